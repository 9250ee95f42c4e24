"""The verdict on a time constant: whether it is reliable, and the evidence against it.

A verdict is decided once, at the end of a fit, from its results.  Everything that uses the number inherits
the verdict: pages, commands, forecasts, alarms.  Each rule examines one kind of evidence and returns reasons;
the worst reason decides, and a number without any reason against it is believed.

A reason is "reject" where the evidence contradicts the number, or where the record does not determine it.  It
is "caution" where the evidence is weak, or where it affects the interval but not the number.

A further rule takes one function `rule(fit, part) -> reasons` in `VERDICT_RULES`, a code in `ReasonCode`, and
one row in docs/explanation/verdict.md.
`fit` are the results of a fit, of which parts may be missing; `part` is "thermal" or "hygric".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from hygrokf.estimation.optimiser import INEXACT
from hygrokf.evaluation.innovation_tests import SMALL_CORRELATION, OutputDiagnosis
from hygrokf.identification.fit_results import FitResults, ParameterRow, Sampling, TimeConstant
from hygrokf.identification.verdict_terms import (
    JUDGED_PERIODS,
    PARAMETER_OF,
    QUANTITY_OF,
    Inherited,
    Interval,
)
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.parts import BOTH_PARTS, PARTS
from hygrokf.texts.reasons import CAUTION, REJECT, VERDICTS, Reason, ReasonCode, verdict_of, worst_first
from hygrokf.texts.statement import Statement
from hygrokf.texts.wording import BASELINES, QUANTITY_NAMES

TIGHT = 0.25
"""[1] largest relative half-width of the interval of a well-determined time constant."""
DECADE = 10.0
"""[1] ratio of upper to lower bound above which not even the order of magnitude is known."""
CONTRADICTION = 2.0
"""[1] distance of the two criteria, in units of their joint uncertainty, above which they contradict each
other."""
SAYING = 3.0
"""[1] ratio of upper to lower bound of the free run's time constant below which it is informative."""
MATERIAL = 0.1
"""[1] relative difference of an error from a rule's error, or change of a time constant, that is worth
mentioning."""
CARRIES_OVER = 1.25
"""[1] largest ratio of validation to identification error of a model that generalises."""
COVERAGE = (0.90, 0.985)
"""[1] acceptable shares of readings within a 95 % band."""
FAILED_SHARE = 0.5
"""[1] share within the free run's 95 % band below which the free run is unreliable."""
FEWEST_IN_BAND = 20
"""Fewest readings for a meaningful share within a band."""
SCATTER = 2.0
"""[1] ratio of the score's variance to the model's above which most of the scatter is not explained by the
model."""
STRETCHED = 3.0
"""[1] prior standard deviations above which a constant sensor error is no longer attributed to the sensor."""
PER_PARAMETER = 20.0
"""Readings per estimated parameter below which asymptotic bounds are doubtful."""
CONSTANTS = 20.0
"""[1] length of the identification period, in time constants, below which it cannot determine the time
constant."""
FORGOTTEN = 2.0
"""[1] step between readings, in time constants, above which they hardly show the decay: 14 % of a change is
left."""
PARTS_SCATTER = 2.0
"""[1] ratio of the scatter of estimates from quarters of the record to their bounds; exceeds 1.6 by chance in
5 %."""
CREDIBLE = 0.1
"""[1] weight above which another form of the model is considered."""

_OUTPUTS = {part.name: part.output for part in BOTH_PARTS}


# --- deciding --------------------------------------------------------------------------------


def inherited(fit: FitResults) -> dict[str, Inherited]:
    """Value, interval, verdict and reasons of a fit's time constants, by part; missing verdicts are
    decided."""
    found = {}
    for part in PARTS:
        if part in fit.time_constants:
            one = fit.time_constants[part]
            decided = (
                (reason for rule in VERDICT_RULES for reason in rule(fit, part)) if not one.verdict else ()
            )
            reasons = one.reasons if one.verdict else worst_first(decided)
            verdict = one.verdict or verdict_of(reasons)
            found[part] = Inherited(one.value_h, one.lower_h, one.upper_h, verdict, reasons)
    return found


def with_verdicts(fit: FitResults) -> FitResults:
    """The results with a verdict on each time constant that lacks one."""
    return with_reasons(fit, "", ())


def with_reasons(fit: FitResults, part: str, further: Iterable[Reason]) -> FitResults:
    """The results with verdicts, and with further reasons against a time constant; those already present are
    not repeated."""
    judged = dict(fit.time_constants)
    for name, one in inherited(fit).items():
        present = {(known.code, known.verdict) for known in one.reasons}
        new = [more for more in (further if name == part else ()) if (more.code, more.verdict) not in present]
        reasons = worst_first((*one.reasons, *new))
        verdict = max((one.verdict, verdict_of(reasons)), key=VERDICTS.index)
        judged[name] = replace(judged[name], verdict=verdict, reasons=reasons)
    return replace(fit, time_constants=judged)


