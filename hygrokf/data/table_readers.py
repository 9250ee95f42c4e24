"""Tables of readings from files: CSV (also compressed) and Parquet."""

from __future__ import annotations

import csv
import gzip
import hashlib
import io
import itertools
import os
import re
import warnings as python_warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.columns import (
    HEADER,
    MISSING,
    Notation,
    Places,
    Table,
    TableFault,
    column_fault,
    numbered,
    table_of,
)
from hygrokf.data.numbers import POINT, could_divide_thousands
from hygrokf.data.quality import StatedQuality
from hygrokf.errors import suggestion

if TYPE_CHECKING:
    import pandas

SUFFIXES = (".csv", ".csv.gz", ".txt", ".tsv", ".parquet")
_HEADER_WITHIN = 200


def read_table(
    path: str | os.PathLike[str], columns: Sequence[str], time_column: str, notation: Notation
) -> Table:
    """Columns of numbers and their stamps from a file, stamps in UTC [s].

    path: text (.csv, .csv.gz, .txt, .tsv) or .parquet (extra `parquet`).
    columns: names of the columns of numbers.
    time_column: name of the column of stamps. Lines above the one that holds this name are skipped.
    notation: of stamps and numbers.

    Rows without a stamp are left out, with a warning. Raises TableFault with every fault found.
    """
    file = Path(path)
    if not file.name.lower().endswith(SUFFIXES) and not file.is_dir():
        raise TableFault(f"expected a file of the kind {', '.join(SUFFIXES)}, found {file.name}")
    return table_in(file_bytes(file), file.name, columns, time_column, notation)


def table_in(
    content: bytes, name: str, columns: Sequence[str], time_column: str, notation: Notation
) -> Table:
    """Columns of numbers and their stamps from the bytes of a file with this name; as `read_table`."""
    faults: list[str] = []
    wanted = list(dict.fromkeys(columns))
    if name.lower().endswith(".parquet"):
        frame, beside = _parquet_source(content, wanted, time_column, notation.quality, faults)
        places = Places("row", lambda rows: [int(row) + 1 for row in rows])
    else:
        source = _CsvSource(content, notation)
        frame, beside = source.frame(wanted, time_column, faults)
        frame.attrs[HEADER] = source.names if len(frame) else ()
        places = Places("line", source.line_numbers)
    if len(frame) == 0 and not faults:
        raise TableFault("expected readings, found no row below the header")
    stamps = frame[time_column] if time_column in frame else None
    digest = hashlib.sha256(content).hexdigest()
    named = f'column "{time_column}"'
    return table_of(frame, wanted, stamps, named, places, notation, beside, faults, digest)


def file_bytes(file: Path) -> bytes:
    """All bytes of a file.  Raises TableFault for a file that is absent, empty, unreadable or a directory."""
    if file.is_dir():
        raise TableFault("is a directory, not a file")
    try:
        content = file.read_bytes()
    except FileNotFoundError:
        near = [one.name for one in file.parent.iterdir()] if file.parent.is_dir() else []
        raise TableFault(f"no such file: {file}{suggestion(file.name, near)}") from None
    except OSError as refused:
        raise TableFault(f"cannot be read: {refused.strerror or refused}") from None
    if not content:
        raise TableFault("the file is empty")
    return content


def unpacked(content: bytes) -> bytes:
    """The bytes of a file, out of gzip where they are packed.  Raises TableFault."""
    if content[:2] == b"\x1f\x8b":
        try:
            content = gzip.decompress(content)
        except (OSError, EOFError, zlib.error) as broken:
            raise TableFault(f"cannot be decompressed: {broken}") from None
    if not content.strip():
        raise TableFault("the file is empty")
    return content


