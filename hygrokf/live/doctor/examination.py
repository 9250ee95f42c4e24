"""Examination of everything that a tracker needs: clock, files, sources, store, models, page and channels.

The examination changes nothing.
"""

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
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hygrokf.data.signals import SIGNALS
from hygrokf.data.structured import JsonObject, plain
from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.live.config import Config
from hygrokf.live.doctor.check import (
    certificate_checks,
    machine_checks,
    monotonic_epoch,
    of_names,
    rounded,
    worst,
)
from hygrokf.live.doctor.sources import examine_sources
from hygrokf.live.notification.channel import Channel, ChannelFault, NoticeMessage
from hygrokf.live.plan import Plan
from hygrokf.live.sources.stream import Stream
from hygrokf.live.storage.database import StoreUnready, one_line
from hygrokf.live.storage.schema import VERSION, observation
from hygrokf.live.storage.sqlite import path_of
from hygrokf.live.storage.statements import select_newest, select_rows
from hygrokf.live.storage.store import Store, StoreFault, open_store
from hygrokf.live.tracker import Reading, Tracker, tracked_record
from hygrokf.live.turbine import Turbine, digest
from hygrokf.live.web.page_settings import PageFault, PageSettings
from hygrokf.live.web.server import listening_socket
from hygrokf.modelling.inputs import model_inputs
from hygrokf.physics.signal_names import AMBIENT_HUMIDITIES
from hygrokf.texts.doctor_codes import CHECK_LEVELS, DOUBT, FAULT, OK, Check, CheckCode, ExaminedCode
from hygrokf.texts.reasons import REJECT
from hygrokf.texts.statement import Statement

PAGE_ANSWER_S = 5.0
"""Longest time that the page may take to answer [s]."""
TRIAL_H = 72
"""Length of the artificial readings on which a model is tried [h]."""


def examine(
    config: Config,
    file: Path | None = None,
    wait_s: float = 10.0,
    with_page: bool = True,
    send_notices: bool = False,
) -> list[Check]:
    """Check the clock, the files that the tracker's `file` names, its sources, store, models, page and
    channels.

    Sources that send by themselves are observed for `wait_s` [s], all at the same time.  With `send_notices`
    a test message is sent to every channel.
    """
    epoch_s, contents = monotonic_epoch(), StoreContents()
    # the turbine with the smallest tolerance decides whether a reading is late
    lateness_s = min((turbine.plan.lateness_s for turbine in config.turbines.values()), default=math.inf)
    sources = examine_sources(config.streams, wait_s, lateness_s)
    played_back = all(stream.played_back for stream in config.streams if not stream.mapping.weather)
    checks_of_store = list(
        store_checks(config.store, config.turbines, config.retention_s, played_back, contents)
    )
    received = {name: set(signals) for name, signals in contents.signals.items()}
    for _, statistics in sources:
        for turbine, signal in statistics.newest:
            received.setdefault(turbine, set()).add(signal)
    return [
        *machine_checks(epoch_s, contents.received_s),
        *(certificate_checks(file) if file is not None else ()),
        *(check for checks, _ in sources for check in checks),
        *checks_of_store,
        *model_checks(config.turbines, config.streams, received),
        *(page_checks(config.page) if with_page else ()),
        *channel_checks(config.channels, send_notices),
    ]


def page_checks(settings: PageSettings) -> Iterator[Check]:
    """Check whether the page can be served, or whether a running tracker already serves it."""
    about = f"page {settings.place}"
    if None in map(importlib.util.find_spec, ("starlette", "uvicorn", "prometheus_client")):
        yield CheckCode.PAGE_PACKAGES_MISSING(about)
        return
    try:
        listening_socket(settings).close()
        if settings.unix:
            Path(settings.unix).unlink()
        yield CheckCode.PAGE_ADDRESS_FREE(about)
    except PageFault as error:
        page_fault = _running_page_fault(settings)
        if page_fault is None:
            yield CheckCode.PAGE_ADDRESS_TAKEN(about, fault=str(error))
        elif page_fault:
            yield CheckCode.PAGE_REPORTS(about, fault=page_fault)
        else:
            yield CheckCode.PAGE_HEALTHY(about)


