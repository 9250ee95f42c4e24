"""The loops of a traced filter as LLVM text: value, trace, adjoint and tangent.

`loop_text` writes the function of one kind for a `hygrokf.engine.traced_filter.Recursion`: first the stages
before the time loop (parameters, then the table of keys), then the loop over the instants with its blocks of
straight-line code.  `FILTER_COMMON` lists the arguments that all kinds share, `FILTER_ARGUMENTS` those of
each kind.

Methods emit code; strings that they take and return are registers and slots of the text (`llvm_writer`), and
the nouns of `step_codegen` hold here, too.  Further ones:

- bars, dots: adjoints and tangents, by node; `%statebar`, `%keydot` and so on are arrays of them.
- seeds: node → expression of the adjoint from which a reverse pass starts.
- pull: to propagate the adjoints of a block's outputs to the nodes that it reads.
- k, c, y, exists: registers of the instant, of a reading and of whether it exists; the place of its output.
"""

from __future__ import annotations

from collections.abc import Sequence

from hygrokf.engine.discretisation import Assign, Repeat, operations
from hygrokf.engine.information import RunningSums, accumulate
from hygrokf.engine.llvm_writer import SCALAR, VECTOR, Writer, declarations, literal
from hygrokf.engine.packing import place, trace_width
from hygrokf.engine.schedule_codegen import WALKED, Walk
from hygrokf.engine.step_codegen import Names, Stages, Symbols, seed
from hygrokf.engine.traced_filter import INSTANT, KEY, Block, Recursion
from hygrokf.physics.expression import Expression, forward, reverse

FILTER_COMMON = [("i64", "count"), ("i64", "nkeys")]
FILTER_COMMON += [
    ("ptr", name) for name in "theta keys nsub table key offset row within u y reset state first".split()
]
"""Numbers of instants and keys; parameters; leaves, doublings and table of the keys; key and first sub-step
of every instant; key and fractions of the step (S, 2) of every sub-step; inputs, readings and resets of every
instant; moments before the first instant (replaced by the moments after the last one), and a copy of them."""
FILTER_ARGUMENTS = {
    kind: [("ptr", name) for name in names.split()]
    for kind, names in {
        "value": "out",
        "trace": "out rows",
        "adjoint": "out store keybar thetabar statebar buffer levels",
        "tangent": "out seeds statedot keydot e s edot sdot",
        "controlled": "idle levels positions tags tolerance",
        "schedule": "places depths doubled numbers tags tolerance",
    }.items()
}

"""In a loop that chooses its own sub-steps (`schedule_codegen.WALKED`), `tags` (`WORKSPACE`,), −1 at first,
are the keys whose values the rows of the table hold, and `tolerance` is one number.  A schedule: `places`,
`depths` and `doubled` (room,) of the sub-steps; `numbers` (5,): room, largest allowed number of sub-steps,
resulting number, instant reached, and index of the state whose error stopped the walk, or −1."""


def loop_text(recursion: Recursion, kind: str, gain: bool) -> str:
    """LLVM text of a module with one function, named after its kind: value, trace, adjoint or tangent.

    Without `gain`, readings do not correct the state.
    """
    emission = Emission(recursion, kind, gain)
    getattr(emission, "_" + kind)()
    return emission.text()


