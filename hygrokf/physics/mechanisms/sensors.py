"""What the logger in the cabinet shows: bias within its accuracy, white noise, resolution."""

from __future__ import annotations

from collections.abc import Callable

from hygrokf.physics.expression import Given, Named, Value, exp, log
from hygrokf.physics.model import Mechanism
from hygrokf.physics.parameters import Parameter, Prior
from hygrokf.physics.psychrometrics import GAS_CONSTANT_VAPOUR, SATURATION_WATER


def saturation_pressure(temperature: Value) -> Value:
    """Sonntag's saturation pressure over water [Pa] for traced temperatures [K] too."""
    a, b, c, d, e = SATURATION_WATER
    return exp(a / temperature + b + (c + d * temperature) * temperature + e * log(temperature))


def _bias(name: str, unit: str, accuracy: float) -> tuple[Parameter, ...]:
    """A constant error whose prior says that 95 % of such sensors are within the accuracy; none for accuracy 0."""
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
"""[h] a response time to be estimated is at least this long: below it readings minutes apart show nothing of it."""


def _sensor(
    mechanism: str,
    name: str,
    quantity: Callable,
    noise: Parameter,
    bias: tuple[Parameter, ...],
    spread: tuple[float, float],
    response_h: float,
    longest_response_h: float | None,
    settings: dict,
    meaning: str,
    inputs: tuple[str, ...] = (),
) -> Mechanism:
    """A sensor, its output `name`, that shows `quantity(x, u, q)` with what else acts on the reading, a bias and noise.

    With a response time θ it follows first: dy/dt = (quantity − y)/θ, θ = `response_h` [h] or, where
    `longest_response_h` is given, a parameter up to that.  `spread` mean and variance of y at first.
    """
    resolution = Given(settings["resolution"] ** 2 / 12.0)
    estimated = longest_response_h is not None
    state, response = f"{name}_sensor", f"{name}_response"
    responds = estimated or response_h > 0
    stated = Given(1.0 / response_h) if response_h > 0 else 0.0

    def output(p: Named, x: Named, u: Named, q: Named, s: Named) -> tuple[Value, Value]:
        value = getattr(x, state) if responds else quantity(x, u, q)
        value = value + getattr(s, f"{name}_reading")
        if bias:
            value = value + getattr(p, bias[0].name)
        own = getattr(p, noise.name)
        return value, own * own + resolution

    def drift(p: Named, x: Named, u: Named, q: Named, s: Named) -> dict[str, Value]:
        rate = 1.0 / getattr(p, response) if estimated else stated
        return {state: (quantity(x, u, q) - getattr(x, state)) * rate}

    time = (
        Parameter(
            response, "h", 0.1, SHORTEST_RESPONSE_H, longest_response_h, positive=True,
            meaning="time in which the sensor follows a step by all but 1/e",
        ),
    ) if longest_response_h is not None else ()  # fmt: skip
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
    """The temperature reading [K]: T_conv,a + bias + noise; rounding to `resolution` adds resolution²/12.

    `response_h` [h] of the sensor, or its longest where it is estimated: the reading then follows T_conv,a with that
    time constant.
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


def _relative_humidity(x: Named, u: Named, q: Named) -> Value:
    pressure = x.vapour * u.ambient_temperature * (1e-3 * GAS_CONSTANT_VAPOUR)
    return pressure / saturation_pressure(q.cabinet_air_temperature)


def humidity_sensor(
    accuracy: float = 0.02,
    resolution: float = 0.0,
    response_h: float = 0.0,
    longest_response_h: float | None = None,
) -> Mechanism:
    """The relative-humidity reading [1]: h = c* R_v T_amb / e_s(T_conv,a) + bias + noise, over water at any T.

    The reading belongs to the air at the sensor, c_conv,a R_v T_conv,a = c* R_v T_amb by equation (5).  `response_h` as
    for the temperature: polymer sensors behind a filter follow within 5 to 15 min.
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
    """The absolute-humidity reading [g/m³]: c_conv,a = c* T_amb/T_conv,a, equation (5); `response_h` as above."""
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
