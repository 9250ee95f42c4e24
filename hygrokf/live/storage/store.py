"""The store of observations, estimates, filter states and each source's position, all committed together.

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
from hygrokf.live.condition import DISPLAYED_QUANTITIES, Condition, Quantity
from hygrokf.live.plan import BEFORE
from hygrokf.live.storage import schema, statements
from hygrokf.live.storage.database import Database, Row
from hygrokf.live.storage.database import StoreFault as StoreFault
from hygrokf.live.storage.postgres import SCHEMES, open_postgres
from hygrokf.live.storage.sqlite import open_sqlite, path_of
from hygrokf.live.storage.statements import (
    ACKNOWLEDGED_COLUMNS,
    count_rows,
    delete_rows,
    insert_new,
    select_newest,
    select_rows,
    upsert,
)
from hygrokf.live.tracker import Point, Reading, Versions, used_value

WEATHER_KEPT_S = 3 * DAY_S
"""[s] for which a value of a weather forecast is kept after its time."""
TIMES_PER_QUERY = 500
"""Largest number of times in one query for readings."""
T = TypeVar("T")


class Store:
    """A store in either database; only one thread may use it at a time.

    An external error (disk, network, another process) is raised as StoreFault and may not recur after the
    store is reopened; an invalid statement or value raises the driver's own exception.
    """

    def __init__(self, database: Database) -> None:
        self.database, self.url = database, database.url
        self.rows, self.first, self.transaction = database.rows, database.first, database.transaction
        self.execute, self.execute_many = database.execute, database.execute_many
        self.claim, self.close = database.claim, database.close

    def records(self, kind: type[T], query: Select[Any], **values: Any) -> list[T]:
        """The rows of a query as objects of the dataclass `kind`, whose fields are the query's columns."""
        return [kind(*row) for row in self.rows(query, **values)]

    # -- writing ---------------------------------------------------------------------------------------------
    def commit(self, batch: Batch) -> None:
        """Write a batch completely or not at all."""
        with self.transaction():
            self.write(batch)

    def write(self, batch: Batch) -> None:
        """Write a batch within a transaction.

        If a stamp has several values, the observation holds the one that the filter uses, and the table
        `revision` holds all versions.
        """
        first = [(*_reading_row(o), int(o.late), 0, _mark(o)) for o in batch.observations if not o.revision]
        self.execute_many(insert_new(schema.observation), first)
        self._write_revisions([o for o in batch.observations if o.revision])
        for statement, rows in _changes(batch):
            self.execute_many(statement, rows)

    def _write_revisions(self, revisions: Sequence[Observation]) -> None:
        """Add each revision to the versions of its stamp; unless it is late, choose the version to use
        anew."""
        stamps: dict[str, list[tuple[str, float]]] = {}
        for o in revisions:
            stamps.setdefault(o.turbine, []).append((o.reading.signal, o.reading.time))
        stored = {turbine: self.versions(turbine, revised) for turbine, revised in stamps.items()}
        self.execute_many(statements.FIRST_VERSION, [_reading_row(o)[:3] for o in revisions])
        insertion = insert_new(schema.revision)
        for o in revisions:
            versions = stored[o.turbine][o.reading.signal, o.reading.time]
            self.execute_many(insertion, [(*_reading_row(o), _mark(o), int(o.late), len(versions))])
            versions.append(o.reading)
            if not o.late:
                self.use(o.turbine, versions)

    def use(self, turbine: str, versions: Sequence[Reading]) -> None:
        """Write the version of a stamp that the filter uses as the observation."""
        value, first = used_value(versions), versions[0]
        is_contradicted = math.isnan(value)
        used = first.value if is_contradicted else value
        stamp = {"turbine": turbine, "signal": first.signal, "time": first.time}
        self.execute(statements.USE_VERSION, **stamp, used=used, is_contradicted=int(is_contradicted))

    def add_turbines(self, models: Mapping[str, str]) -> None:
        """Register turbines; `models`: turbine → digest of the model that tracks it.

        A turbine whose model has changed starts again from its observations, because its filter state belongs
        to the old model.
        """
        with self.transaction():
            registered = self.models()
            for name, digest in models.items():
                if registered.get(name, digest) != digest:
                    for table in (schema.point, schema.memory):
                        self.execute(delete_rows(table, "turbine"), turbine=name)
            rows = [(name, digest, time.time()) for name, digest in models.items()]
            self.execute_many(upsert(schema.turbine, "added"), rows)

    # -- statements of people --------------------------------------------------------------------------------
    def acknowledge(self, acknowledged: Alarm, notices: Iterable[Notice] = ()) -> bool:
        """Write the acknowledgement that an alarm carries, and its notices.

        Returns False if the store has no such alarm or the alarm was acknowledged before.
        """
        values = {f"new_{name}": getattr(acknowledged, name) for name in ACKNOWLEDGED_COLUMNS}
        with self.transaction():
            changed = self.execute(statements.ACKNOWLEDGE, id=acknowledged.id, **values) == 1
            if changed:
                self.execute_many(insert_new(schema.outbox), map(astuple, notices))
        return changed

    def shelve(self, shelf: Shelf) -> None:
        """Shelve a turbine's alarms of one kind, which replaces an earlier shelf of that kind."""
        self._put(upsert(schema.shelf), shelf)

    def unshelve(self, turbine: str, kind: str) -> bool:
        """End a shelf early; returns False if there is no such shelf."""
        return self.execute(delete_rows(schema.shelf, "turbine kind"), turbine=turbine, kind=kind) == 1

    def note_event(self, event: Event) -> None:
        """Write an event; it replaces an event with the same id."""
        self._put(upsert(schema.event), event)

    def _put(self, statement: ClauseElement, row: Shelf | Event) -> None:
        with self.transaction():
            self.execute_many(statement, [astuple(row)])

    # -- reading ---------------------------------------------------------------------------------------------
    def point(self, turbine: str) -> Point | None:
        row = self.first(select_rows(schema.point, "time state", "turbine"), turbine=turbine)
        return Point(row[0], state_of(row[1])) if row else None

    def models(self) -> dict[str, str]:
        """Turbine → digest of the model that tracks it."""
        return dict(self.rows(select_rows(schema.turbine, "name model", order="name")))

    def readings(self, turbine: str, since: float) -> list[Reading]:
        """Readings of a turbine that the filter may use: each signal's readings from `since` [s] on, and its
        last `BEFORE` readings before `since`.

        The value is NaN where two readings contradict each other.
        """
        readings: list[Reading] = []
        for signal in self.signals(turbine):
            begin = self.first_needed(turbine, signal, since)
            rows = self.rows(statements.READINGS, turbine=turbine, signal=signal, since=begin)
            for at, value, mark, contradicted in rows:
                readings.append(_reading(signal, at, math.nan if contradicted else value, mark))
        return readings

    def first_needed(self, turbine: str, signal: str, since: float) -> float:
        """Time [s] of the earliest of a signal's last `BEFORE` readings before `since` [s]; `since` itself if
        there are no earlier readings."""
        query = statements.BEFORE_TIME
        times = self.rows(query, turbine=turbine, signal=signal, before=since, most=BEFORE)
        return float(times[-1][0]) if times else since

    def versions(self, turbine: str, stamps: Iterable[tuple[str, float]]) -> Versions:
        """The versions of the values of some stamps (signal, time [s]); a stamp that is not stored is left
        out."""
        versions: Versions = {}
        wanted = set(stamps)
        times = sorted({at for _, at in wanted})
        for first in range(0, len(times), TIMES_PER_QUERY):
            some = times[first : first + TIMES_PER_QUERY]
            rows = self.rows(statements.AT_TIMES, turbine=turbine, times=some)
            versions |= {(row[0], row[1]): [_reading(*row)] for row in rows if row[:2] in wanted}
        revised = self.revised(turbine, times[0]) if versions else {}
        return versions | {stamp: values for stamp, values in revised.items() if stamp in versions}

    def revised(self, turbine: str, since: float = -math.inf) -> Versions:
        """The versions of all stamps from `since` [s] on that have several values."""
        versions: Versions = {}
        query = select_rows(
            schema.revision, "signal time value mark", "turbine", "signal time number", since=True
        )
        for signal, at, value, mark in self.rows(query, turbine=turbine, since=since):
            versions.setdefault((signal, at), []).append(_reading(signal, at, value, mark))
        return versions

    def losses(self, turbine: str) -> dict[str, list[tuple[float, float]]]:
        """Signal of a turbine → spans (begin, end) [s] without connection; the end is ∞ while it is lost."""
        losses: dict[str, list[tuple[float, float]]] = {}
        query = select_rows(schema.connection, "signal lost regained", "turbine", "signal lost")
        for signal, lost, regained in self.rows(query, turbine=turbine):
            losses.setdefault(signal, []).append((lost, math.inf if regained is None else regained))
        return losses

    def held(self, turbine: str, until: float = math.inf) -> list[Observation]:
        """Readings of a turbine that are held back because they arrived with stamps ahead of the clock, up to
        the time `until` [s], sorted by time."""
        rows = self.rows(statements.HELD, turbine=turbine, until=until)
        return [Observation(name, _reading(*reading), received) for name, received, *reading in rows]

    def held_ahead(self) -> list[tuple[str, str, float]]:
        """(turbine, signal, time [s] from the last arrival to the latest stamp) of readings that are held
        back."""
        rows = self.rows(statements.HELD_AHEAD)
        return [(turbine, signal, latest - arrival) for turbine, signal, latest, arrival in rows]

    def held_count(self, turbine: str) -> int:
        """Number of readings that are held back for one turbine."""
        return int(self.rows(count_rows(schema.held, "turbine"), turbine=turbine)[0][0])

    def newest_estimate(self, turbine: str) -> tuple[float, float | None] | None:
        """Time [s] and probability of condensation [1] of a turbine's newest estimate; None without
        estimates."""
        row = self.first(select_newest(schema.estimate, "time condensation", "turbine"), turbine=turbine)
        return None if row is None else (row[0], row[1])

    def outlook(self, turbine: str) -> list[tuple[float, float]]:
        """Times [s] and probabilities of condensation [1] of a turbine's forecast."""
        return self.rows(statements.OUTLOOK, turbine=turbine)

    def assessments(self) -> dict[str, Assessment]:
        """Turbine → assessment of its state."""
        return {row.turbine: row for row in self.records(Assessment, select_rows(schema.assessment))}

    def shelves(self, now: float) -> list[Shelf]:
        """Shelves that are in force at `now` [s]."""
        return self.records(Shelf, statements.SHELVES, now=now)

    def all_events(self) -> list[Event]:
        """Events at all turbines, in the order in which they were entered."""
        return self.records(Event, select_rows(schema.event, order="made id"))

    def events(self, turbine: str) -> list[Event]:
        """Events at a turbine, sorted by time."""
        return self.records(
            Event, select_rows(schema.event, same="turbine", order="time id"), turbine=turbine
        )

    def course(
        self, turbine: str, signals: Sequence[str], since: float, until: float
    ) -> list[tuple[str, float, float]]:
        """(signal, time [s], value) of the readings of some signals that the filter used, from `since` to
        `until` [s], sorted by signal and time."""
        span = {"since": since, "until": until}
        return self.rows(statements.COURSE, turbine=turbine, signals=signals, **span)

    def weather(self, turbine: str, since: float) -> list[tuple[str, float, float]]:
        """(signal, time [s], value) of the turbine's own weather forecast, or of the forecast for all
        turbines if it has none, sorted by signal and time."""
        query = select_rows(schema.weather, "signal time value", "turbine", "signal time", since=True)
        return self.rows(query, turbine=turbine, since=since) or self.rows(query, turbine="", since=since)

    def memory(self, turbine: str, name: str) -> Json:
        """JSON data of that name from which a turbine's tracker resumes; None if the store has none."""
        row = self.first(select_rows(schema.memory, "content", "turbine name"), turbine=turbine, name=name)
        return json.loads(row[0]) if row else None

    def memories(self, turbine: str) -> JsonObject:
        """Name → JSON data from which a turbine's tracker resumes."""
        rows = self.rows(select_rows(schema.memory, "name content", "turbine"), turbine=turbine)
        return {name: json.loads(content) for name, content in rows}

    def signals(self, turbine: str) -> list[str]:
        """Signals of a turbine's readings."""
        return [signal for (signal,) in self.rows(statements.SIGNALS_READ, turbine=turbine)]

    def place(self, url: str) -> str | None:
        """Position at which a source resumes; None if it was never read."""
        row = self.first(select_rows(schema.source, "place", "url"), url=url)
        return row[0] if row else None

    def counters(self) -> dict[tuple[str, str], int]:
        return {(turbine, name): int(n) for turbine, name, n in self.rows(select_rows(schema.counter))}

    def size(self) -> dict[str, int]:
        """Table → number of rows."""
        return {name: int(self.rows(count_rows(table))[0][0]) for name, table in schema.TABLES.items()}


