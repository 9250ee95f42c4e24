"""What a Sparkplug message gives: payloads for the mapping, by the names that birth certificates define."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from hygrokf.data.quality import BAD, GOOD, VOCABULARIES
from hygrokf.data.structured import JsonObject
from hygrokf.live.sources.payload_formats import Payload, Refused, Unreadable
from hygrokf.live.sources.sparkplug_payload import Message, Metric
from hygrokf.live.sources.stream import Receipt

NAMESPACE = "spBv1.0"
CERTIFICATES = ("NBIRTH", "NDATA", "NDEATH", "DBIRTH", "DDATA", "DDEATH")
"""Types of the messages that an edge node publishes."""
PASSED_BY = ("NCMD", "DCMD", "STATE")
"""Types of the messages to edge nodes, and of those of host applications."""
LONGEST_METRIC_NAME = 500
"""Longest name of a metric [characters]."""
LARGEST_QUALITY = 255
"""Largest value of the property Quality that is a code of OPC DA; those above it, such as 500 (stale), are
bad."""
_CONTROL = ("bdSeq", "Node Control/", "Device Control/")
"""Beginnings of the names of metrics that belong to the protocol."""


class Address(NamedTuple):
    """The topic of a message: group, type, edge node, and device ("" for the edge node itself)."""

    group: str
    kind: str
    node: str
    device: str = ""

    @property
    def edge_node(self) -> str:
        """GROUP/NODE."""
        return f"{self.group}/{self.node}"

    @property
    def where(self) -> str:
        """The sender as text."""
        return f"{self.edge_node}/{self.device}" if self.device else self.edge_node


def address_of(topic: str) -> Address | None:
    """The address of a message from an edge node; None for commands and for states of host applications.
    Raises Refused for a topic outside of Sparkplug B."""
    levels = topic.split("/")
    if not topic.isprintable():
        raise Refused("no Sparkplug topic", f"expected printable characters, found {topic[:80]!r}")
    if levels[0] == NAMESPACE and any(one in PASSED_BY for one in levels[1:3]):
        return None
    wanted = 5 if len(levels) > 2 and levels[2].startswith("D") else 4
    if len(levels) != wanted or levels[0] != NAMESPACE or levels[2] not in CERTIFICATES or "" in levels:
        raise Refused(
            "no Sparkplug topic", f"expected {NAMESPACE}/GROUP/TYPE/NODE[/DEVICE], found {topic[:80]!r}"
        )
    return Address(*levels[1:])


class Arrived(NamedTuple):
    """A message from an address, decoded and as its `payload`, with its time of arrival [s]; `repeated`: the
    broker sends it once more."""

    address: Address
    topic: str
    message: Message
    payload: bytes
    received: float
    receipt: Receipt | None = None
    repeated: bool = False


class Released(NamedTuple):
    """What a message gives: payloads for the mapping, and reasons why parts of it are not used."""

    contents: tuple[Payload | Unreadable, ...]
    topic: str
    received: float
    receipt: Receipt | None = None


@dataclass(frozen=True)
class Table:
    """What a birth certificate defines: name -> data type, and alias -> name."""

    types: Mapping[str, int] = field(default_factory=dict)
    names: Mapping[int, str] = field(default_factory=dict)

    @classmethod
    def of(cls, message: Message) -> Table:
        named = [one for one in message.metrics if one.name and len(one.name) <= LONGEST_METRIC_NAME]
        return cls(
            {one.name: one.datatype for one in named if one.name},
            {one.alias: one.name for one in named if one.name and one.alias is not None},
        )

    def name_of(self, metric: Metric) -> str | None:
        """The name of a metric; None for an alias that is not defined."""
        return metric.name or (None if metric.alias is None else self.names.get(metric.alias))

    def agrees(self, other: Table, metric: Metric) -> bool:
        """Whether a metric means the same in another table."""
        name = self.name_of(metric)
        return name is not None and name == other.name_of(metric) and self.types[name] == other.types[name]


def contents_of(one: Arrived, table: Table) -> list[Payload | Unreadable]:
    """Payloads of the metrics that a table can name, one for each time and quality, in the order of time.

    Each holds "time" [s], "quality" ("good", "uncertain" or "bad") and the values by the metrics' names.
    Metrics whose alias the table does not know are left to the caller.
    """
    groups: dict[tuple[float | None, str], list[JsonObject]] = {}
    reasons: dict[str, list[Metric]] = {}
    for metric in one.message.metrics:
        name = table.name_of(metric)
        if name is None or name.startswith(_CONTROL):
            if name is None and metric.alias is None:
                reasons.setdefault("no name", []).append(metric)
            continue
        value = metric.reading(metric.datatype or table.types.get(name, 0))
        if not metric.is_scalar:
            reasons.setdefault("no single value", []).append(metric)
        elif metric.is_transient:
            reasons.setdefault("transient", []).append(metric)
        elif len(name) > LONGEST_METRIC_NAME:
            reasons.setdefault("name too long", []).append(metric)
        elif value is not None:
            # a historical value without a time of its own is not of the time of its message
            time = one.message.time if metric.time is None and not metric.is_historical else metric.time
            quality = GOOD if metric.quality is None else BAD
            if metric.quality is not None and metric.quality <= LARGEST_QUALITY:
                quality = VOCABULARIES["opc-da"].judge(metric.quality)
            those = groups.setdefault((time, quality), [{}])
            if name in those[-1]:
                those.append({})
            those[-1][name] = value
    ordered = sorted(groups.items(), key=lambda group: -1.0 if group[0][0] is None else group[0][0])
    payloads = [
        {**values, "time": time, "quality": quality} for (time, quality), those in ordered for values in those
    ]
    return [*payloads, *(Unreadable(kind, metrics_text(one, found, kind)) for kind, found in reasons.items())]


def refused(one: Arrived, kind: str, words: str) -> Released:
    """A message of which nothing is used."""
    text = f"{one.address.kind} of {one.address.where}: {words}"
    return Released((Unreadable(kind, text),), one.topic, one.received, one.receipt)


def metrics_text(one: Arrived, metrics: Sequence[Metric], words: str) -> str:
    """Text about some metrics of a message."""
    count = f"{len(metrics)} metric{'s' * (len(metrics) > 1)}"
    return f"{count} in {one.address.kind} of {one.address.where}: {words}"
