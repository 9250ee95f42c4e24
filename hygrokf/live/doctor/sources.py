"""The sources of a tracker, one by one and all at the same time: whether they are reached, and what they give."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from hygrokf.data.timestamps import stamp_text
from hygrokf.live.doctor.check import Check, doubt, fault, lasting, ok
from hygrokf.live.doctor.clock import stamp_check
from hygrokf.live.doctor.mqtt import mqtt_checks, tally_checks
from hygrokf.live.doctor.opcua import opcua_checks
from hygrokf.live.payload_statistics import Tally
from hygrokf.live.sources.mqtt import Mqtt
from hygrokf.live.sources.opcua import OpcUa
from hygrokf.live.sources.streams import LONGEST_LINE, PAUSE_S, Lines, Playback, Stream, TailedFile

TAIL = 4_000_000
"""[bytes] at the end of a file that are read."""
DAY_S = 86400.0
OLD_S = 7200.0
"""[s] since a file was last written, or its newest reading, from which nobody may write it any more."""


@dataclass(frozen=True)
class Examined:
    """What was found of a source, and what it gave meanwhile."""

    checks: tuple[Check, ...]
    tally: Tally


def examined(streams: Sequence[Stream], wait_s: float, lateness_s: float) -> list[Examined]:
    """Every source; those that speak by themselves are listened to for `wait_s` [s]."""

    found: dict[int, Examined | BaseException] = {}

    def one(number: int, stream: Stream) -> None:
        tally = Tally(stream.mapping)
        try:
            found[number] = Examined(tuple(_checks(stream, tally, wait_s, lateness_s)), tally)
        except BaseException as error:
            found[number] = error

    # daemons: who breaks off does not wait for them
    threads = [
        threading.Thread(target=one, args=(number, stream), name=f"doctor {stream.url}", daemon=True)
        for number, stream in enumerate(streams)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    results = []
    for number in range(len(streams)):
        made = found[number]
        if isinstance(made, BaseException):
            raise made
        results.append(made)
    return results


def _checks(stream: Stream, tally: Tally, wait_s: float, lateness_s: float) -> Iterator[Check]:
    about = f"source {stream.url}"
    if isinstance(stream, Mqtt):
        yield from mqtt_checks(stream.broker, stream.mapping, tally, wait_s, lateness_s)
    elif isinstance(stream, OpcUa):
        yield from opcua_checks(stream, tally, wait_s)
    elif isinstance(stream, TailedFile):
        yield from _file_checks(stream, tally, wait_s)
    elif isinstance(stream, Playback):
        for at, content in stream.messages:
            tally.take(content, at)
        yield from tally_checks(about, tally, "rows that are played back")
    else:
        yield ok(about, "is read when the tracker runs; it cannot be looked at before")
    if stream.mapping.weather and tally.newest:
        ahead = max(tally.newest.values()) - time.time()
        said = f"its weather forecast reaches {lasting(ahead)} ahead"
        need = "deliver a day of it at least: what is shorter is not used"
        yield doubt(about, said, need) if ahead < DAY_S else ok(about, said)


def _file_checks(stream: TailedFile, tally: Tally, wait_s: float) -> Iterator[Check]:
    """A file that is followed: there, readable, growing, and what its last rows give."""
    about, path = f"source {stream.url}", stream.path
    try:
        size, written = _state(path)
        read_rows(path, tally)
    except FileNotFoundError:
        waits = "does not exist yet; the tracker waits for it"
        if not stream.follow:
            yield fault(about, "no such file", "check the path")
        elif path.parent.is_dir():
            yield doubt(about, waits, "check the path, and whatever writes it")
        else:
            yield fault(about, f"its folder {path.parent} does not exist", "check the path")
        return
    except OSError as error:
        yield fault(
            about, f"cannot be read: {error.strerror}", "check its permissions for the user of the tracker"
        )
        return
    if stream.follow:
        yield _growth(about, path, size, written, wait_s)
    if not tally.payloads:
        yield doubt(
            about, "no row in it yet", "a first line with names, then rows; or one JSON object a line"
        )
    yield from tally_checks(about, tally, "last rows")
    if tally.newest and not stream.mapping.weather:
        newest = max(tally.newest.values())
        age = time.time() - newest
        said = f"its newest reading is of {stamp_text(newest)}, {lasting(max(age, 0.0))} ago"
        yield doubt(about, said, "look at whatever writes it") if age > OLD_S else ok(about, said)
        found = stamp_check(f"{about} as it was last written", min(tally.lag_s, written - newest))
        if found is not None and found.level != "ok":
            yield found


def _state(path: Path) -> tuple[int, float]:
    """Size [bytes] and when it was last written [s]."""
    found = os.stat(path)
    return found.st_size, found.st_mtime


def _growth(about: str, path: Path, size: int, written: float, wait_s: float) -> Check:
    """Whether it grows within `wait_s` [s], or else how long ago it did."""
    end = time.monotonic() + wait_s
    while time.monotonic() < end:
        try:
            now = _state(path)[0]
        except FileNotFoundError:
            now = -1
        if now > size:
            return ok(about, f"it grows: {now - size} bytes more within {lasting(wait_s)}")
        if now < size:
            return doubt(
                about, "it was replaced or cut just now", "append to it; the tracker begins such a file anew"
            )
        time.sleep(PAUSE_S)
    age = time.time() - written
    said = f"it has not grown within {lasting(wait_s)}; it was last written {lasting(max(age, 0.0))} ago"
    return doubt(about, said, "look at whatever writes it") if age > OLD_S else ok(about, said)


def read_rows(path: Path, tally: Tally) -> None:
    """Put the rows of a file into a tally, of a long file the last ones."""
    lines, now = Lines(), time.time()
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > TAIL:
            while not lines.header:  # rows further down need the header
                line = file.readline(LONGEST_LINE)
                if not line or lines.content(line.decode("utf-8", "replace")):
                    break
            file.seek(size - TAIL)
            file.readline()
        while (line := file.readline(LONGEST_LINE)).endswith(b"\n"):  # one without its end is not yet a line
            content = lines.content(line.decode("utf-8", "replace"))
            if content is not None:
                tally.take(content, now)
