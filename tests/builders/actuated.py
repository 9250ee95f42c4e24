"""Plants with actuators whose course is logged: heater, fan, dehumidifier and door, as 10-minute means."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from plants.as_record import to_record
from plants.hidden import HIDDEN_OPTIONS, finish, make_scene
from plants.plant import ingredients, plant
from plants.scene import Change, Scene, states

from hygrokf.data.record import Record, Series

STEP_MIN = 10
HEATER_W = 300.0
FAN_EXCHANGE = 2.0
FAN_CONDUCTANCE = 0.4
DRYING_A_HOUR = 0.6
DOOR_EXCHANGE = 30.0
DOOR_CONDUCTANCE = 0.5


def _thermostat(scene: Scene) -> np.ndarray:
    """1 in minutes in which the plain cabinet is cold, with 2 K of hysteresis: on a fifth of the time."""
    kelvin = scene.trajectory.cabinet_K
    on_below = float(np.quantile(kelvin, 0.2))
    course, on = np.zeros(len(kelvin)), False
    for i, value in enumerate(kelvin):
        on = value < on_below if not on else value < on_below + 2.0
        course[i] = on
    return course


def courses(scene: Scene) -> dict[str, np.ndarray]:
    """Duty (T,) of every actuator at minutes."""
    minute = np.arange(len(scene.trajectory.cabinet_K))
    random = np.random.default_rng(7)
    door = np.zeros(len(minute))
    for start in random.integers(0, len(minute) - 90, 12):
        door[start : start + 60] = 1.0
    blocks = random.random(len(minute) // 360 + 1)
    return {
        "heater_duty": _thermostat(scene),
        "fan_duty": np.where(
            scene.trajectory.cabinet_K > np.quantile(scene.trajectory.cabinet_K, 0.7), 1.0, 0.0
        ),
        "dehumidifier_duty": np.repeat(np.where(blocks > 0.7, 1.0, 0.0), 360)[: len(minute)],
        "door_open": door,
    }


def change(scene: Scene, signal: str, duty: np.ndarray) -> Change:
    """What an actuator does to the balances."""
    held = 0.5 * (duty[:-1] + duty[1:])
    outer_W_K = 1.0 / scene.cabinet.outer_resistance
    if signal == "heater_duty":
        return Change(heat_W=HEATER_W * held)
    if signal == "fan_duty":
        return Change(exchange=1.0 + FAN_EXCHANGE * held, conductance_W_K=FAN_CONDUCTANCE * outer_W_K * held)
    if signal == "door_open":
        return Change(
            exchange=1.0 + DOOR_EXCHANGE * held, conductance_W_K=DOOR_CONDUCTANCE * outer_W_K * held
        )
    vapour = scene.trajectory.cabinet_kg_m3[:-1]
    return Change(vapour_kg_s=-DRYING_A_HOUR / 3600.0 * scene.cabinet.volume * vapour * held)


def actuated(seed: int, *signals: str, days: float = 90.0) -> tuple[Record, dict[str, np.ndarray], object]:
    """(record with the actuators' 10-minute means, their duty at minutes, the plant)."""
    kept: dict[str, np.ndarray] = {}

    def build(name, seed, drivers, logging, **options):
        made = ingredients(seed, drivers, **options)
        scene = make_scene(made, seed, drivers)
        kept.update({signal: courses(scene)[signal] for signal in signals})
        found = [change(scene, signal, duty) for signal, duty in kept.items()]
        moved = replace(scene, trajectory=states(scene, found)[0])
        return finish(name, seed, made, moved, logging, [])

    made = plant(seed, days=days, build=build, **HIDDEN_OPTIONS)
    record = to_record(made)
    series = [_means(signal, duty, made.drivers.time) for signal, duty in kept.items()]
    until = record.start_s + 0.7 * (record.end_s - record.start_s)
    return replace(record, series=(*record.series, *series), until_s=until), kept, made


def _means(signal: str, duty: np.ndarray, time: np.ndarray) -> Series:
    """Means over ten minutes, stamped at their ends."""
    count = (len(duty) - 1) // STEP_MIN
    held = 0.5 * (duty[:-1] + duty[1:])
    return Series(
        signal,
        time[STEP_MIN::STEP_MIN][:count],
        held[: count * STEP_MIN].reshape(count, STEP_MIN).mean(axis=1),
        hold="mean",
        interval_s=60.0 * STEP_MIN,
        source="actuators",
    )