def _changes(batch: Batch) -> Iterator[tuple[ClauseElement, Iterable[Row]]]:
    """The statements that write a batch except its observations, each with its rows of parameters."""
    yield insert_new(schema.held), [(*_reading_row(o), _mark(o)) for o in batch.held]
    yield delete_rows(schema.held, "turbine signal time"), [_reading_row(o)[:3] for o in batch.released]
    yield upsert(schema.connection), map(astuple, batch.losses)
    points = [(turbine, p.time, state_text(p.state)) for turbine, p in batch.points.items()]
    yield upsert(schema.point), points
    # the new estimates replace the provisional ones
    yield statements.PROVISIONAL, [(turbine, e.since) for turbine, e in batch.estimates.items()]
    estimates = (estimate_rows(turbine, e.condition, e.final) for turbine, e in batch.estimates.items())
    yield upsert(schema.estimate), chain.from_iterable(estimates)
    properties = [
        (turbine, at, p.name, p.unit, p.value, p.lower, p.upper, p.reference, int(p.observable))
        for turbine, at, properties in batch.properties
        for p in properties
    ]
    yield upsert(schema.property_), properties
    yield upsert(schema.alarm, *ACKNOWLEDGED_COLUMNS), map(astuple, batch.alarms)
    yield statements.REOPEN, [(alarm.id,) for alarm in batch.reopened]
    yield upsert(schema.assessment), map(astuple, batch.assessments)
    yield insert_new(schema.outbox), map(astuple, batch.notices)
    memories = [(turbine, name, json.dumps(data)) for (turbine, name), data in batch.memories.items()]
    yield upsert(schema.memory), memories
    yield (
        upsert(schema.counter, added="count"),
        [(*key, count) for key, count in batch.counters.items() if count],
    )
    yield upsert(schema.source), batch.place.items()
    yield delete_rows(schema.forecast, "turbine"), [(name,) for name in batch.forecasts]
    for turbine, forecast in batch.forecasts.items():
        if forecast is not None:
            rows = zip(estimate_rows(turbine, forecast.condition, 0), _plain(forecast.above), strict=True)
            forecast_rows = [(*row[:2], forecast.made_s, *row[3:], above) for row, above in rows]
            yield insert_new(schema.forecast), forecast_rows
    if batch.weather:  # forecast values of the past are of no use
        old = min(o.received for o in batch.weather) - WEATHER_KEPT_S
        yield statements.OLD_WEATHER, [(old,)]
    yield upsert(schema.weather, newer="received"), map(_reading_row, batch.weather)


