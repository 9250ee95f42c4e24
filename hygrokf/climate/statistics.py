"""The numbers of a year of climate: `STATISTICS` lists all of them with the functions that compute them.

Units are those of specifications: °C, % relative humidity, g/m³, hours a year (of 8766 h). Shapes: N members,
T instants.
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
"""Largest hours a year of each class of time of wetness, ISO 9223:1992; above the last one τ5."""
CYCLE_RANGES_K = np.array([5.0, 10.0, 20.0])


def courses(year: Year) -> dict[str, np.ndarray]:
    """The quantities of a year (N, T) in °C, %, g/m³; only the temperature if the model has no humidity."""
    by_quantity = {"temperature_degC": year.temperature_K - ZERO_CELSIUS_K}
    if year.relative_humidity is not None and year.absolute_humidity_g_m3 is not None:
        by_quantity["relative_humidity_percent"] = 100.0 * year.relative_humidity
        by_quantity["absolute_humidity_g_m3"] = year.absolute_humidity_g_m3
    return by_quantity


def outside(year: Year) -> Year:
    """Return the weather of a year as an ensemble of one member, without condensation."""
    rows = {name: value[None, :] for name, value in year.ambient.items()}
    return replace(
        year,
        temperature_K=rows["temperature_K"],
        relative_humidity=rows.get("relative_humidity"),
        absolute_humidity_g_m3=rows.get("absolute_humidity_g_m3"),
        condensing=None,
    )


def scope_of(year: Year, scope: str) -> np.ndarray:
    """Return which instants (T,) are known and belong to a scope: all, operation, standstill."""
    if scope == "all":
        return year.known
    return year.known & (year.operating if scope == "operation" else ~year.operating)


def steepness(values: np.ndarray, year: Year) -> tuple[np.ndarray, np.ndarray]:
    """Return absolute rates of change (N, T−1) [unit/h] between successive instants, and whether each
    interval (T−1,) is no gap."""
    seconds = np.diff(year.time_s)
    return np.abs(np.diff(values, axis=1)) * (3600.0 / seconds), seconds < 1.5 * 3600.0 * year.step_h


def rates(values: np.ndarray, year: Year) -> np.ndarray:
    """Return absolute rates of change (N, ·) [unit/h] between successive instants that are both known; 0
    without any."""
    all_rates, has_no_gap = steepness(values, year)
    is_usable = has_no_gap & year.known[1:] & year.known[:-1]
    return all_rates[:, is_usable] if is_usable.any() else np.zeros((len(values), 1))


def excursions(beyond: np.ndarray, step_h: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for each member (N,) the number of excursions, i.e. unbroken periods in which `beyond` (N, T) is
    true, and their mean and longest length [h].

    Each instant stands for one step. The mean length is NaN without any excursion.
    """
    padding = np.zeros((len(beyond), 1), dtype=bool)
    padded = np.concatenate([padding, beyond, padding], axis=1)
    counts = (padded[:, 1:] & ~padded[:, :-1]).sum(axis=1)
    index = np.arange(padded.shape[1])
    last_outside = np.maximum.accumulate(np.where(padded, 0, index), axis=1)
    longest_h = (index - last_outside).max(axis=1) * step_h
    hours_beyond = beyond.sum(axis=1) * step_h
    mean_length_h = np.where(counts > 0, hours_beyond / np.maximum(counts, 1), np.nan)
    return counts.astype(float), mean_length_h, longest_h.astype(float)


def turning_points(values: np.ndarray) -> np.ndarray:
    """Return the values of a course (T,) at its turning points and at both ends."""
    values = np.asarray(values, dtype=float)
    values = values[np.append(True, values[1:] != values[:-1])] if len(values) else values
    if len(values) < 3:
        return values
    direction = np.sign(np.diff(values))
    return values[np.concatenate([[True], direction[1:] != direction[:-1], [True]])]


