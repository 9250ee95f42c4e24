"""What a year of climate is like, in numbers: one for each member.

Units are those of requirement specifications: °C, % relative humidity, g/m³, hours a year (of 8766 h).
Shapes: N members, T instants.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.climate.acceleration import FREEZING_K, Acceleration
from hygrokf.climate.cycles import cycles_from
from hygrokf.climate.ensemble import YEAR_H, Year

SCOPES = ("all", "operation", "standstill")
SHARES = (0.0, 0.001, 0.01, 0.02, 0.05, *np.arange(0.1, 0.91, 0.05).round(2), 0.95, 0.98, 0.99, 0.999, 1.0)
"""Shares of the time at which a duration curve is told."""
UNITS = {"temperature_degC": "°C", "relative_humidity_percent": "%", "absolute_humidity_g_m3": "g/m³"}
RATES = {"temperature": "K/h", "relative_humidity": "%/h"}
WET_PERCENT = 80.0
"""Relative humidity above which, above 0 °C, a surface counts as wet: time of wetness, ISO 9223:2012."""
WETNESS_CLASSES = ((10.0, "τ1"), (250.0, "τ2"), (2500.0, "τ3"), (5500.0, "τ4"))
"""Most hours a year of the classes of time of wetness, ISO 9223:1992; τ5 above."""
EXCURSIONS = {
    "humidity_above_80": ("relative_humidity_percent", "above", 80.0),
    "humidity_above_95": ("relative_humidity_percent", "above", 95.0),
    "temperature_above_40": ("temperature_degC", "above", 40.0),
    "temperature_below_0": ("temperature_degC", "below", 0.0),
}
"""Excursions that are counted in every climate: quantity, side, level."""
CYCLE_RANGES_K = np.array([5.0, 10.0, 20.0])
TEMPERATURE_EDGES = np.arange(-60.0, 120.1, 2.5)
HUMIDITY_EDGES = np.arange(0.0, 100.1, 5.0)
"""Edges of the joint distribution [°C], [%]; what is above saturation counts in the last bin."""


@dataclass(frozen=True)
class Curves:
    """Of one year, for every member: `duration` by quantity (N, len(SHARES)), `rates` likewise of absolute rates,
    `joint` (N, temperature bins, humidity bins) in hours a year, or None without humidity.
    """

    duration: Mapping[str, np.ndarray]
    rates: Mapping[str, np.ndarray]
    joint: np.ndarray | None


def courses(year: Year) -> dict[str, np.ndarray]:
    """Quantities (N, T) in °C, %, g/m³; those that there are."""
    found = {"temperature_degC": year.temperature_K - FREEZING_K}
    if year.relative_humidity is not None and year.absolute_humidity_g_m3 is not None:
        found["relative_humidity_percent"] = 100.0 * year.relative_humidity
        found["absolute_humidity_g_m3"] = year.absolute_humidity_g_m3
    return found


def outside(year: Year) -> Year:
    """The weather of a year as an ensemble of one member; nothing condenses there."""
    rows = {name: value[None, :] for name, value in year.ambient.items()}
    return replace(
        year,
        temperature_K=rows["temperature_K"],
        relative_humidity=rows.get("relative_humidity"),
        absolute_humidity_g_m3=rows.get("absolute_humidity_g_m3"),
        condensing=None,
    )


def scope_of(year: Year, scope: str) -> np.ndarray:
    """Instants (T,) that are known and belong to a scope: all, operation, standstill."""
    if scope == "all":
        return year.known
    return year.known & (year.operating if scope == "operation" else ~year.operating)


def scalars(year: Year, law: Acceleration, scope: str = "all") -> dict[str, np.ndarray]:
    """Single numbers (N,) of a year by name; the name ends with the unit.

    Hours and numbers are those of 8766 hours of the same kind.  What needs a course without holes (rates, excursions,
    cycles) is told for the whole year alone.  Raises ValueError where nothing of the year is known.
    """
    if not year.known.any():
        raise ValueError("of this year neither weather nor power is known at any instant; check the files")
    chosen = scope_of(year, scope)
    per_year = YEAR_H / year.known.sum()
    rows = courses(year)
    count = len(year.temperature_K)
    found = {"hours": np.full(count, chosen.sum() * per_year)}
    for name, value in rows.items():
        found[f"mean_{name}"] = value[:, chosen].mean(axis=1) if chosen.any() else np.full(count, np.nan)
    humid = year.relative_humidity is not None
    if year.relative_humidity is not None:
        wet = (rows["relative_humidity_percent"] > WET_PERCENT) & (rows["temperature_degC"] > 0.0)
        found["wetness_h"] = wet[:, chosen].sum(axis=1) * per_year
        found["saturation_h"] = (year.relative_humidity > 1.0)[:, chosen].sum(axis=1) * per_year
        if year.condensing is not None:
            found["condensation_h"] = year.condensing[:, chosen].sum(axis=1) * per_year
    if humid or not law.humid:
        damp = None if year.relative_humidity is None else year.relative_humidity[:, chosen]
        rate = law.rate(year.temperature_K[:, chosen], damp)
        found["ageing_h"] = rate.sum(axis=1) * per_year
    if scope == "all":
        found |= _of_courses(year, rows, per_year)
    return found


def _of_courses(year: Year, rows: Mapping[str, np.ndarray], per_year: float) -> dict[str, np.ndarray]:
    """Rates, excursions and cycles."""
    found: dict[str, np.ndarray] = {}
    for name, (quantity, side, level) in EXCURSIONS.items():
        if quantity in rows:
            beyond = rows[quantity] > level if side == "above" else rows[quantity] < level
            number, mean, longest = excursions(beyond & year.known, year.step_h)
            found |= {
                f"{name}_h": beyond[:, year.known].sum(axis=1) * per_year,
                f"{name}_number": number * per_year / year.step_h,
                f"{name}_mean_length_h": mean,
                f"{name}_longest_h": longest,
            }
    if year.condensing is not None:
        number, mean, longest = excursions(year.condensing & year.known, year.step_h)
        found |= {
            "condensation_number": number * per_year / year.step_h,
            "condensation_mean_length_h": mean,
            "condensation_longest_h": longest,
        }
    for name, unit in (("temperature_degC", "K"), ("relative_humidity_percent", "percent")):
        if name in rows:
            steep = rates(rows[name], year)
            quantity = name.rsplit("_", 1)[0]
            found[f"{quantity}_rate_99_{unit}_per_h"] = np.quantile(steep, 0.99, axis=1)
            found[f"{quantity}_rate_largest_{unit}_per_h"] = steep.max(axis=1)
    cycles = np.array([cycles_from(row, CYCLE_RANGES_K) for row in rows["temperature_degC"][:, year.known]])
    for place, least in enumerate(CYCLE_RANGES_K):
        found[f"temperature_cycles_from_{least:g}_K_number"] = cycles[:, place] * per_year / year.step_h
    return found


def rates(values: np.ndarray, year: Year) -> np.ndarray:
    """Absolute rates (N, ·) [unit/h] between neighbouring instants of which both are known."""
    seconds = np.diff(year.time_s)
    both = year.known[1:] & year.known[:-1] & (seconds < 1.5 * 3600.0 * year.step_h)
    if not both.any():
        return np.zeros((len(values), 1))
    return np.abs(np.diff(values, axis=1)[:, both]) * (3600.0 / seconds[both])


def excursions(beyond: np.ndarray, step_h: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number (N,) of stretches in which `beyond` (N, T) holds, their mean length and the longest (N,) [h].

    Each instant stands for one step.  Where there is no stretch the mean length is NaN: none has a length.
    """
    edge = np.zeros((len(beyond), 1), dtype=bool)
    padded = np.concatenate([edge, beyond, edge], axis=1)
    number = (padded[:, 1:] & ~padded[:, :-1]).sum(axis=1)
    place = np.arange(padded.shape[1])
    last_off = np.maximum.accumulate(np.where(padded, 0, place), axis=1)
    longest = (place - last_off).max(axis=1) * step_h
    total = beyond.sum(axis=1) * step_h
    mean = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    return number.astype(float), mean, longest.astype(float)


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


def wetness_class(hours: float) -> str:
    """Class of a time of wetness [h a year], ISO 9223:1992: τ1 … τ5."""
    return next((name for most, name in WETNESS_CLASSES if hours <= most), "τ5")
