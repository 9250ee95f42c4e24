"""The command `scripts/benchmark`: topics, their sections, output."""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections.abc import Sequence
from importlib import import_module

from benchmarks.measure import Figure, table

TOPICS = {"identify": "benchmarks.identify", "track": "benchmarks.track", "fleet": "benchmarks.fleet"}
"""What can be measured: topic -> the module whose `SECTIONS` maps names to functions quick -> figures."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; the exit status says nothing about targets (a busy machine is no fault)."""
    parser = argparse.ArgumentParser(
        prog="scripts/benchmark", description="Figures, targets, what was reached."
    )
    parser.add_argument(
        "topic", nargs="?", default="identify", choices=sorted(TOPICS), help="default: identify"
    )
    parser.add_argument("--quick", action="store_true", help="short runs: a smoke test, not a measurement")
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    parser.add_argument("--only", nargs="+", metavar="SECTION", help="some sections of the topic")
    options = parser.parse_args(arguments)
    sections = import_module(TOPICS[options.topic]).SECTIONS
    chosen = options.only or list(sections)
    unknown = sorted(set(chosen) - set(sections))
    if unknown:
        parser.error(f"--only: unknown {unknown}; {options.topic} has {sorted(sections)}")
    figures: list[Figure] = []
    for name in chosen:
        print(f"measuring {name} ...", file=sys.stderr)
        figures.extend(sections[name](options.quick))
    if options.json:
        print(json.dumps({"machine": machine(), "figures": [f.to_json() for f in figures]}, indent=1))
    else:
        print(table(figures))
    return 0


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
