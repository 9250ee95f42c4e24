"""Uncertainty of an estimate: observed information, and a covariance robust to a wrong model.

Shapes: d free coordinates z (see `parameters`), T instants.

- Wald: V_H = H⁻¹, where H is the observed information: minus the second derivative of ln L + ln prior, by
  central differences of the exact score.
- Sandwich: V_S = H⁻¹ J H⁻¹, where J is the long-run variance of the score (`serial_dependence`), plus the
  prior's information, which is not a sum over instants.  A parameter whose scores depend on each other over a
  large part of the record has none: its V_S is V_H.
- Profiles and likelihood ratios: see `profile_likelihood`.

Directions of the coordinates along which the expected information is rounding alone (a and b where only a·b
acts) are open: they have no part in H⁻¹, and V is very large along them, so that it is finite for those
combinations alone that the readings determine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from hygrokf.engine.parallel import mapped
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.estimation.likelihood import Sensitivities
from hygrokf.estimation.newton_steps import natural_units
from hygrokf.estimation.optimiser import Estimate, Objective
from hygrokf.estimation.serial_dependence import long_run_covariance
from hygrokf.physics.parameters import Coordinates, Parameter
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.statement import Statement, Value
from hygrokf.texts.terms import Name, Unit

STEP_OF_SE = 0.02
"""Central differences of the score move a coordinate by this share of its standard error."""
FLAT_SE = 3.0
"""[ln] a positive parameter whose logarithm has a larger standard error is called not identifiable."""
LEAST_EIGENVALUE = 1e-10
"""[1] least eigenvalue of an information matrix scaled to a diagonal of ones."""
TRADED = 0.95
"""[1] absolute correlation above which two parameters are called a trade-off."""
OPEN_VARIANCE = 1e8
"""Variance along a direction that the readings do not determine, in the coordinates' natural units."""


@dataclass(frozen=True)
class Uncertainty:
    """Covariances of an estimate, of the f coordinates inside their bounds, which are those of `names`.

    `wald`, `sandwich` (f, f) covariances of the coordinates; `factor` (f,) ratios of their diagonals, at
    least 1; `flat` names of coordinates that the data hardly determine.  `curvature` (d, d) observed
    information of all coordinates, including those at a bound.  `parts` (PARTS, f) first-order shift of the
    coordinates if estimated from each part of the readings alone.  `open` (f, m) directions that the readings
    do not determine at all.  `needed`: of coordinates whose sandwich is Wald's because the record is too
    short for one, the length that a sufficient record has, in lengths of this one.
    """

    names: tuple[str, ...]
    wald: np.ndarray
    sandwich: np.ndarray
    factor: np.ndarray
    flat: tuple[str, ...]
    trade_offs: tuple[tuple[str, str, float], ...]
    curvature: np.ndarray
    parts: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    open: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    needed: Mapping[str, float] = field(default_factory=dict)

    @property
    def wider(self) -> np.ndarray:
        """The Wald covariance (f, f) with each standard deviation widened to the sandwich's where that is
        larger."""
        root = np.sqrt(self.factor)
        return self.wald * np.outer(root, root)

    def place(self, name: str) -> int | None:
        """Index of a parameter in the covariances; None for one at a bound, or fixed."""
        return self.names.index(name) if name in self.names else None


Side: TypeAlias = Literal["lower", "upper"]
Effect: TypeAlias = Literal["held", "lifted", "open"]


@dataclass(frozen=True)
class Limit:
    """Another parameter that reached a limit of its search at one end of a profile.

    `end` is "lower" or "upper"; `parameter` and its `unit`; its `value` at that end and the `limit` of its
    search. `effect`: "held", the limit is physical and the parameter stays there; "lifted", the limit is a
    guard and was passed; "open", the parameter reached the end of the lifted range before the profile closed,
    which leaves the end open.
    """

    end: Side
    parameter: Name
    unit: Unit
    value: float
    limit: float
    effect: Effect

    @property
    def values(self) -> Mapping[str, Value]:
        """The values of statements about the limit, by the names of their placeholders."""
        return {key: value for key, value in vars(self).items() if key != "effect"}


@dataclass(frozen=True)
class Bounds:
    """Confidence bounds of one value in its unit; infinite or zero where the data do not bound it.

    `curve` (P, 2): values and twice the drop of the profile log-likelihood; `method`: profile, wald, sandwich
    or none; `statements`: why a side is open; `limited_by`: limits of other parameters met at its ends;
    `better`: values of all parameters at the most likely point of the profile where it exceeds the estimate
    by `BETTER`: the estimate is then no maximum and must be refitted from there.
    """

    value: float
    lower: float
    upper: float
    level: float
    method: str
    statements: tuple[Statement, ...] = ()
    curve: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))
    limited_by: tuple[Limit, ...] = ()
    better: Mapping[str, float] | None = None


