"""Read weather files as the record of a site: one file of any format, several years of files, or a typical
year that is repeated."""

from __future__ import annotations

import dataclasses
import gzip
import os
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.readings import mask
from hygrokf.data.record import Record, Series, Site
from hygrokf.data.timestamps import modal_step
from hygrokf.texts.wording import duration_text, stamp_text
from hygrokf.weather.archive import archive_kind
from hygrokf.weather.joining import join_records
from hygrokf.weather.open_meteo import read_open_meteo
from hygrokf.weather.reanalysis import read_era5, read_merra2
from hygrokf.weather.site_weather import LAPSE_RATE, WARNED_FROM_M, at_altitude, distance_km, place_text
from hygrokf.weather.typical_years import is_try, read_epw, read_try

_READERS: Mapping[str, Callable[[Path, Site | None, int | None, int], Record]] = {
    "era5": lambda file, site, *_: read_era5(file, site),
    "epw": lambda file, _, *years: read_epw(file, *years),
    "merra2": lambda file, site, *_: read_merra2(file, site),
    "open_meteo": lambda file, *_: read_open_meteo(file),
    "try": lambda file, _, *years: read_try(file, *years),
}
WEATHER_FORMATS = tuple(_READERS)
TYPICAL = ("epw", "try")
"""Formats of typical years, whose hours are moved to a calendar year."""
NEEDED_SIGNALS = ("ambient_temperature", "ambient_dew_point_temperature")
MOST_GAPS_LISTED = 3
FAR_KM = 50.0
"""[km] weather from a point further from the site than this gives a warning."""
_HEAD = 2**14
"""[bytes] length of the beginning of a file from which its format is recognised."""


def read_weather_file(
    path: str | os.PathLike[str],
    form: str | None = None,
    *,
    site: Site | None = None,
    year: int | None = None,
    years: int = 1,
    altitude_m: float | None = None,
    to_site_altitude: bool = False,
    lapse_rate: float = LAPSE_RATE,
) -> Record:
    """Read the ambient signals of a site from one weather file, in SI units and UTC.

    path: of one of the `WEATHER_FORMATS`. form: its format; None: recognised by `weather_format`.
    site: of the cabinet; selects the nearest cell of a grid, with a warning if it is far away.
    year: calendar year of a typical year. years: number of calendar years from `year` on that repeat it.
    altitude_m: [m] height of the weather, if the file states none or a wrong one.
    to_site_altitude: whether temperature, dew point and pressure are moved to the site's altitude
        (`at_altitude`); otherwise a difference above 100 m gives a warning. lapse_rate: [K/m] for this.

    Raises TableFault with every fault.
    """
    file = Path(path)
    kind = form or weather_format(file) or "era5"  # the reader of ERA5 reports the faults of unknown files
    if kind not in WEATHER_FORMATS:
        raise ValueError(f'form must be one of {", ".join(WEATHER_FORMATS)}, found "{kind}"')
    record, station_m = _READERS[kind](file, site, year, years), altitude_m
    if (weather_site := record.site) is not None:
        point_deg = weather_site.latitude_deg, weather_site.longitude_deg
        if site is not None and distance_km(*point_deg, site) > FAR_KM:
            warning = f"its point lies at {place_text(*point_deg, site)}: is it the weather of this site?"
            record = dataclasses.replace(record, warnings=(*record.warnings, warning))
        station_m = weather_site.altitude_m if altitude_m is None else altitude_m
        record = dataclasses.replace(record, site=Site(*point_deg, station_m))
    record = mask(record, within_range=True)  # such as codes of missing values
    site_m = None if site is None else site.altitude_m
    if to_site_altitude:
        faults = []
        if site_m is None:
            faults.append("conversion to the site's altitude needs altitude_m in [site]")
        if station_m is None:
            faults.append(
                "conversion to the site's altitude needs the altitude of the weather: state altitude_m "
                "in this source "
                "(of a reanalysis: the height of its ground in that cell, geopotential / 9.80665)"
            )
        if site_m is None or station_m is None:
            raise TableFault(*faults)
        return at_altitude(record, site_m, station_m, lapse_rate)
    if site_m is not None and station_m is not None and abs(site_m - station_m) > WARNED_FROM_M:
        difference_K = 6.5e-3 * (site_m - station_m)
        warning = (
            f"its height is {station_m:.0f} m, the site's {site_m:.0f} m: the site will be about "
            f"{abs(difference_K):.1f} K {'colder' if difference_K > 0 else 'warmer'}; "
            "to_site_altitude = true corrects this"
        )
        record = dataclasses.replace(record, warnings=(*record.warnings, warning))
    return record


