"""Times as timestamps: what the tracker filters is what the store gives back, and the large tables can be
partitioned by time.

TimescaleDB's hypertables ask of a table what PostgreSQL's own partitions ask: the time in every unique index.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders.databases import Server
from builders.live_case import expect_offline
from builders.service_case import Acknowledging
from builders.store_case import T0, queried

from hygrokf.data.record import Record
from hygrokf.data.timestamps import whole_microseconds
from hygrokf.live.batch import Batch, Observation
from hygrokf.live.service import Service
from hygrokf.live.storage.schema import POSTGRESQL, VIEWS, view_creation
from hygrokf.live.storage.store import open_store, prune
from hygrokf.live.tracker import Reading
from hygrokf.live.turbine import Turbine

LARGE = ("observation", "estimate", "property", "forecast", "weather")


def test_a_whole_microsecond_comes_back_bit_for_bit(store_url: str) -> None:
    random = np.random.default_rng(3)
    fine = np.sort(random.uniform(7e8, 2.5e9, 3000)).tolist()
    readings = [Reading("rain", t, 1.0).as_stored() for t in fine]
    assert all(abs(one.time - t) < 1e-6 for one, t in zip(readings, fine, strict=True))
    assert all(one.as_stored() is one for one in readings)
    store = open_store(store_url)
    store.commit(Batch(observations=[Observation("T1", one, one.time) for one in readings]))
    assert [one.time for one in store.readings("T1", -np.inf)] == [one.time for one in readings]
    store.close()


def test_stamps_finer_than_a_microsecond_end_in_the_offline_filter(
    store_url: str, record: Record, turbine: Turbine
) -> None:
    """The offline filter on the rounded stamps: the tracker rounds them before it filters, in every store."""
    shifted = [s.time + 0.123456789 for s in record.series]
    fine = replace(
        record, series=tuple(replace(s, time=t) for s, t in zip(record.series, shifted, strict=True))
    )
    rounded = [np.array([whole_microseconds(t) for t in times.tolist()]) for times in shifted]
    kept = replace(
        record, series=tuple(replace(s, time=t) for s, t in zip(record.series, rounded, strict=True))
    )
    assert not all(np.array_equal(a, b) for a, b in zip(shifted, rounded, strict=True))
    Service({"T1": turbine}, [Acknowledging(fine)], store_url).run(until_ended=True)
    expect_offline(store_url, kept, turbine)


@pytest.fixture
def partitioned(postgresql: Server) -> str:
    """A store whose large tables are partitioned by time."""
    name = postgresql.database()
    url = postgresql.url(name)
    open_store(url).close()
    statements = [f"DROP VIEW {name}" for name in reversed(VIEWS)]
    for table in LARGE:
        statements += [
            f"ALTER TABLE {table} RENAME TO {table}_before",
            f"CREATE TABLE {table} (LIKE {table}_before INCLUDING ALL) PARTITION BY RANGE (time)",
            f"CREATE TABLE {table}_other PARTITION OF {table} DEFAULT",
            f"DROP TABLE {table}_before",
        ]
    postgresql.execute(name, *statements, *view_creation(POSTGRESQL))
    return url


def test_the_large_tables_can_be_partitioned_by_time(
    postgresql: Server, partitioned: str, record: Record, turbine: Turbine
) -> None:
    first = min(float(s.time[0]) for s in record.series)
    name = partitioned.partition("@/")[2].partition("?")[0]
    for table in LARGE:
        for day in range(5):
            begin = f"to_timestamp({first + 86400.0 * (day - 1)})"
            end = f"to_timestamp({first + 86400.0 * day})"
            postgresql.execute(
                name, f"CREATE TABLE {table}_{day} PARTITION OF {table} FOR VALUES FROM ({begin}) TO ({end})"
            )
    Service({"T1": turbine}, [Acknowledging(record)], partitioned).run(until_ended=True)
    expect_offline(partitioned, record, turbine)
    store = open_store(partitioned)
    counts = [queried(store, f"SELECT COUNT(*) FROM observation_{day}")[0][0] for day in range(1, 4)]
    assert min(counts) > 0 and sum(counts) > 0.9 * store.size()["observation"]
    # a span of time is looked for in its own partitions
    plan = queried(
        store,
        "EXPLAIN SELECT value FROM observation WHERE turbine = ? AND time >= to_timestamp(?) "
        "AND time < to_timestamp(?)",
        ("T1", first + 86400.0, first + 2 * 86400.0),
    )
    said = "\n".join(line for (line,) in plan)
    assert "observation_2" in said and "observation_3" not in said and "observation_other" not in said, said
    before = store.size()
    while prune(store, "T1", first + 86400.0, T0 + 1e9) > 0:
        pass
    assert 0 < store.size()["observation"] < before["observation"]
    assert store.size()["estimate"] < before["estimate"]
    store.close()
