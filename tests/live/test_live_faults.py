"""A live tracker that is killed, starved and fed with rubbish: `scripts/live_faults` in small, in full with
the slow marker.

Afterwards every time: no acknowledged observation is missing, none is there twice, the state is the offline
filter's. What is done to single parts stands in their own tests (test_mqtt, test_opcua, test_postgres,
test_sqlite, test_service).
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from builders.brokers import needs_mosquitto
from builders.databases import Server

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.fixture(scope="module")
def part() -> Iterator:
    """`part("kills")` -> that module of the suite."""
    sys.path.insert(0, str(SCRIPTS))
    yield lambda name: importlib.import_module(f"faults.{name}")
    sys.path.remove(str(SCRIPTS))


@pytest.fixture(scope="module")
def kills(part) -> ModuleType:
    return part("kills")


def holds(outcome) -> None:
    assert outcome.held, outcome
    assert outcome.messages > 0 and outcome.missing == outcome.doubled == 0


# -- kill -9 -------------------------------------------------------------------------------------------------
@needs_mosquitto
@pytest.mark.parametrize("count", [2, pytest.param(40, marks=pytest.mark.slow)])
def test_a_tracker_killed_at_random_moments(tmp_path: Path, kills: ModuleType, count: int) -> None:
    found = kills.killed_tracker(tmp_path, seed=2, kills=count)
    holds(found)
    assert found.blows == count


@needs_mosquitto
@pytest.mark.parametrize("count", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_a_tracker_on_postgresql_killed_at_random_moments(
    tmp_path: Path, kills: ModuleType, postgresql: Server, count: int
) -> None:
    holds(kills.killed_tracker(tmp_path, 1, count, postgresql.url(postgresql.database())))


@needs_mosquitto
@pytest.mark.parametrize(
    ("count", "in_postgresql", "days"),
    [
        pytest.param(4, False, 2.0, marks=pytest.mark.slow),
        pytest.param(50, False, 2.0, marks=pytest.mark.slow),
        pytest.param(50, True, 2.0, marks=pytest.mark.slow),
    ],
)
def test_a_tracker_of_all_sources_killed_at_random_moments(
    tmp_path: Path, part, postgresql: Server, count: int, in_postgresql: bool, days: float
) -> None:
    found = part("together").killed_together(tmp_path, 1, postgresql, count, in_postgresql, days)
    holds(found)
    assert found.blows == count


@needs_mosquitto
@pytest.mark.slow
def test_a_broker_killed_while_messages_flow(tmp_path: Path, kills: ModuleType) -> None:
    holds(kills.killed_broker(tmp_path, seed=1, kills=5))


@pytest.mark.slow
def test_an_opcua_server_killed_while_it_tells_values(tmp_path: Path, kills: ModuleType) -> None:
    pytest.importorskip("asyncua", reason="asyncua is not installed: pip install 'hygrokf[test]'")
    holds(kills.killed_server(tmp_path, seed=1, kills=5))


@needs_mosquitto
@pytest.mark.slow
def test_postgresql_killed_while_messages_flow(tmp_path: Path, kills: ModuleType, postgresql: Server) -> None:
    holds(kills.killed_database(tmp_path, 1, postgresql, kills=5))


# -- the disk, the store, the clock --------------------------------------------------------------------------
@needs_mosquitto
@pytest.mark.slow
def test_a_full_disk_and_a_kill_while_it_is_full(tmp_path: Path, part) -> None:
    resource = pytest.importorskip("resource")
    if not hasattr(resource, "prlimit"):
        pytest.skip("this system cannot limit the files of another process")
    found = part("disk").full_disk(tmp_path, seed=1, fillings=5)
    holds(found)
    assert found.blows == 10


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["beginning", "page", "cut", "another file"])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_tracker_refuses_a_damaged_store(tmp_path: Path, part, damage: str, seed: int) -> None:
    assert damage in part("disk").DAMAGES
    holds(part("disk").damaged_store(tmp_path, seed, damage))


@needs_mosquitto
def test_a_clock_that_jumps(tmp_path: Path, part) -> None:
    found = part("clock").jumping_clock(tmp_path, seed=1)
    holds(found)
    assert "messages held back until it was right" in found.words


# -- what comes in -------------------------------------------------------------------------------------------
@needs_mosquitto
@pytest.mark.parametrize("count", [1_000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_malformed_payloads_change_nothing_and_are_counted(tmp_path: Path, part, count: int) -> None:
    found = part("payloads").malformed(tmp_path, seed=1, count=count)
    holds(found)
    assert found.blows == count


def test_payloads_are_spoiled_in_every_way(part) -> None:
    payloads = part("payloads")
    found = payloads.spoiled(np.random.default_rng(1), 2_000, 1.6e9)
    assert {kind for kind, _ in found} == {kind for kind, _ in payloads.KINDS.values()}
    assert len({text for _, text in found}) > 1_500


def test_late_shuffled_and_repeated_messages(tmp_path: Path, part) -> None:
    found = part("flood").flood(tmp_path, seed=1, count=50_000)
    holds(found)
    assert found.messages > 50_000


@needs_mosquitto
@pytest.mark.slow
def test_a_million_messages_in_flat_memory(tmp_path: Path, part) -> None:
    flood = part("flood")
    if not Path("/proc/self/status").exists():
        pytest.skip("this system does not say how much memory another process holds")
    found = flood.flood(tmp_path, seed=1, count=1_000_000, through="broker")
    holds(found)
    assert found.messages > 1_000_000 and " MB after that" in found.words


# -- the suite itself ----------------------------------------------------------------------------------------
def test_a_reading_that_is_missing_or_doubled_is_found(tmp_path: Path, part) -> None:
    """A suite that finds nothing must be one that would."""
    plant = part("plant").Plant(tmp_path, days=2.0)
    store = f"sqlite:{tmp_path / 'live.db'}"
    lines = [payload + b"\n" for _, payload in plant.messages()]
    file, tracker = tmp_path / "messages.ndjson", part("tracker").Tracker
    config = plant.config('[[source]]\nurl = "file:messages.ndjson"\nfollow = false', store)

    def judged(written: list[bytes]):
        (tmp_path / "live.db").unlink(missing_ok=True)
        file.write_bytes(b"".join(written))
        with tracker(config, "--until-ended") as one:
            one.ended()
        return plant.judged("mine", 1, 0, len(lines), store)

    holds(judged(lines))
    lost = judged(lines[:100] + lines[103:])
    assert (lost.missing, lost.doubled, lost.equal, lost.held) == (3, 0, False, False)
    another = json.loads(lines[50]) | {"time": json.loads(lines[50])["time"] + 1.0}
    more = judged([*lines[:51], json.dumps(another).encode() + b"\n", *lines[51:]])
    assert (more.missing, more.doubled, more.equal) == (0, 1, False)


def test_the_command_prints_a_table_or_json(part, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    command, outcome = part("command"), part("outcome").Outcome
    asked = []

    def run(name: str, seed: int, amount: int):
        asked.append((name, seed, amount))
        return outcome(name, seed, amount, 2_000, missing=int(seed == 2), words="a note")

    monkeypatch.setattr(command, "run", run)
    assert command.main(["tracker", "flood"]) == 0
    printed = capsys.readouterr().out
    assert "tracker" in printed and "50,000" in printed and "a note" in printed and "NO" not in printed
    assert command.main(["tracker", "--thorough", "--seeds", "2", "--json"]) == 1
    printed = capsys.readouterr()
    assert [row["held"] for row in json.loads(printed.out)] == [True, False]
    assert "tracker, seed 2: does not hold" in printed.err
    assert asked == [("tracker", 1, 4), ("flood", 1, 50_000), ("tracker", 1, 40), ("tracker", 2, 40)]
    with pytest.raises(SystemExit) as ended:
        command.main(["nothing"])
    assert ended.value.code == 2 and "there are tracker" in capsys.readouterr().err


def test_what_does_not_happen_in_time_does_not_hold(part, monkeypatch: pytest.MonkeyPatch) -> None:
    command = part("command")

    def never(folder: Path, seed: int, amount: int):
        raise AssertionError("it did not happen: all it said")

    monkeypatch.setitem(command.SCENARIOS, "tracker", command.Scenario(never, 1, 1, "kills"))
    found = command.run("tracker", 3, 1)
    assert (found.seed, found.held) == (3, False) and "all it said" in found.fault
