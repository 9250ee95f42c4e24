"""The data that the page shows, read from the store: the fleet by risk, one turbine's last days, alarms.

Temperatures are in °C, relative humidity in %, times in seconds since 1970, UTC.
"""

from __future__ import annotations

import math
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from hygrokf.data.signals import SIGNALS, from_si
from hygrokf.data.structured import plain, structured
from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.identification.verdict_terms import PARAMETER_OF, Inherited
from hygrokf.live.alarms import CABINET_CHANGED, CONTRADICTS
from hygrokf.live.batch import STATED_CAUSES, TURBINE_STATES, Alarm, Assessment, pieces_of, stated_text
from hygrokf.live.condition import DISPLAYED_QUANTITIES, Z95, Quantity, probability_above
from hygrokf.live.forecast import LIMIT, ForecastMade
from hygrokf.live.plan import Need
from hygrokf.live.properties import WATCHED
from hygrokf.live.service import Health
from hygrokf.live.sources.stream import Stream
from hygrokf.live.storage import schema, statements
from hygrokf.live.storage.database import Row
from hygrokf.live.storage.statements import count_rows, select_newest, select_rows
from hygrokf.live.storage.store import Store
from hygrokf.live.web.reader import Reader
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.texts.live_codes import StateCode
from hygrokf.texts.reasons import MARKS, VERDICTS

DECIMALS = 4
"""Decimal places of numbers sent to the page; rounding halves the size of a response."""
RIGHT, WRONG = ("defect", "settings changed"), ("false alarm",)
"""Causes of acknowledgements that state that an alarm was right, and that it was wrong."""
SEVERITY = {"alarm": 2, "warning": 1, "notice": 0}
COURSES = {q.name: q for q in DISPLAYED_QUANTITIES if q.name != "frost_point"}
_COLUMNS = " ".join(f"{q.column} {q.sd_column}" for q in COURSES.values())
MOST_COURSE_POINTS = 3000
"""Largest number of points in a course; longer courses are thinned."""
CABINET_SIGNALS_SHOWN = {
    "temperature": "cabinet_temperature",
    "relative_humidity": "cabinet_relative_humidity",
}
"""Quantity on the page → the measured signal of the cabinet."""
Verdicts = Mapping[str, Inherited]
"""Part of a turbine's model → the fit's verdict on its number."""
View = dict[str, Any]
"""JSON of the page; the function that returns it describes the content."""
T = TypeVar("T")


def model_view(verdicts: Verdicts) -> View:
    """The `numbers` of a turbine's model with the verdict on each, and the worst `verdict` (None without
    numbers)."""
    numbers = [
        {
            "part": part,
            "property": PARAMETER_OF[part],
            "verdict": inherited.verdict,
            "mark": MARKS[inherited.verdict],
            "words": inherited.words,
            "why": inherited.why,
        }
        for part, inherited in verdicts.items()
    ]
    verdict = max((inherited.verdict for inherited in verdicts.values()), key=VERDICTS.index, default=None)
    return {"verdict": verdict, "numbers": numbers}


