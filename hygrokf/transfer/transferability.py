"""The judgement of a transfer: tables of parameters, groups and likelihood ratios, and the verdict with its
reasons."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from hygrokf.estimation.confidence import Uncertainty
from hygrokf.estimation.optimiser import Estimate
from hygrokf.texts.parts import SCORED
from hygrokf.texts.statement import Statement, Value
from hygrokf.texts.transfer_codes import TransferCode, TransferVerdict
from hygrokf.texts.wording import QUANTITY_NAMES, RULE_NAMES
from hygrokf.transfer.baseline import (
    HYGRIC_GROUP,
    OF_THE_RECORD,
    THERMAL_GROUP,
    Baseline,
    Difference,
    GroupTest,
    members,
)
from hygrokf.transfer.transfer_results import (
    Contrast,
    GroupChange,
    LikelihoodRatio,
    Outcome,
    ParameterChange,
    Reduction,
    TransferResult,
)

MATERIAL_DIFFERENCE = {
    "ln_time_constant": 0.10,
    "resistance_ratio": 0.05,
    "temperature_K": 0.3,
    "absolute_humidity_g_m3": 0.26,
}
"""Smallest differences that matter, however significant a smaller one is: 10 % of a time constant, 0.05 of
R_AT/(R_AT+R_IC), and for the simulated readings the accuracy of the paper's loggers (0.3 K; 2 % relative
humidity, which is 0.26 g/m³ at 15 °C)."""
DECISIVE_PARAMETERS = {
    THERMAL_GROUP: {"thermal_time_constant": "ln_time_constant", "resistance_ratio": "resistance_ratio"},
    HYGRIC_GROUP: {"hygric_k": "ln_time_constant"},
}
"""Group → parameters that decide whether its difference matters, with their keys in `MATERIAL_DIFFERENCE`;
for other groups the effect on the simulated readings decides."""
STRUCTURE = 1.5
"""[1] if the free-run error with all parameters estimated here is larger than that of the fit on its own
record by this factor, the form of the model is doubted."""


def matters(group: str, apart: Difference, effect: Mapping[str, float]) -> bool:
    """Return whether the difference of a group is large enough to matter."""
    if group not in DECISIVE_PARAMETERS:
        return any(effect.get(quantity, 0.0) >= MATERIAL_DIFFERENCE[quantity] for quantity in SCORED)
    sizes = dict(zip(apart.names, np.abs(apart.value), strict=True))
    return any(
        sizes.get(name, 0.0) >= MATERIAL_DIFFERENCE[key] for name, key in DECISIVE_PARAMETERS[group].items()
    )


def group_parameters(
    baseline: Baseline,
    apart: Difference,
    values: Mapping[str, Mapping[str, float]],
    spread: Uncertainty,
    own: Estimate,
) -> dict[str, ParameterChange]:
    """Every parameter with its values in the fit and on this record, standard errors, and difference."""
    origin_indices = {name: number for number, name in enumerate(baseline.origin.names)}
    rows = {}
    for parameter in baseline.base.model.parameters:
        origin_index, index = origin_indices.get(parameter.name), spread.place(parameter.name)
        original_se = own_se = math.nan
        if origin_index is not None:
            variance = float(baseline.origin.covariance[origin_index, origin_index])
            original_se = math.sqrt(max(variance, 0.0))
        if index is not None:
            sd = math.sqrt(spread.wald[index, index] * spread.factor[index])
            own_se = sd * abs(parameter.slope(own.values[parameter.name]))
        change = None
        if parameter.name in apart.names:
            change = Contrast(*apart.bounds(parameter.name))
            if parameter.positive:
                change = change.ratio
        rows[parameter.name] = ParameterChange(
            baseline.groups[parameter.name],
            parameter.unit,
            parameter.meaning,
            original=values["as_is"][parameter.name],
            original_se=original_se,
            own=own.values[parameter.name],
            own_se=own_se if math.isfinite(own_se) else math.nan,
            re_estimated=values["re_estimated"][parameter.name],
            difference=change,
            difference_is=None if change is None else "ratio" if parameter.positive else "difference",
            kept=parameter.name in baseline.held,
        )
    return rows


def groups_of(
    baseline: Baseline,
    apart: Difference,
    tests: Mapping[str, GroupTest],
    effects: Mapping[str, Mapping[str, float]],
    differing: Sequence[str],
) -> tuple[GroupChange, ...]:
    """Return for each group of parameters the test that decided on it, its effect on the free run, and the
    outcome."""
    rows = []
    for group in dict.fromkeys(baseline.groups.values()):
        names = members(baseline.groups, group)
        if group in OF_THE_RECORD:
            rows.append(GroupChange(group, names, "own", TransferCode.GROUP_OF_THE_RECORD()))
            continue
        if group not in effects:
            rows.append(GroupChange(group, names, "not judged", TransferCode.GROUP_NOT_SHOWN()))
            continue
        test, difference_of_group = tests[group], apart.of(names)
        outcome: Outcome = "differs" if group in differing else "travels"
        code = TransferCode.GROUP_ALIKE
        if group in differing:
            code = TransferCode.GROUP_DIFFERS
        elif test.significant:
            code = TransferCode.GROUP_IMMATERIAL
        elif _could_matter(group, difference_of_group, effects[group]):
            code = TransferCode.GROUP_OPEN
        effect = dict(effects[group])
        rows.append(
            GroupChange(group, difference_of_group.names, outcome, code(), **vars(test), effect=effect)
        )
    return tuple(rows)


def _could_matter(group: str, alone: Difference, effect: Mapping[str, float]) -> bool:
    """Return whether the uncertainty of this record includes a difference that is large enough to matter.

    For time constants and the resistance ratio: whether their 95 % bounds include such a difference. For
    other groups: whether the own values change the simulation enough to matter.
    """
    if group not in DECISIVE_PARAMETERS:
        return matters(group, alone, effect)
    for name, key in DECISIVE_PARAMETERS[group].items():
        if name in alone.names:
            _, lower, upper = alone.bounds(name)
            if max(-lower, upper) >= MATERIAL_DIFFERENCE[key]:
                return True
    return False


def ratios_of(
    baseline: Baseline,
    logger: Estimate,
    adapted: Estimate,
    own: Estimate,
    spread: Uncertainty,
    differing: Sequence[str],
) -> tuple[LikelihoodRatio, ...]:
    """Return exact likelihood ratios on this record alone, without the uncertainty of the original values.

    The statistic is divided by the mean factor by which the autocorrelation of the noise widens the bounds
    (Kent 1982).
    """
    from scipy.stats import chi2

    rows = []
    for restricted, extended, is_differing, label in (
        (logger, adapted, True, TransferCode.RATIO_OF_DIFFERING()),
        (adapted, own, False, TransferCode.RATIO_OF_REST()),
    ):
        names = tuple(
            name for name in baseline.cabinet if (baseline.groups[name] in differing) is is_differing
        )
        if not names:
            continue
        indices = [spread.names.index(name) for name in names if name in spread.names]
        factor = float(np.mean(spread.factor[indices])) if indices else 1.0
        ratio = max(2.0 * (extended.objective - restricted.objective), 0.0)
        p = float(chi2.sf(ratio / factor, len(names)))
        rows.append(LikelihoodRatio(label, names, ratio, factor, len(names), p))
    return tuple(rows)


# --- the verdict -----------------------------------------------------------------------------


def with_verdict(result: TransferResult) -> TransferResult:
    """Return the result with its verdict and the reasons for it, objections first."""
    worse_than_rules, doubts = _against_the_rules(result)
    objections = [*_of_the_model(result), *worse_than_rules, *_worse_than_before(result)]
    if objections:
        verdict = TransferVerdict.DOES_NOT_TRANSFER
    elif doubts:
        verdict = TransferVerdict.CANNOT_BE_JUDGED
    else:
        verdict = TransferVerdict.PARTLY if result.re_estimate else TransferVerdict.TRANSFERS
    reasons = (*(objections or doubts), *_errors_before_and_after(result))
    return replace(result, verdict=verdict, reasons=reasons)


def _of_the_model(result: TransferResult) -> list[Statement]:
    """Return objections to the model: all groups differ, parameters at limits, errors of its form."""
    objections = []
    differing = result.re_estimate
    judged_groups = {row.group for row in result.groups if row.outcome in ("travels", "differs")}
    if len(judged_groups) > 1 and judged_groups == set(differing):
        objections.append(TransferCode.ALL_GROUPS_DIFFER(groups=differing))
    if result.at_bounds:
        objections.append(TransferCode.ENDED_AT_LIMIT(names=result.at_bounds))
    objections += [
        TransferCode.STRUCTURE_LACKS(**_terms(quantity), error=row.rmse, ratio=row.ratio)
        for quantity, row in result.structure.items()
        if row.lower > STRUCTURE
    ]
    return objections


def _against_the_rules(result: TransferResult) -> tuple[list[Statement], list[Statement]]:
    """Return objections and doubts because a rule without a model errs less than the re-estimated model."""
    objections, doubts = [], []
    for quantity, gain in _gains(result, "over_rule"):
        values = {
            **_terms(quantity),
            "excess": -gain.gain,
            "rule": RULE_NAMES.get(gain.against, gain.against),
        }
        if math.isnan(gain.upper) and gain.gain < 0.0:
            doubts.append(TransferCode.RULE_BETTER_UNBOUNDED(**values, readings=result.n_readings))
        if gain.upper < 0.0:
            objections.append(TransferCode.RULE_BETTER(**values))
    return objections, doubts


def _worse_than_before(result: TransferResult) -> list[Statement]:
    """Return objections because re-estimating enlarges the error beyond its bounds."""
    return [
        TransferCode.WORSE_RE_ESTIMATED(groups=result.re_estimate, **_terms(quantity), excess=-gain.gain)
        for quantity, gain in _gains(result, "over_as_is")
        if result.re_estimate and gain.upper < 0.0
    ]


def _errors_before_and_after(result: TransferResult) -> list[Statement]:
    """Return statements on the errors of the model as it is and after re-estimating."""
    reasons = []
    is_held_out = result.period == "validation"
    error = TransferCode.ERROR_HELD_OUT if is_held_out else TransferCode.ERROR_IDENTIFIED
    change = TransferCode.BY_RE_ESTIMATING if result.re_estimate else TransferCode.BY_OWN_OFFSETS
    for quantity, gain in _gains(result, "over_as_is"):
        errors_by_set = result.rmse[quantity]
        values: dict[str, Value] = {**_terms(quantity), "error": error(), "change": change()}
        values |= {"before": errors_by_set["as_is"].total, "after": errors_by_set["re_estimated"].total}
        if math.isnan(gain.lower):
            reasons.append(TransferCode.ERROR_BEFORE_AND_AFTER(**values))
        else:
            bounds = {"gain": gain.gain, "lower": gain.lower, "upper": gain.upper}
            reasons.append(TransferCode.ERROR_GAINED(**values, **bounds))
    return reasons


def _terms(quantity: str) -> dict[str, Value]:
    """Return name and unit of a scored quantity as values of a statement."""
    name, unit = QUANTITY_NAMES[quantity]
    return {"quantity": name, "unit": unit}


def _gains(
    result: TransferResult, reference: Literal["over_as_is", "over_rule"]
) -> Iterator[tuple[str, Reduction]]:
    """Yield, for each quantity, the gain of the re-estimated model over a reference."""
    for quantity, gains_by_model in result.gains.items():
        gain = gains_by_model.get("re_estimated", {}).get(reference)
        if gain is not None:
            yield quantity, gain
