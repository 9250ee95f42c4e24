"""The table of a fleet: a row for each turbine, as CSV, and as Parquet where pyarrow is installed."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from hygrokf.data.structured import Cell
from hygrokf.fleet.job import Row
from hygrokf.fleet.tasks import SHARED, TASKS

CSV, PARQUET = "fleet.csv", "fleet.parquet"


def columns_of(task: str) -> dict[str, str]:
    """Columns of a task's table in their order, with their meanings."""
    return {**SHARED, **TASKS[task].columns}


def table_csv(task: str, rows: Sequence[Row]) -> str:
    """Rows as CSV text; what is not known, infinite or does not apply is empty; numbers as they are,
    unrounded."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    names = list(columns_of(task))
    writer.writerow(names)
    for row in rows:
        writer.writerow([_cell(row.get(name)) for name in names])
    return buffer.getvalue()


def _cell(value: Cell) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


def table_parquet(task: str, rows: Sequence[Row]) -> bytes | None:
    """Rows as a Parquet file, columns without a value as null; None where pyarrow is not installed."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return None
    kinds = {bool: pyarrow.bool_(), int: pyarrow.int64(), float: pyarrow.float64(), str: pyarrow.string()}
    fields, arrays = [], []
    for name in columns_of(task):
        values = [row.get(name) for row in rows]
        kind = kinds[_kind(name, values)]
        fields.append(pyarrow.field(name, kind))
        arrays.append(pyarrow.array(values, type=kind))
    sink = pyarrow.BufferOutputStream()
    parquet.write_table(pyarrow.Table.from_arrays(arrays, schema=pyarrow.schema(fields)), sink)
    return sink.getvalue().to_pybytes()


def _kind(name: str, values: Sequence[Cell]) -> type:
    """The type of a column; one without any value is of numbers, or of words where its meaning has no
    unit."""
    there = {type(value) for value in values if value is not None}
    if there == {int, float}:
        return float
    return there.pop() if len(there) == 1 else float if name.endswith(_NUMBERS) else str


_NUMBERS = (
    "_h", "_K", "_m3", "_degC", "_percent", "_lower", "_upper", "_coverage", "loglik", "confidence",
    "n_readings", "warnings",
)  # fmt: skip
