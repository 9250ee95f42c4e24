"""Checks of a tracker's sources, all at the same time: whether they can be reached, and what they deliver."""

from __future__ import annotations

import asyncio
import os
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from hygrokf.data.timestamps import DAY_S, HOUR_S, stamp_text
from hygrokf.live.doctor.check import Check, doubt, fault, lasting, ok
from hygrokf.live.doctor.machine import server_check, stamp_check
from hygrokf.live.doctor.mqtt import mqtt_checks, payload_checks
from hygrokf.live.sources.mqtt import Mqtt
from hygrokf.live.sources.opcua import OpcUa
from hygrokf.live.sources.opcua_client import Connection
from hygrokf.live.sources.opcua_samples import ConnectionFault, HistoryFault, Node, Sample
from hygrokf.live.sources.payload import PayloadStatistics
from hygrokf.live.sources.streams import LONGEST_LINE, PAUSE_S, Lines, Playback, Stream, TailedFile, several

TAIL = 4_000_000
"""[bytes] read from the end of a file."""
OLD_S = 2.0 * HOUR_S
"""Age [s] from which a file or a value may no longer be updated."""
BACK_S = DAY_S
"""Length of the requested history [s]."""
ASKED = 20
"""Largest number of nodes whose history is requested."""
REACH = "check url, certificates and user of this [[source]], and that the server runs"


@dataclass(frozen=True)
class Examined:
    """The checks of a source, and a statistics of its payloads."""

    checks: tuple[Check, ...]
    statistics: PayloadStatistics


