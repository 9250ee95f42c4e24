"""One verdict for every number: whether a time constant can be believed, and what speaks against it.

A verdict is decided once, at the end of a fit, from the plain data of `fit.json`.  Whatever uses the number inherits it:
pages, commands, forecasts, alarms.  Each rule looks at one kind of evidence and gives reasons; the worst reason decides,
and a number against which nothing speaks is believed.

A reason says "reject" where the evidence contradicts the number, or where the record does not determine it.  It says
"caution" where the evidence is weak, or where it puts the interval in doubt and leaves the number standing.

A further rule is one function `rule(fit, part) -> reasons` in `RULES` and one row in docs/verdict.md.  `fit` is the data
of fit.json, of which anything may be missing; `part` is "thermal" or "hygric".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

from hygrokf.data.lookup import entry, number, numbers
from hygrokf.evaluation.innovation_tests import SMALL
from hygrokf.identification.verdict_terms import (
    _OUTPUTS,
    BELIEVE,
    CARRIES_OVER,
    CAUTION,
    CONSTANTS,
    CONTRADICTION,
    COVERAGE,
    CREDIBLE,
    DECADE,
    FAILED,
    FEWEST_IN_BAND,
    FORGOTTEN,
    MARKS,
    MATERIAL,
    PARAMETER_OF,
    PARTS_SCATTER,
    PER_PARAMETER,
    PERIODS,
    PLAIN_MARKS,
    QUANTITY_OF,
    REJECT,
    SAYING,
    SCATTER,
    STRETCHED,
    TIGHT,
    VERDICTS,
    WORDS,
    Reason,
    Verdict,
)
from hygrokf.identification.wording import (
    BASELINES,
    QUANTITIES,
    UNBOUNDED,
    WIDE,
    fixed,
    interval,
    minus,
    percent,
    plain_number,
    text_of,
    texts,
)
from hygrokf.modelling.design import PARTS

__all__ = [  # the terms of verdicts and what is done with them: the one module that others import
    "BELIEVE", "CARRIES_OVER", "CAUTION", "CONSTANTS", "CONTRADICTION", "COVERAGE", "CREDIBLE", "DECADE",
    "FAILED", "FEWEST_IN_BAND", "FORGOTTEN", "MARKS", "MATERIAL", "PARAMETER_OF", "PARTS", "PARTS_SCATTER",
    "PERIODS", "PER_PARAMETER", "PLAIN_MARKS", "QUANTITY_OF", "REJECT", "RULES", "SAYING", "SCATTER",
    "SMALL", "STRETCHED", "TIGHT", "VERDICTS", "WIDE", "WORDS", "Reason", "Rule", "Verdict", "band_failed",
    "best_rule", "beyond_readings", "criteria_apart", "decide", "free_run_says", "half_width", "handed_on",
    "inherited", "largest_correlation", "line", "rests_on", "spread_words", "told", "verdicts",
    "with_reasons", "with_verdicts"
]  # fmt: skip


# --- deciding --------------------------------------------------------------------------------


def decide(fit: Mapping) -> dict[str, Verdict]:
    """The verdict on each time constant that a fit has, from the data of fit.json."""
    return {
        part: Verdict.of(reason for rule in RULES for reason in rule(fit, part))
        for part in PARTS
        if isinstance(entry(fit, "time_constants", part), Mapping)
    }


def with_verdicts(fit: Mapping) -> dict:
    """The data of a fit with `verdict` and `reasons` of each time constant; those that are there stay."""
    constants = entry(fit, "time_constants")
    if not isinstance(constants, Mapping):
        return dict(fit)
    found = verdicts(fit)
    filled = {part: {**constants[part], **found[part].to_json()} for part in found}
    return {**fit, "time_constants": {**constants, **filled}}


def verdicts(fit: Mapping) -> dict[str, Verdict]:
    """The verdicts of a fit as it states them; one that states none, or none that can be read, is judged now."""
    found: dict[str, Verdict] = {}
    for part in PARTS:
        data = entry(fit, "time_constants", part)
        if isinstance(data, Mapping) and data.get("verdict") in VERDICTS:
            found[part] = Verdict.from_json(data)
    missing = [p for p in PARTS if p not in found and isinstance(entry(fit, "time_constants", p), Mapping)]
    judged = decide(fit) if missing else {}
    both = judged | found
    return {part: both[part] for part in PARTS if part in both}


def with_reasons(fit: Mapping, part: str, further: Iterable[Reason]) -> dict:
    """The data of a fit with further reasons against one of its numbers; none is told twice."""
    known = verdicts(fit).get(part)
    if known is None:
        return dict(fit)
    constants = fit["time_constants"]
    said = {(one.code, one.verdict) for one in known.reasons}
    new = [one for one in further if (one.code, one.verdict) not in said]
    wider = {**constants[part], **Verdict.of((*known.reasons, *new)).to_json()}
    return {**fit, "time_constants": {**constants, part: wider}}


def inherited(fit: Mapping) -> dict[str, dict]:
    """What results that use a fit hand on of its numbers: value, interval, verdict and reasons, by part."""
    return {
        part: {
            **{key: entry(fit, "time_constants", part, key) for key in ("value_h", "lower_h", "upper_h")},
            **one.to_json(),
        }
        for part, one in verdicts(fit).items()
    }


def line(name: str, span: str, found: Verdict) -> str:
    """A number with its verdict in a line; one that is not to be believed stands behind the words that say so."""
    if found.verdict != REJECT:
        return f"{name} {span}: {found.sentence}"
    words = "" if span.startswith(UNBOUNDED) else f" {found.words},"
    return f"{name}{words} {span}{f': {found.why}' if found.why else ''}"


def told(data: object) -> list[str]:
    """A line for each number that a result has inherited (`inherited`), with its mark, as every command tells it."""
    lines = []
    for part, one, found in handed_on(data):
        value, bounds, _ = interval(number(one, "value_h"), number(one, "lower_h"), number(one, "upper_h"))
        span = f"{value} ({bounds})" if bounds else value
        lines.append(f"{PLAIN_MARKS[found.verdict]} {line(f'{part} time constant', span, found)}")
    return lines


def handed_on(data: object) -> list[tuple[str, Mapping, Verdict]]:
    """Part, numbers and verdict of each number that a result has inherited; what cannot be read is left out."""
    return [
        (part, one, Verdict.from_json(one))
        for part in PARTS
        if isinstance(one := entry(data, part), Mapping) and one.get("verdict") in VERDICTS
    ]


def rests_on(data: object, parts: Iterable[str] = PARTS) -> str:
    """What is said of a result that rests on inherited numbers which are not to be believed; empty where there are none.

    parts: those that it rests on.
    """
    rejected = [part for part, _, found in handed_on(data) if found.verdict == REJECT and part in parts]
    if not rejected:
        return ""
    several = len(rejected) > 1
    return (
        f"the model's {' and '.join(rejected)} time constant{'s' if several else ''}, on which this rests, "
        f"{'are' if several else 'is'} {WORDS[REJECT]}"
    )


# --- the rules -------------------------------------------------------------------------------


def _convergence(fit: Mapping, part: str) -> Iterator[Reason]:
    if entry(fit, "converged") is True:
        return
    said = text_of(entry(fit, "message"))
    if entry(fit, "converged") is False:
        yield Reason(
            "not_converged", REJECT, f"the estimation did not converge{f' ({said})' if said else ''}"
        )
    else:
        yield Reason("convergence_unknown", CAUTION, "whether the estimation converged is not stated")


def _interval(fit: Mapping, part: str) -> Iterator[Reason]:
    """What the interval itself says: open, the search's own limit, or wide."""
    value, low, high = (number(fit, "time_constants", part, key) for key in ("value_h", "lower_h", "upper_h"))
    if PARAMETER_OF[part] in texts(entry(fit, "at_bounds")):
        yield Reason(
            "at_limit",
            REJECT,
            f"the estimate ended at the limit of the search, {plain_number(value)} h, which the record did not set",
            {"value_h": value},
        )
    if not math.isfinite(value) or not (low > 0 or math.isfinite(high)):
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
            f"its interval reaches over {spread_words(value, low, high)} on either side: not even its order of magnitude is known",
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
    """How far an interval reaches: "±3.5 %", of a wide one "a factor of 4.2"."""
    if high > WIDE * low:
        return f"a factor of {plain_number(math.sqrt(high / low), 2)}"
    half = half_width(value, low, high)
    return f"±{percent(half, 1 if half < 0.095 else 0)}"


