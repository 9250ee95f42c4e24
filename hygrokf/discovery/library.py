"""The library of causes: which mechanisms each of them is, where to look for its dates and thresholds, what to check.

A `Cause` gives `Variant`s for a scene: mechanisms to add to one or both parts, features that they read, start values,
and how many settings were searched.  Identifiers are those of `discovery.json`.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hygrokf.ambient import at_times, centred
from hygrokf.discovery.clocks import Shift, sources, turns_within
from hygrokf.discovery.scan import abrupt, local_scan, scan, slow_scan
from hygrokf.discovery.scene import HYGRIC, THERMAL, Part, Scene
from hygrokf.features import operating
from hygrokf.model import Mechanism
from hygrokf.record import Record

DAY_S = 86400.0


@dataclass(frozen=True)
class Variant:
    """One form of a cause, ready to be estimated.

    `additions` part → (mechanism, settings) pairs; `features` inputs they read; `starts` start values to be tried;
    `settings` what was chosen from a grid (dates, thresholds), `searched` how many independent settings that amounts to;
    `altered` part → mechanism → settings that differ from the base; `shift` a source whose stamps are to be moved.
    """

    cause: str
    form: str
    additions: Mapping[str, tuple[tuple[str, dict], ...]] = field(default_factory=dict)
    features: Mapping[str, dict] = field(default_factory=dict)
    starts: tuple[Mapping[str, float], ...] = ({},)
    settings: Mapping[str, object] = field(default_factory=dict)
    searched: float = 1.0
    altered: Mapping[str, Mapping[str, dict]] = field(default_factory=dict)
    shift: Shift | None = None


@dataclass(frozen=True)
class Cause:
    """A physical cause: its `variants` in a scene (none where the record cannot show it), in words what it is, what to
    check in the turbine (`remedy`), and the measurement that would tell it from its rivals (`separate_by`).

    `scored`: whether it shows in the free run's error; a clock or a faster exchange hardly does.  `event`: whether it
    happened at times that nobody logs, which no simulation can foresee.  A user's own cause brings its `mechanisms`, name → factory, and its `features`, name → (function, hold).
    """

    name: str
    meaning: str
    remedy: str
    separate_by: str
    variants: Callable[[Scene], list[Variant]]
    needs: str = ""
    scored: bool = True
    event: bool = False
    mechanisms: Mapping[str, Callable[..., Mechanism]] = field(default_factory=dict)
    features: Mapping[str, tuple[Callable, str]] = field(default_factory=dict)


def _parts(scene: Scene, **additions: tuple) -> dict[str, tuple]:
    """Additions for the parts that the scene has."""
    return {part: pairs for part, pairs in additions.items() if part in scene.parts}


def _one(
    cause: str, part: str, mechanism: str, *starts: Mapping[str, float]
) -> Callable[[Scene], list[Variant]]:
    """A cause that is one mechanism of one part, without a grid."""

    def variants(scene: Scene) -> list[Variant]:
        if part not in scene.parts:
            return []
        return [Variant(cause, mechanism, {part: ((mechanism, {}),)}, starts=starts)]

    return variants


# -- grids ---------------------------------------------------------------------------------------------------------
def dates(record: Record, every_days: float = 1.0) -> list[float]:
    """Dates [s] for a change: every day, five percent of the record away from its ends."""
    margin = 0.05 * (record.end_s - record.start_s)
    count = max(int((record.end_s - record.start_s - 2 * margin) / (every_days * DAY_S)), 3)
    return [float(d) for d in np.linspace(record.start_s + margin, record.end_s - margin, count)]


@dataclass(frozen=True)
class Probe:
    """A mechanism of one part whose parameter a scan of dates looks for."""

    part: str
    mechanism: tuple[str, dict]
    parameter: str
    nulls: Mapping[str, float] = field(default_factory=dict)


def _best_date(
    scene: Scene, feature: str, probes: Sequence[Probe], more: Sequence[float] = (), **fixed: float
) -> tuple[dict, float]:
    """(settings of the feature, effective number searched) of the change that the parts' score statistics ask for most."""
    spacing = dates(scene.record)
    grid = [*spacing, *more]
    step = spacing[1] - spacing[0]
    searched, found = 0.0, grid[0]
    for look in (slow_scan, scan):
        settings = [{"date_s": d, **fixed} for d in grid]
        looks = [
            look(scene.parts[one.part], one.mechanism, one.parameter, feature, settings, one.nulls)
            for one in probes
            if one.part in scene.parts
        ]
        scanned = functools.reduce(operator.add, looks)
        found = float(grid[int(np.argmax(scanned.root**2))])
        searched += scanned.effective
        grid = [found + step * f for f in np.linspace(-1.5, 1.5, 13)]
    return {"date_s": found, **fixed}, searched


