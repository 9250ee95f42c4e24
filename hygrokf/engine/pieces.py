"""The pieces of a run that the compiled loops take in one call, and what comes between: long steps and gaps.

At the end of a gap of the inputs, the states that follow the inputs are unknown.

In a gap too long to bridge the inputs hold their last values, and no reading is used.  The true inputs may
have been any, so every state that follows an input (one whose first value depends on the inputs) is then as
uncertain about its course as it is at a record's first instant: at the end of the gap

    P ← P + diag(p₀),    p₀ the initial variance of these states, 0 of the others.

The filter's own covariance says from then on how much a reading tells, and how soon the gap is forgotten.
Disturbances, sensors' errors and random walks keep what is known of them.  Shapes: n states, d parameters, r
directions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hygrokf.engine.long_steps import LongStep, inputs_between
from hygrokf.engine.timeline import Timeline
from hygrokf.engine.traced_filter import Recursion
from hygrokf.physics.model import Model, Values


@dataclass(frozen=True)
class SubSteps:
    """Sub-steps: `keys` (distinct steps, 1 + regimes) with their length [h], `parts` their number; `ends` the
    instants after the ends of gaps; `long` the instants that a long step leads to, of which the loops take
    the last `tail_h` [h]."""

    keys: np.ndarray
    parts: np.ndarray
    ends: tuple[int, ...]
    long: tuple[int, ...] = ()
    tail_h: float = 0.0

    def pieces(self, part: slice) -> list[slice]:
        """Stretches of instants that the loops take in one call; every long step and every end of a gap
        begins a new one."""
        inner = {k for k in (*self.long, *self.ends) if part.start < k < part.stop}
        return [slice(a, b) for a, b in pairwise([part.start, *sorted(inner), part.stop])]


@dataclass(frozen=True)
class GapEnd:
    """The end of a gap of the inputs, with the `inputs` there.

    States are packed moments (width,), in the layout of the compiled loops.
    """

    model: Model
    inputs: Mapping[str, float]

    def take(self, values: Mapping[str, float], state: np.ndarray) -> None:
        """Widen the covariance of a state, in place."""
        state[self._places] += self.variances(values)

    def tangents(
        self, values: Mapping[str, float], state: np.ndarray, dots: np.ndarray, seeds: np.ndarray
    ) -> np.ndarray:
        """Tangents (width, r) after the gap from those before it and the directions (d, r)."""
        result = dots.copy()
        result[self._places] += self._slopes(values) @ seeds
        return result

    def adjoints(
        self, values: Mapping[str, float], state: np.ndarray, bar: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Adjoints (width,) of the state before and (d,) of the parameters, from the adjoints after it."""
        return bar, bar[self._places] @ self._slopes(values)

    @property
    def _places(self) -> np.ndarray:
        """The diagonal of the covariance in the packed moments (n,)."""
        n = len(self.model.states)
        return n - 1 + np.cumsum(np.arange(1, n + 1))

    def variances(self, values: Values) -> np.ndarray:
        """The variances p₀ (n,); complex values give complex ones."""
        moved = {name: value + 1e-30j for name, value in self.inputs.items()}
        mean, _ = self.model.initial({name: np.real(v) for name, v in values.items()}, moved)
        _, variance = self.model.initial(values, self.inputs)
        return np.where(np.imag(np.array(mean, dtype=complex)) != 0.0, np.array(variance), 0.0)

    def _slopes(self, values: Mapping[str, float]) -> np.ndarray:
        """Derivatives (n, d) of the variances, by complex steps."""
        names = [p.name for p in self.model.parameters]
        return np.stack(
            [np.imag(self.variances({**values, name: values[name] + 1e-30j})) * 1e30 for name in names],
            axis=1,
        )


def crossed(
    model: Model, recursion: Recursion, t: Timeline, steps: SubSteps, k: int
) -> list[GapEnd | LongStep]:
    """What comes in front of the loops at instant k: the end of a gap, then the jump of a long step."""
    found: list[GapEnd | LongStep] = []
    if k in steps.ends:
        held = zip((*t.regimes, *t.varying), (*t.steps[t.key[k], 1:], *t.u[k]), strict=True)
        found.append(GapEnd(model, {name: float(value) for name, value in held}))
    return [*found, long_step(model, recursion, t, steps, k)] if k in steps.long else found


def long_step(model: Model, recursion: Recursion, t: Timeline, steps: SubSteps, k: int) -> LongStep:
    """The long step to instant k."""
    hours, *held = t.steps[t.key[k]].tolist()
    before, after = (
        dict(zip((*t.regimes, *t.varying), (*held, *t.u[row].tolist()), strict=True)) for row in (k, k + 1)
    )
    tail = inputs_between(model.holds, before, after, 1.0 - steps.tail_h / hours)
    return LongStep(recursion, before, tail, hours - steps.tail_h, steps.tail_h)
