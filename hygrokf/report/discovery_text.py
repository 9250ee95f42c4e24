"""A discovery in sentences: verdict, gain, evidence, settings and what to check."""

from __future__ import annotations

import math
from collections.abc import Iterable
from datetime import UTC, datetime

from hygrokf.discovery.discovery_results import (
    CauseFound,
    CauseParameter,
    DiscoveryResults,
    Evidence,
    Gain,
    Settings,
)
from hygrokf.discovery.repeats import REPEATED
from hygrokf.evaluation.scoring import SCORED
from hygrokf.identification.verdict import best_rule, inherited
from hygrokf.identification.verdict_terms import REJECT
from hygrokf.identification.wording import (
    QUANTITIES,
    decimals_for,
    fixed,
    minus,
    percent,
    plain_number,
    sentence,
)
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.report.fit_tables import unit
from hygrokf.report.fit_text import p_value, share_text

VERDICTS = {
    "none": "This record shows no missing cause",
    "unexplained": "Something is missing; the cause is unknown",
}
"""The verdict where no cause is named."""
NOT_RIGHT = "No cause was found, but the model is not right"
REPETITION = "The logger repeats readings of the day before"
PERIOD = {"validation": "the held-out period", "identification": "the identification period"}
PARTS = {"thermal": "temperature", "hygric": "humidity"}
NO_GAIN = (
    "no gain is stated: held-out data cannot confirm an event, or a cause that was seen in one episode only; "
    "for a single episode the confidence is capped"
)
MOST_SENTENCES = 5
"""Sentences below the verdict; the sections contain the rest."""
NO_CHECK = "nothing is stated"


# --- words -----------------------------------------------------------------------------------


def spoken(name: str) -> str:
    """An identifier as it is read: "moisture_sorption" -> "moisture sorption"."""
    return name.replace("_", " ").strip() or "unnamed cause"


def title(name: str) -> str:
    """An identifier as it stands at the beginning of a line."""
    return capital(spoken(name))


def capital(text: str) -> str:
    """A text with a capital letter."""
    return text[:1].upper() + text[1:]


def listed(words: Iterable[str]) -> str:
    """ "a", "a and b", "a, b and c"."""
    words = list(words)
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)


def signed_percent(share: float) -> str:
    """A change [1] in per cent with its sign."""
    sign = "+" if share >= 0.0005 else "−" if share <= -0.0005 else "±"
    return sign + percent(abs(share), 1 if abs(share) < 0.095 else 0)


def quantity_of(name: str) -> tuple[str, str]:
    """Name and unit of a scored quantity."""
    return QUANTITIES.get(name, (spoken(name) if name else "error", ""))


# --- the verdict -----------------------------------------------------------------------------


def tried(found: DiscoveryResults) -> int:
    """How many causes were tried."""
    return len({one.cause for one in found.causes} | {one.cause for one in found.rejected})


def repeats_itself(found: DiscoveryResults) -> bool:
    """Whether the remaining structure is a logger's repetition of readings."""
    return found.unexplained is not None and found.unexplained.kind == REPEATED


def headline(found: DiscoveryResults) -> str:
    """The verdict in a few words: the causes' names, or that none is named."""
    if found.verdict == "named":
        return title(" + ".join(spoken(one.cause) for one in found.causes) or "a cause")
    if found.verdict == "none" and _doubts(found):
        return NOT_RIGHT
    if found.verdict == "unexplained" and repeats_itself(found):
        return REPETITION
    return VERDICTS[found.verdict]


def _doubts(found: DiscoveryResults) -> list[str]:
    """The base model's time constants that are rejected, with the reason."""
    return [
        f"its {part} time constant is {one.words}: {one.why}"
        for part, one in inherited(found.baseline.fit).items()
        if one.verdict == REJECT
    ]


