"""The compiled step of many runs of one model: `RUNS` runs at a time, one in each lane of the processor's
vectors.

`fleet_text` writes one function for a traced recursion.  Persistent arrays are stored in blocks of `RUNS`
runs, (blocks, width, RUNS); the data of a step are stored in columns, (width, runs).  Every load thus takes
one number of each run in a block.  Values that depend only on the parameters and on the length of a step are
kept between steps and recomputed for blocks that are marked as changed.  Lanes differ in their number of
sub-steps: all lanes compute, and finished lanes keep their previous values.
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
    return "<" + ", ".join([f"i64 {number}"] * RUNS) + ">"


def fleet_text(recursion: Recursion) -> str:
    """LLVM text of a module with the function `fleet(blocks, theta, keys, …)`."""
    reduction = f"declare i64 @llvm.vector.reduce.smax.v{RUNS}i64({LONGS})\n"
    return declarations() + reduction + _Emission(recursion).function()


@dataclass
class _Emission:
    recursion: Recursion
    writer: Writer = field(init=False)

    def function(self) -> str:
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
        w = self.writer
        place = w.integer("add", w.integer("mul", block, width), column)
        return w.load(RUN_VECTOR, w.at(RUN_VECTOR, f"%{array}", place))

    def _column(self, array: str, block: str, column: int) -> str:
        w = self.writer
        place = w.integer("add", w.integer("mul", "%blocks", column), block)
        return w.load(RUN_VECTOR, w.at(RUN_VECTOR, f"%{array}", place))

    def _row(self, array: str, block: str, nodes: list[int]) -> dict[int, str]:
        return {i: self._load(array, block, len(nodes), c) for c, i in enumerate(nodes)}

    def _parameters_and_keys(self, block: str) -> dict[int, str]:
        r = self.recursion
        leaves = [e.index for e in (*r.p.values(), *r.given)]
        keys = {e.index: self._column("keys", block, c) for c, e in enumerate(r.key_leaves)}
        return self._row("theta", block, leaves) | keys

    def _keep(self, block: str) -> None:
        r, w = self.recursion, self.writer
        nodes, leaves = kept_nodes(r), self._parameters_and_keys(block)
        if r.exact:
            leaves |= self._matrices(leaves, CONSTANT_SHARE)
        wanted = [Expression(r.graph, i) for i in nodes]
        for c, (kind, name) in enumerate(w.block(r.graph, wanted, leaves, list(leaves))):
            place = w.integer("add", w.integer("mul", block, len(nodes)), c)
            w.store(RUN_VECTOR, w.as_vector(kind, name), w.at(RUN_VECTOR, "%known", place))

    def _matrices(self, leaves: dict[int, str], share: float) -> dict[int, str]:
        """Values of a step's matrices: of the symbol of the share, and of the symbols that operations
        assign."""
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
        """Run an operation; only `lanes` take its values."""
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
        w = self.writer
        needed = set(self.recursion.graph.needed(operation.block))
        all_leaves = leaves | {i: w.load(RUN_VECTOR, slot) for i, slot in slots.items() if i in needed}
        values = self._values(list(operation.block), all_leaves)
        for e, value in zip(operation.into, values, strict=True):
            old = w.load(RUN_VECTOR, slots[e.index])
            w.store(RUN_VECTOR, self._where(lanes, value, old), slots[e.index])

    def _doublings(self, leaves: dict[int, str], share: float) -> tuple[str, str]:
        """Number of doublings of every run, and the largest; 0 for rates that are not finite."""
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
        w = self.writer
        results = w.block(self.recursion.graph, outputs, leaves, list(leaves))
        return [w.as_vector(kind, name) for kind, name in results]

    def _predict(self, slots: dict[int, str], block: str) -> None:
        r, w = self.recursion, self.writer
        parts = self._column("parts", block, 0)
        largest = w.value(f"sext i32 {w.load('i32', w.at('i32', '%most', block))} to i64")
        with w.loop(largest) as j:
            counter = w.splat(w.value(f"sitofp i64 {j} to double"))
            runs = w.value(f"fcmp olt {RUN_VECTOR} {counter}, {parts}")
            old = {i: w.load(RUN_VECTOR, slot) for i, slot in slots.items()}
            leaves = old | self._parameters_and_keys(block) | self._row("known", block, kept_nodes(r))
            leaves |= self._inputs_within(block, counter, parts)
            if not r.exact:
                leaves |= self._matrices(leaves, SHARE)
            values = self._values(r.predict, leaves)
            for (i, slot), value in zip(slots.items(), values, strict=True):
                w.store(RUN_VECTOR, self._where(runs, value, old[i]), slot)

    def _where(self, truths: str, a: str, b: str) -> str:
        return self.writer.value(f"select {TRUTHS} {truths}, {RUN_VECTOR} {a}, {RUN_VECTOR} {b}")

    def _inputs_within(self, block: str, j: str, parts: str) -> dict[int, str]:
        """Inputs at the start and the end of sub-step j of `parts`; exact for a single sub-step."""
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
