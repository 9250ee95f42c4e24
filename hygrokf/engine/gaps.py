"""The ends of gaps in the inputs of a run.

In a gap too long to bridge the inputs hold their last values, and no reading is used.  The true inputs are
unknown, so every state that follows an input, directly or through other states, is as uncertain at the end
of the gap as at a record's first instant:

    P ← P + diag(p₀),    p₀ the initial variance of these states, 0 for the others.

From then on the filter's covariance determines the weight of each reading.  Disturbances, sensors' errors
and random walks keep their moments.

Shapes: T instants, n states, w packed moments.
"""

from __future__ import annotations

import numpy as np

from hygrokf.engine.packing import unpack
from hygrokf.engine.timeline import Timeline
from hygrokf.engine.traced_filter import Recursion
from hygrokf.physics.model import Model


def gap_variances(model: Model, recursion: Recursion, t: Timeline) -> dict[int, np.ndarray]:
    """p₀ (n,) by the instant at which a gap ends, from the parameters' start values."""
    start, variances = {p.name: p.start for p in model.parameters}, {}
    for k in np.flatnonzero(t.ends).tolist():
        held = zip((*t.regimes, *t.varying), (*t.steps[t.key[k], 1:], *t.u[k]), strict=True)
        _, variance = model.initial(start, {name: float(value) for name, value in held})
        variances[k] = np.where(recursion.driven, np.array(variance, dtype=float), 0.0)
    return variances


def widened(recursion: Recursion, state: np.ndarray, added: np.ndarray) -> np.ndarray:
    """Packed moments (w,) with the variances `added` (n,)."""
    covariance = recursion.covariance_of(state) + np.diag(added)
    moments = recursion.packed_moments(state[: recursion.n], covariance)
    moments[recursion.loaded :] = state[recursion.loaded :]
    return moments


def widened_slopes(recursion: Recursion, state: np.ndarray, added: np.ndarray) -> np.ndarray:
    """Derivatives (w, w) of `widened`; row i is by entry i of `state`."""
    eye = np.eye(len(state))
    if not recursion.factored:
        return eye
    n, q = recursion.n, recursion.q
    lower, diagonal = recursion.lower_of(state), np.diag(unpack(state[n : n + q], n))
    lower_slopes = recursion.lower_of(eye) - recursion.lower_of(np.zeros(len(state)))
    diagonal_slopes = np.einsum("rii->ri", unpack(eye[:, n : n + q], n))
    half = lower_slopes @ (lower * diagonal).T
    covariance_slopes = half + np.swapaxes(half, 1, 2) + (lower * diagonal_slopes[:, None, :]) @ lower.T
    covariance = recursion.covariance_of(state) + np.diag(added)
    slopes = recursion.packed_slopes(eye[:, :n], covariance, covariance_slopes)
    slopes[:, recursion.loaded :] = eye[:, recursion.loaded :]
    return slopes
