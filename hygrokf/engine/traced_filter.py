"""The extended Kalman filter of a model, traced: the expressions of one step, and when each is known.

One step of the filter is traced once as two kinds of blocks, `predict` (a sub-step) and `update` (one scalar
reading).  The compiled loops (`hygrokf.engine.filter_loops`) are made from these blocks: the likelihood, its
adjoint (score), its tangents (sensitivities of every innovation) and the trace of all moments.  Readings at
one instant are processed one after the other, each linearised at the state that the previous one left.  A
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
from hygrokf.engine.square_root import corrected, factored, factors, orthogonalised, square_root
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
"""A reading's loading on an unknown start counts from this share of the products that make it: what rounding
leaves of a difference in ten thousand steps is less."""

CONSTANT, PARAMETER, KEY, INSTANT = range(4)
"""Stages: when a value first becomes known."""
Block = list[Expression]
"""Outputs of traced straight-line code."""


class Recursion:
    """The filter of one model as expressions.

    Of the start's `unknown` directions nothing is known (exact diffuse start, Durbin & Koopman 2012, section
    5.2): the prior covariance is κ Φ N N' Φ' with κ → ∞.  The moments carry Φ (n, unknown), the loadings of
    the state on the unknown start, N (unknown, unknown), the directions of it that no reading has shown yet,
    one in each column, and whether the loadings have begun to move: a start of which nothing at all is known
    stands at the first reading.

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
        """The blocks of a step: `predict`, `updates` and `transition`, and the rates with their Jacobian."""
        g, model, d = self.graph, self.model, self.unknown
        made = step(
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
        self.early, self.late = made.early, made.late
        self.exact, self.reach = made.exact, made.reach
        self.registers = {e.index: e for one in operations(self.late) for e in one.into}
        packed = self._predicted(made) if self.factored else self._lower(made.covariance)
        self.predict: Block = [*made.mean, *packed, *(g.constant(1.0) for _ in self.units)]
        if d:
            moved = product(made.decay, self.loadings)
            begun = self.begun[0] > 0.5
            for row, old in zip(moved, self.loadings, strict=True):
                self.predict.extend(where(begun, v, o) for v, o in zip(row, old, strict=True))
            self.predict.extend([*_flat(self.directions), *self.begun])
        at = model.traced(self.mean, self.now, self.p)
        self.rates = [g.lift(v) for v in at.rates]
        self.jacobian = jacobian(self.rates, self.mean)
        traced = [self._trace_update(*at.outputs[name]) for name in model.outputs]
        self.updates = [update for update, _ in traced]
        self.spreads = [spread for _, spread in traced]
        self.transition = [g.lift(v) for row in made.transition for v in row]
        self._gained = made.noise

    @cached_property
    def gathered(self) -> tuple[list[Expression], Block]:
        """The packed noise (q,) of the sub-steps before a sub-step, and that after it, F W F' + Q."""
        before = [self.graph.symbol(f"W{i}{j}") for i in range(self.n) for j in range(i + 1)]
        f = [self.transition[i * self.n : (i + 1) * self.n] for i in range(self.n)]
        return before, self._lower(congruence(f, self._square(before), self._gained))

    # -- numbers ---------------------------------------------------------------------------------------------
    def covariance_of(self, state: np.ndarray) -> np.ndarray:
        """Covariances (…, n, n) of moments (…, w)."""
        found = unpack(state[..., self.n : self.n + self.q], self.n)
        if not self.factored:
            return found
        lower, diagonal = self._lower_of(state), np.einsum("...ii->...i", found)
        return (lower * diagonal[..., None, :]) @ np.swapaxes(lower, -1, -2)

    def root_of(self, state: np.ndarray) -> np.ndarray:
        """W (…, n, n) with W W' the covariance of moments (…, w)."""
        found = unpack(state[..., self.n : self.n + self.q], self.n)
        if not self.factored:
            return square_root(found)
        return self._lower_of(state) * np.sqrt(np.einsum("...ii->...i", found))[..., None, :]

    def _lower_of(self, state: np.ndarray) -> np.ndarray:
        lower = np.tril(unpack(state[..., self.n : self.n + self.q], self.n), -1) + np.eye(self.n)
        for c, i in enumerate(self.model.resets):
            lower[..., i, i] = state[..., self.n + self.q + c]
        return lower

    def packed_moments(self, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Moments (…, w) of a mean (…, n) and a covariance (…, n, n), without an unknown start."""
        found = [mean, pack(factored(covariance) if self.factored else covariance)]
        if len(self.state) > self.n + self.q:
            rest = np.repeat([1.0, 0.0], [len(self.units), len(self.state) - self.loaded])
            found.append(np.broadcast_to(rest, (*mean.shape[:-1], len(rest))))
        return np.concatenate(found, axis=-1)

    def put(self, state: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Moments (…, w) with another covariance (…, n, n)."""
        found = self.packed_moments(state[..., : self.n], covariance)
        found[..., self.loaded :] = state[..., self.loaded :]
        return found

    @property
    def loaded(self) -> int:
        """Place of the first loading in the moments."""
        return self.n + self.q + len(self.units)

    def unknown_of(self, state: np.ndarray) -> np.ndarray:
        """Φ N (…, n, unknown) of moments (…, w), 0 where rounding alone is left."""
        n, d, first = self.n, self.unknown, self.loaded
        loadings = state[..., first : first + n * d].reshape(*state.shape[:-1], n, d)
        directions = state[..., first + n * d : first + (n + d) * d].reshape(*state.shape[:-1], d, d)
        found = loadings @ directions
        return np.where(np.abs(found) > UNSEEN * (np.abs(loadings) @ np.abs(directions)), found, 0.0)

    # -- pieces of the trace ---------------------------------------------------------------------------------
    def _lower(self, matrix: Matrix) -> list[Expression]:
        return [self.graph.lift(matrix[i][j]) for i in range(self.n) for j in range(i + 1)]

    def _square(self, packed: Sequence[Expression]) -> Matrix:
        return [[packed[place(i, j)] for j in range(self.n)] for i in range(self.n)]

    def _predicted(self, made: Step) -> list[Expression]:
        """Packed factors of F P F' + Q."""
        lower, diagonal = self._factors()
        own, spread = factors(made.noise)
        rows = [[*a, *b] for a, b in zip(product(made.transition, lower), own, strict=True)]
        return self._packed(*orthogonalised(rows, [*diagonal, *spread]))

    def _factors(self) -> tuple[Matrix, list[Value]]:
        """L (n, n) and D (n,) of the moments."""
        units = dict(zip(self.model.resets, self.units, strict=True))
        diagonal = [self.packed[place(i, i)] for i in range(self.n)]
        lower: Matrix = [[self.packed[place(i, j)] for j in range(i)] for i in range(self.n)]
        return [[*row, units.get(i, 1.0), *[0.0] * (self.n - i - 1)] for i, row in enumerate(lower)], diagonal

    def _packed(self, lower: Matrix, diagonal: list[Value]) -> list[Expression]:
        return self._lower([[*row[:i], diagonal[i]] for i, row in enumerate(lower)])

    def _trace_update(self, prediction: Value, variance: Value) -> tuple[Block, Expression]:
        """Outputs for one reading with this prediction and variance of its noise: moments, innovation, its
        variance, and the log-likelihood term without its constant; and the variance once more, NaN where the
        reading depends on a direction of the start that is unknown."""
        g = self.graph
        prediction = g.lift(prediction)
        row = jacobian([prediction], self.mean)[0]
        if self.factored:
            lower, diagonal = self._factors()
            shown = [dot([lower[i][j] for i in range(j, self.n)], row[j:]) for j in range(self.n)]
            weighted = [dot([d], [f]) for d, f in zip(diagonal, shown, strict=True)]
            cross = [dot(lower[i][: i + 1], weighted[: i + 1]) for i in range(self.n)]
            spread = g.lift(dot(weighted, shown) + variance)
        else:
            cross = [dot(self.covariance[i], row) for i in range(self.n)]
            spread = g.lift(_quadratic(row, self.covariance, cross) + variance)
        error = self.reading - prediction
        if not self.unknown:
            usual, quadratic = self._usual(row, cross, error, spread, variance)
            return [*usual, error, spread, quadratic], spread
        return self._diffuse_update(row, cross, error, spread, variance)

    def _usual(
        self, row: list[Value], cross: list[Value], error: Expression, spread: Expression, variance: Value
    ) -> tuple[list[Value], Expression]:
        """Mean and covariance after a reading, and its e²/S."""
        inverse = 1.0 / spread
        quadratic = error * error * inverse
        weight = self._weight(quadratic)
        gain = [0.0 if is_zero(c) else c * (weight * inverse) for c in cross]
        mean = [m if is_zero(k) else m + k * error for m, k in zip(self.mean, gain, strict=True)]
        if self.factored:  # a weight is as much more noise
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
        as by a reading at the bound, so that it follows readings that stay far off.
        """
        if math.isinf(self.model.bound):
            return 1.0
        ratio = maximum(quadratic * (1.0 / self.square), 1.0)  # never 0, where the root has no finite slope
        # the condition stands directly before the quotient and keeps it out of the ordinary step
        return where(quadratic > self.square, 1.0 / sqrt(ratio), 1.0)

    @property
    def square(self) -> float:
        """b², from which the squared innovations count less."""
        return self.model.bound**2

    def term_slope(self, quadratic: Expression) -> Value:
        """Slope of a reading's term in −2 ln L along e²/S = `quadratic`.

        The term is e²/S, and beyond b² it is b² (1 + ln(e²/(b² S))): the tail of Student's distribution with
        about b² degrees of freedom.  A few readings far off thus do not buy the variances of all others.
        """
        if math.isinf(self.square):
            return 1.0
        return where(quadratic > self.square, self.square / maximum(quadratic, self.square), 1.0)

    def _diffuse_update(
        self, row: list[Value], cross: list[Value], error: Expression, spread: Expression, variance: Value
    ) -> tuple[Block, Expression]:
        """The exact diffuse update where the reading depends on an unknown direction of the start, else the
        usual update."""
        g, n = self.graph, self.n
        towards, rest = self._resolved(row)
        m = [dot(loading, towards) for loading in self.loadings]
        f = g.lift(dot(row, m))
        seen = f > 0.0
        usual, quadratic = self._usual(row, cross, error, where(seen, 1.0, spread), variance)
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
        """What a reading with these slopes shows of the start, (unknown,), 0 where it shows nothing, and the
        directions (unknown²,) that are then left.

        A Householder reflection turns the columns of N so that the reading depends on one alone, which is
        then known.  The column is the one that it depends on most: small entries keep their digits.
        """
        d, n = self.unknown, self.directions
        shown = [dot(row, [loading[j] for loading in self.loadings]) for j in range(d)]
        size = [v if is_zero(v) else maximum(v, -v) for v in shown]
        if all(map(is_zero, shown)):
            return [0.0] * d, _flat(n)
        free: list[Value] = []
        for j in range(d):
            column = [n[i][j] for i in range(d)]
            depends = dot(shown, column)
            reach = dot(size, [maximum(v, -v) for v in column])
            free.append(where(maximum(depends, -depends) > UNSEEN * reach, depends, 0.0))
        square = dot(free, free)
        length = sqrt(where(square > 0.0, square, 1.0))
        largest: Value = 0.0
        for v in free:
            largest = maximum(largest, maximum(v, -v))
        left, chosen = 1.0, []
        for v in free:  # 1 for the first of the largest, 0 for the others
            chosen.append(where(maximum(v, -v) < largest, 0.0, left))
            left = left - chosen[-1]
        most = dot(free, chosen)
        sign = where(most < 0.0, -1.0, 1.0)
        mirror = [v + c * sign * length for v, c in zip(free, chosen, strict=True)]
        scale = 1.0 / where(square > 0.0, square + sign * most * length, 1.0)
        rest = [
            (1.0 - chosen[j]) * (n[i][j] - dot(n[i], mirror) * (scale * mirror[j]))
            for i in range(d)
            for j in range(d)
        ]
        return [dot(n[i], free) for i in range(d)], rest

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
        key = {e.index for e in self.key_leaves}
        key |= {self.share.index, *(e.index for one in operations(self.early) for e in one.into)}
        result: list[int] = []
        for i, node in enumerate(self.graph.nodes):
            if node[0] == "const":
                result.append(CONSTANT)
            elif node[0] == "symbol":
                at_key = i in key
                early = node[1].startswith(("p:", "c:"))
                result.append(PARAMETER if early else KEY if at_key else INSTANT)
            else:
                result.append(max(result[j] for j in arguments(node)))
        return result

    @cached_property
    def jacobian_entries(self) -> dict[tuple[int, int], Value]:
        """The entries of the Jacobian that are not zero, by row and column."""
        return _entries(self.jacobian)

    @cached_property
    def noise_entries(self) -> dict[tuple[int, int], Value]:
        """The entries of the noise that are not zero, by row and column."""
        return _entries(self.noise)

    def cuts(self, timeline: Timeline) -> Iterable[int]:
        """Instants at which a run is cut, so that its loops do not need too much memory."""
        return ()

    @cached_property
    def uncertainty(self) -> Matrix:
        """The covariance of the moments, with a variance of 1 in directions of which nothing is known."""
        found = self.covariance
        if self.factored:
            lower, diagonal = self._factors()
            weighted = [[dot([v], [d]) for v, d in zip(row, diagonal, strict=True)] for row in lower]
            found = product(weighted, transpose(lower))
        if self.unknown:
            free = product(self.loadings, self.directions)
            found = add(found, product(free, transpose(free)))
        return found

    @cached_property
    def comparisons(self) -> list[Expression]:
        """The comparisons of states that the rates make, as 1 or 0."""
        states = [f"m{i}" for i in range(self.n)]
        made = [
            Expression(self.graph, i) for i in self.graph.needed(self.rates) if self.graph.nodes[i][0] == "lt"
        ]
        return [where(one, 1.0, 0.0) for one in made if depends_on(self.graph, one, states)]

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
        """Nodes of earlier stages read by the code of `stage`: (of the parameter stage, of the key stage)."""
        stages = self.stage
        found: set[int] = set()
        for i in self.graph.needed(outputs):
            if stages[i] == stage:
                found.update(j for j in self._read_by(i) if stages[j] < stage)
            elif any(e.index == i for e in outputs):
                found.add(i)
        known = sorted(found)
        return (
            [i for i in known if stages[i] == PARAMETER],
            [i for i in known if stages[i] == KEY],
        )

    def _read_by(self, i: int) -> list[int]:
        """Nodes whose numbers node i needs; in place of a condition, which is not a number, the nodes that it
        compares."""
        found: list[int] = []
        for j in arguments(self.graph.nodes[i]):
            found.extend(arguments(self.graph.nodes[j]) if self.graph.nodes[j][0] == "lt" else [j])
        return found

    @cached_property
    def variances(self) -> Variances:
        return variances_of(self.graph, self.model, self.p, self.now, self.mean)

    @cached_property
    def driven(self) -> np.ndarray:
        """(n,) True for states that follow an input, by themselves or through other states."""
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
        late = [list(one.block) for one in operations(self.late)]
        return [self.predict, *self.updates, self.gathered[1], *late]

    @cached_property
    def key_nodes(self) -> list[int]:
        """Nodes computed once per distinct key, in the order of the key table."""
        _ = self.stage
        found: set[int] = set()
        for block in self._blocks:
            found.update(self.boundary(block, INSTANT)[1])
        found.update(e.index for e in self.transition if self.stage[e.index] == KEY)
        return sorted(found)

    @cached_property
    def parameter_nodes(self) -> list[int]:
        """Nodes that depend only on the parameters and are read later, including the parameters
        themselves."""
        found: set[int] = set()
        for block in self._blocks:
            found.update(self.boundary(block, INSTANT)[0])
        keys = [Expression(self.graph, i) for i in self.key_nodes]
        keys.extend(e for one in operations(self.early) for e in one.block)
        keys.extend(self.reach)
        found.update(self.boundary(keys, KEY)[0])
        found.update(e.index for b in self._blocks for e in b if self.stage[e.index] == PARAMETER)
        found.update(e.index for e in self.transition if self.stage[e.index] == PARAMETER)
        return sorted(found)

    @cached_property
    def estimated_nodes(self) -> list[int]:
        """The members of `parameter_nodes` that depend on a parameter; the others have no derivative."""
        names = [f"p:{name}" for name in self.p]
        return [i for i in self.parameter_nodes if depends_on(self.graph, Expression(self.graph, i), names)]

    def _digest(self) -> str:
        """Digest of everything that determines the compiled loops: recursions with the same digest share
        their code."""
        model, blocks = self.model, self._blocks
        own = {k: v for k, v in vars(self).items() if k not in ("model", "graph", "constants")}
        content = (
            *(model.states, model.inputs, model.outputs, model.resets),
            *(self.wide, self.square, self.graph.nodes, blocks, own),
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


def _entries(matrix: Matrix) -> dict[tuple[int, int], Value]:
    return {
        (i, j): entry for i, row in enumerate(matrix) for j, entry in enumerate(row) if not is_zero(entry)
    }


def _flat(matrix: Matrix) -> list[Value]:
    return [entry for row in matrix for entry in row]


def _lifted(graph: Graph, value: Expression | float) -> Expression | float:
    return 0.0 if is_zero(value) else graph.lift(value)


def traced(model: Model, unknown: int = 0, factored: bool = False) -> Recursion:
    """The filter of a model, traced at first use; `unknown`, `factored` as in `Recursion`."""
    # the model keeps its filters: each of them holds the model, so that nothing else could let them go
    filters: dict[tuple[int, bool], Recursion] = vars(model).setdefault("_filters", {})
    found = filters.get((unknown, factored))
    if found is None:
        found = filters.setdefault((unknown, factored), Recursion(model, unknown, factored))
    return found
