"""The library of causes: which mechanisms each of them is, where to look for its dates and thresholds, what to check.

A `Cause` gives `Variant`s for a scene: mechanisms to add to one or both parts, features that they read, start values,
and how many settings were searched.  Identifiers are those of `discovery.json`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hygrokf.ambient import at_times, centred
from hygrokf.discovery.scan import abrupt, local_scan, scan
from hygrokf.discovery.scene import HYGRIC, THERMAL, Part, Scene
from hygrokf.features import operating
from hygrokf.record import Record

DAY_S = 86400.0


@dataclass(frozen=True)
class Variant:
    """One form of a cause, ready to be estimated.

    `additions` part → (mechanism, settings) pairs; `features` inputs they read; `starts` start values to be tried;
    `settings` what was chosen from a grid (dates, thresholds), `searched` the size of that grid; `altered` part →
    mechanism → settings that differ from the base; `shift_s` source → seconds that its stamps are moved by.
    """

    cause: str
    form: str
    additions: Mapping[str, tuple[tuple[str, dict], ...]] = field(default_factory=dict)
    features: Mapping[str, dict] = field(default_factory=dict)
    starts: tuple[Mapping[str, float], ...] = ({},)
    settings: Mapping[str, object] = field(default_factory=dict)
    searched: int = 1
    altered: Mapping[str, Mapping[str, dict]] = field(default_factory=dict)
    shift_s: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Cause:
    """A physical cause: its `variants` in a scene (none where the record cannot show it), in words what it is, what to
    check in the turbine (`remedy`), and the measurement that would tell it from its rivals (`separate_by`).

    `scored`: whether it shows in the free run's error; a clock or a faster exchange hardly does.
    """

    name: str
    meaning: str
    remedy: str
    separate_by: str
    variants: Callable[[Scene], list[Variant]]
    needs: str = ""
    scored: bool = True


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
def dates(record: Record, every_days: float = 3.0) -> list[float]:
    """Dates [s] for a change: every few days, five percent of the record away from its ends."""
    margin = 0.05 * (record.end_s - record.start_s)
    count = max(int((record.end_s - record.start_s - 2 * margin) / (every_days * DAY_S)), 3)
    return [float(d) for d in np.linspace(record.start_s + margin, record.end_s - margin, count)]


def _best_date(
    scene: Scene, probes: Mapping[str, tuple[str, str]], more: Sequence[float] = ()
) -> tuple[float, int]:
    """(date [s], dates tried) of the change that the parts' score statistics ask for most."""
    grid = [*dates(scene.record), *more]
    spacing = grid[1] - grid[0]
    for _ in range(2):
        total = np.zeros(len(grid))
        for part, (mechanism, parameter) in probes.items():
            if part in scene.parts:
                settings = [{"date_s": d} for d in grid]
                total += scan(scene.parts[part], (mechanism, {}), parameter, "after_step", settings) ** 2
        best = int(np.argmax(total))
        found, tried = grid[best], len(dates(scene.record)) + len(more)
        grid = [found + spacing * f for f in np.linspace(-0.9, 0.9, 13)]  # once more, finer; 0 is among them
    return found, tried


def _exchange_step(scene: Scene) -> list[Variant]:
    probes = {
        HYGRIC: ("stepped_exchange", "exchange_change"),
        THERMAL: ("stepped_loss", "conductance_change"),
    }
    date, tried = _best_date(scene, probes)
    additions = _parts(scene, thermal=(("stepped_loss", {}),), hygric=(("stepped_exchange", {}),))
    return [
        Variant(
            "exchange_step", "step", additions, {"after_step": {"date_s": date}},
            settings={"date_s": date}, searched=tried,
        )
    ]  # fmt: skip


