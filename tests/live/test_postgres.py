"""A store in PostgreSQL: on a real server that is killed, that refuses, and that several trackers share."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from builders.databases import OWNER, Server
from builders.live_case import count_of, expect_offline
from builders.ports import free_port
from builders.service_case import Acknowledging, in_small_rounds, running
from builders.store_case import T0, everything, observed, queried, refused
from builders.tracking_process import halt_after, killed_at, started
from builders.waiting import eventually

from hygrokf.data.record import Record
from hygrokf.data.timestamps import whole_microseconds
from hygrokf.live import service as module
from hygrokf.live.batch import Batch
from hygrokf.live.service import Service
from hygrokf.live.sources.local import record_mapping
from hygrokf.live.storage import database, postgres
from hygrokf.live.storage.postgres import NO_SECRET, url_fault
from hygrokf.live.storage.schema import VERSION
from hygrokf.live.storage.store import Store, StoreFault, open_store
from hygrokf.live.turbines import Turbine


@pytest.fixture
def url(postgresql: Server) -> str:
    return postgresql.url(postgresql.database())


@pytest.fixture
def store(url: str) -> Iterator[Store]:
    made = open_store(url)
    yield made
    made.close()


# -- the server is lost --------------------------------------------------------------------------------------
def test_a_killed_server_loses_nothing_and_nothing_comes_twice(
    postgresql: Server, url: str, record: Record, turbine: Turbine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of its processes die at once in the middle; it comes back, and so does the loop."""
    in_small_rounds(monkeypatch, 25, 0.05)
    stream = Acknowledging(record, halts=(0.6,))
    service = Service({"T1": turbine}, [stream], url)
    with running(service, until_ended=True):
        try:
            eventually(lambda: len(stream.acknowledged) > 0.4 * len(stream.messages))
            postgresql.kill()
            stream.go_on()
            eventually(lambda: service.health.failures > 0)
            eventually(lambda: url in service.health.store)
        finally:
            if not postgresql.is_running:
                postgresql.start()
    assert service.health.store == ""
    stream.expect_acknowledged()
    expect_offline(url, record, turbine)


