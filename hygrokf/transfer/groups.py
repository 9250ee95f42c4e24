"""Groups of parameters that travel from turbine to turbine together, and which of them differ between two
estimates.

With δ = z₁ − z₀ the difference of two independent estimates in the parameters' coordinates, Σ = V₁ + V₀ its
covariance and S the groups that may differ, the equality of the others leaves unexplained

    Q(S) = min_Δ (δ − D_S Δ)' Σ⁻¹ (δ − D_S Δ),

D_S the columns of the identity that belong to S.  Where all groups outside S ∪ {G} are shared, Q(S) − Q(S ∪
{G}) is χ² with as many degrees of freedom as G has parameters: the likelihood ratio of two quadratic
likelihoods.  Groups are added to S one by one, the most significant first, as long as its p times the number
of groups left is below the level (Holm 1979; Bonferroni within a step).

Shapes: d parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.estimation.confidence import normal_quantile, positive_inverse
from hygrokf.physics.model import Model

THERMAL = "thermal time constant"
HEAT = "heat release"
HYGRIC = "hygric exchange"
OFFSETS = "sensor offsets"
DISTURBANCES = "disturbances"
UNKNOWN = "not known to the type"
OF_THE_RECORD = (OFFSETS, DISTURBANCES, UNKNOWN)
"""Groups that belong to a logger, a site and a season, not to a type of cabinet: every record has its own."""
LEVEL = 0.05
_BASE = {"thermal_network": THERMAL, "heat_release": HEAT, "hygric_exchange": HYGRIC}
_OFFSETS = ("_bias", "_offset")


def group_of(model: Model) -> dict[str, str]:
    """Group of every parameter of a model; mechanisms beside the base models are groups of their own."""
    found = {}
    for mechanism in model.mechanisms:
        for p in mechanism.parameters:
            if p.name.endswith(_OFFSETS):
                group = OFFSETS
            elif p.noise:
                group = DISTURBANCES
            else:
                group = _BASE.get(mechanism.name, mechanism.name.replace("_", " "))
            found[p.name] = group
    return found


def members(groups: Mapping[str, str], *chosen: str) -> tuple[str, ...]:
    """Names of the parameters of some groups."""
    return tuple(name for name, group in groups.items() if group in chosen)


@dataclass(frozen=True)
class Difference:
    """Difference of two estimates (d,) in the coordinates of `names`, with the covariance (d, d) of the
    difference."""

    names: tuple[str, ...]
    value: np.ndarray
    covariance: np.ndarray

    def of(self, names: Sequence[str]) -> Difference:
        """The difference of some of the parameters, whatever the others do."""
        place = [self.names.index(name) for name in names if name in self.names]
        return Difference(
            tuple(self.names[i] for i in place), self.value[place], self.covariance[np.ix_(place, place)]
        )

    def bounds(self, name: str, level: float = 0.95) -> tuple[float, float, float]:
        """Difference of one parameter in its coordinate: (value, lower, upper)."""
        i = self.names.index(name)
        reach = normal_quantile(level) * math.sqrt(max(self.covariance[i, i], 0.0))
        return float(self.value[i]), float(self.value[i] - reach), float(self.value[i] + reach)


@dataclass(frozen=True)
class SelectionStep:
    """One step of the selection: each group's statistic beside the groups selected before, and the group that
    it selects, if any."""

    statistic: Mapping[str, float]
    degrees: Mapping[str, int]
    p: Mapping[str, float]
    p_adjusted: Mapping[str, float]
    selected: str | None


def unexplained(found: Difference, differing: Sequence[str]) -> float:
    """Q(S): the squared distance that remains when the parameters `differing` may differ and all others are
    equal."""
    others = [i for i, name in enumerate(found.names) if name not in set(differing)]
    if not others:
        return 0.0
    value = found.value[others]
    return float(value @ positive_inverse(found.covariance[np.ix_(others, others)]) @ value)


def selection(found: Difference, groups: Mapping[str, str]) -> tuple[SelectionStep, ...]:
    """Forward selection of the groups that differ; the last step selects none, unless all are selected."""
    from scipy.stats import chi2

    left = list(dict.fromkeys(groups[name] for name in found.names))
    selected: list[str] = []
    steps: list[SelectionStep] = []
    while left:
        rest = unexplained(found, [n for n in found.names if groups[n] in selected])
        statistic, degrees, p = {}, {}, {}
        for group in left:
            wider = [n for n in found.names if groups[n] in (*selected, group)]
            statistic[group] = max(rest - unexplained(found, wider), 0.0)
            degrees[group] = sum(groups[n] == group for n in found.names)
            p[group] = float(chi2.sf(statistic[group], degrees[group]))
        adjusted = {group: min(1.0, value * len(left)) for group, value in p.items()}
        # p of large statistics underflows to zero: the mean square decides then
        best = min(left, key=lambda group: (p[group], -statistic[group] / degrees[group]))
        hit = adjusted[best] < LEVEL
        steps.append(SelectionStep(statistic, degrees, p, adjusted, best if hit else None))
        if not hit:
            break
        selected.append(best)
        left.remove(best)
    return tuple(steps)
