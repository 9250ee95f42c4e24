"""The page's server, which runs in its own thread beside the tracker, and its server-sent events.

The events tell the page which turbines a commit has changed.  The tracker's thread notifies the `Hub`, which
passes the names to the asyncio loop of the page's thread.  For each client only the names not yet sent are
kept, so that a slow client costs no memory.
"""

from __future__ import annotations

import asyncio
import errno
import json
import logging
import re
import socket
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import TYPE_CHECKING

from hygrokf.data.structured import Json
from hygrokf.live.batch import Batch
from hygrokf.live.sources.endpoint import bracketed
from hygrokf.live.web.access import answer
from hygrokf.live.web.connections import WAITING, WAITING_OF_ADDRESS, Connections, watched
from hygrokf.live.web.page_settings import NEEDED, PageFault, PageSettings

if TYPE_CHECKING:
    import uvicorn
    from starlette.types import ASGIApp, Receive, Scope, Send

START_S = 10.0
STOP_S = 5.0
"""[s] allowed for starting and for stopping."""
GRACE_S = 2
"""[s] for responses in progress when the server stops."""
REASONS = {
    errno.EADDRINUSE: "the port is in use by another program; end that one, or give another port",
    errno.EACCES: "this port is reserved for the system; give one above 1023",
    errno.EADDRNOTAVAIL: "this machine does not have this address",
}
LOG = logging.getLogger("hygrokf.page")
CLIENTS = 200
"""Largest number of open event streams."""
PACE_S = 1.0
"""Shortest interval [s] between two messages to one client."""
ALIVE_S = 10.0
"""[s] without changes after which a client gets a heartbeat."""
SLOW_S = 10.0
"""[s] after which a client that accepts no data is dropped."""
RETRY_MS = 2000
"""[ms] after which a browser reconnects."""
NAMED = 200
"""Largest number of turbines named in a message; a message about more of them stands for all."""


class PageServer:
    """A running server, ended by `stop` or by leaving its context.

    `port` is the actual port, also if port 0 was requested.
    """

    def __init__(
        self, thread: threading.Thread, server: uvicorn.Server, hub: Hub, settings: PageSettings, port: int
    ) -> None:
        self._thread = thread
        self._server = server
        self._hub = hub
        self._settings = settings
        self.port = port

    @property
    def url(self) -> str:
        scheme = "https" if self._settings.certificate else "http"
        return f"{scheme}://{bracketed(self._settings.host)}:{self.port}/"

    def stop(self) -> None:
        """End the event streams, then the server, within `STOP_S`."""
        self._hub.close()
        self._server.should_exit = True
        self._thread.join(timeout=STOP_S)

    @property
    def running(self) -> bool:
        return self._thread.is_alive()

    def __enter__(self) -> PageServer:
        return self

    def __exit__(self, *fault: object) -> None:
        self.stop()


def serve(app: ASGIApp, settings: PageSettings, hub: Hub) -> PageServer:
    """Serve an application in a thread; port 0 selects a free port.  Raises PageFault."""
    try:
        import uvicorn
    except ImportError:
        raise PageFault(NEEDED) from None
    connections = Connections(WAITING if settings.behind_proxy else WAITING_OF_ADDRESS)
    listening = watched(listening_socket(settings), connections)
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            http="h11",
            ws="none",
            loop="asyncio",
            lifespan="off",
            interface="asgi3",
            log_config=None,
            log_level="error",  # a client's mistakes do not fill the log
            access_log=False,
            server_header=False,
            proxy_headers=settings.behind_proxy,
            timeout_graceful_shutdown=GRACE_S,
            ssl_certfile=settings.certificate or None,
            ssl_keyfile=settings.key or None,
        )
    )
    try:
        server.config.load()
    except OSError as fault:  # TLS errors are OSErrors, too
        listening.close()
        raise PageFault(f"the page's certificate cannot be used: {fault.strerror or fault}") from None
    for name in ("uvicorn.error", "asyncio"):
        logging.getLogger(name).addFilter(is_own_mistake)
    # outside of what puts a proxy's clients in the place of the connections' own addresses
    server.config.loaded_app = connections.limited(server.config.loaded_app)
    thread = threading.Thread(target=server.run, args=([listening],), name="page", daemon=True)
    thread.start()
    end = time.monotonic() + START_S
    while not server.started and thread.is_alive() and time.monotonic() < end:
        time.sleep(0.01)
    made = PageServer(thread, server, hub, settings, listening.getsockname()[1] if server.started else 0)
    if not server.started:
        made.stop()
        listening.close()
        raise PageFault(f"the page did not start within {START_S:g} s; the log says why")
    return made


