"""What the plant's three systems write down: readings with the errors of their sensors, on clocks of their
own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from other_make.random_processes import first_order_lag, interval_means


@dataclass(frozen=True)
class Clock:
    """Stamps of one system.

    step_s: [s] between stamps. phase_s: [s] of the first stamp after the full step. late_s: [s] by which
        stamps are
    late: what is stamped t was measured at t − late_s. mean: whether a reading is the mean over the step that
    ends at its stamp, not the value at its stamp.
    """

    step_s: float
    phase_s: float = 0.0
    late_s: float = 0.0
    mean: bool = False


@dataclass(frozen=True)
class Sensor:
    """One sensor; all in the unit of the signal.

    noise: standard deviation. bias: constant. resolution: grid of the readings, counted from `zero`. lag_s:
    [s] of a first-order response. degrees: of freedom of Student's t that the noise follows, None: normal
    (the standard deviation is the same). outliers: share of readings off by 6 … 12 standard deviations.
    missing: share of readings that are not there.
    """

    noise: float = 0.0
    bias: float = 0.0
    resolution: float = 0.0
    zero: float = 0.0
    lag_s: float = 0.0
    degrees: float | None = None
    outliers: float = 0.0
    missing: float = 0.0


@dataclass(frozen=True)
class Channel:
    """One signal as it was written, in SI units; time [s] (T,) of the stamps, value (T,), NaN where missing.

    interval_s: [s] that a reading is the mean over, up to its stamp; 0: instants. response_time_s: [s] stated
    for the sensor, None: not stated.
    """

    signal: str
    system: str
    time: np.ndarray
    value: np.ndarray
    interval_s: float
    resolution: float
    response_time_s: float | None = None


def write_down(
    random: np.random.Generator,
    signal: str,
    system: str,
    time: np.ndarray,
    course: np.ndarray,
    clock: Clock,
    sensor: Sensor,
    *,
    stated: bool = False,
    held: bool = False,
) -> Channel:
    """Readings of a course (T,) on the regular grid `time` [s].

    stated: whether the sensor's response time is known. held: the course is held over the step that follows,
    not straight between grid points.
    """
    step_s = time[1] - time[0]
    shown = first_order_lag(course, step_s, sensor.lag_s) if sensor.lag_s else course
    reach = clock.step_s if clock.mean else 0.0
    first = np.ceil((time[0] + max(clock.late_s, 0.0) + reach) / clock.step_s) * clock.step_s + clock.phase_s
    stamps = np.arange(first, time[-1] + min(clock.late_s, 0.0) + 1e-6, clock.step_s)
    when = stamps - clock.late_s
    if clock.mean and held:
        amount = np.concatenate([[0.0], np.cumsum(shown[:-1]) * step_s])
        value = (np.interp(when, time, amount) - np.interp(when - clock.step_s, time, amount)) / clock.step_s
    elif clock.mean:
        value = interval_means(time, shown, when, clock.step_s)
    else:
        value = np.interp(when, time, shown)
    value = value + sensor.bias + sensor.noise * _noise(random, len(value), sensor)
    if sensor.resolution:
        value = sensor.zero + sensor.resolution * np.round((value - sensor.zero) / sensor.resolution)
    value[random.random(len(value)) < sensor.missing] = np.nan
    return Channel(
        signal,
        system,
        stamps,
        value,
        clock.step_s if clock.mean else 0.0,
        sensor.resolution,
        sensor.lag_s if stated else None,
    )


def _noise(random: np.random.Generator, size: int, sensor: Sensor) -> np.ndarray:
    """Noise (size,) of standard deviation 1, and outliers."""
    normal = random.standard_normal(size)
    heavy = sensor.degrees
    if heavy is not None:
        normal *= np.sqrt((heavy - 2.0) / random.chisquare(heavy, size))
    struck = random.random(size) < sensor.outliers
    blow = random.choice([-1.0, 1.0], size) * random.uniform(6.0, 12.0, size)
    return normal + struck * blow
