"""A discovery in sentences: the verdict, the causes and their forms, the held-out test, and what to check."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from hygrokf.discovery.candidates import SENSOR, WATER
from hygrokf.discovery.discovery_results import (
    CauseFound,
    CauseWords,
    DiscoveryResults,
    ErrorGain,
    Exclusion,
    HeldOutTest,
    Reason,
    Rejected,
    SpectralLine,
    Verdict,
)
from hygrokf.discovery.judgement import LEAST_IMPROVEMENT, WORSE_GROWTH
from hygrokf.discovery.repeats import repeated_statement
from hygrokf.identification.verdict import inherited
from hygrokf.modelling.causes.cause import Cause
from hygrokf.modelling.library import LIBRARY
from hygrokf.report.quantities import capital, quantity, spoken
from hygrokf.texts.discovery_codes import DiscoveryCode
from hygrokf.texts.reasons import REJECT
from hygrokf.texts.statement import Statement, listed
from hygrokf.texts.wording import sentence

ANSWERS: Mapping[Verdict, DiscoveryCode] = {
    "ambiguous": DiscoveryCode.ANSWER_CAUSES,
    "named": DiscoveryCode.ANSWER_CAUSES,
    "none": DiscoveryCode.ANSWER_NONE,
    "refuted": DiscoveryCode.ANSWER_REFUTED,
    "unexplained": DiscoveryCode.ANSWER_BESIDE,
}
MEANINGS = {
    DiscoveryCode.ANSWER_NONE: DiscoveryCode.NONE_HAS_EVIDENCE,
    DiscoveryCode.ANSWER_WRONG: DiscoveryCode.NONE_BUT_WRONG,
    DiscoveryCode.ANSWER_UNKNOWN: DiscoveryCode.NONE_EXPLAINS,
}
"""Answer → what it means for the causes that were judged."""
ACTIONS = {
    DiscoveryCode.ANSWER_BESIDE: DiscoveryCode.LOOK_FOR_RHYTHM,
    DiscoveryCode.ANSWER_UNKNOWN: DiscoveryCode.LOOK_FOR_RHYTHM,
    DiscoveryCode.ANSWER_REFUTED: DiscoveryCode.KEEP_BASE_MODEL,
    DiscoveryCode.ANSWER_UNPROVEN: DiscoveryCode.KEEP_BASE_MODEL,
    DiscoveryCode.ANSWER_NONE: DiscoveryCode.KEEP_BASE_MODEL,
}
"""Answer that does not name the whole cause → what to do."""
WARNINGS = (DiscoveryCode.ANSWER_BESIDE, DiscoveryCode.ANSWER_UNKNOWN, DiscoveryCode.ANSWER_WRONG)
REFUTATIONS: Mapping[Reason, DiscoveryCode] = {
    "no_effect": DiscoveryCode.REFUTED_NO_EFFECT,
    "no_gain": DiscoveryCode.REFUTED_NO_GAIN,
    "unproven": DiscoveryCode.REFUTED_UNPROVEN,
    "worse": DiscoveryCode.REFUTED_WORSE,
    "": DiscoveryCode.REFUTED_WORSE,
}
EXCLUSIONS: Mapping[Exclusion, DiscoveryCode] = {
    "refuted": DiscoveryCode.EXCLUDED_REFUTED,
    "no_effect": DiscoveryCode.EXCLUDED_NO_EFFECT,
    "weak": DiscoveryCode.EXCLUDED_WEAK,
    "weak_by_days": DiscoveryCode.EXCLUDED_WEAK_BY_DAYS,
    "later_gone": DiscoveryCode.EXCLUDED_LATER_GONE,
    "left_to_budget": DiscoveryCode.EXCLUDED_LEFT_TO_BUDGET,
    "no_form": DiscoveryCode.EXCLUDED_NO_FORM,
}
CRITERION_CODES = {
    "likelihood": DiscoveryCode.BY_LIKELIHOOD,
    "output-error": DiscoveryCode.BY_OUTPUT_ERROR,
}
PERIOD = {"validation": "held-out readings", "identification": "identification readings"}
SHORT_DAYS = 14
"""[d] with fewer held-out days little can be refuted."""
MOST_SATURATED = 0.01
"""Share of readings at the sensor's ceiling from which condensation cannot be excluded."""
UNCHANGED = 5e-3
"""Largest relative change of an error that is reported as no change."""


