"""`hygrokf fleet` at the terminal: its arguments; a bar, and a line for each turbine as it is done."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.commands.console import Progress, UserFault, expect_own_directory
from hygrokf.data.files import FLEET

if TYPE_CHECKING:
    from hygrokf.fleet.job import Outcome


def fleet_arguments(parser: ArgumentParser, whole: Callable[[int], Callable[[str], int]]) -> None:
    """Arguments of the command; `whole` makes a reader of whole numbers from a least one on."""
    parser.add_argument("fleet", type=Path, metavar="FLEET.toml")
    parser.add_argument(
        "--out", type=Path, required=True, help="directory for fleet.csv, report.html, each turbine's results"
    )
    parser.add_argument(
        "--workers", type=whole(1), default=None, help="processes on this machine (default one a core)"
    )
    parser.add_argument(
        "--dask", metavar="ADDRESS", help="do it on a Dask cluster, such as tcp://HOST:8786, instead"
    )


def tell_fleet(options: Namespace) -> tuple[Path, list[Mapping[str, object]], str, int]:
    """Run the fleet of a file: its page, its rows, the table as text, and the exit status.

    The status is 1 where any turbine has no result.  Raises FleetFault and UserFault.
    """
    from hygrokf.fleet.plan import read_plan
    from hygrokf.fleet.running import run_fleet
    from hygrokf.fleet.text import fleet_text, outcome_text

    expect_own_directory(options.out, FLEET)
    if options.dask and options.workers:
        raise UserFault("--workers is for this machine; a cluster has its own: leave it out beside --dask")
    plan = read_plan(options.fleet)
    progress = Progress(len(plan.turbines))

    def say(found: Outcome, known: bool) -> None:
        progress.tell(outcome_text(found, known))
        progress(found.turbine)

    try:
        result = run_fleet(plan, options.out, workers=options.workers, cluster=options.dask, say=say)
    except BaseException:
        progress.abandon()
        raise
    progress.close()
    return result.page, result.rows, fleet_text(plan.task, result.rows), int(bool(result.missing))
