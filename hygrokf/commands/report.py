"""`hygrokf report`: writes the page of a directory of results again."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from hygrokf.commands.console import show
from hygrokf.commands.verb import Verb, add_json
from hygrokf.data.files import CLIMATE, COMPARISON, DISCOVERY, FLEET, TRANSFER


def _arguments(parser: ArgumentParser) -> None:
    parser.add_argument("directory", type=Path, metavar="DIR", help="the directory of results")
    add_json(parser)


def _run(options: Namespace) -> int:
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


VERB = Verb("report", "write the pages again from a directory of results", _arguments, _run)
