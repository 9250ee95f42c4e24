"""A store in a PostgreSQL database, accessed with psycopg 3; libpq's parameters, files and variables apply.

The store's URL must not contain a password, because logs, pages and process lists would show it.
"""

from __future__ import annotations

import os
import secrets
import shlex
import struct
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import BIGINT, any_, cast, column, delete, func, select, table

from hygrokf.live.storage.database import Cursor, Database, Row, StoreFault, one_line
from hygrokf.live.storage.schema import POSTGRESQL, claim, schema_version
from hygrokf.live.storage.statements import CLAIMS

if TYPE_CHECKING:
    import psycopg

SCHEMES = ("postgresql://", "postgres://")
CREATION_KEY = 0x68796B66
"""Key of the advisory lock that a process holds while it creates tables or claims."""
LOCK_S = 10
"""[s] for which a statement waits for another session's lock."""
DEFAULTS = {
    "connect_timeout": "10", "keepalives_idle": "30", "keepalives_interval": "10", "keepalives_count": "3",
    "tcp_user_timeout": "60000", "fallback_application_name": "hygrokf", "client_encoding": "UTF8",
}  # fmt: skip
"""Default connection parameters, which the URL may override; a lost server is detected within a minute."""
# SQLAlchemy has no expression for SET
STORE_SESSION = (
    f"SET lock_timeout = '{LOCK_S}s'",
    # the server ends the session of a lost client, and with it the claim, within a minute
    "SET tcp_keepalives_idle = 30",
    "SET tcp_keepalives_interval = 10",
    "SET tcp_keepalives_count = 3",
    # a commit that is acknowledged to a source must be on the server's disk
    "SELECT set_config('synchronous_commit', 'on', false) WHERE current_setting('synchronous_commit') = "
    "'off'",
)
EPOCH_US = 946_684_800_000_000
"""Beginning of 2000, the zero of the server's timestamps [µs since 1970]."""
_MICROSECONDS = struct.Struct("!q")
SECRET_PARAMETERS = ("password", "sslpassword")
NO_SECRET = (
    "the password does not belong in the URL, where it can be read by others: leave it out (and "
    "write @ and : in names as %40 and %3A); libpq takes it from ~/.pgpass, from the file that PGPASSFILE "
    "names, or from PGPASSWORD"
)
EXTERNAL_CODES = ("08", "25006", "40", "42501", "53", "55", "57", "58", "XX")
"""Prefixes of SQLSTATE codes with an external cause: connection, permissions, resources, locks, the server
itself."""


_LOCK = table("pg_locks", *map(column, ("locktype", "classid", "objid", "objsubid", "granted", "database")))
_DATABASE = table("pg_database", column("oid"), column("datname"))
_THIS_DATABASE = (
    select(_DATABASE.c.oid).where(_DATABASE.c.datname == func.current_database()).scalar_subquery()
)
_CLASS = table("pg_class", column("relname"), column("relnamespace"))
_NAMESPACE = table("pg_namespace", column("oid"), column("nspname"))
HOLDERS = select(
    cast(_LOCK.c.classid, BIGINT).bitwise_lshift(32).bitwise_or(cast(_LOCK.c.objid, BIGINT))
).where(
    _LOCK.c.locktype == "advisory", _LOCK.c.objsubid == 1, _LOCK.c.granted, _LOCK.c.database == _THIS_DATABASE
)  # fmt: skip
"""Query for the keys of claims whose sessions are alive."""
# within a transaction to_regclass would miss tables that another session has created since the transaction
# began
POSTGRES_STORE_TABLES = (
    select(_CLASS.c.relname)
    .join(_NAMESPACE, _NAMESPACE.c.oid == _CLASS.c.relnamespace)
    .where(_CLASS.c.relname == schema_version.name)
    .where(_NAMESPACE.c.nspname == any_(func.current_schemas(False)))
)


class PostgresDatabase(Database):
    """A session on a PostgreSQL server."""

    dialect = POSTGRESQL
    connection: psycopg.Connection[Row]

    def __init__(self, connection: psycopg.Connection[Row], url: str) -> None:
        import psycopg

        super().__init__(connection, url)
        self.errors = psycopg.Error
        self._key: int | None = None

    def cursor(self) -> Cursor:
        return self.connection.cursor(binary=True)  # the loader of timestamps reads the binary format

    def is_trouble(self, error: Exception) -> bool:
        import psycopg

        state = getattr(error, "sqlstate", None)
        is_lost = state is None and (self.connection.closed or isinstance(error, psycopg.OperationalError))
        return is_lost or (state is not None and state.startswith(EXTERNAL_CODES))

    def has_tables(self) -> bool:
        return bool(self.rows(POSTGRES_STORE_TABLES))

    def take_turn(self) -> None:
        self.rows(select(func.pg_advisory_xact_lock(CREATION_KEY)))

    def try_claim(self, wanted: Sequence[tuple[str, str]]) -> tuple[str, str, str] | None:
        """The session holds one advisory lock, and each claim stores the key of that lock, so that the claims
        end with the session.

        One lock per name would let a large fleet fill the server's lock table.
        """
        with self.transaction():
            self.take_turn()
            if self._key is None:
                key = secrets.randbits(63)
                self.rows(select(func.pg_advisory_lock(key)))
                self._key = key
            self.execute(delete(claim).where(claim.c.holder.not_in(HOLDERS)))
            rows = self.rows(CLAIMS.where(claim.c.holder != self._key))
            holders = {(kind, name): who for kind, name, who in rows}
            for kind, name in wanted:
                if (kind, name) in holders:
                    return kind, name, holders[kind, name]
            self.insert_claims(wanted, self._key)
        return None

    def claims(self) -> dict[tuple[str, str], str]:
        return {(kind, name): who for kind, name, who in self.rows(CLAIMS.where(claim.c.holder.in_(HOLDERS)))}

    def may_write(self) -> bool:
        return bool(self.rows(select(func.has_table_privilege("observation", "INSERT")))[0][0])

    def size(self) -> int:
        return int(self.rows(select(func.pg_database_size(func.current_database())))[0][0])


