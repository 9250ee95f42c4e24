"""The statements that write and read the store's tables, the same for both databases.

A parameter is named after its column.  A statement that is executed for many rows takes the values of a row
in the order of its parameters.  Each statement is built once, so that a connection compiles it once.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import sqlalchemy as sa
from sqlalchemy import Select, Table, bindparam, delete, func, select
from sqlalchemy.dialects.postgresql import Insert, insert

from hygrokf.live.storage import schema
from hygrokf.live.storage.schema import observation, revision

ACKNOWLEDGED_COLUMNS = ("acknowledged", "acknowledged_by", "cause", "note", "look_again")
"""Columns of an alarm that the page writes and the tracker leaves as they are."""
CLEARED: sa.ColumnElement[int] = sa.literal_column("0")
"""A cleared flag as a literal, because a statement for many rows has no parameter for it."""


# -- statements about any table ------------------------------------------------------------------------------
def matches(rows: sa.FromClause, names: str) -> sa.ColumnElement[bool]:
    """Condition: each named column equals the parameter of the same name."""
    first, *others = (rows.c[name] == bindparam(name) for name in names.split())
    return sa.and_(first, *others)


def is_since(rows: sa.FromClause) -> sa.ColumnElement[bool]:
    """Condition: the time of a row is `since` [s] or later."""
    return rows.c.time >= bindparam("since")


@cache
def select_rows(
    rows: sa.FromClause, names: str = "", same: str = "", order: str = "", since: bool = False
) -> Select[Any]:
    """Select the columns `names` ("": all) of the rows whose columns `same` equal their parameters and, with
    `since`, whose time [s] is not before the parameter of that name; sorted by the columns `order`."""
    query = select(*(rows.c[name] for name in names.split() or rows.c.keys()))
    query = query.where(matches(rows, same)) if same else query
    query = query.where(is_since(rows)) if since else query
    return query.order_by(*(rows.c[name] for name in order.split()))


@cache
def select_newest(rows: Table, names: str, same: str = "") -> Select[Any]:
    """Select columns of the newest row whose columns `same` equal their parameters."""
    return select_rows(rows, names, same).order_by(rows.c.time.desc()).limit(1)


@cache
def count_rows(rows: sa.FromClause, same: str = "", since: bool = False) -> Select[Any]:
    """Count the rows that `select_rows` would select."""
    return select_rows(rows, same=same, since=since).with_only_columns(
        func.count(), maintain_column_froms=True
    )


@cache
def insert_new(table: Table) -> Insert:
    """Insert a row, unless the table has a row with the same primary key.

    SQLite has PostgreSQL's ON CONFLICT clause, and its compiler writes it.
    """
    return insert(table).on_conflict_do_nothing()


@cache
def upsert(table: Table, *kept: str, newer: str = "", added: str = "") -> Insert:
    """Insert a row or, if the table has a row with the same primary key, replace all but the `kept` columns.

    The value of the column `added` is added to the old value.  Nothing is replaced if the column `newer`
    would decrease.
    """
    statement, keys = insert(table), list(table.primary_key)
    changed: dict[str, Any] = {
        column.name: statement.excluded[column.name]
        for column in table.c
        if column not in keys and column.name not in kept
    }
    if added:
        changed[added] += table.c[added]
    where = statement.excluded[newer] >= table.c[newer] if newer else None
    return statement.on_conflict_do_update(index_elements=keys, set_=changed, where=where)


@cache
def delete_rows(table: Table, same: str, since: bool = False) -> sa.Delete:
    """Delete the rows that `select_rows` would select."""
    statement = delete(table).where(matches(table, same))
    return statement.where(is_since(table)) if since else statement


@cache
def first_kept(time: sa.Column[Any], same: str) -> Select[Any]:
    """Select the time of one row before `until` [s] whose columns `same` equal their parameters: the row
    after the `first` oldest ones."""
    conditions = matches(time.table, same), time < bindparam("until")
    return select(time).where(*conditions).order_by(time).limit(1).offset(bindparam("first"))


@cache
def delete_before(time: sa.Column[Any], same: str) -> sa.Delete:
    """Delete the rows before `until` [s] whose columns `same` equal their parameters."""
    assert isinstance(time.table, Table), "the column belongs to a table"
    return delete_rows(time.table, same).where(time < bindparam("until"))


# -- what a batch changes ------------------------------------------------------------------------------------
_VERSION = revision.c.keys()[:-1]
FIRST_VERSION = (
    insert(revision)
    .from_select(
        [*_VERSION, "number"],
        select(*(observation.c[name] for name in _VERSION), CLEARED).where(
            matches(observation, "turbine signal time")
        ),
    )
    .on_conflict_do_nothing()
)
USE_VERSION = (
    sa.update(observation)
    .where(
        matches(revision, "turbine signal time"),
        revision.c.value == bindparam("used"),
        *(observation.c[name] == revision.c[name] for name in ("turbine", "signal", "time")),
    )
    .values({name: revision.c[name] for name in ("value", "received", "mark")})
    .values(contradicted=bindparam("is_contradicted"))
)
PROVISIONAL = delete_rows(schema.estimate, "turbine", since=True).where(schema.estimate.c.final == CLEARED)
_ALARM = sa.update(schema.alarm).where(matches(schema.alarm, "id"))
REOPEN = _ALARM.values(dict.fromkeys(("acknowledged", "acknowledged_by", "look_again"), sa.null()))
ACKNOWLEDGE = _ALARM.where(schema.alarm.c.acknowledged.is_(None)).values(
    {name: bindparam(f"new_{name}") for name in ACKNOWLEDGED_COLUMNS}
)
OLD_WEATHER = delete(schema.weather).where(schema.weather.c.time < bindparam("until"))


# -- readings ------------------------------------------------------------------------------------------------
def _signals() -> sa.CTE:
    """The signals of a turbine's readings, each by one index lookup; DISTINCT would scan all readings."""
    rows = observation.alias()
    first = select(func.min(observation.c.signal).label("signal")).where(matches(observation, "turbine"))
    known = first.cte("known", recursive=True)
    following = select(func.min(rows.c.signal)).where(
        matches(rows, "turbine"), rows.c.signal > known.c.signal
    )
    return known.union_all(select(following.scalar_subquery()).where(known.c.signal.is_not(None)))


