"""Numbers and judgements in words: what the report says about a fit before it shows a figure.

Any part of the results may be missing.  Whether a time constant can be believed is not decided here: that is
its `verdict`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from hygrokf.evaluation.diagnosis import InnovationTest
from hygrokf.evaluation.innovation_tests import SMALL
from hygrokf.evaluation.scoring import SCORED
from hygrokf.identification import fit_results
from hygrokf.identification.fit_results import FitResults, Interval
from hygrokf.identification.verdict import (
    CARRIES_OVER,
    COVERAGE,
    FEWEST_IN_BAND,
    MATERIAL,
    band_failed,
    best_rule,
    beyond_readings,
    free_run_informs,
    largest_correlation,
    spread_words,
    verdicts,
)
from hygrokf.identification.verdict_terms import (
    BELIEVE,
    CAUTION,
    PERIODS,
    QUANTITY_OF,
    REJECT,
    Verdict,
    verdict_line,
)
from hygrokf.identification.wording import QUANTITIES, ends, fixed, interval, percent, plain_number, sentence
from hygrokf.modelling.design import PARTS

METHODS = {
    "composed": "all sources",
    "profile": "profile likelihood",
    "wald": "Wald",
    "sandwich": "sandwich",
    "none": "no bounds",
}


# --- time constants --------------------------------------------------------------------------


@dataclass(frozen=True)
class TimeConstant:
    """A time constant in words: `value` ("1.49 h", "≤ 0.4 h", "not identifiable"), `bounds`, `closed` on both
    sides.

    `verdict`: whether it can be believed.
    """

    name: str
    value: str
    bounds: str
    closed: bool
    found: fit_results.TimeConstant | None
    verdict: Verdict = field(default_factory=Verdict)

    @property
    def span(self) -> str:
        """Value and bounds."""
        return f"{self.value} ({self.bounds})" if self.bounds else self.value

    @property
    def sentence(self) -> str:
        """The number with its verdict; one that is not to be believed stands behind it."""
        return (
            f"{self.name} {self.span}"
            if self.found is None
            else verdict_line(self.name, self.span, self.verdict)
        )


def time_constant(fit: FitResults, name: str) -> TimeConstant:
    """The headline of one time constant, "thermal" or "hygric"."""
    found = fit.time_constants.get(name)
    if found is None:
        return TimeConstant(name, "not identified", "", False, None)
    value, bounds, closed = interval(found.value_h, found.lower_h, found.upper_h)
    how = (percent(found.level) if math.isfinite(found.level) else "", method(found))
    tail = ", ".join(part for part in (bounds, *how) if part)
    return TimeConstant(name, value, tail, closed, found, verdicts(fit)[name])


def method(found: fit_results.TimeConstant) -> str:
    """How bounds were made, in words."""
    first, _, rest = found.method.partition(" ")
    return f"{METHODS.get(first, first)} {rest}".strip()


def simulated(found: fit_results.TimeConstant | None) -> str:
    """The estimate by the simulation criterion with its bounds [h]; empty where there is none."""
    free = (None if found is None else found.simulation) or Interval()
    value, low, high = free.value_h, free.lower_h, free.upper_h
    if not math.isfinite(value):
        return ""
    if not (math.isfinite(low) and math.isfinite(high) and high > low):
        return f"{plain_number(value)} h"
    shown, span = ends(value, low, high)
    return f"{shown} h ({span})"


def range_of(found: fit_results.TimeConstant | None) -> tuple[float, float]:
    """The time constant [h] at the ends of the record's temperatures; NaN where it has no such range."""
    ends_h = (found.range_h if found is not None else None) or ()
    known = len(ends_h) == 2 and all(map(math.isfinite, ends_h))
    return (ends_h[0], ends_h[1]) if known else (math.nan, math.nan)


# --- judgements ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Judgement:
    """One sentence, what to make of it ("believe", "caution", "reject"), and what it is about.

    `about`: a time constant ("thermal", "hygric"), a scored quantity, "bands", "innovations" or "record".  Of
    one subject nothing is believed and rejected at once.  `reason`: whether it belongs to the judgement
    before it.
    """

    kind: str
    sentence: str
    about: str
    reason: bool = False


