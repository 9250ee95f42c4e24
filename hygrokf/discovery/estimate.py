"""Maximum likelihood of a simulation: its parameters by Gauss–Newton, the variances of its error by scoring.

The objective is −2 ln L of the identification readings under the error model, summed over the quantities,
plus (z − mean)²/sd² of priors.  The steps with all dampings are simulated together, and the best is taken.
An estimate is `linear` in a parameter whose coordinate is the value itself instead of its logarithm, and
`plain` where the error model is white noise (least squares).

Shapes: T readings of a quantity, P parameters, d free parameters.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hygrokf.discovery.error_model import (
    HUBER,
    VARIANCES,
    Filtered,
    Instants,
    course,
    filtered,
    loss,
    maximised,
)
from hygrokf.discovery.simulator import Simulator
from hygrokf.physics.parameters import Parameter
from hygrokf.texts.parts import BOTH_PARTS

TIME_CONSTANT_OF = {part.balance: part.time_constant for part in BOTH_PARTS}
"""Parameter that is the time constant [h] of a quantity's low pass."""
DAMPINGS = (0.0, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1000.0)
LARGEST_STEP = 1.5
"""Largest change of a logarithmic coordinate in one step."""
MOVE = 1e-3
"""Step of the numerical Jacobian: change of a logarithm; fifty times this share of a prior's standard
deviation; a tenth of this share of a range."""
GAUSS_NEWTON_STEPS = 3
"""Gauss–Newton steps between two estimates of the variances."""
LIGHT, POLISH = (3, 0.3), (10, 0.05)
"""Effort of a fit: largest number of rounds, and the gain in −2 ln L below which they end."""


@dataclass(frozen=True)
class Calibration:
    """Parameters `theta` (P,) of a simulator; by quantity, the instants of the error, its variances (7,) and
    the simulated readings (T,); linear: parameters whose coordinate is never the logarithm."""

    simulator: Simulator
    errors: Mapping[str, Instants]
    theta: np.ndarray
    variances: Mapping[str, np.ndarray]
    simulated: Mapping[str, np.ndarray]
    linear: frozenset[str] = frozenset()
    plain: bool = False

    @property
    def values(self) -> dict[str, float]:
        return dict(zip(self.simulator.names, self.theta.tolist(), strict=True))

    @property
    def quantities(self) -> tuple[str, ...]:
        return tuple(self.simulated)

    def residual(self, quantity: str) -> np.ndarray:
        """(T,) reading − simulation in the identification period, else NaN."""
        r = self.simulator.scene.readings[quantity]
        return np.where(r.identified, r.value - self.simulated[quantity], np.nan)

    @cached_property
    def filtered(self) -> dict[str, Filtered]:
        bound = math.inf if self.plain else HUBER
        return {
            q: filtered(self.errors[q], self.variances[q], self.residual(q), bound) for q in self.quantities
        }

    @cached_property
    def deviances(self) -> dict[str, float]:
        """−2 ln L of each quantity, the priors of its parameters included."""
        return {
            q: reference.deviance + sum(
                _prior_term(p, x) for p, x in zip(self.simulator.parameters, self.theta, strict=True)
                if q in self.simulator.affects(p.name)
            )
            for q, reference in self.filtered.items()
        }  # fmt: skip

    @property
    def deviance(self) -> float:
        return sum(self.deviances.values())


def _prior_term(p: Parameter, value: float) -> float:
    if p.prior is None:
        return 0.0
    coordinate = math.log(value) if p.prior.logarithmic else value
    return ((coordinate - p.prior.mean) / p.prior.sd) ** 2


@dataclass(frozen=True)
class Frame:
    """Coordinates of the free parameters (each (d,)): their places among all parameters, whether a coordinate
    is the logarithm, its limits, and its `move` for the numerical Jacobian."""

    place: np.ndarray
    logarithmic: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    move: np.ndarray

    def coordinates(self, theta: np.ndarray) -> np.ndarray:
        x = theta[self.place]
        return np.where(self.logarithmic, np.log(np.maximum(x, 1e-300)), x)

    def theta(self, start: np.ndarray, z: np.ndarray) -> np.ndarray:
        theta = start.copy()
        theta[self.place] = np.where(self.logarithmic, np.exp(np.where(self.logarithmic, z, 0.0)), z)
        return theta


