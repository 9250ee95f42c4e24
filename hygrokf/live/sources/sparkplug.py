"""Sparkplug B on an MQTT broker as a source: edge nodes with their births, data and deaths.

What the births define is kept in the store together with the readings, because a broker does not repeat them
after a restart of the tracker.  With `rebirth_requests` an edge node is asked for its birth certificates when
they are needed; nothing else is published here but alarms.
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
"""Edge nodes that are followed."""
LOOK_S = 0.5
"""[s] between two looks for messages that wait in vain, and for edge nodes to be asked."""
ASK_AGAIN_S = 60.0
"""[s] after which an edge node is asked again."""
DEVICE_PLACE = 4
"""Place of the device in a topic."""
DEVICE_LEVEL = f"{{{DEVICE_PLACE}}}"
"""The mapping's turbine where each device is one."""
_OF_NO_DEVICE = Unreadable("of no device", "metrics of an edge node itself, while turbines are devices")


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
        """The edge node of a message received at a time [s], and what the message releases.

        Commands, and states of host applications, have neither an edge node nor contents.
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
        """Resume from what `EdgeNode.memories` gave."""
        prefix = "edge node "
        for key, content in memories.items():
            if key.startswith(prefix) and len(self.nodes) < MOST_NODES:
                name = key.removeprefix(prefix)
                self.nodes[name] = EdgeNode.recalled(name, memories.get(f"sequence of {name}"), content)

    def without_birth(self) -> list[str]:
        """Names of edge nodes whose aliases only a birth certificate can explain."""
        nodes = tuple(self.nodes.items())
        return [name for name, node in nodes if node.gap_s is not None or node.unborn]


def data_topic(name: str, device: str) -> str:
    """The topic at which an edge node (GROUP/NODE) publishes data of a device, "" for its own."""
    group, _, node = name.partition("/")
    return f"{NAMESPACE}/{group}/DDATA/{node}/{device}" if device else f"{NAMESPACE}/{group}/NDATA/{node}"


class Sparkplug(Mqtt):
    """The edge nodes below some topics of a broker."""

    largest = LARGEST_MESSAGE

    def __init__(self, broker: Broker, mapping: PayloadMapping) -> None:
        own = mapping.of_own_payloads(mapping.use_uncertain, mapping.turbines)
        named = replace(own, turbine=mapping.turbine, tag_pattern=mapping.tag_pattern, names=mapping.names)
        super().__init__(broker, named)
        self.edge_nodes = EdgeNodes()
        self._asked: dict[str, float] = {}
        self._looked = 0.0

    def recall(self, memories: JsonObject) -> None:
        self.edge_nodes.recall(memories)

    # -- the source's own thread -----------------------------------------------------------------------------
    def _take(self, link: BrokerLink, found: Arrival, put: Callable[[Delivery], None]) -> None:
        acknowledge = partial(link.acknowledge, found.identifier)
        node, released = self.edge_nodes.take(
            found.topic, found.payload, found.time, acknowledge, found.repeated
        )
        if node is None and not released[0].contents:
            acknowledge()
        else:
            self._put_released(node, released, put)

    def _look_after(self, link: BrokerLink, put: Callable[[Delivery], None]) -> None:
        """Release messages that wait in vain for those before them; ask for births."""
        if time.monotonic() < self._looked + LOOK_S:
            return
        self._looked = time.monotonic()
        for node in self.edge_nodes.nodes.values():
            self._put_released(node, node.look(time.time()), put)
        if self.broker.rebirth_requests and link.answered:
            for name in self.edge_nodes.without_birth():
                if self._looked > self._asked.get(name, -ASK_AGAIN_S) + ASK_AGAIN_S:
                    self._asked[name] = self._looked
                    group, _, node_id = name.partition("/")
                    link.request(f"{NAMESPACE}/{group}/NCMD/{node_id}", rebirth_request(time.time()))
                    LOG.info("asked for a rebirth", extra={"source": self.url, "edge_node": name})

    def _put_released(
        self, node: EdgeNode | None, released: list[Released], put: Callable[[Delivery], None]
    ) -> None:
        for place, one in enumerate(released, 1):
            # the data to keep describe the edge node after all that is released
            memories = node.memories() if node is not None and place == len(released) else None
            self._put(self.contents(one), one.received, one.topic, one.acknowledge, put, memories)

    def read(self, arrival: Arrival) -> Sequence[Content]:
        _, released = self.edge_nodes.take(arrival.topic, arrival.payload, arrival.time)
        return [content for one in released for content in self.contents(one)]

    def contents(self, one: Released) -> Sequence[Payload | Unreadable]:
        """What the mapping is given: where turbines are devices, nothing that an edge node says of itself."""
        if self.mapping.turbine != DEVICE_LEVEL or one.topic.count("/") >= DEVICE_PLACE:
            return one.contents
        return [_OF_NO_DEVICE if not isinstance(c, Unreadable) else c for c in one.contents]

    # -- what the state says ---------------------------------------------------------------------------------
    def _absences(self) -> list[tuple[str, str, float]]:
        """Names of edge nodes and devices that have left and have not come back, the topics of their data,
        and the times [s] of their death certificates."""
        nodes = tuple(self.edge_nodes.nodes.items())
        return [
            (f"{name}/{device}" if device else name, data_topic(name, device), since)
            for name, node in nodes
            for device, since in tuple(node.left_s.items())
        ]

    def left(self) -> dict[str, Statement]:
        """Turbine -> that its edge node or device has left, where the topic names the turbine and nothing
        else sends for it."""
        found: dict[str, Statement] = {}
        nodes = tuple(self.edge_nodes.nodes.items())
        present = {
            self._turbine(data_topic(name, one)) for name, node in nodes for one in tuple(node.present)
        }
        for sender, topic, since in self._absences():
            turbine = self._turbine(topic)
            if turbine is not None and turbine not in present:
                found[turbine] = AlarmCode.SENDER_LEFT(sender=sender, at=since)
        return found

    def _turbine(self, topic: str) -> str | None:
        """The turbine that a level of the topic names, or the only one; None for any other."""
        mapping = self.mapping
        if not mapping.turbine:
            return mapping.only_turbine
        return mapping.turbines.get(str(mapping.readers["turbine"](PayloadRecord((), topic=topic))))

    @property
    def state(self) -> SourceState:
        found = super().state
        if found.word != "connected":
            return found
        nodes = tuple(self.edge_nodes.nodes.items())
        left = [name for name, node in nodes if "" in node.left_s]
        notes = [found.words, *self._notes()]
        return SourceState("lost" if nodes and len(left) == len(nodes) else "connected", "; ".join(notes))

    def _notes(self) -> list[str]:
        left = [f"{sender} since {stamp_text(since)}" for sender, _, since in self._absences()]
        notes = (
            [f"left, so that its signals are stale until it is born again: {several(left)}"] if left else []
        )
        if waiting := self.edge_nodes.without_birth():
            remedy = (
                "it has been asked for a rebirth"
                if self.broker.rebirth_requests
                else (f"ask for a rebirth: {ASK_REBIRTH}, or set rebirth_requests = true")
            )
            notes.append(f"gap or no birth certificate, aliases are not read: {several(waiting)}: {remedy}")
        return notes


@dataclass(frozen=True)
class MqttForm(Broker):
    """A [[source]] of a broker: payloads for the mapping, or Sparkplug B."""

    def stream(self, mapping: PayloadMapping, place: Place) -> Mqtt:
        """The stream; secrets and certificates that cannot be read are faults."""
        if (missing := libraries_fault()) is not None:
            place.fault(missing)
        if not place.faults:
            self.expect(place, self.password.read, self.context)
        return (Sparkplug if self.format == SPARKPLUG else Mqtt)(self, mapping)
