"""Metrics for Prometheus: the tracker's deliveries, commits and sources, and each turbine's present risk.

Each scrape reads the store and the tracker's counts; the fleet's rows are shared with the page and at most a
few seconds old.
"""

from __future__ import annotations

import math
import platform
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import accumulate
from typing import TYPE_CHECKING

from hygrokf.live.alarms import ALARM_RULES, CLOCKS, REACH_KIND
from hygrokf.live.batch import TURBINE_STATES, Alarm
from hygrokf.live.service import WAIT_CLASSES_S, Health, Service
from hygrokf.live.turbines import SOURCE
from hygrokf.live.web.page_settings import MISSING_PACKAGES, PageFault
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
    cannot be reached.  alarms: the open alarms.  counters: (turbine, kind) → count.  notices: channel →
    number of notices that are not sent yet.
    """
    try:
        from prometheus_client import CollectorRegistry, ProcessCollector
    except ImportError:
        raise PageFault(MISSING_PACKAGES) from None
    from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

    class Collector:
        def collect(self) -> Iterator[Metric]:
            yield from _tracker(service.health, fleet is not None, clients)
            yield from _sources(service)
            yield from _unused(counters)
            yield from _turbines(service.now, fleet or ())
            yield _open_alarms([] if fleet is None else [SOURCE, *(row["turbine"] for row in fleet)], alarms)
            waiting = [((channel,), count) for channel, count in notices.items()]
            text = "Notices of alarms that are not sent yet"
            yield _gauge("hygrokf_notices_waiting", text, waiting, ("channel",))

    registry = CollectorRegistry()
    registry.register(Collector())
    ProcessCollector(registry=registry)
    return generate_latest(registry), CONTENT_TYPE_LATEST


def _gauge(
    name: str, text: str, samples: Iterable[tuple[Sequence[str], float]], labels: Sequence[str] = ()
) -> Metric:
    """A metric with its samples: (values of the labels, number)."""
    from prometheus_client.core import GaugeMetricFamily

    metric = GaugeMetricFamily(name, text, labels=labels)
    for values, number in samples:
        metric.add_metric(values, number)
    return metric


def _tracker(health: Health, store_reached: bool, clients: int) -> Iterator[Metric]:
    from prometheus_client.core import CounterMetricFamily, HistogramMetricFamily

    build = [((__version__, platform.python_version()), 1)]
    text = "1, with the version of the tracker and of Python"
    yield _gauge("hygrokf_build_info", text, build, ("version", "python"))
    yield CounterMetricFamily("hygrokf_deliveries", "Deliveries that were committed", health.deliveries)
    yield CounterMetricFamily("hygrokf_store_failures", "Commits that the store refused", health.failures)
    classes = [*(f"{bound:g}" for bound in WAIT_CLASSES_S), "+Inf"]
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
            ((url, state), int(state == stream.state.word))
            for url, stream in service.streams.items()
            for state in dict.fromkeys((*SOURCE_STATES, stream.state.word))
        ),
        ("source", "state"),
    )
    sources = [(url, source) for url, source in service.health.sources.items() if url in service.streams]
    yield _gauge(
        "hygrokf_source_last_message_timestamp_seconds",
        "When a source last delivered something, since 1970",
        (((url,), source.committed) for url, source in sources),
        ("source",),
    )
    yield _gauge(
        "hygrokf_source_lag_seconds",
        "Time from a source's newest reading to its arrival, of the last delivery with readings",
        (((url,), source.lag_s) for url, source in sources if source.lag_s is not None),
        ("source",),
    )
    yield _gauge(
        "hygrokf_source_not_reached_ratio",
        "Time that a source has not been reached, as a multiple of its limit",
        (((url,), reach.share(service.now)) for url, reach in service.reaches().items()),
        ("source",),
    )


def _unused(counters: Mapping[tuple[str, str], int]) -> Iterator[Metric]:
    from prometheus_client.core import CounterMetricFamily

    refused = CounterMetricFamily(
        "hygrokf_refused", "Deliveries of no known turbine or form", labels=["kind"]
    )
    unused = CounterMetricFamily(
        "hygrokf_set_aside", "Readings of a turbine that were not used", labels=["turbine", "kind"]
    )
    for (turbine, kind), count in sorted(counters.items()):
        if turbine:
            unused.add_metric([turbine, kind], count)
        else:
            refused.add_metric([kind], count)
    yield from (refused, unused)


def _turbines(now: float, fleet: Sequence[View]) -> Iterator[Metric]:
    heard = [((row["turbine"],), now - row["heard"]) for row in fleet if row["heard"] is not None]
    yield _gauge("hygrokf_heard_age_seconds", "Time since a turbine was last heard", heard, ("turbine",))
    for key, name, text in (
        ("condensation", "condensation_probability", "Probability of condensation at the coldest surface"),
        ("margin", "dew_point_margin_kelvin", "Coldest surface above the dew point"),
    ):
        samples = [((row["turbine"],), row[key]) for row in fleet if row[key] is not None]
        yield _gauge(f"hygrokf_{name}", text, samples, ("turbine",))
    yield _gauge(
        "hygrokf_turbine_state",
        "1 for the state that a turbine is in",
        (((row["turbine"], state), int(state == row["state"])) for row in fleet for state in TURBINE_STATES),
        ("turbine", "state"),
    )


def _open_alarms(names: Sequence[str], alarms: Sequence[Alarm]) -> Metric:
    """Number of open alarms of every turbine and kind, zeros included, so that a rule sees an alarm begin and
    end.

    Alarms that belong to no turbine have an empty label `turbine`.
    """
    counts: Counter[tuple[str, str, str]] = Counter()
    for name in names:
        for rule in ALARM_RULES.values():
            if rule.follows in (REACH_KIND, CLOCKS) if name == SOURCE else rule.follows != REACH_KIND:
                counts[name, rule.kind, rule.severity] = 0
                if math.isfinite(rule.severe):
                    counts[name, rule.kind, "alarm"] = 0
    counts.update((alarm.turbine, alarm.kind, alarm.severity) for alarm in alarms if alarm.turbine in names)
    labels = ("turbine", "kind", "severity")
    return _gauge("hygrokf_open_alarms", "Open alarms", sorted(counts.items()), labels)
