"""Whether correlated errors depend on a condition: block bootstrap, effective size, false discoveries.

The errors of a free run are correlated over half a day and more, so readings are not independent.  The
surrogates are post-blackened (`evaluation.bootstrap`): blocks of the raw errors would lose a share τ/L of
the variance of their means (τ integral time, L block), which changes p in the far tail by a factor of two or
three.

Shapes: n bins of equal length, k columns of a basis, B surrogates, J tests.

Source: Künsch 1989, doi:10.1214/aos/1176347265; Politis & Romano 1992 (circular blocks); Davison & Hinkley
1997, section 8.2.3 (post-blackening); Benjamini & Hochberg 1995, doi:10.1111/j.2517-6161.1995.tb02031.x.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.evaluation.bootstrap import SURROGATES, autoregression, block_h, effective_size, surrogates

SECOND_LOOK = 200
"""Surrogates where the noise is judged again without an effect."""
FEWEST_CLUSTERS = 10.0
"""Effective number of blocks from which a condition's own scatter can be judged."""
LIVELY = 1.5
"""Ratio of variances from which errors are livelier under a condition; then the number of blocks counts."""


@dataclass(frozen=True)
class Null:
    """A series (n,), surrogates of its noise (B, n), its degrees of freedom, and the length of its blocks.

    Surrogates of a series with a large effect take the effect for noise, which limits its significance; those
    `without` the effect do not.
    """

    values: np.ndarray
    made: np.ndarray
    step_h: float
    freedom: float
    block: int

    @classmethod
    def of(cls, values: np.ndarray, step_h: float = 1.0, count: int = SURROGATES) -> Null:
        """Surrogates of a series: the same memory, no condition."""
        known = np.isfinite(values)
        freedom = max(4.0, effective_size(values, step_h))
        block = max(1, round(block_h(values, step_h) / step_h))
        made = surrogates(values, step_h, count)
        return cls(np.where(known, values, np.nan), np.where(known, made, 0.0), step_h, freedom, block)

    @property
    def deviations(self) -> np.ndarray:
        """The series (n,) less its mean, 0 where it is missing."""
        known = np.isfinite(self.values)
        return np.where(known, self.values - float(np.mean(self.values[known])), 0.0)

    def without(self, basis: np.ndarray) -> Null:
        """The same series, its noise estimated without the part that a basis (n, k) explains."""
        x, e = centred(basis, np.isfinite(self.values)), self.deviations
        effect, *_ = np.linalg.lstsq(x, e, rcond=None)
        noise = np.where(np.isfinite(self.values), e - x @ effect, np.nan)
        return replace(Null.of(noise, self.step_h, min(SECOND_LOOK, len(self.made))), values=self.values)


