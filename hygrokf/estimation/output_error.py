"""Output-error fit (`--criterion simulation`): the criterion of the paper, the free run against the readings.

Minimises ½ Σ_j n_j ln(SSE_j/n_j) over the outputs j by Gauss–Newton; bounds from a sandwich with long-run
variance, because free-run residuals are serially dependent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hygrokf.estimation.confidence import normal_quantile, positive_inverse
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import LIMIT_DISTANCE
from hygrokf.physics.parameters import Coordinates

LEAST_DAMPING = 1e-12
"""Least damping, relative to the scaled Gauss–Newton matrix; keeps the matrix regular where parameters act
alike."""
TRANSIENT_H = 24.0
"""[h] residuals at the start that are left out, because the initial state is a guess."""
FEWEST_VARIANCE_BLOCKS = 40


@dataclass(frozen=True)
class OutputError:
    """Estimates by simulation: `values` of all parameters, and the covariance of the coordinates `names`.

    `at_bounds`: parameters that ended at a bound; `unseen`: constant errors of the sensors, which are 0 in
    `values` because a free run cannot distinguish them from the model's own parameters and this criterion has
    no prior for them.
    """

    values: dict[str, float]
    names: tuple[str, ...]
    covariance: np.ndarray
    converged: bool
    at_bounds: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()

    def bounds(self, name: str, positive: bool, level: float = CONFIDENCE) -> tuple[float, float]:
        """Bounds symmetric in the parameter's coordinate; open where the estimate ended at a search limit."""
        if name in self.at_bounds:
            return (0.0 if positive else -math.inf), math.inf
        i, value = self.names.index(name), self.values[name]
        reach = normal_quantile(level) * math.sqrt(max(self.covariance[i, i], 0.0))
        if positive:
            factor = min(reach, 50.0)
            return value * math.exp(-factor), value * math.exp(factor)
        return value - reach, value + reach


def fit_output_error(likelihood: Likelihood, values: dict[str, float], passes: int = 40) -> OutputError:
    """Free-run least squares from start `values`; noise parameters are fixed, sensor errors are 0.

    The first day (in short records the first quarter) is run but not counted.
    """
    model, time = likelihood.model, likelihood.timeline.time
    counted = time - time[0] >= min(TRANSIENT_H, 0.25 * (time[-1] - time[0]))
    fixed = {p.name: values[p.name] for p in model.parameters if p.noise}
    unseen = tuple(p.name for p in model.parameters if p.prior is not None)
    coordinates = Coordinates(model.parameters, fixed | dict.fromkeys(unseen, 0.0))
    z = coordinates.start(values)

    def residuals(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        e, slopes = likelihood.residuals(coordinates.values(z), coordinates.directions(z))
        return np.where(counted[:, None], e, np.nan), slopes

    def objective(e: np.ndarray) -> float:
        total = 0.0
        for column in e.T:
            present = column[np.isfinite(column)]
            if len(present):
                total += 0.5 * len(present) * math.log(float(present @ present) / len(present) + 1e-300)
        return total

    e, slopes = residuals(z)
    value, damping, converged = objective(e), 1e-3, False
    for _ in range(passes):
        gradient, matrix, _ = _normal_equations(e, slopes)
        free = ~(((z <= coordinates.lower) & (gradient < 0)) | ((z >= coordinates.upper) & (gradient > 0)))
        has_improved = False
        for _ in range(12):
            scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix)[free], 1e-300))
            scaled = matrix[np.ix_(free, free)] * scale[:, None] * scale + damping * np.eye(int(free.sum()))
            step = np.zeros_like(z)
            step[free] = scale * np.linalg.solve(scaled, scale * gradient[free])
            step /= max(1.0, float(np.max(np.abs(step) / np.maximum(1.5, 0.5 * np.abs(z)))))
            new = np.clip(z + step, coordinates.lower, coordinates.upper)
            trial, trial_slopes = residuals(new)
            trial_value = objective(trial)
            if math.isfinite(trial_value) and trial_value < value:
                has_improved = True
                break
            damping = max(damping, 1e-6) * 8.0
        if not has_improved or value - trial_value < 1e-4:
            if has_improved:
                z, e, slopes = new, trial, trial_slopes
            converged = True
            break
        z, e, slopes, value = new, trial, trial_slopes, trial_value
        damping = max(damping / 8.0, LEAST_DAMPING)
    _, matrix, scores = _normal_equations(e, slopes)
    inverse = positive_inverse(matrix)
    # two days exceed the memory of the disturbances; short records need shorter blocks for enough blocks
    block_h = min(max((time[-1] - time[0]) / FEWEST_VARIANCE_BLOCKS, 12.0), 48.0)
    score_variance = long_run_variance(scores, time, block_h)
    is_at_bound = (z <= coordinates.lower + LIMIT_DISTANCE) | (z >= coordinates.upper - LIMIT_DISTANCE)
    at_bounds = tuple(
        name for name, ends_at_bound in zip(coordinates.names, is_at_bound, strict=True) if ends_at_bound
    )
    covariance = inverse @ score_variance @ inverse
    return OutputError(coordinates.values(z), coordinates.names, covariance, converged, at_bounds, unseen)


def long_run_variance(scores: np.ndarray, time: np.ndarray, block_h: float) -> np.ndarray:
    """Variance (d, d) of the sum of serially dependent scores (T, d) at `time` [h], from sums over blocks,
    with Bartlett's weight for neighbouring blocks (Newey & West 1987)."""
    block = ((time - time[0]) / block_h).astype(int)
    sums = np.zeros((block[-1] + 1, scores.shape[1]))
    np.add.at(sums, block, scores)
    sums = sums - sums.mean(axis=0)
    cross = sums[1:].T @ sums[:-1]
    return sums.T @ sums + 0.5 * (cross + cross.T)


def _normal_equations(e: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Descent direction (r,), Gauss–Newton matrix (r, r) and each instant's share (T, r) of the direction."""
    shares = np.zeros((len(e), slopes.shape[2]))
    matrix = np.zeros((slopes.shape[2], slopes.shape[2]))
    for j in range(e.shape[1]):
        is_present = np.isfinite(e[:, j])
        if not is_present.any():
            continue
        weight = 1.0 / max(float(np.mean(e[is_present, j] ** 2)), 1e-300)
        shares[is_present] -= weight * e[is_present, j, None] * slopes[is_present, j]
        matrix += weight * slopes[is_present, j].T @ slopes[is_present, j]
    return shares.sum(axis=0), matrix, shares
