"""The interface between a source and the tracker: a `Stream` of deliveries, with a state.

Every source hands deliveries to the service from its own thread; the service calls `acknowledge` with those
that the store has committed.
"""

from __future__ import annotations

import logging
import math
import random
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from hygrokf.data.structured import JsonObject
from hygrokf.data.timestamps import MINUTE_S, duration
from hygrokf.data.toml_form import FolderKeys, Place, setting
from hygrokf.errors import HygrokfError
from hygrokf.live.batch import Alarm
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.payload_formats import Content
from hygrokf.texts.statement import Statement

LOG = logging.getLogger("hygrokf.track")
POLL_PAUSE_S = 0.2
"""Pause [s] before a source that has nothing new is read again."""
SOURCE_BACK_OFF_S = (1.0, 60.0)
"""Shortest and longest pause [s] between attempts to read a source."""


@dataclass(frozen=True)
class Delivery:
    """A payload that a source delivers.

    `received`: time of arrival [s]; `topic`: MQTT topic; `place`: position from which the source resumes
    after this delivery; `memories`: name → JSON data of the source that the store keeps together with this
    delivery and returns by `Stream.recall`; `acknowledge`: called when the delivery is committed, None if the
    source needs no call; `mark`: number by which the source orders the versions of a value (`Reading.mark`).
    """

    content: Content
    received: float
    topic: str = ""
    place: str = ""
    memories: JsonObject = field(default_factory=dict)
    acknowledge: Callable[[], None] | None = field(default=None, compare=False)
    mark: float = field(default=math.nan, compare=False)


def pause_s(failed: int, limits_s: tuple[float, float]) -> float:
    """Pause [s] after `failed` ≥ 1 consecutive failed attempts.

    limits_s: shortest pause, which follows the first attempt, and longest pause. Each pause is twice as long
    as the one before, up to the longest.
    """
    shortest, longest = limits_s
    return min(shortest * 2.0 ** min(failed - 1, 30), longest)  # 30: the power must not overflow


class BackOff:
    """Pauses between attempts to reach a source.

    Each pause is up to twice as long as the one before; after an attempt that lasted longer than the longest
    pause, the next pause is the shortest again.  The length is random, so that the trackers of a broker do
    not reconnect at the same time.
    """

    # a separate generator, because the global one belongs to the program that runs the tracker
    _random = random.Random()

    def __init__(self) -> None:
        self._began = time.monotonic()
        self._failed = 1

    @property
    def has_held(self) -> bool:
        """Whether the present attempt has lasted longer than the longest pause."""
        return time.monotonic() - self._began > SOURCE_BACK_OFF_S[1]

    @property
    def next_s(self) -> float:
        """Longest time [s] until the next attempt."""
        return SOURCE_BACK_OFF_S[0] if self.has_held else pause_s(self._failed, SOURCE_BACK_OFF_S)

    def reset(self) -> None:
        """Begin again with the shortest pause."""
        self._failed = 1

    def wait(self, ended: threading.Event) -> None:
        """End the present attempt, wait for the pause or until `ended` is set, and begin the next attempt."""
        if self.has_held:
            self.reset()
        ended.wait(pause_s(self._failed, SOURCE_BACK_OFF_S) * self._random.uniform(0.5, 1.0))
        self._failed += 1
        self._began = time.monotonic()


class SourceFault(HygrokfError):
    """A source cannot be read; the message tells the operator why."""


class SourceState(NamedTuple):
    """The state of a source: one `word` ("connected", "waiting", "lost", "ended", "stopped", "idle") and its
    explanation."""

    word: str
    words: str


REACHED_STATES = ("connected", "ended", "stopped")
"""Words of the states in which a source counts as reached."""
ALARM_INTERVALS = 3.0
"""Number of a source's usual intervals, or at least a minute, after which its absence is an alarm."""


class Reach(NamedTuple):
    """How long a source has not been reached.

    `since`: beginning [s, this machine's clock], None while the source is reached; `limit_s`: time [s] after
    which an alarm is raised; `words`: reason.
    """

    since: float | None
    limit_s: float
    words: str = ""

    def share(self, now: float) -> float:
        """The time without a connection, until `now` [s], as a multiple of the limit."""
        return 0.0 if self.since is None else (now - self.since) / self.limit_s


@dataclass(frozen=True, kw_only=True)
class SourceKeys(FolderKeys):
    """The keys of every [[source]] table; the subclass for each kind of source creates its stream."""

    weather: bool = setting(False, "whether it brings weather forecasts, not readings")
    revision: str = setting("last", "which of several values of a stamp counts", choices=("last", "neither"))
    reach_limit_s: float | None = setting(
        None, "after which a source that is not reached is an alarm", read=duration, above=0.0,
        expected="longer than nothing",
    )  # fmt: skip

    def stream(self, mapping: PayloadMapping, place: Place) -> Stream | None:
        """The stream; None if faults are reported at `place`."""
        raise NotImplementedError

    def expect(self, place: Place, *reads: Callable[[], object]) -> None:
        """Read what a connection needs, such as secrets, by `reads`; report their faults at `place`."""
        for read in reads:
            try:
                read()
            except SourceFault as fault:
                place.fault(str(fault))


