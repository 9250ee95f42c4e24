"""Sources that need no server: a growing file, standard input, and a record that is played back.

Every source is a `Stream`: it puts deliveries where the service takes them, in a thread of its own, and is told by
`acknowledge` what the store has committed.
"""

from __future__ import annotations

import csv
import json
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Protocol

import numpy as np

from hygrokf.live.fleet import Delivery
from hygrokf.record import Record

PAUSE_S = 0.2
"""[s] between two looks at a file that has not grown."""
LONGEST_LINE = 65_536


class SourceFault(Exception):
    """A source that cannot be read, in words for the one who runs it."""


class Stream(Protocol):
    """A source of deliveries.

    `url` names it in the store; `start` begins after `place` (None: at the beginning, or wherever the source has kept it);
    `state` is one word and what stands behind it, for the page and the doctor.
    """

    url: str

    def start(self, place: str | None, put: Callable[[Delivery], None]) -> None: ...

    def acknowledge(self, deliveries: Iterable[Delivery]) -> None: ...

    def stop(self) -> None: ...

    @property
    def state(self) -> tuple[str, str]: ...


class Threaded:
    """What streams with a thread of their own share: `_deliver` runs in it until `_ended` is set or it returns."""

    url = ""

    def __init__(self) -> None:
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._state = ("idle", "not started")

    def start(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        self._thread = threading.Thread(target=self._run, args=(place, put), name=self.url, daemon=True)
        self._thread.start()

    def _run(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        try:
            self._state = ("connected", self.url)
            self._deliver(place, put)
            self._state = ("ended", "all of it was read") if not self._ended.is_set() else ("stopped", "")
        except SourceFault as fault:
            self._state = ("lost", str(fault))
        except OSError as fault:
            self._state = ("lost", f"{self.url}: {fault.strerror or fault}")

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        raise NotImplementedError

    def acknowledge(self, deliveries: Iterable[Delivery]) -> None:
        """Nothing to do: the place in the store says where to go on."""

    def stop(self) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join(timeout=10.0)

    @property
    def state(self) -> tuple[str, str]:
        return self._state


class Lines:
    """Rows of text as they come: NDJSON as it is, CSV by its header (one that is repeated is no row)."""

    def __init__(self) -> None:
        self.header: list[str] = []
        self._separator = ","

    def content(self, line: str) -> str | dict | None:
        """What a line delivers; None for an empty one, a comment, or a header."""
        text = line.strip("\ufeff\r\n")
        if not text.strip() or text.startswith("#"):
            return None
        if text.lstrip().startswith("{"):
            return text
        if not self.header:
            self._separator = max(",;\t", key=text.count)
        cells = [c.strip() for c in next(csv.reader([text], delimiter=self._separator), [])]
        if not self.header:
            self.header = cells
        if cells == self.header:
            return None
        return dict(zip(self.header, cells, strict=False))


class TailedFile(Threaded):
    """A CSV or NDJSON file that grows; begins anew where it was replaced or cut.

    The place is "identity offset": another file of that name is read from its start.  A line without its end is not yet one.
    """

    def __init__(self, path: str | os.PathLike[str], follow: bool = True) -> None:
        super().__init__()
        self.path = Path(path)
        self.url = f"file:{self.path}"
        self.follow = follow

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        while not self._ended.is_set():
            try:
                with self.path.open("rb") as file:
                    identity = _identity(file)
                    known, _, offset = (place or "").partition(" ")
                    if self._read(file, identity, int(offset) if known == identity else 0, put):
                        return
            except FileNotFoundError:
                if not self.follow:
                    raise SourceFault(f"{self.path}: no such file") from None
                self._state = ("waiting", f"{self.path} does not exist yet")
                self._ended.wait(PAUSE_S)
            place = None

    def _read(self, file, identity: str, offset: int, put: Callable[[Delivery], None]) -> bool:
        """Deliver from an offset on; True where there is nothing more to come, False where the file was replaced."""
        self._state = ("connected", self.url)
        lines = Lines()
        while offset and not lines.header:  # rows further down need the header
            line = file.readline(LONGEST_LINE).decode("utf-8", "replace")
            if not line or lines.content(line):
                break
        file.seek(offset)
        while not self._ended.is_set():
            line = file.readline(LONGEST_LINE)
            if line.endswith(b"\n") or (len(line) == LONGEST_LINE):
                offset += len(line)
                content = lines.content(line.decode("utf-8", "replace"))
                if content is not None:
                    put(Delivery(content, time.time(), place=f"{identity} {offset}"))
                continue
            if not self.follow:
                if line.strip():
                    content = lines.content(line.decode("utf-8", "replace"))
                    if content is not None:
                        put(Delivery(content, time.time(), place=f"{identity} {offset + len(line)}"))
                return True
            file.seek(offset)
            self._ended.wait(PAUSE_S)
            try:
                now = self.path.stat()
            except FileNotFoundError:
                return False
            if now.st_size < offset or f"{now.st_dev}.{now.st_ino}" != identity:
                return False
        return True


def _identity(file) -> str:
    found = os.fstat(file.fileno())
    return f"{found.st_dev}.{found.st_ino}"


class StandardInput(Threaded):
    """Lines of standard input, until it ends; there is no going back to what was read."""

    url = "stdin"

    def __init__(self, file=None) -> None:
        super().__init__()
        self._file = file

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        lines = Lines()
        for line in self._file or sys.stdin:
            if self._ended.is_set():
                return
            content = lines.content(line)
            if content is not None:
                put(Delivery(content, time.time()))


class Playback(Threaded):
    """A record played back as messages of one turbine, faster by a factor, perhaps shuffled, repeated and late.

    `speed` 0 plays as fast as it is taken.  `late_s` [s] every reading arrives up to this much late, in time of the record;
    `repeated` share of readings that come twice.  Stamps are the record's own, moved to end now with `live`.  The place is
    the number of messages that were delivered: the same seed gives the same messages.
    """

    def __init__(
        self,
        record: Record,
        turbine: str,
        *,
        speed: float = 0.0,
        late_s: float = 0.0,
        repeated: float = 0.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.url = f"replay:{record.name}?late={late_s:g}&repeated={repeated:g}&seed={seed}"
        self.speed = speed
        self._messages = messages(record, turbine, late_s, repeated, seed)

    def __len__(self) -> int:
        return len(self._messages)

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        first = int(place or 0)
        if first >= len(self._messages):
            return
        began, origin = time.monotonic(), self._messages[first][0]
        for number in range(first, len(self._messages)):
            at, content = self._messages[number]
            if self.speed > 0.0:
                self._ended.wait(max((at - origin) / self.speed - (time.monotonic() - began), 0.0))
            if self._ended.is_set():
                return
            put(Delivery(content, at, place=str(number + 1)))


def messages(
    record: Record, turbine: str, late_s: float = 0.0, repeated: float = 0.0, seed: int = 0
) -> list[tuple[float, str]]:
    """(arrival [s], JSON payload) of every reading of a record, by arrival; values in SI units under the signals' names."""
    random = np.random.default_rng(seed)
    found: list[tuple[float, int, str]] = []
    for time_s, signal, value in _stamped(record):
        text = json.dumps({"turbine": turbine, "time": time_s, signal: value})
        copies = 1 + int(random.random() < repeated)
        for _ in range(copies):
            found.append((time_s + late_s * float(random.random()), len(found), text))
    return [(at, text) for at, _, text in sorted(found)]


def _stamped(record: Record) -> Iterator[tuple[float, str, float]]:
    rows = [
        (t, s.signal, v)
        for s in record.series
        for t, v in zip(s.time[~s.missing].tolist(), s.value[~s.missing].tolist(), strict=True)
    ]
    yield from sorted(rows)


def taken_from(waiting: queue.Queue, most: int, patience_s: float) -> list[Delivery]:
    """Deliveries that wait, `most` at most; waits `patience_s` [s] for a first one."""
    found: list[Delivery] = []
    try:
        found.append(waiting.get(timeout=patience_s))
        while len(found) < most:
            found.append(waiting.get_nowait())
    except queue.Empty:
        pass
    return found
