"""Sparkplug B on a broker of its own, from an edge node of another make: births, gaps, deaths, restarts."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from builders import service_case
from builders.brokers import Mosquitto, mosquitto, needs_mosquitto, overheard, peer
from builders.live_case import count_of, expect_offline, live_record, without_preheating
from builders.sparkplug_peer import DOUBLE, EdgeNode, metric
from builders.store_case import queried
from builders.waiting import eventually

from hygrokf.data.record import Record
from hygrokf.live.service import Service
from hygrokf.live.sources import sparkplug, sparkplug_node
from hygrokf.live.sources import stream as streams
from hygrokf.live.sources.broker import Broker
from hygrokf.live.sources.local import record_mapping, record_messages
from hygrokf.live.sources.sparkplug import Sparkplug
from hygrokf.live.storage.store import open_store
from hygrokf.live.turbines import SOURCE, Turbine

pytestmark = needs_mosquitto

SIGNAL = "cabinet_temperature"


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "SOURCE_BACK_OFF_S", (0.05, 0.2))
    monkeypatch.setattr(sparkplug, "CHECK_INTERVAL_S", 0.05)
    monkeypatch.setattr(sparkplug_node, "REORDER_S", 0.2)


@contextmanager
def a_broker(folder: Path, *settings: str) -> Iterator[Mosquitto]:
    folder.mkdir()
    with mosquitto(folder, "allow_anonymous true", *settings) as made:
        yield made


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    with a_broker(tmp_path / "broker") as made:
        yield made


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return without_preheating(live_record(tmp_path_factory.mktemp("turbine"), seed=7, days=3.0))


@pytest.fixture(scope="module")
def values(record: Record) -> list[tuple[float, str, float]]:
    """(time [s], signal, value) of every reading."""
    return [
        (t, name, value)
        for t, content in record_messages(record, "T1")
        for name, value in content.items()
        if name not in ("turbine", "time")
    ]


def stream_of(found: Mosquitto, record: Record, rebirth_requests: bool = False) -> Sparkplug:
    mapping = replace(record_mapping(record, "T1"), turbine="{4}")
    session = Broker(
        f"mqtt://127.0.0.1:{found.port}",
        ("spBv1.0/Farm/#",),
        client_id="tracker",
        rebirth_requests=rebirth_requests,
    )
    return Sparkplug(session, mapping)


def edge_node(found: Mosquitto, record: Record, **how: object) -> EdgeNode:
    return EdgeNode(found, devices={"T1": {s.signal: DOUBLE for s in record.series}}, **how)


@contextmanager
def serving(turbine: Turbine, stream: Sparkplug, store: str) -> Iterator[Service]:
    service = Service({"T1": turbine}, [stream], store)
    with service_case.running(service):
        eventually(lambda: stream.state.word in ("connected", "lost"), lambda: stream.state)
        eventually(lambda: stream._link.answered)
        yield service


def in_store(url: str, question: str, *parameters: object) -> object:
    store = open_store(url)
    try:
        return queried(store, question, parameters)[0][0]
    finally:
        store.close()


def stored(url: str) -> int:
    return in_store(url, "SELECT COUNT(*) FROM observation")


def counted(url: str) -> dict[str, int]:
    store = open_store(url)
    try:
        return dict(queried(store, "SELECT name, count FROM counter WHERE turbine = ?", (SOURCE,)))
    finally:
        store.close()


def test_values_by_alias_end_in_the_offline_filter_across_a_restart(
    tmp_path: Path, record: Record, turbine: Turbine, values: list[tuple[float, str, float]]
) -> None:
    """The broker keeps what comes while the tracker is away; the aliases are those of births before."""
    store, half = f"sqlite:{tmp_path / 'live.db'}", len(values) // 2
    with a_broker(tmp_path / "broker", "queue_qos0_messages true") as broker:
        with edge_node(broker, record).connected() as node:
            with serving(turbine, stream_of(broker, record), store):
                node.bear()
                for t, name, value in values[:half]:
                    node.send("T1", {name: value}, t)
                eventually(lambda: stored(store) == half, lambda: (stored(store), half))
            for t, name, value in values[half:]:
                node.send("T1", {name: value}, t)
            with serving(turbine, stream_of(broker, record), store):
                eventually(lambda: stored(store) == count_of(record), lambda: counted(store))
            assert node.rebirths == 0
    assert set(counted(store)) <= {"no value"}
    expect_offline(store, record, turbine)


def test_a_gap_is_told_and_asks_for_a_rebirth_only_where_that_is_allowed(
    tmp_path: Path, broker: Mosquitto, record: Record, turbine: Turbine
) -> None:
    store, now = f"sqlite:{tmp_path / 'live.db'}", time.time()
    with edge_node(broker, record).connected() as node, peer(broker) as other:
        commands = overheard(other, "spBv1.0/Farm/NCMD/#")
        with serving(turbine, stream_of(broker, record), store):
            node.bear(now - 60.0)
            node.send("T1", {SIGNAL: 290.0}, now - 50.0)
            eventually(lambda: stored(store) == 1)
        # nobody keeps messages of QoS 0 while the tracker is away
        node.send("T1", {SIGNAL: 291.0}, now - 40.0)
        stream = stream_of(broker, record)
        with serving(turbine, stream, store):
            node.send("T1", {SIGNAL: 292.0}, now - 30.0)
            eventually(lambda: "Node Control/Rebirth" in stream.state.words, lambda: stream.state)
            assert "Farm/N1" in stream.state.words and "rebirth_requests" in stream.state.words
            assert stream.state.word == "connected"
            eventually(lambda: counted(store).get("held until birth") == 1)
        assert not commands and node.rebirths == 0
        stream = stream_of(broker, record, rebirth_requests=True)
        with serving(turbine, stream, store):
            node.send("T1", {SIGNAL: 293.0}, now - 20.0)
            eventually(lambda: node.rebirths == 1)
            # what was held is read once its alias is known to mean the same
            eventually(lambda: stored(store) == 2, lambda: counted(store))
            assert "rebirth" not in stream.state.words
            node.send("T1", {SIGNAL: 294.0}, now - 10.0)
            eventually(lambda: stored(store) == 3)
    assert node.rebirths == len(commands) == 1 and not commands[0].retain
    assert in_store(store, "SELECT MIN(value) FROM observation WHERE time > ?", now - 25.0) == 293.0


def test_a_broken_edge_node_is_told_until_it_is_born_again(
    tmp_path: Path, broker: Mosquitto, record: Record, turbine: Turbine
) -> None:
    store, now = f"sqlite:{tmp_path / 'live.db'}", time.time()
    stream = stream_of(broker, record)
    with serving(turbine, stream, store):
        with edge_node(broker, record).connected() as node:
            node.bear(now - 60.0, cabinet_temperature=290.0)
            eventually(lambda: stored(store) == 1)
            node.die()
            eventually(lambda: stream.state.word == "lost", lambda: stream.state)
        assert "Farm/N1/T1 since" in stream.state.words
        assert set(stream.left()) == {"T1"} and stream.left()["T1"].values["sender"] == "Farm/N1/T1"
        with edge_node(broker, record, bdseq=1, first_alias=50).connected() as node:
            node.bear(now - 30.0, cabinet_temperature=291.0)
            eventually(lambda: stored(store) == 2)
            node.send("T1", {SIGNAL: 292.0}, now - 20.0)
            eventually(lambda: stored(store) == 3)
            eventually(lambda: stream.state.word == "connected", lambda: stream.state)
            assert not stream.left()
            node.leave("T1")
            eventually(lambda: "Farm/N1/T1 since" in stream.state.words)
            assert set(stream.left()) == {"T1"}
        # another edge node takes its place
        with edge_node(broker, record, name="Farm/N2").connected() as node:
            node.bear(now - 10.0)
            eventually(lambda: not stream.left())
    assert counted(store)["death certificate"] >= 2


def test_metrics_of_an_edge_node_itself_are_of_no_turbine(broker: Mosquitto, record: Record) -> None:
    stream, taken = stream_of(broker, record), []
    stream.start(None, taken.append)
    try:
        eventually(lambda: stream.state.word == "connected")
        with EdgeNode(broker, devices={}).connected() as node:
            node.bear()
            node._publish("NDATA", "", [metric("Load", 1.0, DOUBLE, at=time.time())], time.time())
            eventually(lambda: len(taken) == 2)
    finally:
        stream.stop()
        stream.stop()
    assert [one.content.kind for one in taken][:2] == ["no value", "of no device"]


def test_a_historical_value_is_stored_at_its_time_and_is_not_the_latest(
    tmp_path: Path, broker: Mosquitto, record: Record, turbine: Turbine
) -> None:
    store, now = f"sqlite:{tmp_path / 'live.db'}", round(time.time())
    stream = stream_of(broker, record)
    with edge_node(broker, record).connected() as node, serving(turbine, stream, store) as service:
        node.bear(now - 60.0)
        node.send("T1", {SIGNAL: 290.0}, now - 30.0)
        node.send("T1", {SIGNAL: 280.0}, now - 600.0, is_historical=True)
        node.send("T1", {SIGNAL: 270.0}, now - 86_400.0, is_historical=True)
        eventually(lambda: stored(store) == 3)
        assert service.fleet.tracked["T1"].tracker.heard()[SIGNAL] == now - 30.0
    assert in_store(store, "SELECT value FROM observation ORDER BY time LIMIT 1") == 270.0
