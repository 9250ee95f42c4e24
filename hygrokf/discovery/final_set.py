"""The final parameters of a model after the search with their covariance, also as a `Fit` for reports,
climate, measures and the tracker.

The likelihood of whitened errors rests on their fast part and estimates levels badly.  Least squares of the
free run rest on the slow part and estimate time constants badly where disturbances are slow.  Both estimators
are fitted to the first two thirds of the identification period; the estimator whose free run predicts the
last third better gives the final set.  The Kalman filter of a `Fit` also needs the sizes of its disturbances,
which maximise its likelihood with all other parameters fixed.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hygrokf.data.prepared import PreparedRecord, prepare
from hygrokf.data.progress import Progress
from hygrokf.data.record import Record
from hygrokf.data.shared_clocks import shifted
from hygrokf.data.timestamps import HOUR_S
from hygrokf.discovery.estimate import (
    POLISH,
    TIME_CONSTANT_OF,
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
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.estimation.likelihood import Likelihood, RatesFault
from hygrokf.estimation.moments import DigitsFault
from hygrokf.estimation.optimiser import Estimate, Objective, climb
from hygrokf.identification.estimation import Stage
from hygrokf.identification.fit import Fit
from hygrokf.identification.identify import Basis, assemble_fit
from hygrokf.identification.needed_inputs import CHANCE, WithoutInput, alternatives
from hygrokf.identification.steady_state import heat_release_regression
from hygrokf.identification.verdict import with_reasons, with_verdicts
from hygrokf.modelling.design import CASCADE, Design
from hygrokf.modelling.inputs import model_inputs
from hygrokf.physics.parameters import Coordinates
from hygrokf.physics.signal_names import CABINET_TEMPERATURE
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.parts import TIME_CONSTANTS
from hygrokf.texts.reasons import Reason

Estimator = Literal["likelihood", "output-error"]
BETTER_RATIO = 0.95
"""Ratio of the errors of least squares and likelihood below which least squares are preferred."""
EARLY = 2.0 / 3.0
"""Share of the identification period to which both estimators are fitted for their comparison."""
UNDETERMINED = 1e-10
"""Information of a coordinate, and eigenvalue as a share of the largest, up to which a direction is not
determined."""


@dataclass(frozen=True)
class FinalSet:
    """An estimate with its estimator and the covariance (d, d) of its coordinates `names` (logarithms of
    positive parameters); at_bounds: parameters that ended at a limit; flat: parameters that the readings do
    not determine."""

    estimate: Calibration
    estimator: Estimator
    names: tuple[str, ...]
    covariance: np.ndarray
    at_bounds: tuple[str, ...]
    flat: tuple[str, ...]

    def deviation(self, name: str) -> float:
        """Standard error of a parameter's coordinate (of the logarithm if that is the coordinate)."""
        i = self.names.index(name)
        return math.sqrt(max(self.covariance[i, i], 0.0))

    def bounds(self, name: str, quantile: float = 1.96) -> tuple[float, float]:
        """95 % bounds of a parameter, in its unit; open if the parameter ended at a limit or is not
        determined."""
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
    for model in models:
        early = _until(model, EARLY)
        by_likelihood, by_output = fitted_by(early, "likelihood"), fitted_by(early, "output-error")
        for q in model.quantities:
            r = model.simulator.scene.readings[q]
            late = r.identified & ~early.simulator.scene.readings[q].identified & np.isfinite(r.value)
            if late.sum() > 1:
                errors = [
                    max(float(np.mean((r.value - fit.simulated[q])[late] ** 2)), 1e-12)
                    for fit in (by_likelihood, by_output)
                ]
                ratios.append(0.5 * math.log(errors[1] / errors[0]))
    return "output-error" if ratios and math.exp(np.mean(ratios)) < BETTER_RATIO else "likelihood"


def final_set(estimate: Calibration, estimator: Estimator) -> FinalSet:
    """The final set of an estimator on the entire identification period, with the sandwich covariance by
    days."""
    fit = fitted_by(estimate, estimator)
    names, covariance, flat = sandwich(
        with_variances(replace(fit, plain=True)) if estimator == "output-error" else fit
    )
    limits = {p.name: (p.lower, p.upper) for p in fit.simulator.parameters}
    at_limits = tuple(
        name for name in names
        if min(abs(fit.values[name] - limit) for limit in limits[name]) <= 1e-6 * np.ptp(limits[name])
    )  # fmt: skip
    return FinalSet(fit, estimator, names, covariance, at_limits, flat)


