"""Tables of readings from files: CSV (also compressed) and Parquet."""

from __future__ import annotations

import csv
import gzip
import hashlib
import io
import os
import re
import warnings as python_warnings
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.signals import suggestion
from hygrokf.stamps import read_stamps, zone_named

if TYPE_CHECKING:
    import pandas

MISSING = (
    "",
    "NaN",
    "nan",
    "NAN",
    "NA",
    "na",
    "N/A",
    "n/a",
    "#N/A",
    "null",
    "NULL",
    "Null",
)
MISSING += ("None", "none", "<NA>", "-", "--", "---")
"""What counts as a missing reading, besides what the case file lists."""

SUFFIXES = (".csv", ".csv.gz", ".parquet")
_HEADER_WITHIN = 200
_SHOWN = 5


class TableFault(Exception):
    """A table that cannot be read; `faults` lists every reason."""

    def __init__(self, faults: Sequence[str]) -> None:
        self.faults = tuple(faults)
        super().__init__("\n".join(self.faults))


@dataclass(frozen=True)
class Table:
    """Columns of a file, in the order of the file.

    time: [s] (N,) since 1970-01-01T00:00Z; finite, neither sorted nor unique yet.
    values: column name -> (N,) as in the file; NaN = missing.
    warnings: rows that were left out, and why.
    sha256: of the file.
    """

    time: np.ndarray
    values: dict[str, np.ndarray]
    warnings: tuple[str, ...]
    sha256: str


@dataclass(frozen=True)
class _Layout:
    """Where the cells of a CSV file are."""

    header_line: int
    names: tuple[str, ...]


def read_table(
    path: str | os.PathLike[str],
    columns: Sequence[str],
    time_column: str,
    *,
    timezone: str | None = None,
    separator: str = ",",
    decimal: str = ".",
    comment: str | None = None,
    missing: Sequence[str] = (),
    time_format: str | None = None,
    ignore_offset: bool = False,
) -> Table:
    """Columns of numbers and their stamps from a file, stamps in UTC [s].

    path: .csv, .csv.gz or .parquet (extra `parquet`).
    columns: names of the columns of numbers.
    time_column: name of the column of stamps; ISO 8601 unless `time_format` says else. Lines
        above the one that holds this name are skipped.
    timezone: of stamps without an offset: "+02:00", "UTC" or an IANA name.
    separator, decimal: of a CSV file. comment: what starts a line to be skipped.
    missing: texts that mean no reading, besides `MISSING`.
    time_format: strptime format of the stamps.
    ignore_offset: take stamps without the offset that they carry, in `timezone`.

    Rows without stamp are left out and said. Raises TableFault with every fault found.
    """
    file = Path(path)
    faults: list[str] = []
    zone = None
    if timezone is not None:
        try:
            zone = zone_named(timezone)
        except ValueError as unknown:
            faults.append(str(unknown))
            # Any zone will do to look for further faults.
            zone = UTC
    content = _content(file)
    digest = hashlib.sha256(content).hexdigest()
    wanted = list(dict.fromkeys(columns))
    if file.name.lower().endswith(".parquet"):
        frame = _parquet_frame(content, wanted, time_column, faults)
        source = None
    else:
        source = _CsvSource(content, file.name, separator, decimal, comment, tuple(missing))
        frame = source.frame(wanted, time_column, faults)
    if len(frame) == 0 and not faults:
        raise TableFault(["expected readings, found no row below the header"])

    values = {}
    for name in wanted:
        if name not in frame:
            continue
        numbers, texts = _numbers(frame[name], decimal, tuple(missing))
        values[name] = numbers
        if texts.any():
            faults.append(_text_fault(name, frame[name], texts, source, decimal))
    warnings: list[str] = []
    time = np.full(len(frame), np.nan)
    if time_column in frame:
        stamps = read_stamps(
            frame[time_column],
            zone,
            time_format=time_format,
            ignore_offset=ignore_offset,
        )
        time = stamps.time
        column = f'column "{time_column}"'
        if stamps.unreadable.any():
            where = _where(np.flatnonzero(stamps.unreadable), frame[time_column], source)
            faults.append(
                f"{column}: expected ISO 8601 stamps"
                + (f' or "{time_format}"' if time_format else "")
                + f", found {int(stamps.unreadable.sum())} of {len(frame)} rows otherwise: {where}"
                + _stamp_remedy(frame[time_column], stamps.unreadable, time_column)
            )
        if stamps.naive.any():
            rows = np.flatnonzero(stamps.naive)
            faults.append(
                f"{column}: {len(rows)} of {len(frame)} stamps have no offset "
                f"({_where(rows[:1], frame[time_column], source)}); state their zone in this "
                'source: timezone = "UTC", a fixed offset such as "+01:00", or a name such as '
                '"Europe/Berlin"'
            )
        elif zone is not None and not ignore_offset and _all_aware(frame[time_column]):
            warnings.append(f'timezone = "{timezone}" is not used: the stamps carry offsets')
        warnings += stamps.warnings
        given = frame[time_column].notna().to_numpy()
        lost = ~given & np.any([np.isfinite(one) for one in values.values()] or [~given], axis=0)
        if lost.any():
            where = _lines(np.flatnonzero(lost), source)
            count = int(lost.sum())
            rows = "1 row" if count == 1 else f"{count} rows"
            warnings.append(f"{rows} without a stamp left out: {where}")
    if faults:
        raise TableFault(faults)
    keep = np.isfinite(time)
    if not keep.any():
        raise TableFault(["expected readings, found no row with a stamp that can be used"])
    return Table(
        time[keep],
        {name: array[keep] for name, array in values.items()},
        tuple(warnings),
        digest,
    )


