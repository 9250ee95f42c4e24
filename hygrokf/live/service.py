"""The tracker's loop: it takes deliveries, runs rounds of the fleet, commits batches and acknowledges
deliveries.

Nothing is acknowledged before it is committed.  If the store fails, the loop keeps its deliveries, reopens
the store until that succeeds, and starts again from the stored state, without whatever was not
committed.
"""

from __future__ import annotations

import logging
import math
import queue
import secrets
import threading
import time
from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

from hygrokf.data.timestamps import HOUR_S
from hygrokf.live.batch import Batch
from hygrokf.live.fault_isolation import CauseFinding
from hygrokf.live.forecast_job import FORECAST_EVERY_S, isolation_steps, make_forecast
from hygrokf.live.notification.channel import Channel
from hygrokf.live.notification.notices import look_again, notices_of
from hygrokf.live.sources.stream import Delivery, Reach, Stream, pause_s
from hygrokf.live.storage.database import REPLACED, StoreReplaced
from hygrokf.live.storage.store import MOST_DELETED, Store, StoreFault, open_store, prune
from hygrokf.live.turbine import Turbine
from hygrokf.live.turbines import SOURCE, Fleet
from hygrokf.texts.statement import Statement

LOG = logging.getLogger("hygrokf.track")
T = TypeVar("T")
WAITING = 20_000
"""Largest number of waiting deliveries; a faster source is blocked."""
MOST_PER_ROUND = 2_000
"""Largest number of deliveries per round."""
FIRST_DELIVERY_S = 0.1
"""[s] a round waits for its first delivery."""
FILTER_S = 0.2
"""[s] per round for filtering; the other turbines wait, while deliveries are still taken and acknowledged."""
TICK_S = 10.0
"""[s] between two checks for stale data and lost sources."""
FORECAST_SHARE = 0.3
"""Largest share of time [1] for forecasts and fault isolation while deliveries come."""
BUSY_SHARE = 0.05
"""Largest share of time [1] for them while deliveries or unfiltered turbines wait."""
PRUNED_S = 6.0 * HOUR_S
"""[s] between two passes over the fleet that delete old history."""
REOPEN_S = (0.5, 10.0)
"""Shortest and longest pause [s] between attempts to reopen a failed store."""


WAIT_CLASSES_S = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
"""Upper bounds [s] of the classes in which waits are counted; a further class has no upper bound."""


@dataclass(frozen=True)
class SourceTimes:
    """Times of a source's last delivery: of its commit [s, this machine's clock], and the lag [s] of its
    arrival behind the stamp of its newest reading, None without readings so far."""

    committed: float
    lag_s: float | None = None


@dataclass
class Health:
    """Counts of the loop.

    `failures` of the store; `committed_s`: time of the last commit [s]; `looped`: monotonic time of the last
    cycle of the loop, ∞ before and after the loop; `waits_s`: times [s] from the last deliveries to their
    commits; `wait_counts`: numbers of all these times since the start by the classes `WAIT_CLASSES_S`, and
    `wait_sum_s` [s] their sum; `sources`: times of each source by its URL; `store`: why the store fails now,
    empty if it works.
    """

    rounds: int = 0
    deliveries: int = 0
    failures: int = 0
    committed_s: float = 0.0
    looped: float = math.inf
    waits_s: list[float] = field(default_factory=list)
    wait_counts: list[int] = field(default_factory=lambda: [0] * (len(WAIT_CLASSES_S) + 1))
    wait_sum_s: float = 0.0
    sources: dict[str, SourceTimes] = field(default_factory=dict)
    store: str = ""

    def note_waits(self, waits_s: Sequence[float]) -> None:
        """Count the times [s] from some deliveries to their commits."""
        self.waits_s = [*self.waits_s, *waits_s][-10_000:]
        for wait_s in waits_s:
            self.wait_counts[bisect_left(WAIT_CLASSES_S, wait_s)] += 1
        self.wait_sum_s += sum(waits_s)

    def note_source(self, url: str, batch: Batch) -> None:
        """Note that deliveries of a source were committed, and the lag of their newest reading."""
        before = self.sources.get(url, SourceTimes(0.0))
        newest = max(
            (*batch.observations, *batch.weather), key=lambda observed: observed.reading.time, default=None
        )
        lag_s = before.lag_s if newest is None else newest.received - newest.reading.time
        self.sources[url] = SourceTimes(time.time(), lag_s)

    def wait_s(self, share: float) -> float | None:
        """Return the wait [s] that a share [1] of the deliveries did not exceed; None without deliveries."""
        waits = sorted(self.waits_s)
        return waits[int(share * (len(waits) - 1))] if waits else None


