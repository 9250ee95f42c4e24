"""An OPC UA server as a source: what it publishes as it comes, and from its history what was missed.

The place is JSON, node id -> time [s] of its last sample that was delivered.  From there on the server's history is read
at every new connection, and where a queue overflowed, before anything newer is delivered: the filter takes readings in the
order of their times.  Where the server keeps no history, what was missed is lost, and the state says so.
"""

from __future__ import annotations

import asyncio
import heapq
import json
import logging
import time
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from collections.abc import Mapping as MappingOf
from dataclasses import replace

from hygrokf.live.sources.opcua_client import Connection
from hygrokf.live.sources.opcua_samples import ConnectionFault, HistoryFault, Node, Rates, Sample, library
from hygrokf.live.sources.opcua_security import Security, User
from hygrokf.live.sources.payload import AHEAD_S, EARLIEST_S, Mapping
from hygrokf.live.sources.streams import PAUSE_S, SourceFault, Threaded
from hygrokf.live.turbines import Delivery

LOG = logging.getLogger("hygrokf.track")
RETRY_S = (0.5, 1.0, 2.0, 5.0, 10.0, 30.0)
"""[s] between attempts to connect; the last one repeats."""
LASTING_S = 60.0
"""[s] after which a connection counts as one that holds: the next attempts begin with the shortest pause again."""
FIRST_S = 2.0
"""[s] for which the first samples of a subscription are waited for, beyond its own interval."""
AGAIN_S = 60.0
"""[s] after which nodes and histories that the server refused are asked for again."""
BATCH = 500
"""Deliveries with one place."""
NAMED = 5
"""Nodes that are named in a state; of the others only how many there are."""


