"""A discovery in sentences: verdict, causes and their forms, held-out test, and what to check."""

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
"""What follows from an answer of the causes that were judged."""
ACTIONS = {
    DiscoveryCode.ANSWER_BESIDE: DiscoveryCode.LOOK_FOR_RHYTHM,
    DiscoveryCode.ANSWER_UNKNOWN: DiscoveryCode.LOOK_FOR_RHYTHM,
    DiscoveryCode.ANSWER_REFUTED: DiscoveryCode.KEEP_BASE_MODEL,
    DiscoveryCode.ANSWER_UNPROVEN: DiscoveryCode.KEEP_BASE_MODEL,
    DiscoveryCode.ANSWER_NONE: DiscoveryCode.KEEP_BASE_MODEL,
}
"""What to do after an answer that does not name the whole cause."""
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
CRITERIA = {
    "likelihood": DiscoveryCode.BY_LIKELIHOOD,
    "output-error": DiscoveryCode.BY_OUTPUT_ERROR,
}
PERIOD = {"validation": "held-out readings", "identification": "identification readings"}
SHORT_DAYS = 14
"""Held-out days below which little can be refuted."""
MOST_SATURATED = 0.01
"""Share of readings at the sensor's ceiling from which condensation cannot be excluded."""
UNCHANGED = 5e-3
"""Relative change of an error that is told as none."""


# --- words -----------------------------------------------------------------------------------


def form_words(code: str) -> str:
    """The code of a form as it is read: "humidistat__at_standstill" -> "humidistat, at standstill",
    "in_summer_time:scada_log" -> "scada_log, in summer time"."""
    words, _, source = code.partition(":")
    return ", ".join([source] * bool(source) + [spoken(part) for part in words.split("__")])


def formed(one: CauseFound | Rejected) -> str:
    """A cause with its form: "unlogged heater (humidistat, at standstill)"."""
    cause = spoken(one.cause) or "unnamed cause"
    return f"{cause} ({form_words(one.form)})" if one.form else cause


def unchanged(before: float, after: float) -> bool:
    """Whether two errors are told as equal."""
    return abs(after - before) <= UNCHANGED * before


# --- the verdict -----------------------------------------------------------------------------


@dataclass(frozen=True)
class DiscoveryVerdict:
    """A discovery's verdict in words.

    headline: the first sentence; confidence: behind the only cause that it names, else "".
    reasons: doubts, what is left, the causes, and what limits the verdict.
    actions: what to check in the turbine, and what to do else.
    warned: whether the model is wrong, or the search did not end.
    """

    headline: str
    confidence: str
    reasons: tuple[str, ...]
    actions: tuple[str, ...]
    warned: bool


def verdict_of(found: DiscoveryResults) -> DiscoveryVerdict:
    """The verdict of a discovery in words."""
    refuted = tuple(map(formed, found.refuted))
    wrong = [
        DiscoveryCode.CONSTANT_WRONG(part=part, verdict=constant.words, why=constant.why)
        for part, constant in inherited(found.baseline.fit).items()
        if constant.verdict == REJECT
    ]
    code = _answer(found, bool(wrong))
    answer = code(causes=" + ".join(map(class_of, found.causes)) or "a cause", refuted=refuted)
    budget, ended = found.work.budget, bool(found.work.not_judged)
    reasons: list[Statement] = []
    actions = [text for cause in found.causes for text in _checks(cause)]
    if ended:
        none = code is DiscoveryCode.ANSWER_NONE
        reasons.append(DiscoveryCode.SO_FAR_NONE() if none else DiscoveryCode.SO_FAR(answer=answer))
        left = tuple(map(spoken, found.work.not_judged))
        answer = DiscoveryCode.ANSWER_ENDED(budget=budget, causes=left)
    reasons += [DiscoveryCode.SETTLE_DOUBT(doubt=doubt) for doubt in found.doubts]
    reasons += map(line_statement, found.lines)
    if code in MEANINGS and not (ended and code is DiscoveryCode.ANSWER_NONE):
        reasons.append(MEANINGS[code](tried=tried(found)))
    if code is DiscoveryCode.ANSWER_WRONG:
        reasons += wrong
    texts = [reason.text for reason in reasons]
    if found.refuted:
        beside = [] if found.verdict == "refuted" else [DiscoveryCode.ANSWER_REFUTED(refuted=refuted)]
        texts.append(joined(*beside, *map(refutation, found.refuted)))
    alone = len(found.causes) == 1 and not ended
    texts += [_cause(found, cause, alone) for cause in found.causes]
    texts += [DiscoveryCode.EXTENDED_STILL_ERRS(finding=finding.statement).text for finding in found.left[:1]]
    if found.saturated > MOST_SATURATED:
        texts.append(DiscoveryCode.READINGS_SATURATED(share=found.saturated).text)
    if ended:
        actions.append(DiscoveryCode.ALLOW_MORE_SIMULATIONS(budget=budget).text)
    elif code in ACTIONS:
        actions.append(ACTIONS[code]().text)
    repeated = {
        name: [s for s in spans if all(map(math.isfinite, s))] for name, spans in found.repeated.items()
    }
    if any(repeated.values()):
        texts.append(repeated_statement(repeated).text)
        actions.append(DiscoveryCode.FIND_OUT_REPEATS().text)
    sure = sure_of(found.causes[0]) if alone and found.verdict in ("named", "ambiguous") else ""
    return DiscoveryVerdict(
        capital(answer.text), sure, tuple(filter(None, texts)), tuple(actions), ended or code in WARNINGS
    )


