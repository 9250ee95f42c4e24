"""The page's server in its own thread beside the tracker: access, JSON, and server-sent events.

The events tell the page which turbines a commit has changed.  The tracker's thread notifies the `Hub`, which
passes the names to the asyncio loop of the page's thread.  Only the names that a client has not yet received
are kept, so that a slow client costs no memory.
"""

from __future__ import annotations

import asyncio
import errno
import hashlib
import hmac
import json
import os
import secrets
import socket
import stat
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from hygrokf.data.structured import Json, JsonObject
from hygrokf.data.timestamps import DAY_S
from hygrokf.live.batch import Alarm, Batch, pieces_of
from hygrokf.live.web.page_settings import MISSING_PACKAGES, PageFault, PageSettings

if TYPE_CHECKING:
    import uvicorn
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

START_S = 10.0
START_AND_STOP_S = 5.0
"""Longest time that starting, and stopping, may take [s]."""
GRACE_S = 2
"""[s] that responses in progress may take when the server stops."""
MOST_CONNECTIONS = 500
"""Largest number of connections; further ones are closed at once."""
REQUEST_SILENT_S = 10.0
"""[s] until a new connection must have sent the headers of its first request."""
BACKLOG = 100
"""Largest number of connections that wait to be accepted, and that are accepted at a time."""
REASONS = {
    errno.EADDRINUSE: "the port is in use by another program; end that one, or give another port",
    errno.EACCES: "this port is reserved for the system; give one above 1023",
    errno.EADDRNOTAVAIL: "this machine does not have this address",
}
MOST_CLIENTS = 200
"""Largest number of open event streams."""
MESSAGE_PAUSE_S = 1.0
"""Shortest interval [s] between two messages to one client."""
HEARTBEAT_S = 10.0
"""[s] without changes after which a client gets a heartbeat."""
RETRY_MS = 2000
"""[ms] after which a browser reconnects."""
MOST_NAMED = 200
"""Largest number of turbines named in a message; a message without names stands for all turbines."""


@dataclass(frozen=True)
class PageServer:
    """A running server; `port` is the bound port even if port 0 was requested, and 0 for a Unix socket."""

    server: uvicorn.Server
    thread: threading.Thread
    url: str
    port: int


@contextmanager
def serve(app: ASGIApp, settings: PageSettings, hub: Hub) -> Iterator[PageServer]:
    """Serve an application in a thread within this context; port 0 selects a free port.  Raises PageFault.

    When the context ends, the event streams end and then the server, within `START_AND_STOP_S`.
    """
    try:
        import uvicorn
    except ImportError:
        raise PageFault(MISSING_PACKAGES) from None
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
            forwarded_allow_ips="*",  # a client that bypasses the proxy can deceive only itself
            backlog=BACKLOG,
            timeout_graceful_shutdown=GRACE_S + 1,
        )
    )
    thread = threading.Thread(target=server.run, args=([listening],), name="page", daemon=True)
    thread.start()
    deadline_s = time.monotonic() + START_S
    while not server.started and thread.is_alive() and time.monotonic() < deadline_s:
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
        thread.join(timeout=START_AND_STOP_S)


