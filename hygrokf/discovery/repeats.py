"""Readings that repeat the readings of the previous day, a fault of the logger.  They are removed before the
search for causes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import DAY_S
from hygrokf.discovery.residuals import run_lengths
from hygrokf.texts.discovery_codes import DiscoveryCode
from hygrokf.texts.statement import Statement, Value
from hygrokf.texts.wording import day_text

SHORTEST_REPEAT_S = 3600.0
"""[s] shortest stretch of repeated readings."""
FEWEST_REPEATED = 6
"""Fewest readings of a stretch of repeated readings."""
BEYOND_CHANCE = 1.5
"""Least ratio of a stretch's length to that of the longest chance repetition, which is measured at other lags
near a day."""
LONGEST_PAUSE_S = 7200.0
"""[s] longest pause within a stretch: readings that were missing on the previous day."""
OTHERS = 40
"""Number of other lags at which chance repetitions are measured."""
MOVING_SHARE = 0.25
"""[1] share of steps with a change below which readings stand still: saturated or frozen readings repeat at
every lag."""


def repeats(series: Series) -> list[tuple[float, float]]:
    """Stretches (first, last) [s] of a series over which the readings equal the readings 24 h earlier."""
    is_known = ~series.missing
    time, value = series.time[is_known], series.value[is_known]
    if len(time) < 3:
        return []
    step = float(np.median(np.diff(time)))
    day = round(DAY_S / step)
    grid_index = np.round((time - time[0]) / step).astype(np.int64)
    if day < 2 or abs(day * step - DAY_S) > 1.0 or grid_index[-1] <= day:
        return []
    grid = np.full(int(grid_index[-1]) + 1, np.nan)
    grid[grid_index] = value
    tolerance = 1e-6 * float(np.nanstd(value))
    other_lags = (day + side * k for k in range(2, 2 + OTHERS // 2) for side in (-1, 1))
    chance = max((b - a for lag in other_lags for a, b in _equal(grid, lag, tolerance)), default=0)
    fewest = max(FEWEST_REPEATED, SHORTEST_REPEAT_S / step, BEYOND_CHANCE * chance)
    return [
        (float(time[0] + step * (day + a)), float(time[0] + step * (day + b - 1)))
        for a, b in _equal(grid, day, tolerance)
        if b - a >= fewest
    ]


def _equal(grid: np.ndarray, lag: int, tolerance: float) -> list[tuple[int, int]]:
    """Runs [a, b) of moving values that equal the values `lag` steps earlier; a, b count from `lag` on."""
    if not 0 < lag < len(grid):
        return []
    current, earlier = grid[lag:], grid[:-lag]
    return [
        (a, b)
        for a, b in run_lengths(np.abs(current - earlier) < tolerance)
        if b - a > 1 and np.mean(np.diff(current[a:b]) != 0.0) >= MOVING_SHARE
    ]


def without_repeats(record: Record) -> tuple[Record, dict[str, list[tuple[float, float]]]]:
    """The record without the cabinet's repeated readings, and the stretches [s] of such readings by signal.

    A logger repeats all its signals: the stretches of one signal, with the pauses between them, are removed
    from every signal of the same source.
    """
    cabinet_series = [series for series in record.series if series.signal.startswith("cabinet_")]
    spans = {series.signal: found for series in cabinet_series if (found := repeats(series))}
    for series in cabinet_series if spans else ():
        value = series.value.copy()
        spans_of_source = [
            span
            for other in cabinet_series
            if other.source.split(",")[0] == series.source.split(",")[0]
            for span in spans.get(other.signal, ())
        ]
        for first, last in joined(spans_of_source, LONGEST_PAUSE_S):
            value[(series.time >= first - 1.0) & (series.time <= last + 1.0)] = np.nan
        record = record.replace_series(replace(series, value=value))
    return record, spans


def joined(spans: Iterable[Sequence[float]], pause_s: float = 0.0) -> list[tuple[float, float]]:
    """Stretches in order, merged where they overlap or are separated by at most `pause_s`."""
    merged: list[tuple[float, float]] = []
    for first, last in sorted(map(tuple, spans)):
        if merged and first - merged[-1][1] <= pause_s:
            merged[-1] = (merged[-1][0], max(last, merged[-1][1]))
        else:
            merged.append((first, last))
    return merged


def repeated_statement(spans: Mapping[str, Sequence[tuple[float, float]]]) -> Statement:
    """The statement of repeated readings, for the signal with most stretches."""
    name, stretches = max(spans.items(), key=lambda pair: len(pair[1]))
    days = tuple(dict.fromkeys(day_text(first) for first, _ in stretches))
    values: dict[str, Value] = {"signal": name, "days": days[:3]}
    values["hours"] = sum(last - first for first, last in stretches) / 3600.0
    if len(days) > 3:
        return DiscoveryCode.READINGS_REPEATED_OFTEN(**values, more=len(days) - 3)
    return DiscoveryCode.READINGS_REPEATED(**values)
