"""Named quantities over time with their standard deviations, as arrays and as pandas frames.

Shapes: T instants.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.result_file import utc_index, with_units
from hygrokf.estimation.confidence import normal_quantile

if TYPE_CHECKING:
    from pandas import DataFrame, Index


@dataclass(frozen=True)
class Course:
    """Expected values and standard deviations of named quantities.

    `time_h` (T,) [h] from `origin_s` [s since 1970, UTC; 0 where a timeline states none]; `value`, `sd` by
    name (T,) in the quantities' own units, which `units` has as far as they are known; `reading` by name
    (T,), NaN where there is none, empty for quantities that are not read; `lead_h` (T,) [h] since the last
    reading that a forecast used, empty for other courses.

    `course[name]` is the pair (value, standard deviation).
    """

    time_h: np.ndarray
    origin_s: float
    value: Mapping[str, np.ndarray]
    sd: Mapping[str, np.ndarray]
    reading: Mapping[str, np.ndarray] = field(default_factory=dict)
    lead_h: np.ndarray = field(default_factory=lambda: np.empty(0))
    units: Mapping[str, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        if name not in self.value:
            raise KeyError(f"expected one of {', '.join(self.value)}, found {name}")
        return self.value[name], self.sd[name]

    def bounds(self, name: str, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bound (T,) of the central interval with probability `level` [1]."""
        value, sd = self[name]
        half_width = normal_quantile(level) * sd
        return value - half_width, value + half_width

    def to_frame(self, level: float = 0.95) -> DataFrame:
        """A pandas frame over time (UTC, or hours where there is no date) with the columns `name`, `name_sd`,
        `name_lower`, `name_upper` and, where it is read, `name_reading`, of every quantity; a forecast has
        `lead_h` too."""
        from pandas import DataFrame

        columns: dict[str, np.ndarray] = {"lead_h": self.lead_h} if len(self.lead_h) else {}
        for name in self.value:
            lower, upper = self.bounds(name, level)
            columns |= {name: self.value[name], f"{name}_sd": self.sd[name]}
            columns |= {f"{name}_lower": lower, f"{name}_upper": upper}
            if name in self.reading:
                columns[f"{name}_reading"] = self.reading[name]
        frame = DataFrame(columns, index=time_index(self.time_h, self.origin_s))
        units = {f"{name}{end}": unit for name, unit in self.units.items() for end in ENDS}
        return with_units(frame, units | {"lead_h": "h"})

    def __repr__(self) -> str:
        lines = [f"{type(self).__name__} of {len(self.time_h)} instants"]
        if len(self.time_h):
            index = time_index(self.time_h[[0, -1]], self.origin_s)
            lines[0] += f", {index[0]} … {index[1]}{'' if self.origin_s else ' h'}"
            for name, value in self.value.items():
                lines.append(f"  {name}: {np.nanmin(value):.5g} … {np.nanmax(value):.5g}")
        return "\n".join(lines[:12])


ENDS = ("", "_sd", "_lower", "_upper", "_reading")
"""Suffixes of a quantity's name in the names of its columns."""


def time_index(time_h: np.ndarray, origin_s: float) -> Index:
    """Times (T,) [h] as an index: in UTC where their origin is a date, else in hours."""
    from pandas import Index

    return utc_index(origin_s + 3600.0 * time_h) if origin_s else Index(time_h, name="time_h")
