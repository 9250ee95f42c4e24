"""Access control of the page: host names, token and session, origin of a POST, count of wrong tokens.

`Access` decides; `guard` wraps the whole page, so that every response, including errors, carries the
security headers.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import logging
import secrets
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import urlsplit

from hygrokf.data.timestamps import DAY_S
from hygrokf.live.web.page_settings import PageSettings

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOG = logging.getLogger("hygrokf.page")
SESSION_S = 7 * DAY_S
"""[s] a browser stays logged in."""
GUESSES = 10
GUESSES_S = 300.0
"""Wrong tokens from one address within `GUESSES_S` [s], after which further wrong ones are refused without a
look."""
ADDRESSES = 1000
"""Number of addresses whose wrong tokens are remembered."""
OPEN = ("/", "/healthz", "/readyz", "/api/login")
"""Paths that need no token, because they reveal nothing about a turbine."""
READING = ("GET", "HEAD")
"""Methods that change nothing."""
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}

FIXED = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
"""`HEADERS` as ASGI has them."""


class Attempts:
    """Wrong tokens by address: limited in number and forgotten after `GUESSES_S`."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._wrong: OrderedDict[str, deque[float]] = OrderedDict()

    def wait_s(self, address: str) -> float:
        """[s] an address has to wait before its next attempt."""
        wrong = self._wrong.get(address, deque())
        return max(wrong[0] + GUESSES_S - self._clock(), 0.0) if len(wrong) == GUESSES else 0.0

    def note(self, address: str) -> None:
        """Note a wrong token from an address."""
        wrong = self._wrong.setdefault(address, deque(maxlen=GUESSES))
        wrong.append(self._clock())
        self._wrong.move_to_end(address)
        if len(self._wrong) > ADDRESSES:
            self._wrong.popitem(last=False)


class Sessions:
    """Session cookies: an expiry time signed with the token, so that they stay valid across a restart of the
    page."""

    def __init__(self, settings: PageSettings, clock: Callable[[], float] = time.time) -> None:
        self._key = hmac.digest(settings.token.encode(), b"hygrokf page session", hashlib.sha256)
        self._clock = clock
        self._encrypted = settings.encrypted
        # browsers share cookies between all ports of a host, so the name contains the port
        self.name = f"{'__Host-' if self._encrypted else ''}hygrokf_{settings.port}"

    def opening_header(self) -> str:
        """The Set-Cookie header that opens a session."""
        said = f"{self._clock() + SESSION_S:.0f}.{secrets.token_hex(8)}"
        return self._header(f"{said}.{self._signature(said)}", SESSION_S)

    def closing_header(self) -> str:
        """The Set-Cookie header that closes a session."""
        return self._header("", 0.0)

    def valid(self, cookies: str) -> bool:
        """Whether a request's cookies contain an unexpired session."""
        try:
            found = SimpleCookie(cookies).get(self.name)
        except CookieError:
            return False
        said, _, signature = ("" if found is None else found.value).rpartition(".")
        if not hmac.compare_digest(signature.encode(), self._signature(said).encode()):
            return False
        return self._clock() < float(said.partition(".")[0])

    def _signature(self, said: str) -> str:
        return hmac.new(self._key, said.encode(), hashlib.sha256).hexdigest()

    def _header(self, value: str, age_s: float) -> str:
        secure = "; Secure" if self._encrypted else ""
        return f"{self.name}={value}; Max-Age={age_s:.0f}; Path=/; HttpOnly; SameSite=Strict{secure}"


class Refusal(NamedTuple):
    """A refused request: HTTP status, message and headers of the response."""

    status: int
    words: str
    headers: Mapping[str, str]