def fleet_view(
    store: Store,
    names: Sequence[str],
    now: float,
    verdicts: Mapping[str, Verdicts] = MappingProxyType({}),
) -> list[View]:
    """One row per turbine, sorted by the urgency of its state, then by the severity of open alarms, then by
    the present or forecast risk of condensation.

    `time`: time of the newest estimate; `heard`: time of the last arrival; `…_half`: half the width of a 95 %
    band; `margin` [K]; `forecast`: the highest forecast probability of `condensation` [1] and the earliest
    `time` of that value; `cabinet`: whether the cabinet's properties are as fitted; `severity`: severity of
    the worst open alarm (`SEVERITY`), −1 without open alarms.

    verdicts: turbine → verdicts on the numbers of its model.
    """
    latest = {turbine: row for turbine, *row in store.rows(statements.FLEET_ROWS)}
    observable: dict[str, int] = dict(store.rows(statements.OBSERVABLE))
    highest = {
        turbine: {"condensation": chance, "time": at}
        for turbine, chance, at in store.rows(statements.CHANCES, since=now)
    }
    states, open_alarms = store.assessments(), alarms_view(store, since=math.inf)
    rows: list[View] = []
    for name in names:
        heard, at, temperature, temperature_sd, humidity, humidity_sd, margin, margin_sd, chance = latest.get(
            name, [None] * 9
        )
        alarms = [alarm for alarm in open_alarms if alarm.turbine == name]
        cabinet = {None: None, 0: "not observable", 1: "as fitted"}[observable.get(name)]
        rows.append(
            {
                "turbine": name,
                **_state(states.get(name)),
                "time": at,
                "heard": heard,
                "temperature": _scaled(temperature, 1.0, -ZERO_CELSIUS_K),
                "temperature_half": _scaled(temperature_sd, Z95, 0.0),
                "relative_humidity": _scaled(humidity, 100.0, 0.0),
                "relative_humidity_half": _scaled(humidity_sd, 100.0 * Z95, 0.0),
                "margin": margin,
                "margin_lower": None if margin is None else margin - Z95 * margin_sd,
                "condensation": chance,
                "forecast": highest.get(name),
                "cabinet": "changed"
                if any(alarm.kind == CABINET_CHANGED.kind for alarm in alarms)
                else cabinet,
                "alarms": alarms,
                "model": model_view(verdicts.get(name, {}))["verdict"],
                "severity": max((SEVERITY[alarm.severity] for alarm in alarms), default=-1),
            }
        )
    return sorted(rows, key=_urgency)


def _urgency(row: View) -> tuple[int, int, float, str]:
    forecast_risk = row["forecast"]["condensation"] if row["forecast"] else 0.0
    risk = max(row["condensation"] or 0.0, forecast_risk)
    return TURBINE_STATES.index(row["state"]), -row["severity"], -risk, row["turbine"]


def _state(assessment: Assessment | None) -> View:
    """A turbine's `state`, the time [s] `since` which it has that state, and the `reason` as text, as codes
    with values (`content`) and as `pieces`, in which numbers are times [s]."""
    statements = (StateCode.NOT_ASSESSED_YET(),) if assessment is None else assessment.statements
    return {
        "state": "no estimate" if assessment is None else assessment.state,
        "since": None if assessment is None else assessment.since,
        "reason": stated_text(statements),
        "content": plain(list(statements)),
        "pieces": pieces_of(statements),
    }


