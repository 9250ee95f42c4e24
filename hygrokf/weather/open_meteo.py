"""Read Open-Meteo, a service of weather and reanalysis: hourly values of one place as JSON or CSV."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hygrokf.data.columns import Notation, Places, Table, TableFault, table_of
from hygrokf.data.record import Record, Site
from hygrokf.data.table_readers import csv_rows
from hygrokf.data.timestamps import HOUR_S, stamp_text
from hygrokf.weather.archive import only_content
from hygrokf.weather.site_weather import SiteWeather, converted, dew_point_of, place_text

_PLAIN = {
    # name: signal, whether it belongs to the hour before its stamp
    "temperature_2m": ("ambient_temperature", False),
    "dew_point_2m": ("ambient_dew_point_temperature", False),
    "surface_pressure": ("ambient_pressure", False),
    "cloud_cover": ("cloud_cover", False),
    "shortwave_radiation": ("global_horizontal_irradiance", True),
    "diffuse_radiation": ("diffuse_horizontal_irradiance", True),
    "direct_normal_irradiance": ("direct_normal_irradiance", True),
    "precipitation": ("rain", True),
}
_FORMER = {
    "dewpoint_2m": "dew_point_2m", "relativehumidity_2m": "relative_humidity_2m", "cloudcover": "cloud_cover",
}  # fmt: skip
"""Names of the service before 2023 -> today's."""
_META = ("latitude", "longitude", "elevation", "utc_offset_seconds")
_WIND = re.compile(r"wind_?(speed|direction)_(\d+)m")
PREFERRED_WIND_M = 100.0
"""[m] of several heights of the wind the nearest to this one, on a logarithmic scale, is taken."""


@dataclass(frozen=True)
class Answer:
    """What the service answered for one site.

    table: of the columns that are used, its time by the clock of the file. offset_s: [s] of that clock.
    unit: name -> its unit, that of "time" included.
    """

    site: Site
    offset_s: float
    table: Table
    unit: Mapping[str, str]


def read_open_meteo(path: str | os.PathLike[str]) -> Record:
    """Record of ambient signals from hourly values of Open-Meteo, in SI units and UTC.

    path: JSON or CSV, as gzip too. Units are those that the file states (wind is in km/h unless asked for
        otherwise).

    Stamps are at the fixed offset `utc_offset_seconds` of the file, which is that of the day of the request:
    the service knows no summer time; stamps of `timeformat=unixtime` are UTC.  Temperature, humidity,
    pressure, wind and cloud are instants; radiation and precipitation belong to the hour that ends at the
    stamp.  Without `dew_point_2m` the dew point is computed from `relative_humidity_2m` over water.  The
    record's site has the `elevation` to which the service has converted temperatures.

    Raises TableFault with every fault.
    """
    file = Path(path)
    one, digest = only_content(file, ("json", "csv"), "JSON or CSV of Open-Meteo")
    answer = _json_answer(one.data) if one.kind == "json" else _csv_answer(one.data)
    warnings = list(answer.table.warnings)
    time = _time(answer, warnings)
    place = place_text(answer.site.latitude_deg, answer.site.longitude_deg)
    weather = SiteWeather(file.name, time, place, warnings=warnings)
    _add_columns(weather, answer)
    return weather.record(answer.site, digest, "no temperature_2m: ask for it in hourly=…")


# --- layouts ---------------------------------------------------------------------------------


def _json_answer(data: bytes) -> Answer:
    try:
        found = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as broken:
        raise TableFault(f"cannot be read as JSON ({broken}): cut short? fetch it again") from None
    if isinstance(found, list):
        raise TableFault(f"holds {len(found)} places; expected one: write each into a file of its own")
    hourly, units = found.get("hourly"), found.get("hourly_units")
    if not isinstance(hourly, dict) or not isinstance(units, dict) or "time" not in hourly:
        raise TableFault("expected hourly and hourly_units with time in them; ask for hourly=…")
    columns = {str(name): column for name, column in hourly.items() if isinstance(column, list)}
    count = len(columns.get("time", []))
    faults = [
        f"{name}: {len(column)} values for {count} stamps; fetch the file again"
        for name, column in columns.items()
        if len(column) != count
    ]
    if faults:
        raise TableFault(*faults)
    meta = [found.get(name) for name in _META]
    return _answer(meta, columns, {str(name): str(unit) for name, unit in units.items()})


def _csv_answer(data: bytes) -> Answer:
    rows = [cells for _, cells in csv_rows(data, "utf-8-sig")]
    head = [cell.strip() for cell in rows[0]] if rows else []
    if "location_id" in head:
        raise TableFault("holds several places; expected one: write each into a file of its own")
    if "utc_offset_seconds" not in head or len(rows) < 2:
        raise TableFault(
            "expected CSV of Open-Meteo, whose first line names latitude, longitude, elevation, "
            f"utc_offset_seconds; found {', '.join(head[:6]) or 'nothing'}"
        )
    stated = dict(zip(head, rows[1], strict=False))
    meta = [stated.get(name) for name in _META]
    begin = next((i for i, row in enumerate(rows[2:], 2) if row and row[0].strip() == "time"), None)
    if begin is None:
        raise TableFault("no line that begins with time: ask for hourly=…")
    names, unit = [], {}
    for cell in rows[begin]:
        name, _, rest = cell.strip().partition(" (")
        names.append(name)
        unit[name] = rest.removesuffix(")")
    # further blocks, such as daily values, follow after an empty line
    end = next((i for i in range(begin + 1, len(rows)) if not any(rows[i])), len(rows))
    body = rows[begin + 1 : end]
    wrong = [i for i, row in enumerate(body) if len(row) != len(names)]
    if wrong:
        raise TableFault(
            f"line {begin + 2 + wrong[0]}: expected {len(names)} cells, found {len(body[wrong[0]])}: "
            "cut short? fetch the file again"
        )
    return _answer(meta, {name: [row[place] for row in body] for place, name in enumerate(names)}, unit)


