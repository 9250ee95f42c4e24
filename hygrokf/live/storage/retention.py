"""What is older than the retention goes, a little at a time, and never what a restart needs."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from typing import Any

from hygrokf.live.plan import BEFORE
from hygrokf.live.storage.store import Store, StoreFault
from hygrokf.live.turbines import Fleet

LOG = logging.getLogger("hygrokf.track")
EVERY_S = 6.0 * 3600.0
"""[s] between two turns through the fleet."""
BITE = 1_000
"""Rows that are deleted at once, so that the loop is held up for a moment only."""


class Retention:
    """Keeps the store's history to `seconds` before each turbine's newest final estimate, on that turbine's own clock: a
    record that is played back is kept like a live one, and a turbine that is silent loses nothing.

    Turbines that the fleet does not have are left alone: they are another tracker's, or nobody's any more.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._due: list[str] = []
        self._next = -math.inf

    def bite(self, store: Store, fleet: Fleet) -> int:
        """Delete a little, where a turn is due; how many rows.  A store that fails is left to the next commit to notice."""
        if not self._due and time.monotonic() >= self._next and math.isfinite(self.seconds):
            self._due, self._next = list(fleet.turbines), time.monotonic() + EVERY_S
        while self._due:
            name = self._due[-1]
            point = fleet.trackers[name].point
            if point is None:  # all of its readings are still needed
                self._due.pop()
                continue
            needed = point.time - fleet.turbines[name].plan.context_s
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
    """Delete what a turbine has from before a time [s], `most` rows at most; how many there were, fewer where all is done.

    A restart needs readings from `needed` [s] on, and each signal's last `BEFORE` readings before that: they are
    kept.  Open alarms are kept, too.
    """
    limit, count = min(before, needed), 0
    with store.transaction() as cursor:
        for signal in signals_of(store, turbine):
            edges = store.rows(
                "SELECT time FROM observation WHERE turbine = ? AND signal = ? AND time < ? AND late = 0 "
                "ORDER BY time DESC LIMIT ?",
                (turbine, signal, needed, BEFORE),
            )
            until = min(limit, edges[-1][0]) if edges else limit
            same = {"turbine": turbine, "signal": signal}
            count += _bite(store, cursor, "observation", same, "time", until, most - count)
        for table, column in (("estimate", "time"), ("property", "time"), ("alarm", "ended")):
            count += _bite(store, cursor, table, {"turbine": turbine}, column, limit, most - count)
    return count


def signals_of(store: Store, turbine: str) -> list[str]:
    """A turbine's signals, one step in the index each: DISTINCT would read all of it."""
    found: list[str] = []
    while True:
        last = found[-1] if found else ""
        following = store.rows(
            "SELECT MIN(signal) FROM observation WHERE turbine = ? AND signal > ?", (turbine, last)
        )[0][0]
        if following is None:
            return found
        found.append(following)


def _bite(
    store: Store, cursor: Any, table: str, same: Mapping[str, str], column: str, until: float, most: int
) -> int:
    """Delete the oldest rows of a table from before a time [s], `most` at most; how many."""
    where = " AND ".join([*(f"{name} = ?" for name in same), f"{column} < ?"])
    values = (*same.values(), until)
    next_one = store.rows(
        f"SELECT {column} FROM {table} WHERE {where} ORDER BY {column} LIMIT 1 OFFSET ?",
        (*values, max(most, 0)),
    )
    if next_one:
        values = (*same.values(), next_one[0][0])
    cursor.execute(store.database.text(f"DELETE FROM {table} WHERE {where}"), values)
    return max(cursor.rowcount, 0)