def judgements(fit: FitResults) -> list[Judgement]:
    """What to believe and what not: the time constants with the reasons of their verdicts, then what the
    model does."""
    found = [one for name in PARTS for one in _time_constant(fit, name)]
    found += [one for name in PARTS for one in _errors(fit, name)]
    return [*found, *_bands(fit), *_innovations(fit)]


def doubted(fit: FitResults) -> list[Judgement]:
    """What a sceptic would ask about the record itself; to be shown before everything else."""
    return [
        Judgement(CAUTION, f"Doubt about the record: {line}{'' if line[-1] in '.?!' else '.'}", "record")
        for line in fit.doubts
        if line
    ]


def _time_constant(fit: FitResults, name: str) -> list[Judgement]:
    constant = time_constant(fit, name)
    if constant.found is None:
        said = f"There is no {name} time constant: nothing in the record determines one."
        return [Judgement(CAUTION, said, name)]
    known = constant.value
    if constant.closed:
        found = constant.found
        known += f", known to {spread_words(found.value_h, found.lower_h, found.upper_h)}"
    verdict = constant.verdict
    head = {
        BELIEVE: f"The {name} time constant, {known}, is to be believed.",
        CAUTION: f"The {name} time constant, {known}, is to be taken with caution:",
        REJECT: f"The {name} time constant ({known}) is not to be believed:",
    }[verdict.verdict]
    made = [Judgement(verdict.verdict, head, name)]
    made += [
        Judgement(one.verdict, sentence(one.text), name, reason=True)
        for one in verdict.reasons
        if one.code != "record_doubted" or one.text.partition(": ")[2] not in fit.doubts
    ]
    other = simulated(constant.found)
    if verdict.verdict == BELIEVE and other and free_run_informs(constant.found):
        said = f"The free run alone gives {other} for it: the criteria agree."
        made.append(Judgement(BELIEVE, said, name, reason=True))
    return made


def _errors(fit: FitResults, part: str) -> list[Judgement]:
    """The free run's error in the validation period (else the identification period), beside the best rule,
    in one."""
    quantity = QUANTITY_OF[part]
    name, unit = QUANTITIES[quantity]
    early, late = (fit.errors(period, quantity).total for period in ("identification", "validation"))
    if not (math.isfinite(early) or math.isfinite(late)):
        return []
    validated = math.isfinite(late)
    period = "validation" if validated else "identification"
    for one in PERIODS:
        beyond = beyond_readings(fit, quantity, one)
        if beyond is not None:
            said = (
                f"The free run's {name} error is {fixed(beyond[0])} {unit} in {one}, more than the standard "
                f"deviation of the readings ({fixed(beyond[1])} {unit}): their mean alone would do better."
            )
            return [Judgement(REJECT, said, quantity)]
    kind, ends = BELIEVE, ""
    if not validated:
        kind = CAUTION
        begins = (
            f"The free run's {name} error is {fixed(early)} {unit}, on data which the fit has seen: "
            "nothing validates it"
        )
    else:
        begins = f"The free run's {name} error is {fixed(late)} {unit} in validation"
        if math.isfinite(early) and early > 0:
            begins += f" after {fixed(early)} {unit} in identification"
            if late > CARRIES_OVER * early:
                kind, ends = CAUTION, "the model does not carry over well"
            else:
                ends = "the model carries over"
    rule = best_rule(fit, quantity, period)
    if rule is not None:
        against = f"the rule “{rule.words}” ({fixed(rule.rule)} {unit} in {period})"
        if rule.gain >= MATERIAL:
            ends += f"{', and ' if ends else ''}it is {percent(rule.gain)} below that of {against}"
        else:
            worse = rule.gain < -MATERIAL
            beside = "worse" if worse else "hardly better" if rule.gain >= 0.0 else "no better"
            # an error as large as before is no success where a rule without a model errs as little
            lost = ends if kind == CAUTION else ""
            kind = REJECT if worse else CAUTION
            ends = f"{f'{lost}, and ' if lost else ''}it is {beside} than {against}"
            verdict = verdicts(fit).get(part)
            if verdict is not None and verdict.verdict != REJECT:
                ends += "; the time constant says something about the cabinet, not about accuracy"
    share = fit.sensor_share.get(period, {}).get(quantity, math.nan)
    tail = f" The sensors' accuracy alone explains {percent(share)} of it." if share >= 0.5 else ""
    return [Judgement(kind, f"{begins}{': ' if ends else ''}{ends}.{tail}", quantity)]


