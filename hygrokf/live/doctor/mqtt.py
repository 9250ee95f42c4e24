"""Checks of an MQTT broker from the tracker's point of view: connection, permissions, and messages within a
given time; and of Sparkplug edge nodes on it: whether births explain what arrives.

The doctor listens in its own temporary session and neither takes over the tracker's session nor reads from
it.
"""

from __future__ import annotations

import queue
import secrets
import ssl
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from hygrokf.live.doctor.check import (
    SECRETS,
    Check,
    doubt,
    fault,
    lasting,
    ok,
    payload_checks,
    stamp_check,
    unread_certificate,
    validities,
    validity_check,
)
from hygrokf.live.sources.broker import Broker, unreachable
from hygrokf.live.sources.mqtt import Mqtt
from hygrokf.live.sources.mqtt_link import Link
from hygrokf.live.sources.payload import PayloadStatistics
from hygrokf.live.sources.payload_formats import Content, Unreadable
from hygrokf.live.sources.sparkplug import ASK, EdgeNodes, Sparkplug
from hygrokf.live.sources.sparkplug_node import UNEXPLAINED
from hygrokf.live.sources.stream import SourceFault, several

if TYPE_CHECKING:
    from paho.mqtt.client import Client, MQTTMessage

ANSWER_S = 10.0
"""[s] allowed for a broker to accept the client and answer its subscription."""
REACH = "check url, user, password and certificates of this [[source]], and that the broker runs"
KEPT = (
    "edge nodes publish at QoS 0: let the broker keep it for sessions (mosquitto: queue_qos0_messages true)"
)
SILENT = "check topic, publisher and the rights of this user; wait longer (--wait 10min) if messages are rare"


class Listener(Link):
    """A link that keeps each message as it is and acknowledges it at once, because nobody else uses this
    session.

    `messages`: (message, time of arrival [s]), and None once the link is lost.
    """

    def __init__(self, broker: Broker) -> None:
        self.messages: queue.SimpleQueue[tuple[MQTTMessage, float] | None] = queue.SimpleQueue()
        super().__init__(broker, (), lambda link: None)

    def lose(self, reason: str) -> None:
        super().lose(reason)
        self.messages.put(None)

    def _on_message(self, client: Client, userdata: object, message: MQTTMessage) -> None:
        self.acknowledge(message.mid if message.qos else None)
        with suppress(UnicodeDecodeError):
            if not self.is_own(message.topic):
                self.messages.put((message, time.time()))


def mqtt_checks(
    source: Mqtt,
    statistics: PayloadStatistics,
    wait_s: float,
    lateness_s: float,
    contents: Callable[[str, bytes, float], Sequence[Content]] | None = None,
    keep: str = "publish at QoS 1",
) -> Iterator[Check]:
    """Connect, subscribe and listen for `wait_s` [s]; messages that are not retained also go into the
    statistics.

    contents: gives the payloads of a message (topic, payload, time of arrival [s]), None for the reader of
    the source; `keep`: what to do where the broker does not keep the messages.
    """
    broker, mapping = source.broker, source.mapping
    about = f"source {source.url}"
    for caution in broker.cautions():
        if not caution.startswith(SECRETS):  # `file_checks` reports these
            yield doubt(about, *caution.split(": ", 1))
    with listening(doctor_session(broker)) as link:
        if link.lost.is_set() or not link.answered:
            reason = link.reason or f"{broker.where} has not answered within {ANSWER_S:g} s"
            yield fault(about, reason, REACH)
            return
        user = f" as user {broker.user_name}" if broker.user_name else ""
        yield ok(about, f"connected{' by TLS' * broker.tls}{user}")
        yield from _certificate(link, about)
        retained, read = PayloadStatistics(mapping), contents or source.reader()

        def take(message: MQTTMessage, came: float) -> None:
            payload = bytes(message.payload[: source.largest + 1])
            for content in read(message.topic, payload, came):
                (retained if message.retain else statistics).take(content, came, message.topic)

        heard = _count_messages(link, take, wait_s)
        if link.lost.is_set():
            yield fault(about, f"the connection was lost: {link.reason}", REACH)
        denied = link.denied
    for topics, one in heard.items():
        yield _filter_check(f"{about} {topics}", one, denied.get(topics), wait_s, keep)
    if retained.payloads and not statistics.payloads:
        yield from payload_checks(f"{about} retained messages", retained)
    yield from payload_checks(about, statistics)
    found = stamp_check(about, statistics.lag_s, lateness_s)
    if found is not None and not mapping.weather:
        yield found


def doctor_session(broker: Broker) -> Broker:
    """The broker with the doctor's own session, which ends with the connection.

    A shared subscription is replaced by a plain one, because messages dealt to it would be missing elsewhere.
    """
    topics = tuple(dict.fromkeys(plain_filter(one) for one in broker.topics))
    own = f"hygrokf-doctor-{secrets.token_hex(4)}"
    return replace(broker, client_id=own, session_expiry_s=0.0, topics=topics)


