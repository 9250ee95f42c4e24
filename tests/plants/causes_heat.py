"""Hidden causes in the heat balance: walls, sun, wind, heaters, fans, fouling, a neighbour."""

from __future__ import annotations

import numpy as np

from plants.chance import log_uniform, low_pass
from plants.drivers import DAY_S, HOUR_S, MINUTE_S
from plants.outdoors import MINUTE_H, wall_irradiance
from plants.scene import AIR_J_M3_K, Change, Law, Scene


def one_wall(random: np.random.Generator, scene: Scene) -> Law:
    """A wall in series within R_AT, 30 to 70 % of which lies on its inner side; 1 to 24 h: 20 to
    300 mm of steel or concrete between its two halves.
    """
    place = random.uniform(0.3, 0.7)
    between = scene.cabinet.outer_resistance * place * (1.0 - place)

    def change(hours: float) -> Change:
        capacity = HOUR_S * hours / between
        return Change(
            terms={"wall_J_K": capacity, "wall_place": place},
            parameters={"wall_h": hours, "inner_share": place, "capacity_MJ_K": 1e-6 * capacity},
        )

    return Law("one wall in series", 1.0, 24.0, change)


def two_walls(random: np.random.Generator, scene: Scene) -> Law:
    """Two layers in series: a light cabinet skin, then a heavy tower foot.

    Skin: 15 to 40 % of the equipment's heat capacity. The foot holds 1 to 60 times the equipment's.
    """
    inner, middle = random.uniform(0.2, 0.4), random.uniform(0.2, 0.4)
    skin = random.uniform(0.15, 0.4) * scene.cabinet.heat_capacity

    def change(ratio: float) -> Change:
        heavy = ratio * scene.cabinet.heat_capacity
        beyond = scene.cabinet.outer_resistance * (1.0 - inner - middle)
        terms = {"wall_J_K": skin, "wall_place": inner, "outer_wall_J_K": heavy, "outer_wall_place": middle}
        parameters = {
            "inner_share": inner,
            "middle_share": middle,
            "skin_MJ_K": 1e-6 * skin,
            "foot_MJ_K": 1e-6 * heavy,
            "foot_h": heavy * beyond / HOUR_S,
        }
        return Change(terms=terms, parameters=parameters)

    return Law("light skin and heavy foot", 1.0, 60.0, change)


def sun_on_roof(random: np.random.Generator, scene: Scene) -> Law:
    """Heat of so many square metres of horizontal, fully absorbing surface, with a lag of 0.1 to 1 h.

    0.01 to 3 m2 reach the equipment: a nacelle roof or a base with a glazed door.
    """
    lag_h = random.uniform(0.1, 1.0)
    sun = low_pass(scene.drivers.irradiance_W_m2, MINUTE_H, lag_h)
    held = 0.5 * (sun[:-1] + sun[1:])

    def change(area: float) -> Change:
        return Change(heat_W=area * held, parameters={"absorbing_m2": area, "lag_h": lag_h})

    return Law("gain times irradiance of a horizontal plane", 0.01, 3.0, change)


def sun_on_wall(random: np.random.Generator, scene: Scene) -> Law:
    """Sol-air temperature of a wall that faces the sun at some hour, with the lag of its own
    mass.

    Absorptance over heat transfer 0.002 to 0.06 K m2/W: 0.3 to 0.9 over 15 to 25 W/(m2 K), and
    less where only part of R_AT lies behind that wall. Azimuth east by south to west. Lag 0.5 to
    4 h.
    """
    azimuth = np.radians(random.uniform(90.0, 280.0))
    lag_h = random.uniform(0.5, 4.0)
    sun = low_pass(wall_irradiance(scene.drivers, azimuth), MINUTE_H, lag_h)

    def change(gain: float) -> Change:
        parameters = {"gain_K_m2_W": gain, "azimuth_deg": float(np.degrees(azimuth)), "lag_h": lag_h}
        return Change(skin_K=gain * sun, parameters=parameters)

    return Law("sol-air temperature of a facing wall", 0.002, 0.06, change)


