"""Sources on this machine: a growing file, standard input, and a record that is played back."""

from __future__ import annotations

import csv
import math
import os
import re
import select
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from io import UnsupportedOperation
from pathlib import Path
from typing import IO, Any, AnyStr

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.data.signals import SIGNALS
from hygrokf.data.timestamps import duration
from hygrokf.data.toml_form import Place, across, setting
from hygrokf.live.plan import SignalReporting
from hygrokf.live.sources.payload import Field, PayloadMapping
from hygrokf.live.sources.payload_formats import JSON, LARGEST_PAYLOAD, Content, Unreadable
from hygrokf.live.sources.payload_values import RECEIVED
from hygrokf.live.sources.stream import (
    POLL_PAUSE_S,
    Delivery,
    SourceFault,
    SourceKeys,
    SourceState,
    Stream,
)

GROWTHS = 16
"""Number of the latest growths of a file from whose times its usual interval is estimated."""
LONGEST_LINE = LARGEST_PAYLOAD
"""Longest line that is read [bytes]."""
INPUT_READ_SIZE = 65_536
"""Number of bytes read at once from standard input."""
_JSON_LINE = re.compile(r"\s*(\{|\[\s*[{\]])")


class Lines:
    """Interprets lines of text: JSON unchanged, CSV by its header; a repeated header is skipped.

    form: format of the payloads; lines of another format than `JSON`, such as line protocol, are delivered
    unchanged.
    """

    def __init__(self, form: str = JSON) -> None:
        self.header: list[str] = []
        self._form = form
        self._separator = ","
        self._in_long_line = False

    def read_header(self, file: IO[bytes]) -> None:
        """Read a file up to its header, which later rows need, or to its first content without one."""
        while not self.header:
            line = next_line(file)
            if not line or self.content(line) is not None:
                break

    def content(self, line: bytes | str) -> Content | None:
        """Content of a line; None for an empty line, a comment or a header."""
        encoded = line.encode("utf-8", "replace") if isinstance(line, str) else line
        was_in_long_line = self._in_long_line
        self._in_long_line = not encoded.endswith(b"\n") and (was_in_long_line or len(encoded) > LONGEST_LINE)
        if was_in_long_line:  # the rest of a line that is too long
            return None
        if self._in_long_line:
            return Unreadable("too large", f"a line of more than {LONGEST_LINE} bytes")
        try:
            text = encoded.decode("utf-8")
        except UnicodeDecodeError:
            text = encoded.decode("utf-8", "replace")
            if self._form != JSON or self.header or _is_json(text):  # a header is used as far as it is valid
                return Unreadable("malformed", "a line that is not text in UTF-8")
        text = text.strip("\ufeff\r\n")
        if not text.strip() or text.startswith("#"):
            return None
        return text if self._form != JSON or _is_json(text) else self._row(text)

    def _row(self, text: str) -> Content | None:
        """Column name -> cell; None for a header."""
        if not self.header:
            self._separator = max(",;\t", key=text.count)
        try:
            if "\0" in text:
                raise csv.Error("it holds a NUL")
            cells = [c.strip() for c in next(csv.reader([text], delimiter=self._separator), [])]
        except csv.Error as fault:
            return Unreadable("malformed", f"a row that is no CSV: {fault}")
        if not self.header:
            self.header = cells
        if cells == self.header:
            return None
        count = len(self.header)
        if len(cells) < count or any(cells[count:]):  # additional separators at the end of a row are common
            return Unreadable("malformed", f"a row of {len(cells)} cells below a header of {count}")
        return dict(zip(self.header, cells, strict=False))


def _is_json(text: str) -> bool:
    return _JSON_LINE.match(text) is not None


def next_line(file: IO[AnyStr]) -> AnyStr:
    """The next line, or the next piece of a line that is too long; empty at the end of the file."""
    return file.readline(LONGEST_LINE + 1)


def is_whole(line: bytes | str) -> bool:
    """Whether a line is complete: it ends with a line end, or it is a piece of a line that is too long."""
    return len(line) > LONGEST_LINE or line[-1:] in (b"\n", "\n")


def contents(file: IO[AnyStr], lines: Lines) -> Iterator[Content]:
    """The contents of a file's lines up to its end."""
    while line := next_line(file):
        if (content := lines.content(line)) is not None:
            yield content


