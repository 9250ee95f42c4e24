"""Moist air per mass, from vapour pressures: what weather services state and the package only reads."""

from __future__ import annotations

import numpy as np

from hygrokf.physics.psychrometrics import MASS_RATIO


def humidity_ratio(vapour: np.ndarray | float, pressure: np.ndarray | float) -> np.ndarray | float:
    """Vapour mass per mass of dry air, w = eps e / (p - e) [kg/kg], of pressures [Pa]."""
    return MASS_RATIO * vapour / (pressure - vapour)


def specific_humidity(vapour: np.ndarray | float, pressure: np.ndarray | float) -> np.ndarray | float:
    """Vapour mass per mass of moist air, q = eps e / (p - (1 - eps) e) [kg/kg], of pressures [Pa]."""
    return MASS_RATIO * vapour / (pressure - (1.0 - MASS_RATIO) * vapour)
