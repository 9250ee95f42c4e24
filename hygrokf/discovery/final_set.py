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
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.moments import DigitsFault
from hygrokf.estimation.optimiser import Estimate, Objective, climb
from hygrokf.estimation.rates_fault import RatesFault
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
"""Ratio of the errors by least squares to those by likelihood below which least squares are preferred."""
EARLY = 2.0 / 3.0
"""Share of the identification period to which both estimators are fitted for their comparison."""
UNDETERMINED = 1e-10
"""A direction is not determined if its information, or its eigenvalue as a share of the largest one, is at
most this."""


@dataclass(frozen=True)
class FinalSet:
    """The final parameter values of a model with their covariance.

    names: parameters of the rows of `covariance` (d, d), which is in coordinates: logarithms of positive
        parameters.
    at_bounds: parameters that ended at a limit.  flat: parameters that the readings do not determine.
    """

    estimate: Calibration
    estimator: Estimator
    names: tuple[str, ...]
    covariance: np.ndarray
    at_bounds: tuple[str, ...]
    flat: tuple[str, ...]

    def deviation(self, name: str) -> float:
        """Return the standard error of a parameter's coordinate: of its logarithm if it is estimated as
        one."""
        index = self.names.index(name)
        return math.sqrt(max(self.covariance[index, index], 0.0))

    def bounds(self, name: str, quantile: float = 1.96) -> tuple[float, float]:
        """Return the bounds of a parameter in its unit; by default with 95 % probability.

        They are open (0 or ∓∞) if the parameter ended at a limit or is not determined.
        """
        parameter = self.estimate.simulator.parameters[self.estimate.simulator.names.index(name)]
        value, half_width = self.estimate.values[name], quantile * self.deviation(name)
        logarithmic = parameter.positive and name not in self.estimate.linear
        if name in (*self.at_bounds, *self.flat) or not half_width < 50.0 * (
            1.0 if logarithmic else math.inf
        ):
            return (0.0 if logarithmic else -math.inf), math.inf
        if logarithmic:
            return value * math.exp(-half_width), value * math.exp(half_width)
        return value - half_width, value + half_width


def final_estimator(*models: Calibration) -> Estimator:
    """Return the estimator whose free runs predict the last third of the identification period better.

    Both estimators are fitted to the first two thirds; "likelihood" is kept unless output error is better by
    5 %.
    """
    ratios = []
    for model in models:
        on_early_part = _until(model, EARLY)
        by_likelihood, by_output = (
            fitted_by(on_early_part, "likelihood"),
            fitted_by(on_early_part, "output-error"),
        )
        for q in model.quantities:
            readings = model.simulator.scene.readings[q]
            is_late = (
                readings.identified
                & ~on_early_part.simulator.scene.readings[q].identified
                & np.isfinite(readings.value)
            )
            if is_late.sum() > 1:
                errors = [
                    max(float(np.mean((readings.value - fit.simulated[q])[is_late] ** 2)), 1e-12)
                    for fit in (by_likelihood, by_output)
                ]
                ratios.append(0.5 * math.log(errors[1] / errors[0]))
    return "output-error" if ratios and math.exp(np.mean(ratios)) < BETTER_RATIO else "likelihood"


def final_set(estimate: Calibration, estimator: Estimator) -> FinalSet:
    """Fit a model by an estimator to the whole identification period, with the sandwich covariance by
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
    """Refit a model by an estimator, in the parameters that act on the quantities (None: all)."""
    free = None if quantities is None else acting(estimate, quantities)
    if estimator == "likelihood":
        return levelled(fitted(estimate, free))
    plain = fitted(with_variances(replace(estimate, plain=True)), free, POLISH)
    return replace(estimate_at(plain.simulator, estimate.errors, plain.theta, estimate.linear), plain=False)


def _until(estimate: Calibration, share: float) -> Calibration:
    """Return the estimate with its identification period cut to the first `share` of its length."""
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
    """Return names, covariance H⁻¹ J H⁻¹ in coordinates, and the parameters that H does not determine.

    H is the Gauss–Newton information plus that of the priors.  J is the covariance of the daily scores,
    including that between neighbouring days, plus the information of the priors.
    """
    coordinates = frame(estimate.simulator.parameters, set(estimate.simulator.names), estimate.linear)
    names = tuple(estimate.simulator.names[i] for i in coordinates.place)
    information, score_covariance = np.zeros((2, len(names), len(names)))
    for q, columns in slopes(estimate, coordinates).items():
        white, error = weighted(estimate, q, columns)
        daily = estimate.simulator.scene.readings[q].by_day(white * error[:, None])
        information += white.T @ white
        # neighbouring days of a slow disturbance are not independent
        score_covariance += daily.T @ daily
        for lag in (1, 2):
            cross = (1.0 - lag / 3.0) * daily[lag:].T @ daily[:-lag]
            score_covariance += cross + cross.T
    priors = np.diag(of_priors(estimate, coordinates)[0])
    information += priors
    score_covariance += priors
    is_informed = np.diag(information) > UNDETERMINED
    scale = np.where(is_informed, 1.0 / np.sqrt(np.where(is_informed, np.diag(information), 1.0)), 0.0)
    eigenvalues, eigenvectors = np.linalg.eigh(information * scale[:, None] * scale)
    is_determined = eigenvalues > UNDETERMINED * eigenvalues[-1]
    undetermined_share = (eigenvectors[:, ~is_determined] ** 2).sum(axis=1)
    root = scale[:, None] * eigenvectors[:, is_determined] / eigenvalues[is_determined]
    inverse = root @ (eigenvectors[:, is_determined] * scale[:, None]).T
    covariance = inverse @ score_covariance @ inverse.T
    flat = tuple(
        name
        for name, share_undetermined, variance in zip(
            names, undetermined_share, np.diag(covariance), strict=True
        )
        if share_undetermined > 0.01 or not variance > 0.0
    )
    return names, covariance, flat


SIZE_TOLERANCE = 0.05
"""Expected gain in ln L at which the search for the sizes of the filter's disturbances ends."""
FINAL_STEP_TOLERANCE = 1e-5
"""[1] `tolerance` of the filter's sub-steps; it is coarse, since only the sizes of the disturbances depend on
it."""


