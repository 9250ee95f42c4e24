"""The table of a fleet, in fleet.json, as CSV, and (with pyarrow) as Parquet."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from hygrokf.data.result_file import units_by_name, with_units
from hygrokf.data.structured import optional
from hygrokf.fleet.job import DONE, Row, flat
from hygrokf.fleet.tasks import SHARED_COLUMNS, TASKS
from hygrokf.identification.turbine_type import TurbineType
from hygrokf.texts.terms import Instant, Name, Version

if TYPE_CHECKING:
    import pandas

CSV, PARQUET = "fleet.csv", "fleet.parquet"


@dataclass(frozen=True)
class FleetResults:
    """The table of a fleet: one row for each turbine, in the order of FLEET.toml.

    `task`: name of the task, with its `options`; `type`: type of turbine pooled from the fits, without the
    turbines of `type_without`. The columns are those of `tasks.TASKS[task]`.
    """

    task: Name
    rows: tuple[Row, ...]
    name: Name = ""
    version: Version = ""
    created: Instant = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    type: TurbineType | None = None
    type_without: tuple[Name, ...] = optional(())

    @property
    def done(self) -> list[Row]:
        """Rows of the turbines that have a result."""
        return [row for row in self.rows if row.get("status") == DONE]

    @property
    def missing(self) -> list[Row]:
        """Rows of the turbines that have no result."""
        return [row for row in self.rows if row.get("status") != DONE]

    def to_frame(self) -> pandas.DataFrame:
        """Return the table as a pandas frame with the turbines as index and stamps as times in UTC;
        `attrs["units"]` has the units of the columns."""
        import pandas

        rows = [{name: flat(cell) for name, cell in row.items()} for row in self.rows]
        frame = pandas.DataFrame(rows).set_index("turbine")
        stamps = [name for name in ("start", "end") if name in frame.columns]
        return with_units(frame, units_by_name(list(frame.columns)), stamps)

    def __str__(self) -> str:
        return f"{self.name}: {self.task}, {len(self.done)} of {len(self.rows)} turbines with a result"

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return str(self.to_frame().to_html())


def task_columns(task: str) -> dict[str, str]:
    """Return the columns of a task's table in their order, with their meanings."""
    return {**SHARED_COLUMNS, **TASKS[task].columns}


def table_csv(task: str, rows: Sequence[Row]) -> str:
    """Return rows as CSV text with unrounded numbers; cells without a value are empty."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    names = list(task_columns(task))
    writer.writerow(names)
    for row in rows:
        cells = (flat(row.get(name)) for name in names)
        writer.writerow([str(cell).lower() if isinstance(cell, bool) else cell for cell in cells])
    return buffer.getvalue()


def table_parquet(task: str, rows: Sequence[Row]) -> bytes | None:
    """Return rows as the bytes of a Parquet file; None if pyarrow is not installed."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return None
    names = task_columns(task)
    table = pyarrow.Table.from_pylist([{name: flat(row.get(name)) for name in names} for row in rows])
    buffer = pyarrow.BufferOutputStream()
    parquet.write_table(table, buffer)
    return buffer.getvalue().to_pybytes()