def frame(parameters: Sequence[Parameter], free: Collection[str], linear: Collection[str]) -> Frame:
    place = np.array([i for i, p in enumerate(parameters) if p.name in free], dtype=int)
    free_parameters = [parameters[i] for i in place]
    logarithmic = np.array([p.positive and p.name not in linear for p in free_parameters], dtype=bool)
    lower = [math.log(p.lower) if is_log else (min(p.lower, p.null or 0.0) if p.positive else p.lower)
             for p, is_log in zip(free_parameters, logarithmic, strict=True)]  # fmt: skip
    upper = [
        math.log(p.upper) if is_log else p.upper
        for p, is_log in zip(free_parameters, logarithmic, strict=True)
    ]
    move = [
        MOVE if is_log else 50.0 * MOVE * p.prior.sd if p.prior else 0.1 * MOVE * min(p.upper - p.lower, 50.0)
        for p, is_log in zip(free_parameters, logarithmic, strict=True)
    ]
    return Frame(place, logarithmic, np.array(lower), np.array(upper), np.array(move))


def estimate_at(
    simulator: Simulator, errors: Mapping[str, Instants], theta: np.ndarray,
    linear: frozenset[str] = frozenset(), variances: Mapping[str, np.ndarray] | None = None,
    plain: bool = False,
) -> Calibration:  # fmt: skip
    """The calibration at given parameters; without `variances`, with those of the greatest likelihood."""
    simulated = {q: simulator.simulated(theta[:, None], q)[:, 0] for q in errors}
    calibration = Calibration(simulator, errors, theta, variances or {}, simulated, linear, plain)
    return calibration if variances else with_variances(calibration)


def with_variances(estimate: Calibration, quantities: Sequence[str] | None = None) -> Calibration:
    """The estimate with the variances of the quantities (None: all) at their maximum likelihood."""
    variances = dict(estimate.variances)
    for q in estimate.quantities if quantities is None else quantities:
        residual = estimate.residual(q)
        if estimate.plain:
            variances[q] = np.zeros(VARIANCES)
            variances[q][0] = max(float(np.nanmean(residual**2)), 1e-12)
        else:
            start = estimate.variances.get(q)
            variances[q] = maximised(estimate.errors[q], residual, start)
    return replace(estimate, variances=variances)


Columns = Mapping[str, Mapping[str, np.ndarray]]
"""Columns (T,) of the Jacobian by quantity and parameter."""


def fitted(
    estimate: Calibration,
    free: Collection[str] | None = None,
    effort: tuple[int, float] = POLISH,
    kept: Columns | None = None,
) -> Calibration:
    """The estimate with the free parameters (None: all) and the variances at their maximum likelihood.

    Quantities that share no parameter are fitted one after the other.  kept: columns of the Jacobian at a
    nearby point, used in all steps.
    """
    names = set(estimate.simulator.names) if free is None else set(free)
    for block in _blocks(estimate, names):
        rounds, tolerance = effort
        for _ in range(rounds):
            deviance_before = sum(estimate.deviances[q] for q in block)
            estimate = with_variances(_stepped(estimate, names, block, kept or {}), block)
            if not sum(estimate.deviances[q] for q in block) < deviance_before - tolerance:
                break
    return estimate


def acting(estimate: Calibration, quantities: Collection[str]) -> list[str]:
    """The parameters that act on any of the quantities."""
    return [
        name for name in estimate.simulator.names if set(estimate.simulator.affects(name)) & set(quantities)
    ]