class _CsvSource:
    """The bytes of one CSV file and the layout of its lines."""

    def __init__(self, content: bytes, notation: Notation) -> None:
        content = unpacked(content)
        if content[:4] in (b"PK\x03\x04", b"\xd0\xcf\x11\xe0"):
            raise TableFault("is an Excel file or a ZIP archive; export it as CSV text")
        if content[:4] == b"PAR1":
            raise TableFault("is a Parquet file; name it .parquet")
        self.content, self.encoding = decodable(content)
        self.separator, self.marks, self.comment = notation.separator, notation.marks, notation.comment
        self.missing, self.quality = notation.missing, notation.quality
        self.header_line, self.names = 0, tuple[str, ...]()

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
            raise TableFault(f"line {reader.line_num}: {broken}") from None

    def _find_header(self, time_column: str, faults: list[str]) -> bool:
        """Find the header, the first line that names the time column; False where no column can be read."""
        text = io.TextIOWrapper(io.BytesIO(self.content), self.encoding, newline="")
        reader = csv.reader(text, delimiter=self.separator)
        first: tuple[int, tuple[str, ...]] | None = None
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
                    self.header_line, self.names = reader.line_num, tuple(candidate)
                    return True
            comment = bool(names) and names[0].startswith(mark)
            if first is None and any(names) and not comment:
                first = reader.line_num, tuple(names)
        if first is None:
            faults.append("expected a header line, found only blank lines or comments")
            return False
        self.header_line, self.names = first
        other = self._other_separator(time_column)
        if other is not None:
            shown = "\\t" if other == "\t" else other
            comma = ' and, if numbers are written as 1,5, decimal = ","'
            faults.append(
                f'line {self.header_line}: the columns are separated by "{shown}", not by '
                f'"{self.separator}": state separator = "{shown}"{comma if other != "," else ""} '
                "in this source"
            )
            return False
        faults.append(column_fault(time_column, self.names, f"line {self.header_line} has"))
        return True

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

    def frame(
        self, wanted: list[str], time_column: str, faults: list[str]
    ) -> tuple[pandas.DataFrame, dict[str, str]]:
        """The wanted columns as pandas reads them, missing ones as faults; column -> that of its quality."""
        import pandas as pd

        if not self._find_header(time_column, faults):
            return pd.DataFrame(), {}
        positions = {}
        beside = self.quality.beside(self.names, wanted)
        marks = dict.fromkeys(beside.values())
        for name in dict.fromkeys([time_column, *wanted, *marks]):
            count = self.names.count(name)
            if count == 1:
                positions[name] = self.names.index(name)
            elif count > 1:
                faults.append(f'line {self.header_line}: column "{name}" occurs {count} times')
            elif name != time_column:
                faults.append(column_fault(name, self.names, f"line {self.header_line} has"))
        if not positions:
            return pd.DataFrame(), beside
        faults += self._width_faults()
        order = sorted(positions, key=positions.__getitem__)
        try:
            texts = [time_column, *marks]
            while True:
                with python_warnings.catch_warnings():
                    python_warnings.simplefilter("ignore", pd.errors.ParserWarning)
                    frame = pd.read_csv(
                        io.BytesIO(self.content),
                        encoding=self.encoding,
                        sep=self.separator,
                        decimal=(self.marks or POINT).decimal,
                        comment=self.comment if self.comment and len(self.comment) == 1 else None,
                        header=None,
                        skiprows=self.header_line,
                        usecols=[positions[name] for name in order],
                        names=order,
                        index_col=False,
                        dtype=dict.fromkeys(texts, object),
                        keep_default_na=False,
                        # a text that says that there is no reading may say so of its quality too
                        na_values={n: [""] if n in marks else [*MISSING, *self.missing] for n in order},
                        skipinitialspace=True,
                        low_memory=False,
                    )
                floats = [one for one in frame if frame[one].dtype == float and self.marks is None]
                doubtful = [one for one in floats if could_divide_thousands(frame[one].to_numpy())]
                if not doubtful:
                    return frame, beside
                texts += doubtful  # only the texts tell what their points mean
        except pd.errors.EmptyDataError:
            return pd.DataFrame({name: [] for name in order}), beside
        except (pd.errors.ParserError, UnicodeDecodeError) as broken:
            open_quote = re.search(r"EOF inside string starting at row (\d+)", str(broken))
            if open_quote is not None:
                line = int(open_quote[1]) + 1
                faults.append(f"line {line}: a quotation mark is opened and never closed")
            else:
                faults.append(f"cannot be read as CSV: {broken}")
            return pd.DataFrame(), beside

    def _width_faults(self) -> list[str]:
        """Fault of rows with more cells than the header, whose values would otherwise shift silently."""
        width = len(self.names)
        if b'"' not in self.content:
            data = np.frombuffer(self.content, dtype=np.uint8)
            ends = np.flatnonzero(data == 10)
            marks = np.flatnonzero(data == ord(self.separator))
            counts = np.diff(np.searchsorted(marks, np.append(ends, len(data))), prepend=0) + 1
            if not np.any(counts[self.header_line :] > width):
                return []
        wide, example = [], ""
        for number, cells in self._rows():
            if number <= self.header_line or len(cells) <= width:
                continue
            if any(cell.strip() for cell in cells[width:]):
                wide.append(number)
                example = example or self.separator.join(cells)
        if not wide:
            return []
        remedy = ""
        if self.separator == "," and re.search(r"\d,\d+(,|$)", example):
            remedy = "; numbers with a decimal comma need another separator or quotes: export again"
        header = f"expected {width} cells as in the header (line {self.header_line})"
        return [f'{numbered("line", wide, len(wide))}: {header}, found more: "{example[:80]}"{remedy}']

    def line_numbers(self, rows: np.ndarray) -> list[int]:
        """Line numbers of rows of the frame."""
        numbers = (number for number, _ in self._rows() if number > self.header_line)
        first = list(itertools.islice(numbers, int(max(rows, default=-1)) + 1))
        return [first[int(row)] for row in rows if row < len(first)]


