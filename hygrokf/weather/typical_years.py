"""Read typical years: EPW, the hours of a typical or real year in local standard time, for building
simulation; and TRY, the test reference years of Germany (DWD, BBSR), in Central European Time."""

from __future__ import annotations

import calendar
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Site
from hygrokf.data.table_readers import csv_rows
from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.physics.psychrometrics import (
    dew_point,
    vapour_pressure,
    vapour_pressure_from_humidity_ratio,
)
from hygrokf.weather.archive import only_content
from hygrokf.weather.site_weather import (
    SiteWeather,
    Variable,
    WeatherField,
    dew_point_of,
    require_temperature,
)

WIND_HEIGHT_M = 10.0
"""[m] height of the wind in files of typical years."""
_DEW_POINT = "ambient_dew_point_temperature"
_HEADER = 8
_EPW = {
    f"column {number}": variable
    for number, variable in {
        7: Variable("ambient_temperature", "degC", missing=99.9),
        8: Variable(_DEW_POINT, "degC", missing=99.9),
        9: Variable("ambient_relative_humidity", "%", part=True, missing=999.0),
        10: Variable("ambient_pressure", "Pa", missing=999999.0),
        14: Variable("global_horizontal_irradiance", "W/m2", mean=True, missing=9999.0),
        15: Variable("direct_normal_irradiance", "W/m2", mean=True, missing=9999.0),
        16: Variable("diffuse_horizontal_irradiance", "W/m2", mean=True, missing=9999.0),
        21: Variable("wind_direction", "deg", missing=999.0),
        22: Variable("wind_speed", "m/s", missing=999.0),
        23: Variable("cloud_cover", "tenths", missing=99.0),
        34: Variable("rain", "mm", mean=True, missing=999.0),
    }.items()
}
_FEWEST_COLUMNS = 22
_NINES = (9.0, 99.0, 99.9, 99.99, *(10.0**power - 1.0 for power in range(3, 10)), 999.9, 9999.9, 99999.9)


def read_epw(path: str | os.PathLike[str], year: int | None = None, years: int = 1) -> Record:
    """Read ambient signals from an EPW file, in SI units and UTC.

    path: .epw, also as gzip or in a ZIP archive.
    year: calendar year to which every hour is moved; needed for a typical year, whose months are of different
        years. None: the file's own year.
    years: number of calendar years from `year` on in which the hours are repeated.

    Hour h of a day ends at h o'clock of local standard time, in the header's time zone. Temperature,
    humidity, pressure, wind and cloud are instants at that end; radiation (Wh/m², hence W/m² as the mean) and
    rain belong to the hour. The codes of missing values (99.9, 999, 9999, 99999, 999999) become NaN. A
    missing dew point is computed from relative humidity over water. In a leap year, 28 February is repeated
    if the file has no 29 February.

    Raises TableFault with every fault: not an EPW file, lines missing, text among numbers, a typical year
    without `year`.
    """
    file = Path(path)
    # archives of weather services hold statistics and design days beside the EPW file
    content, digest = only_content(file, ("epw",), "an EPW file, whose first line begins with LOCATION")
    rows = [cells for _, cells in csv_rows(content.data, "utf-8-sig")]
    faults: list[str] = []
    site, zone_h = _location(rows[0], faults)
    table = _hours(rows, faults)
    if faults:
        raise TableFault(*faults)
    stamps = table[:, :4].astype(int)
    stated_years = np.unique(stamps[:, 0])
    if year is None and len(stated_years) > 1:
        raise TableFault(
            f"is a typical year composed of months from {stated_years[0]} … {stated_years[-1]}; state the "
            "calendar year to assign to it, such as year = 2019"
        )
    is_own_year = year is None or (years == 1 and list(stated_years) == [year])
    own_years = "" if is_own_year else f"{stated_years[0]} … {stated_years[-1]}"
    columns = {f"column {place}": column for place, column in enumerate(table.T, 1)}
    weather = _weather(file.name, stamps, columns, _EPW, site, zone_h, year, years, own_years, _HEADER)
    _add_epw_dew_point(weather)
    lacking = "no dry-bulb temperature: all values of column 7 are missing"
    return require_temperature(weather.record(digest), lacking, "a file with dew points or relative humidity")


