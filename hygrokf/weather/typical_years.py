"""Read typical years. EPW, the weather of building simulation: hours of a typical or real year in local
standard time. TRY, the test reference years of Germany (DWD, BBSR): a typical year in Central European
Time."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Site
from hygrokf.data.signals import to_si
from hygrokf.data.table_readers import csv_rows
from hygrokf.data.timestamps import HOUR_S
from hygrokf.physics.psychrometrics import (
    ZERO_CELSIUS_K,
    dew_point,
    vapour_pressure,
    vapour_pressure_from_humidity_ratio,
)
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
    placed_in_years,
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


def read_epw(path: str | os.PathLike[str], year: int | None = None, years: int = 1) -> Record:
    """Record of ambient signals from an EPW file, in SI units and UTC.

    path: .epw, as gzip, or in a ZIP archive. year: calendar year to which every hour is moved; needed for a
        typical year, whose months are of different years.  None: the file's own year. years: in how many
        calendar years from `year` on the hours are repeated.

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
    rows = [cells for _, cells in csv_rows(content.data, "utf-8-sig")]
    faults: list[str] = []
    site, zone_h, place = _location(rows[0], faults)
    calendar, value = _hours(rows, faults)
    if faults:
        raise TableFault(*faults)
    written = np.unique(calendar[:, 0])
    warnings: list[str] = []
    if year is None and len(written) > 1:
        raise TableFault(
            f"is a typical year composed of months from {written[0]} … {written[-1]}; state the calendar "
            "year to assign to it, such as year = 2019"
        )
    if year is not None:
        same = years == 1 and list(written) == [year]
        own = "" if same else f"{written[0]} … {written[-1]}"
        calendar, value, warnings = placed_in_years(calendar, value, year, years, own)
    time = local_seconds(calendar) - zone_h * HOUR_S
    if (np.diff(time) <= 0.0).any():
        repeated = int(np.argmax(np.diff(time) <= 0.0)) + 1
        raise TableFault(f"line {repeated + _HEADER + 1}: the hours must be consecutive, this hour is not")
    weather = SiteWeather(file.name, time, place, SHIFTED, warnings=warnings)
    _add_epw_columns(weather, value)
    return weather.record(site, digest, "no dry-bulb temperature: all values of column 7 are missing")


def _add_epw_columns(weather: SiteWeather, value: Mapping[str, np.ndarray]) -> None:
    """Add the series of values (T,) in the file's units."""
    si = {one: to_si(number, _COLUMNS[one][1], one) for one, number in value.items()}
    si["ambient_dew_point_temperature"] = _epw_dew_point(si, weather)
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


def _epw_dew_point(si: Mapping[str, np.ndarray], weather: SiteWeather) -> np.ndarray:
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


ZONE_H = 1.0
"""[h] Central European Time against UTC, in summer too."""
HOURS = 8760
END_OF_HEADER = "***"
_NEEDED = ("MM", "DD", "HH", "t", "p", "x", "RF")
_MISSING = {"WR": 999.0, "N": 9.0}
_SIGNALS = {
    # signal: column, unit, whether it holds over the hour
    "ambient_temperature": ("t", "degC", False),
    "ambient_pressure": ("p", "hPa", False),
    "wind_direction": ("WR", "deg", False),
    "wind_speed": ("WG", "m/s", False),
    "cloud_cover": ("N", "1", False),
    "diffuse_horizontal_irradiance": ("D", "W/m2", True),
}


def is_try(text: str) -> bool:
    """Whether a text begins like a test reference year: a header with its columns that ends in ***."""
    lines = text.splitlines()
    end = next((i for i, line in enumerate(lines) if line.strip().startswith(END_OF_HEADER)), None)
    return end is not None and end > 0 and {"MM", "DD", "HH"} <= set(lines[end - 1].split())


