"""Acknowledging an alarm with its cause, and its return if it was to be looked at again."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

from hygrokf.live.batch import Batch
from hygrokf.live.notification.channel import Channel
from hygrokf.live.notification.notices import acknowledgement, due_again
from hygrokf.live.storage.outbox import acknowledged_until, alarm_of, without_acknowledgement
from hygrokf.live.storage.store import Store

LOOK_AGAIN = "look again"
"""The cause of an acknowledgement that holds for some days only."""


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
    notices = acknowledgement(known, channels, time.time())
    done = store.acknowledge(alarm, by, now, cause, note, look_again_s, notices)
    return found.turbine if done else None


def look_again(store: Store, now: float, channels: Sequence[Channel]) -> Batch:
    """Open alarms that are due at `now` [s] to be looked at again: unacknowledged, with their notices."""
    batch = Batch()
    for alarm in acknowledged_until(store, now):
        assert alarm.look_again is not None, "that is how they are found"
        back = without_acknowledgement(alarm)
        batch.reopened.append(back)
        batch.notices += due_again(back, alarm.look_again, channels, time.time())
    return batch
