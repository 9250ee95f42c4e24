"""The stages of a compiled loop before its instants, and the step to an instant, as LLVM text.

`Stages` writes what all kinds of loops share (`hygrokf.engine.filter_codegen`): parameters, the table of keys
with the doublings of constant-rate steps, the moments in stack slots, and the prediction.  Its methods emit
code; strings that they take and return are registers and slots of the text (`llvm_writer`).

- key: one distinct combination of sub-step length and regimes; the *key table* has a row of values for each.
- leaves: node → register of its value, from which a block is computed.
- slots: node → stack slot that holds its value; the state's slots hold the moments.
- doublings, share: the matrices of a sub-step are computed for its share 2^−doublings, then doubled.
- early, late: the operations of the matrices that depend on the key alone, and those of every sub-step, whose
  results stand in the slots `registers`.
- levels: memory for the values before each doubling, which the adjoint needs again.
- r, w, k, c: the recursion, the writer, the register of the instant, the column within a row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from hygrokf.engine.discretisation import CONSTANT_SHARE, MILD, Assign, Choose, Operation, Repeat, operations
from hygrokf.engine.llvm_writer import SCALAR, Writer, literal
from hygrokf.engine.traced_filter import Recursion
from hygrokf.physics.expression import Expression
from hygrokf.physics.holds import LINEAR, PREVIOUS

Names = dict[int, str]
"""Node -> the LLVM name of its value, or of the stack slot that holds it."""
Symbols = dict[int, Expression]
"""Node -> the expression of its adjoint."""
DOUBLINGS = 100
"""Largest number of doublings: it allows rates times a step of 6e29."""
Compute = Callable[[Assign | Repeat, Names], None]
"""(operation, leaves): emits code that computes an operation."""
Pull = Callable[[Sequence[int], Sequence[Expression], Names, str], None]
"""(into, block, leaves, key): emits code that propagates the adjoints of the symbols `into` to the nodes that
their block reads."""


@dataclass(frozen=True)
class SubStep:
    """Registers of one sub-step: its number `j` of `count`, its row of the key table, and the inputs at its
    ends."""

    j: str
    count: str
    key: str
    inputs: Names


class Stages:
    """The text at the beginning of all loops of a recursion, and the prediction to an instant.

    walked: whether the loop chooses its own sub-steps, and therefore computes the rows of the key table when
    it needs them (`schedule_codegen`).
    """

    def __init__(self, recursion: Recursion, writer: Writer, walked: bool = False) -> None:
        self.recursion, self.writer, self.walked = recursion, writer, walked
        self.registers = self.slots(list(recursion.registers.values()))
        self._parameters()
        if not walked:
            self._keys()

    # -- stages before the time loop -------------------------------------------------------------------------
    def _parameters(self) -> None:
        """Emit code that loads the parameters and computes all values that depend on them alone."""
        r, w = self.recursion, self.writer
        self.at_parameters: Names = {}
        for i, e in enumerate([*r.p.values(), *r.given]):
            self.at_parameters[e.index] = w.load(SCALAR, w.at(SCALAR, "%theta", i))
        nodes = [Expression(r.graph, i) for i in r.parameter_nodes]
        for e, (_, name) in zip(nodes, w.block(r.graph, nodes, self.at_parameters), strict=True):
            self.at_parameters[e.index] = name

    def _load_row(self, base: str, row: str, nodes: Sequence[int], kind: str = SCALAR) -> Names:
        """Emit code that loads row `row` of the array at `base`, one number for each node; returns node →
        register."""
        w = self.writer
        start = w.integer("mul", row, len(nodes))
        return {i: w.load(kind, w.at(kind, base, w.integer("add", start, c))) for c, i in enumerate(nodes)}

    def _key_row(self, key: str) -> Names:
        """Emit code that loads what defines a key: length of the sub-step and regimes; returns node →
        register."""
        return self._load_row("%keys", key, [e.index for e in self.recursion.key_leaves])

    def key_leaves(self, key: str) -> Names:
        """Emit code that loads what defines a key, and computes the share 2^−doublings of its sub-step;
        returns node → register."""
        return self._key_row(key) | {self.recursion.share.index: self.power(self.times(key))}

    def power(self, times: str) -> str:
        """Emit code for 2^−times, from an i64; returns the register of the double."""
        w = self.writer
        bits = w.value(f"shl i64 {w.integer('sub', 1023, times)}, 52")
        return w.value(f"bitcast i64 {bits} to double")

    def times(self, key: str) -> str:
        """Emit code that loads the doublings of a row of the key table; returns the register of the i64."""
        return self._index("%nsub", key)

    def _keys(self) -> None:
        """Emit the loop that computes the key table, row by row."""
        r, w = self.recursion, self.writer
        with w.loop("%nkeys") as key:
            if r.exact:  # the number of doublings follows from the rates
                times = w.value(f"trunc i64 {self.doublings(self._key_row(key), CONSTANT_SHARE)} to i32")
                w.store("i32", times, w.at("i32", "%nsub", key))
            row = w.integer("mul", key, len(r.key_nodes))
            for c, name in enumerate(self.early(self.key_leaves(key), self.times(key))):
                w.store(SCALAR, name, w.at(SCALAR, "%table", w.integer("add", row, c)))

    def doublings(self, leaves: Names, share: float) -> str:
        """Emit code for the number of doublings (i64) by the rates at the beginning of a sub-step, which
        `leaves` give; −1 for rates that are not finite, or too large.  Returns its register.

        share: [1] largest product of the rates and the share of the sub-step.
        """
        w, r = self.writer, self.recursion
        largest, total = literal(0.5), literal(0.0)
        for _, name in w.block(r.graph, r.reach, leaves | self.at_parameters):
            scaled = w.real("fmul", name, literal(1.0 / share))
            larger = w.value(f"fcmp ogt double {scaled}, {largest}")
            largest = w.value(f"select i1 {larger}, double {scaled}, double {largest}")
            total = w.real("fadd", total, scaled)
        bits = w.value(f"bitcast double {largest} to i64")
        power = w.integer("sub", w.integer("lshr", bits, 52), 1022)  # 0 for [1/2, 1), 1 for [1, 2)
        possible = w.value(f"icmp sle i64 {power}, {DOUBLINGS}")
        finite = w.value(f"fcmp ord double {w.real('fsub', total, total)}, {literal(0.0)}")
        return w.value(f"select i1 {w.value(f'and i1 {possible}, {finite}')}, i64 {power}, i64 -1")

    def early(self, leaves: Names, times: str) -> list[str]:
        """Emit code that computes one row of the key table from its leaves; returns the registers of the
        row."""
        r, w = self.recursion, self.writer
        slots = self.slots([e for operation in operations(r.early) for e in operation.into])
        self.perform(r.early, slots, times, leaves | self.at_parameters)
        nodes = [Expression(r.graph, i) for i in r.key_nodes]
        all_leaves = leaves | self.at_parameters | self.read(slots)
        return [name for _, name in w.block(r.graph, nodes, all_leaves)]

    # -- the operations before a step ------------------------------------------------------------------------
    def perform(
        self,
        program: Sequence[Operation],
        slots: Names,
        times: str,
        leaves: Names,
        compute: Compute | None = None,
        levels: bool = False,
    ) -> None:
        """Emit code that runs operations on their symbols in `slots`.

        times: register of the number of doublings.  compute: emits an operation's code in place of the plain
        computation.  levels: whether to store the values before each doubling.
        """
        w = self.writer
        columns = self._level_columns(program)

        def run(operation: Operation) -> None:
            """Emit code that runs one operation."""
            if isinstance(operation, Choose):
                for inner in self._chosen(operation, times):
                    for item in inner:
                        run(item)
            elif isinstance(operation, Repeat):
                with w.loop(times) as j:
                    if levels:
                        self._at_level(operation, columns, slots, j, self._keep)
                    (compute or self._compute(slots))(operation, self.reading(slots, operation.block))
            else:
                all_leaves = leaves | self.reading(slots, operation.block)
                (compute or self._compute(slots))(operation, all_leaves)

        for item in program:
            run(item)

    def retract(
        self, program: Sequence[Operation], slots: Names, times: str, leaves: Names, pull: Pull, key: str
    ) -> None:
        """Emit the adjoint of `perform`, whose code must have run with `levels`: the operations backwards,
        each propagated by `pull`.

        key: register of the row of the key table, which `pull` gets.
        """
        w = self.writer
        columns = self._level_columns(program)

        def run(operation: Operation) -> None:
            """Emit the adjoint of one operation."""
            if isinstance(operation, Choose):
                for inner in self._chosen(operation, times):
                    for item in reversed(inner):
                        run(item)
                return
            into = [e.index for e in operation.into]
            if isinstance(operation, Repeat):
                with w.loop(times, backwards=True) as j:
                    self._at_level(operation, columns, slots, j, self._restore)
                    pull(into, operation.block, self.reading(slots, operation.block), key)
            else:
                pull(into, operation.block, leaves | self.reading(slots, operation.block), key)

        for item in reversed(program):
            run(item)

    def _chosen(self, operation: Choose, times: str) -> Iterator[tuple[Operation, ...]]:
        """Yield both alternatives in turn, each within a condition: code emitted meanwhile runs only where
        the number of doublings chooses the alternative yielded."""
        w = self.writer
        stiff = w.value(f"icmp sgt i64 {times}, {MILD}")
        for condition, inner in (
            (stiff, operation.stiff), (w.value(f"xor i1 {stiff}, true"), operation.plain),
        ):  # fmt: skip
            with w.when(condition):
                yield inner

    def _compute(self, slots: Names) -> Compute:
        """The plain computation of an operation: results are stored in the slots of its symbols."""

        def plain(operation: Assign | Repeat, leaves: Names) -> None:
            results = self.writer.block(self.recursion.graph, operation.block, leaves)
            for e, (_, name) in zip(operation.into, results, strict=True):
                self.writer.store(SCALAR, name, slots[e.index])

        return plain

    def reading(self, slots: Names, block: Sequence[Expression]) -> Names:
        """Emit code that loads the symbols in `slots` that a block reads; returns node → register."""
        needed = self.recursion.leaves_of(block)
        return {i: self.writer.load(SCALAR, s) for i, s in slots.items() if i in needed}

    @staticmethod
    def _level_columns(program: Sequence[Operation]) -> tuple[dict[int, int], int]:
        """The first column of each repetition in a row of `%levels`, by the identity of the operation, and
        the width of a row."""
        columns, width = {}, 0
        for operation in operations(program):
            if isinstance(operation, Repeat):
                columns[id(operation)] = width
                width += len(operation.into)
        return columns, width

    def _at_level(
        self,
        operation: Repeat,
        columns: tuple[dict[int, int], int],
        slots: Names,
        j: str,
        move: Callable[[str, str], None],
    ) -> None:
        """Emit code that moves the symbols of a repetition between their slots and `%levels`, at doubling
        j; `move(slot, pointer)` emits the code of one of them."""
        w = self.writer
        start = w.integer("add", w.integer("mul", j, columns[1]), columns[0][id(operation)])
        for c, e in enumerate(operation.into):
            move(slots[e.index], w.at(SCALAR, "%levels", w.integer("add", start, c)))

    def _keep(self, slot: str, pointer: str) -> None:
        """Emit code that copies a slot to memory."""
        self.writer.store(SCALAR, self.writer.load(SCALAR, slot), pointer)

    def _restore(self, slot: str, pointer: str) -> None:
        """Emit code that copies memory to a slot."""
        self.writer.store(SCALAR, self.writer.load(SCALAR, pointer), slot)

    # -- pieces of the time loop -----------------------------------------------------------------------------
    def slots(self, symbols: Sequence[Expression]) -> Names:
        """New slots for symbols, by node."""
        return {e.index: self.writer.slot(SCALAR) for e in symbols}

    def read(self, slots: Names, kind: str = SCALAR) -> Names:
        """Emit code that loads all slots; returns node → register."""
        return {i: self.writer.load(kind, s) for i, s in slots.items()}

    def load_state(self, slots: Names, base: str, row: str | int = 0) -> None:
        """Emit code that copies a row of packed moments from memory to the slots."""
        w = self.writer
        start = w.integer("mul", row, len(slots))
        for c, s in enumerate(slots.values()):
            w.store(SCALAR, w.load(SCALAR, w.at(SCALAR, base, w.integer("add", start, c))), s)

    def save_state(self, slots: Names, base: str, row: str | int = 0) -> None:
        """Emit code that copies the slots to a row of packed moments in memory."""
        w = self.writer
        start = w.integer("mul", row, len(slots))
        for c, s in enumerate(slots.values()):
            w.store(SCALAR, w.load(SCALAR, s), w.at(SCALAR, base, w.integer("add", start, c)))

    def _index(self, base: str, place: str) -> str:
        """Emit code that loads entry `place` of an array of i32; returns the register of its i64."""
        w = self.writer
        value = w.load("i32", w.at("i32", base, place))
        return w.value(f"sext i32 {value} to i64")

    def table(self, key: str) -> Names:
        """Emit code that loads a row of the key table and its leaves; returns node → register.  In a loop
        that chooses its sub-steps, row 0 belongs to the instant."""
        row = "0" if self.walked else key
        return self.key_leaves(key) | self._load_row("%table", row, self.recursion.key_nodes)

    def key_of(self, k: str) -> str:
        """Emit code that loads the key of instant k, whose values its updates read, and an exact step to it;
        returns its register."""
        return self._index("%key", k)

    @contextmanager
    def sub_steps(self, k: str, backwards: bool = False) -> Iterator[SubStep]:
        """Emit the loop over the sub-steps to instant k around the code emitted meanwhile; yields the
        registers of one.  An exact step is a single sub-step."""
        w = self.writer
        if self.recursion.exact:
            yield SubStep("0", "1", self.key_of(k), self.inputs_between(k))
            return
        begin = self._index("%offset", k)
        count = w.integer("sub", self._index("%offset", w.integer("add", k, 1)), begin)
        with w.loop(count, backwards=backwards) as j:
            place = w.integer("add", begin, j)
            left, right = (
                w.load(SCALAR, w.at(SCALAR, "%within", w.integer("add", w.integer("mul", place, 2), c)))
                for c in (0, 1)
            )
            yield SubStep(j, count, self._index("%row", place), self.inputs_between(k, left, right))

    def inputs_between(self, k: str, left: str = "", right: str = "") -> Names:
        """Emit code for the inputs at two fractions [1] of the step that ends at instant k, by default at its
        ends; returns node → register."""
        r, w = self.recursion, self.writer
        m = len(r.varying)
        row = w.integer("mul", k, m)
        before = w.integer("sub", row, m)
        result = {}
        for c, name in enumerate(r.varying):
            hold = r.holds[name]
            end = w.integer("add", before if hold == PREVIOUS else row, c)
            value = w.load(SCALAR, w.at(SCALAR, "%u", end))
            result[r.end[name].index] = value
            if hold == LINEAR:
                old = w.load(SCALAR, w.at(SCALAR, "%u", w.integer("add", before, c)))
                result[r.start[name].index] = old
                if left:
                    rise = w.real("fsub", value, old)
                    for table, share in ((r.start, left), (r.end, right)):
                        result[table[name].index] = w.real("fadd", old, w.real("fmul", rise, share))
        return result

    def inputs_at(self, k: str) -> Names:
        """Emit code that loads the inputs at instant k; returns node → register."""
        r = self.recursion
        return self._load_row("%u", k, [r.now[name].index for name in r.varying])

    def predict(self, slots: Names, k: str) -> None:
        """Emit code that moves the moments in `slots` to instant k, before its readings."""
        with self.sub_steps(k) as sub_step:
            leaves = self.read(slots) | self.table(sub_step.key) | sub_step.inputs | self.at_parameters
            self.advance(slots, self.times(sub_step.key), leaves)

    def advance(self, slots: Names, times: str, leaves: Names) -> None:
        """Emit code that moves the moments in `slots` over one sub-step.

        times: register of its doublings.  leaves: moments, inputs and values of the key before the sub-step.
        """
        r = self.recursion
        self.perform(r.late, self.registers, times, leaves)
        all_leaves = leaves | self.reading(self.registers, r.predict)
        self._store(slots, self.writer.block(r.graph, r.predict, all_leaves))

    def _store(self, slots: Names, values: Sequence[tuple[str, str]]) -> None:
        """Emit code that stores the leading (kind, register) pairs in the slots of the state."""
        for s, (_, name) in zip(slots.values(), values, strict=False):
            self.writer.store(SCALAR, name, s)


def level_room(recursion: Recursion) -> int:
    """Count of numbers in `%levels` of the adjoint: the matrices before each doubling."""
    widths = [
        sum(len(operation.into) for operation in operations(program) if isinstance(operation, Repeat))
        for program in (recursion.early, recursion.late)
    ]
    return max(1, (DOUBLINGS + 1) * max(widths))


def seed(seeds: Symbols, output: Expression, bar: Expression) -> None:
    """Add an adjoint of an output to the seeds of a reverse pass: an output may occur more than once."""
    seeds[output.index] = seeds[output.index] + bar if output.index in seeds else bar
