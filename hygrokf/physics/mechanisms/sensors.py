"""Sensors of the logger in the cabinet: bias within the stated accuracy, white noise, resolution, response,
and further errors of their readings."""

from __future__ import annotations

from collections.abc import Callable

from hygrokf.physics.expression import Given, Value
from hygrokf.physics.mechanisms.effects import effect, named
from hygrokf.physics.mechanisms.hygric import cabinet_humidity, cabinet_vapour
from hygrokf.physics.mechanisms.moisture import twice_positive
from hygrokf.physics.model import Factory, Mechanism, Pair, Space, Values
from hygrokf.physics.parameters import Parameter, Prior

SHORTEST_RESPONSE_H = 1.0 / 30.0
"""[h] lower bound of an estimated response time: readings minutes apart do not show a shorter one."""
OWN_ERROR = "the sensor's own error"
TEMPERATURE_READING = "cabinet_temperature_reading"
HUMIDITY_READING = "cabinet_relative_humidity_reading"
SETTINGS_TEXT = """
The prior of the bias puts 95 % of sensors within the stated `accuracy`; there is none for accuracy 0.
Rounding to `resolution` adds the variance resolution²/12.  A sensor with a response time θ lags: dy/dt =
(quantity − y)/θ; θ is `response_h` [h], or a parameter with the upper bound `longest_response_h`.
"""


def _sensor(
    mechanism: str,
    name: str,
    unit: str,
    quantity: Callable[[Space, Space, Space], Value],
    noise: tuple[float, float, float],
    initial_moments: tuple[float, float],
    usual_accuracy: float,
    meaning: str,
    summary: str,
    inputs: tuple[str, ...] = (),
) -> Factory:
    """A sensor with the output `name`: `quantity(x, u, q)` plus reading errors of other mechanisms, bias and
    noise.

    `noise`: start, lower and upper limit of the standard deviation of a single reading; `initial_moments`:
    initial mean and variance of the lagged quantity y.
    """
    state, response = f"{name}_sensor", f"{name}_response"

    def factory(
        accuracy: float = usual_accuracy,
        resolution: float = 0.0,
        response_h: float = 0.0,
        longest_response_h: float | None = None,
    ) -> Mechanism:
        rounding = Given(resolution**2 / 12.0)
        has_bias = accuracy > 0
        responds = longest_response_h is not None or response_h > 0
        stated_rate = Given(1.0 / response_h) if response_h > 0 else 0.0

        def output(p: Space, x: Space, u: Space, q: Space, s: Space) -> Pair:
            value = getattr(x, state) if responds else quantity(x, u, q)
            value = value + getattr(s, f"{name}_reading")
            if has_bias:
                value = value + getattr(p, f"{name}_bias")
            noise_sd = getattr(p, f"{name}_noise")
            return value, noise_sd * noise_sd + rounding

        def drift(p: Space, x: Space, u: Space, q: Space, s: Space) -> Values:
            rate = stated_rate if longest_response_h is None else 1.0 / getattr(p, response)
            return {state: (quantity(x, u, q) - getattr(x, state)) * rate}

        parameters = [
            Parameter(
                f"{name}_noise", unit, *noise, positive=True, noise=True,
                meaning="white noise of a single reading",
            )
        ]  # fmt: skip
        if has_bias:
            bias = Parameter(
                f"{name}_bias", unit, 0.0, -4 * accuracy, 4 * accuracy, prior=Prior(0.0, accuracy / 1.96),
                null=0.0, meaning="constant error of the sensor, within its stated accuracy",
            )  # fmt: skip
            parameters.insert(0, bias)
        if longest_response_h is not None:
            time = Parameter(
                response, "h", 0.1, SHORTEST_RESPONSE_H, longest_response_h, positive=True,
                meaning="time in which the sensor covers 63 % of a step",
            )  # fmt: skip
            parameters.append(time)
        return Mechanism(
            name=mechanism,
            parameters=tuple(parameters),
            states=(state,) if responds else (),
            inputs=inputs,
            drift=drift if responds else None,
            initial=(lambda p, u: {state: initial_moments}) if responds else None,
            outputs={name: output},
            settings={
                "accuracy": accuracy, "resolution": resolution, "response_h": response_h,
                "longest_response_h": longest_response_h,
            },
            meaning=meaning,
        )  # fmt: skip

    return named(mechanism, f"{summary} + bias + noise [{unit}].\n{SETTINGS_TEXT}", factory)


