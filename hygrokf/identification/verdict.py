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
"""[1] ratio of upper to lower bound below which the free run's own time constant is informative."""
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
"""[1] ratio of the score's variance to that of the model above which most of the scatter is unexplained."""
STRETCHED = 3.0
"""[1] prior standard deviations above which a constant sensor error is probably not the sensor's."""
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
    """Return value, interval, verdict and reasons of a fit's time constants, by part ("thermal", "hygric").

    Missing verdicts are decided by `VERDICT_RULES`.
    """
    inherited_by_part = {}
    for part in PARTS:
        if part in fit.time_constants:
            constant = fit.time_constants[part]
            reasons_of_rules = (
                (reason for rule in VERDICT_RULES for reason in rule(fit, part))
                if not constant.verdict
                else ()
            )
            reasons = constant.reasons if constant.verdict else worst_first(reasons_of_rules)
            verdict = constant.verdict or verdict_of(reasons)
            inherited_by_part[part] = Inherited(
                constant.value_h, constant.lower_h, constant.upper_h, verdict, reasons
            )
    return inherited_by_part


def with_verdicts(fit: FitResults) -> FitResults:
    """The results with a verdict on each time constant that lacks one."""
    return with_reasons(fit, "", ())


def with_reasons(fit: FitResults, part: str, further: Iterable[Reason]) -> FitResults:
    """Return the results with verdicts, and with further reasons against one time constant; none is
    repeated."""
    constants = dict(fit.time_constants)
    for name, constant in inherited(fit).items():
        known_reasons = {(known.code, known.verdict) for known in constant.reasons}
        new_reasons = [
            more
            for more in (further if name == part else ())
            if (more.code, more.verdict) not in known_reasons
        ]
        reasons = worst_first((*constant.reasons, *new_reasons))
        verdict = max((constant.verdict, verdict_of(reasons)), key=VERDICTS.index)
        constants[name] = replace(constants[name], verdict=verdict, reasons=reasons)
    return replace(fit, time_constants=constants)


# --- the rules -------------------------------------------------------------------------------


def _convergence(fit: FitResults, part: str) -> Iterator[Reason]:
    """Reasons from the search: it did not converge, or its steps were not exact."""
    if fit.converged is None:
        yield ReasonCode.CONVERGENCE_UNKNOWN()
    elif not fit.converged:
        yield ReasonCode.NOT_CONVERGED(why=(FitCode.BECAUSE(why=fit.messages),) if fit.messages else ())
    if fit.discretisation_error > INEXACT:
        yield ReasonCode.NOT_EXACT(change=fit.discretisation_error)


def _interval(fit: FitResults, part: str) -> Iterator[Reason]:
    """Reasons from the interval: it is open, ended by a limit of the search, or wide."""
    data = fit.time_constants[part]
    lower, upper, without = data.lower_h, data.upper_h, data.without_input
    if PARAMETER_OF[part] in fit.at_bounds:
        yield ReasonCode.AT_LIMIT(value_h=data.value_h)
    if without is not None and not without.enough:
        comparison = FitCode.EXPLAINS_BETTER if without.gain < 0 else FitCode.EXPLAINS_AS_WELL
        yield ReasonCode.INPUT_NOT_NEEDED(
            model=without.model, how=comparison(by=abs(without.gain)), required=without.required
        )
    elif not math.isfinite(data.value_h) or not (lower > 0 or math.isfinite(upper)):
        yield ReasonCode.NOT_IDENTIFIABLE()
    elif not lower > 0:
        yield ReasonCode.ONE_SIDED(side="above", sign="≤", bound_h=upper)
    elif not math.isfinite(upper):
        yield ReasonCode.ONE_SIDED(side="below", sign="≥", bound_h=lower)
    elif upper > DECADE * lower:
        yield ReasonCode.UNDETERMINED(spread=data.spread, lower_h=lower, upper_h=upper)
    elif not data.half_width <= TIGHT:
        yield ReasonCode.IMPRECISE(spread=data.spread, half_width=data.half_width)


def _guards(fit: FitResults, part: str) -> Iterator[Reason]:
    """Reason if another parameter ended at a limit of its search that is not physical."""
    rows = _rows(fit, part)
    names = tuple(name for name, row in rows if row.at_guard and name != PARAMETER_OF[part])
    if names:
        yield ReasonCode.GUARD_REACHED(names=names)


