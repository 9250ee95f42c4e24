"""OPC UA against a server that is there: nothing lost, nothing doubled, nothing written, and faults in
words."""

from __future__ import annotations

import asyncio
import json
import logging
import math
import re
import sys
import threading
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from builders.documents import document
from builders.live_case import expect_offline
from builders.ports import free_port
from builders.rejections import counted
from builders.stream_case import Collected
from builders.waiting import PATIENCE_S, eventually

from hygrokf.data.record import Record
from hygrokf.data.toml_form import Place, keys_of
from hygrokf.live.config import stream_of
from hygrokf.live.service import Service
from hygrokf.live.sources import opcua as module
from hygrokf.live.sources import opcua_client
from hygrokf.live.sources import stream as streams
from hygrokf.live.sources.local import record_mapping, record_messages
from hygrokf.live.sources.opcua import OpcUa
from hygrokf.live.sources.opcua_client import node_fault, sample_of
from hygrokf.live.sources.opcua_form import Node, Server
from hygrokf.live.sources.payload import Field, PayloadMapping
from hygrokf.live.sources.stream import BackOff, SourceFault, SourceKeys
from hygrokf.live.storage.store import open_store
from hygrokf.live.turbines import Turbine

pytest.importorskip("asyncua", reason="asyncua is not installed: pip install 'hygrokf[test]'")

from builders.opcua_peer import NAMESPACE, Peer

RECORD = {"seed": 7, "days": 2.0}
T0 = 1.7e9
GOOD, BAD, UNCERTAIN, OVERFLOWED = 0x00000000, 0x808C0000, 0x40900000, 0x00000480
RATES = {"sampling_s": 0.0, "publishing_s": 0.05, "queue": 5_000}


def server(url: str, nodes: list[Node], **stated: object) -> Server:
    return Server(url, {one.id: one for one in nodes}, **{**RATES, **stated})


MAPPING = PayloadMapping(
    {
        "Tcab": Field("cabinet_temperature", "degC"),
        "heat": Field("preheating", "1"),
        "T.env": Field("ambient_temperature", "degC"),
    },
    turbines={"plant/7": "T07", "T07": "T07"},
)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "SOURCE_BACK_OFF_S", (0.2, 0.4))


@pytest.fixture(scope="module")
def peer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Peer]:
    """A server without security, whose nodes each test adds for itself."""
    with Peer(tmp_path_factory.mktemp("peer")) as made:
        yield made.start()


@pytest.fixture
def named(request: pytest.FixtureRequest) -> Callable[[str], str]:
    """Node ids that no other test has."""
    return lambda name: f"ns=2;s={request.node.name}.{name}"


class Started:
    """A stream that runs until the test ends, and what it put."""

    def __init__(self, stream: OpcUa, place: str | None = None) -> None:
        self.stream, self.got = stream, Collected()
        stream.start(place, self.got)

    @property
    def contents(self) -> list[dict]:
        return [one.content for one in self.got.found]

    def values(self, field: str = "Tcab") -> list[tuple]:
        """(time after T0 [s], value) of good samples."""
        return [
            (c["time"] - T0, c[field])
            for c in self.contents
            if c["quality"] == "good" and c["time"] and field in c
        ]

    def wait(self, condition: Callable[[], object]) -> None:
        eventually(condition, lambda: (self.stream.state, self.contents))

    def place(self) -> dict[str, float]:
        return json.loads(next(one.place for one in reversed(self.got.found) if one.place))


@pytest.fixture
def started() -> Iterator[Callable[..., Started]]:
    running: list[Started] = []

    def start(url: str, nodes: dict[str, str], place: dict | None = None, **more: object) -> Started:
        rows = [Node(id, "T07", field) for id, field in nodes.items()]
        mapping = PayloadMapping(
            MAPPING.fields, quality="quality", use_uncertain=False, turbines={"T07": "T07"}
        )
        stated, faults = server(url, rows, **more), Place()
        made = OpcUa(stated, mapping, stated.security_from(faults))
        assert faults.faults == []
        running.append(Started(made, None if place is None else json.dumps(place)))
        return running[-1]

    yield start
    for one in running:
        one.stream.stop()
        assert one.stream.state[0] in ("stopped", "lost")


def at(*rows: tuple, node: str) -> list[tuple]:
    """Samples of a node, from (time after T0 [s], value) with a status code where it is not good."""
    return [(node, T0 + row[0], row[1], row[2] if len(row) > 2 else GOOD) for row in rows]


