"""A Sparkplug edge node as its messages describe it: birth certificates define names, aliases and data types,
data use them, death certificates end them; and the payloads that a message gives for the mapping.

The node numbers its messages (0 … 255).  A missing number may be that of a birth certificate that gave the
aliases another meaning.  What comes by alias after such a gap, or after a death certificate, is therefore
held until the next birth certificate, and is read only if its alias means the same before and after.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

from hygrokf.data.quality import BAD, GOOD, VOCABULARIES
from hygrokf.data.structured import Json, JsonObject, StructureFault, plain, structured
from hygrokf.live.sources.payload_formats import Payload, Refused, Unreadable
from hygrokf.live.sources.sparkplug_payload import Metric, SparkplugMessage, decode

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


class EdgeAddress(NamedTuple):
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


def address_of(topic: str) -> EdgeAddress | None:
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
    return EdgeAddress(*levels[1:])


class Arrived(NamedTuple):
    """A message from an address, decoded and as its `payload`, with its time of arrival [s]; `repeated`: the
    broker sends it once more."""

    address: EdgeAddress
    topic: str
    message: SparkplugMessage
    payload: bytes
    received: float
    acknowledge: Callable[[], None] | None = None
    repeated: bool = False


class Released(NamedTuple):
    """What a message gives: payloads for the mapping, and reasons why parts of it are not used."""

    contents: tuple[Payload | Unreadable, ...]
    topic: str
    received: float
    acknowledge: Callable[[], None] | None = None


@dataclass(frozen=True)
class BirthTable:
    """What a birth certificate defines: name -> data type, and name -> alias."""

    types: Mapping[str, int] = field(default_factory=dict)
    aliases: Mapping[str, int] = field(default_factory=dict)

    @cached_property
    def names(self) -> Mapping[int, str]:
        """Alias -> name."""
        return {alias: name for name, alias in self.aliases.items()}

    @classmethod
    def of(cls, message: SparkplugMessage) -> BirthTable:
        named = [one for one in message.metrics if one.name and len(one.name) <= LONGEST_METRIC_NAME]
        return cls(
            {one.name: one.datatype for one in named if one.name},
            {one.name: one.alias for one in named if one.name and one.alias is not None},
        )

    def name_of(self, metric: Metric) -> str | None:
        """The name of a metric; None for an alias that is not defined."""
        return metric.name or (None if metric.alias is None else self.names.get(metric.alias))

    def agrees(self, other: BirthTable, metric: Metric) -> bool:
        """Whether a metric means the same in another table."""
        name = self.name_of(metric)
        return name is not None and name == other.name_of(metric) and self.types[name] == other.types[name]


def contents_of(one: Arrived, table: BirthTable) -> list[Payload | Unreadable]:
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
    return Released((Unreadable(kind, text),), one.topic, one.received, one.acknowledge)


def metrics_text(one: Arrived, metrics: Sequence[Metric], words: str) -> str:
    """Text about some metrics of a message."""
    count = f"{len(metrics)} metric{'s' * (len(metrics) > 1)}"
    return f"{count} in {one.address.kind} of {one.address.where}: {words}"


REORDER_S = 2.0
"""[s] a message waits for those before it: brokers keep the order within a topic only."""
MOST_WAITING = 100
"""Messages of an edge node that may wait for those before them."""
UNEXPLAINED = ("held until birth", "no birth yet")
"""Reasons for which metrics by alias are not read: a birth certificate is awaited."""
MOST_DEVICES = 1_000
"""Devices of an edge node."""
MOST_HELD = 8 * 2**20
"""[bytes] of messages held of an edge node; the oldest are dropped."""
BESIDE = 500
"""[bytes] that a held message takes beside its payload."""


@dataclass(frozen=True)
class NodeMemory:
    """What an edge node resumes from, as plain data.

    `bdseq`: number of the session that its birth certificate names; `tables` by device, and the `former` ones
    in doubt since a gap or a death; `gap_s`: time [s] of the gap; `left_s`: device -> time [s] of its death
    certificate, "" for the edge node.
    """

    bdseq: int | None = None
    tables: Mapping[str, BirthTable] = field(default_factory=dict)
    former: Mapping[str, BirthTable] = field(default_factory=dict)
    gap_s: float | None = None
    left_s: Mapping[str, float] = field(default_factory=dict)


class HeldMessages:
    """Messages whose aliases await a birth certificate, in the order of their arrival.

    They are held encoded, which takes much less space: a backlog after an outage is long.
    """

    def __init__(self) -> None:
        self._messages: deque[Arrived] = deque()
        self._size = 0

    def add(self, one: Arrived) -> None:
        """Hold a message, and drop the oldest ones that have no place beside it."""
        self._messages.append(one._replace(message=SparkplugMessage(), acknowledge=None))
        self._size += len(one.payload) + BESIDE
        while self._size > MOST_HELD:
            self._size -= len(self._messages.popleft().payload) + BESIDE

    def release(self, device: str) -> Iterator[Arrived]:
        """The messages of a device, which are held no longer."""
        those = [one for one in self._messages if one.address.device == device]
        self._messages = deque(one for one in self._messages if one.address.device != device)
        self._size -= sum(len(one.payload) + BESIDE for one in those)
        return (one._replace(message=decode(one.payload)) for one in those)


class EdgeNode:
    """The present session of an edge node `name` (GROUP/NODE).

    `gap_s`: time [s] since which a message is missing, None without a gap; `unborn`: whether metrics came by
    aliases that the birth certificates so far do not define; `left_s`: device -> time [s] of its death
    certificate, "" for the edge node; `present`: devices that have sent since.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.gap_s: float | None = None
        self.unborn = False
        self.left_s: dict[str, float] = {}
        self.present: set[str] = set()
        self._bdseq: int | None = None
        self._expected: int | None = None
        self._tables: dict[str, BirthTable] = {}
        self._former: dict[str, BirthTable] = {}
        self._last: Arrived | None = None
        self._waiting: list[Arrived] = []
        self._held = HeldMessages()
        self._changed = False

    # -- messages --------------------------------------------------------------------------------------------
    def take(self, one: Arrived) -> list[Released]:
        """What a message releases: itself, and messages that waited for it."""
        sequence = one.message.sequence
        if one.address.kind == "NDEATH":
            return self._node_death(one)
        if one.address.kind == "NBIRTH":
            return [*self._node_birth(one), *self._in_order()]
        if sequence is None or self._expected in (None, sequence):
            return [*self._next(one), *self._in_order()]
        last = self._last
        is_last = last is not None and (last.address, last.message) == (one.address, one.message)
        if is_last or (one.repeated and (sequence - (self._expected or 0)) % 256 >= 128):
            return [refused(one, "repeated", "it came before")]
        self._waiting.append(one)
        return self.look(one.received)

    def look(self, now: float) -> list[Released]:
        """What is released because the messages before it are missing for too long at a time [s]."""
        waiting = self._waiting
        if not waiting or (now - waiting[0].received < REORDER_S and len(waiting) <= MOST_WAITING):
            return []
        return self._without_missing(now, waiting)

    def _next(self, one: Arrived) -> list[Released]:
        if one.message.sequence is not None:
            self._expected = (one.message.sequence + 1) % 256
        self._last = one
        return self._apply(one)

    def _in_order(self) -> list[Released]:
        """Apply waiting messages as long as the next of the sequence is among them."""
        released: list[Released] = []
        by_number = {one.message.sequence: one for one in self._waiting}
        while (one := by_number.pop(self._expected, None)) is not None:
            self._waiting.remove(one)
            released += self._next(one)
        return released

    def _without_missing(self, now: float, those: Sequence[Arrived]) -> list[Released]:
        """Apply waiting messages in their order although some before them are missing: a gap."""
        self.gap_s = now if self.gap_s is None else self.gap_s
        self._former |= self._tables
        self._tables, self._changed = {}, True
        expected = self._expected or 0
        ordered = sorted(those, key=lambda one: ((one.message.sequence or 0) - expected) % 256)
        self._waiting = [one for one in self._waiting if one not in those]
        return [released for one in ordered for released in self._next(one)]

    def _node_birth(self, one: Arrived) -> list[Released]:
        """A new session; waiting messages that are older than its birth certificate belong to the former."""
        born = one.message.time
        old = [w for w in self._waiting if born is None or w.message.time is None or w.message.time < born]
        released = self._without_missing(one.received, old) if old else []
        self._former |= self._tables
        self._tables = {}
        self._bdseq = one.message.session
        self.gap_s, self._expected = None, None
        return [*released, *self._next(one)]

    def _node_death(self, one: Arrived) -> list[Released]:
        number = one.message.session
        if number is not None and self._bdseq is not None and (number - self._bdseq) % 256 >= 128:
            return [refused(one, "former death certificate", "it belongs to a former session")]
        released = self._without_missing(one.received, self._waiting) if self._waiting else []
        self._former |= self._tables
        self.left_s |= dict.fromkeys(("", *self._former), one.received)
        self.present.clear()
        self._tables, self._expected, self._last = {}, None, None
        self.gap_s, self.unborn, self._changed = None, False, True
        return [*released, refused(one, "death certificate", "it has left")]

    def _apply(self, one: Arrived) -> list[Released]:
        device, kind = one.address.device, one.address.kind
        if kind == "DDEATH":
            if device in self._tables:
                self._former[device] = self._tables.pop(device)
            self.present.discard(device)
            self.left_s[device], self._changed = one.received, True
            return [refused(one, "death certificate", "it has left")]
        # whoever sends lives
        self.present.add(device)
        for alive in {"", device} & set(self.left_s):
            del self.left_s[alive]
            self._changed = True
        if kind not in ("NBIRTH", "DBIRTH"):
            return [self._read(one)]
        if device not in self._tables and len(self._tables) > MOST_DEVICES:
            return [refused(one, "too large", f"more than {MOST_DEVICES} devices")]
        self._tables[device], self._changed, self.unborn = BirthTable.of(one.message), True, False
        return [self._read(one), *self._released_by_birth(device)]

    # -- metrics ---------------------------------------------------------------------------------------------
    def _read(self, one: Arrived) -> Released:
        """Payloads of a message by the present table; metrics with aliases in doubt are held."""
        table = self._tables.get(one.address.device, BirthTable())
        contents = contents_of(one, table)
        former = self._former.get(one.address.device, BirthTable())
        unknown = [m for m in one.message.metrics if m.alias is not None and table.name_of(m) is None]
        held = tuple(m for m in unknown if former.name_of(m) is not None)
        if held:
            self._held.add(one)
            contents.append(
                Unreadable(UNEXPLAINED[0], metrics_text(one, held, "wait for a birth certificate"))
            )
        if len(unknown) > len(held):
            strange = [m for m in unknown if former.name_of(m) is None]
            contents.append(
                Unreadable(UNEXPLAINED[1], metrics_text(one, strange, "no birth certificate has come"))
            )
        self.unborn = self.unborn or bool(unknown)
        if not contents:
            contents.append(
                Unreadable("no value", f"{one.address.kind} of {one.address.where} without a value")
            )
        return Released(tuple(contents), one.topic, one.received, one.acknowledge)

    def _released_by_birth(self, device: str) -> list[Released]:
        """Held metrics of a device: read if the new birth certificate gives their aliases the old meaning."""
        former, table = self._former.pop(device, BirthTable()), self._tables[device]
        released = []
        for one in self._held.release(device):
            held = [m for m in one.message.metrics if not m.name and former.name_of(m) is not None]
            same = tuple(m for m in held if table.agrees(former, m))
            contents = contents_of(one._replace(message=replace(one.message, metrics=same)), table)
            if len(same) < len(held):
                contents.append(
                    Unreadable("alias changed", f"aliases of {one.address.where} changed in a gap")
                )
            released.append(Released(tuple(contents), one.topic, one.received))
        return [one for one in released if one.contents]

    # -- memories --------------------------------------------------------------------------------------------
    def memories(self) -> JsonObject:
        """Data to resume from, by name: the place in the sequence, and the rest if it has changed."""
        found: JsonObject = {f"sequence of {self.name}": self._expected}
        if self._changed:
            self._changed = False
            known = NodeMemory(self._bdseq, self._tables, self._former, self.gap_s, self.left_s)
            found[f"edge node {self.name}"] = plain(known)
        return found

    @classmethod
    def recalled(cls, name: str, sequence: Json, content: Json) -> EdgeNode:
        """The edge node from its `memories`; those that cannot be read are forgotten."""
        found = cls(name)
        try:
            known = structured(NodeMemory, content)
        except StructureFault:
            return found
        found._bdseq, found._tables, found._former = known.bdseq, dict(known.tables), dict(known.former)
        found.gap_s, found.left_s, found.present = known.gap_s, dict(known.left_s), set(known.tables)
        found._expected = sequence % 256 if isinstance(sequence, int) else None
        return found