def centred(basis: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Columns (n, k) less their means over the known bins, zero elsewhere; unknown entries count as the
    mean."""
    there = known[:, None] & np.isfinite(basis)
    number = np.maximum(there.sum(axis=0), 1)
    filled = np.where(there, basis, 0.0)
    return np.where(there, filled - filled.sum(axis=0) / number, 0.0)


@dataclass(frozen=True)
class Prewhitened:
    """A series (n,) without its memory: its prediction errors, and the same operation for a basis.

    A condition that sets in within an hour stands out from errors that change slowly (generalised least
    squares).
    """

    phi: np.ndarray
    errors: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray) -> Prewhitened:
        """With the autoregression that the series itself suggests."""
        return cls(*autoregression(values))

    def basis(self, basis: np.ndarray) -> np.ndarray:
        """Columns (n, k) without the same memory."""
        from scipy.signal import lfilter

        return lfilter(np.concatenate([[1.0], -self.phi]), [1.0], basis, axis=0)

    def size(self, column: np.ndarray) -> float:
        """Coefficient of a column (n,) by generalised least squares [unit of the series]."""
        known = np.isfinite(self.errors)
        x = centred(self.basis(column[:, None]), known)[known, 0]
        return float(x @ self.errors[known]) / max(float(x @ x), 1e-300)


def linear_p(null: Null, bases: Sequence[np.ndarray]) -> np.ndarray:
    """p (J,) that a series is free of each basis (n, k_j): Hotelling's T² with the surrogates' covariance.

    The statistic is (X'e)' Σ⁻¹ (X'e); its law is F(k, ν) with ν the smaller of the surrogates' number and the
    series' effective size.  Where a condition holds in ten blocks or more, the scatter between the blocks is
    also estimated, and the larger variance counts: errors may be livelier under that condition.
    """
    from scipy.stats import f as f_law

    known, e = np.isfinite(null.values), null.deviations
    columns = [centred(basis, known) for basis in bases]
    table = np.concatenate(columns, axis=1)
    score, world = table.T @ e, null.made @ table
    result, first = np.ones(len(bases)), 0
    count = len(null.made)
    for j, x in enumerate(columns):
        part = slice(first, first + x.shape[1])
        first += x.shape[1]
        root = _whitening(world[:, part].T @ world[:, part] / count)
        if root is None:
            continue
        u = root @ score[part]
        k = len(u)
        inflation, clusters = _inflation(x, e, root, null.block)
        freedom = min(count - k + 1.0, null.freedom)
        if inflation > LIVELY:
            freedom = min(freedom, clusters)
        statistic = float(u @ u) / inflation * (count - k + 1.0) / (k * count)
        result[j] = float(f_law.sf(statistic, k, freedom))
    return result


def _whitening(covariance: np.ndarray) -> np.ndarray | None:
    """Rows W with W Σ W' = 1 for the directions that the covariance resolves; None without any."""
    scale = np.sqrt(np.diag(covariance))
    used = scale > 1e-12 * max(float(scale.max(initial=0.0)), 1e-300)
    if not used.any() or not np.isfinite(scale).all():
        return None
    safe = np.where(used, scale, 1.0)
    value, vector = np.linalg.eigh(covariance / np.outer(safe, safe))
    kept = value > 1e-6 * value[-1]
    return (vector[:, kept] / np.sqrt(value[kept])).T / safe


def _inflation(x: np.ndarray, e: np.ndarray, root: np.ndarray, block: int) -> tuple[float, float]:
    """Scatter of the blocks' shares in the score over that of the surrogates, at least 1; effective number of
    blocks."""
    effect, *_ = np.linalg.lstsq(x, e, rcond=None)
    starts = np.arange(0, len(e), block)
    weight = np.add.reduceat(((x @ root.T) ** 2).sum(axis=1), starts)
    clusters = float(weight.sum()) ** 2 / max(float((weight**2).sum()), 1e-300)
    if clusters < FEWEST_CLUSTERS:
        return 1.0, clusters
    shares = np.add.reduceat(x * (e - x @ effect)[:, None], starts, axis=0) @ root.T
    return max(1.0, float((shares**2).sum()) / root.shape[0]), clusters


def largest_p(null: Null, table: np.ndarray) -> float:
    """p that the largest |z| of many columns (n, m) is chance."""
    x = centred(table, np.isfinite(null.values))
    score, world = x.T @ null.deviations, null.made @ x
    scale = np.sqrt(np.mean(world**2, axis=0))
    scale = np.where(scale > 0, scale, np.inf)
    z = float(np.abs(score / scale).max())
    # a tail like that of t: the scale itself is known from `freedom` values only
    shrunk = z / math.sqrt(1.0 + 0.5 * z**2 / null.freedom)
    return tail(shrunk, np.abs(world / scale).max(axis=1))


def tail(observed: float, simulated: np.ndarray) -> float:
    """p of a value among simulated ones (B,): counted, or beyond the tenth largest by a fitted gamma law."""
    exceeding = int((simulated >= observed).sum())
    if exceeding >= 10:
        return (exceeding + 1.0) / (len(simulated) + 1.0)
    from scipy.stats import pearson3

    mean, sd = float(simulated.mean()), float(simulated.std())
    if sd <= 0:
        return 1.0 if observed <= mean else 1.0 / (len(simulated) + 1.0)
    skew = max(float(np.mean(((simulated - mean) / sd) ** 3)), 0.05)
    return float(min(pearson3.sf(observed, skew, mean, sd), 10.0 / len(simulated)))


# --- many conditions -------------------------------------------------------------------------


def benjamini_hochberg(p: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """q (J,): the share of false discoveries among all that are at least as significant.

    weights: (J,) fixed beforehand, of mean 1 (they are scaled to it); p is divided by them.  Holds for
    independent and for positively dependent tests.  Here overlapping conditions share hours, so the squares
    of the statistics rise and fall together: positive dependence, which needs no factor Σ 1/j (Benjamini &
    Yekutieli 2001, doi:10.1214/aos/1013699998).  The tests count the false alarms on plants without a hidden
    cause.

    Source: Genovese, Roeder & Wasserman 2006, doi:10.1093/biomet/93.3.509 (weights).
    """
    p = np.asarray(p, dtype=float)
    if weights is not None:
        p = p / (np.asarray(weights, dtype=float) * len(p) / float(np.sum(weights)))
    order = np.argsort(p)
    scaled = p[order] * len(p) / np.arange(1, len(p) + 1)
    result = np.empty(len(p))
    result[order] = np.minimum(np.minimum.accumulate(scaled[::-1])[::-1], 1.0)
    return result
