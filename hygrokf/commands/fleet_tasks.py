"""What each task of a fleet does for one turbine, the same as the command of its name does for one case; and
`run_fleet`, which does it for all of them.

Processes and Dask workers import `do_task` by its name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.cases.case_file import read_case
from hygrokf.commands.inputs import library_of, source_model, stored_fit
from hygrokf.data.files import write_text_whole
from hygrokf.data.result_file import result_text
from hygrokf.data.structured import Cell
from hygrokf.fleet.job import Job, Row, Work
from hygrokf.fleet.plan import FleetPlan
from hygrokf.fleet.results import FleetResults
from hygrokf.fleet.running import run_jobs
from hygrokf.fleet.tasks import CLIMATE_COLUMNS
from hygrokf.identification.fit import write_fit
from hygrokf.modelling.design import PARTS
from hygrokf.report.fit_page import write_report
from hygrokf.report.fleet_page import write_fleet_report
from hygrokf.report.transfer_page import write_transfer
from hygrokf.texts.fleet import FleetCode
from hygrokf.texts.statement import Statement
from hygrokf.texts.wording import stamp_text

if TYPE_CHECKING:
    from hygrokf.data.record import Record
    from hygrokf.evaluation.scoring import Scored
    from hygrokf.identification.fit_results import TimeConstant
    from hygrokf.identification.verdict_terms import Inherited

ERRORS = {"temperature_K": "temperature_rmse_K", "absolute_humidity_g_m3": "humidity_rmse_g_m3"}
"""Scored quantity → the column of its free-run error."""


def run_fleet(
    plan: FleetPlan,
    out: Path,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    say: Callable[[Row, bool], None] = lambda found, known: None,
) -> FleetResults:
    """Do what a plan states for every turbine.

    plan: of a fleet's file (`fleet.plan.read_plan`).
    out: directory of fleet.csv, fleet.parquet, fleet.json and report.html; results of each turbine are in
        `turbines/NAME`.
    workers: processes on this machine, by default one per core.
    cluster: address of a Dask scheduler, whose workers see the same files under the same paths.
    say: is called with each row as it comes, and whether it was on disk already.

    Work with the same files, options and version is not repeated; failures are tried again.

    Returns the table, the same on processes and on a cluster.  Raises FleetFault where there is no cluster,
    ClassFault for limits of an unknown class.
    """
    from hygrokf.climate.limits import limits_of

    for one in plan.options.get("limits", ()):
        if not Path(one).is_file():  # a name that is that of no known class ends here, before any work
            limits_of(one)
    found = run_jobs(plan, out, do_task, workers=workers, cluster=cluster, say=say)
    write_fleet_report(out)
    return found


def do_task(job: Job) -> Row:
    """Do the task of a job; returns the columns of its row.  Raises what the task raises."""
    return WORK[job.task](job)


def _fit(job: Job) -> Row:
    from hygrokf.identification.procedure import identify

    record, options = read_case(job.case), dict(job.options)
    report = options.pop("report")
    fit = identify(record, **options)
    write_fit(fit, job.folder)
    if report:
        write_report(job.folder)
    found = fit.results
    return {
        **_of_record(record),
        "converged": found.converged,
        "n_readings": found.period.n_readings,
        **_of_time_constants(found.time_constants),
        **_of_scores(found),
        "loglik": found.loglik,
        "at_bounds": found.at_bounds,
    }


def _of_record(record: Record) -> dict[str, Cell]:
    return {
        "record": record.name,
        "start": stamp_text(record.start_s),
        "end": stamp_text(record.end_s),
        "provenance": record.provenance,
        "warnings": len(record.warnings),
    }


def _of_time_constants(constants: Mapping[str, TimeConstant]) -> dict[str, Cell]:
    found: dict[str, Cell] = {}
    for name in PARTS:
        constant = constants.get(name)
        for end in ("value_h", "lower_h", "upper_h"):
            found[f"{name}_{end}"] = getattr(constant, end, math.nan)
        found[f"{name}_statement"] = "" if constant is None or constant.closed else _open(constant)
    return found | _of_verdicts(constants)


def _open(constant: TimeConstant) -> Statement:
    """What is known of a time constant without both bounds."""
    if 0 < constant.upper_h < math.inf:
        return FleetCode.NOT_ABOVE(bound=constant.upper_h)
    if 0 < constant.lower_h < math.inf:
        return FleetCode.NOT_BELOW(bound=constant.lower_h)
    return FleetCode.NO_BOUNDS()


def _of_verdicts(known: Mapping[str, TimeConstant | Inherited]) -> dict[str, Cell]:
    """The verdict on each time constant of a fit, or of a result that uses a fit; empty without a verdict."""
    return {f"{part}_verdict": (known[part].verdict or "") if part in known else "" for part in PARTS}


def _of_scores(found: Scored) -> dict[str, Cell]:
    """Free-run errors in total, of the validation period where it was scored and else of the identification
    period."""
    scored = math.isfinite(found.errors("validation", "temperature_K").total)
    period = "validation" if scored else "identification"
    errors = {column: found.errors(period, quantity).total for quantity, column in ERRORS.items()}
    return {"scored_period": period, **errors}


def _discover(job: Job) -> Row:
    from hygrokf.discovery.procedure import discover
    from hygrokf.discovery.results import write_discovery
    from hygrokf.report.discovery_page import write_discovery_report

    library = library_of(job.options["library"], installed=True)
    record = read_case(job.case)
    discovery = discover(record, library=library)
    write = write_discovery_report if job.options["report"] else write_discovery
    write(discovery, job.folder)
    found = discovery.results
    named = [one for one in found.causes if one.told_apart]
    columns: dict[str, Cell] = {
        **_of_record(record),
        "verdict": found.verdict,
        "causes": tuple("/".join((one.cause, *one.ambiguous_with)) for one in named),
        "confidence": min((one.confidence for one in named), default=math.nan),
        "not_judged": found.work.not_judged,
        **_of_time_constants((found.extended or found.baseline).time_constants),
        **_of_scores((found.extended or found.baseline).fit),
    }
    base = _of_scores(found.baseline.fit)
    return columns | {f"base_{column}": base[column] for column in ERRORS.values()}


def _evaluate(job: Job) -> Row:
    from hygrokf.identification.fit_on_record import evaluate

    fit, record = stored_fit(*_model(job)), read_case(job.case)
    found = evaluate(fit, record)
    write_text_whole(job.folder / "evaluation.json", result_text(found))
    columns: dict[str, Cell] = {
        **_of_record(record),
        "model": fit.name,
        **_of_verdicts(found.verdicts),
        **_of_scores(found),
    }
    for quantity, column in ERRORS.items():
        errors = found.errors(str(columns["scored_period"]), quantity)
        columns[column.replace("rmse", "rmse_operation")] = errors.operation
        columns[column.replace("rmse", "rmse_standstill")] = errors.standstill
        columns[f"{column.partition('_rmse')[0]}_coverage"] = found.band("free_run", quantity).coverage
    columns["statements"] = found.statements
    return columns


def _model(job: Job) -> tuple[Path, list[Path]]:
    assert job.fit is not None, f"{job.task} needs a fit"
    return job.fit, [Path(file) for file in job.options["library"]]


def _transfer(job: Job) -> Row:
    from hygrokf.transfer.procedure import transfer_fit

    record = read_case(job.case)
    transfer = transfer_fit(source_model(*_model(job)), record)
    write_transfer([transfer], job.folder)
    results = transfer.results
    columns: dict[str, Cell] = {
        **_of_record(record),
        "model": results.source.name,
        "transfer": results.verdict(),
        "re_estimate": results.re_estimate,
        "sentence": results.statement,
        **_of_verdicts(results.verdicts),
        "scored_period": results.period,
    }
    for quantity, column in ERRORS.items():
        for which, name in (("re_estimated", column), ("as_is", f"as_is_{column}")):
            error = results.rmse.get(quantity, {}).get(which)
            columns[name] = error.total if error is not None else math.nan
        gain = results.gains.get(quantity, {}).get("re_estimated", {}).get("over_as_is")
        for part, suffix in (("gain", ""), ("lower", "_lower"), ("upper", "_upper")):
            columns[f"{column.replace('rmse', 'gain')}{suffix}"] = getattr(gain, part, math.nan)
    return columns


def _climate(job: Job) -> Row:
    from hygrokf.climate.limits import limits_of
    from hygrokf.climate.procedure import climate_profile
    from hygrokf.climate.region import Region, read_power
    from hygrokf.report.climate_page import write_climate_report

    fit, options = stored_fit(*_model(job)), job.options
    weather = read_case(job.case, cabinet=False)
    still = options["standstill"] or fit.design.power_scale_W is None
    study = climate_profile(
        fit,
        [Region(job.turbine, weather, (job.case.name,))],
        None if still else read_power(job.case),
        limits=[limit for file in options["limits"] for limit in limits_of(file)],
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
    for name in CLIMATE_COLUMNS:
        for part, suffix in (("value", ""), ("lower", "_lower"), ("upper", "_upper")):
            columns[f"{name}{suffix}"] = getattr(region.year.get(name), part, math.nan)
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
"""The function of each task of `fleet.tasks.TASKS`."""
