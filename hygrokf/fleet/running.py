"""The jobs of a plan, on one machine or a cluster; their table, and the type of turbine pooled from fits."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from hygrokf.data.files import FLEET, REPORT, TYPE, write_bytes_whole, write_text_whole
from hygrokf.data.result_file import ResultFault, result_text
from hygrokf.fleet.cluster import on_cluster
from hygrokf.fleet.job import DONE, LOST, Outcome, Row, Work, finished, keep
from hygrokf.fleet.outliers import spreads
from hygrokf.fleet.plan import Plan
from hygrokf.fleet.processes import cores, in_processes
from hygrokf.fleet.results import CSV, PARQUET, FleetResults, table_csv, table_parquet
from hygrokf.fleet.tasks import TASKS
from hygrokf.identification.fit import read_fit
from hygrokf.identification.turbine_type import TurbineType, TypeFault, pool_types, write_type
from hygrokf.version import __version__

FEWEST_OF_A_TYPE = 3
"""Fewest turbines from which a type is pooled."""
EVERY_S = 2.0
"""[s] between two writings of the table while results come."""


@dataclass(frozen=True)
class FleetRun:
    """The results of a fleet.

    results: its table. outcomes: in the order of the plan. known: how many of them were on disk before.
    folder: the directory of the results.
    """

    results: FleetResults
    outcomes: tuple[Outcome, ...]
    known: int
    folder: Path

    @property
    def missing(self) -> list[Outcome]:
        """Turbines without a result."""
        return [one for one in self.outcomes if one.status != DONE]

    @property
    def page(self) -> Path:
        """The path of the fleet's page."""
        return self.folder / REPORT


def run_jobs(
    plan: Plan,
    out: Path,
    work: Work,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    say: Callable[[Outcome, bool], None] = lambda found, known: None,
) -> FleetRun:
    """Do the work for every turbine of a plan and write fleet.json, fleet.csv, fleet.parquet and, of three
    fits or more, type.json.

    plan, out, workers, cluster, say: as for `hygrokf.run_fleet`. work: what is done for one turbine.

    Raises FleetFault where there is no cluster.
    """
    jobs = {job.turbine: job for job in plan.jobs(out)}
    out.mkdir(parents=True, exist_ok=True)
    found: dict[str, Outcome] = {}
    for name, job in jobs.items():
        if (known := finished(job)) is not None:
            found[name] = known
            say(known, True)
    todo = [job for name, job in jobs.items() if name not in found]
    before, written = len(found), time.monotonic()
    if not todo:
        coming: Iterator[Outcome] = iter(())
    elif cluster:
        coming = on_cluster(todo, work, cluster)
    else:
        coming = in_processes(todo, work, workers or cores())
    for one in coming:
        found[one.turbine] = one
        if one.status == LOST:  # its process could not write the row
            keep(jobs[one.turbine], one)
        say(one, False)
        if time.monotonic() - written > EVERY_S:
            rows = [found[name].row for name in jobs if name in found]
            write_text_whole(out / CSV, table_csv(plan.task, rows))
            written = time.monotonic()
    outcomes = tuple(found[name] for name in jobs)
    return FleetRun(_written(plan, out, outcomes), outcomes, before, out)


def _written(plan: Plan, out: Path, outcomes: Sequence[Outcome]) -> FleetResults:
    """Write the table as CSV, Parquet and JSON; returns it."""
    rows = [one.row for one in outcomes]
    write_text_whole(out / CSV, table_csv(plan.task, rows))
    binary = table_parquet(plan.task, rows)
    if binary is None:
        (out / PARQUET).unlink(missing_ok=True)  # that of an earlier run has other numbers
    else:
        write_bytes_whole(out / PARQUET, binary)
    kind, without = _type_of(plan, out, rows)
    results = FleetResults(
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
    write_text_whole(out / FLEET, result_text(results))
    return results


def _type_of(plan: Plan, out: Path, rows: Sequence[Row]) -> tuple[TurbineType | None, list[str]]:
    """The type of turbine pooled from a fleet's fits, also written as `type.json`, and the turbines left out.

    Turbines whose time constants depart from the others' are left out; the type is None where the fits share
    none.
    """
    file = out / TYPE
    file.unlink(missing_ok=True)  # that of an earlier run was made of other fits
    done = [row for row in rows if row["status"] == DONE]
    names = [str(row["turbine"]) for row in done]
    if plan.task != "fit" or len(names) < FEWEST_OF_A_TYPE:
        return None, []
    constants = [one for one in spreads(done, TASKS[plan.task].compared) if one.compared.lower]
    odd = sorted({one.turbines[i] for one in constants for i in one.outliers})
    try:
        fits = [replace(read_fit(plan.folder(out, name)), name=name) for name in names if name not in odd]
        kind = pool_types(fits, plan.name)
    except (TypeFault, ResultFault):  # the fits have nothing in common, or someone has removed them
        return None, []
    write_type(kind, file)
    return kind, odd
