"""Whether errors depend on a condition: score tests under the error model, and false discoveries.

What a simulation misses is a stationary process with a free spectrum behind the cabinet's low pass
(`error_model`).  Standardised innovations e of such an error are white.  A condition whose columns become x
in the same filter leaves in them

    e = x β + white,    (x'e)' (x'x)⁻¹ (x'e) ~ χ²(k) without an effect.

Innovations beyond the Huber bound count as the bound.  Where the scores of whole days scatter more than this
law says, because errors are livelier under the condition, the statistic is divided by the excess.

Shapes: n bins of equal length, k columns of a condition, q nuisance columns, J tests.

Source: Benjamini & Hochberg 1995, doi:10.1111/j.2517-6161.1995.tb02031.x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.discovery.error_model import HUBER, Filtered, course, filtered, maximised

SLOWER = 4.0
"""[1] time constant of a slower mass over that of the low pass."""
POSSIBLE = math.log(0.05)
"""ln p above which the scatter of the days does not matter any more."""
EDGE = 0.05
"""[1] share of the readings at either end among which no change is looked for."""
INTERVAL = 4.0
"""Statistic by which one explanation must lead another to be clearly better: that of a 95 % interval."""

ROUNDING = 1e-12
"""Share of a column's square beside the nuisance that is rounding."""
NEAR = 2
"""Bins around a change within which something that does not last may explain it."""
SHARP_H = 1.0
"""[h] longest interval of a date that is sure."""


@dataclass(frozen=True)
class Whitened:
    """An error (n,) in standardised innovations, beside nuisance columns (n, q).

    error: NaN without a reading; step_h, tau_h: [h] length of a bin, time constant of
    the low pass; basis: (n, q) of the whitened nuisance, orthonormal; e: (n,) innovations beside it, 0
    without a reading.
    """

    error: np.ndarray
    step_h: float
    tau_h: float
    known: Filtered
    nuisance: np.ndarray
    basis: np.ndarray
    e: np.ndarray

    @classmethod
    def of(cls, error: np.ndarray, step_h: float, tau_h: float) -> Whitened:
        """Under the variances of the greatest likelihood, beside a constant."""
        error = error - np.nanmean(error)
        largest = max(float(np.nanvar(error)), 1e-12)
        time = step_h * np.arange(len(error))
        seen = course(time, tau_h, np.zeros(len(error)), largest=largest)
        known = filtered(seen, maximised(seen, error), error)
        empty = np.empty((len(error), 0))
        return cls(error, step_h, tau_h, known, empty, empty, error)._with(
            error, known.variances, np.ones((len(error), 1))
        )

    def _with(self, error: np.ndarray, variances: np.ndarray, nuisance: np.ndarray) -> Whitened:
        known = filtered(self.known.course, variances, error)
        white = known.whitened(nuisance)
        root = _root(white)
        basis = white[:, :0] if root is None else white @ root
        e = np.nan_to_num(known.standardised)
        return replace(
            self, error=error, known=known, nuisance=nuisance, basis=basis, e=e - basis @ (basis.T @ e)
        )

    def columns(self, condition: np.ndarray, flow: bool) -> np.ndarray:
        """Columns (n, k) of a condition (n, m), NaN = unknown, less their means; with `flow` also those that
        it leaves if it acts as a flow on the air, or on a slower mass."""
        there = np.isfinite(condition)
        known = np.where(there, condition, 0.0)
        mean = known.sum(axis=0) / np.maximum(there.sum(axis=0), 1)
        centred = np.where(there, known - mean, 0.0)
        if not flow:
            return centred
        return np.column_stack([centred, self.low_passed(centred), self.low_passed(centred, SLOWER)])

    def low_passed(self, columns: np.ndarray, slower: float = 1.0) -> np.ndarray:
        """Columns (n, k) behind the low pass: τ dz/dt = −z + column, with τ by so much longer."""
        from scipy.signal import lfilter

        left = np.exp(-self.step_h / (slower * self.tau_h))
        return lfilter([1.0 - left], [1.0, -left], columns, axis=0)

    def whitened(self, columns: np.ndarray) -> np.ndarray:
        """Columns (n, k) in the innovations, without the nuisance."""
        white = self.known.whitened(columns)
        before = np.einsum("ni,ni->i", white, white)
        white -= self.basis @ (self.basis.T @ white)
        white[:, np.einsum("ni,ni->i", white, white) <= ROUNDING * before] = 0.0
        return white

    def log_p(self, white: np.ndarray, full: bool = False) -> float:
        """ln p that the error is free of a condition, of its whitened columns (n, k); full: innovations count
        in full."""
        root = _root(white)
        if root is None:
            return 0.0
        e, rank = self.e if full else _clipped(self.e), root.shape[1]
        size = _square(root.T @ (white.T @ e))
        if _log_tail(size, rank) > POSSIBLE:
            return _log_tail(size, rank)
        left = _clipped(self.e - white @ (root @ (root.T @ (white.T @ self.e))))
        daily = np.add.reduceat(white * left[:, None], np.arange(0, len(left), round(24.0 / self.step_h)))
        return _log_tail(size / max(1.0, _square(daily @ root) / rank), rank)

    def effect(self, columns: np.ndarray) -> np.ndarray:
        """(n,) what columns (n, k) explain of the error, by generalised least squares."""
        white = self.whitened(columns)
        root = _root(white)
        if root is None:
            return np.zeros(len(columns))
        return columns @ (root @ (root.T @ (white.T @ self.e)))

    def rejudged(self, columns: np.ndarray) -> Whitened:
        """The same under variances of the error without what columns (n, k) explain: an effect feigns a
        memory, which would hide it."""
        rest = self.error - self.effect(columns)
        variances = maximised(self.known.course, rest, self.known.variances)
        return self._with(self.error, variances, self.nuisance)

    def without(self, columns: np.ndarray, kin: np.ndarray) -> Whitened:
        """The error without what columns (n, k) explain; they and their `kin` (n, c) are nuisance from here
        on."""
        rest = self.error - self.effect(columns)
        variances = maximised(self.known.course, rest, self.known.variances)
        return self._with(rest, variances, np.column_stack([self.nuisance, columns, kin]))

    def change(self) -> tuple[int, bool, int, bool]:
        """The likeliest lasting change: from which bin on, whether of a flow (else of the readings), how many
        were tried, and whether the date is sure to the hour.

        The adjoint filter gives the scores of all dates in one pass: a change from bin t on meets the sum of
        what is behind t.  Its information is that in a record without holes.  Innovations count in full;
        dates near which a stray reading, or a shock that the process itself forgets, explains them clearly
        better are left out.
        """
        from scipy.ndimage import maximum_filter1d
        from scipy.signal import lfilter

        count, left = len(self.e), np.exp(-self.step_h / self.tau_h)
        told = np.column_stack([self._adjoint(one) for one in (self.e, *self.basis.T)])
        ahead = told[::-1]
        direct = np.cumsum(ahead, axis=0)
        sums = np.stack([direct, direct - left * lfilter([1.0], [1.0, -left], ahead, axis=0)], axis=1)[::-1]
        read = np.flatnonzero(np.isfinite(self.error))
        margin = round(EDGE * len(read))
        within = read[margin : len(read) - margin]
        first = min(round(EDGE * count), int(within[0]))
        place = np.arange(count)
        step, stray = (place >= first)[:, None].astype(float), (place == first)[:, None].astype(float)
        steady = filtered(self.known.course, self.known.variances, np.zeros(count))
        white = steady.whitened(np.column_stack([step, self.low_passed(step), stray]))[first:]
        square = np.cumsum(white[:, :2] ** 2, axis=0)[count - 1 - within]
        square = square - (sums[within, :, 1:] ** 2).sum(axis=2)
        safe = np.where(square > 0.0, square, np.inf)
        value = sums[within, :, 0] ** 2 / safe
        shock = np.maximum(self.e**2, told[:, 0] ** 2 / _square(white[:, 2]))
        value[value < maximum_filter1d(shock, 2 * NEAR + 1)[within, None] - INTERVAL] = 0.0
        best, flow = np.unravel_index(np.argmax(value), value.shape)
        likely = int((value[:, flow] > value[best, flow] - INTERVAL).sum())
        return int(within[best]), bool(flow), value.size, likely * self.step_h <= SHARP_H

    def _adjoint(self, white: np.ndarray) -> np.ndarray:
        """(n,) what each reading adds to the product of whitened readings with a vector (n,)."""
        seen = np.isfinite(self.known.innovation)
        innovation = np.where(seen, white * np.sqrt(self.known.variance), np.nan)
        told = replace(self.known, innovation=innovation, predicted=np.zeros(len(white))).smoothed()
        noise = self.known.variances[0] * self.known.course.shape
        return np.where(seen, (innovation - told) / noise, 0.0)