def verdict_sentences(found: DiscoveryResults) -> list[str]:
    """The verdict in at most five sentences: cause, gain, rivals, check in the turbine, remaining errors."""
    if found.verdict == "named" and len(found.causes) == 1:
        (one,) = found.causes
        rivals = rivals_sentence(one)
        said = [
            one.statement,
            short_gain(one.gain),
            f"this record cannot distinguish it from {rivals}" if rivals else "",
            f"check in the turbine: {one.remedy or NO_CHECK}",
            *_consequences(found),
        ]
    else:
        named = [
            f"{spoken(one.cause)} (confidence {confidence_of(one)}): {short_gain(one.gain)}"
            for one in found.causes
        ]
        left = _consequences(found)
        said = [*left[:1], *named] if named and found.verdict == "unexplained" else [*named, *left]
        refuted = listed(spoken(one.cause) for one in found.refuted)
        if refuted:
            said.append(f"the held-out period refutes {refuted}, named on the identification period")
    first = [f"settle this first, for a wrong reading looks like a cause: {one}" for one in found.doubts]
    return [sentence(text) for text in (*first, *said) if text][:MOST_SENTENCES]


def _consequences(found: DiscoveryResults) -> list[str]:
    """What the verdict means for a user of the simulation."""
    return [*meaning(found), *advice(found)]


def meaning(found: DiscoveryResults) -> list[str]:
    """What the verdict says of the model and of the errors that are left."""
    left = remainder(found)
    none_of = f"none of {tried(found)} causes of the library"
    if found.verdict == "named":
        return [f"the extended model still errs: {left}"] if left else []
    if found.verdict == "none" and (doubts := _doubts(found)):
        return [
            f"{none_of} improves the simulation significantly and by enough to matter, yet the base model is "
            "wrong",
            *doubts,
        ]
    if found.verdict == "none":
        return [
            f"{none_of} improves the simulation significantly and by enough to matter; its errors look like "
            "the ordinary disturbances of a cabinet"
        ]
    if repeats_itself(found):
        return [left]
    said = left or "the remaining errors have a structure that no cause of the library explains"
    if not found.causes:
        return [said, f"{none_of} explains it, so no cause is named"]
    names = listed(spoken(one.cause) for one in found.causes)
    return [said, f"{names} explains only a part of the errors; take the name with caution"]


def advice(found: DiscoveryResults) -> list[str]:
    """What to do after a verdict that names no cause, or not the whole one."""
    if found.verdict == "named" or (found.verdict == "none" and _doubts(found)):
        return []
    if found.verdict == "none":
        return ["keep the base model; a cause may be missing that this record does not show"]
    if repeats_itself(found):
        check = "find out why the logger repeats readings, and correct that first"
        return [f"{check}; the causes named here were found in the other readings" if found.causes else check]
    return ["do not rely on the simulation under these conditions; look there for influences not logged"]


def remainder(found: DiscoveryResults) -> str:
    """The structure that is left in words; empty where none is."""
    return "" if found.unexplained is None else found.unexplained.statement


def remainder_driver(found: DiscoveryResults) -> str:
    """The logged signal that the remaining error correlates with most; empty without one."""
    left = found.unexplained
    if left is None or not left.driver or not math.isfinite(left.correlation):
        return ""
    late = f", {plain_number(left.lag_h, 2)} h later" if left.lag_h > 0 else ""
    return (
        f"of all logged signals it correlates most with the {spoken(left.driver)} "
        f"(correlation {fixed(left.correlation)}{late})"
    )


def untried(found: DiscoveryResults) -> str:
    """The trials for which the time budget was too short; empty where there are none."""
    names = [spoken(name) for name in found.not_tried.causes]
    parts = [f"{listed(names)} {'was' if len(names) == 1 else 'were'} not tried"] if names else []
    if found.not_tried.beside:
        parts.append("no further cause was tried beside the accepted one")
    seconds = found.not_tried.budget_s
    return f"within {seconds:.0f} s {' and '.join(parts)}: allow more time with --budget" if parts else ""


# --- a cause ---------------------------------------------------------------------------------


def confidence_of(cause: CauseFound) -> str:
    """Confidence in per cent."""
    if not math.isfinite(cause.confidence):
        return "not stated"
    return percent(cause.confidence) if cause.confidence < 0.995 else "> 99 %"