def turbine_view(
    store: Store,
    name: str,
    since: float,
    now: float,
    verdicts: Verdicts = MappingProxyType({}),
    needs: Sequence[Need] = (),
) -> View:
    """The data of one turbine from `since` [s] on.

    At the instants `time` [s]: `final` (1 for final estimates), `condensation` [1] and `courses`.  `hours`,
    `humid`: the highest probability in every hour of condensation, and of a relative humidity above a
    `limit`.  `readings`: measurements in the cabinet.  `counts`: kind → number of readings that were not
    used.  `held`: number of readings that are held back because their stamps are ahead of the clock.

    needs: the inputs of the turbine's model; signals among them that never arrived are listed, too.
    """
    estimates = select_rows(
        schema.estimate, f"{_COLUMNS} time final condensation", "turbine", "time", since=True
    )
    rows = _thin(store.rows(estimates, turbine=name, since=since))
    readings: View = {}
    for quantity, signal in CABINET_SIGNALS_SHOWN.items():
        factor, offset = COURSES[quantity].factor, COURSES[quantity].offset
        values = _thin(store.rows(statements.USED_VALUES, turbine=name, signal=signal, since=since))
        if values:
            readings[quantity] = {
                "time": [at for at, _ in values],
                "value": [_scaled(value, factor, offset) for _, value in values],
            }
    time, chances = [row[-3] for row in rows], [row[-1] for row in rows]
    forecast = _forecast(store, name)
    limit = LIMIT if forecast is None else forecast["limit"]
    alarms = alarms_view(store, name, since)
    return {
        "turbine": name,
        **_state(store.assessments().get(name)),
        "model": model_view(verdicts),
        "time": time,
        "final": [row[-2] for row in rows],
        "condensation": chances,
        "hours": {
            "past": by_hour(time, chances),
            "forecast": by_hour(forecast["time"], forecast["condensation"]) if forecast else [],
        },
        "humid": {
            "limit": limit,
            "past": by_hour(time, _humid(rows, limit)),
            "forecast": by_hour(forecast["time"], forecast["above_limit"]) if forecast else [],
        },
        "courses": _courses(rows),
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
    first = 2 * list(COURSES).index("relative_humidity")
    value, sd = np.array([row[first : first + 2] for row in rows], dtype=float).reshape(-1, 2).T
    chances = probability_above(Quantity(value, sd), limit)
    return [None if math.isnan(v) else float(p) for v, p in zip(value, chances, strict=True)]


def by_hour(time: Sequence[float], values: Sequence[float | None]) -> list[tuple[float, float]]:
    """(beginning [s], highest value) of every hour that has values."""
    highest: dict[float, float] = {}
    for at, value in zip(time, values, strict=True):
        if value is not None:
            hour = HOUR_S * (at // HOUR_S)
            highest[hour] = max(value, highest.get(hour, value))
    return sorted(highest.items())


def _courses(rows: Sequence[Row]) -> View:
    """Value and bounds of each quantity that has values, from rows that begin with the columns of
    `COURSES`."""
    courses: View = {}
    for i, (quantity, display) in enumerate(COURSES.items()):
        factor, offset = display.factor, display.offset
        pairs = [(row[2 * i], row[2 * i + 1]) for row in rows]
        if all(value is None for value, _ in pairs):
            continue
        courses[quantity] = {
            "value": [_scaled(value, factor, offset) for value, _ in pairs],
            "lower": [_scaled(value, factor, offset, -Z95 * factor, sd) for value, sd in pairs],
            "upper": [_scaled(value, factor, offset, Z95 * factor, sd) for value, sd in pairs],
        }
    return courses


def _forecast(store: Store, name: str) -> View | None:
    """A turbine's newest forecast: its `weather` and `advice` as texts and as codes with values (`content`),
    and its courses; None before the first forecast."""
    stored = store.memory(name, "forecast")
    if not isinstance(stored, dict):
        return None
    forecast = structured(ForecastMade, stored)
    courses = select_rows(schema.forecast, f"{_COLUMNS} time condensation above_limit", "turbine", "time")
    rows = store.rows(courses, turbine=name)
    return {
        "made": forecast.made,
        "limit": forecast.limit,
        "weather": forecast.basis.text,
        "advice": None if forecast.advice is None else forecast.advice.text,
        "content": {"weather": stored["basis"], "advice": stored["advice"]},
        "time": [row[-3] for row in rows],
        "condensation": [row[-2] for row in rows],
        "above_limit": [row[-1] for row in rows],
        "courses": _courses(rows),
    }


def alarms_view(store: Store, turbine: str | None = None, since: float = -math.inf) -> list[Alarm]:
    """Alarms of one turbine, or of all turbines, that are open or ended at `since` [s] or later.

    Open alarms come first; open and ended alarms are each sorted by severity, then by time, newest first.
    """
    if turbine is None:
        alarms = store.records(Alarm, statements.ALARMS, since=since)
    else:
        alarms = store.records(Alarm, statements.ALARMS_OF, since=since, turbine=turbine)
    return sorted(alarms, key=lambda alarm: (alarm.ended is not None, -SEVERITY[alarm.severity]))


def labels_view(store: Store) -> list[View]:
    """How often each kind of alarm was `right` (something had changed) or `wrong` according to its
    acknowledgements, sorted by kind."""
    by_kind: dict[str, Counter[str | None]] = defaultdict(Counter)
    for kind, cause, count in store.rows(statements.CAUSE_COUNTS):
        by_kind[kind][cause] = int(count)
    return [
        {
            "kind": kind,
            "alarms": counts.total(),
            "causes": {cause: counts[cause] for cause in STATED_CAUSES},
            "right": sum(counts[cause] for cause in RIGHT),
            "wrong": sum(counts[cause] for cause in WRONG),
        }
        for kind, counts in sorted(by_kind.items())
    ]


def _properties(store: Store, name: str, since: float) -> list[View]:
    """Each property with its course, whose last value is the present value; shares are in per cent."""
    views = []
    names = "reference observable time value lower_bound upper_bound"
    query = select_rows(schema.property_, names, "turbine name", "time", since=True)
    for watched in WATCHED:
        rows = store.rows(query, turbine=name, name=watched.name, since=since)
        if rows:
            factor, unit = (100.0, "%") if watched.unit == "1" else (1.0, watched.unit)
            references, observable, time, *courses = zip(*rows, strict=True)
            view: View = {"name": watched.name, "unit": unit, "time": time}
            view |= {"reference": factor * references[-1], "observable": bool(observable[-1])}
            for key, course in zip(("value", "lower", "upper"), courses, strict=True):
                view[key] = [None if number is None else factor * number for number in course]
            views.append(view)
    return views


def _scaled(
    value: float | None, factor: float, offset: float, width: float = 0.0, sd: float | None = 0.0
) -> float | None:
    return None if value is None else round(factor * value + offset + width * (sd or 0.0), DECIMALS)


def _thin(rows: Sequence[T]) -> Sequence[T]:
    """At most `MOST_COURSE_POINTS` evenly spaced rows, including the last one."""
    step = -(-len(rows) // MOST_COURSE_POINTS)
    return rows if step <= 1 else rows[(len(rows) - 1) % step :: step]


def health_view(
    streams: Mapping[str, Stream], health: Health, counters: Mapping[tuple[str, str], int]
) -> View:
    """State of the `sources` and of the `store` (why it fails), and counts of `refused` deliveries that
    belong to no turbine.

    Of a source: `heard`: time at which its last message was committed [s]; `lag`: time [s] from its newest
    reading to the arrival of that reading; `not_reached`: time [s] since which it has not been reached;
    `ordered_by`: the criterion that orders the versions of a value.
    """
    sources = []
    for url, stream in streams.items():
        times, is_unordered = health.sources.get(url), stream.mapping.revision == "neither"
        sources.append(
            {
                "url": url,
                "state": stream.state.word,
                "words": stream.state.words,
                "heard": None if times is None else times.committed,
                "lag": None if times is None else times.lag_s,
                "not_reached": None if stream.played_back else stream.reach().since,
                "ordered_by": "nothing: neither counts" if is_unordered else stream.ordered_by,
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


def signal_rows(
    store: Store, name: str, now: float, needs: Sequence[Need], alarms: Iterable[Alarm]
) -> list[dict[str, Any]]:
    """The last reading of each signal of a turbine in its display unit; signals that the model reads but that
    never arrived are listed, too.

    `last`: time of the reading [s]; `received`: its arrival [s]; `count`: number of readings in the last day;
    `needed`: "required" if there is no estimate without the signal, "used" if the model reads the signal, ""
    if it does not; `contradicts`: whether an open alarm states that the reading contradicts the estimate.
    """
    views = []
    contradicting = {a.subject for a in alarms if a.kind == CONTRADICTS.kind and a.ended is None}
    present = store.signals(name)
    used = {signal: "required" if need.required else "used" for need in needs for signal in need.signals}
    missing = [need.signals[0] for need in needs if not set(need.signals) & set(present)]
    newest = select_newest(schema.observation, "value time received", "turbine signal")
    in_last_day = count_rows(schema.observation, "turbine signal", since=True)
    for signal in sorted({*missing, *present}):
        row, key = SIGNALS.get(signal), {"turbine": name, "signal": signal}
        value, last, received = store.first(newest, **key) or (None, None, None)
        ((count,),) = store.rows(in_last_day, **key, since=now - DAY_S)
        views.append(
            {
                "signal": signal,
                "value": value if row is None or value is None else float(from_si(value, row.display, row)),
                "unit": "" if row is None else row.display,
                "last": last,
                "received": received,
                "count": count,
                "needed": used.get(signal, ""),
                "contradicts": signal in contradicting,
            }
        )
    return views


# -- margins of the overview ---------------------------------------------------------------------------------
SHOWN_BACK_S, SHOWN_AHEAD_S = 3.0 * DAY_S, 2.0 * DAY_S
"""Length of the past and of the forecast that are shown [s]."""
MARGIN_STEP_S = 2.0 * HOUR_S
"""Length of a step [s]."""
PAST_STEPS, AHEAD_STEPS = round(SHOWN_BACK_S / MARGIN_STEP_S), round(SHOWN_AHEAD_S / MARGIN_STEP_S)
"""Number of steps of the past, and of the forecast."""
TURBINES_AT_ONCE = 50
"""Number of turbines read at once; other requests may read the store between two groups."""
MARGINS_KEPT_S = 300.0
"""Time of the tracker's clock for which the margins are kept [s]."""
KEPT_REAL_S = 5.0
"""Real time for which the margins are kept at least [s], because the clock of a playback may run faster."""


class MarginsCache:
    """The margins of the fleet, cached until they are too old."""

    def __init__(self) -> None:
        self._kept: tuple[float, View] | None = None

    def view(self, reader: Reader, names: Sequence[str], now: float) -> View:
        """The margins of all turbines at `now` [s] in steps of `step` [s] from `start` [s] on.

        The first `past` steps are estimates, the others forecasts.
        """
        if self._kept is not None:
            read_s, margins = self._kept
            age_s = now - margins["start"] - SHOWN_BACK_S
            if 0.0 <= age_s < MARGINS_KEPT_S or 0.0 <= time.monotonic() - read_s < KEPT_REAL_S:
                return margins
        start = now - SHOWN_BACK_S
        turbines: View = {}
        for first in range(0, len(names), TURBINES_AT_ONCE):
            group = names[first : first + TURBINES_AT_ONCE]
            turbines |= reader.read(partial(margins_of, names=group, start=start))
        margins = {"start": start, "step": MARGIN_STEP_S, "past": PAST_STEPS, "turbines": turbines}
        self._kept = (time.monotonic(), margins)
        return margins


def margins_of(store: Store, names: Sequence[str], start: float) -> View:
    """Turbine → the lowest margin `value` [K] in each step from `start` [s] on, and `half` the width of its
    95 % band [K]; None in steps without margins.  Turbines without any margin are left out."""
    margins = {}
    now = start + SHOWN_BACK_S
    for name in names:
        courses = [
            row
            for query, since, until in (
                (statements.PAST_MARGINS, start, now),
                (statements.FORECAST_MARGINS, now, now + SHOWN_AHEAD_S),
            )
            for row in store.rows(query, turbine=name, since=since, until=until)
        ]
        if not courses:
            continue
        rows = np.array(courses, dtype=float)
        value, half = lowest_margins(
            (rows[:, 0] - start) / MARGIN_STEP_S, rows[:, 1], rows[:, 2], PAST_STEPS + AHEAD_STEPS
        )
        margins[name] = {"value": value, "half": half}
    return margins


def lowest_margins(
    time: np.ndarray, margin: np.ndarray, sd: np.ndarray, steps: int
) -> tuple[list[float | None], list[float | None]]:
    """The lowest margin [K] in each of the steps, and half the width of its 95 % band [K].

    time (T,): time as a multiple of the step; margin, sd (T,) [K].
    """
    step = np.floor(time).astype(int)
    order = np.lexsort((margin, step))
    first = order[np.r_[True, np.diff(step[order]) != 0]]
    value: list[float | None] = [None] * steps
    half: list[float | None] = [None] * steps
    for i in first:
        if 0 <= step[i] < steps and np.isfinite(margin[i]) and np.isfinite(sd[i]):
            value[step[i]], half[step[i]] = round(float(margin[i]), 1), round(Z95 * float(sd[i]), 1)
    return value, half
