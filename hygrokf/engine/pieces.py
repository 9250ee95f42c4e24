"""The pieces of a run that the compiled loops take in one call, and what comes between: long steps and gaps.

In a gap too long to bridge the inputs hold their last values, and no reading is used.  The true inputs may
have been any, so every state that follows an input, at once or through other states, is as uncertain at the
end of the gap as at a record's first instant:

    P ← P + diag(p₀),    p₀ the initial variance of these states, 0 of the others.

The filter's own covariance says from then on how much a reading tells, and how soon the gap is forgotten.
Disturbances, sensors' errors and random walks keep what is known of them.  Shapes: T instants, n states.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hygrokf.engine.long_steps import LongStep
from hygrokf.engine.timeline import Timeline
from hygrokf.engine.traced_filter import Recursion
from hygrokf.physics.expression import is_zero
from hygrokf.physics.holds import inputs_between
from hygrokf.physics.model import Model


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


def gap_variances(model: Model, recursion: Recursion, t: Timeline) -> dict[int, np.ndarray]:
    """p₀ (n,) of each end of a gap, by the instant after it; parameters that it depends on have their start
    values."""
    start, found = {p.name: p.start for p in model.parameters}, {}
    driven = _driven(recursion) if t.ends.any() else np.empty(0)
    for k in np.flatnonzero(t.ends).tolist():
        held = zip((*t.regimes, *t.varying), (*t.steps[t.key[k], 1:], *t.u[k]), strict=True)
        _, variance = model.initial(start, {name: float(value) for name, value in held})
        found[k] = np.where(driven, np.array(variance, dtype=float), 0.0)
    return found


def _driven(recursion: Recursion) -> np.ndarray:
    """(n,) True for states that follow an input, by themselves or through other states."""
    graph, n = recursion.graph, recursion.n
    inputs = {i for i, node in enumerate(graph.nodes) if node[0] == "symbol" and node[1][:2] in ("b:", "g:")}
    driven = np.array([not inputs.isdisjoint(graph.needed([rate])) for rate in recursion.rates])
    acts = np.array([[not is_zero(entry) for entry in row] for row in recursion.jacobian]).reshape(n, n)
    for _ in range(n):
        driven = driven | (acts @ driven)
    return driven


def long_step(model: Model, recursion: Recursion, t: Timeline, steps: SubSteps, k: int) -> LongStep:
    """The long step to instant k."""
    hours, *held = t.steps[t.key[k]].tolist()
    before, after = (
        dict(zip((*t.regimes, *t.varying), (*held, *t.u[row].tolist()), strict=True)) for row in (k, k + 1)
    )
    tail = inputs_between(model.holds, before, after, 1.0 - steps.tail_h / hours)
    return LongStep(recursion, before, tail, hours - steps.tail_h, steps.tail_h)
