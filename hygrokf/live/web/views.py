"""The data that the page shows, read from the store: the fleet by risk, one turbine's last days, alarms.

Temperatures are in °C, relative humidity in %, times in seconds since 1970, UTC.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, TypedDict, TypeVar

import numpy as np
from sqlalchemy import ColumnElement, Join, Table, and_, func, select
from sqlalchemy.sql.base import ReadOnlyColumnCollection

from hygrokf.data.structured import Json, structured
from hygrokf.data.timestamps import HOUR_S
from hygrokf.identification.verdict_terms import MARKS, PARAMETER_OF, VERDICTS, Inherited
from hygrokf.live.alarms import CHANGED
from hygrokf.live.assessment import NOT_ASSESSED
from hygrokf.live.batch import CAUSES, STATES, Alarm, Assessment
from hygrokf.live.condition import QUANTITIES, Z95, Quantity, probability_above
from hygrokf.live.forecast import LIMIT, ForecastMade
from hygrokf.live.plan import Need
from hygrokf.live.properties import WATCHED
from hygrokf.live.service import Health
from hygrokf.live.sources.stream import Stream
from hygrokf.live.storage import schema
from hygrokf.live.storage.database import Row
from hygrokf.live.storage.schema import matching
from hygrokf.live.storage.store import Store
from hygrokf.live.web.signal_rows import SignalRow, signal_rows
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K

DECIMALS = 4
"""Decimal places of numbers sent to the page; rounding halves the size of the response."""
FRESH_S = HOUR_S
"""[s] since the last reading after which a turbine's data are no longer fresh."""
RIGHT, WRONG = ("defect", "settings changed"), ("false alarm",)
"""Causes of acknowledgements that say that an alarm was right, or wrong."""
SEVERITY = {"alarm": 2, "warning": 1, "notice": 0}
COURSES = {q.name: q for q in QUANTITIES if q.name != "frost_point"}
MOST = 3000
"""Largest number of points in a course; longer courses are thinned."""
READ = {"temperature": "cabinet_temperature", "relative_humidity": "cabinet_relative_humidity"}
"""Quantity on the page -> the cabinet's own signal."""
Verdicts = Mapping[str, Inherited]
"""A fit's verdicts on the numbers of a turbine's model, by part."""
T = TypeVar("T")


class Chance(TypedDict):
    """The highest forecast probability of condensation [1], and the first time [s] it is reached."""

    condensation: float
    time: float


class StateView(TypedDict):
    """The `state` of a turbine, one of `STATES`, `since` a time [s], with its `reason`."""

    state: str
    reason: str
    since: float | None


class FleetRow(StateView):
    """A turbine in the fleet's table: temperatures [°C], `margin` [K], humidity [%], probabilities [1], times
    [s].

    `…_half` is half the width of a 95 % band; `cabinet` says whether its properties are as fitted; `severity`
    is that of its worst open alarm (`SEVERITY`), −1 without any.
    """

    turbine: str
    time: float | None
    heard: float | None
    fresh: bool
    temperature: float | None
    temperature_half: float | None
    relative_humidity: float | None
    relative_humidity_half: float | None
    margin: float | None
    margin_lower: float | None
    condensation: float | None
    forecast: Chance | None
    cabinet: str | None
    alarms: list[Alarm]
    model: str | None
    severity: int


class NumberVerdict(TypedDict):
    """The verdict on one number of a model, as the page shows it."""

    part: str
    property: str
    verdict: str
    mark: str
    words: str
    why: str


class ModelView(TypedDict):
    """The worst verdict on a model, None without any, and the verdict on each of its numbers."""

    verdict: str | None
    numbers: list[NumberVerdict]


class Course(TypedDict):
    """A quantity at the instants of a course, with bounds of 95 %."""

    value: list[float | None]
    lower: list[float | None]
    upper: list[float | None]


class PropertyCourse(Course):
    """A property with its course; `reference` and `observable` are those of its newest row."""

    name: str
    unit: str
    time: list[float]
    reference: float
    observable: bool


class ReadingCourse(TypedDict):
    """The cabinet's own readings of a quantity, at times [s]."""

    time: list[float]
    value: list[float | None]


