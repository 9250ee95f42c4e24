"""The store's tables and views, and how SQLite and PostgreSQL write their times.

Times are seconds since 1970, UTC, as double precision.  In PostgreSQL those of type `Instant` are
`timestamptz`, by which a table can be partitioned; `point.time` is not, because it restores every bit.
Values are in SI units, absolute humidity in g/m³.  The views are for people and plotting tools: timestamps,
°C and %, lower-case names.

A new column is a field of what the store writes (`batch`, `condition.QUANTITIES`) and stands here.
"""

from __future__ import annotations

from functools import cache
from types import UnionType
from typing import Any, get_args, get_type_hints

import sqlalchemy as sa
from sqlalchemy import Column, Double, Integer, Table, Text, func, select
from sqlalchemy.dialects.postgresql import Insert, insert
from sqlalchemy.dialects.postgresql.base import PGDialect
from sqlalchemy.dialects.sqlite.base import SQLiteDialect
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.schema import CreateIndex, CreateTable
from sqlalchemy.sql import quoted_name
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.types import TypeDecorator, TypeEngine

from hygrokf.live.batch import Alarm, Assessment, Event, Loss, Notice, Shelf
from hygrokf.live.condition import QUANTITIES, Z95

VERSION = 6
"""Number of the schema: one higher with each change of it.  A store with another number is refused."""
SQLITE = SQLiteDialect(paramstyle="qmark")
POSTGRESQL = PGDialect(paramstyle="format")


# -- times ---------------------------------------------------------------------------------------------------
class Instant(TypeDecorator[float]):
    """A time [s] that is a timestamp where the database has such a type."""

    impl = Double
    cache_ok = True

    def load_dialect_impl(self, dialect: sa.Dialect) -> TypeEngine[Any]:
        return sa.TIMESTAMP(timezone=True) if dialect is POSTGRESQL else Double()

    def bind_expression(self, bindparam: sa.BindParameter[float]) -> sa.ColumnElement[float]:
        return _Timestamp(sa.type_coerce(bindparam, Double))


class _Function(FunctionElement[Any]):
    """A function of one time that each database writes in its own way."""

    inherit_cache = True
    sqlite = postgresql = "{}"


class _Timestamp(_Function):
    """A number [s] as a value for an `Instant`."""

    postgresql = "to_timestamp({})"


class _Iso(_Function):
    """A time as ISO 8601 text, where the database has no timestamps."""

    sqlite = "strftime('%Y-%m-%dT%H:%M:%fZ', {}, 'unixepoch')"


class _Hour(_Function):
    """The beginning of the hour of an `Instant`."""

    type = Instant()
    sqlite, postgresql = "CAST({} / 3600 AS INTEGER) * 3600.0", "date_trunc('hour', {}, 'UTC')"


@compiles(_Function)
def _function(element: _Function, compiler: SQLCompiler, **options: Any) -> str:
    template: str = getattr(element, compiler.dialect.name)
    return template.format(compiler.process(element.clauses, **options))


# -- tables --------------------------------------------------------------------------------------------------
METADATA = sa.MetaData()
_TYPES: dict[type, TypeEngine[Any]] = {str: Text(), int: Integer(), float: Double()}


def _key(name: str, kind: type[TypeEngine[Any]] = Text) -> Column[Any]:
    return Column(name, kind, primary_key=True, autoincrement=False)


def _stated(name: str, kind: type[TypeEngine[Any]] = Text) -> Column[Any]:
    return Column(name, kind, nullable=False)


def _readings(name: str, *more: Column[Any], keys: tuple[str, ...] = ("turbine", "signal", "time")) -> Table:
    """A table of readings."""
    kinds = {"turbine": Text, "signal": Text, "time": Instant, "value": Double, "received": Instant}
    columns = [_key(c, kind) if c in keys else _stated(c, kind) for c, kind in kinds.items()]
    return Table(name, METADATA, *columns, *more)


def _table_of(kind: type[Any], name: str, *keys: str, instants: tuple[str, ...] = ()) -> Table:
    """A table whose columns are the fields of a dataclass."""
    columns = []
    for field, hint in get_type_hints(kind).items():
        optional = isinstance(hint, UnionType)
        plain = get_args(hint)[0] if optional else hint
        type_ = Instant() if field in instants else _TYPES[plain]
        columns.append(Column(field, type_, primary_key=field in keys, nullable=optional))
    return Table(name, METADATA, *columns)


def _air(name: str, *columns: Column[Any], more: tuple[str, ...] = ()) -> Table:
    """A table of conditions of the cabinet's air."""
    names = [*(name for q in QUANTITIES for name in (q.column, q.sd_column)), "condensation", *more]
    own = [Column(quoted_name(one, quote=False), Double) for one in names]
    return Table(name, METADATA, _key("turbine"), _key("time", Instant), *columns, *own)


