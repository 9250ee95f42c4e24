"""Weather of many years: files put after each other, or a typical year repeated."""

from __future__ import annotations

import calendar
import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Series, Site
from hygrokf.data.timestamps import duration_text, modal_step, stamp_text
from hygrokf.weather.altitude import LAPSE_RATE
from hygrokf.weather.joining import joined
from hygrokf.weather.reading import form_of, read_weather_file

NEEDED = ("ambient_temperature", "ambient_dew_point_temperature")
SHOWN_GAPS = 3


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
    """Record of ambient signals over the years of one or several weather files, in SI units and UTC.

    paths: ERA5 (NetCDF, ZIP, CSV) or EPW files, known by name and first bytes; several are put after each
        other.
    site: of the cabinet; needed where a file holds a grid.
    year: first calendar year of a typical year (EPW); needed where its months are of different years.
    years: calendar years from `year` on over which a typical year is repeated. Each has its own 29 February,
        on which the 28 is repeated.
    altitude_m, to_site_altitude, lapse_rate: as in `read_weather_file`.

    The record's warnings name the gaps: hours that are missing although the files go on after them. Its site
    is that of the weather, not the cabinet's, unless the weather was moved to the site's altitude.

    Raises TableFault with the faults of every file; ValueError for numbers out of range.
    """
    files = [Path(paths)] if isinstance(paths, str | os.PathLike) else [Path(one) for one in paths]
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
        typical = form_of(file) == "epw"
        if years > 1 and not typical:
            faults.append(f"{file.name}: only a typical year (.epw) is repeated; this file has its own years")
            continue
        for place in range(years):
            try:
                records.append(
                    read_weather_file(
                        file,
                        site=site,
                        year=year + place if typical and year is not None else None,
                        altitude_m=altitude_m,
                        to_site_altitude=to_site_altitude,
                        lapse_rate=lapse_rate,
                    )
                )
            except TableFault as broken:
                faults += [f"{file.name}: {fault}" for fault in broken.faults]
                break
    if faults:
        raise TableFault(faults)
    record = joined(
        records, files[0].name if len(files) == 1 else f"{files[0].name} and {len(files) - 1} more"
    )
    warnings = _without_repeats(record.warnings) if years > 1 else list(record.warnings)
    for signal in NEEDED:
        if signal in record:
            warnings += gaps_text(record[signal])
    return dataclasses.replace(record, warnings=tuple(warnings))


def gaps_text(series: Series) -> list[str]:
    """The gaps of a series in one sentence, or nothing: what is longer than three steps between known
    readings.

    series: any.
    """
    time, _ = series.known
    step, _ = modal_step(series.time)
    if len(time) < 2 or not np.isfinite(step):
        return []
    length = np.diff(time)
    wide = np.flatnonzero(length > 3.01 * step)
    if not len(wide):
        return []
    longest = wide[np.argsort(length[wide])[::-1][:SHOWN_GAPS]]
    listed = ", ".join(f"{duration_text(length[one])} from {stamp_text(time[one])}" for one in longest)
    missing = float(np.sum(length[wide] - step))
    return [
        f"{series.signal}: {len(wide)} gaps, {duration_text(missing)} in all; longest {listed}"
        if len(wide) > 1
        else f"{series.signal}: a gap of {listed}"
    ]


def _without_repeats(warnings: Sequence[str]) -> list[str]:
    """Sentences about single years of a repeated typical year become one."""
    leap = [said for said in warnings if "28 February is repeated" in said]
    typical = [said for said in warnings if "a typical year, not the weather of" in said]
    kept = [said for said in warnings if said not in leap and said not in typical]
    if typical:
        first, last = typical[0].split(" stand in ")[0], typical[-1].split(" stand in ")[1].split(":")[0]
        begin = typical[0].split(" stand in ")[1].split(":")[0]
        kept.append(
            f"{first} are repeated in every year {begin} … {last}: a typical year, not the weather of these"
        )
    if leap:
        named = ", ".join(said.split()[0] for said in leap)
        kept.append(f"leap years {named}: 28 February is repeated as 29 February")
    return kept


def whole_years(record: Record, signal: str = "ambient_temperature") -> tuple[int, ...]:
    """Calendar years (UTC) of which a signal has readings for at least 95 % of the hours.

    record: of weather. signal: that is counted.
    """
    time, _ = record[signal].known
    hours = np.unique(np.floor((time - 1.0) / 3600.0))
    of_year = (hours * 3600.0).astype("datetime64[s]").astype("datetime64[Y]").astype(int) + 1970
    found = []
    for year in np.unique(of_year):
        length = 8784 if calendar.isleap(int(year)) else 8760
        if np.count_nonzero(of_year == year) >= 0.95 * length:
            found.append(int(year))
    return tuple(found)
