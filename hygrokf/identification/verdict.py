"""The verdict on a time constant: whether it is reliable, and the evidence against it.

A verdict is decided once, at the end of a fit, from its results.  Everything that uses the number inherits
the verdict: pages, commands, forecasts, alarms.  Each rule examines one kind of evidence and returns reasons;
the worst reason decides, and a number without any reason against it is believed.

A reason is "reject" where the evidence contradicts the number, or where the record does not determine it.  It
is "caution" where the evidence is weak, or where it affects the interval but not the number.

A further rule takes one function `rule(fit, part) -> reasons` in `RULES` and one row in
docs/explanation/verdict.md.
`fit` are the results of a fit, of which parts may be missing; `part` is "thermal" or "hygric".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.estimation.optimiser import INEXACT
from hygrokf.evaluation.diagnosis import Autocorrelation, CrossCorrelation, OutputDiagnosis
from hygrokf.evaluation.innovation_tests import SMALL
from hygrokf.identification.fit_results import FitResults, Interval, ParameterRow, Sampling, TimeConstant
from hygrokf.identification.verdict_terms import (
    CAUTION,
    PARAMETER_OF,
    PERIODS,
    QUANTITY_OF,
    REJECT,
    Inherited,
    Reason,
    Verdict,
)
from hygrokf.identification.wording import BASELINES, QUANTITIES, WIDE, fixed, minus, percent, plain_number
from hygrokf.modelling.design import PARTS

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
FAILED = 0.5
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

_OUTPUTS = {"thermal": "temperature", "hygric": "humidity"}


# --- deciding --------------------------------------------------------------------------------


def decide(fit: FitResults) -> dict[str, Verdict]:
    """The verdict on each time constant of a fit by the rules, whatever the fit states."""
    return {
        part: Verdict.of(reason for rule in RULES for reason in rule(fit, part))
        for part in PARTS
        if part in fit.time_constants
    }


def with_verdicts(fit: FitResults) -> FitResults:
    """The results with a verdict on each time constant that lacks one."""
    return _with(fit, verdicts(fit))


def verdicts(fit: FitResults) -> dict[str, Verdict]:
    """The verdicts stated in a fit; missing ones are decided."""
    constants = {part: fit.time_constants[part] for part in PARTS if part in fit.time_constants}
    decided = decide(fit) if any(one.verdict is None for one in constants.values()) else {}
    return {
        part: decided[part] if one.verdict is None else Verdict(one.verdict, one.reasons)
        for part, one in constants.items()
    }


def with_reasons(fit: FitResults, part: str, further: Iterable[Reason]) -> FitResults:
    """The results with further reasons against a time constant; those already present are not repeated."""
    known = verdicts(fit).get(part)
    if known is None:
        return fit
    present = {(one.code, one.verdict) for one in known.reasons}
    new = [one for one in further if (one.code, one.verdict) not in present]
    return _with(fit, {part: Verdict.of((*known.reasons, *new))})


def _with(fit: FitResults, found: Mapping[str, Verdict]) -> FitResults:
    """The results with these verdicts on their time constants."""
    judged = {
        part: replace(fit.time_constants[part], verdict=one.verdict, reasons=one.reasons)
        for part, one in found.items()
    }
    return replace(fit, time_constants={**fit.time_constants, **judged})


def inherited(fit: FitResults) -> dict[str, Inherited]:
    """Value, interval, verdict and reasons of a fit's numbers, by part, for results that use the fit."""
    return {
        part: Inherited(one.value_h, one.lower_h, one.upper_h, found.verdict, found.reasons)
        for part, found in verdicts(fit).items()
        for one in (fit.time_constants[part],)
    }


# --- the rules -------------------------------------------------------------------------------


def _convergence(fit: FitResults, part: str) -> Iterator[Reason]:
    if fit.converged is None:
        yield Reason("convergence_unknown", CAUTION, "whether the estimation converged is not stated")
    elif not fit.converged:
        why = f" ({fit.message})" if fit.message else ""
        yield Reason("not_converged", REJECT, f"the estimation did not converge{why}")
    if fit.discretisation_error > INEXACT:
        change = f"sub-steps of half the length change ln L by {fit.discretisation_error:.2g}"
        yield Reason("not_exact", REJECT, f"the filter's steps are not exact: {change}")


