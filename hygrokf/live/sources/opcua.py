"""An OPC UA server as a source: published samples as they come, and missed samples from the server's history.

The place that the store keeps is JSON: node id -> time [s] of its last delivered sample.  At every new
connection, and after a queue overflow, the server's history since these times is delivered before any newer
sample, because the filter needs readings in the order of their times.  A node whose history is still to be
read is pending.  If the server keeps no history, missed samples are lost, and the state reports this.
"""

from __future__ import annotations

import asyncio
import heapq
import json
import logging
import time
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from hygrokf.data.structured import Json, JsonObject
from hygrokf.data.toml_form import Place
from hygrokf.errors import suggestion
from hygrokf.live.sources.opcua_client import Connection, HistoryFault, Sample, library, node_fault
from hygrokf.live.sources.opcua_form import Node, Security, Server
from hygrokf.live.sources.payload import EARLIEST_STAMP_S, PayloadMapping
from hygrokf.live.sources.payload_values import STAMP_AHEAD_S
from hygrokf.live.sources.stream import POLL_PAUSE_S, Delivery, SourceFault, SourceState, Stream
from hygrokf.texts.wording import several

LOG = logging.getLogger("hygrokf.track")
FIRST_SAMPLES_S = 2.0
"""Time [s] to wait for the first samples of a subscription, in addition to its publishing interval."""
REQUEST_AGAIN_S = 60.0
"""Time [s] after which refused nodes and pending histories are requested again."""
DELIVERED_TOGETHER = 500
"""Largest number of samples that are delivered together; only their last delivery carries a place."""


