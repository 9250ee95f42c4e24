"""Convert the fields of a reanalysis at one point to series: names, units, means of sums, wind."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Site
from hygrokf.data.timestamps import DAY_S, HOUR_S, duration_text, modal_step
from hygrokf.weather.altitude import GRAVITY
from hygrokf.weather.site_weather import SiteWeather, converted, unit_in_weather

NO_HUMIDITY = (
    "no dew point (d2m, 2m_dewpoint_temperature): this weather has no humidity; ask for it in the request"
)


@dataclass(frozen=True)
class Field:
    """One field at one point: values (T,) and the unit that the file states, or None."""

    value: np.ndarray
    unit: str | None = None


@dataclass(frozen=True)
class PointFields:
    """Fields of a reanalysis at one point, as in the file.

    file: its name. time: [s] (T,) since 1970-01-01T00:00Z, in any order, repeats allowed. fields: name in the
        file -> field.
    latitude_deg, longitude_deg: of the point, or None. altitude_m: [m] height of its ground, or None.
    place: the point in words. warnings: choices and omissions of the reader.
    """

    file: str
    time: np.ndarray
    fields: Mapping[str, Field]
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    place: str = ""
    warnings: tuple[str, ...] = field(default=())

    @property
    def site(self) -> Site | None:
        """The point as a site; None where the file does not state it.  Raises TableFault."""
        if self.latitude_deg is None or self.longitude_deg is None:
            return None
        east = (self.longitude_deg + 180.0) % 360.0 - 180.0
        try:
            return Site(self.latitude_deg, east, self.altitude_m)
        except ValueError as outside:
            raise TableFault(f"the file's point is impossible: {outside}") from None


_IRRADIANCE = "global_horizontal_irradiance"
_FIELDS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "t2m": ("ambient_temperature", "K", ("2m_temperature", "2t", "t_2m", "VAR_2T")),
    "d2m": ("ambient_dew_point_temperature", "K", ("2m_dewpoint_temperature", "2d", "d_2m", "VAR_2D")),
    "sp": ("ambient_pressure", "Pa", ("surface_pressure", "surf_pres")),
    "u10": ("wind_speed", "m s**-1", ("u_10", "10m_u_component_of_wind", "10u", "VAR_10U")),
    "v10": ("wind_speed", "m s**-1", ("v_10", "10m_v_component_of_wind", "10v", "VAR_10V")),
    "u100": ("wind_speed", "m s**-1", ("u_100", "100m_u_component_of_wind", "100u", "VAR_100U")),
    "v100": ("wind_speed", "m s**-1", ("v_100", "100m_v_component_of_wind", "100v", "VAR_100V")),
    "ssrd": (_IRRADIANCE, "J m**-2", ("surface_solar_radiation_downwards",)),
    "fdir": (_IRRADIANCE, "J m**-2", ("total_sky_direct_solar_radiation_at_surface",)),
    "avg_sdswrf": (
        _IRRADIANCE, "W m**-2", ("msdwswrf", "mean_surface_downward_short_wave_radiation_flux"),
    ),
    "tp": ("rain", "m", ("total_precipitation",)),
    "tcc": ("cloud_cover", "1", ("total_cloud_cover",)),
    "z": ("", "m**2 s**-2", ("geopotential", "geopotential_at_surface")),
}  # fmt: skip
"""Short name of a field of ERA5 -> a signal in its unit, the unit where the file states none, other names."""
_ACCUMULATED = ("ssrd", "fdir", "tp")


def short_name(name: str) -> str | None:
    """Short name of a field of ERA5, such as "t2m" for "2m_temperature"; None for an unused field."""
    for short, (_, _, others) in _FIELDS.items():
        if {name, name.lower()} & {short, *others}:
            return short
    return None


def altitude_of(value: np.ndarray, unit: str | None) -> float | None:
    """Height of the reanalysis' ground [m] from its geopotential, or None."""
    finite = np.asarray(value, dtype=float).ravel()
    finite = finite[np.isfinite(finite)]
    known = {None: 1 / GRAVITY, "m**2 s**-2": 1 / GRAVITY, "m2 s-2": 1 / GRAVITY, "m": 1.0}
    height = known.get(unit, math.nan) * float(np.median(finite)) if len(finite) else math.nan
    return height if -500.0 <= height <= 9000.0 else None


