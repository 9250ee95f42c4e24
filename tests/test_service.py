"""The loop: all that is delivered is committed once, also when the store fails and when it is told to end."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hygrokf.case import read_case
from hygrokf.design import CASCADE, design, merged
from hygrokf.fit import Fit
from hygrokf.live import service as module
from hygrokf.live.fleet import Delivery, Turbine
from hygrokf.live.payload import Field, Mapping
from hygrokf.live.plan import Form, plan
from hygrokf.live.service import Service
from hygrokf.live.store import StoreFault, open_store
from hygrokf.live.streams import Playback
from hygrokf.live.tracker import whole
from hygrokf.record import Record
from hygrokf.synthetic import synthetic_turbine, write_case

UNITS = {"cabinet_temperature": "K", "ambient_temperature": "K", "active_power": "W"}
FRACTIONS = ("cabinet_relative_humidity", "ambient_relative_humidity", "preheating")


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """Three days of the synthetic turbine, with the signals that its model reads."""
    made = read_case(write_case(synthetic_turbine(seed=7, days=3.0), tmp_path_factory.mktemp("turbine")))
    return replace(made, series=tuple(s for s in made.series if s.signal in UNITS or s.signal in FRACTIONS))


@pytest.fixture(scope="module")
def turbine(record: Record) -> Turbine:
    base = merged([design(record, kind="thermal"), design(record, kind=CASCADE)])
    fit = Fit(record.name, base, {p.name: p.start for p in base.model.parameters}, {})
    forms = {s.signal: Form(s.hold, s.interval_s) for s in record.series}
    return Turbine(plan(fit, forms=forms, site=record.site, rated_power_W=record.rated_power_W))


@pytest.fixture(scope="module")
def mapping(record: Record) -> Mapping:
    fields = {
        s.signal: Field(s.signal, UNITS.get(s.signal, "1"), Form(s.hold, s.interval_s)) for s in record.series
    }
    return Mapping(fields, turbines={"T1": "T1"})


class Acknowledging(Playback):
    """A playback that remembers what it was told."""

    def __init__(self, *arguments: object, **options: object) -> None:
        super().__init__(*arguments, **options)
        self.acknowledged: list[str] = []

    def acknowledge(self, deliveries: Iterable[Delivery]) -> None:
        self.acknowledged += [one.place for one in deliveries]


def check(path: Path, record: Record, turbine: Turbine, count: int) -> None:
    store = open_store(f"sqlite:{path}")
    offline = whole(turbine.plan, record)
    assert store.size()["observation"] == count
    point = store.point("T1")
    last = int(np.searchsorted(offline.seconds, point.time + 1e-3, side="right")) - 1
    assert np.array_equal(point.state.mean, offline.trace.mean[last])
    assert np.array_equal(point.state.covariance, offline.trace.covariance[last])
    store.close()


def test_a_late_and_repeated_playback_ends_in_the_offline_filter(
    tmp_path: Path, record: Record, turbine: Turbine, mapping: Mapping
) -> None:
    stream = Acknowledging(record, "T1", late_s=1500.0, repeated=0.1, seed=1)
    path = tmp_path / "live.db"
    settled: list = []
    service = Service({"T1": turbine}, mapping, [stream], f"sqlite:{path}", settled.append)
    service.run(until_ended=True)
    assert stream.acknowledged == [str(n + 1) for n in range(len(stream))]
    assert service.health.deliveries == len(stream) and len(settled) == service.health.rounds
    check(path, record, turbine, sum(int((~s.missing).sum()) for s in record.series))


def test_a_store_that_fails_is_opened_anew_and_nothing_is_lost(
    tmp_path: Path, record: Record, turbine: Turbine, mapping: Mapping, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk at a commit, twice a store that cannot be opened, then all is well."""
    monkeypatch.setattr(module, "RETRY_S", (0.01,))
    monkeypatch.setattr(module, "MOST", 100)
    stream, path = Acknowledging(record, "T1"), tmp_path / "live.db"
    service = Service({"T1": turbine}, mapping, [stream], f"sqlite:{path}")
    faults = iter(["commit", "open", "open", "", "", "commit", "", ""] + [""] * 10_000)
    real_open, fails = module.open_store, {"open": False}

    def opening(url: str):
        if fails["open"]:
            fails["open"] = next(faults) == "open"
            if fails["open"]:
                raise StoreFault("not reached")
        store = real_open(url)
        real_commit = store.commit

        def commit(batch):
            if next(faults) == "commit":
                fails["open"] = True
                raise sqlite3.OperationalError("database or disk is full")
            real_commit(batch)

        store.commit = commit
        return store

    monkeypatch.setattr(module, "open_store", opening)
    service.run(until_ended=True)
    assert service.health.failures == 2 and service.health.store == ""
    assert stream.acknowledged == [str(n + 1) for n in range(len(stream))]
    check(path, record, turbine, len(stream))


def test_told_to_end_it_commits_what_was_delivered_and_goes_on_later(
    tmp_path: Path, record: Record, turbine: Turbine, mapping: Mapping
) -> None:
    path = tmp_path / "live.db"
    first = Acknowledging(record, "T1", speed=400_000.0)
    service = Service({"T1": turbine}, mapping, [first], f"sqlite:{path}")
    runner = threading.Thread(target=service.run)
    runner.start()
    end = time.monotonic() + 20.0
    while service.health.deliveries < 150 and time.monotonic() < end:
        time.sleep(0.01)
    service.stop()
    runner.join(timeout=20.0)
    assert not runner.is_alive() and first.state[0] == "stopped"
    done = service.health.deliveries
    assert 150 <= done < len(first) and len(first.acknowledged) == done
    second = Acknowledging(record, "T1")
    Service({"T1": turbine}, mapping, [second], f"sqlite:{path}").run(until_ended=True)
    assert second.acknowledged[0] == str(done + 1)
    check(path, record, turbine, len(first))


def test_a_store_that_cannot_be_opened_at_the_start_is_told(
    tmp_path: Path, turbine: Turbine, mapping: Mapping
) -> None:
    service = Service({"T1": turbine}, mapping, [], f"sqlite:{tmp_path / 'none' / 'x.db'}")
    with pytest.raises(StoreFault, match="does not exist"):
        service.run()
