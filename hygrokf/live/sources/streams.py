"""Sources that need no server: a growing file, standard input, and a record that is played back.

Every source is a `Stream`: it puts deliveries where the service takes them, in a thread of its own, and is told by
`acknowledge` what the store has committed.
"""

from __future__ import annotations

import csv
import math
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from collections.abc import Mapping as MappingOf
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.data.signals import SIGNALS
from hygrokf.errors import HygrokfError
from hygrokf.live.plan import Form
from hygrokf.live.sources.payload import Field, Mapping, stamp_of
from hygrokf.live.storage.store import Alarm
from hygrokf.live.table_reader import TableReader
from hygrokf.live.turbines import Delivery

T = TypeVar("T")

PAUSE_S = 0.2
"""[s] between two looks at a file that has not grown."""
LONGEST_LINE = 65_536


class SourceFault(HygrokfError):
    """A source that cannot be read, in words for the one who runs it."""


class Stream(Protocol):
    """A source of deliveries.

    `url` names it in the store, and never holds a secret; `mapping` says how its payloads are read; `start` begins after
    `place` (None: at the beginning, or wherever the source has kept it); `tell` hands on alarms that began, changed or
    ended, where the source has a place for them; `state` is one word ("connected", "waiting", "lost", "ended", "stopped",
    "idle") and what stands behind it, for the page and the doctor.
    """

    url: str
    mapping: Mapping

    def start(self, place: str | None, put: Callable[[Delivery], None]) -> None: ...

    def acknowledge(self, deliveries: Iterable[Delivery]) -> None: ...

    def tell(self, alarms: Iterable[Alarm]) -> None: ...

    def stop(self) -> None: ...

    def now(self) -> float: ...

    @property
    def state(self) -> tuple[str, str]: ...


class Threaded:
    """What streams with a thread of their own share: `_deliver` runs in it until `_ended` is set or it returns."""

    url = ""

    def __init__(self, mapping: Mapping) -> None:
        self.mapping = mapping
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

    def tell(self, alarms: Iterable[Alarm]) -> None:
        """Nothing to do: these sources only give."""

    def now(self) -> float:
        """The time [s] that its data are judged by."""
        return time.time()

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

    def __init__(self, path: str | os.PathLike[str], mapping: Mapping, follow: bool = True) -> None:
        super().__init__(mapping)
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

    def _read(self, file: Any, identity: str, offset: int, put: Callable[[Delivery], None]) -> bool:
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


def _identity(file: Any) -> str:
    found = os.fstat(file.fileno())
    return f"{found.st_dev}.{found.st_ino}"


class StandardInput(Threaded):
    """Lines of standard input, until it ends; there is no going back to what was read."""

    url = "stdin"

    def __init__(self, mapping: Mapping, file: Any = None) -> None:
        super().__init__(mapping)
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
    """Messages played back, each at its own time or faster by a factor.

    messages: (arrival [s], content), by arrival.  `speed` 0 plays as fast as it is taken, and so are those before `live_s`
    [s].  The place is the number of messages that were delivered.
    """

    def __init__(
        self,
        url: str,
        messages: Sequence[tuple[float, str | dict]],
        mapping: Mapping,
        speed: float = 0.0,
        live_s: float = -math.inf,
    ) -> None:
        super().__init__(mapping)
        self.url = url
        self.speed = speed
        self._live_s = live_s
        self._messages = messages
        self._played = (messages[0][0] if messages else 0.0, math.inf)

    def acknowledge(self, deliveries: Iterable[Delivery]) -> None:
        """What is committed has been played."""
        for one in deliveries:
            self._played = (one.received, time.monotonic())

    def now(self) -> float:
        """The time of the record that was reached."""
        at, when = self._played
        return at + self.speed * max(time.monotonic() - when, 0.0) if at >= self._live_s else at

    @property
    def messages(self) -> Sequence[tuple[float, str | dict]]:
        """All of them: (arrival [s], content)."""
        return self._messages

    def __len__(self) -> int:
        return len(self._messages)

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        first = int(place or 0)
        if first >= len(self._messages):
            return
        began, origin = math.nan, 0.0
        for number in range(first, len(self._messages)):
            at, content = self._messages[number]
            if self.speed > 0.0 and at >= self._live_s:
                if math.isnan(began):
                    began, origin = time.monotonic(), at
                self._ended.wait(max((at - origin) / self.speed - (time.monotonic() - began), 0.0))
            if self._ended.is_set():
                return
            put(Delivery(content, at, place=str(number + 1)))


