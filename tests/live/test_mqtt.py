"""MQTT against a broker of its own: nothing lost and nothing twice however either side dies; states in words;
alarms."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from builders import service_case
from builders.brokers import (
    Mosquitto,
    authority,
    dynamic_security,
    mosquitto,
    needs_mosquitto,
    overheard,
    password_file,
    peer,
    publish,
)
from builders.live_case import count_of, expect_offline, live_record, without_preheating
from builders.ports import free_port
from builders.store_case import queried
from builders.waiting import eventually

from hygrokf.data.record import Record
from hygrokf.live.batch import Alarm, Batch
from hygrokf.live.service import Service
from hygrokf.live.sources import mqtt
from hygrokf.live.sources import stream as streams
from hygrokf.live.sources.broker import Broker
from hygrokf.live.sources.local import record_mapping, record_messages
from hygrokf.live.sources.mqtt import Mqtt
from hygrokf.live.sources.payload import Field, PayloadMapping
from hygrokf.live.sources.payload_formats import LARGEST_PAYLOAD, Refused
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.storage.store import open_store
from hygrokf.live.turbines import Turbine

pytestmark = needs_mosquitto

SEED, DAYS = 7, 3.0
TOPIC = "scada/T1/cabinet"
MAPPING = PayloadMapping({"Tcab": Field("cabinet_temperature", "degC")}, turbines={"T1": "T1"})
ALARM = Alarm(
    "T1:condensation:1600000000", "T1", "condensation", "warning", 1.6e9, "water condenses", "pre-heat"
)


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "SOURCE_BACK_OFF_S", (0.05, 0.2))


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return without_preheating(live_record(tmp_path_factory.mktemp("turbine"), seed=SEED, days=DAYS))


@pytest.fixture(scope="module")
def messages(record: Record) -> list[tuple[str, str]]:
    return [(TOPIC, json.dumps(content)) for _, content in record_messages(record, "T1")]


def stream_of(found: Mosquitto, mapping: PayloadMapping = MAPPING, **changes: object) -> Mqtt:
    settings = {"topics": ("scada/#",), "client_id": "tracker"} | changes
    scheme = "mqtts" if settings.pop("tls", False) else "mqtt"
    return Mqtt(Broker(f"{scheme}://127.0.0.1:{found.port}", **settings), mapping)


class Taken:
    """What a stream put; with `held` it waits in `put`, as a service that does not keep up."""

    def __init__(self, held: bool = False) -> None:
        self.found: list[Delivery] = []
        self.free = threading.Event()
        if not held:
            self.free.set()

    def __call__(self, one: Delivery) -> None:
        self.free.wait(120.0)
        self.found.append(one)

    @property
    def contents(self) -> list[bytes]:
        return [one.content for one in self.found]


@contextmanager
def running(stream: Mqtt, place: str | None = None, until: str = "connected", **how: bool) -> Iterator[Taken]:
    """A stream that runs until the block ends, and what it puts."""
    taken = Taken(**how)
    stream.start(place, taken)
    try:
        eventually(lambda: stream.state[0] == until)
        yield taken
    finally:
        taken.free.set()
        stream.stop()
        stream.stop()


@contextmanager
def serving(
    turbine: Turbine, stream: Mqtt, store: str, settle: Callable = lambda batch: None
) -> Iterator[Service]:
    """A service that runs until the block ends; its end is that of one that is ending."""
    service = Service({"T1": turbine}, [stream], store, settle)
    with service_case.running(service):
        eventually(lambda: stream.state[0] == "connected")
        yield service
    assert stream.state == ("stopped", "")


def stored(url: str) -> int:
    store = open_store(url)
    try:
        return queried(store, "SELECT COUNT(*) FROM observation")[0][0]
    finally:
        store.close()


def nothing_is_left(found: Mosquitto, **changes: object) -> None:
    """The broker has nothing for this session: what is published now comes first."""
    with running(stream_of(found, **changes)) as taken, peer(found) as other:
        publish(other, [(TOPIC, "the first")])
        eventually(lambda: taken.found)
        assert taken.contents == [b"the first"]


# -- nothing lost, nothing twice -----------------------------------------------------------------------------
def test_a_broker_that_is_killed_and_comes_back_loses_nothing(
    tmp_path: Path, broker: Mosquitto, record: Record, turbine: Turbine, messages: list[tuple[str, str]]
) -> None:
    store = f"sqlite:{tmp_path / 'live.db'}"
    stream = stream_of(broker, record_mapping(record, "T1"))
    most = len(messages) - 100
    committed, held = threading.Event(), threading.Event()

    def settle(batch: Batch) -> None:
        if batch.observations:
            committed.set()
            held.wait(120.0)

    with serving(turbine, stream, store, settle):
        try:
            with peer(broker) as other:
                publish(other, messages[:most])
            # some are committed, some were sent and not acknowledged, the rest waits at the broker
            eventually(committed.is_set)
            broker.save()
            broker.kill()
            eventually(lambda: stream.state[0] == "lost")
            assert "refused" in stream.state[1] or "lost" in stream.state[1]
        finally:
            held.set()
        broker.start()
        eventually(lambda: stream.state[0] == "connected")
        with peer(broker) as other:
            publish(other, messages[most:])
        eventually(lambda: stored(store) == count_of(record))
    expect_offline(store, record, turbine)
    nothing_is_left(broker)


CHILD = """
import sys, time
from pathlib import Path
from hygrokf.live.sources.broker import Broker
from hygrokf.live.sources.mqtt import Mqtt
from hygrokf.live.service import Service
from hygrokf.live.storage.store import Store
from hygrokf.live.sources.endpoint import Secret
from hygrokf.live.sources.local import record_mapping
from builders.live_case import live_record, live_turbine, without_preheating

