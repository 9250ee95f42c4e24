"""The stamps of an export: column and format, meaning within the interval, and evidence of their zone."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.timestamps import (
    DAY_S,
    HOUR_S,
    MINUTE_S,
    change_date,
    fitting_formats,
    modal_step,
    read_stamps,
    zone_in_header,
    zone_named,
)
from hygrokf.drafting.layout import Export, is_date

if TYPE_CHECKING:
    import pandas

_TIME_ALONE = re.compile(r"\d{1,2}:\d{2}(:\d{2})?(\s?[AaPp][Mm])?$")
_STATED_ZONE = re.compile(
    r"(?:time ?zone|zeitzone)\W{0,3}"
    r"((?:utc|gmt)\s?[+-]\d{1,2}(?::?\d{2})?|[A-Za-z]+(?:/[A-Za-z_]+)?|[+-]\d{2}:?\d{2})",
    re.IGNORECASE,
)
_CENTRAL_EUROPE = re.compile(r"(?<![a-z])(mes?z|ces?t)(?![a-z])", re.IGNORECASE)
_DATE_ALONE = r"\d{8}|\d{1,4}[-/.]\s?\d{1,2}[-/.]\s?\d{1,4}"
_HOURS = re.compile(r"hour|hora|heure|stunde|uur|zeit|time|(?<![a-z])(hh?|hr|std)(?![a-z])", re.IGNORECASE)
_CLOCKS_OF_MAKES = {"MESS_DATUM": ("UTC", "the files of DWD are in UTC")}
"""Column of stamps -> its zone and the reason, for services whose files never name their zone."""


@dataclass(frozen=True)
class ExportClock:
    """The stamps of one export.

    column: its name.  time_format: strptime format; None for ISO 8601.
    time: [s] (N,) by the clock of the file, read as UTC where the stamps have no offset.
    timezone: of the stamps; None where they carry offsets.  zone_assumed: whether there is no evidence for
        it.
    stamp: "instant", "start" or "end" of the interval.  step_s: most frequent step.
    doubts: choices to confirm.  remarks: conclusions that rest on evidence.
    """

    column: str
    time_format: str | None
    time: np.ndarray
    timezone: str | None
    stamp: str
    step_s: float
    doubts: tuple[str, ...]
    remarks: tuple[str, ...]
    zone_assumed: bool = False


def time_columns(export: Export) -> tuple[str, str | None]:
    """Return the column of stamps or dates, and the column of times of day if that is a separate one.

    A column of one constant date, such as the day of the export, is taken only where no other one varies: in
    an export of a single day it may be the date beside a time of day.  Raises TableFault where there is none.
    """
    sampled_rows = export.cells.iloc[
        np.linspace(0, len(export.cells) - 1, min(len(export.cells), 200)).astype(int)
    ]
    candidates: list[tuple[bool, int, int, str]] = []
    for name in sampled_rows:
        cells = sampled_rows[name].dropna()
        if len(cells) < 0.5 * len(sampled_rows):
            continue
        if cells.map(is_date).mean() > 0.9:
            lower_name = name.lower()
            is_numeric = cells.str.fullmatch(r"[\d.,]+").all() and not cells.str.contains(r"\..*\.").any()
            is_named = bool(re.search(r"time|date|datum|zeit|stamp|epoch|yyyymmdd|ts\b|_ts|时间", lower_name))
            if is_numeric and not is_named:
                continue
            is_utc = "utc" in lower_name or "gmt" in lower_name
            is_end = bool(re.search(r"\bend|ende\b|bis\b|_end|received|insert", lower_name))
            varies = cells.nunique() > 1
            candidates.append((varies, is_named + is_utc - is_end, -len(candidates), name))
    if not candidates:
        raise TableFault(
            "expected a column of stamps such as 2020-12-01 00:00, found none among "
            f"{', '.join(sampled_rows)[:200]}"
        )
    column = max(candidates)[-1]
    dates = sampled_rows[column].dropna()
    if not dates.str.contains(":").any():
        for name in sampled_rows:
            cells = sampled_rows[name].dropna()
            if name == column or not len(cells):
                continue
            if cells.map(lambda cell: bool(_TIME_ALONE.match(cell))).mean() > 0.9:
                return column, name
            is_hours = cells.str.fullmatch(r"1?\d|2[0-4]|0\d").all() and cells.nunique() > 2
            if is_hours and _HOURS.search(name) and dates.str.fullmatch(_DATE_ALONE).all():
                return column, name
    return column, None


def time_of_day(hours: pandas.Series) -> tuple[pandas.Series, bool]:
    """Return times of day as text, and whether hours run from 1 to 24, that is, are ends of intervals."""
    if hours.str.contains(":").any():
        return hours, False
    numbers = hours.dropna().astype(int)
    return hours.str.zfill(2) + ":00", bool(numbers.min() > 0 and numbers.max() == 24)


def as_text(stamps: pandas.Series) -> tuple[pandas.Series, str | None]:
    """Return stamps in a form that a case can read and, if they were Unix times, their unit in words."""
    import pandas as pd

    present = stamps.dropna()
    if not present.str.fullmatch(r"1\d{9}(\.\d*)?|1\d{12}").all():
        return stamps, None
    is_milliseconds = present.str.len().median() == 13 and not present.str.contains(".", regex=False).any()
    number = pd.to_numeric(stamps) * (1 if is_milliseconds else 1000)
    text = pd.to_datetime(number.round(), unit="ms").dt.strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    return text.str.replace(".000000Z", "Z"), f"Unix {'milliseconds' if is_milliseconds else 'seconds'}"


def clock_of(export: Export, are_means: bool) -> ExportClock:
    """Return the clock of an export.

    are_means: whether the readings are means over intervals.  Raises TableFault where no format reads the
        stamps.
    """
    column, text = export.column, export.cells[export.column]
    fitting = _fitting_forms(text)
    if not fitting:
        raise TableFault(
            f'column "{column}": expected stamps such as 2020-12-01 00:00 or 01.12.2020 00:00, found '
            f'"{text.dropna().iloc[0]}"; export the time in ISO 8601'
        )
    doubts: list[str] = []
    time_format, time = fitting[0]
    if len(fitting) > 1:
        others = ", ".join(str(other_form) for other_form, _ in fitting[1:3])
        doubts.append(f"day and month can be exchanged in these stamps; also possible: {others}")
    step, _ = modal_step(np.sort(time[np.isfinite(time)]))
    holes, unbroken = _spring_holes(time, step)
    zone: str | None = None
    remark, is_assumed = "", False
    if not (time_format is None and read_stamps(text.iloc[:50]).naive.sum() < 25):
        zone, remark, doubt = _infer_zone(export, holes, unbroken)
        doubts += [doubt] if doubt else []
        is_assumed = bool(doubt) and zone == "UTC"
    stamp, evidence = _infer_meaning(column, time, step, holes, are_means)
    if stamp != "instant" and not evidence:
        doubts.append(
            'means over intervals: the file does not state whether stamps are their "start" or "end"'
        )
    remarks = tuple(filter(None, (remark, evidence)))
    return ExportClock(column, time_format, time, zone, stamp, step, tuple(doubts), remarks, is_assumed)


def _fitting_forms(text: pandas.Series) -> list[tuple[str | None, np.ndarray]]:
    """Return the formats that read the stamps, with the times [s].

    Of several formats, only those with the most regular steps and the shortest span are kept.
    """
    sample = text.dropna()
    sample = sample.iloc[np.linspace(0, len(sample) - 1, min(len(sample), 300)).astype(int)]
    ranked = []
    for rank, form in enumerate(fitting_formats(sample)):
        stamps_read = read_stamps(text, UTC, time_format=form)
        if stamps_read.unreadable.sum() > 0.001 * len(text):
            continue
        times = np.sort(stamps_read.time[np.isfinite(stamps_read.time)])
        irregular = 1.0 - modal_step(times)[1]
        span = times[-1] - times[0] if len(times) else math.inf
        ranked.append((round(irregular, 2), round(span / DAY_S), rank, form, stamps_read.time))
        if form is None:
            break
    ranked.sort(key=lambda candidate: candidate[:3])
    return [(candidate[3], candidate[4]) for candidate in ranked if candidate[:2] == ranked[0][:2]]


@dataclass(frozen=True)
class _Hole:
    """An hour that a clock skips in spring because it follows summer time.

    hour: [h] at which it begins by this clock.  end: whether stamps are ends of intervals.
    american: whether the clock changed on the American date.
    """

    hour: int
    end: bool
    american: bool


_ZONES = {1: "Europe/London", 2: "Europe/Berlin", 3: "Europe/Helsinki"}


def _spring_holes(time: np.ndarray, step: float) -> tuple[list[_Hole], int]:
    """Return the hours missing on the dates when summer time begins, and on how many such dates no hour is
    missing."""
    times = np.unique(time[np.isfinite(time)])
    if not step <= HOUR_S or len(times) < 10:
        return [], 0
    holes, unbroken_count = [], 0
    for start in np.arange(DAY_S * np.floor(times[0] / DAY_S), times[-1], DAY_S):
        day, season = change_date(start)
        if season != "spring":
            continue
        european = day.day >= 25
        times_around_change = times[(times >= start - HOUR_S) & (times <= start + 6 * HOUR_S)]
        gaps = np.flatnonzero(np.diff(times_around_change) > 1.5 * step)
        if len(gaps) == 0 and len(times_around_change) > 5 * HOUR_S / step:
            unbroken_count += european
        elif (
            len(gaps) == 1
            and abs(times_around_change[gaps[0] + 1] - times_around_change[gaps[0]] - HOUR_S - step)
            < 0.01 * step
        ):
            hour_of_gap = (times_around_change[gaps[0]] + step - start) / HOUR_S
            holes.append(_Hole(math.floor(hour_of_gap + 1e-6), hour_of_gap % 1.0 > 1e-6, not european))
    return holes, unbroken_count


def _infer_zone(export: Export, holes: Sequence[_Hole], unbroken: int) -> tuple[str, str, str]:
    """Return the zone of stamps without an offset, the evidence for it, and a doubt about it ("" without)."""
    column = export.column
    header_text = " ".join((column, *export.units[:1])).replace("_", " ")
    zone_of_header, central_european = zone_in_header(header_text), _CENTRAL_EUROPE.search(header_text)
    if zone_of_header is not None and not central_european:
        return zone_of_header, f'the zone is named in the header "{column}"', ""
    stated_zone = _STATED_ZONE.search(export.preamble)
    if stated_zone is not None:
        with suppress(ValueError):
            offset = None if _CENTRAL_EUROPE.search(stated_zone[1]) else zone_in_header(stated_zone[1])
            zone_named(offset or stated_zone[1])
            return offset or stated_zone[1], "the zone is stated above the header", ""
    if column in _CLOCKS_OF_MAKES:
        return *_CLOCKS_OF_MAKES[column], ""
    if central_european and zone_of_header is not None and not holes:
        doubt = (
            f'the header "{column}" names Central European Time: {zone_of_header} is assumed; '
            'state "Europe/Berlin" if the clock follows summer time'
        )
        return zone_of_header, "", "" if unbroken else doubt
    if holes and not unbroken:
        zone = _ZONES.get(holes[0].hour) if not holes[0].american else None
        evidence = f"the hour from {holes[0].hour}:00 is missing where summer time begins"
        if zone is not None:
            return zone, f"{evidence}: the clock follows the summer time of {zone} or a zone like it", ""
        site = "name the IANA zone of the site, such as America/Chicago; UTC is only assumed"
        return "UTC", "", f"{evidence}: {site}"
    if unbroken and not holes:
        return "UTC", "", (
            "no hour is missing where summer time begins: the clock has a fixed offset, which the file does "
            "not state; UTC is assumed"
        )  # fmt: skip
    return "UTC", "", "the file does not state the zone of its stamps; UTC is assumed"


def _infer_meaning(
    column: str, time: np.ndarray, step: float, holes: Sequence[_Hole], are_means: bool
) -> tuple[str, str]:
    """Return what stamps mean ("instant", or "start" or "end" of an interval), and the evidence.

    are_means: whether readings are means.  Without evidence, their stamps count as starts, and the evidence
        is "".
    """
    header_words = re.sub(r"[_\W]+", " ", column.lower())
    evidence_of_header = f'the header "{column}" says that stamps are at the {{}} of the interval'
    if re.search(r"\b(start|begin|beginning|beginn|von|from)\b", header_words):
        return "start", evidence_of_header.format("start")
    if re.search(r"\b(end|ende|bis)\b", header_words):
        return "end", evidence_of_header.format("end")
    if not (are_means and step >= 5.0 * MINUTE_S):
        return "instant", ""
    times = np.sort(time[np.isfinite(time)])
    first_minute, last_minute = np.round(np.mod(times[[0, -1]], DAY_S) / MINUTE_S)
    step_minutes = round(step / MINUTE_S) if math.isfinite(step) else 0
    if step_minutes and holes:
        stamp = "end" if holes[0].end else "start"
        return stamp, f"the stamps missing where summer time begins are {stamp}s of intervals"
    if step_minutes and (first_minute, last_minute) == (step_minutes, 0):
        evidence = "one step after midnight and ends at midnight: stamps are ends of intervals"
        return "end", f"the file begins {evidence}"
    if step_minutes and (first_minute, last_minute) == (0, round(DAY_S / MINUTE_S) - step_minutes):
        evidence = "at midnight and ends one step before: stamps are starts of intervals"
        return "start", f"the file begins {evidence}"
    return "start", ""


def sun_remark(time: np.ndarray, irradiance: np.ndarray, longitude_deg: float | None) -> str | None:
    """Return a sentence on a clock's offset from UTC by the course of the sun; None with less than five days
    of sun.

    time: [s] (N,) by the clock.  irradiance: [any unit] (N,).  Noon is the mean time of day of the sun's
        energy, by the first harmonic of the day, weighted by the irradiance; the equation of time averages
        out over a year and is at most 0.3 h.
    """
    is_sunny = np.isfinite(time) & np.isfinite(irradiance) & (irradiance > 0.0)
    if is_sunny.sum() < 50 or np.ptp(time[is_sunny]) < 5.0 * DAY_S:
        return None
    phase = 2.0 * math.pi * time[is_sunny] / DAY_S
    noon_angle = math.atan2(
        float(irradiance[is_sunny] @ np.sin(phase)), float(irradiance[is_sunny] @ np.cos(phase))
    )
    noon_h = (noon_angle / (2.0 * math.pi) * 24.0) % 24.0
    lead_h = noon_h - 12.0
    if longitude_deg is not None:
        offset = lead_h + longitude_deg / 15.0
        return (
            f"the sun is highest at {noon_h:.1f} h by this clock: at {longitude_deg:g}° E it runs at "
            f"UTC{offset:+.1f} h"
        )
    longitude_at_utc = -15.0 * lead_h
    longitudes = ", ".join(
        f"{offset:+d} h: {longitude_at_utc + 15.0 * offset:.0f}° E" for offset in (0, 1, 2)
    )
    return f"the sun is highest at {noon_h:.1f} h by this clock; that fits UTC{longitudes}"
