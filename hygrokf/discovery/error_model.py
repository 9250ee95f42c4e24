"""The error of a simulation as a process: heat or vapour flow with a free spectrum, through the cabinet's own
low pass, and white noise of the readings.

    y = simulation + n + w,    w ~ N(0, R),
    τ dn/dt = −n + Σ u_j + white flow,    θ_j du_j/dt = −u_j + white,    θ_j = 0.5, 2, 8, 32, 128 h,

with all variances free: s_j² those of the parts u_j, s_w² that which white flow alone would give n.  At rest

    Var n = Σ s_j² θ_j/(θ_j+τ) + s_w²,    Cov(u_j, n) = s_j² θ_j/(θ_j+τ),    Cov(u_j, u_l) = 0 (j ≠ l).

A slow disturbance then costs a cause its evidence, and a fast one does not buy it any.  −2 ln L counts e² of
a standardised innovation up to a bound and grows linearly beyond it (Huber), so that single readings decide
nothing.

Shapes: T instants, m = 5 parts, n = m + 1 states (u_1 … u_m, n), LANES runs side by side, c columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from hygrokf.engine.jit import CompiledCode
from hygrokf.engine.llvm_writer import LANES, SCALAR, Writer, declarations
from hygrokf.physics.expression import Expression, Graph, Matrix
from hygrokf.physics.matrices import add, product, transpose

TIMES_H = (0.5, 2.0, 8.0, 32.0, 128.0)
"""[h] correlation times θ of the parts: a factor of four apart, they span half an hour to a week."""
HUBER = 4.0
"""Standard deviations from which an innovation counts linearly."""
FEWEST_STEPS = 0.6
"""Median steps of the readings that a part's correlation time must last."""
LONGEST_SHARE = 1.0 / 3.0
"""Share of the record that it may last."""
LEAST = 1e-6
"""Smallest variance, as a share of the readings'."""
VARIANCES = len(TIMES_H) + 2
"""R, s_w² and those of the parts, in this order."""
_STATES = len(TIMES_H) + 1
_COEFFICIENTS = 2 * len(TIMES_H) + 1
_MOVE = 1e-3
_STEP = 3.0
"""Largest change of a log variance in one step."""
_GAIN = 0.02
"""Gain in −2 ln L of a step at which scoring ends."""
_STEPS = 60


@dataclass(frozen=True)
class Instants:
    """When an error is seen, and what its law needs of that.

    time_h: (T,) [h]; tau_h: [h] time constant of the low pass; added: (T,) variance that Var n has beside the
    stationary one at an instant, where the state begins anew or an input's time is not known; key, table:
    the row (T,) of the distinct steps' coefficients (d, 2m+1); there: (m,) which parts the readings resolve;
    shape: (T,) variance of each reading's noise as a multiple of R; largest: variance of the readings, which
    no part may exceed at the output.
    """

    time_h: np.ndarray
    tau_h: float
    added: np.ndarray
    key: np.ndarray
    table: np.ndarray
    there: np.ndarray
    shape: np.ndarray
    largest: float


def course(
    time_h: np.ndarray, tau_h: float, added: np.ndarray, shape: np.ndarray | None = None,
    there: np.ndarray | None = None, largest: float = math.inf,
) -> Instants:  # fmt: skip
    """The course of an error at instants (T,) [h]; `added`, `shape` (T,), `largest` as in `Instants`."""
    steps = np.round(np.diff(time_h, prepend=time_h[0]) * 3.6e6) / 3.6e6
    lengths, key = np.unique(steps, return_inverse=True)
    if there is None:
        usual = float(np.median(steps[1:])) if len(steps) > 1 else math.inf
        span = float(time_h[-1] - time_h[0])
        there = np.array([FEWEST_STEPS * usual <= t <= LONGEST_SHARE * span for t in TIMES_H])
    table = np.stack([coefficients(length, tau_h) for length in lengths.tolist()])
    shape = np.ones(len(time_h)) if shape is None else np.ascontiguousarray(shape, dtype=float)
    return Instants(time_h, tau_h, added, key.reshape(-1).astype(np.int32), table, there, shape, largest)