port, folder, store, seed, days = sys.argv[1:]
record = without_preheating(live_record(Path(folder), seed=int(seed), days=float(days)))
broker = Broker(f"mqtt://127.0.0.1:{port}", ("scada/#",), client_id="tracker")
stream = Mqtt(broker, record_mapping(record, "T1"))
commit, rounds = Store.commit, []

def held(self, batch):
    rounds.extend([batch] if batch.observations else [])  # forecasts and alarms are committed too
    commit(self, batch)
    if batch.observations and len(rounds) == 2:
        print("held", flush=True); time.sleep(600.0)

Store.commit = held
service = Service({"T1": live_turbine(record)}, [stream], store)
start = stream.start
def started(place, put):
    start(place, put); print("started", flush=True)
stream.start = started
service.run()
"""


def test_a_tracker_killed_around_a_commit_gets_again_what_it_had_not_acknowledged(
    tmp_path: Path, broker: Mosquitto, record: Record, turbine: Turbine, messages: list[tuple[str, str]]
) -> None:
    store = f"sqlite:{tmp_path / 'live.db'}"
    root = Path(__file__).parents[2]
    paths = os.pathsep.join([str(root), str(root / "tests")])
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(broker.port), str(tmp_path), store, str(SEED), str(DAYS)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths},
    )
    try:
        assert child.stdout.readline() == "started\n"
        eventually(lambda: "as tracker" in broker.log() and "SUBACK to tracker" in broker.log())
        third = len(messages) // 3
        with peer(broker) as other:
            # in parts: a quick tracker takes everything that is there in one commit, and nothing would be
            # left to lose
            publish(other, messages[:third])
            eventually(lambda: stored(store) > 0)
            publish(other, messages[third : 2 * third])
            assert child.stdout.readline() == "held\n"
            publish(other, messages[2 * third :])
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait(timeout=60.0)
        child.stdout.close()
    before = stored(store)
    assert 0 < before < count_of(record)
    with serving(turbine, stream_of(broker, record_mapping(record, "T1")), store) as service:
        eventually(lambda: stored(store) == count_of(record))
        eventually(lambda: stored(store) - before <= service.health.deliveries)
    again = service.health.deliveries - (count_of(record) - before)
    assert again > 0
    expect_offline(store, record, turbine)
    nothing_is_left(broker)


def test_an_acknowledgement_of_a_lost_connection_acknowledges_nothing(broker: Mosquitto) -> None:
    """The new connection's messages bear the same identifiers as the old one's: they must stay
    unacknowledged."""
    stream = stream_of(broker)
    with running(stream) as taken, peer(broker) as other:
        publish(other, [(TOPIC, f"{i}") for i in range(5)])
        eventually(lambda: len(taken.found) == 5)
        broker.save()
        broker.kill()
        eventually(lambda: stream.state[0] == "lost")
        broker.start()
        eventually(lambda: len(taken.found) == 10)
        old, new = taken.found[:5], taken.found[5:]
        assert [one.content for one in new] == [one.content for one in old] == [b"0", b"1", b"2", b"3", b"4"]
        assert {one.acknowledge.args for one in old} == {one.acknowledge.args for one in new}
        stream.acknowledge(old)
        stream.acknowledge(new[:2])
        eventually(lambda: broker.log().count("PUBACK from tracker") == 2)
    with running(stream_of(broker)) as taken:
        eventually(lambda: len(taken.found) == 3)
        assert taken.contents == [b"2", b"3", b"4"]


def test_a_tracker_that_does_not_keep_up_stays_connected(
    broker: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    # long enough that neither side takes the other for lost on a machine that is busy for a second
    monkeypatch.setattr(mqtt, "KEEPALIVE_S", 4)
    stream = stream_of(broker)
    count = mqtt.MOST_UNACKNOWLEDGED + 300
    with running(stream, held=True) as taken, peer(broker) as other:
        publish(other, [(TOPIC, f"{i}") for i in range(count)])
        # the broker would send a client away after 1.5 times its keep-alive
        eventually(lambda: broker.log().count("PINGREQ from tracker") >= 2)
        assert stream.state[0] == "connected" and not taken.found
        assert stream._link.arrived.qsize() <= mqtt.MOST_UNACKNOWLEDGED
        taken.free.set()
        done = 0
        while done < count:
            eventually(lambda: len(taken.found) > done)  # noqa: B023
            found = taken.found[done:]
            stream.acknowledge(found)
            done += len(found)
        assert taken.contents == [f"{i}".encode() for i in range(count)]
        assert broker.log().count("as tracker") == 1


def test_what_nobody_confirms_is_bounded_and_told(broker: Mosquitto, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mqtt, "MOST_QUEUED_QOS_0", 10)
    stream = stream_of(broker)
    with running(stream, held=True) as taken, peer(broker) as other:
        publish(other, [(TOPIC, "0")], qos=0)
        eventually(stream._has_pending)  # it is taken, and held
        publish(other, [(TOPIC, f"{i}") for i in range(1, 50)], qos=0)
        eventually(lambda: "39 messages of QoS 0" in stream.state[1])
        assert stream.state[0] == "connected"
        taken.free.set()
        eventually(lambda: len(taken.found) == 11)
        stream.acknowledge(taken.found)
        assert taken.contents == [f"{i}".encode() for i in range(11)]


def test_a_stopped_source_takes_the_acknowledgements_that_are_still_to_come(broker: Mosquitto) -> None:
    stream = stream_of(broker)
    with running(stream) as taken, peer(broker) as other:
        publish(other, [(TOPIC, f"{i}") for i in range(5)])
        eventually(lambda: len(taken.found) == 5)
        stream.stop()
        publish(other, [(TOPIC, "later")])
        stream.acknowledge(taken.found)
        eventually(lambda: stream.state == ("stopped", ""))
        assert len(taken.found) == 5
    with running(stream_of(broker)) as taken:
        eventually(lambda: taken.found)
        assert taken.contents == [b"later"]


def test_messages_that_are_too_large_are_cut_or_stay_at_the_broker(
    broker: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mqtt, "LARGEST_PACKET", 3 * LARGEST_PAYLOAD)
    stream = stream_of(broker)
    with running(stream) as taken, peer(broker) as other:
        sizes = (3 * LARGEST_PAYLOAD, 2 * LARGEST_PAYLOAD, LARGEST_PAYLOAD, 10)
        publish(other, [(TOPIC, b"x" * size) for size in sizes])
        eventually(lambda: len(taken.found) == 3)
        assert [len(one) for one in taken.contents] == [LARGEST_PAYLOAD + 1, LARGEST_PAYLOAD, 10]
        with pytest.raises(Refused, match="at most") as fault:
            MAPPING.read(taken.contents[0], 0.0)
        assert fault.value.kind == "too large"
        stream.acknowledge(taken.found)
        publish(other, [(TOPIC, b"y")] * 20)
        eventually(lambda: len(taken.found) == 23)


def test_a_retained_message_comes_once(broker: Mosquitto) -> None:
    with peer(broker) as other:
        publish(other, [(TOPIC, "kept")], retain=True)
        stream = stream_of(broker)
        with running(stream) as taken:
            eventually(lambda: taken.found)
            stream.acknowledge(taken.found)
        again = stream_of(broker)
        with running(again, place="scada/#") as taken:
            publish(other, [(TOPIC, "new")])
            eventually(lambda: taken.found)
            assert taken.contents == [b"new"]


def test_topics_that_are_no_longer_asked_for_are_forgotten(broker: Mosquitto) -> None:
    with peer(broker) as other:
        with running(stream_of(broker, topics=("scada/a", "scada/b"))) as taken:
            publish(other, [("scada/a", "1")])
            eventually(lambda: taken.found)
            place = taken.found[0].place
        with running(stream_of(broker, topics=("scada/b",)), place=place) as taken:
            publish(other, [("scada/a", "2"), ("scada/b", "3")])
            eventually(lambda: taken.contents[-1:] == [b"3"])
            assert taken.contents == [b"1", b"3"]


def test_a_session_that_the_broker_lost_is_told(broker: Mosquitto, caplog: pytest.LogCaptureFixture) -> None:
    stream = stream_of(broker)
    with running(stream):
        assert "no session" not in caplog.text
        broker.kill()  # it had saved nothing
        eventually(lambda: stream.state[0] == "lost")
        broker.start()
        eventually(lambda: stream.state[0] == "connected")
        assert "the broker no longer has a session of this client_id" in caplog.text


# -- states in words -----------------------------------------------------------------------------------------
def test_a_broker_that_is_not_there_is_waited_for(tmp_path: Path) -> None:
    folder = tmp_path / "broker"
    folder.mkdir()
    found = Mosquitto(folder)
    stream = stream_of(found)
    with running(stream, until="lost"):
        assert stream.state[1].startswith(f"127.0.0.1:{found.port}: refused")
        try:
            found.start()
            eventually(lambda: stream.state[0] == "connected")
            assert "no message has arrived yet" in stream.state[1]
            with peer(found) as other:
                publish(other, [(TOPIC, "{}")])
            eventually(lambda: "no message has arrived yet" not in stream.state[1])
        finally:
            found.kill()


def test_a_name_that_is_not_resolved() -> None:
    stream = Mqtt(Broker("mqtt://no-such-host.invalid", ("a",), client_id="tracker"), MAPPING)
    with running(stream, until="lost"):
        assert "its name cannot be resolved" in stream.state[1]


def test_a_server_that_is_no_broker_is_told() -> None:
    """It listens and closes every connection; what is bound to it is told that no answer came."""
    import socket

    with socket.create_server(("127.0.0.1", 0)) as server:

        def closing() -> None:
            try:
                while True:
                    server.accept()[0].close()
            except OSError:
                pass

        runner = threading.Thread(target=closing)
        runner.start()
        stream = Mqtt(Broker(f"mqtt://127.0.0.1:{server.getsockname()[1]}", ("a",)), MAPPING)
        with running(stream, until="lost"):
            assert "TLS (mqtts://)?" in stream.state[1] or "closed the connection" in stream.state[1]
        server.shutdown(socket.SHUT_RDWR)
        runner.join(timeout=60.0)
        assert not runner.is_alive()


def test_user_and_password(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG")
    secret = tmp_path / "secret"
    secret.write_text("not it 4711\n")
    users = password_file(tmp_path, "reader", "right 0815")
    with mosquitto(tmp_path, "allow_anonymous false", f"password_file {users}") as found:
        stream = stream_of(found, user="reader", password_file=str(secret))
        with running(stream, until="lost"):
            assert "not authorised" in stream.state[1] or "password is wrong" in stream.state[1]
            # the file is read anew for every attempt
            secret.write_text("right 0815\n")
            eventually(lambda: stream.state[0] == "connected")
            secret.unlink()
            found.kill()
            found.start()
            eventually(lambda: "No such file" in stream.state[1])
    for shown in (caplog.text, stream.url, repr(stream.broker), repr(stream.state)):
        assert "4711" not in shown and "0815" not in shown and "reader@" not in shown


def test_another_client_with_the_same_name_is_told(broker: Mosquitto) -> None:
    first, second = stream_of(broker), stream_of(broker)
    with running(first), running(second):
        # a broker may say why, as MQTT 5 has it; mosquitto 2.0.11 closes the connection and says nothing
        eventually(
            lambda: any(one.state[0] == "lost" and "client_id" in one.state[1] for one in (first, second))
        )


def test_a_denied_subscription_is_lost_and_asked_for_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mqtt, "RESUBSCRIBE_S", 0.5)
    monkeypatch.setenv("BROKER_PASSWORD", "right")
    settings = dynamic_security(tmp_path, "reader", "right", denied="secret/#")
    with mosquitto(tmp_path, *settings) as found:
        stream = stream_of(
            found, user="reader", password_env="BROKER_PASSWORD", topics=("secret/#", "scada/#")
        )
        with running(stream, until="lost") as taken, peer(found, "reader", "right") as other:
            assert "denies a subscription (secret/#: not authorised" in stream.state[1]
            assert "scada/#" not in stream.state[1]
            publish(other, [(TOPIC, "what is granted still comes")])
            eventually(lambda: taken.found)
            assert stream.state[0] == "lost"
            eventually(lambda: found.log().count("SUBSCRIBE from tracker") >= 3)


def test_a_denial_that_looks_granted_is_hinted_at(tmp_path: Path) -> None:
    """An access list of mosquitto's denies the messages, not the subscription."""
    rights = tmp_path / "rights"
    rights.write_text("topic readwrite else/#\ntopic write scada/#\n")
    with mosquitto(tmp_path, "allow_anonymous true", f"acl_file {rights}") as found:
        stream = stream_of(found, topics=("scada/#", "else/#"))
        with running(stream) as taken, peer(found) as other:
            publish(other, [(TOPIC, "denied")])
            assert "no message has arrived yet" in stream.state[1] and "rights" in stream.state[1]
            publish(other, [("else/T1", "granted")])
            eventually(lambda: taken.found)
            assert taken.contents == [b"granted"]