def _reading_row(observation: Observation) -> Row:
    reading = observation.reading
    return (observation.turbine, reading.signal, reading.time, reading.value, observation.received)


def _mark(observation: Observation) -> float | None:
    mark = observation.reading.mark
    return None if math.isnan(mark) else mark


def _reading(signal: str, time: float, value: float, mark: float | None) -> Reading:
    return Reading(signal, time, value, math.nan if mark is None else mark)


def state_text(state: Gaussian) -> str:
    """A Gaussian as JSON that restores every bit."""
    return json.dumps({"mean": state.mean.tolist(), "covariance": np.asarray(state.covariance).tolist()})


def state_of(text: str) -> Gaussian:
    data = json.loads(text)
    return Gaussian(np.array(data["mean"], dtype=float), np.array(data["covariance"], dtype=float))


def estimate_rows(turbine: str, condition: Condition, final: int) -> list[Row]:
    """Rows of the estimate table, in the order of its columns; the first `final` are final; NaN becomes
    NULL."""
    count = len(condition.time_s)
    columns: list[list[Any]] = [
        [turbine] * count,
        condition.time_s.tolist(),
        [int(i < final) for i in range(count)],
    ]
    for row in DISPLAYED_QUANTITIES:
        quantity: Quantity | None = getattr(condition, row.column)
        columns += [[None] * count] * 2 if quantity is None else [_plain(quantity.value), _plain(quantity.sd)]
    columns.append([None] * count if condition.condensation is None else _plain(condition.condensation))
    return list(zip(*columns, strict=True))