def coefficients(step_h: float, tau_h: float) -> np.ndarray:
    """(2m+1,) of a step [h]: u_j ← a_j u_j, n ← a n + Σ g_j u_j; in the order a_j, g_j, a.

    a_j = e^(−dt/θ_j), a = e^(−dt/τ), g_j = a (dt/τ)(e^δ − 1)/δ with δ = dt (1/τ − 1/θ_j): no case θ_j = τ is
    singular.
    """
    times = np.array(TIMES_H)
    own = math.exp(-step_h / tau_h)
    delta = step_h * (1.0 / tau_h - 1.0 / times)
    safe = np.where(np.abs(delta) < 1e-12, 1.0, delta)
    # a (e^δ − 1) = e^(−dt/θ) − e^(−dt/τ), written so that neither factor overflows
    fading = np.exp(-step_h / times)
    ratio = np.where(
        np.abs(delta) < 1e-12, own,
        np.where(
            delta < 0.0, own * np.expm1(np.minimum(safe, 0.0)), -fading * np.expm1(np.minimum(-safe, 0.0))
        )
        / safe,
    )  # fmt: skip
    return np.concatenate([fading, step_h / tau_h * ratio, [own]])


def shares(tau_h: float) -> np.ndarray:
    """(m,) of a part's variance that reaches the output: θ_j/(θ_j+τ)."""
    return np.array(TIMES_H) / (np.array(TIMES_H) + tau_h)


def stationary(variances: Sequence[Expression], share: Sequence[Expression]) -> Matrix:
    """Covariance (n, n) at rest, of traced variances (R, s_w², s_1² …) and `shares`."""
    flow, parts = variances[1], variances[2:]
    covariance: Matrix = [[0.0] * _STATES for _ in range(_STATES)]
    total: Expression | float = flow
    for j, (part, one) in enumerate(zip(parts, share, strict=True)):
        covariance[j][j] = part
        covariance[j][-1] = covariance[-1][j] = part * one
        total = total + part * one
    covariance[-1][-1] = total
    return covariance


# -- compiled passes -----------------------------------------------------------------------------------------
class _Traced:
    """One step of the filter as expressions."""

    def __init__(self) -> None:
        g = self.graph = Graph()
        parts = range(len(TIMES_H))
        self.variances = [g.symbol(f"s{i}") for i in range(VARIANCES)]
        self.share = [g.symbol(f"b{j}") for j in parts]
        self.coefficients = [g.symbol(f"a{i}") for i in range(_COEFFICIENTS)]
        self.x = [g.symbol(f"x{i}") for i in range(_STATES)]
        self.places = [(i, j) for i in range(_STATES) for j in range(i + 1)]
        self.p = [g.symbol(f"p{i}.{j}") for i, j in self.places]
        self.residual, self.seen, self.added, self.shape = (
            g.symbol(name) for name in ("r", "seen", "added", "shape")
        )
        self.gain = [g.symbol(f"k{i}") for i in range(_STATES)]
        self.scale = g.symbol("w")
        count = len(TIMES_H)
        transition: Matrix = [[0.0] * _STATES for _ in range(_STATES)]
        for j in parts:
            transition[j][j] = self.coefficients[j]
            transition[-1][j] = self.coefficients[count + j]
        transition[-1][-1] = self.coefficients[-1]
        self.transition = transition
        self.resting = stationary(self.variances, self.share)

    def moved(self) -> list[Expression]:
        """The state after a step."""
        return [row[0] for row in product(self.transition, [[x] for x in self.x])]

    def spread(self) -> Matrix:
        """P∞ + F (P − P∞) F', and what is added."""
        full: Matrix = [[0.0] * _STATES for _ in range(_STATES)]
        for (i, j), value in zip(self.places, self.p, strict=True):
            full[i][j] = full[j][i] = value - self.resting[i][j]
        moved = add(self.resting, product(product(self.transition, full), transpose(self.transition)))
        moved[-1][-1] = moved[-1][-1] + self.added
        return moved


