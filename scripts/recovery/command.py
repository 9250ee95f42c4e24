"""The command `scripts/coverage`: fit the plants that are missing, print tables."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from trials.command import read_lines, span

from recovery.one import line
from recovery.rows import ROWS
from recovery.tables import free_runs, table

Fitted = Callable[[str, int, float], dict]


def fitted(row: str, seeds: Sequence[int], days: float, workers: int, one: Fitted) -> Iterator[dict]:
    """Lines of the seeds, each as soon as it is there."""
    if workers == 1:
        for seed in seeds:
            yield one(row, seed, days)
        return
    with ProcessPoolExecutor(workers) as pool:
        for job in as_completed([pool.submit(one, row, seed, days) for seed in seeds]):
            yield job.result()


def run_into(
    file: Path, row: str, seeds: Sequence[int], days: float, workers: int, one: Fitted = line
) -> None:
    """Append the lines of the row's seeds that the file does not have yet."""
    there = read_lines([file])
    other = {text["days"] for text in there if text["row"] == row} - {days}
    if other:
        raise SystemExit(f"{file} holds records of {other.pop():g} days: expected {days:g}, or another --out")
    # a line that was cut off would spoil the next one
    file.write_text("".join(json.dumps(text) + "\n" for text in there), encoding="utf-8")
    done = {text["seed"] for text in there if text["row"] == row}
    wanted = [seed for seed in seeds if seed not in done]
    with file.open("a", encoding="utf-8") as out:
        for count, text in enumerate(fitted(row, wanted, days, workers, one), 1):
            out.write(json.dumps(text) + "\n")
            out.flush()
            print(f"{row}: seed {text['seed']}, {count} of {len(wanted)}", file=sys.stderr, flush=True)


def printed(lines: Sequence[Mapping]) -> str:
    """The table, and beneath it how large the free-run errors are."""
    sources = {one["sources"] for one in lines}
    note = [f"(fits of {len(sources)} versions of the package's sources)"] if len(sources) > 1 else []
    return "\n".join([table(lines), "", free_runs(lines), *note])


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="coverage", description=__doc__)
    parser.add_argument("--row", choices=sorted(ROWS), help="what the records of the plants are like")
    parser.add_argument("--seeds", type=span, metavar="FIRST:LAST", help="LAST excluded")
    parser.add_argument("--days", type=float, default=90.0, help="length of a record")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="lines are appended; seeds in it are skipped"
    )
    parser.add_argument(
        "--table", type=Path, nargs="+", metavar="FILE", help="print the table of these files"
    )
    options = parser.parse_args(arguments)
    study = (options.row, options.seeds, options.out)
    if None in study and (not options.table or any(study)):
        parser.error("expected --row, --seeds and --out, or --table")
    if options.out:
        run_into(options.out, options.row, options.seeds, options.days, options.workers)
    files = options.table or [options.out]
    lines = read_lines(files)
    if not lines:
        raise SystemExit(f"no lines in {', '.join(map(str, files))}: run a row with --seeds and --out first")
    print(printed(lines))
    return 0
