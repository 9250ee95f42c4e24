"""What a cause is: its forms, what to check in the turbine, and the measurement that tells it from others.

`cause_of` makes a cause of one mechanism, in the package's library and in a user's file alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from hygrokf.data.prepared import prepare
from hygrokf.modelling.causes.forms import Form, Ground, Setting, Settings, using
from hygrokf.modelling.derived_inputs import FEATURES, without_settings
from hygrokf.physics.mechanisms import MECHANISMS
from hygrokf.physics.model import Feature, Mechanism

ALWAYS = ("ambient_temperature", "exchange_factor")
"""Inputs that every run has."""


@dataclass(frozen=True)
class Cause:
    """A physical cause.

    name: identifier.
    meaning, remedy, separate_by: what it is, what to check in the turbine, and the measurement that tells it
        from its rivals.
    forms: those in which a record can show it, none where it cannot.
    needs: signals without which it is not tried, for the report.
    mechanisms, features: name → factory, and name → (function, hold), that it brings.
    """

    name: str
    meaning: str
    remedy: str
    separate_by: str
    forms: Callable[[Ground], Iterable[Form]]
    needs: str = ""
    mechanisms: Mapping[str, Callable[..., Mechanism]] = field(default_factory=dict)
    features: Mapping[str, Feature] = field(default_factory=dict)


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
) -> Cause:
    """A cause that is one mechanism of the heat, of the vapour, or one of each.

    name: identifier.  thermal, hygric: factories of the mechanism, called without arguments.
    meaning, remedy, separate_by: one sentence each: what the cause is, what to check in the turbine, and
        which measurement tells it from its rivals.
    starts: values of shape parameters to try, in their units; the sizes of the effect are estimated at each.
    features: settings of the package's features that need any (`{"after_step": {"date_s": 1.6e9}}`), and
        features that the mechanism does not bring itself: (function(record, time), hold).
    needs: signals that features read.  On a record that lacks one the cause is not tried.

    Returns the cause, for the package's library or `Library.with_causes`.  For grids of dates or
    thresholds make a `Cause` with `forms` of your own.  Raises ValueError without a factory, TypeError where
    a factory returns no mechanism.
    """
    factories = {key: one for key, one in (("thermal", thermal), ("hygric", hygric)) if one is not None}
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
    grid = tuple(Setting(settings, values) for values in first or ({},))

    def given(ground: Ground) -> list[Form]:
        there = {key: one for key, one in mechanisms.items() if ground.humid or key == "thermal"}
        known = {*ALWAYS, *settings, *ground.record.signals}
        if prepare(ground.record).ambient_vapour is not None:
            known.add("ambient_absolute_humidity")
        lacking = [
            key for key, one in there.items()
            if {*one.inputs, *needs} - known - ground.inputs[key != "thermal"]
        ]  # fmt: skip
        if lacking or not there:
            return []
        heat, vapour = (using(there[key].name) if key in there else () for key in ("thermal", "hygric"))
        return [Form(name, "", heat, vapour, grid)]

    made = {mechanisms[key].name: factory for key, factory in factories.items()}
    return Cause(
        name, meaning, remedy, separate_by, given, ", ".join(sorted({*inputs, *needs} - set(settings))),
        mechanisms={key: one for key, one in made.items() if MECHANISMS.get(key) is not one},
        features={key: pair for key, pair in own.items() if FEATURES.get(key) != pair},
    )  # fmt: skip
