"""The page's connections: limited in number and time, so that half-open ones keep nobody out.

A connection waits while no request of it is being answered: after its beginning, during a TLS handshake, and
after each answer.  Waiting connections are closed after some time, and the oldest ones once there are too
many, so that a new connection always gets its turn.  A monitoring system's `/healthz` is answered beyond the
limit on requests, too.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

from hygrokf.live.web.access import answer, headed

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Receive, Scope, Send

LOG = logging.getLogger("hygrokf.page")
HEADER_S = 10.0
"""[s] a new connection may take until its first request is complete up to the end of its headers."""
IDLE_S = 30.0
"""[s] the same after an answer, during which the end of that answer may still be on its way."""
ANSWER_S = 120.0
"""[s] an answer may take, except for event streams."""
WAITING = 256
"""Largest number of waiting connections."""
WAITING_OF_ADDRESS = 64
"""The same from one address, unless that is a proxy's."""
REQUESTS = 500
"""Largest number of requests that are answered at the same time; further ones are told to retry."""
SWEEP_S = 0.5
"""[s] between two searches for connections that have waited too long."""
HEALTH = ("/healthz", "/readyz")
EVENTS = "/events"
Peer = tuple[str, int]
"""A client's address and port."""


class Waiting(NamedTuple):
    """A waiting connection, and until when it may wait [s]."""

    connection: socket.socket
    until: float

    def close(self) -> None:
        """End the connection in both directions; its transport notices this and closes the socket."""
        with suppress(OSError):  # the client was faster
            self.connection.shutdown(socket.SHUT_RDWR)


class Connections:
    """The connections of one server, used in its loop only."""

    def __init__(
        self, of_address: int = WAITING_OF_ADDRESS, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.busy = 0
        self._of_address = of_address
        self._clock = clock
        self._waiting: dict[Peer, Waiting] = {}
        self._sweeping = False

    def __len__(self) -> int:
        """Number of waiting connections."""
        return len(self._waiting)

    def enter(self, connection: socket.socket, peer: Peer) -> None:
        """Note an accepted connection, and close the oldest waiting ones if there are too many."""
        self._wait(connection, peer, HEADER_S)
        # closed sockets have no number any more
        self._waiting = {key: one for key, one in self._waiting.items() if one.connection.fileno() != -1}
        own = [key for key in self._waiting if key[0] == peer[0]]
        for key in own[: max(len(own) - self._of_address, 0)]:
            self._waiting.pop(key).close()
        for key in list(self._waiting)[: max(len(self._waiting) - WAITING, 0)]:
            self._waiting.pop(key).close()

    def _wait(self, connection: socket.socket, peer: Peer, seconds: float) -> None:
        self._waiting[peer] = Waiting(connection, self._clock() + seconds)
        self._sweep_later()

    def _sweep_later(self) -> None:
        """Look for connections that have waited too long, as long as any are waiting."""
        if self._waiting and not self._sweeping:
            self._sweeping = True
            asyncio.get_running_loop().call_later(SWEEP_S, self._sweep)

    def _sweep(self) -> None:
        """Close connections that have waited too long."""
        now = self._clock()
        for key in [key for key, one in self._waiting.items() if one.until < now]:
            self._waiting.pop(key).close()
        self._sweeping = False
        self._sweep_later()

    def limited(self, app: ASGIApp) -> ASGIApp:
        """Wrap the outermost ASGI application, which sees the connections' own addresses."""

        async def limited(scope: Scope, receive: Receive, send: Send) -> None:
            host, port = scope["client"] or ("", 0)
            if self.busy >= REQUESTS and scope["path"] not in HEALTH:
                await answer(headed(send), 503, "too many requests at a time", {"Retry-After": "10"})
                return
            held = self._waiting.pop((host, port), None)
            self.busy += 1
            try:
                async with asyncio.timeout(None if scope["path"] == EVENTS else ANSWER_S) as limit:
                    await app(scope, receive, send)
            except TimeoutError:
                if not limit.expired():
                    raise
                LOG.warning("a client did not take its answer within %g s", ANSWER_S)
            finally:
                self.busy -= 1
                if held is not None:
                    self._wait(held.connection, (host, port), 0.0 if limit.expired() else IDLE_S)

        return limited


class ListeningSocket(socket.socket):
    """A listening socket that notes every accepted connection."""

    connections: Connections | None = None

    def accept(self) -> tuple[socket.socket, tuple[str, int]]:
        connection, place = super().accept()
        if self.connections is not None:
            self.connections.enter(connection, (str(place[0]), int(place[1])))
        return connection, place


def watched(plain: socket.socket, connections: Connections) -> ListeningSocket:
    """A listening socket in the place of a plain one, which is used up."""
    made = ListeningSocket(plain.family, plain.type, plain.proto, plain.detach())
    made.connections = connections
    return made
