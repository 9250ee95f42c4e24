"""Variance of sums of serially dependent terms, whose memory the terms themselves tell.

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
"""Number of cosines in n^⅔."""
FEWEST_COSINES = 4
"""A series of fewer optimal block lengths is too short, one of so many has so many cosines."""
LONGER = 3.0
"""Least terms a cosine, in optimal block lengths."""
FEWEST_TERMS = 10


@dataclass(frozen=True)
class LongRun:
    """Covariance (f, f) of the sums of columns, for use with normal quantiles; and `needed` (f,): the length
    of a sufficient series in lengths of this one, above 1 where this one is too short."""

    covariance: np.ndarray
    needed: np.ndarray


def long_run_covariance(terms: np.ndarray) -> LongRun:
    """Covariance of the sums of serially dependent terms (n, f), positive semi-definite.

    Every variance is from its own column's number of cosines B, enlarged by the square of Student's over the
    normal 95 % quantile; the correlations are from the smallest B.  Columns that are too short (`needed`
    above 1) have the variance of as many cosines as there are.
    """
    from scipy.fft import dct
    from scipy.special import ndtri, stdtrit

    n, f = terms.shape
    if n < FEWEST_TERMS:
        return LongRun(np.full((f, f), np.nan), np.full(f, FEWEST_TERMS / max(n, 1)))
    optimal = np.array([optimal_block(column) for column in (terms - terms.mean(axis=0)).T])
    most = np.minimum(COSINES * n ** (2.0 / 3.0), n / (LONGER * optimal))
    count = np.maximum(most.astype(int), FEWEST_COSINES)
    cosines = math.sqrt(n) * dct(terms, axis=0, norm="ortho")[1 : count.max() + 1]
    deviations = [
        stdtrit(own, 0.975) / ndtri(0.975) * math.sqrt(float(column[:own] @ column[:own]) / own)
        for column, own in zip(cosines.T, count.tolist(), strict=True)
    ]
    common = cosines[: count.min()]
    product = common.T @ common
    size = np.sqrt(np.diag(product))
    scale = np.divide(deviations, size, out=np.zeros(f), where=size > 0.0)
    # the optimal length grows with the cube root of the series' length
    return LongRun(product * np.outer(scale, scale), np.maximum((FEWEST_COSINES * optimal / n) ** 1.5, 1.0))


def optimal_block(terms: np.ndarray) -> float:
    """Optimal block length of centred terms (n,), at least 1; n where their memory is longer than they can
    tell."""
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
    least = covariance[0] + 2.0 * float((1.0 - lags / (lags[-1] + 1.0)) @ covariance[lags])
    beyond = 2.0 * float((window * lags) @ covariance[lags]) / max(total, least)
    return max((1.5 * beyond**2 * n) ** (1.0 / 3.0), 1.0)


def autocovariance(terms: np.ndarray, lags: int) -> np.ndarray:
    """Autocovariances (lags + 1,) of deviations (n,), divided by n, so that they are never indefinite."""
    n = len(terms)
    size = 1 << (n + lags).bit_length()
    spectrum = np.abs(np.fft.rfft(terms, size)) ** 2
    return np.fft.irfft(spectrum, size)[: lags + 1] / n
