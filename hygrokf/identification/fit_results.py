"""What an identification found, as it stands in `fit.json`: frozen dataclasses with a default for every part.

A part that a fit lacks holds NaN, an empty collection or None, so that rules, tables and figures can read
attributes without asking first.  Units are in the names; the rest is dimensionless unless stated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from hygrokf.data.record import Provenance, Site
from hygrokf.data.structured import optional
from hygrokf.estimation.confidence import Limit
from hygrokf.evaluation.actuator_effects import ActuatorEffect
from hygrokf.evaluation.innovation_tests import Diagnosis
from hygrokf.evaluation.scoring import Scored, Shares
from hygrokf.identification.clock_offsets import ClockOffset
from hygrokf.identification.composition import CompositionStep
from hygrokf.identification.needed_inputs import WithoutInput
from hygrokf.identification.steady_state import HeatRelease
from hygrokf.identification.verdict_terms import Interval
from hygrokf.modelling.design import Design
from hygrokf.texts.reasons import Kind, Reason
from hygrokf.texts.record_codes import touched
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import Digest, Instant, Meaning, Name, ReaderText, Source, Unit, Version

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True)
class FormEstimate(Interval):
    """The time constant by one form of the model: `weight`, its share of the evidence, and `gain` in ln L."""

    form: Name = ""
    weight: float = math.nan
    gain: float = math.nan


@dataclass(frozen=True)
class Sampling:
    """Change of ln(constant) when every second ambient reading is left out; `ambient_step_h` [h] between
    these."""

    ambient_step_h: float = math.nan
    shift_ln_when_halved: float = math.nan


@dataclass(frozen=True)
class SensorResponse:
    """The response time of the humidity sensor [min]: stated, included in the constant, or estimated."""

    kind: Literal["stated", "included", "estimated"]
    minutes: float = math.nan
    lower_minutes: float = optional(math.nan)
    upper_minutes: float = optional(math.nan)


@dataclass(frozen=True)
class MeanTemperatures:
    """The mean temperatures [K] at which a time constant holds."""

    cabinet_temperature_K: float = math.nan
    ambient_temperature_K: float = math.nan


@dataclass(frozen=True)
class TimeConstant(Interval):
    """A time constant as reported, with what was found about it.

    `level` of the interval and the `method` of its bounds; `composition`: the interval by the profile
    likelihood of the chosen form, then widened source by source; `forms` of the model that competed;
    `parts_scatter`: scatter of the estimates from quarters of the record against their bounds; `limited_by`:
    other parameters that met a limit at an end of the profile; `factor`: variance of the score against the
    model's; `curve` (P, 2): constant [h] and twice the drop of the profile log-likelihood, with its
    `threshold`; `simulation`: the free run's own estimate, and `likelihood` that of the one-step predictions
    where the free run is the criterion; `criteria_disagree`: whether the two contradict each other;
    `range_h`: the constant over the record's temperatures, for the thermal one at the differences to the
    ambient `difference_K` of 10, 50 and 90 % of the readings; `resistance_capacity`: (R_AT+R_IC) C at the
    median difference; `modes` [h]: time constants of all states; `without_input`: the best model in which its
    input does not act.
    """

    level: float = math.nan
    method: Name = ""
    composition: tuple[CompositionStep, ...] = ()
    forms: tuple[FormEstimate, ...] = ()
    parts_scatter: float = math.nan
    limited_by: tuple[Limit, ...] = ()
    factor: float = math.nan
    threshold: float = math.nan
    curve: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))
    clock: tuple[ClockOffset, ...] | None = None
    sampling: Sampling | None = None
    simulation: Interval | None = None
    likelihood: Interval | None = optional()
    criteria_disagree: bool = False
    mean_temperatures: MeanTemperatures | None = optional()
    range_h: tuple[float, ...] | None = optional()
    difference_K: tuple[float, ...] | None = optional()
    resistance_capacity: Interval | None = optional()
    response: SensorResponse | None = optional()
    modes: tuple[float, ...] = ()
    without_input: WithoutInput | None = optional()
    verdict: Kind | None = None
    reasons: tuple[Reason, ...] = ()

    @property
    def profile(self) -> Interval | None:
        """The interval by the profile likelihood of the chosen form alone."""
        value_h = (self.likelihood or self).value_h
        return next((Interval(value_h, one.lower_h, one.upper_h) for one in self.composition[:1]), None)

    def __post_init__(self) -> None:
        if self.curve.size == 0:  # JSON does not keep the shape of what is empty
            object.__setattr__(self, "curve", np.empty((0, 2)))
        elif self.curve.shape != (len(self.curve), 2):
            raise ValueError(f"curve: expected pairs of numbers, found shape {self.curve.shape}")


@dataclass(frozen=True)
class PriorTerms:
    """Mean and standard deviation of a parameter's prior, in the parameter's unit."""

    mean: float = math.nan
    sd: float = math.nan


@dataclass(frozen=True)
class ParameterRow:
    """An estimated parameter in its `unit`: value, standard error, 95 % bounds (NaN where open or unknown).

    `at_guard`: at a limit of the search that is not physical; `parts`: the time constants estimated together
    with it.
    """

    value: float = math.nan
    unit: Unit = ""
    se: float = math.nan
    lower: float = math.nan
    upper: float = math.nan
    meaning: Meaning = ""
    prior: PriorTerms | None = None
    fixed: bool = False
    at_bound: bool = False
    at_guard: bool = False
    parts: tuple[Name, ...] = ()


@dataclass(frozen=True)
class Covariance:
    """Covariance `matrix` (r, r) of the parameters `names`, in their own units."""

    names: tuple[Name, ...] = ()
    matrix: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))


@dataclass(frozen=True)
class Period:
    """Start, end of the identification (`until`) and end of a record (ISO 8601), and what of it is used."""

    start: Instant | None = None
    until: Instant | None = None
    end: Instant | None = None
    n_readings: int = 0


@dataclass(frozen=True)
class LocalOptimum:
    """Another local optimum: its penalised log-likelihood and the time constants there [h]."""

    objective: float
    thermal_time_constant: float = optional(math.nan)
    hygric_k: float = optional(math.nan)


@dataclass(frozen=True)
class FitResults(Scored):
    """All that `fit.json` says.

    `criterion`: "likelihood" or "simulation"; `kind`: "joint" or "cascade"; `doubts` about the record;
    `files` read, with their digests; `converged`: None where not stated, and how each search ended in
    `messages`; `loglik` of the whole model at the reported values on the identification period, and
    `aic`, `bic` of it; `flat`: parameters that the record does not determine; `trade_offs`: pairs of
    parameters with their correlation; `readings_sd`: standard deviation of the readings by period and
    quantity; `identified_on`: 0.1 and 99.9 % quantiles of the inputs; `discretisation_error`: change of ln L,
    or of the parameters in standard errors where this is more, with sub-steps of half the length.
    """

    name: Name = ""
    version: Version = ""
    created: Instant = ""
    provenance: Provenance = Provenance.MEASURED
    criterion: Name = "likelihood"
    kind: Name = ""
    rated_power_kW: float = math.nan
    site: Site | None = None
    period: Period = Period()
    design: Design | None = None
    statements: tuple[Statement, ...] = ()
    warnings: tuple[ReaderText, ...] = ()
    doubts: tuple[Statement, ...] = ()
    files: tuple[tuple[Source, Digest], ...] = ()
    parameters: Mapping[str, ParameterRow] = field(default_factory=dict)
    covariance: Covariance = field(default_factory=Covariance)
    time_constants: Mapping[str, TimeConstant] = field(default_factory=dict)
    loglik: float = math.nan
    aic: float = math.nan
    bic: float = math.nan
    n_obs: int = 0
    converged: bool | None = None
    messages: tuple[Statement, ...] = ()
    other_optima: tuple[LocalOptimum, ...] = ()
    at_bounds: tuple[Name, ...] = ()
    flat: tuple[Name, ...] = ()
    trade_offs: tuple[tuple[Name, Name, float], ...] = ()
    readings_sd: Shares = field(default_factory=dict)
    heat_release: HeatRelease | None = None
    actuators: tuple[ActuatorEffect, ...] = ()
    innovations: Diagnosis = field(default_factory=Diagnosis)
    identified_on: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    discretisation_error: float = 0.0

    def doubts_about(self, part: str) -> tuple[Statement, ...]:
        """The doubts about the record that concern a time constant."""
        return tuple(one for one in self.doubts if part in touched(one))

    def to_frame(self) -> DataFrame:
        """The table of parameters, one row each, as a pandas data frame."""
        from pandas import DataFrame

        columns = ("value", "unit", "se", "lower", "upper", "meaning", "fixed", "at_bound")
        rows = [[getattr(row, name) for name in columns] for row in self.parameters.values()]
        return DataFrame(rows, index=list(self.parameters), columns=list(columns))
