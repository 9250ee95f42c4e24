"""The test of a candidate on held-out readings: forecast errors and free-run errors by days, by quantity."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.discovery.discovery_results import HeldOutTest
from hygrokf.discovery.error_model import HUBER, Filtered, filtered, forecast_weights, loss
from hygrokf.discovery.estimate import Calibration, fitted, with_variances

LEVEL_PARAMETERS = (
    "heat_release_operation", "heat_release_standstill", "heat_release_operation_ambient",
    "heat_release_standstill_ambient", "cabinet_temperature_bias", "cabinet_relative_humidity_bias",
    "breathed_offset", "breathed_humidity_offset",
)  # fmt: skip
"""Parameters that set the mean level of a simulation."""
HORIZONS_H = (3.0, 12.0, 48.0)
BETTER_Z = 2.0
"""Standard errors by which held-out errors must fall to count as a gain."""
WORSE_GROWTH = 0.1
"""Mean growth of ln squared error above which a cause is refuted."""
LEAST_IMPROVEMENT = 0.02
"""Share by which a cause must lower the free-run error of a quantity, with levels fitted; with less a remark
says so, and weak evidence counts as unproven."""
NOTICED = 1.0
"""Squared whitened difference of two simulations below which held-out readings cannot tell them apart."""
OLDEST = 1.5
"""A forecast's reading lies at most this many horizons, plus half an hour, after its start."""


@dataclass(frozen=True)
class Scores:
    """Errors of one quantity on held-out readings.

    squares: (T, 4) squared errors of the forecasts over 3, 12 and 48 h and of the free run; NaN outside of
        the held-out readings.  day: (T,) day number.
    deviance: −2 ln L of the held-out readings.  simulated: (T,) free run.
    run: the filter over all readings.  held_out: (T,) whether a reading is held out.
    """

    squares: np.ndarray
    day: np.ndarray
    deviance: float
    simulated: np.ndarray
    run: Filtered
    held_out: np.ndarray


def levelled(estimate: Calibration) -> Calibration:
    """Return the estimate with its level parameters refitted to the smallest free-run error.

    The error variances are estimated again: they may have absorbed the error of a level.
    """
    names = set(LEVEL_PARAMETERS) & set(estimate.simulator.names)
    plain = fitted(with_variances(replace(estimate, plain=True)), names, (4, 0.1))
    return with_variances(replace(plain, plain=False, variances=estimate.variances))


def scores(estimate: Calibration) -> dict[str, Scores]:
    """Return the errors of an estimate on held-out readings, by quantity."""
    scores_of = {}
    for q in estimate.quantities:
        readings = estimate.simulator.scene.readings[q]
        residual = readings.value - estimate.simulated[q]
        run = filtered(estimate.errors[q], estimate.variances[q], residual)
        read_indices = np.flatnonzero(np.isfinite(residual))
        time_h = readings.time_h[read_indices]
        squared_errors = np.full((len(residual), len(HORIZONS_H) + 1), np.nan)
        for column, horizon in enumerate(HORIZONS_H):
            last_origin = np.searchsorted(time_h, time_h - horizon + 1e-6, side="right") - 1
            has_origin = (last_origin >= 0) & (
                time_h - time_h[np.maximum(last_origin, 0)] <= OLDEST * horizon + 0.5
            )
            if not has_origin.any():
                continue
            target, origin = read_indices[has_origin], read_indices[last_origin[has_origin]]
            lead_h = np.round(readings.time_h[target] - readings.time_h[origin], 4)
            distinct_leads_h, lead_index = np.unique(lead_h, return_inverse=True)
            weights = forecast_weights(estimate.errors[q], distinct_leads_h)[lead_index.reshape(-1)]
            squared_errors[target, column] = (
                residual[target] - (weights * run.state[origin]).sum(axis=1)
            ) ** 2
        squared_errors[:, -1] = residual**2
        squared_errors[readings.identified] = np.nan
        innovation = run.standardised
        is_held_out = np.isfinite(innovation) & ~readings.identified
        deviance = float((np.log(run.variance[is_held_out]) + loss(innovation[is_held_out], HUBER)).sum())
        scores_of[q] = Scores(squared_errors, readings.day, deviance, estimate.simulated[q], run, is_held_out)
    return scores_of


