"""One filter step of many runs of the same model side by side, for fleets that are filtered in step.

Every run has its own parameters, inputs, step, readings and state, held in arrays; one call of compiled code
(`hygrokf.engine.batch_codegen`) advances all runs by one step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from hygrokf.engine.batch_codegen import fleet_text, kept_nodes
from hygrokf.engine.jit import Code
from hygrokf.engine.llvm_writer import RUNS
from hygrokf.engine.packing import pack, place, unpack
from hygrokf.engine.schedule import TOLERANCE
from hygrokf.engine.schedule_codegen import CHANGE, DEEPEST, KINK, KNOWN, ROUNDING, VALUE
from hygrokf.engine.traced_filter import traced
from hygrokf.estimation.likelihood import Gaussian, RatesFault
from hygrokf.physics.holds import between
from hygrokf.physics.model import Model

TRIED = 3
"""Numbers of equal parts, each twice the one before, that are tried before an interval is halved."""


class SideBySide:
    """The states of N runs of one model as arrays; `step` advances all of them.

    `values` are N sets of parameter values, `states` N Gaussians; `tolerance` [1] is the largest error of a
    step, as in `Likelihood`: where rates vary, all runs take as many equal sub-steps as the worst of them
    needs. `mean` (N, n) and `covariance` (N, n, n) are the states after the last step.
    """

    def __init__(
        self,
        model: Model,
        values: Sequence[Mapping[str, float]],
        states: Sequence[Gaussian],
        tolerance: float = TOLERANCE,
    ) -> None:
        count = len(values)
        if count != len(states) or not count:
            raise ValueError(f"expected as many states as sets of values, found {len(states)} and {count}")
        recursion = traced(model)
        self.model = model
        self.varying = tuple(recursion.varying)
        self.regimes = tuple(recursion.regimes)
        self._tolerance, self._divided, self._uncertain = tolerance, 1, True
        self._exact, self._n = recursion.exact, recursion.n
        self._count = count
        given = list(recursion.constants)
        parameters = np.array([[*(v[p.name] for p in model.parameters), *given] for v in values], dtype=float)
        self._values = {p.name: parameters[:, i] for i, p in enumerate(model.parameters)}
        moments = np.array([np.concatenate([s.mean, pack(s.covariance)]) for s in states], dtype=float)
        self._theta, self._state = self._in_blocks(parameters), self._in_blocks(moments)
        blocks = len(self._state)
        runs = blocks * RUNS
        self._keys = np.full((1 + len(self.regimes), runs), np.nan)
        self._known = np.empty((blocks, max(1, len(kept_nodes(recursion))), RUNS))
        self._now = np.zeros((max(1, len(self.varying)), runs))
        self._unread = np.full((max(1, len(model.outputs)), runs), np.nan)
        self._equal_parts: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._diagonal = [self._n + place(i, i) for i in range(self._n)]
        self._row, self._column = np.tril_indices(self._n)
        self._code = Code(lambda: fleet_text(recursion), ["fleet"], f"fleet {recursion.structure}")

    def __len__(self) -> int:
        return self._count

    @property
    def mean(self) -> np.ndarray:
        return self._in_rows(self._state[:, : self._n])

    @property
    def covariance(self) -> np.ndarray:
        return unpack(self._in_rows(self._state[:, self._n :]), self._n)

    def settle(self, mean: np.ndarray) -> None:
        """Set every run's state to `mean` (N, n) with zero covariance, as at the start of each step of a
        simulation."""
        self._state = np.zeros_like(self._state)
        self._state[:, : self._n] = self._in_blocks(mean)

    def _in_blocks(self, rows: np.ndarray) -> np.ndarray:
        """(N, width) as (blocks, width, RUNS); the last run fills the unused lanes of the last block."""
        spare = -len(rows) % RUNS
        filled = np.concatenate([rows, np.repeat(rows[-1:], spare, axis=0)])
        return np.ascontiguousarray(filled.reshape(-1, RUNS, rows.shape[1]).swapaxes(1, 2))

    def _in_rows(self, blocks: np.ndarray) -> np.ndarray:
        return blocks.swapaxes(1, 2).reshape(-1, blocks.shape[1])[: self._count]

    def _fill(self, column: np.ndarray, values: np.ndarray | float) -> None:
        """Store one number for each run (N,) in a column; unused lanes repeat that of the last run."""
        column[: self._count] = values
        column[self._count :] = column[self._count - 1]

    def step(
        self,
        hours: np.ndarray | float,
        inputs: Mapping[str, np.ndarray],
        readings: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Advance by `hours` (N,) [h] to instants with `inputs` (N,), and apply `readings` (N,) there (NaN:
        none).

        Linear inputs start from the values of the previous step.  Raises ValueError for an input that is
        missing or not finite.
        """
        faults = [n for n in self.model.inputs if n not in inputs or not _finite(inputs[n])]
        if faults:
            raise ValueError(
                f"expected finite inputs for every run, found none or others of: {', '.join(faults)}"
            )
        unknown = sorted(set(readings or {}) - set(self.model.outputs))
        if unknown:
            raise ValueError(f"expected readings of {list(self.model.outputs)}, found {unknown}")
        before, y = self._now, self._unread
        self.begin(inputs)
        if readings:
            y = y.copy()
            for column, name in enumerate(self.model.outputs):
                self._fill(y[column], readings.get(name, np.nan))
        if self._exact:
            self._state = self._moved(self._state, hours, inputs, before, self._now, 1, y)
            return
        self._uncertain = bool(self._state[:, self._n :].any())
        self._state = self._through(self._state, np.asarray(hours, float), inputs, before, self._now, 0)
        if readings and not np.isnan(y).all():
            self._state = self._moved(self._state, 0.0, inputs, before, self._now, 1, y)

    def _through(
        self,
        begun: np.ndarray,
        hours: np.ndarray,
        inputs: Mapping[str, np.ndarray],
        before: np.ndarray,
        now: np.ndarray,
        depth: int,
    ) -> np.ndarray:
        """Moments (blocks, width, RUNS) after `hours` between two sets of inputs: in equal parts, or where
        these do not do, in two halves."""
        parts = 1 if depth else self._divided
        once = self._moved(begun, hours, inputs, before, now, parts)
        for _ in range(TRIED):
            twice = self._moved(begun, hours, inputs, before, now, 2 * parts)
            error = self._error(begun, once, twice)
            if error <= self._tolerance and depth < KINK and self._kinked(begun, twice, inputs):
                break
            if error <= self._tolerance:
                if not depth:
                    # half as many next time where their error, of at least fourth order, would do as well
                    self._divided = max(1, parts // 2 if error < self._tolerance / 32.0 else parts)
                return twice
            parts, once = 2 * parts, twice
        if depth > DEEPEST:
            raise RatesFault(
                f"expected rates that sub-steps of {float(np.max(hours)):.1g} h resolve, found an error of "
                f"{error:.1g} standard deviations: narrow the bounds of the parameters, or smooth what jumps"
            )
        middle = now.copy()
        for row, name in enumerate(self.varying):
            middle[row] = between(self.model.holds[name], before[row], now[row], 0.5)
        half = self._through(begun, 0.5 * hours, inputs, before, middle, depth + 1)
        return self._through(half, 0.5 * hours, inputs, middle, now, depth + 1)

    def _moved(
        self,
        begun: np.ndarray,
        hours: np.ndarray | float,
        inputs: Mapping[str, np.ndarray],
        before: np.ndarray,
        now: np.ndarray,
        parts: int,
        y: np.ndarray | None = None,
    ) -> np.ndarray:
        """Moments after `hours` in equal parts, and with the readings `y` if there are any."""
        state, keys = begun.copy(), np.empty_like(self._keys)
        self._fill(keys[0], np.asarray(hours) / parts)
        for row, name in enumerate(self.regimes):
            self._fill(keys[1 + row], inputs[name])
        # before the first step the keys are NaN, so that everything kept is computed then
        changed = np.any(self._keys != keys, axis=0)
        self._keys = keys
        if parts not in self._equal_parts:
            whole = np.full(keys.shape[1], float(parts))
            self._equal_parts[parts] = whole, _of_blocks(whole)
        self._code(
            "fleet", len(state), self._theta, keys, *self._equal_parts[parts], _of_blocks(changed),
            self._known, before, now, self._unread if y is None else y, state,
        )  # fmt: skip
        return state

    def _error(self, begun: np.ndarray, once: np.ndarray, twice: np.ndarray) -> float:
        """Largest error of a run, as of `schedule_codegen.Walk`; infinite where a moment is not finite."""
        n = self._n
        if not (np.isfinite(once).all() and np.isfinite(twice).all()):
            return math.inf
        mean, apart = twice[:, :n], abs(once - twice)
        size = abs(mean)
        sd = np.sqrt(np.maximum(twice[:, self._diagonal], 0.0)) + KNOWN
        scale = sd + CHANGE * abs(mean - begun[:, :n]) + VALUE * size
        return float(
            max(
                (np.maximum(apart[:, :n] - ROUNDING * size, 0.0) / scale).max(),
                (apart[:, n:] / (sd[:, self._row] * sd[:, self._column])).max(),
            )
        )

    def _kinked(self, begun: np.ndarray, ended: np.ndarray, inputs: Mapping[str, np.ndarray]) -> bool:
        """Whether a comparison of the rates changes its result, where a state is uncertain before the step; a
        mean alone feels a kink to second order only."""
        r, n = traced(self.model), traced(self.model).n
        if not r.comparisons or not self._uncertain:
            return False
        found = [
            r.graph.evaluate(r.comparisons, r.symbols(self._values, self._in_rows(part)[:, :n].T, inputs))
            for part in (begun, ended)
        ]
        return any(np.any(np.not_equal(a, b)) for a, b in zip(*found, strict=True))

    def begin(self, inputs: Mapping[str, np.ndarray]) -> None:
        """Set the inputs at the current instants, from which linear inputs start."""
        self._now = np.zeros_like(self._now)
        for row, name in enumerate(self.varying):
            self._fill(self._now[row], inputs[name])


def _finite(value: np.ndarray | float) -> bool:
    """Whether a number or an array is finite; most values are floats, for which numpy takes ten times as
    long."""
    return math.isfinite(value) if isinstance(value, float) else bool(np.all(np.isfinite(value)))


def _of_blocks(values: np.ndarray) -> np.ndarray:
    """The largest value of every block, from values (runs,)."""
    return np.maximum.reduce(values.reshape(-1, RUNS).T).astype(np.int32)