def _running_page_fault(settings: PageSettings) -> str | None:
    """Return the fault that a tracker's page at the address reports, "" without a fault; None if the address
    has no such page."""
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(settings.host, settings.host)
    connection = http.client.HTTPConnection(host, settings.port, timeout=PAGE_ANSWER_S)
    try:
        if settings.unix:
            connection.sock = socket.socket(socket.AF_UNIX)
            connection.sock.settimeout(PAGE_ANSWER_S)
            connection.sock.connect(settings.unix)
        try:
            connection.request("GET", "/healthz")
            answer = json.loads(connection.getresponse().read(10_000))
        finally:
            connection.close()
    except (OSError, http.client.HTTPException, ValueError):
        return None
    if not isinstance(answer, dict) or not set(answer) & {"ok", "fault"}:
        return None
    return "" if answer.get("ok") is True else str(answer.get("fault"))[:200]


def channel_checks(channels: Sequence[Channel], send: bool) -> list[Check]:
    """Check all channels at the same time; with `send` a test message is sent to each channel."""
    if not channels:
        return []
    with ThreadPoolExecutor(min(len(channels), 8)) as pool:
        by_channel = pool.map(lambda channel: list(_channel_checks(channel, send)), channels)
        return [check for checks in by_channel for check in checks]


def _channel_checks(channel: Channel, send: bool) -> Iterator[Check]:
    """Check one channel; with `send` a test message is sent to it."""
    about = f"notify {channel.name}"
    for caution in channel.cautions():
        yield replace(caution, about=about)
    try:
        yield CheckCode.CHANNEL_ANSWERS(about, where=channel.where, answer=channel.probe())
        if send:
            channel.send(NoticeMessage(secrets.token_hex(16)))  # a message without contents is a test
            yield CheckCode.CHANNEL_ACCEPTS(about)
    except ChannelFault as error:
        yield CheckCode.CHANNEL_FAILS(about, fault=str(error))


def checks_text(checks: list[Check]) -> str:
    """Return one line per check, then the number of checks at each level and a conclusion."""
    counts = [f"{sum(check.level == level for check in checks)} {level}" for level in CHECK_LEVELS]
    conclusion = "ready to track" if worst(checks) != FAULT else "fix the faults first"
    return "\n".join([*map(str, checks), f"{', '.join(counts)}: {conclusion}"])


def checks_data(checks: list[Check]) -> JsonObject:
    """Return the checks as JSON data."""
    return {"level": worst(checks), "checks": plain(checks)}


# -- models --------------------------------------------------------------------------------------------------
def model_checks(
    turbines: Mapping[str, Turbine], streams: Sequence[Stream], received: Mapping[str, Collection[str]]
) -> Iterator[Check]:
    """Check every turbine's model; `received`: turbine → signals that a source or the store has delivered."""
    runnable, unheard = [], []
    for name, turbine in turbines.items():
        mapped = set[str]().union(*(stream.signals(name) for stream in streams))
        for part, verdict in turbine.verdicts.items():
            if verdict.verdict == REJECT:
                yield CheckCode.NUMBER_REJECTED(
                    f"turbine {name}", part=part, words=verdict.words, why=verdict.why
                )
        fault = model_fault(turbine.plan, mapped, f"turbine {name}")
        if fault is not None:
            yield fault
            continue
        if mapped.isdisjoint(turbine.plan.model.outputs):
            yield CheckCode.MODEL_ALONE(f"turbine {name}")
        if "operating" in turbine.plan.model.inputs and "active_power" not in mapped:
            yield CheckCode.STANDSTILL_ASSUMED(f"turbine {name}")
        missing = missing_signals(turbine.plan, mapped, received.get(name, ()))
        yield from of_names(
            f"turbine {name}", missing if received.get(name) else (), CheckCode.INPUTS_NEVER_ARRIVED
        )
        if not received.get(name):
            unheard.append(name)
        elif not missing:
            runnable.append(name)
    yield from of_names("turbines", unheard, CheckCode.TURBINES_NEVER_HEARD)
    if runnable:
        yield CheckCode.MODELS_CAN_RUN("turbines", count=len(runnable))


