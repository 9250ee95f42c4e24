"""The compiled loops of a filter with many states, called as those of straight-line code are.

Shapes: T instants, K keys, n states, d parameters, L = `LANES`; moments packed outside, in blocks inside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hygrokf.engine.jit import Code
from hygrokf.engine.llvm_writer import LANES
from hygrokf.engine.packing import pack, unpack
from hygrokf.engine.wide_codegen import wide_text, workspace
from hygrokf.engine.wide_recursion import Numbers, WideRecursion, aligned

Common = tuple[Any, ...]
"""Number of instants, and arrays (`wide_codegen.COMMON`, and the sums of the likelihood)."""


@dataclass(frozen=True)
class WideLoop:
    """One loop: makes the matrices of the keys and their derivatives, and turns moments into blocks."""

    recursion: WideRecursion
    code: Code

    def __call__(self, kind: str, *arguments: Any) -> None:
        """The loop of this kind, with the arguments of `filter_codegen`."""
        count, _, theta, keys, times, _, key, _, _, _, u, y, reset, state, _, out, *own = arguments
        r = self.recursion
        numbers = r.numbers(dict(zip(r.p, theta, strict=False)), keys)
        if numbers is None:
            times[:] = -1
            return
        block = self._block(state)
        common = (
            count, numbers.nodes, keys, numbers.table, key, u, y, reset, block, aligned(workspace(r)), out,
        )  # fmt: skip
        getattr(self, "_" + kind)(numbers, common, *own)
        state[:] = self._packed(block)

    def _value(self, numbers: Numbers, common: Common) -> None:
        self.code("value", *common)

    def _trace(self, numbers: Numbers, common: Common, rows: np.ndarray) -> None:
        r, key = self.recursion, common[4]
        size, q, pairs = r.held * r.width, r.n + r.q, 2 * len(r.updates)
        found = np.empty((len(rows), 2 * size + pairs))
        self.code("trace", *common, found)
        rows[:, :q] = self._packed(found[:, :size])
        rows[:, q : q + pairs] = found[:, size : size + pairs]
        rows[:, q + pairs : 2 * q + pairs] = self._packed(found[:, size + pairs :])
        ends, w = 2 * q + pairs, r.width
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
        held = np.empty((count, len(r.updates) + 1, r.held * r.width))
        bars, known_bar = np.zeros_like(numbers.table), np.zeros(max(1, len(numbers.nodes)))
        first = np.array(common[8])
        self.code("adjoint", *common, first, held, bars, known_bar, bar)
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
        own = blocks.reshape(*blocks.shape[:-1], -1, w) if blocks.shape[-1] != w else blocks
        return np.concatenate([own[..., n, :n], pack(own[..., :n, :n])], axis=-1)


def wide_loop(recursion: WideRecursion, kind: str, gain: bool, source: str) -> WideLoop:
    """The compiled loop of a kind: value, trace, adjoint or tangent; `source` as in `Code`."""
    return WideLoop(recursion, Code(lambda: wide_text(recursion, kind, gain), [kind], source))
