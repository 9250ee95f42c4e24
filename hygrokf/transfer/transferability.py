"""The judgement of a transfer: parameters, groups, likelihood ratios, and the verdict with its reasons."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from hygrokf.estimation.confidence import Uncertainty
from hygrokf.estimation.optimiser import Estimate
from hygrokf.evaluation.scoring import SCORED
from hygrokf.texts.statement import Statement, Value
from hygrokf.texts.transfer_codes import TransferCode, TransferVerdict
from hygrokf.texts.wording import QUANTITIES, RULES
from hygrokf.transfer.baseline import (
    HYGRIC,
    OF_THE_RECORD,
    THERMAL,
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

MATTERS = {
    "ln_time_constant": 0.10,
    "resistance_ratio": 0.05,
    "temperature_K": 0.3,
    "absolute_humidity_g_m3": 0.26,
}
"""Smaller differences do not matter, however significant: 10 % of a time constant, 0.05 of R_AT/(R_AT+R_IC),
and in the simulated readings the paper's loggers' accuracy (0.3 K; 2 % relative humidity, 0.26 g/m³ at 15
°C)."""
WATCHED = {
    THERMAL: {"thermal_time_constant": "ln_time_constant", "resistance_ratio": "resistance_ratio"},
    HYGRIC: {"hygric_k": "ln_time_constant"},
}
"""Parameters that decide whether the difference of a group matters, with their keys of `MATTERS`; for other
groups the effect on the simulated readings decides."""
STRUCTURE = 1.5
"""Free-run error of the record's own model over that of the fit on its own record, beyond which the form is
doubted."""


def matters(group: str, apart: Difference, effect: Mapping[str, float]) -> bool:
    """Whether a group's difference is large enough to matter."""
    if group not in WATCHED:
        return any(effect.get(quantity, 0.0) >= MATTERS[quantity] for quantity in SCORED)
    size = dict(zip(apart.names, np.abs(apart.value), strict=True))
    return any(size.get(name, 0.0) >= MATTERS[key] for name, key in WATCHED[group].items())


def parameters_of(
    baseline: Baseline,
    apart: Difference,
    values: Mapping[str, Mapping[str, float]],
    spread: Uncertainty,
    own: Estimate,
) -> dict[str, ParameterChange]:
    """Every parameter: its original and own value with standard errors, and their difference with bounds."""
    known = {n: i for i, n in enumerate(baseline.origin.names)}
    rows = {}
    for p in baseline.base.model.parameters:
        i, place = known.get(p.name), spread.place(p.name)
        old = new = math.nan
        if i is not None:
            old = math.sqrt(max(float(baseline.origin.covariance[i, i]), 0.0))
        if place is not None:
            sd = math.sqrt(spread.wald[place, place] * spread.factor[place])
            new = sd * abs(p.slope(own.values[p.name]))
        change = None
        if p.name in apart.names:
            change = Contrast(*apart.bounds(p.name))
            if p.positive:
                change = change.ratio
        rows[p.name] = ParameterChange(
            baseline.groups[p.name],
            p.unit,
            p.meaning,
            original=values["as_is"][p.name],
            original_se=old,
            own=own.values[p.name],
            own_se=new if math.isfinite(new) else math.nan,
            re_estimated=values["re_estimated"][p.name],
            difference=change,
            difference_is=None if change is None else "ratio" if p.positive else "difference",
            kept=p.name in baseline.held,
        )
    return rows


def groups_of(
    baseline: Baseline,
    apart: Difference,
    tests: Mapping[str, GroupTest],
    effects: Mapping[str, Mapping[str, float]],
    differing: Sequence[str],
) -> tuple[GroupChange, ...]:
    """For each group the test that decided on it, its effect, and the outcome."""
    rows = []
    for group in dict.fromkeys(baseline.groups.values()):
        names = members(baseline.groups, group)
        if group in OF_THE_RECORD:
            rows.append(GroupChange(group, names, "own", TransferCode.GROUP_OF_THE_RECORD()))
            continue
        if group not in effects:
            rows.append(GroupChange(group, names, "not judged", TransferCode.GROUP_NOT_SHOWN()))
            continue
        test, alone = tests[group], apart.of(names)
        outcome: Outcome = "differs" if group in differing else "travels"
        code = TransferCode.GROUP_ALIKE
        if group in differing:
            code = TransferCode.GROUP_DIFFERS
        elif test.significant:
            code = TransferCode.GROUP_IMMATERIAL
        elif _could_matter(group, alone, effects[group]):
            code = TransferCode.GROUP_OPEN
        effect = dict(effects[group])
        rows.append(GroupChange(group, alone.names, outcome, code(), **vars(test), effect=effect))
    return tuple(rows)


def _could_matter(group: str, alone: Difference, effect: Mapping[str, float]) -> bool:
    """Whether a difference that would matter is within the uncertainty of this record.

    For time constants and the resistance ratio: whether their bounds hold such a difference. For other
    groups: whether the estimate, which is within its bounds, changes the simulation enough to matter.
    """
    if group not in WATCHED:
        return matters(group, alone, effect)
    ends = {key: alone.bounds(name)[1:] for name, key in WATCHED[group].items() if name in alone.names}
    return any(max(-low, high) >= MATTERS[key] for key, (low, high) in ends.items())


