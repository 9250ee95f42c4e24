"""Score statistics of one-parameter effects at the base model's maximum: which date, threshold or delay to refit.

With e the standardised innovations of the base, x their slopes along the effect's parameter at its null value and X
those along the base's parameters,

    x' = x − X (X'X)⁻¹ X'x,    LM = (x'·e)²/(x'·x'),

the gain 2 Δ ln L that a small effect promises when everything else is estimated again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.design import extended
from hygrokf.discovery.scene import Part, searching
from hygrokf.drivers import run
from hygrokf.features import feature
from hygrokf.likelihood import Likelihood
from hygrokf.model import Model
from hygrokf.parallel import mapped
from hygrokf.timeline import Timeline


@dataclass(frozen=True)
class Scanned:
    """Score statistics of S settings: `root` (S,) signed roots of LM, positive where the parameter wants to grow, and their
    `correlation` (S, S) where there is no effect.
    """

    root: np.ndarray
    correlation: np.ndarray

    def __add__(self, other: Scanned) -> Scanned:
        """Both of two independent looks at the same settings, for statistics that add up as squares."""
        root = np.sqrt(self.root**2 + other.root**2)
        return Scanned(root, 0.5 * (self.correlation + other.correlation))

    @property
    def effective(self) -> float:
        """Number of independent settings whose largest LM has the same law: the price of having searched.

        From `DRAWS` simulated maxima of normal variates with the correlation of the statistics; at least 1.
        """
        from scipy.special import erfc

        value, vector = np.linalg.eigh(self.correlation)
        factor = vector * np.sqrt(np.maximum(value, 0.0))
        normal = np.random.default_rng(0).standard_normal((DRAWS, len(value)))
        high = float(np.quantile(np.abs(normal @ factor.T).max(axis=1), 1.0 - TAIL))
        return max(TAIL / max(float(erfc(high / math.sqrt(2.0))), 1e-12), 1.0)


@dataclass(frozen=True)
class _Bench:
    """A part with an effect at its null value: standardised innovations `e` (n,) at the readings, a `basis` (n, d) of what
    the base's parameters explain, and how the slopes along the effect are had for other values of its feature.
    """

    part: Part
    model: Model
    timeline: Timeline
    at: Mapping[str, float]
    along: np.ndarray
    root: np.ndarray
    read: np.ndarray
    e: np.ndarray
    basis: np.ndarray
    name: str

    @property
    def seconds(self) -> np.ndarray:
        return self.timeline.origin_s + 3600.0 * self.timeline.time

    def slopes(self, value: np.ndarray) -> np.ndarray:
        """Slopes (n,) along the effect with the feature's values (T,)."""
        u = self.timeline.u.copy()
        column = self.timeline.varying.index(self.name)
        u[1:, column] = value
        u[0, column] = value[0]
        changed = searching(self.model, replace(self.timeline, u=u))
        return (_slopes(changed, self.at, self.along)[..., 0] / self.root)[self.read]

    def scanned(self, columns: Sequence[np.ndarray]) -> Scanned:
        """Signed roots of LM of slopes (n,), one for each setting."""
        units = np.column_stack(columns)
        for place in range(0, units.shape[1], AT_ONCE):
            block = units[:, place : place + AT_ONCE]
            block -= self.basis @ (self.basis.T @ block)
            length = np.sqrt(np.einsum("ns,ns->s", block, block))
            block *= np.where(length > 1e-6, 1.0 / np.maximum(length, 1e-6), 0.0)
        return Scanned(units.T @ self.e, units.T @ units)


def _bench(
    part: Part,
    mechanism: tuple[str, dict],
    parameter: str,
    name: str,
    setting: Mapping,
    nulls: Mapping | None,
) -> _Bench:
    wider = extended(part.base, [mechanism], features={name: dict(setting)})
    t = run(wider, part.record).timeline
    model = wider.model
    at = {p.name: p.null if p.null is not None else p.start for p in model.parameters}
    at |= dict(part.values) | dict(nulls or {})
    own = [p.name for p in model.parameters]
    base = [own.index(p.name) for p in part.base.model.parameters if p.name in own]
    slopes = {p.name: p.slope(at[p.name]) for p in part.base.model.parameters}
    directions = np.zeros((len(own), len(base)))
    for column, row in enumerate(base):
        directions[row, column] = slopes[own[row]]
    likelihood = searching(model, t)
    trace = likelihood.trace(at)
    read = np.isfinite(t.y)
    root = np.sqrt(trace.variance)
    e = ((t.y - trace.prediction) / root)[read]
    x0 = (_slopes(likelihood, at, directions) / root[..., None])[read]
    basis, _ = np.linalg.qr(x0[:, np.abs(x0).max(axis=0) > 1e-12])
    along = np.zeros((len(own), 1))
    along[own.index(parameter), 0] = 1.0
    return _Bench(part, model, t, at, along, root, read, e, basis, name)


def scan(
    part: Part,
    mechanism: tuple[str, dict],
    parameter: str,
    name: str,
    settings: Sequence[Mapping],
    nulls: Mapping[str, float] | None = None,
    sums: np.ndarray | None = None,
) -> Scanned:
    """Score statistics of S settings of the feature `name`.

    `mechanism` (name, settings) brings the parameter and reads the feature; `nulls` values of its other parameters.  With
    `sums` (S, W) those of W features that are sums of the settings' own: slopes are linear in the feature.
    """
    bench = _bench(part, mechanism, parameter, name, settings[0], nulls)
    courses = [feature(part.record, name, one, bench.seconds) for one in settings]
    columns = mapped(bench.slopes, courses)
    return bench.scanned(columns if sums is None else list((np.column_stack(columns) @ sums).T))


