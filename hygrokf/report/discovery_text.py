"""A discovery in words: verdict, gain, settings and remedy as sentences, and all of it as text for the
terminal.

Everything here reads the plain data of `discovery.json`; what is null is said to be so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import UTC, datetime

from hygrokf.data.lookup import entry, number
from hygrokf.data.structured import StructureFault, structured
from hygrokf.discovery.repeats import REPEATED
from hygrokf.identification.fit_results import FitResults
from hygrokf.identification.verdict import REJECT, handed_on, inherited, told
from hygrokf.identification.verdict_terms import Inherited
from hygrokf.identification.wording import (
    NONE,
    QUANTITIES,
    SCORED,
    decimals_for,
    fixed,
    minus,
    percent,
    plain_number,
    sentence,
    text_of,
    texts,
)
from hygrokf.report.fit_tables import unit
from hygrokf.report.terminal import TEXT_WIDTH, wrapped

VERDICTS = {
    "none": "nothing that is both significant and worth having",
    "named": "a cause is named",
    "unexplained": "structure remains that nothing in the library explains",
}
PERIOD = {"validation": "the held-out period", "identification": "the identification period"}
PARTS = {"thermal": "temperature", "hygric": "humidity"}
NO_GAIN = (
    "no gain is stated: what was seen in one episode only, or was an event, no held-out data can show again; "
    "for one episode the confidence is capped"
)
MOST_SENTENCES = 5
"""Sentences on the verdict's card; the rest stands below."""
NO_CHECK = "nothing is stated"


def rows_of(found: Mapping, name: str) -> list[Mapping]:
    """The mappings in a list of the results; empty where there is none."""
    value = entry(found, name)
    return [one for one in value if isinstance(one, Mapping)] if isinstance(value, (list, tuple)) else []


def spoken(name: object) -> str:
    """An identifier as it is read: "moisture_sorption" -> "moisture sorption"."""
    return text_of(name).replace("_", " ").strip() or "unnamed cause"


def title(name: object) -> str:
    """An identifier as it stands at the beginning of a line."""
    text = spoken(name)
    return text[:1].upper() + text[1:]


def listed(words: list[str]) -> str:
    """ "a", "a and b", "a, b and c"."""
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)


def verdict_of(found: Mapping) -> str:
    """The verdict as it is stated; what is not one of the three counts as unexplained."""
    verdict = text_of(entry(found, "verdict"))
    return verdict if verdict in VERDICTS else "unexplained"


def repeats_itself(found: Mapping) -> bool:
    """Whether what remains are readings that a logger wrote again."""
    return text_of(entry(found, "unexplained", "kind")) == REPEATED


def tried(found: Mapping) -> int:
    """How many causes were tried."""
    return len({text_of(row.get("cause")) for name in ("causes", "rejected") for row in rows_of(found, name)})


def verdict_sentences(found: Mapping) -> list[str]:
    """What the verdict means for whoever uses the simulation, beside what is said of each cause."""
    verdict, causes = verdict_of(found), rows_of(found, "causes")
    if verdict == "named":
        left = remainder(found)
        return [f"that is not all: {left}"] if left else []
    doubts = [
        f"its {part} time constant is {one.words}: {one.why}"
        for part, _, one in handed_on(numbers_of(found, "baseline"))
        if one.verdict == REJECT
    ]
    if verdict == "none" and doubts:
        return [
            f"none of {tried(found)} causes of the library is both significant and worth having, and yet the "
            "base model is not right",
            *doubts,
        ]
    if verdict == "none":
        return [
            f"none of {tried(found)} causes of the library is both significant and worth having, and what "
            "the simulation gets wrong looks like what the disturbances of any cabinet look like",
            "keep the base model; this does not prove that nothing is missing, only that this record does "
            "not show it",
        ]
    if repeats_itself(found):
        check = "find out why the logger writes readings again, and see to that first"
        return [remainder(found), f"{check}; what is named here was found in the others" if causes else check]
    said = [remainder(found) or "structure remains that nothing in the library explains"]
    if not causes:
        said.append(f"none of {tried(found)} causes of the library explains it, so none is named")
    else:
        said.append(
            f"{listed([spoken(one.get('cause')) for one in causes])} explains a part only; take the name "
            "with caution"
        )
    said.append("do not rely on the simulation where this shows; look there for what is not logged")
    return said


