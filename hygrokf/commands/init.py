"""`hygrokf init`: a case file drafted from exports."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from dataclasses import replace
from pathlib import Path

from hygrokf.commands.console import UserFault, expect_file, printable, show
from hygrokf.commands.verb import Verb, add_json


def _degrees(text: str) -> tuple[float, float]:
    """Latitude and longitude."""
    try:
        latitude, longitude = map(float, text.split(","))
    except ValueError:
        latitude = longitude = 999.0
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        raise ArgumentTypeError(f"expected degrees such as 52.4,-0.95, found {text!r}")
    return latitude, longitude


def _arguments(parser: ArgumentParser) -> None:
    parser.add_argument(
        "exports", type=Path, nargs="+", metavar="EXPORT", help="CSV, Parquet, Excel or weather file"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("case.toml"), help="the case file to write (default case.toml)"
    )
    parser.add_argument("--turbine", metavar="NAME", help="of exports that hold several turbines")
    parser.add_argument(
        "--site", type=_degrees, metavar="LAT,LON", help="in degrees, as in --site=52.4,-0.95"
    )
    add_json(parser)


def _run(options: Namespace) -> int:
    from hygrokf.cases.case_file import CaseFault, read_case
    from hygrokf.drafting.draft import draft_case
    from hygrokf.report.record_text import draft_text

    expect_file(options.out)
    if options.out.exists():
        raise UserFault(f"--out {options.out}: expected a new file, found one; remove it or name another one")
    found = draft_case(options.exports, options.out, turbine=options.turbine, site=options.site)
    broken = ""
    try:
        said = read_case(options.out, cabinet=False, ambient=False).warnings
        found = replace(found, doubts=tuple(dict.fromkeys((*found.doubts, *said))))
    except CaseFault as fault:
        broken = f"the draft needs an edit before it can be read:\n{printable(str(fault))}"
    show(found, draft_text(found), options.json)
    if broken:
        print(broken, file=sys.stderr)
    return 0


VERB = Verb("init", "draft a case file from exports, with its doubts as comments", _arguments, _run)
