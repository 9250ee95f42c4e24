"""The clock of the tracker's machine jumps: forward, back a little, and back so far that messages come from
its future."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path

import numpy as np

from validation.faults.plant import Outcome, Plant, counted, held, stored
from validation.faults.tracker import broker_of, each_published, mqtt_source, tracking, unacknowledged, until

HOOK = """\
import time
from pathlib import Path

_FILE, _TRUE = Path(__file__).with_name("offset"), time.time


def _jumping():
    return _TRUE() + float(_FILE.read_text() or 0.0)


time.time = _jumping
"""
"""`sitecustomize`, which Python imports at its start: the clock is off by what the file `offset` says [s]."""
DAY_S = 86400.0


def jumping_clock(folder: Path, seed: int) -> Outcome:
    """Four jumps while messages flow; what is more than 15 min ahead of the clock is held back until it is
    right again, and nothing is lost."""
    random, plant = np.random.default_rng(seed), Plant(folder)
    store, rows = plant.store, plant.timed()
    cuts = [0, *(_cut(rows, share) for share in (0.2, 0.4, 0.6, 0.7, 0.9)), len(rows)]
    hook = folder / "hook"
    hook.mkdir()
    (hook / "sitecustomize.py").write_text(HOOK)

    def clock(at: float) -> None:
        whole = hook / "new"
        whole.write_text(f"{at - time.time()!r}")
        whole.replace(hook / "offset")

    clock(time.time())
    most_held = 0
    with broker_of(plant) as broker:
        with tracking(broker, plant.config(mqtt_source(broker), store), hook) as tracker:
            sent = 0
            for number, (first, last) in enumerate(pairwise(cuts)):
                part = rows[first:last]
                ends = part[-1][0]
                if number == 1:
                    clock(time.time() + float(random.uniform(10.0, 400.0)) * DAY_S)
                elif number == 2:  # behind what comes, by less than is forgiven
                    clock(ends - float(random.uniform(60.0, 600.0)))
                elif number == 3:  # behind all of it
                    clock(part[0][0] - float(random.uniform(1.0, 30.0)) * DAY_S)
                elif number == 4:
                    clock(ends + 10.0)
                else:
                    clock(time.time())
                each_published(broker, [message for _, message in part])
                sent += len(part)
                until(
                    lambda sent=sent: stored(store) + held(store) == sent,
                    lambda: (stored(store), held(store), counted(store), tracker.said()),
                )
                most_held = max(most_held, held(store))
            tracker.stop()
        fault = unacknowledged(broker)
    if not most_held or held(store) or counted(store):
        fault = f"{most_held} readings were held back, {held(store)} still are, counted: {counted(store)}"
    words = f"clock a day behind: {most_held} messages held back until it was right; no jump changes anything"
    return plant.judged(5, len(rows), store, words=words, fault=fault)


def _cut(rows: list, share: float) -> int:
    """A place near a share of the rows at which a new time begins."""
    place = int(len(rows) * share)
    while rows[place][0] == rows[place - 1][0]:
        place += 1
    return place
