"""`run_fleet`: every job of a plan, on one machine or a cluster, and what all of them give together."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from hygrokf.data.files import FLEET, REPORT, TYPE, write_bytes_whole, write_text_whole
from hygrokf.data.result_file import ResultFault, read_result, result_text
from hygrokf.fleet.cluster import on_cluster
from hygrokf.fleet.fleet_results import FleetResults
from hygrokf.fleet.job import DONE, FleetFault, Job, Outcome, Row, finished, keep
from hygrokf.fleet.outliers import spreads
from hygrokf.fleet.page import fleet_page
from hygrokf.fleet.plan import Plan
from hygrokf.fleet.processes import cores, in_processes
from hygrokf.fleet.table import CSV, PARQUET, table_csv, table_parquet
from hygrokf.fleet.tasks import TASKS
from hygrokf.identification.fit import read_fit
from hygrokf.identification.turbine_type import TurbineType, TypeFault, pool_types, write_type
from hygrokf.version import __version__

FEWEST_OF_A_TYPE = 3
"""Turbines that a type is made of at least."""
EVERY_S = 2.0
"""[s] between two writings of the table while results come."""


@dataclass(frozen=True)
class FleetRun:
    """A fleet's table, the outcomes in the order of its plan, how many were on disk before, and the page."""

    results: FleetResults
    outcomes: tuple[Outcome, ...]
    known: int
    page: Path

    @property
    def missing(self) -> list[Outcome]:
        """Turbines without a result."""
        return [one for one in self.outcomes if one.status != DONE]


def run_fleet(
    plan: Plan,
    out: Path,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    say: Callable[[Outcome, bool], None] = lambda found, known: None,
) -> FleetRun:
    """Do what a plan states for every turbine.

    plan: of a fleet's file (`fleet.plan.read_plan`).
    out: directory of fleet.csv, fleet.parquet, fleet.json and report.html; results of each turbine are in
        `turbines/NAME`.
    workers: processes on this machine, by default one per core.
    cluster: address of a Dask scheduler, whose workers see the same files under the same paths.
    say: is told each outcome as it comes, and whether it was on disk already.

    What was done with the same files, options and version is not done again; what failed is tried again.

    Returns the table (`results`, the same whatever does the work), the outcomes, and the path of the page.
    Raises FleetFault where there is no cluster.
    """
    jobs = plan.jobs(out)
    out.mkdir(parents=True, exist_ok=True)
    by_name: dict[str, Outcome] = {}
    for job in jobs:
        if (known := finished(job)) is not None:
            by_name[job.turbine] = known
            say(known, True)
    todo = [job for job in jobs if job.turbine not in by_name]
    before, written = len(by_name), time.monotonic()
    folders = {job.turbine: job for job in todo}
    for found in _outcomes(todo, workers, cluster):
        by_name[found.turbine] = found
        if found.status not in (DONE, "failed"):  # its process could not write the row
            keep(folders[found.turbine], found)
        say(found, False)
        if time.monotonic() - written > EVERY_S:
            write_text_whole(out / CSV, table_csv(plan.task, _in_order(jobs, by_name)))
            written = time.monotonic()
    ordered = tuple(by_name[job.turbine] for job in jobs)
    results = _written(plan, out, ordered)
    return FleetRun(results, ordered, before, write_fleet_report(out))


def _outcomes(jobs: Sequence[Job], workers: int | None, cluster: str | None) -> Iterator[Outcome]:
    if not jobs:
        return iter(())
    return on_cluster(jobs, cluster) if cluster else in_processes(jobs, workers or cores())


def _in_order(jobs: Sequence[Job], found: Mapping[str, Outcome]) -> list[Row]:
    return [found[job.turbine].row for job in jobs if job.turbine in found]


def _written(plan: Plan, out: Path, outcomes: Sequence[Outcome]) -> FleetResults:
    """Write the table of all."""
    rows = [one.row for one in outcomes]
    write_text_whole(out / CSV, table_csv(plan.task, rows))
    binary = table_parquet(plan.task, rows)
    if binary is None:
        (out / PARQUET).unlink(missing_ok=True)  # one of an earlier run would be of other numbers
    else:
        write_bytes_whole(out / PARQUET, binary)
    kind, without = _type_of(plan, out, rows)
    found = FleetResults(
        task=plan.task,
        rows=tuple(rows),
        name=plan.name,
        version=__version__,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        options=dict(plan.options),
        type=kind,
        type_without=tuple(without),
        cpu_s={one.turbine: round(one.seconds, 3) for one in outcomes},
    )
    write_text_whole(out / FLEET, result_text(found))
    return found


def _type_of(plan: Plan, out: Path, rows: Sequence[Row]) -> tuple[TurbineType | None, list[str]]:
    """The pooled type of a fleet's fits, also as `type.json`, and the turbines that it is without.

    A turbine whose time constants depart from the others' is none of their type; the type is None where the
    fits make none.
    """
    file = out / TYPE
    file.unlink(missing_ok=True)  # one of an earlier run would be of other fits
    done = [row for row in rows if row["status"] == DONE]
    names = [str(row["turbine"]) for row in done]
    if plan.task != "fit" or len(names) < FEWEST_OF_A_TYPE:
        return None, []
    constants = [one for one in spreads(done, TASKS[plan.task].compared) if one.compared.lower]
    odd = sorted({one.turbines[i] for one in constants for i in one.outliers})
    folders = {job.turbine: job.folder for job in plan.jobs(out)}
    try:
        fits = [replace(read_fit(folders[name]), name=name) for name in names if name not in odd]
        kind = pool_types(fits, plan.name)
    except (TypeFault, ResultFault):  # fits that have nothing in common, or that someone has removed
        return None, []
    write_type(kind, file)
    return kind, odd


def write_fleet_report(out: Path) -> Path:
    """Write `report.html` again from `fleet.json`; raises FleetFault where that is missing or damaged."""
    file = out / FLEET
    try:
        fleet = read_result(FleetResults, file, "hygrokf fleet")
    except ResultFault as fault:
        raise FleetFault(str(file), [str(fault)]) from None
    named = [row.get("turbine") for row in fleet.rows]
    if fleet.task not in TASKS or None in named or len(named) != len(set(named)):
        raise FleetFault(str(file), ["expected rows of a task of this version; run `hygrokf fleet` again"])
    return write_text_whole(out / REPORT, fleet_page(fleet))
