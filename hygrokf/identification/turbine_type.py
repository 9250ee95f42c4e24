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
"""Endings of parameters that belong to a logger, not to a type of turbine."""
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
    """One parameter over K turbines, on the scale on which it is pooled (`logarithmic`: ln θ).

    `mean`, `se`: of the type, with its standard error (Hartung & Knapp).  `lower`, `upper`: 95 % bounds of
        the mean.
    `spread`: standard deviation τ between turbines.
    `next_sd`: standard deviation of the normal distribution with the 95 % prediction interval of a further
        turbine.
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
        """Check that the numbers are finite and consistent; raises ValueError."""
        numbers = (self.mean, self.se, self.lower, self.upper, self.spread, self.next_sd)
        if not all(map(math.isfinite, numbers)):
            raise ValueError(f"expected finite numbers, found {numbers}")
        if min(self.se, self.spread, self.next_sd) < 0.0 or not self.lower <= self.mean <= self.upper:
            raise ValueError("expected lower ≤ mean ≤ upper and se, spread, next_sd of 0 or more")
        if self.logarithmic and max(map(abs, (self.lower, self.upper))) > 300.0:
            raise ValueError(f"expected logarithms within ±300, found {self.lower:g} … {self.upper:g}")

    def in_unit(self) -> dict[str, float]:
        """Return value and bounds of the type, and bounds for the next turbine, in the parameter's unit."""
        half_width = 1.959964 * self.next_sd
        ends = [self.mean, self.lower, self.upper, self.mean - half_width, self.mean + half_width]
        if self.logarithmic:
            ends = [math.exp(end) for end in ends]
        return dict(zip(("value", "lower", "upper", "next_lower", "next_upper"), ends, strict=True))


@dataclass(frozen=True)
class TurbineType:
    """Parameters of a type of turbine, with their spread from turbine to turbine, and the model's design."""

    name: Name
    design: Design
    turbines: tuple[Name, ...]
    parameters: Mapping[Name, Pooled]
    version: Version = __version__

    def prior(self, design: Design | None = None) -> dict[str, Prior]:
        """Return priors for the parameters of the next turbine, for its design (by default the type's own).

        The levels of the heat release are moved to the design's reference temperature.  Pass the bound method
        to `identify(record, prior=TurbineType.prior)`.  Parameters of the design that the type lacks have no
        prior.
        """
        target_design = self.design if design is None else design
        reference_shift_K = reference_K(target_design) - reference_K(self.design)
        power_ratio = _scale_ratio(target_design, self.design)
        target_parameters = {p.name for p in target_design.model.parameters}
        priors = {}
        for name, pooled in self.parameters.items():
            if name not in target_parameters:
                continue
            mean, variance = pooled.mean, pooled.next_sd**2
            slope = self.parameters.get(AMBIENT_SLOPES.get(name, ""))
            if slope is not None:
                mean, variance = (
                    mean + reference_shift_K * slope.mean,
                    variance + (reference_shift_K * slope.next_sd) ** 2,
                )
            factor = power_ratio ** _power_of(name)
            priors[name] = Prior(mean * factor, math.sqrt(variance) * factor, pooled.logarithmic)
        return priors

    @property
    def values(self) -> dict[str, float]:
        """The type's value of every parameter of its design, in its unit; parameters that it lacks have their
        start value."""
        start_values = {p.name: p.start for p in self.design.model.parameters}
        return start_values | {
            name: p.in_unit()["value"] for name, p in self.parameters.items() if name in start_values
        }


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
    repeated_names = sorted({repeated for repeated in names if names.count(repeated) > 1})
    if repeated_names:
        faults.append(
            f"expected every turbine once, found several fits of {', '.join(repeated_names)}: keep one "
            "of each"
        )
    if faults:
        raise TypeFault("; ".join(faults))
    base = fits[0].design
    shared_parameters = {p.name: p for p in base.model.parameters if not p.name.endswith(OWN)}
    estimates: dict[str, list[tuple[float, float]]] = {name: [] for name in shared_parameters}
    for fit in fits:
        # neither parameters taken over from another turbine nor rejected time constants are evidence
        left_out = {n for n, row in fit.results.parameters.items() if row.fixed}
        left_out |= {
            PARAMETER_OF[part]
            for part, constant in inherited(fit.results).items()
            if constant.verdict == REJECT
        }
        for parameter, value, variance in _converted(base, fit):
            if parameter in shared_parameters and parameter not in left_out:
                estimate = _on_scale(shared_parameters[parameter], value, variance)
                estimates[parameter] += [] if estimate is None else [estimate]
    pooled = {}
    for parameter, pairs in estimates.items():
        if len(pairs) < FEWEST_TURBINES:
            continue
        means, variances = np.array(pairs).T
        mean, se, spread = random_effects(means, variances)
        half_width = student_quantile(0.95, len(means) - 1) * se
        prediction_half_width = student_quantile(
            0.95, min(len(means) - 1, max(len(means) - 2, 2))
        ) * math.hypot(spread, se)
        pooled[parameter] = Pooled(
            unit=shared_parameters[parameter].unit,
            logarithmic=shared_parameters[parameter].positive,
            mean=mean,
            se=se,
            lower=mean - half_width,
            upper=mean + half_width,
            spread=spread,
            next_sd=prediction_half_width / normal_quantile(0.95),
            turbines=len(means),
        )
    if not pooled:
        raise TypeFault(
            "expected parameters with a standard error in at least two of the fits, found none: check that "
            "the fits are of one type of turbine"
        )
    return TurbineType(name or f"type of {', '.join(names)}", base, tuple(names), pooled)


