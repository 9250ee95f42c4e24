"""The table of a fleet: in `fleet.json` with the type of turbine, as CSV, and as Parquet where pyarrow is
installed."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from hygrokf.data.structured import Cell, optional
from hygrokf.data.tabular import units_by_name, with_units
from hygrokf.fleet.job import DONE, Row
from hygrokf.fleet.tasks import SHARED, TASKS
from hygrokf.identification.turbine_type import TurbineType

if TYPE_CHECKING:
    import pandas

CSV, PARQUET = "fleet.csv", "fleet.parquet"


@dataclass(frozen=True)
class FleetResults:
    """A fleet's table: one row per turbine, in the order of the fleet's file.

    `task`: name of the task, with its `options`; `type`: the type of turbine pooled from the fits, without
    the turbines of `type_without`; `cpu_s`: CPU time [s] by turbine.  Columns and their units are those of
    `tasks.TASKS[task]`.
    """

    task: str
    rows: tuple[Row, ...]
    name: str = ""
    version: str = ""
    created: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    type: TurbineType | None = None
    type_without: tuple[str, ...] = optional(())
    cpu_s: Mapping[str, float] = field(default_factory=dict)

    @property
    def done(self) -> list[Row]:
        """Rows of the turbines with a result."""
        return [row for row in self.rows if row.get("status") == DONE]

    @property
    def missing(self) -> list[Row]:
        """Rows of the turbines without a result."""
        return [row for row in self.rows if row.get("status") != DONE]

    def to_frame(self) -> pandas.DataFrame:
        """The table, by turbine, stamps as times in UTC; `attrs["units"]` has the units of its columns."""
        import pandas

        frame = pandas.DataFrame(list(self.rows)).set_index("turbine")
        stamps = [name for name in ("start", "end") if name in frame.columns]
        return with_units(frame, units_by_name(list(frame.columns)), stamps)

    def __str__(self) -> str:
        return f"{self.name}: {self.task}, {len(self.done)} of {len(self.rows)} turbines with a result"

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return str(self.to_frame().to_html())


def columns_of(task: str) -> dict[str, str]:
    """Columns of a task's table in their order, with their meanings."""
    return {**SHARED, **TASKS[task].columns}


def table_csv(task: str, rows: Sequence[Row]) -> str:
    """Rows as CSV text: numbers unrounded; cells without a value empty."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    names = list(columns_of(task))
    writer.writerow(names)
    for row in rows:
        cells = (row.get(name) for name in names)
        writer.writerow([str(one).lower() if isinstance(one, bool) else one for one in cells])
    return buffer.getvalue()


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
    """The type of a column; where it has no value at all, `float` or `str` by its name."""
    there = {type(value) for value in values if value is not None}
    if there == {int, float}:
        return float
    return there.pop() if len(there) == 1 else float if name.endswith(_NUMBERS) else str


_NUMBERS = (
    "_h", "_K", "_m3", "_degC", "_percent", "_lower", "_upper", "_coverage", "loglik", "confidence",
    "n_readings", "warnings",
)  # fmt: skip
