"""Receivers of notices on the loopback that fail on request: a mail server (aiosmtpd) and a webhook."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import socket
import ssl
import threading
import time
from collections import Counter
from email import message_from_bytes
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Self

from aiosmtpd.controller import Controller
from aiosmtpd.smtp import SMTP, AuthResult, LoginPassword

from builders.ports import free_port

FAILURES = ("refuse", "hang", "error", "close", "lost answer")
"""Ways to fail: no listener, no answer, a refusal, a connection that breaks in the middle, and a message that
is accepted although its sender never hears of it."""
HUNG_S = 30.0
USER, PASSWORD = "tracker", "geheim 1"


class Accepted:
    """Messages that a receiver has accepted, by key, and those of them whose answer it lost."""

    def __init__(self) -> None:
        self.keys: Counter[str] = Counter()
        self.lost_answers: Counter[str] = Counter()
        self.messages: list[Any] = []
        self.lock = threading.Lock()

    def add(self, key: str, message: object, answered: bool) -> None:
        with self.lock:
            self.keys[key] += 1
            self.lost_answers[key] += not answered
            self.messages.append(message)

    @property
    def doubled(self) -> list[str]:
        """Keys that were accepted again after the receiver had answered."""
        return [key for key, n in self.keys.items() if n - self.lost_answers[key] > 1]

    @property
    def repeated(self) -> int:
        """Messages that came again because their answer was lost; a receiver drops them by their key."""
        return sum(n - 1 for n in self.keys.values())


class Receiver:
    """A receiver on a free port; `failure` is one of `FAILURES` or empty, and `noticed` counts what it hit.

    `_server` is what listens, None while nothing does.
    """

    def __init__(self) -> None:
        self.accepted = Accepted()
        self.failure = ""
        self.noticed: Counter[str] = Counter()
        self.port = free_port()
        self._server: Any = None

    def start(self) -> None:
        raise NotImplementedError

    def stop(self) -> None:
        raise NotImplementedError

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *fault: object) -> None:
        self.stop()

    def fail(self, failure: str) -> None:
        """Fail in one way from now on; empty: work."""
        if failure == "refuse":
            self.noticed["refuse"] += 1
            self.stop()
        elif self._server is None:
            self.start()
        self.failure = failure


class MailServer(Receiver):
    """A mail server."""

    def __init__(
        self, certificate: Path | None = None, key: Path | None = None, tls: bool = False, login: bool = False
    ) -> None:
        super().__init__()
        self.refuses: dict[str, str] = {}
        self._context = None
        if certificate is not None:
            self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            self._context.load_cert_chain(certificate, key)
        self._tls, self._login = tls, login

    def start(self) -> None:
        more: dict[str, Any] = {}
        if self._context is not None and not self._tls:
            more = {"tls_context": self._context, "require_starttls": True}
        if self._login:
            more |= {"authenticator": self._authenticate, "auth_required": not self._tls}
            more |= {"auth_require_tls": not self._tls}
        self._server = _Controller(
            self, hostname="127.0.0.1", port=self.port, ready_timeout=10.0,
            ssl_context=self._context if self._tls else None, **more,
        )  # fmt: skip
        self._server.start()

    def stop(self) -> None:
        if self._server is not None:
            self._server.stop()
            self._server = None

    def _authenticate(
        self, server: SMTP, session: object, envelope: object, kind: str, data: Any
    ) -> AuthResult:
        right = isinstance(data, LoginPassword) and (
            (data.login, data.password) == (USER.encode(), PASSWORD.encode())
        )
        return AuthResult(success=right, handled=False)

    # -- hooks of aiosmtpd -------------------------------------------------------------------------------
    async def handle_RCPT(
        self, server: SMTP, session: object, envelope: Any, address: str, options: object
    ) -> str:
        if address in self.refuses:
            return self.refuses[address]
        envelope.rcpt_tos.append(address)
        return "250 OK"

    async def handle_DATA(self, server: SMTP, session: Any, envelope: Any) -> str:
        import asyncio

        failure = self.failure
        self.noticed[failure] += 1
        mail = message_from_bytes(envelope.content)
        if failure == "hang":
            await asyncio.sleep(HUNG_S)
            return "451 hung"
        if failure == "error":
            return "451 try again later"
        if failure == "close":
            server.transport.abort()
            return "451 closed"
        session.key = mail["Message-ID"]
        self.accepted.add(session.key, (mail, tuple(envelope.rcpt_tos)), answered=False)
        if failure == "lost answer":
            server.transport.abort()
        return "250 accepted"

    async def handle_QUIT(self, server: SMTP, session: Any, envelope: object) -> str:
        # only now it is known that the answer before has arrived
        key = getattr(session, "key", None)
        if key is not None:
            self.accepted.lost_answers[key] -= 1
        return "221 bye"


class _Controller(Controller):
    def factory(self) -> SMTP:
        return SMTP(self.handler, hostname="localhost", **self.SMTP_kwargs)


class WebhookServer(Receiver):
    """A webhook that verifies signatures."""

    def __init__(
        self, secret: bytes | None = None, certificate: Path | None = None, key: Path | None = None
    ) -> None:
        super().__init__()
        self.status = 204
        self.slow_s = 0.0
        self.wrong: list[str] = []
        self.secret = secret
        self._pair = (certificate, key)
        self._ending = threading.Event()

    def start(self) -> None:
        class Handler(BaseHTTPRequestHandler):
            def do_POST(handler) -> None:
                self._answer(handler)

            def log_message(handler, *said: object) -> None:
                pass

        self._ending.clear()
        self._server = _HttpServer(("127.0.0.1", self.port), Handler)
        if self._pair[0] is not None:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(*self._pair)
            self._server.socket = context.wrap_socket(self._server.socket, server_side=True)
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    def stop(self) -> None:
        self._ending.set()
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None

    def _answer(self, handler: BaseHTTPRequestHandler) -> None:
        failure = self.failure
        self.noticed[failure] += 1
        body = handler.rfile.read(int(handler.headers["Content-Length"]))
        if failure == "hang":
            self._ending.wait(HUNG_S)
            return
        if failure == "error":
            handler.send_error(500)
            return
        if failure == "close":
            handler.wfile.write(b"HTTP/1.0 2")
            handler.wfile.flush()
            handler.connection.shutdown(socket.SHUT_RDWR)
            return
        time.sleep(self.slow_s)
        self._verify(handler, body)
        self.accepted.add(handler.headers["webhook-id"], json.loads(body), failure != "lost answer")
        if failure == "lost answer":
            handler.connection.shutdown(socket.SHUT_RDWR)
            return
        handler.send_response(self.status)
        if 300 <= self.status < 400:
            handler.send_header("Location", "/elsewhere")
        handler.end_headers()

    def _verify(self, handler: BaseHTTPRequestHandler, body: bytes) -> None:
        """As a receiver of Standard Webhooks does."""
        if self.secret is None:
            return
        key, stamp = handler.headers["webhook-id"], handler.headers["webhook-timestamp"]
        made = hmac.new(self.secret, b".".join((key.encode(), stamp.encode(), body)), hashlib.sha256).digest()
        given = handler.headers["webhook-signature"].split(" ")
        if f"v1,{base64.b64encode(made).decode()}" not in given or abs(time.time() - int(stamp)) > 5.0:
            self.wrong.append(key)


class _HttpServer(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request: object, address: object) -> None:
        pass
