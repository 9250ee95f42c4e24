"""Which causes to accept: forward selection by likelihood and free run, one cause at a time."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.discovery.baseline import HYGRIC, THERMAL, Baseline, redriven
from hygrokf.discovery.budget import Budget, BudgetSpent
from hygrokf.discovery.candidate import MATERIAL, Candidate, attempt, polished, refined, started
from hygrokf.discovery.cause import Cause
from hygrokf.discovery.library import LIBRARY, named
from hygrokf.engine.parallel import mapped
from hygrokf.identification.estimation import Progress
from hygrokf.physics.switches import SWITCHES

EVIDENCE = 10.0
"""Gain in 2 ln L beyond the price of parameters and grid (BIC) that counts as strong."""
WORSE = -0.02
"""A cause that makes the free run of a part worse by more than this share is no cause."""
SATURATION = 0.97
"""[1] relative humidity from which a ceiling is no fault of a sensor: saturated air, read with a sensor's
accuracy."""
CLOSE = 10.0
"""Difference in evidence below which two acceptable causes are not told apart."""
HALF = 0.5
"""Two causes are alike where their free runs differ by less than this share of what the better one changes in
them, and the other has at least this share of its evidence."""
SAME = 0.25
"""Acceptable causes whose free runs differ by less than this share are alike whatever their evidence."""
MOST_CAUSES = 3
SHARE = 0.06
"""Share of an accepted cause's evidence that a further cause of the same part must have: the true form is
never known, and what it differs in is left behind."""
OVERWHELMING = 200.0
"""Evidence that is enough for any cause, however little the free run gains; in 36 cabinets that hide nothing
the most was 88."""
EXPLAINED = "what it explains is explained by the accepted causes"
NO_BETTER = "beside the accepted causes it does not simulate better"
RETRY = 8.0
"""2 Δ ln L below which a cause is not tried again beside an accepted one."""


@dataclass(frozen=True)
class Selection:
    """Accepted candidates in order with the candidates that rivalled each, all others with the reason, and
    the last baseline.

    `margins`: share of its evidence by which the best cause outside its class stayed behind each accepted
    one; `tried`: number of variants that were tried; `untried` causes for which the time did not last; `cut`:
    whether it did not last for looking beside what was accepted.
    """

    accepted: tuple[Candidate, ...]
    rivals: tuple[tuple[Candidate, ...], ...]
    margins: tuple[float, ...]
    tried: int
    rejected: tuple[tuple[Candidate, str], ...]
    baseline: Baseline
    untried: tuple[str, ...] = ()
    cut: bool = False


def verdict_on(candidate: Candidate, cause: Cause, tried: int = 1) -> str:
    """Why a candidate, one of so many that were `tried`, is not acceptable; empty where it is."""
    if candidate.lr <= 0.0 or not candidate.parts:
        return "it gains no likelihood"
    certain = candidate.bic_gain >= EVIDENCE
    if not certain and not all(part.converged for part in candidate.parts.values()):
        return "the estimate did not converge, and what it reached is no evidence"
    if not certain and not simulates(candidate, tried):
        return "its gain in likelihood does not pay for its parameters and the settings searched"
    if candidate.beyond:
        return f"{candidate.beyond.replace('_', ' ')} would have to be larger than is physically possible"
    if candidate.variant.joint and min(candidate.lrs.values()) < math.log(
        min(p.n for p in candidate.parts.values())
    ):
        return "it acts on heat and vapour, and one of them does not show"
    if min(candidate.gain.values(), default=0.0) < WORSE:
        return "it makes the free run worse"
    stated = candidate.variant.settings
    if cause.name == "clock_shift" and abs(float(stated["shift_s"])) < float(stated["ordinary_s"]):
        return "a clock error of this size is ordinary"
    if candidate.value("humidity_ceiling", 0.0) > SATURATION:
        return "a ceiling as near to saturation as that is one of the air, not of the sensor"
    if not worth_having(candidate) and candidate.bic_gain < min(cause.alone, OVERWHELMING):
        return "significant, but the free run gains too little, or on a few days alone"
    return ""


def simulates(candidate: Candidate, tried: int) -> bool:
    """Whether the free run of a part gains a material share beyond what chance makes of so many candidates
    and their settings.

    Where the model is far from right the likelihood knows little, and this speaks for a cause by itself.
    """
    if candidate.lr - candidate.price < EVIDENCE:
        return False
    largest = math.sqrt(2.0 * math.log(max(tried * candidate.variant.searched, 1.0)))
    return any(candidate.gain[name] >= MATERIAL and z >= largest for name, z in candidate.z.items())


def worth_having(candidate: Candidate) -> bool:
    """Whether the free run gains a material share without its best days."""
    return candidate.best_lasting >= MATERIAL


def _settled(baseline: Baseline, candidate: Candidate) -> Candidate:
    """A candidate that simulates better but was cut short, climbed on; others as they are."""
    done = all(part.converged for part in candidate.parts.values())
    if done or candidate.bic_gain >= EVIDENCE or candidate.best_lasting < MATERIAL:
        return candidate
    return polished(baseline, candidate)


def switches(candidate: Candidate) -> bool:
    """Whether what was tried is a switch."""
    return bool(SWITCHES.keys() & set(candidate.variant.features))


def worth(candidate: Candidate) -> float:
    """What acceptable candidates are ranked by: evidence in the likelihood."""
    return candidate.bic_gain


def select(
    baseline: Baseline, library: Sequence[Cause] = LIBRARY, say: Progress = lambda text: None
) -> Selection:
    """Add causes while one is both significant and worth having; take back those that a later one replaces.

    Once the baseline's budget is spent no further candidate is begun, and those that run end; what was found
    by then is decided on as it stands.
    """
    base, budget, cut = baseline, baseline.budget, False
    accepted: list[Candidate] = []
    rivals: list[tuple[Candidate, ...]] = []
    margins: list[float] = []
    behind: dict[str, str] = {}
    stale: set[str] = set()

    candidates, untried = _first_candidates(baseline, library, say)
    tried = len(candidates)
    first = {t.variant.cause: t for t in sorted(candidates, key=worth)}  # the best of each cause comes last
    while True:
        kept = [t for t in candidates if t.variant.cause not in behind]
        good = [t for t in kept if not _reason(t, tried, accepted, library)]
        good.sort(key=worth, reverse=True)
        if not good:
            break
        best = good[0]
        if best.variant.cause in stale:  # beside a coarser form than is accepted now
            stale.remove(best.variant.cause)
            candidates = [t for t in candidates if t.variant.cause != best.variant.cause]
            with suppress(BudgetSpent):
                candidates.append(attempt(baseline, started(baseline, best)))
            continue
        with suppress(BudgetSpent):
            best = polished(baseline, best)
        class_ = _class(baseline, best, good, candidates)
        ahead = _ahead(best, class_, candidates)
        slipped = _reason(best, tried, accepted, library)  # at its maximum it may gain less than on the way
        if slipped:
            behind[best.variant.cause] = slipped
            continue
        before = baseline
        rough = _rough(accepted, best)
        if rough is not None and not budget.spent:  # what a coarse form leaves behind is no other cause
            with suppress(BudgetSpent):
                accepted[rough], baseline = _finest(base, baseline, accepted, rough)
            if baseline is not before:
                behind, stale = {}, {t.variant.cause for t in candidates if set(t.parts) & set(best.parts)}
            continue
        behind = {}
        rivals.append(class_)
        margins.append(ahead)
        accepted.append(best)
        baseline = with_candidate(baseline, best)
        changed = {name for name, part in baseline.parts.items() if part is not before.parts[name]}
        if len(accepted) > 1:
            with suppress(BudgetSpent):
                keep, baseline = _needed(base, accepted, baseline, say)
                if len(keep) < len(accepted):
                    changed = set(baseline.parts)
                accepted, rivals = [accepted[i] for i in keep], [rivals[i] for i in keep]
                margins = [margins[i] for i in keep]
        if len(accepted) == MOST_CAUSES or budget.spent:
            cut = cut or len(accepted) < MOST_CAUSES
            break
        candidates, stale = _again(baseline, candidates, accepted, changed, say), set()
        cut = budget.spent
    for place in range(len(accepted)):
        with suppress(BudgetSpent):
            accepted[place], baseline = _finest(base, baseline, accepted, place)
    names = {t.variant.cause for t in accepted}
    # what was accepted beside a cause is no longer another name for it
    apart = tuple(tuple(t for t in one if t.variant.cause not in names) for one in rivals)
    last = {t.variant.cause: _reason(t, tried, accepted, library) for t in sorted(candidates, key=worth)}
    others = [t for name, t in first.items() if name not in names and name not in untried]
    rejected = [(t, _why_left_out(t, tried, library, last | behind)) for t in others]
    untried = [name for name in untried if name not in names]
    untried.sort(key=[cause.name for cause in library].index)
    baseline = replace(baseline, budget=Budget())  # what follows has time of its own
    return Selection(
        tuple(accepted), apart, tuple(margins), tried, tuple(rejected), baseline, tuple(untried), cut
    )


def _why_left_out(
    candidate: Candidate, tried: int, library: Sequence[Cause], reasons: Mapping[str, str]
) -> str:
    """Why a cause is not among the accepted ones: by its first candidate, else by what it was in the end."""
    cause = candidate.variant.cause
    return verdict_on(candidate, named(cause, library), tried) or reasons.get(cause) or EXPLAINED


def _first_candidates(
    baseline: Baseline, library: Sequence[Cause], say: Progress
) -> tuple[list[Candidate], list[str]]:
    """Every variant of every cause tried on the base, and the causes that the budget did not reach."""
    untried: list[str] = []

    def tried_on(cause: Cause) -> list[Candidate]:
        found = []
        try:
            baseline.budget.check()
            say(cause.name.replace("_", " "))
            for variant in cause.variants(baseline):
                found.append(_settled(baseline, attempt(baseline, variant)))
        except BudgetSpent:
            untried.append(cause.name)
        return found

    return [candidate for found in mapped(tried_on, library) for candidate in found], untried


def _rough(accepted: Sequence[Candidate], other: Candidate) -> int | None:
    """Place of an accepted cause of the same part whose finer form was not tried yet."""
    for place, one in enumerate(accepted):
        if one.variant.finer is not None and set(one.parts) & set(other.parts):
            return place
    return None


def _finest(
    base: Baseline, baseline: Baseline, accepted: Sequence[Candidate], place: int
) -> tuple[Candidate, Baseline]:
    """An accepted candidate in its finer form where that gains, and the baseline with it; it is
    tried once."""
    candidate = accepted[place]
    others = [*accepted[:place], *accepted[place + 1 :]]
    beside = {name for other in others for name in other.parts}
    ground = base
    if any(drives(other) for other in others):
        ground = redriven(replace(base, parts={**base.parts, THERMAL: baseline.parts[THERMAL]}))
    found, baseline = refined(ground, baseline, candidate, alone=not beside & set(candidate.parts))
    return replace(found, variant=replace(found.variant, finer=None)), baseline


def with_candidate(baseline: Baseline, candidate: Candidate) -> Baseline:
    """The baseline with what a candidate changed, the humidity on the temperature that is known by it."""
    wider = replace(baseline, parts={**baseline.parts, **candidate.parts})
    return redriven(wider) if drives(candidate) else wider


def drives(candidate: Candidate) -> bool:
    """Whether the air temperature is better known by a candidate: by all that changes its model, but for
    errors of its readings that the hygric part is told by itself.
    """
    return THERMAL in candidate.parts and HYGRIC not in candidate.variant.altered


def _class(
    baseline: Baseline, best: Candidate, good: Sequence[Candidate], candidates: Sequence[Candidate]
) -> tuple[Candidate, ...]:
    """The best candidate of every other cause that is not told apart from the chosen one.

    Acceptable ones are compared by evidence and free run; of others that are worth having those that simulate
    the same: a source that always runs and an offset of the ambient differ by how the exchange depends on the
    temperature alone, and no cabinet keeps that law as the library writes it.
    """
    others = {t.variant.cause: t for t in reversed(good)}
    for t in sorted(candidates, key=worth, reverse=True):
        close = t.lr > 0.0 and worth_having(t) and not t.beyond
        if close and t.variant.cause not in others and difference(baseline, best, t) < SAME:
            others[t.variant.cause] = t
    others.pop(best.variant.cause, None)
    acceptable = {t.variant.cause for t in good}
    return tuple(t for cause, t in others.items() if cause not in acceptable or alike(baseline, best, t))


def _ahead(best: Candidate, class_: Sequence[Candidate], candidates: Sequence[Candidate]) -> float:
    """Share of its evidence by which the best cause outside its class stays behind."""
    alike_to_it = {best.variant.cause, *(t.variant.cause for t in class_)}
    behind = max((worth(t) for t in candidates if t.variant.cause not in alike_to_it), default=0.0)
    return 1.0 - max(behind, 0.0) / max(worth(best), behind, 1e-9)


def _reason(candidate: Candidate, tried: int, accepted: Sequence[Candidate], library: Sequence[Cause]) -> str:
    """Why a candidate is not acceptable beside the accepted ones."""
    reason = verdict_on(candidate, named(candidate.variant.cause, library), tried)
    if reason:
        return reason
    if accepted and not worth_having(candidate):
        return NO_BETTER
    for other in accepted:
        common = set(other.parts) & set(candidate.parts)
        if common and candidate.bic_in(common) < SHARE * other.bic_in(common):
            return "no more than what a stronger cause of another form than assumed leaves behind"
    return ""


def _again(
    baseline: Baseline,
    candidates: Sequence[Candidate],
    accepted: Sequence[Candidate],
    changed: set[str],
    say: Progress,
) -> list[Candidate]:
    """The hopeful ones of the last round, two variants of a cause at most, tried beside what was accepted.

    changed: parts that are others now; where a candidate has none of them, nothing about it is.  What the
        budget
    does not last for is left out.
    """
    say("others beside it")
    done = {t.variant.cause for t in accepted}
    taken = {name: setting for t in accepted for name, setting in t.variant.features.items()}
    hopeful: list[Candidate] = []
    count: dict[str, int] = {}
    for candidate in sorted(candidates, key=worth, reverse=True):
        cause, features = candidate.variant.cause, candidate.variant.features
        if candidate.lr <= RETRY or cause in done or count.get(cause, 0) == 2:
            continue
        if any(name in taken and taken[name] != setting for name, setting in features.items()):
            continue  # one setting of a feature at a time: two dates need two names
        if any(_controls(candidate) & _controls(one) for one in accepted):
            continue
        count[cause] = count.get(cause, 0) + 1
        hopeful.append(candidate)

    def beside(candidate: Candidate) -> Candidate | None:
        if not changed & set(candidate.parts):
            return candidate
        try:
            baseline.budget.check()
            return _settled(baseline, attempt(baseline, started(baseline, candidate)))
        except BudgetSpent:
            return None

    return [candidate for candidate in mapped(beside, hopeful) if candidate is not None]


def _controls(candidate: Candidate) -> set[tuple[str, str]]:
    """(part, reading) of the controllers that a candidate brings.

    Of two that follow the same reading the second is what the first one's form leaves behind.
    """
    return {
        (part, SWITCHES[name](**settings).reads)
        for name, settings in candidate.variant.features.items()
        if name in SWITCHES
        for part in candidate.parts
    }


def _needed(
    base: Baseline, accepted: Sequence[Candidate], baseline: Baseline, say: Progress
) -> tuple[list[int], Baseline]:
    """Places of the causes that are still needed beside the last one, and the baseline with them alone."""
    say("earlier causes again")
    places = list(range(len(accepted)))
    for place in places[:-1]:
        others = [i for i in places if i != place]
        without = base
        for i in others:
            again = attempt(without, started(without, accepted[i]))
            without = with_candidate(without, again)
        lost = sum(
            2.0 * (baseline.parts[name].objective - without.parts[name].objective) for name in baseline.parts
        )
        if lost - accepted[place].price < EVIDENCE:
            return others, without
    return places, baseline


def alike(baseline: Baseline, best: Candidate, other: Candidate) -> bool:
    """Whether two acceptable causes cannot be told apart on this record."""
    if worth(best) - worth(other) < CLOSE:
        return True
    return difference(baseline, best, other) < (HALF if worth(other) >= HALF * worth(best) else SAME)


def difference(baseline: Baseline, best: Candidate, other: Candidate) -> float:
    """RMS difference of two causes' free runs over the RMS change that `best` makes [1], parts in units of
    their error.

    At the readings that all three have; a shifted clock of the cabinet leaves none, and the causes are taken
    as different.
    """
    apart, change = 0.0, 0.0
    for name, part in baseline.parts.items():
        runs = [part, *(candidate.parts.get(name, part) for candidate in (best, other))]
        known = [np.round(one.time_s[np.isfinite(one.error)]) for one in runs]
        shared = functools.reduce(np.intersect1d, known)
        if len(shared) < 0.5 * len(known[0]):
            return math.inf
        before, after, beside = (
            one.error[np.isfinite(one.error)][np.searchsorted(time, shared)]
            for one, time in zip(runs, known, strict=True)
        )
        scale = float(np.mean(before**2))
        apart += float(np.sum((after - beside) ** 2)) / scale
        change += float(np.sum((after - before) ** 2)) / scale
    return math.sqrt(apart / change) if change > 0 else math.inf
