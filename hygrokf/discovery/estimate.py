"""Maximum likelihood of a simulation: its parameters by Gauss–Newton, the variances of its error by scoring.

The objective is −2 ln L of the identification readings under the error model, summed over the quantities,
plus (z − mean)²/sd² of priors.  Trial steps of all dampings run side by side, so that one pass finds the best
of them.

Shapes: T readings of a quantity, P parameters, d free ones.
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

TIME_CONSTANT = {"temperature": "thermal_time_constant", "vapour": "hygric_k"}
"""Parameter that is the time constant [h] of a quantity's low pass."""
DAMPINGS = (0.0, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1000.0)
LARGEST_STEP = 1.5
"""Largest change of a logarithm in one step."""
MOVE = 1e-3
"""Change of a logarithm, share of a prior's deviation by fifty and of a range by ten, for slopes."""
STEPS = 3
"""Gauss–Newton steps between two estimates of the variances."""
LIGHT, POLISH = (3, 0.3), (10, 0.05)
"""Rounds at most, and the gain in −2 ln L below which they end."""


@dataclass(frozen=True)
class Calibration:
    """Parameters and variances of a simulator: theta (P,); the course of the error, its variances (7,)
    and simulated readings (T,) by quantity; linear: parameters that are estimated as they are, whatever their
    coordinate elsewhere."""

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
            q: one.deviance + sum(
                _prior_term(p, x) for p, x in zip(self.simulator.parameters, self.theta, strict=True)
                if q in self.simulator.affects(p.name)
            )
            for q, one in self.filtered.items()
        }  # fmt: skip

    @property
    def deviance(self) -> float:
        return sum(self.deviances.values())


def _prior_term(p: Parameter, value: float) -> float:
    if p.prior is None:
        return 0.0
    at = math.log(value) if p.prior.logarithmic else value
    return ((at - p.prior.mean) / p.prior.sd) ** 2


@dataclass(frozen=True)
class Frame:
    """Free parameters in their coordinates: place (d,) among all, whether each is a logarithm, and limits."""

    place: np.ndarray
    logarithmic: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    move: np.ndarray

    def coordinates(self, theta: np.ndarray) -> np.ndarray:
        x = theta[self.place]
        return np.where(self.logarithmic, np.log(np.maximum(x, 1e-300)), x)

    def theta(self, before: np.ndarray, z: np.ndarray) -> np.ndarray:
        made = before.copy()
        made[self.place] = np.where(self.logarithmic, np.exp(np.where(self.logarithmic, z, 0.0)), z)
        return made


def frame(parameters: Sequence[Parameter], free: Collection[str], linear: Collection[str]) -> Frame:
    place = np.array([i for i, p in enumerate(parameters) if p.name in free], dtype=int)
    chosen = [parameters[i] for i in place]
    logs = np.array([p.positive and p.name not in linear for p in chosen], dtype=bool)
    lower = [math.log(p.lower) if log else (min(p.lower, p.null or 0.0) if p.positive else p.lower)
             for p, log in zip(chosen, logs, strict=True)]  # fmt: skip
    upper = [math.log(p.upper) if log else p.upper for p, log in zip(chosen, logs, strict=True)]
    move = [
        MOVE if log else 50.0 * MOVE * p.prior.sd if p.prior else 0.1 * MOVE * min(p.upper - p.lower, 50.0)
        for p, log in zip(chosen, logs, strict=True)
    ]
    return Frame(place, logs, np.array(lower), np.array(upper), np.array(move))


def estimate_at(
    simulator: Simulator, errors: Mapping[str, Instants], theta: np.ndarray,
    linear: frozenset[str] = frozenset(), variances: Mapping[str, np.ndarray] | None = None,
    plain: bool = False,
) -> Calibration:  # fmt: skip
    """The estimate at given parameters, its variances maximised unless they are given."""
    simulated = {q: simulator.simulated(theta[:, None], q)[:, 0] for q in errors}
    made = Calibration(simulator, errors, theta, variances or {}, simulated, linear, plain)
    return made if variances else with_variances(made)


