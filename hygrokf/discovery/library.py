"""The library of causes: what each cause is, what to check in the turbine, which measurement tells it from
its rivals."""

from __future__ import annotations

from collections.abc import Sequence

from hygrokf.discovery.cause import Cause
from hygrokf.discovery.forms import (
    ambient,
    by_the_clock,
    clock,
    condensation,
    cooling,
    doors,
    drier,
    exchange_step,
    heat_drift,
    heater,
    humidity_sensor,
    rain,
    sorption,
    source,
    sun,
    temperature_offset,
    wall,
    wind,
)

LIBRARY: tuple[Cause, ...] = (
    Cause(
        "moisture_sorption",
        "hygroscopic material takes up water while the cabinet stands and gives it back on heating",
        "look for polymers, insulation, paper or desiccant in the cabinet; dry or replace them; pre-heat "
        "with ventilation",
        "weigh a piece of the material before and after pre-heating, or log relative humidity close to it",
        sorption,
        tried="water content by an isotherm, given back on heating; uptake faster when warm, or alike at "
        "all temperatures; by thin material, or by a slab into which water diffuses",
    ),
    Cause(
        "condensation", "a film forms on a surface colder than the dew point and evaporates later",
        "find and insulate the cold surface; check the drain; keep it above the dew point at standstill",
        "a surface temperature or wetness sensor at the coldest wall",
        condensation,
        tried="film on a surface with a lag of its own, colder than the air around the cabinet always or "
        "under the night sky",
    ),
    Cause(
        "wall_thermal_mass", "a second thermal mass stores heat beside the converter",
        "none needed; use the extended model", "a temperature sensor on the inner wall",
        wall,
        tried="a second mass between ambient and cabinet air",
    ),
    Cause(
        "solar_gain", "the sun heats the cabinet or the tower around it",
        "shade or paint the wall; check the ventilation of the tower base",
        "irradiance measured at the tower",
        sun, needs="irradiance or the site",
        tried="measured or clear-sky irradiance on a roof, or on a wall that faces somewhere, through a lag",
    ),
    Cause(
        "wind_driven_exchange", "wind drives air through the cabinet",
        "check seals and cable entries on the windward side",
        "wind speed at the tower base; a tracer-gas decay in wind and in calm",
        wind, needs="wind_speed",
        tried="loss of heat and exchange of vapour with the wind or its square",
    ),
    Cause(
        "exchange_step", "the exchange of air changed at a date",
        "ask what was done on that date: seal, filter, door, cable entry", "a tracer-gas decay now",
        exchange_step,
        tried="loss of heat and exchange of vapour that change at a date",
    ),
    Cause(
        "heat_release_drift", "the heat release drifts with the calendar",
        "check filters, fans and heat exchangers for fouling; compare losses of the converter",
        "heat flow or coolant temperatures",
        heat_drift,
        tried="heat release in operation that drifts in proportion to time, or from a date on and "
        "saturating",
    ),
    Cause(
        "humidity_sensor_drift", "the humidity sensor drifts, or its scale is off",
        "compare the sensor with a reference; replace it", "a second humidity sensor beside it",
        humidity_sensor,
        tried="drift, a scale that is off or goes off, a ceiling that the readings do not pass",
    ),
    Cause(
        "temperature_sensor_offset", "the cabinet's temperature sensor is off by more than its accuracy",
        "compare the sensor with a reference; check its place and its wiring",
        "a second temperature sensor beside it",
        temperature_offset,
        tried="offset from a date on, or constant beyond the accuracy",
    ),
    Cause(
        "clock_shift", "one source's clock is off",
        "set the clock, or state the zone and the stamp of the source",
        "an event that all sources see", clock,
        tried="one source's stamps, by a constant or by an hour in summer time; of two sources only "
        "the difference shows",
    ),
    Cause(
        "rain_ingress", "rain enters and evaporates",
        "find where the water enters: door, cable entry, roof",
        "a wetness sensor on the floor", rain, needs="rain",
        tried="rain that enters and evaporates",
    ),
    Cause(
        "door_opening", "the door stood open", "compare with the log of service visits", "a door contact",
        doors,
        tried="windows of much larger exchange",
    ),
    Cause(
        "dehumidifier", "a drier works above a set-point", "find the drier and its set-point; log its state",
        "current of the drier", drier,
        tried="drying above a set-point of the humidity, by a desiccant or by a cold plate, which may warm "
        "the air",
    ),
    Cause(
        "internal_moisture_source", "water evaporates inside",
        "look for leaks of coolant, wet cable ducts, ground water",
        "absolute humidity inside and outside with the cabinet at ambient temperature", source,
        tried=(
            "vapour release: constant, at standstill, from a wet surface, in the same hours, or drying "
            "out from a date on"
        ),
    ),
    Cause(
        "ambient_bias", "the ambient series does not describe the air that enters the cabinet",
        "compare the weather series with a sensor at the air inlet", "temperature and humidity at the inlet",
        ambient,
        tried=(
            "offset or gain of the ambient vapour, offset of its humidity; air or intake air that lags the "
            "series; a smoothed series"
        ),
    ),
    Cause(
        "unlogged_heater", "a heater that no signal reports runs",
        "find the heater and its thermostat or humidistat; log its state", "current of the heater",
        heater,
        tried="thermostat or humidistat, at standstill or in any state",
    ),
    Cause(
        "scheduled_heat", "something releases heat at the same hours of every day, or of every workday",
        "look for lamps, timers and people at work in these hours; log the load",
        "current of the equipment that runs in these hours",
        by_the_clock,
        tried="heat in the same hours of every day, or of every workday (UTC)",
    ),
    Cause(
        "cooling_switching", "a fan, a vent or a valve cools the cabinet above a threshold",
        "find the fan, vent or valve and its set-points; log its state", "state of the fan, vent or valve",
        cooling,
        tried="a stage whose loss grows with the temperature, cooling of constant power, or a vent that "
        "opens by temperature or humidity",
    ),
)  # fmt: skip


def named(name: str, library: Sequence[Cause] = LIBRARY) -> Cause:
    """The cause of that identifier."""
    for cause in library:
        if cause.name == name:
            return cause
    raise KeyError(f"no cause {name!r}; the library has {', '.join(c.name for c in library)}")
