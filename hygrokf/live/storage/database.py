"""The database behind the store: statements, transactions, migrations, and who tracks what.

`sqlite` and `postgres` say what is different in each.  Trouble from outside (network, disk, rights) becomes a `StoreFault`,
which is worth another attempt; a wrong statement stays the driver's own error, which is not.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from hygrokf.errors import HygrokfError
from hygrokf.live.storage.schema import VERSION, migration

CLAIM_S = 3.0
"""[s] for which a claim waits for the one before to go: the end of a process is noticed a little later."""
AGAIN_S = 0.1


class StoreFault(HygrokfError):
    """A store that cannot be used, in words for the one who runs it."""


class StoreUnready(StoreFault):
    """A store that the next start of its tracker makes or brings to this version; `version` is what it has, 0 for none."""

    def __init__(self, words: str, version: int = 0) -> None:
        super().__init__(words)
        self.version = version


class Database:
    """One connection, in which a statement takes effect at once unless it stands in a `transaction`.

    `connection` speaks the database interface of Python (PEP 249).  `mark` is its sign for a parameter, `begin` opens a
    transaction that writes, `errors` are its driver's, `words` what its SQL says differently (see `schema`).
    """

    mark = "?"
    begin = "BEGIN"
    errors: type[Exception] = Exception
    words: dict[str, str]

    def __init__(self, connection: Any, url: str) -> None:
        self.connection = connection
        self.url = url
        self._held: set[tuple[str, str]] = set()

    # -- what each database does its own way ------------------------------------------------------------------
    def is_trouble(self, error: Exception) -> bool:
        """Whether an error comes from outside, and another attempt may succeed."""
        raise NotImplementedError

    def has_tables(self) -> bool:
        """Whether there is a store at all."""
        raise NotImplementedError

    def take_turn(self, cursor: Any) -> None:
        """Within a transaction: wait until no other process makes tables or claims, and keep it so until the end."""

    def taken(self, wanted: Sequence[tuple[str, str]]) -> tuple[str, str, str] | None:
        """Claim all of (kind, name), or none: then (kind, name, who) of one that another process holds."""
        raise NotImplementedError

    def claims(self) -> dict[tuple[str, str], str]:
        """What is tracked now: (kind, name) -> the process that claims it."""
        raise NotImplementedError

    def faults(self) -> list[str]:
        """What is damaged, as far as the database can tell by itself."""
        return []

    def may_write(self) -> bool:
        """Whether this user may write into the store."""
        raise NotImplementedError

    def size(self) -> int:
        """[bytes] that it takes."""
        raise NotImplementedError

    # -- what all do the same way -----------------------------------------------------------------------------
    def text(self, statement: str) -> str:
        """A statement with the parameters' signs of this database; in every one they are written as question marks."""
        return statement if self.mark == "?" else statement.replace("%", "%%").replace("?", self.mark)

    def rows(self, statement: str, parameters: Sequence = ()) -> list[tuple]:
        """Rows of a query."""
        with self._told():
            cursor = self.connection.cursor()
            try:
                cursor.execute(self.text(statement), tuple(parameters))
                return cursor.fetchall()
            finally:
                with suppress(Exception):
                    cursor.close()

    @contextmanager
    def transaction(self) -> Iterator:
        """A cursor whose statements take effect together, when the block ends, or not at all."""
        with self._told():
            cursor = self.connection.cursor()
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
    def _told(self) -> Iterator[None]:
        try:
            yield
        except self.errors as error:
            if self.is_trouble(error):
                raise StoreFault(f"{self.url}: {' '.join(str(error).split())}") from error
            raise

    def version(self) -> int:
        """The schema's version; 0 where there are no tables."""
        if not self.has_tables():
            return 0
        return int(self.rows("SELECT MAX(version) FROM schema_version")[0][0] or 0)

    def migrate(self, read_only: bool = False) -> None:
        """Bring the tables to this version, all or nothing, also where several processes start at once.

        With `read_only` they must be of this version.  Raises StoreFault where they are newer, or of something else.
        """
        try:
            found = self.version()
            if found < VERSION and not read_only:
                with self.transaction() as cursor:
                    self.take_turn(cursor)
                    found = self.version()
                    for version in range(found, VERSION):
                        for statement in migration(version + 1, self.words):
                            cursor.execute(statement)
                        cursor.execute(
                            self.text("INSERT INTO schema_version (version, applied) VALUES (?, ?)"),
                            (version + 1, time.time()),
                        )
                found = max(found, VERSION)
        except (self.errors, TypeError, ValueError) as error:
            raise StoreFault(
                f"{self.url}: the store's tables cannot be read or made ({' '.join(str(error).split())}); "
                "nothing was changed. Name a database of its own"
            ) from error
        if found > VERSION:
            raise StoreFault(
                f"{self.url}: expected a schema of version {VERSION} or older, found {found}: "
                "it was written by a newer hygrokf; update this one"
            )
        if found < VERSION:
            raise StoreUnready(
                f"{self.url}: expected a store of version {VERSION}, found "
                f"{f'version {found}; start its tracker once' if found else 'none; check the name'}",
                found,
            )

    def claim(self, kind: str, names: Iterable[str]) -> None:
        """Be the only tracker of what is named, a "turbine" or a "source", until this connection ends or this process dies.

        Raises StoreFault, which names the process that holds one of them.
        """
        wanted = sorted({(kind, name) for name in names} - self._held)
        if not wanted:
            return
        end = time.monotonic() + CLAIM_S
        while (other := self.taken(wanted)) is not None:
            if time.monotonic() > end:
                kind, name, who = other
                raise StoreFault(
                    f"{self.url}: the {kind} {name} is tracked already, by {who}; "
                    "end that one, or give this one turbines, sources and a store of its own"
                )
            time.sleep(AGAIN_S)
        self._held.update(wanted)

    def close(self) -> None:
        with suppress(Exception):
            self.connection.close()


def this_process() -> str:
    """Who claims something, for the one who is refused it."""
    return f"process {os.getpid()} on {socket.gethostname()}"