# --- the rules -------------------------------------------------------------------------------


def _convergence(fit: FitResults, part: str) -> Iterator[Reason]:
    if fit.converged is None:
        yield ReasonCode.CONVERGENCE_UNKNOWN()
    elif not fit.converged:
        yield ReasonCode.NOT_CONVERGED(why=(FitCode.BECAUSE(why=fit.messages),) if fit.messages else ())
    if fit.discretisation_error > INEXACT:
        yield ReasonCode.NOT_EXACT(change=fit.discretisation_error)


def _interval(fit: FitResults, part: str) -> Iterator[Reason]:
    """Reasons from the interval itself: open, ended by the search limit, or wide."""
    data = fit.time_constants[part]
    low, high, without = data.lower_h, data.upper_h, data.without_input
    if PARAMETER_OF[part] in fit.at_bounds:
        yield ReasonCode.AT_LIMIT(value_h=data.value_h)
    if without is not None and not without.enough:
        how = FitCode.EXPLAINS_BETTER if without.gain < 0 else FitCode.EXPLAINS_AS_WELL
        yield ReasonCode.INPUT_NOT_NEEDED(
            model=without.model, how=how(by=abs(without.gain)), required=without.required
        )
    elif not math.isfinite(data.value_h) or not (low > 0 or math.isfinite(high)):
        yield ReasonCode.NOT_IDENTIFIABLE()
    elif not low > 0:
        yield ReasonCode.ONE_SIDED(side="above", sign="≤", bound_h=high)
    elif not math.isfinite(high):
        yield ReasonCode.ONE_SIDED(side="below", sign="≥", bound_h=low)
    elif high > DECADE * low:
        yield ReasonCode.UNDETERMINED(spread=data.spread, lower_h=low, upper_h=high)
    elif not data.half_width <= TIGHT:
        yield ReasonCode.IMPRECISE(spread=data.spread, half_width=data.half_width)


def _guards(fit: FitResults, part: str) -> Iterator[Reason]:
    """Other parameters that ended at a guard of their search."""
    rows = _rows(fit, part)
    names = tuple(name for name, row in rows if row.at_guard and name != PARAMETER_OF[part])
    if names:
        yield ReasonCode.GUARD_REACHED(names=names)


def _sensors(fit: FitResults, part: str) -> Iterator[Reason]:
    """Constant sensor errors that absorb a deficiency of the model."""
    for name, row in _rows(fit, part):
        if name.endswith(("_bias", "_offset")) and row.prior is not None and row.prior.sd > 0:
            apart = abs(row.value - row.prior.mean) / row.prior.sd
            if apart > STRETCHED:
                yield ReasonCode.SENSOR_STRETCHED(
                    name=name, error=row.value, unit=row.unit, standard_deviations=apart
                )


def _rows(fit: FitResults, part: str) -> list[tuple[str, ParameterRow]]:
    """The parameters estimated together with a time constant; all parameters where that is not stated."""
    return [(name, row) for name, row in fit.parameters.items() if part in (row.parts or PARTS)]


def _criteria(fit: FitResults, part: str) -> Iterator[Reason]:
    """Comparison of the free run's own best constant with that of the one-step predictions."""
    data = fit.time_constants[part]
    if data.simulation is None:
        return
    other, low, high = data.simulation.value_h, data.simulation.lower_h, data.simulation.upper_h
    if data.criteria_disagree:
        apart, own = criteria_apart(data), (data.likelihood or data).value_h
        held = not any(value < data.lower_h or value > data.upper_h for value in (other, own))
        yield ReasonCode.CRITERIA_DISAGREE(
            REJECT if apart > CONTRADICTION and not held else CAUTION,
            likelihood_h=own,
            simulation_h=other,
            simulation_lower_h=low,
            simulation_upper_h=high,
            apart=apart,
        )
    elif not free_run_informs(data) and data.likelihood is None:
        closed = low > 0 and math.isfinite(high)
        within = FitCode.WITHIN_BOUNDS(lower_h=low, upper_h=high)
        bounds = within if closed else FitCode.WITHOUT_BOUNDS()
        yield ReasonCode.FREE_RUN_SILENT(simulation_h=other, bounds=bounds)


def free_run_informs(data: TimeConstant) -> bool:
    """Whether the free run's own estimate of a time constant has informative bounds."""
    free = data.simulation or Interval()
    return free.lower_h > 0 and free.upper_h < SAYING * free.lower_h


