"""What can be done for each turbine of a fleet: a table of tasks, one function each, from a `Job` to columns
of its row.

A task is added in `TASKS`: its function, its options, whether it uses a fitted model, the columns that it
gives, and those of them that turbines are compared by.
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hygrokf.data.files import write_text_whole
from hygrokf.data.result_file import result_text
from hygrokf.data.structured import Cell
from hygrokf.data.toml_form import FormFault, setting
from hygrokf.fleet.job import DONE, FAILED, Job, Outcome, Row, begin, finished, keep, outcome
from hygrokf.identification.verdict_terms import REJECT
from hygrokf.modelling.design import PARTS

if TYPE_CHECKING:
    from hygrokf.data.record import Record
    from hygrokf.evaluation.scoring import Scored
    from hygrokf.identification.fit import Fit
    from hygrokf.identification.fit_results import TimeConstant
    from hygrokf.identification.verdict_terms import Inherited

BETWEEN = " | "
"""Between the statements of a column: sentences have semicolons of their own."""


@dataclass(frozen=True)
class Compared:
    """A positive quantity by which turbines are compared on a logarithmic scale.

    column: its value; lower, upper: columns of its bounds, or empty. title, unit: for tables and pictures.
    verdict: the column that says whether it can be believed, or empty.
    """

    column: str
    title: str
    unit: str
    lower: str = ""
    upper: str = ""
    verdict: str = ""

    def rejected(self, row: Row) -> bool:
        """Whether a turbine's value is not to be believed."""
        return bool(self.verdict) and row.get(self.verdict) == REJECT


@dataclass(frozen=True)
class Task:
    """One thing that can be done for every turbine.

    perform: writes results into the job's folder and returns columns of its row; an exception is the
    turbine's failure. columns: name -> meaning with unit. compared: what turbines are compared by. ranking:
    the column by which they are ranked, largest first. uses_fit: whether a fitted model is needed.
    """

    perform: Callable[[Job], Row]
    meaning: str
    options: type[Any]
    columns: Mapping[str, str]
    compared: tuple[Compared, ...]
    ranking: str
    uses_fit: bool = False
    files: tuple[str, ...] = field(default=())
    """Options that hold paths: the bytes of these files are part of what the results follow from."""


def perform(job: Job) -> Outcome:
    """Do one job: whatever goes wrong becomes the reason in its row.  Work that is on disk already is not
    repeated."""
    there = finished(job)
    if there is not None:
        return there
    started = time.process_time()
    try:
        begin(job)
        columns = TASKS[job.task].perform(job)
        found = outcome(job, DONE, columns, seconds=time.process_time() - started)
    except Exception as fault:
        found = outcome(job, FAILED, None, reason_of(fault), time.process_time() - started)
    try:
        keep(job, found)
    except OSError as fault:
        reason = f"{job.folder}: cannot be written: {fault.strerror or fault}"
        return outcome(job, FAILED, None, reason, found.seconds)
    return found


def reason_of(fault: Exception) -> str:
    """A failure on one line; for one that no one foresaw also where it happened."""
    from hygrokf.cases.case_file import CaseFault

    listed = getattr(fault, "faults", ())
    text = " ".join(("; ".join(map(str, listed)) if listed else str(fault)).split())
    if isinstance(fault, FormFault) and not isinstance(
        fault, CaseFault
    ):  # the turbine's case goes without saying
        text = f"{fault.file}: {text}"
    if type(fault).__name__.endswith("Fault") or type(fault) in (ValueError, OSError):
        return text or type(fault).__name__
    where = traceback.extract_tb(fault.__traceback__)
    place = f" ({Path(where[-1].filename).name}, line {where[-1].lineno})" if where else ""
    return f"{type(fault).__name__}: {text or 'no more is said'}{place}"


# --- the tasks -------------------------------------------------------------------------------


def _fit(job: Job) -> Row:
    """Identify the models of a case, as `hygrokf fit` does."""
    from hygrokf.cases.case_file import read_case
    from hygrokf.identification.fit import write_fit
    from hygrokf.identification.procedure import identify

    record, options = read_case(job.case), job.options
    fit = identify(
        record,
        criterion=options["criterion"],
        kind=options["kind"],
        starts=options["starts"],
        profiles=options["profiles"],
    )
    write_fit(fit, job.folder)
    if options["report"]:
        from hygrokf.report.fit_page import write_report

        write_report(job.folder)
    return _of_fit(fit, record)


