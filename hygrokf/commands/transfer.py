"""`hygrokf transfer`: a fitted model on another turbine."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from hygrokf.commands.console import Progress, expect_own_directory, faults_of, show_reported
from hygrokf.commands.inputs import record_of, source_model
from hygrokf.commands.verb import Verb, add_json, add_library, add_out
from hygrokf.data.files import TRANSFER
from hygrokf.errors import HygrokfError

STEPS = 8
"""Progress messages of one transfer."""


def _arguments(parser: ArgumentParser) -> None:
    parser.add_argument("fit", type=Path, metavar="FIT.json|TYPE.json", help="fitted model or pooled type")
    parser.add_argument("cases", type=Path, nargs="+", metavar="CASE.toml", help="cases of other turbines")
    add_out(parser, "directory for transfer.json, report.html and the models")
    add_library(parser)
    add_json(parser)


def _run(options: Namespace) -> int:
    from hygrokf.identification.turbine_type import TurbineType, pool_types
    from hygrokf.report.transfer_page import transfer_blocks, write_transfer
    from hygrokf.transfer.procedure import transfer_fit
    from hygrokf.transfer.results import transfer_results

    expect_own_directory(options.out, TRANSFER)
    source = source_model(options.fit, options.library)
    records = [record_of(case) for case in options.cases]
    found = []
    with Progress(STEPS * len(records)) as progress:
        for case, record in zip(options.cases, records, strict=True):
            with faults_of(case):
                found.append(transfer_fit(source, record, progress))
    fits = [] if isinstance(source, TurbineType) else [source]
    fits += [one.own for one in found if one.own is not None]
    pooled, unpooled = None, ""
    if len(fits) > 2:
        try:
            pooled = pool_types(fits)
        except HygrokfError as fault:
            unpooled = f"\n\nno type of turbine was made: {fault}"
    with Progress(1) as progress:
        progress("draw the report")
        page, results = write_transfer(found, options.out, pooled), transfer_results(found, pooled)
    return show_reported(page, results, transfer_blocks(results), options.json, unpooled)


VERB = Verb(
    "transfer",
    "try a fitted model on another turbine: which parameters carry over, which differ",
    _arguments,
    _run,
)
