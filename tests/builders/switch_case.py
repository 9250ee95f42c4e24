"""A cabinet whose heater, a controller that acts at standstill, is in the model."""

from __future__ import annotations

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.modelling.design import Design, design, extended

HOUR = 3600.0
START = 1.6e9
HEAT = {"throttled_heating": {"reads": "cabinet_temperature", "start": 288.15, "full": 285.15, "idle": True}}


def weather(days: float = 12.0, cabinet: bool = True, step: float = 600.0) -> Record:
    """A cold spell at standstill, with readings of an empty cabinet that say nothing."""
    count = int(days * 86400.0 / step)
    time = START + step * np.arange(count + 1.0)
    hours = (time - START) / HOUR
    series = [
        Series("ambient_temperature", time, 275.0 + 6.0 * np.sin(hours * 2.0 * np.pi / 24.0)),
        Series("active_power", time, np.where(hours < 100.0, 0.0, 1.0e6), interval_s=step, hold="mean"),
    ]
    if cabinet:
        series.append(Series("cabinet_temperature", time, np.full(len(time), 285.15 + 10.0)))
    return Record("cold", tuple(series), rated_power_W=2e6)


def heated(record: Record) -> tuple[Design, dict[str, float]]:
    base = extended(
        design(weather(), kind="thermal", power_order=1), (("unreported_heater", {}),), features=HEAT
    )
    values = {p.name: p.start for p in base.model.parameters}
    values |= {
        "heater_heat": 25.0, "thermal_time_constant": 3.0, "resistance_ratio": 0.9,
        "heat_release_operation": 4.0, "heat_release_power_1": 8.0, "heat_release_standstill": 2.0,
    }  # fmt: skip
    return base, values
