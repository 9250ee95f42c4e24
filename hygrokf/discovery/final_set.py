"""The one set of parameters with which a model leaves the search, its covariance, and both in the form of a
`Fit`: for reports, climate, measures and the tracker.

A whitened likelihood sees the fast part of an error and judges levels badly; least squares of the free run
see the slow part and judge time constants badly where disturbances are slow.  Both are fitted to the first
two thirds of the identification period; the one whose free run predicts the last third better gives the set.
The filter that a file's other users run needs the sizes of its own disturbances beside; these maximise its
likelihood with everything else held.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hygrokf.data.clocks import shifted
from hygrokf.data.prepared import PreparedRecord, prepare
from hygrokf.data.progress import Progress
from hygrokf.data.record import Record
from hygrokf.data.timestamps import HOUR_S
from hygrokf.discovery.estimate import (
    POLISH,
    TIME_CONSTANT,
    Calibration,
    acting,
    errors_of,
    estimate_at,
    fitted,
    frame,
    of_priors,
    slopes,
    weighted,
    with_variances,
)
from hygrokf.discovery.judgement import levelled
from hygrokf.estimation.confidence import Uncertainty, wald_bounds
from hygrokf.estimation.likelihood import Likelihood, RatesFault
from hygrokf.estimation.moments import DigitsFault
from hygrokf.estimation.optimiser import Estimate, Objective, climb
from hygrokf.identification.estimation import LEVEL, TIME_CONSTANTS, Stage
from hygrokf.identification.fit import Fit
from hygrokf.identification.needed_inputs import CHANCE, WithoutInput, alternatives
from hygrokf.identification.procedure import Basis, assemble_fit
from hygrokf.identification.steady_state import heat_release_regression
from hygrokf.identification.verdict import with_reasons, with_verdicts
from hygrokf.modelling.design import CASCADE, TEMPERATURE, Design
from hygrokf.modelling.inputs import model_inputs
from hygrokf.physics.parameters import Coordinates
from hygrokf.texts.fit import FitCode
from hygrokf.texts.verdict import Reason

Estimator = Literal["likelihood", "output-error"]
BETTER = 0.95
"""Share of the likelihood's error below which the least free-run error is preferred."""
EARLY = 2.0 / 3.0
UNDETERMINED = 1e-10
"""Information of a coordinate, and share of the largest eigenvalue, below which a direction is not
determined."""


@dataclass(frozen=True)
class FinalSet:
    """An estimate with the estimator that made it, and the covariance (d, d) of its coordinates `names`
    (logarithms of positive parameters); at_bounds, flat: parameters that ended at a limit, and those that the
    readings do not determine."""

    estimate: Calibration
    estimator: Estimator
    names: tuple[str, ...]
    covariance: np.ndarray
    at_bounds: tuple[str, ...]
    flat: tuple[str, ...]

    def deviation(self, name: str) -> float:
        """Standard error of a parameter's coordinate, the logarithm where that is one."""
        i = self.names.index(name)
        return math.sqrt(max(self.covariance[i, i], 0.0))

    def bounds(self, name: str, quantile: float = 1.96) -> tuple[float, float]:
        """95 % bounds of a parameter, in its unit; open where it ended at a limit or is not determined."""
        p = self.estimate.simulator.parameters[self.estimate.simulator.names.index(name)]
        value, reach = self.estimate.values[name], quantile * self.deviation(name)
        logarithmic = p.positive and name not in self.estimate.linear
        if name in (*self.at_bounds, *self.flat) or not reach < 50.0 * (1.0 if logarithmic else math.inf):
            return (0.0 if logarithmic else -math.inf), math.inf
        if logarithmic:
            return value * math.exp(-reach), value * math.exp(reach)
        return value - reach, value + reach


def final_estimator(*models: Calibration) -> Estimator:
    """The estimator with which the models' free runs predict the last third of the identification period
    better."""
    ratios = []
    for one in models:
        early = _until(one, EARLY)
        by_likelihood, by_output = fitted_by(early, "likelihood"), fitted_by(early, "output-error")
        for q in one.quantities:
            r = one.simulator.scene.readings[q]
            late = r.identified & ~early.simulator.scene.readings[q].identified & np.isfinite(r.value)
            if late.sum() > 1:
                errors = [
                    max(float(np.mean((r.value - made.simulated[q])[late] ** 2)), 1e-12)
                    for made in (by_likelihood, by_output)
                ]
                ratios.append(0.5 * math.log(errors[1] / errors[0]))
    return "output-error" if ratios and math.exp(np.mean(ratios)) < BETTER else "likelihood"


