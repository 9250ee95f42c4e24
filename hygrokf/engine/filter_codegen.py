"""The loops of a traced filter as LLVM text: value, trace, adjoint and tangent.

`loop_text` writes the function of one kind for a `hygrokf.engine.traced_filter.Recursion`: first the stages
before the time loop (parameters, then the table of keys), then the loop over the instants with its blocks of
straight-line code.  `COMMON` lists the arguments that all kinds share, `ARGUMENTS` those of each kind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hygrokf.engine.llvm_writer import SCALAR, VECTOR, Writer, declarations, literal
from hygrokf.engine.running_sums import RunningSums, accumulate
from hygrokf.engine.traced_filter import INSTANT, KEY, Block, Recursion, place, trace_width
from hygrokf.physics.expression import Expression, forward, reverse
from hygrokf.physics.holds import LINEAR, PREVIOUS

Names = dict[int, str]
"""Node -> the LLVM name of its value, or of the stack slot that holds it."""
Symbols = dict[int, Expression]
"""Node -> the expression of its adjoint."""

COMMON = [
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
"""Instants and keys; parameters, key leaves, sub-steps and workspace of the keys; key, inputs, readings and
resets of every instant; moments before the first instant (overwritten by those after the last) and a copy of
them."""
ARGUMENTS = {
    kind: [("ptr", name) for name in names.split()]
    for kind, names in {
        "value": "out",
        "trace": "out rows",
        "adjoint": "out store keybar thetabar statebar buffer",
        "tangent": "out seeds statedot keydot e s edot sdot",
        "controlled": "idle levels positions",
    }.items()
}


def loop_text(recursion: Recursion, kind: str, gain: bool) -> str:
    """LLVM text of a module with one function, named after its kind: value, trace, adjoint or tangent.

    Without `gain`, readings do not correct the state.
    """
    emission = Emission(recursion, kind, gain)
    getattr(emission, "_" + kind)()
    return emission.text()


class Emission:
    """LLVM text of one loop of a recursion, begun with the stages before the time loop."""

    def __init__(self, recursion: Recursion, kind: str, gain: bool) -> None:
        self.recursion, self.gain = recursion, gain
        self.writer = Writer(kind, COMMON + ARGUMENTS[kind])
        self._parameters()
        self._keys()

    def text(self) -> str:
        return declarations() + self.writer.text()

    # -- stages before the time loop -------------------------------------------------------------------------
    def _parameters(self) -> None:
        r, w = self.recursion, self.writer
        self.at_parameters: Names = {}
        for i, e in enumerate([*r.p.values(), *r.given]):
            self.at_parameters[e.index] = w.load(SCALAR, w.at(SCALAR, "%theta", i))
        wanted = [Expression(r.graph, i) for i in r.parameter_nodes]
        for e, (_, name) in zip(wanted, w.block(r.graph, wanted, self.at_parameters), strict=True):
            self.at_parameters[e.index] = name

    def _row(self, base: str, row: str, nodes: Sequence[int], kind: str = SCALAR) -> Names:
        """The numbers of one row of an array, by node."""
        w = self.writer
        start = w.integer("mul", row, len(nodes))
        return {i: w.load(kind, w.at(kind, base, w.integer("add", start, c))) for c, i in enumerate(nodes)}

    def _key_row(self, key: str) -> Names:
        """Values of the key's leaves: sub-step length and regimes."""
        return self._row("%keys", key, [e.index for e in self.recursion.key_leaves])

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
    def slots(self, prefix: Sequence[Expression]) -> Names:
        return {e.index: self.writer.slot(SCALAR) for e in prefix}

    def read(self, slots: Names, kind: str = SCALAR) -> Names:
        return {i: self.writer.load(kind, s) for i, s in slots.items()}

    def load_state(self, slots: Names, base: str, row: str | int = 0) -> None:
        w = self.writer
        start = w.integer("mul", row, len(slots))
        for c, s in enumerate(slots.values()):
            w.store(SCALAR, w.load(SCALAR, w.at(SCALAR, base, w.integer("add", start, c))), s)

    def save_state(self, slots: Names, base: str, row: str | int = 0) -> None:
        w = self.writer
        start = w.integer("mul", row, len(slots))
        for c, s in enumerate(slots.values()):
            w.store(SCALAR, w.load(SCALAR, s), w.at(SCALAR, base, w.integer("add", start, c)))

    def instant_keys(self, k: str) -> tuple[str, str]:
        """(row of the key table as i64, number of sub-steps as i64) for the step that ends at instant k."""
        key = self._index("%key", k)
        return key, self._index("%nsub", key)

    def _index(self, base: str, place: str) -> str:
        w = self.writer
        value = w.load("i32", w.at("i32", base, place))
        return w.value(f"sext i32 {value} to i64")

    def table(self, key: str) -> Names:
        values = self._row("%table", key, self.recursion.key_nodes)
        return self._key_row(key) | values

    def inputs_within(self, k: str, j: str | None = None, count: str = "") -> Names:
        """Inputs at the start and the end of sub-step j of `count`, by default of the whole step, between
        instants k−1 and k."""
        r, w = self.recursion, self.writer
        m = len(r.varying)
        row = w.integer("mul", k, m)
        before = w.integer("sub", row, m)
        if j is not None:
            part = w.real("fdiv", literal(1.0), w.value(f"sitofp i64 {count} to double"))
            left = w.real("fmul", w.value(f"sitofp i64 {j} to double"), part)
            right = w.real("fmul", w.value(f"sitofp i64 {w.integer('add', j, 1)} to double"), part)
        result = {}
        for c, name in enumerate(r.varying):
            hold = r.holds[name]
            end = w.integer("add", before if hold == PREVIOUS else row, c)
            value = w.load(SCALAR, w.at(SCALAR, "%u", end))
            result[r.end[name].index] = value
            if hold == LINEAR:
                old = w.load(SCALAR, w.at(SCALAR, "%u", w.integer("add", before, c)))
                result[r.start[name].index] = old
                if j is not None:
                    rise = w.real("fsub", value, old)
                    for table, share in ((r.start, left), (r.end, right)):
                        result[table[name].index] = w.real("fadd", old, w.real("fmul", rise, share))
        return result

    def _inputs_at(self, k: str) -> Names:
        r = self.recursion
        return self._row("%u", k, [r.now[name].index for name in r.varying])

    def _predict(
        self, slots: Names, k: str, key: str, count: str, each: Callable[[str], None] | None = None
    ) -> None:
        w = self.writer
        rest = count
        if each is None:  # nearly every step has a single sub-step, whose inputs need no fractions
            one = w.value(f"icmp eq i64 {count}, 1")
            with w.when(one):
                self._advance(slots, key, self.inputs_within(k))
            rest = w.value(f"select i1 {one}, i64 0, i64 {count}")
        with w.loop(rest) as j:
            if each is not None:
                each(j)
            self._advance(slots, key, self.inputs_within(k, j, count))

    def _advance(self, slots: Names, key: str, inputs: Names) -> None:
        r, w = self.recursion, self.writer
        leaves = self.read(slots) | self.table(key) | inputs
        values = w.block(r.graph, r.predict, leaves | self.at_parameters)
        self._store(slots, values)

    def _readings(self, k: str) -> list[tuple[str, str]]:
        """(value, condition that a reading exists) of every output at instant k."""
        w = self.writer
        count = len(self.recursion.updates)
        row = w.integer("mul", k, count)
        result = []
        for c in range(count):
            y = w.load(SCALAR, w.at(SCALAR, "%y", w.integer("add", row, c)))
            result.append((y, w.value(f"fcmp ord double {y}, {literal(0.0)}")))
        return result

    def _update_leaves(self, slots: Names, k: str, key: str, y: str) -> Names:
        return (
            self.read(slots)
            | self.table(key)
            | self._inputs_at(k)
            | {self.recursion.reading.index: y}
            | self.at_parameters
        )

    def _resets(self, slots: Names, k: str, zero: str = literal(0.0), kind: str = SCALAR) -> None:
        """Set the running means to zero where their interval begins."""
        r, w = self.recursion, self.writer
        if not r.model.resets:
            return
        flags = w.load("i32", w.at("i32", "%reset", k))
        indices = list(slots)
        for bit, state in enumerate(r.model.resets):
            test = w.value(f"and i32 {flags}, {1 << bit}")
            with w.when(w.value(f"icmp ne i32 {test}, 0")):
                w.store(kind, zero, slots[indices[state]])
                for other in range(r.n):
                    w.store(kind, zero, slots[indices[r.n + place(state, other)]])
                    if r.diffuse:
                        w.store(kind, zero, slots[indices[r.n + r.q + place(state, other)]])

    # -- the functions ---------------------------------------------------------------------------------------
    def _value(self) -> None:
        w, r = self.writer, self.recursion
        slots = self.slots(r.state)
        self.load_state(slots, "%state")
        total = RunningSums(w)
        with w.loop("%count") as k:
            key, parts = self.instant_keys(k)
            self._predict(slots, k, key, parts)
            self._correct(slots, k, key, total)
            self._resets(slots, k)
        self.save_state(slots, "%state")
        total.write(w, "%out")

    def _correct(self, slots: Names, k: str, key: str, total: RunningSums) -> None:
        for update, (y, there) in zip(self.recursion.updates, self._readings(k), strict=True):
            self._correct_by(update, y, there, slots, k, key, total)

    def _correct_by(
        self, update: Block, y: str, there: str, slots: Names, k: str, key: str, total: RunningSums
    ) -> None:
        """Count one reading and correct the state by it, if it exists."""
        w = self.writer
        with w.when(there):
            leaves = self._update_leaves(slots, k, key, y)
            values = w.block(self.recursion.graph, self._kept(update), leaves)
            total.take(w, values[-2][1], values[-1][1], self.recursion.square)
            if self.gain:
                self._store(slots, values)

    def _store(self, slots: Names, values: Sequence[tuple[str, str]]) -> None:
        """Store the first of some (kind, value) in the slots of the state."""
        for s, (_, name) in zip(slots.values(), values, strict=False):
            self.writer.store(SCALAR, name, s)

    def _kept(self, update: Block) -> Block:
        """Results of an update; without gain only the innovation, its variance and the quadratic form."""
        return update if self.gain else update[-3:]

    def _trace(self) -> None:
        """Rows: mean and covariance before; (prediction, variance) of every output; mean and covariance
        after; transition."""
        w, r = self.writer, self.recursion
        slots = self.slots(r.state)
        self.load_state(slots, "%state")
        total = RunningSums(w)
        width = trace_width(r.n, len(r.updates), r.diffuse)
        transition = [w.slot(SCALAR) for _ in range(r.n * r.n)]
        with w.loop("%count") as k:
            key, parts = self.instant_keys(k)
            row = w.at(SCALAR, "%rows", w.integer("mul", k, width))
            for c, s in enumerate(transition):
                w.store(SCALAR, literal(1.0 if c % (r.n + 1) == 0 else 0.0), s)
            self._predict_with_transition(slots, transition, k, key, parts)
            self.save_state(slots, row)
            column = len(slots)
            for update, (y, there) in zip(r.updates, self._readings(k), strict=True):
                outputs = update[-3:-1]
                missing = w.value(f"select i1 {there}, double {y}, double {literal(0.0)}")
                leaves = self._update_leaves(slots, k, key, missing)
                (_, error), (_, variance) = w.block(r.graph, outputs, leaves)
                w.store(SCALAR, w.real("fsub", missing, error), w.at(SCALAR, row, column))
                w.store(SCALAR, variance, w.at(SCALAR, row, column + 1))
                column += 2
                self._correct_by(update, y, there, slots, k, key, total)
            self.save_state(slots, w.at(SCALAR, row, column))
            column += len(slots)
            for c, s in enumerate(transition):
                w.store(SCALAR, w.load(SCALAR, s), w.at(SCALAR, row, column + c))
            self._resets(slots, k)
        self.save_state(slots, "%state")
        total.write(w, "%out")

    def _predict_with_transition(
        self, slots: Names, transition: Sequence[str], k: str, key: str, count: str
    ) -> None:
        r, w = self.recursion, self.writer
        n = r.n
        with w.loop(count) as j:
            leaves = self.read(slots) | self.table(key) | self.inputs_within(k, j, count)
            both = [*r.predict, *r.transition]
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
            self._store(slots, values)

    def _adjoint(self) -> None:
        """Score by a forward pass that stores the moments and a backward pass."""
        w, r, g = self.writer, self.recursion, self.recursion.graph
        slots = self.slots(r.state)
        self.load_state(slots, "%state")
        total = RunningSums(w)
        # store: row 2k the moments before the updates of instant k, row 2k+1 those after it
        with w.loop("%count") as k:
            key, parts = self.instant_keys(k)
            self._predict(slots, k, key, parts)
            self.save_state(slots, "%store", w.integer("mul", k, 2))
            self._correct(slots, k, key, total)
            self._resets(slots, k)
            self.save_state(slots, "%store", w.integer("add", w.integer("mul", k, 2), 1))
        total.write(w, "%out")

        bars = self.slots(r.state)
        bar_symbol = {i: g.symbol(f"bar:{i}") for i in bars}
        self.load_state(bars, "%statebar")
        self.parameter_bars = {i: w.slot(SCALAR, literal(0.0)) for i in r.estimated_nodes}
        for e in r.p.values():
            self.parameter_bars.setdefault(e.index, w.slot(SCALAR, literal(0.0)))
        with w.loop("%count", backwards=True) as k:
            key, parts = self.instant_keys(k)
            self._resets(bars, k)
            self._reverse_updates(slots, bars, bar_symbol, k, key)
            self._reverse_predict(slots, bars, bar_symbol, k, key, parts)
        self.save_state(bars, "%statebar")
        self._reverse_stages()

    def _reverse_updates(self, slots: Names, bars: Names, bar_symbol: Symbols, k: str, key: str) -> None:
        w, r = self.writer, self.recursion
        readings = self._readings(k)
        self.load_state(slots, "%store", w.integer("mul", k, 2))
        last = len(r.updates) - 1
        for c, update in enumerate(r.updates):  # moments before each update, kept in the buffer
            self.save_state(slots, "%buffer", c)
            if c < last and self.gain:
                y, there = readings[c]
                with w.when(there):
                    leaves = self._update_leaves(slots, k, key, y)
                    values = w.block(r.graph, update[: len(slots)], leaves)
                    self._store(slots, values)
        for c in range(last, -1, -1):
            update = r.updates[c]
            y, there = readings[c]
            with w.when(there):
                self.load_state(slots, "%buffer", c)
                leaves = self._update_leaves(slots, k, key, y)
                seeds: Symbols = {}
                if self.gain:
                    for e, i in zip(update, bars, strict=False):
                        seed(seeds, e, bar_symbol[i])
                spread, quadratic = update[-2:]
                g = r.graph
                seed(seeds, spread, -0.5 / spread)
                seed(seeds, quadratic, g.lift(-0.5 * r.term_slope(quadratic)))
                self._reverse_block(update, seeds, leaves, bars, bar_symbol, key, keep=not self.gain)

    def _reverse_predict(
        self, slots: Names, bars: Names, bar_symbol: Symbols, k: str, key: str, parts: str
    ) -> None:
        """Backward through the sub-steps; where there are several, their starting moments are recomputed into
        the buffer."""
        w, r = self.writer, self.recursion
        first = w.value(f"icmp eq i64 {k}, 0")
        self.load_state(slots, "%first")
        with w.when(w.value(f"xor i1 {first}, true")):
            self.load_state(slots, "%store", w.integer("sub", w.integer("mul", k, 2), 1))

        def keep(j: str) -> None:
            self.save_state(slots, "%buffer", j)

        one = w.value(f"icmp sle i64 {parts}, 1")
        with w.when(one):
            self.save_state(slots, "%buffer", 0)
        with w.when(w.value(f"xor i1 {one}, true")):
            self._predict(slots, k, key, parts, each=keep)
        with w.loop(parts, backwards=True) as j:
            self.load_state(slots, "%buffer", j)
            leaves = self.read(slots) | self.table(key) | self.inputs_within(k, j, parts)
            seeds: Symbols = {}
            for e, i in zip(r.predict, bars, strict=True):
                seed(seeds, e, bar_symbol[i])
            self._reverse_block(
                r.predict, seeds, leaves | self.at_parameters, bars, bar_symbol, key, keep=False
            )

    def _reverse_block(
        self,
        block: Block,
        seeds: Symbols,
        leaves: Names,
        bars: Names,
        bar_symbol: Symbols,
        key: str,
        keep: bool,
    ) -> None:
        """Adjoint of one block: replaces the bars of the state (adds to them with `keep`) and adds to those
        of earlier stages."""
        w, r = self.writer, self.recursion
        parameters, keys = r.boundary(block, INSTANT)
        parameters = [i for i in parameters if i in self.parameter_bars]
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
                accumulate(w, result[i], self.parameter_bars[i])
        row = w.integer("mul", key, len(r.key_nodes))
        for i in keys:
            if i in result:
                column = r.key_nodes.index(i)
                pointer = w.at(SCALAR, "%keybar", w.integer("add", row, column))
                accumulate(w, result[i], pointer)

    def _reverse_stages(self) -> None:
        """Pass the adjoints of the key table on to the parameter stage, and from there to the parameters."""
        w, r, g = self.writer, self.recursion, self.recursion.graph
        keys = [Expression(g, i) for i in r.key_nodes]
        inner, _ = r.boundary(keys, KEY)
        seeds = {i: g.symbol(f"keybar:{i}") for i in r.key_nodes}
        found = reverse(g, seeds, inner)
        order = [i for i in inner if i in found and i in self.parameter_bars]
        with w.loop("%nkeys") as key:
            names = self._row("%keybar", key, [seeds[i].index for i in r.key_nodes])
            leaves = self._key_row(key) | self.at_parameters | names
            values = w.block(g, [found[i] for i in order], leaves)
            for i, (_, name) in zip(order, values, strict=True):
                accumulate(w, name, self.parameter_bars[i])
        leaf = {e.index for e in r.p.values()}
        seeds = {i: g.symbol(f"parbar:{i}") for i in r.estimated_nodes if i not in leaf}
        names = {seeds[i].index: w.load(SCALAR, self.parameter_bars[i]) for i in seeds}
        found = reverse(g, seeds, leaf) if seeds else {}
        order = list(found)
        values = w.block(g, [found[i] for i in order], self.at_parameters | names)
        for i, (_, name) in zip(order, values, strict=True):
            accumulate(w, name, self.parameter_bars[i])
        for c, e in enumerate(r.p.values()):
            w.store(SCALAR, w.load(SCALAR, self.parameter_bars[e.index]), w.at(SCALAR, "%thetabar", c))

    def _tangent(self) -> None:
        """Innovations, variances and their derivatives along `LANES` directions of the parameters."""
        w, r, g = self.writer, self.recursion, self.recursion.graph
        directions, dots = self._stage_tangents()
        key_dots = {i: g.symbol(f"dot:{i}") for i in r.key_nodes}
        slots = self.slots(r.state)
        state_dots = {i: g.symbol(f"dot:{i}") for i in slots}
        dot_slots = {i: w.slot(VECTOR) for i in slots}
        self.load_state(slots, "%state")
        for c, s in enumerate(dot_slots.values()):
            w.store(VECTOR, w.load(VECTOR, w.at(VECTOR, "%statedot", c)), s)
        total = RunningSums(w)
        tangents = directions | key_dots | state_dots

        def dot_leaves(key: str) -> Names:
            keys = self._row("%keydot", key, [key_dots[i].index for i in r.key_nodes], VECTOR)
            states = {state_dots[i].index: w.load(VECTOR, s) for i, s in dot_slots.items()}
            return dots | keys | states

        def run(
            outputs: list[Expression], leaves: Names, key: str
        ) -> tuple[list[tuple[str, str]], list[str]]:
            vectors = dot_leaves(key)
            derivative = forward(g, outputs, tangents)
            both = w.block(g, [*outputs, *derivative], leaves | vectors, list(vectors))
            half = len(outputs)
            return both[:half], [w.as_vector(*v) for v in both[half:]]

        width = len(r.updates)
        with w.loop("%count") as k:
            key, parts = self.instant_keys(k)
            with w.loop(parts) as j:
                leaves = self.read(slots) | self.table(key) | self.inputs_within(k, j, parts)
                values, derivatives = run(r.predict, leaves | self.at_parameters, key)
                self._store(slots, values)
                for s, name in zip(dot_slots.values(), derivatives, strict=True):
                    w.store(VECTOR, name, s)
            row = w.integer("mul", k, width)
            for c, (update, (y, there)) in enumerate(zip(r.updates, self._readings(k), strict=True)):
                with w.when(there):
                    leaves = self._update_leaves(slots, k, key, y)
                    outputs = self._kept(update)
                    values, derivatives = run(outputs, leaves, key)
                    total.take(w, values[-2][1], values[-1][1], r.square)
                    place = w.integer("add", row, c)
                    error, error_dot = values[-3][1], derivatives[-3]
                    if r.diffuse:  # a reading that merely resolves an infinite variance has no quadratic form
                        none = w.value(f"fcmp oeq double {values[-1][1]}, {literal(0.0)}")
                        error = w.value(f"select i1 {none}, double {literal(0.0)}, double {error}")
                        error_dot = w.value(
                            f"select i1 {none}, {VECTOR} zeroinitializer, {VECTOR} {error_dot}"
                        )
                    w.store(SCALAR, error, w.at(SCALAR, "%e", place))
                    w.store(SCALAR, values[-2][1], w.at(SCALAR, "%s", place))
                    w.store(VECTOR, error_dot, w.at(VECTOR, "%edot", place))
                    w.store(VECTOR, derivatives[-2], w.at(VECTOR, "%sdot", place))
                    if self.gain:
                        self._store(slots, values)
                        for s, name in zip(dot_slots.values(), derivatives, strict=False):
                            w.store(VECTOR, name, s)
            self._resets(slots, k)
            self._resets(dot_slots, k, "zeroinitializer", VECTOR)
        self.save_state(slots, "%state")
        for c, s in enumerate(dot_slots.values()):
            w.store(VECTOR, w.load(VECTOR, s), w.at(VECTOR, "%statedot", c))
        total.write(w, "%out")

    def _stage_tangents(self) -> tuple[Symbols, Names]:
        """Tangents of the parameter stage, by node and by the node of their symbol; stores those of the key
        table."""
        w, r, g = self.writer, self.recursion, self.recursion.graph
        dots: Names = {}
        directions = {e.index: g.symbol(f"dot:{e.index}") for e in r.p.values()}
        for c, symbol in enumerate(directions.values()):
            dots[symbol.index] = w.load(VECTOR, w.at(VECTOR, "%seeds", c))
        later = [i for i in r.estimated_nodes if i not in directions]
        derivative = forward(g, [Expression(g, i) for i in later], directions)
        values = w.block(g, derivative, self.at_parameters | dots, list(dots))
        for i, (kind, name) in zip(later, values, strict=True):
            directions[i] = g.symbol(f"dot:{i}")
            dots[directions[i].index] = w.as_vector(kind, name)
        keys = [Expression(g, i) for i in r.key_nodes]
        derivative = forward(g, keys, directions)
        with w.loop("%nkeys") as key:
            leaves = self._key_row(key) | self.at_parameters | dots
            values = w.block(g, derivative, leaves, list(dots))
            row = w.integer("mul", key, len(keys))
            for c, (kind, name) in enumerate(values):
                pointer = w.at(VECTOR, "%keydot", w.integer("add", row, c))
                w.store(VECTOR, w.as_vector(kind, name), pointer)
        return directions, dots


def seed(seeds: Symbols, output: Expression, bar: Expression) -> None:
    """Add a bar to the adjoint of an output."""
    seeds[output.index] = seeds[output.index] + bar if output.index in seeds else bar
