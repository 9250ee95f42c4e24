"""The model of one turbine on the record of another: what travels, what must be re-estimated, what that
gains.

Parameters are estimated on the record's identification period (without `until` the first three quarters) and
judged on the held-out rest.  Four sets of values are simulated, all with the design of the fit:

- as it is: every parameter of the fit;
- own loggers: offsets of the sensors and disturbances estimated here, the cabinet as it was fitted;
- re-estimated: also the groups of the cabinet's parameters that differ;
- all its own: every parameter estimated here.

A group differs where the two estimates are further apart than both uncertainties explain (`groups`; both
covariances count, each the wider of Wald and sandwich) and where the difference matters
(`verdict.MATERIAL_DIFFERENCE`).
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
from hygrokf.estimation.conventions import CONFIDENCE
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
    progress: called with each step in words; True: shows them as one line, also in a notebook.
    fits: whether to make the record's own fits too, with their scores and bands.

    Returns `results` as in transfer.json: the verdict, and by group of parameters whether it holds, with
    held-out errors [K], [g/m³] of each set of values.
    Raises ValueError where the record lacks an input or a reading that the model needs.
    """
    with reporting(progress, "transfer_fit") as say:
        return _transferred(source, record, say, fits)


def _transferred(source: Fit | TurbineType, record: Record, say: Progress, fits: bool) -> Transfer:
    baseline, statements = baseline_of(Origin.of(source), record)
    say("as it is")
    found = _estimates(baseline, say)
    say("held-out errors")
    predicted = {n: free_run(baseline.base, one, baseline.run) for n, one in found.values(baseline).items()}
    results = with_verdict(_results(baseline, found, predicted, statements))
    course = RecordCourse.of(baseline.run, predicted)
    if not fits:
        return Transfer(results, course)
    say("its own fit")
    own = adapted = _fit(baseline, found.own, found.spread)
    if found.adapted is not found.own:
        spread = uncertainty(Objective(baseline.likelihood, found.adapted.coordinates), found.adapted)
        adapted = _fit(baseline, found.adapted, spread)
    return Transfer(replace(results, verdicts=inherited(adapted.results)), course, adapted, own)


