"""Maximum likelihood: bounded Fisher scoring from several starts.

In the coordinates z (see `parameters`) the penalised log-likelihood l(z) = ln L + ln prior is climbed with the exact
score g and the expected information I of the innovations' sensitivities,

    (I + λ diag I) δ = g,

λ by Levenberg and Marquardt; coordinates at a bound that the score pushes outwards are held there.
Shapes: d free parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.likelihood import Likelihood
from hygrokf.parameters import Coordinates

GAIN_TOLERANCE = 1e-5
"""A climb has converged when the next full step promises less than this much log-likelihood."""
MAXIMUM_PASSES = 60


@dataclass(frozen=True)
class Optimum:
    """Where one climb ended: coordinates z (d,), penalised log-likelihood, whether it converged, and why it stopped."""

    z: np.ndarray
    objective: float
    converged: bool
    message: str
    passes: int


@dataclass(frozen=True)
class Estimate:
    """The best optimum of several climbs.

    `values` all parameters; `loglik` without the prior; `others` the distinct optima found besides (objective, values);
    `at_bounds` free parameters that ended at a bound.
    """

    coordinates: Coordinates
    z: np.ndarray
    values: dict[str, float]
    loglik: float
    objective: float
    converged: bool
    message: str
    at_bounds: tuple[str, ...]
    others: tuple[tuple[float, dict[str, float]], ...] = ()


class Objective:
    """Penalised log-likelihood of the free coordinates, with score and information."""

    def __init__(self, likelihood: Likelihood, coordinates: Coordinates) -> None:
        self.likelihood = likelihood
        self.coordinates = coordinates
        self._place = coordinates.place()
        self._count = len(coordinates.parameters)

    def value(self, z: np.ndarray) -> float:
        try:
            value = self.likelihood.value(self.coordinates.values(z))
        except FloatingPointError:
            return -math.inf
        return value + self.coordinates.log_prior(z)[0]

    def score(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """l and its gradient (d,)."""
        value, gradient = self.likelihood.score(self.coordinates.values(z))
        prior, slope, _ = self.coordinates.log_prior(z)
        return value + prior, gradient[self._place] * self.coordinates.slopes(z) + slope

    def information(self, z: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """l, its gradient (d,) and the expected information (d, d), the prior's included."""
        return self._sensitivities(z, each=False)[:3]

    def _sensitivities(self, z: np.ndarray, each: bool) -> tuple:
        directions = np.zeros((self._count, len(z)))
        directions[self._place, np.arange(len(z))] = self.coordinates.slopes(z)
        found = self.likelihood.sensitivities(self.coordinates.values(z), directions, each=each)
        prior, slope, curvature = self.coordinates.log_prior(z)
        information = found.information + np.diag(curvature)
        return found.loglik + prior, found.score + slope, information, found.scores

    def scores(self, z: np.ndarray) -> np.ndarray:
        """Each instant's share (T, d) of the score, without the prior."""
        return self.information_and_scores(z)[3]

    def information_and_scores(self, z: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """`information`, and each instant's share (T, d) of the score, without the prior."""
        return self._sensitivities(z, each=True)


def climb(
    objective: Objective,
    start: np.ndarray,
    passes: int = MAXIMUM_PASSES,
    tolerance: float = GAIN_TOLERANCE,
) -> Optimum:
    """Bounded Fisher scoring from one start (d,).

    Far from the optimum the expected information can mislead; where scoring sticks, a quasi-Newton climb by the
    score alone leads on, and scoring finishes.
    """
    found = _scoring(objective, start, passes, tolerance)
    for _ in range(3):
        if found.converged or not math.isfinite(found.objective) or passes < MAXIMUM_PASSES:
            break
        again = _scoring(objective, _quasi_newton(objective, found.z), passes, tolerance)
        if again.objective <= found.objective + tolerance:
            break
        found = again
    return found


def _quasi_newton(objective: Objective, start: np.ndarray) -> np.ndarray:
    from scipy.optimize import minimize

    def downhill(z: np.ndarray) -> tuple[float, np.ndarray]:
        try:
            value, gradient = objective.score(z)
        except FloatingPointError:
            return 1e300, np.zeros_like(z)
        if not (math.isfinite(value) and np.all(np.isfinite(gradient))):
            return 1e300, np.zeros_like(z)
        return -value, -gradient

    bounds = list(zip(objective.coordinates.lower, objective.coordinates.upper, strict=True))
    found = minimize(
        downhill, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 300, "maxcor": 20}
    )
    return found.x


