"""Checks of a tracker's sources, all at the same time: whether they can be reached, and what they deliver.

At a broker the doctor listens in its own temporary session and neither takes over the tracker's session nor
reads from it.
"""

from __future__ import annotations

import asyncio
import math
import os
import queue
import secrets
import ssl
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.live.doctor.check import (
    OLD_S,
    SECRETS,
    Check,
    doubt,
    fault,
    lasting,
    of_names,
    ok,
    payload_checks,
    server_check,
    stamp_check,
    validity_check,
)
from hygrokf.live.sources.broker import Broker
from hygrokf.live.sources.local import Lines, Playback, TailedFile, is_whole, next_line
from hygrokf.live.sources.mqtt import Arrival, BrokerLink, Mqtt
from hygrokf.live.sources.opcua import OpcUa
from hygrokf.live.sources.opcua_client import Connection, HistoryFault, Sample
from hygrokf.live.sources.opcua_form import Node
from hygrokf.live.sources.payload import PayloadStatistics
from hygrokf.live.sources.payload_formats import Unreadable
from hygrokf.live.sources.postgres import LOWEST, TIMES, PostgresQuery, reason_of, rows_above
from hygrokf.live.sources.sparkplug import ASK, EdgeNodes, Sparkplug
from hygrokf.live.sources.sparkplug_node import UNEXPLAINED
from hygrokf.live.sources.stream import PAUSE_S, SourceFault, Stream
from hygrokf.live.storage.database import Row
from hygrokf.texts.wording import stamp_text

if TYPE_CHECKING:
    import psycopg

ANSWER_S = 10.0
"""[s] allowed for a broker to accept the client and answer its subscription."""
REACH = "check url, user, password and certificates of this [[source]], and that the broker runs"
KEPT = (
    "edge nodes publish at QoS 0: let the broker keep it for sessions (mosquitto: queue_qos0_messages true)"
)
SILENT = "check topic, publisher and the rights of this user; wait longer (--wait 10min) if messages are rare"


Look: TypeAlias = Generator[Check, None, str]
"""The checks of a source; it returns the name of what it has read."""


def mqtt_checks(source: Mqtt, statistics: PayloadStatistics, wait_s: float) -> Look:
    """Connect, subscribe and listen for `wait_s` [s]; messages that are not retained also go into the
    statistics.

    Of edge nodes only births within this time are known, so that values by other aliases are not judged.
    """
    broker, about = source.broker, f"source {source.url}"
    for caution in broker.cautions():
        if not caution.startswith(SECRETS):  # `file_checks` reports these
            yield doubt(about, *caution.split(": ", 1))
    with listening(doctor_session(broker), source.largest) as link:
        if link.lost.is_set() or not link.answered:
            raise SourceFault(link.reason or f"{broker.where} has not answered within {ANSWER_S:g} s")
        user = f" as user {broker.user_name}" if broker.user_name else ""
        yield ok(about, f"connected{' by TLS' * broker.tls}{user}")
        yield from _certificate(link, about)
        retained = PayloadStatistics(source.mapping)

        from paho.mqtt.client import topic_matches_sub

        heard = {topics: Counter[str]() for topics in link.broker.topics}
        for arrival in arrivals(link, wait_s):
            for topics, one in heard.items():
                if topic_matches_sub(topics, arrival.topic):
                    one["retained" if arrival.retained else "live"] += 1
                    one["unkept"] += not arrival.retained and arrival.identifier is None
            for content in source.read(arrival):
                if isinstance(content, Unreadable) and content.kind in UNEXPLAINED:
                    continue
                (retained if arrival.retained else statistics).take(content, arrival.time, arrival.topic)
        if link.lost.is_set():
            yield fault(about, f"the connection was lost: {link.reason}", REACH)
        denied = link.denied
    keep = KEPT if isinstance(source, Sparkplug) else "publish at QoS 1"
    for topics, one in heard.items():
        yield _filter_check(f"{about} {topics}", one, denied.get(topics), wait_s, keep)
    if retained.payloads and not statistics.payloads:
        yield from payload_checks(f"{about} retained messages", retained)
    if isinstance(source, Sparkplug):
        yield from _edge_node_checks(about, source.edge_nodes, f"within {lasting(wait_s)}")
    return "payloads"