RAMP_DAYS = 8.0
SETTLING_DAYS = 20.0


def _exchange_step(scene: Scene) -> list[Variant]:
    probes = (
        Probe(HYGRIC, ("stepped_exchange", {}), "exchange_change"),
        Probe(THERMAL, ("stepped_loss", {}), "conductance_change"),
    )
    additions = _parts(scene, thermal=(("stepped_loss", {}),), hygric=(("stepped_exchange", {}),))
    found = []
    for form, days in (("step", 0.0), ("ramp", RAMP_DAYS)):
        setting, tried = _best_date(scene, "after_step", probes, days=days)
        found.append(
            Variant(
                "exchange_step",
                form,
                additions,
                {"after_step": setting},
                settings=setting,
                searched=2 * tried,
            )
        )
    return found


def _temperature_offset(scene: Scene) -> list[Variant]:
    found = []
    if THERMAL in scene.parts:
        probe = Probe(THERMAL, ("temperature_step", {}), "temperature_offset")
        setting, tried = _best_date(scene, "after_step", [probe], abrupt(scene.parts[THERMAL]))
        found.append(
            Variant(
                "temperature_sensor_offset",
                "from a date on",
                {THERMAL: (("temperature_step", {}),)},
                {"after_step": setting},
                settings=setting,
                searched=tried,
            )
        )
    if HYGRIC in scene.parts:
        found.append(
            Variant(
                "temperature_sensor_offset",
                "constant",
                altered={HYGRIC: {"measured_air": {"accuracy": 8.0}}},
                starts=({}, {"cabinet_temperature_offset": 1.0}, {"cabinet_temperature_offset": -1.0}),
            )
        )
    return found


def _inside(scene: Scene, name: str) -> np.ndarray:
    """Readings of a signal in the cabinet, NaN left out."""
    value = scene.record[name].value
    return value[np.isfinite(value)]


def _best(
    part: Part,
    mechanism: str,
    parameter: str,
    feature: str,
    grid: list[dict],
    steps: Mapping[str, float],
    nulls: Mapping[str, float] | None = None,
) -> tuple[dict, float]:
    """(two-point setting that the score statistic asks for most, effective number searched); refined twice by `steps`."""
    searched, best, chosen = 0.0, -math.inf, grid[0]
    for factor in (1.0, 0.4, 0.0):
        scanned = scan(part, (mechanism, {}), parameter, feature, grid, nulls)
        searched += scanned.effective
        if scanned.root.max() > best:
            best, chosen = float(scanned.root.max()), grid[int(np.argmax(scanned.root))]
        on, off = (key for key in chosen if key.startswith("o"))
        step = factor * steps.get(str(chosen.get("reads", "")), next(iter(steps.values())))
        grid = [
            {**chosen, on: chosen[on] + i * step, off: chosen[off] + j * step}
            for i in (-1.0, -0.5, 0.0, 0.5, 1.0)
            for j in (-1.0, -0.5, 0.0, 0.5, 1.0)
            if (chosen[on] + i * step - chosen[off] - j * step) * (chosen[on] - chosen[off]) > 0
        ]
    return chosen, searched


