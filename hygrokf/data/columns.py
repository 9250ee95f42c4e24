"""Convert table columns to readings: cells to numbers, stamps to seconds of UTC; every fault names its
place."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, tzinfo
from decimal import Decimal
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from hygrokf.data.numbers import PARTED, POINT, Marks, Meaning, Unread, evidence, stated_marks, values_in
from hygrokf.data.quality import NOTHING_STATED, MarkedReadings, StatedQuality
from hygrokf.data.timestamps import (
    EARLIEST_S,
    LATEST_S,
    fitting_formats,
    read_stamps,
    time_format_fault,
    zone_in_header,
    zone_named,
)
from hygrokf.data.toml_form import setting
from hygrokf.errors import HygrokfError, suggestion

if TYPE_CHECKING:
    import pandas

MISSING: tuple[str, ...] = (
    "", "NaN", "nan", "NAN", "NA", "na", "N/A", "n/a", "#N/A", "null", "NULL", "Null", "None", "none", "<NA>",
    "-", "--", "---", "unavailable", "unknown",
    "-nan", "-NaN", "nan(ind)", "-nan(ind)", "1.#QNAN", "-1.#IND", "1.#INF", "-1.#INF",
)  # fmt: skip
"""Texts that count as a missing reading, besides those listed in the case file."""

_SHOWN = 5


class TableFault(HygrokfError):
    """A table that cannot be read; `faults` lists every reason."""

    def __init__(self, *faults: str) -> None:
        super().__init__("\n".join(faults))
        self.faults = faults


HEADER = "header"
"""Key of `DataFrame.attrs` with the names of all columns of a source."""


@dataclass(frozen=True)
class FileColumns:
    """Columns of a file, in the order of the file.

    time: [s] (N,) since 1970-01-01T00:00Z; finite, neither sorted nor unique yet.
    values: column name -> (N,) as in the file; NaN = missing.
    warnings: rows that were left out, and why.
    sha256: of the file.
    header: names of all its columns, also of those that were not read.
    judged: column name -> what the quality beside it says.
    summer_time: whether warnings are about the hours of summer-time changes.
    """

    time: np.ndarray
    values: dict[str, np.ndarray]
    warnings: tuple[str, ...]
    sha256: str
    header: tuple[str, ...] = ()
    judged: Mapping[str, MarkedReadings] = field(default_factory=dict)
    summer_time: bool = False


@dataclass(frozen=True)
class Places:
    """How messages name the rows of a table.

    label: "line" of a text file, "row" counted from 1, "iloc" counted from 0.
    numbers: rows of the frame, counted from 0 (K,) -> their numbers under that label.
    here: phrase in remedies for where the user states an option, such as " in this source" of a case file.
    """

    label: str
    numbers: Callable[[np.ndarray], Sequence[int]]
    here: str = " in this source"


_CHARACTER: dict[str, Any] = {"fits": lambda text: len(text) == 1, "expected": "one character in quotes"}


@dataclass(frozen=True, kw_only=True)
class Notation:
    """How a table writes its readings: keys of a source in a case file."""

    timezone: str | None = setting(None, 'of the stamps: "+02:00", "UTC", or an IANA name')
    separator: str = setting(",", "of columns", **_CHARACTER)
    decimal: str | None = setting(None, 'mark of numbers; by default "."', choices=(".", ","))
    thousands: str | None = setting(None, "mark between groups of three digits", **_CHARACTER)
    comment: str | None = setting(None, "lines that start with this character are skipped", **_CHARACTER)
    missing: tuple[str, ...] = setting(
        (), 'texts that mean "no reading"', expected='a list of texts such as ["error"]', empty=True
    )
    time_format: str | None = setting(None, 'strptime format of stamps that are not ISO 8601, or "excel"')
    ignore_offset: bool = setting(False, "drop the offset of the stamps, read them in `timezone`")

    @property
    def marks(self) -> Marks | None:
        """The marks of numbers; None where none is stated."""
        return stated_marks(self.decimal, self.thousands)


def frame_table(
    frame: pandas.DataFrame,
    columns: Mapping[str, Meaning],
    stamps: pandas.Series | None,
    stamps_named: str,
    places: Places,
    notation: Notation,
    quality: StatedQuality = NOTHING_STATED,
    beside: Mapping[str, str] | None = None,
    faults: Sequence[str] = (),
    sha256: str = "",
) -> FileColumns:
    """Readings of a frame: its columns as numbers, its stamps in UTC [s].

    frame: rows in the order of the source. columns: of numbers, and what their texts stand for; `faults`
        must already name the columns that the frame lacks.
    stamps: of the rows, or None where `faults` already explains why. stamps_named: their name in messages,
        such as 'column "time"'.
    places: how messages name rows. notation: of stamps and numbers.
    beside: column of numbers -> column of the frame with its quality.  Readings that the marks of quality
        exclude, as `quality` states, are missing, whatever their cells hold.
    faults: earlier faults of the source, raised together with those of the table. sha256: of a file.

    Rows without a stamp are left out, with a warning. Raises TableFault with every fault found.
    """
    faults = list(faults)
    try:
        zone = None if notation.timezone is None else zone_named(notation.timezone)
    except ValueError as unknown:
        faults.append(str(unknown))
        zone = UTC  # any zone serves to find the remaining faults
    values = {}
    judged = {
        name: quality.judged(name, quality_name, frame[quality_name])
        for name, quality_name in (beside or {}).items()
        if name in frame and quality_name in frame
    }
    warnings = [warning for judgement in judged.values() for warning in judgement.warnings]
    stated = notation.marks
    for name, meaning in ((column, meaning) for column, meaning in columns.items() if column in frame):
        numbers, is_text, reasons = _numbers(frame[name], stated or POINT, notation.missing, meaning)
        if name in judged:
            is_text = is_text & judged[name].usable
            numbers = np.where(judged[name].usable, numbers, np.nan)
        values[name] = numbers
        if stated is None and frame[name].dtype.kind == "O":
            points = evidence(frame[name], ".")
            if points in ("thousands", "either"):
                messages = faults if points == "thousands" else warnings
                messages.append(_ambiguous_points(name, frame[name], places))
        if is_text.any():
            faults.append(_text_fault(name, frame[name], is_text, places, reasons, stated))
    time, summer_time = np.full(len(frame), np.nan), False
    if stamps is not None:
        if stamps.dtype == object:  # databases export a time without bounds as a word
            stamps = stamps.mask(stamps.isin(("infinity", "-infinity")))
        rows = np.array([*values.values()]).reshape(len(values), len(frame))
        unchanged = (rows[:, 1:] == rows[:, :-1]) | (np.isnan(rows[:, 1:]) & np.isnan(rows[:, :-1]))
        repeated = np.append(False, np.all(unchanged, axis=0))[: len(frame)]
        time, stamp_warnings, stamp_faults, summer_time = _read_times(
            stamps, stamps_named, places, zone, notation, repeated
        )
        warnings += stamp_warnings
        faults += stamp_faults
        has_stamp = stamps.notna().to_numpy()
        has_reading = np.isfinite(rows).any(axis=0) | (len(values) == 0)
        without_stamp = has_reading & ~has_stamp
        if count := int(without_stamp.sum()):
            where = numbered(places.label, places.numbers(np.flatnonzero(without_stamp)[:_SHOWN]), count)
            row_count = "1 row" if count == 1 else f"{count} rows"
            warnings.append(f"{row_count} without a stamp left out: {where}")
    if faults:
        raise TableFault(*faults)
    keep = np.isfinite(time)
    if not keep.any():
        raise TableFault("expected readings, found no row with a stamp that can be used")
    kept_values = {name: array[keep] for name, array in values.items()}
    header = tuple(frame.attrs.get(HEADER, ()))
    return FileColumns(time[keep], kept_values, tuple(warnings), sha256, header, judged, summer_time)


def _ambiguous_points(name: str, column: pandas.Series, places: Places) -> str:
    """The message that the points of a column may divide thousands, with an example."""
    example = column.dropna().astype(str).str.extract(PARTED)[0].dropna().iloc[0]
    return (
        f'column "{name}": "{example}" may be {example.replace(".", "")} or {float(example):g}, as texts '
        f'without a point stay below 1000: state thousands = "." or decimal = "."{places.here}'
    )


def _read_times(
    stamps: pandas.Series,
    stamps_named: str,
    places: Places,
    zone: tzinfo | None,
    notation: Notation,
    repeated: np.ndarray,
) -> tuple[np.ndarray, list[str], list[str], bool]:
    """Times (N,) [s] of stamps (NaN: unusable), warnings, faults, whether warnings are about summer time.

    Arguments as for `frame_table` and `read_stamps`.
    """
    time_format, ignore_offset = notation.time_format, notation.ignore_offset
    options: dict[str, Any] = dict(time_format=time_format, ignore_offset=ignore_offset, repeated=repeated)
    if fault := time_format_fault(time_format or ""):
        return np.full(len(stamps), np.nan), [], [f"{stamps_named}: {fault}"], False
    warnings: list[str] = []
    faults: list[str] = []
    read = read_stamps(stamps, zone, **options)
    header = zone_in_header(str(stamps.name or ""))
    if read.naive.any() and header is not None:
        warnings.append(f'{stamps_named}: stamps without an offset are read at "{header}", which it names')
        read = read_stamps(stamps, zone_named(header), **options)
    time = read.time
    if read.unreadable.any():
        where = _where(np.flatnonzero(read.unreadable), stamps, places)
        faults.append(
            f"{stamps_named}: expected ISO 8601 stamps"
            + (f' or "{time_format}"' if time_format else "")
            + f", found {int(read.unreadable.sum())} of {len(stamps)} rows otherwise: {where}"
            + _stamp_remedy(stamps, read.unreadable, places.here, time_format)
        )
    if read.naive.any():
        rows = np.flatnonzero(read.naive)
        faults.append(
            f"{stamps_named}: {len(rows)} of {len(stamps)} stamps have no offset "
            f"({_where(rows[:1], stamps, places)}); state their zone{places.here}: "
            'timezone = "UTC", a fixed offset such as "+01:00", or a name such as "Europe/Berlin"'
        )
    elif zone is not None and not ignore_offset and read.aware:
        warnings.append(f'timezone = "{notation.timezone}" is not used: the stamps carry offsets')
    warnings += read.warnings
    out_of_range = np.isfinite(time) & ~((time > EARLIEST_S) & (time < LATEST_S))
    if out_of_range.any():
        where = _where(np.flatnonzero(out_of_range), stamps, places)
        description = f"{int(out_of_range.sum())} before 1850 or after 2200: {where}"
        if out_of_range.sum() < 0.5 * len(time):
            warnings.append(f"rows with an impossible stamp left out: {description}")
            time = np.where(out_of_range, np.nan, time)
        else:
            remedy = "correct or remove these rows"
            faults.append(f"{stamps_named}: expected stamps of our time, found {description}; {remedy}")
    return time, warnings, faults, bool(read.warnings)


def column_fault(name: str, names: Sequence[str], holder: str) -> str:
    """The fault of a missing column, with the existing columns.

    holder: what has these columns, with its verb, such as "the file has".
    """
    shown = ", ".join(f'"{column}"' for column in names[:40]) + (" …" if len(names) > 40 else "")
    return f'no column "{name}" ({holder} {shown}){suggestion(name, names)}'


def places_of(columns: Iterable[str], names: Sequence[str], holder: str, faults: list[str]) -> dict[str, int]:
    """The positions of columns among the names of a table; a column absent or repeated adds a fault."""
    counts = {name: names.count(name) for name in columns}
    for name, count in counts.items():
        if count == 0:
            faults.append(column_fault(name, names, holder))
        elif count > 1:
            faults.append(f'column "{name}" occurs {count} times')
    return {name: names.index(name) for name, count in counts.items() if count == 1}


def _numbers(
    column: pandas.Series, marks: Marks, missing: tuple[str, ...], meaning: Meaning
) -> tuple[np.ndarray, np.ndarray, list[Unread]]:
    """Numbers of a column, True where a cell is no number, and the reasons."""
    import pandas as pd

    no_text = np.zeros(len(column), dtype=bool)
    if pd.api.types.is_numeric_dtype(column.dtype) and not pd.api.types.is_complex_dtype(column.dtype):
        numbers = column.to_numpy(dtype=float, na_value=np.nan)
        # an infinite reading counts as missing
        return np.where(np.isinf(numbers), np.nan, numbers), no_text, []
    if pd.api.types.is_datetime64_any_dtype(column.dtype) or pd.api.types.is_timedelta64_dtype(column.dtype):
        return np.full(len(column), np.nan), column.notna().to_numpy(), []
    plain = column.astype(object).map(_cell)
    absent = plain.isna() | plain.isin([*MISSING, *missing])
    values, refused = values_in(plain.where(~absent, None), marks, meaning)
    is_text = plain.isin(list(refused)) & ~absent
    return np.where(np.isinf(values), np.nan, values), is_text.to_numpy(), list(refused.values())


def _cell(cell: object) -> object:
    """A cell as a number, None where it is empty, else as text without surrounding blanks."""
    import pandas as pd

    if isinstance(cell, str):
        return cell.strip()
    if cell is None or isinstance(cell, Real | Decimal):
        return cell
    return None if pd.api.types.is_scalar(cell) and pd.isna(cell) else str(cell)


def _text_fault(
    name: str,
    column: pandas.Series,
    texts: np.ndarray,
    places: Places,
    reasons: Sequence[Unread],
    stated: Marks | None,
) -> str:
    """The fault of text in a column of numbers: its places, its content and the likely remedy."""
    rows = np.flatnonzero(texts)
    kind = {"M": "dates", "m": "durations"}.get(column.dtype.kind, "text")
    words = [str(cell).strip() for cell in column[texts].iloc[:1000]]
    specific_reason = next((reason for reason in reasons if reason.kind != "no number"), None)
    commas = evidence(column, ",") if kind == "text" and stated is None else "none"
    mark = "." if stated is not None and stated.decimal != "." else ","
    if specific_reason is not None:
        remedy = str(specific_reason)
    elif commas != "none":
        remedies = {"decimal": 'decimal = ","', "thousands": 'thousands = ","'}
        remedy = f"state {remedies.get(commas, ' or '.join(remedies.values()))}{places.here}"
    elif stated is not None and any(re.fullmatch(rf"[+-]?\d*[{mark}]\d*", word) for word in words):
        remedy = f'"{mark}" cannot divide thousands here: state decimal = "{mark}"{places.here}'
    elif kind != "text":
        remedy = "name another column"
    elif name in words:
        remedy = "the header is repeated among the rows: remove these lines"
    elif list(rows) == [0]:
        remedy = "if the line under the header holds units, remove it"
    else:
        listed = ", ".join(f'"{word}"' for word in dict.fromkeys(words[:_SHOWN]))
        remedy = (
            "correct them or, if this means that there is no reading, state "
            f"missing = [{listed}]{places.here}"
        )
    return (
        f'column "{name}": expected numbers, found {kind} in {len(rows)} of {len(column)} rows: '
        f"{_where(rows, column, places)}; {remedy}"
    )


def _where(rows: np.ndarray, column: pandas.Series, places: Places) -> str:
    """The first few rows with their content, such as: line 7 "error", line 9 "error", …"""
    shown = rows[:_SHOWN]
    parts = [
        f'{places.label} {number} "{str(column.iloc[row]).strip()[:40]}"'
        for number, row in zip(places.numbers(shown), shown, strict=False)
    ]
    return ", ".join(parts) + (", …" if len(rows) > _SHOWN else "")


def numbered(label: str, numbers: Sequence[int], total: int) -> str:
    """The first few of `total` rows by number, such as: lines 7, 9, 12, 15, 16 …"""
    listed = ", ".join(str(number) for number in numbers[:_SHOWN])
    return f"{label}{'s' if total > 1 and label == 'line' else ''} {listed}" + (
        " …" if total > _SHOWN else ""
    )


def _stamp_remedy(column: pandas.Series, unreadable: np.ndarray, here: str, stated: str | None) -> str:
    words = [str(cell).strip() for cell in column[unreadable].iloc[:200]]
    if column.name in words:
        return "; the header is repeated among the rows: remove these lines"
    forms = [form for form in fitting_formats(column[unreadable].iloc[:200]) if form not in (None, stated)]
    if forms:
        others = f" (or {' or '.join(map(repr, forms[1:3]))})" * (len(forms) > 1)
        return f'; state time_format = "{forms[0]}"{others}{here}'
    if all(re.fullmatch(r"\d+(\.\d*)?", word) for word in words):
        return "; bare numbers are not time stamps: export the time as text such as 2020-12-01T00:00Z"
    if all(word.startswith("#") for word in words):
        return '; if these are comments, state comment = "#"' + here
    if unreadable.sum() < len(column) / 2:
        return "; correct or remove these lines"
    return '; state the form of the stamps, such as time_format = "%d.%m.%Y %H:%M"' + (here and f",{here}")
