"""Which causes to accept: forward selection by likelihood and free run, one cause at a time."""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.progress import Progress
from hygrokf.discovery.baseline import Baseline, Budget, BudgetSpent, redriven
from hygrokf.discovery.candidate import MATERIAL, Candidate, attempt, polished, refined, restarted
from hygrokf.discovery.cause import Cause
from hygrokf.discovery.library import LIBRARY, named
from hygrokf.discovery.strata import SATURATED
from hygrokf.discovery.submodel import HYGRIC, THERMAL
from hygrokf.engine.parallel import mapped
from hygrokf.physics.switches import SWITCHES

EVIDENCE = 10.0
"""Gain in 2 ln L beyond the price of parameters and grid (BIC) that counts as strong."""
WORSE = -0.02
"""[1] a cause that increases the squared free-run error of a submodel by more than this share is refused."""
CLOSE = 10.0
"""Difference in evidence below which two acceptable causes cannot be told apart."""
HALF = 0.5
"""[1] two causes are alike where their free runs differ by less than this share of the change that the better
one makes, and the other has at least this share of its evidence."""
SAME = 0.25
"""[1] acceptable causes whose free runs differ by less than this share are alike whatever their evidence."""
MOST_CAUSES = 3
SHARE = 0.06
"""[1] share of an accepted cause's evidence that a further cause of the same submodel must have: the true
form is never known, and its difference from the assumed form stays in the errors."""
OVERWHELMING = 200.0
"""Evidence that is enough for any cause, however little the free run gains; the most in 36 cabinets without a
hidden cause was 88."""
EXPLAINED = "what it explains is explained by the accepted causes"
NO_BETTER = "beside the accepted causes it does not simulate better"
RETRY = 8.0
"""2 Δ ln L below which a cause is not tried again beside an accepted one."""


@dataclass(frozen=True)
class Accepted:
    """An accepted candidate, the candidates of other causes that cannot be told from it, and the margin [1]:
    the share of its evidence by which the best cause outside this class stays behind."""

    candidate: Candidate
    rivals: tuple[Candidate, ...] = ()
    margin: float = math.nan


@dataclass(frozen=True)
class Selection:
    """The outcome of a selection.

    accepted: in order; rejected: all other causes, with the reason; baseline: with the accepted causes.
    tried: number of variants; untried: causes for which there was no time; cut: whether there was no time to
        look beside the accepted causes.
    """

    accepted: tuple[Accepted, ...]
    tried: int
    rejected: tuple[tuple[Candidate, str], ...]
    baseline: Baseline
    untried: tuple[str, ...] = ()
    cut: bool = False

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """The accepted candidates, in order."""
        return tuple(one.candidate for one in self.accepted)


def verdict_on(candidate: Candidate, cause: Cause, tried: int = 1) -> str:
    """Why a candidate is not acceptable, empty where it is; tried: number of variants."""
    if candidate.lr <= 0.0 or not candidate.submodels:
        return "it gains no likelihood"
    certain = candidate.bic_gain >= EVIDENCE
    if not certain and not all(submodel.converged for submodel in candidate.submodels.values()):
        return "the estimate did not converge, and what it reached is no evidence"
    if not certain and not simulates(candidate, tried):
        return "its gain in likelihood does not pay for its parameters and the settings searched"
    if candidate.beyond:
        return f"{candidate.beyond.replace('_', ' ')} would have to be larger than is physically possible"
    readings = min(submodel.n for submodel in candidate.submodels.values())
    if candidate.variant.joint and min(candidate.lrs.values()) < math.log(readings):
        return "it acts on heat and vapour, and one of them does not show"
    if min(candidate.gain.values(), default=0.0) < WORSE:
        return "it makes the free run worse"
    stated = candidate.variant.settings
    if cause.name == "clock_shift" and abs(float(stated["shift_s"])) < float(stated["ordinary_s"]):
        return "a clock error of this size is ordinary"
    if candidate.value("humidity_ceiling", 0.0) > SATURATED:
        return "a ceiling as near to saturation as that is one of the air, not of the sensor"
    if not worth_having(candidate) and candidate.bic_gain < min(cause.alone, OVERWHELMING):
        return "significant, but the free run gains too little, or on a few days alone"
    return ""


