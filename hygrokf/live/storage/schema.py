"""The store's tables and views.

Times are seconds since 1970, UTC, as double precision; in PostgreSQL those of the large tables (`TIMESTAMPS`)
are `timestamptz`, by which a table can be partitioned.  Values are in SI units, absolute humidity in g/m³.
The views are for people and plotting tools: timestamps, °C and %, lower-case names.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

from hygrokf.live.batch import Alarm, Assessment, Event, Loss, Notice, Shelf
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
VERSION = 7
"""Number of the schema: one higher with each change of it.  A store with another number is refused."""
_TYPES = {
    "NUMBER": "DOUBLE PRECISION", "float": "DOUBLE PRECISION", "int": "INTEGER", "str": "TEXT"
}  # fmt: skip
"""Type of a column or a field -> SQL, where they differ; INSTANT is that of the columns in `TIMESTAMPS`."""


@dataclass(frozen=True)
class StoreTable:
    """A table: its `columns` with their SQL types, the columns of its `key`, and those of its `index`, if it
    has another one."""

    columns: Mapping[str, str]
    key: tuple[str, ...]
    index: tuple[str, ...] = ()

    def statements(self, name: str) -> Iterator[str]:
        """The statements that create the table."""
        columns = ", ".join(f"{column} {kind}" for column, kind in self.columns.items())
        yield f"CREATE TABLE {name} ({columns}, PRIMARY KEY ({', '.join(self.key)}))"
        if self.index:
            yield f"CREATE INDEX {name}_by_{self.index[-1]} ON {name} ({', '.join(self.index)})"


def _table(of: str | type[Any], key: str, index: str = "") -> StoreTable:
    """A table from its columns "name TYPE, …", or from a class whose fields they are.

    A value may be missing where the type ends with "?", or where the field may be None.
    """
    columns = {}
    if isinstance(of, str):
        pairs = [one.split() for one in of.split(", ")]
    else:
        pairs = [[one.name, "INSTANT" if one.name == "time" else str(one.type)] for one in fields(of)]
    for name, kind in pairs:
        stated = kind.removesuffix("?").removesuffix(" | None")
        columns[name] = _TYPES.get(stated, stated) + (" NOT NULL" if stated == kind else "")
    return StoreTable(columns, tuple(key.split()), tuple(index.split()))


_READING = "turbine TEXT, signal TEXT, time INSTANT, value NUMBER, received INSTANT"
_AIR = ", ".join(f"{q.column} NUMBER?, {q.sd_column} NUMBER?" for q in QUANTITIES) + ", condensation NUMBER?"
TABLES = {
    "turbine": _table("name TEXT, model TEXT, added NUMBER", "name"),
    "observation": _table(
        f"{_READING}, late INTEGER, contradicted INTEGER, mark NUMBER?", "turbine signal time", "turbine time"
    ),
    "held": _table(f"{_READING}, mark NUMBER?", "turbine signal time value"),
    "revision": _table(
        f"{_READING}, mark NUMBER?, late INTEGER, number INTEGER", "turbine signal time value", "turbine time"
    ),
    "connection": _table(Loss, "turbine signal lost"),
    "point": _table("turbine TEXT, time NUMBER, state TEXT", "turbine"),
    "estimate": _table(f"turbine TEXT, time INSTANT, final INTEGER, {_AIR}", "turbine time"),
    "forecast": _table(
        f"turbine TEXT, time INSTANT, made INSTANT, {_AIR}, above_limit NUMBER?", "turbine time"
    ),
    "property": _table(
        "turbine TEXT, time INSTANT, name TEXT, unit TEXT, value NUMBER?, lower_bound NUMBER?, "
        "upper_bound NUMBER?, reference NUMBER, observable INTEGER",
        "turbine name time",
        "turbine time",
    ),
    "weather": _table(_READING, "turbine signal time"),
    "alarm": _table(Alarm, "id", "turbine began"),
    "memory": _table("turbine TEXT, name TEXT, content TEXT", "turbine name"),
    "counter": _table("turbine TEXT, name TEXT, count BIGINT", "turbine name"),
    "source": _table("url TEXT, place TEXT", "url"),
    "claim": _table("kind TEXT, name TEXT, holder BIGINT, who TEXT, since NUMBER", "kind name"),
    "assessment": _table(Assessment, "turbine"),
    "shelf": _table(Shelf, "turbine kind"),
    "event": _table(Event, "id", "turbine time"),
    "outbox": _table(Notice, "id", "sent due"),
}
"""All tables except the one that records the schema's number.

A new column is a field of what the store writes (`batch`, `condition.QUANTITIES`), or stands here.
"""
TIMESTAMPS = {
    name: tuple(column for column, kind in table.columns.items() if "INSTANT" in kind)
    for name, table in TABLES.items()
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
    made = (statement for name, table in TABLES.items() for statement in table.statements(name))
    tables = [one.replace("INSTANT", dialect.instant) for one in made]
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
