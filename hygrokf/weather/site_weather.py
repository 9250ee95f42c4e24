"""The weather of a site in the making: columns of its file as series in SI units, faults and warnings; hours
of a typical year in one calendar year; and the move from the height of a station or grid cell to that of the
site."""

from __future__ import annotations

import calendar
import dataclasses
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Series, Site
from hygrokf.data.signals import fitting_units, from_si, signal_named, to_si, unit_named
from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.physics.psychrometrics import (
    GAS_CONSTANT_DRY_AIR,
    dew_point,
    saturation_pressure_water,
    vapour_pressure,
)

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
    **dict.fromkeys(("(0-1)", "dimensionless", "kg/kg", "kgkg-1"), ("1", 1.0)),
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


WIND_HEIGHT_M = 10.0
"""[m] height of the wind in files of typical years."""
SHIFTED = "the columns are shifted, or in other units"
"""What impossible values mean in files of typical years."""
WIND_WARNING = "wind_speed is measured at 10 m, not at hub height"


def placed_in_years(
    stamps: np.ndarray, columns: Mapping[str, np.ndarray], year: int, years: int, own: str
) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    """Hours moved to each of several calendar years: their stamps, their columns, and warnings.

    stamps: (T, 4) year, month, day, hour 1…24 as written. columns: of numbers (T,). year: the first one,
    1900 … 2200. years: how many. own: the years of the file in words, "" where it is that year.

    29 February is a repetition of the 28th where a year needs it and the file has none; it is left out
    where the year has none.  Raises TableFault for a year out of range.
    """
    last = year + years - 1
    if not 1900 <= year <= last <= 2200:
        raise TableFault(f"year must lie within 1900 … 2200, found {year if last > 2200 >= year else last}")
    months, days = stamps[:, 1], stamps[:, 2]
    leap_day = (months == 2) & (days == 29)
    before = np.flatnonzero((months == 2) & (days == 28))
    rows, placed, repeated, said = [], [], [], []
    for one in range(year, last + 1):
        keep, day = np.arange(len(days)), days
        if calendar.isleap(one) and not leap_day.any() and len(before) == 24:
            keep, day = np.insert(keep, before[-1] + 1, before), np.insert(day, before[-1] + 1, 24 * [29])
            repeated.append(str(one))
        elif not calendar.isleap(one) and leap_day.any():
            keep, day = keep[~leap_day], day[~leap_day]
            said.append(f"{one} is not a leap year: 29 February is left out")
        rows.append(keep)
        placed.append(np.column_stack([np.full(len(day), one), months[keep], day, stamps[keep, 3]]))
    if own:
        span = f"{year}" if years == 1 else f"{year} … {last}"
        said.append(f"hours of {own} stand in {span}: a typical year, not the weather of {span}")
    if repeated:
        leap = "is a leap year" if len(repeated) == 1 else "are leap years"
        said.insert(0, f"{', '.join(repeated)} {leap}: 28 February is repeated as 29 February")
    kept = np.concatenate(rows)
    return np.concatenate(placed), {name: one[kept] for name, one in columns.items()}, said


def local_seconds(stamps: np.ndarray) -> np.ndarray:
    """Ends of hours (T, 4) as seconds since 1970-01-01T00:00 of the local clock (T,) [s]."""
    months = (stamps[:, 0] - 1970) * 12 + stamps[:, 1] - 1
    days = months.astype("datetime64[M]").astype("datetime64[D]").astype(int) + stamps[:, 2] - 1
    return days * DAY_S + stamps[:, 3] * HOUR_S


def hours_table(
    lines: Sequence[tuple[int, Sequence[str]]],
    width: int,
    used: Sequence[int],
    date: Callable[[np.ndarray], Iterable[float]],
    faults: list[str],
    exact: bool = False,
) -> np.ndarray:
    """The hours (T, columns) of lines, NaN where a cell is empty; the faults of the first lines are added.

    lines: number and cells. width: of a line at least, or with `exact` of every line.
    used: columns of numbers. date: year, month, day and hour 1 … 24 of a row.
    """
    table = np.full((len(lines), max([width, *(len(cells) for _, cells in lines)])), np.nan)
    wrong = []
    for row, (number, cells) in zip(table, lines, strict=True):
        try:
            if len(cells) < width or (exact and len(cells) > width):
                raise ValueError(f"expected {'' if exact else 'at least '}{width} cells, found {len(cells)}")
            for column in used:
                if column < len(cells) and cells[column].strip():
                    row[column] = float(cells[column])
                    if not np.isfinite(row[column]):
                        raise ValueError(f"cell {column + 1}: expected a number, found {cells[column]}")
            year, month, day, hour = (int(one) for one in date(row))
            if not 1 <= hour <= 24:
                raise ValueError(f"expected an hour 1 … 24, found {hour}")
            if not (1 <= month <= 12 and 1 <= day <= 31 and 1800 <= year <= 2300):
                raise ValueError(f"expected a date, found {year}, {month}, {day}")
            if day > (29 if month == 2 else calendar.monthrange(year, month)[1]):
                raise ValueError(f"month {month} has no day {day}")
        except ValueError as reason:
            wrong.append(f"line {number}: {reason}")
    more = f" (and {len(wrong) - 3} more lines)" if len(wrong) > 3 else ""
    faults += [*wrong[:2], *(one + more for one in wrong[2:3])]
    return table


