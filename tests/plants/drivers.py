"""What a cabinet is exposed to: weather and operation, each minute."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plants.chance import low_pass, ornstein_uhlenbeck
from plants.saturation import concentration, saturation_pressure

MINUTE_S = 60.0
HOUR_S = 3600.0
DAY_S = 86400.0
FREEZING_K = 273.15
POWER_STEP_MIN = 10


@dataclass(frozen=True)
class Drivers:
    """Weather and operation at minutes, (T,) each.

    time: [s] since the Unix epoch. ambient_K: [K]. ambient_kg_m3: [kg/m3].
    power_W: [W] and preheating: [-], held over the minute that follows. power_known: [-] whether
    the SCADA system knows the power. wind_m_s: [m/s]. irradiance_W_m2: [W/m2].
    ambient_step_min, ambient_offset_min: [min] clock of the ambient readings; a multiple of a
    minute, so that exact inputs are straight between readings.
    latitude_deg, longitude_deg: [deg].
    """

    time: np.ndarray
    ambient_K: np.ndarray
    ambient_kg_m3: np.ndarray
    power_W: np.ndarray
    power_known: np.ndarray
    preheating: np.ndarray
    wind_m_s: np.ndarray
    irradiance_W_m2: np.ndarray
    ambient_step_min: int
    ambient_offset_min: int
    latitude_deg: float
    longitude_deg: float

    @property
    def held_ambient_K(self) -> np.ndarray:
        """Ambient temperature [K] halfway through each minute, (T - 1,)."""
        return 0.5 * (self.ambient_K[:-1] + self.ambient_K[1:])


def minutes(start: str, days: float) -> np.ndarray:
    """Instants [s] since the Unix epoch, one a minute, both ends included."""
    first = float(np.datetime64(start, "s").astype(np.int64))
    return first + MINUTE_S * np.arange(round(days * DAY_S / MINUTE_S) + 1)


def sun_height(time: np.ndarray, latitude_deg: float, longitude_deg: float) -> np.ndarray:
    """Sine of the sun's elevation, 0 at night."""
    day = time / DAY_S
    # 1 January 1970 began ten days after the winter solstice, near enough.
    season = 2.0 * np.pi * (day + 10.0) / 365.2425
    declination = -np.radians(23.44) * np.cos(season)
    latitude = np.radians(latitude_deg)
    hour = 2.0 * np.pi * (day % 1.0) + np.radians(longitude_deg) - np.pi
    sine = np.sin(latitude) * np.sin(declination)
    return np.maximum(sine + np.cos(latitude) * np.cos(declination) * np.cos(hour), 0.0)


