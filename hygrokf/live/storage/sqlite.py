"""A store in one SQLite file, with a lock file beside it that the writing tracker holds."""

from __future__ import annotations

import os
import shutil
import sqlite3
import sys
import time
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from sqlalchemy import Select, column, delete, func, select, table, text

from hygrokf.live.storage.database import (
    CLAIM_AGAIN_S,
    Database,
    Row,
    StoreFault,
    StoreUnready,
    one_line,
    refuse_other_schema,
)
from hygrokf.live.storage.schema import SQLITE, claim, observation, schema_version, turbine
from hygrokf.live.storage.statements import CLAIMS, LAST_CLAIM, SCHEMA_NUMBER, count_rows

APPLICATION_ID = 0x68796B66
"""Application id in the file's header ("hykf"), which distinguishes a store from other databases."""
BUSY_S = 10.0
"""[s] for which a statement waits for another process's lock."""
INTERNAL_ERRORS = {
    sqlite3.SQLITE_ERROR, sqlite3.SQLITE_INTERNAL, sqlite3.SQLITE_CONSTRAINT, sqlite3.SQLITE_MISMATCH,
    sqlite3.SQLITE_MISUSE, sqlite3.SQLITE_RANGE, sqlite3.SQLITE_TOOBIG,
}  # fmt: skip
"""Result codes of an invalid statement or value; all other codes have an external cause: disk, file or
another process."""


_MASTER = table("sqlite_master", column("name"))
SQLITE_STORE_TABLES = select(_MASTER.c.name).where(_MASTER.c.name == schema_version.name)


class SqliteDatabase(Database):
    """A connection to the store's file."""

    begin = "BEGIN IMMEDIATE"
    errors = sqlite3.Error
    dialect = SQLITE
    connection: sqlite3.Connection

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        super().__init__(connection, f"sqlite:{path}")
        self._path = path
        self._lock: IO[bytes] | None = None
        self.identity: tuple[int, int] | None = None

    def is_replaced(self) -> bool:
        return self.identity is not None and identity_of(self._path) != self.identity

    def is_trouble(self, error: Exception) -> bool:
        code = getattr(error, "sqlite_errorcode", None)
        return code is not None and code & 0xFF not in INTERNAL_ERRORS

    def has_tables(self) -> bool:
        return bool(self.rows(SQLITE_STORE_TABLES))

    def take_turn(self) -> None:
        """Mark the file as a store; BEGIN IMMEDIATE has already waited for other processes."""
        self.execute(text(f"PRAGMA application_id={APPLICATION_ID}"))

    def try_claim(self, wanted: Sequence[tuple[str, str]]) -> tuple[str, str, str] | None:
        """One file has one tracker: the lock file covers everything that it tracks."""
        if self._lock is None:
            self._lock = lock_file(lock_path(self._path))
            if self._lock is None:
                row = self.first(LAST_CLAIM)
                return (*wanted[0], row[0] if row else "another process")
            self.execute(delete(claim))
        with self.transaction():
            self.insert_claims(wanted, 0)
        return None

    def claims(self) -> dict[tuple[str, str], str]:
        """Claims count only while the file is locked, because those of a killed process remain in the
        table."""
        if self._lock is None and not is_locked(lock_path(self._path)):
            return {}
        return {(kind, name): who for kind, name, who in self.rows(CLAIMS)}

    def faults(self) -> list[str]:
        return [row[0] for row in self.rows(text("PRAGMA quick_check(5)")) if row[0] != "ok"]

    def may_write(self) -> bool:
        return all(os.access(path, os.W_OK) for path in (self._path, self._path.parent))

    def size(self) -> int:
        log = Path(f"{self._path}-wal")
        return self._path.stat().st_size + (log.stat().st_size if log.exists() else 0)

    def close(self) -> None:
        super().close()
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def identity_of(path: Path) -> tuple[int, int] | None:
    """Device and inode of a file, which differ for another file of the same name; None without a file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def path_of(url: str) -> Path:
    """Path of the file of a store at `sqlite:PATH`."""
    return Path(url.removeprefix("sqlite:").removeprefix("//"))


def lock_path(path: Path) -> Path:
    """Path of the lock file beside a store's file."""
    return Path(f"{os.path.realpath(path)}.lock")


def restoring_path(path: Path) -> Path:
    """Path of the copy that a restore renames to the store's path; it exists only if a restore was
    interrupted."""
    return Path(f"{os.path.realpath(path)}.restoring")


def is_locked(path: Path) -> bool:
    """Whether a process holds the lock file; a missing file is not created."""
    if not path.exists():
        return False
    file = lock_file(path, "rb")
    if file is not None:
        file.close()
    return file is None


