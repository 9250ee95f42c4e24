"""Old rows go in small bites; what a restart needs stays, so that a tracker of a pruned store ends in the
same state."""

from __future__ import annotations

import numpy as np
import pytest
from builders.live_case import live_record, live_turbine
from builders.service_case import Acknowledging
from builders.store_case import T0, a_condition, observed, queried

from hygrokf.live import service
from hygrokf.live.batch import Alarm, Batch, Estimates
from hygrokf.live.plan import BEFORE
from hygrokf.live.properties import Property
from hygrokf.live.service import Retention, Service
from hygrokf.live.storage.store import Store, open_store, prune
from hygrokf.live.tracker import offline_course
from hygrokf.live.turbines import Fleet


@pytest.fixture
def store(store_url: str) -> Store:
    made = open_store(store_url)
    times = [T0 + 60.0 * i for i in range(100)]
    made.commit(
        Batch(
            observations=[
                *(observed("cabinet_temperature", at, 290.0) for at in times),
                *(observed("rain", at, 1.0) for at in times[:20]),
                *(observed("snow", at, 1.0, late=True) for at in times[:10]),
            ],
            estimates={"T1": Estimates(a_condition(times), 100, T0)},
            properties=[("T1", at,
                [Property(n, "h", 0.3, 0.2, 0.4, 0.3, True) for n in "ab"]) for at in times[::10]],
            alarms=[
                Alarm("open", "T1", "condensation", "alarm", T0, "wet", "dry"),
                Alarm("old", "T1", "condensation", "alarm", T0, "wet", "dry", ended=T0 + 1.0),
                Alarm("new", "T1", "condensation", "alarm", T0, "wet", "dry", ended=times[-1]),
            ],
        )
    )  # fmt: skip
    other = observed("rain", T0, 1.0)
    made.commit(Batch(observations=[type(other)("T2", other.reading, T0)]))
    yield made
    made.close()


def left(store: Store) -> tuple[int, ...]:
    """Numbers of readings of the cabinet temperature and of rain, of estimates, properties and alarms."""
    of_signal = "SELECT COUNT(*) FROM observation WHERE turbine = 'T1' AND signal = ?"
    counts = [queried(store, of_signal, (name,)) for name in ("cabinet_temperature", "rain")]
    counts += [queried(store, f"SELECT COUNT(*) FROM {name}") for name in ("estimate", "property", "alarm")]
    return tuple(rows[0][0] for rows in counts)


def test_what_is_old_goes_and_what_a_restart_needs_stays(store: Store) -> None:
    needed = T0 + 60.0 * 50 + 1.0
    before = store.readings("T1", needed)
    # the retention is longer ago than what is needed: it alone counts
    assert prune(store, "T1", T0 + 60.0 * 20, needed) == 20 + 8 + 10 + 20 + 4 + 1
    # the last readings of a signal before what is needed stay, however old; those that came too late serve
    # nobody
    assert left(store) == (80, BEFORE, 80, 16, 2)
    # a retention that asks for more than may go
    assert prune(store, "T1", T0 + 1e6, needed) == 19 + 31 + 8
    assert left(store) == (49 + BEFORE, BEFORE, 49, 8, 2)
    assert store.readings("T1", needed) == before
    assert prune(store, "T1", T0 + 1e6, needed) == 0
    assert store.readings("T2", 0.0) != [] and [
        r for (r,) in queried(store, "SELECT id FROM alarm ORDER BY id")
    ] == ["new", "open"]


def test_bites_are_small_and_come_to_an_end(store: Store) -> None:
    needed = T0 + 60.0 * 50 + 1.0
    counts = [prune(store, "T1", T0 + 1e6, needed, most=20)]
    while counts[-1]:
        counts.append(prune(store, "T1", T0 + 1e6, needed, most=20))
    assert max(counts) <= 20 and len(counts) >= 6
    assert left(store) == (49 + BEFORE, BEFORE, 49, 8, 2)


def test_a_turbine_without_a_point_and_an_endless_retention_keep_all(store: Store, tmp_path) -> None:
    turbine = live_turbine(live_record(tmp_path, seed=8, days=3.0))
    fleet = Fleet({"T1": turbine})
    assert (
        Retention(0.0).delete_portion(store, fleet) == 0
        and Retention(np.inf).delete_portion(store, fleet) == 0
    )
    assert left(store)[0] == 100


def test_a_pruned_store_ends_in_the_offline_filter(
    store_url: str, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A retention of no time at all, pruned after every round, and six restarts on the way."""
    record = live_record(tmp_path, seed=9, days=5.0)
    turbine = live_turbine(record)
    monkeypatch.setattr(service, "PRUNED_S", 0.0)
    monkeypatch.setattr(service, "MOST_PER_ROUND", 60)
    total = len(Acknowledging(record).messages)
    for end in range(0, total + total // 6, total // 6):
        stream = Acknowledging(record)
        stream.messages = stream.messages[:end]
        Service({"T1": turbine}, [stream], store_url, retention_s=0.0).run(until_ended=True)
    assert stream.acknowledged[-1] == str(total)
    store = open_store(store_url)
    point = store.point("T1")
    offline = offline_course(turbine.plan, record)
    row = int(np.searchsorted(offline.seconds, point.time + 1e-3, side="right")) - 1
    assert np.array_equal(point.state.mean, offline.trace.mean[row])
    assert np.array_equal(point.state.covariance, offline.trace.covariance[row])
    needed = point.time - turbine.plan.context_s
    ((count, oldest),) = queried(store, "SELECT COUNT(*), MIN(time) FROM observation")
    assert count < 0.4 * total and needed - 4.0 * 3600.0 < oldest < needed
    store.close()
