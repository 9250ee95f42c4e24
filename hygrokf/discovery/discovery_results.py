"""What a discovery finds: errors, causes with their evidence, what held-out readings say of them, and the
causes that were left out; and the files that hold it (`discovery.json`, `discovery.npz`, a fit beside them).

Numbers that do not exist are NaN here and null in the file.
"""

from __future__ import annotations

import io
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from hygrokf.data.files import DISCOVERY, DISCOVERY_SERIES, write_bytes_whole, write_text_whole
from hygrokf.data.record import Provenance
from hygrokf.data.result_file import ResultFault, drawn, read_arrays, read_result, result_text, with_units
from hygrokf.data.structured import JsonObject, optional, plain
from hygrokf.discovery.residuals import Quantity, Residuals
from hygrokf.evaluation.scoring import RuleScores, Scores
from hygrokf.identification.fit import Fit, write_fit
from hygrokf.identification.fit_results import FitResults, ParameterRow, TimeConstant
from hygrokf.modelling.causes.forms import Settings
from hygrokf.physics.model import field_values
from hygrokf.texts.discovery_codes import DiscoveryCode
from hygrokf.texts.statement import Statement, Value
from hygrokf.texts.terms import Meaning, Name, Version
from hygrokf.texts.wording import QUANTITY_NAMES as QUANTITY_WORDS

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes

SCORED_AS: Mapping[Quantity, str] = {
    "temperature": "temperature_K",
    "humidity": "absolute_humidity_g_m3",
}
"""Quantity of a finding -> name of the quantity in scores."""
LASTING_KINDS = ("step", "drift", "season")
"""Kinds of conditions that begin once and last, so that they need not recur."""
Verdict: TypeAlias = Literal["none", "named", "ambiguous", "unexplained", "refuted"]
"""none: no effect is missing.  named: every cause is named.  ambiguous: at least one cause cannot be told
from others.  unexplained: an effect is missing beside the named causes.  refuted: held-out readings
contradict every cause found."""
Reason: TypeAlias = Literal["", "worse", "no_gain", "unproven", "no_effect"]
"""Why a cause is refuted.  worse: its held-out errors are larger.  no_gain: held-out readings cost more
evidence than it can spare.  unproven: they do not support weak evidence.  no_effect: it has no effect in the
final set."""
Exclusion: TypeAlias = Literal[
    "refuted", "no_effect", "weak", "weak_by_days", "later_gone", "left_to_budget", "no_form"
]
"""Why a cause was left out.  refuted: by held-out readings.  no_effect: screening found nothing.  weak,
weak_by_days: too little evidence, or too little in days.  later_gone: later causes replaced it.
left_to_budget: the budget ended the search.  no_form: the record cannot show it."""
CLASS_LIMIT = 3
"""Largest number of causes that may be indistinguishable from each other; with more, none is named."""


@dataclass(frozen=True)
class Finding:
    """An error of the free run under one condition, in the identification period.

    kind: of the condition.  driver: signal that the condition is about, or "".
    side: "low" or "high", where the simulation lies beside the readings.
    lasting_h: [h] how long the error lasts after an episode begins, else NaN.
    size: [K] or [g/m³] mean error under the condition minus that elsewhere, by generalised least squares.
    n_episodes, n_possible: number of episodes that show the error, and of all episodes.
    sensor_share: [1] share of size² that the sensors' accuracy explains.
    p_adjusted: [1] probability of such an error by chance, adjusted for the number of tests.
    spans: (start, end) [s] of its episodes, the largest error first.
    """

    quantity: Quantity
    kind: Name
    driver: Name
    condition: Statement
    side: Literal["low", "high"]
    lasting_h: float = math.nan
    size: float = math.nan
    n_episodes: int = 0
    n_possible: int = 0
    sensor_share: float = math.nan
    p_adjusted: float = math.nan
    spans: tuple[tuple[float, float], ...] = ()

    @property
    def statement(self) -> Statement:
        """Condition, quantity, size and sign of the error as a statement."""
        name, unit = QUANTITY_WORDS[SCORED_AS[self.quantity]]
        low, high = DiscoveryCode.SIMULATED_TOO_LOW, DiscoveryCode.SIMULATED_TOO_HIGH
        lasting: dict[str, Value] = {}
        if math.isfinite(self.lasting_h):
            low, high = DiscoveryCode.SIMULATED_TOO_LOW_FOR, DiscoveryCode.SIMULATED_TOO_HIGH_FOR
            lasting = {"hours": self.lasting_h}
        code = low if self.side == "low" else high
        return code(condition=self.condition, quantity=name, size=self.size, unit=unit, **lasting)


