"""The error of a simulation as a process: a flow of heat or vapour with a free spectrum, filtered by the low
pass of the cabinet, plus white noise of the readings.

    y = simulation + n + w,    w ~ N(0, R),
    τ dn/dt = −n + Σ u_j + white flow,    θ_j du_j/dt = −u_j + white,    θ_j = 0.5, 2, 8, 32, 128 h,

with free variances: s_j² of the parts u_j, and s_w² of n under white flow alone.  In the stationary state

    Var n = Σ s_j² θ_j/(θ_j+τ) + s_w²,    Cov(u_j, n) = s_j² θ_j/(θ_j+τ),    Cov(u_j, u_l) = 0 (j ≠ l).

The likelihood then attributes slow and fast disturbances to this process instead of to a cause.  −2 ln L
counts the square of a standardised innovation up to a bound and grows linearly beyond it (Huber's loss), so
that single readings decide nothing.

Shapes: T instants, m = 5 parts, n = m + 1 states (u_1 … u_m, n), LANES parallel runs, c columns.
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
"""Shortest correlation time of a part that readings resolve, in median steps of the readings."""
LONGEST_SHARE = 1.0 / 3.0
"""Longest correlation time of a part that readings resolve, as a share of the record's length."""
LEAST_VARIANCE = 1e-6
"""Smallest variance, as a share of the variance of the readings."""
VARIANCES = len(TIMES_H) + 2
"""Number of variances: R, s_w² and those of the parts, in this order."""
_STATES = len(TIMES_H) + 1
_COEFFICIENTS = 2 * len(TIMES_H) + 1
_MOVE = 1e-3
"""Step of a log variance for the numerical gradient."""
_STEP = 3.0
"""Largest change of a log variance in one step."""
_GAIN = 0.02
"""Gain in −2 ln L of a step below which scoring ends."""
_STEPS = 60


@dataclass(frozen=True)
class Instants:
    """The instants at which an error is observed, with the coefficients of the process between them.

    time_h: (T,) [h]; tau_h: [h] time constant of the low pass; added: (T,) variance of n beyond the
    stationary one, where the state is unknown (at the start, after a gap) or an input's time is uncertain;
    key: (T,) row of each step in `table` (d, 2m+1), the coefficients of the distinct steps; there: (m,)
    whether the readings resolve a part; shape: (T,) noise variance of each reading as a multiple of R;
    largest: variance of the readings, the limit of each part at the output.
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
    """`Instants` with the coefficients of their steps, and the parts that they resolve unless `there` is
    given."""
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
    """(2m+1,) coefficients of a step [h] in the order a_j, g_j, a of u_j ← a_j u_j, n ← a n + Σ g_j u_j.

    a_j = e^(−dt/θ_j), a = e^(−dt/τ), g_j = a (dt/τ)(e^δ − 1)/δ with δ = dt (1/τ − 1/θ_j): regular also for
    θ_j = τ.
    """
    times_h = np.array(TIMES_H)
    low_pass = math.exp(-step_h / tau_h)
    delta = step_h * (1.0 / tau_h - 1.0 / times_h)
    safe = np.where(np.abs(delta) < 1e-12, 1.0, delta)
    # a (e^δ − 1) = e^(−dt/θ) − e^(−dt/τ), written so that neither factor overflows
    decay = np.exp(-step_h / times_h)
    ratio = np.where(
        np.abs(delta) < 1e-12, low_pass,
        np.where(
            delta < 0.0, low_pass * np.expm1(np.minimum(safe, 0.0)), -decay * np.expm1(np.minimum(-safe, 0.0))
        )
        / safe,
    )  # fmt: skip
    return np.concatenate([decay, step_h / tau_h * ratio, [low_pass]])


def shares(tau_h: float) -> np.ndarray:
    """(m,) share θ_j/(θ_j+τ) of a part's variance that passes the low pass."""
    return np.array(TIMES_H) / (np.array(TIMES_H) + tau_h)


def stationary(variances: Sequence[Expression], share: Sequence[Expression]) -> Matrix:
    """Stationary covariance (n, n) of the state, from traced variances (R, s_w², s_1² …) and `shares`."""
    flow, parts = variances[1], variances[2:]
    covariance: Matrix = [[0.0] * _STATES for _ in range(_STATES)]
    total: Expression | float = flow
    for j, (part, gain) in enumerate(zip(parts, share, strict=True)):
        covariance[j][j] = part
        covariance[j][-1] = covariance[-1][j] = part * gain
        total = total + part * gain
    covariance[-1][-1] = total
    return covariance


