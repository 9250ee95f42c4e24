"""Variance of sums of serially dependent terms, with the memory estimated from the terms.

Shapes: n terms in their order, f columns.

The sum of a column x with autocovariances R(k) has the variance n g, g = Σ R(k), the column's spectrum at
frequency zero.  It is estimated by the mean square of its first B cosine coefficients, which are almost
independent, so that Student's quantile for B degrees of freedom counts their scatter (Lazarus, Lewis, Stock
& Watson 2018, doi:10.1080/07350015.2018.1506926).  B = 0.4 n^⅔ is their choice; where the memory is longer,
B = n/(3 b), of which the highest frequency lies within the spectrum's flat part: b = (3/2 (G/g)²)^⅓ n^⅓,
G = Σ |k| R(k), is the optimal block length (Politis & White 2004, doi:10.1081/ETC-120028836, with the
correction of 2009), g and G with a flat-top window of twice the lags at which the autocorrelation is
significant.  All lengths are numbers of terms, so that the unit of time does not matter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

INSIGNIFICANT = 2.0
"""Autocorrelations below this times √(log₁₀ n / n) are taken as zero: Politis and White's choice."""
COSINES = 0.4
"""Number of cosines per n^⅔."""
FEWEST_COSINES = 4
"""Least number of cosines; a series of fewer optimal block lengths than this is too short."""
LONGER = 3.0
"""Least number of terms per cosine, in optimal block lengths."""
FEWEST_TERMS = 10


@dataclass(frozen=True)
class LongRun:
    """Covariance (f, f) of the sums of columns, for use with normal quantiles; and `needed` (f,): the length
    of a sufficient series relative to this series, above 1 where this series is too short."""

    covariance: np.ndarray
    needed: np.ndarray


def long_run_covariance(terms: np.ndarray) -> LongRun:
    """Covariance of the sums of serially dependent terms (n, f), positive semi-definite.

    Every variance comes from the column's own number of cosines B, enlarged by the squared ratio of Student's
    to the normal 95 % quantile; the correlations come from the smallest B.  For columns that are too short
    (`needed` above 1) the variance comes from `FEWEST_COSINES`.
    """
    from scipy.fft import dct
    from scipy.special import ndtri, stdtrit

    n, f = terms.shape
    if n < FEWEST_TERMS:
        return LongRun(np.full((f, f), np.nan), np.full(f, FEWEST_TERMS / max(n, 1)))
    optimal = np.array([optimal_block(column) for column in (terms - terms.mean(axis=0)).T])
    largest_number = np.minimum(COSINES * n ** (2.0 / 3.0), n / (LONGER * optimal))
    count = np.maximum(largest_number.astype(int), FEWEST_COSINES)
    cosines = math.sqrt(n) * dct(terms, axis=0, norm="ortho")[1 : count.max() + 1]
    deviations = [
        stdtrit(number, 0.975) / ndtri(0.975) * math.sqrt(float(column[:number] @ column[:number]) / number)
        for column, number in zip(cosines.T, count.tolist(), strict=True)
    ]
    common = cosines[: count.min()]
    product = common.T @ common
    size = np.sqrt(np.diag(product))
    scale = np.divide(deviations, size, out=np.zeros(f), where=size > 0.0)
    # the optimal length grows with the cube root of the series' length
    return LongRun(product * np.outer(scale, scale), np.maximum((FEWEST_COSINES * optimal / n) ** 1.5, 1.0))


def optimal_block(terms: np.ndarray) -> float:
    """Optimal block length of centred terms (n,), at least 1; n where the memory is too long to be
    estimated."""
    n = len(terms)
    run = max(5, math.ceil(math.sqrt(math.log10(n))))
    most = n // 4
    covariance = autocovariance(terms, min(2 * most + run, n - 1))
    if not covariance[0] > 0.0:
        return 1.0
    large = np.abs(covariance[1:]) >= INSIGNIFICANT * math.sqrt(math.log10(n) / n) * covariance[0]
    memory = next((k for k in range(most) if not large[k : k + run].any()), most)
    if memory == 0:
        return 1.0
    if memory == most:
        return float(n)
    lags = np.arange(1, min(2 * memory, len(covariance) - 1) + 1)
    window = np.minimum(1.0, 2.0 * (1.0 - lags / lags[-1]))
    total = covariance[0] + 2.0 * float(window @ covariance[lags])
    # unlike the flat-top window's, the sum with Bartlett's weights is never negative
    bartlett_total = covariance[0] + 2.0 * float((1.0 - lags / (lags[-1] + 1.0)) @ covariance[lags])
    beyond = 2.0 * float((window * lags) @ covariance[lags]) / max(total, bartlett_total)
    return max((1.5 * beyond**2 * n) ** (1.0 / 3.0), 1.0)


def autocovariance(terms: np.ndarray, lags: int) -> np.ndarray:
    """Autocovariances (lags + 1,) of deviations (n,), divided by n, so that they are never indefinite."""
    n = len(terms)
    size = 1 << (n + lags).bit_length()
    spectrum = np.abs(np.fft.rfft(terms, size)) ** 2
    return np.fft.irfft(spectrum, size)[: lags + 1] / n
