"""Operation as real turbines have it: standstills of days, pre-heating after some, curtailment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plants.drivers import DAY_S, MINUTE_S, POWER_STEP_MIN, Drivers

GRID_MIN = POWER_STEP_MIN
LONG_STANDSTILL_DAYS = 1.4
"""[d] From here on a cabinet may be pre-heated before the turbine starts."""


def standstills(drivers: Drivers, shortest_days: float = LONG_STANDSTILL_DAYS) -> list[tuple[int, int]]:
    """First minute and minute after the last of each standstill that lasts long enough."""
    stopped = np.concatenate(([False], drivers.power_W <= 0.0, [False]))
    begins = np.flatnonzero(~stopped[:-1] & stopped[1:])
    ends = np.flatnonzero(stopped[:-1] & ~stopped[1:])
    least = shortest_days * DAY_S / MINUTE_S
    return [(int(a), int(b)) for a, b in zip(begins, ends, strict=True) if b - a >= least]


def _on_grid(minute: float) -> int:
    return int(GRID_MIN * round(minute / GRID_MIN))


def curtail(random: np.random.Generator, drivers: Drivers, rated_W: float) -> np.ndarray:
    """Power [W] with limits that have nothing to do with the wind.

    Grid curtailment: once in ten days on average, for 2 to 14 h, down to 15 to 50 % of rated
    power. Noise: some weeks with at most 50 to 70 % from 21 to 5 h UTC.
    """
    power = drivers.power_W.copy()
    size = power.size
    days = size * MINUTE_S / DAY_S
    for _ in range(int(random.poisson(days / 10.0))):
        begin = _on_grid(random.uniform(0.0, size))
        end = begin + _on_grid(60.0 * random.uniform(2.0, 14.0))
        power[begin:end] = np.minimum(power[begin:end], random.uniform(0.15, 0.5) * rated_W)
    begin = random.uniform(0.0, 0.8) * days
    quiet = (drivers.time - drivers.time[0]) / DAY_S
    quiet = (quiet > begin) & (quiet < begin + random.uniform(0.1, 0.3) * days)
    hour = (drivers.time % DAY_S) / 3600.0
    limit = random.uniform(0.5, 0.7) * rated_W
    return np.where(quiet & ((hour >= 21.0) | (hour < 5.0)), np.minimum(power, limit), power)


def turbine_operation(
    random: np.random.Generator, drivers: Drivers, rated_W: float, preheating: bool
) -> Drivers:
    """Drivers with further standstills of 2 to 7 days, curtailment, and pre-heating after most.

    preheating: in the last 4 to 24 h of three of four long standstills, of one at least, the
    cabinet is heated.
    """
    power = curtail(random, drivers, rated_W)
    size = power.size
    days = size * MINUTE_S / DAY_S
    count = 1 + round(days / 120.0)
    for place in (np.arange(count) + random.uniform(0.1, 0.9, count)) / count:
        length = min(random.uniform(2.0, 7.0), 0.08 * days)
        begin = _on_grid(place * (days - length) * DAY_S / MINUTE_S)
        power[begin : begin + _on_grid(length * DAY_S / MINUTE_S)] = -3.0e3
    heaters = np.zeros(size)
    changed = replace(drivers, power_W=power)
    for begin, end in standstills(changed):
        hours, chance = random.uniform(4.0, 24.0), random.random()
        if preheating and chance < 0.75 and end < size:
            heaters[max(begin, end - _on_grid(60.0 * hours)) : end] = 1.0
    found = standstills(changed)
    if preheating and found and not heaters.any():
        begin, end = max(found, key=lambda pair: pair[1] - pair[0])
        heaters[max(begin, end - 480) : end] = 1.0
    return replace(changed, preheating=heaters)


def planned_standstill(
    drivers: Drivers, *, after_days: float, days: float, preheating_h: float
) -> tuple[Drivers, int, int]:
    """Drivers with one standstill and pre-heating of its last hours; its first minute and the one
    after the last.

    The power around it stays; the standstill begins and ends on the power's ten minutes.
    """
    begin = _on_grid(after_days * DAY_S / MINUTE_S)
    end = begin + _on_grid(days * DAY_S / MINUTE_S)
    power, heaters = drivers.power_W.copy(), np.zeros(drivers.time.size)
    power[begin:end] = -3.0e3
    # The turbine starts at once when the pre-heating is over.
    power[end : end + 6 * GRID_MIN] = np.maximum(power[end : end + 6 * GRID_MIN], 5.0e4)
    heaters[end - _on_grid(60.0 * preheating_h) : end] = 1.0
    return replace(drivers, power_W=power, preheating=heaters), begin, end
