"""The coldest surface in a cabinet, on which vapour condenses first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K, saturation_pressure_ice, saturation_pressure_water


@dataclass(frozen=True)
class Surface:
    """The coldest surface in a cabinet: T_s = T_amb + follows (T − T_amb) + offset_K.

    `follows` is 0 for a wall at ambient temperature and 1 for a part at the temperature of the cabinet air.
    Both may be arrays, which describe a different surface at each instant.
    """

    follows: float | np.ndarray = 0.3
    offset_K: float | np.ndarray = 0.0

    def temperature(self, outside: np.ndarray, air: np.ndarray) -> np.ndarray:
        """Surface temperature [K] from the ambient and the cabinet air temperature [K], any shape."""
        return outside + self.follows * (air - outside) + self.offset_K


def condenses(vapour_pressure: np.ndarray, surface_K: np.ndarray) -> np.ndarray:
    """Whether air with a vapour pressure [Pa] condenses on a surface [K], as frost below 0 °C; any shape.

    Condensation occurs where the vapour pressure exceeds the saturation pressure at the surface temperature,
    taken over ice below freezing.  This is the same as a surface colder than the dew point or frost point.
    """
    cold = np.minimum(surface_K, ZERO_CELSIUS_K)
    saturated = np.where(
        surface_K < ZERO_CELSIUS_K, saturation_pressure_ice(cold), saturation_pressure_water(surface_K)
    )
    return vapour_pressure > saturated
