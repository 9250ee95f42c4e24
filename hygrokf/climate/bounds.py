"""Bounds of the numbers of a climate, from the values of all members and years.

Bounds of *a year* hold a single year with the weather of one of the simulated years; they include the
uncertainty of the parameters, the disturbances, and the differences between years. Bounds of *the mean* hold
the mean over all years; they include the parameters and the averaged disturbances. With one year of weather
both are equal, and say nothing about other years.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hygrokf.estimation.conventions import CONFIDENCE

RESULT_DIGITS = 6
"""Number of significant digits of the numbers in a result."""


@dataclass(frozen=True)
class BoundedMean:
    """A number with its bounds, in the unit that its name states.

    `value`: mean over members and years. `lower`, `upper`: bounds of a single year. `mean_lower`,
    `mean_upper`: bounds of the mean over all years. `between_years`: standard deviation between years; 0 for
    one year.
    """

    value: float
    lower: float
    upper: float
    mean_lower: float
    mean_upper: float
    between_years: float

    def rounded(self) -> BoundedMean:
        """Return the same numbers with `RESULT_DIGITS` significant digits."""
        return BoundedMean(*rounded(np.array(list(vars(self).values()))).tolist())


def bounded(values: np.ndarray, level: float = CONFIDENCE) -> BoundedMean:
    """Return the bounds of a number from its values (years, N).

    The bounds are quantiles with the plotting positions k/(n+1): a further draw lies between them with the
    stated probability, also for few members. With fewer than 39 members the smallest and the largest value
    replace the 95 % bounds, and hold with a smaller probability (`held`). NaN marks a member without the
    number in a year; it is left out.
    """
    values = np.asarray(values, dtype=float)
    is_known = ~np.isnan(values)
    if not is_known.any():
        return BoundedMean(*[np.nan] * 6)
    if is_known.all():
        return BoundedMean(**{name: float(number) for name, number in bounded_array(values, level).items()})
    means_of_members, means_of_years = _known_means(values.T), _known_means(values)
    of_a_year = bounded(values[is_known][None, :], level)
    of_the_mean = bounded(means_of_members[None, :], level)
    between_years = float(means_of_years.std(ddof=1)) if len(means_of_years) > 1 else 0.0
    return BoundedMean(
        of_a_year.value, of_a_year.lower, of_a_year.upper, of_the_mean.lower, of_the_mean.upper, between_years
    )


def _known_means(rows: np.ndarray) -> np.ndarray:
    """Return the mean of every row without its NaN; rows of NaN are left out."""
    return np.array([row[~np.isnan(row)].mean() for row in rows if not np.isnan(row).all()])


def bounded_array(values: np.ndarray, level: float = CONFIDENCE) -> dict[str, np.ndarray]:
    """Return the fields of `BoundedMean` as arrays, for many numbers at once, from their values (years, N, …)
    without NaN."""
    values = np.asarray(values, dtype=float)
    probabilities = np.array([0.5 - 0.5 * level, 0.5 + 0.5 * level])
    pooled = values.reshape(-1, *values.shape[2:])
    lower, upper = np.quantile(pooled, probabilities, axis=0, method="weibull")
    mean_lower, mean_upper = np.quantile(values.mean(axis=0), probabilities, axis=0, method="weibull")
    means_of_years = values.mean(axis=1)
    between_years = means_of_years.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(values.shape[2:])
    return {
        "value": pooled.mean(axis=0), "lower": lower, "upper": upper, "mean_lower": mean_lower,
        "mean_upper": mean_upper, "between_years": between_years,
    }  # fmt: skip


def held(draws: float, level: float = CONFIDENCE) -> float:
    """Return the probability [1] with which bounds from so many draws hold a further draw: the level, or less
    for few draws."""
    return min(level, (draws - 1.0) / (draws + 1.0))


def rounded(values: np.ndarray, digits: int = RESULT_DIGITS) -> np.ndarray:
    """Round numbers to significant digits; NaN for a number that is not finite."""
    values = np.asarray(values, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(values == 0.0, 1.0, 10.0 ** (digits - 1 - np.floor(np.log10(np.abs(values)))))
        return np.where(np.isfinite(values), np.round(values * scale) / scale, np.nan)


def expect_shape(shape: tuple[int, ...], arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError that lists the arrays of another shape."""
    if wrong := [f"{name} {array.shape}" for name, array in arrays.items() if array.shape != shape]:
        raise ValueError(f"expected arrays of shape {shape}, found {', '.join(wrong)}")