# --- words -----------------------------------------------------------------------------------


def form_words(code: str) -> str:
    """Return the code of a form in words: "humidistat__at_standstill" → "humidistat, at standstill",
    "in_summer_time:scada_log" → "scada_log, in summer time"."""
    words, _, source = code.partition(":")
    return ", ".join([source] * bool(source) + [spoken(part) for part in words.split("__")])


def cause_with_form(cause: CauseFound | Rejected) -> str:
    """Return a cause with its form: "unlogged heater (humidistat, at standstill)"."""
    name = spoken(cause.cause) or "unnamed cause"
    return f"{name} ({form_words(cause.form)})" if cause.form else name


def unchanged(before: float, after: float) -> bool:
    """Return whether two errors are so close that no change is reported."""
    return abs(after - before) <= UNCHANGED * before


# --- the verdict -----------------------------------------------------------------------------


@dataclass(frozen=True)
class DiscoveryVerdict:
    """The verdict of a discovery in words.

    headline: the first sentence. confidence: in the only cause that the headline names, else "".
    reasons: doubts, errors that remain, the causes, and what limits the verdict.
    actions: what to check in the turbine, and what else to do.
    warned: whether the model is wrong, or the search did not end.
    """

    headline: str
    confidence: str
    reasons: tuple[str, ...]
    actions: tuple[str, ...]
    warned: bool


def discovery_verdict(results: DiscoveryResults) -> DiscoveryVerdict:
    """Return the verdict of a discovery in words."""
    refuted = tuple(map(cause_with_form, results.refuted))
    rejected_constants = [
        DiscoveryCode.CONSTANT_WRONG(part=part, verdict=constant.words, why=constant.why)
        for part, constant in inherited(results.baseline.fit).items()
        if constant.verdict == REJECT
    ]
    code = _answer(results, bool(rejected_constants))
    answer = code(causes=" + ".join(map(class_of, results.causes)) or "a cause", refuted=refuted)
    budget, has_budget_ended = results.work.budget, bool(results.work.not_judged)
    reasons: list[Statement] = []
    actions = [text for cause in results.causes for text in _checks(cause)]
    if has_budget_ended:
        is_none = code is DiscoveryCode.ANSWER_NONE
        reasons.append(DiscoveryCode.SO_FAR_NONE() if is_none else DiscoveryCode.SO_FAR(answer=answer))
        not_judged = tuple(map(spoken, results.work.not_judged))
        answer = DiscoveryCode.ANSWER_ENDED(budget=budget, causes=not_judged)
    reasons += [DiscoveryCode.SETTLE_DOUBT(doubt=doubt) for doubt in results.doubts]
    reasons += map(line_statement, results.lines)
    if code in MEANINGS and not (has_budget_ended and code is DiscoveryCode.ANSWER_NONE):
        reasons.append(MEANINGS[code](tried=count_judged(results)))
    if code is DiscoveryCode.ANSWER_WRONG:
        reasons += rejected_constants
    texts = [reason.text for reason in reasons]
    if results.refuted:
        refuted_statement = (
            [] if results.verdict == "refuted" else [DiscoveryCode.ANSWER_REFUTED(refuted=refuted)]
        )
        texts.append(joined(*refuted_statement, *map(refutation, results.refuted)))
    is_only_cause = len(results.causes) == 1 and not has_budget_ended
    texts += [_cause(results, cause, is_only_cause) for cause in results.causes]
    texts += [
        DiscoveryCode.EXTENDED_STILL_ERRS(finding=finding.statement).text for finding in results.left[:1]
    ]
    if results.saturated > MOST_SATURATED:
        texts.append(DiscoveryCode.READINGS_SATURATED(share=results.saturated).text)
    if has_budget_ended:
        actions.append(DiscoveryCode.ALLOW_MORE_SIMULATIONS(budget=budget).text)
    elif code in ACTIONS:
        actions.append(ACTIONS[code]().text)
    repeated = {
        name: [span for span in spans if all(map(math.isfinite, span))]
        for name, spans in results.repeated.items()
    }
    if any(repeated.values()):
        texts.append(repeated_statement(repeated).text)
        actions.append(DiscoveryCode.FIND_OUT_REPEATS().text)
    confidence = (
        confidence_text(results.causes[0])
        if is_only_cause and results.verdict in ("named", "ambiguous")
        else ""
    )
    return DiscoveryVerdict(
        capital(answer.text),
        confidence,
        tuple(filter(None, texts)),
        tuple(actions),
        has_budget_ended or code in WARNINGS,
    )