def test_certificates(tmp_path: Path) -> None:
    """TLS with a CA of its own and client certificates; what is wrong with either is told in words."""
    own, other = authority(tmp_path), authority(tmp_path, "other")
    server, server_key = own.issue("server", "127.0.0.1")
    client, client_key = own.issue("client")
    old, old_key = own.issue("old", days=-1)
    alien, alien_key = other.issue("alien")
    settings = (
        "allow_anonymous true",
        f"cafile {own.file}",
        f"certfile {server}",
        f"keyfile {server_key}",
        "require_certificate true",
    )
    with mosquitto(tmp_path, *settings) as found:

        def stream(
            ca: Path | None, certificate: Path | None = None, key: Path | None = None, **more: object
        ) -> Mqtt:
            return stream_of(found, tls=True, ca=ca, certificate=certificate, key=key, **more)

        with running(stream(own.file, client, client_key)) as taken:
            assert stream(own.file).url.startswith("mqtts://127.0.0.1:")
            inner = stream(own.file, client, client_key, client_id="writer")
            with running(inner):
                inner._link.publish(TOPIC, b"sealed")
                eventually(lambda: taken.found)
        for told, words in (
            (
                stream(other.file, client, client_key),
                "a CA that is not trusted here: name the CA's file as ca",
            ),
            (stream(None, client, client_key), "its certificate is signed by"),
            (stream(own.file), "it requires a client certificate"),
            (stream(own.file, old, old_key), "the client certificate has expired"),
            (stream(own.file, alien, alien_key), "it does not trust the CA of the client certificate"),
            (stream_of(found), "TLS (mqtts://)?"),
        ):
            with running(told, until="lost"):
                assert words in told.state[1], told.state


