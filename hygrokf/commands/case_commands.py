"""`hygrokf init`, `hygrokf check`, `hygrokf demo`: draft a case, show the data of a case, fit a synthetic
case."""

from __future__ import annotations

import shlex
import sys
from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path

from hygrokf.commands.console import (
    UserFault,
    activity,
    expect_file,
    expect_own_directory,
    printable,
    show,
    show_reported,
)
from hygrokf.commands.opening import case_fit, case_record, write_fit_and_page
from hygrokf.commands.verb import Verb, add_json, add_out, reader, whole_number, within
from hygrokf.data.files import FIT


def _degrees(text: str) -> tuple[float, float]:
    """Read "LAT,LON" as latitude and longitude [°]. Raises ValueError."""
    latitude, longitude = map(float, text.split(","))
    return within(-90.0, latitude, 90.0), within(-180.0, longitude, 180.0)


def _init_arguments(parser: ArgumentParser) -> None:
    parser.add_argument(
        "exports", type=Path, nargs="+", metavar="EXPORT", help="CSV, Parquet, Excel or weather file"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("case.toml"), help="the case file to write (default case.toml)"
    )
    parser.add_argument("--turbine", metavar="NAME", help="the turbine to read if the exports hold several")
    parser.add_argument(
        "--site",
        type=reader("degrees such as 52.4,-0.95", _degrees),
        metavar="LAT,LON",
        help="in degrees, as in --site=52.4,-0.95",
    )
    add_json(parser)


def _init(options: Namespace) -> int:
    """Draft a case file from exports, and show its signals and doubts."""
    from hygrokf.cases.case_file import CaseFault, read_case
    from hygrokf.drafting.draft import draft_case
    from hygrokf.report.record_text import draft_text

    expect_file(options.out)
    if options.out.exists():
        raise UserFault(f"--out {options.out}: expected a new file, found one; remove it or name another one")
    draft = draft_case(options.exports, options.out, turbine=options.turbine, site=options.site)
    needed_edit = ""
    try:
        warnings = read_case(options.out, cabinet=False, ambient=False).warnings
        draft = replace(draft, doubts=tuple(dict.fromkeys((*draft.doubts, *warnings))))
    except CaseFault as fault:
        needed_edit = f"the draft needs an edit before it can be read:\n{printable(str(fault))}"
    show(draft, draft_text(draft), options.json)
    if needed_edit:
        print(needed_edit, file=sys.stderr)
    return 0


INIT = Verb("init", "draft a case file from exports, with its doubts as comments", _init_arguments, _init)


def _check_arguments(parser: ArgumentParser) -> None:
    parser.add_argument("case", type=Path, metavar="CASE.toml", help="the case file")
    add_json(parser)


def _check(options: Namespace) -> int:
    """Show the data of a case as read."""
    from hygrokf.cases.case_file import read_case
    from hygrokf.cases.summary import describe
    from hygrokf.report.record_text import describe_text

    summary = describe(read_case(options.case, cabinet=False))
    text = describe_text(summary)
    if any(row.signal.startswith("cabinet_") for row in summary.signals):
        text += f"\n\nnext: hygrokf fit {shlex.quote(str(options.case))} --out result"
    show(summary, text, options.json)
    return 0


CHECK = Verb(
    "check", "show the data of a case as read: spans, steps, gaps, clocks, doubts", _check_arguments, _check
)


def _demo_arguments(parser: ArgumentParser) -> None:
    add_out(parser, "directory for the case and the results")
    parser.add_argument(
        "--seed", type=whole_number(0), default=1, help="seed of the synthetic turbine (default 1)"
    )
    add_json(parser)


def _demo(options: Namespace) -> int:
    """Write a synthetic case, fit it, and show its report."""
    from hygrokf.cases.synthetic import synthetic_turbine, write_case
    from hygrokf.report.fit_page import fit_blocks

    expect_own_directory(options.out, FIT)
    existing = options.out / "case.toml"
    if existing.is_file() and not _is_synthetic(existing):
        raise UserFault(
            f"--out {options.out}: it holds a case.toml of another turbine; name another directory"
        )
    case = write_case(synthetic_turbine(seed=options.seed), options.out)
    activity().note(f"synthetic turbine written: {case}")
    fit = case_fit(case_record(case), case)
    page = write_fit_and_page(fit, options.out)
    return show_reported(page, fit.results, fit_blocks(fit.results, {}), options.json)


def _is_synthetic(case: Path) -> bool:
    """Return whether a case file states that its readings are synthetic; False if it cannot be read."""
    from hygrokf.data.record import Provenance
    from hygrokf.data.toml_form import FormFault, read_toml

    try:
        return bool(read_toml(case)[1].get("provenance") == Provenance.SYNTHETIC)
    except FormFault:
        return False


DEMO = Verb("demo", "make a synthetic turbine, fit it, evaluate and report it", _demo_arguments, _demo)
