"""Water vapour in air: Hyland and Wexler's saturation pressure (ASHRAE Handbook, Fundamentals), over
water."""

from __future__ import annotations

import numpy as np

VAPOUR_GAS_CONSTANT = 461.52
"""[J/(kg K)]"""
FREEZING_K = 273.15

_OVER_WATER = (-5.8002206e3, 1.3914993, -4.8640239e-2, 4.1764768e-5, -1.4452093e-8, 6.5459673)


def saturation_pressure(kelvin: np.ndarray) -> np.ndarray:
    """[Pa] over water, below 0 °C too, as humidity sensors are made; 173 … 473 K."""
    a, b, c, d, e, f = _OVER_WATER
    return np.exp(a / kelvin + b + kelvin * (c + kelvin * (d + kelvin * e)) + f * np.log(kelvin))


def concentration(pressure: np.ndarray, kelvin: np.ndarray) -> np.ndarray:
    """Vapour concentration [kg/m³] of a vapour pressure [Pa]."""
    return pressure / (VAPOUR_GAS_CONSTANT * kelvin)


def relative_humidity(kg_m3: np.ndarray, kelvin: np.ndarray) -> np.ndarray:
    """Relative humidity [-] of a vapour concentration [kg/m³]."""
    return kg_m3 * VAPOUR_GAS_CONSTANT * kelvin / saturation_pressure(kelvin)
