"""One variant of a cause put to the test: all parameters estimated again with it, and what that gained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.design import Design
from hygrokf.discovery.library import SHIFTS_MIN, Variant, penalty, sources
from hygrokf.discovery.scene import Part, Scene, days, refitted
from hygrokf.drivers import run
from hygrokf.likelihood import Likelihood, Trace
from hygrokf.record import Record
from hygrokf.timeline import Timeline

REFINEMENTS = 2
"""Passes that narrow a shift down from the coarse grid by score statistics, each to about half the spacing."""
SHIFT_STEPS_S = (240.0, 90.0, 30.0)
"""[s] steps by which a shift is then moved as long as the likelihood, all parameters estimated again, grows."""
BEST_DAYS = 3
"""Days that a gain must survive without: an effect that was seen on three days alone is no property of the cabinet."""


@dataclass(frozen=True)
class Trial:
    """A variant estimated in a scene.

    `parts` the parts that it changed; `lr` 2 Δ ln L of them together, `parameters` their new ones, `bic_gain` lr less
    the price of parameters and grid; `gain` part → share of the squared free-run error that is gone, `lasting` the
    same without the three days that gained most.
    """

    variant: Variant
    parts: Mapping[str, Part]
    lr: float
    parameters: int
    bic_gain: float
    gain: Mapping[str, float]
    lasting: Mapping[str, float]

    @property
    def best_lasting(self) -> float:
        return max(self.lasting.values(), default=0.0)


def attempt(scene: Scene, variant: Variant) -> Trial:
    """Estimate a variant in every part that it touches."""
    if variant.shift_s:
        return _shifted(scene, variant)
    parts = {}
    for name, part in scene.parts.items():
        additions = variant.additions.get(name, ())
        altered = variant.altered.get(name, {})
        if not additions and not altered:
            continue
        base = replace(part, base=_altered(part.base, altered))
        parts[name] = refitted(base, additions, variant.features, variant.starts)
    return judged(scene, variant, parts)


def judged(scene: Scene, variant: Variant, parts: Mapping[str, Part]) -> Trial:
    """What changed parts gained over those of the scene."""
    lr, count, n = 0.0, 0, 0
    gain, lasting = {}, {}
    for name, part in parts.items():
        before = scene.parts[name]
        lr += 2.0 * (part.objective - before.objective)
        count += part.parameters - before.parameters
        n += before.n
        gain[name], lasting[name] = shares(before, part)
    count = max(count, 1)
    return Trial(variant, dict(parts), lr, count, lr - penalty(variant, count, n), gain, lasting)


def shares(before: Part, after: Part) -> tuple[float, float]:
    """Share of the squared free-run error that is gone, and the same without the three days that gained most."""
    count = int(max(days(before).max(), days(after).max())) + 1
    old, new = (
        np.bincount(days(p)[np.isfinite(p.error)], p.error[np.isfinite(p.error)] ** 2, count)
        for p in (before, after)
    )
    order = np.argsort(new - old)[BEST_DAYS:]
    total, rest = float(old.sum()), float(old[order].sum())
    return (
        1.0 - float(new.sum()) / total if total > 0 else 0.0,
        1.0 - float(new[order].sum()) / rest if rest > 0 else 0.0,
    )


def _altered(base: Design, altered: Mapping[str, dict]) -> Design:
    """The design with other settings of some of its mechanisms."""
    mechanisms = tuple((name, {**settings, **altered.get(name, {})}) for name, settings in base.mechanisms)
    return replace(base, mechanisms=mechanisms)


# -- clocks --------------------------------------------------------------------------------------------------------
def shift_source(record: Record, source: str, seconds: float) -> Record:
    """The record with one source's stamps later by `seconds`."""
    signals = sources(record).get(source, ())
    moved = [replace(record[s], time=record[s].time + seconds) for s in signals]
    return record.replace_series(*moved)


