"""The store: observations, estimates, filter states and each source's position, committed together or not at
all.

A `Batch` holds the results of one round of the tracker.  `Store.commit` writes it in one transaction, so that
a crash leaves the store as it was after some complete batch, and each source resumes from its position in
that batch.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple
from typing import Any, TypeVar

import numpy as np

from hygrokf.data.structured import Json, JsonObject
from hygrokf.data.timestamps import DAY_S
from hygrokf.estimation.likelihood import Gaussian
from hygrokf.live.batch import Alarm, Assessment, Batch, Event, Loss, Notice, Observation, Shelf
from hygrokf.live.condition import QUANTITIES, Condition, Quantity
from hygrokf.live.plan import BEFORE
from hygrokf.live.storage.database import Cursor, Database, Row, SqlValue
from hygrokf.live.storage.database import StoreFault as StoreFault
from hygrokf.live.storage.postgres import SCHEMES, open_postgres
from hygrokf.live.storage.schema import TABLES, TIMESTAMPS
from hygrokf.live.storage.sqlite import open_sqlite, path_of
from hygrokf.live.tracker import Point, Reading, Versions, used_value

_SIGNALS = """
WITH RECURSIVE known (signal) AS (
    SELECT MIN(signal) FROM observation WHERE turbine = ?
    UNION ALL
    SELECT (SELECT MIN(o.signal) FROM observation o WHERE o.turbine = ? AND o.signal > known.signal)
    FROM known WHERE known.signal IS NOT NULL)
"""
_READINGS = f"""{_SIGNALS}
SELECT o.signal, o.time, o.value, o.mark, o.contradicted FROM known CROSS JOIN observation o
WHERE o.turbine = ? AND o.signal = known.signal AND o.late = 0 AND o.time >= COALESCE(
    (SELECT b.time FROM observation b WHERE b.turbine = ? AND b.signal = known.signal AND b.time < ?
    AND b.late = 0 ORDER BY b.time DESC LIMIT 1 OFFSET ?),
    (SELECT MIN(m.time) FROM observation m WHERE m.turbine = ? AND m.signal = known.signal))