def missing_signals(plan: Plan, mapped: Collection[str], received: Collection[str]) -> list[str]:
    """Return mapped signals that a model reads but never got; of the ambient humidities one is enough."""
    inputs = {*plan.model.inputs, *plan.model.outputs, "ambient_temperature"}
    if "operating" in inputs or plan.design.power_order:
        inputs.add("active_power")
    if "ambient_absolute_humidity" in inputs and set(received).isdisjoint(AMBIENT_HUMIDITIES):
        inputs |= set(AMBIENT_HUMIDITIES)
    elif "ambient_absolute_humidity" in inputs:
        inputs -= set(AMBIENT_HUMIDITIES)
    return sorted(inputs & set(mapped) - set(received))


def model_fault(plan: Plan, signals: Collection[str], about: str) -> Check | None:
    """Return the check that says why a model cannot run on readings of these signals; None if it can run.

    The model is run on artificial readings between the limits of each signal.
    """
    times = HOUR_S * np.arange(1.0, TRIAL_H)
    shares = np.resize((0.5, 0.500001), len(times))  # readings that never change would count as frozen
    values = {name: SIGNALS[name].low + shares * (SIGNALS[name].high - SIGNALS[name].low) for name in signals}
    first_readings = [Reading(name, 0.0, float(series[0])) for name, series in values.items()]
    awaited = Tracker(plan, readings=first_readings).awaited()
    if awaited:
        return CheckCode.INPUTS_NOT_MAPPED(about, names=tuple(awaited))
    try:
        model_inputs(plan.design, tracked_record(plan, dict.fromkeys(values, times), values))
    except (ValueError, KeyError) as error:
        return CheckCode.MODEL_CANNOT_RUN(about, fault=str(error))
    return None


# -- the store -----------------------------------------------------------------------------------------------
LEAST_FREE = 100_000_000
"""Free space [bytes] below which the disk may be full at any time."""
SOON_D = 30.0
"""Time until the disk is full [d] below which the doctor doubts that it suffices."""


@dataclass
class StoreContents:
    """Contents of the store: turbine → signals ever received, and the arrival of the newest reading [s, −∞
    without readings]."""

    signals: dict[str, set[str]] = field(default_factory=dict)
    received_s: float = -math.inf


def store_checks(
    url: str, turbines: Mapping[str, Turbine], retention_s: float, played_back: bool, contents: StoreContents
) -> Iterator[Check]:
    """Check the store at a URL and add its contents to `contents`.

    played_back: whether all sources play back records, so that the age of data is not judged.
    """
    try:
        store = open_store(url, read_only=True)
    except StoreUnready:
        if url.startswith("sqlite:") and not os.access(path_of(url).parent, os.W_OK):
            yield CheckCode.STORE_FOLDER_LOCKED("store", folder=str(path_of(url).parent))
        else:
            yield CheckCode.STORE_TO_BE_MADE("store", url=url)
        return
    except StoreFault as error:
        yield CheckCode.STORE_FAILS("store", fault=str(error))
        return
    try:
        yield from _open_store_checks(store, turbines, retention_s, played_back, contents)
    except StoreFault as error:
        yield CheckCode.STORE_FAILS("store", fault=str(error))
    except store.database.errors as error:
        yield CheckCode.STORE_UNREADABLE("store", url=url, fault=one_line(error))
    finally:
        store.close()


def _open_store_checks(
    store: Store,
    turbines: Mapping[str, Turbine],
    retention_s: float,
    played_back: bool,
    contents: StoreContents,
) -> Iterator[Check]:
    """Check an open store, and add its contents to `contents`."""
    damages = store.database.faults()
    if damages:
        yield CheckCode.STORE_DAMAGED("store", url=store.url, damages="; ".join(damages))
        return
    size = store.database.size()
    yield CheckCode.STORE_INTACT("store", url=store.url, version=VERSION, size=size)
    if not store.database.may_write():
        yield CheckCode.STORE_READ_ONLY("store")
    spans = _read_contents(store, turbines, contents)
    if store.url.startswith("sqlite:"):
        free = shutil.disk_usage(path_of(store.url).parent).free
        yield _disk_check(size, free, max(spans.values(), default=0.0), retention_s)
    yield from _claim_checks(store, turbines)
    yield from _turbine_checks(store, turbines)
    yield from _estimate_checks(store, turbines, played_back)


