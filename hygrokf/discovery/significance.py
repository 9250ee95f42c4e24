"""Whether errors depend on a condition: score tests under the error model, and false discoveries.

The error of a simulation is a stationary process with a free spectrum, filtered by the cabinet's low pass
(`error_model`).  Its standardised innovations e are white.  With x, the columns of a condition after the same
filter, an effect β of the condition gives

    e = x β + white,    (x'e)' (x'x)⁻¹ (x'e) ~ χ²(k) without an effect.

Innovations beyond the Huber bound count as the bound.  Where the daily sums of the scores vary more than
under this law, because the error's variance is larger under the condition, the statistic is divided by the
ratio.  Nuisance columns are those of effects that are already explained.

Shapes: n bins of equal length, k columns of a condition, q nuisance columns, J tests.

Source: Benjamini & Hochberg 1995, doi:10.1111/j.2517-6161.1995.tb02031.x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.discovery.error_model import HUBER, Filtered, course, filtered, maximised

SLOWER = 4.0
"""[1] ratio of the time constant of a slower mass to that of the low pass."""
POSSIBLE = math.log(0.05)
"""ln p above which the statistic is not corrected for the scatter of the days."""
EDGE = 0.05
"""[1] share of the readings at either end among which no change is searched."""
INTERVAL = 4.0
"""Difference in the χ² statistic from which one explanation is clearly better than another (95 %
interval)."""
ROUNDING = 1e-12
"""Share of a column's square up to which the part orthogonal to the nuisance is rounding error."""
NEAR = 2
"""Bins around a change in which an outlier or a shock may explain it instead."""
SHARP_H = 1.0
"""[h] longest confidence interval of a date that counts as certain."""


