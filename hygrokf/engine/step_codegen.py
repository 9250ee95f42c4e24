"""The stages of a compiled loop before its instants, and the step to an instant, as LLVM text.

`Stages` holds what all kinds of loops share (`hygrokf.engine.filter_codegen`): parameters, the table of keys
with the doublings of constant-rate steps, the moments in stack slots, and the prediction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hygrokf.engine.llvm_writer import SCALAR, Writer, literal
from hygrokf.engine.running_sums import accumulate
from hygrokf.engine.traced_filter import KEY, Block, Recursion
from hygrokf.physics.expression import Expression, reverse
from hygrokf.physics.holds import LINEAR, PREVIOUS

Names = dict[int, str]
"""Node -> the LLVM name of its value, or of the stack slot that holds it."""
Symbols = dict[int, Expression]
"""Node -> the expression of its adjoint."""


class Stages:
    """The text that all loops of a recursion begin with, and their step to an instant."""

    def __init__(self, recursion: Recursion, writer: Writer) -> None:
        self.recursion, self.writer = recursion, writer
        self.parameter_bars: Names = {}
        self._parameters()
        self._keys()

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

    def _doubled(
        self,
        key: str,
        each: Callable[[Names, str], None] | None = None,
        along: Callable[[Block, Names], None] | None = None,
    ) -> tuple[Names, Names]:
        """Slots of a constant-rate step's matrices, doubled to the whole step, and the leaves of its share;
        `each(slots, j)` is called before doubling j, `along(block, leaves)` before each block is computed."""
        r, w, d = self.recursion, self.writer, self.recursion.doubling
        if d is None:
            return {}, {}
        times = self._index("%nsub", key)
        bits = w.value(f"shl i64 {w.integer('sub', 1023, times)}, 52")  # 2^−times as a double
        leaves = self._key_row(key) | self.at_parameters
        leaves[d.share.index] = w.value(f"bitcast i64 {bits} to double")
        slots = self.slots(d.now)

        def compute(block: Block, known: Names) -> None:
            if along is not None:
                along(block, known)
            self._store(slots, w.block(r.graph, block, known))

        compute(d.first, leaves)
        with w.loop(times) as j:
            if each is not None:
                each(slots, j)
            compute(d.twice, self.read(slots))
        return slots, leaves

    def _keys(self) -> None:
        r, w = self.recursion, self.writer
        wanted = [Expression(r.graph, i) for i in r.key_nodes]
        with w.loop("%nkeys") as key:
            leaves = self._key_row(key) | self.at_parameters | self.read(self._doubled(key)[0])
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
        """(row of the key table, number of sub-steps) for the step that ends at instant k, as i64."""
        key = self._index("%key", k)
        return key, "1" if self.recursion.exact else self._index("%nsub", key)

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

    def inputs_of(self, k: str, j: str, count: str) -> Names:
        """Inputs of sub-step j of `count`; a constant-rate step is one."""
        return self.inputs_within(k) if self.recursion.exact else self.inputs_within(k, j, count)

    def _inputs_at(self, k: str) -> Names:
        r = self.recursion
        return self._row("%u", k, [r.now[name].index for name in r.varying])

    def _predict(
        self, slots: Names, k: str, key: str, count: str, each: Callable[[str], None] | None = None
    ) -> None:
        w = self.writer
        if self.recursion.exact:
            self._advance(slots, key, self.inputs_within(k))
            return
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

    def _store(self, slots: Names, values: Sequence[tuple[str, str]]) -> None:
        """Store the first of some (kind, value) in the slots of the state."""
        for s, (_, name) in zip(slots.values(), values, strict=False):
            self.writer.store(SCALAR, name, s)

    def _bars(self, symbols: Symbols, bars: Names) -> Names:
        return {symbols[i].index: self.writer.load(SCALAR, s) for i, s in bars.items()}

    def _pull(self, outputs: Block, seeds: Symbols, leaves: Names, bars: Names) -> None:
        """Replace the adjoints `bars` by those that the seeds give them, and add to those of the parameter
        stage that `outputs` depend on."""
        w, r = self.writer, self.recursion
        inner = [i for i in r.boundary(outputs, KEY)[0] if i in self.parameter_bars]
        found = reverse(r.graph, seeds, [*bars, *inner])
        order = list(found)
        values = w.block(r.graph, [found[i] for i in order], leaves)
        result = {i: name for i, (_, name) in zip(order, values, strict=True)}
        for i, s in bars.items():
            w.store(SCALAR, result.get(i, literal(0.0)), s)
        for i in inner:
            if i in result:
                accumulate(w, result[i], self.parameter_bars[i])


def seed(seeds: Symbols, output: Expression, bar: Expression) -> None:
    seeds[output.index] = seeds[output.index] + bar if output.index in seeds else bar