class Hourly(TypedDict):
    """(beginning [s], highest probability) of every past hour and of every hour of the forecast."""

    past: list[tuple[float, float]]
    forecast: list[tuple[float, float]]


class HumidHours(Hourly):
    """The same for a relative humidity above a `limit` [1]."""

    limit: float


class ForecastView(TypedDict):
    """The newest forecast, from the state at `made` [s] on, of a humidity `limit` [1] (None in stores of
    earlier versions).

    `weather` describes the scenarios, or says why there is no forecast; the courses are empty then.
    `condensation` and `above_limit` [1] and `courses` at the instants `time` [s].
    """

    made: float
    weather: str
    limit: float | None
    time: list[float]
    condensation: list[float | None]
    above_limit: list[float | None]
    courses: dict[str, Course]
    advice: Json


class TurbineView(StateView):
    """One turbine on the page.

    `final`: 1 for final estimates; `condensation` [1] and `courses` at the instants `time` [s]; `counts`:
    readings that were not used, by kind; `held`: number of readings that are held back, because their stamps
    are ahead of the clock.
    """

    turbine: str
    model: ModelView
    time: list[float]
    final: list[int]
    condensation: list[float | None]
    hours: Hourly
    humid: HumidHours
    courses: dict[str, Course]
    readings: dict[str, ReadingCourse]
    forecast: ForecastView | None
    properties: list[PropertyCourse]
    alarms: list[Alarm]
    signals: list[SignalRow]
    counts: dict[str, int]
    held: int


class KindLabels(TypedDict):
    """Alarms of one kind in the store: how many, how many with each cause of an acknowledgement, and how many
    of those were right (something had changed) or wrong; the others are not known."""

    kind: str
    alarms: int
    causes: dict[str, int]
    right: int
    wrong: int


class SourceRow(TypedDict):
    """A source with its state in one word and its explanation.

    `heard`: when its last message was committed [s], None if none was; `lag`: time [s] from its newest
    reading to its arrival; `not_reached`: since when [s] it is not reached, None while it is; `ordered_by`:
    what orders the versions of a value.
    """

    url: str
    state: str
    words: str
    heard: float | None
    lag: float | None
    not_reached: float | None
    ordered_by: str


class HealthView(TypedDict):
    """The sources and the store.

    `store`: why the store fails, empty if it does not; `committed`: time of the last commit [s]; `wait_99_s`:
    time [s] within which 99 % of the deliveries were committed; `refused`: deliveries of no turbine, by kind.
    """

    sources: list[SourceRow]
    store: str
    deliveries: int
    committed: float
    wait_99_s: float | None
    refused: dict[str, int]


def model_view(verdicts: Verdicts) -> ModelView:
    """The verdict on a turbine's model, which is the worst verdict on its numbers, and the verdict on each
    number."""
    numbers: list[NumberVerdict] = [
        {
            "part": part,
            "property": PARAMETER_OF[part],
            "verdict": found.verdict,
            "mark": MARKS[found.verdict],
            "words": found.words,
            "why": found.why,
        }
        for part, found in verdicts.items()
    ]
    worst = max((VERDICTS.index(one["verdict"]) for one in numbers), default=None)
    return {"verdict": None if worst is None else VERDICTS[worst], "numbers": numbers}


