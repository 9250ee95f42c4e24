"""Saturation over water by Murphy and Koop, humidity by the ideal gas law."""

from __future__ import annotations

import numpy as np

# Molar gas constant over the molar mass of water [J/(kg K)].
VAPOUR_GAS_CONSTANT = 8.314462618 / 0.018015268


def saturation_pressure(kelvin: np.ndarray) -> np.ndarray:
    """Saturation vapour pressure over water, also supercooled [Pa].

    Murphy, D. M. and Koop, T. (2005), Q. J. R. Meteorol. Soc. 131, equation (10); 123 K to 332 K.
    """
    logarithm = np.log(kelvin)
    warm = 54.842763 - 6763.22 / kelvin - 4.210 * logarithm + 0.000367 * kelvin
    cold = 53.878 - 1331.22 / kelvin - 9.44523 * logarithm + 0.014025 * kelvin
    return np.exp(warm + np.tanh(0.0415 * (kelvin - 218.8)) * cold)


def concentration(vapour_Pa: np.ndarray, kelvin: np.ndarray) -> np.ndarray:
    """Vapour mass per volume of air [kg/m3] at a vapour pressure [Pa]."""
    return vapour_Pa / (VAPOUR_GAS_CONSTANT * kelvin)


def relative_humidity(kg_m3: np.ndarray, kelvin: np.ndarray) -> np.ndarray:
    """Relative humidity over water [-]."""
    return kg_m3 * VAPOUR_GAS_CONSTANT * kelvin / saturation_pressure(kelvin)


def dew_point(kg_m3: np.ndarray, kelvin: np.ndarray) -> np.ndarray:
    """Dew point over water [K], by Newton's steps on the logarithm of the pressure."""
    wanted = np.log(kg_m3 * VAPOUR_GAS_CONSTANT * kelvin)
    dew = np.asarray(kelvin, dtype=float) - 3.0
    for _ in range(6):
        here = np.log(saturation_pressure(dew))
        slope = (np.log(saturation_pressure(dew + 0.01)) - here) / 0.01
        dew = dew + (wanted - here) / slope
    return dew