def _answer(results: DiscoveryResults, is_wrong: bool) -> DiscoveryCode:
    """Return the code of the answer; is_wrong: whether a time constant of the base model is rejected."""
    if results.verdict == "unexplained" and not results.causes:
        return DiscoveryCode.ANSWER_UNKNOWN
    if results.verdict == "refuted" and all(cause.held_out.reason == "unproven" for cause in results.refuted):
        return DiscoveryCode.ANSWER_UNPROVEN
    return DiscoveryCode.ANSWER_WRONG if results.verdict == "none" and is_wrong else ANSWERS[results.verdict]


def joined(*parts: Statement | str) -> str:
    """Join statements by semicolons; empty ones are left out."""
    return "; ".join(filter(None, map(str, parts)))


def count_judged(results: DiscoveryResults) -> int:
    """Return how many causes were judged."""
    rejected = {
        cause.cause for cause in results.rejected if cause.reason not in ("left_to_budget", "no_form")
    }
    return len(
        rejected | {cause.cause for cause in results.causes} | {cause.cause for cause in results.refuted}
    )


def class_of(cause: CauseFound) -> str:
    """A cause with the rivals that the record cannot distinguish from it; no name for too many rivals."""
    rivals = [spoken(rival) for rival in cause.ambiguous_with]
    if not cause.told_apart:
        return DiscoveryCode.NOT_TOLD_APART(causes=(spoken(cause.cause), *rivals)).text
    return listed([cause_with_form(cause), *rivals], "or")


def _cause(results: DiscoveryResults, cause: CauseFound, is_headline: bool) -> str:
    """A cause with its meaning, remark and rivals; without its name if the headline states it."""
    name_with_confidence = (
        "" if is_headline else ", ".join(filter(None, (class_of(cause), confidence_text(cause))))
    )
    meaning = ": ".join(filter(None, (name_with_confidence, "" if cause.ambiguous_with else _meaning(cause))))
    return joined(meaning, held_out_remark(results, cause.held_out), rivals_text(cause))


# --- entries of the library ------------------------------------------------------------------


def _entry(cause: CauseFound) -> Cause | CauseWords | None:
    """Return the entry of a cause in the library, or the words that the result itself holds for it."""
    return cause.own or next((entry for entry in LIBRARY.causes if entry.name == cause.cause), None)


def _meaning(cause: CauseFound) -> str:
    """Return the meaning of a cause; empty if no library has it."""
    entry = _entry(cause)
    return "" if entry is None else entry.meaning


def what_it_is(cause: CauseFound) -> str:
    """Return the meaning of a cause; its name if no library has it."""
    return _meaning(cause) or spoken(cause.cause)


def _checks(cause: CauseFound) -> Iterator[str]:
    """Yield what to check in the turbine for a cause, and the measurement that distinguishes it from its
    rivals."""
    if (entry := _entry(cause)) is None:
        return
    remedy, measurement = _remedy(cause, entry.remedy), entry.separate_by
    if cause.cause == SENSOR and not set(WATER).isdisjoint(cause.ambiguous_with):
        remedy = measurement = DiscoveryCode.COMPARE_SENSORS().text
    if cause.told_apart and remedy not in ("", measurement):
        yield DiscoveryCode.CHECK_TURBINE(cause=cause.cause, remedy=remedy).text
    if cause.ambiguous_with and measurement:
        yield DiscoveryCode.TELL_FROM_RIVALS(cause=cause.cause, measurement=measurement).text


