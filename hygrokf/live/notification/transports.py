"""The kinds of channels, each a [[notify]] of the tracker's file: mail by SMTP with TLS from the start
(`smtps:`) or by STARTTLS (`smtp:`), and webhooks, a POST of JSON that is signed by Standard Webhooks.

A message's key is the Message-ID of a mail.  If the connection breaks after the text is sent and before the
server's answer arrives, the client cannot know whether the server has accepted the mail (RFC 1047).  The
mail is sent again with the same Message-ID, by which mailboxes recognise a repeat.

In a webhook the message's key is the `webhook-id`, the same at every attempt; `webhook-signature` is `v1,`
and the base64 of HMAC-SHA256 over `webhook-id.webhook-timestamp.body` (https://www.standardwebhooks.com).
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
import threading
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from email.message import EmailMessage
from email.policy import SMTP
from email.utils import formatdate, parseaddr
from pathlib import Path
from typing import ClassVar

from hygrokf.data.timestamps import duration
from hygrokf.data.toml_form import Place, across, read_form, setting
from hygrokf.errors import suggestion
from hygrokf.live.notification.channel import Channel, ChannelFault, NoticeMessage, data, subject, text
from hygrokf.live.sources.broker import unreachable_text
from hygrokf.live.sources.endpoint import PasswordKeys, Secret, tls_context
from hygrokf.live.sources.stream import SourceFault
from hygrokf.texts.doctor_codes import Check, CheckCode

_ADDRESS = 'an address such as "ops@farm.example"'
GREYLISTING_ATTEMPTS = 3
"""Attempts during which a temporarily refused address (greylisting) delays the mail to the other
addresses."""


@contextmanager
def _faults_of(where: str) -> Iterator[None]:
    """Turn exceptions of an exchange with the server `where` into ChannelFault within this context."""
    try:
        yield
    except ChannelFault:
        raise
    except SourceFault as fault:
        raise ChannelFault(str(fault)) from None
    except smtplib.SMTPAuthenticationError as fault:
        raise ChannelFault(f"{where}: user or password is wrong ({fault.smtp_code})") from None
    except smtplib.SMTPResponseException as fault:
        refusal = f"{where}: it refuses: {_answer_text(fault.smtp_code, fault.smtp_error)}"
        raise ChannelFault(refusal, reached=True) from None
    except (smtplib.SMTPServerDisconnected, http.client.IncompleteRead, ConnectionResetError):
        raise ChannelFault(f"{where}: it closed the connection, or did not answer in time") from None
    except http.client.HTTPException as fault:
        raise ChannelFault(f"{where}: its answer is not HTTP ({type(fault).__name__})") from None
    except smtplib.SMTPException as fault:
        raise ChannelFault(f"{where}: {fault}") from None
    except (OSError, ValueError) as fault:
        raise ChannelFault(unreachable_text(fault, where)) from None


@contextmanager
def _time_limit(seconds: float, connection: smtplib.SMTP | http.client.HTTPConnection) -> Iterator[None]:
    """Break a connection after a time [s] within this context, because single steps of an exchange may each
    stay within their timeout."""

    def shut_down() -> None:
        """Break the connection."""
        with suppress(OSError, AttributeError):
            if connection.sock is not None:
                connection.sock.shutdown(socket.SHUT_RDWR)

    timer = threading.Timer(seconds, shut_down)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _security_text(connection: smtplib.SMTP | http.client.HTTPConnection) -> str:
    """Return whether a connection is encrypted, for the description of a server."""
    sock = connection.sock
    return f" over TLS ({sock.version()})" if isinstance(sock, ssl.SSLSocket) else ", unencrypted"


def _is_address(text: str) -> bool:
    """Return whether a text is a mail address in ASCII, with or without a name."""
    address = parseaddr(text)[1]
    user, at, host = address.rpartition("@")
    return bool(user and at and host) and text.isprintable() and text.isascii() and " " not in address


@dataclass(frozen=True, kw_only=True)
class Mail(PasswordKeys, Channel):
    """A [[notify]] by mail; `timeout_s`: time limit of a complete exchange [s]."""

    url: str = setting(help="smtp://[USER@]HOST[:PORT] for STARTTLS, or smtps:// for TLS from the start")
    sender: str = setting(help="the sender's address", fits=_is_address, expected=_ADDRESS)
    to: tuple[str, ...] = setting(
        help="addresses of the receivers", expected='a list of addresses such as ["ops@farm.example"]',
        fits=lambda to: bool(to) and all(map(_is_address, to)),
    )  # fmt: skip
    unencrypted: bool = setting(False, "whether mail may be sent without TLS")
    timeout_s: float = setting(60.0, "time limit of one message", read=duration, least=1.0, most=600.0,
                               expected="1 s to 10 min")  # fmt: skip

    @across("password_file", "password_env", "url")
    def login(self) -> str | None:
        if self.password.is_stated != bool(self.address.user):
            return "user and password belong together: smtp://USER@HOST and password_file or password_env"
        try:
            if f"{self.address.user}{self.password.read() or ''}".isascii():
                return None
        except SourceFault as fault:
            return str(fault)
        return "user and password must be ASCII: Python's SMTP client sends nothing else"

    @across("unencrypted", "url", "password_file", "password_env")
    def secured(self) -> Iterator[str]:
        if self.unencrypted and self.tls:
            yield "unencrypted contradicts smtps://: keep one"
        if self.unencrypted and self.password.is_stated:
            yield "unencrypted: a password is only sent over TLS"

    def cautions(self) -> Iterator[Check]:
        """Yield a check if mail leaves this machine unencrypted."""
        if self.unencrypted and self.leaves_machine:
            yield CheckCode.MAIL_UNENCRYPTED(where=self.where)

    def probe(self) -> str:
        """Connect, encrypt and log in."""
        with self._session() as smtp:
            smtp.noop()
            user = f", accepts the user {self.address.user}" if self.address.user else ""
            return f"it answers{_security_text(smtp)}{user}"

    def send(self, message: NoticeMessage) -> None:
        """Send a message to all receivers."""
        with self._session() as smtp:
            self._deliver(smtp, message)

    @contextmanager
    def _session(self) -> Iterator[smtplib.SMTP]:
        """A session of at most `timeout_s`, logged in.  Raises ChannelFault."""
        with _faults_of(self.where):
            smtp = self._open()
            with _time_limit(self.timeout_s, smtp):
                try:
                    self._log_in(smtp)
                    yield smtp
                finally:
                    with suppress(Exception):  # the answer to QUIT does not matter
                        if smtp.sock is not None:
                            smtp.sock.settimeout(2.0)
                            smtp.quit()
                    smtp.close()

    def _open(self) -> smtplib.SMTP:
        """Connect to the server."""
        name = re.sub(r"[^A-Za-z0-9.-]", "", socket.gethostname()) or "hygrokf"
        host, port = self.address.host, self.address.port
        if not self.tls:
            return smtplib.SMTP(host, port, name, timeout=self.timeout_s)
        return smtplib.SMTP_SSL(
            host, port, name, timeout=self.timeout_s, context=tls_context(self.path("ca"))
        )

    def _log_in(self, smtp: smtplib.SMTP) -> None:
        """Encrypt by STARTTLS, if needed, and log in.  Raises ChannelFault."""
        smtp.ehlo_or_helo_if_needed()
        if not self.tls and not self.unencrypted:
            if not smtp.has_extn("starttls"):
                raise ChannelFault(
                    f"{self.where}: it offers no STARTTLS: use smtps://, or state unencrypted = true"
                )
            smtp.starttls(context=tls_context(self.path("ca")))
            smtp.ehlo()
        if self.address.user:
            if not smtp.has_extn("auth"):
                raise ChannelFault(f"{self.where}: it offers no login: check the port, or omit the user")
            smtp.login(self.address.user, self.password.read() or "")

    def _deliver(self, smtp: smtplib.SMTP, message: NoticeMessage) -> None:
        """Send a message to all receivers.  Raises ChannelFault if the server refuses it."""
        code, answer = smtp.mail(parseaddr(self.sender)[1])
        if code != 250:
            raise ChannelFault(
                f"{self.where}: it refuses the sender: {_answer_text(code, answer)}", reached=True
            )
        refused: dict[str, tuple[int, bytes]] = {}
        for receiver in self.to:
            code, answer = smtp.rcpt(parseaddr(receiver)[1])
            if code not in (250, 251):
                refused[receiver] = (code, answer)
        temporary = [code for code, _ in refused.values() if code < 500]
        if len(refused) == len(self.to) or (temporary and message.attempts < GREYLISTING_ATTEMPTS):
            reasons = "; ".join(f"{receiver} ({_answer_text(*why)})" for receiver, why in refused.items())
            raise ChannelFault(f"{self.where}: it refuses {reasons}", reached=True)
        mail = EmailMessage(policy=SMTP)
        mail["From"] = self.sender
        mail["To"] = ", ".join(self.to)
        mail["Subject"] = subject(message)
        mail["Date"] = formatdate()
        mail["Message-ID"] = f"<{message.key}@{parseaddr(self.sender)[1].rpartition('@')[2]}>"
        mail["Auto-Submitted"] = "auto-generated"
        mail.set_content(text(message), cte="base64")
        code, answer = smtp.data(mail.as_bytes())
        if code != 250:
            raise ChannelFault(
                f"{self.where}: it refuses the message: {_answer_text(code, answer)}", reached=True
            )


def _answer_text(code: int, answer: bytes | str) -> str:
    """Return code and text of a server's answer."""
    text = answer.decode("utf-8", "replace") if isinstance(answer, bytes) else answer
    return f"{code} {text}"