def _temperature_offset(scene: Scene) -> list[Variant]:
    found = []
    if THERMAL in scene.parts:
        probes = {THERMAL: ("temperature_step", "temperature_offset")}
        date, tried = _best_date(scene, probes, abrupt(scene.parts[THERMAL]))
        found.append(
            Variant(
                "temperature_sensor_offset",
                "from a date on",
                {THERMAL: (("temperature_step", {}),)},
                {"after_step": {"date_s": date}},
                settings={"date_s": date},
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
    part: Part, mechanism: str, parameter: str, feature: str, grid: list[dict], steps: Mapping[str, float]
) -> tuple[dict, int]:
    """The two-point setting that the score statistic asks for most, refined twice around itself by `steps`."""
    tried, best, chosen = 0, -math.inf, grid[0]
    for factor in (1.0, 0.4):
        z = scan(part, (mechanism, {}), parameter, feature, grid)
        tried += len(grid)
        if z.max() > best:
            best, chosen = float(z.max()), grid[int(np.argmax(z))]
        on, off = (key for key in chosen if key.startswith("o"))
        step = factor * steps.get(str(chosen.get("reads", "")), next(iter(steps.values())))
        grid = [
            {**chosen, on: chosen[on] + i * step, off: chosen[off] + j * step}
            for i in (-1.0, -0.5, 0.0, 0.5, 1.0)
            for j in (-1.0, -0.5, 0.0, 0.5, 1.0)
            if (chosen[on] + i * step - chosen[off] - j * step) * (chosen[on] - chosen[off]) > 0
        ]
    z = scan(part, (mechanism, {}), parameter, feature, grid)
    if z.max() > best:
        chosen = grid[int(np.argmax(z))]
    return chosen, tried


def _cooling(scene: Scene) -> list[Variant]:
    if THERMAL not in scene.parts:
        return []
    levels = np.quantile(_inside(scene, "cabinet_temperature"), np.linspace(0.4, 0.97, 10))
    grid = [{"on_K": float(a), "off_K": float(a - width)} for a in levels for width in (1.0, 3.0, 6.0)]
    chosen, tried = _best(
        scene.parts[THERMAL], "cooling_loss", "cooling_conductance", "cooling", grid, {"": 1.5}
    )
    additions = _parts(scene, thermal=(("cooling_loss", {}),))
    return [
        Variant(
            "cooling_switching", "two-point", additions, {"cooling": chosen},
            ({"cooling_conductance": 0.05},), chosen, tried,
        )
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
            {"heating": chosen}, ({"heater_heat": 1.0},), chosen, tried,
        )
    ]  # fmt: skip


def _drier(scene: Scene) -> list[Variant]:
    if HYGRIC not in scene.parts or "cabinet_relative_humidity" not in scene.record:
        return []
    levels = np.quantile(_inside(scene, "cabinet_relative_humidity"), np.linspace(0.3, 0.95, 9))
    starts = tuple({"dehumidifier_rate": 1.0, "dehumidifier_setpoint": float(a)} for a in levels[[2, 6]])
    found = [Variant("dehumidifier", "proportional", {HYGRIC: (("dehumidifier", {}),)}, starts=starts)]
    grid = [{"on": float(a), "off": float(a - width)} for a in levels for width in (0.02, 0.05, 0.1)]
    # the rate is positive and estimated as a logarithm: its slope at a small value stands for that at zero
    z = scan(
        scene.parts[HYGRIC], ("switched_drying", {}), "drying_rate", "drying", grid, {"drying_rate": 1e-4}
    )
    best = int(np.argmax(z))
    found.append(
        Variant(
            "dehumidifier",
            "two-point",
            {HYGRIC: (("switched_drying", {}),)},
            {"drying": grid[best]},
            ({"drying_rate": 0.1},),
            grid[best],
            len(grid),
        )
    )
    return found


def _wind(scene: Scene) -> list[Variant]:
    if "wind_speed" not in scene.record:
        return []
    additions = _parts(scene, thermal=(("wind_loss", {}),), hygric=(("wind_exchange", {}),))
    return [Variant("wind_driven_exchange", "linear", additions, {"wind_tenth": {}})]