def _guards(fit: Mapping, part: str) -> Iterator[Reason]:
    """Other parameters at limits that only guard the search."""
    names = [name for name, row in _rows(fit, part) if entry(row, "at_guard") is True]
    names = [name for name in names if name != PARAMETER_OF[part]]
    if names:
        ended = "ended at a limit of its search" if len(names) == 1 else "ended at limits of their search"
        yield Reason(
            "guard_reached", CAUTION, f"{', '.join(names)} {ended}, on which the interval may depend"
        )


def _sensors(fit: Mapping, part: str) -> Iterator[Reason]:
    """Constant errors of sensors that take in what the model lacks."""
    for name, row in _rows(fit, part):
        if not name.endswith(("_bias", "_offset")):
            continue
        value, mean, sd = number(row, "value"), number(row, "prior", "mean"), number(row, "prior", "sd")
        apart = abs(value - mean) / sd if sd > 0 else math.nan
        if apart > STRETCHED:
            unit = text_of(entry(row, "unit"))
            size = f"{plain_number(value)}{'' if unit == '1' else f' {unit}'}"
            yield Reason(
                "sensor_stretched",
                CAUTION,
                f"the fit needs a constant error {name} of {size}, {fixed(apart, 1)} standard deviations of what the "
                "sensor's accuracy allows: it takes in what the model lacks",
                {"error": value, "standard_deviations": apart},
            )


