"""The library of causes: what each cause is, what to check in the turbine, which measurement tells it from
its rivals."""

from __future__ import annotations

from collections.abc import Sequence

from hygrokf.discovery.cause import Cause
from hygrokf.discovery.causes import (
    breathed,
    by_the_clock,
    clock,
    condensation,
    cooling,
    door,
    drier,
    exchange_step,
    heat_drift,
    heater,
    humidity_drift,
    rain,
    response,
    sorption,
    source,
    sun,
    temperature_offset,
    wall,
    wind,
)

ODD = 30.0
"""Evidence that is enough for causes that hardly show in the free run; on plants without such a cause it
stays below 10."""
SWITCHED = 60.0
"""The same for switches, whose thresholds are searched."""

LIBRARY: tuple[Cause, ...] = (
    Cause(
        "moisture_sorption",
        "hygroscopic material takes up water while the cabinet stands and gives it back on heating",
        "look for polymers, insulation, paper or desiccant in the cabinet; dry or replace them; pre-heat "
        "with ventilation",
        "weigh a piece of the material before and after pre-heating, or log relative humidity close to it",
        sorption,
        forms="water content by an isotherm, given back on heating; uptake faster when warm, or alike at "
        "all temperatures; by thin material, or by a slab into which water diffuses",
    ),
    Cause(
        "condensation", "a film forms on a surface colder than the dew point and evaporates later",
        "find and insulate the cold surface; check the drain; keep it above the dew point at standstill",
        "a surface temperature or wetness sensor at the coldest wall",
        condensation,
        forms="film on a surface with a lag of its own that the air or the night sky cools",
    ),
    Cause(
        "wall_thermal_mass", "a second thermal mass stores heat beside the converter",
        "none needed; use the extended model", "a temperature sensor on the inner wall",
        wall,
        forms="a second mass between ambient and cabinet air",
    ),
    Cause(
        "solar_gain", "the sun heats the cabinet or the tower around it",
        "shade or paint the wall; check the ventilation of the tower base",
        "irradiance measured at the tower",
        sun, needs="irradiance or the site",
        forms="measured or clear-sky irradiance on a roof, or on a wall that faces somewhere, through a lag",
        searches="azimuth",
    ),
    Cause(
        "wind_driven_exchange", "wind drives air through the cabinet",
        "check seals and cable entries on the windward side",
        "wind speed at the tower base; a tracer-gas decay in wind and in calm",
        wind, needs="wind_speed",
        forms="loss of heat and exchange of vapour with the wind or its square",
    ),
    Cause(
        "exchange_step", "the exchange of air changed at a date",
        "ask what was done on that date: seal, filter, door, cable entry", "a tracer-gas decay now",
        exchange_step, alone=ODD,
        forms=(
            "loss and exchange that change at a date, at once or within 8 days; the vapour disturbances "
            "either enter with the exchanged air or are flows that do not change"
        ),
        searches="dates",
    ),
    Cause(
        "heat_release_drift", "the heat release drifts with the calendar",
        "check filters, fans and heat exchangers for fouling; compare losses of the converter",
        "heat flow or coolant temperatures",
        heat_drift,
        forms="heat release in operation that drifts, straight or from a date on and saturating",
        searches="dates",
    ),
    Cause(
        "humidity_sensor_drift", "the humidity sensor drifts, or its scale is off",
        "compare the sensor with a reference; replace it", "a second humidity sensor beside it",
        humidity_drift,
        forms="drift, a scale that is off or goes off, a ceiling that the readings do not pass",
    ),
    Cause(
        "temperature_sensor_offset", "the cabinet's temperature sensor is off by more than its accuracy",
        "compare the sensor with a reference; check its place and its wiring",
        "a second temperature sensor beside it",
        temperature_offset,
        forms="offset from a date on, or constant beyond the accuracy",
        searches="dates",
    ),
    Cause(
        "sensor_response", "the humidity sensor follows more slowly than the case states",
        "clean or replace its filter; state its response time in the case",
        "a second, bare humidity sensor beside it",
        response, alone=ODD,
        forms="a humidity sensor that follows more slowly than the case states; where nothing is stated, "
        "the fit estimates it",
    ),
    Cause(
        "clock_shift", "one source's clock is off",
        "set the clock, or state the zone and the stamp of the source",
        "an event that all sources see", clock, alone=ODD,
        forms="one source's stamps, constant or in summer time; of two sources only the difference shows",
        searches="shifts, to a quarter of a minute",
    ),
    Cause(
        "rain_ingress", "rain enters and evaporates",
        "find where the water enters: door, cable entry, roof",
        "a wetness sensor on the floor", rain, needs="rain",
        forms="rain, or what of it exceeds 1 mm/h, that enters and evaporates",
    ),
    Cause(
        "door_opening", "the door stood open", "compare with the log of service visits", "a door contact",
        door, alone=ODD, event=True,
        forms="windows of much larger exchange",
        searches="windows, with a price for each",
    ),
    Cause(
        "dehumidifier", "a drier works above a set-point", "find the drier and its set-point; log its state",
        "current of the drier", drier,
        forms=(
            "drying above a set-point, proportional or on/off, cold plate or desiccant, with or without "
            "heat released to the air"
        ),
        searches="set-points",
    ),
    Cause(
        "internal_moisture_source", "water evaporates inside",
        "look for leaks of coolant, wet cable ducts, ground water",
        "absolute humidity inside and outside with the cabinet at ambient temperature", source,
        forms=(
            "vapour release: constant, at standstill, from a wet surface, in the same hours, or drying "
            "out from a date on"
        ),
        searches="dates, hours",
    ),
    Cause(
        "ambient_bias", "the ambient series does not describe the air that enters the cabinet",
        "compare the weather series with a sensor at the air inlet", "temperature and humidity at the inlet",
        breathed,
        forms=(
            "offset of the ambient vapour, temperature or humidity; cabinet intake air that lags the "
            "series; a smoothed series"
        ),
    ),
    # the searches of hours and set-points take longest: they come last, where the time may not suffice
    Cause(
        "unlogged_heater", "a heater that no signal reports runs",
        "find the heater and its thermostat or humidistat; log its state", "current of the heater",
        heater, alone=SWITCHED,
        forms="thermostat or humidistat, at standstill or in any state; in proportion to the temperature",
        searches="set-points",
    ),
    Cause(
        "scheduled_heat", "something releases heat at the same hours of every day, or of every workday",
        "look for lamps, timers and people at work in these hours; log the load",
        "current of the equipment that runs in these hours",
        by_the_clock,
        forms="heat in the same hours of every day, or of every workday (UTC)",
        searches="hours",
    ),
    Cause(
        "cooling_switching", "a fan, a vent or a valve cools the cabinet above a threshold",
        "find the fan, vent or valve and its set-points; log its state", "state of the fan, vent or valve",
        cooling,
        alone=SWITCHED,
        forms="loss of heat above a threshold, with or without exchange of air; a vent that opens in "
        "proportion to temperature or humidity",
        searches="set-points",
    ),
)  # fmt: skip


def named(name: str, library: Sequence[Cause] = LIBRARY) -> Cause:
    """The cause of that identifier."""
    for cause in library:
        if cause.name == name:
            return cause
    raise KeyError(f"no cause {name!r}; the library has {', '.join(c.name for c in library)}")
