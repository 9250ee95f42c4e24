"""From members and years to a value with bounds.

A statistic has one value for every member and year.  Its bounds for *a year* hold a single year with the weather of one
of these years: parameters, disturbances and the spread between years.  Its bounds for *the mean* hold the mean over all
years: parameters, and what is left of the disturbances.  With one year of weather both are the same, and say nothing of
other years.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LEVEL = 0.95


@dataclass(frozen=True)
class Bounded:
    """A value with bounds for a year, bounds for the mean of all years, and the spread between years (0 for one year).

    Numbers, or arrays of one shape.
    """

    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    mean_lower: np.ndarray
    mean_upper: np.ndarray
    between_years: np.ndarray

    def to_json(self) -> dict:
        return {name: np.asarray(number).tolist() for name, number in vars(self).items()}


def bounded(values: np.ndarray, level: float = LEVEL) -> Bounded:
    """The bounds of a statistic from its values (years, N, …).

    Quantiles are expected values of order statistics (k/(n+1)): a further draw lies between them with the stated
    probability, also for few members; with fewer than 39 of them the extremes stand in for the 95 % bounds, and hold
    less (`held`).  Of numbers (years, N) those that are NaN, which say nothing, are left out.
    """
    values = np.asarray(values, dtype=float)
    if values.ndim == 2 and np.isnan(values).any():
        return _bounded_where_known(values, level)
    ends = np.array([0.5 - 0.5 * level, 0.5 + 0.5 * level])
    pooled = values.reshape(-1, *values.shape[2:])
    means = values.mean(axis=0)
    lower, upper = np.quantile(pooled, ends, axis=0, method="weibull")
    mean_lower, mean_upper = np.quantile(means, ends, axis=0, method="weibull")
    by_year = values.mean(axis=1)
    between = by_year.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(values.shape[2:])
    return Bounded(pooled.mean(axis=0), lower, upper, mean_lower, mean_upper, between)


def held(draws: float, level: float = LEVEL) -> float:
    """Probability [1] that bounds from so many draws hold a further one: the level, or what the extremes of few draws hold."""
    return min(level, (draws - 1.0) / (draws + 1.0))


def _bounded_where_known(values: np.ndarray, level: float) -> Bounded:
    """The bounds of a number (years, N) that not every member has in every year; NaN where none has it."""
    if np.isnan(values).all():
        return Bounded(*(np.array(np.nan) for _ in range(6)))
    there = ~np.isnan(values)
    means, by_year = (
        np.array([row[one].mean() for row, one in zip(rows, known, strict=True) if one.any()])
        for rows, known in ((values.T, there.T), (values, there))
    )
    all_years, mean = (bounded(part[None, :], level) for part in (values[there], means))
    between = by_year.std(ddof=1) if len(by_year) > 1 else 0.0
    return Bounded(
        all_years.value, all_years.lower, all_years.upper, mean.lower, mean.upper, np.array(between)
    )