def point_record(points: PointFields, sha256: str = "", *, temperature: bool = True) -> Record:
    """Record of the fields at a point: SI units, each series with the hold of its field.

    points: the fields. sha256: of the file. temperature: whether the fields must include a temperature.

    Temperature, dew point, pressure, wind and cloud are instants.  Radiation and rain are sums over the hour
    that ends at the stamp: radiation becomes the mean of that hour, J/m² / 3600 s, and both hold over it.
    Sums since midnight, as in ERA5-Land, are recognised and made hourly sums first.  Diffuse radiation is
    global minus direct radiation, both on a horizontal plane.  Wind at 100 m is preferred; wind at 10 m
    gives a warning.

    Raises TableFault with every fault: an unknown unit, values impossible in their unit, no temperature.
    """
    given = {short: (name, one) for name, one in points.fields.items() if (short := short_name(name))}
    if temperature and "t2m" not in given:
        raise TableFault(
            f"no 2 m temperature (t2m, 2m_temperature); found {', '.join(points.fields) or 'no field'}: "
            "ask for it in the request"
        )
    if not len(points.time):
        raise TableFault("has no hour in it: fetch it again")
    order = np.argsort(points.time, kind="stable")
    time = points.time[order]
    fresh = np.append(True, np.diff(time) > 0.0)
    weather = SiteWeather(points.file, time[fresh], points.place, warnings=list(points.warnings))
    if not fresh.all():
        weather.warnings.append(
            f"{int((~fresh).sum())} stamps occur more than once; the first of each kept"
        )
    value = _values(weather, given, order[fresh])
    _add_fields(weather, given, value)
    if temperature and "d2m" not in value:
        weather.warnings.append(NO_HUMIDITY)
    return weather.record(points.site, sha256)


def _values(
    weather: SiteWeather, given: Mapping[str, tuple[str, Field]], places: np.ndarray
) -> dict[str, np.ndarray]:
    """Values (T,) [SI unit] of each field at some rows of the file; sums are over one hour."""
    value: dict[str, np.ndarray] = {}
    for short, (name, one) in given.items():
        if short != "z":
            signal, own, _ = _FIELDS[short]
            raw = np.asarray(one.value, dtype=float)[places]
            endless = np.isinf(raw)
            if endless.any():
                weather.warnings.append(f"{name}: {int(endless.sum())} values are infinite, taken as missing")
            raw = np.where(endless, np.nan, raw)
            value[short] = converted(name, raw, own if one.unit is None else one.unit, signal, weather.faults)
            weather.faults += _power_for_energy(short, name, one.unit, weather.time, value[short])
    daily = {one: _since_midnight(weather.time, value[one]) for one in _ACCUMULATED if one in value}
    for short, told in daily.items():
        # a field that hardly ever changes is written as the others of its file
        if told or (told is None and True in daily.values()):
            name = given[short][0]
            step = modal_step(weather.time)[0]
            if step > HOUR_S:
                weather.faults.append(
                    f"{name}: sums since 00:00 UTC, every {duration_text(step)}; expected every hour, of "
                    "which means can be made: ask for all 24 hours of the day"
                )
            value[short] = _hourly_sums(weather.time, value[short])
            weather.warnings.append(f"{name}: sums since 00:00 UTC, turned into those of each hour")
    return value


