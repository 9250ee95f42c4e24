"""The command `scripts/benchmark`: topics, their sections, comparison of two revisions, output."""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from benchmarks import against
from benchmarks.measure import Figure, table

TOPICS = {"identify": "benchmarks.identify", "track": "benchmarks.track", "fleet": "benchmarks.fleet"}
"""What can be measured: topic -> the module whose `SECTIONS` maps names to functions quick -> figures."""
REPOSITORY = Path(__file__).resolve().parents[2]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; the exit status says nothing about targets (a busy machine is no fault)."""
    parser = argparse.ArgumentParser(
        prog="scripts/benchmark", description="Figures, targets, what was reached."
    )
    parser.add_argument("topic", nargs="?", choices=sorted(TOPICS), help="default: identify")
    parser.add_argument("--quick", action="store_true", help="short runs: a smoke test, not a measurement")
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    parser.add_argument("--only", nargs="+", metavar="SECTION", help="some sections of the topic")
    parser.add_argument(
        "--against", metavar="REVISION", help="ratios of this revision to another one, run by run"
    )
    parser.add_argument(
        "--pairs", type=int, default=against.PAIRS, help=f"runs of each revision (default {against.PAIRS})"
    )
    parser.add_argument(
        "--fit-pairs", type=int, metavar="PAIRS", help="runs of `hygrokf fit` (default: as --pairs)"
    )
    options = parser.parse_args(arguments)
    if options.against is None:
        figures, spread = _measured(parser, options), "quartiles"
    else:
        figures, spread = _compared(parser, options), "interval"
    if options.json:
        print(json.dumps({"machine": machine(), "figures": [f.to_json() for f in figures]}, indent=1))
    else:
        print(table(figures, spread))
    return 0


def _measured(parser: argparse.ArgumentParser, options: argparse.Namespace) -> list[Figure]:
    """The figures of a topic."""
    topic = options.topic or "identify"
    sections = import_module(TOPICS[topic]).SECTIONS
    figures: list[Figure] = []
    for name in _chosen(parser, options, list(sections), topic):
        print(f"measuring {name} ...", file=sys.stderr)
        figures.extend(sections[name](options.quick))
    return figures


def _compared(parser: argparse.ArgumentParser, options: argparse.Namespace) -> list[Figure]:
    """The ratios of this revision to another one."""
    if options.topic is not None:
        parser.error(f"--against: expected no topic beside it, found {options.topic}; --only chooses")
    least = 2 if options.quick else against.PAIRS
    pairs = 2 if options.quick else options.pairs
    fit_pairs = options.fit_pairs or pairs
    if pairs < least or fit_pairs < 1:
        parser.error(f"--pairs: expected {least} or more, --fit-pairs 1 or more, found {pairs}, {fit_pairs}")
    chosen = _chosen(parser, options, list(dict.fromkeys(against.MEASUREMENTS.values())), "--against")
    figures: list[Figure] = []
    try:
        for one in against.figures(REPOSITORY, options.against, chosen, pairs, fit_pairs):
            print(f"{one.name}: {one.reached:.3f}", file=sys.stderr)
            figures.append(one)
    except against.NotMeasured as why:
        parser.error(str(why))
    return figures


def _chosen(
    parser: argparse.ArgumentParser, options: argparse.Namespace, known: Sequence[str], of: str
) -> Sequence[str]:
    """The sections that were named, by default all of them."""
    chosen = options.only or known
    unknown = sorted(set(chosen) - set(known))
    if unknown:
        parser.error(f"--only: unknown {unknown}; {of} has {sorted(known)}")
    return list(chosen)


def machine() -> dict[str, str]:
    """What the figures belong to."""
    from importlib.metadata import version

    from llvmlite import binding

    return {
        "processor": binding.get_host_cpu_name(),
        "system": platform.platform(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("numpy", "llvmlite", "statsmodels", "filterpy")},
    }
