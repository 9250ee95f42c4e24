"""The errors of a simulation: where, when and by how much; worst first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hygrokf.discovery.conditions import Stratum, conditions, dummies, step_at
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
from hygrokf.discovery.results import Finding
from hygrokf.discovery.significance import Whitened, benjamini_hochberg

LEVEL = 0.05
BIN_H = 0.25
"""[h] shortest bins in which the errors are tested."""
FEWEST_H = 72.0
"""[h] with an error below which there is nothing to analyse."""
MATERIAL = 0.2
"""[1] share of the free run's RMSE below which a finding is immaterial, however significant."""
SENSORS = 0.6
"""[1] share of a finding's square that the sensors may explain; beyond it the error is theirs."""
CERTAIN = 1e-8
"""p above which a slow condition is tested again under variances without its own effect."""
MOST = 8
"""Findings that are reported."""
BATCH = 8
"""Conditions whose columns are whitened together."""
SEEN = 0.5
"""[1] share of its size by which a finding counts as seen in an episode."""


@dataclass
class _QuantityErrors:
    """The errors of one quantity beside the findings so far; ln p of each condition, of which the last is a
    step, that of a flow or of the readings."""

    quantity: Quantity
    rmse: float
    white: Whitened
    conditions: list[Stratum]
    flow: bool = False
    log_p: np.ndarray = field(default_factory=lambda: np.empty(0))

    def columns(self, number: int) -> np.ndarray:
        """(n, k) of a condition; all at once would fill the memory with years of readings."""
        one = self.conditions[number]
        if number < len(self.conditions) - 1:
            return self.white.columns(one.basis, one.flow)
        step = self.white.columns(one.basis, False)
        return self.white.low_passed(step) if self.flow else step


def findings(residuals: Residuals) -> list[Finding]:
    """The errors of the free run in the identification period, worst (in units of its RMSE) first, at most
    eight.

    Each condition (episodes, regimes, hours since a change, hour, season, level, rate and lag of every
    driver, drift and step, saturation) is tested on the free run's errors.  The surest is described and taken
    out of the errors, then all are tested again: an effect that one condition explains is not reported under
    another.  A finding must be significant (weighted Benjamini–Hochberg: episodes, hour, calendar and drivers
    have equal shares of the level), material (0.2 RMSE) and more than the sensors' accuracy explains.

    A quantity with errors in fewer than 72 hours has no findings.  Raises KeyError for one whose time
    constant the residuals do not hold.
    """
    hours = binned(residuals, BIN_H)
    known = conditions(hours)
    states = []
    for quantity in QUANTITIES:
        error = hours.error[quantity]
        if np.isfinite(error).sum() * hours.step_h >= FEWEST_H:
            white = Whitened.of(error, hours.step_h, residuals.time_constants[quantity])
            states.append(_QuantityErrors(quantity, residuals.rmse(quantity), white, known))
    found: list[Finding] = []
    changed = states
    for _ in range(MOST):
        for state in changed:
            _test(state, known, hours)
        adjusted = _adjusted(states)
        changed = []
        for state, q in zip(states, adjusted, strict=True):
            for number in np.argsort(state.log_p, kind="stable"):
                one = _described(hours, state, number, float(q[number])) if q[number] <= LEVEL else None
                if one is not None:
                    found.append(one)
                    _take_out(state, number)
                    changed.append(state)
                    break
        if not changed:
            break
    rmse = {state.quantity: state.rmse for state in states}
    found.sort(key=lambda one: -one.size / rmse[one.quantity])
    return found[:MOST]


