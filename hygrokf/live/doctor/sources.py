"""Checks of all sources of a tracker at the same time: whether they can be reached, and what they deliver.

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
    of_names,
    payload_checks,
    rounded,
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
from hygrokf.live.sources.postgres_source import LOWEST, TIMES, PostgresQuery, postgres_reason, rows_above
from hygrokf.live.sources.sparkplug import EdgeNodes, Sparkplug
from hygrokf.live.sources.sparkplug_node import UNEXPLAINED
from hygrokf.live.sources.stream import POLL_PAUSE_S, SourceFault, Stream
from hygrokf.live.storage.database import Row
from hygrokf.texts.doctor_codes import DOUBT, OK, Check, CheckCode, ExaminedCode
from hygrokf.texts.statement import Statement

if TYPE_CHECKING:
    import psycopg

BROKER_ANSWER_S = 10.0
"""Longest time that a broker may take to accept the client and answer its subscription [s]."""

Checks: TypeAlias = Generator[Check, None, Statement]
"""A generator of the checks of a source, which returns a statement of what was read."""


def mqtt_checks(source: Mqtt, statistics: PayloadStatistics, wait_s: float) -> Checks:
    """Connect, subscribe and listen for `wait_s` [s]; messages that are not retained are added to
    the statistics.

    Only births of edge nodes within this time are known, so that values with aliases of earlier births are
    not judged.
    """
    broker, about = source.broker, f"source {source.url}"
    for caution in broker.cautions():
        if caution.code is not CheckCode.SECRET_READABLE:  # `tailed_file_checks` reports these
            yield replace(caution, about=about)
    with listen(doctor_session(broker), source.largest) as link:
        if link.lost.is_set() or not link.answered:
            raise SourceFault(link.reason or f"{broker.where} has not answered within {BROKER_ANSWER_S:g} s")
        yield CheckCode.BROKER_CONNECTED(
            about,
            security=ExaminedCode.BY_TLS() if broker.tls else "",
            user=ExaminedCode.AS_USER(user=broker.user_name) if broker.user_name else "",
        )
        yield from _certificate(link, about)
        retained = PayloadStatistics(source.mapping)

        from paho.mqtt.client import topic_matches_sub

        heard = {topics: Counter[str]() for topics in link.broker.topics}
        for arrival in arrivals(link, wait_s):
            for topics, counts in heard.items():
                if topic_matches_sub(topics, arrival.topic):
                    counts["retained" if arrival.retained else "live"] += 1
                    counts["unkept"] += not arrival.retained and arrival.identifier is None
            for content in source.read(arrival):
                if isinstance(content, Unreadable) and content.kind in UNEXPLAINED:
                    continue
                (retained if arrival.retained else statistics).take(content, arrival.time, arrival.topic)
        if link.lost.is_set():
            yield CheckCode.CONNECTION_LOST(about, fault=link.reason)
        denied = link.denied
    of_nodes = isinstance(source, Sparkplug)
    unkept = CheckCode.NODE_MESSAGES_NOT_KEPT if of_nodes else CheckCode.MESSAGES_NOT_KEPT
    for topics, counts in heard.items():
        yield _filter_check(f"{about} {topics}", counts, denied.get(topics), rounded(wait_s), unkept)
    if retained.payloads and not statistics.payloads:
        yield from payload_checks(f"{about} retained messages", retained)
    if isinstance(source, Sparkplug):
        yield from _edge_node_checks(about, source.edge_nodes, rounded(wait_s))
    return ExaminedCode.PAYLOADS()


def doctor_session(broker: Broker) -> Broker:
    """The broker with the doctor's own session, which ends with the connection.

    A shared subscription is replaced by a plain one, because messages that the doctor received from it would
    be missing in the tracker.
    """
    topics = tuple(dict.fromkeys(plain_filter(topics) for topics in broker.topics))
    client_id = f"hygrokf-doctor-{secrets.token_hex(4)}"
    return replace(broker, client_id=client_id, session_expiry_s=0.0, topics=topics)


def plain_filter(topics: str) -> str:
    """The FILTER in a shared subscription $share/GROUP/FILTER; any other filter is returned as it is."""
    return topics.split("/", 2)[2] if topics.startswith("$share/") else topics


@contextmanager
def listen(broker: Broker, largest: int) -> Iterator[BrokerLink]:
    """Provide a link to the broker within this context, once the broker has answered the subscription or the
    link is lost; longer payloads are cut to `largest` [bytes]."""
    link = BrokerLink(broker, largest)
    try:
        link.open()
        end = time.monotonic() + BROKER_ANSWER_S
        while not (link.answered or link.lost.is_set()) and time.monotonic() < end:
            link.lost.wait(0.02)
        yield link
    finally:
        link.close()


def _certificate(link: BrokerLink, about: str) -> Iterator[Check]:
    socket = link.client.socket()
    certificate = socket.getpeercert(binary_form=True) if isinstance(socket, ssl.SSLSocket) else None
    if certificate:
        yield validity_check(about, certificate, "the broker's certificate")


def arrivals(link: BrokerLink, wait_s: float) -> Iterator[Arrival]:
    """The messages of the doctor's session within `wait_s` [s], or until the link is lost.

    They are acknowledged at once, because no other program uses this session.
    """
    end = time.monotonic() + wait_s
    while (remaining_s := end - time.monotonic()) > 0.0:
        with suppress(queue.Empty):
            arrival = link.arrived.get(timeout=remaining_s)
            if arrival is None:
                return
            link.acknowledge(arrival.identifier)
            yield arrival


def _filter_check(
    about: str, counts: Counter[str], denied: str | None, wait_s: float, unkept: CheckCode
) -> Check:
    if denied is not None:
        return CheckCode.SUBSCRIPTION_DENIED(about, fault=denied)
    if counts["live"] and counts["unkept"]:
        return unkept(about, live=counts["live"], wait=wait_s, unkept=counts["unkept"])
    if counts["live"]:
        return CheckCode.MESSAGES_ARRIVE(about, live=counts["live"], wait=wait_s)
    if counts["retained"]:
        return CheckCode.ONLY_RETAINED(about, wait=wait_s, retained=counts["retained"])
    return CheckCode.NO_MESSAGE(about, wait=wait_s)


def _edge_node_checks(about: str, nodes: EdgeNodes, wait_s: float) -> Iterator[Check]:
    for node in nodes.nodes.values():
        node.release_overdue(time.time())
    gaps = [name for name, node in nodes.nodes.items() if node.gap_s is not None]
    unborn = [name for name in nodes.without_birth() if name not in gaps]
    died = [name for name, node in nodes.nodes.items() if "" in node.left_s]
    explained = [name for name in nodes.nodes if name not in (*gaps, *unborn, *died)]
    yield from of_names(about, explained, CheckCode.NODES_EXPLAINED)
    yield from of_names(about, gaps, CheckCode.SEQUENCE_BROKEN)
    yield from of_names(about, unborn, CheckCode.BIRTH_MISSING, wait=wait_s)
    yield from of_names(about, died, CheckCode.NODES_DIED, wait=wait_s)


# -- OPC UA --------------------------------------------------------------------------------------------------
EXAMINED_HISTORY_S = DAY_S
"""Length of the history that is requested of an OPC UA server [s]."""
MOST_HISTORIES = 20
"""Largest number of nodes whose history is requested."""


def opcua_checks(source: OpcUa, statistics: PayloadStatistics, wait_s: float) -> Checks:
    """Connect, subscribe, and wait up to `wait_s` [s] for the first values, which are added to the
    statistics."""
    yield from asyncio.run(_examine(source, statistics, wait_s))
    return ExaminedCode.VALUES()


async def _examine(source: OpcUa, statistics: PayloadStatistics, wait_s: float) -> list[Check]:
    about, connection = f"source {source.url}", source.connection()
    try:
        await connection.open()
        checks = [CheckCode.SERVER_CONNECTED(about), *await _clock(connection, about)]
        refused = await connection.subscribe(source.nodes)
        accepted = [node for node in source.nodes if node not in refused]
        first = await _first_samples(connection, set(accepted), wait_s)
        checks += _node_checks(about, source.nodes, refused, first, wait_s)
        checks += await _histories(connection, about, accepted)
    finally:
        await connection.close()
    for sample in first.values():
        delivery = source.delivery(sample)
        statistics.take(delivery.content, delivery.received)
    return checks


async def _clock(connection: Connection, about: str) -> list[Check]:
    before = time.time()
    try:
        server_s = await connection.server_time()
    except SourceFault:  # the tracker does not need to read the clock
        return []
    return [server_check(about, server_s - 0.5 * (before + time.time()))]


async def _first_samples(connection: Connection, awaited: set[Node], wait_s: float) -> dict[Node, Sample]:
    """The newest sample of each node, once all nodes have a sample or `wait_s` [s] have passed."""
    newest: dict[Node, Sample] = {}
    end = time.monotonic() + wait_s
    while awaited - set(newest) and time.monotonic() < end:
        connection.check()
        newest.update({sample.node: sample for sample in await connection.samples(POLL_PAUSE_S)})
    return newest


def _node_checks(
    about: str, nodes: Sequence[Node], refused: dict[Node, str], first: dict[Node, Sample], wait_s: float
) -> Iterator[Check]:
    now, wait_s = time.time(), rounded(wait_s)
    silent = [node.id for node in nodes if node not in refused and node not in first]
    bad = {node: sample.word for node, sample in first.items() if sample.quality != "good"}
    old = {n: sample.time for n, sample in first.items() if sample.time and now - sample.time > OLD_S}
    aged = [ExaminedCode.NODE_SINCE(node=node.id, at=at) for node, at in old.items()]
    unstamped = {n: "no stamp" for n, s in first.items() if s.time is None and s.quality == "good"}
    count = {"count": len(refused), "of": len(nodes)}
    yield from of_names(about, _with_reasons(refused), CheckCode.NODES_REFUSED, **count)
    yield from of_names(about, silent, CheckCode.NODES_SILENT, wait=wait_s)
    yield from of_names(about, _with_reasons(bad), CheckCode.VALUES_BAD)
    yield from of_names(about, aged, CheckCode.VALUES_OLD, limit=OLD_S)
    yield from of_names(about, _with_reasons(unstamped), CheckCode.VALUES_UNSTAMPED)
    good = set(first).difference(bad, old, unstamped)
    if good:
        yield CheckCode.NODES_GOOD(about, count=len(good), of=len(nodes))


def _with_reasons(nodes: Mapping[Node, str]) -> list[Statement]:
    return [ExaminedCode.NODE(node=node.id, why=why) for node, why in nodes.items()]


async def _histories(connection: Connection, about: str, nodes: Sequence[Node]) -> list[Check]:
    """Check whether the server keeps the history of nodes; without it samples during an outage are lost."""
    examined, now = list(nodes)[:MOST_HISTORIES], time.time()
    without = await connection.without_history(examined)
    for node in examined:
        try:
            if await anext(connection.history(node, now - EXAMINED_HISTORY_S, now), None) is not None:
                without.pop(node, None)  # even if the node's access level excludes its history
        except HistoryFault as error:
            without[node] = str(error)
    if examined and not without:
        return [CheckCode.HISTORY_KEPT(about, count=len(examined))]
    names = _with_reasons(without)
    return list(of_names(about, names, CheckCode.HISTORY_MISSING, count=len(without), of=len(examined)))


# -- all sources, files and databases ------------------------------------------------------------------------
TAIL = 4_000_000
"""Length of the end of a file that is read [bytes]."""
MOST_EXAMINED_ROWS = 20_000
"""Largest number of rows of a database's query that are examined."""
SPANS_S = (600.0, 2.0 * HOUR_S, DAY_S, 30.0 * DAY_S)
"""Lengths of the past in which rows are looked for [s]; the shortest one with rows is used."""


