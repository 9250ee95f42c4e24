"""What a cause is, and the library of causes: each with what to check in the turbine, and the measurement
that tells it from its rivals.

`cause_of` makes a cause of one mechanism, in the package's library and in a user's file alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from hygrokf.data.prepared import prepare
from hygrokf.discovery import forms
from hygrokf.discovery.forms import Form, Ground, Setting, using
from hygrokf.discovery.results import Settings
from hygrokf.modelling.derived_inputs import without_settings
from hygrokf.modelling.registry import is_package_feature, is_package_mechanism
from hygrokf.physics.model import Feature, Mechanism

ALWAYS = ("ambient_temperature", "exchange_factor")
"""Inputs that every run has."""


@dataclass(frozen=True)
class Cause:
    """A physical cause.

    name: identifier.
    meaning, remedy, separate_by: what it is, what to check in the turbine, and the measurement that tells it
        from its rivals.
    forms: those in which a record can show it, none where it cannot.
    needs: signals without which it is not tried, for the report.
    mechanisms, features: name → factory, and name → (function, hold), of a user's own cause.
    """

    name: str
    meaning: str
    remedy: str
    separate_by: str
    forms: Callable[[Ground], Iterable[Form]]
    needs: str = ""
    mechanisms: Mapping[str, Callable[..., Mechanism]] = field(default_factory=dict)
    features: Mapping[str, Feature] = field(default_factory=dict)


def cause_of(
    name: str,
    *,
    thermal: Callable[[], Mechanism] | None = None,
    hygric: Callable[[], Mechanism] | None = None,
    meaning: str,
    remedy: str,
    separate_by: str,
    starts: Mapping[str, float] | Sequence[Mapping[str, float]] = (),
    features: Mapping[str, Settings | Feature] | None = None,
    needs: Sequence[str] = (),
) -> Cause:
    """A cause that is one mechanism of the heat, of the vapour, or one of each.

    name: identifier.  thermal, hygric: factories of the mechanism, called without arguments.
    meaning, remedy, separate_by: one sentence each: what the cause is, what to check in the turbine, and
        which measurement tells it from its rivals.
    starts: values of shape parameters to try, in their units; the sizes of the effect are estimated at each.
    features: settings of the package's features that need any (`{"after_step": {"date_s": 1.6e9}}`), and
        features that the mechanism does not bring itself: (function(record, time), hold).
    needs: signals that features read.  On a record that lacks one the cause is not tried.

    Returns the cause, for the library of the package or the `library` of `discover`.  For grids of dates or
    thresholds make a `Cause` with `forms` of your own.  Raises ValueError without a factory, TypeError where
    a factory returns no mechanism.
    """
    factories = {key: one for key, one in (("thermal", thermal), ("hygric", hygric)) if one is not None}
    if not factories:
        raise ValueError(f"cause {name!r}: expected a factory for thermal, hygric or both, found none")
    mechanisms = {key: factory() for key, factory in factories.items()}
    wrong = [key for key, one in mechanisms.items() if not isinstance(one, Mechanism)]
    if wrong:
        raise TypeError(f"cause {name!r}: expected factories that return a Mechanism: {', '.join(wrong)}")
    inputs = {key for one in mechanisms.values() for key in one.inputs}
    brought = {key: pair for one in mechanisms.values() for key, pair in one.features.items()}
    named = {**without_settings(inputs), **brought, **(features or {})}
    settings = {key: dict(value) if isinstance(value, Mapping) else {} for key, value in named.items()}
    own = {key: value for key, value in named.items() if not isinstance(value, Mapping)}
    first = (starts,) if isinstance(starts, Mapping) else tuple(starts)
    grid = tuple(Setting(settings, values) for values in first or ({},))

    def given(ground: Ground) -> list[Form]:
        there = {key: one for key, one in mechanisms.items() if ground.humid or key == "thermal"}
        known = {*ALWAYS, *settings, *ground.record.signals}
        if prepare(ground.record).ambient_vapour is not None:
            known.add("ambient_absolute_humidity")
        lacking = [
            key for key, one in there.items()
            if {*one.inputs, *needs} - known - ground.inputs[key != "thermal"]
        ]  # fmt: skip
        if lacking or not there:
            return []
        heat, vapour = (using(there[key].name) if key in there else () for key in ("thermal", "hygric"))
        return [Form(name, "", heat, vapour, grid)]

    made = {mechanisms[key].name: factory for key, factory in factories.items()}
    return Cause(
        name, meaning, remedy, separate_by, given, ", ".join(sorted({*inputs, *needs} - set(settings))),
        mechanisms={key: one for key, one in made.items() if not is_package_mechanism(key, one)},
        features={key: pair for key, pair in own.items() if not is_package_feature(key, pair)},
    )  # fmt: skip


LIBRARY: tuple[Cause, ...] = (
    Cause(
        "moisture_sorption",
        "hygroscopic material takes up water while the cabinet stands and gives it back on heating",
        "look for polymers, insulation, paper or desiccant in the cabinet; dry or replace them; pre-heat "
        "with ventilation",
        "weigh a piece of the material before and after pre-heating, or log relative humidity close to it",
        forms.sorption,
    ),
    Cause(
        "condensation", "a film forms on a surface colder than the dew point and evaporates later",
        "find and insulate the cold surface; check the drain; keep it above the dew point at standstill",
        "a surface temperature or wetness sensor at the coldest wall",
        forms.condensation,
    ),
    Cause(
        "wall_thermal_mass", "a second thermal mass stores heat beside the converter",
        "none needed; use the extended model", "a temperature sensor on the inner wall",
        forms.wall,
    ),
    Cause(
        "solar_gain", "the sun heats the cabinet or the tower around it",
        "shade or paint the wall; check the ventilation of the tower base",
        "irradiance measured at the tower",
        forms.sun, needs="irradiance or the site",
    ),
    Cause(
        "wind_driven_exchange", "wind drives air through the cabinet",
        "check seals and cable entries on the windward side",
        "wind speed at the tower base; a tracer-gas decay in wind and in calm",
        forms.wind, needs="wind_speed",
    ),
    Cause(
        "exchange_step", "the exchange of air changed at a date",
        "ask what was done on that date: seal, filter, door, cable entry", "a tracer-gas decay now",
        forms.exchange_step,
    ),
    Cause(
        "heat_release_drift", "the heat release drifts with the calendar",
        "check filters, fans and heat exchangers for fouling; compare losses of the converter",
        "heat flow or coolant temperatures",
        forms.heat_drift,
    ),
    Cause(
        "humidity_sensor_drift", "the humidity sensor drifts, or its scale is off",
        "compare the sensor with a reference; replace it", "a second humidity sensor beside it",
        forms.humidity_sensor,
    ),
    Cause(
        "temperature_sensor_offset", "the cabinet's temperature sensor is off by more than its accuracy",
        "compare the sensor with a reference; check its place and its wiring",
        "a second temperature sensor beside it",
        forms.temperature_offset,
    ),
    Cause(
        "clock_shift", "one source's clock is off",
        "set the clock, or state the zone and the stamp of the source",
        "an event that all sources see", forms.clock,
    ),
    Cause(
        "rain_ingress", "rain enters and evaporates",
        "find where the water enters: door, cable entry, roof",
        "a wetness sensor on the floor", forms.rain, needs="rain",
    ),
    Cause(
        "door_opening", "the door stood open", "compare with the log of service visits", "a door contact",
        forms.doors,
    ),
    Cause(
        "dehumidifier", "a drier works above a set-point", "find the drier and its set-point; log its state",
        "current of the drier", forms.drier,
    ),
    Cause(
        "internal_moisture_source", "water evaporates inside",
        "look for leaks of coolant, wet cable ducts, ground water",
        "absolute humidity inside and outside with the cabinet at ambient temperature", forms.source,
    ),
    Cause(
        "ambient_bias", "the ambient series does not describe the air that enters the cabinet",
        "compare the weather series with a sensor at the air inlet", "temperature and humidity at the inlet",
        forms.ambient,
    ),
    Cause(
        "unlogged_heater", "a heater that no signal reports runs",
        "find the heater and its thermostat or humidistat; log its state", "current of the heater",
        forms.heater,
    ),
    Cause(
        "scheduled_heat", "something releases heat at the same hours of every day, or of every workday",
        "look for lamps, timers and people at work in these hours; log the load",
        "current of the equipment that runs in these hours",
        forms.by_the_clock,
    ),
    Cause(
        "cooling_switching", "a fan, a vent or a valve cools the cabinet above a threshold",
        "find the fan, vent or valve and its set-points; log its state", "state of the fan, vent or valve",
        forms.cooling,
    ),
)  # fmt: skip


def named(name: str, library: Sequence[Cause] = LIBRARY) -> Cause:
    """The cause of that identifier."""
    for cause in library:
        if cause.name == name:
            return cause
    raise KeyError(f"no cause {name!r}; the library has {', '.join(c.name for c in library)}")
