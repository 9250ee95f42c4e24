"""`hygrokf fleet`: do one task for many turbines."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.commands.console import FOUND, Progress, UserFault, expect_own_directory, show_reported
from hygrokf.commands.verb import Verb, add_json, add_out, whole_number
from hygrokf.data.files import FLEET, REPORT

if TYPE_CHECKING:
    from hygrokf.fleet.job import Row


def _arguments(parser: ArgumentParser) -> None:
    parser.add_argument("fleet", type=Path, metavar="FLEET.toml", help="the fleet's file")
    add_out(parser, "directory for fleet.csv, report.html, each turbine's results")
    parser.add_argument(
        "--workers",
        type=whole_number(1),
        default=None,
        help="processes on this machine (default: one per core)",
    )
    parser.add_argument(
        "--dask", metavar="ADDRESS", help="run on a Dask cluster instead, such as tcp://HOST:8786"
    )
    add_json(parser)


def _run(options: Namespace) -> int:
    """Do the task for every turbine, write the files, and show the report; status 1 if a turbine has no
    result."""
    from hygrokf.commands.fleet_tasks import run_fleet
    from hygrokf.fleet.fleet_plan import read_plan
    from hygrokf.report.fleet_page import fleet_blocks, outcome_text

    expect_own_directory(options.out, FLEET)
    if options.dask and options.workers:
        raise UserFault("--workers is for this machine; a cluster has its own: leave it out beside --dask")
    plan = read_plan(options.fleet)
    with Progress(len(plan.turbines)) as progress:

        def report_row(row: Row, is_stored: bool) -> None:
            progress.tell(outcome_text(row, is_stored))
            progress(str(row["turbine"]))

        results = run_fleet(plan, options.out, workers=options.workers, cluster=options.dask, say=report_row)
    data = {"rows": [dict(row) for row in results.rows]}
    show_reported(options.out / REPORT, data, fleet_blocks(results), options.json)
    return FOUND if results.missing else 0


FLEET_VERB = Verb(
    "fleet", "run one of these tasks for many turbines: one table and one page", _arguments, _run
)
