"""Mail as a channel: SMTP with TLS from the start (`smtps:`) or by STARTTLS (`smtp:`).

A message's key is its Message-ID.  If the connection breaks after the text is sent and before the server's
answer arrives, nobody can tell whether the server has accepted it (RFC 1047): it is sent again with the same
Message-ID, by which mailboxes recognise a repeat.
"""

from __future__ import annotations

import re
import smtplib
import socket
import ssl
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from email.message import EmailMessage
from email.policy import SMTP
from email.utils import formatdate, parseaddr
from pathlib import Path

from hygrokf.live.notification.channel import ChannelFault, Message, ended_after, subject, text, tls_context
from hygrokf.live.sources.broker import unreachable
from hygrokf.live.sources.endpoint import bracketed, is_loopback, password_of
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
    password_file: Path | None = None
    password_env: str = ""
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
            smtp.login(self.user, password_of(self.password_file, self.password_env) or "")

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
