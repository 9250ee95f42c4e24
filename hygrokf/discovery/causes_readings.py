"""Variants of the causes that leave the cabinet alone and spoil what is known of it: sensors, clocks, ambient."""

from __future__ import annotations

import numpy as np

from hygrokf.discovery.cause import Variant
from hygrokf.discovery.clocks import Shift, sources, turns_within
from hygrokf.discovery.grids import Probe, best_date, inside, span
from hygrokf.discovery.scan import abrupt
from hygrokf.discovery.scene import HYGRIC, THERMAL, Scene


def temperature_offset(scene: Scene) -> list[Variant]:
    found = []
    if THERMAL in scene.parts:
        probe = Probe(THERMAL, ("temperature_step", {}), "temperature_offset")
        setting, tried = best_date(scene, "after_step", [probe], abrupt(scene.parts[THERMAL]))
        # a humidity sensor has a temperature of its own: only what the hygric part is told moves
        told = {HYGRIC: {"measured_air": {"step": True}}} if HYGRIC in scene.parts else {}
        found.append(
            Variant(
                "temperature_sensor_offset", "from a date on", {THERMAL: (("temperature_step", {}),)},
                {"after_step": setting}, settings=setting, searched=tried, altered=told,
            )
        )  # fmt: skip
    if HYGRIC in scene.parts:
        found.append(
            Variant(
                "temperature_sensor_offset", "constant", altered={HYGRIC: {"measured_air": {"accuracy": 8.0}}},
                starts=({}, {"cabinet_temperature_offset": 1.0}, {"cabinet_temperature_offset": -1.0}),
            )
        )  # fmt: skip
    return found


def humidity_drift(scene: Scene) -> list[Variant]:
    if HYGRIC not in scene.parts or "cabinet_relative_humidity" not in scene.record:
        return []
    levels = np.quantile(inside(scene, "cabinet_relative_humidity"), (0.5, 0.8, 0.95))
    sticks = tuple({"humidity_lost": 0.5, "humidity_ceiling": float(a)} for a in levels)
    forms = (
        ("drift", "humidity_drift", {}, {"elapsed": span(scene)}, ({},)),
        ("scale that goes off", "humidity_scale", {}, {"elapsed": span(scene)}, ({},)),
        ("scale", "humidity_scale", {"flag": None}, {}, ({},)),
        ("ceiling", "humidity_ceiling", {}, {}, sticks),
    )
    return [
        Variant(
            "humidity_sensor_drift", form, {HYGRIC: ((mechanism, settings),)}, features, starts, searched=len(forms)
        )
        for form, mechanism, settings, features, starts in forms
    ]  # fmt: skip


def breathed(scene: Scene) -> list[Variant]:
    forms = ("vapour", "temperature", "humidity")
    shares = (
        {},
        *({"lag_share": share, "lag_time": time} for share, time in ((-1.0, 0.5), (-0.5, 3.0), (0.5, 3.0))),
    )

    def lags(*prefixes: str) -> tuple[dict, ...]:
        return tuple(
            {f"{prefix}_{key}": v for prefix in prefixes for key, v in one.items()} for one in shares
        )

    found = []
    if HYGRIC in scene.parts:
        for form in forms:
            found.append(
                Variant(
                    "ambient_bias", form, {HYGRIC: (("breathed_air", {"form": form}),)}, starts=lags("breathed"),
                    searched=len(forms),
                )
            )  # fmt: skip
    if THERMAL in scene.parts:
        thermal = (("lagged_ambient", {}),)
        found.append(
            Variant(
                "ambient_bias",
                "lag of the temperature",
                {THERMAL: thermal},
                starts=lags("ambient"),
                searched=4,
            )
        )
        if HYGRIC in scene.parts:
            both = {THERMAL: thermal, HYGRIC: (("breathed_air", {}),)}
            found.append(
                Variant("ambient_bias", "lag of both", both, starts=lags("ambient", "breathed"), searched=4)
            )
    return found


SHIFTS_MIN = (-60.0, -30.0, -10.0, 10.0, 30.0, 60.0)


def clock(scene: Scene) -> list[Variant]:
    told = ("cabinet_temperature", "ambient_temperature", "active_power")
    names = [name for name, signals in sources(scene.record).items() if set(told) & set(signals)]
    found = [
        Variant("clock_shift", name, shift=Shift(name, 0.0), searched=4 * len(SHIFTS_MIN)) for name in names
    ]
    if turns_within(scene.record):
        found += [
            Variant(
                "clock_shift",
                f"{name}, in summer time",
                shift=Shift(name, 0.0, True),
                searched=2 * len(names),
            )
            for name in names
        ]
    return found
