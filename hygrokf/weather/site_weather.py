"""The weather at a site: the fields of a file and their meaning, the series made of them, and the conversion
from the height of a station or grid cell to that of the site."""

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
"""[m] wind at this height or below gives a warning, because it is not that at hub height."""
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
"""Unit of a weather file (in lower case, without blanks, * and ^) → the name of a unit in `UNITS`, and the
factor to that unit.  Energies and rates are those of an hour."""


def unit_in_weather(text: str, signal: str) -> tuple[str, float] | None:
    """Return the unit in `UNITS` for a weather file's unit, and the factor to it; None if the unit does not
    suit the signal."""
    unit, factor = _FURTHER_UNITS.get(re.sub(r"[\s*^]", "", text).lower(), (unit_named(text), 1.0))
    return (unit, factor) if unit is not None and unit in fitting_units(signal) else None


class Variable(NamedTuple):
    """The meaning of a field of a format.

    signal: of the field, or the signal in whose unit the field is. unit: if the file states none. mean:
        whether values are means or sums of the hour that ends at the stamp. part: whether the field is only
        used to derive signals. missing: numbers of nines from this one on are codes of missing values. names:
        other names of the field.
    """

    signal: str
    unit: str
    mean: bool = False
    part: bool = False
    missing: float = math.inf
    names: tuple[str, ...] = ()


class WeatherField(NamedTuple):
    """One field at one place: values (T,), name in the file, and the unit that the file states, or None."""

    value: np.ndarray
    name: str
    unit: str | None = None


def short_name(variables: Mapping[str, Variable], name: str) -> str | None:
    """Return the key in `variables` of a field's name, such as "t2m" for "2m_temperature"; None for an unused
    field."""
    spellings = {name, name.lower()}
    return next((key for key, variable in variables.items() if spellings & {key, *variable.names}), None)