class TailedFile(Stream):
    """A growing CSV or NDJSON file, read again from its start if it was replaced or truncated.

    The place is "identity offset", so that a different file of the same name is read from its start.  A last
    line without a line end is incomplete and is read again when the file has grown.
    """

    ordered_by = "position in the file"

    def __init__(
        self,
        path: str | os.PathLike[str],
        mapping: PayloadMapping,
        follow: bool = True,
        clock: Callable[[], float] = time.time,
    ) -> None:
        super().__init__(mapping, clock)
        self.path = Path(path)
        self.url = f"file:{self.path}"
        self.follow = follow
        self._growth_times: deque[float] = deque(maxlen=GROWTHS)

    def end_when_read(self) -> None:
        """End at the file's present end instead of following it."""
        self.follow = False

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        while not self._ended.is_set():
            try:
                with self.path.open("rb") as file:
                    status = os.fstat(file.fileno())
                    identity = f"{status.st_dev}.{status.st_ino}"
                    former_identity, _, offset = (place or "").partition(" ")
                    if self._read(file, identity, int(offset) if former_identity == identity else 0, put):
                        return
            except FileNotFoundError:
                if not self.follow:
                    raise SourceFault(f"{self.path}: no such file") from None
                self._state = SourceState("waiting", f"{self.path} does not exist yet")
                self._ended.wait(POLL_PAUSE_S)
            place = None

    def _read(self, file: IO[bytes], identity: str, offset: int, put: Callable[[Delivery], None]) -> bool:
        """Deliver the lines of a file from an offset [bytes] on; returns True if the stream has ended, False
        if the file was removed, replaced or truncated."""
        self._state = SourceState("connected", self.url)
        lines = Lines(self.mapping.form)
        if offset:
            lines.read_header(file)
        file.seek(offset)
        read_until = offset
        while not self._ended.is_set():
            line = next_line(file)
            line_is_whole = is_whole(line)
            if line_is_whole or not self.follow:
                offset += len(line)
                content = lines.content(line)
                if content is not None:
                    put(Delivery(content, self.clock(), place=f"{identity} {offset}"))
                if line_is_whole:
                    continue
                return True
            file.seek(offset)
            if offset > read_until:
                read_until = offset
                self._growth_times.append(time.monotonic())
                if len(self._growth_times) > 1:
                    self.usual_interval_s = float(np.median(np.diff(self._growth_times)))
            self._ended.wait(POLL_PAUSE_S)
            try:
                status = self.path.stat()
            except FileNotFoundError:
                return False
            if status.st_size < offset or f"{status.st_dev}.{status.st_ino}" != identity:
                return False
        return True


class StandardInput(Stream):
    """Lines of standard input until it ends; lines cannot be read again after a restart."""

    url = "stdin"

    def __init__(self, mapping: PayloadMapping, file: IO[Any] | None = None) -> None:
        super().__init__(mapping)
        self._file = file
        self._lines = Lines(mapping.form)
        self._buffer = bytearray()

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        file: IO[Any] = getattr(sys.stdin, "buffer", sys.stdin) if self._file is None else self._file
        descriptor = _descriptor(file)
        while line := next_line(file) if descriptor is None else self._next_line(descriptor):
            if self._ended.is_set():
                return
            content = self._lines.content(line)
            if content is not None:
                put(Delivery(content, self.clock()))

    def _next_line(self, descriptor: int) -> bytes:
        """The next line as `next_line` returns it; empty when the stream is stopped.

        It waits with `select`, because a thread that blocks in a buffered read would keep the process alive.
        """
        searched = 0
        while (end := self._buffer.find(b"\n", searched) + 1) == 0 and len(self._buffer) <= LONGEST_LINE:
            searched, piece = len(self._buffer), b""
            while not self._ended.is_set():
                if select.select([descriptor], [], [], POLL_PAUSE_S)[0]:
                    piece = os.read(descriptor, INPUT_READ_SIZE)
                    break
            if not piece:
                end = len(self._buffer)
                break
            self._buffer += piece
        count = min(end or LONGEST_LINE + 1, LONGEST_LINE + 1)
        line = bytes(self._buffer[:count])
        del self._buffer[:count]
        return line


def _descriptor(file: IO[Any]) -> int | None:
    """The descriptor of a file; None if the file has none, or if the system cannot wait for it."""
    try:
        descriptor = file.fileno()
        select.select([descriptor], [], [], 0.0)
    except (OSError, UnsupportedOperation, ValueError):
        return None
    return descriptor


class Playback(Stream):
    """Plays back messages in real time or faster by a factor.

    messages: (arrival [s], content), sorted by arrival. speed: factor, 0 for as fast as possible. live_s:
    messages before this time [s] are always played as fast as possible. label: text about these data on the
    page.  The place is the number of delivered messages.
    """

    played_back = True

    def __init__(
        self,
        url: str,
        messages: Sequence[tuple[float, Content]],
        mapping: PayloadMapping,
        speed: float = 0.0,
        live_s: float = -math.inf,
        label: str = "",
    ) -> None:
        super().__init__(mapping)
        self.url = url
        self.label = label
        self.speed = speed
        self._live_s = live_s
        self.messages = messages
        self._played = (messages[0][0] if messages else 0.0, math.inf)
        """(arrival of the last committed message [s], monotonic time of its commit [s])"""

    def acknowledge(self, deliveries: Iterable[Delivery]) -> None:
        """Set the record's clock to the arrival of the last committed message."""
        for delivery in deliveries:
            self._played = (delivery.received, time.monotonic())

    def now(self) -> float:
        """The time [s] that playback has reached in the record."""
        arrival, committed = self._played
        if arrival < self._live_s:
            return arrival
        return arrival + self.speed * max(time.monotonic() - committed, 0.0)

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        first = int(place or 0)
        if first >= len(self.messages):
            return
        began, origin = math.nan, 0.0
        for number in range(first, len(self.messages)):
            arrival, content = self.messages[number]
            if self.speed > 0.0 and arrival >= self._live_s:
                if math.isnan(began):
                    began, origin = time.monotonic(), arrival
                self._ended.wait(max((arrival - origin) / self.speed - (time.monotonic() - began), 0.0))
            if self._ended.is_set():
                return
            put(Delivery(content, arrival, place=str(number + 1)))


