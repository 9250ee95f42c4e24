"""Tables of readings from files: CSV (also compressed) and Parquet."""

from __future__ import annotations

import csv
import gzip
import hashlib
import io
import os
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.data.columns import (
    HEADER,
    MISSING,
    FileColumns,
    Notation,
    Places,
    TableFault,
    column_fault,
    frame_table,
    numbered,
    places_of,
)
from hygrokf.data.numbers import Meaning
from hygrokf.data.quality import NOTHING_STATED, StatedQuality
from hygrokf.errors import suggestion

if TYPE_CHECKING:
    import pandas

SUFFIXES = (".csv", ".csv.gz", ".txt", ".tsv", ".parquet")
SEPARATORS = (";", "\t", ",", "|")
_HEADER_WITHIN = 200


def read_table(
    path: str | os.PathLike[str],
    columns: Mapping[str, Meaning],
    time_column: str,
    notation: Notation,
    quality: StatedQuality = NOTHING_STATED,
) -> FileColumns:
    """Columns of numbers and their stamps from a file, stamps in UTC [s].

    path: text (.csv, .csv.gz, .txt, .tsv) or .parquet (extra `parquet`).
    columns: names of the columns of numbers, and what their texts stand for.
    time_column: name of the column of stamps. Lines above the one that holds this name are skipped.
    notation: of stamps and numbers. quality: what is stated about the quality of the readings.

    Rows without a stamp are left out, with a warning. Raises TableFault with every fault found.
    """
    file = Path(path)
    if not file.name.lower().endswith(SUFFIXES) and not file.is_dir():
        raise TableFault(f"expected a file of the kind {', '.join(SUFFIXES)}, found {file.name}")
    return table_in(file_bytes(file), file.name, columns, time_column, notation, quality)


def table_in(
    content: bytes,
    name: str,
    columns: Mapping[str, Meaning],
    time_column: str,
    notation: Notation,
    quality: StatedQuality = NOTHING_STATED,
) -> FileColumns:
    """Columns of numbers and their stamps from the bytes of a file with this name; as `read_table`."""
    faults: list[str] = []
    wanted = list(columns)
    if name.lower().endswith(".parquet"):
        frame, quality_of = _parquet_source(content, wanted, time_column, quality, faults)
        places = Places("row", lambda rows: [int(row) + 1 for row in rows])
    else:
        frame, quality_of, lines = _csv_source(content, wanted, time_column, notation, quality, faults)
        places = Places("line", lambda rows: [lines[int(row)] for row in rows])
    if len(frame) == 0 and not faults:
        raise TableFault("expected readings, found no row below the header")
    stamps = frame[time_column] if time_column in frame else None
    digest = hashlib.sha256(content).hexdigest()
    description = f'column "{time_column}"'
    return frame_table(
        frame, columns, stamps, description, places, notation, quality, quality_of, faults, digest
    )


def file_bytes(file: Path) -> bytes:
    """All bytes of a file.  Raises TableFault for a file that is absent, empty, unreadable or a directory."""
    if file.is_dir():
        raise TableFault("is a directory, not a file")
    try:
        content = file.read_bytes()
    except FileNotFoundError:
        near = [entry.name for entry in file.parent.iterdir()] if file.parent.is_dir() else []
        raise TableFault(f"no such file: {file}{suggestion(file.name, near)}") from None
    except OSError as refused:
        raise TableFault(f"cannot be read: {refused.strerror or refused}") from None
    if not content:
        raise TableFault("the file is empty")
    return content


def unpacked(content: bytes) -> bytes:
    """The bytes of a file, decompressed if it is gzip.  Raises TableFault."""
    if content[:2] == b"\x1f\x8b":
        try:
            content = gzip.decompress(content)
        except (OSError, EOFError, zlib.error) as broken:
            raise TableFault(f"cannot be decompressed: {broken}") from None
    if not content.strip():
        raise TableFault("the file is empty")
    return content


_OTHER_KINDS = (
    (b"PK\x03\x04", "an Excel file or a ZIP archive: export it as CSV text"),
    (b"PAR1", "a Parquet file: name it .parquet"),
    (b"\xd0\xcf\x11\xe0", "an old Excel file (.xls) or one with a password: export it as CSV text"),
    (b"%PDF", "a PDF document: export the table as CSV"),
    (b"\x89PNG", "a picture: export the table as CSV"),
    (b"{", "JSON: export the table as CSV"),
)


def decoded_text(content: bytes) -> tuple[bytes, str]:
    """The bytes of a table of text and their encoding (see `decodable`).  Raises TableFault for others."""
    content = unpacked(content)
    for mark, kind in _OTHER_KINDS:
        if content.lstrip()[: len(mark)] == mark:
            raise TableFault(f"expected a table, found {kind}")
    if re.match(rb"\s*<(!doctype|html|\?xml)", content[:300], re.IGNORECASE):
        raise TableFault("expected a table, found a web page or XML: log in and download the export again")
    return decodable(content)


def csv_rows(content: bytes, encoding: str, separator: str = ",") -> Iterator[tuple[int, list[str]]]:
    """Number of the last line, and cells, of every row of a text.  Raises TableFault."""
    text = io.TextIOWrapper(io.BytesIO(content), encoding, errors="replace", newline="")
    reader = csv.reader(text, delimiter=separator)
    begin, cells = 1, list[str]()
    open_quote = "a quotation mark is opened and never closed"
    try:
        for cells in reader:
            yield reader.line_num, cells
            begin, last = reader.line_num + 1, begin
    except csv.Error as broken:
        reason = open_quote if reader.line_num > begin else str(broken)
        raise TableFault(f"line {begin}: {reason}") from None
    if any("\n" in cell for cell in cells) and content.count(b'"') % 2:
        raise TableFault(f"line {last}: {open_quote}")


