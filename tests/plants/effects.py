"""Coloured disturbances: what forces a cabinet's balances beside the weather and its own heat release.

Each sees the cabinet and its drivers and returns the forcing with its own share added.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from plants.cabinet import Cabinet, Forcing
from plants.chance import low_pass, ornstein_uhlenbeck, power_law, shots
from plants.drivers import Drivers

MINUTE_H = 1.0 / 60.0
DISTURBANCES = ("ou", "two-scale", "power-law", "diurnal-modulated", "shot", "none")
"""Kinds of coloured disturbance; only "ou" is the class that the base model assumes."""


def reference_temperatures(cabinet: Cabinet, drivers: Drivers, forcing: Forcing) -> tuple[float, float]:
    """Mean cabinet and ambient temperature [K] that the heat release alone leads to."""
    ambient = float(drivers.ambient_K.mean())
    return ambient + cabinet.outer_resistance * float(forcing.heat_W.mean()), ambient


def _pattern(
    random: np.random.Generator, kind: str, size: int, correlation_h: float, lag_h: float
) -> np.ndarray:
    """Disturbance at minutes whose first-order lag of `lag_h` has a root mean square of one."""
    if kind == "none":
        return np.zeros(size)
    if kind in ("ou", "shot"):
        # Scaled by theory: the sample keeps its own luck, as a measured record does.
        make = ornstein_uhlenbeck if kind == "ou" else shots
        gain = math.sqrt((correlation_h + lag_h) / correlation_h)
        return gain * make(random, size, MINUTE_H, correlation_h)
    if kind == "two-scale":
        fast = ornstein_uhlenbeck(random, size, MINUTE_H, correlation_h / 8.0)
        slow = ornstein_uhlenbeck(random, size, MINUTE_H, correlation_h * 5.0)
        values = fast + slow
    elif kind == "power-law":
        values = power_law(random, size, MINUTE_H, 1.3, 480.0)
    elif kind == "diurnal-modulated":
        phase = 2.0 * np.pi * (np.arange(size) * MINUTE_H / 24.0 + random.random())
        values = ornstein_uhlenbeck(random, size, MINUTE_H, correlation_h)
        values = values * (1.0 + 0.85 * np.sin(phase))
    else:
        raise ValueError(f"disturbance must be one of {DISTURBANCES}, found {kind!r}")
    return values / math.sqrt(float(np.mean(low_pass(values, MINUTE_H, lag_h) ** 2)))


def _held(values: np.ndarray) -> np.ndarray:
    return 0.5 * (values[:-1] + values[1:])


@dataclass(frozen=True)
class HeatDisturbance:
    """Coloured and white disturbance of the heat flow into the equipment.

    kind: one of DISTURBANCES. free_run_K: [K] root mean square error that it leaves in a
    simulation of the cabinet temperature. correlation_h: [h]. diffusion_K: [K/sqrt(h)] white
    diffusion of the equipment's temperature.
    """

    kind: str
    free_run_K: float
    correlation_h: float
    diffusion_K: float

    def force(
        self, random: np.random.Generator, cabinet: Cabinet, drivers: Drivers, forcing: Forcing
    ) -> Forcing:
        """Heat flow with the disturbance added [W]."""
        size = drivers.time.size
        pattern = _pattern(random, self.kind, size, self.correlation_h, cabinet.thermal_h)
        coloured = self.free_run_K / cabinet.outer_resistance * _held(pattern)
        kicks_K = self.diffusion_K * math.sqrt(MINUTE_H) * random.standard_normal(size - 1)
        white = kicks_K * cabinet.heat_capacity / 60.0
        return replace(forcing, heat_W=forcing.heat_W + coloured + white)


@dataclass(frozen=True)
class VapourDisturbance:
    """Coloured and white disturbance of the vapour flow into the cabinet air.

    kind: one of DISTURBANCES. free_run_kg_m3: [kg/m3] root mean square error that it leaves in a
    simulation of the absolute humidity. correlation_h: [h]. diffusion_kg_m3: [kg/(m3 sqrt(h))]
    white diffusion of c*.
    """

    kind: str
    free_run_kg_m3: float
    correlation_h: float
    diffusion_kg_m3: float

    def force(
        self, random: np.random.Generator, cabinet: Cabinet, drivers: Drivers, forcing: Forcing
    ) -> Forcing:
        """Vapour flow with the disturbance added [kg/s]."""
        size = drivers.time.size
        inside, outside = reference_temperatures(cabinet, drivers, forcing)
        lag_h = cabinet.hygric_h(inside, outside)
        resistance = float(cabinet.diffusion_resistance(np.array(outside)))
        pattern = _pattern(random, self.kind, size, self.correlation_h, lag_h)
        # The error is wanted in c, the flow lifts c*; they differ by the ratio of temperatures.
        coloured = self.free_run_kg_m3 * inside / outside / resistance * _held(pattern)
        kicks = self.diffusion_kg_m3 * math.sqrt(MINUTE_H) * random.standard_normal(size - 1)
        white = kicks * cabinet.volume * outside / inside / 60.0
        return replace(forcing, vapour_kg_s=forcing.vapour_kg_s + coloured + white)