def _windy(scene: Scene, relative: np.ndarray, heat_share: float) -> dict[str, np.ndarray]:
    """Exchange and a share of the heat loss go with 1 + relative; both are the nominal ones at
    the mean.
    """
    factor = (1.0 + relative) / float(np.mean(1.0 + relative))
    conductance = heat_share / scene.cabinet.outer_resistance
    return {"exchange": factor, "conductance_W_K": conductance * (factor - 1.0)}


def wind_blows(random: np.random.Generator, scene: Scene) -> Law:
    """Exchange of vapour and heat with 1 + a v; a of 0.01 to 0.67 s/m.

    McAdams' transfer of a bare plate is 5.7 + 3.8 v, hence a <= 0.67; 50 to 100 % of the loss feels it.
    """
    share = random.uniform(0.5, 1.0)
    wind = low_pass(scene.drivers.wind_m_s, MINUTE_H, 0.15)[:-1]

    def change(slope: float) -> Change:
        parameters = {"slope_s_m": slope, "heat_share": share, "mean_wind_m_s": float(wind.mean())}
        return Change(**_windy(scene, slope * wind, share), parameters=parameters)

    return Law("one plus a times wind", 0.01, 0.67, change, quantities=("temperature",))


def wind_presses(random: np.random.Generator, scene: Scene) -> Law:
    """Exchange of vapour and heat with 1 + b v2: stagnation pressure drives air through gaps of
    laminar flow.

    b of 0.0005 to 0.06 s2/m2: doubled at 4 to 45 m/s. 50 to 100 % of the loss feels it.
    """
    share = random.uniform(0.5, 1.0)
    wind = low_pass(scene.drivers.wind_m_s, MINUTE_H, 0.15)[:-1]

    def change(slope: float) -> Change:
        parameters = {"slope_s2_m2": slope, "heat_share": share, "mean_wind_m_s": float(wind.mean())}
        return Change(**_windy(scene, slope * wind**2, share), parameters=parameters)

    return Law("one plus b times wind squared", 5e-4, 0.06, change, quantities=("temperature",))


def thermostat_heater(random: np.random.Generator, scene: Scene) -> Law:
    """Heater of 100 to 2,500 W at standstill below a temperature, with hysteresis.

    Enclosure thermostats switch back 2 to 5 K higher. Set between 8 and 25 degC, where 50 to 97 %
    of the standstill lies below.
    """
    cold = scene.trajectory.cabinet_K[:-1][scene.stopped]
    point = float(np.clip(np.quantile(cold, random.uniform(0.5, 0.97)), 281.15, 298.15))
    width = random.uniform(2.0, 5.0)

    def change(watts: float) -> Change:
        terms = {"heater_W": watts, "heater_kind": 1.0, "heater_on": point, "heater_off": point + width}
        parameters = {"heater_W": watts, "set_point_degC": point - 273.15, "hysteresis_K": width}
        return Change(terms=terms, parameters=parameters)

    return Law("thermostat with hysteresis", 100.0, 2500.0, change)


def humidistat_heater(random: np.random.Generator, scene: Scene) -> Law:
    """Heater of 100 to 2,500 W at standstill above a relative humidity, with hysteresis.

    Humidistats switch back 4 to 10 % lower; set between 40 and 70 %, exceeded in 40 to 90 % of
    the standstill.
    """
    damp = scene.humidity[:-1][scene.stopped]
    point = float(np.clip(np.quantile(damp, random.uniform(0.1, 0.6)), 0.4, 0.7))
    width = random.uniform(0.04, 0.1)

    def change(watts: float) -> Change:
        terms = {"heater_W": watts, "heater_kind": 2.0, "heater_on": point, "heater_off": point - width}
        parameters = {"heater_W": watts, "set_point": point, "hysteresis": width}
        return Change(terms=terms, parameters=parameters)

    return Law("humidistat with hysteresis", 100.0, 2500.0, change)