def uncertainty(objective: Objective, estimate: Estimate) -> Uncertainty:
    """Compute the observed information and the Wald and sandwich covariances at an estimate.

    Raises ValueError where the likelihood is not finite around the estimate.
    """
    objective = objective.at(estimate.z)
    expected = objective.information(estimate.z, each=True)
    if not np.isfinite(expected.information).all():
        raise ValueError(
            "expected a finite likelihood around the estimate, found none: the model diverges with "
            + ", ".join(f"{name} = {estimate.values[name]:.3g}" for name in estimate.coordinates.names)
            + "; leave out the mechanism that diverges, or mask the readings that it cannot follow"
        )
    width = natural_units(estimate.coordinates)
    steps = STEP_OF_SE / np.sqrt(np.maximum(np.diag(expected.information), 1e-12 / width**2))
    curvature = _curvature(objective, estimate.z, np.clip(steps, 1e-7 * width, 0.05 * width))
    return uncertainty_by(
        objective, estimate, expected, _with_expected_where_flat(curvature, expected.information)
    )


def uncertainty_by(
    objective: Objective, estimate: Estimate, expected: Sensitivities, curvature: np.ndarray | None = None
) -> Uncertainty:
    """Compute the uncertainty of an estimate from sums over the instants.

    expected: its sensitivities with the score of each instant.  curvature: (d, d) observed information, by
    default the expected one.
    """
    coordinates, timeline = estimate.coordinates, objective.likelihood.timeline
    curvature = expected.information if curvature is None else curvature
    inside = np.array([name not in estimate.at_bounds for name in coordinates.names], dtype=bool)
    among = np.ix_(inside, inside)
    names = tuple(n for n, is_inside in zip(coordinates.names, inside, strict=True) if is_inside)
    units = natural_units(coordinates)[inside]
    undetermined = open_directions(expected.information[among], len(timeline), units)
    covariance = positive_inverse(curvature[among], undetermined)
    prior = coordinates.log_prior(estimate.z)[2][inside]
    scores = expected.scores[:, inside]
    run = long_run_covariance(scores[np.isfinite(timeline.y).any(axis=1)] @ covariance)
    is_short = run.needed > 1.0
    sandwich = (
        covariance if np.isnan(run.covariance).any() else run.covariance + (covariance * prior) @ covariance
    )
    variances, robust = np.diag(covariance), np.diag(sandwich)
    ratio = np.divide(robust, variances, out=np.ones(len(names)), where=(variances > 0.0) & (robust > 0.0))
    shrink = np.where(is_short, 1.0 / np.sqrt(ratio), 1.0)
    spread = OPEN_VARIANCE * undetermined @ undetermined.T
    wald = covariance + spread
    return Uncertainty(
        names,
        wald,
        sandwich * np.outer(shrink, shrink) + spread,
        np.where(is_short, 1.0, np.maximum(1.0, ratio)),
        _undetermined_names(coordinates, names, wald),
        _trade_offs(names, wald),
        curvature,
        part_shifts(scores, timeline.y, covariance),
        undetermined,
        {name: float(n) for name, n in zip(names, run.needed, strict=True) if n > 1.0},
    )


def open_directions(information: np.ndarray, count: int, width: np.ndarray) -> np.ndarray:
    """Directions (f, m) of the coordinates along which an information matrix (f, f) is rounding alone.

    The matrix is a sum over `count` instants.  Directions have unit length in the natural units `width` (f,).
    """
    scale, values, vectors = scaled_spectrum(information)
    rounding = max(count, len(values)) * np.finfo(float).eps * float(values.max(initial=0.0))
    directions = vectors[:, values <= rounding] / (scale * width)[:, None]
    return width[:, None] * directions / np.linalg.norm(directions, axis=0)


RECORD_PARTS = 4
"""Parts of a record, with equally many readings, whose estimates are compared."""


