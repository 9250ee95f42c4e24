"""The configuration of an MQTT broker: address, topics, session, user and TLS; and messages that explain why
a connection to the broker fails.

A password is kept in a file or an environment variable, never in the tracker's file or a URL.  Passwords and
certificates are read again for every connection, so that a renewed one takes effect without a restart.
"""

from __future__ import annotations

import hashlib
import os
import socket
import ssl
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING
from urllib.parse import quote

from hygrokf.data.timestamps import DAY_S, duration
from hygrokf.data.toml_form import across, setting
from hygrokf.live.batch import Alarm
from hygrokf.live.sources.endpoint import OTHERS_READ, PasswordKeys, UrlKeys, tls_context
from hygrokf.live.sources.sparkplug_node import NAMESPACE
from hygrokf.live.sources.stream import SourceKeys
from hygrokf.texts.doctor_codes import Check, CheckCode

if TYPE_CHECKING:
    from paho.mqtt.reasoncodes import ReasonCode

EXPIRY_S = 7.0 * DAY_S
"""Default time [s] for which a broker keeps the session of a disconnected tracker."""
LEAST_EXPIRY_S, MOST_EXPIRY_S = 60.0, 2.0**32 - 2.0
LONGEST_CLIENT_NAME = 100
_TLS = ("ca", "certificate", "key")
_TOPICS = 'a list of topic filters such as ["scada/+/cabinet"]'
MAPPED, SPARKPLUG = "mapped", "sparkplug-b"
MESSAGE_FORMATS = (MAPPED, SPARKPLUG)
"""Formats of messages: payloads that the mapping reads directly, or Sparkplug B."""
LONGEST_TOPIC = 65_535
"""Longest topic [bytes in UTF-8]."""
_CERTIFICATE_ERRORS = {
    9: "its certificate is not valid yet: compare the clocks",
    10: "its certificate has expired",
    18: "its certificate is self-signed: name its CA's file as ca",
    19: "its certificate is signed by a CA that is not trusted here: name the CA's file as ca",
    20: "its certificate is signed by a CA that is not trusted here: name the CA's file as ca",
    21: "its certificate is signed by a CA that is not trusted here: name the CA's file as ca",
    62: "its certificate is for another name: connect by the name that the certificate states",
    64: "its certificate is for another address: connect by the name that the certificate states",
}
"""OpenSSL's error code of a rejected server certificate -> message."""
_TLS_ERRORS = {
    "CERTIFICATE_REQUIRED": "it requires a client certificate: name certificate and key",
    "HANDSHAKE_FAILURE": "it refused the TLS handshake: it may require a client certificate",
    "ALERT_UNKNOWN_CA": "it does not trust the CA of the client certificate",
    "ALERT_CERTIFICATE_EXPIRED": "the client certificate has expired",
    "ALERT_CERTIFICATE_REVOKED": "the client certificate was revoked",
    "ALERT_BAD_CERTIFICATE": "it does not accept the client certificate",
    "ALERT_CERTIFICATE_UNKNOWN": "it does not accept the client certificate",
    "ALERT_PROTOCOL_VERSION": "it offers no safe version of TLS: 1.2 or newer is needed",
    "WRONG_VERSION_NUMBER": "it does not speak TLS on this port",
    "EOF": "it closed the connection at the start of TLS: is this its TLS port?",
}
"""Part of OpenSSL's name of a TLS error -> message."""
_REASONS = {
    132: "it does not speak MQTT 5",
    133: "it does not accept this client_id",
    134: "user name or password is wrong",
    135: "not authorised: user name, password, or the rights of this user and client_id",
    136: "it is not available now",
    137: "it is busy",
    138: "this client was banned",
    139: "it is shutting down",
    141: "it received nothing within the agreed keep-alive",
    142: "another client with this client_id took over the session: give every process its own client_id",
    149: "it received a packet larger than it accepts",
    151: "a quota is exceeded",
    152: "its administrator closed the connection",
    158: "it does not support shared subscriptions",
    159: "connections come faster than it allows",
    162: "it does not support subscriptions with + or #",
}
"""MQTT 5 reason code -> message; other codes are reported by their names."""


class _ClosingSocket(ssl.SSLSocket):
    """A socket that closes itself if the handshake fails, because paho then loses its reference to it."""

    def do_handshake(self, block: bool = False) -> None:
        try:
            super().do_handshake(block)
        except BaseException:
            self.close()
            raise


