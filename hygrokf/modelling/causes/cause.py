"""A cause: its forms, what to check in the turbine, and the measurement that distinguishes it from others.

`cause_of` makes a cause of one mechanism, in the package's library and in a user's file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from hygrokf.data.prepared import prepare
from hygrokf.modelling.causes.forms import Form, Ground, Setting, Settings, using
from hygrokf.modelling.derived_inputs import FEATURES, without_settings
from hygrokf.physics.mechanisms import MECHANISMS
from hygrokf.physics.model import Feature, Mechanism
from hygrokf.texts.parts import PARTS

ALWAYS = ("ambient_temperature", "exchange_factor")
"""Inputs that every run has."""


@dataclass(frozen=True)
class Cause:
    """A physical cause.

    name: identifier.
    meaning, remedy, separate_by: what the cause is, what to check in the turbine, and the measurement that
        distinguishes it from other causes.
    forms: the forms in which a record can show the cause; none if the record cannot.
    needs: signals without which the cause is not tried, in words for the report.
    mechanisms, features: name → factory, and name → (function, hold), that the cause adds to a library.
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
    """A cause that consists of a thermal mechanism, a hygric mechanism, or one of each.

    name: identifier.  thermal, hygric: factories of the mechanism, called without arguments.
    meaning, remedy, separate_by: one sentence each: what the cause is, what to check in the turbine, and
        which measurement distinguishes it from other causes.
    starts: values of shape parameters to try, in their units; at each the size of the effect is estimated.
    features: settings of the package's features that need any (`{"after_step": {"date_s": 1.6e9}}`), and
        features that the mechanism does not define itself: (function(record, time), hold).
    needs: signals that features read.  The cause is not tried on a record that lacks one of them.

    Returns the cause, for the package's library or `Library.with_causes`.  For grids of dates or
    thresholds make a `Cause` with `forms` of your own.  Raises ValueError without a factory, TypeError if a
    factory returns no mechanism.
    """
    networks = zip(PARTS, (thermal, hygric), strict=True)
    factories = {key: factory for key, factory in networks if factory is not None}
    if not factories:
        raise ValueError(f"cause {name!r}: expected a factory for thermal, hygric or both, found none")
    mechanisms = {key: factory() for key, factory in factories.items()}
    no_mechanism = [key for key, mechanism in mechanisms.items() if not isinstance(mechanism, Mechanism)]
    if no_mechanism:
        raise TypeError(
            f"cause {name!r}: expected factories that return a Mechanism: {', '.join(no_mechanism)}"
        )
    inputs = {key for mechanism in mechanisms.values() for key in mechanism.inputs}
    used: dict[str, Settings | Feature] = {**without_settings(inputs)}
    for mechanism in mechanisms.values():
        used |= mechanism.features
    used |= features or {}
    settings = {key: dict(value) if isinstance(value, Mapping) else {} for key, value in used.items()}
    functions = {key: value for key, value in used.items() if not isinstance(value, Mapping)}
    start_values = (starts,) if isinstance(starts, Mapping) else tuple(starts)
    grid = tuple(Setting(settings, values) for values in start_values or ({},))

    def forms(ground: Ground) -> list[Form]:
        """The one form of the cause; none where the record lacks an input of its mechanisms."""
        usable = {key: mechanism for key, mechanism in mechanisms.items() if ground.humid or key == "thermal"}
        available = {*ALWAYS, *settings, *ground.record.signals}
        if prepare(ground.record).ambient_vapour is not None:
            available.add("ambient_absolute_humidity")
        without_inputs = [
            key for key, mechanism in usable.items()
            if {*mechanism.inputs, *needs} - available - ground.inputs[key != "thermal"]
        ]  # fmt: skip
        if without_inputs or not usable:
            return []
        heat, vapour = (using(usable[key].name) if key in usable else () for key in PARTS)
        return [Form(name, "", heat, vapour, grid)]

    factory_by_name = {mechanisms[key].name: factory for key, factory in factories.items()}
    return Cause(
        name, meaning, remedy, separate_by, forms, ", ".join(sorted({*inputs, *needs} - set(settings))),
        mechanisms={
            key: factory for key, factory in factory_by_name.items() if MECHANISMS.get(key) is not factory
        },
        features={key: pair for key, pair in functions.items() if FEATURES.get(key) != pair},
    )  # fmt: skip
