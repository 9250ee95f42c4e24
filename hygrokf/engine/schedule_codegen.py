"""The loop that chooses the sub-steps of every step along the filtered course, as LLVM text.

A step is bisected where its error is.  From the moments before an interval (i, l), of length 2^−l of the
step and beginning at i 2^−l of it, one sub-step to (m, P) is compared with two of half the length to (m',
P'), in standard deviations of every reading,

    |h(m) − h(m')| / √S',

and of every state, as far as the next half, with the transition E, does not forget the difference,

    |E (m − m')|_i / (√P'_ii + ε |m'_i − x_i| + ε' |m'_i|),    |E (P − P') E'|_ij / √(P'_ii P'_jj),

x the mean before the interval and ε = `CHANGE`, ε' = `VALUE`, which measure states without any variance.
Within a step a fast state that follows slow ones thus counts by its effect on them; at the end of the step,
where readings may come, E is the identity.  An interval in which a comparison of the rates changes its result
is halved until it is 2^−`KINK` of the step: a comparison of moments misses a kink after the last node.  If
the error is within the tolerance, the single sub-step is accepted, otherwise its first half is tried.  After
an interval the next one is as long, or twice as long where its position allows.  The number of doublings
follows from the rates at the beginning.

Methods emit code; strings that they take and return are registers and slots of the text (`llvm_writer`), and
the nouns of `step_codegen` hold here, too.  Further ones:

- walk: the choice of the sub-steps of one step, from left to right.
- i, level: the interval (i, l) above; at `level` l it is 2^−l of the step.
- origin, once: slots of the moments before an interval, and after it in one sub-step; those after two halves
  stand in the state's slots.
- ahead: slots of the transition E of the last sub-step.
- tags: for each row of the workspace, the key whose values it holds.
"""

from __future__ import annotations

from collections.abc import Callable

from hygrokf.engine.discretisation import SHARE
from hygrokf.engine.llvm_writer import SCALAR, literal
from hygrokf.engine.packing import place
from hygrokf.engine.step_codegen import DOUBLINGS, Names, Stages
from hygrokf.engine.traced_filter import Recursion
from hygrokf.physics.expression import Expression, Value, is_zero, maximum, sqrt
from hygrokf.physics.matrices import congruence, product

WALKED = ("controlled", "schedule")
"""Kinds of loops that choose their own sub-steps."""
CHANGE, VALUE = 0.01, 0.001
"""[1] shares of a state's change and value that count as its standard deviations."""
LEAST_SD = 1e-120
"""Standard deviation, in a state's unit, that is added to each: the square of a smaller one may be flushed to
zero before the covariances with other states are."""
MEAN_ROUNDING = 1e-14
"""[1] of a mean below which a difference is rounding."""
KINK = 6
"""Intervals across a kink are at most 2^−6 of a step."""
MOST_HALVINGS = 24
"""Smallest interval: 2^−24 of a step."""


WORKSPACE = (MOST_HALVINGS + 2) * (DOUBLINGS + 1)
"""Rows of the key table of a walk: one for each level and number of doublings."""


def table_room(recursion: Recursion, kind: str) -> int:
    """Numbers of the key table of a loop that chooses its own sub-steps, 1 for others."""
    walked = kind in WALKED and not recursion.exact
    return WORKSPACE * max(1, len(recursion.key_nodes)) if walked else 1


