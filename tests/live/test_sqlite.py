"""A store in one file: damage refused and left alone, full disks outlived, killed trackers gone on with."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from builders.live_case import count_of, expect_offline
from builders.service_case import Acknowledging, in_small_rounds, running, with_every_store
from builders.store_case import T0, everything, observed, queried, refused
from builders.tracking_process import halt_after, killed_at, started
from builders.waiting import eventually

from hygrokf.data.record import Record
from hygrokf.live.batch import Batch
from hygrokf.live.notification.notices import acknowledge
from hygrokf.live.service import Service
from hygrokf.live.storage import database
from hygrokf.live.storage.schema import VERSION
from hygrokf.live.storage.store import Store, StoreFault, open_store
from hygrokf.live.turbine import Turbine


# -- damage --------------------------------------------------------------------------------------------------
@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A store of about a hundred pages."""
    path = tmp_path / "live.db"
    store = open_store(f"sqlite:{path}")
    store.commit(everything())
    store.commit(Batch(observations=[observed("rain", T0 + i, float(i)) for i in range(5000)]))
    store.close()
    return path


def page_of(path: Path, table: str) -> int:
    """Where the root page of a table begins [bytes]."""
    with closing(sqlite3.connect(path)) as connection:
        ((root,),) = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = ?", (table,))
        return (root - 1) * connection.execute("PRAGMA page_size").fetchone()[0]


