"""The library of mechanisms: every module of this folder lists its factories by group."""

from __future__ import annotations

import copyreg
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from types import MappingProxyType
from typing import Any

from hygrokf.physics.mechanisms import heat, hygric, moisture, sensors, thermal, wandering
from hygrokf.physics.mechanisms.effects import linear_network as linear_network
from hygrokf.physics.model import Factory as Factory
from hygrokf.physics.model import Mechanism
from hygrokf.physics.parameters import Parameter

BASE: tuple[Factory, ...] = (*thermal.BASE, *hygric.BASE, *sensors.BASE)
"""Mechanisms of the base models."""
LOGGED: tuple[Factory, ...] = (*heat.LOGGED, *moisture.LOGGED)
"""Effects of actuators that the record contains.  Each mechanism is nested: at its null value it has no
effect."""
FURTHER: tuple[Factory, ...] = (*thermal.FURTHER, *heat.FURTHER, *moisture.FURTHER, *sensors.FURTHER)
"""Further mechanisms that may act on a cabinet.  Each is nested: at its null values it has no effect."""
WANDERING: tuple[Factory, ...] = wandering.WANDERING
"""Properties of the cabinet as states, for tracking."""
MECHANISMS: Mapping[str, Factory] = MappingProxyType(
    {factory.__name__: factory for factory in (*BASE, *LOGGED, *FURTHER, *WANDERING)}
)
"""Factories by mechanism name; `MECHANISMS[m.name](**m.settings)` creates the mechanism m again."""


def _reduce(mechanism: Mechanism) -> str | tuple[Any, ...]:
    """Reduce a mechanism for pickling: one of the package to its factory and settings, because the functions
    within a factory cannot be pickled; any other, or one with a replaced field, to its fields."""
    factory = MECHANISMS.get(mechanism.name)
    if factory is None or _comparable_fields(factory(**mechanism.settings)) != _comparable_fields(mechanism):
        return object.__reduce_ex__(mechanism, 4)
    return _rebuild, (factory, dict(mechanism.settings), mechanism.parameters)


def _comparable_fields(mechanism: Mechanism) -> dict[str, object]:
    """A mechanism's fields except the parameters, with each function replaced by its code."""
    values = {entry.name: getattr(mechanism, entry.name) for entry in fields(mechanism)}
    del values["parameters"]
    values |= values.pop("outputs")
    return {name: getattr(value, "__code__", value) for name, value in values.items()}


def _rebuild(factory: Factory, settings: Mapping[str, Any], parameters: Sequence[Parameter]) -> Mechanism:
    return replace(factory(**settings), parameters=tuple(parameters))


copyreg.pickle(Mechanism, _reduce)