_SIGNAL_NAMES = _signals()
SIGNALS_READ = select(_SIGNAL_NAMES.c.signal).where(_SIGNAL_NAMES.c.signal.is_not(None))
BEFORE_TIME = (
    select_rows(observation, "time", "turbine signal")
    .where(observation.c.late == 0, observation.c.time < bindparam("before"))
    .order_by(observation.c.time.desc())
    .limit(bindparam("most"))
)
READINGS = select_rows(
    observation, "time value mark contradicted", "turbine signal", "time", since=True
).where(observation.c.late == 0)
AT_TIMES = select_rows(observation, "signal time value mark", "turbine").where(
    observation.c.time.in_(bindparam("times", expanding=True))
)
COURSE = select_rows(observation, "signal time value", "turbine", "signal time", since=True).where(
    observation.c.signal.in_(bindparam("signals", expanding=True)),
    observation.c.time <= bindparam("until"),
    observation.c.contradicted == 0,
    observation.c.late == 0,
)
_HELD = schema.held.c
HELD = select_rows(
    schema.held, "turbine received signal time value mark", "turbine", "time signal received"
).where(_HELD.time <= bindparam("until"))
HELD_AHEAD = select(_HELD.turbine, _HELD.signal, func.max(_HELD.time), func.max(_HELD.received)).group_by(
    _HELD.turbine, _HELD.signal
)

# -- what trackers and people resume from --------------------------------------------------------------------
SCHEMA_NUMBER = select(func.max(schema.schema_version.c.version))
CLAIMS = select_rows(schema.claim, "kind name who")
LAST_CLAIM = select(schema.claim.c.who).order_by(schema.claim.c.since.desc()).limit(1)
OUTLOOK = select_rows(schema.forecast, "time condensation", "turbine", "time").where(
    schema.forecast.c.condensation.is_not(None)
)
SHELVES = select_rows(schema.shelf, order="turbine kind").where(schema.shelf.c.until > bindparam("now"))

# -- filtering anew ------------------------------------------------------------------------------------------
LATE_VERSIONS = count_rows(revision, "turbine").where(revision.c.late == 1, revision.c.number > 0)
USE_LATE, USE_LATE_VERSIONS = (
    sa.update(table).where(matches(table, "turbine"), table.c.late == 1).values(late=0)
    for table in (observation, revision)
)
CHANGE_MODEL = (
    sa.update(schema.turbine).where(matches(schema.turbine, "name")).values(model=bindparam("digest"))
)
FORGET_MEMORIES = delete_rows(schema.memory, "turbine").where(
    schema.memory.c.name.not_in(bindparam("kept", expanding=True))
)
BEGUN_ALARMS = select_rows(schema.alarm, same="turbine").where(schema.alarm.c.began >= bindparam("since"))

