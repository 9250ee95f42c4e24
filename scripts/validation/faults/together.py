"""Kill -9 of a tracker that follows every kind of source at once."""

from __future__ import annotations

import time
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
from builders.databases import Server

from validation.faults.kills import STARTING
from validation.faults.plant import Outcome, Plant, counted, stored
from validation.faults.sources import Input, Rows, Sender, all_senders, rows_of
from validation.faults.tracker import Tracker, later, until

TURBINES = 7
"""One for each kind of source."""
FLOW_S = 0.8
"""[s] over which a part is sent at least; the kill comes at a random moment after the first commit, or while
the tracker starts."""
PIECES = 8


def killed_together(
    folder: Path, seed: int, server: Server, kills: int = 4, in_postgresql: bool = False, days: float = 2.0
) -> Outcome:
    """A tracker of seven turbines dies at random moments while a file, standard input, MQTT in plain text and
    over TLS, a Sparkplug edge node, an OPC UA server and a database's table bring their readings.

    `server` has the table, and the store with `in_postgresql`.
    """
    random, plant = np.random.default_rng(seed), Plant(folder, days, TURBINES)
    store = server.url(server.database()) if in_postgresql else plant.store
    whole = {name: rows_of(plant, name) for name in plant.names}
    count = sum(len(values) for rows in whole.values() for _, values in rows)
    midway = starting = 0
    with all_senders(plant, server) as senders:
        config = plant.config("\n".join(one.source for one in senders.values()), store)
        with fed(config, senders) as first:  # from here on the brokers keep sessions
            until(lambda: all(one.heard() for one in senders.values()), first.said)
            first.stop()
        *early, late = _parts(whole, random, kills + 1)
        sent = 0
        for number, part in enumerate(early):
            before, sent = stored(store), sent + sum(len(v) for rows in part.values() for _, v in rows)
            at_start, pause = bool(number and random.random() < STARTING), float(random.uniform(0.0, 1.0))
            with fed(config, senders) as tracker:

                def die(
                    tracker: Tracker = tracker,
                    before: int = before,
                    at_start: bool = at_start,
                    pause: float = pause,
                ) -> None:
                    if not at_start:
                        until(lambda: stored(store) > before, tracker.said)
                    time.sleep(1.5 * pause if at_start else FLOW_S * pause)
                    tracker.kill()

                with later(0.0, die):
                    _flow(part, senders)
            starting += at_start
            midway += before < stored(store) < sent
        with fed(config, senders) as tracker:
            _flow(late, senders)
            until(lambda: stored(store) >= count, lambda: (stored(store), count, tracker.said()))
            tracker.stop()
    lost = {kind: n for kind, n in counted(store).items() if kind in ("malformed", "held until birth")}
    words = f"{midway} kills amid the readings of their part, {starting} at a start"
    return plant.judged(kills, count, store, words=words, fault=str(lost) if lost else "")


def fed(config: Path, senders: Mapping[str, Sender]) -> Tracker:
    """A tracker whose standard input is attached to its sender."""
    tracker = Tracker(config, fed=True)
    for one in senders.values():
        if isinstance(one, Input):
            one.attach(tracker.process.stdin)
    return tracker


def _parts(whole: Mapping[str, Rows], random: np.random.Generator, count: int) -> list[dict[str, Rows]]:
    """The messages of every turbine in `count` parts, cut at random times that are the same for all."""
    times = sorted({at for rows in whole.values() for at, _ in rows})
    cuts = np.sort(random.choice(times[1:], count - 1, replace=False)).tolist()
    bounds = [-np.inf, *cuts, np.inf]
    return [
        {name: [row for row in rows if first <= row[0] < last] for name, rows in whole.items()}
        for first, last in pairwise(bounds)
    ]


def _flow(part: Mapping[str, Rows], senders: Mapping[str, Sender]) -> None:
    """Send a part piece by piece to all sources in turn."""
    for piece in range(PIECES):
        began = time.monotonic()
        for name, rows in part.items():
            own = rows[len(rows) * piece // PIECES : len(rows) * (piece + 1) // PIECES]
            if own:
                senders[name].send(own)
        time.sleep(max(FLOW_S / PIECES - (time.monotonic() - began), 0.0))
