"""Which causes to accept: forward selection by likelihood and free run, one cause at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from hygrokf.discovery.library import LIBRARY, Cause, named
from hygrokf.discovery.scene import Scene
from hygrokf.discovery.trial import Trial, attempt
from hygrokf.stage import Progress

MATERIAL = 0.05
"""Share of the squared free-run error that must be gone, without the three best days, for a cause to be worth having."""
EVIDENCE = 10.0
"""Gain in 2 ln L beyond the price of parameters and grid (BIC) that counts as strong."""
UNSCORED_EVIDENCE = 30.0
"""The same for causes that hardly show in the free run."""
WORSE = -0.02
"""A cause that makes the free run of a part worse by more than this share is no cause."""
SMALLEST_SHIFT_S = 240.0
"""[s] below this a clock error is ordinary."""
ALIKE = 0.7
"""Causes whose evidence is at least this share of the best one's are kept in view as its rivals."""
MOST_CAUSES = 3
RETRY = 8.0
"""2 Δ ln L below which a cause is not tried again beside an accepted one."""


@dataclass(frozen=True)
class Choice:
    """Accepted trials in order with the trials that rivalled each, all others with the reason, and the last scene."""

    accepted: tuple[Trial, ...]
    rivals: tuple[tuple[Trial, ...], ...]
    rejected: tuple[tuple[Trial, str], ...]
    scene: Scene


def verdict_on(trial: Trial, cause: Cause) -> str:
    """Why a trial is not acceptable; empty where it is."""
    if trial.lr <= 0.0 or not trial.parts:
        return "it gains no likelihood"
    if not all(part.converged for part in trial.parts.values()) and trial.bic_gain < EVIDENCE:
        return "the estimate did not converge, and what it reached is no evidence"
    if trial.bic_gain < (EVIDENCE if cause.scored else UNSCORED_EVIDENCE):
        return "its gain in likelihood does not pay for its parameters and the settings searched"
    if min(trial.gain.values(), default=0.0) < WORSE and trial.best_lasting < 4.0 * -WORSE:
        return "it makes the free run worse"
    if cause.name == "clock_shift" and abs(float(trial.variant.settings["shift_s"])) < SMALLEST_SHIFT_S:
        return "a clock error of this size is ordinary"
    if cause.scored and trial.best_lasting < MATERIAL:
        return "significant, but the free run gains too little, or on a few days alone"
    return ""


def worth(trial: Trial) -> float:
    """What acceptable trials are ranked by: evidence in the likelihood."""
    return trial.bic_gain


def choose(scene: Scene, library: Sequence[Cause] = LIBRARY, say: Progress = lambda text: None) -> Choice:
    """Add causes as long as one is both significant and worth having."""
    accepted: list[Trial] = []
    rivals: list[tuple[Trial, ...]] = []
    last: list[tuple[Trial, str]] = []
    tried = list(library)
    while len(accepted) < MOST_CAUSES:
        trials = _round(scene, tried, accepted, say)
        judged = [(trial, verdict_on(trial, named(trial.variant.cause, library))) for trial in trials]
        good = sorted((t for t, reason in judged if not reason), key=worth, reverse=True)
        if not accepted or good:
            last = [(t, reason) for t, reason in judged if reason]
        if not good:
            break
        best = good[0]
        accepted.append(best)
        rivals.append(
            tuple(
                t
                for t in good[1:]
                if t.variant.cause != best.variant.cause and worth(t) >= ALIKE * worth(best)
            )
        )
        scene = replace(scene, parts={**scene.parts, **best.parts})
        if best.variant.shift_s:
            break
        hopeful = {t.variant.cause for t in trials if t.lr > RETRY}
        tried = [c for c in tried if c.name in hopeful and c.name != best.variant.cause]
    return Choice(tuple(accepted), tuple(rivals), tuple(last), scene)


def _round(scene: Scene, library: Sequence[Cause], accepted: Sequence[Trial], say: Progress) -> list[Trial]:
    """Every variant of every cause, the best variant of each."""
    taken = {feature for trial in accepted for feature in trial.variant.features}
    found = []
    for cause in library:
        say(cause.name.replace("_", " "))
        trials = []
        for variant in cause.variants(scene):
            if taken & set(variant.features):
                continue  # one feature of a name at a time: two dates need two names
            trials.append(attempt(scene, variant))
        if trials:
            found.append(max(trials, key=lambda t: t.bic_gain))
    return found