def _content(file: Path) -> bytes:
    """All bytes of a file. Raises TableFault for what is no readable file."""
    name = file.name.lower()
    if not name.endswith(SUFFIXES):
        if file.is_dir():
            raise TableFault(["is a directory, not a file"])
        raise TableFault([f"expected a file of the kind {', '.join(SUFFIXES)}, found {file.name}"])
    try:
        content = file.read_bytes()
    except FileNotFoundError:
        near = [one.name for one in file.parent.iterdir()] if file.parent.is_dir() else []
        raise TableFault([f"no such file: {file}{suggestion(file.name, near)}"]) from None
    except IsADirectoryError:
        raise TableFault(["is a directory, not a file"]) from None
    except OSError as refused:
        raise TableFault([f"cannot be read: {refused.strerror or refused}"]) from None
    if not content:
        raise TableFault(["the file is empty"])
    return content


def _column_fault(name: str, found: Sequence[str], holder: str) -> str:
    """A missing column, with the columns there are."""
    shown = ", ".join(f'"{one}"' for one in found[:40]) + (" …" if len(found) > 40 else "")
    return f'no column "{name}" ({holder} has {shown}){suggestion(name, found)}'


class _CsvSource:
    """The bytes of one CSV file and what its lines mean."""

    def __init__(
        self,
        content: bytes,
        name: str,
        separator: str,
        decimal: str,
        comment: str | None,
        missing: tuple[str, ...],
    ) -> None:
        if name.lower().endswith(".gz") or content[:2] == b"\x1f\x8b":
            try:
                content = gzip.decompress(content)
            except (OSError, EOFError, zlib.error) as broken:
                raise TableFault([f"cannot be decompressed: {broken}"]) from None
            if not content.strip():
                raise TableFault(["the file is empty"])
        if content[:4] in (b"PK\x03\x04", b"\xd0\xcf\x11\xe0"):
            raise TableFault(["is an Excel file or a ZIP archive; export it as CSV text"])
        if content[:4] == b"PAR1":
            raise TableFault(["is a Parquet file; name it .parquet"])
        self.content, self.encoding = _decodable(content)
        self.separator, self.decimal, self.comment = separator, decimal, comment
        self.missing = missing
        self.layout = _Layout(0, ())

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        """Line number (of the row's last line) and cells of every row that is not blank."""
        text = io.TextIOWrapper(io.BytesIO(self.content), self.encoding, newline="")
        reader = csv.reader(text, delimiter=self.separator)
        try:
            for cells in reader:
                if not any(cell.strip() for cell in cells) and len(cells) <= 1:
                    continue
                if self.comment and cells[0].lstrip().startswith(self.comment):
                    continue
                yield reader.line_num, cells
        except csv.Error as broken:
            raise TableFault([f"line {reader.line_num}: {broken}"]) from None

    def _layout(self, time_column: str, faults: list[str]) -> _Layout | None:
        """The header: the first line that names the time column."""
        text = io.TextIOWrapper(io.BytesIO(self.content), self.encoding, newline="")
        reader = csv.reader(text, delimiter=self.separator)
        first: _Layout | None = None
        mark = self.comment or "#"
        while reader.line_num < _HEADER_WITHIN:
            try:
                cells = next(reader)
            except (StopIteration, csv.Error):
                break
            names = [cell.strip() for cell in cells]
            bare = [names[0].removeprefix(mark).strip(), *names[1:]] if names else []
            for candidate in (names, bare):
                if time_column in candidate:
                    return _Layout(reader.line_num, tuple(candidate))
            comment = bool(names) and names[0].startswith(mark)
            if first is None and any(names) and not comment:
                first = _Layout(reader.line_num, tuple(names))
        if first is None:
            faults.append("expected a header line, found only blank lines or comments")
            return None
        other = self._other_separator(time_column)
        if other is not None:
            shown = "\\t" if other == "\t" else other
            comma = ' and, if numbers are written as 1,5, decimal = ","'
            faults.append(
                f'line {first.header_line}: the columns are separated by "{shown}", not by '
                f'"{self.separator}": state separator = "{shown}"{comma if other != "," else ""} '
                "in this source"
            )
            return None
        holder = f"line {first.header_line}"
        faults.append(_column_fault(time_column, first.names, holder))
        return first

    def _other_separator(self, time_column: str) -> str | None:
        for other in (";", "\t", ",", "|"):
            if other == self.separator:
                continue
            head = self.content[:65536].decode(self.encoding, errors="replace")
            for line in head.splitlines()[:_HEADER_WITHIN]:
                names = [cell.strip().strip('"').lstrip("# ") for cell in line.split(other)]
                if len(names) > 1 and time_column in names:
                    return other
        return None

    def frame(self, wanted: list[str], time_column: str, faults: list[str]) -> pandas.DataFrame:
        """The wanted columns as pandas reads them; columns that are not there become faults."""
        import pandas as pd

        layout = self._layout(time_column, faults)
        if layout is None:
            return pd.DataFrame()
        self.layout = layout
        positions = {}
        for name in dict.fromkeys([time_column, *wanted]):
            count = layout.names.count(name)
            if count == 1:
                positions[name] = layout.names.index(name)
            elif count > 1:
                faults.append(f'line {layout.header_line}: column "{name}" occurs {count} times')
            elif name != time_column:
                holder = f"line {layout.header_line}"
                faults.append(_column_fault(name, layout.names, holder))
        if not positions:
            return pd.DataFrame()
        faults += self._width_faults(len(layout.names))
        order = sorted(positions, key=positions.get)
        try:
            with python_warnings.catch_warnings():
                python_warnings.simplefilter("ignore", pd.errors.ParserWarning)
                return pd.read_csv(
                    io.BytesIO(self.content),
                    encoding=self.encoding,
                    sep=self.separator,
                    decimal=self.decimal,
                    comment=self.comment if self.comment and len(self.comment) == 1 else None,
                    header=None,
                    skiprows=layout.header_line,
                    usecols=[positions[name] for name in order],
                    names=order,
                    index_col=False,
                    dtype={time_column: object},
                    keep_default_na=False,
                    na_values=[*MISSING, *self.missing],
                    skipinitialspace=True,
                    low_memory=False,
                )
        except pd.errors.EmptyDataError:
            return pd.DataFrame({name: [] for name in order})
        except (pd.errors.ParserError, UnicodeDecodeError) as broken:
            open_quote = re.search(r"EOF inside string starting at row (\d+)", str(broken))
            if open_quote is not None:
                line = int(open_quote[1]) + 1
                faults.append(f"line {line}: a quotation mark is opened and never closed")
            else:
                faults.append(f"cannot be read as CSV: {broken}")
            return pd.DataFrame()

    def _width_faults(self, width: int) -> list[str]:
        """Rows with more cells than the header: their values would shift unseen."""
        if b'"' not in self.content:
            data = np.frombuffer(self.content, dtype=np.uint8)
            ends = np.flatnonzero(data == 10)
            marks = np.flatnonzero(data == ord(self.separator))
            cells = np.diff(np.searchsorted(marks, np.append(ends, len(data))), prepend=0) + 1
            if not np.any(cells[self.layout.header_line :] > width):
                return []
        wide, example = [], ""
        for number, cells in self._rows():
            if number <= self.layout.header_line or len(cells) <= width:
                continue
            if any(cell.strip() for cell in cells[width:]):
                wide.append(number)
                example = example or self.separator.join(cells)
        if not wide:
            return []
        remedy = ""
        if self.separator == "," and re.search(r"\d,\d+(,|$)", example):
            remedy = "; numbers with a decimal comma need another separator or quotes: export again"
        header = f"expected {width} cells as in the header (line {self.layout.header_line})"
        return [f'{_numbered(wide)}: {header}, found more: "{example[:80]}"{remedy}']

    def line_numbers(self, rows: np.ndarray) -> list[int]:
        """Line numbers of rows of the frame."""
        wanted = {int(row) for row in rows}
        found, row = {}, 0
        for number, _ in self._rows():
            if number <= self.layout.header_line:
                continue
            if row in wanted:
                found[row] = number
                if len(found) == len(wanted):
                    break
            row += 1
        return [found[int(row)] for row in rows if int(row) in found]


