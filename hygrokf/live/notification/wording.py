"""Messages in words: subject and text for people, data for machines."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict

from hygrokf.data.structured import JsonObject
from hygrokf.data.timestamps import stamp_text
from hygrokf.identification.wording import one_line
from hygrokf.live.notification.channel import ACKNOWLEDGED, ENDED, Content, Message

LONGEST_SUBJECT = 150
"""Longest subject [characters]."""
TEST = "test message: notices of this tracker arrive here"


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
