"""Score statistics of one-parameter effects at the base model's maximum: which date, threshold or delay to
refit.

With e the standardised innovations of the base, x their slopes along the effect's parameter at its null value
and X those along the base's parameters,

    x' = x − X (X'X)⁻¹ X'x,    LM = (x'·e)²/(x'·x'),

the gain 2 Δ ln L that a small effect promises when everything else is estimated again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np

from hygrokf.discovery.baseline import Part, searching
from hygrokf.discovery.discovery_results import Settings
from hygrokf.engine.llvm_writer import LANES
from hygrokf.engine.parallel import mapped
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.modelling.derived_inputs import feature
from hygrokf.modelling.design import extended
from hygrokf.modelling.inputs import prepare_run
from hygrokf.physics.model import Mechanism, Model, compose


@dataclass(frozen=True)
class Scanned:
    """Score statistics of S settings: `root` (S,) signed roots of LM, positive where the parameter wants to
    grow, and a `factor` (S, r) of their correlation F F' where there is no effect.
    """

    root: np.ndarray
    factor: np.ndarray

    def __add__(self, other: Scanned) -> Scanned:
        """Both of two independent looks at the same settings, for statistics that add up as squares."""
        root = np.sqrt(self.root**2 + other.root**2)
        return Scanned(root, math.sqrt(0.5) * np.hstack([self.factor, other.factor]))

    @property
    def effective(self) -> float:
        """Number of independent settings whose largest LM has the same law: the price of having searched.

        From `DRAWS` simulated maxima of normal variates with the correlation of the statistics; at least 1.
        """
        from scipy.special import erfc

        normal = np.random.default_rng(0).standard_normal((DRAWS, self.factor.shape[1]))
        high = float(np.quantile(np.abs(normal @ self.factor.T).max(axis=1), 1.0 - TAIL))
        return max(TAIL / max(float(erfc(high / math.sqrt(2.0))), 1e-12), 1.0)


@dataclass(frozen=True)
class _Bench:
    """A part with an effect at its null value, as often as the model has copies of the effect's mechanism.

    `e` (n,) standardised innovations at the readings, `basis` (n, d) what the base's parameters explain of
    them; `along` (parameters, L) the directions of the copies' parameters, `columns` the places of their
    features among the inputs.
    """

    likelihood: Likelihood
    at: Mapping[str, float]
    along: np.ndarray
    columns: tuple[int, ...]
    root: np.ndarray
    read: np.ndarray
    e: np.ndarray
    basis: np.ndarray

    @property
    def seconds(self) -> np.ndarray:
        t = self.likelihood.timeline
        return t.origin_s + 3600.0 * t.time

    def slopes(self, courses: Sequence[np.ndarray]) -> np.ndarray:
        """Slopes (n, S) along the effect with each of S courses (T,) of its feature, in one pass of the
        filter."""
        t = self.likelihood.timeline
        u = t.u.copy()
        for column, course in zip(self.columns, courses, strict=False):
            u[1:, column] = course
            u[0, column] = course[0]
        changed = replace(self.likelihood, timeline=replace(t, u=u))
        along = self.along[:, : len(courses)]
        return (_slopes(changed, self.at, along) / self.root[..., None])[self.read]

    def scanned(self, units: np.ndarray, sums: np.ndarray | None = None) -> Scanned:
        """Score statistics of settings with slopes (n, S), or of W `sums` (S, W) of them."""
        rest = units - self.basis @ (self.basis.T @ units)
        score, products = rest.T @ self.e, rest.T @ rest
        value, vector = np.linalg.eigh(products)
        factor = vector * np.sqrt(np.maximum(value, 0.0))
        if sums is not None:
            score, factor = sums.T @ score, sums.T @ factor
        length = np.sqrt(np.einsum("sr,sr->s", factor, factor))
        scale = np.where(length > 1e-6, 1.0 / np.maximum(length, 1e-6), 0.0)
        return Scanned(score * scale, factor * scale[:, None])


def _abreast(
    model: Model, mechanism: Mechanism, parameter: str, name: str
) -> tuple[Model, list[str], list[str]]:
    """(the model with as many copies of a mechanism as the filter takes directions at once, their parameters,
    their features).

    At the parameter's null value a copy changes nothing, so slopes along all of them are had in one pass.  A
    mechanism that brings a state or a shared quantity stays alone.
    """
    count = 1 if mechanism.states or mechanism.quantities else LANES
    numbers = range(2, count + 1)
    parameters, names = ([one, *(f"{one}_{k}" for k in numbers)] for one in (parameter, name))
    copies = [
        _copy(mechanism, {parameter: a, name: b}) for a, b in zip(parameters[1:], names[1:], strict=True)
    ]
    holds = dict(model.holds) | dict.fromkeys(names, model.holds[name])
    return compose([*model.mechanisms, *copies], holds, model.averaged), parameters, names


def _copy(mechanism: Mechanism, names: Mapping[str, str]) -> Mechanism:
    """A mechanism without states with other names of parameters and inputs."""

    def renamed(space: SimpleNamespace) -> SimpleNamespace:
        known = vars(space)
        return SimpleNamespace(**{**known, **{old: known[new] for old, new in names.items() if new in known}})

    conductance, contributions = mechanism.conductance, mechanism.contributions
    return replace(
        mechanism,
        parameters=tuple(replace(p, name=names.get(p.name, p.name)) for p in mechanism.parameters),
        inputs=tuple(names.get(one, one) for one in mechanism.inputs),
        conductance=None if conductance is None else lambda p, u: conductance(renamed(p), renamed(u)),
        contributions=None
        if contributions is None
        else lambda p, x, u, q: contributions(renamed(p), x, renamed(u), q),
    )


def _bench(
    part: Part,
    mechanism: tuple[str, Settings],
    parameter: str,
    name: str,
    setting: Settings,
    nulls: Settings | None,
) -> _Bench:
    wider = extended(part.base, [mechanism], features={name: dict(setting)})
    t = prepare_run(wider, part.record).timeline
    added = wider.model.mechanism(mechanism[0])
    model, parameters, names = _abreast(wider.model, added, parameter, name)
    column = t.u[:, t.varying.index(name)]
    more = names[1:]
    t = replace(
        t,
        u=np.column_stack([t.u, *(column for _ in more)]),
        varying=(*t.varying, *more),
        whole={**t.whole, **{one: t.whole[name] for one in more}},
    )
    at = {p.name: p.null if p.null is not None else p.start for p in model.parameters}
    at |= dict(part.values) | dict(nulls or {})
    at |= {one: at[parameter] for one in parameters}
    own = [p.name for p in model.parameters]
    base = [own.index(p.name) for p in part.base.model.parameters if p.name in own]
    slopes = {p.name: p.slope(at[p.name]) for p in part.base.model.parameters}
    directions = np.zeros((len(own), len(base)))
    for place, row in enumerate(base):
        directions[row, place] = slopes[own[row]]
    likelihood = searching(model, t)
    trace = likelihood.trace(at)
    read = np.isfinite(t.y)
    root = np.sqrt(trace.variance)
    e = ((t.y - trace.prediction) / root)[read]
    x0 = (_slopes(likelihood, at, directions) / root[..., None])[read]
    basis, _ = np.linalg.qr(x0[:, np.abs(x0).max(axis=0) > 1e-12])
    along = np.zeros((len(own), len(parameters)))
    for place, one in enumerate(parameters):
        along[own.index(one), place] = 1.0
    columns = tuple(t.varying.index(one) for one in names)
    return _Bench(likelihood, at, along, columns, root, read, e, basis)


def scan(
    part: Part,
    mechanism: tuple[str, Settings],
    parameter: str,
    name: str,
    settings: Sequence[Settings],
    nulls: Mapping[str, float] | None = None,
    sums: np.ndarray | None = None,
) -> Scanned:
    """Score statistics of S settings of the feature `name`.

    `mechanism` (name, settings) brings the parameter and reads the feature; `nulls` values of its other
    parameters.  With `sums` (S, W) those of W features that are sums of the settings' own: slopes are linear
    in the feature.
    """
    bench = _bench(part, mechanism, parameter, name, settings[0], nulls)
    courses = [feature(part.record, name, one, bench.seconds) for one in settings]
    width = len(bench.columns)
    together = [courses[k : k + width] for k in range(0, len(courses), width)]
    return bench.scanned(np.hstack(mapped(bench.slopes, together)), sums)


def slow_scan(
    part: Part,
    mechanism: tuple[str, Settings],
    parameter: str,
    name: str,
    settings: Sequence[Settings],
    nulls: Mapping[str, float] | None = None,
) -> Scanned:
    """The same for a feature that changes slowly, by one pass of the filter for all settings.

    A filter forgets within hours: slopes along an effect that comes and goes over days are those along a
    lasting one times its course.  What happens in the hours after a sudden change is missed; `scan` refines.
    """
    bench = _bench(part, mechanism, parameter, name, settings[0], nulls)
    lasting = bench.slopes([np.ones(len(bench.seconds))])
    at = np.broadcast_to(np.arange(len(bench.seconds))[:, None], bench.read.shape)[bench.read]
    courses = np.column_stack([feature(part.record, name, one, bench.seconds)[at] for one in settings])
    return bench.scanned(lasting * courses)


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


DRAWS = 4000
TAIL = 0.02
"""[1] tail of the simulated maxima at which independent settings are counted."""
WINDOWS_H = (3.0, 8.0, 24.0, 72.0)
PRICE = 25.0
"""LM that a window must bring: of some thousand windows tried on noise the largest is seldom above 16."""
MOST_WINDOWS = 12


def local_scan(probes: Mapping[str, tuple[Part, str, str]], name: str) -> list[list[float]]:
    """Windows [start, end] [s] in which the parts' innovations ask for an effect, the strongest first; none
    overlaps.

    The response to an effect within a window is taken as that to a lasting one, cut to the window: a filter
    forgets within hours.  `probes`: part → (part, mechanism, parameter) of effects that share the flag
    `name`.
    """
    step = 1800.0
    products, squares, start = np.zeros((0, 0)), np.zeros((0, 0)), 0.0
    for part, mechanism, parameter in probes.values():
        e, x, seconds = _responses(part, mechanism, parameter, name)
        if not products.size:
            start, count = float(seconds[0]), int((seconds[-1] - seconds[0]) / step) + 2
            products, squares = np.zeros((len(probes), count)), np.zeros((len(probes), count))
        row = list(probes).index(part.name)
        place = np.clip(((seconds - start) / step).astype(int), 0, products.shape[1] - 1)
        np.add.at(products[row], place, e * x)
        np.add.at(squares[row], place, x * x)
    if not products.size:
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
    made = prepare_run(wider, part.record)
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
