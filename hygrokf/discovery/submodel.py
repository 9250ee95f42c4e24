"""One submodel of a baseline at its maximum of the likelihood, and its free run.

Innovations estimate a poor simulator where a model lacks something, so the free run of a submodel is also
judged after bounded Gauss–Newton steps toward the least free-run error.

Shapes: T instants of a run, d parameters.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hygrokf.data.record import Record
from hygrokf.data.timestamps import HOUR_S
from hygrokf.discovery.residuals import NORMAL_95, root_mean_square
from hygrokf.engine.timeline import Timeline
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Objective
from hygrokf.evaluation.self_switching import self_switched, switches_of
from hygrokf.evaluation.simulation import settled
from hygrokf.identification.estimation import DesignEstimate, Stage
from hygrokf.modelling.design import Design
from hygrokf.modelling.inputs import Run
from hygrokf.physics.model import Model
from hygrokf.physics.parameters import Coordinates
from hygrokf.physics.psychrometrics import absolute_humidity

THERMAL = "thermal"
HYGRIC = "hygric"
SEARCH_STEP = 2.0
"""Product of rate and sub-step in candidates: ln L is right to a few thousandths, in a quarter of the
time."""
REACH = 1.5
"""Bound of one step toward the least free-run error, in a parameter's coordinate."""
STEPS = 3
"""Steps toward the least free-run error."""


@dataclass(frozen=True)
class Submodel:
    """One likelihood of a baseline at its maximum: "thermal", of the cabinet temperature, or "hygric", of the
    humidity with the smoothed temperature as its input.

    objective: ln L + ln prior.  values: of its parameters.
    """

    name: str
    record: Record
    base: Design
    run: Run
    values: Mapping[str, float]
    objective: float
    converged: bool

    @cached_property
    def error(self) -> np.ndarray:
        """Reading − free run (T,) [K], [g/m³]; NaN without a reading and where the instant is not scored."""
        return free_run_error(self.base, self.run, self.values)

    @property
    def n(self) -> int:
        """Number of readings."""
        return self.run.timeline.n_readings

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return len(self.base.model.parameters)

    @property
    def likelihood(self) -> Likelihood:
        return search_likelihood(self.base.model, self.run.timeline)

    @property
    def time_s(self) -> np.ndarray:
        """Instants (T,) [s] since 1970-01-01T00:00Z."""
        return seconds(self.run.timeline)

    @property
    def days(self) -> np.ndarray:
        """Number (T,) of the day of each instant."""
        return np.floor(self.run.timeline.time / 24.0).astype(int)


def submodel_of(name: str, record: Record, found: DesignEstimate | Stage) -> Submodel:
    """A stage of an identification as a submodel."""
    made = found.estimate
    return Submodel(name, record, found.base, found.run, made.values, made.objective, made.converged)


def search_likelihood(model: Model, timeline: Timeline) -> Likelihood:
    """The likelihood that candidates use."""
    return Likelihood(model, timeline, rate_step=SEARCH_STEP)


def seconds(timeline: Timeline) -> np.ndarray:
    """Instants (T,) [s] of a run since 1970-01-01T00:00Z."""
    return timeline.origin_s + HOUR_S * timeline.time


def rmse(submodel: Submodel) -> float:
    """Root mean squared free-run error [K], [g/m³]."""
    return root_mean_square(submodel.error)


def temper(submodel: Submodel) -> float:
    """Factor c ≥ 1 by which 2 ln L of a submodel is too large because the model is misspecified: tr(H⁻¹ J)/d.

    H (d, d) is the information of its parameters, J the sum of g g' over the days' scores g.  The ratio is 1
    where the model is right.  Where an effect that lasts for hours is missing, the scores of a day have one
    sign and J grows.

    Source: Takeuchi 1976 (the trace); the sandwich of White 1982, doi:10.2307/1912526.
    """
    coordinates = Coordinates(submodel.base.model.parameters)
    objective = Objective(submodel.likelihood, coordinates)
    _, _, information, scores = objective.information_and_scores(coordinates.start(submodel.values))
    daily = np.zeros((int(submodel.days.max()) + 1, scores.shape[1]))
    np.add.at(daily, submodel.days, scores)
    found = float(np.trace(np.linalg.pinv(information, rcond=1e-10) @ (daily.T @ daily)))
    return max(1.0, found / scores.shape[1]) if math.isfinite(found) else 1.0


# -- the free run --------------------------------------------------------------------------------------------
def free_run_error(base: Design, run: Run, values: Mapping[str, float]) -> np.ndarray:
    """Reading − free run (T,): temperature [K]; humidity as absolute humidity [g/m³] at the measured
    temperature.

    The smaller of two errors: that of the values, and the one predicted after one Gauss–Newton step toward
    the least free-run error.  In both, a sensor's offset stays within its accuracy, because a likelihood may
    stretch it to stand for something else.
    """
    found = _free_run(base, run, values)
    return found.predicted if np.nansum(found.predicted**2) < found.square else found.error