def _decodable(content: bytes) -> tuple[bytes, str]:
    """The bytes in an encoding that pandas reads, without byte-order mark, and its name."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        try:
            return content.decode("utf-16").encode(), "utf-8"
        except UnicodeDecodeError as broken:
            raise TableFault([f"is no text: {broken}"]) from None
    if b"\x00" in content:
        line = content[: content.index(b"\x00")].count(b"\n") + 1
        raise TableFault([f"line {line}: is no text (a zero byte); the file may be damaged"])
    content = content.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in content and b"\n" not in content:
        content = content.replace(b"\r", b"\n")
    try:
        content.decode("utf-8")
    except UnicodeDecodeError:
        return content, "cp1252" if _is_cp1252(content) else "latin-1"
    return content, "utf-8"


def _is_cp1252(content: bytes) -> bool:
    try:
        content.decode("cp1252")
    except UnicodeDecodeError:
        return False
    return True


def _parquet_frame(
    content: bytes, wanted: list[str], time_column: str, faults: list[str]
) -> pandas.DataFrame:
    import pandas as pd

    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise TableFault(
            ['reading .parquet needs the extra "parquet": pip install "hygrokf[parquet]"']
        ) from None
    try:
        file = parquet.ParquetFile(pyarrow.BufferReader(content))
        found = list(file.schema_arrow.names)
        there = [name for name in dict.fromkeys([time_column, *wanted]) if name in found]
        for name in dict.fromkeys([time_column, *wanted]):
            if name not in found:
                faults.append(_column_fault(name, found, "the file"))
        if not there:
            return pd.DataFrame()
        return file.read(columns=there).to_pandas(ignore_metadata=True)
    except pyarrow.ArrowException as broken:
        reason = str(broken).splitlines()[0]
        raise TableFault([f"cannot be read as Parquet: {reason}"]) from None


def _numbers(column: pandas.Series, decimal: str, missing: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of a column and where it holds text instead."""
    import pandas as pd

    nothing = np.zeros(len(column), dtype=bool)
    if pd.api.types.is_numeric_dtype(column.dtype):
        numbers = column.to_numpy(dtype=float, na_value=np.nan)
        # An infinite reading is no reading.
        return np.where(np.isinf(numbers), np.nan, numbers), nothing
    if pd.api.types.is_datetime64_any_dtype(column.dtype):
        return np.full(len(column), np.nan), column.notna().to_numpy()
    text = column.astype(object)
    flags = text.map({"true": 1.0, "false": 0.0, "True": 1.0, "False": 0.0, True: 1.0, False: 0.0})
    plain = text.map(lambda one: one.strip() if isinstance(one, str) else one)
    if decimal != ".":
        plain = plain.map(lambda one: one.replace(decimal, ".") if isinstance(one, str) else one)
    absent = text.isna() | plain.isin([*MISSING, *missing])
    numbers = pd.to_numeric(plain.where(~absent, None), errors="coerce").astype(float)
    numbers = numbers.where(numbers.notna(), flags.astype(float))
    wrong = numbers.isna() & ~absent
    values = numbers.to_numpy()
    return np.where(np.isinf(values), np.nan, values), wrong.to_numpy()


