"""Whether errors that remember their past go with a condition: block bootstrap, effective size, false
discoveries.

The errors of a free run are correlated over half a day and more, so readings are no independent witnesses.
The surrogates here are post-blackened (`resampling`): blocks of the raw errors would lose a share τ/L of the
variance of their means (τ integral time, L block), which at the far tail doubles or triples p.

Shapes: n bins of equal length, k columns of a basis, B surrogates, J questions.

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
"""Ratio of variances from which errors are livelier under a condition; then the blocks' number is what
counts."""


# --- one condition ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Null:
    """A series (n,), surrogates of its noise (B, n), and how much they know.

    Of a series with a large effect, the surrogates take the effect for noise, and its significance has a
    ceiling: `without` the effect they do not.
    """

    values: np.ndarray
    made: np.ndarray
    step_h: float
    freedom: float
    block: int

    @classmethod
    def of(cls, values: np.ndarray, step_h: float = 1.0, count: int = SURROGATES) -> Null:
        """The null world of a series: same memory, no condition."""
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
        """The same series, its noise judged after what a basis (n, k) explains has been taken out."""
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
    """A series (n,) free of its memory: its prediction errors, and the same operation for a basis.

    Where a condition sets in within an hour, it stands out from errors that change slowly (generalised least
    squares).
    """

    phi: np.ndarray
    errors: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray) -> Prewhitened:
        """With the autoregression that the series itself suggests."""
        return cls(*autoregression(values))

    def basis(self, basis: np.ndarray) -> np.ndarray:
        """Columns (n, k) free of the same memory."""
        from scipy.signal import lfilter

        return lfilter(np.concatenate([[1.0], -self.phi]), [1.0], basis, axis=0)

    def size(self, column: np.ndarray) -> float:
        """Coefficient of a column (n,) by generalised least squares [unit of the series]."""
        known = np.isfinite(self.errors)
        x = centred(self.basis(column[:, None]), known)[known, 0]
        return float(x @ self.errors[known]) / max(float(x @ x), 1e-300)


def linear_p(null: Null, bases: Sequence[np.ndarray]) -> np.ndarray:
    """p (J,) that a series is free of each basis (n, k_j): Hotelling's T² with the surrogates' covariance.

    The statistic is (X'e)' Σ⁻¹ (X'e); its law F(k, ν) with ν the smaller of the surrogates' number and the
    series' effective size.  Where a condition is met in a dozen blocks or more, the scatter between the
    blocks is looked at too, and the larger variance counts: errors may be livelier under that condition than
    elsewhere.
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
    """Scatter of the blocks' shares in the score over what the surrogates say, at least 1; effective number
    of blocks."""
    effect, *_ = np.linalg.lstsq(x, e, rcond=None)
    starts = np.arange(0, len(e), block)
    weight = np.add.reduceat(((x @ root.T) ** 2).sum(axis=1), starts)
    clusters = float(weight.sum()) ** 2 / max(float((weight**2).sum()), 1e-300)
    if clusters < FEWEST_CLUSTERS:
        return 1.0, clusters
    shares = np.add.reduceat(x * (e - x @ effect)[:, None], starts, axis=0) @ root.T
    return max(1.0, float((shares**2).sum()) / root.shape[0]), clusters


def largest_p(null: Null, table: np.ndarray) -> tuple[float, int, float]:
    """p that the largest of many columns' |z| is chance, its column, and its z: table (n, m)."""
    x = centred(table, np.isfinite(null.values))
    return _largest(x.T @ null.deviations, null.made @ x, null.freedom)


def _largest(score: np.ndarray, world: np.ndarray, freedom: float) -> tuple[float, int, float]:
    scale = np.sqrt(np.mean(world**2, axis=0))
    scale = np.where(scale > 0, scale, np.inf)
    z = score / scale
    place = int(np.argmax(np.abs(z)))
    # a t-like tail: the scale itself is known from `freedom` values only
    shrunk = abs(float(z[place])) / math.sqrt(1.0 + 0.5 * float(z[place]) ** 2 / freedom)
    return tail(shrunk, np.abs(world / scale).max(axis=1)), place, float(z[place])


def tail(observed: float, simulated: np.ndarray) -> float:
    """p of a value among simulated ones (B,): counted, or beyond the tenth largest from a fitted gamma
    law."""
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

    weights: (J,) laid down beforehand, of mean 1 (they are scaled to it); p is divided by them.  Holds for
    independent and for positively dependent tests.  Here the same hours are asked under overlapping
    conditions, so that the squares of the statistics go up and down together: positive dependence, which
    needs no factor Σ 1/j (Benjamini & Yekutieli 2001, doi:10.1214/aos/1013699998).  The false alarms on
    plants without any hidden cause are counted in the tests.

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
