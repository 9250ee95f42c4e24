"""Requests and responses of the page's JSON, and access control: host names, token and session, origin of a
POST.

`Access` decides; `guard` wraps the whole page, so that every response, including errors, carries the
security headers.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from hygrokf.data.structured import JsonObject
from hygrokf.data.timestamps import DAY_S
from hygrokf.live.web.page_settings import PageSettings

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

LARGEST = 4096
"""Largest body of a request [bytes]."""


async def posted_json(request: Request) -> JsonObject:
    """The posted JSON object; empty if the body is no object or too large."""
    from starlette.requests import ClientDisconnect

    body = b""
    try:
        async for part in request.stream():
            body += part
            if len(body) > LARGEST:
                return {}
        found = json.loads(body)
    except (ClientDisconnect, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def reply(
    content: Mapping[str, Any], headers: Mapping[str, str] | None = None, status: int = 200
) -> Response:
    """A JSON response."""
    from starlette.responses import Response

    text = json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":"), default=asdict)
    return Response(text, status, {"Content-Type": "application/json", **(headers or {})})


def refusal(status: int, words: str, headers: Mapping[str, str] | None = None) -> Response:
    """A JSON response that says why a request is refused."""
    return reply({"fault": words}, headers, status)


SESSION_S = 7 * DAY_S
"""[s] a browser stays logged in."""
OPEN = ("/", "/healthz", "/readyz", "/api/login")
"""Paths that need no token, because they reveal nothing about a turbine."""
MACHINES = ("/healthz", "/readyz", "/metrics")
"""Paths that machines beside the page ask, past its proxy."""
READING = ("GET", "HEAD")
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
"""Headers of every response, as ASGI has them."""


class Sessions:
    """Session cookies: an expiry time signed with the token, so that they stay valid across a restart of the
    page."""

    def __init__(self, settings: PageSettings, clock: Callable[[], float] = time.time) -> None:
        self._key = hmac.digest(settings.token.encode(), b"hygrokf page session", hashlib.sha256)
        self._clock = clock
        self._encrypted = settings.behind_proxy
        # browsers share cookies between all ports of a host, so the name contains the port
        self.name = f"{'__Host-' if self._encrypted else ''}hygrokf_{settings.port}"

    def header(self, opens: bool) -> str:
        """The Set-Cookie header that opens a session, or closes it."""
        said = f"{self._clock() + SESSION_S:.0f}.{secrets.token_hex(8)}"
        value, age_s = (f"{said}.{self._signature(said)}", SESSION_S) if opens else ("", 0.0)
        secure = "; Secure" if self._encrypted else ""
        return f"{self.name}={value}; Max-Age={age_s:.0f}; Path=/; HttpOnly; SameSite=Strict{secure}"

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


class Access:
    """Decides which requests a page's settings permit."""

    def __init__(self, settings: PageSettings) -> None:
        self.settings = settings
        self.sessions = Sessions(settings)

    def refusal_of(self, scope: Scope) -> Response | None:
        """The refusal of a request; None if it is permitted."""
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        # a foreign name may resolve to the page's address (DNS rebinding)
        if host_name(headers.get("host", "")) not in self.settings.names:
            words = "the page does not answer to this name; add it to hosts in [page] of the tracker's file"
            return refusal(421, words)
        path = scope["path"]
        if self.settings.behind_proxy and scope["scheme"] != "https" and path not in MACHINES:
            return refusal(403, "expected X-Forwarded-Proto: https; have the proxy set it, and do TLS")
        if scope["method"] not in READING and not own_page(headers):
            words = "expected JSON from the page itself, found a request from another site or of another kind"
            return refusal(403, words)
        if not self.settings.token or path in OPEN or path.startswith("/static/"):
            return None
        if self.sessions.valid(headers.get("cookie", "")):
            return None
        kind, _, given = headers.get("authorization", "").partition(" ")
        words = "log in, or give the token as Authorization: Bearer"
        if kind.lower() == "bearer":
            if self.is_token(given.strip()):
                return None
            words = "wrong token"
        return refusal(401, words, {"WWW-Authenticate": "Bearer"})

    def is_token(self, given: str) -> bool:
        """Whether a text is the token, compared in the same time whatever the text."""
        # JSON may contain lone surrogates
        return hmac.compare_digest(given.encode(errors="surrogatepass"), self.settings.token.encode())


def guard(app: ASGIApp, access: Access) -> ASGIApp:
    """Wrap an ASGI application: refuse a request, or pass it on and add `HEADERS` to the response."""

    async def guard(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            raise RuntimeError(f"the page speaks http alone, found {scope['type']}")
        # browsers keep the page's own files, and ask whether they changed
        kept = scope["path"] == "/" or scope["path"].startswith("/static/")
        cache = (b"cache-control", b"no-cache" if kept else b"no-store")

        async def headed(message: Message) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", []), *HEADERS, cache]}
            await send(message)

        await (access.refusal_of(scope) or app)(scope, receive, headed)

    return guard


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
