"""The named scenarios of docs/validation/coverage.md."""

from __future__ import annotations

from other_make.plant import Scenario

MINUTE_S = 60.0
HUMIDITY_LAG_S = (5.0 * MINUTE_S, 15.0 * MINUTE_S)

ROWS: dict[str, Scenario] = {
    "instants": Scenario(),
    "means10": Scenario(ambient_mean=True),
    "means60": Scenario(ambient_step_s=3600.0, ambient_mean=True),
    "lag_stated": Scenario(humidity_lag_s=HUMIDITY_LAG_S),
    "lag_unstated": Scenario(humidity_lag_s=HUMIDITY_LAG_S, lag_stated=False),
    "clock": Scenario(clock_s=MINUTE_S),
    "convection": Scenario(exponent=(0.2, 0.33)),
    "second_mass": Scenario(second_mass=(0.3, 1.0)),
    "quantised": Scenario(resolution=(0.5, 0.01)),
    "noise": Scenario(degrees=3.0, outliers=0.001),
    "flare": Scenario(flare=0.8),
}
"""Row -> scenario: ordinary records with instants, and what each further row changes in these."""
