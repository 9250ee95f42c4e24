"""Records of every shape that plants deliver, small, as case files: what the matrix of commands is run on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from builders.record_edits import without
from hygrokf.cases.case_file import read_case
from hygrokf.cases.synthetic import LATITUDE_DEG, LONGITUDE_DEG, synthetic_turbine, write_case
from hygrokf.data.record import Record, Series
from hygrokf.texts.wording import stamp_text

DAYS = 5.0
DAY_S = 86400.0
SIGNALS = (
    "cabinet_temperature", "cabinet_relative_humidity", "ambient_temperature", "ambient_relative_humidity",
    "active_power",
    "preheating",
)  # fmt: skip
UNITS = {"temperature": "K", "humidity": "1", "power": "W", "preheating": "1"}
MINUTE_S, TEN_MINUTES_S, HOUR_S = 60.0, 600.0, 3600.0


def base_record(folder: Path, seed: int = 11, days: float = DAYS) -> Record:
    """Five days of a synthetic turbine."""
    made = read_case(write_case(synthetic_turbine(seed=seed, days=days), folder / f"synthetic-{seed}"))
    return replace(made, series=tuple(s for s in made.series if s.signal in SIGNALS), warnings=())


def write_record(record: Record, folder: Path) -> Path:
    """A record as a case file with one file a signal; returns the case's path."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f'name = "{folder.name}"', f'provenance = "{record.provenance}"']
    lines += [f"rated_power_kW = {record.rated_power_W / 1e3}"]
    lines += ["[site]", f"latitude_deg = {LATITUDE_DEG}", f"longitude_deg = {LONGITUDE_DEG}"]
    for series in record.series:
        unit = UNITS[series.signal.rpartition("_")[2]]
        rows = [f"{stamp_text(t)},{v!r}" for t, v in zip(*(a.tolist() for a in series.known), strict=True)]
        (folder / f"{series.signal}.csv").write_text("\n".join(["time,value", *rows, ""]))
        means = f'stamp = "end"\ninterval = "{series.interval_s:g}s"\n' if series.interval_s else ""
        lines.append(
            f'[[source]]\nfile = "{series.signal}.csv"\ntime = "time"\n{means}'
            f'signals.{series.signal} = {{ column = "value", unit = "{unit}" }}'
        )
    if record.until_s is not None:
        lines.append(f'[identification]\nuntil = "{stamp_text(record.until_s)}"')
    case = folder / "case.toml"
    case.write_text("\n".join([*lines, ""]))
    return case


# -- shapes --------------------------------------------------------------------------------------------------
def _changed(record: Record, change: Callable[[Series], Series]) -> Record:
    return replace(record, series=tuple(change(s) for s in record.series))


def _power(record: Record, value: Callable[[np.ndarray], np.ndarray]) -> Record:
    return _changed(record, lambda s: replace(s, value=value(s.value)) if s.signal == "active_power" else s)


def ordinary(record: Record) -> Record:
    return record


def no_standstill(record: Record) -> Record:
    """It feeds in 50 kW at least, never the same twice: a power that stands still looks like a frozen
    sensor."""
    return _power(record, lambda watt: np.maximum(watt, 5e4 + 100.0 * (np.arange(len(watt)) % 7)))


def only_standstill(record: Record) -> Record:
    return _power(record, lambda watt: -5e3 + 0.0 * watt)


def no_power(record: Record) -> Record:
    return without(record, "active_power")


def constant_power(record: Record) -> Record:
    return _power(record, lambda watt: 1e6 + 0.0 * watt)


def no_humidity(record: Record) -> Record:
    return without(record, "cabinet_relative_humidity", "ambient_relative_humidity")


def no_ambient_humidity(record: Record) -> Record:
    return without(record, "ambient_relative_humidity")


def _every(record: Record, step_s: float) -> Record:
    """All signals at full steps; means over them where they were means."""

    def at(series: Series) -> Series:
        first = np.ceil(series.time[0] / step_s) * step_s
        time = np.arange(first, series.time[-1], step_s)
        value = np.interp(time, *series.known)
        return replace(series, time=time, value=value, interval_s=step_s if series.interval_s else 0.0)

    return _changed(record, at)


def hourly(record: Record) -> Record:
    return _every(record, HOUR_S)


def one_minute(record: Record) -> Record:
    """A day and a half, every minute."""
    short = record.window(record.start_s, record.start_s + 1.5 * DAY_S)
    return replace(_every(short, MINUTE_S), until_s=short.start_s + 1.2 * DAY_S)


def eight_readings(record: Record) -> Record:
    """The cabinet was read eight times."""

    def few(series: Series) -> Series:
        if not series.signal.startswith("cabinet_"):
            return series
        kept = np.linspace(0, len(series) - 1, 8).astype(int)
        return replace(series, time=series.time[kept], value=series.value[kept])

    return _changed(record, few)


def a_year_s_gap(record: Record) -> Record:
    """The middle of the record moved later by 400 days: all sources are silent between its two parts."""
    middle = record.start_s + 0.5 * (record.until_s - record.start_s)
    early, late = record.window(-np.inf, middle), record.window(middle + 1.0, np.inf)

    def joined(series: Series) -> Series:
        before = early[series.signal]
        # a mean whose interval begins before the gap belongs to neither part
        after = late[series.signal]
        there = after.time - after.interval_s >= middle
        time = np.concatenate([before.time, after.time[there] + 400.0 * DAY_S])
        return replace(series, time=time, value=np.concatenate([before.value, after.value[there]]))

    return replace(_changed(record, joined), until_s=record.until_s + 400.0 * DAY_S)


def quantised(record: Record) -> Record:
    """Every signal on a coarse grid: 0.5 K, 1 %, a twentieth of the rated power."""
    grid = {"temperature": 0.5, "humidity": 0.01, "power": 1e5, "preheating": 1.0}

    def coarse(series: Series) -> Series:
        step = grid[series.signal.rpartition("_")[2]]
        return replace(series, value=np.round(series.value / step) * step, resolution=step)

    return _changed(record, coarse)


SHAPES: dict[str, Callable[[Record], Record]] = {
    one.__name__: one
    for one in (
        ordinary, no_standstill, only_standstill, no_power, constant_power, no_humidity, no_ambient_humidity,
        hourly,
        one_minute, eight_readings, a_year_s_gap, quantised,
    )
}  # fmt: skip