def fleet_view(
    store: Store,
    names: Sequence[str],
    now: float,
    verdicts: Mapping[str, Verdicts] = MappingProxyType({}),
) -> list[FleetRow]:
    """One row per turbine, sorted by the need of its state, then by the severity of open alarms and by the
    present or forecast risk of condensation.

    verdicts: turbine → verdicts on the numbers of its model.
    """
    t, e, o = schema.turbine.c, schema.estimate.c, schema.observation.c
    # LEFT JOIN makes the database loop over turbines instead of scanning every estimate
    newest = {
        turbine: row
        for turbine, *row in store.rows(
            select(
                t.name, e.time, e.temperature_K, e.temperature_sd, e.relative_humidity,
                e.relative_humidity_sd, e.margin_K, e.margin_sd, e.condensation,
            ).select_from(_newest_of(schema.estimate))
        )
    }  # fmt: skip
    # the newest reading stands for the last received one, which only a scan of every observation would find
    last_one = select(o.received).where(o.turbine == t.name).order_by(o.time.desc()).limit(1)
    heard: dict[str, float | None] = dict(store.rows(select(t.name, last_one.scalar_subquery())))
    states = store.assessments()
    cabinets, highest = _cabinets(store), _highest_forecast(store, now)
    open_: dict[str, list[Alarm]] = {}
    for alarm in alarms_view(store, since=math.inf):
        open_.setdefault(alarm.turbine, []).append(alarm)
    rows: list[FleetRow] = []
    for name in names:
        at, kelvin, kelvin_sd, humidity, humidity_sd, margin, margin_sd, chance = newest.get(name, [None] * 8)
        alarms = open_.get(name, [])
        last = heard.get(name)
        rows.append(
            {
                "turbine": name,
                **_state(states.get(name)),
                "time": at,
                "heard": last,
                "fresh": last is not None and now - last < FRESH_S,
                "temperature": _scaled(kelvin, 1.0, -ZERO_CELSIUS_K),
                "temperature_half": _scaled(kelvin_sd, Z95, 0.0),
                "relative_humidity": _scaled(humidity, 100.0, 0.0),
                "relative_humidity_half": _scaled(humidity_sd, 100.0 * Z95, 0.0),
                "margin": margin,
                "margin_lower": None if margin is None else margin - Z95 * margin_sd,
                "condensation": chance,
                "forecast": highest.get(name),
                "cabinet": "changed" if any(a.kind == CHANGED.kind for a in alarms) else cabinets.get(name),
                "alarms": alarms,
                "model": model_view(verdicts.get(name, {}))["verdict"],
                "severity": max((SEVERITY[a.severity] for a in alarms), default=-1),
            }
        )
    rows.sort(key=lambda row: (STATES.index(row["state"]), -row["severity"], -_risk(row), row["turbine"]))
    return rows


def _newest_of(rows: Table, **same: object) -> Join:
    """Turbines, each with the newest of its rows that have the same values."""
    own = rows.c.turbine == schema.turbine.c.name, matching(rows, **same)
    return schema.turbine.outerjoin(rows, and_(*own, rows.c.time == schema.newest(rows, **same)))


def fleet_summary(rows: Iterable[FleetRow]) -> dict[str, int]:
    """Number of turbines in each of the `STATES`."""
    counts = Counter(row["state"] for row in rows)
    return {state: counts[state] for state in STATES}


def _state(found: Assessment | None) -> StateView:
    """A turbine's assessment; a turbine that was never assessed has no estimate."""
    if found is None:
        return {"state": "no estimate", "reason": NOT_ASSESSED, "since": None}
    return {"state": found.state, "reason": found.reason, "since": found.since}


def _risk(row: FleetRow) -> float:
    coming = row["forecast"]["condensation"] if row["forecast"] else 0.0
    return max(row["condensation"] or 0.0, coming)


def _cabinets(store: Store) -> dict[str, str]:
    """Whether the properties of each turbine's cabinet are observable now: turbine → words for the page."""
    found: dict[str, str] = {}
    for one in WATCHED:
        newest = select(schema.turbine.c.name, schema.property_.c.observable)
        for turbine, observable in store.rows(
            newest.select_from(_newest_of(schema.property_, name=one.name))
        ):
            if observable or (observable is not None and turbine not in found):
                found[turbine] = "as fitted" if observable else "not observable"
    return found


def _highest_forecast(store: Store, now: float) -> dict[str, Chance]:
    """The highest forecast probability of condensation for each turbine, and the first time it is reached."""
    found: dict[str, Chance] = {}
    f = schema.forecast.c
    coming = select(f.turbine, f.time, f.condensation).where(f.time >= now, f.condensation.is_not(None))
    for turbine, at, chance in store.rows(coming.order_by(f.turbine, f.time)):
        if turbine not in found or chance > found[turbine]["condensation"]:
            found[turbine] = {"condensation": chance, "time": at}
    return found


