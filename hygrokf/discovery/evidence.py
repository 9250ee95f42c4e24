"""What speaks for an accepted cause: evidence, parameters, gain, confidence."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

from hygrokf.discovery.baseline import Baseline
from hygrokf.discovery.candidate import Candidate, added_mechanisms, probability, score_statistic
from hygrokf.discovery.cause import Cause
from hygrokf.discovery.discovery_results import CauseFound, CauseParameter, Evidence, Gain
from hygrokf.discovery.library import named
from hygrokf.discovery.model_selection import Accepted
from hygrokf.estimation.confidence import standard_error, wald_bounds
from hygrokf.identification.estimation import Stage

ONCE_AT_MOST = 0.6
"""[1] largest confidence of a cause that was seen in one episode only, or whose amplitudes all have bounds
that include their null value."""
ONCE = "seen in one episode only: what it would gain at another time cannot be said"
EVENT = (
    "an event that nobody logged is no prediction: it gains nothing outside the stretch in which it was found"
)
VAGUE = (
    "the bounds of its size include no effect at all: the name is doubtful, its evidence may come from what "
    "the base model lacks in form"
)
WEIGHTS = {"level": 0.1, "margin": 2.3, "lasting": 3.5}
"""Logistic weights of `confidence`, from the causes accepted in simulated plants
(docs/validation/discover_measured.md)."""


def evidence(baseline: Baseline, candidate: Candidate, tried: int) -> Evidence:
    """The numbers of a candidate.

    baseline: the base model's; tried: number of variants; p is corrected for it and for the number of
        settings.
    """
    chance = probability(candidate) * max(candidate.variant.searched, 1.0) * max(tried, 1)
    score = score_statistic(baseline, candidate.variant)
    return Evidence(
        lr=candidate.lr,
        df=candidate.parameters,
        p_adjusted=min(1.0, chance),
        bic_gain=candidate.bic_gain,
        score_statistic=math.nan if score is None else score,
        free_run_gain=dict(candidate.gain),
        lasting_gain=dict(candidate.lasting),
        settings=dict(candidate.variant.settings),
    )


def cause_entry(
    baseline: Baseline,
    accepted: Accepted,
    gain: Gain | None,
    known: Collection[str],
    stages: Sequence[Stage],
    library: Sequence[Cause],
    tried: int,
) -> CauseFound:
    """One entry of `causes`.

    gain: of this cause on the held-out period, beside those accepted before it; known: parameters of the base
        model; tried: number of variants.
    """
    candidate = accepted.candidate
    cause = named(candidate.variant.cause, library)
    statement = f"{cause.meaning} ({candidate.variant.form}){_clock(candidate)}"
    parameters = _parameters(candidate, stages, known)
    notes = reservations(cause.event, seen_once(candidate), parameters)
    sure = confidence(candidate, accepted.margin)
    if VAGUE in notes:
        sure = min(sure, ONCE_AT_MOST)
    if {ONCE, EVENT} & set(notes):
        gain = None
    return CauseFound(
        cause=cause.name,
        form=candidate.variant.form,
        confidence=sure,
        margin=accepted.margin,
        statement="; ".join((statement, *notes)),
        parameters=parameters,
        settings=dict(candidate.variant.settings),
        evidence=evidence(baseline, candidate, tried),
        gain=gain,
        ambiguous_with=tuple(t.variant.cause for t in accepted.rivals),
        separate_by=cause.separate_by,
        remedy=_remedy(cause, candidate),
    )


def reservations(event: bool, once: bool, parameters: Mapping[str, CauseParameter]) -> tuple[str, ...]:
    """What is said against a cause in its statement."""
    found = []
    if once or event:
        found.append(ONCE if once else EVENT)
    if vague(parameters):
        found.append(VAGUE)
    return tuple(found)


def vague(parameters: Mapping[str, CauseParameter]) -> bool:
    """Whether a cause's amplitudes all have bounds that include their null value.

    The bounds also hold where the model's form is wrong; a gain in likelihood does not.
    """
    amplitudes = [
        (one.lower, one.null, one.upper)
        for one in parameters.values()
        if all(map(math.isfinite, (one.lower, one.null, one.upper)))
    ]
    return bool(amplitudes) and all(lower <= null <= upper for lower, null, upper in amplitudes)


def _clock(candidate: Candidate) -> str:
    """By how much a clock is off, and against which other clock where there are only two."""
    shift = candidate.variant.shift
    if shift is None:
        return ""
    minutes, late = abs(shift.seconds) / 60.0, "late" if shift.seconds < 0.0 else "early"
    other = candidate.variant.settings.get("relative_to")
    against = f" against {other}, or those of {other} as much the other way" if other else ""
    return f": its stamps are {minutes:.3g} min {late}{against}"


def _remedy(cause: Cause, candidate: Candidate) -> str:
    """What to check, and for a constant error of a clock the line that corrects it until then."""
    shift = candidate.variant.shift
    if shift is None or shift.summer:
        return cause.remedy
    line = f'clock_correction = "{shift.seconds / 60.0:+.4g}min"'
    place = f"in each [[source]] of {shift.source} in the case file"
    return f"{cause.remedy}; until then write {line} {place}, added to a correction that already stands there"


def confidence(candidate: Candidate, margin: float) -> float:
    """Probability [1] that the cause, or one of its class, is the right name: logistic in the margin (see
    `Accepted`) and in the lasting gain of the free run."""
    score = WEIGHTS["level"] + WEIGHTS["margin"] * min(max(margin, -1.0), 1.0)
    score += WEIGHTS["lasting"] * min(max(candidate.best_lasting, 0.0), 0.5)
    found = 1.0 / (1.0 + math.exp(-score))
    return min(found, ONCE_AT_MOST) if seen_once(candidate) else found


def seen_once(candidate: Candidate) -> bool:
    """Whether a single episode or a single window speaks for the cause."""
    return candidate.once or len(candidate.variant.settings.get("spans", (1, 2))) == 1


def _parameters(
    candidate: Candidate, stages: Sequence[Stage], known: Collection[str]
) -> dict[str, CauseParameter]:
    """The cause's own parameters in the extended model, with bounds; `known` those of the base model."""
    names = added_mechanisms(candidate.variant)
    altered = {name for changes in candidate.variant.altered.values() for name in changes}
    found = {}
    for stage in stages:
        for mechanism in stage.base.model.mechanisms:
            if mechanism.name not in {*names, *altered}:
                continue
            for p in mechanism.parameters:
                if mechanism.name in altered and p.name in known:
                    continue
                b = wald_bounds(stage.estimate, stage.uncertainty, p.name)
                se = standard_error(stage.estimate, stage.uncertainty, p.name)
                null = math.nan if p.null is None else p.null
                found[p.name] = CauseParameter(
                    stage.estimate.values[p.name], p.unit, b.lower, b.upper, se, null, p.meaning
                )
    return found
