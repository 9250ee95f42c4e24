"""`hygrokf demo`: a synthetic turbine, its fit and its report."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from hygrokf.commands.activity import activity
from hygrokf.commands.console import UserFault, expect_own_directory, show_reported
from hygrokf.commands.inputs import identified, record_of, written
from hygrokf.commands.verb import Verb, add_json, add_out, whole
from hygrokf.data.files import FIT


def _arguments(parser: ArgumentParser) -> None:
    add_out(parser, "directory for the case and the results")
    parser.add_argument("--seed", type=whole(0), default=1, help="seed of the synthetic turbine (default 1)")
    add_json(parser)


def _run(options: Namespace) -> int:
    from hygrokf.cases.synthetic import synthetic_turbine, write_case
    from hygrokf.report.fit_page import fit_blocks

    expect_own_directory(options.out, FIT)
    former = options.out / "case.toml"
    if former.is_file() and b"synthetic" not in former.read_bytes():
        raise UserFault(
            f"--out {options.out}: it holds a case.toml of another turbine; name another directory"
        )
    case = write_case(synthetic_turbine(seed=options.seed), options.out)
    activity().note(f"synthetic turbine written: {case}")
    fit = identified(record_of(case), case)
    page = written(fit, options.out)
    return show_reported(page, fit.results, fit_blocks(fit.results, {}), options.json)


VERB = Verb("demo", "make a synthetic turbine, fit it, evaluate and report it", _arguments, _run)