def bounded_protocol() -> type[asyncio.Protocol]:
    """Return uvicorn's class for a connection, limited to `MOST_CONNECTIONS` connections.

    Half-open connections must not take the file descriptors that the tracker needs; uvicorn's own limit
    refuses requests, but does not close a connection without requests.
    """
    from uvicorn.protocols.http.h11_impl import H11Protocol

    class BoundedProtocol(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            """Close a connection beyond the limit, and later one that sends no request."""
            super().connection_made(transport)
            self._silence = self.loop.call_later(REQUEST_SILENT_S, self._end_if_silent)
            if len(self.connections) > MOST_CONNECTIONS:
                transport.abort()

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            self._silence.cancel()

        def shutdown(self) -> None:
            """End the connection, at the latest after `GRACE_S`."""
            super().shutdown()
            # a client that reads nothing would keep the connection open for ever
            self.loop.call_later(GRACE_S, self.transport.abort)

        def _end_if_silent(self) -> None:
            if self.cycle is None:
                self.transport.abort()

    return BoundedProtocol


def listening_socket(settings: PageSettings) -> socket.socket:
    """Return a socket that listens at the page's address.  Raises PageFault."""
    try:
        if settings.unix:
            return _unix_socket(settings.unix)
        addresses = socket.getaddrinfo(
            settings.host, settings.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
        family, _, _, _, place = addresses[0]
        return socket.create_server(place[:2], family=family, backlog=BACKLOG)
    except OSError as fault:
        reasons = {} if settings.unix else REASONS
        reason = reasons.get(fault.errno or 0, fault.strerror or str(fault))
        raise PageFault(f"the page cannot be served at {settings.place}: {reason}") from None


def _unix_socket(path: str) -> socket.socket:
    """Return a listening Unix socket, which replaces a socket whose program has ended."""
    listening = socket.socket(socket.AF_UNIX)
    try:
        if os.path.exists(path) and stat.S_ISSOCK(os.stat(path).st_mode) and listening.connect_ex(path) != 0:
            os.unlink(path)
        listening.bind(path)
        os.chmod(path, 0o666)  # its folder's mode controls access, and the token too
        listening.listen(BACKLOG)
    except OSError:
        listening.close()
        raise
    return listening


# -- events --------------------------------------------------------------------------------------------------
def changed_turbines(batch: Batch) -> set[str]:
    """Return the turbines for which a batch changes the page."""
    names = {observed.turbine for observed in batch.observations}
    names |= {alarm.turbine for alarm in (*batch.alarms, *batch.reopened)}
    names |= set(batch.estimates)
    names |= {name for name, *_ in batch.properties}
    names |= {name for name, _ in (*batch.memories, *batch.counters)}
    return names - {""}


class Client:
    """One event stream with the turbine names not yet sent, used only in the page's loop."""

    def __init__(self) -> None:
        self.names: set[str] = set()
        self.wake = asyncio.Event()

    def take(self) -> set[str]:
        """Return the names that were not sent yet, and forget them."""
        names, self.names = self.names, set()
        self.wake.clear()
        return names


class Hub:
    """Passes changes from the tracker to the event streams.

    `generation` counts the changes: data read from the store stay valid until it increases.
    """

    def __init__(self, most: int = MOST_CLIENTS, clock: Callable[[], float] = time.time) -> None:
        self.most = most
        self.clock = clock
        self.generation = 0
        self.closed = False
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._clients: set[Client] = set()

    def __len__(self) -> int:
        return len(self._clients)

    def announce_batch(self, batch: Batch) -> None:
        """Announce a committed batch; called by the tracker."""
        self.announce(changed_turbines(batch))

    def announce(self, names: Iterable[str]) -> None:
        """Tell all clients that turbines have changed; callable from any thread."""
        with self._lock:
            self.generation += 1
        self._pass_on(frozenset(names))

    def close(self) -> None:
        """End all event streams and accept no new ones; callable from any thread."""
        with self._lock:
            self.closed = True
        self._pass_on(frozenset())

    def join(self) -> Client | None:
        """Add a client in the running loop and return it; None if there are too many or the hub is closed."""
        with self._lock:
            self._loop = asyncio.get_running_loop()
            if self.closed or len(self._clients) >= self.most:
                return None
        client = Client()
        self._clients.add(client)
        return client

    def leave(self, client: Client) -> None:
        """Remove a client."""
        self._clients.discard(client)

    def _pass_on(self, names: frozenset[str]) -> None:
        """Have the event loop of the page add names to what every client has to send; callable from any
        thread.

        Nothing happens while the page has no loop yet, or none any more.
        """
        if self._loop is not None:
            with suppress(RuntimeError):  # the page has stopped
                self._loop.call_soon_threadsafe(self._add_to_clients, names)

    def _add_to_clients(self, names: frozenset[str]) -> None:
        """Add names to those that each client has not received; called in the page's loop."""
        for client in self._clients:
            client.names |= names
            client.wake.set()


def message(kind: str, **content: Json) -> bytes:
    """Encode one server-sent event; heartbeats are events too, because scripts cannot see comments."""
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
        """Yield the events for a client: changes, or heartbeats without changes."""
        yield f"retry: {RETRY_MS}\n\n".encode() + message("alive", now=self.hub.clock())
        while not self.hub.closed:
            with suppress(TimeoutError):
                await asyncio.wait_for(client.wake.wait(), HEARTBEAT_S)
            names = client.take()
            if names:
                named = sorted(names) if len(names) <= MOST_NAMED else None
                yield message("changed", now=self.hub.clock(), turbines=named)
                await asyncio.sleep(0.0 if self.hub.closed else MESSAGE_PAUSE_S)
            elif not self.hub.closed:
                yield message("alive", now=self.hub.clock())


# -- requests, responses and access --------------------------------------------------------------------------
LARGEST_BODY = 4096
"""Largest body of a request [bytes]."""


async def posted_json(request: Request) -> JsonObject:
    """Return the posted JSON object; an empty one if the body is too large or not a JSON object."""
    from starlette.requests import ClientDisconnect

    body = b""
    try:
        async for part in request.stream():
            body += part
            if len(body) > LARGEST_BODY:
                return {}
        content = json.loads(body)
    except (ClientDisconnect, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def reply(
    content: Mapping[str, Any], headers: Mapping[str, str] | None = None, status: int = 200
) -> Response:
    """Return a JSON response."""
    from starlette.responses import Response

    text = json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":"), default=_json_of)
    return Response(text, status, {"Content-Type": "application/json", **(headers or {})})


def _json_of(row: Any) -> JsonObject:
    """Return a row of the store for the page; an alarm also has its sentence in pieces (`pieces_of`)."""
    return {**row.served(), "pieces": pieces_of(row.statements)} if isinstance(row, Alarm) else asdict(row)


def refusal(status: int, message: str, headers: Mapping[str, str] | None = None) -> Response:
    """Return a JSON response that says why a request is refused."""
    return reply({"fault": message}, headers, status)


SESSION_S = 7 * DAY_S
"""[s] for which a browser stays logged in."""
PUBLIC_PATHS = ("/", "/healthz", "/readyz", "/api/login")
"""Paths that need no token, because they reveal nothing about a turbine."""
LOCAL_PATHS = ("/healthz", "/readyz", "/metrics")
"""Paths that monitoring programs may request directly, without the proxy."""
READ_METHODS = ("GET", "HEAD")
"""Methods that change nothing."""
HEADERS = [
    (name.lower().encode(), value.encode())
    for name, value in {
        "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'",
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
    }.items()
]
"""Headers of every response in the form of ASGI."""


class Sessions:
    """Session cookies: an expiry time signed with the token, so that a cookie stays valid after a restart of
    the page."""

    def __init__(self, settings: PageSettings, clock: Callable[[], float] = time.time) -> None:
        self._key = hmac.digest(settings.token.encode(), b"hygrokf page session", hashlib.sha256)
        self._clock = clock
        self._encrypted = settings.behind_proxy
        # browsers share cookies between all ports of a host, so the name contains the port
        self.name = f"{'__Host-' if self._encrypted else ''}hygrokf_{settings.port}"

    def header(self, opens: bool) -> str:
        """Return the Set-Cookie header that opens a session or, if `opens` is false, closes it."""
        content = f"{self._clock() + SESSION_S:.0f}.{secrets.token_hex(8)}"
        value, age_s = (f"{content}.{self._signature(content)}", SESSION_S) if opens else ("", 0.0)
        secure = "; Secure" if self._encrypted else ""
        return f"{self.name}={value}; Max-Age={age_s:.0f}; Path=/; HttpOnly; SameSite=Strict{secure}"

    def valid(self, cookies: str) -> bool:
        """Return whether a request's cookies contain a session that has not expired."""
        try:
            cookie = SimpleCookie(cookies).get(self.name)
        except CookieError:
            return False
        content, _, signature = ("" if cookie is None else cookie.value).rpartition(".")
        if not hmac.compare_digest(signature.encode(), self._signature(content).encode()):
            return False
        return self._clock() < float(content.partition(".")[0])

    def _signature(self, content: str) -> str:
        """Return the signature of a cookie's content."""
        return hmac.new(self._key, content.encode(), hashlib.sha256).hexdigest()


class Access:
    """Decides which requests a page's settings permit."""

    def __init__(self, settings: PageSettings) -> None:
        self.settings = settings
        self.sessions = Sessions(settings)

    def refusal_of(self, scope: Scope) -> Response | None:
        """Return the response that refuses a request; None if the request is permitted."""
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        # a foreign name may resolve to the page's address (DNS rebinding)
        if host_name(headers.get("host", "")) not in self.settings.names:
            message = "the page does not answer to this name; add it to hosts in [page] of the tracker's file"
            return refusal(421, message)
        path = scope["path"]
        if self.settings.behind_proxy and scope["scheme"] != "https" and path not in LOCAL_PATHS:
            return refusal(
                403, "expected X-Forwarded-Proto: https; let the proxy use TLS and set this header"
            )
        if scope["method"] not in READ_METHODS and not is_own_page(headers):
            message = (
                "expected JSON from the page itself, found a request from another site or of another kind"
            )
            return refusal(403, message)
        if not self.settings.token or path in PUBLIC_PATHS or path.startswith("/static/"):
            return None
        if self.sessions.valid(headers.get("cookie", "")):
            return None
        kind, _, token = headers.get("authorization", "").partition(" ")
        message = "log in, or give the token as Authorization: Bearer"
        if kind.lower() == "bearer":
            if self.is_token(token.strip()):
                return None
            message = "wrong token"
        return refusal(401, message, {"WWW-Authenticate": "Bearer"})

    def is_token(self, text: str) -> bool:
        """Return whether a text is the token, by a comparison that takes the same time for every text."""
        # JSON may contain lone surrogates
        return hmac.compare_digest(text.encode(errors="surrogatepass"), self.settings.token.encode())


def guard(app: ASGIApp, access: Access) -> ASGIApp:
    """Wrap an ASGI application: refuse a request, or pass it on; `HEADERS` are added to each response."""

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            raise RuntimeError(f"the page only serves http requests, found {scope['type']}")
        # browsers cache the page's own files, but ask each time whether they have changed
        is_cached = scope["path"] == "/" or scope["path"].startswith("/static/")
        cache = (b"cache-control", b"no-cache" if is_cached else b"no-store")

        async def send_with_headers(message: Message) -> None:
            """Send a part of the response, with the additional headers."""
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", []), *HEADERS, cache]}
            await send(message)

        await (access.refusal_of(scope) or app)(scope, receive, send_with_headers)

    return guarded


def is_own_page(headers: Mapping[str, str]) -> bool:
    """Return whether a POST is JSON and, if the browser states its origin, comes from the page itself."""
    if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        return False
    if headers.get("sec-fetch-site", "same-origin") != "same-origin":
        return False
    origin = headers.get("origin")
    try:
        return origin is None or urlsplit(origin).netloc.lower() == headers.get("host", "").lower()
    except ValueError:  # an invalid URL, such as http://[
        return False


def host_name(host: str) -> str:
    """Return the name in a Host header, in lower case and without the port."""
    if host.startswith("["):
        return host[1:].partition("]")[0].lower()
    return host.partition(":")[0].lower().rstrip(".")
