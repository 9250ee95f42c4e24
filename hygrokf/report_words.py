"""Numbers and judgements in words: what the report says about a fit before it shows a figure.

Everything here reads the plain data of `fit.json` and expects nothing to be there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from hygrokf.lookup import entry, number, one_line

NONE = "–"
QUANTITIES = {
    "temperature_K": ("temperature", "K"),
    "absolute_humidity_g_m3": ("absolute humidity", "g/m³"),
    "relative_humidity": ("relative humidity", "1"),
}
SCORED = ("temperature_K", "absolute_humidity_g_m3")
BASELINES = {
    "temperature_K": {"no_dynamics": "heat release without heat storage"},
    "absolute_humidity_g_m3": {
        "ambient": "c = c_amb",
        "ambient_pressure_balance": "c = c_amb T_amb/T_conv,a",
    },
}
METHODS = {"profile": "profile likelihood", "wald": "Wald", "sandwich": "sandwich", "none": "no bounds"}
TIGHT = 0.25
"""[1] half-width of the bounds, relative to the value, up to which a time constant counts as pinned down."""
CARRIES_OVER = 1.25
"""[1] error in validation over error in identification up to which a model carries over."""
MATERIAL = 0.1
"""[1] share by which an error must fall below a baseline's to be called better."""
COVERAGE = (0.90, 0.985)
"""[1] shares within a 95 % band between which it is called right."""
FAILED = 0.5
"""[1] share within the free run's 95 % band below which the free run is not to be relied on."""
SAYING = 3.0
"""[1] upper over lower bound of the free run's time constant below which it says something."""


def plain_number(value: float, digits: int = 3) -> str:
    """A number with so many significant digits, without an exponent where that reads better."""
    if not math.isfinite(value):
        return NONE
    if value == 0:
        return "0"
    if 1e-5 <= abs(value) < 1e6:
        decimals = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
        return minus(f"{value:.{min(decimals, 8)}f}")
    return minus(f"{value:.{digits - 1}e}")


def fixed(value: float, decimals: int = 2) -> str:
    """A number with so many decimals."""
    return minus(f"{value:.{decimals}f}") if math.isfinite(value) else NONE


def minus(text: str) -> str:
    return text.replace("-", "−", 1) if text.startswith("-") else text


def percent(share: float, decimals: int = 0) -> str:
    """A share [1] in per cent."""
    return f"{100.0 * share:.{decimals}f} %" if math.isfinite(share) else NONE


def decimals_for(spread: float) -> int:
    """Decimals that show a spread with one digit, with two where the first is 1 or 2."""
    return (
        2
        if not (math.isfinite(spread) and spread > 0)
        else min(max(math.ceil(0.4 - math.log10(spread)), 0), 8)
    )


def text_of(value: object) -> str:
    """A string on one line, without control characters; anything else that is not null as text."""
    return "" if value is None else one_line(value if isinstance(value, str) else str(value))


def texts(value: object) -> list[str]:
    """A list of strings, null and empty ones left out."""
    items = value if isinstance(value, (list, tuple)) else []
    return [text for one in items if (text := text_of(one).strip())]


# --- time constants --------------------------------------------------------------------------


@dataclass(frozen=True)
class TimeConstant:
    """A time constant in words: `value` ("1.49 h", "≤ 0.4 h", "not identifiable"), `bounds`, `closed` on both sides."""

    name: str
    value: str
    bounds: str
    closed: bool
    found: Mapping | None

    @property
    def sentence(self) -> str:
        return f"{self.name} {self.value}" + (f" ({self.bounds})" if self.bounds else "")


