"""Variants of the causes that do not act on the cabinet but on its readings: sensors, clocks, ambient
series."""

from __future__ import annotations

import numpy as np

from hygrokf.data.clocks import Shift, sources, turns_within
from hygrokf.discovery.baseline import Baseline
from hygrokf.discovery.cause import MechanismSettings, Variant, additions_of, needs_humidity
from hygrokf.discovery.clocks import SHIFTS_MIN
from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.grids import best_date, readings_of, span
from hygrokf.discovery.scan import Probe, abrupt
from hygrokf.discovery.submodel import HYGRIC, THERMAL
from hygrokf.identification.forms import LONGEST_RESPONSE_H, UNSTATED

SOUND = 0.25
"""[1] share of the readings that a ceiling leaves alone at least: a sensor that follows nothing is no sensor
with a ceiling."""


def temperature_offset(baseline: Baseline) -> list[Variant]:
    step: MechanismSettings = ("temperature_step", {})
    probe = Probe(THERMAL, step, "temperature_offset")
    jumps = abrupt(baseline.submodels[THERMAL])
    setting, tried = best_date(baseline, "after_step", [probe], jumps)
    # a humidity sensor has a temperature of its own: only the input of the hygric submodel moves
    moved = {HYGRIC: {"measured_air": {"step": True}}} if HYGRIC in baseline.submodels else {}
    found = [
        Variant(
            "temperature_sensor_offset", "from a date on", {THERMAL: (step,)}, {"after_step": setting},
            settings=setting, searched=tried, altered=moved,
        )
    ]  # fmt: skip
    if HYGRIC in baseline.submodels:
        found.append(
            Variant(
                "temperature_sensor_offset", "constant", {HYGRIC: (("thermometer_offset", {}),)},
                starts=({}, {"thermometer_offset": 1.0}, {"thermometer_offset": -1.0}),
            )
        )  # fmt: skip
    return found


@needs_humidity
def humidity_drift(baseline: Baseline) -> list[Variant]:
    if "cabinet_relative_humidity" not in baseline.record:
        return []
    lowest, *levels = np.quantile(readings_of(baseline, "cabinet_relative_humidity"), (SOUND, 0.5, 0.8, 0.95))
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


@needs_humidity
def response(baseline: Baseline) -> list[Variant]:
    """A humidity sensor that follows slowly: the temperature sensor beside it distinguishes the delay from a
    slow exchange of air.

    None where the fit has estimated the response already.
    """
    sensors = dict(baseline.submodels[HYGRIC].base.mechanisms)
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
    if HYGRIC in baseline.submodels:
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
    both = additions_of(baseline, ("lagged_ambient", {}), ("breathed_lag", {}))
    found += [
        Variant("ambient_bias", f"the {name} air lags", {name: pairs}, starts=({}, lag), searched=3)
        for name, pairs in both.items()
    ]
    leads = additions_of(baseline, ("leading_ambient", {}), ("breathed_lead", {}))
    rates = {THERMAL: "ambient_temperature_rate", HYGRIC: "ambient_vapour_rate"}
    # beside a smoothed series the base's own time constants shrink towards 0: one start has usual ones
    usual = {"ambient_lead": 0.8, "breathed_lead": 0.8, "thermal_time_constant": 1.5, "hygric_k": 0.3}
    found.append(
        Variant(
            "ambient_bias", "smoothed series", leads, {rates[name]: {} for name in leads}, ({}, usual),
            searched=3
        )
    )  # fmt: skip
    return found


def clock(baseline: Baseline) -> list[Variant]:
    main = {"cabinet_temperature", "ambient_temperature", "active_power"}
    clocks = sources(baseline.record)
    names = [name for name, signals in clocks.items() if main & set(signals)]
    settings = {}
    if len(clocks) == 2:  # moving one is moving the other the opposite way
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