class Service:
    """Streams, a fleet and a store, run by one thread.

    on_commit: called with each batch after its commit, to publish it on the page.  retention_s: history [s]
    that the store keeps before each turbine's newest final estimate.  channels: for whose receivers alarms
    are written together with notices.  clock: gives this machine's time [s].
    """

    def __init__(
        self,
        turbines: Mapping[str, Turbine],
        streams: Sequence[Stream],
        store_url: str,
        on_commit: Callable[[Batch], None] = lambda batch: None,
        retention_s: float = math.inf,
        channels: Sequence[Channel] = (),
        clock: Callable[[], float] = time.time,
    ) -> None:
        self.turbines = turbines
        self.streams = {stream.url: stream for stream in streams}
        self.store_url = store_url
        self.health = Health()
        self.ending = threading.Event()
        self.retention = Retention(retention_s)
        self.channels = tuple(channels)
        self._on_commit = on_commit
        self._clock = clock
        self._next_tick = self._next_work = self._next_work_behind = 0.0
        self._logged_states: dict[str, str] = {}
        """Source → state (`SourceState.word`) that was logged last."""
        self._batch_marks: dict[str, str] = {}
        """Source → mark of its last committed batch."""
        self._isolation: tuple[str, Iterator[CauseFinding | None]] | None = None
        """Turbine and steps of the fault isolation in progress."""
        self._waiting: queue.Queue[tuple[str, Delivery, float]] = queue.Queue(WAITING)
        """(source, delivery, monotonic time of its arrival [s])"""
        self.store: Store | None = None
        self.fleet: Fleet | None = None

    @property
    def _open_store(self) -> Store:
        """The open store; a different object after a failure."""
        assert self.store is not None
        return self.store

    @property
    def _open_fleet(self) -> Fleet:
        """The fleet of the open store; a different object after a failure."""
        assert self.fleet is not None
        return self.fleet

    def stop(self) -> None:
        """End, after the deliveries that have arrived are filtered and committed."""
        self.ending.set()

    def run(self, until_ended: bool = False, begun: Callable[[], None] = lambda: None) -> None:
        """Run until `stop`, or with `until_ended` until every source has ended and everything is committed.

        `begun` is called once the store is open.  Raises StoreFault if the store cannot be opened at the
        start or is still unavailable at the end; the sources then deliver again what was not committed.
        """
        self._open()
        try:
            begun()
            for url, stream in self.streams.items():
                stream.recall(self._open_store.memories(url))
                stream.start(self._open_store.place(url), partial(self._put, url))
                stream.publish_alarms(
                    self._open_fleet.open_alarms()
                )  # alarms told before a crash may not have arrived
            while not self.ending.is_set():
                self.health.looped = time.monotonic()
                idle = not self.round()
                self._work_between_rounds(idle)
                if idle and until_ended and self._sources_ended():
                    fleet = self._open_fleet
                    if not (self._isolation or fleet.isolation_due() or fleet.forecast_due(FORECAST_EVERY_S)):
                        break
            for stream in self.streams.values():
                stream.stop()
            while self.round():
                pass
        finally:
            self.health.looped = math.inf
            for stream in self.streams.values():
                stream.stop()
            if self.store is not None:
                self.store.close()
            LOG.info("ended", extra={"deliveries": self.health.deliveries, "rounds": self.health.rounds})

    def _open(self) -> None:
        """Open the store, claim what this tracker tracks, and restore the fleet.  Raises StoreFault."""
        store = open_store(self.store_url)
        try:
            store.claim("turbine", self.turbines)
            store.claim("channel", [channel.name for channel in self.channels])
            store.claim("source", [url for url in self.streams if store.place(url) is not None])
            begins, self.fleet = self.fleet is None, Fleet.from_store(self.turbines, store)
            # connections first: the filter needs them for the readings that came meanwhile
            if not (batch := self._connections(self.fleet, begins=begins)).empty:
                store.commit(batch)
            self._batch_marks.clear()
        except BaseException:
            store.close()
            raise
        self.store = store

    def _put(self, url: str, delivery: Delivery) -> None:
        """Queue a delivery, called from the streams' threads; blocks while the queue is full, unless the
        service is ending."""
        while not self.ending.is_set():
            with suppress(queue.Full):
                self._waiting.put((url, delivery, time.monotonic()), timeout=0.5)
                return

    def _sources_ended(self) -> bool:
        """Return whether all sources have ended and all their deliveries are processed."""
        # states before the queue: then the queue holds everything that an ended source delivered
        words = [stream.state.word for stream in self.streams.values()]
        return all(word in ("ended", "lost", "stopped") for word in words) and self._waiting.empty()

    def round(self) -> bool:
        """Process the deliveries that have arrived or, without any, filter waiting turbines; returns whether
        anything was done."""
        arrived = take_from_queue(
            self._waiting, MOST_PER_ROUND, 0.0 if self._open_fleet.waiting else FIRST_DELIVERY_S
        )
        self.retention.delete_portion(self._open_store, self._open_fleet)
        if not arrived and self._open_fleet.waiting:
            self._publish(self._commit(lambda: self._open_fleet.filter_waiting(Batch(), FILTER_S)))
            return True
        by_source: dict[str, list[Delivery]] = {}
        for url, delivery, _ in arrived:
            by_source.setdefault(url, []).append(delivery)
        for url, deliveries in by_source.items():
            self._process(url, deliveries)
        if arrived:
            committed_at = time.monotonic()
            self.health.note_waits([committed_at - arrived_at for _, _, arrived_at in arrived])
            self.health.rounds += 1
            self.health.deliveries += len(arrived)
        return bool(arrived)

    def _process(self, url: str, deliveries: Sequence[Delivery]) -> None:
        """Commit the results of a source's deliveries, then acknowledge and publish them."""
        stream = self.streams[url]
        batch = self._commit(lambda: self._open_fleet.round(deliveries, stream.mapping, url, FILTER_S), url)
        stream.acknowledge(deliveries)
        self.health.note_source(url, batch)
        self._publish(batch)

    def _forecast(self, name: str) -> Batch:
        """Forecast a turbine; the next forecast is due an hour later, even if this one failed."""
        fleet = self._open_fleet
        forecast_batch = make_forecast(
            name, self.turbines[name], fleet.tracked[name].tracker, self._open_store
        )
        if forecast_batch is None:
            return Batch()
        made_s, batch = forecast_batch
        fleet.keep_forecast(name, made_s, batch)
        return batch

    def _commit(self, make: Callable[[], Batch], source: str = "") -> Batch:
        """Make a batch by `make` and commit it; reopens store and fleet, and makes the batch again, as often
        as necessary.

        source: URL of the source whose deliveries the batch contains, "" for other batches.
        """
        attempt, mark, is_replaced = 0, secrets.token_hex(8), False
        while True:
            try:
                self._expect_own_batch(source)
                # if the mark is stored, the commit succeeded and only its answer was lost
                if not attempt or not source or self._open_store.memory(SOURCE, f"batch of {source}") != mark:
                    batch = make()
                    if is_replaced:
                        batch.counters[SOURCE, "store replaced"] = 1
                    batch.notices += notices_of(batch.alarms, self.channels, time.time(), self.now)
                    if source:
                        batch.memories[SOURCE, f"batch of {source}"] = mark
                        self._open_store.claim("source", batch.place)
                    if not batch.empty:
                        self._open_store.commit(batch)
                break
            except StoreFault as fault:
                is_replaced = is_replaced or isinstance(fault, StoreReplaced)
                self.health.store = str(fault).strip()
                self.health.failures += 1  # after the message: whoever sees the new count finds the message
                LOG.warning("the store failed", extra={"fault": self.health.store, "attempt": attempt + 1})
                if attempt and self.ending.is_set():
                    raise
                attempt = self._reopen(attempt)
        if source:
            self._batch_marks[source] = mark
        self.health.store = ""
        self.health.committed_s = self._clock()
        return batch

    def _expect_own_batch(self, source: str) -> None:
        """Raise StoreReplaced if the store does not hold the source's batch that was last committed."""
        store, mark = self._open_store, self._batch_marks.get(source)
        missing = mark is not None and store.memory(SOURCE, f"batch of {source}") != mark
        if missing or store.database.is_replaced():
            raise StoreReplaced(f"{self.store_url}: {REPLACED}")

    def _publish(self, batch: Batch) -> None:
        """Publish a committed batch: alarms at the sources, changes on the page."""
        if batch.empty:
            return
        if batch.alarms:
            for stream in self.streams.values():
                stream.publish_alarms(batch.alarms)
        self._on_commit(batch)

    @property
    def now(self) -> float:
        """Time [s] against which the age of data is judged; of the records if all streams play back
        records."""
        streams = [stream for stream in self.streams.values() if not stream.mapping.weather]
        live = [stream for stream in streams if not stream.played_back]
        return min((stream.now() for stream in live or streams), default=self._clock())

    def _work_between_rounds(self, idle: bool) -> None:
        """Check for missing data, make forecasts and isolate faults, for a limited share of the time.

        idle: whether the last round had nothing to do.
        """
        begin_s = time.monotonic()
        if begin_s >= self._next_tick:
            self._next_tick = begin_s + TICK_S
            for url, stream in self.streams.items():
                word, explanation = stream.state
                if self._logged_states.get(url) != word:
                    self._logged_states[url] = word
                    LOG.info("source", extra={"source": url, "state": word, "behind": explanation})
            left: dict[str, Statement] = {}
            for stream in self.streams.values():
                left |= stream.departed_senders()
            now, reaches = self.now, self.reaches()
            quiet = self._quiet(reaches, now)
            self._publish(self._commit(lambda: self._open_fleet.tick(now, reaches, left, quiet)))
            self._publish(self._commit(lambda: self._connections(self._open_fleet, left)))
            self._publish(self._commit(lambda: self._open_fleet.take_events(self._open_store.all_events())))
            self._publish(self._commit(lambda: look_again(self._open_store, self.now, self.channels)))
        is_behind = self._open_fleet.waiting or not self._waiting.empty()
        if idle or begin_s >= (self._next_work_behind if is_behind else self._next_work):
            name = self._open_fleet.forecast_due(FORECAST_EVERY_S)
            if name is not None:
                self._publish(self._commit(lambda: self._forecast(name)))
            self._isolate()
            end_s = time.monotonic()
            self._next_work, self._next_work_behind = (
                end_s + (end_s - begin_s) * (1.0 / share - 1.0) for share in (FORECAST_SHARE, BUSY_SHARE)
            )

    def reaches(self) -> dict[str, Reach]:
        """Return source URL -> how long it has been unreachable, without played-back records."""
        return {url: stream.reach() for url, stream in self.streams.items() if not stream.played_back}

    def _quiet(self, reaches: Mapping[str, Reach], now: float) -> list[str]:
        """Return the turbines whose silence raises no alarm: all their sources are played back, or have an
        alarm because they are not reached."""
        reached = [
            stream for url, stream in self.streams.items() if url in reaches and reaches[url].share(now) < 1.0
        ]
        quiet = []
        for name in self.turbines:
            has_source = any(stream.signals(name) for stream in self.streams.values())
            if has_source and not any(stream.signals(name) for stream in reached):
                quiet.append(name)
        return quiet

    def _connections(self, fleet: Fleet, left: Collection[str] = (), begins: bool = False) -> Batch:
        """Let the fleet note lost and regained connections; arguments as of `Fleet.note_connections`."""
        now = self.now
        return fleet.note_connections(now, self._unreached(self.reaches(), now), left, begins)

    def _unreached(self, reaches: Mapping[str, Reach], now: float) -> dict[str, dict[str, float | None]]:
        """Return, for every turbine, since when [s] the sources of each signal that is held while connected
        are all lost.

        reaches: url of a source → whether it is reached.  now: [s] present time.

        The time is None while at least one source of the signal is reached.  While all are lost, it is ∞
        until the limit of each has passed, then the time at which the last one was lost.  Signals that no
        source sends, since they come from played-back records, are left out.
        """
        lost_by_turbine: dict[str, dict[str, float | None]] = {}
        for name, turbine in self.turbines.items():
            if not (held := turbine.plan.held_while_connected):
                continue
            senders = [(reaches[url], self.streams[url].signals(name)) for url in reaches]
            for signal in held:
                reaches_of_signal = [reach for reach, sent in senders if signal in sent]
                lost_times = [reach.since for reach in reaches_of_signal if reach.since is not None]
                if reaches_of_signal:
                    lost_s = (
                        max(lost_times)
                        if all(reach.share(now) >= 1.0 for reach in reaches_of_signal)
                        else math.inf
                    )
                    is_lost = len(lost_times) == len(reaches_of_signal)
                    lost_by_turbine.setdefault(name, {})[signal] = lost_s if is_lost else None
        return lost_by_turbine

    def _isolate(self) -> None:
        """Do one step of the fault isolation in progress, or of the next one that is due."""
        if self._isolation is None:
            due = self._open_fleet.isolation_due()
            if due is None:
                return
            name, step = due
            reference = self._open_fleet.tracked[name].reference_point
            sisters = self._open_fleet.sisters(name, step.time)
            steps = isolation_steps(name, self.turbines[name], step, self._open_store, reference, sisters)
            self._isolation = (name, steps)
        name, steps = self._isolation
        try:
            finding = next(steps)
        except StoreFault:  # the next commit notices it too and reopens the store
            self._isolation = None
            return
        if finding is not None:
            self._isolation = None
            self._publish(self._commit(lambda: self._open_fleet.keep_finding(name, finding)))

    def _reopen(self, attempt: int) -> int:
        """Reopen the store, trying until it succeeds or, once the service is ending, only once more.

        attempt: number of failed attempts so far; returns the number of the attempt that succeeded.
        """
        while True:
            self._open_store.close()
            attempt += 1
            self.ending.wait(pause_s(attempt, REOPEN_S))
            try:
                self._open()
                return attempt
            except StoreFault as fault:
                self.health.store = str(fault).strip()
                LOG.warning(
                    "the store cannot be reached", extra={"fault": self.health.store, "attempt": attempt}
                )
                if self.ending.is_set():
                    raise


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

    def delete_portion(self, store: Store, fleet: Fleet) -> int:
        """Delete a portion of the old rows if a pass is due; returns their number.  The next commit handles a
        failure of the store."""
        if not self._due and time.monotonic() >= self._next and math.isfinite(self.seconds):
            self._due, self._next = list(fleet.tracked), time.monotonic() + PRUNED_S
        while self._due:
            name = self._due[-1]
            state = fleet.tracked[name]
            point = state.tracker.point
            if point is None:  # nothing is final yet, so a restart needs all readings
                self._due.pop()
                continue
            needed_from_s = point.time - state.turbine.plan.context_s
            try:
                count = prune(store, name, point.time - self.seconds, needed_from_s)
            except StoreFault as fault:
                LOG.warning("old rows were not deleted", extra={"fault": str(fault)})
                self._due.clear()
                return 0
            if count < MOST_DELETED:
                self._due.pop()
            return count
        return 0


def take_from_queue(waiting: queue.Queue[T], most: int, patience_s: float) -> list[T]:
    """Take at most `most` items from a queue, waiting up to `patience_s` [s] for the first one."""
    items: list[T] = []
    with suppress(queue.Empty):
        items.append(waiting.get(timeout=patience_s))
        while len(items) < most:
            items.append(waiting.get_nowait())
    return items
