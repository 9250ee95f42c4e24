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
"""Quantity of a finding -> scored quantity."""
LASTING_KINDS = ("step", "drift", "season")
"""Kinds of a condition that begins once and lasts, so that it need not recur."""
Verdict: TypeAlias = Literal["none", "named", "ambiguous", "unexplained", "refuted"]
"""No effect is missing; every cause is named; one at least cannot be told from others; an effect is missing
beside what is named; held-out readings refute every cause that was found."""
Reason: TypeAlias = Literal["", "worse", "no_gain", "unproven", "no_effect"]
"""Why a cause is refuted: its held-out errors are larger; held-out readings cost it more evidence than it can
spare, or do not bear out little evidence; it has no effect in the final set."""
Exclusion: TypeAlias = Literal[
    "refuted", "no_effect", "weak", "weak_by_days", "later_gone", "left_to_budget", "no_form"
]
"""Why a cause was left out: held-out readings refute it; screening found nothing; too little evidence, or
evidence in days; it lost its place to later ones; the budget ended the search; the record cannot show it."""
CLASS_LIMIT = 3
"""Causes that a class may hold; a longer one names nothing."""


@dataclass(frozen=True)
class Finding:
    """An error of the free run in the identification period.

    kind: of the condition; driver: signal that it goes with, or "".
    side: of the readings on which the simulation lies under the condition; lasting_h: for how long an episode
        leaves the error, else NaN.
    size: [K], [g/m³] mean effect under the condition less that elsewhere, by generalised least squares under
        the error model.
    n_episodes: in which it is seen, of n_possible.
    sensor_share: [1] of its square that the sensors' accuracy explains.
    p_adjusted: [1] chance of it without a cause, as adjusted share of false discoveries.
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
        """Condition, quantity, size and side of the error."""
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
    """A line that is left in a spectrum: its quantity, its period [h], and the chance [1] of one without an
    effect; cause: the named one in whose daily scores it stands, "" in the errors themselves."""

    quantity: Name
    period_h: float
    p: float
    cause: Name = ""


@dataclass(frozen=True)
class ErrorGain:
    """Errors of the base and of the extended model's free run: root mean squares [K] or [g/m³], and the 95 %
    bounds of their difference.

    period: "validation" or "identification"; hours of openings that were named are left out of both.
    driven_before, driven_after: of the vapour on the measured temperature, else NaN; the errors themselves
    are those of `hygrokf.simulate`, on the simulated one.
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
    """Evidence of a cause's best form.

    gains: [1] 2 ln L by quantity, a difference of maxima; constants: free ones that it adds; searched:
    settings that were tried.
    evidence: the gains less ln N for each constant and 2 ln of the settings; in_days: the same by how
    independent its days are.  lead: by how much the best rival of another cause stays behind, in days.
    """

    gains: Mapping[Name, float] = field(default_factory=dict)
    constants: int = 0
    searched: int = 0
    evidence: float = math.nan
    in_days: float = math.nan
    lead: float = math.nan


@dataclass(frozen=True)
class HeldOutTest:
    """What held-out readings say of a cause beside the model without it, by quantity.

    z: [1] mean over days of the squared errors' change 3, 12 and 48 h ahead, in its standard errors; growth:
    [1] mean change of ln squared error, the free run's included; before, after: RMSE of the free runs with
    levels at their least squares; gain: [1] in 2 ln L of these readings; days: with readings.
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
        """[1] largest share by which a quantity's free-run error falls; 0 without held-out readings."""
        known = [(old, self.after[q]) for q, old in self.before.items() if old > 0 and q in self.after]
        return max((1.0 - new / old for old, new in known), default=0.0)


@dataclass(frozen=True)
class CauseWords:
    """The entry of a cause in a library of the user's own: what it is, what to check in the turbine, and the
    measurement that tells it from its rivals."""

    meaning: Meaning
    remedy: Meaning
    separate_by: Meaning


