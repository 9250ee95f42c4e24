"""`hygrokf check`: the contents of a case, and doubts about them."""

from __future__ import annotations

import shlex
from argparse import ArgumentParser, Namespace
from pathlib import Path

from hygrokf.commands.console import show
from hygrokf.commands.verb import Verb, add_json


def _arguments(parser: ArgumentParser) -> None:
    parser.add_argument("case", type=Path, metavar="CASE.toml", help="the case file")
    add_json(parser)


def _run(options: Namespace) -> int:
    from hygrokf.cases.case_file import read_case
    from hygrokf.cases.summary import describe
    from hygrokf.report.record_text import describe_text

    found = describe(read_case(options.case, cabinet=False))
    text = describe_text(found)
    if any(one.signal.startswith("cabinet_") for one in found.signals):
        text += f"\n\nnext: hygrokf fit {shlex.quote(str(options.case))} --out result"
    show(found, text, options.json)
    return 0


VERB = Verb("check", "show the data of a case as read: spans, steps, gaps, clocks, doubts", _arguments, _run)
