"""The compiled loops of a traced filter, each compiled at first use.

In the loop "controlled" a free run drives controllers: heaters, fans and vents follow the readings that a
logger would show.  The loops of a filter with many states take the same arguments as straight-line loops.

Shapes: T instants, K keys, n states, d parameters, L = `LANES`; moments packed outside, in blocks inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any

import numpy as np

from hygrokf.engine.filter_codegen import Emission, loop_text
from hygrokf.engine.jit import CompiledCode
from hygrokf.engine.llvm_writer import LANES, SCALAR, Writer, literal
from hygrokf.engine.packing import pack, unpack
from hygrokf.engine.schedule_codegen import Walk
from hygrokf.engine.traced_filter import Recursion
from hygrokf.engine.wide_codegen import wide_text, workspace
from hygrokf.engine.wide_recursion import Numbers, WideRecursion, aligned
from hygrokf.physics.expression import Expression


@dataclass(frozen=True)
class Control:
    """A controller within the loop, which sets a varying input from the reading that a logger would show.

    `input` and `reads` are names of an input and an output; `mean_h` [h] is the logger's averaging interval,
    0 for instants.  Its position is (reading − a)/(b − a), limited to 0 … 1, with its two levels a and b.
    With `idle` it is 0 except at standstill.
    """

    input: str
    reads: str
    mean_h: float
    idle: bool


def controlled_text(r: Recursion, controls: Sequence[Control]) -> str:
    """LLVM text of the loop "controlled": means of a free run, and `positions` (T, c) of the controls in the
    step that leads to each instant.

    The controls read the logger at the start of each step.  `idle` (T,) is 1 at standstill; `levels` (c, 2)
    are the readings at which the controls have the positions 0 and 1.
    """
    emission = Emission(r, "controlled", gain=False)
    w = emission.writer
    means = [e.index for e in r.mean]
    slots = emission.slots(r.state)
    emission.load_state(slots, "%state")
    width = len(r.varying)
    walk = None if r.exact else Walk(emission, slots)
    with w.loop("%count") as k:
        key = emission.key_of(k)
        row = w.integer("mul", k, width)
        before = w.integer("sub", row, width)
        inputs_before = {
            r.now[name].index: w.load(SCALAR, w.at(SCALAR, "%u", w.integer("add", before, c)))
            for c, name in enumerate(r.varying)
        }
        if walk is not None:
            walk.compute_key_row(key)
        leaves = emission.read(slots) | emission.table(key) | inputs_before | emission.at_parameters
        leaves |= {r.reading.index: literal(0.0)}
        shown = [name for _, name in w.block(r.graph, [_shown(r, control) for control in controls], leaves)]
        idle = w.value(f"fcmp ogt double {w.load(SCALAR, w.at(SCALAR, '%idle', k))}, {literal(0.5)}")
        place = w.integer("mul", k, len(controls))
        for c, (control, value) in enumerate(zip(controls, shown, strict=True)):
            if not control.mean_h:  # the value is the innovation of a reading of 0
                value = w.value(f"fneg double {value}")
            position = _position(w, control, c, value, idle)
            w.store(SCALAR, position, w.at(SCALAR, "%positions", w.integer("add", place, c)))
            column = w.integer("add", row, r.varying.index(control.input))
            w.store(SCALAR, position, w.at(SCALAR, "%u", column))
        if walk is not None:
            walk.through(k, lambda place, level, times: None)
        else:
            leaves = emission.read(slots) | emission.table(key) | emission.inputs_between(k)
            means_after = w.block(r.graph, r.predict[: len(means)], leaves | emission.at_parameters)
            for i, (_, name) in zip(means, means_after, strict=True):
                w.store(SCALAR, name, slots[i])
    emission.save_state(slots, "%state")
    return emission.text()


def _shown(recursion: Recursion, control: Control) -> Expression:
    """Expression of the reading that a control follows; for an interval mean, the reading whose running mean
    grows at the state's rate."""
    if control.mean_h:
        place = recursion.model.states.index(f"mean_{control.reads}")
        return recursion.rates[place] * control.mean_h
    return recursion.updates[recursion.model.outputs.index(control.reads)][-3]


def _position(w: Writer, control: Control, c: int, value: str, idle: str) -> str:
    """Emit code for the position of control c; returns its register.

    value: register of the reading that it follows.  idle: of the i1 whether the turbine stands still.
    """
    first, second = (w.load(SCALAR, w.at(SCALAR, "%levels", 2 * c + i)) for i in (0, 1))
    zero, one = literal(0.0), literal(1.0)
    share = w.real("fdiv", w.real("fsub", value, first), w.real("fsub", second, first))
    low = w.value(f"select i1 {w.value(f'fcmp ogt double {share}, {zero}')}, double {share}, double {zero}")
    limited = w.value(f"select i1 {w.value(f'fcmp olt double {low}, {one}')}, double {low}, double {one}")
    return w.value(f"select i1 {idle}, double {limited}, double {zero}") if control.idle else limited


_codes: dict[tuple[str, str, bool, tuple[Control, ...]], CompiledCode | WideLoop] = {}
"""Compiled loops by the recursion's structure, kind, gain and controls."""
_compiling = Lock()