def part_shifts(scores: np.ndarray, readings: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Coordinates (PARTS, d) estimated from one part of the readings minus those from all, to first order.

    `scores` (T, d) of the instants at the maximum of all readings, `readings` (T, k), `covariance` V (d, d)
    of the estimate from all.  A part with the share w of the readings and the score s has the information
    w/V, so the part's maximum is V s/w away.  With the right model the variance of each part is V/w.
    """
    count = np.cumsum(np.isfinite(readings).sum(axis=1))
    part = np.minimum((count * RECORD_PARTS) // max(int(count[-1]) + 1, 1), RECORD_PARTS - 1)
    sums = np.zeros((RECORD_PARTS, scores.shape[1]))
    np.add.at(sums, part, scores)
    return RECORD_PARTS * (sums - sums.mean(axis=0)) @ covariance


def parts_scale(spread: Uncertainty, name: str) -> float:
    """Square of Birge's ratio [1]: variance of the parts' estimates over the variance expected; about 1 where
    the bounds hold."""
    place = spread.place(name)
    if place is None or not len(spread.parts):
        return 1.0
    expected = RECORD_PARTS * spread.wald[place, place] * spread.factor[place]
    return float(np.sum(spread.parts[:, place] ** 2) / ((RECORD_PARTS - 1) * expected))


def _curvature(objective: Objective, z: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Minus the second derivatives (d, d) of the objective at z (d,), by central differences of its score."""

    def rows(places: range) -> np.ndarray:
        # a likelihood keeps working memory between calls, so each thread needs its own
        thread_objective = Objective(replace(objective.likelihood), objective.coordinates)
        matrix = np.empty((len(places), len(z)))
        for row, i in enumerate(places):
            up, down = z.copy(), z.copy()
            up[i] += steps[i]
            down[i] -= steps[i]
            matrix[row] = -(thread_objective.score(up)[1] - thread_objective.score(down)[1]) / (
                2.0 * steps[i]
            )
        return matrix

    middle = len(z) // 2
    matrix = np.concatenate(mapped(rows, (range(middle), range(middle, len(z)))))
    return 0.5 * (matrix + matrix.T)


def positive_inverse(matrix: np.ndarray, without: np.ndarray | None = None) -> np.ndarray:
    """Invert a symmetric matrix (f, f) after raising the eigenvalues of the scaled matrix to at least
    `LEAST_EIGENVALUE`: directions without positive curvature get a very large variance, not a negative one.

    without: directions (f, m) that are left out; the inverse is that on all directions conjugate to them, and
    0 along them.
    """
    basis = np.eye(len(matrix))
    scale, values, vectors = scaled_spectrum(matrix)
    if without is not None and without.size:
        m = without.shape[1]
        basis = np.linalg.qr(without * scale[:, None], mode="complete")[0][:, m:]
        values, vectors = np.linalg.eigh(basis.T @ (matrix / scale[:, None] / scale[None, :]) @ basis)
    vectors = basis @ vectors / scale[:, None]
    return (vectors / np.maximum(values, LEAST_EIGENVALUE)) @ vectors.T


def _with_expected_where_flat(observed: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """The observed information (d, d), with the expected one along directions without positive curvature.

    There the readings say nothing or the likelihood is not smooth.
    """
    scale, values, vectors = scaled_spectrum(observed)
    if values.min(initial=1.0) > LEAST_EIGENVALUE:
        return observed
    expected_along = np.einsum("ij,ik,kj->j", vectors, expected / np.outer(scale, scale), vectors)
    values = np.where(values > LEAST_EIGENVALUE, values, np.maximum(expected_along, LEAST_EIGENVALUE))
    return (vectors * values) @ vectors.T * np.outer(scale, scale)


def with_positive_eigenvalues(matrix: np.ndarray) -> np.ndarray:
    """A symmetric matrix (d, d) whose eigenvalues below `LEAST_EIGENVALUE`, when scaled, are raised to it."""
    scale, values, vectors = scaled_spectrum(matrix)
    return (vectors * np.maximum(values, LEAST_EIGENVALUE)) @ vectors.T * scale[:, None] * scale[None, :]


def scaled_spectrum(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scale of a symmetric matrix, the roots (d,) of its diagonal, and the scaled matrix's eigenvalues and
    eigenvectors."""
    size = np.abs(np.diag(matrix))
    scale = np.sqrt(np.where(size > 1e-150, size, 1.0))
    values, vectors = np.linalg.eigh(matrix / scale[:, None] / scale[None, :])
    return scale, values, vectors


def _undetermined_names(
    coordinates: Coordinates, names: tuple[str, ...], covariance: np.ndarray
) -> tuple[str, ...]:
    """The parameters whose standard error exceeds `largest_se`."""
    parameters = map(coordinates.parameter, names)
    variances = np.diag(covariance)
    return tuple(p.name for p, v in zip(parameters, variances, strict=True) if v > largest_se(p) ** 2)


def largest_se(p: Parameter) -> float:
    """The standard error of a parameter's coordinate above which it is called not identifiable."""
    return FLAT_SE if p.positive else 0.5 * (p.upper - p.lower)


def _trade_offs(names: tuple[str, ...], covariance: np.ndarray) -> tuple[tuple[str, str, float], ...]:
    """Pairs whose estimates are correlated by more than `TRADED` in absolute value, and the correlations."""
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    pairs = [
        (names[i], names[j], float(correlation[i, j]))
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) > TRADED
    ]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair[2])))