def with_variances(one: Calibration, block: Sequence[str] | None = None) -> Calibration:
    """The estimate with the variances of some quantities (all) at their maximum."""
    found = dict(one.variances)
    for q in one.quantities if block is None else block:
        residual = one.residual(q)
        if one.plain:
            found[q] = np.zeros(VARIANCES)
            found[q][0] = max(float(np.nanmean(residual**2)), 1e-12)
        else:
            start = one.variances.get(q)
            found[q] = maximised(one.errors[q], residual, start)
    return replace(one, variances=found)


Columns = Mapping[str, Mapping[str, np.ndarray]]
"""Slopes (T,) by quantity and parameter."""


def fitted(
    one: Calibration,
    free: Collection[str] | None = None,
    effort: tuple[int, float] = POLISH,
    kept: Columns | None = None,
) -> Calibration:
    """The estimate with the free parameters (all) and the variances at their maximum.

    Quantities that share no parameter are fitted one after the other.  kept: slopes of a point nearby that
    serve for all steps.
    """
    names = set(one.simulator.names) if free is None else set(free)
    for block in _blocks(one, names):
        rounds, tolerance = effort
        for _ in range(rounds):
            before = sum(one.deviances[q] for q in block)
            one = with_variances(_stepped(one, names, block, kept or {}), block)
            if not sum(one.deviances[q] for q in block) < before - tolerance:
                break
    return one


def acting(one: Calibration, quantities: Collection[str]) -> list[str]:
    """The parameters that act on some quantities."""
    return [name for name in one.simulator.names if set(one.simulator.affects(name)) & set(quantities)]


def _blocks(one: Calibration, free: set[str]) -> list[tuple[str, ...]]:
    """The quantities that free parameters act on, together where one acts on several."""
    acting = [set(one.simulator.affects(name)) & set(one.quantities) for name in free]
    if any(len(group) > 1 for group in acting):
        return [one.quantities]
    return [(q,) for q in one.quantities if {q} in acting]


def _stepped(one: Calibration, free: set[str], block: tuple[str, ...], kept: Columns) -> Calibration:
    """Up to `STEPS` Gauss–Newton steps under fixed variances."""
    mine = {name for name in free if set(one.simulator.affects(name)) & set(block)}
    for _ in range(STEPS):
        f = frame(one.simulator.parameters, mine, one.linear)
        matrix, gradient = _normal_equations(one, f, block, kept)
        z = f.coordinates(one.theta)
        steps = [_step(matrix, gradient, z, f, damping) for damping in DAMPINGS]
        moved = np.column_stack([f.theta(one.theta, np.clip(z + s, f.lower, f.upper)) for s in steps])
        deviance, runs = _trials(one, moved, block)
        best = int(np.argmin(deviance))
        gained = sum(one.deviances[q] for q in block) - deviance[best]
        if not gained > 0.0:
            break
        simulated = {q: y[:, best] for q, y in runs.items()}
        one = replace(one, theta=moved[:, best].copy(), simulated={**one.simulated, **simulated})
        if gained < 0.1:
            break
    return one