def frost_heater(random: np.random.Generator, scene: Scene) -> Law:
    """Heater of 50 to 2,500 W below a temperature, whatever the turbine does, with hysteresis of 2 to 5 K.

    Set where 15 to 60 % of the time lies below, between 3 and 25 degC.
    """
    cold = scene.trajectory.cabinet_K[:-1]
    point = float(np.clip(np.quantile(cold, random.uniform(0.15, 0.6)), 276.15, 298.15))
    width = random.uniform(2.0, 5.0)

    def change(watts: float) -> Change:
        terms = {"heater_W": watts, "heater_kind": 3.0, "heater_on": point, "heater_off": point + width}
        parameters = {"heater_W": watts, "set_point_degC": point - 273.15, "hysteresis_K": width}
        return Change(terms=terms, parameters=parameters)

    return Law("thermostat in any state", 50.0, 2500.0, change)


def _hours(random: np.random.Generator, scene: Scene) -> tuple[np.ndarray, float, float]:
    """Whether a load is on, by the minute, over 5 to 12 h of the day; its begin [h] and length [h]."""
    begin, long = random.uniform(4.0, 14.0), random.uniform(5.0, 12.0)
    return np.mod(scene.drivers.time[:-1] / HOUR_S - begin, 24.0) < long, begin, long


def lamps(random: np.random.Generator, scene: Scene) -> Law:
    """A load of 20 to 2,000 W in the same hours of every day: lamps on a timer."""
    on, begin, long = _hours(random, scene)

    def change(watts: float) -> Change:
        return Change(heat_W=watts * on, parameters={"load_W": watts, "begin_h": begin, "hours": long})

    return Law("the same hours of every day", 20.0, 2000.0, change)


def people_at_work(random: np.random.Generator, scene: Scene) -> Law:
    """Heat of 20 to 2,000 W on workdays, with half an hour's jitter at begin and end and one day in ten
    off."""
    _, begin, long = _hours(random, scene)
    time = scene.drivers.time[:-1]
    day = np.floor(time / DAY_S - begin / 24.0).astype(int)
    first = day.min()
    count = day.max() - first + 1
    late, early = random.uniform(-0.5, 0.5, count), random.uniform(-0.5, 0.5, count)
    there = (random.random(count) > 0.1) & ((np.arange(first, first + count) + 3) % 7 < 5)
    since = time / HOUR_S - begin - 24.0 * day
    place = day - first
    on = there[place] & (since > late[place] + 0.5) & (since < long + early[place])

    def change(watts: float) -> Change:
        return Change(heat_W=watts * on, parameters={"load_W": watts, "begin_h": begin, "hours": long})

    return Law("people on workdays", 20.0, 2000.0, change)


def filter_fan(random: np.random.Generator, scene: Scene) -> Law:
    """A filter fan above a temperature: outside air of 5 to 500 m3/h carries heat and vapour.

    Set where 10 to 50 % of the time lies above, between 18 and 33 degC; switches back 2 to 5 K lower.
    """
    warm = np.quantile(scene.trajectory.cabinet_K, 1.0 - random.uniform(0.1, 0.5))
    point = float(np.clip(warm, 291.15, 306.15))
    width = random.uniform(2.0, 5.0)

    def change(flow: float) -> Change:
        terms = {
            "fan_W_K": AIR_J_M3_K * flow / HOUR_S,
            "fan_exchange": flow / HOUR_S / scene.air_flow_m3_s,
            "fan_on_K": point,
            "fan_off_K": point - width,
        }
        parameters = {"air_m3_h": flow, "set_point_degC": point - 273.15, "hysteresis_K": width}
        return Change(terms=terms, parameters=parameters)

    return Law("filter fan with hysteresis", 5.0, 500.0, change)