def doctor_session(broker: Broker) -> Broker:
    """The broker with the doctor's own session, which ends with the connection.

    A shared subscription is replaced by a plain one, because messages dealt to it would be missing elsewhere.
    """
    topics = tuple(dict.fromkeys(plain_filter(one) for one in broker.topics))
    own = f"hygrokf-doctor-{secrets.token_hex(4)}"
    return replace(broker, client_id=own, session_expiry_s=0.0, topics=topics)


def plain_filter(topics: str) -> str:
    """A topic filter without its share: FILTER of $share/GROUP/FILTER."""
    return topics.split("/", 2)[2] if topics.startswith("$share/") else topics


@contextmanager
def listening(broker: Broker, largest: int) -> Iterator[BrokerLink]:
    """A link within this context, once the broker has answered the subscription or the link is lost;
    `largest`: payload [bytes] from which the rest is cut off."""
    link = BrokerLink(broker, largest)
    try:
        link.open()
        end = time.monotonic() + ANSWER_S
        while not (link.answered or link.lost.is_set()) and time.monotonic() < end:
            link.lost.wait(0.02)
        yield link
    finally:
        link.close()


def _certificate(link: BrokerLink, about: str) -> Iterator[Check]:
    socket = link.client.socket()
    shown = socket.getpeercert(binary_form=True) if isinstance(socket, ssl.SSLSocket) else None
    if shown:
        yield validity_check(about, shown, "the broker's certificate")


def arrivals(link: BrokerLink, wait_s: float) -> Iterator[Arrival]:
    """The messages of the doctor's session within a time [s], or until the link is lost; they are
    acknowledged at once, because nobody else uses this session."""
    end = time.monotonic() + wait_s
    while (left := end - time.monotonic()) > 0.0:
        with suppress(queue.Empty):
            arrival = link.arrived.get(timeout=left)
            if arrival is None:
                return
            link.acknowledge(arrival.identifier)
            yield arrival


def _filter_check(about: str, one: Counter[str], denied: str | None, wait_s: float, keep: str) -> Check:
    within = f"within {lasting(wait_s)}"
    if denied is not None:
        return fault(
            about,
            f"the broker denies the subscription: {denied}",
            "give this user the right to read the topic",
        )
    if one["live"] and one["unkept"]:
        return doubt(
            about,
            f"{one['live']} messages {within}, {one['unkept']} of them published at QoS 0, which the broker "
            "does not keep while the tracker is not running",
            keep,
        )
    if one["live"]:
        return ok(about, f"granted; {one['live']} messages {within}")
    if one["retained"]:
        return doubt(
            about, f"granted; nothing new {within}, only {one['retained']} retained messages", SILENT
        )
    return doubt(
        about, f"granted, but no message arrived {within}: a broker may grant and deliver nothing", SILENT
    )


def _edge_node_checks(about: str, nodes: EdgeNodes, within: str) -> Iterator[Check]:
    for node in nodes.nodes.values():
        node.look(time.time())
    gaps = [name for name, node in nodes.nodes.items() if node.gap_s is not None]
    unborn = [name for name in nodes.without_birth() if name not in gaps]
    left = [name for name, node in nodes.nodes.items() if "" in node.left_s]
    sound = [name for name in nodes.nodes if name not in (*gaps, *unborn, *left)]
    yield from of_names(
        about,
        ("ok", sound, "every message is explained, of edge nodes {}", ""),
        (
            "doubt", gaps, "messages are missing in the sequence of {}",
            "look for a bad connection of the edge node, and for two that bear one name",
        ),
        (
            "doubt", unborn, f"values came by aliases, but no birth certificate {within}, of {{}}",
            f"if the tracker does not know these either: {ASK}, or set rebirth_requests = true",
        ),
        ("doubt", left, f"a death certificate came {within}, of {{}}", "check the edge node"),
    )  # fmt: skip


# -- OPC UA --------------------------------------------------------------------------------------------------
BACK_S = DAY_S
"""Length of the history that is requested of an OPC UA server [s]."""
ASKED = 20
"""Largest number of nodes whose history is requested."""
REACH_SERVER = "check url, certificates and user of this [[source]], and that the server runs"


def opcua_checks(source: OpcUa, statistics: PayloadStatistics, wait_s: float) -> Look:
    """Connect, subscribe, and wait up to `wait_s` [s] for the first values, which go into the statistics."""
    yield from asyncio.run(_examine(source, statistics, wait_s))
    return "values"


