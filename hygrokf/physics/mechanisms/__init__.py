"""The library of mechanisms: every module of this folder lists its own factories, by group."""

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


def _reduced(mechanism: Mechanism) -> str | tuple[Any, ...]:
    """How to pickle a mechanism: one of the package by its factory, because the functions within a factory
    cannot be pickled; any other by its fields, also where somebody has replaced one of them."""
    factory = MECHANISMS.get(mechanism.name)
    if factory is None or _compared(factory(**mechanism.settings)) != _compared(mechanism):
        return object.__reduce_ex__(mechanism, 4)
    return _made_again, (factory, dict(mechanism.settings), mechanism.parameters)


def _compared(mechanism: Mechanism) -> dict[str, object]:
    """Its fields except the parameters, each function by its code."""
    found = {one.name: getattr(mechanism, one.name) for one in fields(mechanism)}
    del found["parameters"]
    found |= found.pop("outputs")
    return {name: getattr(value, "__code__", value) for name, value in found.items()}


def _made_again(factory: Factory, settings: Mapping[str, Any], parameters: Sequence[Parameter]) -> Mechanism:
    return replace(factory(**settings), parameters=tuple(parameters))


copyreg.pickle(Mechanism, _reduced)
