"""What the page shows, as plain data from the store: the fleet by risk, one turbine's last days, alarms.

Temperatures are in °C, relative humidity in %, times in seconds since 1970, UTC.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.signals import SIGNALS, from_si
from hygrokf.identification.verdict import MARKS, PARAMETER_OF, VERDICTS, handed_on
from hygrokf.live.alarms import CHANGED
from hygrokf.live.condition import Z95, Quantity, probability_above
from hygrokf.live.forecast import LIMIT
from hygrokf.live.properties import WATCHED
from hygrokf.live.storage.store import Store

if TYPE_CHECKING:
    from hygrokf.live.service import Health

ZERO_C = 273.15
HOUR_S = 3600.0
DAY_S = 86400.0
DECIMALS = 4
"""Digits after the point, ten times as many as the page shows: what is sent is half as long."""
FRESH_S = 3600.0
"""[s] since the last reading after which a turbine's data are not fresh."""
SEVERITY = {"alarm": 2, "warning": 1, "notice": 0}
COURSES = {
    "temperature": ("temperature_K", "temperature_sd", 1.0, -ZERO_C),
    "relative_humidity": ("relative_humidity", "relative_humidity_sd", 100.0, 0.0),
    "absolute_humidity": ("absolute_humidity_g_m3", "absolute_humidity_sd", 1.0, 0.0),
    "dew_point": ("dew_point_K", "dew_point_sd", 1.0, -ZERO_C),
    "margin": ("margin_K", "margin_sd", 1.0, 0.0),
}
"""Quantity on the page -> (column, its standard deviation's, factor, offset)."""
_COLUMNS = ", ".join(f"{column}, {sd}" for column, sd, _, _ in COURSES.values())
MOST = 3000
"""Points of a course at most; longer ones are thinned."""
READ = {
    "temperature": ("cabinet_temperature", 1.0, -ZERO_C),
    "relative_humidity": ("cabinet_relative_humidity", 100.0, 0.0),
}
"""Quantity on the page -> (the cabinet's own signal, factor, offset)."""


def model_view(verdicts: Mapping[str, Mapping]) -> dict:
    """The verdict on a turbine's model, the worst of those on its numbers, and each of these in words."""
    numbers = [
        {
            "part": part,
            "property": PARAMETER_OF[part],
            "verdict": found.verdict,
            "mark": MARKS[found.verdict],
            "words": found.words,
            "why": found.why,
        }
        for part, _, found in handed_on(verdicts)
    ]
    worst = max((VERDICTS.index(one["verdict"]) for one in numbers), default=None)
    return {"verdict": None if worst is None else VERDICTS[worst], "numbers": numbers}