def slow_scan(
    part: Part,
    mechanism: tuple[str, dict],
    parameter: str,
    name: str,
    settings: Sequence[Mapping],
    nulls: Mapping[str, float] | None = None,
) -> Scanned:
    """The same for a feature that changes slowly, by one pass of the filter for all settings.

    A filter forgets within hours: slopes along an effect that comes and goes over days are those along a lasting one
    times its course.  What happens in the hours after a sudden change is missed; `scan` refines.
    """
    bench = _bench(part, mechanism, parameter, name, settings[0], nulls)
    lasting = bench.slopes(np.ones(len(bench.seconds)))
    courses = (
        np.broadcast_to(feature(part.record, name, one, bench.seconds)[:, None], bench.read.shape)
        for one in settings
    )
    return bench.scanned([lasting * course[bench.read] for course in courses])


def _slopes(likelihood: Likelihood, values: Mapping[str, float], directions: np.ndarray) -> np.ndarray:
    """Slopes (T, k, r) of the predictions along directions (d, r)."""
    return -likelihood.slopes(values, directions)


def abrupt(part: Part, count: int = 12) -> list[float]:
    """Dates [s] just before the largest innovations of a part: where a reading may have jumped."""
    t = part.run.timeline
    trace = searching(part.base.model, t).trace(part.values)
    size = np.abs(t.y - trace.prediction)[:, 0] / np.sqrt(trace.variance)[:, 0]
    order = np.argsort(np.where(np.isfinite(size), -size, 0.0))[:count]
    read = np.flatnonzero(np.isfinite(size))
    before = np.maximum(np.searchsorted(read, order) - 1, 0)
    middle = 0.5 * (t.time[order] + t.time[read[before]])
    return sorted(float(t.origin_s + 3600.0 * m) for m in middle)


AT_ONCE = 64
"""Settings whose slopes are made orthogonal to the base's at a time."""
DRAWS = 4000
TAIL = 0.02
"""[1] tail of the simulated maxima at which independent settings are counted."""
WINDOWS_H = (3.0, 8.0, 24.0, 72.0)
PRICE = 25.0
"""LM that a window must bring: of some thousand windows tried on noise the largest is seldom above 16."""
MOST_WINDOWS = 12


def local_scan(probes: Mapping[str, tuple[Part, str, str]], name: str) -> list[list[float]]:
    """Windows [start, end] [s] in which the parts' innovations ask for an effect, the strongest first; none overlaps.

    The response to an effect within a window is taken as that to a lasting one, cut to the window: a filter forgets
    within hours.  `probes`: part → (part, mechanism, parameter) of effects that share the flag `name`.
    """
    step = 1800.0
    products, squares, start = None, None, 0.0
    for part, mechanism, parameter in probes.values():
        e, x, seconds = _responses(part, mechanism, parameter, name)
        if products is None:
            start, count = float(seconds[0]), int((seconds[-1] - seconds[0]) / step) + 2
            products, squares = np.zeros((len(probes), count)), np.zeros((len(probes), count))
        row = list(probes).index(part.name)
        place = np.clip(((seconds - start) / step).astype(int), 0, products.shape[1] - 1)
        np.add.at(products[row], place, e * x)
        np.add.at(squares[row], place, x * x)
    if products is None:
        return []
    found: list[list[float]] = []
    taken = np.zeros(products.shape[1], bool)
    sums = [np.cumsum(np.pad(a, ((0, 0), (1, 0))), axis=1) for a in (products, squares)]
    candidates = []
    for hours in WINDOWS_H:
        width = int(hours * 3600.0 / step)
        p, q = (s[:, width:] - s[:, :-width] for s in sums)
        gain = np.sum(np.where((p > 0) & (q > 1e-12), p * p / np.maximum(q, 1e-12), 0.0), axis=0)
        candidates += [(float(gain[i]), i, width) for i in np.flatnonzero(gain > PRICE)]
    for _, first, width in sorted(candidates, reverse=True):
        if len(found) >= MOST_WINDOWS:
            break
        if not taken[first : first + width].any():
            taken[first : first + width] = True
            found.append([start + step * first, start + step * (first + width)])
    return sorted(found)


def _responses(
    part: Part, mechanism: str, parameter: str, name: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Standardised innovations, their slopes along a lasting effect, and their times [s], at the readings."""
    wider = extended(part.base, [(mechanism, {})], features={name: {"spans": [[-1e18, 1e18]]}})
    made = run(wider, part.record)
    t = made.timeline
    at = {p.name: p.null if p.null is not None else p.start for p in wider.model.parameters}
    at |= dict(part.values)
    likelihood = searching(wider.model, t)
    trace = likelihood.trace(at)
    along = np.zeros((len(at), 1))
    along[[p.name for p in wider.model.parameters].index(parameter), 0] = 1.0
    root = np.sqrt(trace.variance)
    read = np.isfinite(t.y)
    x = (_slopes(likelihood, at, along)[..., 0] / root)[read]
    e = ((t.y - trace.prediction) / root)[read]
    seconds = np.broadcast_to((t.origin_s + 3600.0 * t.time)[:, None], t.y.shape)[read]
    return e, x, seconds