def _rows(fit: Mapping, part: str) -> list[tuple[str, Mapping]]:
    """The parameters that were estimated together with a time constant; all where that is not stated."""
    found = entry(fit, "parameters")
    return [
        (text_of(name), row)
        for name, row in (found.items() if isinstance(found, Mapping) else ())
        if isinstance(row, Mapping) and part in (texts(entry(row, "parts")) or PARTS)
    ]


def _criteria(fit: Mapping, part: str) -> Iterator[Reason]:
    """What the free run's own best constant says beside that of the one-step predictions."""
    data = entry(fit, "time_constants", part)
    if not isinstance(entry(data, "simulation"), Mapping):
        return
    other, low, high = (number(data, "simulation", key) for key in ("value_h", "lower_h", "upper_h"))
    said = text_of(entry(data, "disagreement"))
    if said:
        apart = criteria_apart(data)
        ends = (number(data, "lower_h"), number(data, "upper_h"))
        values = (other, number(data, "likelihood", "value_h"))
        held = not any(value < ends[0] or value > ends[1] for value in values)
        yield Reason(
            "criteria_disagree",
            REJECT if apart > CONTRADICTION and not held else CAUTION,
            said,
            {"simulation_h": other, "simulation_lower_h": low, "simulation_upper_h": high, "apart": apart},
        )
    elif not free_run_says(data) and not isinstance(entry(data, "likelihood"), Mapping):
        closed = low > 0 and math.isfinite(high)
        how = "without bounds" if not closed else f"{plain_number(low)} … {plain_number(high)} h"
        yield Reason(
            "free_run_silent",
            CAUTION,
            f"the free run alone hardly says anything about it ({plain_number(other)} h, {how}): only the one-step "
            "predictions speak for it",
            {"simulation_h": other, "simulation_lower_h": low, "simulation_upper_h": high},
        )


def free_run_says(data: object) -> bool:
    """Whether the free run's own estimate of a time constant has bounds that say something."""
    low, high = (number(data, "simulation", key) for key in ("lower_h", "upper_h"))
    return low > 0 and high < SAYING * low


def criteria_apart(data: object) -> float:
    """Distance of the estimates by one-step predictions and by the free run, in units of what both uncertainties explain.

    1 is where they begin to disagree; infinite where either has no interval.
    """
    first = next(
        (entry(data, key) for key in ("likelihood", "profile") if isinstance(entry(data, key), Mapping)), data
    )
    ends = []
    for one in (first, entry(data, "simulation")):
        value, low, high = (number(one, key) for key in ("value_h", "lower_h", "upper_h"))
        if not (value > 0 and 0 < low < high):
            return math.inf
        ends.append((math.log(value), 0.5 * math.log(high / low)))
    (a, reach_a), (b, reach_b) = ends
    return abs(a - b) / math.hypot(reach_a, reach_b)


