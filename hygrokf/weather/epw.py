"""Read EPW, the weather of building simulation: hours of a typical or real year in local standard time."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Site
from hygrokf.data.signals import to_si
from hygrokf.data.timestamps import HOUR_S
from hygrokf.weather.archive import only_content
from hygrokf.weather.site_weather import (
    SHIFTED,
    WIND_HEIGHT_M,
    WIND_WARNING,
    SiteWeather,
    dew_point_of,
    hours_table,
    local_seconds,
    place_text,
    placed_in_year,
)

_HEADER = 8
_COLUMNS = {
    # signal: column (from 0), unit, code from which a value is missing, hold
    "ambient_temperature": (6, "degC", 99.9, "instant"),
    "ambient_dew_point_temperature": (7, "degC", 99.9, "instant"),
    "ambient_relative_humidity": (8, "%", 999.0, "instant"),
    "ambient_pressure": (9, "Pa", 999999.0, "instant"),
    "global_horizontal_irradiance": (13, "W/m2", 9999.0, "hour"),
    "direct_normal_irradiance": (14, "W/m2", 9999.0, "hour"),
    "diffuse_horizontal_irradiance": (15, "W/m2", 9999.0, "hour"),
    "wind_direction": (20, "deg", 999.0, "instant"),
    "wind_speed": (21, "m/s", 999.0, "instant"),
    "cloud_cover": (22, "1", 99.0, "instant"),
    "rain": (33, "mm", 999.0, "hour"),
}
_FEWEST_COLUMNS = 22
_NINES = (99.0, 99.9, 99.99, *(10.0**power - 1.0 for power in range(3, 10)), 999.9, 9999.9, 99999.9)


def read_epw(path: str | os.PathLike[str], year: int | None = None) -> Record:
    """Record of ambient signals from an EPW file, in SI units and UTC.

    path: .epw, as gzip, or in a ZIP archive. year: calendar year to which every hour is moved; needed for a
        typical year, whose months are of different years.  None: the file's own year.

    Hour h of a day ends at h o'clock of local standard time, in the header's time zone.  Temperature,
    humidity, pressure, wind and cloud are instants at that end; radiation (Wh/m², so W/m² as the mean)
    and rain belong to the hour.  The codes of missing values (99.9, 999, 9999, 99999, 999999) become NaN.  A
    missing dew point is computed from relative humidity over water.  In a leap year 28 February is repeated
    where the file has no 29 February.

    Raises TableFault with every fault: not an EPW file, lines missing, text among numbers, a typical year
    without `year`.
    """
    file = Path(path)
    # archives of weather services hold statistics and design days beside the EPW file
    content, digest = only_content(file, ("epw",), "an EPW file, whose first line begins with LOCATION")
    rows = list(csv.reader(io.StringIO(content.data.decode("utf-8-sig", "replace"))))
    faults: list[str] = []
    site, zone_h, place = _location(rows[0], faults)
    calendar, value = _hours(rows, faults)
    if faults:
        raise TableFault(*faults)
    years = np.unique(calendar[:, 0])
    warnings: list[str] = []
    if year is None and len(years) > 1:
        raise TableFault(
            f"is a typical year composed of months from {years[0]} … {years[-1]}; state the calendar year "
            "to assign to it, such as year = 2019"
        )
    if year is not None:
        own = "" if list(years) == [year] else f"{years[0]} … {years[-1]}"
        calendar, value, warnings = placed_in_year(calendar, value, year, own)
    time = local_seconds(calendar) - zone_h * HOUR_S
    if (np.diff(time) <= 0.0).any():
        repeated = int(np.argmax(np.diff(time) <= 0.0)) + 1
        raise TableFault(f"line {repeated + _HEADER + 1}: the hours must be consecutive, this hour is not")
    weather = SiteWeather(file.name, time, place, SHIFTED, warnings=warnings)
    _add_columns(weather, value)
    return weather.record(site, digest, "no dry-bulb temperature: all values of column 7 are missing")


def _add_columns(weather: SiteWeather, value: Mapping[str, np.ndarray]) -> None:
    """Add the series of values (T,) in the file's units."""
    si = {one: to_si(number, _COLUMNS[one][1], one) for one, number in value.items()}
    si["ambient_dew_point_temperature"] = _dew_point(si, weather)
    for signal, number in si.items():
        if signal != "ambient_relative_humidity" and np.isfinite(number).any():
            column, _, _, kind = _COLUMNS[signal]
            height_m = WIND_HEIGHT_M if signal.startswith("wind_") else None
            weather.add(signal, number, f"column {column + 1}", mean=kind != "instant", height_m=height_m)
    if np.isfinite(si["wind_speed"]).any():
        weather.warnings.append(WIND_WARNING)