def random_effects(y: np.ndarray, v: np.ndarray) -> tuple[float, float, float]:
    """Pool estimates y (K,) with variances v (K,) over turbines.

    Returns the mean μ, its standard error after Hartung & Knapp, and the spread τ by REML.  The standard
    error is at least that of the usual random-effects mean: with few turbines that agree by chance, Hartung
    and Knapp's would be far too small.  Raises ValueError for fewer than two estimates or variances that are
    not above zero.
    """
    y, v = np.asarray(y, dtype=float), np.asarray(v, dtype=float)
    if len(y) < FEWEST_TURBINES or not np.all(v > 0) or not np.all(np.isfinite(y)):
        raise ValueError(
            f"expected at least {FEWEST_TURBINES} finite estimates with variances above 0, found {y} and {v}"
        )
    tau2 = restricted_maximum_likelihood(y, v)
    weights = 1.0 / (tau2 + v)
    mean = float(weights @ y / weights.sum())
    variance_scale = max(float(weights @ (y - mean) ** 2) / (len(y) - 1.0), 1.0)
    return mean, math.sqrt(variance_scale / float(weights.sum())), math.sqrt(tau2)


def restricted_maximum_likelihood(y: np.ndarray, v: np.ndarray) -> float:
    """Return τ² (≥ 0) that maximises the restricted likelihood −½ [Σ ln(τ²+v) + ln Σw + Σ w (y−μ)²].

    y, v: (K,) estimates and variances.  The likelihood may have two maxima, so the search covers a grid of
        zero and six decades of τ, followed by golden section.
    """
    from scipy.optimize import minimize_scalar

    def loss(tau: float) -> float:
        """Return −2 times the restricted log-likelihood at a spread τ."""
        w = 1.0 / (tau * tau + v)
        mean = w @ y / w.sum()
        return float(-np.log(w).sum() + math.log(w.sum()) + w @ (y - mean) ** 2)

    largest = max(2.0 * float(np.ptp(y)), 1e-12)
    grid = np.concatenate([[0.0], np.geomspace(1e-6, 1.0, 80) * largest])
    values = [loss(tau) for tau in grid]
    best = int(np.argmin(values))
    lower, upper = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    optimum = minimize_scalar(
        loss, bounds=(lower, upper), method="bounded", options={"xatol": 1e-9 * largest}
    )
    return float(optimum.x) ** 2 if optimum.fun < values[0] else 0.0


# --- one design's parameters in another's terms ----------------------------------------------


def reference_K(design: Design) -> float:
    """Return the ambient temperature [K] to which the levels of a design's heat release refer."""
    for name, settings in design.mechanisms:
        if name == "heat_release":
            return float(settings.get("reference_K", 283.15))
    return 283.15


def _power_of(name: str) -> int:
    """Return the exponent of the relative power that a coefficient multiplies; 0 for other parameters."""
    order = name.removeprefix("heat_release_power_")
    return int(order) if order.isdecimal() else 0


def _scale_ratio(target: Design, origin: Design) -> float:
    """Return the ratio of two designs' power scales, by which coefficients of the relative power are
    converted."""
    if target.power_scale_W is None or origin.power_scale_W is None:
        return 1.0
    return target.power_scale_W / origin.power_scale_W


def _converted(base: Design, fit: Fit) -> list[tuple[str, float, float]]:
    """Return (name, value, variance) of a fit's parameters in terms of another design `base`.

    The designs may differ in reference temperature and power scale.
    """
    names, matrix = fit.covariance
    conversion = np.eye(len(names))
    reference_shift_K, power_ratio = (
        reference_K(base) - reference_K(fit.design),
        _scale_ratio(base, fit.design),
    )
    values = np.array([fit.values[name] for name in names])
    for i, name in enumerate(names):
        slope = AMBIENT_SLOPES.get(name)
        if slope in names:
            conversion[i, names.index(slope)] = reference_shift_K
        conversion[i] *= power_ratio ** _power_of(name)
    return list(zip(names, conversion @ values, np.diag(conversion @ matrix @ conversion.T), strict=True))


def _on_scale(parameter: Parameter, value: float, variance: float) -> tuple[float, float] | None:
    """Return estimate and variance on the scale on which a parameter is pooled; None without a usable
    standard error."""
    if not (math.isfinite(value) and variance > 0) or (parameter.positive and value <= 0):
        return None
    if not parameter.positive:
        return value, variance
    return (math.log(value), variance / value**2) if variance < 9.0 * value**2 else None


# --- on disk ---------------------------------------------------------------------------------


def write_type(turbine_type: TurbineType, path: str | os.PathLike[str]) -> Path:
    """Write a type of turbine as JSON, atomically.  Raises OSError from the system."""
    return write_text_whole(path, result_text(turbine_type))


def read_type(path: str | os.PathLike[str], library: Library = LIBRARY) -> TurbineType:
    """Read a type of turbine from its file.  Raises ResultFault that lists everything wrong.

    library: with the mechanisms of its model.
    """
    turbine_type = read_result(TurbineType, Path(path), "hygrokf transfer")
    return replace(turbine_type, design=replace(turbine_type.design, library=library))


def is_type(path: str | os.PathLike[str]) -> bool:
    """Whether a JSON file holds a type of turbine rather than a fit."""
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(data, dict) and "turbines" in data
