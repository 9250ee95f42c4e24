"""The baseline of a transfer: the model that is tried, the record's periods, and what the record determines;
and the groups of parameters that may differ, with a test of which do.

Let δ = z₁ − z₀ be the difference of two independent estimates in the parameters' coordinates, Σ = V₁ + V₀ its
covariance, and S the groups that may differ. If all others are equal, the squared distance that remains
unexplained is

    Q(S) = min_Δ (δ − D_S Δ)' Σ⁻¹ (δ − D_S Δ),

with D_S the columns of the identity that belong to S. If all groups outside S ∪ {G} are equal, Q(S) − Q(S ∪
{G}) is χ² with as many degrees of freedom as G has parameters: the likelihood ratio of two quadratic
likelihoods. Groups are added to S one by one, the most significant first, as long as their p times the number
of remaining groups is below the level (Holm 1979; Bonferroni within a step).

Shapes: d parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from hygrokf.data.record import Record
from hygrokf.estimation.confidence import Uncertainty, normal_quantile, positive_inverse
from hygrokf.estimation.conventions import SIGNIFICANCE
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Estimate, Objective
from hygrokf.evaluation.simulation import measured, settled
from hygrokf.identification.fit import Fit
from hygrokf.identification.fit_on_record import rated_power_mismatch
from hygrokf.identification.identify import expect_readings
from hygrokf.identification.turbine_type import TurbineType
from hygrokf.identification.verdict import inherited
from hygrokf.identification.verdict_terms import Inherited
from hygrokf.modelling.design import Design, read_as
from hygrokf.modelling.inputs import Run, model_inputs
from hygrokf.physics.model import Model
from hygrokf.physics.parameters import Coordinates
from hygrokf.physics.signal_names import CABINET_HUMIDITIES
from hygrokf.texts.reasons import Reason
from hygrokf.texts.statement import Statement
from hygrokf.texts.transfer_codes import TransferCode
from hygrokf.texts.wording import iso_time

THERMAL_GROUP = "thermal time constant"
HEAT_GROUP = "heat release"
HYGRIC_GROUP = "hygric exchange"
OFFSETS = "sensor offsets"
DISTURBANCES = "disturbances"
UNKNOWN_GROUP = "not known to the type"
OF_THE_RECORD = (OFFSETS, DISTURBANCES, UNKNOWN_GROUP)
"""Groups that belong to a logger, a site and a season, not to a cabinet: every record has its own values."""
_BASE = {"thermal_network": THERMAL_GROUP, "heat_release": HEAT_GROUP, "hygric_exchange": HYGRIC_GROUP}
_OFFSETS = ("_bias", "_offset")


def group_of(model: Model) -> dict[str, str]:
    """The group of every parameter of a model; a mechanism beside the base models is a group of its own."""
    groups = {}
    for mechanism in model.mechanisms:
        for parameter in mechanism.parameters:
            if parameter.name.endswith(_OFFSETS):
                group = OFFSETS
            elif parameter.noise:
                group = DISTURBANCES
            else:
                group = _BASE.get(mechanism.name, mechanism.name.replace("_", " "))
            groups[parameter.name] = group
    return groups


def members(groups: Mapping[str, str], *chosen: str) -> tuple[str, ...]:
    """Return the names of the parameters of some groups."""
    return tuple(name for name, group in groups.items() if group in chosen)


@dataclass(frozen=True)
class Difference:
    """The difference of two estimates (d,) in the coordinates of the parameters `names`, with its covariance
    (d, d)."""

    names: tuple[str, ...]
    value: np.ndarray
    covariance: np.ndarray

    def of(self, names: Sequence[str]) -> Difference:
        """Return the difference of some of the parameters; the others are ignored."""
        indices = [self.names.index(name) for name in names if name in self.names]
        return Difference(
            tuple(self.names[index] for index in indices),
            self.value[indices],
            self.covariance[np.ix_(indices, indices)],
        )

    def bounds(self, name: str, level: float = 0.95) -> tuple[float, float, float]:
        """Return the difference of one parameter in its coordinate: (value, lower, upper)."""
        index = self.names.index(name)
        half_width = normal_quantile(level) * math.sqrt(max(self.covariance[index, index], 0.0))
        return (
            float(self.value[index]),
            float(self.value[index] - half_width),
            float(self.value[index] + half_width),
        )


@dataclass(frozen=True)
class GroupTest:
    """The χ² test of a group, given the groups selected before; `p_adjusted`: for the number of remaining
    groups."""

    statistic: float
    df: int
    p: float
    p_adjusted: float

    @property
    def significant(self) -> bool:
        """Whether the group is selected as different."""
        return self.p_adjusted < SIGNIFICANCE


def unexplained(apart: Difference, differing: Sequence[str]) -> float:
    """Return Q(S): the squared distance that remains if the parameters `differing` may differ and all others
    are equal."""
    others = [index for index, name in enumerate(apart.names) if name not in set(differing)]
    if not others:
        return 0.0
    value = apart.value[others]
    return float(value @ positive_inverse(apart.covariance[np.ix_(others, others)]) @ value)


def selection(apart: Difference, groups: Mapping[str, str]) -> dict[str, GroupTest]:
    """Select the groups that differ, one by one; returns the test of each group at the step that decided on
    it, the selected groups first, in their order."""
    from scipy.stats import chi2

    remaining = list(dict.fromkeys(groups[name] for name in apart.names))
    selected: dict[str, GroupTest] = {}
    while remaining:
        unexplained_before = unexplained(apart, [name for name in apart.names if groups[name] in selected])
        tests = {}
        for group in remaining:
            candidates = [name for name in apart.names if groups[name] in (*selected, group)]
            statistic = max(unexplained_before - unexplained(apart, candidates), 0.0)
            df = sum(groups[name] == group for name in apart.names)
            p = float(chi2.sf(statistic, df))
            tests[group] = GroupTest(statistic, df, p, min(1.0, p * len(remaining)))
        # p of large statistics underflows to zero: the mean square decides then
        best = min(remaining, key=lambda group: (tests[group].p, -tests[group].statistic / tests[group].df))
        if not tests[best].significant:
            return selected | tests
        selected[best] = tests[best]
        remaining.remove(best)
    return selected


EARLY_SHARE = 0.75
"""[1] share of a record without `until` that is its identification period."""


@dataclass(frozen=True)
class Origin:
    """The fit or type that is tried on a record: its design, its values, and the covariance of the parameters
    `names` in their units.

    `rmse` [K], [g/m³]: free-run errors on its own record by quantity, if known; `files`: hashes of the files
    behind a fit; `turbines`: names of the turbines behind a type; `verdicts` on a fit's time constants.
    """

    name: str
    kind: Literal["fit", "type"]
    design: Design
    values: Mapping[str, float]
    names: tuple[str, ...]
    covariance: np.ndarray
    rmse: Mapping[str, float] = field(default_factory=dict)
    files: frozenset[str] = frozenset()
    turbines: tuple[str, ...] = ()
    verdicts: Mapping[str, Inherited] = field(default_factory=dict)

    def reasons(self, part: str) -> tuple[Reason, ...]:
        """Return the reasons against a time constant, marked as taken over from here."""
        reasons_of_part = self.verdicts[part].reasons if part in self.verdicts else ()
        return tuple(replace(reason, source=self.name) for reason in reasons_of_part)

    @classmethod
    def of(cls, source: Fit | TurbineType) -> Origin:
        """Return the origin of a fit, or of a type: then the covariance is that of the values of the next
        turbine."""
        if isinstance(source, TurbineType):
            values = source.values
            names = tuple(name for name in source.parameters if name in values)
            slopes = [values[name] if source.parameters[name].logarithmic else 1.0 for name in names]
            sd = [source.parameters[name].next_sd * slope for name, slope in zip(names, slopes, strict=True)]
            return cls(
                source.name,
                "type",
                source.design,
                values,
                names,
                np.diag(np.square(sd)),
                turbines=source.turbines,
            )
        names, covariance = source.covariance
        errors_of_period = source.results.rmse.get("identification", {})
        rmse = {quantity: error.total for quantity, error in errors_of_period.items() if error.total > 0}
        values = {
            parameter.name: source.values[parameter.name] for parameter in source.design.model.parameters
        }
        files = frozenset(digest for _, digest in source.results.files)
        verdicts = inherited(source.results)
        return cls(
            source.name, "fit", source.design, values, names, covariance, rmse, files, verdicts=verdicts
        )


@dataclass(frozen=True)
class Baseline:
    """What all sets of values share: the origin, the model, and its runs on the record and on its
    identification period.

    `until_s` [s since 1970]: end of the identification period; `held`: original values of parameters that the
    record does not determine; `groups`: group of every parameter.
    """

    origin: Origin
    until_s: float
    base: Design
    run: Run
    early_run: Run
    held: dict[str, float]
    groups: dict[str, str]

    @property
    def likelihood(self) -> Likelihood:
        """The likelihood of the model on the identification period."""
        return Likelihood(self.base.model, self.early_run.timeline)

    @property
    def cabinet(self) -> tuple[str, ...]:
        """Names of the cabinet's parameters that this record determines."""
        return tuple(
            name
            for name, group in self.groups.items()
            if group not in OF_THE_RECORD and name not in self.held
        )


