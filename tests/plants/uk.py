"""Cabinets under measured drivers: reanalysis weather and power of a UK wind farm."""

from __future__ import annotations

import csv
import gzip
from functools import lru_cache
from pathlib import Path

import numpy as np

from plants.chance import ornstein_uhlenbeck
from plants.drivers import DAY_S, FREEZING_K, POWER_STEP_MIN, Drivers, minutes
from plants.loggers import Logging
from plants.plant import Plant, build_plant
from plants.saturation import concentration, saturation_pressure

UK_DRIVERS = (
    Path(__file__).resolve().parents[2] / "../shared/data/kelmarsh_2018_2019_era5_power_hourly.csv.gz"
)
"""Hourly weather and power of 2018 and 2019; tests skip where it is absent."""

_TURBINE = "P_K2_kW"


@lru_cache(maxsize=1)
def _hours() -> dict[str, np.ndarray]:
    with gzip.open(UK_DRIVERS, "rt", encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    stamps = [row["datetime_start_utc"][:19].replace(" ", "T") for row in rows]
    columns = {"time": np.array(stamps, dtype="datetime64[s]").astype(float)}
    for name in ("T2m_C", "Td2m_C", "ws100_mps", "ssrd_Wm2", _TURBINE):
        columns[name] = np.array([float(row[name] or "nan") for row in rows])
    return columns


def ten_minute_power(random: np.random.Generator, hourly_kW: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Power [kW] over ten minutes with the measured hourly means, and whether it was measured."""
    known = np.isfinite(hourly_kW)
    hour = np.arange(hourly_kW.size)
    filled = np.interp(hour, hour[known], hourly_kW[known])
    turns = 60 // POWER_STEP_MIN
    ripple = ornstein_uhlenbeck(random, filled.size * turns, POWER_STEP_MIN / 60.0, 0.3)
    ripple = ripple.reshape(-1, turns)
    ripple = ripple - ripple.mean(axis=1, keepdims=True)
    # The ripple fades towards standstill and towards rated power, where there is no room for it.
    room = np.clip(np.minimum(filled, 2050.0 - filled), 0.0, 500.0)
    limit = np.abs(ripple).max(axis=1)
    scale = np.minimum(0.3 * room, 0.98 * room / np.maximum(limit, 1e-9))
    power = filled[:, None] + scale[:, None] * ripple
    return power.ravel(), np.repeat(known, turns)


def uk_plant(seed: int, *, days: float = 180.0, start: str | None = None, disturbance: str = "ou") -> Plant:
    """A random cabinet under two years of measured UK weather and power.

    The weather is hourly and runs straight in between; the power has the measured hourly means.
    start: UTC; None draws one that leaves room for `days`. disturbance: see `plant`.
    Raises FileNotFoundError where the measured file is absent.
    """
    hours = _hours()
    random = np.random.default_rng(np.random.SeedSequence([seed, 2]))
    first, last = hours["time"][0], hours["time"][-1]
    room_days = int((last - first) / DAY_S - days)
    drawn = int(random.integers(0, room_days + 1)) if room_days >= 0 else 0
    if start is None:
        begin = np.datetime64(int(first + DAY_S * drawn), "s")
    else:
        begin = np.datetime64(start, "s")
    time = minutes(str(begin), days)
    if time[0] < first or time[-1] > last:
        raise ValueError(
            f"measured drivers run from {np.datetime64(int(first), 's')} to "
            f"{np.datetime64(int(last), 's')}, asked for {begin} and {days} days: ask for less"
        )
    power_kW, known = ten_minute_power(random, hours[_TURBINE])
    place = ((time - first) // (60.0 * POWER_STEP_MIN)).astype(int)
    dew_K, kelvin = hours["Td2m_C"] + FREEZING_K, hours["T2m_C"] + FREEZING_K
    vapour = concentration(saturation_pressure(np.minimum(dew_K, kelvin)), kelvin)
    drivers = Drivers(
        time=time,
        ambient_K=np.interp(time, hours["time"], kelvin),
        ambient_kg_m3=np.interp(time, hours["time"], vapour),
        power_W=1e3 * power_kW[place],
        power_known=known[place],
        preheating=np.zeros(time.size),
        wind_m_s=np.interp(time, hours["time"], hours["ws100_mps"]),
        irradiance_W_m2=np.interp(time, hours["time"], hours["ssrd_Wm2"]),
        ambient_step_min=60,
        ambient_offset_min=0,
        latitude_deg=52.4,
        longitude_deg=-0.95,
    )
    return build_plant(f"uk-plant-{seed}", seed, drivers, Logging(), disturbance=disturbance)