def weather_format(path: Path) -> str | None:
    """Return the format of a weather file, recognised by its name, its first bytes, or the names in a ZIP
    archive; None for a table, and for a file that cannot be read."""
    name = path.name.lower()
    if name.endswith((".epw", ".epw.gz")):
        return "epw"
    if name.startswith("merra2"):
        return "merra2"
    try:
        with open(path, "rb") as stream:
            first_bytes = stream.read(_HEAD)
        if first_bytes[:2] == b"\x1f\x8b":
            with gzip.open(path) as stream:
                first_bytes = stream.read(_HEAD)
        if first_bytes[:4] == b"PK\x03\x04":
            with zipfile.ZipFile(path) as archive:
                return _form_of_members([name.lower().rpartition("/")[2] for name in archive.namelist()])
        kind = archive_kind(first_bytes)
    except (OSError, EOFError, ValueError, zlib.error, zipfile.BadZipFile, TableFault):
        return None
    if kind == "netcdf4":
        return "merra2" if _has_merra2(path) else "era5"
    if kind == "netcdf3":  # the header names the fields
        return "merra2" if b"T2M" in first_bytes else "era5"
    if kind == "json" or b"utc_offset_seconds" in first_bytes.partition(b"\n")[0]:
        return "open_meteo"
    return "epw" if kind == "epw" else "try" if is_try(first_bytes.decode("latin-1")) else None


def _form_of_members(names: Sequence[str]) -> str | None:
    """Return the format of an archive by the names of its files; None if it is not recognised."""
    if any(name.startswith("merra2") for name in names):
        return "merra2"
    if any(name.endswith(".epw") for name in names):
        return "epw"
    if names and all(name.startswith("try") for name in names):
        return "try"
    return "era5" if any(name.endswith((".nc", ".nc4")) for name in names) else None


def _has_merra2(path: Path) -> bool:
    """Return whether a NetCDF-4 file has the temperature of MERRA-2; its fields are not read."""
    try:
        import h5py

        with h5py.File(path) as file:
            return "T2M" in file
    except (ImportError, OSError):  # the reader reports the fault
        return False


def read_weather(
    paths: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    site: Site | None = None,
    year: int | None = None,
    years: int = 1,
    altitude_m: float | None = None,
    to_site_altitude: bool = False,
    lapse_rate: float = LAPSE_RATE,
) -> Record:
    """Read ambient signals over the years of one or several weather files, in SI units and UTC.

    paths: of the `WEATHER_FORMATS`, recognised by name and first bytes; several files follow each other, such
    as one
        for each day or year.
    site: of the cabinet; needed if a file holds a grid.
    year: first calendar year of a typical year (EPW, TRY); needed if its months are of different years.
    years: number of calendar years from `year` on over which a typical year is repeated; 29 February repeats
        the 28th.
    altitude_m, to_site_altitude, lapse_rate: as in `read_weather_file`.

    The record's warnings name the gaps inside the files. Its site is that of the weather, not that of the
    cabinet, unless the weather was moved to the site's altitude.

    Raises TableFault with the faults of every file; ValueError for numbers out of range.
    """
    files = [Path(paths)] if isinstance(paths, str | os.PathLike) else [Path(path) for path in paths]
    if not files:
        raise ValueError("paths: expected one weather file at least, found none")
    if years < 1:
        raise ValueError(f"years must be 1 or more, found {years}")
    if years > 1 and year is None:
        raise ValueError("years needs year, the first calendar year of the repeated typical year")
    if years > 1 and len(files) > 1:
        raise ValueError("years repeats one typical year; give one file, or years = 1")
    records, faults = [], []
    for file in files:
        is_typical = weather_format(file) in TYPICAL
        if years > 1 and not is_typical:
            faults.append(
                f"{file.name}: only a typical year (EPW, TRY) is repeated; this file has its own years"
            )
            continue
        try:
            records.append(
                read_weather_file(
                    file,
                    site=site,
                    year=year if is_typical else None,
                    years=years,
                    altitude_m=altitude_m,
                    to_site_altitude=to_site_altitude,
                    lapse_rate=lapse_rate,
                )
            )
        except TableFault as fault:
            faults += [f"{file.name}: {message}" for message in fault.faults]
    if faults:
        raise TableFault(*faults)
    record = join_records(
        records, files[0].name if len(files) == 1 else f"{files[0].name} and {len(files) - 1} more"
    )
    warnings = list(record.warnings)
    for signal in NEEDED_SIGNALS:
        if signal in record:
            warnings += gaps_text(record[signal])
    return dataclasses.replace(record, warnings=tuple(warnings))


def gaps_text(series: Series) -> list[str]:
    """Return a sentence on the gaps of a series, as a list; empty without gaps. A gap is longer than three
    usual steps."""
    time, _ = series.known
    step, _ = modal_step(series.time)
    lengths_s = np.diff(time)
    gaps = np.flatnonzero(lengths_s > 3.01 * step)  # none where the step is unknown
    if not len(gaps):
        return []
    longest = gaps[np.argsort(lengths_s[gaps])[::-1][:MOST_GAPS_LISTED]]
    gaps_listed = ", ".join(
        f"{duration_text(lengths_s[gap])} from {stamp_text(time[gap])}" for gap in longest
    )
    missing_s = float(np.sum(lengths_s[gaps] - step))
    return [
        f"{series.signal}: {len(gaps)} gaps, {duration_text(missing_s)} in all; longest {gaps_listed}"
        if len(gaps) > 1
        else f"{series.signal}: a gap of {gaps_listed}"
    ]
