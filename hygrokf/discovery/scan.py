"""Score statistics of one-parameter effects at the base model's maximum: the date, threshold or delay to
refit with.

With e the standardised innovations of the base, x their slopes along the effect's parameter at its null value
and X those along the base's parameters,

    x' = x − X (X'X)⁻¹ X'x,    LM = (x'·e)²/(x'·x'),

the gain 2 Δ ln L that a small effect promises when everything else is estimated again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np

from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.submodel import Submodel, search_likelihood, seconds
from hygrokf.engine.llvm_writer import LANES
from hygrokf.engine.parallel import mapped
from hygrokf.engine.timeline import Timeline
from hygrokf.estimation.likelihood import Likelihood, Trace
from hygrokf.modelling.derived_inputs import feature
from hygrokf.modelling.design import extended
from hygrokf.modelling.inputs import prepare_run
from hygrokf.physics.model import Mechanism, Model, compose

DRAWS = 4000
TAIL = 0.02
"""[1] tail of the simulated maxima at which independent settings are counted."""
STEP_S = 1800.0
"""[s] resolution of windows."""
WINDOWS_H = (3.0, 8.0, 24.0, 72.0)
PRICE = 25.0
"""LM that a window must bring: of some thousand windows tried on noise the largest is seldom above 16."""
MOST_WINDOWS = 12


@dataclass(frozen=True)
class Probe:
    """A mechanism of one submodel and the parameter whose score statistic is wanted.

    nulls: values of its other parameters, by name; null or start values where not given.
    """

    submodel: str
    mechanism: tuple[str, Settings]
    parameter: str
    nulls: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Scanned:
    """Score statistics of S settings: `root` (S,) signed roots of LM, positive where the parameter wants to
    grow, and a `factor` (S, r) of their correlation F F' where there is no effect.
    """

    root: np.ndarray
    factor: np.ndarray

    def __add__(self, other: Scanned) -> Scanned:
        """Two independent looks at the same settings together: the statistics add up as squares."""
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
    """A submodel with an effect at its null value, and copies of the effect's mechanism beside it.

    `e` (n,) standardised innovations at the readings, `basis` (n, d) the directions in which the base's
    parameters move them; `along` (parameters, L) the directions of the copies' parameters, `columns` the
    places of their features among the inputs.
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
    def time_s(self) -> np.ndarray:
        return seconds(self.likelihood.timeline)

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


