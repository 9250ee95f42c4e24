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
        help="directory for summary.html (default: beside each result)",
    )
    parser.add_argument(
        "--pdf", action="store_true", help="also write summary.pdf: what the page prints (extra pdf)"
    )
    add_json(parser)


def _run(options: Namespace) -> int:
    from hygrokf.report.summary.writing import planned, written, written_pdf

    if options.out is not None:
        expect_directory(options.out)
    plans = planned(options.results, options.out)
    pages = []
    with Progress(len(plans) + 1) as progress:
        summaries = [make() for make, _, _ in plans]
        for summary, (_, folder, stem) in zip(summaries, plans, strict=True):
            progress(f"draw the summary of {summary.name}")
            pages.append(written(summary, folder, stem))
        printed = [written_pdf(page) for page in pages] if options.pdf else []
    files = [str(file) for file in (*pages, *printed)]
    show({"summaries": files}, "\n".join(files), options.json)
    return 0


VERB = Verb("summary", "write one page of a fit, a discovery or a climate: HTML, PDF", _arguments, _run)
