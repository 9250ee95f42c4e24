"""Deletes history older than the retention period, in small portions, but never what a restart needs."""

from __future__ import annotations

import logging
import math
import time
from typing import Any

from sqlalchemy import Column, ColumnElement, delete, select

from hygrokf.data.timestamps import HOUR_S
from hygrokf.live.plan import BEFORE
from hygrokf.live.storage.schema import (
    alarm,
    connection,
    estimate,
    matching,
    observation,
    property_,
    revision,
)
from hygrokf.live.storage.store import Store, StoreFault
from hygrokf.live.turbines import Fleet

LOG = logging.getLogger("hygrokf.track")
EVERY_S = 6.0 * HOUR_S
"""[s] between two passes over the fleet."""
BITE = 1_000
"""Rows deleted at once, so that the loop is only held up briefly."""


class Retention:
    """Keeps history back to `seconds` [s] before each turbine's newest final estimate.

    The limit follows the time of the readings: a played-back record is kept like a live one, and a silent
    turbine loses nothing.  Turbines outside the fleet are left alone, because they belong to another tracker
    or to none any more.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._due: list[str] = []
        self._next = -math.inf

    def bite(self, store: Store, fleet: Fleet) -> int:
        """Delete one portion if a pass is due; returns the number of rows.  The next commit notices a failing
        store."""
        if not self._due and time.monotonic() >= self._next and math.isfinite(self.seconds):
            self._due, self._next = list(fleet.tracked), time.monotonic() + EVERY_S
        while self._due:
            name = self._due[-1]
            state = fleet.tracked[name]
            point = state.tracker.point
            if point is None:  # nothing is final yet, so a restart needs all readings
                self._due.pop()
                continue
            needed = point.time - state.turbine.plan.context_s
            try:
                count = prune(store, name, point.time - self.seconds, needed)
            except StoreFault as fault:
                LOG.warning("old rows were not deleted", extra={"fault": str(fault)})
                self._due.clear()
                return 0
            if count < BITE:
                self._due.pop()
            return count
        return 0


def prune(store: Store, turbine: str, before: float, needed: float, most: int = BITE) -> int:
    """Delete at most `most` rows of a turbine older than `before` [s]; returns the number deleted, less than
    `most` when done.

    Readings from `needed` [s] on and each signal's last `BEFORE` readings before that are kept, because a
    restart needs them.  Open alarms are kept, too.
    """
    limit, count = min(before, needed), 0
    time = observation.c.time
    with store.transaction():
        for signal in store.signals(turbine):
            own = matching(observation, turbine=turbine, signal=signal)
            last = select(time).where(own, time < needed, observation.c.late == 0)
            edges = store.rows(last.order_by(time.desc()).limit(BEFORE))
            until = min(limit, edges[-1][0]) if edges else limit
            count += _bite(store, own, time, until, most - count)
        for column in (
            revision.c.time, estimate.c.time, property_.c.time, alarm.c.ended, connection.c.regained
        ):  # fmt: skip
            own = column.table.c.turbine == turbine
            count += _bite(store, own, column, limit, most - count)
    return count


def _bite(store: Store, own: ColumnElement[bool], time: Column[Any], until: float, most: int) -> int:
    """Delete at most `most` of some rows before a time [s], the oldest; returns the number deleted."""
    next_one = store.rows(select(time).where(own, time < until).order_by(time).limit(1).offset(max(most, 0)))
    return store.execute(delete(time.table).where(own, time < (next_one[0][0] if next_one else until)))