def fleet_view(
    store: Store,
    names: Sequence[str],
    now: float,
    verdicts: Mapping[str, Mapping[str, Mapping]] = MappingProxyType({}),
) -> list[dict]:
    """One row a turbine, the one at most risk first: open alarms by severity, then condensation, the likeliest now or ahead.

    `…_half` is half the width of a 95 % band; `ahead` the hour of the forecast in which condensation is likeliest;
    `model` the verdict on the turbine's model, from the `verdicts` on its numbers.
    """
    # LEFT JOIN: the database is to go from turbine to turbine and not through every estimate
    newest = {
        turbine: row
        for turbine, *row in store.rows(
            "SELECT t.name, e.time, e.temperature_K, e.temperature_sd, e.relative_humidity, e.relative_humidity_sd, "
            "e.margin_K, e.margin_sd, e.condensation FROM turbine t LEFT JOIN estimate e "
            "ON e.turbine = t.name AND e.time = (SELECT MAX(time) FROM estimate WHERE turbine = t.name)"
        )
    }
    # the newest reading is taken for the one that came last: asking for that would read every observation
    heard = dict(
        store.rows(
            "SELECT t.name, (SELECT received FROM observation WHERE turbine = t.name ORDER BY time DESC LIMIT 1) FROM turbine t"
        )
    )
    cabinets, ahead = _cabinets(store), _ahead(store, now)
    open_: dict[str, list[dict]] = {}
    for alarm in alarms_view(store, since=math.inf):
        open_.setdefault(alarm["turbine"], []).append(alarm)
    rows = []
    for name in names:
        at, kelvin, kelvin_sd, humidity, humidity_sd, margin, margin_sd, chance = newest.get(name, [None] * 8)
        alarms = open_.get(name, [])
        last = heard.get(name)
        rows.append(
            {
                "turbine": name,
                "time": at,
                "heard": last,
                "fresh": last is not None and now - last < FRESH_S,
                "temperature": _scaled(kelvin, 1.0, -ZERO_C),
                "temperature_half": _scaled(kelvin_sd, Z95, 0.0),
                "relative_humidity": _scaled(humidity, 100.0, 0.0),
                "relative_humidity_half": _scaled(humidity_sd, 100.0 * Z95, 0.0),
                "margin": margin,
                "margin_lower": None if margin is None else margin - Z95 * margin_sd,
                "condensation": chance,
                "ahead": ahead.get(name),
                "cabinet": "changed"
                if any(a["kind"] == CHANGED.kind for a in alarms)
                else cabinets.get(name),
                "alarms": alarms,
                "model": model_view(verdicts.get(name, {}))["verdict"],
                "severity": max((SEVERITY[a["severity"]] for a in alarms), default=-1),
            }
        )
    rows.sort(key=lambda row: (-row["severity"], -_risk(row), row["turbine"]))
    return rows


def _risk(row: dict) -> float:
    ahead = row["ahead"]["condensation"] if row["ahead"] else 0.0
    return max(row["condensation"] or 0.0, ahead)


def _cabinets(store: Store) -> dict[str, str]:
    """Whether the properties of each turbine's cabinet can be told from its readings now."""
    found: dict[str, str] = {}
    for one in WATCHED:
        for turbine, observable in store.rows(
            "SELECT t.name, p.observable FROM turbine t LEFT JOIN property p ON p.turbine = t.name AND p.name = ? "
            "AND p.time = (SELECT MAX(time) FROM property WHERE turbine = t.name AND name = ?)",
            (one.name, one.name),
        ):
            if observable or (observable is not None and turbine not in found):
                found[turbine] = "as fitted" if observable else "not observable"
    return found


def _ahead(store: Store, now: float) -> dict[str, dict]:
    """The highest probability of condensation that is forecast for each turbine, and when first."""
    found: dict[str, dict] = {}
    for turbine, at, chance in store.rows(
        "SELECT turbine, time, condensation FROM forecast WHERE time >= ? AND condensation IS NOT NULL ORDER BY turbine, time",
        (now,),
    ):
        if turbine not in found or chance > found[turbine]["condensation"]:
            found[turbine] = {"condensation": chance, "time": at}
    return found