def _read_contents(
    store: Store, turbines: Mapping[str, Turbine], contents: StoreContents
) -> dict[str, float]:
    """Add signals and newest arrival of each turbine to `contents`; returns turbine → time span of its
    readings [s]."""
    spans: dict[str, float] = {}
    oldest = select_rows(observation, "time", "turbine", "time").limit(1)
    newest = select_newest(observation, "time received", "turbine")
    for name in turbines:
        contents.signals[name] = set(store.signals(name))
        for last, received in store.rows(newest, turbine=name):
            contents.received_s = max(contents.received_s, received)
            spans[name] = last - store.rows(oldest, turbine=name)[0][0]
    return spans


def _disk_check(size: int, free: int, span_s: float, retention_s: float) -> Check:
    """Check whether the disk has room for the store's growth until retention stops it.

    size, free: of the store and of the disk [bytes].  span_s: time span of the stored readings [s].
    """
    daily_growth = size * DAY_S / max(span_s, DAY_S)
    total_growth = daily_growth * max(retention_s - span_s, 0.0) / DAY_S
    if free >= LEAST_FREE and total_growth > free:
        days = free / daily_growth
        level = FAULT if days < 1.0 else DOUBT if days < SOON_D else OK
        return CheckCode.DISK_FILLS("store", level, free=free, a_day=daily_growth, days=days)
    return CheckCode.DISK_ROOM("store", FAULT if free < LEAST_FREE else OK, free=free, a_day=daily_growth)


def _claim_checks(store: Store, turbines: Mapping[str, Turbine]) -> Iterator[Check]:
    """Report which processes track the turbines now."""
    holders: dict[str, list[str]] = {}
    for (kind, name), process in store.database.claims().items():
        if kind == "turbine" and name in turbines:
            holders.setdefault(process, []).append(name)
    for process, names in holders.items():
        yield CheckCode.TURBINES_TRACKED("store", who=process, names=tuple(sorted(names)))
    if not holders:
        yield CheckCode.TURBINES_NOT_TRACKED("store")


def _turbine_checks(store: Store, turbines: Mapping[str, Turbine]) -> Iterator[Check]:
    """Check for turbines that are only in the store, only in the tracker's file, or had another model."""
    models = store.models()
    claimed = {name for kind, name in store.database.claims() if kind == "turbine"}
    only_stored = sorted(set(models) - set(turbines) - claimed)
    new = [name for name in turbines if name not in models]
    changed = [
        name for name, turbine in turbines.items() if name in models and models[name] != digest(turbine.plan)
    ]
    was_read = new and store.size()["source"]
    yield from of_names("store", only_stored, CheckCode.TURBINES_LEFT)
    yield from of_names(
        "store", new, CheckCode.TURBINES_MISS_THE_PAST if was_read else CheckCode.TURBINES_NEW
    )
    yield from of_names("store", changed, CheckCode.MODELS_CHANGED)


def _estimate_checks(store: Store, turbines: Mapping[str, Turbine], played_back: bool) -> Iterator[Check]:
    """Check whether the newest estimates of the turbines are old."""
    estimates = {name: store.newest_estimate(name) for name in turbines}
    newest = {name: estimate[0] for name, estimate in estimates.items() if estimate is not None}
    if not newest:
        yield CheckCode.NO_ESTIMATE_YET("store")
        return
    if played_back:
        yield CheckCode.ESTIMATES_OF_RECORD("store", names=tuple(newest))
        return
    old: list[Statement] = []
    fresh: list[Statement] = []
    for name, at in sorted(newest.items(), key=lambda entry: entry[1]):
        age = time.time() - at
        aged = ExaminedCode.AGED(turbine=name, age=rounded(age))
        (old if age > turbines[name].stale_s else fresh).append(aged)
    yield from of_names("store", old, CheckCode.ESTIMATES_OLD)
    yield from of_names("store", fresh, CheckCode.ESTIMATES_FRESH)
