"""A live tracker that is killed, starved and fed with rubbish: `scripts/validate faults` in small, in full
with the slow marker.

Afterwards every time: no acknowledged observation is missing, none is there twice, the state is the offline
filter's. What is done to single parts stands in their own tests (test_mqtt, test_opcua, test_postgres,
test_sqlite, test_service).
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from builders.brokers import needs_mosquitto
from builders.databases import Server
from validation import frame
from validation.faults import clock, disk, flood, kills, payloads, suite, together
from validation.faults.plant import Outcome, Plant
from validation.faults.tracker import Tracker


def holds(outcome) -> None:
    assert outcome.held, outcome
    assert outcome.messages > 0 and outcome.missing == outcome.doubled == 0


# -- kill -9 -------------------------------------------------------------------------------------------------
@needs_mosquitto
@pytest.mark.parametrize("count", [2, pytest.param(40, marks=pytest.mark.slow)])
def test_a_tracker_killed_at_random_moments(tmp_path: Path, count: int) -> None:
    found = kills.killed_tracker(tmp_path, seed=2, kills=count)
    holds(found)
    assert found.blows == count


@needs_mosquitto
@pytest.mark.parametrize("count", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_a_tracker_on_postgresql_killed_at_random_moments(
    tmp_path: Path, postgresql: Server, count: int
) -> None:
    holds(kills.killed_tracker(tmp_path, 1, count, postgresql.url(postgresql.database())))


@needs_mosquitto
@pytest.mark.slow
@pytest.mark.parametrize("in_postgresql", [False, True])
def test_a_tracker_of_all_sources_killed_at_random_moments(
    tmp_path: Path, postgresql: Server, in_postgresql: bool
) -> None:
    found = together.killed_together(tmp_path, 1, postgresql, 50, in_postgresql, 2.0)
    holds(found)
    assert found.blows == 50


@needs_mosquitto
@pytest.mark.slow
def test_a_broker_killed_while_messages_flow(tmp_path: Path) -> None:
    holds(kills.killed_broker(tmp_path, seed=1, kills=5))


@pytest.mark.slow
def test_an_opcua_server_killed_while_it_tells_values(tmp_path: Path) -> None:
    pytest.importorskip("asyncua", reason="asyncua is not installed: pip install 'hygrokf[test]'")
    holds(kills.killed_server(tmp_path, seed=1, kills=5))


@needs_mosquitto
@pytest.mark.slow
def test_postgresql_killed_while_messages_flow(tmp_path: Path, postgresql: Server) -> None:
    holds(kills.killed_database(tmp_path, 1, postgresql, kills=5))


# -- the disk, the store, the clock --------------------------------------------------------------------------
@needs_mosquitto
@pytest.mark.slow
def test_a_full_disk_and_a_kill_while_it_is_full(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    if not hasattr(resource, "prlimit"):
        pytest.skip("this system cannot limit the files of another process")
    found = disk.full_disk(tmp_path, seed=1, fillings=5)
    holds(found)
    assert found.blows == 10


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["beginning", "page", "cut", "another file"])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_tracker_refuses_a_damaged_store(tmp_path: Path, damage: str, seed: int) -> None:
    assert damage in disk.DAMAGES
    holds(disk.damaged_store(tmp_path, seed, damage))


@needs_mosquitto
def test_a_clock_that_jumps(tmp_path: Path) -> None:
    found = clock.jumping_clock(tmp_path, seed=1)
    holds(found)
    assert "messages held back until it was right" in found.words


# -- what comes in -------------------------------------------------------------------------------------------
@needs_mosquitto
@pytest.mark.parametrize("count", [1_000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_malformed_payloads_change_nothing_and_are_counted(tmp_path: Path, count: int) -> None:
    found = payloads.malformed(tmp_path, seed=1, count=count)
    holds(found)
    assert found.blows == count


def test_payloads_are_spoiled_in_every_way() -> None:
    found = payloads.spoiled(np.random.default_rng(1), 2_000, 1.6e9)
    assert {kind for kind, _ in found} == {kind for kind, _ in payloads.KINDS.values()}
    assert len({text for _, text in found}) > 1_500


def test_late_shuffled_and_repeated_messages(tmp_path: Path) -> None:
    found = flood.flood(tmp_path, seed=1, count=9_000, turbines=5)
    holds(found)
    assert found.messages > 8_000


@needs_mosquitto
@pytest.mark.slow
def test_a_million_messages_in_flat_memory(tmp_path: Path) -> None:
    if not Path("/proc/self/status").exists():
        pytest.skip("this system does not say how much memory another process holds")
    found = flood.flood(tmp_path, seed=1, count=1_000_000, through="broker")
    holds(found)
    assert found.messages > 1_000_000 and " MB after that" in found.words


# -- the suite itself ----------------------------------------------------------------------------------------
def test_a_reading_that_is_missing_or_doubled_is_found(tmp_path: Path) -> None:
    """A suite that finds nothing must be one that would."""
    plant = Plant(tmp_path, days=2.0)
    store = f"sqlite:{tmp_path / 'live.db'}"
    lines = [payload + b"\n" for _, payload in plant.messages()]
    file = tmp_path / "messages.ndjson"
    config = plant.config('[[source]]\nurl = "file:messages.ndjson"\nfollow = false', store)

    def judged(written: list[bytes]):
        (tmp_path / "live.db").unlink(missing_ok=True)
        file.write_bytes(b"".join(written))
        with Tracker(config, "--until-ended") as one:
            one.ended()
        return plant.judged(0, len(lines), store)

    lost = judged(lines[:100] + lines[103:])
    assert (lost.missing, lost.doubled, lost.equal, lost.held) == (3, 0, False, False)
    another = json.loads(lines[50]) | {"time": json.loads(lines[50])["time"] + 1.0}
    more = judged([*lines[:51], json.dumps(another).encode() + b"\n", *lines[51:]])
    assert (more.missing, more.doubled, more.equal) == (0, 1, False)


def test_what_does_not_hold_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys) -> None:
    def run(folder: Path, seed: int, amount: int) -> Outcome:
        return Outcome(amount, 2_000, missing=int(seed == 2), words="a note")

    monkeypatch.setitem(suite.SCENARIOS, "tracker", (run, 40))
    assert frame.main(["faults", "tracker", "--seeds", "1:3", "--out", str(tmp_path / "lines.jsonl")]) == 1
    printed = capsys.readouterr().out
    assert "| tracker | 1 | 40 | 2,000 | 0 | 0 | equal | yes |" in printed
    assert "| tracker | 2 | 40 | 2,000 | 1 | 0 | equal | NO |" in printed
    assert "tracker, seed 1: a note" in printed
    assert suite.one("tracker", 1, amount=4)["blows"] == 4
