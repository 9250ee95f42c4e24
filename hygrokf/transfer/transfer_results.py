"""The results of a transfer (transfer.json), and the courses of several records (readings and simulations
over time) in an .npz file, for figures."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from zipfile import BadZipFile

import numpy as np

from hygrokf.data.files import write_bytes_whole
from hygrokf.data.record import Provenance
from hygrokf.data.result_file import ResultFault, instants
from hygrokf.data.structured import optional
from hygrokf.evaluation.scoring import Errors
from hygrokf.evaluation.simulation import Prediction, measured
from hygrokf.identification.fit import Fit
from hygrokf.identification.turbine_type import TurbineType
from hygrokf.identification.verdict_terms import Inherited
from hygrokf.modelling.inputs import Run
from hygrokf.texts.parts import SCORED
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import Instant, Meaning, Name, Unit, Version
from hygrokf.texts.transfer_codes import TransferCode, TransferVerdict
from hygrokf.version import __version__

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True)
class RecordCourse:
    """The readings of one record, and simulations of them, by quantity [K], [g/m³].

    `time_s` (T,) [s since 1970]; `until_s` [s since 1970]: end of the identification period, NaN without one;
    `scored` (T,): whether all inputs are known; `operating` (T,); `measured` (T,) by quantity; `simulated`
    (T,) by name of the simulation, then by quantity.
    """

    time_s: np.ndarray
    until_s: float
    scored: np.ndarray
    operating: np.ndarray
    measured: Mapping[str, np.ndarray]
    simulated: Mapping[str, Mapping[str, np.ndarray]]

    @classmethod
    def of(cls, run: Run, simulated: Mapping[str, Prediction]) -> RecordCourse:
        """Return the readings of a run, and simulations of it by name."""
        timeline, readings, until_s = run.timeline, measured(run), run.record.until_s
        courses = {
            name: {q: mean_and_sd[0] for q in SCORED if (mean_and_sd := prediction.of(q)) is not None}
            for name, prediction in simulated.items()
        }
        end_s = math.nan if until_s is None else until_s
        scored_readings = {q: readings[q] for q in SCORED}
        return cls(timeline.seconds, end_s, run.scored, run.operating, scored_readings, courses)

    def __post_init__(self) -> None:
        series = {"scored": self.scored, "operating": self.operating}
        for name, values in {"measured": self.measured, **self.simulated}.items():
            series |= {f"{name} {quantity}": value for quantity, value in values.items()}
        faults = [
            f"{name}: expected {self.time_s.shape} numbers, found {value.shape}"
            for name, value in series.items()
            if value.shape != self.time_s.shape
        ]
        if not len(instants({"time_s": self.time_s})):
            faults.append("time_s: expected increasing instants [s since 1970]")
        if faults:
            raise ValueError("; ".join(faults))


def write_courses(courses: Sequence[RecordCourse], path: str | os.PathLike[str]) -> Path:
    """Write the courses of several records to one .npz file; its arrays have names such as
    "0/simulated/as_is/temperature_K". Raises OSError from the system."""
    tree = {str(number): vars(course) for number, course in enumerate(courses)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{"/".join(path_in_tree): array for path_in_tree, array in _leaves(tree)})
    return write_bytes_whole(path, buffer.getvalue())


def _leaves(tree: Mapping[str, Any], *parents: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the arrays of a nested mapping, each with the keys that lead to it."""
    for name, node in tree.items():
        if isinstance(node, Mapping):
            yield from _leaves(node, *parents, name)
        else:
            yield (*parents, name), node


def read_courses(path: Path, count: int, command: str) -> tuple[RecordCourse, ...]:
    """Read the courses of `count` records from a file that `command` wrote. Raises ResultFault."""
    tree_of_records: dict[str, Any] = {}
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            for key in file.files:
                *parents, name = key.split("/")
                node = tree_of_records
                for parent in parents:
                    node = node.setdefault(parent, {})
                node[name] = file[key][()]
        if sorted(tree_of_records) != sorted(map(str, range(count))):
            raise ValueError(f"those of {len(tree_of_records)} records where {count} were expected")
        return tuple(RecordCourse(**tree_of_records[str(number)]) for number in range(count))
    except (OSError, ValueError, TypeError, AttributeError, EOFError, BadZipFile) as fault:
        reason = getattr(fault, "strerror", None) or fault
    raise ResultFault(f"{path}: expected the courses of `{command}`, found: {reason}; run it again")


Outcome = Literal["travels", "differs", "own", "not judged"]


@dataclass(frozen=True)
class TransferSource:
    """The fit or type that is tried on other records, with the verdicts on its time constants."""

    name: Name
    kind: Literal["fit", "type"]
    verdicts: Mapping[Name, Inherited] = field(default_factory=dict)


@dataclass(frozen=True)
class Contrast:
    """The own value minus the original one (or divided by it), with 95 % bounds that include both
    uncertainties."""

    value: float
    lower: float
    upper: float

    @property
    def ratio(self) -> Contrast:
        """The ratio that a difference of logarithms stands for."""
        logarithms = (self.value, self.lower, self.upper)
        return Contrast(*(math.exp(min(max(logarithm, -50.0), 50.0)) for logarithm in logarithms))


@dataclass(frozen=True)
class ParameterChange:
    """One parameter in its unit: the original value, the record's own, and the value after re-estimating.

    `original_se`, `own_se`: standard errors, NaN without; `difference`: None if the parameter is not
    compared; `difference_is`: whether it is a ratio or a difference; `kept`: whether the record does not
    determine the parameter.
    """

    group: Name
    unit: Unit
    meaning: Meaning
    original: float
    original_se: float
    own: float
    own_se: float
    re_estimated: float
    difference: Contrast | None
    difference_is: Literal["ratio", "difference"] | None
    kept: bool


