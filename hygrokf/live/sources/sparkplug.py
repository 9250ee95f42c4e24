"""Sparkplug B on an MQTT broker as a source: edge nodes with their births, data and deaths.

The store keeps the definitions of the birth certificates together with the readings, because a broker does
not repeat the certificates after a restart of the tracker.  With `rebirth_requests` the tracker asks an edge
node for its birth certificates when it needs them; apart from these requests, it publishes only alarms.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from hygrokf.data.structured import JsonObject
from hygrokf.data.toml_form import Place
from hygrokf.live.sources.broker import SPARKPLUG, Broker
from hygrokf.live.sources.mqtt import Arrival, BrokerLink, Mqtt, libraries_fault
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.payload_formats import Content, Payload, PayloadRecord, Refused, Unreadable
from hygrokf.live.sources.sparkplug_node import NAMESPACE, Arrived, EdgeNode, Released, address_of
from hygrokf.live.sources.sparkplug_payload import LARGEST_MESSAGE, decode, rebirth_request
from hygrokf.live.sources.stream import Delivery, SourceState
from hygrokf.texts.doctor_codes import ASK_REBIRTH
from hygrokf.texts.live_codes import AlarmCode
from hygrokf.texts.statement import Statement
from hygrokf.texts.wording import several, stamp_text

LOG = logging.getLogger("hygrokf.track")
MOST_NODES = 1_000
"""Largest number of edge nodes that are followed."""
CHECK_INTERVAL_S = 0.5
"""Time [s] between two checks for messages that have waited too long, and for edge nodes without births."""
REQUEST_INTERVAL_S = 60.0
"""Time [s] after which the tracker repeats a rebirth request to an edge node."""
DEVICE_INDEX = 4
"""Index of the device among the levels of a topic."""
DEVICE_LEVEL = f"{{{DEVICE_INDEX}}}"
"""Path of the turbine in a mapping where each device is a turbine."""
_OF_NO_DEVICE = Unreadable("of no device", "metrics of an edge node itself, although turbines are devices")


class EdgeNodes:
    """All edge nodes of a source by name (GROUP/NODE)."""

    def __init__(self) -> None:
        self.nodes: dict[str, EdgeNode] = {}

    def take(
        self,
        topic: str,
        payload: bytes,
        received: float,
        acknowledge: Callable[[], None] | None = None,
        repeated: bool = False,
    ) -> tuple[EdgeNode | None, list[Released]]:
        """Process a message received at a time [s]; returns its edge node and the messages that it releases.

        acknowledge: call that acknowledges the message to the broker.  repeated: whether the broker marks it
        as sent again.  Commands, and states of host applications, have neither an edge node nor contents.
        """
        try:
            address = address_of(topic)
            if address is None:
                return None, [Released((), topic, received, acknowledge)]
            node = self.nodes.get(address.edge_node)
            if node is None:
                if len(self.nodes) >= MOST_NODES:
                    raise Refused("too many edge nodes", f"at most {MOST_NODES} edge nodes are followed")
                node = EdgeNode(address.edge_node)
            message = decode(payload)
        except Refused as fault:
            return None, [Released((Unreadable(fault.kind, str(fault)),), topic, received, acknowledge)]
        self.nodes[node.name] = node
        return node, node.take(Arrived(address, topic, message, payload, received, acknowledge, repeated))

    def recall(self, memories: JsonObject) -> None:
        """Restore all edge nodes from their stored `EdgeNode.memories`."""
        prefix = "edge node "
        for key, content in memories.items():
            if key.startswith(prefix) and len(self.nodes) < MOST_NODES:
                name = key.removeprefix(prefix)
                self.nodes[name] = EdgeNode.recalled(name, memories.get(f"sequence of {name}"), content)

    def without_birth(self) -> list[str]:
        """Return the names of edge nodes with aliases that only a birth certificate can define."""
        nodes = tuple(self.nodes.items())
        return [name for name, node in nodes if node.gap_s is not None or node.unborn]


def data_topic(name: str, device: str) -> str:
    """Return the topic of a device's data, or of the edge node `name` (GROUP/NODE) itself if `device` is
    ""."""
    group, _, node = name.partition("/")
    return f"{NAMESPACE}/{group}/DDATA/{node}/{device}" if device else f"{NAMESPACE}/{group}/NDATA/{node}"


class Sparkplug(Mqtt):
    """A source of the edge nodes whose topics match the broker's filters."""

    largest = LARGEST_MESSAGE

    def __init__(self, broker: Broker, mapping: PayloadMapping) -> None:
        flat = mapping.for_flat_payloads(mapping.use_uncertain, mapping.turbines)
        named = replace(flat, turbine=mapping.turbine, tag_pattern=mapping.tag_pattern, names=mapping.names)
        super().__init__(broker, named)
        self.edge_nodes = EdgeNodes()
        self._requested_s: dict[str, float] = {}
        self._checked_s = 0.0

    def recall(self, memories: JsonObject) -> None:
        """Restore the edge nodes from the store."""
        self.edge_nodes.recall(memories)

    # -- the source's own thread -----------------------------------------------------------------------------
    def _take(self, link: BrokerLink, arrival: Arrival, put: Callable[[Delivery], None]) -> None:
        """Process a message and deliver what it releases; acknowledge it at once if it has no contents."""
        acknowledge = partial(link.acknowledge, arrival.identifier)
        node, released = self.edge_nodes.take(
            arrival.topic, arrival.payload, arrival.time, acknowledge, arrival.repeated
        )
        if node is None and not released[0].contents:
            acknowledge()
        else:
            self._put_released(node, released, put)

    def _do_periodic_work(self, link: BrokerLink, put: Callable[[Delivery], None]) -> None:
        """Release messages whose predecessors are overdue; request missing birth certificates."""
        if time.monotonic() < self._checked_s + CHECK_INTERVAL_S:
            return
        self._checked_s = time.monotonic()
        for node in self.edge_nodes.nodes.values():
            self._put_released(node, node.release_overdue(time.time()), put)
        if self.broker.rebirth_requests and link.answered:
            for name in self.edge_nodes.without_birth():
                if self._checked_s > self._requested_s.get(name, -REQUEST_INTERVAL_S) + REQUEST_INTERVAL_S:
                    self._requested_s[name] = self._checked_s
                    group, _, node_id = name.partition("/")
                    link.request(f"{NAMESPACE}/{group}/NCMD/{node_id}", rebirth_request(time.time()))
                    LOG.info("asked for a rebirth", extra={"source": self.url, "edge_node": name})

    def _put_released(
        self, node: EdgeNode | None, released: list[Released], put: Callable[[Delivery], None]
    ) -> None:
        """Deliver released messages; the last one carries the state of the edge node for the store."""
        for number, message in enumerate(released, 1):
            # the stored data describe the edge node after the last of the released messages
            memories = node.memories() if node is not None and number == len(released) else None
            self._put(
                self.contents(message), message.received, message.topic, message.acknowledge, put, memories
            )

    def read(self, arrival: Arrival) -> Sequence[Content]:
        """Return the contents that a message releases, without delivering them."""
        _, released = self.edge_nodes.take(arrival.topic, arrival.payload, arrival.time)
        return [content for message in released for content in self.contents(message)]

    def contents(self, message: Released) -> Sequence[Payload | Unreadable]:
        """Return the contents; if devices are turbines, an edge node's own metrics are refused."""
        if self.mapping.turbine != DEVICE_LEVEL or message.topic.count("/") >= DEVICE_INDEX:
            return message.contents
        return [content if isinstance(content, Unreadable) else _OF_NO_DEVICE for content in message.contents]

    # -- state -----------------------------------------------------------------------------------------------
    def _absences(self) -> list[tuple[str, str, float]]:
        """Return (name, data topic, time of death [s]) of each offline edge node or device."""
        nodes = tuple(self.edge_nodes.nodes.items())
        return [
            (f"{name}/{device}" if device else name, data_topic(name, device), since)
            for name, node in nodes
            for device, since in tuple(node.left_s.items())
        ]

    def departed_senders(self) -> dict[str, Statement]:
        """Return turbine -> statement that its edge node or device is offline; only for turbines that the
        topic names and that no present edge node or device sends for."""
        statements: dict[str, Statement] = {}
        nodes = tuple(self.edge_nodes.nodes.items())
        present = {
            self._turbine(data_topic(name, device)) for name, node in nodes for device in tuple(node.present)
        }
        for sender, topic, since in self._absences():
            turbine = self._turbine(topic)
            if turbine is not None and turbine not in present:
                statements[turbine] = AlarmCode.SENDER_LEFT(sender=sender, at=since)
        return statements

    def _turbine(self, topic: str) -> str | None:
        """Return the turbine that the topic names, or the only turbine; None for an unknown name."""
        mapping = self.mapping
        if not mapping.turbine:
            return mapping.only_turbine
        return mapping.turbines.get(str(mapping.readers["turbine"](PayloadRecord((), topic=topic))))

    @property
    def state(self) -> SourceState:
        """The state of the link; "lost" also if all edge nodes are offline."""
        link_state = super().state
        if link_state.word != "connected":
            return link_state
        nodes = tuple(self.edge_nodes.nodes.values())
        all_offline = bool(nodes) and all("" in node.left_s for node in nodes)
        notes = [link_state.explanation, *self._notes()]
        return SourceState("lost" if all_offline else "connected", "; ".join(notes))

    def _notes(self) -> list[str]:
        """Return remarks about offline edge nodes, and about those that need a birth certificate."""
        absent = [f"{sender} since {stamp_text(since)}" for sender, _, since in self._absences()]
        notes = (
            [f"offline by a death certificate; signals stay stale until the next birth: {several(absent)}"]
            if absent
            else []
        )
        if waiting := self.edge_nodes.without_birth():
            remedy = (
                "the tracker has asked for a rebirth"
                if self.broker.rebirth_requests
                else (f"ask for a rebirth: {ASK_REBIRTH}, or set rebirth_requests = true")
            )
            notes.append(
                f"aliases without a valid birth certificate are not read: {several(waiting)}: {remedy}"
            )
        return notes


@dataclass(frozen=True)
class MqttForm(Broker):
    """A [[source]] of a broker: payloads for the mapping, or Sparkplug B."""

    def stream(self, mapping: PayloadMapping, place: Place) -> Mqtt:
        """Return the stream; unreadable secrets and certificates are reported as faults at `place`."""
        if (missing := libraries_fault()) is not None:
            place.fault(missing)
        if not place.faults:
            self.expect(place, self.password.read, self.context)
        return (Sparkplug if self.format == SPARKPLUG else Mqtt)(self, mapping)
