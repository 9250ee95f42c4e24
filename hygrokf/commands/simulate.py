"""`hygrokf simulate`: a fitted model on the inputs of a case."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from hygrokf.commands.activity import activity
from hygrokf.commands.console import expect_file, expect_other, faults_of, show
from hygrokf.commands.inputs import record_of, stored_fit
from hygrokf.commands.verb import Verb, add_fit_and_case, add_json, add_library, add_out
from hygrokf.data.files import FIT


def _arguments(parser: ArgumentParser) -> None:
    add_fit_and_case(parser)
    add_out(parser, "CSV file to write")
    add_library(parser)
    add_json(parser)


def _run(options: Namespace) -> int:
    from hygrokf.data.files import write_text_whole
    from hygrokf.identification.fit_on_record import simulation_csv, simulation_summary
    from hygrokf.identification.verdict_terms import verdict_lines

    expect_file(options.out)
    fit = stored_fit(options.fit, options.library)
    record = record_of(options.case, cabinet=False)
    sources = (options.case.parent / file for file, _ in record.provenance)
    expect_other(options.out, options.fit, options.fit / FIT, options.case, *sources)
    with faults_of(options.case):
        text, summary = simulation_csv(fit, record), simulation_summary(fit, record)
    write_text_whole(options.out, text)
    for sentence in summary.statements:
        activity().note(f"note: {sentence}")
    lines = [f"{summary.n} instants written: {options.out}", *verdict_lines(summary.verdicts)]
    show(summary, "\n".join(lines), options.json)
    return 0


VERB = Verb("simulate", "run a fitted model on the inputs of a case, without its readings", _arguments, _run)
