"""The command `scripts/head_to_head`: run what is missing, print the tables."""

from __future__ import annotations

import argparse
import json
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path

from battery.trial import plain, sources_hash

from rivals.cases import BOX, PLANT, Case, cases, outcome
from rivals.forward import LIMIT_S
from rivals.ground import ground
from rivals.methods import METHODS, NETWORK, RUN, SPARSE, Options
from rivals.tables import tables

RESULTS = Path(__file__).resolve().parents[2] / "build" / "head_to_head.jsonl"


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="scripts/head_to_head",
        description="Four ways to say what a model lacks, on the same simulated plants and the same measured "
        "boxes.",
    )
    made.add_argument(
        "--results",
        type=Path,
        default=RESULTS,
        metavar="FILE",
        help=f"JSON lines (default: build/{RESULTS.name})",
    )
    made.add_argument(
        "--pysindy",
        metavar="PYTHON",
        help="an interpreter that has pysindy; without it that method is skipped",
    )
    made.add_argument("--cases", choices=(PLANT, BOX), help="plants or measured boxes alone")
    made.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS, help="some methods")
    made.add_argument(
        "--limit", type=float, default=LIMIT_S, metavar="SECONDS",
        help=f"CPU time of the forward search for each record (default: {LIMIT_S:g})",
    )  # fmt: skip
    made.add_argument("--only-tables", action="store_true", help="run nothing")
    return made


def read(file: Path) -> list[dict]:
    """Lines of the results file, the last one of each case and method."""
    texts = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    lines = [json.loads(text) for text in texts if text.endswith("}")]
    return list({(line["case"], line["method"]): line for line in lines}.values())


def run_case(case: Case, methods: Sequence[str], options: Options) -> list[dict]:
    """One line for each method; what a method raises is part of its line."""
    shared = ground(case.record())
    found = []
    for method in methods:
        line: dict = {
            "case": case.key, "name": case.name, "kind": case.kind, "seed": case.seed, "right": case.right,
            "method": method, "sources": sources_hash(), "before": shared.held_out(), "failure": None,
        }  # fmt: skip
        try:
            said = RUN[method](shared, options)
            assert said is not None
            line |= said
            line["outcome"] = (
                None if method == NETWORK else outcome(said["names"], said.get("alike", []), case.right)
            )
        except Exception as broken:  # a failure is a result, and does not stop the others
            line["failure"] = f"{type(broken).__name__}: {broken}"
            traceback.print_exc()
        found.append(plain(line))
    return found


def run(
    some: Sequence[Case], done: Sequence[Mapping], options: Options, methods: Sequence[str], file: Path
) -> None:
    """Run what has no line yet, and append to the file."""
    there = {(line["case"], line["method"]) for line in done}
    file.parent.mkdir(parents=True, exist_ok=True)
    for case in some:
        left = [one for one in methods if (case.key, one) not in there]
        if not left:
            continue
        try:
            lines = run_case(case, left, options)
        except FileNotFoundError as absent:
            print(f"{case.key}: skipped, {Path(absent.filename or '').name} is not there", file=sys.stderr)
            continue
        with file.open("a", encoding="utf-8") as stream:
            for line in lines:
                stream.write(json.dumps(line) + "\n")
                said = (
                    line["failure"] or f"{', '.join(line['names']) or 'no name'}, {line['cpu_s']:.0f} s CPU"
                )
                print(f"{case.key} {line['method']}: {said}", file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    options = parser().parse_args(arguments)
    if not options.only_tables:
        methods = list(options.methods)
        if SPARSE in methods and options.pysindy is None:
            print("pysindy: skipped; --pysindy PYTHON names an interpreter that has it", file=sys.stderr)
            methods.remove(SPARSE)
        some = [case for case in cases() if options.cases in (None, case.kind)]
        run(some, read(options.results), Options(options.pysindy, options.limit), methods, options.results)
    lines = read(options.results)
    if not lines:
        print("no results yet", file=sys.stderr)
        return 1
    print(tables(lines))
    return 0
