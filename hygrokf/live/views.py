"""What the page shows, as plain data from the store: the fleet by risk, one turbine's last days, alarms.

Temperatures are in °C, relative humidity in %, times in seconds since 1970, UTC.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hygrokf.live.condition import Z95
from hygrokf.live.store import Store

ZERO_C = 273.15
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
MOST = 3000
"""Points of a course at most; longer ones are thinned."""
READ = {
    "temperature": ("cabinet_temperature", 1.0, -ZERO_C),
    "relative_humidity": ("cabinet_relative_humidity", 100.0, 0.0),
}
"""Quantity on the page -> (the cabinet's own signal, factor, offset)."""


def fleet_view(store: Store, names: Sequence[str], now: float) -> list[dict]:
    """One row a turbine, the one at most risk first: open alarms by severity, then the probability of condensation."""
    newest = {
        turbine: row
        for turbine, *row in store.rows(
            "SELECT e.turbine, e.time, e.temperature_K, e.relative_humidity, e.margin_K, e.margin_sd, e.condensation "
            "FROM estimate e JOIN (SELECT turbine, MAX(time) AS time FROM estimate GROUP BY turbine) l "
            "ON e.turbine = l.turbine AND e.time = l.time"
        )
    }
    heard = dict(store.rows("SELECT turbine, MAX(received) FROM observation GROUP BY turbine"))
    open_: dict[str, list[dict]] = {}
    for alarm in alarms_view(store):
        if alarm["ended"] is None:
            open_.setdefault(alarm["turbine"], []).append(alarm)
    rows = []
    for name in names:
        at, kelvin, humidity, margin, margin_sd, chance = newest.get(name, [None] * 6)
        alarms = open_.get(name, [])
        rows.append(
            {
                "turbine": name,
                "time": at,
                "heard": heard.get(name),
                "fresh": name in heard and now - heard[name] < FRESH_S,
                "temperature": None if kelvin is None else kelvin - ZERO_C,
                "relative_humidity": None if humidity is None else 100.0 * humidity,
                "margin": margin,
                "margin_lower": None if margin is None else margin - Z95 * margin_sd,
                "condensation": chance,
                "alarms": alarms,
                "severity": max((SEVERITY[a["severity"]] for a in alarms), default=-1),
            }
        )
    rows.sort(key=lambda row: (-row["severity"], -(row["condensation"] or 0.0), row["turbine"]))
    return rows


def turbine_view(store: Store, name: str, since: float) -> dict:
    """One turbine from a time [s] on: courses with bounds, readings, properties now and their course, alarms, counts."""
    columns = ", ".join(f"{column}, {sd}" for column, sd, _, _ in COURSES.values())
    found = store.rows(
        f"SELECT time, final, condensation, {columns} FROM estimate WHERE turbine = ? AND time >= ? ORDER BY time",
        (name, since),
    )
    found = _thinned(found)
    courses: dict[str, dict[str, list]] = {}
    for place, (quantity, (_, _, factor, offset)) in enumerate(COURSES.items()):
        rows = [(row[3 + 2 * place], row[4 + 2 * place]) for row in found]
        if all(value is None for value, _ in rows):
            continue
        courses[quantity] = {
            "value": [_scaled(value, factor, offset) for value, _ in rows],
            "lower": [_scaled(value, factor, offset, -Z95 * factor, sd) for value, sd in rows],
            "upper": [_scaled(value, factor, offset, Z95 * factor, sd) for value, sd in rows],
        }
    readings = {}
    for quantity, (signal, factor, offset) in READ.items():
        rows = store.rows(
            "SELECT time, value FROM observation WHERE turbine = ? AND signal = ? AND time >= ? AND contradicted = 0 "
            "ORDER BY time",
            (name, signal, since),
        )
        rows = _thinned(rows)
        if rows:
            readings[quantity] = {
                "time": [at for at, _ in rows],
                "value": [factor * value + offset for _, value in rows],
            }
    return {
        "turbine": name,
        "time": [row[0] for row in found],
        "final": [row[1] for row in found],
        "condensation": [row[2] for row in found],
        "courses": courses,
        "readings": readings,
        "properties": _properties(store, name, since),
        "alarms": [a for a in alarms_view(store, name) if a["ended"] is None or a["ended"] >= since],
        "signals": [
            {"signal": signal, "last": last, "received": received, "count": count}
            for signal, last, received, count in store.rows(
                "SELECT signal, MAX(time), MAX(received), COUNT(*) FROM observation WHERE turbine = ? GROUP BY signal "
                "ORDER BY signal",
                (name,),
            )
        ],
        "counts": {kind: n for (turbine, kind), n in sorted(store.counters().items()) if turbine == name},
    }


def alarms_view(store: Store, turbine: str | None = None) -> list[dict]:
    """Alarms, open ones first, then the newest."""
    names = (
        "id", "turbine", "kind", "severity", "began", "ended", "acknowledged", "acknowledged_by", "statement", "remedy"
    )  # fmt: skip
    where, parameters = ("WHERE turbine = ?", (turbine,)) if turbine is not None else ("", ())
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
        one = found.setdefault(
            prop, {"name": prop, "unit": unit, "time": [], "value": [], "lower": [], "upper": []}
        )
        one |= {"reference": reference, "observable": bool(observable)}
        for key, number in (("time", at), ("value", value), ("lower", lower), ("upper", upper)):
            one[key].append(number)
    return list(found.values())


def _scaled(
    value: float | None, factor: float, offset: float, width: float = 0.0, sd: float | None = 0.0
) -> float | None:
    return None if value is None else factor * value + offset + width * (sd or 0.0)


def _thinned(rows: Sequence) -> Sequence:
    """At most `MOST` of the rows, evenly, the last one among them."""
    step = -(-len(rows) // MOST)
    return rows if step <= 1 else rows[(len(rows) - 1) % step :: step]


def health_view(streams: Mapping[str, tuple[str, str]], health: object, counters: Mapping) -> dict:
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