def criteria_apart(data: TimeConstant) -> float:
    """Distance between the estimates by one-step predictions and by the free run, in units of their joint
    uncertainty.

    Above 1 they disagree; infinite where either has no interval.
    """
    ends = []
    for one in (data.likelihood or data.profile or data, data.simulation or Interval()):
        if not (one.value_h > 0 and 0 < one.lower_h < one.upper_h):
            return math.inf
        ends.append((math.log(one.value_h), 0.5 * math.log(one.upper_h / one.lower_h)))
    (a, reach_a), (b, reach_b) = ends
    return abs(a - b) / math.hypot(reach_a, reach_b)


def _free_run(fit: FitResults, part: str) -> Iterator[Reason]:
    """Comparison of the free run with rules that need no model, and with its own band."""
    quantity, data = QUANTITY_OF[part], fit.time_constants[part]
    scored = [p for p in JUDGED_PERIODS if math.isfinite(fit.errors(p, quantity).total)]
    beyond = [one for p in scored for one in _worse_than_mean(fit, quantity, p)]
    if beyond:
        yield replace(beyond[0], verdict=REJECT if len(beyond) == len(scored) else CAUTION)
    asked = data.simulation is not None
    alone = asked and (not free_run_informs(data) or data.criteria_disagree)
    but = () if not asked else ((FitCode.OWN_BEST_DIFFERS if alone else FitCode.OWN_BEST_AGREES)(),)
    worse = [one for p in scored for one in _worse_than_rule(fit, quantity, p, but)]
    if worse:
        yield replace(worse[0], verdict=REJECT if alone and len(worse) == len(scored) else CAUTION)
    yield from _failed_band(fit, quantity)


def free_run_reasons(fit: FitResults, part: str) -> Iterator[Reason]:
    """What speaks for and against the free run's errors themselves."""
    quantity = QUANTITY_OF[part]
    early, late = (fit.errors(period, quantity).total for period in reversed(JUDGED_PERIODS))
    period = "validation" if math.isfinite(late) else "identification"
    if beyond := [one for p in JUDGED_PERIODS for one in _worse_than_mean(fit, quantity, p)]:
        yield beyond[0]
        return
    if not math.isfinite(late):
        yield ReasonCode.NOT_VALIDATED()
    elif 0 < CARRIES_OVER * early < late:
        yield ReasonCode.WORSE_ON_NEW_DATA()
    worse, rule = [*_worse_than_rule(fit, quantity, period)], best_rule(fit, quantity, period)
    yield from worse
    if rule is not None and not worse:
        code = ReasonCode.BETTER_THAN_RULE if rule.gain >= MATERIAL else ReasonCode.NO_BETTER_THAN_RULE
        unit = QUANTITY_NAMES[quantity][1]
        yield code(rule=rule.words, rule_error=rule.rule, gain=rule.gain, unit=unit)
    yield from (replace(one, verdict=REJECT) for one in _failed_band(fit, quantity))


def _worse_than_mean(fit: FitResults, quantity: str, period: str) -> Iterator[Reason]:
    error, (name, unit) = fit.errors(period, quantity).total, QUANTITY_NAMES[quantity]
    spread = fit.readings_sd.get(period, {}).get(quantity, math.nan)
    if error > spread:
        said = {"quantity": name, "unit": unit, "period": period}
        yield ReasonCode.WORSE_THAN_MEAN(error=error, readings_sd=spread, **said)


def _worse_than_rule(
    fit: FitResults, quantity: str, period: str, but: tuple[Statement, ...] = ()
) -> Iterator[Reason]:
    rule, (name, unit) = best_rule(fit, quantity, period), QUANTITY_NAMES[quantity]
    if rule is not None and rule.gain < -MATERIAL:
        said = {"quantity": name, "unit": unit, "period": period, "rule": rule.words}
        yield ReasonCode.WORSE_THAN_RULE(error=rule.error, rule_error=rule.rule, but=but, **said)


def _failed_band(fit: FitResults, quantity: str) -> Iterator[Reason]:
    band = fit.band("free_run", quantity)
    if band.coverage < FAILED_SHARE and band.n >= FEWEST_IN_BAND:
        yield ReasonCode.BAND_FAILED(coverage=band.coverage, quantity=QUANTITY_NAMES[quantity][0])


@dataclass(frozen=True)
class SimpleRule:
    """The best rule that needs no model in one period: its words, its error, the model's error, and the
    model's gain [1]."""

    words: str
    rule: float
    error: float

    @property
    def gain(self) -> float:
        return 1.0 - self.error / self.rule


