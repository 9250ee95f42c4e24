"""Tables and views: the same in both databases, as the docs say."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import psycopg
import pytest
from builders.databases import Server
from builders.documents import document
from builders.store_case import T0, a_condition, everything, observed, queried

from hygrokf.live.batch import Alarm, Batch, Estimates, Observation
from hygrokf.live.storage.schema import SQLITE, TABLES, VIEWS, Instant, creation
from hygrokf.live.storage.store import Store, StoreFault, open_store
from hygrokf.live.tracker import NEITHER, Reading

PAGE = document("live_store.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```sql\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
ISO = "2023-11-14T22:13:20"
"""T0."""


@pytest.fixture
def store(store_url: str) -> Iterator[Store]:
    made = open_store(store_url)
    made.add_turbines({"T1": "a", "T2": "b"})
    made.commit(everything())
    made.commit(
        Batch(
            observations=[
                observed("rain", 3600.0 * (T0 // 3600.0), 1.0),
                observed("rain", 3600.0 * (T0 // 3600.0) + 3599.5, 4.0),
                observed("rain", 3600.0 * (T0 // 3600.0) + 3600.0, 7.0), observed("rain", 5.0, 1.0),
                Observation("T1", Reading("rain", 5.0, 2.0, NEITHER), 8.0, revision=True),
            ],
            alarms=[
                Alarm("a2", "T1", "data stale", "notice", T0 + 1.0, "x", "y"),
                Alarm("a3", "T1", "data stale", "alarm", T0 + 1.0, "x", "y", ended=T0 + 2.0),
            ],
        )
    )  # fmt: skip
    yield made
    made.close()


def said(value: object) -> object:
    """A time as text without its zone, in whatever form a database gives it."""
    if isinstance(value, datetime):
        assert value.utcoffset() is not None
        return value.astimezone(UTC).replace(tzinfo=None).isoformat()
    return value.removesuffix("Z").removesuffix(".000") if isinstance(value, str) else value


def shown(store: Store, query: str) -> list[list]:
    """Rows as anybody else's connection shows them."""
    place = store.url.removeprefix("sqlite:")
    if place == store.url:
        connection = psycopg.connect(store.url)
    else:
        connection = sqlite3.connect(place)
    with closing(connection):
        return [[said(v) for v in row] for row in connection.execute(query).fetchall()]


def one(store: Store, query: str) -> list:
    (row,) = shown(store, query)
    return row


def at(store: Store, seconds: float) -> object:
    """A time as the columns `time` show it: a timestamp where the database has such a type."""
    if store.url.startswith("sqlite:"):
        return seconds
    return said(datetime.fromtimestamp(seconds, UTC))


def now_at(store: Store, seconds: float) -> str:
    """The condition that the column `time` is a time."""
    return f"time = {seconds}" if store.url.startswith("sqlite:") else f"time = to_timestamp({seconds})"


def test_estimates_in_units_for_people(store: Store) -> None:
    found = one(
        store,
        "SELECT turbine, time, time_utc, final, temperature_celsius, temperature_lower_celsius, "
        "temperature_upper_celsius, frost_point_celsius, condensation_percent FROM estimate_readable WHERE "
        f"{now_at(store, T0)}",
    )
    assert found[:4] == ["T1", at(store, T0), ISO, 1] and found[7:] == [None, 25.0]
    assert found[4:7] == pytest.approx([16.85, 16.85 - 0.5 * 1.959964, 16.85 + 0.5 * 1.959964], abs=1e-9)
    damp = a_condition([T0 + 1200.0], 0.5)
    store.commit(Batch(estimates={"T1": Estimates(damp, 1, T0 + 1200.0)}))
    found = one(
        store,
        "SELECT relative_humidity_percent, relative_humidity_upper_percent, margin_kelvin, "
        "margin_lower_kelvin, absolute_humidity_g_m3, absolute_humidity_upper_g_m3 FROM estimate_readable "
        f"WHERE {now_at(store, T0 + 1200.0)}",
    )
    assert found == pytest.approx([50.0, 147.9982, 0.5, -0.479982, 0.5, 1.479982])


