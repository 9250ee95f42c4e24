"""Results of a filter run: Gaussians, traces, sensitivities, and ln L with a check of its digits.

Shapes: T instants, n states, k outputs, d parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.engine.traced_filter import Recursion
from hygrokf.errors import suggestion, unknown_names
from hygrokf.physics.model import Model

INITIAL = ("prior", "stationary", "diffuse")
COVARIANCE_ROUNDING = 1e-9
"""[1] asymmetry, and negative eigenvalue, of a scaled covariance that rounding explains."""


# -- a state as a normal distribution ------------------------------------------------------------------------
@dataclass(frozen=True)
class Gaussian:
    """A state as a normal distribution x ~ N(mean, covariance), such as a filter's checkpoint.

    mean: (n,) in the order and the units of `Model.states`.
    covariance: (n, n) in products of these units, symmetric, without negative eigenvalues.
    time_h: [h] the instant.

    A likelihood that starts from a Gaussian raises ValueError for other shapes and for an invalid covariance.
    """

    mean: np.ndarray
    covariance: np.ndarray
    time_h: float = 0.0


def expect_initial(model: Model, initial: object, diffuse_states: Sequence[str]) -> None:
    """Check a likelihood's first state; raises ValueError that lists every fault."""
    faults = unknown_names("diffuse_states", diffuse_states, model.states)
    if isinstance(initial, Gaussian):
        faults += _gaussian_faults(initial, len(model.states))
    elif initial not in INITIAL:
        near = suggestion(initial, INITIAL, 1) if isinstance(initial, str) else ""
        faults.append(f"initial: expected one of {INITIAL} or a Gaussian, found {initial!r}{near}")
    if diffuse_states and initial in INITIAL[:2]:
        faults.append(f'diffuse_states: expected initial="diffuse" beside them, found {initial!r}')
    if faults:
        raise ValueError("; ".join(faults))


def _gaussian_faults(initial: Gaussian, n: int) -> list[str]:
    """Why a Gaussian cannot be the start of a model of n states; empty if it can."""
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
    if np.abs(covariance - covariance.T).max() > COVARIANCE_ROUNDING * np.abs(covariance).max():
        return ["initial: expected a symmetric covariance, found another; average it with its transpose"]
    if np.diag(covariance).min() < 0.0 or np.linalg.eigvalsh(covariance / scale).min() < -COVARIANCE_ROUNDING:
        return ["initial: expected a covariance without negative eigenvalues, found one that has some"]
    return []


LOST_DIGITS_RATIO = 1e9
"""[1] ratio of an output's innovation variances from which plain covariances have lost too many digits; below
it ln L is accurate to 1e-7."""
FACTORS = 1e24
"""[1] this ratio for covariances as factors, square roots that keep twice as many digits."""


# -- what a run gives ----------------------------------------------------------------------------------------
class DigitsFault(FloatingPointError, ValueError):
    """Innovation variances so far apart that no digit of a covariance is left."""


@dataclass(frozen=True)
class Sensitivities:
    """Log-likelihood, score (r,), information (r, r) along r directions; `scores` (T, r): by instant, empty
    where they were not asked for."""

    loglik: float
    score: np.ndarray
    information: np.ndarray
    scores: np.ndarray


@dataclass(frozen=True)
class End:
    """ln L of one filter run, and the Gaussian to continue from."""

    loglik: float
    last: Gaussian


@dataclass(frozen=True)
class Trace:
    """All moments of one filter run: `prior_mean` (T, n), `prior_covariance` (T, n, n) before the readings of
    an instant, `mean`, `covariance` after them; `prediction` (T, k) and `variance` (T, k) of every output,
    each given the readings processed before it; `transition` (T, n, n) the derivative of the state with
    respect to that at the previous instant, `noise` (T, n, n) what the step between them added to the
    covariance; `last` the Gaussian to continue from.  Where the start is unknown, variances are infinite."""

    prior_mean: np.ndarray
    prior_covariance: np.ndarray
    prediction: np.ndarray
    variance: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    transition: np.ndarray
    noise: np.ndarray
    loglik: float
    last: Gaussian

    @property
    def lost(self) -> bool:
        """Whether a variance is negative, or the readings of an instant reduced a variance so much that its
        digits are lost."""
        before, after = (np.einsum("tii->ti", p) for p in (self.prior_covariance, self.covariance))
        floor = np.where(np.isfinite(before), before, 0.0) / LOST_DIGITS_RATIO
        return bool((before < 0.0).any() or (after < floor).any())


def loglik_of(sums: Sequence[np.ndarray]) -> float:
    """ln L from the sums that loops wrote over the pieces of a run (`RunningSums.write`)."""
    parts = [part.tolist() for part in sums]
    return sum(-0.5 * (part[0] + part[1] + part[2] * math.log(2.0 * math.pi)) for part in parts)


def checked_loglik(sums: Sequence[np.ndarray], outputs: Sequence[str], factored: bool) -> float:
    """ln L of a run, −∞ where it breaks down; NaN where plain covariances have lost their digits.

    A reading reduces a variance by at most the ratio of its innovation's variance before and after, so that
    the largest and the smallest innovation variance of each output bound the loss of digits.  Raises
    DigitsFault where these variances are too far apart even for factors.
    """
    value, parts = loglik_of(sums), [part[3:].tolist() for part in sums]
    is_finite, count = math.isfinite(value), len(outputs)
    for c, name in enumerate(outputs):
        low, high = min(part[c] for part in parts), max(part[count + c] for part in parts)
        if not factored and (low <= 0.0 or (is_finite and high > LOST_DIGITS_RATIO * low)):
            return math.nan
        if factored and is_finite and high > FACTORS * low:
            raise DigitsFault(
                f"expected variances of the innovations of {name} within a factor of {FACTORS:.0e}, found "
                f"{low:.3g} to {high:.3g}: no digit of a covariance is left; state a narrower start, or "
                "'diffuse', or more noise of the readings"
            )
    return value if is_finite else -math.inf


def covariances(recursion: Recursion, moments: np.ndarray) -> np.ndarray:
    """Covariances (…, n, n) of packed moments (…, w), infinite where the start is unknown."""
    finite = recursion.covariance_of(moments)
    if not recursion.unknown:
        return finite
    unknown = recursion.unknown_of(moments)
    infinite = unknown @ np.swapaxes(unknown, -1, -2)
    return np.where(infinite != 0.0, np.copysign(math.inf, infinite), finite)