def card_sentences(found: Mapping) -> list[str]:
    """The verdict in at most five sentences: what it is, what it gained, what it may also be, what to check,
    what is left."""
    causes = rows_of(found, "causes")
    if len(causes) == 1 and verdict_of(found) == "named":
        (one,) = causes
        rivals = rivals_sentence(one)
        said = [
            text_of(one.get("statement")),
            short_gain(one),
            f"this record does not tell it from {rivals}" if rivals else "",
            f"check in the turbine: {remedy_of(one)}",
            *verdict_sentences(found),
        ]
    else:
        named = [
            f"{spoken(one.get('cause'))} (confidence {confidence_of(one)}): {short_gain(one)}"
            for one in causes
        ]
        left = verdict_sentences(found)
        said = [*left[:1], *named] if causes and verdict_of(found) == "unexplained" else [*named, *left]
        refuted = listed([spoken(one.get("cause")) for one in rows_of(found, "refuted")])
        if refuted:
            said.append(f"the held-out period refutes {refuted}, named on the identification period")
    return [sentence(text) for text in said if text][:MOST_SENTENCES]


def short_gain(cause: Mapping) -> str:
    """What a cause gained, in one clause; why none is stated."""
    gain = entry(cause, "gain")
    before, after = number(gain, "rmse_before"), number(gain, "rmse_after")
    if not (math.isfinite(before) and math.isfinite(after)):
        return "seen once, or an event: no gain can be held against other data"
    name, symbol = quantity_of(entry(gain, "quantity"))
    period = PERIOD.get(text_of(entry(gain, "period")), "the held-out period")
    verb = "falls" if after < before else "rises"
    return f"the {name} error {verb} from {fixed(before)} to {fixed(after)} {symbol} on {period}"


def untried(found: Mapping) -> str:
    """What the time did not last for; empty where all was tried."""
    names = [spoken(name) for name in texts(entry(found, "not_tried", "causes"))]
    parts = [f"{listed(names)} {'was' if len(names) == 1 else 'were'} not tried"] if names else []
    if entry(found, "not_tried", "beside") is True:
        parts.append("nothing was tried beside what was accepted")
    seconds = number(found, "not_tried", "budget_s")
    return f"within {seconds:.0f} s {' and '.join(parts)}: a larger --budget does" if parts else ""


def remainder(found: Mapping) -> str:
    """The structure that is left in words; empty where none is."""
    left = entry(found, "unexplained")
    return text_of(entry(left, "statement") or left) if left is not None else ""


def remainder_driver(found: Mapping) -> str:
    """What the remaining error goes with; empty where it goes with nothing that is logged."""
    left = entry(found, "unexplained")
    driver, r, lag = text_of(entry(left, "driver")), number(left, "correlation"), number(left, "lag_h")
    if not driver or not math.isfinite(r):
        return ""
    late = f", {plain_number(lag, 2)} h later" if lag > 0 else ""
    return f"of all that is logged it goes most with the {spoken(driver)} (correlation {fixed(r)}{late})"


# --- numbers of a cause ----------------------------------------------------------------------


def quantity_of(name: object) -> tuple[str, str]:
    """Name and unit of a scored quantity."""
    text = text_of(name)
    return QUANTITIES.get(text, (spoken(text) if text else "error", ""))


def confidence_of(cause: Mapping) -> str:
    """Confidence in per cent."""
    value = number(cause, "confidence")
    if not math.isfinite(value):
        return "not stated"
    return percent(value) if value < 0.995 else "> 99 %"