def _answer(found: DiscoveryResults, wrong: bool) -> DiscoveryCode:
    """The answer of a discovery; wrong: whether a time constant of its base is rejected."""
    if found.verdict == "unexplained" and not found.causes:
        return DiscoveryCode.ANSWER_UNKNOWN
    if found.verdict == "refuted" and all(cause.held_out.reason == "unproven" for cause in found.refuted):
        return DiscoveryCode.ANSWER_UNPROVEN
    return DiscoveryCode.ANSWER_WRONG if found.verdict == "none" and wrong else ANSWERS[found.verdict]


def joined(*parts: Statement | str) -> str:
    """Statements parted by semicolons, without empty ones."""
    return "; ".join(filter(None, map(str, parts)))


def tried(found: DiscoveryResults) -> int:
    """How many causes were judged."""
    left = {cause.cause for cause in found.rejected if cause.reason not in ("left_to_budget", "no_form")}
    return len(left | {cause.cause for cause in found.causes} | {cause.cause for cause in found.refuted})


def class_of(one: CauseFound) -> str:
    """A cause with those that the record cannot tell from it; a long class names nothing."""
    rest = [spoken(rival) for rival in one.ambiguous_with]
    if not one.told_apart:
        return DiscoveryCode.NOT_TOLD_APART(causes=(spoken(one.cause), *rest)).text
    return listed([formed(one), *rest], "or")


def _cause(found: DiscoveryResults, one: CauseFound, alone: bool) -> str:
    """A cause: its name where the headline does not state it alone, meaning, mark and rivals."""
    name = "" if alone else ", ".join(filter(None, (class_of(one), sure_of(one))))
    meaning = ": ".join(filter(None, (name, "" if one.ambiguous_with else _meaning(one))))
    return joined(meaning, marked(found, one.held_out), alike_text(one))


# --- entries of the library ------------------------------------------------------------------


def _entry(one: CauseFound) -> Cause | CauseWords | None:
    """The entry of a cause in the package's library, or its own."""
    return one.own or next((cause for cause in LIBRARY.causes if cause.name == one.cause), None)


def _meaning(one: CauseFound) -> str:
    entry = _entry(one)
    return "" if entry is None else entry.meaning


def what_it_is(one: CauseFound) -> str:
    """What a cause is; its name where no library has it."""
    return _meaning(one) or spoken(one.cause)


def _checks(one: CauseFound) -> Iterator[str]:
    """What to check in the turbine, and the measurement that tells a cause from its rivals."""
    if (entry := _entry(one)) is None:
        return
    remedy, measurement = _remedy(one, entry.remedy), entry.separate_by
    if one.cause == SENSOR and not set(WATER).isdisjoint(one.ambiguous_with):
        remedy = measurement = DiscoveryCode.COMPARE_SENSORS().text
    if one.told_apart and remedy not in ("", measurement):
        yield DiscoveryCode.CHECK_TURBINE(cause=one.cause, remedy=remedy).text
    if one.ambiguous_with and measurement:
        yield DiscoveryCode.TELL_FROM_RIVALS(cause=one.cause, measurement=measurement).text


def _remedy(one: CauseFound, remedy: str) -> str:
    """What to check; for a clock's error also the line that corrects it until then."""
    shift_s, source = one.settings.get("shift_s"), one.settings.get("source")
    if isinstance(shift_s, int | float) and isinstance(source, str) and not one.settings.get("summer"):
        correction = f"{shift_s / 60.0:+.4g}min"
        return DiscoveryCode.CORRECT_CLOCK(remedy=remedy, correction=correction, source=source).text
    return remedy


def line_statement(one: SpectralLine) -> Statement:
    """A line that is left in a spectrum."""
    name = quantity(one.quantity).words
    if one.period_h >= 48.0:
        period = DiscoveryCode.PERIOD_IN_DAYS(days=one.period_h / 24.0)
    else:
        period = DiscoveryCode.PERIOD_IN_HOURS(hours=one.period_h)
    if one.cause:
        return DiscoveryCode.PERIOD_IN_SCORES(cause=one.cause, quantity=name, period=period)
    return DiscoveryCode.PERIOD_IN_ERRORS(quantity=name, period=period)


# --- errors ----------------------------------------------------------------------------------


def selected(found: DiscoveryResults) -> bool:
    """Whether held-out readings were used to refute causes."""
    return found.held_out_days > 0 and bool(found.causes or found.refuted)


