"""A discovery in sentences: verdict, causes and their forms, held-out test, and what to check."""

from __future__ import annotations

import math
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any

from hygrokf.discovery.judgement import LEAST_IMPROVEMENT, WORSE_GROWTH
from hygrokf.discovery.repeats import repeated_text
from hygrokf.discovery.results import (
    CauseFound,
    CauseParameter,
    DiscoveryResults,
    ErrorGain,
    HeldOutTest,
    Settings,
    SpectralLine,
)
from hygrokf.identification.verdict import inherited
from hygrokf.identification.verdict_terms import REJECT
from hygrokf.identification.wording import (
    QUANTITIES,
    decimals_for,
    fixed,
    percent,
    plain_number,
    sentence,
)
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.report.fit_tables import unit

EXCLUSIONS = {
    "no_effect": "the screening finds no effect",
    "weak": "too little evidence",
    "weak_by_days": "too little evidence in independent days",
    "later_gone": "it lost its place to a cause that was accepted later",
    "left_to_budget": "not judged: the budget ended the search",
    "no_form": "this record cannot show it",
}
ESTIMATORS = {
    "likelihood": "maximise the likelihood of the search",
    "output-error": "minimise the error of the free run (output error)",
}
VERDICTS = {
    "none": "This record shows no missing cause",
    "unexplained": "Something is missing; the cause is unknown",
}
"""The verdict where no cause is named."""
NOT_RIGHT = "No cause was found, but the model is not right"
PERIOD = {"validation": "held-out readings", "identification": "identification readings"}
SCORED_AS = {
    "temperature": "temperature_K",
    "humidity": "absolute_humidity_g_m3",
    "vapour": "absolute_humidity_g_m3",
}
"""Quantity of residuals or of the search → scored quantity."""
NOT_BETTER = "it does not improve the prediction of held-out readings"
NOT_SEEN = "held-out readings show nothing of it, and can neither refute it nor bear it out"
SHORT_DAYS = 14
"""Held-out days below which little can be refuted."""
MOST_SATURATED = 0.01
"""Share of readings at the sensor's ceiling from which condensation cannot be excluded."""
UNCHANGED = 5e-3
"""Relative change of an error that is told as none."""
MOST_SPANS = 5
"""Stretches of time of a cause that are told."""


# --- words -----------------------------------------------------------------------------------


def spoken(name: str) -> str:
    """An identifier as it is read: "moisture_sorption" -> "moisture sorption"."""
    return name.replace("_", " ").strip() or "unnamed cause"


def capital(text: str) -> str:
    """A text with a capital letter."""
    return text[:1].upper() + text[1:]


def listed(words: Iterable[str], last: str = "and") -> str:
    """ "a", "a and b", "a, b and c"."""
    words = list(words)
    return f" {last} ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)


def formed(cause: str, form: str) -> str:
    """A cause with its form: "unlogged heater (humidistat, at standstill)"."""
    return f"{spoken(cause)} ({form})" if form else spoken(cause)


def signed_percent(share: float) -> str:
    """A change [1] in per cent with its sign."""
    sign = "+" if share >= 0.0005 else "−" if share <= -0.0005 else "±"
    return sign + percent(abs(share), 1 if abs(share) < 0.095 else 0)


def quantity_of(name: str) -> tuple[str, str]:
    """Name and unit of a quantity of residuals or of the search."""
    return QUANTITIES.get(SCORED_AS.get(name, ""), (spoken(name) if name else "error", ""))


def unchanged(before: float, after: float) -> bool:
    """Whether two errors are told as equal."""
    return abs(after - before) <= UNCHANGED * before


# --- the verdict -----------------------------------------------------------------------------


def tried(found: DiscoveryResults) -> int:
    """How many causes were judged."""
    judged = {one.cause for one in found.rejected if one.reason not in ("left_to_budget", "no_form")}
    return len(judged | {one.cause for one in found.causes} | {one.cause for one in found.refuted})


def unfinished(found: DiscoveryResults) -> str:
    """That the budget ended the search, and which causes were not judged; empty where it did not."""
    if not found.work.not_judged:
        return ""
    left = listed(map(spoken, found.work.not_judged))
    return f"The budget of {_simulations(found)} ended the search; not judged: {left}"


def _simulations(found: DiscoveryResults) -> str:
    """The budget in words."""
    return f"{found.work.budget:,} simulation{'' if found.work.budget == 1 else 's'}"


def headline(found: DiscoveryResults) -> str:
    """The first sentence of the verdict."""
    return unfinished(found) or answer(found)


def named_alone(found: DiscoveryResults) -> str:
    """The confidence behind the only cause that the headline names; empty where it names none or several."""
    alone = found.verdict in ("named", "ambiguous") and len(found.causes) == 1 and not unfinished(found)
    return sure_of(found.causes[0]) if alone else ""


