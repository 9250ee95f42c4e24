"""`hygrokf fit`, `discover`, `simulate`, `evaluate`: estimate the model of a case, find missing mechanisms,
and apply a model to a case."""

from __future__ import annotations

import json
from argparse import ArgumentParser, Namespace
from pathlib import Path

from hygrokf.commands.console import (
    Progress,
    UserFault,
    activity,
    expect_file,
    expect_other,
    expect_own_directory,
    faults_of,
    printable,
    show,
    show_reported,
)
from hygrokf.commands.opening import case_fit, case_record, library_of, stored_fit, write_fit_and_page
from hygrokf.commands.verb import Verb, add_fit_and_case, add_json, add_library, add_out, whole_number
from hygrokf.data import files
from hygrokf.estimation.conventions import STARTS


def _fit_arguments(parser: ArgumentParser) -> None:
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
        type=whole_number(1),
        default=STARTS,
        help=f"number of starts of the search for the maximum (default {STARTS})",
    )
    parser.add_argument(
        "--model",
        type=Path,
        metavar="FIT.json",
        help="estimate the model of this fit, such as the one of `hygrokf discover`, from its values",
    )
    add_library(parser)
    add_json(parser)


def _fit(options: Namespace) -> int:
    """Fit the model of a case, write the files, and show the report."""
    from hygrokf.report.fit_page import fit_blocks

    if options.model and options.kind == "cascade":
        raise UserFault(
            "--kind cascade: expected joint or no --kind beside --model, whose mechanisms are estimated in "
            "one filter; leave --kind out"
        )
    expect_own_directory(options.out, files.FIT)
    replaced = _record_name_of_fit(options.out)
    record = case_record(options.case)
    model = options.model and stored_fit(options.model, options.library)
    fit = case_fit(record, options.case, options.criterion, options.starts, options.kind, model)
    if replaced and replaced != record.name:
        activity().note(f"note: --out {options.out}: replaces the fit of {printable(replaced)}")
    page = write_fit_and_page(fit, options.out)
    return show_reported(page, fit.results, fit_blocks(fit.results, {}), options.json)


def _record_name_of_fit(out: Path) -> str:
    """Return the name of the record whose fit a directory holds, "" without a fit. Raises UserFault if its
    fit.json is not of `hygrokf fit`."""
    file = out / files.FIT
    if not file.exists():
        return ""
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        data = None
    if not isinstance(data, dict) or not {"name", "version", "parameters", "time_constants"} <= set(data):
        raise UserFault(
            f"--out {out}: expected a new directory or one with an earlier fit, found a {files.FIT} in it "
            "that is no result of `hygrokf fit`; name another one, or take that file away"
        )
    return str(data["name"])


FIT_VERB = Verb("fit", "identify the models of a case", _fit_arguments, _fit)


def _discover_arguments(parser: ArgumentParser) -> None:
    parser.add_argument("case", type=Path, metavar="CASE.toml", help="the case file")
    add_out(parser, "directory for discovery.json, report.html and the extended model")
    parser.add_argument(
        "--budget",
        type=whole_number(1),
        metavar="N",
        help="simulations after which no further cause is tried (default: 40000)",
    )
    add_library(parser)
    add_json(parser)


def _discover(options: Namespace) -> int:
    """Discover what the model of a case lacks, write the files, and show the report."""
    from hygrokf.discovery.discover import MOST_SIMULATIONS, discover
    from hygrokf.report.discovery_page import discovery_blocks, write_discovery_report

    expect_own_directory(options.out, files.DISCOVERY)
    library = library_of(options.library, installed=True)
    record = case_record(options.case)
    with faults_of(options.case), Progress(60) as progress:
        discovery = discover(
            record, library=library, progress=progress, budget=options.budget or MOST_SIMULATIONS
        )
    untried = {row.cause for row in discovery.results.rejected if row.reason == "no_form"}
    for cause in library.own:
        if cause.name in untried:
            needs = f"; it needs {cause.needs}" if cause.needs else ""
            activity().note(f"note: {cause.name} was not tried: this record cannot show it{needs}")
    with Progress(1) as progress:
        progress("draw the report")
        page = write_discovery_report(discovery, options.out)
    results = discovery.results
    return show_reported(page, results, discovery_blocks(results), options.json)


DISCOVER = Verb(
    "discover",
    "show the errors of the simulation, name their cause, extend the model",
    _discover_arguments,
    _discover,
)


def _simulate_arguments(parser: ArgumentParser) -> None:
    add_fit_and_case(parser)
    add_out(parser, "CSV file to write")
    add_library(parser)
    add_json(parser)


def _simulate(options: Namespace) -> int:
    """Simulate a fitted model on the inputs of a case, and write the simulation as CSV."""
    from hygrokf.data.files import write_text_whole
    from hygrokf.identification.fit_on_record import simulate_fit, simulation_csv, simulation_summary
    from hygrokf.identification.verdict_terms import verdict_lines

    expect_file(options.out)
    fit = stored_fit(options.fit, options.library)
    record = case_record(options.case, cabinet=False)
    sources = (options.case.parent / file for file, _ in record.files)
    expect_other(options.out, options.fit, options.fit / files.FIT, options.case, *sources)
    with faults_of(options.case):
        _, run, predicted = simulate_fit(fit, record)
        summary = simulation_summary(fit, run, predicted)
    write_text_whole(options.out, simulation_csv(run, predicted))
    for statement in summary.statements:
        activity().note(f"note: {statement}")
    lines = [f"{summary.n} instants written: {options.out}", *verdict_lines(summary.verdicts)]
    show(summary, "\n".join(lines), options.json)
    return 0


SIMULATE = Verb(
    "simulate",
    "run a fitted model on the inputs of a case, without its readings",
    _simulate_arguments,
    _simulate,
)


def _evaluate_arguments(parser: ArgumentParser) -> None:
    add_fit_and_case(parser)
    add_library(parser)
    add_json(parser)


def _evaluate(options: Namespace) -> int:
    """Score a fitted model on the readings of a case, and show the scores."""
    from hygrokf.identification.fit_on_record import evaluate
    from hygrokf.report.fit_tables import evaluation_text

    fit = stored_fit(options.fit, options.library)
    record = case_record(options.case)
    with faults_of(options.case):
        evaluation = evaluate(fit, record)
    show(evaluation, evaluation_text(evaluation), options.json)
    return 0


EVALUATE = Verb("evaluate", "score a fitted model on a case", _evaluate_arguments, _evaluate)
