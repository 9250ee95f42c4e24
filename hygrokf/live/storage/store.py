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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple
from typing import Any, TypeVar

import numpy as np
from sqlalchemy import (
    CTE,
    ClauseElement,
    ColumnElement,
    FromClause,
    Table,
    bindparam,
    delete,
    func,
    literal_column,
    null,
    select,
    update,
)

from hygrokf.data.structured import Json, JsonObject
from hygrokf.data.timestamps import DAY_S
from hygrokf.estimation.likelihood import Gaussian
from hygrokf.live.batch import Assessment, Batch, Event, Notice, Observation, Shelf
from hygrokf.live.condition import QUANTITIES, Condition, Quantity
from hygrokf.live.plan import BEFORE
from hygrokf.live.storage import schema
from hygrokf.live.storage.database import Database, Row
from hygrokf.live.storage.database import StoreFault as StoreFault
from hygrokf.live.storage.postgres import SCHEMES, open_postgres
from hygrokf.live.storage.schema import inserting, matching, observation, replacing, revision
from hygrokf.live.storage.sqlite import open_sqlite, path_of
from hygrokf.live.tracker import Point, Reading, Versions, used_value

FORGOTTEN_S = 3 * DAY_S
"""[s] a value of a weather forecast is kept after its time."""
ASKED = 500
"""Stamps asked for in one query."""
ACKNOWLEDGED = ("acknowledged", "acknowledged_by", "cause", "note", "look_again")
"""Columns of an alarm that the page writes and the tracker leaves as they are."""
T = TypeVar("T")


# -- statements of every round, written once -----------------------------------------------------------------
def _given(rows: Table, *names: str) -> ColumnElement[bool]:
    """The condition that columns have the values of the parameters of their names."""
    return matching(rows, **{name: bindparam(name) for name in names})


_RELEASE = delete(schema.held).where(_given(schema.held, "turbine", "signal", "time"))
_FIRST_VERSION = inserting(revision).from_select(
    revision.c.keys(),
    select(*(observation.c[name] for name in revision.c.keys()[:-1]), literal_column("0")).where(
        _given(observation, "turbine", "signal", "time")
    ),
)
_PROVISIONAL = delete(schema.estimate).where(
    _given(schema.estimate, "turbine"),
    schema.estimate.c.time >= bindparam("since"),
    schema.estimate.c.final == literal_column("0"),
)
_REOPEN = (
    update(schema.alarm)
    .where(_given(schema.alarm, "id"))
    .values(acknowledged=null(), acknowledged_by=null(), look_again=null())
)
_EVENTS = select(schema.event).order_by(schema.event.c.made, schema.event.c.id)
_MEMORY = select(schema.memory.c.content).where(_given(schema.memory, "turbine", "name"))


def _signals() -> CTE:
    """The signals of a turbine's readings, by one index lookup each; DISTINCT would scan them all."""
    rows, known = observation.alias(), select(func.min(observation.c.signal).label("signal"))
    found = known.where(_given(observation, "turbine")).cte("known", recursive=True)
    following = select(func.min(rows.c.signal)).where(
        rows.c.turbine == bindparam("turbine"), rows.c.signal > found.c.signal
    )
    return found.union_all(select(following.scalar_subquery()).where(found.c.signal.is_not(None)))


_SIGNALS = select(_signals().c.signal)


