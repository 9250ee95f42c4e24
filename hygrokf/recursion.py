"""The extended Kalman filter of one traced model as compiled loops: value, score, sensitivities, trace.

One step of the filter is traced once as two kinds of blocks, `predict` (a sub-step) and `update` (one scalar
reading); everything else is made from them: the likelihood, its adjoint (score), its tangents (sensitivities of
every innovation) and the trace of all moments.  Readings of one instant are taken one after the other, each
linearised at the state that the one before left; a missing reading (NaN) is left out, so that a gap, a dead sensor
and a forecast are one code path.  Every loop starts from a given Gaussian and returns the last one: the offline
filter is a fold of the online step.

Values are computed where they first can be: with the parameters, with the distinct steps ("keys": sub-step length
and regime), or at every instant.

Shapes: T instants, n states, q = n (n+1)/2 packed covariance entries (lower triangle by rows), m inputs,
k outputs, d parameters, L = `LANES`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from hygrokf.discretisation import Step, congruence, step
from hygrokf.emission import LANES, SCALAR, VECTOR, Writer, declarations, literal
from hygrokf.expression import (
    Expression,
    Graph,
    Matrix,
    arguments,
    dot,
    forward,
    is_zero,
    jacobian,
    reverse,
    where,
)
from hygrokf.machine import Code

LINEAR = "linear"
ZERO_ORDER = "zero-order"
REGIME = "regime"
DIFFUSE_TOLERANCE = 1e-9
"""Below this share of its start an infinite variance counts as resolved."""
_CONSTANT, _PARAMETER, _KEY, _INSTANT = range(4)


@dataclass(frozen=True)
class System:
    """A continuous-time model as functions of expressions, ready to be traced.

    `inputs` maps names to holds (`linear`, `zero-order`, or `regime`: piecewise constant with few distinct values);
    `drift(x, u, p)` -> n rates [1/h]; `noise(p)` -> (n, n) intensity [1/h]; `outputs` are pairs (name,
    function (x, u, p) -> (prediction, noise variance)); `averages` maps a state index to the output whose running
    mean it is: it is set to zero where an averaging interval begins.
    """

    parameters: tuple[str, ...]
    states: tuple[str, ...]
    inputs: Mapping[str, str]
    drift: Callable
    noise: Callable
    outputs: tuple[tuple[str, Callable], ...]
    resets: tuple[int, ...] = ()


@dataclass
class _Block:
    """Traced straight-line code: outputs from leaves."""

    outputs: list[Expression]


class Recursion:
    """Compiled filter loops of one `System`.

    With `diffuse` the moments carry a second covariance P∞ behind the first: the part of the prior covariance κ P∞
    with κ → ∞ (exact-diffuse start, Durbin & Koopman 2012, section 5.2).
    """

    def __init__(self, system: System, diffuse: bool = False) -> None:
        self.system = system
        self.diffuse = diffuse
        self.graph = Graph()
        g = self.graph
        n = len(system.states)
        self.n, self.q = n, n * (n + 1) // 2
        self.p = {name: g.symbol(f"p:{name}") for name in system.parameters}
        self.varying = [name for name, hold in system.inputs.items() if hold != REGIME]
        self.regimes = [name for name, hold in system.inputs.items() if hold == REGIME]
        self.h = g.symbol("h")
        regime = {name: g.symbol(f"g:{name}") for name in self.regimes}
        self._key_leaves = [self.h, *regime.values()]
        self.mean = [g.symbol(f"m{i}") for i in range(n)]
        self.packed = [g.symbol(f"P{i}{j}") for i in range(n) for j in range(i + 1)]
        self.covariance = self._square(self.packed)
        self.infinite = [g.symbol(f"I{i}{j}") for i in range(n) for j in range(i + 1)] if diffuse else []
        self.state = [*self.mean, *self.packed, *self.infinite]
        self.start, self.end, self.now = {}, {}, {}
        for name in self.varying:
            self.end[name] = self.now[name] = g.symbol(f"b:{name}")
            linear = system.inputs[name] == LINEAR
            self.start[name] = g.symbol(f"a:{name}") if linear else self.end[name]
        for table in (self.start, self.end, self.now):
            table.update(regime)
        self.reading = g.symbol("y")

        self.noise = [[_lifted(g, v) for v in row] for row in system.noise(self.p)]
        self.step: Step = step(
            g,
            lambda x, u: system.drift(x, u, self.p),
            self.noise,
            self.mean,
            self.covariance,
            self.start,
            self.end,
            self.h,
        )
        self.predict = _Block([*self.step.mean, *self._lower(self.step.covariance)])
        if diffuse:
            carried = congruence(self.step.transition, self._square(self.infinite))
            self.predict.outputs.extend(self._lower(carried))
        self.jacobian = jacobian(system.drift(self.mean, self.now, self.p), self.mean)
        self.updates = [self._trace_update(function) for _, function in system.outputs]
        self._transition_outputs = [g.lift(v) for row in self.step.transition for v in row]

    # -- tracing ---------------------------------------------------------------------------------------------
    def _lower(self, matrix: Matrix) -> list[Expression]:
        return [self.graph.lift(matrix[i][j]) for i in range(self.n) for j in range(i + 1)]

    def _square(self, packed: Sequence[Expression]) -> Matrix:
        return [[packed[_at(i, j)] for j in range(self.n)] for i in range(self.n)]

    def _trace_update(self, function: Callable) -> _Block:
        """Outputs: mean, packed covariance, innovation, its variance, log-likelihood term without its constant."""
        g = self.graph
        prediction, variance = function(self.mean, self.now, self.p)
        prediction = g.lift(prediction)
        row = jacobian([prediction], self.mean)[0]
        cross = [dot(self.covariance[i], row) for i in range(self.n)]
        spread = g.lift(dot(row, cross) + variance)
        inverse = 1.0 / spread
        error = self.reading - prediction
        gain = [0.0 if is_zero(c) else c * inverse for c in cross]
        mean = [m if is_zero(k) else m + k * error for m, k in zip(self.mean, gain, strict=True)]
        covariance = [
            self.covariance[i][j]
            if is_zero(gain[i]) or is_zero(cross[j])
            else self.covariance[i][j] - gain[i] * cross[j]
            for i in range(self.n)
            for j in range(i + 1)
        ]
        quadratic = error * error * inverse
        if not self.diffuse:
            return _Block([*mean, *covariance, error, spread, quadratic])
        return self._diffuse_update(row, cross, error, spread, [*mean, *covariance], quadratic)

    def _diffuse_update(
        self, row: list, cross: list, error: Expression, spread: Expression, usual: list, quadratic: Expression
    ) -> _Block:
        """The exact-diffuse update where the reading sees an infinite variance, else the usual one."""
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
        return _Block(
            [*moments, *rest, error, where(seen, f, spread), where(seen, 0.0, quadratic)]
        )

    @cached_property
    def stage(self) -> list[int]:
        """For every node, the earliest stage at which its value is known."""
        key = {e.index for e in self._key_leaves}
        result: list[int] = []
        for i, node in enumerate(self.graph.nodes):
            if node[0] == "const":
                result.append(_CONSTANT)
            elif node[0] == "symbol":
                at_key = i in key
                result.append(_PARAMETER if node[1].startswith("p:") else _KEY if at_key else _INSTANT)
            else:
                result.append(max(result[j] for j in arguments(node)))
        return result

    def _boundary(self, outputs: Sequence[Expression], stage: int) -> tuple[list[int], list[int]]:
        """Nodes of earlier stages that code of `stage` reads: (of the parameter stage, of the key stage)."""
        stages = self.stage
        found: set[int] = set()
        for i in self.graph.needed(outputs):
            if stages[i] == stage:
                found.update(j for j in self._read_by(i) if stages[j] < stage)
            elif any(e.index == i for e in outputs):
                found.add(i)
        known = sorted(found)
        return (
            [i for i in known if stages[i] == _PARAMETER],
            [i for i in known if stages[i] == _KEY],
        )

    def _read_by(self, i: int) -> list[int]:
        """Nodes whose numbers node i needs; a condition is no number, what it compares is carried in its place."""
        found = []
        for j in arguments(self.graph.nodes[i]):
            found.extend(arguments(self.graph.nodes[j]) if self.graph.nodes[j][0] == "lt" else [j])
        return found

    @cached_property
    def _blocks(self) -> list[_Block]:
        return [self.predict, *self.updates]

    @cached_property
    def key_nodes(self) -> list[int]:
        """Nodes computed once for each distinct key, in the order of the key table."""
        _ = self.stage
        found: set[int] = set()
        for block in self._blocks:
            found.update(self._boundary(block.outputs, _INSTANT)[1])
        found.update(e.index for e in self._transition_outputs if self.stage[e.index] == _KEY)
        return sorted(found)

    @cached_property
    def parameter_nodes(self) -> list[int]:
        """Nodes that depend on the parameters alone and are read later, parameters themselves included."""
        found: set[int] = set()
        for block in self._blocks:
            found.update(self._boundary(block.outputs, _INSTANT)[0])
        keys = [Expression(self.graph, i) for i in self.key_nodes]
        found.update(self._boundary(keys, _KEY)[0])
        found.update(
            e.index for b in self._blocks for e in b.outputs if self.stage[e.index] == _PARAMETER
        )
        found.update(
            e.index for e in self._transition_outputs if self.stage[e.index] == _PARAMETER
        )
        return sorted(found)

    def code(self, kind: str, gain: bool = True) -> Code:
        """Compiled function of a kind: value, trace, adjoint, tangent; without gain the filter runs free."""
        made = self.__dict__.setdefault("_codes", {})
        if (kind, gain) not in made:
            text = declarations() + _Emission(self, gain).function(kind)
            made[kind, gain] = Code(text, [kind])
        return made[kind, gain]


@dataclass
class _Emission:
    """LLVM text of the loops of one recursion."""

    recursion: Recursion
    gain: bool
    writer: Writer = field(init=False)

    def function(self, kind: str) -> str:
        arguments_ = {
            "value": _COMMON + [("ptr", "out")],
            "trace": _COMMON + [("ptr", "out"), ("ptr", "rows")],
            "adjoint": _COMMON + [("ptr", "out"), ("ptr", "store"), ("ptr", "keybar"), ("ptr", "thetabar"), ("ptr", "statebar"), ("ptr", "buffer")],
            "tangent": _COMMON + [("ptr", "out"), ("ptr", "seeds"), ("ptr", "statedot"), ("ptr", "keydot"), ("ptr", "e"), ("ptr", "s"), ("ptr", "edot"), ("ptr", "sdot")],
        }[kind]
        self.writer = Writer(kind, arguments_)
        self._parameters()
        self._keys()
        getattr(self, "_" + kind)()
        return self.writer.text()

    # -- stages before the time loop -------------------------------------------------------------------------
    def _parameters(self) -> None:
        r, w = self.recursion, self.writer
        self.at_parameters: dict[int, str] = {}
        for i, e in enumerate(r.p.values()):
            self.at_parameters[e.index] = w.load(SCALAR, w.at(SCALAR, "%theta", i))
        wanted = [Expression(r.graph, i) for i in r.parameter_nodes]
        for e, (_, name) in zip(wanted, w.block(r.graph, wanted, self.at_parameters), strict=True):
            self.at_parameters[e.index] = name

    def _key_row(self, key: str) -> dict[int, str]:
        """Values of the key's leaves: sub-step length and regimes."""
        r, w = self.recursion, self.writer
        row = w.integer("mul", key, len(r._key_leaves))
        return {
            e.index: w.load(SCALAR, w.at(SCALAR, "%keys", w.integer("add", row, c)))
            for c, e in enumerate(r._key_leaves)
        }

    def _keys(self) -> None:
        r, w = self.recursion, self.writer
        wanted = [Expression(r.graph, i) for i in r.key_nodes]
        with w.loop("%nkeys") as key:
            leaves = self._key_row(key) | self.at_parameters
            values = w.block(r.graph, wanted, leaves)
            row = w.integer("mul", key, len(wanted))
            for c, (_, name) in enumerate(values):
                w.store(SCALAR, name, w.at(SCALAR, "%table", w.integer("add", row, c)))

    # -- pieces of the time loop -----------------------------------------------------------------------------
    def _slots(self, prefix: Sequence[Expression], kind: str = SCALAR) -> dict[int, str]:
        return {e.index: self.writer.slot(kind) for e in prefix}

    def _read(self, slots: Mapping[int, str], kind: str = SCALAR) -> dict[int, str]:
        return {i: self.writer.load(kind, s) for i, s in slots.items()}

    def _load_state(self, slots: Mapping[int, str], base: str, row: str | int = 0) -> None:
        w = self.writer
        start = w.integer("mul", row, len(slots))
        for c, s in enumerate(slots.values()):
            w.store(SCALAR, w.load(SCALAR, w.at(SCALAR, base, w.integer("add", start, c))), s)

    def _save_state(self, slots: Mapping[int, str], base: str, row: str | int = 0) -> None:
        w = self.writer
        start = w.integer("mul", row, len(slots))
        for c, s in enumerate(slots.values()):
            w.store(SCALAR, w.load(SCALAR, s), w.at(SCALAR, base, w.integer("add", start, c)))

    def _instant_keys(self, k: str) -> tuple[str, str]:
        """(row of the key table as i64, number of sub-steps as i64) of the step that ends at instant k."""
        w = self.writer
        key = self._index("%key", k)
        return key, self._index("%nsub", key)

    def _index(self, base: str, place: str) -> str:
        w = self.writer
        value = w.load("i32", w.at("i32", base, place))
        return w.value(f"sext i32 {value} to i64")

    def _table(self, key: str) -> dict[int, str]:
        r, w = self.recursion, self.writer
        row = w.integer("mul", key, len(r.key_nodes))
        values = {
            i: w.load(SCALAR, w.at(SCALAR, "%table", w.integer("add", row, c)))
            for c, i in enumerate(r.key_nodes)
        }
        return self._key_row(key) | values

    def _inputs_within(self, k: str, j: str, count: str) -> dict[int, str]:
        """Inputs at the start and the end of sub-step j of `count`, between instants k−1 and k."""
        r, w = self.recursion, self.writer
        m = len(r.varying)
        row = w.integer("mul", k, m)
        before = w.integer("sub", row, m)
        parts = w.value(f"sitofp i64 {count} to double")
        part = w.real("fdiv", literal(1.0), parts)
        left = w.real("fmul", w.value(f"sitofp i64 {j} to double"), part)
        right = w.real("fmul", w.value(f"sitofp i64 {w.integer('add', j, 1)} to double"), part)
        result = {}
        for c, name in enumerate(r.varying):
            value = w.load(SCALAR, w.at(SCALAR, "%u", w.integer("add", row, c)))
            if r.system.inputs[name] == LINEAR:
                old = w.load(SCALAR, w.at(SCALAR, "%u", w.integer("add", before, c)))
                rise = w.real("fsub", value, old)
                for table, fraction in ((r.start, left), (r.end, right)):
                    result[table[name].index] = w.real("fadd", old, w.real("fmul", rise, fraction))
            else:
                result[r.end[name].index] = value
        return result

    def _inputs_at(self, k: str) -> dict[int, str]:
        r, w = self.recursion, self.writer
        row = w.integer("mul", k, len(r.varying))
        return {
            r.now[name].index: w.load(SCALAR, w.at(SCALAR, "%u", w.integer("add", row, c)))
            for c, name in enumerate(r.varying)
        }

    def _predict(self, slots: Mapping[int, str], k: str, key: str, count: str, each: object = None) -> None:
        r, w = self.recursion, self.writer
        with w.loop(count) as j:
            if each is not None:
                each(j)
            leaves = self._read(slots) | self._table(key) | self._inputs_within(k, j, count)
            values = w.block(r.graph, r.predict.outputs, leaves | self.at_parameters)
            for s, (_, name) in zip(slots.values(), values, strict=True):
                w.store(SCALAR, name, s)

    def _readings(self, k: str) -> list[tuple[str, str]]:
        """(value, condition that it is there) of every output at instant k."""
        w = self.writer
        count = len(self.recursion.updates)
        row = w.integer("mul", k, count)
        result = []
        for c in range(count):
            y = w.load(SCALAR, w.at(SCALAR, "%y", w.integer("add", row, c)))
            result.append((y, w.value(f"fcmp ord double {y}, {literal(0.0)}")))
        return result

    def _update_leaves(self, slots: Mapping[int, str], k: str, key: str, y: str) -> dict[int, str]:
        return (
            self._read(slots)
            | self._table(key)
            | self._inputs_at(k)
            | {self.recursion.reading.index: y}
            | self.at_parameters
        )

    def _resets(self, slots: Mapping[int, str], k: str, zero: str = literal(0.0), kind: str = SCALAR) -> None:
        """Set the running means to zero where their interval begins."""
        r, w = self.recursion, self.writer
        if not r.system.resets:
            return
        flags = w.load("i32", w.at("i32", "%reset", k))
        indices = list(slots)
        for bit, state in enumerate(r.system.resets):
            test = w.value(f"and i32 {flags}, {1 << bit}")
            with w.when(w.value(f"icmp ne i32 {test}, 0")):
                w.store(kind, zero, slots[indices[state]])
                for other in range(r.n):
                    w.store(kind, zero, slots[indices[r.n + _at(state, other)]])
                    if r.diffuse:
                        w.store(kind, zero, slots[indices[r.n + r.q + _at(state, other)]])

    # -- the functions ---------------------------------------------------------------------------------------
    def _value(self) -> None:
        w = self.writer
        slots = self._slots(self.recursion.state)
        self._load_state(slots, "%state")
        total = _Likelihood(w)
        with w.loop("%count") as k:
            key, parts = self._instant_keys(k)
            self._predict(slots, k, key, parts)
            self._correct(slots, k, key, total)
            self._resets(slots, k)
        self._save_state(slots, "%state")
        total.write(w, "%out")

    def _correct(self, slots: Mapping[int, str], k: str, key: str, total: _Likelihood) -> None:
        w, r = self.writer, self.recursion
        for update, (y, there) in zip(r.updates, self._readings(k), strict=True):
            with w.when(there):
                values = w.block(r.graph, self._kept(update), self._update_leaves(slots, k, key, y))
                total.take(w, values[-2][1], values[-1][1])
                if self.gain:
                    for s, (_, name) in zip(slots.values(), values, strict=False):
                        w.store(SCALAR, name, s)

    def _kept(self, update: _Block) -> list[Expression]:
        """What an update computes: without gain only the innovation, its variance and the quadratic form."""
        return update.outputs if self.gain else update.outputs[-3:]

    def _trace(self) -> None:
        """Rows: mean, covariance before; (prediction, variance) of every output; after; transition."""
        w, r = self.writer, self.recursion
        slots = self._slots(self.recursion.state)
        self._load_state(slots, "%state")
        total = _Likelihood(w)
        width = trace_width(r.n, len(r.updates), r.diffuse)
        transition = [w.slot(SCALAR) for _ in range(r.n * r.n)]
        with w.loop("%count") as k:
            key, parts = self._instant_keys(k)
            row = w.at(SCALAR, "%rows", w.integer("mul", k, width))
            for c, s in enumerate(transition):
                w.store(SCALAR, literal(1.0 if c % (r.n + 1) == 0 else 0.0), s)
            self._predict_with_transition(slots, transition, k, key, parts)
            self._save_state(slots, row)
            column = len(slots)
            for update, (y, there) in zip(r.updates, self._readings(k), strict=True):
                outputs = update.outputs[-3:-1]
                missing = w.value(f"select i1 {there}, double {y}, double {literal(0.0)}")
                leaves = self._update_leaves(slots, k, key, missing)
                (_, error), (_, variance) = w.block(r.graph, outputs, leaves)
                w.store(SCALAR, w.real("fsub", missing, error), w.at(SCALAR, row, column))
                w.store(SCALAR, variance, w.at(SCALAR, row, column + 1))
                column += 2
                with w.when(there):
                    values = w.block(
                        r.graph, self._kept(update), self._update_leaves(slots, k, key, y)
                    )
                    total.take(w, values[-2][1], values[-1][1])
                    if self.gain:
                        for s, (_, name) in zip(slots.values(), values, strict=False):
                            w.store(SCALAR, name, s)
            self._save_state(slots, w.at(SCALAR, row, column))
            column += len(slots)
            for c, s in enumerate(transition):
                w.store(SCALAR, w.load(SCALAR, s), w.at(SCALAR, row, column + c))
            self._resets(slots, k)
        self._save_state(slots, "%state")
        total.write(w, "%out")

    def _predict_with_transition(
        self, slots: Mapping[int, str], transition: Sequence[str], k: str, key: str, count: str
    ) -> None:
        r, w = self.recursion, self.writer
        n = r.n
        with w.loop(count) as j:
            leaves = self._read(slots) | self._table(key) | self._inputs_within(k, j, count)
            both = [*r.predict.outputs, *r._transition_outputs]
            values = w.block(r.graph, both, leaves | self.at_parameters)
            f = [name for _, name in values[len(slots) :]]
            old = [w.load(SCALAR, s) for s in transition]
            for i in range(n):
                for c in range(n):
                    total = w.real("fmul", f[i * n], old[c])
                    for inner in range(1, n):
                        term = w.real("fmul", f[i * n + inner], old[inner * n + c])
                        total = w.real("fadd", total, term)
                    w.store(SCALAR, total, transition[i * n + c])
            for s, (_, name) in zip(slots.values(), values, strict=False):
                w.store(SCALAR, name, s)

    def _adjoint(self) -> None:
        """Score by one forward pass that keeps the moments and one backward pass."""
        w, r, g = self.writer, self.recursion, self.recursion.graph
        slots = self._slots(self.recursion.state)
        self._load_state(slots, "%state")
        total = _Likelihood(w)
        # store: row 2k the moments before the updates of instant k, row 2k+1 those after it
        with w.loop("%count") as k:
            key, parts = self._instant_keys(k)
            self._predict(slots, k, key, parts)
            self._save_state(slots, "%store", w.integer("mul", k, 2))
            self._correct(slots, k, key, total)
            self._resets(slots, k)
            self._save_state(slots, "%store", w.integer("add", w.integer("mul", k, 2), 1))
        total.write(w, "%out")

        bars = self._slots(self.recursion.state)
        bar_symbol = {i: g.symbol(f"bar:{i}") for i in bars}
        self._load_state(bars, "%statebar")
        self.parameter_bars = {i: w.slot(SCALAR, literal(0.0)) for i in r.parameter_nodes}
        for e in r.p.values():
            self.parameter_bars.setdefault(e.index, w.slot(SCALAR, literal(0.0)))
        with w.loop("%count", backwards=True) as k:
            key, parts = self._instant_keys(k)
            self._resets(bars, k)
            self._reverse_updates(slots, bars, bar_symbol, k, key)
            self._reverse_predict(slots, bars, bar_symbol, k, key, parts)
        self._save_state(bars, "%statebar")
        self._reverse_stages()

    def _reverse_updates(
        self, slots: dict, bars: dict, bar_symbol: dict, k: str, key: str
    ) -> None:
        w, r = self.writer, self.recursion
        readings = self._readings(k)
        self._load_state(slots, "%store", w.integer("mul", k, 2))
        last = len(r.updates) - 1
        for c, update in enumerate(r.updates):  # moments before each update, kept in the buffer
            self._save_state(slots, "%buffer", c)
            if c < last and self.gain:
                y, there = readings[c]
                with w.when(there):
                    leaves = self._update_leaves(slots, k, key, y)
                    values = w.block(r.graph, update.outputs[: len(slots)], leaves)
                    for s, (_, name) in zip(slots.values(), values, strict=True):
                        w.store(SCALAR, name, s)
        for c in range(last, -1, -1):
            update = r.updates[c]
            y, there = readings[c]
            with w.when(there):
                self._load_state(slots, "%buffer", c)
                leaves = self._update_leaves(slots, k, key, y)
                seeds: dict[int, Expression] = {}
                if self.gain:
                    for e, i in zip(update.outputs, bars, strict=False):
                        _seed(seeds, e, bar_symbol[i])
                spread, quadratic = update.outputs[-2:]
                g = r.graph
                _seed(seeds, spread, -0.5 / spread)
                _seed(seeds, quadratic, g.constant(-0.5))
                self._reverse_block(update, seeds, leaves, bars, bar_symbol, key, keep=not self.gain)

    def _reverse_predict(
        self, slots: dict, bars: dict, bar_symbol: dict, k: str, key: str, parts: str
    ) -> None:
        """Back through the sub-steps; their starting moments are recomputed into the buffer when there are several."""
        w, r = self.writer, self.recursion
        first = w.value(f"icmp eq i64 {k}, 0")
        self._load_state(slots, "%first")
        with w.when(w.value(f"xor i1 {first}, true")):
            self._load_state(slots, "%store", w.integer("sub", w.integer("mul", k, 2), 1))

        def keep(j: str) -> None:
            self._save_state(slots, "%buffer", j)

        one = w.value(f"icmp sle i64 {parts}, 1")
        with w.when(one):
            self._save_state(slots, "%buffer", 0)
        with w.when(w.value(f"xor i1 {one}, true")):
            self._predict(slots, k, key, parts, each=keep)
        with w.loop(parts, backwards=True) as j:
            self._load_state(slots, "%buffer", j)
            leaves = self._read(slots) | self._table(key) | self._inputs_within(k, j, parts)
            seeds: dict[int, Expression] = {}
            for e, i in zip(r.predict.outputs, bars, strict=True):
                _seed(seeds, e, bar_symbol[i])
            self._reverse_block(
                r.predict, seeds, leaves | self.at_parameters, bars, bar_symbol, key, keep=False
            )

    def _reverse_block(
        self,
        block: _Block,
        seeds: dict[int, Expression],
        leaves: dict[int, str],
        bars: dict[int, str],
        bar_symbol: dict[int, Expression],
        key: str,
        keep: bool,
    ) -> None:
        """Adjoint of one block: replaces (or, `keep`, adds to) the bars of the state, adds to the earlier stages'."""
        w, r = self.writer, self.recursion
        parameters, keys = r._boundary(block.outputs, _INSTANT)
        targets = [*bars, *parameters, *keys]
        found = reverse(r.graph, seeds, targets)
        names = {bar_symbol[i].index: w.load(SCALAR, s) for i, s in bars.items()}
        order = [i for i in targets if i in found]
        values = w.block(r.graph, [found[i] for i in order], leaves | names)
        result = {i: name for i, (_, name) in zip(order, values, strict=True)}
        for i, s in bars.items():
            new = result.get(i, literal(0.0))
            if keep:
                new = w.real("fadd", new, w.load(SCALAR, s))
            w.store(SCALAR, new, s)
        for i in parameters:
            if i in result:
                _accumulate(w, result[i], self.parameter_bars[i])
        row = w.integer("mul", key, len(r.key_nodes))
        for i in keys:
            if i in result:
                column = r.key_nodes.index(i)
                pointer = w.at(SCALAR, "%keybar", w.integer("add", row, column))
                _accumulate(w, result[i], pointer)

    def _reverse_stages(self) -> None:
        """From the adjoints of the key table to those of the parameter stage, and to the parameters."""
        w, r, g = self.writer, self.recursion, self.recursion.graph
        keys = [Expression(g, i) for i in r.key_nodes]
        inner, _ = r._boundary(keys, _KEY)
        seeds = {i: g.symbol(f"keybar:{i}") for i in r.key_nodes}
        found = reverse(g, seeds, inner)
        order = [i for i in inner if i in found]
        with w.loop("%nkeys") as key:
            row = w.integer("mul", key, len(r.key_nodes))
            names = {
                seeds[i].index: w.load(SCALAR, w.at(SCALAR, "%keybar", w.integer("add", row, c)))
                for c, i in enumerate(r.key_nodes)
            }
            leaves = self._key_row(key) | self.at_parameters | names
            values = w.block(g, [found[i] for i in order], leaves)
            for i, (_, name) in zip(order, values, strict=True):
                _accumulate(w, name, self.parameter_bars[i])
        leaf = {e.index for e in r.p.values()}
        seeds = {i: g.symbol(f"parbar:{i}") for i in r.parameter_nodes if i not in leaf}
        names = {seeds[i].index: w.load(SCALAR, self.parameter_bars[i]) for i in seeds}
        found = reverse(g, seeds, leaf) if seeds else {}
        order = list(found)
        values = w.block(g, [found[i] for i in order], self.at_parameters | names)
        for i, (_, name) in zip(order, values, strict=True):
            _accumulate(w, name, self.parameter_bars[i])
        for c, e in enumerate(r.p.values()):
            w.store(
                SCALAR, w.load(SCALAR, self.parameter_bars[e.index]), w.at(SCALAR, "%thetabar", c)
            )

    def _tangent(self) -> None:
        """Innovations, variances and their derivatives along `LANES` directions of the parameters."""
        w, r, g = self.writer, self.recursion, self.recursion.graph
        dots: dict[int, str] = {}  # tangents of the parameter stage
        directions = {e.index: g.symbol(f"dot:{e.index}") for e in r.p.values()}
        for c, (i, s) in enumerate(directions.items()):
            dots[s.index] = w.load(VECTOR, w.at(VECTOR, "%seeds", c))
        later = [i for i in r.parameter_nodes if i not in directions]
        derivative = forward(g, [Expression(g, i) for i in later], directions)
        values = w.block(g, derivative, self.at_parameters | dots, list(dots))
        for i, (kind, name) in zip(later, values, strict=True):
            s = g.symbol(f"dot:{i}")
            directions[i] = s
            dots[s.index] = w.as_vector(kind, name)
        keys = [Expression(g, i) for i in r.key_nodes]
        derivative = forward(g, keys, directions)
        with w.loop("%nkeys") as key:
            leaves = self._key_row(key) | self.at_parameters | dots
            values = w.block(g, derivative, leaves, list(dots))
            row = w.integer("mul", key, len(keys))
            for c, (kind, name) in enumerate(values):
                pointer = w.at(VECTOR, "%keydot", w.integer("add", row, c))
                w.store(VECTOR, w.as_vector(kind, name), pointer)
        key_dots = {i: g.symbol(f"dot:{i}") for i in r.key_nodes}
        slots = self._slots(self.recursion.state)
        state_dots = {i: g.symbol(f"dot:{i}") for i in slots}
        dot_slots = {i: w.slot(VECTOR) for i in slots}
        self._load_state(slots, "%state")
        for c, s in enumerate(dot_slots.values()):
            w.store(VECTOR, w.load(VECTOR, w.at(VECTOR, "%statedot", c)), s)
        total = _Likelihood(w)
        tangents = directions | key_dots | state_dots

        def dot_leaves(key: str) -> dict[int, str]:
            row = w.integer("mul", key, len(keys))
            result = dict(dots)
            for c, i in enumerate(r.key_nodes):
                pointer = w.at(VECTOR, "%keydot", w.integer("add", row, c))
                result[key_dots[i].index] = w.load(VECTOR, pointer)
            for i, s in dot_slots.items():
                result[state_dots[i].index] = w.load(VECTOR, s)
            return result

        def run(outputs: list[Expression], leaves: dict[int, str], key: str) -> tuple[list, list]:
            vectors = dot_leaves(key)
            # only tangents that the block's leaves really have
            there = {i: t for i, t in tangents.items()}
            derivative = forward(g, outputs, there)
            both = w.block(g, [*outputs, *derivative], leaves | vectors, list(vectors))
            half = len(outputs)
            return both[:half], [w.as_vector(*v) for v in both[half:]]

        width = len(r.updates)
        with w.loop("%count") as k:
            key, parts = self._instant_keys(k)
            with w.loop(parts) as j:
                leaves = self._read(slots) | self._table(key) | self._inputs_within(k, j, parts)
                values, derivatives = run(r.predict.outputs, leaves | self.at_parameters, key)
                for s, (_, name) in zip(slots.values(), values, strict=True):
                    w.store(SCALAR, name, s)
                for s, name in zip(dot_slots.values(), derivatives, strict=True):
                    w.store(VECTOR, name, s)
            row = w.integer("mul", k, width)
            for c, (update, (y, there)) in enumerate(
                zip(r.updates, self._readings(k), strict=True)
            ):
                with w.when(there):
                    leaves = self._update_leaves(slots, k, key, y)
                    outputs = self._kept(update)
                    values, derivatives = run(outputs, leaves, key)
                    total.take(w, values[-2][1], values[-1][1])
                    place = w.integer("add", row, c)
                    w.store(SCALAR, values[-3][1], w.at(SCALAR, "%e", place))
                    w.store(SCALAR, values[-2][1], w.at(SCALAR, "%s", place))
                    w.store(VECTOR, derivatives[-3], w.at(VECTOR, "%edot", place))
                    w.store(VECTOR, derivatives[-2], w.at(VECTOR, "%sdot", place))
                    if self.gain:
                        for s, (_, name) in zip(slots.values(), values, strict=False):
                            w.store(SCALAR, name, s)
                        for s, name in zip(dot_slots.values(), derivatives, strict=False):
                            w.store(VECTOR, name, s)
            self._resets(slots, k)
            self._resets(dot_slots, k, "zeroinitializer", VECTOR)
        self._save_state(slots, "%state")
        for c, s in enumerate(dot_slots.values()):
            w.store(VECTOR, w.load(VECTOR, s), w.at(VECTOR, "%statedot", c))
        total.write(w, "%out")


