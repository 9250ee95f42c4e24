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
from itertools import chain
from typing import Any, TypeVar

import numpy as np
from sqlalchemy import ClauseElement, Column, Select

from hygrokf.data.structured import Json, JsonObject
from hygrokf.data.timestamps import DAY_S
from hygrokf.estimation.likelihood import Gaussian
from hygrokf.live.batch import Alarm, Assessment, Batch, Event, Notice, Observation, Shelf
from hygrokf.live.condition import QUANTITIES, Condition, Quantity
from hygrokf.live.plan import BEFORE
from hygrokf.live.storage import schema, statements
from hygrokf.live.storage.database import Database, Row
from hygrokf.live.storage.database import StoreFault as StoreFault
from hygrokf.live.storage.postgres import SCHEMES, open_postgres
from hygrokf.live.storage.sqlite import open_sqlite, path_of
from hygrokf.live.storage.statements import (
    ACKNOWLEDGED,
    counting,
    deleting,
    inserting,
    newest,
    replacing,
    selecting,
)
from hygrokf.live.tracker import Point, Reading, Versions, used_value

FORGOTTEN_S = 3 * DAY_S
"""[s] a value of a weather forecast is kept after its time."""
ASKED = 500
"""Times of readings asked for in one query."""
T = TypeVar("T")


