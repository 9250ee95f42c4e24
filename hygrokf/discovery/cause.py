"""What a cause is: a name, words, a remedy, and the variants in which it is tried on a baseline."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from hygrokf.discovery.baseline import Baseline
from hygrokf.discovery.clocks import Shift
from hygrokf.discovery.discovery_results import Settings
from hygrokf.physics.model import Mechanism

Additions = Mapping[str, tuple[tuple[str, Settings], ...]]
"""What a variant adds: part → pairs of a mechanism's name and its settings."""


@dataclass(frozen=True)
class Variant:
    """One form of a cause, ready to be estimated.

    `additions` part → (mechanism, settings) pairs; `features` inputs they read; `starts` start values to be
    tried; `settings` what was chosen from a grid (dates, thresholds), `searched` how many independent
    settings that amounts to; `altered` part → mechanism → settings that differ from the base; `shift` a
    source whose stamps are to be moved. `joint`: whether it acts in all its parts or not at all, as air that
    is exchanged carries heat and vapour, and a drier heats. `finer` a costlier form of the same mechanisms,
    which takes the place of this one in the end where it gains more; it starts from all values that are
    there, those in its `scaled` times a factor.
    """

    cause: str
    form: str
    additions: Additions = field(default_factory=dict)
    features: Mapping[str, Settings] = field(default_factory=dict)
    starts: tuple[Mapping[str, float], ...] = ({},)
    settings: Mapping[str, Any] = field(default_factory=dict)
    searched: float = 1.0
    altered: Mapping[str, Mapping[str, Settings]] = field(default_factory=dict)
    shift: Shift | None = None
    finer: Variant | None = None
    scaled: Mapping[str, float] = field(default_factory=dict)
    joint: bool = False


@dataclass(frozen=True)
class Cause:
    """A physical cause: its `variants` in a baseline (none where the record cannot show it), in words what it
    is, what to check in the turbine (`remedy`), and the measurement that would tell it from its rivals
    (`separate_by`).

    `alone`: gain in evidence (see `model_selection`) that is enough without a better free run: a clock or a
    changed exchange hardly shows in it, and simulated switches lose their phase.  `event`: whether it
    happened at times that nobody logs, which no simulation can foresee.  A user's own cause brings its
    `mechanisms`, name → factory, and its `features`, name → (function, hold).
    """

    name: str
    meaning: str
    remedy: str
    separate_by: str
    variants: Callable[[Baseline], list[Variant]]
    needs: str = ""
    alone: float = math.inf
    event: bool = False
    mechanisms: Mapping[str, Callable[..., Mechanism]] = field(default_factory=dict)
    features: Mapping[str, tuple[Callable[..., Any], str]] = field(default_factory=dict)


def penalty(variant: Variant, parameters: int, n: int) -> float:
    """What a variant's parameters and its grid cost in 2 ln L (BIC, and 2 ln of the settings searched)."""
    return parameters * math.log(max(n, 3)) + 2.0 * math.log(max(variant.searched, 1))


def additions_of(
    baseline: Baseline, **additions: tuple[tuple[str, Settings], ...]
) -> dict[str, tuple[tuple[str, Settings], ...]]:
    """Additions for the parts that the baseline has."""
    return {part: pairs for part, pairs in additions.items() if part in baseline.parts}


def one_mechanism(
    cause: str, part: str, mechanism: str, *starts: Mapping[str, float]
) -> Callable[[Baseline], list[Variant]]:
    """A cause that is one mechanism of one part, without a grid."""

    def variants(baseline: Baseline) -> list[Variant]:
        if part not in baseline.parts:
            return []
        return [Variant(cause, mechanism, {part: ((mechanism, {}),)}, starts=starts)]

    return variants