def plain_filter(topics: str) -> str:
    """A topic filter without its share: FILTER of $share/GROUP/FILTER."""
    return topics.split("/", 2)[2] if topics.startswith("$share/") else topics


@contextmanager
def listening(broker: Broker) -> Iterator[Listener]:
    """A link within this context, once the broker has answered the subscription or the link is lost."""
    link = Listener(broker)
    try:
        try:
            link.open()
        except SourceFault as error:
            link.lose(str(error))
        except Exception as error:  # of any kind: it is reported
            link.lose(unreachable(error, broker.where))
        end = time.monotonic() + ANSWER_S
        while not (link.answered or link.lost.is_set()) and time.monotonic() < end:
            link.lost.wait(0.02)
        yield link
    finally:
        link.close()


def _certificate(link: Link, about: str) -> Iterator[Check]:
    """Check the validity of the broker's certificate."""
    socket = link.client.socket()
    shown = socket.getpeercert(binary_form=True) if isinstance(socket, ssl.SSLSocket) else None
    if shown:
        where = "the broker's certificate"
        try:
            yield validity_check(about, validities(shown)[0], where)
        except ImportError:
            yield unread_certificate(about, where)


def _count_messages(
    link: Listener, take: Callable[[MQTTMessage, float], None], wait_s: float
) -> dict[str, Counter[str]]:
    """Take messages with their times of arrival [s] for `wait_s` [s]; returns their numbers under each
    filter: "live", of these "unkept" (published at QoS 0), and "retained"."""
    from paho.mqtt.client import topic_matches_sub

    heard = {topics: Counter[str]() for topics in link.broker.topics}
    end = time.monotonic() + wait_s
    while (left := end - time.monotonic()) > 0.0:
        with suppress(queue.Empty):
            found = link.messages.get(timeout=left)
            if found is None:
                break
            message, came = found
            for topics, one in heard.items():
                if topic_matches_sub(topics, message.topic):
                    one["retained" if message.retain else "live"] += 1
                    one["unkept"] += not message.retain and message.qos == 0
            take(message, came)
    return heard


def _filter_check(about: str, one: Counter[str], denied: str | None, wait_s: float, keep: str) -> Check:
    within = f"within {lasting(wait_s)}"
    if denied is not None:
        return fault(
            about,
            f"the broker denies the subscription: {denied}",
            "give this user the right to read the topic",
        )
    if one["live"] and one["unkept"]:
        return doubt(
            about,
            f"{one['live']} messages {within}, {one['unkept']} of them published at QoS 0, which the broker "
            "does not keep while the tracker is not running",
            keep,
        )
    if one["live"]:
        return ok(about, f"granted; {one['live']} messages {within}")
    if one["retained"]:
        return doubt(
            about, f"granted; nothing new {within}, only {one['retained']} retained messages", SILENT
        )
    return doubt(
        about, f"granted, but no message arrived {within}: a broker may grant and deliver nothing", SILENT
    )


# -- Sparkplug -----------------------------------------------------------------------------------------------
def sparkplug_checks(
    source: Sparkplug, statistics: PayloadStatistics, wait_s: float, lateness_s: float
) -> Iterator[Check]:
    """The checks of the broker, then those of the edge nodes heard within `wait_s` [s].

    The doctor knows only births within this time, so that it does not judge values by other aliases.
    """
    nodes = EdgeNodes()
    read = source.reader(nodes)

    def contents(topic: str, payload: bytes, received: float) -> Sequence[Content]:
        found = read(topic, payload, received)
        return [one for one in found if not (isinstance(one, Unreadable) and one.kind in UNEXPLAINED)]

    yield from mqtt_checks(source, statistics, wait_s, lateness_s, contents, KEPT)
    for node in nodes.nodes.values():
        node.look(time.time())
    about = f"source {source.url}"
    within = f"within {lasting(wait_s)}"
    gaps = [name for name, node in nodes.nodes.items() if node.gap_s is not None]
    unborn = [name for name in nodes.without_birth() if name not in gaps]
    left = [name for name, node in nodes.nodes.items() if "" in node.left_s]
    sound = [name for name in nodes.nodes if name not in (*gaps, *unborn, *left)]
    if sound:
        yield ok(about, f"every message is explained, of edge nodes {several(sound)}")
    if gaps:
        yield doubt(
            about,
            f"messages are missing in the sequence of {several(gaps)}",
            "look for a bad connection of the edge node, and for two that bear one name",
        )
    if unborn:
        yield doubt(
            about,
            f"values came by aliases, but no birth certificate {within}, of {several(unborn)}",
            f"if the tracker does not know these either: {ASK}, or set rebirth_requests = true",
        )
    if left:
        yield doubt(about, f"a death certificate came {within}, of {several(left)}", "check the edge node")
