"""The database behind the store: statements, transactions, its tables, and which process tracks what.

The modules `sqlite` and `postgres` implement the differences.  An external error (network, disk, permissions)
becomes a `StoreFault` and may be retried; an invalid statement keeps the driver's own exception and must not
be.
"""

from __future__ import annotations

import os
import re
import socket
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from typing import TYPE_CHECKING, Any, TypeAlias

from hygrokf.errors import HygrokfError
from hygrokf.live.storage.schema import SQLITE, VERSION, Dialect, creation

if TYPE_CHECKING:
    import sqlite3

    import psycopg

CLAIM_S = 3.0
"""[s] a claim waits for the previous holder to go: the end of a process is noticed with a delay."""
REPLACED = (
    "it was replaced while the tracker ran; the tracker goes on with the store that is there now. Restart "
    "the tracker, so that its sources go on from the places of that store"
)
AGAIN_S = 0.1
"""[s] between two attempts to claim."""

_COMPARED = re.compile(r"(\b(?:time|received)\s*[<>=]+\s*)\?")
"""A parameter that is compared with a column of `schema.TIMESTAMPS`."""

SqlValue: TypeAlias = str | float | None
Row = tuple[Any, ...]
"""A row of a query or the parameters of a statement: text, numbers and None, as the driver returns them."""


Cursor: TypeAlias = "sqlite3.Cursor | psycopg.Cursor[Row]"
Connection: TypeAlias = "sqlite3.Connection | psycopg.Connection[Row]"


class StoreFault(HygrokfError):
    """The store cannot be used; the message tells the operator why."""


class StoreUnready(StoreFault):
    """The store does not exist yet; the first start of its tracker creates it."""


class StoreReplaced(StoreFault):
    """The store is another one than the one that was opened: a copy was put in its place."""