def _weather(
    file: str, stamps: np.ndarray, columns: Mapping[str, np.ndarray], variables: Mapping[str, Variable],
    site: Site | None, zone_h: float, year: int | None, years: int, own_years: str, header_lines: int,
) -> SiteWeather:  # fmt: skip
    """Return the weather of hours, moved to calendar years. Raises TableFault if the hours are not
    consecutive.

    stamps, columns, year, years, own_years: as for `place_in_years`; year None: the years stay as written.
    zone_h: [h] local clock minus UTC. header_lines: number of lines above the hours.
    """
    warnings: list[str] = []
    if year is not None:
        stamps, columns, warnings = place_in_years(stamps, columns, year, years, own_years)
    time = local_seconds(stamps) - zone_h * HOUR_S
    if (np.diff(time) <= 0.0).any():
        first_fault = int(np.argmax(np.diff(time) <= 0.0)) + 1
        raise TableFault(
            f"line {first_fault + header_lines + 1}: the hours must be consecutive, this hour is not"
        )
    fields = {}
    for name, variable in variables.items():
        if name in columns:
            # codes vary in their number of nines; other large values stay and reveal a wrong unit
            codes = [code for code in _NINES if code >= variable.missing - 1e-9]
            is_missing = np.isclose(columns[name][:, None], codes, rtol=0.0, atol=1e-6).any(axis=1)
            value = np.where(is_missing, np.nan, columns[name])
            if np.isfinite(value).any():
                fields[name] = WeatherField(value, name)
    return SiteWeather(file, time, fields, variables, site=site, height_m=WIND_HEIGHT_M, warnings=warnings)


def _location(row: Sequence[str], faults: list[str]) -> tuple[Site | None, float]:
    """Return site and time zone [h] of the first line; adds faults to `faults`."""
    cells = [cell.strip() for cell in row]
    names = ("latitude", "longitude", "time zone", "elevation")
    try:
        latitude, longitude, zone, altitude = (float(cells[column]) for column in (6, 7, 8, 9))
    except (IndexError, ValueError):
        faults.append(
            f"line 1: expected LOCATION with {', '.join(names)} in cells 7 to 10, found "
            f"{', '.join(cells[6:10]) or 'none'}"
        )
        return None, 0.0
    if not -14.0 <= zone <= 14.0:
        faults.append(f"line 1: expected a time zone within -14 … 14 h, found {zone:g}")
    try:
        return Site(latitude, longitude, altitude), zone
    except ValueError as fault:
        faults.append(f"line 1: {fault}")
        return None, zone


def _hours(rows: list[list[str]], faults: list[str]) -> np.ndarray:
    """Return the columns (T, C), which begin with year, month, day, hour 1…24; adds faults to `faults`."""
    empty_table = np.zeros((0, _FEWEST_COLUMNS))
    periods = next((row for row in rows[:_HEADER] if row and row[0].strip().upper() == "DATA PERIODS"), None)
    if periods is None:
        faults.append(
            f"expected {_HEADER} lines of header that end with DATA PERIODS; the file is cut short or is "
            "not EPW"
        )
        return empty_table
    records_per_hour = len(periods) > 2 and periods[2].strip()
    if records_per_hour != "1":
        faults.append(f"line {_HEADER}: expected 1 record an hour, found {records_per_hour or 'none'}")
        return empty_table
    hour_lines = [row for row in rows[_HEADER:] if any(cell.strip() for cell in row)]
    used_columns = [0, 1, 2, 3, *(int(name.removeprefix("column ")) - 1 for name in _EPW)]
    faults_before = len(faults)
    table = hours_table(
        list(enumerate(hour_lines, _HEADER + 1)), _FEWEST_COLUMNS, used_columns, lambda row: row[:4], faults
    )
    expected = _expected_hours(periods)
    if (
        len(faults) == faults_before
        and expected is not None
        and len(hour_lines) not in (expected, expected + 24)
    ):
        remedy = (
            "the file is cut short; fetch it again" if len(hour_lines) < expected else "lines occur twice"
        )
        faults.append(f"expected {expected} hours after its DATA PERIODS, found {len(hour_lines)}: {remedy}")
    return table


