"""Rain, wind direction and the sun's place: weather that existing plants do not need.

All of it comes from seeds of its own, so that no other stream of a plant moves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from plants.chance import low_pass, ornstein_uhlenbeck
from plants.drivers import DAY_S, MINUTE_S, POWER_STEP_MIN, Drivers, sun_height
from plants.loggers import PlantSeries
from plants.saturation import concentration, dew_point, relative_humidity, saturation_pressure

MINUTE_H = 1.0 / 60.0


@dataclass(frozen=True)
class Outdoors:
    """Weather at minutes, (T,).

    rain_mm_h: [mm/h]. wind_direction: [rad] where the wind comes from, clockwise from north.
    """

    rain_mm_h: np.ndarray
    wind_direction: np.ndarray


def outdoors(random: np.random.Generator, drivers: Drivers) -> Outdoors:
    """Rain and wind direction that go with a plant's weather.

    Rain falls in 5 to 8 % of the time, in spells of an hour or two that prefer humid air;
    intensities are lognormal around 0.9 mm/h, which makes 600 to 1,000 mm a year, as lowland
    Europe has (Haylock et al. 2008, E-OBS). The wind comes from the southwest more often than not
    and keeps its direction for about a day.
    """
    size = drivers.time.size
    humid = relative_humidity(drivers.ambient_kg_m3, drivers.ambient_K)
    humid = low_pass(humid, MINUTE_H, 2.0)
    humid = (humid - humid.mean()) / humid.std()
    spell = 0.75 * ornstein_uhlenbeck(random, size, MINUTE_H, 9.0)
    shower = 0.65 * ornstein_uhlenbeck(random, size, MINUTE_H, 1.0)
    cloudy = 0.8 * humid + spell + shower
    falls = cloudy > np.quantile(cloudy, 1.0 - random.uniform(0.05, 0.08))
    strength = ornstein_uhlenbeck(random, size, MINUTE_H, 0.4)
    rain = np.where(falls, 0.9 * np.exp(0.9 * strength), 0.0)
    veer = ornstein_uhlenbeck(random, size, MINUTE_H, 22.0)
    gusts = ornstein_uhlenbeck(random, size, MINUTE_H, 1.5)
    direction = np.radians(225.0) + 1.25 * veer + 0.2 * gusts
    return Outdoors(rain, np.mod(direction, 2.0 * np.pi))


def with_fronts(random: np.random.Generator, drivers: Drivers) -> Drivers:
    """Drivers whose air masses change as they do on a coast: warm fronts come nearly saturated.

    Temperatures swing by 1.5 to 2.1 K more, with a correlation of 12 to 20 h, and the warmer the
    air mass the smaller its dew-point depression: a surface that lags by a day then lies below
    the dew point in about a tenth of the time, as under measured UK weather. The ambient stays
    straight between its readings.
    """
    places = np.arange(drivers.ambient_offset_min, drivers.time.size, drivers.ambient_step_min)
    step_h = drivers.ambient_step_min * MINUTE_H
    swing, memory_h = random.uniform(1.5, 2.1), random.uniform(12.0, 20.0)
    mass = ornstein_uhlenbeck(random, places.size, step_h, memory_h)
    mass = low_pass(mass, step_h, 1.0)
    floor = 0.25 + 0.2 * np.abs(ornstein_uhlenbeck(random, places.size, step_h, 6.0))
    kelvin, vapour = drivers.ambient_K[places], drivers.ambient_kg_m3[places]
    depression = kelvin - dew_point(vapour, kelvin)
    closed = depression * (0.3 + 1.4 / (1.0 + np.exp(1.6 * mass)))
    warmer = kelvin + swing * mass
    dew = warmer - np.maximum(closed, floor)
    wetter = concentration(saturation_pressure(dew), warmer)

    def spread(extra: np.ndarray) -> np.ndarray:
        return np.interp(np.arange(drivers.time.size), places, extra)

    return replace(
        drivers,
        ambient_K=drivers.ambient_K + spread(warmer - kelvin),
        ambient_kg_m3=drivers.ambient_kg_m3 + spread(wetter - vapour),
    )


def sun_azimuth(time: np.ndarray, latitude_deg: float, longitude_deg: float) -> np.ndarray:
    """Azimuth of the sun [rad], clockwise from north, by the clock of `plants.drivers.sun_height`."""
    day = time / DAY_S
    season = 2.0 * np.pi * (day + 10.0) / 365.2425
    declination = -np.radians(23.44) * np.cos(season)
    latitude = np.radians(latitude_deg)
    hour = 2.0 * np.pi * (day % 1.0) + np.radians(longitude_deg) - np.pi
    east = -np.cos(declination) * np.sin(hour)
    north = np.sin(declination) * np.cos(latitude)
    north = north - np.cos(declination) * np.sin(latitude) * np.cos(hour)
    return np.mod(np.arctan2(east, north), 2.0 * np.pi)


def wall_irradiance(drivers: Drivers, azimuth: float) -> np.ndarray:
    """Irradiance of a vertical wall [W/m2] that looks towards `azimuth` [rad].

    Beam and sky are split by the clearness index (Erbs, Klein and Duffie 1982), the sky is
    isotropic, the ground reflects 20 %.
    """
    sine = sun_height(drivers.time, drivers.latitude_deg, drivers.longitude_deg)
    horizontal = drivers.irradiance_W_m2
    clearness = np.clip(horizontal / np.maximum(1361.0 * sine, 1.0), 0.0, 1.0)
    middle = np.polyval((12.336, -16.638, 4.388, -0.1604, 0.9511), clearness)
    diffuse = np.where(clearness <= 0.22, 1.0 - 0.09 * clearness, np.where(clearness <= 0.8, middle, 0.165))
    # Near the horizon the beam is not horizontal over sine: trees and hills stand before it.
    beam = (1.0 - diffuse) * horizontal / np.maximum(sine, 0.1)
    place = sun_azimuth(drivers.time, drivers.latitude_deg, drivers.longitude_deg)
    facing = np.sqrt(1.0 - np.minimum(sine, 1.0) ** 2) * np.cos(place - azimuth)
    return beam * np.maximum(facing, 0.0) + 0.5 * diffuse * horizontal + 0.1 * horizontal


def _interval_means(values: np.ndarray, first: int, step: int, count: int) -> np.ndarray:
    """Means over `count` intervals of `step` minutes that begin at minute `first`."""
    return values[first : first + count * step].reshape(count, step).mean(axis=1)


def optional_series(
    random: np.random.Generator, drivers: Drivers, sky: Outdoors, *, irradiance: bool, rain: bool
) -> tuple[PlantSeries, ...]:
    """Wind speed, and irradiance and rain on demand, as instruments of a wind farm log them.

    Wind: a nacelle anemometer, calibrated within 3 %, 0.25 m/s of scatter behind the rotor, in
    steps of 0.1 m/s. Irradiance: a pyranometer of class B within 5 %, -1 W/m2 at night. Rain: a
    gauge that tips every 0.2 mm and loses up to 15 % in wind. The numbers are drawn whatever is
    asked for.
    """
    scatter = random.standard_normal(drivers.time.size // POWER_STEP_MIN + 1)
    scale_wind, scale_sun = random.uniform(0.97, 1.03), random.uniform(0.95, 1.05)
    caught, night = random.uniform(0.85, 1.0), random.uniform(-2.0, 0.0)
    flicker = random.standard_normal(drivers.time.size)
    count = (drivers.time.size - 1) // POWER_STEP_MIN
    interval_s = MINUTE_S * POWER_STEP_MIN
    ends = drivers.time[0] + interval_s * np.arange(1, count + 1)
    wind = scale_wind * _interval_means(drivers.wind_m_s, 0, POWER_STEP_MIN, count)
    wind = np.maximum(np.round((wind + 0.25 * scatter[:count]) / 0.1) * 0.1, 0.0)
    made = [PlantSeries("wind_speed", "m/s", ends, wind, "end", interval_s, 0.1, None, "SCADA")]

    first, step = drivers.ambient_offset_min, drivers.ambient_step_min
    count = (drivers.time.size - 1 - first) // step
    ends = drivers.time[first] + MINUTE_S * step * np.arange(1, count + 1)

    def series(signal: str, unit: str, value: np.ndarray, resolution: float) -> PlantSeries:
        return PlantSeries(
            signal, unit, ends, value, "end", MINUTE_S * step, resolution, None, "ambient logger"
        )

    if irradiance:
        sun = scale_sun * _interval_means(drivers.irradiance_W_m2, first, step, count)
        sun = np.round(sun + night + 1.5 * flicker[:count])
        made.append(series("global_horizontal_irradiance", "W/m2", sun, 1.0))
    if rain:
        fallen = caught * MINUTE_H * np.cumsum(sky.rain_mm_h[first : first + count * step])
        tips = np.floor(fallen / 0.2)[step - 1 :: step]
        made.append(series("rain", "mm", 0.2 * np.diff(tips, prepend=0.0), 0.2))
    return tuple(made)


def with_series(series: tuple[PlantSeries, ...], extra: tuple[PlantSeries, ...]) -> tuple[PlantSeries, ...]:
    """Series with those of the same signal replaced, and irradiance left out unless it is given."""
    dropped = {one.signal for one in extra} | {"global_horizontal_irradiance"}
    return tuple(one for one in series if one.signal not in dropped) + extra
