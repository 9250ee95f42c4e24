"""Members of an ensemble: models that are as plausible as the fit, given its data.

Each member has its own parameters, drawn from the normal distribution of the estimates in the coordinates of
the estimation (logarithms of positive parameters) and cut at the parameters' bounds.  A positive parameter
whose logarithm is uncertain by more than `LOG_MOST` cannot be distinguished from zero, usually a noise: a
normal distribution of its logarithm would reach values a hundred times as large, which the data exclude.  It
is drawn in its own units.
"""

from __future__ import annotations

import numpy as np

from hygrokf.identification.fit import Fit
from hygrokf.physics.parameters import Parameter

LOG_MOST = 0.5
"""Standard error of a logarithm [1] up to which the logarithm is drawn from a normal distribution."""


def draw_members(fit: Fit, count: int, seed: int) -> list[dict[str, float]]:
    """`count` sets of parameter values of a fit's model; a seed gives the same sets for every count.

    Parameters without covariance (on a bound, or fixed) keep the fit's value.  The biases of the loggers are
    drawn with the others, because their uncertainty also makes the heat release uncertain.
    """
    names, matrix = fit.covariance
    by_name = {p.name: p for p in fit.design.model.parameters}
    chosen = [by_name[name] for name in names]
    values = np.array([fit.values[p.name] for p in chosen])
    slopes = np.array([p.slope(v) for p, v in zip(chosen, values, strict=True)])
    centre = np.array([p.to_coordinate(v) for p, v in zip(chosen, values, strict=True)])
    factor = _factor(matrix / np.outer(slopes, slopes)) if len(chosen) else np.zeros((0, 0))
    spread = np.sqrt((factor**2).sum(axis=1))
    rows = np.random.default_rng([seed, 1]).standard_normal((count, len(chosen)))
    members = []
    for row in rows:
        moves = factor @ row
        own = {
            p.name: _moved(p, float(z), float(move), float(s))
            for p, z, move, s in zip(chosen, centre, moves, spread, strict=True)
        }
        members.append({**fit.values, **own})
    return members


def _moved(p: Parameter, z: float, move: float, sd: float) -> float:
    """The parameter's value moved from z along its coordinate, or in its own units; within its bounds."""
    if p.positive and sd > LOG_MOST:
        value = p.from_coordinate(z) * (1.0 + move)
    else:
        # within the bounds before the exponential: a wild one has no number
        value = p.from_coordinate(min(max(z + move, p.to_coordinate(p.lower)), p.to_coordinate(p.upper)))
    return min(max(value, p.lower), p.upper)


def _factor(covariance: np.ndarray) -> np.ndarray:
    """A matrix B with B B' the covariance, which may be singular."""
    symmetric = 0.5 * (covariance + covariance.T)
    scale = np.sqrt(np.maximum(np.diag(symmetric), 0.0))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(symmetric / np.outer(scale, scale))
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