def fitted_by(
    estimate: Calibration, estimator: Estimator, quantities: Collection[str] | None = None
) -> Calibration:
    """The estimate refitted by an estimator in the parameters that act on the quantities (None: all)."""
    free = None if quantities is None else acting(estimate, quantities)
    if estimator == "likelihood":
        return levelled(fitted(estimate, free))
    plain = fitted(with_variances(replace(estimate, plain=True)), free, POLISH)
    return replace(estimate_at(plain.simulator, estimate.errors, plain.theta, estimate.linear), plain=False)


def _until(estimate: Calibration, share: float) -> Calibration:
    """The estimate on the first `share` of its identification period."""
    scene, readings = estimate.simulator.scene, {}
    for q, r in estimate.simulator.scene.readings.items():
        identified_s = r.time_s[r.identified]
        last = identified_s[0] + share * (identified_s[-1] - identified_s[0])
        readings[q] = replace(r, identified=r.identified & (r.time_s <= last))
    simulator = replace(estimate.simulator, scene=replace(scene, readings=readings))
    return estimate_at(
        simulator, errors_of(simulator, estimate.theta, estimate.quantities), estimate.theta, estimate.linear
    )


def sandwich(estimate: Calibration) -> tuple[tuple[str, ...], np.ndarray, tuple[str, ...]]:
    """Names, covariance H⁻¹ J H⁻¹ in the coordinates of all parameters, and the parameters that H does not
    determine.

    H is the Gauss–Newton information plus that of the priors; J the sum of squares of the daily scores, with
    those of neighbouring days, plus the information of the priors.
    """
    coordinates = frame(estimate.simulator.parameters, set(estimate.simulator.names), estimate.linear)
    names = tuple(estimate.simulator.names[i] for i in coordinates.place)
    information, spread = np.zeros((2, len(names), len(names)))
    for q, columns in slopes(estimate, coordinates).items():
        white, error = weighted(estimate, q, columns)
        daily = estimate.simulator.scene.readings[q].by_day(white * error[:, None])
        information += white.T @ white
        # neighbouring days of a slow disturbance are not independent
        spread += daily.T @ daily
        for lag in (1, 2):
            cross = (1.0 - lag / 3.0) * daily[lag:].T @ daily[:-lag]
            spread += cross + cross.T
    priors = np.diag(of_priors(estimate, coordinates)[0])
    information += priors
    spread += priors
    is_informed = np.diag(information) > UNDETERMINED
    scale = np.where(is_informed, 1.0 / np.sqrt(np.where(is_informed, np.diag(information), 1.0)), 0.0)
    eigenvalues, eigenvectors = np.linalg.eigh(information * scale[:, None] * scale)
    is_determined = eigenvalues > UNDETERMINED * eigenvalues[-1]
    undetermined_share = (eigenvectors[:, ~is_determined] ** 2).sum(axis=1)
    root = scale[:, None] * eigenvectors[:, is_determined] / eigenvalues[is_determined]
    inverse = root @ (eigenvectors[:, is_determined] * scale[:, None]).T
    covariance = inverse @ spread @ inverse.T
    flat = tuple(
        n
        for n, s, d in zip(names, undetermined_share, np.diag(covariance), strict=True)
        if s > 0.01 or not d > 0.0
    )
    return names, covariance, flat


SIZE_TOLERANCE = 0.05
"""Expected gain in ln L below which the search for the sizes of the filter's disturbances ends."""
FINAL_STEP_TOLERANCE = 1e-5
"""[1] `tolerance` of the filter's sub-steps: a coarser one changes only the sizes of the disturbances."""


def final_fit(
    record: Record, final: FinalSet, say: Progress = lambda text: None, against: Sequence[Reason] = ()
) -> Fit:
    """A final set as a fit of the record, with the record's clocks corrected by the shifts of the set.

    against: reasons against the hygric constant, beside the fit's own.
    Raises ValueError if the dynamics of the set are too fast for a filter of the readings.
    """
    record = shifted(record, *final.estimate.simulator.scene.shifts)
    early = prepare(record.identification())
    try:
        stages = tuple(_stage(early, design, final, say) for design in final_designs(final))
        basis = Basis(CASCADE, stages, heat_release_regression(early))
        fit = assemble_fit(record, basis, {}, say=say, tolerance=FINAL_STEP_TOLERANCE)
    except (RatesFault, DigitsFault) as fault:
        raise ValueError(f"the model that the search ends with cannot be filtered: {fault}") from fault
    # the linear estimate of clock offsets needs a maximum of the filter's likelihood, but this set is none
    statements = (*fit.results.statements, FitCode.CLOCKS_NOT_COUNTED())
    results = with_verdicts(replace(fit.results, criterion=final.estimator, statements=statements))
    return replace(fit, results=with_reasons(results, "hygric", against))


