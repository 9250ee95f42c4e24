"""The loop: all that is delivered is committed once, also when the store fails and when it is told to end."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest
from builders.live_case import expect_offline
from builders.service_case import Acknowledging, in_small_rounds, running, with_every_store
from builders.store_case import queried
from builders.waiting import eventually

from hygrokf.data.record import Record
from hygrokf.live import service as module
from hygrokf.live.batch import Batch
from hygrokf.live.service import Service
from hygrokf.live.sources.local import record_messages
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.storage import database
from hygrokf.live.storage.store import Store, StoreFault, open_store
from hygrokf.live.turbines import Turbine


def test_a_late_and_repeated_playback_ends_in_the_offline_filter(
    store_url: str, record: Record, turbine: Turbine
) -> None:
    stream = Acknowledging(record, late_s=1500.0, repeated=0.1, seed=1)
    settled: list = []
    service = Service({"T1": turbine}, [stream], store_url, settled.append)
    service.run(until_ended=True)
    stream.expect_acknowledged()
    assert service.health.deliveries == len(stream.messages)
    # by its place, as what came in a round may all be repeated
    assert sum(bool(one.place) for one in settled) == service.health.rounds
    expect_offline(store_url, record, turbine)


def test_a_store_that_fails_is_opened_anew_and_nothing_is_lost(
    tmp_path: Path, record: Record, turbine: Turbine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk at a commit, twice a store that cannot be opened, then all is well."""
    in_small_rounds(monkeypatch, 100)
    stream, path = Acknowledging(record), tmp_path / "live.db"
    service = Service({"T1": turbine}, [stream], f"sqlite:{path}")
    faults = iter(["commit", "open", "open", "", "", "commit", "", ""] + [""] * 10_000)
    fails = {"open": False}

    def change(store: Store) -> None:
        if fails["open"]:
            fails["open"] = next(faults) == "open"
            if fails["open"]:
                raise StoreFault("not reached")
        real_commit = store.commit

        def commit(batch: Batch) -> None:
            if next(faults) == "commit":
                fails["open"] = True
                raise StoreFault("database or disk is full")
            real_commit(batch)

        store.commit = commit

    with_every_store(monkeypatch, change)
    service.run(until_ended=True)
    assert service.health.failures == 2 and service.health.store == ""
    stream.expect_acknowledged()
    expect_offline(f"sqlite:{path}", record, turbine)


def test_told_to_end_it_commits_what_was_delivered_and_goes_on_later(
    tmp_path: Path, record: Record, turbine: Turbine
) -> None:
    path = tmp_path / "live.db"
    first = Acknowledging(record, speed=400_000.0, halts=(0.8,))
    service = Service({"T1": turbine}, [first], f"sqlite:{path}")
    with running(service):
        eventually(lambda: service.health.deliveries >= 150)
    assert first.state[0] == "stopped"
    done = service.health.deliveries
    assert 150 <= done < len(first.messages) and len(first.acknowledged) == done
    second = Acknowledging(record)
    Service({"T1": turbine}, [second], f"sqlite:{path}").run(until_ended=True)
    assert second.acknowledged[0] == str(done + 1)
    expect_offline(f"sqlite:{path}", record, turbine)


def test_a_store_that_cannot_be_opened_at_the_start_is_told(tmp_path: Path, turbine: Turbine) -> None:
    service = Service({"T1": turbine}, [], f"sqlite:{tmp_path / 'none' / 'x.db'}")
    with pytest.raises(StoreFault, match="does not exist"):
        service.run()


