"""The command `scripts/discovery_battery`: choose cases, run them, print tables."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from plants.hidden import FORMS

from battery.cases import DAYS, FIRST_SEED, GROUPS, ROUNDS, Case, chosen, ci, full
from battery.lines import answer
from battery.tables import all_tables
from battery.trial import ENGINES, case_key, load, run_case, sources_hash

RESULTS = Path(__file__).resolve().parents[2] / "build" / "discovery_battery.jsonl"
CI_STARTS = 1

Say = Callable[[str], None]


def read_lines(files: Sequence[Path]) -> list[dict]:
    """Lines of results files; a last line that was cut off in writing is left out."""
    found = []
    for file in files:
        texts = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
        for number, text in enumerate(texts, 1):
            try:
                found.append(json.loads(text))
            except json.JSONDecodeError as broken:
                if number < len(texts):
                    raise SystemExit(f"{file}, line {number}: expected JSON, found {text[:60]!r}") from broken
    return found


def remaining(
    cases: Sequence[Case], lines: Sequence[Mapping], engine: str, strict: bool = False, retry: bool = False
) -> list[Case]:
    """The cases that have no line yet.

    strict: lines of other sources of the package do not count. retry: neither do failures. A measured record
    that was not there is looked for again.
    """
    done = {
        line["key"]
        for line in lines
        if not line["skipped"]
        and not (strict and line["sources"] != sources_hash())
        and not (retry and line["failure"])
    }
    return [case for case in cases if case_key(case, engine) not in done]


def run(cases: Sequence[Case], jobs: int, engine: str, starts: int | None) -> Iterator[dict]:
    """Lines of the cases as they are done, in `jobs` processes."""
    load(engine)
    if jobs == 1:
        for case in cases:
            yield run_case(case, engine, starts)
        return
    with ProcessPoolExecutor(jobs) as pool:
        waiting = [pool.submit(run_case, case, engine, starts) for case in cases]
        try:
            for one in as_completed(waiting):
                yield one.result()
        except BaseException:  # stopped from outside: what has not begun is left for the next time
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def run_into(
    file: Path | None, cases: Sequence[Case], jobs: int, engine: str, starts: int | None, say: Say
) -> list[dict]:
    """Run cases, append each line to the file as soon as it is there, and return the lines."""
    made, begin = [], time.perf_counter()
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.exists() and (text := file.read_bytes()) and not text.endswith(b"\n"):
            file.write_bytes(text[: text.rfind(b"\n") + 1])  # a line that was cut off in writing
    for line in run(cases, jobs, engine, starts):
        made.append(line)
        if file is not None:
            with file.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(line) + "\n")
        told = (
            f"skipped: {line['skipped']}" if line["skipped"] else f"{answer(line)}, {line['cpu_s']:.0f} s CPU"
        )
        left = (time.perf_counter() - begin) / len(made) * (len(cases) - len(made))
        say(f"{len(made)}/{len(cases)} {line['key']} -> {told}; {left / 60:.0f} min left")
    return made


def shard(text: str) -> tuple[int, int]:
    """I/N with I from 1 to N."""
    try:
        part, parts = (int(one) for one in text.split("/"))
    except ValueError:
        part, parts = 0, 0
    if not 1 <= part <= parts:
        raise argparse.ArgumentTypeError(f"expected I/N with I from 1 to N, found {text!r}")
    return part, parts


def whole(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 on, found {text!r}")
    return int(text)


def length(text: str) -> float:
    try:
        days = float(text)
    except ValueError:
        days = 0.0
    if not days >= 10.0:
        raise argparse.ArgumentTypeError(f"expected a number of days from 10 on, found {text!r}")
    return days


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="scripts/discovery_battery",
        description="Hide causes in simulated and measured records, let `discover` name them, print how "
        "often it is right.",
    )
    made.add_argument(
        "--results", type=Path, nargs="+", metavar="FILE",
        help=f"JSON lines; the first is appended to, all are read (default: build/{RESULTS.name}; with --ci: "
             "none)",
    )  # fmt: skip
    made.add_argument("--jobs", type=whole, metavar="N", help="processes (default: 1; with --ci: 2)")
    made.add_argument("--groups", nargs="+", choices=GROUPS, help="some groups of cases")
    made.add_argument(
        "--causes", nargs="+", choices=("none", *FORMS), metavar="CAUSE", help="cases that hide these"
    )
    made.add_argument(
        "--seeds", type=int, nargs=2, default=(FIRST_SEED, ROUNDS), metavar=("FIRST", "COUNT"),
        help=f"first seed and number of rounds (default: {FIRST_SEED} {ROUNDS}); a round has every cell once "
             "and 40 plants "
        "that hide nothing",
    )  # fmt: skip
    made.add_argument(
        "--days", type=length, default=DAYS, help=f"length of the plants' records (default: {DAYS:g})"
    )
    made.add_argument(
        "--shard", type=shard, default=(1, 1), metavar="I/N", help="every N-th case, from the I-th on"
    )
    made.add_argument(
        "--engine", choices=ENGINES, default="discover", help="choose: scene and choice alone, for tuning"
    )
    made.add_argument(
        "--starts", type=whole, help="starts of the base fit (default: the engine's; with --ci: 1)"
    )
    made.add_argument(
        "--strict", action="store_true", help="run again what other sources of the package have answered"
    )
    made.add_argument("--retry", action="store_true", help="run again what failed")
    made.add_argument("--ci", action="store_true", help="the small list, in minutes")
    made.add_argument("--only-tables", action="store_true", help="run nothing")
    made.add_argument("--list", action="store_true", help="print the keys of the cases that would run")
    made.add_argument("--json", action="store_true", help="print JSON instead of tables")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing and print the tables; the exit status says nothing about what they say."""
    made = parser()
    options = made.parse_args(arguments)
    first, rounds = options.seeds
    if first < 0 or rounds < 1:
        made.error(f"--seeds: expected FIRST ≥ 0 and COUNT ≥ 1, found {first} {rounds}")
    files = options.results or ([] if options.ci else [RESULTS])
    jobs = options.jobs or (2 if options.ci else 1)
    starts = options.starts or (CI_STARTS if options.ci else None)
    cases = chosen(ci() if options.ci else full(first, rounds, options.days), options.groups, options.causes)
    part, parts = options.shard
    lines = read_lines(files)
    left = remaining(cases[part - 1 :: parts], lines, options.engine, options.strict, options.retry)
    if options.list:
        print("\n".join(case_key(case, options.engine) for case in left))
        return 0
    if not options.only_tables:
        where = files[0] if files else None
        lines += run_into(
            where, left, jobs, options.engine, starts, lambda text: print(text, file=sys.stderr, flush=True)
        )
    shown = [line for line in lines if line["engine"] == options.engine]
    if not shown:
        print("no results yet", file=sys.stderr)
        return 1
    print(told(shown, options.engine, options.json))
    return 0


def told(lines: Sequence[Mapping], engine: str, as_json: bool = False) -> str:
    """All tables as text or JSON, headed by what they are of."""
    tables = all_tables(lines)
    days = sorted({line["days"] for line in lines if line["days"]})
    hashes = sorted({line["sources"] for line in lines})
    if as_json:
        head = {"engine": engine, "lines": len(lines), "days": days, "sources": hashes}
        return json.dumps({**head, **{table.name: table.to_json() for table in tables}}, indent=1)
    mixed = " (mixed: run with --strict for one)" if len(hashes) > 1 else ""
    head = (
        f"# Battery: {len(lines)} lines, engine {engine}, records of {', '.join(f'{d:g}' for d in days)} "
        f"days, sources {', '.join(hashes)}{mixed}"
    )
    return "\n\n".join([head, *(table.markdown() for table in tables)])
