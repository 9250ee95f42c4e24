"""The notices of alarms: writing them when an alarm changes or is acknowledged, deciding whether a due notice
is sent, and the outbox in the store that holds them.

A notice is written in the transaction that writes the alarm, so that no notice is lost.  When a notice is
due, `decide` decides whether to send it: an alarm that ended within its hold-off is not sent, and the end of
an alarm only if its beginning was sent.  The id of a notice consists of channel, alarm and event, so that
each notice is written only once.
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
from hygrokf.texts.live_codes import NoticeCode
from hygrokf.texts.statement import Statement

if TYPE_CHECKING:
    from sqlalchemy import ClauseElement

PAST_S = DAY_S
"""Age [s] above which a new alarm belongs to the past, because the tracker is catching up with old
readings."""
CATCH_UP_S = 600.0
"""[s] for which a notice of a past alarm waits, so that the end of the alarm may become known."""
SHELVED_S = 60.0
"""[s] after which the notice of a shelved alarm is decided again."""
LOOK_AGAIN = "look again"
"""The cause of an acknowledgement that is valid only for some days."""


# -- writing -------------------------------------------------------------------------------------------------
def notices_of(
    alarms: Iterable[Alarm], channels: Iterable[Channel], now: float, record_now: float
) -> list[Notice]:
    """Notices, made at `now` [s], of alarms that began, became worse or ended; `record_now` [s] is the time
    of the readings.

    An end is written whatever the final severity is, because it is sent if the beginning was sent.
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
    """Acknowledge an alarm at `now` [s]; returns its turbine, or None if the alarm does not exist or is
    already acknowledged.

    look_again_s: time [s] at which the alarm is due again.
    """
    stored = alarm_of(store, alarm)
    if stored is None:
        return None
    acknowledged = replace(
        stored, acknowledged=now, acknowledged_by=by, cause=cause, note=note, look_again=look_again_s
    )
    at = time.time()
    notices = [
        _notice(channel, acknowledged, ACKNOWLEDGED, at, at)
        for channel in channels
        if channel.concerns(acknowledged)
    ]
    return stored.turbine if store.acknowledge(acknowledged, notices) else None


def look_again(store: Store, now: float, channels: Sequence[Channel]) -> Batch:
    """A batch that reopens the open alarms that are due again at `now` [s]: without acknowledgement, with
    notices."""
    batch, at = Batch(), time.time()
    for alarm in store.records(Alarm, statements.DUE_ALARMS, now=now):
        assert alarm.look_again is not None, "the query selects alarms with that time"
        # cause and note of the last acknowledgement stay
        reopened = replace(alarm, acknowledged=None, acknowledged_by=None, look_again=None)
        batch.reopened.append(reopened)
        batch.notices += [
            replace(
                _notice(channel, reopened, DUE_AGAIN, at, at),
                id=f"{id_prefix(channel.name, reopened.id)}{DUE_AGAIN} {alarm.look_again:.0f}",
            )
            for channel in channels
            if channel.covers(reopened)
        ]
    return batch


def _notice(channel: Channel, alarm: Alarm, event: str, now: float, record_now: float) -> Notice:
    wait_s = channel.hold_off_s if event == BEGAN else 0.0
    if event == BEGAN and record_now - alarm.began > PAST_S:
        wait_s = max(wait_s, CATCH_UP_S)
    # the id repeats the severity, so that a rise is a new notice, and the time of each acknowledgement
    id_endings = {BEGAN: alarm.severity, ACKNOWLEDGED: f"{ACKNOWLEDGED} {alarm.acknowledged or now:.0f}"}
    return Notice(
        id=id_prefix(channel.name, alarm.id) + id_endings.get(event, event),
        channel=channel.name,
        content=content_text(Content(event, alarm)),
        made=now,
        due=channel.due_s(alarm, now + wait_s),
    )


def id_prefix(channel: str, alarm: str) -> str:
    """The common beginning of the ids of a channel's notices about an alarm."""
    return f"{channel}:{alarm}:"


def content_text(content: Content) -> str:
    """The content of a notice as JSON."""
    return json.dumps(asdict(content), ensure_ascii=False)


