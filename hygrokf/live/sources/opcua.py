"""An OPC UA server as a source: published samples as they come, and missed samples from the server's history.

The place is JSON: node id -> time [s] of its last delivered sample.  At every new connection, and after a
queue overflow, the server's history is read from there on before anything newer is delivered, because the
filter needs readings in the order of their times.  If the server keeps no history, missed samples are lost,
and the state says so.
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
from hygrokf.live.sources.payload import EARLIEST_S, PayloadMapping
from hygrokf.live.sources.payload_values import AHEAD_S
from hygrokf.live.sources.stream import PAUSE_S, Delivery, SourceFault, SourceState, Stream
from hygrokf.texts.wording import several

LOG = logging.getLogger("hygrokf.track")
FIRST_S = 2.0
"""[s] to wait for the first samples of a subscription, in addition to its publishing interval."""
AGAIN_S = 60.0
"""[s] after which refused nodes and histories are requested again."""
BATCH = 500
"""Deliveries that share one place."""


class OpcUa(Stream):
    """A subscription to nodes of one server, in its own asyncio loop.

    Each sample becomes a payload with the names turbine, time, quality and the node's field; the mapping
    states which qualities count.
    """

    ordered_by = "server time stamp"
    is_server = True

    def __init__(self, server: Server, mapping: PayloadMapping, security: Security | None = None) -> None:
        super().__init__(mapping)
        self.url = server.endpoint
        self.server = server
        self.nodes = tuple(server.nodes.values())
        self._security = security
        self._put: Callable[[Delivery], None] = lambda one: None
        self._reached: dict[str, float] = {}
        self._since_s = 0.0
        self._last: dict[Node, tuple[float | None, object, str]] = {}
        self._owed: set[Node] = set()
        self._refused: dict[Node, str] = {}
        self._bad: dict[Node, str] = {}
        self._unread: dict[Node, str] = {}
        self._without_history: dict[Node, str] = {}
        self._overflows = {"in the server": 0, "here": 0}
        self._reading = self._changes_only = False

    @property
    def state(self) -> SourceState:
        word, behind = self._state
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
        return SourceState(word, "; ".join([behind, *filter(None, notes)]))

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        self._put = put
        self._reached = self._reached or self._times_reached(place)
        self._since_s = self._since_s or time.time() - self.server.look_back_s
        library()
        asyncio.run(self._follow())

    def _times_reached(self, place: str | None) -> dict[str, float]:
        """Node id -> time [s] up to which the node was delivered, from the place; nodes without a valid time
        are left out."""
        try:
            found = json.loads(place or "{}")
        except ValueError:
            found = {}
        known = found if isinstance(found, dict) else {}
        times = {node.id: known.get(node.id) for node in self.nodes}
        latest = time.time() + AHEAD_S
        return {
            id: float(at)
            for id, at in times.items()
            if isinstance(at, int | float) and EARLIEST_S <= at <= latest
        }

    # -- connections -----------------------------------------------------------------------------------------
    def connection(self) -> Connection:
        """A connection to the server, not open yet."""
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
        self._refused, self._unread, self._bad, self._without_history = {}, {}, {}, {}
        self._owed = set()
        await self._begin(connection, self.nodes)
        again = time.monotonic() + AGAIN_S
        while not self._ended.is_set():
            connection.check()
            samples = await connection.samples(PAUSE_S)
            overflowed = [one for one in samples if one.overflowed]
            if overflowed:  # the server lost samples before these
                self._overflows["in the server"] += len(overflowed)
                await self._read_back(connection, {one.node: one.time for one in overflowed})
            await self._hand_over(samples)
            if connection.dropped:  # samples after these were lost here
                dropped, connection.dropped = connection.dropped, set()
                self._overflows["here"] += 1
                await self._read_back(connection, dict.fromkeys(dropped))
            if time.monotonic() > again:
                again = time.monotonic() + AGAIN_S
                await self._read_back(connection, dict.fromkeys(self._owed))
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
        end = time.monotonic() + self.server.publishing_s + FIRST_S
        while awaited - set(first) and time.monotonic() < end and not self._ended.is_set():
            came = await connection.samples(PAUSE_S)
            samples += came
            for one in came:
                first.setdefault(one.node, one.time)
        self._without_history |= await connection.without_history(tuple(awaited))
        await self._read_back(connection, {node: first.get(node) for node in awaited})
        await self._hand_over(samples)

    # -- what was missed -------------------------------------------------------------------------------------
    async def _read_back(self, connection: Connection, nodes: Mapping[Node, float | None]) -> None:
        """Deliver the history of nodes since their last delivered samples, merged in the order of time.

        nodes: node -> time [s] at which the next deliveries begin and the history ends, None for all of it.
        """
        self._owed |= set(nodes)
        histories = [self._missed_samples(connection, node, until_s) for node, until_s in nodes.items()]
        batch: list[Sample] = []
        self._reading = bool(histories)
        async for sample in in_order(histories):
            batch.append(sample)
            if len(batch) == BATCH:
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
        """A node's history since its last delivered sample; a node that cannot be read stays owed unless the
        fault is final."""
        since_s = self._reached.get(node.id, self._since_s)
        until_s = time.time() + AHEAD_S if until_s is None else until_s
        if self._ended.is_set():
            return
        came = False
        try:
            if since_s < until_s:
                async for sample in connection.history(node, since_s, until_s):
                    came = True
                    yield sample
            if not came and node in self._without_history:  # the server answers, but keeps nothing
                self._note_unread(node, self._without_history[node], final=True)
            else:
                self._unread.pop(node, None)
            self._owed.discard(node)
        except HistoryFault as fault:
            self._note_unread(node, str(fault), fault.final)
            if fault.final:
                self._owed.discard(node)

    def _note_unread(self, node: Node, words: str, final: bool) -> None:
        """Note that a node's history cannot be read, and log it the first time."""
        if node not in self._unread:
            said = {"source": self.url, "node": node.id, "fault": words, "final": final}
            LOG.warning("no history", extra=said)
        self._unread[node] = words

    # -- deliveries ------------------------------------------------------------------------------------------
    async def _hand_over(self, samples: Sequence[Sample], from_history: bool = False) -> None:
        """Deliver samples in the order of time, from a separate thread, so that a busy service does not block
        the connection."""
        ordered = sorted(samples, key=lambda one: one.received if one.time is None else one.time)
        for start in range(0, len(ordered), BATCH):
            deliveries = [self.delivery(one) for one in ordered[start : start + BATCH] if self._is_new(one)]
            for one in ordered[start : start + BATCH]:
                self._note(one, from_history)
            if deliveries:
                deliveries[-1] = replace(deliveries[-1], place=json.dumps(self._reached))
                await asyncio.to_thread(self._put_all, deliveries)

    def _put_all(self, deliveries: Iterable[Delivery]) -> None:
        for one in deliveries:
            self._put(one)

    def _is_new(self, one: Sample) -> bool:
        """Whether a sample differs from the node's last one, which every new subscription repeats."""
        seen, self._last[one.node] = self._last.get(one.node), (one.time, one.value, one.word)
        return seen != self._last[one.node]

    def _note(self, one: Sample, from_history: bool) -> None:
        """Note the time up to which a node is delivered, unless earlier samples are still owed."""
        if one.time is not None and EARLIEST_S <= one.time <= one.received + AHEAD_S:
            if from_history or one.node not in self._owed:
                self._reached[one.node.id] = max(one.time, self._reached.get(one.node.id, 0.0))
        if one.quality == "bad":
            self._bad[one.node] = one.word
        else:
            self._bad.pop(one.node, None)

    def signals(self, turbine: str) -> set[str]:
        """Signals of a turbine that the nodes deliver."""
        fields = self.mapping.fields
        return {fields[node.field].signal for node in self.nodes if node.turbine == turbine}

    def delivery(self, one: Sample) -> Delivery:
        """The delivery of a sample."""
        content: JsonObject = {"turbine": one.node.turbine, "time": one.time, "quality": one.quality}
        if one.quality != "bad":
            content[one.node.field] = self._number(one)
        return Delivery(content, one.received, mark=one.served)

    def _number(self, one: Sample) -> Json:
        """The value if it is a number, 1 or 0 for a boolean of a field with unit "1", else the name of its
        type."""
        if isinstance(one.value, bool) and self.mapping.fields[one.node.field].unit == "1":
            return int(one.value)
        if isinstance(one.value, int | float) and not isinstance(one.value, bool):
            return one.value
        return type(one.value).__name__


