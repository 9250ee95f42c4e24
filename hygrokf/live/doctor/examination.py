"""The whole examination: clock, files, sources, store, models, page, channels; changing nothing."""

from __future__ import annotations

import http.client
import importlib.util
import json
import math
import os
import secrets
import shutil
import socket
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from hygrokf.data.signals import SIGNALS
from hygrokf.data.structured import JsonObject
from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.identification.verdict_terms import REJECT
from hygrokf.live.config import Config
from hygrokf.live.doctor.check import (
    LEVELS,
    Check,
    doubt,
    elapsed_from,
    fault,
    file_checks,
    lasting,
    machine_checks,
    of_names,
    ok,
    worst,
)
from hygrokf.live.doctor.sources import examine_sources
from hygrokf.live.notification.channel import Channel, ChannelFault, NoticeMessage
from hygrokf.live.plan import AMBIENT_HUMIDITIES, Plan
from hygrokf.live.sources.stream import Stream, several
from hygrokf.live.storage.database import StoreUnready, one_line
from hygrokf.live.storage.schema import VERSION, observation
from hygrokf.live.storage.sqlite import path_of
from hygrokf.live.storage.statements import newest, selecting
from hygrokf.live.storage.store import Store, StoreFault, open_store
from hygrokf.live.tracker import Reading, Tracker, record_of
from hygrokf.live.turbines import Turbine, digest
from hygrokf.live.web.page_settings import PageFault, PageSettings
from hygrokf.live.web.server import listening_socket
from hygrokf.modelling.inputs import model_inputs

ANSWER_S = 5.0
"""[s] allowed for a page's answer."""
TRIED_H = 72
"""Length of the readings on which a model is tried [h]."""
_MEND = "correct [[notify]], or the server; notices wait in the store meanwhile"


def examine(
    config: Config,
    file: Path | None = None,
    wait_s: float = 10.0,
    with_page: bool = True,
    send_notices: bool = False,
) -> list[Check]:
    """Check the clock, the files that the tracker's `file` names, its sources, store, models, page and
    channels.

    Sources that send by themselves are observed for `wait_s` [s], all at the same time.  `send_notices`: a
    test message goes to every channel.
    """
    began, contents = elapsed_from(), StoreContents()
    # the strictest turbine decides what counts as late
    lateness_s = min((one.plan.lateness_s for one in config.turbines.values()), default=math.inf)
    sources = examine_sources(config.streams, wait_s, lateness_s)
    played_back = all(one.played_back for one in config.streams if not one.mapping.weather)
    of_store = list(store_checks(config.store, config.turbines, config.retention_s, played_back, contents))
    came = {name: set(signals) for name, signals in contents.signals.items()}
    for _, statistics in sources:
        for turbine, signal in statistics.newest:
            came.setdefault(turbine, set()).add(signal)
    return [
        *machine_checks(began, contents.received_s),
        *(file_checks(file) if file is not None else ()),
        *(check for checks, _ in sources for check in checks),
        *of_store,
        *model_checks(config.turbines, config.streams, came),
        *(page_checks(config.page) if with_page else ()),
        *channel_checks(config.channels, send_notices),
    ]


def page_checks(settings: PageSettings) -> Iterator[Check]:
    """Whether the page can be served, or a running tracker already serves it."""
    about = f"page {settings.place}"
    if None in map(importlib.util.find_spec, ("starlette", "uvicorn", "prometheus_client")):
        yield fault(about, "its packages are missing", "pip install 'hygrokf[live]', or start with --no-page")
        return
    try:
        listening_socket(settings).close()
        if settings.unix:
            Path(settings.unix).unlink()
        yield ok(about, "the address is free")
    except PageFault as error:
        said = _page_says(settings)
        if said is None:
            words, _, remedy = str(error).partition("; ")
            yield fault(about, words, remedy or "give another address")
        elif said:
            yield doubt(
                about, f"a tracker's page already runs there and reports: {said}", "read that tracker's log"
            )
        else:
            yield ok(about, "a tracker's page already runs there and is healthy")


def _page_says(settings: PageSettings) -> str | None:
    """The fault that a tracker's page at the address reports, empty for none; None if there is no such
    page."""
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(settings.host, settings.host)
    connection = http.client.HTTPConnection(host, settings.port, timeout=ANSWER_S)
    try:
        if settings.unix:
            connection.sock = socket.socket(socket.AF_UNIX)
            connection.sock.settimeout(ANSWER_S)
            connection.sock.connect(settings.unix)
        try:
            connection.request("GET", "/healthz")
            found = json.loads(connection.getresponse().read(10_000))
        finally:
            connection.close()
    except (OSError, http.client.HTTPException, ValueError):
        return None
    if not isinstance(found, dict) or not set(found) & {"ok", "fault"}:
        return None
    return "" if found.get("ok") is True else str(found.get("fault"))[:200]


def channel_checks(channels: Sequence[Channel], send: bool) -> list[Check]:
    """Check channels, all at the same time; `send`: with a test message to each."""
    if not channels:
        return []
    with ThreadPoolExecutor(min(len(channels), 8)) as pool:
        found = pool.map(lambda one: list(_channel_checks(one, send)), channels)
        return [check for checks in found for check in checks]


def _channel_checks(channel: Channel, send: bool) -> Iterator[Check]:
    about = f"notify {channel.name}"
    for caution in channel.cautions():
        yield doubt(about, caution, "use TLS and a secret where others could listen")
    try:
        yield ok(about, f"{channel.where}: {channel.probe()}")
        if send:
            channel.send(NoticeMessage(secrets.token_hex(16)))  # without contents it is a test
            yield ok(about, "a test message was accepted")
    except ChannelFault as found:
        yield fault(about, str(found), _MEND)


