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
        first_values = [observed for observed in batch.observations if not observed.revision]
        contradicted = 0
        self.execute_many(
            insert_new(schema.observation),
            [
                (*_reading_row(observed), int(observed.late), contradicted, _mark(observed))
                for observed in first_values
            ],
        )
        self._write_revisions([observed for observed in batch.observations if observed.revision])
        for statement, rows in _statements_of(batch):
            self.execute_many(statement, rows)

    def _write_revisions(self, revisions: Sequence[Observation]) -> None:
        """Add each revision to the versions of its stamp and, unless it is late, choose the one to use."""
        stamps_by_turbine: dict[str, list[tuple[str, float]]] = {}
        for revision in revisions:
            stamp = revision.reading.signal, revision.reading.time
            stamps_by_turbine.setdefault(revision.turbine, []).append(stamp)
        stored = {turbine: self.versions(turbine, stamps) for turbine, stamps in stamps_by_turbine.items()}
        self.execute_many(statements.FIRST_VERSION, [_reading_row(revision)[:3] for revision in revisions])
        for revision in revisions:
            versions = stored[revision.turbine][revision.reading.signal, revision.reading.time]
            row = (*_reading_row(revision), _mark(revision), int(revision.late), len(versions))
            self.execute_many(insert_new(schema.revision), [row])
            versions.append(revision.reading)
            if not revision.late:
                self.use_version(revision.turbine, versions)

    def use_version(self, turbine: str, versions: Sequence[Reading]) -> None:
        """Make the version that the filter uses the observation of its stamp.

        versions: of one stamp, in the order of their arrival.  If none is used, the observation is marked as
        contradicted.
        """
        first, value = versions[0], used_value(versions)
        is_contradicted = math.isnan(value)
        used = first.value if is_contradicted else value
        stamp = {"turbine": turbine, "signal": first.signal, "time": first.time}
        self.execute(statements.USE_VERSION, **stamp, used=used, is_contradicted=int(is_contradicted))

    def add_turbines(self, models: Mapping[str, str]) -> None:
        """Register turbines; `models`: turbine → digest of its model.

        The filter state of a turbine whose model has changed is deleted, so that its stored readings are
        filtered again.
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
        """Write a row in a transaction of its own."""
        with self.transaction():
            self.execute_many(statement, [astuple(row)])

    # -- reading ---------------------------------------------------------------------------------------------
    def point(self, turbine: str) -> Point | None:
        """Return the newest final estimate of a turbine; None before the first."""
        row = self.first(select_rows(schema.point, "time state", "turbine"), turbine=turbine)
        return Point(row[0], state_of(row[1])) if row else None

    def models(self) -> dict[str, str]:
        """Return turbine → digest of its model."""
        return dict(self.rows(select_rows(schema.turbine, "name model", order="name")))

    def readings(self, turbine: str, since: float) -> list[Reading]:
        """Return the readings of a turbine that the filter may use: of each signal those from `since` [s] on
        and the last `BEFORE` earlier ones.

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
        """Return the time [s] of the earliest of a signal's last `BEFORE` readings before `since` [s];
        `since` itself without earlier readings."""
        times = self.rows(statements.BEFORE_TIME, turbine=turbine, signal=signal, before=since, most=BEFORE)
        return float(times[-1][0]) if times else since

    def versions(self, turbine: str, stamps: Iterable[tuple[str, float]]) -> Versions:
        """Return the versions at stamps (signal, time [s]), without stamps that are not stored."""
        versions: Versions = {}
        requested = set(stamps)
        times = sorted({at for _, at in requested})
        for first in range(0, len(times), TIMES_PER_QUERY):
            chunk = times[first : first + TIMES_PER_QUERY]
            rows = self.rows(statements.AT_TIMES, turbine=turbine, times=chunk)
            versions |= {(row[0], row[1]): [_reading(*row)] for row in rows if row[:2] in requested}
        revised = self.revised(turbine, times[0]) if versions else {}
        return versions | {stamp: values for stamp, values in revised.items() if stamp in versions}

    def revised(self, turbine: str, since: float = -math.inf) -> Versions:
        """Return the versions of all stamps with several values, from `since` [s] on."""
        versions: Versions = {}
        query = select_rows(
            schema.revision, "signal time value mark", "turbine", "signal time number", since=True
        )
        for signal, at, value, mark in self.rows(query, turbine=turbine, since=since):
            versions.setdefault((signal, at), []).append(_reading(signal, at, value, mark))
        return versions

    def losses(self, turbine: str) -> dict[str, list[tuple[float, float]]]:
        """Return signal → spans (begin, end) [s] without connection; the end is ∞ while it is lost."""
        losses: dict[str, list[tuple[float, float]]] = {}
        query = select_rows(schema.connection, "signal lost regained", "turbine", "signal lost")
        for signal, lost, regained in self.rows(query, turbine=turbine):
            losses.setdefault(signal, []).append((lost, math.inf if regained is None else regained))
        return losses

    def held(self, turbine: str, until: float = math.inf) -> list[Observation]:
        """Return the readings of a turbine that are held back because their stamps are ahead of the clock, up
        to the stamp `until` [s], sorted by time."""
        rows = self.rows(statements.HELD, turbine=turbine, until=until)
        return [Observation(name, _reading(*reading), received) for name, received, *reading in rows]

    def held_ahead(self) -> list[tuple[str, str, float]]:
        """Return (turbine, signal, time [s] from the last arrival to the latest stamp) of the readings that
        are held back."""
        rows = self.rows(statements.HELD_AHEAD)
        return [(turbine, signal, latest - arrival) for turbine, signal, latest, arrival in rows]

    def held_count(self, turbine: str) -> int:
        """Return the number of readings of a turbine that are held back."""
        return int(self.rows(count_rows(schema.held, "turbine"), turbine=turbine)[0][0])

    def newest_estimate(self, turbine: str) -> tuple[float, float | None] | None:
        """Return time [s] and probability of condensation [1] of the newest estimate; None without one."""
        row = self.first(select_newest(schema.estimate, "time condensation", "turbine"), turbine=turbine)
        return None if row is None else (row[0], row[1])

    def outlook(self, turbine: str) -> list[tuple[float, float]]:
        """Return (time [s], probability of condensation [1]) of a turbine's forecast."""
        return self.rows(statements.OUTLOOK, turbine=turbine)

    def assessments(self) -> dict[str, Assessment]:
        """Return turbine → assessment of its state."""
        return {row.turbine: row for row in self.records(Assessment, select_rows(schema.assessment))}

    def shelves(self, now: float) -> list[Shelf]:
        """Return the shelves that are in force at `now` [s]."""
        return self.records(Shelf, statements.SHELVES, now=now)

    def all_events(self) -> list[Event]:
        """Return the events at all turbines, in the order in which they were entered."""
        return self.records(Event, select_rows(schema.event, order="made id"))

    def events(self, turbine: str) -> list[Event]:
        """Return the events at a turbine, sorted by time."""
        return self.records(
            Event, select_rows(schema.event, same="turbine", order="time id"), turbine=turbine
        )

    def course(
        self, turbine: str, signals: Sequence[str], since: float, until: float
    ) -> list[tuple[str, float, float]]:
        """Return (signal, time [s], value [SI unit]) of the readings that the filter used, of some signals,
        from `since` to `until` [s], sorted by signal and time."""
        span = {"since": since, "until": until}
        return self.rows(statements.COURSE, turbine=turbine, signals=signals, **span)

    def weather(self, turbine: str, since: float) -> list[tuple[str, float, float]]:
        """Return (signal, time [s], value [SI unit]) of the turbine's own weather forecast or, without one,
        of that for all turbines, sorted by signal and time."""
        query = select_rows(schema.weather, "signal time value", "turbine", "signal time", since=True)
        return self.rows(query, turbine=turbine, since=since) or self.rows(query, turbine="", since=since)

    def memory(self, turbine: str, name: str) -> Json:
        """Return the JSON data stored under a name for a turbine's tracker; None without such data."""
        row = self.first(select_rows(schema.memory, "content", "turbine name"), turbine=turbine, name=name)
        return json.loads(row[0]) if row else None

    def memories(self, turbine: str) -> JsonObject:
        """Return name → JSON data from which a turbine's tracker resumes."""
        rows = self.rows(select_rows(schema.memory, "name content", "turbine"), turbine=turbine)
        return {name: json.loads(content) for name, content in rows}

    def signals(self, turbine: str) -> list[str]:
        """Return the signals of which the turbine has readings."""
        return [signal for (signal,) in self.rows(statements.SIGNALS_READ, turbine=turbine)]

    def place(self, url: str) -> str | None:
        """Return the position at which a source resumes; None if it was never read."""
        row = self.first(select_rows(schema.source, "place", "url"), url=url)
        return row[0] if row else None

    def counters(self) -> dict[tuple[str, str], int]:
        """Return (turbine, name) → count."""
        return {(turbine, name): int(n) for turbine, name, n in self.rows(select_rows(schema.counter))}

    def size(self) -> dict[str, int]:
        """Return table → number of rows."""
        return {name: int(self.rows(count_rows(table))[0][0]) for name, table in schema.TABLES.items()}


