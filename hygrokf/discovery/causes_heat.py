"""Variants of the causes that act on the cabinet's heat, or on heat and air exchange together."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hygrokf.data.ambient import at_times
from hygrokf.data.input_paths import input_path
from hygrokf.discovery.baseline import Baseline
from hygrokf.discovery.cause import Additions, MechanismSettings, Variant, additions_of, at_setting
from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.grids import SETTLING_DAYS, best_date, best_hours, best_switch, readings_of, span
from hygrokf.discovery.scan import Probe, local_scan, scan
from hygrokf.discovery.submodel import HYGRIC, THERMAL
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
