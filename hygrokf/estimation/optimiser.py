"""Maximum likelihood by bounded Newton steps on the exact score, from several starts.

In the coordinates z (see `parameters`) the penalised log-likelihood l(z) = ln L + ln prior is climbed with
the exact score g,

    (M + λ diag M) δ = g,

with λ after Levenberg and Marquardt.  Far from the maximum M is the expected information of the innovations'
sensitivities (Fisher scoring).  Near it, where the expected information would converge linearly or zigzag, M
follows the exact score by secants (Broyden, Fletcher, Goldfarb and Shanno), which converges superlinearly.
Coordinates at a bound that the score pushes outwards stay there. A climb has converged where ½ g' M⁻¹ g of
the other coordinates is below the tolerance.  It ends when its budget of filter steps is spent: where a time
constant becomes far shorter than the interval between readings, every pass takes many sub-steps.

A model that contains another model, its parent, is fitted from the parent's maximum as well: the likelihood
has several maxima, and the larger model must not end below the smaller one. Shapes: d free parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.record import kind_of
from hygrokf.estimation.joint_likelihood import AnyLikelihood
from hygrokf.estimation.likelihood import Sensitivities
from hygrokf.estimation.newton_steps import (
    bounded_step,
    damped_step,
    natural_units,
    reach_of,
    secant_update,
)
from hygrokf.physics.parameters import Coordinates, Parameter, expect_starts
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.statement import Statement

CLIMB_TOLERANCE = 1e-9
"""A climb has converged when the next full step promises less than this much log-likelihood: the estimate is
then within 5e-5 of its standard error."""
NEAR_GAIN = 1.0
"""Promised gain in log-likelihood below which the curvature follows the exact score."""
SCORING_PASSES = 25
"""Passes of scoring after which the curvature follows the exact score at any distance: far from the maximum
the expected information can mislead."""
MAXIMUM_PASSES = 200
LIKELIHOOD_ROUNDING = 1e-8
"""[1] share of the log-likelihood; smaller gains are computed from the score, because the difference of two
values would be rounding."""
MOST_FILTER_STEPS = 3_000.0
"""Filter steps per instant of the record after which a climb is stopped; the fit of the demo's cabinet takes
at most 76."""
LIMIT_DISTANCE = 1e-9
"""Distance within which a coordinate counts as being at a limit, in its natural unit."""
BETTER_GAIN = 0.1
"""Excess in log-likelihood by which another point shows that an estimate is not a maximum; climbs converge
far below it."""
INEXACT = 1e-3
"""Change of ln L, or of the parameters in standard errors, with sub-steps of half the length above which an
estimate is not exact."""
NOISE_SPREAD = 5.0
"""[ln] width of the range over which further starts vary a noise parameter: a factor of 12 up or down."""
OTHER_SPREAD = 3.0
"""[ln] width of this range for other positive parameters: a factor of 4.5 up or down."""


@dataclass(frozen=True)
class Optimum:
    """The point at which a climb ended: coordinates `z` (d,) and penalised log-likelihood `objective` there.

    `end`: why the climb ended.  `curvature` (d, d): minus the second derivatives of the objective, as the
    climb approximated them; None of a climb that has not converged.
    """

    z: np.ndarray
    objective: float
    converged: bool
    end: Statement
    curvature: np.ndarray | None = None


@dataclass(frozen=True, repr=False)
class Estimate:
    """The best local optimum over all starts.

    `values` all parameters; `loglik` without the prior; `others` further distinct optima (objective, values);
    `at_bounds` free parameters that ended at a bound; `discretisation_error` what sub-steps of half the
    length change, 0 where steps are exact: ln L, or, where this is more, the parameters in standard errors.
    """

    coordinates: Coordinates
    z: np.ndarray
    values: dict[str, float]
    loglik: float
    objective: float
    converged: bool
    message: Statement
    at_bounds: tuple[str, ...]
    others: tuple[tuple[float, dict[str, float]], ...] = ()
    discretisation_error: float = 0.0

    def __repr__(self) -> str:
        rows = [
            f"  {p.name} = {self.values[p.name]:.6g}{'' if p.unit == '1' else f' {p.unit}'}"
            + ("  (at a limit)" if p.name in self.at_bounds else "")
            for p in self.coordinates.free
        ]
        more = f", {len(self.others)} other optima" if self.others else ""
        head = f"Estimate: ln L = {self.loglik:.6f}, {len(rows)} free parameters; {self.message}{more}"
        return "\n".join([head, *shortened(rows)])


def shortened(lines: list[str], most: int = 30) -> list[str]:
    """The first `most` lines, and a line with the number of lines left out."""
    return lines if len(lines) <= most else [*lines[:most], f"  … and {len(lines) - most} more"]


class _BudgetSpent(Exception):
    """A climb has used up its budget of filter steps, which `end` states."""

    def __init__(self, end: Statement) -> None:
        super().__init__(end.text)
        self.end = end


class Objective:
    """Penalised log-likelihood of the free coordinates, with score and information."""

    def __init__(self, likelihood: AnyLikelihood, coordinates: Coordinates) -> None:
        self.likelihood = likelihood
        self.coordinates = coordinates
        self._place = coordinates.positions()

    def at(self, z: np.ndarray) -> Objective:
        """The objective with the sub-steps fixed that suit z (d,); itself where no sub-steps resolve the
        rates there."""
        try:
            return Objective(self.likelihood.scheduled(self.coordinates.values(z)), self.coordinates)
        except FloatingPointError:
            return self

    def halved(self, z: np.ndarray) -> Objective:
        """The objective with the sub-steps fixed that suit z (d,), each divided in two."""
        return Objective(self.likelihood.halved(self.coordinates.values(z)), self.coordinates)

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

    def information(self, z: np.ndarray, each: bool = False) -> Sensitivities:
        """l, its gradient (d,) and the expected information (d, d), including that of the prior; with `each`,
        also each instant's share (T, d) of the score, without the prior."""
        directions = self.coordinates.directions(z)
        sensitivities = self.likelihood.sensitivities(self.coordinates.values(z), directions, each)
        prior, slope, curvature = self.coordinates.log_prior(z)
        information = sensitivities.information + np.diag(curvature)
        return Sensitivities(
            sensitivities.loglik + prior, sensitivities.score + slope, information, sensitivities.scores
        )