def _trials(
    one: Calibration, theta: np.ndarray, block: Sequence[str]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """−2 ln L (n,), infinite where they diverge, and readings (T, n) of runs with parameters (P, n) under the
    estimate's variances."""
    total = np.zeros(theta.shape[1])
    simulated = {}
    for q in block:
        known, r = one.filtered[q], one.simulator.scene.readings[q]
        with np.errstate(over="ignore", invalid="ignore"):
            y = simulated[q] = one.simulator.simulated(theta, q)
            e = known.whitened(np.where(r.identified[:, None], r.value[:, None] - y, np.nan))
            total += loss(e, known.bound).sum(axis=0) + float(
                np.log(known.variance[np.isfinite(known.innovation)]).sum()
            )
        for i, p in enumerate(one.simulator.parameters):
            if p.prior is not None and q in one.simulator.affects(p.name):
                total += np.array([_prior_term(p, x) for x in theta[i]])
    return np.where(np.isfinite(total), total, math.inf), simulated


def slopes(
    one: Calibration, f: Frame, block: Sequence[str] | None = None, kept: Columns | None = None
) -> dict[str, np.ndarray]:
    """(T, d) slopes of the simulated readings in the coordinates, by quantity (all); those that are `kept`
    are not run again."""
    block = one.quantities if block is None else block
    z = f.coordinates(one.theta)
    names = [one.simulator.names[i] for i in f.place]
    found = {q: np.zeros((len(one.simulated[q]), len(z))) for q in block}
    for q in block:
        known = (kept or {}).get(q, {})
        for i, name in enumerate(names):
            if name in known:
                found[q][:, i] = known[name]
        there = [i for i, n in enumerate(names) if n not in known and q in one.simulator.affects(n)]
        if not there:
            continue
        move = np.where(z + f.move > f.upper, -f.move, f.move)
        moved = [f.theta(one.theta, z + move * (np.arange(len(z)) == i)) for i in there]
        y = one.simulator.simulated(np.column_stack(moved), q)
        found[q][:, there] = (y - one.simulated[q][:, None]) / move[there]
    return found


def weighted(one: Calibration, quantity: str, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whitened columns (T, c) and errors (T,), both times the roots of the readings' weights."""
    known = one.filtered[quantity]
    root = np.sqrt(known.weight)
    with np.errstate(invalid="ignore", over="ignore"):
        white = known.whitened(np.nan_to_num(columns)) * root[:, None]
    return white, np.nan_to_num(known.standardised) * root


def _normal_equations(
    one: Calibration, f: Frame, block: Sequence[str], kept: Columns
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss–Newton matrix (d, d) and gradient (d,) of half of −2 ln L."""
    d = len(f.place)
    matrix, gradient = np.zeros((d, d)), np.zeros(d)
    for q, columns in slopes(one, f, block, kept).items():
        known = one.filtered[q]
        there = np.flatnonzero(columns.any(axis=0))
        white = known.whitened(columns[:, there])
        e, w = np.nan_to_num(known.standardised), known.weight
        matrix[np.ix_(there, there)] += white.T @ (white * w[:, None])
        gradient[there] -= white.T @ (w * e)
    information, slope = of_priors(one, f)
    matrix += np.diag(information)
    gradient -= slope
    return matrix, gradient


def of_priors(one: Calibration, f: Frame) -> tuple[np.ndarray, np.ndarray]:
    """(d,) information of the priors in the coordinates, and slopes of their log densities."""
    information, slope = np.zeros((2, len(f.place)))
    for i, place in enumerate(f.place):
        prior, value = one.simulator.parameters[place].prior, float(one.theta[place])
        if prior is not None:
            unit = value if f.logarithmic[i] else 1.0
            information[i], slope[i] = (
                prior.information(value) * unit**2,
                prior.log_density_derivative(value) * unit,
            )
    return information, slope


def _step(matrix: np.ndarray, gradient: np.ndarray, z: np.ndarray, f: Frame, damping: float) -> np.ndarray:
    """A damped step; parameters at a limit that pull outward stay."""
    step = np.zeros(len(z))
    free = ~(((z <= f.lower) & (gradient > 0)) | ((z >= f.upper) & (gradient < 0))) & (np.diag(matrix) > 0)
    for _ in range(len(z) + 1):
        if not free.any():
            break
        scale = 1.0 / np.sqrt(np.diag(matrix)[free])
        scaled = matrix[np.ix_(free, free)] * scale[:, None] * scale + (damping + 1e-9) * np.eye(free.sum())
        step[:] = 0.0
        step[free] = -scale * np.linalg.solve(scaled, scale * gradient[free])
        # a step that meets a limit is taken again with that parameter held there
        beyond = free & (
            (z + step < f.lower) & (z <= f.lower + 1e-12) | (z + step > f.upper) & (z >= f.upper - 1e-12)
        )
        if not beyond.any():
            break
        free &= ~beyond
    reach = np.where(f.logarithmic, LARGEST_STEP, np.inf)
    return np.clip(step, -reach, reach)


def errors_of(simulator: Simulator, theta: np.ndarray, quantities: Sequence[str]) -> dict[str, Instants]:
    """The courses of the errors in a round: the low pass has the time constants of parameters (P,)."""
    values = dict(zip(simulator.names, theta.tolist(), strict=True))
    courses = {}
    for q in quantities:
        r = simulator.scene.readings[q]
        shape = (r.saturated / np.mean(r.saturated)) ** 2
        largest = max(float(np.nanvar(np.where(r.identified, r.value, np.nan))), 1e-9)
        courses[q] = course(r.time_h, values[TIME_CONSTANT[q]], r.added, shape, largest=largest)
    return courses