def _of_fit(fit: Fit, record: Record) -> Row:
    found = fit.results
    return {
        **_of_record(record),
        "converged": found.converged,
        "n_readings": found.period.n_readings,
        **_of_time_constants(found.time_constants),
        **_of_scores(found),
        "loglik": found.loglik,
        "at_bounds": " ".join(found.at_bounds),
    }


def _of_record(record: Record) -> dict[str, Cell]:
    from hygrokf.data.timestamps import stamp_text

    return {
        "record": record.name,
        "start": stamp_text(record.start_s),
        "end": stamp_text(record.end_s),
        "synthetic": "synthetic" in record.name.lower(),
        "warnings": len(record.warnings),
    }


def _of_time_constants(constants: Mapping[str, TimeConstant]) -> dict[str, Cell]:
    """Values, bounds, statements and verdicts; empty where a constant was not identified."""
    found: dict[str, Cell] = {}
    for name in PARTS:
        one = constants.get(name)
        for part in ("value", "lower", "upper"):
            found[f"{name}_{part}_h"] = math.nan if one is None else getattr(one, f"{part}_h")
        found[f"{name}_statement"] = "" if one is None else one.statement
    return found | _of_verdicts(constants)


def _of_verdicts(known: Mapping[str, TimeConstant | Inherited]) -> dict[str, Cell]:
    """The verdict on each time constant of a fit, or of what inherited its numbers; empty without one."""
    return {f"{part}_verdict": (known[part].verdict or "") if part in known else "" for part in PARTS}


def _of_scores(found: Scored) -> dict[str, Cell]:
    """Free-run errors in total, of the validation period where it was scored and else of the identification
    period."""
    scored = math.isfinite(found.errors("validation", "temperature_K").total)
    period = "validation" if scored else "identification"
    errors = {column: found.errors(period, quantity).total for quantity, column in _ERRORS.items()}
    return {"scored_period": period, **errors}


_ERRORS = {"temperature_K": "temperature_rmse_K", "absolute_humidity_g_m3": "humidity_rmse_g_m3"}


def _discover(job: Job) -> Row:
    """Show what the simulation gets wrong, name the cause, extend the model, as `hygrokf discover` does."""
    from hygrokf.cases.case_file import read_case
    from hygrokf.discovery.library import LIBRARY
    from hygrokf.discovery.own_causes import load_library
    from hygrokf.discovery.procedure import discover
    from hygrokf.discovery.results import write_discovery
    from hygrokf.report.discovery_page import write_discovery_report
    from hygrokf.report.discovery_text import scored_error

    own = load_library(*job.options["library"], installed=True)
    record = read_case(job.case)
    made = discover(record, starts=job.options["starts"], library=(*LIBRARY, *own))
    if job.options["report"]:
        write_discovery_report(made, job.folder)
    else:
        write_discovery(made, job.folder)
    found = made.results
    columns: dict[str, Cell] = {
        **_of_record(record),
        "verdict": found.verdict,
        "causes": " ".join(one.cause for one in found.causes),
        "confidence": min((one.confidence for one in found.causes), default=math.nan),
        **_of_time_constants((found.extended or found.baseline).time_constants),
    }
    for quantity, column in _ERRORS.items():
        before, after, period = scored_error(found, quantity)
        columns |= {"scored_period": columns.get("scored_period") or period}
        columns |= {column: after if math.isfinite(after) else before, f"base_{column}": before}
    return columns


def _evaluate(job: Job) -> Row:
    """Score a fitted model on a case, as `hygrokf evaluate` does."""
    from hygrokf.cases.case_file import read_case
    from hygrokf.identification.fit_on_record import evaluate

    fit, record = _stored(job), read_case(job.case)
    found = evaluate(fit, record)
    write_text_whole(job.folder / "evaluation.json", result_text(found))
    columns: dict[str, Cell] = {
        **_of_record(record),
        "model": fit.name,
        **_of_verdicts(found.verdicts),
        **_of_scores(found),
    }
    for quantity, column in _ERRORS.items():
        errors = found.errors(str(columns["scored_period"]), quantity)
        columns[column.replace("rmse", "rmse_operation")] = errors.operation
        columns[column.replace("rmse", "rmse_standstill")] = errors.standstill
        columns[f"{column.partition('_rmse')[0]}_coverage"] = found.band("free_run", quantity).coverage
    columns["statements"] = BETWEEN.join(found.statements)
    return columns