def _location(row: Sequence[str], faults: list[str]) -> tuple[Site | None, float, str]:
    """Site, time zone [h] and the place in words, from the first line."""
    cells = [cell.strip() for cell in row]
    names = ("latitude", "longitude", "time zone", "elevation")
    try:
        latitude, longitude, zone, altitude = (float(cells[column]) for column in (6, 7, 8, 9))
    except (IndexError, ValueError):
        faults.append(
            f"line 1: expected LOCATION with {', '.join(names)} in cells 7 to 10, found "
            f"{', '.join(cells[6:10]) or 'none'}"
        )
        return None, 0.0, ""
    if not -14.0 <= zone <= 14.0:
        faults.append(f"line 1: expected a time zone within -14 … 14 h, found {zone:g}")
    try:
        site = Site(latitude, longitude, altitude)
    except ValueError as outside:
        faults.append(f"line 1: {outside}")
        return None, zone, ""
    return site, zone, f"{place_text(latitude, longitude)} {altitude:g} m"


def _hours(rows: list[list[str]], faults: list[str]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Year, month, day, hour 1…24 (T, 4) as written, and signal -> (T,) in the unit of `_COLUMNS`, NaN =
    missing; the faults of the lines are added to `faults`."""
    nothing = np.zeros((0, 4), dtype=int), dict[str, np.ndarray]()
    periods = next((row for row in rows[:_HEADER] if row and row[0].strip().upper() == "DATA PERIODS"), None)
    if periods is None:
        faults.append(
            f"expected {_HEADER} lines of header that end with DATA PERIODS; the file is cut short or is "
            "not EPW"
        )
        return nothing
    hourly = len(periods) > 2 and periods[2].strip()
    if hourly != "1":
        faults.append(f"line {_HEADER}: expected 1 record an hour, found {hourly or 'none'}")
        return nothing
    body = [row for row in rows[_HEADER:] if any(cell.strip() for cell in row)]
    used = sorted({0, 1, 2, 3, *(column for column, *_ in _COLUMNS.values())})
    before = len(faults)
    numbered = list(enumerate(body, _HEADER + 1))
    table = hours_table(numbered, _FEWEST_COLUMNS, used, lambda row: row[:4], faults)
    if len(faults) > before:
        return nothing
    expected = _expected_hours(periods)
    if expected is not None and len(body) not in (expected, expected + 24):
        remedy = "the file is cut short; fetch it again" if len(body) < expected else "lines occur twice"
        faults.append(f"expected {expected} hours after its DATA PERIODS, found {len(body)}: {remedy}")
    value = {}
    for signal, (column, _, missing, _) in _COLUMNS.items():
        if column < table.shape[1]:
            raw = table[:, column]
            # codes vary in their number of nines; other large values point to a wrong unit
            codes = [one for one in _NINES if one >= missing - 1e-9]
            absent = np.isclose(raw[:, None], codes, rtol=0.0, atol=1e-6).any(axis=1)
            scale = 10.0 if signal == "cloud_cover" else 1.0
            value[signal] = np.where(absent, np.nan, raw) / scale
    return table[:, :4].astype(int), value


def _expected_hours(periods: Sequence[str]) -> int | None:
    """Hours of the header's period without 29 February; None where it states no period."""
    try:
        dates = [[int(part) for part in cell.split("/")[:2]] for cell in periods[5:7]]
        first, last = (datetime(2019, m, min(d, 28 if m == 2 else 31), tzinfo=UTC) for m, d in dates)
    except ValueError:
        return None
    return 24 * ((last - first).days + 1) if last >= first else None


def _dew_point(si: Mapping[str, np.ndarray], weather: SiteWeather) -> np.ndarray:
    """Dew points (T,) [K], missing ones from relative humidity."""
    share, own = si["ambient_relative_humidity"], si["ambient_dew_point_temperature"]
    made = dew_point_of(share, si["ambient_temperature"])
    lacking = np.isnan(own) & np.isfinite(made)
    if not lacking.any():
        return own
    highest = 100.0 * float(np.nanmax(share))
    if highest <= 1.5:
        weather.faults.append(
            f"column 9: relative humidity reaches {highest:.3g} only, expected per cent: its numbers look "
            "like fractions"
        )
    weather.warnings.append(
        f"{int(lacking.sum())} dew points are missing; they were computed from relative humidity over water"
    )
    return np.where(lacking, made, own)