def record_mapping(record: Record, turbine: str) -> Mapping:
    """How the messages of a record are read: signals under their own names, in SI units."""
    fields = {s.signal: Field(s.signal, SIGNALS[s.signal].unit, form_of(s)) for s in record.series}
    return Mapping(fields, turbines={turbine: turbine})


def form_of(series: Series) -> Form:
    return Form(series.hold, series.interval_s, series.resolution, series.accuracy, series.response_time_s)


def record_messages(record: Record, turbine: str) -> list[tuple[float, dict]]:
    """(time [s], content) of every reading of a record, by time and signal."""
    rows = [
        (t, s.signal, v)
        for s in record.series
        for t, v in zip(s.time[~s.missing].tolist(), s.value[~s.missing].tolist(), strict=True)
    ]
    return [(t, {"turbine": turbine, "time": t, signal: v}) for t, signal, v in sorted(rows)]


def disturbed(
    messages: Iterable[tuple[float, str | dict]], late_s: float = 0.0, repeated: float = 0.0, seed: int = 0
) -> list[tuple[float, str | dict]]:
    """Messages that arrive up to `late_s` [s] late each, and a share `repeated` of them twice; by arrival.

    The same seed gives the same messages.
    """
    random = np.random.default_rng(seed)
    found: list[tuple[float, int, str | dict]] = []
    for at, content in messages:
        for _ in range(1 + int(random.random() < repeated)):
            found.append((at + late_s * float(random.random()), len(found), content))
    return [(at, content) for at, _, content in sorted(found, key=lambda one: one[:2])]


def taken_from(waiting: queue.Queue[T], most: int, patience_s: float) -> list[T]:
    """Deliveries that wait, `most` at most; waits `patience_s` [s] for a first one."""
    found: list[T] = []
    try:
        found.append(waiting.get(timeout=patience_s))
        while len(found) < most:
            found.append(waiting.get_nowait())
    except queue.Empty:
        pass
    return found


# -- from the tracker's file -----------------------------------------------------------------------------------------
_FILE = ("url", "follow", "speed", "late", "repeated", "seed")


def file_stream(
    table: MappingOf[str, object], where: str, folder: Path, mapping: Mapping, reader: TableReader
) -> Stream | None:
    """`file:PATH`, which is followed as it grows, or with `speed` is played back from its beginning.

    `speed` times faster than it was (0: as fast as it is taken), each row up to `late` late, a share `repeated` twice.
    """
    reader.known(table, _FILE, where)
    path = folder / str(table["url"]).removeprefix("file:").removeprefix("//")
    follow = table.get("follow", True)
    if not isinstance(follow, bool):
        reader.faults.append(f"{where}: follow must be true or false, found {follow!r}")
        follow = True
    speed = reader.number(table, "speed", where)
    late_s = reader.seconds(table, "late", where, 0.0)
    repeated = reader.number(table, "repeated", where, 0.0) or 0.0
    seed = int(reader.number(table, "seed", where, 0.0) or 0.0)
    if not 0.0 <= repeated <= 1.0:
        reader.faults.append(f"{where}: repeated must lie within 0 … 1, found {repeated:g}")
    if speed is None:
        if late_s or repeated:
            reader.faults.append(f"{where}: late and repeated need a speed: they are for playing back")
        return TailedFile(path, mapping, follow)
    if speed < 0.0:
        reader.faults.append(f"{where}: speed must be 0 or more, found {speed:g}")
    try:
        rows = file_messages(path, mapping)
    except OSError as fault:
        reader.faults.append(f"{where}: {path}: {fault.strerror}; a file that is played back must be there")
        return None
    if not rows:
        reader.faults.append(f"{where}: {path}: no row with a time that can be read")
        return None
    url = f"file:{path}?late={late_s:g}&repeated={repeated:g}&seed={seed}"
    return Playback(url, disturbed(rows, late_s, repeated, seed), mapping, speed)


def file_messages(path: Path, mapping: Mapping) -> list[tuple[float, str | dict]]:
    """(time [s], content) of the rows of a file that have a time, by time."""
    found: list[tuple[float, str | dict]] = []
    lines = Lines()
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            content = lines.content(line)
            if content is not None and (at := stamp_of(content, mapping)) is not None:
                found.append((at, content))
    return sorted(found, key=lambda one: one[0])


def input_stream(
    table: MappingOf[str, object], where: str, folder: Path, mapping: Mapping, reader: TableReader
) -> Stream:
    """`stdin`: what is piped in."""
    reader.known(table, ("url",), where)
    return StandardInput(mapping)
