"""Compiled heat and vapour balances with every hidden mechanism: `run` is called by
`plants.chamber`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from plants.saturation import VAPOUR_GAS_CONSTANT

LAYERS = 6
LATENT_J_KG = 2.45e6
"""[J/kg] heat of evaporation near 20 degC."""

_GAS_J_MOL_K = 8.314462618
_REFERENCE_K = 296.15
# Rows of the state: equipment, wall, outer wall [K], vapour, surface [K], film, pool, drained,
# dried [kg], then sorbed water by layers [kg].
_SORBED = 9


@njit(cache=True)
def saturated(kelvin):
    """Saturation pressure over water [Pa], the formula of `plants.saturation` for one number."""
    logarithm = math.log(kelvin)
    warm = 54.842763 - 6763.22 / kelvin - 4.210 * logarithm + 0.000367 * kelvin
    cold = 53.878 - 1331.22 / kelvin - 9.44523 * logarithm + 0.014025 * kelvin
    return math.exp(warm + math.tanh(0.0415 * (kelvin - 218.8)) * cold)


@njit(cache=True)
def _arrhenius(kelvin, J_mol):
    return math.exp(-J_mol / _GAS_J_MOL_K * (1.0 / kelvin - 1.0 / _REFERENCE_K))


@njit(cache=True)
def _air(state, ambient, skin, conductance, fixed, terms):
    """Temperature of the cabinet air [K], which stores no heat, and of what lies beyond it."""
    _, outer, inner, _, _, _ = fixed
    walled = terms.wall_J_K > 0.0
    near = outer * terms.wall_place if walled else outer
    neighbour = state[1] if walled else ambient + skin
    given = neighbour / near + conductance * (ambient + skin)
    air = (state[0] + inner * given) / (1.0 + inner * (1.0 / near + conductance))
    return air, near, neighbour


@njit(cache=True)
def _sorb(state, rates, air, pressure, terms, layers):
    """Rates of the sorbed water [kg/s], into `rates`; their sum."""
    material = air + terms.warmth * (state[0] - air)
    saturation = saturated(material)
    activity = pressure / saturation
    if terms.lumped_kg > 0.0:
        wet = terms.gab_k * min(max(activity, 0.0), 1.0)
        balance = terms.monolayer * terms.gab_c * wet / ((1.0 - wet) * (1.0 - wet + terms.gab_c * wet))
        rate = (terms.lumped_kg * balance - state[_SORBED]) / terms.sorption_s
        if terms.sorption_J_mol > 0.0:
            rate *= _arrhenius(material, terms.sorption_J_mol)
        rates[_SORBED] = rate
        return rate
    diffusivity = terms.slab_m2_s * _arrhenius(material, terms.slab_J_mol)
    through_air = terms.air_m_s * saturation / (VAPOUR_GAS_CONSTANT * material)
    through_face = diffusivity * terms.slab_kg_m3 / (0.5 * layers[0])
    face = state[_SORBED] / (terms.slab_m2 * layers[0] * terms.slab_kg_m3)
    flow = terms.slab_m2 * (activity - face) / (1.0 / through_air + 1.0 / through_face)
    total = flow
    for which in range(layers.size - 1):
        here = state[_SORBED + which] / layers[which]
        there = state[_SORBED + which + 1] / layers[which + 1]
        onward = diffusivity * (here - there) / (0.5 * (layers[which] + layers[which + 1]))
        rates[_SORBED + which] = flow - onward
        flow = onward
    rates[_SORBED + layers.size - 1] = flow
    return total


@njit(cache=True)
def _rates(
    state,
    rates,
    ambient,
    outside,
    skin,
    tends,
    heat,
    vapour,
    exchange,
    conductance,
    water,
    on,
    fixed,
    terms,
    layers,
):
    """Rates of all states, into `rates`; `on`: heater, stage one, stage two, dehumidifier, wet
    surface.
    """
    capacity, outer, _, volume, permeance, closed = fixed
    rates[:] = 0.0
    conductance = conductance + on[1] * terms.fan_W_K + on[2] * terms.second_W_K
    exchange = exchange + on[1] * terms.fan_exchange + on[2] * terms.second_exchange
    air, near, neighbour = _air(state, ambient, skin, conductance, fixed, terms)
    to_wall = (air - neighbour) / near
    loss = to_wall + conductance * (air - ambient - skin)
    if terms.outer_wall_J_K > 0.0:
        between = outer * terms.outer_wall_place
        onward = (state[1] - state[2]) / between
        rates[1] = (to_wall - onward) / terms.wall_J_K
        rates[2] = (onward - (state[2] - ambient - skin) / (outer - near - between)) / terms.outer_wall_J_K
    elif terms.wall_J_K > 0.0:
        rates[1] = (to_wall - (state[1] - ambient - skin) / (outer - near)) / terms.wall_J_K
    heat = heat + on[0] * terms.heater_W

    equivalent = state[3] * air / (volume * ambient) if closed else state[3]
    inside = equivalent * ambient / air
    pressure = inside * VAPOUR_GAS_CONSTANT * air
    inflow = exchange * permeance * (ambient / 273.0) ** 1.8 * (outside - equivalent) + vapour
    if terms.lumped_kg > 0.0 or terms.slab_m2 > 0.0:
        taken = _sorb(state, rates, air, pressure, terms, layers)
        inflow -= taken
        heat += terms.latent * LATENT_J_KG * taken
    if terms.film_m2 > 0.0:
        goal = ambient + terms.surface_share * (air - ambient) + tends
        rates[4] = (goal - state[4]) / terms.surface_s
        surplus = (pressure - saturated(state[4])) / (VAPOUR_GAS_CONSTANT * state[4])
        flow = terms.film_m2 * terms.film_m_s * surplus
        if surplus < 0.0:
            flow *= on[4]
            if terms.drop_kg > 0.0:
                flow *= min(max(state[5], 0.0) / terms.drop_kg, 1.0) ** (2.0 / 3.0)
        runs_off = 0.0
        if surplus > 0.0 and terms.drop_kg > 0.0 and state[5] > terms.drop_kg:
            runs_off = terms.drain * flow
        rates[5] = flow - runs_off
        rates[7] = runs_off
        inflow -= flow
    if terms.pool_m2 > 0.0:
        deficit = (saturated(air) - pressure) / (VAPOUR_GAS_CONSTANT * air)
        full = min(max(state[6], 0.0) / terms.pool_kg, 1.0)
        flow = terms.pool_m2 * terms.pool_m_s * full * max(deficit, 0.0)
        rates[6] = water - flow
        inflow += flow
    if terms.dry_m3_s > 0.0:
        removed = on[3] * terms.dry_m3_s * max(inside - terms.dry_floor, 0.0)
        rates[8] = removed
        inflow -= removed
        heat += LATENT_J_KG * removed + on[3] * terms.dry_W
    rates[0] = (heat - loss) / capacity
    rates[3] = inflow if closed else inflow * air / (volume * ambient)


@njit(cache=True)
def _switch(on, rest, which, wanted, dwell):
    """Turn a device, unless it turned less than `dwell` steps ago."""
    if rest[which] > 0:
        rest[which] -= 1
    elif wanted != on[which]:
        on[which] = wanted
        rest[which] = dwell


@njit(cache=True)
def _decide(on, rest, air, humidity, stopped, dwell, terms):
    """Positions of all devices for the step that begins."""
    if terms.heater_W > 0.0:
        wanted = on[0]
        if terms.heater_kind < 1.5 or terms.heater_kind > 2.5:
            if air < terms.heater_on:
                wanted = 1.0
            elif air > terms.heater_off:
                wanted = 0.0
        elif humidity > terms.heater_on:
            wanted = 1.0
        elif humidity < terms.heater_off:
            wanted = 0.0
        if stopped > 0.5 or terms.heater_kind > 2.5:
            _switch(on, rest, 0, wanted, dwell)
        else:
            # The start of the turbine cuts the heater off at once.
            on[0] = 0.0
            rest[0] = 0
    if terms.fan_W_K > 0.0:
        wanted = 1.0 if air > terms.fan_on_K else (0.0 if air < terms.fan_off_K else on[1])
        _switch(on, rest, 1, wanted, dwell)
    if terms.second_W_K > 0.0:
        wanted = 1.0 if air > terms.second_on_K else (0.0 if air < terms.second_off_K else on[2])
        _switch(on, rest, 2, wanted, dwell)
    if terms.dry_m3_s > 0.0:
        if terms.dry_kind < 1.5:
            wanted = 1.0 if humidity > terms.dry_on else (0.0 if humidity < terms.dry_off else on[3])
            _switch(on, rest, 3, wanted, dwell)
        else:
            on[3] = min(max((humidity - terms.dry_off) / (terms.dry_on - terms.dry_off), 0.0), 1.0)


@njit(cache=True)
def _fastest(state, ambient, air, mixing, fixed, terms, layers):
    """The fastest rate of the balances [1/s]; an open door is stiff against a minute."""
    _, outer, _, volume, permeance, _ = fixed
    fastest = permeance * (ambient / 273.0) ** 1.8 * mixing
    fastest += terms.film_m2 * terms.film_m_s + terms.pool_m2 * terms.pool_m_s + terms.dry_m3_s
    if terms.slab_m2 > 0.0:
        # Both sides of the layer at the face, twice for the sum with its neighbour; and the
        # air film in series with half a layer of polymer.
        spread = terms.slab_m2_s * _arrhenius(max(state[0], air), terms.slab_J_mol)
        dense = saturated(air) / (VAPOUR_GAS_CONSTANT * air)
        face = 2.0 * spread * terms.slab_kg_m3 / (layers[0] * dense)
        fastest += terms.slab_m2 * face * terms.air_m_s / (face + terms.air_m_s)
        fastest = max(fastest, 1.5 * volume * spread / layers[0] ** 2)
    fastest /= volume
    if terms.wall_J_K > 0.0:
        near = 1.0 / (outer * terms.wall_place)
        fastest = max(fastest, 2.0 * near / terms.wall_J_K)
        if terms.outer_wall_J_K > 0.0:
            fastest = max(fastest, (near + 1.0 / (outer * terms.outer_wall_place)) / terms.wall_J_K)
    return fastest


@njit(cache=True)
def _advance(state, step, part, parts, width, courses, held, on, fixed, terms, layers):
    """One Runge-Kutta step of `width` [s] in place; `courses` are linear over the step, `held`
    constant.
    """
    ambient, outside, skin, tends = courses
    heat, vapour, exchange, conductance, water = held
    count = state.size
    trial, total, rates = np.empty(count), np.zeros(count), np.zeros(count)
    nodes = (0.0, 0.5, 0.5, 1.0)
    weights = (1.0 / 6.0, 2.0 / 6.0, 2.0 / 6.0, 1.0 / 6.0)
    for stage in range(4):
        reach = nodes[stage] * width
        for which in range(count):
            trial[which] = state[which] + reach * rates[which]
        share = (part + nodes[stage]) / parts
        _rates(
            trial,
            rates,
            ambient[step] + share * (ambient[step + 1] - ambient[step]),
            outside[step] + share * (outside[step + 1] - outside[step]),
            skin[step] + share * (skin[step + 1] - skin[step]),
            tends[step] + share * (tends[step + 1] - tends[step]),
            heat[step],
            vapour[step],
            exchange[step],
            conductance[step],
            water[step],
            on,
            fixed,
            terms,
            layers,
        )
        for which in range(count):
            total[which] += weights[stage] * rates[which]
    for which in range(count):
        state[which] += width * total[which]


@njit(cache=True)
def run(start, courses, held, stopped, step_s, fixed, terms, layers):
    """States at all instants, (T, 14): the first nine, air [K], sorbed [kg], heater, fan,
    dehumidifier.

    courses: ambient [K], outside [kg/m3], skin [K] and the surface's [K] at the instants, (T,).
    held: heat [W], vapour [kg/s], exchange, conductance [W/K] and water [kg/s] over the steps.
    """
    ambient, _, skin, _ = courses
    _, _, exchange, conductance, _ = held
    _, _, _, volume, _, closed = fixed
    size = ambient.size
    store = np.empty((size, 14))
    state = start.copy()
    on, rest = np.zeros(5), np.zeros(4)
    dwell = terms.dwell_min * 60.0 / step_s
    for step in range(size):
        last = min(step, size - 2)
        blown = conductance[last] + on[1] * terms.fan_W_K + on[2] * terms.second_W_K
        air, _, _ = _air(state, ambient[step], skin[step], blown, fixed, terms)
        store[step, :9] = state[:9]
        store[step, 9] = air
        store[step, 10] = state[_SORBED:].sum()
        if step < size - 1:
            inside = state[3] / volume if closed else state[3] * ambient[step] / air
            pressure = inside * VAPOUR_GAS_CONSTANT * air
            _decide(on, rest, air, pressure / saturated(air), stopped[step], dwell, terms)
        store[step, 11], store[step, 12], store[step, 13] = on[0], on[1] + on[2], on[3]
        if step == size - 1:
            break
        mixing = exchange[step] + on[1] * terms.fan_exchange + on[2] * terms.second_exchange
        fastest = _fastest(state, ambient[step], air, mixing, fixed, terms, layers)
        parts = 1 + int(step_s * fastest / 0.8)
        width = step_s / parts
        for part in range(parts):
            on[4] = 1.0 if state[5] > 0.0 else 0.0
            _advance(state, step, part, parts, width, courses, held, on, fixed, terms, layers)
            for which in (5, 6):
                if state[which] < 0.0:
                    # What evaporated beyond the last drop goes back out of the air: mass is kept.
                    back = -state[which]
                    state[which] = 0.0
                    state[3] -= back if closed else back * air / (volume * ambient[step])
    return store