def _expected_hours(periods: Sequence[str]) -> int | None:
    """Return the number of hours of the header's period, without 29 February; None if it states no period."""
    try:
        dates = [[int(number) for number in cell.split("/")[:2]] for cell in periods[5:7]]
        first, last = (
            datetime(2019, month, min(day, 28 if month == 2 else 31), tzinfo=UTC) for month, day in dates
        )
    except ValueError:
        return None
    return 24 * ((last - first).days + 1) if last >= first else None


def _add_epw_dew_point(weather: SiteWeather) -> None:
    """Add the dew point; missing values are computed from relative humidity."""
    all_missing = np.full(len(weather.time), math.nan)
    temperature, dew_points, humidity = (
        weather.value.get(f"column {number}", all_missing) for number in (7, 8, 9)
    )
    computed = dew_point_of(humidity, temperature)
    is_filled = np.isnan(dew_points) & np.isfinite(computed)
    if not is_filled.any():
        return
    highest = 100.0 * float(np.nanmax(humidity))
    if highest <= 1.5:
        weather.faults.append(
            f"column 9: relative humidity reaches {highest:.3g} only, expected per cent: its numbers look "
            "like fractions"
        )
    weather.warnings.append(
        f"{int(is_filled.sum())} dew points are missing; they were computed from relative humidity over water"
    )
    name = "column 8" if "column 8" in weather.fields else "column 9"
    weather.add(_DEW_POINT, np.where(is_filled, computed, dew_points), name)


ZONE_H = 1.0
"""[h] Central European Time minus UTC, in summer too."""
HOURS = 8760
END_OF_HEADER = "***"
_NEEDED = ("MM", "DD", "HH", "t", "p", "x", "RF")
_TRY = {
    "t": Variable("ambient_temperature", "degC"),
    "p": Variable("ambient_pressure", "hPa"),
    "WR": Variable("wind_direction", "deg", missing=999.0),
    "WG": Variable("wind_speed", "m/s"),
    "N": Variable("cloud_cover", "eighths", missing=9.0),
    "B": Variable("global_horizontal_irradiance", "W/m2", mean=True, part=True),
    "D": Variable("diffuse_horizontal_irradiance", "W/m2", mean=True),
    "x": Variable("cloud_cover", "1", part=True),
    "RF": Variable("ambient_relative_humidity", "%", part=True),
}


def is_try(text: str) -> bool:
    """Return whether a text begins like a test reference year: with a header whose last line before *** names
    the columns."""
    lines = text.splitlines()
    end = next(
        (line_number for line_number, line in enumerate(lines) if line.strip().startswith(END_OF_HEADER)),
        None,
    )
    return end is not None and end > 0 and {"MM", "DD", "HH"} <= set(lines[end - 1].split())


