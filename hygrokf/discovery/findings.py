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
"""[1] time constant of a slower mass, as a multiple of that of the low pass."""
POSSIBLE = math.log(0.05)
"""ln p above which a condition is clearly not significant, so that the correction for scatter between days is
skipped."""
EDGE_SHARE = 0.05
"""[1] share of the readings at each end of the record in which no change is searched."""
INTERVAL = 4.0
"""Difference in the χ² statistic from which one explanation is clearly better than another (95 %
interval)."""
ORTHOGONAL_ROUNDING = 1e-12
"""Share of a column's square below which its part orthogonal to the nuisance is rounding error."""
NEAR_BINS = 2
"""Bins around a change in which an outlier or a shock may explain it instead."""
SHARP_H = 1.0
"""[h] longest confidence interval of a date for which the date counts as certain."""


@dataclass(frozen=True)
class Whitened:
    """The whitened error of one quantity (n bins), with all nuisance effects removed.

    error: (n,) NaN without a reading.  step_h: [h] length of a bin.  tau_h: [h] time constant of the low
        pass.
    filter_result: the filtered error.  nuisance: (n, q) columns of effects that are already explained.
    basis: (n, q) orthonormal basis of the whitened nuisance.
    innovations: (n,) standardised, orthogonal to the basis; 0 without a reading.
    """

    error: np.ndarray
    step_h: float
    tau_h: float
    filter_result: Filtered
    nuisance: np.ndarray
    basis: np.ndarray
    innovations: np.ndarray

    @classmethod
    def of(cls, error: np.ndarray, step_h: float, tau_h: float) -> Whitened:
        """Whiten an error (n,) under its maximum-likelihood variances; its mean is a nuisance."""
        error = error - np.nanmean(error)
        variance = max(float(np.nanvar(error)), 1e-12)
        time = step_h * np.arange(len(error))
        instants = course(time, tau_h, np.zeros(len(error)), largest=variance)
        filter_result = filtered(instants, maximised(instants, error), error)
        empty = np.empty((len(error), 0))
        return cls(error, step_h, tau_h, filter_result, empty, empty, error)._with(
            error, filter_result.variances, np.ones((len(error), 1))
        )

    def _with(self, error: np.ndarray, variances: np.ndarray, nuisance: np.ndarray) -> Whitened:
        """Return the same object for another error (n,), variances (7,) and nuisance columns (n, q)."""
        filter_result = filtered(self.filter_result.course, variances, error)
        white_nuisance = filter_result.whitened(nuisance)
        root = _root(white_nuisance)
        basis = white_nuisance[:, :0] if root is None else white_nuisance @ root
        innovations = np.nan_to_num(filter_result.standardised)
        return replace(
            self,
            error=error,
            filter_result=filter_result,
            nuisance=nuisance,
            basis=basis,
            innovations=innovations - basis @ (basis.T @ innovations),
        )

    def columns(self, condition: np.ndarray, flow: bool) -> np.ndarray:
        """Return the columns (n, k) by which a condition (n, m) is tested; they have mean 0, unknown values
        count as 0.

        flow: whether to add the condition as a flow: its response in the air, and in a slower mass.
        """
        is_known = np.isfinite(condition)
        values = np.where(is_known, condition, 0.0)
        mean = values.sum(axis=0) / np.maximum(is_known.sum(axis=0), 1)
        centred = np.where(is_known, values - mean, 0.0)
        if not flow:
            return centred
        return np.column_stack([centred, self.low_passed(centred), self.low_passed(centred, SLOWER)])

    def low_passed(self, columns: np.ndarray, slower: float = 1.0) -> np.ndarray:
        """Filter columns (n, k) by the low pass τ dz/dt = −z + column, with τ = `slower` times that of the
        cabinet."""
        from scipy.signal import lfilter

        decay = np.exp(-self.step_h / (slower * self.tau_h))
        return lfilter([1.0 - decay], [1.0, -decay], columns, axis=0)

    def whitened(self, columns: np.ndarray) -> np.ndarray:
        """Whiten columns (n, k) and remove their parts along the nuisance."""
        white = self.filter_result.whitened(columns)
        squares_before = np.einsum("ni,ni->i", white, white)
        white -= self.basis @ (self.basis.T @ white)
        white[:, np.einsum("ni,ni->i", white, white) <= ORTHOGONAL_ROUNDING * squares_before] = 0.0
        return white

    def log_p(self, white: np.ndarray, unbounded: bool = False) -> float:
        """Return ln p of the hypothesis that the error does not depend on a condition.

        white: (n, k) whitened columns of the condition.  unbounded: whether large innovations count in full.
        """
        root = _root(white)
        if root is None:
            return 0.0
        innovations, degrees_of_freedom = (
            self.innovations if unbounded else _clipped(self.innovations),
            root.shape[1],
        )
        statistic = _square(root.T @ (white.T @ innovations))
        if _log_tail(statistic, degrees_of_freedom) > POSSIBLE:
            return _log_tail(statistic, degrees_of_freedom)
        remainder = _clipped(self.innovations - white @ (root @ (root.T @ (white.T @ self.innovations))))
        daily = np.add.reduceat(
            white * remainder[:, None], np.arange(0, len(remainder), round(24.0 / self.step_h))
        )
        return _log_tail(statistic / max(1.0, _square(daily @ root) / degrees_of_freedom), degrees_of_freedom)

    def effect(self, columns: np.ndarray) -> np.ndarray:
        """Return the part (n,) of the error that columns (n, k) explain, by generalised least squares."""
        white = self.whitened(columns)
        root = _root(white)
        if root is None:
            return np.zeros(len(columns))
        return columns @ (root @ (root.T @ (white.T @ self.innovations)))

    def rejudged(self, columns: np.ndarray) -> Whitened:
        """Return this error with the variances estimated without the effect of columns (n, k).

        Otherwise a slow effect would raise the slow variances, which then hide it.
        """
        remainder = self.error - self.effect(columns)
        variances = maximised(self.filter_result.course, remainder, self.filter_result.variances)
        return self._with(self.error, variances, self.nuisance)

    def without(self, columns: np.ndarray, kin: np.ndarray) -> Whitened:
        """Return the error minus the part that columns (n, k) explain.

        These columns and the related columns `kin` (n, c) become nuisance.
        """
        remainder = self.error - self.effect(columns)
        variances = maximised(self.filter_result.course, remainder, self.filter_result.variances)
        return self._with(remainder, variances, np.column_stack([self.nuisance, columns, kin]))

    def change(self) -> tuple[int, bool, int, bool]:
        """Return the likeliest lasting change of the error.

        Returns its first bin, whether a flow changed (else the readings), the number of changes that were
        tried, and whether the date is certain to the hour.

        The adjoint filter gives the scores of all dates in one pass: the score of a change at bin t is the
        sum of the contributions from bin t on.  The information is that of a record without gaps.
        Innovations count without the Huber bound.  Dates are skipped where an outlier, or a shock to the
        process, explains the innovations clearly better.
        """
        from scipy.ndimage import maximum_filter1d
        from scipy.signal import lfilter

        count, decay = len(self.innovations), np.exp(-self.step_h / self.tau_h)
        contributions = np.column_stack(
            [self._adjoint(column) for column in (self.innovations, *self.basis.T)]
        )
        reversed_contributions = contributions[::-1]
        direct_sums = np.cumsum(reversed_contributions, axis=0)
        sums = np.stack(
            [
                direct_sums,
                direct_sums - decay * lfilter([1.0], [1.0, -decay], reversed_contributions, axis=0),
            ],
            axis=1,
        )[::-1]
        read_bins = np.flatnonzero(np.isfinite(self.error))
        margin = round(EDGE_SHARE * len(read_bins))
        dates = read_bins[margin : len(read_bins) - margin]
        first_bin = min(round(EDGE_SHARE * count), int(dates[0]))
        bin_index = np.arange(count)
        step, outlier = (
            (bin_index >= first_bin)[:, None].astype(float),
            (bin_index == first_bin)[:, None].astype(float),
        )
        filter_without_gaps = filtered(
            self.filter_result.course, self.filter_result.variances, np.zeros(count)
        )
        white_columns = filter_without_gaps.whitened(np.column_stack([step, self.low_passed(step), outlier]))[
            first_bin:
        ]
        information = np.cumsum(white_columns[:, :2] ** 2, axis=0)[count - 1 - dates]
        information = information - (sums[dates, :, 1:] ** 2).sum(axis=2)
        positive_information = np.where(information > 0.0, information, np.inf)
        statistic = sums[dates, :, 0] ** 2 / positive_information
        shock = np.maximum(self.innovations**2, contributions[:, 0] ** 2 / _square(white_columns[:, 2]))
        statistic[statistic < maximum_filter1d(shock, 2 * NEAR_BINS + 1)[dates, None] - INTERVAL] = 0.0
        best_row, flow_column = np.unravel_index(np.argmax(statistic), statistic.shape)
        likely_bins = int((statistic[:, flow_column] > statistic[best_row, flow_column] - INTERVAL).sum())
        return int(dates[best_row]), bool(flow_column), statistic.size, likely_bins * self.step_h <= SHARP_H

    def _adjoint(self, white: np.ndarray) -> np.ndarray:
        """Return the contribution (n,) of each reading to the product of two whitened series.

        One of them is `white` (n,); the other is to be multiplied later.
        """
        is_present = np.isfinite(self.filter_result.innovation)
        innovation = np.where(is_present, white * np.sqrt(self.filter_result.variance), np.nan)
        smoothed = replace(
            self.filter_result, innovation=innovation, predicted=np.zeros(len(white))
        ).smoothed()
        noise_variance = self.filter_result.variances[0] * self.filter_result.course.shape
        return np.where(is_present, (innovation - smoothed) / noise_variance, 0.0)