def _remedy(cause: CauseFound, remedy: str) -> str:
    """Return what to check; for a clock error also the key of the case file that corrects it until then."""
    shift_s, source = cause.settings.get("shift_s"), cause.settings.get("source")
    if isinstance(shift_s, int | float) and isinstance(source, str) and not cause.settings.get("summer"):
        correction = f"{shift_s / 60.0:+.4g}min"
        return DiscoveryCode.CORRECT_CLOCK(remedy=remedy, correction=correction, source=source).text
    return remedy


def line_statement(line: SpectralLine) -> Statement:
    """Return the statement on a periodic component in the spectrum of the errors or of a cause's scores."""
    name = quantity(line.quantity).words
    if line.period_h >= 48.0:
        period = DiscoveryCode.PERIOD_IN_DAYS(days=line.period_h / 24.0)
    else:
        period = DiscoveryCode.PERIOD_IN_HOURS(hours=line.period_h)
    if line.cause:
        return DiscoveryCode.PERIOD_IN_SCORES(cause=line.cause, quantity=name, period=period)
    return DiscoveryCode.PERIOD_IN_ERRORS(quantity=name, period=period)


# --- errors ----------------------------------------------------------------------------------


def selected(results: DiscoveryResults) -> bool:
    """Return whether held-out readings were used to refute causes."""
    return results.held_out_days > 0 and bool(results.causes or results.refuted)


def readings_of(results: DiscoveryResults, gain: ErrorGain) -> str:
    """Return in words which readings the errors of a gain were computed from."""
    after = ", after selection" if gain.period == "validation" and selected(results) else ""
    return f"{PERIOD.get(gain.period, gain.period)}{after}"


def held_out_sentences(results: DiscoveryResults) -> list[str]:
    """Return sentences on the criterion of both models, and on what the held-out readings can show."""
    statements = []
    if results.estimator:
        has_extended = results.extended is not None
        code = DiscoveryCode.BOTH_MODELS_ESTIMATED if has_extended else DiscoveryCode.ONE_MODEL_ESTIMATED
        statements.append(code(criterion=CRITERION_CODES[results.estimator]()))
    days = results.held_out_days
    if not days:
        statements.append(DiscoveryCode.NOTHING_REFUTED())
    elif days < SHORT_DAYS:
        statements.append(DiscoveryCode.FEW_DAYS_HELD_OUT(days=days))
    if selected(results):
        statements.append(DiscoveryCode.AFTER_SELECTION())
    return [sentence(statement.text) for statement in statements]


# --- a cause ---------------------------------------------------------------------------------


def confidence_text(cause: CauseFound) -> str:
    """Return the confidence in the named cause; empty if too many causes are alike to name one."""
    if not cause.told_apart:
        return ""
    if not math.isfinite(cause.confidence):
        return DiscoveryCode.CONFIDENCE_NOT_STATED().text
    is_near_one = cause.confidence >= 0.995
    code = DiscoveryCode.CONFIDENCE_NEAR_ONE if is_near_one else DiscoveryCode.CONFIDENCE
    return code(share=cause.confidence).text


def held_out_remark(results: DiscoveryResults, test: HeldOutTest) -> str:
    """Return the remark on a cause that does not lower the held-out errors; empty for one that does."""
    if not results.held_out_days:
        return ""
    if not test.days:
        return DiscoveryCode.NOT_SEEN().text
    return DiscoveryCode.NOT_BETTER().text if test.improvement < LEAST_IMPROVEMENT else ""


