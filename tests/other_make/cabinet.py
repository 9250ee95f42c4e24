"""A converter cabinet in physical units, and the integrator of its balances.

Heat: the converter (heat capacity C) gives its heat through R_IC to the cabinet air, which stores none, and
the air through R_AT to the ambient air.  On demand there is a second mass beside the air, or both
conductances rise with the temperature difference, as in natural convection.

Vapour: c* = c_a T_a/T_amb exchanges with the ambient air through gaps by diffusion, D = D₂₇₃ (T_amb/273
K)^1.8: V (T_amb/T_a) dc*/dt = (A/L) D(T_amb) (c_outside − c*).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

DIFFUSIVITY_273 = 2.2e-5
"""[m²/s] of water vapour in air at 273 K."""
CONVECTION_REFERENCE_K = 10.0
"""[K] difference between cabinet and ambient air at which the conductances are those of the resistances
given."""
LEAST_DIFFERENCE_K = 0.05
"""[K] below which conduction keeps the conductance up."""


@dataclass(frozen=True)
class Cabinet:
    """Parameters of one cabinet.

    heat_capacity: [J/K] C of the converter. outer_resistance, inner_resistance: [K/W] R_AT (air to ambient)
        and R_IC (converter to air), at CONVECTION_REFERENCE_K where there is convection.
    volume: [m³] of air. gap: [m] cross-section over length of the diffusion path.
    operation_W: heat release (idle [W], per share of rated power [W], per its square [W], per K of T_amb
        above 10 °C [W/K]). standstill_W: ([W], [W/K]).
    second_capacity: [J/K], 0: none. second_resistance: [K/W] between it and the air.
    exponent: [-] n of both conductances ∝ ΔT^n.
    """

    heat_capacity: float
    outer_resistance: float
    inner_resistance: float
    volume: float
    gap: float
    operation_W: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    standstill_W: tuple[float, float] = (0.0, 0.0)
    second_capacity: float = 0.0
    second_resistance: float = np.inf
    exponent: float = 0.0

    def __post_init__(self) -> None:
        if self.exponent and self.second_capacity:
            raise ValueError(
                "a cabinet has convection or a second mass, not both: its truth would have no one form"
            )

    # -- constants -------------------------------------------------------------------------------------------
    @property
    def resistance_ratio(self) -> float:
        """R_AT/(R_AT+R_IC) [-]."""
        return self.outer_resistance / (self.outer_resistance + self.inner_resistance)

    def resistance_capacity_h(self, difference_K: float = CONVECTION_REFERENCE_K) -> float:
        """(R_AT+R_IC) C [h] at a difference between cabinet and ambient air [K]."""
        scale = (difference_K / CONVECTION_REFERENCE_K) ** -self.exponent
        return (self.outer_resistance + self.inner_resistance) * scale * self.heat_capacity / 3600.0

    def small_signal_h(self, difference_K: float = CONVECTION_REFERENCE_K) -> float:
        """C d(T_conv − T_amb)/dQ [h] at a difference between cabinet and ambient air [K].

        With Q ∝ ΔT^(1+n) a convective resistance counts by R/(1+n).
        """
        return self.resistance_capacity_h(difference_K) / (1.0 + self.exponent)

    def poles_h(self, difference_K: float = CONVECTION_REFERENCE_K) -> tuple[float, ...]:
        """Time constants [h] of the network, linearised at a difference [K], the longest first."""
        if self.second_capacity == 0.0:
            return (self.small_signal_h(difference_K),)
        inner, outer, beside = _conductances(self)
        node = inner + outer + beside
        rates = np.array(
            [
                [inner * inner / node - inner, inner * beside / node],
                [beside * inner / node, beside * beside / node - beside],
            ]
        ) / np.array([[self.heat_capacity], [self.second_capacity]])
        poles = np.linalg.eigvals(rates).real
        return tuple(sorted((-1.0 / poles / 3600.0).tolist(), reverse=True))

    @property
    def hygric_k_h(self) -> float:
        """k of equation (4) [h]: R_D* V* with 273 K inside and outside."""
        return self.volume / (self.gap * DIFFUSIVITY_273) / 3600.0

    def hygric_h(self, cabinet_K: float, ambient_K: float) -> float:
        """R_D* V* [h] at a cabinet and an ambient temperature [K]."""
        resistance = 1.0 / (self.gap * DIFFUSIVITY_273 * (ambient_K / 273.0) ** 1.8)
        return resistance * self.volume * ambient_K / cabinet_K / 3600.0

    def heat_release_W(self, share: np.ndarray, running: np.ndarray, ambient_K: np.ndarray) -> np.ndarray:
        """Heat release [W] at a share of rated power [-]."""
        warm = ambient_K - 283.15
        idle, linear, square, slope = self.operation_W
        base, base_slope = self.standstill_W
        on = idle + linear * share + square * share**2 + slope * warm
        return np.where(running, on, base + base_slope * warm)


@dataclass(frozen=True)
class Trajectory:
    """States (T,) on the grid: converter_K, second_K, cabinet_K [K]; equivalent_kg_m3 [kg/m³], c*."""

    converter_K: np.ndarray
    second_K: np.ndarray
    cabinet_K: np.ndarray
    equivalent_kg_m3: np.ndarray

    def cabinet_kg_m3(self, ambient_K: np.ndarray) -> np.ndarray:
        """Vapour concentration of the cabinet air [kg/m³]."""
        return self.equivalent_kg_m3 * ambient_K / self.cabinet_K


def _conductances(cabinet: Cabinet) -> np.ndarray:
    """[W/K]: converter–air, air–ambient, air–second mass."""
    beside = 1.0 / cabinet.second_resistance if cabinet.second_capacity else 0.0
    return np.array([1.0 / cabinet.inner_resistance, 1.0 / cabinet.outer_resistance, beside])


@njit(cache=True)
def _air(converter, second, ambient, g, exponent):
    """Temperature of the cabinet air [K] and the factor of the inner conductance."""
    air = (g[0] * converter + g[1] * ambient + g[2] * second) / (g[0] + g[1] + g[2])
    if exponent == 0.0:
        return air, 1.0
    # one flow passes both surfaces: the two differences keep their ratio, and so one factor serves both
    difference = max(abs(air - ambient), LEAST_DIFFERENCE_K)
    return air, (difference / CONVECTION_REFERENCE_K) ** exponent


@njit(cache=True)
def _rates(converter, second, vapour, ambient, outside, heat, g, capacities, exchange, exponent):
    air, factor = _air(converter, second, ambient, g, exponent)
    to_air = factor * g[0] * (converter - air)
    first_rate = (heat - to_air) / capacities[0]
    second_rate = g[2] * (air - second) / capacities[1] if capacities[1] > 0.0 else 0.0
    # (A/L) D(T_amb) / (V T_amb/T_a)
    rate = exchange * (ambient / 273.0) ** 1.8 * air / ambient
    return first_rate, second_rate, rate * (outside - vapour)


@njit(cache=True)
def _integrate(start, ambient, outside, heat, step, g, capacities, exchange, exponent):
    """Shu and Osher's third-order Runge–Kutta steps; inputs run straight, the heat is held over a step."""
    size = ambient.size
    store = np.empty((4, size))
    t, s, v = start
    for k in range(size):
        air, _ = _air(t, s, ambient[k], g, exponent)
        store[0, k], store[1, k], store[2, k], store[3, k] = t, s, air, v
        if k == size - 1:
            break
        q = heat[k]
        a0, a1 = ambient[k], ambient[k + 1]
        o0, o1 = outside[k], outside[k + 1]
        dt, ds, dv = _rates(t, s, v, a0, o0, q, g, capacities, exchange, exponent)
        t1, s1, v1 = t + step * dt, s + step * ds, v + step * dv
        dt, ds, dv = _rates(t1, s1, v1, a1, o1, q, g, capacities, exchange, exponent)
        t2 = 0.75 * t + 0.25 * (t1 + step * dt)
        s2 = 0.75 * s + 0.25 * (s1 + step * ds)
        v2 = 0.75 * v + 0.25 * (v1 + step * dv)
        am, om = 0.5 * (a0 + a1), 0.5 * (o0 + o1)
        dt, ds, dv = _rates(t2, s2, v2, am, om, q, g, capacities, exchange, exponent)
        t = t / 3.0 + 2.0 / 3.0 * (t2 + step * dt)
        s = s / 3.0 + 2.0 / 3.0 * (s2 + step * ds)
        v = v / 3.0 + 2.0 / 3.0 * (v2 + step * dv)
    return store


def integrate(
    cabinet: Cabinet,
    step_s: float,
    ambient_K: np.ndarray,
    outside_kg_m3: np.ndarray,
    heat_W: np.ndarray,
    start: tuple[float, float, float] | None = None,
) -> Trajectory:
    """Balances of heat and vapour over a regular grid.

    ambient_K [K], outside_kg_m3 [kg/m³]: (T,), straight between grid points. heat_W: [W] (T,), held over the
    step that follows. start: converter and second mass [K], c* [kg/m³]; None: the ambient's, 8 K warmer.
    """
    if start is None:
        start = (ambient_K[0] + 8.0, ambient_K[0] + 4.0, outside_kg_m3[0])
    stored = _integrate(
        np.array(start, dtype=float),
        np.ascontiguousarray(ambient_K, dtype=float),
        np.ascontiguousarray(outside_kg_m3, dtype=float),
        np.ascontiguousarray(heat_W, dtype=float),
        float(step_s),
        _conductances(cabinet),
        np.array([cabinet.heat_capacity, cabinet.second_capacity]),
        cabinet.gap * DIFFUSIVITY_273 / cabinet.volume,
        float(cabinet.exponent),
    )
    return Trajectory(*stored)
