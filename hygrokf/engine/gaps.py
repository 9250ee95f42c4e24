"""The ends of gaps in the inputs of a run.

In a gap too long to bridge the inputs hold their last values, and no reading is used.  The true inputs may
have been any, so every state that follows an input, at once or through other states, is as uncertain at the
end of the gap as at a record's first instant:

    P ← P + diag(p₀),    p₀ the initial variance of these states, 0 of the others.

The filter's own covariance says from then on how much a reading tells, and how soon the gap is forgotten.
Disturbances, sensors' errors and random walks keep what is known of them.

Shapes: T instants, n states.
"""

from __future__ import annotations

import numpy as np

from hygrokf.engine.timeline import Timeline
from hygrokf.engine.traced_filter import Recursion
from hygrokf.physics.expression import is_zero
from hygrokf.physics.model import Model


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