schema_version = Table("schema_version", METADATA, _key("version", Integer), _stated("applied", Double))
turbine = Table("turbine", METADATA, _key("name"), _stated("model"), _stated("added", Double))
observation = _readings(
    "observation", Column("mark", Double), _stated("late", Integer), _stated("contradicted", Integer)
)
held = _readings("held", Column("mark", Double), keys=("turbine", "signal", "time", "value"))
revision = _readings(
    "revision",
    Column("mark", Double),
    _stated("late", Integer),
    _stated("number", Integer),
    keys=("turbine", "signal", "time", "value"),
)
weather = _readings("weather")
connection = _table_of(Loss, "connection", "turbine", "signal", "lost")
point = Table("point", METADATA, _key("turbine"), _stated("time", Double), _stated("state"))
estimate = _air("estimate", _stated("final", Integer))
forecast = _air("forecast", _stated("made", Instant), more=("above_limit",))
property_ = Table(
    "property", METADATA, _key("turbine"), _key("name"), _key("time", Instant), _stated("unit"),
    Column("value", Double), Column("lower_bound", Double), Column("upper_bound", Double),
    _stated("reference", Double), _stated("observable", Integer),
)  # fmt: skip
alarm = _table_of(Alarm, "alarm", "id")
memory = Table("memory", METADATA, _key("turbine"), _key("name"), _stated("content"))
counter = Table("counter", METADATA, _key("turbine"), _key("name"), _stated("count", sa.BigInteger))
source = Table("source", METADATA, _key("url"), _stated("place"))
claim = Table(
    "claim", METADATA, _key("kind"), _key("name"), _stated("holder", sa.BigInteger), _stated("who"),
    _stated("since", Double),
)  # fmt: skip
assessment = _table_of(Assessment, "assessment", "turbine")
shelf = _table_of(Shelf, "shelf", "turbine", "kind")
event = _table_of(Event, "event", "id", instants=("time",))
outbox = _table_of(Notice, "outbox", "id")
for _name, *_columns in (
    ("observation_by_time", observation.c.turbine, observation.c.time),
    ("revision_by_time", revision.c.turbine, revision.c.time),
    ("property_by_time", property_.c.turbine, property_.c.time),
    ("alarm_by_turbine", alarm.c.turbine, alarm.c.began),
    ("event_by_turbine", event.c.turbine, event.c.time),
    ("outbox_by_due", outbox.c.sent, outbox.c.due),
):
    sa.Index(_name, *_columns)


@cache
def inserting(table: Table) -> Insert:
    """The statement that inserts a row, unless there is one with its key."""
    return insert(table).on_conflict_do_nothing()


@cache
def replacing(table: Table, *kept: str, newer: str = "", added: str = "") -> Insert:
    """The statement that inserts a row or, where there is one with its key, replaces all but the `kept`
    columns, only if `newer` has not decreased, and adds to the column `added`."""
    statement, keys = insert(table), list(table.primary_key)
    changed: dict[str, Any] = {
        one.name: statement.excluded[one.name] for one in table.c if one not in keys and one.name not in kept
    }
    if added:
        changed[added] += table.c[added]
    where = statement.excluded[newer] >= table.c[newer] if newer else None
    return statement.on_conflict_do_update(index_elements=keys, set_=changed, where=where)


def matching(rows: sa.FromClause, **values: object) -> sa.ColumnElement[bool]:
    """The condition that columns have these values."""
    return sa.and_(sa.true(), *(rows.c[name] == value for name, value in values.items()))


# -- views ---------------------------------------------------------------------------------------------------
VIEWS: dict[str, sa.Select[Any]] = {}
"""View -> its query; a view stands after those that it uses."""


def _view(name: str, query: sa.Select[Any]) -> sa.TableClause:
    VIEWS[name] = query
    return sa.table(name, *(sa.column(one.name, one.type) for one in query.selected_columns))


class _CrossJoin(sa.Join):
    """A join whose order SQLite keeps: it looks up the rows on the right for each on the left, instead of
    scanning all of them."""

    inherit_cache = True


@compiles(_CrossJoin)
def _(join: sa.Join, compiler: SQLCompiler, **options: Any) -> str:
    left, right = (compiler.process(one, **{**options, "asfrom": True}) for one in (join.left, join.right))
    return f"{left} CROSS JOIN {right}"


def _readable(air: Table) -> list[sa.ColumnElement[Any]]:
    """The condition in everyday units with 95 % bounds."""
    columns: list[sa.ColumnElement[Any]] = []
    for q in QUANTITIES:
        value, half = q.factor * air.c[q.column] + q.offset, Z95 * q.factor * air.c[q.sd_column]
        columns.append(value.label(f"{q.name}_{q.unit}"))
        columns.append((value - half).label(f"{q.name}_lower_{q.unit}"))
        columns.append((value + half).label(f"{q.name}_upper_{q.unit}"))
    return [*columns, (100.0 * air.c.condensation).label("condensation_percent")]


