"""The whole examination: clock, files, sources, store, models, page, channels; changing nothing."""

from __future__ import annotations

import http.client
import importlib.util
import json
import math
import secrets
import socket
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import numpy as np

from hygrokf.data.signals import SIGNALS
from hygrokf.data.structured import JsonObject
from hygrokf.data.timestamps import HOUR_S
from hygrokf.identification.verdict_terms import REJECT
from hygrokf.live.config import Config
from hygrokf.live.doctor.check import (
    LEVELS,
    Check,
    doubt,
    elapsed_from,
    fault,
    file_checks,
    machine_checks,
    of_names,
    ok,
    worst,
)
from hygrokf.live.doctor.sources import examine_sources
from hygrokf.live.doctor.store import StoreContents, store_checks
from hygrokf.live.notification.channel import Channel, ChannelFault, Message
from hygrokf.live.plan import AMBIENT_HUMIDITIES, Plan
from hygrokf.live.sources.stream import Stream, several
from hygrokf.live.tracker import Reading, Tracker, record_of
from hygrokf.live.turbines import Turbine
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
            channel.send(Message(secrets.token_hex(16)))  # without contents it is a test
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
