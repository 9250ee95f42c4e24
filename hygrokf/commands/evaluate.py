"""`hygrokf evaluate`: the scores of a fitted model on a case."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from hygrokf.commands.console import faults_of, show
from hygrokf.commands.inputs import record_of, stored_fit
from hygrokf.commands.verb import Verb, add_fit_and_case, add_json, add_library


def _arguments(parser: ArgumentParser) -> None:
    add_fit_and_case(parser)
    add_library(parser)
    add_json(parser)


def _run(options: Namespace) -> int:
    from hygrokf.identification.fit_on_record import evaluate
    from hygrokf.report.fit_tables import evaluation_text

    fit = stored_fit(options.fit, options.library)
    record = record_of(options.case)
    with faults_of(options.case):
        found = evaluate(fit, record)
    show(found, evaluation_text(found), options.json)
    return 0


VERB = Verb("evaluate", "score a fitted model on a case", _arguments, _run)