class Store:
    """One store, in either database, whose statements, transactions and claims are its own; only one thread
    may use it at a time.

    An external error (disk, network, another process) is raised as StoreFault and may be gone once the store
    is reopened; an invalid statement or value raises the driver's own exception.
    """

    def __init__(self, database: Database) -> None:
        self.database, self.url = database, database.url
        self.rows, self.first, self.transaction = database.rows, database.first, database.transaction
        self.execute, self.execute_many = database.execute, database.execute_many
        self.claim, self.close = database.claim, database.close

    def found(self, kind: type[T], query: Select[Any], **values: Any) -> list[T]:
        """The rows of a table whose columns are the fields of a kind."""
        return [kind(*row) for row in self.rows(query, **values)]

    # -- writing ---------------------------------------------------------------------------------------------
    def commit(self, batch: Batch) -> None:
        """Write a batch completely or not at all."""
        with self.transaction():
            self.write(batch)

    def write(self, batch: Batch) -> None:
        """Write a batch within a transaction.  Of a stamp with several values the one that counts is written,
        and every version is kept beside it."""
        first = [(*_reading_row(o), int(o.late), 0, _mark(o)) for o in batch.observations if not o.revision]
        self.execute_many(inserting(schema.observation), first)
        self._write_revisions([one for one in batch.observations if one.revision])
        for statement, rows in _changes(batch):
            self.execute_many(statement, rows)

    def _write_revisions(self, revisions: Sequence[Observation]) -> None:
        """Add versions of values to those of their stamps, and use those that count and come in time."""
        stamps: dict[str, list[tuple[str, float]]] = {}
        for one in revisions:
            stamps.setdefault(one.turbine, []).append((one.reading.signal, one.reading.time))
        known = {turbine: self.versions(turbine, own) for turbine, own in stamps.items()}
        self.execute_many(statements.FIRST_VERSION, [_reading_row(one)[:3] for one in revisions])
        added = inserting(schema.revision)
        for one in revisions:
            versions = known[one.turbine][one.reading.signal, one.reading.time]
            self.execute_many(added, [(*_reading_row(one), _mark(one), int(one.late), len(versions))])
            versions.append(one.reading)
            if not one.late:
                self.use(one.turbine, versions)

    def use(self, turbine: str, versions: Sequence[Reading]) -> None:
        """Let the version of a stamp that counts be the observation."""
        value, first = used_value(versions), versions[0]
        none = math.isnan(value)
        used = first.value if none else value
        stamp = {"turbine": turbine, "signal": first.signal, "time": first.time}
        self.execute(statements.USE_VERSION, **stamp, used=used, wrong=int(none))

    def add_turbines(self, models: Mapping[str, str]) -> None:
        """Register turbines; `models`: turbine → digest of the model that tracks it.

        A turbine whose model has changed starts again from its observations, because its point belongs to the
        old model.
        """
        with self.transaction():
            known = self.models()
            for name, digest in models.items():
                if known.get(name, digest) != digest:
                    for table in (schema.point, schema.memory):
                        self.execute(deleting(table, "turbine"), turbine=name)
            rows = [(name, digest, time.time()) for name, digest in models.items()]
            self.execute_many(replacing(schema.turbine, "added"), rows)

    # -- what people state -----------------------------------------------------------------------------------
    def acknowledge(self, known: Alarm, notices: Iterable[Notice] = ()) -> bool:
        """Write the acknowledgement of an alarm, and its notices.

        Returns False if there is no such alarm or it was acknowledged before.
        """
        stated = {f"new_{name}": getattr(known, name) for name in ACKNOWLEDGED}
        with self.transaction():
            changed = self.execute(statements.ACKNOWLEDGE, id=known.id, **stated) == 1
            if changed:
                self.execute_many(inserting(schema.outbox), map(astuple, notices))
        return changed

    def shelve(self, shelf: Shelf) -> None:
        """Shelve a turbine's alarms of one kind, in place of an earlier shelf of that kind."""
        self._put(replacing(schema.shelf), shelf)

    def unshelve(self, turbine: str, kind: str) -> bool:
        """End a shelf early; False if there is none."""
        return self.execute(deleting(schema.shelf, "turbine kind"), turbine=turbine, kind=kind) == 1

    def note_event(self, event: Event) -> None:
        """Write an event, in place of one with its id."""
        self._put(replacing(schema.event), event)

    def _put(self, statement: ClauseElement, row: Shelf | Event) -> None:
        with self.transaction():
            self.execute_many(statement, [astuple(row)])

    # -- reading ---------------------------------------------------------------------------------------------
    def point(self, turbine: str) -> Point | None:
        found = self.first(selecting(schema.point, "time state", "turbine"), turbine=turbine)
        return Point(found[0], state_of(found[1])) if found else None

    def models(self) -> dict[str, str]:
        """Turbine -> digest of the model that tracks it."""
        return dict(self.rows(selecting(schema.turbine, "name model", order="name")))

    def readings(self, turbine: str, since: float) -> list[Reading]:
        """Readings of a turbine that the filter may use: those from `since` [s] on and each signal's last
        `BEFORE` before it.

        The value is NaN where two readings contradict each other.
        """
        found: list[Reading] = []
        for signal in self.signals(turbine):
            begin = self.first_needed(turbine, signal, since)
            rows = self.rows(statements.READINGS, turbine=turbine, signal=signal, since=begin)
            found += [_reading(signal, at, math.nan if bad else value, mark) for at, value, mark, bad in rows]
        return found

    def first_needed(self, turbine: str, signal: str, since: float) -> float:
        """Time [s] of the first of the last `BEFORE` readings of a signal before `since` [s]; `since`
        without any."""
        own = {"turbine": turbine, "signal": signal}
        times = self.rows(statements.BEFORE_TIME, **own, before=since, most=BEFORE)
        return float(times[-1][0]) if times else since

    def versions(self, turbine: str, stamps: Iterable[tuple[str, float]]) -> Versions:
        """The versions of the values of some stamps (signal, time [s]), but for those that are not known."""
        found: Versions = {}
        wanted = set(stamps)
        times = sorted({at for _, at in wanted})
        for first in range(0, len(times), ASKED):
            rows = self.rows(statements.AT_TIMES, turbine=turbine, times=times[first : first + ASKED])
            found |= {(row[0], row[1]): [_reading(*row)] for row in rows if row[:2] in wanted}
        revised = self.revised(turbine, times[0]) if found else {}
        return found | {stamp: known for stamp, known in revised.items() if stamp in found}

    def revised(self, turbine: str, since: float = -math.inf) -> Versions:
        """The versions of all stamps from `since` [s] on that had several values."""
        found: Versions = {}
        query = selecting(
            schema.revision, "signal time value mark", "turbine", "signal time number", since=True
        )
        for signal, at, value, mark in self.rows(query, turbine=turbine, since=since):
            found.setdefault((signal, at), []).append(_reading(signal, at, value, mark))
        return found

    def losses(self, turbine: str) -> dict[str, list[tuple[float, float]]]:
        """Spans [s] in which the connection of each signal of a turbine was lost, ∞ as an end to come."""
        found: dict[str, list[tuple[float, float]]] = {}
        query = selecting(schema.connection, "signal lost regained", "turbine", "signal lost")
        for signal, lost, regained in self.rows(query, turbine=turbine):
            found.setdefault(signal, []).append((lost, math.inf if regained is None else regained))
        return found

    def held(self, turbine: str, until: float = math.inf) -> list[Observation]:
        """Readings of a turbine that came with stamps ahead of the clock and are from before `until` [s], by
        time."""
        found = self.rows(statements.HELD, turbine=turbine, until=until)
        return [Observation(name, _reading(*reading), received) for name, received, *reading in found]

    def held_ahead(self) -> list[tuple[str, str, float]]:
        """(turbine, signal, time [s] from the last arrival to the latest stamp) of readings that are held
        back."""
        found = self.rows(statements.HELD_AHEAD)
        return [(turbine, signal, latest - arrival) for turbine, signal, latest, arrival in found]

    def held_count(self, turbine: str) -> int:
        """Number of readings that are held back for one turbine."""
        return int(self.rows(counting(schema.held, "turbine"), turbine=turbine)[0][0])

    def newest_estimate(self, turbine: str) -> tuple[float, float | None] | None:
        """Time [s] and probability of condensation [1] of a turbine's newest estimate; None without any."""
        found = self.first(newest(schema.estimate, "time condensation", "turbine"), turbine=turbine)
        return None if found is None else (found[0], found[1])

    def outlook(self, turbine: str) -> list[tuple[float, float]]:
        """Times [s] and probabilities of condensation [1] of a turbine's forecast."""
        return self.rows(statements.OUTLOOK, turbine=turbine)

    def assessments(self) -> dict[str, Assessment]:
        """The state of each turbine."""
        return {one.turbine: one for one in self.found(Assessment, selecting(schema.assessment))}

    def shelves(self, now: float) -> list[Shelf]:
        """Shelves that hold at `now` [s]."""
        return self.found(Shelf, statements.SHELVES, now=now)

    def all_events(self) -> list[Event]:
        """Events at all turbines, by the time at which they were stated."""
        return self.found(Event, selecting(schema.event, order="made id"))

    def events(self, turbine: str) -> list[Event]:
        """Events at a turbine, by time."""
        return self.found(Event, selecting(schema.event, same="turbine", order="time id"), turbine=turbine)

    def course(
        self, turbine: str, signals: Sequence[str], since: float, until: float
    ) -> list[tuple[str, float, float]]:
        """(signal, time [s], value) of some signals from `since` to `until` [s] that the filter used, sorted
        by signal and time."""
        span = {"since": since, "until": until}
        return self.rows(statements.COURSE, turbine=turbine, signals=signals, **span)

    def weather(self, turbine: str, since: float) -> list[tuple[str, float, float]]:
        """(signal, time [s], value) of the turbine's weather forecast, else of the common one, by signal and
        time."""
        query = selecting(schema.weather, "signal time value", "turbine", "signal time", since=True)
        return self.rows(query, turbine=turbine, since=since) or self.rows(query, turbine="", since=since)

    def memory(self, turbine: str, name: str) -> Json:
        """JSON data that a turbine's tracker resumes from; None if there is none of that name."""
        found = self.first(selecting(schema.memory, "content", "turbine name"), turbine=turbine, name=name)
        return json.loads(found[0]) if found else None

    def memories(self, turbine: str) -> JsonObject:
        """All JSON data that a turbine's tracker resumes from, by name."""
        found = self.rows(selecting(schema.memory, "name content", "turbine"), turbine=turbine)
        return {name: json.loads(content) for name, content in found}

    def signals(self, turbine: str) -> list[str]:
        """Signals of a turbine's readings."""
        return [signal for (signal,) in self.rows(statements.SIGNALS, turbine=turbine)]

    def place(self, url: str) -> str | None:
        """Position at which a source resumes; None if it was never read."""
        found = self.first(selecting(schema.source, "place", "url"), url=url)
        return found[0] if found else None

    def counters(self) -> dict[tuple[str, str], int]:
        return {(turbine, name): int(n) for turbine, name, n in self.rows(selecting(schema.counter))}

    def size(self) -> dict[str, int]:
        """Number of rows of each table."""
        return {name: int(self.rows(counting(table))[0][0]) for name, table in schema.TABLES.items()}