@dataclass(frozen=True)
class SpectralLine:
    """A significant periodicity that the model leaves unexplained.

    p: [1] probability of such a line by chance.  cause: the named cause in whose daily scores it appears; ""
        for a line in the errors themselves.
    """

    quantity: Name
    period_h: float
    p: float
    cause: Name = ""


@dataclass(frozen=True)
class ErrorGain:
    """Errors of the free run before and after the causes were added: RMSE [K] or [g/m³].

    period: "validation" or "identification".  lower, upper: 95 % bounds of the decrease.
    driven_before, driven_after: RMSE of the vapour when the measured temperature drives it, else NaN.

    Hours of named door openings are left out.
    """

    quantity: Name
    period: Name
    rmse_before: float = math.nan
    rmse_after: float = math.nan
    lower: float = math.nan
    upper: float = math.nan
    driven_before: float = math.nan
    driven_after: float = math.nan


@dataclass(frozen=True)
class CauseEvidence:
    """The evidence for a cause in its best form.

    gains: [1] gain in 2 ln L by quantity.  constants: number of added parameters.
    searched: number of settings that were tried.
    evidence: gains minus ln N for each constant and 2 ln of the settings.
    in_days: the same, divided by the correction for correlated days.
    lead: evidence in days minus that of the best other cause.
    """

    gains: Mapping[Name, float] = field(default_factory=dict)
    constants: int = 0
    searched: int = 0
    evidence: float = math.nan
    in_days: float = math.nan
    lead: float = math.nan


@dataclass(frozen=True)
class HeldOutTest:
    """Comparison of a model with and without a cause on held-out readings, by quantity.

    z: [1] mean daily change of the squared forecast errors (3, 12 and 48 h ahead), in standard errors.
    growth: [1] mean change of ln squared error, including the free run's.
    before, after: RMSE of the free run without and with the cause, levels fitted.
    gain: [1] in 2 ln L of the held-out readings.  days: number of days with readings.
    reason: why the cause is refuted, "" if it is not.
    """

    z: Mapping[Name, float] = field(default_factory=dict)
    growth: Mapping[Name, float] = field(default_factory=dict)
    before: Mapping[Name, float] = field(default_factory=dict)
    after: Mapping[Name, float] = field(default_factory=dict)
    gain: float = 0.0
    days: int = 0
    reason: Reason = ""

    @property
    def improvement(self) -> float:
        """[1] largest relative decrease of a quantity's free-run error; 0 without held-out readings."""
        pairs = [
            (rmse_before, self.after[q])
            for q, rmse_before in self.before.items()
            if rmse_before > 0 and q in self.after
        ]
        return max((1.0 - rmse_after / rmse_before for rmse_before, rmse_after in pairs), default=0.0)


@dataclass(frozen=True)
class CauseWords:
    """Texts of a cause from a user's own library: what it is, what to check, and how to tell it from its
    rivals."""

    meaning: Meaning
    remedy: Meaning
    separate_by: Meaning


@dataclass(frozen=True)
class CauseFound:
    """An accepted cause.

    form: code of its best form.  forms_alike: codes of its other forms that fit equally well.
    confidence: [1] probability that a cause with such evidence is right.
    parameters: its own parameters with bounds.  settings: of its features; chosen: those that the search
        chose.
    ambiguous_with: other causes that fit equally well; with more than two the cause is not named.
    own: texts of the cause if it comes from a user's library.
    """

    cause: Name
    form: Name = ""
    forms_alike: tuple[Name, ...] = ()
    confidence: float = math.nan
    parameters: Mapping[Name, ParameterRow] = field(default_factory=dict)
    settings: Settings = field(default_factory=dict)
    chosen: tuple[Name, ...] = ()
    evidence: CauseEvidence = field(default_factory=CauseEvidence)
    held_out: HeldOutTest = field(default_factory=HeldOutTest)
    ambiguous_with: tuple[Name, ...] = ()
    own: CauseWords | None = optional()

    @property
    def told_apart(self) -> bool:
        """Whether few enough causes are indistinguishable from this one for it to be named."""
        return len(self.ambiguous_with) < CLASS_LIMIT


