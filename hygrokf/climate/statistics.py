"""The numbers of a year of climate, and the table `STATISTICS` that they are all made from.

Units are those of requirement specifications: °C, % relative humidity, g/m³, hours a year (of 8766 h).
Shapes: N members, T instants.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np

from hygrokf.climate.chamber import Acceleration
from hygrokf.climate.ensemble import YEAR_H, Year
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K

SCOPES = ("all", "operation", "standstill")
WET_PERCENT = 80.0
"""Relative humidity above which, above 0 °C, a surface counts as wet: time of wetness, ISO 9223:2012."""
WETNESS_CLASSES = ((10.0, "τ1"), (250.0, "τ2"), (2500.0, "τ3"), (5500.0, "τ4"))
"""Most hours a year of the classes of time of wetness, ISO 9223:1992; τ5 above."""
CYCLE_RANGES_K = np.array([5.0, 10.0, 20.0])


def courses(year: Year) -> dict[str, np.ndarray]:
    """Quantities (N, T) in °C, %, g/m³; those that there are."""
    found = {"temperature_degC": year.temperature_K - ZERO_CELSIUS_K}
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


def steepness(values: np.ndarray, year: Year) -> tuple[np.ndarray, np.ndarray]:
    """Absolute rates (N, T−1) [unit/h] from each instant to the next, and which (T−1,) bridge no gap."""
    seconds = np.diff(year.time_s)
    return np.abs(np.diff(values, axis=1)) * (3600.0 / seconds), seconds < 1.5 * 3600.0 * year.step_h


def rates(values: np.ndarray, year: Year) -> np.ndarray:
    """Absolute rates (N, ·) [unit/h] between neighbouring instants that are both known; 0 where none are."""
    steep, near = steepness(values, year)
    both = near & year.known[1:] & year.known[:-1]
    return steep[:, both] if both.any() else np.zeros((len(values), 1))


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


def turning_points(values: np.ndarray) -> np.ndarray:
    """Values (T,) at which a course turns, with its two ends."""
    values = np.asarray(values, dtype=float)
    values = values[np.append(True, values[1:] != values[:-1])] if len(values) else values
    if len(values) < 3:
        return values
    rise = np.sign(np.diff(values))
    return values[np.concatenate([[True], rise[1:] != rise[:-1], [True]])]


def rainflow(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ranges (c,) of the cycles in a course (T,), in its unit, and their counts (c,): 1, or 0.5 for half
    cycles.

    Source: rainflow counting, ASTM E1049-85 (2017), section 5.4.4.
    """
    ranges: list[float] = []
    counts: list[float] = []
    stack: list[float] = []
    for value in turning_points(values).tolist():
        stack.append(value)
        while len(stack) >= 3:
            last, before = abs(stack[-1] - stack[-2]), abs(stack[-2] - stack[-3])
            if last < before:
                break
            ranges.append(before)
            if len(stack) == 3:  # the range holds the start of the course: half a cycle
                counts.append(0.5)
                del stack[0]
            else:
                counts.append(1.0)
                del stack[-3:-1]
    ranges += [abs(b - a) for a, b in itertools.pairwise(stack)]
    counts += [0.5] * max(len(stack) - 1, 0)
    return np.array(ranges), np.array(counts)


def cycles_from(values: np.ndarray) -> np.ndarray:
    """Number (k,) of cycles in a course (T,) with a range of at least each of `CYCLE_RANGES_K`."""
    ranges, counts = rainflow(values)
    return np.array([counts[ranges >= least].sum() for least in CYCLE_RANGES_K])