def lock_file(path: Path, mode: str = "ab") -> IO[bytes] | None:
    """Open the file, created if missing, and lock it until it is closed; None if another process holds it."""
    try:
        file = path.open(mode)
    except OSError as fault:
        raise StoreFault(
            f"{path}: cannot be opened ({fault.strerror}); check its folder's permissions"
        ) from fault
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(0)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        file.close()
        return None
    except OSError as fault:
        file.close()
        raise StoreFault(
            f"{path}: cannot be locked ({fault.strerror}); name a place on a local disk"
        ) from fault
    return file


def open_sqlite(path: Path, read_only: bool = False) -> SqliteDatabase:
    """Open the store in a file, creating it if it is missing.  Raises StoreFault; a file that is not a store
    stays unchanged."""
    if not path.parent.is_dir():
        raise StoreFault(f"{path}: the folder {path.parent} does not exist; make it, or name another place")
    if read_only and not path.is_file():
        raise StoreUnready(f"{path}: there is no such store; check the name")
    if restoring_path(path).exists():
        raise StoreFault(f"{path}: restoring it was interrupted; run hygrokf restore again")
    database = None
    try:
        if path.exists():
            refuse_unusable(path, check_pages=not read_only)
        database = SqliteDatabase(connect(path, "ro" if read_only else "rwc"), path)
        database.connection.execute("PRAGMA synchronous=FULL")
        database.prepare(read_only)
        if not read_only:
            _use_write_ahead_log(database.connection)
        database.identity = identity_of(path)
        return database
    except (sqlite3.Error, StoreFault) as fault:
        if database is not None:
            database.close()
        if isinstance(fault, StoreFault):
            raise
        raise StoreFault(_opening_fault(path, fault)) from fault


def _opening_fault(path: Path, fault: sqlite3.Error) -> str:
    """The message that says why a file cannot be opened as a store, and what to do."""
    if path.is_dir():
        return f"{path}: expected the file of a store, found a directory; name a file in it"
    if not os.access(path.parent, os.W_OK | os.X_OK):
        return f"{path}: the folder {path.parent} is write-protected; change its rights or name another"
    if path.exists() and not os.access(path, os.R_OK | os.W_OK):
        return f"{path}: no right to read and write it; change its rights, or name a new file"
    return (
        f"{path}: it cannot be read as a store ({fault}); nothing was written to it. "
        "Move it away and restore a copy, or name a new file"
    )


def connect(path: Path, mode: str) -> sqlite3.Connection:
    return sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}",
        uri=True, timeout=BUSY_S, isolation_level=None, check_same_thread=False,
    )  # fmt: skip


def _rows(connection: sqlite3.Connection, query: Select[Any]) -> list[Row]:
    """The rows of a query on a connection that is not a `SqliteDatabase`."""
    compiled = query.compile(dialect=SQLITE, compile_kwargs={"literal_binds": True})
    return connection.execute(str(compiled)).fetchall()


def refuse_unusable(path: Path, check_pages: bool) -> None:
    """Raise StoreFault for another program's database, another schema or, with `check_pages`, a damaged file.

    An empty file may become a store.  The connection is read-only because closing a writable one would move
    pages of the log into the file.
    """
    with closing(connect(path, "ro")) as connection:
        try:
            pages = connection.execute("PRAGMA page_count").fetchone()[0]
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_READONLY_ROLLBACK:
                raise
            # a process died while creating the tables: SQLite rolls its transaction back once a connection
            # may write
            with closing(connect(path, "rw")) as writable:
                pages = writable.execute("PRAGMA page_count").fetchone()[0]
        if pages == 0:
            return
        if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
            raise StoreFault(
                f"{path}: expected a store of hygrokf, found another database; name another file"
            )
        query = "PRAGMA quick_check(5)"
        answers = [row[0] for row in connection.execute(query)] if check_pages else ["ok"]
        if answers != ["ok"]:
            raise StoreFault(
                f"{path}: the store is damaged ({'; '.join(answers)}); nothing was written to it. "
                "Move it away and restore a copy, or name a new file"
            )
        ((version,),) = _rows(connection, SCHEMA_NUMBER)
        refuse_other_schema(path, version)


def _use_write_ahead_log(connection: sqlite3.Connection) -> None:
    """Switch to the write-ahead log, retrying while another process switches, for which SQLite itself does
    not wait."""
    end = time.monotonic() + BUSY_S
    while time.monotonic() <= end:
        with suppress(sqlite3.OperationalError):
            connection.execute("PRAGMA journal_mode=WAL")
            return
        time.sleep(CLAIM_AGAIN_S)
    connection.execute("PRAGMA journal_mode=WAL")


