"""Simulated cabinets of another make than tests/plants, to judge bounds and verdicts with.

Nothing here imports the package or tests/plants, save `other_make.as_record`, which wraps a finished plant as
a record. Weather, operation, cabinet, disturbances and loggers are written anew: physical units, Hyland and
Wexler's saturation pressure, third-order steps of 20 s, true courses that also move between readings.

    from other_make import ROWS, make_plant
    from other_make.as_record import to_record
    plant = make_plant(seed=10000, scenario=ROWS["means10"], days=90.0)
    record, truth = to_record(plant), plant.truth
"""

from __future__ import annotations

from other_make.cabinet import Cabinet, Trajectory, integrate
from other_make.plant import Plant, Scenario, Truth, make_plant
from other_make.rows import ROWS

__all__ = ["ROWS", "Cabinet", "Plant", "Scenario", "Trajectory", "Truth", "integrate", "make_plant"]
