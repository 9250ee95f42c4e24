"""A PostgreSQL or TimescaleDB database as a source: a query is repeated for the rows above a watermark.

The watermark is a column that grows as rows are added, such as the time at which they were written.  A row
may be committed late, below a watermark that was read already; so each query reads an overlap again.  A
watermark is settled when all rows up to it are delivered and no further one can follow.
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

ROWS_PER_FETCH = 1_000
"""Number of rows fetched from the server at once."""
ROWS_PER_QUERY = 20_000
"""Number of rows after which a query ends, so that no snapshot of the server stays open for long; rows with
the same watermark stay together."""
SOURCE_SESSION = (
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
"""Type of a time -> the earliest and the latest value, which replace times before year 1 and after year 9999,
and the infinities."""
REMEMBERED_ROWS = 200_000
"""Largest number of rows remembered as delivered; other rows that are read again are delivered again, and the
store recognises them."""
AFTER_PARAMETER = "%(after)s"

Watermark: TypeAlias = datetime | date | int | float | Decimal


@dataclass(frozen=True)
class PostgresForm(PasswordKeys, SourceKeys):
    """A [[source]] of `postgresql://USER@HOST/NAME`: a query and how it is repeated.

    `query` contains `AFTER_PARAMETER` and sorts by the column `watermark`; `poll_s`: time [s] between two
    queries; `lag_s`: longest time [s] from a row's watermark to its commit; `look_back_s`: time [s] before
    the first start from which rows are read, None for all rows; `name`: distinguishes several queries of a
    database.
    """

    url: str = setting(help="postgresql://USER@HOST:PORT/NAME")
    query: str = setting(help=f"SELECT … WHERE received > {AFTER_PARAMETER} ORDER BY received")
    watermark: str = setting(help="column whose values grow as rows are added")
    poll_s: float = setting(
        10.0, "interval between two queries", read=duration, least=0.1, expected='"0.1s" or longer'
    )
    lag_s: float = setting(60.0, "largest delay from a row's watermark to its commit", read=duration)
    look_back_s: float | None = setting(
        None, "time before the first start from which rows are read; by default all rows", read=duration
    )
    name: str = setting("", "name of this query, needed for several queries of one database")

    @across("url")
    def no_secret(self) -> str | None:
        if "#" in self.url:
            return "a # does not belong in the url: state name to distinguish queries"
        return url_fault(self.url)

    @across("query")
    def asks_for_new_rows(self) -> str | None:
        if AFTER_PARAMETER not in self.query:
            return f"query must ask for new rows: … WHERE received > {AFTER_PARAMETER} ORDER BY received"
        if re.search(r"%(?!%|\(after\)s)", self.query.replace("%%", "")):
            return f"query: write every % except that of {AFTER_PARAMETER} as %%"
        return None

    def stream(self, mapping: PayloadMapping, place: Place) -> Stream:
        """Return the stream; the connection is opened later, so that no fault is reported at `place`."""
        return PostgresQuery(self, mapping)


@dataclass(frozen=True)
class Columns:
    """The columns of a query: their names, and index and type of the watermark's column."""

    names: tuple[str, ...]
    watermark_index: int
    kind: str

    def watermark(self, row: Row) -> Watermark:
        """Return the watermark of a row; infinity for NaN, which the server sorts above all numbers.

        Raises SourceFault for a row without a watermark.
        """
        watermark: Watermark | None = row[self.watermark_index]
        if watermark is None:
            raise SourceFault(
                f"a row has no {self.names[self.watermark_index]}, the watermark; select only rows with one"
            )
        if isinstance(watermark, float | Decimal) and math.isnan(watermark):
            return type(watermark)("inf")
        return watermark

    def payload(self, row: Row) -> Payload:
        """Return the payload of a row: name of the column -> value."""
        return {name: _plain(value) for name, value in zip(self.names, row, strict=True)}


