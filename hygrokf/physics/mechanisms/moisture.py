"""Further sources, sinks and stores of vapour in the cabinet air."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hygrokf.physics.expression import Value, exp, sqrt
from hygrokf.physics.holds import MEAN
from hygrokf.physics.mechanisms.effects import ABOVE_MINUS_ONE, NONNEGATIVE, effect, lagged_share, named
from hygrokf.physics.mechanisms.hygric import (
    cabinet_humidity,
    cabinet_vapour,
    saturated_vapour,
    saturation_pressure,
    vapour_pressure,
)
from hygrokf.physics.model import Factory, Mechanism, Pair, Space
from hygrokf.physics.parameters import Parameter

if TYPE_CHECKING:
    from hygrokf.data.record import Record

REFERENCE_K = 293.15
"""[K] reference temperature of the sorption time constant."""
ACTIVATION_K = 5300.0
"""[K] activation energy of diffusion divided by the gas constant: 44 kJ/mol; epoxies and polyamides have 40 …
55."""
GAB_C, GAB_K = 8.0, 0.75
"""[1] constants of the GAB isotherm; papers, polyamides and laminates have C from 4 to 15 and K from 0.65 to
0.85."""
GAB_SLOPE = 2.31952
"""[1] slope of this isotherm at 50 %, in monolayers per unit of relative humidity."""
GAB_ENDS = (6.0, 12.134375)
"""[1] slopes of this isotherm at 0 and 100 %; beyond both ends it continues as a straight line."""
ROUNDED = 0.003
"""[1] relative humidity over which both ends are rounded."""
VAPOUR_BALANCE = "balance of vapour mass"
PLATE = 4.85
"""[g/m³] vapour concentration over water at the freezing point: the limit of a cold-plate drier."""
BULK = {"sorbed_water": (1.0, 1.0)}
SLAB = {"sorbed_water": (0.892, 1.2), "sorbed_skin": (0.108, 62.7)}
"""Stores of water: state -> (share of the content, rate relative to 1/time constant), for thin material and
for a slab.

