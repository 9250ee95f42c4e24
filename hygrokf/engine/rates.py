"""How fast a model is: an upper bound of the size of its eigenvalues, for any graph of its states.

The bound is the spectral radius of the largest sizes of the Jacobian's entries: no matrix whose entries are
of at most these sizes has a larger one (Horn & Johnson 2013, Matrix Analysis, theorem 8.1.18).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from hygrokf.engine.traced_filter import Place, Recursion


def sizes(
    recursion: Recursion, values: Mapping[str, float], corners: Mapping[str, np.ndarray]
) -> dict[Place, float]:
    """Largest sizes [1/h] of the entries of the Jacobian on which its eigenvalues depend, at the model's
    initial state, over the inputs `corners` (C,).  Raises KeyError for a parameter without a value."""
    known = recursion.symbols(values)
    if recursion.rates_move:
        mean, _ = recursion.model.initial(values, corners)
        known = recursion.symbols(values, map(np.asarray, mean), corners)
    places = recursion.rate_entries
    try:
        found = recursion.graph.evaluate([recursion.jacobian[i][j] for i, j in places], known)
    except ZeroDivisionError:  # a parameter at a physical limit, such as a resistance of 0
        found = [math.inf] * len(places)
    return {place: float(np.max(np.abs(value))) for place, value in zip(places, found, strict=True)}


def rate_bound(recursion: Recursion, sizes: Mapping[Place, float]) -> float:
    """Upper bound [1/h] of the size of the eigenvalues, from those of the entries; infinite where one is not
    finite."""
    if all(i == j for i, j in sizes):  # no cycle of states, as in most cabinets
        return max(sizes.values(), default=0.0)
    matrix = np.zeros((recursion.n, recursion.n))
    for place, size in sizes.items():
        matrix[place] = size
    return float(np.abs(np.linalg.eigvals(matrix)).max()) if np.isfinite(matrix).all() else math.inf