ORDER BY o.signal, o.time
"""
"""Query of `Store.readings`: one index lookup per signal, however long the history is."""
FORGOTTEN_S = 3 * DAY_S
"""[s] a value of a weather forecast is kept after its time."""
ASKED = 500
"""Stamps asked for in one query."""
UNLESS_THERE = " ON CONFLICT DO NOTHING"
ACKNOWLEDGED = ("acknowledged", "acknowledged_by", "cause", "note", "look_again")
"""Columns of an alarm that the page writes and the tracker leaves as they are."""
TABLE_OF: Mapping[type[Any], str] = {
    Alarm: "alarm", Assessment: "assessment", Event: "event", Loss: "connection", Notice: "outbox",
    Shelf: "shelf",
}  # fmt: skip
"""Kind -> its table in `schema.TABLES`, whose columns are its fields."""
T = TypeVar("T")


class Store:
    """One store, in either database, whose statements, transactions and claims are its own; only one thread
    may use it at a time.

    An external error (disk, network, another process) is raised as StoreFault and may be gone once the store
    is reopened; an invalid statement or value raises the driver's own exception.
    """

    def __init__(self, database: Database) -> None:
        self.database, self.url = database, database.url
        self.rows, self.transaction, self._text = database.rows, database.transaction, database.text
        self.claim, self.close = database.claim, database.close

    def found(self, kind: type[T], rest: str = "", parameters: Sequence[SqlValue] = ()) -> list[T]:
        """What the table of a kind holds (`TABLE_OF`), selected and ordered by the `rest` of the query."""
        table = TABLE_OF[kind]
        rows = self.rows(f"SELECT {', '.join(TABLES[table].columns)} FROM {table} {rest}", parameters)
        return [kind(*row) for row in rows]

    # -- writing ---------------------------------------------------------------------------------------------
    def commit(self, batch: Batch) -> None:
        """Write a batch completely or not at all."""
        with self.transaction() as cursor:
            self.write(cursor, batch)

    def write(self, cursor: Cursor, batch: Batch) -> None:
        """Write a batch within a transaction.  Of a stamp with several values the one that counts is written,
        and every version is kept beside it."""
        first = [(*_reading_row(o), int(o.late), 0, _mark(o)) for o in batch.observations if not o.revision]
        self._many(cursor, inserting("observation") + UNLESS_THERE, first)
        self._write_revisions(cursor, [one for one in batch.observations if one.revision])
        for statement, rows in _statements(batch):
            self._many(cursor, statement, rows)

    def _write_revisions(self, cursor: Cursor, revisions: Sequence[Observation]) -> None:
        """Add versions of values to those of their stamps, and use those that count and come in time."""
        stamps: dict[str, list[tuple[str, float]]] = {}
        for one in revisions:
            stamps.setdefault(one.turbine, []).append((one.reading.signal, one.reading.time))
        known = {turbine: self.versions(turbine, own) for turbine, own in stamps.items()}
        names = ", ".join(name for name in TABLES["revision"].columns if name != "number")
        first = f"INSERT INTO revision ({names}, number) SELECT {names}, 0 FROM observation "
        first += "WHERE turbine = ? AND signal = ? AND time = ? ON CONFLICT DO NOTHING"
        self._many(cursor, first, [_reading_row(one)[:3] for one in revisions])
        added = self._text(inserting("revision") + UNLESS_THERE)
        for one in revisions:
            versions = known[one.turbine][one.reading.signal, one.reading.time]
            cursor.execute(added, (*_reading_row(one), _mark(one), int(one.late), len(versions)))
            versions.append(one.reading)
            if not one.late:
                self.use(cursor, one.turbine, versions)

    def use(self, cursor: Cursor, turbine: str, versions: Sequence[Reading]) -> None:
        """Let the version of a stamp that counts be the observation."""
        value, first = used_value(versions), versions[0]
        statement = self._text(
            "UPDATE observation SET contradicted = ?, (value, received, mark) = (SELECT r.value, r.received, "
            "r.mark FROM revision r WHERE r.turbine = observation.turbine AND r.signal = observation.signal "
            "AND r.time = observation.time AND r.value = ?) WHERE turbine = ? AND signal = ? AND time = ?"
        )
        none = math.isnan(value)
        used = first.value if none else value
        cursor.execute(statement, (int(none), used, turbine, first.signal, first.time))

    def _many(self, cursor: Cursor, statement: str, rows: Iterable[Row]) -> None:
        if some := list(rows):
            cursor.executemany(self._text(statement), some)

    def add_turbines(self, models: Mapping[str, str]) -> None:
        """Register turbines; `models`: turbine → digest of the model that tracks it.

        A turbine whose model has changed starts again from its observations, because its point belongs to the
        old model.
        """
        with self.transaction() as cursor:
            for name, digest in models.items():
                cursor.execute(self._text("SELECT model FROM turbine WHERE name = ?"), (name,))
                known = cursor.fetchone()
                if known and known[0] != digest:
                    for table in ("point", "memory"):
                        cursor.execute(self._text(f"DELETE FROM {table} WHERE turbine = ?"), (name,))
                cursor.execute(
                    self._text(
                        "INSERT INTO turbine (name, model, added) VALUES (?, ?, ?) "
                        "ON CONFLICT (name) DO UPDATE SET model = excluded.model"
                    ),
                    (name, digest, time.time()),
                )

    # -- what people state -----------------------------------------------------------------------------------
    def acknowledge(self, known: Alarm, notices: Iterable[Notice] = ()) -> bool:
        """Write the acknowledgement of an alarm, and its notices.

        Returns False if there is no such alarm or it was acknowledged before.
        """
        columns = ", ".join(f"{name} = ?" for name in ACKNOWLEDGED)
        statement = f"UPDATE alarm SET {columns} WHERE id = ? AND acknowledged IS NULL"
        with self.transaction() as cursor:
            cursor.execute(self._text(statement), [getattr(known, name) for name in (*ACKNOWLEDGED, "id")])
            changed = cursor.rowcount == 1
            if changed:
                self._many(cursor, inserting("outbox") + UNLESS_THERE, map(astuple, notices))
        return changed

    def shelve(self, shelf: Shelf) -> None:
        """Shelve a turbine's alarms of one kind, in place of an earlier shelf of that kind."""
        self._execute(replacing("shelf"), astuple(shelf))

    def unshelve(self, turbine: str, kind: str) -> bool:
        """End a shelf early; False if there is none."""
        return self._execute("DELETE FROM shelf WHERE turbine = ? AND kind = ?", (turbine, kind)) == 1

    def note_event(self, event: Event) -> None:
        """Write an event, in place of one with its id."""
        self._execute(replacing("event"), astuple(event))

    def _execute(self, statement: str, parameters: Sequence[SqlValue]) -> int:
        with self.transaction() as cursor:
            cursor.execute(self._text(statement), tuple(parameters))
            return cursor.rowcount

    # -- reading ---------------------------------------------------------------------------------------------
    def point(self, turbine: str) -> Point | None:
        found = self.rows("SELECT time, state FROM point WHERE turbine = ?", (turbine,))
        return Point(found[0][0], state_of(found[0][1])) if found else None

    def readings(self, turbine: str, since: float) -> list[Reading]:
        """Readings of a turbine that the filter may use: those from `since` [s] on and each signal's last
        `BEFORE` before it.

        The value is NaN where two readings contradict each other.
        """
        found = self.rows(_READINGS, (turbine, turbine, turbine, turbine, since, BEFORE - 1, turbine))
        return [_reading(s, at, math.nan if wrong else value, mark) for s, at, value, mark, wrong in found]

    def versions(self, turbine: str, stamps: Iterable[tuple[str, float]]) -> Versions:
        """The versions of the values of some stamps (signal, time [s]), but for those that are not known."""
        found: Versions = {}
        ordered = sorted(stamps, key=lambda stamp: stamp[1])
        for first in range(0, len(ordered), ASKED):
            part = ordered[first : first + ASKED]
            rows = self.rows(
                "SELECT signal, time, value, mark FROM observation WHERE turbine = ? AND (signal, time) IN "
                f"(VALUES {', '.join(['(?, TIME(?))'] * len(part))})",
                [turbine, *(one for stamp in part for one in stamp)],
            )
            found |= {(one[0], one[1]): [_reading(*one)] for one in rows}
        revised = self.revised(turbine, ordered[0][1]) if found else {}
        return found | {stamp: known for stamp, known in revised.items() if stamp in found}

    def revised(self, turbine: str, since: float = -math.inf) -> Versions:
        """The versions of all stamps from `since` [s] on that had several values."""
        found: Versions = {}
        rows = self.rows(
            "SELECT signal, time, value, mark FROM revision WHERE turbine = ? AND time >= ? "
            "ORDER BY signal, time, number",
            (turbine, since),
        )
        for signal, at, value, mark in rows:
            found.setdefault((signal, at), []).append(_reading(signal, at, value, mark))
        return found

    def losses(self, turbine: str) -> dict[str, list[tuple[float, float]]]:
        """Spans [s] in which the connection of each signal of a turbine was lost, ∞ as an end to come."""
        found: dict[str, list[tuple[float, float]]] = {}
        asked = "SELECT signal, lost, regained FROM connection WHERE turbine = ? ORDER BY signal, lost"
        for signal, lost, regained in self.rows(asked, (turbine,)):
            found.setdefault(signal, []).append((lost, math.inf if regained is None else regained))
        return found

    def held(self, turbine: str, until: float = math.inf) -> list[Observation]:
        """Readings of a turbine that came with stamps ahead of the clock and are from before `until` [s], by
        time."""
        found = self.rows(
            f"SELECT {', '.join(TABLES['held'].columns)} FROM held WHERE time <= ? AND turbine = ? "
            "ORDER BY time, signal, received",
            (until, turbine),
        )
        return [
            Observation(name, _reading(s, at, value, mark), received)
            for name, s, at, value, received, mark in found
        ]

    def held_ahead(self) -> list[tuple[str, str, float]]:
        """(turbine, signal, time [s] from the last arrival to the latest stamp) of readings that are held
        back."""
        found = self.rows(
            "SELECT turbine, signal, MAX(time), MAX(received) FROM held GROUP BY turbine, signal"
        )
        return [(turbine, signal, latest - arrival) for turbine, signal, latest, arrival in found]

    def held_count(self, turbine: str) -> int:
        """Number of readings that are held back for one turbine."""
        return int(self.rows("SELECT COUNT(*) FROM held WHERE turbine = ?", (turbine,))[0][0])

    def newest_estimate(self, turbine: str) -> tuple[float, float | None] | None:
        """Time [s] and probability of condensation [1] of a turbine's newest estimate; None without any."""
        found = self.rows(
            "SELECT time, condensation FROM estimate WHERE turbine = ? ORDER BY time DESC LIMIT 1", (turbine,)
        )
        return found[0] if found else None

    def outlook(self, turbine: str) -> list[tuple[float, float]]:
        """Times [s] and probabilities of condensation [1] of a turbine's forecast."""
        return self.rows(
            "SELECT time, condensation FROM forecast WHERE turbine = ? AND condensation IS NOT NULL "
            "ORDER BY time",
            (turbine,),
        )

    def assessments(self) -> dict[str, Assessment]:
        """The state of each turbine."""
        return {one.turbine: one for one in self.found(Assessment)}

    def shelves(self, now: float) -> list[Shelf]:
        """Shelves that hold at `now` [s]."""
        return self.found(Shelf, "WHERE until > ? ORDER BY turbine, kind", (now,))

    def all_events(self) -> list[Event]:
        """Events at all turbines, by the time at which they were stated."""
        return self.found(Event, "ORDER BY made, id")

    def events(self, turbine: str) -> list[Event]:
        """Events at a turbine, by time."""
        return self.found(Event, "WHERE turbine = ? ORDER BY time, id", (turbine,))

    def course(
        self, turbine: str, signals: Sequence[str], since: float, until: float
    ) -> list[tuple[str, float, float]]:
        """(signal, time [s], value) of some signals from `since` to `until` [s] that the filter used, sorted
        by signal and time."""
        return self.rows(
            "SELECT signal, time, value FROM observation WHERE turbine = ? AND signal IN "
            f"({', '.join('?' * len(signals))}) AND time >= ? AND time <= ? AND contradicted = 0 "
            "AND late = 0 ORDER BY signal, time",
            (turbine, *signals, since, until),
        )

    def weather(self, turbine: str, since: float) -> list[tuple[str, float, float]]:
        """(signal, time [s], value) of the turbine's weather forecast, else of the common one, by signal and
        time."""
        statement = (
            "SELECT signal, time, value FROM weather WHERE turbine = ? AND time >= ? ORDER BY signal, time"
        )
        return self.rows(statement, (turbine, since)) or self.rows(statement, ("", since))

    def memory(self, turbine: str, name: str) -> Json:
        """JSON data that a turbine's tracker resumes from; None if there is none of that name."""
        found = self.rows("SELECT content FROM memory WHERE turbine = ? AND name = ?", (turbine, name))
        return json.loads(found[0][0]) if found else None

    def memories(self, turbine: str) -> JsonObject:
        """All JSON data that a turbine's tracker resumes from, by name."""
        found = self.rows("SELECT name, content FROM memory WHERE turbine = ?", (turbine,))
        return {name: json.loads(content) for name, content in found}

    def signals(self, turbine: str) -> list[str]:
        """Signals of a turbine's readings, found with one index lookup each; DISTINCT would scan them all."""
        rows = self.rows(f"{_SIGNALS} SELECT signal FROM known WHERE signal IS NOT NULL", (turbine, turbine))
        return [signal for (signal,) in rows]

    def place(self, url: str) -> str | None:
        """Position at which a source resumes; None if it was never read."""
        found = self.rows("SELECT place FROM source WHERE url = ?", (url,))
        return found[0][0] if found else None

    def counters(self) -> dict[tuple[str, str], int]:
        return {
            (turbine, name): int(n)
            for turbine, name, n in self.rows("SELECT turbine, name, count FROM counter")
        }

    def size(self) -> dict[str, int]:
        """Number of rows of each table."""
        return {table: int(self.rows(f"SELECT COUNT(*) FROM {table}")[0][0]) for table in TABLES}


