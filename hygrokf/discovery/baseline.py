"""What all candidates of causes share: a record, its two likelihoods at their maxima, and their errors day by
day.

The two parts of the cascade are tried by themselves: "thermal" on the cabinet temperature, "hygric" on the
humidity with the smoothed temperature as its input.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hygrokf.data.record import Record
from hygrokf.discovery.budget import Budget
from hygrokf.discovery.discovery_results import Settings
from hygrokf.engine.timeline import Timeline
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Objective, climb
from hygrokf.evaluation.self_switching import self_switched, switches_of
from hygrokf.identification.estimation import (
    DesignEstimate,
    Progress,
    estimate_design,
    select_form,
    smoothed_temperature,
)
from hygrokf.identification.steady_state import heat_release_regression
from hygrokf.modelling.design import CASCADE, Design, design, extended
from hygrokf.modelling.inputs import Run, prepare_run
from hygrokf.physics.model import Model
from hygrokf.physics.parameters import Coordinates
from hygrokf.physics.psychrometrics import absolute_humidity

THERMAL = "thermal"
HYGRIC = "hygric"
DAY_H = 24.0
SEARCH_STEP = 2.0
"""Product of rate and sub-step in candidates: ln L is right to a few thousandths, at a quarter of
the time."""
SIMULATION_STEP = 1.0
"""The same for simulations over the whole record: without readings, coarser steps can leave a variance below
zero."""
SURE = 1.96
"""[sd] a sensor's offset in a free run: within the accuracy that 95 % of such sensors keep."""
REACH = 1.5
"""Bound of one step toward the least free-run error, in a parameter's coordinate."""
SCOUTED = 4
"""Starts that are followed for a few passes: of more, those with the largest likelihood as they stand."""
WANDERS_H = 24.0
"""[h] memory from which a disturbance may stand for what lasts."""
HOPE = 0.3
"""ln L that a mechanism's own parameters must gain by themselves for all parameters to be estimated with
it."""


@dataclass(frozen=True)
class Part:
    """One likelihood of a baseline at its maximum: `objective` ln L + ln prior, `values` of its parameters, n
    readings.

    `error` (T,) reading − free run in K or g/m³ at the run's instants, NaN where there is none or it is not
    scored.
    """

    name: str
    record: Record
    base: Design
    run: Run
    values: Mapping[str, float]
    objective: float
    converged: bool
    error: np.ndarray

    @property
    def n(self) -> int:
        return self.run.timeline.n_readings

    @property
    def parameters(self) -> int:
        return len(self.base.model.parameters)

    @property
    def time_s(self) -> np.ndarray:
        t = self.run.timeline
        return t.origin_s + 3600.0 * t.time


@dataclass(frozen=True)
class Baseline:
    """The identification period of a record, the parts that were identified on it, and the time that
    candidates
    on it may take: where it is over, what estimates a candidate raises BudgetSpent.
    """

    record: Record
    parts: Mapping[str, Part]
    budget: Budget = field(default_factory=Budget)

    @cached_property
    def tempers(self) -> dict[str, float]:
        """Part → `temper` of it."""
        return {name: temper(part) for name, part in self.parts.items()}


def temper(part: Part) -> float:
    """Factor c ≥ 1 by which 2 ln L of a part is too large, because the model is not quite right: tr(H⁻¹ J)/d.

    H (d, d) the information of its parameters, J the sum of g g' over the days' scores g: both are one where
    the model is right.  Where something is missing that lasts for hours the scores of a day have one sign,
    and J grows.

    Source: Takeuchi 1976 (the trace); the sandwich of White 1982, doi:10.2307/1912526.
    """
    coordinates = Coordinates(part.base.model.parameters)
    objective = Objective(searching(part.base.model, part.run.timeline), coordinates)
    _, _, information, scores = objective.information_and_scores(coordinates.start(part.values))
    daily = np.zeros((int(days(part).max()) + 1, scores.shape[1]))
    np.add.at(daily, days(part), scores)
    found = float(np.trace(np.linalg.pinv(information, rcond=1e-10) @ (daily.T @ daily)))
    return max(1.0, found / scores.shape[1]) if math.isfinite(found) else 1.0