async def _examine(source: OpcUa, statistics: PayloadStatistics, wait_s: float) -> list[Check]:
    about, connection = f"source {source.url}", source.connection()
    try:
        await connection.open()
        checks = [ok(about, "connected"), *await _clock(connection, about)]
        refused = await connection.subscribe(source.nodes)
        there = [node for node in source.nodes if node not in refused]
        first = await _first_samples(connection, set(there), wait_s)
        checks += _node_checks(about, source.nodes, refused, first, wait_s)
        checks += await _histories(connection, about, there)
    finally:
        await connection.close()
    for one in first.values():
        delivery = source.delivery(one)
        statistics.take(delivery.content, delivery.received)
    return checks


async def _clock(connection: Connection, about: str) -> list[Check]:
    before = time.time()
    try:
        shown = await connection.server_time()
    except SourceFault:  # the tracker does not need to read the clock
        return []
    return [server_check(about, shown - 0.5 * (before + time.time()))]


async def _first_samples(connection: Connection, awaited: set[Node], wait_s: float) -> dict[Node, Sample]:
    """The newest sample of each node, once all nodes have one or the time is over."""
    found: dict[Node, Sample] = {}
    end = time.monotonic() + wait_s
    while awaited - set(found) and time.monotonic() < end:
        connection.check()
        found.update({one.node: one for one in await connection.samples(PAUSE_S)})
    return found


def _node_checks(
    about: str, nodes: Sequence[Node], refused: dict[Node, str], first: dict[Node, Sample], wait_s: float
) -> Iterator[Check]:
    now, sensor = time.time(), "check the sensor and its connection to the server"
    silent = [node.id for node in nodes if node not in refused and node not in first]
    bad = {n: one.word for n, one in first.items() if one.quality != "good"}
    old = {n: stamp_text(one.time) for n, one in first.items() if one.time and now - one.time > OLD_S}
    unstamped = {n: "no stamp" for n, one in first.items() if one.time is None and one.quality == "good"}
    yield from of_names(
        about,
        (
            "fault", _with_words(refused),
            f"{len(refused)} of {len(nodes)} nodes do not exist or are denied: {{}}",
            "compare the ids with the server's address space, and give this user the right to read them",
        ),
        (
            "doubt", silent, f"no value of {{}} within {lasting(wait_s)}",
            "wait longer (--wait 1min), or check whether the server samples these nodes",
        ),
        ("doubt", _with_words(bad), "values that are not good: {}", sensor),
        ("doubt", _with_words(old), f"values older than {lasting(OLD_S)}: {{}}", sensor),
        ("doubt", _with_words(unstamped), "values without a time stamp, which are not used: {}", sensor),
    )  # fmt: skip
    fine = set(first).difference(bad, old, unstamped)
    if fine:
        yield ok(about, f"{len(fine)} of {len(nodes)} nodes have a good value")


def _with_words(nodes: Mapping[Node, str]) -> list[str]:
    return [f"{node.id} ({word})" for node, word in nodes.items()]


async def _histories(connection: Connection, about: str, nodes: Sequence[Node]) -> list[Check]:
    """Whether the server keeps the history of nodes, without which samples during an outage are lost."""
    asked, now = list(nodes)[:ASKED], time.time()
    unread = await connection.without_history(asked)
    for node in asked:
        try:
            if await anext(connection.history(node, now - BACK_S, now), None) is not None:
                unread.pop(node, None)  # whatever its access level says
        except HistoryFault as error:
            unread[node] = str(error)
    if asked and not unread:
        return [ok(about, f"the server keeps the history of the {len(asked)} nodes examined")]
    missing = f"no history of {len(unread)} of {len(asked)} nodes: {{}}"
    enable = (
        "enable history on the server and let this user read it: otherwise samples are lost while the "
        "tracker is not running"
    )
    return list(of_names(about, ("doubt", _with_words(unread), missing, enable)))


