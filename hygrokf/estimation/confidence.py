"""Uncertainty of an estimate: observed information, a covariance robust to a wrong model, profile likelihood.

Shapes: d free coordinates z (see `parameters`), T instants.

- Wald: V_H = H⁻¹, where H is the observed information: minus the second derivative of ln L + ln prior, by
  central differences of the exact score.
- Sandwich: V_S = H⁻¹ J H⁻¹, where J is the long-run variance of the score: scores summed over blocks longer
  than a day and than the slowest disturbance, with Bartlett weights over neighbouring blocks (Newey & West
  1987), plus the prior's information, which is not a sum over instants.
- Profile: bounds of one parameter where twice the drop of the profile log-likelihood reaches c χ²₁, with the
  factor c = max(1, V_S/V_H) of that parameter (misspecification; Kent 1982, doi:10.1093/biomet/69.1.19).
  Other parameters that reach a search limit on the way may pass it where it is a guard, and stay at it where
  it is physical.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hygrokf.engine.parallel import mapped
from hygrokf.estimation.optimiser import (
    AT_LIMIT,
    BETTER,
    Estimate,
    Objective,
    bounded_step,
    secant_update,
)
from hygrokf.physics.parameters import Coordinates, Parameter

STEP_OF_SE = 0.02
"""Central differences of the score move a coordinate by this share of its standard error."""
FLAT_SE = 3.0
"""[ln] a positive parameter whose logarithm has a larger standard error is called not identifiable."""
WALK_STEPS = 40
WALK_TOLERANCE = 2e-3
"""Re-estimation along a profile ends when the next step promises less than this much log-likelihood."""
MATERIAL = 0.05
"""[1] share of a profile's threshold: a limit counts only if the score promises more than this for passing
it."""


@dataclass(frozen=True)
class Uncertainty:
    """Second-order description of an estimate; `names` of the coordinates inside their bounds.

    `wald`, `sandwich` (f, f) covariances of the coordinates; `factor` (f,) ratios of their diagonals, at
    least 1; `flat` names of directions that the data hardly determine.  `curvature` (d, d) observed
    information of all coordinates, including those at a bound.  `parts` (PARTS, f) first-order shift of the
    coordinates if estimated from each part of the readings alone.
    """

    names: tuple[str, ...]
    wald: np.ndarray
    sandwich: np.ndarray
    factor: np.ndarray
    flat: tuple[str, ...]
    trade_offs: tuple[tuple[str, str, float], ...]
    curvature: np.ndarray
    parts: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def wider(self) -> np.ndarray:
        """The Wald covariance (f, f) with each standard deviation widened to the sandwich's where that is
        larger."""
        root = np.sqrt(self.factor)
        return self.wald * np.outer(root, root)

    def place(self, name: str) -> int | None:
        return self.names.index(name) if name in self.names else None


@dataclass(frozen=True)
class Limit:
    """Another parameter that reached a limit of its search at one end of a profile.

    `end` is "lower" or "upper"; `parameter` and its `unit`; its `value` at that end and the `limit` of its
    search. `effect`: "held", the limit is physical and the parameter stays there; "lifted", the limit is a
    guard and was passed; "open", the parameter reached the end of the lifted range before the profile closed,
    which leaves the end open.
    """

    end: str
    parameter: str
    unit: str
    value: float
    limit: float
    effect: str


@dataclass(frozen=True)
class Bounds:
    """Confidence bounds of one value in its unit; infinite or zero where the data do not bound it.

    `curve` (P, 2): values and twice the drop of the profile log-likelihood; `method`: profile, wald, sandwich
    or none; `limited_by`: limits of other parameters met at its ends; `better`: values of all parameters at
    the most likely point of the profile where it exceeds the estimate by `BETTER`: the estimate is then no
    maximum and must be refitted from there.
    """

    value: float
    lower: float
    upper: float
    level: float
    method: str
    statement: str = ""
    curve: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))
    limited_by: tuple[Limit, ...] = ()
    better: Mapping[str, float] | None = None


def uncertainty(objective: Objective, estimate: Estimate) -> Uncertainty:
    """Observed information, Wald and sandwich covariance at an estimate.

    Raises ValueError where the likelihood is not finite around the estimate.
    """
    expected = objective.information(estimate.z, each=True)
    if not np.isfinite(expected.information).all():
        raise ValueError(
            "expected a finite likelihood around the estimate, found none: the model diverges with "
            + ", ".join(f"{name} = {estimate.values[name]:.3g}" for name in estimate.coordinates.names)
            + "; leave out the mechanism that diverges, or mask the readings that it cannot follow"
        )
    steps = STEP_OF_SE / np.sqrt(np.maximum(np.diag(expected.information), 1e-12))
    curvature = _curvature(objective, estimate.z, np.clip(steps, 1e-7, 0.05))
    return uncertainty_by(objective, estimate, curvature, expected.scores)


def uncertainty_by(
    objective: Objective, estimate: Estimate, curvature: np.ndarray, scores: np.ndarray
) -> Uncertainty:
    """The uncertainty of an estimate by an information `curvature` (d, d) and the `scores` (T, d) there."""
    coordinates = estimate.coordinates
    inside = np.array([name not in estimate.at_bounds for name in coordinates.names])
    names = tuple(n for n, there in zip(coordinates.names, inside, strict=True) if there)
    wald = positive_inverse(curvature[np.ix_(inside, inside)])
    prior = coordinates.log_prior(estimate.z)[2][inside]
    scores = scores[:, inside]
    variance = long_run_variance(scores, objective.likelihood.timeline.time, block_h(estimate.values))
    sandwich = wald @ (variance + np.diag(prior)) @ wald
    factor = np.maximum(1.0, np.diag(sandwich) / np.diag(wald))
    return Uncertainty(
        names,
        wald,
        sandwich,
        factor,
        _flat(coordinates, names, wald),
        _trade_offs(names, wald),
        curvature,
        part_shifts(scores, objective.likelihood.timeline.y, wald),
    )


PARTS = 4
"""Parts of a record, with equally many readings, whose estimates are compared."""


def part_shifts(scores: np.ndarray, readings: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Coordinates (PARTS, d) estimated from each part of the readings alone, minus the common ones, to first
    order.

    `scores` (T, d) of the instants at the common maximum, `readings` (T, k), `covariance` (d, d) of the
    whole.  A part with the share w of the readings has the information w/V, so its own maximum is V s/w away.
    With the right model the variance of the parts is V/w.
    """
    count = np.cumsum(np.isfinite(readings).sum(axis=1))
    part = np.minimum((count * PARTS) // max(int(count[-1]) + 1, 1), PARTS - 1)
    sums = np.zeros((PARTS, scores.shape[1]))
    np.add.at(sums, part, scores)
    return PARTS * (sums - sums.mean(axis=0)) @ covariance


def parts_scale(found: Uncertainty, name: str) -> float:
    """Square of Birge's ratio [1]: scatter of the parts' estimates relative to their bounds; about 1 where
    the bounds hold."""
    place = found.place(name)
    if place is None or not len(found.parts):
        return 1.0
    expected = PARTS * found.wald[place, place] * found.factor[place]
    return float(np.sum(found.parts[:, place] ** 2) / ((PARTS - 1) * expected))


def _curvature(objective: Objective, z: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Minus the second derivatives (d, d) of the objective at z (d,), by central differences of its score."""

    def rows(places: range) -> np.ndarray:
        # a likelihood keeps working memory between calls, so each thread needs its own
        own = Objective(replace(objective.likelihood), objective.coordinates)
        found = np.empty((len(places), len(z)))
        for row, i in enumerate(places):
            up, down = z.copy(), z.copy()
            up[i] += steps[i]
            down[i] -= steps[i]
            found[row] = -(own.score(up)[1] - own.score(down)[1]) / (2.0 * steps[i])
        return found

    middle = len(z) // 2
    found = np.concatenate(mapped(rows, (range(middle), range(middle, len(z)))))
    return 0.5 * (found + found.T)


def block_h(values: Mapping[str, float]) -> float:
    """Blocks of the long-run variance: a day, or four correlation times of the slowest disturbance."""
    times = [v for name, v in values.items() if name.endswith("_disturbance_time")]
    return min(max([24.0, *(4.0 * t for t in times)]), 240.0)


def positive_inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric matrix; directions without positive curvature get a very large variance instead
    of a negative one."""
    scale, values, vectors = _scaled(matrix)
    return (vectors / values) @ vectors.T / scale[:, None] / scale[None, :]


def positive(matrix: np.ndarray) -> np.ndarray:
    """A symmetric matrix made positive: directions without positive curvature get almost none."""
    scale, values, vectors = _scaled(matrix)
    return (vectors * values) @ vectors.T * scale[:, None] * scale[None, :]


def _scaled(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Roots (d,) of a symmetric matrix's diagonal, and eigenvalues (at least 1e-10) and eigenvectors of the
    matrix scaled by them."""
    size = np.abs(np.diag(matrix))
    scale = np.sqrt(np.where(size > 1e-150, size, 1.0))
    values, vectors = np.linalg.eigh(matrix / scale[:, None] / scale[None, :])
    return scale, np.maximum(values, 1e-10), vectors


def long_run_variance(scores: np.ndarray, time: np.ndarray, block_h: float, lags: int = 2) -> np.ndarray:
    """Variance (d, d) of the sum of serially dependent scores (T, d) at `time` [h]."""
    block = ((time - time[0]) / block_h).astype(int)
    sums = np.zeros((block[-1] + 1, scores.shape[1]))
    np.add.at(sums, block, scores)
    sums = sums - sums.mean(axis=0)
    result = sums.T @ sums
    for lag in range(1, min(lags, len(sums) - 1) + 1):
        weight = 1.0 - lag / (lags + 1.0)
        cross = sums[lag:].T @ sums[:-lag]
        result += weight * (cross + cross.T)
    return result


def _flat(coordinates: Coordinates, names: tuple[str, ...], covariance: np.ndarray) -> tuple[str, ...]:
    widths = [FLAT_SE if p.positive else 0.5 * (p.upper - p.lower) for p in map(coordinates.parameter, names)]
    errors = np.sqrt(np.diag(covariance))
    return tuple(name for name, se, width in zip(names, errors, widths, strict=True) if se > width)


def _trade_offs(names: tuple[str, ...], covariance: np.ndarray) -> tuple[tuple[str, str, float], ...]:
    """Pairs whose estimates are correlated by more than 0.95."""
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    found = [
        (names[i], names[j], float(correlation[i, j]))
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) > 0.95
    ]
    return tuple(sorted(found, key=lambda pair: -abs(pair[2])))


def wald_bounds(
    estimate: Estimate, found: Uncertainty, name: str, level: float = 0.95, covariance: str = "wider"
) -> Bounds:
    """Bounds from a covariance, symmetric in the parameter's coordinate: "wald", "sandwich" or the "wider" of
    the two."""
    value = estimate.values[name]
    place = found.place(name)
    if place is None:
        return Bounds(value, -math.inf, math.inf, level, "none", "at a bound or fixed")
    p = estimate.coordinates.parameter(name)
    variances = {"wald": found.wald[place, place], "sandwich": found.sandwich[place, place]}
    variances["wider"] = max(variances.values())
    se, method = math.sqrt(variances[covariance]), "wald" if covariance == "wider" else covariance
    z = p.to_coordinate(value)
    reach = normal_quantile(level) * se
    if p.positive and se > FLAT_SE:
        return Bounds(value, 0.0, math.inf, level, method, "not identifiable")
    ends = [p.from_coordinate(min(max(z + s * reach, -700.0), 700.0)) for s in (-1.0, 1.0)]
    return Bounds(value, ends[0], ends[1], level, method)


def standard_error(estimate: Estimate, found: Uncertainty, name: str) -> float:
    """Standard error in the parameter's unit (delta method), from the wider of the two covariances.

    NaN at a bound, and for a positive parameter that the data do not determine.
    """
    place = found.place(name)
    if place is None:
        return math.nan
    p = estimate.coordinates.parameter(name)
    variance = max(found.wald[place, place], found.sandwich[place, place])
    if p.positive and math.sqrt(variance) > FLAT_SE:
        return math.nan
    return abs(p.slope(estimate.values[name])) * math.sqrt(variance)


def profile(
    objective: Objective,
    estimate: Estimate,
    found: Uncertainty,
    name: str,
    level: float = 0.95,
    progress: Callable[[str], None] | None = None,
) -> Bounds:
    """Profile-likelihood bounds of one free parameter [its unit]; all others are re-estimated along the way.

    `objective` is the penalised likelihood with the maximum `estimate`, `found` its `uncertainty`.  The
    bounds are the values at which
        2 (l(θ̂) − max over the others of l) = c χ²₁,    c = max(1, V_S/V_H) of the parameter, at the
        confidence `level`.
    An end that the data do not close is returned as 0 or infinity (positive parameters: "≤ x", "≥ x" or not
    identifiable; others: the parameter's own bound).

    Another parameter that reaches a search limit on the way would turn the profile into a cliff.  A physical
    limit (`Parameter.physical`) holds, because no model exists beyond it.  A guard is lifted
    (`Parameter.beyond_guards`); if the parameter reaches the end of the lifted range before the profile
    closes, the end is open.  `limited_by` lists these limits. A parameter that the estimate already has at a
    limit stays there unless the score moves it back.
    """
    coordinates = estimate.coordinates
    p = coordinates.parameter(name)
    index = coordinates.names.index(name)
    place = found.place(name)
    factor = float(found.factor[place]) if place is not None else 1.0
    threshold = factor * normal_quantile(level) ** 2
    se = math.sqrt(found.wald[place, place]) if place is not None else 0.3
    walk = _Walk(objective, estimate, found, index)
    points = [(p.from_coordinate(estimate.z[index]), 0.0)]
    ends: list[float | None] = []
    limits: list[Limit] = []
    for side, direction in (("lower", -1.0), ("upper", 1.0)):
        if progress is not None:
            progress(f"profile of {name}, {side} end")
        first = min(max(se, 1e-4), 1.5) * math.sqrt(threshold)
        end, more = _end(walk, p, index, direction, threshold, first)
        points.extend(more)
        if end is not None:
            reached = walk.limits(side, end - estimate.z[index], threshold)
            limits.extend(reached)
            end = None if any(limit.effect == "open" for limit in reached) else end
        ends.append(end)
    curve = np.array(sorted(points))
    lower = (0.0 if p.positive else p.lower) if ends[0] is None else p.from_coordinate(ends[0])
    upper = (math.inf if p.positive else p.upper) if ends[1] is None else p.from_coordinate(ends[1])
    statement = describe(p.unit, lower, upper, ends, limits)
    return Bounds(
        estimate.values[name], lower, upper, level, "profile", statement, curve, tuple(limits), walk.better()
    )


def describe(
    unit: str, lower: float, upper: float, ends: Sequence[float | None], limits: Sequence[Limit] = ()
) -> str:
    """Words for bounds that are open on one or both sides, with the limit of another parameter that left them
    open."""
    open_ = [limit for limit in limits if limit.effect == "open"]
    because = "".join(
        f"; the {limit.end} end stays open: there {limit.parameter} is "
        f"{_with_unit(limit.value, limit.unit)}, far beyond its limit {_with_unit(limit.limit, limit.unit)}"
        for limit in open_
    )
    if ends[0] is None and ends[1] is None:
        return "not identifiable from this record" + because
    if ends[0] is None:
        return f"≤ {_with_unit(upper, unit)}{because}"
    return f"≥ {_with_unit(lower, unit)}{because}" if ends[1] is None else ""


def limit_remarks(name: str, bounds: Bounds) -> list[str]:
    """One sentence for each limit of another parameter that closed ends of a profile met; `name` is the
    profiled parameter."""
    remarks = {"lifted": "beyond the limit {limit} of its search", "held": "its physical limit"}
    return [
        f"the {limit.end} bound of {name} has {limit.parameter} = {_with_unit(limit.value, limit.unit)}, "
        + remarks[limit.effect].format(limit=_with_unit(limit.limit, limit.unit))
        for limit in bounds.limited_by
        if limit.effect in remarks
    ]


def _with_unit(value: float, unit: str) -> str:
    return f"{value:.3g}" + ("" if unit == "1" else f" {unit}")


class _Walk:
    """Re-estimation of the other coordinates with one fixed: quasi-Newton steps starting from the observed
    information.

    Steps stay within the limits with guards lifted.  A coordinate that the score pushes against a limit is
    held there, and the others are solved without it.
    """

    def __init__(self, objective: Objective, estimate: Estimate, found: Uncertainty, index: int) -> None:
        self.objective, self.estimate, self.index = objective, estimate, index
        self.free = estimate.coordinates.free
        self.others = np.arange(len(self.free)) != index
        bounds = np.array([p.beyond_guards() for p in self.free])
        own = estimate.coordinates
        self.lower = np.where(estimate.z <= own.lower + AT_LIMIT, own.lower, bounds[:, 0])
        self.upper = np.where(estimate.z >= own.upper - AT_LIMIT, own.upper, bounds[:, 1])
        self.curvature = positive(found.curvature)
        self.path = np.zeros(len(self.free))
        inside = np.array([p.name in found.names and i != index for i, p in enumerate(self.free)])
        if found.place(own.names[index]) is not None and inside.any():
            block = positive_inverse(found.curvature[np.ix_(inside, inside)])
            self.path[inside] = -block @ found.curvature[inside, index]
        self.last = {0.0: (estimate.z, np.zeros_like(estimate.z))}
        self.best = (-BETTER, estimate.z)

    def drop(self, offset: float) -> float:
        """Twice the drop of the profile log-likelihood at this offset of the fixed coordinate."""
        near = min(self.last, key=lambda known: abs(known - offset))
        z = self.last[near][0] + self.path * (offset - near)
        z = np.clip(z, self.lower, self.upper)
        z[self.index] = self.estimate.z[self.index] + offset
        curvature, informed = self.curvature, False
        value, gradient = self._score(z)
        for _ in range(WALK_STEPS):
            outwards = ((z <= self.lower) & (gradient <= 0)) | ((z >= self.upper) & (gradient >= 0))
            step, promised = bounded_step(
                curvature, gradient, self.others & ~outwards, z, self.lower, self.upper, 1e-9
            )
            if promised < WALK_TOLERANCE:
                break
            for _ in range(8):
                trial = z + step
                new, new_gradient = self._score(trial)
                if new > value:
                    break
                step = 0.3 * step
            else:
                if informed:
                    break
                # the curvature of the estimate is no use here: replace it by the expected information at this
                # point
                curvature, informed = self.objective.information(z).information, True
                continue
            curvature = secant_update(curvature, step, gradient - new_gradient)
            z, value, gradient = trial, new, new_gradient
        self.last[offset] = z, gradient
        self.best = min(self.best, (self.estimate.objective - value, z), key=lambda pair: pair[0])
        return 2.0 * (self.estimate.objective - value)

    def better(self) -> dict[str, float] | None:
        """Parameter values more likely than the estimate, if the walk met any."""
        drop, z = self.best
        return None if drop >= -BETTER else self.objective.coordinates.values(z)

    def limits(self, end: str, offset: float, threshold: float) -> list[Limit]:
        """Limits of other coordinates that matter at this offset, except those that the estimate is already
        at."""
        z, gradient = self.last[min(self.last, key=lambda known: abs(known - offset))]
        own = self.estimate.coordinates
        found = []
        for i, p in enumerate(self.free):
            above = z[i] > own.upper[i] - AT_LIMIT
            at, lifted = (own.upper[i], self.upper[i]) if above else (own.lower[i], self.lower[i])
            same = abs(self.estimate.z[i] - at) <= AT_LIMIT
            if i == self.index or same or not (above or z[i] < own.lower[i] + AT_LIMIT):
                continue
            unit = 1.0 if p.positive else p.upper - p.lower
            pushed = 2.0 * (gradient[i] if above else -gradient[i]) * unit > MATERIAL * threshold
            at_the_end = abs(z[i] - lifted) <= AT_LIMIT and pushed
            physical = abs(p.from_coordinate(lifted) - p.physical[int(above)]) <= AT_LIMIT
            if at_the_end:
                effect = "held" if physical else "open"
            elif abs(z[i] - at) > AT_LIMIT:
                effect = "lifted"
            else:
                continue
            value, limit = p.from_coordinate(float(z[i])), p.upper if above else p.lower
            found.append(Limit(end, p.name, p.unit, value, limit, effect))
        return found

    def _score(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        try:
            value, gradient = self.objective.score(z)
        except FloatingPointError:
            return -math.inf, np.zeros_like(z)
        return (value, gradient) if math.isfinite(value) else (-math.inf, np.zeros_like(z))


def _end(
    walk: _Walk, p: Parameter, index: int, direction: float, threshold: float, first: float
) -> tuple[float | None, list[tuple[float, float]]]:
    """The coordinate where the profile crosses the threshold on one side; None if it does not cross within
    the bound."""
    z = walk.estimate.z[index]
    limit = abs(p.to_coordinate(p.upper if direction > 0 else p.lower) - z)
    points: list[tuple[float, float]] = []

    def root(offset: float) -> float:
        drop = walk.drop(direction * offset)
        points.append((p.from_coordinate(z + direction * offset), drop))
        return math.sqrt(max(drop, 0.0)) - math.sqrt(threshold)

    if limit < 1e-9:
        return None, points
    inner, value_inner = 0.0, -math.sqrt(threshold)
    outer = min(first, limit)
    value_outer = root(outer)
    for _ in range(12):
        if value_outer >= 0 or outer >= limit:
            break
        slope = (value_outer - value_inner) / (outer - inner)
        reach = outer - value_outer / slope * 1.05 if slope > 0 else 2.0 * outer
        inner, value_inner = outer, value_outer
        outer = min(max(reach, 1.1 * outer), 3.0 * outer, limit)
        value_outer = root(outer)
    if value_outer < 0:
        return None, points
    for _ in range(12):
        if abs(value_outer) < 0.01 or outer - inner < 1e-3 * outer:
            break
        share = -value_inner / (value_outer - value_inner)
        middle = inner + min(max(share, 0.05), 0.95) * (outer - inner)
        value = root(middle)
        if abs(value) < 0.01:
            return z + direction * middle, points
        if value < 0:
            inner, value_inner = middle, value
        else:
            outer, value_outer = middle, value
    share = -value_inner / (value_outer - value_inner)
    return z + direction * (inner + share * (outer - inner)), points


def normal_quantile(level: float) -> float:
    """Two-sided standard normal quantile of a confidence level."""
    from statistics import NormalDist

    return NormalDist().inv_cdf(0.5 + 0.5 * level)


def student(level: float, freedom: float) -> float:
    """Two-sided quantile of Student's t."""
    from scipy.stats import t

    return float(t.ppf(0.5 + 0.5 * level, freedom))