SECRET_PREFIX = "whsec_"
SHORTEST_SECRET = 24
"""Shortest secret [bytes]."""
LONGEST_ANSWER = 2000
"""Longest part of an answer that is read [bytes]."""
HOW_TO_MAKE = (
    "make one with: python -c 'import base64, secrets; "
    'print("whsec_" + base64.b64encode(secrets.token_bytes(32)).decode())\''
)


@dataclass(frozen=True, kw_only=True, repr=False)
class Webhook(Channel):
    """A [[notify]] by a webhook; `timeout_s`: time limit of a complete exchange [s].

    The path of the URL may itself be a secret, so that no message shows it.
    """

    REFUSED: ClassVar = {
        "secret": "a secret must not be in this file: name a file as secret_file, or an environment "
        "variable as secret_env"
    }
    url: str = setting(help="https://HOST[:PORT]/PATH")
    secret_file: str = setting("", "file with the signing secret as its only line")
    secret_env: str = setting("", "environment variable with the signing secret")
    timeout_s: float = setting(10.0, "time limit of one message", read=duration, least=1.0, most=120.0,
                               expected="1 s to 2 min")  # fmt: skip

    @across("url")
    def no_user(self) -> str | None:
        fault = "url: user and password do not belong here; sign by secret_file"
        return fault if self.address.user else None

    @across("secret_file", "secret_env")
    def one_secret(self) -> str | None:
        if self.secret_file and self.secret_env:
            return "secret_file and secret_env: keep one"
        try:
            self.signing_key()
        except (SourceFault, ChannelFault) as fault:
            return str(fault)
        return None

    def cautions(self) -> Iterator[Check]:
        """Yield a check if notices are unencrypted, and if they are unsigned."""
        if not self.tls and self.leaves_machine:
            yield CheckCode.NOTICES_UNENCRYPTED(where=self.where)
        if not (self.secret_file or self.secret_env):
            yield CheckCode.NOTICES_UNSIGNED(where=self.where)

    def signing_key(self) -> bytes | None:
        """Return the present signing secret; None without one.  Raises SourceFault, ChannelFault."""
        text = Secret(self.path("secret_file"), self.secret_env, "secret").read()
        return None if text is None else secret_bytes(text, self.secret_env or self.secret_file)

    def probe(self) -> str:
        """Connect and encrypt; nothing is posted."""
        with self._connection() as (connection, secret):
            connection.connect()
            return (
                f"it answers{_security_text(connection)}; notices are {'signed' if secret else 'not signed'}"
            )

    def send(self, message: NoticeMessage) -> None:
        """Post a message; only an answer of 200 to 299 accepts it."""
        body = json.dumps(data(message), ensure_ascii=False, allow_nan=False).encode()
        headers = {"Content-Type": "application/json", "User-Agent": "hygrokf"}
        with self._connection() as (connection, secret), _time_limit(self.timeout_s, connection):
            headers |= signature(message.key, body, time.time(), secret)
            connection.request("POST", self.address.path, body, headers)
            answer = connection.getresponse()
            answer.read(LONGEST_ANSWER)
        if not 200 <= answer.status < 300:
            remedy = ": state the final url" if answer.status < 400 else ""  # a redirection
            refusal = f"{self.where}: it answers {answer.status} {answer.reason}{remedy}"
            raise ChannelFault(refusal, reached=True)

    @contextmanager
    def _connection(self) -> Iterator[tuple[http.client.HTTPConnection, bytes | None]]:
        """A connection, not opened yet, and the present secret.  Raises ChannelFault."""
        with _faults_of(self.where):
            secret, host, port = self.signing_key(), self.address.host, self.address.port
            connection = http.client.HTTPConnection(host, port, timeout=self.timeout_s)
            if self.tls:
                context = tls_context(self.path("ca"))
                connection = http.client.HTTPSConnection(host, port, timeout=self.timeout_s, context=context)
            try:
                yield connection, secret
            finally:
                connection.close()


