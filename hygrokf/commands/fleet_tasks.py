"""The tasks of a fleet: `run_fleet` does one task for all turbines.

A task does for one turbine what the command of the same name does for one case. Processes and Dask workers
import `do_task` by its name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.cases.case_file import read_case
from hygrokf.commands.opening import library_of, source_model, stored_fit
from hygrokf.data.files import write_text_whole
from hygrokf.data.result_file import result_text
from hygrokf.data.structured import Cell
from hygrokf.fleet.fleet_plan import FleetPlan
from hygrokf.fleet.fleet_results import FleetResults
from hygrokf.fleet.job import Job, Row, Work
from hygrokf.fleet.running import run_jobs
from hygrokf.fleet.tasks import CLIMATE_COLUMNS
from hygrokf.identification.fit import write_fit
from hygrokf.report.fit_page import write_report
from hygrokf.report.fleet_page import write_fleet_report
from hygrokf.report.transfer_page import write_transfer
from hygrokf.texts.fleet_codes import FleetCode
from hygrokf.texts.parts import PARTS
from hygrokf.texts.statement import Statement
from hygrokf.texts.wording import stamp_text

if TYPE_CHECKING:
    from hygrokf.data.record import Record
    from hygrokf.evaluation.scoring import Scored
    from hygrokf.identification.fit_results import TimeConstant
    from hygrokf.identification.verdict_terms import Inherited

ERROR_COLUMNS = {"temperature_K": "temperature_rmse_K", "absolute_humidity_g_m3": "humidity_rmse_g_m3"}
"""Scored quantity → column of its free-run error."""


def run_fleet(
    plan: FleetPlan,
    out: Path,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    say: Callable[[Row, bool], None] = lambda row, is_stored: None,
) -> FleetResults:
    """Do the task of a plan for every turbine.

    plan: content of FLEET.toml (`fleet.fleet_plan.read_plan`).
    out: directory for fleet.csv, fleet.parquet, fleet.json and report.html; the results of each turbine go to
        `turbines/NAME`.
    workers: number of processes on this machine; None: one per core.
    cluster: address of a Dask scheduler, whose workers see the same files under the same paths.
    say: called with each row when it is ready, and with True if the row was on disk already.

    A turbine with unchanged files, options and version is not repeated; failed turbines are tried again.

    Returns the table, which does not depend on where it was computed. Raises FleetFault if the cluster cannot
    be reached, ClassFault for limits of an unknown class.
    """
    from hygrokf.climate.limits import limits_of

    for limits in plan.options.get("limits", ()):
        if not Path(limits).is_file():
            limits_of(limits)  # raises ClassFault for an unknown class before any work
    results = run_jobs(plan, out, do_task, workers=workers, cluster=cluster, say=say)
    write_fleet_report(out)
    return results


def do_task(job: Job) -> Row:
    """Do the task of a job; returns the columns of its row. Raises the exceptions of the task."""
    return WORK[job.task](job)


def _fit(job: Job) -> Row:
    """Identify the models of a turbine, write the fit, and return its columns."""
    from hygrokf.identification.identify import identify

    record, options = read_case(job.case), dict(job.options)
    report = options.pop("report")
    fit = identify(record, **options)
    write_fit(fit, job.folder)
    if report:
        write_report(job.folder)
    results = fit.results
    return {
        **_record_columns(record),
        "converged": results.converged,
        "n_readings": results.period.n_readings,
        **_time_constant_columns(results.time_constants),
        **_score_columns(results),
        "loglik": results.loglik,
        "at_bounds": results.at_bounds,
    }


def _record_columns(record: Record) -> dict[str, Cell]:
    """Return the columns that describe a record."""
    return {
        "record": record.name,
        "start": stamp_text(record.start_s),
        "end": stamp_text(record.end_s),
        "provenance": record.provenance,
        "warnings": len(record.warnings),
    }


def _time_constant_columns(constants: Mapping[str, TimeConstant]) -> dict[str, Cell]:
    """Return the columns of both time constants: value, bounds, remark and verdict."""
    columns: dict[str, Cell] = {}
    for name in PARTS:
        constant = constants.get(name)
        for field_name in ("value_h", "lower_h", "upper_h"):
            columns[f"{name}_{field_name}"] = getattr(constant, field_name, math.nan)
        columns[f"{name}_statement"] = (
            "" if constant is None or constant.closed else _open_statement(constant)
        )
    return columns | _verdict_columns(constants)


def _open_statement(constant: TimeConstant) -> Statement:
    """Return the statement on a time constant that lacks a bound."""
    if 0 < constant.upper_h < math.inf:
        return FleetCode.NOT_ABOVE(bound=constant.upper_h)
    if 0 < constant.lower_h < math.inf:
        return FleetCode.NOT_BELOW(bound=constant.lower_h)
    return FleetCode.NO_BOUNDS()


def _verdict_columns(results: Mapping[str, TimeConstant | Inherited]) -> dict[str, Cell]:
    """The verdict on each time constant of a fit, or of a result that uses a fit; "" without a verdict."""
    return {f"{part}_verdict": (results[part].verdict or "") if part in results else "" for part in PARTS}


def _score_columns(results: Scored) -> dict[str, Cell]:
    """Return the total free-run errors of the validation period, or of the identification period if nothing
    was validated."""
    is_validated = math.isfinite(results.errors("validation", "temperature_K").total)
    period = "validation" if is_validated else "identification"
    errors = {column: results.errors(period, quantity).total for quantity, column in ERROR_COLUMNS.items()}
    return {"scored_period": period, **errors}


def _discover(job: Job) -> Row:
    """Discover what the model of a turbine lacks, write the results, and return their columns."""
    from hygrokf.discovery.discover import discover
    from hygrokf.discovery.discovery_results import write_discovery
    from hygrokf.report.discovery_page import write_discovery_report

    library = library_of(job.options["library"], installed=True)
    record = read_case(job.case)
    discovery = discover(record, library=library)
    write_results = write_discovery_report if job.options["report"] else write_discovery
    write_results(discovery, job.folder)
    results = discovery.results
    named_causes = [cause for cause in results.causes if cause.told_apart]
    final_model = results.extended or results.baseline
    columns: dict[str, Cell] = {
        **_record_columns(record),
        "verdict": results.verdict,
        "causes": tuple("/".join((cause.cause, *cause.ambiguous_with)) for cause in named_causes),
        "confidence": min((cause.confidence for cause in named_causes), default=math.nan),
        "not_judged": results.work.not_judged,
        **_time_constant_columns(final_model.time_constants),
        **_score_columns(final_model.fit),
    }
    base_scores = _score_columns(results.baseline.fit)
    return columns | {f"base_{column}": base_scores[column] for column in ERROR_COLUMNS.values()}


def _evaluate(job: Job) -> Row:
    """Score a fitted model on a turbine's record, write the scores, and return their columns."""
    from hygrokf.identification.fit_on_record import evaluate

    fit, record = stored_fit(*_model_files(job)), read_case(job.case)
    evaluation = evaluate(fit, record)
    write_text_whole(job.folder / "evaluation.json", result_text(evaluation))
    columns: dict[str, Cell] = {
        **_record_columns(record),
        "model": fit.name,
        **_verdict_columns(evaluation.verdicts),
        **_score_columns(evaluation),
    }
    for quantity, column in ERROR_COLUMNS.items():
        errors = evaluation.errors(str(columns["scored_period"]), quantity)
        columns[column.replace("rmse", "rmse_operation")] = errors.operation
        columns[column.replace("rmse", "rmse_standstill")] = errors.standstill
        columns[f"{column.partition('_rmse')[0]}_coverage"] = evaluation.band("free_run", quantity).coverage
    columns["statements"] = evaluation.statements
    return columns


