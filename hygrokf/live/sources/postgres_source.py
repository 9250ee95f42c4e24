"""A PostgreSQL or TimescaleDB database as a source: a query is repeated for the rows above a watermark.

The watermark is a column that grows as rows come in, such as the time at which they were written.  Rows that
are committed late, below watermarks that were read already, are found by reading an overlap again.
"""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Callable, Generator
from contextlib import closing, suppress
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from decimal import Decimal
from typing import TYPE_CHECKING, Any, TypeAlias

from hygrokf.data.structured import Json
from hygrokf.data.timestamps import duration
from hygrokf.data.toml_form import Place, across, setting
from hygrokf.live.sources.endpoint import PasswordKeys
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.payload_formats import Payload
from hygrokf.live.sources.stream import (
    Delivery,
    SourceFault,
    SourceKeys,
    SourceState,
    Stream,
)
from hygrokf.live.storage.database import Row, StoreFault, one_line
from hygrokf.live.storage.postgres import connect, import_psycopg, url_fault

if TYPE_CHECKING:
    import psycopg

FETCHED = 1_000
"""Rows fetched from the server at once."""
MOST = 20_000
"""Rows read by one query, so that no snapshot of the server stays open for long; rows of one watermark stay
together."""
SESSION = (
    "SET default_transaction_read_only = on",
    "SET statement_timeout = '5min'",
    "SET lock_timeout = '10s'",
    "SET TimeZone = 'UTC'",
)
LOWEST = {
    "timestamptz": "-infinity", "timestamp": "-infinity", "date": "-infinity", "float8": "-infinity",
    "float4": "-infinity", "numeric": "-1e300", "int8": str(-(2**63)), "int4": str(-(2**31)),
    "int2": str(-(2**15)),
}  # fmt: skip
"""Type of a watermark -> text of a value below all others."""
TIMES = ("timestamptz", "timestamp", "date")
EDGES: dict[str, tuple[date, date]] = {
    "timestamptz": (datetime.min.replace(tzinfo=UTC), datetime.max.replace(tzinfo=UTC)),
    "timestamp": (datetime.min, datetime.max),
    "date": (date.min, date.max),
}
"""What stands for times before year 1 and after year 9999, and for infinity."""
REMEMBERED = 200_000
"""Rows remembered as delivered; further ones that are read again are delivered again, and the store knows
them."""
AFTER = "%(after)s"

Watermark: TypeAlias = datetime | date | int | float | Decimal


@dataclass(frozen=True)
class PostgresForm(PasswordKeys, SourceKeys):
    """A [[source]] of `postgresql://USER@HOST/NAME`: a query and how it is repeated.

    `query` contains `AFTER`, and sorts by the column `watermark`; `poll_s` [s] between two queries; `lag_s`
    [s] from a row's watermark to its commit at most; `look_back_s` [s] read at the first start, None for all
    rows; `name` tells several queries of one database apart.
    """

    url: str = setting(help="postgresql://USER@HOST:PORT/NAME")
    query: str = setting(help=f"SELECT … WHERE received > {AFTER} ORDER BY received")
    watermark: str = setting(help="column that grows as rows come in")
    poll_s: float = setting(
        10.0, "between two queries", read=duration, least=0.1, expected='"0.1s" or longer'
    )
    lag_s: float = setting(60.0, "by which a row may be committed late", read=duration)
    look_back_s: float | None = setting(None, "read at the first start; without it all rows", read=duration)
    name: str = setting("", "of this query, where a database has several")

    @across("url")
    def no_secret(self) -> str | None:
        if "#" in self.url:
            return "a # does not belong in the url: give the query a name"
        return url_fault(self.url)

    @across("query")
    def asks_for_new_rows(self) -> str | None:
        if AFTER not in self.query:
            return f"query must ask for new rows: … WHERE received > {AFTER} ORDER BY received"
        if re.search(r"%(?!%|\(after\)s)", self.query.replace("%%", "")):
            return f"query: write a % other than that of {AFTER} as %%"
        return None

    def stream(self, mapping: PayloadMapping, place: Place) -> Stream:
        return PostgresQuery(self, mapping)


@dataclass(frozen=True)
class Columns:
    """The columns of a query, the place of the watermark among them, and its type."""

    names: tuple[str, ...]
    place: int
    kind: str

    def watermark(self, row: Row) -> Watermark:
        """The watermark of a row; infinity for NaN, which sorts above all others.  Raises SourceFault where
        it has none."""
        found: Watermark | None = row[self.place]
        if found is not None and found != found:
            return type(found)("inf")  # type: ignore[call-arg, arg-type]
        if found is None:
            raise SourceFault(
                f"a row has no {self.names[self.place]}, the watermark; select rows that have one"
            )
        return found

    def payload(self, row: Row) -> Payload:
        """The payload of a row: its values by the names of the columns."""
        return {name: _plain(value) for name, value in zip(self.names, row, strict=True)}