def final_set(one: Calibration, estimator: Estimator) -> FinalSet:
    """The set of an estimator on the whole identification period, with the sandwich covariance by days."""
    made = fitted_by(one, estimator)
    names, covariance, flat = sandwich(
        with_variances(replace(made, plain=True)) if estimator == "output-error" else made
    )
    limits = {p.name: (p.lower, p.upper) for p in made.simulator.parameters}
    at = tuple(
        name for name in names
        if min(abs(made.values[name] - limit) for limit in limits[name]) <= 1e-6 * np.ptp(limits[name])
    )  # fmt: skip
    return FinalSet(made, estimator, names, covariance, at, flat)


def fitted_by(one: Calibration, estimator: Estimator, moved: Collection[str] | None = None) -> Calibration:
    """An estimator's parameters, in the quantities that moved (all)."""
    free = None if moved is None else acting(one, moved)
    if estimator == "likelihood":
        return levelled(fitted(one, free))
    plain = fitted(with_variances(replace(one, plain=True)), free, POLISH)
    return replace(estimate_at(plain.simulator, one.errors, plain.theta, one.linear), plain=False)


def _until(one: Calibration, share: float) -> Calibration:
    """The estimate whose identification period is an early share of its own."""
    scene, readings = one.simulator.scene, {}
    for q, r in one.simulator.scene.readings.items():
        known = r.time_s[r.identified]
        last = known[0] + share * (known[-1] - known[0])
        readings[q] = replace(r, identified=r.identified & (r.time_s <= last))
    simulator = replace(one.simulator, scene=replace(scene, readings=readings))
    return estimate_at(simulator, errors_of(simulator, one.theta, one.quantities), one.theta, one.linear)


def sandwich(one: Calibration) -> tuple[tuple[str, ...], np.ndarray, tuple[str, ...]]:
    """H⁻¹ J H⁻¹ in the coordinates of all parameters, and those that H does not determine: H the Gauss–Newton
    information with the priors', J the sum of squares of the days' scores and the priors' information."""
    f = frame(one.simulator.parameters, set(one.simulator.names), one.linear)
    names = tuple(one.simulator.names[i] for i in f.place)
    information, spread = np.zeros((2, len(names), len(names)))
    for q, columns in slopes(one, f).items():
        white, error = weighted(one, q, columns)
        daily = one.simulator.scene.readings[q].by_day(white * error[:, None])
        information += white.T @ white
        # neighbouring days of a slow disturbance are not independent
        spread += daily.T @ daily
        for lag in (1, 2):
            cross = (1.0 - lag / 3.0) * daily[lag:].T @ daily[:-lag]
            spread += cross + cross.T
    priors = np.diag(of_priors(one, f)[0])
    information += priors
    spread += priors
    told = np.diag(information) > UNDETERMINED
    scale = np.where(told, 1.0 / np.sqrt(np.where(told, np.diag(information), 1.0)), 0.0)
    size, axes = np.linalg.eigh(information * scale[:, None] * scale)
    seen = size > UNDETERMINED * size[-1]
    share = (axes[:, ~seen] ** 2).sum(axis=1)
    root = scale[:, None] * axes[:, seen] / size[seen]
    inverse = root @ (axes[:, seen] * scale[:, None]).T
    found = inverse @ spread @ inverse.T
    flat = tuple(n for n, s, d in zip(names, share, np.diag(found), strict=True) if s > 0.01 or not d > 0.0)
    return names, found, flat


SIZE_TOLERANCE = 0.05
"""Gain in ln L of a further step below which the sizes of the filter's disturbances are found."""
STEP_TOLERANCE = 1e-5
"""[1] `tolerance` of the filter's sub-steps: coarser ones change the disturbances' sizes alone."""


def fit_of(
    record: Record, final: FinalSet, say: Progress = lambda text: None, against: Sequence[Reason] = ()
) -> Fit:
    """A final set as a fit of the record, whose clocks are corrected as the set says.

    against: reasons against the hygric constant, beside the fit's own.
    Raises ValueError where the set is faster than a filter of the readings can follow.
    """
    record = shifted(record, *final.estimate.simulator.scene.shifts)
    early = prepare(record.identification())
    try:
        stages = tuple(_stage(early, one, final, say) for one in final_designs(final))
        basis = Basis(CASCADE, stages, heat_release_regression(early))
        fit = assemble_fit(record, basis, {}, say=say, tolerance=STEP_TOLERANCE)
    except (RatesFault, DigitsFault) as fault:
        raise ValueError(f"the model that the search ends with cannot be filtered: {fault}") from fault
    # offsets of clocks follow to first order from a maximum of the filter's likelihood, which this is not
    said = (*fit.results.statements, FitCode.CLOCKS_NOT_COUNTED())
    results = with_verdicts(replace(fit.results, criterion=final.estimator, statements=said))
    return replace(fit, results=with_reasons(results, "hygric", against))


