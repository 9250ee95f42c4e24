"""The page's server: it listens, in a thread of its own beside the tracker's."""

from __future__ import annotations

import errno
import socket
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from hygrokf.live.web.events import Hub
from hygrokf.live.web.page_settings import NEEDED, PageFault, PageSettings

if TYPE_CHECKING:
    import uvicorn

START_S = 10.0
STOP_S = 5.0
"""[s] that starting and ending may take."""
GRACE_S = 2
"""[s] that answers under way have when the server ends."""
REQUESTS = 500
"""Connections at most; more are told to come again."""
REASONS = {
    errno.EADDRINUSE: "the port is in use by another program; end that one, or give another port",
    errno.EACCES: "this port is for the system alone; give one above 1023",
    errno.EADDRNOTAVAIL: "this machine does not have this address",
}


class PageServer:
    """A server that runs; `port` is the one that it has, whatever was asked for.  Ends with `stop`, or with its block."""

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
        host = f"[{self._settings.host}]" if ":" in self._settings.host else self._settings.host
        return f"{'https' if self._settings.certificate else 'http'}://{host}:{self.port}/"

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


def serve(app: Callable, settings: PageSettings, hub: Hub) -> PageServer:
    """Serve an application in a thread; port 0 takes one that is free.  Raises PageFault."""
    try:
        import uvicorn
    except ImportError:
        raise PageFault(NEEDED) from None
    listening = bound(settings)
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            http="h11",
            ws="none",
            loop="asyncio",
            lifespan="off",
            interface="asgi3",
            log_config=None,
            log_level="warning",
            access_log=False,
            server_header=False,
            proxy_headers=settings.behind_proxy,
            timeout_graceful_shutdown=GRACE_S,
            limit_concurrency=REQUESTS,
            ssl_certfile=settings.certificate or None,
            ssl_keyfile=settings.key or None,
        )
    )
    try:
        server.config.load()
    except OSError as fault:  # of TLS, too
        listening.close()
        raise PageFault(f"the page's certificate cannot be used: {fault.strerror or fault}") from None
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


def bound(settings: PageSettings) -> socket.socket:
    """A socket that listens at the page's address.  Raises PageFault."""
    try:
        found = socket.getaddrinfo(
            settings.host, settings.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
        family, _, _, _, place = found[0]
        return socket.create_server(place[:2], family=family, backlog=128)
    except OSError as fault:
        reason = REASONS.get(fault.errno or 0, fault.strerror or str(fault))
        raise PageFault(f"the page cannot be served at {settings.host}:{settings.port}: {reason}") from None
