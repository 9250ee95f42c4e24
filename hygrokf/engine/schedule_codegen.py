"""The loop that chooses the sub-steps of every step along the filtered course, as LLVM text.

A step is bisected where its error is.  From the moments before an interval (i, l), of length 2^−l of the step and
beginning at i 2^−l of it, one sub-step is compared with two of half the length,

    e = max_i |m_i − m'_i| / (√P'_ii + ε |m'_i − x_i|),    max_ij |P_ij − P'_ij| / √(P'_ii P'_jj),

x the mean before the interval and ε = `CHANGE`, which measures states that are known without doubt.  Up to the
tolerance the one sub-step stands, otherwise its first half is tried; behind an interval the next one is as long, or
twice as long where it may begin there.  The number of doublings follows from the rates at the beginning.
"""

from __future__ import annotations

from collections.abc import Callable

from hygrokf.engine.discretisation import SHARE
from hygrokf.engine.llvm_writer import SCALAR, literal
from hygrokf.engine.step_codegen import DOUBLINGS, Names, Stages
from hygrokf.engine.traced_filter import Recursion, place
from hygrokf.physics.expression import Expression, maximum, sqrt

WALKED = ("controlled", "schedule")
"""Kinds of loops that choose their own sub-steps."""
CHANGE = 1e-2
ROUNDING = 1e-13
"""[1] of a mean below which a difference is rounding."""
DEEPEST = 24
"""Smallest interval: 2^−24 of a step."""


WORKSPACE = (DEEPEST + 2) * (DOUBLINGS + 1)
"""Rows of the key table of a walk: one for each level and number of doublings."""


def table_room(recursion: Recursion, kind: str) -> int:
    """Numbers of the key table of a loop that chooses its own sub-steps, 1 for others."""
    walked = kind in WALKED and not recursion.exact
    return WORKSPACE * max(1, len(recursion.key_nodes)) if walked else 1


