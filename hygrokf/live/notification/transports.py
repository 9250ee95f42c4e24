"""Transports of notices: mail by SMTP with TLS from the start (`smtps:`) or by STARTTLS (`smtp:`), and
webhooks, a POST of JSON that is signed as Standard Webhooks says.

A message's key is the Message-ID of a mail.  If the connection breaks after the text is sent and before the
server's answer arrives, nobody can tell whether the server has accepted it (RFC 1047): it is sent again with
the same Message-ID, by which mailboxes recognise a repeat.

Of a webhook it is the `webhook-id`, the same at every attempt; `webhook-signature` is `v1,` and the base64 of
HMAC-SHA256 over `webhook-id.webhook-timestamp.body` (https://www.standardwebhooks.com).
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import http.client
import json
import re
import smtplib
import socket
import ssl
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from email.message import EmailMessage
from email.policy import SMTP
from email.utils import formatdate, parseaddr
from pathlib import Path

from hygrokf.live.notification.notices import (
    ChannelFault,
    Message,
    data,
    ended_after,
    subject,
    text,
)
from hygrokf.live.sources.broker import unreachable
from hygrokf.live.sources.endpoint import NO_SECRET, Secret, bracketed, is_loopback, tls_context
from hygrokf.live.sources.stream import SourceFault

PATIENT = 3
"""Attempts in which a temporarily refused address (greylisting) holds up the others."""


@dataclass(frozen=True)
class Mail:
    """A mail server with sender and receivers.

    `tls`: from the start, else STARTTLS unless `unencrypted`; `ca`: trusted CAs, None for those of the
    system; `timeout_s`: limit [s] of one whole exchange.
    """

    host: str
    port: int
    sender: str
    to: tuple[str, ...]
    tls: bool = False
    unencrypted: bool = False
    user: str = ""
    password: Secret = NO_SECRET
    ca: Path | None = None
    timeout_s: float = 60.0

    @property
    def where(self) -> str:
        return f"{bracketed(self.host)}:{self.port}"

    def cautions(self) -> Iterator[str]:
        if self.unencrypted and not is_loopback(self.host):
            yield f"mail goes to {self.where} unencrypted"

    def probe(self) -> str:
        """Connect, encrypt and log in."""
        with self._session() as smtp:
            smtp.noop()
            secured = f"TLS ({smtp.sock.version()})" if isinstance(smtp.sock, ssl.SSLSocket) else ""
        user = f", accepts the user {self.user}" if self.user else ""
        return f"it answers{f' over {secured}' if secured else ', unencrypted'}{user}"

    def send(self, message: Message) -> None:
        """Send a message to all receivers."""
        with self._session() as smtp:
            self._deliver(smtp, message)

    @contextmanager
    def _session(self) -> Iterator[smtplib.SMTP]:
        """A session of at most `timeout_s`, logged in; all that may go wrong in it becomes a ChannelFault."""
        try:
            smtp = self._open()
            with ended_after(self.timeout_s, smtp):
                try:
                    self._log_in(smtp)
                    yield smtp
                finally:
                    with suppress(Exception):  # what the server says to the end changes nothing
                        if smtp.sock is not None:
                            smtp.sock.settimeout(2.0)
                            smtp.quit()
                    smtp.close()
        except ChannelFault:
            raise
        except SourceFault as fault:
            raise ChannelFault(str(fault)) from None
        except smtplib.SMTPAuthenticationError as fault:
            raise ChannelFault(f"{self.where}: user or password is wrong ({fault.smtp_code})") from None
        except smtplib.SMTPResponseException as fault:
            said = _answer(fault.smtp_code, fault.smtp_error)
            raise ChannelFault(f"{self.where}: it refuses: {said}", reached=True) from None
        except smtplib.SMTPServerDisconnected:
            raise ChannelFault(f"{self.where}: it closed the connection, or did not answer in time") from None
        except smtplib.SMTPException as fault:
            raise ChannelFault(f"{self.where}: {fault}") from None
        except (OSError, ValueError) as fault:
            raise ChannelFault(unreachable(fault, self.where)) from None

    def _open(self) -> smtplib.SMTP:
        name = re.sub(r"[^A-Za-z0-9.-]", "", socket.gethostname()) or "hygrokf"
        if self.tls:
            return smtplib.SMTP_SSL(
                self.host, self.port, name, timeout=self.timeout_s, context=tls_context(self.ca)
            )
        return smtplib.SMTP(self.host, self.port, name, timeout=self.timeout_s)

    def _log_in(self, smtp: smtplib.SMTP) -> None:
        smtp.ehlo_or_helo_if_needed()
        if not self.tls and not self.unencrypted:
            if not smtp.has_extn("starttls"):
                raise ChannelFault(
                    f"{self.where}: it offers no STARTTLS: use smtps://, or state unencrypted = true"
                )
            smtp.starttls(context=tls_context(self.ca))
            smtp.ehlo()
        if self.user:
            if not smtp.has_extn("auth"):
                raise ChannelFault(f"{self.where}: it offers no login: check the port, or omit the user")
            smtp.login(self.user, self.password.read() or "")

    def _deliver(self, smtp: smtplib.SMTP, message: Message) -> None:
        code, said = smtp.mail(parseaddr(self.sender)[1])
        if code != 250:
            raise ChannelFault(f"{self.where}: it refuses the sender: {_answer(code, said)}", reached=True)
        refused: dict[str, tuple[int, bytes]] = {}
        for one in self.to:
            code, said = smtp.rcpt(parseaddr(one)[1])
            if code not in (250, 251):
                refused[one] = (code, said)
        temporary = [code for code, _ in refused.values() if code < 500]
        if len(refused) == len(self.to) or (temporary and message.attempts < PATIENT):
            shown = "; ".join(f"{one} ({_answer(*answer)})" for one, answer in refused.items())
            raise ChannelFault(f"{self.where}: it refuses {shown}", reached=True)
        made = EmailMessage(policy=SMTP)
        made["From"] = self.sender
        made["To"] = ", ".join(self.to)
        made["Subject"] = subject(message)
        made["Date"] = formatdate()
        made["Message-ID"] = f"<{message.key}@{parseaddr(self.sender)[1].rpartition('@')[2]}>"
        made["Auto-Submitted"] = "auto-generated"
        made.set_content(text(message), cte="base64")
        code, said = smtp.data(made.as_bytes())
        if code != 250:
            raise ChannelFault(f"{self.where}: it refuses the message: {_answer(code, said)}", reached=True)


def _answer(code: int, said: bytes | str) -> str:
    words = said.decode("utf-8", "replace") if isinstance(said, bytes) else said
    return f"{code} {words}"


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
    secret: Secret = NO_SECRET
    ca: Path | None = None
    timeout_s: float = 10.0

    @property
    def where(self) -> str:
        return f"{bracketed(self.host)}:{self.port}"

    def cautions(self) -> Iterator[str]:
        if not self.tls and not is_loopback(self.host):
            yield f"notices go to {self.where} unencrypted: use https://"
        if not self.secret.is_stated:
            yield f"notices to {self.where} are not signed: name a secret_file"

    def signing_key(self) -> bytes | None:
        """The present secret, None for none.  Raises ChannelFault."""
        try:
            found = self.secret.read()
        except SourceFault as fault:
            raise ChannelFault(str(fault)) from None
        return None if found is None else secret_bytes(found, self.secret.variable or str(self.secret.file))

    def probe(self) -> str:
        """Connect and encrypt; nothing is posted."""
        secret = self.signing_key()
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
        headers |= signature(message.key, body, time.time(), self.signing_key())
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
        try:
            context = tls_context(self.ca)
        except SourceFault as fault:
            raise ChannelFault(str(fault)) from None
        return http.client.HTTPSConnection(self.host, self.port, timeout=self.timeout_s, context=context)


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
