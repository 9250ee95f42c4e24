"""A cabinet's last weeks on one clock of ten minutes, for tests of what comes next: made by a few lines of
their own."""

from __future__ import annotations

import numpy as np

from hygrokf.data.record import Record, Series, Site
from hygrokf.live.plan import Plan
from hygrokf.live.scenarios import Scenarios
from hygrokf.live.tracker import Point, offline_course
from hygrokf.physics.psychrometrics import absolute_humidity, relative_humidity
from hygrokf.texts.live_codes import BasisCode

STEP_S = 600.0
DAY_S = 86400.0
START_S = 1.6e9 // DAY_S * DAY_S
"""[s] a midnight, UTC."""
RATED_W = 2.0e6


def autoregressive(random: np.random.Generator, count: int, memory_h: float) -> np.ndarray:
    """A course (count,) at steps of ten minutes, of standard deviation 1."""
    keep = np.exp(-STEP_S / 3600.0 / memory_h)
    value, found = random.standard_normal(), []
    for kick in random.standard_normal(count) * np.sqrt(1.0 - keep**2):
        value = keep * value + kick
        found.append(value)
    return np.array(found)


STANDING = {
    "thermal_time_constant": 1.5, "resistance_ratio": 0.85, "heat_release_standstill": 5.0,
    "heat_release_standstill_ambient": 0.0, "heat_disturbance_sd": 0.2, "hygric_k": 0.3,
    "vapour_disturbance_sd": 0.05,
}  # fmt: skip
"""What the advice for a restart depends on, besides the heater, of a cabinet 5 K warmer than outside."""


def standstill(one: Plan, humidity: float, now_s: float, *further: str) -> tuple[Point, Scenarios]:
    """The state after twenty days of standstill in steady weather of 10 °C, and the same weather to come;
    `further` signals are zero."""
    values = {
        "ambient_temperature": 283.15,
        "ambient_absolute_humidity": absolute_humidity(humidity, 283.15),
        "active_power": 0.0,
        **dict.fromkeys(further, 0.0),
    }
    past, ahead = (
        np.arange(now_s - before_s, now_s + after_s + 1.0, STEP_S)
        for before_s, after_s in ((20 * DAY_S, 0.0), (3 * 3600.0, 30 * 3600.0))
    )
    series = tuple(Series(name, past, np.full(len(past), value)) for name, value in values.items())
    state = offline_course(one, Record("steady", series, None, RATED_W)).trace.last
    member = {name: np.full(len(ahead), value) for name, value in values.items()}
    return Point(now_s, state), Scenarios(now_s, ahead, (member,), BasisCode.OPERATION_AS_NOW())


def cabinet_record(days: float, seed: int = 1, moisture: float = 0.0) -> Record:
    """Weather, operation and readings of a cabinet over some days; `moisture` is added to the logarithm of
    the vapour.

    The turbine stands still at times and is pre-heated on the second evening.
    """
    random = np.random.default_rng(seed)
    time = START_S + STEP_S * np.arange(1, round(days * DAY_S / STEP_S) + 1)
    count = len(time)
    kelvin = 283.0 - 4.0 * np.cos(2.0 * np.pi * time / DAY_S) + 2.0 * autoregressive(random, count, 30.0)
    vapour = 6.5e-3 * np.exp(0.15 * autoregressive(random, count, 40.0) + moisture)
    humidity = np.minimum(relative_humidity(vapour, kelvin), 1.0)
    share = np.clip(0.5 + 0.5 * autoregressive(random, count, 8.0), 0.0, 1.0)
    power = np.where(share > 0.0, RATED_W * share, -5e3)
    evening = (time > START_S + 1.75 * DAY_S) & (time <= START_S + 1.95 * DAY_S)
    power[evening] = -5e3
    air = kelvin + 5.0 + 8.0 * np.maximum(power, 0.0) / RATED_W + 0.1 * random.standard_normal(count)
    inside = np.minimum(
        relative_humidity(vapour * kelvin / air, air) + 0.005 * random.standard_normal(count), 1.0
    )
    means = {"hold": "mean", "interval_s": STEP_S}
    return Record(
        "made",
        (
            Series("ambient_temperature", time, kelvin),
            Series("ambient_relative_humidity", time, humidity),
            Series("active_power", time, power, **means),
            Series("preheating", time, evening.astype(float), **means),
            Series("cabinet_temperature", time, air),
            Series("cabinet_relative_humidity", time, inside),
        ),
        Site(52.0, 1.0),
        RATED_W,
    )
