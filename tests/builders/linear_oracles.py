"""Linear models in closed form, independent of the package: matrices, steps, heat release, first states."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.linalg import expm

from hygrokf.estimation.likelihood import Gaussian


def van_loan(a: np.ndarray, q: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition (n, n) and accumulated noise (n, n) of dx = A x dt + dW over a step of h [h].

    Long steps are doubled, because the block exponential overflows.
    """
    n = len(a)
    doublings = max(0, int(np.ceil(np.log2(np.abs(np.linalg.eigvals(a)).max() * h))))
    power = expm(np.block([[-a, q], [np.zeros((n, n)), a.T]]) * (h / 2**doublings))
    f = power[n:, n:].T
    noise = f @ power[:n, n:]
    for _ in range(doublings):
        noise = f @ noise @ f.T + noise
        f = f @ f
    return f, 0.5 * (noise + noise.T)


def linear_hold(a: np.ndarray, b: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Gains (n, m) of the input at the start and at the end of a step of h [h], linear in between."""
    n, m = b.shape
    block = np.zeros((n + 2 * m, n + 2 * m))
    block[:n, :n], block[:n, n : n + m] = a * h, b * h
    block[n : n + m, n + m :] = np.eye(m)
    power = expm(block)
    level, slope = power[:n, n : n + m], power[:n, n + m :]
    return level - slope, slope


def heat_release(p: Mapping[str, float], ambient: float, operating: float, power: float) -> float:
    """f_ΔT [K] of the base model at an ambient temperature [K] and a relative power [1]."""
    warm = ambient - 283.15
    active = p["heat_release_operation"] + p["heat_release_operation_ambient"] * warm
    idle = p["heat_release_standstill"] + p["heat_release_standstill_ambient"] * warm
    slope = p["heat_release_power_1"] * power + p["heat_release_power_2"] * power**2
    return operating * active + (1 - operating) * idle + slope


def thermal_matrices(p: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """A [1/h] and Q of the converter temperature and its heat disturbance."""
    ratio, tau, colour = p["resistance_ratio"], p["thermal_time_constant"], p["heat_disturbance_time"]
    noise = [p["thermal_diffusion"] ** 2, 2 * p["heat_disturbance_sd"] ** 2 / colour]
    return np.array([[-1 / tau, 1 / ratio / tau], [0, -1 / colour]]), np.diag(noise)


def thermal_force(p: Mapping[str, float], ambient: float, operating: float, power: float) -> np.ndarray:
    """Affine part (2,) of the thermal rates."""
    release = heat_release(p, ambient, operating, power)
    return np.array([(ambient + release / p["resistance_ratio"]) / p["thermal_time_constant"], 0.0])


def first_of(case: object) -> Gaussian:
    """The states, without running means, before the first reading, as each base mechanism states them."""
    p, u = case.values, {name: v[0] for name, v in case.inputs.items()}
    moments = {
        "converter_temperature": lambda: (u["ambient_temperature"] + 5.0, 25.0),
        "heat_disturbance": lambda: (0.0, p["heat_disturbance_sd"] ** 2),
        "vapour": lambda: (u["ambient_absolute_humidity"], (0.3 * u["ambient_absolute_humidity"]) ** 2),
        "vapour_disturbance": lambda: (0.0, p["vapour_disturbance_sd"] ** 2),
    }
    mean, variance = np.array([moments[name]() for name in case.model.mechanism_states]).T
    return Gaussian(mean, np.diag(variance))