def _utc(time: sa.ColumnElement[Any]) -> sa.ColumnElement[Any]:
    """A time as the database's own timestamp, or as ISO 8601 text."""
    return _Iso(time if isinstance(time.type, Instant) else _Timestamp(time))


def _of(rows: sa.FromClause, names: str) -> list[sa.ColumnElement[Any]]:
    """Columns by their names, of which NAME_utc without a column of its own is the time NAME."""
    return [
        rows.c[name] if name in rows.c else _utc(rows.c[name.removesuffix("_utc")]).label(name)
        for name in names.split()
    ]


def newest(rows: Table, **same: object) -> sa.ScalarSelect[Any]:
    """The newest time of a turbine's rows that have the same values, in a query of turbines."""
    own = rows.alias()
    newest_one = select(func.max(own.c.time)).where(own.c.turbine == turbine.c.name, matching(own, **same))
    return newest_one.scalar_subquery()


READABLE_COLUMNS = tuple(one.name for one in _readable(estimate))
"""Columns of `estimate_readable` and `forecast_readable` that describe the cabinet air."""
estimate_readable = _view(
    "estimate_readable", select(*_of(estimate, "turbine time time_utc final"), *_readable(estimate))
)
_above_limit = (100.0 * forecast.c.above_limit).label("above_limit_percent")
_view(
    "forecast_readable",
    select(*_of(forecast, "turbine time time_utc made_utc"), *_readable(forecast), _above_limit),
)
_rank = sa.case({"alarm": 3, "warning": 2}, value=alarm.c.severity, else_=1).label("severity_rank")
alarm_open = _view(
    "alarm_open",
    select(
        *_of(alarm, "id turbine kind severity"),
        _rank,
        *_of(alarm, "began began_utc acknowledged_utc acknowledged_by cause note statement remedy"),
    ).where(alarm.c.ended.is_(None)),
)
_latest = select(turbine.c.name, newest(property_).label("newest")).subquery()
_view(
    "property_now",
    select(
        *_of(property_, "turbine name unit time time_utc value lower_bound upper_bound reference observable")
    )
    .select_from(_CrossJoin(_latest, property_, sa.true()))
    .where(property_.c.turbine == _latest.c.name, property_.c.time == _latest.c.newest),
)
_heard = select(turbine.c.name, newest(observation).label("heard")).subquery()
_open = select(func.count()).where(alarm_open.c.turbine == turbine.c.name)
_worst = _open.with_only_columns(func.max(alarm_open.c.severity_rank)).scalar_subquery()
_view(
    "turbine_now",
    select(
        turbine.c.name.label("turbine"),
        *_of(_heard, "heard heard_utc"),
        *_of(
            estimate_readable,
            "time time_utc temperature_celsius temperature_lower_celsius temperature_upper_celsius "
            "relative_humidity_percent relative_humidity_lower_percent relative_humidity_upper_percent "
            "dew_point_celsius margin_kelvin margin_lower_kelvin condensation_percent",
        ),
        _open.scalar_subquery().label("open_alarms"),
        func.coalesce(_worst, 0).label("severity_rank"),
        *_of(assessment, "state reason"),
    )
    .join(_heard, _heard.c.name == turbine.c.name)
    .outerjoin(
        estimate_readable,
        (estimate_readable.c.turbine == turbine.c.name) & (estimate_readable.c.time == newest(estimate)),
    )
    .outerjoin(assessment, assessment.c.turbine == turbine.c.name),
)
_hours = (
    select(*_of(observation, "turbine signal value"), _Hour(observation.c.time).label("time"))
    .where(observation.c.contradicted == 0)
    .subquery()
)
_value = _hours.c.value
_view(
    "observation_hourly",
    select(
        *_of(_hours, "turbine signal time time_utc"),
        func.avg(_value).label("mean"),
        func.min(_value).label("lowest"),
        func.max(_value).label("highest"),
        func.count().label("readings"),
    ).group_by(*_of(_hours, "turbine signal time")),
)


def creation(dialect: sa.Dialect) -> list[str]:
    """Statements that create all tables and views in one database's SQL dialect."""
    tables = METADATA.sorted_tables
    indices = [index for one in tables for index in sorted(one.indexes, key=lambda index: str(index.name))]
    made: list[sa.ClauseElement] = [*map(CreateTable, tables), *map(CreateIndex, indices)]
    return [*(str(one.compile(dialect=dialect)) for one in made), *created_views(dialect)]


def created_views(dialect: sa.Dialect) -> list[str]:
    """Statements that create all views in one database's SQL dialect."""
    whole = {"literal_binds": True}
    return [
        f"CREATE VIEW {name} AS {query.compile(dialect=dialect, compile_kwargs=whole)}"
        for name, query in VIEWS.items()
    ]