# -- restoring a copy ----------------------------------------------------------------------------------------
FILE_SUFFIXES = ("", "-wal", "-shm", "-journal")
"""Suffixes of the names of a store's files: the database and its logs."""


@dataclass(frozen=True)
class Restored:
    """A restored store: its path, its number of turbines, the time of its newest reading [s] (None without
    readings), and the new names of the replaced files, which are `kept`."""

    store: Path
    turbines: int
    newest_s: float | None
    kept: tuple[Path, ...]


def restore_sqlite(copy: Path, store: Path) -> Restored:
    """Replace a store's file, which may be missing, by a copy.

    The copy is checked first.  Raises StoreFault; then nothing has changed, or the restore can be repeated.
    """
    path = Path(os.path.realpath(store))
    if not copy.is_file():
        raise StoreFault(f"{copy}: there is no such file; name the copy of a store")
    if path.exists() and copy.samefile(path):
        raise StoreFault(f"{copy}: the copy is the store itself; name another file")
    if not path.parent.is_dir():
        raise StoreFault(f"{path}: the folder {path.parent} does not exist; make it first")
    lock = lock_path(path)
    lock_is_new = not lock.exists()
    locked = lock_file(lock)
    if locked is None:
        raise StoreFault(f"{path}: a tracker runs on it ({_holder(path)}); end it first, then restore")
    with closing(locked):
        try:
            part = path.with_name(f"{path.name}.part")
            turbines, newest_s = _copy_checked(copy, part)
            if lock_is_new:
                _copy_owner(path, lock)
            _copy_owner(path, part)
            os.replace(part, restoring_path(path))
            kept = _rename_files(path)
            os.replace(restoring_path(path), path)
            _sync(path.parent)
        except OSError as fault:
            raise StoreFault(f"{path}: {fault.strerror or fault}; mend that and restore again") from fault
    return Restored(path, turbines, newest_s, kept)


def _copy_checked(copy: Path, part: Path) -> tuple[int, float | None]:
    """Copy a store with the content of its log to the file `part` and check it.

    Returns the number of turbines and the time of the newest reading [s].
    """
    try:
        refuse_unusable(copy, check_pages=True)
        part.unlink(missing_ok=True)
        with closing(connect(copy, "ro")) as source, closing(connect(part, "rwc")) as target:
            source.backup(target)
            target.execute("PRAGMA journal_mode=DELETE")
            (answer,) = target.execute("PRAGMA integrity_check(1)").fetchone()
            if answer != "ok":
                raise StoreFault(f"{copy}: the copy is damaged ({answer}); name another one")
            ((turbines,),) = _rows(target, count_rows(turbine))
            ((newest,),) = _rows(target, select(func.max(observation.c.time)))
        with part.open("rb") as file:
            os.fsync(file.fileno())
    except (sqlite3.Error, TypeError) as error:
        part.unlink(missing_ok=True)
        raise StoreFault(f"{copy}: it cannot be restored ({one_line(error)}); name another copy") from error
    except StoreFault:
        part.unlink(missing_ok=True)
        raise
    return turbines, newest


def _rename_files(path: Path) -> tuple[Path, ...]:
    """Rename the store's files alike, so that they remain a store of another name; returns the new paths."""
    aside = f"{path.name}.before-{datetime.now(UTC):%Y%m%dT%H%M%S%fZ}"
    kept = []
    for suffix in FILE_SUFFIXES:
        old, new = Path(f"{path}{suffix}"), path.with_name(f"{aside}{suffix}")
        if old.exists():
            os.rename(old, new)
            kept.append(new)
    _sync(path.parent)
    return tuple(kept)


def _holder(path: Path) -> str:
    """The process that writes to a store, by its last claim if that still holds."""
    with suppress(sqlite3.Error), closing(connect(path, "ro")) as connection:
        rows = _rows(connection, LAST_CLAIM)
        if rows and is_locked(lock_path(path)):
            return str(rows[0][0])
    return "another process"


def _copy_owner(path: Path, new: Path) -> None:
    """Give a new file the owner and mode of the store, or the owner of its folder if there is no store,
    because another user than the tracker's may restore it."""
    model = path if path.exists() else path.parent
    if path.exists() and new.suffix != ".lock":
        shutil.copymode(path, new)
    if hasattr(os, "chown"):
        status = model.stat()
        with suppress(PermissionError):
            os.chown(new, status.st_uid, status.st_gid)


def _sync(folder: Path) -> None:
    """Flush a folder's entries to the disk, where the system can."""
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