def is_own_mistake(record: logging.LogRecord) -> bool:
    """Whether an error that uvicorn or asyncio logs is one of the program.

    It is not where a request turned out to be malformed while it was being answered: uvicorn has refused it
    then, and the answer comes too late.  It is not either where uvicorn fails to refuse a malformed HEAD or
    CONNECT, whose answers have no body; the connection is closed.
    """
    fault = record.exc_info[1] if record.exc_info else None
    if type(fault).__name__ != "LocalProtocolError":
        return True
    too_late = re.search(r"our state is|role=SERVER and state=", str(fault))
    return record.name != "asyncio" and too_late is None


def listening_socket(settings: PageSettings) -> socket.socket:
    """A socket listening at the page's address.  Raises PageFault."""
    try:
        found = socket.getaddrinfo(
            settings.host, settings.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
        family, _, _, _, place = found[0]
        return socket.create_server(place[:2], family=family, backlog=128)
    except OSError as fault:
        reason = REASONS.get(fault.errno or 0, fault.strerror or str(fault))
        raise PageFault(f"the page cannot be served at {settings.host}:{settings.port}: {reason}") from None


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
        names = frozenset(names)
        with self._lock:
            self.generation += 1
            loop = self._loop
        self._call(loop, self._spread, names)

    def close(self) -> None:
        """End all event streams and accept no new one; callable from any thread."""
        with self._lock:
            self.closed = True
            loop = self._loop
        self._call(loop, self._spread, frozenset())

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

    def _spread(self, names: frozenset[str]) -> None:
        for client in self._clients:
            client.names |= names
            client.wake.set()

    def _call(
        self,
        loop: asyncio.AbstractEventLoop | None,
        function: Callable[[frozenset[str]], None],
        names: frozenset[str],
    ) -> None:
        if loop is not None:
            with suppress(RuntimeError):  # the page has stopped
                loop.call_soon_threadsafe(function, names)


def message(kind: str, **content: Json) -> bytes:
    """One server-sent event; heartbeats are events too, because scripts cannot see comments."""
    return f"event: {kind}\ndata: {json.dumps(content)}\n\n".encode()


class EventStream:
    """The ASGI application behind `/events`."""

    def __init__(self, hub: Hub) -> None:
        self.hub = hub

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        client = self.hub.join()
        if client is None:
            await answer(send, 503, "too many pages are open", {"Retry-After": "10"})
            return
        gone = asyncio.create_task(_gone(receive))
        try:
            start = {"type": "http.response.start", "status": 200}
            await send(
                {**start, "headers": [(b"content-type", b"text/event-stream"), (b"x-accel-buffering", b"no")]}
            )
            await self._send(send, f"retry: {RETRY_MS}\n\n".encode() + message("alive", now=self.hub.clock()))
            while not self.hub.closed and not gone.done():
                await self._wait(client, gone)
                names = client.take()
                if names:
                    named = sorted(names) if len(names) <= NAMED else None
                    await self._send(send, message("changed", now=self.hub.clock(), turbines=named))
                    await asyncio.wait([gone], timeout=0.0 if self.hub.closed else PACE_S)
                elif not self.hub.closed and not gone.done():
                    await self._send(send, message("alive", now=self.hub.clock()))
            await self._send(send, b"", more=False)
        except TimeoutError:
            LOG.warning("dropped a page that accepted no data for %g s", SLOW_S)
        finally:
            self.hub.leave(client)
            gone.cancel()

    async def _send(self, send: Send, body: bytes, more: bool = True) -> None:
        async with asyncio.timeout(SLOW_S):
            await send({"type": "http.response.body", "body": body, "more_body": more})

    async def _wait(self, client: Client, gone: asyncio.Task[None]) -> None:
        """Wait until there is something to send, the client has gone, or a heartbeat is due."""
        waking = asyncio.ensure_future(client.wake.wait())
        try:
            await asyncio.wait([waking, gone], timeout=ALIVE_S, return_when=asyncio.FIRST_COMPLETED)
        finally:
            waking.cancel()


async def _gone(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