def short_gain(gain: Gain | None) -> str:
    """What a cause gained, in one clause; why none is stated."""
    if gain is None or not gain.known:
        return "no gain is stated, because the cause was seen once or is an event"
    name, symbol = quantity_of(gain.quantity)
    verb = "falls" if gain.rmse_after < gain.rmse_before else "rises"
    return (
        f"the {name} error {verb} from {fixed(gain.rmse_before)} to {fixed(gain.rmse_after)} {symbol} on "
        f"{PERIOD.get(gain.period, gain.period)}"
    )


def gain_sentence(gain: Gain | None) -> str:
    """What a cause gained on the held-out period, with bounds; why none is stated."""
    if gain is None or not gain.known:
        return NO_GAIN
    before, after, low, high = gain.rmse_before, gain.rmse_after, gain.lower, gain.upper
    name, symbol = quantity_of(gain.quantity)
    change = f", by {percent(abs(1.0 - after / before))}" if before > 0 else ""
    verb = "falls" if after < before else "rises"
    said = (
        f"on {PERIOD.get(gain.period, gain.period)} the {name} error of the free run {verb} from "
        f"{fixed(before)} to {fixed(after)} {symbol}{change}"
    )
    if math.isfinite(low) and high < 0.0:
        said += f" (95 % bounds of the rise: {fixed(-high)} … {fixed(-low)} {symbol})"
    elif math.isfinite(low) and math.isfinite(high):
        said += f" (95 % bounds of the fall: {fixed(low)} … {fixed(high)} {symbol})"
        if low <= 0.0:
            said += ": on this period alone the gain is not certain"
    own = [gain.identified_before, gain.identified_after]
    if all(map(math.isfinite, own)) and [fixed(v) for v in own] != [fixed(before), fixed(after)]:
        said += (
            ". Both models are compared here with the parameters that simulate better; as identified, their "
            f"errors are {fixed(own[0])} and {fixed(own[1])} {symbol}, as in the tables and on the fit's page"
        )
    elif math.isfinite(own[0]) != math.isfinite(own[1]):
        which = "with" if math.isfinite(own[0]) else "without"
        said += f". As identified, the model {which} the cause diverges in the free run and has no error"
    if gain.period == "identification":
        said += "; there is no held-out period, so the cause is scored on the data that it was chosen on"
    return said


def evidence_sentence(found: Evidence) -> str:
    """Likelihood and free run of the identification period, by which a cause was chosen."""
    parts = []
    if math.isfinite(found.lr):
        said = f"2 ln L grows by {found.lr:.0f}"
        if math.isfinite(found.df):
            said += f" for {found.df:.0f} {'parameter' if found.df == 1 else 'parameters'}"
        if math.isfinite(found.bic_gain):
            said += (
                f"; evidence {minus(f'{found.bic_gain:.0f}')} after corrections for the base model's misfit "
                "and for the search"
            )
        parts.append(said)
    if math.isfinite(found.score_statistic):
        parts.append(f"score statistic {plain_number(found.score_statistic)}")
    p = found.p_adjusted
    if math.isfinite(p):
        parts.append(f"p {p_value(p) if p < 1e-3 else f'= {p_value(p)}'}, corrected for all that was tried")
    for part, share in found.free_run_gain.items():
        if math.isfinite(share):
            lasting = found.lasting_gain.get(part, math.nan)
            without = f" ({share_text(lasting)} without the best days)" if math.isfinite(lasting) else ""
            name = PARTS.get(part, spoken(part))
            parts.append(f"the squared {name} error {_fell(share)}{without}")
    return "; ".join(parts) or "no evidence is stated"


def _fell(share: float) -> str:
    """By how much an error fell, or grew."""
    if abs(share) < 0.005:
        return "stays"
    return f"falls by {percent(share)}" if share > 0 else f"grows by {percent(-share)}"


def rivals_sentence(cause: CauseFound) -> str:
    """The causes that this record cannot distinguish, and what could; empty where there are none."""
    if not cause.ambiguous_with:
        return ""
    measure = f"; to distinguish them: {cause.separate_by}" if cause.separate_by else ""
    return f"{listed(spoken(one) for one in cause.ambiguous_with)}{measure}"


