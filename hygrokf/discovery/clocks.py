"""Which shift of a source's clock the innovations ask for.

Shapes: S shifts, N readings, d parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hygrokf.data.clocks import Shift, shifted, sources
from hygrokf.data.record import Record
from hygrokf.data.timestamps import HOUR_S
from hygrokf.discovery.baseline import Baseline, refitted
from hygrokf.discovery.scan import standardised
from hygrokf.discovery.submodel import Submodel, search_likelihood, seconds
from hygrokf.engine.timeline import Timeline
from hygrokf.modelling.inputs import prepare_run

SHIFTS_MIN = (-60.0, -30.0, -10.0, 10.0, 30.0, 60.0)
"""[min] shifts of the coarse grid."""
REFINEMENTS = 2
"""Passes that narrow a shift down from the coarse grid by score statistics, each to about half the
spacing."""
REACH_S = (480.0, 160.0, 50.0)
"""[s] how far around a shift the next one is looked for, all parameters estimated again before each."""
LEAST_S = 15.0
"""[s] by which a shift is moved at least."""
SMALLEST_SHIFT_S = 240.0
"""[s] below this a clock error is ordinary."""
OF_INTERVAL = 0.6
"""The same as a share of the interval over which a source takes means."""


def ordinary_shift(record: Record, source: str) -> float:
    """Largest error [s] of a source's clock that is ordinary, or not the clock's.

    With interval means, the place of the stamp in the interval and heat that takes some minutes to reach the
    sensor look like a shift of a little over half the interval.
    """
    intervals = [record[name].interval_s for name in sources(record).get(source, ())]
    return max([SMALLEST_SHIFT_S, *(OF_INTERVAL * one for one in intervals)])


# -- the shift that a baseline asks for ----------------------------------------------------------------------
def best_shift(baseline: Baseline, shift: Shift) -> tuple[float, dict[str, Submodel]]:
    """(seconds, the submodels estimated with them) of the shift of a source that gains most; 0 and none where
    no shift gains.

    shift: the source, and whether the shift is confined to summer time: then it is an hour either way.
    """
    if shift.summer:
        hours = [replace(shift, seconds=s) for s in (HOUR_S, -HOUR_S)]
        best = max(hours, key=lambda one: _unestimated(baseline, one))
        return best.seconds, _refitted(baseline, best)
    coarse = _coarse(baseline, shift.source)
    return _climbed(baseline, shift.source, coarse) if coarse != 0.0 else (0.0, {})


def _refitted(
    baseline: Baseline, shift: Shift, near: Mapping[str, Submodel] | None = None
) -> dict[str, Submodel]:
    """The submodels estimated with a shift, from the baseline's values or from those of a shift nearby."""
    found = {}
    for name, submodel in baseline.submodels.items():
        begin = submodel if near is None else replace(submodel, values=near[name].values)
        record = shifted(submodel.record, shift)
        found[name] = refitted(begin, (), {}, ({},), record, baseline.budget)
    return found


def _unestimated(baseline: Baseline, shift: Shift) -> float:
    """ln L with a shift at the baseline's own values."""
    found = 0.0
    for submodel in baseline.submodels.values():
        moved = prepare_run(submodel.base, shifted(submodel.record, shift)).timeline
        found += search_likelihood(submodel.base.model, moved).value(submodel.values)
    return found


def _coarse(baseline: Baseline, source: str) -> float:
    """The shift [s] for which the score statistics are largest, 0 where none gains."""
    grid, gains = np.zeros(1), np.zeros(1)
    more = np.array(SHIFTS_MIN) * 60.0
    for step in range(REFINEMENTS + 1):
        if step:
            best = int(np.argmax(gains))
            low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
            more = np.setdiff1d(np.linspace(low, high, 5)[1:-1], grid)
            if not len(more):
                break
        grid = np.append(grid, more)
        gains = np.append(gains, _gains(baseline.submodels, source, more))
        order = np.argsort(grid)
        grid, gains = grid[order], gains[order]
    return float(grid[int(np.argmax(gains))])


