"""What the logger in the cabinet shows: bias within its accuracy, white noise, resolution."""

from __future__ import annotations

from hygrokf.expression import Given, exp, log
from hygrokf.model import Mechanism
from hygrokf.parameters import Parameter, Prior
from hygrokf.psychrometrics import GAS_CONSTANT_VAPOUR, SATURATION_WATER


def saturation_pressure(temperature):
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


def temperature_sensor(accuracy: float = 0.3, resolution: float = 0.0) -> Mechanism:
    """The temperature reading [K]: T_conv,a + bias + noise; rounding to `resolution` adds resolution²/12."""
    floor = Given(resolution**2 / 12.0)
    bias = _bias("cabinet_temperature", "K", accuracy)

    def output(p, x, u, q, s):
        value = q.cabinet_air_temperature + s.cabinet_temperature_reading
        if bias:
            value = value + p.cabinet_temperature_bias
        return value, p.cabinet_temperature_noise * p.cabinet_temperature_noise + floor

    return Mechanism(
        name="temperature_sensor",
        parameters=(*bias, _noise("cabinet_temperature", "K", 0.1, 2e-3, 10.0)),
        outputs={"cabinet_temperature": output},
        settings={"accuracy": accuracy, "resolution": resolution},
        meaning="the logger's temperature sensor",
    )


def humidity_sensor(accuracy: float = 0.02, resolution: float = 0.0) -> Mechanism:
    """The relative-humidity reading [1]: h = c* R_v T_amb / e_s(T_conv,a) + bias + noise, over water at any T.

    The reading belongs to the air at the sensor, c_conv,a R_v T_conv,a = c* R_v T_amb by equation (5).
    """
    floor = Given(resolution**2 / 12.0)
    bias = _bias("cabinet_relative_humidity", "1", accuracy)

    def output(p, x, u, q, s):
        pressure = x.vapour * u.ambient_temperature * (1e-3 * GAS_CONSTANT_VAPOUR)
        value = (
            pressure / saturation_pressure(q.cabinet_air_temperature) + s.cabinet_relative_humidity_reading
        )
        if bias:
            value = value + p.cabinet_relative_humidity_bias
        return value, p.cabinet_relative_humidity_noise * p.cabinet_relative_humidity_noise + floor

    return Mechanism(
        name="humidity_sensor",
        parameters=(*bias, _noise("cabinet_relative_humidity", "1", 0.005, 1e-4, 0.5)),
        inputs=("ambient_temperature",),
        outputs={"cabinet_relative_humidity": output},
        settings={"accuracy": accuracy, "resolution": resolution},
        meaning="the logger's relative-humidity sensor",
    )


def absolute_humidity_sensor(accuracy: float = 0.0, resolution: float = 0.0) -> Mechanism:
    """The absolute-humidity reading [g/m³]: c_conv,a = c* T_amb/T_conv,a, equation (5)."""
    floor = Given(resolution**2 / 12.0)
    bias = _bias("cabinet_absolute_humidity", "g/m3", accuracy)

    def output(p, x, u, q, s):
        value = x.vapour * u.ambient_temperature / q.cabinet_air_temperature
        value = value + s.cabinet_absolute_humidity_reading
        if bias:
            value = value + p.cabinet_absolute_humidity_bias
        return value, p.cabinet_absolute_humidity_noise * p.cabinet_absolute_humidity_noise + floor

    return Mechanism(
        name="absolute_humidity_sensor",
        parameters=(*bias, _noise("cabinet_absolute_humidity", "g/m3", 0.1, 1e-3, 10.0)),
        inputs=("ambient_temperature",),
        outputs={"cabinet_absolute_humidity": output},
        settings={"accuracy": accuracy, "resolution": resolution},
        meaning="a sensor or converter that gives absolute humidity",
    )
