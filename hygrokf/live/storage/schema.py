"""The store's tables and views, described once for both databases.

Times are seconds since 1970, UTC, as double precision; in PostgreSQL, times of type `Instant` are
`timestamptz`, by which a table can be partitioned.  Values are in SI units, absolute humidity in g/m³.
The views are for people and plotting tools: timestamps, °C and %, lower-case names.

To add a column, add a field to a class of `batch` or a row to `condition.QUANTITIES`, or add it here.
"""

from __future__ import annotations

from types import UnionType
from typing import Any, get_args, get_type_hints

import sqlalchemy as sa
from sqlalchemy import Column, Index, Table, func, select
from sqlalchemy.dialects.postgresql.base import PGDialect
from sqlalchemy.dialects.sqlite.base import SQLiteDialect
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.schema import CreateIndex, CreateTable
from sqlalchemy.sql import quoted_name
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.types import TypeDecorator, TypeEngine

from hygrokf.live.batch import Alarm, Assessment, Event, Loss, Notice, Shelf
from hygrokf.live.condition import DISPLAYED_QUANTITIES, Z95

VERSION = 8
"""Number of the schema, increased by 1 with each change.  A store with another number is refused."""
SQLITE = SQLiteDialect(paramstyle="qmark")
POSTGRESQL = PGDialect(paramstyle="format")
NUMBER: TypeEngine[float] = sa.DOUBLE_PRECISION()
TEXT, INTEGER = sa.TEXT(), sa.INTEGER()


# -- times ---------------------------------------------------------------------------------------------------
class _Timestamp(sa.TIMESTAMP):
    """PostgreSQL's timestamp, whose parameters are seconds since 1970."""

    def bind_expression(self, bindparam: sa.BindParameter[Any]) -> sa.ColumnElement[Any]:
        return func.to_timestamp(bindparam)


class Instant(TypeDecorator[float]):
    """A time [s] that is a timestamp where the database has such a type."""

    impl = sa.DOUBLE_PRECISION
    cache_ok = True

    def load_dialect_impl(self, dialect: sa.Dialect) -> TypeEngine[Any]:
        return _Timestamp(timezone=True) if dialect.name == POSTGRESQL.name else NUMBER


class _ByDialect(FunctionElement[Any]):
    """An expression of a time with a different text in each SQL dialect."""

    inherit_cache = False

    def __init__(self, time: sa.ColumnElement[Any], **by_dialect: sa.ColumnElement[Any]) -> None:
        super().__init__(time)
        self.type, self.by_dialect = time.type, by_dialect


@compiles(_ByDialect)
def _compile_by_dialect(element: _ByDialect, compiler: SQLCompiler, **options: Any) -> str:
    return compiler.process(element.by_dialect[compiler.dialect.name], **options)


def _utc(time: sa.ColumnElement[Any]) -> sa.ColumnElement[Any]:
    """A time as the database's timestamp or, in SQLite, which has no such type, as ISO 8601 text."""
    stamp = time if isinstance(time.type, Instant) else func.to_timestamp(time)
    text = func.strftime("%Y-%m-%dT%H:%M:%fZ", time, "unixepoch")
    return _ByDialect(time, sqlite=text, postgresql=stamp)


def _hour(time: sa.ColumnElement[Any]) -> sa.ColumnElement[Any]:
    """The beginning of the hour of an `Instant`."""
    hours = sa.cast(sa.type_coerce(time, NUMBER) / 3600.0, INTEGER)
    seconds = sa.type_coerce(hours, NUMBER) * 3600.0
    return _ByDialect(time, sqlite=seconds, postgresql=func.date_trunc("hour", time, "UTC"))


# -- tables --------------------------------------------------------------------------------------------------
METADATA = sa.MetaData()
_TYPES: dict[type, TypeEngine[Any]] = {str: TEXT, int: INTEGER, float: NUMBER}


def _key(name: str, kind: TypeEngine[Any] = TEXT) -> Column[Any]:
    return Column(name, kind, primary_key=True, autoincrement=False)


def _filled(name: str, kind: TypeEngine[Any] = TEXT) -> Column[Any]:
    return Column(name, kind, nullable=False)


def _readings(name: str, *more: Column[Any] | Index, keys: tuple[str, ...] = ()) -> Table:
    """A table of readings, whose key holds turbine, signal, time and the further `keys`."""
    columns = [_key("turbine"), _key("signal"), _key("time", Instant())]
    value = _key("value", NUMBER) if "value" in keys else _filled("value", NUMBER)
    return Table(name, METADATA, *columns, value, _filled("received", Instant()), *more)


def _mark() -> Column[Any]:
    return Column("mark", NUMBER)