def _climbed(baseline: Baseline, source: str, coarse: float) -> tuple[float, dict[str, Submodel]]:
    """The shift of the largest likelihood near a coarse one, and the submodels estimated with it.

    First-order statistics are minutes wrong for a clock that is off by many minutes, so they are taken again
    where the last ones led.
    """
    best, submodels = coarse, _refitted(baseline, Shift(source, coarse))
    for reach in REACH_S:
        delta = _summit(submodels, source, reach * np.array([-1.0, -0.5, 0.5, 1.0]))
        if abs(delta) < LEAST_S:
            continue
        moved = _refitted(baseline, Shift(source, best + delta), submodels)
        if _objective(moved) > _objective(submodels):
            best, submodels = best + delta, moved
    return best, submodels


def _summit(submodels: Mapping[str, Submodel], source: str, shifts: np.ndarray) -> float:
    """The further shift [s] at the top of the parabola through the largest of the gains and its
    neighbours."""
    gains = _gains(submodels, source, shifts)
    x, y = np.insert(shifts, 2, 0.0), np.insert(gains, 2, 0.0)
    place = int(np.clip(np.argmax(y), 1, len(x) - 2))
    a, b, _ = np.polyfit(x[place - 1 : place + 2], y[place - 1 : place + 2], 2)
    return float(np.clip(-0.5 * b / a, x[0], x[-1])) if a < 0.0 else float(x[np.argmax(y)])


def _objective(submodels: Mapping[str, Submodel]) -> float:
    return sum(submodel.objective for submodel in submodels.values())


def _gains(submodels: Mapping[str, Submodel], source: str, shifts: np.ndarray) -> np.ndarray:
    """2 Δ ln L (S,) that shifts [s] promise in all submodels together."""
    return np.sum([shift_gains(submodel, source, shifts) for submodel in submodels.values()], axis=0)


def shift_gains(submodel: Submodel, source: str, shifts: np.ndarray) -> np.ndarray:
    """2 Δ ln L (S,) that shifts [s] of a source promise, all parameters estimated again to first order.

    Innovations e of the shifted record at the base's parameters, less the part that their slopes X explain:
    |M e₀|² − |M e|² with M = 1 − X (X'X)⁻¹ X'.
    """
    model, at = submodel.base.model, dict(submodel.values)
    likelihood, t = submodel.likelihood, submodel.run.timeline
    directions = np.diag([p.slope(at[p.name]) for p in model.parameters]).astype(float)
    read, root, base_e = standardised(t, likelihood.trace(at))
    x = (-likelihood.slopes(at, directions) / root[..., None])[read]
    base_time = _times(t, read)
    basis, _ = np.linalg.qr(x[:, np.abs(x).max(axis=0) > 1e-12])

    def unexplained(e: np.ndarray) -> float:
        explained = basis.T @ e
        return float(e @ e - explained @ explained)

    moves = "cabinet_temperature" in sources(submodel.record).get(source, ())
    result = []
    for shift in shifts:
        moved = prepare_run(submodel.base, shifted(submodel.record, Shift(source, float(shift)))).timeline
        read, _, e = standardised(moved, search_likelihood(model, moved).trace(at))
        place = _match(base_time, _times(moved, read) - (shift if moves else 0.0))
        inside = place >= 0
        own = base_e.copy()
        own[place[inside]] += e[inside] - base_e[place[inside]]
        result.append(unexplained(base_e) - unexplained(own))
    return np.array(result)


def _times(t: Timeline, read: np.ndarray) -> np.ndarray:
    """Times (N,) [s] of the readings."""
    return np.broadcast_to(seconds(t)[:, None], read.shape)[read]


def _match(known: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Place of each time in `known` (within a second), −1 where there is none."""
    place = np.clip(np.searchsorted(known, time - 0.5), 0, len(known) - 1)
    return np.where(np.abs(known[place] - time) < 1.0, place, -1)
