"""The filter of a linear model with many states: the expressions and matrices that its compiled loops read.

Straight-line code of a whole step grows with the cube of the number of states, its compile time even faster.
Where rates are constant within a step, the loops of `wide_codegen` therefore read the matrices of every
distinct step as numbers, and only short expressions of the model: the rates at x = 0, which drive the mean,
and prediction, variance and derivatives of every reading.

For dx = (A x + B (u₀ + t u₁)) dt + L dW, Q = L L', a step of length h has

    T = (e^{Ah} − I,  ∫₀ʰ e^{Aσ} B dσ,  ∫₀ʰ (h−σ) e^{Aσ} B dσ),     N = ∫₀ʰ e^{Aσ} Q e^{A'σ} dσ.

Both are power series in the length, whose coefficients are shared by all steps with the same A and Q.  The
series are evaluated for the share h/2^s of the step, which is doubled s times.  With E the left part of T
and G its middle part,

    T ← 2 T + E T + (0, 0, h G),     N ← N + (I + E) N (I + E)'.

I + E is never formed while E is small, so that slow states keep all digits.  Tangents and adjoints
differentiate these recursions.

Source: Van Loan 1978, doi:10.1109/TAC.1978.1101743 (the integrals); Moler & Van Loan 2003,
doi:10.1137/S00361445024180 (scaling and squaring).

Here nothing is emitted: the matrices are numbers, computed by numpy before a loop runs.

- drive: the rates at x = 0, at the start and the end of a step; they act on the *driven* states alone.
- share, doublings: the share h/2^s of a step for which the series are evaluated, and s.
- later: what the loops need of the parameters: nodes of the parameter stage, and the entries of A and Q.
- head: the scalars of a reading's update (`wide_codegen`).
- `_t`, `_plus_transpose`: the transposed matrix, and its sum with the matrix.

Shapes: K distinct steps, U distinct pairs of A and Q, n states, r directions, c driven states, d parameters,
e entries of the drive, w = `width` (in `StepSeries` and `Powers`: n + 2 c, the columns of T), L directions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hygrokf.engine.discretisation import constant_rates
from hygrokf.engine.step_codegen import DOUBLINGS, seed
from hygrokf.engine.timeline import Timeline
from hygrokf.engine.traced_filter import INSTANT, KEY, Block, Recursion, traced
from hygrokf.engine.wide_products import ROWS, padded
from hygrokf.physics.expression import Expression, Value, forward, is_zero, jacobian, reverse
from hygrokf.physics.holds import LINEAR
from hygrokf.physics.matrices import dot
from hygrokf.physics.model import Model, Values

SHORT = 1.0
"""[1] largest product of the bound of the rates and the length for which the series are evaluated."""
SERIES_ORDER = 20
"""Degree of the series: remainder 2e-20."""


# -- matrices of whole steps, as numbers ---------------------------------------------------------------------
@dataclass(frozen=True)
class StepSeries:
    """Coefficients of T (U, n, w) and N (U, n, n), for powers of the length in 1/`rate` (U, 1, 1)."""

    a: np.ndarray
    rate: np.ndarray
    rows: list[np.ndarray]
    spreads: list[np.ndarray]

    def tangents(self, da: np.ndarray, dq: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Derivatives of the coefficients along those of A and Q, (U, r, n, n) each."""
        a, n = self.a[:, None], self.a.shape[-1]
        da, ds = da / self.rate[:, None], dq / self.rate[:, None]
        dr = np.zeros((*da.shape[:-1], self.rows[0].shape[-1]))
        dr[..., :n] = da
        rows, spreads = [dr], [ds]
        for k, (row, spread) in enumerate(zip(self.rows[:-1], self.spreads[:-1], strict=True), 2):
            dr = (da @ row[:, None] + a @ dr) / k
            ds = _plus_transpose(da @ spread[:, None] + a @ ds) / k
            rows.append(dr)
            spreads.append(ds)
        return rows, spreads

    def adjoints(
        self, row_bars: list[np.ndarray], spread_bars: list[np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Adjoints (U, n, n) of A and Q from those of the coefficients."""
        a, a_bar = self.a, np.zeros_like(self.a)
        row_bar, spread_bar = row_bars[-1], spread_bars[-1]
        for k in range(len(self.rows), 1, -1):
            a_bar += (row_bar @ _t(self.rows[k - 2]) + 2.0 * spread_bar @ self.spreads[k - 2]) / k
            row_bar = row_bars[k - 2] + _t(a) @ row_bar / k
            spread_bar = spread_bars[k - 2] + _plus_transpose(_t(a) @ spread_bar) / k
        return (a_bar + row_bar[..., : a.shape[-1]]) / self.rate, spread_bar / self.rate


def series(a: np.ndarray, q: np.ndarray, b: np.ndarray) -> StepSeries:
    """The coefficients for A, Q (U, n, n) [1/h] and a constant B (n, c)."""
    (n, c), rate = b.shape, bound(a)[:, None, None]
    rate = np.where(rate > 0.0, rate, 1.0)
    a, drive = a / rate, b / rate
    row = np.concatenate([a, drive, np.zeros_like(drive)], axis=2)
    rows, spreads = [row], [q / rate]
    for k in range(2, SERIES_ORDER + 1):
        row = a @ row
        if k == 2:
            row[..., n + c :] = drive / rate
        row = row / k
        rows.append(row)
        spreads.append(_plus_transpose(a @ spreads[-1]) / k)
    return StepSeries(a, rate, rows, spreads)


@dataclass(frozen=True)
class Powers:
    """T (K, n, w) as `whole` and N (K, n, n) as `noise` of steps with the same number of doublings.

    `which` (K,): index of each step's series; `share` (K, 1, 1): length at which the series is evaluated, in
    units of 1/rate; `stages`: T, N and the length before each doubling.
    """

    series: StepSeries
    which: np.ndarray
    share: np.ndarray
    stages: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    whole: np.ndarray
    noise: np.ndarray

    def tangents(self, rows: list[np.ndarray], spreads: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (K, r, n, w) and (K, r, n, n) of T and N from those of the coefficients."""
        n = self.whole.shape[-2]
        change, gained = (
            _evaluate(coefficients, self.which, self.share[:, None]) for coefficients in (rows, spreads)
        )
        for whole, noise, hours in self.stages:
            e, de = whole[:, None, :, :n], change[..., :n]
            f = np.eye(n) + e
            gained = gained + f @ gained @ _t(f) + _plus_transpose(de @ (noise[:, None] @ _t(f)))
            change = 2.0 * change + de @ whole[:, None] + e @ change + _ramp(change, n, hours[:, None])
        return change, gained

    def adjoints(self, bar: np.ndarray, noise_bar: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Adjoints of the coefficients from those of T (K, n, w) and N (K, n, n), the latter symmetric."""
        n = self.whole.shape[-2]
        c = (bar.shape[-1] - n) // 2
        for whole, noise, hours in reversed(self.stages):
            e = whole[..., :n]
            transition = np.eye(n) + e
            before = 2.0 * bar + _t(e) @ bar
            before[..., n : n + c] += hours * bar[..., n + c :]
            before[..., :n] += bar @ _t(whole) + 2.0 * noise_bar @ transition @ noise
            bar, noise_bar = before, noise_bar + _t(transition) @ noise_bar @ transition
        chosen = np.arange(len(self.series.a))[:, None] == self.which
        factors = [chosen * self.share[:, 0, 0] ** k for k in range(1, SERIES_ORDER + 1)]
        rows, spreads = ([np.tensordot(f, adjoint, 1) for f in factors] for adjoint in (bar, noise_bar))
        return rows, spreads


def powers(series_: StepSeries, which: np.ndarray, hours: np.ndarray) -> Iterator[tuple[np.ndarray, Powers]]:
    """Yield, for each number of doublings, the indices of its steps among the K, and the steps' matrices.

    which: (K,) index of the pair of A and Q of each step; hours: (K,) [h].
    """
    stretch = series_.rate[which, 0, 0] * hours
    doublings = np.ceil(np.log2(np.maximum(stretch / SHORT, 1.0))).astype(int)
    for count in np.unique(doublings).tolist():
        indices = np.flatnonzero(doublings == count)
        shrink = 2.0**-count
        share, length = stretch[indices, None, None] * shrink, hours[indices, None, None] * shrink
        whole, noise = (
            _evaluate(coefficients, which[indices], share) for coefficients in (series_.rows, series_.spreads)
        )
        n, stages = noise.shape[-1], []
        for i in range(count):
            stages.append((whole, noise, length * 2.0**i))
            e = whole[..., :n]
            f = np.eye(n) + e
            noise = noise + f @ noise @ _t(f)
            whole = 2.0 * whole + e @ whole + _ramp(whole, n, length * 2.0**i)
        yield indices, Powers(series_, which[indices], share, stages, whole, noise)


def _evaluate(coefficients: list[np.ndarray], which: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Σ_k share^k c_k, the smallest terms first."""
    total = np.zeros(())
    for coefficient in reversed(coefficients):
        total = (total + coefficient[which]) * share
    return total


def bound(a: np.ndarray) -> np.ndarray:
    """Upper bound (K,) of the eigenvalues' size of matrices (K, n, n), near the spectral radius of |A|.

    For every positive v, max (|A| v)_i / v_i is such a bound (Collatz 1942, doi:10.1007/BF01180013).  It
    is the norm of |A| weighted by v, so that series in A converge as series in this number do.
    """
    size = np.abs(a)
    v = np.ones((*a.shape[:-1], 1))
    for _ in range(16):  # averaging with the old vector keeps all entries positive and prevents oscillation
        grown = size @ v
        v = 0.5 * (v + grown / np.maximum(grown.max(axis=-2, keepdims=True), np.finfo(float).tiny))
    return np.asarray((size @ v / v).max(axis=(-2, -1)))


def _ramp(whole: np.ndarray, n: int, hours: np.ndarray) -> np.ndarray:
    """(0, 0, h G) of a T."""
    c = (whole.shape[-1] - n) // 2
    moved = np.zeros_like(whole)
    moved[..., n + c :] = hours * whole[..., n : n + c]
    return moved


def _t(matrix: np.ndarray) -> np.ndarray:
    """The transposed matrices (…, n, m)."""
    return np.swapaxes(matrix, -1, -2)


def _plus_transpose(matrix: np.ndarray) -> np.ndarray:
    """The sum of a matrix and its transpose."""
    return matrix + _t(matrix)


FEW = 8
"""States up to which straight-line code compiles quickly and runs faster than loops."""

KEYS = 512
"""Largest number of distinct steps whose matrices and derivatives are in memory at a time."""


# -- what the loops take from the model ----------------------------------------------------------------------
class WideRecursion(Recursion):
    """A filter whose loops take matrices.

    `predict`: entries b of the drive, so that m⁺ = F m + Σ_e w_e b_e, with the columns w_e by `columns`
    (state, share of ∫e^{Aσ}, share of ∫(h−σ)e^{Aσ}/h).  `updates`: prediction, variance and non-zero
    derivatives (`reads`: of these states) of every reading.  `heads`: innovation, its variance, e²/S, the
    factor g of P⁺ = P − g c c' and p of m⁺ = m + p c, with c = P H', as functions of the `leaves`: symbols of
    prediction, variance, and the entries of H and c.
    """

    wide = True

    def _trace(self) -> None:
        """Trace the rates; where they are constant within a step, also the drive, and prediction, variance,
        derivatives and head of every reading."""
        g, model = self.graph, self.model
        at = model.traced(self.mean, self.now, self.p)
        self.rates = [g.lift(v) for v in at.rates]
        self.jacobian = jacobian(self.rates, self.mean)
        self.predict, self.updates, self.transition = [], [], []
        self.columns: list[tuple[int, float, float]] = []
        self.reads: list[list[int]] = []
        self.leaves: list[Block] = []
        self.heads: list[Block] = []
        rising = [self.now[name] for name in self.varying if self.holds[name] == LINEAR]
        rows = [*self.jacobian, *self.noise]
        self.exact = constant_rates(self.graph, rows, self._changing, self.rates, rising)
        if not self.exact:
            return
        self.predict, self.columns = self._drive()
        for name in model.outputs:
            prediction, variance = (g.lift(v) for v in at.outputs[name])
            row = jacobian([prediction], self.mean)[0]
            self.reads.append([i for i, v in enumerate(row) if not is_zero(v)])
            self.updates.append([prediction, variance, *(g.lift(row[i]) for i in self.reads[-1])])
            self._trace_head()

    def _drive(self) -> tuple[Block, list[tuple[int, float, float]]]:
        """Trace the drive, and by which weights each entry acts (`columns`): the rates at x = 0 at the start
        and the end of a step; a rate that is equal at both enters once."""
        g = self.graph
        origin = {m.index: g.constant(0.0) for m in self.mean}
        rates = []
        for inputs in (self.start, self.end):
            at = {self.now[n].index: inputs[n] for n in self.varying}
            rates.append(g.substitute(self.rates, origin | at))
        block, columns = [], []
        for i, (early, late) in enumerate(zip(*rates, strict=True)):
            if early.index == late.index:
                entries = [(early, 1.0, 0.0)]
            else:
                entries = [(early, 1.0, -1.0), (late, 0.0, 1.0)]
            for e, whole, ramp in entries:
                if not is_zero(e):
                    block.append(e)
                    columns.append((i, whole, ramp))
        return block, columns

    def _trace_head(self) -> None:
        """Trace the scalars of an update; symbols stand for the numbers that the loops compute with
        matrices."""
        g, c = self.graph, len(self.heads)
        row = self.updates[c][2:]
        prediction, variance = (g.symbol(f"{word}:{c}") for word in ("prediction", "variance"))
        cross = [g.symbol(f"cross:{c}:{i}") for i in range(len(row))]
        slopes = [g.symbol(f"row:{c}:{i}") for i in range(len(row))]
        spread = g.lift(dot(slopes, cross) + variance)
        inverse = 1.0 / spread
        error = self.reading - prediction
        quadratic = error * error * inverse
        gain = self._weight(quadratic) * inverse
        self.leaves.append([prediction, variance, *slopes, *cross])
        self.heads.append([error, spread, quadratic, g.lift(gain), g.lift(gain * error)])

    @cached_property
    def _blocks(self) -> list[Block]:
        return [self.predict, *self.updates]

    @cached_property
    def stage(self) -> list[int]:
        """For every node, the earliest stage at which its value is known, as in `Recursion`.

        What a filter of few states computes for each key, from the regimes, is computed here at every
        instant: in these loops the table of keys holds only the matrices of the steps.
        """
        return [INSTANT if stage == KEY else stage for stage in super().stage]

    # -- sizes -----------------------------------------------------------------------------------------------
    @property
    def width(self) -> int:
        """Numbers in a row of a matrix, padded to whole vectors."""
        return padded(self.n)

    @property
    def rows(self) -> int:
        """Rows of a matrix, padded to whole tiles; columns of a matrix of vectors."""
        return padded(self.n, ROWS)

    @property
    def held(self) -> int:
        """Rows of the moments: the rows of P and the row m', padded."""
        return padded(self.n + 1, ROWS)

    def cuts(self, timeline: Timeline) -> Iterable[int]:
        """Instants between which a run of many distinct steps has at most `KEYS` of them."""
        return range(KEYS, len(timeline), KEYS) if len(timeline.steps) > KEYS else ()

    # -- numbers ---------------------------------------------------------------------------------------------
    @cached_property
    def _entries(self) -> tuple[list[int], Block]:
        """Places of the non-zero entries of A and Q in (2, n, n), and their expressions."""
        values = [v for matrix in (self.jacobian, self.noise) for row in matrix for v in row]
        nonzero = [(i, self.graph.lift(v)) for i, v in enumerate(values) if not is_zero(v)]
        return [i for i, _ in nonzero], [v for _, v in nonzero]

    @cached_property
    def _later(self) -> Block:
        """Nodes of the parameter stage that the loops read, and the entries of A and Q."""
        return [*(Expression(self.graph, i) for i in self.parameter_nodes), *self._entries[1]]

    @cached_property
    def _tangents(self) -> Block:
        """Derivatives of `_later` along directions with the symbols `dot:`."""
        dots = {e.index: self.graph.symbol(f"dot:{e.index}") for e in self.p.values()}
        return forward(self.graph, self._later, dots)

    @cached_property
    def _adjoints(self) -> dict[int, Expression]:
        """Adjoints of the parameters, given those of `_later` with the symbols `bar:`."""
        seeds: dict[int, Expression] = {}
        for i, e in enumerate(self._later):
            seed(seeds, e, self.graph.symbol(f"bar:{i}"))
        return reverse(self.graph, seeds, [e.index for e in self.p.values()])

    @cached_property
    def _driven(self) -> list[int]:
        """Indices of the states that the drive acts on."""
        return sorted({i for i, _, _ in self.columns})

    def _known(self, values: Values, keys: np.ndarray) -> dict[str, Value]:
        """Parameters and regimes by the names of their symbols."""
        regimes = {f"g:{name}": keys[:, 1 + i] for i, name in enumerate(self.regimes)}
        return self.symbols(values) | regimes

    def _split(self, numbers: Sequence[Value], shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Split the numbers of `_later` into nodes (…, nodes), without the keys' axis, and A and Q (2, …, n,
        n)."""
        count = len(self.parameter_nodes)
        nodes = [np.broadcast_to(v, shape[:0:-1])[..., None] for v in numbers[:count]]
        matrices = np.zeros((2 * self.n**2, *shape))
        for index, value in zip(self._entries[0], numbers[count:], strict=True):
            matrices[index] = value
        node_numbers = np.concatenate(nodes, axis=-1) if nodes else np.zeros((*shape[:0:-1], 0))
        return node_numbers, np.moveaxis(matrices.reshape(2, self.n, self.n, *shape), (1, 2), (-2, -1))

    def _weights(self, hours: np.ndarray) -> np.ndarray:
        """(K, 2 c, e) by which the columns w_e follow from the middle and the right part of T."""
        weights = np.zeros((len(hours), 2 * len(self._driven), len(self.columns)))
        for e, (i, whole, ramp) in enumerate(self.columns):
            c = self._driven.index(i)
            weights[:, c, e] = whole
            weights[:, len(self._driven) + c, e] = ramp / np.where(hours > 0, hours, 1.0)
        return weights

    def numbers(self, values: Values, keys: np.ndarray) -> Numbers | None:
        """The numbers that the loops and their derivatives read for some keys (K, 1 + regimes); None where
        rates are not finite, or too large."""
        first, which = np.zeros(1, dtype=int), np.zeros(len(keys), dtype=int)
        if self.regimes:
            _, first, which = np.unique(keys[:, 1:], axis=0, return_index=True, return_inverse=True)
        with np.errstate(all="ignore"):
            found = self.graph.evaluate(self._later, self._known(values, keys[first]))
            nodes, (a, q) = self._split(found, (len(first),))
            coefficients = series(a, q, np.eye(self.n)[:, self._driven])
            if not float(coefficients.rate.max() * keys[:, 0].max()) <= 2.0**DOUBLINGS:
                return None
        steps = list(powers(coefficients, which.reshape(-1), keys[:, 0]))
        nodes = np.ascontiguousarray(nodes)
        return Numbers(self, values, keys, keys[first], nodes, coefficients, steps)


@dataclass(frozen=True)
class Numbers:
    """The numbers that the loops read in one pass, at the parameters `values` and for the `keys`.

    `distinct` (U, 1 + regimes): one key for each combination of regimes; `nodes`: numbers of the parameter
    stage; `series`: of each of these combinations; `steps`: (indices of keys, their matrices) for each number
    of doublings.
    """

    recursion: WideRecursion
    values: Values
    keys: np.ndarray
    distinct: np.ndarray
    nodes: np.ndarray
    series: StepSeries
    steps: Sequence[tuple[np.ndarray, Powers]]

    @cached_property
    def table(self) -> np.ndarray:
        """F, F', N and the columns w_e as rows, (K, 3 w + e, w)."""
        r, n, w = self.recursion, self.recursion.n, self.recursion.width
        table = aligned(len(self.keys), 3 * w + len(r.columns), w)
        for indices, p in self.steps:
            rows = np.zeros((len(indices), *table.shape[1:]))
            rows[:, :n, :n] = np.eye(n) + p.whole[..., :n]
            rows[:, w : w + n, :n] = np.swapaxes(rows[:, :n, :n], 1, 2)
            rows[:, 2 * w : 2 * w + n, :n] = p.noise
            columns = p.whole[..., n:] @ r._weights(self.keys[indices, 0])
            rows[:, 3 * w :, :n] = np.swapaxes(columns, 1, 2)
            table[indices] = rows
        return table

    def tangents(self, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives along the directions `seeds` (d, L): of the nodes (nodes, L); of F', N and the columns
        as rows (K, 2 rows + e, rows, L)."""
        r, n, rows = self.recursion, self.recursion.n, self.recursion.rows
        symbol_values = r._known(self.values, self.distinct[:, :, None])
        symbol_values |= {f"dot:{e.index}": dot for e, dot in zip(r.p.values(), seeds, strict=True)}
        shape = (len(self.distinct), seeds.shape[1])
        nodes, (da, dq) = r._split(r.graph.evaluate(r._tangents, symbol_values), shape)
        coefficients = self.series.tangents(da, dq)
        dots = aligned(len(self.keys), 2 * rows + len(r.columns), rows, seeds.shape[1])
        for indices, p in self.steps:
            change, gained = p.tangents(*coefficients)
            block = np.zeros((len(indices), *dots.shape[1:]))
            block[:, :n, :n] = np.moveaxis(change[..., :n], (1, 2, 3), (3, 2, 1))
            block[:, rows : rows + n, :n] = np.moveaxis(gained, 1, -1)
            columns = change[..., n:] @ r._weights(self.keys[indices, 0])[:, None]
            block[:, 2 * rows :, :n] = np.moveaxis(columns, (1, 2, 3), (3, 2, 1))
            dots[indices] = block
        return np.ascontiguousarray(nodes.T), dots

    def adjoints(self, node_bars: np.ndarray, bars: np.ndarray) -> np.ndarray:
        """Adjoints (d,) of the parameters from the adjoints of the nodes and of the table, which holds half
        of the adjoint of F, and the adjoints of N and of the columns."""
        r, n, w = self.recursion, self.recursion.n, self.recursion.width
        entries = np.zeros((len(self.distinct), 2, n, n))
        for indices, p in self.steps:
            table_bars = bars[indices, :, :n]
            driven = r._weights(self.keys[indices, 0]) @ table_bars[:, 3 * w :]
            bar = np.concatenate([2.0 * table_bars[:, :n], np.swapaxes(driven, 1, 2)], axis=2)
            coefficients = p.adjoints(bar, table_bars[:, 2 * w : 2 * w + n])
            entries += np.stack(self.series.adjoints(*coefficients), axis=1)
        # a node of the parameter stage is one number for all keys: its adjoint is assigned to the first key
        first = np.zeros((len(node_bars), len(entries)))
        first[:, :1] = node_bars[:, None]
        later_bars = [*first, *entries.reshape(len(entries), -1).T[r._entries[0]]]
        symbols = r._known(self.values, self.distinct) | {f"bar:{i}": bar for i, bar in enumerate(later_bars)}
        bars_of = dict(zip(r._adjoints, r.graph.evaluate(list(r._adjoints.values()), symbols), strict=True))
        return np.array([float(np.sum(bars_of.get(e.index, 0.0))) for e in r.p.values()])


def aligned(*shape: int) -> np.ndarray:
    """Zeros aligned to 64 bytes, so that vectors do not cross a cache line."""
    count = math.prod(shape)
    raw = np.zeros(count + 8)
    first = -raw.ctypes.data % 64 // 8
    return raw[first : first + count].reshape(shape)


def recursion_of(model: Model, unknown: int = 0, factored: bool = False) -> Recursion:
    """The filter of a model: with matrices where it has more than `FEW` states, a proper start, plain
    covariances and exact steps of any length, else straight-line code."""
    if len(model.states) <= FEW or unknown or factored:
        return traced(model, unknown, factored)
    # cached on the model, as in `traced`
    cached: list[WideRecursion] = vars(model).setdefault("_wide", [])
    if not cached:
        cached.append(WideRecursion(model))
    return cached[0] if cached[0].exact else traced(model)