def _blocks(estimate: Calibration, free: set[str]) -> list[tuple[str, ...]]:
    """The quantities that free parameters act on, as one block if any parameter acts on several of them."""
    acted_on = [set(estimate.simulator.affects(name)) & set(estimate.quantities) for name in free]
    if any(len(group) > 1 for group in acted_on):
        return [estimate.quantities]
    return [(q,) for q in estimate.quantities if {q} in acted_on]


def _stepped(estimate: Calibration, free: set[str], block: tuple[str, ...], kept: Columns) -> Calibration:
    """Up to `GAUSS_NEWTON_STEPS` Gauss–Newton steps under fixed variances."""
    acting_names = {name for name in free if set(estimate.simulator.affects(name)) & set(block)}
    for _ in range(GAUSS_NEWTON_STEPS):
        f = frame(estimate.simulator.parameters, acting_names, estimate.linear)
        matrix, gradient = _normal_equations(estimate, f, block, kept)
        z = f.coordinates(estimate.theta)
        steps = [_step(matrix, gradient, z, f, damping) for damping in DAMPINGS]
        trials = np.column_stack([f.theta(estimate.theta, np.clip(z + s, f.lower, f.upper)) for s in steps])
        deviance, runs = _trials(estimate, trials, block)
        best = int(np.argmin(deviance))
        gain = sum(estimate.deviances[q] for q in block) - deviance[best]
        if not gain > 0.0:
            break
        simulated = {q: y[:, best] for q, y in runs.items()}
        estimate = replace(
            estimate, theta=trials[:, best].copy(), simulated={**estimate.simulated, **simulated}
        )
        if gain < 0.1:
            break
    return estimate


