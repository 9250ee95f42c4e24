"""How quantities are told: the words, unit and axes of each, its numbers with their bounds, and who computed
them.

Pages, texts, tables and figures take these from here, so that a quantity reads alike on all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from hygrokf.data.record import Site
from hygrokf.identification.fit_results import ParameterRow
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.texts.parts import BOTH_PARTS
from hygrokf.texts.wording import (
    MOST_DECIMALS,
    NONE,
    QUANTITY_NAMES,
    decimals_for,
    fixed,
    minus,
    percent,
    plain_number,
)
from hygrokf.version import __version__


@dataclass(frozen=True)
class QuantityTerms:
    """A scored quantity: its `name` in results, its `words`, the `unit` of its errors, and the unit and the
    `zero` [unit] of its levels."""

    name: str
    words: str
    unit: str
    level_unit: str = ""
    zero: float = 0.0

    @property
    def title(self) -> str:
        """The words with a capital letter."""
        return capital(self.words)

    @property
    def level(self) -> str:
        """The label of its levels: "temperature [°C]"."""
        return f"{self.words} [{self.level_unit or self.unit}]"

    @property
    def change(self) -> str:
        """The label of its errors and differences beside those of another quantity: "temperature [K]"."""
        return f"{self.words} [{self.unit}]"

    @property
    def error(self) -> str:
        """The label of its errors: "error [K]"."""
        return f"error [{self.unit}]"

    @property
    def excess(self) -> str:
        """The label of its errors, the sign as in all statements: above zero the simulation is too high."""
        return f"simulation − reading [{self.unit}]"

    @property
    def rmse(self) -> str:
        """The label of its root mean squared errors."""
        return f"RMSE of the {self.words} [{self.unit}]"

    def with_unit(self, value: float) -> str:
        """An error with its unit: "0.52 K"."""
        return f"{fixed(value)} {self.unit}"


LEVEL_UNITS = {"temperature_K": ("°C", ZERO_CELSIUS_K)}
"""Unit and zero of levels, where they are not those of the errors."""
NAMED_QUANTITY = {
    name: part.scored for part in BOTH_PARTS for name in (part.output, part.balance, part.series)
}
"""Quantity of series, of residuals or of a search → scored quantity."""
COLDEST_K = 150.0
"""[K] above it a parameter is a temperature, below it a difference."""


def quantity(name: str) -> QuantityTerms:
    """The quantity of a name; of an unknown name its words alone."""
    scored = NAMED_QUANTITY.get(name, name)
    if scored not in QUANTITY_NAMES:
        return QuantityTerms("", spoken(name) or "error", "")
    return QuantityTerms(scored, *QUANTITY_NAMES[scored], *LEVEL_UNITS.get(scored, ()))


# --- words -----------------------------------------------------------------------------------


def spoken(name: str) -> str:
    """An identifier as it is read: "moisture_sorption" -> "moisture sorption"."""
    return name.replace("_", " ").strip()


def capital(text: str) -> str:
    """A text with a capital letter."""
    return text[:1].upper() + text[1:]


def unit(text: str) -> str:
    """A unit as it is printed."""
    for plain, printed in (("g/m3", "g/m³"), ("kg/m3", "kg/m³"), ("m2", "m²"), ("/h^0.5", "/√h")):
        text = text.replace(plain, printed)
    return text


def place(site: Site, number: Callable[[float], str] = "{:.2f}".format) -> tuple[str, str]:
    """Latitude and longitude: ("52.40° N", "0.95° W")."""
    north, east = site.latitude_deg, site.longitude_deg
    latitude = f"{number(abs(north))}° {'N' if north >= 0 else 'S'}"
    return latitude, f"{number(abs(east))}° {'E' if east >= 0 else 'W'}"


def versions(version: str, when: str = "") -> str:
    """The version that computed a result, maybe when, and the one that wrote the page."""
    on = f" on {when} UTC" if when else ""
    return f"hygrokf {version or '(version not stated)'}{on}; page by hygrokf {__version__}"


# --- numbers ---------------------------------------------------------------------------------


def interval(low: float, high: float, text: Callable[[float], str] = fixed, symbol: str = "") -> str:
    """Two bounds, each as `text` writes it: "0.48 … 0.56 K"; "–" where neither is known."""
    if not (math.isfinite(low) or math.isfinite(high)):
        return NONE
    return f"{text(low)} … {text(high)}{f' {symbol}' if symbol else ''}"


def share_text(share: float) -> str:
    """A share [1] that may be negative, in whole per cent."""
    return percent(0.0) if abs(share) < 0.005 else minus(percent(share))


def signed_percent(share: float) -> str:
    """A change [1] in per cent with its sign."""
    sign = "+" if share >= 0.0005 else "−" if share <= -0.0005 else "±"
    return sign + percent(abs(share), 1 if abs(share) < 0.095 else 0)


def parameter_cells(row: ParameterRow) -> tuple[str, str, str]:
    """(value, bounds, unit) of a parameter with the digits that its standard error justifies, or its bounds
    where it has none; temperatures in °C."""
    value, low, high, symbol = row.value, row.lower, row.upper, unit(row.unit)
    if row.unit == "K" and value > COLDEST_K:
        value, low, high, symbol = *(v - ZERO_CELSIUS_K for v in (value, low, high)), "°C"
    spread = row.se if row.se > 0.0 else 0.5 * (high - low)
    decimals = decimals_for(0.5 * spread) if 0.0 < spread < math.inf else MOST_DECIMALS
    text: Callable[[float], str] = plain_number
    if decimals < MOST_DECIMALS:
        text = partial(fixed, decimals=decimals)
    return text(value), interval(low, high, lambda v: text(v) if math.isfinite(v) else "open"), symbol