@pytest.mark.parametrize(
    ("address", "days", "words"),
    [("127.0.0.2", 1, "its certificate is for another"), ("127.0.0.1", -1, "its certificate has expired")],
)
def test_a_server_whose_certificate_does_not_hold(
    tmp_path: Path, address: str, days: int, words: str
) -> None:
    own = authority(tmp_path)
    server, key = own.issue("server", address, days)
    settings = ("allow_anonymous true", f"cafile {own.file}", f"certfile {server}", f"keyfile {key}")
    with mosquitto(tmp_path, *settings) as found:
        stream = stream_of(found, tls=True, ca=own.file)
        with running(stream, until="lost"):
            assert words in stream.state[1]


def test_a_backlog_over_tls_is_taken_in_at_once(tmp_path: Path) -> None:
    """The broker sends every message in a record of its own; all that have arrived are read in one turn."""
    own, plain = authority(tmp_path), free_port()
    server, key = own.issue("server", "127.0.0.1")
    sealed = ("allow_anonymous true", f"cafile {own.file}", f"certfile {server}", f"keyfile {key}")
    with mosquitto(tmp_path, *sealed, f"listener {plain} 127.0.0.1") as found:
        stream = stream_of(found, tls=True, ca=own.file)
        with running(stream):
            pass  # the broker keeps the session
        with peer(plain) as publisher:
            publish(publisher, [(TOPIC, b"%d" % number) for number in range(2_000)])
        stream, taken, began = stream_of(found, tls=True, ca=own.file), [], time.monotonic()

        def put(one: Delivery) -> None:
            taken.append(one)
            stream.acknowledge([one])

        stream.start(None, put)
        try:
            eventually(lambda: len(taken) == 2_000)
            assert time.monotonic() - began < 12.0  # a record a turn takes 40 s and more
        finally:
            stream.stop()
    assert [one.content for one in taken] == [b"%d" % number for number in range(2_000)]


