"""A channel: where notices go, which alarms it covers, how long an alarm must stand before it is sent, and
its messages in words; and the notices of alarms: which are written when an alarm changes or is
acknowledged, and what becomes of one that is due.

A notice is written in the transaction that writes the alarm, so that none is lost.  Whether it is sent is
decided when it is due: an alarm that has ended within its hold-off is not, and the end of an alarm only if
its beginning was.  Its id consists of channel, alarm and event, so that it is written once.
"""

from __future__ import annotations

import hashlib
import json
import math
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

from hygrokf.data.structured import JsonObject, structured
from hygrokf.data.timestamps import DAY_S, stamp_text
from hygrokf.errors import HygrokfError
from hygrokf.identification.wording import one_line
from hygrokf.live.batch import Alarm, Batch, Notice
from hygrokf.live.storage.outbox import alarm_of
from hygrokf.live.storage.store import Store

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


PAST_S = DAY_S
"""[s] after its beginning from which a new alarm counts as one of the past: the tracker is catching up."""
CATCH_UP_S = 600.0
"""[s] an alarm of the past waits, so that its end is known if it has ended."""
SHELVED_S = 60.0
"""[s] after which a shelved alarm is looked at again."""
LOOK_AGAIN = "look again"
"""The cause of an acknowledgement that holds for some days only."""
SEVERITIES = ("notice", "warning", "alarm")
"""Severities of an alarm, the lowest first."""


# -- writing -------------------------------------------------------------------------------------------------
def notices_of(
    alarms: Iterable[Alarm], channels: Iterable[Channel], now: float, record_now: float
) -> list[Notice]:
    """Notices of alarms that began, became worse or ended, made at `now` [s]; `record_now` [s] is the time of
    the readings.

    An end is written whatever the severity is by then: it is sent if the beginning was.
    """
    channels = tuple(channels)
    return [
        _notice(channel, alarm, BEGAN if alarm.ended is None else ENDED, now, record_now)
        for alarm in alarms
        for channel in channels
        if (channel.covers(alarm) if alarm.ended is None else channel.concerns(alarm))
    ]


def acknowledge(
    store: Store,
    alarm: str,
    by: str,
    now: float,
    cause: str,
    note: str = "",
    look_again_s: float | None = None,
    channels: Sequence[Channel] = (),
) -> str | None:
    """Acknowledge an alarm at `now` [s]; returns its turbine, None if it cannot be acknowledged (any more).

    `look_again_s`: time [s] at which it is due again.
    """
    found = alarm_of(store, alarm)
    if found is None:
        return None
    known = replace(
        found, acknowledged=now, acknowledged_by=by, cause=cause, note=note, look_again=look_again_s
    )
    at = time.time()
    notices = [_notice(one, known, ACKNOWLEDGED, at, at) for one in channels if one.concerns(known)]
    return found.turbine if store.acknowledge(known, notices) else None


def look_again(store: Store, now: float, channels: Sequence[Channel]) -> Batch:
    """Open alarms that are due at `now` [s] to be looked at again: unacknowledged, with their notices."""
    batch, at = Batch(), time.time()
    rest = "WHERE ended IS NULL AND acknowledged IS NOT NULL AND look_again <= ? ORDER BY look_again, id"
    for alarm in store.found(Alarm, rest, (now,)):
        assert alarm.look_again is not None, "that is how they are found"
        # cause and note of the last acknowledgement stay
        back = replace(alarm, acknowledged=None, acknowledged_by=None, look_again=None)
        batch.reopened.append(back)
        batch.notices += [
            replace(
                _notice(one, back, DUE_AGAIN, at, at),
                id=f"{prefix(one.name, back.id)}{DUE_AGAIN} {alarm.look_again:.0f}",
            )
            for one in channels
            if one.covers(back)
        ]
    return batch


def _notice(channel: Channel, alarm: Alarm, event: str, now: float, record_now: float) -> Notice:
    wait_s = channel.hold_off_s if event == BEGAN else 0.0
    if event == BEGAN and record_now - alarm.began > PAST_S:
        wait_s = max(wait_s, CATCH_UP_S)
    # a beginning is written anew when the severity rises, an acknowledgement after each return
    mark = {BEGAN: alarm.severity, ACKNOWLEDGED: f"{ACKNOWLEDGED} {alarm.acknowledged or now:.0f}"}
    return Notice(
        id=prefix(channel.name, alarm.id) + mark.get(event, event),
        channel=channel.name,
        content=as_text(Content(event, alarm)),
        made=now,
        due=channel.due_s(alarm, now + wait_s),
    )


def prefix(channel: str, alarm: str) -> str:
    """The part that the ids of a channel's notices about an alarm have in common."""
    return f"{channel}:{alarm}:"


def as_text(content: Content) -> str:
    """The content of a notice as JSON."""
    return json.dumps(asdict(content), ensure_ascii=False)


def content_of(notice: Notice) -> Content:
    """The content of a stored notice."""
    return structured(Content, json.loads(notice.content))


# -- deciding ------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Send:
    """Send this content now."""

    content: Content


@dataclass(frozen=True)
class Drop:
    """Send nothing, for a reason."""

    reason: str


@dataclass(frozen=True)
class Wait:
    """Decide again at a time [s]."""

    until: float


@dataclass(frozen=True)
class Situation:
    """What is known when a notice is due.

    `alarm` as the store has it, None if it was deleted; `others`: the channel's other notices about it;
    whether it is `shelved`; `now` [s], and `record_now` [s], the time of the readings.
    """

    alarm: Alarm | None
    others: Sequence[Notice]
    shelved: bool
    now: float
    record_now: float


def decide(notice: Notice, channel: Channel, known: Situation) -> Send | Drop | Wait:
    """What becomes of a notice that is due and was not attempted before."""
    content = content_of(notice)
    if known.alarm is None:
        return Drop("the alarm is no longer stored")
    if content.event in OPENING:
        return _decide_opening(notice, content, channel, known, known.alarm)
    openings = [one for one in known.others if content_of(one).event in OPENING]
    if any(delivered(one) for one in openings):
        return Send(content)
    waiting = [one.due for one in openings if one.sent is None]
    return Wait(max(min(waiting), known.now + 1.0)) if waiting else Drop("its beginning was not sent")


def _decide_opening(
    notice: Notice, content: Content, channel: Channel, known: Situation, alarm: Alarm
) -> Send | Drop | Wait:
    if alarm.acknowledged is not None:
        return Drop("it was acknowledged before the notice was due")
    if known.shelved:
        return Drop("it ended while shelved") if alarm.ended is not None else Wait(known.now + SHELVED_S)
    if alarm.ended is not None:
        made = [one.made for one in known.others if content_of(one).event == ENDED]
        if alarm.ended - alarm.began < channel.hold_off_s and made and made[0] < notice.due:
            return Drop("it ended within the hold-off")
        if known.record_now - alarm.ended > PAST_S:
            return Drop("it was over before the tracker had caught up")
    told = (content_of(one) for one in known.others if delivered(one))
    before = [one.alarm.severity for one in told if one.event in OPENING]
    if content.event == BEGAN and before:
        if max(map(SEVERITIES.index, before)) >= SEVERITIES.index(content.alarm.severity):
            return Drop("a severer notice was sent")
        return Send(replace(content, event=WORSENED))
    return Send(content)


def delivered(notice: Notice) -> bool:
    """Whether a receiver has accepted a notice; one that was dropped says why as its failure."""
    return notice.sent is not None and not notice.failure
