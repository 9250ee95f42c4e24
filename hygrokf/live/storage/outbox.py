"""The store's outbox as its sender uses it: what is due, what was decided about it, what became of it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from hygrokf.live.batch import Alarm, Notice
from hygrokf.live.storage.database import Row
from hygrokf.live.storage.store import Store


def due(store: Store, channel: str, now: float, most: int) -> list[Notice]:
    """A channel's notices that are not sent and due at `now` [s], the earliest first."""
    rest = "WHERE sent IS NULL AND due <= ? AND channel = ? ORDER BY due, id LIMIT ?"
    return store.found(Notice, rest, (now, channel, most))


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
    rows = store.rows(
        "SELECT channel, SUM(CASE WHEN sent IS NULL THEN 1 ELSE 0 END), "
        "MIN(CASE WHEN sent IS NULL THEN made END), "
        "MAX(CASE WHEN sent IS NULL THEN failure ELSE '' END), "
        "MAX(CASE WHEN failure = '' THEN sent END) FROM outbox GROUP BY channel"
    )
    return {channel: ChannelState(int(count), *rest) for channel, count, *rest in rows}


def beginning_with(store: Store, channel: str, prefix: str) -> list[Notice]:
    """A channel's notices whose ids begin with a text."""
    rest = "WHERE channel = ? AND substr(id, 1, ?) = ? ORDER BY made, id"
    return store.found(Notice, rest, (channel, len(prefix), prefix))


def keep_contents(store: Store, contents: Iterable[tuple[str, str]]) -> None:
    """Write the contents (id, JSON) of notices that are about to be sent, so that a repeat is the same."""
    _change(store, "UPDATE outbox SET content = ? WHERE id = ?", [(text, name) for name, text in contents])


def postpone(store: Store, notices: Iterable[tuple[str, float]]) -> None:
    """Decide about notices (id) again at a time [s]."""
    _change(store, "UPDATE outbox SET due = ? WHERE id = ?", [(at, name) for name, at in notices])


def drop(store: Store, notices: Iterable[tuple[str, str]], at: float) -> None:
    """Send notices (id) never, for a reason."""
    _change(
        store,
        "UPDATE outbox SET sent = ?, failure = ? WHERE id = ? AND sent IS NULL",
        [(at, reason, name) for name, reason in notices],
    )


def mark_sent(store: Store, notices: Iterable[str], at: float) -> None:
    """State that notices (by id) were sent at a time [s]."""
    statement = "UPDATE outbox SET sent = ?, attempts = attempts + 1, failure = '' WHERE id = ?"
    _change(store, statement, [(at, one) for one in notices])


def mark_failed(store: Store, notices: Iterable[str], failure: str, due: float) -> None:
    """State why notices (by id) could not be sent, and when they are due again [s]."""
    statement = "UPDATE outbox SET attempts = attempts + 1, failure = ?, due = ? WHERE id = ?"
    _change(store, statement, [(failure, due, one) for one in notices])


def forget(store: Store, before: float) -> None:
    """Delete notices that were sent, dropped or, of a channel that exists no longer, made before a time
    [s]."""
    _change(store, "DELETE FROM outbox WHERE made < ? AND (sent IS NULL OR sent < ?)", [(before, before)])


def alarm_of(store: Store, alarm: str) -> Alarm | None:
    """An alarm by its id; None if there is none."""
    return next(iter(store.found(Alarm, "WHERE id = ?", (alarm,))), None)


def _change(store: Store, statement: str, rows: Sequence[Row]) -> None:
    if rows:
        with store.transaction() as cursor:
            cursor.executemany(store.database.text(statement), rows)
