"""What a cause is: a name, sentences about it, and the variants in which it is tried on a baseline.

`cause_of` makes a cause of one mechanism, in the package's library and in a user's file alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import wraps
from typing import TypeAlias

from hygrokf.data.ambient import ambient_absolute_humidity
from hygrokf.data.clocks import Shift
from hygrokf.discovery.baseline import Baseline
from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.submodel import HYGRIC, THERMAL
from hygrokf.modelling.derived_inputs import without_settings
from hygrokf.modelling.registry import is_package_feature, is_package_mechanism
from hygrokf.physics.model import Feature, Mechanism

MechanismSettings: TypeAlias = tuple[str, Settings]
"""A mechanism's name and its settings."""
Additions: TypeAlias = Mapping[str, tuple[MechanismSettings, ...]]
"""Mechanisms that a variant adds, by submodel."""
ALWAYS = ("ambient_temperature", "exchange_factor")
"""Inputs that every run has."""


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

    name: identifier.
    meaning, remedy, separate_by: what it is, what to check in the turbine, and the measurement that tells it
        from its rivals.
    variants: its forms on a baseline, none where the record cannot show it.
    needs: signals without which it is not tried, for the report.
    alone: [1] gain in evidence, in 2 ln L (`model_selection`), that is enough without a better free run: a
        clock or a changed exchange hardly shows in the free run, and simulated switches lose their phase.
    event: whether it happened at times that nobody logs, which no simulation can foresee.
    mechanisms, features: name → factory, and name → (function, hold), of a user's own cause.
    forms, searches: what is tried, and the settings that are searched, for the site's page of causes.
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
    features: Mapping[str, Feature] = field(default_factory=dict)
    forms: str = ""
    searches: str = ""


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


def cause_of(
    name: str,
    *,
    thermal: Callable[[], Mechanism] | None = None,
    hygric: Callable[[], Mechanism] | None = None,
    meaning: str,
    remedy: str,
    separate_by: str,
    starts: Mapping[str, float] | Sequence[Mapping[str, float]] = (),
    features: Mapping[str, Settings | Feature] | None = None,
    needs: Sequence[str] = (),
    alone: float = math.inf,
    forms: str = "",
) -> Cause:
    """A cause that is one mechanism of the thermal submodel, of the hygric submodel, or one of each.

    name: identifier.  thermal, hygric: factories of the mechanism, called without arguments.
    meaning, remedy, separate_by: one sentence each: what the cause is, what to check in the turbine, and
        which measurement tells it from its rivals.
    starts: start values of parameters, in their units; of several the best is followed.
    features: settings of the package's features that need any (`{"after_step": {"date_s": 1.6e9}}`), and
        features that the mechanism does not bring itself: (function(record, time), hold).
    needs: signals that features read.  On a record that lacks one the cause is not tried.
    alone: [1] gain in evidence, in 2 ln L, that is enough without a better free run.
    forms: what is tried, for the site's page of causes.

    Returns the cause, for the library of the package or the `library` of `discover`.  For grids of dates or
    thresholds make a `Cause` with `variants` of your own.  Raises ValueError without a factory, TypeError
    where a factory returns no mechanism.
    """
    factories = {key: one for key, one in ((THERMAL, thermal), (HYGRIC, hygric)) if one is not None}
    if not factories:
        raise ValueError(f"cause {name!r}: expected a factory for thermal, hygric or both, found none")
    mechanisms = {key: factory() for key, factory in factories.items()}
    wrong = [key for key, one in mechanisms.items() if not isinstance(one, Mechanism)]
    if wrong:
        raise TypeError(f"cause {name!r}: expected factories that return a Mechanism: {', '.join(wrong)}")
    inputs = {key for one in mechanisms.values() for key in one.inputs}
    brought = {key: pair for one in mechanisms.values() for key, pair in one.features.items()}
    named = {**without_settings(inputs), **brought, **(features or {})}
    settings = {key: dict(value) if isinstance(value, Mapping) else {} for key, value in named.items()}
    own = {key: value for key, value in named.items() if not isinstance(value, Mapping)}
    first = (starts,) if isinstance(starts, Mapping) else tuple(starts)

    def variants(baseline: Baseline) -> list[Variant]:
        there = {key: one for key, one in mechanisms.items() if key in baseline.submodels}
        if not there or any(_lacking(baseline, key, one, settings, needs) for key, one in there.items()):
            return []
        additions: Additions = {key: ((one.name, {}),) for key, one in there.items()}
        return [Variant(name, "as given", additions, settings, first or ({},))]

    made = {mechanisms[key].name: factory for key, factory in factories.items()}
    return Cause(
        name, meaning, remedy, separate_by, variants,
        ", ".join(sorted({*inputs, *needs} - set(settings))), alone,
        mechanisms={key: one for key, one in made.items() if not is_package_mechanism(key, one)},
        features={key: pair for key, pair in own.items() if not is_package_feature(key, pair)},
        forms=forms,
    )  # fmt: skip


def _lacking(
    baseline: Baseline,
    submodel: str,
    mechanism: Mechanism,
    features: Mapping[str, Settings],
    needs: Sequence[str],
) -> set[str]:
    """Signals that a mechanism or its features read and a record does not have."""
    inputs = baseline.submodels[submodel].base.model.inputs
    there = {*ALWAYS, *features, *baseline.record.signals, *inputs}
    if ambient_absolute_humidity(baseline.record) is not None:
        there.add("ambient_absolute_humidity")
    return {*mechanism.inputs, *needs} - there
