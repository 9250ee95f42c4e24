"""Variance of sums of serially dependent terms, whose memory the terms themselves tell.

Shapes: n terms in their order, f columns.

The sum of a column x with autocovariances R(k) has the variance n g, g = Σ R(k).  Blocks of b terms miss the
share G/(b g) of it, G = Σ |k| R(k).  The block length b = (3/2 (G/g)²)^⅓ n^⅓ balances this against the
scatter of few blocks (Politis & White 2004, doi:10.1081/ETC-120028836, with the correction of 2009); g and G
are estimated with a flat-top window of twice the lags at which the autocorrelation is significant.  As the
missing share is known it is restored, so that longer blocks, `LONGER` times b, lose little, and Student's
quantile for their number counts their scatter.  All lengths are numbers of terms, so that the unit of time
does not matter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

INSIGNIFICANT = 1.5
"""Autocorrelations below this times √(log₁₀ n / n) are taken as zero; Politis and White have 2, with which
the memory of a disturbance below sensor noise is missed in short records."""
LONGER = 3.0
"""[1] length of blocks in optimal lengths."""
FEWEST_BLOCKS = 5
"""Blocks are shortened to have at least this many."""
FEWEST_OPTIMAL = 2.0
"""Number of blocks of optimal length below which the variance is not estimated."""
FEWEST_TERMS = 10
MOST_MISSED = 0.5
"""[1] largest missing share that is restored."""


@dataclass(frozen=True)
class LongRun:
    """Covariance (f, f) of the sums of columns, for use with normal quantiles; and `needed` (f,): the length
    of a sufficient series in lengths of this one, above 1 where this one is too short."""

    covariance: np.ndarray
    needed: np.ndarray


def long_run_covariance(terms: np.ndarray) -> LongRun:
    """Covariance of the sums of serially dependent terms (n, f), positive semi-definite.

    Every variance is from blocks of its own column's length, the correlations from the longest blocks.  Each
    is enlarged by the square of Student's over the normal 95 % quantile, for the number of its blocks.
    Columns that are too short (`needed` above 1) have the variance of as many blocks as there are.
    """
    from scipy.stats import norm, t

    n, f = terms.shape
    if n < FEWEST_TERMS:
        return LongRun(np.full((f, f), np.nan), np.full(f, FEWEST_TERMS / max(n, 1)))
    centred = terms - terms.mean(axis=0)
    longest, deviations, needed = 1, np.zeros(f), np.ones(f)
    for j, column in enumerate(centred.T):
        optimal, beyond = optimal_block(column)
        length = min(math.ceil(LONGER * optimal), n // FEWEST_BLOCKS) if optimal > 1.0 else 1
        sums = _block_sums(column[:, None], length)[:, 0]
        freedom = len(sums) - 1
        enlarged = (t.ppf(0.975, freedom) / norm.ppf(0.975)) ** 2 * len(sums) / freedom
        missed = min(max(beyond / length, 0.0), MOST_MISSED)
        deviations[j] = math.sqrt(enlarged * float(sums @ sums) / (1.0 - missed))
        # the optimal length grows with the cube root of the series' length
        needed[j] = max((FEWEST_OPTIMAL * optimal / n) ** 1.5, 1.0)
        longest = max(longest, length)
    sums = _block_sums(centred, longest)
    product = sums.T @ sums
    size = np.sqrt(np.diag(product))
    scale = np.divide(deviations, size, out=np.zeros(f), where=size > 0.0)
    return LongRun(product * np.outer(scale, scale), needed)


def optimal_block(terms: np.ndarray) -> tuple[float, float]:
    """Optimal block length of centred terms (n,), at least 1; and G/g, the length whose share of a block is
    missed by it."""
    n = len(terms)
    run = max(5, math.ceil(math.sqrt(math.log10(n))))
    most = n // 4
    covariance = autocovariance(terms, min(2 * most + run, n - 1))
    if not covariance[0] > 0.0:
        return 1.0, 0.0
    large = np.abs(covariance[1:]) >= INSIGNIFICANT * math.sqrt(math.log10(n) / n) * covariance[0]
    memory = next((k for k in range(most) if not large[k : k + run].any()), most)
    if memory == 0:
        return 1.0, 0.0
    if memory == most:  # longer than the series can tell
        return float(n), float(n)
    lags = np.arange(1, min(2 * memory, len(covariance) - 1) + 1)
    window = np.minimum(1.0, 2.0 * (1.0 - lags / lags[-1]))
    total = covariance[0] + 2.0 * float(window @ covariance[lags])
    # unlike the flat-top window's, the sum with Bartlett's weights is never negative
    least = covariance[0] + 2.0 * float((1.0 - lags / (lags[-1] + 1.0)) @ covariance[lags])
    beyond = 2.0 * float((window * lags) @ covariance[lags]) / max(total, least)
    return max((1.5 * beyond**2 * n) ** (1.0 / 3.0), 1.0), beyond


def _block_sums(terms: np.ndarray, length: int) -> np.ndarray:
    """Sums (K, f) over K blocks of almost equal length, at least `length`."""
    count = len(terms) // length
    first = np.arange(count) * len(terms) // count
    return np.add.reduceat(terms, first, axis=0)


def autocovariance(terms: np.ndarray, lags: int) -> np.ndarray:
    """Autocovariances (lags + 1,) of deviations (n,), divided by n, so that they are never indefinite."""
    n = len(terms)
    size = 1 << (n + lags).bit_length()
    spectrum = np.abs(np.fft.rfft(terms, size)) ** 2
    return np.fft.irfft(spectrum, size)[: lags + 1] / n
