"""What the page is told as it happens: which turbines a commit changed, as server-sent events.

The tracker's thread tells the `Hub`, which hands it to the loop of the page's own thread.  For each client only the names
are kept that it was not told yet, so that one that reads slowly costs no memory.
"""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress

from hygrokf.live.storage.store import Batch
from hygrokf.live.web.access import answer

LOG = logging.getLogger("hygrokf.page")
CLIENTS = 200
"""Open event streams at most."""
PACE_S = 1.0
"""[s] between two messages to one client at least."""
ALIVE_S = 10.0
"""[s] of silence after which a client is told that the page is alive."""
SLOW_S = 10.0
"""[s] after which a client that takes nothing is dropped."""
RETRY_MS = 2000
"""[ms] after which a browser that lost the page tries again."""
NAMED = 200
"""Turbines that a message names at most; more of them are told as all."""


def changed_by(batch: Batch) -> set[str]:
    """Turbines of which a batch changes what the page shows."""
    named = {o.turbine for o in batch.observations} | {a.turbine for a in batch.alarms} | set(batch.estimates)
    named |= {name for name, *_ in batch.properties}
    named |= {name for name, _ in (*batch.memories, *batch.counters)}
    return named - {""}


class Client:
    """One event stream: what it was not told yet.  Used in the page's loop alone."""

    def __init__(self) -> None:
        self.names: set[str] = set()
        self.wake = asyncio.Event()

    def taken(self) -> set[str]:
        names, self.names = self.names, set()
        self.wake.clear()
        return names


class Hub:
    """Where the tracker tells what changed, and event streams wait for it.

    `generation` counts the changes: what was read from the store at one is good until the next.
    """

    def __init__(self, most: int = CLIENTS, clock: Callable[[], float] = time.time) -> None:
        self.most = most
        self.clock = clock
        self.generation = 0
        self.closed = False
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._clients: set[Client] = set()

    def __len__(self) -> int:
        return len(self._clients)

    def settle(self, batch: Batch) -> None:
        """What the tracker calls after a commit."""
        self.changed(changed_by(batch))

    def changed(self, names: Iterable[str]) -> None:
        """Tell all clients that turbines changed; from any thread."""
        names = frozenset(names)
        with self._lock:
            self.generation += 1
            loop = self._loop
        self._call(loop, self._spread, names)

    def close(self) -> None:
        """End all event streams and begin no other; from any thread."""
        with self._lock:
            self.closed = True
            loop = self._loop
        self._call(loop, self._spread, frozenset())

    def joined(self) -> Client | None:
        """A new client of the loop that runs; None where there are as many as may be."""
        with self._lock:
            self._loop = asyncio.get_running_loop()
            if self.closed or len(self._clients) >= self.most:
                return None
        client = Client()
        self._clients.add(client)
        return client

    def left(self, client: Client) -> None:
        self._clients.discard(client)

    def _spread(self, names: frozenset[str]) -> None:
        for client in self._clients:
            client.names |= names
            client.wake.set()

    def _call(
        self, loop: asyncio.AbstractEventLoop | None, function: Callable, names: frozenset[str]
    ) -> None:
        if loop is not None:
            with suppress(RuntimeError):  # the page has stopped
                loop.call_soon_threadsafe(function, names)


def message(kind: str, **content: object) -> bytes:
    """One server-sent event; a heartbeat is one too, because pages do not see comments."""
    return f"event: {kind}\ndata: {json.dumps(content)}\n\n".encode()


class EventStream:
    """The ASGI application behind `/events`."""

    def __init__(self, hub: Hub) -> None:
        self.hub = hub

    async def __call__(self, scope: Mapping, receive: Callable, send: Callable) -> None:
        client = self.hub.joined()
        if client is None:
            await answer(send, 503, "too many pages are open", {"Retry-After": "10"})
            return
        gone = asyncio.create_task(_gone(receive))
        try:
            start = {"type": "http.response.start", "status": 200}
            await send(
                {**start, "headers": [(b"content-type", b"text/event-stream"), (b"x-accel-buffering", b"no")]}
            )
            await self._told(send, f"retry: {RETRY_MS}\n\n".encode() + message("alive", now=self.hub.clock()))
            while not self.hub.closed and not gone.done():
                await self._waited(client, gone)
                names = client.taken()
                if names:
                    named = sorted(names) if len(names) <= NAMED else None
                    await self._told(send, message("changed", now=self.hub.clock(), turbines=named))
                    await asyncio.wait([gone], timeout=0.0 if self.hub.closed else PACE_S)
                elif not self.hub.closed and not gone.done():
                    await self._told(send, message("alive", now=self.hub.clock()))
            await self._told(send, b"", more=False)
        except TimeoutError:
            LOG.warning("a page that took nothing for %g s was dropped", SLOW_S)
        finally:
            self.hub.left(client)
            gone.cancel()

    async def _told(self, send: Callable, body: bytes, more: bool = True) -> None:
        async with asyncio.timeout(SLOW_S):
            await send({"type": "http.response.body", "body": body, "more_body": more})

    async def _waited(self, client: Client, gone: asyncio.Task) -> None:
        """Until there is something to tell, the client has gone, or it is time for a sign of life."""
        waking = asyncio.ensure_future(client.wake.wait())
        try:
            await asyncio.wait([waking, gone], timeout=ALIVE_S, return_when=asyncio.FIRST_COMPLETED)
        finally:
            waking.cancel()


async def _gone(receive: Callable) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
