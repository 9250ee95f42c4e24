"""Wrong clocks: readings that are ahead of this machine's clock are held and released; none is lost."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from builders.live_case import count_of, expect_offline, live_record
from builders.service_case import running
from builders.store_case import queried
from builders.waiting import eventually

from hygrokf.data.record import Record
from hygrokf.live import service
from hygrokf.live.batch import Alarm, Batch, Observation
from hygrokf.live.clock_levels import MACHINE, Ahead, clock_levels
from hygrokf.live.service import Service
from hygrokf.live.sources.local import TailedFile, record_mapping, record_messages
from hygrokf.live.sources.payload_values import STAMP_AHEAD_S
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.storage.store import Store, StoreFault, open_store
from hygrokf.live.tracker import Reading
from hygrokf.live.turbines import Fleet, Turbine
from hygrokf.texts.live_codes import AlarmCode

HOUR_S = 3600.0
YEAR_S = 365.25 * 24.0 * HOUR_S


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """A day of a turbine's record."""
    whole = live_record(tmp_path_factory.mktemp("record"), seed=6, days=2.0)
    return whole.window(whole.start_s, whole.start_s + 24.0 * HOUR_S)


class Run:
    """A fleet of one turbine and its store, fed with a record's messages by a clock that may be wrong."""

    def __init__(self, url: str, record: Record, turbine: Turbine) -> None:
        self.turbine, self.record = turbine, record
        self.store: Store = open_store(url)
        self.fleet = Fleet.from_store({"T1": turbine}, self.store)
        self.mapping = record_mapping(record, "T1")
        self.alarms: list[Alarm] = []
        self.most_held = 0

    def commit(self, batch: Batch) -> None:
        self.store.commit(batch)
        self.alarms += batch.alarms

    def restart(self) -> None:
        self.store.close()
        self.store = open_store(self.store.url)
        self.fleet = Fleet.from_store({"T1": self.turbine}, self.store)

    def play(self, wrong_s: Callable[[float], float], restarts: int = 3) -> None:
        """Feed all messages, at their times plus what the clock is wrong by at a share of them [s]."""
        rows = record_messages(self.record, "T1")
        for number, first in enumerate(range(0, len(rows), 24)):
            part = rows[first : first + 24]
            now = part[-1][0] + 2.0 + wrong_s(first / len(rows))
            self.commit(
                self.fleet.round([Delivery(json.dumps(content), now) for _, content in part], self.mapping)
            )
            self.commit(self.fleet.tick(now, {}))
            self.most_held = max(self.most_held, self.store.held_count("T1"))
            if number % (len(rows) // 24 // (restarts + 1)) == 5:
                self.restart()

    def recover(self, now: float) -> None:
        """The clock is right, or has caught up."""
        self.commit(self.fleet.tick(now, {}))
        self.commit(self.fleet.filter_waiting(Batch()))
        assert self.store.held_count("T1") == 0
        expect_offline(self.store.url, self.record, self.turbine)
        self.store.close()


@pytest.mark.parametrize(
    ("wrong_s", "held"),
    [
        (lambda share: -1200.0, True),
        (lambda share: 1200.0, False),
        (lambda share: -10.0 * YEAR_S, True),
        (lambda share: -HOUR_S if 0.4 < share < 0.6 else 0.0, True),
        (lambda share: -10.0 * YEAR_S if share < 0.5 else 0.0, True),
        (lambda share: 300.0 * 24 * HOUR_S if 0.3 < share < 0.6 else 0.0, False),
    ],
    ids=["slow", "fast", "ten years", "set back an hour", "set right", "jump forward"],
)
def test_no_clock_of_this_machine_loses_a_reading(
    tmp_path: Path, record: Record, turbine: Turbine, wrong_s: Callable[[float], float], held: bool
) -> None:
    run = Run(f"sqlite:{tmp_path / 'live.db'}", record, turbine)
    run.play(wrong_s)
    assert (run.most_held > 0) == held
    (stored,) = queried(run.store, "SELECT COUNT(*) FROM observation")[0]
    assert stored + run.store.held_count("T1") == count_of(record)
    assert run.store.counters() == {}
    assert any(one.kind == "clock wrong" for one in run.alarms) == held
    run.recover(record.end_s + 10.0)


def test_a_clock_that_is_set_right_ends_its_alarm(store_url: str, record: Record, turbine: Turbine) -> None:
    run = Run(store_url, record, turbine)
    run.play(lambda share: -2.0 * HOUR_S if share < 0.5 else 0.0, restarts=1)
    begun, *_, ended = (one for one in run.alarms if one.kind == "clock wrong")
    assert begun.severity == "alarm" and begun.ended is None and "2 h ahead" in begun.statement
    assert ended.id == begun.id and ended.ended is not None
    run.recover(record.end_s + 10.0)


def test_stamps_of_the_next_century_fill_no_disk(
    tmp_path: Path, record: Record, turbine: Turbine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hygrokf.live.clock_levels.HELD_MOST", 30)
    run = Run(f"sqlite:{tmp_path / 'live.db'}", record, turbine)
    now, far = record.end_s, 4.07e9

    def told(at: float, count: int) -> None:
        deliveries = [
            Delivery(json.dumps({"turbine": "T1", "time": at + i, "cabinet_temperature": 300.0}), now)
            for i in range(count)
        ]
        run.commit(run.fleet.round(deliveries, run.mapping))

    told(far, 20)
    told(far + 1000.0, 20)
    assert run.store.held_count("T1") == 30 and run.store.counters() == {("T1", "too many ahead"): 10}
    told(now, 5)  # what is right goes on
    assert run.store.size()["observation"] == 5
    told(4.2e9, 1)
    assert run.store.counters()["", "impossible time"] == 1
    run.store.close()


def test_a_service_whose_clock_is_set_right(
    tmp_path: Path, record: Record, turbine: Turbine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock is half a day behind; a file is followed meanwhile, the tracker is restarted, and the clock
    set right while the tracker runs."""
    monkeypatch.setattr(service, "TICK_S", 0.05)
    rows = [json.dumps(content) for _, content in record_messages(record, "T1")]
    path, url = tmp_path / "live.ndjson", f"sqlite:{tmp_path / 'live.db'}"
    path.write_text("".join(row + "\n" for row in rows))
    now = [record.end_s - 12.0 * HOUR_S]

    def tracker() -> Service:
        file = TailedFile(path, record_mapping(record, "T1"), clock=lambda: now[0])
        return Service({"T1": turbine}, [file], url, clock=lambda: now[0])

    def held(store: Store) -> int:
        return store.held_count("T1")

    with running(tracker()):
        eventually(lambda: taken(url) == len(rows))
    store = open_store(url)
    assert 0.3 * len(rows) < held(store) < 0.7 * len(rows)
    assert store.point("T1").time <= now[0] + STAMP_AHEAD_S
    with running(tracker()):
        now[0] = record.end_s + 10.0
        eventually(lambda: held(store) == 0)
    store.close()
    expect_offline(url, record, turbine)


def taken(url: str) -> int:
    """How many readings a store holds, held ones included."""
    try:
        store = open_store(url, read_only=True)
    except StoreFault:  # the tracker has not made it yet
        return 0
    count = queried(store, "SELECT COUNT(*) FROM observation")[0][0] + store.held_count("T1")
    store.close()
    return count


def ahead(turbine: str, by_s: float, signal: str = "cabinet_temperature") -> list[Observation]:
    return [Observation(turbine, Reading(signal, 1e9 + by_s, 300.0), 1e9)]


def test_whose_clock_is_wrong() -> None:
    assert clock_levels({"A": 0.0, "B": 0.0}) == {"A": [], "B": [], MACHINE: []}
    alone = clock_levels({"A": 0.0, "B": 7200.0, "C": 0.0})
    assert [name for name, levels in alone.items() if levels] == ["B"]
    assert alone["B"][0].statements == (AlarmCode.SENDER_CLOCK_FAST(ahead=7200.0),)
    shared = clock_levels({"A": 7200.0, "B": 7150.0, "C": 7260.0, "D": 90000.0})
    assert [name for name, levels in shared.items() if levels] == ["D", MACHINE]
    assert shared[MACHINE][0].statements == (AlarmCode.MACHINE_CLOCK_SLOW(count=3, of=4, ahead=7200.0),)
    (only,) = clock_levels({"A": 10.0 * YEAR_S})["A"]
    assert only.statements[0].code is AlarmCode.SENDER_OR_MACHINE_CLOCK
    assert "10.0 years ahead" in only.statements[0].text


def test_the_newest_reading_tells_the_clock() -> None:
    found = Ahead(None)
    found.note("B", ahead("B", 9e9))
    found.note("A", ahead("A", 7200.0))
    found.note("A", ahead("A", 0.0, "ambient_temperature"))
    assert found.by_turbine() == {"A": 7200.0, "B": 9e9}
    found.note("A", ahead("A", STAMP_AHEAD_S))
    found.note("B", ahead("B", -30.0))
    assert found.by_turbine() == {"A": 0.0, "B": 0.0}