def warned(found: DiscoveryResults) -> bool:
    """Whether the verdict is a warning: the model is wrong, or the search did not end."""
    return found.verdict == "unexplained" or answer(found) == NOT_RIGHT or bool(unfinished(found))


def answer(found: DiscoveryResults) -> str:
    """The verdict in a few words: the causes' names, or that none is named."""
    names = " + ".join(map(class_of, found.causes))
    if found.verdict in ("named", "ambiguous"):
        return capital(names or "a cause")
    if found.verdict == "unexplained" and names:
        return f"Something is missing beside {names}"
    if found.verdict == "refuted":
        mild = all(one.held_out.reason == "unproven" for one in found.refuted)
        names = listed(formed(one.cause, one.form) for one in found.refuted)
        return f"Held-out readings {'do not bear out' if mild else 'refute'} {names}"
    return NOT_RIGHT if found.verdict == "none" and _doubts(found) else VERDICTS[found.verdict]


def class_of(one: CauseFound) -> str:
    """A cause with those that the record cannot tell from it; a long class names nothing."""
    rest = [spoken(rival) for rival in one.ambiguous_with]
    if not one.told_apart:
        return f"not told apart: {', '.join([spoken(one.cause), *rest])}"
    return listed([formed(one.cause, one.form), *rest], "or")


def _doubts(found: DiscoveryResults) -> list[str]:
    """The base model's time constants that are rejected, with the reason."""
    return [
        f"its {part} time constant is {one.words}: {one.why}"
        for part, one in inherited(found.baseline.fit).items()
        if one.verdict == REJECT
    ]


def reasons(found: DiscoveryResults) -> list[str]:
    """What follows the headline: doubts, what is left, the causes, and what limits the verdict."""
    said = [f"settle this first, for a wrong reading looks like a cause: {one}" for one in found.doubts]
    if unfinished(found):
        known = "no cause is named" if found.verdict == "none" and not _doubts(found) else answer(found)
        said.insert(0, f"so far: {known[:1].lower()}{known[1:]}")
    causes = (_cause(found, one) for one in found.causes)
    return [text for text in (*said, *meaning(found), *causes, *warnings(found)) if text]


def _cause(found: DiscoveryResults, one: CauseFound) -> str:
    """A cause: its name where the headline does not state it alone, meaning, mark and rivals."""
    what = "" if one.ambiguous_with else one.statement
    if len(found.causes) > 1 or unfinished(found):
        name = f"{class_of(one)}{sure_of(one)}"
        what = f"{name}: {what}" if what else name
    return "; ".join(text for text in (what, marked(found, one.held_out), alike_sentence(one)) if text)


def actions(found: DiscoveryResults) -> list[str]:
    """What to check in the turbine, and what to do after a verdict that does not name the whole cause."""
    said = []
    for one in found.causes:
        if one.told_apart and one.remedy not in ("", one.separate_by):
            said.append(f"check in the turbine for {spoken(one.cause)}: {one.remedy}")
        if one.ambiguous_with and one.separate_by:
            said.append(f"to tell {spoken(one.cause)} from its rivals: {one.separate_by}")
    if unfinished(found):
        said.append(f"allow more than {_simulations(found)} with --budget")
    elif found.verdict == "unexplained":
        said.append("look for influences with this period that are not logged: tides, routines, duty cycles")
    elif found.verdict == "refuted" or (found.verdict == "none" and not _doubts(found)):
        said.append("keep the base model; a cause may be missing that this record does not show")
    if found.repeated:
        said.append("find out why the logger repeats readings")
    return said


def meaning(found: DiscoveryResults) -> list[str]:
    """What the verdict says of the model and of the errors that are left."""
    none_of = f"none of the {tried(found)} causes that were judged"
    if found.verdict == "none" and (doubts := _doubts(found)):
        return [f"{none_of} has enough evidence, yet the base model is wrong", *doubts]
    if found.verdict == "none" and unfinished(found):
        return []
    if found.verdict == "none":
        return [f"{none_of} has enough evidence; the errors look like the ordinary disturbances of a cabinet"]
    left = [line_sentence(one) for one in found.lines]
    if found.verdict == "unexplained" and not found.causes:
        left.append(f"{none_of} explains it, so no cause is named")
    if found.refuted:
        names = listed(formed(one.cause, one.form) for one in found.refuted)
        reasons = [f"{spoken(one.cause)}: {refutation(one.held_out)}" for one in found.refuted]
        beside = "" if found.verdict == "refuted" else f"held-out readings refute {names}; "
        left.append(beside + "; ".join(reasons))
    return left


def warnings(found: DiscoveryResults) -> list[str]:
    """The worst error of the extended model, and readings that were saturated or repeated."""
    said = [f"the extended model still errs: {one.statement}" for one in found.left[:1]]
    if found.saturated > MOST_SATURATED:
        said.append(
            f"{percent(found.saturated, 1)} of the humidity readings are at the sensor’s ceiling, so "
            "condensation cannot be excluded"
        )
    known = {name: [s for s in spans if all(map(math.isfinite, s))] for name, spans in found.repeated.items()}
    return [*said, repeated_text(known)] if any(known.values()) else said


