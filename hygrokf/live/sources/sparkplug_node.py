"""The state of a Sparkplug edge node, and the payloads that its messages contain for the mapping.  Birth
certificates define names, aliases and data types; data messages use them; death certificates end them.

The node numbers its messages (0 … 255).  A missing number may belong to a birth certificate that redefined
the aliases.  After such a gap, or after a death certificate, metrics without a name are therefore held until
the next birth certificate, and are read only if their aliases mean the same before and after it.
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
MESSAGE_TYPES = ("NBIRTH", "NDATA", "NDEATH", "DBIRTH", "DDATA", "DDEATH")
"""Types of the messages that an edge node publishes."""
IGNORED_TYPES = ("NCMD", "DCMD", "STATE")
"""Types of commands to edge nodes, and of the states of host applications."""
LONGEST_METRIC_NAME = 500
"""Longest name of a metric [characters]."""
LARGEST_QUALITY = 255
"""Largest value of the property Quality that is a code of OPC DA; larger values, such as 500 (stale), mean
bad."""
_CONTROL = ("bdSeq", "Node Control/", "Device Control/")
"""Prefixes of the names of metrics that belong to the protocol."""


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
        """The sender: GROUP/NODE or GROUP/NODE/DEVICE."""
        return f"{self.edge_node}/{self.device}" if self.device else self.edge_node


def address_of(topic: str) -> EdgeAddress | None:
    """Return the address of a message from an edge node; None for commands and for states of host
    applications. Raises Refused for a topic outside of Sparkplug B."""
    levels = topic.split("/")
    if not topic.isprintable():
        raise Refused("no Sparkplug topic", f"expected printable characters, found {topic[:80]!r}")
    if levels[0] == NAMESPACE and any(level in IGNORED_TYPES for level in levels[1:3]):
        return None
    level_count = 5 if len(levels) > 2 and levels[2].startswith("D") else 4
    if len(levels) != level_count or levels[0] != NAMESPACE or levels[2] not in MESSAGE_TYPES or "" in levels:
        raise Refused(
            "no Sparkplug topic", f"expected {NAMESPACE}/GROUP/TYPE/NODE[/DEVICE], found {topic[:80]!r}"
        )
    return EdgeAddress(*levels[1:])


class Arrived(NamedTuple):
    """A received message, decoded (`message`) and undecoded (`payload`).

    `received`: time of arrival [s]; `acknowledge`: call that acknowledges it to the broker, None if that is
    not needed; `repeated`: whether the broker marks it as sent again.
    """

    address: EdgeAddress
    topic: str
    message: SparkplugMessage
    payload: bytes
    received: float
    acknowledge: Callable[[], None] | None = None
    repeated: bool = False


class Released(NamedTuple):
    """A message that is ready for the mapping: its payloads, and the reasons why other parts are not used.

    `received`: time of arrival [s]; `acknowledge`: call that acknowledges it to the broker.
    """

    contents: tuple[Payload | Unreadable, ...]
    topic: str
    received: float
    acknowledge: Callable[[], None] | None = None


@dataclass(frozen=True)
class BirthTable:
    """The definitions of a birth certificate: name -> data type, and name -> alias."""

    types: Mapping[str, int] = field(default_factory=dict)
    aliases: Mapping[str, int] = field(default_factory=dict)

    @cached_property
    def names(self) -> Mapping[int, str]:
        """Alias -> name."""
        return {alias: name for name, alias in self.aliases.items()}

    @classmethod
    def of(cls, message: SparkplugMessage) -> BirthTable:
        """Return the table of a birth certificate."""
        types, aliases = dict[str, int](), dict[str, int]()
        for metric in message.metrics:
            if metric.name and len(metric.name) <= LONGEST_METRIC_NAME:
                types[metric.name] = metric.datatype
                if metric.alias is not None:
                    aliases[metric.name] = metric.alias
        return cls(types, aliases)

    def name_of(self, metric: Metric) -> str | None:
        """Return the name of a metric; None for an alias that is not defined."""
        return metric.name or (None if metric.alias is None else self.names.get(metric.alias))

    def agrees(self, other: BirthTable, metric: Metric) -> bool:
        """Whether a metric has the same name and data type in this table and in another one."""
        name = self.name_of(metric)
        return name is not None and name == other.name_of(metric) and self.types[name] == other.types[name]


def contents_of(arrived: Arrived, table: BirthTable) -> list[Payload | Unreadable]:
    """Return the payloads of the metrics that a table can name, one per time and quality, sorted by time.

    Each payload holds "time" [s], "quality" ("good", "uncertain" or "bad") and the values by the metrics'
    names.  Metrics whose alias is not in the table are not treated here.
    """
    values_by_time_and_quality: dict[tuple[float | None, str], list[JsonObject]] = {}
    unused_metrics: dict[str, list[Metric]] = {}
    for metric in arrived.message.metrics:
        name = table.name_of(metric)
        if name is None or name.startswith(_CONTROL):
            if name is None and metric.alias is None:
                unused_metrics.setdefault("no name", []).append(metric)
            continue
        value = metric.reading(metric.datatype or table.types.get(name, 0))
        if not metric.is_scalar:
            unused_metrics.setdefault("no single value", []).append(metric)
        elif metric.is_transient:
            unused_metrics.setdefault("transient", []).append(metric)
        elif len(name) > LONGEST_METRIC_NAME:
            unused_metrics.setdefault("name too long", []).append(metric)
        elif value is not None:
            # the time of the message does not apply to a historical value without a time of its own
            time = arrived.message.time if metric.time is None and not metric.is_historical else metric.time
            quality = GOOD if metric.quality is None else BAD
            if metric.quality is not None and metric.quality <= LARGEST_QUALITY:
                quality = VOCABULARIES["opc-da"].judge(metric.quality)
            payloads_of_group = values_by_time_and_quality.setdefault((time, quality), [{}])
            if name in payloads_of_group[-1]:  # a second value of a name needs a payload of its own
                payloads_of_group.append({})
            payloads_of_group[-1][name] = value
    ordered = sorted(
        values_by_time_and_quality.items(), key=lambda item: -1.0 if item[0][0] is None else item[0][0]
    )
    payloads = [
        {**values, "time": time, "quality": quality}
        for (time, quality), payloads_of_group in ordered
        for values in payloads_of_group
    ]
    unused = (
        Unreadable(kind, metrics_text(arrived, metrics, kind)) for kind, metrics in unused_metrics.items()
    )
    return [*payloads, *unused]


def refused(arrived: Arrived, kind: str, reason: str) -> Released:
    """Return a message of which nothing is used, with the reason."""
    text = f"{arrived.address.kind} of {arrived.address.where}: {reason}"
    return Released((Unreadable(kind, text),), arrived.topic, arrived.received, arrived.acknowledge)


def metrics_text(arrived: Arrived, metrics: Sequence[Metric], reason: str) -> str:
    """Return the text "N metrics in TYPE of SENDER: REASON" about metrics of a message that are not used."""
    count = f"{len(metrics)} metric{'s' * (len(metrics) > 1)}"
    return f"{count} in {arrived.address.kind} of {arrived.address.where}: {reason}"


REORDER_S = 2.0
"""Time [s] for which a message waits for its predecessors: brokers keep the order only within a topic."""
MOST_WAITING = 100
"""Largest number of messages of an edge node that wait for their predecessors."""
UNEXPLAINED = ("held until birth", "no birth yet")
"""Kinds of unused metrics whose aliases need a birth certificate: held for it, or never defined so far."""
MOST_DEVICES = 1_000
"""Largest number of devices of an edge node."""
MOST_HELD_BYTES = 8 * 2**20
"""Largest size [bytes] of the held messages of an edge node; beyond it the oldest are dropped."""
OVERHEAD_BYTES = 500
"""Estimated size [bytes] of a held message without its payload."""


@dataclass(frozen=True)
class NodeMemory:
    """The state of an edge node that the store keeps, as plain data.

    `bdseq`: session number in its birth certificate; `tables`: device -> valid birth table; `former`: device
    -> birth table that is in doubt since a gap or a death; `gap_s`: time [s] of the gap; `left_s`: device ->
    time [s] of its death certificate, "" for the edge node.
    """

    bdseq: int | None = None
    tables: Mapping[str, BirthTable] = field(default_factory=dict)
    former: Mapping[str, BirthTable] = field(default_factory=dict)
    gap_s: float | None = None
    left_s: Mapping[str, float] = field(default_factory=dict)


class HeldMessages:
    """Messages whose aliases wait for a birth certificate, in the order of arrival.

    They are kept undecoded, because the backlog after an outage is long and decoded messages need much more
    memory.
    """

    def __init__(self) -> None:
        self._messages: deque[Arrived] = deque()
        self._size = 0

    def add(self, arrived: Arrived) -> None:
        """Hold a message; drop the oldest messages beyond `MOST_HELD_BYTES`."""
        self._messages.append(arrived._replace(message=SparkplugMessage(), acknowledge=None))
        self._size += len(arrived.payload) + OVERHEAD_BYTES
        while self._size > MOST_HELD_BYTES:
            self._size -= len(self._messages.popleft().payload) + OVERHEAD_BYTES

    def release(self, device: str) -> Iterator[Arrived]:
        """Remove the held messages of a device and return them, decoded."""
        released = [held for held in self._messages if held.address.device == device]
        self._messages = deque(held for held in self._messages if held.address.device != device)
        self._size -= sum(len(held.payload) + OVERHEAD_BYTES for held in released)
        return (held._replace(message=decode(held.payload)) for held in released)


class EdgeNode:
    """The present session of an edge node `name` (GROUP/NODE).

    `gap_s`: time [s] since which a message is missing, None without a gap; `unborn`: whether metrics arrived
    with aliases that no birth certificate has defined yet; `left_s`: device -> time [s] of its death
    certificate, "" for the edge node; `present`: devices that have sent a message and not left since.
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
    def take(self, arrived: Arrived) -> list[Released]:
        """Process a message; returns the released messages: this one, and those that waited for it."""
        sequence = arrived.message.sequence
        if arrived.address.kind == "NDEATH":
            return self._end_session(arrived)
        if arrived.address.kind == "NBIRTH":
            return [*self._start_session(arrived), *self._apply_in_order()]
        if sequence is None or self._expected in (None, sequence):
            return [*self._apply_next(arrived), *self._apply_in_order()]
        last = self._last
        is_last = last is not None and (last.address, last.message) == (arrived.address, arrived.message)
        # sequence numbers wrap at 256; one that is 128 or more ahead is taken as one in the past
        if is_last or (arrived.repeated and (sequence - (self._expected or 0)) % 256 >= 128):
            return [refused(arrived, "repeated", "it was received before")]
        self._waiting.append(arrived)
        return self.release_overdue(arrived.received)

    def release_overdue(self, now: float) -> list[Released]:
        """Release waiting messages whose missing predecessors are overdue at the time `now` [s]."""
        waiting = self._waiting
        if not waiting or (now - waiting[0].received < REORDER_S and len(waiting) <= MOST_WAITING):
            return []
        return self._apply_despite_gap(now, waiting)

    def _apply_next(self, arrived: Arrived) -> list[Released]:
        """Process the message that continues the sequence."""
        if arrived.message.sequence is not None:
            self._expected = (arrived.message.sequence + 1) % 256
        self._last = arrived
        return self._apply(arrived)

    def _apply_in_order(self) -> list[Released]:
        """Apply waiting messages as long as the next number of the sequence is among them."""
        released: list[Released] = []
        by_number = {arrived.message.sequence: arrived for arrived in self._waiting}
        while (following := by_number.pop(self._expected, None)) is not None:
            self._waiting.remove(following)
            released += self._apply_next(following)
        return released

    def _apply_despite_gap(self, now: float, messages: Sequence[Arrived]) -> list[Released]:
        """Apply waiting messages in the order of their numbers although predecessors are missing: a gap."""
        self.gap_s = now if self.gap_s is None else self.gap_s
        self._former |= self._tables
        self._tables, self._changed = {}, True
        expected = self._expected or 0
        ordered = sorted(messages, key=lambda message: ((message.message.sequence or 0) - expected) % 256)
        self._waiting = [waiting for waiting in self._waiting if waiting not in messages]
        return [released for message in ordered for released in self._apply_next(message)]

    def _start_session(self, arrived: Arrived) -> list[Released]:
        """Process the birth certificate of a new session; older waiting messages belong to the last one."""
        birth_time = arrived.message.time
        old = [
            waiting
            for waiting in self._waiting
            if birth_time is None or waiting.message.time is None or waiting.message.time < birth_time
        ]
        released = self._apply_despite_gap(arrived.received, old) if old else []
        self._former |= self._tables
        self._tables = {}
        self._bdseq = arrived.message.session
        self.gap_s, self._expected = None, None
        return [*released, *self._apply_next(arrived)]

    def _end_session(self, arrived: Arrived) -> list[Released]:
        """Process the death certificate of the edge node."""
        number = arrived.message.session
        if number is not None and self._bdseq is not None and (number - self._bdseq) % 256 >= 128:
            return [refused(arrived, "former death certificate", "it belongs to an earlier session")]
        released = self._apply_despite_gap(arrived.received, self._waiting) if self._waiting else []
        self._former |= self._tables
        self.left_s |= dict.fromkeys(("", *self._former), arrived.received)
        self.present.clear()
        self._tables, self._expected, self._last = {}, None, None
        self.gap_s, self.unborn, self._changed = None, False, True
        return [*released, refused(arrived, "death certificate", "the sender is offline")]

    def _apply(self, arrived: Arrived) -> list[Released]:
        """Process a message that is next in the sequence, except a death certificate of the edge node."""
        device, kind = arrived.address.device, arrived.address.kind
        if kind == "DDEATH":
            if device in self._tables:
                self._former[device] = self._tables.pop(device)
            self.present.discard(device)
            self.left_s[device], self._changed = arrived.received, True
            return [refused(arrived, "death certificate", "the sender is offline")]
        # a message shows that its device and the edge node are present
        self.present.add(device)
        for returned in {"", device} & set(self.left_s):
            del self.left_s[returned]
            self._changed = True
        if kind not in ("NBIRTH", "DBIRTH"):
            return [self._read(arrived)]
        if device not in self._tables and len(self._tables) > MOST_DEVICES:
            return [refused(arrived, "too large", f"more than {MOST_DEVICES} devices")]
        self._tables[device], self._changed, self.unborn = BirthTable.of(arrived.message), True, False
        return [self._read(arrived), *self._released_by_birth(device)]

    # -- metrics ---------------------------------------------------------------------------------------------
    def _read(self, arrived: Arrived) -> Released:
        """Return a message's payloads by the valid birth table; hold it if its aliases are in doubt."""
        table = self._tables.get(arrived.address.device, BirthTable())
        contents = contents_of(arrived, table)
        former = self._former.get(arrived.address.device, BirthTable())
        unknown = [
            metric
            for metric in arrived.message.metrics
            if metric.alias is not None and table.name_of(metric) is None
        ]
        held = tuple(metric for metric in unknown if former.name_of(metric) is not None)
        if held:
            self._held.add(arrived)
            contents.append(
                Unreadable(UNEXPLAINED[0], metrics_text(arrived, held, "wait for a birth certificate"))
            )
        if len(unknown) > len(held):
            undefined = [metric for metric in unknown if former.name_of(metric) is None]
            contents.append(
                Unreadable(UNEXPLAINED[1], metrics_text(arrived, undefined, "no birth certificate has come"))
            )
        self.unborn = self.unborn or bool(unknown)
        if not contents:
            contents.append(
                Unreadable("no value", f"{arrived.address.kind} of {arrived.address.where} without a value")
            )
        return Released(tuple(contents), arrived.topic, arrived.received, arrived.acknowledge)

    def _released_by_birth(self, device: str) -> list[Released]:
        """Return the held metrics of a device whose aliases mean the same in the new birth certificate."""
        former, table = self._former.pop(device, BirthTable()), self._tables[device]
        released = []
        for arrived in self._held.release(device):
            held = [
                metric
                for metric in arrived.message.metrics
                if not metric.name and former.name_of(metric) is not None
            ]
            unchanged = tuple(metric for metric in held if table.agrees(former, metric))
            message = replace(arrived.message, metrics=unchanged)
            contents = contents_of(arrived._replace(message=message), table)
            if len(unchanged) < len(held):
                contents.append(
                    Unreadable("alias changed", f"aliases of {arrived.address.where} changed in a gap")
                )
            if contents:
                released.append(Released(tuple(contents), arrived.topic, arrived.received))
        return released

    # -- memories --------------------------------------------------------------------------------------------
    def memories(self) -> JsonObject:
        """Return data for the store, by name: the next sequence number, and a changed `NodeMemory`."""
        memories: JsonObject = {f"sequence of {self.name}": self._expected}
        if self._changed:
            self._changed = False
            memory = NodeMemory(self._bdseq, self._tables, self._former, self.gap_s, self.left_s)
            memories[f"edge node {self.name}"] = plain(memory)
        return memories

    @classmethod
    def recalled(cls, name: str, sequence: Json, content: Json) -> EdgeNode:
        """Return the edge node with the state that `memories` gave; without a state if it cannot be read."""
        node = cls(name)
        try:
            memory = structured(NodeMemory, content)
        except StructureFault:
            return node
        node._bdseq, node._tables, node._former = memory.bdseq, dict(memory.tables), dict(memory.former)
        node.gap_s, node.left_s, node.present = memory.gap_s, dict(memory.left_s), set(memory.tables)
        node._expected = sequence % 256 if isinstance(sequence, int) else None
        return node
