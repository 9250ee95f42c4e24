"""A webhook as a channel: a POST of JSON, signed as Standard Webhooks says.

`webhook-id` is the message's key, the same at every attempt; `webhook-signature` is `v1,` and the base64 of
HMAC-SHA256 over `webhook-id.webhook-timestamp.body` (https://www.standardwebhooks.com).
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import http.client
import json
import ssl
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from hygrokf.live.notification.channel import ChannelFault, Message, data, ended_after, tls_context
from hygrokf.live.sources.broker import unreachable
from hygrokf.live.sources.endpoint import bracketed, is_loopback, password_of
from hygrokf.live.sources.stream import SourceFault

MARK = "whsec_"
LEAST_BYTES = 24
"""Shortest secret [bytes]."""
READ = 2000
"""[bytes] of an answer that are read."""
MAKE_ONE = (
    "make one with: python -c 'import base64, secrets; "
    'print("whsec_" + base64.b64encode(secrets.token_bytes(32)).decode())\''
)


@dataclass(frozen=True)
class Webhook:
    """A receiver of messages.

    `path` may itself be a secret and appears in no message; `timeout_s`: limit [s] of one whole exchange.
    """

    host: str
    port: int
    path: str = field(default="/", repr=False)
    tls: bool = True
    secret_file: Path | None = None
    secret_env: str = ""
    ca: Path | None = None
    timeout_s: float = 10.0

    @property
    def where(self) -> str:
        return f"{bracketed(self.host)}:{self.port}"

    def cautions(self) -> Iterator[str]:
        if not self.tls and not is_loopback(self.host):
            yield f"notices go to {self.where} unencrypted: use https://"
        if self.secret_file is None and not self.secret_env:
            yield f"notices to {self.where} are not signed: name a secret_file"

    def secret(self) -> bytes | None:
        """The present secret, None for none.  Raises ChannelFault."""
        try:
            found = password_of(self.secret_file, self.secret_env, "secret")
        except SourceFault as fault:
            raise ChannelFault(str(fault)) from None
        return None if found is None else secret_bytes(found, self.secret_env or str(self.secret_file))

    def probe(self) -> str:
        """Connect and encrypt; nothing is posted."""
        secret = self.secret()
        connection = self._connection()
        try:
            connection.connect()
            secured = connection.sock.version() if isinstance(connection.sock, ssl.SSLSocket) else None
        except (OSError, ValueError) as fault:
            raise ChannelFault(unreachable(fault, self.where)) from None
        finally:
            connection.close()
        signed = "signed" if secret else "not signed"
        return f"it answers{f' over TLS ({secured})' if secured else ', unencrypted'}; notices are {signed}"

    def send(self, message: Message) -> None:
        """Post a message; only an answer of 200 to 299 accepts it."""
        body = json.dumps(data(message), ensure_ascii=False, allow_nan=False).encode()
        headers = {"Content-Type": "application/json", "User-Agent": "hygrokf"}
        headers |= signature(message.key, body, time.time(), self.secret())
        connection = self._connection()
        try:
            with ended_after(self.timeout_s, connection):
                connection.request("POST", self.path, body, headers)
                answer = connection.getresponse()
                answer.read(READ)
        except (OSError, ValueError, http.client.HTTPException) as fault:
            raise ChannelFault(self._words(fault)) from None
        finally:
            connection.close()
        if 300 <= answer.status < 400:
            said = f"{self.where}: it redirects ({answer.status}): state the final url"
            raise ChannelFault(said, reached=True)
        if not 200 <= answer.status < 300:
            raise ChannelFault(f"{self.where}: it answers {answer.status} {answer.reason}", reached=True)

    def _words(self, fault: Exception) -> str:
        if isinstance(fault, http.client.IncompleteRead | ConnectionResetError):
            return f"{self.where}: it closed the connection before its answer was complete"
        if isinstance(fault, http.client.HTTPException):
            return f"{self.where}: its answer is no HTTP ({type(fault).__name__})"
        return unreachable(fault, self.where)

    def _connection(self) -> http.client.HTTPConnection:
        if not self.tls:
            return http.client.HTTPConnection(self.host, self.port, timeout=self.timeout_s)
        return http.client.HTTPSConnection(
            self.host, self.port, timeout=self.timeout_s, context=tls_context(self.ca)
        )


def signature(key: str, body: bytes, now: float, secret: bytes | None) -> dict[str, str]:
    """The headers that identify and sign a body at a time [s]; without a secret they only identify it."""
    stamp = f"{now:.0f}"
    headers = {"webhook-id": key, "webhook-timestamp": stamp}
    if secret is not None:
        made = hmac.digest(secret, f"{key}.{stamp}.".encode() + body, hashlib.sha256)
        headers["webhook-signature"] = f"v1,{base64.b64encode(made).decode()}"
    return headers


def secret_bytes(text: str, place: str) -> bytes:
    """The bytes of a secret such as `whsec_…`; `place` names where it stands.  Raises ChannelFault."""
    with suppress(binascii.Error, ValueError):
        found = base64.b64decode(text.removeprefix(MARK), validate=True)
        if text.startswith(MARK) and len(found) >= LEAST_BYTES:
            return found
    raise ChannelFault(f"expected {MARK} and at least {LEAST_BYTES} bytes in base64 in {place}; {MAKE_ONE}")
