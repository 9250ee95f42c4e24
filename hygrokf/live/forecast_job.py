"""One turbine's forecast and advice, from its tracker's state and what the store holds of the last weeks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass

import numpy as np

from hygrokf.data.ambient import ambient_absolute_humidity
from hygrokf.data.record import Record, Series
from hygrokf.live.fault_isolation import BEFORE_S, LONGEST_S, Finding, inquire
from hygrokf.live.forecast import Advice, Forecast, NoForecast, forecast, restart
from hygrokf.live.plan import Plan
from hygrokf.live.properties import Departure
from hygrokf.live.scenarios import DAY_S, DAYS, NoOutlook, Outlook, persistence, weather_forecast
from hygrokf.live.storage.store import Batch, Store
from hygrokf.live.tracker import AMBIENT_HUMIDITIES, Point, Tracker, record_of
from hygrokf.live.turbines import Turbine

DRIVERS = ("ambient_temperature", *AMBIENT_HUMIDITIES, "active_power", "preheating")
CABINET = ("cabinet_temperature", "cabinet_relative_humidity", "cabinet_absolute_humidity")
EVERY_S = 3600.0
"""[s] between two forecasts of a turbine."""


@dataclass(frozen=True)
class Ahead:
    """What is expected of a turbine: a forecast, and at standstill the advice; or in words why there is none."""

    time_s: float
    forecast: Forecast | None
    advice: Advice | None
    words: str


def ahead_batch(name: str, found: Ahead, limit: float) -> Batch:
    """What the store keeps of it."""
    said = {"made": found.time_s, "weather": found.words, "limit": limit}
    advice = None if found.advice is None else asdict(found.advice)
    return Batch(
        forecasts={name: found.forecast}, memories={(name, "forecast"): said, (name, "advice"): advice}
    )


def look_ahead(name: str, one: Turbine, tracker: Tracker, store: Store) -> Ahead | None:
    """What is expected of a turbine from its newest state on; None before it has one."""
    state = tracker.newest_state
    if state is None:
        return None
    plan = one.plan
    signals = (*DRIVERS, *plan.further)
    history = _history(store, name, plan, signals, state.time - (DAYS + 5) * DAY_S, state.time)
    try:
        outlook = _outlook(store, name, plan.further, history, state)
        found = forecast(plan, state, outlook, one.surface, one.limit)
        # while it runs nobody waits for a restart
        advice = None if tracker.running else restart(plan, state, outlook, one.surface, one.limit)
    except (NoOutlook, NoForecast) as fault:
        return Ahead(state.time, None, None, str(fault))
    return Ahead(state.time, found, advice, outlook.words)


def _outlook(store: Store, name: str, further: tuple[str, ...], history: Record, state: Point) -> Outlook:
    coming = _coming(store, name, state.time)
    if coming:
        try:
            seed = int(state.time) % 2**32
            return weather_forecast(history, state.time, coming, further, seed=seed)
        except NoOutlook:
            pass  # one that has run out says less than the last weeks do
    return persistence(history, state.time, further)


def inquiry_into(
    name: str, one: Turbine, departures: Iterable[Departure], store: Store
) -> Iterator[Finding | None]:
    """The steps of an inquiry into a turbine's departures, on its readings since some weeks before them."""
    since = min(departure.since for departure in departures)
    newest = store.rows("SELECT MAX(time) FROM estimate WHERE turbine = ?", (name,))[0][0]
    first = max(since - BEFORE_S, newest - LONGEST_S)
    signals = (*CABINET, *DRIVERS, *one.plan.further)
    try:
        yield from inquire(one.plan, _history(store, name, one.plan, signals, first, newest))
    except ValueError:
        yield Finding(newest, "")


def _history(
    store: Store, name: str, plan: Plan, signals: tuple[str, ...], since: float, until: float
) -> Record:
    times: dict[str, list[float]] = {}
    values: dict[str, list[float]] = {}
    for signal, at, value in store.course(name, signals, since, until):
        times.setdefault(signal, []).append(at)
        values.setdefault(signal, []).append(value)
    return record_of(plan, times, values)


def _coming(store: Store, name: str, now_s: float) -> Mapping[str, Series]:
    """The weather forecast that is stored for a turbine, or for all of them; nothing where there is none."""
    rows: dict[str, list[tuple[float, float]]] = {}
    for signal, at, value in store.weather(name, now_s - DAY_S):
        rows.setdefault(signal, []).append((at, value))
    series = tuple(
        Series(signal, np.array([t for t, _ in pairs]), np.array([v for _, v in pairs]))
        for signal, pairs in sorted(rows.items())
        if len(pairs) > 1
    )
    record = Record(name, series)
    if "ambient_temperature" not in record:
        return {}
    vapour = ambient_absolute_humidity(record)
    return {} if vapour is None else {"temperature": record["ambient_temperature"], "vapour": vapour}
