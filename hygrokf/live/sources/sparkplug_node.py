"""A Sparkplug edge node as its messages describe it: birth certificates define names, aliases and data types,
data use them, death certificates end them.

The node numbers its messages (0 … 255).  A missing number may be that of a birth certificate that gave the
aliases another meaning.  What comes by alias after such a gap, or after a death certificate, is therefore
held until the next birth certificate, and is read only if its alias means the same before and after.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from hygrokf.data.structured import Json, JsonObject, StructureFault, plain, structured
from hygrokf.live.sources.payload_formats import Unreadable
from hygrokf.live.sources.sparkplug_metrics import (
    Arrived,
    Released,
    Table,
    contents_of,
    metrics_text,
    refused,
)
from hygrokf.live.sources.sparkplug_payload import Message, decode

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

    `bdseq`: number of the session that its birth certificate names; `types`, `aliases`: device -> name ->
    data type or alias; `former_types`, `former_aliases`: those in doubt since a gap or a death; `gap_s`: time
    [s] of the gap; `left_s`: device -> time [s] of its death certificate, "" for the edge node.
    """

    bdseq: int | None = None
    types: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    aliases: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    former_types: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    former_aliases: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
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
        self._messages.append(one._replace(message=Message(), receipt=None))
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
        self._tables: dict[str, Table] = {}
        self._former: dict[str, Table] = {}
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
        """Apply a message that is next in the sequence."""
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
        number = one.message.value_of("bdSeq")
        self._bdseq = number % 256 if isinstance(number, int) else None
        self.gap_s, self._expected = None, None
        return [*released, *self._next(one)]

    def _node_death(self, one: Arrived) -> list[Released]:
        number = one.message.value_of("bdSeq")
        if isinstance(number, int) and self._bdseq is not None and (number - self._bdseq) % 256 >= 128:
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
        self._tables[device], self._changed, self.unborn = Table.of(one.message), True, False
        return [self._read(one), *self._released_by_birth(device)]

    # -- metrics ---------------------------------------------------------------------------------------------
    def _read(self, one: Arrived) -> Released:
        """Payloads of a message by the present table; metrics with aliases in doubt are held."""
        table = self._tables.get(one.address.device, Table())
        contents = contents_of(one, table)
        former = self._former.get(one.address.device, Table())
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
        return Released(tuple(contents), one.topic, one.received, one.receipt)

    def _released_by_birth(self, device: str) -> list[Released]:
        """Held metrics of a device: read if the new birth certificate gives their aliases the old meaning."""
        former, table = self._former.pop(device, Table()), self._tables[device]
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
            found[f"edge node {self.name}"] = plain(
                NodeMemory(
                    self._bdseq,
                    {device: table.types for device, table in self._tables.items()},
                    {device: _by_name(table) for device, table in self._tables.items()},
                    {device: table.types for device, table in self._former.items()},
                    {device: _by_name(table) for device, table in self._former.items()},
                    self.gap_s,
                    self.left_s,
                )
            )
        return found

    @classmethod
    def recalled(cls, name: str, sequence: Json, content: Json) -> EdgeNode:
        """The edge node from its `memories`; those that cannot be read are forgotten."""
        found = cls(name)
        try:
            known = structured(NodeMemory, content)
        except StructureFault:
            return found
        found._bdseq = known.bdseq
        found._tables = _tables(known.types, known.aliases)
        found._former = _tables(known.former_types, known.former_aliases)
        found.gap_s, found.left_s, found.present = known.gap_s, dict(known.left_s), set(known.types)
        found._expected = sequence % 256 if isinstance(sequence, int) else None
        return found


def _by_name(table: Table) -> dict[str, int]:
    """Name -> alias."""
    return {name: alias for alias, name in table.names.items()}


def _tables(
    types: Mapping[str, Mapping[str, int]], aliases: Mapping[str, Mapping[str, int]]
) -> dict[str, Table]:
    return {
        device: Table(dict(known), {alias: name for name, alias in aliases.get(device, {}).items()})
        for device, known in types.items()
    }