def _cooling(scene: Scene) -> list[Variant]:
    if THERMAL not in scene.parts:
        return []
    levels = np.quantile(_inside(scene, "cabinet_temperature"), np.linspace(0.4, 0.97, 10))
    grid = [{"on_K": float(a), "off_K": float(a - width)} for a in levels for width in (1.0, 3.0, 6.0)]
    chosen, tried = _best(
        scene.parts[THERMAL], "cooling_loss", "cooling_conductance", "cooling", grid, {"": 1.5}
    )
    closed = _parts(scene, thermal=(("cooling_loss", {}),))
    blown = _parts(scene, thermal=(("cooling_loss", {}),), hygric=(("cooled_exchange", {}),))
    forms = [("closed", closed)] + ([("filter fan", blown)] if HYGRIC in scene.parts else [])
    return [
        Variant(
            "cooling_switching", form, additions, {"cooling": chosen},
            ({"cooling_conductance": 0.05}, {"cooling_conductance": 0.5}), chosen, tried,
        )
        for form, additions in forms
    ]  # fmt: skip


def _heater(scene: Scene) -> list[Variant]:
    if THERMAL not in scene.parts or "active_power" not in scene.record:
        return []
    series = scene.record["cabinet_temperature"]
    idle = ~operating(scene.record, series.time) & np.isfinite(series.value)
    if idle.sum() < 200:
        return []
    levels = np.quantile(series.value[idle], np.linspace(0.05, 0.8, 9))
    grid = [
        {"reads": "cabinet_temperature", "on": float(a), "off": float(a + width)}
        for a in levels
        for width in (1.0, 3.0, 6.0)
    ]
    if "cabinet_relative_humidity" in scene.record:
        damp = at_times(centred(scene.record["cabinet_relative_humidity"]), series.time[idle], 2.0)
        levels = np.nanquantile(damp, np.linspace(0.3, 0.95, 8))
        grid += [
            {"reads": "cabinet_relative_humidity", "on": float(a), "off": float(a - width)}
            for a in levels
            for width in (0.03, 0.08, 0.15)
        ]
    steps = {"cabinet_temperature": 1.5, "cabinet_relative_humidity": 0.05}
    chosen, tried = _best(scene.parts[THERMAL], "unreported_heater", "heater_heat", "heating", grid, steps)
    return [
        Variant(
            "standstill_heater", str(chosen["reads"]), {THERMAL: (("unreported_heater", {}),)},
            {"heating": chosen}, ({"heater_heat": 1.0}, {"heater_heat": 8.0}), chosen, tried,
        )
    ]  # fmt: skip


def _drier(scene: Scene) -> list[Variant]:
    if HYGRIC not in scene.parts or "cabinet_relative_humidity" not in scene.record:
        return []
    levels = np.quantile(_inside(scene, "cabinet_relative_humidity"), np.linspace(0.3, 0.95, 9))
    starts = tuple({"dehumidifier_rate": 1.0, "dehumidifier_setpoint": float(a)} for a in levels[[1, 4, 7]])
    found = [Variant("dehumidifier", "proportional", {HYGRIC: (("dehumidifier", {}),)}, starts=starts)]
    grid = [{"on": float(a), "off": float(a - width)} for a in levels for width in (0.03, 0.08)]
    # the rate is positive and estimated as a logarithm: its slope at a small value stands for that at zero
    chosen, tried = _best(
        scene.parts[HYGRIC],
        "switched_drying",
        "drying_rate",
        "drying",
        grid,
        {"": 0.02},
        {"drying_rate": 1e-4},
    )
    for form, plate in (("two-point, cold plate", True), ("two-point, desiccant", False)):
        found.append(
            Variant(
                "dehumidifier", form, {HYGRIC: (("switched_drying", {"plate": plate}),)}, {"drying": chosen},
                ({"drying_rate": 0.02}, {"drying_rate": 0.2}), chosen, tried,
            )
        )  # fmt: skip
    return found


def _wind(scene: Scene) -> list[Variant]:
    if "wind_speed" not in scene.record:
        return []
    found = []
    for form, flag in (("linear", "wind_tenth"), ("square", "wind_square")):
        additions = _parts(
            scene, thermal=(("wind_loss", {"flag": flag}),), hygric=(("wind_exchange", {"flag": flag}),)
        )
        found.append(Variant("wind_driven_exchange", form, additions, {flag: {}}, searched=2))
    return found


AZIMUTHS = (90.0, 135.0, 180.0, 225.0, 270.0)


