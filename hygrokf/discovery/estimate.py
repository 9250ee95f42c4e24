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

TIME_CONSTANT_OF = {"temperature": "thermal_time_constant", "vapour": "hygric_k"}
"""Quantity -> parameter that is the time constant [h] of its low pass."""
DAMPINGS = (0.0, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1000.0)
LARGEST_STEP = 1.5
"""Largest change of a logarithmic coordinate in one step."""
MOVE = 1e-3
"""Step of the numerical Jacobian: for a logarithm this change; for a parameter with a prior 50 times this
share of the prior's standard deviation; for others a tenth of this share of the range."""
GAUSS_NEWTON_STEPS = 3
"""Largest number of Gauss–Newton steps between two estimates of the error variances."""
LIGHT, POLISH = (3, 0.3), (10, 0.05)
"""Effort of a fit: largest number of rounds, and the gain in −2 ln L below which they end."""


@dataclass(frozen=True)
class Calibration:
    """A simulator with parameter values, and the error process of each quantity.

    errors: by quantity, the instants and coefficients of the error process.
    theta: (P,) parameter values.
    variances: (7,) of the error process, by quantity.
    simulated: (T,) simulated readings, by quantity.
    linear: parameters that are estimated as they are, never as logarithms.
    plain: whether the error counts as white noise (least squares) instead of the error process.
    """

    simulator: Simulator
    errors: Mapping[str, Instants]
    theta: np.ndarray
    variances: Mapping[str, np.ndarray]
    simulated: Mapping[str, np.ndarray]
    linear: frozenset[str] = frozenset()
    plain: bool = False

    @property
    def values(self) -> dict[str, float]:
        """Parameter values by name."""
        return dict(zip(self.simulator.names, self.theta.tolist(), strict=True))

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of the simulated quantities."""
        return tuple(self.simulated)

    def residual(self, quantity: str) -> np.ndarray:
        """Return (T,) reading minus simulation in the identification period, NaN elsewhere."""
        r = self.simulator.scene.readings[quantity]
        return np.where(r.identified, r.value - self.simulated[quantity], np.nan)

    @cached_property
    def filtered(self) -> dict[str, Filtered]:
        """The error of each quantity after the filter of its error process."""
        bound = math.inf if self.plain else HUBER
        return {
            q: filtered(self.errors[q], self.variances[q], self.residual(q), bound) for q in self.quantities
        }

    @cached_property
    def deviances(self) -> dict[str, float]:
        """−2 ln L of each quantity, including the priors of the parameters that act on it."""
        return {
            q: reference.deviance + sum(
                _prior_term(p, x) for p, x in zip(self.simulator.parameters, self.theta, strict=True)
                if q in self.simulator.affects(p.name)
            )
            for q, reference in self.filtered.items()
        }  # fmt: skip

    @property
    def deviance(self) -> float:
        """−2 ln L of all quantities."""
        return sum(self.deviances.values())


def _prior_term(parameter: Parameter, value: float) -> float:
    """Return a parameter's contribution to −2 ln L from its prior; 0 without a prior."""
    if parameter.prior is None:
        return 0.0
    coordinate = math.log(value) if parameter.prior.logarithmic else value
    return ((coordinate - parameter.prior.mean) / parameter.prior.sd) ** 2


