"""The database behind the store: statements, transactions, tables, and the claims of processes.

The modules `sqlite` and `postgres` implement the differences.  An external error (network, disk, permissions)
becomes a `StoreFault` and may be retried; an invalid statement keeps the driver's own exception and must not
be retried.
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
"""[s] for which a claim waits until the previous holder releases it; the end of a process is noticed with a
delay."""
REPLACED = (
    "it was replaced while the tracker ran; the tracker goes on with the store that is there now. Restart "
    "the tracker, so that its sources go on from the places of that store"
)
CLAIM_AGAIN_S = 0.1
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
    """A copy has replaced the store since it was opened."""


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

    # -- differences between databases --------------------------------------------------------------------
    def is_trouble(self, error: Exception) -> bool:
        """Whether an error has an external cause, so that another attempt may succeed."""
        raise NotImplementedError

    def has_tables(self) -> bool:
        """Whether the store's tables exist."""
        raise NotImplementedError

    def take_turn(self) -> None:
        """Within a transaction: wait until no other process creates tables or claims, and exclude other
        processes until the transaction ends."""

    def try_claim(self, wanted: Sequence[tuple[str, str]]) -> tuple[str, str, str] | None:
        """Claim all (kind, name) pairs, or none if another process holds one of them.

        Returns None, or (kind, name, holder) of a pair that is held.
        """
        raise NotImplementedError

    def claims(self) -> dict[tuple[str, str], str]:
        """Current claims: (kind, name) → the process that holds the claim."""
        raise NotImplementedError

    def faults(self) -> list[str]:
        """Damage that the database's own check reports."""
        return []

    def may_write(self) -> bool:
        """Whether this user may write into the store."""
        raise NotImplementedError

    def is_replaced(self) -> bool:
        """Whether another store has replaced the one that was opened."""
        return False

    def size(self) -> int:
        """Size of the store [bytes]."""
        raise NotImplementedError

    def cursor(self) -> Cursor:
        """A cursor that returns all times as seconds since 1970."""
        return self.connection.cursor()

    # -- common to all databases -----------------------------------------------------------------------------
    def _compile(self, statement: ClauseElement) -> SQLCompiler:
        """Compile a statement to this database's SQL; the result is cached as long as the statement
        exists."""
        compiled = self._compiled.get(statement)
        if compiled is None:
            compiler = statement.compile(dialect=self.dialect)
            assert isinstance(compiler, SQLCompiler), "the store changes no tables"
            compiled = self._compiled[statement] = compiler
        return compiled

    @contextmanager
    def _cursor_after(self, statement: ClauseElement, values: Mapping[str, Any]) -> Iterator[Cursor]:
        # expand an IN clause to one parameter per value
        expanded = self._compile(statement).construct_expanded_state(values)
        with self._translate_errors(), closing(self.cursor()) as cursor:
            cursor.execute(expanded.statement, expanded.positional_parameters)
            yield cursor

    def rows(self, statement: ClauseElement, /, **values: Any) -> list[Row]:
        """The rows that a query returns; `values` are the values of its parameters."""
        with self._cursor_after(statement, values) as cursor:
            return cursor.fetchall()

    def first(self, statement: ClauseElement, /, **values: Any) -> Row | None:
        """The first row that a query returns; None if it returns no row."""
        return next(iter(self.rows(statement, **values)), None)

    def execute(self, statement: ClauseElement, /, **values: Any) -> int:
        """Execute a statement; returns the number of changed rows."""
        with self._cursor_after(statement, values) as cursor:
            return max(cursor.rowcount, 0)

    def execute_many(self, statement: ClauseElement, rows: Iterable[Row]) -> None:
        """Execute a statement within a transaction once per row; a row holds the values of the statement's
        parameters in their order."""
        if parameters := list(rows):
            with self._translate_errors(), closing(self.cursor()) as cursor:
                cursor.executemany(self._compile(statement).string, parameters)

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Let all statements of the block take effect together at its end, or not at all."""
        with self._translate_errors():
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
    def _translate_errors(self) -> Iterator[None]:
        """Raise StoreReplaced if another store has replaced this one, and StoreFault instead of a driver's
        exception that has an external cause."""
        if self.is_replaced():
            raise StoreReplaced(f"{self.url}: {REPLACED}")
        try:
            yield
        except self.errors as error:
            if self.is_trouble(error):
                raise StoreFault(f"{self.url}: {one_line(error)}") from error
            raise

    def prepare(self, read_only: bool = False) -> None:
        """Create all tables in one transaction if there are none, even if several processes start at once.

        Raises StoreUnready if there are no tables and `read_only` is set, StoreFault if the tables have
        another schema or belong to another program.
        """
        try:
            if not self.has_tables():
                if read_only:
                    raise StoreUnready(f"{self.url}: expected a store, found none; check the name")
                self._create()
            version = int(self.rows(SCHEMA_NUMBER)[0][0])
        except (self.errors, TypeError, ValueError) as error:
            raise StoreFault(
                f"{self.url}: the store's tables cannot be read or made ({one_line(error)}); "
                "nothing was changed. Name a separate database"
            ) from error
        refuse_other_schema(self.url, version)

    def _create(self) -> None:
        """Create the tables and views, unless another process has created them meanwhile."""
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
            claimed one of the names.
        """
        wanted = sorted({(kind, name) for name in names} - self._held)
        if not wanted:
            return
        end = time.monotonic() + CLAIM_S
        while (conflict := self.try_claim(wanted)) is not None:
            if time.monotonic() > end:
                kind, name, holder = conflict
                raise StoreFault(
                    f"{self.url}: the {kind} {name} is already tracked by {holder}; "
                    "end that process, or give this one its own turbines, sources and store"
                )
            time.sleep(CLAIM_AGAIN_S)
        self._held.update(wanted)

    def insert_claims(self, wanted: Sequence[tuple[str, str]], holder: int) -> None:
        """Write claims of this process within a transaction."""
        who = f"process {os.getpid()} on {socket.gethostname()}"
        self.execute_many(insert(claim), [(*pair, holder, who, time.time()) for pair in wanted])

    def close(self) -> None:
        with suppress(Exception):
            self.connection.close()


def refuse_other_schema(place: object, version: int | None) -> None:
    """Raise StoreFault if the store at `place` has a schema `version` other than `VERSION`."""
    if version != VERSION:
        raise StoreFault(
            f"{place}: expected a store with schema {VERSION}, found schema {version}, which another version "
            "of hygrokf wrote; nothing was changed. Use that version, or name a new store"
        )


def one_line(error: BaseException) -> str:
    """The message of a driver's exception as one line."""
    return " ".join(str(error).split())