def gain_sentence(cause: Mapping) -> str:
    """What a cause gained on the held-out period, with bounds; that it is not stated where it is null."""
    gain = entry(cause, "gain")
    before, after, low, high = (
        number(gain, part) for part in ("rmse_before", "rmse_after", "lower", "upper")
    )
    if not (math.isfinite(before) and math.isfinite(after)):
        return NO_GAIN
    name, symbol = quantity_of(entry(gain, "quantity"))
    period = text_of(entry(gain, "period")) or "validation"
    change = f", by {percent(abs(1.0 - after / before))}" if before > 0 else ""
    verb = "falls" if after < before else "rises"
    said = (
        f"on {PERIOD.get(period, period)} the {name} error of the free run {verb} from {fixed(before)} to "
        f"{fixed(after)} {symbol}{change}"
    )
    if math.isfinite(low) and high < 0.0:
        said += f" (95 % bounds of the rise: {fixed(-high)} … {fixed(-low)} {symbol})"
    elif math.isfinite(low) and math.isfinite(high):
        said += f" (95 % bounds of the fall: {fixed(low)} … {fixed(high)} {symbol})"
        if low <= 0.0:
            said += ": on this period alone the gain is not certain"
    own = [number(gain, f"identified_{when}") for when in ("before", "after")]
    if all(map(math.isfinite, own)) and [fixed(v) for v in own] != [fixed(before), fixed(after)]:
        said += (
            ". This compares the models as the better simulators that they can be; as they were identified, "
            f"they err by {fixed(own[0])} and {fixed(own[1])} {symbol}, and these are the numbers of the "
            "tables and of the fit's page"
        )
    if period == "identification":
        said += "; there is no held-out period, so the data that chose the cause also score it"
    return said


def evidence_sentence(cause: Mapping) -> str:
    """Likelihood and free run of the identification period, by which a cause was chosen."""
    found = entry(cause, "evidence")
    lr, df, price, p = (number(found, part) for part in ("lr", "df", "bic_gain", "p_adjusted"))
    parts = []
    if math.isfinite(lr):
        said = f"2 ln L grows by {lr:.0f}"
        if math.isfinite(df):
            said += f" for {df:.0f} {'parameter' if df == 1 else 'parameters'}"
        if math.isfinite(price):
            said += (
                "; tempered by the base’s misfit and less the price of what was searched, that is "
                f"evidence of {minus(f'{price:.0f}')}"
            )
        parts.append(said)
    score = number(found, "score_statistic")
    if math.isfinite(score):
        parts.append(f"score statistic {plain_number(score)}")
    if math.isfinite(p):
        parts.append(f"p {chance(p) if p < 1e-3 else f'= {chance(p)}'}, corrected for all that was tried")
    shares = entry(found, "free_run_gain")
    for part in shares if isinstance(shares, Mapping) else ():
        share, lasting = number(shares, part), number(found, "lasting_gain", part)
        if math.isfinite(share):
            without = f" ({share_words(lasting)} without the best days)" if math.isfinite(lasting) else ""
            parts.append(
                f"{share_words(share)} of the squared {PARTS.get(part, spoken(part))} error is gone{without}"
            )
    return "; ".join(parts) or "no evidence is stated"


def chance(p: float) -> str:
    """A p-value."""
    return NONE if math.isnan(p) else "< 0.001" if p < 0.001 else f"{p:.3f}"


def share_words(share: float) -> str:
    """A share [1] that may be negative, in whole per cent."""
    return percent(0.0) if abs(share) < 0.005 else minus(percent(share))


def rivals_sentence(cause: Mapping) -> str:
    """The causes that this record cannot tell apart, and what would; empty where there are none."""
    rivals = [spoken(one) for one in texts(entry(cause, "ambiguous_with"))]
    if not rivals:
        return ""
    measure = text_of(entry(cause, "separate_by"))
    return f"{listed(rivals)}{f'; to tell them apart: {measure}' if measure else ''}"


def remedy_of(cause: Mapping) -> str:
    """What to check in the turbine."""
    return text_of(entry(cause, "remedy")) or NO_CHECK


