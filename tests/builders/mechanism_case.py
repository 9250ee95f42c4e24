"""Any mechanism inside a joint model, with inputs, readings and values."""

from __future__ import annotations

import numpy as np

from hygrokf.engine.timeline import Timeline, timeline
from hygrokf.physics.holds import LINEAR, MEAN, REGIME
from hygrokf.physics.mechanisms import MECHANISMS
from hygrokf.physics.model import Mechanism, Model, compose

THERMAL = ("thermal_network", "heat_release", "heat_disturbance", "thermal_diffusion", "temperature_sensor")


HYGRIC = ("hygric_exchange", "vapour_disturbance", "hygric_diffusion", "humidity_sensor")


INSTEAD = {
    "measured_air": THERMAL,
    "absolute_humidity_sensor": ("humidity_sensor",),
}
"""Mechanisms of the joint base model that a mechanism stands in for."""


TIME = np.union1d(np.arange(0.0, 12.0, 0.25), np.arange(0.05, 12.0, 1.0 / 6.0))


POWER_UNKNOWN = "power_unknown"
HOLDS = {name: LINEAR for one in MECHANISMS.values() for name in one().inputs}
HOLDS |= dict.fromkeys(("operating", "preheating", "power_1", "power_2"), MEAN) | {POWER_UNKNOWN: REGIME}


def host(mechanism: Mechanism) -> Model:
    """The joint base model with the mechanism in it."""
    return compose([*others(mechanism, (*THERMAL, *HYGRIC)), mechanism], HOLDS)


def smallest_host(mechanism: Mechanism) -> Model:
    """The base model of the balance that the mechanism's module is about, with the mechanism in it: the
    thermal one, the hygric one on the measured air, or the joint one."""
    module = MECHANISMS[mechanism.name].__module__.rpartition(".")[2]
    if mechanism.name == "measured_air" or module in ("hygric", "moisture"):
        return compose([*others(mechanism, ("measured_air", *HYGRIC)), mechanism], HOLDS)
    if module in ("thermal", "heat"):
        return compose([*others(mechanism, THERMAL), mechanism], HOLDS)
    return host(mechanism)


def others(mechanism: Mechanism, names: tuple[str, ...]) -> list[Mechanism]:
    left_out = {mechanism.name, *INSTEAD.get(mechanism.name, ())}
    return [MECHANISMS[name]() for name in names if name not in left_out]


def some_inputs(model: Model, seed: int = 3) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    kelvin = 283.0 + 4.0 * np.sin(TIME / 4.0)
    operating = (TIME < 8.0).astype(float)
    known = {
        "ambient_temperature": kelvin,
        "cabinet_temperature": kelvin + 6.0 + 0.5 * np.sin(TIME),
        "ambient_absolute_humidity": 7.0 + np.cos(TIME / 5.0),
        "exchange_factor": kelvin**0.8 / 273.0**1.8,
        "operating": operating,
        "power_1": operating * (0.5 + 0.4 * np.sin(TIME)),
        "power_2": operating * (0.5 + 0.4 * np.sin(TIME)) ** 2,
        "preheating": ((TIME > 9) & (TIME < 10)).astype(float),
        POWER_UNKNOWN: ((TIME > 4) & (TIME < 6)).astype(float),
    }
    return {name: known.get(name, 1.0 + random.random(len(TIME))) for name in model.inputs}


def some_run(model: Model, seed: int = 3) -> Timeline:
    random = np.random.default_rng(seed)
    guess = {
        "cabinet_temperature": 289.0 + 3.0 * np.sin(TIME / 4.0),
        "cabinet_relative_humidity": 0.45 + 0.05 * np.cos(TIME / 5.0),
        "cabinet_absolute_humidity": 7.0 + np.cos(TIME / 5.0),
    }
    readings = {}
    for name in model.outputs:
        readings[name] = guess[name] * (1 + 0.002 * random.normal(size=len(TIME)))
        readings[name][random.random(len(TIME)) < 0.4] = np.nan
    return timeline(model, TIME, some_inputs(model), readings)


def some_values(model: Model) -> dict[str, float]:
    """Values away from the starts, where null values would hide a term."""
    random = np.random.default_rng(8)
    values = {}
    for p in model.parameters:
        span = 0.02 * (min(p.upper, p.start + 50.0) - max(p.lower, p.start - 50.0))
        away = p.start * 1.1 if p.positive else p.start + span * (0.5 + random.random())
        values[p.name] = min(max(away, p.lower), p.upper)
    return values
