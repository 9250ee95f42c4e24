"""Cabinets of another make: two nodes, natural convection, breathing, mist, and disturbances that flare up.

Nothing is hidden in them.  They are what no network of two resistances describes: so they show what a
likelihood makes of a cabinet whose form is not the model's, where no cause is to be named.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from plants.cabinet import DIFFUSIVITY_273, Forcing, Trajectory
from plants.chance import ornstein_uhlenbeck
from plants.drivers import MINUTE_S, Drivers
from plants.hidden import HIDDEN_OPTIONS
from plants.loggers import Logging, log_plant
from plants.plant import Plant, ingredients, plant, truth_of

USUAL_K = 8.0
"""[K] temperature difference at which the conductances are those of the cabinet's parameters."""
AIR_SHARE = (0.03, 0.1)
"""Share of the heat capacity that the air and what hangs in it have."""
TO_AIR = (0.05, 0.35)
"""Share of the heat that goes into the air at once."""
CONVECTIVE = (0.1, 0.9)
"""Share of the conductance, and of the exchange of air, that natural convection makes."""
WARMTH = (0.3, 1.0)
"""Heat release as a share of the cabinet's parameters: cool cabinets reach saturation."""
MOST = 3.5
"""Standard deviations that a disturbance does not pass: no flow of heat or vapour is without bounds."""


@njit(cache=True)
def _saturation(kelvin):
    """Density of saturated vapour over water [kg/m3], Magnus."""
    celsius = kelvin - 273.15
    return 610.94 * np.exp(17.625 * celsius / (243.04 + celsius)) / (461.5 * kelvin)


@njit(cache=True)
def _course(ambient, outside, heat, vapour, fixed):
    """Equipment [K], air [K] and all water in the air [kg/m3] by steps of a minute."""
    capacity, outer, inner, volume, permeance, air_share, to_air, loss, draught = fixed
    size = ambient.size
    store = np.empty((size, 3))
    metal = ambient[0] + heat[0] * (outer + inner)
    air = ambient[0] + heat[0] * outer
    water = outside[0] * ambient[0] / air
    for step in range(size):
        store[step, 0], store[step, 1], store[step, 2] = metal, air, water
        if step == size - 1:
            break
        apart = abs(air - ambient[step])
        out = ((1.0 - loss) + loss * (apart / USUAL_K + 1e-3) ** 0.25) / outer
        between = 1.0 / inner
        power = heat[step]
        metal += 60.0 / ((1.0 - air_share) * capacity) * ((1.0 - to_air) * power - between * (metal - air))
        # the air settles within a minute or two: towards its balance, exactly
        balance = (between * metal + out * ambient[step] + to_air * power) / (between + out)
        before = air
        air = balance + (air - balance) * np.exp(-60.0 * (between + out) / (air_share * capacity))
        pace = (
            permeance
            * ((1.0 - draught) + draught * np.sqrt(apart / USUAL_K))
            * (ambient[step] / 273.0) ** 1.8
        )
        inside = water * air / ambient[step]
        water += 60.0 / volume * (pace * (outside[step] - inside) + vapour[step])
        # breathing: air that cools draws in what is outside, air that warms leaves with what it holds
        if air < before:
            water += (before / air - 1.0) * outside[step] * ambient[step] / air
        else:
            water *= before / air
        water = max(water, 1e-5)
    return store


def convection(drivers: Drivers, forcing: Forcing, fixed: tuple[float, ...]) -> Trajectory:
    """States of a convecting cabinet; vapour beyond saturation floats as mist and evaporates again."""
    store = _course(
        np.ascontiguousarray(drivers.ambient_K),
        np.ascontiguousarray(drivers.ambient_kg_m3),
        np.ascontiguousarray(forcing.heat_W),
        np.ascontiguousarray(forcing.vapour_kg_s),
        fixed,
    )
    metal, air, water = (np.ascontiguousarray(column) for column in store.T)
    shown = np.minimum(water, _saturation(air))
    return Trajectory(
        converter_K=metal,
        wall_K=drivers.ambient_K.copy(),
        cabinet_K=air,
        equivalent_kg_m3=shown * air / drivers.ambient_K,
        cabinet_kg_m3=shown,
    )


def _flaring(random: np.random.Generator, disturbance: np.ndarray) -> np.ndarray:
    """The disturbance with a size that wanders by the day, of the same mean square and within bounds."""
    step_h = MINUTE_S / 3600.0
    wandering = ornstein_uhlenbeck(random, len(disturbance), step_h, float(random.uniform(12.0, 48.0)))
    size = float(np.sqrt(np.mean(disturbance**2)))
    flared = disturbance * np.exp(random.uniform(0.0, 0.7) * wandering)
    flared = MOST * np.tanh(flared / np.sqrt(np.mean(flared**2)) / MOST)
    return flared * size / float(np.sqrt(np.mean(flared**2)))


def _build(name: str, seed: int, drivers: Drivers, logging: Logging, **options: object) -> Plant:
    made = ingredients(seed, drivers, **options)  # type: ignore[arg-type]
    random = np.random.default_rng(np.random.SeedSequence([seed, 11]))
    cabinet = made.cabinet
    released = cabinet.heat_release(drivers.power_W[:-1], drivers.held_ambient_K, drivers.preheating[:-1])
    forcing = Forcing(
        heat_W=random.uniform(*WARMTH) * released + _flaring(random, made.forcing.heat_W - released),
        vapour_kg_s=_flaring(random, made.forcing.vapour_kg_s),
    )
    fixed = (
        cabinet.heat_capacity,
        cabinet.outer_resistance,
        cabinet.inner_resistance,
        cabinet.volume,
        cabinet.gap * DIFFUSIVITY_273,
        random.uniform(*AIR_SHARE),
        random.uniform(*TO_AIR),
        random.uniform(*CONVECTIVE),
        random.uniform(*CONVECTIVE),
    )
    trajectory = convection(drivers, forcing, fixed)
    series, biases = log_plant(np.random.default_rng(made.logger_seed), drivers, trajectory, logging)
    truth = truth_of(made, drivers, logging, trajectory, biases)
    return Plant(name, seed, cabinet, drivers, forcing, trajectory, series, truth)


def convecting_plant(seed: int, *, days: float = 180.0, **options: object) -> Plant:
    """A random cabinet of this make, which hides nothing, under the weather, operation and loggers of hidden
    plants.

    The time constant of its vapour is drawn from 0.3 to 30 h.  options: those of `plant`.
    """
    random = np.random.default_rng(np.random.SeedSequence([seed, 12]))
    hygric_h = float(np.exp(random.uniform(np.log(0.3), np.log(30.0))))
    return plant(seed, days=days, build=_build, **{**HIDDEN_OPTIONS, "hygric_h": hygric_h, **options})  # type: ignore[arg-type]
