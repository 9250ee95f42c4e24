"""Properties of the cabinet as slowly varying states, for tracking.

Each state is a random walk, dx = r/√24 dW, with the rate r per √day: after d days without readings its
standard deviation is r √d.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hygrokf.physics.expression import exp
from hygrokf.physics.mechanisms.effects import PAPER, named
from hygrokf.physics.mechanisms.hygric import cabinet_humidity, saturated_vapour
from hygrokf.physics.mechanisms.sensors import HUMIDITY_READING, OWN_ERROR, TEMPERATURE_READING
from hygrokf.physics.model import Factory, Mechanism, Space, Values
from hygrokf.physics.parameters import Parameter


def _random_walk(
    name: str,
    state: str,
    unit: str,
    rate: float,
    bounds: tuple[float, float],
    meaning: str,
    leaves: str,
    source: str,
    inputs: tuple[str, ...] = (),
    **mechanism_fields: Any,
) -> Mechanism:
    """A state with rate 0, driven by white noise; `mechanism_fields`: its effect on named sums or on inputs,
    and further fields of the mechanism."""
    parameter = f"{state}_rate"
    return Mechanism(
        name=name,
        parameters=(
            Parameter(
                parameter, f"{unit}/d^0.5", rate, *bounds, positive=True, null=0.0, noise=True,
                meaning=f"how fast it wanders: {meaning}",
            ),
        ),
        states=(state,),
        inputs=inputs,
        drift=lambda p, x, u, q, s: {state: 0.0 * getattr(x, state)},
        diffusion=lambda p: {state: getattr(p, parameter) * getattr(p, parameter) / 24.0},
        # the variance of one day: the fit's standard error is far below it
        initial=lambda p, u: {state: (0.0, getattr(p, parameter) * getattr(p, parameter))},
        meaning=meaning,
        leaves=leaves,
        source=source,
        **{"settings": {"rate": rate}, **mechanism_fields},
    )  # fmt: skip


def _random_walk_factory(
    name: str,
    state: str,
    unit: str,
    usual_rate: float,
    bounds: tuple[float, float],
    summary: str,
    meaning: str,
    leaves: str,
    source: str,
    inputs: tuple[str, ...] = (),
    **effects: Callable[..., Values],
) -> Factory:
    """A factory of `_random_walk` with the setting `rate`, and with a docstring that begins with
    `summary`."""

    def factory(rate: float = usual_rate) -> Mechanism:
        return _random_walk(name, state, unit, rate, bounds, meaning, leaves, source, inputs, **effects)

    return named(name, f"{summary}, x a random walk of `rate` [{'' if unit == '1' else unit} / √d].", factory)


wandering_time_constant = _random_walk_factory(
    "wandering_time_constant", "log_thermal_change", "1", 0.02, (1e-4, 1.0),
    "The thermal time constant as a state: τ(t) = τ e^x",
    "logarithm of the thermal time constant over that of the fit",
    "innovations after every change of power that grow with a change of the cabinet",
    f"{PAPER}, equation (2) with R C that varies",
    contributions=lambda p, x, u, q: {"thermal_pace": exp(-x.log_thermal_change) - 1.0},
)  # fmt: skip
wandering_exchange = _random_walk_factory(
    "wandering_exchange", "log_hygric_change", "1", 0.02, (1e-4, 1.0),
    "The hygric time constant as a state: k(t) = k e^x",
    "logarithm of k of equation (4) over that of the fit",
    "humidity that follows the ambient humidity faster or slower than before",
    f"{PAPER}, equation (4) with R_D* that varies",
    contributions=lambda p, x, u, q: {"exchange": exp(-x.log_hygric_change) - 1.0},
)  # fmt: skip
wandering_release = _random_walk_factory(
    "wandering_release", "release_change", "K", 0.1, (1e-3, 5.0),
    "An offset of the heat release as a state: f + x [K]",
    "change of the heat release since the fit",
    "a temperature that is off by the same amount for days",
    "balance of heat",
    contributions=lambda p, x, u, q: {"heat_release": x.release_change},
)  # fmt: skip
wandering_temperature_reading = _random_walk_factory(
    "wandering_temperature_reading", "temperature_reading_change", "K", 1e-4, (1e-6, 5.0),
    "An offset of the temperature reading as a state: T + x [K]",
    "change of the temperature sensor's offset since the fit",
    "a temperature reading that is off by the same amount for days, and humidity that does not follow it",
    OWN_ERROR,
    contributions=lambda p, x, u, q: {TEMPERATURE_READING: x.temperature_reading_change},
)  # fmt: skip
wandering_humidity_reading = _random_walk_factory(
    "wandering_humidity_reading", "humidity_reading_change", "1", 0.005, (1e-6, 0.2),
    "An offset of the humidity reading as a state: h + x [1]",
    "change of the humidity sensor's offset since the fit",
    "a humidity reading that is off by the same amount for days",
    OWN_ERROR,
    contributions=lambda p, x, u, q: {HUMIDITY_READING: x.humidity_reading_change},
)  # fmt: skip
wandering_humidity_scale = _random_walk_factory(
    "wandering_humidity_scale", "humidity_scale_change", "1", 0.01, (1e-7, 0.5),
    "The scale of the humidity reading as a state: h (1 + x)",
    "change of the humidity sensor's scale since the fit",
    "a humidity reading that varies too little or too much for days",
    OWN_ERROR, ("ambient_temperature",),
    contributions=lambda p, x, u, q: {HUMIDITY_READING: x.humidity_scale_change * cabinet_humidity(x, u, q)},
)  # fmt: skip


def wandering_ambient_temperature(rate: float = 0.1, relative: bool = True) -> Mechanism:
    """An offset of the ambient's temperature reading as a state: T_amb = reading − x [K], x a random walk of
    `rate` [K/√d].

    `relative`: whether the ambient's humidity was read as relative humidity, so that its vapour follows from
    the temperature.
    """

    def corrections(x: Space, u: Space) -> Values:
        measured, true = u.ambient_temperature, u.ambient_temperature - x.ambient_temperature_change
        if not relative:
            return {"ambient_temperature": true}
        ratio = saturated_vapour(true, true) / saturated_vapour(measured, measured)
        return {"ambient_temperature": true, "ambient_absolute_humidity": ratio * u.ambient_absolute_humidity}

    return _random_walk(
        "wandering_ambient_temperature", "ambient_temperature_change", "K", rate, (1e-6, 5.0),
        "change of the offset of the ambient's temperature sensor since the fit",
        "a temperature reading that is off by the same amount for days",
        OWN_ERROR, ("ambient_temperature", *(("ambient_absolute_humidity",) if relative else ())),
        corrections=corrections, settings={"rate": rate, "relative": relative},
    )  # fmt: skip


wandering_ambient_humidity = _random_walk_factory(
    "wandering_ambient_humidity", "ambient_humidity_change", "1", 0.005, (1e-7, 0.2),
    "An offset of the ambient's humidity reading as a state: relative humidity = reading − x [1]",
    "change of the offset of the ambient's humidity sensor since the fit",
    "a humidity reading that is off for days, the more the warmer the ambient is",
    OWN_ERROR, ("ambient_temperature", "ambient_absolute_humidity"),
    corrections=lambda x, u: {
        "ambient_absolute_humidity": u.ambient_absolute_humidity
        - x.ambient_humidity_change * saturated_vapour(u.ambient_temperature, u.ambient_temperature)
    },
)  # fmt: skip

# fmt: off
WANDERING = (
    wandering_time_constant, wandering_exchange, wandering_release, wandering_temperature_reading,
    wandering_humidity_reading, wandering_humidity_scale, wandering_ambient_temperature,
    wandering_ambient_humidity,
)
# fmt: on