def baseline(record: Record, starts: int = 2, say: Progress = lambda text: None) -> Baseline:
    """Identify the base model on the identification period of a record."""
    early = record.identification()
    regression = heat_release_regression(early)
    order = 2
    if regression.operation is not None and regression.operation.coefficients:
        order = max(2, regression.operation.order)
    parts: dict[str, Part] = {}
    thermal = design(early, kind=THERMAL, power_order=order, heat_start=regression.start())
    parts[THERMAL] = part_of(THERMAL, early, _best(early, thermal, starts, say))
    base = design(early, kind=CASCADE)
    if base.humidity is not None:
        say("smoothed cabinet temperature")
        driven = _driven(parts[THERMAL], early, base.humidity)
        parts[HYGRIC] = part_of(HYGRIC, driven, _best(driven, base, starts, say))
    return Baseline(early, parts)


def _best(early: Record, base: Design, starts: int, say: Progress) -> DesignEstimate:
    """A design's estimate in the form that the record calls for."""
    return select_form(early, estimate_design(early, base, starts, say), say)[0]


def redriven(baseline: Baseline) -> Baseline:
    """The baseline with its hygric part on the temperature that its thermal part smooths now, estimated
    again.

    Whoever simulates the temperature better knows it better between the readings too: a heater's cycles that
    the base smoothed away are errors of the humidity's saturation.  As it is where that does not gain.
    """
    part = baseline.parts.get(HYGRIC)
    if part is None or part.base.humidity is None:
        return baseline
    record = _driven(baseline.parts[THERMAL], part.record, part.base.humidity)
    part = climbed(replace(part, record=record, run=prepare_run(part.base, record)))
    if part.objective <= baseline.parts[HYGRIC].objective:
        return baseline
    return replace(baseline, parts={**baseline.parts, HYGRIC: part})


def _driven(thermal: Part, record: Record, humidity: str) -> Record:
    """A record with the cabinet temperature that a thermal part smooths from its own readings."""
    smoothed = smoothed_temperature(thermal.base, thermal.run, thermal.values, thermal.record, humidity)
    return record.replace_series(smoothed)


def part_of(name: str, record: Record, found: DesignEstimate) -> Part:
    estimate = found.estimate
    return _part(name, record, found.base, found.run, estimate.values, estimate.objective, estimate.converged)


def searching(model: Model, timeline: Timeline) -> Likelihood:
    """The likelihood that candidates use."""
    return Likelihood(model, timeline, rate_step=SEARCH_STEP)


