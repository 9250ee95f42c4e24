"""The compiled step of many runs of one model: `RUNS` runs at a time, one in each lane of the processor's
vectors.

`fleet_text` writes one function for a traced recursion.  Persistent arrays are stored in blocks of `RUNS`
runs, (blocks, width, RUNS); the data of a step are stored in columns, (width, runs).  Every load thus takes
one number of each run in a block.  Values that depend only on the parameters and on the length of a step are
kept between steps and recomputed for blocks that are marked as changed.  Lanes differ in their number of
sub-steps: all lanes compute, and finished lanes keep their previous values.

Methods emit code; strings that they take and return are registers and slots of the text (`llvm_writer`), of
vectors with one lane for each run.  `block` is the register of a block's number, `slots`, `leaves` and
`times` are as in `step_codegen`, `lanes` a vector of i1 that says which lanes take new values.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from hygrokf.engine.discretisation import (
    CONSTANT_SHARE,
    MILD,
    SHARE,
    Assign,
    Choose,
    Operation,
    Repeat,
    operations,
)
from hygrokf.engine.llvm_writer import RUNS, TRUTH, Writer, declarations, literal, vector
from hygrokf.engine.step_codegen import DOUBLINGS
from hygrokf.engine.traced_filter import Recursion
from hygrokf.physics.expression import Expression
from hygrokf.physics.holds import LINEAR, PREVIOUS

RUN_VECTOR, TRUTHS, LONGS = vector(RUNS), vector(RUNS, TRUTH), vector(RUNS, "i64")
BATCH_ARGUMENTS = [("i64", "blocks")] + [
    ("ptr", name) for name in ("theta", "keys", "parts", "most", "changed", "known", "before", "now", "state")
]
"""In columns: key leaves, sub-steps of each run, inputs before and now.  In blocks: parameters, values kept
between steps, moments.  Per block: the largest number of sub-steps, and whether its parameters or keys have
changed.
"""


def kept_nodes(recursion: Recursion) -> list[int]:
    """Nodes whose values are kept between steps."""
    return [*recursion.parameter_nodes, *(recursion.key_nodes if recursion.exact else ())]


def _all(number: int) -> str:
    """A literal vector of i64 with the same number in all lanes."""
    return "<" + ", ".join([f"i64 {number}"] * RUNS) + ">"


def fleet_text(recursion: Recursion) -> str:
    """LLVM text of a module with the function `fleet(blocks, theta, keys, …)`."""
    reduction = f"declare i64 @llvm.vector.reduce.smax.v{RUNS}i64({LONGS})\n"
    return declarations() + reduction + _Emission(recursion).function()


@dataclass
class _Emission:
    """LLVM text of the function `fleet`."""

    recursion: Recursion
    writer: Writer = field(init=False)

    def function(self) -> str:
        """The text: a loop over the blocks, which keeps values where needed and predicts the moments."""
        w = self.writer = Writer("fleet", BATCH_ARGUMENTS, RUNS)
        slots = {e.index: w.slot(RUN_VECTOR) for e in self.recursion.state}
        with w.loop("%blocks") as block:
            changed = w.load("i32", w.at("i32", "%changed", block))
            with w.when(w.value(f"icmp ne i32 {changed}, 0")):
                self._keep(block)
            for c, slot in enumerate(slots.values()):
                w.store(RUN_VECTOR, self._load("state", block, len(slots), c), slot)
            self._predict(slots, block)
            for c, slot in enumerate(slots.values()):
                place = w.integer("add", w.integer("mul", block, len(slots)), c)
                w.store(RUN_VECTOR, w.load(RUN_VECTOR, slot), w.at(RUN_VECTOR, "%state", place))
        return w.text()

    def _load(self, array: str, block: str, width: int, column: int) -> str:
        """Emit code that loads one number of each run from an array in blocks; returns the register."""
        w = self.writer
        place = w.integer("add", w.integer("mul", block, width), column)
        return w.load(RUN_VECTOR, w.at(RUN_VECTOR, f"%{array}", place))

    def _column(self, array: str, block: str, column: int) -> str:
        """Emit code that loads one number of each run from an array in columns; returns the register."""
        w = self.writer
        place = w.integer("add", w.integer("mul", "%blocks", column), block)
        return w.load(RUN_VECTOR, w.at(RUN_VECTOR, f"%{array}", place))

    def _load_row(self, array: str, block: str, nodes: list[int]) -> dict[int, str]:
        """Emit code that loads a row of an array in blocks, one number for each node; returns node →
        register."""
        return {i: self._load(array, block, len(nodes), c) for c, i in enumerate(nodes)}

    def _parameters_and_keys(self, block: str) -> dict[int, str]:
        """Emit code that loads the parameters and what defines the key of each run; returns node →
        register."""
        r = self.recursion
        leaves = [e.index for e in (*r.p.values(), *r.given)]
        keys = {e.index: self._column("keys", block, c) for c, e in enumerate(r.key_leaves)}
        return self._load_row("theta", block, leaves) | keys

    def _keep(self, block: str) -> None:
        """Emit code that computes and stores the values that are kept between steps."""
        r, w = self.recursion, self.writer
        nodes, leaves = kept_nodes(r), self._parameters_and_keys(block)
        if r.exact:
            leaves |= self._matrices(leaves, CONSTANT_SHARE)
        wanted = [Expression(r.graph, i) for i in nodes]
        for c, (kind, name) in enumerate(w.block(r.graph, wanted, leaves, list(leaves))):
            place = w.integer("add", w.integer("mul", block, len(nodes)), c)
            w.store(RUN_VECTOR, w.as_vector(kind, name), w.at(RUN_VECTOR, "%known", place))

    def _matrices(self, leaves: dict[int, str], share: float) -> dict[int, str]:
        """Emit code that computes the matrices of a sub-step; returns node → register of all leaves, the
        share of the sub-step and the symbols that its operations assign.

        share: [1] largest product of the rates and the share of a sub-step.
        """
        r, w = self.recursion, self.writer
        times, largest = self._doublings(leaves, share)
        bits = w.value(f"shl {LONGS} {w.value(f'sub {LONGS} {_all(1023)}, {times}')}, {_all(52)}")
        inner_leaves = leaves | {r.share.index: w.value(f"bitcast {LONGS} {bits} to {RUN_VECTOR}")}
        program = (*r.early, *r.late)
        slots = {
            e.index: w.slot(RUN_VECTOR, "zeroinitializer") for op in operations(program) for e in op.into
        }
        all_lanes = w.value(f"icmp sge {LONGS} {times}, zeroinitializer")
        for operation in program:
            self._perform(operation, slots, times, largest, inner_leaves, all_lanes)
        return inner_leaves | {i: w.load(RUN_VECTOR, slot) for i, slot in slots.items()}

    def _perform(
        self,
        op: Operation,
        slots: dict[int, str],
        times: str,
        most: str,
        leaves: dict[int, str],
        lanes: str,
    ) -> None:
        """Emit code that runs an operation; only `lanes` take its values.

        times, most: doublings of each run, and the largest of them.
        """
        w = self.writer
        if isinstance(op, Choose):
            for inner in op.plain:
                self._perform(inner, slots, times, most, leaves, lanes)
            stiff = w.value(f"icmp sgt {LONGS} {times}, {_all(MILD)}")
            with w.when(w.value(f"icmp sgt i64 {most}, {MILD}")):
                for inner in op.stiff:
                    self._perform(inner, slots, times, most, leaves, stiff)
        elif isinstance(op, Repeat):
            with w.loop(most) as j:
                counter = w.value(f"insertelement {LONGS} poison, i64 {j}, i64 0")
                mask = f"<{RUNS} x i32> zeroinitializer"
                counter = w.value(f"shufflevector {LONGS} {counter}, {LONGS} poison, {mask}")
                self._assign(op, slots, {}, w.value(f"icmp slt {LONGS} {counter}, {times}"))
        else:
            self._assign(op, slots, leaves, lanes)

    def _assign(
        self, operation: Assign | Repeat, slots: dict[int, str], leaves: dict[int, str], lanes: str
    ) -> None:
        """Emit code that assigns the values of an operation's block to its symbols, in the chosen lanes."""
        w = self.writer
        needed = set(self.recursion.graph.needed(operation.block))
        all_leaves = leaves | {i: w.load(RUN_VECTOR, slot) for i, slot in slots.items() if i in needed}
        values = self._values(list(operation.block), all_leaves)
        for e, value in zip(operation.into, values, strict=True):
            old = w.load(RUN_VECTOR, slots[e.index])
            w.store(RUN_VECTOR, self._where(lanes, value, old), slots[e.index])

    def _doublings(self, leaves: dict[int, str], share: float) -> tuple[str, str]:
        """Emit code for the number of doublings of every run, and for the largest; 0 for rates that are not
        finite.  Returns the registers of both."""
        w = self.writer
        largest = w.splat(literal(0.5))
        for name in self._values(list(self.recursion.reach), leaves):
            scaled = w.value(f"fmul {RUN_VECTOR} {name}, {w.splat(literal(1.0 / share))}")
            larger = w.value(f"fcmp ogt {RUN_VECTOR} {scaled}, {largest}")
            largest = self._where(larger, scaled, largest)
        bits = w.value(f"lshr {LONGS} {w.value(f'bitcast {RUN_VECTOR} {largest} to {LONGS}')}, {_all(52)}")
        power = w.value(f"sub {LONGS} {bits}, {_all(1022)}")
        possible = w.value(f"icmp sle {LONGS} {power}, {_all(DOUBLINGS)}")
        power = w.value(f"select {TRUTHS} {possible}, {LONGS} {power}, {LONGS} zeroinitializer")
        return power, w.value(f"call i64 @llvm.vector.reduce.smax.v{RUNS}i64({LONGS} {power})")

    def _values(self, outputs: list[Expression], leaves: dict[int, str]) -> list[str]:
        """Emit code that computes outputs from vectors; returns the registers of vectors."""
        w = self.writer
        results = w.block(self.recursion.graph, outputs, leaves, list(leaves))
        return [w.as_vector(kind, name) for kind, name in results]

    def _predict(self, slots: dict[int, str], block: str) -> None:
        """Emit the loop over the sub-steps of a step, which moves the moments in `slots`."""
        r, w = self.recursion, self.writer
        parts = self._column("parts", block, 0)
        largest = w.value(f"sext i32 {w.load('i32', w.at('i32', '%most', block))} to i64")
        with w.loop(largest) as j:
            counter = w.splat(w.value(f"sitofp i64 {j} to double"))
            runs = w.value(f"fcmp olt {RUN_VECTOR} {counter}, {parts}")
            old = {i: w.load(RUN_VECTOR, slot) for i, slot in slots.items()}
            leaves = old | self._parameters_and_keys(block) | self._load_row("known", block, kept_nodes(r))
            leaves |= self._inputs_within(block, counter, parts)
            if not r.exact:
                leaves |= self._matrices(leaves, SHARE)
            values = self._values(r.predict, leaves)
            for (i, slot), value in zip(slots.items(), values, strict=True):
                w.store(RUN_VECTOR, self._where(runs, value, old[i]), slot)

    def _where(self, truths: str, a: str, b: str) -> str:
        """Emit code that chooses between two vectors lane by lane; returns the register."""
        return self.writer.value(f"select {TRUTHS} {truths}, {RUN_VECTOR} {a}, {RUN_VECTOR} {b}")

    def _inputs_within(self, block: str, j: str, parts: str) -> dict[int, str]:
        """Emit code for the inputs at the start and the end of sub-step j of `parts`, exact for a single
        sub-step; returns node → register."""
        r, w = self.recursion, self.writer
        one = w.splat(literal(1.0))
        after = w.value(f"fadd {RUN_VECTOR} {j}, {one}")
        is_last = w.value(f"fcmp oge {RUN_VECTOR} {after}, {parts}")
        left, right = (w.value(f"fdiv {RUN_VECTOR} {part}, {parts}") for part in (j, after))
        result = {}
        for c, name in enumerate(r.varying):
            hold = r.holds[name]
            current = self._column("before" if hold == PREVIOUS else "now", block, c)
            result[r.end[name].index] = current
            if hold == LINEAR:
                before = self._column("before", block, c)
                change = w.value(f"fsub {RUN_VECTOR} {current}, {before}")
                values = [
                    w.value(f"fadd {RUN_VECTOR} {before}, {w.value(f'fmul {RUN_VECTOR} {change}, {part}')}")
                    for part in (left, right)
                ]
                result[r.start[name].index] = values[0]
                result[r.end[name].index] = self._where(is_last, current, values[1])
        return result