def _add_fields(
    weather: SiteWeather, given: Mapping[str, tuple[str, Field]], value: Mapping[str, np.ndarray]
) -> None:
    """Add the series; radiation and rain belong to the hour before their stamp."""

    def named(*shorts: str) -> dict[str, Any]:
        stated = {one: given[one][1].unit for one in shorts}
        units = dict.fromkeys(
            f'the unit "{unit}"' if unit else f"no unit, so {_FIELDS[one][1]} was taken"
            for one, unit in stated.items()
        )
        remedy = f"the file states {' and '.join(units)}; correct it or fetch the file again"
        return {"names": " and ".join(given[one][0] for one in shorts), "remedy": remedy}

    for short in ("t2m", "d2m", "sp", "tcc"):
        if short in value:
            weather.add(_FIELDS[short][0], value[short], **named(short))
    sun = next((one for one in ("ssrd", "avg_sdswrf") if one in value), None)
    if sun is not None:
        weather.add(_IRRADIANCE, np.maximum(value[sun], 0.0), mean=True, **named(sun))  # NaN stays NaN
    if {"ssrd", "fdir"} <= set(value):
        diffuse = np.maximum(np.maximum(value["ssrd"], 0.0) - value["fdir"], 0.0)
        weather.add("diffuse_horizontal_irradiance", diffuse, mean=True, **named("ssrd", "fdir"))
    if "tp" in value:
        weather.add("rain", np.maximum(value["tp"], 0.0), mean=True, **named("tp"))
    height = next((one for one in ("100", "10") if {f"u{one}", f"v{one}"} <= set(value)), None)
    if height is not None:
        east, north = f"u{height}", f"v{height}"
        weather.add_wind(value[east], value[north], height_m=float(height), **named(east, north))
    if height == "10":
        weather.warnings.append(
            "wind_speed is measured at 10 m, not at hub height: the file has no u100 and v100"
        )


def _power_for_energy(
    short: str, name: str, unit: str | None, time: np.ndarray, value: np.ndarray
) -> list[str]:
    """The fault of radiation in W/m² that is taken for J/m² and becomes 3600 times too small."""
    signal, own, _ = _FIELDS[short]
    if signal != _IRRADIANCE or unit_in_weather(unit or own, signal) in (None, ("W/m2", 1.0)):
        return []
    known = value[np.isfinite(value)]
    highest = float(known.max()) if len(known) else 0.0
    # even under the clouds of a winter at 60 degrees some hour in three days has more than 1 W/m²
    if not 1e-3 < highest < 1.0 or time[-1] - time[0] < 3.0 * DAY_S:
        return []
    said = f'the file states "{unit}"' if unit else "it has no unit, so J/m² of an hour was taken"
    return [
        f"{name}: the radiation would reach {highest:.2g} W/m² only; {said}, and its numbers look like W/m²: "
        "correct the unit or multiply by 3600"
    ]


def _since_midnight(time: np.ndarray, value: np.ndarray) -> bool | None:
    """Whether an accumulated field is summed since 00:00 UTC; None where it hardly ever changes.

    time: [s] (T,) increasing. value: (T,).  Sums since 00:00 fall at the end of the day alone, and within it
    by no more than the noise of their packing (16 bits, whose step grows with the field's range); sums of
    single hours fall at every hour.  The squares of both falls, over the whole field, tell which it is.
    """
    steps = np.nan_to_num(np.diff(value))
    falls = np.square(np.minimum(steps, 0.0))
    at_end = np.diff(_day_of(time)) > 0.0
    if np.count_nonzero(steps**2 > 1e-3 * np.max(steps**2, initial=0.0)) < 6:
        return None
    return bool(np.sum(falls[~at_end]) < 0.01 * np.sum(falls[at_end]))


def _day_of(time: np.ndarray) -> np.ndarray:
    """Number of the day (T,) whose sum a stamp [s] belongs to: that at 00:00 is the last of the day before,
    that at 01:00 the first of the new one."""
    return np.ceil(np.round(time) / DAY_S)


def _hourly_sums(time: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Sums of each hour from sums since 00:00 UTC; NaN after a gap.

    A rise that a later sum of the day takes back is noise of the packing.
    """
    days = np.split(value, np.flatnonzero(np.diff(_day_of(time))) + 1)
    least = np.concatenate([np.fmin.accumulate(day[::-1])[::-1] for day in days])
    least[np.isnan(value)] = np.nan
    before = np.append(np.nan, least[:-1])
    before[np.append(True, np.round(np.diff(time)) != HOUR_S)] = np.nan
    return np.where(np.round(np.mod(time, DAY_S)) == HOUR_S, least, np.maximum(least - before, 0.0))
