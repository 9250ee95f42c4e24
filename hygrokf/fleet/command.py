"""`hygrokf fleet` at the terminal: a bar, a line for each turbine as it is done."""

from __future__ import annotations

from pathlib import Path

from hygrokf.console import Progress, UserFault, expect_directory
from hygrokf.fleet.job import Outcome
from hygrokf.fleet.plan import read_plan
from hygrokf.fleet.running import Result, run_fleet
from hygrokf.fleet.words import fleet_text, outcome_text


def tell_fleet(file: Path, out: Path, workers: int | None, cluster: str | None) -> tuple[Result, str]:
    """Run the fleet of a file; its result, and the table as text.  Raises FleetFault and UserFault."""
    expect_directory(out)
    if cluster and workers:
        raise UserFault("--workers is for this machine; a cluster has its own: leave it out beside --dask")
    plan = read_plan(file)
    progress = Progress(len(plan.turbines))

    def say(found: Outcome, known: bool) -> None:
        progress.tell(outcome_text(found, known))
        progress(found.turbine)

    try:
        result = run_fleet(plan, out, workers=workers, cluster=cluster, say=say)
    except BaseException:
        progress.abandon()
        raise
    progress.close()
    return result, fleet_text(plan.task, result.rows)