@dataclass(frozen=True)
class GroupChange:
    """Whether a group of parameters differs.

    `statistic`, `df`, `p`, and `p_adjusted` for the number of groups: of the test at the step of the
    selection that decided on the group; `effect`: root mean square change [K], [g/m³] of the free run by the
    group's own values. All are None if the group is not judged.
    """

    group: Name
    parameters: tuple[Name, ...]
    outcome: Outcome
    statement: Statement
    statistic: float | None = optional()
    df: int | None = optional()
    p: float | None = optional()
    p_adjusted: float | None = optional()
    effect: Mapping[Name, float] | None = optional()


@dataclass(frozen=True)
class LikelihoodRatio:
    """An exact likelihood ratio on this record alone; `p` is that of the ratio divided by `factor`."""

    of: Statement
    parameters: tuple[Name, ...]
    likelihood_ratio: float
    factor: float
    df: int
    p: float


@dataclass(frozen=True)
class SetError(Errors):
    """The root mean squared error [K], [g/m³] of one set of values; `bounds`: 95 % bounds of the total, None
    for too few readings."""

    bounds: tuple[float, float] | None = None


@dataclass(frozen=True)
class Reduction:
    """By how much the error is smaller than that of the set or rule `against` [K], [g/m³], with 95 %
    bounds."""

    against: Name
    gain: float
    lower: float = math.nan
    upper: float = math.nan


@dataclass(frozen=True)
class Structure:
    """The free-run error [K], [g/m³] with all parameters estimated here, the error of the fit on its own
    record, and the ratio of both with its lower 95 % bound."""

    rmse: float
    rmse_of_the_fit: float
    ratio: float
    lower: float


@dataclass(frozen=True)
class TransferResult:
    """The result of a fit or type on one record: an entry of transfer.json.

    `until`: end of the identification period; `n_readings` in it; `period`: the one that is scored;
    `re_estimate`: groups that differ; `parameters` by name; `rmse` and `gains` by quantity and set of values,
    gains then by "over_as_is" (compared with the model as it is) and "over_rule" (with the best rule without
    a model); `structure` by quantity; `at_bounds`: re-estimated parameters at a limit of their range;
    `converged` by set of values; `verdicts` on the time constants of the model to use here, empty if no fit
    was made.
    """

    name: Name
    provenance: Provenance
    until: Instant
    n_readings: int
    verdict: TransferVerdict
    reasons: tuple[Statement, ...]
    re_estimate: tuple[Name, ...]
    statements: tuple[Statement, ...]
    parameters: Mapping[Name, ParameterChange]
    groups: tuple[GroupChange, ...]
    likelihood_ratios: tuple[LikelihoodRatio, ...]
    period: Literal["identification", "validation"]
    rmse: Mapping[Name, Mapping[Name, SetError]]
    gains: Mapping[Name, Mapping[Name, Mapping[Name, Reduction]]]
    structure: Mapping[Name, Structure]
    at_bounds: tuple[Name, ...]
    converged: Mapping[Name, bool]
    source: TransferSource
    verdicts: Mapping[Name, Inherited] = field(default_factory=dict)

    @property
    def statement(self) -> Statement:
        """The statement of the verdict, with the groups that differ."""
        if self.verdict is TransferVerdict.PARTLY:
            return TransferCode.PARTLY_BY_GROUPS(groups=self.re_estimate)
        return self.verdict()

    def __str__(self) -> str:
        return f"{self.source.name} on {self.name}: {self.statement}"

    def to_frame(self) -> pandas.DataFrame:
        """Return one row for each parameter: group, unit, values, and the difference with 95 % bounds."""
        import pandas as pd

        rows = {}
        for name, parameter in self.parameters.items():
            change = parameter.difference or Contrast(math.nan, math.nan, math.nan)
            rows[name] = {
                "group": parameter.group, "unit": parameter.unit, "re_estimated": parameter.re_estimated,
                "original": parameter.original, "original_se": parameter.original_se,
                "own": parameter.own, "own_se": parameter.own_se, "difference_is": parameter.difference_is,
                "difference": change.value, "lower": change.lower, "upper": change.upper,
            }  # fmt: skip
        return pd.DataFrame.from_dict(rows, orient="index")


@dataclass(frozen=True)
class Transfer:
    """A fit on another turbine's record: its `results`, the `course` of all sets of values, the fit `adapted`
    to use there, and the fit `own` with every parameter estimated there (both None if they were not asked
    for)."""

    results: TransferResult
    course: RecordCourse
    adapted: Fit | None = None
    own: Fit | None = None

    @property
    def verdict(self) -> TransferVerdict:
        """The verdict on the transfer."""
        return self.results.verdict

    def __str__(self) -> str:
        return str(self.results)


@dataclass(frozen=True)
class TransferResults:
    """The content of transfer.json: one source on one or more records, and the type of turbine pooled from
    all of them, if any."""

    version: Version
    created: Instant
    records: tuple[TransferResult, ...]
    type: TurbineType | None

    @property
    def source(self) -> TransferSource:
        """The fit or type that was tried on all records."""
        return self.records[0].source


def transfer_results(transfers: Sequence[Transfer], pooled: TurbineType | None = None) -> TransferResults:
    """Return the content of transfer.json for transfers of one source."""
    return TransferResults(
        __version__,
        datetime.now(UTC).isoformat(timespec="seconds"),
        tuple(transfer.results for transfer in transfers),
        pooled,
    )
