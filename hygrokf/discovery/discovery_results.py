"""The content of `discovery.json` as dataclasses: findings, causes with their evidence and gain, and the
causes that were left out.

Numbers that do not exist are NaN here and null in the file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from hygrokf.data.structured import renamed
from hygrokf.data.tabular import units_by_name, with_units
from hygrokf.evaluation.scoring import RuleScores, Scores
from hygrokf.identification.fit_results import FitResults, TimeConstant

if TYPE_CHECKING:
    import pandas

LASTING_KINDS = ("step", "drift", "season")
"""Kinds of a condition that begins once and lasts, so that it need not recur."""
Verdict: TypeAlias = Literal["none", "named", "unexplained"]
"""The record shows no missing effect; a cause is named; an effect is missing and its cause is unknown."""
Settings: TypeAlias = Mapping[str, Any]
"""Settings of a mechanism, a feature or a search: numbers, names, and spans of time [s]."""


@dataclass(frozen=True)
class Finding:
    """An error of the free run in the identification period.

    quantity: "temperature" or "humidity"; unit: K or g/m³.
    where, when: the condition in words, empty for any.
    size: typical error under the condition less that elsewhere (less that in the hours around it where the
        condition sets in sharply); direction: of the simulation.
    duration_h: [h] for how long of an episode, or NaN.
    n_episodes: in which it is seen, of n_possible.
    sensor_share: [1] of its square that the sensors' accuracy explains.
    p, p_adjusted: [1] chance of it without a cause, alone and as adjusted share of false discoveries.
    driver: signal that it goes with, or None.  kind: of the condition.
    curve: reading − free run over the condition's bins.
    spans: (start, end) [s] of its episodes, the largest error first.
    """

    quantity: str
    where: str
    when: str
    size: float
    unit: str
    direction: str
    duration_h: float
    n_episodes: int
    n_possible: int
    sensor_share: float
    statement: str
    p: float
    p_adjusted: float
    driver: str | None
    kind: str
    curve: Mapping[str, Any] = field(default_factory=dict)
    spans: tuple[tuple[float, float], ...] = ()

    @property
    def once(self) -> bool:
        """Whether there was a single occasion for it, so that nothing shows that it recurs."""
        return self.n_possible == 1 and self.kind not in LASTING_KINDS


@dataclass(frozen=True)
class ResidualStructure:
    """Structure that is left in the errors, and the driver and lag [h] with which it correlates most."""

    quantity: str
    kind: str
    statement: str
    when: str = ""
    driver: str | None = None
    lag_h: float = math.nan
    correlation: float = 0.0
    p: float = 0.0


@dataclass(frozen=True)
class Gain:
    """How much better the free run is with a cause than without it: RMSE [K] or [g/m³] of the better
    simulators, and the 95 % bounds of their difference.

    identified_before, identified_after: errors of the models as estimated by innovations, which tables and
        other pages show; NaN where that model's free run diverges.
    """

    quantity: str
    period: str
    rmse_before: float = math.nan
    rmse_after: float = math.nan
    identified_before: float = math.nan
    identified_after: float = math.nan
    lower: float = math.nan
    upper: float = math.nan

    @property
    def known(self) -> bool:
        """Whether both errors are known."""
        return math.isfinite(self.rmse_before) and math.isfinite(self.rmse_after)


@dataclass(frozen=True)
class Evidence:
    """Evidence of a cause's best form.

    lr: 2 ln L gained by `df` parameters.  p_adjusted: corrected for all that was tried.
    bic_gain: the evidence less the price of parameters and settings.
    free_run_gain: [1] share of the free run's squared error that is gone, by submodel; lasting_gain: the same
        without the days that gained most.
    """

    lr: float = math.nan
    df: float = math.nan
    p_adjusted: float = math.nan
    bic_gain: float = math.nan
    score_statistic: float = math.nan
    free_run_gain: Mapping[str, float] = field(default_factory=dict)
    lasting_gain: Mapping[str, float] = field(default_factory=dict)
    settings: Settings = field(default_factory=dict)


@dataclass(frozen=True)
class CauseParameter:
    """A parameter that a cause adds: value, 95 % bounds (NaN for an open side), standard error, and the value
    without an effect, in its unit."""

    value: float
    unit: str
    lower: float = math.nan
    upper: float = math.nan
    se: float = math.nan
    null: float = math.nan
    meaning: str = ""


@dataclass(frozen=True)
class CauseFound:
    """An accepted cause.

    `confidence`: probability [1] that the name, or one of `ambiguous_with`, is right; `margin`: share [1] of
    its evidence by which the best cause outside its class stays behind; `gain` on the held-out period, None
    where an event or a single episode is no prediction; `separate_by`: the measurement that tells it from its
    rivals; `remedy`: what to check in the turbine.
    """

    cause: str
    form: str = ""
    confidence: float = math.nan
    margin: float = math.nan
    statement: str = ""
    parameters: Mapping[str, CauseParameter] = field(default_factory=dict)
    settings: Settings = field(default_factory=dict)
    evidence: Evidence = field(default_factory=Evidence)
    gain: Gain | None = None
    ambiguous_with: tuple[str, ...] = ()
    separate_by: str = ""
    remedy: str = ""


@dataclass(frozen=True)
class Rejected:
    """A cause that was tried and left out, with the evidence of its best form and the reason."""

    cause: str
    form: str = ""
    evidence: Evidence = field(default_factory=Evidence)
    reason: str = ""


@dataclass(frozen=True)
class Refuted:
    """A cause that the identification period shows and the held-out period refutes."""

    cause: str
    form: str = ""
    gain: Gain | None = None


@dataclass(frozen=True)
class NotTried:
    """What the time did not allow.

    causes: not tried at all; beside: whether no cause was tried beside the accepted ones; budget_s: [s], NaN
        where the time was unlimited.
    """

    causes: tuple[str, ...] = ()
    beside: bool = False
    budget_s: float = math.nan


@dataclass(frozen=True)
class ModelScores:
    """Errors, time constants and likelihood of the base or of the extended model, as in its `fit.json`."""

    rmse: Scores = field(default_factory=dict)
    baselines: RuleScores = field(default_factory=dict)
    time_constants: Mapping[str, TimeConstant] = field(default_factory=dict)
    loglik: float = math.nan
    n_obs: int = 0

    @cached_property
    def fit(self) -> FitResults:
        """These numbers as the results of a fit, for functions that take those."""
        return FitResults(
            rmse=self.rmse,
            baselines=self.baselines,
            time_constants=self.time_constants,
            loglik=self.loglik,
            n_obs=self.n_obs,
        )


@dataclass(frozen=True)
class DiscoveryResults:
    """The results of a discovery.

    baseline, extended: the model before and after; `extended` is None where no cause was accepted.
    findings: errors of the free run, worst first; causes: in the order in which they were accepted.
    rejected, refuted: causes that were tried and left out; unexplained: structure that is left, or None.
    own_causes: origin of the user's causes. doubts: those about the record that concern a time constant.
    """

    name: str
    version: str
    verdict: Verdict
    baseline: ModelScores
    synthetic: bool = False
    extended: ModelScores | None = None
    causes: tuple[CauseFound, ...] = ()
    rejected: tuple[Rejected, ...] = ()
    refuted: tuple[Refuted, ...] = ()
    unexplained: ResidualStructure | None = None
    not_tried: NotTried = field(default_factory=NotTried)
    own_causes: Mapping[str, Any] = field(default_factory=dict)
    findings: tuple[Finding, ...] = renamed("misfits", default=())
    doubts: tuple[str, ...] = ()

    def to_frame(self) -> pandas.DataFrame:
        """Every cause that was tried, by name: verdict on it, confidence [1], gain in evidence, and RMSE
        before and after in `unit`."""
        import pandas

        rows = [
            *(_row(c, "accepted", c.confidence, c.evidence, c.gain) for c in self.causes),
            *(_row(c, "refuted", gain=c.gain) for c in self.refuted),
            *(_row(c, "rejected", evidence=c.evidence) for c in self.rejected),
        ]
        columns = ["cause", "form", "verdict", "confidence", "evidence", "rmse_before", "rmse_after", "unit"]
        frame = pandas.DataFrame(rows, columns=columns).set_index("cause")
        return with_units(frame, {"confidence": "1", "evidence": "1"})


def _row(
    one: CauseFound | Refuted | Rejected,
    verdict: str,
    confidence: float = math.nan,
    evidence: Evidence | None = None,
    gain: Gain | None = None,
) -> tuple[str | float, ...]:
    errors = (math.nan, math.nan) if gain is None else (gain.rmse_before, gain.rmse_after)
    unit = "" if gain is None else units_by_name([gain.quantity]).get(gain.quantity, "1")
    return (
        one.cause,
        one.form,
        verdict,
        confidence,
        math.nan if evidence is None else evidence.bic_gain,
        *errors,
        unit,
    )