def read_try(path: str | os.PathLike[str], year: int | None = None, years: int = 1) -> Record:
    """Read ambient signals from a test reference year, in SI units and UTC.

    path: .dat of the edition of 2017 (a place by Rechtswert and Hochwert) or of 2011 (a region), plain, as
        gzip, or alone in a ZIP archive.
    year: calendar year to which the hours are moved; needed, because the file has none.
    years: number of calendar years from `year` on in which the hours are repeated.

    Hour h of a day ends at h o'clock of Central European Time, in summer too. Temperature, pressure,
    humidity, wind and cloud are instants at that end; radiation is the mean of the hour; global radiation is
    the sum of direct (B) and diffuse radiation (D) on a horizontal plane. The dew point over water follows
    from the mixing ratio x (vapour per dry air), e = x p / (ε + x), or from the relative humidity RF,
    whichever is rounded more finely in that hour.

    Raises TableFault with every fault.
    """
    file = Path(path)
    content, digest = only_content(file, ("csv",), "a test reference year as text (.dat)")
    lines = content.data.decode("latin-1").splitlines()
    header_end = next(
        (line_number for line_number, line in enumerate(lines) if line.strip().startswith(END_OF_HEADER)), 0
    )
    if header_end == 0:
        raise TableFault(f"expected a header that ends in {END_OF_HEADER}, found none: is this a TRY file?")
    if year is None:
        raise TableFault(
            "is a typical year without a calendar year of its own; state the one to assign to it, such as "
            "year = 2019"
        )
    column_names = lines[header_end - 1].split()
    faults = [f'no column "{name}" above {END_OF_HEADER}' for name in _NEEDED if name not in column_names]
    warnings: list[str] = []
    site = _site(lines[:header_end], faults, warnings)
    if faults:
        raise TableFault(*faults)
    table = _table(lines, header_end, column_names, faults)
    if faults:
        raise TableFault(*faults)
    column = {name: table[:, place] for place, name in enumerate(column_names)}
    stamps = np.column_stack([np.full(len(table), year), *(column[name] for name in ("MM", "DD", "HH"))])
    own_years = "a test reference year"
    weather = _weather(
        file.name, stamps.astype(int), column, _TRY, site, ZONE_H, year, years, own_years, header_end + 1
    )
    weather.warnings[:0] = warnings
    values = weather.value
    if {"B", "D"} <= set(values):
        weather.add("global_horizontal_irradiance", values["B"] + values["D"], "B", "D")
    if {"x", "RF", "p", "t"} <= set(values):
        weather.add(_DEW_POINT, _try_dew_point(weather), "x", "RF", "p", "t")
    return require_temperature(
        weather.record(digest), "no temperature: all values of t are missing", "x and RF"
    )


def _table(lines: list[str], header_end: int, names: list[str], faults: list[str]) -> np.ndarray:
    """Return the hours (T, columns) below the header; adds faults to `faults`."""
    below_header = enumerate(lines[header_end + 1 :], header_end + 2)
    hour_lines = [(number, line.split()) for number, line in below_header if line.strip()]
    if len(hour_lines) not in (HOURS, HOURS + 24):
        faults.append(
            f"expected {HOURS} hours after its header, found {len(hour_lines)}: cut short? fetch it again"
        )
        return np.zeros((0, len(names)))
    month, day, hour = (names.index(name) for name in ("MM", "DD", "HH"))

    def date(row: np.ndarray) -> tuple[float, ...]:
        return 2020, row[month], row[day], row[hour]

    return hours_table(hour_lines, len(names), range(len(names)), date, faults, is_exact=True)


def _try_dew_point(weather: SiteWeather) -> np.ndarray:
    """Return the dew point over water (T,) [K] from mixing ratio or relative humidity, whichever is rounded
    more finely."""
    ratio_g_kg, relative_humidity, pressure, kelvin = (weather.value[name] for name in ("x", "RF", "p", "t"))
    mixing_ratio = np.where(ratio_g_kg > 0.0, 1e-3 * ratio_g_kg, math.nan)
    humidity = np.where(relative_humidity > 0.0, relative_humidity, math.nan)
    by_ratio = np.asarray(vapour_pressure_from_humidity_ratio(mixing_ratio, pressure))
    by_humidity = np.asarray(vapour_pressure(np.minimum(humidity, 1.0), kelvin))
    differences = np.abs(by_ratio / by_humidity - 1.0)
    differences = differences[np.isfinite(differences)]
    if len(differences) and float(np.median(differences)) > 0.05:
        weather.warnings.append(
            f"x and RF differ by {100 * float(np.median(differences)):.0f} % in the vapour pressure: are the "
            "columns shifted?"
        )
    # x is written to 0.1 g/kg, RF to 1 %
    rounding_of_ratio = np.where(np.isfinite(by_ratio), 0.1 / np.fmax(ratio_g_kg, 1e-3), math.inf)
    is_ratio_finer = rounding_of_ratio < 0.01 / np.fmax(relative_humidity, 1e-5)
    return np.asarray(dew_point(np.where(is_ratio_finer | ~np.isfinite(by_humidity), by_ratio, by_humidity)))