# -- compiled passes -----------------------------------------------------------------------------------------
class _Traced:
    """The expressions of one filter step."""

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

    def predicted_state(self) -> list[Expression]:
        """The state predicted after a step."""
        return [row[0] for row in product(self.transition, [[x] for x in self.x])]

    def predicted_covariance(self) -> Matrix:
        """P∞ + F (P − P∞) F' plus the added variance of n."""
        excess: Matrix = [[0.0] * _STATES for _ in range(_STATES)]
        for (i, j), value in zip(self.places, self.p, strict=True):
            excess[i][j] = excess[j][i] = value - self.resting[i][j]
        predicted = add(self.resting, product(product(self.transition, excess), transpose(self.transition)))
        predicted[-1][-1] = predicted[-1][-1] + self.added
        return predicted


_ARRAYS = ("key", "table", "variances", "share", "residual", "seen", "added", "shape")


class _FilterEmission:
    """LLVM text of a pass: the recursion with scalars, or with vectors of LANES (`wide`)."""

    def __init__(self, name: str, arguments: Sequence[str], wide: bool) -> None:
        self.traced = _Traced()
        self.wide = wide
        self.w = Writer(name, [("i64", "count"), *(("ptr", argument) for argument in arguments)])
        self.kind = self.w.vector if wide else SCALAR

    def load(self, array: str, place: str | int, kind: str | None = None) -> str:
        kind = kind or self.kind
        return self.w.load(kind, self.w.at(kind, f"%{array}", place))

    def values(
        self, outputs: Sequence[Expression], leaves: dict[int, str], vectors: Sequence[int]
    ) -> list[str]:
        """Names of the computed outputs; leaves: symbol index → name of its value."""
        computed = self.w.block(self.traced.graph, outputs, leaves, vectors)
        return [self.w.as_vector(kind, name) if self.wide else name for kind, name in computed]

    def step(self, instant: str) -> dict[int, str]:
        key = self.w.value(f"sext i32 {self.load('key', instant, 'i32')} to i64")
        row = self.w.integer("mul", key, _COEFFICIENTS)
        return {
            symbol.index: self.load("table", self.w.integer("add", row, c), SCALAR)
            for c, symbol in enumerate(self.traced.coefficients)
        }


def _filter_text(name: str, wide: bool) -> str:
    """`name(count, key, table, variances, share, residual, seen, added, shape, innovation, …)`.

    Writes innovations and their variances (T, lanes), and without `wide` also P H' (T, n), the predicted
    error (T,) and the state after each reading (T, n).
    """
    outputs = ("innovation", "variance", *(() if wide else ("reach", "predicted", "state")))
    e = _FilterEmission(name, (*_ARRAYS, *outputs), wide)
    t, w = e.traced, e.w
    constants = {symbol.index: e.load("variances", i) for i, symbol in enumerate(t.variances)}
    constants |= {symbol.index: e.load("share", j, SCALAR) for j, symbol in enumerate(t.share)}
    wide_leaves = [symbol.index for symbol in (*t.variances, *t.x, *t.p)] if wide else []
    zero = "zeroinitializer" if wide else "0.0"
    state = {symbol.index: w.slot(e.kind, zero) for symbol in t.x}
    resting = e.values([t.graph.lift(t.resting[i][j]) for i, j in t.places], constants, wide_leaves)
    spread = {symbol.index: w.slot(e.kind, value) for symbol, value in zip(t.p, resting, strict=True)}
    with w.loop("%count") as k:
        leaves = constants | e.step(k)
        leaves |= {i: w.load(e.kind, slot) for i, slot in (state | spread).items()}
        leaves |= {
            t.residual.index: e.load("residual", k, SCALAR), t.seen.index: e.load("seen", k, SCALAR),
            t.added.index: e.load("added", k, SCALAR), t.shape.index: e.load("shape", k, SCALAR),
        }  # fmt: skip
        predicted, covariance = t.predicted_state(), t.predicted_covariance()
        innovation = t.residual - predicted[-1]
        variance = t.variances[0] * t.shape + covariance[-1][-1]
        share = t.seen / variance
        state_after = [x + covariance[i][-1] * (share * innovation) for i, x in enumerate(predicted)]
        covariance_after = [
            covariance[i][j] - covariance[i][-1] * (share * covariance[j][-1]) for i, j in t.places
        ]
        reported = [innovation, variance]
        reported += [] if wide else [*(row[-1] for row in covariance), predicted[-1]]
        values = e.values([*reported, *state_after, *covariance_after], leaves, wide_leaves)
        w.store(e.kind, values[0], w.at(e.kind, "%innovation", k))
        w.store(e.kind, values[1], w.at(e.kind, "%variance", k))
        if not wide:
            row = w.integer("mul", k, _STATES)
            for i in range(_STATES):
                w.store(SCALAR, values[2 + i], w.at(SCALAR, "%reach", w.integer("add", row, i)))
            w.store(SCALAR, values[2 + _STATES], w.at(SCALAR, "%predicted", k))
            for i in range(_STATES):
                w.store(SCALAR, values[len(reported) + i], w.at(SCALAR, "%state", w.integer("add", row, i)))
        for slot, value in zip([*state.values(), *spread.values()], values[len(reported) :], strict=True):
            w.store(e.kind, value, slot)
    return w.text()


