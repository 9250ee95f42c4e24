"""Clocks of a record's sources: which signals share one, what a wrong one does to them, and how it is set
right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import HOUR_S, summer_time


@dataclass(frozen=True)
class Shift:
    """A correction of one source's stamps: later by `seconds`, all year, or with `summer` in summer time
    alone."""

    source: str
    seconds: float
    summer: bool = False


def sources(record: Record) -> dict[str, tuple[str, ...]]:
    """Files of a record and the signals that each of them brings: what has one clock."""
    found: dict[str, list[str]] = {}
    for series in record.series:
        found.setdefault(series.source.split(",")[0] or series.signal, []).append(series.signal)
    return {name: tuple(signals) for name, signals in found.items()}


def shifted(record: Record, shift: Shift) -> Record:
    """The record with one source's stamps corrected."""
    signals = sources(record).get(shift.source, ())
    return record.replace_series(*(_moved(record[name], record, shift) for name in signals))


def _moved(series: Series, record: Record, shift: Shift) -> Series:
    if not shift.summer:
        return replace(series, time=series.time + shift.seconds)
    # stamps are local: where they run ahead, summer time ends by them an hour late
    local = series.time + min(shift.seconds, 0.0)
    time = series.time + shift.seconds * summer_time(local, in_america(record))
    new = np.concatenate([[True], time[1:] > np.maximum.accumulate(time)[:-1]])
    return replace(series, time=time[new], value=series.value[new])


def cabinet_moved(record: Record, shifts: Sequence[Shift]) -> float:
    """Time [s] by which corrections that hold all year move the cabinet's readings."""
    known = sources(record)
    return sum(
        one.seconds
        for one in shifts
        if not one.summer and any(name.startswith("cabinet_") for name in known.get(one.source, ()))
    )


def in_america(record: Record) -> bool:
    """Whether the site's summer time is North America's; Europe's counts elsewhere and where no site is
    stated."""
    return record.site is not None and record.site.in_north_america


def turns_within(record: Record) -> bool:
    """Whether the clocks were changed within the record."""
    ends = summer_time(np.arange(record.start_s, record.end_s, 24.0 * HOUR_S), in_america(record))
    return bool(ends.any() and not ends.all())
