"""The statements with which the store writes and reads its tables, the same for both databases.

A parameter is named after its column.  A statement that is executed for many rows takes its parameters in the
order in which they stand in it.  A statement is made once, so that a connection compiles it once.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import sqlalchemy as sa
from sqlalchemy import Select, Table, bindparam, delete, func, select
from sqlalchemy.dialects.postgresql import Insert, insert

from hygrokf.live.storage import schema
from hygrokf.live.storage.schema import observation, revision

ACKNOWLEDGED = ("acknowledged", "acknowledged_by", "cause", "note", "look_again")
"""Columns of an alarm that the page writes and the tracker leaves as they are."""
ZERO: sa.ColumnElement[int] = sa.literal_column("0")
"""A flag that is not set, where a statement takes its parameters by their order."""


# -- statements about any table ------------------------------------------------------------------------------
def given(rows: sa.FromClause, names: str) -> sa.ColumnElement[bool]:
    """The condition that some columns have the values of the parameters of their names."""
    first, *others = (rows.c[name] == bindparam(name) for name in names.split())
    return sa.and_(first, *others)


def given_since(rows: sa.FromClause) -> sa.ColumnElement[bool]:
    """The condition that a row is from the time `since` [s] on."""
    return rows.c.time >= bindparam("since")


@cache
def selecting(
    rows: sa.FromClause, names: str = "", same: str = "", order: str = "", since: bool = False
) -> Select[Any]:
    """Select columns, or all, of the rows that have the values of the parameters `same` and, with `since`,
    are from that time [s] on; in an order."""
    query = select(*(rows.c[name] for name in names.split() or rows.c.keys()))
    query = query.where(given(rows, same)) if same else query
    query = query.where(given_since(rows)) if since else query
    return query.order_by(*(rows.c[name] for name in order.split()))


@cache
def newest(rows: Table, names: str, same: str = "") -> Select[Any]:
    """Select columns of the newest row that has the values of the parameters `same`."""
    return selecting(rows, names, same).order_by(rows.c.time.desc()).limit(1)


@cache
def counting(rows: sa.FromClause, same: str = "", since: bool = False) -> Select[Any]:
    """Count the rows that `selecting` would select."""
    return selecting(rows, same=same, since=since).with_only_columns(func.count(), maintain_column_froms=True)


@cache
def inserting(table: Table) -> Insert:
    """Insert a row, unless there is one with its key.

    SQLite has PostgreSQL's ON CONFLICT clause, and its compiler writes it.
    """
    return insert(table).on_conflict_do_nothing()


@cache
def replacing(table: Table, *kept: str, newer: str = "", added: str = "") -> Insert:
    """Insert a row or, where there is one with its key, replace all but the `kept` columns, only if the
    column `newer` has not decreased, and add to the column `added`."""
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
def deleting(table: Table, same: str, since: bool = False) -> sa.Delete:
    """Delete the rows that `selecting` would select."""
    statement = delete(table).where(given(table, same))
    return statement.where(given_since(table)) if since else statement


@cache
def first_kept(time: sa.Column[Any], same: str) -> Select[Any]:
    """The oldest time before `until` [s] of rows with the values of the parameters `same`, after the `first`
    of them."""
    before = given(time.table, same), time < bindparam("until")
    return select(time).where(*before).order_by(time).limit(1).offset(bindparam("first"))


@cache
def deleting_before(time: sa.Column[Any], same: str) -> sa.Delete:
    """Delete the rows with the values of the parameters `same` from before `until` [s]."""
    assert isinstance(time.table, Table), "a column of a table"
    return deleting(time.table, same).where(time < bindparam("until"))


# -- what a batch changes ------------------------------------------------------------------------------------
_VERSION = revision.c.keys()[:-1]
FIRST_VERSION = (
    insert(revision)
    .from_select(
        [*_VERSION, "number"],
        select(*(observation.c[name] for name in _VERSION), ZERO).where(
            given(observation, "turbine signal time")
        ),
    )
    .on_conflict_do_nothing()
)
USE_VERSION = (
    sa.update(observation)
    .where(
        given(revision, "turbine signal time"),
        revision.c.value == bindparam("used"),
        *(observation.c[name] == revision.c[name] for name in ("turbine", "signal", "time")),
    )
    .values({name: revision.c[name] for name in ("value", "received", "mark")})
    .values(contradicted=bindparam("wrong"))
)
PROVISIONAL = deleting(schema.estimate, "turbine", since=True).where(schema.estimate.c.final == ZERO)
_ALARM = sa.update(schema.alarm).where(given(schema.alarm, "id"))
REOPEN = _ALARM.values(dict.fromkeys(("acknowledged", "acknowledged_by", "look_again"), sa.null()))
ACKNOWLEDGE = _ALARM.where(schema.alarm.c.acknowledged.is_(None)).values(
    {name: bindparam(f"new_{name}") for name in ACKNOWLEDGED}
)
OLD_WEATHER = delete(schema.weather).where(schema.weather.c.time < bindparam("until"))


# -- readings ------------------------------------------------------------------------------------------------
def _signals() -> sa.CTE:
    """The signals of a turbine's readings, found with one index lookup each; DISTINCT would scan them all."""
    rows = observation.alias()
    first = select(func.min(observation.c.signal).label("signal")).where(given(observation, "turbine"))
    found = first.cte("known", recursive=True)
    following = select(func.min(rows.c.signal)).where(given(rows, "turbine"), rows.c.signal > found.c.signal)
    return found.union_all(select(following.scalar_subquery()).where(found.c.signal.is_not(None)))