def time_constant(fit: Mapping, name: str) -> TimeConstant:
    """The headline of one time constant, "thermal" or "hygric"."""
    found = entry(fit, "time_constants", name)
    if not isinstance(found, Mapping):
        return TimeConstant(name, "not identified", "", False, None)
    value, low, high = (number(found, part) for part in ("value_h", "lower_h", "upper_h"))
    low = low if low > 0 else math.nan
    level = number(found, "level")
    how = ", ".join(part for part in (percent(level) if math.isfinite(level) else "", method(found)) if part)
    closed = math.isfinite(value) and math.isfinite(low) and math.isfinite(high)
    if closed:
        decimals = decimals_for(0.5 * (high - low))
        bounds = f"{low:.{decimals}f} … {high:.{decimals}f}"
        return TimeConstant(
            name, f"{value:.{decimals}f} h", f"{bounds}, {how}" if how else bounds, True, found
        )
    best = f"best {plain_number(value)} h" if math.isfinite(value) else ""
    tail = ", ".join(part for part in (best, how) if part)
    if math.isfinite(high):
        return TimeConstant(name, f"≤ {plain_number(high)} h", tail, False, found)
    if math.isfinite(low):
        return TimeConstant(name, f"≥ {plain_number(low)} h", tail, False, found)
    return TimeConstant(name, "not identifiable", tail, False, found)


def method(found: Mapping) -> str:
    """How bounds were made, in words."""
    text = text_of(entry(found, "method"))
    first, _, rest = text.partition(" ")
    return f"{METHODS.get(first, first)} {rest}".strip()


def simulated(found: Mapping | None) -> str:
    """The estimate by the simulation criterion with its bounds [h]; empty where there is none."""
    value, low, high = (number(found, "simulation", part) for part in ("value_h", "lower_h", "upper_h"))
    if not math.isfinite(value):
        return ""
    if not (math.isfinite(low) and math.isfinite(high) and high > low):
        return f"{plain_number(value)} h"
    decimals = decimals_for(0.5 * (high - low))
    return f"{value:.{decimals}f} h ({low:.{decimals}f} … {high:.{decimals}f})"


# --- judgements ------------------------------------------------------------------------------

GOOD, CARE, BAD = "good", "care", "bad"


@dataclass(frozen=True)
class Judgement:
    """One sentence and what to make of it: "good" (to be believed), "care" (with caution), "bad" (not)."""

    kind: str
    sentence: str


def judgements(fit: Mapping) -> list[Judgement]:
    """What to believe and what not, from the numbers of the fit."""
    found = [*_convergence(fit)]
    for name in ("thermal", "hygric"):
        found += _time_constant(fit, name)
    for quantity in SCORED:
        found += _errors(fit, quantity)
    return [*found, *_bands(fit), *_innovations(fit)]


def doubted(fit: Mapping) -> list[Judgement]:
    """What a sceptic would ask about the record itself; to be shown before everything else."""
    return [
        Judgement(CARE, f"Doubt about the record: {line}{'' if line[-1] in '.?!' else '.'}")
        for line in texts(entry(fit, "doubts"))
    ]


def _scored_period(fit: Mapping, quantity: str) -> str:
    late = number(fit, "rmse", "validation", quantity, "total")
    return "validation" if math.isfinite(late) else "identification"


def _beyond(fit: Mapping, quantity: str) -> tuple[str, float, float] | None:
    """Period, error and standard deviation of the readings where the free run errs by more than they vary."""
    for period in ("validation", "identification"):
        error = number(fit, "rmse", period, quantity, "total")
        spread = number(fit, "readings_sd", period, quantity)
        if error > spread:
            return period, error, spread
    return None


def _band_failed(fit: Mapping, quantity: str) -> bool:
    share, n = (number(fit, "bands", "free_run", quantity, part) for part in ("coverage", "n"))
    return share < FAILED and n >= 20


def _convergence(fit: Mapping) -> list[Judgement]:
    if entry(fit, "converged") is True:
        return []
    said = text_of(entry(fit, "message"))
    words = (
        "The estimation did not converge"
        if entry(fit, "converged") is False
        else "Whether the estimation converged is not known"
    )
    return [Judgement(BAD, f"{words}{f': {said}' if said else ''}. No number below is final.")]