def read_try(path: str | os.PathLike[str], year: int | None = None, years: int = 1) -> Record:
    """Record of ambient signals from a test reference year, in SI units and UTC.

    path: .dat of the edition of 2017 (a place by Rechtswert and Hochwert) or of 2011 (a region), plain, as
        gzip, or alone in a ZIP archive. year: calendar year to which the hours are moved; needed, as the file
        has none. years: in how many calendar years from it on they are repeated.

    Hour h of a day ends at h o'clock of Central European Time, in summer too.  Temperature, pressure,
    humidity, wind and cloud are instants at that end; radiation is the mean of the hour, global radiation
    the sum of the direct (B) and the diffuse one (D) on a horizontal plane.  The dew point is that over water
    of the vapour pressure, from the mixing ratio x (vapour by dry air), e = x p / (ε + x), or from the
    relative humidity RF, whichever is rounded more finely in that hour.

    Raises TableFault with every fault.
    """
    file = Path(path)
    one, digest = only_content(file, ("csv",), "a test reference year as text (.dat)")
    lines = one.data.decode("latin-1").splitlines()
    end = next((i for i, line in enumerate(lines) if line.strip().startswith(END_OF_HEADER)), 0)
    if end == 0:
        raise TableFault(f"expected a header that ends in {END_OF_HEADER}, found none: is this a TRY file?")
    if year is None:
        raise TableFault(
            "is a typical year without a calendar year of its own; state the one to assign to it, such as "
            "year = 2019"
        )
    names = lines[end - 1].split()
    faults = [f'no column "{name}" above {END_OF_HEADER}' for name in _NEEDED if name not in names]
    warnings: list[str] = []
    site = _site(lines[:end], faults, warnings)
    if faults:
        raise TableFault(*faults)
    table = _table(lines, end, names, faults)
    if faults:
        raise TableFault(*faults)
    column = {name: table[:, place] for place, name in enumerate(names)}
    stamps = np.column_stack(
        [np.full(len(table), year), *(column[name] for name in ("MM", "DD", "HH"))]
    ).astype(int)
    stamps, column, said = placed_in_years(stamps, column, year, years, "a test reference year")
    warnings += said
    time = local_seconds(stamps) - ZONE_H * HOUR_S
    if (np.abs(np.diff(time) - HOUR_S) > 1.0).any():
        place = int(np.argmax(np.abs(np.diff(time) - HOUR_S) > 1.0))
        raise TableFault(f"hour {place + 2} of the year: the hours must be consecutive, this one is not")
    weather = SiteWeather(file.name, time, remedy=SHIFTED, warnings=warnings)
    _add_try_columns(weather, column)
    return weather.record(site, digest)


def _table(lines: list[str], end: int, names: list[str], faults: list[str]) -> np.ndarray:
    """The hours (T, columns); their faults are added to `faults`."""
    body = [(i + 1, line.split()) for i, line in enumerate(lines) if i > end and line.strip()]
    if len(body) not in (HOURS, HOURS + 24):
        faults.append(
            f"expected {HOURS} hours after its header, found {len(body)}: cut short? fetch it again"
        )
        return np.zeros((0, len(names)))
    month, day, hour = (names.index(name) for name in ("MM", "DD", "HH"))
    used = range(len(names))
    return hours_table(
        body, len(names), used, lambda row: (2020, row[month], row[day], row[hour]), faults, exact=True
    )


def _add_try_columns(weather: SiteWeather, column: Mapping[str, np.ndarray]) -> None:
    """Add the series of columns (T,)."""
    for signal, (name, unit, held) in _SIGNALS.items():
        raw = column.get(name, np.full(len(weather.time), math.nan))
        raw = np.where(raw == _MISSING.get(name, math.inf), math.nan, raw) / (8.0 if name == "N" else 1.0)
        if np.isfinite(raw).any():
            height_m = WIND_HEIGHT_M if signal.startswith("wind_") else None
            weather.add(signal, to_si(raw, unit, signal), f'column "{name}"', mean=held, height_m=height_m)
    if {"B", "D"} <= set(column):
        sun = np.maximum(column["B"] + column["D"], 0.0)
        weather.add("global_horizontal_irradiance", sun, 'column "B and D"', mean=True)
    humid = _try_dew_point(column, weather.warnings)
    weather.add("ambient_dew_point_temperature", humid, 'column "x, RF, p and t"')
    weather.warnings.append(WIND_WARNING)