def inserting(table: str) -> str:
    """The statement that inserts a row."""
    columns = TABLES[table].columns
    marks = ", ".join("TIME(?)" if name in TIMESTAMPS[table] else "?" for name in columns)
    return f"INSERT INTO {table} ({', '.join(columns)}) VALUES ({marks})"


def replacing(table: str, kept: Sequence[str] = ()) -> str:
    """The statement that inserts a row or, where one with its key exists, replaces all but the `kept`
    columns."""
    columns, key = TABLES[table].columns, TABLES[table].key
    changed = [f"{name} = excluded.{name}" for name in columns if name not in (*key, *kept)]
    return f"{inserting(table)} ON CONFLICT ({', '.join(key)}) DO UPDATE SET {', '.join(changed)}"


def _statements(batch: Batch) -> Iterator[tuple[str, Iterable[Row]]]:
    """The statements that write all of a batch but its observations, each with its rows."""
    yield inserting("held") + UNLESS_THERE, [(*_reading_row(one), _mark(one)) for one in batch.held]
    released = [_reading_row(one)[:3] for one in batch.released]
    yield "DELETE FROM held WHERE turbine = ? AND signal = ? AND time = ?", released
    yield replacing("connection"), map(astuple, batch.losses)
    points = [(turbine, one.time, state_text(one.state)) for turbine, one in batch.points.items()]
    yield replacing("point"), points
    # estimates take the place of the provisional ones
    begun = [(turbine, one.since) for turbine, one in batch.estimates.items()]
    yield "DELETE FROM estimate WHERE turbine = ? AND time >= ? AND final = 0", begun
    for turbine, one in batch.estimates.items():
        yield replacing("estimate"), estimate_rows(turbine, one.condition, one.final)
    properties = [
        (turbine, at, p.name, p.unit, p.value, p.lower, p.upper, p.reference, int(p.observable))
        for turbine, at, properties in batch.properties
        for p in properties
    ]
    yield replacing("property"), properties
    yield replacing("alarm", ACKNOWLEDGED), map(astuple, batch.alarms)
    again = "UPDATE alarm SET acknowledged = NULL, acknowledged_by = NULL, look_again = NULL WHERE id = ?"
    yield again, [(alarm.id,) for alarm in batch.reopened]
    yield replacing("assessment"), map(astuple, batch.assessments)
    yield inserting("outbox") + UNLESS_THERE, map(astuple, batch.notices)
    memories = [(turbine, name, json.dumps(data)) for (turbine, name), data in batch.memories.items()]
    yield replacing("memory"), memories
    more = " ON CONFLICT (turbine, name) DO UPDATE SET count = counter.count + excluded.count"
    yield inserting("counter") + more, [(*key, count) for key, count in batch.counters.items() if count]
    yield replacing("source"), batch.place.items()
    yield "DELETE FROM forecast WHERE turbine = ?", [(name,) for name in batch.forecasts]
    for turbine, made in batch.forecasts.items():
        if made is not None:
            rows = zip(estimate_rows(turbine, made.condition, 0), _plain(made.above), strict=True)
            yield inserting("forecast"), [(*row[:2], made.made_s, *row[3:], above) for row, above in rows]
    if batch.weather:  # forecast values of the past are of no use
        old = min(one.received for one in batch.weather) - FORGOTTEN_S
        yield "DELETE FROM weather WHERE time < ?", [(old,)]
    newer = " WHERE excluded.received >= weather.received"
    yield replacing("weather") + newer, map(_reading_row, batch.weather)