@dataclass(frozen=True)
class CauseFound:
    """An accepted cause.

    form: code of its best form; forms_alike: codes of those that the record cannot tell from it.
    confidence: [1] how often a name with such evidence is right.
    settings: those of its features; chosen: the names of those that the search chose.
    ambiguous_with: causes that the record cannot tell from it; more than two: it names nothing.
    own: its entry where it is none of the package's library, which holds the others under their names.
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
        """Whether its class is small enough to name something."""
        return len(self.ambiguous_with) < CLASS_LIMIT


@dataclass(frozen=True)
class Rejected:
    """A cause that was left out: its best form, its evidence, the reason, and the held-out test where there
    was one."""

    cause: Name
    form: Name = ""
    evidence: CauseEvidence = field(default_factory=CauseEvidence)
    reason: Exclusion = "no_effect"
    held_out: HeldOutTest = optional(HeldOutTest())


@dataclass(frozen=True)
class SearchCost:
    """What the search cost: simulations, those that it was allowed, and the causes that it therefore did not
    judge."""

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
        """These numbers as the results of a fit, for functions that take those."""
        return FitResults(**field_values(self))


@dataclass(frozen=True)
class DiscoveryResults:
    """The results of a discovery.

    baseline, extended: the model before and after; `extended` is None where no cause was accepted.
    estimator: of both models' parameters, "likelihood" or "output-error".
    gains: errors of both by quantity; held_out_days: with readings after the identification period.  As these
    can refute a cause, errors told from them are those after a selection.
    findings: errors of the base model's free run, worst first; left: those of the model that it ends with.
    causes: in the order in which they were accepted; rejected, refuted: those that were left out.
    lines: what is left without a cause.
    repeated: signal → stretches [s] of repeated readings that were set aside; saturated: [1] share of the
    humidity readings at the end of the sensor's range.
    doubts: those about the record that concern a time constant.
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
        """The causes that it names, each with those that the record cannot tell from it."""
        return tuple(
            name for one in self.causes if one.told_apart for name in (one.cause, *one.ambiguous_with)
        )

    def to_frame(self) -> pandas.DataFrame:
        """Every cause that was tried, by name: verdict on it, confidence [1], gain in evidence, and largest
        share [1] by which a free-run error on held-out readings falls."""
        import pandas

        judged: list[tuple[CauseFound | Rejected, str, float]] = [
            *((c, "accepted", c.confidence) for c in self.causes),
            *((c, c.reason, math.nan) for c in (*self.refuted, *self.rejected)),
        ]
        rows = [
            (c.cause, c.form, verdict, sure, c.evidence.evidence,
             c.held_out.improvement if c.held_out.days else math.nan)
            for c, verdict, sure in judged
        ]  # fmt: skip
        columns = ["cause", "form", "verdict", "confidence", "evidence", "improvement"]
        frame = pandas.DataFrame(rows, columns=columns).set_index("cause")
        return with_units(frame, {"confidence": "1", "evidence": "1", "improvement": "1"})


@dataclass(frozen=True)
class Discovered:
    """The content of a discovery's page: its results (`discovery.json`), and the residuals of both models."""

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
    """The base fit, the extended fit where a cause was accepted, and what was found.

    `results.to_frame()` lists every cause that was tried.  A discovery can be pickled.
    """

    base: Fit = field(kw_only=True)
    extended: Fit | None = field(default=None, kw_only=True)

    def to_json(self) -> JsonObject:
        """The data of `discovery.json`."""
        data: JsonObject = plain(self.results)
        return data

    def __str__(self) -> str:
        """The name with its verdict, and each cause with its confidence [1]."""
        causes = [
            f"  {one.cause} ({one.form}), confidence {one.confidence:.2f}" for one in self.results.causes
        ]
        return "\n".join([f"{self.results.name}: {self.results.verdict}", *causes])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return str(self.results.to_frame().to_html())


# --- files -----------------------------------------------------------------------------------

WHICH = ("before", "after")


def write_discovery(found: Discovery, directory: str | os.PathLike[str]) -> Path:
    """Write `discovery.json` and `discovery.npz`, and the extended model (the base without one) as `fit.json`
    and `series.npz`; returns the path of discovery.json.

    Pages of earlier results in the directory are removed first.  Raises OSError as the system gives it.
    """
    folder = Path(directory)
    write_fit(found.extended or found.base, folder)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **_arrays(found))  # type: ignore[arg-type]  # its flag is a keyword too
    write_bytes_whole(folder / DISCOVERY_SERIES, buffer.getvalue())
    return write_text_whole(folder / DISCOVERY, result_text(found.results))


def read_discovery(directory: str | os.PathLike[str]) -> Discovered:
    """The discovery of a directory; raises ResultFault that lists all faults."""
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


def _arrays(found: Discovery) -> dict[str, np.ndarray]:
    """Every array of both residuals under "which/field" or "which/field/name"."""
    result = {}
    for which in WHICH:
        one = getattr(found, which)
        for name, value in vars(one).items() if one is not None else ():
            parts = value.items() if isinstance(value, Mapping) else [(None, value)]
            for part, array in parts:
                result["/".join(filter(None, (which, name, part)))] = np.asarray(array)
    return result


def _residuals(arrays: Mapping[str, np.ndarray], which: str) -> Residuals | None:
    """Residuals from the arrays of `_arrays`; None where there are none."""
    found: dict[str, Any] = {}
    for key, array in arrays.items():
        head, name, *part = key.split("/", 2)
        if head == which and part:
            found.setdefault(name, {})[part[0]] = array
        elif head == which:
            found[name] = array if array.ndim else float(array)
    return Residuals(**found) if found else None
