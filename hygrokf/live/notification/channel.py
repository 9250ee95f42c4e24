"""A channel: where notices go, which alarms it covers, how long an alarm must stand before it is sent; and
its messages in words."""

from __future__ import annotations

import hashlib
import math
import socket
import ssl
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from hygrokf.data.structured import JsonObject
from hygrokf.data.timestamps import stamp_text
from hygrokf.errors import HygrokfError
from hygrokf.identification.wording import one_line
from hygrokf.live.batch import Alarm

if TYPE_CHECKING:
    import http.client
    import smtplib

URGENT = "alarm"
"""Severity of alarms that are not collected into a digest."""
BEGAN, WORSENED, ENDED = "began", "worsened", "ended"
ACKNOWLEDGED, DUE_AGAIN = "acknowledged", "due again"
OPENING = (BEGAN, WORSENED, DUE_AGAIN)
"""Events that announce an open alarm; the others are sent only if one of these was."""
LONGEST_SUBJECT = 150
"""Longest subject [characters]."""
TEST = "test message: notices of this tracker arrive here"
LONGEST_REASON = 200
"""[characters] of a server's answer that are shown."""


class ChannelFault(HygrokfError):
    """A message could not be delivered; the text says why and contains no secret.

    `reached`: whether the server was reached and refused this message, so that others may still pass.
    """

    def __init__(self, words: str, reached: bool = False) -> None:
        shown = one_line(words)
        super().__init__(shown if len(shown) <= LONGEST_REASON else f"{shown[: LONGEST_REASON - 1]}…")
        self.reached = reached


@dataclass(frozen=True)
class Content:
    """What a notice says: an `event` of an `alarm` as it was then.

    `message`: key of the message that carries it, empty before the first attempt; from then on that message
    stays as it is.
    """

    event: str
    alarm: Alarm
    message: str = ""


@dataclass(frozen=True)
class Message:
    """What is sent at once: contents by id of their notices.

    `key` is the same at every attempt, so that a receiver can drop a repeat; a message without contents is a
    test.
    """

    key: str
    contents: dict[str, Content] = field(default_factory=dict)
    attempts: int = 0

    @classmethod
    def of(cls, contents: dict[str, Content]) -> Message:
        """A new message, whose key is a digest of its notices' ids."""
        key = hashlib.sha256("\n".join(sorted(contents)).encode()).hexdigest()[:32]
        return cls(key, {name: replace(one, message=key) for name, one in contents.items()})


def subject(message: Message) -> str:
    """One line that says what a message is about."""
    contents = list(message.contents.values())
    if not contents:
        return f"[hygrokf] {TEST}"
    if len(contents) == 1:
        said = headline(contents[0])
    else:
        events = Counter(one.event for one in contents)
        said = f"{len(contents)} notices: {', '.join(f'{n} {event}' for event, n in events.items())}"
    return one_line(f"[hygrokf] {said}")[:LONGEST_SUBJECT]


def headline(content: Content) -> str:
    """One line about one alarm."""
    alarm = content.alarm
    whose = alarm.turbine or "tracker"
    word = "" if content.event == ACKNOWLEDGED else f"{alarm.severity}, "
    return one_line(f"{whose}: {alarm.kind} ({word}{content.event})")


def text(message: Message) -> str:
    """The message for people, the most severe and newest contents last."""
    if not message.contents:
        return f"{TEST}\n"
    in_order = sorted(message.contents.values(), key=lambda one: (one.alarm.began, one.alarm.id))
    return "\n\n".join(map(_paragraph, in_order)) + "\n"


def _paragraph(content: Content) -> str:
    alarm = content.alarm
    lines = [headline(content), f"  {one_line(alarm.statement)}"]
    if content.event == ENDED and alarm.ended is not None:
        lines.append(f"  from {stamp_text(alarm.began)} to {stamp_text(alarm.ended)}")
    else:
        lines.append(f"  since {stamp_text(alarm.began)}")
    if content.event == ACKNOWLEDGED:
        note = f": {alarm.note}" if alarm.note else ""
        lines.append(one_line(f"  {alarm.cause} – {alarm.acknowledged_by}{note}"))
        if alarm.look_again is not None:
            lines.append(f"  due again {stamp_text(alarm.look_again)}")
    elif content.event != ENDED and alarm.remedy:
        lines.append(f"  to do: {one_line(alarm.remedy)}")
    return "\n".join(lines)


def data(message: Message) -> JsonObject:
    """The message for machines; the same at every attempt."""
    return {
        "type": "hygrokf.alarms" if message.contents else "hygrokf.test",
        "text": text(message),
        "notices": [
            {"id": name, "event": one.event, "alarm": asdict(one.alarm)}
            for name, one in message.contents.items()
        ],
    }


class Transport(Protocol):
    """Delivers messages.

    `where`: HOST:PORT; `send` returns once the receiver has accepted the message, and `probe` tries
    everything but sending and says what it found.  Both raise ChannelFault.  `cautions` are settings that
    work but are unsafe.
    """

    @property
    def where(self) -> str: ...

    def send(self, message: Message) -> None: ...

    def probe(self) -> str: ...

    def cautions(self) -> Iterator[str]: ...


@dataclass(frozen=True)
class Channel:
    """Where notices go, and which alarms they are about; empty `kinds`, `severities`, `turbines` stand for
    all.

    `hold_off_s` [s] an alarm must stand before it is sent; `digest_s`: interval [s] after which notices that
    are not urgent are sent together, 0 for each at once.
    """

    name: str
    transport: Transport
    hold_off_s: float = 0.0
    digest_s: float = 0.0
    kinds: tuple[str, ...] = ()
    severities: tuple[str, ...] = ()
    turbines: tuple[str, ...] = ()

    def concerns(self, alarm: Alarm) -> bool:
        """Whether an alarm of some severity is sent here; one of no turbine (a lost source) concerns all of
        them."""
        return (not self.kinds or alarm.kind in self.kinds) and (
            not self.turbines or not alarm.turbine or alarm.turbine in self.turbines
        )

    def covers(self, alarm: Alarm) -> bool:
        """Whether the beginning of an alarm is sent here."""
        return self.concerns(alarm) and (not self.severities or alarm.severity in self.severities)

    def collects(self, alarm: Alarm) -> bool:
        """Whether notices of an alarm wait for the next digest."""
        return self.digest_s > 0.0 and alarm.severity != URGENT

    def due_s(self, alarm: Alarm, from_s: float) -> float:
        """When [s] a notice that may be sent from a time [s] on is due."""
        if not self.collects(alarm):
            return from_s
        return self.digest_s * math.ceil(from_s / self.digest_s)


@contextmanager
def ended_after(seconds: float, connection: smtplib.SMTP | http.client.HTTPConnection) -> Iterator[None]:
    """Within this context a connection is broken after a time [s], which limits exchanges whose single steps
    never time out."""

    def cut() -> None:
        with suppress(OSError, AttributeError):
            if connection.sock is not None:
                connection.sock.shutdown(socket.SHUT_RDWR)

    timer = threading.Timer(seconds, cut)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def tls_context(ca: Path | None) -> ssl.SSLContext:
    """A context that verifies chain and host name of a server's certificate.  Raises ChannelFault."""
    try:
        return ssl.create_default_context(cafile=ca)
    except (OSError, ssl.SSLError) as fault:
        said = "expected certificates in PEM" if isinstance(fault, ssl.SSLError) else fault.strerror
        raise ChannelFault(f"ca: {ca}: {said}") from None