def _fit_of(job: Job) -> Path:
    """The fitted model, or type, that a job uses."""
    assert job.fit is not None, f"{job.task} needs a fit"
    return job.fit


def _stored(job: Job) -> Fit:
    """The fitted model that a job uses, with causes of the user's own where it has some."""
    from hygrokf.identification.fit import LibraryAbsent, read_fit

    try:
        return read_fit(_fit_of(job))
    except LibraryAbsent:
        from hygrokf.discovery.own_causes import load_library

        load_library(*job.options["library"], installed=True)
        return read_fit(_fit_of(job))


def _transfer(job: Job) -> Row:
    """Try a fitted model, or a type, on another turbine's record, as `hygrokf transfer` does."""
    from hygrokf.cases.case_file import read_case
    from hygrokf.identification.turbine_type import is_type, read_type
    from hygrokf.report.transfer_page import write_transfer
    from hygrokf.transfer.procedure import transfer_fit

    record = read_case(job.case)
    source = _fit_of(job)
    made = transfer_fit(read_type(source) if is_type(source) else _stored(job), record)
    write_transfer([made], job.folder)
    results = made.results
    columns: dict[str, Cell] = {
        **_of_record(record),
        "model": results.source.name,
        "transfer": results.verdict,
        "re_estimate": " ".join(results.re_estimate),
        "sentence": results.sentence,
        **{f"{p}_verdict": results.verdicts[p].verdict if p in results.verdicts else "" for p in PARTS},
        "scored_period": results.period,
    }
    for quantity, column in _ERRORS.items():
        for which, name in (("re_estimated", column), ("as_is", f"as_is_{column}")):
            error = results.rmse.get(quantity, {}).get(which)
            columns[name] = error.total if error is not None else math.nan
        gains = results.gains.get(quantity, {}).get("re_estimated")
        gain = gains.over_as_is if gains is not None else None
        for part, suffix in (("gain", ""), ("lower", "_lower"), ("upper", "_upper")):
            columns[f"{column.replace('rmse', 'gain')}{suffix}"] = getattr(gain, part, math.nan)
    return columns


def _climate(job: Job) -> Row:
    """The climate in a fitted cabinet under the weather and power of a case, as `hygrokf climate` has it."""
    from hygrokf.cases.case_file import read_case
    from hygrokf.climate.limits import read_limits
    from hygrokf.climate.procedure import climate_profile
    from hygrokf.climate.region import Region, read_power
    from hygrokf.report.climate_page import write_climate_report

    fit, options = _stored(job), job.options
    weather = read_case(job.case, cabinet=False)
    still = options["standstill"] or fit.design.power_scale_W is None
    study = climate_profile(
        fit,
        [Region(job.turbine, weather, (job.case.name,))],
        None if still else read_power(job.case),
        limits=[one for file in options["limits"] for one in read_limits(file)],
        members=options["members"],
        seed=options["seed"],
    )
    write_climate_report(study, job.folder)
    (region,) = study.regions
    columns: dict[str, Cell] = {
        **_of_record(weather),
        "model": fit.name,
        **_of_verdicts(study.verdicts),
        "bounds_hold": region.bounds_hold,
    }
    for name in _CLIMATE:
        one = region.year.get(name)
        for part, column in (("value", name), ("lower", f"{name}_lower"), ("upper", f"{name}_upper")):
            columns[column] = getattr(one, part) if one else math.nan
    columns["limits"] = region.verdict
    columns["wetness_class"] = region.wetness_class or ""
    columns["statements"] = BETWEEN.join(region.statements)
    return columns


