"""Effects that no library holds: tides, routines of a week, chance, pressure, a lit sensor, a wet filter.

Each function draws everything but the amplitude from ranges with their reason beside them.
"""

from __future__ import annotations

import numpy as np

from plants.cabinet import Trajectory
from plants.causes_exchange import exchange_of
from plants.chance import low_pass, ornstein_uhlenbeck
from plants.drivers import DAY_S, HOUR_S, MINUTE_S, Drivers
from plants.outdoors import MINUTE_H, sun_azimuth, wall_irradiance
from plants.saturation import concentration, relative_humidity, saturation_pressure
from plants.scene import Change, Law, Scene, with_air

TIDE_H = 12.4206
"""[h] period of the principal lunar tide, M2."""
FORTNIGHT_H = 354.367
"""[h] from spring tide to spring tide."""


def tide_surrounds(random: np.random.Generator, scene: Scene) -> Law:
    """Sea water around a tower's foot warms and cools what the cabinet loses heat to, by 0.5 to 25 K.

    Its level follows M2; springs rise 20 to 40 % higher than the mean, neaps as much less.
    """
    hours = scene.drivers.time / HOUR_S
    phase, spring = random.uniform(0.0, 2.0 * np.pi, 2)
    swell = 1.0 + random.uniform(0.2, 0.4) * np.cos(2.0 * np.pi * hours / FORTNIGHT_H + spring)
    level = swell * np.cos(2.0 * np.pi * hours / TIDE_H + phase)

    def change(kelvin: float) -> Change:
        return Change(skin_K=kelvin * level, parameters={"warmth_K": kelvin, "period_h": TIDE_H})

    return Law("surroundings that follow the tide", 0.5, 25.0, change)


def weekly_routine(random: np.random.Generator, scene: Scene) -> Law:
    """A load of 20 to 4,000 W on two days of the week, for 3 to 9 h from an odd hour on: a pump."""
    first = int(random.integers(0, 7))
    days = (first, (first + int(random.integers(2, 6))) % 7)
    begin, long = random.uniform(0.0, 24.0), random.uniform(3.0, 9.0)
    since = scene.drivers.time[:-1] / HOUR_S - begin
    on = np.isin(np.floor(since / 24.0).astype(int) % 7, days) & (since % 24.0 < long)

    def change(watts: float) -> Change:
        return Change(heat_W=watts * on, parameters={"load_W": watts, "begin_h": begin, "hours": long})

    return Law("a load on two days of the week", 20.0, 4000.0, change)


def load_by_chance(random: np.random.Generator, scene: Scene) -> Law:
    """A load of 20 to 2,000 W that goes on and off by chance, 2 d each on average: a random telegraph."""
    size = scene.drivers.time.size - 1
    turns = random.random(size) < MINUTE_S / (2.0 * DAY_S)
    on = (np.cumsum(turns) + int(random.integers(0, 2))) % 2

    def change(watts: float) -> Change:
        return Change(heat_W=watts * on, parameters={"load_W": watts, "switchings": float(turns.sum())})

    return Law("a load on and off by chance", 20.0, 2000.0, change)


def pressure_breathes(random: np.random.Generator, scene: Scene) -> Law:
    """Damp air of the foundation that falling air pressure, which nobody logs, draws into the cabinet.

    The pressure wanders with 60 h, smoothed over 3 h; the air comes while it falls, with its rate. At the
    mean rate it would lift the humidity by 0.05 to 10 g/m3.
    """
    pressure = low_pass(ornstein_uhlenbeck(random, scene.drivers.time.size, MINUTE_H, 60.0), MINUTE_H, 3.0)
    fall = np.maximum(-np.diff(pressure), 0.0)
    inflow = fall / fall.mean() * scene.air_flow_m3_s

    def change(grams: float) -> Change:
        return Change(vapour_kg_s=1e-3 * grams * inflow, parameters={"lift_g_m3": grams})

    return Law("damp air with the fall of the pressure", 0.05, 10.0, change)


def sensor_in_the_sun(random: np.random.Generator, scene: Scene) -> Law:
    """Sun through a slit warms the cabinet's sensor by 0.5 to 40 K at 600 W/m2, and nothing else.

    The slit is 20 to 40 degrees of azimuth wide and lies between southeast and southwest. The probe's
    relative humidity is that of the same vapour in the warmer air around it.
    """
    drivers = scene.drivers
    centre, width = np.radians(random.uniform(120.0, 240.0)), np.radians(random.uniform(20.0, 40.0))
    place = sun_azimuth(drivers.time, drivers.latitude_deg, drivers.longitude_deg)
    away = np.abs(np.mod(place - centre + np.pi, 2.0 * np.pi) - np.pi)
    lit = low_pass((away < 0.5 * width) * wall_irradiance(drivers, centre) / 600.0, MINUTE_H, 0.15)

    def change(kelvin: float) -> Change:
        def sees(seen: Drivers, run: Trajectory) -> tuple[Drivers, Trajectory]:
            every = (lit.size - 1) // (run.cabinet_K.size - 1)
            return seen, warmer_probe(run, kelvin * lit[::every])

        parameters = {"warmth_K": kelvin, "azimuth_deg": float(np.degrees(centre))}
        return Change(sees=sees, parameters=parameters | {"width_deg": float(np.degrees(width))})

    return Law("sensor that is lit through a slit", 0.5, 40.0, change)


def warmer_probe(run: Trajectory, kelvin: np.ndarray, humidity: np.ndarray | float = 0.0) -> Trajectory:
    """Readings where the air around the probe is warmer [K] and holds the same vapour pressure.

    humidity: [-] added to the relative humidity that follows.
    """
    local = run.cabinet_K + kelvin
    # At equal vapour pressure the density falls as the temperature rises.
    felt = relative_humidity(run.cabinet_kg_m3 * run.cabinet_K / local, local) + humidity
    return with_air(run, local, concentration(np.clip(felt, 0.0, 1.0) * saturation_pressure(local), local))


def wet_filter(random: np.random.Generator, scene: Scene) -> Law:
    """A filter mat that soaks in fog and lets less air through until it is dry.

    It soaks with 2 h while the outside air is above 88 to 94 % relative humidity, and dries with 4 to
    12 h; soaked it takes 5 to 95 % of the exchange.
    """
    drivers = scene.drivers
    fog = relative_humidity(drivers.ambient_kg_m3, drivers.ambient_K)[:-1] > random.uniform(0.88, 0.94)
    drying_h = random.uniform(4.0, 12.0)
    rates = MINUTE_H / np.where(fog, 2.0, drying_h)
    soaked, wet = np.empty(fog.size), 0.0
    for step, (foggy, rate) in enumerate(zip(fog.tolist(), rates.tolist(), strict=True)):
        wet += rate * (foggy - wet)
        soaked[step] = wet

    def change(share: float) -> Change:
        parameters = {"share": share, "drying_h": drying_h, "fog": float(fog.mean())}
        return Change(**exchange_of(scene, 1.0 - share * soaked), parameters=parameters)

    return Law("filter that soaks in fog", 0.05, 0.95, change)
