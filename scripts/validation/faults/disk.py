"""A disk that takes no more, and a store that is damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from validation.faults.plant import Outcome, Plant, parts, stored
from validation.faults.tracker import (
    Tracker,
    broker_of,
    each_published,
    mqtt_source,
    tracking,
    unacknowledged,
    until,
)

FULL_BYTES = 100_000
"""The size beyond which the system lets no file of the tracker grow."""
DAMAGES = ("beginning", "page", "cut", "another file")


def full_disk(folder: Path, seed: int, fillings: int = 1) -> Outcome:
    """The system refuses every byte beyond a size (RLIMIT_FSIZE), takes them again, refuses them: and then
    comes a kill.

    What was acknowledged and not written would be missing after that.
    """
    import resource

    random, plant = np.random.default_rng(seed), Plant(folder)
    store, messages = plant.store, plant.messages()
    log = folder / "live.db-wal"
    unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    with broker_of(plant) as broker:
        config, failures, sent = plant.config(mqtt_source(broker), store), 0, 0
        with tracking(broker, config) as first:
            first.stop()
        *early, late = parts(messages, random, 2 * fillings + 1)
        for begin, rest in zip(early[::2], early[1::2], strict=True):
            half = len(begin) // 2
            with tracking(broker, config) as tracker:
                each_published(broker, begin[:half])
                sent += half
                until(lambda: log.exists() and log.stat().st_size > FULL_BYTES, tracker.said)
                # what the last filling kept out is redelivered and comes in first
                until(lambda sent=sent: stored(store) == sent, tracker.said)
                for part, is_last in ((begin[half:], False), (rest, True)):
                    before, told = stored(store), tracker.said().count("the store failed")
                    resource.prlimit(tracker.process.pid, resource.RLIMIT_FSIZE, (FULL_BYTES, unlimited[1]))
                    each_published(broker, part)
                    sent += len(part)
                    until(lambda told=told: tracker.said().count("the store failed") > told, tracker.said)
                    failures += 1
                    assert stored(store) == before, "something was written onto a full disk"
                    if is_last:
                        tracker.kill()
                        break
                    resource.prlimit(tracker.process.pid, resource.RLIMIT_FSIZE, unlimited)
                    until(lambda sent=sent: stored(store) == sent, tracker.said)
        each_published(broker, late)
        with tracking(broker, config) as tracker:
            until(lambda: stored(store) >= len(messages), tracker.said)
            tracker.stop()
        fault = unacknowledged(broker)
    words = f"{failures} times full, {fillings} times killed while it was"
    return plant.judged(failures, len(messages), store, words=words, fault=fault)


def damaged_store(folder: Path, seed: int, damage: str = "page") -> Outcome:
    """A damaged file is refused in words, and is afterwards what it was, byte for byte; put right, all goes
    on."""
    random, plant = np.random.default_rng(seed), Plant(folder, days=2.0)
    path = folder / "live.db"
    store, file = plant.store, folder / "messages.ndjson"
    lines = [payload + b"\n" for _, payload in plant.messages()]
    file.write_bytes(b"".join(lines[: len(lines) // 2]))
    config = plant.config('[[source]]\nurl = "file:messages.ndjson"\nfollow = false', store)
    with Tracker(config, "--until-ended") as tracker:
        tracker.ended()
    whole = path.read_bytes()
    path.write_bytes(damaged(whole, damage, random))
    before = _bytes(folder)
    with Tracker(config, "--until-ended") as tracker:
        status = tracker.process.wait(timeout=60.0)
    said = tracker.said().splitlines()
    fault = ""
    if status == 0 or any("Traceback" in line for line in said):
        fault = f"it ended with {status} and said {said[-1:]}"
    elif not before.items() <= _bytes(folder).items():
        fault = "the store was changed"
    path.write_bytes(whole)
    with file.open("ab") as more:
        more.write(b"".join(lines[len(lines) // 2 :]))
    with Tracker(config, "--until-ended") as tracker:
        tracker.ended()
    words = f"{damage}: {said[-1][:160]}"
    return plant.judged(1, len(lines), store, words=words, fault=fault)


def damaged(whole: bytes, damage: str, random: np.random.Generator) -> bytes:
    """A store's file after a damage of a kind of `DAMAGES`, at a random place."""
    data = bytearray(whole)
    if damage == "beginning":
        place = int(random.integers(0, 16))
        data[place] ^= 0xFF
    elif damage == "page":  # where the cells of an inner or an outer page begin
        pages = [p for p in range(4096, len(data), 4096) if data[p] in (2, 5, 10, 13)]
        place = pages[int(random.integers(0, len(pages)))]
        data[place : place + 8] = random.bytes(8)
    elif damage == "cut":
        del data[int(random.integers(4096, len(data) - 1)) :]
    else:
        data[:] = random.bytes(len(data))
    return bytes(data)


def _bytes(folder: Path) -> dict[str, bytes]:
    """The store's files but for the lock, which holds nothing; to look at one SQLite puts an empty log beside
    it."""
    return {one.name: one.read_bytes() for one in folder.glob("live.db*") if one.suffix != ".lock"}