@dataclass(frozen=True)
class _Estimates:
    """The estimates of the sets of values on one record, and how they differ from the original values.

    `spread` the uncertainty of `own`; `apart` own less original values; `effects` of each group on the free
    run by quantity; `differing` the groups that differ and matter.
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
        """Values by the names in `SETS`."""
        estimates = (self.logger, self.adapted, self.own)
        return dict(zip(SETS, (dict(baseline.origin.values), *(e.values for e in estimates)), strict=True))


def _estimates(baseline: Baseline, say: Progress) -> _Estimates:
    parameters = baseline.likelihood.model.parameters
    starts = within_limits(parameters, baseline.origin.values) | {
        n: 0.0 for n in members(baseline.groups, OFFSETS)
    }
    cabinet = {n: baseline.origin.values[n] for n in baseline.cabinet}
    say("own loggers")
    logger = fit_mle(baseline.likelihood, starts, {**baseline.held, **cabinet}, count=1)
    say("all parameters")
    own = fit_mle(baseline.likelihood, logger.values, baseline.held, count=1)
    if own.objective < logger.objective - 0.01:  # the search ended at another maximum
        own = fit_mle(baseline.likelihood, starts, baseline.held, count=3)
    say("uncertainty")
    spread = uncertainty(Objective(baseline.likelihood, own.coordinates), own)
    apart = difference(baseline.origin, own, spread, baseline.cabinet)
    tests = selection(apart, baseline.groups)
    say("what differences do")
    effects = {g: _effect(baseline, own, g) for g in dict.fromkeys(baseline.groups[n] for n in apart.names)}
    differing = tuple(
        g
        for g in effects
        if tests[g].significant and matters(g, apart.of(members(baseline.groups, g)), effects[g])
    )
    say("re-estimated")
    adapted = _adapted(baseline, logger, own, differing)
    return _Estimates(logger, adapted, own, spread, apart, tests, effects, differing)


def _results(
    baseline: Baseline,
    found: _Estimates,
    predicted: Mapping[str, Prediction],
    statements: Sequence[Statement],
) -> TransferResult:
    masks = period_masks(baseline.run)
    held_out = (masks["validation"] & baseline.run.scored).any()
    period: Literal["identification", "validation"] = "validation" if held_out else "identification"
    table, gains = _scored(baseline, predicted, masks[period])
    origin, estimates = baseline.origin, (found.logger, found.adapted, found.own)
    return TransferResult(
        name=baseline.run.record.name,
        provenance=baseline.run.record.provenance,
        until=iso_time(baseline.until_s),
        n_readings=baseline.early_run.timeline.n_readings,
        verdict=TransferVerdict.CANNOT_BE_JUDGED,
        reasons=(),
        re_estimate=found.differing,
        statements=tuple(statements),
        parameters=group_parameters(baseline, found.apart, found.values(baseline), found.spread, found.own),
        groups=groups_of(baseline, found.apart, found.tests, found.effects, found.differing),
        likelihood_ratios=ratios_of(baseline, *estimates, found.spread, found.differing),
        period=period,
        rmse=table,
        gains=gains,
        structure=_structure(baseline, predicted["all_own"]),
        at_bounds=tuple(
            n
            for n in found.adapted.at_bounds
            if baseline.groups[n] in found.differing and n != "resistance_ratio"
        ),
        converged={name: estimate.converged for name, estimate in zip(SETS[1:], estimates, strict=True)},
        source=TransferSource(origin.name, origin.kind, dict(origin.verdicts)),
    )


def _effect(baseline: Baseline, own: Estimate, group: str) -> dict[str, float]:
    """What a group's own values change in the free run: root mean square [K] and [g/m³] over the record."""
    changed = dict(baseline.origin.values) | {n: own.values[n] for n in members(baseline.groups, group)}
    runs = [free_run(baseline.base, values, baseline.run) for values in (baseline.origin.values, changed)]
    found = {}
    for quantity in SCORED:
        before, after = (made.of(quantity) for made in runs)
        if before is not None and after is not None:
            found[quantity] = float(np.sqrt(np.mean((before[0] - after[0])[baseline.run.scored] ** 2)))
    return found


def _adapted(baseline: Baseline, logger: Estimate, own: Estimate, differing: Sequence[str]) -> Estimate:
    """Offsets, disturbances and the differing groups estimated here, the others as they were."""
    if not differing:
        return logger
    fixed = {n: baseline.origin.values[n] for n in baseline.cabinet if baseline.groups[n] not in differing}
    if not fixed:
        return own
    return fit_mle(baseline.likelihood, own.values, {**baseline.held, **fixed}, count=1)


# --- held-out errors -------------------------------------------------------------------------


def _errors(baseline: Baseline, predicted: Mapping[str, Prediction], quantity: str) -> dict[str, np.ndarray]:
    """Errors (T,) of every set and of the sceptic's rules at scored instants."""
    reading = measured(baseline.run)[quantity]
    columns = {n: pair[0] for n, made in predicted.items() if (pair := made.of(quantity)) is not None}
    columns |= {n: guess[quantity] for n, guess in guesses(baseline.run).items() if quantity in guess}
    return {n: np.where(baseline.run.scored, reading - value, np.nan) for n, value in columns.items()}


def _scored(
    baseline: Baseline, predicted: Mapping[str, Prediction], chosen: np.ndarray
) -> tuple[dict[str, dict[str, SetError]], dict[str, dict[str, dict[str, Reduction]]]]:
    """Errors of the sets and the rules at the chosen instants (T,) that all of them score, and the gains, by
    quantity."""
    table, gains = {}, {}
    for quantity in SCORED:
        errors = {n: np.where(chosen, e, np.nan) for n, e in _errors(baseline, predicted, quantity).items()}
        errors = {n: e for n, e in errors.items() if np.isfinite(e).any()}
        if not errors:
            continue
        columns = np.column_stack(list(errors.values()))
        drawn = resampled(baseline.run.timeline.seconds, columns)
        if drawn is None:
            continue
        there = np.isfinite(columns).all(axis=1)
        table[quantity] = {
            n: SetError(
                **vars(rmse(np.where(there, e, np.nan), baseline.run.operating)), bounds=drawn.bounds(i)
            )
            for i, (n, e) in enumerate(errors.items())
        }
        gains[quantity] = _gains(drawn, list(errors))
    return table, gains


