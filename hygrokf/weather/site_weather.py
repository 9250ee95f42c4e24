"""The weather of a site in the making: columns of its file as series in SI units, faults and warnings."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Series, Site
from hygrokf.data.signals import fitting_units, from_si, signal_named, to_si, unit_named
from hygrokf.data.timestamps import HOUR_S
from hygrokf.physics.psychrometrics import dew_point, vapour_pressure

EARTH_RADIUS_KM = 6371.0
_FURTHER_UNITS: dict[str, tuple[str, float]] = {
    **dict.fromkeys(("degree_celsius", "degrees_celsius"), ("degC", 1.0)),
    **dict.fromkeys(("m/s", "ms-1"), ("m/s", 1.0)),
    **dict.fromkeys(("km/h", "kmh-1"), ("m/s", 1 / 3.6)),
    **dict.fromkeys(("mph", "mp/h"), ("m/s", 0.44704)),
    "kn": ("m/s", 1852.0 / HOUR_S),
    **dict.fromkeys(("w/m2", "wm-2", "wh/m2", "whm-2"), ("W/m2", 1.0)),
    **dict.fromkeys(("j/m2", "jm-2"), ("W/m2", 1 / HOUR_S)),
    **dict.fromkeys(("kg/m2", "kgm-2"), ("mm", 1.0)),
    "kgm-2s-1": ("mm", HOUR_S),
    "m": ("mm", 1000.0),
    "inch": ("mm", 25.4),
    **dict.fromkeys(("(0-1)", "dimensionless"), ("1", 1.0)),
}
"""Units of weather files, in lower case and without blanks, * and ^: a name in `UNITS`, and how many of it.
Energies and rates are those of an hour."""


def unit_in_weather(text: str, signal: str) -> tuple[str, float] | None:
    """A unit that fits a signal, and how many of it a weather file's unit is; None where it does not fit."""
    unit, count = _FURTHER_UNITS.get(re.sub(r"[\s*^]", "", text).lower(), (unit_named(text), 1.0))
    return (unit, count) if unit is not None and unit in fitting_units(signal) else None


def converted(name: str, value: np.ndarray, unit: str, signal: str, faults: list[str]) -> np.ndarray:
    """Values (T,) of a column in the SI unit of a signal; NaN, and a fault, for an unknown unit."""
    known = unit_in_weather(unit, signal)
    if known is not None:
        return to_si(known[1] * value, known[0], signal)
    fitting = fitting_units(signal)
    further = (one for one, (other, _) in _FURTHER_UNITS.items() if other in fitting)
    listed = ", ".join(dict.fromkeys((*fitting, *further)))
    faults.append(f'{name}: unknown unit "{unit}"; expected one of {listed}')
    return np.full(len(value), math.nan)


@dataclass
class SiteWeather:
    """Series of one file at one place, in the making.

    file: its name. time: [s] (T,). place: in words, or "". remedy: what to do about impossible values.
    """

    file: str
    time: np.ndarray
    place: str = ""
    remedy: str = "fetch the file again"
    faults: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    series: list[Series] = field(default_factory=list)

    def add(
        self,
        signal: str,
        value: np.ndarray,
        names: str,
        *,
        mean: bool = False,
        height_m: float | None = None,
        remedy: str = "",
    ) -> None:
        """Add a series; or a warning where there is no value, or a fault where the values are impossible.

        value: (T,) [SI unit], NaN = missing. names: of its columns, in messages. mean: whether it is the mean
            or the sum of the hour that ends at the stamp.
        """
        known, row = value[np.isfinite(value)], signal_named(signal)
        if not len(known):
            self.warnings.append(f"{names}: no value at this point, {signal} is left out")
            return
        low, high = np.quantile(known, [0.02, 0.98])
        if not (row.low <= low and high <= row.high):
            unit = "" if row.display == "1" else f" {row.display}"
            low, high = from_si(np.array([low, high]), row.display, row)
            beyond = f"{signal} would lie at {low:.4g} … {high:.4g}{unit}, which is impossible"
            self.faults.append(f"{names}: {beyond}: {remedy or self.remedy}")
        else:
            column = names if names.startswith("column ") else f'column "{names}"'
            source = f"{self.file}, {column}" + (f" at {self.place}" if self.place else "")
            interval_s = HOUR_S if mean else 0.0
            self.series.append(
                Series(signal, self.time, value, interval_s=interval_s, source=source, height_m=height_m)
            )

    def add_wind(self, east: np.ndarray, north: np.ndarray, names: str, **stated: Any) -> None:
        """Add speed and direction of a wind [m/s] (T,) that blows towards east and north; stated: as for
        `add`."""
        # where the wind comes from, clockwise from north
        direction = np.mod(np.arctan2(-east, -north), 2.0 * math.pi)
        for signal, value in (("wind_speed", np.hypot(east, north)), ("wind_direction", direction)):
            self.add(signal, value, names, **stated)

    def record(self, site: Site | None, sha256: str, lacking: str = "") -> Record:
        """The record.  Raises TableFault with every fault.

        site: of the weather. sha256: of the file. lacking: the fault of a file without temperature.
        """
        of = {one.signal: one.value for one in self.series}
        if lacking and not self.faults and "ambient_temperature" not in of:
            self.faults.append(lacking)
        if self.faults:
            raise TableFault(*self.faults)
        if {"ambient_temperature", "ambient_dew_point_temperature"} <= set(of):
            above = of["ambient_dew_point_temperature"] - of["ambient_temperature"]
            share = np.mean(above[np.isfinite(above)] > 0.5) if np.isfinite(above).any() else 0.0
            if share > 0.01:
                self.warnings.append(
                    f"the dew point lies above the temperature for {100 * share:.0f} % of the hours: are the "
                    "two swapped?"
                )
        origin = ((self.file, sha256),)
        return Record(self.file, tuple(self.series), site, warnings=tuple(self.warnings), provenance=origin)


def dew_point_of(share: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Dew point over water (T,) [K] from relative humidity [1] and temperature [K].

    A relative humidity of 0 has none, and one above 1 is a rounding of it.
    """
    known = np.where(share > 0.0, np.minimum(share, 1.0), np.nan)
    return np.asarray(dew_point(vapour_pressure(known, temperature)))


# --- the place -------------------------------------------------------------------------------


def distance_km(latitude_deg: float, longitude_deg: float, site: Site) -> float:
    """Distance on the sphere from a point [deg] to a site [km], by the haversine formula."""
    one, other = math.radians(latitude_deg), math.radians(site.latitude_deg)
    across = math.radians(site.longitude_deg - longitude_deg)
    half = math.sin(0.5 * (other - one)) ** 2 + math.cos(one) * math.cos(other) * math.sin(0.5 * across) ** 2
    return 2.0 * EARTH_RADIUS_KM * math.asin(min(1.0, math.sqrt(half)))


def place_text(latitude_deg: float, longitude_deg: float, site: Site | None = None) -> str:
    """A point in words with its distance from the site, if any: "48.50° N 5.50° E, 11 km from the site"."""
    east = (longitude_deg + 180.0) % 360.0 - 180.0
    text = (
        f"{abs(latitude_deg):.2f}° {'N' if latitude_deg >= 0 else 'S'} {abs(east):.2f}° "
        f"{'E' if east >= 0 else 'W'}"
    )
    if site is None:
        return text
    return f"{text}, {distance_km(latitude_deg, east, site):.0f} km from the site"