def test_a_session_that_is_ended_is_opened_anew(
    postgresql: Server, url: str, record: Record, turbine: Turbine, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_small_rounds(monkeypatch, 50)
    stream = Acknowledging(record, halts=(0.35, 0.65, 0.9))
    service = Service({"T1": turbine}, [stream], url)
    with running(service, until_ended=True):
        for share in (0.2, 0.5, 0.8):
            eventually(lambda share=share: len(stream.acknowledged) > share * len(stream.messages))
            ended = postgresql.execute(
                "postgres",
                "SELECT pid, pg_terminate_backend(pid) FROM pg_stat_activity "
                "WHERE application_name = 'hygrokf'",
            )
            pids = ", ".join(str(pid) for pid, _ in ended)
            alive = f"SELECT pid FROM pg_stat_activity WHERE pid IN ({pids})"
            eventually(lambda alive=alive: not postgresql.execute("postgres", alive))
            stream.go_on()
    assert service.health.failures >= 3
    stream.expect_acknowledged()
    expect_offline(url, record, turbine)


def test_another_session_s_lock_is_told_and_waited_for(
    url: str, record: Record, turbine: Turbine, monkeypatch: pytest.MonkeyPatch
) -> None:
    import psycopg

    in_small_rounds(monkeypatch, module.MOST_PER_ROUND)
    monkeypatch.setattr(
        postgres, "STORE_SESSION", ("SET lock_timeout = '100ms'", *postgres.STORE_SESSION[1:])
    )
    open_store(url).close()
    stream = Acknowledging(record)
    service = Service({"T1": turbine}, [stream], url)
    with ExitStack() as stack:
        with psycopg.connect(url) as other:
            other.execute("LOCK TABLE observation IN EXCLUSIVE MODE")
            stack.enter_context(running(service, until_ended=True))
            eventually(lambda: service.health.failures >= 2)
            assert "lock timeout" in service.health.store
    expect_offline(url, record, turbine)


@pytest.mark.slow
def test_a_tracker_killed_at_random_moments_ends_in_the_offline_filter(
    url: str, case: Path, record: Record, turbine: Turbine
) -> None:
    random = np.random.default_rng(12)
    store = open_store(url)
    for mark in np.sort(random.uniform(0.05, 0.9, 5)) * count_of(record):
        tracker = started(case, url, halt=halt_after(mark, record))
        killed_at(mark, tracker, lambda: store.size()["observation"], random)
    assert store.size()["observation"] < count_of(record)
    store.close()
    tracker = started(case, url)
    assert tracker.communicate(timeout=120.0)[1] == "" and tracker.returncode == 0
    expect_offline(url, record, turbine)


# -- what is refused -----------------------------------------------------------------------------------------
def test_what_is_not_reached_is_told_without_secrets(
    postgresql: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = postgresql.database()
    monkeypatch.setenv("PGPASSWORD", postgresql.password)
    open_store(postgresql.tcp_url(name)).close()
    monkeypatch.setenv("PGPASSWORD", "falsch-geheim")
    for url, words in (
        (postgresql.tcp_url(name), f'password authentication failed for user "{OWNER}"'),
        (postgresql.url("nowhere"), 'database "nowhere" does not exist'),
        (postgresql.url(name, user="nobody_here"), 'role "nobody_here" does not exist'),
        (f"postgresql://{OWNER}@127.0.0.1:{free_port()}/{name}", "refused"),
        (f"postgresql://{OWNER}@no-such-host.invalid/{name}", "cannot be reached"),
    ):
        said = refused(url)
        assert url in said and words in said and "check the server" in said, said
        assert "geheim" not in said and "\n" not in said
    assert "invalid URI query parameter" in refused(f"postgresql://{OWNER}@127.0.0.1/{name}?sslmod=require")


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://me:geheim@host/live", "postgres://me:ge/heim@host:5432/live",
        "postgresql://me:ge?heim@host/live",
        "postgresql://me:geheim@h@ost/live", "postgresql://host/live?password=geheim",
        "postgresql://:geheim@host/live",
        "postgresql://me@host/live?sslmode=require&sslpassword=geheim",
        "postgresql://me@host/live?pass%77ord=geheim",
    ],
)  # fmt: skip
def test_a_password_in_the_url_is_refused_and_never_shown(url: str) -> None:
    said = refused(url)
    assert said == NO_SECRET and "heim" not in said


def test_urls_without_a_password_are_fine() -> None:
    for url in (
        "postgresql://me@host:5432/live",
        "postgresql:///live?host=/run/pg&user=me",
        "postgresql://me@host/live?passfile=/run/pgpass",
        "sqlite:live.db",
    ):
        assert url_fault(url) is None


def test_a_database_that_is_no_place_for_a_store(postgresql: Server) -> None:
    name = postgresql.database()
    postgresql.execute(name, "CREATE TABLE source (mine TEXT)")
    said = refused(postgresql.url(name))
    assert 'relation "source" already exists' in said and "Name a separate database" in said
    tables = "SELECT table_name FROM information_schema.tables WHERE table_schema = 'public'"
    assert postgresql.execute(name, tables) == [("source",)]
    postgresql.execute(
        name, "CREATE TABLE schema_version (version TEXT)", "INSERT INTO schema_version VALUES ('V1.2')"
    )
    assert "Name a separate database" in refused(postgresql.url(name))
    postgresql.execute("postgres", "CREATE DATABASE latin ENCODING 'LATIN1' TEMPLATE template0")
    assert "expected a database in UTF8, found LATIN1" in refused(postgresql.url("latin"))


def test_two_stores_in_schemas_of_one_database(postgresql: Server) -> None:
    name = postgresql.database()
    postgresql.execute(name, "CREATE SCHEMA cabinets", "CREATE TABLE source (mine TEXT)")
    url = postgresql.url(name, options="-csearch_path%3Dcabinets")
    store = open_store(url)
    store.commit(everything())
    store.claim("turbine", ["T1"])
    store.close()
    assert postgresql.execute(name, "SELECT COUNT(*) FROM cabinets.observation") == [(2,)]
    again = open_store(url)
    assert again.size()["observation"] == 2
    again.close()


def test_without_psycopg_the_extra_is_named(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)
    assert "pip install 'hygrokf[postgres]'" in refused(url)