def test_tls_to_a_broker_without_it(broker: Mosquitto) -> None:
    stream = stream_of(broker, tls=True)
    with running(stream, until="lost"):
        assert "TLS" in stream.state[1]


# -- alarms --------------------------------------------------------------------------------------------------
def kept(found: Mosquitto, topic: str) -> dict[str, dict]:
    """What a broker has retained: topic -> content."""
    with peer(found) as other:
        heard = overheard(other, topic, "mark")
        publish(other, [("mark", b"")])  # comes after all that is retained
        eventually(lambda: heard and heard[-1].topic == "mark")
        return {one.topic: json.loads(one.payload) for one in heard if one.retain}


def changed(alarm: Alarm, **changes: object) -> Alarm:
    return Alarm(**(vars(alarm) | changes))


def test_alarms_are_published_retained_and_nothing_else_ever_is(
    tmp_path: Path, broker: Mosquitto, record: Record, turbine: Turbine, messages: Sequence[tuple[str, str]]
) -> None:
    """With a service that reads every topic there is: what it told itself is no reading."""
    store = f"sqlite:{tmp_path / 'live.db'}"
    stream = stream_of(broker, record_mapping(record, "T1"), topics=("#",), alarms="plant/alarms")
    some = messages[:300]
    with peer(broker) as watching, serving(turbine, stream, store) as service, peer(broker) as other:
        heard = overheard(watching, "#")
        stream.tell([ALARM])
        eventually(lambda: heard)
        publish(other, some[:150])
        stream.tell(
            [changed(ALARM, severity="alarm"), changed(ALARM, turbine="a/b +#", id="x", kind="data stale")]
        )
        stream.tell([changed(ALARM, severity="alarm", ended=1.7e9)])
        eventually(lambda: len(heard) == 150 + 4)
        publish(other, some[150:])
        eventually(lambda: len(heard) == len(some) + 4 and service.health.deliveries == len(some))
        assert {one.topic for one in heard} == {
            TOPIC,
            "plant/alarms/T1/condensation",
            "plant/alarms/a%2Fb%20%2B%23/data_stale",
        }
        opened = open_store(store)
        assert opened.counters() == {}
        opened.close()
    found = kept(broker, "plant/alarms/+/+")
    assert set(found) == {"plant/alarms/T1/condensation", "plant/alarms/a%2Fb%20%2B%23/data_stale"}
    last = found["plant/alarms/T1/condensation"]
    assert (last["began"], last["ended"], last["severity"]) == (1.6e9, 1.7e9, "alarm")
    assert last["id"] == ALARM.id and last["remedy"] == "pre-heat" and last["statement"] == "water condenses"
    assert found["plant/alarms/a%2Fb%20%2B%23/data_stale"]["ended"] is None


