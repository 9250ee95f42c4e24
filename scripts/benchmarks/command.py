"""The command `scripts/benchmark`: what is compared with which revision, and the table of ratios."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence

from validation.counts import markdown
from validation.frame import ROOT

from benchmarks import against

QUICK_PAIRS = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; the exit status says nothing about ratios (a busy machine is no fault)."""
    kinds = tuple(dict.fromkeys(against.MEASUREMENTS.values()))
    parser = argparse.ArgumentParser(prog="scripts/benchmark", description="CPU time of two revisions.")
    parser.add_argument("--against", metavar="REVISION", required=True, help="the other revision")
    parser.add_argument("--only", nargs="+", metavar="KIND", choices=kinds, default=kinds, help=f"of {kinds}")
    parser.add_argument("--pairs", type=int, default=against.PAIRS, help=f"runs (default {against.PAIRS})")
    parser.add_argument(
        "--fit-pairs", type=int, metavar="PAIRS", help="runs of `fit` and `track` (default: as --pairs)"
    )
    parser.add_argument("--quick", action="store_true", help="two pairs: a smoke test, not a measurement")
    options = parser.parse_args(arguments)
    pairs = QUICK_PAIRS if options.quick else options.pairs
    fit_pairs = options.fit_pairs or pairs
    if (not options.quick and pairs < against.PAIRS) or fit_pairs < 1:
        parser.error(
            f"--pairs: expected {against.PAIRS} or more, --fit-pairs 1 or more, found {pairs}, {fit_pairs}"
        )
    ratios: list[against.Ratio] = []
    try:
        for one in against.ratios(ROOT, options.against, options.only, pairs, fit_pairs):
            print(f"{one.name}: {one.median:.3f}", file=sys.stderr)
            ratios.append(one)
    except against.NotMeasured as why:
        parser.error(str(why))
    rows = ((r.name, f"{r.median:.4g}", _interval(r), r.note) for r in ratios)
    print(markdown(("measurement", f"this / {options.against}", "interval", ""), rows))
    return 0


def _interval(ratio: against.Ratio) -> str:
    """The interval that holds the median; none from two pairs."""
    return f"{ratio.low:.3g} … {ratio.high:.3g}" if math.isfinite(ratio.low) else "–"
