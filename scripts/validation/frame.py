"""The frame of all claims: seeds, workers, a line of JSON a case, going on where it stopped, the table."""

from __future__ import annotations

import argparse
import hashlib
import inspect
import json
import math
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import Path

import hygrokf

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
"""Measured records; they are not shipped."""
CLAIMS = {
    "coverage": "bounds of time constants hold the truth",
    "discovery": "causes are named, and none where there is none",
    "constants": "what half and double of each constant that decides do to discover",
    "transfer": "verdicts on pairs of cabinets, and what a type says of its next turbine",
    "climate": "bounds of a simulated climate hold",
    "forecast": "forecasts of the tracker against what came",
    "saturation": "condensation said for several surfaces against what came",
    "restart": "advice how long to pre-heat against how long it took",
    "changes": "when a cabinet's change is reported, and how often wrongly",
    "contradictions": "readings that are said to contradict the estimate",
    "spikes": "bad readings, and what they move",
    "faulty": "estimates and alarms of cabinets and sensors that fail",
    "cabinet": "a measured cabinet of a turbine",
    "sisters": "transfers between measured sisters",
    "paper": "the experiments of the paper, repeated",
    "faults": "a live tracker loses and doubles nothing when it, its peers or its store fail",
    "notices": "notices arrive whatever their receiver does",
    "clocks": "wrong clocks, units and columns are named, right ones are not",
}
"""Name, which is also that of the module with its `CLAIM` -> what is claimed."""
Line = Mapping
Case = tuple
"""A variant, what distinguishes its cases where that is more than their seed, and the seed."""


class Absent(Exception):
    """A measured record is not there, or a program: its case is left out."""


@dataclass(frozen=True)
class Claim:
    """What a command measures.

    `seeds` are the documented ones of each variant.  `one(*case, **settings)` gives what is found in a case;
    its keyword-only arguments are options of the command.  `cases(variant, seed)` are the cases of a seed.
    `table` sums up lines, `docs` writes pictures and tables of the documentation.  `before(*case)`: what is
    known of a case whatever it raises; without it the table is given no lines of cases that raised."""

    name: str
    seeds: Mapping[str, range]
    one: Callable[..., Mapping]
    table: Callable[[Sequence[Line]], str]
    cases: Callable[[str, int], Iterable[Case]] = lambda variant, seed: [(variant, seed)]
    docs: Callable[[Sequence[Line]], None] | None = None
    before: Callable[..., Mapping] | None = None

    @property
    def settings(self) -> dict[str, object]:
        """Keyword-only arguments of `one` with their defaults."""
        arguments = inspect.signature(self.one).parameters.values()
        return {one.name: one.default for one in arguments if one.kind is inspect.Parameter.KEYWORD_ONLY}

    def chosen(self, variants: Iterable[str], seeds: Iterable[int] | None = None) -> list[Case]:
        """Cases of some variants, seed by seed: a run that is stopped early has seen every variant."""
        pairs = [(seed, v) for v in variants for seed in (self.seeds[v] if seeds is None else seeds)]
        pairs.sort(key=lambda pair: pair[0])
        return [case for seed, variant in pairs for case in self.cases(variant, seed)]


def claim_of(name: str) -> Claim:
    return import_module(f"validation.{name}").CLAIM


def key_of(case: Case) -> str:
    return ":".join(map(str, case))


@lru_cache(maxsize=1)
def sources_hash() -> str:
    """The package's sources in twelve digits: results of other sources are other results."""
    root = Path(hygrokf.__file__).parent
    found = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        found.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return found.hexdigest()[:12]


