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
"""Number of a file's latest growths from which the usual interval between growths is estimated."""
LONGEST_LINE = LARGEST_PAYLOAD
"""Longest line that is read [bytes]."""
INPUT_READ_SIZE = 65_536
"""Number of bytes read at once from standard input."""
_JSON_LINE = re.compile(r"\s*(\{|\[\s*[{\]])")
"""Beginning of a line that holds a JSON object or an array of objects."""


class Lines:
    """Converts lines of text to contents: a JSON line stays text, a CSV row becomes column name -> cell by
    the header; a repeated header is skipped.

    form: format of the payloads (`payload_formats.FORMATS`); lines of other formats than JSON stay text.
    """

    def __init__(self, form: str = JSON) -> None:
        self.header: list[str] = []
        self._form = form
        self._separator = ","
        self._in_long_line = False

    def read_header(self, file: IO[bytes]) -> None:
        """Read a file up to its CSV header, which later rows need, or to its first content without one."""
        while not self.header:
            line = next_line(file)
            if not line or self.content(line) is not None:
                break

    def content(self, line: bytes | str) -> Content | None:
        """Return the content of a line; None for an empty line, a comment or a header."""
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
        """Return column name -> cell of a CSV row; None for the header."""
        if not self.header:
            self._separator = max(",;\t", key=text.count)
        try:
            if "\0" in text:
                raise csv.Error("it holds a NUL")
            cells = [cell.strip() for cell in next(csv.reader([text], delimiter=self._separator), [])]
        except csv.Error as fault:
            return Unreadable("malformed", f"a row that is not valid CSV: {fault}")
        if not self.header:
            self.header = cells
        if cells == self.header:
            return None
        column_count = len(self.header)
        # additional separators at the end of a row are common
        if len(cells) < column_count or any(cells[column_count:]):
            return Unreadable("malformed", f"a row of {len(cells)} cells below a header of {column_count}")
        return dict(zip(self.header, cells, strict=False))


def _is_json(text: str) -> bool:
    """Whether a line holds a JSON object or an array of objects."""
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

    The place is the text "DEVICE.INODE OFFSET", so that a different file of the same name is read from its
    start.  A last line without a line end is incomplete and is read again when the file has grown.
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
        """Read the file whenever it exists, from the stored offset or, if it was replaced, from its start."""
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
        """Deliver the lines of a file from an offset [bytes] on.

        Returns True if the stream has ended, False if the file was removed, replaced or truncated.
        """
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
        """Deliver the lines of standard input until its end."""
        file: IO[Any] = getattr(sys.stdin, "buffer", sys.stdin) if self._file is None else self._file
        descriptor = _descriptor(file)
        while line := next_line(file) if descriptor is None else self._next_line(descriptor):
            if self._ended.is_set():
                return
            content = self._lines.content(line)
            if content is not None:
                put(Delivery(content, self.clock()))

    def _next_line(self, descriptor: int) -> bytes:
        """Return the next line as `next_line` does; empty at the end of the input or when the stream is
        stopped.

        Waits with `select`, because a thread that blocks in a buffered read would keep the process alive.
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
    """Plays back recorded messages in real time or faster.

    messages: (arrival [s], content), sorted by arrival. speed: multiple of real time, 0 for as fast as
    possible. live_s: messages before this time [s] are always played as fast as possible. label: text about
    these data on the page.  The place is the number of delivered messages.
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
        self._last_committed = (messages[0][0] if messages else 0.0, math.inf)
        """(arrival of the last committed message [s], monotonic time of its commit [s])"""

    def acknowledge(self, deliveries: Iterable[Delivery]) -> None:
        """Set the record's clock to the arrival of the last committed message."""
        for delivery in deliveries:
            self._last_committed = (delivery.received, time.monotonic())

    def now(self) -> float:
        """Return the time [s] that playback has reached in the record."""
        arrival_s, committed_s = self._last_committed
        if arrival_s < self._live_s:
            return arrival_s
        return arrival_s + self.speed * max(time.monotonic() - committed_s, 0.0)

    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        """Deliver the messages that follow the first `place` ones, each at its time."""
        first = int(place or 0)
        if first >= len(self.messages):
            return
        began_s, first_live_s = math.nan, 0.0  # monotonic time of the first timed message, and its arrival
        for number in range(first, len(self.messages)):
            arrival, content = self.messages[number]
            if self.speed > 0.0 and arrival >= self._live_s:
                if math.isnan(began_s):
                    began_s, first_live_s = time.monotonic(), arrival
                due_s = began_s + (arrival - first_live_s) / self.speed
                self._ended.wait(max(due_s - time.monotonic(), 0.0))
            if self._ended.is_set():
                return
            put(Delivery(content, arrival, place=str(number + 1)))