class Walk:
    """The walk through one step, in a loop of its own kind.

    The loop has the arguments `tags` (i64, one for every row of the workspace, first −1): the key whose values a row
    holds; and `tolerance` (1,).
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
        self.ends = [[g.symbol(f"{name}:{i}") for i in range(n + r.q)] for name in ("once", "twice")]
        self.errors = self._errors()

    def _errors(self) -> list[Expression]:
        """The error of every state (n,), and a number that is not finite where a moment is not."""
        r, (one, two) = self.stages.recursion, self.ends
        n = r.n

        def size(value: Expression) -> Expression:
            return maximum(value, -value)

        sd = [sqrt(maximum(two[n + place(i, i)], 0.0)) for i in range(n)]
        found, total = [], one[0] - two[0]
        for p, q in zip(one[1:], two[1:], strict=True):
            total = total + (p - q)
        for i in range(n):
            scale = sd[i] + CHANGE * size(two[i] - self.before[i]) + ROUNDING * size(two[i]) + 1e-300
            error = size(one[i] - two[i]) / scale
            for j in range(n):
                p, q = one[n + place(i, j)], two[n + place(i, j)]
                error = maximum(error, size(p - q) / (sd[i] * sd[j] + 1e-300))
            found.append(error)
        return [*found, total]

    def through(self, k: str, accept: Callable[[str, str, str], str | None]) -> None:
        """Move the moments to instant k; `accept(i, level, doublings)` is told every sub-step, and returns an i1
        that ends the walk.  Where it does, or the deepest interval does not do, `worst` is the state with the
        largest error, and the moments stay before that interval."""
        w = self.stages.writer
        key = self.stages.key_of(k)
        hours = w.load(SCALAR, w.at(SCALAR, "%keys", w.integer("mul", key, len(self.stages.recursion.key_leaves))))
        w.store("i64", "0", self.i)
        w.store("i64", "0", self.level)
        begun = w.value(f"fcmp ogt double {hours}, {literal(0.0)}")
        w.store("i64", w.value(f"zext i1 {begun} to i64"), self.going)
        with w.during(self.going):
            self._copy(list(self.slots.values()), self.origin)
            begin, level = w.load("i64", self.i), w.load("i64", self.level)
            with w.loop("3") as trial:  # once over the interval, then over its halves
                first = w.value(f"icmp eq i64 {trial}, 0")
                with w.when(w.value(f"icmp eq i64 {trial}, 1")):
                    self._copy(list(self.slots.values()), self.once)
                    self._copy(self.origin, list(self.slots.values()))
                deeper = w.value(f"select i1 {first}, i64 {level}, i64 {w.integer('add', level, 1)}")
                place_ = w.integer("add", w.integer("mul", begin, 2), w.integer("sub", trial, 1))
                at = w.value(f"select i1 {first}, i64 {begin}, i64 {place_}")
                times = self._sub_step(k, key, hours, at, deeper)
                with w.when(first):
                    w.store("i64", times, self.times)
            error, state = self._judged()
            tolerance = w.load(SCALAR, "%tolerance")
            good = w.value(f"fcmp ole double {error}, {tolerance}")
            with w.when(good):
                enough = accept(begin, level, w.load("i64", self.times))
                self._copy(self.once, list(self.slots.values()))
                after = w.integer("add", begin, 1)
                whole = w.integer("shl", "1", level)
                up = w.value(f"icmp sgt i64 {level}, 0")
                even = w.value(f"icmp eq i64 {w.integer('and', after, 1)}, 0")
                up = w.value(f"and i1 {up}, {even}")
                one = w.value(f"zext i1 {up} to i64")
                w.store("i64", w.integer("ashr", after, one), self.i)
                w.store("i64", w.integer("sub", level, one), self.level)
                left = w.value(f"icmp slt i64 {after}, {whole}")
                w.store("i64", w.value(f"zext i1 {left} to i64"), self.going)
                if enough is not None:
                    self._stop(enough, state)
            with w.when(w.value(f"xor i1 {good}, true")):
                self._copy(self.origin, list(self.slots.values()))
                w.store("i64", w.integer("mul", begin, 2), self.i)
                w.store("i64", w.integer("add", level, 1), self.level)
                self._stop(w.value(f"icmp sge i64 {level}, {DEEPEST}"), state)

    def _stop(self, condition: str, state: str) -> None:
        w = self.stages.writer
        with w.when(condition):
            w.store("i64", state, self.worst)
            w.store("i64", "0", self.going)

    def known(self, key: str) -> None:
        """Make the values of a key known as row 0 of the workspace, which the updates read."""
        self._row(key, "0", "0", self.stages.key_leaves(key))

    def _row(self, key: str, row: str, times: str, leaves: Names) -> str:
        """Where the values of a key table's row begin in the workspace; computed unless it holds them already."""
        s, w, r = self.stages, self.stages.writer, self.stages.recursion
        start, tag = w.integer("mul", row, len(r.key_nodes)), w.at("i64", "%tags", row)
        with w.when(w.value(f"icmp ne i64 {w.load('i64', tag)}, {key}")):
            w.store("i64", key, tag)
            for c, name in enumerate(s.early(leaves, times)):
                w.store(SCALAR, name, w.at(SCALAR, "%table", w.integer("add", start, c)))
        return start

    def _copy(self, source: list[str], target: list[str]) -> None:
        w = self.stages.writer
        for a, b in zip(source, target, strict=True):
            w.store(SCALAR, w.load(SCALAR, a), b)

    def _sub_step(self, k: str, key: str, hours: str, at: str, level: str) -> str:
        """Move the moments over an interval; returns its doublings."""
        s, w, r = self.stages, self.stages.writer, self.stages.recursion
        part = s.power(level)
        left = w.real("fmul", w.value(f"sitofp i64 {at} to double"), part)
        inputs = s.inputs_between(k, left, w.real("fadd", left, part))
        leaves = s.key_leaves(key) | {r.h.index: w.real("fmul", hours, part)}
        found = s.doublings(s.read(self.slots) | inputs | leaves, SHARE)
        times = w.value(f"select i1 {w.value(f'icmp slt i64 {found}, 0')}, i64 0, i64 {found}")
        leaves[r.share.index] = s.power(times)
        row = w.integer("add", w.integer("mul", level, DOUBLINGS + 1), times)
        start = self._row(key, row, times, leaves)
        known = {
            i: w.load(SCALAR, w.at(SCALAR, "%table", w.integer("add", start, c)))
            for c, i in enumerate(r.key_nodes)
        }
        s.advance(self.slots, times, s.read(self.slots) | leaves | known | inputs | s.at_parameters)
        return times

    def _judged(self) -> tuple[str, str]:
        """The largest error, NaN where a moment is not finite, and its state."""
        w, r = self.stages.writer, self.stages.recursion
        n = r.n + r.q
        leaves = {
            e.index: w.load(SCALAR, slot)
            for symbols, slots in (
                (self.before, self.origin), (self.ends[0], self.once), (self.ends[1], self.slots.values()),
            )
            for e, slot in zip(symbols, list(slots)[: len(symbols)], strict=True)
        }  # fmt: skip
        *each, total = (name for _, name in w.block(r.graph, self.errors, leaves))
        error, state = each[0], "0"
        for i, name in enumerate(each[1:], 1):
            larger = w.value(f"fcmp ogt double {name}, {error}")
            error = w.value(f"select i1 {larger}, double {name}, double {error}")
            state = w.value(f"select i1 {larger}, i64 {i}, i64 {state}")
        finite = w.real("fmul", total, literal(0.0))
        return w.real("fadd", error, finite), state
