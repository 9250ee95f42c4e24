"""Moist-air quantities: saturation over water and ice, conversions of humidity, derivatives.

Every function is vectorised and analytic: it broadcasts its arguments, returns a float for
floats and an array for arrays, and takes complex arguments (a complex step gives its derivative).
NaN in gives NaN out. A value outside the documented range gives NaN as well, never an error
and never a warning, because a filter feeds these functions with readings that may be missing.
Water vapour is an ideal gas. Relative humidity refers to water, also below 0 degC, as the
sensors do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

ZERO_CELSIUS_K = 273.15
"""[K] 0 °C."""
GAS_CONSTANT_VAPOUR = 461.5
"""[J/(kg K)] specific gas constant of water vapour, R_v."""

GAS_CONSTANT_DRY_AIR = 287.05
"""[J/(kg K)] specific gas constant of dry air."""

MASS_RATIO = GAS_CONSTANT_DRY_AIR / GAS_CONSTANT_VAPOUR
"""[-] molar mass of water over that of dry air."""

WATER_RANGE = (173.15, 373.15)
"""[K] temperatures for which the saturation pressure over water is given."""

ICE_RANGE = (173.15, 273.16)
"""[K] temperatures for which the saturation pressure over ice is given."""

# Coefficients of a/T + b + c T + d T^2 + e ln T = ln(pressure / Pa).
_HECTOPASCAL = math.log(100.0)
SATURATION_WATER = (-6096.9385, 16.635794 + _HECTOPASCAL, -2.711193e-2, 1.673952e-5, 2.433502)
"""Sonntag (1990), saturation over water: a, b, c, d, e of ln p = a/T + b + c T + d T^2 + e ln T."""

SATURATION_ICE = (-6024.5282, 24.7219 + _HECTOPASCAL, 1.0613868e-2, -1.3198825e-5, -0.49382577)
"""Sonntag (1990), saturation over ice: a, b, c, d, e of ln p = a/T + b + c T + d T^2 + e ln T."""

# Started at the Magnus formula, the third Newton step reaches round-off anywhere in the range; a
# fixed number of steps, one more than needed, keeps the inverse analytic (complex steps pass through).
_NEWTON_STEPS = 4

Number = Any
"""A float, a complex number or an array of either; results have the kind of the arguments."""


def _as_number(value: Number) -> np.ndarray:
    array = np.asarray(value)
    return array if np.iscomplexobj(array) else array.astype(float)


def _nan_outside(inside: np.ndarray, value: np.ndarray) -> Number:
    """The value where `inside` holds and NaN elsewhere; a scalar stays a scalar."""
    return np.where(inside, value, np.nan)[()]


def _between(value: np.ndarray, lowest: float, highest: float) -> np.ndarray:
    real = value.real
    return (real >= lowest) & (real <= highest)


def _log_saturation(temperature: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    a, b, c, d, e = coefficients
    return a / temperature + b + (c + d * temperature) * temperature + e * np.log(temperature)


def _log_saturation_slope(temperature: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    a, _, c, d, e = coefficients
    return -a / temperature**2 + c + 2.0 * d * temperature + e / temperature


def _saturation(
    temperature: Number, coefficients: tuple[float, ...], valid: tuple[float, float], slope: bool = False
) -> Number:
    """Saturation vapour pressure [Pa], or its slope [Pa/K], at a temperature [K]; NaN outside `valid` [K]."""
    kelvin = _as_number(temperature)
    with np.errstate(all="ignore"):
        pressure = np.exp(_log_saturation(kelvin, coefficients))
        if slope:
            pressure = pressure * _log_saturation_slope(kelvin, coefficients)
    return _nan_outside(_between(kelvin, *valid), pressure)


def saturation_pressure_water(temperature: Number) -> Number:
    """Saturation vapour pressure over liquid water, also supercooled [Pa].

    temperature: [K], any shape.
    ln(e_w / hPa) = -6096.9385/T + 16.635794 - 2.711193e-2 T + 1.673952e-5 T^2 + 2.433502 ln T
    Range: 173.15 K to 373.15 K (-100 degC to 100 degC), NaN outside. Within 0.01 % of IAPWS-95
    from 0 degC to 100 degC; over supercooled water above Murphy and Koop (2005) by 0.03 % at
    -10 degC, 0.2 % at -30 degC, 0.7 % at -40 degC and, where water does not stay liquid, by more.
    Source: Sonntag, D. (1990), Z. Meteorol. 70, 340-344, equation (7).
    """
    return _saturation(temperature, SATURATION_WATER, WATER_RANGE)


def saturation_pressure_water_slope(temperature: Number) -> Number:
    """Slope of the saturation vapour pressure over water, d e_w / dT [Pa/K].

    temperature: [K], any shape.
    Range: 173.15 K to 373.15 K, NaN outside. Derivative of `saturation_pressure_water`.
    """
    return _saturation(temperature, SATURATION_WATER, WATER_RANGE, slope=True)


def saturation_pressure_ice(temperature: Number) -> Number:
    """Saturation vapour pressure over ice [Pa].

    temperature: [K], any shape.
    ln(e_i / hPa) = -6024.5282/T + 24.7219 + 1.0613868e-2 T - 1.3198825e-5 T^2 - 0.49382577 ln T
    Range: 173.15 K to 273.16 K (-100 degC to the triple point), NaN outside. Within 0.04 % of
    the IAPWS sublimation pressure down to -40 degC.
    Source: Sonntag, D. (1990), Z. Meteorol. 70, 340-344, equation (8).
    """
    return _saturation(temperature, SATURATION_ICE, ICE_RANGE)


def saturation_pressure_ice_slope(temperature: Number) -> Number:
    """Slope of the saturation vapour pressure over ice, d e_i / dT [Pa/K].

    temperature: [K], any shape.
    Range: 173.15 K to 273.16 K, NaN outside. Derivative of `saturation_pressure_ice`.
    """
    return _saturation(temperature, SATURATION_ICE, ICE_RANGE, slope=True)


@cache
def _bounds(coefficients: tuple[float, ...], valid: tuple[float, float]) -> tuple[float, float]:
    """Saturation pressures [Pa] at the ends of a range."""
    lowest, highest = (float(_saturation(bound, coefficients, valid)) for bound in valid)
    return lowest, highest


def _inverse(
    vapour_pressure: Number,
    coefficients: tuple[float, ...],
    valid: tuple[float, float],
    magnus: tuple[float, float],
) -> Number:
    """The temperature [K] at which `_saturation` returns the given pressure."""
    pressure = _as_number(vapour_pressure)
    lowest, highest = _bounds(coefficients, valid)
    # Round-off must not push the saturation pressure of a bound itself outside.
    inside = _between(pressure, lowest * (1.0 - 1e-12), highest * (1.0 + 1e-12))
    with np.errstate(all="ignore"):
        log_pressure = np.log(np.where(inside, pressure, 0.5 * (lowest + highest)))
        steepness, offset = magnus
        ratio = log_pressure - math.log(611.2)
        temperature = ZERO_CELSIUS_K + offset * ratio / (steepness - ratio)
        for _ in range(_NEWTON_STEPS):
            excess = _log_saturation(temperature, coefficients) - log_pressure
            temperature = temperature - excess / _log_saturation_slope(temperature, coefficients)
    return _nan_outside(inside, temperature)


def dew_point(vapour_pressure: Number) -> Number:
    """Dew-point temperature, with respect to water also below 0 degC [K].

    vapour_pressure: [Pa], any shape.
    Inverse of `saturation_pressure_water` by Newton's method on ln e, to 1e-10 relative.
    Range: dew points of 173.15 K to 373.15 K (0.0036 Pa to 101.4 kPa), NaN outside.
    """
    return _inverse(vapour_pressure, SATURATION_WATER, WATER_RANGE, (17.62, 243.12))


def frost_point(vapour_pressure: Number) -> Number:
    """Frost-point temperature, with respect to ice [K].

    vapour_pressure: [Pa], any shape.
    Inverse of `saturation_pressure_ice` by Newton's method on ln e, to 1e-10 relative.
    Range: frost points of 173.15 K to 273.16 K (0.0014 Pa to 611.7 Pa), NaN outside.
    """
    return _inverse(vapour_pressure, SATURATION_ICE, ICE_RANGE, (22.46, 272.62))


def vapour_pressure(relative_humidity: Number, temperature: Number) -> Number:
    """Vapour pressure from relative humidity, e = h e_w(T) [Pa].

    relative_humidity: [-] fraction over water, any shape; not clipped to 0...1.
    temperature: [K], any shape. Range: that of `saturation_pressure_water`, NaN outside.
    """
    return _as_number(relative_humidity) * saturation_pressure_water(temperature)


def vapour_pressure_from_absolute_humidity(absolute_humidity: Number, temperature: Number) -> Number:
    """Vapour pressure from absolute humidity, e = c R_v T [Pa].

    absolute_humidity: [kg/m3], any shape. temperature: [K] > 0, any shape; NaN otherwise.
    """
    kelvin = _as_number(temperature)
    pressure = _as_number(absolute_humidity) * GAS_CONSTANT_VAPOUR * kelvin
    return _nan_outside(kelvin.real > 0.0, pressure)


def absolute_humidity_from_vapour_pressure(vapour_pressure: Number, temperature: Number) -> Number:
    """Absolute humidity from vapour pressure, c = e / (R_v T) [kg/m3].

    vapour_pressure: [Pa], any shape. temperature: [K] > 0, any shape; NaN otherwise.
    """
    kelvin = _as_number(temperature)
    with np.errstate(all="ignore"):
        concentration = _as_number(vapour_pressure) / (GAS_CONSTANT_VAPOUR * kelvin)
    return _nan_outside(kelvin.real > 0.0, concentration)


def absolute_humidity(relative_humidity: Number, temperature: Number) -> Number:
    """Absolute humidity: vapour mass per volume of moist air, c = h e_w(T) / (R_v T) [kg/m3].

    relative_humidity: [-] fraction over water, any shape; not clipped to 0...1.
    temperature: [K], any shape. Range: that of `saturation_pressure_water`, NaN outside.
    """
    return absolute_humidity_from_vapour_pressure(
        vapour_pressure(relative_humidity, temperature), temperature
    )


def absolute_humidity_from_dew_point(dew_point: Number, temperature: Number) -> Number:
    """Absolute humidity from dew point, c = e_w(T_dew) / (R_v T) [kg/m3].

    dew_point: [K] over water, any shape; range of `saturation_pressure_water`, NaN outside.
    temperature: [K] > 0 of the air itself, any shape; NaN otherwise.
    """
    return absolute_humidity_from_vapour_pressure(saturation_pressure_water(dew_point), temperature)


def relative_humidity(absolute_humidity: Number, temperature: Number) -> Number:
    """Relative humidity over water, h = c R_v T / e_w(T) [-].

    absolute_humidity: [kg/m3], any shape; h is not clipped to 0...1.
    temperature: [K], any shape. Range: that of `saturation_pressure_water`, NaN outside.
    """
    saturated = saturation_pressure_water(temperature)
    return vapour_pressure_from_absolute_humidity(absolute_humidity, temperature) / saturated


def absolute_humidity_slope_temperature(relative_humidity: Number, temperature: Number) -> Number:
    """Slope of absolute humidity in temperature, (dc/dT)_h = c (e_w'/e_w - 1/T) [kg/(m3 K)].

    relative_humidity: [-] fraction over water, any shape, held constant.
    temperature: [K], any shape. Range: that of `saturation_pressure_water`, NaN outside.
    """
    kelvin = _as_number(temperature)
    with np.errstate(all="ignore"):
        relative = _log_saturation_slope(kelvin, SATURATION_WATER) - 1.0 / kelvin
    return absolute_humidity(relative_humidity, temperature) * relative


def vapour_pressure_from_humidity_ratio(humidity_ratio: Number, pressure: Number) -> Number:
    """Vapour pressure from humidity ratio, e = w p / (eps + w) [Pa].

    humidity_ratio: [kg/kg] >= 0, any shape; NaN otherwise. pressure: [Pa], any shape.
    """
    ratio = _as_number(humidity_ratio)
    with np.errstate(all="ignore"):
        vapour = ratio * _as_number(pressure) / (MASS_RATIO + ratio)
    return _nan_outside(ratio.real >= 0.0, vapour)


def vapour_pressure_from_specific_humidity(specific_humidity: Number, pressure: Number) -> Number:
    """Vapour pressure from specific humidity, e = q p / (eps + (1 - eps) q) [Pa].

    specific_humidity: [kg/kg] in 0...1, any shape; NaN otherwise. pressure: [Pa], any shape.
    """
    fraction = _as_number(specific_humidity)
    with np.errstate(all="ignore"):
        vapour = fraction * _as_number(pressure) / (MASS_RATIO + (1.0 - MASS_RATIO) * fraction)
    return _nan_outside(_between(fraction, 0.0, 1.0), vapour)


# -- the coldest surface in a cabinet, on which vapour condenses first ---------------------------------------
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
    taken over ice below freezing.  Equivalently, the surface is colder than the dew point or frost point.
    """
    cold = np.minimum(surface_K, ZERO_CELSIUS_K)
    saturated = np.where(
        surface_K < ZERO_CELSIUS_K, saturation_pressure_ice(cold), saturation_pressure_water(surface_K)
    )
    return vapour_pressure > saturated
