"""`hygrokf discover`: the errors of the simulation, and their cause."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from hygrokf.commands.activity import activity
from hygrokf.commands.console import Progress, expect_own_directory, faults_of, show_reported
from hygrokf.commands.inputs import own_causes, record_of
from hygrokf.commands.verb import Verb, add_json, add_library, add_out, whole
from hygrokf.data.files import DISCOVERY


def _arguments(parser: ArgumentParser) -> None:
    parser.add_argument("case", type=Path, metavar="CASE.toml", help="the case file")
    add_out(parser, "directory for discovery.json, report.html and the extended model")
    parser.add_argument(
        "--budget",
        type=whole(1),
        metavar="N",
        help="simulations after which no further cause is tried (default: 40000)",
    )
    add_library(parser)
    add_json(parser)


def _run(options: Namespace) -> int:
    from hygrokf.discovery.library import LIBRARY
    from hygrokf.discovery.procedure import BUDGET, discover
    from hygrokf.report.discovery_page import discovery_blocks, write_discovery_report

    expect_own_directory(options.out, DISCOVERY)
    own = own_causes(options.library)
    record = record_of(options.case)
    with faults_of(options.case), Progress(60) as progress:
        found = discover(
            record, library=(*LIBRARY, *own), progress=progress, budget=options.budget or BUDGET
        )
    unseen = {one.cause for one in found.results.rejected if one.reason == "no_form"}
    for cause in own:
        if cause.name in unseen:
            needs = f"; it needs {cause.needs}" if cause.needs else ""
            activity().note(f"note: {cause.name} was not tried: this record cannot show it{needs}")
    with Progress(1) as progress:
        progress("draw the report")
        page = write_discovery_report(found, options.out)
    return show_reported(page, found.results, discovery_blocks(found.results), options.json)


VERB = Verb(
    "discover", "show the errors of the simulation, name their cause, extend the model", _arguments, _run
)
