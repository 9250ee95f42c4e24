"""The headline interval of a time constant, composed of several sources of uncertainty.

All terms refer to the logarithm of the time constant.  The interval starts from the profile likelihood's
bounds of the chosen form, at distances a below and b above the value.  Each further source adds a variance v,
and the interval becomes

    value · exp(−√(a² + z² Σv)) … value · exp(√(b² + z² Σv)),    z the normal quantile of the level:

- parts: (B − 1) σ², if the estimates from quarters of the record scatter more than their bounds explain
  (Birge's ratio B > 1);
- forms: the variance that other forms add about the value, Σ_i p_i (σ_i² + (ln τ_i − ln τ)²) − σ², with their
  shares p_i of the evidence;
- free run: ½ (d² − σ² − σ_F²) with the distance d to the estimate from the free run, if the two estimates
  contradict each other at 95 % (variance between two methods, DerSimonian and Laird 1986);
- clocks: the variance due to offsets within their uncertainty, plus the square of the effect of the most
  likely offsets;
- sampling: s²/3, where s is the change of the estimate with half as many ambient readings: the error between
  the readings is taken as uniform within ±s.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from hygrokf.data.structured import optional
from hygrokf.estimation.confidence import normal_quantile
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.texts.terms import Name


@dataclass(frozen=True)
class AlternativeEstimate:
    """An estimate of the logarithm of a time constant from another form, part or method."""

    log_value: float
    variance: float
    weight: float = 1.0


@dataclass(frozen=True)
class CompositionStep:
    """The interval [h] after one source of uncertainty, which adds `sd_ln` [1] to the logarithm.

    The first step is the interval of the profile likelihood, which adds nothing.  `upper_h` of an open
    interval is NaN.
    """

    source: Name
    lower_h: float = math.nan
    upper_h: float = math.nan
    sd_ln: float = optional(math.nan)


def nan_if_open(bound: float) -> float:
    """A bound as in the results: NaN if it is infinite."""
    return bound if math.isfinite(bound) else math.nan


@dataclass(frozen=True)
class Resolved:
    """The range of time constants [h] that a record resolves: from a tenth of the median step between its
    readings to ten times its length."""

    shortest_h: float = 0.0
    longest_h: float = 1e300

    def bounds(self, lower_h: float, upper_h: float) -> tuple[float, float]:
        """Bounds as in the results: beyond the range they are open, 0 below and NaN above."""
        low, high = min(lower_h, self.longest_h), max(upper_h, self.shortest_h)
        return (low if low >= self.shortest_h else 0.0), (high if high <= self.longest_h else math.nan)

    def around(self, value_h: float, distance: float) -> tuple[float, float]:
        """Bounds at a distance [1] on either side of the logarithm of a value."""
        factor = math.exp(min(distance, LARGEST_EXPONENT))
        return self.bounds(value_h / factor, value_h * factor)


ANY_CONSTANT = Resolved()
LARGEST_EXPONENT = 600.0
"""[1] distance of a bound from the logarithm of its value, beyond which numbers overflow."""


def of_parts(scale: float, variance: float) -> float:
    """The variance that scattering parts add: `scale` is Birge's ratio, `variance` the variance of the
    logarithm according to the bounds."""
    return max(scale - 1.0, 0.0) * variance


def of_forms(log_value: float, variance: float, forms: Sequence[AlternativeEstimate]) -> float:
    """The variance that other forms add about the value."""
    total = sum(form.weight * (form.variance + (form.log_value - log_value) ** 2) for form in forms)
    return max(total - variance, 0.0)


def of_free_run(log_value: float, variance: float, free: AlternativeEstimate) -> float:
    """The variance that the estimate from the free run adds; 0 unless the two estimates contradict each other
    at the 95 % level."""
    difference, total_variance = free.log_value - log_value, variance + free.variance
    return (
        0.5 * (difference**2 - total_variance)
        if difference**2 > normal_quantile(CONFIDENCE) ** 2 * total_variance
        else 0.0
    )


def compose_interval(
    value: float,
    bounds: tuple[float, float],
    level: float,
    sources: Mapping[str, float],
    within: Resolved = ANY_CONSTANT,
) -> tuple[CompositionStep, ...]:
    """The interval of the profile likelihood [h], and the interval after each source; the last interval is
    the headline interval.

    bounds: [h] of the profile likelihood.  sources: name → variance [1] that the source adds to the
    logarithm.  An open side stays open, and a bound beyond `within` is open.
    """
    z, total = normal_quantile(level), 0.0
    steps = [CompositionStep("profile", *within.bounds(*bounds))]
    for name, variance in sources.items():
        total += variance
        ends = (_widened(value, bound, side, total) for bound, side in zip(bounds, (-z, z), strict=True))
        steps.append(CompositionStep(name, *within.bounds(*ends), math.sqrt(variance)))
    return tuple(steps)


def _widened(value: float, bound: float, z: float, variance: float) -> float:
    if bound <= 0 or math.isinf(bound):
        return bound
    distance = math.hypot(math.log(bound / value), z * math.sqrt(variance))
    return value * math.exp(math.copysign(min(distance, LARGEST_EXPONENT), z))
