"""The database behind the store: statements, transactions, its tables, and which process tracks what.

The modules `sqlite` and `postgres` implement the differences.  An external error (network, disk, permissions)
becomes a `StoreFault` and may be retried; an invalid statement keeps the driver's own exception and must not
be.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from typing import TYPE_CHECKING, Any, TypeAlias
from weakref import WeakKeyDictionary

from sqlalchemy import ClauseElement, Dialect, insert
from sqlalchemy.sql.compiler import SQLCompiler

from hygrokf.errors import HygrokfError
from hygrokf.live.storage.schema import SQLITE, VERSION, claim, creation, schema_version
from hygrokf.live.storage.statements import SCHEMA_NUMBER

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

    SQLAlchemy compiles the statements, and the driver's own connection executes them: a pool would reconnect
    by itself, which loses the claims.  `begin`: the text that opens a writing transaction; `errors`: base
    class of the driver's exceptions; `dialect`: its SQL (see `schema`).
    """

    begin = "BEGIN"
    errors: type[Exception] = Exception
    dialect: Dialect = SQLITE

    def __init__(self, connection: Connection, url: str) -> None:
        self.connection = connection
        self.url = url
        self._held: set[tuple[str, str]] = set()
        self._compiled: WeakKeyDictionary[ClauseElement, SQLCompiler] = WeakKeyDictionary()

    # -- what differs between databases --------------------------------------------------------------------
    def is_trouble(self, error: Exception) -> bool:
        """Whether an error has an external cause, so that another attempt may succeed."""
        raise NotImplementedError

    def has_tables(self) -> bool:
        """Whether the store's tables exist."""
        raise NotImplementedError

    def take_turn(self) -> None:
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
    def _in_sql(self, statement: ClauseElement) -> SQLCompiler:
        """A statement in this database's SQL, compiled once for as long as it exists."""
        compiled = self._compiled.get(statement)
        if compiled is None:
            compiler = statement.compile(dialect=self.dialect)
            assert isinstance(compiler, SQLCompiler), "the store changes no tables"
            compiled = self._compiled[statement] = compiler
        return compiled

    @contextmanager
    def _executed(self, statement: ClauseElement, values: Mapping[str, Any]) -> Iterator[Cursor]:
        # as many parameters of an IN as it has values
        expanded = self._in_sql(statement).construct_expanded_state(values)
        with self._translated(), closing(self.cursor()) as cursor:
            cursor.execute(expanded.statement, expanded.positional_parameters)
            yield cursor

    def rows(self, statement: ClauseElement, /, **values: Any) -> list[Row]:
        """The rows that a query returns; `values`: of its parameters, by their names."""
        with self._executed(statement, values) as cursor:
            return cursor.fetchall()

    def first(self, statement: ClauseElement, /, **values: Any) -> Row | None:
        """The first row that a query returns; None without any."""
        return next(iter(self.rows(statement, **values)), None)

    def execute(self, statement: ClauseElement, /, **values: Any) -> int:
        """Execute a statement; returns the number of rows that it changes."""
        with self._executed(statement, values) as cursor:
            return max(cursor.rowcount, 0)

    def execute_many(self, statement: ClauseElement, rows: Iterable[Row]) -> None:
        """Execute a statement within a transaction for each of some rows, which hold its parameters in their
        order."""
        if some := list(rows):
            with self._translated(), closing(self.cursor()) as cursor:
                cursor.executemany(self._in_sql(statement).string, some)

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Let all statements of the block take effect together at its end, or not at all."""
        with self._translated():
            try:
                self._execute_text(self.begin)
                yield
                self._execute_text("COMMIT")
            except BaseException:
                with suppress(Exception):
                    self.connection.rollback()
                raise

    def _execute_text(self, text: str) -> None:
        with closing(self.cursor()) as cursor:
            cursor.execute(text)

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
            found = int(self.rows(SCHEMA_NUMBER)[0][0])
        except (self.errors, TypeError, ValueError) as error:
            raise StoreFault(
                f"{self.url}: the store's tables cannot be read or made ({one_line(error)}); "
                "nothing was changed. Name a separate database"
            ) from error
        refuse_other_schema(self.url, found)

    def _create(self) -> None:
        """Create the tables and views, unless another process was first."""
        with self.transaction():
            self.take_turn()
            if self.has_tables():
                return
            for text in creation(self.dialect):
                self._execute_text(text)
            self.execute_many(insert(schema_version), [(VERSION, time.time())])

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

    def insert_claims(self, wanted: Sequence[tuple[str, str]], holder: int) -> None:
        """Write claims of this process within a transaction."""
        who = f"process {os.getpid()} on {socket.gethostname()}"
        self.execute_many(insert(claim), [(*pair, holder, who, time.time()) for pair in wanted])

    def close(self) -> None:
        with suppress(Exception):
            self.connection.close()


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
