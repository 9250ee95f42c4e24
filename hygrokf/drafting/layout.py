"""The layout of an export: separator, header, row of units, decimal mark; its cells as text."""

from __future__ import annotations

import csv
import io
import re
import zipfile
import zlib
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.data.columns import MISSING, TableFault
from hygrokf.data.numbers import FLAGS, POLES, Marks, Meaning, Unread, evidence, unit_among, values_in
from hygrokf.data.signals import unit_named
from hygrokf.data.table_readers import (
    SEPARATORS,
    SUFFIXES,
    csv_rows,
    decoded_text,
    file_bytes,
    parquet_frame,
    too_wide,
    unpacked,
)

if TYPE_CHECKING:
    import numpy as np
    import pandas

_HEAD = 150  # lines by which the layout is recognised
_DATE = re.compile(
    r"\d{1,4}[-/.]\s?(\d{1,2}|[A-Za-z]{3})[-/.]\s?\d{1,4}(\D|$)"
    r"|(19|20)\d{6}([ T]?(\d\d|\d{4,6}))?$|1\d{9}(\.\d*)?$|1\d{12}$|[34]\d{4}[.,]\d+$"
)
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?$")


@dataclass(frozen=True)
class Export:
    """A table as read from its file.

    file: its path. cells: text of the rows, None where a cell is empty; its columns: `names`, unique.
    names: the header. units: of the row below the header, empty texts where there is none.
    separator, decimal, thousands, comment: of a text file; doubts: of these and of the selection. missing:
    texts that are no readings, the row of units included.
    changes: reasons why a case cannot read the file itself; the draft then writes a copy.
    label: of the turbine within the names of columns, or "". preamble: text above the header.
    column: of stamps. turbine: the selected one, None where the file holds a single turbine.
    """

    file: Path
    cells: pandas.DataFrame
    names: tuple[str, ...]
    units: tuple[str, ...]
    separator: str = ","
    decimal: str = "."
    comment: str | None = None
    missing: tuple[str, ...] = ()
    changes: tuple[str, ...] = ()
    label: str = ""
    preamble: str = ""
    thousands: str = ""
    doubts: tuple[str, ...] = ()
    column: str = ""
    turbine: str | None = None

    def read(self, column: str) -> tuple[np.ndarray, dict[str, Unread]]:
        """Values (N,) of a column in the unit of its header, and the texts that are no values, with the
        reason."""
        unit = dict(zip(self.cells.columns, self.units, strict=False)).get(column, "")
        meaning = Meaning("", unit_in_export(unit) or "", one=POLES[0])
        return values_in(self.cells[column], Marks(self.decimal, self.thousands), meaning)


def read_export(file: Path) -> Export:
    """The table of an export: CSV text of any separator (also compressed), Parquet or Excel (.xlsx).

    Raises TableFault for what is no table, in one message with the remedy.
    """
    content = unpacked(file_bytes(file))
    if content[:4] == b"PAR1":
        frame = parquet_frame(content).apply(lambda column: column.map(_cell_text))
        names = tuple(map(str, frame.columns))
        return _with_marks(Export(file, frame, names, ("",) * len(names)))
    if content[:4] == b"PK\x03\x04":
        return _parse_rows(file, _excel_rows(content), ",", ("an Excel file",))
    content, encoding = decoded_text(content)
    text = content.decode(encoding)
    if sum(not character.isprintable() and character not in "\r\n\t" for character in text[:5000]) > 50:
        raise TableFault("expected a table, found bytes that are not text: export it as CSV")
    separator = _find_separator(text)
    rows = list(csv_rows(content, encoding, separator))
    is_readable = file.name.lower().endswith(SUFFIXES)
    return _parse_rows(file, rows, separator, () if is_readable else (f"the ending {file.suffix}",))


def is_date(cell: str) -> bool:
    """Whether a cell looks like a stamp."""
    return _DATE.match(cell.strip()) is not None


def is_number(cell: str) -> bool:
    """Whether a cell is a number, with a decimal point or comma."""
    return _NUMBER.match(cell.strip()) is not None


def is_value(cell: str) -> bool:
    """Whether a cell is a number or a flag."""
    return is_number(cell) or cell.strip().lower() in (*FLAGS, *POLES)


