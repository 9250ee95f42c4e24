"""Sensors of the logger in the cabinet: bias within the stated accuracy, white noise, resolution."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from hygrokf.physics.expression import Given, Value, exp, log
from hygrokf.physics.model import Mechanism, Pair, Space, Values
from hygrokf.physics.parameters import Parameter, Prior
from hygrokf.physics.psychrometrics import GAS_CONSTANT_VAPOUR, SATURATION_WATER


def saturation_pressure(temperature: Value) -> Value:
    """Sonntag's saturation pressure over water [Pa]; also accepts traced temperatures [K]."""
    a, b, c, d, e = SATURATION_WATER
    return exp(a / temperature + b + (c + d * temperature) * temperature + e * log(temperature))


def _bias(name: str, unit: str, accuracy: float) -> tuple[Parameter, ...]:
    """A constant sensor error whose prior puts 95 % of sensors within the stated accuracy; none for accuracy
    0."""
    if accuracy <= 0:
        return ()
    sd = accuracy / 1.96
    return (
        Parameter(
            f"{name}_bias", unit, 0.0, -4 * accuracy, 4 * accuracy, prior=Prior(0.0, sd), null=0.0,
            meaning="constant error of the sensor, within its stated accuracy",
        ),
    )  # fmt: skip


def _noise(name: str, unit: str, start: float, lower: float, upper: float) -> Parameter:
    return Parameter(
        f"{name}_noise",
        unit,
        start,
        lower,
        upper,
        positive=True,
        noise=True,
        meaning="white noise of a single reading",
    )


SHORTEST_RESPONSE_H = 1.0 / 30.0
"""[h] lower bound of an estimated response time: readings minutes apart do not show a shorter one."""


def _sensor(
    mechanism: str,
    name: str,
    quantity: Callable[[Space, Space, Space], Value],
    noise: Parameter,
    bias: tuple[Parameter, ...],
    spread: tuple[float, float],
    response_h: float,
    longest_response_h: float | None,
    settings: Mapping[str, Any],
    meaning: str,
    inputs: tuple[str, ...] = (),
) -> Mechanism:
    """A sensor with the output `name`: `quantity(x, u, q)` plus reading errors of other mechanisms, bias and
    noise.

    With a response time θ the sensor lags: dy/dt = (quantity − y)/θ.  θ is `response_h` [h], or a parameter
    with the upper bound `longest_response_h` where that is given.  `spread` is the initial mean and variance
    of y.
    """
    resolution = Given(settings["resolution"] ** 2 / 12.0)
    estimated = longest_response_h is not None
    state, response = f"{name}_sensor", f"{name}_response"
    responds = estimated or response_h > 0
    stated = Given(1.0 / response_h) if response_h > 0 else 0.0

    def output(p: Space, x: Space, u: Space, q: Space, s: Space) -> Pair:
        value = getattr(x, state) if responds else quantity(x, u, q)
        value = value + getattr(s, f"{name}_reading")
        if bias:
            value = value + getattr(p, bias[0].name)
        own = getattr(p, noise.name)
        return value, own * own + resolution

    def drift(p: Space, x: Space, u: Space, q: Space, s: Space) -> Values:
        rate = 1.0 / getattr(p, response) if estimated else stated
        return {state: (quantity(x, u, q) - getattr(x, state)) * rate}

    time: tuple[Parameter, ...] = ()
    if longest_response_h is not None:
        time = (
            Parameter(
                response, "h", 0.1, SHORTEST_RESPONSE_H, longest_response_h, positive=True,
                meaning="time in which the sensor follows a step by all but 1/e",
            ),
        )  # fmt: skip
    return Mechanism(
        name=mechanism,
        parameters=(*bias, noise, *time),
        states=(state,) if responds else (),
        inputs=inputs,
        drift=drift if responds else None,
        initial=(lambda p, u: {state: spread}) if responds else None,
        outputs={name: output},
        settings={**settings, "response_h": response_h, "longest_response_h": longest_response_h},
        meaning=meaning,
    )


def temperature_sensor(
    accuracy: float = 0.3,
    resolution: float = 0.0,
    response_h: float = 0.0,
    longest_response_h: float | None = None,
) -> Mechanism:
    """The temperature reading [K]: T_conv,a + bias + noise; rounding to `resolution` adds the variance
    resolution²/12.

    `response_h` [h] is the sensor's response time; `longest_response_h` [h] is given where it is to be
    estimated.  The reading follows T_conv,a with that time constant.
    """
    return _sensor(
        "temperature_sensor",
        "cabinet_temperature",
        lambda x, u, q: q.cabinet_air_temperature,
        _noise("cabinet_temperature", "K", 0.1, 2e-3, 10.0),
        _bias("cabinet_temperature", "K", accuracy),
        (288.15, 225.0),
        response_h,
        longest_response_h,
        {"accuracy": accuracy, "resolution": resolution},
        "the logger's temperature sensor",
    )


def _relative_humidity(x: Space, u: Space, q: Space) -> Value:
    pressure = x.vapour * u.ambient_temperature * (1e-3 * GAS_CONSTANT_VAPOUR)
    return pressure / saturation_pressure(q.cabinet_air_temperature)


def humidity_sensor(
    accuracy: float = 0.02,
    resolution: float = 0.0,
    response_h: float = 0.0,
    longest_response_h: float | None = None,
) -> Mechanism:
    """The relative-humidity reading [1]: h = c* R_v T_amb / e_s(T_conv,a) + bias + noise, over water at any
    temperature.

    The reading refers to the air at the sensor: c_conv,a R_v T_conv,a = c* R_v T_amb by equation (5).
    `response_h` as for the temperature; polymer sensors behind a filter respond within 5 to 15 min.
    """
    return _sensor(
        "humidity_sensor",
        "cabinet_relative_humidity",
        _relative_humidity,
        _noise("cabinet_relative_humidity", "1", 0.005, 1e-4, 0.5),
        _bias("cabinet_relative_humidity", "1", accuracy),
        (0.5, 0.09),
        response_h,
        longest_response_h,
        {"accuracy": accuracy, "resolution": resolution},
        "the logger's relative-humidity sensor",
        ("ambient_temperature",),
    )


def absolute_humidity_sensor(
    accuracy: float = 0.0,
    resolution: float = 0.0,
    response_h: float = 0.0,
    longest_response_h: float | None = None,
) -> Mechanism:
    """The absolute-humidity reading [g/m³]: c_conv,a = c* T_amb/T_conv,a, equation (5); `response_h` as for
    the temperature."""
    return _sensor(
        "absolute_humidity_sensor",
        "cabinet_absolute_humidity",
        lambda x, u, q: x.vapour * u.ambient_temperature / q.cabinet_air_temperature,
        _noise("cabinet_absolute_humidity", "g/m3", 0.1, 1e-3, 10.0),
        _bias("cabinet_absolute_humidity", "g/m3", accuracy),
        (8.0, 50.0),
        response_h,
        longest_response_h,
        {"accuracy": accuracy, "resolution": resolution},
        "a sensor or converter that gives absolute humidity",
        ("ambient_temperature",),
    )
