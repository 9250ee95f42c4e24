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
"""Standard deviations beyond which an innovation counts linearly instead of squared."""
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
    """The instants at which an error is observed, and the error process between them.

    time_h: (T,) [h].  tau_h: [h] time constant of the cabinet's low pass.
    added: (T,) variance added to the state n where it is unknown: at the start and after gaps.
    key: (T,) row of each step in `table` (d, 2m+1), which holds the coefficients of each distinct step.
    is_resolved: (m,) whether the readings resolve a part of the process.
    shape: (T,) noise variance of each reading as a multiple of R.
    largest: variance of the readings; no part may exceed it at the output.
    """

    time_h: np.ndarray
    tau_h: float
    added: np.ndarray
    key: np.ndarray
    table: np.ndarray
    is_resolved: np.ndarray
    shape: np.ndarray
    largest: float


def course(
    time_h: np.ndarray, tau_h: float, added: np.ndarray, shape: np.ndarray | None = None,
    is_resolved: np.ndarray | None = None, largest: float = math.inf,
) -> Instants:  # fmt: skip
    """Return the instants of an error with the coefficients of the process between them.

    time_h: (T,) [h].  tau_h, added, shape, largest: as in `Instants`.
    is_resolved: (m,) which parts the readings resolve; None: decided from the step and length of the record.
    """
    steps = np.round(np.diff(time_h, prepend=time_h[0]) * 3.6e6) / 3.6e6
    lengths, key = np.unique(steps, return_inverse=True)
    if is_resolved is None:
        usual_step_h = float(np.median(steps[1:])) if len(steps) > 1 else math.inf
        record_h = float(time_h[-1] - time_h[0])
        is_resolved = np.array(
            [FEWEST_STEPS * usual_step_h <= t <= LONGEST_SHARE * record_h for t in TIMES_H]
        )
    table = np.stack([coefficients(length, tau_h) for length in lengths.tolist()])
    shape = np.ones(len(time_h)) if shape is None else np.ascontiguousarray(shape, dtype=float)
    return Instants(
        time_h, tau_h, added, key.reshape(-1).astype(np.int32), table, is_resolved, shape, largest
    )


def coefficients(step_h: float, tau_h: float) -> np.ndarray:
    """Return the coefficients (2m+1,) of one step [h] in the order a_j, g_j, a.

    They are those of u_j ← a_j u_j and n ← a n + Σ g_j u_j: a_j = e^(−dt/θ_j), a = e^(−dt/τ), g_j = a
    (dt/τ)(e^δ − 1)/δ with δ = dt (1/τ − 1/θ_j), which is also regular for θ_j = τ.
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
    """Return the share (m,) θ_j/(θ_j+τ) of each part's variance that passes the low pass."""
    return np.array(TIMES_H) / (np.array(TIMES_H) + tau_h)


def stationary(variances: Sequence[Expression], share: Sequence[Expression]) -> Matrix:
    """Return the stationary covariance (n, n) of the state as expressions.

    variances: (R, s_w², s_1² …).  share: of each part, as `shares` computes it.
    """
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
    """Symbols and expressions of one filter step, from which the compiled passes are written."""

    def __init__(self) -> None:
        """Make the symbols of one step: variances, coefficients, state, covariance, reading."""
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
        """Return the state after a step, before its reading is used."""
        return [row[0] for row in product(self.transition, [[x] for x in self.x])]

    def predicted_covariance(self) -> Matrix:
        """Return the covariance after a step: P∞ + F (P − P∞) F' plus the added variance of n."""
        excess: Matrix = [[0.0] * _STATES for _ in range(_STATES)]
        for (i, j), value in zip(self.places, self.p, strict=True):
            excess[i][j] = excess[j][i] = value - self.resting[i][j]
        predicted = add(self.resting, product(product(self.transition, excess), transpose(self.transition)))
        predicted[-1][-1] = predicted[-1][-1] + self.added
        return predicted


_ARRAYS = ("key", "table", "variances", "share", "residual", "seen", "added", "shape")