def turbine_view(
    store: Store,
    name: str,
    since: float,
    now: float,
    verdicts: Verdicts = MappingProxyType({}),
    needs: Sequence[Need] = (),
) -> TurbineView:
    """One turbine from `since` [s] on: courses with bounds, readings, properties, alarms, counts.

    needs: what its model reads, of which signals that never came are listed too.
    """
    e, o = schema.estimate.c, schema.observation.c
    estimates = select(*_air(e), e.time, e.final, e.condensation).where(e.turbine == name, e.time >= since)
    found = _thin(store.rows(estimates.order_by(e.time)))
    readings: dict[str, ReadingCourse] = {}
    for quantity, signal in READ.items():
        shown = COURSES[quantity]
        own = matching(schema.observation, turbine=name, signal=signal, contradicted=0)
        rows = _thin(store.rows(select(o.time, o.value).where(own, o.time >= since).order_by(o.time)))
        if rows:
            readings[quantity] = {
                "time": [at for at, _ in rows],
                "value": [_scaled(value, shown.factor, shown.offset) for _, value in rows],
            }
    time, chances = [row[-3] for row in found], [row[-1] for row in found]
    forecast = _forecast(store, name)
    limit = LIMIT if forecast is None or forecast["limit"] is None else forecast["limit"]
    alarms = alarms_view(store, name, since)
    return {
        "turbine": name,
        **_state(store.assessments().get(name)),
        "model": model_view(verdicts),
        "time": time,
        "final": [row[-2] for row in found],
        "condensation": chances,
        "hours": {
            "past": by_hour(time, chances),
            "forecast": by_hour(forecast["time"], forecast["condensation"]) if forecast else [],
        },
        "humid": {
            "limit": limit,
            "past": by_hour(time, _humid(found, limit)),
            "forecast": by_hour(forecast["time"], forecast["above_limit"]) if forecast else [],
        },
        "courses": _courses(found),
        "readings": readings,
        "forecast": forecast,
        "properties": _properties(store, name, since),
        "alarms": alarms,
        "signals": signal_rows(store, name, now, needs, alarms),
        "counts": {kind: n for (turbine, kind), n in sorted(store.counters().items()) if turbine == name},
        "held": store.held_count(name),
    }


def _humid(rows: Sequence[Row], limit: float) -> list[float | None]:
    """Probability that relative humidity exceeds a limit, from rows that begin with the columns of
    `COURSES`."""
    place = 2 * list(COURSES).index("relative_humidity")
    value, sd = np.array([row[place : place + 2] for row in rows], dtype=float).reshape(-1, 2).T
    chances = probability_above(Quantity(value, sd), limit)
    return [None if math.isnan(v) else float(p) for v, p in zip(value, chances, strict=True)]


