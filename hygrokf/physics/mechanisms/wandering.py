"""Properties of the cabinet as slowly varying states, for tracking.

Each state is a random walk, dx = r/√24 dW, with the rate r per √day: after d days without readings its
standard deviation is r √d.
"""

from __future__ import annotations

from collections.abc import Callable

from hygrokf.physics.expression import exp
from hygrokf.physics.mechanisms.effects import PAPER
from hygrokf.physics.mechanisms.hygric import cabinet_humidity, saturated_vapour
from hygrokf.physics.mechanisms.sensors import HUMIDITY_READING, OWN_ERROR, TEMPERATURE_READING
from hygrokf.physics.model import Mechanism, Space, Values
from hygrokf.physics.parameters import Parameter


def _random_walk(
    name: str,
    state: str,
    unit: str,
    rate: float,
    bounds: tuple[float, float],
    contributions: Callable[[Space, Space, Space, Space], Values] | None,
    meaning: str,
    leaves: str,
    source: str,
    inputs: tuple[str, ...] = (),
    corrections: Callable[[Space, Space], Values] | None = None,
    **settings: float | bool,
) -> Mechanism:
    """A state without a rate, driven by white noise, and its effect on named sums or on inputs."""
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
        corrections=corrections,
        contributions=contributions,
        drift=lambda p, x, u, q, s: {state: 0.0 * getattr(x, state)},
        diffusion=lambda p: {state: getattr(p, parameter) * getattr(p, parameter) / 24.0},
        # the fit's standard error is far below a day's random walk
        initial=lambda p, u: {state: (0.0, getattr(p, parameter) * getattr(p, parameter))},
        settings={"rate": rate, **settings},
        meaning=meaning,
        leaves=leaves,
        source=source,
    )  # fmt: skip


def wandering_time_constant(rate: float = 0.02) -> Mechanism:
    """The thermal time constant as a state: τ(t) = τ e^x, x a random walk of `rate` [1/√d]."""
    return _random_walk(
        "wandering_time_constant", "log_thermal_change", "1", rate, (1e-4, 1.0),
        lambda p, x, u, q: {"thermal_pace": exp(-x.log_thermal_change) - 1.0},
        "logarithm of the thermal time constant over that of the fit",
        leaves="innovations after every change of power that grow with a change of the cabinet",
        source=f"{PAPER}, equation (2) with R C that varies",
    )  # fmt: skip


def wandering_exchange(rate: float = 0.02) -> Mechanism:
    """The hygric time constant as a state: k(t) = k e^x, x a random walk of `rate` [1/√d]."""
    return _random_walk(
        "wandering_exchange", "log_hygric_change", "1", rate, (1e-4, 1.0),
        lambda p, x, u, q: {"exchange": exp(-x.log_hygric_change) - 1.0},
        "logarithm of k of equation (4) over that of the fit",
        leaves="humidity that follows the ambient's faster or slower than it did",
        source=f"{PAPER}, equation (4) with R_D* that varies",
    )  # fmt: skip


def wandering_release(rate: float = 0.1) -> Mechanism:
    """An offset of the heat release as a state: f + x [K], x a random walk of `rate` [K/√d]."""
    return _random_walk(
        "wandering_release", "release_change", "K", rate, (1e-3, 5.0),
        lambda p, x, u, q: {"heat_release": x.release_change},
        "change of the heat release since the fit",
        leaves="a temperature that is off by the same amount for days",
        source="balance of heat",
    )  # fmt: skip


def wandering_temperature_reading(rate: float = 1e-4) -> Mechanism:
    """An offset of the temperature reading as a state: T + x [K], x a random walk of `rate` [K/√d]."""
    return _random_walk(
        "wandering_temperature_reading", "temperature_reading_change", "K", rate, (1e-6, 5.0),
        lambda p, x, u, q: {TEMPERATURE_READING: x.temperature_reading_change},
        "change of the temperature sensor's offset since the fit",
        leaves="a temperature reading that is off by the same amount for days, and humidity that does not "
               "follow it",
        source=OWN_ERROR,
    )  # fmt: skip


def wandering_humidity_reading(rate: float = 0.005) -> Mechanism:
    """An offset of the humidity reading as a state: h + x [1], x a random walk of `rate` [1/√d]."""
    return _random_walk(
        "wandering_humidity_reading", "humidity_reading_change", "1", rate, (1e-6, 0.2),
        lambda p, x, u, q: {HUMIDITY_READING: x.humidity_reading_change},
        "change of the humidity sensor's offset since the fit",
        leaves="a humidity reading that is off by the same amount for days",
        source=OWN_ERROR,
    )  # fmt: skip


def wandering_humidity_scale(rate: float = 0.01) -> Mechanism:
    """The scale of the humidity reading as a state: h (1 + x), x a random walk of `rate` [1/√d]."""
    return _random_walk(
        "wandering_humidity_scale", "humidity_scale_change", "1", rate, (1e-7, 0.5),
        lambda p, x, u, q: {HUMIDITY_READING: x.humidity_scale_change * cabinet_humidity(x, u, q)},
        "change of the humidity sensor's scale since the fit",
        inputs=("ambient_temperature",),
        leaves="a humidity reading that is too flat or too steep for days",
        source=OWN_ERROR,
    )  # fmt: skip


def wandering_ambient_temperature(rate: float = 0.1, relative: bool = True) -> Mechanism:
    """An offset of the ambient's temperature reading as a state: T_amb = reading − x [K], x a random walk of
    `rate` [K/√d].

    `relative`: whether the ambient's humidity was read as relative humidity, so that its vapour follows from
    the temperature.
    """

    def corrections(x: Space, u: Space) -> Values:
        read, true = u.ambient_temperature, u.ambient_temperature - x.ambient_temperature_change
        if not relative:
            return {"ambient_temperature": true}
        share = saturated_vapour(true, true) / saturated_vapour(read, read)
        return {"ambient_temperature": true, "ambient_absolute_humidity": share * u.ambient_absolute_humidity}

    return _random_walk(
        "wandering_ambient_temperature", "ambient_temperature_change", "K", rate, (1e-6, 5.0), None,
        "change of the offset of the ambient's temperature sensor since the fit",
        leaves="a temperature reading that is off by the same amount for days",
        inputs=("ambient_temperature", *(("ambient_absolute_humidity",) if relative else ())),
        corrections=corrections, source=OWN_ERROR, relative=relative,
    )  # fmt: skip


def wandering_ambient_humidity(rate: float = 0.005) -> Mechanism:
    """An offset of the ambient's humidity reading as a state: relative humidity = reading − x [1], x a random
    walk of `rate` [1/√d]."""
    return _random_walk(
        "wandering_ambient_humidity", "ambient_humidity_change", "1", rate, (1e-7, 0.2), None,
        "change of the offset of the ambient's humidity sensor since the fit",
        leaves="a humidity reading that is off for days, the more the warmer the ambient is",
        inputs=("ambient_temperature", "ambient_absolute_humidity"),
        corrections=lambda x, u: {
            "ambient_absolute_humidity": u.ambient_absolute_humidity
            - x.ambient_humidity_change * saturated_vapour(u.ambient_temperature, u.ambient_temperature)
        },
        source=OWN_ERROR,
    )  # fmt: skip


# fmt: off
WANDERING = (
    wandering_time_constant, wandering_exchange, wandering_release, wandering_temperature_reading,
    wandering_humidity_reading, wandering_humidity_scale, wandering_ambient_temperature,
    wandering_ambient_humidity,
)
# fmt: on