def rainflow(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count the cycles in a course (T,): their ranges (c,) in its unit, and their counts (c,), 1 or for half
    cycles 0.5.

    Source: rainflow counting, ASTM E1049-85 (2017), section 5.4.4.
    """
    ranges: list[float] = []
    counts: list[float] = []
    stack: list[float] = []
    for value in turning_points(values).tolist():
        stack.append(value)
        while len(stack) >= 3:
            last_range, previous_range = abs(stack[-1] - stack[-2]), abs(stack[-2] - stack[-3])
            if last_range < previous_range:
                break
            ranges.append(previous_range)
            if len(stack) == 3:  # the range holds the start of the course: half a cycle
                counts.append(0.5)
                del stack[0]
            else:
                counts.append(1.0)
                del stack[-3:-1]
    ranges += [abs(end - start) for start, end in itertools.pairwise(stack)]
    counts += [0.5] * max(len(stack) - 1, 0)
    return np.array(ranges), np.array(counts)


def cycles_from(values: np.ndarray) -> np.ndarray:
    """Return the number (k,) of cycles in a course (T,) whose range is at least each of `CYCLE_RANGES_K`."""
    ranges, counts = rainflow(values)
    return np.array([counts[ranges >= smallest_range].sum() for smallest_range in CYCLE_RANGES_K])


@dataclass(frozen=True, eq=False)
class ScopeHours:
    """The known hours of a year in a scope, with the intermediate results that several statistics share."""

    year: Year
    law: Acceleration
    scope: str = "all"

    @cached_property
    def chosen(self) -> np.ndarray:
        """Whether each instant (T,) is known and belongs to the scope."""
        return scope_of(self.year, self.scope)

    @cached_property
    def per_year(self) -> float:
        """Hours of a year [h] that each known instant stands for."""
        return float(YEAR_H / self.year.known.sum())

    @cached_property
    def courses(self) -> dict[str, np.ndarray]:
        """The quantities of the year (N, T) by name, in °C, %, g/m³."""
        return courses(self.year)

    @cached_property
    def steep(self) -> dict[str, np.ndarray]:
        """Absolute rates of change (N, ·) [unit/h] by quantity."""
        return {name: rates(value, self.year) for name, value in self.courses.items()}

    @cached_property
    def cycles(self) -> np.ndarray:
        """Temperature cycles (N, 3) in the known hours, from each of `CYCLE_RANGES_K` on."""
        known = self.courses["temperature_degC"][:, self.year.known]
        return np.array([cycles_from(row) for row in known])

    @cached_property
    def stretches(self) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Number, mean length [h] and longest length [h] (N,) of each of `EXCURSIONS`."""
        beyond = {name: condition_of(self) for name, (_, condition_of) in EXCURSIONS.items()}
        known, step = self.year.known, self.year.step_h
        return {
            name: excursions(is_beyond & known, step)
            for name, is_beyond in beyond.items()
            if is_beyond is not None
        }

    def count(self, condition: np.ndarray | None) -> np.ndarray | None:
        """Return the hours a year (N,) of the scope in which a condition (N, T) holds; None for an unknown
        condition."""
        return None if condition is None else condition[:, self.chosen].sum(axis=1) * self.per_year


@dataclass(frozen=True)
class YearNumber:
    """One number of a year: its `name` in climate.json, and its `words` and `unit` on the page.

    `of`: computes it for every member (N,); None if the model lacks the quantity. `table`: "scope" for a
    number of each scope; "excursion" and "rate" for numbers of the whole year. `weather`: whether the weather
    has this number too. `compared`: whether regions are compared by it.
    """

    name: str
    words: str
    unit: str
    of: Callable[[ScopeHours], np.ndarray | None]
    table: Literal["scope", "excursion", "rate"] = "scope"
    weather: bool = True
    compared: bool = False


def _mean(hours: ScopeHours, quantity: str) -> np.ndarray | None:
    """Return the mean of a quantity (N,) over the hours of the scope."""
    value = hours.courses.get(quantity)
    if value is None:
        return None
    return value[:, hours.chosen].mean(axis=1) if hours.chosen.any() else np.full(len(value), np.nan)


def _more_humid(hours: ScopeHours, percent: float) -> np.ndarray | None:
    """Return whether the relative humidity (N, T) is above a limit [%]."""
    value = hours.courses.get("relative_humidity_percent")
    return None if value is None else value > percent


def _wetness(hours: ScopeHours) -> np.ndarray | None:
    """Return the time of wetness (N,) [h/a]: above `WET_PERCENT` and above 0 °C."""
    humid = _more_humid(hours, WET_PERCENT)
    return None if humid is None else hours.count(humid & (hours.courses["temperature_degC"] > 0.0))


def _ageing(hours: ScopeHours) -> np.ndarray | None:
    """Return the ageing (N,) [h at the reference condition a year]."""
    humidity = hours.year.relative_humidity
    if humidity is None and hours.law.humid:
        return None
    humidity_of_scope = None if humidity is None else humidity[:, hours.chosen]
    return (
        hours.law.rate(hours.year.temperature_K[:, hours.chosen], humidity_of_scope).sum(axis=1)
        * hours.per_year
    )


EXCURSIONS: dict[str, tuple[str, Callable[[ScopeHours], np.ndarray | None]]] = {
    "humidity_above_80": ("humidity above 80 %", partial(_more_humid, percent=80.0)),
    "humidity_above_95": ("humidity above 95 %", partial(_more_humid, percent=95.0)),
    "temperature_above_40": ("temperature above 40 °C", lambda h: h.courses["temperature_degC"] > 40.0),
    "temperature_below_0": ("temperature below 0 °C", lambda h: h.courses["temperature_degC"] < 0.0),
    "condensation": ("condensation", lambda hours: hours.year.condensing),
}
"""Name of an excursion → its words, and the function that returns when it holds (N, T)."""
EXCURSION_PARTS = {
    "h": "h/a",
    "number": "number/a",
    "mean_length_h": "mean length, h",
    "longest_h": "longest, h",
}
"""The numbers of an excursion: ending of the name → unit, for lengths with the word for it."""


def _of_excursion(hours: ScopeHours, name: str, part: str) -> np.ndarray | None:
    """Return one of `EXCURSION_PARTS` of an excursion (N,)."""
    if part == "h":
        return hours.count(EXCURSIONS[name][1](hours))
    if name not in hours.stretches:
        return None
    counts, mean_length_h, longest_h = hours.stretches[name]
    if part == "number":
        return counts * hours.per_year / hours.year.step_h
    return mean_length_h if part == "mean_length_h" else longest_h


def _rate(hours: ScopeHours, quantity: str, share: float) -> np.ndarray | None:
    """Return the rate of change (N,) [unit/h] that a share [1] of the time does not exceed."""
    rates_of_quantity = hours.steep.get(quantity)
    if rates_of_quantity is None:
        return None
    return np.quantile(rates_of_quantity, share, axis=1) if share < 1.0 else rates_of_quantity.max(axis=1)


def _cycles_from(range_number: int) -> Callable[[ScopeHours], np.ndarray]:
    """Return the function that computes the cycles a year (N,) from one of `CYCLE_RANGES_K` on."""
    return lambda hours: hours.cycles[:, range_number] * hours.per_year / hours.year.step_h


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
"""All numbers of a climate, in the order of climate.json.  A new number needs only a row here to appear in
climate.json, climate.csv and the tables."""


def scalars(year: Year, law: Acceleration, scope: str = "all") -> dict[str, np.ndarray]:
    """Return the numbers (N,) of a year by name, as listed in `STATISTICS`.

    Hours and counts are scaled from the known hours, at least one, to a year of 8766 h. Rates, excursions and
    cycles, which need a course without holes, are computed for the whole year only.
    """
    hours = ScopeHours(year, law, scope)
    wanted = [statistic for statistic in STATISTICS if statistic.table == "scope" or scope == "all"]
    return {statistic.name: value for statistic in wanted if (value := statistic.of(hours)) is not None}


def wetness_class(hours: float) -> str:
    """Return the class of a time of wetness [h a year], ISO 9223:1992: τ1 … τ5."""
    return next((name for largest_h, name in WETNESS_CLASSES if hours <= largest_h), "τ5")
