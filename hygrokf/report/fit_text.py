"""Numbers and judgements of a fit in words.

Any part of the results may be missing.  Whether a time constant is reliable is decided by its verdict
(`identification.verdict`), not here.
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
)
from hygrokf.identification.wording import (
    NONE,
    QUANTITIES,
    ends,
    fixed,
    interval,
    minus,
    percent,
    plain_number,
    sentence,
)
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
    """A time constant as printed: `value` ("1.49 h", "≤ 0.4 h", "not identifiable") and `bounds`.

    `closed`: whether the interval has both ends.  `verdict`: whether the number is reliable.
    """

    name: str
    value: str
    bounds: str
    closed: bool
    found: fit_results.TimeConstant | None
    verdict: Verdict = field(default_factory=Verdict)


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


def simulated(found: fit_results.TimeConstant | None) -> tuple[str, str]:
    """The estimate by the free run alone and its bounds [h], as printed; empty where there are none."""
    free = (None if found is None else found.simulation) or Interval()
    value, low, high = free.value_h, free.lower_h, free.upper_h
    if not math.isfinite(value):
        return "", ""
    if not (math.isfinite(low) and math.isfinite(high) and high > low):
        return f"{plain_number(value)} h", ""
    shown, span = ends(value, low, high)
    return f"{shown} h", span


def free_run_text(found: fit_results.TimeConstant | None) -> str:
    """The estimate by the free run alone with its bounds: "1.52 h (1.29 … 1.75)"; empty without one."""
    value, span = simulated(found)
    return f"{value} ({span})" if span else value


def share_text(share: float) -> str:
    """A share [1] that may be negative, in whole per cent."""
    return percent(0.0) if abs(share) < 0.005 else minus(percent(share))


def p_value(p: float) -> str:
    """A probability as printed."""
    return NONE if math.isnan(p) else "< 0.001" if p < 0.001 else f"{p:.3f}"


def range_of(found: fit_results.TimeConstant | None) -> tuple[float, float]:
    """The time constant [h] at the ends of the record's temperatures; NaN where it has no such range."""
    ends_h = (found.range_h if found is not None else None) or ()
    known = len(ends_h) == 2 and all(map(math.isfinite, ends_h))
    return (ends_h[0], ends_h[1]) if known else (math.nan, math.nan)


# --- judgements ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Judgement:
    """One sentence with its verdict ("believe", "caution", "reject") and its subject.

    `about`: a time constant ("thermal", "hygric"), a scored quantity, a kind of bands, "innovations" or
    "record".  `reason`: whether it is a reason for the judgement before it.
    """

    kind: str
    sentence: str
    about: str
    reason: bool = False


def judgements(fit: FitResults) -> list[Judgement]:
    """The verdicts on the time constants with their reasons, then those on errors, bands and innovations."""
    found = [one for name in PARTS for one in _time_constant(fit, name)]
    found += [one for name in PARTS for one in _errors(fit, name)]
    return [*found, *_bands(fit), *_innovations(fit)]


def doubted(fit: FitResults) -> list[Judgement]:
    """Doubts about the record itself, to be shown before everything else."""
    return [
        Judgement(CAUTION, f"Doubt about the record: {line}{'' if line[-1] in '.?!' else '.'}", "record")
        for line in fit.doubts
        if line
    ]


def head(fit: FitResults, name: str) -> str:
    """Whether a time constant is reliable, in a sentence; a colon at its end leads to the reasons."""
    constant = time_constant(fit, name)
    if constant.found is None:
        return f"There is no {name} time constant: nothing in the record determines one."
    known = constant.value
    if constant.closed:
        found = constant.found
        known += f", known to {spread_words(found.value_h, found.lower_h, found.upper_h)}"
    return {
        BELIEVE: f"The {name} time constant, {known}, is reliable.",
        CAUTION: f"The {name} time constant, {known}, should be used with caution:",
        REJECT: f"The {name} time constant ({known}) is not reliable:",
    }[constant.verdict.verdict]


def _time_constant(fit: FitResults, name: str) -> list[Judgement]:
    constant = time_constant(fit, name)
    if constant.found is None:
        return [Judgement(CAUTION, head(fit, name), name)]
    verdict = constant.verdict
    made = [Judgement(verdict.verdict, head(fit, name), name)]
    made += [
        Judgement(one.verdict, sentence(one.text), name, reason=True)
        for one in verdict.reasons
        if one.code != "record_doubted" or one.text.partition(": ")[2] not in fit.doubts
    ]
    other = free_run_text(constant.found)
    if verdict.verdict == BELIEVE and other and free_run_informs(constant.found):
        said = f"The free run alone gives {other}: both criteria agree."
        made.append(Judgement(BELIEVE, said, name, reason=True))
    return made


