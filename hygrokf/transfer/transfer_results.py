"""What a transfer finds: the content of transfer.json; and readings and simulations over time, for pictures,
with the .npz file that holds those of several records."""

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
    """One record's readings and what one or several models simulate of them, by quantity [K], [g/m³].

    `time_s` (T,) [s since 1970]; `until_s` [s since 1970] the end of the identification period, NaN without
    one; `scored` (T,) True where all inputs are known; `operating` (T,); `measured` (T,) by quantity;
    `simulated` (T,) by the name of the model or of its values, then by quantity.
    """

    time_s: np.ndarray
    until_s: float
    scored: np.ndarray
    operating: np.ndarray
    measured: Mapping[str, np.ndarray]
    simulated: Mapping[str, Mapping[str, np.ndarray]]

    @classmethod
    def of(cls, run: Run, simulated: Mapping[str, Prediction]) -> RecordCourse:
        """The readings of a run, and simulations of it by name."""
        t, known, until_s = run.timeline, measured(run), run.record.until_s
        courses = {
            name: {q: pair[0] for q in SCORED if (pair := prediction.of(q)) is not None}
            for name, prediction in simulated.items()
        }
        end_s = math.nan if until_s is None else until_s
        return cls(t.seconds, end_s, run.scored, run.operating, {q: known[q] for q in SCORED}, courses)

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
    """Write courses to one .npz file, atomically, with the places of arrays in them as names, such as
    "0/simulated/as_is/temperature_K".  Raises OSError from the system."""
    tree = {str(place): vars(course) for place, course in enumerate(courses)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{"/".join(place): array for place, array in _leaves(tree)})
    return write_bytes_whole(path, buffer.getvalue())


def _leaves(tree: Mapping[str, Any], *place: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    for name, one in tree.items():
        if isinstance(one, Mapping):
            yield from _leaves(one, *place, name)
        else:
            yield (*place, name), one


def read_courses(path: Path, count: int, command: str) -> tuple[RecordCourse, ...]:
    """The courses of `count` records from a file that `command` wrote.  Raises ResultFault."""
    found: dict[str, Any] = {}
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            for key in file.files:
                *place, name = key.split("/")
                tree = found
                for step in place:
                    tree = tree.setdefault(step, {})
                tree[name] = file[key][()]
        if sorted(found) != sorted(map(str, range(count))):
            raise ValueError(f"those of {len(found)} records where {count} were expected")
        return tuple(RecordCourse(**found[str(i)]) for i in range(count))
    except (OSError, ValueError, TypeError, AttributeError, EOFError, BadZipFile) as fault:
        reason = getattr(fault, "strerror", None) or fault
    raise ResultFault(f"{path}: expected the courses of `{command}`, found: {reason}; run it again")


Outcome = Literal["travels", "differs", "own", "not judged"]


@dataclass(frozen=True)
class TransferSource:
    """The fit or type that is tried elsewhere, with the verdicts on its time constants."""

    name: Name
    kind: Literal["fit", "type"]
    verdicts: Mapping[Name, Inherited] = field(default_factory=dict)


@dataclass(frozen=True)
class Contrast:
    """Own less original value, or own over original value, with 95 % bounds that count both uncertainties."""

    value: float
    lower: float
    upper: float

    @property
    def ratio(self) -> Contrast:
        """A difference of logarithms as a ratio."""
        return Contrast(*(math.exp(min(max(v, -50.0), 50.0)) for v in (self.value, self.lower, self.upper)))


@dataclass(frozen=True)
class ParameterChange:
    """One parameter in its unit: its original value, the record's own, and the value after re-estimating.

    `original_se`, `own_se` standard errors, NaN where there are none; `difference` None where the parameter
    is not compared, and `difference_is` how it is to be read; `kept`: this record says nothing about it.
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

    `statistic`, `df`, `p` and `p_adjusted` (for the number of groups) at the step of the selection that
    decided on the group; `effect` what the group's own values change in the free run, root mean square [K],
    [g/m³]; all None where the group is not judged.
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
    """An exact likelihood ratio on this record alone; it is divided by `factor` before `p` is taken."""

    of: Statement
    parameters: tuple[Name, ...]
    likelihood_ratio: float
    factor: float
    df: int
    p: float


@dataclass(frozen=True)
class SetError(Errors):
    """Root mean squared error [K], [g/m³] of one set of values; `bounds` 95 % of the total, where there are
    enough readings."""

    bounds: tuple[float, float] | None = None


@dataclass(frozen=True)
class Reduction:
    """By how much the error is smaller than that of the set or rule `against` [K], [g/m³], 95 % bounds."""

    against: Name
    gain: float
    lower: float = math.nan
    upper: float = math.nan


@dataclass(frozen=True)
class Structure:
    """Free-run error [K], [g/m³] with all parameters estimated here, that of the fit on its own record, and
    the ratio of both with its lower 95 % bound."""

    rmse: float
    rmse_of_the_fit: float
    ratio: float
    lower: float


@dataclass(frozen=True)
class TransferResult:
    """A fit or type on one record: an entry of transfer.json.

    `until` the end of the identification period; `n_readings` in it; `period` the one that is scored;
    `re_estimate` the groups that differ; `parameters` by name; `rmse` and `gains` by quantity and set of
    values, gains then "over_as_is" (the model as it is) and "over_rule" (the best rule without a model);
    `structure` by quantity; `at_bounds` re-estimated parameters at the edge of their range; `converged` by
    set of values; `verdicts` on the time constants of the model to use here, empty where no fit was made.
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
        """The verdict, with the groups that differ."""
        if self.verdict is TransferVerdict.PARTLY:
            return TransferCode.PARTLY_BY_GROUPS(groups=self.re_estimate)
        return self.verdict()

    def __str__(self) -> str:
        return f"{self.source.name} on {self.name}: {self.statement}"

    def to_frame(self) -> pandas.DataFrame:
        """One row a parameter: its group and unit, its values, and the difference with 95 % bounds."""
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
    """A fit on another turbine's record: its `results`, the `course` of all sets of values, and the record's
    own estimates: `adapted` the model to use there, `own` that with every parameter estimated there (None
    where they were not asked for)."""

    results: TransferResult
    course: RecordCourse
    adapted: Fit | None = None
    own: Fit | None = None

    @property
    def verdict(self) -> TransferVerdict:
        return self.results.verdict

    def __str__(self) -> str:
        return str(self.results)


@dataclass(frozen=True)
class TransferResults:
    """The content of transfer.json: one source on one or more records, and the type of all turbines where it
    was made."""

    version: Version
    created: Instant
    records: tuple[TransferResult, ...]
    type: TurbineType | None

    @property
    def source(self) -> TransferSource:
        """What is tried on all records."""
        return self.records[0].source


def transfer_results(transfers: Sequence[Transfer], pooled: TurbineType | None = None) -> TransferResults:
    """The content of transfer.json of transfers from one source."""
    return TransferResults(
        __version__,
        datetime.now(UTC).isoformat(timespec="seconds"),
        tuple(transfer.results for transfer in transfers),
        pooled,
    )
