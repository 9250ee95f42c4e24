"""A state as a normal distribution, and what a likelihood checks before it starts from one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.errors import suggestion, unknown_names
from hygrokf.physics.model import Model

INITIAL = ("prior", "stationary", "diffuse")
ROUNDING = 1e-9
"""[1] asymmetry, and negative eigenvalue, of a covariance in its own scale that rounding explains."""


@dataclass(frozen=True)
class Gaussian:
    """A state as a normal distribution x ~ N(mean, covariance), such as a filter's checkpoint.

    mean: (n,) in the order and the units of `Model.states`.
    covariance: (n, n) in products of these units, symmetric, without negative eigenvalues.
    time_h: [h] the instant.

    A likelihood that starts from it raises ValueError for other shapes and for what is no covariance.
    """

    mean: np.ndarray
    covariance: np.ndarray
    time_h: float = 0.0


def expect_initial(model: Model, initial: object, diffuse_states: Sequence[str]) -> None:
    """Check a likelihood's first state; raises ValueError that lists every fault."""
    faults = unknown_names("diffuse_states", diffuse_states, model.states)
    if isinstance(initial, Gaussian):
        faults += _no_gaussian(initial, len(model.states))
    elif initial not in INITIAL:
        near = suggestion(initial, INITIAL, 1) if isinstance(initial, str) else ""
        faults.append(f"initial: expected one of {INITIAL} or a Gaussian, found {initial!r}{near}")
    if diffuse_states and initial in INITIAL[:2]:
        faults.append(f'diffuse_states: expected initial="diffuse" beside them, found {initial!r}')
    if faults:
        raise ValueError("; ".join(faults))


def _no_gaussian(initial: Gaussian, n: int) -> list[str]:
    mean, covariance = np.asarray(initial.mean), np.asarray(initial.covariance)
    if mean.shape != (n,) or covariance.shape != (n, n):
        return [
            f"initial: expected a mean of shape {(n,)} and a covariance of shape {(n, n)}, found "
            f"{mean.shape} and {covariance.shape}"
        ]
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        return [
            "initial: expected finite moments, found others; a state of which nothing is known is diffuse"
        ]
    size = np.sqrt(np.abs(np.diag(covariance)))
    scale = np.outer(*[np.where(size > 0.0, size, 1.0)] * 2)
    if np.abs(covariance - covariance.T).max() > ROUNDING * np.abs(covariance).max():
        return ["initial: expected a symmetric covariance, found another; average it with its transpose"]
    if np.diag(covariance).min() < 0.0 or np.linalg.eigvalsh(covariance / scale).min() < -ROUNDING:
        return ["initial: expected a covariance without negative eigenvalues, found one that has some"]
    return []