def _square(values: np.ndarray) -> float:
    """Return the sum of squares."""
    return float(np.sum(values**2))


def _clipped(e: np.ndarray) -> np.ndarray:
    """Return innovations limited to the Huber bound."""
    return np.clip(e, -HUBER, HUBER)


def _root(white: np.ndarray) -> np.ndarray | None:
    """Return the matrix R (k, r) for which `white` (n, k) times R has orthonormal columns; None if all
    columns are 0.

    """
    products = white.T @ white
    scale = np.sqrt(np.diag(products))
    is_used = scale > 1e-9 * max(float(scale.max(initial=0.0)), 1e-9)
    if not is_used.any():
        return None
    scale = np.where(is_used, scale, np.inf)
    value, vector = np.linalg.eigh(products / np.outer(scale, scale))
    is_kept = value > 1e-6 * value[-1]
    return vector[:, is_kept] / np.sqrt(value[is_kept]) / scale[:, None]


def _log_tail(value: float, freedom: int) -> float:
    """Return ln of the probability that χ² with `freedom` degrees of freedom exceeds a value."""
    from scipy.special import chdtrc, gammaln

    probability = float(chdtrc(freedom, value))
    if probability > 0.0:
        return math.log(probability)
    return (0.5 * freedom - 1.0) * math.log(0.5 * value) - 0.5 * value - float(gammaln(0.5 * freedom))