def _free_run(fit: Mapping, part: str) -> Iterator[Reason]:
    """How the free run does beside what needs no model, and beside its own band."""
    quantity = QUANTITY_OF[part]
    name, unit = QUANTITIES[quantity]
    scored = [p for p in PERIODS if math.isfinite(number(fit, "rmse", p, quantity, "total"))]
    beyond = [p for p in scored if beyond_readings(fit, quantity, p) is not None]
    if beyond:
        error, spread = beyond_readings(fit, quantity, beyond[0]) or (math.nan, math.nan)
        yield Reason(
            "worse_than_mean",
            REJECT if beyond == scored else CAUTION,
            f"the free run's {name} errs by {fixed(error)} {unit} in {beyond[0]}, more than the readings vary "
            f"({fixed(spread)} {unit}): their mean alone would do better",
            {"error": error, "readings_sd": spread},
        )
    worse = [p for p in scored if (rule := best_rule(fit, quantity, p)) and rule.gain < -MATERIAL]
    if worse:
        rule = best_rule(fit, quantity, worse[0])
        assert rule is not None
        data = entry(fit, "time_constants", part)
        asked = isinstance(entry(data, "simulation"), Mapping)
        alone = asked and (not free_run_says(data) or bool(text_of(entry(data, "disagreement"))))
        tail = "and its own best constant does not confirm the number" if alone else ""
        if asked and not alone:
            tail = "though its own best constant agrees with the number"
        yield Reason(
            "worse_than_rule",
            REJECT if alone and worse == scored else CAUTION,
            f"the free run's {name} errs by {fixed(rule.error)} {unit} in {worse[0]}, the rule “{rule.words}” by "
            f"{fixed(rule.rule)} {unit}{f', {tail}' if tail else ''}",
            {"error": rule.error, "rule_error": rule.rule},
        )
    if band_failed(fit, quantity):
        share = number(fit, "bands", "free_run", quantity, "coverage")
        yield Reason(
            "band_failed",
            CAUTION,
            f"the free run's 95 % band holds only {percent(share)} of the readings of the {name}",
            {"coverage": share},
        )


@dataclass(frozen=True)
class Rule:
    """The best rule that needs no model in one period: its words, its error and the model's, and what the model gains [1]."""

    words: str
    rule: float
    error: float

    @property
    def gain(self) -> float:
        return 1.0 - self.error / self.rule


def best_rule(fit: Mapping, quantity: str, period: str) -> Rule | None:
    """The rule with the least error in a period, beside the free run's error there; None where nothing was scored."""
    error = number(fit, "rmse", period, quantity, "total")
    rules = {
        words: value
        for key, words in BASELINES[quantity].items()
        if (value := number(fit, "baselines", period, key, quantity, "total")) > 0
    }
    if not rules or not math.isfinite(error):
        return None
    words = min(rules, key=lambda one: rules[one])
    return Rule(words, rules[words], error)


def beyond_readings(fit: Mapping, quantity: str, period: str) -> tuple[float, float] | None:
    """Error and standard deviation of the readings in a period where the free run errs by more than they vary."""
    error = number(fit, "rmse", period, quantity, "total")
    spread = number(fit, "readings_sd", period, quantity)
    return (error, spread) if error > spread else None


def band_failed(fit: Mapping, quantity: str) -> bool:
    """Whether the free run's 95 % band holds so few readings that it is not to be relied on."""
    share, n = (number(fit, "bands", "free_run", quantity, key) for key in ("coverage", "n"))
    return share < FAILED and n >= FEWEST_IN_BAND


def _innovations(fit: Mapping, part: str) -> Iterator[Reason]:
    """One-step predictions that are still correlated, and scores that vary more than the model says."""
    size, beside = largest_correlation(fit, _OUTPUTS[part])
    if size >= SMALL:
        yield Reason(
            "innovations_correlated",
            CAUTION,
            f"the one-step predictions of the {QUANTITIES[QUANTITY_OF[part]][0]} are still correlated with "
            f"{beside}, by up to {fixed(size)}: the interval may be too narrow",
            {"correlation": size},
        )
    factor = number(fit, "time_constants", part, "factor")
    if factor > SCATTER:
        yield Reason(
            "noise_not_as_modelled",
            CAUTION,
            f"the estimate scatters {plain_number(factor, 2)} times as much (in variance) as the model's noise explains: the "
            "interval was widened by that, and rests on a model that is not quite right",
            {"factor": factor},
        )


