"""The command `scripts/live_faults`: scenarios, how much of each, output."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from builders.databases import Server

from faults.clock import jumping_clock
from faults.disk import DAMAGES, damaged_store, full_disk
from faults.flood import flood
from faults.kills import killed_broker, killed_database, killed_server, killed_tracker
from faults.outcome import Outcome, table
from faults.payloads import malformed
from faults.together import killed_together


@contextmanager
def postgresql() -> Iterator[Server]:
    """A PostgreSQL server of its own, which ends with the block."""
    # another user must be able to enter the folder, and a socket's path must be short
    folder = Path(tempfile.mkdtemp(prefix="hygrokf-pg-"))
    try:
        server = Server(folder)
        try:
            server.start()
            yield server
        finally:
            server.stop()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _tracker_on_postgresql(folder: Path, seed: int, kills: int) -> Outcome:
    with postgresql() as server:
        return killed_tracker(folder, seed, kills, server.url(server.database()))


def _together(folder: Path, seed: int, kills: int) -> Outcome:
    with postgresql() as server:
        return killed_together(folder, seed, server, kills)


def _together_on_postgresql(folder: Path, seed: int, kills: int) -> Outcome:
    with postgresql() as server:
        return killed_together(folder, seed, server, kills, in_postgresql=True)


def _database(folder: Path, seed: int, kills: int) -> Outcome:
    with postgresql() as server:
        return killed_database(folder, seed, server, kills)


def _damages(folder: Path, seed: int, count: int) -> Outcome:
    """Damages of all kinds in turn; the first outcome that does not hold, or the last."""
    for number in range(count):
        own = folder / str(number)
        own.mkdir()
        found = damaged_store(own, seed + number, DAMAGES[number % len(DAMAGES)])
        if not found.held:
            break
    return found


@dataclass(frozen=True)
class Scenario:
    """`run` takes a folder, a seed and how much is done; `usual` and `thorough` amounts, and what they
    count."""

    run: Callable[[Path, int, int], Outcome]
    usual: int
    thorough: int
    unit: str


SCENARIOS = {
    "tracker": Scenario(killed_tracker, 4, 40, "kills"),
    "tracker-postgresql": Scenario(_tracker_on_postgresql, 1, 10, "kills"),
    "sources": Scenario(_together, 4, 50, "kills"),
    "sources-postgresql": Scenario(_together_on_postgresql, 4, 50, "kills"),
    "broker": Scenario(killed_broker, 1, 5, "kills"),
    "opcua": Scenario(killed_server, 1, 5, "kills"),
    "postgresql": Scenario(_database, 1, 5, "kills"),
    "disk": Scenario(full_disk, 1, 5, "fillings"),
    "damage": Scenario(_damages, 1, 8, "damaged files"),
    "clock": Scenario(lambda folder, seed, count: jumping_clock(folder, seed), 1, 1, "runs"),
    "payloads": Scenario(malformed, 1_000, 10_000, "payloads"),
    "flood": Scenario(flood, 50_000, 50_000, "messages"),
    "million": Scenario(lambda *how: flood(*how, through="broker"), 200_000, 1_000_000, "messages"),
}
"""What can be done to a tracker, by name."""


def run(name: str, seed: int, amount: int) -> Outcome:
    """One scenario in a folder of its own; what it could not see happen did not hold."""
    with tempfile.TemporaryDirectory(prefix="hygrokf-faults-") as folder:
        try:
            return SCENARIOS[name].run(Path(folder), seed, amount)
        except AssertionError as broken:
            return Outcome(name, seed, 0, 0, equal=False, fault=str(broken))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run scenarios and print what was found; the exit status is 1 where something did not hold."""
    parser = argparse.ArgumentParser(
        prog="scripts/live_faults",
        description="Does a live tracker lose or double anything, whatever happens?",
    )
    parser.add_argument(
        "scenarios", nargs="*", metavar="SCENARIO", help=f"of {', '.join(SCENARIOS)}; all without any"
    )
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="seeds 1 … N (default 1)")
    parser.add_argument("--thorough", action="store_true", help="as much as the slow tests do")
    parser.add_argument("--amount", type=int, help="how much of each, instead of the usual")
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    options = parser.parse_args(arguments)
    unknown = sorted(set(options.scenarios) - set(SCENARIOS))
    if unknown:
        parser.error(f"unknown {unknown}; there are {', '.join(SCENARIOS)}")
    outcomes = []
    for name in options.scenarios or SCENARIOS:
        scenario = SCENARIOS[name]
        amount = options.amount or (scenario.thorough if options.thorough else scenario.usual)
        for seed in range(1, options.seeds + 1):
            print(f"{name}, seed {seed}: {amount:,} {scenario.unit} ...", file=sys.stderr, flush=True)
            outcomes.append(run(name, seed, amount))
            if not outcomes[-1].held:
                print(
                    f"{name}, seed {seed}: does not hold: {outcomes[-1].fault}", file=sys.stderr, flush=True
                )
    print(json.dumps([one.to_json() for one in outcomes], indent=1) if options.json else table(outcomes))
    return 0 if all(one.held for one in outcomes) else 1
