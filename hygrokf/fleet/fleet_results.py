"""What `fleet.json` holds: the table of a fleet, and the type of turbine that its fits make."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from hygrokf.data.structured import optional
from hygrokf.fleet.job import DONE, Row
from hygrokf.identification.turbine_type import TurbineType

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True)
class FleetResults:
    """A fleet's table: one row per turbine, in the order of the fleet's file.

    `task`: what was done, with its `options`; `type`: the pooled type of turbine of a fleet's fits, without
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

    def to_frame(self) -> pandas.DataFrame:
        """The table, by turbine."""
        import pandas

        return pandas.DataFrame(list(self.rows)).set_index("turbine")

    def __str__(self) -> str:
        return f"{self.name}: {self.task}, {len(self.done)} of {len(self.rows)} turbines with a result"

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return str(self.to_frame().to_html())
