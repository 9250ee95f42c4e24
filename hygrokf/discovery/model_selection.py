"""Which causes to accept: forward selection by likelihood and free run, one cause at a time."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.discovery.baseline import HYGRIC, THERMAL, Scene, redriven
from hygrokf.discovery.budget import Budget, BudgetSpent
from hygrokf.discovery.candidate import MATERIAL, Trial, attempt, polished, refined, started
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
class Choice:
    """Accepted trials in order with the trials that rivalled each, all others with the reason, and the last
    scene.

    `margins`: share of its evidence by which the best cause outside its class stayed behind each accepted
    one; `tried`: number of variants that were tried; `untried` causes for which the time did not last; `cut`:
    whether it did not last for looking beside what was accepted.
    """

    accepted: tuple[Trial, ...]
    rivals: tuple[tuple[Trial, ...], ...]
    margins: tuple[float, ...]
    tried: int
    rejected: tuple[tuple[Trial, str], ...]
    scene: Scene
    untried: tuple[str, ...] = ()
    cut: bool = False


def verdict_on(trial: Trial, cause: Cause, tried: int = 1) -> str:
    """Why a trial, one of so many that were `tried`, is not acceptable; empty where it is."""
    if trial.lr <= 0.0 or not trial.parts:
        return "it gains no likelihood"
    certain = trial.bic_gain >= EVIDENCE
    if not certain and not all(part.converged for part in trial.parts.values()):
        return "the estimate did not converge, and what it reached is no evidence"
    if not certain and not simulates(trial, tried):
        return "its gain in likelihood does not pay for its parameters and the settings searched"
    if trial.beyond:
        return f"{trial.beyond.replace('_', ' ')} would have to be larger than is physically possible"
    if trial.variant.joint and min(trial.lrs.values()) < math.log(min(p.n for p in trial.parts.values())):
        return "it acts on heat and vapour, and one of them does not show"
    if min(trial.gain.values(), default=0.0) < WORSE:
        return "it makes the free run worse"
    stated = trial.variant.settings
    if cause.name == "clock_shift" and abs(float(stated["shift_s"])) < float(stated["ordinary_s"]):
        return "a clock error of this size is ordinary"
    if trial.value("humidity_ceiling", 0.0) > SATURATION:
        return "a ceiling as near to saturation as that is one of the air, not of the sensor"
    if not worth_having(trial) and trial.bic_gain < min(cause.alone, OVERWHELMING):
        return "significant, but the free run gains too little, or on a few days alone"
    return ""


def simulates(trial: Trial, tried: int) -> bool:
    """Whether the free run of a part gains a material share beyond what chance makes of so many trials and
    their settings.

    Where the model is far from right the likelihood knows little, and this speaks for a cause by itself.
    """
    if trial.lr - trial.price < EVIDENCE:
        return False
    largest = math.sqrt(2.0 * math.log(max(tried * trial.variant.searched, 1.0)))
    return any(trial.gain[name] >= MATERIAL and z >= largest for name, z in trial.z.items())


def worth_having(trial: Trial) -> bool:
    """Whether the free run gains a material share without its best days."""
    return trial.best_lasting >= MATERIAL


def _settled(scene: Scene, trial: Trial) -> Trial:
    """A trial that simulates better but was cut short, climbed on; others as they are."""
    done = all(part.converged for part in trial.parts.values())
    if done or trial.bic_gain >= EVIDENCE or trial.best_lasting < MATERIAL:
        return trial
    return polished(scene, trial)


def switches(trial: Trial) -> bool:
    """Whether what was tried is a switch."""
    return bool(SWITCHES.keys() & set(trial.variant.features))


def worth(trial: Trial) -> float:
    """What acceptable trials are ranked by: evidence in the likelihood."""
    return trial.bic_gain


def choose(scene: Scene, library: Sequence[Cause] = LIBRARY, say: Progress = lambda text: None) -> Choice:
    """Add causes while one is both significant and worth having; take back those that a later one replaces.

    Once the scene's budget is spent no further trial is begun, and those that run end; what was found by then
    is decided on as it stands.
    """
    base, budget = scene, scene.budget
    cut = False
    accepted: list[Trial] = []
    rivals: list[tuple[Trial, ...]] = []
    margins: list[float] = []
    behind: dict[str, str] = {}
    stale: set[str] = set()

    trials, untried = _first_trials(scene, library, say)
    tried = len(trials)
    first = {t.variant.cause: t for t in sorted(trials, key=worth)}  # the best of each cause comes last
    while True:
        kept = [t for t in trials if t.variant.cause not in behind]
        good = [t for t in kept if not _reason(t, tried, accepted, library)]
        good.sort(key=worth, reverse=True)
        if not good:
            break
        best = good[0]
        if best.variant.cause in stale:  # beside a coarser form than is accepted now
            stale.remove(best.variant.cause)
            trials = [t for t in trials if t.variant.cause != best.variant.cause]
            with suppress(BudgetSpent):
                trials.append(attempt(scene, started(scene, best)))
            continue
        with suppress(BudgetSpent):
            best = polished(scene, best)
        class_ = _class(scene, best, good, trials)
        ahead = _ahead(best, class_, trials)
        slipped = _reason(best, tried, accepted, library)  # at its maximum it may gain less than on the way
        if slipped:
            behind[best.variant.cause] = slipped
            continue
        before = scene
        rough = _rough(accepted, best)
        if rough is not None and not budget.spent:  # what a coarse form leaves behind is no other cause
            with suppress(BudgetSpent):
                accepted[rough], scene = _finest(base, scene, accepted, rough)
            if scene is not before:
                behind, stale = {}, {t.variant.cause for t in trials if set(t.parts) & set(best.parts)}
            continue
        behind = {}
        rivals.append(class_)
        margins.append(ahead)
        accepted.append(best)
        scene = with_trial(scene, best)
        changed = {name for name, part in scene.parts.items() if part is not before.parts[name]}
        if len(accepted) > 1:
            with suppress(BudgetSpent):
                keep, scene = _needed(base, accepted, scene, say)
                if len(keep) < len(accepted):
                    changed = set(scene.parts)
                accepted, rivals = [accepted[i] for i in keep], [rivals[i] for i in keep]
                margins = [margins[i] for i in keep]
        if len(accepted) == MOST_CAUSES:
            break
        if budget.spent:
            cut = True
            break
        trials, stale = _again(scene, trials, accepted, changed, say), set()
        cut = budget.spent
    for place in range(len(accepted)):
        with suppress(BudgetSpent):
            accepted[place], scene = _finest(base, scene, accepted, place)
    names = {t.variant.cause for t in accepted}
    # what was accepted beside a cause is no longer another name for it
    apart = tuple(tuple(t for t in one if t.variant.cause not in names) for one in rivals)
    last = {t.variant.cause: _reason(t, tried, accepted, library) for t in sorted(trials, key=worth)}
    others = [t for name, t in first.items() if name not in names and name not in untried]
    rejected = [(t, _why_left_out(t, tried, library, last | behind)) for t in others]
    untried = [name for name in untried if name not in names]
    untried.sort(key=[cause.name for cause in library].index)
    scene = replace(scene, budget=Budget())  # what follows has time of its own
    return Choice(tuple(accepted), apart, tuple(margins), tried, tuple(rejected), scene, tuple(untried), cut)


def _why_left_out(trial: Trial, tried: int, library: Sequence[Cause], reasons: Mapping[str, str]) -> str:
    """Why a cause is not among the accepted ones: by its first trial, else by what it was in the end."""
    cause = trial.variant.cause
    return verdict_on(trial, named(cause, library), tried) or reasons.get(cause) or EXPLAINED


def _first_trials(scene: Scene, library: Sequence[Cause], say: Progress) -> tuple[list[Trial], list[str]]:
    """Every variant of every cause tried on the base, and the causes that the budget did not reach."""
    untried: list[str] = []

    def tried_on(cause: Cause) -> list[Trial]:
        found = []
        try:
            scene.budget.check()
            say(cause.name.replace("_", " "))
            for variant in cause.variants(scene):
                found.append(_settled(scene, attempt(scene, variant)))
        except BudgetSpent:
            untried.append(cause.name)
        return found

    return [trial for found in mapped(tried_on, library) for trial in found], untried


def _rough(accepted: Sequence[Trial], other: Trial) -> int | None:
    """Place of an accepted cause of the same part whose finer form was not tried yet."""
    for place, one in enumerate(accepted):
        if one.variant.finer is not None and set(one.parts) & set(other.parts):
            return place
    return None


def _finest(base: Scene, scene: Scene, accepted: Sequence[Trial], place: int) -> tuple[Trial, Scene]:
    """An accepted trial in its finer form where that gains, and the scene with it; it is tried once."""
    trial = accepted[place]
    others = [*accepted[:place], *accepted[place + 1 :]]
    beside = {name for other in others for name in other.parts}
    ground = base
    if any(drives(other) for other in others):
        ground = redriven(replace(base, parts={**base.parts, THERMAL: scene.parts[THERMAL]}))
    found, scene = refined(ground, scene, trial, alone=not beside & set(trial.parts))
    return replace(found, variant=replace(found.variant, finer=None)), scene


def with_trial(scene: Scene, trial: Trial) -> Scene:
    """The scene with what a trial changed, the humidity on the temperature that is known by it."""
    wider = replace(scene, parts={**scene.parts, **trial.parts})
    return redriven(wider) if drives(trial) else wider


def drives(trial: Trial) -> bool:
    """Whether the air temperature is better known by a trial: by all that changes its model, but for errors
    of its readings that the hygric part is told by itself.
    """
    return THERMAL in trial.parts and HYGRIC not in trial.variant.altered


def _class(scene: Scene, best: Trial, good: Sequence[Trial], trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """The best trial of every other cause that is not told apart from the chosen one.

    Acceptable ones are compared by evidence and free run; of others that are worth having those that simulate
    the same: a source that always runs and an offset of the ambient differ by how the exchange depends on the
    temperature alone, and no cabinet keeps that law as the library writes it.
    """
    others = {t.variant.cause: t for t in reversed(good)}
    for t in sorted(trials, key=worth, reverse=True):
        close = t.lr > 0.0 and worth_having(t) and not t.beyond
        if close and t.variant.cause not in others and difference(scene, best, t) < SAME:
            others[t.variant.cause] = t
    others.pop(best.variant.cause, None)
    acceptable = {t.variant.cause for t in good}
    return tuple(t for cause, t in others.items() if cause not in acceptable or alike(scene, best, t))


def _ahead(best: Trial, class_: Sequence[Trial], trials: Sequence[Trial]) -> float:
    """Share of its evidence by which the best cause outside its class stays behind."""
    alike_to_it = {best.variant.cause, *(t.variant.cause for t in class_)}
    behind = max((worth(t) for t in trials if t.variant.cause not in alike_to_it), default=0.0)
    return 1.0 - max(behind, 0.0) / max(worth(best), behind, 1e-9)


def _reason(trial: Trial, tried: int, accepted: Sequence[Trial], library: Sequence[Cause]) -> str:
    """Why a trial is not acceptable beside the accepted ones."""
    reason = verdict_on(trial, named(trial.variant.cause, library), tried)
    if reason:
        return reason
    if accepted and not worth_having(trial):
        return NO_BETTER
    for other in accepted:
        common = set(other.parts) & set(trial.parts)
        if common and trial.bic_in(common) < SHARE * other.bic_in(common):
            return "no more than what a stronger cause of another form than assumed leaves behind"
    return ""


def _again(
    scene: Scene,
    trials: Sequence[Trial],
    accepted: Sequence[Trial],
    changed: set[str],
    say: Progress,
) -> list[Trial]:
    """The hopeful ones of the last round, two variants of a cause at most, tried beside what was accepted.

    changed: parts that are others now; where a trial has none of them, nothing about it is.  What the budget
    does not last for is left out.
    """
    say("others beside it")
    done = {t.variant.cause for t in accepted}
    taken = {name: setting for t in accepted for name, setting in t.variant.features.items()}
    hopeful: list[Trial] = []
    count: dict[str, int] = {}
    for trial in sorted(trials, key=worth, reverse=True):
        cause, features = trial.variant.cause, trial.variant.features
        if trial.lr <= RETRY or cause in done or count.get(cause, 0) == 2:
            continue
        if any(name in taken and taken[name] != setting for name, setting in features.items()):
            continue  # one setting of a feature at a time: two dates need two names
        if any(_controls(trial) & _controls(one) for one in accepted):
            continue
        count[cause] = count.get(cause, 0) + 1
        hopeful.append(trial)

    def beside(trial: Trial) -> Trial | None:
        if not changed & set(trial.parts):
            return trial
        try:
            scene.budget.check()
            return _settled(scene, attempt(scene, started(scene, trial)))
        except BudgetSpent:
            return None

    return [trial for trial in mapped(beside, hopeful) if trial is not None]


def _controls(trial: Trial) -> set[tuple[str, str]]:
    """(part, reading) of the controllers that a trial brings.

    Of two that follow the same reading the second is what the first one's form leaves behind.
    """
    return {
        (part, SWITCHES[name](**settings).reads)
        for name, settings in trial.variant.features.items()
        if name in SWITCHES
        for part in trial.parts
    }


def _needed(base: Scene, accepted: Sequence[Trial], scene: Scene, say: Progress) -> tuple[list[int], Scene]:
    """Places of the causes that are still needed beside the last one, and the scene with them alone."""
    say("earlier causes again")
    places = list(range(len(accepted)))
    for place in places[:-1]:
        others = [i for i in places if i != place]
        without = base
        for i in others:
            again = attempt(without, started(without, accepted[i]))
            without = with_trial(without, again)
        lost = sum(
            2.0 * (scene.parts[name].objective - without.parts[name].objective) for name in scene.parts
        )
        if lost - accepted[place].price < EVIDENCE:
            return others, without
    return places, scene


def alike(scene: Scene, best: Trial, other: Trial) -> bool:
    """Whether two acceptable causes cannot be told apart on this record."""
    if worth(best) - worth(other) < CLOSE:
        return True
    return difference(scene, best, other) < (HALF if worth(other) >= HALF * worth(best) else SAME)


def difference(scene: Scene, best: Trial, other: Trial) -> float:
    """RMS difference of two causes' free runs over the RMS change that `best` makes [1], parts in units of
    their error.

    At the readings that all three have; a shifted clock of the cabinet leaves none, and the causes are taken
    as different.
    """
    apart, change = 0.0, 0.0
    for name, part in scene.parts.items():
        runs = [part, *(trial.parts.get(name, part) for trial in (best, other))]
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