def examine_sources(
    streams: Sequence[Stream], wait_s: float, lateness_s: float
) -> list[tuple[tuple[Check, ...], PayloadStatistics]]:
    """The checks of every source and the statistics of its payloads; sources that send by themselves are
    observed for `wait_s` [s]."""
    results: dict[int, tuple[tuple[Check, ...], PayloadStatistics]] = {}
    errors: list[BaseException] = []

    def examine(number: int, stream: Stream) -> None:
        statistics = PayloadStatistics(stream.mapping)
        try:
            results[number] = tuple(_checks(stream, statistics, wait_s, lateness_s)), statistics
        except BaseException as error:
            errors.append(error)

    # daemon threads, so that an interruption does not wait for them
    threads = [
        threading.Thread(target=examine, args=(number, stream), name=f"doctor {stream.url}", daemon=True)
        for number, stream in enumerate(streams)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    return [results[number] for number in range(len(streams))]


def _checks(
    stream: Stream, statistics: PayloadStatistics, wait_s: float, lateness_s: float
) -> Iterator[Check]:
    about = f"source {stream.url}"
    kind = next((kind for kind in SOURCE_CHECKS if isinstance(stream, kind)), None)
    if kind is None:
        yield CheckCode.SOURCE_NOT_EXAMINED(about)
        return
    (check, failure), examined = SOURCE_CHECKS[kind], ExaminedCode.PAYLOADS()
    try:
        examined = yield from check(stream, statistics, wait_s)
    except SourceFault as error:
        yield failure(about, fault=str(error))
    yield from payload_checks(about, statistics, examined)
    newest = max(statistics.newest.values(), default=-math.inf)
    age = time.time() - newest
    if stream.mapping.weather and statistics.newest:
        yield CheckCode.FORECAST_REACHES(about, DOUBT if -age < DAY_S else OK, ahead=rounded(-age))
    if stream.mapping.weather or stream.played_back:
        return
    sends_itself = isinstance(stream, Mqtt)
    if statistics.newest and not sends_itself:
        # if the watermark is not a time, the first rows were read, whose age says nothing
        is_old = age > OLD_S and examined.code is not ExaminedCode.FIRST_ROWS
        yield CheckCode.NEWEST_READING(about, DOUBT if is_old else OK, at=newest, age=rounded(age))
    clock = stamp_check(
        about,
        statistics.lag_s,
        lateness_s if sends_itself else math.inf,
        fresh=sends_itself or isinstance(stream, TailedFile),
    )
    if clock is not None and (sends_itself or clock.level != OK):
        yield clock


def playback_checks(stream: Playback, statistics: PayloadStatistics, wait_s: float) -> Checks:
    """Add the rows of a played-back file to the statistics."""
    for at, content in stream.messages:
        statistics.take(content, at)
    yield from ()
    return ExaminedCode.PLAYED_BACK()


def tailed_file_checks(stream: TailedFile, statistics: PayloadStatistics, wait_s: float) -> Checks:
    """Check that a followed file exists, is readable and grows, and add its last rows to the statistics."""
    about, path, examined = f"source {stream.url}", stream.path, ExaminedCode.LAST_ROWS()
    try:
        status = path.stat()
        size, written_s = status.st_size, status.st_mtime
        read_rows(path, statistics)
    except FileNotFoundError:
        if stream.follow and path.parent.is_dir():
            yield CheckCode.FILE_AWAITED(about)
            return examined
        raise SourceFault(
            f"its folder {path.parent} does not exist" if stream.follow else "no such file"
        ) from None
    except OSError as error:
        raise SourceFault(f"cannot be read: {error.strerror}") from None
    if stream.follow:
        yield _growth(about, path, size, written_s, wait_s)
    if not statistics.payloads:
        yield CheckCode.FILE_EMPTY(about)
    if statistics.newest:  # the lag of a file ends at the time at which it was last written
        statistics.lag_s = min(statistics.lag_s, written_s - max(statistics.newest.values()))
    return examined


def _growth(about: str, path: Path, size: int, written_s: float, wait_s: float) -> Check:
    end = time.monotonic() + wait_s
    while time.monotonic() < end:
        try:
            present_size = path.stat().st_size
        except FileNotFoundError:
            present_size = -1
        if present_size > size:
            return CheckCode.FILE_GROWS(about, grown=present_size - size, within=rounded(wait_s))
        if present_size < size:
            return CheckCode.FILE_REPLACED(about)
        time.sleep(POLL_PAUSE_S)
    age = time.time() - written_s
    level = DOUBT if age > OLD_S else OK
    return CheckCode.FILE_RESTS(about, level, within=rounded(wait_s), age=rounded(age))


def read_rows(path: Path, statistics: PayloadStatistics) -> None:
    """Add the rows of a file to the statistics, of a long file only the last `TAIL` bytes."""
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


def postgres_checks(source: PostgresQuery, statistics: PayloadStatistics, wait_s: float) -> Checks:
    """Connect, run the query for its newest rows, and add the rows to the statistics."""
    try:
        return (yield from _postgres_checks(source, statistics, f"source {source.url}"))
    except Exception as error:  # the driver's own class cannot be named, because only the source imports it
        raise SourceFault(postgres_reason(error)) from None


def _postgres_checks(source: PostgresQuery, statistics: PayloadStatistics, about: str) -> Checks:
    with closing(source.open()) as connection:
        columns = source.columns(connection)
        yield CheckCode.QUERY_ANSWERED(about, columns=tuple(columns.names))
        before = time.time()
        (server_time,) = connection.execute("SELECT clock_timestamp()").fetchone() or (None,)
        if isinstance(server_time, datetime):
            yield server_check(about, server_time.timestamp() - 0.5 * (before + time.time()))
        rows, examined, took_s = _newest_rows(source, columns.kind, connection)
    if not rows:
        yield CheckCode.QUERY_EMPTY(about, examined=examined)
        return examined
    now = time.time()
    for row in rows:
        columns.watermark(row)
        statistics.take(columns.payload(row), now)
    poll_s = source.form.poll_s
    if took_s > poll_s:
        yield CheckCode.QUERY_SLOW(
            about, took=rounded(took_s), poll=rounded(poll_s), watermark=source.form.watermark
        )
    return examined


def _newest_rows(
    source: PostgresQuery, kind: str, connection: psycopg.Connection[Row]
) -> tuple[list[Row], Statement, float]:
    """Rows of the shortest span that has rows, a statement of what they are, and the query's duration [s]."""
    rows: list[Row] = []
    examined, took_s = ExaminedCode.ROWS(), 0.0
    for after, examined in _watermarks(kind):  # noqa: B007
        began = time.monotonic()
        with closing(rows_above(connection, source.form.query, after)) as cursor:
            rows = list(islice(cursor, MOST_EXAMINED_ROWS))
        took_s = time.monotonic() - began
        if rows:
            break
    return rows, examined, took_s


def _watermarks(kind: str) -> Iterator[tuple[str, Statement]]:
    if kind in TIMES:
        for span in SPANS_S:
            since = datetime.fromtimestamp(time.time() - span, UTC)
            yield since.isoformat(), ExaminedCode.ROWS_SINCE(span=span)
    else:
        yield LOWEST[kind], ExaminedCode.FIRST_ROWS()


SOURCE_CHECKS: Mapping[type[Stream], tuple[Callable[..., Checks], CheckCode]] = {
    TailedFile: (tailed_file_checks, CheckCode.FILE_FAILS),
    Playback: (playback_checks, CheckCode.FILE_FAILS),
    Mqtt: (mqtt_checks, CheckCode.BROKER_FAILS),
    OpcUa: (opcua_checks, CheckCode.SERVER_FAILS),
    PostgresQuery: (postgres_checks, CheckCode.DATABASE_FAILS),
}
"""Kind of source → the generator function of its checks, called with (stream, statistics, wait_s), and the
code for a source that cannot be reached."""
