"""Read Open-Meteo, a service of weather and reanalysis data: hourly values of one place as JSON or CSV."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hygrokf.data.columns import Notation, Places, TableFault, frame_table
from hygrokf.data.numbers import UNKNOWN_MEANING
from hygrokf.data.record import Record, Site
from hygrokf.data.table_readers import csv_rows
from hygrokf.data.timestamps import HOUR_S
from hygrokf.texts.wording import stamp_text
from hygrokf.weather.archive import only_content
from hygrokf.weather.site_weather import (
    SiteWeather,
    Variable,
    WeatherField,
    dew_point_of,
    require_temperature,
    short_name,
)

_VARIABLES = {
    "temperature_2m": Variable("ambient_temperature", "°C"),
    "dew_point_2m": Variable("ambient_dew_point_temperature", "°C", names=("dewpoint_2m",)),
    "relative_humidity_2m": Variable(
        "ambient_relative_humidity", "%", part=True, names=("relativehumidity_2m",)
    ),
    "surface_pressure": Variable("ambient_pressure", "hPa"),
    "cloud_cover": Variable("cloud_cover", "%", names=("cloudcover",)),
    "shortwave_radiation": Variable("global_horizontal_irradiance", "W/m²", mean=True),
    "diffuse_radiation": Variable("diffuse_horizontal_irradiance", "W/m²", mean=True),
    "direct_normal_irradiance": Variable("direct_normal_irradiance", "W/m²", mean=True),
    "precipitation": Variable("rain", "mm", mean=True),
    # no interpolation: a straight line between two directions may turn the wrong way
    "speed": Variable("wind_speed", "km/h"),
    "direction": Variable("wind_direction", "°"),
}
"""Name of a field at the service → its meaning, with `names` from before 2023; "speed" and "direction" stand
for the wind at the height that is read."""
_META = ("latitude", "longitude", "elevation", "utc_offset_seconds")
_WIND = re.compile(r"wind_?(speed|direction)_(\d+)m")
PREFERRED_WIND_M = 100.0
"""[m] preferred height of the wind; of several heights the nearest one on a logarithmic scale is read."""


def read_open_meteo(path: str | os.PathLike[str]) -> Record:
    """Read ambient signals from hourly values of Open-Meteo, in SI units and UTC.

    path: JSON or CSV, also as gzip. Units are those that the file states (wind in km/h unless requested
        otherwise).

    Stamps are at the fixed offset `utc_offset_seconds` of the file, which is that of the day of the request:
    the service knows no summer time. Stamps of `timeformat=unixtime` are UTC. Temperature, humidity,
    pressure, wind and cloud are instants; radiation and precipitation belong to the hour that ends at the
    stamp. Without `dew_point_2m` the dew point is computed from `relative_humidity_2m` over water. The
    record's site has the `elevation` to which the service has converted temperatures.

    Raises TableFault with every fault.
    """
    file = Path(path)
    content, digest = only_content(file, ("json", "csv"), "JSON or CSV of Open-Meteo")
    weather = (_weather_of_json if content.kind == "json" else _weather_of_csv)(file.name, content.data)
    values = weather.value
    if "dew_point_2m" not in values and {"temperature_2m", "relative_humidity_2m"} <= set(values):
        dew_point = dew_point_of(values["relative_humidity_2m"], values["temperature_2m"])
        weather.add("ambient_dew_point_temperature", dew_point, "relative_humidity_2m")
    record = weather.record(digest)
    no_temperature = "no temperature_2m: add it to hourly=… in the request URL"
    return require_temperature(record, no_temperature, "dew_point_2m or relative_humidity_2m")


# --- layouts ---------------------------------------------------------------------------------


def _weather_of_json(file: str, data: bytes) -> SiteWeather:
    """Read the weather from JSON. Raises TableFault."""
    try:
        content = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as fault:
        raise TableFault(f"cannot be read as JSON ({fault}): cut short? fetch it again") from None
    if isinstance(content, list):
        raise TableFault(f"holds {len(content)} places; expected one: write each into a file of its own")
    hourly, units = content.get("hourly"), content.get("hourly_units")
    if not isinstance(hourly, dict) or not isinstance(units, dict) or "time" not in hourly:
        raise TableFault(
            "expected the keys hourly, with time in it, and hourly_units; add hourly=temperature_2m (and "
            "other variables) to the request URL"
        )
    columns = {str(name): column for name, column in hourly.items() if isinstance(column, list)}
    stamp_count = len(columns.get("time", []))
    faults = [
        f"{name}: {len(column)} values for {stamp_count} stamps; fetch the file again"
        for name, column in columns.items()
        if len(column) != stamp_count
    ]
    if faults:
        raise TableFault(*faults)
    place_and_offset = [content.get(name) for name in _META]
    return _weather(file, place_and_offset, columns, {str(name): str(unit) for name, unit in units.items()})


def _weather_of_csv(file: str, data: bytes) -> SiteWeather:
    """Read the weather from CSV. Raises TableFault."""
    rows = [cells for _, cells in csv_rows(data, "utf-8-sig")]
    column_names = [cell.strip() for cell in rows[0]] if rows else []
    if "location_id" in column_names:
        raise TableFault("holds several places; expected one: write each into a file of its own")
    if "utc_offset_seconds" not in column_names or len(rows) < 2:
        raise TableFault(
            "expected CSV of Open-Meteo, whose first line names latitude, longitude, elevation, "
            f"utc_offset_seconds; found {', '.join(column_names[:6]) or 'nothing'}"
        )
    stated_values = dict(zip(column_names, rows[1], strict=False))
    place_and_offset = [stated_values.get(name) for name in _META]
    header_line = next(
        (line_number for line_number, row in enumerate(rows[2:], 2) if row and row[0].strip() == "time"), None
    )
    if header_line is None:
        raise TableFault(
            'expected a header line beginning with "time" below the first two lines, found none; add '
            "hourly=temperature_2m (and other variables) to the request URL"
        )
    names, units = [], {}
    for cell in rows[header_line]:
        name, _, unit_text = cell.strip().partition(" (")
        names.append(name)
        units[name] = unit_text.removesuffix(")")
    # further blocks, such as daily values, follow after an empty line
    later_lines = range(header_line + 1, len(rows))
    end_line = next((number for number in later_lines if not any(rows[number])), len(rows))
    value_rows = rows[header_line + 1 : end_line]
    for line_number, row in enumerate(value_rows, header_line + 2):
        if len(row) != len(names):
            raise TableFault(
                f"line {line_number}: expected {len(names)} cells, found {len(row)}: cut short? fetch the "
                "file again"
            )
    columns = {name: [row[column] for row in value_rows] for column, name in enumerate(names)}
    return _weather(file, place_and_offset, columns, units)


def _weather(
    file: str,
    place_and_offset: Sequence[str | float | None],
    columns: Mapping[str, Sequence[Any]],
    units: Mapping[str, str],
) -> SiteWeather:
    """Return the weather of columns by the service's names.

    place_and_offset: latitude, longitude [deg], elevation [m], and offset of the stamps from UTC [s]. units:
        of the columns.
    """
    import pandas as pd

    try:
        latitude, longitude, offset = (float(place_and_offset[index]) for index in (0, 1, 3))  # type: ignore[arg-type]
        elevation = float(place_and_offset[2]) if place_and_offset[2] is not None else math.nan
        site = Site(latitude, longitude, elevation if math.isfinite(elevation) else None)
    except (TypeError, ValueError) as fault:
        raise TableFault(
            "expected latitude, longitude, elevation and utc_offset_seconds as numbers, found "
            f"{', '.join(map(str, place_and_offset))} ({fault})"
        ) from None
    if not -14.0 * HOUR_S <= offset <= 14.0 * HOUR_S:
        raise TableFault(f"utc_offset_seconds: expected -50400 … 50400, found {offset:g}")
    stamps = pd.Series(columns.get("time", []), dtype=object)
    unix_seconds = pd.to_numeric(stamps, errors="coerce")
    if len(stamps) and unix_seconds.notna().all():
        stamps, offset = pd.to_datetime(unix_seconds, unit="s"), 0.0
    field_names = {
        name: field_name for name in columns if (field_name := short_name(_VARIABLES, name)) is not None
    }
    winds = {name: match for name in columns if (match := _WIND.fullmatch(name))}
    heights = {int(match[2]) for match in winds.values() if match[1] == "speed"}
    height = min(heights, key=lambda height_m: abs(math.log(height_m / PREFERRED_WIND_M)), default=None)
    field_names |= {name: match[1] for name, match in winds.items() if int(match[2]) == height}
    frame = pd.DataFrame({name: columns[name] for name in field_names}, index=range(len(stamps)))
    row_places = Places("row", lambda rows: [int(row) + 1 for row in rows])
    notation = Notation(timezone="UTC", decimal=".")
    table = frame_table(
        frame, dict.fromkeys(field_names, UNKNOWN_MEANING), stamps, "time", row_places, notation
    )
    fields = {
        field_name: WeatherField(table.values[name], name, units.get(name, ""))
        for name, field_name in field_names.items()
    }
    time, warnings = table.time - offset, list(table.warnings)
    if offset:
        warnings.append(
            f"stamps are read at the fixed offset {offset / HOUR_S:+g} h that the file states, in summer and "
            "winter; ask for timezone=GMT if a program between has changed them"
        )
    steps = np.diff(time)
    if len(steps) and (np.abs(steps - HOUR_S) > 1.0).any():
        index = int(np.argmax(np.abs(steps - HOUR_S) > 1.0))
        raise TableFault(
            f"time: expected an hour between stamps, found {steps[index]:g} s after "
            f"{stamp_text(time[index])}: the stamps follow summer time, or hours were removed; ask for "
            "timezone=GMT and hourly=…"
        )
    return SiteWeather(
        file, time, fields, _VARIABLES, site=site,
        height_m=None if height is None else float(height), warnings=warnings,
    )  # fmt: skip
