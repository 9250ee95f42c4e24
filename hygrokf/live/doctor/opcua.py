"""An OPC UA server as the tracker would find it: connection, nodes, stamps, history, clock.  It reads only."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence

from hygrokf.data.timestamps import stamp_text
from hygrokf.live.doctor.check import Check, doubt, fault, lasting, ok, several
from hygrokf.live.doctor.clock import server_check, stamp_check
from hygrokf.live.doctor.mqtt import tally_checks
from hygrokf.live.payload_statistics import Tally
from hygrokf.live.sources.opcua import OpcUa
from hygrokf.live.sources.opcua_client import Connection
from hygrokf.live.sources.opcua_samples import ConnectionFault, HistoryFault, Node, Sample

PAUSE_S = 0.2
OLD_S = 7200.0
"""[s] age of a value from which it may be one that nobody writes any more."""
BACK_S = 86400.0
"""[s] of history that is asked for."""
ASKED = 20
"""Nodes whose history is asked for, at most."""
REACH = "check url, certificates and user of this [[source]], and that the server runs"


def opcua_checks(source: OpcUa, tally: Tally, wait_s: float) -> list[Check]:
    """Connect and subscribe; first values are waited for up to `wait_s` [s], and go into the tally."""
    return asyncio.run(_examined(source, tally, wait_s))


async def _examined(source: OpcUa, tally: Tally, wait_s: float) -> list[Check]:
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
            tally.take(delivery.content, delivery.received)
        checks += tally_checks(about, tally, "values")
        found = stamp_check(about, tally.lag_s, fresh=False)
        return checks + ([found] if found else [])
    except ConnectionFault as error:
        return [fault(about, str(error), REACH)]
    finally:
        await connection.close()


async def _clock(connection: Connection, about: str) -> list[Check]:
    before = time.time()
    try:
        shown = await connection.server_time()
    except ConnectionFault:  # the right to read it is not needed
        return []
    return [server_check(about, shown - 0.5 * (before + time.time()))]


async def _first(connection: Connection, awaited: set[Node], wait_s: float) -> dict[Node, Sample]:
    """The newest sample of each node, as soon as all have one or the time is over."""
    found: dict[Node, Sample] = {}
    end = time.monotonic() + wait_s
    while awaited - set(found) and time.monotonic() < end:
        connection.check()
        found.update({one.node: one for one in await connection.samples(PAUSE_S)})
    return found


def _node_checks(
    about: str, nodes: Sequence[Node], refused: dict[Node, str], first: dict[Node, Sample], wait_s: float
) -> list[Check]:
    """One line a kind of trouble, and one for the nodes that are as they should be."""
    checks = []
    if refused:
        said = several(f"{node.id} ({word})" for node, word in refused.items())
        checks.append(
            fault(
                about,
                f"{len(refused)} of {len(nodes)} nodes are not there or denied: {said}",
                "compare the ids with the server's address space, and give this user the right to read them",
            )
        )
    silent = [node.id for node in nodes if node not in refused and node not in first]
    if silent:
        checks.append(
            doubt(
                about,
                f"no value within {lasting(wait_s)} of {several(silent)}",
                "wait longer (--wait 1min), or look whether the server samples these nodes",
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
            checks.append(doubt(about, f"{words}: {said}", "look at the sensor and at its way to the server"))
    fine = set(first).difference(*wanting.values())
    if fine:
        checks.append(ok(about, f"{len(fine)} of {len(nodes)} nodes have a good value"))
    return checks


async def _histories(connection: Connection, about: str, nodes: Sequence[Node]) -> list[Check]:
    """Whether the history of nodes is kept, without which what comes in an outage is lost."""
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
                "let the server keep history, and this user read it: what comes while the tracker is away is lost else",
            )
        ]
    return [ok(about, f"history is kept of {len(asked)} nodes that were asked for")] if asked else []