def _whiten_text() -> str:
    """`whiten(count, key, table, gain, scale, columns)`: replaces LANES columns (T, LANES) by their
    innovations under known gains (T, n), times `scale` (T,)."""
    e = _FilterEmission("whiten", ("key", "table", "gain", "scale", "columns"), True)
    t, w = e.traced, e.w
    state = {symbol.index: w.slot(e.kind, "zeroinitializer") for symbol in t.x}
    vectors = [t.residual.index, *state]
    with w.loop("%count") as k:
        row = w.integer("mul", k, _STATES)
        leaves = e.step(k) | {i: w.load(e.kind, slot) for i, slot in state.items()}
        leaves |= {
            symbol.index: e.load("gain", w.integer("add", row, i), SCALAR) for i, symbol in enumerate(t.gain)
        }
        leaves |= {t.residual.index: e.load("columns", k), t.scale.index: e.load("scale", k, SCALAR)}
        predicted = t.predicted_state()
        innovation = t.residual - predicted[-1]
        state_after = [x + symbol * innovation for x, symbol in zip(predicted, t.gain, strict=True)]
        values = e.values([innovation * t.scale, *state_after], leaves, vectors)
        w.store(e.kind, values[0], w.at(e.kind, "%columns", k))
        for slot, value in zip(state.values(), values[1:], strict=True):
            w.store(e.kind, value, slot)
    return w.text()


def _smooth_text() -> str:
    """`smooth(count, key, table, gain, share, innovation, reach, smoothed)`: a backward pass that adds the
    corrections by later readings to the predicted errors in `smoothed` (T,)."""
    e = _FilterEmission("smooth", ("key", "table", "gain", "share", "innovation", "reach", "smoothed"), False)
    t, w = e.traced, e.w
    state = {symbol.index: w.slot(SCALAR, "0.0") for symbol in t.x}
    reach = [t.graph.symbol(f"c{i}") for i in range(_STATES)]
    with w.loop("%count", backwards=True) as k:
        row = w.integer("mul", k, _STATES)
        leaves = e.step(k) | {i: w.load(SCALAR, slot) for i, slot in state.items()}
        for array, symbols in (("gain", t.gain), ("reach", reach)):
            leaves |= {
                symbol.index: e.load(array, w.integer("add", row, i), SCALAR)
                for i, symbol in enumerate(symbols)
            }
        leaves |= {t.residual.index: e.load("innovation", k), t.scale.index: e.load("share", k)}
        # adjoint r ← H' e/S + (I − K H)' r, then F' r for the preceding instant
        corrected = sum((symbol * x for symbol, x in zip(t.gain, t.x, strict=True)), t.graph.constant(0.0))
        adjoint = [*t.x[:-1], t.x[-1] - corrected + t.scale * t.residual]
        change = sum((symbol * x for symbol, x in zip(reach, adjoint, strict=True)), t.graph.constant(0.0))
        adjoint_before = [row[0] for row in product(transpose(t.transition), [[x] for x in adjoint])]
        values = e.values([change, *adjoint_before], leaves, [])
        at = w.at(SCALAR, "%smoothed", k)
        w.store(SCALAR, w.real("fadd", w.load(SCALAR, at), values[0]), at)
        for slot, value in zip(state.values(), values[1:], strict=True):
            w.store(SCALAR, value, slot)
    return w.text()


@cache
def _code() -> CompiledCode:
    texts = (_filter_text("scores", True), _filter_text("filter", False), _whiten_text(), _smooth_text())
    return CompiledCode(declarations() + "".join(texts), ["scores", "filter", "whiten", "smooth"])


