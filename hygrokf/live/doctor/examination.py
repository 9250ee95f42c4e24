"""The doctor: looks at all that a tracker needs, changes nothing, and says what is wrong and what to do."""

from __future__ import annotations

import http.client
import importlib.util
import json
import math
import ssl
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from hygrokf.live.config import Config
from hygrokf.live.doctor.check import LEVELS, Check, doubt, fault, ok, worst
from hygrokf.live.doctor.clock import Watch, machine_checks
from hygrokf.live.doctor.files import file_checks
from hygrokf.live.doctor.models import model_checks
from hygrokf.live.doctor.sources import examined
from hygrokf.live.doctor.store import Kept, store_checks
from hygrokf.live.sources.streams import Playback
from hygrokf.live.web.page_settings import PageFault, PageSettings
from hygrokf.live.web.server import bound

ANSWER_S = 5.0
"""[s] within which a page answers."""


def examine(
    config: Config, file: Path | None = None, wait_s: float = 10.0, with_page: bool = True
) -> list[Check]:
    """Look at the clock, the files that the tracker's `file` names, its sources, store, models and page.

    Sources that speak by themselves are listened to for `wait_s` [s], all at the same time.
    """
    watch, kept = Watch(), Kept()
    # what is late for one turbine is late
    lateness_s = min((one.plan.lateness_s for one in config.turbines.values()), default=math.inf)
    sources = examined(config.streams, wait_s, lateness_s)
    played_back = all(isinstance(one, Playback) for one in config.streams if not one.mapping.weather)
    of_store = list(store_checks(config.store, config.turbines, config.retention_s, played_back, kept))
    came = {name: set(signals) for name, signals in kept.signals.items()}
    for one in sources:
        for turbine, signal in one.tally.newest:
            came.setdefault(turbine, set()).add(signal)
    return [
        *machine_checks(watch, kept.received_s),
        *(file_checks(file) if file is not None else ()),
        *(check for one in sources for check in one.checks),
        *of_store,
        *model_checks(config.turbines, config.streams, came),
        *(page_checks(config.page) if with_page else ()),
    ]


def page_checks(settings: PageSettings) -> Iterator[Check]:
    """Whether the page can be served, or is served by a tracker that runs."""
    about = f"page {settings.host}:{settings.port}"
    if None in map(importlib.util.find_spec, ("starlette", "uvicorn", "prometheus_client")):
        yield fault(about, "its packages are missing", "pip install 'hygrokf[live]', or start with --no-page")
        return
    try:
        bound(settings).close()
        yield ok(about, "the address is free")
    except PageFault as error:
        said = _page_says(settings)
        if said is None:
            words, _, remedy = str(error).partition("; ")
            yield fault(about, words, remedy or "give another address")
        elif said:
            yield doubt(about, f"a tracker's page is there, and says: {said}", "look at that tracker's log")
        else:
            yield ok(about, "a tracker's page is there, and all is well with it")


def _page_says(settings: PageSettings) -> str | None:
    """What a tracker's page at the address has to complain of, empty for nothing; None where there is no such page."""
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(settings.host, settings.host)
    try:
        if settings.certificate:
            # it is asked how it is, and told nothing: whose certificate it shows does not matter
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
            context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
            connection: http.client.HTTPConnection = http.client.HTTPSConnection(
                host, settings.port, timeout=ANSWER_S, context=context
            )
        else:
            connection = http.client.HTTPConnection(host, settings.port, timeout=ANSWER_S)
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


def as_text(checks: list[Check]) -> str:
    """One line a check, and how many there are of each level."""
    return "\n".join([*map(str, checks), summary(checks)])


def as_data(checks: list[Check]) -> dict:
    """The same as plain data."""
    return {"level": worst(checks), "checks": [asdict(one) for one in checks]}


def summary(checks: list[Check]) -> str:
    """How many checks there are of each level."""
    counts = [f"{sum(one.level == level for one in checks)} {level}" for level in LEVELS]
    return f"{', '.join(counts)}: " + (
        "nothing stands in the way" if worst(checks) != "fault" else "mend the faults first"
    )