def _statements_of(batch: Batch) -> Iterator[tuple[ClauseElement, Iterable[Row]]]:
    """Yield the statements that write a batch without its observations, each with its rows of parameters."""
    yield insert_new(schema.held), [(*_reading_row(held), _mark(held)) for held in batch.held]
    yield delete_rows(schema.held, "turbine signal time"), [_reading_row(held)[:3] for held in batch.released]
    yield upsert(schema.connection), map(astuple, batch.losses)
    points = [(turbine, point.time, state_text(point.state)) for turbine, point in batch.points.items()]
    yield upsert(schema.point), points
    # the new estimates replace the provisional ones
    yield statements.PROVISIONAL, [(turbine, new.since) for turbine, new in batch.estimates.items()]
    estimates = (estimate_rows(turbine, new.condition, new.final) for turbine, new in batch.estimates.items())
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
        kept_from_s = min(observed.received for observed in batch.weather) - WEATHER_KEPT_S
        yield statements.OLD_WEATHER, [(kept_from_s,)]
    yield upsert(schema.weather, newer="received"), map(_reading_row, batch.weather)


def _reading_row(observation: Observation) -> Row:
    """Return (turbine, signal, time [s] from last arrival to latest stamp) of held readings."""
    reading = observation.reading
    return (observation.turbine, reading.signal, reading.time, reading.value, observation.received)


