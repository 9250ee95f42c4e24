"""Common parameters of several turbines of one type, and their spread from turbine to turbine.

Random effects, parameter by parameter, with y_i the estimate of turbine i on its scale (ln θ for positive
parameters, θ otherwise), v_i its squared standard error and K turbines:

    y_i = μ + b_i + e_i,    b_i ~ N(0, τ²),    e_i ~ N(0, v_i),
    w_i = 1/(τ² + v_i),    μ = Σ w_i y_i / Σ w_i,

τ² by restricted maximum likelihood, bounds of μ after Hartung & Knapp (Student's t with K−1 degrees of
freedom), and for the next turbine's own value the prediction μ ± t √(τ² + se²) with K−2 degrees of freedom;
with fewer than four turbines K−1, since a single degree of freedom would make the prediction uninformative.

Sources: Viechtbauer 2005, doi:10.3102/10769986030003261 (REML); Hartung & Knapp 2001, doi:10.1002/sim.1009;
Higgins, Thompson & Spiegelhalter 2009, doi:10.1111/j.1467-985X.2008.00552.x (prediction).
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hygrokf.data.files import write_text_whole
from hygrokf.data.result_file import read_result, result_text
from hygrokf.errors import HygrokfError
from hygrokf.estimation.confidence import normal_quantile, student_quantile
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.identification.fit import Fit
from hygrokf.identification.verdict import inherited
from hygrokf.identification.verdict_terms import PARAMETER_OF
from hygrokf.modelling.design import Design
from hygrokf.modelling.library import LIBRARY, Library
from hygrokf.physics.parameters import Parameter, Prior
from hygrokf.texts.reasons import REJECT
from hygrokf.texts.terms import Name, Unit, Version
from hygrokf.version import __version__

FEWEST_TURBINES = 2
"""Fewest turbines that make a type."""
OWN = ("_bias", "_offset", "_noise")
"""Suffixes of parameters that belong to a logger and not to a type of turbine."""
AMBIENT_SLOPES = {
    "heat_release_operation": "heat_release_operation_ambient",
    "heat_release_standstill": "heat_release_standstill_ambient",
}
"""Level of the heat release at the design's reference temperature → its derivative by the ambient
temperature."""


class TypeFault(HygrokfError, ValueError):
    """Fits that cannot make a type: all reasons in one message."""


@dataclass(frozen=True)
class Pooled:
    """One parameter over K turbines, on its scale (`logarithmic`: ln θ).

    `mean`, `se` of the type with its standard error (Hartung & Knapp); `lower`, `upper` 95 % bounds of the
    mean; `spread` the standard deviation τ between turbines; `next_sd` the standard deviation of the normal
    distribution that has the 95 % prediction interval of a further turbine.
    """

    unit: Unit
    logarithmic: bool
    mean: float
    se: float
    lower: float
    upper: float
    spread: float
    next_sd: float
    turbines: int

    def __post_init__(self) -> None:
        numbers = (self.mean, self.se, self.lower, self.upper, self.spread, self.next_sd)
        if not all(map(math.isfinite, numbers)):
            raise ValueError(f"expected finite numbers, found {numbers}")
        if min(self.se, self.spread, self.next_sd) < 0.0 or not self.lower <= self.mean <= self.upper:
            raise ValueError("expected lower ≤ mean ≤ upper and se, spread, next_sd of 0 or more")
        if self.logarithmic and max(map(abs, (self.lower, self.upper))) > 300.0:
            raise ValueError(f"a logarithm of {self.mean:g} is no parameter's")

    def in_unit(self) -> dict[str, float]:
        """Value and bounds of the type, and bounds of the next turbine's own value, in the parameter's
        unit."""
        reach = 1.959964 * self.next_sd
        ends = [self.mean, self.lower, self.upper, self.mean - reach, self.mean + reach]
        if self.logarithmic:
            ends = [math.exp(v) for v in ends]
        return dict(zip(("value", "lower", "upper", "next_lower", "next_upper"), ends, strict=True))


@dataclass(frozen=True)
class TurbineType:
    """Parameters of a type of turbine with their spread from turbine to turbine, and their design."""

    name: Name
    design: Design
    turbines: tuple[Name, ...]
    parameters: Mapping[Name, Pooled]
    version: Version = __version__

    def prior(self, design: Design | None = None) -> dict[str, Prior]:
        """Priors of the next turbine's parameters for its design (by default this type's own).

        The levels of the heat release are moved to the design's reference temperature.  Pass the bound method
        to `identify(record, prior=TurbineType.prior)`.  Parameters of the design that the type lacks have no
        prior.
        """
        wanted = self.design if design is None else design
        shift = reference_K(wanted) - reference_K(self.design)
        ratio = _scale_ratio(wanted, self.design)
        known = {p.name for p in wanted.model.parameters}
        found = {}
        for name, pooled in self.parameters.items():
            if name not in known:
                continue
            mean, variance = pooled.mean, pooled.next_sd**2
            slope = self.parameters.get(AMBIENT_SLOPES.get(name, ""))
            if slope is not None:
                mean, variance = mean + shift * slope.mean, variance + (shift * slope.next_sd) ** 2
            factor = ratio ** _power_of(name)
            found[name] = Prior(mean * factor, math.sqrt(variance) * factor, pooled.logarithmic)
        return found

    @property
    def values(self) -> dict[str, float]:
        """The type's value of every parameter of its design, in its unit; the start value of parameters that
        the type lacks."""
        found = {p.name: p.start for p in self.design.model.parameters}
        return found | {name: p.in_unit()["value"] for name, p in self.parameters.items() if name in found}


def pool_types(fits: Sequence[Fit], name: str = "") -> TurbineType:
    """The type of several turbines from their fits, each weighted by its own covariance.

    The design is that of the first fit.  Left out are parameters of loggers (offsets, noise of a reading),
    parameters that a fit took over from another one (marked as fixed), rejected time constants, and
    parameters with a standard error in fewer than two of the fits.  Raises TypeFault where fewer than two
    fits are given, where the same turbine is given twice, or where nothing is left.
    """
    faults = []
    if len(fits) < FEWEST_TURBINES:
        faults.append(
            f"expected the fits of at least {FEWEST_TURBINES} turbines, found {len(fits)}: fit more turbines"
        )
    names = [fit.name for fit in fits]
    twice = sorted({one for one in names if names.count(one) > 1})
    if twice:
        faults.append(
            f"expected every turbine once, found several fits of {', '.join(twice)}: leave the others out"
        )
    if faults:
        raise TypeFault("; ".join(faults))
    base = fits[0].design
    known = {p.name: p for p in base.model.parameters if not p.name.endswith(OWN)}
    estimates: dict[str, list[tuple[float, float]]] = {name: [] for name in known}
    for fit in fits:
        # neither parameters taken over from another turbine nor rejected time constants are evidence
        left_out = {n for n, row in fit.results.parameters.items() if row.fixed}
        left_out |= {
            PARAMETER_OF[part] for part, one in inherited(fit.results).items() if one.verdict == REJECT
        }
        for parameter, value, variance in _converted(base, fit):
            if parameter in known and parameter not in left_out:
                pair = _on_scale(known[parameter], value, variance)
                estimates[parameter] += [] if pair is None else [pair]
    found = {}
    for parameter, pairs in estimates.items():
        if len(pairs) < FEWEST_TURBINES:
            continue
        y, v = np.array(pairs).T
        mean, se, spread = random_effects(y, v)
        reach = student_quantile(CONFIDENCE, len(y) - 1) * se
        ahead = student_quantile(CONFIDENCE, min(len(y) - 1, max(len(y) - 2, 2))) * math.hypot(spread, se)
        found[parameter] = Pooled(
            unit=known[parameter].unit,
            logarithmic=known[parameter].positive,
            mean=mean,
            se=se,
            lower=mean - reach,
            upper=mean + reach,
            spread=spread,
            next_sd=ahead / normal_quantile(CONFIDENCE),
            turbines=len(y),
        )
    if not found:
        raise TypeFault(
            "expected parameters that at least two of the fits know with a standard error, found none: are "
            "these fits of one type of turbine?"
        )
    return TurbineType(name or f"type of {', '.join(names)}", base, tuple(names), found)


def random_effects(y: np.ndarray, v: np.ndarray) -> tuple[float, float, float]:
    """Mean μ, its standard error after Hartung & Knapp, and spread τ by REML of estimates y (K,) with
    variances v (K,).

    The standard error is at least that of the usual random-effects mean: with few turbines that agree by
    chance, Hartung and Knapp's would be far too small.  Raises ValueError for fewer than two estimates or
    variances that are not above zero.
    """
    y, v = np.asarray(y, dtype=float), np.asarray(v, dtype=float)
    if len(y) < FEWEST_TURBINES or not np.all(v > 0) or not np.all(np.isfinite(y)):
        raise ValueError(
            f"expected at least {FEWEST_TURBINES} finite estimates with variances above 0, found {y} and {v}"
        )
    tau2 = restricted_maximum_likelihood(y, v)
    w = 1.0 / (tau2 + v)
    mean = float(w @ y / w.sum())
    scale = max(float(w @ (y - mean) ** 2) / (len(y) - 1.0), 1.0)
    return mean, math.sqrt(scale / float(w.sum())), math.sqrt(tau2)


def restricted_maximum_likelihood(y: np.ndarray, v: np.ndarray) -> float:
    """τ² (≥ 0) that maximises the restricted likelihood −½ [Σ ln(τ²+v) + ln Σw + Σ w (y−μ)²].

    The likelihood may have two maxima, so the search covers a grid of zero and six decades of τ, followed by
    golden section.
    """
    from scipy.optimize import minimize_scalar

    def loss(tau: float) -> float:
        w = 1.0 / (tau * tau + v)
        mean = w @ y / w.sum()
        return float(-np.log(w).sum() + math.log(w.sum()) + w @ (y - mean) ** 2)

    top = max(2.0 * float(np.ptp(y)), 1e-12)
    grid = np.concatenate([[0.0], np.geomspace(1e-6, 1.0, 80) * top])
    values = [loss(tau) for tau in grid]
    best = int(np.argmin(values))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    found = minimize_scalar(loss, bounds=(low, high), method="bounded", options={"xatol": 1e-9 * top})
    return float(found.x) ** 2 if found.fun < values[0] else 0.0


# --- one design's parameters in another's terms ----------------------------------------------


def reference_K(design: Design) -> float:
    """The ambient temperature [K] to which the levels of the heat release refer."""
    for name, settings in design.mechanisms:
        if name == "heat_release":
            return float(settings.get("reference_K", 283.15))
    return 283.15


def _power_of(name: str) -> int:
    """The exponent of the relative power that a coefficient belongs to; 0 for other parameters."""
    order = name.removeprefix("heat_release_power_")
    return int(order) if order.isdecimal() else 0


def _scale_ratio(wanted: Design, given: Design) -> float:
    """Ratio by which a coefficient of the relative power changes from one design's power scale to
    another's."""
    if wanted.power_scale_W is None or given.power_scale_W is None:
        return 1.0
    return wanted.power_scale_W / given.power_scale_W


