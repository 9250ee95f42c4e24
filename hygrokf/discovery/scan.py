"""Score statistics of one-parameter effects at the base model's maximum: which date, threshold or delay to refit.

With e the standardised innovations of the base, x their slopes along the effect's parameter at its null value and X
those along the base's parameters,

    x' = x − X (X'X)⁻¹ X'x,    LM = (x'·e)²/(x'·x'),

the gain 2 Δ ln L that a small effect promises when everything else is estimated again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from hygrokf.design import extended
from hygrokf.discovery.scene import Part
from hygrokf.drivers import run
from hygrokf.features import feature
from hygrokf.likelihood import Likelihood


def scan(
    part: Part,
    mechanism: tuple[str, dict],
    parameter: str,
    name: str,
    settings: Sequence[Mapping],
    nulls: Mapping[str, float] | None = None,
) -> np.ndarray:
    """Signed roots of LM (S,), positive where the parameter wants to grow, for each of S settings of the feature `name`.

    `mechanism` (name, settings) brings the parameter and reads the feature; `nulls` values of its other parameters.
    """
    wider = extended(part.base, [mechanism], features={name: dict(settings[0])})
    made = run(wider, part.record)
    t = made.timeline
    model = wider.model
    at = {p.name: p.null if p.null is not None else p.start for p in model.parameters}
    at |= dict(part.values) | dict(nulls or {})
    own = [p.name for p in model.parameters]
    base = [own.index(p.name) for p in part.base.model.parameters if p.name in own]
    slopes = {p.name: p.slope(at[p.name]) for p in part.base.model.parameters}
    directions = np.zeros((len(own), len(base)))
    for column, row in enumerate(base):
        directions[row, column] = slopes[own[row]]
    likelihood = Likelihood(model, t)
    trace = likelihood.trace(at)
    read = np.isfinite(t.y)
    root = np.sqrt(trace.variance)
    e = ((t.y - trace.prediction) / root)[read]
    x0 = (_slopes(likelihood, at, directions) / root[..., None])[read]
    basis, _ = np.linalg.qr(x0[:, np.abs(x0).max(axis=0) > 1e-12])
    along = np.zeros((len(own), 1))
    along[own.index(parameter), 0] = 1.0
    column = t.varying.index(name)
    seconds = t.origin_s + 3600.0 * t.time
    found = []
    for one in settings:
        u = t.u.copy()
        u[1:, column] = feature(part.record, name, one, seconds)
        u[0, column] = u[1, column]
        changed = Likelihood(model, replace(t, u=u))
        x = (_slopes(changed, at, along)[..., 0] / root)[read]
        x = x - basis @ (basis.T @ x)
        square = float(x @ x)
        found.append(0.0 if square <= 1e-12 else float(x @ e) / np.sqrt(square))
    return np.array(found)


def _slopes(likelihood: Likelihood, values: Mapping[str, float], directions: np.ndarray) -> np.ndarray:
    """Slopes (T, k, r) of the predictions along directions (d, r)."""
    return -likelihood.slopes(values, directions)


def abrupt(part: Part, count: int = 12) -> list[float]:
    """Dates [s] just before the largest innovations of a part: where a reading may have jumped."""
    t = part.run.timeline
    trace = Likelihood(part.base.model, t).trace(part.values)
    size = np.abs(t.y - trace.prediction)[:, 0] / np.sqrt(trace.variance)[:, 0]
    order = np.argsort(np.where(np.isfinite(size), -size, 0.0))[:count]
    read = np.flatnonzero(np.isfinite(size))
    before = np.maximum(np.searchsorted(read, order) - 1, 0)
    middle = 0.5 * (t.time[order] + t.time[read[before]])
    return sorted(float(t.origin_s + 3600.0 * m) for m in middle)


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
    likelihood = Likelihood(wider.model, t)
    trace = likelihood.trace(at)
    along = np.zeros((len(at), 1))
    along[[p.name for p in wider.model.parameters].index(parameter), 0] = 1.0
    root = np.sqrt(trace.variance)
    read = np.isfinite(t.y)
    x = (_slopes(likelihood, at, along)[..., 0] / root)[read]
    e = ((t.y - trace.prediction) / root)[read]
    seconds = np.broadcast_to((t.origin_s + 3600.0 * t.time)[:, None], t.y.shape)[read]
    return e, x, seconds
