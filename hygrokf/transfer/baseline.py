"""The baseline of a transfer: the model's origin, the record's periods, and what the record determines;
groups of parameters that travel from turbine to turbine together, and which of them differ between two
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
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from hygrokf.data.record import Record
from hygrokf.estimation.confidence import Uncertainty, normal_quantile, positive_inverse
from hygrokf.estimation.conventions import CONFIDENCE, SIGNIFICANCE
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
"""Groups that belong to a logger, a site and a season, not to a type of cabinet: every record has its own."""
_BASE = {"thermal_network": THERMAL_GROUP, "heat_release": HEAT_GROUP, "hygric_exchange": HYGRIC_GROUP}
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

    def bounds(self, name: str, level: float = CONFIDENCE) -> tuple[float, float, float]:
        """Difference of one parameter in its coordinate: (value, lower, upper)."""
        i = self.names.index(name)
        reach = normal_quantile(level) * math.sqrt(max(self.covariance[i, i], 0.0))
        return float(self.value[i]), float(self.value[i] - reach), float(self.value[i] + reach)


@dataclass(frozen=True)
class GroupTest:
    """The χ² test of a group beside those selected before: `p_adjusted` for the number of groups left."""

    statistic: float
    df: int
    p: float
    p_adjusted: float

    @property
    def significant(self) -> bool:
        """Whether the group is selected."""
        return self.p_adjusted < SIGNIFICANCE


def unexplained(found: Difference, differing: Sequence[str]) -> float:
    """Q(S): the squared distance that remains when the parameters `differing` may differ and all others are
    equal."""
    others = [i for i, name in enumerate(found.names) if name not in set(differing)]
    if not others:
        return 0.0
    value = found.value[others]
    return float(value @ positive_inverse(found.covariance[np.ix_(others, others)]) @ value)


def selection(found: Difference, groups: Mapping[str, str]) -> dict[str, GroupTest]:
    """Forward selection of the groups that differ: the test of each at the step that decided on it, the
    selected ones first, in their order."""
    from scipy.stats import chi2

    left = list(dict.fromkeys(groups[name] for name in found.names))
    selected: dict[str, GroupTest] = {}
    while left:
        rest = unexplained(found, [n for n in found.names if groups[n] in selected])
        tests = {}
        for group in left:
            wider = [n for n in found.names if groups[n] in (*selected, group)]
            statistic = max(rest - unexplained(found, wider), 0.0)
            df = sum(groups[n] == group for n in found.names)
            p = float(chi2.sf(statistic, df))
            tests[group] = GroupTest(statistic, df, p, min(1.0, p * len(left)))
        # p of large statistics underflows to zero: the mean square decides then
        best = min(left, key=lambda group: (tests[group].p, -tests[group].statistic / tests[group].df))
        if not tests[best].significant:
            return selected | tests
        selected[best] = tests[best]
        left.remove(best)
    return selected


EARLY_SHARE = 0.75
"""[1] share of a record without `until` that serves as its identification period."""


@dataclass(frozen=True)
class Origin:
    """The fit or type that is tried on a record: a design, its values, and their covariance (`names`, in
    their units).

    `rmse` [K], [g/m³] the errors of the free run on its own record, by quantity, if known; `files` hashes of
    the files that a fit was made from; `turbines` names of those that a type was made of; `verdicts` on a
    fit's time constants.
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
        """The reasons against a time constant, for a fit that takes it over from here."""
        known = self.verdicts[part].reasons if part in self.verdicts else ()
        return tuple(replace(reason, source=self.name) for reason in known)

    @classmethod
    def of(cls, source: Fit | TurbineType) -> Origin:
        """From a fit, or from a type: then the covariance is that of the next turbine's own values."""
        if isinstance(source, TurbineType):
            values = source.values
            names = tuple(n for n in source.parameters if n in values)
            slopes = [values[n] if source.parameters[n].logarithmic else 1.0 for n in names]
            sd = [source.parameters[n].next_sd * slope for n, slope in zip(names, slopes, strict=True)]
            return cls(
                source.name,
                "type",
                source.design,
                values,
                names,
                np.diag(np.square(sd)),
                turbines=source.turbines,
            )
        names, matrix = source.covariance
        scored = source.results.rmse.get("identification", {})
        known = {q: row.total for q, row in scored.items() if row.total > 0}
        values = {p.name: source.values[p.name] for p in source.design.model.parameters}
        files = frozenset(digest for _, digest in source.results.files)
        handed = inherited(source.results)
        return cls(source.name, "fit", source.design, values, names, matrix, known, files, verdicts=handed)


