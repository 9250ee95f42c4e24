"""Stores of the last revision, as their own code left them, become stores of this one.

`stores/version_2_*.sql` are dumps of stores that the code of schema version 2 wrote: a batch of
`builders.store_case.everything`, and readings whose stamps are finer than a microsecond.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from builders.databases import Server
from builders.store_case import T0, a_state, everything

from hygrokf.data.timestamps import whole_microseconds
from hygrokf.live.storage.database import StoreUnready
from hygrokf.live.storage.schema import TIMESTAMPS, VERSION
from hygrokf.live.storage.store import open_store
from hygrokf.live.tracker import Reading

STORES = Path(__file__).parent / "stores"
FINE = T0 + 1200.1234567
"""Stamp of a reading [s]; another one came 0.24 µs later."""


@pytest.fixture(params=["sqlite", "postgresql"])
def old_store(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The URL of a store of version 2."""
    text = (STORES / f"version_2_{request.param}.sql").read_text(encoding="utf-8")
    if request.param == "sqlite":
        with closing(sqlite3.connect(tmp_path / "live.db")) as connection:
            connection.executescript(text)
        return f"sqlite:{tmp_path / 'live.db'}"
    server: Server = request.getfixturevalue("postgresql")
    name = server.database()
    server.execute(name, text)
    return server.url(name)


def test_a_store_of_version_2_becomes_one_of_this_version(old_store: str) -> None:
    with pytest.raises(StoreUnready, match="found version 2"):
        open_store(old_store, read_only=True)
    store = open_store(old_store)
    assert store.rows("SELECT version FROM schema_version ORDER BY version") == [
        (version + 1,) for version in range(VERSION)
    ]
    # two readings within a microsecond are one, which the filter would have merged anyway
    assert store.readings("T1", T0) == [
        Reading("cabinet_temperature", T0, 290.25),
        Reading("cabinet_temperature", T0 + 600.0, 290.5),
        Reading("cabinet_temperature", whole_microseconds(FINE), 291.0),
        Reading("rain", 5.0, pytest.approx(float("nan"), nan_ok=True)),
        Reading("rain", T0 + 0.1, 0.1 + 0.2),
    ]
    point = store.point("T1")
    assert point.time == T0
    assert point.state.mean.tobytes() == a_state().mean.tobytes()
    assert point.state.covariance.tobytes() == a_state().covariance.tobytes()
    assert store.rows("SELECT time, temperature_K, final FROM estimate ORDER BY time") == [
        (T0, 290.0, 1),
        (T0 + 600.0, 290.0, 0),
    ]
    assert store.rows("SELECT time, value FROM property") == [(T0, 0.3)]
    assert store.weather("T1", T0) == [("ambient_temperature", T0 + 3600.0, 280.0)]
    assert store.rows("SELECT id, began, cause FROM alarm") == [("a1", T0, None)]
    assert store.place("file:live.csv") == "1200"
    assert store.counters() == {("T1", "late"): 2, ("", "malformed"): 1}
    assert store.rows("SELECT turbine, heard FROM turbine_now ORDER BY turbine") == [
        ("T1", whole_microseconds(FINE)),
        ("T2", None),
    ]
    before = store.size()
    store.commit(everything())  # what is repeated is known
    assert store.size() == before
    store.close()


def test_the_large_tables_have_timestamps(postgresql: Server) -> None:
    name = postgresql.database()
    open_store(postgresql.url(name)).close()
    found = postgresql.execute(
        name,
        "SELECT table_name, column_name FROM information_schema.columns c JOIN pg_tables t "
        "ON t.tablename = c.table_name WHERE t.schemaname = 'public' AND data_type LIKE 'timestamp with%'",
    )
    assert set(found) == {(table, column) for table, columns in TIMESTAMPS.items() for column in columns}
