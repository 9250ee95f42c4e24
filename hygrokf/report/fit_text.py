"""Verdicts of a fit in sentences: on its time constants, errors, bands and one-step predictions.

Any part of the results may be missing. The reasons for and against each number come from
`identification.verdict`.
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


def level_and_method(constant: TimeConstant) -> str:
    """Return level and method of a time constant's interval: "95 %, all sources"."""
    level = percent(constant.level) if math.isfinite(constant.level) else ""
    return ", ".join(filter(None, (level, METHOD_NAMES.get(constant.method, constant.method))))


def free_run_text(constant: TimeConstant) -> str:
    """The estimate by the free run alone with its bounds, "1.52 h (1.29 … 1.75)"; empty without one."""
    free_run = constant.simulation
    if free_run is None or not math.isfinite(free_run.value_h):
        return ""
    return free_run.span if free_run.closed else f"{plain_number(free_run.value_h)} h"


def range_text(constant: TimeConstant) -> str:
    """The time constant at both ends of the record's temperatures; empty if it does not depend on them."""
    ends_h = constant.range_h or ()
    if len(ends_h) != 2 or not all(map(math.isfinite, ends_h)):
        return ""
    decimals = decimals_for(0.2 * abs(ends_h[1] - ends_h[0]))
    return interval(*ends_h, partial(fixed, decimals=decimals), "h")


def lead_words(lead: str) -> str:
    """Return a lead time in words: "24h" → "24 h ahead", "free_run" → "free run"."""
    hours = lead.removesuffix("h")
    return f"{hours} h ahead" if hours.replace(".", "").isdigit() else spoken(lead)


# --- judgements ------------------------------------------------------------------------------


@dataclass(frozen=True)
class SubjectVerdict:
    """The verdict on one subject: its sentence without a full stop, and the reasons, the worst first.

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
    """Return the verdict of the worst reason; reasons in favour are left out if there is one against."""
    sorted_reasons = worst_first(reasons)
    verdict = verdict_of(sorted_reasons)
    stated_reasons = tuple(
        reason for reason in sorted_reasons if verdict == BELIEVE or reason.verdict != BELIEVE
    )
    return SubjectVerdict(about, verdict, subject + VERDICT_ENDS[verdict], stated_reasons)


def judgements(fit: FitResults) -> list[SubjectVerdict]:
    """Return the verdicts on the time constants, then those on errors, bands and innovations."""
    constants = [_time_constant(fit, part) for part in PARTS]
    return [*constants, *_errors(fit), *_bands(fit), *_innovations(fit)]


def _time_constant(fit: FitResults, part: str) -> SubjectVerdict:
    """Return the verdict on a time constant with its reasons; caution where there is none."""
    constant = fit.time_constants.get(part)
    if constant is None:
        sentence = f"There is no {part} time constant: nothing in the record determines one"
        return SubjectVerdict(part, CAUTION, sentence)
    reported = inherited(fit)[part]
    spread_text = f", known to {reported.spread}" if reported.closed else ""
    head = f"The {part} time constant, {reported.texts[0]}{spread_text}{VERDICT_ENDS[reported.verdict]}"
    # doubts about the record stand before everything else
    reasons = [
        reason for reason in reported.reasons if reason.source or reason.values.get("doubt") not in fit.doubts
    ]
    if reported.verdict == BELIEVE and free_run_informs(constant):
        reasons.append(ReasonCode.CRITERIA_AGREE(free=free_run_text(constant)))
    return SubjectVerdict(part, reported.verdict, head, tuple(reasons))


def _errors(fit: FitResults) -> Iterator[SubjectVerdict]:
    """Yield the verdict on the free-run error of each scored quantity."""
    for part, name in QUANTITY_OF.items():
        terms = quantity(name)
        errors = ((period, fit.errors(period, name).total) for period in ("validation", "identification"))
        scored = [f"{terms.with_unit(error)} in {period}" for period, error in errors if math.isfinite(error)]
        if scored:
            subject = f"The free run's {terms.words}, off by {' after '.join(scored)}"
            yield _judged(name, subject, free_run_reasons(fit, part))


def _bands(fit: FitResults) -> Iterator[SubjectVerdict]:
    """Yield the verdict on all 95 % bands, by the share of readings that they hold."""
    coverage_by_band = {
        f"{lead_words(lead)} {quantity(name).words} {percent(band.coverage)}": band.coverage
        for lead in fit.bands
        for name in SCORED
        for band in (fit.band(lead, name),)
        if math.isfinite(band.coverage) and band.n >= FEWEST_IN_BAND
    }
    if coverage_by_band:
        least, most = COVERAGE
        bands_outside = {
            ReasonCode.BANDS_NARROW: [words for words, share in coverage_by_band.items() if share < least],
            ReasonCode.BANDS_WIDE: [words for words, share in coverage_by_band.items() if share > most],
        }
        range_text = (
            f"{100.0 * min(coverage_by_band.values()):.0f} to {percent(max(coverage_by_band.values()))}"
        )
        reasons = (code(bands=tuple(words)) for code, words in bands_outside.items() if words)
        yield _judged("bands", f"The 95 % band, which holds {range_text} of the readings", reasons)


def _innovations(fit: FitResults) -> Iterator[SubjectVerdict]:
    """Yield the verdict on the one-step predictions, by the tests of their innovations."""
    tests = fit.innovations.tests
    rejecting = [test for test in tests if test.rejected]
    if not tests:
        return
    largest = max((largest_correlation(fit, name)[0] for name in fit.innovations.outputs), default=0.0)
    is_small, reasons = 0 < largest < SMALL_CORRELATION, []
    if rejecting:
        kinds = dict.fromkeys(f"{test.test}{' with inputs' * bool(test.input)}" for test in rejecting)
        reasons.append(ReasonCode.NOT_WHITE(BELIEVE if is_small else CAUTION, kinds=tuple(kinds)))
    if largest > 0:
        code = ReasonCode.CORRELATED_LITTLE if is_small else ReasonCode.CORRELATED
        reasons.append(code(correlation=largest))
    white = f"white by {len(tests) - len(rejecting)} of {len(tests)} tests"
    yield _judged("innovations", f"The one-step prediction, whose innovations are {white}", reasons)