def test_a_commit_whose_answer_was_lost_is_not_made_again(
    store_url: str, record: Record, turbine: Turbine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The batch is in the store, and the loop hears of a lost connection: counts must not grow twice."""
    in_small_rounds(monkeypatch, 300)
    plain = [*record_messages(record, "T1")]
    rubbish = [(at, {"turbine": "unknown", "time": at}) for at, _ in plain[::10]]
    stream = Acknowledging(record)
    stream.messages = sorted([*plain, *rubbish], key=lambda one: one[0])
    service = Service({"T1": turbine}, [stream], store_url)
    lost = []

    def change(store: Store) -> None:
        real_commit = store.commit

        def commit(batch: Batch) -> None:
            real_commit(batch)
            if batch.observations and len(lost) < 3:
                lost.append(len(batch.observations))
                raise StoreFault("the connection was lost")

        store.commit = commit

    with_every_store(monkeypatch, change)
    service.run(until_ended=True)
    assert len(lost) == 3 and all(lost) and service.health.failures == 3
    stream.expect_acknowledged()
    store = open_store(store_url)
    assert store.counters() == {("", "unknown turbine"): len(rubbish)}
    store.close()
    expect_offline(store_url, record, turbine)


def test_a_mistake_of_its_own_ends_the_loop(store_url: str, record: Record, turbine: Turbine) -> None:
    """A statement that can never succeed is not tried for ever."""
    stream = Acknowledging(record)
    service = Service({"T1": turbine}, [stream], store_url)
    store = open_store(store_url)
    errors = store.database.errors
    with store.transaction():
        queried(store, "DROP VIEW observation_hourly")
        queried(store, "ALTER TABLE observation RENAME COLUMN received TO seen")
    with pytest.raises(errors, match="received"):
        service.run(until_ended=True)
    assert stream.acknowledged == [] and service.health.failures == 0
    assert store.size()["observation"] == 0
    store.close()


def test_told_to_end_while_the_store_is_away_it_ends(
    tmp_path: Path, record: Record, turbine: Turbine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was not committed was not acknowledged either: the next tracker gets it again."""
    path = tmp_path / "live.db"
    first = Acknowledging(record, speed=400_000.0, halts=(0.5,))
    service = Service({"T1": turbine}, [first], f"sqlite:{path}")
    faults: list[BaseException] = []

    def run() -> None:
        try:
            service.run()
        except StoreFault as fault:
            faults.append(fault)

    runner = threading.Thread(target=run)
    runner.start()
    eventually(lambda: service.health.deliveries >= 150)
    real_open = module.open_store

    def refusing(url: str):
        raise StoreFault("not reached")

    def failing(batch):  # in the thread that owns the connection: every write fails from here on
        store.database.connection.execute("PRAGMA query_only = on")
        real_commit(batch)

    store = service.store
    real_commit = store.commit
    monkeypatch.setattr(module, "open_store", refusing)
    store.commit = failing
    first.go_on()
    eventually(lambda: service.health.failures)
    service.stop()
    runner.join(timeout=60.0)
    assert not runner.is_alive() and "not reached" in str(faults[0])
    done = len(first.acknowledged)
    monkeypatch.setattr(module, "open_store", real_open)
    second = Acknowledging(record)
    Service({"T1": turbine}, [second], f"sqlite:{path}").run(until_ended=True)
    assert second.acknowledged[0] == str(done + 1)
    expect_offline(f"sqlite:{path}", record, turbine)


def test_a_second_tracker_of_a_turbine_is_refused(
    store_url: str, record: Record, turbine: Turbine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(database, "CLAIM_S", 0.2)
    first = Acknowledging(record, speed=400_000.0)
    service = Service({"T1": turbine}, [first], store_url)
    with running(service):
        eventually(lambda: service.health.deliveries > 100)
        second = Acknowledging(record)
        with pytest.raises(StoreFault, match=f"turbine T1 .* by process {os.getpid()} on "):
            Service({"T1": turbine}, [second], store_url).run(until_ended=True)
        assert second.state == ("idle", "not started")
    Service({"T1": turbine}, [Acknowledging(record)], store_url).run(until_ended=True)
    expect_offline(store_url, record, turbine)


@pytest.mark.parametrize(("behind", "share"), [(False, module.FORECAST_SHARE), (True, module.BUSY_SHARE)])
def test_forecasts_give_way_while_anything_waits(
    behind: bool,
    share: float,
    tmp_path: Path,
    record: Record,
    turbine: Turbine,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, spent = [1000.0], [0.0]

    def forecast(*_: object) -> None:
        now[0] += 0.5
        spent[0] += 0.5

    stream = Acknowledging(record)
    service = Service({"T1": turbine}, [stream], f"sqlite:{tmp_path / 'live.db'}")
    service._open()
    first: list[Delivery] = []
    stream.start(None, lambda one: first.append(one))
    eventually(lambda: stream.state[0] == "ended")
    for one in first[:500]:
        service._put(stream.url, one)
    while service.round():
        pass
    assert service.fleet.forecast_due(module.FORECAST_EVERY_S) == "T1"
    if behind:
        service._put(stream.url, first[500])
    try:
        with monkeypatch.context() as patched:
            patched.setattr(module, "make_forecast", forecast)
            patched.setattr(module.time, "monotonic", lambda: now[0])
            for _ in range(8_000):
                now[0] += 0.05
                service._work_between_rounds(idle=False)
    finally:
        stream.stop()
        service.store.close()
    assert spent[0] / (now[0] - 1000.0) == pytest.approx(share, rel=0.05)
