"""`hygrokf summary`: results on one page each."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from hygrokf.commands.console import Progress, expect_directory, show
from hygrokf.commands.verb import Verb, add_json


def _arguments(parser: ArgumentParser) -> None:
    parser.add_argument(
        "results",
        type=Path,
        nargs="+",
        metavar="RESULT",
        help="fit.json, discovery.json or climate.json, or a directory that holds one",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="directory for summary.html, .pdf and .png (default: beside each result)",
    )
    add_json(parser)


def _run(options: Namespace) -> int:
    from hygrokf.report.summary.writing import planned, written

    if options.out is not None:
        expect_directory(options.out)
    plans = planned(options.results, options.out)
    files: list[str] = []
    with Progress(len(plans) + 1) as progress:
        summaries = [make() for make, _, _ in plans]
        for summary, (_, folder, stem) in zip(summaries, plans, strict=True):
            progress(f"draw the summary of {summary.name}")
            files += map(str, written(summary, folder, stem))
    show({"summaries": files}, "\n".join(files), options.json)
    return 0


VERB = Verb(
    "summary", "write one page of a fit, a discovery or a climate: HTML, PDF and PNG", _arguments, _run
)
