"""The store's outbox as its sender uses it: what is due, what was decided about it, what became of it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from sqlalchemy import case, delete, func, or_, select, update
from sqlalchemy.sql.dml import Update

from hygrokf.live.batch import Alarm, Notice
from hygrokf.live.storage.schema import alarm, outbox
from hygrokf.live.storage.store import Store

_WAITS = outbox.c.sent.is_(None)


def due(store: Store, channel: str, now: float, most: int) -> list[Notice]:
    """A channel's notices that are not sent and due at `now` [s], the earliest first."""
    found = select(outbox).where(_WAITS, outbox.c.due <= now, outbox.c.channel == channel)
    return store.found(Notice, found.order_by(outbox.c.due, outbox.c.id).limit(most))


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
    states = select(
        outbox.c.channel,
        func.sum(case((_WAITS, 1), else_=0)),
        func.min(case((_WAITS, outbox.c.made))),
        func.max(case((_WAITS, outbox.c.failure), else_="")),
        func.max(case((outbox.c.failure == "", outbox.c.sent))),
    )
    rows = store.rows(states.group_by(outbox.c.channel))
    return {channel: ChannelState(int(count), *rest) for channel, count, *rest in rows}


def waiting(store: Store) -> dict[str, int]:
    """Number of notices that are not sent, by channel."""
    found = {channel: state.waiting for channel, state in channel_states(store).items()}
    return {channel: count for channel, count in found.items() if count}


def beginning_with(store: Store, channel: str, prefix: str) -> list[Notice]:
    """A channel's notices whose ids begin with a text."""
    begins = outbox.c.channel == channel, func.substr(outbox.c.id, 1, len(prefix)) == prefix
    return store.found(Notice, select(outbox).where(*begins).order_by(outbox.c.made, outbox.c.id))


def _notice(name: str, waits: bool = False) -> Update:
    own = outbox.c.id == name
    return update(outbox).where(own & _WAITS if waits else own)


def keep_contents(store: Store, contents: Iterable[tuple[str, str]]) -> None:
    """Write the contents (id, JSON) of notices that are about to be sent, so that a repeat is the same."""
    _change(store, [_notice(name).values(content=text) for name, text in contents])


def postpone(store: Store, notices: Iterable[tuple[str, float]]) -> None:
    """Decide about notices (id) again at a time [s]."""
    _change(store, [_notice(name).values(due=at) for name, at in notices])


def drop(store: Store, notices: Iterable[tuple[str, str]], at: float) -> None:
    """Send notices (id) never, for a reason."""
    _change(store, [_notice(name, waits=True).values(sent=at, failure=why) for name, why in notices])


def mark_sent(store: Store, notices: Iterable[str], at: float) -> None:
    """State that notices (by id) were sent at a time [s]."""
    changed = {"sent": at, "attempts": outbox.c.attempts + 1, "failure": ""}
    _change(store, [_notice(name).values(changed) for name in notices])


def mark_failed(store: Store, notices: Iterable[str], failure: str, due: float) -> None:
    """State why notices (by id) could not be sent, and when they are due again [s]."""
    changed = {"attempts": outbox.c.attempts + 1, "failure": failure, "due": due}
    _change(store, [_notice(name).values(changed) for name in notices])


def forget(store: Store, before: float) -> None:
    """Delete notices that were sent, dropped or, of a channel that exists no longer, made before a time
    [s]."""
    store.execute(delete(outbox).where(outbox.c.made < before, or_(_WAITS, outbox.c.sent < before)))


def alarm_of(store: Store, name: str) -> Alarm | None:
    """An alarm by its id; None if there is none."""
    return next(iter(store.found(Alarm, select(alarm).where(alarm.c.id == name))), None)


def due_again(store: Store, now: float) -> list[Alarm]:
    """Open alarms whose acknowledgement says that they are to be looked at again by `now` [s]."""
    a = alarm.c
    known = a.ended.is_(None), a.acknowledged.is_not(None), a.look_again <= now
    return store.found(Alarm, select(alarm).where(*known).order_by(a.look_again, a.id))


def _change(store: Store, changes: Sequence[Update]) -> None:
    if changes:
        with store.transaction():
            for one in changes:
                store.execute(one)