_ARRAYS = ("key", "table", "variances", "share", "residual", "seen", "added", "shape")


class _FilterEmission:
    """Text of the passes: the same recursion, with numbers or with vectors of LANES."""

    def __init__(self, name: str, arguments: Sequence[str], wide: bool) -> None:
        self.traced = _Traced()
        self.wide = wide
        self.w = Writer(name, [("i64", "count"), *(("ptr", one) for one in arguments)])
        self.kind = self.w.vector if wide else SCALAR

    def load(self, array: str, place: str | int, kind: str | None = None) -> str:
        kind = kind or self.kind
        return self.w.load(kind, self.w.at(kind, f"%{array}", place))

    def values(
        self, outputs: Sequence[Expression], leaves: dict[int, str], vectors: Sequence[int]
    ) -> list[str]:
        made = self.w.block(self.traced.graph, outputs, leaves, vectors)
        return [self.w.as_vector(kind, name) if self.wide else name for kind, name in made]

    def step(self, instant: str) -> dict[int, str]:
        key = self.w.value(f"sext i32 {self.load('key', instant, 'i32')} to i64")
        row = self.w.integer("mul", key, _COEFFICIENTS)
        return {
            one.index: self.load("table", self.w.integer("add", row, c), SCALAR)
            for c, one in enumerate(self.traced.coefficients)
        }


def _filter_text(name: str, wide: bool) -> str:
    """`name(count, key, table, variances, share, residual, seen, added, shape, innovation, …)`.

    Writes innovations and their variances (T, lanes), and without `wide` also P H' (T, n), the predicted
    error (T,) and the state after each reading (T, n).
    """
    outputs = ("innovation", "variance", *(() if wide else ("reach", "predicted", "state")))
    e = _FilterEmission(name, (*_ARRAYS, *outputs), wide)
    t, w = e.traced, e.w
    known = {one.index: e.load("variances", i) for i, one in enumerate(t.variances)}
    known |= {one.index: e.load("share", j, SCALAR) for j, one in enumerate(t.share)}
    wide_leaves = [one.index for one in (*t.variances, *t.x, *t.p)] if wide else []
    zero = "zeroinitializer" if wide else "0.0"
    state = {one.index: w.slot(e.kind, zero) for one in t.x}
    resting = e.values([t.graph.lift(t.resting[i][j]) for i, j in t.places], known, wide_leaves)
    spread = {one.index: w.slot(e.kind, value) for one, value in zip(t.p, resting, strict=True)}
    with w.loop("%count") as k:
        leaves = known | e.step(k)
        leaves |= {i: w.load(e.kind, slot) for i, slot in (state | spread).items()}
        leaves |= {
            t.residual.index: e.load("residual", k, SCALAR), t.seen.index: e.load("seen", k, SCALAR),
            t.added.index: e.load("added", k, SCALAR), t.shape.index: e.load("shape", k, SCALAR),
        }  # fmt: skip
        moved, covariance = t.moved(), t.spread()
        innovation = t.residual - moved[-1]
        variance = t.variances[0] * t.shape + covariance[-1][-1]
        share = t.seen / variance
        after = [x + covariance[i][-1] * (share * innovation) for i, x in enumerate(moved)]
        left = [covariance[i][j] - covariance[i][-1] * (share * covariance[j][-1]) for i, j in t.places]
        told = [innovation, variance]
        told += [] if wide else [*(row[-1] for row in covariance), moved[-1]]
        made = e.values([*told, *after, *left], leaves, wide_leaves)
        w.store(e.kind, made[0], w.at(e.kind, "%innovation", k))
        w.store(e.kind, made[1], w.at(e.kind, "%variance", k))
        if not wide:
            row = w.integer("mul", k, _STATES)
            for i in range(_STATES):
                w.store(SCALAR, made[2 + i], w.at(SCALAR, "%reach", w.integer("add", row, i)))
            w.store(SCALAR, made[2 + _STATES], w.at(SCALAR, "%predicted", k))
            for i in range(_STATES):
                w.store(SCALAR, made[len(told) + i], w.at(SCALAR, "%state", w.integer("add", row, i)))
        kept = made[len(told) :]
        for slot, value in zip([*state.values(), *spread.values()], kept, strict=True):
            w.store(e.kind, value, slot)
    return w.text()