def simulates(candidate: Candidate, tried: int) -> bool:
    """Whether the free run of a submodel gains a material share, more than chance gives the best of so many
    candidates and their settings.

    Where the model is far from right the likelihood is a poor judge, and this alone speaks for a cause.
    """
    if candidate.lr - candidate.price < EVIDENCE:
        return False
    largest = math.sqrt(2.0 * math.log(max(tried * candidate.variant.searched, 1.0)))
    return any(candidate.gain[name] >= MATERIAL and z >= largest for name, z in candidate.z.items())


def worth_having(candidate: Candidate) -> bool:
    """Whether the free run gains a material share even without its best days."""
    return candidate.best_lasting >= MATERIAL


def _settled(baseline: Baseline, candidate: Candidate) -> Candidate:
    """A candidate that improved the free run but stopped before converging, refitted; others unchanged."""
    done = all(submodel.converged for submodel in candidate.submodels.values())
    if done or candidate.bic_gain >= EVIDENCE or candidate.best_lasting < MATERIAL:
        return candidate
    return polished(baseline, candidate)


def brings_switch(candidate: Candidate) -> bool:
    """Whether a candidate brings a switch."""
    return bool(SWITCHES.keys() & set(candidate.variant.features))


def _by_evidence(candidates: Iterable[Candidate]) -> list[Candidate]:
    """The candidates, the best first."""
    return sorted(candidates, key=lambda one: one.bic_gain, reverse=True)


def select(
    baseline: Baseline, library: Sequence[Cause] = LIBRARY, say: Progress = lambda text: None
) -> Selection:
    """Add causes while one is both significant and worth having; remove earlier ones that a later one
    replaces.

    Once the baseline's budget is spent no further candidate is begun and running ones end; the candidates
    that are done by then are decided on.
    """
    base, budget, cut = baseline, baseline.budget, False
    accepted: list[Candidate] = []
    classes: dict[str, tuple[tuple[Candidate, ...], float]] = {}
    behind: dict[str, str] = {}
    stale: set[str] = set()

    candidates, untried = _first_candidates(baseline, library, say)
    tried = len(candidates)
    first = _best_of_each(candidates)
    while True:
        kept = [t for t in candidates if t.variant.cause not in behind]
        good = _by_evidence(t for t in kept if not reason_against(t, tried, accepted, library))
        if not good:
            break
        best = good[0]
        cause = best.variant.cause
        if cause in stale:  # tried beside a coarser form than is accepted now
            stale.remove(cause)
            candidates = [t for t in candidates if t.variant.cause != cause]
            with suppress(BudgetSpent):
                candidates.append(attempt(baseline, restarted(baseline, best)))
            continue
        with suppress(BudgetSpent):
            best = polished(baseline, best)
        reason = reason_against(best, tried, accepted, library)
        if reason:  # at its maximum it may gain less than before
            behind[cause] = reason
            continue
        before = baseline
        rough = _rough(accepted, best)
        if rough is not None and not budget.spent:  # the error of a coarse form is no further cause
            with suppress(BudgetSpent):
                accepted[rough], baseline = _finest(base, baseline, accepted, rough)
            if baseline is not before:
                behind = {}
                stale = {t.variant.cause for t in candidates if set(t.submodels) & set(best.submodels)}
            continue
        behind, stale = {}, set()
        rivals = _class(baseline, best, good, candidates)
        classes[cause] = rivals, _margin(best, rivals, candidates)
        accepted.append(best)
        baseline = with_candidate(baseline, best)
        changed = {n for n, submodel in baseline.submodels.items() if submodel is not before.submodels[n]}
        if len(accepted) > 1:
            with suppress(BudgetSpent):
                needed, baseline = _needed(base, accepted, baseline, say)
                if len(needed) < len(accepted):
                    accepted, changed = needed, set(baseline.submodels)
        if len(accepted) == MOST_CAUSES or budget.spent:
            cut = cut or len(accepted) < MOST_CAUSES
            break
        candidates = _again(baseline, candidates, accepted, changed, say)
        cut = budget.spent
    for place in range(len(accepted)):
        with suppress(BudgetSpent):
            accepted[place], baseline = _finest(base, baseline, accepted, place)
    last = {c: reason_against(t, tried, accepted, library) for c, t in _best_of_each(candidates).items()}
    names = {t.variant.cause for t in accepted}
    others = [t for cause, t in first.items() if cause not in names and cause not in untried]
    return Selection(
        accepted=tuple(_accepted(t, *classes[t.variant.cause], names) for t in accepted),
        tried=tried,
        rejected=tuple((t, _why_left_out(t, tried, library, last | behind)) for t in others),
        baseline=replace(baseline, budget=Budget()),  # the steps after the selection are not limited
        untried=tuple(cause.name for cause in library if cause.name in set(untried) - names),
        cut=cut,
    )