# --- hours of typical years -----------------------------------------------------------------


def place_in_years(
    stamps: np.ndarray, columns: Mapping[str, np.ndarray], year: int, years: int, own_years: str
) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    """Move hours to each of several calendar years; returns their stamps, their columns, and warnings.

    stamps: (T, 4) year, month, day, hour 1…24 as written. columns: of numbers (T,). year: first calendar
        year, 1900 … 2200. years: number of calendar years. own_years: years of the file in words; "": no
        warning, because they are the calendar year.

    In a leap year 28 February is repeated as 29 February if the file has none; in other years the file's 29
    February is left out. Raises TableFault for a year out of range.
    """
    last_year = year + years - 1
    if not 1900 <= year <= last_year <= 2200:
        out_of_range = year if last_year > 2200 >= year else last_year
        raise TableFault(f"year must lie within 1900 … 2200, found {out_of_range}")
    months, days = stamps[:, 1], stamps[:, 2]
    leap_day = (months == 2) & (days == 29)
    february_28 = np.flatnonzero((months == 2) & (days == 28))
    rows_of_years, dates, leap_years, warnings = [], [], [], []
    for calendar_year in range(year, last_year + 1):
        chosen, day = np.arange(len(days)), days
        if calendar.isleap(calendar_year) and not leap_day.any() and len(february_28) == 24:
            chosen, day = (
                np.insert(chosen, february_28[-1] + 1, february_28),
                np.insert(day, february_28[-1] + 1, 24 * [29]),
            )
            leap_years.append(str(calendar_year))
        elif not calendar.isleap(calendar_year) and leap_day.any():
            chosen, day = chosen[~leap_day], day[~leap_day]
            warnings.append(f"{calendar_year} is not a leap year: 29 February is left out")
        rows_of_years.append(chosen)
        year_of_hour = np.full(len(day), calendar_year)
        dates.append(np.column_stack([year_of_hour, months[chosen], day, stamps[chosen, 3]]))
    if own_years:
        span = f"{year}" if years == 1 else f"{year} … {last_year}"
        warnings.append(f"hours of {own_years} stand in {span}: a typical year, not the weather of {span}")
    if leap_years:
        verb = "is a leap year" if len(leap_years) == 1 else "are leap years"
        warnings.insert(0, f"{', '.join(leap_years)} {verb}: 28 February is repeated as 29 February")
    all_rows = np.concatenate(rows_of_years)
    return np.concatenate(dates), {name: column[all_rows] for name, column in columns.items()}, warnings


def local_seconds(stamps: np.ndarray) -> np.ndarray:
    """Return the ends of hours, given by stamps (T, 4), as seconds since 1970-01-01T00:00 of the local clock
    (T,)."""
    months = (stamps[:, 0] - 1970) * 12 + stamps[:, 1] - 1
    days = months.astype("datetime64[M]").astype("datetime64[D]").astype(int) + stamps[:, 2] - 1
    return days * DAY_S + stamps[:, 3] * HOUR_S


def hours_table(
    lines: Sequence[tuple[int, Sequence[str]]],
    width: int,
    used_columns: Sequence[int],
    date: Callable[[np.ndarray], Iterable[float]],
    faults: list[str],
    is_exact: bool = False,
) -> np.ndarray:
    """Return the hours (T, columns) of lines, NaN for empty cells; adds the faults of the first three faulty
    lines to `faults`.

    lines: number and cells of each line. width: smallest number of cells of a line; is_exact: the only
        number.
    used_columns: to read as numbers. date: returns year, month, day and hour 1 … 24 of a row.
    """
    table = np.full((len(lines), max([width, *(len(cells) for _, cells in lines)])), np.nan)
    messages = []
    for row, (number, cells) in zip(table, lines, strict=True):
        try:
            if len(cells) < width or (is_exact and len(cells) > width):
                raise ValueError(
                    f"expected {'' if is_exact else 'at least '}{width} cells, found {len(cells)}"
                )
            for column in used_columns:
                if column < len(cells) and cells[column].strip():
                    row[column] = float(cells[column])
                    if not np.isfinite(row[column]):
                        raise ValueError(f"cell {column + 1}: expected a number, found {cells[column]}")
            year, month, day, hour = map(int, date(row))
            if not 1 <= hour <= 24:
                raise ValueError(f"expected an hour 1 … 24, found {hour}")
            if not (1 <= month <= 12 and 1 <= day <= 31 and 1800 <= year <= 2300):
                raise ValueError(f"expected a date, found {year}, {month}, {day}")
            if day > (29 if month == 2 else calendar.monthrange(year, month)[1]):
                raise ValueError(f"month {month} has no day {day}")
        except ValueError as reason:
            messages.append(f"line {number}: {reason}")
    remark_on_rest = f" (and {len(messages) - 3} more lines)" if len(messages) > 3 else ""
    faults += [*messages[:2], *(message + remark_on_rest for message in messages[2:3])]
    return table


