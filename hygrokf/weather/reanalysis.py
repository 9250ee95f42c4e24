"""Read reanalyses. MERRA-2 of NASA: hourly means of tavg1_2d_slv_Nx (M2T1NXSLV) and its sisters. ERA5 as the
Climate Data Store delivers it: NetCDF in either layout, ZIP, CSV of the point product."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hygrokf.data.columns import Notation, TableFault
from hygrokf.data.record import Record, Site
from hygrokf.data.table_readers import table_in
from hygrokf.data.timestamps import DAY_S, HOUR_S, MINUTE_S, duration_text, modal_step, stamp_text
from hygrokf.physics.psychrometrics import dew_point, vapour_pressure_from_specific_humidity
from hygrokf.weather.archive import FORMATS_OF_KINDS, Content, contents, read_each
from hygrokf.weather.gridded import Field, PointFields, open_dataset, point_fields
from hygrokf.weather.joining import joined
from hygrokf.weather.site_weather import SiteWeather, converted, place_text, unit_in_weather

_MERRA2_FIELDS = {
    # field: a signal in its unit, the unit where the file states none
    "T2M": ("ambient_temperature", "K"), "T2MDEW": ("ambient_dew_point_temperature", "K"),
    "PS": ("ambient_pressure", "Pa"), "SWGDN": ("global_horizontal_irradiance", "W/m2"),
    "CLDTOT": ("cloud_cover", "1"), **dict.fromkeys(("PRECTOTCORR", "PRECTOT"), ("rain", "kg m-2 s-1")),
    **dict.fromkeys(("U50M", "V50M", "U10M", "V10M", "U2M", "V2M"), ("wind_speed", "m/s")),
    "QV2M": ("cloud_cover", "kg kg-1"),  # a fraction, as that of the mass is
}  # fmt: skip
"""Fields of MERRA-2 that are used: single levels, radiation, precipitation."""
_SHORT_NAMES = {"PHIS": "z", **{name: name for name in _MERRA2_FIELDS}}
"""Used fields; the geopotential of the ground is one of the constant fields const_2d_asm_Nx [m²/s²]."""
WIND_HEIGHTS_M = (50, 10, 2)
"""[m] heights of the wind, the preferred one first."""


def read_merra2(path: str | os.PathLike[str], site: Site | None = None) -> Record:
    """Record of ambient signals from a file of MERRA-2, in SI units and UTC.

    path: NetCDF-4 as delivered (a day each), a subset of it as NetCDF-4 or NetCDF-3, or a ZIP archive of
        these. site: the nearest cell of a grid is used; may be None for a file of one point.

    All fields are means over an hour whose middle is the stamp (00:30, 01:30, …): every series holds over
    the hour that ends half an hour after its stamp.  Humidity is the specific humidity QV2M, vapour mass per
    mass of moist air, at the pressure PS: e = q p / (ε + (1 − ε) q), and the dew point is that over water; a
    file without them gives T2MDEW.

    Raises TableFault with every fault and, for an archive, its member.
    """
    file = Path(path)
    found, digest = contents(file)
    records = read_each(found, lambda one: _merra2_record(one, file.name, site, digest))
    if not any("ambient_temperature" in one for one in records):
        raise TableFault("no temperature T2M in any of its files: ask for the collection M2T1NXSLV")
    return joined(records, file.name)


def _merra2_record(one: Content, file: str, site: Site | None, digest: str) -> Record:
    """The record of one file."""
    if not one.kind.startswith("netcdf"):
        raise TableFault(f"expected NetCDF of MERRA-2, found {one.kind}")
    points = point_fields(open_dataset(one.data, one.kind), file, _SHORT_NAMES.get, site)
    # a stamp is the middle of its hour; a record has ends
    weather, value = _weather_of(points, _MERRA2_FIELDS, 30.0 * MINUTE_S)
    if len(weather.time) < len(points.time):
        merged = "stamps occur more than once: the files of two days or versions were merged wrongly"
        weather.faults.append(merged)
    off = np.abs(np.mod(points.time, HOUR_S) - 30.0 * MINUTE_S) > 1.0
    if off.any():
        weather.faults.append(
            f"{int(off.sum())} of {len(off)} stamps are not half past the hour; expected hourly means "
            "(tavg1_…), not instants (inst…) or means over three hours: ask for M2T1NXSLV"
        )
    _add_merra2_fields(weather, value)
    return weather.record(points.site, digest)


def _weather_of(
    points: PointFields, fields: Mapping[str, tuple[str, str]], shift_s: float = 0.0
) -> tuple[SiteWeather, dict[str, np.ndarray]]:
    """The weather of the fields at a point, to be filled, and their values [SI unit] (T,) by short name.

    fields: short name -> a signal in its unit, the unit where the file states none. shift_s: [s] from a stamp
    to the end of its hour.  Raises TableFault where there is no hour.
    """
    if not len(points.time):
        raise TableFault("has no hour in it: fetch it again")
    time, rows = np.unique(points.time, return_index=True)
    weather = SiteWeather(points.file, time + shift_s, points.place, warnings=list(points.warnings))
    if repeated := len(points.time) - len(time):
        weather.warnings.append(f"{repeated} stamps occur more than once; the first of each kept")
    value: dict[str, np.ndarray] = {}
    for short, one in points.fields.items():
        signal, own = fields[short]
        raw = np.asarray(one.value, dtype=float)[rows]
        if (endless := np.isinf(raw)).any():
            weather.warnings.append(f"{one.name}: {int(endless.sum())} values are infinite, taken as missing")
        raw = np.where(endless, np.nan, raw)
        value[short] = converted(one.name, raw, own if one.unit is None else one.unit, signal, weather.faults)
    return weather, value


def _add_merra2_fields(weather: SiteWeather, value: Mapping[str, np.ndarray]) -> None:
    """Add the series, means over the hour, from values (T,) of the fields in SI units."""
    if "QV2M" in value and "PS" in value:
        vapour = vapour_pressure_from_specific_humidity(value["QV2M"], value["PS"])
        weather.add("ambient_dew_point_temperature", np.asarray(dew_point(vapour)), "QV2M and PS", mean=True)
    elif "T2MDEW" in value:
        weather.add("ambient_dew_point_temperature", value["T2MDEW"], "T2MDEW", mean=True)
    elif "QV2M" in value:
        weather.faults.append("QV2M is a humidity by mass and needs the pressure PS: ask for it too")
    elif "T2M" in value:
        weather.warnings.append("no QV2M and no T2MDEW: this weather has no humidity; ask for QV2M and PS")
    rain = next((name for name in ("PRECTOTCORR", "PRECTOT") if name in value), "")
    for name in ("T2M", "PS", "SWGDN", "CLDTOT", rain):
        if name in value:
            number = np.maximum(value[name], 0.0) if name in ("SWGDN", rain) else value[name]
            weather.add(_MERRA2_FIELDS[name][0], number, name, mean=True)
    for height in WIND_HEIGHTS_M:
        east, north = value.get(f"U{height}M"), value.get(f"V{height}M")
        if east is None or north is None:
            continue
        weather.add_wind(east, north, f"U{height}M and V{height}M", height_m=float(height), mean=True)
        weather.warnings.append(
            f"wind_speed is measured at {height} m, not at hub height; speed of the hour's mean wind"
        )
        break


NO_HUMIDITY = (
    "no dew point (d2m, 2m_dewpoint_temperature): this weather has no humidity; ask for it in the request"
)
_IRRADIANCE = "global_horizontal_irradiance"
_ERA5_FIELDS = {
    "t2m": ("ambient_temperature", "K"), "d2m": ("ambient_dew_point_temperature", "K"),
    "sp": ("ambient_pressure", "Pa"), "tcc": ("cloud_cover", "1"), "tp": ("rain", "m"),
    **dict.fromkeys(("u10", "v10", "u100", "v100"), ("wind_speed", "m s**-1")),
    **dict.fromkeys(("ssrd", "fdir"), (_IRRADIANCE, "J m**-2")), "avg_sdswrf": (_IRRADIANCE, "W m**-2"),
}  # fmt: skip
"""Short name of a field of ERA5 -> a signal in its unit, the unit where the file states none."""
_OTHER_NAMES = {
    "t2m": ("2m_temperature", "2t", "t_2m", "VAR_2T"),
    "d2m": ("2m_dewpoint_temperature", "2d", "d_2m", "VAR_2D"),
    "sp": ("surface_pressure", "surf_pres"), "tcc": ("total_cloud_cover",), "tp": ("total_precipitation",),
    "u10": ("u_10", "10m_u_component_of_wind", "10u", "VAR_10U"),
    "v10": ("v_10", "10m_v_component_of_wind", "10v", "VAR_10V"),
    "u100": ("u_100", "100m_u_component_of_wind", "100u", "VAR_100U"),
    "v100": ("v_100", "100m_v_component_of_wind", "100v", "VAR_100V"),
    "ssrd": ("surface_solar_radiation_downwards",),
    "fdir": ("total_sky_direct_solar_radiation_at_surface",),
    "avg_sdswrf": ("msdwswrf", "mean_surface_downward_short_wave_radiation_flux"),
    "z": ("geopotential", "geopotential_at_surface"),
}  # fmt: skip
"""Short name of a field of ERA5, or of the height of its ground -> its other names."""
_ACCUMULATED = ("ssrd", "fdir", "tp")


def read_era5(path: str | os.PathLike[str], site: Site | None = None) -> Record:
    """Record of ambient signals from a file of ERA5 (or ERA5-Land), in SI units and UTC.

    path: NetCDF in the current layout (`valid_time`) or that before September 2024 (`time`, perhaps
        `expver`), the CSV of the point product, or a ZIP archive of these (instantaneous and accumulated
        fields come in separate files).
    site: the nearest cell of a grid is used; may be None for a file of one point.

    The record's site is the point of the reanalysis, with the height of its ground where the file has the
    geopotential; the source of each series names the point and its distance from the site.  Temperature, dew
    point, pressure, wind and cloud are instants; radiation and rain belong to the hour that ends at the
    stamp.

    Raises TableFault with every fault and, for an archive, its member.
    """
    file = Path(path)
    found, digest = contents(file)
    alone = len(found) == 1
    records = read_each(found, lambda one: _era5_record(one, file.name, site, digest, alone))
    known = [one for one in records if one is not None]
    signals = {signal for one in known for signal in one.signals}
    if "ambient_temperature" not in signals:
        raise TableFault(
            "no 2 m temperature (t2m, 2m_temperature) in any of its files: ask for it in the request"
        )
    record = joined(known, file.name)
    if not alone and "ambient_dew_point_temperature" not in signals:
        record = dataclasses.replace(record, warnings=(*record.warnings, NO_HUMIDITY))
    return record


def _era5_record(one: Content, file: str, site: Site | None, digest: str, alone: bool) -> Record | None:
    """The record of one member; None for a further member without a known field, such as one of waves."""
    if (form := FORMATS_OF_KINDS.get(one.kind, "era5")) != "era5":
        raise TableFault(f'expected a file of ERA5, found {one.kind}; state format = "{form}"')
    if one.kind == "csv":
        points = _csv_fields(one.data, file, site, alone)
        return None if points is None else point_record(points, digest, temperature=alone)
    dataset = open_dataset(one.data, one.kind)
    if "QV2M" in dataset.data_vars:
        raise TableFault('is a file of MERRA-2; state format = "merra2"')
    if not alone and not any(short_name(str(name)) for name in dataset.data_vars):
        return None
    return point_record(point_fields(dataset, file, short_name, site), digest, temperature=alone)


def _csv_fields(data: bytes, file: str, site: Site | None, alone: bool) -> PointFields | None:
    """Fields of the point product's CSV: `valid_time`, fields by short name, `latitude`, `longitude`."""
    head = data.partition(b"\n")[0].decode("utf-8-sig", "replace")
    names = [name.strip().strip('"') for name in head.split(",")]
    time_name = next((name for name in ("valid_time", "time", "datetime") if name in names), None)
    used = [name for name in names if short_name(name)]
    if time_name is None or not used:
        if not alone and time_name is not None:
            return None
        raise TableFault(
            "expected the point product's CSV with valid_time and fields such as t2m, d2m, sp; found the "
            f"columns {', '.join(names[:12])}: name another table as a plain source, with its columns"
        )
    spots = [name for name in ("latitude", "longitude") if name in names]
    # stamps carry no offset, and are in UTC
    table = table_in(data, "", [*used, *spots], time_name, Notation(timezone="UTC", decimal="."))
    fields = {
        short: Field(table.values[name], name)
        for name in used
        if (short := short_name(name)) is not None and short != "z"
    }
    if len(spots) < 2:
        return PointFields(file, table.time, fields, warnings=table.warnings)
    at = np.unique(np.column_stack([table.values[name] for name in spots]), axis=0)
    if np.isnan(at).any():
        lost = np.isnan(table.values["latitude"] + table.values["longitude"])
        raise TableFault(
            f"no latitude and longitude at {stamp_text(table.time[lost][0])}: the file is damaged or cut "
            "short; fetch it again"
        )
    if len(at) > 1:
        raise TableFault(f"holds {len(at)} points; expected one: write each into a file of its own")
    north, east = map(float, at[0])
    place = place_text(north, east, site)
    return PointFields(file, table.time, fields, north, east, None, place, table.warnings)