The two stores of a slab reproduce tanh(√s)/√s, the uptake by Fick's law, within 13 % (root mean square) from
0.3 to 100 times the slab's own frequency.
"""
ROUNDED_FILM = 0.01
"""[g/m³] film over which the size |m| of the film is rounded."""
ROUNDED_VAPOUR = 0.05
"""[g/m³] vapour concentration over which the transition between condensing and drying is rounded."""


def twice_positive(value: Value, width: float) -> Value:
    """2 max(0, value), its edge rounded over `width`."""
    return value + sqrt(value * value + width * width)


def moisture_sorption(activated: bool = True, slab: bool = False) -> Mechanism:
    """Hygroscopic material in the cabinet: it takes up water with relative humidity and gives it back when
    heated.

        dwᵢ/dt = rᵢ (aᵢ W g(h) − wᵢ)/θ(T),    g(h) = φ(h)/φ′(½),    φ(h) = C K h/((1 − K h)(1 − K h + C K h)),
        θ(T) = θ₂₀ exp(5300 K (1/T − 1/293.15 K))  (θ₂₀ throughout without `activated`),    vapour release −Σ
        dwᵢ/dt,
    Σ wᵢ [g/m³] is the water held per volume of cabinet air, h the relative humidity at the air temperature T,
    θ₂₀ [h] the time constant at 20 °C.  W [g/m³] is the moisture capacity: water per unit of relative
    humidity, the isotherm's slope at 50 %. C = 8, K = 0.75; below 0 and above 100 % φ continues straight.  A
    record determines this slope; the content itself depends on the assumed isotherm by ± 20 %.

    Thin material is a single store with a = r = 1.  A `slab`, into which water diffuses from its faces, has a
    skin that responds first and a slow remainder; θ = 4 L²/(π² D) is the time constant of its slowest mode.
    A record of some weeks determines W/√θ better than W or θ alone.
    """
    stores = SLAB if slab else BULK

    def isotherm(h: Value) -> Value:
        """The isotherm [1], scaled to a slope of 1 at 50 %."""
        return _gab(h) / GAB_SLOPE

    def rates(p: Space, x: Space, u: Space, q: Space) -> dict[str, Value]:
        air = q.cabinet_air_temperature
        time = p.sorption_time
        if activated:
            time = time * exp(ACTIVATION_K * (1.0 / air - 1.0 / REFERENCE_K))
        content = p.sorption_capacity * isotherm(cabinet_humidity(x, u, q))
        return {n: (share * content - getattr(x, n)) * (pace / time) for n, (share, pace) in stores.items()}

    def initial(p: Space, u: Space) -> dict[str, Pair]:
        kelvin = u.ambient_temperature
        pressure = vapour_pressure(u.ambient_absolute_humidity, kelvin)
        content = p.sorption_capacity * isotherm(pressure / saturation_pressure(kelvin + 6.0))
        return {
            n: (share * content, 0.1 * (share * content) * (share * content))
            for n, (share, _) in stores.items()
        }

    return Mechanism(
        name="moisture_sorption",
        parameters=(
            Parameter(
                "sorption_capacity", "g/m3", 8.0, 1e-3, 10000.0, positive=True, null=0.0,
                meaning="moisture capacity at 50 %: water for each unit of relative humidity, per volume of "
                        "cabinet air",
            ),
            Parameter(
                "sorption_time", "h", *((40.0, 4.0, 4000.0) if slab else (10.0, 1.0, 400.0)), positive=True,
                meaning="time constant of the water uptake at 20 °C",
            ),
        ),
        states=tuple(stores),
        amounts=tuple(stores),
        inputs=("ambient_temperature", "ambient_absolute_humidity"),
        contributions=lambda p, x, u, q: {"vapour_release": -sum(rates(p, x, u, q).values())},
        drift=lambda p, x, u, q, s: rates(p, x, u, q),
        initial=initial,
        settings={"activated": activated, "slab": slab},
        meaning="water taken up and given back by hygroscopic material",
        leaves="too little vapour when the cabinet warms after a long damp standstill, too much while it "
               "stands",
        source="isotherm of Guggenheim, Anderson and de Boer; linear driving force (Glueckauf 1955); slab: "
               "Crank (1975)",
    )  # fmt: skip


def _gab(h: Value) -> Value:
    """Isotherm of Guggenheim, Anderson and de Boer, in monolayers; continued straight below 0 and above 100
    %.

    The isotherm itself has poles at −19 and 133 % and the wrong sign beyond them, and nothing keeps the
    humidity of a free run between them.
    """
    below, above = 0.5 * twice_positive(-h, ROUNDED), 0.5 * twice_positive(h - 1.0, ROUNDED)
    wet = GAB_K * (h + below - above)
    inner = GAB_C * wet / ((1.0 - wet) * (1.0 - wet + GAB_C * wet))
    return inner - GAB_ENDS[0] * below + GAB_ENDS[1] * above


def condensation(sky: bool = False) -> Mechanism:
    """A water film on a surface colder than the dew point, which evaporates later.

        dT_s/dt = (T_amb − δ s + κ (T_a − T_amb) − T_s)/θ_s,    x = c* − e_s(T_s)/(R_v T_amb),
        dm/dt = β max(0, x) − β max(0, −x) · m/(|m| + 1 g/m³);    vapour release −dm/dt,
    m ≥ 0 [g/m³] is the film per volume of cabinet air, θ_s [h] the lag of the surface, δ [K] its cooling
    below the air by radiation: always (s = 1), or with `sky` in proportion to the input `night_sky`.  The
    last gram stands in drops whose area shrinks with them.  The edges of max are rounded over 0.05 g/m³.
    """

    def rate(p: Space, x: Space, u: Space, q: Space) -> Value:
        excess = x.vapour - saturated_vapour(x.surface_temperature, u.ambient_temperature)
        condensing, drying = (
            0.5 * twice_positive(excess, ROUNDED_VAPOUR),
            0.5 * twice_positive(-excess, ROUNDED_VAPOUR),
        )
        # the filter may estimate a slightly negative film; this term then pulls it back to zero
        wet_share = x.film / (1.0 + sqrt(x.film * x.film + ROUNDED_FILM * ROUNDED_FILM))
        return p.condensation_rate * (condensing - drying * wet_share)

    def surface(p: Space, x: Space, u: Space, q: Space) -> Value:
        target = u.ambient_temperature + p.surface_share * (q.cabinet_air_temperature - u.ambient_temperature)
        undercooling = p.surface_undercooling * (u.night_sky if sky else 1.0)
        return (target - undercooling - x.surface_temperature) / p.surface_time

    return Mechanism(
        name="condensation",
        parameters=(
            Parameter(
                "condensation_rate", "1/h", 0.3, 1e-4, 4.0, positive=True, null=0.0,
                meaning="vapour transfer to the film, per volume of cabinet air",
            ),
            Parameter("surface_time", "h", 3.0, 0.3, 72.0, positive=True, meaning="lag of the cold surface"),
            Parameter(
                "surface_share", "1", 0.05, 0.0, 0.9, physical=(0.0, 1.0),
                meaning="how far the cold surface follows the cabinet air instead of the ambient",
            ),
            Parameter(
                "surface_undercooling", "K", 1.0, 0.0, 12.0, physical=NONNEGATIVE,
                meaning="how far the surface cools below its surroundings by radiation",
            ),
        ),
        states=("film", "surface_temperature"),
        amounts=("film",),
        inputs=("ambient_temperature", *(("night_sky",) if sky else ())),
        contributions=lambda p, x, u, q: {"vapour_release": -rate(p, x, u, q)},
        drift=lambda p, x, u, q, s: {"film": rate(p, x, u, q), "surface_temperature": surface(p, x, u, q)},
        initial=lambda p, u: {"film": (0.0, 0.0), "surface_temperature": (u.ambient_temperature + 1.0, 4.0)},
        settings={"sky": sky},
        meaning="condensate on a cold surface",
        leaves="humidity capped at a cold surface's dew point, then too little vapour when it warms",
        source="mass transfer by the Lewis analogy; film and surface of first order",
    )  # fmt: skip


def fading(record: Record, time: np.ndarray, date_s: float, days: float) -> np.ndarray:
    """0 before a date [s], then 1, decaying with the time constant `days`."""
    return np.where(time > date_s, np.exp(-np.maximum(time - date_s, 0.0) / (days * 86400.0)), 0.0)


def internal_moisture_source(when: str = "always") -> Mechanism:
    """A vapour source in the cabinet [g/(m³ h)].

    `when` is "always", "standstill", "fading" (from a date on) or "scheduled" (by time of day).
    """
    return effect(
        "internal_moisture_source", "vapour_release",
        Parameter(
            "moisture_source", "g/m3/h", 0.1, 1e-4, 50.0, positive=True, null=0.0,
            meaning="vapour released per volume of cabinet air",
        ),
        *(() if when == "always" else (when,)),
        features={"fading": (fading, MEAN)},
        settings={"when": when},
        meaning="water that evaporates inside",
        leaves="absolute humidity above the ambient humidity, the more the slower the exchange",
        source=VAPOUR_BALANCE,
    )  # fmt: skip


def wet_surface() -> Mechanism:
    """A wet surface at cabinet air temperature that releases or absorbs vapour: vapour release k (c_sat(T_a)
    − c).

    k [1/h] is the volume of air saturated per hour and volume of cabinet; c_sat and c [g/m³] are the vapour
    concentrations of saturated air and of the cabinet air.  Examples: open water, a wet wall, soil, plants.
    """

    def saturation_deficit(x: Space, u: Space, q: Space) -> Value:
        air = q.cabinet_air_temperature
        return saturated_vapour(air, air) - cabinet_vapour(x, u, q)

    return effect(
        "wet_surface", "vapour_release",
        Parameter(
            "evaporation_rate", "1/h", 0.05, 1e-4, 100.0, positive=True, null=0.0,
            meaning="air that a wet surface saturates each hour, per volume of cabinet air",
        ),
        saturation_deficit, inputs=("ambient_temperature",),
        meaning="water that evaporates from a wet surface",
        leaves="absolute humidity above the ambient humidity, the more the warmer and drier the cabinet is",
        source="Dalton's law of evaporation",
    )  # fmt: skip


def rain_ingress() -> Mechanism:
    """Rain that enters, is stored and evaporates with a delay.

    dr/dt = a · rain − r/θ,    vapour release r/θ,    r [g/m³], θ [h].
    """
    return Mechanism(
        name="rain_ingress",
        parameters=(
            Parameter(
                "rain_intake", "g/m3/h", 1.0, 1e-4, 500.0, positive=True, null=0.0,
                meaning="water that enters per volume of cabinet air while the rain signal is 1",
            ),
            Parameter("rain_drying_time", "h", 6.0, 0.5, 100.0, positive=True, meaning="time to evaporate"),
        ),
        states=("rain_water",),
        amounts=("rain_water",),
        inputs=("rain",),
        contributions=lambda p, x, u, q: {"vapour_release": x.rain_water / p.rain_drying_time},
        drift=lambda p, x, u, q, s: {
            "rain_water": p.rain_intake * u.rain - x.rain_water / p.rain_drying_time
        },
        initial=lambda p, u: {"rain_water": (0.0, 0.0)},
        meaning="rain water that enters and evaporates",
        leaves="humidity above the simulated for hours after rain",
        source="balance of water with a first-order delay",
    )  # fmt: skip


def _above_plate(x: Space, u: Space, q: Space) -> Value:
    """Vapour of the cabinet air in excess of saturation over a plate at the freezing point [g/m³], at least
    0; rounded over 0.05."""
    return 0.5 * twice_positive(cabinet_vapour(x, u, q) - PLATE, ROUNDED_VAPOUR)


def switched_drying(plate: bool = True, flag: str = "throttled_drying") -> Mechanism:
    """A drier that no signal reports (input `throttled_drying`): vapour release −d · throttled_drying · c,
    d [1/h] the air dried per hour.

    c [g/m³] is the vapour of the cabinet air, all of which a desiccant takes; with `plate` only the excess
    over the 4.85 g/m³ above a plate at the freezing point.
    """
    return effect(
        "switched_drying", "vapour_release",
        Parameter(
            "drying_rate", "1/h", 0.1, 1e-5, 50.0, positive=True, null=0.0,
            meaning="air dried each hour, per volume of cabinet air, while the drier runs",
        ),
        flag, _above_plate if plate else cabinet_vapour,
        negative=True, inputs=("ambient_temperature", flag), settings={"plate": plate, "flag": flag},
        meaning="drying while the drier runs",
        leaves="simulated humidity too high above a set-point",
        source=VAPOUR_BALANCE,
    )  # fmt: skip


def dehumidifier_drying() -> Mechanism:
    """Drying by a logged dehumidifier: vapour release −d · `dehumidifier_duty` · c.

    d [1/h] is the volume of air dried per hour at full duty and per volume of cabinet air; c [g/m³] the
    vapour of the cabinet air.
    """
    return effect(
        "dehumidifier_drying", "vapour_release",
        Parameter(
            "logged_drying_rate", "1/h", 0.0, 0.0, 50.0, null=0.0, physical=NONNEGATIVE,
            meaning="air dried each hour, per volume of cabinet air, at full duty of the logged dehumidifier",
        ),
        "dehumidifier_duty", cabinet_vapour,
        negative=True, inputs=("ambient_temperature", "dehumidifier_duty"),
        meaning="drying by the logged dehumidifier",
        leaves="simulated humidity too high while the dehumidifier runs",
        source=VAPOUR_BALANCE,
    )  # fmt: skip


def _exchange_factory(
    name: str, parameter: str, flag: str, upper: float, when: str, leaves: str, lower: float = -0.95
) -> Factory:
    """Vapour exchange multiplied by 1 + b · flag, b > −1; with `lower` = 0, b ≥ 0."""

    def factory(flag: str = flag) -> Mechanism:
        return effect(
            name, "exchange",
            Parameter(
                parameter, "1", 0.0, lower, upper, null=0.0,
                physical=NONNEGATIVE if lower == 0 else ABOVE_MINUS_ONE,
                meaning=f"relative change of the vapour exchange, {when}",
            ),
            flag,
            settings={"flag": flag}, meaning=f"vapour exchange, {when}", leaves=leaves,
            source="resistance R_D* of equation (4) divided by the factor",
        )  # fmt: skip

    return named(name, f"Vapour exchange {when}: multiplied by 1 + b · `{flag}`.", factory)


fan_exchange = _exchange_factory(
    "fan_exchange", "fan_exchange", "fan_duty", 500.0, "at full duty of the logged fan",
    "humidity that follows the ambient humidity faster while the fan runs", 0.0,
)  # fmt: skip
wind_exchange = _exchange_factory(
    "wind_exchange", "wind_exchange_gain", "wind_tenth", 50.0, "at 10 m/s of wind",
    "humidity that follows the ambient humidity faster in wind than in calm",
)  # fmt: skip
stepped_exchange = _exchange_factory(
    "stepped_exchange", "exchange_change", "after_step", 50.0, "from the date on",
    "humidity that follows the ambient humidity faster or slower from a date on",
)  # fmt: skip
open_exchange = _exchange_factory(
    "open_exchange", "door_exchange", "door_open", 500.0, "while the door is open",
    "stretches of hours in which the humidity is the ambient humidity",
)  # fmt: skip
vent_exchange = _exchange_factory(
    "vent_exchange", "vent_exchange", "venting", 500.0, "while the vent is open",
    "humidity that follows the ambient humidity faster while the vent is open", 0.0,
)  # fmt: skip


def breathed_air(form: str = "vapour") -> Mechanism:
    """Air drawn into the cabinet that differs from the ambient series: ambient_vapour += o g.

    g by `form`: "vapour" 1 g/m³; "temperature" c_amb (a thermometer error of 1 K amounts to 6 %); "humidity"
    the saturation concentration at ambient temperature.
    """
    unit, bound = ("g/m3", 10.0) if form == "vapour" else ("1", 0.6)
    name = {
        "vapour": "breathed_offset", "temperature": "breathed_gain", "humidity": "breathed_humidity_offset",
    }[form]  # fmt: skip
    meaning = {
        "vapour": "excess of the breathed air's vapour over the ambient series",
        "temperature": "share by which the ambient series understates the vapour of the breathed air",
        "humidity": "what the relative humidity of the ambient series lacks",
    }[form]

    def scale(x: Space, u: Space, q: Space) -> Value:
        if form == "humidity":
            return saturated_vapour(u.ambient_temperature, u.ambient_temperature)
        return 1.0 if form == "vapour" else u.ambient_absolute_humidity

    return effect(
        "breathed_air", "ambient_vapour",
        Parameter(name, unit, 0.0, -bound, bound, null=0.0, meaning=meaning),
        scale,
        inputs=("ambient_absolute_humidity", *(("ambient_temperature",) if form == "humidity" else ())),
        settings={"form": form},
        meaning="the breathed air differs from the ambient series",
        leaves="an offset of the absolute humidity",
        source="the ambient sensors' own errors",
    )  # fmt: skip


def breathed_lag() -> Mechanism:
    """A share w of the air drawn in lags the ambient series: ambient_vapour += w (L − c_amb), dL/dt = (c_amb
    − L)/θ."""
    return lagged_share(
        "breathed_lag", "ambient_vapour", "ambient_absolute_humidity", "breathed_vapour",
        Parameter("breathed_lag_share", "1", 0.0, -0.2, 1.2, null=0.0,
                  meaning="share of the breathed air that lags the ambient series"),
        Parameter("breathed_lag_time", "h", 3.0, 0.25, 24.0, positive=True,
                  meaning="time constant of the lag"),
        0.25, amount=True,
        meaning="the breathed air lags the ambient series",
        leaves="an error that follows the rate of the ambient humidity",
    )  # fmt: skip


def breathed_lead() -> Mechanism:
    """Ambient series smoothed by a first-order lag θ, unlike the air drawn in: ambient_vapour += θ dc_amb/dt.

    θ [h]; the rate is the input `ambient_vapour_rate` [g/(m³ h)].
    """
    return effect(
        "breathed_lead", "ambient_vapour",
        Parameter("breathed_lead", "h", 0.0, -2.0, 24.0, null=0.0,
                  meaning="time by which the series is smoothed"),
        "ambient_vapour_rate",
        meaning="the ambient humidity is smoothed, the breathed air is not",
        leaves="an error that follows the rate of the ambient humidity",
        source="inverse of a first-order lag",
    )  # fmt: skip


# fmt: off
LOGGED = (fan_exchange, open_exchange, dehumidifier_drying)
FURTHER = (
    moisture_sorption, condensation, internal_moisture_source, wet_surface, rain_ingress,
    switched_drying, wind_exchange, stepped_exchange, vent_exchange, breathed_air, breathed_lag,
    breathed_lead,
)
# fmt: on