def final_designs(final: FinalSet) -> tuple[Design, ...]:
    """The designs of a set, whose controllers have the levels that were estimated."""
    values, simulator = final.estimate.values, final.estimate.simulator
    found = []
    for one in simulator.designs:
        features = dict(one.features)
        for name in set(features) & set(simulator.controls):
            levels = {"start": values[f"{name}_first"], "full": values[f"{name}_second"]}
            features[name] = {**features[name], **levels}
        found.append(replace(one, features=features))
    return tuple(found)


def _stage(early: PreparedRecord, base: Design, final: FinalSet, say: Progress) -> Stage:
    """One likelihood at the set's values, with the set's covariance."""
    say("sizes of the disturbances")
    run = model_inputs(base, early)
    likelihood = Likelihood(base.model, run.timeline, tolerance=STEP_TOLERANCE)
    known = final.estimate.values
    held = {
        p.name: min(max(known[p.name], p.lower), p.upper) for p in base.model.parameters if p.name in known
    }
    noise = Coordinates(base.model.parameters, held)
    found = climb(Objective(likelihood, noise), noise.start(), tolerance=SIZE_TOLERANCE)
    values = {**noise.values(found.z)}
    coordinates = Coordinates(base.model.parameters, {n: values[n] for n in noise.names})
    estimate = Estimate(
        coordinates, coordinates.start(values), values, likelihood.value(values), found.objective,
        found.converged, found.end, tuple(n for n in final.at_bounds if n in held),
    )  # fmt: skip
    spread = _uncertainty(final, coordinates)
    bounds = {
        name: wald_bounds(estimate, spread, name, LEVEL)
        for name in TIME_CONSTANTS
        if name in coordinates.names
    }
    say("models without the input")
    stated = base.humidity is not None and early[base.humidity].response_time_s is not None
    without = {name: without_input(final.estimate, name) for name in bounds}
    return Stage(base, run, estimate, spread, bounds, response_stated=stated, without=without)


def without_input(one: Calibration, name: str) -> WithoutInput:
    """The best simulation in which the input of a time constant does not act, beside the model's own maximum
    of the likelihood."""
    from scipy.special import chdtri

    q = next(quantity for quantity, own in TIME_CONSTANT.items() if own == name)
    scene, simulator = one.simulator.scene, one.simulator
    time, vapour = scene.edges_s / HOUR_S, np.full(len(scene.edges_s), np.nan)
    if "vapour" in scene.readings:
        r = scene.readings["vapour"]
        vapour[np.clip(np.searchsorted(scene.edges_s, r.time_s), 0, len(time) - 1)] = r.value
    names = [n for n in simulator.cell_model(q).inputs if n != TEMPERATURE]
    inputs = {n: scene.at_edges(n, simulator.owner(n)) for n in names}
    free, found = acting(one, [q]), []
    own = fitted(one, free)
    required = float(chdtri(len(free), CHANCE))
    for code, moved, fixed in alternatives(name, inputs, time, scene.drive, vapour):
        still = scene.with_inputs([(n, simulator.owner(n), value) for n, value in moved.items()])
        other = replace(simulator, scene=still, _cells={})
        theta = other.vector({**own.values, **fixed})
        # from the model's own error and from that of its time constant now: variances have several maxima
        for errors, variances in (
            (own.errors, own.variances),
            (errors_of(other, theta, one.quantities), None),
        ):
            begun = estimate_at(other, errors, theta, own.linear, variances)
            end = fitted(begun, [n for n in free if n not in fixed])
            found.append(WithoutInput(code(), float(end.deviances[q] - own.deviances[q]), required))
    return min(found, key=lambda other: other.gain)


def _uncertainty(final: FinalSet, coordinates: Coordinates) -> Uncertainty:
    """The covariance of a stage's parameters; logarithms where the coordinate is one."""
    open_ = (*final.at_bounds, *final.flat)
    names = tuple(n for n in coordinates.names if n in final.names and n not in open_)
    place = [final.names.index(n) for n in names]
    values: Mapping[str, float] = final.estimate.values
    linear = final.estimate.linear
    as_logarithm = [coordinates.parameter(n).positive and n in linear for n in names]
    scale = np.array(
        [1.0 / max(values[n], 1e-300) if log else 1.0 for n, log in zip(names, as_logarithm, strict=True)]
    )
    covariance = final.covariance[np.ix_(place, place)] * np.outer(scale, scale)
    information = np.linalg.pinv(covariance)
    factor = np.ones(len(names))
    return Uncertainty(names, covariance, covariance, factor, final.flat, (), information)