def parameter_cells(row: Mapping) -> tuple[str, str, str]:
    """(value, bounds, unit) of a parameter, with the digits that it is known to; an open side is said."""
    value, low, high = (number(row, part) for part in ("value", "lower", "upper"))
    if math.isfinite(low) and math.isfinite(high) and high > low:
        decimals = decimals_for(0.25 * (high - low))
        shown = [fixed(v, decimals) for v in (value, low, high)]
    else:
        shown = [plain_number(value), *(plain_number(v) if math.isfinite(v) else "open" for v in (low, high))]
    return shown[0], f"{shown[1]} … {shown[2]}", unit(text_of(entry(row, "unit")))


_UNITS = {"_K": "K", "_h": "h", "_deg": "°", "_min": "min", "_mm": "mm"}


def settings_words(settings: object) -> list[str]:
    """What was found on a grid: dates, thresholds, clock errors, each in its own words."""
    found = []
    for name, value in settings.items() if isinstance(settings, Mapping) else ():
        key = text_of(name)
        if key in ("start_s", "end_s", "reads"):
            continue
        if isinstance(value, (list, tuple)):
            spans = [one for one in value if isinstance(one, (list, tuple)) and len(one) == 2]
            found += [f"from {date_words(a)} to {date_words(b)}" for a, b in spans]
            continue
        v = number({"": value}, "")
        if not math.isfinite(v):
            if not isinstance(value, bool) and text_of(value):
                found.append(f"{spoken(key)} {text_of(value)}")
        elif key == "date_s":
            found.append(f"date {date_words(v)}")
        elif key == "shift_s":
            found.append(f"stamps moved by {fixed(v / 60.0, 1)} min")
        elif key == "days":
            if v:
                found.append(f"over {plain_number(v)} days")
        elif key in ("on", "off", "on_K", "off_K", "above"):
            found.append(f"{spoken(key.removesuffix('_K'))} {_level(v)}")
        else:
            ending = next((end for end in _UNITS if key.endswith(end)), "")
            said = f"{spoken(key.removesuffix(ending))} {plain_number(v)} {_UNITS.get(ending, '')}"
            found.append(said.strip())
    return found


def _level(value: float) -> str:
    """A threshold: temperatures above 150 K in °C, humidities up to 1 in per cent."""
    if value > 150.0:
        return f"{fixed(value - 273.15, 1)} °C"
    return percent(value) if 0.0 < value <= 1.0 else plain_number(value)


def date_words(instant_s: object) -> str:
    """An instant [s] since 1970 as date and time in UTC."""
    value = number({"": instant_s}, "")
    try:
        return f"{datetime.fromtimestamp(value, UTC):%-d %B %Y %H:%M} UTC"
    except (ValueError, OverflowError, OSError):
        return "unknown date"


# --- the terminal ----------------------------------------------------------------------------


