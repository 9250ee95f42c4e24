"""`hygrokf fit`: the model of a case."""

from __future__ import annotations

import json
from argparse import ArgumentParser, Namespace
from pathlib import Path

from hygrokf.commands.activity import activity
from hygrokf.commands.console import UserFault, expect_own_directory, printable, show_reported
from hygrokf.commands.inputs import identified, record_of, stored_fit, written
from hygrokf.commands.verb import Verb, add_json, add_library, add_out, whole
from hygrokf.data.files import FIT


def _arguments(parser: ArgumentParser) -> None:
    parser.add_argument("case", type=Path, metavar="CASE.toml", help="the case file")
    add_out(parser, "directory for fit.json, series.npz and report.html")
    parser.add_argument(
        "--criterion",
        choices=("likelihood", "simulation"),
        default="likelihood",
        help="innovations (default) or the free run's error, as in the paper",
    )
    parser.add_argument(
        "--kind",
        choices=("joint", "cascade"),
        default=None,
        help="one filter, or hygric on the measured temperature",
    )
    parser.add_argument(
        "--starts",
        type=whole(1),
        default=5,
        help="number of starts of the search for the maximum (default 5)",
    )
    parser.add_argument(
        "--model",
        type=Path,
        metavar="FIT.json",
        help="estimate the model of this fit, such as the one of `hygrokf discover`, from its values",
    )
    add_library(parser)
    add_json(parser)


def _run(options: Namespace) -> int:
    from hygrokf.report.fit_page import fit_blocks

    if options.model and options.kind == "cascade":
        raise UserFault(
            "--kind cascade: expected joint or no --kind beside --model, whose mechanisms are estimated in "
            "one filter; leave --kind out"
        )
    expect_own_directory(options.out, FIT)
    former = _record_of_the_fit_in(options.out)
    record = record_of(options.case)
    model = options.model and stored_fit(options.model, options.library)
    fit = identified(record, options.case, options.criterion, options.starts, options.kind, model)
    if former and former != record.name:
        activity().note(f"note: --out {options.out}: replaces the fit of {printable(former)}")
    page = written(fit, options.out)
    return show_reported(page, fit.results, fit_blocks(fit.results, {}), options.json)


def _record_of_the_fit_in(out: Path) -> str:
    """The name of the record whose fit a directory holds, or nothing; raises UserFault for a fit.json of
    another program."""
    file = out / FIT
    if not file.exists():
        return ""
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        data = None
    if not isinstance(data, dict) or not {"name", "version", "parameters", "time_constants"} <= set(data):
        raise UserFault(
            f"--out {out}: expected a new directory or one with an earlier fit, found a {FIT} in it that is "
            "no result of `hygrokf fit`; name another one, or take that file away"
        )
    return str(data["name"])


VERB = Verb("fit", "identify the models of a case", _arguments, _run)