def place_of(found: DiscoveryResults, gain: ErrorGain) -> str:
    """The readings that errors are told from."""
    after = ", after selection" if gain.period == "validation" and selected(found) else ""
    return f"{PERIOD.get(gain.period, gain.period)}{after}"


def held_out_sentences(found: DiscoveryResults) -> list[str]:
    """How both models were estimated, and what the held-out part can show."""
    statements = []
    if found.estimator:
        both = found.extended is not None
        code = DiscoveryCode.BOTH_MODELS_ESTIMATED if both else DiscoveryCode.ONE_MODEL_ESTIMATED
        statements.append(code(criterion=CRITERIA[found.estimator]()))
    days = found.held_out_days
    if not days:
        statements.append(DiscoveryCode.NOTHING_REFUTED())
    elif days < SHORT_DAYS:
        statements.append(DiscoveryCode.FEW_DAYS_HELD_OUT(days=days))
    if selected(found):
        statements.append(DiscoveryCode.AFTER_SELECTION())
    return [sentence(statement.text) for statement in statements]


# --- a cause ---------------------------------------------------------------------------------


def sure_of(one: CauseFound) -> str:
    """The confidence behind a name; empty for a class that names nothing."""
    if not one.told_apart:
        return ""
    if not math.isfinite(one.confidence):
        return DiscoveryCode.CONFIDENCE_NOT_STATED().text
    near = one.confidence >= 0.995
    code = DiscoveryCode.CONFIDENCE_NEAR_ONE if near else DiscoveryCode.CONFIDENCE
    return code(share=one.confidence).text


def marked(found: DiscoveryResults, one: HeldOutTest) -> str:
    """The mark of a cause that does not lower the held-out errors; empty for one that does."""
    if not found.held_out_days:
        return ""
    if not one.days:
        return DiscoveryCode.NOT_SEEN().text
    return DiscoveryCode.NOT_BETTER().text if one.improvement < LEAST_IMPROVEMENT else ""


def refutation(one: Rejected) -> Statement:
    """Why held-out readings refute a cause."""
    test = one.held_out
    grown = [q for q in test.z if test.growth.get(q, math.nan) > WORSE_GROWTH]
    names = tuple(dict.fromkeys(quantity(q).words for q in grown)) or ("cabinet",)
    return REFUTATIONS[test.reason](cause=one.cause, quantities=names, least=LEAST_IMPROVEMENT)


def held_out_text(found: DiscoveryResults, one: HeldOutTest) -> str:
    """What held-out readings say of a cause beside the errors of its table."""
    if not one.days:
        code = DiscoveryCode.NOT_SEEN if found.held_out_days else DiscoveryCode.NO_READINGS_HELD_OUT
        return code().text
    statements = [DiscoveryCode.ERROR_FALLS(share=one.improvement)]
    if math.isfinite(one.gain):
        code = DiscoveryCode.LIKELIHOOD_GROWS if one.gain >= 0 else DiscoveryCode.LIKELIHOOD_FALLS
        statements.append(code(change=abs(one.gain)))
    return joined(*statements, DiscoveryCode.DAYS_WITH_READINGS(days=one.days))


def alike_text(cause: CauseFound) -> str:
    """The forms and causes that this record cannot tell apart; empty where there are none."""
    statements = []
    if cause.forms_alike:
        statements.append(DiscoveryCode.ALIKE_FORMS(forms=tuple(map(form_words, cause.forms_alike))))
    if cause.ambiguous_with and cause.told_apart:
        statements.append(DiscoveryCode.ALIKE_CAUSES(causes=tuple(map(spoken, cause.ambiguous_with))))
    return joined(*statements)


def outcome(found: DiscoveryResults, one: CauseFound | Rejected) -> str:
    """That a cause was accepted, with its lead [1] in days, or why it was left out."""
    if isinstance(one, CauseFound):
        known = math.isfinite(one.evidence.lead)
        code = DiscoveryCode.ACCEPTED_AHEAD if known else DiscoveryCode.ACCEPTED
        return code(lead=one.evidence.lead).text
    why = EXCLUSIONS[one.reason]()
    hidden = one.cause == "condensation" and found.saturated > MOST_SATURATED
    return DiscoveryCode.MAYBE_HIDDEN(why=why).text if hidden else why.text


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
"""Setting that a search chose → statement."""


def chosen_words(cause: CauseFound) -> Iterator[str]:
    """What the search chose of a cause's form, in words."""
    for name in (setting for setting in cause.chosen if setting in cause.settings):
        value = cause.settings[name]
        statement = DiscoveryCode.CHOSEN_OTHER(name=name, value=str(value))
        if name in CHOSEN:
            with suppress(TypeError, ValueError):  # a user's own feature may mean something else by it
                statement = CHOSEN[name](value)
        against = cause.settings.get("relative_to") if name == "shift_s" else None
        if against:
            statement = DiscoveryCode.AGAINST_SOURCE(shift=statement, source=str(against))
        yield statement.text
