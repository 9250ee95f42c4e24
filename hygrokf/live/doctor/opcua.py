"""Checks of an OPC UA server from the tracker's point of view: connection, nodes, and their history."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator, Sequence

from hygrokf.data.timestamps import DAY_S, stamp_text
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
from hygrokf.live.sources.opcua import OpcUa
from hygrokf.live.sources.opcua_client import Connection
from hygrokf.live.sources.opcua_samples import ConnectionFault, HistoryFault, Node, Sample
from hygrokf.live.sources.payload_statistics import PayloadStatistics
from hygrokf.live.sources.stream import PAUSE_S, several

BACK_S = DAY_S
"""Length of the requested history [s]."""
ASKED = 20
"""Largest number of nodes whose history is requested."""
REACH = "check url, certificates and user of this [[source]], and that the server runs"


def opcua_checks(
    source: OpcUa, statistics: PayloadStatistics, wait_s: float, lateness_s: float
) -> Iterator[Check]:
    """Connect, subscribe, and wait up to `wait_s` [s] for the first values, which go into the statistics."""
    yield from asyncio.run(_examine(source, statistics, wait_s))


async def _examine(source: OpcUa, statistics: PayloadStatistics, wait_s: float) -> list[Check]:
    about, connection = f"source {source.url}", source.connection()
    try:
        await connection.open()
        checks = [ok(about, "connected")]
        checks += await _clock(connection, about)
        refused = await connection.subscribe(source.nodes)
        first = await _first_samples(connection, set(source.nodes) - set(refused), wait_s)
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
    asked, now = list(nodes)[:ASKED], time.time()
    unread = await connection.without_history(asked)
    for node in asked:
        try:
            if await anext(connection.history(node, now - BACK_S, now), None) is not None:
                unread.pop(node, None)  # whatever its access level says
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
