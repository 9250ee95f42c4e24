"""Clocks of a record's sources: which signals share a clock, and how its stamps are corrected."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import summer_time


@dataclass(frozen=True)
class Shift:
    """A correction of one source's stamps.

    `seconds` are added to them; with `summer` only during summer time.
    """

    source: str
    seconds: float
    summer: bool = False


def sources(record: Record) -> dict[str, tuple[str, ...]]:
    """Return the files of a record and the signals of each file, which share a clock."""
    signals_by_file: dict[str, list[str]] = {}
    for series in record.series:
        signals_by_file.setdefault(series.file, []).append(series.signal)
    return {name: tuple(signals) for name, signals in signals_by_file.items()}


def shifted(record: Record, *shifts: Shift) -> Record:
    """Return the record with the stamps of some sources corrected."""
    for shift in shifts:
        signals_of_source = sources(record).get(shift.source, ())
        record = record.replace_series(
            *(_shift_series(record[name], record, shift) for name in signals_of_source)
        )
    return record


def _shift_series(series: Series, record: Record, shift: Shift) -> Series:
    """Return a series with corrected stamps; readings whose time would not increase are left out."""
    if not shift.summer:
        return replace(series, time=series.time + shift.seconds)
    # by stamps that run ahead, summer time would end too late: they are corrected before the look-up
    stamps = series.time + min(shift.seconds, 0.0)
    time = series.time + shift.seconds * summer_time(stamps, in_america(record))
    is_later = np.concatenate([[True], time[1:] > np.maximum.accumulate(time)[:-1]])
    return replace(series, time=time[is_later], value=series.value[is_later])


def in_america(record: Record) -> bool:
    """Whether the site follows North America's summer-time dates, roughly; Europe's count elsewhere and
    without a site."""
    site = record.site
    return site is not None and site.latitude_deg > 0.0 and -170.0 < site.longitude_deg < -40.0