def parameter_cells(row: CauseParameter) -> tuple[str, str, str]:
    """(value, bounds, unit) of a parameter with the digits that its bounds justify."""
    value, low, high = row.value, row.lower, row.upper
    if math.isfinite(low) and math.isfinite(high) and high > low:
        decimals = decimals_for(0.25 * (high - low))
        shown = [fixed(v, decimals) for v in (value, low, high)]
    else:
        shown = [plain_number(value), *(plain_number(v) if math.isfinite(v) else "open" for v in (low, high))]
    return shown[0], f"{shown[1]} … {shown[2]}", unit(row.unit)


_UNITS = {"_K": "K", "_h": "h", "_deg": "°", "_min": "min", "_mm": "mm"}


def settings_words(settings: Settings) -> list[str]:
    """Settings that were found on a grid: dates, thresholds, clock errors, each in its own words."""
    found = []
    for key, value in settings.items():
        if key in ("start_s", "end_s", "reads"):
            continue
        if isinstance(value, list | tuple):
            spans = [one for one in value if isinstance(one, list | tuple) and len(one) == 2]
            found += [f"from {date_words(a)} to {date_words(b)}" for a, b in spans]
        elif isinstance(value, bool) or not isinstance(value, int | float):
            if not isinstance(value, bool) and value:
                found.append(f"{spoken(key)} {value}")
        elif key == "date_s":
            found.append(f"date {date_words(value)}")
        elif key == "shift_s":
            found.append(f"stamps moved by {fixed(value / 60.0, 1)} min")
        elif key == "days":
            if value:
                found.append(f"over {plain_number(value)} days")
        elif key in ("on", "off", "on_K", "off_K", "above"):
            found.append(f"{spoken(key.removesuffix('_K'))} {_level(value)}")
        else:
            ending = next((end for end in _UNITS if key.endswith(end)), "")
            said = f"{spoken(key.removesuffix(ending))} {plain_number(value)} {_UNITS.get(ending, '')}"
            found.append(said.strip())
    return found


def _level(value: float) -> str:
    """A threshold: temperatures above 150 K in °C, humidities up to 1 in per cent."""
    if value > 150.0:
        return f"{fixed(value - ZERO_CELSIUS_K, 1)} °C"
    return percent(value) if 0.0 < value <= 1.0 else plain_number(value)


def date_words(instant_s: float) -> str:
    """An instant [s] since 1970 as date and time in UTC."""
    try:
        return f"{datetime.fromtimestamp(float(instant_s), UTC):%-d %B %Y %H:%M} UTC"
    except (TypeError, ValueError, OverflowError, OSError):
        return "unknown date"


# --- errors ----------------------------------------------------------------------------------


def scored_error(found: DiscoveryResults, quantity: str) -> tuple[float, float, str]:
    """(RMSE before, after, period) of a scored quantity; after is NaN without an extended model.

    The validation period where there is one, else the identification period.
    """
    for period in ("validation", "identification"):
        before = found.baseline.fit.errors(period, quantity).total
        if math.isfinite(before):
            after = math.nan if found.extended is None else found.extended.fit.errors(period, quantity).total
            return before, after, period
    return math.nan, math.nan, ""


def error_sentences(found: DiscoveryResults) -> list[str]:
    """For each scored quantity the free-run error before and after, and against the best simple rule."""
    said = []
    for quantity in SCORED:
        before, after, period = scored_error(found, quantity)
        if not math.isfinite(before):
            continue
        name, symbol = QUANTITIES[quantity]
        where = f"on {PERIOD[period]}"
        last = after if math.isfinite(after) else before
        if math.isfinite(after) and before > 0:
            text = (
                f"The {name} error {where}: {fixed(before)} → {fixed(after)} {symbol} "
                f"({signed_percent(after / before - 1.0)})"
            )
        else:
            text = f"The {name} error {where}: {fixed(before)} {symbol}"
        rule = best_rule(found.baseline.fit, quantity, period)
        if rule is not None:
            against = last / rule.rule - 1.0
            side = "below" if against <= 0 else "above"
            text += f", {percent(abs(against))} {side} the rule “{rule.words}” ({fixed(rule.rule)} {symbol})"
        said.append(f"{text}.")
    return said
