"""Metrics for Prometheus: the tracker's deliveries, commits and sources, and each turbine's present risk.

Each scrape reads the store and the tracker's own counts; the fleet's rows are shared with the page and
seconds old at most.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from hygrokf.live.batch import STATES as TURBINE_STATES
from hygrokf.live.service import Health
from hygrokf.live.sources.stream import SourceState
from hygrokf.live.web.page_settings import NEEDED, PageFault
from hygrokf.live.web.views import FleetRow

if TYPE_CHECKING:
    from prometheus_client import Metric

QUANTILES = (0.5, 0.9, 0.99)
STATES = ("connected", "waiting", "lost", "ended", "stopped", "idle")


def exposition(
    now: float,
    health: Health,
    sources: Mapping[str, SourceState],
    clients: int,
    fleet: Sequence[FleetRow] | None,
    counters: Mapping[tuple[str, str], int],
) -> tuple[bytes, str]:
    """The metrics as text, and its media type.

    `now` [s]; `fleet`: rows of `fleet_view`, None if the store cannot be reached; `counters`: (turbine, kind)
    → count. Raises PageFault if prometheus_client is missing.
    """
    try:
        from prometheus_client import CollectorRegistry
    except ImportError:
        raise PageFault(NEEDED) from None
    from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

    class Now:
        def collect(self) -> Iterator[Metric]:
            yield from _tracker(now, health, sources, clients, fleet is not None)
            yield from _set_aside(counters)
            yield from _turbines(now, fleet or ())

    registry = CollectorRegistry()
    registry.register(Now())
    return generate_latest(registry), CONTENT_TYPE_LATEST


def _tracker(
    now: float, health: Health, sources: Mapping[str, SourceState], clients: int, reached: bool
) -> Iterator[Metric]:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    yield CounterMetricFamily("hygrokf_deliveries", "Deliveries that were committed", health.deliveries)
    yield CounterMetricFamily("hygrokf_store_failures", "Commits that the store refused", health.failures)
    wait = GaugeMetricFamily(
        "hygrokf_commit_wait_seconds", "Time from delivery to commit, of the last 10,000", labels=["quantile"]
    )
    for share in QUANTILES:
        if (seconds := health.wait_s(share)) is not None:
            wait.add_metric([f"{share:g}"], seconds)
    yield wait
    age = GaugeMetricFamily("hygrokf_last_commit_age_seconds", "Time since the last commit")
    if health.committed_s:
        age.add_metric([], time.time() - health.committed_s)
    yield age
    yield GaugeMetricFamily(
        "hygrokf_store_reached", "1 if tracker and page reach the store", int(reached and not health.store)
    )
    state = GaugeMetricFamily(
        "hygrokf_source_state", "1 for the state that a source is in", labels=["source", "state"]
    )
    for url, (word, _) in sources.items():
        for one in dict.fromkeys((*STATES, word)):
            state.add_metric([url, one], int(one == word))
    yield state
    yield GaugeMetricFamily("hygrokf_page_clients", "Pages that are notified of changes", clients)


def _set_aside(counters: Mapping[tuple[str, str], int]) -> Iterator[Metric]:
    from prometheus_client.core import CounterMetricFamily

    refused = CounterMetricFamily(
        "hygrokf_refused", "Deliveries of no known turbine or form", labels=["kind"]
    )
    aside = CounterMetricFamily(
        "hygrokf_set_aside", "Readings of a turbine that were not used", labels=["turbine", "kind"]
    )
    for (turbine, kind), count in sorted(counters.items()):
        if turbine:
            aside.add_metric([turbine, kind], count)
        else:
            refused.add_metric([kind], count)
    yield from (refused, aside)


def _turbines(now: float, fleet: Sequence[FleetRow]) -> Iterator[Metric]:
    from prometheus_client.core import GaugeMetricFamily

    heard = GaugeMetricFamily(
        "hygrokf_heard_age_seconds", "Time since a turbine was last heard", labels=["turbine"]
    )
    chance = GaugeMetricFamily(
        "hygrokf_condensation_probability",
        "Probability of condensation at the coldest surface",
        labels=["turbine"],
    )
    margin = GaugeMetricFamily(
        "hygrokf_dew_point_margin_kelvin", "Coldest surface above the dew point", labels=["turbine"]
    )
    for row in fleet:
        for family, value in (
            (heard, None if row["heard"] is None else now - row["heard"]),
            (chance, row["condensation"]),
            (margin, row["margin"]),
        ):
            if value is not None:
                family.add_metric([row["turbine"]], value)
    yield from (heard, chance, margin)
    state = GaugeMetricFamily(
        "hygrokf_turbine_state", "1 for the state that a turbine is in", labels=["turbine", "state"]
    )
    for row in fleet:
        for one in TURBINE_STATES:
            state.add_metric([row["turbine"], one], int(one == row["state"]))
    yield state
    alarms = GaugeMetricFamily("hygrokf_open_alarms", "Open alarms", labels=["kind", "severity"])
    for (kind, severity), count in sorted(
        Counter((a.kind, a.severity) for row in fleet for a in row["alarms"]).items()
    ):
        alarms.add_metric([kind, severity], count)
    yield alarms
