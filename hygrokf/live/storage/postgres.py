"""A store in a PostgreSQL database, through psycopg 3; all of libpq's parameters, files and variables count.

A password never stands in the store's URL, where logs, pages and lists of processes would show it.
"""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Sequence
from typing import Any

from hygrokf.live.storage.database import Database, StoreFault, this_process
from hygrokf.live.storage.schema import POSTGRESQL

SCHEMES = ("postgresql://", "postgres://")
TURN = 0x68796B66
"""Advisory lock that one process holds while it makes tables or claims."""
LOCK_S = 10
"""[s] for which a statement waits for another session's lock."""
DEFAULTS = {
    "connect_timeout": "10", "keepalives_idle": "30", "keepalives_interval": "10", "keepalives_count": "3",
    "tcp_user_timeout": "60000", "fallback_application_name": "hygrokf", "client_encoding": "UTF8",
}  # fmt: skip
"""Parameters of the connection where the URL does not say otherwise: a peer that is gone is noticed within a minute."""
SESSION = (
    f"SET lock_timeout = '{LOCK_S}s'",
    # where this machine is lost, the server ends the session, and with it the claim, within a minute too
    "SET tcp_keepalives_idle = 30",
    "SET tcp_keepalives_interval = 10",
    "SET tcp_keepalives_count = 3",
    # what was acknowledged to a source must be on the server's disk
    "SELECT set_config('synchronous_commit', 'on', false) WHERE current_setting('synchronous_commit') = 'off'",
)
SECRETS = ("password", "sslpassword")
NO_SECRET = (
    "the password does not belong in the store's URL, where it can be read by others: leave it out (and write @ and : in "
    "names as %40 and %3A); libpq takes it from ~/.pgpass, from the file that PGPASSFILE names, or from PGPASSWORD"
)
OUTSIDE = ("08", "25006", "40", "42501", "53", "55", "57", "58", "XX")
"""Beginnings of SQLSTATE codes of what comes from outside: connection, rights, resources, locks, the server itself."""


HOLDERS = (
    "SELECT (classid::bigint << 32) | objid::bigint FROM pg_locks "
    "WHERE locktype = 'advisory' AND objsubid = 1 AND granted AND database = "
    "(SELECT oid FROM pg_database WHERE datname = current_database())"
)
"""Keys of claims whose sessions live."""


class PostgresDatabase(Database):
    """A session of a PostgreSQL server."""

    mark = "%s"
    words = POSTGRESQL

    def __init__(self, connection: object, url: str) -> None:
        import psycopg

        super().__init__(connection, url)
        self.errors = psycopg.Error
        self._key: int | None = None

    def is_trouble(self, error: Exception) -> bool:
        import psycopg

        state = getattr(error, "sqlstate", None)
        lost = state is None and (self.connection.closed or isinstance(error, psycopg.OperationalError))
        return lost or (state is not None and state.startswith(OUTSIDE))

    def has_tables(self) -> bool:
        # to_regclass would not see, within a transaction, what another session has made since it began
        return bool(
            self.rows(
                "SELECT 1 FROM pg_class c JOIN pg_namespace n ON n.oid = c.relnamespace "
                "WHERE c.relname = 'schema_version' AND n.nspname = ANY (current_schemas(false))"
            )
        )

    def take_turn(self, cursor: Any) -> None:
        cursor.execute(f"SELECT pg_advisory_xact_lock({TURN})")

    def taken(self, wanted: Sequence[tuple[str, str]]) -> tuple[str, str, str] | None:
        """The session holds one advisory lock, whose key stands beside all that it claims: the claims die with it.

        A lock for each name would fill the server's table of locks with a fleet.
        """
        with self.transaction() as cursor:
            self.take_turn(cursor)
            if self._key is None:
                key = secrets.randbits(63)
                cursor.execute("SELECT pg_advisory_lock(%s)", (key,))
                self._key = key
            cursor.execute(f"DELETE FROM claim WHERE holder NOT IN ({HOLDERS})")
            cursor.execute("SELECT kind, name, who FROM claim WHERE holder <> %s", (self._key,))
            others = {(kind, name): who for kind, name, who in cursor.fetchall()}
            for kind, name in wanted:
                if (kind, name) in others:
                    return kind, name, others[kind, name]
            rows = [(kind, name, self._key, this_process(), time.time()) for kind, name in wanted]
            cursor.executemany(
                "INSERT INTO claim (kind, name, holder, who, since) VALUES (%s, %s, %s, %s, %s)", rows
            )
        return None

    def claims(self) -> dict[tuple[str, str], str]:
        found = self.rows(f"SELECT kind, name, who FROM claim WHERE holder IN ({HOLDERS})")
        return {(kind, name): who for kind, name, who in found}

    def may_write(self) -> bool:
        return bool(self.rows("SELECT has_table_privilege('observation', 'INSERT')")[0][0])

    def size(self) -> int:
        return int(self.rows("SELECT pg_database_size(current_database())")[0][0])


def url_fault(url: str) -> str | None:
    """What is wrong with a store's URL as it is written: a secret in it.  The secret is not in the message."""
    rest = url.partition("://")[2]
    keys = {part.partition("=")[0] for part in rest.partition("?")[2].split("&")}
    return NO_SECRET if ":" in rest.rpartition("@")[0] or keys & set(SECRETS) else None


def open_postgres(url: str, read_only: bool = False) -> PostgresDatabase:
    """The store at `postgresql://USER@HOST:PORT/NAME?PARAMETER=VALUE`, in the schema that the session's search path names.

    Raises StoreFault where it is not reached, or cannot be a store.
    """
    if (fault := url_fault(url)) is not None:
        raise StoreFault(fault)
    try:
        import psycopg
        from psycopg.conninfo import conninfo_to_dict
    except ImportError:
        raise StoreFault("a PostgreSQL store needs psycopg: pip install 'hygrokf[postgres]'") from None
    try:
        said = conninfo_to_dict(url)
    except psycopg.Error as error:
        raise StoreFault(f"the store's URL cannot be read: {' '.join(str(error).split())}") from None
    if set(SECRETS) & set(said):
        raise StoreFault(NO_SECRET)
    settings: dict[str, Any] = {**DEFAULTS, **said}
    if "PGCONNECT_TIMEOUT" in os.environ and "connect_timeout" not in said:
        del settings["connect_timeout"]
    try:
        connection = psycopg.connect(**settings, autocommit=True)
    except psycopg.Error as error:
        raise StoreFault(
            f"{url}: not reached ({' '.join(str(error).split())}); check that the server runs, its host and port, the "
            "database, the user, and the password in ~/.pgpass or PGPASSWORD"
        ) from None
    database = PostgresDatabase(connection, url)
    try:
        for statement in SESSION:
            connection.execute(statement)
        if read_only:
            connection.execute("SET default_transaction_read_only = on")
        encoding = connection.info.parameter_status("server_encoding")
        if encoding != "UTF8":
            raise StoreFault(
                f"{url}: expected a database in UTF8, found {encoding}: make one by "
                "CREATE DATABASE … ENCODING 'UTF8' TEMPLATE template0"
            )
        database.migrate(read_only)
    except psycopg.Error as error:
        database.close()
        raise StoreFault(f"{url}: {' '.join(str(error).split())}") from error
    except BaseException:
        database.close()
        raise
    return database