def _errors(fit: FitResults, part: str) -> list[Judgement]:
    """The free run's error in validation (else in identification) and against the best rule, as one
    judgement."""
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
                f"deviation of the readings ({fixed(beyond[1])} {unit}): their mean would predict better."
            )
            return [Judgement(REJECT, said, quantity)]
    kind, ends = BELIEVE, ""
    if not validated:
        kind = CAUTION
        begins = (
            f"The free run's {name} error is {fixed(early)} {unit} on the data that the model was fitted to: "
            "no later data validate it"
        )
    else:
        begins = f"The free run's {name} error is {fixed(late)} {unit} in validation"
        if math.isfinite(early) and early > 0:
            begins += f" after {fixed(early)} {unit} in identification"
            if late > CARRIES_OVER * early:
                kind, ends = CAUTION, "the model does worse on new data"
            else:
                ends = "the model does as well on new data"
    rule = best_rule(fit, quantity, period)
    if rule is not None:
        against = f"the rule “{rule.words}” ({fixed(rule.rule)} {unit} in {period})"
        if rule.gain >= MATERIAL:
            joint = "" if not ends else ", but " if kind == CAUTION else ", and "
            ends += f"{joint}it errs {percent(rule.gain)} less than {against}"
        else:
            worse = rule.gain < -MATERIAL
            beside = "worse" if worse else "hardly better" if rule.gain >= 0.0 else "no better"
            # that the error stays the same is no success where a rule without a model errs as little
            lost = ends if kind == CAUTION else ""
            kind = REJECT if worse else CAUTION
            ends = f"{f'{lost}, and ' if lost else ''}it is {beside} than {against}"
            verdict = verdicts(fit).get(part)
            if verdict is not None and verdict.verdict != REJECT:
                ends += "; the time constant describes the cabinet but makes the prediction no better"
    share = fit.sensor_share.get(period, {}).get(quantity, math.nan)
    said = f"{begins}{': ' if ends else ''}{ends}."
    if share >= 0.5:
        said += f" The accuracy of the sensors explains {percent(share)} of the squared error."
    return [Judgement(kind, said, quantity)]


def _bands(fit: FitResults) -> list[Judgement]:
    """The free run's bands that fail, then all bands by how many readings they hold."""
    found: dict[str, list[str]] = {"bands that hold": [], "narrow bands": [], "wide bands": []}
    for lead in fit.bands:
        for quantity in SCORED:
            band = fit.band(lead, quantity)
            share = band.coverage
            if math.isfinite(share) and band.n >= FEWEST_IN_BAND:
                low, high = COVERAGE
                kind = "narrow bands" if share < low else "wide bands" if share > high else "bands that hold"
                found[kind].append(f"{lead_words(lead)} {QUANTITIES[quantity][0]} {percent(share)}")
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
    words = {
        "bands that hold": (BELIEVE, "hold about 95 % of the readings"),
        "narrow bands": (CAUTION, "are too narrow"),
        "wide bands": (CAUTION, "are wider than needed"),
    }
    return made + [
        Judgement(verdict, f"95 % bands that {said}: {', '.join(found[kind])}.", kind)
        for kind, (verdict, said) in words.items()
        if found[kind]
    ]


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
    count = f"{len(against)} of {len(rows)} tests {'rejects' if len(against) == 1 else 'reject'}"
    if not against:
        said = f"None of {len(rows)} tests rejects white innovations."
        return [Judgement(BELIEVE, said, "innovations")]
    if kinds and set(kinds) <= set(NO_CORRELATION):
        said = f"{count} white innovations{named}, but none finds a correlation (see the tests)."
        return [Judgement(CAUTION, said, "innovations")]
    largest = max((largest_correlation(fit, name)[0] for name in fit.innovations.outputs), default=0.0)
    small = largest < SMALL
    size = f", by correlations of at most {fixed(largest)}" if largest > 0 else ""
    what = "measurable, but small" if small else "the one-step predictions are still correlated"
    words = f"{count} white innovations{named}{size}: {what} (see the tests)."
    return [Judgement(BELIEVE if small else CAUTION, words, "innovations")]


NO_CORRELATION = ("mean", "variance", "normality")
"""Kinds of tests of the size and the distribution of innovations, not of their correlation."""


def _test_in_words(row: InnovationTest) -> str:
    """The kind of a test: "mean", "autocorrelation", "correlation with inputs"."""
    test = row.test.split(" up to ")[0]
    return "correlation with inputs" if test.startswith("correlation with ") else test
