"""Plain data of a fit as its results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from hygrokf.data.record import Provenance
from hygrokf.data.structured import structured
from hygrokf.identification.fit import Fit
from hygrokf.identification.fit_results import Covariance, FitResults, ParameterRow
from hygrokf.modelling.design import Design


def typed(data: Mapping[str, Any]) -> FitResults:
    """The results of a fit from the data of its fit.json, or from a part of them."""
    return structured(FitResults, dict(data))


def with_parts(fit: Fit, **parts: Any) -> Fit:
    """The fit with parts of its results replaced, given as plain data."""
    return replace(fit, results=typed({**fit.to_json(), **parts}))


def bare_fit(name: str, design: Design, values: Mapping[str, float]) -> Fit:
    """A fit with nothing but a model, its values and a variance of the first time constant: it can be written
    and read again."""
    rows = {one: ParameterRow(value) for one, value in values.items()}
    covariance = Covariance(("thermal_time_constant",), np.array([[0.01]]))
    results = FitResults(
        name=name,
        version="0.1.0",
        provenance=Provenance.SYNTHETIC,
        design=design,
        parameters=rows,
        covariance=covariance,
        converged=True,
    )
    return Fit(name, design, values, results)