def _sensors(fit: FitResults, part: str) -> Iterator[Reason]:
    """Reasons if a constant sensor error is so large that it stands for a deficiency of the model."""
    for name, row in _rows(fit, part):
        if name.endswith(("_bias", "_offset")) and row.prior is not None and row.prior.sd > 0:
            deviations = abs(row.value - row.prior.mean) / row.prior.sd
            if deviations > STRETCHED:
                yield ReasonCode.SENSOR_STRETCHED(
                    name=name, error=row.value, unit=row.unit, standard_deviations=deviations
                )


def _rows(fit: FitResults, part: str) -> list[tuple[str, ParameterRow]]:
    """Return the parameters that were estimated together with a time constant; all where that is not
    stated."""
    return [(name, row) for name, row in fit.parameters.items() if part in (row.parts or PARTS)]


def _criteria(fit: FitResults, part: str) -> Iterator[Reason]:
    """Reason from the comparison of the free run's own best time constant with that of the one-step
    predictions."""
    data = fit.time_constants[part]
    if data.simulation is None:
        return
    by_simulation, lower, upper = data.simulation.value_h, data.simulation.lower_h, data.simulation.upper_h
    if data.criteria_disagree:
        distance, by_likelihood = criteria_apart(data), (data.likelihood or data).value_h
        both_inside = not any(
            estimate < data.lower_h or estimate > data.upper_h for estimate in (by_simulation, by_likelihood)
        )
        yield ReasonCode.CRITERIA_DISAGREE(
            REJECT if distance > CONTRADICTION and not both_inside else CAUTION,
            likelihood_h=by_likelihood,
            simulation_h=by_simulation,
            simulation_lower_h=lower,
            simulation_upper_h=upper,
            apart=distance,
        )
    elif not free_run_informs(data) and data.likelihood is None:
        is_closed = lower > 0 and math.isfinite(upper)
        within_bounds = FitCode.WITHIN_BOUNDS(lower_h=lower, upper_h=upper)
        bounds = within_bounds if is_closed else FitCode.WITHOUT_BOUNDS()
        yield ReasonCode.FREE_RUN_SILENT(simulation_h=by_simulation, bounds=bounds)


def free_run_informs(data: TimeConstant) -> bool:
    """Whether the free run's own estimate of a time constant has informative bounds."""
    free = data.simulation or Interval()
    return free.lower_h > 0 and free.upper_h < SAYING * free.lower_h


def criteria_apart(data: TimeConstant) -> float:
    """Return the distance between the one-step and the free-run estimate, in units of their joint
    uncertainty.

    Above 1 they disagree; it is infinite where either has no interval.
    """
    centres_and_widths = []
    for interval in (data.likelihood or data.profile or data, data.simulation or Interval()):
        if not (interval.value_h > 0 and 0 < interval.lower_h < interval.upper_h):
            return math.inf
        centres_and_widths.append(
            (math.log(interval.value_h), 0.5 * math.log(interval.upper_h / interval.lower_h))
        )
    (first, first_half_width), (second, second_half_width) = centres_and_widths
    return abs(first - second) / math.hypot(first_half_width, second_half_width)


def _free_run(fit: FitResults, part: str) -> Iterator[Reason]:
    """Reasons from the free run: worse than the mean, than a rule without a model, or outside of its own
    band."""
    quantity, data = QUANTITY_OF[part], fit.time_constants[part]
    scored_periods = [
        period for period in JUDGED_PERIODS if math.isfinite(fit.errors(period, quantity).total)
    ]
    worse_than_mean = [
        reason for period in scored_periods for reason in _worse_than_mean(fit, quantity, period)
    ]
    if worse_than_mean:
        yield replace(
            worse_than_mean[0], verdict=REJECT if len(worse_than_mean) == len(scored_periods) else CAUTION
        )
    has_own_estimate = data.simulation is not None
    not_supported = has_own_estimate and (not free_run_informs(data) or data.criteria_disagree)
    own_estimate = (
        ()
        if not has_own_estimate
        else ((FitCode.OWN_BEST_DIFFERS if not_supported else FitCode.OWN_BEST_AGREES)(),)
    )
    worse_than_rule = [
        reason
        for period in scored_periods
        for reason in _worse_than_rule(fit, quantity, period, own_estimate)
    ]
    if worse_than_rule:
        yield replace(
            worse_than_rule[0],
            verdict=REJECT if not_supported and len(worse_than_rule) == len(scored_periods) else CAUTION,
        )
    yield from _failed_band(fit, quantity)