def _time_constant(fit: Mapping, name: str) -> list[Judgement]:
    constant = time_constant(fit, name)
    if constant.found is None:
        return [Judgement(CARE, f"There is no {name} time constant: nothing in the record determines one.")]
    value, low, high = (number(constant.found, part) for part in ("value_h", "lower_h", "upper_h"))
    if not constant.closed:
        return [
            Judgement(
                CARE, f"The record bounds the {name} time constant on one side at most: {constant.value}."
            )
        ]
    half = 0.5 * (high - low) / value if value > 0 else math.inf
    known = f"known to ±{percent(half, 1 if half < 0.095 else 0)}"
    apart = text_of(entry(constant.found, "disagreement"))
    if apart:
        return [
            Judgement(
                BAD,
                f"The {name} time constant depends on the criterion, though the likelihood alone calls it {known}: {apart}.",
            )
        ]
    tight = half <= TIGHT
    tail = "." if tight else ": roughly."
    # the exchange of vapour is read at the cabinet's temperature: both must hold for the hygric one
    failed = [
        QUANTITIES[quantity][0]
        for quantity in (SCORED[:1] if name == "thermal" else SCORED)
        if _band_failed(fit, quantity) or _beyond(fit, quantity) is not None
    ]
    if failed:
        tail = f" only if the model holds, and its free run fails for the {' and the '.join(failed)}."
    made = [Judgement(GOOD if tight and not failed else CARE, f"The {name} time constant is {known}{tail}")]
    other = simulated(constant.found)
    if other:
        low, high = (number(constant.found, "simulation", part) for part in ("lower_h", "upper_h"))
        says = low > 0 and math.isfinite(high) and high < SAYING * low
        words = "the criteria agree" if says else "so wide that it hardly says anything"
        if not (math.isfinite(low) and math.isfinite(high)):
            words = "without bounds, so it hardly says anything"
        made.append(
            Judgement(
                GOOD if says else CARE,
                f"The free run alone gives {other} for the {name} time constant: {words}.",
            )
        )
    return made


def _errors(fit: Mapping, quantity: str) -> list[Judgement]:
    name, unit = QUANTITIES[quantity]
    early, late = (
        number(fit, "rmse", period, quantity, "total") for period in ("identification", "validation")
    )
    if not (math.isfinite(early) or math.isfinite(late)):
        return []
    made = []
    period = _scored_period(fit, quantity)
    error = late if period == "validation" else early
    beyond = _beyond(fit, quantity)
    if beyond is not None:
        where, above, spread = beyond
        made.append(
            Judgement(
                CARE,
                f"The free run's {name} error is {fixed(above)} {unit} in {where}, more than the standard deviation of the "
                f"readings ({fixed(spread)} {unit}): their mean alone would do better, so nothing is said to carry over.",
            )
        )
    elif not math.isfinite(late):
        made.append(
            Judgement(
                CARE,
                f"The {name} could not be validated: its error of {fixed(early)} {unit} is that on data which the fit has seen.",
            )
        )
    elif math.isfinite(early) and early > 0:
        good = late <= CARRIES_OVER * early
        verdict = "the model carries over" if good else "the model does not carry over well"
        made.append(
            Judgement(
                GOOD if good else CARE,
                f"The free run's {name} error is {fixed(late)} {unit} in validation after {fixed(early)} {unit} in "
                f"identification: {verdict}.",
            )
        )
    rivals = {
        words: number(fit, "baselines", period, key, quantity, "total")
        for key, words in BASELINES[quantity].items()
    }
    rivals = {words: value for words, value in rivals.items() if math.isfinite(value) and value > 0}
    if rivals:
        words = min(rivals, key=lambda one: rivals[one])
        gain = 1.0 - error / rivals[words]
        against = f"“{words}” ({fixed(rivals[words])} {unit} in {period})"
        if gain >= MATERIAL:
            made.append(
                Judgement(GOOD, f"The {name} error is {percent(gain)} below that of the rule {against}.")
            )
        else:
            verb = "hardly better than" if gain > -0.02 else "worse than"
            made.append(
                Judgement(
                    CARE,
                    f"For predicting the {name}, the model is {verb} the rule {against}: believe the time constant "
                    "for what it says about the cabinet, not for a gain in accuracy.",
                )
            )
    share = number(fit, "sensor_share", period, quantity)
    if share >= 0.5:
        made.append(
            Judgement(GOOD, f"The sensors' accuracy alone explains {percent(share)} of the {name} error.")
        )
    return made