_known = _signals()
SIGNALS = select(_known.c.signal).where(_known.c.signal.is_not(None))
BEFORE_TIME = (
    selecting(observation, "time", "turbine signal")
    .where(observation.c.late == 0, observation.c.time < bindparam("before"))
    .order_by(observation.c.time.desc())
    .limit(bindparam("most"))
)
READINGS = selecting(observation, "time value mark contradicted", "turbine signal", "time", since=True).where(
    observation.c.late == 0
)
AT_TIMES = selecting(observation, "signal time value mark", "turbine").where(
    observation.c.time.in_(bindparam("times", expanding=True))
)
COURSE = selecting(observation, "signal time value", "turbine", "signal time", since=True).where(
    observation.c.signal.in_(bindparam("signals", expanding=True)),
    observation.c.time <= bindparam("until"),
    observation.c.contradicted == 0,
    observation.c.late == 0,
)
_HELD = schema.held.c
HELD = selecting(
    schema.held, "turbine received signal time value mark", "turbine", "time signal received"
).where(_HELD.time <= bindparam("until"))
HELD_AHEAD = select(_HELD.turbine, _HELD.signal, func.max(_HELD.time), func.max(_HELD.received)).group_by(
    _HELD.turbine, _HELD.signal
)

# -- what trackers and people resume from --------------------------------------------------------------------
SCHEMA_NUMBER = select(func.max(schema.schema_version.c.version))
CLAIMS = selecting(schema.claim, "kind name who")
LAST_CLAIM = select(schema.claim.c.who).order_by(schema.claim.c.since.desc()).limit(1)
OUTLOOK = selecting(schema.forecast, "time condensation", "turbine", "time").where(
    schema.forecast.c.condensation.is_not(None)
)
SHELVES = selecting(schema.shelf, order="turbine kind").where(schema.shelf.c.until > bindparam("now"))

