"""Variants of the causes that leave the cabinet alone and spoil what is known of it: sensors, clocks,
ambient."""

from __future__ import annotations

import numpy as np

from hygrokf.discovery.baseline import HYGRIC, THERMAL, Baseline
from hygrokf.discovery.cause import Variant, additions_of
from hygrokf.discovery.clocks import Shift, sources, turns_within
from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.grids import Probe, best_date, inside, span
from hygrokf.discovery.scan import abrupt
from hygrokf.identification.forms import LONGEST_RESPONSE_H, UNSTATED


def temperature_offset(baseline: Baseline) -> list[Variant]:
    found = []
    if THERMAL in baseline.parts:
        probe = Probe(THERMAL, ("temperature_step", {}), "temperature_offset")
        setting, tried = best_date(baseline, "after_step", [probe], abrupt(baseline.parts[THERMAL]))
        # a humidity sensor has a temperature of its own: only what the hygric part is told moves
        told = {HYGRIC: {"measured_air": {"step": True}}} if HYGRIC in baseline.parts else {}
        found.append(
            Variant(
                "temperature_sensor_offset", "from a date on", {THERMAL: (("temperature_step", {}),)},
                {"after_step": setting}, settings=setting, searched=tried, altered=told,
            )
        )  # fmt: skip
    if HYGRIC in baseline.parts:
        found.append(
            Variant(
                "temperature_sensor_offset", "constant", {HYGRIC: (("thermometer_offset", {}),)},
                starts=({}, {"thermometer_offset": 1.0}, {"thermometer_offset": -1.0}),
            )
        )  # fmt: skip
    return found


SOUND = 0.25
"""Share of the readings that a ceiling leaves alone at least; a sensor that follows nothing is no sensor with
a ceiling."""


def humidity_drift(baseline: Baseline) -> list[Variant]:
    if HYGRIC not in baseline.parts or "cabinet_relative_humidity" not in baseline.record:
        return []
    lowest, *levels = np.quantile(inside(baseline, "cabinet_relative_humidity"), (SOUND, 0.5, 0.8, 0.95))
    sticks = tuple({"humidity_lost": 0.5, "humidity_ceiling": float(a)} for a in levels)
    forms: tuple[tuple[str, str, Settings, Settings, tuple[Settings, ...]], ...] = (
        ("drift", "humidity_drift", {}, {"elapsed": span(baseline)}, ({},)),
        ("scale that goes off", "humidity_scale", {}, {"elapsed": span(baseline)}, ({},)),
        ("scale", "humidity_scale", {"flag": None}, {}, ({},)),
        ("ceiling", "humidity_ceiling", {"lowest": float(np.clip(lowest, 0.2, 0.95))}, {}, sticks),
    )
    return [
        Variant(
            "humidity_sensor_drift", form, {HYGRIC: ((mechanism, settings),)}, features, starts,
            searched=len(forms)
        )
        for form, mechanism, settings, features, starts in forms
    ]  # fmt: skip


def response(baseline: Baseline) -> list[Variant]:
    """A humidity sensor that follows slowly: the temperature beside it tells its delay from a slow exchange
    of air.

    Where the fit has estimated the response already, nothing is left to find.
    """
    if HYGRIC not in baseline.parts:
        return []
    sensors = dict(baseline.parts[HYGRIC].base.mechanisms)
    return [
        Variant(
            "sensor_response", "humidity",
            altered={HYGRIC: {sensor: {"longest_response_h": LONGEST_RESPONSE_H}}},
            starts=({f"{signal}_response": 0.1},),
        )
        for signal, sensor in UNSTATED.items()
        if sensor in sensors and sensors[sensor].get("longest_response_h") is None
    ]  # fmt: skip


def breathed(baseline: Baseline) -> list[Variant]:
    """Offsets of the ambient's sensors, a lag of the breathed air, and a series that was smoothed."""
    found = []
    forms = ("vapour", "temperature", "humidity")
    if HYGRIC in baseline.parts:
        found += [
            Variant("ambient_bias", form, {HYGRIC: (("breathed_air", {"form": form}),)}, searched=len(forms))
            for form in forms
        ]
    lag = {
        "ambient_lag_share": 0.5,
        "ambient_lag_time": 3.0,
        "breathed_lag_share": 0.5,
        "breathed_lag_time": 3.0,
    }
    both = additions_of(baseline, thermal=(("lagged_ambient", {}),), hygric=(("breathed_lag", {}),))
    found += [
        Variant("ambient_bias", f"the {part} air lags", {part: pairs}, starts=({}, lag), searched=3)
        for part, pairs in both.items()
    ]
    leads = additions_of(baseline, thermal=(("leading_ambient", {}),), hygric=(("breathed_lead", {}),))
    rates = {THERMAL: "ambient_temperature_rate", HYGRIC: "ambient_vapour_rate"}
    # beside a smoothed series the base's own time constants shrink to nothing: one start has them as usual
    usual = {"ambient_lead": 0.8, "breathed_lead": 0.8, "thermal_time_constant": 1.5, "hygric_k": 0.3}
    found.append(
        Variant(
            "ambient_bias", "smoothed series", leads, {rates[part]: {} for part in leads}, ({}, usual),
            searched=3
        )
    )  # fmt: skip
    return found


SHIFTS_MIN = (-60.0, -30.0, -10.0, 10.0, 30.0, 60.0)


def clock(baseline: Baseline) -> list[Variant]:
    told = ("cabinet_temperature", "ambient_temperature", "active_power")
    clocks = sources(baseline.record)
    names = [name for name, signals in clocks.items() if set(told) & set(signals)]
    settings = {}
    if len(clocks) == 2:  # to move the one is to move the other the opposite way
        settings = {"relative_to": names[-1]} if len(names) == 2 else {}
        names = names[:1]
    found = [
        Variant("clock_shift", name, shift=Shift(name, 0.0), settings=settings, searched=4 * len(SHIFTS_MIN))
        for name in names
    ]
    if turns_within(baseline.record):
        found += [
            Variant(
                "clock_shift", f"{name}, in summer time", shift=Shift(name, 0.0, True), settings=settings,
                searched=2 * len(names),
            )
            for name in names
        ]  # fmt: skip
    return found
