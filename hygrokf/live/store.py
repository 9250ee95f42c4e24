"""Where observations, estimates, states and the source's place are kept, together or not at all.

A `Batch` is what one round of the tracker found; `Store.commit` writes it in one transaction, so that after a crash
everything is as it was after some whole batch, and the source goes on from there.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hygrokf.likelihood import Gaussian
from hygrokf.live.condition import Condition, Quantity
from hygrokf.live.properties import Property
from hygrokf.live.schema import MIGRATIONS, TABLES, VERSION
from hygrokf.live.tracker import Point, Reading

APPLICATION_ID = 0x68796B66
"""What a store's file says it is ("hykf"), so that no other database is taken for one."""
BUSY_S = 10.0


class StoreFault(Exception):
    """A store that cannot be used, in words for the one who runs it."""


@dataclass(frozen=True)
class Observation:
    """A reading of a turbine, when it was received [s], and whether it came too late to be used."""

    turbine: str
    reading: Reading
    received: float
    late: bool = False


@dataclass(frozen=True)
class Alarm:
    """An alarm: `began`, `ended`, `acknowledged` [s]; `severity` "notice", "warning" or "alarm"."""

    id: str
    turbine: str
    kind: str
    severity: str
    began: float
    statement: str
    remedy: str
    ended: float | None = None
    acknowledged: float | None = None
    acknowledged_by: str | None = None


@dataclass
class Batch:
    """What one round found.

    `estimates` turbine → (condition, how many of its instants are final, time [s] from which on it overtakes what was
    provisional); `memories` (turbine, name) → plain data that a
    turbine's tracker goes on from; `counters` (turbine, name) → increase; `place` source → where it is to go on.
    """

    observations: list[Observation] = field(default_factory=list)
    points: dict[str, Point] = field(default_factory=dict)
    estimates: dict[str, tuple[Condition, int, float]] = field(default_factory=dict)
    properties: list[tuple[str, float, Sequence[Property]]] = field(default_factory=list)
    alarms: list[Alarm] = field(default_factory=list)
    memories: dict[tuple[str, str], object] = field(default_factory=dict)
    counters: dict[tuple[str, str], int] = field(default_factory=dict)
    place: dict[str, str] = field(default_factory=dict)


_QUANTITIES = (
    ("temperature_K", "temperature_sd"),
    ("relative_humidity", "relative_humidity_sd"),
    ("absolute_humidity_g_m3", "absolute_humidity_sd"),
    ("dew_point_K", "dew_point_sd"),
    ("frost_point_K", "frost_point_sd"),
    ("margin_K", "margin_sd"),
)
ESTIMATE_COLUMNS = (
    "turbine", "time", "final", *(name for pair in _QUANTITIES for name in pair), "condensation"
)  # fmt: skip