def _whiten_text() -> str:
    """`whiten(count, key, table, gain, scale, columns)`: innovations, in place, of LANES columns (T, LANES)
    under known gains (T, n), times `scale` (T,)."""
    e = _FilterEmission("whiten", ("key", "table", "gain", "scale", "columns"), True)
    t, w = e.traced, e.w
    state = {one.index: w.slot(e.kind, "zeroinitializer") for one in t.x}
    vectors = [t.residual.index, *state]
    with w.loop("%count") as k:
        row = w.integer("mul", k, _STATES)
        leaves = e.step(k) | {i: w.load(e.kind, slot) for i, slot in state.items()}
        leaves |= {
            one.index: e.load("gain", w.integer("add", row, i), SCALAR) for i, one in enumerate(t.gain)
        }
        leaves |= {t.residual.index: e.load("columns", k), t.scale.index: e.load("scale", k, SCALAR)}
        moved = t.moved()
        innovation = t.residual - moved[-1]
        after = [x + one * innovation for x, one in zip(moved, t.gain, strict=True)]
        made = e.values([innovation * t.scale, *after], leaves, vectors)
        w.store(e.kind, made[0], w.at(e.kind, "%columns", k))
        for slot, value in zip(state.values(), made[1:], strict=True):
            w.store(e.kind, value, slot)
    return w.text()


def _smooth_text() -> str:
    """`smooth(count, key, table, gain, share, innovation, reach, smoothed)`: adds to the predicted errors in
    `smoothed` (T,) what later readings tell, backwards."""
    e = _FilterEmission("smooth", ("key", "table", "gain", "share", "innovation", "reach", "smoothed"), False)
    t, w = e.traced, e.w
    state = {one.index: w.slot(SCALAR, "0.0") for one in t.x}
    reach = [t.graph.symbol(f"c{i}") for i in range(_STATES)]
    with w.loop("%count", backwards=True) as k:
        row = w.integer("mul", k, _STATES)
        leaves = e.step(k) | {i: w.load(SCALAR, slot) for i, slot in state.items()}
        for array, symbols in (("gain", t.gain), ("reach", reach)):
            leaves |= {
                one.index: e.load(array, w.integer("add", row, i), SCALAR) for i, one in enumerate(symbols)
            }
        leaves |= {t.residual.index: e.load("innovation", k), t.scale.index: e.load("share", k)}
        # r ← H' e/S + (I − K H)' r, then F' r for the instant before
        taken = sum((one * x for one, x in zip(t.gain, t.x, strict=True)), t.graph.constant(0.0))
        later = [*t.x[:-1], t.x[-1] - taken + t.scale * t.residual]
        gained = sum((one * x for one, x in zip(reach, later, strict=True)), t.graph.constant(0.0))
        before = [row[0] for row in product(transpose(t.transition), [[x] for x in later])]
        made = e.values([gained, *before], leaves, [])
        at = w.at(SCALAR, "%smoothed", k)
        w.store(SCALAR, w.real("fadd", w.load(SCALAR, at), made[0]), at)
        for slot, value in zip(state.values(), made[1:], strict=True):
            w.store(SCALAR, value, slot)
    return w.text()


@cache
def _code() -> CompiledCode:
    texts = (_filter_text("scores", True), _filter_text("filter", False), _whiten_text(), _smooth_text())
    return CompiledCode(declarations() + "".join(texts), ["scores", "filter", "whiten", "smooth"])