def _text_fault(
    name: str,
    column: pandas.Series,
    texts: np.ndarray,
    source: _CsvSource | None,
    decimal: str,
) -> str:
    """Text in a column of numbers: where, what, and the likely remedy."""
    rows = np.flatnonzero(texts)
    words = [str(one).strip() for one in column[texts].iloc[:1000]]
    if any(re.fullmatch(r"-?\d+,\d+", word) for word in words) and decimal == ".":
        remedy = 'state decimal = "," in this source'
    elif any(re.fullmatch(r"-?\d{1,3}(,\d{3})+(\.\d+)?", word) for word in words):
        remedy = "export without thousands separators"
    elif name in words:
        remedy = "the header is repeated among the rows: remove these lines"
    elif list(rows) == [0]:
        remedy = "if the line under the header holds units, remove it"
    else:
        listed = ", ".join(f'"{word}"' for word in dict.fromkeys(words[:_SHOWN]))
        remedy = (
            "correct the file or, if this means that there is no reading, state "
            f"missing = [{listed}] in this source"
        )
    return (
        f'column "{name}": expected numbers, found text in {len(rows)} of {len(column)} rows: '
        f"{_where(rows, column, source)}; {remedy}"
    )


def _where(rows: np.ndarray, column: pandas.Series, source: _CsvSource | None) -> str:
    """The first few rows with what they hold, such as: line 7 "error", line 9 "error", …"""
    shown = rows[:_SHOWN]
    numbers = source.line_numbers(shown) if source is not None else [row + 1 for row in shown]
    label = "line" if source is not None else "row"
    parts = [
        f'{label} {number} "{str(column.iloc[row]).strip()[:40]}"'
        for number, row in zip(numbers, shown, strict=False)
    ]
    return ", ".join(parts) + (", …" if len(rows) > _SHOWN else "")


