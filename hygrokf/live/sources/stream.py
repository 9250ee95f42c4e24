"""What a source is to the tracker: a `Stream` of deliveries, with a state.

Every source hands deliveries to the service from its own thread, and `acknowledge` tells it which of them the
store has committed.
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
PAUSE_S = 0.2
"""[s] between two looks at a source that has nothing new."""
BACK_OFF_S = (1.0, 60.0)
"""Shortest and longest pause [s] between attempts to read a source."""


@dataclass(frozen=True)
class Delivery:
    """A payload that a source delivers.

    `received`: time of arrival [s]; `topic`: MQTT topic; `place`: position from which the source resumes
    after this delivery; `memories`: name → JSON data of the source that the store keeps together with this
    delivery and gives back by `Stream.recall`; `acknowledge`: tells the source that it is committed, None if
    there is nothing to tell; `mark`: the source's own number of this version of its values (`Reading.mark`).
    """

    content: Content
    received: float
    topic: str = ""
    place: str = ""
    memories: JsonObject = field(default_factory=dict)
    acknowledge: Callable[[], None] | None = field(default=None, compare=False)
    mark: float = field(default=math.nan, compare=False)


def pause_s(failed: int, limits_s: tuple[float, float]) -> float:
    """Pause [s] after `failed` attempts in a row, 1 or more: the shortest of its limits at first, then each
    twice as long as the one before, up to the longest."""
    shortest, longest = limits_s
    return min(shortest * 2.0 ** min(failed - 1, 30), longest)


class BackOff:
    """Pauses between attempts to reach a source.

    Each is up to twice as long as the one before, from the shortest again after an attempt that held for
    longer than the longest.  Their length is random, so that trackers of one broker do not return together.
    """

    # its own generator: the global one belongs to the program that runs the tracker
    _random = random.Random()

    def __init__(self) -> None:
        self._began = time.monotonic()
        self._failed = 1

    @property
    def has_held(self) -> bool:
        """Whether the present attempt has held for longer than the longest pause."""
        return time.monotonic() - self._began > BACK_OFF_S[1]

    @property
    def next_s(self) -> float:
        """Longest time [s] until the next attempt."""
        return BACK_OFF_S[0] if self.has_held else pause_s(self._failed, BACK_OFF_S)

    def reset(self) -> None:
        """Begin again with the shortest pause."""
        self._failed = 1

    def wait(self, ended: threading.Event) -> None:
        """End the present attempt; wait for the pause, or until `ended` is set; the next attempt begins."""
        if self.has_held:
            self.reset()
        ended.wait(pause_s(self._failed, BACK_OFF_S) * self._random.uniform(0.5, 1.0))
        self._failed += 1
        self._began = time.monotonic()


class SourceFault(HygrokfError):
    """A source cannot be read; the message tells the operator why."""


class SourceState(NamedTuple):
    """The state of a source: one `word` ("connected", "waiting", "lost", "ended", "stopped", "idle") and its
    explanation."""

    word: str
    words: str


REACHED = ("connected", "ended", "stopped")
"""Words of the states in which a source is reached."""
INTERVALS = 3.0
"""Usual intervals of a source, but at least a minute, after which one that is not reached is an alarm."""


class Reach(NamedTuple):
    """Since when [s, this machine's clock] a source is not reached, None while it is; the time [s] after
    which that is an alarm; and why."""

    since: float | None
    limit_s: float
    words: str = ""

    def share(self, now: float) -> float:
        """The time that it has not been reached at `now` [s] as a multiple of the limit."""
        return 0.0 if self.since is None else (now - self.since) / self.limit_s


@dataclass(frozen=True, kw_only=True)
class SourceKeys(FolderKeys):
    """The keys of every [[source]] table, whose form makes its stream."""

    weather: bool = setting(False, "whether it brings weather forecasts, not readings")
    revision: str = setting("last", "which of several values of a stamp counts", choices=("last", "neither"))
    reach_limit_s: float | None = setting(
        None, "after which a source that is not reached is an alarm", read=duration, above=0.0,
        expected="longer than nothing",
    )  # fmt: skip

    def stream(self, mapping: PayloadMapping, place: Place) -> Stream | None:
        """The stream; None with faults in `place`."""
        raise NotImplementedError

    def expect(self, place: Place, *reads: Callable[[], object]) -> None:
        """Read what a connection needs, such as secrets; what cannot be read is a fault in `place`."""
        for read in reads:
            try:
                read()
            except SourceFault as fault:
                place.fault(str(fault))


class Stream:
    """A source of deliveries: a thread that runs `_deliver` until it returns or `_ended` is set, and this
    machine's `clock` [s].

    `url` identifies the source in the store and never contains a secret; `mapping` tells how to read its
    payloads; `played_back` whether it repeats a record, whose age says nothing; `label` is what the page says
    of its data, such as that they are a demonstration's; `reach_limit_s`: the limit of `reach` [s] that it
    states; `ordered_by`: what orders the versions of a value; `state` is shown on the page and by the doctor.

    Whatever `_deliver` raises makes the source "lost", with the reason.  After a pause it is called again,
    from the place of the last delivery.  Pauses grow until a delivery or, of a server (`is_server`), to which
    many may come back at once, until a connection holds.
    """

    url = ""
    played_back = False
    is_server = False
    label = ""
    ordered_by = "arrival"
    reach_limit_s: float | None = None
    usual_interval_s = 0.0
    """[s] after which more comes from the source as a rule, if that is known."""
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
        reached, reason = place, ""

        def reach(one: Delivery) -> None:
            nonlocal reached
            put(one)
            reached = one.place or reached
            if not self.is_server:
                back_off.reset()
            if self._state.word == "lost":
                self._state = SourceState("connected", self.url)

        waits, reads = SourceState("waiting", "not connected yet"), SourceState("connected", self.url)
        self._state = waits if self.is_server else reads
        while not self._ended.is_set():
            try:
                self._deliver(reached, reach)
                self._state = SourceState("ended", "read to its end")
                break
            except Exception as fault:  # of any kind: a source must never end without a word
                if self._ended.is_set():
                    break
                words = _reason(fault, self.url)
                self._state = SourceState("lost", f"{words}; next attempt within {back_off.next_s:g} s")
                if words != reason or back_off.has_held:  # log once, not at every attempt
                    foreseen = isinstance(fault, SourceFault | OSError)
                    said = {"source": self.url, "reason": words}
                    LOG.warning("source lost", extra=said, exc_info=None if foreseen else fault)
                reason = words
            back_off.wait(self._ended)
        # a file that is not there when the tracker ends stays lost, which the command reports
        if self._ended.is_set() and (self.is_server or self._state.word != "lost"):
            self._state = SourceState("stopped", "")

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        raise NotImplementedError

    def recall(self, memories: JsonObject) -> None:
        """Take back, before the start, the data that its deliveries let the store keep: none by default."""

    def end_when_read(self) -> None:
        """End at the present end of a growing source; the others end by themselves."""

    def acknowledge(self, deliveries: Iterable[Delivery]) -> None:
        """Note which deliveries the store has committed; most need only its place to resume."""

    def tell(self, alarms: Iterable[Alarm]) -> None:
        """Pass on alarms that began, changed or ended, if the source can publish them."""

    def now(self) -> float:
        """The time [s] against which the age of the data is judged."""
        return self.clock()

    def reach(self) -> Reach:
        """Since when the source is not reached, whatever its state is called: seen whenever it is asked."""
        word, words = self.state
        if word in REACHED:
            self._unreached = None
        elif self._unreached is None:
            self._unreached = self.clock()
        limit_s = self.reach_limit_s or max(MINUTE_S, INTERVALS * self.usual_interval_s)
        return Reach(self._unreached, limit_s, words)

    def stop(self) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join(timeout=10.0)

    @property
    def state(self) -> SourceState:
        return self._state

    def left(self) -> dict[str, Statement]:
        """Turbine -> that its sender has left: none, because these senders do not say so."""
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