def _reading_row(one: Observation) -> Row:
    return (one.turbine, one.reading.signal, one.reading.time, one.reading.value, one.received)


def _mark(one: Observation) -> float | None:
    return None if math.isnan(one.reading.mark) else one.reading.mark


def _reading(signal: str, time: float, value: float, mark: float | None) -> Reading:
    return Reading(signal, time, value, math.nan if mark is None else mark)


def state_text(state: Gaussian) -> str:
    """A Gaussian as JSON that restores every bit."""
    return json.dumps({"mean": state.mean.tolist(), "covariance": np.asarray(state.covariance).tolist()})


def state_of(text: str) -> Gaussian:
    data = json.loads(text)
    return Gaussian(np.array(data["mean"], dtype=float), np.array(data["covariance"], dtype=float))


def estimate_rows(turbine: str, found: Condition, final: int) -> list[Row]:
    """Rows of the estimate table, in the order of its columns; NaN becomes NULL."""
    count = len(found.time_s)
    columns: list[list[Any]] = [
        [turbine] * count,
        found.time_s.tolist(),
        [int(i < final) for i in range(count)],
    ]
    for row in QUANTITIES:
        quantity: Quantity | None = getattr(found, row.column)
        columns += [[None] * count] * 2 if quantity is None else [_plain(quantity.value), _plain(quantity.sd)]
    columns.append([None] * count if found.condensation is None else _plain(found.condensation))
    return list(zip(*columns, strict=True))


