"""Further sources and losses of heat in the cabinet."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hygrokf.physics.expression import Given, Value
from hygrokf.physics.holds import LINEAR
from hygrokf.physics.mechanisms.effects import ABOVE_MINUS_ONE, NONNEGATIVE, effect, lagged_share, named
from hygrokf.physics.model import Factory, Mechanism, Space, Values
from hygrokf.physics.parameters import Parameter

if TYPE_CHECKING:
    from hygrokf.data.record import Record


def solar_gain(lagged: bool = False, flag: str = "sunshine") -> Mechanism:
    """Solar heat on cabinet, tower or wall: f += a G, with `lagged` through a thermal mass; a [K/(kW/m²)], G
    [kW/m²].

    Lag: dG'/dt = (G − G')/θ, θ [h].  `flag` is "sunshine" for the horizontal plane or "sunlit_wall" for a
    wall with a stated orientation.
    """

    def contributions(p: Space, x: Space, u: Space, q: Space) -> Values:
        return {"heat_release": p.solar_heat * (x.stored_sun if lagged else getattr(u, flag))}

    def drift(p: Space, x: Space, u: Space, q: Space, s: Space) -> Values:
        return {"stored_sun": (getattr(u, flag) - x.stored_sun) / p.solar_time}

    heat = Parameter(
        "solar_heat", "K/(kW/m2)", 1.0, 1e-3, 100.0, positive=True, null=0.0,
        meaning="heat release for each kW/m² of sun",
    )  # fmt: skip
    lag = Parameter(
        "solar_time", "h", 2.0, 0.25, 24.0, positive=True, meaning="lag of the mass that it warms"
    )
    return Mechanism(
        name="solar_gain",
        parameters=(heat, lag) if lagged else (heat,),
        states=("stored_sun",) if lagged else (),
        inputs=(flag,),
        contributions=contributions,
        drift=drift if lagged else None,
        initial=(lambda p, u: {"stored_sun": (getattr(u, flag), 0.01)}) if lagged else None,
        settings={"lagged": lagged, "flag": flag},
        meaning="heat of the sun",
        leaves="a cabinet that is too warm on clear days, in the afternoon",
        source="sol-air temperature (ASHRAE Fundamentals) with a first-order wall",
    )


def _driven_heat(name: str, parameter: str, flag: str, when: str, leaves: str, remark: str = "") -> Factory:
    """Heat release proportional to an input: f += a · flag, a ≥ 0 [K]."""

    def factory(flag: str = flag) -> Mechanism:
        return _scaled_heat(name, parameter, flag, 1.0, when, leaves, {"flag": flag})

    return named(name, f"Heat release {when}{remark}: f += a · `{flag}`, a ≥ 0 [K].", factory)


def _scaled_heat(
    name: str, parameter: str, signal: str, full: float, when: str, leaves: str, settings: Mapping[str, Any]
) -> Mechanism:
    """Heat release in proportion to a logged signal: f += a · signal/full [K]."""
    scale, meaning = Given(1.0 / full), f"heat release {when}"
    return effect(
        name, "heat_release",
        Parameter(parameter, "K", 0.0, 0.0, 80.0, null=0.0, physical=NONNEGATIVE, meaning=meaning),
        lambda x, u, q: scale * getattr(u, signal),
        inputs=(signal,), settings=settings, meaning=meaning, leaves=leaves, source="balance of heat",
    )  # fmt: skip


def logged_heater(signal: str = "heater_duty", full: float = 1.0) -> Mechanism:
    """Heat of a logged heater: f += a · signal/full [K].

    `signal` is "heater_duty" [1] or "heater_power" [W]; at the value `full`, in the signal's unit, the
    release is a.
    """
    when = "at full duty" if signal == "heater_duty" else f"at {full:.4g} W"
    return _scaled_heat(
        "logged_heater", "logged_heater_heat", signal, full, f"of the logged heater {when}",
        "a cabinet that is too warm while the heater runs", {"signal": signal, "full": full},
    )  # fmt: skip


POWER_AND_CONDENSATION = ", its electric power and the heat of condensation"
unreported_heater = _driven_heat(
    "unreported_heater", "heater_heat", "throttled_heating", "while the unreported heater runs",
    "a cabinet that is too warm in the simulation when it is cold or damp",
)  # fmt: skip
scheduled_heat = _driven_heat(
    "scheduled_heat", "scheduled_heat", "scheduled", "in the hours in which it is on",
    "a temperature error in the same hours of every day, or of every workday",
    " every day: lamps, people at work, a load on a timer",
)  # fmt: skip
dehumidifier_heat = _driven_heat(
    "dehumidifier_heat", "dehumidifier_heat", "dehumidifier_duty",
    "of the logged dehumidifier at full duty",
    "a cabinet that is too warm while the dehumidifier runs", POWER_AND_CONDENSATION,
)  # fmt: skip
drying_heat = _driven_heat(
    "drying_heat", "drying_heat", "throttled_drying", "while the unreported drier runs",
    "a cabinet that is too warm in the simulation when it is damp", POWER_AND_CONDENSATION,
)  # fmt: skip


def since(record: Record, time: np.ndarray, date_s: float, days: float) -> np.ndarray:
    """0 before a date [s], then approaching 1 with the time constant `days`."""
    return 1.0 - np.exp(-np.maximum(time - date_s, 0.0) / (days * 86400.0))


def release_drift(order: int = 0, operation: bool = False, flag: str = "elapsed") -> Mechanism:
    """Heat release that drifts with time: f += a · flag · f₀ [K], f₀ the base model's own heat release in
    operation.

    `order` and `operation` are the settings of the base heat release: f₀ = a₀ + Σ a_k p^k while the turbine
    operates, or the standstill heat release in a model without operation.  `flag` is "elapsed" (share of the
    record that has passed) or "since" (a course that starts at a date and saturates).
    """
    powers = [f"power_{k}" for k in range(1, order + 1)] if operation else []

    def base_release(p: Space, u: Space) -> Value:
        if not operation:
            return p.heat_release_standstill
        total = p.heat_release_operation * u.operating
        for name in powers:
            total = total + getattr(p, f"heat_release_{name}") * getattr(u, name)
        return total

    return Mechanism(
        name="release_drift",
        parameters=(
            Parameter(
                "heat_drift", "1", 0.0, -0.95, 10.0, null=0.0, physical=ABOVE_MINUS_ONE,
                meaning="relative change of the heat release at the end of the record",
            ),
        ),
        inputs=(flag, *(("operating", *powers) if operation else ())),
        contributions=lambda p, x, u, q: {
            "heat_release": p.heat_drift * getattr(u, flag) * base_release(p, u)
        },
        features={"since": (since, LINEAR)},
        settings={"order": order, "operation": operation, "flag": flag},
        meaning="heat release that drifts with time",
        leaves="a temperature error that grows with time, in operation",
        source="balance of heat",
    )  # fmt: skip


def _conductance(parameter: str, when: str, lower: float = 0.0) -> Parameter:
    """A conductance between cabinet air and ambient in parallel to 1/R_AT, in units of 1/R_AT."""
    physical = NONNEGATIVE if lower == 0 else ABOVE_MINUS_ONE
    meaning = f"conductance to the ambient beside 1/R_AT, {when}"
    return Parameter(parameter, "1", 0.0, lower, 50.0, null=0.0, physical=physical, meaning=meaning)


PARALLEL = "conductance parallel to R_AT"


def _loss(name: str, parameter: str, flag: str, when: str, leaves: str, lower: float = 0.0) -> Factory:
    """Conductance between cabinet air and ambient in parallel to 1/R_AT and in units of 1/R_AT: g · flag."""

    def factory(flag: str = flag) -> Mechanism:
        return Mechanism(
            name=name,
            parameters=(_conductance(parameter, when, lower),),
            inputs=(flag,),
            conductance=lambda p, u: getattr(p, parameter) * getattr(u, flag),
            settings={"flag": flag},
            meaning=f"heat lost to the ambient, {when}",
            leaves=leaves,
            source=PARALLEL,
        )

    return named(
        name, f"Heat lost to the ambient, {when}: a conductance g · `{flag}` beside 1/R_AT.", factory
    )


def _converter_loss(name: str, parameter: str, flag: str, when: str, leaves: str, reason: str) -> Factory:
    """Heat removed from the converter itself: f −= g · flag · (T_a − T_amb)."""

    def factory(flag: str = flag) -> Mechanism:
        return effect(
            name, "heat_release", _conductance(parameter, when),
            flag, lambda x, u, q: q.cabinet_air_temperature - u.ambient_temperature,
            negative=True, inputs=("ambient_temperature", flag), settings={"flag": flag},
            meaning=f"heat lost to the ambient, {when}", leaves=leaves, source=PARALLEL,
        )  # fmt: skip

    docstring = f"""Heat lost by the converter to the ambient, {when}: f −= g · `{flag}` · (T_a − T_amb).

    The converter's excess over the ambient temperature is that of the air divided by ρ.  {reason}
    """
    return named(name, docstring, factory)


wind_loss = _loss(
    "wind_loss", "wind_conductance", "wind_tenth", "at 10 m/s of wind",
    "a cabinet that is too warm in calm and too cold in wind", -0.6,
)  # fmt: skip
stepped_loss = _loss(
    "stepped_loss", "conductance_change", "after_step", "from the date on",
    "a temperature error that begins at a date and grows with the heat release", -0.9,
)  # fmt: skip
fan_loss = _loss(
    "fan_loss", "fan_conductance", "fan_duty", "at full duty of the logged fan",
    "a cabinet that is too warm in the simulation while the fan runs",
)  # fmt: skip
open_loss = _loss(
    "open_loss", "door_conductance", "door_open", "while the door is open",
    "stretches of hours in which the temperature falls toward the ambient temperature",
)  # fmt: skip
vent_loss = _loss(
    "vent_loss", "vent_conductance", "venting", "while the vent is open",
    "a cabinet that is too warm in the simulation while the vent is open",
)  # fmt: skip
pump_loss = _converter_loss(
    "pump_loss", "pump_conductance", "pump_duty", "at full duty of the logged pump",
    "a cabinet that is too warm in the simulation while the pump runs",
    "The coolant is assumed to reach ambient temperature before it returns.",
)  # fmt: skip
throttled_cooling_loss = _converter_loss(
    "throttled_cooling_loss", "throttled_conductance", "venting", "at full cooling",
    "a cabinet that is too warm in the simulation above a threshold",
    "Heat taken from the air would make the temperature jump at times that the readings do not determine, "
    "which lowers the likelihood more than missing jumps do.",
)  # fmt: skip


def throttled_cooling() -> Mechanism:
    """Cooling of constant capacity in proportion to the temperature above a threshold (input `venting`):
    f −= a · venting [K]."""
    return effect(
        "throttled_cooling", "heat_release",
        Parameter("cooling_capacity", "K", 0.0, 0.0, 80.0, null=0.0, physical=NONNEGATIVE,
                  meaning="heat that the cooling removes at full capacity"),
        "venting", negative=True,
        meaning="cooling of constant capacity above a threshold",
        leaves="a cabinet that is too warm in the simulation above a threshold",
        source="balance of heat",
    )  # fmt: skip


def lagged_ambient() -> Mechanism:
    """Air around the cabinet that lags the ambient series: a share w follows a first-order lag, f += w (L −
    T_amb) [K].

    dL/dt = (T_amb − L)/θ,    θ [h].
    """
    return lagged_share(
        "lagged_ambient", "heat_release", "ambient_temperature", "ambient_lag",
        Parameter("ambient_lag_share", "1", 0.0, -0.2, 1.2, null=0.0,
                  meaning="share of the air around the cabinet that lags the ambient series"),
        Parameter("ambient_lag_time", "h", 3.0, 0.25, 24.0, positive=True,
                  meaning="time constant of the lag"),
        4.0,
        meaning="air around the cabinet that lags the ambient series",
        leaves="a temperature error that follows the rate of the ambient temperature",
    )  # fmt: skip


def leading_ambient() -> Mechanism:
    """Ambient series smoothed by a first-order lag θ, unlike the air around the cabinet: f += θ dT_amb/dt
    [K].

    θ [h]; the rate is the input `ambient_temperature_rate` [K/h].
    """
    return effect(
        "leading_ambient", "heat_release",
        Parameter("ambient_lead", "h", 0.0, -2.0, 24.0, null=0.0,
                  meaning="time by which the series is smoothed"),
        "ambient_temperature_rate",
        meaning="the ambient temperature is smoothed, the air around the cabinet is not",
        leaves="a temperature error that follows the rate of the ambient temperature",
        source="inverse of a first-order lag",
    )  # fmt: skip


# fmt: off
LOGGED = (logged_heater, dehumidifier_heat, fan_loss, pump_loss, open_loss)
FURTHER = (
    solar_gain, unreported_heater, drying_heat, scheduled_heat, release_drift, wind_loss, stepped_loss,
    throttled_cooling_loss, throttled_cooling, vent_loss, lagged_ambient, leading_ambient,
)
# fmt: on