# -- what follows from them ----------------------------------------------------------------------------------
@dataclass(frozen=True)
class Filtered:
    """An error (T,) filtered under variances (7,) (R, s_w², s_1² …).

    innovation, variance: (T,), the innovation NaN where there is no reading; reach: (T, n) covariance of the
    state with the error before each reading; predicted: (T,) the error before it; state: (T, n) the state
    after it.
    """

    course: Instants
    variances: np.ndarray
    innovation: np.ndarray
    variance: np.ndarray
    reach: np.ndarray
    predicted: np.ndarray
    state: np.ndarray
    bound: float = HUBER

    @property
    def standardised(self) -> np.ndarray:
        """(T,) innovations by their standard deviations."""
        return self.innovation / np.sqrt(self.variance)

    @property
    def deviance(self) -> float:
        """−2 ln L, without ln 2π."""
        seen = np.isfinite(self.innovation)
        v = self.variance[seen][:, None]
        e = self.innovation[seen][:, None] / np.sqrt(v)
        return float(np.sum(np.log(v) + loss(e, self.bound), axis=0)[0])

    @property
    def terms(self) -> np.ndarray:
        """(T,) what each reading adds to −2 ln L; 0 without one."""
        e = self.standardised
        return np.where(np.isfinite(e), np.log(self.variance) + loss(e, self.bound), 0.0)

    @property
    def weight(self) -> np.ndarray:
        """(T,) by which an innovation counts in least squares; 0 without one."""
        e = np.abs(self.standardised)
        return np.where(np.isfinite(e), np.minimum(1.0, self.bound / np.maximum(e, 1e-300)), 0.0)

    @property
    def gain(self) -> np.ndarray:
        """(T, n) Kalman gains."""
        return np.where(np.isfinite(self.innovation), 1.0 / self.variance, 0.0)[:, None] * self.reach

    def whitened(self, columns: np.ndarray) -> np.ndarray:
        """Columns (T, c) as standardised innovations (T, c), 0 where there is no reading."""
        seen = np.isfinite(self.innovation)
        scale = np.where(seen, 1.0 / np.sqrt(self.variance), 0.0)
        gain = np.ascontiguousarray(self.gain)
        count, width = columns.shape
        result = np.empty((count, width))
        for first in range(0, width, LANES):
            block = np.zeros((count, LANES))
            part = columns[:, first : first + LANES]
            block[:, : part.shape[1]] = np.where(seen[:, None], part, 0.0)
            _code()("whiten", count, self.course.key, self.course.table, gain, scale, block)
            result[:, first : first + LANES] = block[:, : part.shape[1]]
        return result

    def smoothed(self) -> np.ndarray:
        """(T,) the error given all readings."""
        result = self.predicted.copy()
        seen = np.isfinite(self.innovation)
        share = np.where(seen, 1.0 / self.variance, 0.0)
        innovation = np.where(seen, self.innovation, 0.0)
        c = self.course
        _code()(
            "smooth", len(result), c.key, c.table, np.ascontiguousarray(self.gain), share, innovation,
            np.ascontiguousarray(self.reach), result,
        )  # fmt: skip
        return result


def loss(e: np.ndarray, bound: float = HUBER) -> np.ndarray:
    """e² up to the bound, 2 b |e| − b² beyond."""
    size = np.abs(e)
    counted = np.minimum(size, bound)
    return counted * (2.0 * size - counted)


def filtered(course: Instants, variances: np.ndarray, residual: np.ndarray, bound: float = HUBER) -> Filtered:
    """Filter an error (T,), NaN where there is no reading, under variances (7,)."""
    count = len(residual)
    innovation, variance, predicted = (np.empty(count) for _ in range(3))
    reach, state = np.empty((count, _STATES)), np.empty((count, _STATES))
    given, seen = _given(course, variances, residual)
    _code()("filter", count, *given, innovation, variance, reach, predicted, state)
    innovation[~seen] = np.nan
    return Filtered(course, variances, innovation, variance, reach, predicted, state, bound)