def test_alarms_of_one_kind_have_a_topic_each(broker: Mosquitto) -> None:
    subjects = ("thermal_time_constant", "hygric_k")
    stream = stream_of(broker, alarms="alarms")
    with running(stream):
        stream.tell(changed(ALARM, kind="cabinet changed", subject=one) for one in subjects)
        stream.tell(changed(ALARM, turbine=f"N{i}") for i in range(60))  # more than paho sends at once
        eventually(lambda: not stream._has_pending())
    assert set(kept(broker, "alarms/#")) == {
        "alarms/T1/cabinet_changed_thermal_time_constant",
        "alarms/T1/cabinet_changed_hygric_k",
        *(f"alarms/N{i}/condensation" for i in range(60)),
    }


def test_alarms_told_without_a_connection_are_published_later_the_last_word_last(broker: Mosquitto) -> None:
    stream = stream_of(broker, alarms="alarms")
    with running(stream):
        broker.stop()
        eventually(lambda: stream.state[0] == "lost")
        for severity in ("notice", "warning", "alarm"):
            stream.tell([changed(ALARM, severity=severity)])
        broker.start()
        eventually(lambda: stream.state[0] == "connected")
        stream.stop()  # waits until they are confirmed
        eventually(lambda: stream.state[0] == "stopped")
    assert kept(broker, "alarms/#")["alarms/T1/condensation"]["severity"] == "alarm"


def test_alarms_are_off_unless_a_topic_is_named(broker: Mosquitto) -> None:
    stream = stream_of(broker)
    with peer(broker) as other:
        heard = overheard(other, "#")
        with running(stream):
            stream.tell([ALARM])
        publish(other, [("end", b"")])
        eventually(lambda: heard)
        assert [one.topic for one in heard] == ["end"]


def test_alarms_that_the_broker_does_not_take_are_told(tmp_path: Path) -> None:
    rights = tmp_path / "rights"
    rights.write_text("topic read #\ntopic write scada/#\n")
    with mosquitto(tmp_path, "allow_anonymous true", f"acl_file {rights}") as found:
        stream = stream_of(found, alarms="alarms")
        with running(stream):
            stream.tell([ALARM])
            eventually(lambda: "the broker refuses alarms below alarms: not authorised" in stream.state[1])
            assert stream.state[0] == "connected"