def _sun(scene: Scene) -> list[Variant]:
    known = "global_horizontal_irradiance" in scene.record or scene.record.site is not None
    if not known or THERMAL not in scene.parts:
        return []
    return [
        Variant(
            "solar_gain", f"lag of {time_h:g} h" if time_h else "at once",
            {THERMAL: (("solar_gain", {"time_h": time_h}),)}, {"sunshine": {}}, ({"solar_heat": 0.1},), searched=2,
        )
        for time_h in (0.0, 3.0)
    ]  # fmt: skip


def _span(scene: Scene) -> dict[str, float]:
    return {"start_s": float(scene.record.start_s), "end_s": float(scene.record.end_s)}


def _humidity_drift(scene: Scene) -> list[Variant]:
    if HYGRIC not in scene.parts or "cabinet_relative_humidity" not in scene.record:
        return []
    return [
        Variant(
            "humidity_sensor_drift", form, {HYGRIC: ((mechanism, {}),)}, {feature: _span(scene)}, searched=2
        )
        for form, mechanism, feature in (
            ("drift", "humidity_drift", "elapsed"),
            ("scale", "humidity_scale", "elapsed"),
        )
    ]


def _heat_drift(scene: Scene) -> list[Variant]:
    return [
        Variant(
            "heat_release_drift",
            "straight",
            {THERMAL: (("release_drift", {}),)},
            {"elapsed": _span(scene)},
        )
    ]


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
    starts = tuple(
        {"condensation_rate": 0.1, "surface_share": s, "surface_undercooling": 1.0} for s in (0.05, 0.4)
    )
    return [
        Variant(
            "condensation", form, {HYGRIC: (("condensation", {"time_h": time_h}),)}, starts=starts, searched=2
        )
        for form, time_h in (("light surface", 1.5), ("heavy surface", 15.0))
    ]  # fmt: skip


def _rain(scene: Scene) -> list[Variant]:
    if "rain" not in scene.record or HYGRIC not in scene.parts:
        return []
    starts = tuple({"rain_intake": 0.1, "rain_drying_time": t} for t in (2.0, 12.0))
    return [Variant("rain_ingress", "delayed", {HYGRIC: (("rain_ingress", {}),)}, starts=starts)]


def _source(scene: Scene) -> list[Variant]:
    if HYGRIC not in scene.parts:
        return []
    forms = [("always", False)]
    if "active_power" in scene.record:
        forms.append(("at standstill", True))
    return [
        Variant(
            "internal_moisture_source", form, {HYGRIC: (("internal_moisture_source", {"standstill": idle}),)},
            {"standstill": {}} if idle else {}, starts=({"moisture_source": 0.02},), searched=len(forms),
        )
        for form, idle in forms
    ]  # fmt: skip


def _breathed(scene: Scene) -> list[Variant]:
    found = []
    if HYGRIC in scene.parts:
        found.append(
            Variant("ambient_bias", "vapour", {HYGRIC: (("breathed_air", {"time_h": 3.0}),)}, searched=2)
        )
    if THERMAL in scene.parts:
        found.append(
            Variant(
                "ambient_bias", "temperature", {THERMAL: (("lagged_ambient", {"time_h": 3.0}),)}, searched=2
            )
        )
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


def sources(record: Record) -> dict[str, tuple[str, ...]]:
    """Files of a record and the signals that each of them brings: what has one clock."""
    found: dict[str, list[str]] = {}
    for series in record.series:
        found.setdefault(series.source.split(",")[0] or series.signal, []).append(series.signal)
    return {name: tuple(signals) for name, signals in found.items()}


def _clock(scene: Scene) -> list[Variant]:
    cabinet = "cabinet_temperature"
    return [
        Variant("clock_shift", name, shift_s={name: 0.0}, searched=4 * len(SHIFTS_MIN))
        for name, signals in sources(scene.record).items()
        if cabinet in signals or "ambient_temperature" in signals or "active_power" in signals
    ]


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
        "door_opening", "the door stood open", "compare with the log of service visits", "a door contact", _door, scored=False,
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
