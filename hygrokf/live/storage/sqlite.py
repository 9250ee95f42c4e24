"""A store in one SQLite file; beside it lies a lock file, held by the tracker that writes into it."""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import IO, Any

from hygrokf.live.storage.database import AGAIN_S, Database, StoreFault, StoreUnready, this_process
from hygrokf.live.storage.schema import SQLITE

APPLICATION_ID = 0x68796B66
"""What a store's file says it is ("hykf"), so that no other database is taken for one."""
BUSY_S = 10.0
"""[s] for which a statement waits for another process."""
OWN_MISTAKES = {
    sqlite3.SQLITE_ERROR, sqlite3.SQLITE_INTERNAL, sqlite3.SQLITE_CONSTRAINT, sqlite3.SQLITE_MISMATCH,
    sqlite3.SQLITE_MISUSE, sqlite3.SQLITE_RANGE, sqlite3.SQLITE_TOOBIG,
}  # fmt: skip
"""Result codes of a wrong statement or value; all others come from the disk, the file or another process."""


class SqliteDatabase(Database):
    """A connection to the file at `path`."""

    begin = "BEGIN IMMEDIATE"
    errors = sqlite3.Error
    words = SQLITE

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        super().__init__(connection, f"sqlite:{path}")
        self._path = path
        self._lock: IO[bytes] | None = None

    def is_trouble(self, error: Exception) -> bool:
        code = getattr(error, "sqlite_errorcode", None)
        return code is not None and code & 0xFF not in OWN_MISTAKES

    def has_tables(self) -> bool:
        return bool(self.rows("SELECT 1 FROM sqlite_master WHERE name = 'schema_version'"))

    def take_turn(self, cursor: Any) -> None:
        """BEGIN IMMEDIATE has waited already; with the first tables the file says what it is."""
        cursor.execute(f"PRAGMA application_id={APPLICATION_ID}")

    def taken(self, wanted: Sequence[tuple[str, str]]) -> tuple[str, str, str] | None:
        """One file has one tracker: the lock file is held for all that it tracks."""
        if self._lock is None:
            self._lock = locked(lock_of(self._path))
            if self._lock is None:
                found = self.rows("SELECT who FROM claim ORDER BY since DESC LIMIT 1")
                return (*wanted[0], found[0][0] if found else "another process")
            with self.transaction() as cursor:
                cursor.execute("DELETE FROM claim")
        rows = [(kind, name, 0, this_process(), time.time()) for kind, name in wanted]
        with self.transaction() as cursor:
            cursor.executemany(
                "INSERT INTO claim (kind, name, holder, who, since) VALUES (?, ?, ?, ?, ?)", rows
            )
        return None

    def claims(self) -> dict[tuple[str, str], str]:
        """Claims outlive a process that was killed; the lock does not."""
        if self._lock is None and not is_locked(lock_of(self._path)):
            return {}
        return {(kind, name): who for kind, name, who in self.rows("SELECT kind, name, who FROM claim")}

    def faults(self) -> list[str]:
        return [row[0] for row in self.rows("PRAGMA quick_check(5)") if row[0] != "ok"]

    def may_write(self) -> bool:
        return all(os.access(one, os.W_OK) for one in (self._path, self._path.parent))

    def size(self) -> int:
        log = Path(f"{self._path}-wal")
        return self._path.stat().st_size + (log.stat().st_size if log.exists() else 0)

    def close(self) -> None:
        super().close()
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def lock_of(path: Path) -> Path:
    """The lock file beside a store's file."""
    return Path(f"{os.path.realpath(path)}.lock")


def is_locked(path: Path) -> bool:
    """Whether a process holds a lock file; none is made."""
    if not path.exists():
        return False
    file = locked(path, "rb")
    if file is not None:
        file.close()
    return file is None


def locked(path: Path, mode: str = "ab") -> IO[bytes] | None:
    """The file, made if need be and held by this process until it is closed; None where another one holds it."""
    try:
        file = path.open(mode)
    except OSError as fault:
        raise StoreFault(
            f"{path}: cannot be opened ({fault.strerror}); check its folder's permissions"
        ) from fault
    try:
        if os.name == "nt":
            import msvcrt

            file.seek(0)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]  # of Windows alone
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
    """The store in a file, made where there is none yet.  Raises StoreFault; what is no store is left as it is."""
    if not path.parent.is_dir():
        raise StoreFault(f"{path}: the folder {path.parent} does not exist; make it, or name another place")
    if read_only and not path.is_file():
        raise StoreUnready(f"{path}: there is no such store; check the name")
    database = None
    try:
        if path.exists():
            _examine(path, thoroughly=not read_only)
        database = SqliteDatabase(_connected(path, "ro" if read_only else "rwc"), path)
        database.connection.execute("PRAGMA synchronous=FULL")
        database.migrate(read_only)
        if not read_only:
            _write_ahead(database.connection)
        return database
    except (sqlite3.Error, StoreFault) as fault:
        if database is not None:
            database.close()
        if isinstance(fault, StoreFault):
            raise
        raise StoreFault(
            f"{path}: this is no store that can be read ({fault}); nothing was written to it. "
            "Put it aside and restore a copy, or name a new file"
        ) from fault


def _connected(path: Path, mode: str) -> sqlite3.Connection:
    return sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}",
        uri=True, timeout=BUSY_S, isolation_level=None, check_same_thread=False,
    )  # fmt: skip


def _examine(path: Path, thoroughly: bool) -> None:
    """Refuse what is damaged or not a store; an empty file may become one.

    A connection that may write would, when it is closed, move the log's pages into a file that is to be left as it is.
    """
    with closing(_connected(path, "ro")) as connection:
        try:
            pages = connection.execute("PRAGMA page_count").fetchone()[0]
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_READONLY_ROLLBACK:
                raise
            # a process died while it made the tables: SQLite undoes that as soon as it may write
            with closing(_connected(path, "rw")) as other:
                pages = other.execute("PRAGMA page_count").fetchone()[0]
        if pages == 0:
            return
        if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
            raise StoreFault(
                f"{path}: expected a store of hygrokf, found another database; name another file"
            )
        faults = [row[0] for row in connection.execute("PRAGMA quick_check(5)")] if thoroughly else ["ok"]
        if faults != ["ok"]:
            raise StoreFault(
                f"{path}: the store is damaged ({'; '.join(faults)}); nothing was written to it. "
                "Put it aside and restore a copy, or name a new file"
            )


def _write_ahead(connection: sqlite3.Connection) -> None:
    """Turn the write-ahead log on; SQLite does not wait by itself where another process is about to do the same."""
    end = time.monotonic() + BUSY_S
    while True:
        with suppress(sqlite3.OperationalError):
            connection.execute("PRAGMA journal_mode=WAL")
            return
        if time.monotonic() > end:
            connection.execute("PRAGMA journal_mode=WAL")
            return
        time.sleep(AGAIN_S)