_CLIMATE = {
    "mean_temperature_degC": "mean temperature in the cabinet [°C]",
    "mean_relative_humidity_percent": "mean relative humidity in the cabinet [%]",
    "wetness_h": "time of wetness, above 80 % and 0 °C [h a year]",
    "condensation_h": "condensation on the coldest surface [h a year]",
    "ageing_h": "hours at the reference condition that age as much, by Peck's law [h a year]",
}

# --- the table of tasks ----------------------------------------------------------------------

_RECORD = {
    "record": "name of the record, from the case file",
    "start": "first reading of the record [UTC]",
    "end": "last reading of the record [UTC]",
    "synthetic": "whether the record says of itself that a computer made it",
    "warnings": "how many things were masked or repaired at reading",
}
_CONSTANTS = {
    f"{name}_{part}": f"{text} of the {name} time constant{unit}"
    for name in ("thermal", "hygric")
    for part, text, unit in (
        ("value_h", "estimate", " [h]"),
        ("lower_h", "lower 95 % bound", " [h]"),
        ("upper_h", "upper 95 % bound", " [h], empty where the data do not bound it"),
        ("statement", "what is to be said", ", empty where value and bounds say it"),
    )
}
_VERDICTS = {
    f"{name}_verdict": f"whether the {name} time constant of the model can be believed: believe, caution or "
    "reject"
    for name in PARTS
}
_SCORES = {
    "scored_period": "period of the errors: validation, or identification where nothing is held out",
    "temperature_rmse_K": "free-run error of the temperature in total, root mean square [K]",
    "humidity_rmse_g_m3": "free-run error of the absolute humidity in total, root mean square [g/m³]",
}
_COMPARED_CONSTANTS = tuple(
    Compared(
        f"{name}_value_h",
        f"{name} time constant",
        "h",
        f"{name}_lower_h",
        f"{name}_upper_h",
        f"{name}_verdict",
    )
    for name in PARTS
)
_COMPARED_ERRORS = (
    Compared("temperature_rmse_K", "free-run error of the temperature", "K"),
    Compared("humidity_rmse_g_m3", "free-run error of the absolute humidity", "g/m³"),
)
_ENDS = (("", ""), ("_lower", "lower 95 % bound of "), ("_upper", "upper 95 % bound of "))
_FILES = "a list of paths in quotes"


@dataclass(frozen=True)
class Library:
    """The options of tasks that simulate."""

    library: tuple[str, ...] = setting(
        (), "files with causes of your own, which are executed", expected=_FILES
    )


@dataclass(frozen=True)
class FitOptions:
    """The options of the task "fit"."""

    criterion: str = setting(
        "likelihood", "innovations, or the free run's error", choices=("likelihood", "simulation")
    )
    kind: str = setting(
        "cascade", "hygric on the measured temperature, or one filter", choices=("cascade", "joint")
    )
    starts: int = setting(5, "starts of the search for the maximum", least=1)
    profiles: bool = setting(False, "bounds by profile likelihood; without, Wald bounds")
    report: bool = setting(False, "write each turbine's own page too")


@dataclass(frozen=True)
class DiscoverOptions(Library):
    """The options of the task "discover"."""

    starts: int = setting(5, "starts of the search for the maximum", least=1)
    report: bool = setting(True, "write each turbine's own page too")


@dataclass(frozen=True)
class ClimateOptions(Library):
    """The options of the task "climate"."""

    standstill: bool = setting(False, "no power all year; without, the case has `active_power`")
    limits: tuple[str, ...] = setting((), "files with limits to hold the climate against", expected=_FILES)
    members: int = setting(50, "of the ensemble", least=2)
    seed: int = setting(1, "of the ensemble", least=0)