def _scoring(objective: Objective, start: np.ndarray, passes: int, tolerance: float) -> Optimum:
    lower, upper = objective.coordinates.lower, objective.coordinates.upper
    z = np.clip(start, lower, upper)
    damping = 1e-3
    value, gradient, information = objective.information(z)
    if not math.isfinite(value):
        return Optimum(z, -math.inf, False, "the likelihood is not finite at the start", 0)
    for done in range(1, passes + 1):
        free = ~(((z <= lower) & (gradient <= 0)) | ((z >= upper) & (gradient >= 0)))
        if not free.any():
            return Optimum(z, value, True, "converged: every free parameter is at a bound", done)
        if bounded_step(information, gradient, free, z, lower, upper, 1e-9)[1] < tolerance:
            return Optimum(z, value, True, "converged", done)
        for _ in range(25):
            step, promised = bounded_step(information, gradient, free, z, lower, upper, damping)
            if promised > 0:
                trial = objective.value(z + step)
                if trial - value > 0.05 * promised:
                    damping = max(damping / (10.0 if trial - value > 0.5 * promised else 2.0), 1e-9)
                    break
                if promised < 0.1 * tolerance:
                    return Optimum(z, value, True, "converged to rounding", done)
            damping = max(damping, 1e-6) * 6.0
        else:
            return Optimum(
                z, value, False, "no step improves the likelihood, yet its score is not zero", done
            )
        new = z + step
        z = new
        value, gradient, information = objective.information(z)
    return Optimum(z, value, False, f"stopped after {passes} passes", passes)


def bounded_step(
    information: np.ndarray,
    gradient: np.ndarray,
    free: np.ndarray,
    z: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    damping: float,
) -> tuple[np.ndarray, float]:
    """The damped step within the bounds and a trust box, and the gain that the quadratic model promises for it.

    Of three ways to stay in the box the one that promises most: every coordinate that would leave it held at its edge
    and the others solved again; the whole step shortened; the steepest ascent.  Shortened alone, a flat direction, whose
    full step is without end, would shrink the steps of all others to nothing and so feign convergence.
    """
    reach = np.maximum(1.5, 0.5 * np.abs(z))
    low, high = np.maximum(lower - z, -reach), np.minimum(upper - z, reach)
    held, moving = np.zeros_like(z), free.copy()
    shortened = np.zeros_like(z)
    while moving.any():
        rest = gradient - information @ np.where(moving, 0.0, held)
        held[moving] = _damped_step(information[np.ix_(moving, moving)], rest[moving], damping)
        if moving.sum() == free.sum():
            shortened = np.clip(held / max(1.0, float(np.max(np.abs(held) / reach))), lower - z, upper - z)
        beyond = moving & ((held < low) | (held > high))
        if not beyond.any():
            break
        held[beyond] = np.clip(held[beyond], low[beyond], high[beyond])
        moving &= ~beyond

    tried = []
    diagonal = np.maximum(np.diag(information), 1e-300)
    steepest = np.where(free, gradient / (diagonal * (1.0 + damping)), 0.0)
    for direction in (held, shortened, np.clip(steepest, low, high)):
        # the box is convex: any share of the way stays in it, and the best share promises no loss
        slope, curvature = float(gradient @ direction), float(direction @ information @ direction)
        share = min(max(slope / max(curvature, 1e-300), 0.0), 1.0)
        tried.append((share * slope - 0.5 * share**2 * curvature, share * direction))
    promised, step = max(tried, key=lambda pair: pair[0])
    return step, promised


def _damped_step(information: np.ndarray, gradient: np.ndarray, damping: float) -> np.ndarray:
    diagonal = np.maximum(np.diag(information), 1e-12 * max(float(np.max(np.diag(information))), 1e-300))
    root = 1.0 / np.sqrt(diagonal)
    scaled = information * root[:, None] * root[None, :] + damping * np.eye(len(gradient))
    try:
        return root * np.linalg.solve(scaled, root * gradient)
    except np.linalg.LinAlgError:
        return root * np.linalg.lstsq(scaled, root * gradient, rcond=1e-12)[0]


