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
from hygrokf.physics.model import Model


def gap_variances(model: Model, recursion: Recursion, t: Timeline) -> dict[int, np.ndarray]:
    """p₀ (n,) of each end of a gap, by the instant after it; parameters that it depends on have their start
    values."""
    start, found = {p.name: p.start for p in model.parameters}, {}
    for k in np.flatnonzero(t.ends).tolist():
        held = zip((*t.regimes, *t.varying), (*t.steps[t.key[k], 1:], *t.u[k]), strict=True)
        _, variance = model.initial(start, {name: float(value) for name, value in held})
        found[k] = np.where(recursion.driven, np.array(variance, dtype=float), 0.0)
    return found
