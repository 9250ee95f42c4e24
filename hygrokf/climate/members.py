"""Members of an ensemble: models that the fit's data could as well have come from.

Each member has parameters of its own, drawn from the normal distribution of the estimates in the coordinates of the
estimation (logarithms of positive parameters), cut at the parameters' bounds.
"""

from __future__ import annotations

import numpy as np

from hygrokf.fit import Fit


def draw_members(fit: Fit, count: int, seed: int) -> list[dict[str, float]]:
    """`count` sets of parameter values of a fit's model; the same seed gives the same ones, whatever the count.

    Parameters without covariance (on a bound, or held) keep the fit's value.  The biases of the loggers are drawn with
    the others: what the fit does not know of them it does not know of the heat release either.
    """
    names, matrix = fit.covariance
    by_name = {p.name: p for p in fit.design.model.parameters}
    chosen = [by_name[name] for name in names]
    values = np.array([fit.values[p.name] for p in chosen])
    slopes = np.array([p.slope(v) for p, v in zip(chosen, values, strict=True)])
    centre = np.array([p.to_coordinate(v) for p, v in zip(chosen, values, strict=True)])
    factor = _factor(matrix / np.outer(slopes, slopes)) if len(chosen) else np.zeros((0, 0))
    rows = np.random.default_rng([seed, 1]).standard_normal((count, len(chosen)))
    members = []
    for row in rows:
        drawn = centre + factor @ row
        own = {p.name: _within(p, float(z)) for p, z in zip(chosen, drawn, strict=True)}
        members.append({**fit.values, **own})
    return members


def _within(p, z: float) -> float:
    lower, upper = p.to_coordinate(p.lower), p.to_coordinate(p.upper)
    return min(max(p.from_coordinate(min(max(z, lower), upper)), p.lower), p.upper)


def _factor(covariance: np.ndarray) -> np.ndarray:
    """A matrix B with B B' the covariance, which may be singular."""
    symmetric = 0.5 * (covariance + covariance.T)
    scale = np.sqrt(np.maximum(np.diag(symmetric), 0.0))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(symmetric / np.outer(scale, scale))
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