def final_designs(final: FinalSet) -> tuple[Design, ...]:
    """The designs of a final set, with the estimated levels of the controllers."""
    values, simulator = final.estimate.values, final.estimate.simulator
    designs = []
    for design in simulator.designs:
        features = dict(design.features)
        for name in set(features) & set(simulator.controls):
            levels = {"start": values[f"{name}_first"], "full": values[f"{name}_second"]}
            features[name] = {**features[name], **levels}
        designs.append(replace(design, features=features))
    return tuple(designs)


def _stage(early: PreparedRecord, base: Design, final: FinalSet, say: Progress) -> Stage:
    """The stage of one design with the values and the covariance of the final set."""
    say("sizes of the disturbances")
    run = model_inputs(base, early)
    likelihood = Likelihood(base.model, run.timeline, tolerance=FINAL_STEP_TOLERANCE)
    estimated = final.estimate.values
    fixed = {
        p.name: min(max(estimated[p.name], p.lower), p.upper)
        for p in base.model.parameters
        if p.name in estimated
    }
    noise = Coordinates(base.model.parameters, fixed)
    optimum = climb(Objective(likelihood, noise), noise.start(), tolerance=SIZE_TOLERANCE)
    values = {**noise.values(optimum.z)}
    coordinates = Coordinates(base.model.parameters, {n: values[n] for n in noise.names})
    estimate = Estimate(
        coordinates, coordinates.start(values), values, likelihood.value(values), optimum.objective,
        optimum.converged, optimum.end, tuple(n for n in final.at_bounds if n in fixed),
    )  # fmt: skip
    uncertainty = _uncertainty(final, coordinates)
    bounds = {
        name: wald_bounds(estimate, uncertainty, name, CONFIDENCE)
        for name in TIME_CONSTANTS
        if name in coordinates.names
    }
    say("models without the input")
    stated = base.humidity is not None and early[base.humidity].response_time_s is not None
    without = {name: without_input(final.estimate, name) for name in bounds}
    return Stage(base, run, estimate, uncertainty, bounds, response_stated=stated, without=without)


def without_input(model: Calibration, name: str) -> WithoutInput:
    """The best simulation in which the input of a time constant does not act, compared with the maximum of
    the likelihood of the model itself."""
    from scipy.special import chdtri

    q = next(quantity for quantity, best in TIME_CONSTANT_OF.items() if best == name)
    scene, simulator = model.simulator.scene, model.simulator
    time, vapour = scene.edges_s / HOUR_S, np.full(len(scene.edges_s), np.nan)
    if "vapour" in scene.readings:
        r = scene.readings["vapour"]
        vapour[np.clip(np.searchsorted(scene.edges_s, r.time_s), 0, len(time) - 1)] = r.value
    names = [n for n in simulator.cell_model(q).inputs if n != CABINET_TEMPERATURE]
    inputs = {n: scene.at_edges(n, simulator.owner(n)) for n in names}
    free, results = acting(model, [q]), []
    best = fitted(model, free)
    required = float(chdtri(len(free), CHANCE))
    for code, moved, fixed in alternatives(name, inputs, time, scene.drive, vapour):
        still = scene.with_inputs([(n, simulator.owner(n), value) for n, value in moved.items()])
        other = replace(simulator, scene=still, _cells={})
        theta = other.vector({**best.values, **fixed})
        # the variances have several maxima: start with those of the model and with new ones
        for errors, variances in (
            (best.errors, best.variances),
            (errors_of(other, theta, model.quantities), None),
        ):
            start = estimate_at(other, errors, theta, best.linear, variances)
            fit = fitted(start, [n for n in free if n not in fixed])
            results.append(WithoutInput(code(), float(fit.deviances[q] - best.deviances[q]), required))
    return min(results, key=lambda other: other.gain)


def _uncertainty(final: FinalSet, coordinates: Coordinates) -> Uncertainty:
    """The uncertainty of a stage's parameters in the stage's coordinates."""
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