def _plain(values: np.ndarray) -> list[float | None]:
    return [None if math.isnan(value) else value for value in values.tolist()]


# -- retention -----------------------------------------------------------------------------------------------
MOST_DELETED = 1_000
"""Most rows deleted at once, so that a deletion delays the tracker's loop only briefly."""


def prune(store: Store, turbine: str, before: float, needed: float, most: int = MOST_DELETED) -> int:
    """Delete at most `most` rows of a turbine older than `before` [s]; returns the number of deleted rows,
    which is less than `most` when none remain to be deleted.

    Readings from `needed` [s] on and each signal's last `BEFORE` readings before `needed` are kept, because a
    restart needs them.  Open alarms are kept, too.
    """
    limit, count = min(before, needed), 0
    with store.transaction():
        for signal in store.signals(turbine):
            until = min(limit, store.first_needed(turbine, signal, needed))
            same = {"turbine": turbine, "signal": signal}
            count += _delete_oldest(store, schema.observation.c.time, until, most - count, same)
        for time_column in (
            schema.revision.c.time, schema.estimate.c.time, schema.property_.c.time, schema.alarm.c.ended,
            schema.connection.c.regained,
        ):  # fmt: skip
            count += _delete_oldest(store, time_column, limit, most - count, {"turbine": turbine})
    return count


def _delete_oldest(store: Store, time: Column[Any], until: float, most: int, same: Mapping[str, str]) -> int:
    """Delete at most `most` of the oldest rows before `until` [s] whose columns have the values `same`;
    returns the number of deleted rows."""
    names = " ".join(same)
    first_kept = store.first(statements.first_kept(time, names), **same, until=until, first=max(most, 0))
    end = first_kept[0] if first_kept else until
    return store.execute(statements.delete_before(time, names), **same, until=end)


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