class Walk:
    """The text that chooses the sub-steps of one step, for the kinds of loops in `WALKED`.

    The loop has the arguments `tags` (i64, one for every row of the workspace, initially −1), the key whose
    values a row holds, and `tolerance` (1,).
    """

    def __init__(self, stages: Stages, slots: Names) -> None:
        self.stages, self.slots = stages, slots
        w, r = stages.writer, stages.recursion
        self.i, self.level, self.pass_, self.times, self.going = (w.slot("i64") for _ in range(5))
        self.worst = w.slot("i64", "-1")
        self.origin = [w.slot(SCALAR) for _ in slots]
        self.once = [w.slot(SCALAR) for _ in slots]
        g, n = r.graph, r.n
        self.before = [g.symbol(f"before:{i}") for i in range(n)]
        self.single = [g.symbol(f"once:{i}") for i in range(len(r.state))]
        self.ahead = {g.symbol(f"ahead:{i}").index: w.slot(SCALAR) for i in range(n * n)}
        self.errors = self._errors()

    def _errors(self) -> list[Expression]:
        """Trace the errors of an interval: that of every state (n,) and reading (k,); a sum that is finite
        only if all moments are; and the number of comparisons in the rates whose results differ between the
        means before and after."""
        r = self.stages.recursion
        g, n, single_step, halves = r.graph, r.n, self.single, r.state

        def size(value: Value) -> Expression:
            return maximum(g.lift(value), -g.lift(value))

        def without_rounding(value: Value, of: Value) -> Expression:
            return maximum(size(value) - MEAN_ROUNDING * size(of), 0.0)

        ahead = [
            [
                g.symbol(f"ahead:{i * n + j}") if i == j or not is_zero(r.transition[i * n + j]) else 0.0
                for j in range(n)
            ]
            for i in range(n)
        ]
        packed = [g.lift(r.uncertainty[i][j]) for i in range(n) for j in range(i + 1)]
        single = g.substitute(packed, {e.index: s for e, s in zip(halves, single_step, strict=True)})
        differences = [p - q for p, q in zip([*single_step[:n], *single], [*r.mean, *packed], strict=True)]
        mean_differences = [row[0] for row in product(ahead, [[value] for value in differences[:n]])]
        spread = congruence(ahead, [[differences[n + place(i, j)] for j in range(n)] for i in range(n)])
        sd = [sqrt(maximum(packed[place(i, i)], 0.0)) + LEAST_SD for i in range(n)]
        errors = []
        for i in range(n):
            change = size(halves[i] - self.before[i])
            scale = sd[i] + CHANGE * change + VALUE * size(halves[i])
            error = without_rounding(mean_differences[i], halves[i]) / scale
            for j in range(n):
                error = maximum(error, size(spread[i][j]) / (sd[i] * sd[j]))
            errors.append(error)
        shown_halves = [update[-3] for update in r.updates]
        shown_single, shown_before = (
            g.substitute(shown_halves, {m.index: e for m, e in zip(r.mean, symbols, strict=False)})
            for symbols in (single_step, self.before)
        )
        for a, b, c, update in zip(shown_single, shown_halves, shown_before, r.updates, strict=True):
            scale = sqrt(maximum(update[-2], 0.0)) + CHANGE * size(c - b) + 1e-300
            errors.append(without_rounding(a - b, b) / scale)
        total = g.constant(0.0)
        for value in differences:
            total = total + value
        shown_before = g.substitute(
            r.comparisons, {m.index: e for m, e in zip(r.mean, self.before, strict=True)}
        )
        changed = g.constant(0.0)
        for a, b in zip(r.comparisons, shown_before, strict=True):
            changed = changed + (a - b) * (a - b)
        return [*errors, total, changed]

    def through(self, k: str, accept: Callable[[str, str, str], str | None]) -> None:
        """Emit code that moves the moments to instant k.

        `accept(i, level, doublings)` emits code that runs for every accepted sub-step, and may return an i1
        that ends the walk.  If that holds, or if the deepest interval exceeds the tolerance, `worst` is the
        state with the largest error, and the moments stay before that interval.
        """
        w = self.stages.writer
        key = self.stages.key_of(k)
        self.compute_key_row(key)
        hours = w.load(
            SCALAR, w.at(SCALAR, "%keys", w.integer("mul", key, len(self.stages.recursion.key_leaves)))
        )
        w.store("i64", "0", self.i)
        w.store("i64", "0", self.level)
        has_length = w.value(f"fcmp ogt double {hours}, {literal(0.0)}")
        w.store("i64", w.value(f"zext i1 {has_length} to i64"), self.going)
        with w.during(self.going):
            self._copy(list(self.slots.values()), self.origin)
            begin, level = w.load("i64", self.i), w.load("i64", self.level)
            with w.loop("3") as trial:  # once over the interval, then over its halves
                first = w.value(f"icmp eq i64 {trial}, 0")
                with w.when(w.value(f"icmp eq i64 {trial}, 1")):
                    self._copy(list(self.slots.values()), self.once)
                    self._copy(self.origin, list(self.slots.values()))
                deeper = w.value(f"select i1 {first}, i64 {level}, i64 {w.integer('add', level, 1)}")
                half = w.integer("add", w.integer("mul", begin, 2), w.integer("sub", trial, 1))
                at = w.value(f"select i1 {first}, i64 {begin}, i64 {half}")
                times = self._sub_step(k, key, hours, at, deeper)
                with w.when(first):
                    w.store("i64", times, self.times)
            error, state, changed = self._assess(k, key)
            tolerance = w.load(SCALAR, "%tolerance")
            below_kink = w.value(f"icmp sge i64 {level}, {KINK}")
            smooth = w.value(f"or i1 {below_kink}, {w.value(f'fcmp oeq double {changed}, {literal(0.0)}')}")
            accepted = w.value(f"and i1 {smooth}, {w.value(f'fcmp ole double {error}, {tolerance}')}")
            with w.when(accepted):
                ends = accept(begin, level, w.load("i64", self.times))
                self._copy(self.once, list(self.slots.values()))
                after = w.integer("add", begin, 1)
                intervals = w.integer("shl", "1", level)
                may_double = w.value(f"icmp sgt i64 {level}, 0")
                even = w.value(f"icmp eq i64 {w.integer('and', after, 1)}, 0")
                may_double = w.value(f"and i1 {may_double}, {even}")
                shift = w.value(f"zext i1 {may_double} to i64")
                w.store("i64", w.integer("ashr", after, shift), self.i)
                w.store("i64", w.integer("sub", level, shift), self.level)
                remains = w.value(f"icmp slt i64 {after}, {intervals}")
                w.store("i64", w.value(f"zext i1 {remains} to i64"), self.going)
                if ends is not None:
                    self._stop(ends, state)
            with w.when(w.value(f"xor i1 {accepted}, true")):
                self._copy(self.origin, list(self.slots.values()))
                w.store("i64", w.integer("mul", begin, 2), self.i)
                w.store("i64", w.integer("add", level, 1), self.level)
                self._stop(w.value(f"icmp sge i64 {level}, {MOST_HALVINGS}"), state)

    def _stop(self, condition: str, state: str) -> None:
        """Emit code that ends the walk if an i1 holds, and records the state with the largest error."""
        w = self.stages.writer
        with w.when(condition):
            w.store("i64", state, self.worst)
            w.store("i64", "0", self.going)

    def compute_key_row(self, key: str) -> None:
        """Emit code that computes the values of a key as row 0 of the workspace, which the updates read."""
        self._provide_row(key, "0", "0", self.stages.key_leaves(key))

    def _provide_row(self, key: str, row: str, times: str, leaves: Names) -> str:
        """Emit code that computes a row of the workspace from its leaves unless it holds this key's values
        already; returns the register of the row's first position."""
        s, w, r = self.stages, self.stages.writer, self.stages.recursion
        start, tag = w.integer("mul", row, len(r.key_nodes)), w.at("i64", "%tags", row)
        with w.when(w.value(f"icmp ne i64 {w.load('i64', tag)}, {key}")):
            w.store("i64", key, tag)
            for c, name in enumerate(s.early(leaves, times)):
                w.store(SCALAR, name, w.at(SCALAR, "%table", w.integer("add", start, c)))
        return start

    def _copy(self, source: list[str], target: list[str]) -> None:
        """Emit code that copies slots to other slots."""
        w = self.stages.writer
        for a, b in zip(source, target, strict=True):
            w.store(SCALAR, w.load(SCALAR, a), b)

    def _sub_step(self, k: str, key: str, hours: str, at: str, level: str) -> str:
        """Emit code that moves the moments over interval `at` of a level of the step of `hours` [h]; returns
        the register of its number of doublings."""
        s, w, r = self.stages, self.stages.writer, self.stages.recursion
        part = s.power(level)
        left = w.real("fmul", w.value(f"sitofp i64 {at} to double"), part)
        inputs = s.inputs_between(k, left, w.real("fadd", left, part))
        leaves = s.key_leaves(key) | {r.h.index: w.real("fmul", hours, part)}
        doublings = s.doublings(s.read(self.slots) | inputs | leaves, SHARE)
        times = w.value(f"select i1 {w.value(f'icmp slt i64 {doublings}, 0')}, i64 0, i64 {doublings}")
        leaves[r.share.index] = s.power(times)
        row = w.integer("add", w.integer("mul", level, DOUBLINGS + 1), times)
        start = self._provide_row(key, row, times, leaves)
        row_values = {
            i: w.load(SCALAR, w.at(SCALAR, "%table", w.integer("add", start, c)))
            for c, i in enumerate(r.key_nodes)
        }
        leaves |= row_values | s.at_parameters
        s.advance(self.slots, times, s.read(self.slots) | leaves | inputs)
        transition = w.block(r.graph, r.transition, leaves | s.reading(s.registers, r.transition))
        is_last = w.value(f"icmp eq i64 {w.integer('add', at, 1)}, {w.integer('shl', '1', level)}")
        for c, (slot, (_, name)) in enumerate(zip(self.ahead.values(), transition, strict=True)):
            identity_entry = literal(1.0 if c % (r.n + 1) == 0 else 0.0)
            w.store(SCALAR, w.value(f"select i1 {is_last}, double {identity_entry}, double {name}"), slot)
        return times

    def _assess(self, k: str, key: str) -> tuple[str, str, str]:
        """Emit code that compares the halves of an interval with the whole; returns the registers of the
        largest error, NaN where a moment is not finite; of the index of its state, from n on of a reading;
        and of the number of comparisons whose result changed."""
        s, w, r = self.stages, self.stages.writer, self.stages.recursion
        leaves = s.read(self.slots) | s.read(self.ahead) | s.table(key) | s.inputs_at(k) | s.at_parameters
        leaves[r.reading.index] = literal(0.0)
        for symbols, slots in ((self.before, self.origin), (self.single, self.once)):
            leaves |= {e.index: w.load(SCALAR, slot) for e, slot in zip(symbols, slots, strict=False)}
        *each, total, changed = (name for _, name in w.block(r.graph, self.errors, leaves))
        error, state = each[0], "0"
        for i, name in enumerate(each[1:], 1):
            larger = w.value(f"fcmp ogt double {name}, {error}")
            error = w.value(f"select i1 {larger}, double {name}, double {error}")
            state = w.value(f"select i1 {larger}, i64 {i}, i64 {state}")
        return w.real("fadd", error, w.real("fmul", total, literal(0.0))), state, changed