class _FilterEmission:
    """Writer of the LLVM text of one compiled pass; `wide`: LANES runs side by side instead of one."""

    def __init__(self, name: str, arguments: Sequence[str], wide: bool) -> None:
        """Begin the text of a function with a count and the named arrays as arguments."""
        self.traced = _Traced()
        self.wide = wide
        self.w = Writer(name, [("i64", "count"), *(("ptr", argument) for argument in arguments)])
        self.kind = self.w.vector if wide else SCALAR

    def load(self, array: str, place: str | int, kind: str | None = None) -> str:
        """Write the loading of an array's element and return the name of its value."""
        kind = kind or self.kind
        return self.w.load(kind, self.w.at(kind, f"%{array}", place))

    def values(
        self, outputs: Sequence[Expression], leaves: dict[int, str], vectors: Sequence[int]
    ) -> list[str]:
        """Write the computation of expressions and return the names of their values.

        leaves: symbol index → name of its value.  vectors: indices of symbols that hold vectors.
        """
        named_values = self.w.block(self.traced.graph, outputs, leaves, vectors)
        return [self.w.as_vector(kind, name) if self.wide else name for kind, name in named_values]

    def step(self, instant: str) -> dict[int, str]:
        """Write the loading of a step's coefficients; returns symbol index → name of its value."""
        key = self.w.value(f"sext i32 {self.load('key', instant, 'i32')} to i64")
        row = self.w.integer("mul", key, _COEFFICIENTS)
        return {
            symbol.index: self.load("table", self.w.integer("add", row, c), SCALAR)
            for c, symbol in enumerate(self.traced.coefficients)
        }


def _filter_text(name: str, wide: bool) -> str:
    """Return the LLVM text of a filter pass.

    The function is `name(count, key, table, variances, share, residual, seen, added, shape, innovation, …)`.
    It writes innovations and their variances (T, lanes); without `wide` also P H' (T, n), the predicted error
    (T,) and the state after each reading (T, n).
    """
    outputs = ("innovation", "variance", *(() if wide else ("reach", "predicted", "state")))
    e = _FilterEmission(name, (*_ARRAYS, *outputs), wide)
    traced, writer = e.traced, e.w
    constants = {symbol.index: e.load("variances", i) for i, symbol in enumerate(traced.variances)}
    constants |= {symbol.index: e.load("share", j, SCALAR) for j, symbol in enumerate(traced.share)}
    wide_leaves = [symbol.index for symbol in (*traced.variances, *traced.x, *traced.p)] if wide else []
    zero = "zeroinitializer" if wide else "0.0"
    state_slots = {symbol.index: writer.slot(e.kind, zero) for symbol in traced.x}
    stationary_values = e.values(
        [traced.graph.lift(traced.resting[i][j]) for i, j in traced.places], constants, wide_leaves
    )
    covariance_slots = {
        symbol.index: writer.slot(e.kind, value)
        for symbol, value in zip(traced.p, stationary_values, strict=True)
    }
    with writer.loop("%count") as k:
        leaves = constants | e.step(k)
        leaves |= {i: writer.load(e.kind, slot) for i, slot in (state_slots | covariance_slots).items()}
        leaves |= {
            traced.residual.index: e.load("residual", k, SCALAR),
            traced.seen.index: e.load("seen", k, SCALAR),
            traced.added.index: e.load("added", k, SCALAR),
            traced.shape.index: e.load("shape", k, SCALAR),
        }
        predicted, covariance = traced.predicted_state(), traced.predicted_covariance()
        innovation = traced.residual - predicted[-1]
        variance = traced.variances[0] * traced.shape + covariance[-1][-1]
        share = traced.seen / variance
        state_after = [x + covariance[i][-1] * (share * innovation) for i, x in enumerate(predicted)]
        covariance_after = [
            covariance[i][j] - covariance[i][-1] * (share * covariance[j][-1]) for i, j in traced.places
        ]
        reported = [innovation, variance]
        reported += [] if wide else [*(row[-1] for row in covariance), predicted[-1]]
        values = e.values([*reported, *state_after, *covariance_after], leaves, wide_leaves)
        writer.store(e.kind, values[0], writer.at(e.kind, "%innovation", k))
        writer.store(e.kind, values[1], writer.at(e.kind, "%variance", k))
        if not wide:
            row = writer.integer("mul", k, _STATES)
            for i in range(_STATES):
                writer.store(
                    SCALAR, values[2 + i], writer.at(SCALAR, "%reach", writer.integer("add", row, i))
                )
            writer.store(SCALAR, values[2 + _STATES], writer.at(SCALAR, "%predicted", k))
            for i in range(_STATES):
                writer.store(
                    SCALAR,
                    values[len(reported) + i],
                    writer.at(SCALAR, "%state", writer.integer("add", row, i)),
                )
        for slot, value in zip(
            [*state_slots.values(), *covariance_slots.values()], values[len(reported) :], strict=True
        ):
            writer.store(e.kind, value, slot)
    return writer.text()


