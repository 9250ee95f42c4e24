"""Random courses on a regular grid; every function draws from the generator that it is given."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter


def ornstein_uhlenbeck(
    random: np.random.Generator,
    size: int,
    step_h: float,
    correlation_h: float,
    intensity: np.ndarray | None = None,
) -> np.ndarray:
    """A course (size,) with autocorrelation exp(−|lag|/correlation_h) and variance 1.

    intensity: [-] (size,) factor on the driving noise, whose mean square is 1 where the variance shall stay
        1.
    """
    keep = np.exp(-step_h / correlation_h)
    noise = np.sqrt(1.0 - keep**2) * random.standard_normal(size)
    noise[0] /= np.sqrt(1.0 - keep**2)
    if intensity is not None:
        noise *= intensity
    return lfilter([1.0], [1.0, -keep], noise)


def flaring(
    random: np.random.Generator, size: int, step_h: float, strength: float, calm_h: float
) -> np.ndarray:
    """Intensity [-] (size,) of a noise that flares up and calms down: log-normal, mean square 1.

    strength: [-] standard deviation of its logarithm. calm_h: [h] correlation time of the logarithm.
    """
    return np.exp(strength * ornstein_uhlenbeck(random, size, step_h, calm_h) - strength**2)


def first_order_lag(course: np.ndarray, step_s: float, lag_s: float) -> np.ndarray:
    """The solution of lag · y' = course − y, y(0) = course(0), with the course straight between grid points.

    Exact on the grid: with r = exp(−step/lag) and s = (1 − r) lag/step, y₁ = r y₀ + (s − r) u₀ + (1 − s) u₁.
    """
    if lag_s == 0.0:
        return course.copy()
    keep = np.exp(-step_s / lag_s)
    share = -np.expm1(-step_s / lag_s) * lag_s / step_s
    weights = np.array([1.0 - share, share - keep])
    # the filter's own state before the first point, such that y(0) = u(0)
    before = np.array([(share) * course[0]])
    return lfilter(weights, [1.0, -keep], course, zi=before)[0]


def interval_means(time: np.ndarray, course: np.ndarray, ends: np.ndarray, interval_s: float) -> np.ndarray:
    """Means of a course that is straight between grid points over (end − interval, end], for each end [s]."""
    step = np.diff(time)
    area = np.concatenate([[0.0], np.cumsum(0.5 * (course[1:] + course[:-1]) * step)])
    return (_area(time, course, area, ends) - _area(time, course, area, ends - interval_s)) / interval_s


def _area(time: np.ndarray, course: np.ndarray, area: np.ndarray, at: np.ndarray) -> np.ndarray:
    """∫ course from time[0] to `at`."""
    place = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    inside = at - time[place]
    slope = (course[place + 1] - course[place]) / (time[place + 1] - time[place])
    return area[place] + inside * (course[place] + 0.5 * slope * inside)
