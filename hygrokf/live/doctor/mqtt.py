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
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import TypeAlias

from hygrokf.live.doctor.check import (
    SECRETS,
    Check,
    doubt,
    fault,
    lasting,
    of_names,
    ok,
    payload_checks,
    validity_check,
)
from hygrokf.live.sources.broker import Broker, unreachable
from hygrokf.live.sources.mqtt import Mqtt
from hygrokf.live.sources.mqtt_link import Arrival, Link
from hygrokf.live.sources.payload import PayloadStatistics
from hygrokf.live.sources.payload_formats import Unreadable
from hygrokf.live.sources.sparkplug import ASK, EdgeNodes, Sparkplug
from hygrokf.live.sources.sparkplug_node import UNEXPLAINED
from hygrokf.live.sources.stream import SourceFault

ANSWER_S = 10.0
"""[s] allowed for a broker to accept the client and answer its subscription."""
REACH = "check url, user, password and certificates of this [[source]], and that the broker runs"
KEPT = (
    "edge nodes publish at QoS 0: let the broker keep it for sessions (mosquitto: queue_qos0_messages true)"
)
SILENT = "check topic, publisher and the rights of this user; wait longer (--wait 10min) if messages are rare"


Look: TypeAlias = Generator[Check, None, str]
"""The checks of a source; it returns the name of what it has read."""


def mqtt_checks(source: Mqtt, statistics: PayloadStatistics, wait_s: float) -> Look:
    """Connect, subscribe and listen for `wait_s` [s]; messages that are not retained also go into the
    statistics.

    Of edge nodes only births within this time are known, so that values by other aliases are not judged.
    """
    broker, about = source.broker, f"source {source.url}"
    for caution in broker.cautions():
        if not caution.startswith(SECRETS):  # `file_checks` reports these
            yield doubt(about, *caution.split(": ", 1))
    with listening(doctor_session(broker), source.largest) as link:
        if link.lost.is_set() or not link.answered:
            raise SourceFault(link.reason or f"{broker.where} has not answered within {ANSWER_S:g} s")
        user = f" as user {broker.user_name}" if broker.user_name else ""
        yield ok(about, f"connected{' by TLS' * broker.tls}{user}")
        yield from _certificate(link, about)
        retained = PayloadStatistics(source.mapping)

        from paho.mqtt.client import topic_matches_sub

        heard = {topics: Counter[str]() for topics in link.broker.topics}
        for arrival in arrivals(link, wait_s):
            for topics, one in heard.items():
                if topic_matches_sub(topics, arrival.topic):
                    one["retained" if arrival.retained else "live"] += 1
                    one["unkept"] += not arrival.retained and arrival.identifier is None
            for content in source.read(arrival):
                if isinstance(content, Unreadable) and content.kind in UNEXPLAINED:
                    continue
                (retained if arrival.retained else statistics).take(content, arrival.time, arrival.topic)
        if link.lost.is_set():
            yield fault(about, f"the connection was lost: {link.reason}", REACH)
        denied = link.denied
    keep = KEPT if isinstance(source, Sparkplug) else "publish at QoS 1"
    for topics, one in heard.items():
        yield _filter_check(f"{about} {topics}", one, denied.get(topics), wait_s, keep)
    if retained.payloads and not statistics.payloads:
        yield from payload_checks(f"{about} retained messages", retained)
    if isinstance(source, Sparkplug):
        yield from _edge_node_checks(about, source.edge_nodes, f"within {lasting(wait_s)}")
    return "payloads"


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
def listening(broker: Broker, largest: int) -> Iterator[Link]:
    """A link within this context, once the broker has answered the subscription or the link is lost;
    `largest`: payload [bytes] from which the rest is cut off."""
    link = Link(broker, largest)
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
    socket = link.client.socket()
    shown = socket.getpeercert(binary_form=True) if isinstance(socket, ssl.SSLSocket) else None
    if shown:
        yield validity_check(about, shown, "the broker's certificate")


def arrivals(link: Link, wait_s: float) -> Iterator[Arrival]:
    """The messages of the doctor's session within a time [s], or until the link is lost; they are
    acknowledged at once, because nobody else uses this session."""
    end = time.monotonic() + wait_s
    while (left := end - time.monotonic()) > 0.0:
        with suppress(queue.Empty):
            arrival = link.arrived.get(timeout=left)
            if arrival is None:
                return
            link.acknowledge(arrival.identifier)
            yield arrival


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


def _edge_node_checks(about: str, nodes: EdgeNodes, within: str) -> Iterator[Check]:
    for node in nodes.nodes.values():
        node.look(time.time())
    gaps = [name for name, node in nodes.nodes.items() if node.gap_s is not None]
    unborn = [name for name in nodes.without_birth() if name not in gaps]
    left = [name for name, node in nodes.nodes.items() if "" in node.left_s]
    sound = [name for name in nodes.nodes if name not in (*gaps, *unborn, *left)]
    yield from of_names(
        about,
        ("ok", sound, "every message is explained, of edge nodes {}", ""),
        (
            "doubt", gaps, "messages are missing in the sequence of {}",
            "look for a bad connection of the edge node, and for two that bear one name",
        ),
        (
            "doubt", unborn, f"values came by aliases, but no birth certificate {within}, of {{}}",
            f"if the tracker does not know these either: {ASK}, or set rebirth_requests = true",
        ),
        ("doubt", left, f"a death certificate came {within}, of {{}}", "check the edge node"),
    )  # fmt: skip