def standardised(t: Timeline, trace: Trace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(readings (T, k) bool, standard deviations (T, k) of the predictions, standardised innovations (N,) at
    the readings)."""
    read, root = np.isfinite(t.y), np.sqrt(trace.variance)
    return read, root, ((t.y - trace.prediction) / root)[read]


def _null_values(model: Model, submodel: Submodel, nulls: Mapping[str, float]) -> dict[str, float]:
    """Values of an extended model's parameters at which it is the submodel."""
    at = {p.name: p.null if p.null is not None else p.start for p in model.parameters}
    return at | dict(submodel.values) | dict(nulls)


def _abreast(
    model: Model, mechanism: Mechanism, parameter: str, name: str
) -> tuple[Model, list[str], list[str]]:
    """(the model with as many copies of a mechanism as the filter takes directions at once, their parameters,
    their features).

    At the parameter's null value a copy changes nothing, so one pass gives the slopes along all of them.  A
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


def _bench(submodel: Submodel, probe: Probe, name: str, setting: Settings) -> _Bench:
    wider = extended(submodel.base, [probe.mechanism], features={name: dict(setting)})
    t = prepare_run(wider, submodel.record).timeline
    added = wider.model.mechanism(probe.mechanism[0])
    model, parameters, names = _abreast(wider.model, added, probe.parameter, name)
    column = t.u[:, t.varying.index(name)]
    more = names[1:]
    t = replace(
        t,
        u=np.column_stack([t.u, *(column for _ in more)]),
        varying=(*t.varying, *more),
        whole={**t.whole, **{one: t.whole[name] for one in more}},
    )
    at = _null_values(model, submodel, probe.nulls)
    at |= {one: at[probe.parameter] for one in parameters}
    own = [p.name for p in model.parameters]
    base = [p for p in submodel.base.model.parameters if p.name in own]
    directions = np.zeros((len(own), len(base)))
    for place, p in enumerate(base):
        directions[own.index(p.name), place] = p.slope(at[p.name])
    likelihood = search_likelihood(model, t)
    read, root, e = standardised(t, likelihood.trace(at))
    x0 = (_slopes(likelihood, at, directions) / root[..., None])[read]
    basis, _ = np.linalg.qr(x0[:, np.abs(x0).max(axis=0) > 1e-12])
    along = np.zeros((len(own), len(parameters)))
    for place, one in enumerate(parameters):
        along[own.index(one), place] = 1.0
    columns = tuple(t.varying.index(one) for one in names)
    return _Bench(likelihood, at, along, columns, root, read, e, basis)


def scan(
    submodel: Submodel, probe: Probe, name: str, settings: Sequence[Settings], sums: np.ndarray | None = None
) -> Scanned:
    """Score statistics of S settings of the feature `name`, which the probe's mechanism reads.

    With `sums` (S, W) those of W features that are sums of the settings' own: slopes are linear in the
    feature.
    """
    bench = _bench(submodel, probe, name, settings[0])
    courses = [feature(submodel.record, name, one, bench.time_s) for one in settings]
    width = len(bench.columns)
    together = [courses[k : k + width] for k in range(0, len(courses), width)]
    return bench.scanned(np.hstack(mapped(bench.slopes, together)), sums)


def slow_scan(submodel: Submodel, probe: Probe, name: str, settings: Sequence[Settings]) -> Scanned:
    """The same for a feature that changes slowly, by one pass of the filter for all settings.

    A filter forgets within hours: slopes along an effect that comes and goes over days are those along a
    lasting effect times its course.  The hours after a sudden change are missed; `scan` refines.
    """
    bench = _bench(submodel, probe, name, settings[0])
    lasting = bench.slopes([np.ones(len(bench.time_s))])
    at = np.broadcast_to(np.arange(len(bench.time_s))[:, None], bench.read.shape)[bench.read]
    courses = np.column_stack([feature(submodel.record, name, one, bench.time_s)[at] for one in settings])
    return bench.scanned(lasting * courses)


def _slopes(likelihood: Likelihood, values: Mapping[str, float], directions: np.ndarray) -> np.ndarray:
    """Slopes (T, k, r) of the predictions along directions (d, r)."""
    return -likelihood.slopes(values, directions)


def abrupt(submodel: Submodel, count: int = 12) -> list[float]:
    """Dates [s] just before the largest innovations of a submodel: where a reading may have jumped."""
    t = submodel.run.timeline
    trace = submodel.likelihood.trace(submodel.values)
    size = np.abs(t.y - trace.prediction)[:, 0] / np.sqrt(trace.variance)[:, 0]
    order = np.argsort(np.where(np.isfinite(size), -size, 0.0))[:count]
    read = np.flatnonzero(np.isfinite(size))
    before = np.maximum(np.searchsorted(read, order) - 1, 0)
    middle = 0.5 * (t.time[order] + t.time[read[before]])
    return sorted(float(t.origin_s + 3600.0 * m) for m in middle)


def local_scan(submodels: Mapping[str, Submodel], probes: Sequence[Probe], name: str) -> list[list[float]]:
    """Windows [start, end] [s] in which the submodels' innovations ask for effects that share the flag
    `name`, the strongest first; none overlaps.

    The response to an effect within a window is taken as that to a lasting effect, cut to the window: a
    filter forgets within hours.
    """
    looks = [_responses(submodels[p.submodel], p, name) for p in probes if p.submodel in submodels]
    start, end = (float(looks[0][2][k]) for k in (0, -1))
    products, squares = np.zeros((2, len(looks), int((end - start) / STEP_S) + 2))
    for row, (e, x, time_s) in enumerate(looks):
        place = np.clip(((time_s - start) / STEP_S).astype(int), 0, products.shape[1] - 1)
        np.add.at(products[row], place, e * x)
        np.add.at(squares[row], place, x * x)
    sums = [np.cumsum(np.pad(a, ((0, 0), (1, 0))), axis=1) for a in (products, squares)]
    candidates = []
    for hours in WINDOWS_H:
        width = int(hours * 3600.0 / STEP_S)
        p, q = (s[:, width:] - s[:, :-width] for s in sums)
        gain = np.sum(np.where((p > 0) & (q > 1e-12), p * p / np.maximum(q, 1e-12), 0.0), axis=0)
        candidates += [(float(gain[i]), i, width) for i in np.flatnonzero(gain > PRICE)]
    found: list[list[float]] = []
    used = np.zeros(products.shape[1], bool)
    for _, first, width in sorted(candidates, reverse=True):
        if len(found) >= MOST_WINDOWS:
            break
        if not used[first : first + width].any():
            used[first : first + width] = True
            found.append([start + STEP_S * first, start + STEP_S * (first + width)])
    return sorted(found)


def _responses(submodel: Submodel, probe: Probe, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Standardised innovations, their slopes along a lasting effect, and their times [s], at the readings."""
    wider = extended(submodel.base, [probe.mechanism], features={name: {"spans": [[-1e18, 1e18]]}})
    t = prepare_run(wider, submodel.record).timeline
    at = _null_values(wider.model, submodel, probe.nulls)
    along = np.array([[float(p.name == probe.parameter)] for p in wider.model.parameters])
    likelihood = search_likelihood(wider.model, t)
    read, root, e = standardised(t, likelihood.trace(at))
    x = (_slopes(likelihood, at, along)[..., 0] / root)[read]
    return e, x, np.broadcast_to(seconds(t)[:, None], t.y.shape)[read]