def turbine_view(
    store: Store, name: str, since: float, now: float, verdicts: Mapping[str, Mapping] = MappingProxyType({})
) -> dict:
    """One turbine from a time [s] on: courses with bounds, readings, properties now and their course, alarms, counts.

    `hours` and `humid` hold the highest probability of each hour, up to the last estimate and as it is forecast: of
    condensation, and of a relative humidity above the turbine's limit; `model` the verdicts on its model.
    """
    found = _thinned(
        store.rows(
            f"SELECT {_COLUMNS}, time, final, condensation FROM estimate WHERE turbine = ? AND time >= ? ORDER BY time",
            (name, since),
        )
    )
    readings = {}
    for quantity, (signal, factor, offset) in READ.items():
        taken = store.rows(
            "SELECT time, value FROM observation WHERE turbine = ? AND signal = ? AND time >= ? AND contradicted = 0 "
            "ORDER BY time",
            (name, signal, since),
        )
        rows = _thinned(taken)
        if rows:
            readings[quantity] = {
                "time": [at for at, _ in rows],
                "value": [_scaled(value, factor, offset) for _, value in rows],
            }
    time, chances = [row[-3] for row in found], [row[-1] for row in found]
    forecast = _forecast(store, name)
    limit = forecast.get("limit", LIMIT) if forecast else LIMIT
    return {
        "turbine": name,
        "model": model_view(verdicts),
        "time": time,
        "final": [row[-2] for row in found],
        "condensation": chances,
        "hours": {
            "past": by_hour(time, chances),
            "ahead": by_hour(forecast["time"], forecast["condensation"]) if forecast else [],
        },
        "humid": {
            "limit": limit,
            "past": by_hour(time, _humid(found, limit)),
            "ahead": by_hour(forecast["time"], forecast["above_limit"]) if forecast else [],
        },
        "courses": _courses(found),
        "readings": readings,
        "forecast": forecast,
        "properties": _properties(store, name, since),
        "alarms": alarms_view(store, name, since),
        "signals": _signals(store, name, now),
        "counts": {kind: n for (turbine, kind), n in sorted(store.counters().items()) if turbine == name},
    }


def _humid(rows: Sequence[tuple], limit: float) -> list[float | None]:
    """Probability that relative humidity is above a limit, from rows that begin with the columns of `COURSES`."""
    place = 2 * list(COURSES).index("relative_humidity")
    value, sd = np.array([row[place : place + 2] for row in rows], dtype=float).reshape(-1, 2).T
    chances = probability_above(Quantity(value, sd), limit)
    return [None if math.isnan(v) else float(p) for v, p in zip(value, chances, strict=True)]


