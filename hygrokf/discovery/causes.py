"""Variants of the causes: of heat and air exchange, of moisture, and of the readings (sensors, clocks,
ambient series), which do not act on the cabinet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hygrokf.data.ambient import at_times
from hygrokf.data.clocks import Shift, sources, turns_within
from hygrokf.data.input_paths import input_path
from hygrokf.discovery.baseline import Baseline
from hygrokf.discovery.cause import (
    Additions,
    MechanismSettings,
    Variant,
    additions_of,
    at_setting,
    needs_humidity,
)
from hygrokf.discovery.clocks import SHIFTS_MIN
from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.grids import SETTLING_DAYS, best_date, best_hours, best_switch, readings_of, span
from hygrokf.discovery.scan import Probe, abrupt, local_scan, scan
from hygrokf.discovery.submodel import HYGRIC, THERMAL
from hygrokf.identification.forms import LONGEST_RESPONSE_H, UNSTATED
from hygrokf.modelling.derived_inputs import operating

RAMP_DAYS = 8.0
FEWEST_IDLE = 200
"""Readings at standstill from which a heater of the standstill is looked for."""
STEPS = {"cabinet_temperature": 1.5, "cabinet_relative_humidity": 0.05}
"""Distances [K], [1] by which the set-points of controllers are refined."""
AZIMUTHS = (90.0, 135.0, 180.0, 225.0, 270.0)


def wall(baseline: Baseline) -> list[Variant]:
    starts = tuple({"wall_conductance": 0.02, "wall_time_constant": h} for h in (3.0, 20.0))
    mechanism: MechanismSettings = ("wall_thermal_mass", {})
    return [Variant("wall_thermal_mass", "wall_thermal_mass", {THERMAL: (mechanism,)}, starts=starts)]


def exchange_step(baseline: Baseline) -> list[Variant]:
    probes = (
        Probe(HYGRIC, ("stepped_exchange", {}), "exchange_change"),
        Probe(THERMAL, ("stepped_loss", {}), "conductance_change"),
    )
    found = []
    for form, days in (("step", 0.0), ("ramp", RAMP_DAYS)):
        setting, tried = best_date(baseline, "after_step", probes, days=(days,))
        for flows in (False, True) if HYGRIC in baseline.submodels else (False,):
            additions = additions_of(baseline, ("stepped_loss", {}), ("stepped_exchange", {"flows": flows}))
            name, number = (f"{form}, vapour flows as before", 3) if flows else (form, 2)
            found.append(
                at_setting("exchange_step", name, additions, "after_step", (setting, number * tried))
            )
    return found


def cooling(baseline: Baseline) -> list[Variant]:
    return [*_stage(baseline), *_vents(baseline)]


def _stage(baseline: Baseline) -> list[Variant]:
    """A stage with two set-points, in a closed cabinet or with exchange of air."""
    levels = np.quantile(readings_of(baseline, "cabinet_temperature"), np.linspace(0.4, 0.97, 10))
    grid = [{"on_K": float(a), "off_K": float(a - width)} for a in levels for width in (1.0, 3.0, 6.0)]
    loss: MechanismSettings = ("cooling_loss", {})
    probe = Probe(THERMAL, loss, "cooling_conductance")
    found = best_switch(baseline, "cooling", [probe], grid, STEPS)
    if found is None:
        return []
    forms: list[tuple[str, Additions, bool]] = [("closed", {THERMAL: (loss,)}, False)]
    if HYGRIC in baseline.submodels:
        forms.append(("filter fan", additions_of(baseline, loss, ("cooled_exchange", {})), True))
    starts = ({"cooling_conductance": 0.05}, {"cooling_conductance": 0.5})
    return [
        at_setting("cooling_switching", form, additions, "cooling", found, starts, joint)
        for form, additions, joint in forms
    ]


def _vents(baseline: Baseline) -> list[Variant]:
    """A vent that opens in proportion to the temperature or the humidity in the cabinet, and a vent that is
    open in the same hours of every day or of every workday."""
    variants = []
    for feature, settings in (("venting", {}), ("open_hours", {"flag": "open_hours"})):
        loss, exchange = ("vent_loss", settings), ("vent_exchange", settings)
        probes = (Probe(THERMAL, loss, "vent_conductance"), Probe(HYGRIC, exchange, "vent_exchange"))
        if feature == "venting":
            found = best_switch(baseline, feature, probes, list(_bands(baseline)), STEPS)
        else:
            found = best_hours(baseline, probes, feature)
        if found is None:
            continue
        form = f"vent, opens with {found[0]['reads']}" if feature == "venting" else "vent, by the clock"
        additions = additions_of(baseline, loss, exchange)
        starts = tuple({"vent_conductance": g, "vent_exchange": 5.0 * g} for g in (0.1, 1.0))
        variants.append(
            at_setting("cooling_switching", form, additions, feature, found, starts, len(additions) > 1)
        )
    return variants


def _bands(baseline: Baseline, falling: bool = False) -> Iterator[Settings]:
    """Bands in which a controller opens: upward with temperature or humidity; `falling`: downward with the
    temperature."""
    names = ("cabinet_temperature",) if falling else tuple(STEPS)
    for name in names:
        if name in baseline.record:
            for start in np.quantile(readings_of(baseline, name), (0.1, 0.3, 0.5, 0.7, 0.85, 0.95)):
                for width in (1.5 * STEPS[name], 4.0 * STEPS[name]):
                    full = start - width if falling else start + width
                    yield {"reads": name, "start": float(start), "full": float(full)}


def heater(baseline: Baseline) -> list[Variant]:
    grids: list[tuple[str, list[Settings], str]] = [
        ("heating", [{**one, "idle": False} for one in _set_points(baseline)], "in any state, {reads}"),
        ("throttled_heating", list(_bands(baseline, falling=True)), "in any state, in proportion"),
    ]
    if "active_power" in baseline.record:
        series = baseline.record["cabinet_temperature"]
        idle = ~operating(baseline.record, series.time) & np.isfinite(series.value)
        if idle.sum() >= FEWEST_IDLE:
            grids.append(("heating", _set_points(baseline, idle), "at standstill, {reads}"))
    variants = []
    for feature, grid, form in grids:
        mechanism = ("unreported_heater", {"flag": feature})
        found = best_switch(baseline, feature, [Probe(THERMAL, mechanism, "heater_heat")], grid, STEPS)
        if found is not None:
            variants.append(
                at_setting(
                    "unlogged_heater", form.format(**found[0]), {THERMAL: (mechanism,)}, feature, found,
                    ({"heater_heat": 1.0}, {"heater_heat": 8.0}),
                )
            )  # fmt: skip
    return variants


def _set_points(baseline: Baseline, there: np.ndarray | None = None) -> list[Settings]:
    """Set-points of a thermostat or humidistat among the readings `there` (all)."""
    series = baseline.record["cabinet_temperature"]
    there = np.isfinite(series.value) if there is None else there
    levels = np.quantile(series.value[there], np.linspace(0.05, 0.8, 9))
    grid: list[Settings] = [
        {"reads": "cabinet_temperature", "on": float(a), "off": float(a + width)}
        for a in levels
        for width in (1.0, 3.0, 6.0)
    ]
    if "cabinet_relative_humidity" in baseline.record:
        damp = at_times(input_path(baseline.record["cabinet_relative_humidity"]), series.time[there], 2.0)
        levels = np.nanquantile(damp, np.linspace(0.3, 0.95, 8))
        grid += [
            {"reads": "cabinet_relative_humidity", "on": float(a), "off": float(a - width)}
            for a in levels
            for width in (0.03, 0.08, 0.15)
        ]
    return grid


def by_the_clock(baseline: Baseline) -> list[Variant]:
    mechanism: MechanismSettings = ("scheduled_heat", {})
    found = best_hours(baseline, [Probe(THERMAL, mechanism, "scheduled_heat")], "scheduled")
    form = "on workdays" if found[0]["workdays"] else "every day"
    additions, starts = {THERMAL: (mechanism,)}, ({"scheduled_heat": 1.0},)
    return [at_setting("scheduled_heat", form, additions, "scheduled", found, starts)]


def wind(baseline: Baseline) -> list[Variant]:
    if "wind_speed" not in baseline.record:
        return []
    found = []
    for form, flag in (("linear", "wind_tenth"), ("square", "wind_square")):
        additions = additions_of(baseline, ("wind_loss", {"flag": flag}), ("wind_exchange", {"flag": flag}))
        found.append(Variant("wind_driven_exchange", form, additions, {flag: {}}, searched=2))
    return found


def sun(baseline: Baseline) -> list[Variant]:
    if "global_horizontal_irradiance" not in baseline.record and baseline.record.site is None:
        return []
    roof = ("solar_gain", {"lagged": True})
    starts = tuple({"solar_heat": 0.2, "solar_time": h} for h in (0.5, 3.0))
    found = [
        Variant(
            "solar_gain", "on the roof", {THERMAL: (roof,)}, {"sunshine": {}}, starts,
            searched=1 + len(AZIMUTHS),
        )
    ]  # fmt: skip
    if baseline.record.site is not None:
        wall = ("solar_gain", {"lagged": True, "flag": "sunlit_wall"})
        settings = [{"azimuth_deg": a} for a in AZIMUTHS]
        probe = Probe(THERMAL, wall, "solar_heat", {"solar_heat": 1e-3, "solar_time": 1.5})
        scanned = scan(baseline.submodels[THERMAL], probe, "sunlit_wall", settings)
        best = settings[int(np.argmax(scanned.root))], 1.0 + scanned.effective
        found.append(at_setting("solar_gain", "on a wall", {THERMAL: (wall,)}, "sunlit_wall", best, starts))
    return found


def heat_drift(baseline: Baseline) -> list[Variant]:
    base = dict(baseline.submodels[THERMAL].base.mechanisms)["heat_release"]
    own = {"order": base["order"], "operation": True} if base["operation"] else {}
    straight, late = ("release_drift", own), ("release_drift", {**own, "flag": "since"})
    found = best_date(baseline, "since", [Probe(THERMAL, late, "heat_drift")], days=SETTLING_DAYS)
    return [
        Variant("heat_release_drift", "straight", {THERMAL: (straight,)}, {"elapsed": span(baseline)}),
        at_setting(
            "heat_release_drift", "from a date on, saturating", {THERMAL: (late,)}, "since", found
        ),
    ]  # fmt: skip


def door(baseline: Baseline) -> list[Variant]:
    """Windows in which the innovations of both submodels ask for a much larger exchange, by a matched filter
    with a price for each.

    None where the base model has a logged door.
    """
    if any("door_open" in submodel.base.model.inputs for submodel in baseline.submodels.values()):
        return []
    loss: MechanismSettings = ("open_loss", {})
    exchange: MechanismSettings = ("open_exchange", {})
    probes = Probe(HYGRIC, exchange, "door_exchange"), Probe(THERMAL, loss, "door_conductance")
    spans = local_scan(baseline.submodels, probes, "door_open")
    if not spans:
        return []
    return [
        at_setting(
            "door_opening", f"{len(spans)} openings", additions_of(baseline, loss, exchange), "door_open",
            ({"spans": spans}, 200 * len(spans)), ({"door_exchange": 3.0, "door_conductance": 0.1},),
        )
    ]  # fmt: skip


HEAVY_MM_H = 1.0
"""[mm/h] of rain that counts as heavy."""
USUAL_EXCHANGE_H = 3.0
"""[h] time constant of the vapour exchange beyond which films and driers are looked for at lower rates."""


@needs_humidity
def sorption(baseline: Baseline) -> list[Variant]:
    found = []
    for uptake, activated in (("uptake faster when warm", True), ("uptake alike at all temperatures", False)):
        thin, slab = (
            Variant(
                "moisture_sorption", f"{material}, {uptake}",
                {HYGRIC: (("moisture_sorption", {"activated": activated, "slab": material == "slab"}),)},
                searched=4,
            )
            for material in ("thin", "slab")
        )  # fmt: skip
        starts = tuple({"sorption_capacity": 0.5, "sorption_time": time} for time in (3.0, 15.0, 60.0))
        # in its first hours a slab takes up water like thin material with a fifth of its capacity and a
        # shorter time constant
        slab = replace(slab, scaled={"sorption_capacity": 5.0, "sorption_time": 18.0})
        found.append(replace(thin, starts=starts, finer=slab))
    return found


def _pace(baseline: Baseline) -> float:
    """Factor of the start rates: in a tight cabinet, whose own exchange is slow, slow rates matter."""
    return min(1.0, USUAL_EXCHANGE_H / baseline.submodels[HYGRIC].values["hygric_k"])


@needs_humidity
def condensation(baseline: Baseline) -> list[Variant]:
    pace = _pace(baseline)

    def starts(*undercooling: float) -> tuple[Settings, ...]:
        # with a film that is there or not, the likelihood has many maxima
        return tuple(
            {
                "condensation_rate": rate * pace,
                "surface_time": time,
                "surface_share": 0.03,
                "surface_undercooling": below,
            }
            for rate in (0.2, 0.7, 2.5)
            for time in (1.0, 4.0, 9.0, 20.0)
            for below in undercooling
        )

    forms = [("heavy surface", False, starts(0.3, 1.0))]
    if baseline.record.site is not None:
        forms.append(("skin under the night sky", True, starts(1.5, 4.0)))
    return [
        Variant(
            "condensation", form, {HYGRIC: (("condensation", {"sky": sky}),)},
            {"night_sky": {}} if sky else {},
            starts=first, searched=len(forms),
        )
        for form, sky, first in forms
    ]  # fmt: skip


@needs_humidity
def rain(baseline: Baseline) -> list[Variant]:
    if "rain" not in baseline.record:
        return []
    series = baseline.record["rain"]
    step_s = series.interval_s if series.interval_s > 0 else float(np.median(np.diff(series.time)))
    above = HEAVY_MM_H * step_s / 3600.0
    starts = tuple({"rain_intake": 0.5, "rain_drying_time": t} for t in (2.0, 12.0))
    return [
        Variant(
            "rain_ingress", form, {HYGRIC: (("rain_ingress", {"flag": flag}),)}, features, starts, settings, 2
        )
        for form, flag, features, settings in (
            ("all rain", "rain", {}, {}),
            ("heavy rain", "heavy_rain", {"heavy_rain": {"above": above}}, {"above": above}),
        )
    ]  # fmt: skip


@needs_humidity
def source(baseline: Baseline) -> list[Variant]:
    start = ({"moisture_source": 0.02}, {"moisture_source": 0.3}, {"moisture_source": 2.0})

    def variant(form: str, when: str, setting: Settings | None = None, searched: float = 3.0) -> Variant:
        features = {} if when == "always" else {when: setting or {}}
        additions = {HYGRIC: (("internal_moisture_source", {"when": when}),)}
        return Variant("internal_moisture_source", form, additions, features, start, setting or {}, searched)

    rates = tuple({"evaporation_rate": rate * _pace(baseline)} for rate in (0.02, 0.2, 2.0))
    found = [
        variant("always", "always"),
        Variant(
            "internal_moisture_source", "from a wet surface", {HYGRIC: (("wet_surface", {}),)}, starts=rates,
            searched=3,
        ),
    ]  # fmt: skip
    if "active_power" in baseline.record:
        found.append(variant("at standstill", "standstill"))

    def probe(when: str) -> list[Probe]:
        mechanism = ("internal_moisture_source", {"when": when})
        return [Probe(HYGRIC, mechanism, "moisture_source", {"moisture_source": 1e-4})]

    # where the air is exchanged fast, vapour jumps when the source begins: with a date that is an hour off
    # nothing is gained
    jumps = abrupt(baseline.submodels[HYGRIC])
    date = best_date(baseline, "fading", probe("fading"), jumps, days=SETTLING_DAYS, sudden=True)
    found.append(variant("drying out from a date on", "fading", *date))
    hours = best_hours(baseline, probe("scheduled"), "scheduled")
    form = "by the clock, on workdays" if hours[0]["workdays"] else "by the clock, every day"
    found.append(variant(form, "scheduled", *hours))
    return found


@needs_humidity
def drier(baseline: Baseline) -> list[Variant]:
    if "cabinet_relative_humidity" not in baseline.record:
        return []
    levels = np.quantile(readings_of(baseline, "cabinet_relative_humidity"), np.linspace(0.3, 0.95, 9))
    starts = tuple(
        {"dehumidifier_rate": _pace(baseline), "dehumidifier_setpoint": float(a)} for a in levels[[1, 4, 7]]
    )
    found = [Variant("dehumidifier", "proportional", {HYGRIC: (("dehumidifier", {}),)}, starts=starts)]
    grid = [{"on": float(a), "off": float(a - width)} for a in levels for width in (0.03, 0.08)]
    # the rate is positive and estimated as a logarithm: its slope at a small value stands for that at zero
    probe = Probe(HYGRIC, ("switched_drying", {}), "drying_rate", {"drying_rate": 1e-4})
    switched = best_switch(baseline, "drying", [probe], grid, {"": 0.02})
    if switched is None:
        return found
    for form, plate, heats in (
        ("two-point, cold plate", True, False),
        ("two-point, desiccant", False, False),
        ("two-point, cold plate, heats the air", True, True),
    ):
        additions = {HYGRIC: (("switched_drying", {"plate": plate}),)}
        if heats:
            additions[THERMAL] = (("drying_heat", {}),)
        rates = ({"drying_rate": 0.02}, {"drying_rate": 0.2})
        found.append(at_setting("dehumidifier", form, additions, "drying", switched, rates, joint=heats))
    return found


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
