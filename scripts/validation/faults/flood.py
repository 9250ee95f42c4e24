"""Many messages: late, in any order, twice, the last of them all once more; and a million with memory that
does not grow."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from builders.brokers import peer, publish

from hygrokf.live.sources.local import delay_and_repeat
from validation.faults.plant import LATENESS_S, Message, Outcome, Plant, counted, stored
from validation.faults.tracker import Tracker, broker_of, mqtt_source, tracking, unacknowledged, until

LATE_S = 0.9 * LATENESS_S
"""[s] by which a message comes late at most."""
TWICE = 0.1
"""Share of the messages that come a second time; after that the last tenth of all comes once more."""
A_DAY = 690
"""Messages of a turbine a day, near enough."""
CHUNK = 2_000
AHEAD = 20_000
"""Messages that are sent ahead of what the store knows."""
WARM = 400_000
"""Messages after which memory is looked at first: forecasts then have all the weeks of history that they ask
for."""
MOST_GROWTH = 1.05
"""The most memory in the second half of the rest may be so many times that of the first: some 40 bytes a
message."""
PATIENCE_S = 600.0


def flood(folder: Path, seed: int, count: int = 50_000, turbines: int = 10, through: str = "file") -> Outcome:
    """About `count` messages of some turbines, each up to `LATE_S` late; `through` a "file" that grows or a
    "broker"."""
    shares = (1.0 + TWICE) * 1.1
    plant = Plant(folder, days=count / shares / turbines / A_DAY, turbines=turbines)
    store = plant.store
    messages = [message for _, message in delay_and_repeat(plant.timed(), LATE_S, TWICE, seed)]
    whole = len(set(messages))
    messages += messages[-len(messages) // 10 :]
    memory: list[tuple[int, int]] = []
    began = time.monotonic()
    faults: list[str] = []
    with (into_file if through == "file" else into_broker)(plant, store, faults) as (tracker, send):
        for first in range(0, len(messages), CHUNK):
            send(messages[first : first + CHUNK])
            done = min(first + CHUNK, len(messages))
            if done % AHEAD < CHUNK or done == len(messages):
                until(lambda done=done: taken(store) >= done - AHEAD, tracker.said, patience_s=PATIENCE_S)
                memory.append((done, tracker.resident_kB() or 0))
        until(lambda: taken(store) >= len(messages), tracker.said, patience_s=PATIENCE_S)
        spent = time.monotonic() - began
        tracker.stop()
    # what comes again when its time is long final is late, too
    aside = counted(store)
    again = aside["repeated"] + aside["late"]
    if again != len(messages) - whole or aside.total() != again:
        faults.append(f"{len(messages) - whole} messages came again, counted were {dict(aside)}")
    words = f"{again:,} came again; {len(messages) / spent:,.0f} messages a second"
    half = (WARM + len(messages)) / 2
    early = [size / 1024 for done, size in memory if WARM <= done <= half]
    late = [size / 1024 for done, size in memory if done > half]
    if early and late:
        words += f"; memory {min(early):.0f} to {max(early):.0f} MB up to {half:,.0f} messages, "
        words += f"{min(late):.0f} to {max(late):.0f} MB after that"
        if max(late) > MOST_GROWTH * max(early):
            faults.append(f"memory grows: {words}")
    return plant.judged(1, len(messages), store, words=words, fault="; ".join(faults))


@contextmanager
def into_file(plant: Plant, store: str, faults: list[str]) -> Iterator[tuple]:
    """A tracker that follows a file, and what appends messages to it."""
    file = plant.folder / "messages.ndjson"
    with file.open("ab", buffering=0) as grown:

        def send(messages: Sequence[Message]) -> None:
            grown.write(b"".join(payload + b"\n" for _, payload in messages))

        with Tracker(plant.config('[[source]]\nurl = "file:messages.ndjson"', store)) as tracker:
            yield tracker, send


@contextmanager
def into_broker(plant: Plant, store: str, faults: list[str]) -> Iterator[tuple]:
    """A tracker that has subscribed at a broker, and what publishes messages there."""
    # its log tells subscriptions only, not every message
    quiet = ("allow_anonymous true", "log_type none", "log_type subscribe")
    with broker_of(plant, *quiet) as broker:
        with tracking(broker, plant.config(mqtt_source(broker), store)) as tracker, peer(broker) as client:
            yield tracker, lambda messages: publish(client, messages)
        left = unacknowledged(broker)
        faults += [left] if left else []


def taken(store: str) -> int:
    """Messages of which the store knows: observations and what was set aside."""
    return stored(store) + counted(store).total()
