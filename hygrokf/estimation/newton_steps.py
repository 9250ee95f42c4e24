"""Steps of a bounded Newton climb: the coordinates' units, the step within a box, the curvature by secants.

Shapes: d free coordinates z (see `parameters`).
"""

from __future__ import annotations

import numpy as np

from hygrokf.physics.parameters import Coordinates

STEP_SHARE = 1.0 / 30.0
"""[1] share of a search range that counts as much as a step of 1 in a logarithm."""
LEAST_BOX = 1.5
"""Least half width of the box of one step, in the coordinates' natural units."""


def secant_update(curvature: np.ndarray, s: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The curvature (d, d) corrected by a step s (d,) that changed the score by −y (Broyden, Fletcher,
    Goldfarb and Shanno); unchanged where the step met no positive curvature."""
    along = curvature @ s
    if not (float(s @ y) > 0.0 and float(s @ along) > 0.0):
        return curvature
    return curvature - np.outer(along, along) / float(s @ along) + np.outer(y, y) / float(s @ y)


def natural_units(coordinates: Coordinates) -> np.ndarray:
    """Units (d,) in which steps of the coordinates compare: 1 of a logarithm, else a share of the search
    range's width, so that nothing depends on the parameters' units."""
    return np.array([1.0 if p.positive else STEP_SHARE * (p.upper - p.lower) for p in coordinates.free])


def reach_of(coordinates: Coordinates, z: np.ndarray) -> np.ndarray:
    """Half widths (d,) of the trust box of one step from z; wider far from the parameters' starts."""
    return np.maximum(LEAST_BOX * natural_units(coordinates), 0.5 * np.abs(z - coordinates.start()))


def bounded_step(
    information: np.ndarray,
    gradient: np.ndarray,
    free: np.ndarray,
    z: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    damping: float,
    reach: np.ndarray,
) -> tuple[np.ndarray, float]:
    """The damped step within the bounds and a trust box of half width `reach` (d,), and the gain that the
    quadratic model promises for it.

    The step is the most promising of three: the full step with coordinates that would leave the box set to
    its edge and the other coordinates solved again; the full step shortened; the steepest ascent.  Shortening
    alone would let a flat direction, whose full step is unbounded, shrink the steps of all other coordinates
    to nothing and so simulate convergence.
    """
    low, high = np.maximum(lower - z, -reach), np.minimum(upper - z, reach)
    held, moving = np.zeros_like(z), free.copy()
    shortened = np.zeros_like(z)
    while moving.any():
        rest = gradient - information @ np.where(moving, 0.0, held)
        held[moving] = damped_step(information[np.ix_(moving, moving)], rest[moving], damping, reach[moving])
        if moving.sum() == free.sum():
            shortened = np.clip(held / max(1.0, float(np.max(np.abs(held) / reach))), lower - z, upper - z)
        beyond = moving & ((held < low) | (held > high))
        if not beyond.any():
            break
        held[beyond] = np.clip(held[beyond], low[beyond], high[beyond])
        moving &= ~beyond

    candidates = []
    diagonal = np.maximum(np.diag(information), 1e-300)
    steepest = np.where(free, gradient / (diagonal * (1.0 + damping)), 0.0)
    for direction in (held, shortened, np.clip(steepest, low, high)):
        # the box is convex, so any share of the way stays in it; the best share promises no loss
        slope, curvature = float(gradient @ direction), float(direction @ information @ direction)
        share = min(max(slope / max(curvature, 1e-300), 0.0), 1.0)
        candidates.append((share * slope - 0.5 * share**2 * curvature, share * direction))
    promised, step = max(candidates, key=lambda pair: pair[0])
    return step, promised


def damped_step(
    information: np.ndarray, gradient: np.ndarray, damping: float, unit: np.ndarray
) -> np.ndarray:
    """Solve (M + λ diag M) δ = g for the step δ, with the information M, the damping λ and the score g.

    Each coordinate's information, in its `unit`, counts as at least 1e-12 of the largest coordinate's.
    """
    curvatures = np.diag(information)
    diagonal = np.maximum(
        curvatures, 1e-12 * max(float(np.max(curvatures * unit**2, initial=0.0)), 1e-300) / unit**2
    )
    root = 1.0 / np.sqrt(diagonal)
    scaled = information * root[:, None] * root[None, :] + damping * np.eye(len(gradient))
    try:
        return root * np.linalg.solve(scaled, root * gradient)
    except np.linalg.LinAlgError:
        return root * np.linalg.lstsq(scaled, root * gradient, rcond=1e-12)[0]
