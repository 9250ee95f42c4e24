"""Limits for the climate in a cabinet, from a specification or from a class of a standard, and the verdict on
whether they are kept.

docs/how_to/climate_limits.toml is an example. Classes are included only if their numbers are in public
documents.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from hygrokf.climate.bounds import BoundedMean, bounded
from hygrokf.climate.ensemble import YEAR_H, Year
from hygrokf.climate.statistics import SCOPES, courses, excursions, scope_of, steepness
from hygrokf.data.toml_form import across, read_toml_form, setting
from hygrokf.errors import HygrokfError
from hygrokf.texts.climate_codes import ClimateCode
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import Name

LIMITED_QUANTITIES = {
    "temperature_degC": "°C",
    "relative_humidity_percent": "%",
    "absolute_humidity_g_m3": "g/m³",
    "temperature_rate_K_per_h": "K/h",
    "relative_humidity_rate_percent_per_h": "%/h",
}
"""Quantity that may be limited → its unit; rates are absolute changes over an hour."""
_QUANTITY_OF_RATE = {
    "temperature_rate_K_per_h": "temperature_degC",
    "relative_humidity_rate_percent_per_h": "relative_humidity_percent",
}


@dataclass(frozen=True)
class ClimateLimit:
    """A limit, as in a [[limit]] of a file: `quantity` may be `above` or `below` a level for at most
    `hours_a_year` hours, of the hours `during` a scope of the year."""

    quantity: Name = setting(help="what is limited", choices=tuple(LIMITED_QUANTITIES))
    above: float | None = setting(None, "the level that should not be exceeded")
    below: float | None = setting(None, "the level that the quantity should not fall below")
    hours_a_year: float = setting(0.0, "hours allowed beyond the level", least=0.0, most=YEAR_H)
    during: Name = setting("all", "the hours that count", choices=SCOPES)
    name: Name = setting("", "by default quantity and level in words")

    @property
    def side(self) -> str:
        """ "above" or "below": the key that states the level."""
        return "below" if self.above is None else "above"

    @property
    def level(self) -> float:
        """The level, in the unit of the quantity."""
        return getattr(self, self.side)

    @across("above", "below")
    def one_side(self) -> str | None:
        """Return a fault unless exactly one of `above` and `below` is stated."""
        if (self.above is None) != (self.below is None):
            return None
        found = "neither" if self.above is None else f"above = {self.above:g}, below = {self.below:g}"
        return f"expected either above or below with a number, found {found}"

    @across("above", "below", "quantity")
    def level_of_quantity(self) -> Iterator[str]:
        """Yield faults of a level that does not suit its quantity."""
        if self.quantity == "relative_humidity_percent" and 0.0 < (self.level or 0.0) <= 1.5:
            yield (
                f"{self.side} = {self.level:g}: expected per cent, its number looks like a fraction; "
                f"write {self.side} = {100.0 * self.level:g}"
            )
        if "rate" in self.quantity and self.below is not None:
            yield "a rate is limited from above; write above = …"

    def named(self, prefix: str = "") -> ClimateLimit:
        """Return the limit with a name: its own, or `prefix` and the limit in words."""
        scope_text = "" if self.during == "all" else f" in {self.during}"
        unit = LIMITED_QUANTITIES[self.quantity]
        limit_text = f"{self.quantity_words} {self.side} {self.level:g} {unit}{scope_text}"
        return replace(self, name=self.name or f"{prefix}{limit_text}")

    @property
    def quantity_words(self) -> str:
        """The quantity in words, without its unit."""
        return re.sub("_(degC|percent_per_h|percent|g_m3|K_per_h)$", "", self.quantity).replace("_", " ")


@dataclass(frozen=True)
class LimitsForm:
    """A file of limits."""

    limit: tuple[ClimateLimit, ...] = setting((), "the limits")

    @across("limit")
    def names(self) -> list[str]:
        """Return faults if there is no limit, or if limits share a name."""
        if not self.limit:
            return ["expected at least one [[limit]], found none; see docs/how_to/climate.md"]
        return duplicate_name_faults([limit.named() for limit in self.limit])


@dataclass(frozen=True, kw_only=True)
class Exceedance(ClimateLimit):
    """A limit with its verdict in a climate.

    `hours` [h] and `number` of exceedances in a year; `longest_h`: length of the longest one; `why`: reason
    for "undecided", if it is not the bounds.
    """

    hours: BoundedMean
    number: BoundedMean
    longest_h: BoundedMean
    verdict: Literal["pass", "undecided", "fail"]
    why: Statement | None = None


class ClassFault(HygrokfError):
    """A name that is neither a file of limits nor a known class of a standard."""


CLASSES: Mapping[str, tuple[ClimateLimit, ...]] = {
    # 2nd edition (1994), replaced in 2019 by an edition with other classes; it also limits the absolute
    # humidity and the rate of change of the temperature, without a public number.  Sources: data sheet of the
    # WiFi Fan Controller Rev 3.3, github.com/zeroflow/wifi-fancontroller; humidity also: KEB COMBIVERT G6,
    # installation manual, page 9
    "IEC 60721-3-3 3K3": (
        ClimateLimit("temperature_degC", above=40.0),
        ClimateLimit("temperature_degC", below=5.0),
        ClimateLimit("relative_humidity_percent", above=85.0),
        ClimateLimit("relative_humidity_percent", below=5.0),
    ),
}
"""Class of a standard → its limits, which allow no hour beyond them; docs/how_to/climate.md lists the classes
with their sources."""


def limits_of(given: str | os.PathLike[str]) -> tuple[ClimateLimit, ...]:
    """Return the limits in a file or of a class.

    given: path of a TOML file, or name of a class, with or without its standard: "IEC 60721-3-3 3K3", "EN
        60721-3-3 3K3", "3K3".

    Raises FormFault for a file with faults, ClassFault for an unknown name.
    """
    path = Path(given)
    if path.suffix == ".toml" or path.exists():
        return tuple(limit.named() for limit in read_toml_form(LimitsForm, path).limit)
    for name, limits in CLASSES.items():
        standard, _, letters = name.removeprefix("IEC ").rpartition(" ")
        pattern = rf"(((DIN|EN|IEC|BS|ISO)\s+)*{re.escape(standard)}\s+(class\s+)?)?{letters}"
        if re.fullmatch(pattern, str(given).strip(), re.IGNORECASE):
            return tuple(limit.named(f"{name}: ") for limit in limits)
    raise ClassFault(
        f'limits "{given}": expected a file of limits (.toml) or one of the classes {", ".join(CLASSES)}; '
        "the numbers of other classes are not in public documents: write those of your copy of the standard "
        "into a file, see docs/how_to/climate.md"
    )


def duplicate_name_faults(limits: Sequence[ClimateLimit]) -> list[str]:
    """Return a message for every name that several limits share, as limits of several files may."""
    names = [limit.name for limit in limits]
    return [
        f'two limits are called "{name}"; rename one'
        for name in sorted({name for name in names if names.count(name) > 1})
    ]


def beyond(year: Year, limit: ClimateLimit) -> np.ndarray | None:
    """Whether each member exceeds the limit at each instant (N, T); None if the model lacks the quantity."""
    quantity = _QUANTITY_OF_RATE.get(limit.quantity, limit.quantity)
    values = courses(year).get(quantity)
    if values is None:
        return None
    in_scope = scope_of(year, limit.during)
    if limit.quantity in _QUANTITY_OF_RATE:
        rate, has_no_gap = steepness(values, year)
        is_beyond = np.zeros(values.shape, dtype=bool)
        is_beyond[:, 1:] = (rate > limit.level) & has_no_gap & in_scope[1:] & in_scope[:-1]
        return is_beyond
    is_outside = values > limit.level if limit.side == "above" else values < limit.level
    return is_outside & in_scope


def exceeded(year: Year, limit: ClimateLimit) -> np.ndarray | None:
    """Return for each member (N, 3): hours and number of exceedances in a year, and the longest exceedance
    [h]; None if the model lacks the quantity."""
    is_beyond = beyond(year, limit)
    if is_beyond is None:
        return None
    scale_to_year = YEAR_H / year.known.sum()
    number, _, longest = excursions(is_beyond, year.step_h)
    return np.column_stack(
        [is_beyond.sum(axis=1) * scale_to_year, number * scale_to_year / year.step_h, longest]
    )


def judge_limit(limit: ClimateLimit, years: np.ndarray, part_of_year: Statement | None = None) -> Exceedance:
    """Return the verdict on a limit from the members' exceedances (years, N, 3), those of `exceeded`.

    "pass" if the upper bound of the hours in a year is within the allowed hours, "fail" if the lower bound
    exceeds them, else "undecided". A limit that is kept is also "undecided" if only a part of a year is known
    (`part_of_year`: its length, such as 80 days), because the rest of the year may exceed it.
    """
    hours, number, longest = (bounded(years[:, :, column]) for column in range(3))
    verdict: Literal["pass", "undecided", "fail"] = "undecided"
    reason = None
    if hours.upper <= limit.hours_a_year:
        if part_of_year is None:
            verdict = "pass"
        else:
            reason = ClimateCode.OF_A_PART(part=part_of_year)
    elif hours.lower > limit.hours_a_year:
        verdict = "fail"
    return Exceedance(
        **vars(limit), hours=hours, number=number, longest_h=longest, verdict=verdict, why=reason
    )
