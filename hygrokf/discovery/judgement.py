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
"""Parameters that set the levels of a simulation."""
HORIZONS_H = (3.0, 12.0, 48.0)
BETTER_Z = 2.0
"""Standard errors by which errors must fall to count as a gain."""
WORSE_GROWTH = 0.1
"""Mean growth of ln squared error above which a cause is refuted."""
LEAST_IMPROVEMENT = 0.02
"""Share by which a cause must lower the free-run error of a quantity, with levels at their least squares;
otherwise a remark says so, or weak evidence is unproven."""
NOTICED = 1.0
"""Squared whitened difference of two simulations below which held-out readings cannot distinguish them."""
OLDEST = 1.5
"""Largest time from the start of a forecast to its reading: this many horizons plus half an hour."""


@dataclass(frozen=True)
class Scores:
    """Scores of a quantity on held-out readings.

    squares: (T, 4) squared errors of forecasts over 3, 12 and 48 h and of the free run, NaN outside of the
    held-out readings; deviance: −2 ln L of the held-out readings; simulated: (T,) free run; run: the filter
    over all readings; held_out: (T,).
    """

    squares: np.ndarray
    day: np.ndarray
    deviance: float
    simulated: np.ndarray
    run: Filtered
    held_out: np.ndarray


def levelled(estimate: Calibration) -> Calibration:
    """The estimate with the `LEVEL_PARAMETERS` of the least free-run error in the identification period.

    The variances are maximised again: part of the slow disturbance may have been the error of a level.
    """
    names = set(LEVEL_PARAMETERS) & set(estimate.simulator.names)
    plain = fitted(with_variances(replace(estimate, plain=True)), names, (4, 0.1))
    return with_variances(replace(plain, plain=False, variances=estimate.variances))


def scores(estimate: Calibration) -> dict[str, Scores]:
    """The scores of an estimate by quantity."""
    scores_of = {}
    for q in estimate.quantities:
        r = estimate.simulator.scene.readings[q]
        error = r.value - estimate.simulated[q]
        run = filtered(estimate.errors[q], estimate.variances[q], error)
        read = np.flatnonzero(np.isfinite(error))
        time_h = r.time_h[read]
        squares = np.full((len(error), len(HORIZONS_H) + 1), np.nan)
        for c, horizon in enumerate(HORIZONS_H):
            last = np.searchsorted(time_h, time_h - horizon + 1e-6, side="right") - 1
            has_origin = (last >= 0) & (time_h - time_h[np.maximum(last, 0)] <= OLDEST * horizon + 0.5)
            if not has_origin.any():
                continue
            target, origin = read[has_origin], read[last[has_origin]]
            lead = np.round(r.time_h[target] - r.time_h[origin], 4)
            leads, lead_index = np.unique(lead, return_inverse=True)
            weights = forecast_weights(estimate.errors[q], leads)[lead_index.reshape(-1)]
            squares[target, c] = (error[target] - (weights * run.state[origin]).sum(axis=1)) ** 2
        squares[:, -1] = error**2
        squares[r.identified] = np.nan
        innovation = run.standardised
        is_held_out = np.isfinite(innovation) & ~r.identified
        deviance = float((np.log(run.variance[is_held_out]) + loss(innovation[is_held_out], HUBER)).sum())
        scores_of[q] = Scores(squares, r.day, deviance, estimate.simulated[q], run, is_held_out)
    return scores_of


def difference(first: Mapping[str, Scores], other: Mapping[str, Scores]) -> dict[str, np.ndarray]:
    """(T,) squared whitened difference of two simulations, by quantity: the expected gain in −2 ln L of
    `other` over the first simulation if `other` is right."""
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
    for q, old in parent.items():
        if differences[q][child[q].held_out].sum() < NOTICED:
            continue
        new = child[q]
        in_both = np.isfinite(old.squares) & np.isfinite(new.squares)
        if not in_both.any():
            continue
        # a short record has no errors at the longer horizons
        has_horizon = in_both.any(axis=0)
        in_both = in_both[:, has_horizon]
        old_squares, new_squares = (np.where(in_both, s.squares[:, has_horizon], np.nan) for s in (old, new))
        mean = np.nanmean(old_squares, axis=0)
        ratio = np.nanmean(new_squares, axis=0) / mean
        growth[q] = float(np.nanmean(np.log(np.maximum(ratio, 1e-12))))
        before[q], after[q] = (float(math.sqrt(np.nanmean(s[:, -1]))) for s in (old_squares, new_squares))
        change = np.nansum((new_squares - old_squares)[:, :-1] / mean[:-1], axis=1)
        with_free_run = in_both[:, -1]
        days = np.unique(old.day[with_free_run])
        day_count = max(day_count, len(days))
        daily = np.array([change[with_free_run & (old.day == d)].mean() for d in days])
        spread = daily.std(ddof=1) / math.sqrt(len(daily)) if len(daily) > 1 else math.inf
        z[q] = float(daily.mean() / spread) if spread > 0 else 0.0
    gain = sum(parent[q].deviance - child[q].deviance for q in parent)
    test = HeldOutTest(z, growth, before, after, gain, day_count)
    cost = max(0.0, -gain) / factor + sum(max(0.0, v) ** 2 for v in z.values())
    if any(v > WORSE_GROWTH for v in growth.values()):
        return replace(test, reason="worse")
    if z and not any(v <= -BETTER_Z for v in z.values()) and cost > spare:
        return replace(test, reason="no_gain")
    held_out = any(old.held_out.any() for old in parent.values())
    if weak and held_out and test.improvement < LEAST_IMPROVEMENT:
        return replace(test, reason="unproven")
    return test