def _try_dew_point(column: Mapping[str, np.ndarray], warnings: list[str]) -> np.ndarray:
    """Dew point over water (T,) [K] from mixing ratio or relative humidity, whichever is rounded more
    finely."""
    ratio = np.where(column["x"] > 0.0, 1e-3 * column["x"], math.nan)
    share = np.where(column["RF"] > 0.0, 0.01 * column["RF"], math.nan)
    by_ratio = np.asarray(vapour_pressure_from_humidity_ratio(ratio, 100.0 * column["p"]))
    by_share = np.asarray(vapour_pressure(np.minimum(share, 1.0), column["t"] + ZERO_CELSIUS_K))
    apart = np.abs(by_ratio / by_share - 1.0)
    apart = apart[np.isfinite(apart)]
    if len(apart) and float(np.median(apart)) > 0.05:
        warnings.append(
            f"x and RF differ by {100 * float(np.median(apart)):.0f} % in the vapour pressure: are the "
            "columns shifted?"
        )
    # x is written to 0.1 g/kg, RF to 1 %
    finer = np.where(np.isfinite(by_ratio), 0.1 / np.fmax(column["x"], 1e-3), math.inf) < 1.0 / np.fmax(
        column["RF"], 1e-3
    )
    return np.asarray(dew_point(np.where(finer | ~np.isfinite(by_share), by_ratio, by_share)))


# --- the place -------------------------------------------------------------------------------


def _site(header: list[str], faults: list[str], warnings: list[str]) -> Site | None:
    """The place from Rechtswert, Hochwert and Hoehenlage; None where the header has none, as that of 2011."""
    found = {}
    for line in header:
        if match := re.match(r"\s*(Rechtswert|Hochwert|H\S*henlage)\s*:\s*(-?[\d.]+)\s*Meter", line):
            found[match[1]] = float(match[2])
    if not {"Rechtswert", "Hochwert"} <= set(found):
        warnings.append("the header states no place by Rechtswert and Hochwert: it is that of a region")
        return None
    east, north = found.pop("Rechtswert"), found.pop("Hochwert")
    latitude, longitude = geographic(east, north)
    if not (46.0 < latitude < 56.0 and 4.0 < longitude < 17.0):
        faults.append(
            f"Rechtswert {east:.0f} and Hochwert {north:.0f} lie at {latitude:.1f}° N "
            f"{longitude:.1f}° E; expected a place in Germany in the projection of the files"
        )
        return None
    return Site(latitude, longitude, next(iter(found.values()), None))


def geographic(easting_m: float, northing_m: float) -> tuple[float, float]:
    """Latitude and longitude [deg] of a point of ETRS89 / LCC Europe (EPSG:3034), the files' projection.

    easting_m, northing_m: [m] Rechtswert and Hochwert.

    Inverse of the Lambert conformal conic projection with two standard parallels on the ellipsoid GRS 80
    (Snyder, Map Projections – A Working Manual, 1987, equations 15-8 to 15-11, 14-9, 14-10 and 7-9).
    """
    radius, flattening = 6378137.0, 1.0 / 298.257222101
    e = math.sqrt(flattening * (2.0 - flattening))
    first, second, origin, meridian = (math.radians(one) for one in (35.0, 65.0, 52.0, 10.0))

    def scale(angle: float) -> float:
        return math.cos(angle) / math.sqrt(1.0 - (e * math.sin(angle)) ** 2)

    def conformal(angle: float) -> float:
        sine = e * math.sin(angle)
        return math.tan(0.25 * math.pi - 0.5 * angle) / ((1.0 - sine) / (1.0 + sine)) ** (0.5 * e)

    cone = math.log(scale(first) / scale(second)) / math.log(conformal(first) / conformal(second))
    factor = radius * scale(first) / (cone * conformal(first) ** cone)
    at_origin = factor * conformal(origin) ** cone
    east, north = easting_m - 4.0e6, at_origin - (northing_m - 2.8e6)
    t = (math.hypot(east, north) / factor) ** (1.0 / cone)
    latitude = 0.5 * math.pi - 2.0 * math.atan(t)
    for _ in range(8):
        sine = e * math.sin(latitude)
        latitude = 0.5 * math.pi - 2.0 * math.atan(t * ((1.0 - sine) / (1.0 + sine)) ** (0.5 * e))
    return math.degrees(latitude), math.degrees(math.atan2(east, north) / cone + meridian)
