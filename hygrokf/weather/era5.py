"""Read ERA5 as the Climate Data Store delivers it: NetCDF in either layout, ZIP, CSV of the point product."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np

from hygrokf.data.columns import Notation, TableFault
from hygrokf.data.record import Record, Site
from hygrokf.data.table_readers import table_in
from hygrokf.data.timestamps import stamp_text
from hygrokf.weather.archive import FORMATS_OF_KINDS, Content, contents, read_each
from hygrokf.weather.fields import NO_HUMIDITY, Field, PointFields, point_record, short_name
from hygrokf.weather.gridded import open_dataset, point_fields
from hygrokf.weather.joining import joined
from hygrokf.weather.site_weather import place_text


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
    records = read_each(found, lambda one: _content_record(one, file.name, site, digest, alone))
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


def _content_record(one: Content, file: str, site: Site | None, digest: str, alone: bool) -> Record | None:
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
    return point_record(point_fields(dataset, file, site), digest, temperature=alone)


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
    fields = {name: Field(table.values[name]) for name in used}
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
