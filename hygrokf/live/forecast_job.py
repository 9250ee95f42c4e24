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
from hygrokf.live.fault_isolation import (
    LONGEST_ISOLATION_S,
    SHIFT_BEFORE_S,
    SISTERS_SIGNAL,
    CauseFinding,
    ShiftStep,
    isolate,
)
from hygrokf.live.forecast import ForecastMade, NoForecast, forecast, restart
from hygrokf.live.plan import Plan
from hygrokf.live.scenarios import PAST_DAYS, NoScenarios, Scenarios, persistence, weather_forecast
from hygrokf.live.storage.store import Store
from hygrokf.live.tracker import Point, Tracker, tracked_record
from hygrokf.live.turbine import Turbine
from hygrokf.physics.signal_names import AMBIENT_HUMIDITIES, CABINET_SIGNALS
from hygrokf.texts.live_codes import BasisCode

FORECAST_DRIVERS = ("ambient_temperature", *AMBIENT_HUMIDITIES, "active_power", "preheating")
FORECAST_EVERY_S = HOUR_S
"""[s] between two forecasts of a turbine."""


def make_forecast(name: str, turbine: Turbine, tracker: Tracker, store: Store) -> tuple[float, Batch] | None:
    """Forecast a turbine from its newest state; returns None before it has a state.

    Otherwise returns the time [s] of the state, and the batch that stores the forecast and, at standstill,
    the advice, or the reason why there is no forecast.
    """
    state = tracker.newest_state
    if state is None:
        return None
    plan, excess = turbine.plan, tracker.excess
    signals = (*FORECAST_DRIVERS, *plan.extra_signals)
    history = _history(store, name, plan, signals, state.time - (PAST_DAYS + 5) * DAY_S, state.time)
    new_forecast, advice = None, None
    try:
        scenarios = _scenarios(store, name, plan.extra_signals, history, state)
        new_forecast = forecast(plan, state, scenarios, turbine.surface, turbine.limit, excess)
        basis = scenarios.basis
        # a running turbine needs no restart advice
        if not tracker.running:
            heating_sd_K = turbine.heating_sd_K
            advice = restart(
                plan, state, scenarios, turbine.surface, turbine.limit, heating_sd_K, excess
            ).statement
    except (NoScenarios, NoForecast) as fault:
        new_forecast, basis = None, BasisCode.NO_FORECAST(fault=str(fault))
    batch = Batch(forecasts={name: new_forecast})
    batch.memories[name, "forecast"] = plain(ForecastMade(state.time, basis, turbine.limit, advice))
    return state.time, batch


def _scenarios(store: Store, name: str, further: tuple[str, ...], history: Record, state: Point) -> Scenarios:
    """Return scenarios from the stored weather forecast or, without a usable one, from persistence."""
    weather = _stored_weather(store, name, state.time)
    if weather:
        try:
            seed = int(state.time) % 2**32
            return weather_forecast(history, state.time, weather, further, seed=seed)
        except NoScenarios:
            pass  # persistence of the last weeks is better than an expired forecast
    return persistence(history, state.time, further)


def isolation_steps(
    name: str,
    turbine: Turbine,
    step: ShiftStep,
    store: Store,
    reference: Point | None = None,
    sisters: Mapping[str, Plan] | None = None,
) -> Iterator[CauseFinding | None]:
    """Search for the cause of a turbine's lasting shifts in its readings up to the time of the step; yields
    None after each part of the search, and finally the finding.

    The readings begin some weeks before the shifts or, with a `reference`, before this state, against which
    shifts are judged after a stated change.  `sisters`: the plans of the turbines whose readings up to the
    step are final.
    """
    since = min(shift.since for shift in step.lasting)
    first_s = max(since - SHIFT_BEFORE_S, step.time - LONGEST_ISOLATION_S)
    if reference is not None:
        first_s = reference.time - turbine.plan.context_s
    signals = (*CABINET_SIGNALS, *FORECAST_DRIVERS, *turbine.plan.extra_signals)
    try:
        history = _history(store, name, turbine.plan, signals, first_s, step.time)
        others = [
            _history(store, sister, plan, tuple(SISTERS_SIGNAL.values()), first_s, step.time)
            for sister, plan in (sisters or {}).items()
        ]
        for finding in isolate(turbine.plan, history, reference, others):
            yield None if finding is None else replace(finding, time_s=step.time)
    except ValueError:
        yield CauseFinding(step.time, "")


def _history(
    store: Store, name: str, plan: Plan, signals: tuple[str, ...], since: float, until: float
) -> Record:
    """Return the record of a turbine's stored readings of some signals, from `since` to `until` [s]."""
    courses = _by_signal(store.course(name, signals, since, until))
    times, values = ({signal: rows[column] for signal, rows in courses.items()} for column in (0, 1))
    return tracked_record(plan, times, values, store.losses(name))


def _stored_weather(store: Store, name: str, now_s: float) -> Mapping[str, Series]:
    """Return the stored weather forecast for a turbine: series "temperature" [K] and "vapour" [kg/m³]; empty
    without a usable forecast."""
    courses = _by_signal(store.weather(name, now_s - DAY_S))
    record = Record(
        name, tuple(Series(signal, *rows) for signal, rows in courses.items() if len(rows[0]) > 1)
    )
    if "ambient_temperature" not in record:
        return {}
    vapour = prepare(record).ambient_vapour
    return {} if vapour is None else {"temperature": record["ambient_temperature"], "vapour": vapour}


def _by_signal(rows: Iterable[tuple[str, float, float]]) -> dict[str, np.ndarray]:
    """Return signal → times [s] and values (2, T), from rows sorted by signal (signal, time, value)."""
    groups = groupby(rows, key=itemgetter(0))
    return {signal: np.array([row[1:] for row in signal_rows]).T.copy() for signal, signal_rows in groups}