def _sun(scene: Scene) -> list[Variant]:
    known = "global_horizontal_irradiance" in scene.record or scene.record.site is not None
    if not known or THERMAL not in scene.parts:
        return []
    starts = tuple({"solar_heat": 0.2, "solar_time": h} for h in (0.5, 3.0))
    found = [
        Variant(
            "solar_gain", "on the roof", {THERMAL: (("solar_gain", {"lagged": True}),)}, {"sunshine": {}}, starts,
            searched=1 + len(AZIMUTHS),
        )
    ]  # fmt: skip
    if scene.record.site is not None:
        wall = ("solar_gain", {"lagged": True, "flag": "sunlit_wall"})
        settings = [{"azimuth_deg": a} for a in AZIMUTHS]
        nulls = {"solar_heat": 1e-3, "solar_time": 1.5}
        scanned = scan(scene.parts[THERMAL], wall, "solar_heat", "sunlit_wall", settings, nulls)
        chosen = settings[int(np.argmax(scanned.root))]
        found.append(
            Variant(
                "solar_gain", "on a wall", {THERMAL: (wall,)}, {"sunlit_wall": chosen}, starts, chosen,
                1.0 + scanned.effective,
            )
        )  # fmt: skip
    return found


def _span(scene: Scene) -> dict[str, float]:
    return {"start_s": float(scene.record.start_s), "end_s": float(scene.record.end_s)}


def _humidity_drift(scene: Scene) -> list[Variant]:
    if HYGRIC not in scene.parts or "cabinet_relative_humidity" not in scene.record:
        return []
    levels = np.quantile(_inside(scene, "cabinet_relative_humidity"), (0.5, 0.8, 0.95))
    sticks = tuple({"humidity_lost": 0.5, "humidity_ceiling": float(a)} for a in levels)
    forms = (
        ("drift", "humidity_drift", {}, {"elapsed": _span(scene)}, ({},)),
        ("scale that goes off", "humidity_scale", {}, {"elapsed": _span(scene)}, ({},)),
        ("scale", "humidity_scale", {"flag": None}, {}, ({},)),
        ("ceiling", "humidity_ceiling", {}, {}, sticks),
    )
    return [
        Variant(
            "humidity_sensor_drift", form, {HYGRIC: ((mechanism, settings),)}, features, starts, searched=len(forms)
        )
        for form, mechanism, settings, features, starts in forms
    ]  # fmt: skip


def _heat_drift(scene: Scene) -> list[Variant]:
    if THERMAL not in scene.parts:
        return []
    base = dict(scene.parts[THERMAL].base.mechanisms)["heat_release"]
    own = {"order": base["order"], "operation": base["operation"]} if base["standstill"] else {}
    found = [
        Variant(
            "heat_release_drift", "straight", {THERMAL: (("release_drift", own),)}, {"elapsed": _span(scene)}
        )
    ]
    late = {**own, "flag": "since"}
    probe = Probe(THERMAL, ("release_drift", late), "heat_drift")
    setting, tried = _best_date(scene, "since", [probe], days=SETTLING_DAYS)
    return [
        *found,
        Variant(
            "heat_release_drift", "from a date on, saturating", {THERMAL: (("release_drift", late),)},
            {"since": setting}, settings=setting, searched=tried,
        ),
    ]  # fmt: skip


def _sorption(scene: Scene) -> list[Variant]:
    if HYGRIC not in scene.parts:
        return []
    starts = tuple({"sorption_capacity": 0.3, "sorption_time": t} for t in (3.0, 15.0, 60.0))
    return [
        Variant(
            "moisture_sorption", form, {HYGRIC: (("moisture_sorption", {"activated": activated}),)},
            starts=starts, searched=2,
        )
        for form, activated in (("uptake faster when warm", True), ("uptake alike at all temperatures", False))
    ]  # fmt: skip


