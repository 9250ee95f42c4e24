"""Read TRY, the test reference years of Germany (DWD, BBSR): a typical year in Central European Time."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Site
from hygrokf.data.signals import to_si
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
    hours_table,
    local_seconds,
    placed_in_year,
)

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


def read_try(path: str | os.PathLike[str], year: int | None = None) -> Record:
    """Record of ambient signals from a test reference year, in SI units and UTC.

    path: .dat of the edition of 2017 (a place by Rechtswert and Hochwert) or of 2011 (a region), plain, as
        gzip, or alone in a ZIP archive. year: calendar year to which the hours are moved; needed, as the file
        has none.

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
    stamps, column, said = placed_in_year(stamps, column, year, "a test reference year")
    warnings += said
    time = local_seconds(stamps) - ZONE_H * HOUR_S
    if (np.abs(np.diff(time) - HOUR_S) > 1.0).any():
        place = int(np.argmax(np.abs(np.diff(time) - HOUR_S) > 1.0))
        raise TableFault(f"hour {place + 2} of the year: the hours must be consecutive, this one is not")
    weather = SiteWeather(file.name, time, remedy=SHIFTED, warnings=warnings)
    _add_columns(weather, column)
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


def _add_columns(weather: SiteWeather, column: Mapping[str, np.ndarray]) -> None:
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
    humid = _dew_point(column, weather.warnings)
    weather.add("ambient_dew_point_temperature", humid, 'column "x, RF, p and t"')
    weather.warnings.append(WIND_WARNING)


def _dew_point(column: Mapping[str, np.ndarray], warnings: list[str]) -> np.ndarray:
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
