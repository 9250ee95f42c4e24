"""What a command says beside its result: notes, its steps, and signs of life in a log."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from enum import IntEnum

HEARTBEAT_S = 30.0
"""[s] longest silence of a command whose output goes to a file or another program."""


class Loudness(IntEnum):
    """How much a command says on standard error beside its result."""

    QUIET = 0
    NORMAL = 1
    VERBOSE = 2


class Activity:
    """A running command: its present step, and its lines on standard error.

    name: of the command. beats: whether it gives signs of life where standard error is no terminal.
    every_s: [s] between these; None: `HEARTBEAT_S`. clock: [s] monotonic.
    """

    def __init__(
        self,
        name: str,
        loudness: Loudness = Loudness.NORMAL,
        *,
        beats: bool = False,
        every_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name, self.loudness = name, loudness
        self._beats, self._clock = beats, clock
        self._every_s = HEARTBEAT_S if every_s is None else every_s
        self._begin = self._said = clock()
        self._step = "at work"

    @property
    def on_terminal(self) -> bool:
        """Whether a person watches: standard error is a terminal."""
        return sys.stderr is not None and sys.stderr.isatty()

    def step(self, text: str) -> None:
        """Begin a step; it is printed with --verbose, and named in later signs of life."""
        self._step = text
        if self.loudness is Loudness.VERBOSE:
            self.line(f"{self.name}: {self._elapsed()}: {text}")

    def note(self, text: str) -> None:
        """Print a note or a warning; not with --quiet."""
        if self.loudness is not Loudness.QUIET:
            self.line(text)

    def line(self, text: str) -> None:
        """Print a line on standard error, at once."""
        self._said = self._clock()
        if sys.stderr is not None:
            print(text, file=sys.stderr, flush=True)

    @contextmanager
    def alive(self) -> Iterator[None]:
        """Give signs of life within this context: a line after every `every_s` without another line."""
        if not self._beats or self.loudness is Loudness.QUIET or self.on_terminal:
            yield
            return
        ended = threading.Event()

        def beat() -> None:
            wait = self._every_s
            while not ended.wait(wait):
                wait = self._said + self._every_s - self._clock()
                if wait <= 0.0:
                    self.line(f"{self.name}: {self._elapsed()}: {self._step}")
                    wait = self._every_s

        thread = threading.Thread(target=beat, name="heartbeat", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def end(self) -> None:
        """With --verbose, print how long the command took."""
        if self.loudness is Loudness.VERBOSE:
            self.line(f"{self.name}: {self._elapsed()}: end")

    def _elapsed(self) -> str:
        return f"{self._clock() - self._begin:.0f} s"


_ACTIVITY: ContextVar[Activity | None] = ContextVar("activity", default=None)


def activity() -> Activity:
    """The command that runs; outside of any command one with the usual loudness."""
    return _ACTIVITY.get() or Activity("hygrokf")


@contextmanager
def running(this: Activity) -> Iterator[Activity]:
    """Within this context `activity()` is this command, which gives signs of life."""
    before = _ACTIVITY.set(this)
    try:
        with this.alive():
            yield this
    finally:
        _ACTIVITY.reset(before)