def _plain(values: np.ndarray) -> list[float | None]:
    return [v if v == v else None for v in values.tolist()]


# -- retention -----------------------------------------------------------------------------------------------
BITE = 1_000
"""Rows deleted at once, so that the loop is only held up briefly."""


def prune(store: Store, turbine: str, before: float, needed: float, most: int = BITE) -> int:
    """Delete at most `most` rows of a turbine older than `before` [s]; returns the number deleted, less than
    `most` when done.

    Readings from `needed` [s] on and each signal's last `BEFORE` readings before that are kept, because a
    restart needs them.  Open alarms are kept, too.
    """
    limit, count = min(before, needed), 0
    with store.transaction() as cursor:
        for signal in store.signals(turbine):
            edges = store.rows(
                "SELECT time FROM observation WHERE turbine = ? AND signal = ? AND time < ? AND late = 0 "
                "ORDER BY time DESC LIMIT ?",
                (turbine, signal, needed, BEFORE),
            )
            until = min(limit, edges[-1][0]) if edges else limit
            same = {"turbine": turbine, "signal": signal}
            count += _bite(store, cursor, "observation", same, "time", until, most - count)
        for table, column in (
            ("revision", "time"), ("estimate", "time"), ("property", "time"), ("alarm", "ended"),
            ("connection", "regained"),
        ):  # fmt: skip
            count += _bite(store, cursor, table, {"turbine": turbine}, column, limit, most - count)
    return count