@dataclass(frozen=True)
class Frame:
    """The coordinates in which d free parameters are estimated: a parameter or its logarithm.

    place: (d,) index of each among all parameters.  logarithmic: (d,) whether the coordinate is the
        logarithm.
    lower, upper: (d,) limits of the coordinates.  move: (d,) steps for the numerical Jacobian.
    """

    place: np.ndarray
    logarithmic: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    move: np.ndarray

    def coordinates(self, theta: np.ndarray) -> np.ndarray:
        """Return the coordinates (d,) of a parameter vector (P,)."""
        x = theta[self.place]
        return np.where(self.logarithmic, np.log(np.maximum(x, 1e-300)), x)

    def theta(self, start: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the parameter vector (P,) at coordinates z (d,); parameters that are not free keep their
        `start`."""
        theta = start.copy()
        theta[self.place] = np.where(self.logarithmic, np.exp(np.where(self.logarithmic, z, 0.0)), z)
        return theta


def frame(parameters: Sequence[Parameter], free: Collection[str], linear: Collection[str]) -> Frame:
    """Return the coordinates of the free parameters; `linear` names those that are never logarithms."""
    indices = np.array([i for i, p in enumerate(parameters) if p.name in free], dtype=int)
    free_parameters = [parameters[i] for i in indices]
    logarithmic = np.array([p.positive and p.name not in linear for p in free_parameters], dtype=bool)
    lower = [math.log(p.lower) if is_log else (min(p.lower, p.null or 0.0) if p.positive else p.lower)
             for p, is_log in zip(free_parameters, logarithmic, strict=True)]  # fmt: skip
    upper = [
        math.log(p.upper) if is_log else p.upper
        for p, is_log in zip(free_parameters, logarithmic, strict=True)
    ]
    jacobian_step = [
        MOVE if is_log else 50.0 * MOVE * p.prior.sd if p.prior else 0.1 * MOVE * min(p.upper - p.lower, 50.0)
        for p, is_log in zip(free_parameters, logarithmic, strict=True)
    ]
    return Frame(indices, logarithmic, np.array(lower), np.array(upper), np.array(jacobian_step))


def estimate_at(
    simulator: Simulator, errors: Mapping[str, Instants], theta: np.ndarray,
    linear: frozenset[str] = frozenset(), variances: Mapping[str, np.ndarray] | None = None,
    plain: bool = False,
) -> Calibration:  # fmt: skip
    """Return the calibration at parameters theta (P,).

    errors: error process by quantity.  variances: (7,) by quantity; None: those with the largest likelihood.
    """
    simulated = {q: simulator.simulated(theta[:, None], q)[:, 0] for q in errors}
    calibration = Calibration(simulator, errors, theta, variances or {}, simulated, linear, plain)
    return calibration if variances else with_variances(calibration)


def with_variances(estimate: Calibration, quantities: Sequence[str] | None = None) -> Calibration:
    """Return the estimate with the error variances of largest likelihood, for the given quantities (None:
    all)."""
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
    """Return the estimate with its free parameters and error variances at their maximum likelihood.

    free: names of the parameters to fit; None: all.  effort: largest number of rounds, and the gain in −2 ln
        L at which they end.  kept: Jacobian columns of a nearby point, used in all steps.
    Quantities that share no free parameter are fitted separately.
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
    """Return the names of the parameters that act on any of the quantities."""
    return [
        name for name in estimate.simulator.names if set(estimate.simulator.affects(name)) & set(quantities)
    ]


def _blocks(estimate: Calibration, free: set[str]) -> list[tuple[str, ...]]:
    """Return the groups of quantities that must be fitted together.

    All of them form one group if any free parameter acts on several.
    """
    acted_on = [set(estimate.simulator.affects(name)) & set(estimate.quantities) for name in free]
    if any(len(group) > 1 for group in acted_on):
        return [estimate.quantities]
    return [(q,) for q in estimate.quantities if {q} in acted_on]


def _stepped(estimate: Calibration, free: set[str], block: tuple[str, ...], kept: Columns) -> Calibration:
    """Make up to `GAUSS_NEWTON_STEPS` damped Gauss–Newton steps of the free parameters, with the error
    variances fixed.

    block: the quantities that count.  kept: Jacobian columns that are not computed again.
    """
    acting_names = {name for name in free if set(estimate.simulator.affects(name)) & set(block)}
    for _ in range(GAUSS_NEWTON_STEPS):
        coordinates = frame(estimate.simulator.parameters, acting_names, estimate.linear)
        matrix, gradient = _normal_equations(estimate, coordinates, block, kept)
        position = coordinates.coordinates(estimate.theta)
        steps = [_step(matrix, gradient, position, coordinates, damping) for damping in DAMPINGS]
        trials = np.column_stack(
            [
                coordinates.theta(
                    estimate.theta, np.clip(position + step, coordinates.lower, coordinates.upper)
                )
                for step in steps
            ]
        )
        deviance, simulated_of_trials = _trials(estimate, trials, block)
        best = int(np.argmin(deviance))
        gain = sum(estimate.deviances[q] for q in block) - deviance[best]
        if not gain > 0.0:
            break
        simulated = {q: readings_of_trials[:, best] for q, readings_of_trials in simulated_of_trials.items()}
        estimate = replace(
            estimate, theta=trials[:, best].copy(), simulated={**estimate.simulated, **simulated}
        )
        if gain < 0.1:
            break
    return estimate


def _trials(
    estimate: Calibration, theta: np.ndarray, block: Sequence[str]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Simulate parameter vectors theta (P, n).

    Returns −2 ln L (n,), infinite where a run diverges, and the simulated readings (T, n) by quantity.
    """
    total = np.zeros(theta.shape[1])
    simulated = {}
    for q in block:
        reference, readings = estimate.filtered[q], estimate.simulator.scene.readings[q]
        with np.errstate(over="ignore", invalid="ignore"):
            trial_readings = simulated[q] = estimate.simulator.simulated(theta, q)
            errors = reference.whitened(
                np.where(readings.identified[:, None], readings.value[:, None] - trial_readings, np.nan)
            )
            total += loss(errors, reference.bound).sum(axis=0) + float(
                np.log(reference.variance[np.isfinite(reference.innovation)]).sum()
            )
        for i, parameter in enumerate(estimate.simulator.parameters):
            if parameter.prior is not None and q in estimate.simulator.affects(parameter.name):
                total += np.array([_prior_term(parameter, x) for x in theta[i]])
    return np.where(np.isfinite(total), total, math.inf), simulated


def slopes(
    estimate: Calibration,
    coordinates: Frame,
    block: Sequence[str] | None = None,
    known_columns: Columns | None = None,
) -> dict[str, np.ndarray]:
    """Return the Jacobian (T, d) of the simulated readings in the coordinates, by quantity.

    block: the quantities; None: all.
    known_columns: columns that are not computed again, by quantity and parameter.
    """
    block = estimate.quantities if block is None else block
    position = coordinates.coordinates(estimate.theta)
    names = [estimate.simulator.names[i] for i in coordinates.place]
    jacobian = {q: np.zeros((len(estimate.simulated[q]), len(position))) for q in block}
    for q in block:
        kept_columns = (known_columns or {}).get(q, {})
        for i, name in enumerate(names):
            if name in kept_columns:
                jacobian[q][:, i] = kept_columns[name]
        to_run = [
            i
            for i, name in enumerate(names)
            if name not in kept_columns and q in estimate.simulator.affects(name)
        ]
        if not to_run:
            continue
        steps = np.where(position + coordinates.move > coordinates.upper, -coordinates.move, coordinates.move)
        moved_theta = [
            coordinates.theta(estimate.theta, position + steps * (np.arange(len(position)) == i))
            for i in to_run
        ]
        moved_readings = estimate.simulator.simulated(np.column_stack(moved_theta), q)
        jacobian[q][:, to_run] = (moved_readings - estimate.simulated[q][:, None]) / steps[to_run]
    return jacobian


def weighted(estimate: Calibration, quantity: str, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return whitened columns (T, c) and whitened errors (T,), each times the root of the readings' Huber
    weights."""
    reference = estimate.filtered[quantity]
    root = np.sqrt(reference.weight)
    with np.errstate(invalid="ignore", over="ignore"):
        white = reference.whitened(np.nan_to_num(columns)) * root[:, None]
    return white, np.nan_to_num(reference.standardised) * root


def _normal_equations(
    estimate: Calibration, coordinates: Frame, block: Sequence[str], kept: Columns
) -> tuple[np.ndarray, np.ndarray]:
    """Return the Gauss–Newton matrix (d, d) and the gradient (d,) of ½ (−2 ln L), priors included."""
    count = len(coordinates.place)
    matrix, gradient = np.zeros((count, count)), np.zeros(count)
    for q, columns in slopes(estimate, coordinates, block, kept).items():
        reference = estimate.filtered[q]
        nonzero = np.flatnonzero(columns.any(axis=0))
        white = reference.whitened(columns[:, nonzero])
        errors, weights = np.nan_to_num(reference.standardised), reference.weight
        matrix[np.ix_(nonzero, nonzero)] += white.T @ (white * weights[:, None])
        gradient[nonzero] -= white.T @ (weights * errors)
    information, slope = of_priors(estimate, coordinates)
    matrix += np.diag(information)
    gradient -= slope
    return matrix, gradient


def of_priors(estimate: Calibration, coordinates: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Return the information (d,) of the priors in the coordinates, and the gradient (d,) of their log
    densities."""
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
    """Return a damped Gauss–Newton step (d,) from coordinates z (d,).

    A coordinate at a limit stays there if the gradient points outward.
    """
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
    """Return the error process of each quantity at parameters theta (P,), which give the time constants of
    its low pass."""
    values = dict(zip(simulator.names, theta.tolist(), strict=True))
    instants_of = {}
    for q in quantities:
        readings = simulator.scene.readings[q]
        relative_noise = (readings.saturated / np.mean(readings.saturated)) ** 2
        variance_of_readings = max(
            float(np.nanvar(np.where(readings.identified, readings.value, np.nan))), 1e-9
        )
        instants_of[q] = course(
            readings.time_h,
            values[TIME_CONSTANT_OF[q]],
            readings.added,
            relative_noise,
            largest=variance_of_readings,
        )
    return instants_of