def starts(coordinates: Coordinates, values: Mapping[str, float] | None, count: int) -> list[np.ndarray]:
    """The stated start and `count`−1 more that differ in the noise parameters: a Halton sequence over e^±2.5."""
    first = coordinates.start(values)
    noisy = [i for i, p in enumerate(coordinates.free) if p.noise]
    result = [first]
    primes = [2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37]
    for k in range(1, count if noisy else 1):
        z = first.copy()
        for place, i in enumerate(noisy):
            z[i] += 5.0 * (_halton(k, primes[place % len(primes)]) - 0.5)
        result.append(np.clip(z, coordinates.lower, coordinates.upper))
    return result


def _halton(index: int, base: int) -> float:
    result, fraction = 0.0, 1.0
    while index > 0:
        fraction /= base
        result += fraction * (index % base)
        index //= base
    return result


def maximise(
    likelihood: Likelihood,
    values: Mapping[str, float] | None = None,
    fixed: Mapping[str, float] | None = None,
    count: int = 4,
    progress: Callable[[str], None] | None = None,
    more_starts: Sequence[Mapping[str, float]] = (),
    search: Likelihood | None = None,
) -> Estimate:
    """Maximum likelihood from several starts; other optima are reported, not hidden.

    `values` start values of some parameters, `fixed` those to be held, `count` starts over the noise parameters,
    `more_starts` further complete starts.  Short climbs from every start, on a shorter stretch of the record if `search`
    gives one, are followed to the end on the whole for those that lead to different places.
    """
    coordinates = Coordinates(likelihood.model.parameters, fixed)
    objective = Objective(likelihood, coordinates)
    scout = objective if search is None else Objective(search, coordinates)
    candidates = starts(coordinates, values, count)
    candidates += [coordinates.start(v) for v in more_starts]
    short = []
    for k, z in enumerate(candidates):
        if progress is not None:
            progress(f"start {k + 1} of {len(candidates)}")
        several = len(candidates) > 1
        short.append(
            climb(scout, z, passes=15 if several else 25, tolerance=1e-2)
            if several or search
            else Optimum(z, 0.0, False, "", 0)
        )
    short.sort(key=lambda o: -o.objective)
    optima: list[Optimum] = []
    if progress is not None:
        progress("climb")
    for k, o in enumerate(short):
        # worth following to the end: the best, and others that may still overtake it
        if k > 0 and (len(optima) >= 3 or o.objective < short[0].objective - 50.0 or not _far(o, short[0])):
            continue
        done = climb(objective, o.z)
        if all(_far(done, kept) for kept in optima):
            optima.append(done)
    return estimate_of(likelihood, coordinates, optima)


def climbed_on(
    likelihood: Likelihood, values: Mapping[str, float], passes: int = MAXIMUM_PASSES - 1
) -> Estimate:
    """The estimate that a bounded number of passes of scoring leads to from values near a maximum.

    No quasi-Newton climb follows where scoring sticks: on a likelihood with edges it goes on for hundreds of passes.
    """
    coordinates = Coordinates(likelihood.model.parameters)
    found = climb(Objective(likelihood, coordinates), coordinates.start(values), passes)
    return estimate_of(likelihood, coordinates, [found])


def estimate_of(likelihood: Likelihood, coordinates: Coordinates, optima: list[Optimum]) -> Estimate:
    """The best of some optima, the others beside it."""
    optima = sorted(optima, key=lambda o: -o.objective)
    best = optima[0]
    values_ = coordinates.values(best.z)
    margin = 1e-9
    at = tuple(
        p.name
        for p, z, a, b in zip(coordinates.free, best.z, coordinates.lower, coordinates.upper, strict=True)
        if z <= a + margin or z >= b - margin
    )
    message = (
        best.message
        if best.converged
        else f"not converged: {best.message}; try more starts or other start values"
    )
    return Estimate(
        coordinates=coordinates,
        z=best.z,
        values=values_,
        loglik=likelihood.value(values_),
        objective=best.objective,
        converged=best.converged,
        message=message,
        at_bounds=at,
        others=tuple((o.objective, coordinates.values(o.z)) for o in optima[1:] if o.converged),
    )


def _far(a: Optimum, b: Optimum) -> bool:
    """Whether two optima differ by more than unfinished climbing explains."""
    return abs(a.objective - b.objective) > 0.5 or float(np.max(np.abs(a.z - b.z))) > 0.7