def _trials(
    estimate: Calibration, theta: np.ndarray, block: Sequence[str]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """−2 ln L (n,) under the estimate's variances, and the readings (T, n), of runs with parameters (P, n);
    −2 ln L is infinite where a run diverges."""
    total = np.zeros(theta.shape[1])
    simulated = {}
    for q in block:
        reference, r = estimate.filtered[q], estimate.simulator.scene.readings[q]
        with np.errstate(over="ignore", invalid="ignore"):
            trial_readings = simulated[q] = estimate.simulator.simulated(theta, q)
            errors = reference.whitened(
                np.where(r.identified[:, None], r.value[:, None] - trial_readings, np.nan)
            )
            total += loss(errors, reference.bound).sum(axis=0) + float(
                np.log(reference.variance[np.isfinite(reference.innovation)]).sum()
            )
        for i, p in enumerate(estimate.simulator.parameters):
            if p.prior is not None and q in estimate.simulator.affects(p.name):
                total += np.array([_prior_term(p, x) for x in theta[i]])
    return np.where(np.isfinite(total), total, math.inf), simulated


def slopes(
    estimate: Calibration, coordinates: Frame, block: Sequence[str] | None = None, kept: Columns | None = None
) -> dict[str, np.ndarray]:
    """The Jacobian (T, d) of the simulated readings in the coordinates, by quantity (None: all); columns in
    `kept` are used as they are."""
    block = estimate.quantities if block is None else block
    z = coordinates.coordinates(estimate.theta)
    names = [estimate.simulator.names[i] for i in coordinates.place]
    jacobian = {q: np.zeros((len(estimate.simulated[q]), len(z))) for q in block}
    for q in block:
        kept_columns = (kept or {}).get(q, {})
        for i, name in enumerate(names):
            if name in kept_columns:
                jacobian[q][:, i] = kept_columns[name]
        to_run = [
            i for i, n in enumerate(names) if n not in kept_columns and q in estimate.simulator.affects(n)
        ]
        if not to_run:
            continue
        move = np.where(z + coordinates.move > coordinates.upper, -coordinates.move, coordinates.move)
        moved_theta = [coordinates.theta(estimate.theta, z + move * (np.arange(len(z)) == i)) for i in to_run]
        moved_readings = estimate.simulator.simulated(np.column_stack(moved_theta), q)
        jacobian[q][:, to_run] = (moved_readings - estimate.simulated[q][:, None]) / move[to_run]
    return jacobian


def weighted(estimate: Calibration, quantity: str, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whitened columns (T, c) and whitened errors (T,), each times the roots of the readings' weights."""
    reference = estimate.filtered[quantity]
    root = np.sqrt(reference.weight)
    with np.errstate(invalid="ignore", over="ignore"):
        white = reference.whitened(np.nan_to_num(columns)) * root[:, None]
    return white, np.nan_to_num(reference.standardised) * root


def _normal_equations(
    estimate: Calibration, coordinates: Frame, block: Sequence[str], kept: Columns
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss–Newton matrix (d, d) and gradient (d,) of half of −2 ln L."""
    d = len(coordinates.place)
    matrix, gradient = np.zeros((d, d)), np.zeros(d)
    for q, columns in slopes(estimate, coordinates, block, kept).items():
        reference = estimate.filtered[q]
        nonzero = np.flatnonzero(columns.any(axis=0))
        white = reference.whitened(columns[:, nonzero])
        e, w = np.nan_to_num(reference.standardised), reference.weight
        matrix[np.ix_(nonzero, nonzero)] += white.T @ (white * w[:, None])
        gradient[nonzero] -= white.T @ (w * e)
    information, slope = of_priors(estimate, coordinates)
    matrix += np.diag(information)
    gradient -= slope
    return matrix, gradient


def of_priors(estimate: Calibration, coordinates: Frame) -> tuple[np.ndarray, np.ndarray]:
    """(d,) information of the priors in the coordinates, and the gradient of their log densities."""
    information, gradient = np.zeros((2, len(coordinates.place)))
    for i, place in enumerate(coordinates.place):
        prior, value = estimate.simulator.parameters[place].prior, float(estimate.theta[place])
        if prior is not None:
            unit = value if coordinates.logarithmic[i] else 1.0
            information[i], gradient[i] = (
                prior.information(value) * unit**2,
                prior.log_density_derivative(value) * unit,
            )
    return information, gradient


def _step(
    matrix: np.ndarray, gradient: np.ndarray, z: np.ndarray, coordinates: Frame, damping: float
) -> np.ndarray:
    """A damped Gauss–Newton step; coordinates at a limit with an outward gradient stay there."""
    step = np.zeros(len(z))
    free = ~(((z <= coordinates.lower) & (gradient > 0)) | ((z >= coordinates.upper) & (gradient < 0))) & (
        np.diag(matrix) > 0
    )
    for _ in range(len(z) + 1):
        if not free.any():
            break
        scale = 1.0 / np.sqrt(np.diag(matrix)[free])
        scaled = matrix[np.ix_(free, free)] * scale[:, None] * scale + (damping + 1e-9) * np.eye(free.sum())
        step[:] = 0.0
        step[free] = -scale * np.linalg.solve(scaled, scale * gradient[free])
        # a step across a limit is computed again with that coordinate fixed
        beyond = free & (
            (z + step < coordinates.lower) & (z <= coordinates.lower + 1e-12)
            | (z + step > coordinates.upper) & (z >= coordinates.upper - 1e-12)
        )
        if not beyond.any():
            break
        free &= ~beyond
    largest = np.where(coordinates.logarithmic, LARGEST_STEP, np.inf)
    return np.clip(step, -largest, largest)


def errors_of(simulator: Simulator, theta: np.ndarray, quantities: Sequence[str]) -> dict[str, Instants]:
    """The instants of the errors by quantity; their low pass has the time constants of parameters (P,)."""
    values = dict(zip(simulator.names, theta.tolist(), strict=True))
    courses = {}
    for q in quantities:
        r = simulator.scene.readings[q]
        shape = (r.saturated / np.mean(r.saturated)) ** 2
        largest = max(float(np.nanvar(np.where(r.identified, r.value, np.nan))), 1e-9)
        courses[q] = course(r.time_h, values[TIME_CONSTANT_OF[q]], r.added, shape, largest=largest)
    return courses
