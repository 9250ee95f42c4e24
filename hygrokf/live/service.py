"""The tracker's loop: deliveries in, rounds of the fleet, batches into the store, acknowledgements back.

Nothing is acknowledged before it is committed.  Where the store fails the loop keeps what it holds, opens the store anew
until that works, and begins again from what the store has: what was not committed has not happened.
"""

from __future__ import annotations

import logging
import queue
import sqlite3
import threading
import time
from collections.abc import Callable, Sequence
from collections.abc import Mapping as MappingOf
from dataclasses import dataclass, field

from hygrokf.live.fleet import Delivery, Fleet, Turbine
from hygrokf.live.payload import Mapping
from hygrokf.live.store import Store, StoreFault, open_store
from hygrokf.live.streams import Stream, taken_from

LOG = logging.getLogger("hygrokf.track")
WAITING = 20_000
"""Deliveries that wait at most; a source that is faster is slowed down."""
MOST = 2_000
"""Deliveries of one round."""
PATIENCE_S = 0.1
"""[s] for which a round waits for its first delivery."""
RETRY_S = (0.5, 1.0, 2.0, 5.0, 10.0)
"""[s] between attempts to reach a store that failed; the last one repeats."""


@dataclass
class Health:
    """What the loop does: rounds, deliveries, the last commit and how long deliveries waited for theirs [s]."""

    rounds: int = 0
    deliveries: int = 0
    failures: int = 0
    committed_s: float = 0.0
    waits_s: list[float] = field(default_factory=list)
    store: str = ""

    def note(self, waits: Sequence[float]) -> None:
        self.waits_s = [*self.waits_s, *waits][-10_000:]


class Service:
    """Streams, a fleet and a store, run by one thread.

    `settle` turns a finished batch into what is published beside the store (alarms, pages); it is called after a commit.
    """

    def __init__(
        self,
        turbines: MappingOf[str, Turbine],
        mapping: Mapping,
        streams: Sequence[Stream],
        store_url: str,
        settle: Callable[[object], None] = lambda batch: None,
    ) -> None:
        self.turbines = turbines
        self.mapping = mapping
        self.streams = {one.url: one for one in streams}
        self.store_url = store_url
        self.health = Health()
        self.ending = threading.Event()
        self._settle = settle
        self._waiting: queue.Queue = queue.Queue(WAITING)
        self.store: Store | None = None
        self.fleet: Fleet | None = None

    def stop(self) -> None:
        """Drain and end: what was delivered is filtered and committed first."""
        self.ending.set()

    def run(self, until_ended: bool = False) -> None:
        """Run until `stop`, or with `until_ended` until every source has ended and all of it is committed.

        Raises StoreFault where the store cannot be opened at the start.
        """
        self._open(open_store(self.store_url))
        for url, stream in self.streams.items():
            stream.start(self.store.place(url), lambda one, url=url: self._put(url, one))
        try:
            while not self.ending.is_set():
                if self.round() == 0 and until_ended and self._ended():
                    break
            for stream in self.streams.values():
                stream.stop()
            while self.round():
                pass
        finally:
            for stream in self.streams.values():
                stream.stop()
            if self.store is not None:
                self.store.close()
            LOG.info("ended", extra={"deliveries": self.health.deliveries, "rounds": self.health.rounds})

    def _open(self, store: Store) -> None:
        self.store = store
        self.fleet = Fleet.opened(self.turbines, self.mapping, store)

    def _put(self, url: str, one: Delivery) -> None:
        """Called by the streams' threads; waits where too much waits, unless all is about to end."""
        while not self.ending.is_set():
            try:
                self._waiting.put((url, one, time.monotonic()), timeout=0.5)
                return
            except queue.Full:
                continue

    def _ended(self) -> bool:
        return self._waiting.empty() and all(
            s.state[0] in ("ended", "lost", "stopped") for s in self.streams.values()
        )

    def round(self) -> int:
        """One round: how many deliveries it took."""
        found = taken_from(self._waiting, MOST, PATIENCE_S)
        if not found:
            return 0
        by_source: dict[str, list[Delivery]] = {}
        for url, one, _ in found:
            by_source.setdefault(url, []).append(one)
        for url, deliveries in by_source.items():
            self._committed(url, deliveries)
        now = time.monotonic()
        self.health.note([now - came for _, _, came in found])
        self.health.rounds += 1
        self.health.deliveries += len(found)
        return len(found)

    def _committed(self, url: str, deliveries: Sequence[Delivery]) -> None:
        """Filter deliveries and commit what that gives, however often the store has to be opened anew."""
        attempt = 0
        while True:
            try:
                batch = self.fleet.round(deliveries, url)
                self.store.commit(batch)
                break
            except (sqlite3.Error, OSError, StoreFault) as fault:
                self.health.failures += 1
                self.health.store = str(fault).strip()
                LOG.warning("the store failed", extra={"fault": self.health.store, "attempt": attempt + 1})
                attempt = self._reopened(attempt)
        self.health.store = ""
        self.health.committed_s = time.time()
        self.streams[url].acknowledge(deliveries)
        self._settle(batch)

    def _reopened(self, attempt: int) -> int:
        """Open the store anew, as often as it takes; the next attempt's number."""
        while True:
            time.sleep(RETRY_S[min(attempt, len(RETRY_S) - 1)])
            attempt += 1
            self.store.close()
            try:
                self._open(open_store(self.store_url))
                return attempt
            except (sqlite3.Error, OSError, StoreFault) as fault:
                self.health.store = str(fault).strip()
                LOG.warning(
                    "the store is not reached", extra={"fault": self.health.store, "attempt": attempt}
                )