TASKS: Mapping[str, Task] = {
    "fit": Task(
        _fit,
        "identify the models of every case",
        FitOptions,
        {
            **_RECORD,
            "converged": "whether every climb ended at a maximum",
            "n_readings": "readings of the identification period",
            **_CONSTANTS,
            **_VERDICTS,
            **_SCORES,
            "loglik": "log-likelihood of all stages",
            "at_bounds": "parameters that ended at a bound",
        },
        (*_COMPARED_CONSTANTS, *_COMPARED_ERRORS),
        "temperature_rmse_K",
    ),
    "discover": Task(
        _discover,
        "name what every simulation lacks",
        DiscoverOptions,
        {
            **_RECORD,
            "verdict": "none, named or unexplained",
            "causes": "accepted causes, in the order in which they were accepted",
            "confidence": "least confidence of the accepted causes [1]",
            **_CONSTANTS,
            **_VERDICTS,
            **_SCORES,
            "base_temperature_rmse_K": "free-run error of the temperature before the extension [K]",
            "base_humidity_rmse_g_m3": "free-run error of the absolute humidity before the extension [g/m³]",
        },
        (*_COMPARED_CONSTANTS, *_COMPARED_ERRORS),
        "temperature_rmse_K",
        files=("library",),
    ),
    "evaluate": Task(
        _evaluate,
        "score a fitted model on every case",
        Library,
        {
            **_RECORD,
            "model": "name of the fitted model",
            **_VERDICTS,
            **_SCORES,
            **{
                f"{name}_rmse_{regime}_{unit}": f"the same of the {text} {words} "
                f"[{unit.replace('g_m3', 'g/m³')}]"
                for name, unit, text in (
                    ("temperature", "K", "temperature"),
                    ("humidity", "g_m3", "absolute humidity"),
                )
                for regime, words in (("operation", "in operation"), ("standstill", "at standstill"))
            },
            "temperature_coverage": "share of temperature readings inside the free run's 95 % band [1]",
            "humidity_coverage": "share of absolute humidities inside the free run's 95 % band [1]",
            "statements": "what the record brings that the model does not know, and the reverse",
        },
        _COMPARED_ERRORS,
        "temperature_rmse_K",
        uses_fit=True,
        files=("library",),
    ),
    "transfer": Task(
        _transfer,
        "try a fitted model on every case, and say what travels",
        Library,
        {
            **_RECORD,
            "model": "name of the fitted model",
            "transfer": "whether the model transfers, transfers after re-estimating, or does not",
            "re_estimate": "groups of parameters that are to be re-estimated",
            "sentence": "the verdict in words",
            **_VERDICTS,
            **_SCORES,
            **{
                f"as_is_{column}": f"the same of the {text}, with the model as it is [{unit}]"
                for column, text, unit in (
                    ("temperature_rmse_K", "temperature", "K"),
                    ("humidity_rmse_g_m3", "absolute humidity", "g/m³"),
                )
            },
            **{
                f"{column}{end}": f"{words}what re-estimating takes off the error of the {text} [{unit}]"
                for column, text, unit in (
                    ("temperature_gain_K", "temperature", "K"),
                    ("humidity_gain_g_m3", "absolute humidity", "g/m³"),
                )
                for end, words in _ENDS
            },
        },
        _COMPARED_ERRORS,
        "temperature_rmse_K",
        uses_fit=True,
        files=("library",),
    ),
    "climate": Task(
        _climate,
        "simulate a year's climate in every cabinet",
        ClimateOptions,
        {
            **_RECORD,
            "model": "name of the fitted model",
            **_VERDICTS,
            "bounds_hold": "share of single years that the bounds hold [1]",
            **{
                f"{name}{end}": f"{words}{meaning}"
                for name, meaning in _CLIMATE.items()
                for end, words in (("", ""), ("_lower", "lower bound of "), ("_upper", "upper bound of "))
            },
            "limits": "worst verdict on the limits: fail, undecided or pass; empty without any",
            "wetness_class": "class of the time of wetness, ISO 9223:1992",
            "statements": "how weather and power were put together",
        },
        (
            Compared("ageing_h", "ageing", "h a year", "ageing_h_lower", "ageing_h_upper"),
            Compared("wetness_h", "time of wetness", "h a year", "wetness_h_lower", "wetness_h_upper"),
        ),
        "ageing_h",
        uses_fit=True,
        files=("library", "limits"),
    ),
}
"""Every task by its name in FLEET.toml."""

SHARED = {
    "turbine": "name of the turbine in the fleet",
    "status": "done; failed: see reason; lost: its process died, twice",
    "reason": "why there is no result, empty otherwise",
    "task": "what was done",
    "key": "SHA-256 of what the row follows from: version, task, options, case, data files, fit",
}
"""Columns of every row, in front of the task's."""