# -- topics --------------------------------------------------------------------------------------------------
def filter_fault(text: str) -> str | None:
    """An error message for an invalid topic filter, else None; $share/GROUP/FILTER is valid, too."""
    if not text.isprintable() or not 0 < len(text.encode("utf-8", "surrogatepass")) <= LONGEST_TOPIC:
        return f"a topic filter has 1 to {LONGEST_TOPIC} bytes of printable characters"
    if text.split("/")[0] == "$share":
        _, group, rest = (*text.split("/", 2), "", "")[:3]
        if not group or "+" in group or "#" in group or not rest:
            return "a shared subscription is $share/GROUP/FILTER"
        return filter_fault(rest)
    levels = text.split("/")
    if any("#" in level for level in levels[:-1]) or ("#" in levels[-1] and levels[-1] != "#"):
        return '"#" must be alone, as the last level'
    if any("+" in level and level != "+" for level in levels):
        return '"+" must be alone in its level'
    return None


def alarm_topic(prefix: str, alarm: Alarm) -> str:
    """The topic `PREFIX/TURBINE/KIND` of an alarm; KIND includes the alarm's subject if it has one.

    Characters that are special in topics are percent-encoded; spaces in the kind become "_".
    """
    kind = f"{alarm.kind} {alarm.subject}".strip().replace(" ", "_")
    return f"{prefix}/{quote(alarm.turbine, safe='')}/{quote(kind, safe='')}"


# -- the session ---------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Broker(UrlKeys, PasswordKeys, SourceKeys):
    """A [[source]] of `mqtt://[USER@]HOST[:PORT]`, or `mqtts://` for TLS: a broker and a session on it."""

    url: str = setting(help="mqtt://[USER@]HOST[:PORT], or mqtts:// for TLS; never with a password")
    topics: tuple[str, ...] = setting((), "topic filters", expected=_TOPICS, empty=True)
    alarms: str = setting("", "topic below which alarms are published")
    client_id: str | None = setting(
        None,
        "name of the session at the broker",
        fits=lambda name: len(name) <= LONGEST_CLIENT_NAME and name.isprintable(),
        expected=f"text of 1 to {LONGEST_CLIENT_NAME} printable characters",
    )
    session_expiry_s: float = setting(
        EXPIRY_S,
        "for how long the broker keeps the session of an absent tracker",
        read=duration,
        least=LEAST_EXPIRY_S,
        most=MOST_EXPIRY_S,
        expected="1 min or more (and fit into 32 bits): for so long the broker keeps what comes while the "
        "tracker is away",
    )
    user: str | None = setting(None, "if it is not in the url", empty=True)
    ca: str = setting("", "certificates of the CAs to trust, PEM")
    certificate: str = setting("", "of this client, PEM")
    key: str = setting("", "of the certificate, PEM, without a passphrase")

    format: str = setting(MAPPED, "of the messages", choices=MESSAGE_FORMATS)
    rebirth_requests: bool = setting(False, "whether edge nodes are asked for their birth certificates")

    @across("url")
    def url_form(self) -> str | None:
        return self.address.fault

    @across("topics")
    def filters(self) -> Iterator[str]:
        if not self.topics:
            yield f"topics must be {_TOPICS}, found none"
        for topic in self.topics:
            if (fault := filter_fault(topic)) is not None:
                yield f"topics: {fault}, found {topic!r}"

    @across("alarms")
    def alarms_topic(self) -> str | None:
        topic = self.alarms
        fault = filter_fault(topic) if topic else None
        if topic.startswith(("$", "/")) or topic.endswith("/") or "+" in topic or "#" in topic:
            fault = (
                'expected a topic such as "hygrokf/alarms", without +, #, a $ or / in front and a / behind'
            )
        return None if fault is None else f"alarms: {fault}, found {topic!r}"

    @across("user", "url")
    def user_stated_once(self) -> str | None:
        if self.user is None or not self.address.user:
            return None
        return "user stands in the url and as a key: keep one"

    @across("password_file", "password_env", "user")
    def password_of_user(self) -> str | None:
        if not self.password.is_stated or self.user or self.address.user:
            return None
        return "a password needs its user: add user, or mqtt://USER@HOST"

    @across(*_TLS)
    def tls_files(self) -> Iterator[str]:
        if not self.tls and (tls_keys := [key for key in _TLS if getattr(self, key)]):
            yield f"{', '.join(tls_keys)}: only with TLS; write mqtts:// or take this away"
        if bool(self.certificate) != bool(self.key):
            yield "certificate and key belong together: both, or neither"

    @across("format", "rebirth_requests")
    def requests_of_sparkplug(self) -> str | None:
        if self.format == SPARKPLUG or not self.rebirth_requests:
            return None
        return f'rebirth_requests: only with format = "{SPARKPLUG}"'

    @across("format", "weather")
    def readings_of_sparkplug(self) -> str | None:
        is_contradictory = self.format == SPARKPLUG and self.weather
        return f'weather: not with format = "{SPARKPLUG}"' if is_contradictory else None

    @across("format", "topics")
    def topics_of_sparkplug(self) -> Iterator[str]:
        for topic in self.topics if self.format == SPARKPLUG else ():
            levels = topic.split("/")
            if levels[0] == "$share":
                yield f"topics: a share has gaps in the sequence of every edge node, found {topic!r}"
            elif levels[0] != NAMESPACE or ("#" not in levels[1:3] and levels[2:3] != ["+"]):
                yield (
                    f"topics: births, data and deaths are needed: write {NAMESPACE}/GROUP/# or "
                    f"{NAMESPACE}/GROUP/+/NODE/#, found {topic!r}"
                )

    @property
    def user_name(self) -> str:
        return self.user or self.address.user

    @property
    def session(self) -> str:
        """The name of the session, by default `hygrokf-HOST-DIGEST`.

        The default stays the same across restarts on this machine, but differs between folders and between
        brokers.
        """
        if self.client_id:
            return self.client_id
        scheme, host, port, *_ = self.address
        host_name = "".join(c for c in socket.gethostname().partition(".")[0] if c.isalnum() and c.isascii())[
            :20
        ]
        names = f"{scheme}:{host}:{port} {self.folder.resolve()}"
        return f"hygrokf-{host_name}-{hashlib.sha256(names.encode()).hexdigest()[:8]}"

    @property
    def session_url(self) -> str:
        """The source's URL with broker and session, but without user and password."""
        return f"{self.address.scheme}://{self.where}?client_id={quote(self.session)}"

    def context(self) -> ssl.SSLContext | None:
        """TLS context that verifies chain and host name of the broker's certificate; None without TLS.
        Raises SourceFault."""
        if not self.tls:
            return None
        context = tls_context(*map(self.path, _TLS))
        context.sslsocket_class = _ClosingSocket
        return context

    def cautions(self) -> Iterator[Check]:
        """Settings that work but are unsafe."""
        for name in ("password_file", "key"):
            path = self.path(name)
            if path is not None and os.name == "posix" and path.exists():
                if path.stat().st_mode & OTHERS_READ:
                    yield CheckCode.SECRET_READABLE(path=str(path))
        if self.user_name and not self.tls and self.leaves_machine:
            yield CheckCode.LOGIN_IN_PLAIN_TEXT(where=self.where)