class _Metered:
    """An objective during one climb: keeps the sub-steps fixed, counts the filter steps and remembers the
    best point."""

    def __init__(self, objective: Objective, start: np.ndarray, budget: float) -> None:
        self.coordinates = objective.coordinates
        self._base, self._fixed = objective, objective.at(start)
        self._budget = self._remaining = budget
        self.best = (-math.inf, np.empty(0))

    def renew_sub_steps(self, z: np.ndarray) -> bool:
        """Fix the sub-steps that suit z (d,); returns whether they have changed."""
        before, self._fixed = self._fixed.likelihood, self._base.at(z)
        return self._fixed.likelihood is not before

    def value(self, z: np.ndarray) -> float:
        self._spend(z)
        value = self._fixed.value(z)
        self._keep(z, value)
        return value

    def score(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        self._spend(z)
        try:
            value, gradient = self._fixed.score(z)
        except FloatingPointError:
            return -math.inf, np.zeros_like(z)
        if not (math.isfinite(value) and np.isfinite(gradient).all()):
            return -math.inf, np.zeros_like(z)
        self._keep(z, value)
        return value, gradient

    def information(self, z: np.ndarray) -> Sensitivities:
        self._spend(z)
        sensitivities = self._fixed.information(z)
        self._keep(z, sensitivities.loglik)
        return sensitivities

    def _spend(self, z: np.ndarray) -> None:
        """Take the filter steps of one pass off the budget; raises _BudgetSpent when it is used up."""
        try:
            steps = self._fixed.likelihood.steps_per_instant(self.coordinates.values(z))
        except FloatingPointError:  # without finite rates there are no steps to count
            steps = 1.0
        self._remaining -= steps
        if self._remaining < 0.0:
            raise _BudgetSpent(FitCode.BUDGET_SPENT(budget=self._budget, steps=steps))

    def _keep(self, z: np.ndarray, value: float) -> None:
        """Remember a point if it is the best one so far."""
        if value > self.best[0]:
            self.best = (value, z.copy())


def climb(
    objective: Objective,
    start: np.ndarray,
    passes: int = MAXIMUM_PASSES,
    tolerance: float = CLIMB_TOLERANCE,
    budget: float = MOST_FILTER_STEPS,
) -> Optimum:
    """A bounded climb from one start (d,), as the module's text describes.

    The climb has converged where two points in succession promise less than `tolerance` of log-likelihood.
    After `passes` steps, or `budget` filter steps per instant of the record, the climb ends, not converged,
    at its best point.  Sub-steps are fixed on the way, and chosen anew at the end until the end point stays.
    """
    metered = _Metered(objective, start, budget)
    try:
        return _climb(metered, start, passes, tolerance)
    except _BudgetSpent as spent:
        value, z = metered.best
        return Optimum(z if z.size else start, value, False, spent.end)


def _climb(objective: _Metered, start: np.ndarray, passes: int, tolerance: float) -> Optimum:
    """Climb from one start until convergence; raises _BudgetSpent.

    Each pass takes the first of up to 25 steps, more and more damped, whose gain is a fair share of what its
    quadratic model promised.  Far from the maximum a step is judged by its value and the expected information
    is computed anew after it; near it, by its score, from which every step corrects the curvature.
    """
    lower, upper = objective.coordinates.lower, objective.coordinates.upper
    z = np.clip(start, lower, upper)
    sensitivities = objective.information(z)
    if not math.isfinite(sensitivities.loglik):
        return Optimum(z, -math.inf, False, FitCode.START_NOT_FINITE())
    value, gradient, curvature = sensitivities.loglik, sensitivities.score, sensitivities.information
    damping, was_small, is_expected = 1e-3, False, True
    for count in range(passes + 1):
        free = ~(((z <= lower) & (gradient <= 0)) | ((z >= upper) & (gradient >= 0)))
        if not free.any():
            return Optimum(z, value, True, FitCode.CONVERGED_AT_BOUNDS(), curvature)
        reach = reach_of(objective.coordinates, z)
        promised = bounded_step(curvature, gradient, free, z, lower, upper, 1e-9, reach)[1]
        if promised < tolerance and was_small and objective.renew_sub_steps(z):
            value, gradient = objective.score(z)
            if not math.isfinite(value):
                return Optimum(z, value, False, FitCode.NO_SUB_STEPS())
            promised = bounded_step(curvature, gradient, free, z, lower, upper, 1e-9, reach)[1]
        if promised < tolerance and was_small:
            return Optimum(z, value, True, FitCode.CONVERGED(), curvature)
        if count == passes:
            break
        was_small = promised < tolerance
        is_far = promised > NEAR_GAIN and count < SCORING_PASSES
        for _ in range(25):
            step, promised = bounded_step(curvature, gradient, free, z, lower, upper, damping, reach)
            new, slope = (objective.value(z + step), gradient) if is_far else objective.score(z + step)
            gain = new - value
            if not is_far and math.isfinite(new):
                if promised < LIKELIHOOD_ROUNDING * (1.0 + abs(value)):
                    gain = 0.5 * float((gradient + slope) @ step)
                curvature = secant_update(curvature, step, gradient - slope)
            if gain > 0.05 * promised > 0.0:
                damping = max(damping / (10.0 if gain > 0.5 * promised else 2.0), 1e-9)
                break
            if was_small:  # the gain is rounding; the curvature is already updated by the step
                new, slope, step = value, gradient, np.zeros_like(z)
                break
            damping = max(damping, 1e-6) * 6.0
        else:
            if is_expected:
                return Optimum(z, value, False, FitCode.NO_STEP_IMPROVES())
            curvature, is_expected, damping = objective.information(z).information, True, 1e-3
            continue
        z, value, gradient, is_expected = z + step, new, slope, is_far
        if is_far:
            sensitivities = objective.information(z)
            value, gradient, curvature = sensitivities.loglik, sensitivities.score, sensitivities.information
    return Optimum(z, value, False, FitCode.PASSES_SPENT(passes=passes))


def starts(coordinates: Coordinates, values: Mapping[str, float] | None, count: int) -> list[np.ndarray]:
    """The given start and `count`−1 further ones around it: the first, third, … of these vary only the noise
    parameters, the others all parameters.

    The starts fill their ranges evenly by an additive recurrence with the generalised golden ratio (Roberts
    2018): the k-th start has the shares ½ + k φ^−j mod 1, φ^(d+1) = φ + 1."""
    first = coordinates.start(values)
    noisy = np.array([p.noise for p in coordinates.free], dtype=bool)
    width = np.array([_start_width(p) for p in coordinates.free])
    ratio = 2.0
    for _ in range(50):
        ratio = (1.0 + ratio) ** (1.0 / (len(first) + 1.0))
    steps = ratio ** -np.arange(1.0, len(first) + 1.0)
    result = [first]
    for k in range(1, count):
        varied = noisy if k % 2 and noisy.any() else np.ones_like(noisy)
        z = first + np.where(varied, width * ((0.5 + k * steps) % 1.0 - 0.5), 0.0)
        result.append(np.clip(z, coordinates.lower, coordinates.upper))
    return result


def _start_width(p: Parameter) -> float:
    """Width of the range of starts in a parameter's coordinate, limited by its prior."""
    if p.noise:
        return NOISE_SPREAD
    if p.prior is not None and p.prior.logarithmic == p.positive:
        return 4.0 * p.prior.sd
    return OTHER_SPREAD if p.positive else 0.5 * (p.upper - p.lower)


def nested_starts(
    coordinates: Coordinates, values: Mapping[str, float] | None, parent: Estimate
) -> list[np.ndarray]:
    """Starts (d,) of a model at the maximum of its `parent`, a model that it contains.

    Parameters that the parent lacks take their given start; in a second start they take their null values, if
    all of them have one.
    """
    added = [p for p in coordinates.free if p.name not in parent.values]
    start_values = {**(values or {}), **parent.values}
    result = [coordinates.start(start_values)]
    nulls = {p.name: p.null for p in added if p.null is not None}
    if added and len(nulls) == len(added):
        result.append(coordinates.start({**start_values, **nulls}))
    return result


def least_objective(coordinates: Coordinates, parents: Sequence[Estimate]) -> float:
    """Lower limit of the penalised log-likelihood at a model's maximum, from the maxima of its `parents`."""
    floors = [-math.inf]
    for parent in parents:
        added = [p for p in coordinates.free if p.name not in parent.values]
        priors = [
            p.prior.log_density(p.start if p.null is None else p.null) for p in added if p.prior is not None
        ]
        floors.append(parent.objective + sum(priors))
    return max(floors)


def fit_mle(
    likelihood: AnyLikelihood,
    values: Mapping[str, float] | None = None,
    fixed: Mapping[str, float] | None = None,
    count: int = 4,
    progress: Callable[[str], None] | None = None,
    more_starts: Sequence[Mapping[str, float]] = (),
    search: AnyLikelihood | None = None,
    parents: Sequence[Estimate] = (),
    budget: float = MOST_FILTER_STEPS,
    tolerance: float = CLIMB_TOLERANCE,
) -> Estimate:
    """Maximum likelihood from several starts; other optima are reported too.

    likelihood: of the model on its readings; of several records, a `JointLikelihood`.
    values: start values of some parameters, in their units; the others begin at their own start.
    fixed: parameters to hold, with their values in their units.
    count, more_starts: number of starts (see `starts`), and further complete ones in the parameters' units.
    search: likelihood on a shorter stretch, for the short climbs that run from every start; short climbs
        that end at distinct points are continued on the whole record until they converge.
    parents: estimates, on the same readings, of models that this one contains, exactly or as a limit.  Climbs
        also begin from each of them (see `nested_starts`), and an estimate less likely than a parent's is
        never called converged.
    budget: [1] filter steps per instant of the record for each climb.
    tolerance: [ln L] the estimate has converged where ½ g' M⁻¹ g, the gain that the next step promises, is
        smaller.
    progress: called with a sentence about each step.

    Returns the estimate: `values` in the parameters' units, `loglik`, `converged` and `message`, `others`.
    Raises ValueError for unknown names, starts outside their limits, settings that are not positive, and
    where there are no readings.
    """
    _expect_search(likelihood, count, budget, tolerance)
    coordinates = Coordinates(likelihood.parameters, fixed)
    start_sets = {f"more_starts[{k}]": start for k, start in enumerate(more_starts)}
    expect_starts(coordinates.parameters, coordinates.fixed, {"values": values or {}, **start_sets})
    if not likelihood.timeline.n_readings:
        raise ValueError(
            "likelihood: expected readings, found none at any instant; give `timeline` readings of "
            f"{', '.join(likelihood.model.outputs) or 'the outputs'}"
        )
    objective = Objective(likelihood, coordinates)
    short_objective = objective if search is None else Objective(search, coordinates)
    candidates = starts(coordinates, values, count)
    candidates += [coordinates.start(v) for v in more_starts]
    nested = [z for parent in parents for z in nested_starts(coordinates, values, parent)]
    candidates += nested
    short_optima = []
    for k, z in enumerate(candidates):
        if progress is not None:
            progress(f"start {k + 1} of {len(candidates)}")
        has_several = len(candidates) > 1
        short_optima.append(
            climb(short_objective, z, passes=15 if has_several else 25, tolerance=1e-2, budget=budget)
            if has_several or search
            else Optimum(z, 0.0, False, FitCode.PASSES_SPENT(passes=0))
        )
    short_optima.sort(key=lambda optimum: -optimum.objective)
    optima: list[Optimum] = []
    units = natural_units(coordinates)

    def is_distinct(a: Optimum, b: Optimum) -> bool:
        """Whether two optima differ by more than incomplete climbs explain."""
        return abs(a.objective - b.objective) > 0.5 or float(np.max(np.abs(a.z - b.z) / units)) > 0.7

    if progress is not None:
        progress("climb")
    for k, optimum in enumerate(short_optima):
        # continue the best climb, and others that may still overtake it
        is_behind = optimum.objective < short_optima[0].objective - 50.0
        if k > 0 and (len(optima) >= 3 or is_behind or not is_distinct(optimum, short_optima[0])):
            continue
        end = climb(objective, optimum.z, tolerance=tolerance, budget=budget)
        if all(is_distinct(end, other) for other in optima):
            optima.append(end)
    least = least_objective(coordinates, parents)
    if max(optimum.objective for optimum in optima) < least - BETTER_GAIN:
        optima += [climb(objective, z, tolerance=tolerance, budget=budget) for z in nested]
    return reject_below(least, estimate_of(likelihood, coordinates, optima))


def _expect_search(likelihood: object, count: int, budget: float, tolerance: float) -> None:
    """Check the settings of a search; raises ValueError that lists every fault."""
    faults = []
    if not callable(getattr(likelihood, "sensitivities", None)):
        faults.append(
            f"fit_mle: expected a Likelihood, found {kind_of(likelihood)}; "
            "Likelihood(model, timeline(model, …)) makes one, and so does fit.likelihood(record)"
        )
    if count < 1:
        faults.append(f"count: expected at least 1 start, found {count}")
    for name, value in (("budget", budget), ("tolerance", tolerance)):
        if not value > 0.0:
            faults.append(f"{name}: expected a number above 0, found {value}")
    if faults:
        raise ValueError("; ".join(faults))


def reject_below(least: float, estimate: Estimate) -> Estimate:
    """The estimate, marked as not converged where its objective is below `least`, a nested model's
    maximum."""
    deficit = least - estimate.objective
    if not deficit > BETTER_GAIN:
        return estimate
    return replace(estimate, converged=False, message=FitCode.NESTED_MODEL_HIGHER(gain=deficit))


def refine(likelihood: AnyLikelihood, values: Mapping[str, float]) -> Estimate:
    """The estimate after a climb from values near a maximum."""
    coordinates = Coordinates(likelihood.parameters)
    optimum = climb(Objective(likelihood, coordinates), coordinates.start(values))
    return estimate_of(likelihood, coordinates, [optimum])


def estimate_of(likelihood: AnyLikelihood, coordinates: Coordinates, optima: list[Optimum]) -> Estimate:
    """The estimate at the best of several optima, with the other converged optima in `others`."""
    optima = sorted(optima, key=lambda optimum: -optimum.objective)
    best = optima[0]
    values = coordinates.values(best.z)
    near = LIMIT_DISTANCE * natural_units(coordinates)
    ends = (best.z <= coordinates.lower + near) | (best.z >= coordinates.upper - near)
    message = best.end if best.converged else FitCode.SEARCH_UNFINISHED(end=best.end)
    loglik, error = (
        likelihood.value(values),
        max(changes_by_halving(Objective(likelihood, coordinates), best)),
    )
    if error > INEXACT:
        finer = 0.1 * likelihood.tolerance * INEXACT / error
        message = FitCode.STEPS_TOO_LONG(end=message, change=error, tolerance=finer)
    return Estimate(
        coordinates=coordinates,
        z=best.z,
        values=values,
        loglik=loglik,
        objective=best.objective,
        converged=best.converged,
        message=message,
        at_bounds=tuple(name for name, at in zip(coordinates.names, ends, strict=True) if at),
        others=tuple(
            (optimum.objective, coordinates.values(optimum.z)) for optimum in optima[1:] if optimum.converged
        ),
        discretisation_error=error,
    )


def changes_by_halving(objective: Objective, optimum: Optimum) -> tuple[float, float]:
    """Measure the error of the sub-steps at an optimum by halving them: returns |Δl|, and the largest shift
    of a combination of the parameters [standard errors],

        √(Δg' M⁻¹ Δg),

    with the change Δg of the score and the curvature M in the coordinates that are not at a bound.  Both are
    0 where steps are exact; the shift is also given as 0 without a curvature.
    """
    z, coordinates = optimum.z, objective.coordinates
    held, halved = objective.at(z), objective.halved(z)
    if halved.likelihood is held.likelihood:
        return 0.0, 0.0
    if optimum.curvature is None:
        return abs(halved.value(z) - held.value(z)), 0.0
    (value, score), (finer_value, finer_score) = held.score(z), halved.score(z)
    is_free = (z > coordinates.lower) & (z < coordinates.upper)
    change, curvature = (finer_score - score)[is_free], optimum.curvature[np.ix_(is_free, is_free)]
    shift = damped_step(curvature, change, 0.0, natural_units(coordinates)[is_free])
    return abs(finer_value - value), math.sqrt(max(float(change @ shift), 0.0))