class Access:
    """Decides which requests a page's settings permit."""

    def __init__(self, settings: PageSettings) -> None:
        self.settings = settings
        self.sessions = Sessions(settings)
        self.attempts = Attempts()

    def refusal_of(self, scope: Scope) -> Refusal | None:
        """The refusal of a request; None if it is permitted."""
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        if not self._addressed(scope, headers.get("host", "")):
            return Refusal(
                421,
                "the page does not answer to this name; add it to hosts in [page] of the tracker's file",
                {},
            )
        if scope["method"] not in READING and not own_page(headers):
            return Refusal(
                403,
                "expected JSON from the page itself, found a request from another site or of another kind",
                {},
            )
        path = scope["path"]
        if not self.settings.token or path in OPEN or path.startswith("/static/"):
            return None
        if self.sessions.valid(headers.get("cookie", "")):
            return None
        kind, _, given = headers.get("authorization", "").partition(" ")
        if kind.lower() != "bearer":
            words = "log in, or give the token as Authorization: Bearer"
            return Refusal(401, words, {"WWW-Authenticate": "Bearer"})
        return self.check_token(client_of(scope), given.strip())

    def check_token(self, client: str, given: str) -> Refusal | None:
        """None for the right token, else the refusal.

        Wrong tokens are counted by address.  The right token passes whatever came from its address before:
        behind a proxy, somebody else's mistakes must not lock it out, and a token is too long to be guessed.
        """
        # the comparison takes the same time for every input; JSON may contain lone surrogates
        found = given.encode(errors="surrogatepass")
        if self.settings.token and hmac.compare_digest(found, self.settings.token.encode()):
            return None
        wait_s = self.attempts.wait_s(client)
        if wait_s > 0.0:
            words = f"too many wrong tokens; try again in {wait_s / 60.0:.0f} min"
            return Refusal(429, words, {"Retry-After": f"{wait_s:.0f}"})
        self.attempts.note(client)
        if self.attempts.wait_s(client) > 0.0:
            LOG.warning("too many wrong tokens", extra={"address": client})
        return Refusal(401, "wrong token", {"WWW-Authenticate": "Bearer"})

    def _addressed(self, scope: Scope, host: str) -> bool:
        """Whether a request's Host header names the page or the address that the request reached.

        A foreign name that resolves to this address (DNS rebinding) is neither.
        """
        name = host_name(host)
        server = scope.get("server") or ("", 0)
        return name in self.settings.names or (bool(name) and name == server[0])


def guard(app: ASGIApp, access: Access) -> ASGIApp:
    """Wrap an ASGI application: refuse a request, or pass it on and add `HEADERS` to the response."""

    async def guard(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            raise RuntimeError(f"the page speaks http alone, found {scope['type']}")
        refused = access.refusal_of(scope)
        if refused is None:
            await app(scope, receive, headed(send))
        else:
            await answer(headed(send), *refused)

    return guard


def headed(send: Send) -> Send:
    """`send` that adds `HEADERS` to a response."""

    async def headed(message: Message) -> None:
        if message["type"] == "http.response.start":
            given = list(message.get("headers", []))
            kept = any(name.lower() == b"cache-control" for name, _ in given)
            more = [] if kept else [(b"cache-control", b"no-store")]
            message = {**message, "headers": [*given, *FIXED, *more]}
        await send(message)

    return headed


def own_page(headers: Mapping[str, str]) -> bool:
    """Whether a POST is JSON and, as far as the browser states its origin, comes from the page itself."""
    if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        return False
    if headers.get("sec-fetch-site", "same-origin") != "same-origin":
        return False
    origin = headers.get("origin")
    try:
        return origin is None or urlsplit(origin).netloc.lower() == headers.get("host", "").lower()
    except ValueError:  # no URL, such as http://[
        return False


def host_name(host: str) -> str:
    """The name in a Host header, in lower case and without the port."""
    if host.startswith("["):
        return host[1:].partition("]")[0].lower()
    return host.partition(":")[0].lower().rstrip(".")


def client_of(scope: Scope) -> str:
    """The client's address of a request."""
    return (scope.get("client") or ("", 0))[0]


async def answer(send: Send, status: int, words: str, headers: Mapping[str, str]) -> None:
    """Send a refusal with its message as JSON."""
    rows = [(name.lower().encode(), value.encode()) for name, value in headers.items()]
    start = {"type": "http.response.start", "status": status}
    await send({**start, "headers": [(b"content-type", b"application/json"), *rows]})
    await send({"type": "http.response.body", "body": json.dumps({"fault": words}).encode()})