class OpcUa(Stream):
    """A subscription to nodes of one server, in its own asyncio loop.

    Each sample becomes a payload with the names turbine, time, quality and the node's field; the mapping
    states which qualities are used.
    """

    ordered_by = "server time stamp"
    is_server = True

    def __init__(self, server: Server, mapping: PayloadMapping, security: Security | None = None) -> None:
        super().__init__(mapping)
        self.url = server.endpoint
        self.server = server
        self.nodes = tuple(server.nodes.values())
        self._security = security
        self._put: Callable[[Delivery], None] = lambda delivery: None
        self._delivered_until: dict[str, float] = {}
        self._start_s = 0.0
        self._last: dict[Node, tuple[float | None, object, str]] = {}
        self._pending: set[Node] = set()
        self._refused: dict[Node, str] = {}
        self._bad: dict[Node, str] = {}
        self._unread: dict[Node, str] = {}
        self._without_history: dict[Node, str] = {}
        self._overflows = {"in the server": 0, "here": 0}
        self._reading = self._changes_only = False

    @property
    def state(self) -> SourceState:
        word, explanation = self._state
        if word != "connected":
            return self._state
        notes = [
            "reading missed samples from the history" if self._reading else "",
            _nodes_text("missing or denied", self._refused),
            _nodes_text("bad now", self._bad),
            _nodes_text("no history, missed samples are lost", self._unread),
            "the server reports changes only" if self._changes_only else "",
            *(f"the queue {where} overflowed {n} times" for where, n in self._overflows.items() if n),
        ]
        return SourceState(word, "; ".join([explanation, *filter(None, notes)]))

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        self._put = put
        self._delivered_until = self._delivered_until or self._stored_times(place)
        self._start_s = self._start_s or time.time() - self.server.look_back_s
        library()
        asyncio.run(self._follow())

    def _stored_times(self, place: str | None) -> dict[str, float]:
        """Node id -> time [s] up to which the node was delivered, read from the place; nodes without a valid
        time are omitted."""
        try:
            parsed = json.loads(place or "{}")
        except ValueError:
            parsed = {}
        stored = parsed if isinstance(parsed, dict) else {}
        times = {node.id: stored.get(node.id) for node in self.nodes}
        latest = time.time() + STAMP_AHEAD_S
        return {
            node_id: float(time_s)
            for node_id, time_s in times.items()
            if isinstance(time_s, int | float) and EARLIEST_STAMP_S <= time_s <= latest
        }

    # -- connections -----------------------------------------------------------------------------------------
    def connection(self) -> Connection:
        """A connection to the server that is not open yet."""
        return Connection(self.server, self._security)

    async def _follow(self) -> None:
        connection = self.connection()
        try:
            await connection.open()
            LOG.info("connected", extra={"source": self.url})
            await self._serve(connection)
        except SourceFault as fault:
            raise SourceFault(f"{self.url}: {fault}") from None
        finally:
            await connection.close()

    async def _serve(self, connection: Connection) -> None:
        """Deliver the samples of an open connection until the source is stopped or a fault is raised."""
        self._refused, self._unread, self._bad, self._without_history = {}, {}, {}, {}
        self._pending = set()
        await self._begin(connection, self.nodes)
        next_retry = time.monotonic() + REQUEST_AGAIN_S
        while not self._ended.is_set():
            connection.check()
            samples = await connection.samples(POLL_PAUSE_S)
            overflowed = [sample for sample in samples if sample.overflowed]
            if overflowed:  # the server lost samples before these
                self._overflows["in the server"] += len(overflowed)
                await self._read_back(connection, {sample.node: sample.time for sample in overflowed})
            await self._hand_over(samples)
            if connection.dropped:  # this machine's full queue lost samples of these nodes after those above
                dropped, connection.dropped = connection.dropped, set()
                self._overflows["here"] += 1
                await self._read_back(connection, dict.fromkeys(dropped))
            if time.monotonic() > next_retry:
                next_retry = time.monotonic() + REQUEST_AGAIN_S
                await self._read_back(connection, dict.fromkeys(self._pending))
                await self._begin(connection, tuple(self._refused))

    async def _begin(self, connection: Connection, nodes: Sequence[Node]) -> None:
        """Subscribe to nodes; deliver their history first, then the subscription's initial samples."""
        if not nodes:
            return
        self._refused = await connection.subscribe(nodes)
        self._changes_only = connection.unfiltered
        self._state = SourceState("connected", self.url)
        first: dict[Node, float | None] = {}
        samples: list[Sample] = []
        awaited = set(nodes) - set(self._refused)
        end = time.monotonic() + self.server.publishing_s + FIRST_SAMPLES_S
        while awaited - set(first) and time.monotonic() < end and not self._ended.is_set():
            received = await connection.samples(POLL_PAUSE_S)
            samples += received
            for sample in received:
                first.setdefault(sample.node, sample.time)
        self._without_history |= await connection.without_history(tuple(awaited))
        await self._read_back(connection, {node: first.get(node) for node in awaited})
        await self._hand_over(samples)

    # -- missed samples --------------------------------------------------------------------------------------
    async def _read_back(self, connection: Connection, nodes: Mapping[Node, float | None]) -> None:
        """Deliver the history of nodes since their last delivered samples, merged in the order of time.

        nodes: node -> time [s] of its first newer sample, at which the history ends; None: up to now.
        """
        self._pending |= set(nodes)
        histories = [self._missed_samples(connection, node, until_s) for node, until_s in nodes.items()]
        batch: list[Sample] = []
        self._reading = bool(histories)
        async for sample in in_order(histories):
            batch.append(sample)
            if len(batch) == DELIVERED_TOGETHER:
                await self._hand_over(batch, from_history=True)
                batch = []
                connection.check()
                if self._ended.is_set():
                    return
        await self._hand_over(batch, from_history=True)
        self._reading = False

    async def _missed_samples(
        self, connection: Connection, node: Node, until_s: float | None
    ) -> AsyncIterator[Sample]:
        """A node's history since its last delivered sample; if the history cannot be read, the node stays
        pending unless the fault is final."""
        since_s = self._delivered_until.get(node.id, self._start_s)
        until_s = time.time() + STAMP_AHEAD_S if until_s is None else until_s
        if self._ended.is_set():
            return
        has_samples = False
        try:
            if since_s < until_s:
                async for sample in connection.history(node, since_s, until_s):
                    has_samples = True
                    yield sample
            if not has_samples and node in self._without_history:  # the server answers, but keeps no history
                self._note_unread(node, self._without_history[node], final=True)
            else:
                self._unread.pop(node, None)
            self._pending.discard(node)
        except HistoryFault as fault:
            self._note_unread(node, str(fault), fault.final)
            if fault.final:
                self._pending.discard(node)

    def _note_unread(self, node: Node, reason: str, final: bool) -> None:
        """Record that a node's history cannot be read, and log this the first time."""
        if node not in self._unread:
            details = {"source": self.url, "node": node.id, "fault": reason, "final": final}
            LOG.warning("no history", extra=details)
        self._unread[node] = reason

    # -- deliveries ------------------------------------------------------------------------------------------
    async def _hand_over(self, samples: Sequence[Sample], from_history: bool = False) -> None:
        """Deliver samples in the order of time, from a separate thread, so that a busy service does not block
        the connection."""
        ordered = sorted(samples, key=lambda sample: sample.received if sample.time is None else sample.time)
        for start in range(0, len(ordered), DELIVERED_TOGETHER):
            batch = ordered[start : start + DELIVERED_TOGETHER]
            deliveries = [self.delivery(sample) for sample in batch if self._is_new(sample)]
            for sample in batch:
                self._note(sample, from_history)
            if deliveries:
                deliveries[-1] = replace(deliveries[-1], place=json.dumps(self._delivered_until))
                await asyncio.to_thread(self._put_all, deliveries)

    def _put_all(self, deliveries: Iterable[Delivery]) -> None:
        for delivery in deliveries:
            self._put(delivery)

    def _is_new(self, sample: Sample) -> bool:
        """Whether a sample differs from the node's last one, which every new subscription repeats."""
        last, self._last[sample.node] = self._last.get(sample.node), (sample.time, sample.value, sample.word)
        return last != self._last[sample.node]

    def _note(self, sample: Sample, from_history: bool) -> None:
        """Record a node's quality and, unless its history is pending, its last delivered time."""
        if sample.time is not None and EARLIEST_STAMP_S <= sample.time <= sample.received + STAMP_AHEAD_S:
            if from_history or sample.node not in self._pending:
                self._delivered_until[sample.node.id] = max(
                    sample.time, self._delivered_until.get(sample.node.id, 0.0)
                )
        if sample.quality == "bad":
            self._bad[sample.node] = sample.word
        else:
            self._bad.pop(sample.node, None)

    def signals(self, turbine: str) -> set[str]:
        """Signals of a turbine that the nodes deliver."""
        fields = self.mapping.fields
        return {fields[node.field].signal for node in self.nodes if node.turbine == turbine}

    def delivery(self, sample: Sample) -> Delivery:
        """The delivery of a sample."""
        content: JsonObject = {"turbine": sample.node.turbine, "time": sample.time, "quality": sample.quality}
        if sample.quality != "bad":
            content[sample.node.field] = self._number(sample)
        return Delivery(content, sample.received, mark=sample.served)

    def _number(self, sample: Sample) -> Json:
        """The value if it is a number; 1 or 0 for a boolean in a field with the unit "1"; otherwise the name
        of its type, which the mapping refuses."""
        if isinstance(sample.value, bool) and self.mapping.fields[sample.node.field].unit == "1":
            return int(sample.value)
        if isinstance(sample.value, int | float) and not isinstance(sample.value, bool):
            return sample.value
        return type(sample.value).__name__