def _interval(fit: FitResults, part: str) -> Iterator[Reason]:
    """Reasons from the interval itself: open, ended by the search limit, or wide."""
    data = fit.time_constants[part]
    value, low, high = data.value_h, data.lower_h, data.upper_h
    if PARAMETER_OF[part] in fit.at_bounds:
        yield Reason(
            "at_limit",
            REJECT,
            f"the estimate ended at the limit of the search, {plain_number(value)} h, so the record does "
            "not determine it",
            {"value_h": value},
        )
    if data.without_input is not None and not data.without_input.enough:
        gain = {"gain": data.without_input.gain, "required": data.without_input.required}
        yield Reason("input_not_needed", REJECT, data.without_input.sentence, gain)
    elif not math.isfinite(value) or not (low > 0 or math.isfinite(high)):
        yield Reason("not_identifiable", REJECT, "the record bounds it on neither side")
    elif not low > 0:
        yield Reason(
            "one_sided",
            CAUTION,
            f"the record bounds it from above only (≤ {plain_number(high)} h)",
            {"upper_h": high},
        )
    elif not math.isfinite(high):
        yield Reason(
            "one_sided",
            CAUTION,
            f"the record bounds it from below only (≥ {plain_number(low)} h)",
            {"lower_h": low},
        )
    elif high > DECADE * low:
        yield Reason(
            "undetermined",
            REJECT,
            f"its interval spans {spread_words(value, low, high)} on either side: not even its order of "
            "magnitude is known",
            {"lower_h": low, "upper_h": high},
        )
    elif not (half := half_width(value, low, high)) <= TIGHT:
        yield Reason(
            "imprecise",
            CAUTION,
            f"it is known to {spread_words(value, low, high)} only",
            {"half_width": half},
        )


def half_width(value: float, low: float, high: float) -> float:
    """Half the width of an interval relative to the value."""
    return 0.5 * (high - low) / value if value > 0 else math.inf


def spread_words(value: float, low: float, high: float) -> str:
    """The size of an interval in words: "±3.5 %", or "a factor of 4.2" for a wide one."""
    if high > WIDE * low:
        return f"a factor of {plain_number(math.sqrt(high / low), 2)}"
    half = half_width(value, low, high)
    return f"±{percent(half, 1 if half < 0.095 else 0)}"


def _guards(fit: FitResults, part: str) -> Iterator[Reason]:
    """Other parameters that ended at a guard of their search."""
    names = [name for name, row in _rows(fit, part) if row.at_guard]
    names = [name for name in names if name != PARAMETER_OF[part]]
    if names:
        ended = "ended at a limit of its search" if len(names) == 1 else "ended at limits of their search"
        yield Reason(
            "guard_reached", CAUTION, f"{', '.join(names)} {ended}, on which the interval may depend"
        )


