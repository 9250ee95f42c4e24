"""Block bootstrap of correlated errors, and bounds of root mean squared errors.

The errors of a free run are correlated over half a day and more, so readings are not independent.  Circular
blocks of the squared errors give the uncertainty of a root mean squared error, and of the difference between
two root mean squared errors on the same instants.

Shapes: n bins of equal length, T instants, k columns of errors, B draws.

Source: Künsch 1989, doi:10.1214/aos/1176347265; Politis & Romano 1992 (circular blocks).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hygrokf.data.timestamps import HOUR_S
from hygrokf.estimation.confidence import student_quantile
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.estimation.serial_dependence import autocovariance

BOOTSTRAP_SEED = 20200925
"""Fixed seed: the same record gives the same result."""
LEAST_BLOCK_H = 24.0
"""[h] shortest block."""
BLOCKS_PER_TIME = 4.0
"""Length of blocks in integral times."""
SHORT_HOLE = 6
"""Longest hole, in bins, that is interpolated before the correlation time is estimated."""
ERROR_DRAWS = 600
"""Draws of blocks for bounds of root mean squared errors."""
FEWEST_DRAWN_BLOCKS = 4.0
"""Effective number of blocks below which no bounds are given."""
MOST_LOST = 0.5
"""Largest share of the variance that may be missing because blocks are short; the bounds are corrected for
it."""


# --- memory ----------------------------------------------------------------------------------


def bridged(values: np.ndarray) -> np.ndarray:
    """Return the deviations (n,) of a series from its mean, without gaps.

    Gaps of up to `SHORT_HOLE` bins are interpolated linearly, longer gaps are filled with 0.
    """
    is_known = np.isfinite(values)
    if not is_known.any():
        return np.zeros(len(values))
    centred = values - float(np.mean(values[is_known]))
    index = np.arange(len(values))
    interpolated = np.interp(index, index[is_known], centred[is_known])
    previous_known = np.maximum.accumulate(np.where(is_known, index, -len(values)))
    next_known = np.minimum.accumulate(np.where(is_known, index, 2 * len(values))[::-1])[::-1]
    return np.where(next_known - previous_known <= SHORT_HOLE, interpolated, np.where(is_known, centred, 0.0))


def integral_time_h(values: np.ndarray, step_h: float = 1.0) -> float:
    """Return the integral time scale [h] of a series (n,), in which NaN means missing.

    It is ∫ρ dt from 0 to where the autocorrelation ρ first falls below 0.05, and at least half a step.  An
    exponential memory of time constant τ gives τ.
    """
    centred = bridged(values)
    lags = min(len(values) - 1, int(20 * 24 / step_h))
    covariance = autocovariance(centred, lags)
    if covariance[0] <= 0:
        return 0.5 * step_h
    rho = covariance / covariance[0]
    below_threshold = np.flatnonzero(rho < 0.05)
    last_lag = int(below_threshold[0]) if len(below_threshold) else lags
    return step_h * max(0.5, 0.5 + float(rho[1:last_lag].sum()))


def block_h(values: np.ndarray) -> float:
    """Return the length of bootstrap blocks [h] for hourly values (n,).

    It is four integral times, at least a day and at most a tenth of the record.
    """
    longest_h = max(LEAST_BLOCK_H, 0.1 * len(values))
    return min(max(LEAST_BLOCK_H, BLOCKS_PER_TIME * integral_time_h(values)), longest_h)


def prediction_error(centred: np.ndarray, known: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Return the errors (n,) with which an autoregression predicts deviations (n,).

    phi: (p,) coefficients.  NaN for the first p values, and where a value involved is not known (n,).
    """
    count, order = len(centred), len(phi)
    error = np.convolve(centred, np.concatenate([[1.0], -phi]))[:count]
    uses_unknown = np.convolve((~known).astype(float), np.ones(order + 1))[:count] > 0.5
    uses_unknown[:order] = True
    return np.where(uses_unknown, np.nan, error)


# --- root mean squared errors ----------------------------------------------------------------