def by_hour(time: Sequence[float], values: Sequence[float | None]) -> list[tuple[float, float]]:
    """(beginning [s], highest value) of every hour with a value."""
    most: dict[float, float] = {}
    for at, value in zip(time, values, strict=True):
        if value is not None:
            hour = HOUR_S * (at // HOUR_S)
            most[hour] = max(value, most.get(hour, value))
    return sorted(most.items())


def _air(columns: ReadOnlyColumnCollection[str, Any]) -> list[ColumnElement[Any]]:
    """Value and standard deviation of each of the `COURSES`."""
    return [columns[name] for q in COURSES.values() for name in (q.column, q.sd_column)]


def _courses(rows: Sequence[Row]) -> dict[str, Course]:
    """Value and bounds of each quantity that has values, from rows that begin with the columns of
    `COURSES`."""
    courses: dict[str, Course] = {}
    for place, (quantity, shown) in enumerate(COURSES.items()):
        factor, offset = shown.factor, shown.offset
        pairs = [(row[2 * place], row[2 * place + 1]) for row in rows]
        if all(value is None for value, _ in pairs):
            continue
        courses[quantity] = {
            "value": [_scaled(value, factor, offset) for value, _ in pairs],
            "lower": [_scaled(value, factor, offset, -Z95 * factor, sd) for value, sd in pairs],
            "upper": [_scaled(value, factor, offset, Z95 * factor, sd) for value, sd in pairs],
        }
    return courses


def _forecast(store: Store, name: str) -> ForecastView | None:
    """A turbine's newest forecast and the advice for a restart; None before the first one."""
    memory = store.memory(name, "forecast")
    if not memory:
        return None
    made = structured(ForecastMade, memory)
    f = schema.forecast.c
    courses = select(*_air(f), f.time, f.condensation, f.above_limit).where(f.turbine == name)
    rows = store.rows(courses.order_by(f.time))
    return {
        "made": made.made,
        "weather": made.weather,
        "limit": made.limit,
        "time": [row[-3] for row in rows],
        "condensation": [row[-2] for row in rows],
        "above_limit": [row[-1] for row in rows],
        "courses": _courses(rows),
        "advice": store.memory(name, "advice"),
    }


def alarms_view(store: Store, turbine: str | None = None, since: float = -math.inf) -> list[Alarm]:
    """Alarms of one turbine or of all that are open or ended at `since` [s] or later.

    Open alarms come first; within each group the most severe come first, and then the newest.
    """
    a = schema.alarm.c
    alarms = select(schema.alarm).where(a.ended.is_(None) | (a.ended >= since)).order_by(a.began.desc())
    found = store.found(Alarm, alarms if turbine is None else alarms.where(a.turbine == turbine))
    return sorted(found, key=lambda alarm: (alarm.ended is not None, -SEVERITY[alarm.severity]))


def labels_view(store: Store) -> list[KindLabels]:
    """How often each kind of alarm was right, as those say who acknowledged it; by kind."""
    found: dict[str, KindLabels] = {}
    a = schema.alarm.c
    for kind, cause, count in store.rows(select(a.kind, a.cause, func.count()).group_by(a.kind, a.cause)):
        row = found.setdefault(
            kind, {"kind": kind, "alarms": 0, "causes": dict.fromkeys(CAUSES, 0), "right": 0, "wrong": 0}
        )
        row["alarms"] += int(count)
        if cause in row["causes"]:
            row["causes"][cause] += int(count)
            row["right"] += int(count) * (cause in RIGHT)
            row["wrong"] += int(count) * (cause in WRONG)
    return [found[kind] for kind in sorted(found)]


def _properties(store: Store, name: str, since: float) -> list[PropertyCourse]:
    """Each property with its course, whose last value is the present one."""
    found: dict[str, PropertyCourse] = {}
    p = schema.property_.c
    columns = (p.name, p.unit, p.time, p.value, p.lower_bound, p.upper_bound, p.reference, p.observable)
    rows = select(*columns).where(p.turbine == name, p.time >= since).order_by(p.time)
    for prop, unit, at, value, lower, upper, reference, observable in store.rows(rows):
        factor = 100.0 if unit == "1" else 1.0  # shares are shown in per cent
        one = found.setdefault(
            prop,
            {
                "name": prop,
                "unit": "%" if unit == "1" else unit,
                "time": [],
                "value": [],
                "lower": [],
                "upper": [],
                "reference": 0.0,
                "observable": False,
            },
        )
        one["reference"], one["observable"] = factor * reference, bool(observable)
        one["time"].append(at)
        for course, number in ((one["value"], value), (one["lower"], lower), (one["upper"], upper)):
            course.append(None if number is None else factor * number)
    return list(found.values())


def _scaled(
    value: float | None, factor: float, offset: float, width: float = 0.0, sd: float | None = 0.0
) -> float | None:
    return None if value is None else round(factor * value + offset + width * (sd or 0.0), DECIMALS)


def _thin(rows: Sequence[T]) -> Sequence[T]:
    """At most `MOST` evenly spaced rows, including the last one."""
    step = -(-len(rows) // MOST)
    return rows if step <= 1 else rows[(len(rows) - 1) % step :: step]


def health_view(
    streams: Mapping[str, Stream], health: Health, counters: Mapping[tuple[str, str], int]
) -> HealthView:
    """State of sources and store, and counts of refused deliveries that belong to no turbine."""
    sources: list[SourceRow] = []
    for url, one in streams.items():
        state, times, neither = one.state, health.sources.get(url), one.mapping.revision == "neither"
        sources.append(
            {
                "url": url,
                "state": state.word,
                "words": state.words,
                "heard": None if times is None else times.committed,
                "lag": None if times is None else times.lag_s,
                "not_reached": None if one.played_back else one.reach().since,
                "ordered_by": "nothing: neither counts" if neither else one.ordered_by,
            }
        )
    return {
        "sources": sources,
        "store": health.store,
        "deliveries": health.deliveries,
        "committed": health.committed_s,
        "wait_99_s": health.wait_s(0.99),
        "refused": {kind: n for (turbine, kind), n in sorted(counters.items()) if not turbine},
    }