class SiteWeather:
    """The fields of one file at one place, and the series made of them.

    file: its name. time: [s] (T,) since 1970-01-01T00:00Z, in any order; of repeated stamps the first one is
        kept. fields: by the short names of their format. variables: their meanings. site: the place, or None.
        near: site of the cabinet; sources state the distance from it. height_m: [m] of the wind. shift_s: [s]
        from a stamp to the time of its value.
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
        for name, field in fields.items():
            values = np.asarray(field.value, dtype=float)[rows]
            if (is_infinite := np.isinf(values)).any():
                message = f"{int(is_infinite.sum())} values are infinite, taken as missing"
                self.warnings.append(f"{field.name}: {message}")
            self.value[name] = self._to_si(name, np.where(is_infinite, np.nan, values))

    def _to_si(self, name: str, value: np.ndarray) -> np.ndarray:
        """The values (T,) of a field in the SI unit of its signal; NaN, and a fault, for an unknown unit."""
        variable, field = self.variables[name], self.fields[name]
        unit = variable.unit if field.unit is None else field.unit
        if (unit_and_factor := unit_in_weather(unit, variable.signal)) is not None:
            return to_si(unit_and_factor[1] * value, unit_and_factor[0], variable.signal)
        fitting = fitting_units(variable.signal)
        further_units = (
            file_unit for file_unit, (standard_unit, _) in _FURTHER_UNITS.items() if standard_unit in fitting
        )
        units_listed = ", ".join(dict.fromkeys((*fitting, *further_units)))
        self.faults.append(f'{field.name}: unknown unit "{unit}"; expected one of {units_listed}')
        return np.full(len(value), math.nan)

    def add(self, signal: str, value: np.ndarray, *names: str) -> None:
        """Add a series; a warning if it has no value, a fault if its values are impossible.

        value: (T,) [SI unit], NaN = missing. names: of the fields from which the series is made.
        """
        finite, signal_properties = value[np.isfinite(value)], signal_named(signal)
        fields, variables = [self.fields[name] for name in names], [self.variables[name] for name in names]
        field_names = " and ".join(field.name for field in fields)
        if not len(finite):
            self.warnings.append(f"{field_names}: no value at this point, {signal} is left out")
            return
        low, high = np.quantile(finite, [0.02, 0.98])
        if not (signal_properties.low <= low and high <= signal_properties.high):
            unit = "" if signal_properties.display == "1" else f" {signal_properties.display}"
            low, high = from_si(np.array([low, high]), signal_properties.display, signal_properties)
            stated = (
                f'the unit "{field.unit}"' if field.unit else f"no unit, so {variable.unit} was taken"
                for field, variable in zip(fields, variables, strict=True)
            )  # fmt: skip
            self.faults.append(
                f"{field_names}: {signal} would lie at {low:.4g} … {high:.4g}{unit}, which is impossible: "
                f"the file states {' and '.join(dict.fromkeys(stated))}; correct it, or fetch the file again "
                "if its columns are shifted"
            )
            return
        if signal_properties.dimension == "irradiance" or signal == "rain":
            value = np.maximum(value, 0.0)  # NaN stays NaN
        column = field_names if field_names.startswith("column ") else f'column "{field_names}"'
        source = f"{self.file}, {column}" + (f" at {self.place}" if self.place else "")
        interval_s = HOUR_S if variables[0].mean else 0.0
        height_m = self.height_m if signal.startswith("wind_") else None
        self.series.append(
            Series(signal, self.time, value, interval_s=interval_s, source=source, height_m=height_m)
        )

    def add_wind(self, winds: Sequence[tuple[float, str, str]]) -> None:
        """Add speed and direction of the first of `winds` that the file holds: (height [m], names of the
        fields [m/s] towards east and north)."""
        for height_m, *components in winds:
            if set(components) <= set(self.value):
                east, north = (self.value[name] for name in components)
                self.height_m = height_m
                self.add("wind_speed", np.hypot(east, north), *components)
                # where the wind comes from, clockwise from north
                self.add("wind_direction", np.mod(np.arctan2(-east, -north), 2.0 * math.pi), *components)
                return

    def record(self, sha256: str) -> Record:
        """Return the record of the added series, and of each field whose signal was not added. Raises
        TableFault with every fault.

        sha256: of the file.
        """
        for name, (signal, _, _, part, *_) in self.variables.items():
            if name in self.value and not part and all(series.signal != signal for series in self.series):
                self.add(signal, self.value[name], name)
        if self.faults:
            raise TableFault(*self.faults)
        by_signal = {series.signal: series for series in self.series}
        if {"ambient_temperature", "ambient_dew_point_temperature"} <= set(by_signal):
            excess = by_signal["ambient_dew_point_temperature"].value - by_signal["ambient_temperature"].value
            share = np.mean(excess[np.isfinite(excess)] > 0.5) if np.isfinite(excess).any() else 0.0
            if share > 0.01:
                self.warnings.append(
                    f"the dew point lies above the temperature for {100 * share:.0f} % of the hours: are the "
                    "two swapped?"
                )
        if "wind_speed" in by_signal and (self.height_m or math.inf) <= LOW_WIND_M:
            remark = "; speed of the hour's mean wind" * (by_signal["wind_speed"].interval_s > 0.0)
            self.warnings.append(f"wind_speed is measured at {self.height_m:g} m, not at hub height{remark}")
        files = ((self.file, sha256),)
        return Record(self.file, tuple(self.series), self.site, warnings=tuple(self.warnings), files=files)


def require_temperature(record: Record, no_temperature: str, fields_to_request: str) -> Record:
    """Return the record, with a warning that names the fields to request if it has no humidity.

    Raises TableFault with the message `no_temperature` if it has no temperature.
    """
    if "ambient_temperature" not in record:
        raise TableFault(no_temperature)
    if "ambient_dew_point_temperature" in record:
        return record
    warning = f"no dew point: this weather has no humidity; ask for {fields_to_request}"
    return dataclasses.replace(record, warnings=(*record.warnings, warning))


def dew_point_of(relative_humidity: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Return the dew point over water (T,) [K] from relative humidity [1] and temperature [K].

    A relative humidity of 0 has no dew point; one above 1 is a rounding error and counts as 1.
    """
    humidity = np.where(relative_humidity > 0.0, np.minimum(relative_humidity, 1.0), np.nan)
    return np.asarray(dew_point(vapour_pressure(humidity, temperature)))


# --- the place -------------------------------------------------------------------------------


def distance_km(latitude_deg: float, longitude_deg: float, site: Site) -> float:
    """Return the distance on the sphere [km] from a point [deg] to a site, by the haversine formula."""
    latitude, site_latitude = math.radians(latitude_deg), math.radians(site.latitude_deg)
    longitude_difference = math.radians(site.longitude_deg - longitude_deg)
    haversine = (
        math.sin(0.5 * (site_latitude - latitude)) ** 2
        + math.cos(latitude) * math.cos(site_latitude) * math.sin(0.5 * longitude_difference) ** 2
    )
    return 2.0 * EARTH_RADIUS_KM * math.asin(min(1.0, math.sqrt(haversine)))


