"""Readings that repeat those of the day before: a logger's fault, to be set aside before anything is explained by physics."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from hygrokf.discovery.residuals import run_lengths
from hygrokf.record import Record, Series

DAY_S = 86400.0
SHORTEST_S = 3.0 * 3600.0
"""[s] over which moving readings that equal those of the day before are no chance."""
MOVING = 0.25
"""[1] share of steps with a change below which readings stand still: saturated or frozen ones equal each other anyway."""


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
    found = []
    for a, b in run_lengths(np.abs(grid[day:] - grid[:-day]) < 1e-6 * np.nanstd(value)):
        part = grid[day + a : day + b]
        if (b - a) * step >= SHORTEST_S and np.mean(np.diff(part) != 0.0) >= MOVING:
            found.append((float(time[0] + step * (day + a)), float(time[0] + step * (day + b - 1))))
    return found


def without_repeats(record: Record) -> tuple[Record, dict[str, list[tuple[float, float]]]]:
    """The record with the cabinet's repeated readings missing, and the stretches [s] by signal."""
    spans = {}
    for series in record.series:
        if series.signal.startswith("cabinet_") and (found := repeats(series)):
            spans[series.signal] = found
            value = series.value.copy()
            for first, last in found:
                value[(series.time >= first - 1.0) & (series.time <= last + 1.0)] = np.nan
            record = record.replace_series(replace(series, value=value))
    return record, spans


def repeated_text(spans: dict[str, list[tuple[float, float]]]) -> str:
    """The repeats in one sentence."""
    name, found = max(spans.items(), key=lambda pair: len(pair[1]))
    days = list(dict.fromkeys(f"{datetime.fromtimestamp(first, UTC):%-d %B %Y}" for first, _ in found))
    more = f" and {len(days) - 3} more days" if len(days) > 3 else ""
    hours = sum(last - first for first, last in found) / 3600.0
    return (
        f"readings of {name.replace('_', ' ')} repeat those of the day before, {hours:.0f} h in all: "
        f"{', '.join(days[:3])}{more}; they were set aside"
    )