# --- the fields at a point -------------------------------------------------------------------


def short_name(name: str) -> str | None:
    """Short name of a field of ERA5, such as "t2m" for "2m_temperature"; None for an unused field."""
    for short, others in _OTHER_NAMES.items():
        if {name, name.lower()} & {short, *others}:
            return short
    return None


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
    given = points.fields
    if temperature and "t2m" not in given:
        found = ", ".join(one.name for one in given.values()) or "no field"
        raise TableFault(
            f"no 2 m temperature (t2m, 2m_temperature); found {found}: ask for it in the request"
        )
    weather, value = _weather_of(points, _ERA5_FIELDS)
    for short, one in given.items():
        weather.faults += _power_for_energy(short, one, weather.time, value[short])
    _make_hourly(weather, given, value)
    _add_era5_fields(weather, given, value)
    if temperature and "d2m" not in value:
        weather.warnings.append(NO_HUMIDITY)
    return weather.record(points.site, sha256)


def _make_hourly(weather: SiteWeather, given: Mapping[str, Field], value: dict[str, np.ndarray]) -> None:
    """Make sums since midnight those of single hours."""
    daily = {one: _since_midnight(weather.time, value[one]) for one in _ACCUMULATED if one in value}
    for short, told in daily.items():
        # a field that hardly ever changes is written as the others of its file
        if told or (told is None and True in daily.values()):
            name = given[short].name
            step = modal_step(weather.time)[0]
            if step > HOUR_S:
                weather.faults.append(
                    f"{name}: sums since 00:00 UTC, every {duration_text(step)}; expected every hour, of "
                    "which means can be made: ask for all 24 hours of the day"
                )
            value[short] = _hourly_sums(weather.time, value[short])
            weather.warnings.append(f"{name}: sums since 00:00 UTC, turned into those of each hour")