def notice_content(notice: Notice) -> Content:
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
    """Decide about a notice that is due and was not attempted before.

    Returns the content to send now, the reason to send nothing, or the time [s] at which to decide again.

    alarm: the alarm in the store, None if it was deleted.  others: the channel's other notices about the
    alarm.
    shelved: whether the alarm is shelved.  record_now: time of the readings [s].
    """
    content = notice_content(notice)
    if alarm is None:
        return NoticeCode.ALARM_NOT_STORED()
    if content.event not in OPENING:
        openings = [other for other in others if notice_content(other).event in OPENING]
        if any(is_delivered(opening) for opening in openings):
            return content
        waiting = [opening.due for opening in openings if opening.sent is None]
        return max(min(waiting), now + 1.0) if waiting else NoticeCode.BEGINNING_NOT_SENT()
    if alarm.acknowledged is not None:
        return NoticeCode.ACKNOWLEDGED_BEFORE()
    if shelved:
        return NoticeCode.ENDED_WHILE_SHELVED() if alarm.ended is not None else now + SHELVED_S
    if alarm.ended is not None:
        ends = [other.made for other in others if notice_content(other).event == ENDED]
        if alarm.ended - alarm.began < channel.hold_off_s and ends and ends[0] < notice.due:
            return NoticeCode.ENDED_IN_HOLD_OFF()
        if record_now - alarm.ended > PAST_S:
            return NoticeCode.OVER_BEFORE_CAUGHT_UP()
    sent = (notice_content(other) for other in others if is_delivered(other))
    sent_severities = [opening.alarm.severity for opening in sent if opening.event in OPENING]
    if content.event == BEGAN and sent_severities:
        if max(map(SEVERITIES.index, sent_severities)) >= SEVERITIES.index(content.alarm.severity):
            return NoticeCode.SEVERER_SENT()
        return replace(content, event=WORSENED)
    return content


def is_delivered(notice: Notice) -> bool:
    """Whether a receiver has accepted a notice; a dropped notice has the reason as its failure."""
    return notice.sent is not None and not notice.failure


# -- the outbox ----------------------------------------------------------------------------------------------
def due(store: Store, channel: str, now: float, most: int) -> list[Notice]:
    """A channel's unsent notices that are due at `now` [s], the earliest first."""
    return store.records(Notice, statements.DUE, channel=channel, now=now, most=most)


@dataclass(frozen=True)
class ChannelState:
    """A channel's outbox: number of `waiting` notices; time at which the oldest of them was `made` [s];
    `failure` of their attempts, "" without a failure; time at which a notice was last `sent` [s]."""

    waiting: int = 0
    made: float | None = None
    failure: str = ""
    sent: float | None = None


def channel_states(store: Store) -> dict[str, ChannelState]:
    """Channel → state of its outbox."""
    return {
        channel: ChannelState(int(count), *rest)
        for channel, count, *rest in store.rows(statements.CHANNEL_STATES)
    }


def with_prefix(store: Store, channel: str, prefix: str) -> list[Notice]:
    """A channel's notices whose ids begin with `prefix`."""
    return store.records(Notice, statements.NOTICES_ABOUT, channel=channel, length=len(prefix), prefix=prefix)


def keep_contents(store: Store, contents: Iterable[tuple[str, str]]) -> None:
    """Write the contents (id, JSON) of notices that are about to be sent, so that a repeated
    message has the same content."""
    _change(store, statements.KEEP_CONTENT, [{"notice": name, "text": text} for name, text in contents])


def postpone(store: Store, notices: Iterable[tuple[str, float]]) -> None:
    """Set the times [s] at which notices (id) are decided again."""
    _change(store, statements.POSTPONE, [{"notice": name, "at": at} for name, at in notices])


def drop(store: Store, notices: Iterable[tuple[str, Statement]], at: float) -> None:
    """Mark notices (id) as never to be sent, each with the reason."""
    _change(
        store,
        statements.DROP_NOTICE,
        [{"notice": name, "reason": reason.text, "at": at} for name, reason in notices],
    )


def mark_sent(store: Store, notices: Iterable[str], at: float) -> None:
    """Mark notices (by id) as sent at a time [s]."""
    _change(store, statements.MARK_SENT, [{"notice": name, "at": at} for name in notices])


def mark_failed(store: Store, notices: Iterable[str], failure: str, due: float) -> None:
    """Store why notices (by id) could not be sent, and the time [s] at which they are due again."""
    _change(
        store, statements.MARK_FAILED, [{"notice": name, "reason": failure, "at": due} for name in notices]
    )


def forget(store: Store, before: float) -> None:
    """Delete notices that were sent or dropped before a time [s], and unsent notices that were made
    before."""
    store.execute(statements.FORGET_NOTICES, before=before)


def alarm_of(store: Store, alarm: str) -> Alarm | None:
    """The alarm with this id; None if the store has no such alarm."""
    return next(iter(store.records(Alarm, select_rows(schema.alarm, same="id"), id=alarm)), None)


def _change(store: Store, statement: ClauseElement, changes: Sequence[Mapping[str, object]]) -> None:
    """Execute a statement with the values of each change, all in one transaction."""
    if changes:
        with store.transaction():
            for values in changes:
                store.execute(statement, **values)