def _condensation(scene: Scene) -> list[Variant]:
    if HYGRIC not in scene.parts:
        return []

    def starts(*rows: tuple[float, float, float]) -> tuple[dict, ...]:
        return tuple(
            {
                "condensation_rate": rate,
                "surface_time": time,
                "surface_share": 0.03,
                "surface_undercooling": below,
            }
            for rate, time, below in rows
        )

    forms = [("heavy surface", False, starts((0.2, 15.0, 0.3), (0.2, 4.0, 1.0), (2.0, 15.0, 0.3)))]
    if scene.record.site is not None:
        forms.append(("skin under the night sky", True, starts((0.3, 1.5, 3.0), (2.0, 1.0, 2.0))))
    return [
        Variant(
            "condensation", form, {HYGRIC: (("condensation", {"sky": sky}),)}, {"night_sky": {}} if sky else {},
            starts=first, searched=len(forms),
        )
        for form, sky, first in forms
    ]  # fmt: skip


HEAVY_MM_H = 1.0


def _rain(scene: Scene) -> list[Variant]:
    if "rain" not in scene.record or HYGRIC not in scene.parts:
        return []
    series = scene.record["rain"]
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


def _source(scene: Scene) -> list[Variant]:
    if HYGRIC not in scene.parts:
        return []
    start = ({"moisture_source": 0.02}, {"moisture_source": 0.3})

    def variant(form: str, when: str, features: dict, searched: int) -> Variant:
        additions = {HYGRIC: (("internal_moisture_source", {"when": when}),)}
        settings = next(iter(features.values()), {})
        return Variant("internal_moisture_source", form, additions, features, start, settings, searched)

    found = [variant("always", "always", {}, 3)]
    if "active_power" in scene.record:
        found.append(variant("at standstill", "standstill", {"standstill": {}}, 3))
    late = ("internal_moisture_source", {"when": "fading"})
    probe = Probe(HYGRIC, late, "moisture_source", {"moisture_source": 1e-4})
    setting, tried = _best_date(scene, "fading", [probe], days=SETTLING_DAYS)
    found.append(variant("drying out from a date on", "fading", {"fading": setting}, tried))
    return found


def _breathed(scene: Scene) -> list[Variant]:
    found = []
    forms = ("vapour", "temperature", "humidity")
    if HYGRIC in scene.parts:
        for form in forms:
            found.append(
                Variant(
                    "ambient_bias", form, {HYGRIC: (("breathed_air", {"time_h": 3.0, "form": form}),)},
                    starts=({}, {"breathed_lag_share": -0.5}), searched=len(forms),
                )
            )  # fmt: skip
    if THERMAL in scene.parts:
        thermal = (("lagged_ambient", {"time_h": 3.0}),)
        lag = ({}, {"ambient_lag_share": -0.5})
        found.append(
            Variant("ambient_bias", "lag of the temperature", {THERMAL: thermal}, starts=lag, searched=4)
        )
        if HYGRIC in scene.parts:
            both = {THERMAL: thermal, HYGRIC: (("breathed_air", {"time_h": 3.0}),)}
            lag = ({}, {"ambient_lag_share": -0.5, "breathed_lag_share": -0.5})
            found.append(Variant("ambient_bias", "lag of both", both, starts=lag, searched=4))
    return found


def _door(scene: Scene) -> list[Variant]:
    """Windows in which both parts' innovations ask for a much larger exchange, by a matched filter with a price for each."""
    spans = local_scan(
        {
            name: (scene.parts[name], mechanism, parameter)
            for name, mechanism, parameter in (
                (HYGRIC, "open_exchange", "door_exchange"),
                (THERMAL, "open_loss", "door_conductance"),
            )
            if name in scene.parts
        },
        "door_open",
    )
    if not spans:
        return []
    additions = _parts(scene, thermal=(("open_loss", {}),), hygric=(("open_exchange", {}),))
    return [
        Variant(
            "door_opening", f"{len(spans)} openings", additions, {"door_open": {"spans": spans}},
            ({"door_exchange": 3.0, "door_conductance": 0.1},), {"spans": spans}, 200 * len(spans),
        )
    ]  # fmt: skip


SHIFTS_MIN = (-60.0, -30.0, -10.0, 10.0, 30.0, 60.0)


def _clock(scene: Scene) -> list[Variant]:
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


