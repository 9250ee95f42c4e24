"""One filter step of many runs of the same model side by side, for fleets that are filtered in step.

Every run has its own parameters, inputs, step, readings and state, held in arrays; one call of compiled code
(`hygrokf.engine.batch_codegen`) advances all runs by one step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from hygrokf.engine.batch_codegen import fleet_text, kept_nodes
from hygrokf.engine.discretisation import RATE_STEP, doublings
from hygrokf.engine.jit import Code
from hygrokf.engine.llvm_writer import RUNS
from hygrokf.engine.long_steps import MOST, TAIL, jump
from hygrokf.engine.packing import pack, unpack
from hygrokf.engine.traced_filter import traced
from hygrokf.estimation.likelihood import Gaussian
from hygrokf.physics.holds import inputs_between
from hygrokf.physics.model import Model


class SideBySide:
    """The states of N runs of one model as arrays; `step` advances all of them.

    `values` are N sets of parameter values, `states` N Gaussians, `fastest` (N,) [1/h] the rates that
    determine the sub-steps (see `Likelihood.rate`).  `mean` (N, n) and `covariance` (N, n, n) are the states
    after the last step.
    """

    def __init__(
        self,
        model: Model,
        values: Sequence[Mapping[str, float]],
        states: Sequence[Gaussian],
        fastest: np.ndarray | Sequence[float],
    ) -> None:
        count = len(values)
        if not (count == len(states) == len(np.atleast_1d(fastest))) or not count:
            raise ValueError(
                f"expected as many states and rates as sets of values, found {len(states)}, "
                f"{len(np.atleast_1d(fastest))} and {count}"
            )
        recursion = traced(model)
        self.model = model
        self.varying = tuple(recursion.varying)
        self.regimes = tuple(recursion.regimes)
        self._fastest = np.asarray(fastest, dtype=float)
        self._exact = recursion.exact
        self._count = count
        given = list(recursion.constants)
        parameters = np.array([[*(v[p.name] for p in model.parameters), *given] for v in values], dtype=float)
        self._values = {p.name: parameters[:, i] for i, p in enumerate(model.parameters)}
        moments = np.array([np.concatenate([s.mean, pack(s.covariance)]) for s in states], dtype=float)
        self._theta, self._state = self._in_blocks(parameters), self._in_blocks(moments)
        blocks = len(self._state)
        runs = blocks * RUNS
        self._keys = np.full((1 + len(self.regimes), runs), np.nan)
        self._parts = np.ones(runs)
        self._known = np.empty((blocks, max(1, len(kept_nodes(recursion))), RUNS))
        self._before, self._now = (np.zeros((max(1, len(self.varying)), runs)) for _ in range(2))
        self._y = np.full((max(1, len(model.outputs)), runs), np.nan)
        self._code = Code(lambda: fleet_text(recursion), ["fleet"], f"fleet {recursion.structure}")

    def __len__(self) -> int:
        return self._count

    @property
    def mean(self) -> np.ndarray:
        return self._in_rows(self._state)[:, : traced(self.model).n]

    @property
    def covariance(self) -> np.ndarray:
        return unpack(self._in_rows(self._state)[:, traced(self.model).n :], traced(self.model).n)

    def settle(self, mean: np.ndarray) -> None:
        """Set every run's state to `mean` (N, n) with zero covariance, as at the start of each step of a
        simulation."""
        rows = np.zeros((self._count, self._state.shape[1]))
        rows[:, : mean.shape[1]] = mean
        self._state[...] = self._in_blocks(rows)

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
        self._before, self._now = self._now, self._before
        self.begin(inputs)
        for place, name in enumerate(self.model.outputs):
            self._fill(self._y[place], (readings or {}).get(name, np.nan))
        keys = self._keys.copy()
        reach = np.multiply(hours, self._fastest)
        if self._exact:
            self._fill(self._parts, doublings(reach))
            self._fill(self._keys[0], hours)
        else:
            parts = np.maximum(np.ceil(reach / RATE_STEP - 1e-9), 1.0)
            if (far := parts > MOST).any():
                hours = np.array(np.broadcast_to(hours, self._count), dtype=float)
                hours[far], parts[far] = self._jump(far, hours[far], inputs), TAIL
            self._fill(self._parts, parts)
            self._fill(self._keys[0], hours / parts)
        for place, name in enumerate(self.regimes):
            self._fill(self._keys[1 + place], inputs[name])
        # before the first step the keys are NaN, so that everything kept is computed then
        changed = np.any(self._keys != keys, axis=0)
        self._code(
            "fleet", len(self._state), self._theta, self._keys, self._parts, _of_blocks(self._parts),
            _of_blocks(changed),
            self._known, self._before, self._now, self._y, self._state,
        )  # fmt: skip

    def _jump(
        self, far: np.ndarray, hours: np.ndarray, inputs: Mapping[str, np.ndarray | float]
    ) -> np.ndarray:
        """Move the runs `far` (N,) to the tails of their long steps of `hours` [h]; returns the remaining
        time [h] of each."""
        rest_h = TAIL * RATE_STEP / self._fastest[far]
        now = {name: np.broadcast_to(inputs[name], self._count)[far] for name in self.model.inputs}
        before = {
            name: row[: self._count][far] for name, row in zip(self.varying, self._before, strict=False)
        }
        tail = inputs_between(self.model.holds, before, now, 1.0 - rest_h / hours)
        rows, n = self._in_rows(self._state).copy(), traced(self.model).n
        mean, (covariance,), _ = jump(
            traced(self.model),
            {name: column[far] for name, column in self._values.items()},
            before,
            tail,
            hours - rest_h,
            rest_h,
            rows[far, :n],
            [unpack(rows[far, n:], n)],
        )
        rows[far] = np.concatenate([mean, pack(covariance)], axis=1)
        self._state[...] = self._in_blocks(rows)
        for name, row in zip(self.varying, self._before, strict=False):
            at = row[: self._count].copy()
            at[far] = tail[name]
            self._fill(row, at)
        return rest_h

    def begin(self, inputs: Mapping[str, np.ndarray]) -> None:
        """Set the inputs at the current instants, from which linear inputs start."""
        for place, name in enumerate(self.varying):
            self._fill(self._now[place], inputs[name])


def _finite(value: np.ndarray | float) -> bool:
    """Whether a number or an array is finite; most values are floats, for which numpy takes ten times as
    long."""
    return math.isfinite(value) if isinstance(value, float) else bool(np.all(np.isfinite(value)))


def _of_blocks(values: np.ndarray) -> np.ndarray:
    """The largest value of every block, from values (runs,)."""
    return np.maximum.reduce(values.reshape(-1, RUNS).T).astype(np.int32)