class Database:
    """One connection in autocommit mode: a statement takes effect at once unless it is part of a
    `transaction`.

    `mark`: its parameter placeholder; `begin`: the statement that opens a
    writing transaction; `errors`: base class of the driver's exceptions; `dialect`: its SQL (see `schema`).
    """

    mark = "?"
    begin = "BEGIN"
    errors: type[Exception] = Exception
    dialect: Dialect = SQLITE

    def __init__(self, connection: Connection, url: str) -> None:
        self.connection = connection
        self.url = url
        self._held: set[tuple[str, str]] = set()

    # -- what differs between databases --------------------------------------------------------------------
    def is_trouble(self, error: Exception) -> bool:
        """Whether an error has an external cause, so that another attempt may succeed."""
        raise NotImplementedError

    def has_tables(self) -> bool:
        """Whether the store's tables exist."""
        raise NotImplementedError

    def take_turn(self, cursor: Cursor) -> None:
        """Within a transaction: wait until no other process creates tables or claims, and keep others out
        until it ends."""

    def try_claim(self, wanted: Sequence[tuple[str, str]]) -> tuple[str, str, str] | None:
        """Claim all (kind, name) pairs, or none if another process holds one of them.

        Returns None, or (kind, name, holder) of a pair that is held.
        """
        raise NotImplementedError

    def claims(self) -> dict[tuple[str, str], str]:
        """Current claims: (kind, name) -> the process that holds it."""
        raise NotImplementedError

    def faults(self) -> list[str]:
        """Damage that the database's own check reports."""
        return []

    def may_write(self) -> bool:
        """Whether this user may write into the store."""
        raise NotImplementedError

    def is_replaced(self) -> bool:
        """Whether the store's place holds another store than the one that was opened."""
        return False

    def size(self) -> int:
        """Size of the store [bytes]."""
        raise NotImplementedError

    def cursor(self) -> Cursor:
        """A cursor, which gives all times as seconds since 1970."""
        return self.connection.cursor()

    # -- what all databases share ----------------------------------------------------------------------------
    def text(self, statement: str) -> str:
        """A statement in this database's SQL; callers write parameters as question marks, times in seconds.

        Where the database keeps timestamps, a parameter that is compared with `time` or `received` becomes
        one, as does a parameter marked as TIME(?).
        """
        return _in_sql(statement, self.mark, self.dialect.time)

    def rows(self, statement: str, parameters: Sequence[SqlValue] = ()) -> list[Row]:
        """The rows that a query returns."""
        with self._translated():
            cursor = self.cursor()
            try:
                cursor.execute(self.text(statement), tuple(parameters))
                return cursor.fetchall()
            finally:
                with suppress(Exception):
                    cursor.close()

    @contextmanager
    def transaction(self) -> Iterator[Cursor]:
        """A cursor whose statements take effect together at the end of the block, or not at all."""
        with self._translated():
            cursor = self.cursor()
            try:
                cursor.execute(self.begin)
                yield cursor
                cursor.execute("COMMIT")
            except BaseException:
                with suppress(Exception):
                    self.connection.rollback()
                raise
            finally:
                with suppress(Exception):
                    cursor.close()

    @contextmanager
    def _translated(self) -> Iterator[None]:
        """Raise StoreFault in place of a driver's exception with an external cause, StoreReplaced in place of
        using a store that is gone."""
        if self.is_replaced():
            raise StoreReplaced(f"{self.url}: {REPLACED}")
        try:
            yield
        except self.errors as error:
            if self.is_trouble(error):
                raise StoreFault(f"{self.url}: {one_line(error)}") from error
            raise

    def prepare(self, read_only: bool = False) -> None:
        """Create the tables where there are none, all or nothing, even if several processes start at once.

        Raises StoreUnready if there are none with `read_only`, StoreFault if they have another schema or
        belong to something else.
        """
        try:
            if not self.has_tables():
                if read_only:
                    raise StoreUnready(f"{self.url}: expected a store, found none; check the name")
                self._create()
            found = int(self.rows("SELECT MAX(version) FROM schema_version")[0][0])
        except (self.errors, TypeError, ValueError) as error:
            raise StoreFault(
                f"{self.url}: the store's tables cannot be read or made ({one_line(error)}); "
                "nothing was changed. Name a separate database"
            ) from error
        refuse_other_schema(self.url, found)

    def _create(self) -> None:
        """Create the tables and views, unless another process was first."""
        with self.transaction() as cursor:
            self.take_turn(cursor)
            if self.has_tables():
                return
            for statement in creation(self.dialect):
                cursor.execute(statement)
            cursor.execute(
                self.text("INSERT INTO schema_version (version, applied) VALUES (?, ?)"),
                (VERSION, time.time()),
            )

    def claim(self, kind: str, names: Iterable[str]) -> None:
        """Claim turbines, sources or channels for this process alone, until the connection is closed or the
        process dies.

        kind: "turbine", "source" or "channel".  Raises StoreFault, naming the holder, if another process has
            claimed one of them.
        """
        wanted = sorted({(kind, name) for name in names} - self._held)
        if not wanted:
            return
        end = time.monotonic() + CLAIM_S
        while (other := self.try_claim(wanted)) is not None:
            if time.monotonic() > end:
                kind, name, who = other
                raise StoreFault(
                    f"{self.url}: the {kind} {name} is already tracked by {who}; "
                    "end that process, or give this one its own turbines, sources and store"
                )
            time.sleep(AGAIN_S)
        self._held.update(wanted)

    def insert_claims(self, cursor: Cursor, wanted: Sequence[tuple[str, str]], holder: int) -> None:
        """Write claims of this process within a transaction."""
        who = f"process {os.getpid()} on {socket.gethostname()}"
        statement = "INSERT INTO claim (kind, name, holder, who, since) VALUES (?, ?, ?, ?, ?)"
        cursor.executemany(self.text(statement), [(*one, holder, who, time.time()) for one in wanted])

    def close(self) -> None:
        with suppress(Exception):
            self.connection.close()


@cache
def _in_sql(statement: str, mark: str, time: str) -> str:
    statement = _COMPARED.sub(r"\1TIME(?)", statement).replace("TIME(?)", time)
    return statement if mark == "?" else statement.replace("%", "%%").replace("?", mark)


def refuse_other_schema(place: object, found: int | None) -> None:
    """Raise StoreFault if the schema's number that a store at `place` states is not this version's."""
    if found != VERSION:
        raise StoreFault(
            f"{place}: expected a store with schema {VERSION}, found schema {found}, which another version "
            "of hygrokf wrote; nothing was changed. Use that version, or name a new store"
        )


def one_line(error: BaseException) -> str:
    """The text of a driver's exception in one line."""
    return " ".join(str(error).split())
