"""The weather of a site in the making: the fields of a file, what they hold, and the series that they become;
and the move from the height of a station or grid cell to that of the site."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Series, Site
from hygrokf.data.signals import fitting_units, from_si, signal_named, to_si, unit_named
from hygrokf.data.timestamps import HOUR_S
from hygrokf.physics.psychrometrics import (
    GAS_CONSTANT_DRY_AIR,
    dew_point,
    saturation_pressure_water,
    vapour_pressure,
)

EARTH_RADIUS_KM = 6371.0
LOW_WIND_M = 50.0
"""[m] height up to which a wind is said not to be that at the hub."""
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
    "tenths": ("1", 0.1),
    "eighths": ("1", 0.125),
}
"""Units of weather files, in lower case and without blanks, * and ^: a name in `UNITS`, and how many of it.
Energies and rates are those of an hour."""


def unit_in_weather(text: str, signal: str) -> tuple[str, float] | None:
    """A unit that fits a signal, and how many of it a weather file's unit is; None where it does not fit."""
    unit, count = _FURTHER_UNITS.get(re.sub(r"[\s*^]", "", text).lower(), (unit_named(text), 1.0))
    return (unit, count) if unit is not None and unit in fitting_units(signal) else None


class Variable(NamedTuple):
    """What a field of a format holds.

    signal: that it is, or in whose unit it is read. unit: where the file states none. mean: whether it is the
    mean or the sum of the hour that ends at the stamp. part: whether signals are only derived from it.
    missing: code from which on nines mean that there is no value. names: other names of the field.
    """

    signal: str
    unit: str
    mean: bool = False
    part: bool = False
    missing: float = math.inf
    names: tuple[str, ...] = ()


class WeatherField(NamedTuple):
    """One field at one place: values (T,), its name in the file, and the unit that it states, or None."""

    value: np.ndarray
    name: str
    unit: str | None = None


def short_name(variables: Mapping[str, Variable], name: str) -> str | None:
    """The name among the variables of a format of a field, such as "t2m" for "2m_temperature"; None for one
    that is not used."""
    either = {name, name.lower()}
    return next((short for short, one in variables.items() if either & {short, *one.names}), None)