def _given(
    course: Instants, variances: np.ndarray, residual: np.ndarray
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    seen = np.isfinite(residual)
    arrays = (
        course.key, course.table, np.ascontiguousarray(variances, dtype=float), shares(course.tau_h),
        np.where(seen, residual, 0.0), seen.astype(float), course.added, course.shape,
    )  # fmt: skip
    return arrays, seen


def start_variances(course: Instants, residual: np.ndarray) -> np.ndarray:
    """(7,) a twentieth of the error's variance as noise, the rest spread over the flow."""
    total = max(float(np.nanvar(residual)), 1e-12)
    found = np.zeros(VARIANCES)
    found[:2] = 0.05 * total, 0.1 * total
    found[2:] = np.where(course.there, 0.85 * total / max(course.there.sum(), 1) / shares(course.tau_h), 0.0)
    return found


def maximised(course: Instants, residual: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """Variances (7,) of the greatest likelihood of an error (T,), by Fisher scoring.

    The eight lanes are the point and each log variance moved.
    """
    upper = np.full(VARIANCES, course.largest)
    upper[2:] = course.largest / shares(course.tau_h)
    active = np.append([True, True], course.there)
    common = start_variances(course, residual)
    begun = common if start is None else start
    lowest = np.log(LEAST * upper)
    usual = np.log(np.maximum(common, LEAST * upper))
    z = np.clip(np.log(np.maximum(np.where(active, begun, 1.0), 1e-300)), lowest, np.log(upper))
    damping, value, gradient, information = 1e-3, *_scores(course, residual, z, active)
    near = False
    for _ in range(_STEPS):
        outward = ((z <= lowest + 1e-9) & (gradient > 0)) | ((z >= np.log(upper) - 1e-9) & (gradient < 0))
        free = active & ~outward
        if not free.any():
            break
        matrix = information[np.ix_(free, free)]
        # slope and information of a small variance fall with it and its square: so does what holds it back
        # from rising, else it would stay where it is
        held = 0.5 * np.where(gradient < 0.0, np.minimum(1.0, np.exp(z - usual)), 1.0)[free] ** 2
        matrix = matrix + np.diag(damping * np.diag(matrix) + held)
        step = np.zeros(VARIANCES)
        step[free] = np.clip(-np.linalg.solve(matrix, gradient[free]), -_STEP, _STEP)
        if near and step.max() < _STEP:
            break
        moved = np.clip(z + step, lowest, np.log(upper))
        trial = _scores(course, residual, moved, active)
        if not trial[0] < value:
            damping *= 8.0
            if damping > 1e6:
                break
            continue
        gained = value - trial[0]
        z, (value, gradient, information) = moved, trial
        near = gained < _GAIN and damping < 0.05
        damping = max(damping / 5.0, 1e-6)
    return np.where(active, np.exp(z), 0.0)


def _scores(
    course: Instants, residual: np.ndarray, z: np.ndarray, active: np.ndarray, bound: float = HUBER
) -> tuple[float, np.ndarray, np.ndarray]:
    """−2 ln L, its gradient (7,) and its expected information (7, 7) in the log variances."""
    lanes = np.repeat(np.where(active, np.exp(z), 0.0)[:, None], LANES, axis=1)
    lanes[np.arange(VARIANCES), np.arange(1, LANES)] *= math.exp(_MOVE)
    count = len(residual)
    innovation, variance = (np.empty((count, LANES)) for _ in range(2))
    given, seen = _given(course, lanes, residual)
    _code()("scores", count, *given, innovation, variance)
    r, v = innovation[seen], variance[seen]
    root = np.sqrt(v[:, 0])
    e = r[:, 0] / root
    u = np.log(v[:, 1:] / v[:, :1]) / _MOVE
    d = (r[:, 1:] - r[:, :1]) / (_MOVE * root[:, None])
    w = np.minimum(1.0, bound / np.maximum(np.abs(e), 1e-300))
    gradient = (1.0 - w * e * e) @ u + 2.0 * (w * e) @ d
    information = u.T @ u + 2.0 * (w[:, None] * d).T @ d
    value = float(np.sum(np.log(v[:, 0]) + loss(e, bound)))
    return value, gradient, information


def ahead(course: Instants, horizon_h: np.ndarray) -> np.ndarray:
    """(h, n) weights of the state in the error expected after times (h,) [h]."""
    rows = np.stack([coefficients(float(one), course.tau_h) for one in horizon_h])
    return np.column_stack([rows[:, len(TIMES_H) : -1], rows[:, -1]])