def ratios_of(
    baseline: Baseline,
    logger: Estimate,
    adapted: Estimate,
    own: Estimate,
    spread: Uncertainty,
    differing: Sequence[str],
) -> tuple[LikelihoodRatio, ...]:
    """Exact likelihood ratios on this record alone, without the uncertainty of the original values.

    They are scaled by the mean factor by which the real colour of the noise widens bounds (Kent 1982).
    """
    from scipy.stats import chi2

    rows = []
    for first, second, differ, label in (
        (logger, adapted, True, TransferCode.RATIO_OF_DIFFERING()),
        (adapted, own, False, TransferCode.RATIO_OF_REST()),
    ):
        names = tuple(n for n in baseline.cabinet if (baseline.groups[n] in differing) is differ)
        if not names:
            continue
        place = [spread.names.index(n) for n in names if n in spread.names]
        factor = float(np.mean(spread.factor[place])) if place else 1.0
        ratio = max(2.0 * (second.objective - first.objective), 0.0)
        p = float(chi2.sf(ratio / factor, len(names)))
        rows.append(LikelihoodRatio(label, names, ratio, factor, len(names), p))
    return tuple(rows)


# --- the verdict -----------------------------------------------------------------------------


def with_verdict(found: TransferResult) -> TransferResult:
    """The result with its verdict and the reasons, objections first."""
    worse_than_rules, doubts = _against_the_rules(found)
    against = [*_of_the_model(found), *worse_than_rules, *_worse_than_before(found)]
    if against:
        verdict = TransferVerdict.DOES_NOT_TRANSFER
    elif doubts:
        verdict = TransferVerdict.CANNOT_BE_JUDGED
    else:
        verdict = TransferVerdict.PARTLY if found.re_estimate else TransferVerdict.TRANSFERS
    reasons = (*(against or doubts), *_errors_before_and_after(found))
    return replace(found, verdict=verdict, reasons=reasons)


def _of_the_model(found: TransferResult) -> list[Statement]:
    """Objections to the model: no group in common, parameters at bounds, errors of the structure."""
    against = []
    differing = found.re_estimate
    tried = {row.group for row in found.groups if row.outcome in ("travels", "differs")}
    if len(tried) > 1 and tried == set(differing):
        against.append(TransferCode.ALL_GROUPS_DIFFER(groups=differing))
    if found.at_bounds:
        against.append(TransferCode.ENDED_AT_LIMIT(names=found.at_bounds))
    against += [
        TransferCode.STRUCTURE_LACKS(**_terms(quantity), error=row.rmse, ratio=row.ratio)
        for quantity, row in found.structure.items()
        if row.lower > STRUCTURE
    ]
    return against


def _against_the_rules(found: TransferResult) -> tuple[list[Statement], list[Statement]]:
    """Objections and doubts where a rule without a model errs less than the re-estimated model."""
    against, doubts = [], []
    for quantity, over in _gains(found, "over_rule"):
        values = {**_terms(quantity), "excess": -over.gain, "rule": RULES.get(over.against, over.against)}
        if math.isnan(over.upper) and over.gain < 0.0:
            doubts.append(TransferCode.RULE_BETTER_UNBOUNDED(**values, readings=found.n_readings))
        if over.upper < 0.0:
            against.append(TransferCode.RULE_BETTER(**values))
    return against, doubts


def _worse_than_before(found: TransferResult) -> list[Statement]:
    """Objections where re-estimating enlarges the error beyond its bounds."""
    return [
        TransferCode.WORSE_RE_ESTIMATED(groups=found.re_estimate, **_terms(quantity), excess=-gain.gain)
        for quantity, gain in _gains(found, "over_as_is")
        if found.re_estimate and gain.upper < 0.0
    ]


def _errors_before_and_after(found: TransferResult) -> list[Statement]:
    reasons = []
    held_out = found.period == "validation"
    error = TransferCode.ERROR_HELD_OUT if held_out else TransferCode.ERROR_IDENTIFIED
    change = TransferCode.BY_RE_ESTIMATING if found.re_estimate else TransferCode.BY_OWN_OFFSETS
    for quantity, gain in _gains(found, "over_as_is"):
        table = found.rmse[quantity]
        values: dict[str, Value] = {**_terms(quantity), "error": error(), "change": change()}
        values |= {"before": table["as_is"].total, "after": table["re_estimated"].total}
        if math.isnan(gain.lower):
            reasons.append(TransferCode.ERROR_BEFORE_AND_AFTER(**values))
        else:
            bounds = {"gain": gain.gain, "lower": gain.lower, "upper": gain.upper}
            reasons.append(TransferCode.ERROR_GAINED(**values, **bounds))
    return reasons


def _terms(quantity: str) -> dict[str, Value]:
    """The name and the unit of a scored quantity, for a statement."""
    name, unit = QUANTITIES[quantity]
    return {"quantity": name, "unit": unit}


def _gains(
    found: TransferResult, over: Literal["over_as_is", "over_rule"]
) -> Iterator[tuple[str, Reduction]]:
    for quantity, rows in found.gains.items():
        gain = rows.get("re_estimated", {}).get(over)
        if gain is not None:
            yield quantity, gain