def filter_loop(
    recursion: Recursion, kind: str, gain: bool = True, controls: tuple[Control, ...] = ()
) -> CompiledCode | WideLoop:
    """The compiled function named after its kind: value, trace, adjoint, tangent or schedule.

    Without `gain` the filter runs free.  The kind "controlled" is a free run in which the `controls` follow
    the simulation.
    """
    key = (recursion.structure, kind, gain, controls)
    if key not in _codes:
        with _compiling:
            if key not in _codes:
                source = repr(key)
                if isinstance(recursion, WideRecursion):
                    _codes[key] = wide_loop(recursion, kind, gain, source)
                elif kind == "controlled":
                    _codes[key] = CompiledCode(lambda: controlled_text(recursion, controls), [kind], source)
                else:
                    _codes[key] = CompiledCode(lambda: loop_text(recursion, kind, gain), [kind], source)
    return _codes[key]


# -- the compiled loops of a filter with many states, with the arguments of straight-line loops --------------
Common = tuple[Any, ...]
"""Number of instants, and arrays (`wide_codegen.WIDE_COMMON`, and the sums of the likelihood)."""


@dataclass(frozen=True)
class WideLoop:
    """One loop: computes the matrices of the keys and their derivatives, and converts moments to blocks."""

    recursion: WideRecursion
    code: CompiledCode

    def __call__(self, kind: str, *arguments: Any) -> None:
        """Run the loop of this kind with the arguments of `filter_codegen`."""
        count, _, theta, keys, times, _, key, _, _, _, u, y, reset, state, _, out, *rest = arguments
        r = self.recursion
        numbers = r.numbers(dict(zip(r.p, theta, strict=False)), keys)
        if numbers is None:
            times[:] = -1
            return
        block = self._block(state)
        common = (
            count, numbers.nodes, keys, numbers.table, key, u, y, reset, block, aligned(workspace(r)), out,
        )  # fmt: skip
        getattr(self, "_" + kind)(numbers, common, *rest)
        state[:] = self._packed(block)

    # the methods named after the kinds call the compiled loop and convert what it takes and returns
    def _value(self, numbers: Numbers, common: Common) -> None:
        self.code("value", *common)

    def _trace(self, numbers: Numbers, common: Common, rows: np.ndarray) -> None:
        r, key = self.recursion, common[4]
        size, width, pair_count = r.held * r.width, r.n + r.q, 2 * len(r.updates)
        raw_rows = np.empty((len(rows), 2 * size + pair_count))
        self.code("trace", *common, raw_rows)
        rows[:, :width] = self._packed(raw_rows[:, :size])
        rows[:, width : width + pair_count] = raw_rows[:, size : size + pair_count]
        rows[:, width + pair_count : 2 * width + pair_count] = self._packed(raw_rows[:, size + pair_count :])
        ends, w = 2 * width + pair_count, r.width
        rows[:, ends : ends + r.n**2] = numbers.table[key, : r.n, : r.n].reshape(len(rows), -1)
        rows[:, ends + r.n**2 :] = pack(numbers.table[key, 2 * w : 2 * w + r.n, : r.n])

    def _adjoint(
        self, numbers: Numbers, common: Common, store: np.ndarray, key_bar: np.ndarray,
        theta_bar: np.ndarray, state_bar: np.ndarray, *_room: np.ndarray,
    ) -> None:  # fmt: skip
        r, count = self.recursion, common[0]
        # off the diagonal, a packed entry stands for two entries: each has half of its adjoint
        share = np.concatenate([np.ones(r.n), pack(0.5 + 0.5 * np.eye(r.n))])
        bar = self._block(state_bar * share)
        stored = np.empty((count, len(r.updates) + 1, r.held * r.width))
        bars, known_bar = np.zeros_like(numbers.table), np.zeros(max(1, len(numbers.nodes)))
        first = np.array(common[8])
        self.code("adjoint", *common, first, stored, bars, known_bar, bar)
        state_bar[:] = self._packed(bar) / share
        theta_bar += numbers.adjoints(known_bar[: len(numbers.nodes)], bars)

    def _tangent(
        self, numbers: Numbers, common: Common, seeds: np.ndarray, dot: np.ndarray,
        key_dot: np.ndarray, *rows: np.ndarray,
    ) -> None:  # fmt: skip
        r = self.recursion
        node_dots, table_dots = numbers.tangents(seeds)
        block = aligned(r.held, r.rows, LANES)
        block[: r.n, : r.n] = np.moveaxis(unpack(dot[r.n :].T, r.n), 0, -1)
        block[r.n, : r.n] = dot[: r.n]
        self.code("tangent", *common, node_dots, table_dots, block, *rows)
        dot[: r.n] = block[r.n, : r.n]
        dot[r.n :] = pack(np.moveaxis(block[: r.n, : r.n], -1, 0)).T

    def _block(self, packed: np.ndarray) -> np.ndarray:
        """Packed moments as a block."""
        n = self.recursion.n
        block = aligned(self.recursion.held, self.recursion.width)
        block[:n, :n], block[n, :n] = unpack(packed[n:], n), packed[:n]
        return block

    def _packed(self, blocks: np.ndarray) -> np.ndarray:
        """Blocks as packed moments (…, width)."""
        n, w = self.recursion.n, self.recursion.width
        rows = blocks.reshape(*blocks.shape[:-1], -1, w) if blocks.shape[-1] != w else blocks
        return np.concatenate([rows[..., n, :n], pack(rows[..., :n, :n])], axis=-1)


def wide_loop(recursion: WideRecursion, kind: str, gain: bool, source: str) -> WideLoop:
    """The compiled loop of a kind: value, trace, adjoint or tangent; `source` as in `CompiledCode`."""
    return WideLoop(recursion, CompiledCode(lambda: wide_text(recursion, kind, gain), [kind], source))