def _model_files(job: Job) -> tuple[Path, list[Path]]:
    """Return the fit of a job, and its files with causes of the user."""
    assert job.fit is not None, f"{job.task} needs a fit"
    return job.fit, [Path(file) for file in job.options["library"]]


def _transfer(job: Job) -> Row:
    """Try a fitted model on a turbine's record, write the results, and return their columns."""
    from hygrokf.transfer.transfer_fit import transfer_fit

    record = read_case(job.case)
    transfer = transfer_fit(source_model(*_model_files(job)), record)
    write_transfer([transfer], job.folder)
    results = transfer.results
    columns: dict[str, Cell] = {
        **_record_columns(record),
        "model": results.source.name,
        "transfer": results.verdict(),
        "re_estimate": results.re_estimate,
        "sentence": results.statement,
        **_verdict_columns(results.verdicts),
        "scored_period": results.period,
    }
    for quantity, column in ERROR_COLUMNS.items():
        for set_name, error_column in (("re_estimated", column), ("as_is", f"as_is_{column}")):
            error = results.rmse.get(quantity, {}).get(set_name)
            columns[error_column] = error.total if error is not None else math.nan
        gain = results.gains.get(quantity, {}).get("re_estimated", {}).get("over_as_is")
        for field_name, suffix in (("gain", ""), ("lower", "_lower"), ("upper", "_upper")):
            columns[f"{column.replace('rmse', 'gain')}{suffix}"] = getattr(gain, field_name, math.nan)
    return columns


def _climate(job: Job) -> Row:
    """Simulate the climate in a turbine's cabinet, write the results, and return their columns."""
    from hygrokf.climate.climate_profile import climate_profile
    from hygrokf.climate.limits import limits_of
    from hygrokf.climate.region import Region, read_power
    from hygrokf.report.climate_page import write_climate_report

    fit, options = stored_fit(*_model_files(job)), job.options
    weather = read_case(job.case, cabinet=False)
    is_standstill = options["standstill"] or fit.design.power_scale_W is None
    study = climate_profile(
        fit,
        [Region(job.turbine, weather, (job.case.name,))],
        None if is_standstill else read_power(job.case),
        limits=[limit for file in options["limits"] for limit in limits_of(file)],
        members=options["members"],
        seed=options["seed"],
    )
    write_climate_report(study, job.folder)
    (region,) = study.regions
    columns: dict[str, Cell] = {
        **_record_columns(weather),
        "model": fit.name,
        **_verdict_columns(study.verdicts),
        "bounds_hold": region.bounds_hold,
    }
    for name in CLIMATE_COLUMNS:
        for field_name, suffix in (("value", ""), ("lower", "_lower"), ("upper", "_upper")):
            columns[f"{name}{suffix}"] = getattr(region.year.get(name), field_name, math.nan)
    columns["limits"] = region.verdict
    columns["wetness_class"] = region.wetness_class or ""
    columns["statements"] = (*region.statements, *region.warnings)
    return columns


WORK: Mapping[str, Work] = {
    "fit": _fit,
    "discover": _discover,
    "evaluate": _evaluate,
    "transfer": _transfer,
    "climate": _climate,
}
"""Name of a task in `fleet.tasks.TASKS` → function that does it."""
