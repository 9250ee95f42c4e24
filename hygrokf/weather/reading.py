"""One weather file of any kind as the record of a site: read, its place compared with the site, moved to its
height."""

from __future__ import annotations

import dataclasses
import os
import zipfile
from pathlib import Path

from hygrokf.data.columns import TableFault
from hygrokf.data.masks import mask_out_of_range
from hygrokf.data.record import Record, Site
from hygrokf.weather.altitude import LAPSE_RATE, SAID_FROM_M, at_altitude
from hygrokf.weather.epw import read_epw
from hygrokf.weather.era5 import read_era5
from hygrokf.weather.gridded import FAR_KM, distance_km

FORMATS = ("era5", "epw")


def read_weather_file(
    path: str | os.PathLike[str],
    form: str | None = None,
    *,
    site: Site | None = None,
    year: int | None = None,
    altitude_m: float | None = None,
    to_site_altitude: bool = False,
    lapse_rate: float = LAPSE_RATE,
) -> Record:
    """Record of ambient signals of a site from one weather file, in SI units and UTC.

    path: of ERA5 or EPW. form: "era5" or "epw"; None: see `form_of`.
    site: of the cabinet; the nearest cell of a grid is taken, and a weather from afar is said.
    year: calendar year of a typical year. altitude_m: [m] that the weather is of, where the file does not say
        or is wrong.
    to_site_altitude: move temperature, dew point and pressure to the site's altitude, see `at_altitude`;
        without it a difference above 100 m is said. lapse_rate: [K/m] for this.

    Raises TableFault with every fault.
    """
    file = Path(path)
    kind = form or form_of(file)
    if kind not in FORMATS:
        raise ValueError(f'form must be one of {", ".join(FORMATS)}, found "{kind}"')
    if kind == "epw":
        record = _said_from_afar(read_epw(file, year), site)
    else:
        record = read_era5(file, site)
    record = _within_range(record)
    if altitude_m is not None and record.site is not None:
        record = dataclasses.replace(record, site=dataclasses.replace(record.site, altitude_m=altitude_m))
    station_m = altitude_m
    if station_m is None and record.site is not None:
        station_m = record.site.altitude_m
    wanted_m = None if site is None else site.altitude_m
    if to_site_altitude:
        faults = []
        if wanted_m is None:
            faults.append(
                "to be moved to the site's altitude, the site needs one: state altitude_m in [site]"
            )
        if station_m is None:
            faults.append(
                "to be moved to the site's altitude, its own must be known: state altitude_m in this source "
                "(of a reanalysis: the height of its ground in that cell, geopotential / 9.80665)"
            )
        if faults or wanted_m is None:
            raise TableFault(faults)
        return at_altitude(record, wanted_m, station_m, lapse_rate)
    if wanted_m is not None and station_m is not None and abs(wanted_m - station_m) > SAID_FROM_M:
        colder = 6.5e-3 * (wanted_m - station_m)
        said = (
            f"its height is {station_m:.0f} m, the site's {wanted_m:.0f} m: the site will be about "
            f"{abs(colder):.1f} K {'colder' if colder > 0 else 'warmer'}; to_site_altitude = true corrects "
            "this"
        )
        record = dataclasses.replace(record, warnings=(*record.warnings, said))
    return record


def form_of(path: Path) -> str:
    """ "epw" or "era5": by the name of a file, else by its first bytes or, in a ZIP archive, by the names of
    its members."""
    if path.name.lower().endswith((".epw", ".epw.gz")):
        return "epw"
    try:
        with open(path, "rb") as stream:
            head = stream.read(12)
        if head[:4] == b"PK\x03\x04":
            with zipfile.ZipFile(path) as archive:
                names = archive.namelist()
            return "epw" if any(name.lower().endswith(".epw") for name in names) else "era5"
    except (OSError, ValueError, zipfile.BadZipFile):  # what is wrong with it, the reader says
        return "era5"
    return "epw" if head.removeprefix(b"\xef\xbb\xbf").upper().startswith(b"LOCATION,") else "era5"


def _within_range(record: Record) -> Record:
    """The record without single readings that cannot be, such as codes for what is missing, and what was left
    out."""
    series, warnings = [], list(record.warnings)
    for one in record.series:
        kept, said = mask_out_of_range(one)
        series.append(kept)
        warnings += said
    return dataclasses.replace(record, series=tuple(series), warnings=tuple(warnings))


def _said_from_afar(record: Record, site: Site | None) -> Record:
    if site is None or record.site is None:
        return record
    away = distance_km(record.site.latitude_deg, record.site.longitude_deg, site)
    if away <= FAR_KM:
        return record
    said = f"its station lies {away:.0f} km from the site: is it the weather of this site?"
    return dataclasses.replace(record, warnings=(*record.warnings, said))