def too_wide(rows: Iterable[tuple[int, list[str]]], width: int, separator: str, header: str) -> list[str]:
    """The fault of rows with more cells than the header, whose values might belong to other columns.

    rows: number and cells. header: its place, such as "line 1".
    """
    wide = [(number, cells) for number, cells in rows if any(cell.strip() for cell in cells[width:])]
    if not wide:
        return []
    example, remedy = separator.join(wide[0][1]), ""
    if separator == "," and re.search(r"\d,\d+(,|$)", example):
        remedy = "; numbers with a decimal comma need another separator or quotes: export again"
    where = numbered("line", [number for number, _ in wide], len(wide))
    expected = f"expected {width} cells as in the header ({header})"
    return [f'{where}: {expected}, found more: "{example[:80]}"{remedy}']


def _csv_header(
    content: bytes, encoding: str, separator: str, comment: str | None, time_column: str
) -> tuple[int, tuple[str, ...]] | None:
    """Line and names of the header: the first line that names the time column, else the first one that is
    neither blank nor a comment."""
    first: tuple[int, tuple[str, ...]] | None = None
    mark = comment or "#"
    for number, cells in csv_rows(content, encoding, separator):
        if number > _HEADER_WITHIN:
            break
        names = [cell.strip() for cell in cells]
        bare = [names[0].removeprefix(mark).strip(), *names[1:]] if names else []
        for candidate in (names, bare):
            if time_column in candidate:
                return number, tuple(candidate)
        if first is None and any(names) and not names[0].startswith(mark):
            first = number, tuple(names)
    return first


def _other_separator(content: bytes, encoding: str, notation: Notation, time_column: str) -> str | None:
    """The fault of the stated separator, if the header has the time column with another separator."""
    for candidate in SEPARATORS:
        with suppress(TableFault):
            header = _csv_header(content, encoding, candidate, notation.comment, time_column)
            if header is None or candidate == notation.separator:
                continue
            line, names = header
            if len(names) > 1 and time_column in names:
                shown = "\\t" if candidate == "\t" else candidate
                comma = ' and, if numbers are written as 1,5, decimal = ","' if candidate != "," else ""
                return (
                    f'line {line}: the columns are separated by "{shown}", not by '
                    f'"{notation.separator}": state separator = "{shown}"{comma} in this source'
                )
    return None


def _csv_source(
    content: bytes,
    wanted: list[str],
    time_column: str,
    notation: Notation,
    quality: StatedQuality,
    faults: list[str],
) -> tuple[pandas.DataFrame, dict[str, str], list[int]]:
    """The wanted columns as texts, column -> column of its quality, and the line of each row.

    Missing columns are added to `faults`.
    """
    import pandas as pd

    content, encoding = decoded_text(content)
    separator, comment = notation.separator, notation.comment
    header = _csv_header(content, encoding, separator, comment, time_column)
    if header is None:
        faults.append("expected a header line, found only blank lines or comments")
        return pd.DataFrame(), {}, []
    line, names = header
    if time_column not in names:
        separator_fault = _other_separator(content, encoding, notation, time_column)
        faults.append(separator_fault or column_fault(time_column, names, f"line {line} has"))
        if separator_fault is not None:
            return pd.DataFrame(), {}, []
    quality_of = quality.beside(names, wanted)
    quality_names = dict.fromkeys(quality_of.values())
    used = [name for name in (time_column, *wanted, *quality_names) if name != time_column or name in names]
    positions = places_of(used, names, f"line {line} has", faults)
    lines, rows, wide, width = list[int](), list[list[str]](), list[tuple[int, list[str]]](), len(names)
    for number, cells in csv_rows(content, encoding, separator):
        blank = len(cells) <= 1 and not any(cell.strip() for cell in cells)
        if number <= line or blank or (comment and cells[0].lstrip().startswith(comment)):
            continue
        if any(cells[width:]):
            wide.append((number, cells))
        cells += [""] * (width - len(cells))
        lines.append(number)
        rows.append([cells[place].strip() for place in positions.values()])
    faults += too_wide(wide, width, separator, f"line {line}")
    # a text for a missing reading may be a mark in a column of quality
    absent = {name: {""} if name in quality_names else {*MISSING, *notation.missing} for name in positions}
    columns = {
        name: [None if row[place] in absent[name] else row[place] for row in rows]
        for place, name in enumerate(positions)
    }
    frame = pd.DataFrame(columns, dtype=object)
    frame.attrs[HEADER] = names
    return frame, quality_of, lines


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
    """A frame of columns of a Parquet file, with the names of all its columns.  Raises TableFault.

    select: chooses the columns to read from the names of all columns; None: all.
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
    """The wanted columns, and column -> column of its quality; missing columns are added to `faults`."""
    quality_of: dict[str, str] = {}

    def select(names: list[str]) -> list[str]:
        quality_of.update(quality.beside(names, wanted))
        return [*places_of([time_column, *wanted, *quality_of.values()], names, "the file has", faults)]

    return parquet_frame(content, select), quality_of
