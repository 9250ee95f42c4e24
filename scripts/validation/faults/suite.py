"""Whether a live tracker loses or doubles anything when it, its broker, its server or its store is killed,
and the like: docs/validation/live_guarantees.md.

The tracker is `hygrokf track` in a process of its own; mosquitto, PostgreSQL and an OPC UA server run on
loopback, on free ports.  Afterwards every reading must be stored once, and the state must be the offline
filter's, bit for bit.  The extra `test`, mosquitto and PostgreSQL must be installed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from builders.databases import running_server

from validation.counts import markdown
from validation.faults.clock import jumping_clock
from validation.faults.disk import DAMAGES, damaged_store, full_disk
from validation.faults.flood import flood
from validation.faults.kills import killed_broker, killed_database, killed_server, killed_tracker
from validation.faults.payloads import malformed
from validation.faults.plant import Outcome
from validation.faults.together import killed_together
from validation.frame import Claim


def _tracker_on_postgresql(folder: Path, seed: int, kills: int) -> Outcome:
    with running_server() as server:
        return killed_tracker(folder, seed, kills, server.url(server.database()))


def _together(folder: Path, seed: int, kills: int, in_postgresql: bool = False) -> Outcome:
    with running_server() as server:
        return killed_together(folder, seed, server, kills, in_postgresql)


def _database(folder: Path, seed: int, kills: int) -> Outcome:
    with running_server() as server:
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


SCENARIOS: Mapping[str, tuple[Callable[[Path, int, int], Outcome], int]] = {
    "tracker": (killed_tracker, 40),
    "tracker-postgresql": (_tracker_on_postgresql, 10),
    "sources": (_together, 50),
    "sources-postgresql": (lambda *how: _together(*how, in_postgresql=True), 50),
    "broker": (killed_broker, 5),
    "opcua": (killed_server, 5),
    "postgresql": (_database, 5),
    "disk": (full_disk, 5),
    "damage": (_damages, 8),
    "clock": (lambda folder, seed, count: jumping_clock(folder, seed), 1),
    "payloads": (malformed, 10_000),
    "flood": (flood, 50_000),
    "million": (lambda *how: flood(*how, through="broker"), 1_000_000),
}
"""What can be done to a tracker: what does it in a folder with a seed and so often, and how often by default
(kills, fillings, damaged files, payloads, messages)."""


def one(scenario: str, seed: int, *, amount: int = 0) -> dict:
    """A scenario in a folder of its own; an `amount` of 0 is the documented one."""
    done, usual = SCENARIOS[scenario]
    with tempfile.TemporaryDirectory(prefix="hygrokf-faults-") as folder:
        return done(Path(folder), seed, amount or usual).to_json()


def table(lines: Sequence[Mapping]) -> str:
    """A row a scenario and seed; what else was seen stands below."""
    rows = [
        (one["variant"], *(f"{one[n]:,}" for n in ("seed", "blows", "messages", "missing", "doubled")),
         "equal" if one["equal"] else "OTHER", "yes" if one["held"] else "NO")
        for one in lines
    ]  # fmt: skip
    head = ("scenario", "seed", "blows", "messages", "missing", "doubled", "state", "held")
    said = [f"{one['variant']}, seed {one['seed']}: {one['fault'] or one['words']}" for one in lines]
    return "\n".join([markdown(head, rows), "", *said])


CLAIM = Claim("faults", dict.fromkeys(SCENARIOS, range(1, 2)), one, table)