def largest_correlation(fit: Mapping, output: str) -> tuple[float, str]:
    """The largest correlation [1] of an output's innovations that a test rejects, and with what; (0, "") without one."""
    data = entry(fit, "innovations", "outputs", output)
    rejected = {
        text_of(entry(row, "test"))
        for row in _list(entry(fit, "innovations", "tests"))
        if entry(row, "output") == output and entry(row, "rejected") is True
    }
    crossed = entry(data, "cross_correlation")
    found = [("what came before", entry(data, "autocorrelation"), "autocorrelation")]
    for name, one in crossed.items() if isinstance(crossed, Mapping) else ():
        words = text_of(name).replace("_", " ")
        found.append((f"the {words}", one, f"correlation with {words}"))
    largest, beside = 0.0, ""
    for words, one, test in found:
        if not any(name.startswith(test) for name in rejected):
            continue
        limit = number(one, "limit_all")
        sizes = [abs(v) for v in numbers(one, "value") if abs(v) > (limit if math.isfinite(limit) else 0.0)]
        if sizes and max(sizes) > largest:
            largest, beside = float(max(sizes)), words
    return largest, beside


def _data(fit: Mapping, part: str) -> Iterator[Reason]:
    """Readings that are too few, too short, or too far apart for the number; doubts about the record that touch it."""
    data = entry(fit, "time_constants", part)
    value, low, high = (number(data, key) for key in ("value_h", "lower_h", "upper_h"))
    shift, step = number(data, "sampling", "shift_ln_when_halved"), number(data, "sampling", "ambient_step_h")
    reach = 0.5 * math.log(high / low) if 0 < low < high < math.inf else math.inf
    if abs(shift) > max(reach, MATERIAL):
        yield Reason(
            "ambient_coarse",
            CAUTION,
            f"with every second ambient reading left out it changes by {minus(f'{100 * math.expm1(shift):+.0f}')} %, more "
            f"than its interval allows: readings of the ambient every {60 * step:.3g} min hardly resolve it",
            {"shift": math.expm1(shift), "ambient_step_h": step},
        )
    n, every = (number(fit, "innovations", "outputs", _OUTPUTS[part], key) for key in ("n", "step_h"))
    if every > FORGOTTEN * value:
        yield Reason(
            "readings_coarse",
            CAUTION,
            f"the cabinet is read every {60 * every:.3g} min, when {percent(1.0 - math.exp(-every / value))} of what the last "
            "reading showed is forgotten",
            {"step_h": every},
        )
    free = sum(entry(row, "fixed") is not True for _, row in _rows(fit, part))
    if n < PER_PARAMETER * free:
        yield Reason(
            "few_readings",
            CAUTION,
            f"{n:.0f} readings determine {free} parameters: too few to trust the interval",
            {"readings": n, "parameters": free},
        )
    length = _hours(
        entry(fit, "period", "start"), entry(fit, "period", "until") or entry(fit, "period", "end")
    )
    if length < CONSTANTS * value:
        yield Reason(
            "record_short",
            CAUTION,
            f"the identification period is {plain_number(length / value, 2)} time constants long: too short to trust "
            "the interval",
            {"time_constants": length / value},
        )
    for said in texts(entry(fit, "doubted", part)):
        yield Reason("record_doubted", CAUTION, f"doubt about the record: {said}")


def _hours(start: object, end: object) -> float:
    """Hours between two stamps of ISO 8601; NaN where they are none."""
    from datetime import datetime

    try:
        first, last = (datetime.fromisoformat(text_of(one)) for one in (start, end))
        return (last - first).total_seconds() / 3600.0
    except (ValueError, TypeError):
        return math.nan


def _other_estimates(fit: Mapping, part: str) -> Iterator[Reason]:
    """Other forms of the model outside the interval, and parts of the record that differ."""
    data = entry(fit, "time_constants", part)
    low, high = (number(data, key) for key in ("lower_h", "upper_h"))
    for one in _list(entry(data, "forms")):
        value, weight = number(one, "value_h"), number(one, "weight")
        if weight >= CREDIBLE and (value < low or value > high):
            yield Reason(
                "forms_differ",
                CAUTION,
                f"another form of the model ({text_of(entry(one, 'form'))}, weight {percent(weight)}) gives "
                f"{plain_number(value)} h, outside the interval",
                {"other_h": value, "weight": weight},
            )
    scatter = number(data, "parts", "scale")
    if scatter > PARTS_SCATTER:
        yield Reason(
            "parts_differ",
            CAUTION,
            f"parts of the record scatter {plain_number(scatter, 2)} times as much as their own bounds explain: the number is "
            "not the same throughout, or the model lacks something",
            {"scatter": scatter},
        )


def _list(value: object) -> list[Mapping]:
    return [one for one in value if isinstance(one, Mapping)] if isinstance(value, (list, tuple)) else []


RULES: tuple[Callable[[Mapping, str], Iterable[Reason]], ...] = (
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
"""In the order in which reasons of one weight are told."""