class SiteWeather:
    """Fields of one file at one place, and the series that are made of them.

    file: its name. time: [s] (T,) since 1970-01-01T00:00Z, in any order, repeats allowed. fields: by the name
    of their format. variables: name -> what it holds. site: the place, or None. near: the site of the
    cabinet, whose distance is told. height_m: [m] of the wind. shift_s: [s] from a stamp to the time that it
    stands for.
    """

    def __init__(
        self, file: str, time: np.ndarray, fields: Mapping[str, WeatherField],
        variables: Mapping[str, Variable], *,
        site: Site | None = None, near: Site | None = None, height_m: float | None = None,
        shift_s: float = 0.0, warnings: Iterable[str] = (),
    ) -> None:  # fmt: skip
        if not len(time):
            raise TableFault("has no hour in it: fetch it again")
        stamps, rows = np.unique(time, return_index=True)
        self.file, self.time, self.fields, self.variables = file, stamps + shift_s, fields, variables
        self.site, self.height_m = site, height_m
        self.place = "" if site is None else place_text(site.latitude_deg, site.longitude_deg, near)
        self.warnings, self.faults, self.series = list(warnings), list[str](), list[Series]()
        self.value: dict[str, np.ndarray] = {}  # [SI unit] (T,) by name
        self.repeated = len(time) - len(stamps)
        if self.repeated:
            self.warnings.append(f"{self.repeated} stamps occur more than once; the first of each kept")
        for name, one in fields.items():
            raw = np.asarray(one.value, dtype=float)[rows]
            if (endless := np.isinf(raw)).any():
                said = f"{int(endless.sum())} values are infinite, taken as missing"
                self.warnings.append(f"{one.name}: {said}")
            self.value[name] = self._converted(name, np.where(endless, np.nan, raw))

    def _converted(self, name: str, value: np.ndarray) -> np.ndarray:
        """Values (T,) of a field in the SI unit of its signal; NaN, and a fault, for an unknown unit."""
        variable, one = self.variables[name], self.fields[name]
        unit = variable.unit if one.unit is None else one.unit
        if (known := unit_in_weather(unit, variable.signal)) is not None:
            return to_si(known[1] * value, known[0], variable.signal)
        fitting = fitting_units(variable.signal)
        further = (text for text, (other, _) in _FURTHER_UNITS.items() if other in fitting)
        listed = ", ".join(dict.fromkeys((*fitting, *further)))
        self.faults.append(f'{one.name}: unknown unit "{unit}"; expected one of {listed}')
        return np.full(len(value), math.nan)

    def add(self, signal: str, value: np.ndarray, *names: str) -> None:
        """Add a series; or a warning where there is no value, or a fault where the values are impossible.

        value: (T,) [SI unit], NaN = missing. names: of the fields that it is made of.
        """
        known, row = value[np.isfinite(value)], signal_named(signal)
        fields, variables = [self.fields[name] for name in names], [self.variables[name] for name in names]
        named = " and ".join(one.name for one in fields)
        if not len(known):
            self.warnings.append(f"{named}: no value at this point, {signal} is left out")
            return
        low, high = np.quantile(known, [0.02, 0.98])
        if not (row.low <= low and high <= row.high):
            unit = "" if row.display == "1" else f" {row.display}"
            low, high = from_si(np.array([low, high]), row.display, row)
            stated = (
                f'the unit "{one.unit}"' if one.unit else f"no unit, so {variable.unit} was taken"
                for one, variable in zip(fields, variables, strict=True)
            )  # fmt: skip
            self.faults.append(
                f"{named}: {signal} would lie at {low:.4g} … {high:.4g}{unit}, which is impossible: the file "
                f"states {' and '.join(dict.fromkeys(stated))}; correct it, or fetch the file again if its "
                "columns are shifted"
            )
            return
        if row.dimension == "irradiance" or signal == "rain":
            value = np.maximum(value, 0.0)  # NaN stays NaN
        column = named if named.startswith("column ") else f'column "{named}"'
        source = f"{self.file}, {column}" + (f" at {self.place}" if self.place else "")
        interval_s = HOUR_S if variables[0].mean else 0.0
        height_m = self.height_m if signal.startswith("wind_") else None
        self.series.append(
            Series(signal, self.time, value, interval_s=interval_s, source=source, height_m=height_m)
        )

    def add_wind(self, winds: Sequence[tuple[float, str, str]]) -> None:
        """Add speed and direction of the first wind that the file holds: its height [m], and the names of the
        fields [m/s] in which it blows towards east and north."""
        for height_m, *pair in winds:
            if set(pair) <= set(self.value):
                east, north = (self.value[name] for name in pair)
                self.height_m = height_m
                self.add("wind_speed", np.hypot(east, north), *pair)
                # where the wind comes from, clockwise from north
                self.add("wind_direction", np.mod(np.arctan2(-east, -north), 2.0 * math.pi), *pair)
                return

    def record(self, sha256: str) -> Record:
        """The record, with the fields that are signals themselves where none is derived; sha256: of the file.
        Raises TableFault with every fault."""
        for name, (signal, _, _, part, *_) in self.variables.items():
            if name in self.value and not part and all(one.signal != signal for one in self.series):
                self.add(signal, self.value[name], name)
        if self.faults:
            raise TableFault(*self.faults)
        of = {one.signal: one for one in self.series}
        if {"ambient_temperature", "ambient_dew_point_temperature"} <= set(of):
            above = of["ambient_dew_point_temperature"].value - of["ambient_temperature"].value
            share = np.mean(above[np.isfinite(above)] > 0.5) if np.isfinite(above).any() else 0.0
            if share > 0.01:
                self.warnings.append(
                    f"the dew point lies above the temperature for {100 * share:.0f} % of the hours: are the "
                    "two swapped?"
                )
        if "wind_speed" in of and (self.height_m or math.inf) <= LOW_WIND_M:
            mean = "; speed of the hour's mean wind" * (of["wind_speed"].interval_s > 0.0)
            self.warnings.append(f"wind_speed is measured at {self.height_m:g} m, not at hub height{mean}")
        files = ((self.file, sha256),)
        return Record(self.file, tuple(self.series), self.site, warnings=tuple(self.warnings), files=files)


def complete(record: Record, no_temperature: str, ask: str) -> Record:
    """A record with a temperature; a warning, with what to ask for, where it has no humidity.

    Raises TableFault with `no_temperature`.
    """
    if "ambient_temperature" not in record:
        raise TableFault(no_temperature)
    if "ambient_dew_point_temperature" in record:
        return record
    lacking = f"no dew point: this weather has no humidity; ask for {ask}"
    return dataclasses.replace(record, warnings=(*record.warnings, lacking))


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


def at_altitude(record: Record, altitude_m: float, from_m: float, lapse_rate: float = LAPSE_RATE) -> Record:
    """A weather record moved to the height of the site.

    record: of ambient signals. altitude_m: [m] height of the site. from_m: [m] height of the record.
    lapse_rate: [K/m] decrease of temperature with height, -0.02 … 0.02.

    Temperature changes by the lapse rate, pressure by hydrostatic balance.  The mixing ratio ε e/(p − e) is
    kept, so that vapour pressure and pressure change by the same factor.  Where the cooled air would be
    supersaturated, the dew point is set to the temperature (the rest condensed on the way up); a warning says
    how often.  Sun, wind, cloud and rain do not change.  The lapse rate is a mean: that of single hours
    differs, in winter inversions even in sign.

    Raises ValueError for a lapse rate out of its range.
    """
    if not -0.02 <= lapse_rate <= 0.02:
        raise ValueError(f"lapse_rate must lie within -0.02 … 0.02 K/m, found {lapse_rate:g}")
    rise = altitude_m - from_m
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
        f"converted from {from_m:g} m to {altitude_m:g} m: {-1e3 * lapse_rate:+g} K/km, hydrostatic "
        "pressure, "
        "mixing ratio kept",
    )
    return dataclasses.replace(record, series=tuple(moved), site=site, warnings=(*record.warnings, *warnings))
