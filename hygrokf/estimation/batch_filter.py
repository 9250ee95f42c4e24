"""One step of many simulations of the same model side by side, for ensembles.

Every run has its own parameters, inputs, step and state, held in arrays; one call of compiled code
(`hygrokf.engine.batch_codegen`) advances all runs by one step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from hygrokf.engine.batch_codegen import fleet_text, kept_nodes
from hygrokf.engine.jit import CompiledCode
from hygrokf.engine.llvm_writer import RUNS
from hygrokf.engine.packing import place, unpack
from hygrokf.engine.schedule import STEP_TOLERANCE
from hygrokf.engine.schedule_codegen import CHANGE, LEAST_SD, MEAN_ROUNDING, MOST_HALVINGS, VALUE
from hygrokf.engine.traced_filter import traced
from hygrokf.estimation.rates_fault import RatesFault
from hygrokf.physics.holds import between
from hygrokf.physics.model import Model

TRIALS = 3
"""How often the number of equal parts is doubled before an interval is halved."""


class SideBySide:
    """N runs of one model; `step` advances all of them.

    `values` are N sets of parameter values; `tolerance` [1] is the largest error of a step, as in
    `Likelihood`: where rates vary, all runs take as many equal sub-steps as the worst of them needs.
    """

    def __init__(
        self, model: Model, values: Sequence[Mapping[str, float]], tolerance: float = STEP_TOLERANCE
    ) -> None:
        self.model, self._recursion = model, traced(model)
        self._tolerance, self._usual_parts, self._count = tolerance, 1, len(values)
        given = list(self._recursion.constants)
        parameters = np.array([[*(v[p.name] for p in model.parameters), *given] for v in values], dtype=float)
        self._theta = self._in_blocks(parameters)
        blocks = len(self._theta)
        runs = blocks * RUNS
        self._keys = np.empty((1 + len(self._recursion.regimes), runs))
        # NaN differs from every key, so that the first step computes all kept values
        self._kept_keys = np.full_like(self._keys, np.nan)
        n = self._recursion.n
        self._pairs = np.tril_indices(n)
        self._variances = [n + place(i, i) for i in range(n)]
        self._parts = np.ones(runs)
        self._kept_values = np.empty((blocks, max(1, len(kept_nodes(self._recursion))), RUNS))
        self._inputs = np.zeros((max(1, len(self._recursion.varying)), runs))
        self._code = CompiledCode(
            lambda: fleet_text(self._recursion), ["fleet"], f"fleet {self._recursion.structure}"
        )

    def _in_blocks(self, rows: np.ndarray) -> np.ndarray:
        """(N, width) as (blocks, width, RUNS); the last run fills the unused lanes of the last block."""
        spare = -len(rows) % RUNS
        filled = np.concatenate([rows, np.repeat(rows[-1:], spare, axis=0)])
        return np.ascontiguousarray(filled.reshape(-1, RUNS, rows.shape[1]).swapaxes(1, 2))

    def _in_rows(self, blocks: np.ndarray) -> np.ndarray:
        return blocks.swapaxes(1, 2).reshape(-1, blocks.shape[1])[: self._count]

    def _fill(self, column: np.ndarray, values: np.ndarray | float) -> None:
        """Store one number for each run (N,) in a column; unused lanes repeat the number of the last run."""
        column[: self._count] = values
        column[self._count :] = column[self._count - 1]

    def begin(self, inputs: Mapping[str, np.ndarray]) -> None:
        """Set the inputs at the current instants, from which linear inputs start."""
        self._inputs = np.zeros_like(self._inputs)
        for row, name in enumerate(self._recursion.varying):
            self._fill(self._inputs[row], inputs[name])

    def step(
        self, mean: np.ndarray, hours: np.ndarray | float, inputs: Mapping[str, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """States (N, n) after `hours` (N,) [h] from `mean` (N, n), at instants with `inputs` (N,), and the
        covariances (N, n, n) that the noise gave them on the way.

        Linear inputs start from the values of the previous step.  Raises ValueError for an input that is
        missing or not finite, and RatesFault where no sub-step resolves the rates.
        """
        faults = [n for n in self.model.inputs if n not in inputs or not _finite(inputs[n])]
        if faults:
            raise ValueError(
                f"expected finite inputs for every run, found missing or infinite ones: {', '.join(faults)}"
            )
        before = self._inputs
        self.begin(inputs)
        for row, name in enumerate(self._recursion.regimes):
            self._fill(self._keys[1 + row], inputs[name])
        n, q = self._recursion.n, self._recursion.q
        start = self._in_blocks(np.concatenate([mean, np.zeros((self._count, q))], axis=1))
        if self._recursion.exact:
            end = self._in_equal_parts(start, hours, before, self._inputs, 1)
        else:
            end = self._advance(start, np.asarray(hours, float), before, self._inputs, 0)
        rows = self._in_rows(end)
        return rows[:, :n], unpack(rows[:, n:], n)

    def _advance(
        self, start: np.ndarray, hours: np.ndarray, before: np.ndarray, now: np.ndarray, depth: int
    ) -> np.ndarray:
        """Moments (blocks, width, RUNS) after `hours` between two sets of inputs: in equal parts, or in two
        halves where equal parts are not exact enough."""
        parts = 1 if depth else self._usual_parts
        once = self._in_equal_parts(start, hours, before, now, parts)
        for _ in range(TRIALS):
            twice = self._in_equal_parts(start, hours, before, now, 2 * parts)
            error = self._error(start, once, twice)
            if error <= self._tolerance:
                if not depth:
                    # half as many parts next time, if their error, of at least fourth order, stays small
                    # enough
                    self._usual_parts = max(1, parts // 2 if error < self._tolerance / 32.0 else parts)
                return twice
            parts, once = 2 * parts, twice
        if depth > MOST_HALVINGS:
            raise RatesFault(
                f"expected rates that sub-steps of {float(np.max(hours)):.1g} h resolve, found an error of "
                f"{error:.1g} standard deviations: narrow the bounds of the parameters, or smooth what jumps"
            )
        middle = now.copy()
        for row, name in enumerate(self._recursion.varying):
            middle[row] = between(self.model.holds[name], before[row], now[row], 0.5)
        half = self._advance(start, 0.5 * hours, before, middle, depth + 1)
        return self._advance(half, 0.5 * hours, middle, now, depth + 1)

    def _in_equal_parts(
        self,
        start: np.ndarray,
        hours: np.ndarray | float,
        before: np.ndarray,
        now: np.ndarray,
        parts: int,
    ) -> np.ndarray:
        """Moments after `hours` in equal parts."""
        self._fill(self._parts, float(parts))
        self._fill(self._keys[0], np.asarray(hours) / parts)
        changed, state = np.any(self._keys != self._kept_keys, axis=0), start.copy()
        self._kept_keys[:] = self._keys
        self._code(
            "fleet", len(state), self._theta, self._keys, self._parts, _largest_of_blocks(self._parts),
            _largest_of_blocks(changed), self._kept_values, before, now, state,
        )  # fmt: skip
        return state

    def _error(self, start: np.ndarray, once: np.ndarray, twice: np.ndarray) -> float:
        """Largest error of all runs, defined as in `schedule_codegen.Walk`; infinite where a moment is not
        finite."""
        n = self._recursion.n
        if not (np.isfinite(once).all() and np.isfinite(twice).all()):
            return math.inf
        mean, difference = twice[:, :n], abs(once - twice)
        size, (row, column) = abs(mean), self._pairs
        sd = np.sqrt(np.maximum(twice[:, self._variances], 0.0)) + LEAST_SD
        scale = sd + CHANGE * abs(mean - start[:, :n]) + VALUE * size
        return float(
            max(
                (np.maximum(difference[:, :n] - MEAN_ROUNDING * size, 0.0) / scale).max(),
                (difference[:, n:] / (sd[:, row] * sd[:, column])).max(),
            )
        )


def _finite(value: np.ndarray | float) -> bool:
    """Whether a number or all of an array is finite; for floats numpy would take ten times as long."""
    return math.isfinite(value) if isinstance(value, float) else bool(np.all(np.isfinite(value)))


def _largest_of_blocks(values: np.ndarray) -> np.ndarray:
    """The largest value of every block, from values (runs,)."""
    return np.maximum.reduce(values.reshape(-1, RUNS).T).astype(np.int32)
