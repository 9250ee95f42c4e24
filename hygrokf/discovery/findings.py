"""Findings: under which conditions a simulation errs, in which direction and by how much, worst first.

Score tests under the error model say whether errors depend on a condition; the rate of false discoveries is
held.
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
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hygrokf.discovery.conditions import Stratum, conditions, dummies, step_at
from hygrokf.discovery.discovery_results import Finding
from hygrokf.discovery.error_model import HUBER, Filtered, course, filtered, maximised
from hygrokf.discovery.residuals import (
    RESIDUAL_QUANTITIES,
    Quantity,
    Residuals,
    binned,
    closed,
    duration_h,
    root_mean_square,
    run_lengths,
)
from hygrokf.estimation.conventions import SIGNIFICANCE

# -- score tests ---------------------------------------------------------------------------------------------
SLOWER = 4.0
"""[1] ratio of the time constant of a slower mass to that of the low pass."""
POSSIBLE = math.log(0.05)
"""ln p above which the statistic is not corrected for the scatter of the days."""
EDGE_SHARE = 0.05
"""[1] share of the readings at either end among which no change is searched."""
INTERVAL = 4.0
"""Difference in the χ² statistic from which one explanation is clearly better than another (95 %
interval)."""
ORTHOGONAL_ROUNDING = 1e-12
"""Share of a column's square up to which the part orthogonal to the nuisance is rounding error."""
NEAR_BINS = 2
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
        white[:, np.einsum("ni,ni->i", white, white) <= ORTHOGONAL_ROUNDING * squares_before] = 0.0
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
        margin = round(EDGE_SHARE * len(read))
        dates = read[margin : len(read) - margin]
        first = min(round(EDGE_SHARE * count), int(dates[0]))
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
        statistic[statistic < maximum_filter1d(shock, 2 * NEAR_BINS + 1)[dates, None] - INTERVAL] = 0.0
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


# -- findings ------------------------------------------------------------------------------------------------
FINDING_BIN_H = 0.25
"""[h] shortest bins in which the errors are tested."""
FEWEST_H = 72.0
"""[h] fewest hours with an error for an analysis."""
MATERIAL_SHARE = 0.2
"""[1] share of the free run's RMSE below which a finding is immaterial, however significant."""
SENSORS_SHARE = 0.6
"""[1] largest share of a finding's square that the sensors' accuracy may explain."""
CERTAIN = 1e-8
"""p above which a slow condition is tested again under variances of the error without its effect."""
MOST_FINDINGS = 8
"""Findings that are reported."""
WHITENED_TOGETHER = 8
"""Conditions whose columns are whitened together."""
SEEN = 0.5
"""[1] share of a finding's size from which an episode counts as showing the finding."""


@dataclass
class _QuantityErrors:
    """The errors of one quantity without the findings so far, and ln p of each condition; the last condition
    is a step, of a flow (`flow`) or of the readings."""

    quantity: Quantity
    rmse: float
    white: Whitened
    conditions: list[Stratum]
    flow: bool = False
    log_p: np.ndarray = field(default_factory=lambda: np.empty(0))

    def columns(self, number: int) -> np.ndarray:
        """Columns (n, k) of a condition; columns of all conditions would not fit into memory for years of
        readings."""
        condition = self.conditions[number]
        if number < len(self.conditions) - 1:
            return self.white.columns(condition.basis, condition.flow)
        step = self.white.columns(condition.basis, False)
        return self.white.low_passed(step) if self.flow else step


def findings(residuals: Residuals) -> list[Finding]:
    """The errors of the free run in the identification period, worst (in units of its RMSE) first, at most
    eight.

    Each condition (episodes, regimes, hours since a change, hour, season, level, rate and lag of every
    driver, drift and step, saturation) is tested on the free run's errors.  The most significant condition is
    described and removed from the errors, then all conditions are tested again, so that an effect is reported
    under one condition only.  A finding must be significant (weighted Benjamini–Hochberg: episodes, hour,
    calendar and drivers have equal shares of the level), material (0.2 RMSE) and larger than the sensors'
    accuracy explains.

    A quantity with errors in fewer than 72 hours has no findings.  Raises KeyError for a quantity without a
    time constant in the residuals.
    """
    bins = binned(residuals, FINDING_BIN_H)
    common_conditions = conditions(bins)
    states = []
    for quantity in RESIDUAL_QUANTITIES:
        error = bins.error[quantity]
        if np.isfinite(error).sum() * bins.step_h >= FEWEST_H:
            white = Whitened.of(error, bins.step_h, residuals.time_constants[quantity])
            states.append(_QuantityErrors(quantity, residuals.rmse(quantity), white, common_conditions))
    results: list[Finding] = []
    changed_states = states
    for _ in range(MOST_FINDINGS):
        for state in changed_states:
            _test(state, common_conditions, bins)
        adjusted = _adjusted(states)
        changed_states = []
        for state, q in zip(states, adjusted, strict=True):
            for number in np.argsort(state.log_p, kind="stable"):
                is_significant = q[number] <= SIGNIFICANCE
                finding = _described(bins, state, number, float(q[number])) if is_significant else None
                if finding is not None:
                    results.append(finding)
                    _remove_effect(state, number)
                    changed_states.append(state)
                    break
        if not changed_states:
            break
    rmse = {state.quantity: state.rmse for state in states}
    results.sort(key=lambda finding: -finding.size / rmse[finding.quantity])
    return results[:MOST_FINDINGS]