def plain(value):
    """The same as JSON can hold it: numbers of numpy as Python's, what is not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def by_variant(lines: Iterable[Line]) -> dict[str, list[Line]]:
    """Lines by their variant, in the order in which these occur."""
    found: dict[str, list[Line]] = {}
    for line in lines:
        found.setdefault(line["variant"], []).append(line)
    return found


# -- running -------------------------------------------------------------------------------------------------
def line_of(claim: Claim, case: Case, settings: Mapping) -> dict:
    """The line of a case.  What is raised is part of it: a study counts failures, it does not stop at
    them."""
    line: dict = {
        "key": key_of(case),
        "variant": case[0],
        "seed": case[-1],
        "settings": dict(settings),
        "sources": sources_hash(),
        "failure": None,
        **(claim.before(*case) if claim.before else {}),
    }
    try:
        return plain({**line, **claim.one(*case, **settings)})
    except Absent as reason:
        return line | {"absent": str(reason)}
    except Exception as broken:
        return line | {
            "failure": f"{type(broken).__name__}: {broken}",
            "trace": traceback.format_exc()[-3000:],
        }


def _in_a_worker(name: str, case: Case, settings: Mapping) -> dict:
    return line_of(claim_of(name), case, settings)


def run(claim: Claim, cases: Sequence[Case], settings: Mapping, workers: int = 1) -> Iterator[dict]:
    """Lines of cases, each as soon as it is there."""
    if workers == 1:
        for case in cases:
            yield line_of(claim, case, settings)
        return
    with ProcessPoolExecutor(workers) as pool:
        jobs = [pool.submit(_in_a_worker, claim.name, case, settings) for case in cases]
        for job in as_completed(jobs):
            yield job.result()


def read_lines(files: Iterable[Path]) -> list[dict]:
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


def run_into(
    file: Path, claim: Claim, cases: Sequence[Case], settings: Mapping, workers: int = 1
) -> list[str]:
    """Append the lines of the cases that the file does not have yet; returns the reasons of absent ones."""
    there = read_lines([file])
    variants = {case[0] for case in cases}
    others = [line["settings"] for line in there if line.get("variant") in variants]
    if other := next((one for one in others if one != dict(settings)), None):
        raise SystemExit(f"{file} holds lines of {other}: expected {dict(settings)}, or another --out")
    file.parent.mkdir(parents=True, exist_ok=True)
    # a line that was cut off would spoil the next one
    file.write_text("".join(json.dumps(line) + "\n" for line in there), encoding="utf-8")
    done = {line.get("key") for line in there}
    wanted = [case for case in cases if key_of(case) not in done]
    absent = []
    with file.open("a", encoding="utf-8") as out:
        for count, line in enumerate(run(claim, wanted, settings, workers), 1):
            reason = line.get("absent", "")
            if reason:
                absent.append(f"{line['key']}: left out, {reason}")
            else:
                out.write(json.dumps(line) + "\n")
                out.flush()
            said = reason or line["failure"] or line.get("said", "")
            print(f"{count} of {len(wanted)}, {line['key']}" + f": {said}" * bool(said), file=sys.stderr,
                  flush=True)  # fmt: skip
    return absent


# -- the command ---------------------------------------------------------------------------------------------
def printed(claim: Claim, lines: Sequence[Line]) -> str:
    """The table, and beneath it what failed and whether results are of several versions of the package."""
    lines = list({line.get("key", number): line for number, line in enumerate(lines)}.values())
    good = [line for line in lines if claim.before or not line.get("failure")]
    parts = [claim.table(good)] if good else []
    parts += [f"{line['key']}: {line['failure']}" for line in lines if line.get("failure")]
    versions = {line["sources"] for line in lines if "sources" in line}
    if len(versions) > 1:
        parts.append(f"(results of {len(versions)} versions of the package's sources)")
    return "\n".join(parts)


def span(text: str) -> range:
    """Seeds FIRST:LAST, LAST excluded."""
    try:
        first, last = (int(part) for part in text.split(":"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected FIRST:LAST, e.g. 100:120, found {text!r}") from None
    return range(first, last)


def _parser(claim: Claim) -> argparse.ArgumentParser:
    variants = "\n".join(f"  {name:30} {r.start}:{r.stop}" for name, r in claim.seeds.items())
    parser = argparse.ArgumentParser(
        prog=f"validate {claim.name}", formatter_class=argparse.RawDescriptionHelpFormatter,
        description=CLAIMS[claim.name], epilog=f"variants and their documented seeds:\n{variants}",
    )  # fmt: skip
    parser.add_argument("variants", nargs="*", metavar="VARIANT", help="all without any")
    parser.add_argument("--seeds", type=span, metavar="FIRST:LAST", help="other seeds, LAST excluded")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument(
        "--out", type=Path, metavar="FILE", default=ROOT / "build" / "validation" / f"{claim.name}.jsonl",
        help="lines are appended, what is there is left out (default: build/validation)",
    )  # fmt: skip
    parser.add_argument("--table", type=Path, nargs="*", metavar="FILE",
                        help="run nothing, print the table of these files (default: --out)")  # fmt: skip
    parser.add_argument("--docs", action="store_true", help="write pictures and tables of docs, too")
    for name, default in claim.settings.items():
        kind = str if default is None else type(default)
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, default=default,
                            metavar=name.upper(), help=f"default: {default}")  # fmt: skip
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a claim and print its table; the status is 1 where a case failed or did not hold."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    listed = "\n".join(f"  {name:16} {text}" for name, text in CLAIMS.items())
    chooser = argparse.ArgumentParser(
        prog="validate", formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Measure a claim of docs/validation again.", epilog=f"claims:\n{listed}",
    )  # fmt: skip
    chooser.add_argument("claim", choices=CLAIMS, metavar="CLAIM", help="one of those below")
    chooser.add_argument("rest", nargs="*", metavar="...", help="VARIANT and options: CLAIM --help")
    claim = claim_of(chooser.parse_args(words[:1]).claim)
    parser = _parser(claim)
    options = parser.parse_intermixed_args(words[1:])
    unknown = sorted(set(options.variants) - set(claim.seeds))
    if unknown:
        parser.error(f"expected variants of {', '.join(claim.seeds)}, found {', '.join(unknown)}")
    if options.docs and claim.docs is None:
        parser.error("--docs: this claim has no picture and no table of its own there")
    absent = []
    if options.table is None:
        settings = {name: getattr(options, name) for name in claim.settings}
        cases = claim.chosen(options.variants or claim.seeds, options.seeds)
        absent = run_into(options.out, claim, cases, settings, options.workers)
    lines = read_lines(options.table or [options.out])
    if not lines:
        raise SystemExit("\n".join(absent) or f"no lines in {options.out}: run it without --table first")
    print(printed(claim, lines))
    if options.docs:
        claim.docs(lines)
    return int(any(line.get("failure") or line.get("held") is False for line in lines))
