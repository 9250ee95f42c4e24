"""Export of the store's history to CSV or Parquet files: observations, losses of connection, estimates,
properties and alarms."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from sqlalchemy import FromClause, bindparam, select, tuple_

from hygrokf.data.files import writing_whole
from hygrokf.data.signals import SIGNALS
from hygrokf.errors import HygrokfError
from hygrokf.live.storage import schema
from hygrokf.live.storage.database import Row
from hygrokf.live.storage.schema import READABLE_COLUMNS
from hygrokf.live.storage.store import Store

EXPORT_FORMATS = ("csv", "parquet")
ROWS_AT_ONCE = 20_000
"""Largest number of rows in memory at once."""

Values = list[Any] | np.ndarray
"""A column of a file: text, numbers and flags in a list, times as an array of datetime64[ms]."""
Write = Callable[[list[Values]], None]
"""Writes a chunk of rows, given column by column."""


class ExportFault(HygrokfError):
    """The export is impossible; the message tells the user why."""


@dataclass(frozen=True)
class Column:
    """A column of an exported file.

    `name`: its name in the file; `source`: column of the store; `kind`: "text", "free" (text that people type
    on the page), "number", "time" [s], "flag", or "unit", which is the SI unit of the signal named in the
    store's column.
    """

    name: str
    source: str
    kind: str


@dataclass(frozen=True)
class ExportedTable:
    """An exported file: its `name`, the `source` table or view, its `columns`, and the `key` that orders the
    rows.

    A row is valid from its time in the column `begin` to its time in the column `end`, or until now if the
    latter is empty.
    """

    name: str
    source: FromClause
    columns: tuple[Column, ...]
    key: tuple[str, ...]
    begin: str = "time"
    end: str = "time"


def _columns(*rows: str) -> tuple[Column, ...]:
    """Return columns from texts "name kind" or "name source kind"."""
    return tuple(Column(words[0], words[-2], words[-1]) for words in map(str.split, rows))


EXPORTED_TABLES = (
    ExportedTable(
        "observation", schema.observation,
        _columns(
            "turbine text", "signal text", "time_utc time time", "value_si value number", "unit signal unit",
            "received_utc received time", "late flag", "contradicted flag",
        ),
        ("turbine", "signal", "time"),
    ),
    ExportedTable(
        "connection", schema.connection,
        _columns("turbine text", "signal text", "lost_utc lost time", "regained_utc regained time"),
        ("turbine", "signal", "lost"),
        "lost", "regained",
    ),
    ExportedTable(
        "estimate", schema.estimate_readable,
        _columns("turbine text", "time_utc time time", "final flag",
            *(f"{name} number" for name in READABLE_COLUMNS)),
        ("turbine", "time"),
    ),
    ExportedTable(
        "property", schema.property_,
        _columns(
            "turbine text", "name text", "time_utc time time", "value number", "lower_bound number",
            "upper_bound number",
            "reference number", "unit text", "observable flag",
        ),
        ("turbine", "name", "time"),
    ),
    ExportedTable(
        "alarm", schema.alarm,
        _columns(
            "id text", "turbine text", "kind text", "severity text", "began_utc began time",
            "ended_utc ended time",
            "acknowledged_utc acknowledged time", "acknowledged_by free", "cause text", "note free",
            "look_again_utc look_again time", "statement text", "remedy text",
        ),
        ("turbine", "began", "id"),
        "began", "ended",
    ),
)  # fmt: skip
"""The exported files."""


def export(
    store: Store,
    out: Path,
    form: str = "csv",
    turbine: str | None = None,
    since: float = -math.inf,
    until: float = math.inf,
) -> dict[str, int]:
    """Write the tables of one turbine or of all to the folder `out`, as TABLE.csv or TABLE.parquet; returns
    the number of rows per table.

    Rows satisfy since ≤ time < until [s since 1970, UTC]; alarms were open at some time in that interval.
    Memory use does not grow with the store, and the files appear together once all are written.  Raises
    ExportFault, StoreFault, OSError.
    """
    if form not in EXPORT_FORMATS:
        raise ExportFault(f"expected one of the formats {', '.join(EXPORT_FORMATS)}, found {form!r}")
    turbines = list(store.models())
    if turbine is not None and turbine not in turbines:
        raise ExportFault(
            f"{store.url}: expected one of the turbines {', '.join(turbines) or '(none yet)'}, "
            f"found {turbine!r}"
        )
    if not since < until:
        raise ExportFault("since must be earlier than until")
    writer = _csv_writer if form == "csv" else _parquet_writer
    out.mkdir(parents=True, exist_ok=True)
    counts: dict[str, int] = {}
    with ExitStack() as files:
        for table in EXPORTED_TABLES:
            file = files.enter_context(writing_whole(out / f"{table.name}.{form}"))
            counts[table.name] = 0
            write, close = writer(file, table.columns)
            for rows in chunks(store, table, turbine, since, until):
                write(_by_column(table, rows))
                counts[table.name] += len(rows)
            close()
    return counts


def alarms_csv(store: Store) -> bytes:
    """Return all alarms of the store as CSV, with the columns of the exported file."""
    table = next(table for table in EXPORTED_TABLES if table.name == "alarm")
    file = io.BytesIO()
    write, close = _csv_writer(file, table.columns)
    for rows in chunks(store, table, None, -math.inf, math.inf):
        write(_by_column(table, rows))
    close()
    return file.getvalue()


def _by_column(table: ExportedTable, rows: Sequence[Row]) -> list[Values]:
    """Convert rows of the store to the columns of a file."""
    values = zip(*rows, strict=True)
    return [_values(column.kind, cells) for column, cells in zip(table.columns, values, strict=True)]


def chunks(
    store: Store, table: ExportedTable, turbine: str | None, since: float, until: float
) -> Iterator[list[Row]]:
    """Yield the rows of a table in the order of its key, at most `ROWS_AT_ONCE` at a time; each query starts
    after the last row of the one before.

    No query stays open between chunks, so that the tracker can write and its log does not grow during an
    export.
    """
    columns, values = table.source.c, {"since": since, "until": until, "turbine": turbine}
    key = [columns[name] for name in table.key]
    query = (
        select(*(columns[column.source] for column in table.columns), *key).order_by(*key).limit(ROWS_AT_ONCE)
    )
    if math.isfinite(since):
        end = columns[table.end]
        query = query.where(end.is_(None) | (end >= bindparam("since")))
    if math.isfinite(until):
        query = query.where(columns[table.begin] < bindparam("until"))
    if turbine is not None:
        query = query.where(columns.turbine == bindparam("turbine"))
    last = tuple_(*(bindparam(f"last_{column.name}", type_=column.type) for column in key))
    following = query.where(tuple_(*key) > last)
    rows = store.rows(query, **values)
    while rows:
        yield [row[: -len(key)] for row in rows]
        if len(rows) < ROWS_AT_ONCE:
            return
        after = zip(key, rows[-1][-len(key) :], strict=True)
        values |= {f"last_{column.name}": value for column, value in after}
        rows = store.rows(following, **values)


def _values(kind: str, cells: Sequence[Any]) -> Values:
    """Convert a column's values for a file, by the column's kind; times are rounded to milliseconds, the
    resolution of the filter (`SAME_S`)."""
    if kind == "time":
        seconds = np.array([math.nan if cell is None else cell for cell in cells], dtype=float)
        is_present = np.isfinite(seconds)
        milliseconds = np.round(np.where(is_present, seconds, 0.0) * 1e3).astype("datetime64[ms]")
        return np.where(is_present, milliseconds, np.datetime64("NaT", "ms"))
    if kind == "flag":
        return [bool(cell) for cell in cells]
    if kind == "unit":
        return [SIGNALS[signal].unit if signal in SIGNALS else None for signal in cells]
    return list(cells)


def _csv_writer(file: BinaryIO, columns: Sequence[Column]) -> tuple[Write, Callable[[], object]]:
    """Return the functions that write a chunk, and that finish a CSV file.

    The file is in UTF-8 with a header; times are ISO 8601, flags true or false, missing values empty.
    """
    text = io.TextIOWrapper(file, encoding="utf-8", newline="", write_through=True)
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow([column.name for column in columns])

    def texts(kind: str, values: Values) -> Values:
        """Convert the values of a column to the texts of its cells."""
        if kind == "time":
            stamps = np.datetime_as_string(values, unit="ms").tolist()
            return ["" if stamp == "NaT" else f"{stamp}Z" for stamp in stamps]
        if kind == "free":  # a spreadsheet would take text with such a first character for a formula
            return [f"'{text}" if text and text[0] in "=+-@\t\r" else text for text in values]
        return ["true" if flag else "false" for flag in values] if kind == "flag" else values

    def write(values: list[Values]) -> None:
        """Write rows, given column by column."""
        columns_of_texts = [texts(column.kind, cells) for column, cells in zip(columns, values, strict=True)]
        rows.writerows(zip(*columns_of_texts, strict=True))

    return write, text.detach


def _parquet_writer(file: BinaryIO, columns: Sequence[Column]) -> tuple[Write, Callable[[], object]]:
    """Return the functions that write a chunk, and that finish a Parquet file."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise ExportFault("Parquet files need pyarrow: pip install 'hygrokf[parquet]'") from None
    kinds = {"time": pyarrow.timestamp("ms", tz="UTC"), "number": pyarrow.float64(), "flag": pyarrow.bool_()}
    schema = pyarrow.schema([(column.name, kinds.get(column.kind, pyarrow.string())) for column in columns])
    writer = parquet.ParquetWriter(file, schema)

    def write(values: list[Values]) -> None:
        """Write rows, given column by column."""
        arrays = []
        for column, cells, file_type in zip(columns, values, schema.types, strict=True):
            is_time = column.kind == "time"
            array = pyarrow.array(cells, type=pyarrow.timestamp("ms") if is_time else file_type)
            arrays.append(array.cast(file_type) if is_time else array)
        writer.write_batch(pyarrow.record_batch(arrays, schema=schema))

    return write, writer.close