# -- the page ------------------------------------------------------------------------------------------------
_t, _e, _f, _a, _p = (
    rows.c for rows in (schema.turbine, schema.estimate, schema.forecast, schema.alarm, schema.property_now)
)
_RECEIVED = select_newest(observation, "received").where(observation.c.turbine == _t.name)
FLEET_ROWS = select(
    _t.name, _RECEIVED.scalar_subquery(), _e.time, _e.temperature_K, _e.temperature_sd, _e.relative_humidity,
    _e.relative_humidity_sd, _e.margin_K, _e.margin_sd, _e.condensation,
).join_from(
    schema.turbine, schema.estimate,
    (_e.turbine == _t.name) & (_e.time == schema.newest_time(schema.estimate)), isouter=True,
)  # fmt: skip
"""LEFT JOIN makes the database loop over turbines instead of scanning every estimate.  The arrival of the
newest reading stands for the last arrival, for which the database would have to scan every observation."""
OBSERVABLE = select(_p.turbine, func.max(_p.observable)).group_by(_p.turbine)
CHANCES = (
    select_rows(schema.forecast, "turbine condensation time", since=True)
    .where(_f.condensation.is_not(None))
    .order_by(_f.turbine, _f.condensation, _f.time.desc())
)
"""The last row of a turbine is its highest probability, at the earliest time."""
USED_VALUES = select_rows(observation, "time value", "turbine signal", "time", since=True).where(
    observation.c.contradicted == 0
)
ALARMS = (
    select_rows(schema.alarm)
    .where(_a.ended.is_(None) | (_a.ended >= bindparam("since")))
    .order_by(_a.began.desc())
)
ALARMS_OF = ALARMS.where(matches(schema.alarm, "turbine"))
CAUSE_COUNTS = select(_a.kind, _a.cause, func.count()).group_by(_a.kind, _a.cause)
PAST_MARGINS, FORECAST_MARGINS = (
    select_rows(rows, "time margin_K margin_sd", "turbine", since=True).where(
        rows.c.time < bindparam("until"), rows.c.margin_K.is_not(None)
    )
    for rows in (schema.estimate, schema.forecast)
)

# -- alarms and their notices --------------------------------------------------------------------------------
_n = schema.outbox.c
_WAITS = _n.sent.is_(None)
DUE = (
    select_rows(schema.outbox, same="channel", order="due id")
    .where(_WAITS, _n.due <= bindparam("now"))
    .limit(bindparam("most"))
)
CHANNEL_STATES = select(
    _n.channel,
    func.sum(sa.case((_WAITS, 1), else_=0)),
    func.min(sa.case((_WAITS, _n.made))),
    func.max(sa.case((_WAITS, _n.failure), else_="")),
    func.max(sa.case((_n.failure == "", _n.sent))),
).group_by(_n.channel)
NOTICES_ABOUT = select_rows(schema.outbox, same="channel", order="made id").where(
    func.substr(_n.id, 1, bindparam("length")) == bindparam("prefix")
)
_NOTICE = sa.update(schema.outbox).where(_n.id == bindparam("notice"))
KEEP_CONTENT = _NOTICE.values(content=bindparam("text"))
POSTPONE = _NOTICE.values(due=bindparam("at"))
DROP_NOTICE = _NOTICE.where(_WAITS).values(failure=bindparam("reason"), sent=bindparam("at"))
_ATTEMPTED = _NOTICE.values(attempts=_n.attempts + 1)
MARK_SENT = _ATTEMPTED.values(failure="", sent=bindparam("at"))
MARK_FAILED = _ATTEMPTED.values(due=bindparam("at"), failure=bindparam("reason"))
FORGET_NOTICES = delete(schema.outbox).where(
    _n.made < bindparam("before"), _WAITS | (_n.sent < bindparam("before"))
)
DUE_ALARMS = select_rows(schema.alarm, order="look_again id").where(
    _a.ended.is_(None), _a.acknowledged.is_not(None), _a.look_again <= bindparam("now")
)