def _bands(fit: FitResults) -> list[Judgement]:
    narrow: list[str] = []
    wide: list[str] = []
    right: list[str] = []
    for lead in fit.bands:
        for quantity in SCORED:
            band = fit.band(lead, quantity)
            share = band.coverage
            if math.isfinite(share) and band.n >= FEWEST_IN_BAND:
                words = f"{lead_words(lead)} {QUANTITIES[quantity][0]} {percent(share)}"
                (narrow if share < COVERAGE[0] else wide if share > COVERAGE[1] else right).append(words)
    made = []
    for quantity in SCORED:
        if band_failed(fit, quantity):
            late = math.isfinite(fit.errors("validation", quantity).total)
            said = (
                f"The free run's 95 % band of the {QUANTITIES[quantity][0]} holds only "
                f"{percent(fit.band('free_run', quantity).coverage)} of the readings in "
                f"{'validation' if late else 'identification'}: do not rely on the free run."
            )
            made.append(Judgement(REJECT, said, f"band of {quantity}"))
    if right:
        said = f"95 % bands that hold about what they promise: {', '.join(right)}."
        made.append(Judgement(BELIEVE, said, "bands that hold"))
    if narrow:
        made.append(
            Judgement(CAUTION, f"95 % bands that are too narrow: {', '.join(narrow)}.", "narrow bands")
        )
    if wide:
        made.append(
            Judgement(CAUTION, f"95 % bands that are wider than needed: {', '.join(wide)}.", "wide bands")
        )
    return made


def lead_words(lead: str) -> str:
    """ "24h" -> "24 h ahead", "free_run" -> "free run"."""
    hours = lead.removesuffix("h")
    return f"{hours} h ahead" if hours.replace(".", "").isdigit() else lead.replace("_", " ")


def _innovations(fit: FitResults) -> list[Judgement]:
    rows = fit.innovations.tests
    if not rows:
        return []
    against = [row for row in rows if row.rejected]
    kinds = list(dict.fromkeys(text for row in against if (text := _test_in_words(row))))
    named = f" ({', '.join(kinds)})" if kinds else ""
    count = f"{len(against)} of {len(rows)} tests {'speaks' if len(against) == 1 else 'speak'}"
    if not against:
        said = f"None of {len(rows)} tests speaks against white innovations."
        return [Judgement(BELIEVE, said, "innovations")]
    if kinds and set(kinds) <= set(NO_CORRELATION):
        said = f"{count} against white innovations{named}, none of them by a correlation (below)."
        return [Judgement(CAUTION, said, "innovations")]
    largest = max((largest_correlation(fit, name)[0] for name in fit.innovations.outputs), default=0.0)
    small = largest < SMALL
    size = f", by correlations of at most {fixed(largest)}" if largest > 0 else ""
    words = (
        f"{count} against white innovations{named}{size}: "
        f"{'measurable, but small' if small else 'the one-step predictions are still correlated'} (below)."
    )
    return [Judgement(BELIEVE if small else CAUTION, words, "innovations")]


NO_CORRELATION = ("mean", "variance", "normality")
"""Kinds of tests that ask for the size and the shape of innovations, not for what they follow."""


def _test_in_words(row: InnovationTest) -> str:
    """The kind of a test: "mean", "autocorrelation", "correlation with inputs"."""
    test = row.test.split(" up to ")[0]
    return "correlation with inputs" if test.startswith("correlation with ") else test