def record_mapping(record: Record, turbine: str) -> PayloadMapping:
    """The mapping for the messages of a record: each field has the name of its signal, in SI units."""
    fields = {s.signal: Field(s.signal, SIGNALS[s.signal].unit, line_form(s)) for s in record.series}
    return PayloadMapping(fields, turbines={turbine: turbine})


def line_form(series: Series) -> SignalReporting:
    """The form of readings in a series."""
    return SignalReporting(**{field.name: getattr(series, field.name) for field in fields(SignalReporting)})


def record_messages(record: Record, turbine: str) -> list[tuple[float, Content]]:
    """(time [s], content) of every reading of a record, sorted by time and signal."""
    rows = [
        (t, s.signal, v)
        for s in record.series
        for t, v in zip(s.time[~s.missing].tolist(), s.value[~s.missing].tolist(), strict=True)
    ]
    return [(t, {"turbine": turbine, "time": t, signal: v}) for t, signal, v in sorted(rows)]


def delay_and_repeat(
    messages: Iterable[tuple[float, Content]], late_s: float = 0.0, repeated: float = 0.0, seed: int = 0
) -> list[tuple[float, Content]]:
    """Messages with random delays up to `late_s` [s] and a share `repeated` [1] of duplicates, sorted by
    arrival.

    The same seed gives the same messages.
    """
    random = np.random.default_rng(seed)
    delayed: list[tuple[float, int, Content]] = []
    for arrival, content in messages:
        for _ in range(1 + int(random.random() < repeated)):
            delayed.append((arrival + late_s * float(random.random()), len(delayed), content))
    return [(arrival, content) for arrival, _, content in sorted(delayed, key=lambda row: row[:2])]


# -- from the tracker's file ---------------------------------------------------------------------------------
@dataclass(frozen=True)
class FileForm(SourceKeys):
    """A [[source]] of `file:PATH`: a file that is followed as it grows or, with `speed`, played back.

    Playback runs at `speed` times real time; rows are delayed by up to `late`, and a share `repeated` of them
    is duplicated.
    """

    url: str = setting(help="file:PATH")
    follow: bool = setting(True, "false: read to its end")
    speed: float | None = setting(None, "of playback over real time; 0: as fast as possible", least=0.0)
    late_s: float = setting(0.0, "by which a row may be delayed", read=duration)
    repeated: float = setting(0.0, "share of rows that come twice", least=0.0, most=1.0)
    seed: int = setting(0, "of what is delayed and repeated", least=0)

    @across("repeated", "late", "speed")
    def of_playback(self) -> str | None:
        if self.speed is not None or not (self.late_s or self.repeated):
            return None
        return "late and repeated need a speed: they are for playing back"

    def stream(self, mapping: PayloadMapping, place: Place) -> Stream | None:
        """The stream; None, with a fault at `place`, if a file that is played back has no rows."""
        if RECEIVED in mapping.time:
            place.fault(
                f'time = "{RECEIVED}" is for sources that send by themselves; rows of a file need a time: '
                "state another time in its [source.mapping]"
            )
        path = self.folder / self.url.removeprefix("file:").removeprefix("//")
        if self.speed is None:
            return TailedFile(path, mapping, self.follow)
        try:
            rows = file_messages(path, mapping)
        except OSError as fault:
            place.fault(f"{path}: {fault.strerror}; a file that is played back must be there")
            return None
        if not rows:
            place.fault(f"{path}: no row with a time that can be read")
            return None
        url = f"file:{path}?late={self.late_s:g}&repeated={self.repeated:g}&seed={self.seed}"
        messages = delay_and_repeat(rows, self.late_s, self.repeated, self.seed)
        return Playback(url, messages, mapping, self.speed)


@dataclass(frozen=True)
class InputForm(SourceKeys):
    """A [[source]] of `stdin`."""

    url: str = setting(help="stdin")

    def stream(self, mapping: PayloadMapping, place: Place) -> Stream:
        return StandardInput(mapping)


def file_messages(path: Path, mapping: PayloadMapping) -> list[tuple[float, Content]]:
    """(time [s], content) of a file's rows with a readable time, sorted by time."""
    with path.open("rb") as file:
        stamped = [(mapping.stamp(content), content) for content in contents(file, Lines(mapping.form))]
    return sorted(((at, content) for at, content in stamped if at is not None), key=lambda row: row[0])