def refutation(cause: Rejected) -> Statement:
    """Return why held-out readings refute a cause."""
    test = cause.held_out
    worse_quantities = [name for name in test.z if test.growth.get(name, math.nan) > WORSE_GROWTH]
    names = tuple(dict.fromkeys(quantity(name).words for name in worse_quantities)) or ("cabinet",)
    return REFUTATIONS[test.reason](cause=cause.cause, quantities=names, least=LEAST_IMPROVEMENT)


def held_out_text(results: DiscoveryResults, test: HeldOutTest) -> str:
    """Return what the held-out readings show of a cause, besides the errors in its table."""
    if not test.days:
        code = DiscoveryCode.NOT_SEEN if results.held_out_days else DiscoveryCode.NO_READINGS_HELD_OUT
        return code().text
    statements = [DiscoveryCode.ERROR_FALLS(share=test.improvement)]
    if math.isfinite(test.gain):
        code = DiscoveryCode.LIKELIHOOD_GROWS if test.gain >= 0 else DiscoveryCode.LIKELIHOOD_FALLS
        statements.append(code(change=abs(test.gain)))
    return joined(*statements, DiscoveryCode.DAYS_WITH_READINGS(days=test.days))


def rivals_text(cause: CauseFound) -> str:
    """Return the forms and causes that this record cannot distinguish; empty without any."""
    statements = []
    if cause.forms_alike:
        statements.append(DiscoveryCode.ALIKE_FORMS(forms=tuple(map(form_words, cause.forms_alike))))
    if cause.ambiguous_with and cause.told_apart:
        statements.append(DiscoveryCode.ALIKE_CAUSES(causes=tuple(map(spoken, cause.ambiguous_with))))
    return joined(*statements)


def outcome(results: DiscoveryResults, cause: CauseFound | Rejected) -> str:
    """Whether a cause was accepted, with its lead over the best rival, or why it was excluded."""
    if isinstance(cause, CauseFound):
        has_lead = math.isfinite(cause.evidence.lead)
        code = DiscoveryCode.ACCEPTED_AHEAD if has_lead else DiscoveryCode.ACCEPTED
        return code(lead=cause.evidence.lead).text
    exclusion = EXCLUSIONS[cause.reason]()
    may_be_hidden = cause.cause == "condensation" and results.saturated > MOST_SATURATED
    return DiscoveryCode.MAYBE_HIDDEN(why=exclusion).text if may_be_hidden else exclusion.text


CHOSEN: Mapping[str, Callable[[Any], Statement]] = {
    "date_s": lambda date_s: DiscoveryCode.CHOSEN_DATE(date=float(date_s)),
    "spans": lambda spans: DiscoveryCode.CHOSEN_SPANS(
        spans=tuple(DiscoveryCode.CHOSEN_SPAN(first=float(a), last=float(b)) for a, b in spans)
    ),
    "azimuth_deg": lambda azimuth: DiscoveryCode.CHOSEN_AZIMUTH(azimuth=float(azimuth)),
    "days": lambda days: DiscoveryCode.CHOSEN_DAYS(days=float(days)),
    "start_h": lambda hour: DiscoveryCode.CHOSEN_START(hour=float(hour)),
    "hours": lambda hours: DiscoveryCode.CHOSEN_LENGTH(hours=float(hours)),
    "shift_s": lambda shift_s: DiscoveryCode.CHOSEN_SHIFT(minutes=float(shift_s) / 60.0),
}
"""Setting of a cause's form that the search chose → function that makes its statement from the value."""


def chosen_words(cause: CauseFound) -> Iterator[str]:
    """Yield the settings of a cause's form that the search chose, in words."""
    for name in (setting for setting in cause.chosen if setting in cause.settings):
        value = cause.settings[name]
        statement = DiscoveryCode.CHOSEN_OTHER(name=name, value=str(value))
        if name in CHOSEN:
            with suppress(TypeError, ValueError):  # a user's own feature may mean something else by it
                statement = CHOSEN[name](value)
        reference_source = cause.settings.get("relative_to") if name == "shift_s" else None
        if reference_source:
            statement = DiscoveryCode.AGAINST_SOURCE(shift=statement, source=str(reference_source))
        yield statement.text