class PostgresQuery(Stream):
    """The rows of a query, from a session that may only read; reconnects indefinitely.

    The place is type and text of a watermark below which every row is committed.
    """

    ordered_by = "watermark"
    is_server = True

    def __init__(self, form: PostgresForm, mapping: PayloadMapping) -> None:
        super().__init__(mapping)
        self.form = form
        self.usual_interval_s = form.poll_s
        self.url = f"{form.url}#{form.name}" if form.name else form.url
        self._follow = True
        self._connection: psycopg.Connection[Row] | None = None
        self._after = ""
        """Text of the watermark above which the next poll reads."""
        self._reached: list[tuple[float, Watermark]] = []
        """(monotonic time [s] of a query, highest watermark that it found), the newest last."""
        self._polled = -math.inf
        self._seen: dict[int, Watermark] = {}
        """Rows above `_after` that were delivered, by their hash."""

    def end_when_read(self) -> None:
        """End when all present rows are read."""
        self._follow = False

    def stop(self) -> None:
        self._ended.set()
        connection = self._connection
        if connection is not None:
            with suppress(Exception):
                connection.cancel()
        super().stop()

    # -- connection ------------------------------------------------------------------------------------------
    def open(self) -> psycopg.Connection[Row]:
        """A session that may only read.  Raises SourceFault."""
        try:
            import_psycopg("a PostgreSQL source")
            connection = connect(self.form.url, self.form.password.read())
        except StoreFault as fault:
            raise SourceFault(str(fault)) from None
        for statement in SESSION:
            connection.execute(statement)
        _read_all_times(connection)
        return connection

    def columns(self, connection: psycopg.Connection[Row]) -> Columns:
        """The columns of the query.  Raises SourceFault where the watermark is not one that can be used."""
        cursor = connection.execute(self.form.query, {"after": None})  # no row is above NULL
        if cursor.description is None:
            raise SourceFault("the query gives no rows; write a SELECT")
        names = tuple(one.name for one in cursor.description)
        if self.form.watermark not in names:
            raise SourceFault(
                f"expected the watermark {self.form.watermark!r} among the query's columns, found "
                f"{', '.join(names)}; select it"
            )
        place = names.index(self.form.watermark)
        known = connection.adapters.types.get(cursor.description[place].type_code)
        kind = known.name if known is not None else "an unknown type"
        if kind not in LOWEST:
            raise SourceFault(
                f"expected a watermark that is a time or a number, found {self.form.watermark} of type {kind}"
            )
        return Columns(names, place, kind)

    def first_after(self, columns: Columns, place: str | None) -> str:
        """Text of the watermark above which the source begins or resumes.  Raises SourceFault."""
        if place:
            kind, _, text = place.partition(" ")
            if kind != columns.kind:
                raise SourceFault(
                    f"its watermark was of type {kind}, now it is {columns.kind}; give the source a new name"
                )
            return text
        if self.form.look_back_s is None:
            return LOWEST[columns.kind]
        if columns.kind not in TIMES:
            raise SourceFault(f"look_back needs a watermark that is a time, found type {columns.kind}")
        return datetime.fromtimestamp(time.time() - self.form.look_back_s, UTC).isoformat()

    # -- the source's own thread -----------------------------------------------------------------------------
    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        """Poll until the source is stopped or, where it does not follow, until every present row is read."""
        try:
            self._follow_query(place, put)
        except Exception as fault:  # of the driver, which only this module imports
            raise SourceFault(reason_of(fault)) from fault
        finally:
            connection, self._connection = self._connection, None
            if connection is not None:
                with suppress(Exception):
                    connection.close()

    def _follow_query(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        connection = self._connection = self.open()
        columns = self.columns(connection)
        self._state = SourceState("connected", self.url)
        self._after = self._after or self.first_after(columns, place)
        while not self._ended.is_set():
            is_long = self._poll(connection, columns, put)
            self._state = SourceState("connected", self.url)
            if not self._follow:
                return
            # a long history is read again only once all of it can be settled
            self._ended.wait(max(self.form.poll_s, self.form.lag_s) if is_long else self.form.poll_s)

    def _poll(
        self, connection: psycopg.Connection[Row], columns: Columns, put: Callable[[Delivery], None]
    ) -> bool:
        """Deliver the rows that have come since the last poll, in queries of at most `MOST` rows; returns
        whether there was more than one query.

        A row that is committed after the last poll got its watermark at most `lag_s` before that.  So it is
        above every watermark that was found earlier than `lag_s` before the last poll.
        """
        settled = [mark for at, mark in self._reached if at <= self._polled - self.form.lag_s]
        if settled:
            del self._reached[: len(settled) - 1]
            self._settle(settled[-1])
        self._polled = began = time.monotonic()
        after, count = self._read(connection, columns, self._after, began, put), 1
        while after is not None and not self._ended.is_set():
            after, count = self._read(connection, columns, after, time.monotonic(), put), count + 1
        return count > 1

    def _read(
        self,
        connection: psycopg.Connection[Row],
        columns: Columns,
        after: str,
        began: float,
        put: Callable[[Delivery], None],
    ) -> str | None:
        """Deliver the rows of one query, which began at a monotonic time [s].

        Returns the watermark above which rows remain, None without any.

        The highest watermark itself is never passed: further rows may have the same.
        """
        (now,) = connection.execute("SELECT clock_timestamp()").fetchone() or (None,)
        old = now - timedelta(seconds=self.form.lag_s) if columns.kind == "timestamptz" else None
        ahead = now + timedelta(days=1)
        latest = {"timestamptz": ahead, "timestamp": ahead.replace(tzinfo=None), "date": ahead.date()}
        before: Any = None
        last: Any = None
        with closing(rows_above(connection, self.form.query, after)) as rows:
            for count, row in enumerate(rows):
                mark: Any = columns.watermark(row)
                if columns.kind in latest and mark > latest[columns.kind]:
                    mark = EDGES[columns.kind][1]  # passed, a wrong stamp would hide all rows to come
                if last is not None and mark < last:
                    raise SourceFault(f"the rows are not sorted; add ORDER BY {self.form.watermark}")
                if mark != last:
                    before, last = last, mark
                    if before is not None and old is not None and before <= old:
                        self._after = text_of(before)
                    if count >= MOST and before is not None:
                        break
                if self._ended.is_set():
                    return None
                self._put(columns, row, mark, put)
            else:
                last = None
        if before is None:
            return None
        if old is not None and before <= old:
            self._settle(before)
        if not self._reached or before > self._reached[-1][1]:
            self._reached.append((began, before))
        return None if last is None else text_of(before)

    def _put(self, columns: Columns, row: Row, mark: Watermark, put: Callable[[Delivery], None]) -> None:
        """Deliver a row that is not known to be delivered already."""
        identity = hash(repr(row))
        if identity in self._seen:
            return
        place = f"{columns.kind} {self._after}"
        put(Delivery(columns.payload(row), time.time(), place=place, mark=number_of(mark)))
        if len(self._seen) < REMEMBERED:
            self._seen[identity] = mark

    def _settle(self, mark: Any) -> None:
        """Pass a watermark: every row up to it was delivered, and none will follow."""
        self._after = text_of(mark)
        self._seen = {row: one for row, one in self._seen.items() if one > mark}


def rows_above(connection: psycopg.Connection[Row], text: str, after: str) -> Generator[Row, None, None]:
    """The rows of a query above a watermark, fetched in portions through a cursor on the server."""
    with connection.transaction():
        connection.execute(f"DECLARE hygrokf NO SCROLL CURSOR FOR {text}", {"after": after})
        while rows := connection.execute(f"FETCH FORWARD {FETCHED} FROM hygrokf").fetchall():
            yield from rows


def _read_all_times(connection: psycopg.Connection[Row]) -> None:
    """Let a time that Python does not have cost its own value alone, not all rows that are fetched with it:
    it is read as one of the `EDGES`, a time of day (24:00) and an interval as text."""
    from psycopg import DataError
    from psycopg.types import datetime as loaders

    def passing(kind: type[Any], edges: tuple[date, date] | None) -> type[Any]:
        def load(self: Any, data: Any) -> Any:
            try:
                return kind.load(self, data)
            except DataError:
                text = bytes(data).decode("ascii", "replace")
                return text if edges is None else edges[not text.startswith("-") and "BC" not in text]

        return type(kind.__name__, (kind,), {"load": load})

    for name in (*TIMES, "time", "timetz", "interval"):
        kind = getattr(loaders, f"{name.capitalize()}Loader")
        connection.adapters.register_loader(name, passing(kind, EDGES.get(name)))


def text_of(mark: Watermark) -> str:
    """A watermark as text from which the server makes the same value."""
    return mark.isoformat() if isinstance(mark, date) else str(mark)


def number_of(mark: Watermark) -> float:
    """A watermark as a finite number that grows with it."""
    if isinstance(mark, datetime):
        return mark.replace(tzinfo=mark.tzinfo or UTC).timestamp()
    return min(float(mark.toordinal() if isinstance(mark, date) else mark), sys.float_info.max)


def _plain(value: Any) -> Json:
    """A value of a row as it stands in a payload: times in ISO 8601, exact numbers as floating point."""
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, Decimal):
        return float(value)
    if isinstance(value, timedelta):
        return value.total_seconds()
    if value is None or isinstance(value, bool | int | float | str | list | dict):
        return value
    return str(value)


def reason_of(fault: Exception) -> str:
    """Why a source is lost, in one line: the server's own message where there is one."""
    said = getattr(getattr(fault, "diag", None), "message_primary", None)
    hint = getattr(getattr(fault, "diag", None), "message_hint", None)
    words = one_line(fault) if said is None else f"{said}; {hint}" if hint else str(said)
    return words or type(fault).__name__
