"""The page's server, which runs in its own thread beside the tracker, and its server-sent events.

The events tell the page which turbines a commit has changed.  The tracker's thread notifies the `Hub`, which
passes the names to the asyncio loop of the page's thread.  For each client only the names not yet sent are
kept, so that a slow client costs no memory.
"""

from __future__ import annotations

import asyncio
import errno
import json
import os
import socket
import stat
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from hygrokf.data.structured import Json
from hygrokf.live.batch import Batch
from hygrokf.live.web.exchange import refusal
from hygrokf.live.web.page_settings import NEEDED, PageFault, PageSettings

if TYPE_CHECKING:
    import uvicorn
    from starlette.types import ASGIApp, Receive, Scope, Send

START_S = 10.0
STOP_S = 5.0
"""[s] allowed for starting and for stopping."""
GRACE_S = 2
"""[s] for responses in progress when the server stops."""
MOST = 500
"""Largest number of connections; further ones are closed at once."""
SILENT_S = 10.0
"""[s] until a new connection must have sent the headers of its first request."""
BACKLOG = 100
"""Largest number of connections that wait to be accepted, and that are accepted at a time."""
REASONS = {
    errno.EADDRINUSE: "the port is in use by another program; end that one, or give another port",
    errno.EACCES: "this port is reserved for the system; give one above 1023",
    errno.EADDRNOTAVAIL: "this machine does not have this address",
}
CLIENTS = 200
"""Largest number of open event streams."""
PACE_S = 1.0
"""Shortest interval [s] between two messages to one client."""
ALIVE_S = 10.0
"""[s] without changes after which a client gets a heartbeat."""
RETRY_MS = 2000
"""[ms] after which a browser reconnects."""
NAMED = 200
"""Largest number of turbines named in a message; a message about more of them stands for all."""


@dataclass(frozen=True)
class PageServer:
    """A running server; `port` is the actual one, also if port 0 was requested (0 at a Unix socket)."""

    server: uvicorn.Server
    thread: threading.Thread
    url: str
    port: int


@contextmanager
def serve(app: ASGIApp, settings: PageSettings, hub: Hub) -> Iterator[PageServer]:
    """Serve an application in a thread, within this context; port 0 selects a free port.  Raises PageFault.

    At its end the event streams end, then the server, within `STOP_S`.
    """
    try:
        import uvicorn
    except ImportError:
        raise PageFault(NEEDED) from None
    listening = listening_socket(settings)
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            http=bounded_protocol(),
            ws="none",
            loop="asyncio",
            lifespan="off",
            interface="asgi3",
            log_config=None,
            log_level="error",
            access_log=False,
            server_header=False,
            proxy_headers=settings.behind_proxy,
            forwarded_allow_ips="*",  # who reaches the page past the proxy can only cheat itself
            backlog=BACKLOG,
            timeout_graceful_shutdown=GRACE_S + 1,
        )
    )
    thread = threading.Thread(target=server.run, args=([listening],), name="page", daemon=True)
    thread.start()
    end = time.monotonic() + START_S
    while not server.started and thread.is_alive() and time.monotonic() < end:
        time.sleep(0.01)
    try:
        if not server.started:
            listening.close()
            raise PageFault(f"the page did not start within {START_S:g} s; the log says why")
        port = 0 if settings.unix else listening.getsockname()[1]
        place = replace(settings, port=port).place
        yield PageServer(server, thread, place if settings.unix else f"http://{place}/", port)
    finally:
        hub.close()
        server.should_exit = True
        thread.join(timeout=STOP_S)


