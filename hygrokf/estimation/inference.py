"""Bounds of any parameter, time constants and a table of parameters of any model, from a likelihood and its
estimate.

`identify` uses these functions for a cabinet's two constants; here they are available for a user's own model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.errors import suggestion
from hygrokf.estimation.confidence import (
    FLAT_SE,
    OPEN_VARIANCE,
    Bounds,
    Uncertainty,
    expect_level,
    largest_se,
    normal_quantile,
    positive_inverse,
    scaled_spectrum,
    standard_error,
    uncertainty,
    wald_bounds,
)
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.estimation.joint_likelihood import AnyLikelihood, records_of
from hygrokf.estimation.newton_steps import natural_units
from hygrokf.estimation.optimiser import Estimate, Objective, shortened
from hygrokf.estimation.profile_likelihood import profile
from hygrokf.estimation.subject import Given, Source, estimated
from hygrokf.physics.parameters import Coordinates, Parameter

if TYPE_CHECKING:
    from pandas import DataFrame

BOUND_METHODS = ("profile", "likelihood-ratio", "wald", "sandwich")
COORDINATE_STEP = 1e-5
"""Step of the coordinates, in their natural units, in central differences of the Jacobian, whose error is of
the order of its square."""
ALIKE = 1e-6
"""[1] product of the normalised left and right eigenvectors below which two eigenvalues count as equal."""
POOR = 0.1
"""[1] eigenvalue of the information scaled to a diagonal of ones, below which its parameters form a group:
each alone is known three times worse than with the others given."""
GROUP_SHARE = 0.25
"""[1] least share of such an eigenvector with which a parameter belongs to the group."""
DROPPED = 0.5
"""[1] share of its threshold by which the likelihood must have dropped at a bound by the delta method; where
it has not, the bound is open."""


def confidence_intervals(
    source: Source,
    given: Given | None = None,
    names: str | Sequence[str] | None = None,
    method: str = "profile",
    level: float = CONFIDENCE,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Bounds]:
    """Bounds of free parameters by one method, by default of all of them.

    source, given: a `Likelihood` and the `Estimate` that `fit_mle` made of it; or a `Fit` and its `Record`,
        where the likelihood of the whole model is first climbed to its maximum from the fit's values.
    names: of the parameters, or one name.
    method: "profile" re-estimates all other parameters along the way, with a threshold widened by the
        sandwich factor (`profile_likelihood.profile`); "likelihood-ratio" does so with the plain threshold;
        "wald" uses the observed information; "sandwich" uses the covariance that remains valid under a wrong
        model.  The last two are symmetric in the parameter's coordinate, which is the logarithm of a positive
        parameter.
    level: [1] of confidence, between 0 and 1.
    progress: called with a sentence before each end of a profile; an end takes at most `WALK_PASSES` scores.

    Returns `lower` and `upper` by name, in the parameters' units.  Where an end is open they are 0 and
    infinity, or the limits of the search of a parameter that is not positive, and `statements` say why.
    Raises ValueError for an unknown method or level, for names that are not free parameters, and for other
    kinds of `source` or `given`, with the call that makes the expected kind.
    """
    likelihood, estimate = estimated("confidence_intervals", source, given)
    free = estimate.coordinates.names
    wanted = free if names is None else (names,) if isinstance(names, str) else tuple(names)
    unknown = [f"{name}{suggestion(name, free, 1)}" for name in wanted if name not in free]
    if unknown:
        raise ValueError(f"names: expected free parameters, {', '.join(free)}, found {', '.join(unknown)}")
    if method not in BOUND_METHODS:
        near = suggestion(str(method), BOUND_METHODS, 1)
        raise ValueError(f"method: expected one of {', '.join(BOUND_METHODS)}, found {method!r}{near}")
    expect_level(level)
    objective = Objective(likelihood, estimate.coordinates).at(estimate.z)
    spread = uncertainty(objective, estimate)
    if method in ("wald", "sandwich"):
        return {name: wald_bounds(estimate, spread, name, level, method) for name in wanted}

    bounds = {}
    for count, name in enumerate(wanted, 1):
        place = f"{count} of {len(wanted)}: "
        report = None if progress is None else lambda text, place=place: progress(place + text)
        bounds[name] = profile(objective, estimate, spread, name, level, report, method == "profile")
    return bounds


@dataclass(frozen=True)
class ModalTimeConstant:
    """One time constant of a linear, or linearised, model [h], with bounds by the delta method.

    `value` τ = −1/Re λ of an eigenvalue λ of the Jacobian; infinite where Re λ ≥ 0 (no decay).  `lower` and
    `upper` at the `level`, symmetric in ln τ; NaN where two eigenvalues coincide; 0 and infinity where they
    are open, as the parameters of the mode are not determined, or the likelihood has not dropped there.
    `period` 2π/|Im λ| of an oscillation, else infinite. `states`: shares [1] of the states in the mode
    (participation factors), largest first.
    """

    value: float
    lower: float
    upper: float
    level: float
    period: float
    states: Mapping[str, float]


def modal_time_constants(
    source: Source,
    given: Given | None = None,
    level: float = CONFIDENCE,
    state: Mapping[str, float] | None = None,
    inputs: Mapping[str, float] | None = None,
    known: Uncertainty | None = None,
) -> tuple[ModalTimeConstant, ...]:
    """Time constants of a model at its estimate, slowest first; one for each pair of conjugate eigenvalues.

        A v = λ v,    dλ/dz_j = w' (dA/dz_j) v / (w' v),    Var ln τ = g' V g,  g_j = −d Re λ/dz_j / Re λ,

    with the Jacobian A (n, n) [1/h], its left and right eigenvectors w and v, and the covariance V of the
    coordinates z, the wider of Wald and sandwich.  Parameters at a bound count as known.

    source, given: as `confidence_intervals` takes them.
    level: [1] of confidence, between 0 and 1.
    state, inputs: where a nonlinear model is linearised, in the model's units; values not given there are the
        means of the filtered states and the medians of the inputs over the record.
    known: the estimate's uncertainty, if already computed.

    Returns values with bounds [h] and the states that take part.
    Raises ValueError for names that the model does not have.

    Source: Golub & Van Loan, Matrix Computations, section 7.2.2 (derivatives of eigenvalues); Pérez-Arriaga,
    Verghese & Schweppe 1982 (participation factors).
    """
    from scipy.linalg import eig

    expect_level(level)
    likelihood, estimate = estimated("modal_time_constants", source, given)
    at_state, at_inputs = operating_point(likelihood, estimate.values, state or {}, inputs or {})
    coordinates, z = estimate.coordinates, estimate.z
    objective = Objective(likelihood, coordinates).at(estimate.z)
    known = known or uncertainty(objective, estimate)
    inside = [coordinates.names.index(name) for name in known.names]

    def matrix(point: np.ndarray) -> np.ndarray:
        return likelihood.jacobian(coordinates.values(point), at_state, at_inputs).astype(float)

    slopes = []
    for place, step in zip(inside, COORDINATE_STEP * natural_units(coordinates)[inside], strict=True):
        moved = step * (np.arange(len(z)) == place)
        slopes.append((matrix(z + moved) - matrix(z - moved)) / (2.0 * step))
    values, left, right = eig(matrix(z), left=True, right=True)
    rounding = len(values) * np.finfo(float).eps * float(np.abs(values).max(initial=0.0))
    constants = []
    for k in np.flatnonzero(values.imag >= 0.0):
        w, v = left[:, k].conj(), right[:, k]
        overlap = w @ v
        rate = float(values[k].real)
        shares = np.abs(w * v)
        participation = dict(zip(likelihood.model.states, (shares / shares.sum()).tolist(), strict=True))
        ordered = dict(sorted(participation.items(), key=lambda pair: -pair[1]))
        period = 2.0 * math.pi / float(values[k].imag) if values[k].imag > 0.0 else math.inf
        if rate >= -rounding:
            constants.append(ModalTimeConstant(math.inf, math.inf, math.inf, level, period, ordered))
            continue
        value, lower, upper = -1.0 / rate, math.nan, math.nan
        if abs(overlap) > ALIKE:
            slope = np.array([-((w @ s @ v) / overlap).real / rate for s in slopes])
            lower, upper = _delta_bounds(value, slope, objective, estimate, known, level)
        constants.append(ModalTimeConstant(value, lower, upper, level, period, ordered))
    return tuple(sorted(constants, key=lambda constant: -constant.value))


def _delta_bounds(
    value: float,
    slope: np.ndarray,
    objective: Objective,
    estimate: Estimate,
    known: Uncertainty,
    level: float,
) -> tuple[float, float]:
    """Bounds of a positive value by the delta method, from the slope (f,) of its logarithm along the f
    coordinates inside their bounds.

    Both ends stay open, 0 and infinity, where the logarithm has a standard error above `FLAT_SE`.  One end
    stays open where the likelihood, at the coordinates that the delta method assigns to this end, has dropped
    by less than `DROPPED` of its threshold: there it is so far from a parabola that the standard error says
    nothing about this side.
    """
    along = known.wider @ slope if len(slope) else slope
    sd = math.sqrt(max(float(slope @ along), 0.0))
    if sd == 0.0:
        return value, value
    if not sd <= FLAT_SE:
        return 0.0, math.inf
    coordinates, quantile = estimate.coordinates, normal_quantile(level)
    inside = [coordinates.names.index(name) for name in known.names]
    lowest, highest = np.array([p.lifted_limits() for p in coordinates.free]).T

    def end(standard_errors: float, open_end: float) -> float:
        moved = estimate.z.copy()
        moved[inside] += standard_errors / sd * along
        drop = estimate.objective - objective.value(np.clip(moved, lowest, highest))
        has_dropped = 2.0 * drop >= DROPPED * standard_errors**2
        return value * math.exp(standard_errors * sd) if has_dropped else open_end

    return end(-quantile, 0.0), end(quantile, math.inf)


def operating_point(
    likelihood: AnyLikelihood,
    values: Mapping[str, float],
    state: Mapping[str, float],
    inputs: Mapping[str, float],
) -> tuple[np.ndarray, dict[str, float]]:
    """State (n,) and inputs at which a model is linearised."""
    model, records = likelihood.model, records_of(likelihood, values)
    for kind, given, known_names in (("state", state, model.states), ("inputs", inputs, model.inputs)):
        unknown = [
            f"{name}{suggestion(name, known_names, 1)}" for name in sorted(set(given) - set(known_names))
        ]
        if unknown:
            raise ValueError(
                f"{kind}: expected names of {', '.join(known_names)}, found {', '.join(unknown)}"
            )
    mean = np.concatenate(
        [likelihood_of_record.trace(record_values).mean for likelihood_of_record, record_values in records]
    ).mean(axis=0)
    point = np.array([state.get(name, float(m)) for name, m in zip(model.states, mean, strict=True)])
    lines = [likelihood_of_record.timeline for likelihood_of_record, _ in records]
    medians = {
        name: float(np.median(np.concatenate([t.input(name) for t in lines]))) for name in model.inputs
    }
    return point, {**medians, **inputs}


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter of a table: `value`, `standard_error`, `lower`, `upper` in its `unit`; `prior` (mean, sd)
    in its unit, or None; `at`: "lower" or "upper" limit of its search, "fixed", or "" inside.

    The standard error is NaN, and the bounds are open, where the readings do not determine it.
    """

    name: str
    unit: str
    value: float
    standard_error: float
    lower: float
    upper: float
    prior: tuple[float, float] | None
    at: str