def _test(state: _QuantityErrors, common_conditions: Sequence[Stratum], hours: Residuals) -> None:
    """Compute ln p of every condition and of the likeliest step."""
    white = state.white
    first_bin, state.flow, number_tried, sharp = white.change()
    state.conditions = [*common_conditions, step_at(hours, first_bin, sharp)]

    def log_p(under: Whitened, condition: Stratum, table: np.ndarray) -> float:
        if condition.kind != "step":
            return under.log_p(table)
        return min(0.0, under.log_p(table, full=True) + math.log(number_tried))

    log_p_of: list[float] = []
    for first in range(0, len(state.conditions), WHITENED_TOGETHER):
        batch = state.conditions[first : first + WHITENED_TOGETHER]
        tables = [state.columns(first + i) for i in range(len(batch))]
        ends = np.cumsum([table.shape[1] for table in tables])[:-1]
        tables = np.split(white.whitened(np.column_stack(tables)), ends, axis=1)
        log_p_of += [log_p(white, *pair) for pair in zip(batch, tables, strict=True)]
    for i, condition in enumerate(state.conditions):
        if condition.group == "calendar" and log_p_of[i] > math.log(CERTAIN):
            retested = white.rejudged(columns := state.columns(i))
            log_p_of[i] = min(log_p_of[i], log_p(retested, condition, retested.whitened(columns)))
    state.log_p = np.array(log_p_of)


def _adjusted(states: Sequence[_QuantityErrors]) -> list[np.ndarray]:
    """q (J,) of every quantity; groups of conditions have equal shares of the level."""
    if not states:
        return []
    groups = [condition.group for condition in states[0].conditions]
    weights = np.array([1.0 / groups.count(group) for group in groups])
    p = np.exp(np.concatenate([state.log_p for state in states]))
    q = benjamini_hochberg(p, np.tile(weights, len(states)))
    return list(q.reshape(len(states), -1))


def _remove_effect(state: _QuantityErrors, number: int) -> None:
    """Remove the part of the errors that a condition explains; its bins, and all conditions on the same
    driver, become nuisance."""
    condition = state.conditions[number]
    same_driver = [
        state.columns(i)
        for i, other in enumerate(state.conditions)
        if other.driver and other.driver == condition.driver
    ]
    bins = state.white.columns(dummies(condition.bins), False)
    state.white = state.white.without(state.columns(number), np.column_stack([bins, *same_driver]))


def _described(hours: Residuals, state: _QuantityErrors, number: int, q: float) -> Finding | None:
    """The finding of a condition; None if it is immaterial, or if the free run does not show it.

    Innovations show fast effects.  An effect whose removal would not lower the squared error of the free run
    is not reported, since the model compensates for it on average.
    """
    condition, error = state.conditions[number], state.white.error
    is_known = np.isfinite(error)
    effect = np.where(is_known, state.white.effect(state.columns(number)), np.nan)
    centred = effect[is_known] - effect[is_known].mean()
    if 2.0 * centred @ error[is_known] <= centred @ centred:
        return None
    first, last = condition.worst(effect)
    inside = condition.inside(first, last)
    inside_known, outside_known = is_known & inside, is_known & ~inside & (condition.bins >= 0)
    if not (inside_known.any() and outside_known.any()):
        return None
    size = float(effect[inside_known].mean() - effect[outside_known].mean())
    sensor_error = float(np.nan_to_num(root_mean_square(hours.sensor_error[state.quantity][inside])))
    sensor_share = min(1.0, (sensor_error / size) ** 2) if size else 1.0
    if abs(size) < MATERIAL_SHARE * state.rmse or sensor_share > SENSORS_SHARE:
        return None
    deviation = np.sign(size) * (error - error[outside_known].mean())
    episodes = [(a, b) for a, b in run_lengths(closed(inside, hours.step_h)) if inside_known[a:b].any()]
    means = np.array([float(deviation[a:b][inside_known[a:b]].mean()) for a, b in episodes])
    duration = duration_h(deviation, episodes, hours.step_h) if condition.kind == "episode" else math.nan
    half = 1800.0 * hours.step_h
    return Finding(
        state.quantity, condition.kind, condition.driver, condition.phrase(first, last),
        "low" if size > 0 else "high", duration if duration > 0 else math.nan,
        abs(size), int((means >= SEEN * abs(size)).sum()), len(episodes), sensor_share, q,
        tuple(
            (float(hours.time_s[a] - half), float(hours.time_s[b - 1] + half))
            for a, b in (episodes[i] for i in np.argsort(-means, kind="stable"))
        ),
    )  # fmt: skip