GRAVITY = 9.80665
"""[m/s²] standard acceleration of free fall; reanalyses use it for geopotential too."""
LAPSE_RATE = 0.0065
"""[K/m] decrease of temperature with height in the standard atmosphere (ICAO)."""
SAID_FROM_M = 100.0
"""[m] difference of height from which an uncorrected record has a warning: 0.65 K."""


def pressure_ratio(temperature: np.ndarray, rise_m: float, lapse_rate: float = LAPSE_RATE) -> np.ndarray:
    """Pressure of the air at a height over that at another, p(z + Δz)/p(z) [-].

    temperature: [K] any shape, at the lower of the two heights z. rise_m: [m] Δz, may be negative.
    lapse_rate: [K/m] Γ, decrease of temperature with height.

    Hydrostatic balance of dry air dp/dz = −g p/(R_d T) with T(z + Δz) = T − Γ Δz:
    (1 − Γ Δz/T)^(g/(R_d Γ)), and exp(−g Δz/(R_d T)) for Γ = 0.  Moisture changes it by less than 0.1 % over
    500 m.
    """
    kelvin = np.asarray(temperature, dtype=float)
    if abs(lapse_rate) < 1e-9:
        return np.exp(-GRAVITY * rise_m / (GAS_CONSTANT_DRY_AIR * kelvin))
    return (1.0 - lapse_rate * rise_m / kelvin) ** (GRAVITY / (GAS_CONSTANT_DRY_AIR * lapse_rate))


def at_altitude(
    record: Record, altitude_m: float, from_m: float | None = None, lapse_rate: float = LAPSE_RATE
) -> Record:
    """A weather record moved to the height of the site.

    record: of ambient signals. altitude_m: [m] height of the site. from_m: [m] height of the record; None:
        that of its site.
    lapse_rate: [K/m] decrease of temperature with height, -0.02 … 0.02.

    Temperature changes by the lapse rate, pressure by hydrostatic balance.  The mixing ratio ε e/(p − e) is
    kept, so that vapour pressure and pressure change by the same factor.  Where the cooled air would be
    supersaturated, the dew point is set to the temperature (the rest condensed on the way up); a warning says
    how often.  Sun, wind, cloud and rain do not change.  The lapse rate is a mean: that of single hours
    differs, in winter inversions even in sign.

    Raises ValueError where the record's height is not known, or a number is out of its range.
    """
    station_m = from_m
    if station_m is None and record.site is not None:
        station_m = record.site.altitude_m
    if station_m is None:
        raise ValueError(f"{record.name}: the height of this weather is not known; state it")
    if not -0.02 <= lapse_rate <= 0.02:
        raise ValueError(f"lapse_rate must lie within -0.02 … 0.02 K/m, found {lapse_rate:g}")
    rise = altitude_m - station_m
    site = record.site and Site(record.site.latitude_deg, record.site.longitude_deg, altitude_m)
    moved, warnings = [], []
    for one in record.series:
        value = one.value
        if one.signal == "ambient_temperature":
            value = value - lapse_rate * rise
        elif one.signal in ("ambient_pressure", "ambient_dew_point_temperature"):
            known = record["ambient_temperature"].known
            before = np.interp(one.time, *known) if len(known[0]) else np.full(len(one), np.nan)
            ratio = pressure_ratio(before, rise, lapse_rate)
        if one.signal == "ambient_pressure":
            value = value * ratio
        elif one.signal == "ambient_dew_point_temperature":
            vapour = saturation_pressure_water(value) * ratio
            # supersaturation in the source, by rounding or packing, is no condensation on the way
            limit = before - lapse_rate * rise + np.fmax(value - before, 0.0)
            condensed = dew_point(vapour) > limit
            value = np.where(condensed, limit, dew_point(vapour))
            if condensed.any():
                warnings.append(
                    f"during the conversion to {altitude_m:g} m the air became saturated in "
                    f"{100 * np.mean(condensed):.1f} % of the hours"
                )
        moved.append(dataclasses.replace(one, value=value))
    warnings.insert(
        0,
        f"converted from {station_m:g} m to {altitude_m:g} m: {-1e3 * lapse_rate:+g} K/km, hydrostatic "
        "pressure, "
        "mixing ratio kept",
    )
    return dataclasses.replace(record, series=tuple(moved), site=site, warnings=(*record.warnings, *warnings))
