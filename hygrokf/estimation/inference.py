"""Bounds of any parameter and time constants of any model, from a likelihood and its estimate.

`identify` uses these functions for a cabinet's two constants; here they are available for a user's own model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.estimation.confidence import (
    Bounds,
    Uncertainty,
    normal_quantile,
    profile,
    uncertainty,
    wald_bounds,
)
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Objective
from hygrokf.estimation.subject import Given, Source, estimated

METHODS = ("profile", "wald", "sandwich")
COORDINATE_STEP = 1e-5
"""Step of the coordinates in central differences of the Jacobian, whose error is of the order of its
square."""
ALIKE = 1e-6
"""[1] product of the normalised left and right eigenvectors below which two eigenvalues count as equal."""


def confidence_intervals(
    source: Source,
    given: Given | None = None,
    names: Sequence[str] | None = None,
    method: str = "profile",
    level: float = 0.95,
) -> dict[str, Bounds]:
    """Bounds of free parameters by one method, by default of all of them.

    source, given: a `Likelihood` and the `Estimate` that `fit_mle` made of it; or a `Fit` and its `Record`,
        where the likelihood of the whole model is first climbed to its maximum from the fit's values.
    names: of the parameters.
    method: "profile" re-estimates all other parameters along the way, with a threshold widened by the
        sandwich factor (`confidence.profile`); "wald" uses the observed information; "sandwich" uses the
        covariance that remains valid under a wrong model.  The last two are symmetric in the parameter's
        coordinate, which is the logarithm of a positive parameter.
    level: [1] of confidence, between 0 and 1.

    Returns `lower` and `upper` by name, in the parameters' units; NaN for an open end.
    Raises ValueError for an unknown method or level, for names that are not free parameters, and for anything
    else, with the call that makes what is missing.
    """
    likelihood, estimate = estimated("confidence_intervals", source, given)
    free = estimate.coordinates.names
    wanted = free if names is None else tuple(names)
    unknown = [name for name in wanted if name not in free]
    if unknown:
        raise ValueError(f"names: expected free parameters, {', '.join(free)}, found {', '.join(unknown)}")
    if method not in METHODS:
        raise ValueError(f"method: expected one of {', '.join(METHODS)}, found {method!r}")
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: expected a probability between 0 and 1, found {level}")
    objective = Objective(likelihood, estimate.coordinates)
    known = uncertainty(objective, estimate)
    if method == "profile":
        return {name: profile(objective, estimate, known, name, level) for name in wanted}
    return {name: wald_bounds(estimate, known, name, level, method) for name in wanted}


@dataclass(frozen=True)
class TimeConstant:
    """One time constant of a linear, or linearised, model [h], with bounds by the delta method.

    `value` τ = −1/Re λ of an eigenvalue λ of the Jacobian; infinite where Re λ ≥ 0 (no decay).  `lower` and
    `upper` at the `level`, symmetric in ln τ; NaN where two eigenvalues coincide.  `period` 2π/|Im λ| of an
    oscillation, else infinite. `states`: shares [1] of the states in the mode (participation factors),
    largest first.
    """

    value: float
    lower: float
    upper: float
    level: float
    period: float
    states: Mapping[str, float]


def modal_time_constants(
    source: Source,
    given: Given | None = None,
    level: float = 0.95,
    state: Mapping[str, float] | None = None,
    inputs: Mapping[str, float] | None = None,
    known: Uncertainty | None = None,
) -> tuple[TimeConstant, ...]:
    """Time constants of a model at its estimate, slowest first; one for each pair of conjugate eigenvalues.

        A v = λ v,    dλ/dz_j = w' (dA/dz_j) v / (w' v),    Var ln τ = g' V g,  g_j = −d Re λ/dz_j / Re λ,

    with the Jacobian A (n, n) [1/h], its left and right eigenvectors w and v, and the covariance V of the
    coordinates z, the wider of Wald and sandwich.  Parameters at a bound count as known.

    source, given: as `confidence_intervals` takes them.
    level: [1] of confidence, between 0 and 1.
    state, inputs: where a nonlinear model is linearised, in the model's units; values not given there are the
        means of the filtered states and the medians of the inputs over the record.
    known: the estimate's uncertainty, if already computed.

    Returns values with bounds [h] and the states that take part.
    Raises ValueError for names that the model does not have.

    Source: Golub & Van Loan, Matrix Computations, section 7.2.2 (derivatives of eigenvalues); Pérez-Arriaga,
    Verghese & Schweppe 1982 (participation factors).
    """
    from scipy.linalg import eig

    likelihood, estimate = estimated("modal_time_constants", source, given)
    at_state, at_inputs = operating_point(likelihood, estimate.values, state or {}, inputs or {})
    coordinates, z = estimate.coordinates, estimate.z
    known = known or uncertainty(Objective(likelihood, coordinates), estimate)

    def matrix(point: np.ndarray) -> np.ndarray:
        return likelihood.jacobian(coordinates.values(point), at_state, at_inputs).astype(float)

    slopes = []
    for name in known.names:
        step = np.where(np.array(coordinates.names) == name, COORDINATE_STEP, 0.0)
        slopes.append((matrix(z + step) - matrix(z - step)) / (2.0 * COORDINATE_STEP))
    values, left, right = eig(matrix(z), left=True, right=True)
    rounding = len(values) * np.finfo(float).eps * float(np.abs(values).max(initial=0.0))
    found = []
    for k in np.flatnonzero(values.imag >= 0.0):
        w, v = left[:, k].conj(), right[:, k]
        overlap = w @ v
        rate = float(values[k].real)
        shares = np.abs(w * v)
        participation = dict(zip(likelihood.model.states, (shares / shares.sum()).tolist(), strict=True))
        ordered = dict(sorted(participation.items(), key=lambda pair: -pair[1]))
        period = 2.0 * math.pi / float(values[k].imag) if values[k].imag > 0.0 else math.inf
        if rate >= -rounding:
            found.append(TimeConstant(math.inf, math.inf, math.inf, level, period, ordered))
            continue
        value, reach = -1.0 / rate, math.nan
        if abs(overlap) > ALIKE:
            slope = np.array([-((w @ s @ v) / overlap).real / rate for s in slopes])
            reach = normal_quantile(level) * math.sqrt(max(float(slope @ known.wider @ slope), 0.0))
        bounds = [value * math.exp(min(sign * reach, 700.0)) for sign in (-1.0, 1.0)]
        found.append(TimeConstant(value, bounds[0], bounds[1], level, period, ordered))
    return tuple(sorted(found, key=lambda one: -one.value))


def operating_point(
    likelihood: Likelihood,
    values: Mapping[str, float],
    state: Mapping[str, float],
    inputs: Mapping[str, float],
) -> tuple[np.ndarray, dict[str, float]]:
    """State (n,) and inputs at which a model is linearised."""
    model, timeline = likelihood.model, likelihood.timeline
    for kind, given, there in (("state", state, model.states), ("inputs", inputs, model.inputs)):
        unknown = sorted(set(given) - set(there))
        if unknown:
            raise ValueError(f"{kind}: expected names of {', '.join(there)}, found {', '.join(unknown)}")
    mean = likelihood.trace(values).mean.mean(axis=0)
    point = np.array([state.get(name, float(m)) for name, m in zip(model.states, mean, strict=True)])
    known = {name: float(np.median(timeline.input(name))) for name in model.inputs}
    return point, {**known, **inputs}
