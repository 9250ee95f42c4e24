"""Checks of Sparkplug edge nodes: those of their broker, and whether births explain what arrives."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

from hygrokf.live.doctor.check import Check, doubt, lasting, ok
from hygrokf.live.doctor.mqtt import mqtt_checks
from hygrokf.live.sources.payload_formats import Content, Unreadable
from hygrokf.live.sources.payload_statistics import PayloadStatistics
from hygrokf.live.sources.sparkplug import ASK, EdgeNodes, Sparkplug
from hygrokf.live.sources.sparkplug_node import UNEXPLAINED
from hygrokf.live.sources.stream import several

KEPT = (
    "edge nodes publish at QoS 0: let the broker keep it for sessions (mosquitto: queue_qos0_messages true)"
)


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
