"""Restoring a store from a copy, after a crash and beside a running tracker, as the docs say."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sqlite3
import subprocess
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from builders.command_line import run
from builders.databases import Server, program
from builders.documents import document
from builders.live_case import count_of, expect_offline
from builders.service_case import Acknowledging, in_small_rounds, running
from builders.store_case import T0, everything, observed
from builders.tracking_process import halt_after, killed_at, started
from builders.waiting import eventually

from hygrokf.data.record import Record
from hygrokf.live.batch import Batch
from hygrokf.live.service import Service
from hygrokf.live.storage import sqlite as module
from hygrokf.live.storage.database import StoreFault
from hygrokf.live.storage.sqlite import restore_sqlite
from hygrokf.live.storage.store import open_store
from hygrokf.live.turbine import Turbine

PAGE = document("live_store.md").read_text(encoding="utf-8")
BACKUP, RESTORE = re.findall(r"^```text\n(.*?)^```", PAGE.split("## Backup")[1], re.DOTALL | re.MULTILINE)


def observations(path: Path) -> int:
    with closing(sqlite3.connect(path)) as connection:
        ((count,),) = connection.execute("SELECT COUNT(*) FROM observation")
        return int(count)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a store of 102 readings, some of them in its log as after a crash, and a copy of two."""
    store = open_store(f"sqlite:{tmp_path / 'crashed.db'}")
    store.commit(everything())
    store.database.connection.execute(f"VACUUM INTO '{tmp_path / 'copy.db'}'")
    store.commit(Batch(observations=[observed("rain", T0 + i, float(i)) for i in range(100)]))
    for end in ("", "-wal"):  # as a killed tracker leaves them: nothing was moved from the log to the file
        shutil.copy(tmp_path / f"crashed.db{end}", tmp_path / f"live.db{end}")
    store.close()
    assert (tmp_path / "live.db-wal").stat().st_size > 0
    monkeypatch.chdir(tmp_path)
    return tmp_path


def contents(folder: Path) -> dict[str, bytes]:
    """Bytes of the store's files, but for those that hold locks."""
    files = [folder / "live.db", folder / "live.db-wal"]
    return {path.name: path.read_bytes() for path in files}


# -- SQLite --------------------------------------------------------------------------------------------------
def test_the_page_s_commands_restore_after_a_crash(folder: Path) -> None:
    vacuum = shlex.split(BACKUP.splitlines()[0])
    assert vacuum[:2] == ["sqlite3", "live.db"]
    with closing(sqlite3.connect("crashed.db")) as connection:
        (folder / "copy.db").unlink()
        connection.execute(vacuum[2])
    with closing(sqlite3.connect("copy.db")) as connection, connection:
        connection.execute("DELETE FROM observation WHERE signal = 'rain'")
    command = RESTORE.splitlines()[0]
    assert command == "hygrokf restore copy.db --store sqlite:live.db"
    said = run(command.removeprefix("hygrokf "))
    assert said.status == 0 and said.out.startswith("restored: ") and "newest reading 2023-11-14" in said.out
    assert observations(folder / "live.db") == 2 and not (folder / "live.db-wal").exists()
    (kept,) = [path for path in folder.glob("live.db.before-*Z")]
    assert str(kept) in said.out
    assert observations(kept) == 102  # with its log
    assert not list(folder.glob("*.part")) and not list(folder.glob("*.restoring"))


@pytest.mark.slow
def test_a_killed_tracker_goes_on_from_a_copy(
    tmp_path: Path, case: Path, record: Record, turbine: Turbine
) -> None:
    url, path, random = f"sqlite:{tmp_path / 'live.db'}", tmp_path / "live.db", np.random.default_rng(2)
    for mark in (0.3, 0.6):
        store = open_store(url)
        mark *= count_of(record)
        tracker = started(case, url, halt=halt_after(mark, record))
        killed_at(mark, tracker, lambda store=store: store.size()["observation"], random)
        if mark < 0.5 * count_of(record):
            store.database.connection.execute(f"VACUUM INTO '{tmp_path / 'copy.db'}'")
        store.close()
    before = observations(path)
    found = restore_sqlite(tmp_path / "copy.db", path)
    assert found.turbines == 1
    assert observations(path) < before == observations(found.kept[0])
    Service({"T1": turbine}, [Acknowledging(record)], url).run(until_ended=True)
    expect_offline(url, record, turbine)


def test_a_store_that_is_tracked_is_left_alone(folder: Path) -> None:
    store = open_store("sqlite:live.db")
    store.claim("turbine", ["T1"])
    before = contents(folder)
    said = run("restore copy.db --store sqlite:live.db")
    assert said.status == 2 and f"process {os.getpid()}" in said.err and "end it first" in said.err
    assert contents(folder) == before
    store.close()
    assert run("restore copy.db --store sqlite:live.db --json").status == 0


@pytest.mark.parametrize("what", ["missing", "itself", "damaged", "foreign", "text", "empty", "other schema"])
def test_a_copy_that_is_none_changes_nothing(folder: Path, what: str) -> None:
    copy, words = folder / "copy.db", ""
    if what == "missing":
        copy.unlink()
        words = "there is no such file"
    elif what == "itself":
        copy, words = folder / "live.db", "the store itself"
    elif what == "damaged":
        data = bytearray(copy.read_bytes())
        data[5 * 4096 : 8 * 4096] = b"\xff" * (3 * 4096)
        copy.write_bytes(data)
    elif what == "foreign":
        copy.unlink()
        with closing(sqlite3.connect(copy)) as connection:
            connection.execute("CREATE TABLE mine (x)")
        words = "another database"
    elif what in ("text", "empty"):
        copy.write_text("no database" * 500 if what == "text" else "")
    else:
        with closing(sqlite3.connect(copy)) as connection, connection:
            connection.execute("INSERT INTO schema_version VALUES (99, 0.0)")
        words = "found schema 99"
    before = contents(folder)
    said = run(f"restore {copy.name} --store sqlite:live.db")
    assert said.status == 2 and words in said.err and "Traceback" not in said.err, said
    assert contents(folder) == before
    assert observations(folder / "live.db") == 102