def signature(key: str, body: bytes, now: float, secret: bytes | None) -> dict[str, str]:
    """Return the headers that identify a body sent at `now` [s] by its key and, with a secret, sign it."""
    stamp = f"{now:.0f}"
    headers = {"webhook-id": key, "webhook-timestamp": stamp}
    if secret is not None:
        digest = hmac.digest(secret, f"{key}.{stamp}.".encode() + body, hashlib.sha256)
        headers["webhook-signature"] = f"v1,{base64.b64encode(digest).decode()}"
    return headers


def secret_bytes(text: str, place: str) -> bytes:
    """Decode a secret such as `whsec_…`; `place` names its file or variable.  Raises ChannelFault."""
    with suppress(binascii.Error, ValueError):
        secret = base64.b64decode(text.removeprefix(SECRET_PREFIX), validate=True)
        if text.startswith(SECRET_PREFIX) and len(secret) >= SHORTEST_SECRET:
            return secret
    raise ChannelFault(
        f"expected {SECRET_PREFIX} and at least {SHORTEST_SECRET} bytes in base64 in {place}; {HOW_TO_MAKE}"
    )


TRANSPORTS: Mapping[str, type[Mail] | type[Webhook]] = {
    "smtp": Mail, "smtps": Mail, "https": Webhook, "http": Webhook,
}  # fmt: skip
"""Scheme of a URL → kind of channel."""


def channel_of(
    table: Mapping[str, object], place: Place, folder: Path, turbines: Collection[str]
) -> Channel | None:
    """Return the channel of a `[[notify]]` table; None if the table has faults, which are reported at
    `place`.

    Nothing is connected yet.  Paths are relative to `folder`.
    """
    url = table.get("url")
    scheme = url.partition(":")[0] if isinstance(url, str) else ""
    if scheme not in TRANSPORTS:
        place.fault(
            f"url must begin with one of {', '.join(f'{kind}:' for kind in TRANSPORTS)}, found {scheme!r}"
        )
        return None
    table_place = replace(place, faults=[])
    channel: Mail | Webhook = read_form(TRANSPORTS[scheme], table, table_place, folder=folder)
    faults = table_place.faults
    unknown = [] if faults else [name for name in channel.turbines if name not in turbines]
    if unknown:
        table_place.fault(f"turbines: no turbine is named {unknown[0]!r}{suggestion(unknown[0], turbines)}")
    place.faults.extend(faults)
    return None if faults else channel