def _test(state: _QuantityErrors, known: Sequence[Stratum], hours: Residuals) -> None:
    """ln p of every condition, and of the likeliest step."""
    white = state.white
    first_bin, state.flow, tried, sharp = white.change()
    state.conditions = [*known, step_at(hours, first_bin, sharp)]

    def log_p(under: Whitened, one: Stratum, table: np.ndarray) -> float:
        if one.kind != "step":
            return under.log_p(table)
        return min(0.0, under.log_p(table, full=True) + math.log(tried))

    found: list[float] = []
    for first in range(0, len(state.conditions), BATCH):
        some = state.conditions[first : first + BATCH]
        tables = [state.columns(first + i) for i in range(len(some))]
        ends = np.cumsum([one.shape[1] for one in tables])[:-1]
        tables = np.split(white.whitened(np.column_stack(tables)), ends, axis=1)
        found += [log_p(white, *pair) for pair in zip(some, tables, strict=True)]
    for i, one in enumerate(state.conditions):
        if one.group == "calendar" and found[i] > math.log(CERTAIN):
            again = white.rejudged(columns := state.columns(i))
            found[i] = min(found[i], log_p(again, one, again.whitened(columns)))
    state.log_p = np.array(found)


def _adjusted(states: Sequence[_QuantityErrors]) -> list[np.ndarray]:
    """q (J,) of every quantity; groups of conditions have equal shares of the level."""
    if not states:
        return []
    groups = [one.group for one in states[0].conditions]
    weights = np.array([1.0 / groups.count(group) for group in groups])
    p = np.exp(np.concatenate([one.log_p for one in states]))
    q = benjamini_hochberg(p, np.tile(weights, len(states)))
    return list(q.reshape(len(states), -1))


def _take_out(state: _QuantityErrors, number: int) -> None:
    """What the condition explains; its bins, and all on the same driver, are tested no more."""
    condition = state.conditions[number]
    kin = [
        state.columns(i)
        for i, one in enumerate(state.conditions)
        if one.driver and one.driver == condition.driver
    ]
    bins = state.white.columns(dummies(condition.bins), False)
    state.white = state.white.without(state.columns(number), np.column_stack([bins, *kin]))


def _described(hours: Residuals, state: _QuantityErrors, number: int, q: float) -> Finding | None:
    """The finding; None where it is immaterial, or where the free run does not show it.

    Innovations see what is fast.  An effect whose removal would not lower the squared error of the free run
    is none of it: the model makes up for it in the mean.
    """
    condition, error = state.conditions[number], state.white.error
    known = np.isfinite(error)
    effect = np.where(known, state.white.effect(state.columns(number)), np.nan)
    course = effect[known] - effect[known].mean()
    if 2.0 * course @ error[known] <= course @ course:
        return None
    first, last = condition.worst(effect)
    inside = condition.inside(first, last)
    under, rest = known & inside, known & ~inside & (condition.bins >= 0)
    if not (under.any() and rest.any()):
        return None
    size = float(effect[under].mean() - effect[rest].mean())
    sensors = float(np.nan_to_num(root_mean_square(hours.sensor_error[state.quantity][inside])))
    share = min(1.0, (sensors / size) ** 2) if size else 1.0
    if abs(size) < MATERIAL * state.rmse or share > SENSORS:
        return None
    beside = np.sign(size) * (error - error[rest].mean())
    episodes = [(a, b) for a, b in run_lengths(closed(inside, hours.step_h)) if under[a:b].any()]
    means = np.array([float(beside[a:b][under[a:b]].mean()) for a, b in episodes])
    duration = duration_h(beside, episodes, hours.step_h) if condition.kind == "episode" else math.nan
    half = 1800.0 * hours.step_h
    return Finding(
        state.quantity, condition.kind, condition.driver, condition.phrase(first, last),
        "low" if size > 0 else "high", duration if duration > 0 else math.nan,
        abs(size), int((means >= SEEN * abs(size)).sum()), len(episodes), share, q,
        tuple(
            (float(hours.time_s[a] - half), float(hours.time_s[b - 1] + half))
            for a, b in (episodes[i] for i in np.argsort(-means, kind="stable"))
        ),
    )  # fmt: skip
