"""The cabinet: heat and vapour balances in physical units and their integrator.

Heat: the equipment (C_conv) gives its heat through R_IC to the cabinet air, which stores none,
and the air through R_AT to the outside; on demand a wall (C_wall) divides R_AT in two.
Vapour: the air (V) exchanges it with the outside by diffusion through gaps, whose resistance
R_D* = length / (area D(T_amb)) falls with temperature as D does (exponent 1.8).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

DIFFUSIVITY_273 = 2.26e-5
"""[m2/s] of water vapour in air at 273 K and 1 bar; its value cancels in every time constant."""

VAPOUR_BALANCES = ("paper", "mass")


@dataclass(frozen=True)
class Cabinet:
    """Parameters of one cabinet.

    heat_capacity: [J/K] of the equipment. outer_resistance: [K/W] air to outside (R_AT).
    inner_resistance: [K/W] equipment to air (R_IC), 0 allowed.
    wall_capacity: [J/K], 0 = no wall. wall_place: [-] share of R_AT on the wall's inner side.
    volume: [m3] of air. gap: [m] area over length of the diffusion path.
    operation_W: (at rest [W], per rated power [W], per its square [W], per K of T_amb [W/K]).
    standstill_W: ([W], [W/K]); both count T_amb from 283.15 K. preheating_W: [W] while on.
    rated_W: [W] rated power.
    vapour_balance: "paper" keeps the equivalent volume constant as equation (4) does, "mass"
        balances the vapour mass in a closed volume.
    """

    heat_capacity: float
    outer_resistance: float
    inner_resistance: float
    volume: float
    gap: float
    operation_W: tuple[float, float, float, float]
    standstill_W: tuple[float, float]
    preheating_W: float = 0.0
    rated_W: float = 2.05e6
    wall_capacity: float = 0.0
    wall_place: float = 0.5
    vapour_balance: str = "paper"

    def __post_init__(self) -> None:
        if self.vapour_balance not in VAPOUR_BALANCES:
            raise ValueError(
                f"vapour_balance must be one of {VAPOUR_BALANCES}, found {self.vapour_balance!r}"
            )

    @property
    def thermal_h(self) -> float:
        """(R_AT + R_IC) C_conv [h]."""
        return (self.outer_resistance + self.inner_resistance) * self.heat_capacity / 3600.0

    @property
    def rho(self) -> float:
        """R_AT / (R_AT + R_IC) [-]."""
        return self.outer_resistance / (self.outer_resistance + self.inner_resistance)

    @property
    def hygric_constant_h(self) -> float:
        """k of equation (4) [h]: length times volume over area times diffusivity at 273 K."""
        return self.volume / (self.gap * DIFFUSIVITY_273) / 3600.0

    def hygric_h(self, cabinet_K: float, ambient_K: float) -> float:
        """R_D* V* [h] at given temperatures."""
        return self.hygric_constant_h * 273.0**1.8 / (cabinet_K * ambient_K**0.8)

    def diffusion_resistance(self, ambient_K: np.ndarray) -> np.ndarray:
        """R_D* [s/m3]."""
        return 1.0 / (self.gap * DIFFUSIVITY_273 * (ambient_K / 273.0) ** 1.8)

    def heat_release(self, power_W: np.ndarray, ambient_K: np.ndarray, preheating: np.ndarray) -> np.ndarray:
        """Heat released into the equipment [W]."""
        share, warmer = power_W / self.rated_W, ambient_K - 283.15
        at_rest, linear, square, slope = self.operation_W
        operation = at_rest + linear * share + square * share**2 + slope * warmer
        standstill = self.standstill_W[0] + self.standstill_W[1] * warmer
        return np.where(power_W > 0.0, operation, standstill) + self.preheating_W * preheating


@dataclass(frozen=True)
class Forcing:
    """What drives the balances beside the outside air, held over each step, (T - 1,).

    heat_W: [W] into the equipment. vapour_kg_s: [kg/s] into the cabinet air.
    """

    heat_W: np.ndarray
    vapour_kg_s: np.ndarray


@dataclass(frozen=True)
class Trajectory:
    """True states at the instants of the drivers, (T,).

    converter_K, wall_K, cabinet_K: [K]. equivalent_kg_m3: [kg/m3] c*. cabinet_kg_m3: [kg/m3].
    """

    converter_K: np.ndarray
    wall_K: np.ndarray
    cabinet_K: np.ndarray
    equivalent_kg_m3: np.ndarray
    cabinet_kg_m3: np.ndarray


@njit(cache=True)
def _flows(state, ambient, outside, heat, vapour, fixed):
    """Rates of (equipment [K/s], wall [K/s], vapour store) and the air temperature [K]."""
    capacity, outer, inner, wall_capacity, place, volume, permeance, closed = fixed
    walled = wall_capacity > 0.0
    near = outer * place if walled else outer
    neighbour = state[1] if walled else ambient
    flow = (state[0] - neighbour) / (near + inner)
    air = neighbour + near * flow
    equipment_rate = (heat - flow) / capacity
    wall_rate = 0.0
    if walled:
        wall_rate = (flow - (state[1] - ambient) / (outer - near)) / wall_capacity
    equivalent = state[2] * air / (volume * ambient) if closed else state[2]
    inflow = permeance * (ambient / 273.0) ** 1.8 * (outside - equivalent) + vapour
    vapour_rate = inflow if closed else inflow * air / (volume * ambient)
    return equipment_rate, wall_rate, vapour_rate, air


@njit(cache=True)
def _runge_kutta(start, ambient, outside, heat, vapour, step_s, substeps, fixed):
    size = ambient.size
    store = np.empty((size, 4))
    state = start.copy()
    trial = np.empty(3)
    _, _, _, air = _flows(state, ambient[0], outside[0], heat[0], vapour[0], fixed)
    store[0, :3] = state
    store[0, 3] = air
    width = step_s / substeps
    # Classical Runge-Kutta coefficients; the drivers run straight within a step.
    nodes = np.array([0.0, 0.5, 0.5, 1.0])
    weights = np.array([1.0, 2.0, 2.0, 1.0]) / 6.0
    for step in range(size - 1):
        for sub in range(substeps):
            total = np.zeros(3)
            rates = (0.0, 0.0, 0.0, 0.0)
            for stage in range(4):
                reach = nodes[stage] * width
                for which in range(3):
                    trial[which] = state[which] + reach * rates[which]
                share = (sub + nodes[stage]) / substeps
                rates = _flows(
                    trial,
                    ambient[step] + share * (ambient[step + 1] - ambient[step]),
                    outside[step] + share * (outside[step + 1] - outside[step]),
                    heat[step],
                    vapour[step],
                    fixed,
                )
                for which in range(3):
                    total[which] += weights[stage] * rates[which]
            for which in range(3):
                state[which] += width * total[which]
        _, _, _, air = _flows(state, ambient[step + 1], outside[step + 1], heat[step], vapour[step], fixed)
        store[step + 1, :3] = state
        store[step + 1, 3] = air
    return store


def integrate(
    cabinet: Cabinet,
    step_s: float,
    ambient_K: np.ndarray,
    ambient_kg_m3: np.ndarray,
    forcing: Forcing,
    substeps: int = 1,
) -> Trajectory:
    """States of the cabinet from its balance at the first instant on.

    step_s: [s] between the instants. ambient_K [K], ambient_kg_m3 [kg/m3]: (T,), straight
    between instants. substeps: fourth-order Runge-Kutta steps an instant.
    """
    closed = cabinet.vapour_balance == "mass"
    through = cabinet.outer_resistance + cabinet.inner_resistance
    heat, vapour = float(forcing.heat_W[0]), float(forcing.vapour_kg_s[0])
    ambient, outside = float(ambient_K[0]), float(ambient_kg_m3[0])
    converter = ambient + through * heat
    air = ambient + cabinet.outer_resistance * heat
    wall = ambient + cabinet.outer_resistance * (1.0 - cabinet.wall_place) * heat
    equivalent = outside + vapour * float(cabinet.diffusion_resistance(np.array(ambient)))
    stored = cabinet.volume * equivalent * ambient / air if closed else equivalent
    store = _runge_kutta(
        np.array([converter, wall, stored]),
        # One layout of the arrays, or the kernel is compiled once more for slices.
        np.ascontiguousarray(ambient_K),
        np.ascontiguousarray(ambient_kg_m3),
        np.ascontiguousarray(forcing.heat_W),
        np.ascontiguousarray(forcing.vapour_kg_s),
        float(step_s),
        substeps,
        (
            cabinet.heat_capacity,
            cabinet.outer_resistance,
            cabinet.inner_resistance,
            cabinet.wall_capacity,
            cabinet.wall_place,
            cabinet.volume,
            cabinet.gap * DIFFUSIVITY_273,
            closed,
        ),
    )
    cabinet_K = store[:, 3].copy()
    equivalent_kg_m3 = store[:, 2].copy()
    if closed:
        equivalent_kg_m3 *= cabinet_K / (cabinet.volume * ambient_K)
    return Trajectory(
        converter_K=store[:, 0].copy(),
        wall_K=store[:, 1].copy() if cabinet.wall_capacity > 0.0 else ambient_K.copy(),
        cabinet_K=cabinet_K,
        equivalent_kg_m3=equivalent_kg_m3,
        cabinet_kg_m3=equivalent_kg_m3 * ambient_K / cabinet_K,
    )
