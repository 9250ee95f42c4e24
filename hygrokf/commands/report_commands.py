"""`hygrokf report`, `hygrokf summary`: make the pages of stored results."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path

from hygrokf.commands.console import Progress, expect_directory, show
from hygrokf.commands.verb import Verb, add_json
from hygrokf.data.files import CLIMATE, COMPARISON, DISCOVERY, FIT, FLEET, TRANSFER


def _report_arguments(parser: ArgumentParser) -> None:
    parser.add_argument("directory", type=Path, metavar="DIR", help="the directory of results")
    add_json(parser)


PAGES: Mapping[str, Callable[[Path], Path]] = {
    DISCOVERY: lambda folder: import_module("hygrokf.report.discovery_page").write_discovery_report(
        None, folder
    ),
    FLEET: lambda folder: import_module("hygrokf.report.fleet_page").write_fleet_report(folder),
    CLIMATE: lambda folder: import_module("hygrokf.report.climate_page").write_climate_report(None, folder),
    COMPARISON: lambda folder: import_module("hygrokf.report.comparison_page").write_comparison(None, folder),
    TRANSFER: lambda folder: import_module("hygrokf.report.transfer_page").rewrite_transfer(folder),
    FIT: lambda folder: import_module("hygrokf.report.fit_page").write_report(folder),
}
"""File of results → function that writes their page; of a directory, the first of these files decides."""


def _report(options: Namespace) -> int:
    """Write the page of a directory of results again, and show its path."""
    folder = options.directory.parent if options.directory.is_file() else options.directory
    kind = next((name for name in PAGES if (folder / name).is_file()), FIT)
    page = PAGES[kind](folder)
    show({"report": str(page)}, str(page), options.json)
    return 0


REPORT_VERB = Verb("report", "write the pages again from a directory of results", _report_arguments, _report)


def _summary_arguments(parser: ArgumentParser) -> None:
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


def _summary(options: Namespace) -> int:
    """Write the summary of each result as HTML, with --pdf also as PDF, and show their paths."""
    from hygrokf.report.summary.writing import plan_summaries, write_pdf, write_summary

    if options.out is not None:
        expect_directory(options.out)
    plans = plan_summaries(options.results, options.out)
    pages = []
    with Progress(len(plans) + 1) as progress:
        summaries = [make_summary() for make_summary, _, _ in plans]
        for summary, (_, folder, stem) in zip(summaries, plans, strict=True):
            progress(f"draw the summary of {summary.name}")
            pages.append(write_summary(summary, folder, stem))
        pdf_files = [write_pdf(page) for page in pages] if options.pdf else []
    files = [str(file) for file in (*pages, *pdf_files)]
    show({"summaries": files}, "\n".join(files), options.json)
    return 0


SUMMARY_VERB = Verb(
    "summary", "write one page of a fit, a discovery or a climate: HTML, PDF", _summary_arguments, _summary
)
