"""The weather of a site as a course in time: seasons, weather systems, sun and cloud, and its fine
structure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from other_make.moist_air import FREEZING_K, concentration, saturation_pressure
from other_make.random_processes import first_order_lag, ornstein_uhlenbeck

DAY_S = 86400.0


@dataclass(frozen=True)
class Weather:
    """What surrounds the turbine; all arrays (T,) on one regular grid, straight between its points.

    time: [s] since 1970-01-01T00:00Z. ambient_K: [K]. ambient_kg_m3: [kg/m³] vapour concentration.
    irradiance_W_m2: [W/m²]. wind_m_s: [m/s] at hub height. latitude_deg: [deg].
    """

    time: np.ndarray
    ambient_K: np.ndarray
    ambient_kg_m3: np.ndarray
    irradiance_W_m2: np.ndarray
    wind_m_s: np.ndarray
    latitude_deg: float

    @property
    def step_s(self) -> float:
        """[s] between grid points."""
        return float(self.time[1] - self.time[0])

    def refined(self, parts: int) -> Weather:
        """The same course on a grid `parts` times as fine."""
        time = np.linspace(self.time[0], self.time[-1], parts * (len(self.time) - 1) + 1)

        def finer(course: np.ndarray) -> np.ndarray:
            return np.interp(time, self.time, course)

        return Weather(
            time,
            finer(self.ambient_K),
            finer(self.ambient_kg_m3),
            finer(self.irradiance_W_m2),
            finer(self.wind_m_s),
            self.latitude_deg,
        )


def solar_elevation_sine(time: np.ndarray, latitude_deg: float) -> np.ndarray:
    """Sine of the sun's elevation (T,) at 0° longitude, 0 at night; declination after Cooper (1969)."""
    day_of_year = (time / DAY_S) % 365.2425 + 1.0
    declination = np.radians(23.45) * np.sin(2.0 * np.pi * (284.0 + day_of_year) / 365.0)
    hour_angle = 2.0 * np.pi * ((time / DAY_S) % 1.0 - 0.5)
    latitude = np.radians(latitude_deg)
    sine = np.sin(latitude) * np.sin(declination)
    sine = sine + np.cos(latitude) * np.cos(declination) * np.cos(hour_angle)
    return np.maximum(sine, 0.0)


def make_weather(random: np.random.Generator, days: float, step_s: float) -> Weather:
    """A temperate site from a random day of the year 2021 on, every `step_s` [s]."""
    size = round(days * DAY_S / step_s) + 1
    first = float(np.datetime64("2021-01-01", "s").astype(np.int64)) + DAY_S * random.integers(365)
    time = first + step_s * np.arange(size)
    latitude = random.uniform(43.0, 58.0)
    step_h = step_s / 3600.0

    def process(correlation_h: float) -> np.ndarray:
        return ornstein_uhlenbeck(random, size, step_h, correlation_h)

    def smooth(correlation_h: float, lag_h: float) -> np.ndarray:
        course = first_order_lag(process(correlation_h), step_s, 3600.0 * lag_h)
        return course * np.sqrt((correlation_h + lag_h) / correlation_h)

    season = -np.cos(2.0 * np.pi * (time / DAY_S - 20.0) / 365.2425)
    cloud = 1.0 / (1.0 + np.exp(-2.0 * smooth(14.0, 2.0) - 0.8 * process(0.7)))
    sine = solar_elevation_sine(time, latitude)
    irradiance = 1050.0 * sine**1.15 * (1.0 - 0.75 * cloud)
    # air masses change within days; the ground's warmth follows sun and clear nights within hours
    air_mass = random.uniform(8.0, 13.0) + random.uniform(4.0, 7.0) * season
    air_mass = air_mass + random.uniform(2.4, 3.6) * smooth(55.0, 9.0)
    ground = first_order_lag(irradiance - 70.0 * (1.0 - cloud), step_s, 3600.0 * random.uniform(2.2, 4.0))
    celsius = air_mass + random.uniform(0.010, 0.016) * ground - 1.5
    celsius = celsius + 0.7 * process(5.0) + random.uniform(0.10, 0.18) * process(0.35) + 0.03 * process(0.05)
    # the dew point belongs to the air mass and stays below the air's own temperature
    dew = air_mass - 2.5 + 1.3 * process(20.0) + 0.45 * process(3.0)
    dew = dew + random.uniform(0.06, 0.12) * process(0.35) + 0.02 * process(0.05)
    dew = celsius - 0.3 - np.logaddexp(0.0, (celsius - 0.3 - dew) / 0.7) * 0.7
    ambient_K = celsius + FREEZING_K
    strength = 0.9 * smooth(20.0, 4.0) + 0.4 * process(2.0) - 0.12 * season
    wind = random.uniform(7.4, 8.8) * np.logaddexp(0.0, 1.6 * strength + 0.25) ** 0.55
    return Weather(
        time=time,
        ambient_K=ambient_K,
        ambient_kg_m3=concentration(saturation_pressure(dew + FREEZING_K), ambient_K),
        irradiance_W_m2=irradiance,
        wind_m_s=wind,
        latitude_deg=float(latitude),
    )
