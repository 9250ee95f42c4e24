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
from functools import cache, cached_property

import numpy as np

from hygrokf.engine.discretisation import congruence, operations, step
from hygrokf.physics.expression import (
    Expression,
    Graph,
    Matrix,
    Value,
    arguments,
    depends_on,
    dot,
    is_zero,
    jacobian,
    maximum,
    sqrt,
    where,
)
from hygrokf.physics.holds import LINEAR, PREVIOUS, REGIME
from hygrokf.physics.model import Model, Values

DIFFUSE_TOLERANCE = 1e-9
"""An infinite variance counts as resolved below this share of its initial value."""

CONSTANT, PARAMETER, KEY, INSTANT = range(4)
"""Stages: when a value first becomes known."""
Block = list[Expression]
"""Outputs of traced straight-line code."""


class Recursion:
    """The filter of one model as expressions.

    With `diffuse`, a second covariance P∞ follows the first in the moments: the prior covariance is κ P∞ with
    κ → ∞ (exact diffuse start, Durbin & Koopman 2012, section 5.2).
    """

    def __init__(self, model: Model, diffuse: bool = False) -> None:
        self.model = model
        self.diffuse = diffuse
        self.graph = Graph()
        g = self.graph
        n = len(model.states)
        self.n, self.q = n, n * (n + 1) // 2
        self.p = {p.name: g.symbol(f"p:{p.name}") for p in model.parameters}
        self.holds = model.input_holds
        self.varying = [name for name, hold in self.holds.items() if hold != REGIME]
        self.regimes = [name for name, hold in self.holds.items() if hold == REGIME]
        self.h = g.symbol("h")
        regime = {name: g.symbol(f"g:{name}") for name in self.regimes}
        self.key_leaves = [self.h, *regime.values()]
        self.mean = [g.symbol(f"m{i}") for i in range(n)]
        self.packed = [g.symbol(f"P{i}{j}") for i in range(n) for j in range(i + 1)]
        self.covariance = self._square(self.packed)
        self.infinite = [g.symbol(f"I{i}{j}") for i in range(n) for j in range(i + 1)] if diffuse else []
        self.state = [*self.mean, *self.packed, *self.infinite]
        self.start, self.end, self.now = {}, {}, {}
        for name in self.varying:
            hold = self.holds[name]
            self.now[name] = g.symbol(f"b:{name}")
            self.start[name] = g.symbol(f"a:{name}") if hold in (LINEAR, PREVIOUS) else self.now[name]
            self.end[name] = self.start[name] if hold == PREVIOUS else self.now[name]
        for table in (self.start, self.end, self.now):
            table.update(regime)
        self.reading = g.symbol("y")

        self.noise = [[_lifted(g, v) for v in row] for row in model.noise(self.p)]
        made = step(
            g,
            lambda x, u: model.traced(x, u, self.p).rates,
            self.noise,
            self.mean,
            self.covariance,
            self.start,
            self.end,
            self.h,
            [f"m{i}" for i in range(n)] + [f"{end}:{name}" for end in "ab" for name in self.varying],
        )
        self.share, self.early, self.late = made.share, made.early, made.late
        self.exact, self.reach = made.exact, made.reach
        self.registers = {e.index: e for one in operations(self.late) for e in one.into}
        self.predict: Block = [*made.mean, *self._lower(made.covariance)]
        if diffuse:
            self.predict.extend(self._lower(congruence(made.transition, self._square(self.infinite))))
        at = model.traced(self.mean, self.now, self.p)
        self.rates = [g.lift(v) for v in at.rates]
        self.jacobian = jacobian(self.rates, self.mean)
        self.updates = [self._trace_update(*at.outputs[name]) for name in model.outputs]
        self.transition = [g.lift(v) for row in made.transition for v in row]
        self.given = [g.symbol(f"c:{i}") for i in range(len(g.given))]
        self.constants = np.array(g.given, dtype=float)
        self.structure = self._digest()

    # -- tracing ---------------------------------------------------------------------------------------------
    def _lower(self, matrix: Matrix) -> list[Expression]:
        return [self.graph.lift(matrix[i][j]) for i in range(self.n) for j in range(i + 1)]

    def _square(self, packed: Sequence[Expression]) -> Matrix:
        return [[packed[place(i, j)] for j in range(self.n)] for i in range(self.n)]

    def _trace_update(self, prediction: Value, variance: Value) -> Block:
        """Outputs for one reading with this prediction and variance of its noise: mean, packed covariance,
        innovation, its variance, and the log-likelihood term without its constant."""
        g = self.graph
        prediction = g.lift(prediction)
        row = jacobian([prediction], self.mean)[0]
        cross = [dot(self.covariance[i], row) for i in range(self.n)]
        spread = g.lift(_quadratic(row, self.covariance, cross) + variance)
        inverse = 1.0 / spread
        error = self.reading - prediction
        quadratic = error * error * inverse
        weight = self._weight(quadratic)
        gain = [0.0 if is_zero(c) else c * (weight * inverse) for c in cross]
        mean = [m if is_zero(k) else m + k * error for m, k in zip(self.mean, gain, strict=True)]
        covariance = [
            self.covariance[i][j]
            if is_zero(gain[i]) or is_zero(cross[j])
            else self.covariance[i][j] - (cross[i] * cross[j]) * (weight * inverse)
            for i in range(self.n)
            for j in range(i + 1)
        ]
        if not self.diffuse:
            return [*mean, *covariance, error, spread, quadratic]
        return self._diffuse_update(row, cross, error, spread, [*mean, *covariance], quadratic)

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
        self,
        row: list[Value],
        cross: list[Value],
        error: Expression,
        spread: Expression,
        usual: list[Value],
        quadratic: Expression,
    ) -> Block:
        """The exact diffuse update where the reading depends on an infinite variance, else the usual
        update."""
        n = self.n
        infinite = self._square(self.infinite)
        m = [dot(infinite[i], row) for i in range(n)]
        f = self.graph.lift(dot(row, m))
        seen = f > DIFFUSE_TOLERANCE
        inverse = 1.0 / where(seen, f, 1.0)
        mean = [v + (m[i] * inverse) * error for i, v in enumerate(self.mean)]
        lower = [(i, j) for i in range(n) for j in range(i + 1)]
        covariance = [
            self.covariance[i][j]
            + m[i] * m[j] * inverse * inverse * spread
            - (cross[i] * m[j] + m[i] * cross[j]) * inverse
            for i, j in lower
        ]
        rest = [where(seen, infinite[i][j] - m[i] * m[j] * inverse, infinite[i][j]) for i, j in lower]
        moments = [where(seen, a, b) for a, b in zip([*mean, *covariance], usual, strict=True)]
        return [*moments, *rest, error, where(seen, f, spread), where(seen, 0.0, quadratic)]

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

    @cached_property
    def comparisons(self) -> list[Expression]:
        """The comparisons of states that the rates make, as 1 or 0."""
        states = [f"m{i}" for i in range(self.n)]
        made = [
            Expression(self.graph, i) for i in self.graph.needed(self.rates) if self.graph.nodes[i][0] == "lt"
        ]
        return [where(one, 1.0, 0.0) for one in made if depends_on(self.graph, one, states)]

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
    def _blocks(self) -> list[Block]:
        late = [list(one.block) for one in operations(self.late)]
        return [self.predict, *self.updates, *late, *([] if self.exact else [self.reach])]

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
        keys.extend(self.reach if self.exact else [])
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
        outputs = [[e.index for e in block] for block in self._blocks]
        model = self.model
        content = (
            *(list(self.p), model.states, sorted(self.holds.items()), model.inputs),
            *(model.resets, self.diffuse, self.graph.nodes, outputs),
            [e.index for e in self.transition],
            repr((self.early, self.late)),
        )
        return hashlib.sha256(repr(content).encode()).hexdigest()