def _add_era5_fields(
    weather: SiteWeather, given: Mapping[str, Field], value: Mapping[str, np.ndarray]
) -> None:
    """Add the series; radiation and rain belong to the hour before their stamp."""

    def named(*shorts: str) -> dict[str, Any]:
        stated = {one: given[one].unit for one in shorts}
        units = dict.fromkeys(
            f'the unit "{unit}"' if unit else f"no unit, so {_ERA5_FIELDS[one][1]} was taken"
            for one, unit in stated.items()
        )
        remedy = f"the file states {' and '.join(units)}; correct it or fetch the file again"
        return {"names": " and ".join(given[one].name for one in shorts), "remedy": remedy}

    for short in ("t2m", "d2m", "sp", "tcc"):
        if short in value:
            weather.add(_ERA5_FIELDS[short][0], value[short], **named(short))
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


def _power_for_energy(short: str, one: Field, time: np.ndarray, value: np.ndarray) -> list[str]:
    """The fault of radiation in W/m² that is taken for J/m² and becomes 3600 times too small."""
    (signal, own), unit = _ERA5_FIELDS[short], one.unit
    if signal != _IRRADIANCE or unit_in_weather(unit or own, signal) in (None, ("W/m2", 1.0)):
        return []
    known = value[np.isfinite(value)]
    highest = float(known.max()) if len(known) else 0.0
    # even under the clouds of a winter at 60 degrees some hour in three days has more than 1 W/m²
    if not 1e-3 < highest < 1.0 or time[-1] - time[0] < 3.0 * DAY_S:
        return []
    said = f'the file states "{unit}"' if unit else "it has no unit, so J/m² of an hour was taken"
    return [
        f"{one.name}: the radiation would reach {highest:.2g} W/m² only; {said}, and its numbers look like "
        "W/m²: correct the unit or multiply by 3600"
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