def discovery_text(found: Mapping) -> str:
    """Verdict, misfits, causes with their gain, and what was tried in vain; lines of at most 100 columns."""
    name = text_of(entry(found, "name")).strip() or "unnamed record"
    synthetic = " (SYNTHETIC: nothing measured)" if entry(found, "synthetic") is True else ""
    lines = [*wrapped(f"{name}{synthetic}: {VERDICTS[verdict_of(found)]}", TEXT_WIDTH), ""]
    lines.append("what the simulation gets wrong")
    lines += _items([text_of(one.get("statement")) for one in rows_of(found, "misfits")]) or [
        "  nothing significant and material"
    ]
    for cause in rows_of(found, "causes"):
        form = text_of(cause.get("form"))
        heading = f"cause: {text_of(cause.get('cause'))}{f' ({form})' if form else ''}"
        lines += ["", *wrapped(f"{heading}, confidence {confidence_of(cause)}", TEXT_WIDTH)]
        lines += _items([text_of(cause.get("statement"))])
        parameters = entry(cause, "parameters")
        for key, row in parameters.items() if isinstance(parameters, Mapping) else ():
            value, bounds, symbol = parameter_cells(row)
            lines += [
                f"    {line}"
                for line in wrapped(f"{text_of(key)} = {value} ({bounds}) {symbol}".rstrip(), 96)
            ]
        lines += _items([*settings_words(entry(cause, "settings")), gain_sentence(cause)])
        lines += _items([f"evidence: {evidence_sentence(cause)}"])
        if rivals := rivals_sentence(cause):
            lines += _items([f"could also be {rivals}"])
        lines += _items([f"check: {remedy_of(cause)}"])
    for one in rows_of(found, "refuted"):
        lines += [
            "",
            f"refuted by the held-out period: {text_of(one.get('cause'))}",
            *_items([gain_sentence(one)]),
        ]
    lines += _time_constants(found)
    if left := remainder(found):
        lines += ["", "unexplained", *_items([left, *filter(None, [remainder_driver(found)])])]
    out = len(rows_of(found, "rejected"))
    lines += [
        "",
        f"tried and left out: {out} {'cause' if out == 1 else 'causes'} (discovery.json has the evidence)",
        *(wrapped(sentence(untried(found)), TEXT_WIDTH) if untried(found) else []),
    ]
    return "\n".join(lines)


def _time_constants(found: Mapping) -> list[str]:
    """The time constants of both models with their verdicts, and what the extension changed."""
    said = []
    for which, label in (("baseline", "base model"), ("extended", "extended model")):
        said += [line for text in told(numbers_of(found, which)) for line in _items([f"{label}: {text}"])]
    changed = []
    for name in PARTS:
        a, b = (number(found, which, "time_constants", name, "value_h") for which in ("baseline", "extended"))
        if a > 0 and math.isfinite(b):
            changed.append(f"{name} {signed_percent(b / a - 1.0)}")
    said += [f"  - change by the extension: {', '.join(changed)}"] if changed else []
    return ["", "time constants", *said] if said else []


def numbers_of(found: Mapping, which: str) -> dict[str, Inherited]:
    """The numbers of the base ("baseline") or the extended model with their verdicts."""
    return inherited(fit_like(found, which))


def fit_like(found: Mapping, which: str) -> FitResults:
    """What is kept of the base ("baseline") or the extended model, as the results of a fit."""
    value = entry(found, which)
    try:
        return structured(FitResults, value if isinstance(value, Mapping) else {})
    except StructureFault:
        return FitResults()


def signed_percent(share: float) -> str:
    """A change [1] in per cent with its sign."""
    sign = "+" if share >= 0.0005 else "−" if share <= -0.0005 else "±"
    return sign + percent(abs(share), 1 if abs(share) < 0.095 else 0)


def scored_error(found: Mapping, quantity: str) -> tuple[float, float, str]:
    """(RMSE before, after, period) of a scored quantity; after is NaN without an extended model.

    The validation period where there is one.  `before` is that of the base model as it stands in the results.
    """
    for period in ("validation", "identification"):
        before = number(found, "baseline", "rmse", period, quantity, "total")
        if math.isfinite(before):
            return before, number(found, "extended", "rmse", period, quantity, "total"), period
    return math.nan, math.nan, ""


def gains_by_quantity(found: Mapping) -> dict[str, Mapping]:
    """Scored quantity -> the first accepted cause's gain in it."""
    result: dict[str, Mapping] = {}
    for cause in rows_of(found, "causes"):
        gain = cause.get("gain")
        name = text_of(entry(gain, "quantity"))
        if isinstance(gain, Mapping) and name in SCORED and math.isfinite(number(gain, "rmse_before")):
            result.setdefault(name, gain)
    return result


def _items(sentences: list[str]) -> list[str]:
    """Sentences as items of a list, further lines indented."""
    lines = []
    for text in sentences:
        first, *rest = wrapped(text, TEXT_WIDTH - 4) if text else [""]
        lines += [f"  - {first}", *(f"    {line}" for line in rest)] if first else []
    return lines