def difference(first: Mapping[str, Scores], other: Mapping[str, Scores]) -> dict[str, np.ndarray]:
    """Return (T,) the squared whitened difference of two simulations, by quantity.

    Its sum is the expected gain in −2 ln L of `other` over `first` if `other` is right.
    """
    squares = {}
    for q, reference in first.items():
        white = reference.run.whitened((other[q].simulated - reference.simulated)[:, None])[:, 0]
        squares[q] = np.nan_to_num(white**2 * reference.run.weight)
    return squares


def judged(
    parent: Mapping[str, Scores],
    child: Mapping[str, Scores],
    spare: float = 0.0,
    factor: float = 1.0,
    weak: bool = False,
) -> HeldOutTest:
    """Compare a child with its parent on held-out readings.

    spare: the child's evidence in days minus that which acceptance needs; factor: its evidence divided by its
    evidence in days; weak: whether the misfit of another cause could explain the evidence.

    Reasons to refute the child.  "worse": ln of a quantity's squared errors grows by more than `WORSE_GROWTH`
    on average.  "no_gain": no quantity's errors fall by `BETTER_Z` standard errors, and the loss in 2 ln L
    divided by `factor`, plus z² of each quantity whose errors rise, exceeds `spare`.  "unproven": a child
    with weak evidence lowers no free-run error by `LEAST_IMPROVEMENT`.
    """
    z, growth, before, after, day_count = {}, {}, {}, {}, 0
    differences = difference(parent, child)
    for q, parent_scores in parent.items():
        if differences[q][child[q].held_out].sum() < NOTICED:
            continue
        child_scores = child[q]
        in_both = np.isfinite(parent_scores.squares) & np.isfinite(child_scores.squares)
        if not in_both.any():
            continue
        # a short record has no errors at the longer horizons
        has_horizon = in_both.any(axis=0)
        in_both = in_both[:, has_horizon]
        parent_squares, child_squares = (
            np.where(in_both, squares_of.squares[:, has_horizon], np.nan)
            for squares_of in (parent_scores, child_scores)
        )
        mean = np.nanmean(parent_squares, axis=0)
        ratio = np.nanmean(child_squares, axis=0) / mean
        growth[q] = float(np.nanmean(np.log(np.maximum(ratio, 1e-12))))
        before[q], after[q] = (
            float(math.sqrt(np.nanmean(squares_of[:, -1]))) for squares_of in (parent_squares, child_squares)
        )
        change = np.nansum((child_squares - parent_squares)[:, :-1] / mean[:-1], axis=1)
        with_free_run = in_both[:, -1]
        days = np.unique(parent_scores.day[with_free_run])
        day_count = max(day_count, len(days))
        daily_change = np.array([change[with_free_run & (parent_scores.day == day)].mean() for day in days])
        standard_error = (
            daily_change.std(ddof=1) / math.sqrt(len(daily_change)) if len(daily_change) > 1 else math.inf
        )
        z[q] = float(daily_change.mean() / standard_error) if standard_error > 0 else 0.0
    gain = sum(parent[q].deviance - child[q].deviance for q in parent)
    result = HeldOutTest(z, growth, before, after, gain, day_count)
    cost = max(0.0, -gain) / factor + sum(max(0.0, value) ** 2 for value in z.values())
    if any(value > WORSE_GROWTH for value in growth.values()):
        return replace(result, reason="worse")
    if z and not any(value <= -BETTER_Z for value in z.values()) and cost > spare:
        return replace(result, reason="no_gain")
    held_out = any(parent_scores.held_out.any() for parent_scores in parent.values())
    if weak and held_out and result.improvement < LEAST_IMPROVEMENT:
        return replace(result, reason="unproven")
    return result