def _answer(
    meta: Sequence[str | float | None], columns: Mapping[str, Sequence[Any]], unit: Mapping[str, str]
) -> Answer:
    """The answer from latitude, longitude, elevation, offset, and its columns."""
    import pandas as pd

    try:
        latitude, longitude, offset = (float(meta[place]) for place in (0, 1, 3))  # type: ignore[arg-type]
        elevation = float(meta[2]) if meta[2] is not None else math.nan
        site = Site(latitude, longitude, elevation if math.isfinite(elevation) else None)
    except (TypeError, ValueError) as broken:
        raise TableFault(
            "expected latitude, longitude, elevation and utc_offset_seconds as numbers, found "
            f"{', '.join(map(str, meta))} ({broken})"
        ) from None
    if not -14.0 * HOUR_S <= offset <= 14.0 * HOUR_S:
        raise TableFault(f"utc_offset_seconds: expected -50400 … 50400, found {offset:g}")
    stamps = pd.Series(columns.get("time", []), dtype=object)
    if not len(stamps):
        raise TableFault("has no hour in it: fetch it again")
    unix = pd.to_numeric(stamps, errors="coerce")
    if unix.notna().all():
        stamps, offset = pd.to_datetime(unix, unit="s"), 0.0
    used = [
        name
        for name in columns
        if (own := _FORMER.get(name, name)) in {*_PLAIN, "relative_humidity_2m"} or _WIND.fullmatch(own)
    ]
    frame = pd.DataFrame({name: columns[name] for name in used})
    places = Places("row", lambda rows: [int(row) + 1 for row in rows])
    table = table_of(frame, used, stamps, "time", places, Notation(timezone="UTC", decimal="."), {})
    return Answer(site, offset, table, unit)


# --- values ----------------------------------------------------------------------------------


def _time(answer: Answer, warnings: list[str]) -> np.ndarray:
    """Stamps in UTC (T,) [s].  Raises TableFault where they are not hourly."""
    time = answer.table.time - answer.offset_s
    if answer.offset_s:
        warnings.append(
            f"stamps are read at the fixed offset {answer.offset_s / HOUR_S:+g} h that the file states, "
            "in summer and winter; ask for timezone=GMT if a program between has changed them"
        )
    steps = np.diff(time)
    if len(steps) and (np.abs(steps - HOUR_S) > 1.0).any():
        place = int(np.argmax(np.abs(steps - HOUR_S) > 1.0))
        raise TableFault(
            f"time: expected an hour between stamps, found {steps[place]:g} s after "
            f"{stamp_text(time[place])}: the stamps follow summer time, or hours were removed; ask for "
            "timezone=GMT and hourly=…"
        )
    return time


def _add_columns(weather: SiteWeather, answer: Answer) -> None:
    """Add the series of the columns that are used."""
    given = {_FORMER.get(name, name): name for name in answer.table.values}

    def value(own: str, signal: str) -> np.ndarray:
        name = given[own]
        return converted(name, answer.table.values[name], answer.unit.get(name, ""), signal, weather.faults)

    def add(own: str, signal: str, number: np.ndarray, **more: Any) -> None:
        remedy = f"the file states {answer.unit.get(given[own])}; fetch it again"
        weather.add(signal, number, given[own], remedy=remedy, **more)

    for own, (signal, mean) in _PLAIN.items():
        if own in given:
            add(own, signal, value(own, signal), mean=mean)
    if not {"dew_point_2m", "relative_humidity_2m"} & set(given):
        weather.warnings.append("no dew_point_2m and no relative_humidity_2m: this weather has no humidity")
    elif "dew_point_2m" not in given and "temperature_2m" in given:
        share = value("relative_humidity_2m", "ambient_relative_humidity")
        kelvin = value("temperature_2m", "ambient_temperature")
        add("relative_humidity_2m", "ambient_dew_point_temperature", dew_point_of(share, kelvin))
    winds = {own: match for own in given if (match := _WIND.fullmatch(own))}
    heights = sorted(
        {int(match[2]) for match in winds.values() if match[1] == "speed"},
        key=lambda height: abs(math.log(height / PREFERRED_WIND_M)),
    )
    for own, match in winds.items():
        if heights and int(match[2]) == heights[0]:
            # a straight line between two directions may turn the wrong way: they hold
            signal = f"wind_{match[1]}"
            add(own, signal, value(own, signal), height_m=float(heights[0]))
    if heights and heights[0] <= 10:
        weather.warnings.append(
            f"wind_speed is measured at {heights[0]} m, not at hub height: ask for wind_speed_100m"
        )