def best_rule(fit: FitResults, quantity: str, period: str) -> SimpleRule | None:
    """The rule with the smallest error in a period, with the free run's error there; None where nothing was
    scored."""
    error = fit.errors(period, quantity).total
    rules = {
        words: value
        for key, words in BASELINES[quantity].items()
        if (value := fit.rule_errors(period, key, quantity).total) > 0
    }
    if not rules or not math.isfinite(error):
        return None
    words = min(rules, key=lambda one: rules[one])
    return SimpleRule(words, rules[words], error)


def _innovations(fit: FitResults, part: str) -> Iterator[Reason]:
    """Correlated one-step predictions, and scores that vary more than the model explains."""
    size, beside = largest_correlation(fit, _OUTPUTS[part])
    if size >= SMALL_CORRELATION and beside is not None:
        quantity = QUANTITY_NAMES[QUANTITY_OF[part]][0]
        yield ReasonCode.INNOVATIONS_CORRELATED(correlation=size, beside=beside, quantity=quantity)
    factor = fit.time_constants[part].factor
    if factor > SCATTER:
        yield ReasonCode.NOISE_NOT_AS_MODELLED(factor=factor)


def largest_correlation(fit: FitResults, output: str) -> tuple[float, Statement | None]:
    """The largest correlation [1] of an output's innovations that a test rejects, and its other variable; (0,
    None) without one."""
    data = fit.innovations.outputs.get(output, OutputDiagnosis())
    rejected = {
        (row.test, row.input) for row in fit.innovations.tests if row.output == output and row.rejected
    }
    found = [("autocorrelation", "", data.autocorrelation)]
    found += [("correlation", name, one) for name, one in data.cross_correlation.items()]
    sizes = [
        (size, name)
        for test, name, one in found
        if one is not None and (test, name) in rejected
        for size in (float(np.max(np.abs(one.value), initial=0.0)),)
        if size > np.nan_to_num(one.limit_all)
    ]
    if not sizes:
        return 0.0, None
    size, name = max(sizes)
    return size, FitCode.THE_INPUT(input=name) if name else FitCode.EARLIER_INNOVATIONS()


def _data(fit: FitResults, part: str) -> Iterator[Reason]:
    """Too few or too widely spaced readings, a record too short for the number, and doubts about the record
    that concern it."""
    data = fit.time_constants[part]
    value, low, high = data.value_h, data.lower_h, data.upper_h
    sampling = data.sampling or Sampling()
    shift, step = sampling.shift_ln_when_halved, sampling.ambient_step_h
    reach = 0.5 * math.log(high / low) if 0 < low < high < math.inf else math.inf
    if abs(shift) > max(reach, MATERIAL):
        yield ReasonCode.AMBIENT_COARSE(shift=math.expm1(shift), ambient_step_min=60.0 * step)
    output = fit.innovations.outputs.get(_OUTPUTS[part])
    n, every = (math.nan, math.nan) if output is None else (output.n, output.step_h)
    if every > FORGOTTEN * value:
        yield ReasonCode.READINGS_COARSE(step_min=60.0 * every, decayed=1.0 - math.exp(-every / value))
    free = sum(not row.fixed for _, row in _rows(fit, part))
    if n < PER_PARAMETER * free:
        yield ReasonCode.FEW_READINGS(readings=n, parameters=free)
    length = _hours(fit.period.start, fit.period.until or fit.period.end)
    if length < CONSTANTS * value:
        yield ReasonCode.RECORD_SHORT(time_constants=length / value)
    for doubt in fit.doubts_about(part):
        yield ReasonCode.RECORD_DOUBTED(doubt=doubt)


def _hours(start: str | None, end: str | None) -> float:
    """Hours between two ISO 8601 stamps; NaN where they are not stamps."""
    try:
        first, last = (datetime.fromisoformat(one or "") for one in (start, end))
        return (last - first).total_seconds() / 3600.0
    except (ValueError, TypeError):
        return math.nan


def _other_estimates(fit: FitResults, part: str) -> Iterator[Reason]:
    """Other forms of the model outside the interval, and parts of the record that differ."""
    data = fit.time_constants[part]
    for one in data.forms:
        if one.weight >= CREDIBLE and (one.value_h < data.lower_h or one.value_h > data.upper_h):
            yield ReasonCode.FORMS_DIFFER(form=one.form, weight=one.weight, other_h=one.value_h)
    if data.parts_scatter > PARTS_SCATTER:
        yield ReasonCode.PARTS_DIFFER(scatter=data.parts_scatter)


VERDICT_RULES: tuple[Callable[[FitResults, str], Iterable[Reason]], ...] = (
    _convergence,
    _interval,
    _criteria,
    _free_run,
    _innovations,
    _data,
    _sensors,
    _guards,
    _other_estimates,
)
"""Reasons of equal weight are reported in this order."""