def wald_bounds(
    estimate: Estimate, spread: Uncertainty, name: str, level: float = CONFIDENCE, covariance: str = "wider"
) -> Bounds:
    """Bounds symmetric in the parameter's coordinate, from a covariance: "wald", "sandwich" or the "wider" of
    the two."""
    value = estimate.values[name]
    place = spread.place(name)
    if place is None:
        return Bounds(value, -math.inf, math.inf, level, "none", (FitCode.AT_BOUND_OR_FIXED(),))
    p = estimate.coordinates.parameter(name)
    if covariance == "sandwich" and name in spread.needed:
        return Bounds(value, *in_unit(p, (None, None)), level, "none", (too_short(spread, name),))
    variances = {"wald": spread.wald[place, place], "sandwich": spread.sandwich[place, place]}
    variances["wider"] = max(variances.values())
    se, method = math.sqrt(variances[covariance]), "wald" if covariance == "wider" else covariance
    z = p.to_coordinate(value)
    reach = normal_quantile(level) * se
    low, high = (None, None) if se > largest_se(p) else (z - reach, z + reach)
    ends = (
        None if low is None or low < p.to_coordinate(p.lower) else low,
        None if high is None or high > p.to_coordinate(p.upper) else high,
    )
    lower, upper = in_unit(p, ends)
    return Bounds(value, lower, upper, level, method, describe(p.unit, lower, upper, ends))


def too_short(spread: Uncertainty, name: str) -> Statement:
    """State that a parameter has no sandwich covariance, and how long a record it takes."""
    return FitCode.NO_SANDWICH(parameter=name, length=max(spread.needed[name], 1.1))


def in_unit(p: Parameter, ends: Sequence[float | None]) -> tuple[float, float]:
    """Convert the lower and upper bound of a parameter's coordinate to its unit.

    An open end, None, becomes 0 or infinity; of a parameter that is not positive, the limit of its search.
    """
    lower = (0.0 if p.positive else p.lower) if ends[0] is None else p.from_coordinate(ends[0])
    upper = (math.inf if p.positive else p.upper) if ends[1] is None else p.from_coordinate(ends[1])
    return lower, upper


def standard_error(estimate: Estimate, spread: Uncertainty, name: str) -> float:
    """Standard error in the parameter's unit (delta method), from the wider of the two covariances.

    NaN for a parameter at a bound, and for a parameter that the data do not determine.
    """
    place = spread.place(name)
    if place is None:
        return math.nan
    p = estimate.coordinates.parameter(name)
    variance = max(spread.wald[place, place], spread.sandwich[place, place])
    if math.sqrt(variance) > largest_se(p):
        return math.nan
    return abs(p.slope(estimate.values[name])) * math.sqrt(variance)


def describe(
    unit: str, lower: float, upper: float, ends: Sequence[float | None], limits: Sequence[Limit] = ()
) -> tuple[Statement, ...]:
    """State which sides of a value's bounds are open, and which limits of other parameters left them open;
    nothing where both are closed.

    unit, lower, upper: of the value.  ends: coordinates of its bounds, None where they are open.
    """
    if ends[0] is None and ends[1] is None:
        open_ = FitCode.OPEN_ON_BOTH_SIDES()
    elif ends[0] is None:
        open_ = FitCode.AT_MOST(bound=upper, unit=unit)
    elif ends[1] is None:
        open_ = FitCode.AT_LEAST(bound=lower, unit=unit)
    else:
        return ()
    return (open_, *(FitCode.END_STAYS_OPEN(**one.values) for one in limits if one.effect == "open"))


def expect_level(level: float) -> None:
    """Check a level of confidence [1]; raises ValueError outside 0 … 1."""
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: expected a probability between 0 and 1, found {level}")


def normal_quantile(level: float) -> float:
    """Two-sided standard normal quantile of a confidence level."""
    from statistics import NormalDist

    expect_level(level)
    return NormalDist().inv_cdf(0.5 + 0.5 * level)


def student_quantile(level: float, freedom: float) -> float:
    """Two-sided quantile of Student's t with `freedom` degrees of freedom."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.5 + 0.5 * level))
