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
"""Smallest ratio of a span's length to the longest repetition by chance, as measured at other lags near a
day."""
LONGEST_PAUSE_S = 7200.0
"""[s] longest pause within a stretch: readings that were missing on the previous day."""
OTHERS = 40
"""Number of other lags at which chance repetitions are measured."""
MOVING_SHARE = 0.25
"""[1] share of steps with a change below which readings count as constant; saturated or frozen readings
repeat at every lag."""


def repeats(series: Series) -> list[tuple[float, float]]:
    """Return the spans (first, last) [s] over which a series repeats its readings of 24 h earlier.

    A span must be longer than repetitions that occur by chance, as measured at other lags near a day.
    """
    is_known = ~series.missing
    time, value = series.time[is_known], series.value[is_known]
    if len(time) < 3:
        return []
    step = float(np.median(np.diff(time)))
    steps_per_day = round(DAY_S / step)
    grid_index = np.round((time - time[0]) / step).astype(np.int64)
    if steps_per_day < 2 or abs(steps_per_day * step - DAY_S) > 1.0 or grid_index[-1] <= steps_per_day:
        return []
    grid = np.full(int(grid_index[-1]) + 1, np.nan)
    grid[grid_index] = value
    tolerance = 1e-6 * float(np.nanstd(value))
    other_lags = (
        steps_per_day + sign * distance for distance in range(2, 2 + OTHERS // 2) for sign in (-1, 1)
    )
    longest_by_chance = max(
        (end - first for lag in other_lags for first, end in _equal(grid, lag, tolerance)), default=0
    )
    shortest_run = max(FEWEST_REPEATED, SHORTEST_REPEAT_S / step, BEYOND_CHANCE * longest_by_chance)
    return [
        (float(time[0] + step * (steps_per_day + first)), float(time[0] + step * (steps_per_day + end - 1)))
        for first, end in _equal(grid, steps_per_day, tolerance)
        if end - first >= shortest_run
    ]


def _equal(grid: np.ndarray, lag: int, tolerance: float) -> list[tuple[int, int]]:
    """Return the runs [first, end) in which a grid of values (n,) equals its values `lag` steps earlier.

    Positions count from `lag` on.  Runs in which the values hardly change are left out.
    """
    if not 0 < lag < len(grid):
        return []
    current, earlier = grid[lag:], grid[:-lag]
    return [
        (first, end)
        for first, end in run_lengths(np.abs(current - earlier) < tolerance)
        if end - first > 1 and np.mean(np.diff(current[first:end]) != 0.0) >= MOVING_SHARE
    ]


def without_repeats(record: Record) -> tuple[Record, dict[str, list[tuple[float, float]]]]:
    """Return the record without the cabinet's repeated readings, and their spans [s] by signal.

    A logger repeats all its signals, so a span found in one signal is removed from all signals of the same
    source; pauses between spans are removed too.
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
    """Return spans in order, merged where they overlap or lie at most `pause_s` [s] apart."""
    merged: list[tuple[float, float]] = []
    for first, last in sorted(map(tuple, spans)):
        if merged and first - merged[-1][1] <= pause_s:
            merged[-1] = (merged[-1][0], max(last, merged[-1][1]))
        else:
            merged.append((first, last))
    return merged


def repeated_statement(spans: Mapping[str, Sequence[tuple[float, float]]]) -> Statement:
    """Return the statement about repeated readings, for the signal with the most spans."""
    name, spans_of_signal = max(spans.items(), key=lambda pair: len(pair[1]))
    days = tuple(dict.fromkeys(day_text(first) for first, _ in spans_of_signal))
    values: dict[str, Value] = {"signal": name, "days": days[:3]}
    values["hours"] = sum(last - first for first, last in spans_of_signal) / 3600.0
    if len(days) > 3:
        return DiscoveryCode.READINGS_REPEATED_OFTEN(**values, more=len(days) - 3)
    return DiscoveryCode.READINGS_REPEATED(**values)