def _whiten_text() -> str:
    """Return the LLVM text of `whiten(count, key, table, gain, scale, columns)`.

    It replaces LANES columns (T, LANES) by their innovations under known gains (T, n), times `scale` (T,).
    """
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
    """Return the LLVM text of `smooth(count, key, table, gain, share, innovation, reach, smoothed)`.

    It is a backward pass, which adds the corrections by later readings to the predicted errors `smoothed`
    (T,).
    """
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
    """Compile the four passes: `scores`, `filter`, `whiten` and `smooth`."""
    texts = (_filter_text("scores", True), _filter_text("filter", False), _whiten_text(), _smooth_text())
    return CompiledCode(declarations() + "".join(texts), ["scores", "filter", "whiten", "smooth"])


# -- filter, likelihood, scoring -----------------------------------------------------------------------------
@dataclass(frozen=True)
class Filtered:
    """An error (T,) after the Kalman filter, under variances (7,) in the order R, s_w², s_1² ….

    innovation, variance: (T,) of the readings; the innovation is NaN without a reading.
    reach: (T, n) P H', the covariance of the state with the error before the reading.
    predicted: (T,) error before the reading.  state: (T, n) after it.
    bound: of Huber's loss, in standard deviations.
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
        """(T,) innovations divided by their standard deviations."""
        return self.innovation / np.sqrt(self.variance)

    @property
    def deviance(self) -> float:
        """−2 ln L, without ln 2π."""
        is_read = np.isfinite(self.innovation)
        variance_column = self.variance[is_read][:, None]
        standardised = self.innovation[is_read][:, None] / np.sqrt(variance_column)
        return float(np.sum(np.log(variance_column) + loss(standardised, self.bound), axis=0)[0])

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
        """Filter further columns (T, c) with the same gains.

        Returns their standardised innovations (T, c), 0 where there is no reading.
        """
        is_read = np.isfinite(self.innovation)
        scale = np.where(is_read, 1.0 / np.sqrt(self.variance), 0.0)
        gain = np.ascontiguousarray(self.gain)
        count, width = columns.shape
        result = np.empty((count, width))
        for first_column in range(0, width, LANES):
            block = np.zeros((count, LANES))
            columns_of_block = columns[:, first_column : first_column + LANES]
            block[:, : columns_of_block.shape[1]] = np.where(is_read[:, None], columns_of_block, 0.0)
            _code()("whiten", count, self.course.key, self.course.table, gain, scale, block)
            result[:, first_column : first_column + LANES] = block[:, : columns_of_block.shape[1]]
        return result

    def smoothed(self) -> np.ndarray:
        """Return the expected error (T,) given all readings, earlier and later."""
        result = self.predicted.copy()
        is_read = np.isfinite(self.innovation)
        inverse_variance = np.where(is_read, 1.0 / self.variance, 0.0)
        innovation = np.where(is_read, self.innovation, 0.0)
        instants = self.course
        _code()(
            "smooth",
            len(result),
            instants.key,
            instants.table,
            np.ascontiguousarray(self.gain),
            inverse_variance,
            innovation,
            np.ascontiguousarray(self.reach),
            result,
        )
        return result


def loss(e: np.ndarray, bound: float = HUBER) -> np.ndarray:
    """Return Huber's loss of standardised innovations: e² up to the bound b, 2 b |e| − b² beyond."""
    size = np.abs(e)
    counted = np.minimum(size, bound)
    return counted * (2.0 * size - counted)


def filtered(
    instants: Instants, variances: np.ndarray, residual: np.ndarray, bound: float = HUBER
) -> Filtered:
    """Filter an error (T,) under variances (7,); the error is NaN where there is no reading."""
    count = len(residual)
    innovation, variance, predicted = (np.empty(count) for _ in range(3))
    reach, state = np.empty((count, _STATES)), np.empty((count, _STATES))
    arguments, is_read = _given(instants, variances, residual)
    _code()("filter", count, *arguments, innovation, variance, reach, predicted, state)
    innovation[~is_read] = np.nan
    return Filtered(instants, variances, innovation, variance, reach, predicted, state, bound)


