"""Metrics for Prometheus: the tracker's deliveries, commits and sources, and each turbine's present risk.

Each scrape reads the store and the tracker's own counts; the fleet's rows are shared with the page and
seconds old at most.
"""

from __future__ import annotations

import math
import platform
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import accumulate
from typing import TYPE_CHECKING

from hygrokf.live.alarms import CLOCKS, REACH, RULES
from hygrokf.live.batch import STATES as TURBINE_STATES
from hygrokf.live.batch import Alarm
from hygrokf.live.service import WAITS_S, Health, Service
from hygrokf.live.turbines import SOURCE
from hygrokf.live.web.page_settings import NEEDED, PageFault
from hygrokf.live.web.views import View
from hygrokf.version import __version__

if TYPE_CHECKING:
    from prometheus_client import Metric

SOURCE_STATES = ("connected", "waiting", "lost", "ended", "stopped", "idle")


def exposition(
    service: Service,
    clients: int,
    fleet: Sequence[View] | None,
    alarms: Sequence[Alarm],
    counters: Mapping[tuple[str, str], int],
    notices: Mapping[str, int],
) -> tuple[bytes, str]:
    """The metrics as text, and its media type.  Raises PageFault if prometheus_client is missing.

    clients: number of pages that are notified of changes.  fleet: rows of `fleet_view`, None if the store
    cannot be reached.  alarms: that are open.  counters: (turbine, kind) → count.  notices: channel → notices
    that are not sent yet.
    """
    try:
        from prometheus_client import CollectorRegistry, ProcessCollector
    except ImportError:
        raise PageFault(NEEDED) from None
    from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

    class Now:
        def collect(self) -> Iterator[Metric]:
            yield from _tracker(service.health, fleet is not None, clients)
            yield from _sources(service)
            yield from _set_aside(counters)
            yield from _turbines(service.now, fleet or ())
            yield _open_alarms([] if fleet is None else [SOURCE, *(row["turbine"] for row in fleet)], alarms)
            waiting = [((channel,), count) for channel, count in notices.items()]
            words = "Notices of alarms that are not sent yet"
            yield _gauge("hygrokf_notices_waiting", words, waiting, ("channel",))

    registry = CollectorRegistry()
    registry.register(Now())
    ProcessCollector(registry=registry)
    return generate_latest(registry), CONTENT_TYPE_LATEST


def _gauge(
    name: str, words: str, samples: Iterable[tuple[Sequence[str], float]], labels: Sequence[str] = ()
) -> Metric:
    """A metric with its samples: (values of the labels, number)."""
    from prometheus_client.core import GaugeMetricFamily

    made = GaugeMetricFamily(name, words, labels=labels)
    for values, number in samples:
        made.add_metric(values, number)
    return made


def _tracker(health: Health, store_reached: bool, clients: int) -> Iterator[Metric]:
    from prometheus_client.core import CounterMetricFamily, HistogramMetricFamily

    build = [((__version__, platform.python_version()), 1)]
    words = "1, with the version of the tracker and of Python"
    yield _gauge("hygrokf_build_info", words, build, ("version", "python"))
    yield CounterMetricFamily("hygrokf_deliveries", "Deliveries that were committed", health.deliveries)
    yield CounterMetricFamily("hygrokf_store_failures", "Commits that the store refused", health.failures)
    classes = [*(f"{bound:g}" for bound in WAITS_S), "+Inf"]
    yield HistogramMetricFamily(
        "hygrokf_commit_wait_seconds",
        "Time from delivery to commit",
        buckets=list(zip(classes, accumulate(health.wait_counts), strict=True)),
        sum_value=health.wait_sum_s,
    )
    age = [((), time.time() - health.committed_s)] if health.committed_s else []
    yield _gauge("hygrokf_last_commit_age_seconds", "Time since the last commit", age)
    reached = int(store_reached and not health.store)
    yield _gauge("hygrokf_store_reached", "1 if tracker and page reach the store", [((), reached)])
    yield _gauge("hygrokf_page_clients", "Pages that are notified of changes", [((), clients)])


def _sources(service: Service) -> Iterator[Metric]:
    yield _gauge(
        "hygrokf_source_state",
        "1 for the state that a source is in",
        (
            ((url, one), int(one == word))
            for url, stream in service.streams.items()
            for word in (stream.state.word,)
            for one in dict.fromkeys((*SOURCE_STATES, word))
        ),
        ("source", "state"),
    )
    times = [(url, one) for url, one in service.health.sources.items() if url in service.streams]
    yield _gauge(
        "hygrokf_source_last_message_timestamp_seconds",
        "When a source last delivered something, since 1970",
        (((url,), one.committed) for url, one in times),
        ("source",),
    )
    yield _gauge(
        "hygrokf_source_lag_seconds",
        "Time from a source's newest reading to its arrival, of the last delivery with readings",
        (((url,), one.lag_s) for url, one in times if one.lag_s is not None),
        ("source",),
    )
    yield _gauge(
        "hygrokf_source_not_reached_ratio",
        "Time that a source has not been reached, as a multiple of its limit",
        (((url,), reach.share(service.now)) for url, reach in service.reaches().items()),
        ("source",),
    )


def _set_aside(counters: Mapping[tuple[str, str], int]) -> Iterator[Metric]:
    from prometheus_client.core import CounterMetricFamily

    refused = CounterMetricFamily(
        "hygrokf_refused", "Deliveries of no known turbine or form", labels=["kind"]
    )
    aside = CounterMetricFamily(
        "hygrokf_set_aside", "Readings of a turbine that were not used", labels=["turbine", "kind"]
    )
    for (turbine, kind), count in sorted(counters.items()):
        (aside if turbine else refused).add_metric([turbine, kind] if turbine else [kind], count)
    yield from (refused, aside)


def _turbines(now: float, fleet: Sequence[View]) -> Iterator[Metric]:
    heard = [((row["turbine"],), now - row["heard"]) for row in fleet if row["heard"] is not None]
    yield _gauge("hygrokf_heard_age_seconds", "Time since a turbine was last heard", heard, ("turbine",))
    for key, name, words in (
        ("condensation", "condensation_probability", "Probability of condensation at the coldest surface"),
        ("margin", "dew_point_margin_kelvin", "Coldest surface above the dew point"),
    ):
        known = [((row["turbine"],), row[key]) for row in fleet if row[key] is not None]
        yield _gauge(f"hygrokf_{name}", words, known, ("turbine",))
    yield _gauge(
        "hygrokf_turbine_state",
        "1 for the state that a turbine is in",
        (((row["turbine"], one), int(one == row["state"])) for row in fleet for one in TURBINE_STATES),
        ("turbine", "state"),
    )


def _open_alarms(names: Sequence[str], alarms: Sequence[Alarm]) -> Metric:
    """Open alarms of every turbine and kind, zeros included, so that a rule sees an alarm begin and end.

    Alarms that belong to no turbine have an empty label `turbine`.
    """
    counts: Counter[tuple[str, str, str]] = Counter()
    for name in names:
        for rule in RULES.values():
            if rule.follows in (REACH, CLOCKS) if name == SOURCE else rule.follows != REACH:
                counts[name, rule.kind, rule.severity] = 0
                if math.isfinite(rule.severe):
                    counts[name, rule.kind, "alarm"] = 0
    counts.update((one.turbine, one.kind, one.severity) for one in alarms if one.turbine in names)
    labels = ("turbine", "kind", "severity")
    return _gauge("hygrokf_open_alarms", "Open alarms", sorted(counts.items()), labels)