def bounded_protocol() -> type[asyncio.Protocol]:
    """uvicorn's protocol of a connection, of at most `MOST`: half-open ones must not take the files that the
    tracker opens, and uvicorn's own limit refuses requests, but closes no connection that makes none."""
    from uvicorn.protocols.http.h11_impl import H11Protocol

    class BoundedProtocol(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            self._silence = self.loop.call_later(SILENT_S, self._end_if_silent)
            if len(self.connections) > MOST:
                transport.abort()

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            self._silence.cancel()

        def shutdown(self) -> None:
            super().shutdown()
            # a client that takes nothing would keep its end open for ever
            self.loop.call_later(GRACE_S, self.transport.abort)

        def _end_if_silent(self) -> None:
            if self.cycle is None:
                self.transport.abort()

    return BoundedProtocol


def listening_socket(settings: PageSettings) -> socket.socket:
    """A socket listening at the page's address.  Raises PageFault."""
    try:
        if settings.unix:
            return _unix_socket(settings.unix)
        found = socket.getaddrinfo(
            settings.host, settings.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
        family, _, _, _, place = found[0]
        return socket.create_server(place[:2], family=family, backlog=BACKLOG)
    except OSError as fault:
        known = {} if settings.unix else REASONS
        reason = known.get(fault.errno or 0, fault.strerror or str(fault))
        raise PageFault(f"the page cannot be served at {settings.place}: {reason}") from None


def _unix_socket(path: str) -> socket.socket:
    """A listening Unix socket in the place of one whose program has ended."""
    made = socket.socket(socket.AF_UNIX)
    try:
        if os.path.exists(path) and stat.S_ISSOCK(os.stat(path).st_mode) and made.connect_ex(path) != 0:
            os.unlink(path)
        made.bind(path)
        os.chmod(path, 0o666)  # its folder says who may come, the token who may read
        made.listen(BACKLOG)
    except OSError:
        made.close()
        raise
    return made


# -- events --------------------------------------------------------------------------------------------------
def changed_turbines(batch: Batch) -> set[str]:
    """Turbines for which a batch changes the page."""
    named = {o.turbine for o in batch.observations} | {a.turbine for a in (*batch.alarms, *batch.reopened)}
    named |= set(batch.estimates)
    named |= {name for name, *_ in batch.properties}
    named |= {name for name, _ in (*batch.memories, *batch.counters)}
    return named - {""}


class Client:
    """One event stream with the turbine names not yet sent.  Only the page's loop uses it."""

    def __init__(self) -> None:
        self.names: set[str] = set()
        self.wake = asyncio.Event()

    def take(self) -> set[str]:
        names, self.names = self.names, set()
        self.wake.clear()
        return names


class Hub:
    """Passes changes from the tracker to the event streams.

    `generation` counts the changes: data read from the store stay valid until it increases.
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
        """Announce a committed batch; called by the tracker."""
        self.changed(changed_turbines(batch))

    def changed(self, names: Iterable[str]) -> None:
        """Tell all clients that turbines changed; callable from any thread."""
        with self._lock:
            self.generation += 1
        self._tell(frozenset(names))

    def close(self) -> None:
        """End all event streams and accept no new one; callable from any thread."""
        with self._lock:
            self.closed = True
        self._tell(frozenset())

    def join(self) -> Client | None:
        """A new client in the running loop; None if there are too many or the hub is closed."""
        with self._lock:
            self._loop = asyncio.get_running_loop()
            if self.closed or len(self._clients) >= self.most:
                return None
        client = Client()
        self._clients.add(client)
        return client

    def leave(self, client: Client) -> None:
        self._clients.discard(client)

    def _tell(self, names: frozenset[str]) -> None:
        if self._loop is not None:
            with suppress(RuntimeError):  # the page has stopped
                self._loop.call_soon_threadsafe(self._spread, names)

    def _spread(self, names: frozenset[str]) -> None:
        for client in self._clients:
            client.names |= names
            client.wake.set()


def message(kind: str, **content: Json) -> bytes:
    """One server-sent event; heartbeats are events too, because scripts cannot see comments."""
    return f"event: {kind}\ndata: {json.dumps(content)}\n\n".encode()


class EventStream:
    """The ASGI application behind `/events`."""

    def __init__(self, hub: Hub) -> None:
        self.hub = hub

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        from starlette.responses import StreamingResponse

        client = self.hub.join()
        if client is None:
            await refusal(503, "too many pages are open", {"Retry-After": "10"})(scope, receive, send)
            return
        try:
            headers = {"Content-Type": "text/event-stream", "X-Accel-Buffering": "no"}
            await StreamingResponse(self._messages(client), headers=headers)(scope, receive, send)
        finally:
            self.hub.leave(client)

    async def _messages(self, client: Client) -> AsyncIterator[bytes]:
        yield f"retry: {RETRY_MS}\n\n".encode() + message("alive", now=self.hub.clock())
        while not self.hub.closed:
            with suppress(TimeoutError):
                await asyncio.wait_for(client.wake.wait(), ALIVE_S)
            names = client.take()
            if names:
                named = sorted(names) if len(names) <= NAMED else None
                yield message("changed", now=self.hub.clock(), turbines=named)
                await asyncio.sleep(0.0 if self.hub.closed else PACE_S)
            elif not self.hub.closed:
                yield message("alive", now=self.hub.clock())