def test_turbines_alarms_and_properties_now(store: Store) -> None:
    query = (
        "SELECT turbine, heard, heard_utc, time_utc, condensation_percent, open_alarms, severity_rank "
        "FROM turbine_now "
    )
    hour = 3600.0 * (T0 // 3600.0) + 3600.0
    assert one(store, query + "WHERE turbine = 'T1'") == [
        "T1", at(store, hour), said(datetime.fromtimestamp(hour, UTC)), "2023-11-14T22:23:20", 25.0, 2, 2
    ]  # fmt: skip
    assert one(store, query + "WHERE turbine = 'T2'") == ["T2", None, None, None, None, 0, 0]
    found = shown(store, "SELECT id, severity_rank, began_utc, acknowledged_utc FROM alarm_open ORDER BY id")
    assert found == [
        ["a1", 2, ISO, None],
        ["a2", 1, "2023-11-14T22:13:21", None],
    ]
    assert one(store, "SELECT * FROM property_now") == [
        "T1", "hygric_k", "h", at(store, T0), ISO, 0.3, 0.28, 0.33, 0.31, 1
    ]  # fmt: skip
    assert queried(store, "SELECT COUNT(*) FROM forecast_readable") == [(0,)]


def test_hours_begin_at_the_hour_and_leave_contradictions_out(store: Store) -> None:
    found = shown(
        store,
        "SELECT time, time_utc, mean, lowest, highest, readings FROM observation_hourly WHERE signal = "
        "'rain' ORDER BY time",
    )
    assert found == [
        [at(store, 1699999200.0), "2023-11-14T22:00:00", 2.5, 1.0, 4.0, 2],
        [at(store, 1700002800.0), "2023-11-14T23:00:00", 7.0, 7.0, 7.0, 1],
    ]


@pytest.fixture(scope="module")
def plain() -> Iterator[sqlite3.Connection]:
    """The tables and views in memory."""
    with closing(sqlite3.connect(":memory:")) as connection:
        for statement in creation(SQLITE):
            connection.execute(statement)
        yield connection


def test_both_databases_have_the_same_columns(postgresql: Server, plain: sqlite3.Connection) -> None:
    there = open_store(postgresql.url(postgresql.database()))
    for name in (*TABLES, *VIEWS):
        columns = []
        for connection in (there.database.connection, plain):
            with closing(connection.cursor()) as cursor:
                cursor.execute(f"SELECT * FROM {name}")
                columns.append([column[0].lower() for column in cursor.description])
        assert columns[0] == columns[1]
    there.close()


def test_the_large_tables_have_timestamps(postgresql: Server) -> None:
    name = postgresql.database()
    open_store(postgresql.url(name)).close()
    found = postgresql.execute(
        name,
        "SELECT table_name, column_name FROM information_schema.columns c JOIN pg_tables t "
        "ON t.tablename = c.table_name WHERE t.schemaname = 'public' AND data_type LIKE 'timestamp with%'",
    )
    assert set(found) == {
        (name, column.name)
        for name, table in TABLES.items()
        for column in table.c
        if isinstance(column.type, Instant)
    }


# -- the page ------------------------------------------------------------------------------------------------
def test_the_page_names_every_table_view_and_their_columns(plain: sqlite3.Connection) -> None:
    for name in (*TABLES, *VIEWS, "schema_version"):
        assert f"`{name}`" in PAGE, name
    stated = set(re.findall(r"`(\w+)`", PAGE))
    own = {"point", "memory", "source", "claim"}  # the tracker's own, which nobody else need understand
    shared = {"turbine", "time", "schema_version"}
    for table in set(TABLES) - own:
        for column in (c[1] for c in plain.execute(f"PRAGMA table_info({table})")):
            assert column in stated | shared or column.endswith("_sd"), f"{table}.{column}"


def test_the_page_s_roles_and_queries_work(postgresql: Server, tmp_path: Path) -> None:
    """The page's own SQL: as a superuser, as the tracker, as a reader; in SQLite, too."""
    roles, rights, course, plain_course, fleet = BLOCKS
    postgresql.execute("postgres", *filter(None, map(str.strip, roles.split(";"))))
    url = postgresql.url("hygrokf", user="hygrokf")
    owner = open_store(url)
    for statement in filter(None, map(str.strip, rights.split(";"))):
        owner.database.connection.execute(statement)
    with owner.transaction():  # a later version's table
        queried(owner, "CREATE TABLE later (x INTEGER)")
    owner.close()
    file = f"sqlite:{tmp_path / 'live.db'}"
    for place in (url, file):
        made = open_store(place)
        made.add_turbines({"T07": "a"})
        made.commit(Batch(estimates={"T07": Estimates(a_condition([T0, T0 + 600.0, T0 + 1200.0]), 3, T0)}))
        made.close()
    reader = open_store(postgresql.url("hygrokf", user="hygrokf_reader"), read_only=True)
    # as Grafana replaces it
    course = re.sub(r"\$__timeFilter\((\w+)\)", rf"\1 BETWEEN '{ISO}Z' AND '2023-11-14T22:23:20Z'", course)
    assert [row[0] for row in queried(reader, course)] == [T0, T0 + 600.0]
    assert [row[0] for row in queried(reader, fleet)] == ["T07"]
    assert queried(reader, "SELECT * FROM later") == []
    with pytest.raises(StoreFault, match="read-only"):
        reader.commit(everything())
    reader.close()
    # rights are granted by somebody: a loop that lacks them tries again
    reader = open_store(postgresql.url("hygrokf", user="hygrokf_reader"))
    with pytest.raises(StoreFault, match="permission denied"):
        reader.commit(everything())
    reader.close()
    reader = open_store(file, read_only=True)
    plain_course = plain_course.replace("$__from", f"{T0:.0f}000").replace("$__to", f"{T0 + 601:.0f}000")
    assert [row[0] for row in queried(reader, plain_course)] == [T0, T0 + 600.0]
    assert [row[0] for row in queried(reader, fleet)] == ["T07"]
    reader.close()