# -- filter, likelihood, scoring -----------------------------------------------------------------------------
@dataclass(frozen=True)
class Filtered:
    """An error (T,) filtered under variances (7,) (R, s_w², s_1² …).

    innovation, variance: (T,) of the readings, the innovation NaN without a reading; reach: (T, n) P H', the
    predicted covariance of the state with the error; predicted: (T,) predicted error; state: (T, n) state
    after each reading.
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
        """(T,) contribution of each reading to −2 ln L; 0 without a reading."""
        e = self.standardised
        return np.where(np.isfinite(e), np.log(self.variance) + loss(e, self.bound), 0.0)

    @property
    def weight(self) -> np.ndarray:
        """(T,) weight of each innovation in least squares; 0 without a reading."""
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
    """Huber's loss: e² up to the bound b, 2 b |e| − b² beyond."""
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
    is_present = np.isfinite(residual)
    arrays = (
        course.key, course.table, np.ascontiguousarray(variances, dtype=float), shares(course.tau_h),
        np.where(is_present, residual, 0.0), is_present.astype(float), course.added, course.shape,
    )  # fmt: skip
    return arrays, is_present


def start_variances(course: Instants, residual: np.ndarray) -> np.ndarray:
    """Start values (7,): 0.05 of the error's variance as noise, 0.1 as white flow, the rest in equal shares
    over the resolved parts."""
    total = max(float(np.nanvar(residual)), 1e-12)
    variances = np.zeros(VARIANCES)
    variances[:2] = 0.05 * total, 0.1 * total
    variances[2:] = np.where(
        course.there, 0.85 * total / max(course.there.sum(), 1) / shares(course.tau_h), 0.0
    )
    return variances


def maximised(course: Instants, residual: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """Variances (7,) that maximise the likelihood of an error (T,), by Fisher scoring."""
    upper = np.full(VARIANCES, course.largest)
    upper[2:] = course.largest / shares(course.tau_h)
    active = np.append([True, True], course.there)
    common = start_variances(course, residual)
    initial = common if start is None else start
    lowest = np.log(LEAST_VARIANCE * upper)
    log_common = np.log(np.maximum(common, LEAST_VARIANCE * upper))
    z = np.clip(np.log(np.maximum(np.where(active, initial, 1.0), 1e-300)), lowest, np.log(upper))
    damping, value, gradient, information = 1e-3, *_scores(course, residual, z, active)
    is_near = False
    for _ in range(_STEPS):
        outward = ((z <= lowest + 1e-9) & (gradient > 0)) | ((z >= np.log(upper) - 1e-9) & (gradient < 0))
        free = active & ~outward
        if not free.any():
            break
        matrix = information[np.ix_(free, free)]
        # the gradient of a small variance vanishes with the variance and its information with the square: the
        # prior weight must vanish alike, or the variance could not grow
        prior_weight = 0.5 * np.where(gradient < 0.0, np.minimum(1.0, np.exp(z - log_common)), 1.0)[free] ** 2
        matrix = matrix + np.diag(damping * np.diag(matrix) + prior_weight)
        step = np.zeros(VARIANCES)
        step[free] = np.clip(-np.linalg.solve(matrix, gradient[free]), -_STEP, _STEP)
        if is_near and step.max() < _STEP:
            break
        trial_z = np.clip(z + step, lowest, np.log(upper))
        trial_scores = _scores(course, residual, trial_z, active)
        if not trial_scores[0] < value:
            damping *= 8.0
            if damping > 1e6:
                break
            continue
        gain = value - trial_scores[0]
        z, (value, gradient, information) = trial_z, trial_scores
        is_near = gain < _GAIN and damping < 0.05
        damping = max(damping / 5.0, 1e-6)
    return np.where(active, np.exp(z), 0.0)


def _scores(
    course: Instants, residual: np.ndarray, z: np.ndarray, active: np.ndarray, bound: float = HUBER
) -> tuple[float, np.ndarray, np.ndarray]:
    """−2 ln L, its gradient (7,) and its expected information (7, 7) in the log variances.

    The eight lanes run at z and at z with each log variance increased by `_MOVE`.
    """
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


def forecast_weights(course: Instants, horizon_h: np.ndarray) -> np.ndarray:
    """Weights (k, n) of the state's components in the error that is expected after k horizons [h]."""
    rows = np.stack([coefficients(float(hours), course.tau_h) for hours in horizon_h])
    return np.column_stack([rows[:, len(TIMES_H) : -1], rows[:, -1]])
