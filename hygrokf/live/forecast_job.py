"""One turbine's forecast and restart advice, from its tracker's state and the stored readings of the last
weeks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import groupby
from operator import itemgetter

import numpy as np

from hygrokf.data.prepared import prepare
from hygrokf.data.record import Record, Series
from hygrokf.data.structured import plain
from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.live.batch import Batch
from hygrokf.live.fault_isolation import AMBIENT, BEFORE_S, LONGEST_S, CauseFinding, ShiftStep, isolate
from hygrokf.live.forecast import ForecastMade, NoForecast, forecast, restart
from hygrokf.live.plan import AMBIENT_HUMIDITIES, Plan
from hygrokf.live.scenarios import DAYS, NoScenarios, Scenarios, persistence, weather_forecast
from hygrokf.live.storage.store import Store
from hygrokf.live.tracker import Point, Tracker, record_of
from hygrokf.live.turbines import Turbine
from hygrokf.texts.live_codes import BasisCode

DRIVERS = ("ambient_temperature", *AMBIENT_HUMIDITIES, "active_power", "preheating")
CABINET = ("cabinet_temperature", "cabinet_relative_humidity", "cabinet_absolute_humidity")
EVERY_S = HOUR_S
"""[s] between two forecasts of a turbine."""


def make_forecast(name: str, one: Turbine, tracker: Tracker, store: Store) -> tuple[float, Batch] | None:
    """Forecast a turbine from its newest state on; None before it has a state.

    Returns the time [s] of that state, and the batch that stores the forecast and, at standstill, the advice,
    or why there are none.
    """
    state = tracker.newest_state
    if state is None:
        return None
    plan, excess = one.plan, tracker.excess
    signals = (*DRIVERS, *plan.further)
    history = _history(store, name, plan, signals, state.time - (DAYS + 5) * DAY_S, state.time)
    found, advice = None, None
    try:
        scenarios = _scenarios(store, name, plan.further, history, state)
        found = forecast(plan, state, scenarios, one.surface, one.limit, excess)
        basis = scenarios.basis
        # a running turbine needs no restart advice
        if not tracker.running:
            heating_sd_K = one.heating_sd_K
            advice = restart(plan, state, scenarios, one.surface, one.limit, heating_sd_K, excess).statement
    except (NoScenarios, NoForecast) as fault:
        found, basis = None, BasisCode.NO_FORECAST(fault=str(fault))
    batch = Batch(forecasts={name: found})
    batch.memories[name, "forecast"] = plain(ForecastMade(state.time, basis, one.limit, advice))
    return state.time, batch


def _scenarios(store: Store, name: str, further: tuple[str, ...], history: Record, state: Point) -> Scenarios:
    weather = _stored_weather(store, name, state.time)
    if weather:
        try:
            seed = int(state.time) % 2**32
            return weather_forecast(history, state.time, weather, further, seed=seed)
        except NoScenarios:
            pass  # the last weeks are better than an expired forecast
    return persistence(history, state.time, further)


def isolation_steps(
    name: str,
    one: Turbine,
    step: ShiftStep,
    store: Store,
    reference: Point | None = None,
    sisters: Mapping[str, Plan] | None = None,
) -> Iterator[CauseFinding | None]:
    """Search for the cause of a turbine's lasting shifts, on readings from some weeks before them, or since
    the state from which shifts count after a stated change, up to the time of the step; `sisters`: the plans
    of the turbines whose readings up to then are final."""
    since = min(shift.since for shift in step.lasting)
    first = max(since - BEFORE_S, step.time - LONGEST_S)
    if reference is not None:
        first = reference.time - one.plan.context_s
    signals = (*CABINET, *DRIVERS, *one.plan.further)
    try:
        history = _history(store, name, one.plan, signals, first, step.time)
        others = [
            _history(store, sister, plan, tuple(AMBIENT.values()), first, step.time)
            for sister, plan in (sisters or {}).items()
        ]
        for found in isolate(one.plan, history, reference, others):
            yield None if found is None else replace(found, time_s=step.time)
    except ValueError:
        yield CauseFinding(step.time, "")


def _history(
    store: Store, name: str, plan: Plan, signals: tuple[str, ...], since: float, until: float
) -> Record:
    courses = _by_signal(store.course(name, signals, since, until))
    times, values = ({signal: one[column] for signal, one in courses.items()} for column in (0, 1))
    return record_of(plan, times, values, store.losses(name))


def _stored_weather(store: Store, name: str, now_s: float) -> Mapping[str, Series]:
    """The stored weather forecast for a turbine or, else, for all; empty without one."""
    courses = _by_signal(store.weather(name, now_s - DAY_S))
    record = Record(name, tuple(Series(signal, *one) for signal, one in courses.items() if len(one[0]) > 1))
    if "ambient_temperature" not in record:
        return {}
    vapour = prepare(record).ambient_vapour
    return {} if vapour is None else {"temperature": record["ambient_temperature"], "vapour": vapour}


def _by_signal(rows: Iterable[tuple[str, float, float]]) -> dict[str, np.ndarray]:
    """Times and values (2, T) of each signal, from rows that are sorted by it."""
    groups = groupby(rows, key=itemgetter(0))
    return {signal: np.array([row[1:] for row in group]).T.copy() for signal, group in groups}