class Emission(Stages):
    """LLVM text of one loop of a recursion, begun with the stages before the time loop.

    gain: whether readings correct the moments.  The methods named after the kinds emit the whole time loop.
    """

    def __init__(self, recursion: Recursion, kind: str, gain: bool) -> None:
        self.gain = gain
        walked = kind in WALKED and not recursion.exact
        super().__init__(recursion, Writer(kind, FILTER_COMMON + FILTER_ARGUMENTS[kind]), walked)

    def text(self) -> str:
        return declarations() + self.writer.text()

    # -- pieces of the time loop -----------------------------------------------------------------------------
    def _readings(self, k: str) -> list[tuple[str, str]]:
        """Emit code that loads the readings at instant k; returns, for every output, the registers of the
        value and of the i1 whether it exists."""
        w = self.writer
        count = len(self.recursion.updates)
        row = w.integer("mul", k, count)
        result = []
        for c in range(count):
            y = w.load(SCALAR, w.at(SCALAR, "%y", w.integer("add", row, c)))
            result.append((y, w.value(f"fcmp ord double {y}, {literal(0.0)}")))
        return result

    def _update_leaves(self, slots: Names, k: str, key: str, y: str) -> Names:
        """Emit code that loads all that an update reads: moments, key table, inputs, reading and parameters;
        returns node → register."""
        return (
            self.read(slots)
            | self.table(key)
            | self.inputs_at(k)
            | {self.recursion.reading.index: y}
            | self.at_parameters
        )

    def _resets(self, slots: Names, k: str, zero: str = literal(0.0), kind: str = SCALAR) -> None:
        """Emit code that sets the running means to zero at an instant where their interval begins."""
        r, w = self.recursion, self.writer
        if not r.model.resets:
            return
        flags = w.load("i32", w.at("i32", "%reset", k))
        indices = list(slots)
        for bit, state in enumerate(r.model.resets):
            test = w.value(f"and i32 {flags}, {1 << bit}")
            with w.when(w.value(f"icmp ne i32 {test}, 0")):
                w.store(kind, zero, slots[indices[state]])
                # of factors, the row of L and the diagonal; the column holds what other states took from it
                for other in range(state if r.factored else r.n):
                    w.store(kind, zero, slots[indices[r.n + place(state, other)]])
                if r.factored:
                    w.store(kind, zero, slots[indices[r.n + r.q + bit]])
                for j in range(r.unknown):
                    w.store(kind, zero, slots[indices[r.loaded + state * r.unknown + j]])

    # -- the functions ---------------------------------------------------------------------------------------
    def _value(self) -> None:
        """Emit the loop that filters the readings and keeps the sums of the likelihood."""
        w, r = self.writer, self.recursion
        slots = self.slots(r.state)
        self.load_state(slots, "%state")
        total = RunningSums(w, len(r.updates))
        with w.loop("%count") as k:
            key = self.key_of(k)
            self.predict(slots, k)
            self._correct(slots, k, key, total)
            self._resets(slots, k)
        self.save_state(slots, "%state")
        total.write(w, "%out")

    def _schedule(self) -> None:
        """Emit the loop that chooses the sub-steps of every step along the filtered course."""
        w, r = self.writer, self.recursion
        slots = self.slots(r.state)
        self.load_state(slots, "%state")
        total, walk = RunningSums(w, len(r.updates)), Walk(self, slots)
        room, limit = (w.load("i64", w.at("i64", "%numbers", c)) for c in (0, 1))
        taken, instant = w.slot("i64", "0"), w.slot("i64", "0")
        going = w.slot("i64", w.value(f"zext i1 {w.value('icmp sgt i64 %count, 0')} to i64"))

        def accept(place: str, level: str, times: str) -> str:
            """Emit code that records a sub-step; returns the register of the i1 whether there are too
            many."""
            count = w.load("i64", taken)
            with w.when(w.value(f"icmp slt i64 {count}, {room}")):
                for name, value in (("places", place), ("depths", level), ("doubled", times)):
                    w.store("i32", w.value(f"trunc i64 {value} to i32"), w.at("i32", f"%{name}", count))
            w.store("i64", w.integer("add", count, 1), taken)
            return w.value(f"icmp sge i64 {count}, {limit}")

        with w.during(going):
            k = w.load("i64", instant)
            key = self.key_of(k)
            walk.through(k, accept)
            self._correct(slots, k, key, total)
            self._resets(slots, k)
            after = w.integer("add", k, 1)
            number = w.value(f"trunc i64 {w.load('i64', taken)} to i32")
            w.store("i32", number, w.at("i32", "%offset", after))
            resolved = w.value(f"icmp slt i64 {w.load('i64', walk.worst)}, 0")
            goes_on = w.value(f"and i1 {resolved}, {w.value(f'icmp slt i64 {after}, %count')}")
            w.store("i64", w.value(f"zext i1 {goes_on} to i64"), going)
            with w.when(resolved):
                w.store("i64", after, instant)
        for c, slot in enumerate((taken, instant, walk.worst), 2):
            w.store("i64", w.load("i64", slot), w.at("i64", "%numbers", c))
        self.save_state(slots, "%state")

    def _correct(self, slots: Names, k: str, key: str, total: RunningSums) -> None:
        """Emit code that counts the readings at instant k and corrects the moments in `slots` by them."""
        before = self._covariance(slots)
        for c, (y, exists) in enumerate(self._readings(k)):
            self._correct_by(c, y, exists, before, slots, k, key, total)

    def _correct_by(
        self, c: int, y: str, exists: str, before: Names, slots: Names, k: str, key: str, total: RunningSums
    ) -> None:
        """Emit code that counts reading c and corrects the moments in `slots` by it, if it exists.

        before: registers of the covariance before the readings of the instant.
        """
        w, r = self.writer, self.recursion
        with w.when(exists):
            leaves = self._update_leaves(slots, k, key, y)
            values = w.block(r.graph, self._results(r.updates[c]), leaves)
            total.take(w, values[-2][1], values[-1][1], r.square)
            self._watch(c, leaves, before, total)
            if self.gain:
                self._store(slots, values)

    def _covariance(self, slots: Names) -> Names:
        """Emit code that loads the covariance from the slots; returns node → register."""
        r = self.recursion
        return self.read({e.index: slots[e.index] for e in [*r.packed, *r.units]})

    def _watch(self, c: int, leaves: Names, before: Names, total: RunningSums) -> str:
        """Emit code that records the variance of an innovation, given the readings processed before it and
        without any of its instant; returns the register of the former."""
        w, r = self.writer, self.recursion
        ((_, variance),) = w.block(r.graph, [r.spreads[c]], leaves)
        ((_, variance_before),) = w.block(r.graph, [r.spreads[c]], leaves | before)
        total.watch(w, c, variance, variance_before)
        return variance

    def _results(self, update: Block) -> Block:
        """The expressions of an update that are computed; without gain only the innovation, its variance and
        e²/S."""
        return update if self.gain else update[-3:]

    def _trace(self) -> None:
        """Emit the loop that writes one row for each instant (`packing.trace_width`): moments before the
        readings; prediction and variance of every output; moments after the readings; transition; noise."""
        w, r = self.writer, self.recursion
        slots = self.slots(r.state)
        self.load_state(slots, "%state")
        total = RunningSums(w, len(r.updates))
        width = trace_width(len(slots), r.n, len(r.updates))
        transition = [w.slot(SCALAR) for _ in range(r.n * r.n)]
        noise = self.slots(r.gathered[0])
        with w.loop("%count") as k:
            key = self.key_of(k)
            row = w.at(SCALAR, "%rows", w.integer("mul", k, width))
            for c, s in enumerate(transition):
                w.store(SCALAR, literal(1.0 if c % (r.n + 1) == 0 else 0.0), s)
            for s in noise.values():
                w.store(SCALAR, literal(0.0), s)
            self._predict_with_transition(slots, transition, noise, k)
            self.save_state(slots, row)
            column = len(slots)
            before = self._covariance(slots)
            for c, (y, exists) in enumerate(self._readings(k)):
                outputs = [r.updates[c][-3], r.spreads[c]]
                reading = w.value(f"select i1 {exists}, double {y}, double {literal(0.0)}")
                leaves = self._update_leaves(slots, k, key, reading)
                (_, error), (_, variance) = w.block(r.graph, outputs, leaves)
                w.store(SCALAR, w.real("fsub", reading, error), w.at(SCALAR, row, column))
                w.store(SCALAR, variance, w.at(SCALAR, row, column + 1))
                column += 2
                self._correct_by(c, y, exists, before, slots, k, key, total)
            self.save_state(slots, w.at(SCALAR, row, column))
            column += len(slots)
            for c, s in enumerate([*transition, *noise.values()]):
                w.store(SCALAR, w.load(SCALAR, s), w.at(SCALAR, row, column + c))
            self._resets(slots, k)
        self.save_state(slots, "%state")
        total.write(w, "%out")

    def _predict_with_transition(self, slots: Names, transition: Sequence[str], noise: Names, k: str) -> None:
        """Emit code that moves the moments to instant k, and multiplies the `transition` (n², slots by rows)
        and accumulates the `noise` of its sub-steps."""
        r, w = self.recursion, self.writer
        n = r.n
        with self.sub_steps(k) as sub_step:
            leaves = self.read(slots) | self.read(noise) | self.table(sub_step.key) | sub_step.inputs
            leaves |= self.at_parameters
            self.perform(r.late, self.registers, self.times(sub_step.key), leaves)
            outputs = [*r.predict, *r.transition, *r.gathered[1]]
            values = w.block(r.graph, outputs, leaves | self.reading(self.registers, outputs))
            self._store(noise, values[len(slots) + n * n :])
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
        """Emit the loops of the score: a forward pass that stores the moments, and a backward pass that
        propagates the adjoints."""
        w, r = self.writer, self.recursion
        slots = self.slots(r.state)
        self.load_state(slots, "%state")
        total = RunningSums(w, len(r.updates))
        # store: row 2k the moments before the updates of instant k, row 2k+1 those after it
        with w.loop("%count") as k:
            key = self.key_of(k)
            self.predict(slots, k)
            self.save_state(slots, "%store", w.integer("mul", k, 2))
            self._correct(slots, k, key, total)
            self._resets(slots, k)
            self.save_state(slots, "%store", w.integer("add", w.integer("mul", k, 2), 1))
        total.write(w, "%out")

        bars = self.slots(r.state)
        self.load_state(bars, "%statebar")
        self.parameter_bars = {i: w.slot(SCALAR, literal(0.0)) for i in r.estimated_nodes}
        for e in r.p.values():
            self.parameter_bars.setdefault(e.index, w.slot(SCALAR, literal(0.0)))
        self.bars = bars | {i: w.slot(SCALAR, literal(0.0)) for i in self.registers}
        with w.loop("%count", backwards=True) as k:
            key = self.key_of(k)
            self._resets(bars, k)
            self._reverse_updates(slots, k, key)
            self._reverse_predict(slots, k)
        self.save_state(bars, "%statebar")
        self._reverse_stages()

    def _reverse_updates(self, slots: Names, k: str, key: str) -> None:
        """Emit code that propagates the adjoints back through the readings of instant k; the moments before
        each reading are recomputed into the buffer first."""
        w, r = self.writer, self.recursion
        readings = self._readings(k)
        self.load_state(slots, "%store", w.integer("mul", k, 2))
        last = len(r.updates) - 1
        for c, update in enumerate(r.updates):  # moments before each update, kept in the buffer
            self.save_state(slots, "%buffer", c)
            if c < last and self.gain:
                y, exists = readings[c]
                with w.when(exists):
                    leaves = self._update_leaves(slots, k, key, y)
                    values = w.block(r.graph, update[: len(slots)], leaves)
                    self._store(slots, values)
        for c in range(last, -1, -1):
            update = r.updates[c]
            y, exists = readings[c]
            with w.when(exists):
                self.load_state(slots, "%buffer", c)
                leaves = self._update_leaves(slots, k, key, y)
                variance, quadratic = update[-2:]
                seeds: Symbols = {}
                seed(seeds, variance, -0.5 / variance)
                seed(seeds, quadratic, r.graph.lift(-0.5 * r.term_derivative(quadratic)))
                self._pull(list(slots) if self.gain else [], update, leaves, key, seeds)

    def _reverse_predict(self, slots: Names, k: str) -> None:
        """Emit code that propagates the adjoints back through the sub-steps to instant k; the moments before
        each of several sub-steps are recomputed into the buffer first."""
        w, r = self.writer, self.recursion
        first = w.value(f"icmp eq i64 {k}, 0")
        self.load_state(slots, "%first")
        with w.when(w.value(f"xor i1 {first}, true")):
            self.load_state(slots, "%store", w.integer("sub", w.integer("mul", k, 2), 1))
        if not r.exact:
            with self.sub_steps(k) as sub_step:
                self.save_state(slots, "%buffer", sub_step.j)
                with w.when(w.value(f"icmp slt i64 {w.integer('add', sub_step.j, 1)}, {sub_step.count}")):
                    leaves = (
                        self.read(slots) | self.table(sub_step.key) | sub_step.inputs | self.at_parameters
                    )
                    self.advance(slots, self.times(sub_step.key), leaves)
        with self.sub_steps(k, backwards=True) as sub_step:
            if not r.exact:
                self.load_state(slots, "%buffer", sub_step.j)
            times = self.times(sub_step.key)
            leaves = self.read(slots) | self.table(sub_step.key) | sub_step.inputs | self.at_parameters
            self.perform(r.late, self.registers, times, leaves, levels=True)
            all_leaves = leaves | self.reading(self.registers, r.predict)
            self._pull(list(slots), r.predict, all_leaves, sub_step.key)
            self.retract(r.late, self.registers, times, leaves, self._pull, sub_step.key)

    def _pull(
        self,
        into: Sequence[int],
        block: Sequence[Expression],
        leaves: Names,
        key: str,
        seeds: Symbols | None = None,
        stage: int = INSTANT,
    ) -> None:
        """Emit code that propagates the adjoints of the symbols `into`, whose values a block computes, to the
        nodes that the block reads; the adjoints of `into` itself are replaced.

        leaves: registers from which the block is computed.  key: register of its row of the key table.
        seeds: adjoints of outputs of the block that are known without symbols.  stage: at which the block
        runs; the nodes of earlier stages keep sums of their adjoints.
        """
        w, r = self.writer, self.recursion
        seeds = dict(seeds or {})
        names: Names = {}
        for e, i in zip(block, into, strict=False):
            bar = r.graph.symbol(f"bar:{i}")
            seed(seeds, e, bar)
            names[bar.index] = w.load(SCALAR, self.bars[i])
        parameters, keys = r.boundary(block, stage)
        parameters = [i for i in parameters if i in self.parameter_bars]
        keys = [i for i in keys if i not in self.bars]
        targets = [*self.bars, *parameters, *keys]
        adjoints = reverse(r.graph, seeds, targets)
        nodes = [i for i in targets if i in adjoints]
        values = w.block(r.graph, [adjoints[i] for i in nodes], leaves | names)
        result = {i: name for i, (_, name) in zip(nodes, values, strict=True)}
        for i in into:
            w.store(SCALAR, result.pop(i, literal(0.0)), self.bars[i])
        row = w.integer("mul", key, len(r.key_nodes))
        for i, name in result.items():
            if i in self.bars:
                accumulate(w, name, self.bars[i])
            elif i in self.parameter_bars:
                accumulate(w, name, self.parameter_bars[i])
            else:
                column = w.integer("add", row, r.key_nodes.index(i))
                accumulate(w, name, w.at(SCALAR, "%keybar", column))

    def _reverse_stages(self) -> None:
        """Emit code that passes the adjoints of the key table on to the parameter stage, and from there to
        the parameters."""
        w, r, g = self.writer, self.recursion, self.recursion.graph
        keys = [Expression(g, i) for i in r.key_nodes]
        bars = {i: g.symbol(f"keybar:{i}") for i in r.key_nodes}
        with w.loop("%nkeys") as key:
            slots = self.slots([e for operation in operations(r.early) for e in operation.into])
            self.bars = {i: w.slot(SCALAR, literal(0.0)) for i in slots}
            times, leaves = self.times(key), self.key_leaves(key) | self.at_parameters
            self.perform(r.early, slots, times, leaves, levels=True)
            names = self._load_row("%keybar", key, [bars[i].index for i in r.key_nodes])
            self._pull([], keys, leaves | self.read(slots) | names, key, bars, KEY)

            def pull(into: Sequence[int], block: Sequence[Expression], block_leaves: Names, row: str) -> None:
                self._pull(into, block, block_leaves, row, stage=KEY)

            self.retract(r.early, slots, times, leaves, pull, key)
        parameters = {e.index for e in r.p.values()}
        seeds = {i: g.symbol(f"parbar:{i}") for i in r.estimated_nodes if i not in parameters}
        names = {seeds[i].index: w.load(SCALAR, self.parameter_bars[i]) for i in seeds}
        adjoints = reverse(g, seeds, parameters) if seeds else {}
        nodes = list(adjoints)
        values = w.block(g, [adjoints[i] for i in nodes], self.at_parameters | names)
        for i, (_, name) in zip(nodes, values, strict=True):
            accumulate(w, name, self.parameter_bars[i])
        for c, e in enumerate(r.p.values()):
            w.store(SCALAR, w.load(SCALAR, self.parameter_bars[e.index]), w.at(SCALAR, "%thetabar", c))

    def _tangent(self) -> None:
        """Emit the loop of innovations, variances and their derivatives along `LANES` directions."""
        w, r, g = self.writer, self.recursion, self.recursion.graph
        directions, dots = self._stage_tangents()
        key_dots = {i: g.symbol(f"dot:{i}") for i in r.key_nodes}
        slots = self.slots(r.state)
        state_dots = {i: g.symbol(f"dot:{i}") for i in slots}
        dot_slots = {i: w.slot(VECTOR) for i in slots}
        self.load_state(slots, "%state")
        for c, s in enumerate(dot_slots.values()):
            w.store(VECTOR, w.load(VECTOR, w.at(VECTOR, "%statedot", c)), s)
        total = RunningSums(w, len(r.updates))
        register_dots = {i: w.slot(VECTOR, "zeroinitializer") for i in self.registers}
        within = {i: g.symbol(f"dot:{i}") for i in self.registers}
        tangents = directions | key_dots | state_dots | within

        def dot_leaves(key: str) -> Names:
            """Emit loads of the tangents that a block may read; returns symbol of the tangent → register."""
            keys = self._load_row("%keydot", key, [key_dots[i].index for i in r.key_nodes], VECTOR)
            states = {state_dots[i].index: w.load(VECTOR, s) for i, s in dot_slots.items()}
            inner = {within[i].index: w.load(VECTOR, s) for i, s in register_dots.items()}
            return dots | keys | states | inner

        def run(
            outputs: list[Expression], leaves: Names, key: str
        ) -> tuple[list[tuple[str, str]], list[str]]:
            """Emit outputs and their tangents; returns (kind, register) of the former, registers of these."""
            vectors = dot_leaves(key)
            derivative = forward(g, outputs, tangents)
            values_and_dots = w.block(g, [*outputs, *derivative], leaves | vectors, list(vectors))
            split = len(outputs)
            return values_and_dots[:split], [w.as_vector(*v) for v in values_and_dots[split:]]

        with w.loop("%count") as k:
            key = self.key_of(k)
            with self.sub_steps(k) as sub_step:
                leaves = self.read(slots) | self.table(sub_step.key) | sub_step.inputs | self.at_parameters

                def compute(operation: Assign | Repeat, all_leaves: Names, row: str = sub_step.key) -> None:
                    """Emit code that computes and stores an operation and its tangents."""
                    values, derivatives = run(list(operation.block), all_leaves, row)
                    for e, (_, name), dot in zip(operation.into, values, derivatives, strict=True):
                        w.store(SCALAR, name, self.registers[e.index])
                        w.store(VECTOR, dot, register_dots[e.index])

                self.perform(r.late, self.registers, self.times(sub_step.key), leaves, compute)
                all_leaves = leaves | self.reading(self.registers, r.predict)
                values, derivatives = run(r.predict, all_leaves, sub_step.key)
                self._store(slots, values)
                for s, name in zip(dot_slots.values(), derivatives, strict=True):
                    w.store(VECTOR, name, s)
            row, before = w.integer("mul", k, len(r.updates)), self._covariance(slots)
            for c, (y, exists) in enumerate(self._readings(k)):
                with w.when(exists):
                    leaves = self._update_leaves(slots, k, key, y)
                    values, derivatives = run(self._results(r.updates[c]), leaves, key)
                    total.take(w, values[-2][1], values[-1][1], r.square)
                    variance = self._watch(c, leaves, before, total)
                    place = w.integer("add", row, c)
                    error, error_dot = values[-3][1], derivatives[-3]
                    if r.unknown:  # a reading that merely shows what was unknown has no quadratic form
                        is_unknown = w.value(f"fcmp uno double {variance}, {literal(0.0)}")
                        error = w.value(f"select i1 {is_unknown}, double {literal(0.0)}, double {error}")
                        error_dot = w.value(
                            f"select i1 {is_unknown}, {VECTOR} zeroinitializer, {VECTOR} {error_dot}"
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
        """Emit code that computes the tangents of the parameter stage, and stores those of the key table;
        returns node → symbol of its tangent, and symbol → register, of the parameter stage."""
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
        slots = self.slots([e for item in operations(r.early) for e in item.into])
        slot_dots = {i: g.symbol(f"dot:{i}") for i in slots}
        dot_slots = {i: w.slot(VECTOR, "zeroinitializer") for i in slots}

        def derivatives(block: Sequence[Expression], leaves: Names) -> list[tuple[str, str]]:
            """Emit code for the tangents of a block; returns their (kind, register)."""
            vectors = dots | {slot_dots[i].index: w.load(VECTOR, s) for i, s in dot_slots.items()}
            return w.block(g, forward(g, block, directions | slot_dots), leaves | vectors, list(vectors))

        def compute(operation: Assign | Repeat, leaves: Names) -> None:
            """Emit code that computes an operation and its tangents, and stores both in their slots."""
            names = [w.as_vector(*item) for item in derivatives(operation.block, leaves)]
            self._compute(slots)(operation, leaves)
            for e, name in zip(operation.into, names, strict=True):
                w.store(VECTOR, name, dot_slots[e.index])

        with w.loop("%nkeys") as key:
            leaves = self.key_leaves(key) | self.at_parameters
            self.perform(r.early, slots, self.times(key), leaves, compute)
            values = derivatives(keys, leaves | self.read(slots))
            row = w.integer("mul", key, len(keys))
            for c, (kind, name) in enumerate(values):
                pointer = w.at(VECTOR, "%keydot", w.integer("add", row, c))
                w.store(VECTOR, w.as_vector(kind, name), pointer)
        return directions, dots