def as_text(checks: list[Check]) -> str:
    """One line per check, and the number of checks at each level with a conclusion."""
    counts = [f"{sum(one.level == level for one in checks)} {level}" for level in LEVELS]
    said = "ready to track" if worst(checks) != "fault" else "fix the faults first"
    return "\n".join([*map(str, checks), f"{', '.join(counts)}: {said}"])


def as_data(checks: list[Check]) -> JsonObject:
    """The checks as JSON data."""
    return {"level": worst(checks), "checks": [asdict(one) for one in checks]}


# -- models --------------------------------------------------------------------------------------------------
def model_checks(
    turbines: Mapping[str, Turbine], streams: Sequence[Stream], came: Mapping[str, Collection[str]]
) -> Iterator[Check]:
    """Check every turbine's model; `came`: turbine → signals of which the store or a source has readings."""
    fine, unheard = [], []
    for name, one in turbines.items():
        mapped = set[str]().union(*(stream.signals(name) for stream in streams))
        for part, verdict in one.verdicts.items():
            if verdict.verdict == REJECT:
                yield doubt(
                    f"turbine {name}",
                    f"the {part} time constant of its model is {verdict.words}: {verdict.why}",
                    "read the fit's report; estimates and alarms that rest on this number say so",
                )
        wrong = model_fault(one.plan, mapped)
        if wrong is not None:
            yield fault(f"turbine {name}", *wrong)
            continue
        if mapped.isdisjoint(one.plan.model.outputs):
            yield ok(
                f"turbine {name}",
                "no mapped field is a reading of its cabinet: the estimates come from the model alone",
            )
        if "operating" in one.plan.model.inputs and "active_power" not in mapped:
            yield doubt(
                f"turbine {name}",
                "the model needs the operation, but no mapped field is active_power: it assumes standstill",
                "add the field to [mapping.signals]",
            )
        absent = lacking(one.plan, mapped, came.get(name, ()))
        names = "compare the names in [mapping.signals] with the delivered payloads"
        if not came.get(name):
            unheard.append(name)
        elif absent:
            found = f"its model reads {several(absent)}, which never arrived"
            yield doubt(f"turbine {name}", found, names)
        else:
            fine.append(name)
    known_as = "compare their known_as with the names in the payloads, or wait longer (--wait 10min)"
    yield from of_names("turbines", ("doubt", unheard, "no reading of {} has ever arrived", known_as))
    if fine:
        yield ok("turbines", f"{len(fine)} have a model that can run, and have delivered all its inputs")


def lacking(plan: Plan, mapped: Collection[str], came: Collection[str]) -> list[str]:
    """Mapped signals that a model uses but that never came; any one of the ambient's humidities is enough."""
    inputs = {*plan.model.inputs, *plan.model.outputs, "ambient_temperature"}
    if "operating" in inputs or plan.design.power_order:
        inputs.add("active_power")
    if "ambient_absolute_humidity" in inputs and set(came).isdisjoint(AMBIENT_HUMIDITIES):
        inputs |= set(AMBIENT_HUMIDITIES)
    elif "ambient_absolute_humidity" in inputs:
        inputs -= set(AMBIENT_HUMIDITIES)
    return sorted(inputs & set(mapped) - set(came))


def model_fault(plan: Plan, signals: Collection[str]) -> tuple[str, str] | None:
    """Why a model cannot run on these signals, whatever their readings, and what to do; None if it can."""
    times = HOUR_S * np.arange(1.0, TRIED_H)
    near = np.resize((0.5, 0.500001), len(times))  # readings that never change would count as frozen
    values = {name: SIGNALS[name].low + near * (SIGNALS[name].high - SIGNALS[name].low) for name in signals}
    awaited = Tracker(
        plan, readings=(Reading(name, 0.0, float(v[0])) for name, v in values.items())
    ).awaited()
    if awaited:
        return (
            f"its model needs {several(awaited)}, but no mapped field provides it",
            "add it to [mapping.signals]",
        )
    try:
        model_inputs(plan.design, record_of(plan, dict.fromkeys(values, times), values))
    except (ValueError, KeyError) as error:
        return (
            f"its model cannot be run on these signals: {error}",
            "correct [mapping.signals] or [[turbine]], or fit the model again",
        )
    return None


# -- the store -----------------------------------------------------------------------------------------------
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
    spans, first = {}, selecting(observation, "time", "turbine", "time").limit(1)
    for name in turbines:
        contents.signals[name] = set(store.signals(name))
        for last, received in store.rows(newest(observation, "time received", "turbine"), turbine=name):
            contents.received_s = max(contents.received_s, received)
            spans[name] = last - store.rows(first, turbine=name)[0][0]
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
    known = store.models()
    claimed = {name for kind, name in store.database.claims() if kind == "turbine"}
    left = sorted(set(known) - set(turbines) - claimed)
    new = [name for name in turbines if name not in known]
    changed = [
        name for name, one in turbines.items() if known.get(name, digest(one.plan)) != digest(one.plan)
    ]
    was_read = new and store.size()["source"]
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
    estimated = {name: one[0] for name in turbines if (one := store.newest_estimate(name)) is not None}
    if not estimated:
        yield doubt("store", "it has no estimate yet", "start the tracker; read its log if none appears")
        return
    if played_back:
        yield ok("store", f"it has estimates of {several(estimated)}")
        return
    old: list[str] = []
    fresh: list[str] = []
    for name, at in sorted(estimated.items(), key=lambda one: one[1]):
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