@dataclass(frozen=True)
class Whitened:
    """The standardised innovations of an error (n,), orthogonal to nuisance columns (n, q).

    error: NaN without a reading; step_h, tau_h: [h] length of a bin, time constant of the low pass; basis:
    (n, q) orthonormal basis of the whitened nuisance; e: (n,) innovations orthogonal to the basis, 0 without
    a reading.
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
        """The error whitened under its maximum-likelihood variances, with a constant as nuisance."""
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
        """Columns (n, k) of a condition (n, m), NaN = unknown, minus their means; with `flow` also the
        responses of the air and of a slower mass to a flow with the course of the condition."""
        is_known = np.isfinite(condition)
        values = np.where(is_known, condition, 0.0)
        mean = values.sum(axis=0) / np.maximum(is_known.sum(axis=0), 1)
        centred = np.where(is_known, values - mean, 0.0)
        if not flow:
            return centred
        return np.column_stack([centred, self.low_passed(centred), self.low_passed(centred, SLOWER)])

    def low_passed(self, columns: np.ndarray, slower: float = 1.0) -> np.ndarray:
        """Columns (n, k) filtered by the low pass τ dz/dt = −z + column, whose τ is `slower` times the
        error's time constant."""
        from scipy.signal import lfilter

        decay = np.exp(-self.step_h / (slower * self.tau_h))
        return lfilter([1.0 - decay], [1.0, -decay], columns, axis=0)

    def whitened(self, columns: np.ndarray) -> np.ndarray:
        """Columns (n, k) whitened by the filter and orthogonal to the nuisance."""
        white = self.known.whitened(columns)
        squares_before = np.einsum("ni,ni->i", white, white)
        white -= self.basis @ (self.basis.T @ white)
        white[:, np.einsum("ni,ni->i", white, white) <= ROUNDING * squares_before] = 0.0
        return white

    def log_p(self, white: np.ndarray, full: bool = False) -> float:
        """ln p of the hypothesis that the error does not depend on a condition with whitened columns (n, k);
        full: without the Huber bound."""
        root = _root(white)
        if root is None:
            return 0.0
        e, rank = self.e if full else _clipped(self.e), root.shape[1]
        statistic = _square(root.T @ (white.T @ e))
        if _log_tail(statistic, rank) > POSSIBLE:
            return _log_tail(statistic, rank)
        remainder = _clipped(self.e - white @ (root @ (root.T @ (white.T @ self.e))))
        daily = np.add.reduceat(
            white * remainder[:, None], np.arange(0, len(remainder), round(24.0 / self.step_h))
        )
        return _log_tail(statistic / max(1.0, _square(daily @ root) / rank), rank)

    def effect(self, columns: np.ndarray) -> np.ndarray:
        """The part (n,) of the error that columns (n, k) explain, by generalised least squares."""
        white = self.whitened(columns)
        root = _root(white)
        if root is None:
            return np.zeros(len(columns))
        return columns @ (root @ (root.T @ (white.T @ self.e)))

    def rejudged(self, columns: np.ndarray) -> Whitened:
        """The same error under the variances of its part that columns (n, k) do not explain: the effect would
        otherwise raise the slow variances, which then hide it."""
        remainder = self.error - self.effect(columns)
        variances = maximised(self.known.course, remainder, self.known.variances)
        return self._with(self.error, variances, self.nuisance)

    def without(self, columns: np.ndarray, kin: np.ndarray) -> Whitened:
        """The error minus the part that columns (n, k) explain; these columns and `kin` (n, c) join the
        nuisance."""
        remainder = self.error - self.effect(columns)
        variances = maximised(self.known.course, remainder, self.known.variances)
        return self._with(remainder, variances, np.column_stack([self.nuisance, columns, kin]))

    def change(self) -> tuple[int, bool, int, bool]:
        """The likeliest lasting change: its first bin, whether it is one of a flow (else of the readings),
        the number of changes that were tried, and whether the date is certain to the hour.

        The adjoint filter gives the scores of all dates in one pass: the score of a change at bin t is the
        sum of the contributions from bin t on.  The information is that of a record without gaps.
        Innovations count without the Huber bound.  Dates near which an outlier, or a shock to the process
        itself, explains the innovations clearly better are left out.
        """
        from scipy.ndimage import maximum_filter1d
        from scipy.signal import lfilter

        count, decay = len(self.e), np.exp(-self.step_h / self.tau_h)
        contributions = np.column_stack([self._adjoint(column) for column in (self.e, *self.basis.T)])
        reversed_contributions = contributions[::-1]
        direct = np.cumsum(reversed_contributions, axis=0)
        sums = np.stack(
            [direct, direct - decay * lfilter([1.0], [1.0, -decay], reversed_contributions, axis=0)], axis=1
        )[::-1]
        read = np.flatnonzero(np.isfinite(self.error))
        margin = round(EDGE * len(read))
        dates = read[margin : len(read) - margin]
        first = min(round(EDGE * count), int(dates[0]))
        bin_index = np.arange(count)
        step, outlier = (
            (bin_index >= first)[:, None].astype(float),
            (bin_index == first)[:, None].astype(float),
        )
        steady = filtered(self.known.course, self.known.variances, np.zeros(count))
        white = steady.whitened(np.column_stack([step, self.low_passed(step), outlier]))[first:]
        square = np.cumsum(white[:, :2] ** 2, axis=0)[count - 1 - dates]
        square = square - (sums[dates, :, 1:] ** 2).sum(axis=2)
        safe = np.where(square > 0.0, square, np.inf)
        statistic = sums[dates, :, 0] ** 2 / safe
        shock = np.maximum(self.e**2, contributions[:, 0] ** 2 / _square(white[:, 2]))
        statistic[statistic < maximum_filter1d(shock, 2 * NEAR + 1)[dates, None] - INTERVAL] = 0.0
        best, flow = np.unravel_index(np.argmax(statistic), statistic.shape)
        likely_bins = int((statistic[:, flow] > statistic[best, flow] - INTERVAL).sum())
        return int(dates[best]), bool(flow), statistic.size, likely_bins * self.step_h <= SHARP_H

    def _adjoint(self, white: np.ndarray) -> np.ndarray:
        """(n,) contribution of each reading to the product of the whitened readings with a vector (n,)."""
        is_present = np.isfinite(self.known.innovation)
        innovation = np.where(is_present, white * np.sqrt(self.known.variance), np.nan)
        smoothed = replace(self.known, innovation=innovation, predicted=np.zeros(len(white))).smoothed()
        noise = self.known.variances[0] * self.known.course.shape
        return np.where(is_present, (innovation - smoothed) / noise, 0.0)


def _square(values: np.ndarray) -> float:
    return float(np.sum(values**2))


def _clipped(e: np.ndarray) -> np.ndarray:
    return np.clip(e, -HUBER, HUBER)


def _root(white: np.ndarray) -> np.ndarray | None:
    """R (k, r) that makes columns (n, k) orthonormal in their r independent directions; None for r = 0."""
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
    """ln of the probability that χ² with `freedom` degrees of freedom exceeds a value."""
    from scipy.special import chdtrc, gammaln

    p = float(chdtrc(freedom, value))
    if p > 0.0:
        return math.log(p)
    return (0.5 * freedom - 1.0) * math.log(0.5 * value) - 0.5 * value - float(gammaln(0.5 * freedom))


def benjamini_hochberg(p: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """q (J,): the share of false discoveries among all tests that are at least as significant.

    weights: (J,) fixed beforehand, scaled to mean 1; p is divided by them.  Valid for independent and for
    positively dependent tests.  Overlapping conditions share hours, so that their statistics are positively
    dependent and need no factor Σ 1/j (Benjamini & Yekutieli 2001, doi:10.1214/aos/1013699998).

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