@dataclass(frozen=True)
class Baseline:
    """The origin, the model, and its runs on the record and on its identification period, which all sets of
    values share.

    `until_s` [s since 1970] the end of the period; `held`: values of parameters that the record does not
    determine; `groups`: group of every parameter.
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
        return Likelihood(self.base.model, self.early_run.timeline)

    @property
    def cabinet(self) -> tuple[str, ...]:
        """Parameters of the cabinet that this record determines."""
        return tuple(n for n, g in self.groups.items() if g not in OF_THE_RECORD and n not in self.held)


def baseline_of(origin: Origin, record: Record) -> tuple[Baseline, list[Statement]]:
    """The baseline of a transfer, and statements about it.

    Raises ValueError for a record on which no model can be judged.
    """
    statements: list[Statement] = []
    if (until_s := record.until_s) is None:
        cabinet = [record[n] for n in ("cabinet_temperature", *CABINET_HUMIDITIES) if n in record]
        first, last = min(s.time[0] for s in cabinet), max(s.time[-1] for s in cabinet)
        until_s = float(first + EARLY_SHARE * (last - first))
        record = replace(record, until_s=until_s)
        statements.append(TransferCode.NO_UNTIL(until=iso_time(until_s)))
    statements += _kinship(origin, record)
    base = replace(read_as(origin.design, record), priors={})
    groups = group_of(base.model)
    early = record.identification()
    expect_readings(early)
    early_run = model_inputs(base, early)
    if not any(np.isfinite(one[early_run.scored]).any() for one in measured(early_run).values()):
        raise ValueError(
            "no reading to judge the model by: the identification period has no reading of the cabinet at a "
            "time when all inputs are known (a model that reads the power needs the power); check the case "
            "with `hygrokf check`"
        )
    unknown = [n for n, g in groups.items() if g not in OF_THE_RECORD and n not in origin.names]
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
    """Original values of the parameters whose range the identification period cannot narrow."""
    coordinates = Coordinates(base.model.parameters)
    objective = Objective(Likelihood(base.model, early_run.timeline), coordinates)
    information = np.diag(objective.information(coordinates.start(origin.values)).information)
    held = {}
    for p, known in zip(coordinates.free, information, strict=True):
        width = p.to_coordinate(p.upper) - p.to_coordinate(p.lower)
        if not known * width**2 > 1.0:
            held[p.name] = origin.values[p.name]
    return held


def _kinship(origin: Origin, record: Record) -> list[Statement]:
    """A statement where the model was, or seems to be, made from this very record."""
    files = frozenset(digest for _, digest in record.files)
    if files and files == origin.files:
        return [TransferCode.SAME_FILES()]
    if record.name in origin.turbines:
        return [TransferCode.ONE_OF_THE_TYPE(record=record.name)]
    return []


def difference(origin: Origin, own: Estimate, spread: Uncertainty, names: Sequence[str]) -> Difference:
    """Own less original values of the named parameters in their coordinates; both covariances add up.

    A parameter that the origin knows without standard error (at a bound there) counts as known as well as
    here.  Those at a bound here are left out.
    """
    free = {p.name: p for p in own.coordinates.free}
    kept = [n for n in names if n in spread.names]
    place = [spread.names.index(n) for n in kept]
    # the exact information's correlations, widened to the sandwich where that is wider
    grow = np.sqrt(spread.factor[place])
    covariance = spread.wald[np.ix_(place, place)] * np.outer(grow, grow)
    old = np.zeros_like(covariance)
    known = {n: i for i, n in enumerate(origin.names)}
    slopes = np.array([free[n].slope(origin.values[n]) for n in kept])
    for i, a in enumerate(kept):
        if a not in known:
            old[i, i] = covariance[i, i]
            continue
        for j, b in enumerate(kept):
            if b in known:
                old[i, j] = origin.covariance[known[a], known[b]] / (slopes[i] * slopes[j])
    value = np.array(
        [free[n].to_coordinate(own.values[n]) - free[n].to_coordinate(origin.values[n]) for n in kept]
    )
    return Difference(tuple(kept), value, covariance + old)