def _load_times_as_seconds(connection: psycopg.Connection[Row]) -> None:
    """Make the cursors of a connection return timestamps as seconds since 1970.

    A timestamp is a whole number of microseconds, which is divided by 10⁶ in double precision.
    """
    from psycopg.adapt import Buffer, Loader
    from psycopg.pq import Format

    class SecondsLoader(Loader):
        format = Format.BINARY

        def load(self, data: Buffer) -> float:
            return (_MICROSECONDS.unpack(data)[0] + EPOCH_US) / 1e6

    connection.adapters.register_loader("timestamptz", SecondsLoader)


def url_fault(url: str) -> str | None:
    """The error message if a database's URL contains a secret, which the message does not repeat, else
    None."""
    rest = url.partition("://")[2]
    keys = {part.partition("=")[0] for part in rest.partition("?")[2].split("&")}
    return NO_SECRET if ":" in rest.rpartition("@")[0] or keys & set(SECRET_PARAMETERS) else None


def import_psycopg(wanted_by: str) -> None:
    """Raise StoreFault, naming the extra to install, if psycopg is missing."""
    try:
        import psycopg  # noqa: F401
    except ImportError:
        raise StoreFault(f"{wanted_by} needs psycopg: pip install 'hygrokf[postgres]'") from None


def url_parameters(url: str) -> dict[str, Any]:
    """The connection parameters of libpq in a URL.  Raises StoreFault."""
    if (fault := url_fault(url)) is not None:
        raise StoreFault(fault)
    import_psycopg("a PostgreSQL store")
    import psycopg
    from psycopg.conninfo import conninfo_to_dict

    try:
        return conninfo_to_dict(url)
    except psycopg.Error as error:
        raise StoreFault(f"the database's URL cannot be read: {one_line(error)}") from None


def connect(url: str, password: str | None = None) -> psycopg.Connection[Row]:
    """Open a session in autocommit mode with `password` or, with None, the password that libpq finds.  Raises
    StoreFault."""
    import psycopg

    parameters = url_parameters(url)
    if set(SECRET_PARAMETERS) & set(parameters):
        raise StoreFault(NO_SECRET)
    settings = {**DEFAULTS, **parameters}
    if "PGCONNECT_TIMEOUT" in os.environ and "connect_timeout" not in parameters:
        del settings["connect_timeout"]
    if password is not None:
        settings["password"] = password
    try:
        return psycopg.connect(**settings, autocommit=True)
    except psycopg.Error as error:
        raise StoreFault(
            f"{url}: cannot be reached ({one_line(error)}); check the server, its host and "
            "port, the database, the user, and the password in ~/.pgpass or PGPASSWORD"
        ) from None


def open_postgres(url: str, read_only: bool = False) -> PostgresDatabase:
    """Open the store at `postgresql://USER@HOST:PORT/NAME?PARAMETER=VALUE`, in the schema of the session's
    search path.

    Raises StoreFault if the database cannot be reached or used as a store.
    """
    import_psycopg("a PostgreSQL store")
    import psycopg

    connection = connect(url)
    database = PostgresDatabase(connection, url)
    _load_times_as_seconds(connection)
    try:
        for statement in STORE_SESSION:
            connection.execute(statement)
        if read_only:
            connection.execute("SET default_transaction_read_only = on")
        encoding = connection.info.parameter_status("server_encoding")
        if encoding != "UTF8":
            raise StoreFault(
                f"{url}: expected a database in UTF8, found {encoding}: make one by "
                "CREATE DATABASE … ENCODING 'UTF8' TEMPLATE template0"
            )
        database.prepare(read_only)
    except psycopg.Error as error:
        database.close()
        raise StoreFault(f"{url}: {one_line(error)}") from error
    except BaseException:
        database.close()
        raise
    return database


def postgres_commands(copy: Path, url: str) -> list[str]:
    """The shell commands that restore a `pg_dump` into a new database and give it the name of the store's
    database, which is kept under another name.  Raises StoreFault.

    """
    parameters = url_parameters(url)
    from psycopg.conninfo import make_conninfo

    name = str(parameters.get("dbname") or parameters.get("user") or "hygrokf")
    server = {key: str(value) for key, value in parameters.items() if key not in ("dbname", "options")}
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