def _lines(rows: np.ndarray, source: _CsvSource | None) -> str:
    shown = rows[:_SHOWN]
    if source is None:
        return "row " + ", ".join(str(row + 1) for row in shown)
    return _numbered(source.line_numbers(shown), len(rows))


def _numbered(lines: Sequence[int], total: int | None = None) -> str:
    count = len(lines) if total is None else total
    listed = ", ".join(str(line) for line in lines[:_SHOWN])
    return f"line{'s' if count > 1 else ''} {listed}" + (" …" if count > _SHOWN else "")


def _stamp_remedy(column: pandas.Series, unreadable: np.ndarray, time_column: str) -> str:
    words = [str(one).strip() for one in column[unreadable].iloc[:200]]
    if time_column in words:
        return "; the header is repeated among the rows: remove these lines"
    if all(re.fullmatch(r"\d+(\.\d*)?", word) for word in words):
        return "; bare numbers are no stamps: export the time as text such as 2020-12-01T00:00Z"
    for pattern, form in (
        (r"\d{1,2}\.\d{1,2}\.\d{4} \d{1,2}:\d{2}:\d{2}", "%d.%m.%Y %H:%M:%S"),
        (r"\d{1,2}\.\d{1,2}\.\d{4} \d{1,2}:\d{2}", "%d.%m.%Y %H:%M"),
        (r"\d{1,2}/\d{1,2}/\d{4} \d{1,2}:\d{2}:\d{2}", "%d/%m/%Y %H:%M:%S"),
        (r"\d{1,2}/\d{1,2}/\d{4} \d{1,2}:\d{2}", "%d/%m/%Y %H:%M"),
    ):
        if all(re.fullmatch(pattern, word) for word in words):
            ask = " (or month first: %m/%d)" if "/" in form else ""
            return f'; state time_format = "{form}"{ask} in this source'
    if all(word.startswith("#") for word in words):
        return '; if these are comments, state comment = "#" in this source'
    if unreadable.sum() < len(column) / 2:
        return "; correct or remove these lines"
    return '; state the form of the stamps, such as time_format = "%d.%m.%Y %H:%M", in this source'


def _all_aware(column: pandas.Series) -> bool:
    """True where stamps are no local ones; only asked after read_stamps found none naive."""
    import pandas as pd

    if pd.api.types.is_datetime64_any_dtype(column.dtype):
        return column.dt.tz is not None
    first = column.dropna()
    return (
        len(first) > 0
        and re.search(r"([zZ]|UTC|GMT|[+-]\d{2}(:?\d{2})?)\s*$", str(first.iloc[0])) is not None
    )