LIBRARY: tuple[Cause, ...] = (
    Cause(
        "moisture_sorption", "hygroscopic material takes up water while the cabinet stands and gives it back on heating",
        "look for polymers, insulation, paper or desiccant in the cabinet; dry or replace them; pre-heat with ventilation",
        "weigh a piece of the material before and after pre-heating, or log relative humidity close to it",
        _sorption,
    ),
    Cause(
        "condensation", "a film forms on a surface colder than the dew point and evaporates later",
        "find and insulate the cold surface; check the drain; keep it above the dew point at standstill",
        "a surface temperature or wetness sensor at the coldest wall",
        _condensation,
    ),
    Cause(
        "wall_thermal_mass", "a second thermal mass stores heat beside the converter",
        "none needed; use the extended model", "a temperature sensor on the inner wall",
        _one("wall_thermal_mass", THERMAL, "wall_thermal_mass",
             *({"wall_conductance": 0.02, "wall_time_constant": t} for t in (3.0, 20.0))),
    ),
    Cause(
        "solar_gain", "the sun heats the cabinet or the tower around it",
        "shade or paint the wall; check the ventilation of the tower base", "irradiance measured at the tower",
        _sun, needs="irradiance or the site",
    ),
    Cause(
        "wind_driven_exchange", "wind drives air through the cabinet",
        "check seals and cable entries on the windward side", "wind speed at the tower base; a tracer-gas decay in wind and in calm",
        _wind, needs="wind_speed",
    ),
    Cause(
        "standstill_heater", "a heater that no signal reports runs at standstill",
        "find the heater and its thermostat or humidistat; log its state", "current of the heater",
        _heater, needs="power",
    ),
    Cause(
        "cooling_switching", "a fan or valve stage cools the cabinet above a threshold",
        "find the stage and its set-points; log its state", "state of the fan or valve", _cooling,
    ),
    Cause(
        "exchange_step", "the exchange of air changed at a date",
        "ask what was done on that date: seal, filter, door, cable entry", "a tracer-gas decay now", _exchange_step, scored=False,
    ),
    Cause(
        "heat_release_drift", "the heat release drifts with the calendar",
        "check filters, fans and heat exchangers for fouling; compare losses of the converter", "heat flow or coolant temperatures",
        _heat_drift,
    ),
    Cause(
        "humidity_sensor_drift", "the humidity sensor drifts, or its scale is off",
        "compare the sensor with a reference; replace it", "a second humidity sensor beside it", _humidity_drift,
    ),
    Cause(
        "temperature_sensor_offset", "the cabinet's temperature sensor is off by more than its accuracy",
        "compare the sensor with a reference; check its place and its wiring", "a second temperature sensor beside it",
        _temperature_offset,
    ),
    Cause(
        "clock_shift", "one source's clock is off", "set the clock, or state the zone and the stamp of the source",
        "an event that all sources see", _clock, scored=False,
    ),
    Cause(
        "rain_ingress", "rain enters and evaporates", "look for the way of the water: door, cable entry, roof",
        "a wetness sensor on the floor", _rain, needs="rain",
    ),
    Cause(
        "door_opening", "the door stood open", "compare with the log of service visits", "a door contact", _door, scored=False, event=True,
    ),
    Cause(
        "dehumidifier", "a drier works above a set-point", "find the drier and its set-point; log its state",
        "current of the drier", _drier,
    ),
    Cause(
        "internal_moisture_source", "water evaporates inside", "look for leaks of coolant, wet cable ducts, ground water",
        "absolute humidity inside and outside with the cabinet at ambient temperature", _source,
    ),
    Cause(
        "ambient_bias", "the ambient series is not the air that the cabinet breathes",
        "compare the weather series with a sensor at the air inlet", "temperature and humidity at the inlet", _breathed,
    ),
)  # fmt: skip


def named(name: str, library: Sequence[Cause] = LIBRARY) -> Cause:
    """The cause of that identifier."""
    for cause in library:
        if cause.name == name:
            return cause
    raise KeyError(f"no cause {name!r}; the library has {', '.join(c.name for c in library)}")


def penalty(variant: Variant, parameters: int, n: int) -> float:
    """What a variant's parameters and its grid cost in 2 ln L (BIC, and 2 ln of the settings searched)."""
    return parameters * math.log(max(n, 3)) + 2.0 * math.log(max(variant.searched, 1))
