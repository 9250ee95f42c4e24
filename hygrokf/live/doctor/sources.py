"""Checks of a tracker's sources, all at the same time: whether they can be reached, and what they deliver."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.data.timestamps import DAY_S, HOUR_S, stamp_text
from hygrokf.live.doctor.check import (
    OLD_S,
    Check,
    doubt,
    fault,
    lasting,
    ok,
    payload_checks,
    server_check,
    stamp_check,
)
from hygrokf.live.doctor.mqtt import mqtt_checks, sparkplug_checks
from hygrokf.live.doctor.opcua import opcua_checks
from hygrokf.live.sources.local import Lines, Playback, TailedFile, is_whole, next_line
from hygrokf.live.sources.mqtt import Mqtt
from hygrokf.live.sources.opcua import OpcUa
from hygrokf.live.sources.payload_statistics import PayloadStatistics
from hygrokf.live.sources.postgres import LOWEST, TIMES, PostgresQuery, reason_of, rows_above
from hygrokf.live.sources.sparkplug import Sparkplug
from hygrokf.live.sources.stream import PAUSE_S, SourceFault, Stream
from hygrokf.live.storage.database import Row

if TYPE_CHECKING:
    import psycopg

TAIL = 4_000_000
"""[bytes] read from the end of a file."""


REACH = "check url, password and query of this [[source]], and that the server runs"
MOST_ROWS = 20_000
"""Rows examined at most."""
SPANS_S = (600.0, 2.0 * HOUR_S, DAY_S, 30.0 * DAY_S)
"""How far back rows are looked for [s]: the shortest span that has any."""


def examine_sources(
    streams: Sequence[Stream], wait_s: float, lateness_s: float
) -> list[tuple[tuple[Check, ...], PayloadStatistics]]:
    """The checks of every source, and a statistics of its payloads; those that send by themselves are
    observed for `wait_s` [s]."""
    done: dict[int, tuple[tuple[Check, ...], PayloadStatistics]] = {}
    failed: list[BaseException] = []

    def examine(number: int, stream: Stream) -> None:
        statistics = PayloadStatistics(stream.mapping)
        try:
            done[number] = tuple(_checks(stream, statistics, wait_s, lateness_s)), statistics
        except BaseException as error:
            failed.append(error)

    # daemon threads, so that an interruption does not wait for them
    threads = [
        threading.Thread(target=examine, args=(number, stream), name=f"doctor {stream.url}", daemon=True)
        for number, stream in enumerate(streams)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failed:
        raise failed[0]
    return [done[number] for number in range(len(streams))]


def _checks(
    stream: Stream, statistics: PayloadStatistics, wait_s: float, lateness_s: float
) -> Iterator[Check]:
    about = f"source {stream.url}"
    checks_of_kind = next((checks for kind, checks in KINDS.items() if isinstance(stream, kind)), None)
    if checks_of_kind is None:
        yield ok(about, "can be read only while the tracker runs; not examined")
    else:
        yield from checks_of_kind(stream, statistics, wait_s, lateness_s)
    if stream.mapping.weather and statistics.newest:
        ahead = max(statistics.newest.values()) - time.time()
        said = f"its weather forecast reaches {lasting(ahead)} ahead"
        need = "deliver at least a day: shorter forecasts are not used"
        yield doubt(about, said, need) if ahead < DAY_S else ok(about, said)


def playback_checks(
    stream: Playback, statistics: PayloadStatistics, wait_s: float, lateness_s: float
) -> Iterator[Check]:
    """Check what the rows of a played-back file give."""
    for at, content in stream.messages:
        statistics.take(content, at)
    yield from payload_checks(f"source {stream.url}", statistics, "rows that are played back")


def file_checks(
    stream: TailedFile, statistics: PayloadStatistics, wait_s: float, lateness_s: float
) -> Iterator[Check]:
    """Check that a followed file exists, is readable and grows, and what its last rows give."""
    about, path = f"source {stream.url}", stream.path
    try:
        found = path.stat()
        size, written = found.st_size, found.st_mtime
        read_rows(path, statistics)
    except FileNotFoundError:
        waits = "does not exist yet; the tracker waits for it"
        if not stream.follow:
            yield fault(about, "no such file", "check the path")
        elif path.parent.is_dir():
            yield doubt(about, waits, "check the path and the program that writes the file")
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
    if not statistics.payloads:
        yield doubt(
            about, "it has no rows yet", "write a line of names and then rows, or one JSON object per line"
        )
    yield from payload_checks(about, statistics, "last rows")
    if statistics.newest and not stream.mapping.weather:
        newest = max(statistics.newest.values())
        yield _newest_reading(about, newest, "check the program that writes the file")
        stamped = stamp_check(f"{about} as it was last written", min(statistics.lag_s, written - newest))
        if stamped is not None and stamped.level != "ok":
            yield stamped


def _newest_reading(about: str, newest: float, remedy: str, judged: bool = True) -> Check:
    """The time [s] of the newest reading, with doubt where it is old, unless its age is not `judged`."""
    age = time.time() - newest
    said = f"its newest reading is from {stamp_text(newest)}, {lasting(max(age, 0.0))} ago"
    return doubt(about, said, remedy) if judged and age > OLD_S else ok(about, said)


def _growth(about: str, path: Path, size: int, written: float, wait_s: float) -> Check:
    """Whether a file grows within `wait_s` [s], or else when it last did."""
    end = time.monotonic() + wait_s
    while time.monotonic() < end:
        try:
            now = path.stat().st_size
        except FileNotFoundError:
            now = -1
        if now > size:
            return ok(about, f"it grows: {now - size} bytes more within {lasting(wait_s)}")
        if now < size:
            return doubt(
                about,
                "it was replaced or truncated just now",
                "append to it; the tracker reads a replaced file from its start",
            )
        time.sleep(PAUSE_S)
    age = time.time() - written
    said = f"it has not grown within {lasting(wait_s)}; it was last written {lasting(max(age, 0.0))} ago"
    return doubt(about, said, "check the program that writes the file") if age > OLD_S else ok(about, said)


def read_rows(path: Path, statistics: PayloadStatistics) -> None:
    """Count the rows of a file in a statistics; of a long file only the last ones."""
    lines, now = Lines(statistics.mapping.form), time.time()
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > TAIL:
            lines.read_header(file)
            file.seek(size - TAIL)
            file.readline()
        while is_whole(line := next_line(file)):
            content = lines.content(line)
            if content is not None:
                statistics.take(content, now)


def postgres_checks(
    source: PostgresQuery, statistics: PayloadStatistics, wait_s: float, lateness_s: float
) -> Iterator[Check]:
    """Connect, run the query for its newest rows, and read them."""
    about = f"source {source.url}"
    try:
        yield from _postgres_checks(source, statistics, about)
    except SourceFault as error:
        yield fault(about, str(error), REACH)
    except Exception as error:  # of the driver, which only the source imports
        yield fault(about, f"the query cannot be run: {reason_of(error)}", REACH)


def _postgres_checks(source: PostgresQuery, statistics: PayloadStatistics, about: str) -> Iterator[Check]:
    with closing(source.open()) as connection:
        columns = source.columns(connection)
        yield ok(about, f"connected; the query gives {', '.join(columns.names)}")
        before = time.time()
        (shown,) = connection.execute("SELECT clock_timestamp()").fetchone() or (None,)
        if isinstance(shown, datetime):
            yield server_check(about, shown.timestamp() - 0.5 * (before + time.time()))
        rows, span, took_s = _newest_rows(source, columns.kind, connection)
    if not rows:
        yield doubt(about, f"no {span}", "check the query and the program that fills its table")
        return
    now = time.time()
    for row in rows:
        columns.watermark(row)
        statistics.take(columns.payload(row), now)
    yield from payload_checks(about, statistics, span)
    if took_s > source.form.poll_s:
        yield doubt(
            about,
            f"the query took {lasting(took_s)}, longer than poll ({lasting(source.form.poll_s)})",
            f"create an index on {source.form.watermark}, or poll less often",
        )
    if statistics.newest and not statistics.mapping.weather:
        newest, remedy = max(statistics.newest.values()), "check the program that fills its table"
        yield _newest_reading(about, newest, remedy, columns.kind in TIMES)
        ahead = stamp_check(about, statistics.lag_s, fresh=False)
        if ahead is not None and ahead.level != "ok":
            yield ahead


def _newest_rows(
    source: PostgresQuery, kind: str, connection: psycopg.Connection[Row]
) -> tuple[list[Row], str, float]:
    """Rows of the shortest span that has any, the name of the span, and how long the query took [s]."""
    found: list[Row] = []
    said, took_s = "rows", 0.0
    for after, said in _starts(kind):  # noqa: B007
        began = time.monotonic()
        with closing(rows_above(connection, source.form.query, after)) as rows:
            found = list(islice(rows, MOST_ROWS))
        took_s = time.monotonic() - began
        if found:
            break
    return found, said, took_s


def _starts(kind: str) -> Iterator[tuple[str, str]]:
    """Watermarks above which rows are looked for, each with the name of those rows."""
    if kind in TIMES:
        for span in SPANS_S:
            since = datetime.fromtimestamp(time.time() - span, UTC)
            yield since.isoformat(), f"rows of the last {lasting(span)}"
    else:
        yield LOWEST[kind], "first rows"


KINDS: Mapping[type[Stream], Callable[..., Iterator[Check]]] = {
    TailedFile: file_checks,
    Playback: playback_checks,
    Sparkplug: sparkplug_checks,
    Mqtt: mqtt_checks,
    OpcUa: opcua_checks,
    PostgresQuery: postgres_checks,
}
"""Kind of source -> its checks, a function of (stream, statistics, wait_s, lateness_s); a kind stands before
the one that it extends."""
