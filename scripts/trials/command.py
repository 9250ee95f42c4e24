"""The command `scripts/live_trials`: run the seeds that are missing, print tables, draw the picture."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from trials import (
    changes,
    clocks,
    contradictions,
    faulty,
    forecast,
    notification,
    restart,
    saturation,
    spikes,
)
from trials.picture import reliability_png


@dataclass(frozen=True)
class Trial:
    """`one` gives the line of a seed, `table` the text of many lines."""

    one: Callable[[int], dict]
    table: Callable[[Sequence[Mapping]], str]
    help: str


TRIALS = {
    "forecast": Trial(forecast.one, forecast.table, "forecasts over sixty days against what came"),
    "restart": Trial(restart.one, restart.table, "advice how long to pre-heat against how long it took"),
    "heater": Trial(restart.of_heater, restart.table, "the same with a logged heater that has a thermostat"),
    "saturation": Trial(
        saturation.one, saturation.table, "condensation said for several surfaces against what came"
    ),
    "mail": Trial(
        notification.of_mail, notification.table, "notices by mail over a hundred outages of the server"
    ),
    "webhook": Trial(notification.of_webhook, notification.table, "the same of a webhook"),
    "contradictions": Trial(
        contradictions.one, contradictions.table, "readings that are said to contradict the estimate"
    ),
    "clocks": Trial(clocks.one, clocks.table, "how often a wrong clock, unit or column is named"),
    "clocks_right": Trial(clocks.right, clocks.table_of_right, "what is named where all clocks are right"),
    "spikes": Trial(spikes.one, spikes.table, "bad readings in a record, and what they move in its fit"),
    "tracked_spikes": Trial(
        spikes.tracked, spikes.table_of_tracked, "bad readings, and what they move in the tracker's states"
    ),
    **{
        name.replace(" ", "_"): Trial(one, faulty.table, f"estimates and alarms of a plant: {name}")
        for name, one in faulty.ONES.items()
    },
    "changes": Trial(
        changes.one, changes.table, "when a cabinet's change is reported, and how often wrongly"
    ),
}


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


def run(trial: Trial, seeds: Sequence[int], workers: int) -> Iterator[dict]:
    """Lines of the seeds, in their order."""
    if workers == 1:
        yield from map(trial.one, seeds)
        return
    with ProcessPoolExecutor(workers) as pool:
        yield from pool.map(trial.one, seeds)


def run_into(file: Path, trial: Trial, seeds: Sequence[int], workers: int) -> None:
    """Append the lines of the seeds that the file does not have yet, each as soon as it is there."""
    lines = read_lines([file])
    done = {line["seed"] for line in lines}
    # a line that was cut off would spoil the next one
    file.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    with file.open("a", encoding="utf-8") as out:
        for line in run(trial, [seed for seed in seeds if seed not in done], workers):
            out.write(json.dumps(line) + "\n")
            out.flush()
            print(f"seed {line['seed']}", file=sys.stderr, flush=True)


def span(text: str) -> range:
    """Seeds FIRST:LAST, LAST excluded."""
    try:
        first, last = (int(part) for part in text.split(":"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected FIRST:LAST, e.g. 100:120, found {text!r}") from None
    return range(first, last)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="live_trials", description=__doc__)
    commands = parser.add_subparsers(dest="trial", required=True)
    for name, trial in TRIALS.items():
        command = commands.add_parser(name, help=trial.help)
        command.add_argument("--seeds", type=span, metavar="FIRST:LAST", help="LAST excluded")
        command.add_argument(
            "--out", type=Path, metavar="FILE", help="lines are appended; seeds in it are skipped"
        )
        command.add_argument("--workers", type=int, default=1)
        command.add_argument(
            "--table", type=Path, nargs="+", metavar="FILE", help="print the tables of these files"
        )
        if name == "forecast":
            command.add_argument(
                "--picture", type=Path, metavar="PNG", help="draw the reliability of --table's files"
            )
    options = parser.parse_args(arguments)
    if not options.table and not (options.seeds and options.out):
        parser.error("expected --seeds with --out, or --table")
    trial = TRIALS[options.trial]
    if options.seeds and options.out:
        run_into(options.out, trial, options.seeds, options.workers)
    if options.table:
        lines = read_lines(options.table)
        if not lines:
            raise SystemExit(
                f"no lines in {', '.join(map(str, options.table))}: run it with --seeds and --out first"
            )
        print(trial.table(lines))
        if getattr(options, "picture", None):
            options.picture.write_bytes(reliability_png(forecast.Forecasts(lines)))
    return 0
