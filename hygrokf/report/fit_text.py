"""What a fit says of its time constants, errors, bands and one-step predictions: each with its verdict.

Any part of the results may be missing.  What speaks for and against each number is decided in
`identification.verdict`, not here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial

from hygrokf.evaluation.innovation_tests import SMALL_CORRELATION
from hygrokf.identification.fit_results import FitResults, TimeConstant
from hygrokf.identification.verdict import (
    COVERAGE,
    FEWEST_IN_BAND,
    free_run_informs,
    free_run_reasons,
    inherited,
    largest_correlation,
)
from hygrokf.identification.verdict_terms import QUANTITY_OF
from hygrokf.report.quantities import interval, quantity, spoken
from hygrokf.texts.parts import PARTS, SCORED
from hygrokf.texts.reasons import BELIEVE, CAUTION, REJECT, Kind, Reason, ReasonCode, verdict_of, worst_first
from hygrokf.texts.wording import decimals_for, fixed, percent, plain_number

METHOD_NAMES = {
    "composed": "all sources",
    "profile": "profile likelihood",
    "wald": "Wald",
    "none": "no bounds",
}


# --- numbers ---------------------------------------------------------------------------------


def level_and_method(found: TimeConstant) -> str:
    """Level of an interval, and how its bounds were made."""
    level = percent(found.level) if math.isfinite(found.level) else ""
    return ", ".join(filter(None, (level, METHOD_NAMES.get(found.method, found.method))))


def free_run_text(found: TimeConstant) -> str:
    """The estimate by the free run alone with its bounds: "1.52 h (1.29 … 1.75)"; empty without one."""
    free = found.simulation
    if free is None or not math.isfinite(free.value_h):
        return ""
    return free.span if free.closed else f"{plain_number(free.value_h)} h"


def range_text(found: TimeConstant) -> str:
    """The time constant at the ends of the record's temperatures; empty where it has no such range."""
    ends_h = found.range_h or ()
    if len(ends_h) != 2 or not all(map(math.isfinite, ends_h)):
        return ""
    decimals = decimals_for(0.2 * abs(ends_h[1] - ends_h[0]))
    return interval(*ends_h, partial(fixed, decimals=decimals), "h")


def lead_words(lead: str) -> str:
    """ "24h" -> "24 h ahead", "free_run" -> "free run"."""
    hours = lead.removesuffix("h")
    return f"{hours} h ahead" if hours.replace(".", "").isdigit() else spoken(lead)


# --- judgements ------------------------------------------------------------------------------


@dataclass(frozen=True)
class SubjectVerdict:
    """A subject's verdict, in one sentence without its stop, and the reasons for it, the worst first.

    `about`: a time constant ("thermal", "hygric"), a scored quantity, "bands" or "innovations".
    """

    about: str
    verdict: Kind
    head: str
    reasons: tuple[Reason, ...] = ()


VERDICT_ENDS = {
    BELIEVE: ", is reliable",
    CAUTION: ", should be used with caution",
    REJECT: ", is not reliable",
}


def _judged(about: str, subject: str, reasons: Iterable[Reason]) -> SubjectVerdict:
    """A judgement by its worst reason; nothing is said for a subject that something speaks against."""
    found = worst_first(reasons)
    verdict = verdict_of(found)
    told = tuple(one for one in found if verdict == BELIEVE or one.verdict != BELIEVE)
    return SubjectVerdict(about, verdict, subject + VERDICT_ENDS[verdict], told)


def judgements(fit: FitResults) -> list[SubjectVerdict]:
    """The verdicts on the time constants with their reasons, then those on errors, bands and innovations."""
    constants = [_time_constant(fit, part) for part in PARTS]
    return [*constants, *_errors(fit), *_bands(fit), *_innovations(fit)]


def _time_constant(fit: FitResults, part: str) -> SubjectVerdict:
    found = fit.time_constants.get(part)
    if found is None:
        none = f"There is no {part} time constant: nothing in the record determines one"
        return SubjectVerdict(part, CAUTION, none)
    known = inherited(fit)[part]
    size = f", known to {known.spread}" if known.closed else ""
    head = f"The {part} time constant, {known.texts[0]}{size}{VERDICT_ENDS[known.verdict]}"
    # doubts about the record stand before everything else
    reasons = [
        reason for reason in known.reasons if reason.source or reason.values.get("doubt") not in fit.doubts
    ]
    if known.verdict == BELIEVE and free_run_informs(found):
        reasons.append(ReasonCode.CRITERIA_AGREE(free=free_run_text(found)))
    return SubjectVerdict(part, known.verdict, head, tuple(reasons))


def _errors(fit: FitResults) -> Iterator[SubjectVerdict]:
    """The free run's error in validation, else in identification."""
    for part, name in QUANTITY_OF.items():
        terms = quantity(name)
        errors = ((period, fit.errors(period, name).total) for period in ("validation", "identification"))
        scored = [f"{terms.with_unit(error)} in {period}" for period, error in errors if math.isfinite(error)]
        if scored:
            subject = f"The free run's {terms.words}, off by {' after '.join(scored)}"
            yield _judged(name, subject, free_run_reasons(fit, part))


def _bands(fit: FitResults) -> Iterator[SubjectVerdict]:
    """All 95 % bands by how many readings they hold."""
    shares = {
        f"{lead_words(lead)} {quantity(name).words} {percent(band.coverage)}": band.coverage
        for lead in fit.bands
        for name in SCORED
        for band in (fit.band(lead, name),)
        if math.isfinite(band.coverage) and band.n >= FEWEST_IN_BAND
    }
    if shares:
        low, high = COVERAGE
        outside = {
            ReasonCode.BANDS_NARROW: [words for words, share in shares.items() if share < low],
            ReasonCode.BANDS_WIDE: [words for words, share in shares.items() if share > high],
        }
        span = f"{100.0 * min(shares.values()):.0f} to {percent(max(shares.values()))}"
        reasons = (code(bands=tuple(words)) for code, words in outside.items() if words)
        yield _judged("bands", f"The 95 % band, which holds {span} of the readings", reasons)


def _innovations(fit: FitResults) -> Iterator[SubjectVerdict]:
    """The one-step predictions, by the tests of their innovations."""
    tests = fit.innovations.tests
    against = [row for row in tests if row.rejected]
    if not tests:
        return
    largest = max((largest_correlation(fit, name)[0] for name in fit.innovations.outputs), default=0.0)
    small, reasons = 0 < largest < SMALL_CORRELATION, []
    if against:
        kinds = dict.fromkeys(f"{row.test}{' with inputs' * bool(row.input)}" for row in against)
        reasons.append(ReasonCode.NOT_WHITE(BELIEVE if small else CAUTION, kinds=tuple(kinds)))
    if largest > 0:
        code = ReasonCode.CORRELATED_LITTLE if small else ReasonCode.CORRELATED
        reasons.append(code(correlation=largest))
    white = f"white by {len(tests) - len(against)} of {len(tests)} tests"
    yield _judged("innovations", f"The one-step prediction, whose innovations are {white}", reasons)