def record_mapping(record: Record, turbine: str) -> PayloadMapping:
    """Return the mapping for `record_messages`: each field has the name of its signal, in SI units."""
    fields = {
        series.signal: Field(series.signal, SIGNALS[series.signal].unit, line_form(series))
        for series in record.series
    }
    return PayloadMapping(fields, turbines={turbine: turbine})


def line_form(series: Series) -> SignalReporting:
    """Return how a source would report the readings of a series."""
    return SignalReporting(**{field.name: getattr(series, field.name) for field in fields(SignalReporting)})


def record_messages(record: Record, turbine: str) -> list[tuple[float, Content]]:
    """Return (time [s], payload) of every reading of a record, sorted by time and signal."""
    readings: list[tuple[float, str, float]] = []
    for series in record.series:
        times, values = (array[~series.missing].tolist() for array in (series.time, series.value))
        readings += [(at, series.signal, value) for at, value in zip(times, values, strict=True)]
    return [(at, {"turbine": turbine, "time": at, signal: value}) for at, signal, value in sorted(readings)]


def delay_and_repeat(
    messages: Iterable[tuple[float, Content]], late_s: float = 0.0, repeated: float = 0.0, seed: int = 0
) -> list[tuple[float, Content]]:
    """Delay messages (arrival [s], content) randomly by up to `late_s` [s] and duplicate the share `repeated`
    [1] of them; returns them sorted by arrival.

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
    follow: bool = setting(True, "whether the file is followed as it grows, or read once to its end")
    speed: float | None = setting(
        None, "playback as a multiple of real time; 0: as fast as possible", least=0.0
    )
    late_s: float = setting(0.0, "largest random delay of a row", read=duration)
    repeated: float = setting(0.0, "share of rows that are delivered twice", least=0.0, most=1.0)
    seed: int = setting(0, "seed of the random delays and repetitions", least=0)

    @across("repeated", "late", "speed")
    def of_playback(self) -> str | None:
        if self.speed is not None or not (self.late_s or self.repeated):
            return None
        return "late and repeated need a speed: they apply to playback only"

    def stream(self, mapping: PayloadMapping, place: Place) -> Stream | None:
        """Return the stream; None, with a fault at `place`, if a file to be played back cannot be read or has
        no rows."""
        if RECEIVED in mapping.time:
            place.fault(
                f'time = "{RECEIVED}" is for sources that send by themselves; rows of a file need a time: '
                "state the field with the time in its [source.mapping]"
            )
        path = self.folder / self.url.removeprefix("file:").removeprefix("//")
        if self.speed is None:
            return TailedFile(path, mapping, self.follow)
        try:
            rows = file_messages(path, mapping)
        except OSError as fault:
            place.fault(f"{path}: {fault.strerror}; a file that is played back must exist at the start")
            return None
        if not rows:
            place.fault(
                f"{path}: no row has a time that can be read; check time and time_format in [mapping]"
            )
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
    """Return (time [s], content) of a file's rows with a readable time, sorted by time."""
    rows: list[tuple[float, Content]] = []
    with path.open("rb") as file:
        for content in contents(file, Lines(mapping.form)):
            stamp_s = mapping.stamp(content)
            if stamp_s is not None:
                rows.append((stamp_s, content))
    return sorted(rows, key=lambda row: row[0])