# -- the whole way to the filter -----------------------------------------------------------------------------
class Tracked:
    """A service on a turbine's nodes at a server, in a thread of its own."""

    def __init__(self, url: str, record: Record, turbine: Turbine, store: Path, prefix: str = "T1") -> None:
        mapping = record_mapping(record, "T1")
        plain = PayloadMapping(
            mapping.fields, quality="quality", use_uncertain=False, turbines=mapping.turbines
        )
        nodes = [Node(f"ns=2;s={prefix}.{name}", "T1", name) for name in mapping.fields]
        self.stream = OpcUa(server(url, nodes), plain)
        self.store = f"sqlite:{store}"
        self.service = Service({"T1": turbine}, [self.stream], self.store)
        self.thread = threading.Thread(target=self.service.run)

    def observed(self) -> int:
        found = open_store(self.store)
        count = found.size()["observation"]
        found.close()
        return count

    def wait(self, count: int) -> None:
        eventually(lambda: self.observed() >= count, lambda: (self.observed(), count, self.stream.state))

    def __enter__(self) -> Tracked:
        self.thread.start()
        eventually(lambda: self.stream.state[0] == "connected", lambda: self.stream.state)
        return self

    def __exit__(self, *_: object) -> None:
        self.service.stop()
        self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive() and self.stream.state[0] == "stopped"


def samples_of(record: Record, prefix: str = "T1") -> list[tuple]:
    """Every reading of a record as a sample of a node, by time."""
    return [
        (f"ns=2;s={prefix}.{name}", at, value, GOOD)
        for at, content in record_messages(record, "T1")
        for name, value in content.items()
        if name not in ("turbine", "time")
    ]


def nodes_of(samples: Sequence[tuple]) -> list[str]:
    return sorted({one[0] for one in samples})


def test_values_of_a_subscription_end_in_the_offline_filter(
    tmp_path: Path, peer: Peer, record: Record, turbine: Turbine
) -> None:
    """All of it by the subscription, equal values in a row too; at the server nothing was written and nothing
    called."""
    samples = samples_of(record, "live")
    peer.add(nodes_of(samples), history="none")
    with Tracked(peer.url, record, turbine, tmp_path / "live.db", "live") as tracked:
        peer.write(samples, pause_s=0.001)
        tracked.wait(len(samples))
    expect_offline(tracked.store, record, turbine)
    assert {key: peer.asked_of()[key] for key in ("written", "called")} == {"written": 0, "called": 0}
    asyncio.run(write_and_call(peer.url, nodes_of(samples)[0]))
    assert {key: peer.asked_of()[key] for key in ("written", "called")} == {"written": 1, "called": 1}


async def write_and_call(url: str, node: str) -> None:
    """What the tracker never does, to see that the server would have noticed."""
    from asyncua import Client, ua

    async with Client(url) as client:
        with suppress(ua.UaError):
            await client.get_node(node).write_value(1.0)
        with suppress(ua.UaError):
            await client.nodes.server.call_method("0:GetMonitoredItems", ua.Variant(0, ua.VariantType.UInt32))


def test_a_tracker_that_ends_reads_back_what_it_missed(
    tmp_path: Path, peer: Peer, record: Record, turbine: Turbine
) -> None:
    samples = samples_of(record, "restart")
    third = len(samples) // 3
    peer.add(nodes_of(samples))
    for part in (1, 2):
        with Tracked(peer.url, record, turbine, tmp_path / "live.db", "restart") as tracked:
            peer.write(samples[(2 * part - 2) * third : (2 * part - 1) * third])
            tracked.wait((2 * part - 1) * third)
        peer.write(samples[(2 * part - 1) * third : 2 * part * third])
    peer.write(samples[4 * third :])
    with Tracked(peer.url, record, turbine, tmp_path / "live.db", "restart") as tracked:
        tracked.wait(len(samples))
    expect_offline(tracked.store, record, turbine)


def test_a_server_that_is_killed_loses_nothing(tmp_path: Path, record: Record, turbine: Turbine) -> None:
    """Killed twice, once for long; what was recorded meanwhile is read back, and what comes then is not
    doubled."""
    samples = samples_of(record)
    part = len(samples) // 4
    with Peer(tmp_path) as peer:
        peer.prepare()
        peer.add(nodes_of(samples))
        peer.listen()
        with Tracked(peer.url, record, turbine, tmp_path / "live.db") as tracked:
            peer.write(samples[:part])
            tracked.wait(part)
            peer.kill()
            eventually(lambda: tracked.stream.state[0] == "lost", lambda: tracked.stream.state)
            assert "nothing listens there" in tracked.stream.state[1] or "lost" in tracked.stream.state[1]
            assert tracked.stream.reach().since is not None
            peer.prepare()
            peer.write(samples[part : 3 * part])
            peer.listen()
            peer.write(samples[3 * part :])
            tracked.wait(len(samples))
            assert tracked.stream.reach().since is None
    expect_offline(tracked.store, record, turbine)


