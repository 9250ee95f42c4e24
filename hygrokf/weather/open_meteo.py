"""Read Open-Meteo, a service of weather and reanalysis: hourly values of one place as JSON or CSV."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Series, Site
from hygrokf.data.signals import signal_named
from hygrokf.data.timestamps import HOUR_S
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K, dew_point, vapour_pressure
from hygrokf.weather.archive import contents
from hygrokf.weather.fields import impossible_range, saturation_doubt

_FAHRENHEIT = 5.0 / 9.0
_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "temperature": {"°C": (1.0, ZERO_CELSIUS_K), "°F": (_FAHRENHEIT, ZERO_CELSIUS_K - 32.0 * _FAHRENHEIT)},
    "share": {"%": (0.01, 0.0)},
    "pressure": {"hPa": (100.0, 0.0)},
    "speed": {
        "km/h": (1 / 3.6, 0.0), "m/s": (1.0, 0.0), "mp/h": (0.44704, 0.0), "mph": (0.44704, 0.0),
        "kn": (1852.0 / HOUR_S, 0.0),
    },
    "angle": {"°": (math.pi / 180.0, 0.0)},
    "irradiance": {"W/m²": (1.0, 0.0)},
    "depth": {"mm": (1.0, 0.0), "inch": (25.4, 0.0)},
}  # fmt: skip
"""Kind -> unit as the service writes it -> (factor, offset) to the SI unit (rain: mm)."""

_PLAIN = {
    # name: signal, kind, whether it belongs to the hour before its stamp
    "temperature_2m": ("ambient_temperature", "temperature", False),
    "dew_point_2m": ("ambient_dew_point_temperature", "temperature", False),
    "surface_pressure": ("ambient_pressure", "pressure", False),
    "cloud_cover": ("cloud_cover", "share", False),
    "shortwave_radiation": ("global_horizontal_irradiance", "irradiance", True),
    "diffuse_radiation": ("diffuse_horizontal_irradiance", "irradiance", True),
    "direct_normal_irradiance": ("direct_normal_irradiance", "irradiance", True),
    "precipitation": ("rain", "depth", True),
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
    """What the service answered for one place.

    stamps: as written. value: name -> (T,), NaN = missing. unit: name -> its unit, that of "time" included.
    """

    latitude_deg: float
    longitude_deg: float
    elevation_m: float | None
    offset_s: float
    stamps: tuple[str | float, ...]
    value: Mapping[str, np.ndarray]
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
    (one, *others), digest = contents(file)
    if others:
        raise TableFault(f"holds {len(others) + 1} files; expected one: unpack that of the site")
    if one.kind not in ("json", "csv"):
        raise TableFault(f"expected JSON or CSV of Open-Meteo, found {one.kind}")
    answer = _json_answer(one.data) if one.kind == "json" else _csv_answer(one.data)
    faults: list[str] = []
    warnings: list[str] = []
    time = _time(answer, faults, warnings)
    if faults:
        raise TableFault(*faults)
    place = f"{abs(answer.latitude_deg):.2f}° {'N' if answer.latitude_deg >= 0 else 'S'} " + (
        f"{abs(answer.longitude_deg):.2f}° {'E' if answer.longitude_deg >= 0 else 'W'}"
    )
    series = []
    for signal, (name, number, held, height_m) in _signals(answer, faults, warnings).items():
        row = signal_named(signal)
        finite = number[np.isfinite(number)]
        if not len(finite):
            warnings.append(f"{name}: no value, {signal} is left out")
            continue
        if beyond := impossible_range(finite, row):
            faults.append(f"{name}: {beyond}: the file states {answer.unit.get(name)}; fetch it again")
            continue
        source = f'{file.name}, column "{name}" at {place}'
        series.append(
            Series(signal, time, number, interval_s=HOUR_S if held else 0.0, source=source, height_m=height_m)
        )
    if "ambient_temperature" not in {made.signal for made in series} and not faults:
        faults.append("no temperature_2m: ask for it in hourly=…")
    if faults:
        raise TableFault(*faults)
    site = Site(answer.latitude_deg, answer.longitude_deg, answer.elevation_m)
    return Record(file.name, tuple(series), site, warnings=tuple(warnings), provenance=((file.name, digest),))


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
    stamps = columns.pop("time", [])
    faults = [
        f"{name}: {len(column)} values for {len(stamps)} stamps; fetch the file again"
        for name, column in columns.items()
        if len(column) != len(stamps)
    ]
    if faults:
        raise TableFault(*faults)
    value = {name: _numbers(name, column, faults) for name, column in columns.items() if _used(name)}
    meta = [found.get(name) for name in _META]
    if faults:
        raise TableFault(*faults)
    return _answer(meta, stamps, value, {str(name): str(unit) for name, unit in units.items()})


def _csv_answer(data: bytes) -> Answer:
    rows = list(csv.reader(io.StringIO(data.decode("utf-8-sig", "replace"))))
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
    faults: list[str] = []
    body = rows[begin + 1 : end]
    wrong = [i for i, row in enumerate(body) if len(row) != len(names)]
    if wrong:
        raise TableFault(
            f"line {begin + 2 + wrong[0]}: expected {len(names)} cells, found {len(body[wrong[0]])}: "
            "cut short? fetch the file again"
        )
    columns = {name: [row[place] for row in body] for place, name in enumerate(names)}
    value = {name: _numbers(name, columns[name], faults) for name in names[1:] if _used(name)}
    if faults:
        raise TableFault(*faults)
    stamps = [float(text) if text.isdigit() else text for text in columns["time"]]
    return _answer(meta, stamps, value, unit)


def _answer(
    meta: Sequence[str | float | None],
    stamps: Sequence[str | float],
    value: Mapping[str, np.ndarray],
    unit: Mapping[str, str],
) -> Answer:
    """The answer from latitude, longitude, elevation, offset, and its columns."""
    try:
        latitude, longitude, offset = (float(meta[place]) for place in (0, 1, 3))  # type: ignore[arg-type]
        elevation = float(meta[2]) if meta[2] is not None else math.nan
        Site(latitude, longitude)
    except (TypeError, ValueError) as broken:
        raise TableFault(
            "expected latitude, longitude, elevation and utc_offset_seconds as numbers, found "
            f"{', '.join(map(str, meta))} ({broken})"
        ) from None
    if not -14.0 * HOUR_S <= offset <= 14.0 * HOUR_S:
        raise TableFault(f"utc_offset_seconds: expected -50400 … 50400, found {offset:g}")
    height = elevation if math.isfinite(elevation) else None
    return Answer(latitude, longitude, height, offset, tuple(stamps), value, unit)


def _numbers(name: str, column: Sequence[str | float | None], faults: list[str]) -> np.ndarray:
    """Values (T,); null, NaN and empty cells are NaN."""
    made = np.full(len(column), math.nan)
    for place, cell in enumerate(column):
        if cell is None or (isinstance(cell, str) and not cell.strip()):
            continue
        try:
            made[place] = float(cell)
        except (TypeError, ValueError):
            faults.append(f'{name}: expected numbers, found "{cell}" in row {place + 1}')
            break
    return np.where(np.isfinite(made), made, math.nan)


def _used(name: str) -> bool:
    own = _FORMER.get(name, name)
    return own in _PLAIN or own == "relative_humidity_2m" or _WIND.fullmatch(own) is not None


# --- values ----------------------------------------------------------------------------------


def _time(answer: Answer, faults: list[str], warnings: list[str]) -> np.ndarray:
    """Stamps in UTC (T,) [s]."""
    if not answer.stamps:
        faults.append("has no hour in it: fetch it again")
        return np.zeros(0)
    if all(isinstance(one, int | float) for one in answer.stamps):
        time = np.array(answer.stamps, dtype=float)
    else:
        try:
            local = np.array(answer.stamps, dtype="datetime64[s]").astype(np.int64).astype(float)
        except ValueError:
            faults.append(f'time: expected stamps such as 2024-01-01T00:00, found "{answer.stamps[0]}"')
            return np.zeros(0)
        time = local - answer.offset_s
        if answer.offset_s:
            warnings.append(
                f"stamps are read at the fixed offset {answer.offset_s / HOUR_S:+g} h that the file states, "
                "in summer and winter; ask for timezone=GMT if a program between has changed them"
            )
    steps = np.diff(time)
    if len(steps) and (np.abs(steps - HOUR_S) > 1.0).any():
        place = int(np.argmax(np.abs(steps - HOUR_S) > 1.0))
        faults.append(
            f"time: expected an hour between stamps, found {steps[place]:g} s after {answer.stamps[place]}: "
            "the stamps follow summer time, or hours were removed; ask for timezone=GMT and hourly=…"
        )
    return time


def _signals(
    answer: Answer, faults: list[str], warnings: list[str]
) -> dict[str, tuple[str, np.ndarray, bool, float | None]]:
    """Signal -> name in the file, values (T,) in SI units, whether they belong to the hour, height [m]."""
    given = {_FORMER.get(name, name): name for name in answer.value}
    made: dict[str, tuple[str, np.ndarray, bool, float | None]] = {}
    for own, (signal, kind, held) in _PLAIN.items():
        if own in given:
            made[signal] = (given[own], _converted(answer, given[own], kind, faults), held, None)
    if "ambient_dew_point_temperature" not in made and "relative_humidity_2m" in given:
        name = given["relative_humidity_2m"]
        share = _converted(answer, name, "share", faults)
        if "ambient_temperature" in made:
            kelvin = made["ambient_temperature"][1]
            vapour = vapour_pressure(np.where(share > 0.0, np.minimum(share, 1.0), np.nan), kelvin)
            made["ambient_dew_point_temperature"] = (name, np.asarray(dew_point(vapour)), False, None)
    if "ambient_dew_point_temperature" not in made:
        warnings.append("no dew_point_2m and no relative_humidity_2m: this weather has no humidity")
    elif "ambient_temperature" in made:
        warnings += saturation_doubt(made["ambient_temperature"][1], made["ambient_dew_point_temperature"][1])
    heights = sorted(
        {int(match[2]) for name in answer.value if (match := _WIND.fullmatch(name)) and match[1] == "speed"},
        key=lambda height: abs(math.log(height / PREFERRED_WIND_M)),
    )
    for name in answer.value:
        match = _WIND.fullmatch(name)
        if match and heights and int(match[2]) == heights[0]:
            kind = "speed" if match[1] == "speed" else "angle"
            number = _converted(answer, name, kind, faults)
            # a straight line between two directions may turn the wrong way: they hold
            made[f"wind_{match[1]}"] = (name, number, False, float(heights[0]))
    if heights and heights[0] <= 10:
        warnings.append(
            f"wind_speed is measured at {heights[0]} m, not at hub height: ask for wind_speed_100m"
        )
    return made


def _converted(answer: Answer, name: str, kind: str, faults: list[str]) -> np.ndarray:
    """Values (T,) in the SI unit of their kind."""
    stated, known = answer.unit.get(name, "").strip(), _UNITS[kind]
    if stated not in known:
        faults.append(f'{name}: unknown unit "{stated}"; expected one of {", ".join(known)}')
        return np.full(len(answer.value[name]), math.nan)
    factor, offset = known[stated]
    return factor * answer.value[name] + offset