# -- several at once -----------------------------------------------------------------------------------------
def test_several_may_make_the_tables_at_once(postgresql: Server) -> None:
    for _ in range(3):
        url, gate, faults = postgresql.url(postgresql.database()), threading.Barrier(6), []

        def run(url=url, gate=gate, faults=faults) -> None:
            gate.wait()
            try:
                open_store(url).close()
            except Exception as fault:
                faults.append(fault)

        several = [threading.Thread(target=run) for _ in range(6)]
        for one in several:
            one.start()
        for one in several:
            one.join(timeout=60.0)
        assert faults == []
        store = open_store(url)
        assert queried(store, "SELECT version FROM schema_version") == [(VERSION,)]
        store.close()


def test_trackers_share_a_database_but_no_turbine(
    postgresql: Server, store: Store, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(database, "CLAIM_S", 0.2)
    store.claim("turbine", ["T1", "T2"])
    store.claim("turbine", ["T1"])
    second = open_store(url)
    second.claim("turbine", ["T3"])
    with pytest.raises(StoreFault, match=f"turbine T2 .* by process {os.getpid()} on "):
        second.claim("turbine", ["T2", "T4"])
    assert queried(store, "SELECT name FROM claim ORDER BY name") == [("T1",), ("T2",), ("T3",)]  # T4 neither
    second.claim("source", ["mqtt://broker"])
    with pytest.raises(StoreFault, match="the source mqtt://broker is already tracked"):
        store.claim("source", ["mqtt://broker"])
    # a session that dies holds nothing
    monkeypatch.setattr(database, "CLAIM_S", 10.0)
    ((process,),) = queried(store, "SELECT pg_backend_pid()")
    postgresql.execute("postgres", f"SELECT pg_terminate_backend({process})")
    second.claim("turbine", ["T1", "T2"])
    second.close()


def test_two_services_with_their_own_turbines_run_side_by_side(
    url: str, record: Record, turbine: Turbine
) -> None:
    streams, runners = [], []
    for name in ("T1", "T2"):
        stream = Acknowledging(record)
        stream.url = f"replay:{name}"
        stream.messages = [(at, {**content, "turbine": name}) for at, content in stream.messages]
        stream.mapping = record_mapping(record, name)
        streams.append(stream)
        runners.append(threading.Thread(target=Service({name: turbine}, [stream], url).run, args=(True,)))
    for one in runners:
        one.start()
    for one in runners:
        one.join(timeout=60.0)
    for name, stream in zip(("T1", "T2"), streams, strict=True):
        stream.expect_acknowledged()
        expect_offline(url, record, turbine, name)


# -- bits, rights, TLS ---------------------------------------------------------------------------------------
def test_every_bit_of_a_number_comes_back(store: Store) -> None:
    random = np.random.default_rng(5)
    values = np.frombuffer(random.bytes(8 * 2000), dtype=float)
    values = [float(v) for v in values[np.isfinite(values)]] + [
        5e-324,
        2.0**53 + 2,
        1.7976931348623157e308,
        0.1 + 0.2,
    ]
    times = [whole_microseconds(t) for t in np.sort(T0 + random.uniform(0.0, 1e7, len(values))).tolist()]
    store.commit(Batch(observations=[observed("rain", t, v) for t, v in zip(times, values, strict=True)]))
    found = store.readings("T1", 0.0)
    assert [one.value for one in found] == values and [one.time for one in found] == times


def test_tls_is_libpq_s_own(postgresql: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What sslmode and sslrootcert ask for in the URL is asked of the server."""
    certificate = postgresql.data / "server.crt"
    if not certificate.exists():
        pytest.skip("no openssl to make a certificate with")
    monkeypatch.setenv("PGPASSWORD", postgresql.password)
    root = tmp_path / "root.crt"
    root.write_bytes(certificate.read_bytes())
    place = f"{postgresql.port}/{postgresql.database()}?hostaddr=127.0.0.1&sslmode=verify-full&sslrootcert="
    store = open_store(f"postgresql://{OWNER}@localhost:{place}{root}")
    assert queried(store, "SELECT ssl FROM pg_stat_ssl WHERE pid = pg_backend_pid()") == [(True,)]
    store.close()
    assert "does not match host name" in refused(f"postgresql://{OWNER}@elsewhere.example:{place}{root}")
    assert "root certificate file" in refused(
        f"postgresql://{OWNER}@localhost:{place}{tmp_path / 'none.crt'}"
    )
