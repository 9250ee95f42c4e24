"""Read ERA5 as the Climate Data Store delivers it: NetCDF in either layout, ZIP, CSV of the point product."""

from __future__ import annotations

import dataclasses
import io
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Site
from hygrokf.weather.archive import Content, contents
from hygrokf.weather.fields import NO_HUMIDITY, Field, PointFields, point_record, short_name
from hygrokf.weather.gridded import FAR_KM, distance_km, open_dataset, place_text, point_fields
from hygrokf.weather.joining import joined

if TYPE_CHECKING:
    import pandas


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
    records, faults = [], []
    for one in found:
        try:
            records.append(_content_record(one, file.name, site, digest, alone=len(found) == 1))
        except TableFault as broken:
            inside = one.name.removeprefix(f"{file.name} (").removesuffix(")")
            faults += [fault if len(found) == 1 else f"{inside}: {fault}" for fault in broken.faults]
    known = [one for one in records if one is not None]
    signals = {signal for one in known for signal in one.signals}
    if not faults and "ambient_temperature" not in signals:
        faults.append(
            "no 2 m temperature (t2m, 2m_temperature) in any of its files: ask for it in the request"
        )
    if faults:
        raise TableFault(*faults)
    record = joined(known, file.name)
    if len(found) > 1 and "ambient_dew_point_temperature" not in signals:
        record = dataclasses.replace(record, warnings=(*record.warnings, NO_HUMIDITY))
    return record


def _content_record(one: Content, file: str, site: Site | None, digest: str, alone: bool) -> Record | None:
    """The record of one member; None for a further member without a known field, such as one of waves."""
    if one.kind == "epw":
        raise TableFault('is an EPW file; state format = "epw"')
    if one.kind == "json":
        raise TableFault('is JSON of Open-Meteo; state format = "open_meteo"')
    if one.kind == "csv":
        points = _csv_fields(one.data, file, site, alone)
    else:
        dataset = open_dataset(one.data, one.kind)
        if "QV2M" in dataset.data_vars:
            raise TableFault('is a file of MERRA-2; state format = "merra2"')
        if not alone and not any(short_name(str(name)) for name in dataset.data_vars):
            return None
        points = point_fields(dataset, file, site)
    if points is None:
        return None
    return point_record(points, digest, temperature=alone)


def _csv_fields(data: bytes, file: str, site: Site | None, alone: bool) -> PointFields | None:
    """Fields of the point product's CSV: `valid_time`, fields by short name, `latitude`, `longitude`."""
    import pandas as pd

    try:
        frame = pd.read_csv(io.BytesIO(data), encoding="utf-8-sig", skipinitialspace=True, low_memory=False)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as broken:
        raise TableFault(f"cannot be read as CSV: {' '.join(str(broken).split())}") from None
    frame.columns = [str(name).strip() for name in frame.columns]
    time_name = next((name for name in ("valid_time", "time", "datetime") if name in frame), None)
    used = [name for name in frame.columns if short_name(name)]
    if time_name is None or not used:
        if not alone and time_name is not None:
            return None
        listed = ", ".join(frame.columns[:12])
        raise TableFault(
            "expected the point product's CSV with valid_time and fields such as t2m, d2m, sp; found the "
            f"columns {listed}: name another table as a plain source, with its columns"
        )
    if not len(frame):
        raise TableFault("has a line of names and no hour below it; fetch it again")
    time = _csv_time(frame[time_name], time_name)
    faults, fields = [], {}
    for name in used:
        number = pd.to_numeric(frame[name], errors="coerce")
        text = number.isna() & frame[name].notna()
        if text.any():
            row = int(np.argmax(text.to_numpy()))
            faults.append(
                f'column "{name}": expected numbers, found "{frame[name].iloc[row]}" in line {row + 2}'
            )
        fields[name] = Field(number.to_numpy(dtype=float))
    place, warnings = "", []
    at: tuple[float, float] | None = None
    if {"latitude", "longitude"} <= set(frame.columns):
        spots = frame[["latitude", "longitude"]].apply(pd.to_numeric, errors="coerce").drop_duplicates()
        if spots.isna().any(axis=None):
            row = int(np.argmax(spots.isna().any(axis=1).to_numpy()))
            faults.append(
                f"line {int(spots.index[row]) + 2}: no latitude and longitude: the file is damaged or cut "
                "short; fetch it again"
            )
        elif len(spots) > 1:
            faults.append(f"holds {len(spots)} points; expected one: write each into a file of its own")
        else:
            at = float(spots.iloc[0, 0]), float(spots.iloc[0, 1])
            place = place_text(*at, site)
            if site is not None and distance_km(*at, site) > FAR_KM:
                warnings.append(f"its point lies at {place}: is it the weather of this site?")
    if faults:
        raise TableFault(*faults)
    north, east = at or (None, None)
    return PointFields(file, time, fields, north, east, None, place, tuple(warnings))


def _csv_time(column: pandas.Series, name: str) -> np.ndarray:
    """Stamps in UTC [s]; the product's own carry no offset."""
    from datetime import UTC

    from hygrokf.data.timestamps import read_stamps

    stamps = read_stamps(column, UTC)
    wrong = stamps.unreadable | ~np.isfinite(stamps.time)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise TableFault(
            f'column "{name}": expected stamps such as 2024-01-01 00:00:00, found "{column.iloc[row]}" '
            "in line "
            f"{row + 2}: the file is damaged or cut short; fetch it again"
        )
    return stamps.time
