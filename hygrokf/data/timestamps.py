"""Stamps of readings: conversion of text and zones to seconds of UTC, durations, steps, summer time."""

from __future__ import annotations

import math
import re
import warnings as python_warnings
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta, timezone, tzinfo
from functools import lru_cache
from typing import TYPE_CHECKING, Any
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError, available_timezones

import numpy as np

from hygrokf.errors import suggestion
from hygrokf.texts.wording import stamp_text

if TYPE_CHECKING:
    import pandas

EARLIEST_S, LATEST_S = -3786825600.0, 7289654400.0
"""[s] start of 1850 and end of 2200: the accepted range of times."""
MINUTE_S, HOUR_S, DAY_S, WEEK_S = 60.0, 3600.0, 86400.0, 604800.0
_SECONDS = {"ms": 1e-3, "s": 1.0, "min": MINUTE_S, "h": HOUR_S, "d": DAY_S}
_FIXED_OFFSET = re.compile(r"([+-])(\d{2}):?(\d{2})$")
_ENDS_IN_OFFSET = re.compile(r"(?<=\d)\s*(?:[zZ]|[+-]\d{2}(?::?\d{2})?)\s*$")
_DATE_ALONE = re.compile(r"\d{4}[-/]\d{1,2}([-/]\d{1,2})?\s*$")
_HEADER_ZONE = re.compile(
    r"(?<![A-Z])(UTC|GMT|CES?T|MES?Z)(?:\s?([+-]\d{1,2}):?(\d{2})?)?(?![A-Z])", re.IGNORECASE
)
_CENTRAL_EUROPE_H = {"CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2}
EXCEL = "excel"
"""The `time_format` of Excel's serial days: days since 1899-12-30, with their fraction."""
STAMP_FORMATS = (
    "%d.%m.%Y %H:%M:%S", "%d.%m.%Y %H:%M", "%d.%m.%y %H:%M:%S", "%d.%m.%y %H:%M", "%d.%m.%Y",
    "%d/%m/%Y %H:%M:%S", "%d/%m/%Y %H:%M", "%d/%m/%y %H:%M:%S", "%d/%m/%y %H:%M",
    "%m/%d/%Y %H:%M:%S", "%m/%d/%Y %H:%M", "%m/%d/%y %H:%M:%S", "%m/%d/%y %H:%M",
    "%m/%d/%Y %I:%M:%S %p", "%m/%d/%y %I:%M:%S %p", "%m/%d/%Y %I:%M %p", "%m/%d/%y %I:%M %p",
    "%d/%m/%Y %I:%M:%S %p", "%d/%m/%y %I:%M:%S %p",
    "%d-%m-%Y %H:%M:%S", "%d-%m-%Y %H:%M", "%m-%d-%Y %H:%M:%S", "%m-%d-%Y %H:%M",
    "%d-%b-%Y %H:%M:%S", "%d-%b-%Y %H:%M", "%d %b %Y %H:%M:%S", "%Y.%m.%d %H:%M:%S", "%Y.%m.%d %H:%M",
    "%d.%m.%Y, %H:%M", "%d.%m.%Y, %H:%M:%S", "%Y%m%d %H%M", "%Y%m%d%H%M%S", "%Y%m%d%H", "%Y%m%d%H%M",
    "%Y%m%d %H:%M", EXCEL,
)  # fmt: skip
"""strptime formats of exports, besides ISO 8601."""
_EXCEL_DAYS = (20_000.0, 80_000.0)  # 1954 to 2119
_DURATION = re.compile(r"\s*(\d+(?:\.\d+)?)\s*(ms|s|min|h|d)\s*$")
_CAUSES = (
    ("spring", "autumn", "the clock follows summer time although its stamps are read at a fixed offset: "
     'state its zone, such as timezone = "Europe/Berlin"'),
    ("autumn", "spring", "the stamps carry summer-time offsets although the clock has no summer time: "
     "ignore them (ignore_offset = true, timezone = the clock's own fixed offset)"),
)  # fmt: skip
"""Season in which a clock lacks an hour, season in which an hour occurs twice, and the probable cause."""


def duration(text: str) -> float:
    """Seconds of a duration such as "500ms", "30s", "10min", "1h", "2d" [s].

    text: a number and one of ms, s, min, h, d. Raises ValueError for anything else.
    """
    match = _DURATION.match(text) if isinstance(text, str) else None
    if match is None:
        raise ValueError(f'expected a duration such as "30s", "10min" or "1h", found {text!r}')
    return float(match[1]) * _SECONDS[match[2]]


def whole_microseconds(seconds: float) -> float:
    """A time rounded to microseconds [s since 1970]: a database's timestamp gives back every bit of it."""
    return round(seconds * 1e6) / 1e6


def signed_duration(text: str) -> float:
    """Seconds of a duration with an optional sign, such as "-49min" or "+1h" [s]; raises ValueError as
    `duration` does."""
    if isinstance(text, str) and text[:1] in ("-", "+"):
        return (-1.0 if text[0] == "-" else 1.0) * duration(text[1:])
    return duration(text)


def zone_named(text: str) -> tzinfo:
    """Time zone of a case file: a fixed offset ("+02:00"), "UTC", or an IANA name.

    text: as written in the case file. Raises ValueError with the reason and the accepted forms.
    """
    if not isinstance(text, str) or not text.strip():
        raise ValueError(f'timezone must be text such as "+01:00" or "Europe/Berlin", not {text!r}')
    name = text.strip()
    if name.upper() in ("UTC", "Z", "GMT"):
        return UTC
    fixed = _FIXED_OFFSET.match(name)
    if fixed is not None:
        size = timedelta(hours=int(fixed[2]), minutes=int(fixed[3]))
        if size > timedelta(hours=14):
            raise ValueError(f'timezone "{name}" is beyond 14 hours')
        return timezone(size if fixed[1] == "+" else -size)
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise ValueError(
            f'unknown timezone "{name}": expected a fixed offset such as "+02:00", "UTC", or an '
            f'IANA name such as "Europe/Berlin"{suggestion(name, available_timezones())}'
        ) from None


def zone_in_header(text: str) -> str | None:
    """The zone named in the header of a column of stamps, "+02:00" for "Time (CEST)"; None without one."""
    match = _HEADER_ZONE.search(text.replace("_", " "))
    if match is None:
        return None
    hours, minutes = int(match[2] or _CENTRAL_EUROPE_H.get(match[1].upper(), 0)), match[3] or "00"
    return f"{hours:+03d}:{minutes}" if hours or int(minutes) else "UTC"


def time_format_fault(form: str) -> str | None:
    """The fault of a strptime format that reads the wrong hour, with the remedy; None for other formats."""
    if "%H" in form and "%p" in form:
        return f'time_format = "{form}": %p (AM, PM) is ignored beside %H: write %I for %H'
    if "%I" in form and "%p" not in form:
        return f'time_format = "{form}": %I counts to 12: add %p (AM, PM), or write %H for %I'
    return None


def midnight_of(text: str, form: str | None = None) -> str | None:
    """A stamp at 24:00 rewritten as 00:00 of the same day, a day too early; None for any other stamp.

    form: its strptime format, None or "" for ISO 8601.
    """
    pattern = r"(.*\d[T ]+)24((?::?00(?::?00(?:\.0+)?)?)?(?:$|[Z+\- ].*))"
    if form:
        parts = [part for part in re.split(r"(%.)", form) if part]
        digits_of = {"%Y": r"\d{4}", "%H": ")24(", "%M": "00?", "%S": "00?", "%f": "0+"}
        pattern = "".join(digits_of.get(part, ".+?" if part[0] == "%" else re.escape(part)) for part in parts)
        pattern = f"({pattern})" if "%H" in form else r"(?!)"
    match = re.fullmatch(pattern, text.strip())
    return None if match is None else f"{match[1]}00{match[2]}"


def moment(value: Any) -> float:
    """Time of a stamp in the case file [s since 1970-01-01T00:00Z].

    value: ISO 8601 text with an offset, or the datetime that TOML makes of such a stamp.
    Raises ValueError for other text and for a stamp without offset.
    """
    example = '"2020-12-01T00:00:00Z"'
    stamp = value
    if isinstance(value, str):
        try:
            stamp = datetime.fromisoformat(value.strip())
        except ValueError:
            stamp = None
    if not isinstance(stamp, datetime):
        # always a ValueError: the fault is in the text of a case file, not in the type that a caller passed
        raise ValueError(f'expected an ISO 8601 stamp such as {example}, found "{value}"')
    if stamp.tzinfo is None:
        raise ValueError(f'stamp "{value!s}" has no offset: add Z for UTC, or such as +01:00')
    return stamp.timestamp()


@dataclass(frozen=True)
class Stamps:
    """Stamps of a table in UTC.

    time: [s] (N,) since 1970-01-01T00:00Z; NaN where there is none.
    unreadable: (N,) True where the text is no stamp.
    naive: (N,) True where a stamp has no offset and no zone was given for it.
    aware: whether all stamps carry their offset.
    warnings: stamps that were left out or disambiguated at summer-time changes.
    """

    time: np.ndarray
    unreadable: np.ndarray
    naive: np.ndarray
    warnings: tuple[str, ...] = ()
    aware: bool = False


def read_stamps(
    column: pandas.Series,
    zone: tzinfo | None = None,
    *,
    time_format: str | None = None,
    ignore_offset: bool = False,
    repeated: np.ndarray | None = None,
) -> Stamps:
    """Seconds of UTC from a column of stamps [s].

    column: (N,) text or datetimes, in the order of the file.
    zone: of stamps without an offset; None: every stamp must have one.
    time_format: strptime format, or `EXCEL`; None: ISO 8601 (also with slashes or a blank).
    ignore_offset: read the stamps without their offset, in `zone`.
    repeated: (N,) True for a row with the readings of the row before; None: for none.

    At the end of summer time an hour occurs twice.  If the file has both passes, the order of the stamps
    distinguishes them: the second pass begins where the stamps step back, and a 03:00 before that ends the
    first pass.  Ambiguous stamps of this hour, and stamps of the hour that does not exist in spring, are left
    out (NaN) with a warning.
    """
    import pandas as pd

    if pd.api.types.is_datetime64_any_dtype(column.dtype):
        text, parsed = column, column
        missing = column.isna().to_numpy()
        if ignore_offset and parsed.dt.tz is not None:
            parsed = parsed.dt.tz_localize(None)
        naive = np.full(len(column), parsed.dt.tz is None)
    else:
        text = column.astype(object)
        missing = text.isna().to_numpy()
        if ignore_offset:
            text = text.map(
                lambda stamp: _ENDS_IN_OFFSET.sub("", stamp) if _has_offset(stamp) else stamp,
                na_action="ignore",
            )
        parsed, naive = _parse(text, time_format)
    empty = parsed.isna().to_numpy()
    unreadable = empty & ~missing
    naive = naive & ~empty
    aware = not naive.any() and not empty.all()
    if parsed.dt.tz is not None:
        seconds = _seconds(parsed.dt.tz_convert("UTC").dt.tz_localize(None))
    else:
        seconds = _seconds(parsed)
    all_false = np.zeros(len(column), dtype=bool)
    if not naive.any():
        return Stamps(seconds, unreadable, all_false, aware=aware)
    if zone is None:
        return Stamps(seconds, unreadable, naive)
    local = np.where(naive, seconds, np.nan)
    utc, warnings = _from_local(local, zone, all_false if repeated is None else repeated)
    return Stamps(np.where(naive, utc, seconds), unreadable, all_false, warnings)


def fitting_formats(texts: pandas.Series) -> Iterator[str | None]:
    """Formats that read all of these stamps (N,) as times of 1850 to 2200, ISO 8601 (None) first."""
    for form in (None, *STAMP_FORMATS):
        read = read_stamps(texts, UTC, time_format=form)
        seconds = read.time[np.isfinite(read.time)]
        if not read.unreadable.any() and not np.any((seconds < EARLIEST_S) | (seconds > LATEST_S)):
            yield form


def _parse(text: pandas.Series, form: str | None) -> tuple[pandas.Series, np.ndarray]:
    """Datetimes (NaT where unreadable), and True for those without an offset."""
    import pandas as pd

    parsed, naive = _parse_as(text, form)
    failed = (parsed.isna() & text.notna()).to_numpy()
    if failed.any():
        # 24:00 and a trailing "UTC" are common in exports and unambiguous
        unread = text[failed].astype(str).str.strip()
        rewritten = unread.map(lambda stamp: midnight_of(stamp, form) or stamp)
        midnight = rewritten != unread
        if form is None:
            rewritten = rewritten.str.replace(r"\s*(?:UTC|GMT)$", "Z", regex=True)
        repaired, repaired_naive = _parse_as(rewritten, form)
        if repaired.notna().any():
            repaired = repaired + pd.to_timedelta(midnight.to_numpy().astype(int), unit="D")
            if (parsed.dt.tz is None) != (repaired.dt.tz is None) or parsed.dt.tz is not None:
                parsed, repaired = (pd.to_datetime(datetimes, utc=True) for datetimes in (parsed, repaired))
            parsed = parsed.astype(repaired.dtype)
            parsed[failed] = repaired
            naive[failed] = repaired_naive
    return parsed, naive


def _parse_as(text: pandas.Series, form: str | None) -> tuple[pandas.Series, np.ndarray]:
    import pandas as pd

    if form is None:
        return _parse_iso(text)
    if form == EXCEL:
        days = pd.to_numeric(text.astype(str).str.replace(",", "."), errors="coerce")
        seconds = (days.where(days.between(*_EXCEL_DAYS)) * DAY_S).round()
        return pd.Timestamp("1899-12-30") + pd.to_timedelta(seconds, unit="s"), np.full(len(text), True)
    aware = "%z" in form
    return pd.to_datetime(text, format=form, errors="coerce", utc=aware), np.full(len(text), not aware)


def _parse_iso(text: pandas.Series) -> tuple[pandas.Series, np.ndarray]:
    import pandas as pd

    numbers = text.astype(str).str.fullmatch(r"\s*\d{1,4}\s*|\s*\d{9,}\s*|\s*\d+\.\d*\s*")
    if numbers.any():
        # years, Excel days and Unix seconds must not pass as stamps
        text = text.where(~numbers, None)
    try:
        with python_warnings.catch_warnings():
            # Offsets that change within a column are an error in pandas 3, a warning before.
            python_warnings.simplefilter("error", FutureWarning)
            parsed = pd.to_datetime(text, format="ISO8601", errors="coerce")
    except (ValueError, FutureWarning):
        parsed = pd.to_datetime(text, format="ISO8601", errors="coerce", utc=True)
        offsets = text.map(_has_offset, na_action="ignore").eq(True)
        return parsed, ~offsets.to_numpy()
    return parsed, np.full(len(text), parsed.dt.tz is None)


def _has_offset(text: str) -> bool:
    return _DATE_ALONE.match(text.strip()) is None and _ENDS_IN_OFFSET.search(text) is not None


def _seconds(naive: pandas.Series) -> np.ndarray:
    """Seconds since 1970-01-01T00:00 of datetimes without zone [s]; NaN for NaT."""
    microseconds = naive.to_numpy(dtype="datetime64[us]")
    seconds = microseconds.astype(np.int64) / 1e6
    seconds[np.isnat(microseconds)] = np.nan
    return seconds


def _from_local(local: np.ndarray, zone: tzinfo, repeated: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """UTC seconds of local wall-clock seconds, and warnings [s]."""
    if not isinstance(zone, ZoneInfo):
        offset = zone.utcoffset(None)
        assert offset is not None  # such a zone has one fixed offset
        return local - offset.total_seconds(), ()
    # within a doubled hour, summer time is the earlier moment
    first_s, second_s = (_localised(local, zone, summer) for summer in (True, False))
    # 03:00 may also be the end of an interval in the first pass: the instant just before 03:00 locates it
    as_end = np.round(_localised(local - 1e-6, zone, True) + 1e-6, 6)
    ends = (first_s == second_s) & np.isfinite(as_end) & (as_end < first_s)
    warnings = []
    in_hole = np.isnan(first_s) & np.isfinite(local)
    if in_hole.any():
        moments = local[in_hole]
        days = sorted({stamp_text(moment)[:10] for moment in moments})
        warnings.append(
            f"summer-time hole: {in_hole.sum()} stamps left out, because their hour does not exist "
            f"in {zone} ({', '.join(days[:4])}{' …' if len(days) > 4 else ''}); if the clock does "
            f'not follow summer time, state its fixed offset, such as timezone = "+01:00"'
        )
    earlier = np.where(ends, as_end, first_s)
    utc = second_s.copy()
    resolved, left_out = [], []
    doubtful = np.flatnonzero(np.isfinite(first_s) & (earlier != second_s))
    dates = np.flatnonzero(np.abs(np.diff(local[doubtful])) > DAY_S) + 1
    for group in np.split(doubtful, dates) if len(doubtful) else []:
        second, ambiguous = _passes(local, group, repeated), group[~ends[group]]
        if second is not None:
            utc[group[~second]] = earlier[group[~second]]
            resolved.append(ambiguous)
        elif len(ambiguous):
            utc[ambiguous] = np.nan
            left_out.append(ambiguous)
    if resolved:
        days = sorted({stamp_text(local[group[0]])[:10] for group in resolved})
        warnings.append(
            f"summer-time hole: {sum(map(len, resolved))} stamps of the repeated hour resolved by their "
            f"order ({', '.join(days)})"
        )
    if left_out:
        days = sorted({stamp_text(local[group[0]])[:10] for group in left_out})
        warnings.append(
            f"summer-time hole: {sum(map(len, left_out))} stamps left out, because their hour occurs "
            f"twice in {zone} and the order of the file does not resolve it "
            f"({', '.join(days)}); stamps with an offset would resolve it"
        )
    return utc, tuple(warnings)


def _localised(local: np.ndarray, zone: ZoneInfo, summer: bool) -> np.ndarray:
    """UTC seconds of local seconds [s]; NaN for an hour that does not exist.

    summer: whether stamps of the doubled hour are read in summer time.
    """
    import pandas as pd

    index = pd.DatetimeIndex((local * 1e6).round().astype("datetime64[us]"))
    localised = index.tz_localize(zone, ambiguous=np.full(len(local), summer), nonexistent="NaT")
    return _seconds(localised.tz_convert("UTC").tz_localize(None).to_series())


def _passes(local: np.ndarray, group: np.ndarray, repeated: np.ndarray) -> np.ndarray | None:
    """True for the stamps in the second pass of a doubled hour; None if the order does not determine them.

    An equal stamp is a repetition, unless the stamps are hourly (one for each pass) and its readings are new.
    """
    steps = np.diff(local[np.isfinite(local)])
    newest_first = len(steps) > 0 and np.median(steps) < 0.0
    rows = group[::-1] if newest_first else group
    steps = np.diff(local[rows])
    is_repetition = repeated[np.maximum(rows[1:], rows[:-1])] | bool(np.any((steps > 0.0) & (steps < HOUR_S)))
    back = np.flatnonzero((steps < 0.0) | ((steps == 0.0) & ~is_repetition))
    if len(back) != 1:
        return None
    second = np.arange(len(group)) > back[0]
    return second[::-1] if newest_first else second


def modal_step(time: np.ndarray) -> tuple[float, float]:
    """Most frequent step of increasing stamps [s] and the share of steps equal to it [-].

    time: [s] (T,). The share counts steps within 1 % of the modal one; (NaN, 0) below two stamps.
    """
    steps = np.diff(time)
    steps = np.round(steps[steps > 0.0], 3)
    if not len(steps):
        return math.nan, 0.0
    sizes, counts = np.unique(steps, return_counts=True)
    step = float(sizes[np.argmax(counts)])
    if counts.max() < 0.1 * len(steps):
        # a jittering clock has no repeated step; the median is its nominal one
        step = float(np.median(steps))
    return step, float(np.mean(np.abs(steps - step) <= 0.01 * step))


BY_CHANCE = 0.1
"""Expected number of chance losses of a single hour on dates of change, above which no warning is given."""


def summer_time_holes(time: np.ndarray) -> tuple[str, ...]:
    """Warnings about an hour that is missing or doubled on a date of summer-time change.

    time: [s] (T,) stamps in UTC, sorted, duplicates included.
    The dates are those of Europe and of North America.  Where a record loses single hours just as often on
    other days, an hour lost on such a date gives no warning.
    """
    step, _ = modal_step(time)
    if not step <= HOUR_S:
        return ()
    steps = np.diff(time)
    gaps = np.flatnonzero(np.abs(steps - (HOUR_S + step)) < 0.01 * step)
    gap_dates = [change_date(time[index] + step) for index in gaps]
    gaps_elsewhere = sum(not season for _, season in gap_dates)
    dates = np.arange(time[0], time[-1], DAY_S)
    if gaps_elsewhere * sum(bool(change_date(moment)[1]) for moment in dates) > BY_CHANCE * len(dates):
        gap_dates = []
    gap_days = {name: [day for day, season in gap_dates if season == name] for name in ("spring", "autumn")}
    double_days: dict[str, list[date]] = {"spring": [], "autumn": []}
    doubles = time[1:][steps == 0.0]
    for number in np.unique(np.floor(doubles / DAY_S)):
        of_day = doubles[np.floor(doubles / DAY_S) == number]
        day, season = change_date(of_day[0])
        if season and abs(len(of_day) - HOUR_S / step) < 1.5 and np.ptp(of_day) < HOUR_S:
            double_days[season].append(day)
    warnings = []
    shifted_days = sorted(set(gap_days["spring"]) & set(double_days["spring"]))
    if shifted_days:
        warnings.append(
            f"summer-time hole: one hour is missing and the next occurs twice on {_days(shifted_days)}: the "
            "export moved the readings of the hour that summer time skips"
        )
    for days in (gap_days["spring"], double_days["spring"]):
        days[:] = [day for day in days if day not in shifted_days]
    for gap, double, reason in _CAUSES:
        facts = []
        if gap_days[gap]:
            facts.append(f"one hour is missing on {_days(gap_days[gap])}")
        if double_days[double]:
            facts.append(f"one hour occurs twice on {_days(double_days[double])}")
        if facts:
            warnings.append(f"summer-time hole: {' and '.join(facts)}; perhaps {reason}")
    return tuple(warnings)


def _days(days: list[date]) -> str:
    return ", ".join(day.isoformat() for day in days)


def change_date(seconds: float) -> tuple[date, str]:
    """Date of a moment and "spring" or "autumn" if clocks change on it, else ""."""
    day = (datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=float(seconds))).date()
    if day.weekday() != 6:
        return day, ""
    if day.month == 3 and (day.day >= 25 or 8 <= day.day <= 14):
        return day, "spring"
    if (day.month == 10 and day.day >= 25) or (day.month == 11 and day.day <= 7):
        return day, "autumn"
    return day, ""


def summer_time(time: np.ndarray, america: bool = False) -> np.ndarray:
    """Whether summer time is in force (T,) at instants [s] of UTC.

    Europe: from 01:00 UTC of March's last Sunday to that of October's.  North America: from 08:00 UTC of
    March's second Sunday to 07:00 UTC of November's first, the hours of its central zone.
    """
    years = np.asarray(time).astype("datetime64[s]").astype("datetime64[Y]").astype(int) + 1970
    summer = np.zeros(len(time), dtype=bool)
    for year in np.unique(years):
        begin, end = _turns(int(year), america)
        summer |= (time >= begin) & (time < end)
    return summer


@lru_cache(maxsize=64)
def _turns(year: int, america: bool) -> tuple[float, float]:
    """Beginning and end of summer time in a year [s]."""
    sundays = ((3, 1, 8.0), (11, 0, 7.0)) if america else ((4, -1, 1.0), (11, -1, 1.0))
    # (month, offset, hour): offset 0 is the month's first Sunday, −1 the last Sunday of the previous month
    begin, end = (
        np.busday_offset(f"{year}-{month:02d}-01", offset, roll="forward", weekmask="Sun").astype(int) * DAY_S
        + hour * HOUR_S
        for month, offset, hour in sundays
    )
    return float(begin), float(end)
