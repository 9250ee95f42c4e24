"""Read MERRA-2, the reanalysis of NASA: hourly means of tavg1_2d_slv_Nx (M2T1NXSLV) and its sisters."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Series, Site
from hygrokf.data.signals import signal_named
from hygrokf.data.timestamps import HOUR_S, MINUTE_S
from hygrokf.physics.psychrometrics import dew_point, vapour_pressure_from_specific_humidity
from hygrokf.weather.archive import Content, contents
from hygrokf.weather.fields import PointFields, impossible_range, saturation_doubt
from hygrokf.weather.gridded import open_dataset, point_fields
from hygrokf.weather.joining import joined

UNITS = {
    # field: units in use, all of them the SI unit
    "T2M": ("K",), "T2MDEW": ("K",), "QV2M": ("kg kg-1", "kg/kg", "1"), "PS": ("Pa",),
    "U50M": ("m s-1", "m/s"), "V50M": ("m s-1", "m/s"), "U10M": ("m s-1", "m/s"), "V10M": ("m s-1", "m/s"),
    "U2M": ("m s-1", "m/s"), "V2M": ("m s-1", "m/s"), "SWGDN": ("W m-2", "W/m^2", "W/m2"),
    "PRECTOTCORR": ("kg m-2 s-1",), "PRECTOT": ("kg m-2 s-1",), "CLDTOT": ("1",),
}  # fmt: skip
"""Fields of MERRA-2 that are used: single levels, radiation, precipitation."""
GROUND = {"PHIS": "z"}
"""Geopotential of the ground, of the constant fields const_2d_asm_Nx [m²/s²]."""
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
    records: list[Record] = []
    faults: list[str] = []
    for one in found:
        try:
            records.append(_content_record(one, file.name, site, digest))
        except TableFault as broken:
            faults += [fault if len(found) == 1 else f"{one.name}: {fault}" for fault in broken.faults]
    if not faults and not any("ambient_temperature" in one for one in records):
        faults.append("no temperature T2M in any of its files: ask for the collection M2T1NXSLV")
    if faults:
        raise TableFault(*faults)
    return joined(records, file.name)


def _content_record(one: Content, file: str, site: Site | None, digest: str) -> Record:
    """The record of one file."""
    if not one.kind.startswith("netcdf"):
        raise TableFault(f"expected NetCDF of MERRA-2, found {one.kind}")
    points = point_fields(
        open_dataset(one.data, one.kind),
        file,
        site,
        lambda name: GROUND.get(name, name if name in UNITS else None),
    )
    faults = _time_faults(points.time) + _unit_faults(points)
    value = {name: np.asarray(field.value, dtype=float) for name, field in points.fields.items()}
    warnings = list(points.warnings)
    made = _values(value, warnings, faults)
    # a stamp is the middle of its hour; a record has ends
    order = np.argsort(points.time, kind="stable")
    time = points.time[order] + 30.0 * MINUTE_S
    series = []
    for signal, (names, number, height_m) in made.items():
        row = signal_named(signal)
        finite = number[np.isfinite(number)]
        if not len(finite):
            warnings.append(f"{names}: no value at this point, {signal} is left out")
            continue
        if beyond := impossible_range(finite, row):
            faults.append(f"{names}: {beyond}: fetch the file again")
            continue
        source = f'{file}, column "{names}"' + (f" at {points.place}" if points.place else "")
        series.append(
            Series(signal, time, number[order], interval_s=HOUR_S, source=source, height_m=height_m)
        )
    if faults:
        raise TableFault(*faults)
    place = None
    if points.latitude_deg is not None and points.longitude_deg is not None:
        place = Site(points.latitude_deg, points.longitude_deg, points.altitude_m)
    return Record(file, tuple(series), place, warnings=tuple(warnings), provenance=((file, digest),))


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


def _unit_faults(points: PointFields) -> list[str]:
    return [
        f'{name}: unknown unit "{field.unit}"; expected {UNITS[name][0]}, as in the files of MERRA-2'
        for name, field in points.fields.items()
        if field.unit is not None and field.unit.strip() not in UNITS[name]
    ]


def _values(
    value: Mapping[str, np.ndarray], warnings: list[str], faults: list[str]
) -> dict[str, tuple[str, np.ndarray, float | None]]:
    """Signal -> its fields, values (T,) in SI units, and height of a wind [m]."""
    made: dict[str, tuple[str, np.ndarray, float | None]] = {}
    if "T2M" in value:
        made["ambient_temperature"] = ("T2M", value["T2M"], None)
    if "QV2M" in value and "PS" in value:
        vapour = vapour_pressure_from_specific_humidity(value["QV2M"], value["PS"])
        made["ambient_dew_point_temperature"] = ("QV2M and PS", np.asarray(dew_point(vapour)), None)
    elif "T2MDEW" in value:
        made["ambient_dew_point_temperature"] = ("T2MDEW", value["T2MDEW"], None)
    elif "QV2M" in value:
        faults.append("QV2M is a humidity by mass and needs the pressure PS: ask for it in the request")
    elif "T2M" in value:
        warnings.append("no QV2M and no T2MDEW: this weather has no humidity; ask for QV2M and PS")
    if {"ambient_temperature", "ambient_dew_point_temperature"} <= set(made):
        warnings += saturation_doubt(made["ambient_temperature"][1], made["ambient_dew_point_temperature"][1])
    if "PS" in value:
        made["ambient_pressure"] = ("PS", value["PS"], None)
    if "SWGDN" in value:
        made["global_horizontal_irradiance"] = ("SWGDN", np.maximum(value["SWGDN"], 0.0), None)
    if "CLDTOT" in value:
        made["cloud_cover"] = ("CLDTOT", value["CLDTOT"], None)
    rain = next((name for name in ("PRECTOTCORR", "PRECTOT") if name in value), None)
    if rain is not None:  # kg/m² is a depth in mm
        made["rain"] = (rain, np.maximum(HOUR_S * value[rain], 0.0), None)
    for height in WIND_HEIGHTS_M:
        east, north = value.get(f"U{height}M"), value.get(f"V{height}M")
        if east is None or north is None:
            continue
        names = f"U{height}M and V{height}M"
        made["wind_speed"] = (names, np.hypot(east, north), float(height))
        made["wind_direction"] = (names, np.mod(np.arctan2(-east, -north), 2.0 * math.pi), float(height))
        warnings.append(
            f"wind_speed is measured at {height} m, not at hub height; speed of the hour's mean wind"
        )
        break
    return made
