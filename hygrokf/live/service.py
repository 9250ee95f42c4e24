"""The tracker's loop: deliveries in, rounds of the fleet, batches into the store, acknowledgements back.

Nothing is acknowledged before it is committed.  Where the store fails the loop keeps what it holds, opens the store anew
until that works, and begins again from what the store has: what was not committed has not happened.
"""

from __future__ import annotations

import logging
import math
import queue
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from collections.abc import Mapping as MappingOf
from dataclasses import dataclass, field
from functools import partial

from hygrokf.live.fault_isolation import Finding
from hygrokf.live.forecast_job import EVERY_S, ahead_batch, inquiry_into, look_ahead
from hygrokf.live.sources.streams import Stream, taken_from
from hygrokf.live.storage.retention import Retention
from hygrokf.live.storage.store import Batch, Store, StoreFault, open_store
from hygrokf.live.turbines import SOURCE, Delivery, Fleet, Turbine

LOG = logging.getLogger("hygrokf.track")
WAITING = 20_000
"""Deliveries that wait at most; a source that is faster is slowed down."""
MOST = 2_000
"""Deliveries of one round."""
PATIENCE_S = 0.1
"""[s] for which a round waits for its first delivery."""
FILTER_S = 0.2
"""[s] of a round that go into the filter: turbines that find no room wait, while deliveries are still taken and acknowledged."""
TICK_S = 10.0
"""[s] between two looks at what did not come."""
SHARE = 0.3
"""Largest share of the time that goes into forecasts while deliveries come."""
LEAST_SHARE = 0.05
"""The same while deliveries, or turbines with readings that are not filtered, wait."""
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
    `retention_s` [s] of history are kept, as far back as each turbine's filter has come.
    """

    def __init__(
        self,
        turbines: MappingOf[str, Turbine],
        streams: Sequence[Stream],
        store_url: str,
        settle: Callable[[Batch], None] = lambda batch: None,
        retention_s: float = math.inf,
    ) -> None:
        self.turbines = turbines
        self.streams = {one.url: one for one in streams}
        self.store_url = store_url
        self.health = Health()
        self.ending = threading.Event()
        self.retention = Retention(retention_s)
        self._settle = settle
        self._tick = self._forecasts = self._latest = 0.0
        self._words: dict[str, str] = {}
        self._inquiry: tuple[str, Iterator[Finding | None]] | None = None
        self._waiting: queue.Queue[tuple[str, Delivery, float]] = queue.Queue(WAITING)
        self.store: Store | None = None
        self.fleet: Fleet | None = None

    @property
    def _store(self) -> Store:
        """The store, while the service runs."""
        assert self.store is not None, "the service does not run yet"
        return self.store

    @property
    def _fleet(self) -> Fleet:
        """The fleet, while the service runs."""
        assert self.fleet is not None, "the service does not run yet"
        return self.fleet

    def stop(self) -> None:
        """Drain and end: what was delivered is filtered and committed first."""
        self.ending.set()

    def run(self, until_ended: bool = False, begun: Callable[[], None] = lambda: None) -> None:
        """Run until `stop`, or with `until_ended` until every source has ended and all of it is committed.

        `begun` is called once the store is open.  Raises StoreFault where the store cannot be opened at the start, or has not
        come back when all is to end: what was
        not committed then is delivered again.
        """
        self._open()
        try:
            begun()
            for url, stream in self.streams.items():
                stream.start(self._store.place(url), partial(self._put, url))
                stream.tell(self._fleet.open_alarms())  # what was told before a crash may not have arrived
            while not self.ending.is_set():
                idle = not self.round()
                self._aside(idle)
                if idle and until_ended and self._ended() and not self._busy():
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

    def _open(self) -> None:
        """The store, and the fleet as the store has it, for this tracker alone."""
        store = open_store(self.store_url)
        try:
            store.claim("turbine", self.turbines)
            store.claim("source", [url for url in self.streams if store.place(url) is not None])
            self.fleet = Fleet.opened(self.turbines, store)
        except BaseException:
            store.close()
            raise
        self.store = store

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

    def _busy(self) -> bool:
        """Whether something is still to be found out or foretold from what has come."""
        return bool(self._inquiry or self._fleet.asked() or self._fleet.due(EVERY_S))

    def round(self) -> bool:
        """One round of deliveries, or of turbines that wait for their filter; whether there was either."""
        found = taken_from(self._waiting, MOST, 0.0 if self._fleet.waiting else PATIENCE_S)
        self.retention.bite(self._store, self._fleet)
        if not found and self._fleet.waiting:
            self._told(self._kept(lambda: self._fleet.filtered(Batch(), FILTER_S)))
            return True
        by_source: dict[str, list[Delivery]] = {}
        for url, one, _ in found:
            by_source.setdefault(url, []).append(one)
        for url, deliveries in by_source.items():
            self._committed(url, deliveries)
        if found:
            now = time.monotonic()
            self.health.note([now - came for _, _, came in found])
            self.health.rounds += 1
            self.health.deliveries += len(found)
        return bool(found)

    def _committed(self, url: str, deliveries: Sequence[Delivery]) -> None:
        """Take deliveries in, commit what that gives, and acknowledge them."""
        stream = self.streams[url]
        batch = self._kept(lambda: self._fleet.round(deliveries, stream.mapping, url, FILTER_S), url)
        stream.acknowledge(deliveries)
        self._told(batch)

    def _looked_ahead(self, name: str) -> Batch:
        """The forecast of a turbine; the next one is due an hour later, also where there is none."""
        one, tracker = self.turbines[name], self._fleet.trackers[name]
        found = look_ahead(name, one, tracker, self._store)
        if found is None:
            return Batch()
        self._fleet.looked[name] = found.time_s
        return ahead_batch(name, found, one.limit)

    def _kept(self, make: Callable[[], Batch], source: str = "") -> Batch:
        """Make a batch and commit it, however often the store has to be opened anew; the fleet is then another one."""
        attempt, mark = 0, secrets.token_hex(8)
        while True:
            try:
                # a commit whose answer was lost has been made where its mark is there
                if not attempt or not source or self._store.memory(SOURCE, f"batch of {source}") != mark:
                    batch = make()
                    if source:
                        batch.memories[SOURCE, f"batch of {source}"] = mark
                        self._store.claim("source", batch.place)
                    if not batch.empty:
                        self._store.commit(batch)
                break
            except StoreFault as fault:
                self.health.store = str(fault).strip()
                self.health.failures += 1  # after the words: who sees the failure finds them
                LOG.warning("the store failed", extra={"fault": self.health.store, "attempt": attempt + 1})
                if attempt and self.ending.is_set():
                    raise
                attempt = self._reopened(attempt)
        self.health.store = ""
        self.health.committed_s = time.time()
        return batch

    def _told(self, batch: Batch) -> None:
        """Tell what was committed to the page, and alarms to the sources that have a place for them."""
        if batch.empty:
            return
        if batch.alarms:
            for stream in self.streams.values():
                stream.tell(batch.alarms)
        self._settle(batch)

    @property
    def now(self) -> float:
        """The time [s] that data are judged by: a record that is played back has its own."""
        clocks = [stream.now() for stream in self.streams.values() if not stream.mapping.weather]
        return min(clocks, default=time.time())

    def _aside(self, idle: bool) -> None:
        """What is done between rounds: what did not come, and forecasts, for a share of the time at most."""
        begin = time.monotonic()
        if begin >= self._tick:
            self._tick = begin + TICK_S
            states = {url: stream.state for url, stream in self.streams.items()}
            self._noted(states)
            self._told(self._kept(lambda: self._fleet.tick(self.now, states)))
        behind = self._fleet.waiting or not self._waiting.empty()
        if idle or begin >= (self._latest if behind else self._forecasts):
            name = self._fleet.due(EVERY_S)
            if name is not None:
                self._told(self._kept(lambda: self._looked_ahead(name)))
            self._inquired()
            end = time.monotonic()
            self._forecasts, self._latest = (
                end + (end - begin) * (1.0 / share - 1.0) for share in (SHARE, LEAST_SHARE)
            )

    def _noted(self, states: MappingOf[str, tuple[str, str]]) -> None:
        """Log sources that are in another state than before."""
        for url, (word, behind) in states.items():
            if self._words.get(url) != word:
                self._words[url] = word
                LOG.info("source", extra={"source": url, "state": word, "behind": behind})

    def _inquired(self) -> None:
        """One step of the inquiry that is under way, or the first one of another."""
        if self._inquiry is None:
            name = self._fleet.asked()
            if name is None:
                return
            lasting = [one for one in self._fleet.departures[name].values() if one.lasting]
            self._inquiry = (name, inquiry_into(name, self.turbines[name], lasting, self._store))
        name, steps = self._inquiry
        try:
            found = next(steps)
        except StoreFault:  # the next commit notices it too, and opens the store anew
            self._inquiry = None
            return
        if found is not None:
            self._inquiry = None
            self._told(self._kept(lambda: self._fleet.answered(name, found)))

    def _reopened(self, attempt: int) -> int:
        """Open the store anew, as often as it takes, once more when all is to end; the next attempt's number."""
        while True:
            self._store.close()
            self.ending.wait(RETRY_S[min(attempt, len(RETRY_S) - 1)])
            attempt += 1
            try:
                self._open()
                return attempt
            except StoreFault as fault:
                self.health.store = str(fault).strip()
                LOG.warning(
                    "the store is not reached", extra={"fault": self.health.store, "attempt": attempt}
                )
                if self.ending.is_set():
                    raise