@pytest.mark.parametrize("step", range(5))
def test_an_interrupted_restore_is_noticed_and_repeated(
    folder: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    """It dies before its n-th change of a name: nothing has happened yet, or no tracker opens the store."""
    steps = 0

    def dying(change):  # type: ignore[no-untyped-def]
        def changed(*given):  # type: ignore[no-untyped-def]
            nonlocal steps
            steps += 1
            if steps > step:
                raise KeyboardInterrupt
            return change(*given)

        return changed

    with monkeypatch.context() as patched:
        patched.setattr(module.os, "replace", dying(os.replace))
        patched.setattr(module.os, "rename", dying(os.rename))
        try:
            restore_sqlite(Path("copy.db"), Path("live.db"))
        except KeyboardInterrupt:
            pass
    if step == 0:
        assert observations(folder / "live.db") == 102
    elif step < 4:
        with pytest.raises(StoreFault, match="run hygrokf restore again"):
            open_store("sqlite:live.db")
    restore_sqlite(Path("copy.db"), Path("live.db"))
    store = open_store("sqlite:live.db")
    assert store.size()["observation"] == 2
    store.close()
    kept = [path for path in folder.glob("live.db.before-*Z") if observations(path) == 102]
    assert len(kept) == 1 or step in (2, 3)  # file and log were separated before the file moved


def test_a_store_that_is_gone_is_restored(folder: Path) -> None:
    for path in folder.glob("live.db*"):
        path.unlink()
    found = restore_sqlite(Path("copy.db"), Path("live.db"))
    assert found.kept == () and observations(folder / "live.db") == 2


# -- PostgreSQL ----------------------------------------------------------------------------------------------
def test_the_commands_for_postgresql(postgresql: Server, tmp_path: Path) -> None:
    name = postgresql.database()
    url = postgresql.url(name)
    store = open_store(url)
    store.commit(everything())
    dump = tmp_path / "copy.dump"
    subprocess.run(
        [program("pg_dump"), "--format=custom", f"--file={dump}", "-d", url], check=True, capture_output=True
    )
    store.commit(Batch(observations=[observed("rain", T0, 1.0)]))
    store.close()
    said = run(f"restore {dump} --store {url}")
    assert said.status == 0
    for command in said.out.splitlines():
        if not command.startswith("#"):
            parts = shlex.split(command)
            done = subprocess.run(
                [str(program(parts[0])), *parts[1:]], check=False, capture_output=True, text=True
            )
            assert done.returncode == 0, (command, done.stderr)
    store = open_store(url)
    assert store.size()["observation"] == 2
    store.claim("turbine", ["T1"])
    store.close()
    kept = postgresql.execute(
        "postgres", f"SELECT datname FROM pg_database WHERE datname LIKE '{name}_before_%'"
    )
    assert postgresql.execute(kept[0][0], "SELECT COUNT(*) FROM observation") == [(3,)]
    assert run(f"restore {tmp_path / 'none'} --store {url}").status == 2
    refused = run(f"restore {dump} --store postgresql://me:geheim@host/live")
    assert refused.status == 2 and "geheim" not in refused.err


# -- a store that is replaced under a tracker ----------------------------------------------------------------
def replaced_count(url: str) -> int:
    store = open_store(url, read_only=True)
    found = store.counters().get(("", "store replaced"), 0)
    store.close()
    return found


def test_a_file_that_is_replaced_under_a_tracker_is_noticed(
    tmp_path: Path, record: Record, turbine: Turbine, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_small_rounds(monkeypatch, 50)
    url, path = f"sqlite:{tmp_path / 'live.db'}", tmp_path / "live.db"
    stream = Acknowledging(record, halts=(0.4, 0.7))
    service = Service({"T1": turbine}, [stream], url)
    with running(service, until_ended=True):
        eventually(lambda: len(stream.acknowledged) > 0.3 * len(stream.messages))
        with closing(sqlite3.connect(path)) as connection:
            connection.execute(f"VACUUM INTO '{tmp_path / 'copy.db'}'")
        stream.go_on()
        eventually(lambda: len(stream.acknowledged) > 0.6 * len(stream.messages))
        for end in ("-wal", "-shm"):
            Path(f"{path}{end}").unlink(missing_ok=True)
        os.replace(tmp_path / "copy.db", path)
        stream.go_on()
    assert service.health.failures == 1 and service.health.store == ""
    assert replaced_count(url) == 1
    # what came since is in the new file, what came between copy and replacement is the known gap
    assert 0.5 * count_of(record) < observations(path) < count_of(record)


def test_an_older_state_put_in_place_of_a_database_is_noticed(
    postgresql: Server, record: Record, turbine: Turbine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As by pg_restore --clean: the tables hold an earlier batch of the source."""
    in_small_rounds(monkeypatch, 50)
    name = postgresql.database()
    stream = Acknowledging(record, halts=(0.5,))
    service = Service({"T1": turbine}, [stream], postgresql.url(name))
    with running(service, until_ended=True):
        eventually(lambda: len(stream.acknowledged) == int(0.5 * len(stream.messages)))
        postgresql.execute(
            name, """UPDATE memory SET content = '"earlier"' WHERE name = 'batch of replay:'"""
        )
        stream.go_on()
    assert service.health.failures == 1
    assert replaced_count(postgresql.url(name)) == 1
