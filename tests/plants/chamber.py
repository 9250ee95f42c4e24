"""The cabinet with every hidden mechanism in its balances: what `plants.cabinet` leaves out.

One kernel integrates the heat and vapour balances of `plants.cabinet` together with a second
wall layer, sorbing material, a film on a cold surface, a pool, a heater, fan stages and a
dehumidifier. Each of them has null values in `Terms` that switch it off exactly. What varies in
time from outside (doors, wind, sun on the wall, leaking rain) comes as arrays in `Exposure`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from plants.balances import LAYERS, run
from plants.cabinet import DIFFUSIVITY_273, Cabinet, Forcing, Trajectory
from plants.saturation import relative_humidity

STATES = ("film_kg", "pool_kg", "sorbed_kg", "drained_kg", "dried_kg", "surface_K", "outer_wall_K")
SWITCHES = ("heater", "fan", "dehumidifier")


class Terms(NamedTuple):
    """Parameters of the mechanisms inside the cabinet; all null by default.

    wall_J_K, wall_place: [J/K], [-] a wall, and the share of R_AT on its inner side.
    outer_wall_J_K, outer_wall_place: [J/K], [-] a second layer, and the share of R_AT between both.
    lumped_kg: [kg] dry sorbing material that follows its isotherm with one time constant.
    monolayer, gab_c, gab_k: [kg/kg], [-], [-] of the GAB isotherm. sorption_s: [s] time constant
        at 296.15 K. sorption_J_mol: [J/mol] its activation energy. warmth: [-] place of the
        material's temperature between cabinet air (0) and equipment (1).
    slab_m2, slab_m: [m2] free area and [m] thickness behind it of a polymer slab.
    slab_kg_m3: [kg/m3] water at 100 % relative humidity. slab_m2_s: [m2/s] diffusivity at
        296.15 K. slab_J_mol: [J/mol] its activation energy. air_m_s: [m/s] mass transfer from air.
    start_activity: [-] relative humidity that the material is in balance with at first.
    latent: [-] 1 = the heat of sorption goes to the equipment.
    film_m2, film_m_s: [m2], [m/s] area of the cold surface and mass transfer to it.
    surface_s, surface_share: [s], [-] lag of its temperature, and the place of what it tends to
        between ambient (0) and cabinet (1). drop_kg: [kg] 0 = film; else water that covers the
        surface with drops, less evaporating less. drain: [-] share of what condenses beyond
        drop_kg that runs off.
    pool_m2, pool_m_s, pool_kg: [m2], [m/s], [kg] evaporation of a pool that is full at pool_kg.
    heater_W, heater_kind, heater_on, heater_off: [W]; 1 thermostat [K], 2 humidistat [-]; switches
        on below (above) `on` and off above (below) `off`, only at standstill; 3 thermostat in any state.
    fan_W_K, fan_exchange, fan_on_K, fan_off_K: [W/K] conductance and [-] further vapour exchange of
        a fan stage; second_ for the second stage.
    dry_m3_s, dry_kind, dry_on, dry_off, dry_floor: [m3/s] air that a dehumidifier dries down to
        [kg/m3] dry_floor; 1 with hysteresis [-], 2 proportional between dry_off and dry_on.
    dry_W: [W] electric power while it runs; the latent heat stays in the cabinet too.
    dwell_min: [min] shortest time between two switchings of one device.
    """

    wall_J_K: float = 0.0
    wall_place: float = 0.5
    outer_wall_J_K: float = 0.0
    outer_wall_place: float = 0.25
    lumped_kg: float = 0.0
    monolayer: float = 0.02
    gab_c: float = 8.0
    gab_k: float = 0.8
    sorption_s: float = 3.6e4
    sorption_J_mol: float = 0.0
    warmth: float = 0.5
    slab_m2: float = 0.0
    slab_m: float = 1e-3
    slab_kg_m3: float = 50.0
    slab_m2_s: float = 1e-12
    slab_J_mol: float = 4e4
    air_m_s: float = 3e-3
    start_activity: float = 0.4
    latent: float = 0.0
    film_m2: float = 0.0
    film_m_s: float = 3e-3
    surface_s: float = 7.2e3
    surface_share: float = 0.1
    drop_kg: float = 0.0
    drain: float = 0.0
    pool_m2: float = 0.0
    pool_m_s: float = 3e-3
    pool_kg: float = 0.1
    heater_W: float = 0.0
    heater_kind: float = 0.0
    heater_on: float = 0.0
    heater_off: float = 0.0
    fan_W_K: float = 0.0
    fan_exchange: float = 0.0
    fan_on_K: float = 1e4
    fan_off_K: float = 1e4
    second_W_K: float = 0.0
    second_exchange: float = 0.0
    second_on_K: float = 1e4
    second_off_K: float = 1e4
    dry_m3_s: float = 0.0
    dry_kind: float = 0.0
    dry_on: float = 2.0
    dry_off: float = 2.0
    dry_floor: float = 0.0
    dry_W: float = 0.0
    dwell_min: float = 5.0


@dataclass(frozen=True)
class Exposure:
    """What comes from outside beside the ambient air.

    At the instants (T,): skin_K: [K] added to the outside temperature that heat flows to.
    surface_K: [K] added to the temperature that the cold surface tends to.
    Over the steps (T - 1,): exchange: [-] factor of the vapour exchange. conductance_W_K: [W/K]
    added between cabinet air and outside. water_kg_s: [kg/s] liquid that enters the pool.
    stopped: [-] 1 at standstill.
    """

    skin_K: np.ndarray
    surface_K: np.ndarray
    exchange: np.ndarray
    conductance_W_K: np.ndarray
    water_kg_s: np.ndarray
    stopped: np.ndarray


def no_exposure(power_W: np.ndarray) -> Exposure:
    """Nothing from outside, under a power [W] at the instants."""
    size = power_W.size
    return Exposure(
        skin_K=np.zeros(size),
        surface_K=np.zeros(size),
        exchange=np.ones(size - 1),
        conductance_W_K=np.zeros(size - 1),
        water_kg_s=np.zeros(size - 1),
        stopped=(power_W[:-1] <= 0.0).astype(float),
    )


@dataclass(frozen=True)
class Inside:
    """States of the hidden mechanisms at the instants, (T,): `STATES`, and `SWITCHES` as 0 or 1."""

    film_kg: np.ndarray
    pool_kg: np.ndarray
    sorbed_kg: np.ndarray
    drained_kg: np.ndarray
    dried_kg: np.ndarray
    surface_K: np.ndarray
    outer_wall_K: np.ndarray
    heater: np.ndarray
    fan: np.ndarray
    dehumidifier: np.ndarray


def slab_layers(thickness_m: float) -> np.ndarray:
    """Thickness of each layer [m], thin at the face that the air sees."""
    growth = 1.5 ** np.arange(LAYERS)
    return thickness_m * growth / growth.sum()


def gab(activity: np.ndarray | float, monolayer: float, gab_c: float, gab_k: float) -> np.ndarray | float:
    """Water per dry mass [kg/kg] at a relative humidity [-]: Guggenheim, Anderson, de Boer."""
    wet = gab_k * activity
    return monolayer * gab_c * wet / ((1.0 - wet) * (1.0 - wet + gab_c * wet))


def _start(
    cabinet: Cabinet, ambient_K: np.ndarray, ambient_kg_m3: np.ndarray, forcing: Forcing, terms: Terms
) -> np.ndarray:
    """States at the first instant: balances at rest under its inputs, the sorbed water as `terms` say."""
    outer = cabinet.outer_resistance
    heat, vapour = float(forcing.heat_W[0]), float(forcing.vapour_kg_s[0])
    ambient, outside = float(ambient_K[0]), float(ambient_kg_m3[0])
    air = ambient + outer * heat
    beyond = 1.0 - terms.wall_place - (terms.outer_wall_place if terms.outer_wall_J_K > 0.0 else 0.0)
    equivalent = outside + vapour * float(cabinet.diffusion_resistance(np.array(ambient)))
    closed = cabinet.vapour_balance == "mass"
    sorbing = 1 if terms.lumped_kg > 0.0 else (LAYERS if terms.slab_m2 > 0.0 else 0)
    start = np.zeros(9 + sorbing)
    start[0] = ambient + (outer + cabinet.inner_resistance) * heat
    start[1] = ambient + outer * (1.0 - terms.wall_place) * heat
    start[2] = ambient + outer * beyond * heat
    start[3] = cabinet.volume * equivalent * ambient / air if closed else equivalent
    start[4] = ambient + terms.surface_share * (air - ambient)
    if terms.lumped_kg > 0.0:
        start[9] = terms.lumped_kg * float(
            gab(terms.start_activity, terms.monolayer, terms.gab_c, terms.gab_k)
        )
    elif terms.slab_m2 > 0.0:
        start[9:] = terms.slab_m2 * slab_layers(terms.slab_m) * terms.slab_kg_m3 * terms.start_activity
    return start


def integrate_hidden(
    cabinet: Cabinet,
    step_s: float,
    ambient_K: np.ndarray,
    ambient_kg_m3: np.ndarray,
    forcing: Forcing,
    terms: Terms,
    exposure: Exposure,
) -> tuple[Trajectory, Inside]:
    """States of the cabinet with its hidden mechanisms; arguments as `plants.cabinet.integrate`."""
    closed = cabinet.vapour_balance == "mass"
    if cabinet.wall_capacity > 0.0 and terms.wall_J_K == 0.0:
        terms = terms._replace(wall_J_K=cabinet.wall_capacity, wall_place=cabinet.wall_place)
    courses = (ambient_K, ambient_kg_m3, exposure.skin_K, exposure.surface_K)
    held = (
        forcing.heat_W,
        forcing.vapour_kg_s,
        exposure.exchange,
        exposure.conductance_W_K,
        exposure.water_kg_s,
    )
    store = run(
        _start(cabinet, ambient_K, ambient_kg_m3, forcing, terms),
        tuple(np.ascontiguousarray(one) for one in courses),
        tuple(np.ascontiguousarray(one) for one in held),
        np.ascontiguousarray(exposure.stopped),
        float(step_s),
        (
            cabinet.heat_capacity,
            cabinet.outer_resistance,
            cabinet.inner_resistance,
            cabinet.volume,
            cabinet.gap * DIFFUSIVITY_273,
            closed,
        ),
        terms,
        slab_layers(terms.slab_m),
    )
    cabinet_K = store[:, 9].copy()
    equivalent_kg_m3 = store[:, 3].copy()
    if closed:
        equivalent_kg_m3 *= cabinet_K / (cabinet.volume * ambient_K)
    trajectory = Trajectory(
        converter_K=store[:, 0].copy(),
        wall_K=store[:, 1].copy() if terms.wall_J_K > 0.0 else ambient_K.copy(),
        cabinet_K=cabinet_K,
        equivalent_kg_m3=equivalent_kg_m3,
        cabinet_kg_m3=equivalent_kg_m3 * ambient_K / cabinet_K,
    )
    inside = Inside(
        film_kg=store[:, 5].copy(),
        pool_kg=store[:, 6].copy(),
        sorbed_kg=store[:, 10].copy(),
        drained_kg=store[:, 7].copy(),
        dried_kg=store[:, 8].copy(),
        surface_K=store[:, 4].copy(),
        outer_wall_K=store[:, 2].copy(),
        heater=store[:, 11].copy(),
        fan=store[:, 12].copy(),
        dehumidifier=store[:, 13].copy(),
    )
    return trajectory, inside


def usual_activity(cabinet: Cabinet, ambient_K: np.ndarray, kg_m3: np.ndarray, heat_W: np.ndarray) -> float:
    """Relative humidity [-] that a cabinet settles at under the means of its surroundings."""
    ambient = float(ambient_K.mean())
    inside = ambient + cabinet.outer_resistance * float(heat_W.mean())
    return float(relative_humidity(np.array(kg_m3.mean() * ambient / inside), np.array(inside)))