def _rows_of(kind: type[Any], name: str, *keys: str, index: tuple[str, ...] = ()) -> Table:
    """A table whose columns are the fields of a dataclass; a column is nullable if its field may be None."""
    columns = []
    for field, hint in get_type_hints(kind).items():
        optional = isinstance(hint, UnionType)
        type_ = Instant() if field == "time" else _TYPES[get_args(hint)[0] if optional else hint]
        columns.append(Column(field, type_, primary_key=field in keys, nullable=optional))
    return Table(name, METADATA, *columns, *([Index(f"{name}_by_{index[-1]}", *index)] if index else ()))


def _air(name: str, column: Column[Any], *more: str) -> Table:
    """A table of conditions of the cabinet's air."""
    names = [*(name for q in DISPLAYED_QUANTITIES for name in (q.column, q.sd_column)), "condensation", *more]
    # unquoted, as people write them: PostgreSQL keeps them in lower case
    numbers = [Column(quoted_name(each, quote=False), NUMBER) for each in names]
    return Table(name, METADATA, _key("turbine"), _key("time", Instant()), column, *numbers)


schema_version = Table("schema_version", METADATA, _key("version", INTEGER), _filled("applied", NUMBER))
turbine = Table("turbine", METADATA, _key("name"), _filled("model"), _filled("added", NUMBER))
observation = _readings(
    "observation", _filled("late", INTEGER), _filled("contradicted", INTEGER), _mark(),
    Index("observation_by_time", "turbine", "time"),
)  # fmt: skip
held = _readings("held", _mark(), keys=("value",))
revision = _readings(
    "revision", _mark(), _filled("late", INTEGER), _filled("number", INTEGER),
    Index("revision_by_time", "turbine", "time"), keys=("value",),
)  # fmt: skip
weather = _readings("weather")
connection = _rows_of(Loss, "connection", "turbine", "signal", "lost")
point = Table("point", METADATA, _key("turbine"), _filled("time", NUMBER), _filled("state"))
"""The filter state.  Its time is a number in both databases, so that reading restores every bit."""
estimate = _air("estimate", _filled("final", INTEGER))
forecast = _air("forecast", _filled("made", Instant()), "above_limit")
property_ = Table(
    "property", METADATA, _filled("turbine"), _filled("time", Instant()), _filled("name"), _filled("unit"),
    Column("value", NUMBER), Column("lower_bound", NUMBER), Column("upper_bound", NUMBER),
    _filled("reference", NUMBER), _filled("observable", INTEGER),
    sa.PrimaryKeyConstraint("turbine", "name", "time"), Index("property_by_time", "turbine", "time"),
)  # fmt: skip
alarm = _rows_of(Alarm, "alarm", "id", index=("turbine", "began"))
memory = Table("memory", METADATA, _key("turbine"), _key("name"), _filled("content"))
counter = Table("counter", METADATA, _key("turbine"), _key("name"), _filled("count", sa.BIGINT()))
source = Table("source", METADATA, _key("url"), _filled("place"))
claim = Table(
    "claim", METADATA, _key("kind"), _key("name"), _filled("holder", sa.BIGINT()), _filled("who"),
    _filled("since", NUMBER),
)  # fmt: skip
assessment = _rows_of(Assessment, "assessment", "turbine")
shelf = _rows_of(Shelf, "shelf", "turbine", "kind")
event = _rows_of(Event, "event", "id", index=("turbine", "time"))
outbox = _rows_of(Notice, "outbox", "id", index=("sent", "due"))
TABLES = {name: table for name, table in METADATA.tables.items() if table is not schema_version}
"""All tables except the one that records the schema's number."""


# -- views ---------------------------------------------------------------------------------------------------
VIEWS: dict[str, sa.Select[Any]] = {}
"""View → its query; each view comes after the views that it uses."""


def _view(name: str, query: sa.Select[Any]) -> sa.TableClause:
    VIEWS[name] = query
    return sa.table(name, *(sa.column(column.name, column.type) for column in query.selected_columns))


class _CrossJoin(sa.Join):
    """A join whose order SQLite keeps: for each row on the left it looks up the rows on the right instead of
    scanning all rows on the right."""

    inherit_cache = True

    def __init__(self, left: sa.FromClause, right: sa.FromClause) -> None:
        super().__init__(left, right, sa.true())


@compiles(_CrossJoin)
def _compile_cross_join(join: _CrossJoin, compiler: SQLCompiler, **options: Any) -> str:
    options = {**options, "asfrom": True}
    left, right = (compiler.process(side, **options) for side in (join.left, join.right))
    return f"{left} CROSS JOIN {right}"


def named_columns(rows: sa.FromClause, names: str) -> list[sa.ColumnElement[Any]]:
    """Columns by their names; NAME_utc, unless it is a column itself, is the column NAME as a timestamp."""
    return [
        rows.c[name] if name in rows.c else _utc(rows.c[name.removesuffix("_utc")]).label(name)
        for name in names.split()
    ]


