"""`hygrokf report`, `hygrokf summary`: pages of stored results."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from hygrokf.commands.console import Progress, expect_directory, show
from hygrokf.commands.verb import Verb, add_json
from hygrokf.data.files import CLIMATE, COMPARISON, DISCOVERY, FLEET, TRANSFER


def _report_arguments(parser: ArgumentParser) -> None:
    parser.add_argument("directory", type=Path, metavar="DIR", help="the directory of results")
    add_json(parser)


def _report(options: Namespace) -> int:
    page = _written(options.directory)
    show({"report": str(page)}, str(page), options.json)
    return 0


def _written(directory: Path) -> Path:
    """Write the page of the kind of results in a directory; returns its path."""
    folder = directory.parent if directory.is_file() else directory
    if (folder / DISCOVERY).is_file():
        from hygrokf.report.discovery_page import write_discovery_report

        return write_discovery_report(None, folder)
    if (folder / FLEET).is_file():
        from hygrokf.report.fleet_page import write_fleet_report

        return write_fleet_report(folder)
    if (folder / CLIMATE).is_file():
        from hygrokf.report.climate_page import write_climate_report

        return write_climate_report(None, folder)
    if (folder / COMPARISON).is_file():
        from hygrokf.report.comparison_page import write_comparison

        return write_comparison(None, folder)
    if (folder / TRANSFER).is_file():
        from hygrokf.report.transfer_page import rewrite_transfer

        return rewrite_transfer(folder)
    from hygrokf.report.fit_page import write_report

    return write_report(directory)


REPORT = Verb("report", "write the pages again from a directory of results", _report_arguments, _report)


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


SUMMARY = Verb(
    "summary", "write one page of a fit, a discovery or a climate: HTML, PDF", _summary_arguments, _summary
)
