"""Variants of the causes that act on the cabinet's heat, or on heat and air exchange together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hygrokf.data.ambient import at_times
from hygrokf.data.input_paths import input_path
from hygrokf.discovery.baseline import HYGRIC, THERMAL, Baseline
from hygrokf.discovery.cause import Variant, additions_of
from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.grids import Probe, best_date, best_hours, best_switch, inside, span
from hygrokf.discovery.scan import local_scan, scan
from hygrokf.modelling.derived_inputs import operating

RAMP_DAYS = 8.0
SETTLING_DAYS = (8.0, 20.0, 50.0)
FEWEST_IDLE = 200
"""Readings at standstill from which a heater of the standstill is looked for."""


def exchange_step(baseline: Baseline) -> list[Variant]:
    probes = (
        Probe(HYGRIC, ("stepped_exchange", {}), "exchange_change"),
        Probe(THERMAL, ("stepped_loss", {}), "conductance_change"),
    )
    found = []
    for form, days in (("step", 0.0), ("ramp", RAMP_DAYS)):
        setting, tried = best_date(baseline, "after_step", probes, days=(days,))
        for flows in (False, True) if HYGRIC in baseline.parts else (False,):
            additions = additions_of(
                baseline, thermal=(("stepped_loss", {}),), hygric=(("stepped_exchange", {"flows": flows}),)
            )
            found.append(
                Variant(
                    "exchange_step",
                    f"{form}, vapour flows as before" if flows else form,
                    additions,
                    {"after_step": setting},
                    settings=setting,
                    searched=3 * tried if flows else 2 * tried,
                )
            )
    return found


STEPS = {"cabinet_temperature": 1.5, "cabinet_relative_humidity": 0.05}
"""Distances [K], [1] by which the set-points of controllers are refined."""


def cooling(baseline: Baseline) -> list[Variant]:
    if THERMAL not in baseline.parts:
        return []
    found = _stage(baseline)
    vent = _vent(baseline)
    return [*found, *([] if vent is None else [vent]), _timed_vent(baseline)]


def _stage(baseline: Baseline) -> list[Variant]:
    """A stage with two set-points, in a closed cabinet or with exchange of air."""
    levels = np.quantile(inside(baseline, "cabinet_temperature"), np.linspace(0.4, 0.97, 10))
    grid = [{"on_K": float(a), "off_K": float(a - width)} for a in levels for width in (1.0, 3.0, 6.0)]
    probe = Probe(THERMAL, ("cooling_loss", {}), "cooling_conductance")
    found = best_switch(baseline, "cooling", [probe], grid, STEPS)
    if found is None:
        return []
    chosen, tried = found
    closed = additions_of(baseline, thermal=(("cooling_loss", {}),))
    blown = additions_of(baseline, thermal=(("cooling_loss", {}),), hygric=(("cooled_exchange", {}),))
    forms = [("closed", closed)] + ([("filter fan", blown)] if HYGRIC in baseline.parts else [])
    return [
        Variant(
            "cooling_switching", form, additions, {"cooling": chosen},
            ({"cooling_conductance": 0.05}, {"cooling_conductance": 0.5}), chosen, tried,
            joint=form == "filter fan",
        )
        for form, additions in forms
    ]  # fmt: skip


def _vent(baseline: Baseline) -> Variant | None:
    """A vent that opens in proportion to the temperature or the humidity in the cabinet."""
    probes = (
        Probe(THERMAL, ("vent_loss", {}), "vent_conductance"),
        Probe(HYGRIC, ("vent_exchange", {}), "vent_exchange"),
    )
    found = best_switch(baseline, "venting", probes, list(_bands(baseline)), STEPS)
    if found is None:
        return None
    chosen, tried = found
    additions = additions_of(baseline, thermal=(("vent_loss", {}),), hygric=(("vent_exchange", {}),))
    starts = tuple({"vent_conductance": g, "vent_exchange": 5.0 * g} for g in (0.1, 1.0))
    return Variant(
        "cooling_switching", f"vent, opens with {chosen['reads']}", additions, {"venting": chosen}, starts,
        chosen, tried,
        joint=len(additions) > 1,
    )  # fmt: skip


def _timed_vent(baseline: Baseline) -> Variant:
    """A vent that is open in the same hours of every day, or of every workday."""
    by_clock = {"flag": "open_hours"}
    probes = (
        Probe(THERMAL, ("vent_loss", by_clock), "vent_conductance"),
        Probe(HYGRIC, ("vent_exchange", by_clock), "vent_exchange"),
    )
    setting, tried = best_hours(baseline, probes, "open_hours")
    additions = additions_of(
        baseline, thermal=(("vent_loss", by_clock),), hygric=(("vent_exchange", by_clock),)
    )
    starts = tuple({"vent_conductance": g, "vent_exchange": 5.0 * g} for g in (0.1, 1.0))
    return Variant(
        "cooling_switching", "vent, by the clock", additions, {"open_hours": setting}, starts, setting, tried,
        joint=len(additions) > 1,
    )  # fmt: skip


def _bands(baseline: Baseline, falling: bool = False) -> Iterator[Settings]:
    """Bands in which a controller opens: upward with temperature or humidity; `falling`: downward with the
    temperature."""
    names = ("cabinet_temperature",) if falling else tuple(STEPS)
    for name in names:
        if name in baseline.record:
            for start in np.quantile(inside(baseline, name), (0.1, 0.3, 0.5, 0.7, 0.85, 0.95)):
                for width in (1.5 * STEPS[name], 4.0 * STEPS[name]):
                    full = start - width if falling else start + width
                    yield {"reads": name, "start": float(start), "full": float(full)}


def heater(baseline: Baseline) -> list[Variant]:
    if THERMAL not in baseline.parts:
        return []
    forms = [
        _heater(baseline, "heating", [{**one, "idle": False} for one in _set_points(baseline)],
            "in any state, {reads}"),
        _heater(baseline, "throttled_heating", list(_bands(baseline, falling=True)),
            "in any state, in proportion"),
    ]  # fmt: skip
    if "active_power" in baseline.record:
        series = baseline.record["cabinet_temperature"]
        idle = ~operating(baseline.record, series.time) & np.isfinite(series.value)
        if idle.sum() >= FEWEST_IDLE:
            forms.append(_heater(baseline, "heating", _set_points(baseline, idle), "at standstill, {reads}"))
    return [one for one in forms if one is not None]


def _heater(baseline: Baseline, flag: str, grid: Sequence[Settings], form: str) -> Variant | None:
    mechanism = ("unreported_heater", {"flag": flag})
    found = best_switch(baseline, flag, [Probe(THERMAL, mechanism, "heater_heat")], grid, STEPS)
    if found is None:
        return None
    chosen, tried = found
    return Variant(
        "unlogged_heater", form.format(**chosen), {THERMAL: (mechanism,)}, {flag: chosen},
        ({"heater_heat": 1.0}, {"heater_heat": 8.0}), chosen, tried,
    )  # fmt: skip


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
    if THERMAL not in baseline.parts:
        return []
    setting, tried = best_hours(baseline, [Probe(THERMAL, ("scheduled_heat", {}), "scheduled_heat")])
    return [
        Variant(
            "scheduled_heat", "on workdays" if setting["workdays"] else "every day",
            {THERMAL: (("scheduled_heat", {}),)}, {"scheduled": setting}, ({"scheduled_heat": 1.0},), setting,
            tried,
        )
    ]  # fmt: skip


def wind(baseline: Baseline) -> list[Variant]:
    if "wind_speed" not in baseline.record:
        return []
    found = []
    for form, flag in (("linear", "wind_tenth"), ("square", "wind_square")):
        additions = additions_of(
            baseline, thermal=(("wind_loss", {"flag": flag}),), hygric=(("wind_exchange", {"flag": flag}),)
        )
        found.append(Variant("wind_driven_exchange", form, additions, {flag: {}}, searched=2))
    return found


AZIMUTHS = (90.0, 135.0, 180.0, 225.0, 270.0)


def sun(baseline: Baseline) -> list[Variant]:
    known = "global_horizontal_irradiance" in baseline.record or baseline.record.site is not None
    if not known or THERMAL not in baseline.parts:
        return []
    starts = tuple({"solar_heat": 0.2, "solar_time": h} for h in (0.5, 3.0))
    found = [
        Variant(
            "solar_gain", "on the roof", {THERMAL: (("solar_gain", {"lagged": True}),)}, {"sunshine": {}},
            starts,
            searched=1 + len(AZIMUTHS),
        )
    ]  # fmt: skip
    if baseline.record.site is not None:
        wall = ("solar_gain", {"lagged": True, "flag": "sunlit_wall"})
        settings = [{"azimuth_deg": a} for a in AZIMUTHS]
        nulls = {"solar_heat": 1e-3, "solar_time": 1.5}
        scanned = scan(baseline.parts[THERMAL], wall, "solar_heat", "sunlit_wall", settings, nulls)
        chosen = settings[int(np.argmax(scanned.root))]
        found.append(
            Variant(
                "solar_gain", "on a wall", {THERMAL: (wall,)}, {"sunlit_wall": chosen}, starts, chosen,
                1.0 + scanned.effective,
            )
        )  # fmt: skip
    return found


def heat_drift(baseline: Baseline) -> list[Variant]:
    if THERMAL not in baseline.parts:
        return []
    base = dict(baseline.parts[THERMAL].base.mechanisms)["heat_release"]
    own = {"order": base["order"], "operation": True} if base["operation"] else {}
    found = [
        Variant(
            "heat_release_drift",
            "straight",
            {THERMAL: (("release_drift", own),)},
            {"elapsed": span(baseline)},
        )
    ]
    late = {**own, "flag": "since"}
    probe = Probe(THERMAL, ("release_drift", late), "heat_drift")
    setting, tried = best_date(baseline, "since", [probe], days=SETTLING_DAYS)
    return [
        *found,
        Variant(
            "heat_release_drift", "from a date on, saturating", {THERMAL: (("release_drift", late),)},
            {"since": setting}, settings=setting, searched=tried,
        ),
    ]  # fmt: skip


def door(baseline: Baseline) -> list[Variant]:
    """Windows in which both parts' innovations ask for a much larger exchange, by a matched filter with a
    price for each.

    None where the base model has a logged door.
    """
    if any("door_open" in part.base.model.inputs for part in baseline.parts.values()):
        return []
    spans = local_scan(
        {
            name: (baseline.parts[name], mechanism, parameter)
            for name, mechanism, parameter in (
                (HYGRIC, "open_exchange", "door_exchange"),
                (THERMAL, "open_loss", "door_conductance"),
            )
            if name in baseline.parts
        },
        "door_open",
    )
    if not spans:
        return []
    additions = additions_of(baseline, thermal=(("open_loss", {}),), hygric=(("open_exchange", {}),))
    return [
        Variant(
            "door_opening", f"{len(spans)} openings", additions, {"door_open": {"spans": spans}},
            ({"door_exchange": 3.0, "door_conductance": 0.1},), {"spans": spans}, 200 * len(spans),
        )
    ]  # fmt: skip