def _square(values: np.ndarray) -> float:
    return float(np.sum(values**2))


def _clipped(e: np.ndarray) -> np.ndarray:
    return np.clip(e, -HUBER, HUBER)


def _root(white: np.ndarray) -> np.ndarray | None:
    """R (k, r) that makes columns (n, k) orthonormal in the directions that they resolve; None without
    any."""
    gram = white.T @ white
    scale = np.sqrt(np.diag(gram))
    used = scale > 1e-9 * max(float(scale.max(initial=0.0)), 1e-9)
    if not used.any():
        return None
    scale = np.where(used, scale, np.inf)
    value, vector = np.linalg.eigh(gram / np.outer(scale, scale))
    kept = value > 1e-6 * value[-1]
    return vector[:, kept] / np.sqrt(value[kept]) / scale[:, None]


def _log_tail(value: float, freedom: int) -> float:
    """ln of the chance that χ² with so many degrees of freedom exceeds a value."""
    from scipy.special import chdtrc, gammaln

    p = float(chdtrc(freedom, value))
    if p > 0.0:
        return math.log(p)
    return (0.5 * freedom - 1.0) * math.log(0.5 * value) - 0.5 * value - float(gammaln(0.5 * freedom))


def benjamini_hochberg(p: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """q (J,): the share of false discoveries among all that are at least as significant.

    weights: (J,) fixed beforehand, of mean 1 (they are scaled to it); p is divided by them.  Holds for
    independent and for positively dependent tests.  Here overlapping conditions share hours, so the squares
    of the statistics rise and fall together: positive dependence, which needs no factor Σ 1/j (Benjamini &
    Yekutieli 2001, doi:10.1214/aos/1013699998).

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
