"""Puts a copy in the place of a store; the files that it replaces are kept beside it.

A store in SQLite is a file and its write-ahead log.  SQLite would play a log that is left beside another
file into that, so that both are exchanged together.  Until that is done, the file `unfinished` lets no
tracker open the store.
"""

from __future__ import annotations

import os
import shlex
import shutil
import sqlite3
from contextlib import closing, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from hygrokf.live.storage.database import StoreFault, one_line
from hygrokf.live.storage.postgres import parameters_of
from hygrokf.live.storage.sqlite import (
    connect,
    is_locked,
    lock_file,
    lock_path,
    refuse_unfit,
    unfinished,
)

LOGS = ("", "-wal", "-shm", "-journal")
"""Ends of the names of a store's files."""


@dataclass(frozen=True)
class Restored:
    """A restored store: its path, its number of turbines, the time of its newest reading [s] (None without
    any), and the replaced files that were `kept`."""

    store: Path
    turbines: int
    newest_s: float | None
    kept: tuple[Path, ...]


def restore_sqlite(copy: Path, store: Path) -> Restored:
    """Put a copy in the place of a store's file, which need not exist any more.

    The copy is checked first.  Raises StoreFault; nothing is changed then, or the restore can be repeated.
    """
    path = Path(os.path.realpath(store))
    if not copy.is_file():
        raise StoreFault(f"{copy}: there is no such file; name the copy of a store")
    if path.exists() and copy.samefile(path):
        raise StoreFault(f"{copy}: the copy is the store itself; name another file")
    if not path.parent.is_dir():
        raise StoreFault(f"{path}: the folder {path.parent} does not exist; make it first")
    lock = lock_path(path)
    is_new = not lock.exists()
    held = lock_file(lock)
    if held is None:
        raise StoreFault(f"{path}: a tracker runs on it ({_holder(path)}); end it first, then restore")
    with closing(held):
        try:
            part = path.with_name(f"{path.name}.part")
            found = _checked_copy(copy, part)
            if is_new:
                _own_as(path, lock)
            _own_as(path, part)
            os.replace(part, unfinished(path))
            kept = _put_aside(path)
            os.replace(unfinished(path), path)
            _sync(path.parent)
        except OSError as fault:
            raise StoreFault(f"{path}: {fault.strerror or fault}; mend that and restore again") from fault
    return Restored(path, *found, kept)


def _checked_copy(copy: Path, part: Path) -> tuple[int, float | None]:
    """Copy a store, with what its log holds, to the file `part`; returns turbines and newest reading [s]."""
    try:
        refuse_unfit(copy, thoroughly=True)
        part.unlink(missing_ok=True)
        with closing(connect(copy, "ro")) as source, closing(connect(part, "rwc")) as target:
            source.backup(target)
            target.execute("PRAGMA journal_mode=DELETE")
            (said,) = target.execute("PRAGMA integrity_check(1)").fetchone()
            if said != "ok":
                raise StoreFault(f"{copy}: the copy is damaged ({said}); name another one")
            (turbines,) = target.execute("SELECT COUNT(*) FROM turbine").fetchone()
            (newest,) = target.execute("SELECT MAX(time) FROM observation").fetchone()
        with part.open("rb") as file:
            os.fsync(file.fileno())
    except (sqlite3.Error, TypeError) as error:
        part.unlink(missing_ok=True)
        raise StoreFault(f"{copy}: it cannot be restored ({one_line(error)}); name another copy") from error
    except StoreFault:
        part.unlink(missing_ok=True)
        raise
    return turbines, newest


def _put_aside(path: Path) -> tuple[Path, ...]:
    """Rename the store's files, so that together they remain a store of another name; returns their names."""
    aside = f"{path.name}.before-{datetime.now(UTC):%Y%m%dT%H%M%S%fZ}"
    kept = []
    for end in LOGS:
        old, new = Path(f"{path}{end}"), path.with_name(f"{aside}{end}")
        if old.exists():
            os.rename(old, new)
            kept.append(new)
    _sync(path.parent)
    return tuple(kept)


def _holder(path: Path) -> str:
    """The process that tracks into a store, as far as the store can say."""
    with suppress(sqlite3.Error), closing(connect(path, "ro")) as connection:
        found = connection.execute("SELECT who FROM claim ORDER BY since DESC LIMIT 1").fetchone()
        if found and is_locked(lock_path(path)):
            return str(found[0])
    return "another process"


def _own_as(path: Path, new: Path) -> None:
    """Give a new file the owner and the mode of the store, or the owner of its folder: who restores need not
    be the tracker's user."""
    model = path if path.exists() else path.parent
    if path.exists() and new.suffix != ".lock":
        shutil.copymode(path, new)
    if hasattr(os, "chown"):
        found = model.stat()
        with suppress(PermissionError):
            os.chown(new, found.st_uid, found.st_gid)


def _sync(folder: Path) -> None:
    """Write the names in a folder to the disk, where the system can."""
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def postgres_commands(copy: Path, url: str) -> list[str]:
    """The commands that restore a `pg_dump` into a new database and give that the name of the store's, which
    is kept under another name.

    Raises StoreFault.
    """
    said = parameters_of(url)
    from psycopg.conninfo import make_conninfo

    name = str(said.get("dbname") or said.get("user") or "hygrokf")
    server = {key: str(value) for key, value in said.items() if key not in ("dbname", "options")}
    admin = make_conninfo(**server, dbname="postgres")
    new, old = f"{name}_restored", f"{name}_before_{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    statements = (
        f"CREATE DATABASE {_quoted(new)} ENCODING 'UTF8' TEMPLATE template0",
        f"ALTER DATABASE {_quoted(name)} RENAME TO {_quoted(old)}",
        f"ALTER DATABASE {_quoted(new)} RENAME TO {_quoted(name)}",
    )
    restored = make_conninfo(**server, dbname=new)
    return [
        shlex.join(["psql", "-d", admin, "-c", statements[0]]),
        shlex.join(["pg_restore", "--exit-on-error", "--single-transaction", "-d", restored, str(copy)]),
        shlex.join(["psql", "-d", admin, "-1", "-c", statements[1], "-c", statements[2]]),
    ]


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
