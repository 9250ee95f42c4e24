"""The store's tables and views, as numbered migrations.

Times are seconds since 1970, UTC, as double precision; in PostgreSQL those of the large tables (`TIMESTAMPS`)
are `timestamptz`, by which a table can be partitioned.  Values are in SI units, absolute humidity in g/m³.
The views are for people and plotting tools: timestamps, °C and %, lower-case names.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from hygrokf.live.condition import QUANTITIES, Z95

TIMESTAMPS: Mapping[str, tuple[str, ...]] = {
    "observation": ("time", "received"),
    "revision": ("time", "received"),
    "held": ("time", "received"),
    "weather": ("time", "received"),
    "estimate": ("time",),
    "forecast": ("time", "made"),
    "property": ("time",),
    "event": ("time",),
}
"""Table -> its columns that are `timestamptz` in PostgreSQL.  `point.time` is not: it restores every bit."""
_KEYS = {
    "observation": ("turbine", "signal"),
    "held": ("turbine", "signal"),
    "weather": ("turbine", "signal"),
    "estimate": ("turbine",),
    "forecast": ("turbine",),
    "property": ("turbine", "name"),
}
"""Table -> the columns of its key beside `time`."""


@dataclass(frozen=True)
class Dialect:
    """The SQL of one database.

    `words`: templates that the views use as WORD(column).  UTC: a time [s] as the database's own timestamp,
    or ISO 8601 text where it has no such type; STAMP: the same of a column of `TIMESTAMPS`; HOUR: the
    beginning of the hour of such a column.  `time`: the template of a parameter [s] that stands for such a
    column.  `migrations`: version -> statements that only this database needs.
    """

    words: Mapping[str, str]
    time: str = "?"
    migrations: Mapping[int, tuple[str, ...]] = field(default_factory=dict)


def _as_timestamps() -> tuple[str, ...]:
    """Statements that make timestamps, with microseconds, of seconds as double precision.

    Of rows whose times are the same to the microsecond, the first is kept: the filter merges readings within
    a millisecond.
    """
    merged = (
        f"DELETE FROM {table} a USING {table} b WHERE {' AND '.join(f'a.{name} = b.{name}' for name in key)} "
        "AND to_timestamp(a.time) = to_timestamp(b.time) AND a.time > b.time"
        for table, key in _KEYS.items()
    )
    changed = (
        f"ALTER TABLE {table} "
        + ", ".join(f"ALTER {name} TYPE TIMESTAMPTZ USING to_timestamp({name})" for name in columns)
        for table, columns in TIMESTAMPS.items()
        if table != "revision"  # made later, with the types of then
    )
    return *merged, *changed


SQLITE = Dialect(
    {
        "UTC": "strftime('%Y-%m-%dT%H:%M:%fZ', {}, 'unixepoch')",
        "STAMP": "strftime('%Y-%m-%dT%H:%M:%fZ', {}, 'unixepoch')",
        "HOUR": "CAST({} / 3600 AS INTEGER) * 3600.0",
    },
    migrations={
        4: (
            "UPDATE OR REPLACE observation SET time = round(time * 1e6) / 1e6 "
            "WHERE time <> round(time * 1e6) / 1e6",
        )
    },
)
POSTGRESQL = Dialect(
    {"UTC": "to_timestamp({})", "STAMP": "{}", "HOUR": "date_trunc('hour', {}, 'UTC')"},
    "to_timestamp(?)",
    {4: _as_timestamps()},
)


def _readable() -> dict[str, str]:
    """The condition in everyday units with 95 % bounds: column of the view -> SQL expression."""
    columns = {}
    for q in QUANTITIES:
        value = f"{q.factor} * {q.column} + ({q.offset})"
        columns[f"{q.name}_{q.unit}"] = value
        columns[f"{q.name}_lower_{q.unit}"] = f"{value} - {Z95 * q.factor} * {q.sd_column}"
        columns[f"{q.name}_upper_{q.unit}"] = f"{value} + {Z95 * q.factor} * {q.sd_column}"
    return {**columns, "condensation_percent": "100.0 * condensation"}


READABLE_COLUMNS = tuple(_readable())
"""Columns of `estimate_readable` and `forecast_readable` that describe the cabinet air."""
_CONDITION = ", ".join(f"{value} AS {name}" for name, value in _readable().items())
_RANK = "CASE severity WHEN 'alarm' THEN 3 WHEN 'warning' THEN 2 ELSE 1 END"
MIGRATIONS: tuple[tuple[str, ...], ...] = (
    (
        """CREATE TABLE turbine (
            name TEXT PRIMARY KEY,
            model TEXT NOT NULL,
            added DOUBLE PRECISION NOT NULL)""",
        """CREATE TABLE observation (
            turbine TEXT NOT NULL,
            signal TEXT NOT NULL,
            time DOUBLE PRECISION NOT NULL,
            value DOUBLE PRECISION NOT NULL,
            received DOUBLE PRECISION NOT NULL,
            late INTEGER NOT NULL,
            contradicted INTEGER NOT NULL,
            PRIMARY KEY (turbine, signal, time))""",
        "CREATE INDEX observation_by_time ON observation (turbine, time)",
        """CREATE TABLE point (
            turbine TEXT PRIMARY KEY,
            time DOUBLE PRECISION NOT NULL,
            state TEXT NOT NULL)""",
        """CREATE TABLE estimate (
            turbine TEXT NOT NULL,
            time DOUBLE PRECISION NOT NULL,
            final INTEGER NOT NULL,
            temperature_K DOUBLE PRECISION, temperature_sd DOUBLE PRECISION,
            relative_humidity DOUBLE PRECISION, relative_humidity_sd DOUBLE PRECISION,
            absolute_humidity_g_m3 DOUBLE PRECISION, absolute_humidity_sd DOUBLE PRECISION,
            dew_point_K DOUBLE PRECISION, dew_point_sd DOUBLE PRECISION,
            frost_point_K DOUBLE PRECISION, frost_point_sd DOUBLE PRECISION,
            margin_K DOUBLE PRECISION, margin_sd DOUBLE PRECISION,
            condensation DOUBLE PRECISION,
            PRIMARY KEY (turbine, time))""",
        """CREATE TABLE property (
            turbine TEXT NOT NULL,
            time DOUBLE PRECISION NOT NULL,
            name TEXT NOT NULL,
            unit TEXT NOT NULL,
            value DOUBLE PRECISION, lower_bound DOUBLE PRECISION, upper_bound DOUBLE PRECISION,
            reference DOUBLE PRECISION NOT NULL,
            observable INTEGER NOT NULL,
            PRIMARY KEY (turbine, name, time))""",
        "CREATE INDEX property_by_time ON property (turbine, time)",
        """CREATE TABLE forecast (
            turbine TEXT NOT NULL,
            time DOUBLE PRECISION NOT NULL,
            made DOUBLE PRECISION NOT NULL,
            temperature_K DOUBLE PRECISION, temperature_sd DOUBLE PRECISION,
            relative_humidity DOUBLE PRECISION, relative_humidity_sd DOUBLE PRECISION,
            absolute_humidity_g_m3 DOUBLE PRECISION, absolute_humidity_sd DOUBLE PRECISION,
            dew_point_K DOUBLE PRECISION, dew_point_sd DOUBLE PRECISION,
            frost_point_K DOUBLE PRECISION, frost_point_sd DOUBLE PRECISION,
            margin_K DOUBLE PRECISION, margin_sd DOUBLE PRECISION,
            condensation DOUBLE PRECISION,
            above_limit DOUBLE PRECISION,
            PRIMARY KEY (turbine, time))""",
        """CREATE TABLE weather (
            turbine TEXT NOT NULL,
            signal TEXT NOT NULL,
            time DOUBLE PRECISION NOT NULL,
            value DOUBLE PRECISION NOT NULL,
            received DOUBLE PRECISION NOT NULL,
            PRIMARY KEY (turbine, signal, time))""",
        """CREATE TABLE alarm (
            id TEXT PRIMARY KEY,
            turbine TEXT NOT NULL,
            kind TEXT NOT NULL,
            severity TEXT NOT NULL,
            began DOUBLE PRECISION NOT NULL,
            ended DOUBLE PRECISION,
            acknowledged DOUBLE PRECISION,
            acknowledged_by TEXT,
            statement TEXT NOT NULL,
            remedy TEXT NOT NULL)""",
        "CREATE INDEX alarm_by_turbine ON alarm (turbine, began)",
        """CREATE TABLE memory (
            turbine TEXT NOT NULL,
            name TEXT NOT NULL,
            content TEXT NOT NULL,
            PRIMARY KEY (turbine, name))""",
        """CREATE TABLE counter (
            turbine TEXT NOT NULL,
            name TEXT NOT NULL,
            count BIGINT NOT NULL,
            PRIMARY KEY (turbine, name))""",
        """CREATE TABLE source (
            url TEXT PRIMARY KEY,
            place TEXT NOT NULL)""",
        """CREATE TABLE claim (
            kind TEXT NOT NULL,
            name TEXT NOT NULL,
            holder BIGINT NOT NULL,
            who TEXT NOT NULL,
            since DOUBLE PRECISION NOT NULL,
            PRIMARY KEY (kind, name))""",
    ),
    (),
    (
        "ALTER TABLE alarm ADD COLUMN cause TEXT",
        "ALTER TABLE alarm ADD COLUMN note TEXT",
        "ALTER TABLE alarm ADD COLUMN look_again DOUBLE PRECISION",
        """CREATE TABLE held (
            turbine TEXT NOT NULL,
            signal TEXT NOT NULL,
            time DOUBLE PRECISION NOT NULL,
            value DOUBLE PRECISION NOT NULL,
            received DOUBLE PRECISION NOT NULL,
            PRIMARY KEY (turbine, signal, time))""",
        """CREATE TABLE assessment (
            turbine TEXT PRIMARY KEY,
            state TEXT NOT NULL,
            reason TEXT NOT NULL,
            since DOUBLE PRECISION NOT NULL)""",
        """CREATE TABLE shelf (
            turbine TEXT NOT NULL,
            kind TEXT NOT NULL,
            until DOUBLE PRECISION NOT NULL,
            made DOUBLE PRECISION NOT NULL,
            made_by TEXT NOT NULL,
            note TEXT NOT NULL,
            PRIMARY KEY (turbine, kind))""",
        """CREATE TABLE event (
            id TEXT PRIMARY KEY,
            turbine TEXT NOT NULL,
            time DOUBLE PRECISION NOT NULL,
            kind TEXT NOT NULL,
            note TEXT NOT NULL,
            made DOUBLE PRECISION NOT NULL,
            made_by TEXT NOT NULL)""",
        "CREATE INDEX event_by_turbine ON event (turbine, time)",
        """CREATE TABLE outbox (
            id TEXT PRIMARY KEY,
            channel TEXT NOT NULL,
            content TEXT NOT NULL,
            made DOUBLE PRECISION NOT NULL,
            due DOUBLE PRECISION NOT NULL,
            attempts INTEGER NOT NULL,
            failure TEXT NOT NULL,
            sent DOUBLE PRECISION)""",
        "CREATE INDEX outbox_by_due ON outbox (sent, due)",
    ),
    (),
    (
        "ALTER TABLE observation ADD COLUMN mark DOUBLE PRECISION",
        "ALTER TABLE held ADD COLUMN mark DOUBLE PRECISION",
        "ALTER TABLE held RENAME TO held_once",
        "CREATE TABLE held AS SELECT * FROM held_once",
        "DROP TABLE held_once",
        "CREATE UNIQUE INDEX held_by_value ON held (turbine, signal, time, value)",
        """CREATE TABLE revision AS
            SELECT turbine, signal, time, value, received, mark, late, 0 AS number
            FROM observation WHERE 1 = 0""",
        "CREATE UNIQUE INDEX revision_by_value ON revision (turbine, signal, time, value)",
        "CREATE INDEX revision_by_time ON revision (turbine, time)",
    ),
)
"""One tuple of statements per version that create and change tables, from 1 on; a released version is never
changed, only followed by another.  Version 2 added the views; version 3 states, held readings, shelves,
events and notices; version 4 rounds times to microseconds, and makes timestamps of them where the database
has them (`Dialect.migrations`); version 5 keeps every version of a value.

