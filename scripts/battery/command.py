"""The command `scripts/discovery_trials`: run the cases that are missing, print the table."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from trials.command import read_lines, span

from battery import constants
from battery.calibration import calibrated
from battery.cases import GROUPS, Case, chosen
from battery.tables import table
from battery.trial import run_case


def run_into(file: Path, cases: Sequence[Case], one: Callable[[Case], dict] = run_case) -> None:
    """Append a line a case to the file; cases that stand there are left out."""
    there = read_lines([file])
    # a line that was cut off would spoil the next one
    file.write_text("".join(json.dumps(line) + "\n" for line in there), encoding="utf-8")
    done = {line["key"] for line in there}
    wanted = [case for case in cases if case.key not in done]
    with file.open("a", encoding="utf-8") as out:
        for count, case in enumerate(wanted, 1):
            line = one(case)
            out.write(json.dumps(line) + "\n")
            out.flush()
            told = line["skipped"] or (line["failure"] or {}).get("type") or line["verdict"]
            named = ", ".join(f"{name['cause']}/{name['form']}" for name in line["names"])
            print(f"{count} of {len(wanted)} {case.key}: {named or told}", file=sys.stderr, flush=True)


def run_constants(file: Path) -> None:
    """Append the lines of every variant of the cases that the file lacks."""
    done = {line["key"].partition(": ")[2] for line in read_lines([file])} if file.exists() else set()
    for case in constants.cases():
        if case.key not in done:
            some = list(constants.lines_of(case))
            with file.open("a", encoding="utf-8") as out:
                out.writelines(json.dumps(line) + "\n" for line in some)
            print(case.key, file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="discovery_trials", description=__doc__)
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=f"one or more of {', '.join(GROUPS)}")
    parser.add_argument("--seeds", type=span, metavar="A:B", help="seeds of each cell, B excluded")
    parser.add_argument(
        "--out", type=Path, nargs="+", required=True, metavar="FILE",
        help="JSON lines: the first is appended to and its cases are left out; the table reads all",
    )  # fmt: skip
    parser.add_argument("--table", action="store_true", help="print the table of the files")
    parser.add_argument(
        "--calibrate", action="store_true", help="print the coefficients of the confidence from the files"
    )
    parser.add_argument(
        "--constants", action="store_true",
        help="halve and double each constant that decides, on ten plants and five nulls",
    )  # fmt: skip
    options = parser.parse_args(arguments)
    if options.constants:
        run_constants(options.out[0])
        print(constants.table(read_lines(options.out)))
        return 0
    if unknown := sorted(set(options.groups) - set(GROUPS)):
        parser.error(f"expected groups of {', '.join(GROUPS)}, found {', '.join(unknown)}")
    printed = [one for one, wanted in ((table, options.table), (calibrated, options.calibrate)) if wanted]
    if bool(options.groups) != bool(options.seeds) or not (options.groups or printed):
        parser.error("expected GROUP and --seeds, or --table, --calibrate or --constants")
    if options.groups:
        run_into(options.out[0], chosen(options.groups, options.seeds))
    if printed:
        lines = read_lines(options.out)
        if not lines:
            parser.error(f"no lines in {', '.join(map(str, options.out))}: name a GROUP and --seeds first")
        for one in printed:
            print(one(lines))
    return 0
