"""Who may ask the page for what: names of the host, token and session, where a POST comes from, how often one may guess.

`Access` decides; `guarded` stands before the whole page, so that every answer, a fault's too, carries the headers that
bind the browser.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import secrets
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from http.cookies import CookieError, SimpleCookie
from urllib.parse import urlsplit

from hygrokf.live.web.page_settings import PageSettings

SESSION_S = 7 * 86400.0
"""[s] for which a browser stays logged in."""
GUESSES = 10
GUESSES_S = 300.0
"""Wrong tokens of one address within so many seconds, after which it has to wait."""
ADDRESSES = 1000
"""Addresses whose guesses are remembered."""
OPEN = ("/", "/healthz", "/api/login")
"""What is answered without a token: it says nothing of any turbine."""
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class Attempts:
    """Wrong tokens by address; bounded, and forgotten after `GUESSES_S`."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._wrong: OrderedDict[str, deque[float]] = OrderedDict()

    def wait_s(self, address: str) -> float:
        """[s] for which an address has to wait before its next attempt."""
        wrong = self._wrong.get(address, deque())
        return max(wrong[0] + GUESSES_S - self._clock(), 0.0) if len(wrong) == GUESSES else 0.0

    def note(self, address: str) -> None:
        """A wrong token came from an address."""
        wrong = self._wrong.setdefault(address, deque(maxlen=GUESSES))
        wrong.append(self._clock())
        self._wrong.move_to_end(address)
        if len(self._wrong) > ADDRESSES:
            self._wrong.popitem(last=False)


class Sessions:
    """Cookies that say until when a browser may come in, signed with the token: a restart of the page keeps them valid."""

    def __init__(self, settings: PageSettings, clock: Callable[[], float] = time.time) -> None:
        self._key = hmac.digest(settings.token.encode(), b"hygrokf page session", hashlib.sha256)
        self._clock = clock
        self._encrypted = settings.encrypted
        # pages of one machine share their cookies, whatever the port
        self.name = f"{'__Host-' if self._encrypted else ''}hygrokf_{settings.port}"

    def begun(self) -> str:
        """The header that opens a session."""
        said = f"{self._clock() + SESSION_S:.0f}.{secrets.token_hex(8)}"
        return self._header(f"{said}.{self._signature(said)}", SESSION_S)

    def ended(self) -> str:
        """The header that closes it."""
        return self._header("", 0.0)

    def valid(self, cookies: str) -> bool:
        """Whether a request's cookies hold a session that is still open."""
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


class Access:
    """What a page's settings let pass."""

    def __init__(self, settings: PageSettings) -> None:
        self.settings = settings
        self.sessions = Sessions(settings)
        self.attempts = Attempts()

    def refused(self, scope: Mapping) -> tuple[int, str, dict] | None:
        """Status, words and headers of a refusal; None for what may pass."""
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        if not self._addressed(scope, headers.get("host", "")):
            return (
                421,
                "the page does not go by this name; name it under hosts in [page] of the tracker's file",
                {},
            )
        if scope["method"] == "POST" and not own_page(headers):
            return (
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
            return 401, "log in, or give the token as Authorization: Bearer", {"WWW-Authenticate": "Bearer"}
        return self.judged(client_of(scope), given.strip())

    def judged(self, client: str, given: str) -> tuple[int, str, dict] | None:
        """None for the right token, else the refusal; wrong ones are counted."""
        wait_s = self.attempts.wait_s(client)
        if wait_s > 0.0:
            words = f"too many wrong tokens; try again in {wait_s / 60.0:.0f} min"
            return 429, words, {"Retry-After": f"{wait_s:.0f}"}
        # whatever was given is compared, in a time that does not depend on it
        if self.settings.token and hmac.compare_digest(given.encode(), self.settings.token.encode()):
            return None
        self.attempts.note(client)
        return 401, "this is not the token", {"WWW-Authenticate": "Bearer"}

    def _addressed(self, scope: Mapping, host: str) -> bool:
        """Whether a request was made to a name of the page, or to the very address that it reached.

        A name that was bent to this address (DNS rebinding) is neither.
        """
        name = host_name(host)
        server = scope.get("server") or ("", 0)
        return name in self.settings.names or (bool(name) and name == server[0])


def guarded(app: Callable, access: Access) -> Callable:
    """An ASGI application before another: it refuses, or hands on and adds `HEADERS`."""
    fixed = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]

    async def guard(scope: Mapping, receive: Callable, send: Callable) -> None:
        async def headed(message: dict) -> None:
            if message["type"] == "http.response.start":
                given = list(message.get("headers", []))
                kept = any(name.lower() == b"cache-control" for name, _ in given)
                message = {
                    **message,
                    "headers": given + fixed + ([] if kept else [(b"cache-control", b"no-store")]),
                }
            await send(message)

        if scope["type"] != "http":
            raise RuntimeError(f"the page speaks http alone, found {scope['type']}")
        refused = access.refused(scope)
        if refused is None:
            await app(scope, receive, headed)
        else:
            await answer(headed, *refused)

    return guard


def own_page(headers: Mapping[str, str]) -> bool:
    """Whether a POST is JSON and, where a browser says so, from the page itself."""
    if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        return False
    if headers.get("sec-fetch-site", "same-origin") != "same-origin":
        return False
    origin = headers.get("origin")
    return origin is None or urlsplit(origin).netloc.lower() == headers.get("host", "").lower()


def host_name(host: str) -> str:
    """The name of a Host header, in lower case and without its port."""
    if host.startswith("["):
        return host[1:].partition("]")[0].lower()
    return host.partition(":")[0].lower().rstrip(".")


def client_of(scope: Mapping) -> str:
    """The address from which a request came."""
    return (scope.get("client") or ("", 0))[0]


async def answer(send: Callable, status: int, words: str, headers: Mapping[str, str]) -> None:
    """Send a refusal in words, as JSON."""
    rows = [(name.lower().encode(), value.encode()) for name, value in headers.items()]
    start = {"type": "http.response.start", "status": status}
    await send({**start, "headers": [(b"content-type", b"application/json"), *rows]})
    await send({"type": "http.response.body", "body": json.dumps({"fault": words}).encode()})