def _best_of_each(candidates: Iterable[Candidate]) -> dict[str, Candidate]:
    """The best candidate of each cause, by the cause's name."""
    return {t.variant.cause: t for t in sorted(candidates, key=lambda one: one.bic_gain)}


def _accepted(
    candidate: Candidate, rivals: Sequence[Candidate], margin: float, names: Collection[str]
) -> Accepted:
    """A candidate with its class; a cause that was accepted beside it (`names`) is not another name for
    it."""
    return Accepted(candidate, tuple(t for t in rivals if t.variant.cause not in names), margin)


def _why_left_out(
    candidate: Candidate, tried: int, library: Sequence[Cause], reasons: Mapping[str, str]
) -> str:
    """Why a cause is not among the accepted ones: by its first candidate, else by its last."""
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
    """Place of an accepted cause of the same submodel whose finer form was not tried yet."""
    for place, one in enumerate(accepted):
        if one.variant.finer is not None and set(one.submodels) & set(other.submodels):
            return place
    return None


def _finest(
    base: Baseline, baseline: Baseline, accepted: Sequence[Candidate], place: int
) -> tuple[Candidate, Baseline]:
    """An accepted candidate in its finer form where that gains, and the baseline with it; tried once."""
    candidate = accepted[place]
    others = [*accepted[:place], *accepted[place + 1 :]]
    beside = {name for other in others for name in other.submodels}
    ground = base
    if any(drives(other) for other in others):
        ground = redriven(replace(base, submodels={**base.submodels, THERMAL: baseline.submodels[THERMAL]}))
    found, baseline = refined(ground, baseline, candidate, alone=not beside & set(candidate.submodels))
    return replace(found, variant=replace(found.variant, finer=None)), baseline


def with_candidate(baseline: Baseline, candidate: Candidate) -> Baseline:
    """The baseline with a candidate's submodels, its humidity driven by the temperature that they know."""
    wider = replace(baseline, submodels={**baseline.submodels, **candidate.submodels})
    return redriven(wider) if drives(candidate) else wider


def drives(candidate: Candidate) -> bool:
    """Whether a candidate changes the known air temperature: where it changes the thermal model, unless it is
    an error of the readings that the hygric submodel has as an input of its own.
    """
    return THERMAL in candidate.submodels and HYGRIC not in candidate.variant.altered


def _class(
    baseline: Baseline, best: Candidate, good: Sequence[Candidate], candidates: Sequence[Candidate]
) -> tuple[Candidate, ...]:
    """The best candidate of every other cause that cannot be told from the chosen one.

    Acceptable candidates are compared by evidence and free run.  Others that are worth having belong to the
    class where they simulate the same: a source that always runs and an offset of the ambient differ only in
    how the exchange depends on the temperature, and no cabinet keeps that law exactly.
    """
    others = {t.variant.cause: t for t in reversed(good)}
    for t in _by_evidence(candidates):
        close = t.lr > 0.0 and worth_having(t) and not t.beyond
        if close and t.variant.cause not in others and difference(baseline, best, t) < SAME:
            others[t.variant.cause] = t
    others.pop(best.variant.cause, None)
    acceptable = {t.variant.cause for t in good}
    return tuple(t for cause, t in others.items() if cause not in acceptable or alike(baseline, best, t))


