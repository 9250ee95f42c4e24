"""Random processes, each stationary from its first instant."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def first_order(gain: float, drive: np.ndarray, start: float) -> np.ndarray:
    """x[0] = start, x[n] = gain x[n - 1] + drive[n]; as long as `drive`, whose first is unused."""
    result = np.empty(drive.size)
    result[0] = start
    for step in range(1, drive.size):
        result[step] = gain * result[step - 1] + drive[step]
    return result


def log_uniform(random: np.random.Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def ornstein_uhlenbeck(
    random: np.random.Generator, size: int, step_h: float, correlation_h: float
) -> np.ndarray:
    """Ornstein-Uhlenbeck process of mean 0 and variance 1 at equal steps, (size,)."""
    gain = math.exp(-step_h / correlation_h)
    normal = random.standard_normal(size)
    return first_order(gain, math.sqrt(1.0 - gain**2) * normal, normal[0])


def shots(random: np.random.Generator, size: int, step_h: float, correlation_h: float) -> np.ndarray:
    """Decaying jumps of either sign: the spectrum of an Ornstein-Uhlenbeck process, not Gaussian.

    One jump in three correlation times on average; variance 1 in expectation.
    """
    gain = math.exp(-step_h / correlation_h)
    chance = step_h / (3.0 * correlation_h)
    jumps = (random.random(size) < chance) * random.standard_normal(size)
    scale = math.sqrt((1.0 - gain**2) / chance)
    return first_order(gain, scale * jumps, float(random.standard_normal()))


def power_law(
    random: np.random.Generator, size: int, step_h: float, exponent: float, slowest_h: float
) -> np.ndarray:
    """Gaussian process with spectrum (f^2 + f_slowest^2)^(-exponent/2), variance 1."""
    # Twice the length is made and half thrown away, for the Fourier series is periodic.
    frequency = np.fft.rfftfreq(2 * size, step_h)
    spectrum = (frequency**2 + slowest_h**-2.0) ** (-exponent / 4.0)
    spectrum[0] = 0.0
    normal = random.standard_normal((2, frequency.size))
    values = np.fft.irfft(spectrum * (normal[0] + 1j * normal[1]), 2 * size)[:size]
    # Each of the frequencies adds (2 spectrum / length)^2 to the variance.
    return values * size / math.sqrt(float(np.sum(spectrum**2)))


def low_pass(values: np.ndarray, step_h: float, lag_h: float) -> np.ndarray:
    """First-order lag of a series at equal steps, starting settled."""
    gain = math.exp(-step_h / lag_h)
    return first_order(gain, (1.0 - gain) * values, float(values[0]))
