"""Checks of the store from the tracker's point of view: reachable, intact, with room to grow, up to date.
They only read."""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from hygrokf.data.timestamps import DAY_S
from hygrokf.live.doctor.check import Check, doubt, fault, lasting, of_names, ok
from hygrokf.live.sources.stream import several
from hygrokf.live.storage.database import StoreUnready, one_line
from hygrokf.live.storage.schema import VERSION
from hygrokf.live.storage.sqlite import path_of
from hygrokf.live.storage.store import Store, StoreFault, open_store
from hygrokf.live.turbines import Turbine, digest

REACH = "check the store's URL, its server or folder, and this user's rights; restore a copy if it is damaged"
LEAST_FREE = 100_000_000
"""Free space [bytes] below which the disk may be full at any time."""
SOON_D = 30.0
"""Time until the disk is full [d] below which to make room."""


@dataclass
class StoreContents:
    """Contents of the store: turbine -> signals ever received, and the arrival of the newest reading [s]."""

    signals: dict[str, set[str]] = field(default_factory=dict)
    received_s: float = -math.inf


def store_checks(
    url: str, turbines: Mapping[str, Turbine], retention_s: float, played_back: bool, contents: StoreContents
) -> Iterator[Check]:
    """Check the store at a URL; its contents go to `contents`.  With `played_back` the age of data is not
    judged."""
    try:
        store = open_store(url, read_only=True)
    except StoreUnready:
        if url.startswith("sqlite:") and not os.access(path_of(url).parent, os.W_OK):
            said = f"{path_of(url).parent} is not writable"
            yield fault("store", said, "check the folder's permissions")
        else:
            yield ok("store", f"{url} does not exist yet; the tracker creates it at its first start")
        return
    except StoreFault as error:
        yield fault("store", *_finding_and_remedy(str(error)))
        return
    try:
        yield from _contents(store, turbines, retention_s, played_back, contents)
    except StoreFault as error:
        yield fault("store", *_finding_and_remedy(str(error)))
    except store.database.errors as error:
        yield fault(
            "store",
            f"{url} cannot be read ({one_line(error)})",
            "restore a copy, or name a new store",
        )
    finally:
        store.close()


def _finding_and_remedy(words: str) -> tuple[str, str]:
    """Split a fault's message into the finding and the remedy after the first semicolon; `REACH` without
    one."""
    found, _, remedy = words.partition("; ")
    return found, remedy or REACH


def _contents(
    store: Store,
    turbines: Mapping[str, Turbine],
    retention_s: float,
    played_back: bool,
    contents: StoreContents,
) -> Iterator[Check]:
    damages = store.database.faults()
    if damages:
        yield fault(
            "store", f"{store.url} is damaged ({'; '.join(damages)})", "move it away and restore a copy"
        )
        return
    size = store.database.size()
    yield ok("store", f"{store.url} is reached and intact; version {VERSION}, {_bytes(size)}")
    if not store.database.may_write():
        yield fault("store", "this user may not write into it", "grant the tracker's user write permission")
    spans = _read_contents(store, turbines, contents)
    if store.url.startswith("sqlite:"):
        free = shutil.disk_usage(path_of(store.url).parent).free
        yield _room(size, free, max(spans.values(), default=0.0), retention_s)
    yield from _claims(store, turbines)
    yield from _turbines(store, turbines)
    yield from _estimates(store, turbines, played_back)


def _read_contents(
    store: Store, turbines: Mapping[str, Turbine], contents: StoreContents
) -> dict[str, float]:
    """Note the signals of each turbine in `contents`; returns turbine → time span of its readings [s]."""
    spans = {}
    for name in turbines:
        contents.signals[name] = set(store.signals(name))
        rows = store.rows(
            "SELECT time, received FROM observation WHERE turbine = ? ORDER BY time DESC LIMIT 1", (name,)
        )
        for newest, received in rows:
            contents.received_s = max(contents.received_s, received)
            oldest = store.rows("SELECT MIN(time) FROM observation WHERE turbine = ?", (name,))[0][0]
            spans[name] = newest - oldest
    return spans


def _room(size: int, free: int, span_s: float, retention_s: float) -> Check:
    """Whether the disk has room for the growth until retention stops it."""
    a_day = size * DAY_S / max(span_s, DAY_S)
    coming = a_day * max(retention_s - span_s, 0.0) / DAY_S
    said = f"{_bytes(free)} free on its disk; it grows by about {_bytes(a_day)} a day"
    remedy = "make room, keep less (retention), or move the store"
    if free < LEAST_FREE:
        return fault("store", said, remedy)
    if coming > free:
        days = free / a_day
        found = f"{said}, which fills it in {days:.0f} d, before retention stops its growth"
        return (
            (fault if days < 1.0 else doubt)("store", found, remedy) if days < SOON_D else ok("store", found)
        )
    return ok("store", said)


def _claims(store: Store, turbines: Mapping[str, Turbine]) -> Iterator[Check]:
    holders: dict[str, list[str]] = {}
    for (kind, name), who in store.database.claims().items():
        if kind == "turbine" and name in turbines:
            holders.setdefault(who, []).append(name)
    for who, names in holders.items():
        yield ok("store", f"{who} tracks {several(sorted(names))} now")
    if not holders:
        yield ok("store", "no process tracks these turbines now")


def _turbines(store: Store, turbines: Mapping[str, Turbine]) -> Iterator[Check]:
    """Turbines that only the store or only the tracker's file has, or that had another model."""
    known = {name: model for name, model in store.rows("SELECT name, model FROM turbine")}
    claimed = {name for kind, name in store.database.claims() if kind == "turbine"}
    left = sorted(set(known) - set(turbines) - claimed)
    new = [name for name in turbines if name not in known]
    changed = [
        name for name, one in turbines.items() if known.get(name, digest(one.plan)) != digest(one.plan)
    ]
    was_read = new and store.rows("SELECT url FROM source")
    yield from of_names(
        "store",
        (
            "doubt", left, "no process tracks {}, which it contains",
            "add a [[turbine]], or delete their rows by hand",
        ),
        (
            "doubt", new if was_read else [], "it does not contain {} yet, but its sources were read for "
            "others: only what comes after that is read for these",
            "nothing if this is intended; name a new store to read a file from its start",
        ),
        ("ok", [] if was_read else new, "it does not contain {} yet: their first readings add them", ""),
        (
            "doubt", changed, "{} had another model, or readings in another form, when last tracked",
            "nothing if this is intended: the next start filters their readings again",
        ),
    )  # fmt: skip


def _estimates(store: Store, turbines: Mapping[str, Turbine], played_back: bool) -> Iterator[Check]:
    newest = {
        name: at
        for name in turbines
        for (at,) in store.rows("SELECT MAX(time) FROM estimate WHERE turbine = ?", (name,))
        if at is not None
    }
    if not newest:
        yield doubt("store", "it has no estimate yet", "start the tracker; read its log if none appears")
        return
    if played_back:
        yield ok("store", f"it has estimates of {several(newest)}")
        return
    old: list[str] = []
    fresh: list[str] = []
    for name, at in sorted(newest.items(), key=lambda one: one[1]):
        age = time.time() - at
        (old if age > turbines[name].stale_s else fresh).append(f"{name} {lasting(age)} ago")
    check = "check whether the tracker runs and readings arrive"
    yield from of_names(
        "store",
        ("doubt", old, "newest estimates are old: {}", check),
        ("ok", fresh, "newest estimates: {}", ""),
    )


def _bytes(count: float) -> str:
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count:.0f} bytes"