async def in_order(histories: Iterable[AsyncIterator[Sample]]) -> AsyncIterator[Sample]:
    """Merge the histories of several nodes, each of them sorted by time, into one sorted sequence."""
    heads: list[tuple[float, int, Sample, AsyncIterator[Sample]]] = []
    for number, history in enumerate(histories):
        sample = await anext(history, None)
        if sample is not None:
            heapq.heappush(heads, (sample.time or 0.0, number, sample, history))
    while heads:
        _, number, sample, history = heads[0]
        yield sample
        following = await anext(history, None)
        if following is None:
            heapq.heappop(heads)
        else:
            heapq.heapreplace(heads, (following.time or 0.0, number, following, history))


def _nodes_text(heading: str, nodes: Mapping[Node, str]) -> str:
    # the copy is needed because another thread may change the nodes meanwhile
    texts = [f"{node.id} ({reason})" for node, reason in tuple(nodes.items())]
    return f"{heading}: {several(texts)}" if texts else ""


# -- from the tracker's file ---------------------------------------------------------------------------------
_RESERVED_NAMES = ("turbine", "time", "quality")
"""Names in the payloads of this source that no field may have."""


@dataclass(frozen=True)
class OpcUaForm(Server):
    """A [[source]] of `opc.tcp://HOST:PORT/PATH`."""

    def stream(self, mapping: PayloadMapping, place: Place) -> OpcUa:
        """The stream; faults of its nodes and files are reported at `place`."""
        security = self.security_from(place)
        self.expect(place, self.password.read, lambda: _check_nodes(self.nodes, mapping, place))
        turbines = {node.turbine: node.turbine for node in self.nodes.values()}
        flat = mapping.of_own_payloads(self.uncertain and mapping.use_uncertain, turbines)
        return OpcUa(self, flat, security)


def _check_nodes(nodes: Mapping[str, Node], mapping: PayloadMapping, place: Place) -> None:
    """Report invalid node ids, turbines and fields that are not configured, and fields with two nodes.

    Raises SourceFault if asyncua is missing.
    """
    turbines = tuple(set(mapping.turbines.values()))
    taken: dict[tuple[str, str], str] = {}
    for node_id, node in nodes.items():
        entry = place.inside("nodes", entry=repr(node_id))
        if (fault := node_fault(node_id)) is not None:
            entry.fault(fault)
        for key, value, choices, where in (
            ("turbine", node.turbine, turbines, "[[turbine]]"),
            ("field", node.field, tuple(mapping.fields), "[mapping.signals]"),
        ):
            if value and value not in choices:
                entry.fault(f"{key}: {where} has no {value!r}{suggestion(value, choices)}")
        if node.field in _RESERVED_NAMES:
            entry.fault(f"a field must not be named {node.field!r} here: rename it in [mapping.signals]")
        other = taken.setdefault((node.turbine, node.field), node_id)
        if other != node_id:
            entry.fault(f"{other!r} already is {node.field} of {node.turbine}")
