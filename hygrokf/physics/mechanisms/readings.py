"""Sensor errors besides bias and noise."""

from __future__ import annotations

from hygrokf.physics.expression import Value, sqrt
from hygrokf.physics.mechanisms.sensors import saturation_pressure
from hygrokf.physics.model import Mechanism, Space, Values
from hygrokf.physics.parameters import Parameter
from hygrokf.physics.psychrometrics import GAS_CONSTANT_VAPOUR


def _reading(
    name: str, parameter: str, unit: str, bound: float, flag: str, target: str, text: str
) -> Mechanism:
    return Mechanism(
        name=name,
        parameters=(Parameter(parameter, unit, 0.0, -bound, bound, null=0.0, meaning=text),),
        inputs=(flag,),
        contributions=lambda p, x, u, q: {target: getattr(p, parameter) * getattr(u, flag)},
        meaning=text,
        leaves="readings that depart from the simulation with the calendar, in every regime alike",
        source="the sensor's own error",
    )


def humidity_drift() -> Mechanism:
    """Humidity reading with a linear drift, reaching a at the end of the record (input `elapsed`) [1]."""
    return _reading(
        "humidity_drift", "humidity_drift_total", "1", 0.4, "elapsed", "cabinet_relative_humidity_reading",
        "drift of the humidity reading over the record",
    )  # fmt: skip


def _relative(x: Space, u: Space, q: Space) -> Value:
    """Relative humidity of the cabinet air [1]."""
    pressure = x.vapour * u.ambient_temperature * (1e-3 * GAS_CONSTANT_VAPOUR)
    return pressure / saturation_pressure(q.cabinet_air_temperature)


def humidity_scale(flag: str | None = "elapsed") -> Mechanism:
    """Humidity reading with a scale error: a · flag · h, h the relative humidity of the air [1].

    `flag` "elapsed": growing linearly over the record; "since": from a date on; None: constant.
    """

    def contributions(p: Space, x: Space, u: Space, q: Space) -> Values:
        course = 1.0 if flag is None else getattr(u, flag)
        return {"cabinet_relative_humidity_reading": p.humidity_scale_error * course * _relative(x, u, q)}

    return Mechanism(
        name="humidity_scale",
        parameters=(
            Parameter(
                "humidity_scale_error", "1", 0.0, -0.9, 2.0, null=0.0,
                meaning="error of the humidity sensor's scale in the end",
            ),
        ),
        inputs=("ambient_temperature", *((flag,) if flag else ())),
        contributions=contributions,
        settings={"flag": flag},
        meaning="scale of the humidity sensor that is off",
        leaves="humidity readings that are too flat or too steep, perhaps with the calendar",
        source="the sensor's own error",
    )  # fmt: skip


def humidity_ceiling(lowest: float = 0.2) -> Mechanism:
    """Humidity reading that saturates above a ceiling h₁: −s · max(0, h − h₁), its edge rounded over 0.5 %.

    lowest: [1] smallest relative humidity at which the ceiling may lie.
    """

    def contributions(p: Space, x: Space, u: Space, q: Space) -> Values:
        above = _relative(x, u, q) - p.humidity_ceiling
        return {
            "cabinet_relative_humidity_reading": -0.5 * p.humidity_lost * (above + sqrt(above * above + 1e-4))
        }

    return Mechanism(
        name="humidity_ceiling",
        parameters=(
            Parameter(
                "humidity_lost", "1", 0.5, 0.0, 1.0, null=0.0, physical=(0.0, 1.0),
                meaning="share of what exceeds the ceiling that the reading does not show",
            ),
            Parameter(
                "humidity_ceiling", "1", max(0.7, lowest), lowest, 1.0, physical=(0.0, 1.0),
                meaning="relative humidity above which the sensor sticks",
            ),
        ),
        inputs=("ambient_temperature",),
        contributions=contributions,
        settings={"lowest": lowest},
        meaning="humidity sensor that sticks at a ceiling",
        leaves="humidity readings that stop at one value whatever the simulation does",
        source="the sensor's own error",
    )  # fmt: skip


def temperature_step() -> Mechanism:
    """Temperature reading with a constant error from a date on (input `after_step`) [K]."""
    return _reading(
        "temperature_step", "temperature_offset", "K", 30.0, "after_step", "cabinet_temperature_reading",
        "offset of the temperature reading from the date on",
    )  # fmt: skip


def thermometer_offset() -> Mechanism:
    """Constant thermometer error d [K], seen through its effect on the humidity reading: + p_v (1/e_s(T − d)
    − 1/e_s(T)).

    T is the temperature as read, or as simulated by a thermal part identified on such readings, whose heat
    release absorbs d. The humidity sensor is at the true air temperature T − d.
    """

    def contributions(p: Space, x: Space, u: Space, q: Space) -> Values:
        pressure = x.vapour * u.ambient_temperature * (1e-3 * GAS_CONSTANT_VAPOUR)
        own = saturation_pressure(q.cabinet_air_temperature - p.thermometer_offset)
        return {
            "cabinet_relative_humidity_reading": pressure / own
            - pressure / saturation_pressure(q.cabinet_air_temperature)
        }

    return Mechanism(
        name="thermometer_offset",
        parameters=(
            Parameter(
                "thermometer_offset", "K", 0.0, -10.0, 10.0, null=0.0,
                meaning="constant offset of the cabinet's thermometer",
            ),
        ),
        inputs=("ambient_temperature",),
        contributions=contributions,
        meaning="thermometer that is off by a constant",
        leaves="humidity that is off by 6 to 7 % of itself for each kelvin",
        source="the sensor's own error",
    )  # fmt: skip