def place_text(latitude_deg: float, longitude_deg: float, site: Site | None = None) -> str:
    """A point in words, with its distance from the site, if any: "48.50° N 5.50° E, 11 km from the site"."""
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
WARNED_FROM_M = 100.0
"""[m] a larger difference of height (0.65 K) gives a warning, unless the record is converted."""


def pressure_ratio(temperature: np.ndarray, rise_m: float, lapse_rate: float = LAPSE_RATE) -> np.ndarray:
    """Return the pressure of the air at one height over that at another, p(z + Δz)/p(z) [1].

    temperature: [K] of any shape, at the height z. rise_m: [m] Δz, may be negative. lapse_rate: [K/m] Γ,
        decrease of temperature with height.

    Hydrostatic balance of dry air dp/dz = −g p/(R_d T) with T(z + Δz) = T − Γ Δz: (1 − Γ Δz/T)^(g/(R_d Γ)),
    and exp(−g Δz/(R_d T)) for Γ = 0. Moisture changes it by less than 0.1 % over 500 m.
    """
    kelvin = np.asarray(temperature, dtype=float)
    if abs(lapse_rate) < 1e-9:
        return np.exp(-GRAVITY * rise_m / (GAS_CONSTANT_DRY_AIR * kelvin))
    return (1.0 - lapse_rate * rise_m / kelvin) ** (GRAVITY / (GAS_CONSTANT_DRY_AIR * lapse_rate))


def at_altitude(record: Record, altitude_m: float, from_m: float, lapse_rate: float = LAPSE_RATE) -> Record:
    """Move a weather record to the height of the site.

    record: of ambient signals. altitude_m: [m] height of the site. from_m: [m] height of the record.
    lapse_rate: [K/m] decrease of temperature with height, -0.02 … 0.02.

    Temperature changes by the lapse rate, pressure by hydrostatic balance. The mixing ratio ε e/(p − e) is
    kept, so that vapour pressure and pressure change by the same factor. If the cooled air would be
    supersaturated, the dew point is set to the temperature (the rest has condensed on the way up), and a
    warning says how often. Sun, wind, cloud and rain do not change. The lapse rate is a mean: that of single
    hours differs, in winter inversions even in sign.

    Raises ValueError for a lapse rate out of its range.
    """
    if not -0.02 <= lapse_rate <= 0.02:
        raise ValueError(f"lapse_rate must lie within -0.02 … 0.02 K/m, found {lapse_rate:g}")
    rise_m = altitude_m - from_m
    site = record.site and Site(record.site.latitude_deg, record.site.longitude_deg, altitude_m)
    converted, warnings = [], []
    for series in record.series:
        value = series.value
        if series.signal == "ambient_temperature":
            value = value - lapse_rate * rise_m
        elif series.signal in ("ambient_pressure", "ambient_dew_point_temperature"):
            known_temperature = record["ambient_temperature"].known
            air_temperature = (
                np.interp(series.time, *known_temperature)
                if len(known_temperature[0])
                else np.full(len(series), np.nan)
            )
            ratio = pressure_ratio(air_temperature, rise_m, lapse_rate)
        if series.signal == "ambient_pressure":
            value = value * ratio
        elif series.signal == "ambient_dew_point_temperature":
            vapour_pressure_there = saturation_pressure_water(value) * ratio
            # supersaturation in the source, by rounding or packing, does not count as condensation
            highest_dew_point = air_temperature - lapse_rate * rise_m + np.fmax(value - air_temperature, 0.0)
            is_condensed = dew_point(vapour_pressure_there) > highest_dew_point
            value = np.where(is_condensed, highest_dew_point, dew_point(vapour_pressure_there))
            if is_condensed.any():
                warnings.append(
                    f"during the conversion to {altitude_m:g} m the air became saturated in "
                    f"{100 * np.mean(is_condensed):.1f} % of the hours"
                )
        converted.append(dataclasses.replace(series, value=value))
    warnings.insert(
        0,
        f"converted from {from_m:g} m to {altitude_m:g} m: {-1e3 * lapse_rate:+g} K/km, hydrostatic "
        "pressure, mixing ratio kept",
    )
    return dataclasses.replace(
        record, series=tuple(converted), site=site, warnings=(*record.warnings, *warnings)
    )
