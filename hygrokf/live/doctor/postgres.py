"""Checks of a database that is a source: whether it can be reached, what the query gives, and how fast."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from itertools import islice
from typing import TYPE_CHECKING

from hygrokf.data.timestamps import DAY_S, HOUR_S, stamp_text
from hygrokf.live.doctor.check import (
    OLD_S,
    Check,
    doubt,
    fault,
    lasting,
    ok,
    payload_checks,
    server_check,
    stamp_check,
)
from hygrokf.live.sources.payload_statistics import PayloadStatistics
from hygrokf.live.sources.postgres import LOWEST, TIMES, PostgresQuery, reason_of, rows_above
from hygrokf.live.sources.stream import SourceFault
from hygrokf.live.storage.database import Row

if TYPE_CHECKING:
    import psycopg

REACH = "check url, password and query of this [[source]], and that the server runs"
MOST = 20_000
"""Rows examined at most."""
SPANS_S = (600.0, 2.0 * HOUR_S, DAY_S, 30.0 * DAY_S)
"""How far back rows are looked for [s]: the shortest span that has any."""


def postgres_checks(
    source: PostgresQuery, statistics: PayloadStatistics, wait_s: float, lateness_s: float
) -> Iterator[Check]:
    """Connect, run the query for its newest rows, and read them."""
    about = f"source {source.url}"
    try:
        yield from _examine(source, statistics, about)
    except SourceFault as error:
        yield fault(about, str(error), REACH)
    except Exception as error:  # of the driver, which only the source imports
        yield fault(about, f"the query cannot be run: {reason_of(error)}", REACH)


def _examine(source: PostgresQuery, statistics: PayloadStatistics, about: str) -> Iterator[Check]:
    with closing(source.open()) as connection:
        columns = source.columns(connection)
        yield ok(about, f"connected; the query gives {', '.join(columns.names)}")
        before = time.time()
        (shown,) = connection.execute("SELECT clock_timestamp()").fetchone() or (None,)
        if isinstance(shown, datetime):
            yield server_check(about, shown.timestamp() - 0.5 * (before + time.time()))
        rows, span, took_s = _newest_rows(source, columns.kind, connection)
    if not rows:
        yield doubt(about, f"no {span}", "check the query and the program that fills its table")
        return
    now = time.time()
    for row in rows:
        columns.watermark(row)
        statistics.take(columns.payload(row), now)
    yield from payload_checks(about, statistics, span)
    if took_s > source.query.poll_s:
        yield doubt(
            about,
            f"the query took {lasting(took_s)}, longer than poll ({lasting(source.query.poll_s)})",
            f"create an index on {source.query.watermark}, or poll less often",
        )
    if statistics.newest and not statistics.mapping.weather:
        newest = max(statistics.newest.values())
        said = f"its newest reading is from {stamp_text(newest)}, {lasting(max(now - newest, 0.0))} ago"
        old = now - newest > OLD_S and columns.kind in TIMES
        yield doubt(about, said, "check the program that fills its table") if old else ok(about, said)
        ahead = stamp_check(about, statistics.lag_s, fresh=False)
        if ahead is not None and ahead.level != "ok":
            yield ahead


def _newest_rows(
    source: PostgresQuery, kind: str, connection: psycopg.Connection[Row]
) -> tuple[list[Row], str, float]:
    """Rows of the shortest span that has any, the name of the span, and how long the query took [s]."""
    found: list[Row] = []
    said, took_s = "rows", 0.0
    for after, said in _starts(kind):  # noqa: B007
        began = time.monotonic()
        with closing(rows_above(connection, source.query.text, after)) as rows:
            found = list(islice(rows, MOST))
        took_s = time.monotonic() - began
        if found:
            break
    return found, said, took_s


def _starts(kind: str) -> Iterator[tuple[str, str]]:
    """Watermarks above which rows are looked for, each with the name of those rows."""
    if kind in TIMES:
        for span in SPANS_S:
            since = datetime.fromtimestamp(time.time() - span, UTC)
            yield since.isoformat(), f"rows of the last {lasting(span)}"
    else:
        yield LOWEST[kind], "first rows"