class Stream:
    """A source of deliveries, with a thread that runs `_deliver` until it returns or `_ended` is set.

    `url` identifies the source in the store and never contains a secret; `mapping`: how to read its payloads;
    `clock`: this machine's clock [s]; `played_back`: whether the source repeats a record, whose age is
    meaningless; `label`: text about its data on the page, such as that they are a demonstration;
    `reach_limit_s`: configured limit of `reach` [s]; `ordered_by`: what orders the versions of a value;
    `state` is shown on the page and by the doctor.

    If `_deliver` raises an exception, the source is "lost", with the reason.  After a pause `_deliver` is
    called again with the place of the last delivery.  The pauses grow until something is delivered; for a
    server (`is_server`), to which many clients may return at once, until a connection lasts.
    """

    url = ""
    played_back = False
    is_server = False
    label = ""
    ordered_by = "arrival"
    reach_limit_s: float | None = None
    usual_interval_s = 0.0
    """Usual time [s] between two deliveries, 0 if unknown."""
    _unreached: float | None = None

    def __init__(self, mapping: PayloadMapping, clock: Callable[[], float] = time.time) -> None:
        self.mapping = mapping
        self.clock = clock
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._state = SourceState("idle", "not started")

    def start(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        """Resume after `place` (None: from the beginning, or from the position that the source itself
        keeps)."""
        self._thread = threading.Thread(target=self._run, args=(place, put), name=self.url, daemon=True)
        self._thread.start()

    def _run(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        back_off = BackOff()
        last_place, reason = place, ""

        def put_and_record(delivery: Delivery) -> None:
            nonlocal last_place
            put(delivery)
            last_place = delivery.place or last_place
            if not self.is_server:
                back_off.reset()
            if self._state.word == "lost":
                self._state = SourceState("connected", self.url)

        waiting, connected = SourceState("waiting", "not connected yet"), SourceState("connected", self.url)
        self._state = waiting if self.is_server else connected
        while not self._ended.is_set():
            try:
                self._deliver(last_place, put_and_record)
                self._state = SourceState("ended", "read to its end")
                break
            except Exception as fault:  # whatever its type: a source must never end without a reason
                if self._ended.is_set():
                    break
                last_reason, reason = reason, _reason(fault, self.url)
                self._state = SourceState("lost", f"{reason}; next attempt within {back_off.next_s:g} s")
                if reason != last_reason or back_off.has_held:  # log once, not at every attempt
                    is_foreseen = isinstance(fault, SourceFault | OSError)
                    details = {"source": self.url, "reason": reason}
                    LOG.warning("source lost", extra=details, exc_info=None if is_foreseen else fault)
            back_off.wait(self._ended)
        # a file that does not exist when the tracker ends stays "lost", so that the command reports it
        if self._ended.is_set() and (self.is_server or self._state.word != "lost"):
            self._state = SourceState("stopped", "")

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        raise NotImplementedError

    def recall(self, memories: JsonObject) -> None:
        """Restore, before the start, the `memories` of former deliveries from the store: none by default."""

    def end_when_read(self) -> None:
        """End at the present end of a growing source; other sources end by themselves."""

    def acknowledge(self, deliveries: Iterable[Delivery]) -> None:
        """Called with the deliveries that the store has committed; most sources need only their places."""

    def tell(self, alarms: Iterable[Alarm]) -> None:
        """Publish alarms that began, changed or ended, if the source can publish."""

    def now(self) -> float:
        """The time [s] against which the age of the data is judged."""
        return self.clock()

    def reach(self) -> Reach:
        """Since when the source has not been reached: the first call that finds it so sets the time."""
        word, words = self.state
        if word in REACHED_STATES:
            self._unreached = None
        elif self._unreached is None:
            self._unreached = self.clock()
        limit_s = self.reach_limit_s or max(MINUTE_S, ALARM_INTERVALS * self.usual_interval_s)
        return Reach(self._unreached, limit_s, words)

    def stop(self) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join(timeout=10.0)

    @property
    def state(self) -> SourceState:
        return self._state

    def left(self) -> dict[str, Statement]:
        """Turbine -> statement that its sender has left; empty for senders that do not announce it."""
        return {}

    def signals(self, turbine: str) -> set[str]:
        """Signals of a turbine that this source can deliver as readings."""
        if self.mapping.weather or turbine not in self.mapping.turbines.values():
            return set()
        return {field.signal for field in self.mapping.fields.values()}


def _reason(fault: Exception, url: str) -> str:
    if isinstance(fault, SourceFault):
        return str(fault)
    if isinstance(fault, OSError):
        return f"{url}: {fault.strerror or fault}"
    return f"{url}: unforeseen fault, {type(fault).__name__}: {fault}; please report it with the log"