def decodable(content: bytes) -> tuple[bytes, str]:
    """The bytes in an encoding that pandas reads, without byte-order mark, and the name of the encoding."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        try:
            return content.decode("utf-16").encode(), "utf-8"
        except UnicodeDecodeError as broken:
            raise TableFault(f"is not text: {broken}") from None
    if b"\x00" in content:
        line = content[: content.index(b"\x00")].count(b"\n") + 1
        raise TableFault(f"line {line}: is not text (a zero byte); the file may be damaged")
    content = content.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in content and b"\n" not in content:
        content = content.replace(b"\r", b"\n")
    for encoding in ("utf-8", "cp1252"):
        with suppress(UnicodeDecodeError):
            content.decode(encoding)
            return content, encoding
    return content, "latin-1"


def parquet_frame(content: bytes, select: Callable[[list[str]], list[str]] | None = None) -> pandas.DataFrame:
    """A frame of columns of a Parquet file, with the names of all of them.  Raises TableFault.

    select: the columns to read, from the names of all; None: all.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise TableFault(
            'reading .parquet needs the extra "parquet": pip install "hygrokf[parquet]"'
        ) from None
    try:
        file = parquet.ParquetFile(pyarrow.BufferReader(content))
        names = list(file.schema_arrow.names)
        columns = names if select is None else select(names)
        frame = file.read(columns=columns).to_pandas(ignore_metadata=True)
    except pyarrow.ArrowException as broken:
        reason = str(broken).splitlines()[0]
        raise TableFault(f"cannot be read as Parquet: {reason}") from None
    frame.attrs[HEADER] = names
    return frame


def _parquet_source(
    content: bytes, wanted: list[str], time_column: str, quality: StatedQuality, faults: list[str]
) -> tuple[pandas.DataFrame, dict[str, str]]:
    """The wanted columns, missing ones as faults; column -> that of its quality."""
    beside: dict[str, str] = {}

    def select(found: list[str]) -> list[str]:
        beside.update(quality.beside(found, wanted))
        columns = dict.fromkeys([time_column, *wanted, *beside.values()])
        faults.extend(column_fault(name, found, "the file has") for name in columns if name not in found)
        return [name for name in columns if name in found]

    return parquet_frame(content, select), beside
