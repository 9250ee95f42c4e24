"""An identified model as a noun: everything to repeat it, to use it elsewhere, and to report it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from hygrokf.identification.verdict import with_verdicts
from hygrokf.modelling.design import Design


@dataclass(frozen=True)
class Fit:
    """An identified model: everything to repeat it and to use it elsewhere.

    `design` and `values` make the model; `results` is the plain data of `fit.json`; `series` the arrays for pictures.
    """

    name: str
    design: Design
    values: Mapping[str, float]
    results: Mapping[str, Any]
    series: Mapping[str, np.ndarray] = field(default_factory=dict)

    @cached_property
    def covariance(self) -> tuple[tuple[str, ...], np.ndarray]:
        """Names and covariance (r, r) of the parameters that have one, in their own units."""
        found = self.results["covariance"]
        return tuple(found["names"]), np.array(found["matrix"], dtype=float).reshape(len(found["names"]), -1)

    def to_json(self) -> dict:
        return dict(self.results)

    @classmethod
    def from_json(cls, data: Mapping) -> Fit:
        """A fit from what `to_json` gave; one that states no verdicts on its numbers is judged by its own data."""
        values = {name: row["value"] for name, row in data["parameters"].items()}
        return cls(data["name"], Design.from_json(data["design"]), values, with_verdicts(data))