class Store:
    """One store, in either database, whose statements, transactions and claims are its own; only one thread
    may use it at a time.

    An external error (disk, network, another process) is raised as StoreFault and may be gone once the store
    is reopened; an invalid statement or value raises the driver's own exception.
    """

    def __init__(self, database: Database) -> None:
        self.database, self.url = database, database.url
        self.rows, self.execute, self.execute_many = database.rows, database.execute, database.execute_many
        self.transaction, self.claim, self.close = database.transaction, database.claim, database.close

    def found(self, kind: type[T], statement: ClauseElement) -> list[T]:
        """The rows of a query of a table whose columns are the fields of a kind."""
        return [kind(*row) for row in self.rows(statement)]

    # -- writing ---------------------------------------------------------------------------------------------
    def commit(self, batch: Batch) -> None:
        """Write a batch completely or not at all."""
        with self.transaction():
            self.write(batch)

    def write(self, batch: Batch) -> None:
        """Write a batch within a transaction."""
        self._write_observations(batch)
        self._write_estimates(batch)
        self._write_findings(batch)
        self._write_forecasts(batch)

    def _put(self, table: Table, rows: Iterable[Any]) -> None:
        """Insert dataclasses or tuples as rows, in place of those with their keys."""
        self.execute_many(replacing(table), [one if isinstance(one, tuple) else astuple(one) for one in rows])

    def _write_observations(self, batch: Batch) -> None:
        """Write readings and filter points; of a stamp with several values the one that counts is written,
        and every version is kept beside it."""
        first = [(*_marked_row(one), int(one.late), 0) for one in batch.observations if not one.revision]
        self.execute_many(inserting(observation), first)
        self._write_revisions([one for one in batch.observations if one.revision])
        self.execute_many(inserting(schema.held), map(_marked_row, batch.held))
        self.execute_many(_RELEASE, [_reading_row(one)[:3] for one in batch.released])
        self._put(schema.connection, batch.losses)
        self._put(schema.point, [(name, p.time, state_text(p.state)) for name, p in batch.points.items()])

    def _write_revisions(self, revisions: Sequence[Observation]) -> None:
        """Add versions of values to those of their stamps, and use those that count and come in time."""
        stamps: dict[str, list[tuple[str, float]]] = {}
        for one in revisions:
            stamps.setdefault(one.turbine, []).append((one.reading.signal, one.reading.time))
        known = {turbine: self.versions(turbine, own) for turbine, own in stamps.items()}
        self.execute_many(_FIRST_VERSION, [_reading_row(one)[:3] for one in revisions])
        for one in revisions:
            versions = known[one.turbine][one.reading.signal, one.reading.time]
            self.execute_many(inserting(revision), [(*_marked_row(one), int(one.late), len(versions))])
            versions.append(one.reading)
            if not one.late:
                self.use(one.turbine, versions)

    def use(self, turbine: str, versions: Sequence[Reading]) -> None:
        """Let the version of a stamp that counts be the observation."""
        value, first = used_value(versions), versions[0]
        stamp = {"turbine": turbine, "signal": first.signal, "time": first.time}
        used = first.value if math.isnan(value) else value
        version = select(revision.c.received, revision.c.mark).where(matching(revision, **stamp, value=used))
        ((received, mark),) = self.rows(version)
        changed = {"contradicted": int(math.isnan(value)), "value": used, "received": received, "mark": mark}
        self.execute(update(observation).where(matching(observation, **stamp)).values(changed))

    def _write_estimates(self, batch: Batch) -> None:
        """Write estimates in place of the provisional ones."""
        self.execute_many(_PROVISIONAL, [(turbine, one.since) for turbine, one in batch.estimates.items()])
        rows: list[Row] = []
        for turbine, one in batch.estimates.items():
            finals = [int(i < one.final) for i in range(len(one.condition.time_s))]
            rows += air_rows(turbine, one.condition, finals)
        self._put(schema.estimate, rows)

    def _write_findings(self, batch: Batch) -> None:
        """Write properties, alarms, states of turbines, notices, the data that trackers and sources resume
        from, and counters."""
        self._put(
            schema.property_,
            [
                (turbine, p.name, at, p.unit, p.value, p.lower, p.upper, p.reference, int(p.observable))
                for turbine, at, properties in batch.properties
                for p in properties
            ],
        )
        self.execute_many(replacing(schema.alarm, *ACKNOWLEDGED), map(astuple, batch.alarms))
        self._put(schema.assessment, batch.assessments)
        self.execute_many(_REOPEN, [(alarm.id,) for alarm in batch.reopened])
        self.execute_many(inserting(schema.outbox), map(astuple, batch.notices))
        self._put(schema.memory, [(*key, json.dumps(data)) for key, data in batch.memories.items()])
        counts = [(*key, count) for key, count in batch.counters.items() if count]
        self.execute_many(replacing(schema.counter, added="count"), counts)
        self._put(schema.source, batch.place.items())

    def _write_forecasts(self, batch: Batch) -> None:
        """Write the cabinets' forecasts, and the weather forecasts that they are based on."""
        for turbine, made in batch.forecasts.items():
            self.execute(delete(schema.forecast).where(schema.forecast.c.turbine == turbine))
            if made is not None:
                instants = [made.made_s] * len(made.condition.time_s)
                self._put(schema.forecast, air_rows(turbine, made.condition, instants, _plain(made.above)))
        if batch.weather:  # forecast values of the past are of no use
            old = min(one.received for one in batch.weather) - FORGOTTEN_S
            self.execute(delete(schema.weather).where(schema.weather.c.time < old))
        self.execute_many(replacing(schema.weather, newer="received"), map(_reading_row, batch.weather))

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
                        self.execute(delete(table).where(table.c.turbine == name))
            rows = [(name, digest, time.time()) for name, digest in models.items()]
            self.execute_many(replacing(schema.turbine, "added"), rows)

    # -- what people state -----------------------------------------------------------------------------------
    def acknowledge(
        self,
        alarm: str,
        by: str,
        at: float,
        cause: str = "unexplained",
        note: str = "",
        look_again: float | None = None,
        notices: Iterable[Notice] = (),
    ) -> bool:
        """Acknowledge an alarm at a time [s] with its cause (one of `batch.CAUSES`), to be looked at again at
        `look_again` [s]; write its notices.

        Returns False if there is no such alarm or it was acknowledged before.
        """
        stated = dict(zip(ACKNOWLEDGED, (at, by, cause, note, look_again), strict=True))
        unacknowledged = matching(schema.alarm, id=alarm, acknowledged=None)
        with self.transaction():
            changed = self.execute(update(schema.alarm).where(unacknowledged).values(stated)) == 1
            if changed:
                self.execute_many(inserting(schema.outbox), map(astuple, notices))
        return changed

    def shelve(self, shelf: Shelf) -> None:
        """Shelve a turbine's alarms of one kind, in place of an earlier shelf of that kind."""
        self._put(schema.shelf, [shelf])

    def unshelve(self, turbine: str, kind: str) -> bool:
        """End a shelf early; False if there is none."""
        own = matching(schema.shelf, turbine=turbine, kind=kind)
        return self.execute(delete(schema.shelf).where(own)) == 1

    def note_event(self, event: Event) -> None:
        """Write an event, in place of one with its id."""
        self._put(schema.event, [event])

    # -- reading ---------------------------------------------------------------------------------------------
    def models(self) -> dict[str, str]:
        """Turbine → digest of the model that tracks it."""
        return dict(self.rows(select(schema.turbine.c.name, schema.turbine.c.model)))

    def point(self, turbine: str) -> Point | None:
        table = schema.point
        found = self.rows(select(table.c.time, table.c.state).where(table.c.turbine == turbine))
        return Point(found[0][0], state_of(found[0][1])) if found else None

    def readings(self, turbine: str, since: float) -> list[Reading]:
        """Readings of a turbine that the filter may use: those from `since` [s] on and each signal's last
        `BEFORE` before it, by one index lookup per signal, however long the history is.

        The value is NaN where two readings contradict each other.
        """
        found: list[Reading] = []
        o = observation.c
        for signal in self.signals(turbine):
            own = matching(observation, turbine=turbine, signal=signal, late=0)
            before = select(o.time).where(own, o.time < since).order_by(o.time.desc()).limit(BEFORE)
            edges = self.rows(before)
            begin = edges[-1][0] if edges else since
            rows = select(o.time, o.value, o.mark, o.contradicted).where(own, o.time >= begin)
            found += [
                _reading(signal, at, math.nan if wrong else value, mark)
                for at, value, mark, wrong in self.rows(rows.order_by(o.time))
            ]
        return found

    def versions(self, turbine: str, stamps: Iterable[tuple[str, float]]) -> Versions:
        """The versions of the values of some stamps (signal, time [s]), but for those that are not known."""
        found: Versions = {}
        wanted = set(stamps)
        times = sorted({time for _, time in wanted})
        o = observation.c
        for first in range(0, len(times), ASKED):
            asked = o.time.in_(times[first : first + ASKED])
            rows = self.rows(select(o.signal, o.time, o.value, o.mark).where(o.turbine == turbine, asked))
            found |= {(row[0], row[1]): [_reading(*row)] for row in rows if row[:2] in wanted}
        revised = self.revised(turbine, times[0]) if found else {}
        return found | {stamp: known for stamp, known in revised.items() if stamp in found}

    def revised(self, turbine: str, since: float = -math.inf) -> Versions:
        """The versions of all stamps from `since` [s] on that had several values."""
        found: Versions = {}
        r = revision.c
        rows = select(r.signal, r.time, r.value, r.mark).where(r.turbine == turbine, r.time >= since)
        for signal, at, value, mark in self.rows(rows.order_by(r.signal, r.time, r.number)):
            found.setdefault((signal, at), []).append(_reading(signal, at, value, mark))
        return found

    def losses(self, turbine: str) -> dict[str, list[tuple[float, float]]]:
        """Spans [s] in which the connection of each signal of a turbine was lost, ∞ as an end to come."""
        found: dict[str, list[tuple[float, float]]] = {}
        c = schema.connection.c
        rows = select(c.signal, c.lost, c.regained).where(c.turbine == turbine).order_by(c.signal, c.lost)
        for signal, lost, regained in self.rows(rows):
            found.setdefault(signal, []).append((lost, math.inf if regained is None else regained))
        return found

    def held(self, turbine: str | None = None, until: float = math.inf) -> list[Observation]:
        """Readings of a turbine (None: of all) that came with stamps ahead of the clock and are from before
        `until` [s], by time."""
        h = schema.held.c
        rows = select(h.turbine, h.signal, h.time, h.value, h.mark, h.received).where(h.time <= until)
        if turbine is not None:
            rows = rows.where(h.turbine == turbine)
        found = self.rows(rows.order_by(h.time, h.turbine, h.signal, h.received))
        return [Observation(name, _reading(*reading), received) for name, *reading, received in found]

    def held_ahead(self) -> list[tuple[str, str, float]]:
        """(turbine, signal, time [s] from the last arrival to the latest stamp) of readings that are held
        back."""
        h = schema.held.c
        rows = select(h.turbine, h.signal, func.max(h.time), func.max(h.received))
        found = self.rows(rows.group_by(h.turbine, h.signal))
        return [(turbine, signal, latest - arrival) for turbine, signal, latest, arrival in found]

    def held_count(self, turbine: str) -> int:
        """Number of readings that are held back for one turbine."""
        return self.count(schema.held, schema.held.c.turbine == turbine)

    def count(self, table: FromClause, *conditions: ColumnElement[bool]) -> int:
        """Number of rows of a table."""
        return int(self.rows(select(func.count()).select_from(table).where(*conditions))[0][0])

    def newest(self, table: Table, turbine: str) -> float | None:
        """The newest time [s] of a turbine's rows; None without any."""
        newest: float | None
        ((newest,),) = self.rows(select(func.max(table.c.time)).where(table.c.turbine == turbine))
        return newest

    def newest_estimate(self, turbine: str) -> tuple[float, float | None] | None:
        """Time [s] and probability of condensation [1] of a turbine's newest estimate; None without any."""
        e = schema.estimate.c
        newest = select(e.time, e.condensation).where(e.turbine == turbine).order_by(e.time.desc()).limit(1)
        return next(iter(self.rows(newest)), None)

    def outlook(self, turbine: str) -> list[tuple[float, float]]:
        """Times [s] and probabilities of condensation [1] of a turbine's forecast."""
        f = schema.forecast.c
        known = f.turbine == turbine, f.condensation.is_not(None)
        return self.rows(select(f.time, f.condensation).where(*known).order_by(f.time))

    def assessments(self) -> dict[str, Assessment]:
        """The state of each turbine."""
        return {one.turbine: one for one in self.found(Assessment, select(schema.assessment))}

    def shelves(self, now: float) -> list[Shelf]:
        """Shelves that hold at `now` [s]."""
        s = schema.shelf.c
        return self.found(Shelf, select(schema.shelf).where(s.until > now).order_by(s.turbine, s.kind))

    def all_events(self) -> list[Event]:
        """Events at all turbines, by the time at which they were stated."""
        return self.found(Event, _EVENTS)

    def events(self, turbine: str, since: float = -math.inf) -> list[Event]:
        """Events at a turbine from `since` [s] on, by time."""
        e = schema.event.c
        own = e.turbine == turbine, e.time >= since
        return self.found(Event, select(schema.event).where(*own).order_by(e.time, e.id))

    def course(
        self, turbine: str, signals: Sequence[str], since: float, until: float
    ) -> list[tuple[str, float, float]]:
        """(signal, time [s], value) of some signals from `since` to `until` [s] that the filter used, sorted
        by signal and time."""
        o = observation.c
        used = matching(observation, turbine=turbine, contradicted=0, late=0), o.signal.in_(signals)
        rows = select(o.signal, o.time, o.value).where(*used, o.time >= since, o.time <= until)
        return self.rows(rows.order_by(o.signal, o.time))

    def weather(self, turbine: str, since: float) -> list[tuple[str, float, float]]:
        """(signal, time [s], value) of the turbine's weather forecast, else of the common one, by signal and
        time."""
        w = schema.weather.c
        rows = select(w.signal, w.time, w.value).where(w.time >= since).order_by(w.signal, w.time)
        return self.rows(rows.where(w.turbine == turbine)) or self.rows(rows.where(w.turbine == ""))

    def memory(self, turbine: str, name: str) -> Json:
        """JSON data that a turbine's tracker resumes from; None if there is none of that name."""
        found = self.rows(_MEMORY, turbine=turbine, name=name)
        return json.loads(found[0][0]) if found else None

    def memories(self, turbine: str) -> JsonObject:
        """All JSON data that a turbine's tracker resumes from, by name."""
        m = schema.memory.c
        found = self.rows(select(m.name, m.content).where(m.turbine == turbine))
        return {name: json.loads(content) for name, content in found}

    def signals(self, turbine: str) -> list[str]:
        """Signals of a turbine's readings."""
        return [signal for (signal,) in self.rows(_SIGNALS, turbine=turbine) if signal is not None]

    def place(self, url: str) -> str | None:
        """Position at which a source resumes; None if it was never read."""
        found = self.rows(select(schema.source.c.place).where(schema.source.c.url == url))
        return found[0][0] if found else None

    def counters(self) -> dict[tuple[str, str], int]:
        return {(turbine, name): int(n) for turbine, name, n in self.rows(select(schema.counter))}

    def size(self) -> dict[str, int]:
        """Number of rows of each table but the one that states the schema's number."""
        tables = [one for one in schema.METADATA.tables.values() if one is not schema.schema_version]
        return {table.name: self.count(table) for table in tables}