class PostgresQuery(Stream):
    """The rows of a query, from a read-only session; reconnects indefinitely.

    The place that the store keeps is the type and the text of the settled watermark.
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
        """Text of the settled watermark, above which the next poll reads."""
        self._highest_read: list[tuple[float, Watermark]] = []
        """(monotonic time [s] of a query, highest completely read watermark), the newest last."""
        self._polled_s = -math.inf
        """Monotonic time [s] of the last poll."""
        self._delivered: dict[int, Watermark] = {}
        """Hash of each delivered row above `_after` -> its watermark."""

    def end_when_read(self) -> None:
        """End when all rows that exist now are read."""
        self._follow = False

    def stop(self) -> None:
        """Stop, and cancel a query that is running."""
        self._ended.set()
        connection = self._connection
        if connection is not None:
            with suppress(Exception):
                connection.cancel()
        super().stop()

    # -- connection ------------------------------------------------------------------------------------------
    def open(self) -> psycopg.Connection[Row]:
        """Open a read-only session.  Raises SourceFault."""
        try:
            import_psycopg("a PostgreSQL source")
            connection = connect(self.form.url, self.form.password.read())
        except StoreFault as fault:
            raise SourceFault(str(fault)) from None
        for statement in SOURCE_SESSION:
            connection.execute(statement)
        _read_all_times(connection)
        return connection

    def columns(self, connection: psycopg.Connection[Row]) -> Columns:
        """Return the columns of the query.  Raises SourceFault if the watermark is missing or unusable."""
        cursor = connection.execute(self.form.query, {"after": None})  # gives no rows: none is above NULL
        if cursor.description is None:
            raise SourceFault("the query returns no rows; write a SELECT")
        names = tuple(column.name for column in cursor.description)
        if self.form.watermark not in names:
            raise SourceFault(
                f"expected the watermark {self.form.watermark!r} among the query's columns, found "
                f"{', '.join(names)}; select it"
            )
        index = names.index(self.form.watermark)
        type_info = connection.adapters.types.get(cursor.description[index].type_code)
        kind = "an unknown type" if type_info is None else type_info.name
        if kind not in LOWEST:
            raise SourceFault(
                f"expected a watermark that is a time or a number, found {self.form.watermark} of type {kind}"
            )
        return Columns(names, index, kind)

    def first_after(self, columns: Columns, place: str | None) -> str:
        """Return the text of the watermark above which the source begins or resumes.  Raises SourceFault."""
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
        """Poll until the source is stopped or, after `end_when_read`, until all existing rows are read."""
        try:
            self._follow_query(place, put)
        except Exception as fault:  # the driver's exceptions are imported only in this module
            raise SourceFault(postgres_reason(fault)) from fault
        finally:
            connection, self._connection = self._connection, None
            if connection is not None:
                with suppress(Exception):
                    connection.close()

    def _follow_query(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        """Connect and poll until the source is stopped or, after `end_when_read`, once."""
        connection = self._connection = self.open()
        columns = self.columns(connection)
        self._state = SourceState("connected", self.url)
        self._after = self._after or self.first_after(columns, place)
        while not self._ended.is_set():
            is_long = self._poll(connection, columns, put)
            self._state = SourceState("connected", self.url)
            if not self._follow:
                return
            # a long history is not read again before all its watermarks can be settled
            self._ended.wait(max(self.form.poll_s, self.form.lag_s) if is_long else self.form.poll_s)

    def _poll(
        self, connection: psycopg.Connection[Row], columns: Columns, put: Callable[[Delivery], None]
    ) -> bool:
        """Deliver the rows added since the last poll, in queries of about `ROWS_PER_QUERY` rows; returns
        whether there was more than one query.

        A row that was committed after the last poll received its watermark at most `lag_s` before that poll.
        Its watermark is therefore above every watermark that was read `lag_s` or more before the last poll.
        """
        settled_by_s = self._polled_s - self.form.lag_s
        settled = [mark for read_s, mark in self._highest_read if read_s <= settled_by_s]
        if settled:
            del self._highest_read[: len(settled) - 1]
            self._settle(settled[-1])
        self._polled_s = began = time.monotonic()
        after, query_count = self._read(connection, columns, self._after, began, put), 1
        while after is not None and not self._ended.is_set():
            after = self._read(connection, columns, after, time.monotonic(), put)
            query_count += 1
        return query_count > 1

    def _read(
        self,
        connection: psycopg.Connection[Row],
        columns: Columns,
        after: str,
        began: float,
        put: Callable[[Delivery], None],
    ) -> str | None:
        """Deliver the rows above the watermark `after`, by one query that began at the monotonic time `began`
        [s].

        Returns the text of the watermark above which rows remain, None if no row remains.  The highest
        watermark is never settled, because further rows may have the same watermark.
        """
        (now,) = connection.execute("SELECT clock_timestamp()").fetchone() or (None,)
        settled_until = now - timedelta(seconds=self.form.lag_s) if columns.kind == "timestamptz" else None
        tomorrow = now + timedelta(days=1)
        latest_by_kind = {
            "timestamptz": tomorrow, "timestamp": tomorrow.replace(tzinfo=None), "date": tomorrow.date(),
        }  # fmt: skip
        complete_mark: Any = None  # highest watermark whose rows are all read
        last_mark: Any = None  # watermark of the last row
        with closing(rows_above(connection, self.form.query, after)) as rows:
            for row_number, row in enumerate(rows):
                mark: Any = columns.watermark(row)
                if columns.kind in latest_by_kind and mark > latest_by_kind[columns.kind]:
                    # if a wrong time in the future were settled, it would hide all later rows
                    mark = EDGES[columns.kind][1]
                if last_mark is not None and mark < last_mark:
                    raise SourceFault(f"the rows are not sorted; add ORDER BY {self.form.watermark}")
                if mark != last_mark:
                    complete_mark, last_mark = last_mark, mark
                    if (
                        complete_mark is not None
                        and settled_until is not None
                        and complete_mark <= settled_until
                    ):
                        self._after = watermark_text(complete_mark)
                    if row_number >= ROWS_PER_QUERY and complete_mark is not None:
                        break
                if self._ended.is_set():
                    return None
                self._put(columns, row, mark, put)
            else:  # no row remains
                last_mark = None
        if complete_mark is None:
            return None
        if settled_until is not None and complete_mark <= settled_until:
            self._settle(complete_mark)
        if not self._highest_read or complete_mark > self._highest_read[-1][1]:
            self._highest_read.append((began, complete_mark))
        return None if last_mark is None else watermark_text(complete_mark)

    def _put(self, columns: Columns, row: Row, mark: Watermark, put: Callable[[Delivery], None]) -> None:
        """Deliver a row unless it is remembered as delivered."""
        identity = hash(repr(row))
        if identity in self._delivered:
            return
        place = f"{columns.kind} {self._after}"
        put(Delivery(columns.payload(row), time.time(), place=place, mark=number_of(mark)))
        if len(self._delivered) < REMEMBERED_ROWS:
            self._delivered[identity] = mark

    def _settle(self, mark: Any) -> None:
        """Settle a watermark: all rows up to it are delivered, and no further one will be committed."""
        self._after = watermark_text(mark)
        self._delivered = {row: watermark for row, watermark in self._delivered.items() if watermark > mark}


def rows_above(connection: psycopg.Connection[Row], text: str, after: str) -> Generator[Row, None, None]:
    """Yield the rows of the query `text` above the watermark `after`, fetched by a server-side cursor."""
    with connection.transaction():
        connection.execute(f"DECLARE hygrokf NO SCROLL CURSOR FOR {text}", {"after": after})
        while rows := connection.execute(f"FETCH FORWARD {ROWS_PER_FETCH} FROM hygrokf").fetchall():
            yield from rows


def _read_all_times(connection: psycopg.Connection[Row]) -> None:
    """Let the driver read times that Python cannot represent, which would otherwise make a whole fetch fail.

    Such a date or time stamp becomes one of the `EDGES`, a time of day (24:00) or an interval becomes text.
    """
    from psycopg import DataError
    from psycopg.types import datetime as loaders

    def tolerant(kind: type[Any], edges: tuple[date, date] | None) -> type[Any]:
        """Return a loader like `kind` that replaces a time beyond Python's range by the nearer of `edges`, or
        by its text without edges."""

        def load(self: Any, data: Any) -> Any:
            try:
                return kind.load(self, data)
            except DataError:
                text = bytes(data).decode("ascii", "replace")
                if edges is None:
                    return text
                earliest, latest = edges
                # "-infinity", or a year before Christ
                return earliest if text.startswith("-") or "BC" in text else latest

        return type(kind.__name__, (kind,), {"load": load})

    for name in (*TIMES, "time", "timetz", "interval"):
        kind = getattr(loaders, f"{name.capitalize()}Loader")
        connection.adapters.register_loader(name, tolerant(kind, EDGES.get(name)))


def watermark_text(mark: Watermark) -> str:
    """Return a watermark as text that the server reads as the same value."""
    return mark.isoformat() if isinstance(mark, date) else str(mark)


def number_of(mark: Watermark) -> float:
    """Return a watermark as a finite number; a higher watermark never has a smaller number."""
    if isinstance(mark, datetime):
        return mark.replace(tzinfo=mark.tzinfo or UTC).timestamp()
    return min(float(mark.toordinal() if isinstance(mark, date) else mark), sys.float_info.max)


def _plain(value: Any) -> Json:
    """Convert a value of a row for a payload: times to ISO 8601, exact numbers to floating point."""
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, Decimal):
        return float(value)
    if isinstance(value, timedelta):
        return value.total_seconds()
    if value is None or isinstance(value, bool | int | float | str | list | dict):
        return value
    return str(value)


def postgres_reason(fault: Exception) -> str:
    """Return why a source was lost, in one line: the server's own message and hint, if it sent any."""
    message = getattr(getattr(fault, "diag", None), "message_primary", None)
    hint = getattr(getattr(fault, "diag", None), "message_hint", None)
    if message is None:
        return one_line(fault) or type(fault).__name__
    return (f"{message}; {hint}" if hint else str(message)) or type(fault).__name__
