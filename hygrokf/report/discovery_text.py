"""A discovery in sentences: verdict, causes and their forms, held-out test, and what to check."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from hygrokf.discovery.judgement import LEAST_IMPROVEMENT, WORSE_GROWTH
from hygrokf.discovery.repeats import repeated_text
from hygrokf.discovery.results import (
    CauseFound,
    DiscoveryResults,
    ErrorGain,
    HeldOutTest,
    Rejected,
    SpectralLine,
)
from hygrokf.identification.verdict import inherited
from hygrokf.report.quantities import capital, listed, quantity, spoken
from hygrokf.texts.verdict import REJECT
from hygrokf.texts.wording import fixed, percent, plain_number, sentence, stamp_text

EXCLUSIONS = {
    "refuted": "held-out readings refute it",
    "no_effect": "the screening finds no effect",
    "weak": "too little evidence",
    "weak_by_days": "too little evidence in independent days",
    "later_gone": "it lost its place to a cause that was accepted later",
    "left_to_budget": "not judged: the budget ended the search",
    "no_form": "this record cannot show it",
}
"""Why a cause was left out."""
REFUTATIONS = {
    "no_effect": "in the final set of parameters it has no effect",
    "no_gain": "held-out readings speak against it more strongly than the others speak for it",
    "unproven": "its evidence is small, and it lowers no held-out free-run error by {least}",
    "worse": "with it the errors of the {names} on held-out readings grow",
}
"""Why held-out readings refute a cause."""
ESTIMATORS = {
    "likelihood": "maximise the likelihood of the search",
    "output-error": "minimise the error of the free run (output error)",
}
ANSWERS = {
    "named": "{names}",
    "ambiguous": "{names}",
    "unexplained": "something is missing beside {names}",
    "unexplained, no name": "something is missing; the cause is unknown",
    "refuted": "held-out readings refute {refuted}",
    "unproven": "held-out readings do not bear out {refuted}",
    "none": "this record shows no missing cause",
    "wrong": "no cause was found, but the model is not right",
}
"""The verdict in a few words."""
MEANINGS = {
    "none": "has enough evidence; the errors look like the ordinary disturbances of a cabinet",
    "wrong": "has enough evidence, yet the base model is wrong",
    "unexplained, no name": "explains it, so no cause is named",
}
"""What follows from it of the causes that were judged."""
RHYTHM = "look for influences with this period that are not logged: tides, routines, duty cycles"
KEEP = "keep the base model; a cause may be missing that this record does not show"
ACTIONS = {
    "unexplained": RHYTHM, "unexplained, no name": RHYTHM, "refuted": KEEP, "unproven": KEEP, "none": KEEP,
}  # fmt: skip
"""What to do after a verdict that does not name the whole cause."""
WARNINGS = ("unexplained", "unexplained, no name", "wrong")
PERIOD = {"validation": "held-out readings", "identification": "identification readings"}
NOT_BETTER = "it does not improve the prediction of held-out readings"
NOT_SEEN = "held-out readings show nothing of it, and can neither refute it nor bear it out"
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
    names, refuted = " + ".join(map(class_of, found.causes)), listed(map(formed, found.refuted))
    constants = inherited(found.baseline.fit).items()
    wrong = [f"its {n} time constant is {c.words}: {c.why}" for n, c in constants if c.verdict == REJECT]
    code = _code(found, bool(wrong))
    headline = answer = capital(ANSWERS[code].format(names=names or "a cause", refuted=refuted))
    reasons = [f"settle this first, for a wrong reading looks like a cause: {one}" for one in found.doubts]
    actions = [text for one in found.causes for text in _checks(one)]
    ended = bool(found.work.not_judged)
    if ended:
        budget = f"{found.work.budget:,} simulation{'' if found.work.budget == 1 else 's'}"
        left = listed(map(spoken, found.work.not_judged))
        headline = f"The budget of {budget} ended the search; not judged: {left}"
        so_far = "no cause is named" if code == "none" else answer
        reasons.insert(0, f"so far: {so_far[:1].lower()}{so_far[1:]}")
    reasons += [line_sentence(one) for one in found.lines]
    if code in MEANINGS and not (ended and code == "none"):
        reasons.append(f"none of the {tried(found)} causes that were judged {MEANINGS[code]}")
    if code == "wrong":
        reasons += wrong
    if found.refuted:
        beside = "" if found.verdict == "refuted" else f"held-out readings refute {refuted}; "
        why = (f"{spoken(one.cause)}: {refutation(one.held_out)}" for one in found.refuted)
        reasons.append(beside + "; ".join(why))
    alone = len(found.causes) == 1 and not ended
    reasons += [_cause(found, one, alone) for one in found.causes]
    reasons += [f"the extended model still errs: {one.statement}" for one in found.left[:1]]
    if found.saturated > MOST_SATURATED:
        share = percent(found.saturated, 1)
        ceiling = f"{share} of the humidity readings are at the sensor’s ceiling"
        reasons.append(f"{ceiling}, so condensation cannot be excluded")
    if ended:
        actions.append(f"allow more than {budget} with --budget")
    elif code in ACTIONS:
        actions.append(ACTIONS[code])
    repeated = {
        name: [s for s in spans if all(map(math.isfinite, s))] for name, spans in found.repeated.items()
    }
    if any(repeated.values()):
        reasons.append(repeated_text(repeated))
        actions.append("find out why the logger repeats readings")
    sure = sure_of(found.causes[0]) if alone and found.verdict in ("named", "ambiguous") else ""
    return DiscoveryVerdict(
        headline, sure, tuple(filter(None, reasons)), tuple(actions), ended or code in WARNINGS
    )


def _code(found: DiscoveryResults, wrong: bool) -> str:
    """The row of `ANSWERS` that a discovery has; wrong: whether a time constant of its base is rejected."""
    if found.verdict == "unexplained" and not found.causes:
        return "unexplained, no name"
    if found.verdict == "refuted" and all(one.held_out.reason == "unproven" for one in found.refuted):
        return "unproven"
    return "wrong" if found.verdict == "none" and wrong else found.verdict


def tried(found: DiscoveryResults) -> int:
    """How many causes were judged."""
    left = {one.cause for one in found.rejected if one.reason not in ("left_to_budget", "no_form")}
    return len(left | {one.cause for one in found.causes} | {one.cause for one in found.refuted})


def class_of(one: CauseFound) -> str:
    """A cause with those that the record cannot tell from it; a long class names nothing."""
    rest = [spoken(rival) for rival in one.ambiguous_with]
    if not one.told_apart:
        return f"not told apart: {', '.join([spoken(one.cause), *rest])}"
    return listed([formed(one), *rest], "or")


def _cause(found: DiscoveryResults, one: CauseFound, alone: bool) -> str:
    """A cause: its name where the headline does not state it alone, meaning, mark and rivals."""
    name = "" if alone else ", ".join(filter(None, (class_of(one), sure_of(one))))
    meaning = ": ".join(filter(None, (name, "" if one.ambiguous_with else one.statement)))
    return "; ".join(filter(None, (meaning, marked(found, one.held_out), alike_sentence(one))))


def _checks(one: CauseFound) -> Iterable[str]:
    if one.told_apart and one.remedy not in ("", one.separate_by):
        yield f"check in the turbine for {spoken(one.cause)}: {one.remedy}"
    if one.ambiguous_with and one.separate_by:
        yield f"to tell {spoken(one.cause)} from its rivals: {one.separate_by}"


def line_sentence(one: SpectralLine) -> str:
    """A line that is left in a spectrum."""
    name = quantity(one.quantity).words
    long = one.period_h >= 48.0
    period = f"{plain_number(one.period_h / 24.0)} days" if long else f"{plain_number(one.period_h)} h"
    if one.cause:
        where = f"the daily scores of {spoken(one.cause)} in the {name} have a period of {period}"
        return f"{where}: the effect changes with it, which this cause does not describe"
    return f"the errors of the {name} have a period of {period} that no cause explains"


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
    said = []
    if found.estimator:
        which = "parameters of both models" if found.extended is not None else "model’s parameters"
        said.append(f"the {which} {ESTIMATORS.get(found.estimator, found.estimator)}")
    days = found.held_out_days
    if not days:
        said.append("no readings were held out, so nothing could be refuted and errors are those of the fit")
    elif days < SHORT_DAYS:
        said.append(
            f"readings of {days} day{'s' if days > 1 else ''} were held out: too short a part to refute much"
        )
    if selected(found):
        said.append(
            "after selection: held-out readings can refute a cause, so their errors are those of models that "
            "passed; in another season they may be larger"
        )
    return [sentence(one) for one in said]


# --- a cause ---------------------------------------------------------------------------------


def sure_of(one: CauseFound) -> str:
    """The confidence behind a name; empty for a class that names nothing."""
    if not one.told_apart:
        return ""
    share = one.confidence
    known = "> 99 %" if share >= 0.995 else percent(share) if math.isfinite(share) else "not stated"
    return f"confidence {known}"


def marked(found: DiscoveryResults, one: HeldOutTest) -> str:
    """The mark of a cause that does not lower the held-out errors; empty for one that does."""
    if not found.held_out_days:
        return ""
    if not one.days:
        return NOT_SEEN
    return NOT_BETTER if one.improvement < LEAST_IMPROVEMENT else ""


def refutation(one: HeldOutTest) -> str:
    """Why held-out readings refute a cause."""
    grown = [q for q in one.z if one.growth.get(q, math.nan) > WORSE_GROWTH]
    names = listed(dict.fromkeys(quantity(q).words for q in grown)) or "cabinet"
    return REFUTATIONS[one.reason or "worse"].format(names=names, least=percent(LEAST_IMPROVEMENT))


def held_out_sentence(found: DiscoveryResults, one: HeldOutTest) -> str:
    """What held-out readings say of a cause beside the errors of its table."""
    if not one.days:
        return NOT_SEEN if found.held_out_days else "no readings were held out"
    said = [f"a levelled free-run error falls by {percent(one.improvement)}"]
    if math.isfinite(one.gain):
        said.append(f"2 ln L {'grows' if one.gain >= 0 else 'falls'} by {abs(one.gain):.0f}")
    return "; ".join([*said, f"{one.days} days with readings"])


def alike_sentence(cause: CauseFound) -> str:
    """The forms and causes that this record cannot tell apart; empty where there are none."""
    said = []
    if cause.forms_alike:
        forms = listed(map(form_words, cause.forms_alike), "or")
        said.append(f"in this form or {forms}: this record cannot tell these apart")
    if cause.ambiguous_with and cause.told_apart:
        said.append(f"this record cannot tell it from {listed(map(spoken, cause.ambiguous_with))}")
    return "; ".join(said)


CHOSEN: Mapping[str, Callable[[Any], str]] = {
    "date_s": lambda date_s: f"date {stamp_text(date_s)}",
    "spans": lambda spans: ", ".join(f"{stamp_text(a)} to {stamp_text(b)}" for a, b in spans),
    "azimuth_deg": "azimuth {:.0f}°".format,
    "days": "over {:.3g} days".format,
    "start_h": "from {:g} h UTC".format,
    "hours": "for {:g} h".format,
    "shift_s": lambda shift_s: f"stamps moved by {fixed(shift_s / 60.0, 1)} min",
}
"""Setting that a search chose → words."""


def chosen_words(cause: CauseFound) -> Iterator[str]:
    """What the search chose of a cause's form, in words."""
    for name in (one for one in cause.chosen if one in cause.settings):
        value = cause.settings[name]
        against = cause.settings.get("relative_to") if name == "shift_s" else None
        words = f"{name} = {value}"
        if name in CHOSEN:
            with suppress(TypeError, ValueError):  # a user's own feature may mean something else by it
                words = CHOSEN[name](value)
        yield f"{words} against {against}" if against else words
