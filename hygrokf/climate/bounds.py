"""Bounds of a climate's numbers, from the values of all members and years.

The bounds of *a year* hold a single year with the weather of one of these years: they contain what the fit
does not know of its parameters, the disturbances, and the spread between years.  The bounds of *the mean*
hold the mean over all years: they contain the parameters and what is left of the disturbances.  With one
year of weather both are the same, and say nothing about other years.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hygrokf.estimation.conventions import CONFIDENCE

RESULT_DIGITS = 6
"""Significant digits of the numbers in a result."""


@dataclass(frozen=True)
class BoundedMean:
    """A number with its bounds, in the unit that its name states.

    `value`: mean over members and years.  `lower`, `upper`: bounds of a single year.  `mean_lower`,
    `mean_upper`: bounds of the mean of all years.  `between_years`: standard deviation of the years; 0 for
    one year.
    """

    value: float
    lower: float
    upper: float
    mean_lower: float
    mean_upper: float
    between_years: float

    def rounded(self) -> BoundedMean:
        """The same to `RESULT_DIGITS` significant digits."""
        return BoundedMean(*rounded(np.array(list(vars(self).values()))).tolist())


def bounded(values: np.ndarray, level: float = CONFIDENCE) -> BoundedMean:
    """The bounds of a number from its values (years, N).

    Quantiles are expected values of order statistics (k/(n+1)): a further draw lies between them with the
    stated probability, also for few members.  With fewer than 39 members the extremes stand in for the 95 %
    bounds, and hold less (`held`).  NaN marks a member without the number in that year; it is left out.
    """
    values = np.asarray(values, dtype=float)
    known = ~np.isnan(values)
    if not known.any():
        return BoundedMean(*[np.nan] * 6)
    if known.all():
        return BoundedMean(**{name: float(one) for name, one in bounded_array(values, level).items()})
    means, by_year = (
        np.array([row[there].mean() for row, there in zip(rows, knowns, strict=True) if there.any()])
        for rows, knowns in ((values.T, known.T), (values, known))
    )
    all_years, mean = (bounded(part[None, :], level) for part in (values[known], means))
    between = float(by_year.std(ddof=1)) if len(by_year) > 1 else 0.0
    return BoundedMean(all_years.value, all_years.lower, all_years.upper, mean.lower, mean.upper, between)


def bounded_array(values: np.ndarray, level: float = CONFIDENCE) -> dict[str, np.ndarray]:
    """What `BoundedMean` has, of each of many numbers, from their values (years, N, …) without gaps."""
    values = np.asarray(values, dtype=float)
    ends = np.array([0.5 - 0.5 * level, 0.5 + 0.5 * level])
    pooled = values.reshape(-1, *values.shape[2:])
    lower, upper = np.quantile(pooled, ends, axis=0, method="weibull")
    mean_lower, mean_upper = np.quantile(values.mean(axis=0), ends, axis=0, method="weibull")
    by_year = values.mean(axis=1)
    between = by_year.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(values.shape[2:])
    return {
        "value": pooled.mean(axis=0), "lower": lower, "upper": upper, "mean_lower": mean_lower,
        "mean_upper": mean_upper, "between_years": between,
    }  # fmt: skip


def held(draws: float, level: float = CONFIDENCE) -> float:
    """Probability [1] that bounds from so many draws hold a further one: the level, or what the extremes of
    few draws hold."""
    return min(level, (draws - 1.0) / (draws + 1.0))


def rounded(values: np.ndarray, digits: int = RESULT_DIGITS) -> np.ndarray:
    """Numbers to significant digits, NaN where they are not finite: a file need not show the last bits."""
    values = np.asarray(values, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(values == 0.0, 1.0, 10.0 ** (digits - 1 - np.floor(np.log10(np.abs(values)))))
        return np.where(np.isfinite(values), np.round(values * scale) / scale, np.nan)


def expect_shape(shape: tuple[int, ...], arrays: Mapping[str, np.ndarray]) -> None:
    """Raises ValueError with the arrays of another shape."""
    if wrong := [f"{name} {array.shape}" for name, array in arrays.items() if array.shape != shape]:
        raise ValueError(f"expected arrays of shape {shape}, found {', '.join(wrong)}")
