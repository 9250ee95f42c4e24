"""Simulated cabinets made by other means, to judge the package with.

Nothing here imports the package, save `plants.as_record`, which wraps a finished plant as a
record. Quantities are physical (W, J/K, K/W, m3, kg), the saturation formula and the integrator
are other ones than the package's. A plant is a set of cabinet parameters, drivers (weather and
operation), disturbances that force its balances, and loggers.
"""

from __future__ import annotations

from plants.cabinet import Cabinet, Forcing, Trajectory, integrate
from plants.drivers import Drivers, own_drivers
from plants.effects import DISTURBANCES, HeatDisturbance, VapourDisturbance
from plants.loggers import Logging, PlantSeries
from plants.plant import Plant, Truth, build_plant, plant, undisturbed
from plants.uk import UK_DRIVERS, uk_plant

__all__ = [
    "DISTURBANCES",
    "UK_DRIVERS",
    "Cabinet",
    "Drivers",
    "Forcing",
    "HeatDisturbance",
    "Logging",
    "Plant",
    "PlantSeries",
    "Trajectory",
    "Truth",
    "VapourDisturbance",
    "build_plant",
    "integrate",
    "own_drivers",
    "plant",
    "uk_plant",
    "undisturbed",
]