# -- samples -------------------------------------------------------------------------------------------------
def test_bad_values_are_counted_and_never_used(peer: Peer, named, started) -> None:
    tcab, heat, env = named("Tcab"), named("heat"), named("env")
    peer.add([tcab, env])
    peer.add([heat], value=False)
    run = started(peer.url, {tcab: "Tcab", heat: "heat", env: "T.env"})
    run.wait(lambda: run.stream.state[0] == "connected" and len(run.contents) == 3)
    peer.write(
        at((1, 31.5), (2, None, BAD), (3, 32.0, BAD), (4, 32.5, UNCERTAIN), (5, 31.5), (6, 31.5), node=tcab)
    )
    peer.write(at((1, float("nan")), (2, 8.0), node=env))
    peer.write([(heat, T0 + 1, True, GOOD), (tcab, None, 40.0, GOOD)])
    run.wait(lambda: len(run.contents) == 13)
    assert run.values("Tcab") == [(1, 31.5), (5, 31.5), (6, 31.5)]  # a value that stays is measured, too
    assert run.values("heat")[-1] == (1, 1)
    counts: Counter = Counter()
    used = []
    for one in run.contents:
        if one["time"] is None:
            counts["no time"] += 1
            continue
        (found,) = run.stream.mapping.read(one, time.time())
        counts += counted(found)
        used += [r.time - T0 for r in found.readings if r.signal == "cabinet_temperature"]
    assert counts == {"bad quality": 3, "no number": 1, "no time": 3} and used == [1, 5, 6]
    peer.write(at((7, None, BAD), node=tcab))
    run.wait(lambda: f"bad now: {tcab} (BadSensorFailure)" in run.stream.state[1])


def test_samples_of_data_values() -> None:
    from asyncua import ua

    node, then = Node("i=1", "T07", "Tcab"), datetime.fromtimestamp(T0, UTC)

    def sample(value=1.5, status=GOOD, **stamps):
        return sample_of(node, ua.DataValue(ua.Variant(value), ua.StatusCode(status), **stamps), T0 + 9.0)

    both = sample(SourceTimestamp=then, ServerTimestamp=then + timedelta(seconds=5))
    assert (both.time, both.quality, both.word, both.overflowed) == (T0, "good", "Good", False)
    assert both.served == T0 + 5.0  # by which corrected values are ordered
    assert sample(ServerTimestamp=then).time == T0 and math.isnan(sample(SourceTimestamp=then).served)
    assert sample().time is None
    never = datetime(1601, 1, 1, tzinfo=UTC)
    assert sample(SourceTimestamp=never).time is None
    assert sample(SourceTimestamp=never, ServerTimestamp=then).time == T0
    assert sample(SourceTimestamp=then.replace(tzinfo=None)).time == T0
    qualities = [sample(status=s).quality for s in (GOOD, UNCERTAIN, BAD, 0xC0000000)]
    assert qualities == ["good", "uncertain", "bad", "bad"]
    assert sample(value=None).quality == "bad"
    assert sample_of(node, ua.DataValue(), T0).quality == "bad"
    assert sample(status=BAD | OVERFLOWED).word == "BadSensorFailure"
    overflowed = [sample(status=s).overflowed for s in (0x480, 0x80, 0x400, 0x40000480)]
    assert overflowed == [True, False, False, True]


def test_a_server_that_tells_changes_only_is_taken_as_it_is(peer: Peer, named, started) -> None:
    tcab, other = named("Tcab"), named("other")
    peer.add([tcab], filters=False)
    peer.add([other])
    run = started(peer.url, {tcab: "Tcab", other: "T.env"})
    run.wait(lambda: "the server reports changes only" in run.stream.state[1] and len(run.contents) == 2)
    rows = ((1, 1.0), (2, 1.0), (3, 2.0))
    peer.write(at(*rows, node=tcab) + at(*rows, node=other))
    run.wait(lambda: len(run.values("T.env")) == 3)
    assert run.values("Tcab") == [(1, 1.0), (3, 2.0)]


def test_uncertain_values_are_used_where_that_is_stated() -> None:
    table = {"url": "opc.tcp://localhost", "nodes": {"i=7": {"turbine": "T07", "field": "Tcab"}}}
    payload = {"turbine": "T07", "time": T0, "quality": "uncertain", "Tcab": 30.0}
    for stated, count in ((False, 0), (True, 1)):
        stream = made({**table, "uncertain": stated})
        assert sum(len(one.readings) for one in stream.mapping.read(payload, T0 + 9.0)) == count