class OpcUa(Threaded):
    """A subscription to nodes of one server, in an asyncio loop of its own.

    `look_back_s` [s] is how far back the history of a node is read that was never read before.  Each sample is a payload of
    plain names: turbine, time, quality, and the node's field; the mapping says which qualities count.
    """

    def __init__(
        self,
        url: str,
        nodes: Sequence[Node],
        mapping: Mapping,
        rates: Rates | None = None,
        look_back_s: float = 0.0,
        security: Security | None = None,
        user: User | None = None,
    ) -> None:
        super().__init__(mapping)
        self.url = url
        self.nodes = tuple(nodes)
        self._rates, self._look_back_s = rates or Rates(), look_back_s
        self._security, self._user = security, user
        self._put: Callable[[Delivery], None] = lambda one: None
        self._reached: dict[str, float] = {}
        self._since_s = 0.0
        self._last: dict[Node, tuple] = {}
        self._owed: set[Node] = set()
        self._refused: dict[Node, str] = {}
        self._bad: dict[Node, str] = {}
        self._unread: dict[Node, str] = {}
        self._overflows = {"in the server": 0, "here": 0}
        self._reading = self._changes_only = False

    @property
    def state(self) -> tuple[str, str]:
        word, behind = self._state
        if word != "connected":
            return word, behind
        notes = [
            "reads back what was missed" if self._reading else "",
            _named("not there or denied", self._refused),
            _named("bad now", self._bad),
            _named("no history, what was missed is lost", self._unread),
            "the server tells changes only" if self._changes_only else "",
            *(f"the queue {where} overflowed {n} times" for where, n in self._overflows.items() if n),
        ]
        return word, "; ".join([behind, *filter(None, notes)])

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        self._state = ("waiting", "not connected yet")
        self._put = put
        self._reached = self._begun(place)
        self._since_s = time.time() - self._look_back_s
        try:
            library()
        except ConnectionFault as fault:
            raise SourceFault(str(fault)) from None
        asyncio.run(self._follow())

    def _begun(self, place: str | None) -> dict[str, float]:
        """Times up to which nodes were delivered, as the place says; of those that it does not have, none."""
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

    # -- connections -------------------------------------------------------------------------------------------------
    def connection(self) -> Connection:
        """A connection to the server, which is not open yet."""
        return Connection(self.url, self._rates, self._security, self._user)

    async def _follow(self) -> None:
        """Connect, again and again, until told to stop."""
        attempt, told = 0, ""
        while not self._ended.is_set():
            connection = self.connection()
            began = time.monotonic()
            try:
                await connection.open()
                told = ""
                LOG.info("connected", extra={"source": self.url})
                await self._serve(connection)
            except Exception as fault:  # whatever a server sends, the tracker goes on
                attempt = 0 if time.monotonic() - began > LASTING_S else attempt
                pause_s = RETRY_S[min(attempt, len(RETRY_S) - 1)]
                self._state = ("waiting", f"{self.url}: {fault}; next attempt within {pause_s:g} s")
                if str(fault) != told:
                    unforeseen = None if isinstance(fault, ConnectionFault) else fault
                    said = {"source": self.url, "fault": str(fault)}
                    LOG.warning("not connected", extra=said, exc_info=unforeseen)
                told, attempt = str(fault), attempt + 1
                await self._pause(pause_s)
            finally:
                await connection.close()

    async def _pause(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while not self._ended.is_set() and time.monotonic() < end:
            await asyncio.sleep(PAUSE_S)

    async def _serve(self, connection: Connection) -> None:
        """Deliver what one connection brings until it is lost or the stream is stopped."""
        self._refused, self._unread, self._bad = {}, {}, {}
        self._owed = set()
        await self._begin(connection, self.nodes)
        again = time.monotonic() + AGAIN_S
        while not self._ended.is_set():
            connection.check()
            samples = await connection.samples(PAUSE_S)
            overflowed = [one for one in samples if one.overflowed]
            if overflowed:  # what was lost in the server was before them
                self._overflows["in the server"] += len(overflowed)
                await self._read_back(connection, {one.node: one.time for one in overflowed})
            await self._hand_over(samples)
            if connection.dropped:  # what is lost here is after them
                dropped, connection.dropped = connection.dropped, set()
                self._overflows["here"] += 1
                await self._read_back(connection, dict.fromkeys(dropped))
            if time.monotonic() > again:
                again = time.monotonic() + AGAIN_S
                await self._read_back(connection, dict.fromkeys(self._owed))
                await self._begin(connection, tuple(self._refused))

    async def _begin(self, connection: Connection, nodes: Sequence[Node]) -> None:
        """Subscribe to nodes, and deliver first what their history has before what the subscription begins with."""
        if not nodes:
            return
        self._refused = await connection.subscribe(nodes)
        self._changes_only = connection.unfiltered
        self._state = ("connected", self.url)
        first: dict[Node, float | None] = {}
        samples: list[Sample] = []
        awaited = set(nodes) - set(self._refused)
        end = time.monotonic() + self._rates.publishing_s + FIRST_S
        while awaited - set(first) and time.monotonic() < end and not self._ended.is_set():
            came = await connection.samples(PAUSE_S)
            samples += came
            for one in came:
                first.setdefault(one.node, one.time)
        await self._read_back(connection, {node: first.get(node) for node in awaited})
        await self._hand_over(samples)

    # -- what was missed ---------------------------------------------------------------------------------------------
    async def _read_back(self, connection: Connection, nodes: MappingOf[Node, float | None]) -> None:
        """Deliver what the server's history has of nodes since they were delivered, all of them in one order of time.

        nodes: node -> time [s] up to which (None: all of it), which is where what is delivered next begins.
        """
        self._owed |= set(nodes)
        histories = [self._missed(connection, node, until_s) for node, until_s in nodes.items()]
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

    async def _missed(
        self, connection: Connection, node: Node, until_s: float | None
    ) -> AsyncIterator[Sample]:
        """A node's history since it was delivered; what cannot be read now is owed until it can, or never will be."""
        since_s = self._reached.get(node.id, self._since_s)
        until_s = time.time() + AHEAD_S if until_s is None else until_s
        if self._ended.is_set():
            return
        try:
            if since_s < until_s:
                async for sample in connection.history(node, since_s, until_s):
                    yield sample
            self._unread.pop(node, None)
            self._owed.discard(node)
        except HistoryFault as fault:
            if node not in self._unread:
                LOG.warning(
                    "no history",
                    extra={"source": self.url, "node": node.id, "fault": str(fault), "final": fault.final},
                )
            self._unread[node] = str(fault)
            if fault.final:
                self._owed.discard(node)

    # -- deliveries --------------------------------------------------------------------------------------------------
    async def _hand_over(self, samples: Sequence[Sample], from_history: bool = False) -> None:
        """Deliver samples by time, in a thread of their own: where the service is busy they wait there, not the server."""
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
        """Whether a sample is not the node's last one once more, which every new subscription begins with."""
        seen, self._last[one.node] = self._last.get(one.node), (one.time, one.value, one.word)
        return seen != self._last[one.node]

    def _note(self, one: Sample, from_history: bool) -> None:
        """Remember how far a node is delivered, unless something before that is still owed."""
        if one.time is not None and EARLIEST_S <= one.time <= one.received + AHEAD_S:
            if from_history or one.node not in self._owed:
                self._reached[one.node.id] = max(one.time, self._reached.get(one.node.id, 0.0))
        if one.quality == "bad":
            self._bad[one.node] = one.word
        else:
            self._bad.pop(one.node, None)

    def delivery(self, one: Sample) -> Delivery:
        """What a sample delivers."""
        content: dict[str, object] = {"turbine": one.node.turbine, "time": one.time, "quality": one.quality}
        if one.quality != "bad":
            content[one.node.field] = self._number(one)
        return Delivery(content, one.received)

    def _number(self, one: Sample) -> object:
        """A number as it is, true and false as 1 and 0 of a field in that unit; of all else its kind, which is no number."""
        if isinstance(one.value, bool) and self.mapping.fields[one.node.field].unit == "1":
            return int(one.value)
        return one.value if type(one.value) in (int, float) else type(one.value).__name__


async def in_order(histories: Iterable[AsyncIterator[Sample]]) -> AsyncIterator[Sample]:
    """Samples of several nodes, of which each is in order, in one order of time."""
    heads: list[tuple[float, int, Sample, AsyncIterator[Sample]]] = []
    for number, history in enumerate(histories):
        sample = await anext(history, None)
        if sample is not None:
            heapq.heappush(heads, (sample.time or 0.0, number, sample, history))
    while heads:
        _, number, sample, history = heads[0]
        yield sample
        sample = await anext(history, None)
        if sample is None:
            heapq.heappop(heads)
        else:
            heapq.heapreplace(heads, (sample.time or 0.0, number, sample, history))


def _named(words: str, nodes: MappingOf[Node, str]) -> str:
    """Nodes with the server's word for each, of many the first; empty without any."""
    found = [f"{node.id} ({word})" for node, word in tuple(nodes.items())]
    more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    return f"{words}: {', '.join(found[:NAMED])}{more}" if found else ""
