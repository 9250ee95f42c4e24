"""Cabinets that get wet, whose fan stops, or whose sensors freeze, drift or fall silent on a date, with the
truth.

They are simpler than `make_plant`: one thermal and one hygric time constant, Euler steps of two minutes.
What the loggers write comes every ten minutes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from other_make.loggers import Channel
from other_make.moist_air import FREEZING_K, VAPOUR_GAS_CONSTANT, saturation_pressure
from other_make.random_processes import ornstein_uhlenbeck

STEP_S = 120.0
"""[s] step of the integration."""
WRITTEN = 5
"""Steps between two readings."""
DAY_S = 86400.0
START_S = 1_672_531_200.0
"""[s] 2023-01-01 UTC."""
FAULT_DAY = 75.0
FOLLOWS = 0.3
"""Of the coldest surface: T_amb + 0.3 (T − T_amb)."""
SIGNALS = {
    "temperature": "cabinet_temperature",
    "humidity": "cabinet_relative_humidity",
    "ambient temperature": "ambient_temperature",
    "ambient humidity": "ambient_relative_humidity",
}


@dataclass(frozen=True)
class Fault:
    """What goes wrong from `FAULT_DAY` on for `days`.

    source_kg_m3: [kg/m³] moisture, as a rise of the air around. slower: factor on the thermal time constant.
    frozen, silent: words of `SIGNALS`. drift: word → [SI unit/d].
    """

    days: float = 1e3
    source_kg_m3: float = 0.0
    slower: float = 1.0
    frozen: tuple[str, ...] = ()
    silent: tuple[str, ...] = ()
    drift: tuple[tuple[str, float], ...] = ()


FAULTS = {
    "healthy": Fault(),
    "wet": Fault(20.0, source_kg_m3=2.5e-3),
    "ingress": Fault(1.5, source_kg_m3=6e-3),
    "fan": Fault(slower=1.6),
    "frozen temperature": Fault(frozen=("temperature",)),
    "frozen humidity": Fault(frozen=("humidity",)),
    "frozen ambient temperature": Fault(frozen=("ambient temperature",)),
    "frozen ambient humidity": Fault(frozen=("ambient humidity",)),
    "temperature drift": Fault(drift=(("temperature", 0.15),)),
    "humidity drift down": Fault(drift=(("humidity", -0.005),)),
    "humidity drift up": Fault(drift=(("humidity", 0.005),)),
    "ambient temperature drift": Fault(drift=(("ambient temperature", 0.15),)),
    "ambient humidity drift": Fault(drift=(("ambient humidity", -0.005),)),
    "silent 12 h": Fault(0.5, silent=("temperature", "humidity")),
    "silent 5 d": Fault(5.0, silent=("temperature", "humidity")),
}
"""Faults by name."""


@dataclass(frozen=True)
class FaultyPlant:
    """One plant: courses (T,) at the times [s] of its readings, and what was written.

    margin_K: the coldest surface above the dew point.
    """

    name: str
    fault: Fault
    time: np.ndarray
    ambient_K: np.ndarray
    cabinet_K: np.ndarray
    pressure_Pa: np.ndarray
    margin_K: np.ndarray
    channels: tuple[Channel, ...]
    rated_W: float


def make_faulty(seed: int, fault: str = "healthy", damp: bool = False, days: float = 97.0) -> FaultyPlant:
    """The plant of a seed with a fault of `FAULTS`; the same seed without it is the same plant before it.

    damp: the ambient's dew-point spread is 1 K, not 2 K.
    """
    random = np.random.default_rng([seed, 0xFA17])
    what = FAULTS[fault]
    size = round(days * DAY_S / STEP_S) + 1
    time = START_S + STEP_S * np.arange(size)
    day = (time - START_S) / DAY_S
    struck = (day >= FAULT_DAY) & (day < FAULT_DAY + what.days)

    def wander(sd: float, correlation_h: float) -> np.ndarray:
        return sd * ornstein_uhlenbeck(random, size, STEP_S / 3600.0, correlation_h)

    daily = np.sin(2.0 * np.pi * (day + random.uniform()))
    outside = FREEZING_K + 9.0 + 7.0 * np.sin(2.0 * np.pi * (day / 365.0 + random.uniform()))
    outside += wander(3.0, 60.0) + wander(0.6, 6.0) + 2.0 * daily
    spread = np.abs((1.0 if damp else 2.0) + wander(1.5, 30.0) + 1.2 * daily) + 0.3
    around = saturation_pressure(outside - spread) / (VAPOUR_GAS_CONSTANT * outside)
    share = _power(random, np.maximum(7.0 + wander(2.8, 12.0) + wander(0.7, 1.0), 0.0))
    tau_h, k_h = random.uniform(1.2, 3.5), random.uniform(0.2, 1.2)
    q0, q1, q2, still = (random.uniform(*ends) for ends in ((5, 8), (5, 11), (-3, 0), (3, 6)))
    release = np.where(share > 0.0, q0 + q1 * share + q2 * share**2, still)
    release += wander(random.uniform(0.4, 1.2), random.uniform(4.0, 10.0))
    moist = wander(1e-3 * random.uniform(0.1, 0.35), random.uniform(3.0, 8.0))
    kelvin = _euler(outside + release, STEP_S / 3600.0 / np.where(struck, tau_h * what.slower, tau_h))
    target = np.maximum(around + moist, 1e-4) + what.source_kg_m3 * struck
    ceiling = saturation_pressure(kelvin) / (VAPOUR_GAS_CONSTANT * outside)
    vapour = _euler(target, np.full(size, STEP_S / 3600.0 / k_h), ceiling)
    pressure = vapour * VAPOUR_GAS_CONSTANT * outside
    surface = outside + FOLLOWS * (kelvin - outside)
    courses = {
        "cabinet_temperature": (kelvin, random.normal(0.0, 0.1), 0.05, 0.1),
        "cabinet_relative_humidity": (
            pressure / saturation_pressure(kelvin), random.normal(0.0, 0.008), 0.003, 0.001,
        ),
        "ambient_temperature": (outside, random.normal(0.0, 0.15), 0.05, 0.1),
        "ambient_relative_humidity": (
            around * VAPOUR_GAS_CONSTANT * outside / saturation_pressure(outside),
            random.normal(0.0, 0.01), 0.003, 0.001,
        ),
    }  # fmt: skip
    rated_W = 2.5e6
    stamps = slice(0, size, WRITTEN)
    channels = []
    for signal, (course, *error) in courses.items():
        read = _read(random, course[stamps], *error)
        channels.append(Channel(signal, signal.split("_")[0], time[stamps], read, 0.0, error[2]))
    means = share[:-1].reshape(-1, WRITTEN).mean(axis=1) * rated_W
    channels.append(Channel("active_power", "scada", time[stamps][1:], means, WRITTEN * STEP_S, 0.0))
    written = tuple(_struck(one, what, struck[stamps], day[stamps] - FAULT_DAY) for one in channels)
    margin = surface - dew_point(pressure)
    kept = (x[stamps] for x in (time, outside, kelvin, pressure, margin))
    return FaultyPlant(f"faulty-{seed}", what, *kept, written, rated_W)


def make_sisters(seed: int, count: int = 4) -> tuple[tuple[Channel, ...], ...]:
    """What `count` healthy turbines beside the plant of a seed read of the ambient: each has offsets of its
    own (0.2 K, 1.5 %), and differs by 0.4 K and 2 % for hours."""
    random = np.random.default_rng([seed, 0x5157])
    around = [one for one in make_faulty(seed).channels if one.signal.startswith("ambient")]
    sizes = {"ambient_temperature": (0.2, 0.4), "ambient_relative_humidity": (0.015, 0.02)}

    def beside(one: Channel) -> Channel:
        offset, sd = sizes[one.signal]
        apart = sd * ornstein_uhlenbeck(random, len(one.time), WRITTEN * STEP_S / 3600.0, 8.0)
        course = one.value + apart
        return replace(one, value=_read(random, course, random.normal(0.0, offset), 0.0, one.resolution))

    return tuple(tuple(beside(one) for one in around) for _ in range(count))


def dew_point(pressure_Pa: np.ndarray) -> np.ndarray:
    """[K] over water, of a vapour pressure [Pa], from a table of the saturation pressure."""
    kelvin = np.linspace(FREEZING_K - 45.0, FREEZING_K + 60.0, 10_501)
    return np.interp(pressure_Pa, saturation_pressure(kelvin), kelvin)


def _euler(target: np.ndarray, pace: np.ndarray, ceiling: np.ndarray | None = None) -> np.ndarray:
    """The course that moves by the share `pace` (T,) of its distance to the target (T,) in each step, held
    below a ceiling (T,)."""
    most = np.full(len(target), np.inf) if ceiling is None else ceiling
    value, course = float(min(target[0], most[0])), [float(min(target[0], most[0]))]
    for goal, part, top in zip(target[:-1].tolist(), pace[:-1].tolist(), most[1:].tolist(), strict=True):
        value = min(value + part * (goal - value), top)
        course.append(value)
    return np.array(course)


def _power(random: np.random.Generator, wind: np.ndarray) -> np.ndarray:
    """Share of the rated power [1] (T,): (v/12)³ above 3.2 m/s, standstills of 5 to 40 h every 15 days."""
    share = np.where(wind > 3.2, np.minimum((wind / 12.0) ** 3, 1.0), 0.0)
    step_h = STEP_S / 3600.0
    hour = random.exponential(15.0 * 24.0)
    while hour < len(wind) * step_h:
        longer = random.uniform(5.0, 40.0)
        share[round(hour / step_h) : round((hour + longer) / step_h)] = 0.0
        hour += longer + random.exponential(15.0 * 24.0)
    return share


def _read(
    random: np.random.Generator, course: np.ndarray, offset: float, noise: float, resolution: float
) -> np.ndarray:
    """Readings: offset, noise, and rounding to steps that are counted from 0 °C or 0."""
    zero = FREEZING_K if course[0] > 100.0 else 0.0
    shown = course + offset + noise * random.standard_normal(len(course)) - zero
    read = zero + resolution * np.round(shown / resolution)
    return read if zero else np.clip(read, 0.0, 1.0)


def _struck(channel: Channel, fault: Fault, struck: np.ndarray, day: np.ndarray) -> Channel:
    """What is written with the fault of a sensor; `day`: days since its beginning."""
    words = {signal: word for word, signal in SIGNALS.items()}
    word = words.get(channel.signal)
    if word in fault.silent:
        return replace(channel, time=channel.time[~struck], value=channel.value[~struck])
    value = channel.value
    if word in fault.frozen:
        value = np.where(struck, value[np.argmax(struck) - 1], value)
    for drifting, rate in fault.drift:
        if word == drifting:
            zero = FREEZING_K if value[0] > 100.0 else 0.0
            moved = value - zero + np.where(struck, rate * day, 0.0)
            value = zero + channel.resolution * np.round(moved / channel.resolution)
            value = value if zero else np.clip(value, 0.0, 1.0)
    return replace(channel, value=value)
