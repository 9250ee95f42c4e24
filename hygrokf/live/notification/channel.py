"""A channel: its receiver, the alarms that it covers, the hold-off of alarms before they are sent, and the
text of its messages."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from hygrokf.data.structured import JsonObject
from hygrokf.data.timestamps import DAY_S, duration
from hygrokf.data.toml_form import FolderKeys, across, setting
from hygrokf.errors import HygrokfError
from hygrokf.live.alarms import ALARM_RULES
from hygrokf.live.batch import Alarm
from hygrokf.live.sources.endpoint import UrlKeys
from hygrokf.texts.doctor_codes import Check
from hygrokf.texts.wording import one_line, stamp_text

SEVERITIES = ("notice", "warning", "alarm")
"""Severities of an alarm, the lowest first."""
URGENT = "alarm"
"""Severity of alarms that are not collected into a digest."""
BEGAN, WORSENED, ENDED = "began", "worsened", "ended"
ACKNOWLEDGED, DUE_AGAIN = "acknowledged", "due again"
OPENING = (BEGAN, WORSENED, DUE_AGAIN)
"""Events that announce an open alarm; other events are sent only after one of these was sent."""
LONGEST_SUBJECT = 150
"""Longest subject [characters]."""
TEST = "test message: notices of this tracker arrive here"
LONGEST_REASON = 200
"""Longest reason of a failure that is shown [characters]."""


class ChannelFault(HygrokfError):
    """A message could not be delivered; the text says why and contains no secret.

    `reached`: whether the server was reached and refused this message, so that others may still pass.
    """

    def __init__(self, message: str, reached: bool = False) -> None:
        line = one_line(message)
        super().__init__(line if len(line) <= LONGEST_REASON else f"{line[: LONGEST_REASON - 1]}…")
        self.reached = reached


@dataclass(frozen=True)
class Content:
    """The content of a notice: an `event`, and the `alarm` in its state at the event.

    `message`: key of the message that contains the notice, "" before the first attempt; after the first
    attempt the message no longer changes.
    """

    event: str
    alarm: Alarm
    message: str = ""


@dataclass(frozen=True)
class NoticeMessage:
    """A message: id of a notice → its content.

    `key` is the same at every attempt, so that a receiver can drop a repeat; a message without contents is a
    test.
    """

    key: str
    contents: dict[str, Content] = field(default_factory=dict)
    attempts: int = 0

    @classmethod
    def of(cls, contents: dict[str, Content]) -> NoticeMessage:
        """A new message, whose key is a digest of its notices' ids."""
        key = hashlib.sha256("\n".join(sorted(contents)).encode()).hexdigest()[:32]
        return cls(key, {name: replace(content, message=key) for name, content in contents.items()})


def subject(message: NoticeMessage) -> str:
    """The subject of a message in one line."""
    contents = list(message.contents.values())
    if not contents:
        return f"[hygrokf] {TEST}"
    if len(contents) == 1:
        summary = headline(contents[0])
    else:
        events = Counter(content.event for content in contents)
        summary = f"{len(contents)} notices: {', '.join(f'{n} {event}' for event, n in events.items())}"
    return one_line(f"[hygrokf] {summary}")[:LONGEST_SUBJECT]


def headline(content: Content) -> str:
    """One line about one alarm."""
    alarm = content.alarm
    origin = alarm.turbine or "tracker"
    severity = "" if content.event == ACKNOWLEDGED else f"{alarm.severity}, "
    return one_line(f"{origin}: {alarm.kind} ({severity}{content.event})")


def text(message: NoticeMessage) -> str:
    """The message as text for people; its contents are sorted by the beginning of their alarms."""
    if not message.contents:
        return f"{TEST}\n"
    in_order = sorted(message.contents.values(), key=lambda content: (content.alarm.began, content.alarm.id))
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


def data(message: NoticeMessage) -> JsonObject:
    """The message as data for programs, the same at every attempt."""
    return {
        "type": "hygrokf.alarms" if message.contents else "hygrokf.test",
        "text": text(message),
        "notices": [
            {"id": name, "event": content.event, "alarm": content.alarm.served()}
            for name, content in message.contents.items()
        ],
    }


# -- keys common to the tables of all channels ---------------------------------------------------------------
LONGEST_CHANNEL_NAME = 40
MOST_HOLD_OFF_S, MOST_DIGEST_S = 7.0 * DAY_S, DAY_S


@dataclass(frozen=True, kw_only=True, repr=False)
class Channel(UrlKeys, FolderKeys):
    """The receiver of notices, and the alarms that it covers; empty `kinds`, `severities` or `turbines`
    stand for all.

    `hold_off_s`: time [s] that an alarm must last before it is sent; `digest_s`: interval [s] of messages
    that collect all notices that are not urgent, 0 to send each notice at once.
    """

    name: str = setting(
        help="the name of the channel",
        fits=lambda name: len(name) <= LONGEST_CHANNEL_NAME and name.isprintable() and ":" not in name,
        expected=f"text of 1 to {LONGEST_CHANNEL_NAME} printable characters without a colon",
    )
    hold_off_s: float = setting(
        0.0,
        "time that an alarm must stand",
        read=duration,
        least=0.0,
        most=MOST_HOLD_OFF_S,
        expected="at most 7 d",
    )
    digest_s: float = setting(
        0.0, "interval of collected messages", read=duration, least=0.0, most=MOST_DIGEST_S,
        expected="at most 1 d",
    )  # fmt: skip
    kinds: tuple[str, ...] = setting((), "kinds of alarms", choices=tuple(ALARM_RULES))
    severities: tuple[str, ...] = setting((), "severities of alarms", choices=SEVERITIES)
    turbines: tuple[str, ...] = setting((), "names of turbines", empty=True)
    ca: str = setting("", "certificates of the CAs to trust, PEM")
    url: str

    @across("url")
    def url_form(self) -> str | None:
        if not self.url.isascii():
            return "url must be ASCII"
        return self.address.fault

    def send(self, message: NoticeMessage) -> None:
        """Send a message; returns when the receiver has accepted it.  Raises ChannelFault."""
        raise NotImplementedError

    def probe(self) -> str:
        """Try everything except sending; returns a description of the server.  Raises ChannelFault."""
        raise NotImplementedError

    def cautions(self) -> Iterator[Check]:
        """Warnings about settings that work but are unsafe."""
        raise NotImplementedError

    def concerns(self, alarm: Alarm) -> bool:
        """Whether the channel sends this alarm at some severity; an alarm without a turbine (a lost source)
        concerns the channels of all turbines."""
        return (not self.kinds or alarm.kind in self.kinds) and (
            not self.turbines or not alarm.turbine or alarm.turbine in self.turbines
        )

    def covers(self, alarm: Alarm) -> bool:
        """Whether the channel sends the beginning of an alarm."""
        return self.concerns(alarm) and (not self.severities or alarm.severity in self.severities)

    def collects(self, alarm: Alarm) -> bool:
        """Whether notices of an alarm wait for the next digest."""
        return self.digest_s > 0.0 and alarm.severity != URGENT

    def due_s(self, alarm: Alarm, from_s: float) -> float:
        """Time [s] at which a notice that may be sent from `from_s` [s] on is due."""
        return self.digest_s * math.ceil(from_s / self.digest_s) if self.collects(alarm) else from_s
