"""Findings: under which conditions a simulation errs, in which direction and by how much, worst first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hygrokf.discovery.conditions import Stratum, conditions, dummies, step_at
from hygrokf.discovery.discovery_results import Finding
from hygrokf.discovery.residuals import (
    QUANTITIES,
    Quantity,
    Residuals,
    binned,
    closed,
    duration_h,
    root_mean_square,
    run_lengths,
)
from hygrokf.discovery.significance import Whitened, benjamini_hochberg

LEVEL = 0.05
BIN_H = 0.25
"""[h] shortest bins in which the errors are tested."""
FEWEST_H = 72.0
"""[h] fewest hours with an error for an analysis."""
MATERIAL = 0.2
"""[1] share of the free run's RMSE below which a finding is immaterial, however significant."""
SENSORS = 0.6
"""[1] largest share of a finding's square that the sensors' accuracy may explain."""
CERTAIN = 1e-8
"""p above which a slow condition is tested again under variances of the error without its effect."""
MOST = 8
"""Findings that are reported."""
BATCH = 8
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
    bins = binned(residuals, BIN_H)
    common_conditions = conditions(bins)
    states = []
    for quantity in QUANTITIES:
        error = bins.error[quantity]
        if np.isfinite(error).sum() * bins.step_h >= FEWEST_H:
            white = Whitened.of(error, bins.step_h, residuals.time_constants[quantity])
            states.append(_QuantityErrors(quantity, residuals.rmse(quantity), white, common_conditions))
    results: list[Finding] = []
    changed_states = states
    for _ in range(MOST):
        for state in changed_states:
            _test(state, common_conditions, bins)
        adjusted = _adjusted(states)
        changed_states = []
        for state, q in zip(states, adjusted, strict=True):
            for number in np.argsort(state.log_p, kind="stable"):
                finding = _described(bins, state, number, float(q[number])) if q[number] <= LEVEL else None
                if finding is not None:
                    results.append(finding)
                    _remove_effect(state, number)
                    changed_states.append(state)
                    break
        if not changed_states:
            break
    rmse = {state.quantity: state.rmse for state in states}
    results.sort(key=lambda finding: -finding.size / rmse[finding.quantity])
    return results[:MOST]


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
    for first in range(0, len(state.conditions), BATCH):
        batch = state.conditions[first : first + BATCH]
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
    if abs(size) < MATERIAL * state.rmse or sensor_share > SENSORS:
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
