"""What a cause is: a name, sentences about it, and the variants in which it is tried on a baseline."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, TypeAlias

from hygrokf.discovery.baseline import Baseline
from hygrokf.discovery.clocks import Shift
from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.submodel import HYGRIC, THERMAL
from hygrokf.physics.model import Mechanism

MechanismSettings: TypeAlias = tuple[str, Settings]
"""A mechanism's name and its settings."""
Additions: TypeAlias = Mapping[str, tuple[MechanismSettings, ...]]
"""Mechanisms that a variant adds, by submodel."""


@dataclass(frozen=True)
class Variant:
    """One form of a cause, ready to be estimated.

    additions: mechanisms by submodel; features: inputs that they read; starts: start values to try.
    settings: what a search chose (dates, thresholds); searched: number of independent settings that the
        search amounts to.
    altered: submodel → mechanism → settings that differ from the base; shift: a source whose stamps move.
    joint: whether it acts in all its submodels or not at all: exchanged air carries heat and vapour.
    finer: a costlier form of the same mechanisms that replaces this one in the end where it gains more; it
        starts from the values of this one, those in `scaled` of the finer form times a factor.
    """

    cause: str
    form: str
    additions: Additions = field(default_factory=dict)
    features: Mapping[str, Settings] = field(default_factory=dict)
    starts: tuple[Mapping[str, float], ...] = ({},)
    settings: Settings = field(default_factory=dict)
    searched: float = 1.0
    altered: Mapping[str, Mapping[str, Settings]] = field(default_factory=dict)
    shift: Shift | None = None
    finer: Variant | None = None
    scaled: Mapping[str, float] = field(default_factory=dict)
    joint: bool = False


@dataclass(frozen=True)
class Cause:
    """A physical cause.

    meaning: what it is; remedy: what to check in the turbine; separate_by: the measurement that tells it from
        its rivals.  needs: signals without which it is not tried, for the report.
    variants: its forms on a baseline, none where the record cannot show it.
    alone: gain in evidence (see `model_selection`) that is enough without a better free run: a clock or a
        changed exchange hardly shows in the free run, and simulated switches lose their phase.
    event: whether it happened at times that nobody logs, which no simulation can foresee.
    mechanisms: name → factory, features: name → (function, hold), of a user's own cause.
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


def needs_humidity(variants: Callable[[Baseline], list[Variant]]) -> Callable[[Baseline], list[Variant]]:
    """Variants that exist only where the baseline has a hygric submodel."""

    @wraps(variants)
    def where_there_is(baseline: Baseline) -> list[Variant]:
        return variants(baseline) if HYGRIC in baseline.submodels else []

    return where_there_is


def penalty(variant: Variant, parameters: int, n: int) -> float:
    """Price of a variant in 2 ln L: BIC for its parameters, and 2 ln of the number of settings searched."""
    return parameters * math.log(max(n, 3)) + 2.0 * math.log(max(variant.searched, 1))


def additions_of(baseline: Baseline, thermal: MechanismSettings, hygric: MechanismSettings) -> Additions:
    """A mechanism for each submodel that the baseline has."""
    both = {THERMAL: (thermal,), HYGRIC: (hygric,)}
    return {name: pairs for name, pairs in both.items() if name in baseline.submodels}


def at_setting(
    cause: str,
    form: str,
    additions: Additions,
    feature: str,
    found: tuple[Settings, float],
    starts: tuple[Mapping[str, float], ...] = ({},),
    joint: bool = False,
) -> Variant:
    """A variant whose `feature` has the setting that a search found; found: (setting, effective number
    searched)."""
    setting, searched = found
    return Variant(cause, form, additions, {feature: setting}, starts, setting, searched, joint=joint)
