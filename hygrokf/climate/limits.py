"""Limits of a requirement specification, and whether a climate keeps to them.

A file of limits:

    [[limit]]
    name = "operation, hot"
    quantity = "temperature_degC"       # see `QUANTITIES`
    above = 45                          # or below = …
    hours_a_year = 0                    # allowed beyond it
    during = "operation"                # or "standstill"; all of the year where it is left out
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.climate.bounds import Bounded, bounded
from hygrokf.climate.ensemble import YEAR_H, Year
from hygrokf.climate.form import FormFault, is_number, read_toml, unknown_keys
from hygrokf.climate.statistics import SCOPES, courses, excursions, scope_of

QUANTITIES = {
    "temperature_degC": "°C",
    "relative_humidity_percent": "%",
    "absolute_humidity_g_m3": "g/m³",
    "temperature_rate_K_per_h": "K/h",
    "relative_humidity_rate_percent_per_h": "%/h",
}
"""Quantities that may be limited, with their units; rates are absolute ones over an hour."""
_RATE_OF = {
    "temperature_rate_K_per_h": "temperature_degC",
    "relative_humidity_rate_percent_per_h": "relative_humidity_percent",
}
_KEYS = ("name", "quantity", "above", "below", "hours_a_year", "during")


@dataclass(frozen=True)
class Limit:
    """A limit: at most `hours_a_year` of `quantity` above (`side`) or below `level`, `during` a scope of the year."""

    name: str
    quantity: str
    side: str
    level: float
    hours_a_year: float = 0.0
    during: str = "all"

    def words(self) -> str:
        when = "" if self.during == "all" else f" in {self.during}"
        return f"{self.quantity_words} {self.side} {self.level:g} {QUANTITIES[self.quantity]}{when}"

    @property
    def quantity_words(self) -> str:
        for tail in ("_degC", "_percent_per_h", "_percent", "_g_m3", "_K_per_h"):
            if self.quantity.endswith(tail):
                return self.quantity.removesuffix(tail).replace("_", " ")
        return self.quantity


@dataclass(frozen=True)
class Exceedance:
    """How a climate keeps to a limit: hours and number of exceedances a year, the longest [h], and the verdict.

    `why`: what stands in the way of a verdict, in words, or "".
    """

    limit: Limit
    hours: Bounded
    number: Bounded
    longest_h: Bounded
    verdict: str
    why: str = ""

    def to_json(self) -> dict:
        return {
            **vars(self.limit),
            "hours": self.hours.to_json(),
            "number": self.number.to_json(),
            "longest_h": self.longest_h.to_json(),
            "verdict": self.verdict,
            "why": self.why,
        }


def read_limits(path: str | os.PathLike[str]) -> tuple[Limit, ...]:
    """Limits from a TOML file; raises FormFault with everything that is wrong."""
    data = read_toml(path, "limits, one [[limit]] each")
    faults = unknown_keys(data, ("limit",), "the file")
    rows = data.get("limit")
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) for row in rows):
        raise FormFault(path, [*faults, "expected at least one [[limit]], found none; see docs/climate.md"])
    found = [_limit(row, f"limit {number}", faults) for number, row in enumerate(rows, 1)]
    faults = faults or _doubled(found)  # rows that are wrong have names that only look alike
    if faults:
        raise FormFault(path, faults)
    return tuple(found)


def _doubled(limits: Sequence[Limit]) -> list[str]:
    names = [one.name for one in limits]
    return [
        f'two limits are called "{n}"; rename one' for n in sorted({n for n in names if names.count(n) > 1})
    ]


def expect_names(limits: Sequence[Limit]) -> None:
    """Refuse limits of one name, maybe of several files; raises ValueError."""
    if faults := _doubled(limits):
        raise ValueError("; ".join(faults))


def _limit(row: dict, where: str, faults: list[str]) -> Limit:
    faults += unknown_keys(row, _KEYS, where)
    quantity, during = row.get("quantity"), row.get("during", "all")
    if not isinstance(quantity, str) or quantity not in QUANTITIES:
        faults.append(f"{where}: quantity: expected one of {', '.join(QUANTITIES)}, found {quantity!r}")
        quantity = "temperature_degC"
    sides = [side for side in ("above", "below") if side in row]
    if len(sides) != 1 or not is_number(row[sides[0]]):
        faults.append(
            f"{where}: expected either above or below with a number, found "
            f"{', '.join(f'{side} = {str(row[side])[:40]}' for side in sides) or 'neither'}"
        )
        sides, row = ["above"], {**row, "above": 0.0}
    level = row[sides[0]]
    if quantity == "relative_humidity_percent" and 0.0 < level <= 1.5:
        faults.append(
            f"{where}: {sides[0]} = {level:g}: expected per cent, its number looks like a fraction; "
            f"write {sides[0]} = {100.0 * level:g}"
        )
    if "rate" in quantity and sides[0] == "below":
        faults.append(f"{where}: a rate is limited from above; write above = …")
    allowed = row.get("hours_a_year", 0.0)
    if not is_number(allowed) or not 0.0 <= allowed <= YEAR_H:
        faults.append(f"{where}: hours_a_year: expected a number within 0 … {YEAR_H:g}, found {allowed!r}")
        allowed = 0.0
    if during not in SCOPES:
        faults.append(f"{where}: during: expected one of {', '.join(SCOPES)}, found {during!r}")
        during = "all"
    name = row.get("name", "")
    if not isinstance(name, str):
        faults.append(f"{where}: name: expected a text, found {name!r}")
        name = ""
    made = Limit("", quantity, sides[0], float(row[sides[0]]), float(allowed), during)
    return Limit(name or made.words(), quantity, made.side, made.level, made.hours_a_year, during)


def beyond(year: Year, limit: Limit) -> np.ndarray | None:
    """Instants (N, T) at which a year is beyond a limit; None where the model lacks the quantity."""
    quantity = _RATE_OF.get(limit.quantity, limit.quantity)
    values = courses(year).get(quantity)
    if values is None:
        return None
    chosen = scope_of(year, limit.during)
    if limit.quantity in _RATE_OF:
        seconds = np.diff(year.time_s)
        near = (seconds < 1.5 * 3600.0 * year.step_h) & chosen[1:] & chosen[:-1]
        steep = np.abs(np.diff(values, axis=1)) * (3600.0 / seconds)
        found = np.zeros(values.shape, dtype=bool)
        found[:, 1:] = (steep > limit.level) & near
        return found
    outside = values > limit.level if limit.side == "above" else values < limit.level
    return outside & chosen


def exceeded(year: Year, limit: Limit) -> np.ndarray | None:
    """Hours a year, number a year and longest exceedance [h] of every member (N, 3)."""
    found = beyond(year, limit)
    if found is None:
        return None
    per_year = YEAR_H / year.known.sum()
    number, _, longest = excursions(found, year.step_h)
    return np.column_stack([found.sum(axis=1) * per_year, number * per_year / year.step_h, longest])


def judged(limit: Limit, years: Sequence[np.ndarray], part: str = "") -> Exceedance:
    """The verdict on a limit from the members' numbers (N, 3) in every year.

    "pass" where the upper bound of the hours in a year is within what is allowed, "fail" where the lower bound is
    beyond it, "undecided" between them, and also where nothing more than a `part` of a year is known (in words, such as
    "80 days") that keeps to the limit: the rest may not.
    """
    hours, number, longest = (bounded(np.array([year[:, i] for year in years])) for i in range(3))
    verdict, why = "undecided", ""
    if hours.upper <= limit.hours_a_year:
        verdict, why = ("undecided", f"of {part}, not a year") if part else ("pass", "")
    elif hours.lower > limit.hours_a_year:
        verdict = "fail"
    return Exceedance(limit, hours, number, longest, verdict, why)