_COMMON = [
    ("i64", "count"),
    ("i64", "nkeys"),
    ("ptr", "theta"),
    ("ptr", "keys"),
    ("ptr", "nsub"),
    ("ptr", "table"),
    ("ptr", "key"),
    ("ptr", "u"),
    ("ptr", "y"),
    ("ptr", "reset"),
    ("ptr", "state"),
    ("ptr", "first"),
]


class _Likelihood:
    """Running sums: Σ log S through a product that is turned into a logarithm before it leaves the range, Σ e²/S."""

    def __init__(self, w: Writer) -> None:
        self.logarithm = w.slot(SCALAR, literal(0.0))
        self.product = w.slot(SCALAR, literal(1.0))
        self.quadratic = w.slot(SCALAR, literal(0.0))
        self.number = w.slot("i64", "0")

    def take(self, w: Writer, variance: str, quadratic: str) -> None:
        product = w.real("fmul", w.load(SCALAR, self.product), variance)
        _accumulate(w, quadratic, self.quadratic)
        w.store("i64", w.integer("add", w.load("i64", self.number), 1), self.number)
        w.store(SCALAR, product, self.product)
        low = w.value(f"fcmp ult double {product}, {literal(1e-100)}")
        high = w.value(f"fcmp ugt double {product}, {literal(1e100)}")
        with w.when(w.value(f"or i1 {low}, {high}")):
            self._fold(w)

    def _fold(self, w: Writer) -> None:
        value = w.value(f"call double @llvm.log.f64(double {w.load(SCALAR, self.product)})")
        _accumulate(w, value, self.logarithm)
        w.store(SCALAR, literal(1.0), self.product)

    def write(self, w: Writer, out: str) -> None:
        """out[0] = Σ log S, out[1] = Σ e²/S, out[2] = number of readings."""
        self._fold(w)
        w.store(SCALAR, w.load(SCALAR, self.logarithm), out)
        w.store(SCALAR, w.load(SCALAR, self.quadratic), w.at(SCALAR, out, 1))
        number = w.value(f"sitofp i64 {w.load('i64', self.number)} to double")
        w.store(SCALAR, number, w.at(SCALAR, out, 2))