temperature_sensor = _sensor(
    "temperature_sensor", "cabinet_temperature", "K", lambda x, u, q: q.cabinet_air_temperature,
    (0.1, 2e-3, 10.0), (288.15, 225.0), 0.3,
    "the logger's temperature sensor", "The temperature reading: T_conv,a",
)  # fmt: skip
humidity_sensor = _sensor(  # polymer sensors behind a filter respond within 5 to 15 min
    "humidity_sensor", "cabinet_relative_humidity", "1", cabinet_humidity,
    (0.005, 1e-4, 0.5), (0.5, 0.09), 0.02,
    "the logger's relative-humidity sensor",
    "The relative-humidity reading, over water at any temperature: h = c* R_v T_amb / e_s(T_conv,a), "
    "equation (5),", ("ambient_temperature",),
)  # fmt: skip
absolute_humidity_sensor = _sensor(
    "absolute_humidity_sensor", "cabinet_absolute_humidity", "g/m3", cabinet_vapour,
    (0.1, 1e-3, 10.0), (8.0, 50.0), 0.0,
    "a sensor or converter that gives absolute humidity",
    "The absolute-humidity reading: c_conv,a = c* T_amb/T_conv,a, equation (5),", ("ambient_temperature",),
)  # fmt: skip


# -- further errors of readings ------------------------------------------------------------------------------
def _calendar_error(
    name: str, target: str, flag: str, parameter: str, unit: str, limit: float, meaning: str
) -> Factory:
    """A reading with the error a · flag, where the flag depends on the date alone."""

    def factory() -> Mechanism:
        return effect(
            name, target, Parameter(parameter, unit, 0.0, -limit, limit, null=0.0, meaning=meaning), flag,
            meaning=meaning, source=OWN_ERROR,
            leaves="readings whose deviation from the simulation depends on the date, not on the regime",
        )  # fmt: skip

    return named(name, f"A reading with an error a · `{flag}` [{unit}], a the {meaning}.", factory)


humidity_drift = _calendar_error(
    "humidity_drift", HUMIDITY_READING, "elapsed", "humidity_drift_total", "1", 0.4,
    "drift of the humidity reading over the record",
)  # fmt: skip
temperature_step = _calendar_error(
    "temperature_step", TEMPERATURE_READING, "after_step", "temperature_offset", "K", 30.0,
    "offset of the temperature reading from the date on",
)  # fmt: skip


def humidity_scale(flag: str | None = "elapsed") -> Mechanism:
    """Humidity reading with a scale error: a · flag · h, h the relative humidity of the air [1].

    `flag` "elapsed": growing linearly over the record; "since": from a date on; None: constant.
    """

    name = "humidity_scale_error" if flag is None else "humidity_scale_drift"

    def contributions(p: Space, x: Space, u: Space, q: Space) -> Values:
        course = 1.0 if flag is None else getattr(u, flag)
        return {HUMIDITY_READING: getattr(p, name) * course * cabinet_humidity(x, u, q)}

    return Mechanism(
        name="humidity_scale",
        parameters=(
            Parameter(
                name, "1", 0.0, -0.9, 2.0, null=0.0,
                meaning="error of the humidity sensor's scale in the end",
            ),
        ),
        inputs=("ambient_temperature", *((flag,) if flag else ())),
        contributions=contributions,
        settings={"flag": flag},
        meaning="scale error of the humidity sensor",
        leaves="humidity readings that vary too little or too much, perhaps increasingly over the record",
        source=OWN_ERROR,
    )  # fmt: skip


def humidity_ceiling() -> Mechanism:
    """Humidity reading that saturates above a ceiling h₁: −s · max(0, h − h₁).

    The transition at h₁ is rounded over 0.5 % of relative humidity.
    """

    def contributions(p: Space, x: Space, u: Space, q: Space) -> Values:
        above = cabinet_humidity(x, u, q) - p.humidity_ceiling
        return {HUMIDITY_READING: -0.5 * p.humidity_lost * twice_positive(above, 0.01)}

    return Mechanism(
        name="humidity_ceiling",
        parameters=(
            Parameter(
                "humidity_lost", "1", 0.5, 0.0, 1.0, null=0.0, physical=(0.0, 1.0),
                meaning="share of the excess over the ceiling that the reading does not show",
            ),
            Parameter(
                "humidity_ceiling", "1", 0.7, 0.2, 1.0, physical=(0.0, 1.0),
                meaning="relative humidity above which the sensor sticks",
            ),
        ),
        inputs=("ambient_temperature",),
        contributions=contributions,
        meaning="humidity sensor that sticks at a ceiling",
        leaves="humidity readings that stop at one value whatever the simulation does",
        source=OWN_ERROR,
    )  # fmt: skip


# fmt: off
BASE = (temperature_sensor, humidity_sensor, absolute_humidity_sensor)
FURTHER = (humidity_drift, humidity_scale, humidity_ceiling, temperature_step)
# fmt: on