def free_run_reasons(fit: FitResults, part: str) -> Iterator[Reason]:
    """Yield what speaks for and against the free run itself."""
    quantity = QUANTITY_OF[part]
    identification_error, validation_error = (
        fit.errors(period, quantity).total for period in reversed(JUDGED_PERIODS)
    )
    period = "validation" if math.isfinite(validation_error) else "identification"
    if worse_than_mean := [
        reason for one_period in JUDGED_PERIODS for reason in _worse_than_mean(fit, quantity, one_period)
    ]:
        yield worse_than_mean[0]
        return
    if not math.isfinite(validation_error):
        yield ReasonCode.NOT_VALIDATED()
    elif 0 < CARRIES_OVER * identification_error < validation_error:
        yield ReasonCode.WORSE_ON_NEW_DATA()
    worse_than_rule, rule = [*_worse_than_rule(fit, quantity, period)], best_rule(fit, quantity, period)
    yield from worse_than_rule
    if rule is not None and not worse_than_rule:
        code = ReasonCode.BETTER_THAN_RULE if rule.gain >= MATERIAL else ReasonCode.NO_BETTER_THAN_RULE
        unit = QUANTITY_NAMES[quantity][1]
        yield code(rule=rule.words, rule_error=rule.rule, gain=rule.gain, unit=unit)
    yield from (replace(reason, verdict=REJECT) for reason in _failed_band(fit, quantity))


def _worse_than_mean(fit: FitResults, quantity: str, period: str) -> Iterator[Reason]:
    """Reason if the free run's error is larger than the standard deviation of the readings."""
    error, (name, unit) = fit.errors(period, quantity).total, QUANTITY_NAMES[quantity]
    readings_sd = fit.readings_sd.get(period, {}).get(quantity, math.nan)
    if error > readings_sd:
        where = {"quantity": name, "unit": unit, "period": period}
        yield ReasonCode.WORSE_THAN_MEAN(error=error, readings_sd=readings_sd, **where)


def _worse_than_rule(
    fit: FitResults, quantity: str, period: str, remark: tuple[Statement, ...] = ()
) -> Iterator[Reason]:
    """Reason if the free run's error is clearly larger than that of the best rule without a model."""
    rule, (name, unit) = best_rule(fit, quantity, period), QUANTITY_NAMES[quantity]
    if rule is not None and rule.gain < -MATERIAL:
        what = {"quantity": name, "unit": unit, "period": period, "rule": rule.words}
        yield ReasonCode.WORSE_THAN_RULE(error=rule.error, rule_error=rule.rule, but=remark, **what)


def _failed_band(fit: FitResults, quantity: str) -> Iterator[Reason]:
    """Reason if the free run's 95 % band contains too few readings."""
    band = fit.band("free_run", quantity)
    if band.coverage < FAILED_SHARE and band.n >= FEWEST_IN_BAND:
        yield ReasonCode.BAND_FAILED(coverage=band.coverage, quantity=QUANTITY_NAMES[quantity][0])


@dataclass(frozen=True)
class SimpleRule:
    """The best prediction rule that needs no model, in one period.

    `words`: its name.  `rule`, `error`: its error and the model's.
    """

    words: str
    rule: float
    error: float

    @property
    def gain(self) -> float:
        """[1] relative decrease of the error by the model."""
        return 1.0 - self.error / self.rule


def best_rule(fit: FitResults, quantity: str, period: str) -> SimpleRule | None:
    """Return the rule with the smallest error in a period; None where nothing was scored."""
    error = fit.errors(period, quantity).total
    rules = {
        words: value
        for key, words in BASELINES[quantity].items()
        if (value := fit.rule_errors(period, key, quantity).total) > 0
    }
    if not rules or not math.isfinite(error):
        return None
    words = min(rules, key=lambda rule_words: rules[rule_words])
    return SimpleRule(words, rules[words], error)


