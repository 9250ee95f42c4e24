"""What a sensor may do beside its bias and noise."""

from __future__ import annotations

from hygrokf.mechanisms.sensors import saturation_pressure
from hygrokf.model import Mechanism
from hygrokf.parameters import Parameter
from hygrokf.psychrometrics import GAS_CONSTANT_VAPOUR


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
    """Humidity reading that drifts by a from the record's beginning to its end (input `elapsed`) [1]."""
    return _reading(
        "humidity_drift", "humidity_drift_total", "1", 0.6, "elapsed", "cabinet_relative_humidity_reading",
        "drift of the humidity reading over the record",
    )  # fmt: skip


def humidity_scale() -> Mechanism:
    """Humidity reading whose scale is off: a · elapsed · (h − 0.5), h the relative humidity of the air [1]."""

    def contributions(p, x, u, q):
        pressure = x.vapour * u.ambient_temperature * (1e-3 * GAS_CONSTANT_VAPOUR)
        h = pressure / saturation_pressure(q.cabinet_air_temperature)
        return {"cabinet_relative_humidity_reading": p.humidity_scale_error * u.elapsed * (h - 0.5)}

    return Mechanism(
        name="humidity_scale",
        parameters=(
            Parameter(
                "humidity_scale_error", "1", 0.0, -0.9, 2.0, null=0.0,
                meaning="error of the humidity sensor's scale at the record's end",
            ),
        ),
        inputs=("ambient_temperature", "elapsed"),
        contributions=contributions,
        meaning="scale of the humidity sensor that goes off over the record",
        leaves="humidity readings that become too flat or too steep with the calendar",
        source="the sensor's own error",
    )  # fmt: skip


def temperature_step() -> Mechanism:
    """Temperature reading that is off by a constant from a date on (input `after_step`) [K]."""
    return _reading(
        "temperature_step", "temperature_offset", "K", 30.0, "after_step", "cabinet_temperature_reading",
        "offset of the temperature reading from the date on",
    )  # fmt: skip