@dataclass(frozen=True)
class Rejected:
    """A cause that was left out, with its best form, its evidence and the reason."""

    cause: Name
    form: Name = ""
    evidence: CauseEvidence = field(default_factory=CauseEvidence)
    reason: Exclusion = "no_effect"
    held_out: HeldOutTest = optional(HeldOutTest())


@dataclass(frozen=True)
class SearchCost:
    """Number of simulations of a search, its budget, and the causes that the budget left untested."""

    simulations: int = 0
    budget: int = 0
    not_judged: tuple[Name, ...] = ()


@dataclass(frozen=True)
class ModelScores:
    """Errors and time constants of the base or of the extended model, as in its `fit.json`."""

    rmse: Scores = field(default_factory=dict)
    baselines: RuleScores = field(default_factory=dict)
    time_constants: Mapping[Name, TimeConstant] = field(default_factory=dict)

    @cached_property
    def fit(self) -> FitResults:
        """These numbers as `FitResults`, for functions that take a fit."""
        return FitResults(**field_values(self))


@dataclass(frozen=True)
class DiscoveryResults:
    """The results of a discovery.

    verdict: on the whole record.  baseline, extended: scores of the model before and after; extended is None
        if no cause was accepted.
    estimator: of both models' parameters, "likelihood" or "output-error".
    gains: errors of both models by quantity.  held_out_days: number of days after the identification period.
    causes: accepted, in order.  rejected, refuted: left out, and contradicted by held-out readings.
    lines: spectral lines that remain unexplained.
    repeated: signal → spans [s] of repeated readings that were removed.
    saturated: [1] share of humidity readings at the end of the sensor's range.
    findings: errors of the base model's free run, worst first.  left: those of the final model.
    doubts: about the record, as far as they concern a time constant.
    """

    name: Name
    version: Version
    verdict: Verdict
    baseline: ModelScores
    provenance: Provenance = Provenance.MEASURED
    extended: ModelScores | None = None
    estimator: Literal["", "likelihood", "output-error"] = ""
    gains: tuple[ErrorGain, ...] = ()
    held_out_days: int = 0
    causes: tuple[CauseFound, ...] = ()
    rejected: tuple[Rejected, ...] = ()
    refuted: tuple[Rejected, ...] = ()
    lines: tuple[SpectralLine, ...] = ()
    work: SearchCost = field(default_factory=SearchCost)
    repeated: Mapping[Name, tuple[tuple[float, float], ...]] = field(default_factory=dict)
    saturated: float = math.nan
    findings: tuple[Finding, ...] = field(kw_only=True)
    left: tuple[Finding, ...] = ()
    doubts: tuple[Statement, ...] = ()

    @property
    def named(self) -> tuple[str, ...]:
        """The causes that the discovery names, each followed by those that fit equally well."""
        return tuple(
            name for cause in self.causes if cause.told_apart for name in (cause.cause, *cause.ambiguous_with)
        )

    def to_frame(self) -> pandas.DataFrame:
        """Return every tried cause as a row: form, verdict, confidence [1], evidence, improvement [1].

        improvement: largest relative decrease of a free-run error on held-out readings.
        """
        import pandas

        causes_with_verdict: list[tuple[CauseFound | Rejected, str, float]] = [
            *((c, "accepted", c.confidence) for c in self.causes),
            *((c, c.reason, math.nan) for c in (*self.refuted, *self.rejected)),
        ]
        rows = [
            (c.cause, c.form, verdict, confidence, c.evidence.evidence,
             c.held_out.improvement if c.held_out.days else math.nan)
            for c, verdict, confidence in causes_with_verdict
        ]  # fmt: skip
        columns = ["cause", "form", "verdict", "confidence", "evidence", "improvement"]
        frame = pandas.DataFrame(rows, columns=columns).set_index("cause")
        return with_units(frame, {"confidence": "1", "evidence": "1", "improvement": "1"})


