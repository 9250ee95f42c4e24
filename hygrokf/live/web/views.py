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
from hygrokf.live.alarms import CHANGED, CONTRADICTS
from hygrokf.live.batch import CAUSES, STATES, Alarm, Assessment, pieces_of, text_of
from hygrokf.live.condition import QUANTITIES, Z95, Quantity, probability_above
from hygrokf.live.forecast import LIMIT, ForecastMade
from hygrokf.live.plan import Need
from hygrokf.live.properties import WATCHED
from hygrokf.live.service import Health
from hygrokf.live.sources.stream import Stream
from hygrokf.live.storage import schema, statements
from hygrokf.live.storage.database import Row
from hygrokf.live.storage.statements import counting, newest, selecting
from hygrokf.live.storage.store import Store
from hygrokf.live.web.reader import Reader
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.texts.live import StateCode
from hygrokf.texts.verdict import MARKS, VERDICTS

DECIMALS = 4
"""Decimal places of numbers sent to the page; rounding halves the size of the response."""
RIGHT, WRONG = ("defect", "settings changed"), ("false alarm",)
"""Causes of acknowledgements that say that an alarm was right, or wrong."""
SEVERITY = {"alarm": 2, "warning": 1, "notice": 0}
COURSES = {q.name: q for q in QUANTITIES if q.name != "frost_point"}
_COLUMNS = " ".join(f"{q.column} {q.sd_column}" for q in COURSES.values())
MOST = 3000
"""Largest number of points in a course; longer courses are thinned."""
READ = {"temperature": "cabinet_temperature", "relative_humidity": "cabinet_relative_humidity"}
"""Quantity on the page -> the cabinet's own signal."""
Verdicts = Mapping[str, Inherited]
"""A fit's verdicts on the numbers of a turbine's model, by part."""
View = dict[str, Any]
"""JSON of the page; what it holds stands at the function that makes it."""
T = TypeVar("T")