def final_fit(
    record: Record, final: FinalSet, say: Progress = lambda text: None, against: Sequence[Reason] = ()
) -> Fit:
    """Return a final set as a `Fit` of the record, with the record's clocks corrected as the set states.

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
        raise ValueError(f"the final model of the search is too fast for a Kalman filter: {fault}") from fault
    # the linear estimate of clock offsets needs a maximum of the filter's likelihood, but this set is none
    statements = (*fit.results.statements, FitCode.CLOCKS_NOT_COUNTED())
    results = with_verdicts(replace(fit.results, criterion=final.estimator, statements=statements))
    return replace(fit, results=with_reasons(results, "hygric", against))


def final_designs(final: FinalSet) -> tuple[Design, ...]:
    """Return the designs of a final set, with the estimated switching levels of the controllers."""
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
    """Return one design as a stage of a fit, with the values and the covariance of the final set.

    early: the record's identification period.  The noise parameters are estimated by the Kalman filter.
    """
    say("sizes of the disturbances")
    run_of_record = model_inputs(base, early)
    likelihood = Likelihood(base.model, run_of_record.timeline, tolerance=FINAL_STEP_TOLERANCE)
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
    response_stated = base.humidity is not None and early[base.humidity].response_time_s is not None
    without = {name: without_input(final.estimate, name) for name in bounds}
    return Stage(
        base, run_of_record, estimate, uncertainty, bounds, response_stated=response_stated, without=without
    )


def without_input(model: Calibration, name: str) -> WithoutInput:
    """Return the best simulation in which the input of a time constant does not act, compared with the model.

    name: "thermal_time_constant" or "hygric_k".
    """
    from scipy.special import chdtri

    quantity = next(q for q, parameter in TIME_CONSTANT_OF.items() if parameter == name)
    scene, simulator = model.simulator.scene, model.simulator
    time_h, vapour = scene.edges_s / HOUR_S, np.full(len(scene.edges_s), np.nan)
    if "vapour" in scene.readings:
        readings = scene.readings["vapour"]
        vapour[np.clip(np.searchsorted(scene.edges_s, readings.time_s), 0, len(time_h) - 1)] = readings.value
    names = [n for n in simulator.cell_model(quantity).inputs if n != CABINET_TEMPERATURE]
    inputs = {n: scene.at_edges(n, simulator.owner(n)) for n in names}
    free, comparisons = acting(model, [quantity]), []
    full_fit = fitted(model, free)
    required = float(chdtri(len(free), CHANCE))
    for code, changed_inputs, fixed in alternatives(name, inputs, time_h, scene.drive, vapour):
        scene_without_input = scene.with_inputs(
            [(n, simulator.owner(n), value) for n, value in changed_inputs.items()]
        )
        simulator_without_input = replace(simulator, scene=scene_without_input, _cells={})
        theta = simulator_without_input.vector({**full_fit.values, **fixed})
        # the variances have several maxima: start with those of the model and with new ones
        for errors, variances in (
            (full_fit.errors, full_fit.variances),
            (errors_of(simulator_without_input, theta, model.quantities), None),
        ):
            start = estimate_at(simulator_without_input, errors, theta, full_fit.linear, variances)
            fit = fitted(start, [n for n in free if n not in fixed])
            comparisons.append(
                WithoutInput(code(), float(fit.deviances[quantity] - full_fit.deviances[quantity]), required)
            )
    return min(comparisons, key=lambda comparison: comparison.gain)


def _uncertainty(final: FinalSet, coordinates: Coordinates) -> Uncertainty:
    """Return the uncertainty of a stage's parameters in the stage's own coordinates."""
    without_covariance = (*final.at_bounds, *final.flat)
    names = tuple(
        name for name in coordinates.names if name in final.names and name not in without_covariance
    )
    indices = [final.names.index(name) for name in names]
    values: Mapping[str, float] = final.estimate.values
    linear = final.estimate.linear
    as_logarithm = [coordinates.parameter(name).positive and name in linear for name in names]
    scale = np.array(
        [
            1.0 / max(values[name], 1e-300) if log else 1.0
            for name, log in zip(names, as_logarithm, strict=True)
        ]
    )
    covariance = final.covariance[np.ix_(indices, indices)] * np.outer(scale, scale)
    information = np.linalg.pinv(covariance)
    factor = np.ones(len(names))
    return Uncertainty(names, covariance, covariance, factor, final.flat, (), information)