def bounded_weight(quadratic: np.ndarray, bound: float) -> np.ndarray:
    """Square root min(1, b √S/|e|) of a reading's weight in the score; `quadratic` e²/S, `bound` b."""
    return np.ones_like(quadratic) if math.isinf(bound) else bound / np.sqrt(np.maximum(quadratic, bound**2))


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


def _lifted(graph: Graph, value: Expression | float) -> Expression | float:
    return 0.0 if is_zero(value) else graph.lift(value)


# -- memory layout of the moments: a mean, then the lower triangle of a covariance by rows -------------------
def place(i: int, j: int) -> int:
    """Place of entry (i, j) in a packed lower triangle."""
    i, j = max(i, j), min(i, j)
    return i * (i + 1) // 2 + j


def trace_width(n: int, outputs: int, diffuse: bool = False) -> int:
    """Numbers in one row of a trace: moments before and after, two for every output, the transition
    matrix."""
    return 2 * (n + (2 if diffuse else 1) * (n * (n + 1) // 2)) + 2 * outputs + n * n


@cache
def _places(n: int) -> np.ndarray:
    return np.array([[place(i, j) for j in range(n)] for i in range(n)])


@cache
def _triangle(n: int) -> tuple[np.ndarray, np.ndarray]:
    return np.tril_indices(n)


def unpack(packed: np.ndarray, n: int) -> np.ndarray:
    """Packed lower triangles (..., q) as symmetric matrices (..., n, n)."""
    return packed[..., _places(n)]


def pack(matrix: np.ndarray) -> np.ndarray:
    """Symmetric matrices (..., n, n) as packed lower triangles (..., q)."""
    rows, columns = _triangle(matrix.shape[-1])
    return np.ascontiguousarray(matrix[..., rows, columns])


def traced(model: Model, diffuse: bool = False) -> Recursion:
    """The filter of a model, traced at first use; with `diffuse` it carries an infinite covariance too."""
    # the model keeps its filters: each of them holds the model, so that nothing else could let them go
    filters: dict[bool, Recursion] = vars(model).setdefault("_filters", {})
    found = filters.get(diffuse)
    return filters.setdefault(diffuse, Recursion(model, diffuse)) if found is None else found
