"""Exports the store's history to files: observations, losses of connection, estimates, properties and
alarms, as CSV or Parquet with timestamps."""

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

from hygrokf.data.files import writing_whole
from hygrokf.data.signals import SIGNALS
from hygrokf.errors import HygrokfError
from hygrokf.live.storage.database import Row
from hygrokf.live.storage.schema import READABLE_COLUMNS
from hygrokf.live.storage.store import Store

FORMATS = ("csv", "parquet")
CHUNK = 20_000
"""Rows held in memory at once."""

Values = list[Any] | np.ndarray
"""A column of a file: text, numbers and flags in a list, times as an array of datetime64[ms]."""
Write = Callable[[list[Values]], None]
"""Writes a chunk of rows, given column by column."""


class ExportFault(HygrokfError):
    """An export that cannot be made, with a message for the user."""


@dataclass(frozen=True)
class Column:
    """A column of an exported file.

    `name`: in the file; `source`: column of the store; `kind`: "text", "free" (text that people type on the
    page), "number", "time" [s], "flag", or "unit", which is the SI unit of the signal named in the store's
    column.
    """

    name: str
    source: str
    kind: str


@dataclass(frozen=True)
class ExportedTable:
    """An exported file: its `name`, the `source` table or view, its `columns`, and the `key` that orders the
    rows.

    `within`: SQL conditions that select rows by (since, until) [s].
    """

    name: str
    source: str
    columns: tuple[Column, ...]
    key: tuple[str, ...]
    within: tuple[str, str] = ("time >= ?", "time < ?")


def _columns(*rows: str) -> tuple[Column, ...]:
    """Columns from texts "name kind" or "name source kind"."""
    parts = [row.split() for row in rows]
    return tuple(Column(one[0], one[-2], one[-1]) for one in parts)