@dataclass(frozen=True)
class Combination:
    """A combination Σ c_j z_j of coordinates with `weights` c_j, the largest of which is 1, and its
    `standard_error`; `determined`: whether the readings determine it.

    Where all are positive, as `product` says, it is the logarithm of the product of powers that `text`
    writes.
    """

    text: str
    weights: Mapping[str, float]
    standard_error: float
    product: bool
    determined: bool

    def __str__(self) -> str:
        if not self.determined:
            return f"{self.text} is not determined"
        size = f"{100.0 * self.standard_error:.2g} %" if self.product else f"± {self.standard_error:.2g}"
        return f"{self.text} is known to {size}"


@dataclass(frozen=True, repr=False)
class ParameterTable:
    """All parameters of a model at an estimate; `correlation` (f, f) of the coordinates of the `names` inside
    their bounds; `combinations` of those that are known far better together than alone, best known first;
    bounds at the `level`."""

    rows: tuple[ParameterEstimate, ...]
    names: tuple[str, ...]
    correlation: np.ndarray
    combinations: tuple[Combination, ...]
    level: float

    def to_frame(self) -> DataFrame:
        """One row a parameter, by name."""
        import pandas as pd

        return pd.DataFrame([asdict(row) for row in self.rows]).set_index("name")

    def __repr__(self) -> str:
        head = ("parameter", "value", "± se", f"{100.0 * self.level:g} % bounds", "unit", "")
        cells = [head, *(_cells(row) for row in self.rows)]
        widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
        lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in cells]
        return "\n".join(
            shortened(lines) + shortened([str(combination) for combination in self.combinations], 8)
        )