def coolant_stages(random: np.random.Generator, scene: Scene) -> Law:
    """Two stages of a closed heat exchanger, the second as strong as the first; no air is
    exchanged.

    First stage where 20 to 45 % of the time lies above, second 3 to 6 K higher, both back 2 to 5
    K lower; each adds 5 % to three times the conductance of the enclosure.
    """
    warm = np.quantile(scene.trajectory.cabinet_K, 1.0 - random.uniform(0.2, 0.45))
    point = float(np.clip(warm, 289.15, 303.15))
    width, step = random.uniform(2.0, 5.0), random.uniform(3.0, 6.0)

    def change(ratio: float) -> Change:
        conductance = ratio / scene.cabinet.outer_resistance
        terms = {
            "fan_W_K": conductance,
            "fan_on_K": point,
            "fan_off_K": point - width,
            "second_W_K": conductance,
            "second_on_K": point + step,
            "second_off_K": point + step - width,
        }
        parameters = {
            "stage_W_K": conductance,
            "set_point_degC": point - 273.15,
            "second_set_point_degC": point + step - 273.15,
            "hysteresis_K": width,
        }
        return Change(terms=terms, parameters=parameters)

    return Law("two stages of a closed exchanger", 0.05, 3.0, change)


def linear_fouling(random: np.random.Generator, scene: Scene) -> Law:
    """Heat release in operation drifts by 3 to 150 % over half a year; it grows in four cases of five.

    Fouled coolers and clogged filters raise it, a repaired pump lowers it (by 60 % at most).
    """
    grows = random.random() < 0.8
    drift = scene.release_W * ~scene.stopped * 0.5 * (scene.progress[:-1] + scene.progress[1:])

    def change(share: float) -> Change:
        signed = share if grows else -min(share, 0.6)
        return Change(heat_W=signed * drift, parameters={"change_by_the_end": signed})

    return Law("linear in time", 0.03, 1.5, change)


def saturating_fouling(random: np.random.Generator, scene: Scene) -> Law:
    """Fouling that begins at a date and saturates: 1 - exp(-t / tau), tau of 8 to 40 d; size as
    the linear one.
    """
    begin = scene.drivers.time[0] + random.uniform(0.1, 0.6) * scene.days * DAY_S
    lag_d = log_uniform(random, 8.0, 40.0)
    since = np.maximum(scene.drivers.time[:-1] + 0.5 * MINUTE_S - begin, 0.0) / (DAY_S * lag_d)
    course = scene.release_W * ~scene.stopped * (1.0 - np.exp(-since))

    def change(share: float) -> Change:
        parameters = {"change_in_the_end": share, "time_constant_d": lag_d}
        return Change(heat_W=share * course, parameters=parameters, dates=(float(begin),))

    return Law("saturating from a date on", 0.03, 1.5, change)


def neighbour_exhaust(random: np.random.Generator, scene: Scene) -> Law:
    """Warm exhaust of a neighbour reaches the cabinet while the wind comes from a sector that
    nobody logs.

    1 to 25 K, thinner in strong wind; a sector of 40 to 90 degrees.
    """
    centre, width = np.radians(random.uniform(150.0, 300.0)), np.radians(random.uniform(40.0, 90.0))
    away = np.abs(np.mod(scene.sky.wind_direction - centre + np.pi, 2.0 * np.pi) - np.pi)
    inside = 1.0 / (1.0 + np.exp((away - 0.5 * width) / np.radians(5.0)))
    thin = 5.0 / (5.0 + scene.drivers.wind_m_s)
    plume = low_pass(inside * thin / 0.5, MINUTE_H, 0.25)

    def change(kelvin: float) -> Change:
        parameters = {
            "warmth_K": kelvin,
            "sector_deg": float(np.degrees(centre)),
            "width_deg": float(np.degrees(width)),
        }
        return Change(skin_K=kelvin * plume, parameters=parameters)

    return Law("warm plume from a sector", 1.0, 25.0, change)
