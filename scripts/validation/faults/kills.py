"""Kill -9 while messages flow: of the tracker, of the broker, of the OPC UA server, of PostgreSQL."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from builders.databases import Server

from validation.faults.plant import Message, Outcome, Plant, counted, parts, stored
from validation.faults.sources import Nodes, rows_of
from validation.faults.tracker import (
    Tracker,
    broker_of,
    each_published,
    flow,
    later,
    mqtt_source,
    sessions,
    tracking,
    unacknowledged,
    until,
)

FLOW_S = 1.5
"""[s] over which a part of the messages is published; the kill comes at a random moment after the first
commit."""
STARTING = 0.25
"""Share of the kills that come while a tracker starts, with the messages of its predecessor waiting."""
UNCONFIRMED_S = 10.0
"""[s] after which a part that a killed broker has not confirmed is given up; all of it is published once
more."""
EVERY = 40
"""One message in so many is none: it must be counted, and change nothing."""
RUBBISH: Message = ("scada/T1", b'{"turbine": "T1"')


@contextmanager
def amid(store: str, before: int, tracker: Tracker, pause: float, blow: Callable[[], None]) -> Iterator[None]:
    """While the block runs a blow comes after the first commit beyond `before` observations, and a share
    `pause` of half the flow."""

    def strike() -> None:
        until(lambda: stored(store) > before, tracker.said)
        time.sleep(0.5 * FLOW_S * pause)
        blow()

    with later(0.0, strike):
        yield


def killed_tracker(folder: Path, seed: int, kills: int = 5, store: str = "") -> Outcome:
    """The tracker dies at random moments of its start and of its rounds; what it was sent meanwhile waits at
    the broker."""
    random, plant = np.random.default_rng(seed), Plant(folder)
    store = store or plant.store
    messages = plant.messages()
    for place in sorted(random.integers(0, len(messages), len(messages) // EVERY).tolist(), reverse=True):
        messages.insert(place, RUBBISH)
    midway = sent = 0
    with broker_of(plant) as broker:
        config = plant.config(mqtt_source(broker), store)
        with tracking(broker, config) as first:  # from here on the broker keeps a session
            first.stop()
        *early, late = parts(messages, random, kills + 1)
        for number, part in enumerate(early):
            before, sent = sent, sent + len(part) - part.count(RUBBISH)
            pause = float(random.uniform(0.0, 1.0))
            if number and random.random() < STARTING:
                with Tracker(config) as tracker, later(1.5 * pause, tracker.kill):
                    flow(broker, part, FLOW_S)
            else:
                with tracking(broker, config) as tracker, amid(store, before, tracker, pause, tracker.kill):
                    flow(broker, part, FLOW_S)
            midway += before < stored(store) < sent
        each_published(broker, late)
        whole = len(messages) - messages.count(RUBBISH)
        with tracking(broker, config) as tracker:
            until(lambda: stored(store) >= whole, tracker.said)
            tracker.stop()
        fault = unacknowledged(broker)
    rubbish, set_aside = len(messages) - whole, counted(store)["malformed"]
    if set_aside < rubbish:
        fault = f"{rubbish} payloads were none, {set_aside} were counted"
    words = (
        f"{midway} kills amid the messages of their part; {rubbish} payloads were none, {set_aside} were "
        "counted"
    )
    return plant.judged(kills, len(messages), store, words=words, fault=fault)


def killed_broker(folder: Path, seed: int, kills: int = 1) -> Outcome:
    """The broker dies at random moments; what it had not saved is published again, and so is what it had."""
    random, plant = np.random.default_rng(seed), Plant(folder)
    store, messages = plant.store, plant.messages()
    with broker_of(plant) as broker:
        with tracking(broker, plant.config(mqtt_source(broker), store)) as tracker:
            *early, late = parts(messages, random, kills + 1)
            for part in early:
                broker.save()
                pause = float(random.uniform(0.0, 1.0))
                with amid(store, stored(store), tracker, pause, broker.kill):
                    with suppress(AssertionError, RuntimeError):  # nobody confirms any more
                        flow(broker, part, FLOW_S, UNCONFIRMED_S)
                heard = sessions(broker)
                broker.start()
                until(lambda heard=heard: sessions(broker) > heard, tracker.said)
                each_published(broker, part)
            each_published(broker, late)
            until(lambda: stored(store) >= len(messages), tracker.said)
            tracker.stop()
        fault = unacknowledged(broker)
    return plant.judged(kills, len(messages), store, fault=fault)


def killed_database(folder: Path, seed: int, server: Server, kills: int = 1) -> Outcome:
    """All of PostgreSQL's processes die at random moments; the tracker waits for it, and the broker for the
    tracker."""
    random, plant = np.random.default_rng(seed), Plant(folder)
    store, messages = server.url(server.database()), plant.messages()
    with broker_of(plant) as broker:
        with tracking(broker, plant.config(mqtt_source(broker), store)) as tracker:
            *early, late = parts(messages, random, kills + 1)
            try:
                for part in early:
                    pause = float(random.uniform(0.0, 1.0))
                    with amid(store, stored(store), tracker, pause, server.kill):
                        flow(broker, part, FLOW_S)
                    server.start()
            finally:
                if not server.is_running:
                    server.start()
            each_published(broker, late)
            until(lambda: stored(store) >= len(messages), tracker.said)
            tracker.stop()
            failures = tracker.log.read_text().count("the store failed")
        fault = unacknowledged(broker)
    words = f"the tracker noticed {failures} failures of its store"
    return plant.judged(kills, len(messages), store, words=words, fault=fault)


def killed_server(folder: Path, seed: int, kills: int = 1) -> Outcome:
    """An OPC UA server dies while it tells values; what its history has of the outage is read back."""
    from builders.opcua_peer import Peer

    random, plant = np.random.default_rng(seed), Plant(folder, days=2.0)
    store, (turbine,) = plant.store, plant.names
    with Peer(folder) as server:
        nodes = Nodes(server, turbine, [s.signal for s in plant.record.series])
        samples = nodes.samples(rows_of(plant, turbine))
        with Tracker(plant.config(nodes.source, store)) as tracker:
            until(lambda: "connected" in tracker.said(), tracker.said)
            *early, late = parts(samples, random, kills + 1)
            sent = 0
            for part in early:
                sent += len(part)
                half = len(part) // 2
                server.write(part[:half])
                until(
                    lambda sent=sent, half=half, part=part: stored(store) >= sent - len(part) + half,
                    tracker.said,
                )
                server.killed_while_writing(part[half:], 0.001, float(random.uniform(0.0, 0.5)))
                server.start()
                until(lambda sent=sent: stored(store) >= sent, tracker.said)
            server.write(late)
            until(lambda: stored(store) >= len(samples), tracker.said)
            tracker.stop()
    return plant.judged(kills, len(samples), store)