A new column is a field of what the store writes (`batch`, `condition.QUANTITIES`) and an ALTER TABLE here.
"""
VERSION = len(MIGRATIONS)
VIEWS = {
    "estimate_readable": f"""SELECT turbine, time, STAMP(time) AS time_utc, final, {_CONDITION}
        FROM estimate""",
    "forecast_readable": f"""SELECT turbine, time, STAMP(time) AS time_utc, STAMP(made) AS made_utc,
        {_CONDITION}, 100.0 * above_limit AS above_limit_percent FROM forecast""",
    "alarm_open": f"""SELECT id, turbine, kind, severity, {_RANK} AS severity_rank,
        began, UTC(began) AS began_utc,
        UTC(acknowledged) AS acknowledged_utc, acknowledged_by, cause, note, statement, remedy
        FROM alarm WHERE ended IS NULL""",
    # CROSS JOIN fixes SQLite's join order: it looks up each turbine's newest time instead of scanning
    # every row
    "property_now": """SELECT p.turbine, p.name, p.unit, p.time, STAMP(p.time) AS time_utc, p.value,
        p.lower_bound, p.upper_bound, p.reference, p.observable
        FROM (SELECT name, (SELECT MAX(n.time) FROM property n WHERE n.turbine = turbine.name) AS newest
        FROM turbine) t
        CROSS JOIN property p WHERE p.turbine = t.name AND p.time = t.newest""",
    "turbine_now": """SELECT t.name AS turbine, h.heard, STAMP(h.heard) AS heard_utc, e.time, e.time_utc,
        e.temperature_celsius, e.temperature_lower_celsius, e.temperature_upper_celsius,
        e.relative_humidity_percent, e.relative_humidity_lower_percent, e.relative_humidity_upper_percent,
        e.dew_point_celsius, e.margin_kelvin, e.margin_lower_kelvin, e.condensation_percent,
        (SELECT COUNT(*) FROM alarm a WHERE a.turbine = t.name AND a.ended IS NULL) AS open_alarms,
        COALESCE((SELECT MAX(o.severity_rank) FROM alarm_open o WHERE o.turbine = t.name), 0)
        AS severity_rank, s.state, s.reason
        FROM turbine t
        JOIN (SELECT name, (SELECT MAX(o.time) FROM observation o WHERE o.turbine = name) AS heard
        FROM turbine) h
        ON h.name = t.name
        LEFT JOIN estimate_readable e ON e.turbine = t.name
        AND e.time = (SELECT MAX(n.time) FROM estimate n WHERE n.turbine = t.name)
        LEFT JOIN assessment s ON s.turbine = t.name""",
    "observation_hourly": """SELECT turbine, signal, hour AS time, STAMP(hour) AS time_utc,
        AVG(value) AS mean, MIN(value) AS lowest, MAX(value) AS highest, COUNT(*) AS readings
        FROM (SELECT turbine, signal, HOUR(time) AS hour, value FROM observation
        WHERE contradicted = 0) o
        GROUP BY turbine, signal, hour""",
}
"""View -> its query; a view stands after those that it uses.  A migration drops and creates all views."""
TABLES = (
    "turbine", "observation", "point", "estimate", "forecast", "weather", "property", "alarm", "memory",
    "counter", "source", "claim", "held", "assessment", "shelf", "event", "outbox", "revision",
)  # fmt: skip
"""All tables except the one that records the schema's version."""


def migration(version: int, dialect: Dialect) -> list[str]:
    """Statements of a version in one database's SQL dialect; the first migration also creates
    `schema_version`."""
    own = ["CREATE TABLE schema_version (version INTEGER PRIMARY KEY, applied DOUBLE PRECISION NOT NULL)"]
    return [*(own if version == 1 else []), *MIGRATIONS[version - 1], *dialect.migrations.get(version, ())]


def dropped_views() -> list[str]:
    """Statements that drop all views, which would stand in the way of a changed column."""
    return [f"DROP VIEW IF EXISTS {name}" for name in reversed(VIEWS)]


def created_views(dialect: Dialect) -> list[str]:
    """Statements that create all views in one database's SQL dialect."""
    return [_in_dialect(f"CREATE VIEW {name} AS {query}", dialect) for name, query in VIEWS.items()]


def _in_dialect(statement: str, dialect: Dialect) -> str:
    return re.sub(
        r"\b(UTC|STAMP|HOUR)\(([\w.]+)\)", lambda found: dialect.words[found[1]].format(found[2]), statement
    )