def unit_in_export(text: str) -> str | None:
    """The name in `UNITS` of a unit as headers write it, perhaps in brackets; None if unknown."""
    bare = text.strip().strip("[](){}").strip()
    return unit_named(bare) if bare else None


_FURTHER_UNITS = re.compile(
    r"(k?v(a|ar)?|k?va?r?h|k?a|hz|[km]?wh|bar|s|sec|min|h|mm|l/min|date|time|ts|rn|avg|smp)$", re.I
)


def _is_unit(cell: str) -> bool:
    bare = cell.strip().strip("[](){}").strip()
    return not bare or bare == "-" or unit_in_export(bare) is not None or bool(_FURTHER_UNITS.match(bare))


def _find_separator(text: str) -> str:
    """The separator with which most lines have a stamp and the same number of cells."""
    lines = text[:200_000].splitlines()[:_HEAD]
    best = (0, 0, ",")
    for separator in SEPARATORS:
        rows = [
            row for row in csv.reader(lines, delimiter=separator) if any(map(is_date, row)) and len(row) > 1
        ]
        if not rows:
            continue
        width, count = Counter(map(len, rows)).most_common(1)[0]
        complete_rows = count if sum(map(is_date, rows[-1])) < width else 0
        best = max(best, (complete_rows, width, separator))
    if best[0] == 0:
        dated_lines = [line for line in lines if any(is_date(part) for part in re.split(r"[;,\t|]", line))]
        if not dated_lines:
            raise TableFault(
                "expected a column of stamps such as 2020-12-01 00:00, found none in the first "
                f"{len(lines)} lines: export the time with the readings"
            )
        raise TableFault("expected a time and at least one column of readings, found one column alone")
    return best[2]


def _parse_rows(
    file: Path, lines: list[tuple[int, list[str]]], separator: str, changes: tuple[str, ...]
) -> Export:
    """The table of `lines`, number and cells; header and row of units are above the first row with a
    stamp."""
    import pandas as pd

    rows = [cells for _, cells in lines]
    head = rows[: 2 * _HEAD]
    dated_rows = [number for number, row in enumerate(head) if len(row) > 1 and any(map(is_date, row))]
    if not dated_rows:
        raise TableFault("expected a column of stamps and one of readings, found no row with both")
    width = Counter(len(head[number]) for number in dated_rows).most_common(1)[0][0]
    first = next(number for number in dated_rows if len(head[number]) == width)
    header_rows: list[list[str]] = []
    while first - len(header_rows) > 0 and len(header_rows) < 4:
        row = [cell.strip() for cell in rows[first - len(header_rows) - 1]]
        if len(row) > width + 1 or len(row) < 2 or sum(map(bool, row)) < 0.4 * min(width, len(row)):
            break
        header_rows.append((row + [""] * width)[:width])
    header_rows = header_rows[::-1]
    while len(header_rows) > 1 and all(map(_is_unit, header_rows[0])):
        header_rows = header_rows[1:]
    while len(header_rows) > 1 and _is_title(header_rows[0], header_rows[1]):
        header_rows = header_rows[1:]
    if not header_rows or all(map(is_number, filter(None, header_rows[0]))):
        header_rows, changes = [[f"column {n + 1}" for n in range(width)]], (*changes, "no header")
    names = [header_rows[0][0].removeprefix("#").strip() or header_rows[0][0], *header_rows[0][1:]]
    unit_rows = [row for row in header_rows[1:] if sum(map(_is_unit, row)) > 0.6 * len(row)]
    units = unit_rows[0] if unit_rows else [""] * width
    body = [(number, row) for number, row in lines[first:] if any(cell.strip() for cell in row)]
    is_remark = [row[0].lstrip().startswith("#") and not is_date(row[0]) for _, row in body]
    comment = "#" if any(is_remark) else None
    body = [row for row in body if not (comment and row[1][0].lstrip().startswith(comment))]
    if faults := too_wide(body, width, separator, "above it"):
        raise TableFault(*faults)
    data = [[*(cell.strip() for cell in row[:width]), *[""] * (width - len(row))] for _, row in body]
    frame = pd.DataFrame(data, columns=_unique_names(names), dtype=object)
    words = {cell for row in header_rows[1:] for cell in row if cell and cell not in MISSING}
    preamble = "\n".join(" ".join(row) for row in rows[: first - len(header_rows)])
    export = Export(
        file, frame, tuple(names), tuple(units), separator, comment=comment, missing=tuple(sorted(words)),
        changes=changes, preamble=preamble,
    )  # fmt: skip
    return _with_marks(export)