def _cells(row: ParameterEstimate) -> tuple[str, ...]:
    """The cells of one row of the printed table."""
    prior = "" if row.prior is None else f"prior {row.prior[0]:.4g} ± {row.prior[1]:.2g}"
    at = f"at its {row.at} limit" if row.at in ("lower", "upper") else row.at
    is_known = math.isfinite(row.standard_error)
    return (
        row.name,
        f"{row.value:.5g}",
        f"{row.standard_error:.2g}" if is_known else "",
        "" if row.at else f"{row.lower:.4g} … {row.upper:.4g}" if is_known else "not identifiable",
        row.unit,
        ", ".join(filter(None, (at, prior))),
    )


def parameter_table(source: Source, given: Given | None = None, level: float = CONFIDENCE) -> ParameterTable:
    """Values, standard errors, bounds, correlations and identifiable combinations of a model's parameters.

    source, given: as in `confidence_intervals`.
    level: [1] of confidence, between 0 and 1, of Wald's bounds with the wider of both covariances.

    Groups of parameters that trade against each other are the eigenvectors with small eigenvalues of the
    observed information scaled to a diagonal of ones; the combinations are the eigenvectors of the
    correlation of such a group.

    Returns the table, in the parameters' units.  Raises ValueError for a level outside 0 … 1, and as
    `confidence_intervals` does.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: expected a probability between 0 and 1, found {level}")
    likelihood, estimate = estimated("parameter_table", source, given)
    coordinates = estimate.coordinates
    spread = uncertainty(Objective(likelihood, coordinates), estimate)
    rows = []
    for p in coordinates.parameters:
        value = estimate.values[p.name]
        prior = None if p.prior is None else p.prior.in_unit()
        if p.name not in spread.names:
            free = p.name in coordinates.names
            at = ("lower" if value - p.lower < p.upper - value else "upper") if free else "fixed"
            rows.append(ParameterEstimate(p.name, p.unit, value, math.nan, math.nan, math.nan, prior, at))
            continue
        b = wald_bounds(estimate, spread, p.name, level)
        se = standard_error(estimate, spread, p.name)
        rows.append(ParameterEstimate(p.name, p.unit, value, se, b.lower, b.upper, prior, ""))
    sd = np.sqrt(np.diag(spread.wald))
    correlation = spread.wald / np.outer(sd, sd)
    return ParameterTable(tuple(rows), spread.names, correlation, _combinations(coordinates, spread), level)


def _combinations(coordinates: Coordinates, spread: Uncertainty) -> tuple[Combination, ...]:
    """Combinations of the parameters of each group that trade against each other, best known first.

    Groups come from eigenvectors of the scaled information with eigenvalues below `POOR`; those that share a
    parameter are joined.  The combinations of a group are the eigenvectors of its correlation.
    """
    parameters = [coordinates.parameter(name) for name in spread.names]
    places = [coordinates.names.index(name) for name in spread.names]
    curvature = spread.curvature[np.ix_(places, places)]
    _, values, vectors = scaled_spectrum(curvature)
    # beside the variances along open directions, those of what is determined would be lost to rounding
    determined = positive_inverse(curvature, spread.open)
    groups: list[set[int]] = []
    for vector in vectors.T[values < POOR]:
        group = set(np.flatnonzero(np.abs(vector) >= GROUP_SHARE).tolist())
        groups = [other for other in groups if not other & group] + [
            group.union(*(g for g in groups if g & group))
        ]
    combinations = []
    for group in groups:
        members = sorted(group)
        covariance = spread.wald[np.ix_(members, members)]
        sd = np.sqrt(np.diag(covariance))
        for vector in np.linalg.eigh(covariance / np.outer(sd, sd))[1].T:
            weights = vector / sd
            weights = weights / weights[np.argmax(np.abs(weights))]
            open_ = (
                OPEN_VARIANCE * float(np.sum((weights @ spread.open[members]) ** 2))
                if spread.open.size
                else 0.0
            )
            error = math.sqrt(float(weights @ determined[np.ix_(members, members)] @ weights) + open_)
            terms = zip(members, weights.tolist(), vector, strict=True)
            involved = [(parameters[i], c) for i, c, v in terms if abs(v) > 0.1]
            product = all(p.positive for p, _ in involved)
            weights_by_name = {parameters[i].name: float(c) for i, c in zip(members, weights, strict=True)}
            is_determined = error <= max(largest_se(p) for p, _ in involved)
            combinations.append(
                Combination(_text(involved, product), weights_by_name, error, product, is_determined)
            )
    return tuple(sorted(combinations, key=lambda other: other.standard_error))


def _text(involved: Sequence[tuple[Parameter, float]], product: bool) -> str:
    """A product of powers such as a·b^0.5/c, or a sum."""
    if product:
        above = [_power(p.name, c) for p, c in involved if c > 0.0]
        below = [_power(p.name, -c) for p, c in involved if c < 0.0]
        return "·".join(above or ["1"]) + "".join(f"/{power}" for power in below)
    names = [(f"ln {p.name}" if p.positive else p.name, c) for p, c in involved]
    text = " ".join(
        f"{'+' if c > 0.0 else '−'} {'' if abs(abs(c) - 1.0) < 0.05 else f'{abs(c):.1g} '}{name}"
        for name, c in names
    )
    return text.removeprefix("+ ")


def _power(name: str, exponent: float) -> str:
    return name if abs(exponent - 1.0) < 0.05 else f"{name}^{exponent:.1g}"