def _bite(
    store: Store, cursor: Cursor, table: str, same: Mapping[str, str], column: str, until: float, most: int
) -> int:
    """Delete at most `most` of the oldest rows of a table before a time [s]; returns the number deleted."""
    where = " AND ".join([*(f"{name} = ?" for name in same), f"{column} < ?"])
    values: tuple[SqlValue, ...] = (*same.values(), until)
    next_one = store.rows(
        f"SELECT {column} FROM {table} WHERE {where} ORDER BY {column} LIMIT 1 OFFSET ?",
        (*values, max(most, 0)),
    )
    if next_one:
        values = (*same.values(), next_one[0][0])
    cursor.execute(store.database.text(f"DELETE FROM {table} WHERE {where}"), values)
    return max(cursor.rowcount, 0)


# -- opening -------------------------------------------------------------------------------------------------
def open_store(url: str, read_only: bool = False) -> Store:
    """Open the store at `sqlite:PATH` or `postgresql://USER@HOST/NAME`, creating it if it is missing.

    With `read_only` the store must exist, and nothing can be written.  Raises StoreFault if the target is no
    store, has another schema, is damaged or cannot be reached.  Nothing is overwritten.
    """
    if url.startswith(SCHEMES):
        return Store(open_postgres(url, read_only))
    if url.startswith("sqlite:"):
        return Store(open_sqlite(path_of(url), read_only))
    scheme = url.partition(":")[0] if ":" in url else url
    raise StoreFault(
        "expected a store as sqlite:PATH or postgresql://USER@HOST/NAME, found one that begins with "
        f"{scheme[:40]!r}"
    )