def simulation_values(submodel: Submodel) -> dict[str, float]:
    """Values of a submodel's parameters after `STEPS` steps toward the least free-run error, sensors within
    their accuracy.

    Switches follow the simulation.  A first-order step does not know when they will switch then, so the steps
    begin both at the estimate and where steps with switches that follow the readings lead.
    """
    by_readings = _descended(submodel, submodel.values, STEPS, own=False)
    if not switches_of(submodel.base):
        return by_readings.values
    starts = (submodel.values, by_readings.values)
    return _best(_descended(submodel, start, STEPS, own=True) for start in starts).values


def self_driven_error(submodel: Submodel) -> np.ndarray:
    """The error (T,) of a free run in which the submodel's switches follow the simulation."""
    if not switches_of(submodel.base):
        return submodel.error
    starts = (submodel.values, _descended(submodel, submodel.values, 1, own=False).values)
    best = _best(_descended(submodel, start, 0, own=True) for start in starts)
    return _best((best, _descended(submodel, best.stepped, 0, own=True))).error


@dataclass(frozen=True)
class _FreeRun:
    """A free run at `values`: its error (T,), NaN where it is not scored, and the sum of squares; and after
    one bounded Gauss–Newton step: the `stepped` values, and the error (T,) `predicted` to first order."""

    values: dict[str, float]
    error: np.ndarray
    square: float
    stepped: dict[str, float]
    predicted: np.ndarray


def _best(runs: Iterable[_FreeRun]) -> _FreeRun:
    return min(runs, key=lambda run: run.square)


def _descended(submodel: Submodel, values: Mapping[str, float], steps: int, own: bool) -> _FreeRun:
    """The best of some steps; `own`: switches follow the simulation."""
    best, known = None, settled(submodel.base, submodel.values, submodel.run)
    for _ in range(steps + 1):
        run = self_switched(submodel.base, values, [known])[0] if own else known
        found = _free_run(submodel.base, run, values)
        if best is not None and not found.square < best.square:
            break
        best, values = found, found.stepped
    assert best is not None
    return best


def _free_run(base: Design, run: Run, values: Mapping[str, float]) -> _FreeRun:
    model, t = base.model, run.timeline
    likelihood = search_likelihood(model, t)
    own = [i for i, p in enumerate(model.parameters) if not p.noise]
    held, units = dict(values), np.ones(len(own))
    directions = np.zeros((len(model.parameters), len(own)))
    low, high = np.full(len(own), -REACH), np.full(len(own), REACH)
    for column, i in enumerate(own):
        p = model.parameters[i]
        unit = p.slope(values[p.name])
        if p.prior is not None:
            unit = units[column] = p.prior.sd
            reach = NORMAL_95 * unit
            held[p.name] = float(np.clip(values[p.name], p.prior.mean - reach, p.prior.mean + reach))
            off = (held[p.name] - p.prior.mean) / unit
            low[column], high[column] = -NORMAL_95 - off - 1e-9, NORMAL_95 - off + 1e-9
        directions[i, column] = unit
    error, slopes = likelihood.residuals(held, directions)
    error, slopes = error[:, 0], slopes[:, 0, :]
    if t.outputs[0] == "cabinet_relative_humidity":
        weight = 1e3 * absolute_humidity(1.0, t.input("cabinet_temperature"))
        error, slopes = error * weight, slopes * weight[:, None]
    there = np.isfinite(error) & run.scored
    scored, predicted = np.where(there, error, np.nan), np.full(len(error), np.nan)
    # a direction along which the free run diverges is none for a first-order step
    x, e = np.where(np.isfinite(slopes[there]).all(axis=0), slopes[there], 0.0), error[there]
    if not len(e):
        return _FreeRun(dict(values), scored, 0.0, held, predicted)
    # a step of one in a coordinate (or a prior's standard deviation) costs as much as a day of errors
    ridge = 96.0 * float(np.mean(e**2))
    turned, root = np.linalg.qr(np.vstack([x, np.sqrt(ridge) * np.eye(x.shape[1])]))
    step = _bounded_least_squares(root, -turned[: len(e)].T @ e, low, high)
    stepped = dict(held)
    for column, i in enumerate(own):
        p = model.parameters[i]
        z = p.to_coordinate(held[p.name]) + step[column] * units[column]
        stepped[p.name] = float(np.clip(p.from_coordinate(z), p.lower, p.upper))
    predicted[there] = e + x @ step
    return _FreeRun(dict(values), scored, float(np.nansum(e**2)), stepped, predicted)


def _bounded_least_squares(
    matrix: np.ndarray, target: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """x (d,) of the least |matrix x − target| within bounds (d,)."""
    from scipy.optimize import lsq_linear

    return lsq_linear(matrix, target, bounds=(low, high)).x