def _innovations(fit: FitResults, part: str) -> Iterator[Reason]:
    """Reasons from the innovations: they are correlated, or scatter more than the model explains."""
    correlation, other_variable = largest_correlation(fit, _OUTPUTS[part])
    if correlation >= SMALL_CORRELATION and other_variable is not None:
        quantity = QUANTITY_NAMES[QUANTITY_OF[part]][0]
        yield ReasonCode.INNOVATIONS_CORRELATED(
            correlation=correlation, beside=other_variable, quantity=quantity
        )
    factor = fit.time_constants[part].factor
    if factor > SCATTER:
        yield ReasonCode.NOISE_NOT_AS_MODELLED(factor=factor)


def largest_correlation(fit: FitResults, output: str) -> tuple[float, Statement | None]:
    """Return the largest significant correlation [1] of an output's innovations, and with what; (0, None)
    without one."""
    data = fit.innovations.outputs.get(output, OutputDiagnosis())
    rejected = {
        (row.test, row.input) for row in fit.innovations.tests if row.output == output and row.rejected
    }
    tested_correlations = [("autocorrelation", "", data.autocorrelation)]
    tested_correlations += [
        ("correlation", name, correlation) for name, correlation in data.cross_correlation.items()
    ]
    significant = [
        (size, name)
        for test, name, correlation in tested_correlations
        if correlation is not None and (test, name) in rejected
        for size in (float(np.max(np.abs(correlation.value), initial=0.0)),)
        if size > np.nan_to_num(correlation.limit_all)
    ]
    if not significant:
        return 0.0, None
    size, name = max(significant)
    return size, FitCode.THE_INPUT(input=name) if name else FitCode.EARLIER_INNOVATIONS()


def _data(fit: FitResults, part: str) -> Iterator[Reason]:
    """Reasons from the readings: too few, too widely spaced, over too short a time, or doubted."""
    data = fit.time_constants[part]
    value, lower, upper = data.value_h, data.lower_h, data.upper_h
    sampling = data.sampling or Sampling()
    change, ambient_step_h = sampling.shift_ln_when_halved, sampling.ambient_step_h
    half_width = 0.5 * math.log(upper / lower) if 0 < lower < upper < math.inf else math.inf
    if abs(change) > max(half_width, MATERIAL):
        yield ReasonCode.AMBIENT_COARSE(shift=math.expm1(change), ambient_step_min=60.0 * ambient_step_h)
    output = fit.innovations.outputs.get(_OUTPUTS[part])
    readings, step_h = (math.nan, math.nan) if output is None else (output.n, output.step_h)
    if step_h > FORGOTTEN * value:
        yield ReasonCode.READINGS_COARSE(step_min=60.0 * step_h, decayed=1.0 - math.exp(-step_h / value))
    free_parameters = sum(not row.fixed for _, row in _rows(fit, part))
    if readings < PER_PARAMETER * free_parameters:
        yield ReasonCode.FEW_READINGS(readings=readings, parameters=free_parameters)
    length = _hours(fit.period.start, fit.period.until or fit.period.end)
    if length < CONSTANTS * value:
        yield ReasonCode.RECORD_SHORT(time_constants=length / value)
    for doubt in fit.doubts_about(part):
        yield ReasonCode.RECORD_DOUBTED(doubt=doubt)


def _hours(start: str | None, end: str | None) -> float:
    """Return the hours between two ISO 8601 stamps; NaN where they are not stamps."""
    try:
        start_time, end_time = (datetime.fromisoformat(stamp or "") for stamp in (start, end))
        return (end_time - start_time).total_seconds() / 3600.0
    except (ValueError, TypeError):
        return math.nan


def _other_estimates(fit: FitResults, part: str) -> Iterator[Reason]:
    """Reasons from other estimates: another likely form lies outside of the interval, or parts of the record
    differ."""
    data = fit.time_constants[part]
    for estimate in data.forms:
        if estimate.weight >= CREDIBLE and (
            estimate.value_h < data.lower_h or estimate.value_h > data.upper_h
        ):
            yield ReasonCode.FORMS_DIFFER(
                form=estimate.form, weight=estimate.weight, other_h=estimate.value_h
            )
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