def _weather(
    random: np.random.Generator, knots: np.ndarray, latitude_deg: float, longitude_deg: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Temperature [K], vapour [kg/m3], irradiance [W/m2], wind strength [-] at the knots."""
    step_h = float(knots[1] - knots[0]) / 3600.0
    size = knots.size

    def process(correlation_h: float) -> np.ndarray:
        return ornstein_uhlenbeck(random, size, step_h, correlation_h)

    mean, swing = random.uniform(7.2, 10.0), random.uniform(4.6, 6.4)
    season = np.cos(2.0 * np.pi * (knots / DAY_S - 24.0) / 365.2425)
    synoptic = process(random.uniform(50.0, 90.0))
    clearness = 0.5 * (1.0 + np.tanh(process(15.0) - 0.4))
    sun = sun_height(knots, latitude_deg, longitude_deg)
    irradiance = (240.0 + 760.0 * clearness) * sun**1.1
    night = (sun == 0.0) * clearness
    base = mean - swing * season + random.uniform(2.3, 3.4) * synoptic
    warming = 0.019 * low_pass(irradiance, step_h, 2.7) - 2.8 * low_pass(night, step_h, 3.5)
    celsius = base + warming + 0.8 * process(7.0) + 0.2 * process(0.6)
    depression = 1.0 + 1.4 * np.logaddexp(0.0, process(25.0)) + 0.4 * process(4.0)
    dew = np.minimum(base - depression, celsius - 0.4 - 0.3 * np.abs(process(12.0)))
    dew_K, kelvin = dew + FREEZING_K, celsius + FREEZING_K
    vapour = concentration(saturation_pressure(dew_K), kelvin)
    wind = 0.85 * process(25.0) + 0.45 * process(3.0) + 0.15 * synoptic + 0.12 * season
    return kelvin, vapour, irradiance, wind


def _wind_and_power(
    strength: np.ndarray, rated_W: float, idle_W: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Wind speed [m/s], Weibull distributed, and power [W] from a standard normal strength."""
    wind = 8.3 * np.logaddexp(0.0, 1.7 * strength) ** 0.48
    share = (np.clip(wind, 3.3, 12.0) - 3.3) / (12.0 - 3.3)
    power = rated_W * share**2 * (1.9 - 0.9 * share)
    return wind, np.where(wind > 3.4, power, -idle_W)


def stop_turbine(
    random: np.random.Generator, time: np.ndarray, power_W: np.ndarray, faults: int, preheating: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Power [W] and pre-heating [-] with fault standstills of two to six days at random places."""
    power_W, heaters = power_W.copy(), np.zeros(time.size)
    span = float(time[-1] - time[0])
    grid = POWER_STEP_MIN * MINUTE_S
    for place in (np.arange(faults) + random.uniform(0.2, 0.8, faults)) / max(faults, 1):
        length = min(random.uniform(2.0, 6.0) * DAY_S, 0.05 * span)
        begin = time[0] + grid * np.round(place * (span - length) / grid)
        end = begin + grid * np.round(length / grid)
        stopped = (time >= begin) & (time < end)
        power_W[stopped] = -3.0e3
        if preheating:
            hours = grid * np.round(random.uniform(4.0, 9.0) * 3600.0 / grid)
            heaters[stopped & (time >= end - hours)] = 1.0
    return power_W, heaters


def own_drivers(
    random: np.random.Generator,
    *,
    days: float,
    start: str = "2020-07-15T00:00:00",
    rated_W: float = 2.05e6,
    ambient_step_min: int = 10,
    power: str = "wind",
    standstill: bool = True,
    preheating: bool = False,
    faults: int | None = None,
) -> Drivers:
    """Simulated weather and operation.

    The weather runs straight between ambient readings and the power is constant over ten minutes,
    so that the readings tell all. power: "wind" or "constant". standstill: False keeps the power
    above zero throughout. faults: number of fault standstills; None draws it.
    """
    if power not in ("wind", "constant"):
        raise ValueError(f'power must be "wind" or "constant", found {power!r}')
    time = minutes(start, days)
    latitude, longitude = random.uniform(48.0, 56.0), random.uniform(-4.0, 10.0)
    offset = int(random.integers(0, min(ambient_step_min, 10)))
    first = time[0] + MINUTE_S * offset
    knot_step = MINUTE_S * ambient_step_min
    before, after = np.ceil(offset * MINUTE_S / knot_step), np.ceil((time[-1] - first) / knot_step)
    knots = first + knot_step * np.arange(-before, after + 1.0)
    kelvin, vapour, irradiance, wind_knots = _weather(random, knots, latitude, longitude)

    strength = np.interp(time[::POWER_STEP_MIN], knots, wind_knots)
    strength = strength + 0.12 * ornstein_uhlenbeck(random, strength.size, POWER_STEP_MIN / 60.0, 0.25)
    idle_W = 5.0e3 + 3.0e3 * random.random(strength.size)
    wind, power_W = _wind_and_power(strength, rated_W, idle_W)
    if power == "constant":
        power_W = np.full(power_W.size, 0.6 * rated_W)
    elif not standstill:
        power_W = np.maximum(power_W, 0.01 * rated_W)
    wind = np.repeat(wind, POWER_STEP_MIN)[: time.size]
    power_W = np.repeat(power_W, POWER_STEP_MIN)[: time.size]
    drawn = int(random.integers(2, 4)) if standstill and power == "wind" else 0
    number = drawn if faults is None else faults
    power_W, heaters = stop_turbine(random, time, power_W, number, preheating)
    return Drivers(
        time=time,
        ambient_K=np.interp(time, knots, kelvin),
        ambient_kg_m3=np.interp(time, knots, vapour),
        power_W=power_W,
        power_known=np.ones(time.size, dtype=bool),
        preheating=heaters,
        wind_m_s=wind,
        irradiance_W_m2=np.interp(time, knots, irradiance),
        ambient_step_min=ambient_step_min,
        ambient_offset_min=offset,
        latitude_deg=latitude,
        longitude_deg=longitude,
    )
