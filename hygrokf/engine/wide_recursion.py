"""The filter of a linear model with many states: what its compiled loops take from the model, as expressions.

Straight-line code of a whole step grows with the cube of the number of states, and its compilation faster.
Where rates are constant within a step, the loops of `wide_codegen` therefore take the matrices of every
distinct step as numbers, and from the model only the expressions that are short: the rates at
x = 0 that drive the mean, and prediction, variance and derivative of every reading.

For dx = (A x + B (u₀ + t u₁)) dt + L dW, Q = L L', a step of length h has

    T = (e^{Ah} − I,  ∫₀ʰ e^{Aσ} B dσ,  ∫₀ʰ (h−σ) e^{Aσ} B dσ),     N = ∫₀ʰ e^{Aσ} Q e^{A'σ} dσ.

Both are power series in the length.  A share h/2^s of the step takes them, whose coefficients all steps with
the same A and Q have in common, and is doubled s times: with E the left part of T, G its middle,

    T ← 2 T + E T + (0, 0, h G),     N ← N + (I + E) N (I + E)'.

I + E is never formed while E is small, so that slow states keep all digits.  Tangents and adjoints
differentiate these recursions.

Source: Van Loan 1978, doi:10.1109/TAC.1978.1101743 (the integrals); Moler & Van Loan 2003,
doi:10.1137/S00361445024180 (scaling and squaring).

Shapes: K distinct steps, U distinct pairs of A and Q, n states, r directions, c driven states, d parameters,
e entries of the drive, w = `width`, L directions.
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
"""Largest product of the bound of the rates and the share of a step that the series take."""
ORDER = 20
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
            ds = _both(da @ spread[:, None] + a @ ds) / k
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
            spread_bar = spread_bars[k - 2] + _both(_t(a) @ spread_bar) / k
        return (a_bar + row_bar[..., : a.shape[-1]]) / self.rate, spread_bar / self.rate


def series(a: np.ndarray, q: np.ndarray, b: np.ndarray) -> StepSeries:
    """The coefficients for A, Q (U, n, n) [1/h] and a constant B (n, c)."""
    (n, c), rate = b.shape, bound(a)[:, None, None]
    rate = np.where(rate > 0.0, rate, 1.0)
    a, drive = a / rate, b / rate
    row = np.concatenate([a, drive, np.zeros_like(drive)], axis=2)
    rows, spreads = [row], [q / rate]
    for k in range(2, ORDER + 1):
        row = a @ row
        if k == 2:
            row[..., n + c :] = drive / rate
        row = row / k
        rows.append(row)
        spreads.append(_both(a @ spreads[-1]) / k)
    return StepSeries(a, rate, rows, spreads)


@dataclass(frozen=True)
class Powers:
    """T (K, n, w) and N (K, n, n) of steps that are doubled equally often; `which` (K,) of the series they
    take at `share` (K, 1, 1), in units of 1/rate; `stages` T, N and the length before each doubling."""

    series: StepSeries
    which: np.ndarray
    share: np.ndarray
    stages: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    whole: np.ndarray
    noise: np.ndarray

    def tangents(self, rows: list[np.ndarray], spreads: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (K, r, n, w) and (K, r, n, n) of T and N from those of the coefficients."""
        n = self.whole.shape[-2]
        change, gained = (_at(one, self.which, self.share[:, None]) for one in (rows, spreads))
        for whole, noise, hours in self.stages:
            e, de = whole[:, None, :, :n], change[..., :n]
            moved = np.eye(n) + e
            gained = gained + moved @ gained @ _t(moved) + _both(de @ (noise[:, None] @ _t(moved)))
            change = 2.0 * change + de @ whole[:, None] + e @ change + _ramp(change, n, hours[:, None])
        return change, gained

    def adjoints(self, bar: np.ndarray, noise_bar: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Adjoints of the coefficients from those of T (K, n, w) and N (K, n, n), the latter symmetric."""
        n = self.whole.shape[-2]
        c = (bar.shape[-1] - n) // 2
        for whole, noise, hours in reversed(self.stages):
            e = whole[..., :n]
            moved = np.eye(n) + e
            before = 2.0 * bar + _t(e) @ bar
            before[..., n : n + c] += hours * bar[..., n + c :]
            before[..., :n] += bar @ _t(whole) + 2.0 * noise_bar @ moved @ noise
            bar, noise_bar = before, noise_bar + _t(moved) @ noise_bar @ moved
        chosen = np.arange(len(self.series.a))[:, None] == self.which
        factors = [chosen * self.share[:, 0, 0] ** k for k in range(1, ORDER + 1)]
        rows, spreads = ([np.tensordot(f, one, 1) for f in factors] for one in (bar, noise_bar))
        return rows, spreads


def powers(found: StepSeries, which: np.ndarray, hours: np.ndarray) -> Iterator[tuple[np.ndarray, Powers]]:
    """Steps of equally many doublings at a time: their places among the K, and their matrices.

    which: (K,) of the pairs of A and Q that a step has; hours: (K,) [h].
    """
    reach = found.rate[which, 0, 0] * hours
    doublings = np.ceil(np.log2(np.maximum(reach / SHORT, 1.0))).astype(int)
    for count in np.unique(doublings).tolist():
        places = np.flatnonzero(doublings == count)
        shrink = 2.0**-count
        share, length = reach[places, None, None] * shrink, hours[places, None, None] * shrink
        whole, noise = (_at(one, which[places], share) for one in (found.rows, found.spreads))
        n, stages = noise.shape[-1], []
        for i in range(count):
            stages.append((whole, noise, length * 2.0**i))
            e = whole[..., :n]
            moved = np.eye(n) + e
            noise = noise + moved @ noise @ _t(moved)
            whole = 2.0 * whole + e @ whole + _ramp(whole, n, length * 2.0**i)
        yield places, Powers(found, which[places], share, stages, whole, noise)


def _at(coefficients: list[np.ndarray], which: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Σ_k share^k c_k, the smallest terms first."""
    total = np.zeros(())
    for one in reversed(coefficients):
        total = (total + one[which]) * share
    return total


def bound(a: np.ndarray) -> np.ndarray:
    """Upper bound (K,) of the eigenvalues' size of matrices (K, n, n), near the spectral radius of |A|.

    For every positive v, max (|A| v)_i / v_i is one (Collatz 1942, doi:10.1007/BF01180013).  In the norm
    that v scales, |A| has this size, so that series in A converge as those of a number do.
    """
    size = np.abs(a)
    v = np.ones((*a.shape[:-1], 1))
    for _ in range(16):  # half of the old vector keeps all entries positive, and rings of states from turning
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
    return np.swapaxes(matrix, -1, -2)


def _both(matrix: np.ndarray) -> np.ndarray:
    """A matrix and its transpose, added."""
    return matrix + _t(matrix)


FEW = 8
"""States up to which straight-line code compiles quickly and runs faster than loops."""

KEYS = 512
"""Distinct steps whose matrices and derivatives are in memory at a time."""


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
        """The rates at x = 0 at the start and the end of a step; one that is the same at both enters once."""
        g = self.graph
        origin = {m.index: g.constant(0.0) for m in self.mean}
        found = []
        for inputs in (self.start, self.end):
            at = {self.now[n].index: inputs[n] for n in self.varying}
            found.append(g.substitute(self.rates, origin | at))
        block, columns = [], []
        for i, (early, late) in enumerate(zip(*found, strict=True)):
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
        """The scalars of an update, of symbols in place of what the loops compute with matrices."""
        g, c = self.graph, len(self.heads)
        row = self.updates[c][2:]
        made = [g.symbol(f"{word}:{c}") for word in ("prediction", "variance")]
        cross = [g.symbol(f"cross:{c}:{i}") for i in range(len(row))]
        slopes = [g.symbol(f"row:{c}:{i}") for i in range(len(row))]
        spread = g.lift(dot(slopes, cross) + made[1])
        inverse = 1.0 / spread
        error = self.reading - made[0]
        quadratic = error * error * inverse
        gain = self._weight(quadratic) * inverse
        self.leaves.append([*made, *slopes, *cross])
        self.heads.append([error, spread, quadratic, g.lift(gain), g.lift(gain * error)])

    @cached_property
    def _blocks(self) -> list[Block]:
        return [self.predict, *self.updates]

    @cached_property
    def stage(self) -> list[int]:
        """Regimes count with the inputs: the table of keys holds matrices alone."""
        return [INSTANT if stage == KEY else stage for stage in super().stage]

    # -- sizes -----------------------------------------------------------------------------------------------
    @property
    def width(self) -> int:
        """Numbers in a row of a matrix."""
        return padded(self.n)

    @property
    def rows(self) -> int:
        """Rows of a matrix that tiles reach; columns of a matrix of vectors."""
        return padded(self.n, ROWS)

    @property
    def held(self) -> int:
        """Rows of the moments: those of P, and m' behind them."""
        return padded(self.n + 1, ROWS)

    def cuts(self, timeline: Timeline) -> Iterable[int]:
        """Instants between which a run of many distinct steps has at most `KEYS` of them."""
        return range(KEYS, len(timeline), KEYS) if len(timeline.steps) > KEYS else ()

    # -- numbers ---------------------------------------------------------------------------------------------
    @cached_property
    def _entries(self) -> tuple[list[int], Block]:
        """Places of the non-zero entries of A and Q in (2, n, n), and their expressions."""
        both = [v for matrix in (self.jacobian, self.noise) for row in matrix for v in row]
        there = [(i, self.graph.lift(v)) for i, v in enumerate(both) if not is_zero(v)]
        return [i for i, _ in there], [v for _, v in there]

    @cached_property
    def _later(self) -> Block:
        """Nodes of the parameter stage that the loops read, and the entries of A and Q."""
        return [*(Expression(self.graph, i) for i in self.parameter_nodes), *self._entries[1]]

    @cached_property
    def _tangents(self) -> Block:
        """Their derivatives along directions with the symbols `dot:`."""
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
        return sorted({i for i, _, _ in self.columns})

    def _known(self, values: Values, keys: np.ndarray) -> dict[str, Value]:
        regimes = {f"g:{name}": keys[:, 1 + i] for i, name in enumerate(self.regimes)}
        return self.symbols(values) | regimes

    def _split(self, found: Sequence[Value], shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of `_later`: of the nodes (…, nodes) without the keys' axis, and A and Q (2, …, n, n)."""
        count = len(self.parameter_nodes)
        nodes = [np.broadcast_to(v, shape[:0:-1])[..., None] for v in found[:count]]
        matrices = np.zeros((2 * self.n**2, *shape))
        for place, value in zip(self._entries[0], found[count:], strict=True):
            matrices[place] = value
        known = np.concatenate(nodes, axis=-1) if nodes else np.zeros((*shape[:0:-1], 0))
        return known, np.moveaxis(matrices.reshape(2, self.n, self.n, *shape), (1, 2), (-2, -1))

    def _weights(self, hours: np.ndarray) -> np.ndarray:
        """(K, 2 c, e) by which the columns w_e follow from the middle and the right part of T."""
        found = np.zeros((len(hours), 2 * len(self._driven), len(self.columns)))
        for e, (i, whole, ramp) in enumerate(self.columns):
            c = self._driven.index(i)
            found[:, c, e] = whole
            found[:, len(self._driven) + c, e] = ramp / np.where(hours > 0, hours, 1.0)
        return found

    def numbers(self, values: Values, keys: np.ndarray) -> Numbers | None:
        """What the loops and their derivatives start from, for some keys (K, 1 + regimes); None where rates
        are not finite, or too large."""
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
    """The parameters' and keys' numbers of one pass: `distinct` (U, 1 + regimes) keys with all regimes,
    `nodes` the numbers of the parameter stage, `steps` the keys' matrices by their places among them."""

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
        for places, p in self.steps:
            found = np.zeros((len(places), *table.shape[1:]))
            found[:, :n, :n] = np.eye(n) + p.whole[..., :n]
            found[:, w : w + n, :n] = np.swapaxes(found[:, :n, :n], 1, 2)
            found[:, 2 * w : 2 * w + n, :n] = p.noise
            columns = p.whole[..., n:] @ r._weights(self.keys[places, 0])
            found[:, 3 * w :, :n] = np.swapaxes(columns, 1, 2)
            table[places] = found
        return table

    def tangents(self, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives along the directions `seeds` (d, L): of the nodes (nodes, L); of F', N and the columns
        as rows (K, 2 rows + e, rows, L)."""
        r, n, rows = self.recursion, self.recursion.n, self.recursion.rows
        known = r._known(self.values, self.distinct[:, :, None])
        known |= {f"dot:{e.index}": dot for e, dot in zip(r.p.values(), seeds, strict=True)}
        shape = (len(self.distinct), seeds.shape[1])
        nodes, (da, dq) = r._split(r.graph.evaluate(r._tangents, known), shape)
        coefficients = self.series.tangents(da, dq)
        dots = aligned(len(self.keys), 2 * rows + len(r.columns), rows, seeds.shape[1])
        for places, p in self.steps:
            change, gained = p.tangents(*coefficients)
            found = np.zeros((len(places), *dots.shape[1:]))
            found[:, :n, :n] = np.moveaxis(change[..., :n], (1, 2, 3), (3, 2, 1))
            found[:, rows : rows + n, :n] = np.moveaxis(gained, 1, -1)
            columns = change[..., n:] @ r._weights(self.keys[places, 0])[:, None]
            found[:, 2 * rows :, :n] = np.moveaxis(columns, (1, 2, 3), (3, 2, 1))
            dots[places] = found
        return np.ascontiguousarray(nodes.T), dots

    def adjoints(self, node_bars: np.ndarray, bars: np.ndarray) -> np.ndarray:
        """Adjoints (d,) of the parameters from those of the nodes and of the table: half of F's, all of N's
        and of the columns'."""
        r, n, w = self.recursion, self.recursion.n, self.recursion.width
        entries = np.zeros((len(self.distinct), 2, n, n))
        for places, p in self.steps:
            here = bars[places, :, :n]
            driven = r._weights(self.keys[places, 0]) @ here[:, 3 * w :]
            bar = np.concatenate([2.0 * here[:, :n], np.swapaxes(driven, 1, 2)], axis=2)
            coefficients = p.adjoints(bar, here[:, 2 * w : 2 * w + n])
            entries += np.stack(self.series.adjoints(*coefficients), axis=1)
        # a node of the parameter stage is one number for all keys: the first of them takes its adjoint
        first = np.zeros((len(node_bars), len(entries)))
        first[:, :1] = node_bars[:, None]
        found = [*first, *entries.reshape(len(entries), -1).T[r._entries[0]]]
        known = r._known(self.values, self.distinct) | {f"bar:{i}": bar for i, bar in enumerate(found)}
        slopes = dict(zip(r._adjoints, r.graph.evaluate(list(r._adjoints.values()), known), strict=True))
        return np.array([float(np.sum(slopes.get(e.index, 0.0))) for e in r.p.values()])


def aligned(*shape: int) -> np.ndarray:
    """Zeros from a multiple of 64 bytes on, so that vectors do not cross a cache line."""
    count = math.prod(shape)
    raw = np.zeros(count + 8)
    first = -raw.ctypes.data % 64 // 8
    return raw[first : first + count].reshape(shape)


def recursion_of(model: Model, unknown: int = 0, factored: bool = False) -> Recursion:
    """The filter of a model: with matrices where it has more than `FEW` states, a proper start, plain
    covariances and exact steps of any length, else straight-line code."""
    if len(model.states) <= FEW or unknown or factored:
        return traced(model, unknown, factored)
    # kept with the model, as in `traced`
    kept: list[WideRecursion] = vars(model).setdefault("_wide", [])
    if not kept:
        kept.append(WideRecursion(model))
    return kept[0] if kept[0].exact else traced(model)