# -- why a connection fails ----------------------------------------------------------------------------------
def unreachable_text(fault: BaseException, where: str) -> str:
    """Message that explains why the endpoint `where` (HOST:PORT) cannot be reached."""
    if isinstance(fault, ssl.SSLCertVerificationError):
        reason = (
            _CERTIFICATE_ERRORS.get(fault.verify_code)
            or f"its certificate is not trusted: {fault.verify_message}"
        )
    elif isinstance(fault, ssl.SSLError):
        reason = tls_error_text(str(fault)) or f"TLS failed: {fault.reason or fault}"
    elif isinstance(fault, socket.gaierror | UnicodeError):
        reason = "its name cannot be resolved: check the name and this machine's name server"
    elif isinstance(fault, ConnectionRefusedError):
        reason = "refused: nothing listens there; check host and port, and that it is running"
    elif isinstance(fault, TimeoutError):
        reason = "it does not answer: check the network and firewalls between"
    elif isinstance(fault, ConnectionError):
        reason = "it closed the connection during set-up: check the port, and whether it uses TLS"
    elif isinstance(fault, OSError):
        reason = fault.strerror or str(fault)
    else:
        reason = f"{type(fault).__name__}: {fault}"
    return f"{where}: {reason}"


def tls_error_text(text: str) -> str | None:
    """Message for an error text of OpenSSL; None if the error is not among `_TLS_ERRORS`."""
    upper = text.upper()
    return next((message for name, message in _TLS_ERRORS.items() if name in upper), None)


def reason_text(code: ReasonCode) -> str:
    """Message for a reason code of MQTT 5."""
    return _REASONS.get(code.value, f"{str(code).lower()} (reason code {code.value})")