def _bands(fit: Mapping) -> list[Judgement]:
    found = entry(fit, "bands")
    narrow, wide, right = [], [], []
    for lead, by_quantity in found.items() if isinstance(found, Mapping) else ():
        for quantity in SCORED:
            share, n = number(by_quantity, quantity, "coverage"), number(by_quantity, quantity, "n")
            if math.isfinite(share) and n >= 20:
                words = f"{lead_words(lead)} {QUANTITIES[quantity][0]} {percent(share)}"
                (narrow if share < COVERAGE[0] else wide if share > COVERAGE[1] else right).append(words)
    made = [
        Judgement(
            BAD,
            f"The free run's 95 % band of the {QUANTITIES[quantity][0]} holds only "
            f"{percent(number(found, 'free_run', quantity, 'coverage'))} of the readings in "
            f"{_scored_period(fit, quantity)}: do not rely on the free run.",
        )
        for quantity in SCORED
        if _band_failed(fit, quantity)
    ]
    if right:
        made.append(Judgement(GOOD, f"95 % bands that hold about what they promise: {', '.join(right)}."))
    if narrow:
        made.append(Judgement(CARE, f"95 % bands that are too narrow: {', '.join(narrow)}."))
    if wide:
        made.append(Judgement(CARE, f"95 % bands that are wider than needed: {', '.join(wide)}."))
    return made


def lead_words(lead: object) -> str:
    """ "24h" -> "24 h ahead", "free_run" -> "free run"."""
    text = text_of(lead)
    return (
        f"{text[:-1]} h ahead"
        if text.endswith("h") and text[:-1].replace(".", "").isdigit()
        else text.replace("_", " ")
    )


def _innovations(fit: Mapping) -> list[Judgement]:
    tests = entry(fit, "innovations", "tests")
    rows = [row for row in tests if isinstance(row, Mapping)] if isinstance(tests, (list, tuple)) else []
    if not rows:
        return []
    against = [row for row in rows if row.get("rejected") is True]
    kinds = list(dict.fromkeys(text for row in against if (text := _test_in_words(row))))
    named = f" ({', '.join(kinds)})" if kinds else ""
    count = f"{len(against)} of {len(rows)} tests {'speaks' if len(against) == 1 else 'speak'}"
    if kinds and set(kinds) <= set(NO_CORRELATION):
        return [
            Judgement(
                CARE, f"{count} against white innovations{named}, none of them by a correlation (below)."
            )
        ]
    if not against:
        return [Judgement(GOOD, f"None of {len(rows)} tests speaks against white innovations.")]
    largest = 0.0
    outputs = entry(fit, "innovations", "outputs")
    for one in outputs.values() if isinstance(outputs, Mapping) else ():
        crossed = entry(one, "cross_correlation")
        parts = [entry(one, "autocorrelation"), *(crossed.values() if isinstance(crossed, Mapping) else ())]
        for part in parts:
            values = entry(part, "value")
            sizes = (
                [abs(v) for v in values if isinstance(v, (int, float))] if isinstance(values, list) else []
            )
            largest = max([largest, *sizes])
    small = largest < 0.1
    words = (
        f"{count} against white innovations{named}, by correlations of at most "
        f"{largest:.2f}: {'measurable, but small' if small else 'the one-step prediction still owes something'} (below)."
    )
    return [Judgement(GOOD if small else CARE, words)]


NO_CORRELATION = ("mean", "variance", "normality")
"""Kinds of tests that ask for the size and the shape of innovations, not for what they follow."""


def _test_in_words(row: Mapping) -> str:
    """The kind of a test: "mean", "autocorrelation", "correlation with inputs"."""
    test = text_of(row.get("test")).split(" up to ")[0]
    return "correlation with inputs" if test.startswith("correlation with ") else test