class _Timed(Objective):
    """An objective that is not evaluated any more where the time for candidates is over."""

    def __init__(self, likelihood: Likelihood, coordinates: Coordinates, budget: Budget) -> None:
        super().__init__(likelihood, coordinates)
        self._budget = budget

    def value(self, z: np.ndarray) -> float:
        self._budget.check()
        return super().value(z)

    def information(self, z: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        self._budget.check()
        return super().information(z)


def refitted(
    part: Part,
    additions: Sequence[tuple[str, Settings]],
    features: Mapping[str, Settings],
    starts: Sequence[Mapping[str, float]],
    record: Record | None = None,
    budget: Budget | None = None,
) -> Part:
    """The part with further mechanisms, all its parameters estimated again, the noise's too; the best of
    several starts."""
    wider = extended(part.base, additions, features=features)
    record = part.record if record is None else record
    made = prepare_run(wider, record)
    likelihood = searching(wider.model, made.timeline)
    coordinates = Coordinates(wider.model.parameters)
    budget = budget or Budget()
    objective = _Timed(likelihood, coordinates, budget)
    given = {p.name: p.start for p in wider.model.parameters} | dict(part.values)
    first, hopeful = [{**given, **start} for start in starts or ({},)], True
    if len(first) > SCOUTED:
        offsets = {p.name: p.prior.mean for p in wider.model.parameters if p.prior is not None}
        first.sort(key=lambda at: -objective.value(coordinates.start({**at, **offsets})))
        first = first[:SCOUTED]
    ordinary = disturbances(wider.model)
    if any(part.values.get(name, 0.0) > WANDERS_H for name in ordinary if name.endswith("_time")):
        # what wanders for days may have taken the place of what is tried: one start has ordinary disturbances
        first.append({**first[0], **ordinary})
    if len(first) > 1:
        # the mechanisms' own parameters alone, a few passes: what is far behind then is not followed
        reached, best_start = max(
            (_scouted(likelihood, part, at, budget) for at in first), key=lambda pair: pair[0]
        )
        first = [best_start]
        hopeful = reached > part.objective + HOPE
    best = climb(objective, coordinates.start(first[0]), passes=10 if hopeful else 2, tolerance=0.5)
    values = coordinates.values(best.z)
    return _part(part.name, record, wider, made, values, best.objective, best.converged)


def climbed(part: Part, budget: Budget | None = None) -> Part:
    """The part with its parameters climbed to the maximum."""
    coordinates = Coordinates(part.base.model.parameters)
    objective = _Timed(searching(part.base.model, part.run.timeline), coordinates, budget or Budget())
    best = climb(objective, coordinates.start(part.values), passes=40, tolerance=0.02)
    values = coordinates.values(best.z)
    return _part(part.name, part.record, part.base, part.run, values, best.objective, best.converged)


def disturbances(model: Model) -> dict[str, float]:
    """Sizes and memories of a model's disturbances as they are before anything was estimated."""
    return {p.name: p.start for p in model.parameters if p.noise and "_disturbance_" in p.name}


def _scouted(
    likelihood: Likelihood, part: Part, at: Mapping[str, float], budget: Budget
) -> tuple[float, dict[str, float]]:
    """(objective, values) after a few passes over the parameters that the part does not have, the
    disturbances' and the sensors' offsets.

    Offsets start from where the sensors' accuracy has them: the base may have stretched them to stand for
    what it lacks.
    """
    parameters = likelihood.model.parameters
    offsets = {p.name: p.prior.mean for p in parameters if p.prior is not None}
    free = {*offsets, *disturbances(likelihood.model)}
    held = {name: value for name, value in at.items() if name in part.values and name not in free}
    coordinates = Coordinates(parameters, held if len(held) < len(parameters) else {})
    objective = _Timed(likelihood, coordinates, budget)
    found = climb(objective, coordinates.start({**at, **offsets}), passes=5, tolerance=1.0)
    return found.objective, coordinates.values(found.z)


def _part(
    name: str,
    record: Record,
    base: Design,
    made: Run,
    values: Mapping[str, float],
    objective: float,
    converged: bool,
) -> Part:
    return Part(
        name, record, base, made, dict(values), objective, converged, free_run_error(base, made, values)
    )


def free_run_error(base: Design, made: Run, values: Mapping[str, float]) -> np.ndarray:
    """Reading − free run (T,): temperature [K]; humidity as absolute humidity [g/m³] at the measured
    temperature.

    Where innovations estimate a model that lacks something it is a poor simulator.  So the error is that of
    the better of two: of the estimate as it is, and after one Gauss–Newton step toward the least free-run
    error.  In both, sensors are no worse than their accuracy: a likelihood may stretch an offset to stand for
    something else.
    """
    there, error, better, _ = _toward_free_run(base, made, values)
    return better if np.nansum(better**2) < np.nansum(error[there] ** 2) else np.where(there, error, np.nan)


def simulating(part: Part, steps: int = 3) -> dict[str, float]:
    """Values of a part's parameters after steps toward the least free-run error, sensors within their
    accuracy.

    Switches drive themselves in it.  A step of first order knows nothing of when they would switch then, so
    it is begun from the estimate, and from where steps with the switches' course by readings lead.
    """
    readings = _descended(part, part.values, steps, own=False)
    if not switches_of(part.base):
        return readings.values
    starts = (part.values, readings.values)
    return min((_descended(part, one, steps, own=True) for one in starts), key=lambda one: one.square).values


def self_driven(part: Part) -> Part:
    """The part with the free-run error (T,) of a simulation that drives its own switches; as it is where it
    has none."""
    if not switches_of(part.base):
        return part
    starts = (part.values, _descended(part, part.values, 1, own=False).values)
    best = min((_descended(part, one, 0, own=True) for one in starts), key=lambda one: one.square)
    further = _descended(part, best.stepped, 0, own=True)
    return replace(part, error=min((best, further), key=lambda one: one.square).error)


@dataclass(frozen=True)
class _Descent:
    """Where steps toward the least free-run error led: squared error, values, error (T,), and what comes
    next."""

    square: float
    values: dict[str, float]
    error: np.ndarray
    stepped: dict[str, float]


def _descended(part: Part, values: Mapping[str, float], steps: int, own: bool) -> _Descent:
    """The best of some steps; `own`: switches drive themselves."""
    values, best = dict(values), None
    for _ in range(steps + 1):
        made = self_switched(part.base, values, [part.run])[0] if own else part.run
        there, error, _, stepped = _toward_free_run(part.base, made, values)
        square = float(np.nansum(error[there] ** 2))
        if best is not None and not square < best.square:
            break
        best = _Descent(square, values, np.where(there, error, np.nan), stepped)
        values = stepped
    assert best is not None
    return best


def _toward_free_run(
    base: Design, made: Run, values: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, float]]:
    """(scored (T,), error (T,), error after one bounded Gauss–Newton step to first order (T,), values after
    the step)."""
    model, t = base.model, made.timeline
    likelihood = searching(model, t)
    own = [i for i, p in enumerate(model.parameters) if not p.noise]
    held, units = dict(values), np.ones(len(own))
    directions = np.zeros((len(model.parameters), len(own)))
    low, high = np.full(len(own), -REACH), np.full(len(own), REACH)
    for column, i in enumerate(own):
        p = model.parameters[i]
        unit = p.slope(values[p.name])
        if p.prior is not None:
            unit = p.prior.sd
            held[p.name] = float(
                np.clip(values[p.name], p.prior.mean - SURE * unit, p.prior.mean + SURE * unit)
            )
            off = (held[p.name] - p.prior.mean) / unit
            low[column], high[column] = -SURE - off - 1e-9, SURE - off + 1e-9
            units[column] = unit
        directions[i, column] = unit
    error, slopes = likelihood.residuals(held, directions)
    error, slopes = error[:, 0], slopes[:, 0, :]
    if t.outputs[0] == "cabinet_relative_humidity":
        weight = 1e3 * absolute_humidity(1.0, t.input("cabinet_temperature"))
        error, slopes = error * weight, slopes * weight[:, None]
    there = np.isfinite(error) & made.scored
    # a direction whose effect grows beyond all numbers is no direction for a step of first order
    x, e = np.where(np.isfinite(slopes[there]).all(axis=0), slopes[there], 0.0), error[there]
    if not len(e):
        return there, error, np.full(len(error), np.nan), held
    # a step of one in a coordinate (or a prior's standard deviation) costs as much as a day of errors
    ridge = 96.0 * float(np.mean(e**2))
    turned, root = np.linalg.qr(np.vstack([x, np.sqrt(ridge) * np.eye(x.shape[1])]))
    step = bounded_least_squares(root, -turned[: len(e)].T @ e, low, high)
    stepped = dict(held)
    for column, i in enumerate(own):
        p = model.parameters[i]
        z = p.to_coordinate(held[p.name]) + step[column] * units[column]
        stepped[p.name] = float(np.clip(p.from_coordinate(z), p.lower, p.upper))
    after = np.full(len(error), np.nan)
    after[there] = e + x @ step
    return there, error, after, stepped


def bounded_least_squares(
    matrix: np.ndarray, target: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """x (d,) of the least |matrix x − target| within bounds (d,)."""
    from scipy.optimize import lsq_linear

    return lsq_linear(matrix, target, bounds=(low, high)).x


def days(part: Part) -> np.ndarray:
    """Number (T,) of the day of each instant."""
    return np.floor(part.run.timeline.time / DAY_H).astype(int)


def rmse(part: Part) -> float:
    """Root mean squared free-run error [K], [g/m³]."""
    there = part.error[np.isfinite(part.error)]
    return float(np.sqrt(np.mean(there**2))) if len(there) else math.nan