def _margin(best: Candidate, rivals: Sequence[Candidate], candidates: Sequence[Candidate]) -> float:
    """Share of its evidence by which the best cause outside its class stays behind."""
    class_ = {best.variant.cause, *(t.variant.cause for t in rivals)}
    behind = max((t.bic_gain for t in candidates if t.variant.cause not in class_), default=0.0)
    return 1.0 - max(behind, 0.0) / max(best.bic_gain, behind, 1e-9)


def reason_against(
    candidate: Candidate, tried: int, accepted: Sequence[Candidate], library: Sequence[Cause]
) -> str:
    """Why a candidate is not acceptable beside the accepted ones; empty where it is."""
    reason = verdict_on(candidate, named(candidate.variant.cause, library), tried)
    if reason:
        return reason
    if accepted and not worth_having(candidate):
        return NO_BETTER
    for other in accepted:
        common = set(other.submodels) & set(candidate.submodels)
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
    """The hopeful candidates of the last round, two variants of a cause at most, tried beside the accepted
    ones.

    changed: names of the submodels that are new; a candidate with none of them stays as it is.  Candidates
        that the budget does not reach are left out.
    """
    say("others beside it")
    done = {t.variant.cause for t in accepted}
    used = {name: setting for t in accepted for name, setting in t.variant.features.items()}
    hopeful: list[Candidate] = []
    count: dict[str, int] = {}
    for candidate in _by_evidence(candidates):
        cause, features = candidate.variant.cause, candidate.variant.features
        if candidate.lr <= RETRY or cause in done or count.get(cause, 0) == 2:
            continue
        if any(name in used and used[name] != setting for name, setting in features.items()):
            continue  # one setting of a feature at a time: two dates need two names
        if any(_controls(candidate) & _controls(one) for one in accepted):
            continue
        count[cause] = count.get(cause, 0) + 1
        hopeful.append(candidate)

    def beside(candidate: Candidate) -> Candidate | None:
        if not changed & set(candidate.submodels):
            return candidate
        try:
            baseline.budget.check()
            return _settled(baseline, attempt(baseline, restarted(baseline, candidate)))
        except BudgetSpent:
            return None

    return [candidate for candidate in mapped(beside, hopeful) if candidate is not None]


def _controls(candidate: Candidate) -> set[tuple[str, str]]:
    """(submodel, reading) of the controllers that a candidate brings.

    A second controller that follows the same reading explains what the form of the first leaves behind.
    """
    return {
        (submodel, SWITCHES[name](**settings).reads)
        for name, settings in candidate.variant.features.items()
        if name in SWITCHES
        for submodel in candidate.submodels
    }


def _needed(
    base: Baseline, accepted: Sequence[Candidate], baseline: Baseline, say: Progress
) -> tuple[list[Candidate], Baseline]:
    """The causes that are still needed beside the last one, and the baseline with them alone."""
    say("earlier causes again")
    for place, candidate in enumerate(accepted[:-1]):
        others = [*accepted[:place], *accepted[place + 1 :]]
        without = base
        for other in others:
            without = with_candidate(without, attempt(without, restarted(without, other)))
        lost = sum(
            2.0 * (submodel.objective - without.submodels[name].objective)
            for name, submodel in baseline.submodels.items()
        )
        if lost - candidate.price < EVIDENCE:
            return others, without
    return list(accepted), baseline


def alike(baseline: Baseline, best: Candidate, other: Candidate) -> bool:
    """Whether two acceptable causes cannot be told apart on this record."""
    if best.bic_gain - other.bic_gain < CLOSE:
        return True
    return difference(baseline, best, other) < (HALF if other.bic_gain >= HALF * best.bic_gain else SAME)


def difference(baseline: Baseline, best: Candidate, other: Candidate) -> float:
    """RMS difference of two causes' free runs over the RMS change that `best` makes [1], each submodel in
    units of its error.

    Compared at the readings that all three runs share; infinite where these are few, as with a shifted clock
    of the cabinet.
    """
    apart, change = 0.0, 0.0
    for name, submodel in baseline.submodels.items():
        runs = [submodel, *(candidate.submodels.get(name, submodel) for candidate in (best, other))]
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