def _mark(observation: Observation) -> float | None:
    """Return the mark of a reading for the store: None without one."""
    mark = observation.reading.mark
    return None if math.isnan(mark) else mark


def _reading(signal: str, time: float, value: float, mark: float | None) -> Reading:
    """Return a reading from the columns of the store."""
    return Reading(signal, time, value, math.nan if mark is None else mark)


def state_text(state: Gaussian) -> str:
    """Return a Gaussian as JSON, from which `state_of` restores every bit."""
    return json.dumps({"mean": state.mean.tolist(), "covariance": np.asarray(state.covariance).tolist()})


def state_of(text: str) -> Gaussian:
    """Return the Gaussian of `state_text`."""
    data = json.loads(text)
    return Gaussian(np.array(data["mean"], dtype=float), np.array(data["covariance"], dtype=float))


def estimate_rows(turbine: str, condition: Condition, final: int) -> list[Row]:
    """Return rows of the table `estimate`, in the order of its columns; NaN becomes NULL.

    final: number of instants, from the first on, whose estimates are final.
    """
    count = len(condition.time_s)
    columns: list[list[Any]] = [
        [turbine] * count,
        condition.time_s.tolist(),
        [int(i < final) for i in range(count)],
    ]
    for displayed in DISPLAYED_QUANTITIES:
        quantity: Quantity | None = getattr(condition, displayed.column)
        columns += [[None] * count] * 2 if quantity is None else [_plain(quantity.value), _plain(quantity.sd)]
    columns.append([None] * count if condition.condensation is None else _plain(condition.condensation))
    return list(zip(*columns, strict=True))


def _plain(values: np.ndarray) -> list[float | None]:
    """Return numbers as a list; NaN becomes None."""
    return [None if math.isnan(value) else value for value in values.tolist()]


# -- retention -----------------------------------------------------------------------------------------------
MOST_DELETED = 1_000
"""Largest number of rows deleted at once, so that a deletion delays the tracker's loop only briefly."""


def prune(store: Store, turbine: str, before: float, needed: float, most: int = MOST_DELETED) -> int:
    """Delete at most `most` of a turbine's rows from before the time `before` [s]; returns the number of
    deleted rows, which is less than `most` if none remain.

    needed: time [s] from which a restart needs the readings; these, each signal's last `BEFORE` readings
    before that time, and open alarms are kept.
    """
    limit_s, count = min(before, needed), 0
    with store.transaction():
        for signal in store.signals(turbine):
            until = min(limit_s, store.first_needed(turbine, signal, needed))
            same = {"turbine": turbine, "signal": signal}
            count += _delete_oldest(store, schema.observation.c.time, until, most - count, same)
        for time_column in (
            schema.revision.c.time, schema.estimate.c.time, schema.property_.c.time, schema.alarm.c.ended,
            schema.connection.c.regained,
        ):  # fmt: skip
            count += _delete_oldest(store, time_column, limit_s, most - count, {"turbine": turbine})
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