TABLES = (
    ExportedTable(
        "observation", "observation",
        _columns(
            "turbine text", "signal text", "time_utc time time", "value_si value number", "unit signal unit",
            "received_utc received time", "late flag", "contradicted flag",
        ),
        ("turbine", "signal", "time"),
    ),
    ExportedTable(
        "connection", "connection",
        _columns("turbine text", "signal text", "lost_utc lost time", "regained_utc regained time"),
        ("turbine", "signal", "lost"),
        ("(regained IS NULL OR regained >= ?)", "lost < ?"),
    ),
    ExportedTable(
        "estimate", "estimate_readable",
        _columns("turbine text", "time_utc time time", "final flag",
            *(f"{name} number" for name in READABLE_COLUMNS)),
        ("turbine", "time"),
    ),
    ExportedTable(
        "property", "property",
        _columns(
            "turbine text", "name text", "time_utc time time", "value number", "lower_bound number",
            "upper_bound number",
            "reference number", "unit text", "observable flag",
        ),
        ("turbine", "name", "time"),
    ),
    ExportedTable(
        "alarm", "alarm",
        _columns(
            "id text", "turbine text", "kind text", "severity text", "began_utc began time",
            "ended_utc ended time",
            "acknowledged_utc acknowledged time", "acknowledged_by free", "cause text", "note free",
            "look_again_utc look_again time", "statement text", "remedy text",
        ),
        ("turbine", "began", "id"),
        ("(ended IS NULL OR ended >= ?)", "began < ?"),
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
    rows per table.

    Rows satisfy since ≤ time < until [s since 1970, UTC]; alarms were open at some time in that interval.
    Memory use does not grow with the store, and the files appear together once all are written.  Raises
    ExportFault, StoreFault, OSError.
    """
    if form not in FORMATS:
        raise ExportFault(f"expected a format of {', '.join(FORMATS)}, found {form!r}")
    known = [name for (name,) in store.rows("SELECT name FROM turbine ORDER BY name")]
    if turbine is not None and turbine not in known:
        raise ExportFault(
            f"{store.url}: expected a turbine of {', '.join(known) or 'none yet'}, found {turbine!r}"
        )
    if not since < until:
        raise ExportFault("since must be earlier than until")
    writer = _csv_writer if form == "csv" else _parquet_writer
    out.mkdir(parents=True, exist_ok=True)
    counts: dict[str, int] = {}
    with ExitStack() as files:
        for table in TABLES:
            file = files.enter_context(writing_whole(out / f"{table.name}.{form}"))
            counts[table.name] = 0
            write, close = writer(file, table.columns)
            for rows in chunks(store, table, turbine, since, until):
                write(_by_column(table, rows))
                counts[table.name] += len(rows)
            close()
    return counts


def alarms_csv(store: Store) -> bytes:
    """All alarms of the store as CSV, with the columns of the exported file."""
    table = next(one for one in TABLES if one.name == "alarm")
    file = io.BytesIO()
    write, close = _csv_writer(file, table.columns)
    for rows in chunks(store, table, None, -math.inf, math.inf):
        write(_by_column(table, rows))
    close()
    return file.getvalue()


def _by_column(table: ExportedTable, rows: Sequence[Row]) -> list[Values]:
    columns = zip(table.columns, zip(*rows, strict=True), strict=True)
    return [_values(one.kind, column) for one, column in columns]


def chunks(
    store: Store, table: ExportedTable, turbine: str | None, since: float, until: float
) -> Iterator[list[Row]]:
    """Rows of a table in the order of its key, at most `CHUNK` per chunk; each chunk starts after the last
    row of the previous.

    No query stays open between chunks, so that the tracker can write and its log does not grow during an
    export.
    """
    conditions: list[str] = []
    values: list[float | str] = []
    for condition, value in zip(table.within, (since, until), strict=True):
        if math.isfinite(value):
            conditions.append(condition)
            values.append(value)
    if turbine is not None:
        conditions.append("turbine = ?")
        values.append(turbine)
    names = ", ".join([*table.key, *(column.source for column in table.columns)])
    order, width = ", ".join(table.key), len(table.key)
    marks = ", ".join("TIME(?)" if name == "time" else "?" for name in table.key)
    after: Row = ()
    while True:
        following = [f"({order}) > ({marks})"] if after else []
        where = " AND ".join([*conditions, *following]) or "1 = 1"
        rows = store.rows(
            f"SELECT {names} FROM {table.source} WHERE {where} ORDER BY {order} LIMIT {CHUNK}",
            (*values, *after),
        )
        if rows:
            yield [row[width:] for row in rows]
        if len(rows) < CHUNK:
            return
        after = rows[-1][:width]


def _values(kind: str, column: Sequence[Any]) -> Values:
    """A column's values as written to a file; times are rounded to milliseconds, the resolution of the filter
    (`SAME_S`)."""
    if kind == "time":
        seconds = np.array([math.nan if v is None else v for v in column], dtype=float)
        there = np.isfinite(seconds)
        milliseconds = np.round(np.where(there, seconds, 0.0) * 1e3).astype("datetime64[ms]")
        return np.where(there, milliseconds, np.datetime64("NaT", "ms"))
    if kind == "flag":
        return [bool(v) for v in column]
    if kind == "unit":
        return [SIGNALS[v].unit if v in SIGNALS else None for v in column]
    return list(column)


def _csv_writer(file: BinaryIO, columns: Sequence[Column]) -> tuple[Write, Callable[[], object]]:
    """Writer of CSV in UTF-8 with a header; times are ISO 8601, flags true or false, missing values empty."""
    text = io.TextIOWrapper(file, encoding="utf-8", newline="", write_through=True)
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow([one.name for one in columns])

    def said(kind: str, values: Values) -> Values:
        if kind == "time":
            return [
                "" if one == "NaT" else f"{one}Z" for one in np.datetime_as_string(values, unit="ms").tolist()
            ]
        if kind == "free":  # a spreadsheet would take it for a formula
            return [f"'{v}" if v and v[0] in "=+-@\t\r" else v for v in values]
        return [("false", "true")[v] for v in values] if kind == "flag" else values

    def write(values: list[Values]) -> None:
        rows.writerows(zip(*(said(c.kind, v) for c, v in zip(columns, values, strict=True)), strict=True))

    return write, text.detach


def _parquet_writer(file: BinaryIO, columns: Sequence[Column]) -> tuple[Write, Callable[[], object]]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise ExportFault("Parquet files need pyarrow: pip install 'hygrokf[parquet]'") from None
    kinds = {"time": pyarrow.timestamp("ms", tz="UTC"), "number": pyarrow.float64(), "flag": pyarrow.bool_()}
    schema = pyarrow.schema([(one.name, kinds.get(one.kind, pyarrow.string())) for one in columns])
    made = parquet.ParquetWriter(file, schema)

    def write(values: list[Values]) -> None:
        arrays = [
            pyarrow.array(v, type=pyarrow.timestamp("ms")).cast(t)
            if c.kind == "time"
            else pyarrow.array(v, type=t)
            for c, v, t in zip(columns, values, schema.types, strict=True)
        ]
        made.write_batch(pyarrow.record_batch(arrays, schema=schema))

    return write, made.close