async def in_order(histories: Iterable[AsyncIterator[Sample]]) -> AsyncIterator[Sample]:
    """Merge the samples of several nodes, each in order, by time."""
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


def _nodes_text(words: str, nodes: Mapping[Node, str]) -> str:
    # another thread may change the nodes meanwhile
    found = [f"{node.id} ({word})" for node, word in tuple(nodes.items())]
    return f"{words}: {several(found)}" if found else ""


# -- from the tracker's file ---------------------------------------------------------------------------------
_PLAIN = ("turbine", "time", "quality")


@dataclass(frozen=True)
class OpcUaForm(Server):
    """A [[source]] of `opc.tcp://HOST:PORT/PATH`."""

    def stream(self, mapping: PayloadMapping, place: Place) -> OpcUa:
        """The stream; faults of its nodes and files go to `place`."""
        security = self.security_from(place)
        self.expect(place, self.password.read, lambda: _check_nodes(self.nodes, mapping, place))
        turbines = {one.turbine: one.turbine for one in self.nodes.values()}
        own = mapping.of_own_payloads(self.uncertain and mapping.use_uncertain, turbines)
        return OpcUa(self, own, security)


def _check_nodes(nodes: Mapping[str, Node], mapping: PayloadMapping, place: Place) -> None:
    """Faults of nodes that the mapping does not know, or that stand for one field twice.

    Raises SourceFault without asyncua.
    """
    turbines = tuple(set(mapping.turbines.values()))
    taken: dict[tuple[str, str], str] = {}
    for id, one in nodes.items():
        inside = place.inside("nodes", entry=repr(id))
        if (wrong := node_fault(id)) is not None:
            inside.fault(wrong)
        for key, value, known, where in (
            ("turbine", one.turbine, turbines, "[[turbine]]"),
            ("field", one.field, tuple(mapping.fields), "[mapping.signals]"),
        ):
            if value and value not in known:
                inside.fault(f"{key}: {where} has no {value!r}{suggestion(value, known)}")
        if one.field in _PLAIN:
            inside.fault(f"a field must not be named {one.field!r} here: rename it in [mapping.signals]")
        other = taken.setdefault((one.turbine, one.field), id)
        if other != id:
            inside.fault(f"{other!r} already is {one.field} of {one.turbine}")
