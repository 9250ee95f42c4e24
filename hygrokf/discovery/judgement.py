"""What the held-out readings say of a candidate: errors ahead and by days, of both quantities."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.discovery.error_model import HUBER, Filtered, ahead, filtered, loss
from hygrokf.discovery.estimate import Calibration, fitted, with_variances
from hygrokf.discovery.results import HeldOutTest

LEVELS = (
    "heat_release_operation", "heat_release_standstill", "heat_release_operation_ambient",
    "heat_release_standstill_ambient", "cabinet_temperature_bias", "cabinet_relative_humidity_bias",
    "breathed_offset", "breathed_humidity_offset",
)  # fmt: skip
"""Parameters that are the slow part of a simulation."""
HORIZONS_H = (3.0, 12.0, 48.0)
BETTER_Z = 2.0
WORSE_GROWTH = 0.1
LEAST_IMPROVEMENT = 0.02
"""Share by which a cause must lower a levelled free-run error, else it is marked, or unproven."""
NOTICED = 1.0
"""Squared whitened difference of two simulations below which held-out readings do not tell them apart."""
OLDEST = 1.5
"""A forecast starts no earlier than this many horizons, and half an hour, before its reading."""


@dataclass(frozen=True)
class Scores:
    """Squared errors (T, 4) of a quantity on held-out readings, NaN elsewhere: 3, 12 and 48 h ahead, and of
    the free run; deviance: −2 ln L of these readings; simulated (T,) by the filter `run`."""

    squares: np.ndarray
    day: np.ndarray
    deviance: float
    simulated: np.ndarray
    run: Filtered
    held_out: np.ndarray


def levelled(one: Calibration) -> Calibration:
    """The estimate whose levels are those of the least free-run error in the identification period.

    What a slow disturbance seemed to be beside a wrong level is none: the variances follow.
    """
    names = set(LEVELS) & set(one.simulator.names)
    plain = fitted(with_variances(replace(one, plain=True)), names, (4, 0.1))
    return with_variances(replace(plain, plain=False, variances=one.variances))


def scores(one: Calibration) -> dict[str, Scores]:
    found = {}
    for q in one.quantities:
        r = one.simulator.scene.readings[q]
        error = r.value - one.simulated[q]
        run = filtered(one.errors[q], one.variances[q], error)
        known = np.flatnonzero(np.isfinite(error))
        time = r.time_h[known]
        squares = np.full((len(error), len(HORIZONS_H) + 1), np.nan)
        for c, horizon in enumerate(HORIZONS_H):
            last = np.searchsorted(time, time - horizon + 1e-6, side="right") - 1
            fine = (last >= 0) & (time - time[np.maximum(last, 0)] <= OLDEST * horizon + 0.5)
            if not fine.any():
                continue
            at, from_ = known[fine], known[last[fine]]
            lead = np.round(r.time_h[at] - r.time_h[from_], 4)
            leads, which = np.unique(lead, return_inverse=True)
            weights = ahead(one.errors[q], leads)[which.reshape(-1)]
            squares[at, c] = (error[at] - (weights * run.state[from_]).sum(axis=1)) ** 2
        squares[:, -1] = error**2
        squares[r.identified] = np.nan
        e = run.standardised
        held = np.isfinite(e) & ~r.identified
        deviance = float((np.log(run.variance[held]) + loss(e[held], HUBER)).sum())
        found[q] = Scores(squares, r.day, deviance, one.simulated[q], run, held)
    return found


def difference(one: Mapping[str, Scores], other: Mapping[str, Scores]) -> dict[str, np.ndarray]:
    """(T,) by quantity, the square of the whitened difference of two simulations: what −2 ln L gains by it on
    average where the one that differs is right."""
    found = {}
    for q, known in one.items():
        white = known.run.whitened((other[q].simulated - known.simulated)[:, None])[:, 0]
        found[q] = np.nan_to_num(white**2 * known.run.weight)
    return found


def judged(
    parent: Mapping[str, Scores],
    child: Mapping[str, Scores],
    spare: float = 0.0,
    factor: float = 1.0,
    weak: bool = False,
) -> HeldOutTest:
    """Compare a child with its parent on held-out readings.

    spare: the child's evidence in days beyond what acceptance needs; factor: its evidence over that in days;
    weak: whether it is less than a neighbour's misfit may have.

    "worse": ln of a quantity's squared errors grows by more than `WORSE_GROWTH` on average.  "no_gain": no
    quantity's errors fall by `BETTER_Z` standard errors, and the loss in 2 ln L, over `factor`, plus z² of
    each quantity whose errors rise exceeds `spare`.  "unproven": a weak one lowers no free-run error by
    `LEAST_IMPROVEMENT`.
    """
    z, growth, before, after, number = {}, {}, {}, {}, 0
    moved = difference(parent, child)
    for q, old in parent.items():
        if moved[q][child[q].held_out].sum() < NOTICED:
            continue
        new = child[q]
        both = np.isfinite(old.squares) & np.isfinite(new.squares)
        if not both.any():
            continue
        # a short record has no errors at the longer horizons
        some = both.any(axis=0)
        both = both[:, some]
        o, n = (np.where(both, s.squares[:, some], np.nan) for s in (old, new))
        mean = np.nanmean(o, axis=0)
        ratio = np.nanmean(n, axis=0) / mean
        growth[q] = float(np.nanmean(np.log(np.maximum(ratio, 1e-12))))
        before[q], after[q] = (float(math.sqrt(np.nanmean(s[:, -1]))) for s in (o, n))
        change = np.nansum((n - o)[:, :-1] / mean[:-1], axis=1)
        there = both[:, -1]
        days = np.unique(old.day[there])
        number = max(number, len(days))
        daily = np.array([change[there & (old.day == d)].mean() for d in days])
        spread = daily.std(ddof=1) / math.sqrt(len(daily)) if len(daily) > 1 else math.inf
        z[q] = float(daily.mean() / spread) if spread > 0 else 0.0
    gain = sum(parent[q].deviance - child[q].deviance for q in parent)
    test = HeldOutTest(z, growth, before, after, gain, number)
    taken = max(0.0, -gain) / factor + sum(max(0.0, v) ** 2 for v in z.values())
    if any(v > WORSE_GROWTH for v in growth.values()):
        return replace(test, reason="worse")
    if z and not any(v <= -BETTER_Z for v in z.values()) and taken > spare:
        return replace(test, reason="no_gain")
    held_out = any(old.held_out.any() for old in parent.values())
    if weak and held_out and test.improvement < LEAST_IMPROVEMENT:
        return replace(test, reason="unproven")
    return test