# -- all sources, files and databases ------------------------------------------------------------------------
TAIL = 4_000_000
"""[bytes] read from the end of a file."""
FIRST_ROWS = "first rows"
"""Rows of a watermark that is no time, whose age says nothing."""
REACH_DATABASE = "check url, password and query of this [[source]], and that the server runs"
MOST_ROWS = 20_000
"""Rows of a database's query that are examined at most."""
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
    kind = next((one for one in KINDS if isinstance(stream, one)), None)
    if kind is None:
        yield ok(about, "can be read only while the tracker runs; not examined")
        return
    (look, remedy), what = KINDS[kind], "payloads"
    try:
        what = yield from look(stream, statistics, wait_s)
    except SourceFault as error:
        yield fault(about, str(error), remedy)
    yield from payload_checks(about, statistics, what)
    newest = max(statistics.newest.values(), default=-math.inf)
    if stream.mapping.weather and statistics.newest:
        ahead = newest - time.time()
        said = f"its weather forecast reaches {lasting(ahead)} ahead"
        need = "deliver at least a day: shorter forecasts are not used"
        yield doubt(about, said, need) if ahead < DAY_S else ok(about, said)
    if stream.mapping.weather or stream.played_back:
        return
    is_heard = isinstance(stream, Mqtt)
    if statistics.newest and not is_heard:
        age = time.time() - newest
        said = f"its newest reading is from {stamp_text(newest)}, {lasting(max(age, 0.0))} ago"
        judged = age > OLD_S and what != FIRST_ROWS
        writer = "check the program that writes the file, or fills the table"
        yield doubt(about, said, writer) if judged else ok(about, said)
    stamped = stamp_check(
        about,
        statistics.lag_s,
        lateness_s if is_heard else math.inf,
        fresh=is_heard or isinstance(stream, TailedFile),
    )
    if stamped is not None and (is_heard or stamped.level != "ok"):
        yield stamped


def playback_checks(stream: Playback, statistics: PayloadStatistics, wait_s: float) -> Look:
    """Check what the rows of a played-back file give."""
    for at, content in stream.messages:
        statistics.take(content, at)
    yield from ()
    return "rows that are played back"


def file_checks(stream: TailedFile, statistics: PayloadStatistics, wait_s: float) -> Look:
    """Check that a followed file exists, is readable and grows, and what its last rows give."""
    about, path, what = f"source {stream.url}", stream.path, "last rows"
    try:
        found = path.stat()
        size, written = found.st_size, found.st_mtime
        read_rows(path, statistics)
    except FileNotFoundError:
        if stream.follow and path.parent.is_dir():
            waits = "does not exist yet; the tracker waits for it"
            yield doubt(about, waits, "check the path and the program that writes the file")
            return what
        raise SourceFault(
            f"its folder {path.parent} does not exist" if stream.follow else "no such file"
        ) from None
    except OSError as error:
        raise SourceFault(f"cannot be read: {error.strerror}") from None
    if stream.follow:
        yield _growth(about, path, size, written, wait_s)
    if not statistics.payloads:
        yield doubt(
            about, "it has no rows yet", "write a line of names and then rows, or one JSON object per line"
        )
    if statistics.newest:  # its clock is judged by the time at which it was last written
        statistics.lag_s = min(statistics.lag_s, written - max(statistics.newest.values()))
    return what


def _growth(about: str, path: Path, size: int, written: float, wait_s: float) -> Check:
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


def postgres_checks(source: PostgresQuery, statistics: PayloadStatistics, wait_s: float) -> Look:
    """Connect, run the query for its newest rows, and read them."""
    try:
        return (yield from _postgres_checks(source, statistics, f"source {source.url}"))
    except Exception as error:  # of the driver, which only the source imports
        raise SourceFault(reason_of(error)) from None


def _postgres_checks(source: PostgresQuery, statistics: PayloadStatistics, about: str) -> Look:
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
        return span
    now = time.time()
    for row in rows:
        columns.watermark(row)
        statistics.take(columns.payload(row), now)
    if took_s > source.form.poll_s:
        yield doubt(
            about,
            f"the query took {lasting(took_s)}, longer than poll ({lasting(source.form.poll_s)})",
            f"create an index on {source.form.watermark}, or poll less often",
        )
    return span


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
    if kind in TIMES:
        for span in SPANS_S:
            since = datetime.fromtimestamp(time.time() - span, UTC)
            yield since.isoformat(), f"rows of the last {lasting(span)}"
    else:
        yield LOWEST[kind], FIRST_ROWS


KINDS: Mapping[type[Stream], tuple[Callable[..., Look], str]] = {
    TailedFile: (file_checks, "check the path, and its permissions for the user of the tracker"),
    Playback: (playback_checks, ""),
    Mqtt: (mqtt_checks, REACH),
    OpcUa: (opcua_checks, REACH_SERVER),
    PostgresQuery: (postgres_checks, REACH_DATABASE),
}
"""Kind of source -> its checks, a function of (stream, statistics, wait_s) that returns the name of what it
has read; and what to do where it cannot be reached."""
