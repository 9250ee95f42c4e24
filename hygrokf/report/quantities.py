"""How quantities are written on pages, in tables and in figures: names, units, labels of axes, and values
with bounds."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from hygrokf.data.record import Site
from hygrokf.identification.fit_results import ParameterRow
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
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
    """The texts of a scored quantity: `name` in results, `words`, `unit` of errors; and of levels the unit
    and the `zero` that is subtracted [unit]."""

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
    "temperature": "temperature_K",
    "humidity": "absolute_humidity_g_m3",
    "vapour": "absolute_humidity_g_m3",
    "absolute_humidity": "absolute_humidity_g_m3",
}
"""Name of a quantity in series, residuals or a discovery → name of the scored quantity."""
COLDEST_K = 150.0
"""[K] a parameter in kelvin above this value is a temperature, below it a difference of temperatures."""


def quantity(name: str) -> QuantityTerms:
    """Return the texts of a quantity; for an unknown name, the name in words without a unit."""
    scored = NAMED_QUANTITY.get(name, name)
    if scored not in QUANTITY_NAMES:
        return QuantityTerms("", spoken(name) or "error", "")
    return QuantityTerms(scored, *QUANTITY_NAMES[scored], *LEVEL_UNITS.get(scored, ()))


# --- words -----------------------------------------------------------------------------------


def spoken(name: str) -> str:
    """Return an identifier in words: "moisture_sorption" → "moisture sorption"."""
    return name.replace("_", " ").strip()


def capital(text: str) -> str:
    """Return a text with a capital first letter."""
    return text[:1].upper() + text[1:]


def unit(text: str) -> str:
    """Return a unit as it is printed: "g/m3" → "g/m³"."""
    for ascii_unit, printed in (("g/m3", "g/m³"), ("kg/m3", "kg/m³"), ("m2", "m²"), ("/h^0.5", "/√h")):
        text = text.replace(ascii_unit, printed)
    return text


def place(site: Site, number: Callable[[float], str] = "{:.2f}".format) -> tuple[str, str]:
    """Return latitude and longitude as texts: ("52.40° N", "0.95° W")."""
    north, east = site.latitude_deg, site.longitude_deg
    latitude = f"{number(abs(north))}° {'N' if north >= 0 else 'S'}"
    return latitude, f"{number(abs(east))}° {'E' if east >= 0 else 'W'}"


def versions(version: str, when: str = "") -> str:
    """The version that computed a result (and the time, if given), and the version that wrote the page."""
    date_text = f" on {when} UTC" if when else ""
    return f"hygrokf {version or '(version not stated)'}{date_text}; page by hygrokf {__version__}"


# --- numbers ---------------------------------------------------------------------------------


def interval(low: float, high: float, text: Callable[[float], str] = fixed, symbol: str = "") -> str:
    """Return two bounds as text, each written by `text`: "0.48 … 0.56 K"; "–" where neither is finite."""
    if not (math.isfinite(low) or math.isfinite(high)):
        return NONE
    return f"{text(low)} … {text(high)}{f' {symbol}' if symbol else ''}"


def share_text(share: float) -> str:
    """Return a share [1], which may be negative, in whole per cent."""
    return percent(0.0) if abs(share) < 0.005 else minus(percent(share))


def signed_percent(share: float) -> str:
    """Return a relative change [1] in per cent with its sign."""
    sign = "+" if share >= 0.0005 else "−" if share <= -0.0005 else "±"
    return sign + percent(abs(share), 1 if abs(share) < 0.095 else 0)


def parameter_cells(row: ParameterRow) -> tuple[str, str, str]:
    """Return value, bounds and unit of a parameter as texts, with the decimals that its standard error (or,
    without one, its bounds) justifies; temperatures in °C."""
    value, low, high, symbol = row.value, row.lower, row.upper, unit(row.unit)
    if row.unit == "K" and value > COLDEST_K:
        value, low, high, symbol = *(kelvin - ZERO_CELSIUS_K for kelvin in (value, low, high)), "°C"
    half_width = row.se if row.se > 0.0 else 0.5 * (high - low)
    decimals = decimals_for(0.5 * half_width) if 0.0 < half_width < math.inf else MOST_DECIMALS
    text: Callable[[float], str] = plain_number
    if decimals < MOST_DECIMALS:
        text = partial(fixed, decimals=decimals)
    bounds = interval(low, high, lambda bound: text(bound) if math.isfinite(bound) else "open")
    return text(value), bounds, symbol