def _given(
    instants: Instants, variances: np.ndarray, residual: np.ndarray
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Return the arrays that the compiled filter takes, and (T,) whether there is a reading."""
    is_present = np.isfinite(residual)
    filter_arguments = (
        instants.key, instants.table, np.ascontiguousarray(variances, dtype=float), shares(instants.tau_h),
        np.where(is_present, residual, 0.0), is_present.astype(float), instants.added, instants.shape,
    )  # fmt: skip
    return filter_arguments, is_present


def start_variances(instants: Instants, residual: np.ndarray) -> np.ndarray:
    """Return start values of the variances (7,).

    They are 0.05 of the error's variance for noise, 0.1 for white flow, and the rest in equal shares for the
    parts that the readings resolve.
    """
    total = max(float(np.nanvar(residual)), 1e-12)
    variances = np.zeros(VARIANCES)
    variances[:2] = 0.05 * total, 0.1 * total
    variances[2:] = np.where(
        instants.is_resolved, 0.85 * total / max(instants.is_resolved.sum(), 1) / shares(instants.tau_h), 0.0
    )
    return variances


def maximised(instants: Instants, residual: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """Return the variances (7,) with the largest likelihood of an error (T,), found by Fisher scoring.

    start: start values (7,); None: those of `start_variances`.
    """
    upper = np.full(VARIANCES, instants.largest)
    upper[2:] = instants.largest / shares(instants.tau_h)
    active = np.append([True, True], instants.is_resolved)
    default_start = start_variances(instants, residual)
    initial = default_start if start is None else start
    lowest = np.log(LEAST_VARIANCE * upper)
    log_common = np.log(np.maximum(default_start, LEAST_VARIANCE * upper))
    z = np.clip(np.log(np.maximum(np.where(active, initial, 1.0), 1e-300)), lowest, np.log(upper))
    damping, value, gradient, information = 1e-3, *_scores(instants, residual, z, active)
    almost_converged = False
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
        if almost_converged and step.max() < _STEP:
            break
        trial_z = np.clip(z + step, lowest, np.log(upper))
        trial_scores = _scores(instants, residual, trial_z, active)
        if not trial_scores[0] < value:
            damping *= 8.0
            if damping > 1e6:
                break
            continue
        gain = value - trial_scores[0]
        z, (value, gradient, information) = trial_z, trial_scores
        almost_converged = gain < _GAIN and damping < 0.05
        damping = max(damping / 5.0, 1e-6)
    return np.where(active, np.exp(z), 0.0)


def _scores(
    instants: Instants, residual: np.ndarray, z: np.ndarray, active: np.ndarray, bound: float = HUBER
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return −2 ln L, its gradient (7,) and expected information (7, 7) in the log variances z (7,).

    active: (7,) which variances are estimated.  The derivatives are numerical: the eight lanes of one filter
        run hold z and z with each element increased by `_MOVE`.
    """
    lanes = np.repeat(np.where(active, np.exp(z), 0.0)[:, None], LANES, axis=1)
    lanes[np.arange(VARIANCES), np.arange(1, LANES)] *= math.exp(_MOVE)
    count = len(residual)
    innovation, variance = (np.empty((count, LANES)) for _ in range(2))
    arguments, is_read = _given(instants, lanes, residual)
    _code()("scores", count, *arguments, innovation, variance)
    innovation_of_lane, variance_of_lane = innovation[is_read], variance[is_read]
    root = np.sqrt(variance_of_lane[:, 0])
    standardised = innovation_of_lane[:, 0] / root
    log_variance_slope = np.log(variance_of_lane[:, 1:] / variance_of_lane[:, :1]) / _MOVE
    innovation_slope = (innovation_of_lane[:, 1:] - innovation_of_lane[:, :1]) / (_MOVE * root[:, None])
    weight = np.minimum(1.0, bound / np.maximum(np.abs(standardised), 1e-300))
    gradient = (1.0 - weight * standardised * standardised) @ log_variance_slope + 2.0 * (
        weight * standardised
    ) @ innovation_slope
    information = (
        log_variance_slope.T @ log_variance_slope
        + 2.0 * (weight[:, None] * innovation_slope).T @ innovation_slope
    )
    value = float(np.sum(np.log(variance_of_lane[:, 0]) + loss(standardised, bound)))
    return value, gradient, information


def forecast_weights(instants: Instants, horizon_h: np.ndarray) -> np.ndarray:
    """Return the weights (k, n) that turn a state into the error expected after k horizons [h]."""
    rows = np.stack([coefficients(float(hours), instants.tau_h) for hours in horizon_h])
    return np.column_stack([rows[:, len(TIMES_H) : -1], rows[:, -1]])
