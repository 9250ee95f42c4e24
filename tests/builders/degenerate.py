"""Records that hardly determine anything, drawn at random, as frames: constant, regulated and unrelated
signals, of eight readings to some thousand.  No code of the package is used."""

from __future__ import annotations

import numpy as np
import pandas as pd

STEP_MIN = (5, 10, 60)
READINGS = (8, 60, 400, 1500)
COURSES = ("constant", "regulated", "own", "outside", "steps")


def degenerate(seed: int) -> pd.DataFrame:
    """Temperatures [degC], humidities [%] and perhaps the power [kW] of a drawn record, over time in UTC."""
    draw = np.random.default_rng(seed)
    count, step = int(draw.choice(READINGS)), int(draw.choice(STEP_MIN))
    hours = np.arange(count) * step / 60.0
    outside = 8.0 + 5.0 * np.sin(hours * np.pi / 12.0) + _wander(draw, count, step / 60.0, 40.0, 3.0)
    moist = np.clip(75.0 + _wander(draw, count, step / 60.0, 20.0, 12.0), 20.0, 100.0)
    power = np.clip(800.0 + _wander(draw, count, step / 60.0, 15.0, 700.0), -5.0, 2000.0)
    signals = {
        "cabinet_temperature": _course(draw, hours, 24.0, 2.0, outside + 10.0).round(2),
        "cabinet_relative_humidity": np.clip(_course(draw, hours, 45.0, 6.0, 0.5 * moist), 1, 99).round(1),
        "ambient_temperature": _course(draw, hours, 9.0, 4.0, outside).round(2),
        "ambient_relative_humidity": np.clip(_course(draw, hours, 70.0, 8.0, moist), 1.0, 100.0).round(1),
    }
    if draw.random() < 0.5:
        signals["active_power"] = _course(draw, hours, 900.0, 400.0, power).round(0)
    index = pd.date_range("2021-01-05", periods=count, freq=f"{step}min", tz="UTC")
    return pd.DataFrame(signals, index=index)


def _course(
    draw: np.random.Generator, hours: np.ndarray, level: float, size: float, follows: np.ndarray
) -> np.ndarray:
    """One signal: constant, regulated with noise, wandering on its own, following, or in steps."""
    kind, count = str(draw.choice(COURSES)), len(hours)
    if kind == "constant":
        return np.full(count, level)
    if kind == "regulated":
        return level + 0.1 * size * draw.normal(size=count)
    if kind == "own":
        return level + _wander(draw, count, hours[1], float(draw.uniform(0.5, 50.0)), size)
    if kind == "steps":
        return level + size * (np.floor(hours / draw.uniform(2.0, 60.0)) % 2.0)
    return follows


def _wander(draw: np.random.Generator, count: int, step_h: float, time_h: float, sd: float) -> np.ndarray:
    """A stationary process (count,) with an exponential autocorrelation."""
    kept, found = float(np.exp(-step_h / time_h)), np.empty(count)
    found[0] = sd * draw.normal()
    for k in range(1, count):
        found[k] = kept * found[k - 1] + sd * float(np.sqrt(1.0 - kept**2)) * draw.normal()
    return found
