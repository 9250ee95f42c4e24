"""The extended Kalman filter of a model, traced: the expressions of one step, and when each is known.

One step of the filter is traced once as two kinds of blocks, `predict` (a sub-step) and `update` (one scalar
reading).  The compiled loops (`hygrokf.engine.filter_loops`) are made from these blocks: the likelihood, its
adjoint (score), its tangents (sensitivities of every innovation) and the trace of all moments.  Readings at
one instant are processed one after the other, each linearised at the state after the previous one.  A
missing reading (NaN) is skipped, so that a gap, a dead sensor and a forecast take the same path.  Every loop
starts from a given Gaussian and returns the last one: the offline filter is a fold of the online step.

Numbers of one record (`expression.Given`) are passed after the parameters and are not part of the code:
recursions that differ only in these numbers share their code.

Values are computed at the earliest stage possible: with the parameters, with the distinct steps ("keys":
sub-step length and regime), or at every instant.

Shapes: T instants, n states, q = n (n+1)/2 packed covariance entries (lower triangle by rows), m inputs,
k outputs, d parameters, L = `LANES`.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Sequence
from functools import cached_property

import numpy as np

from hygrokf.engine.discretisation import Operation, Step, operations, step
from hygrokf.engine.packing import pack, place, unpack
from hygrokf.engine.square_root import (
    corrected,
    factored,
    factored_slopes,
    factors,
    orthogonalised,
    square_root,
)
from hygrokf.engine.timeline import Timeline
from hygrokf.engine.variances import Variances, variances_of
from hygrokf.physics.expression import (
    Expression,
    Graph,
    Matrix,
    Value,
    arguments,
    depends_on,
    is_zero,
    jacobian,
    maximum,
    sqrt,
    where,
)
from hygrokf.physics.holds import LINEAR, PREVIOUS, REGIME
from hygrokf.physics.matrices import add, congruence, dot, product, transpose
from hygrokf.physics.model import Model, Values

UNSEEN = 1e-10
"""[1] a reading's loading on an unknown start counts as 0 below this share of the products that it sums: the
rounding of a difference over ten thousand steps is smaller."""

CONSTANT, PARAMETER, KEY, INSTANT = range(4)
"""Stages at which a value is first known."""
Block = list[Expression]
"""Outputs of traced straight-line code."""


class Recursion:
    """The filter of one model as expressions.

    The start is diffuse in `unknown` directions (exact diffuse start, Durbin & Koopman 2012, section 5.2):
    the prior covariance is κ Φ N N' Φ' with κ → ∞.  The moments hold Φ (n, unknown), the loadings of the
    state on the unknown start; N (unknown, unknown), whose columns are the directions that no reading has
    determined yet; and whether the loadings move with the state, which they do from the first reading on.

    `factored` moments hold the covariance as factors (`engine.square_root`), and the diagonal of L for the
    running means.
    """

    wide = False
    """Whether the loops take the matrices of whole steps (`wide_recursion`)."""
    exact: bool
    """Whether a step of any length is one exact step (`discretisation.constant_rates`)."""
    early: tuple[Operation, ...] = ()
    late: tuple[Operation, ...] = ()
    reach: Sequence[Expression] = ()

    def __init__(self, model: Model, unknown: int = 0, factored: bool = False) -> None:
        self.model = model
        self.unknown, self.factored = int(unknown), factored
        self.graph = Graph()
        g = self.graph
        n = len(model.states)
        self.n, self.q = n, n * (n + 1) // 2
        self.p = {p.name: g.symbol(f"p:{p.name}") for p in model.parameters}
        self.holds = model.input_holds
        self.varying = [name for name, hold in self.holds.items() if hold != REGIME]
        self.regimes = [name for name, hold in self.holds.items() if hold == REGIME]
        self.h, self.share = g.symbol("h"), g.symbol("share")
        regime = {name: g.symbol(f"g:{name}") for name in self.regimes}
        self.key_leaves = [self.h, *regime.values()]
        self.mean = [g.symbol(f"m{i}") for i in range(n)]
        self.packed = [g.symbol(f"P{i}{j}") for i in range(n) for j in range(i + 1)]
        self.covariance = self._square(self.packed)
        d = self.unknown
        self.units = [g.symbol(f"D{i}") for i in model.resets] if factored else []
        self.loadings = [[g.symbol(f"I{i}:{j}") for j in range(d)] for i in range(n)]
        self.directions = [[g.symbol(f"N{i}:{j}") for j in range(d)] for i in range(d)]
        self.begun = [g.symbol("begun")] if d else []
        self.state = [*self.mean, *self.packed, *self.units]
        self.state += [*_flat(self.loadings), *_flat(self.directions), *self.begun]
        self.start, self.end, self.now = {}, {}, {}
        for name in self.varying:
            hold = self.holds[name]
            self.now[name] = g.symbol(f"b:{name}")
            self.start[name] = g.symbol(f"a:{name}") if hold in (LINEAR, PREVIOUS) else self.now[name]
            self.end[name] = self.start[name] if hold == PREVIOUS else self.now[name]
        for table in (self.start, self.end, self.now):
            table.update(regime)
        self.reading = g.symbol("y")

        self.noise = self._noise(self.now)
        self._trace()
        self.given = [g.symbol(f"c:{i}") for i in range(len(g.given))]
        self.constants = np.array(g.given, dtype=float)
        self.structure = self._digest()

    # -- tracing ---------------------------------------------------------------------------------------------
    @property
    def _changing(self) -> list[str]:
        """Names of the symbols that change from step to step."""
        return [f"m{i}" for i in range(self.n)] + [f"{end}:{name}" for end in "ab" for name in self.varying]

    def _noise(self, u: Values) -> Matrix:
        return [[_lifted(self.graph, v) for v in row] for row in self.model.noise(self.p, u)]

    def _trace(self) -> None:
        """Trace the blocks of a step: `predict`, `updates` and `transition`, and the rates with their
        Jacobian."""
        g, model, d = self.graph, self.model, self.unknown
        traced_step = step(
            g,
            lambda x, u: model.traced(x, u, self.p).rates,
            self._noise,
            self.mean,
            self.covariance,
            self.start,
            self.end,
            self.h,
            self._changing,
            decays=d > 0,
        )
        self.early, self.late = traced_step.early, traced_step.late
        self.exact, self.reach = traced_step.exact, traced_step.reach
        self.registers = {e.index: e for operation in operations(self.late) for e in operation.into}
        packed = self._predicted(traced_step) if self.factored else self._lower(traced_step.covariance)
        self.predict: Block = [*traced_step.mean, *packed, *(g.constant(1.0) for _ in self.units)]
        if d:
            moved_loadings = product(traced_step.decay, self.loadings)
            begun = self.begun[0] > 0.5
            for row, old in zip(moved_loadings, self.loadings, strict=True):
                self.predict.extend(where(begun, v, o) for v, o in zip(row, old, strict=True))
            self.predict.extend([*_flat(self.directions), *self.begun])
        equations = model.traced(self.mean, self.now, self.p)
        self.rates = [g.lift(v) for v in equations.rates]
        self.jacobian = jacobian(self.rates, self.mean)
        traced = [self._trace_update(*equations.outputs[name]) for name in model.outputs]
        self.updates = [update for update, _ in traced]
        self.spreads = [spread for _, spread in traced]
        self.transition = [g.lift(v) for row in traced_step.transition for v in row]
        self._gained = traced_step.noise

    @cached_property
    def gathered(self) -> tuple[list[Expression], Block]:
        """Symbols of the packed accumulated noise W (q,) before a sub-step, and F W F' + Q after it."""
        before = [self.graph.symbol(f"W{i}{j}") for i in range(self.n) for j in range(i + 1)]
        f = [self.transition[i * self.n : (i + 1) * self.n] for i in range(self.n)]
        return before, self._lower(congruence(f, self._square(before), self._gained))

    # -- numbers ---------------------------------------------------------------------------------------------
    def covariance_of(self, state: np.ndarray) -> np.ndarray:
        """Covariances (…, n, n) of moments (…, w)."""
        packed = unpack(state[..., self.n : self.n + self.q], self.n)
        if not self.factored:
            return packed
        lower, diagonal = self.lower_of(state), np.einsum("...ii->...i", packed)
        return (lower * diagonal[..., None, :]) @ np.swapaxes(lower, -1, -2)

    def root_of(self, state: np.ndarray) -> np.ndarray:
        """W (…, n, n) with W W' the covariance of moments (…, w)."""
        packed = unpack(state[..., self.n : self.n + self.q], self.n)
        if not self.factored:
            return square_root(packed)
        return self.lower_of(state) * np.sqrt(np.einsum("...ii->...i", packed))[..., None, :]

    def lower_of(self, state: np.ndarray) -> np.ndarray:
        """L (…, n, n) of factored moments (…, w)."""
        lower = np.tril(unpack(state[..., self.n : self.n + self.q], self.n), -1) + np.eye(self.n)
        for c, i in enumerate(self.model.resets):
            lower[..., i, i] = state[..., self.n + self.q + c]
        return lower

    def packed_moments(self, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Moments (…, w) of a mean (…, n) and a covariance (…, n, n), without an unknown start."""
        parts = [mean, pack(factored(covariance) if self.factored else covariance)]
        if len(self.state) > self.n + self.q:
            rest = np.repeat([1.0, 0.0], [len(self.units), len(self.state) - self.loaded])
            parts.append(np.broadcast_to(rest, (*mean.shape[:-1], len(rest))))
        return np.concatenate(parts, axis=-1)

    def packed_slopes(
        self, mean_slopes: np.ndarray, covariance: np.ndarray, covariance_slopes: np.ndarray
    ) -> np.ndarray:
        """Derivatives (r, w) of `packed_moments` from those of the mean (r, n) and of the covariance
        (r, n, n)."""
        slopes = np.zeros((len(mean_slopes), len(self.state)))
        slopes[:, : self.n] = mean_slopes
        entries = factored_slopes(covariance, covariance_slopes) if self.factored else covariance_slopes
        slopes[:, self.n : self.n + self.q] = pack(entries)
        return slopes

    @property
    def loaded(self) -> int:
        """Index of the first loading in the moments."""
        return self.n + self.q + len(self.units)

    def unknown_of(self, state: np.ndarray) -> np.ndarray:
        """Φ N (…, n, unknown) of moments (…, w), 0 where only rounding errors remain."""
        n, d, start = self.n, self.unknown, self.loaded
        loadings = state[..., start : start + n * d].reshape(*state.shape[:-1], n, d)
        directions = state[..., start + n * d : start + (n + d) * d].reshape(*state.shape[:-1], d, d)
        product_ = loadings @ directions
        return np.where(np.abs(product_) > UNSEEN * (np.abs(loadings) @ np.abs(directions)), product_, 0.0)

    # -- pieces of the trace ---------------------------------------------------------------------------------
    def _lower(self, matrix: Matrix) -> list[Expression]:
        return [self.graph.lift(matrix[i][j]) for i in range(self.n) for j in range(i + 1)]

    def _square(self, packed: Sequence[Expression]) -> Matrix:
        return [[packed[place(i, j)] for j in range(self.n)] for i in range(self.n)]

    def _predicted(self, traced_step: Step) -> list[Expression]:
        """Trace the packed factors of F P F' + Q."""
        lower, diagonal = self._factors()
        noise_lower, noise_diagonal = factors(traced_step.noise)
        rows = [[*a, *b] for a, b in zip(product(traced_step.transition, lower), noise_lower, strict=True)]
        return self._packed(*orthogonalised(rows, [*diagonal, *noise_diagonal]))

    def _factors(self) -> tuple[Matrix, list[Value]]:
        """L (n, n) and D (n,) of the moments."""
        units = dict(zip(self.model.resets, self.units, strict=True))
        diagonal = [self.packed[place(i, i)] for i in range(self.n)]
        lower: Matrix = [[self.packed[place(i, j)] for j in range(i)] for i in range(self.n)]
        return [[*row, units.get(i, 1.0), *[0.0] * (self.n - i - 1)] for i, row in enumerate(lower)], diagonal

    def _packed(self, lower: Matrix, diagonal: list[Value]) -> list[Expression]:
        return self._lower([[*row[:i], diagonal[i]] for i, row in enumerate(lower)])

    def _trace_update(self, prediction: Value, variance: Value) -> tuple[Block, Expression]:
        """Trace the update by one reading with this prediction and noise variance.

        Returns the block (moments, innovation e, its variance S, e²/S), and S again, which is NaN where the
        reading depends on an unknown direction of the start."""
        g = self.graph
        prediction = g.lift(prediction)
        row = jacobian([prediction], self.mean)[0]
        if self.factored:
            lower, diagonal = self._factors()
            projected = [dot([lower[i][j] for i in range(j, self.n)], row[j:]) for j in range(self.n)]
            weighted = [dot([d], [f]) for d, f in zip(diagonal, projected, strict=True)]
            cross = [dot(lower[i][: i + 1], weighted[: i + 1]) for i in range(self.n)]
            spread = g.lift(dot(weighted, projected) + variance)
        else:
            cross = [dot(self.covariance[i], row) for i in range(self.n)]
            spread = g.lift(_quadratic(row, self.covariance, cross) + variance)
        error = self.reading - prediction
        if not self.unknown:
            usual, quadratic = self._known_update(row, cross, error, spread, variance)
            return [*usual, error, spread, quadratic], spread
        return self._diffuse_update(row, cross, error, spread, variance)

    def _known_update(
        self, row: list[Value], cross: list[Value], error: Expression, spread: Expression, variance: Value
    ) -> tuple[list[Value], Expression]:
        """Trace mean and covariance after a reading that depends on no unknown direction, and e²/S.

        row: derivatives H of its prediction.  cross: P H'.  error, spread: e and S.  variance: of its noise.
        """
        inverse = 1.0 / spread
        quadratic = error * error * inverse
        weight = self._weight(quadratic)
        gain = [0.0 if is_zero(c) else c * (weight * inverse) for c in cross]
        mean = [m if is_zero(k) else m + k * error for m, k in zip(self.mean, gain, strict=True)]
        if self.factored:  # a weight w below 1 acts as the noise variance R + S (1/w − 1)
            noise = variance if isinstance(weight, float) else variance + spread * (1.0 / weight - 1.0)
            return [*mean, *self._packed(*corrected(*self._factors(), row, noise)), *self.units], quadratic
        covariance = [
            self.covariance[i][j]
            if is_zero(gain[i]) or is_zero(cross[j])
            else self.covariance[i][j] - (cross[i] * cross[j]) * (weight * inverse)
            for i in range(self.n)
            for j in range(i + 1)
        ]
        return [*mean, *covariance], quadratic

    def _weight(self, quadratic: Expression) -> Value:
        """Weight of a reading with the squared innovation e²/S = `quadratic`.

        Beyond b standard deviations it is b √S/|e| (Huber 1964, doi:10.1214/aoms/1177703732): the state moves
        as for a reading at the bound, so that it follows readings that stay far from the prediction.
        """
        if math.isinf(self.model.bound):
            return 1.0
        # never 0, where the root has no finite derivative
        ratio = maximum(quadratic * (1.0 / self.square), 1.0)
        # the condition stands directly before the quotient and keeps it out of the ordinary step
        return where(quadratic > self.square, 1.0 / sqrt(ratio), 1.0)

    @property
    def square(self) -> float:
        """b²: larger squared innovations e²/S have a reduced weight."""
        return self.model.bound**2

    def term_derivative(self, quadratic: Expression) -> Value:
        """Derivative of a reading's term in −2 ln L with respect to e²/S = `quadratic`.

        The term is e²/S, and beyond b² it is b² (1 + ln(e²/(b² S))): the tail of Student's distribution with
        about b² degrees of freedom.  A few outliers thus do not determine the variances of all other
        readings.
        """
        if math.isinf(self.square):
            return 1.0
        return where(quadratic > self.square, self.square / maximum(quadratic, self.square), 1.0)

    def _diffuse_update(
        self, row: list[Value], cross: list[Value], error: Expression, spread: Expression, variance: Value
    ) -> tuple[Block, Expression]:
        """Trace the exact diffuse update where the reading depends on an unknown direction of the start, else
        the usual update; arguments as in `_known_update`, returns as in `_trace_update`."""
        g, n = self.graph, self.n
        towards, rest = self._resolved(row)
        m = [dot(loading, towards) for loading in self.loadings]
        f = g.lift(dot(row, m))
        seen = f > 0.0
        usual, quadratic = self._known_update(row, cross, error, where(seen, 1.0, spread), variance)
        gain = [v * (1.0 / where(seen, f, 1.0)) for v in m]
        mean = [v + k * error for v, k in zip(self.mean, gain, strict=True)]
        if self.factored:
            lower, diagonal = self._factors()
            kept = [[(1.0 if i == j else 0.0) - dot([gain[i]], [row[j]]) for j in range(n)] for i in range(n)]
            rows = [[*a, k] for a, k in zip(product(kept, lower), gain, strict=True)]
            new = [*self._packed(*orthogonalised(rows, [*diagonal, variance])), *(1.0 for _ in self.units)]
        else:
            new = [
                self.covariance[i][j] + gain[i] * gain[j] * spread - (cross[i] * gain[j] + gain[i] * cross[j])
                for i in range(n)
                for j in range(i + 1)
            ]
        moments = [where(seen, a, b) for a, b in zip([*mean, *new], usual, strict=True)]
        directions = [where(seen, new, old) for new, old in zip(rest, _flat(self.directions), strict=True)]
        # loadings without a direction left would grow without limit where the model is unstable
        open_ = dot(directions, directions) > 0.0
        loadings = [where(open_, loading, 0.0) for loading in _flat(self.loadings)]
        block = [*moments, *loadings, *directions, g.constant(1.0)]
        ends = [error, where(seen, f, spread), where(seen, 0.0, quadratic)]
        return [*map(g.lift, block), *ends], where(seen, math.nan, spread)

    def _resolved(self, row: list[Value]) -> tuple[list[Value], list[Value]]:
        """Trace what a reading with the derivatives `row` tells of the unknown start: the combination
        (unknown,) that it determines, 0 if none, and the directions (unknown²,) that remain unknown after it.

        A Householder reflection rotates the columns of N so that the reading depends on, and determines, a
        single column: the column with the largest dependence, so that small entries keep their digits.
        """
        d, n = self.unknown, self.directions
        dependence = [dot(row, [loading[j] for loading in self.loadings]) for j in range(d)]
        magnitudes = [v if is_zero(v) else maximum(v, -v) for v in dependence]
        if all(map(is_zero, dependence)):
            return [0.0] * d, _flat(n)
        significant: list[Value] = []
        for j in range(d):
            column = [n[i][j] for i in range(d)]
            value = dot(dependence, column)
            scale_ = dot(magnitudes, [maximum(v, -v) for v in column])
            significant.append(where(maximum(value, -value) > UNSEEN * scale_, value, 0.0))
        square = dot(significant, significant)
        length = sqrt(where(square > 0.0, square, 1.0))
        largest: Value = 0.0
        for v in significant:
            largest = maximum(largest, maximum(v, -v))
        remaining, is_largest = 1.0, []
        for v in significant:  # 1 for the first of the largest, 0 for the others
            is_largest.append(where(maximum(v, -v) < largest, 0.0, remaining))
            remaining = remaining - is_largest[-1]
        largest_value = dot(significant, is_largest)
        sign = where(largest_value < 0.0, -1.0, 1.0)
        mirror = [v + c * sign * length for v, c in zip(significant, is_largest, strict=True)]
        scale = 1.0 / where(square > 0.0, square + sign * largest_value * length, 1.0)
        directions = [
            (1.0 - is_largest[j]) * (n[i][j] - dot(n[i], mirror) * (scale * mirror[j]))
            for i in range(d)
            for j in range(d)
        ]
        return [dot(n[i], significant) for i in range(d)], directions

    def symbols(
        self, values: Values, mean: Iterable[Value] = (), inputs: Values | None = None
    ) -> dict[str, Value]:
        """Parameters, states (n) and inputs by the names of their symbols, as `graph.evaluate` takes them."""
        known = {f"p:{name}": value for name, value in values.items()}
        known |= {f"m{i}": value for i, value in enumerate(mean)}
        return known | {f"{kind}:{name}": v for name, v in (inputs or {}).items() for kind in ("b", "g")}

    @cached_property
    def stage(self) -> list[int]:
        """For every node, the earliest stage at which its value is known."""
        key_symbols = {e.index for e in self.key_leaves}
        key_symbols |= {
            self.share.index,
            *(e.index for operation in operations(self.early) for e in operation.into),
        }
        result: list[int] = []
        for i, node in enumerate(self.graph.nodes):
            if node[0] == "const":
                result.append(CONSTANT)
            elif node[0] == "symbol":
                is_key = i in key_symbols
                is_parameter = node[1].startswith(("p:", "c:"))
                result.append(PARAMETER if is_parameter else KEY if is_key else INSTANT)
            else:
                result.append(max(result[j] for j in arguments(node)))
        return result

    def cuts(self, timeline: Timeline) -> Iterable[int]:
        """Instants at which a run is divided to limit the memory of its loops."""
        return ()

    @cached_property
    def uncertainty(self) -> Matrix:
        """The covariance of the moments, with a variance of 1 in unknown directions."""
        covariance = self.covariance
        if self.factored:
            lower, diagonal = self._factors()
            weighted = [[dot([v], [d]) for v, d in zip(row, diagonal, strict=True)] for row in lower]
            covariance = product(weighted, transpose(lower))
        if self.unknown:
            unknown_loadings = product(self.loadings, self.directions)
            covariance = add(covariance, product(unknown_loadings, transpose(unknown_loadings)))
        return covariance

    @cached_property
    def comparisons(self) -> list[Expression]:
        """The comparisons in the rates that depend on states, as 1 or 0."""
        states = [f"m{i}" for i in range(self.n)]
        comparisons = [
            Expression(self.graph, i) for i in self.graph.needed(self.rates) if self.graph.nodes[i][0] == "lt"
        ]
        return [
            where(comparison, 1.0, 0.0)
            for comparison in comparisons
            if depends_on(self.graph, comparison, states)
        ]

    def leaves_of(self, block: Sequence[Expression]) -> frozenset[int]:
        """The symbols that a block reads."""
        key = tuple(e.index for e in block)
        if key not in self._leaves:
            needed = self.graph.needed(block)
            self._leaves[key] = frozenset(i for i in needed if self.graph.nodes[i][0] == "symbol")
        return self._leaves[key]

    @cached_property
    def _leaves(self) -> dict[tuple[int, ...], frozenset[int]]:
        return {}

    def boundary(self, outputs: Sequence[Expression], stage: int) -> tuple[list[int], list[int]]:
        """Nodes of earlier stages that the code of `stage` reads: (of the parameter stage, of the key
        stage)."""
        stages = self.stage
        nodes: set[int] = set()
        for i in self.graph.needed(outputs):
            if stages[i] == stage:
                nodes.update(j for j in self._read_by(i) if stages[j] < stage)
            elif any(e.index == i for e in outputs):
                nodes.add(i)
        ordered = sorted(nodes)
        return (
            [i for i in ordered if stages[i] == PARAMETER],
            [i for i in ordered if stages[i] == KEY],
        )

    def _read_by(self, i: int) -> list[int]:
        """Nodes whose numbers node i needs; a condition is not a number, so it is replaced by the nodes that
        it compares."""
        nodes: list[int] = []
        for j in arguments(self.graph.nodes[i]):
            nodes.extend(arguments(self.graph.nodes[j]) if self.graph.nodes[j][0] == "lt" else [j])
        return nodes

    @cached_property
    def variances(self) -> Variances:
        return variances_of(self.graph, self.model, self.p, self.now, self.mean)

    @cached_property
    def driven(self) -> np.ndarray:
        """(n,) True for states that follow an input, directly or through other states."""
        nodes = enumerate(self.graph.nodes)
        inputs = {i for i, node in nodes if node[0] == "symbol" and node[1][:2] in ("b:", "g:")}
        driven = np.array([not inputs.isdisjoint(self.graph.needed([rate])) for rate in self.rates])
        acts = np.array([[not is_zero(entry) for entry in row] for row in self.jacobian])
        acts = acts.reshape(self.n, self.n)
        for _ in range(self.n):
            driven = driven | (acts @ driven)
        return driven

    @cached_property
    def _blocks(self) -> list[Block]:
        late = [list(operation.block) for operation in operations(self.late)]
        return [self.predict, *self.updates, self.gathered[1], *late]

    @cached_property
    def key_nodes(self) -> list[int]:
        """Nodes computed once per distinct key, in the order of the key table."""
        _ = self.stage
        nodes: set[int] = set()
        for block in self._blocks:
            nodes.update(self.boundary(block, INSTANT)[1])
        nodes.update(e.index for e in self.transition if self.stage[e.index] == KEY)
        return sorted(nodes)

    @cached_property
    def parameter_nodes(self) -> list[int]:
        """Nodes that depend only on the parameters and are read later, including the parameters
        themselves."""
        nodes: set[int] = set()
        for block in self._blocks:
            nodes.update(self.boundary(block, INSTANT)[0])
        keys = [Expression(self.graph, i) for i in self.key_nodes]
        keys.extend(e for operation in operations(self.early) for e in operation.block)
        keys.extend(self.reach)
        nodes.update(self.boundary(keys, KEY)[0])
        nodes.update(e.index for b in self._blocks for e in b if self.stage[e.index] == PARAMETER)
        nodes.update(e.index for e in self.transition if self.stage[e.index] == PARAMETER)
        return sorted(nodes)

    @cached_property
    def estimated_nodes(self) -> list[int]:
        """The members of `parameter_nodes` that depend on a parameter; the others have no derivative."""
        names = [f"p:{name}" for name in self.p]
        return [i for i in self.parameter_nodes if depends_on(self.graph, Expression(self.graph, i), names)]

    def _digest(self) -> str:
        """Digest of everything that determines the compiled loops: recursions with the same digest share
        their code."""
        model, blocks = self.model, self._blocks
        attributes = {k: v for k, v in vars(self).items() if k not in ("model", "graph", "constants")}
        content = (
            *(model.states, model.inputs, model.outputs, model.resets),
            *(self.wide, self.square, self.graph.nodes, blocks, attributes),
        )
        return hashlib.sha256(repr(content).encode()).hexdigest()


def _quadratic(row: list[Value], covariance: Matrix, cross: list[Value]) -> Value:
    """h P h'; a row with a single entry squares it first, which shortens the dependency chain between
    steps."""
    nonzero = [i for i, v in enumerate(row) if not is_zero(v)]
    if len(nonzero) == 1:
        (i,) = nonzero
        return (row[i] * row[i]) * covariance[i][i]
    return dot(row, cross)


def _flat(matrix: Matrix) -> list[Value]:
    return [entry for row in matrix for entry in row]


def _lifted(graph: Graph, value: Expression | float) -> Expression | float:
    return 0.0 if is_zero(value) else graph.lift(value)


def traced(model: Model, unknown: int = 0, factored: bool = False) -> Recursion:
    """The filter of a model, traced at first use; `unknown`, `factored` as in `Recursion`."""
    # filters are cached on the model, because each refers to the model: a global cache would keep both alive
    filters: dict[tuple[int, bool], Recursion] = vars(model).setdefault("_filters", {})
    recursion = filters.get((unknown, factored))
    if recursion is None:
        recursion = filters.setdefault((unknown, factored), Recursion(model, unknown, factored))
    return recursion
