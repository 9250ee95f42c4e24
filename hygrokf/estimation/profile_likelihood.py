"""Profile-likelihood bounds of one parameter; all others are re-estimated along the way.

The bounds are where twice the drop of the profile log-likelihood reaches c χ²₁.  With c = 1 they are those
of the likelihood-ratio test; with c = max(1, V_S/V_H) of the parameter they also hold where the model is
somewhat wrong (Kent 1982, doi:10.1093/biomet/69.1.19).  Another parameter that reaches a search limit on the
way passes the limit where it is a guard, and stays there where the limit is physical.

Shapes: d free coordinates z (see `parameters`), P points.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from hygrokf.estimation.confidence import (
    Bounds,
    Effect,
    Limit,
    Side,
    Uncertainty,
    describe,
    in_unit,
    normal_quantile,
    positive_inverse,
    too_short,
    with_positive_eigenvalues,
)
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.estimation.newton_steps import bounded_step, natural_units, reach_of, secant_update
from hygrokf.estimation.optimiser import (
    BETTER_GAIN,
    LIMIT_DISTANCE,
    Estimate,
    Objective,
)
from hygrokf.physics.parameters import Parameter
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.statement import Statement

WALK_STEPS = 40
WALK_PASSES = 400
"""Score passes in the search for one end of a profile, after which it stays open; ends take about 30."""
WALK_TOLERANCE = 2e-3
"""Re-estimation along a profile ends when the next step promises less than this much log-likelihood."""
MATERIAL_GAIN = 0.05
"""[1] share of a profile's threshold: a limit counts only if passing it promises a larger gain of twice the
log-likelihood."""


def profile(
    objective: Objective,
    estimate: Estimate,
    spread: Uncertainty,
    name: str,
    level: float = CONFIDENCE,
    progress: Callable[[str], None] | None = None,
    robust: bool = True,
) -> Bounds:
    """Profile-likelihood bounds of one free parameter [its unit]; all others are re-estimated along the way.

    `objective` is the penalised likelihood with the maximum `estimate`, `spread` its `uncertainty`.  The
    bounds are the values at which
        2 (l(θ̂) − max over the others of l) = c χ²₁,    c = max(1, V_S/V_H) of the parameter if `robust`,
        else 1, at the confidence `level`.
    Where the record is too short for a sandwich, c = 1, and a statement says so.
    An end that the data do not close is returned as 0 or infinity (positive parameters: "≤ x", "≥ x" or not
    identifiable; others: the parameter's own bound).

    Another parameter that reaches a search limit on the way would turn the profile into a cliff.  A physical
    limit (`Parameter.physical`) holds, because no model exists beyond it.  A guard is lifted
    (`Parameter.lifted_limits`); if the parameter reaches the end of the lifted range before the profile
    closes, the end is open.  `limited_by` lists these limits. A parameter that the estimate already has at a
    limit stays there unless the score moves it back.
    """
    coordinates = estimate.coordinates
    p = coordinates.parameter(name)
    index = coordinates.names.index(name)
    place = spread.place(name)
    factor = float(spread.factor[place]) if place is not None and robust else 1.0
    threshold = factor * normal_quantile(level) ** 2
    width = float(natural_units(coordinates)[index])
    se = math.sqrt(spread.wald[place, place]) if place is not None else 0.3 * width
    walk = _Walk(objective, estimate, spread, index)
    points = [(p.from_coordinate(estimate.z[index]), 0.0)]
    ends: list[float | None] = []
    limits: list[Limit] = []
    unfinished: list[Statement] = []
    sides: tuple[tuple[Side, float], ...] = (("lower", -1.0), ("upper", 1.0))
    for side, direction in sides:
        if progress is not None:
            progress(f"profile of {name}, {side} end")
        first_offset = min(max(se, 1e-4 * width), 1.5 * width) * math.sqrt(threshold)
        walk.left = WALK_PASSES
        end, more = _end(walk, p, index, direction, threshold, first_offset)
        if walk.left < 0:
            end = None
            unfinished.append(FitCode.END_NOT_FOUND(end=side, passes=WALK_PASSES))
        points.extend(more)
        if end is not None:
            end_limits = walk.limits(side, end - estimate.z[index], threshold)
            limits.extend(end_limits)
            end = None if any(limit.effect == "open" for limit in end_limits) else end
        ends.append(end)
    curve = np.array(sorted(points))
    lower, upper = in_unit(p, ends)
    statements = [*describe(p.unit, lower, upper, ends, limits), *unfinished]
    if robust and name in spread.needed and name not in spread.flat:
        statements.append(FitCode.AS_IF_MODEL_RIGHT(why=too_short(spread, name)))
    return Bounds(
        estimate.values[name], lower, upper, level, "profile" if robust else "likelihood-ratio",
        tuple(statements), curve, tuple(limits), walk.better(),
    )  # fmt: skip


def limit_statements(name: str, bounds: Bounds) -> list[Statement]:
    """State which other parameters reached a limit at the finite ends of the profile of `name`."""
    codes = {"lifted": FitCode.BOUND_BEYOND_GUARD, "held": FitCode.BOUND_AT_PHYSICAL_LIMIT}
    return [
        codes[limit.effect](bounded=name, **limit.values)
        for limit in bounds.limited_by
        if limit.effect in codes
    ]


class _Walk:
    """The profile of one coordinate `index`: at any value of it, all other coordinates are re-estimated by
    quasi-Newton steps, which start from the observed information.

    Steps stay within the limits with guards lifted.  A coordinate that the score pushes against a limit is
    held there, and the others are solved without it.  `last`: offset of the fixed coordinate → point and
    score after re-estimation there; `best`: (drop, point) of the most likely point met; `left`: passes left.
    """

    def __init__(self, objective: Objective, estimate: Estimate, spread: Uncertainty, index: int) -> None:
        self.objective, self.estimate, self.index = objective, estimate, index
        self.free = estimate.coordinates.free
        self.others = np.arange(len(self.free)) != index
        bounds = np.array([p.lifted_limits() for p in self.free])
        coordinates = estimate.coordinates
        self.units = natural_units(coordinates)
        near = LIMIT_DISTANCE * self.units
        self.lower = np.where(estimate.z <= coordinates.lower + near, coordinates.lower, bounds[:, 0])
        self.upper = np.where(estimate.z >= coordinates.upper - near, coordinates.upper, bounds[:, 1])
        self.curvature = with_positive_eigenvalues(spread.curvature)
        self.path = np.zeros(len(self.free))
        inside = np.array([p.name in spread.names and i != index for i, p in enumerate(self.free)])
        if spread.place(coordinates.names[index]) is not None and inside.any():
            block = positive_inverse(spread.curvature[np.ix_(inside, inside)])
            self.path[inside] = -block @ spread.curvature[inside, index]
        self.last = {0.0: (estimate.z, np.zeros_like(estimate.z))}
        self.best = (-BETTER_GAIN, estimate.z)
        self.left = WALK_PASSES

    def drop(self, offset: float) -> float:
        """Re-estimate the other coordinates at this offset of the fixed one from the estimate; returns twice
        the drop of the log-likelihood."""
        near = min(self.last, key=lambda visited: abs(visited - offset))
        z = self.last[near][0] + self.path * (offset - near)
        z = np.clip(z, self.lower, self.upper)
        z[self.index] = self.estimate.z[self.index] + offset
        curvature, has_information = self.curvature, False
        self.objective = self.objective.at(z)  # the sub-steps stay fixed while this offset is re-estimated
        value, gradient = self._score(z)
        for _ in range(WALK_STEPS):
            if self.left < 0:
                break
            outwards = ((z <= self.lower) & (gradient <= 0)) | ((z >= self.upper) & (gradient >= 0))
            step, promised = bounded_step(
                curvature,
                gradient,
                self.others & ~outwards,
                z,
                self.lower,
                self.upper,
                1e-9,
                reach_of(self.estimate.coordinates, z),
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
                if has_information:
                    break
                # the curvature of the estimate does not apply here: take the expected information at z
                curvature, has_information = self.objective.information(z).information, True
                continue
            curvature = secant_update(curvature, step, gradient - new_gradient)
            z, value, gradient = trial, new, new_gradient
        self.last[offset] = z, gradient
        self.best = min(self.best, (self.estimate.objective - value, z), key=lambda pair: pair[0])
        return 2.0 * (self.estimate.objective - value)

    def better(self) -> dict[str, float] | None:
        """Parameter values more likely than the estimate, if the walk met any."""
        drop, z = self.best
        return None if drop >= -BETTER_GAIN else self.objective.coordinates.values(z)

    def limits(self, side: Side, offset: float, threshold: float) -> list[Limit]:
        """The limits at which other coordinates are, at this offset of the fixed one; without those at which
        they are at the estimate already."""
        z, gradient = self.last[min(self.last, key=lambda visited: abs(visited - offset))]
        coordinates = self.estimate.coordinates
        limits = []
        for i, p in enumerate(self.free):
            near = LIMIT_DISTANCE * self.units[i]
            above = z[i] > coordinates.upper[i] - near
            search_limit, lifted = (
                (coordinates.upper[i], self.upper[i]) if above else (coordinates.lower[i], self.lower[i])
            )
            was_at_limit = abs(self.estimate.z[i] - search_limit) <= near
            if i == self.index or was_at_limit or not (above or z[i] < coordinates.lower[i] + near):
                continue
            unit = 1.0 if p.positive else p.upper - p.lower
            is_pushed = 2.0 * (gradient[i] if above else -gradient[i]) * unit > MATERIAL_GAIN * threshold
            is_at_end = abs(z[i] - lifted) <= near and is_pushed
            lifted_value = p.from_coordinate(lifted)
            physical = abs(lifted_value - p.physical[int(above)]) <= near * p.slope(lifted_value)
            if is_at_end:
                effect: Effect = "held" if physical else "open"
            elif abs(z[i] - search_limit) > near:
                effect = "lifted"
            else:
                continue
            value, limit = p.from_coordinate(float(z[i])), p.upper if above else p.lower
            limits.append(Limit(side, p.name, p.unit, value, limit, effect))
        return limits

    def _score(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """Value and score (d,); −∞ and zeros where the filter breaks down.  Counts the pass."""
        self.left -= 1
        try:
            value, gradient = self.objective.score(z)
        except FloatingPointError:
            return -math.inf, np.zeros_like(z)
        return (value, gradient) if math.isfinite(value) else (-math.inf, np.zeros_like(z))


def _end(
    walk: _Walk, p: Parameter, index: int, direction: float, threshold: float, first: float
) -> tuple[float | None, list[tuple[float, float]]]:
    """Find one end of a profile: the coordinate at which twice the drop reaches the threshold.

    direction: 1 for the upper end, −1 for the lower one.  first: offset that is tried first.

    Returns the coordinate, None if the profile does not reach the threshold within the search limit, and all
    points (value, drop) on the way.
    """
    z = walk.estimate.z[index]
    limit = abs(p.to_coordinate(p.upper if direction > 0 else p.lower) - z)
    points: list[tuple[float, float]] = []

    def root(offset: float) -> float:
        drop = walk.drop(direction * offset)
        points.append((p.from_coordinate(z + direction * offset), drop))
        return math.sqrt(max(drop, 0.0)) - math.sqrt(threshold)

    if limit < LIMIT_DISTANCE * walk.units[index]:
        return None, points
    inner, value_inner = 0.0, -math.sqrt(threshold)
    outer = min(first, limit)
    value_outer = root(outer)
    for _ in range(12):
        if value_outer >= 0 or outer >= limit or walk.left < 0:
            break
        slope = (value_outer - value_inner) / (outer - inner)
        reach = outer - value_outer / slope * 1.05 if slope > 0 else 2.0 * outer
        inner, value_inner = outer, value_outer
        outer = min(max(reach, 1.1 * outer), 3.0 * outer, limit)
        value_outer = root(outer)
    if value_outer < 0:
        return None, points
    for _ in range(12):
        if abs(value_outer) < 0.01 or outer - inner < 1e-3 * outer or walk.left < 0:
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
