"""Clocks of a record's sources: which signals share a clock, and how its stamps are corrected."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import summer_time


@dataclass(frozen=True)
class Shift:
    """A correction of one source's stamps: `seconds` are added, with `summer` only during summer time."""

    source: str
    seconds: float
    summer: bool = False


def sources(record: Record) -> dict[str, tuple[str, ...]]:
    """Files of a record and the signals of each file, which share a clock."""
    signals_by_file: dict[str, list[str]] = {}
    for series in record.series:
        signals_by_file.setdefault(series.file, []).append(series.signal)
    return {name: tuple(signals) for name, signals in signals_by_file.items()}


def shifted(record: Record, *shifts: Shift) -> Record:
    """The record with its sources' stamps corrected."""
    for shift in shifts:
        signals = sources(record).get(shift.source, ())
        record = record.replace_series(*(_shift_series(record[name], record, shift) for name in signals))
    return record


def _shift_series(series: Series, record: Record, shift: Shift) -> Series:
    if not shift.summer:
        return replace(series, time=series.time + shift.seconds)
    # by stamps that run ahead, summer time would end too late: they are corrected before the look-up
    local = series.time + min(shift.seconds, 0.0)
    time = series.time + shift.seconds * summer_time(local, in_america(record))
    new = np.concatenate([[True], time[1:] > np.maximum.accumulate(time)[:-1]])
    return replace(series, time=time[new], value=series.value[new])


def in_america(record: Record) -> bool:
    """Whether the site's summer time is North America's, roughly; Europe's counts elsewhere and where no site
    is stated."""
    site = record.site
    return site is not None and site.latitude_deg > 0.0 and -170.0 < site.longitude_deg < -40.0
