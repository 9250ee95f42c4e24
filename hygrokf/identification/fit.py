"""An identified model with everything needed to repeat it, use it elsewhere and report it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hygrokf.data.structured import JsonObject, plain, structured
from hygrokf.identification.fit_results import FitResults
from hygrokf.identification.verdict import inherited, told, with_verdicts
from hygrokf.modelling.design import Design


@dataclass(frozen=True)
class Fit:
    """An identified model: everything needed to repeat it and to use it elsewhere.

    `design`, `values`: the model, and its parameters in their units.  `results`: what `fit.json` says; time
    constants [h] with bounds in `results.time_constants`, errors and verdicts beside them.  `series`: arrays
    for figures.  A fit can be pickled; `write_fit` and `read_fit` keep it in files.
    """

    name: str
    design: Design
    values: Mapping[str, float]
    results: FitResults = field(default_factory=FitResults)
    series: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def covariance(self) -> tuple[tuple[str, ...], np.ndarray]:
        """Names and covariance (r, r) of the parameters that have one, in their own units."""
        found = self.results.covariance
        count = len(found.names)
        return found.names, found.matrix.reshape(count, -1) if count else np.empty((0, 0))

    def to_json(self) -> JsonObject:
        """The data of `fit.json`."""
        data: dict[str, Any] = plain(self.results)
        return data

    @classmethod
    def from_json(cls, data: JsonObject) -> Fit:
        """A fit from the data of `to_json`; verdicts that the data lack are decided from the data.

        Raises StructureFault with every fault and its place.
        """
        results = with_verdicts(structured(FitResults, dict(data)))
        if results.design is None:
            raise ValueError("design: expected, and missing")
        values = {name: row.value for name, row in results.parameters.items()}
        return cls(results.name, results.design, values, results)

    def __str__(self) -> str:
        """The name with its time constants and their verdicts."""
        return "\n".join([self.name, *told(inherited(self.results))])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """The page of the fit, for a notebook."""
        from hygrokf.report.fit_page import report_page

        return report_page(self.results, self.series)