# -- what is missed ------------------------------------------------------------------------------------------
def test_history_comes_in_one_order_of_time_page_after_page(
    peer: Peer, named, started, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fast node and a slow one: neither runs ahead of the other, or the filter would find readings too
    late."""
    monkeypatch.setattr(opcua_client, "SAMPLES_AT_ONCE", 7)
    monkeypatch.setattr(module, "DELIVERED_TOGETHER", 10)
    fast, slow = named("fast"), named("slow")
    peer.add([fast, slow])
    peer.write(at(*((i, 0.1 * i) for i in range(100)), node=fast))
    peer.write(at(*((10 * i + 5, float(i)) for i in range(10)), (96, 20.0), node=slow))
    run = started(peer.url, {fast: "Tcab", slow: "T.env"}, place={fast: T0 + 9, slow: T0 + 5})
    run.wait(lambda: len(run.contents) >= 100)
    run.stream.stop()
    assert run.values("Tcab") == [(i, 0.1 * i) for i in range(10, 100)]
    assert run.values("T.env") == [(10 * i + 5, i) for i in range(1, 10)] + [(96, 20.0)]
    stamps = [one["time"] for one in run.contents]
    assert stamps == sorted(stamps)
    assert run.place() == {fast: T0 + 99, slow: T0 + 96}
    for one in run.got.found:  # a place says nothing that was not delivered before it
        for node, reached in json.loads(one.place or "{}").items():
            field = {fast: "Tcab", slow: "T.env"}[node]
            sent = [c["time"] for c in run.contents[: run.got.found.index(one) + 1] if field in c]
            assert reached == max(sent, default=T0 + {fast: 9, slow: 5}[node])


def test_the_first_start_reads_back_as_far_as_is_stated(peer: Peer, named, started) -> None:
    tcab, now = named("Tcab"), time.time()
    peer.add([tcab])
    peer.write([(tcab, now - s, s, GOOD) for s in (900.0, 500.0, 100.0)])
    for look_back_s, expected in ((600.0, [500.0, 100.0]), (0.0, [100.0])):
        run = started(peer.url, {tcab: "Tcab"}, look_back_s=look_back_s)
        run.wait(lambda run=run, expected=expected: [one["Tcab"] for one in run.contents] == expected)


@pytest.mark.parametrize("place", ["{", "[1]", '{"other": 1}', '{"%s": "soon"}', '{"%s": 1e12}'])
def test_a_place_that_says_nothing_is_no_place(place: str) -> None:
    stream = OpcUa(server("opc.tcp://localhost", [Node("i=1", "T07", "Tcab")]), MAPPING)
    assert stream._stored_times(place.replace("%s", "i=1")) == {}
    assert stream._stored_times('{"i=1": 1.7e9}') == {"i=1": 1.7e9}


def test_a_stamp_of_the_far_future_does_not_end_reading_back(peer: Peer, named, started) -> None:
    tcab = named("Tcab")
    peer.add([tcab])
    run = started(peer.url, {tcab: "Tcab"})
    run.wait(lambda: len(run.contents) == 1)
    peer.write(at((1, 1.0), (3e9, 2.0), (2, 3.0), node=tcab))
    run.wait(lambda: len(run.values()) == 3)
    assert run.place() == {tcab: T0 + 2}


def test_what_overflowed_in_the_server_is_read_back_first(peer: Peer, named, started) -> None:
    tcab = named("Tcab")
    peer.add([tcab])
    run = started(peer.url, {tcab: "Tcab"})
    peer.write(at((1, 1.0), node=tcab))
    run.wait(lambda: run.values() == [(1, 1.0)])
    peer.record(at((2, 2.0), (3, 3.0), node=tcab))
    peer.write(at((4, 4.0, OVERFLOWED), node=tcab))
    run.wait(lambda: run.values() == [(1, 1.0), (2, 2.0), (3, 3.0), (4, 4.0)])
    run.wait(lambda: "the queue in the server overflowed 1 times" in run.stream.state[1])


def test_what_found_no_room_here_is_read_back(
    peer: Peer, named, started, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(opcua_client, "QUEUE_SIZE", 5)
    tcab = named("Tcab")
    peer.add([tcab])
    run = started(peer.url, {tcab: "Tcab"})
    run.wait(lambda: len(run.contents) == 1)
    peer.write(at(*((i, float(i)) for i in range(1, 400)), node=tcab))
    run.wait(lambda: sorted(set(run.values())) == [(i, i) for i in range(1, 400)])
    assert "the queue here overflowed" in run.stream.state[1]
    run.wait(lambda: run.place() == {tcab: T0 + 399})


def test_a_slow_service_is_waited_for_and_the_connection_holds(peer: Peer, named, started) -> None:
    tcab = named("Tcab")
    peer.add([tcab])
    gate, got = threading.Event(), []

    def put(one) -> None:
        gate.wait(PATIENCE_S)
        got.append(one.content["time"])

    stream = OpcUa(server(peer.url, [Node(tcab, "T07", "Tcab")]), MAPPING)
    stream.start(None, put)
    try:
        eventually(lambda: stream.state[0] == "connected")
        for i in range(1, 30):
            peer.write(at((i, float(i)), node=tcab))
        assert got == []
        gate.set()
        eventually(lambda: got[-29:] == [T0 + i for i in range(1, 30)], lambda: (stream.state, got))
        eventually(lambda: stream.state == ("connected", peer.url), lambda: stream.state)
    finally:
        gate.set()
        stream.stop()


def test_without_history_it_says_so_and_goes_on(
    peer: Peer, named, started, caplog: pytest.LogCaptureFixture
) -> None:
    tcab, other = named("Tcab"), named("other")
    peer.add([tcab], history="refused")
    peer.add([other])
    peer.record(at((1, 1.0), (3, 3.0), node=tcab) + at((1, 7.0), (2, 8.0), node=other))
    with caplog.at_level(logging.WARNING, "hygrokf.track"):
        run = started(peer.url, {tcab: "Tcab", other: "T.env"}, place={tcab: T0 + 0.5, other: T0 + 0.5})
        run.wait(lambda: run.values("T.env") == [(1, 7.0), (2, 8.0)])
        peer.write(at((4, 4.0), node=tcab))
        run.wait(lambda: run.values() == [(4, 4.0)])
    said = f"no history, missed samples are lost: {tcab} (BadHistoryOperationUnsupported)"
    assert said in run.stream.state[1]
    assert [r.node for r in caplog.records if r.message == "no history"] == [tcab]
    assert run.place() == {tcab: T0 + 4, other: T0 + 2}


def test_a_server_that_answers_for_history_and_keeps_none_is_told(
    peer: Peer, named, started, caplog: pytest.LogCaptureFixture
) -> None:
    """An empty answer is history only where the node's access level says so."""
    tcab, other = named("Tcab"), named("other")
    peer.add([tcab], history="none")
    peer.add([other])
    with caplog.at_level(logging.WARNING, "hygrokf.track"):
        run = started(peer.url, {tcab: "Tcab", other: "T.env"}, place={tcab: T0, other: T0})
        peer.write(at((4, 4.0), node=tcab))
        run.wait(lambda: run.values() == [(4, 4.0)])
    state = run.stream.state[1]
    assert "missed samples are lost" in state and f"{tcab} (the node's AccessLevel has no" in state
    assert other not in state.partition("no history")[2]
    assert [r.node for r in caplog.records if r.message == "no history"] == [tcab]


def test_history_that_fails_for_now_is_owed(
    peer: Peer, named, started, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Values go on, the place does not: a restart would begin where the gap does; then the gap is closed."""
    monkeypatch.setattr(module, "REQUEST_AGAIN_S", 0.5)
    tcab = named("Tcab")
    peer.add([tcab], history="failing")
    peer.record(at((1, 1.0), (2, 2.0), node=tcab))
    run = started(peer.url, {tcab: "Tcab"}, place={tcab: T0})
    peer.write(at((3, 3.0), node=tcab))
    run.wait(lambda: run.values() == [(3, 3.0)])
    assert run.place() == {tcab: T0}
    assert f"{tcab} (BadResourceUnavailable)" in run.stream.state[1]
    peer.add([tcab], history="kept")
    run.wait(lambda: set(run.values()) == {(1, 1.0), (2, 2.0), (3, 3.0)})
    run.wait(lambda: run.place() == {tcab: T0 + 3} and "history" not in run.stream.state[1])


def test_nodes_that_are_not_there_are_named_and_asked_for_again(
    peer: Peer, named, started, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "REQUEST_AGAIN_S", 0.5)
    tcab, later = named("Tcab"), named("later")
    peer.add([tcab], value=30.0)
    elsewhere = "nsu=urn:elsewhere;s=x"
    run = started(peer.url, {tcab: "Tcab", later: "T.env", elsewhere: "heat"})
    run.wait(lambda: len(run.contents) == 1)
    state = run.stream.state[1]
    assert f"{later} (BadNodeIdUnknown)" in state
    assert f"{elsewhere} (the server has no such namespace)" in state
    peer.add([later])
    peer.write(at((1, 8.0), node=later))
    run.wait(lambda: run.values("T.env") == [(1, 8.0)])
    # its first value, before it was measured, may have come in between, and is told as a bad one
    assert f"{later} (BadNodeIdUnknown)" not in run.stream.state[1] and elsewhere in run.stream.state[1]


def test_a_node_may_be_named_by_its_namespace(peer: Peer, named, started) -> None:
    tcab = named("Tcab")
    peer.add([tcab])
    by_name = tcab.replace("ns=2;", f"nsu={NAMESPACE};")
    peer.write(at((1, 1.0), (2, 2.0), node=tcab))
    run = started(peer.url, {by_name: "Tcab"}, place={by_name: T0})
    run.wait(lambda: run.values() == [(1, 1.0), (2, 2.0)] and run.place() == {by_name: T0 + 2})


def test_a_server_that_says_nothing_any_more_is_left(
    peer: Peer, named, started, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its connection stays open: only asking tells that nobody is there."""
    monkeypatch.setattr(opcua_client, "WATCH_S", 0.3)
    monkeypatch.setattr(opcua_client, "SERVER_ANSWER_S", 1.0)
    monkeypatch.setattr(opcua_client, "HISTORY_ANSWER_S", 1.0)
    tcab = named("Tcab")
    peer.add([tcab])
    run = started(peer.url, {tcab: "Tcab"})
    run.wait(lambda: run.stream.state[0] == "connected")
    peer.stall()
    try:
        run.wait(lambda: run.stream.state[0] == "lost" and "no answer in time" in run.stream.state[1])
    finally:
        peer.go_on()
    peer.write(at((1, 1.0), node=tcab))
    run.wait(lambda: run.values() == [(1, 1.0)] and run.stream.state[0] == "connected")


def test_a_server_that_is_not_there_yet_is_waited_for_with_bounded_pauses(
    started, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streams, "SOURCE_BACK_OFF_S", (0.1, 0.3))
    seen, wait = [], BackOff.wait

    def noted(back_off: BackOff, ended: threading.Event) -> None:
        seen.append(back_off.next_s)
        wait(back_off, ended)

    monkeypatch.setattr(BackOff, "wait", noted)
    run = started(f"opc.tcp://127.0.0.1:{free_port()}", {"i=1": "Tcab"})
    run.wait(lambda: len(seen) >= 4)
    assert seen[:4] == [0.1, 0.2, 0.3, 0.3]
    word, said = run.stream.state
    assert word == "lost" and "nothing listens there; next attempt within 0.3 s" in said
    run.stream.stop()
    # one attempt: where names are resolved slowly, a second one would not end with the test
    monkeypatch.setattr(streams, "SOURCE_BACK_OFF_S", (30.0, 30.0))
    away = started("opc.tcp://no-such-host.invalid:4840", {"i=1": "Tcab"})
    away.wait(lambda: "the host is not known" in away.stream.state[1])


# -- security ------------------------------------------------------------------------------------------------
def write_pair(folder: Path, name: str, uri: str, days: int = 2) -> tuple[str, str]:
    """A certificate of its own signature and its key, as files; their names."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import rsa
    from cryptography.x509.oid import NameOID

    key = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.now(UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=3))
        .not_valid_after(now + timedelta(days=days))
    )
    if uri:
        names = [x509.UniformResourceIdentifier(uri), x509.DNSName("localhost")]
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    made = builder.sign(key, hashes.SHA256())
    (folder / f"{name}.pem").write_bytes(made.public_bytes(serialization.Encoding.PEM))
    (folder / f"{name}.key").write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    )
    return f"{name}.pem", f"{name}.key"


@pytest.fixture(scope="module")
def papers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of certificates: the tracker's, the server's, another server's, one that is over, one without
    a name."""
    folder = tmp_path_factory.mktemp("papers")
    write_pair(folder, "tracker", "urn:plant:tracker")
    write_pair(folder, "server", "urn:plant:server")
    write_pair(folder, "other", "urn:plant:server")
    write_pair(folder, "over", "urn:plant:tracker", days=-1)
    write_pair(folder, "nameless", "")
    (folder / "password").write_text("pa55 word\n", encoding="utf-8")
    (folder / "wrong").write_text("guess7", encoding="utf-8")
    (folder / "empty").write_text("\n", encoding="utf-8")
    return folder


PAPERS = {"certificate": "tracker.pem", "key": "tracker.key", "server_certificate": "server.pem"}
SIGNED_ON = {**PAPERS, "user": "hygrokf", "password_file": "password"}


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory, papers: Path) -> Iterator[Peer]:
    """A server that takes encrypted connections of one user only."""
    settings = {"certificate": str(papers / "server.pem"), "key": str(papers / "server.key"), "closed": True}
    with Peer(tmp_path_factory.mktemp("secured"), users={"hygrokf": "pa55 word"}, **settings) as made:
        made.prepare()
        made.add(["ns=2;s=Tcab"])
        made.write(at((1, 31.0), node="ns=2;s=Tcab"))
        made.listen()
        yield made


def test_an_encrypted_connection_of_a_user(secured: Peer, papers: Path, started) -> None:
    run = started(secured.url, {"ns=2;s=Tcab": "Tcab"}, place={"ns=2;s=Tcab": T0}, folder=papers, **SIGNED_ON)
    run.wait(lambda: run.values() == [(1, 31.0)] and run.stream.state == ("connected", secured.url))


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        (
            {"server_certificate": "other.pem"},
            "the server's certificate is not the one in server_certificate",
        ),
        ({"password_file": "wrong"}, "the server refuses the user: check user and password"),
        (
            {"user": None, "password_file": None},
            "the server refuses the user: check user and password, or state",
        ),
        (
            {"certificate": "over.pem", "key": "over.key", "user": "x"},
            "; this client's certificate was valid until 20",
        ),
        ({"mode": "Sign"}, "no connection with Basic256Sha256 Sign; it offers Basic256Sha256 SignAndEncrypt"),
        ({"policy": "Aes256Sha256RsaPss"}, "no connection with Aes256Sha256RsaPss SignAndEncrypt; it offers"),
        (dict.fromkeys(SIGNED_ON), "no connection with no security; it offers Basic256Sha256 SignAndEncrypt"),
    ],
)
def test_what_does_not_fit_is_said_in_words(
    secured: Peer,
    papers: Path,
    started,
    stated: dict,
    said: str,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No value comes, and no secret shows in the state, the log or what is printed of the stream's parts."""
    monkeypatch.setattr(opcua_client, "SERVER_ANSWER_S", 2.0)
    table = {key: value for key, value in {**SIGNED_ON, **stated}.items() if value is not None}
    with caplog.at_level(logging.DEBUG):
        run = started(secured.url, {"ns=2;s=Tcab": "Tcab"}, folder=papers, **table)
        run.wait(lambda: said in run.stream.state[1])
        assert run.stream.state[0] == "lost" and run.contents == []
        run.stream.stop()
    key = (papers / "tracker.key").read_text().splitlines()[2]
    parts = run.stream.server, run.stream._security
    shown = f"{caplog.text} {[vars(r) for r in caplog.records]} {run.stream.state} {parts}"
    assert not [secret for secret in ("pa55", "guess7", key) if secret in shown]


def test_a_user_s_password_is_not_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HYGROKF_OPCUA", "pa55")
    stated = server("opc.tcp://localhost", [], user="hygrokf", password_env="HYGROKF_OPCUA")
    assert stated.password.read() == "pa55" and "pa55" not in repr(stated)


# -- the tracker's file --------------------------------------------------------------------------------------
NODES = {"ns=2;s=T07.CabinetTemp": {"turbine": "T07", "field": "Tcab"}}
PLAIN = {"url": "opc.tcp://localhost:4840/plant", "nodes": NODES}
AWAY = {"url": "opc.tcp://scada.example:4840", "nodes": NODES}


def made(table: dict, folder: Path = Path(".")) -> OpcUa:
    place = Place("[[source]] 1")
    stream = stream_of(table, place, folder, MAPPING)
    assert place.faults == [] and isinstance(stream, OpcUa)
    return stream


def faults(table: dict, folder: Path = Path(".")) -> str:
    place = Place("[[source]] 1")
    assert stream_of(table, place, folder, MAPPING) is None
    assert place.faults and all(one.startswith("[[source]] 1") for one in place.faults)
    return "\n".join(place.faults)


def test_a_whole_table(papers: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HYGROKF_OPCUA", "pa55 word")
    table = {
        **AWAY, **PAPERS, "url": "opc.tcp://scada.example/plant", "policy": "Aes128Sha256RsaOaep",
        "mode": "Sign", "user": "me",
        "password_env": "HYGROKF_OPCUA", "sampling": "0s", "publishing": "0.5s", "queue": 50,
        "look_back": "3d",
        "uncertain": True,
    }  # fmt: skip
    stream = made(table, papers)
    assert stream.url == "opc.tcp://scada.example:4840/plant"
    assert stream.nodes == (Node("ns=2;s=T07.CabinetTemp", "T07", "Tcab"),)
    assert stream.mapping.use_uncertain and stream.mapping.turbines == {"T07": "T07"}
    stated = stream.server
    assert (stated.sampling_s, stated.publishing_s, stated.queue) == (0.0, 0.5, 50)
    assert (stated.look_back_s, stated.user, stated.password.read()) == (259200.0, "me", "pa55 word")
    assert (stream._security.policy, stream._security.mode) == ("Aes128Sha256RsaOaep", "Sign")
    assert stream._security.application_uri == "urn:plant:tracker"
    assert made(PLAIN).state == ("idle", "not started")
    assert made({**AWAY, "security": "none"})._security is None


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"url": "opc.tcp://me:s3cret@localhost:4840"}, "a password must not be in this file"),
        ({"url": "opc.tcp://me@localhost:4840"},
            "a user does not belong in the url: state user, and password_file"),
        ({"url": "opc.tcp:localhost"}, "url must be opc.tcp://HOST[:PORT]/PATH"),
        ({"url": "opc.tcp://localhost:port"}, "url must be opc.tcp://HOST[:PORT]/PATH"),
        ({"password": "s3cret", "user": "me"},
            "a password must not be in this file: put it into a separate file"),
        ({"nods": {}}, 'unknown key "nods"; expected url, nodes'),
        ({"nodes": {}}, "no nodes: add nodes = {"),
        ({"nodes": {"T07.CabinetTemp": {"turbine": "T07", "field": "Tcab"}}}, "expected a node id such as"),
        ({"nodes": {"srv=1;i=5": {"turbine": "T07", "field": "Tcab"}}}, "expected a node id such as"),
        ({"nodes": {"i=5": "Tcab"}}, "expected { turbine = "),
        ({"nodes": {"i=5": {"turbine": "T7", "field": "Tcab"}}}, 'has no \'T7\'; did you mean "T07"?'),
        ({"nodes": {"i=5": {"turbine": "T07", "field": "Tcap"}}}, 'has no \'Tcap\'; did you mean "Tcab"?'),
        ({"nodes": {"i=5": {"turbine": "T07", "feld": "Tcab"}}}, 'unknown key "feld"'),
        ({"nodes": {**NODES, "i=5": {"turbine": "T07", "field": "Tcab"}}}, "already is Tcab of T07"),
        ({"queue": 1}, "queue must be a whole number within 2 … 20000"),
        ({"publishing": "0s"}, "publishing must be within"),
        ({"sampling": "fast"}, "sampling: expected a duration"),
        ({"uncertain": "yes"}, "uncertain must be true or false"),
        ({"security": "some"}, 'security must be "none" where it is stated'),
        ({**PAPERS, "security": "none"},
            'security = "none" contradicts certificate, key, server_certificate'),
        ({"certificate": "tracker.pem"}, "key, server_certificate missing"),
        ({**PAPERS, "policy": "Basic128"}, "policy must be one of Basic256Sha256"),
        ({**PAPERS, "mode": "None"}, "mode must be one of SignAndEncrypt, Sign"),
        ({**PAPERS, "key": "gone.key"}, "gone.key: No such file or directory"),
        ({**PAPERS, "key": "server.key"}, "certificate and key do not belong together"),
        ({**PAPERS, "key": "tracker.pem"}, "expected a private RSA key without a password"),
        ({**PAPERS, "certificate": "password"}, "expected an RSA certificate, as PEM or DER"),
        ({**PAPERS, "certificate": "nameless.pem", "key": "nameless.key"},
            "expected a URI among its alternative names"),
        ({"user": "me"}, "user and its password_file or password_env belong together"),
        ({"password_file": "password"}, "user and its password_file or password_env belong together"),
        ({"user": "me", "password_file": "password", "password_env": "X"}, "keep one"),
        ({"user": "me", "password_file": "gone"}, "gone: No such file or directory"),
        ({"user": "me", "password_file": "empty"}, "expected one line, the password"),
        ({"user": "me", "password_env": "HYGROKF_NOT_THERE"}, "HYGROKF_NOT_THERE is not set"),
        (AWAY, 'needs certificate, key, server_certificate; state security = "none"'),
        ({**AWAY, "security": "none", "user": "me", "password_file": "password"},
            "it would be sent readable"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_the_table_is_told(papers: Path, changes: dict, said: str) -> None:
    found = faults({**PLAIN, **changes}, papers)
    assert said in found and "s3cret" not in found and "pa55" not in found


def test_the_page_of_the_docs_states_every_key_and_its_example_is_read(papers: Path, tmp_path: Path) -> None:
    page = document("live_opcua.md").read_text(encoding="utf-8")
    example = tomllib.loads(re.search(r"```toml\n(.*?)```", page, re.DOTALL)[1])
    for name, place in (("tracker.pem", "pki"), ("tracker.key", "pki"), ("password", "secrets")):
        (tmp_path / place).mkdir(exist_ok=True)
        (tmp_path / place / {"password": "opcua"}.get(name, name)).write_bytes((papers / name).read_bytes())
    (tmp_path / "pki" / "scada.pem").write_bytes((papers / "server.pem").read_bytes())
    mapping = PayloadMapping(
        {name: Field(one["signal"], one["unit"]) for name, one in example["mapping"]["signals"].items()},
        turbines={"T07": "T07"},
    )
    place = Place()
    stream = stream_of(example["source"][0], place, tmp_path, mapping)
    assert place.faults == [] and len(stream.nodes) == 2
    assert (stream.server.user, stream.server.password.read()) == ("hygrokf", "pa55 word")
    assert not [
        key
        for key in {*keys_of(Server)} - {*keys_of(SourceKeys)}
        if not re.search(rf"[`.]{key}[`\]]|^{key} = ", page, re.MULTILINE)
    ]


def test_fields_named_like_the_frame_of_a_payload_are_refused() -> None:
    place, mapping = Place(), PayloadMapping({"time": MAPPING.fields["Tcab"]}, turbines={"T07": "T07"})
    nodes = {"i=5": {"turbine": "T07", "field": "time"}}
    assert stream_of({**PLAIN, "nodes": nodes}, place, Path("."), mapping) is None
    assert "a field must not be named 'time' here" in place.faults[0]


def test_without_asyncua_the_extra_is_named(started, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "asyncua", None)
    said = "OPC UA needs asyncua: pip install 'hygrokf[opcua]'"
    assert said in faults(PLAIN)
    run = started("opc.tcp://localhost:4840", {"i=1": "Tcab"})
    run.wait(lambda: run.stream.state[0] == "lost" and said in run.stream.state[1])
    with pytest.raises(SourceFault, match="hygrokf"):
        node_fault("i=1")


def test_nothing_of_it_can_write_or_call() -> None:
    folder = Path(module.__file__).parent
    for file in ("opcua.py", "opcua_client.py", "opcua_form.py"):
        text = (folder / file).read_text(encoding="utf-8")
        assert not [
            word
            for word in ("write_", "set_value", "call_method", ".call(", "history_update")
            if word in text
        ]