@pytest.mark.parametrize("place", ["magic", "page size", "schema", "table", "leaf", "cut page", "cut half"])
def test_a_damaged_file_is_refused_and_left_as_it_is(file: Path, place: str) -> None:
    data = bytearray(file.read_bytes())
    if place == "magic":
        data[:16] = b"\x00" * 16
    elif place == "page size":
        data[16:18] = b"\x00\x07"
    elif place == "schema":
        data[100:108] = b"\xff" * 8
    elif place == "table":
        start = page_of(file, "observation")
        data[start : start + 8] = b"\xff" * 8
    elif place == "leaf":  # a cell's place beyond its page, in the middle of the file
        pages = [p for p in range(len(data) // 2, len(data), 4096) if data[p] == 13]
        data[pages[0] + 8 : pages[0] + 10] = b"\xff\xff"
    else:
        del data[len(data) - 1000 if place == "cut page" else len(data) // 2 :]
    file.write_bytes(bytes(data))
    said = refused(f"sqlite:{file}")
    assert str(file) in said and "restore a copy" in said and "nothing was written" in said, said
    assert file.read_bytes() == bytes(data)


def test_a_damaged_file_keeps_its_log_too(file: Path, tmp_path: Path) -> None:
    """As a killed tracker leaves it: the newest rows are in the log, which a careless look would move into
    the file."""
    store = open_store(f"sqlite:{file}")
    store.commit(Batch(observations=[observed("snow", T0 + i, float(i)) for i in range(100)]))
    copy = tmp_path / "copy.db"
    start = page_of(file, "alarm")
    data = bytearray(file.read_bytes())
    data[start : start + 8] = b"\xff" * 8
    copy.write_bytes(bytes(data))
    log = Path(f"{file}-wal").read_bytes()
    assert len(log) > 4096
    Path(f"{copy}-wal").write_bytes(log)
    store.close()
    assert "damaged" in refused(f"sqlite:{copy}")
    assert copy.read_bytes() == bytes(data) and Path(f"{copy}-wal").read_bytes() == log


def test_a_process_that_died_while_it_made_the_tables(tmp_path: Path) -> None:
    """Its journal is undone, and the store is made anew."""
    path = tmp_path / "live.db"
    dies = (
        "import os, sqlite3, sys\nc = sqlite3.connect(sys.argv[1], isolation_level=None)\nc.execute('PRAGMA "
        "cache_size = 5')\nc.execute('BEGIN IMMEDIATE')\nfor n in range(50):\n    c.execute(f'CREATE TABLE "
        "t{n} (x)')\n    c.execute(f'INSERT INTO t{n} VALUES (zeroblob(20000))')\nos.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run([sys.executable, "-c", dies, str(path)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert path.stat().st_size > 0 and Path(f"{path}-journal").stat().st_size > 0
    store = open_store(f"sqlite:{path}")
    store.commit(everything())
    assert (
        store.size()["observation"] == 2
        and queried(store, "SELECT name FROM sqlite_master WHERE name = 't1'") == []
    )
    store.close()


# -- several at once -----------------------------------------------------------------------------------------
def test_several_processes_may_make_a_store_at_once(tmp_path: Path) -> None:
    """Three of them, a new store at each of fifteen beats."""
    opens = (
        "import sys, time\nfrom hygrokf.live.storage.store import open_store\nprint('ready', flush=True)\n"
        "beat = float(sys.stdin.readline())\nfor n in range(15):\n    while time.time() < beat + 0.05 * n:\n "
        "       pass\n    open_store(f'sqlite:{sys.argv[1]}/{n}.db').close()\n"
    )
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-c", opens, str(tmp_path)]
    several = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, cwd=root)
        for _ in range(3)
    ]  # fmt: skip
    try:
        assert [one.stdout.readline() for one in several] == ["ready\n"] * 3
        beat = time.time() + 0.2
        for one in several:
            one.stdin.write(f"{beat}\n")
            one.stdin.flush()
        assert [one.communicate(timeout=240.0)[1] for one in several] == [""] * 3
    finally:
        for one in several:
            one.kill()
            one.communicate()
    for n in range(15):
        store = open_store(f"sqlite:{tmp_path / f'{n}.db'}")
        assert queried(store, "SELECT version FROM schema_version") == [(VERSION,)]
        assert queried(store, "PRAGMA journal_mode") == [("wal",)]
        assert queried(store, "PRAGMA integrity_check") == [("ok",)]
        store.close()


def test_one_file_has_one_tracker_and_many_readers(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "CLAIM_S", 0.2)
    url = f"sqlite:{file}"
    first, page = open_store(url), open_store(url)
    first.claim("turbine", ["T1", "T2"])
    first.claim("turbine", ["T2", "T3"])
    second = open_store(url)
    with pytest.raises(StoreFault, match=f"turbine T9 .* by process {os.getpid()} on "):
        second.claim("turbine", ["T9"])
    assert acknowledge(page, "a1", "control room", T0, "defect") and page.size()["observation"] == 5002
    assert queried(first, "SELECT name FROM claim ORDER BY name") == [("T1",), ("T2",), ("T3",)]
    first.close()
    second.claim("turbine", ["T9"])
    assert queried(page, "SELECT kind, name FROM claim") == [("turbine", "T9")]
    second.close()
    page.close()


def test_a_dead_tracker_holds_nothing(file: Path) -> None:
    holds = (
        "import sys, time\nfrom hygrokf.live.storage.store import open_store\nstore = "
        "open_store(sys.argv[1])\nstore.claim('turbine', ['T1'])\nprint('held', flush=True)\n"
        "time.sleep(600)\n"
    )
    root = Path(__file__).resolve().parents[2]
    holder = subprocess.Popen(
        [sys.executable, "-c", holds, f"sqlite:{file}"], stdout=subprocess.PIPE, text=True, cwd=root
    )
    try:
        assert holder.stdout.readline() == "held\n"
        store = open_store(f"sqlite:{file}")
        with pytest.raises(StoreFault, match=f"by process {holder.pid} on "):
            store.claim("turbine", ["T1"])
        holder.kill()
        holder.wait(timeout=60.0)
        store.claim("turbine", ["T1"])
        store.close()
    finally:
        holder.kill()
        holder.communicate()


# -- a full disk, a killed tracker ---------------------------------------------------------------------------
def test_a_full_disk_is_outlived(
    tmp_path: Path,
    record: Record,
    turbine: Turbine,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """SQLite itself says so: the file may not grow; when there is room again the loop goes on."""
    in_small_rounds(monkeypatch, 100, 0.02)
    url, is_full = f"sqlite:{tmp_path / 'live.db'}", threading.Event()
    is_full.set()

    def limit(store: Store) -> None:
        if is_full.is_set():
            ((pages,),) = queried(store, "PRAGMA page_count")
            queried(store, f"PRAGMA max_page_count = {pages + 10}")

    with_every_store(monkeypatch, limit)
    stream = Acknowledging(record)
    service = Service({"T1": turbine}, [stream], url)
    with running(service, until_ended=True):
        try:
            eventually(lambda: service.health.failures >= 5)
        finally:
            is_full.clear()
    said = [one.fault for one in caplog.records if one.message == "the store failed"]
    assert len(said) >= 5 and all("full" in words for words in said)
    assert service.health.store == ""
    stream.expect_acknowledged()
    expect_offline(url, record, turbine)


@pytest.mark.slow
def test_a_disk_that_refuses_to_write_is_outlived(
    tmp_path: Path, case: Path, record: Record, turbine: Turbine
) -> None:
    """The system refuses every byte beyond a size, and takes them again later."""
    resource = pytest.importorskip("resource")
    if not hasattr(resource, "prlimit"):
        pytest.skip("this system cannot limit the files of another process")
    path = tmp_path / "live.db"
    tracker = started(case, f"sqlite:{path}", speed=30_000.0)
    try:
        eventually(lambda: observed_count(path) > 300)
        resource.prlimit(tracker.pid, resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))
        assert "the store failed" in tracker.stderr.readline()
        resource.prlimit(tracker.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        _, said = tracker.communicate(timeout=120.0)
        assert tracker.returncode == 0, said
    finally:
        tracker.kill()
        tracker.communicate()
    expect_offline(f"sqlite:{path}", record, turbine)


def observed_count(path: Path) -> int:
    """How many observations a store holds, looked at from outside."""
    try:
        with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True, timeout=5.0)) as connection:
            return connection.execute("SELECT COUNT(*) FROM observation").fetchone()[0]
    except sqlite3.OperationalError:  # not there yet
        return 0


@pytest.mark.parametrize("kills", [1, pytest.param(5, marks=pytest.mark.slow)])
def test_a_tracker_killed_at_random_moments_ends_in_the_offline_filter(
    tmp_path: Path, case: Path, record: Record, turbine: Turbine, kills: int
) -> None:
    path, random = tmp_path / "live.db", np.random.default_rng(11)
    for mark in np.sort(random.uniform(0.05, 0.9, kills)) * count_of(record):
        tracker = started(case, f"sqlite:{path}", halt=halt_after(mark, record))
        killed_at(mark, tracker, lambda: observed_count(path), random)
        with closing(sqlite3.connect(path)) as connection:
            assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    assert observed_count(path) < count_of(record)
    tracker = started(case, f"sqlite:{path}")
    assert tracker.communicate(timeout=120.0)[1] == "" and tracker.returncode == 0
    expect_offline(f"sqlite:{path}", record, turbine)