def baseline_of(origin: Origin, record: Record) -> tuple[Baseline, list[Statement]]:
    """Return the baseline of a transfer, and statements about it.

    Raises ValueError for a record on which no model can be judged.
    """
    statements: list[Statement] = []
    if (until_s := record.until_s) is None:
        cabinet = [record[name] for name in ("cabinet_temperature", *CABINET_HUMIDITIES) if name in record]
        first_s = min(series.time[0] for series in cabinet)
        last_s = max(series.time[-1] for series in cabinet)
        until_s = float(first_s + EARLY_SHARE * (last_s - first_s))
        record = replace(record, until_s=until_s)
        statements.append(TransferCode.NO_UNTIL(until=iso_time(until_s)))
    statements += _kinship(origin, record)
    base = replace(read_as(origin.design, record), priors={})
    groups = group_of(base.model)
    identification_period = record.identification()
    expect_readings(identification_period)
    early_run = model_inputs(base, identification_period)
    if not any(np.isfinite(readings[early_run.scored]).any() for readings in measured(early_run).values()):
        raise ValueError(
            "no reading to judge the model by: the identification period has no reading of the cabinet at a "
            "time when all inputs are known (a model that reads the power needs the power); check the case "
            "with `hygrokf check`"
        )
    unknown = [
        name for name, group in groups.items() if group not in OF_THE_RECORD and name not in origin.names
    ]
    if origin.kind == "type" and unknown:
        groups |= dict.fromkeys(unknown, UNKNOWN_GROUP)
        statements.append(TransferCode.UNKNOWN_TO_THE_TYPE(names=tuple(unknown)))
    held = _unknowable(origin, base, early_run)
    if held:
        statements.append(TransferCode.NO_INFORMATION(names=tuple(held)))
    statements += rated_power_mismatch(origin.design, record)
    values = {p.name: origin.values.get(p.name, p.start) for p in base.model.parameters}
    run = settled(base, values, model_inputs(base, record))
    return Baseline(origin, until_s, base, run, early_run, held, groups), statements