def _sensors(fit: FitResults, part: str) -> Iterator[Reason]:
    """Constant sensor errors that absorb a deficiency of the model."""
    for name, row in _rows(fit, part):
        if not name.endswith(("_bias", "_offset")):
            continue
        value, prior = row.value, row.prior
        apart = abs(value - prior.mean) / prior.sd if prior is not None and prior.sd > 0 else math.nan
        if apart > STRETCHED:
            size = f"{plain_number(value)}{'' if row.unit == '1' else f' {row.unit}'}"
            yield Reason(
                "sensor_stretched",
                CAUTION,
                f"the fit needs a constant error {name} of {size}, {fixed(apart, 1)} standard deviations of "
                "the sensor's accuracy: the error absorbs a defect of the model",
                {"error": value, "standard_deviations": apart},
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
    if data.disagreement:
        apart = criteria_apart(data)
        values = (other, math.nan if data.likelihood is None else data.likelihood.value_h)
        held = not any(value < data.lower_h or value > data.upper_h for value in values)
        yield Reason(
            "criteria_disagree",
            REJECT if apart > CONTRADICTION and not held else CAUTION,
            data.disagreement,
            {"simulation_h": other, "simulation_lower_h": low, "simulation_upper_h": high, "apart": apart},
        )
    elif not free_run_informs(data) and data.likelihood is None:
        closed = low > 0 and math.isfinite(high)
        how = "without bounds" if not closed else f"{plain_number(low)} … {plain_number(high)} h"
        yield Reason(
            "free_run_silent",
            CAUTION,
            f"the free run alone hardly determines it ({plain_number(other)} h, {how}): the number rests on "
            "the one-step predictions alone",
            {"simulation_h": other, "simulation_lower_h": low, "simulation_upper_h": high},
        )


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
    quantity = QUANTITY_OF[part]
    name, unit = QUANTITIES[quantity]
    scored = [p for p in PERIODS if math.isfinite(fit.errors(p, quantity).total)]
    beyond = [p for p in scored if beyond_readings(fit, quantity, p) is not None]
    if beyond:
        error, spread = beyond_readings(fit, quantity, beyond[0]) or (math.nan, math.nan)
        yield Reason(
            "worse_than_mean",
            REJECT if beyond == scored else CAUTION,
            f"the free run's {name} errs by {fixed(error)} {unit} in {beyond[0]}, more than the standard "
            f"deviation of the readings ({fixed(spread)} {unit}): their mean would predict better",
            {"error": error, "readings_sd": spread},
        )
    worse = [p for p in scored if (rule := best_rule(fit, quantity, p)) and rule.gain < -MATERIAL]
    if worse:
        rule = best_rule(fit, quantity, worse[0])
        assert rule is not None
        data = fit.time_constants[part]
        asked = data.simulation is not None
        alone = asked and (not free_run_informs(data) or bool(data.disagreement))
        tail = "and its own best constant does not confirm the number" if alone else ""
        if asked and not alone:
            tail = "though its own best constant agrees with the number"
        yield Reason(
            "worse_than_rule",
            REJECT if alone and worse == scored else CAUTION,
            f"the free run's {name} errs by {fixed(rule.error)} {unit} in {worse[0]}, the rule "
            f"“{rule.words}” by {fixed(rule.rule)} {unit}{f', {tail}' if tail else ''}",
            {"error": rule.error, "rule_error": rule.rule},
        )
    if band_failed(fit, quantity):
        share = fit.band("free_run", quantity).coverage
        yield Reason(
            "band_failed",
            CAUTION,
            f"the free run's 95 % band holds only {percent(share)} of the readings of the {name}",
            {"coverage": share},
        )


@dataclass(frozen=True)
class Rule:
    """The best rule that needs no model in one period: its words, its error, the model's error, and the
    model's gain [1]."""

    words: str
    rule: float
    error: float

    @property
    def gain(self) -> float:
        return 1.0 - self.error / self.rule


def best_rule(fit: FitResults, quantity: str, period: str) -> Rule | None:
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
    return Rule(words, rules[words], error)


def beyond_readings(fit: FitResults, quantity: str, period: str) -> tuple[float, float] | None:
    """Error and standard deviation of the readings in a period where the free run's error exceeds their
    standard deviation."""
    error = fit.errors(period, quantity).total
    spread = fit.readings_sd.get(period, {}).get(quantity, math.nan)
    return (error, spread) if error > spread else None


def band_failed(fit: FitResults, quantity: str) -> bool:
    """Whether the free run's 95 % band contains too few readings to be relied on."""
    band = fit.band("free_run", quantity)
    return band.coverage < FAILED and band.n >= FEWEST_IN_BAND


def _innovations(fit: FitResults, part: str) -> Iterator[Reason]:
    """Correlated one-step predictions, and scores that vary more than the model explains."""
    size, beside = largest_correlation(fit, _OUTPUTS[part])
    if size >= SMALL:
        yield Reason(
            "innovations_correlated",
            CAUTION,
            f"the one-step predictions of the {QUANTITIES[QUANTITY_OF[part]][0]} are still correlated with "
            f"{beside}, by up to {fixed(size)}: the interval may be too narrow",
            {"correlation": size},
        )
    factor = fit.time_constants[part].factor
    if factor > SCATTER:
        yield Reason(
            "noise_not_as_modelled",
            CAUTION,
            f"the variance of the estimate is {plain_number(factor, 2)} times what the model's noise "
            "explains: "
            "the interval was widened accordingly, but the noise model is not right",
            {"factor": factor},
        )


def largest_correlation(fit: FitResults, output: str) -> tuple[float, str]:
    """The largest correlation [1] of an output's innovations that a test rejects, and its other variable; (0,
    "") without one."""
    data = fit.innovations.outputs.get(output, OutputDiagnosis())
    rejected = {row.test for row in fit.innovations.tests if row.output == output and row.rejected}
    found: list[tuple[str, Autocorrelation | CrossCorrelation | None, str]] = [
        ("earlier innovations", data.autocorrelation, "autocorrelation")
    ]
    for name, crossed in data.cross_correlation.items():
        words = name.replace("_", " ")
        found.append((f"the {words}", crossed, f"correlation with {words}"))
    largest, beside = 0.0, ""
    for words, one, test in found:
        if one is None or not any(name.startswith(test) for name in rejected):
            continue
        size = float(np.max(np.abs(one.value), initial=0.0))
        if size > max(largest, np.nan_to_num(one.limit_all)):
            largest, beside = size, words
    return largest, beside


def _data(fit: FitResults, part: str) -> Iterator[Reason]:
    """Too few or too widely spaced readings, a record too short for the number, and doubts about the record
    that concern it."""
    data = fit.time_constants[part]
    value, low, high = data.value_h, data.lower_h, data.upper_h
    sampling = data.sampling or Sampling()
    shift, step = sampling.shift_ln_when_halved, sampling.ambient_step_h
    reach = 0.5 * math.log(high / low) if 0 < low < high < math.inf else math.inf
    if abs(shift) > max(reach, MATERIAL):
        yield Reason(
            "ambient_coarse",
            CAUTION,
            "without every second ambient reading it changes by "
            f"{minus(f'{100 * math.expm1(shift):+.0f}')} %, more "
            f"than its interval allows: ambient readings every {60 * step:.3g} min hardly resolve it",
            {"shift": math.expm1(shift), "ambient_step_h": step},
        )
    output = fit.innovations.outputs.get(_OUTPUTS[part])
    n, every = (math.nan, math.nan) if output is None else (output.n, output.step_h)
    if every > FORGOTTEN * value:
        yield Reason(
            "readings_coarse",
            CAUTION,
            f"the cabinet is read every {60 * every:.3g} min; by then "
            f"{percent(1.0 - math.exp(-every / value))} "
            "of a deviation has decayed",
            {"step_h": every},
        )
    free = sum(not row.fixed for _, row in _rows(fit, part))
    if n < PER_PARAMETER * free:
        yield Reason(
            "few_readings",
            CAUTION,
            f"{n:.0f} readings determine {free} parameters: too few to trust the interval",
            {"readings": n, "parameters": free},
        )
    length = _hours(fit.period.start, fit.period.until or fit.period.end)
    if length < CONSTANTS * value:
        yield Reason(
            "record_short",
            CAUTION,
            f"the identification period is {plain_number(length / value, 2)} time constants long: too short "
            "to trust the interval",
            {"time_constants": length / value},
        )
    for doubt in fit.doubted.get(part, ()):
        yield Reason("record_doubted", CAUTION, f"doubt about the record: {doubt}")


def _hours(start: str | None, end: str | None) -> float:
    """Hours between two ISO 8601 stamps; NaN where they are not stamps."""
    from datetime import datetime

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
            yield Reason(
                "forms_differ",
                CAUTION,
                f"another form of the model ({one.form}, weight {percent(one.weight)}) gives "
                f"{plain_number(one.value_h)} h, outside the interval",
                {"other_h": one.value_h, "weight": one.weight},
            )
    scatter = math.nan if data.parts is None else data.parts.scale
    if scatter > PARTS_SCATTER:
        yield Reason(
            "parts_differ",
            CAUTION,
            f"parts of the record scatter {plain_number(scatter, 2)} times as much as their own bounds "
            "explain: the number changes over the record, or the model lacks something",
            {"scatter": scatter},
        )


RULES: tuple[Callable[[FitResults, str], Iterable[Reason]], ...] = (
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
