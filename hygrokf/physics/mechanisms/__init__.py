"""The library of mechanisms: every module of this folder lists its own factories, by group."""

from __future__ import annotations

from collections.abc import Callable

from hygrokf.physics.mechanisms import heat, hygric, moisture, sensors, thermal, wandering
from hygrokf.physics.mechanisms.network import linear_network as linear_network
from hygrokf.physics.model import Mechanism

Factory = Callable[..., Mechanism]
"""A function (**settings) -> mechanism."""

BASE: tuple[Factory, ...] = (*thermal.BASE, *hygric.BASE, *sensors.BASE)
"""Mechanisms of the base models."""
LOGGED: tuple[Factory, ...] = (*heat.LOGGED, *moisture.LOGGED)
"""Effects of actuators that the record contains.  Each mechanism is nested: at its null value it has no
effect."""
FURTHER: tuple[Factory, ...] = (*thermal.FURTHER, *heat.FURTHER, *moisture.FURTHER, *sensors.FURTHER)
"""Further mechanisms that may act on a cabinet.  Each is nested: at its null values it has no effect."""
WANDERING: tuple[Factory, ...] = wandering.WANDERING
"""Properties of the cabinet as states, for tracking."""
LIBRARY: dict[str, Factory] = {
    factory.__name__: factory for factory in (*BASE, *LOGGED, *FURTHER, *WANDERING)
}
"""Factories by mechanism name; `LIBRARY[m.name](**m.settings)` creates the mechanism m again."""