def _unknowable(origin: Origin, base: Design, early_run: Run) -> dict[str, float]:
    """Return the original values of the parameters whose range the identification period does not narrow."""
    coordinates = Coordinates(base.model.parameters)
    objective = Objective(Likelihood(base.model, early_run.timeline), coordinates)
    information = np.diag(objective.information(coordinates.start(origin.values)).information)
    undetermined = {}
    for parameter, information_of_parameter in zip(coordinates.free, information, strict=True):
        width = parameter.to_coordinate(parameter.upper) - parameter.to_coordinate(parameter.lower)
        if not information_of_parameter * width**2 > 1.0:
            undetermined[parameter.name] = origin.values[parameter.name]
    return undetermined


def _kinship(origin: Origin, record: Record) -> list[Statement]:
    """Return a statement if the model was made, or seems to be made, from this very record."""
    files = frozenset(digest for _, digest in record.files)
    if files and files == origin.files:
        return [TransferCode.SAME_FILES()]
    if record.name in origin.turbines:
        return [TransferCode.ONE_OF_THE_TYPE(record=record.name)]
    return []


def difference(origin: Origin, own: Estimate, spread: Uncertainty, names: Sequence[str]) -> Difference:
    """Return own minus original values of the named parameters in their coordinates, with the sum of both
    covariances.

    A parameter without standard error in the origin (there at a bound) counts as known as well as here.
    Parameters at a bound here are left out.
    """
    free_parameters = {parameter.name: parameter for parameter in own.coordinates.free}
    kept = [name for name in names if name in spread.names]
    indices = [spread.names.index(name) for name in kept]
    # the exact information's correlations, widened to the sandwich where that is wider
    widening = np.sqrt(spread.factor[indices])
    covariance = spread.wald[np.ix_(indices, indices)] * np.outer(widening, widening)
    original_covariance = np.zeros_like(covariance)
    index_of = {name: i for i, name in enumerate(origin.names)}
    slopes = np.array([free_parameters[name].slope(origin.values[name]) for name in kept])
    for i, row_name in enumerate(kept):
        if row_name not in index_of:
            original_covariance[i, i] = covariance[i, i]
            continue
        for j, column_name in enumerate(kept):
            if column_name in index_of:
                original_covariance[i, j] = origin.covariance[index_of[row_name], index_of[column_name]] / (
                    slopes[i] * slopes[j]
                )
    value = np.array(
        [
            free_parameters[name].to_coordinate(own.values[name])
            - free_parameters[name].to_coordinate(origin.values[name])
            for name in kept
        ]
    )
    return Difference(tuple(kept), value, covariance + original_covariance)
