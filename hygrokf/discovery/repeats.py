"""Readings that repeat those of the day before: a fault of the logger.  They are set aside before errors are
explained by physics."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import DAY_S
from hygrokf.discovery.residuals import run_lengths
from hygrokf.texts.discovery import DiscoveryCode
from hygrokf.texts.statement import Statement, Value
from hygrokf.texts.wording import day_text

SHORTEST_S = 3600.0
"""[s] shortest stretch."""
FEWEST_REPEATED = 6
"""Fewest readings of a stretch."""
BEYOND = 1.5
"""A stretch must be this many times as long as the longest that chance makes: that of readings which equal
readings some steps more or less than a day before."""
PAUSE_S = 7200.0
"""[s] between two stretches that belong to one: readings that were missing a day before."""
OTHERS = 40
"""Other lags that show what chance makes."""
MOVING = 0.25
"""[1] share of steps with a change below which readings stand still: saturated or frozen ones equal each
other anyway."""


def repeats(series: Series) -> list[tuple[float, float]]:
    """Stretches (first, last) [s] of a series over which its readings are those of 24 h before."""
    known = ~series.missing
    time, value = series.time[known], series.value[known]
    if len(time) < 3:
        return []
    step = float(np.median(np.diff(time)))
    day = round(DAY_S / step)
    place = np.round((time - time[0]) / step).astype(np.int64)
    if day < 2 or abs(day * step - DAY_S) > 1.0 or place[-1] <= day:
        return []
    grid = np.full(int(place[-1]) + 1, np.nan)
    grid[place] = value
    tolerance = 1e-6 * float(np.nanstd(value))
    others = (day + side * k for k in range(2, 2 + OTHERS // 2) for side in (-1, 1))
    chance = max((b - a for lag in others for a, b in _equal(grid, lag, tolerance)), default=0)
    fewest = max(FEWEST_REPEATED, SHORTEST_S / step, BEYOND * chance)
    return [
        (float(time[0] + step * (day + a)), float(time[0] + step * (day + b - 1)))
        for a, b in _equal(grid, day, tolerance)
        if b - a >= fewest
    ]


def _equal(grid: np.ndarray, lag: int, tolerance: float) -> list[tuple[int, int]]:
    """Runs [a, b) of moving values that equal those `lag` steps before, counted from `lag` on."""
    if not 0 < lag < len(grid):
        return []
    now, then = grid[lag:], grid[:-lag]
    return [
        (a, b)
        for a, b in run_lengths(np.abs(now - then) < tolerance)
        if b - a > 1 and np.mean(np.diff(now[a:b]) != 0.0) >= MOVING
    ]


def without_repeats(record: Record) -> tuple[Record, dict[str, list[tuple[float, float]]]]:
    """The record with the cabinet's repeated readings missing, and the stretches [s] by signal.

    A logger repeats all that it logs: the stretches of one signal go missing in every signal of its source,
    with the pauses between them.
    """
    own = [series for series in record.series if series.signal.startswith("cabinet_")]
    spans = {series.signal: found for series in own if (found := repeats(series))}
    for series in own if spans else ():
        value = series.value.copy()
        mine = [
            span
            for other in own
            if other.source.split(",")[0] == series.source.split(",")[0]
            for span in spans.get(other.signal, ())
        ]
        for first, last in joined(mine, PAUSE_S):
            value[(series.time >= first - 1.0) & (series.time <= last + 1.0)] = np.nan
        record = record.replace_series(replace(series, value=value))
    return record, spans


def joined(spans: Iterable[Sequence[float]], pause_s: float = 0.0) -> list[tuple[float, float]]:
    """Stretches in order; those that overlap, or have a pause of up to `pause_s` between them, are one."""
    found: list[tuple[float, float]] = []
    for first, last in sorted(map(tuple, spans)):
        if found and first - found[-1][1] <= pause_s:
            found[-1] = (found[-1][0], max(last, found[-1][1]))
        else:
            found.append((first, last))
    return found


def repeated_statement(spans: Mapping[str, Sequence[tuple[float, float]]]) -> Statement:
    """The repeats of the signal that has most of them."""
    name, stretches = max(spans.items(), key=lambda pair: len(pair[1]))
    days = tuple(dict.fromkeys(day_text(first) for first, _ in stretches))
    values: dict[str, Value] = {"signal": name, "days": days[:3]}
    values["hours"] = sum(last - first for first, last in stretches) / 3600.0
    if len(days) > 3:
        return DiscoveryCode.READINGS_REPEATED_OFTEN(**values, more=len(days) - 3)
    return DiscoveryCode.READINGS_REPEATED(**values)