def _gains(drawn: Resampled, names: Sequence[str]) -> dict[str, dict[str, Reduction]]:
    """How much less each set errs than the model as it is, and than the best rule without a model."""
    rules = [n for n in names if n not in SETS]
    best = min(rules, key=lambda n: drawn.value[names.index(n)]) if rules else None
    found: dict[str, dict[str, Reduction]] = {name: {} for name in SETS if name in names}
    for name, gains in found.items():
        for key, other in (("over_as_is", "as_is"), ("over_rule", best)):
            if other is not None and other in names and other != name:
                i, j = names.index(other), names.index(name)
                value = float(drawn.value[i] - drawn.value[j])
                gains[key] = Reduction(other, *(drawn.difference(i, j) or (value,)))
    return found


def _structure(baseline: Baseline, predicted: Prediction) -> dict[str, Structure]:
    """Free-run error of the record's own model in the identification period, beside that of the fit on its
    own record."""
    masks = period_masks(baseline.run)
    found = {}
    for quantity in SCORED:
        errors = _errors(baseline, {"all_own": predicted}, quantity).get("all_own")
        before = baseline.origin.rmse.get(quantity)
        if errors is None or before is None:
            continue
        drawn = resampled(
            baseline.run.timeline.seconds, np.where(masks["identification"], errors, np.nan)[:, None]
        )
        if drawn is not None:
            value, (low, _) = float(drawn.value[0]), drawn.bounds(0) or (math.nan, math.nan)
            found[quantity] = Structure(value, before, value / before, low / before)
    return found


# --- fits ------------------------------------------------------------------------------------


def _fit(baseline: Baseline, estimate: Estimate, spread: Uncertainty) -> Fit:
    """An estimate on the record as a fit; parameters taken over keep their value and uncertainty."""
    from hygrokf.identification.steady_state import heat_release_regression

    kept = [n for n in baseline.origin.names if n in estimate.coordinates.fixed]
    wider = _with_kept(baseline, spread, kept)
    bounds = {}
    for name in TIME_CONSTANTS:
        i = wider.place(name)
        if i is not None:
            log_variance = max(wider.wald[i, i], wider.sandwich[i, i])
            reach = min(normal_quantile(CONFIDENCE) * math.sqrt(log_variance), 50.0)
            value = estimate.values[name]
            ends = (value * math.exp(-reach), value * math.exp(reach))
            method = "taken over" if name in kept else "wald"
            bounds[name] = Bounds(value, *ends, CONFIDENCE, method)
    stage = Stage(baseline.base, baseline.early_run, estimate, wider, bounds)
    basis = Basis(JOINT, (stage,), heat_release_regression(baseline.early_run.record))
    made = assemble_fit(baseline.run.record, basis, {})
    origin = FitCode.MODEL_TAKEN_OVER(fit=baseline.origin.name)
    results = replace(made.results, statements=(origin, *made.results.statements))
    for part, name in zip(PARTS, TIME_CONSTANTS, strict=True):
        if name in kept:
            results = with_reasons(results, part, baseline.origin.reasons(part))
    return replace(made, results=results)


def _with_kept(baseline: Baseline, spread: Uncertainty, kept: Sequence[str]) -> Uncertainty:
    """The uncertainty of an estimate with that of the parameters taken over, which are independent of it."""
    from scipy.linalg import block_diag

    place = [baseline.origin.names.index(n) for n in kept]
    parameters = {p.name: p for p in baseline.base.model.parameters}
    slopes = np.array([parameters[n].slope(baseline.origin.values[n]) for n in kept])
    old = baseline.origin.covariance[np.ix_(place, place)] / np.outer(slopes, slopes)
    return replace(
        spread,
        names=(*spread.names, *kept),
        wald=block_diag(spread.wald, old),
        sandwich=block_diag(spread.sandwich, old),
        factor=np.concatenate([spread.factor, np.ones(len(kept))]),
        # no part of this record determines the parameters taken over
        parts=np.pad(spread.parts, ((0, 0), (0, len(kept) if spread.parts.size else 0))),
    )
