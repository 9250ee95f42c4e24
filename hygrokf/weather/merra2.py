"""Read MERRA-2, the reanalysis of NASA: hourly means of tavg1_2d_slv_Nx (M2T1NXSLV) and its sisters."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Site
from hygrokf.data.timestamps import HOUR_S, MINUTE_S
from hygrokf.physics.psychrometrics import dew_point, vapour_pressure_from_specific_humidity
from hygrokf.weather.archive import Content, contents, read_each
from hygrokf.weather.gridded import open_dataset, point_fields
from hygrokf.weather.joining import joined
from hygrokf.weather.site_weather import SiteWeather, converted

_FIELDS = {
    # field: a signal in its unit, the unit where the file states none
    "T2M": ("ambient_temperature", "K"), "T2MDEW": ("ambient_dew_point_temperature", "K"),
    "PS": ("ambient_pressure", "Pa"), "SWGDN": ("global_horizontal_irradiance", "W/m2"),
    "CLDTOT": ("cloud_cover", "1"), **dict.fromkeys(("PRECTOTCORR", "PRECTOT"), ("rain", "kg m-2 s-1")),
    **dict.fromkeys(("U50M", "V50M", "U10M", "V10M", "U2M", "V2M"), ("wind_speed", "m/s")),
}  # fmt: skip
"""Fields of MERRA-2 that are used besides QV2M: single levels, radiation, precipitation."""
_BY_MASS = (None, "kg kg-1", "kg/kg", "1")
_SHORT_NAMES = {"PHIS": "z", "QV2M": "QV2M", **{name: name for name in _FIELDS}}
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
    records = read_each(found, lambda one: _content_record(one, file.name, site, digest))
    if not any("ambient_temperature" in one for one in records):
        raise TableFault("no temperature T2M in any of its files: ask for the collection M2T1NXSLV")
    return joined(records, file.name)


def _content_record(one: Content, file: str, site: Site | None, digest: str) -> Record:
    """The record of one file."""
    if not one.kind.startswith("netcdf"):
        raise TableFault(f"expected NetCDF of MERRA-2, found {one.kind}")
    points = point_fields(open_dataset(one.data, one.kind), file, _SHORT_NAMES.get, site)
    # a stamp is the middle of its hour; a record has ends
    order = np.argsort(points.time, kind="stable")
    weather = SiteWeather(file, points.time[order] + 30.0 * MINUTE_S, points.place)
    weather.warnings += points.warnings
    weather.faults += _time_faults(points.time)
    value: dict[str, np.ndarray] = {}
    for name, field in points.fields.items():
        raw = np.asarray(field.value, dtype=float)[order]
        if name in _FIELDS:
            signal, own = _FIELDS[name]
            raw = converted(name, raw, own if field.unit is None else field.unit, signal, weather.faults)
        elif field.unit not in _BY_MASS:
            weather.faults.append(f'{name}: unknown unit "{field.unit}"; expected kg kg-1')
        value[name] = raw
    _add_fields(weather, value)
    return weather.record(points.site, digest)


def _time_faults(time: np.ndarray) -> list[str]:
    """The faults of stamps [s]: doubled ones, and those that are not the middles of hours."""
    if not len(time):
        return ["has no hour in it: fetch it again"]
    faults = []
    if len(np.unique(time)) < len(time):
        faults.append("stamps occur more than once: the files of two days or versions were merged wrongly")
    off = np.abs(np.mod(time, HOUR_S) - 30.0 * MINUTE_S) > 1.0
    if off.any():
        faults.append(
            f"{int(off.sum())} of {len(time)} stamps are not half past the hour; expected hourly means "
            "(tavg1_…), not instants (inst…) or means over three hours: ask for M2T1NXSLV"
        )
    return faults


def _add_fields(weather: SiteWeather, value: Mapping[str, np.ndarray]) -> None:
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
            weather.add(_FIELDS[name][0], number, name, mean=True)
    for height in WIND_HEIGHTS_M:
        east, north = value.get(f"U{height}M"), value.get(f"V{height}M")
        if east is None or north is None:
            continue
        weather.add_wind(east, north, f"U{height}M and V{height}M", height_m=float(height), mean=True)
        weather.warnings.append(
            f"wind_speed is measured at {height} m, not at hub height; speed of the hour's mean wind"
        )
        break
