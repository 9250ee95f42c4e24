"""How sure: exact observed information, a covariance that survives a wrong model, profile likelihood.

Shapes: d free coordinates z (see `parameters`), T instants.

- Wald: V_H = H⁻¹, H the observed information: minus the second derivative of ln L + ln prior, by central differences
  of the exact score.
- Sandwich: V_S = H⁻¹ J H⁻¹, J the long-run variance of the score: scores summed over blocks of a day and longer
  than the slowest disturbance, with Bartlett weights over neighbouring blocks (Newey & West 1987), plus the prior's
  information, which is no sum over instants.
- Profile: bounds of one parameter where twice the drop of the profile log-likelihood reaches c χ²₁, with the factor
  c = max(1, V_S/V_H) of that parameter (misspecification; Kent 1982, doi:10.1093/biomet/69.1.19).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from hygrokf.fitting import Estimate, Objective

STEP_OF_SE = 0.02
"""Central differences of the score move a coordinate by this share of its standard error."""
FLAT_SE = 3.0
"""[ln] a positive parameter with a larger standard error of its logarithm is called not identifiable."""


@dataclass(frozen=True)
class Uncertainty:
    """Second-order picture of an estimate: `names` of the coordinates that are inside their bounds.

    `hessian` (f, f) observed information; `wald`, `sandwich` (f, f) covariances of the coordinates; `factor` (f,) the
    ratios of their diagonals, at least 1; `flat` names of directions that the data hardly pin down; `parts` (4, f) by how
    much each quarter of the readings alone would move the coordinates, to first order.
    """

    names: tuple[str, ...]
    hessian: np.ndarray
    wald: np.ndarray
    sandwich: np.ndarray
    factor: np.ndarray
    flat: tuple[str, ...]
    trade_offs: tuple[tuple[str, str, float], ...]
    parts: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))

    def place(self, name: str) -> int | None:
        return self.names.index(name) if name in self.names else None


@dataclass(frozen=True)
class Bounds:
    """Confidence bounds of one value in its unit; infinite or zero where the data do not bound it.

    `curve` (P, 2): values and twice the drop of the profile log-likelihood; `method` profile, wald or none.
    """

    value: float
    lower: float
    upper: float
    level: float
    method: str
    statement: str
    curve: np.ndarray


def uncertainty(objective: Objective, estimate: Estimate) -> Uncertainty:
    """Observed information, Wald and sandwich covariance at an estimate.

    Raises ValueError where the likelihood has no curvature there because it is not finite.
    """
    coordinates, z = estimate.coordinates, estimate.z
    inside = np.array([name not in estimate.at_bounds for name in coordinates.names])
    _, _, information = objective.information(z)
    if not np.isfinite(information).all():
        raise ValueError(
            "expected a finite likelihood around the estimate, found none: the model runs away with "
            + ", ".join(f"{name} = {estimate.values[name]:.3g}" for name in coordinates.names)
            + "; leave out the mechanism that does, or mask the readings that it cannot follow"
        )
    steps = STEP_OF_SE / np.sqrt(np.maximum(np.diag(information), 1e-12))
    steps = np.clip(steps, 1e-7, 0.05)
    hessian = np.empty((len(z), len(z)))
    for i, h in enumerate(steps):
        up, down = z.copy(), z.copy()
        up[i] += h
        down[i] -= h
        hessian[i] = -(objective.score(up)[1] - objective.score(down)[1]) / (2.0 * h)
    hessian = 0.5 * (hessian + hessian.T)[np.ix_(inside, inside)]
    names = tuple(n for n, there in zip(coordinates.names, inside, strict=True) if there)
    wald = positive_inverse(hessian)
    prior = coordinates.log_prior(z)[2][inside]
    scores = objective.scores(z)[:, inside]
    variance = long_run_variance(scores, objective.likelihood.timeline.time, block_h(estimate.values))
    sandwich = wald @ (variance + np.diag(prior)) @ wald
    factor = np.maximum(1.0, np.diag(sandwich) / np.diag(wald))
    return Uncertainty(
        names,
        hessian,
        wald,
        sandwich,
        factor,
        _flat(coordinates, names, wald),
        _trade_offs(names, wald),
        part_shifts(scores, objective.likelihood.timeline.y, wald),
    )


PARTS = 4
"""Parts of a record, with equally many readings, that are held against each other."""


def part_shifts(scores: np.ndarray, readings: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Coordinates (PARTS, d) that each part of the readings alone would give, less the common ones, to first order.

    `scores` (T, d) of the instants at the common maximum, `readings` (T, k), `covariance` (d, d) of the whole: a part with
    the share w of the readings has the information w/V, so its own maximum is V s/w away.  With the right model the
    parts' variance is V/w.
    """
    count = np.cumsum(np.isfinite(readings).sum(axis=1))
    part = np.minimum((count * PARTS) // max(int(count[-1]) + 1, 1), PARTS - 1)
    sums = np.zeros((PARTS, scores.shape[1]))
    np.add.at(sums, part, scores)
    return PARTS * (sums - sums.mean(axis=0)) @ covariance


def parts_scale(found: Uncertainty, name: str) -> float:
    """Square of Birge's ratio [1]: scatter of the parts' estimates over what their bounds say; about 1 where those hold."""
    place = found.place(name)
    if place is None or not len(found.parts):
        return 1.0
    expected = PARTS * found.wald[place, place] * found.factor[place]
    return float(np.sum(found.parts[:, place] ** 2) / ((PARTS - 1) * expected))


def block_h(values: Mapping[str, float]) -> float:
    """Blocks of the long-run variance: a day, or four correlation times of the slowest disturbance."""
    times = [v for name, v in values.items() if name.endswith("_disturbance_time")]
    return min(max([24.0, *(4.0 * t for t in times)]), 240.0)


def positive_inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric matrix; directions without positive curvature get a huge variance, not a negative one."""
    size = np.abs(np.diag(matrix))
    scale = 1.0 / np.sqrt(np.where(size > 1e-150, size, 1.0))
    values, vectors = np.linalg.eigh(matrix * scale[:, None] * scale[None, :])
    inverse = np.where(values > 1e-10, 1.0 / np.maximum(values, 1e-10), 1e10)
    return (vectors * inverse) @ vectors.T * scale[:, None] * scale[None, :]


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


def _flat(coordinates, names: tuple[str, ...], covariance: np.ndarray) -> tuple[str, ...]:
    by_name = {p.name: p for p in coordinates.free}
    flat = []
    for name, se in zip(names, np.sqrt(np.diag(covariance)), strict=True):
        p = by_name[name]
        width = FLAT_SE if p.positive else 0.5 * (p.upper - p.lower)
        if se > width:
            flat.append(name)
    return tuple(flat)


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


def wald_bounds(estimate: Estimate, found: Uncertainty, name: str, level: float = 0.95) -> Bounds:
    """Bounds from the wider of the two covariances, symmetric in the parameter's coordinate."""
    value = estimate.values[name]
    place = found.place(name)
    if place is None:
        return Bounds(value, -math.inf, math.inf, level, "none", "at a bound or fixed", np.empty((0, 2)))
    p = next(q for q in estimate.coordinates.parameters if q.name == name)
    se = math.sqrt(max(found.wald[place, place], found.sandwich[place, place]))
    z = p.to_coordinate(value)
    reach = normal_quantile(level) * se
    if p.positive and se > FLAT_SE:
        return Bounds(value, 0.0, math.inf, level, "wald", "not identifiable", np.empty((0, 2)))
    ends = [p.from_coordinate(min(max(z + s * reach, -700.0), 700.0)) for s in (-1.0, 1.0)]
    return Bounds(value, ends[0], ends[1], level, "wald", "", np.empty((0, 2)))


def standard_error(estimate: Estimate, found: Uncertainty, name: str) -> float:
    """Standard error in the parameter's unit (delta method), from the wider of the two covariances.

    NaN at a bound, and for a positive parameter that the data leave open.
    """
    place = found.place(name)
    if place is None:
        return math.nan
    p = next(q for q in estimate.coordinates.parameters if q.name == name)
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
    """Profile-likelihood bounds of one free parameter, all others re-estimated along the way.

    An end that the data do not close is returned as 0 or infinity (positive parameters: "≤ x", "≥ x" or not
    identifiable; others: the parameter's own bound).
    """
    coordinates = estimate.coordinates
    p = next(q for q in coordinates.free if q.name == name)
    index = coordinates.names.index(name)
    place = found.place(name)
    factor = float(found.factor[place]) if place is not None else 1.0
    threshold = factor * normal_quantile(level) ** 2
    se = math.sqrt(found.wald[place, place]) if place is not None else 0.3
    walk = _Walk(objective, estimate, found, index)
    points = [(p.from_coordinate(estimate.z[index]), 0.0)]
    ends = []
    for direction in (-1.0, 1.0):
        if progress is not None:
            progress(f"profile of {name}, {'lower' if direction < 0 else 'upper'} end")
        first = min(max(se, 1e-4), 1.5) * math.sqrt(threshold)
        end, more = _end(walk, p, index, direction, threshold, first)
        ends.append(end)
        points.extend(more)
    curve = np.array(sorted(points))
    lower = (0.0 if p.positive else p.lower) if ends[0] is None else p.from_coordinate(ends[0])
    upper = (math.inf if p.positive else p.upper) if ends[1] is None else p.from_coordinate(ends[1])
    value = estimate.values[name]
    return Bounds(value, lower, upper, level, "profile", describe(p.unit, lower, upper, ends), curve)


def describe(unit: str, lower: float, upper: float, ends: list) -> str:
    """What the bounds say, where they do not close on both sides."""
    if ends[0] is None and ends[1] is None:
        return "not identifiable from this record"
    unit = "" if unit == "1" else f" {unit}"
    if ends[0] is None:
        return f"≤ {upper:.3g}{unit}"
    return f"≥ {lower:.3g}{unit}" if ends[1] is None else ""


class _Walk:
    """Re-estimation of the other coordinates with one held: quasi-Newton steps by the known observed information."""

    def __init__(self, objective: Objective, estimate: Estimate, found: Uncertainty, index: int) -> None:
        self.objective, self.estimate, self.index = objective, estimate, index
        names = estimate.coordinates.names
        self.others = [i for i, n in enumerate(names) if i != index and n in found.names]
        at = {n: i for i, n in enumerate(found.names)}
        rows = [at[names[i]] for i in self.others]
        self.inverse = positive_inverse(found.hessian[np.ix_(rows, rows)]) if rows else np.zeros((0, 0))
        self.path = np.zeros(len(self.others))
        if found.place(names[index]) is not None and rows:
            self.path = -self.inverse @ found.hessian[rows, at[names[index]]]
        self.last = {0.0: estimate.z}

    def drop(self, offset: float) -> float:
        """Twice the drop of the profile log-likelihood at this offset of the coordinate."""
        near = min(self.last, key=lambda known: abs(known - offset))
        z = self.last[near].copy()
        z[self.index] = self.estimate.z[self.index] + offset
        z[self.others] += self.path * (offset - near)
        z = np.clip(z, self.objective.coordinates.lower, self.objective.coordinates.upper)
        inverse = self.inverse.copy()
        value, gradient = self._score(z)
        for _ in range(25):
            g = gradient[self.others]
            step = inverse @ g
            if 0.5 * float(g @ step) < 2e-3:
                break
            step = step / max(1.0, float(np.max(np.abs(step))))
            moved = False
            for _ in range(8):
                trial = z.copy()
                trial[self.others] += step
                trial = np.clip(trial, self.objective.coordinates.lower, self.objective.coordinates.upper)
                new, new_gradient = self._score(trial)
                if new > value:
                    moved = True
                    break
                step = 0.3 * step
            if not moved:
                break
            s = trial[self.others] - z[self.others]
            y = -(new_gradient[self.others] - g)
            inverse = _bfgs(inverse, s, y)
            z, value, gradient = trial, new, new_gradient
        self.last[offset] = z
        return 2.0 * (self.estimate.objective - value)

    def _score(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        try:
            value, gradient = self.objective.score(z)
        except FloatingPointError:
            return -math.inf, np.zeros_like(z)
        return (value, gradient) if math.isfinite(value) else (-math.inf, np.zeros_like(z))


def _bfgs(inverse: np.ndarray, s: np.ndarray, y: np.ndarray) -> np.ndarray:
    curvature = float(s @ y)
    if curvature <= 1e-12:
        return inverse
    left = np.eye(len(s)) - np.outer(s, y) / curvature
    return left @ inverse @ left.T + np.outer(s, s) / curvature


def _end(
    walk: _Walk, p, index: int, direction: float, threshold: float, first: float
) -> tuple[float | None, list[tuple[float, float]]]:
    """The coordinate where the profile crosses the threshold on one side; None where it does not before the bound."""
    z = walk.estimate.z[index]
    limit = (p.to_coordinate(p.upper) if direction > 0 else p.to_coordinate(p.lower)) - z
    limit = abs(limit)
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
