"""`transfer_fit`: try the model of one turbine on the record of another; which parameters hold, which must be
re-estimated, and what that gains.

Parameters are estimated on the record's identification period (without `until`, on its first three quarters)
and judged on the held-out rest. Four sets of values are simulated, all with the design of the fit:

- as it is: every parameter of the fit;
- own loggers: offsets of the sensors and disturbances estimated here, the cabinet as in the fit;
- re-estimated: also the groups of the cabinet's parameters that differ;
- all its own: every parameter estimated here.

A group differs if the two estimates are further apart than both uncertainties explain (of each the wider of
Wald and sandwich), and if the difference matters (`transferability.MATERIAL_DIFFERENCE`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hygrokf.data.progress import Progress, reporting
from hygrokf.data.record import Record
from hygrokf.estimation.confidence import Bounds, Uncertainty, normal_quantile, uncertainty
from hygrokf.estimation.optimiser import Estimate, Objective, fit_mle
from hygrokf.evaluation.bootstrap import Resampled, resampled
from hygrokf.evaluation.scoring import guesses, period_masks, rmse
from hygrokf.evaluation.simulation import Prediction, free_run, measured
from hygrokf.identification.estimation import Stage
from hygrokf.identification.fit import Fit
from hygrokf.identification.identify import Basis, assemble_fit
from hygrokf.identification.turbine_type import TurbineType
from hygrokf.identification.verdict import inherited, with_reasons
from hygrokf.modelling.design import JOINT
from hygrokf.physics.parameters import within_limits
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.parts import PARTS, SCORED, TIME_CONSTANTS
from hygrokf.texts.statement import Statement
from hygrokf.texts.transfer_codes import TransferVerdict
from hygrokf.texts.wording import iso_time
from hygrokf.transfer.baseline import (
    OFFSETS,
    Baseline,
    Difference,
    GroupTest,
    Origin,
    baseline_of,
    difference,
    members,
    selection,
)
from hygrokf.transfer.transfer_results import (
    RecordCourse,
    Reduction,
    SetError,
    Structure,
    Transfer,
    TransferResult,
    TransferSource,
)
from hygrokf.transfer.transferability import group_parameters, groups_of, matters, ratios_of, with_verdict

SETS = ("as_is", "own_loggers", "re_estimated", "all_own")


def transfer_fit(
    source: Fit | TurbineType,
    record: Record,
    progress: Progress | bool | None = None,
    fits: bool = True,
) -> Transfer:
    """Judge the model of one turbine, or of a type, on another turbine's record.

    source: a fit, or a type of turbines (`identification.turbine_type`).
    record: of the other turbine.
    progress: called with each step in words; True: shows the steps as one line, also in a notebook.
    fits: whether the record's own fits are made too, with their scores and bands.

    Returns a `Transfer`, whose `results` are those of transfer.json: the verdict, whether each group of
    parameters holds, and the held-out errors [K], [g/m³] of each set of values. Raises ValueError if the
    record lacks an input or a reading that the model needs.
    """
    with reporting(progress, "transfer_fit") as say:
        return _transferred(source, record, say, fits)


def _transferred(source: Fit | TurbineType, record: Record, say: Progress, fits: bool) -> Transfer:
    """Estimate the sets of values, simulate them, judge the transfer, and make the fits."""
    baseline, statements = baseline_of(Origin.of(source), record)
    say("as it is")
    estimates = _estimates(baseline, say)
    say("held-out errors")
    predictions = {
        name: free_run(baseline.base, values, baseline.run)
        for name, values in estimates.values(baseline).items()
    }
    results = with_verdict(_results(baseline, estimates, predictions, statements))
    course = RecordCourse.of(baseline.run, predictions)
    if not fits:
        return Transfer(results, course)
    say("its own fit")
    own_fit = adapted_fit = _fit(baseline, estimates.own, estimates.spread)
    if estimates.adapted is not estimates.own:
        spread = uncertainty(Objective(baseline.likelihood, estimates.adapted.coordinates), estimates.adapted)
        adapted_fit = _fit(baseline, estimates.adapted, spread)
    return Transfer(replace(results, verdicts=inherited(adapted_fit.results)), course, adapted_fit, own_fit)


@dataclass(frozen=True)
class _Estimates:
    """The estimates of the sets of values on one record, and how they differ from the original values.

    `logger`, `adapted`, `own`: estimates of the sets "own loggers", "re-estimated", "all its own"; `spread`:
    uncertainty of `own`; `apart`: own minus original values; `effects`: effect of each group on the free run,
    by quantity; `differing`: groups that differ and matter.
    """

    logger: Estimate
    adapted: Estimate
    own: Estimate
    spread: Uncertainty
    apart: Difference
    tests: Mapping[str, GroupTest]
    effects: Mapping[str, Mapping[str, float]]
    differing: tuple[str, ...]

    def values(self, baseline: Baseline) -> dict[str, Mapping[str, float]]:
        """Return the parameter values of each of `SETS`."""
        estimated = (estimate.values for estimate in (self.logger, self.adapted, self.own))
        return dict(zip(SETS, (dict(baseline.origin.values), *estimated), strict=True))


def _estimates(baseline: Baseline, say: Progress) -> _Estimates:
    """Estimate the sets of values on the identification period."""
    parameters = baseline.likelihood.model.parameters
    starts = within_limits(parameters, baseline.origin.values) | {
        name: 0.0 for name in members(baseline.groups, OFFSETS)
    }
    cabinet_values = {name: baseline.origin.values[name] for name in baseline.cabinet}
    say("own loggers")
    logger = fit_mle(baseline.likelihood, starts, {**baseline.held, **cabinet_values}, count=1)
    say("all parameters")
    own = fit_mle(baseline.likelihood, logger.values, baseline.held, count=1)
    if own.objective < logger.objective - 0.01:  # the search ended at another maximum
        own = fit_mle(baseline.likelihood, starts, baseline.held, count=3)
    say("uncertainty")
    spread = uncertainty(Objective(baseline.likelihood, own.coordinates), own)
    apart = difference(baseline.origin, own, spread, baseline.cabinet)
    tests = selection(apart, baseline.groups)
    say("what differences do")
    effects = {
        group: _effect(baseline, own, group)
        for group in dict.fromkeys(baseline.groups[name] for name in apart.names)
    }
    differing = tuple(
        group
        for group in effects
        if tests[group].significant
        and matters(group, apart.of(members(baseline.groups, group)), effects[group])
    )
    say("re-estimated")
    adapted = _adapted(baseline, logger, own, differing)
    return _Estimates(logger, adapted, own, spread, apart, tests, effects, differing)


def _results(
    baseline: Baseline,
    estimates: _Estimates,
    predicted: Mapping[str, Prediction],
    statements: Sequence[Statement],
) -> TransferResult:
    """Return the results of a transfer, still without its verdict."""
    masks = period_masks(baseline.run)
    is_held_out = (masks["validation"] & baseline.run.scored).any()
    period: Literal["identification", "validation"] = "validation" if is_held_out else "identification"
    errors, gains = _scored(baseline, predicted, masks[period])
    origin, all_estimates = baseline.origin, (estimates.logger, estimates.adapted, estimates.own)
    return TransferResult(
        name=baseline.run.record.name,
        provenance=baseline.run.record.provenance,
        until=iso_time(baseline.until_s),
        n_readings=baseline.early_run.timeline.n_readings,
        verdict=TransferVerdict.CANNOT_BE_JUDGED,
        reasons=(),
        re_estimate=estimates.differing,
        statements=tuple(statements),
        parameters=group_parameters(
            baseline, estimates.apart, estimates.values(baseline), estimates.spread, estimates.own
        ),
        groups=groups_of(baseline, estimates.apart, estimates.tests, estimates.effects, estimates.differing),
        likelihood_ratios=ratios_of(baseline, *all_estimates, estimates.spread, estimates.differing),
        period=period,
        rmse=errors,
        gains=gains,
        structure=_structure(baseline, predicted["all_own"]),
        at_bounds=tuple(
            name
            for name in estimates.adapted.at_bounds
            if baseline.groups[name] in estimates.differing and name != "resistance_ratio"
        ),
        converged={name: estimate.converged for name, estimate in zip(SETS[1:], all_estimates, strict=True)},
        source=TransferSource(origin.name, origin.kind, dict(origin.verdicts)),
    )


def _effect(baseline: Baseline, own: Estimate, group: str) -> dict[str, float]:
    """Return how much the own values of a group change the free run: root mean square [K], [g/m³] over the
    record."""
    changed_values = dict(baseline.origin.values) | {
        name: own.values[name] for name in members(baseline.groups, group)
    }
    runs = [
        free_run(baseline.base, values, baseline.run) for values in (baseline.origin.values, changed_values)
    ]
    effects = {}
    for quantity in SCORED:
        before, after = (prediction.of(quantity) for prediction in runs)
        if before is not None and after is not None:
            effects[quantity] = float(np.sqrt(np.mean((before[0] - after[0])[baseline.run.scored] ** 2)))
    return effects


def _adapted(baseline: Baseline, logger: Estimate, own: Estimate, differing: Sequence[str]) -> Estimate:
    """Return the estimate with offsets, disturbances and the differing groups estimated here, all other
    parameters as in the fit."""
    if not differing:
        return logger
    fixed = {
        name: baseline.origin.values[name]
        for name in baseline.cabinet
        if baseline.groups[name] not in differing
    }
    if not fixed:
        return own
    return fit_mle(baseline.likelihood, own.values, {**baseline.held, **fixed}, count=1)


# --- held-out errors -------------------------------------------------------------------------


def _errors(baseline: Baseline, predicted: Mapping[str, Prediction], quantity: str) -> dict[str, np.ndarray]:
    """Return the errors (T,) of every set of values and of the rules without a model, at scored instants."""
    reading = measured(baseline.run)[quantity]
    columns = {
        name: mean_and_sd[0]
        for name, prediction in predicted.items()
        if (mean_and_sd := prediction.of(quantity)) is not None
    }
    columns |= {name: guess[quantity] for name, guess in guesses(baseline.run).items() if quantity in guess}
    return {name: np.where(baseline.run.scored, reading - value, np.nan) for name, value in columns.items()}


def _scored(
    baseline: Baseline, predicted: Mapping[str, Prediction], chosen: np.ndarray
) -> tuple[dict[str, dict[str, SetError]], dict[str, dict[str, dict[str, Reduction]]]]:
    """Return errors of sets and rules, and gains of the sets, by quantity, at those of the chosen instants
    (T,) that all of them score."""
    errors_by_quantity, gains = {}, {}
    for quantity in SCORED:
        errors = {
            name: np.where(chosen, error, np.nan)
            for name, error in _errors(baseline, predicted, quantity).items()
        }
        errors = {name: error for name, error in errors.items() if np.isfinite(error).any()}
        if not errors:
            continue
        columns = np.column_stack(list(errors.values()))
        bootstrap = resampled(baseline.run.timeline.seconds, columns)
        if bootstrap is None:
            continue
        all_known = np.isfinite(columns).all(axis=1)
        errors_by_quantity[quantity] = {
            name: SetError(
                **vars(rmse(np.where(all_known, error, np.nan), baseline.run.operating)),
                bounds=bootstrap.bounds(column),
            )
            for column, (name, error) in enumerate(errors.items())
        }
        gains[quantity] = _gains(bootstrap, list(errors))
    return errors_by_quantity, gains


def _gains(bootstrap: Resampled, names: Sequence[str]) -> dict[str, dict[str, Reduction]]:
    """Return how much less each set errs than the model as it is, and than the best rule without a model."""
    rules = [name for name in names if name not in SETS]
    best_rule = min(rules, key=lambda name: bootstrap.value[names.index(name)]) if rules else None
    gains_by_set: dict[str, dict[str, Reduction]] = {name: {} for name in SETS if name in names}
    for name, gains in gains_by_set.items():
        for gain_name, reference in (("over_as_is", "as_is"), ("over_rule", best_rule)):
            if reference is not None and reference in names and reference != name:
                reference_column, column = names.index(reference), names.index(name)
                value = float(bootstrap.value[reference_column] - bootstrap.value[column])
                gains[gain_name] = Reduction(
                    reference, *(bootstrap.difference(reference_column, column) or (value,))
                )
    return gains_by_set


def _structure(baseline: Baseline, predicted: Prediction) -> dict[str, Structure]:
    """Return the free-run error of the record's own model in the identification period, beside that of the
    fit on its own record."""
    masks = period_masks(baseline.run)
    by_quantity = {}
    for quantity in SCORED:
        errors = _errors(baseline, {"all_own": predicted}, quantity).get("all_own")
        error_of_fit = baseline.origin.rmse.get(quantity)
        if errors is None or error_of_fit is None:
            continue
        bootstrap = resampled(
            baseline.run.timeline.seconds, np.where(masks["identification"], errors, np.nan)[:, None]
        )
        if bootstrap is not None:
            error, (lower, _) = float(bootstrap.value[0]), bootstrap.bounds(0) or (math.nan, math.nan)
            by_quantity[quantity] = Structure(error, error_of_fit, error / error_of_fit, lower / error_of_fit)
    return by_quantity


# --- fits ------------------------------------------------------------------------------------


def _fit(baseline: Baseline, estimate: Estimate, spread: Uncertainty) -> Fit:
    """Return an estimate on the record as a fit; parameters that were taken over keep their value and
    uncertainty."""
    from hygrokf.identification.steady_state import heat_release_regression

    kept = [name for name in baseline.origin.names if name in estimate.coordinates.fixed]
    full_uncertainty = _with_kept(baseline, spread, kept)
    bounds = {}
    for name in TIME_CONSTANTS:
        index = full_uncertainty.place(name)
        if index is not None:
            variance = max(full_uncertainty.wald[index, index], full_uncertainty.sandwich[index, index])
            half_width_ln = min(normal_quantile(0.95) * math.sqrt(variance), 50.0)
            value = estimate.values[name]
            ends = (value * math.exp(-half_width_ln), value * math.exp(half_width_ln))
            method = "taken over" if name in kept else "wald"
            bounds[name] = Bounds(value, *ends, 0.95, method)
    stage = Stage(baseline.base, baseline.early_run, estimate, full_uncertainty, bounds)
    basis = Basis(JOINT, (stage,), heat_release_regression(baseline.early_run.record))
    fit = assemble_fit(baseline.run.record, basis, {})
    origin = FitCode.MODEL_TAKEN_OVER(fit=baseline.origin.name)
    results = replace(fit.results, statements=(origin, *fit.results.statements))
    for part, name in zip(PARTS, TIME_CONSTANTS, strict=True):
        if name in kept:
            results = with_reasons(results, part, baseline.origin.reasons(part))
    return replace(fit, results=results)


def _with_kept(baseline: Baseline, spread: Uncertainty, kept: Sequence[str]) -> Uncertainty:
    """Return the uncertainty of an estimate together with that of the parameters taken over, which are
    independent of it."""
    from scipy.linalg import block_diag

    indices = [baseline.origin.names.index(name) for name in kept]
    parameters = {parameter.name: parameter for parameter in baseline.base.model.parameters}
    slopes = np.array([parameters[name].slope(baseline.origin.values[name]) for name in kept])
    original_covariance = baseline.origin.covariance[np.ix_(indices, indices)] / np.outer(slopes, slopes)
    return replace(
        spread,
        names=(*spread.names, *kept),
        wald=block_diag(spread.wald, original_covariance),
        sandwich=block_diag(spread.sandwich, original_covariance),
        factor=np.concatenate([spread.factor, np.ones(len(kept))]),
        # no part of this record determines the parameters taken over
        parts=np.pad(spread.parts, ((0, 0), (0, len(kept) if spread.parts.size else 0))),
    )
