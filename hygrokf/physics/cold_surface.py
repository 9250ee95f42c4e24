"""The coldest surface in a cabinet, on which vapour condenses first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hygrokf.physics.psychrometrics import saturation_pressure_ice, saturation_pressure_water

FREEZING_K = 273.15


@dataclass(frozen=True)
class Surface:
    """The coldest surface in a cabinet: T_s = T_amb + follows (T − T_amb) + offset_K.

    `follows` 0 for a wall that has the ambient's temperature, 1 for a part that has the cabinet air's.  Arrays (T,) are other surfaces at each
    instant.
    """

    follows: float | np.ndarray = 0.3
    offset_K: float | np.ndarray = 0.0

    def temperature(self, outside: np.ndarray, air: np.ndarray) -> np.ndarray:
        """Temperature [K] of the surface, from those of the ambient and of the cabinet air [K], any shape."""
        return outside + self.follows * (air - outside) + self.offset_K


def condenses(vapour_pressure: np.ndarray, surface_K: np.ndarray) -> np.ndarray:
    """Whether air of a vapour pressure [Pa] leaves water, or below 0 °C frost, on a surface [K]; any shape.

    It does where the vapour pressure is above the surface's saturation pressure, over ice below freezing: the same as a
    surface below dew or frost point.
    """
    cold = np.minimum(surface_K, FREEZING_K)
    saturated = np.where(
        surface_K < FREEZING_K, saturation_pressure_ice(cold), saturation_pressure_water(surface_K)
    )
    return vapour_pressure > saturated