@dataclass(frozen=True)
class Discovered:
    """Results of a discovery as read from files, with the residuals of the base and of the extended model."""

    results: DiscoveryResults
    before: Residuals | None = None
    after: Residuals | None = None

    def plot(self, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
        """Readings, base and extended model where the error is largest; else errors over the drivers.

        axes: matplotlib's; one, or one for each panel (episodes, or drivers by quantity).
            None: a new figure of pyplot, in the style of the reports.

        Returns the axes that were drawn on; nothing is shown.  Raises HygrokfError where the picture's
        data or matplotlib are missing, ValueError for more axes than panels.
        """
        return drawn(self, axes)


@dataclass(frozen=True)
class Discovery(Discovered):
    """A discovery: the base fit, the extended fit (None if no cause was accepted) and the results.

    `results.to_frame()` lists every cause that was tried.  A discovery can be pickled.
    """

    base: Fit = field(kw_only=True)
    extended: Fit | None = field(default=None, kw_only=True)

    def to_json(self) -> JsonObject:
        """Return the content of `discovery.json`."""
        data: JsonObject = plain(self.results)
        return data

    def __str__(self) -> str:
        """Return the record's name with the verdict, and each cause with its confidence [1]."""
        causes = [
            f"  {cause.cause} ({cause.form}), confidence {cause.confidence:.2f}"
            for cause in self.results.causes
        ]
        return "\n".join([f"{self.results.name}: {self.results.verdict}", *causes])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """Return the table of causes for a notebook."""
        return str(self.results.to_frame().to_html())


# --- files -----------------------------------------------------------------------------------

WHICH = ("before", "after")


def write_discovery(discovery: Discovery, directory: str | os.PathLike[str]) -> Path:
    """Write `discovery.json` and `discovery.npz`, and the extended model (the base without one) as `fit.json`
    and `series.npz`; returns the path of discovery.json.

    Pages of earlier results in the directory are removed first.  Raises OSError as the system gives it.
    """
    folder = Path(directory)
    write_fit(discovery.extended or discovery.base, folder)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **_arrays(discovery))  # type: ignore[arg-type]  # its flag is a keyword too
    write_bytes_whole(folder / DISCOVERY_SERIES, buffer.getvalue())
    return write_text_whole(folder / DISCOVERY, result_text(discovery.results))


def read_discovery(directory: str | os.PathLike[str]) -> Discovered:
    """Read the discovery in a directory.  Raises ResultFault that lists all faults."""
    folder, path = Path(directory), Path(directory) / DISCOVERY_SERIES
    faults: list[str] = []
    try:
        results = read_result(DiscoveryResults, folder / DISCOVERY, "hygrokf discover")
    except ResultFault as fault:
        faults.append(str(fault))
    try:
        arrays = read_arrays(path, "hygrokf discover")
        residuals = {which: _residuals(arrays, which) for which in WHICH}
    except ResultFault as fault:
        faults.append(str(fault))
    except (TypeError, ValueError) as fault:
        faults.append(f"{path}: expected arrays of residuals, found: {fault}; run `hygrokf discover` again")
    if faults:
        raise ResultFault("\n".join(faults))
    return Discovered(results, **residuals)


def _arrays(discovery: Discovery) -> dict[str, np.ndarray]:
    """Return all arrays of the residuals before and after, keyed "before/field" or "before/field/name"."""
    result = {}
    for which in WHICH:
        residuals_of_model = getattr(discovery, which)
        for name, value in vars(residuals_of_model).items() if residuals_of_model is not None else ():
            arrays_by_name = value.items() if isinstance(value, Mapping) else [(None, value)]
            for name_inside, array in arrays_by_name:
                result["/".join(filter(None, (which, name, name_inside)))] = np.asarray(array)
    return result


def _residuals(arrays: Mapping[str, np.ndarray], which: str) -> Residuals | None:
    """Return the residuals of one model ("before" or "after") from the arrays of `_arrays`; None if
    absent."""
    fields: dict[str, Any] = {}
    for key, array in arrays.items():
        model, name, *name_inside = key.split("/", 2)
        if model == which and name_inside:
            fields.setdefault(name, {})[name_inside[0]] = array
        elif model == which:
            fields[name] = array if array.ndim else float(array)
    return Residuals(**fields) if fields else None