def by_hour(time: Sequence[float], values: Sequence[float | None]) -> list[tuple[float, float]]:
    """(beginning [s], highest value) of every hour that has one."""
    most: dict[float, float] = {}
    for at, value in zip(time, values, strict=True):
        if value is not None:
            hour = HOUR_S * (at // HOUR_S)
            most[hour] = max(value, most.get(hour, value))
    return sorted(most.items())


def _signals(store: Store, name: str, now: float) -> list[dict]:
    """Each signal of a turbine: its last reading in the unit that is shown, when it came, readings of the last day."""
    found = []
    # one step of the index for each signal: a list of all that were ever seen would read every observation
    for (signal,) in store.rows(
        "WITH RECURSIVE seen(signal) AS (SELECT MIN(signal) FROM observation WHERE turbine = ? UNION ALL SELECT "
        "(SELECT MIN(signal) FROM observation WHERE turbine = ? AND signal > seen.signal) FROM seen WHERE seen.signal IS NOT NULL) "
        "SELECT signal FROM seen WHERE signal IS NOT NULL",
        (name, name),
    ):
        ((last, value, received),) = store.rows(
            "SELECT time, value, received FROM observation WHERE turbine = ? AND signal = ? ORDER BY time DESC LIMIT 1",
            (name, signal),
        )
        ((count,),) = store.rows(
            "SELECT COUNT(*) FROM observation WHERE turbine = ? AND signal = ? AND time >= ?",
            (name, signal, now - DAY_S),
        )
        row = SIGNALS.get(signal)
        shown = value if row is None else float(from_si(value, row.display, row))
        unit = "" if row is None else row.display
        found.append(
            {
                "signal": signal,
                "value": shown,
                "unit": unit,
                "last": last,
                "received": received,
                "count": count,
            }
        )
    return found


def _courses(rows: Sequence[tuple]) -> dict[str, dict[str, list]]:
    """Value and bounds of each quantity, from rows that begin with the columns of `COURSES`; none where all is NULL."""
    courses: dict[str, dict[str, list]] = {}
    for place, (quantity, (_, _, factor, offset)) in enumerate(COURSES.items()):
        pairs = [(row[2 * place], row[2 * place + 1]) for row in rows]
        if all(value is None for value, _ in pairs):
            continue
        courses[quantity] = {
            "value": [_scaled(value, factor, offset) for value, _ in pairs],
            "lower": [_scaled(value, factor, offset, -Z95 * factor, sd) for value, sd in pairs],
            "upper": [_scaled(value, factor, offset, Z95 * factor, sd) for value, sd in pairs],
        }
    return courses


def _forecast(store: Store, name: str) -> dict | None:
    """The newest forecast: what it was made from, courses, chances, and the advice for a restart.

    Where none could be made `weather` says why, and the courses are empty.
    """
    made = store.memory(name, "forecast")
    rows = store.rows(
        f"SELECT {_COLUMNS}, time, condensation, above_limit FROM forecast WHERE turbine = ? ORDER BY time",
        (name,),
    )
    if not made:
        return None
    return {
        **made,
        "time": [row[-3] for row in rows],
        "condensation": [row[-2] for row in rows],
        "above_limit": [row[-1] for row in rows],
        "courses": _courses(rows),
        "advice": store.memory(name, "advice"),
    }


def alarms_view(store: Store, turbine: str | None = None, since: float = -math.inf) -> list[dict]:
    """Alarms, of one turbine or of all, that are open or ended at `since` [s] or later; open ones first, then the newest."""
    names = (
        "id", "turbine", "kind", "severity", "began", "ended", "acknowledged", "acknowledged_by", "statement", "remedy"
    )  # fmt: skip
    where = "WHERE (ended IS NULL OR ended >= ?)"
    parameters: list[float | str] = [since]
    if turbine is not None:
        where, parameters = f"{where} AND turbine = ?", [since, turbine]
    rows = store.rows(f"SELECT {', '.join(names)} FROM alarm {where} ORDER BY began DESC", parameters)
    found = [dict(zip(names, row, strict=True)) for row in rows]
    return sorted(found, key=lambda a: (a["ended"] is not None, -SEVERITY[a["severity"]]))


def _properties(store: Store, name: str, since: float) -> list[dict]:
    """Each property with its course; the last row of the course is what it is now."""
    found: dict[str, dict] = {}
    for prop, unit, at, value, lower, upper, reference, observable in store.rows(
        "SELECT name, unit, time, value, lower_bound, upper_bound, reference, observable FROM property "
        "WHERE turbine = ? AND time >= ? ORDER BY time",
        (name, since),
    ):
        factor = 100.0 if unit == "1" else 1.0  # shares are told in per cent
        one = found.setdefault(
            prop,
            {
                "name": prop,
                "unit": "%" if unit == "1" else unit,
                "time": [],
                "value": [],
                "lower": [],
                "upper": [],
            },
        )
        one |= {"reference": factor * reference, "observable": bool(observable)}
        one["time"].append(at)
        for key, number in (("value", value), ("lower", lower), ("upper", upper)):
            one[key].append(None if number is None else factor * number)
    return list(found.values())


def _scaled(
    value: float | None, factor: float, offset: float, width: float = 0.0, sd: float | None = 0.0
) -> float | None:
    return None if value is None else round(factor * value + offset + width * (sd or 0.0), DECIMALS)


def _thinned(rows: Sequence) -> Sequence:
    """At most `MOST` of the rows, evenly, the last one among them."""
    step = -(-len(rows) // MOST)
    return rows if step <= 1 else rows[(len(rows) - 1) % step :: step]


def health_view(streams: Mapping[str, tuple[str, str]], health: Health, counters: Mapping) -> dict:
    """Sources, store and what was set aside that belongs to no turbine."""
    waits = sorted(health.waits_s)
    return {
        "sources": [{"url": url, "state": state, "words": words} for url, (state, words) in streams.items()],
        "store": health.store,
        "deliveries": health.deliveries,
        "committed": health.committed_s,
        "wait_99_s": waits[int(0.99 * (len(waits) - 1))] if waits else None,
        "refused": {kind: n for (turbine, kind), n in sorted(counters.items()) if not turbine},
    }