# -- filtering anew ------------------------------------------------------------------------------------------
LATE_VERSIONS = counting(revision, "turbine").where(revision.c.late == 1, revision.c.number > 0)
USE_LATE, USE_LATE_VERSIONS = (
    sa.update(table).where(given(table, "turbine"), table.c.late == 1).values(late=0)
    for table in (observation, revision)
)
CHANGE_MODEL = (
    sa.update(schema.turbine).where(given(schema.turbine, "name")).values(model=bindparam("digest"))
)
FORGET_MEMORIES = deleting(schema.memory, "turbine").where(
    schema.memory.c.name.not_in(bindparam("kept", expanding=True))
)
BEGUN_ALARMS = selecting(schema.alarm, same="turbine").where(schema.alarm.c.began >= bindparam("since"))

# -- the page ------------------------------------------------------------------------------------------------
_t, _e, _f, _a, _p = (
    rows.c for rows in (schema.turbine, schema.estimate, schema.forecast, schema.alarm, schema.property_now)
)
_RECEIVED = newest(observation, "received").where(observation.c.turbine == _t.name)
FLEET = select(
    _t.name, _RECEIVED.scalar_subquery(), _e.time, _e.temperature_K, _e.temperature_sd, _e.relative_humidity,
    _e.relative_humidity_sd, _e.margin_K, _e.margin_sd, _e.condensation,
).join_from(
    schema.turbine, schema.estimate,
    (_e.turbine == _t.name) & (_e.time == schema.newest_time(schema.estimate)), isouter=True,
)  # fmt: skip
"""LEFT JOIN makes the database loop over turbines instead of scanning every estimate; the newest reading
stands for the last received one, which only a scan of every observation would find."""
OBSERVABLE = select(_p.turbine, func.max(_p.observable)).group_by(_p.turbine)
CHANCES = (
    selecting(schema.forecast, "turbine condensation time", since=True)
    .where(_f.condensation.is_not(None))
    .order_by(_f.turbine, _f.condensation, _f.time.desc())
)
"""The last row of a turbine is its highest chance, at the first time."""
USED_VALUES = selecting(observation, "time value", "turbine signal", "time", since=True).where(
    observation.c.contradicted == 0
)
ALARMS = (
    selecting(schema.alarm)
    .where(_a.ended.is_(None) | (_a.ended >= bindparam("since")))
    .order_by(_a.began.desc())
)
ALARMS_OF = ALARMS.where(given(schema.alarm, "turbine"))
CAUSES = select(_a.kind, _a.cause, func.count()).group_by(_a.kind, _a.cause)
PAST_MARGINS, FORECAST_MARGINS = (
    selecting(rows, "time margin_K margin_sd", "turbine", since=True).where(
        rows.c.time < bindparam("until"), rows.c.margin_K.is_not(None)
    )
    for rows in (schema.estimate, schema.forecast)
)

# -- alarms and their notices --------------------------------------------------------------------------------
_n = schema.outbox.c
_WAITS = _n.sent.is_(None)
DUE = (
    selecting(schema.outbox, same="channel", order="due id")
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
NOTICES_ABOUT = selecting(schema.outbox, same="channel", order="made id").where(
    func.substr(_n.id, 1, bindparam("length")) == bindparam("prefix")
)
_NOTICE = sa.update(schema.outbox).where(_n.id == bindparam("notice"))
KEEP_CONTENT = _NOTICE.values(content=bindparam("text"))
POSTPONE = _NOTICE.values(due=bindparam("at"))
DROP = _NOTICE.where(_WAITS).values(failure=bindparam("reason"), sent=bindparam("at"))
_ATTEMPTED = _NOTICE.values(attempts=_n.attempts + 1)
MARK_SENT = _ATTEMPTED.values(failure="", sent=bindparam("at"))
MARK_FAILED = _ATTEMPTED.values(due=bindparam("at"), failure=bindparam("reason"))
FORGET_NOTICES = delete(schema.outbox).where(
    _n.made < bindparam("before"), _WAITS | (_n.sent < bindparam("before"))
)
DUE_AGAIN = selecting(schema.alarm, order="look_again id").where(
    _a.ended.is_(None), _a.acknowledged.is_not(None), _a.look_again <= bindparam("now")
)