class Store:
    """One store; `commit` and the readers may be used by one thread at a time.

    `connection` speaks the database interface of Python (PEP 249); `mark` is its sign for a parameter.
    """

    def __init__(self, connection: object, mark: str, url: str) -> None:
        self.connection = connection
        self.mark = mark
        self.url = url

    # -- plain statements -------------------------------------------------------------------------------------
    def _text(self, statement: str) -> str:
        return statement if self.mark == "?" else statement.replace("?", self.mark)

    def rows(self, statement: str, parameters: Sequence = ()) -> list[tuple]:
        """Rows of a query; parameters stand as question marks in every store."""
        with self.transaction(write=False) as cursor:
            cursor.execute(self._text(statement), tuple(parameters))
            return cursor.fetchall()

    @contextmanager
    def transaction(self, write: bool = True) -> Iterator:
        """A cursor whose statements take effect together, when the block ends, or not at all."""
        cursor = self.connection.cursor()
        try:
            if self.mark == "?" and write:
                cursor.execute("BEGIN IMMEDIATE")
            yield cursor
            self.connection.commit()
        except BaseException:
            with suppress(Exception):
                self.connection.rollback()
            raise
        finally:
            with suppress(Exception):
                cursor.close()

    def migrate(self) -> None:
        """Bring the tables to this version, each migration in a transaction of its own."""
        with self.transaction() as cursor:
            cursor.execute(
                "CREATE TABLE IF NOT EXISTS schema_version (version INTEGER PRIMARY KEY, applied DOUBLE PRECISION)"
            )
        found = self.rows("SELECT MAX(version) FROM schema_version")[0][0] or 0
        if found > VERSION:
            raise StoreFault(
                f"{self.url}: expected a schema of version {VERSION} or older, found {found}: "
                "it was written by a newer hygrokf; update this one"
            )
        for version in range(found, VERSION):
            with self.transaction() as cursor:
                for statement in MIGRATIONS[version]:
                    cursor.execute(statement)
                cursor.execute(
                    self._text("INSERT INTO schema_version (version, applied) VALUES (?, ?)"),
                    (version + 1, time.time()),
                )

    # -- writing ----------------------------------------------------------------------------------------------
    def commit(self, batch: Batch) -> None:
        """Write a batch, whole or not at all."""
        with self.transaction() as cursor:
            self._many(
                cursor,
                "INSERT INTO observation (turbine, signal, time, value, received, late, contradicted) "
                "VALUES (?, ?, ?, ?, ?, ?, 0) ON CONFLICT (turbine, signal, time) DO UPDATE SET contradicted = "
                "CASE WHEN observation.value = excluded.value OR excluded.late = 1 THEN observation.contradicted ELSE 1 END",
                [
                    (o.turbine, o.reading.signal, o.reading.time, o.reading.value, o.received, int(o.late))
                    for o in batch.observations
                ],
            )
            self._many(
                cursor,
                "INSERT INTO point (turbine, time, state) VALUES (?, ?, ?) "
                "ON CONFLICT (turbine) DO UPDATE SET time = excluded.time, state = excluded.state",
                [(turbine, p.time, state_text(p.state)) for turbine, p in batch.points.items()],
            )
            names = ", ".join(ESTIMATE_COLUMNS)
            marks = ", ".join("?" * len(ESTIMATE_COLUMNS))
            changed = ", ".join(f"{n} = excluded.{n}" for n in ESTIMATE_COLUMNS[2:])
            for turbine, (found, final, since) in batch.estimates.items():
                cursor.execute(
                    self._text("DELETE FROM estimate WHERE turbine = ? AND time >= ? AND final = 0"),
                    (turbine, since),
                )
                self._many(
                    cursor,
                    f"INSERT INTO estimate ({names}) VALUES ({marks}) "
                    f"ON CONFLICT (turbine, time) DO UPDATE SET {changed}",
                    estimate_rows(turbine, found, final),
                )
            self._many(
                cursor,
                "INSERT INTO property (turbine, time, name, unit, value, lower_bound, upper_bound, reference, observable) "
                "VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT (turbine, name, time) DO UPDATE SET "
                "value = excluded.value, lower_bound = excluded.lower_bound, upper_bound = excluded.upper_bound, "
                "observable = excluded.observable",
                [
                    (turbine, at, p.name, p.unit, p.value, p.lower, p.upper, p.reference, int(p.observable))
                    for turbine, at, found in batch.properties
                    for p in found
                ],
            )
            self._many(
                cursor,
                "INSERT INTO alarm (id, turbine, kind, severity, began, ended, acknowledged, acknowledged_by, statement, "
                "remedy) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT (id) DO UPDATE SET severity = excluded.severity, "
                "ended = excluded.ended, statement = excluded.statement, remedy = excluded.remedy",
                [
                    (a.id, a.turbine, a.kind, a.severity, a.began, a.ended, a.acknowledged, a.acknowledged_by,
                     a.statement, a.remedy)
                    for a in batch.alarms
                ],
            )  # fmt: skip
            self._many(
                cursor,
                "INSERT INTO memory (turbine, name, content) VALUES (?, ?, ?) "
                "ON CONFLICT (turbine, name) DO UPDATE SET content = excluded.content",
                [(turbine, name, json.dumps(data)) for (turbine, name), data in batch.memories.items()],
            )
            self._many(
                cursor,
                "INSERT INTO counter (turbine, name, count) VALUES (?, ?, ?) "
                "ON CONFLICT (turbine, name) DO UPDATE SET count = counter.count + excluded.count",
                [(turbine, name, count) for (turbine, name), count in batch.counters.items() if count],
            )
            self._many(
                cursor,
                "INSERT INTO source (url, place) VALUES (?, ?) ON CONFLICT (url) DO UPDATE SET place = excluded.place",
                list(batch.place.items()),
            )

    def _many(self, cursor, statement: str, rows: Sequence[tuple]) -> None:
        if rows:
            cursor.executemany(self._text(statement), rows)

    def add_turbines(self, models: Mapping[str, str]) -> None:
        """Turbines with the digest of the model that they are tracked with.

        A turbine that was tracked with another model begins anew from its observations: its point is another model's.
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

    def acknowledge(self, alarm: str, by: str, at: float) -> bool:
        """Mark an alarm as seen; False where there is no such alarm, or it was acknowledged before."""
        with self.transaction() as cursor:
            cursor.execute(
                self._text(
                    "UPDATE alarm SET acknowledged = ?, acknowledged_by = ? WHERE id = ? AND acknowledged IS NULL"
                ),
                (at, by, alarm),
            )
            return cursor.rowcount == 1

    def prune(self, before: float) -> int:
        """Delete observations, estimates and properties older than `before` [s]; how many rows that were.

        What a restart needs is kept: nothing after a turbine's point less the tracker's look back is touched, because the
        caller's retention is longer than that.
        """
        count = 0
        with self.transaction() as cursor:
            for table in ("observation", "estimate", "property"):
                cursor.execute(self._text(f"DELETE FROM {table} WHERE time < ?"), (before,))
                count += max(cursor.rowcount, 0)
            cursor.execute(self._text("DELETE FROM alarm WHERE ended IS NOT NULL AND ended < ?"), (before,))
            count += max(cursor.rowcount, 0)
        return count

    # -- reading ----------------------------------------------------------------------------------------------
    def point(self, turbine: str) -> Point | None:
        found = self.rows("SELECT time, state FROM point WHERE turbine = ?", (turbine,))
        return Point(found[0][0], state_of(found[0][1])) if found else None

    def readings(self, turbine: str, since: float) -> list[Reading]:
        """Readings of a turbine that the filter may use: those from a time [s] on, and of each signal the last before it.

        NaN where two contradict each other.
        """
        found = self.rows(
            "SELECT o.signal, o.time, o.value, o.contradicted FROM observation o JOIN "
            "(SELECT signal, MAX(time) AS time FROM observation WHERE turbine = ? AND time < ? AND late = 0 GROUP BY signal) "
            "l ON o.signal = l.signal AND o.time = l.time WHERE o.turbine = ?",
            (turbine, since, turbine),
        )
        found += self.rows(
            "SELECT signal, time, value, contradicted FROM observation WHERE turbine = ? AND time >= ? AND late = 0 "
            "ORDER BY signal, time",
            (turbine, since),
        )
        return [Reading(signal, at, float("nan") if wrong else value) for signal, at, value, wrong in found]

    def memory(self, turbine: str, name: str) -> object:
        found = self.rows("SELECT content FROM memory WHERE turbine = ? AND name = ?", (turbine, name))
        return json.loads(found[0][0]) if found else None

    def place(self, url: str) -> str | None:
        """Where a source is to go on; None for one that was never read."""
        found = self.rows("SELECT place FROM source WHERE url = ?", (url,))
        return found[0][0] if found else None

    def counters(self) -> dict[tuple[str, str], int]:
        return {
            (turbine, name): int(n)
            for turbine, name, n in self.rows("SELECT turbine, name, count FROM counter")
        }

    def size(self) -> dict[str, int]:
        """Rows of every table."""
        return {table: int(self.rows(f"SELECT COUNT(*) FROM {table}")[0][0]) for table in TABLES}

    def close(self) -> None:
        with suppress(Exception):
            self.connection.close()


def state_text(state: Gaussian) -> str:
    """A Gaussian as JSON, of which every bit comes back."""
    return json.dumps({"mean": state.mean.tolist(), "covariance": np.asarray(state.covariance).tolist()})


def state_of(text: str) -> Gaussian:
    data = json.loads(text)
    return Gaussian(np.array(data["mean"], dtype=float), np.array(data["covariance"], dtype=float))


def estimate_rows(turbine: str, found: Condition, final: int) -> Iterable[tuple]:
    """Rows of the estimate table, in the order of `ESTIMATE_COLUMNS`; what is no number is NULL."""
    count = len(found.time_s)
    columns: list[list] = [[turbine] * count, found.time_s.tolist(), [int(i < final) for i in range(count)]]
    for name, _ in _QUANTITIES:
        quantity: Quantity | None = getattr(found, name)
        columns += [[None] * count] * 2 if quantity is None else [_plain(quantity.value), _plain(quantity.sd)]
    columns.append([None] * count if found.condensation is None else _plain(found.condensation))
    return list(zip(*columns, strict=True))


def _plain(values: np.ndarray) -> list[float | None]:
    return [v if v == v else None for v in values.tolist()]


# -- opening ---------------------------------------------------------------------------------------------------------
def open_store(url: str) -> Store:
    """The store at `sqlite:PATH`, brought to this version.

    Raises StoreFault, in words, where it is no store, is damaged or cannot be reached.  Nothing is overwritten.
    """
    if url.startswith("sqlite:"):
        return _sqlite(Path(url.removeprefix("sqlite:").removeprefix("//")))
    raise StoreFault(f"expected a store as sqlite:PATH, found {url!r}")


def _sqlite(path: Path) -> Store:
    if not path.parent.is_dir():
        raise StoreFault(f"{path}: the folder {path.parent} does not exist; make it, or name another place")
    fresh = not path.exists() or path.stat().st_size == 0
    url = f"sqlite:{path}"
    connection = None
    try:
        connection = sqlite3.connect(path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
        if not fresh:
            _examine(connection, path)
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=FULL")
        connection.execute("PRAGMA foreign_keys=ON")
        connection.execute(f"PRAGMA application_id={APPLICATION_ID}")
        store = Store(connection, "?", url)
        store.migrate()
        return store
    except (sqlite3.Error, StoreFault) as fault:
        if connection is not None:
            connection.close()
        if isinstance(fault, StoreFault):
            raise
        raise StoreFault(
            f"{path}: this is no store that can be read ({fault}); nothing was written to it. "
            "Put it aside and restore a copy, or name a new file"
        ) from fault


def _examine(connection: sqlite3.Connection, path: Path) -> None:
    """Refuse what is damaged or not a store."""
    said = connection.execute("PRAGMA application_id").fetchone()[0]
    if said != APPLICATION_ID:
        raise StoreFault(f"{path}: expected a store of hygrokf, found another database; name another file")
    faults = [row[0] for row in connection.execute("PRAGMA quick_check(5)")]
    if faults != ["ok"]:
        raise StoreFault(
            f"{path}: the store is damaged ({'; '.join(faults)}); nothing was written to it. "
            "Put it aside and restore a copy, or name a new file"
        )