@dataclass(frozen=True)
class Resampled:
    """Root mean squared errors (k,) of k models on the same instants, with B bootstrap draws (B, k).

    `n`: number of readings.  `blocks`: effective number of blocks with readings.
    `lost`: [1] share of the variance from correlation beyond the length of a block.
    """

    value: np.ndarray
    draws: np.ndarray
    n: int
    blocks: float
    lost: float

    def bounds(self, column: int) -> tuple[float, float] | None:
        """Return the 95 % bounds of one column's error, symmetric in its logarithm; None for too few
        blocks."""
        value = float(self.value[column])
        half_width = self._half_width(np.log(np.maximum(self.draws[:, column], 1e-300)))
        if value <= 0 or half_width is None:
            return None
        return value * math.exp(-half_width), value * math.exp(half_width)

    def difference(self, first: int, second: int) -> tuple[float, float, float] | None:
        """Return the first column's error minus the second's as (value, lower, upper); None for too few
        blocks."""
        value = float(self.value[first] - self.value[second])
        half_width = self._half_width(self.draws[:, first] - self.draws[:, second])
        return None if half_width is None else (value, value - half_width, value + half_width)

    def skill(self, column: int, rule: int) -> tuple[float, float, float] | None:
        """Return the skill 1 − MSE/MSE of a rule as (value, lower, upper); None for too few blocks.

        column, rule: columns of the model and of the rule.  The bounds are symmetric in the logarithm of the
            ratio.
        """
        if not (self.value[column] > 0 and self.value[rule] > 0):
            return None
        ratio = 2.0 * math.log(self.value[column] / self.value[rule])
        draws = np.log(np.maximum(self.draws, 1e-300))
        half_width = self._half_width(2.0 * (draws[:, column] - draws[:, rule]))
        if half_width is None:
            return None
        return -math.expm1(ratio), -math.expm1(ratio + half_width), -math.expm1(ratio - half_width)

    def _half_width(self, draws: np.ndarray) -> float | None:
        """Return half the width of 95 % bounds from draws (B,); None for too few blocks.

        It is Student's quantile times the spread of the draws, with two corrections.  A mean of K blocks
        varies by σ²/K, its bootstrap by σ² (K−1)/K²: the factor K/(K−1) corrects this.  1/(1 − τ/L) adds the
        variance from correlation beyond the end of a block (length L, integral time τ of the errors).
        """
        if self.blocks < FEWEST_DRAWN_BLOCKS:
            return None
        spread = float(np.std(draws)) * math.sqrt(self.blocks / (self.blocks - 1.0) / (1.0 - self.lost))
        return student_quantile(CONFIDENCE, self.blocks - 1.0) * spread


def resampled(
    time_s: np.ndarray, errors: np.ndarray, length_h: float | None = None, count: int = ERROR_DRAWS
) -> Resampled | None:
    """Return root mean squared errors of columns (T, k) at times (T,) [s], with bootstrap draws.

    Circular blocks of whole hours are drawn.  Only instants at which every column has an error count, so that
    the columns can be compared; None if there is no such instant.

    length_h: [h] of the blocks; None: four integral times of the slowest column's errors, at least a day and
        at most a
        tenth of the span.
    count: number of draws.
    """
    is_complete = np.isfinite(errors).all(axis=1)
    if not is_complete.any():
        return None
    hour = np.floor(time_s[is_complete] / HOUR_S).astype(np.int64)
    hour -= hour.min()
    hour_count, complete_errors = int(hour.max()) + 1, errors[is_complete]
    counts = np.bincount(hour, minlength=hour_count).astype(float)
    sums = np.column_stack([np.bincount(hour, column, hour_count) for column in complete_errors.T])
    squares = np.column_stack([np.bincount(hour, column**2, hour_count) for column in complete_errors.T])
    means = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1.0)[:, None], np.nan)
    if length_h is None:
        length_h = max(block_h(column) for column in means.T)
    length = int(min(max(round(length_h), 1), hour_count))
    readings_by_block = np.add.reduceat(counts, np.arange(0, hour_count, length))
    blocks = float(readings_by_block.sum()) ** 2 / float((readings_by_block**2).sum())
    columns = np.column_stack([counts, squares])
    running_sums = np.concatenate(
        [np.zeros((1, columns.shape[1])), np.cumsum(np.vstack([columns, columns[:length]]), axis=0)]
    )
    block_sums = running_sums[length : length + hour_count] - running_sums[:hour_count]
    generator = np.random.default_rng(BOOTSTRAP_SEED)
    starts = generator.integers(0, hour_count, (count, max(round(hour_count / length), 1)))
    drawn_sums = block_sums[starts].sum(axis=1)
    drawn_sums = drawn_sums[drawn_sums[:, 0] > 0]
    value = np.sqrt(squares.sum(axis=0) / counts.sum())
    draws = np.sqrt(np.maximum(drawn_sums[:, 1:], 0.0) / drawn_sums[:, :1])
    lost = min(max(integral_time_h(column) for column in means.T) / length, MOST_LOST)
    return Resampled(value, draws, int(counts.sum()), blocks, lost)