def line_sentence(one: SpectralLine) -> str:
    """A line that is left in a spectrum."""
    name, _ = quantity_of(one.quantity)
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
    return f", confidence {known}"


def marked(found: DiscoveryResults, one: HeldOutTest) -> str:
    """The mark of a cause that does not lower the held-out errors; empty for one that does."""
    if not found.held_out_days:
        return ""
    if not one.days:
        return NOT_SEEN
    return NOT_BETTER if one.improvement < LEAST_IMPROVEMENT else ""


def refutation(one: HeldOutTest) -> str:
    """Why held-out readings refute a cause."""
    if one.reason == "no_effect":
        return "in the final set of parameters it has no effect"
    if one.reason == "no_gain":
        return "held-out readings speak against it more strongly than the others speak for it"
    if one.reason == "unproven":
        return (
            f"its evidence is small, and it lowers no held-out free-run error by {percent(LEAST_IMPROVEMENT)}"
        )
    grown = [q for q in one.z if one.growth.get(q, math.nan) > WORSE_GROWTH]
    names = listed(dict.fromkeys(quantity_of(q)[0] for q in grown)) or "cabinet"
    return f"with it the errors of the {names} on held-out readings grow"


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
        said.append(f"in this form or {listed(cause.forms_alike, 'or')}: this record cannot tell these apart")
    if cause.ambiguous_with and cause.told_apart:
        said.append(f"this record cannot tell it from {listed(map(spoken, cause.ambiguous_with))}")
    return "; ".join(said)


def parameter_cells(row: CauseParameter) -> tuple[str, str, str]:
    """(value, bounds, unit) of a parameter with the digits that its bounds justify; levels in °C."""
    value, low, high = row.value, row.lower, row.upper
    symbol = unit(row.unit)
    if row.unit == "K" and value > 150.0:
        value, low, high, symbol = *(v - ZERO_CELSIUS_K for v in (value, low, high)), "°C"
    if math.isfinite(low) and math.isfinite(high) and high > low:
        decimals = decimals_for(0.25 * (high - low))
        shown = [fixed(v, decimals) for v in (value, low, high)]
    else:
        shown = [plain_number(value), *(plain_number(v) if math.isfinite(v) else "open" for v in (low, high))]
    return shown[0], f"{shown[1]} … {shown[2]}", symbol


TOLD_ELSEWHERE = (
    "start_s", "end_s", "reads", "idle", "rising", "workdays", "start", "full", "on", "off", "on_K", "off_K",
    "source", "relative_to",
)  # fmt: skip
"""Settings that the form, the record or the parameters (levels of controllers) tell."""
_UNITS = {"_K": "K", "_h": "h", "_deg": "°", "_min": "min", "_mm": "mm"}


def settings_words(settings: Settings) -> list[str]:
    """Settings that were found on a grid: dates, hours, clock errors, each in its own words."""
    return [
        words
        for key, value in settings.items()
        if key not in TOLD_ELSEWHERE
        for words in _setting_words(key, value, settings)
    ]


def _setting_words(key: str, value: Any, settings: Settings) -> list[str]:
    if isinstance(value, list | tuple):
        spans = [one for one in value if isinstance(one, list | tuple) and len(one) == 2]
        rest = len(spans) - MOST_SPANS
        said = [f"from {date_words(a)} to {date_words(b)}" for a, b in spans[:MOST_SPANS]]
        return [*said, f"and {rest} more"] if rest > 0 else said
    if isinstance(value, bool) or value is None:
        return []
    if not isinstance(value, int | float):
        return [f"{spoken(key)} {value}"]
    if key == "date_s":
        return [f"date {date_words(value)}"]
    if key == "shift_s":
        source = settings.get("source", "the source")
        other = f" against {settings['relative_to']}" if "relative_to" in settings else ""
        when = " in summer time" if settings.get("summer") else ""
        return [f"stamps of {source} moved by {fixed(value / 60.0, 1)} min{when}{other}"]
    if key == "days":
        return [f"over {plain_number(value)} days"] if value else []
    if key == "start_h":
        return [f"from {value:g} h UTC"]
    if key == "hours":
        return [f"for {value:g} h"]
    ending = next((end for end in _UNITS if key.endswith(end)), "")
    return [f"{spoken(key.removesuffix(ending))} {plain_number(value)} {_UNITS.get(ending, '')}".strip()]


def date_words(instant_s: float) -> str:
    """An instant [s] since 1970 as date and time in UTC."""
    try:
        return f"{datetime.fromtimestamp(float(instant_s), UTC):%-d %B %Y %H:%M} UTC"
    except (TypeError, ValueError, OverflowError, OSError):
        return "unknown date"