def _is_title(row: list[str], below: list[str]) -> bool:
    """Whether a row is a title above the header: it has far fewer filled cells than the row below, and the
    row below is no row of units."""
    units = sum(map(_is_unit, filter(None, below)))
    filled = sum(map(bool, below))
    return sum(map(bool, row)) < 0.7 * filled and units <= 0.6 * filled


def _with_marks(export: Export) -> Export:
    """An export with None in empty cells, units also taken from cells, and its marks of numbers."""
    if len(export.names) < 2:
        raise TableFault("expected a time and at least one column of readings, found one column alone")
    if len(export.cells) < 2:
        raise TableFault(f"expected readings, found {len(export.cells)} rows below the header")
    missing = {*MISSING, None}
    cells = export.cells.apply(lambda column: [None if text in missing else text for text in column])
    cells = cells.astype(object)
    marks, doubts = _number_marks(cells)
    units = tuple(
        text if text.strip("[](){} -") else unit_among(cells.iloc[:, number])
        for number, text in enumerate(export.units)
    )
    decimal, thousands = marks
    return replace(export, cells=cells, units=units, decimal=decimal, thousands=thousands, doubts=doubts)


def _number_marks(cells: pandas.DataFrame) -> tuple[Marks, tuple[str, ...]]:
    """The marks of numbers by the evidence of all columns, and a doubt where two readings are possible.

    Raises TableFault where both marks are decimal.
    """
    evidence_of = {(mark, evidence(cells[name], mark)): name for name in cells for mark in ",."}
    decimal_marks = [mark for mark in ",." if (mark, "decimal") in evidence_of]
    if len(decimal_marks) == 2:
        comma, point = (evidence_of[mark, "decimal"] for mark in ",.")
        raise TableFault(
            f'expected one decimal mark, found both: a comma in column "{comma}" and a point in column '
            f'"{point}"; export again with one of them'
        )
    thousands_marks = [
        mark for mark in ",." if (mark, "thousands") in evidence_of and mark not in decimal_marks
    ]
    for mark in ",.":
        if (mark, "either") in evidence_of and not decimal_marks and not thousands_marks:
            name = evidence_of[mark, "either"]
            doubt = f'"{mark}" in column "{name}" may be decimal, as assumed, or divide thousands: state'
            return Marks(mark), (f'{doubt} decimal = "{mark}" or thousands = "{mark}"',)
    thousands_mark = "".join(thousands_marks[:1])
    return Marks("".join(decimal_marks) or ("," if thousands_mark == "." else "."), thousands_mark), ()


def _unique_names(names: list[str]) -> list[str]:
    seen: Counter[str] = Counter()
    result = []
    for name in names:
        seen[name] += 1
        result.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return result


def _excel_rows(content: bytes) -> list[tuple[int, list[str]]]:
    """Number and cells, as text, of the rows of the first sheet of an .xlsx file."""
    import pandas as pd

    try:
        frame = pd.read_excel(io.BytesIO(content), header=None, dtype=object, engine="openpyxl")
    except ImportError:
        raise TableFault(
            'Excel files need the extra "excel": pip install "hygrokf[excel]"; or export the table as CSV'
        ) from None
    except (KeyError, ValueError, OSError, zlib.error, zipfile.BadZipFile) as broken:
        raise TableFault(f"is a ZIP archive but no Excel table: {broken}") from None
    rows = ([_cell_text(cell) for cell in row] for row in frame.itertuples(index=False))
    return list(enumerate(rows, 1))


def _cell_text(cell: object) -> str:
    import pandas as pd

    if cell is None or (pd.api.types.is_scalar(cell) and pd.isna(cell)):
        return ""
    return f"{cell!r}" if isinstance(cell, float) else str(cell)
