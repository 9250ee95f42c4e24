"""Clocks of a record's sources: which signals share one, what a wrong one does to them, and how it is set right."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from hygrokf.record import Record, Series

HOUR_S = 3600.0


@dataclass(frozen=True)
class Shift:
    """A correction of one source's stamps: later by `seconds`, all year, or with `summer` in summer time alone."""

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


def in_america(record: Record) -> bool:
    """Whether the site's summer time is North America's; Europe's counts elsewhere and where no site is stated."""
    site = record.site
    return site is not None and site.latitude_deg > 0.0 and -170.0 < site.longitude_deg < -40.0


def summer_time(time: np.ndarray, america: bool = False) -> np.ndarray:
    """Whether summer time holds (T,) at instants [s] of UTC.

    Europe: from 01:00 UTC of March's last Sunday to that of October's.  North America: from 08:00 UTC of March's second
    Sunday to 07:00 UTC of November's first, the hours of its central zone.
    """
    years = np.asarray(time).astype("datetime64[s]").astype("datetime64[Y]").astype(int) + 1970
    summer = np.zeros(len(time), dtype=bool)
    for year in np.unique(years):
        begin, end = _turns(int(year), america)
        summer |= (time >= begin) & (time < end)
    return summer


def turns_within(record: Record) -> bool:
    """Whether the clocks were changed within the record."""
    ends = summer_time(np.arange(record.start_s, record.end_s, 24.0 * HOUR_S), in_america(record))
    return bool(ends.any() and not ends.all())


@lru_cache(maxsize=64)
def _turns(year: int, america: bool) -> tuple[float, float]:
    """Beginning and end of summer time [s]."""
    if america:
        return _sunday(year, 3, 1) + 8.0 * HOUR_S, _sunday(year, 11, 0) + 7.0 * HOUR_S
    return _sunday(year, 3, -1) + HOUR_S, _sunday(year, 10, -1) + HOUR_S


def _sunday(year: int, month: int, which: int) -> float:
    """Midnight UTC of a month's Sunday [s], counted from 0, or from its end with −1."""
    first = np.datetime64(f"{year}-{month:02d}-01", "D")
    days = np.arange(first, np.datetime64(first, "M") + 1, dtype="datetime64[D]")
    sundays = days[(days.astype(int) + 4) % 7 == 0]  # 1 January 1970 was a Thursday
    return float(sundays[which].astype("datetime64[s]").astype(int))