@dataclass(frozen=True, eq=False)
class ScopeHours:
    """The known hours of a year in a scope, with the courses that several statistics are made from."""

    year: Year
    law: Acceleration
    scope: str = "all"

    @cached_property
    def chosen(self) -> np.ndarray:
        """Instants (T,) that are known and belong to the scope."""
        return scope_of(self.year, self.scope)

    @cached_property
    def per_year(self) -> float:
        """Hours of a year that each known instant stands for."""
        return float(YEAR_H / self.year.known.sum())

    @cached_property
    def courses(self) -> dict[str, np.ndarray]:
        return courses(self.year)

    @cached_property
    def steep(self) -> dict[str, np.ndarray]:
        """Absolute rates of change (N, ·) by quantity, per hour."""
        return {name: rates(value, self.year) for name, value in self.courses.items()}

    @cached_property
    def cycles(self) -> np.ndarray:
        """Temperature cycles (N, 3) in the known hours from each of `CYCLE_RANGES_K`."""
        known = self.courses["temperature_degC"][:, self.year.known]
        return np.array([cycles_from(row) for row in known])

    @cached_property
    def stretches(self) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Number, mean length [h] and longest (N,) [h] of the stretches of each of `EXCURSIONS`."""
        beyond = {name: where(self) for name, (_, where) in EXCURSIONS.items()}
        known, step = self.year.known, self.year.step_h
        return {n: excursions(one & known, step) for n, one in beyond.items() if one is not None}

    def count(self, where: np.ndarray | None) -> np.ndarray | None:
        """Hours a year (N,) of the scope in which a condition (N, T) holds; None where it is not known."""
        return None if where is None else where[:, self.chosen].sum(axis=1) * self.per_year


@dataclass(frozen=True)
class YearNumber:
    """One number of a year: `name` in climate.json, `words` and `unit` on the page.

    `of` computes it for every member (N,); None where the model lacks the quantity.  `table`: "scope" for a
    number that operation and standstill have too, "excursion" and "rate" for numbers of the whole year.
    `weather`: whether the weather has this number too, so that it stands beside the cabinet's.  `compared`:
    whether several regions are compared by it.
    """

    name: str
    words: str
    unit: str
    of: Callable[[ScopeHours], np.ndarray | None]
    table: Literal["scope", "excursion", "rate"] = "scope"
    weather: bool = True
    compared: bool = False


def _mean(hours: ScopeHours, quantity: str) -> np.ndarray | None:
    value = hours.courses.get(quantity)
    if value is None:
        return None
    return value[:, hours.chosen].mean(axis=1) if hours.chosen.any() else np.full(len(value), np.nan)


def _more_humid(hours: ScopeHours, percent: float) -> np.ndarray | None:
    value = hours.courses.get("relative_humidity_percent")
    return None if value is None else value > percent


def _wetness(hours: ScopeHours) -> np.ndarray | None:
    humid = _more_humid(hours, WET_PERCENT)
    return None if humid is None else hours.count(humid & (hours.courses["temperature_degC"] > 0.0))


def _ageing(hours: ScopeHours) -> np.ndarray | None:
    humidity = hours.year.relative_humidity
    if humidity is None and hours.law.humid:
        return None
    damp = None if humidity is None else humidity[:, hours.chosen]
    return hours.law.rate(hours.year.temperature_K[:, hours.chosen], damp).sum(axis=1) * hours.per_year


EXCURSIONS: dict[str, tuple[str, Callable[[ScopeHours], np.ndarray | None]]] = {
    "humidity_above_80": ("humidity above 80 %", partial(_more_humid, percent=80.0)),
    "humidity_above_95": ("humidity above 95 %", partial(_more_humid, percent=95.0)),
    "temperature_above_40": ("temperature above 40 °C", lambda h: h.courses["temperature_degC"] > 40.0),
    "temperature_below_0": ("temperature below 0 °C", lambda h: h.courses["temperature_degC"] < 0.0),
    "condensation": ("condensation", lambda hours: hours.year.condensing),
}
"""Conditions whose stretches are counted: words, and the instants (N, T) at which they hold."""
EXCURSION_PARTS = {
    "h": "h/a",
    "number": "number/a",
    "mean_length_h": "mean length, h",
    "longest_h": "longest, h",
}
"""The numbers of each excursion: ending of the name, and heading of the column."""


def _of_excursion(hours: ScopeHours, name: str, part: str) -> np.ndarray | None:
    if part == "h":
        return hours.count(EXCURSIONS[name][1](hours))
    if name not in hours.stretches:
        return None
    number, mean, longest = hours.stretches[name]
    if part == "number":
        return number * hours.per_year / hours.year.step_h
    return mean if part == "mean_length_h" else longest


def _rate(hours: ScopeHours, quantity: str, share: float) -> np.ndarray | None:
    steep = hours.steep.get(quantity)
    if steep is None:
        return None
    return np.quantile(steep, share, axis=1) if share < 1.0 else steep.max(axis=1)


def _cycles_from(place: int) -> Callable[[ScopeHours], np.ndarray]:
    return lambda hours: hours.cycles[:, place] * hours.per_year / hours.year.step_h


STATISTICS: tuple[YearNumber, ...] = (
    YearNumber("hours", "hours", "h/a",
        lambda hours: np.full(len(hours.year.temperature_K), hours.chosen.sum() * hours.per_year),
        weather=False),
    YearNumber("mean_temperature_degC", "mean temperature", "°C", partial(_mean, quantity="temperature_degC"),
        compared=True),
    YearNumber("mean_relative_humidity_percent", "mean relative humidity", "%",
        partial(_mean, quantity="relative_humidity_percent"), compared=True),
    YearNumber("mean_absolute_humidity_g_m3", "mean absolute humidity", "g/m³",
        partial(_mean, quantity="absolute_humidity_g_m3")),
    YearNumber("wetness_h", "time of wetness (above 80 %, above 0 °C)", "h/a", _wetness, compared=True),
    YearNumber("saturation_h", "relative humidity above 100 %", "h/a",
        lambda hours: hours.count(_more_humid(hours, 100.0))),
    YearNumber("condensation_h", "condensation on the cold surface", "h/a",
        lambda hours: hours.count(hours.year.condensing), compared=True),
    YearNumber("ageing_h", "ageing, in hours at the reference condition", "h/a", _ageing, weather=False,
        compared=True),
    *(
        YearNumber(f"{name}_{part}", words, unit, partial(_of_excursion, name=name, part=part),
            "excursion")
        for name, (words, _) in EXCURSIONS.items()
        for part, unit in EXCURSION_PARTS.items()
        if (name, part) != ("condensation", "h")  # it is in every scope
    ),
    YearNumber("temperature_rate_99_K_per_h", "rate of temperature, exceeded 1 % of the time", "K/h",
        partial(_rate, quantity="temperature_degC", share=0.99), "rate"),
    YearNumber("temperature_rate_largest_K_per_h", "largest rate of temperature", "K/h",
        partial(_rate, quantity="temperature_degC", share=1.0), "rate"),
    YearNumber("relative_humidity_rate_99_percent_per_h", "rate of humidity, exceeded 1 % of the time", "%/h",
        partial(_rate, quantity="relative_humidity_percent", share=0.99), "rate"),
    YearNumber("relative_humidity_rate_largest_percent_per_h", "largest rate of humidity", "%/h",
        partial(_rate, quantity="relative_humidity_percent", share=1.0), "rate"),
    *(
        YearNumber(f"temperature_cycles_from_{least:g}_K_number",
            f"temperature cycles of {least:g} K and more", "1/a", _cycles_from(place), "rate")
        for place, least in enumerate(CYCLE_RANGES_K)
    ),
)  # fmt: skip
"""All numbers of a climate, in the order of climate.json.  A new row here is all that a new number needs: it
appears in climate.json, climate.csv and the tables."""


def scalars(year: Year, law: Acceleration, scope: str = "all") -> dict[str, np.ndarray]:
    """The numbers (N,) of a year by name, as `STATISTICS` lists them.

    Hours and counts are scaled from the known hours, one at least, to a year of 8766 h.  What needs a course
    without holes (rates, excursions, cycles) is computed for the whole year alone.
    """
    hours = ScopeHours(year, law, scope)
    wanted = [one for one in STATISTICS if one.table == "scope" or scope == "all"]
    return {one.name: value for one in wanted if (value := one.of(hours)) is not None}


def wetness_class(hours: float) -> str:
    """Class of a time of wetness [h a year], ISO 9223:1992: τ1 … τ5."""
    return next((name for most, name in WETNESS_CLASSES if hours <= most), "τ5")