def _accumulate(w: Writer, value: str, pointer: str) -> None:
    w.store(SCALAR, w.real("fadd", w.load(SCALAR, pointer), value), pointer)


def _seed(seeds: dict[int, Expression], output: Expression, bar: Expression) -> None:
    seeds[output.index] = seeds[output.index] + bar if output.index in seeds else bar


def _lifted(graph: Graph, value: Expression | float) -> Expression | float:
    return 0.0 if is_zero(value) else graph.lift(value)


def _at(i: int, j: int) -> int:
    """Place of entry (i, j) in a packed lower triangle."""
    i, j = max(i, j), min(i, j)
    return i * (i + 1) // 2 + j


def trace_width(n: int, outputs: int, diffuse: bool = False) -> int:
    """Numbers in one row of a trace: moments before and after, two for every output, the transition matrix."""
    return 2 * (n + (2 if diffuse else 1) * (n * (n + 1) // 2)) + 2 * outputs + n * n


def unpack(packed: np.ndarray, n: int) -> np.ndarray:
    """Packed lower triangles (..., q) as symmetric matrices (..., n, n)."""
    index = np.array([[_at(i, j) for j in range(n)] for i in range(n)])
    return packed[..., index]


def pack(matrix: np.ndarray) -> np.ndarray:
    """Symmetric matrices (..., n, n) as packed lower triangles (..., q)."""
    rows, columns = np.tril_indices(matrix.shape[-1])
    return np.ascontiguousarray(matrix[..., rows, columns])