# --- the place -------------------------------------------------------------------------------


def _site(header: list[str], faults: list[str], warnings: list[str]) -> Site | None:
    """Return the place from Rechtswert, Hochwert and Hoehenlage; None if the header states none, as in the
    edition of 2011."""
    coordinates = {}
    for line in header:
        if match := re.match(r"\s*(Rechtswert|Hochwert|H\S*henlage)\s*:\s*(-?[\d.]+)\s*Meter", line):
            coordinates[match[1]] = float(match[2])
    if not {"Rechtswert", "Hochwert"} <= set(coordinates):
        warnings.append("the header states no place by Rechtswert and Hochwert: it is that of a region")
        return None
    east, north = coordinates.pop("Rechtswert"), coordinates.pop("Hochwert")
    latitude, longitude = geographic(east, north)
    if not (46.0 < latitude < 56.0 and 4.0 < longitude < 17.0):
        faults.append(
            f"Rechtswert {east:.0f} and Hochwert {north:.0f} lie at {latitude:.1f}° N "
            f"{longitude:.1f}° E; expected a place in Germany in the projection of the files"
        )
        return None
    return Site(latitude, longitude, next(iter(coordinates.values()), None))


def geographic(easting_m: float, northing_m: float) -> tuple[float, float]:
    """Return latitude and longitude [deg] of a point in ETRS89 / LCC Europe (EPSG:3034), the projection of
    the files.

    easting_m, northing_m: [m] Rechtswert and Hochwert.

    Inverse of the Lambert conformal conic projection with two standard parallels on the ellipsoid GRS 80
    (Snyder, Map Projections – A Working Manual, 1987, equations 15-8 to 15-11, 14-9, 14-10 and 7-9).
    """
    radius, flattening = 6378137.0, 1.0 / 298.257222101
    eccentricity = math.sqrt(flattening * (2.0 - flattening))
    first, second, origin, meridian = (math.radians(degrees) for degrees in (35.0, 65.0, 52.0, 10.0))

    def scale(angle: float) -> float:
        return math.cos(angle) / math.sqrt(1.0 - (eccentricity * math.sin(angle)) ** 2)

    def conformal(angle: float) -> float:
        sine = eccentricity * math.sin(angle)
        return math.tan(0.25 * math.pi - 0.5 * angle) / ((1.0 - sine) / (1.0 + sine)) ** (0.5 * eccentricity)

    cone = math.log(scale(first) / scale(second)) / math.log(conformal(first) / conformal(second))
    factor = radius * scale(first) / (cone * conformal(first) ** cone)
    at_origin = factor * conformal(origin) ** cone
    east, north = easting_m - 4.0e6, at_origin - (northing_m - 2.8e6)
    projected = (math.hypot(east, north) / factor) ** (1.0 / cone)
    latitude = 0.5 * math.pi - 2.0 * math.atan(projected)
    for _ in range(8):
        sine = eccentricity * math.sin(latitude)
        latitude = 0.5 * math.pi - 2.0 * math.atan(
            projected * ((1.0 - sine) / (1.0 + sine)) ** (0.5 * eccentricity)
        )
    return math.degrees(latitude), math.degrees(math.atan2(east, north) / cone + meridian)