def examined(streams: Sequence[Stream], wait_s: float, lateness_s: float) -> list[Examined]:
    """Examine every source; those that send by themselves are observed for `wait_s` [s]."""

    found: dict[int, Examined] = {}
    failed: list[BaseException] = []

    def one(number: int, stream: Stream) -> None:
        statistics = PayloadStatistics(stream.mapping)
        try:
            found[number] = Examined(tuple(_checks(stream, statistics, wait_s, lateness_s)), statistics)
        except BaseException as error:
            failed.append(error)

    # daemon threads, so that an interruption does not wait for them
    threads = [
        threading.Thread(target=one, args=(number, stream), name=f"doctor {stream.url}", daemon=True)
        for number, stream in enumerate(streams)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failed:
        raise failed[0]
    return [found[number] for number in range(len(streams))]


def _checks(
    stream: Stream, statistics: PayloadStatistics, wait_s: float, lateness_s: float
) -> Iterator[Check]:
    about = f"source {stream.url}"
    if isinstance(stream, Mqtt):
        yield from mqtt_checks(stream.broker, stream.mapping, statistics, wait_s, lateness_s)
    elif isinstance(stream, OpcUa):
        yield from opcua_checks(stream, statistics, wait_s)
    elif isinstance(stream, TailedFile):
        yield from _file_checks(stream, statistics, wait_s)
    elif isinstance(stream, Playback):
        for at, content in stream.messages:
            statistics.take(content, at)
        yield from payload_checks(about, statistics, "rows that are played back")
    else:
        yield ok(about, "can be read only while the tracker runs; not examined")
    if stream.mapping.weather and statistics.newest:
        ahead = max(statistics.newest.values()) - time.time()
        said = f"its weather forecast reaches {lasting(ahead)} ahead"
        need = "deliver at least a day: shorter forecasts are not used"
        yield doubt(about, said, need) if ahead < DAY_S else ok(about, said)


def _file_checks(stream: TailedFile, statistics: PayloadStatistics, wait_s: float) -> Iterator[Check]:
    """Check that a followed file exists, is readable and grows, and what its last rows give."""
    about, path = f"source {stream.url}", stream.path
    try:
        size, written = _state(path)
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
        age = time.time() - newest
        said = f"its newest reading is from {stamp_text(newest)}, {lasting(max(age, 0.0))} ago"
        yield doubt(about, said, "check the program that writes the file") if age > OLD_S else ok(about, said)
        found = stamp_check(f"{about} as it was last written", min(statistics.lag_s, written - newest))
        if found is not None and found.level != "ok":
            yield found


def _state(path: Path) -> tuple[int, float]:
    """Size of a file [bytes] and time of its last write [s]."""
    found = os.stat(path)
    return found.st_size, found.st_mtime


def _growth(about: str, path: Path, size: int, written: float, wait_s: float) -> Check:
    """Whether a file grows within `wait_s` [s], or else when it last did."""
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
    lines, now = Lines(), time.time()
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > TAIL:
            while not lines.header:  # later rows need the header
                line = file.readline(LONGEST_LINE)
                if not line or lines.content(line.decode("utf-8", "replace")):
                    break
            file.seek(size - TAIL)
            file.readline()
        while (line := file.readline(LONGEST_LINE)).endswith(b"\n"):  # a line without its end is incomplete
            content = lines.content(line.decode("utf-8", "replace"))
            if content is not None:
                statistics.take(content, now)


# -- OPC UA --------------------------------------------------------------------------------------------------
def opcua_checks(source: OpcUa, statistics: PayloadStatistics, wait_s: float) -> list[Check]:
    """Connect, subscribe, and wait up to `wait_s` [s] for the first values, which go into the statistics."""
    return asyncio.run(_examined(source, statistics, wait_s))


async def _examined(source: OpcUa, statistics: PayloadStatistics, wait_s: float) -> list[Check]:
    about, connection = f"source {source.url}", source.connection()
    try:
        await connection.open()
        checks = [ok(about, "connected")]
        checks += await _clock(connection, about)
        refused = await connection.subscribe(source.nodes)
        first = await _first(connection, set(source.nodes) - set(refused), wait_s)
        there = [node for node in source.nodes if node not in refused]
        checks += _node_checks(about, source.nodes, refused, first, wait_s)
        checks += await _histories(connection, about, there)
        for one in first.values():
            delivery = source.delivery(one)
            statistics.take(delivery.content, delivery.received)
        checks += payload_checks(about, statistics, "values")
        found = stamp_check(about, statistics.lag_s, fresh=False)
        return checks + ([found] if found else [])
    except ConnectionFault as error:
        return [fault(about, str(error), REACH)]
    finally:
        await connection.close()


async def _clock(connection: Connection, about: str) -> list[Check]:
    before = time.time()
    try:
        shown = await connection.server_time()
    except ConnectionFault:  # the tracker does not need to read the clock
        return []
    return [server_check(about, shown - 0.5 * (before + time.time()))]


async def _first(connection: Connection, awaited: set[Node], wait_s: float) -> dict[Node, Sample]:
    """The newest sample of each node, once all nodes have one or the time is over."""
    found: dict[Node, Sample] = {}
    end = time.monotonic() + wait_s
    while awaited - set(found) and time.monotonic() < end:
        connection.check()
        found.update({one.node: one for one in await connection.samples(PAUSE_S)})
    return found


def _node_checks(
    about: str, nodes: Sequence[Node], refused: dict[Node, str], first: dict[Node, Sample], wait_s: float
) -> list[Check]:
    """One check per kind of problem, and one for the nodes without problems."""
    checks = []
    if refused:
        said = several(f"{node.id} ({word})" for node, word in refused.items())
        checks.append(
            fault(
                about,
                f"{len(refused)} of {len(nodes)} nodes do not exist or are denied: {said}",
                "compare the ids with the server's address space, and give this user the right to read them",
            )
        )
    silent = [node.id for node in nodes if node not in refused and node not in first]
    if silent:
        checks.append(
            doubt(
                about,
                f"no value of {several(silent)} within {lasting(wait_s)}",
                "wait longer (--wait 1min), or check whether the server samples these nodes",
            )
        )
    now = time.time()
    wanting = {
        "values that are not good": {n: one.word for n, one in first.items() if one.quality != "good"},
        f"values older than {lasting(OLD_S)}": {
            n: stamp_text(one.time) for n, one in first.items() if one.time and now - one.time > OLD_S
        },
        "values without a time stamp, which are not used": {
            n: "no stamp" for n, one in first.items() if one.time is None and one.quality == "good"
        },
    }
    for words, found in wanting.items():
        if found:
            said = several(f"{node.id} ({word})" for node, word in found.items())
            checks.append(
                doubt(about, f"{words}: {said}", "check the sensor and its connection to the server")
            )
    fine = set(first).difference(*wanting.values())
    if fine:
        checks.append(ok(about, f"{len(fine)} of {len(nodes)} nodes have a good value"))
    return checks


async def _histories(connection: Connection, about: str, nodes: Sequence[Node]) -> list[Check]:
    """Whether the server keeps the history of nodes, without which samples during an outage are lost."""
    asked, unread, now = list(nodes)[:ASKED], {}, time.time()
    for node in asked:
        try:
            await anext(connection.history(node, now - BACK_S, now), None)
        except HistoryFault as error:
            unread[node] = str(error)
    if unread:
        said = several(f"{node.id} ({word})" for node, word in unread.items())
        return [
            doubt(
                about,
                f"no history of {len(unread)} of {len(asked)} nodes: {said}",
                "enable history on the server and let this user read it: otherwise samples are lost while "
                "the tracker is not running",
            )
        ]
    return [ok(about, f"the server keeps the history of the {len(asked)} nodes examined")] if asked else []
