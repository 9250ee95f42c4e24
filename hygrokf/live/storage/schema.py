"""The store's tables and views.

Times are seconds since 1970, UTC, as double precision; in PostgreSQL those of the large tables (`TIMESTAMPS`)
are `timestamptz`, by which a table can be partitioned.  Values are in SI units, absolute humidity in g/m³.
The views are for people and plotting tools: timestamps, °C and %, lower-case names.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from hygrokf.live.condition import QUANTITIES, Z95


@dataclass(frozen=True)
class Dialect:
    """The SQL of one database.

    `words`: templates that the views use as WORD(column).  UTC: a time [s] as the database's own timestamp,
    or ISO 8601 text where it has no such type; STAMP: the same of a column of `TIMESTAMPS`; HOUR: the
    beginning of the hour of such a column.  `instant`: the type of such a column; `time`: the template of a
    parameter [s] that stands for one.
    """

    words: Mapping[str, str]
    instant: str
    time: str


SQLITE = Dialect(
    {
        "UTC": "strftime('%Y-%m-%dT%H:%M:%fZ', {}, 'unixepoch')",
        "STAMP": "strftime('%Y-%m-%dT%H:%M:%fZ', {}, 'unixepoch')",
        "HOUR": "CAST({} / 3600 AS INTEGER) * 3600.0",
    },
    "DOUBLE PRECISION",
    "?",
)
POSTGRESQL = Dialect(
    {"UTC": "to_timestamp({})", "STAMP": "{}", "HOUR": "date_trunc('hour', {}, 'UTC')"},
    "TIMESTAMPTZ",
    "to_timestamp(?)",
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
_AIR = ", ".join(f"{q.column} DOUBLE PRECISION, {q.sd_column} DOUBLE PRECISION" for q in QUANTITIES)
_READING = """turbine TEXT NOT NULL,
        signal TEXT NOT NULL,
        time INSTANT NOT NULL,
        value DOUBLE PRECISION NOT NULL,
        received INSTANT NOT NULL"""
VERSION = 6
"""Number of the schema: one higher with each change of it.  A store with another number is refused."""
STATEMENTS = (
    """CREATE TABLE turbine (
        name TEXT PRIMARY KEY,
        model TEXT NOT NULL,
        added DOUBLE PRECISION NOT NULL)""",
    f"""CREATE TABLE observation (
        {_READING},
        late INTEGER NOT NULL,
        contradicted INTEGER NOT NULL,
        mark DOUBLE PRECISION,
        PRIMARY KEY (turbine, signal, time))""",
    "CREATE INDEX observation_by_time ON observation (turbine, time)",
    f"""CREATE TABLE held (
        {_READING},
        mark DOUBLE PRECISION,
        PRIMARY KEY (turbine, signal, time, value))""",
    f"""CREATE TABLE revision (
        {_READING},
        mark DOUBLE PRECISION,
        late INTEGER NOT NULL,
        number INTEGER NOT NULL,
        PRIMARY KEY (turbine, signal, time, value))""",
    "CREATE INDEX revision_by_time ON revision (turbine, time)",
    """CREATE TABLE connection (
        turbine TEXT NOT NULL,
        signal TEXT NOT NULL,
        lost DOUBLE PRECISION NOT NULL,
        regained DOUBLE PRECISION,
        PRIMARY KEY (turbine, signal, lost))""",
    """CREATE TABLE point (
        turbine TEXT PRIMARY KEY,
        time DOUBLE PRECISION NOT NULL,
        state TEXT NOT NULL)""",
    f"""CREATE TABLE estimate (
        turbine TEXT NOT NULL,
        time INSTANT NOT NULL,
        final INTEGER NOT NULL,
        {_AIR},
        condensation DOUBLE PRECISION,
        PRIMARY KEY (turbine, time))""",
    f"""CREATE TABLE forecast (
        turbine TEXT NOT NULL,
        time INSTANT NOT NULL,
        made INSTANT NOT NULL,
        {_AIR},
        condensation DOUBLE PRECISION,
        above_limit DOUBLE PRECISION,
        PRIMARY KEY (turbine, time))""",
    """CREATE TABLE property (
        turbine TEXT NOT NULL,
        time INSTANT NOT NULL,
        name TEXT NOT NULL,
        unit TEXT NOT NULL,
        value DOUBLE PRECISION, lower_bound DOUBLE PRECISION, upper_bound DOUBLE PRECISION,
        reference DOUBLE PRECISION NOT NULL,
        observable INTEGER NOT NULL,
        PRIMARY KEY (turbine, name, time))""",
    "CREATE INDEX property_by_time ON property (turbine, time)",
    f"""CREATE TABLE weather (
        {_READING},
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
        remedy TEXT NOT NULL,
        cause TEXT,
        note TEXT,
        look_again DOUBLE PRECISION)""",
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
        time INSTANT NOT NULL,
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
)
"""Statements that create the tables; INSTANT is the type of the columns in `TIMESTAMPS`.

A new column is a field of what the store writes (`batch`, `condition.QUANTITIES`) and stands here.
"""
TABLES = tuple(one.split()[2] for one in STATEMENTS if one.startswith("CREATE TABLE"))
"""All tables except the one that records the schema's number."""
TIMESTAMPS = {
    one.split()[2]: tuple(re.findall(r"(\w+) INSTANT", one)) for one in STATEMENTS if "INSTANT" in one
}
"""Table -> its columns that are `timestamptz` in PostgreSQL.  `point.time` is not: it restores every bit."""
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
"""View -> its query; a view stands after those that it uses."""


def creation(dialect: Dialect) -> list[str]:
    """Statements that create all tables and views in one database's SQL dialect."""
    tables = [one.replace("INSTANT", dialect.instant) for one in STATEMENTS]
    number = "CREATE TABLE schema_version (version INTEGER PRIMARY KEY, applied DOUBLE PRECISION NOT NULL)"
    return [number, *tables, *created_views(dialect)]


def created_views(dialect: Dialect) -> list[str]:
    """Statements that create all views in one database's SQL dialect."""
    return [
        re.sub(
            r"\b(UTC|STAMP|HOUR)\(([\w.]+)\)",
            lambda found: dialect.words[found[1]].format(found[2]),
            f"CREATE VIEW {name} AS {query}",
        )
        for name, query in VIEWS.items()
    ]
