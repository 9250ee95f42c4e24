"""The library of mechanisms."""

from __future__ import annotations

from collections.abc import Callable

from hygrokf.physics.mechanisms.heat import (
    cooling_loss,
    dehumidifier_heat,
    drying_heat,
    fan_loss,
    lagged_ambient,
    leading_ambient,
    logged_heater,
    open_loss,
    pump_loss,
    release_drift,
    scheduled_heat,
    solar_gain,
    stepped_loss,
    unreported_heater,
    vent_loss,
    wind_loss,
)
from hygrokf.physics.mechanisms.hygric import (
    hygric_diffusion,
    hygric_exchange,
    second_vapour_disturbance,
    vapour_disturbance,
)
from hygrokf.physics.mechanisms.moisture import (
    breathed_air,
    breathed_lag,
    breathed_lead,
    condensation,
    cooled_exchange,
    dehumidifier,
    dehumidifier_drying,
    fan_exchange,
    internal_moisture_source,
    moisture_sorption,
    open_exchange,
    rain_ingress,
    stepped_exchange,
    switched_drying,
    vent_exchange,
    wet_surface,
    wind_exchange,
)
from hygrokf.physics.mechanisms.network import linear_network
from hygrokf.physics.mechanisms.sensors import (
    absolute_humidity_sensor,
    humidity_ceiling,
    humidity_drift,
    humidity_scale,
    humidity_sensor,
    temperature_sensor,
    temperature_step,
    thermometer_offset,
)
from hygrokf.physics.mechanisms.thermal import (
    heat_disturbance,
    heat_release,
    measured_air,
    natural_convection,
    second_heat_disturbance,
    thermal_diffusion,
    thermal_network,
    wall_thermal_mass,
)
from hygrokf.physics.mechanisms.wandering import (
    wandering_exchange,
    wandering_humidity_reading,
    wandering_humidity_scale,
    wandering_release,
    wandering_temperature_reading,
    wandering_time_constant,
)
from hygrokf.physics.model import Mechanism

Factory = Callable[..., Mechanism]
"""A function (**settings) -> mechanism."""

# fmt: off
BASE = (
    thermal_network, measured_air, heat_release, natural_convection, heat_disturbance,
    second_heat_disturbance, thermal_diffusion, hygric_exchange, vapour_disturbance,
    second_vapour_disturbance, hygric_diffusion, temperature_sensor, humidity_sensor,
    absolute_humidity_sensor,
)
"""Mechanisms of the base models."""
LOGGED = (
    logged_heater, dehumidifier_heat, fan_loss, pump_loss, open_loss, fan_exchange, open_exchange,
    dehumidifier_drying,
)
"""Effects of actuators that the record contains.  Each mechanism is nested: at its null value it has no
effect."""
FURTHER = (
    wall_thermal_mass, solar_gain, unreported_heater, drying_heat, scheduled_heat, release_drift, wind_loss,
    stepped_loss, cooling_loss, vent_loss, lagged_ambient, leading_ambient, moisture_sorption, condensation,
    internal_moisture_source, wet_surface, rain_ingress, dehumidifier, switched_drying, wind_exchange,
    stepped_exchange, cooled_exchange, vent_exchange, breathed_air, breathed_lag, breathed_lead,
    humidity_drift, humidity_scale, humidity_ceiling, temperature_step, thermometer_offset,
)
"""Further mechanisms that may act on a cabinet.  Each is nested: at its null values it has no effect."""
WANDERING = (
    wandering_time_constant, wandering_exchange, wandering_release, wandering_temperature_reading,
    wandering_humidity_reading, wandering_humidity_scale,
)
"""Properties of the cabinet as states, for tracking."""
# fmt: on
LIBRARY: dict[str, Factory] = {
    function.__name__: function for function in (*BASE, *LOGGED, *FURTHER, *WANDERING)
}
"""Factories by mechanism name; `LIBRARY[m.name](**m.settings)` creates the mechanism m again."""

__all__ = [*LIBRARY, "BASE", "FURTHER", "LIBRARY", "LOGGED", "WANDERING", "linear_network"]
