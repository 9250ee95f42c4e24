"""The library of mechanisms."""

from __future__ import annotations

from hygrokf.mechanisms.hygric import (
    hygric_diffusion,
    hygric_exchange,
    second_vapour_disturbance,
    vapour_disturbance,
)
from hygrokf.mechanisms.network import linear_network
from hygrokf.mechanisms.sensors import absolute_humidity_sensor, humidity_sensor, temperature_sensor
from hygrokf.mechanisms.thermal import (
    heat_disturbance,
    heat_release,
    measured_air,
    second_heat_disturbance,
    thermal_diffusion,
    thermal_network,
    wall_thermal_mass,
)

LIBRARY = {
    function.__name__: function
    for function in (
        thermal_network,
        measured_air,
        heat_release,
        heat_disturbance,
        second_heat_disturbance,
        thermal_diffusion,
        wall_thermal_mass,
        hygric_exchange,
        vapour_disturbance,
        second_vapour_disturbance,
        hygric_diffusion,
        temperature_sensor,
        humidity_sensor,
        absolute_humidity_sensor,
    )
}
"""Factories by mechanism name; `LIBRARY[m.name](**m.settings)` makes a mechanism again."""

__all__ = [*LIBRARY, "LIBRARY", "linear_network"]
