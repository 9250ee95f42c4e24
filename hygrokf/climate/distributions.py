"""Distributions of a year: duration curves, rates of change, and temperature with humidity.

Shapes: N members, T instants.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hygrokf.climate.ensemble import YEAR_H, Year
from hygrokf.climate.statistics import courses, rates

SHARES = (0.0, 0.001, 0.01, 0.02, 0.05, *np.arange(0.1, 0.91, 0.05).round(2), 0.95, 0.98, 0.99, 0.999, 1.0)
"""Shares of the time [1] at which a duration curve is given."""
TEMPERATURE_EDGES = np.arange(-60.0, 120.1, 2.5)
HUMIDITY_EDGES = np.arange(0.0, 100.1, 5.0)
"""Edges of the joint distribution [°C], [%]; the last bin also counts what is above saturation."""


@dataclass(frozen=True)
class Curves:
    """The curves of one year for every member.

    `duration` by quantity (N, len(SHARES)), `rates` likewise of absolute rates, `joint` (N, temperature bins,
    humidity bins) in hours a year, or None without humidity.
    """

    duration: Mapping[str, np.ndarray]
    rates: Mapping[str, np.ndarray]
    joint: np.ndarray | None


def curves(year: Year) -> Curves:
    """Duration curves, rates and the joint distribution of a year."""
    rows = courses(year)
    shares = 1.0 - np.array(SHARES)
    duration = {name: np.quantile(value[:, year.known], shares, axis=1).T for name, value in rows.items()}
    steep = {}
    for name, short in (
        ("temperature_degC", "temperature"),
        ("relative_humidity_percent", "relative_humidity"),
    ):
        if name in rows:
            steep[short] = np.quantile(rates(rows[name], year), shares, axis=1).T
    joint = None
    if "relative_humidity_percent" in rows:
        joint = joint_hours(
            rows["temperature_degC"][:, year.known], rows["relative_humidity_percent"][:, year.known]
        )
    return Curves(duration, steep, joint)


def joint_hours(celsius: np.ndarray, percent: np.ndarray) -> np.ndarray:
    """Hours a year (N, I, J) of every member in the bins of `TEMPERATURE_EDGES` and `HUMIDITY_EDGES`."""
    rows, columns = len(TEMPERATURE_EDGES) - 1, len(HUMIDITY_EDGES) - 1
    i = np.clip(np.searchsorted(TEMPERATURE_EDGES, celsius, side="right") - 1, 0, rows - 1)
    j = np.clip(np.searchsorted(HUMIDITY_EDGES, percent, side="right") - 1, 0, columns - 1)
    member = np.arange(len(celsius))[:, None]
    flat = ((member * rows + i) * columns + j).ravel()
    counted = np.bincount(flat, minlength=len(celsius) * rows * columns)
    return counted.reshape(-1, rows, columns) * (YEAR_H / celsius.shape[1])