def _changes(batch: Batch) -> Iterator[tuple[ClauseElement, Iterable[Row]]]:
    """The statements that write all of a batch but its observations, each with its rows."""
    yield inserting(schema.held), [(*_reading_row(one), _mark(one)) for one in batch.held]
    yield deleting(schema.held, "turbine signal time"), [_reading_row(one)[:3] for one in batch.released]
    yield replacing(schema.connection), map(astuple, batch.losses)
    points = [(turbine, one.time, state_text(one.state)) for turbine, one in batch.points.items()]
    yield replacing(schema.point), points
    # estimates take the place of the provisional ones
    yield statements.PROVISIONAL, [(turbine, one.since) for turbine, one in batch.estimates.items()]
    estimates = (estimate_rows(name, one.condition, one.final) for name, one in batch.estimates.items())
    yield replacing(schema.estimate), chain.from_iterable(estimates)
    properties = [
        (turbine, at, p.name, p.unit, p.value, p.lower, p.upper, p.reference, int(p.observable))
        for turbine, at, properties in batch.properties
        for p in properties
    ]
    yield replacing(schema.property_), properties
    yield replacing(schema.alarm, *ACKNOWLEDGED), map(astuple, batch.alarms)
    yield statements.REOPEN, [(alarm.id,) for alarm in batch.reopened]
    yield replacing(schema.assessment), map(astuple, batch.assessments)
    yield inserting(schema.outbox), map(astuple, batch.notices)
    memories = [(turbine, name, json.dumps(data)) for (turbine, name), data in batch.memories.items()]
    yield replacing(schema.memory), memories
    yield (
        replacing(schema.counter, added="count"),
        [(*key, count) for key, count in batch.counters.items() if count],
    )
    yield replacing(schema.source), batch.place.items()
    yield deleting(schema.forecast, "turbine"), [(name,) for name in batch.forecasts]
    for turbine, made in batch.forecasts.items():
        if made is not None:
            rows = zip(estimate_rows(turbine, made.condition, 0), _plain(made.above), strict=True)
            forecast = [(*row[:2], made.made_s, *row[3:], above) for row, above in rows]
            yield inserting(schema.forecast), forecast
    if batch.weather:  # forecast values of the past are of no use
        old = min(one.received for one in batch.weather) - FORGOTTEN_S
        yield statements.OLD_WEATHER, [(old,)]
    yield replacing(schema.weather, newer="received"), map(_reading_row, batch.weather)


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
    with store.transaction():
        for signal in store.signals(turbine):
            until = min(limit, store.first_needed(turbine, signal, needed))
            same = {"turbine": turbine, "signal": signal}
            count += _bite(store, schema.observation.c.time, until, most - count, same)
        for time_column in (
            schema.revision.c.time, schema.estimate.c.time, schema.property_.c.time, schema.alarm.c.ended,
            schema.connection.c.regained,
        ):  # fmt: skip
            count += _bite(store, time_column, limit, most - count, {"turbine": turbine})
    return count


def _bite(store: Store, time: Column[Any], until: float, most: int, same: Mapping[str, str]) -> int:
    """Delete at most `most` of the oldest rows with the `same` values from before a time [s]; returns the
    number deleted."""
    names = " ".join(same)
    kept = store.first(statements.first_kept(time, names), **same, until=until, first=max(most, 0))
    end = kept[0] if kept else until
    return store.execute(statements.deleting_before(time, names), **same, until=end)


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