def benjamini_hochberg(p: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Return adjusted p (J,): the share of false discoveries among all tests that are at least as
    significant.

    p: (J,) of the tests.
    weights: (J,) chosen beforehand; p is divided by them, after they are scaled to mean 1.
    Valid for independent and for positively dependent tests.  Overlapping conditions share hours, so their
    statistics are positively dependent and need no factor Σ 1/j (Benjamini & Yekutieli 2001,
    doi:10.1214/aos/1013699998).

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
"""[h] length of the shortest bins over which errors are averaged before they are tested."""
FEWEST_H = 72.0
"""[h] fewest hours with errors for which a quantity is tested."""
MATERIAL_SHARE = 0.2
"""[1] smallest size of a finding as a share of the free run's RMSE; smaller ones are not reported, however
significant."""
SENSORS_SHARE = 0.6
"""[1] largest share of a finding's squared size that the sensors' accuracy may explain."""
CERTAIN = 1e-8
"""p above which a calendar condition is tested again, with the error variances estimated without its
effect."""
MOST_FINDINGS = 8
"""Largest number of findings that are reported."""
WHITENED_TOGETHER = 8
"""Number of conditions whose columns are whitened together."""
SEEN = 0.5
"""[1] mean error of an episode, as a share of a finding's size, from which the episode shows the finding."""


@dataclass
class _QuantityErrors:
    """The state of the search for findings in one quantity.

    white: its errors without the findings so far.  conditions: all conditions, a possible step last.
    flow: whether that step is one of a flow, else of the readings.  log_p: (J,) ln p of each condition.
    """

    quantity: Quantity
    rmse: float
    white: Whitened
    conditions: list[Stratum]
    flow: bool = False
    log_p: np.ndarray = field(default_factory=lambda: np.empty(0))

    def columns(self, number: int) -> np.ndarray:
        """Return the columns (n, k) of one condition.

        They are not stored, since those of all conditions would not fit into memory for years of readings.
        """
        condition = self.conditions[number]
        if number < len(self.conditions) - 1:
            return self.white.columns(condition.basis, condition.flow)
        step = self.white.columns(condition.basis, False)
        return self.white.low_passed(step) if self.flow else step


def findings(residuals: Residuals) -> list[Finding]:
    """Return under which conditions the free run errs in the identification period, at most eight, worst
    first.

    Each condition (episodes, regimes, hours since a change, hour, season, level, rate and lag of every
    driver, drift and step, saturation) is tested on the free run's errors.  The most significant condition is
    reported and its effect removed, then all conditions are tested again, so that an effect is reported only
    once.  A finding must be significant (weighted Benjamini–Hochberg: episodes, hour, calendar and drivers
    have equal shares of the level), material (0.2 RMSE) and larger than the sensors' accuracy explains.

    A quantity with errors in fewer than 72 hours has no findings.  Raises KeyError for a quantity without a
    time constant in the residuals.
    """
    binned_residuals = binned(residuals, FINDING_BIN_H)
    common_conditions = conditions(binned_residuals)
    states = []
    for quantity in RESIDUAL_QUANTITIES:
        error = binned_residuals.error[quantity]
        if np.isfinite(error).sum() * binned_residuals.step_h >= FEWEST_H:
            white = Whitened.of(error, binned_residuals.step_h, residuals.time_constants[quantity])
            states.append(_QuantityErrors(quantity, residuals.rmse(quantity), white, common_conditions))
    results: list[Finding] = []
    changed_states = states
    for _ in range(MOST_FINDINGS):
        for state in changed_states:
            _test(state, common_conditions, binned_residuals)
        adjusted = _adjusted(states)
        changed_states = []
        for state, p_adjusted in zip(states, adjusted, strict=True):
            for condition_index in np.argsort(state.log_p, kind="stable"):
                finding = (
                    _described(binned_residuals, state, condition_index, float(p_adjusted[condition_index]))
                    if p_adjusted[condition_index] <= SIGNIFICANCE
                    else None
                )
                if finding is not None:
                    results.append(finding)
                    _remove_effect(state, condition_index)
                    changed_states.append(state)
                    break
        if not changed_states:
            break
    rmse = {state.quantity: state.rmse for state in states}
    results.sort(key=lambda finding: -finding.size / rmse[finding.quantity])
    return results[:MOST_FINDINGS]


def _test(state: _QuantityErrors, common_conditions: Sequence[Stratum], hours: Residuals) -> None:
    """Test every condition and the likeliest step; the result is stored in `state.log_p`."""
    white = state.white
    first_bin, state.flow, number_tried, is_sharp = white.change()
    state.conditions = [*common_conditions, step_at(hours, first_bin, is_sharp)]

    def log_p(errors: Whitened, condition: Stratum, columns: np.ndarray) -> float:
        """Return ln p of a condition; a step's p is multiplied by the number of dates that were tried."""
        if condition.kind != "step":
            return errors.log_p(columns)
        return min(0.0, errors.log_p(columns, unbounded=True) + math.log(number_tried))

    log_p_of: list[float] = []
    for first in range(0, len(state.conditions), WHITENED_TOGETHER):
        conditions_of_batch = state.conditions[first : first + WHITENED_TOGETHER]
        whitened_columns = [state.columns(first + i) for i in range(len(conditions_of_batch))]
        ends = np.cumsum([columns.shape[1] for columns in whitened_columns])[:-1]
        whitened_columns = np.split(white.whitened(np.column_stack(whitened_columns)), ends, axis=1)
        log_p_of += [log_p(white, *pair) for pair in zip(conditions_of_batch, whitened_columns, strict=True)]
    for i, condition in enumerate(state.conditions):
        if condition.group == "calendar" and log_p_of[i] > math.log(CERTAIN):
            retested = white.rejudged(columns := state.columns(i))
            log_p_of[i] = min(log_p_of[i], log_p(retested, condition, retested.whitened(columns)))
    state.log_p = np.array(log_p_of)


def _adjusted(states: Sequence[_QuantityErrors]) -> list[np.ndarray]:
    """Return the adjusted p (J,) of every quantity; groups of conditions have equal shares of the level."""
    if not states:
        return []
    groups = [condition.group for condition in states[0].conditions]
    weights = np.array([1.0 / groups.count(group) for group in groups])
    p = np.exp(np.concatenate([state.log_p for state in states]))
    q = benjamini_hochberg(p, np.tile(weights, len(states)))
    return list(q.reshape(len(states), -1))


def _remove_effect(state: _QuantityErrors, condition_index: int) -> None:
    """Remove the part of the errors that a condition explains.

    The condition's bins and all conditions on the same driver become nuisance.
    """
    condition = state.conditions[condition_index]
    same_driver = [
        state.columns(i)
        for i, other in enumerate(state.conditions)
        if other.driver and other.driver == condition.driver
    ]
    bin_columns = state.white.columns(dummies(condition.bins), False)
    state.white = state.white.without(
        state.columns(condition_index), np.column_stack([bin_columns, *same_driver])
    )


def _described(hours: Residuals, state: _QuantityErrors, number: int, p_adjusted: float) -> Finding | None:
    """Return the finding for one condition; None if it is immaterial or the free run does not show it.

    An effect is dropped if removing it would not lower the squared error of the free run: the model then
    compensates for it on average.
    """
    condition, error = state.conditions[number], state.white.error
    is_known = np.isfinite(error)
    effect = np.where(is_known, state.white.effect(state.columns(number)), np.nan)
    centred_effect = effect[is_known] - effect[is_known].mean()
    if 2.0 * centred_effect @ error[is_known] <= centred_effect @ centred_effect:
        return None
    first, last = condition.worst(effect)
    inside = condition.inside(first, last)
    known_inside, known_outside = is_known & inside, is_known & ~inside & (condition.bins >= 0)
    if not (known_inside.any() and known_outside.any()):
        return None
    size = float(effect[known_inside].mean() - effect[known_outside].mean())
    sensor_error = float(np.nan_to_num(root_mean_square(hours.sensor_error[state.quantity][inside])))
    sensor_share = min(1.0, (sensor_error / size) ** 2) if size else 1.0
    if abs(size) < MATERIAL_SHARE * state.rmse or sensor_share > SENSORS_SHARE:
        return None
    deviation = np.sign(size) * (error - error[known_outside].mean())
    episodes = [
        (begin, end)
        for begin, end in run_lengths(closed(inside, hours.step_h))
        if known_inside[begin:end].any()
    ]
    means = np.array([float(deviation[begin:end][known_inside[begin:end]].mean()) for begin, end in episodes])
    duration = duration_h(deviation, episodes, hours.step_h) if condition.kind == "episode" else math.nan
    half_step_s = 1800.0 * hours.step_h
    return Finding(
        state.quantity, condition.kind, condition.driver, condition.phrase(first, last),
        "low" if size > 0 else "high", duration if duration > 0 else math.nan,
        abs(size), int((means >= SEEN * abs(size)).sum()), len(episodes), sensor_share, p_adjusted,
        tuple(
            (float(hours.time_s[begin] - half_step_s), float(hours.time_s[end - 1] + half_step_s))
            for begin, end in (episodes[i] for i in np.argsort(-means, kind="stable"))
        ),
    )  # fmt: skip