def model_view(verdicts: Verdicts) -> View:
    """The `verdict` on a turbine's model, the worst one on its `numbers` (None without any), and these."""
    numbers = [
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
    verdict = max((one.verdict for one in verdicts.values()), key=VERDICTS.index, default=None)
    return {"verdict": verdict, "numbers": numbers}


def fleet_view(
    store: Store,
    names: Sequence[str],
    now: float,
    verdicts: Mapping[str, Verdicts] = MappingProxyType({}),
) -> list[View]:
    """One row per turbine, sorted by the need of its state, then by the severity of open alarms and by the
    present or forecast risk of condensation.

    `time`: of the newest estimate, `heard`: of the last arrival; `…_half`: half the width of a 95 % band;
    `margin` [K]; `forecast`: the highest `condensation` [1] to come and the first `time` it is reached;
    `cabinet`: whether its properties are as fitted; `severity`: of its worst open alarm (`SEVERITY`), −1
    without any.

    verdicts: turbine → verdicts on the numbers of its model.
    """
    latest = {turbine: row for turbine, *row in store.rows(statements.FLEET)}
    observable: dict[str, int] = dict(store.rows(statements.OBSERVABLE))
    highest = {
        turbine: {"condensation": chance, "time": at}
        for turbine, chance, at in store.rows(statements.CHANCES, since=now)
    }
    states, open_alarms = store.assessments(), alarms_view(store, since=math.inf)
    rows: list[View] = []
    for name in names:
        heard, at, kelvin, kelvin_sd, humidity, humidity_sd, margin, margin_sd, chance = latest.get(
            name, [None] * 9
        )
        alarms = [one for one in open_alarms if one.turbine == name]
        cabinet = {None: None, 0: "not observable", 1: "as fitted"}[observable.get(name)]
        rows.append(
            {
                "turbine": name,
                **_state(states.get(name)),
                "time": at,
                "heard": heard,
                "temperature": _scaled(kelvin, 1.0, -ZERO_CELSIUS_K),
                "temperature_half": _scaled(kelvin_sd, Z95, 0.0),
                "relative_humidity": _scaled(humidity, 100.0, 0.0),
                "relative_humidity_half": _scaled(humidity_sd, 100.0 * Z95, 0.0),
                "margin": margin,
                "margin_lower": None if margin is None else margin - Z95 * margin_sd,
                "condensation": chance,
                "forecast": highest.get(name),
                "cabinet": "changed" if any(one.kind == CHANGED.kind for one in alarms) else cabinet,
                "alarms": alarms,
                "model": model_view(verdicts.get(name, {}))["verdict"],
                "severity": max((SEVERITY[one.severity] for one in alarms), default=-1),
            }
        )
    return sorted(rows, key=_need)


def _need(row: View) -> tuple[int, int, float, str]:
    coming = row["forecast"]["condensation"] if row["forecast"] else 0.0
    risk = max(row["condensation"] or 0.0, coming)
    return STATES.index(row["state"]), -row["severity"], -risk, row["turbine"]


def _state(found: Assessment | None) -> View:
    """A turbine's `state` `since` [s] a time, its `reason` as text, as codes with values (`content`) and in
    `pieces`, of which the numbers are instants [s]."""
    statements = (StateCode.NOT_ASSESSED_YET(),) if found is None else found.statements
    return {
        "state": "no estimate" if found is None else found.state,
        "since": None if found is None else found.since,
        "reason": text_of(statements),
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
    """One turbine from `since` [s] on.

    At the instants `time` [s]: `final` (1 for final estimates), `condensation` [1] and `courses`; `hours` and
    `humid`: highest probability of condensation, and of a relative humidity above a `limit`, of every hour;
    `readings`: the cabinet's own; `counts`: readings that were not used, by kind; `held`: number of readings
    that are held back, because their stamps are ahead of the clock.

    needs: what its model reads, of which signals that never came are listed too.
    """
    estimates = selecting(
        schema.estimate, f"{_COLUMNS} time final condensation", "turbine", "time", since=True
    )
    found = _thin(store.rows(estimates, turbine=name, since=since))
    readings: View = {}
    for quantity, signal in READ.items():
        shown = COURSES[quantity]
        rows = _thin(store.rows(statements.USED_VALUES, turbine=name, signal=signal, since=since))
        if rows:
            readings[quantity] = {
                "time": [at for at, _ in rows],
                "value": [_scaled(value, shown.factor, shown.offset) for _, value in rows],
            }
    time, chances = [row[-3] for row in found], [row[-1] for row in found]
    forecast = _forecast(store, name)
    limit = LIMIT if forecast is None else forecast["limit"]
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


def _courses(rows: Sequence[Row]) -> View:
    """Value and bounds of each quantity that has values, from rows that begin with the columns of
    `COURSES`."""
    courses: View = {}
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


def _forecast(store: Store, name: str) -> View | None:
    """A turbine's newest forecast: what the store keeps of it (`ForecastMade`) as codes, `weather` and
    `advice` as texts, and its courses; None before the first one."""
    kept = store.memory(name, "forecast")
    if not isinstance(kept, dict):
        return None
    made = structured(ForecastMade, kept)
    courses = selecting(schema.forecast, f"{_COLUMNS} time condensation above_limit", "turbine", "time")
    rows = store.rows(courses, turbine=name)
    return {
        "made": made.made,
        "limit": made.limit,
        "weather": made.basis.text,
        "advice": None if made.advice is None else made.advice.text,
        "content": {"weather": kept["basis"], "advice": kept["advice"]},
        "time": [row[-3] for row in rows],
        "condensation": [row[-2] for row in rows],
        "above_limit": [row[-1] for row in rows],
        "courses": _courses(rows),
    }


def alarms_view(store: Store, turbine: str | None = None, since: float = -math.inf) -> list[Alarm]:
    """Alarms of one turbine or of all that are open or ended at `since` [s] or later.

    Open alarms come first; within each group the most severe come first, and then the newest.
    """
    own = {} if turbine is None else {"turbine": turbine}
    found = store.found(Alarm, statements.ALARMS_OF if own else statements.ALARMS, since=since, **own)
    return sorted(found, key=lambda alarm: (alarm.ended is not None, -SEVERITY[alarm.severity]))


def labels_view(store: Store) -> list[View]:
    """How often each kind of alarm was `right` (something had changed) or `wrong`, as those say who
    acknowledged it; by kind."""
    found: dict[str, Counter[str | None]] = defaultdict(Counter)
    for kind, cause, count in store.rows(statements.CAUSES):
        found[kind][cause] = int(count)
    return [
        {
            "kind": kind,
            "alarms": counts.total(),
            "causes": {cause: counts[cause] for cause in CAUSES},
            "right": sum(counts[cause] for cause in RIGHT),
            "wrong": sum(counts[cause] for cause in WRONG),
        }
        for kind, counts in sorted(found.items())
    ]


def _properties(store: Store, name: str, since: float) -> list[View]:
    """Each property with its course, whose last value is the present one; shares are in per cent."""
    found = []
    names = "reference observable time value lower_bound upper_bound"
    query = selecting(schema.property_, names, "turbine name", "time", since=True)
    for one in WATCHED:
        rows = store.rows(query, turbine=name, name=one.name, since=since)
        if rows:
            factor, unit = (100.0, "%") if one.unit == "1" else (1.0, one.unit)
            references, observable, time, *courses = zip(*rows, strict=True)
            view: View = {"name": one.name, "unit": unit, "time": time}
            view |= {"reference": factor * references[-1], "observable": bool(observable[-1])}
            for key, course in zip(("value", "lower", "upper"), courses, strict=True):
                view[key] = [None if number is None else factor * number for number in course]
            found.append(view)
    return found


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
) -> View:
    """State of the `sources` and of the `store` (why it fails), and counts of `refused` deliveries that
    belong to no turbine.

    Of a source: `heard`: when its last message was committed [s]; `lag`: time [s] from its newest reading to
    its arrival; `not_reached`: since when [s] it is not; `ordered_by`: what orders the versions of a value.
    """
    sources = []
    for url, one in streams.items():
        times, neither = health.sources.get(url), one.mapping.revision == "neither"
        sources.append(
            {
                "url": url,
                "state": one.state.word,
                "words": one.state.words,
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


def signal_rows(
    store: Store, name: str, now: float, needs: Sequence[Need], alarms: Iterable[Alarm]
) -> list[dict[str, Any]]:
    """The last reading of each signal of a turbine in its display unit, and what its model reads and never
    came.

    `last`: its time [s]; `received`: its arrival [s]; `count`: number of readings in the last day; `needed`:
    "required" if there is no estimate without it, "used" if the model reads it, "" if it does not;
    `contradicts`: whether the reading contradicts the estimate, by the open alarms.
    """
    found = []
    open_ = [one for one in alarms if one.kind == CONTRADICTS.kind and one.ended is None]
    there = store.signals(name)
    used = {signal: "required" if one.required else "used" for one in needs for signal in one.signals}
    missing = [one.signals[0] for one in needs if not set(one.signals) & set(there)]
    for signal in sorted({*missing, *there}):
        row, own = SIGNALS.get(signal), {"turbine": name, "signal": signal}
        reading = store.first(newest(schema.observation, "value time received", "turbine signal"), **own)
        value, last, received = reading or (None, None, None)
        in_a_day = counting(schema.observation, "turbine signal", since=True)
        ((count,),) = store.rows(in_a_day, **own, since=now - DAY_S)
        found.append(
            {
                "signal": signal,
                "value": value if row is None or value is None else float(from_si(value, row.display, row)),
                "unit": "" if row is None else row.display,
                "last": last,
                "received": received,
                "count": count,
                "needed": used.get(signal, ""),
                "contradicts": any(one.subject == signal for one in open_),
            }
        )
    return found


# -- margins of the overview ---------------------------------------------------------------------------------
BACK_S, AHEAD_S = 3.0 * DAY_S, 2.0 * DAY_S
"""[s] of the past and of the forecast that are shown."""
STEP_S = 2.0 * HOUR_S
"""[s] of a step."""
PAST, AHEAD = round(BACK_S / STEP_S), round(AHEAD_S / STEP_S)
"""Number of steps of the past, and of the forecast."""
TOGETHER = 50
"""Turbines that are read at once; others may read the store between two groups."""
KEPT_S = 300.0
"""[s] of the tracker's time for which the courses are kept."""
LEAST_S = 5.0
"""[s] of real time for which they are kept, because the time of a playback may run faster."""


class MarginsKept:
    """The margins of the fleet, read again when they are old."""

    def __init__(self) -> None:
        self._kept: tuple[float, View] | None = None

    def view(self, reader: Reader, names: Sequence[str], now: float) -> View:
        """The margins of all turbines at `now` [s], from `start` [s] on in steps of `step` [s], of which the
        first `past` are estimates and the others forecasts."""
        if self._kept is not None:
            read_s, found = self._kept
            age_s = now - found["start"] - BACK_S
            if 0.0 <= age_s < KEPT_S or 0.0 <= time.monotonic() - read_s < LEAST_S:
                return found
        start = now - BACK_S
        turbines: View = {}
        for first in range(0, len(names), TOGETHER):
            some = names[first : first + TOGETHER]
            turbines |= reader.read(partial(margins_of, names=some, start=start))
        made = {"start": start, "step": STEP_S, "past": PAST, "turbines": turbines}
        self._kept = (time.monotonic(), made)
        return made


def margins_of(store: Store, names: Sequence[str], start: float) -> View:
    """The margins of those turbines that have some, step by step from `start` [s] on: the lowest `value` [K]
    and `half` the width of its 95 % band [K]; None in steps without any."""
    found = {}
    now = start + BACK_S
    for name in names:
        courses = [
            row
            for query, since, until in (
                (statements.PAST_MARGINS, start, now),
                (statements.FORECAST_MARGINS, now, now + AHEAD_S),
            )
            for row in store.rows(query, turbine=name, since=since, until=until)
        ]
        if not courses:
            continue
        rows = np.array(courses, dtype=float)
        value, half = lowest((rows[:, 0] - start) / STEP_S, rows[:, 1], rows[:, 2], PAST + AHEAD)
        found[name] = {"value": value, "half": half}
    return found


def lowest(
    place: np.ndarray, margin: np.ndarray, sd: np.ndarray, steps: int
) -> tuple[list[float | None], list[float | None]]:
    """The lowest margin [K] in each of the steps, and half the width of its 95 % band [K].

    place (T,): time as a multiple of the step; margin, sd (T,) [K].
    """
    step = np.floor(place).astype(int)
    order = np.lexsort((margin, step))
    first = order[np.r_[True, np.diff(step[order]) != 0]]
    value: list[float | None] = [None] * steps
    half: list[float | None] = [None] * steps
    for i in first:
        if 0 <= step[i] < steps and np.isfinite(margin[i]) and np.isfinite(sd[i]):
            value[step[i]], half[step[i]] = round(float(margin[i]), 1), round(Z95 * float(sd[i]), 1)
    return value, half
