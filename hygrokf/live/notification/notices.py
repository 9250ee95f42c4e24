"""The notices of alarms: which are written when an alarm changes or is acknowledged, what becomes of one that
is due, and the outbox in the store that holds them.

A notice is written in the transaction that writes the alarm, so that none is lost.  Whether it is sent is
decided when it is due: an alarm that has ended within its hold-off is not, and the end of an alarm only if
its beginning was.  Its id consists of channel, alarm and event, so that it is written once.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

from hygrokf.data.structured import structured
from hygrokf.data.timestamps import DAY_S
from hygrokf.live.batch import Alarm, Batch, Notice
from hygrokf.live.notification.channel import (
    ACKNOWLEDGED,
    BEGAN,
    DUE_AGAIN,
    ENDED,
    OPENING,
    SEVERITIES,
    WORSENED,
    Channel,
    Content,
)
from hygrokf.live.storage import schema, statements
from hygrokf.live.storage.statements import select_rows
from hygrokf.live.storage.store import Store
from hygrokf.texts.live import NoticeCode
from hygrokf.texts.statement import Statement

if TYPE_CHECKING:
    from sqlalchemy import ClauseElement

PAST_S = DAY_S
"""[s] after its beginning from which a new alarm counts as one of the past: the tracker is catching up."""
CATCH_UP_S = 600.0
"""[s] an alarm of the past waits, so that its end is known if it has ended."""
SHELVED_S = 60.0
"""[s] after which a shelved alarm is looked at again."""
LOOK_AGAIN = "look again"
"""The cause of an acknowledgement that holds for some days only."""


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
    for alarm in store.records(Alarm, statements.DUE_AGAIN, now=now):
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
def decide(
    notice: Notice,
    channel: Channel,
    alarm: Alarm | None,
    others: Sequence[Notice],
    shelved: bool,
    now: float,
    record_now: float,
) -> Content | Statement | float:
    """What becomes of a notice that is due and was not attempted before: the content to send now, the reason
    to send nothing, or the time [s] at which to decide again.

    `alarm` as the store has it, None if it was deleted; `others`: the channel's other notices about it;
    whether it is `shelved`; `now` [s], and `record_now` [s], the time of the readings.
    """
    content = content_of(notice)
    if alarm is None:
        return NoticeCode.ALARM_NOT_STORED()
    if content.event not in OPENING:
        openings = [one for one in others if content_of(one).event in OPENING]
        if any(delivered(one) for one in openings):
            return content
        waiting = [one.due for one in openings if one.sent is None]
        return max(min(waiting), now + 1.0) if waiting else NoticeCode.BEGINNING_NOT_SENT()
    if alarm.acknowledged is not None:
        return NoticeCode.ACKNOWLEDGED_BEFORE()
    if shelved:
        return NoticeCode.ENDED_WHILE_SHELVED() if alarm.ended is not None else now + SHELVED_S
    if alarm.ended is not None:
        made = [one.made for one in others if content_of(one).event == ENDED]
        if alarm.ended - alarm.began < channel.hold_off_s and made and made[0] < notice.due:
            return NoticeCode.ENDED_IN_HOLD_OFF()
        if record_now - alarm.ended > PAST_S:
            return NoticeCode.OVER_BEFORE_CAUGHT_UP()
    told = (content_of(one) for one in others if delivered(one))
    before = [one.alarm.severity for one in told if one.event in OPENING]
    if content.event == BEGAN and before:
        if max(map(SEVERITIES.index, before)) >= SEVERITIES.index(content.alarm.severity):
            return NoticeCode.SEVERER_SENT()
        return replace(content, event=WORSENED)
    return content


def delivered(notice: Notice) -> bool:
    """Whether a receiver has accepted a notice; one that was dropped says why as its failure."""
    return notice.sent is not None and not notice.failure


# -- the outbox ----------------------------------------------------------------------------------------------
def due(store: Store, channel: str, now: float, most: int) -> list[Notice]:
    """A channel's notices that are not sent and due at `now` [s], the earliest first."""
    return store.records(Notice, statements.DUE, channel=channel, now=now, most=most)


@dataclass(frozen=True)
class ChannelState:
    """A channel's outbox: notices `waiting`, of which the oldest was `made` [s]; the `failure` of
    their attempts, empty if none has failed; when a notice was last `sent` [s]."""

    waiting: int = 0
    made: float | None = None
    failure: str = ""
    sent: float | None = None


def channel_states(store: Store) -> dict[str, ChannelState]:
    """The outbox by channel."""
    return {
        channel: ChannelState(int(count), *rest)
        for channel, count, *rest in store.rows(statements.CHANNEL_STATES)
    }


def beginning_with(store: Store, channel: str, prefix: str) -> list[Notice]:
    """A channel's notices whose ids begin with a text."""
    return store.records(Notice, statements.NOTICES_ABOUT, channel=channel, length=len(prefix), prefix=prefix)


def keep_contents(store: Store, contents: Iterable[tuple[str, str]]) -> None:
    """Write the contents (id, JSON) of notices that are about to be sent, so that a repeat is the same."""
    _change(store, statements.KEEP_CONTENT, [{"notice": name, "text": text} for name, text in contents])


def postpone(store: Store, notices: Iterable[tuple[str, float]]) -> None:
    """Decide about notices (id) again at a time [s]."""
    _change(store, statements.POSTPONE, [{"notice": name, "at": at} for name, at in notices])


def drop(store: Store, notices: Iterable[tuple[str, Statement]], at: float) -> None:
    """Send notices (id) never, for a reason."""
    _change(
        store,
        statements.DROP,
        [{"notice": name, "reason": reason.text, "at": at} for name, reason in notices],
    )


def mark_sent(store: Store, notices: Iterable[str], at: float) -> None:
    """State that notices (by id) were sent at a time [s]."""
    _change(store, statements.MARK_SENT, [{"notice": name, "at": at} for name in notices])


def mark_failed(store: Store, notices: Iterable[str], failure: str, due: float) -> None:
    """State why notices (by id) could not be sent, and when they are due again [s]."""
    _change(
        store, statements.MARK_FAILED, [{"notice": name, "reason": failure, "at": due} for name in notices]
    )


def forget(store: Store, before: float) -> None:
    """Delete notices that were sent, dropped or, of a channel that exists no longer, made before a time
    [s]."""
    store.execute(statements.FORGET_NOTICES, before=before)


def alarm_of(store: Store, alarm: str) -> Alarm | None:
    """An alarm by its id; None if there is none."""
    return next(iter(store.records(Alarm, select_rows(schema.alarm, same="id"), id=alarm)), None)


def _change(store: Store, statement: ClauseElement, changes: Sequence[Mapping[str, object]]) -> None:
    """Execute a statement with the values of each of some changes, all or none."""
    if changes:
        with store.transaction():
            for values in changes:
                store.execute(statement, **values)
