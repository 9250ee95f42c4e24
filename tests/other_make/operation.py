"""What the turbine does: power from the wind, faults, and nothing below the cut-in speed."""

from __future__ import annotations

import numpy as np

from other_make.random_processes import first_order_lag, ornstein_uhlenbeck
from other_make.weather import DAY_S, Weather

CUT_IN_M_S = 3.5
RATED_M_S = 12.5


def make_power(random: np.random.Generator, weather: Weather, rated_W: float) -> np.ndarray:
    """Active power [W] (T,) at the grid points of the weather, held over the step that follows.

    In operation it is above zero; at standstill the turbine draws some kilowatts.  Faults come once in about
    twelve days and last four hours to three days.
    """
    size, step_s = len(weather.time), weather.step_s
    gusts = 1.0 + 0.10 * ornstein_uhlenbeck(random, size, step_s / 3600.0, 0.05)
    wind = first_order_lag(weather.wind_m_s * gusts, step_s, 45.0)
    share = np.clip((wind - CUT_IN_M_S) / (RATED_M_S - CUT_IN_M_S), 0.0, 1.0)
    power = rated_W * (0.004 + 0.996 * share**2 * (3.0 - 2.0 * share))
    # the control starts and stops on the ten-minute wind, with a hysteresis
    slow = first_order_lag(wind, step_s, 600.0)
    change = np.where(slow > CUT_IN_M_S + 0.3, 1.0, np.where(slow < CUT_IN_M_S - 0.3, 0.0, np.nan))
    change[0] = float(slow[0] > CUT_IN_M_S)
    last = np.maximum.accumulate(np.where(np.isnan(change), 0, np.arange(size)))
    running = change[last] > 0.0
    days = (weather.time[-1] - weather.time[0]) / DAY_S
    for begin_s in weather.time[0] + DAY_S * np.sort(random.uniform(0.0, days, random.poisson(days / 12.0))):
        length_s = 3600.0 * np.exp(random.uniform(np.log(4.0), np.log(72.0)))
        running &= (weather.time < begin_s) | (weather.time >= begin_s + length_s)
    return np.where(running, power, -random.uniform(0.002, 0.006) * rated_W)