def _reading_row(one: Observation) -> Row:
    """The row of a reading, in the order of `READING_COLUMNS`."""
    return (one.turbine, one.reading.signal, one.reading.time, one.reading.value, one.received)


def _marked_row(one: Observation) -> Row:
    """The row of a reading, in the order of `MARKED_COLUMNS`."""
    mark = one.reading.mark
    return (*_reading_row(one), None if math.isnan(mark) else mark)


def _reading(signal: str, time: float, value: float, mark: float | None) -> Reading:
    return Reading(signal, time, value, math.nan if mark is None else mark)


def state_text(state: Gaussian) -> str:
    """A Gaussian as JSON that restores every bit."""
    return json.dumps({"mean": state.mean.tolist(), "covariance": np.asarray(state.covariance).tolist()})


def state_of(text: str) -> Gaussian:
    data = json.loads(text)
    return Gaussian(np.array(data["mean"], dtype=float), np.array(data["covariance"], dtype=float))


def air_rows(
    turbine: str, air: Condition, third: Sequence[float], *more: Sequence[float | None]
) -> list[Row]:
    """Rows of the estimate or forecast table, whose `third` column differs; NaN becomes NULL."""
    none = [None] * len(air.time_s)
    columns: list[Sequence[Any]] = [[turbine] * len(none), air.time_s.tolist(), third]
    for row in QUANTITIES:
        quantity: Quantity | None = getattr(air, row.column)
        columns += [none, none] if quantity is None else [_plain(quantity.value), _plain(quantity.sd)]
    columns.append(none if air.condensation is None else _plain(air.condensation))
    return list(zip(*columns, *more, strict=True))


def _plain(values: np.ndarray) -> list[float | None]:
    return [v if v == v else None for v in values.tolist()]


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