def _shifted(scene: Scene, variant: Variant) -> Trial:
    """The shift of a source that the innovations ask for, found on a grid, refined by a parabola, and estimated."""
    (source,) = variant.shift_s
    grid = np.array(SHIFTS_MIN) * 60.0
    gains = sum(shift_gains(part, source, grid) for part in scene.parts.values())
    grid, gains = np.append(grid, 0.0), np.append(gains, 0.0)
    order = np.argsort(grid)
    grid, gains = grid[order], gains[order]
    for _ in range(REFINEMENTS):
        best = int(np.argmax(gains))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        more = np.setdiff1d(np.linspace(low, high, 5)[1:-1], grid)
        if not len(more):
            break
        extra = sum(shift_gains(part, source, more) for part in scene.parts.values())
        grid, gains = np.append(grid, more), np.append(gains, extra)
        order = np.argsort(grid)
        grid, gains = grid[order], gains[order]
    seconds = float(grid[int(np.argmax(gains))])
    if seconds == 0.0:
        still = replace(variant, settings={"source": source, "shift_s": 0.0})
        return Trial(still, {}, 0.0, 1, -penalty(variant, 1, 1), {}, {})
    seconds, parts = _climbed(scene, source, seconds)
    settings = {"source": source, "shift_s": seconds}
    return judged(scene, replace(variant, shift_s={source: seconds}, settings=settings), parts)


def _climbed(scene: Scene, source: str, seconds: float) -> tuple[float, dict[str, Part]]:
    """A shift moved in ever smaller steps to the largest likelihood, and the parts estimated there.

    The score statistics are of first order: for a clock that is off by many minutes they are minutes wrong.
    """
    known: dict[float, dict[str, Part]] = {}

    def objective(shift: float) -> float:
        if shift not in known:
            known[shift] = {
                name: refitted(part, (), {}, ({},), shift_source(part.record, source, shift))
                for name, part in scene.parts.items()
            }
        return sum(part.objective for part in known[shift].values())

    best = seconds
    for step in SHIFT_STEPS_S:
        for sign in (1.0, -1.0):
            while objective(best + sign * step) > objective(best):
                best += sign * step
    return best, known[best]


def shift_gains(part: Part, source: str, shifts: Sequence[float]) -> np.ndarray:
    """2 Δ ln L (S,) that shifts [s] of a source promise, all parameters estimated again to first order.

    Innovations e of the shifted record at the base's parameters, less what their slopes X can explain: |M e₀|² − |M e|².
    """
    model, at = part.base.model, dict(part.values)
    likelihood = Likelihood(model, part.run.timeline)
    directions = np.diag([p.slope(at[p.name]) for p in model.parameters]).astype(float)
    trace = likelihood.trace(at)
    slopes = -likelihood.slopes(at, directions)
    base_time, base_e, x = _readings(part.run.timeline, trace, slopes)
    keep = np.abs(x).max(axis=0) > 1e-12
    basis, _ = np.linalg.qr(x[:, keep])
    result = []
    for seconds in shifts:
        record = shift_source(part.record, source, float(seconds))
        t = run(part.base, record).timeline
        found = Likelihood(model, t).trace(at)
        time, e, _ = _readings(t, found, None)
        moved = "cabinet_temperature" in sources(part.record).get(source, ())
        place = _match(base_time, time - (seconds if moved else 0.0))
        inside = place >= 0
        change = np.zeros(len(base_e))
        change[place[inside]] = e[inside] - base_e[place[inside]]
        own = base_e + change
        result.append(
            float(base_e @ base_e - (basis.T @ base_e) @ (basis.T @ base_e))
            - float(own @ own - (basis.T @ own) @ (basis.T @ own))
        )
    return np.array(result)


def _readings(
    t: Timeline, trace: Trace, slopes: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Times [s], standardised innovations, and their slopes, at the readings."""
    read = np.isfinite(t.y)
    root = np.sqrt(trace.variance)
    e = ((t.y - trace.prediction) / root)[read]
    seconds = np.broadcast_to((t.origin_s + 3600.0 * t.time)[:, None], t.y.shape)[read]
    return seconds, e, None if slopes is None else (slopes / root[..., None])[read]


def _match(known: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Place of each time in `known` (within a second), −1 where there is none."""
    place = np.clip(np.searchsorted(known, time - 0.5), 0, len(known) - 1)
    return np.where(np.abs(known[place] - time) < 1.0, place, -1)