def newest_time(rows: Table) -> sa.ScalarSelect[Any]:
    """The newest time of a turbine's rows, in a query of turbines."""
    alias = rows.alias()
    return select(func.max(alias.c.time)).where(alias.c.turbine == turbine.c.name).scalar_subquery()


def _readable(air: Table) -> list[sa.ColumnElement[Any]]:
    """The columns of a condition in display units with 95 % bounds."""
    columns: list[sa.ColumnElement[Any]] = []
    for q in DISPLAYED_QUANTITIES:
        value, half_width = q.factor * air.c[q.column] + q.offset, Z95 * q.factor * air.c[q.sd_column]
        columns.append(value.label(f"{q.name}_{q.unit}"))
        columns.append((value - half_width).label(f"{q.name}_lower_{q.unit}"))
        columns.append((value + half_width).label(f"{q.name}_upper_{q.unit}"))
    return [*columns, (100.0 * air.c.condensation).label("condensation_percent")]


READABLE_COLUMNS = tuple(column.name for column in _readable(estimate))
"""Columns of `estimate_readable` and `forecast_readable` that describe the cabinet air."""
estimate_readable = _view(
    "estimate_readable", select(*named_columns(estimate, "turbine time time_utc final"), *_readable(estimate))
)
_view(
    "forecast_readable",
    select(
        *named_columns(forecast, "turbine time time_utc made_utc"),
        *_readable(forecast),
        (100.0 * forecast.c.above_limit).label("above_limit_percent"),
    ),
)
alarm_open = _view(
    "alarm_open",
    select(
        *named_columns(alarm, "id turbine kind severity"),
        sa.case({"alarm": 3, "warning": 2}, value=alarm.c.severity, else_=1).label("severity_rank"),
        *named_columns(alarm, "began began_utc acknowledged_utc acknowledged_by cause note statement remedy"),
    ).where(alarm.c.ended.is_(None)),
)
_latest = select(turbine.c.name, newest_time(property_).label("newest")).subquery()
property_now = _view(
    "property_now",
    select(
        *named_columns(
            property_, "turbine name unit time time_utc value lower_bound upper_bound reference observable"
        )
    )
    .select_from(_CrossJoin(_latest, property_))
    .where(property_.c.turbine == _latest.c.name, property_.c.time == _latest.c.newest),
)
_heard = select(turbine.c.name, newest_time(observation).label("heard")).subquery()
_open = select(func.count()).where(alarm_open.c.turbine == turbine.c.name)
_worst = _open.with_only_columns(func.max(alarm_open.c.severity_rank)).scalar_subquery()
_view(
    "turbine_now",
    select(
        turbine.c.name.label("turbine"),
        *named_columns(_heard, "heard heard_utc"),
        *named_columns(
            estimate_readable,
            "time time_utc temperature_celsius temperature_lower_celsius temperature_upper_celsius "
            "relative_humidity_percent relative_humidity_lower_percent relative_humidity_upper_percent "
            "dew_point_celsius margin_kelvin margin_lower_kelvin condensation_percent",
        ),
        _open.scalar_subquery().label("open_alarms"),
        func.coalesce(_worst, 0).label("severity_rank"),
        *named_columns(assessment, "state reason"),
    )
    .join(_heard, _heard.c.name == turbine.c.name)
    .outerjoin(
        estimate_readable,
        (estimate_readable.c.turbine == turbine.c.name) & (estimate_readable.c.time == newest_time(estimate)),
    )
    .outerjoin(assessment, assessment.c.turbine == turbine.c.name),
)
_hours = (
    select(*named_columns(observation, "turbine signal value"), _hour(observation.c.time).label("time"))
    .where(observation.c.contradicted == 0)
    .subquery()
)
_view(
    "observation_hourly",
    select(
        *named_columns(_hours, "turbine signal time time_utc"),
        func.avg(_hours.c.value).label("mean"),
        func.min(_hours.c.value).label("lowest"),
        func.max(_hours.c.value).label("highest"),
        func.count().label("readings"),
    ).group_by(*named_columns(_hours, "turbine signal time")),
)


def creation(dialect: sa.Dialect) -> list[str]:
    """Statements that create all tables and views in one database's SQL dialect."""
    tables = METADATA.tables.values()
    created: list[sa.ClauseElement] = [*map(CreateTable, tables)]
    created += [CreateIndex(index) for table in tables for index in table.indexes]
    return [*(str(item.compile(dialect=dialect)) for item in created), *view_creation(dialect)]


def view_creation(dialect: sa.Dialect) -> list[str]:
    """Statements that create all views in one database's SQL dialect."""
    literally = {"literal_binds": True}
    return [
        f"CREATE VIEW {name} AS {query.compile(dialect=dialect, compile_kwargs=literally)}"
        for name, query in VIEWS.items()
    ]