def _converted(base: Design, fit: Fit) -> list[tuple[str, float, float]]:
    """(name, value, variance) of a fit's parameters, converted to another design's reference temperature and
    power scale."""
    names, matrix = fit.covariance
    change = np.eye(len(names))
    shift, ratio = reference_K(base) - reference_K(fit.design), _scale_ratio(base, fit.design)
    values = np.array([fit.values[name] for name in names])
    for i, name in enumerate(names):
        slope = AMBIENT_SLOPES.get(name)
        if slope in names:
            change[i, names.index(slope)] = shift
        change[i] *= ratio ** _power_of(name)
    return list(zip(names, change @ values, np.diag(change @ matrix @ change.T), strict=True))


def _on_scale(parameter: Parameter, value: float, variance: float) -> tuple[float, float] | None:
    """Estimate and variance on the parameter's scale; None without a usable standard error."""
    if not (math.isfinite(value) and variance > 0) or (parameter.positive and value <= 0):
        return None
    if not parameter.positive:
        return value, variance
    return (math.log(value), variance / value**2) if variance < 9.0 * value**2 else None


# --- on disk ---------------------------------------------------------------------------------


def write_type(turbine_type: TurbineType, path: str | os.PathLike[str]) -> Path:
    """Write a type as JSON, atomically.  Raises OSError from the system."""
    return write_text_whole(path, result_text(turbine_type))


def read_type(path: str | os.PathLike[str], library: Library = LIBRARY) -> TurbineType:
    """A type from its file.  Raises ResultFault with everything that is wrong.

    library: with the mechanisms of its model.
    """
    found = read_result(TurbineType, Path(path), "hygrokf transfer")
    return replace(found, design=replace(found.design, library=library))


def is_type(path: str | os.PathLike[str]) -> bool:
    """Whether a JSON file holds a type of turbine rather than a fit."""
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(data, dict) and "turbines" in data
