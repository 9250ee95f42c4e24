"""Possible weather and operation: members drawn from the turbine's own last weeks, or around a weather
forecast.

Without a weather forecast each member uses one of the last weeks' days: how temperature and vapour deviated
from their mean at each hour of the day, minus the part that could be predicted from the start of that day.
The prediction from today's start plus this part gives persistence with a realistic spread.  Operation is as
on other days, as after earlier standstills of the same length, or as now.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.actuators import ACTUATORS
from hygrokf.data.ambient import AMBIENT_BRIDGE_H, at_times, bridge_h
from hygrokf.data.input_paths import input_path
from hygrokf.data.prepared import VAPOUR, PreparedRecord, prepare
from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.physics.psychrometrics import absolute_humidity, relative_humidity
from hygrokf.texts.live_codes import BasisCode
from hygrokf.texts.statement import Statement

FINE_S = 600.0
"""[s] between instants of the scenarios for pre-heating advice."""
LOOK_BACK_S = 3 * HOUR_S
"""[s] before now at which the scenarios begin, for inputs that depend on the past."""
FORECAST_MEMBERS = 24
"""Number of members drawn around a weather forecast."""
FORECAST_ERROR = {"temperature_K": 1.5, "vapour": 0.08}
"""Standard deviation of a weather forecast's error a day ahead: temperature [K], logarithm of vapour
concentration [1]."""
ERROR_H = 12.0
"""Correlation time of the errors of a weather forecast [h], and the time constant with which the present
error decays."""
WEATHER_DAYS = 3.0
"""Duration of a weather pattern [d]: this number of the members' days counts as one independent day in the
spread of the members."""
DRIEST, MOISTEST = 1e-5, 1.0
"""Lowest vapour concentration [kg/m³] and highest relative humidity [1] of the ambient."""
SCENARIO_STEP_S = 1800.0
"""[s] between the instants of the scenarios."""
HORIZON_S = 48 * HOUR_S
"""[s] after now at which the scenarios end."""
PAST_DAYS = 30
"""Number of past days considered."""
FEWEST_PAST_DAYS = 5
"""Smallest number of past days needed."""
LEVEL_H = 4.0
"""Time constant [h] with which the present power loses its influence on the forecast power."""
SWITCHED_DAILY = ("active_power", "preheating")
OPERATION_SIGNALS = (*SWITCHED_DAILY, *ACTUATORS)
"""Signals whose course belongs to the operation of a day; they are taken from one day together."""
PRESENT_S = 3 * HOUR_S
"""[s] before now over which the mean of an actuator is its present value: thermostats switch often."""

Courses = dict[str, np.ndarray]
"""Signal → values (H,) at the instants of the scenarios."""


class NoScenarios(Exception):
    """No scenarios can be made; the message says why."""


@dataclass(frozen=True)
class Scenarios:
    """Possible futures, seen from `now_s` [s].

    `members`: each maps signal → values (H,) [SI unit] at `time_s` (H,) [s], with the same signals in all;
    `basis`: what the scenarios are based on.
    """

    now_s: float
    time_s: np.ndarray
    members: tuple[Mapping[str, np.ndarray], ...]
    basis: Statement

    def with_preheating(self, hours: float, heaters: Mapping[str, float] | None = None) -> Scenarios:
        """Return the scenarios for the next `hours` [h] with the turbine at standstill, and with pre-heating
        and `heaters` (signal -> value at full power [SI unit]) on from now on.

        Other actuators act as in the scenarios; a door is closed.
        """
        time = np.arange(self.time_s[0], self.now_s + HOUR_S * hours + 1.0, FINE_S)
        is_future = time > self.now_s + 1.0
        switched = {"active_power": 0.0, "preheating": 1.0, **(heaters or {})}
        members = []
        for member in self.members:
            courses = {name: np.interp(time, self.time_s, values) for name, values in member.items()}
            closed = {"door_open": 0.0} if "door_open" in courses else {}
            for name, value in {**closed, **switched}.items():
                courses[name] = np.where(is_future, value, courses.get(name, 0.0))
            members.append(courses)
        return replace(self, time_s=time, members=tuple(members))


def grid(now_s: float) -> np.ndarray:
    """Return the instants (H,) [s] of the scenarios."""
    return now_s + np.arange(-LOOK_BACK_S, HORIZON_S + 1.0, SCENARIO_STEP_S)


def persistence(history: Record, now_s: float, further: Sequence[str] = ()) -> Scenarios:
    """Return scenarios from the ambient and the operation of the last weeks.

    `history`: readings of up to the last `PAST_DAYS` days, of which those after `now_s` [s] are ignored;
    `further`: signals beside ambient and operation that the model reads.  Raises NoScenarios with fewer than
    `FEWEST_PAST_DAYS` complete days.
    """
    time, history = grid(now_s), prepare(history.window(-np.inf, now_s))
    days = _complete_days(history, time, further)
    if len(days) < FEWEST_PAST_DAYS:
        raise NoScenarios(
            f"persistence needs {FEWEST_PAST_DAYS} complete days of ambient readings that began two days ago "
            f"or earlier; found {len(days)}"
        )
    ambient = _possible_ambients(history, now_s, time, [day for day, _ in days])
    operations, operation = possible_operation(
        history, now_s, time, [courses for _, courses in days], len(days)
    )
    members = tuple({**weather, **operating} for weather, operating in zip(ambient, operations, strict=True))
    return Scenarios(now_s, time, members, BasisCode.PERSISTENCE(days=len(members), operation=operation))


def weather_forecast(
    history: Record,
    now_s: float,
    coming: Mapping[str, Series],
    further: Sequence[str] = (),
    error: Mapping[str, float] = FORECAST_ERROR,
    seed: int = 0,
) -> Scenarios:
    """Return scenarios around a weather forecast.

    `history`, `further`: as of `persistence`; `coming`: the forecast's series "temperature" [K] and "vapour"
    [kg/m³]; `error`: standard deviations a day ahead.  The forecast is corrected by its error at the last
    reading, which decays within hours.  Raises NoScenarios if the forecast does not cover a day.
    """
    time, history = grid(now_s), prepare(history.window(-np.inf, now_s))
    absent = sorted({"temperature", "vapour"} - set(coming))
    if absent:
        raise NoScenarios(f"the weather forecast has no {' and no '.join(absent)}")
    base, spread = {}, {}
    for name, series in _ambient(history).items():
        path, newest = _continue_readings(series, input_path(coming[name]), now_s, log=name == "vapour")
        base[name] = at_times(path, time, AMBIENT_BRIDGE_H)
        spread[name] = np.sqrt(1.0 - np.exp(-2.0 * np.maximum(time - newest, 0.0) / (HOUR_S * ERROR_H)))
    now_index = int(np.searchsorted(time, now_s))
    unknown = np.flatnonzero(np.isnan(base["temperature"]) | np.isnan(base["vapour"]))
    if now_index in unknown:
        raise NoScenarios("neither the weather forecast nor the ambient readings cover the present")
    first = unknown[unknown < now_index].max(initial=-1) + 1
    last = unknown[unknown > now_index].min(initial=len(time))
    if time[last - 1] < now_s + DAY_S:
        raise NoScenarios("the weather forecast ends within a day; send a newer one")
    covered = slice(first, last)
    random = np.random.default_rng(seed)
    members = []
    for _ in range(FORECAST_MEMBERS):
        ambient = {
            name: base[name] + error[key] * spread[name] * _random_course(random, len(time))
            for name, key in (("temperature", "temperature_K"), ("vapour", "vapour"))
        }
        members.append(
            _saturation_limited(ambient["temperature"][covered], np.exp(ambient["vapour"][covered]))
        )
    days = [courses for _, courses in _complete_days(history, time, further)]
    operations, operation = possible_operation(history, now_s, time, days, FORECAST_MEMBERS)
    joined_members = tuple(
        {**weather, **{name: values[covered] for name, values in operating.items()}}
        for weather, operating in zip(members, operations, strict=True)
    )
    return Scenarios(now_s, time[covered], joined_members, BasisCode.WEATHER_FORECAST(operation=operation))


def _continue_readings(readings: Series, forecast: Series, now_s: float, log: bool) -> tuple[Series, float]:
    """Continue readings up to `now_s` [s] by the forecast; returns the series, as logarithms if `log`, and
    the time of the newest reading [s].

    The difference between the newest reading and the forecast is added to the forecast, decaying with
    `ERROR_H`.
    """

    def scaled(values: np.ndarray) -> np.ndarray:
        return np.log(np.maximum(values, DRIEST)) if log else values

    is_past = ~readings.missing & (readings.time <= now_s)
    newest = float(readings.time[is_past][-1]) if is_past.any() else -np.inf
    is_later = forecast.time > newest
    forecast_then = scaled(at_times(forecast, np.array([newest]), AMBIENT_BRIDGE_H))
    difference = scaled(readings.value[is_past][-1:]) - forecast_then
    decay = np.exp(-(forecast.time[is_later] - newest) / (HOUR_S * ERROR_H))
    value = scaled(forecast.value[is_later]) + np.nan_to_num(difference).sum() * decay
    time = np.concatenate([readings.time[is_past], forecast.time[is_later]])
    value = np.concatenate([scaled(readings.value[is_past]), value])
    return replace(readings, time=time, value=value), newest


def _random_course(random: np.random.Generator, count: int) -> np.ndarray:
    """Return a random course (count,): Ornstein-Uhlenbeck, standard deviation 1, correlation time
    `ERROR_H`."""
    autocorrelation = math.exp(-SCENARIO_STEP_S / HOUR_S / ERROR_H)
    steps = random.standard_normal(count)
    course = np.empty(count)
    course[0] = steps[0]
    for i in range(1, count):
        course[i] = autocorrelation * course[i - 1] + math.sqrt(1.0 - autocorrelation**2) * steps[i]
    return course


def _ambient(history: PreparedRecord) -> dict[str, Series]:
    """Return the ambient's temperature [K] and vapour [kg/m³].  Raises NoScenarios without readings."""
    if "ambient_temperature" not in history or history.ambient_vapour is None:
        raise NoScenarios("no readings of the ambient's temperature and humidity")
    return {"temperature": history.path("ambient_temperature"), "vapour": history.path(VAPOUR)}


def _complete_days(
    history: PreparedRecord, time: np.ndarray, further: Sequence[str]
) -> list[tuple[int, dict[str, np.ndarray]]]:
    """Return (days ago, courses of all non-ambient signals at the instants `time` [s] shifted by these days),
    for the days on which the readings of the ambient and of the signals `further` are complete."""
    absent = sorted(set(further) - set(history.signals))
    if absent:
        raise NoScenarios(f"the model needs {', '.join(absent)}, of which there are no readings")
    ambient = _ambient(history)
    climate = [
        signal
        for signal in history.signals
        if signal.startswith(("cabinet_", "ambient_")) and signal != "ambient_pressure"
    ]
    others = {
        series.signal: series
        for series in history.series
        if series.signal not in climate and not series.missing.all()
    }
    complete_days = []
    for days_ago in range(2, PAST_DAYS + 3):
        past_s = time - days_ago * DAY_S
        if not all(np.isfinite(values_at(series, past_s)).all() for series in ambient.values()):
            continue
        courses = {name: values_at(series, past_s) for name, series in others.items()}
        if not all(np.isfinite(courses[name]).all() for name in further):
            continue
        # as in the features, an unknown value takes the mean; unknown power stays NaN and excludes the day
        mean = {name: np.nanmean(series.value) for name, series in others.items() if name != "active_power"}
        mean |= {"active_power": np.nan, "preheating": 0.0}
        filled = {name: np.where(np.isnan(values), mean[name], values) for name, values in courses.items()}
        complete_days.append((days_ago, filled))
    return complete_days


def _possible_ambients(
    history: PreparedRecord, now_s: float, time: np.ndarray, days: Sequence[int]
) -> list[dict[str, np.ndarray]]:
    """Return possible courses of the ambient at the instants `time` [s], one for each of the `days` ago.

    Humidity is drawn as w with RH = exp(−w²), so that the air stays below saturation for every deviation of
    w, and a deviation of w has less effect near saturation, as in air that would condense.
    """
    ambient = _ambient(history)
    kelvin = _possible_courses(ambient["temperature"], now_s, time, days)
    dryness = _possible_courses(
        _humidity(ambient), now_s, time, days, scaled=lambda humidity: np.sqrt(-np.log(humidity))
    )
    return [
        _saturation_limited(temperature, absolute_humidity(np.exp(-(w**2)), temperature))
        for temperature, w in zip(kelvin, dryness, strict=True)
    ]


def _humidity(ambient: Mapping[str, Series]) -> Series:
    """Return the ambient's relative humidity [1] at the times of its vapour readings, at most saturation."""
    vapour, temperature = ambient["vapour"], ambient["temperature"]
    kelvin = at_times(temperature, vapour.time, bridge_h(temperature, AMBIENT_BRIDGE_H))
    value = np.minimum(relative_humidity(np.maximum(vapour.value, DRIEST), kelvin), MOISTEST)
    return replace(vapour, signal="ambient_relative_humidity", value=value)


def _possible_courses(
    series: Series,
    now_s: float,
    time: np.ndarray,
    days: Sequence[int],
    scaled: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> list[np.ndarray]:
    """Return possible courses (H,) of a signal, transformed by `scaled`, one for each of the `days` ago.

    Up to `now_s` each course equals the readings.  After it a course is the sum of the mean at that hour of
    the day, the persistence of today's deviation from this mean, and the part of the other day's deviation
    that the start of that day did not predict.
    """
    hours = np.arange(0.0, DAY_S, SCENARIO_STEP_S)
    # values (hours of the day, days ago), of which the mean (hours of the day,) is the usual day
    past = scaled(values_at(series, now_s - DAY_S + hours[:, None] - DAY_S * np.arange(0, PAST_DAYS + 3)))
    is_known = np.isfinite(past)
    usual_day = np.where(is_known, past, 0.0).sum(axis=1) / np.maximum(is_known.sum(axis=1), 1)
    phase = np.mod(time - now_s, DAY_S) / SCENARIO_STEP_S
    expected = usual_day[np.round(phase).astype(int) % len(hours)]
    deviation = (past - usual_day[:, None]).T[::-1].reshape(-1)  # by time, oldest first
    # autocorrelation of the deviation over a day
    first, day_later = deviation[: -len(hours)], deviation[len(hours) :]
    is_pair = np.isfinite(first) & np.isfinite(day_later)
    product, square = first[is_pair] * day_later[is_pair], first[is_pair] ** 2
    autocorrelation = float(np.sum(product) / max(np.sum(square), 1e-12))
    memory = np.clip(autocorrelation, 0.02, 0.98) ** (np.maximum(time - now_s, 0.0) / DAY_S)
    is_past = time <= now_s
    now_index = int(np.flatnonzero(is_past)[-1])
    observed = _filled_forward(scaled(values_held(series, time)), now_index)
    today = observed[now_index] - expected[now_index]
    # the members share a mean of few independent days: widen them by its uncertainty
    independent_days = max(len(days) / WEATHER_DAYS, 2.0)
    widening = math.sqrt((independent_days + 1.0) / (independent_days - 1.0))
    courses = []
    for day in days:
        day_deviation = scaled(values_at(series, time - day * DAY_S)) - expected
        future = expected + memory * today + widening * (day_deviation - memory * day_deviation[now_index])
        courses.append(np.where(is_past, observed, future))
    return courses


def _filled_forward(values: np.ndarray, now_index: int) -> np.ndarray:
    """Fill gaps in values (H,) by the previous value, at the start by the first one.  Raises NoScenarios if
    the present value is unknown."""
    known_index = np.flatnonzero(np.isfinite(values))
    if not np.isfinite(values[now_index]):
        raise NoScenarios(f"no readings of the ambient within the last {AMBIENT_BRIDGE_H:.0f} h")
    last_known = np.maximum(np.searchsorted(known_index, np.arange(len(values)), side="right") - 1, 0)
    return values[known_index[last_known]]


def _saturation_limited(kelvin: np.ndarray, vapour: np.ndarray) -> dict[str, np.ndarray]:
    """Return the ambient of a member, from temperature [K] and vapour [kg/m³] (H,), limited to saturation."""
    return {
        "ambient_temperature": kelvin,
        "ambient_absolute_humidity": np.clip(vapour, DRIEST, absolute_humidity(MOISTEST, kelvin)),
    }


# -- operation -----------------------------------------------------------------------------------------------
def values_at(series: Series, time: np.ndarray) -> np.ndarray:
    """Interpolate a series at times [s]; NaN outside it and in gaps that the filter would not bridge."""
    return at_times(series, time, bridge_h(series, AMBIENT_BRIDGE_H))


def values_held(series: Series, time: np.ndarray) -> np.ndarray:
    """Interpolate as `values_at`, but hold the last reading for the longest gap that is bridged."""
    known_s = series.time[~series.missing]
    if not len(known_s):
        return np.full(len(time), np.nan)
    stale = time > known_s[-1] + HOUR_S * bridge_h(series, AMBIENT_BRIDGE_H)
    return np.where(stale, np.nan, values_at(series, np.minimum(time, known_s[-1])))


def possible_operation(
    history: Record, now_s: float, time: np.ndarray, days: Sequence[Courses], count: int
) -> tuple[list[Courses], Statement]:
    """Return `count` courses of the non-ambient signals, with an operation that may follow the present one,
    and a statement of what this operation is based on.

    days: non-ambient signals of earlier days at the scenarios' instants `time` (H,) [s], used in turn.
    """
    given_days = [days[i % len(days)] if days else {} for i in range(count)]
    names = [name for name in OPERATION_SIGNALS if name in history and not history[name].missing.all()]
    recent = {name: values_held(history[name], time) for name in names}
    with_power = [day for day in days if np.isfinite(day.get("active_power", np.nan)).all()]
    level = _present_power(recent["active_power"], time, now_s) if "active_power" in recent else np.nan
    # actuators as now, without pre-heating
    steady = {name: 0.0 if name in SWITCHED_DAILY else _present_mean(history[name], now_s) for name in names}
    if np.isnan(level) and len(with_power) < FEWEST_PAST_DAYS:
        names = [name for name in names if name != "active_power"]
        recent = {name: recent[name] if name != "preheating" else np.zeros(len(time)) for name in names}
        given_days = [
            {name: values for name, values in day.items() if name not in SWITCHED_DAILY} for day in given_days
        ]
        operations = [
            {name: day.get(name, np.full(len(time), steady[name])) for name in names} for day in given_days
        ]
        basis = BasisCode.OPERATION_UNKNOWN()
    elif np.isnan(level):
        operations = _operation_of_days(with_power, given_days, names)
        basis = BasisCode.PRESENT_POWER_UNKNOWN()
    elif level <= 0.0:
        operations, basis = _operation_after_standstill(history, now_s, time, given_days, steady)
    else:
        days_running = [day for day in with_power if _present_power(day["active_power"], time, now_s) > 0.0]
        operations, basis = _operation_while_running(
            days_running, given_days, {**steady, "active_power": level}, time, now_s
        )
    is_past = time <= now_s
    courses = []
    for day, operation in zip(given_days, operations, strict=True):
        complete = {
            name: np.where(np.isnan(values), steady[name], values) for name, values in operation.items()
        }
        joined = {
            name: np.where(is_past & np.isfinite(values), values, complete[name])
            for name, values in recent.items()
        }
        courses.append({**day, **joined})
    return courses, basis


def _present_mean(series: Series, now_s: float) -> float:
    """Return the mean of an actuator over the last `PRESENT_S`; 0 if it is unknown."""
    values = values_held(series, now_s - np.arange(0.0, PRESENT_S, 60.0))
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else 0.0


def _operation_of_days(
    chosen: Sequence[Courses], given: Sequence[Courses], names: Sequence[str]
) -> list[Courses]:
    """Return the operation of each given day, or of the `chosen` days in turn if it is not among them.

    names: signals of the operation.
    """
    chosen_ids = {id(day) for day in chosen}
    sources = [day if id(day) in chosen_ids else chosen[i % len(chosen)] for i, day in enumerate(given)]
    return [{name: day[name] for name in names} for day in sources]


def _operation_while_running(
    alike: Sequence[Courses],
    given: Sequence[Courses],
    steady: Mapping[str, float],
    time: np.ndarray,
    now_s: float,
) -> tuple[list[Courses], Statement]:
    """Return the operation of each given day, while the turbine runs: that of days on which the turbine ran
    at this hour (`alike`), adjusted to the present power, or with too few such days as now (`steady`)."""
    if len(alike) < FEWEST_PAST_DAYS:
        constant = {signal: np.full(len(time), value) for signal, value in steady.items()}
        return [constant] * len(given), BasisCode.OPERATION_AS_NOW()
    operations = _operation_of_days(alike, given, tuple(steady))
    for operation in operations:
        operation["active_power"] = _shift_power(
            operation["active_power"], steady["active_power"], time, now_s
        )
    return operations, BasisCode.OPERATION_OF_ALIKE_DAYS()


def _operation_after_standstill(
    history: Record, now_s: float, time: np.ndarray, given: Sequence[Courses], steady: Mapping[str, float]
) -> tuple[list[Courses], Statement]:
    """Return the operation that may follow the present standstill: as after earlier standstills of the same
    length, or as after an unprecedented one.

    Each of these is equally likely.  Of an unprecedented standstill only the age a is known: it lasts for
    another time h with probability a/(a + h), with actuators as now (`steady`), and then the given day's
    operation follows.
    """
    age_s, earlier_times = _standstills(history, now_s)
    after_earlier = [
        {name: values_at(history[name], time - now_s + earlier_s) for name in steady}
        for earlier_s in earlier_times
    ]
    after_earlier = [operation for operation in after_earlier if np.isfinite(operation["active_power"]).all()]
    cycle = len(after_earlier) + 1
    unprecedented_count = math.ceil(len(given) / cycle)
    operations = []
    for i, day in enumerate(given):
        if i % cycle:
            operations.append(after_earlier[i % cycle - 1])
            continue
        quantile = (i // cycle + 0.5) / unprecedented_count
        stands_still = time <= now_s + age_s * (1.0 / quantile - 1.0)
        operations.append(
            {
                signal: np.where(stands_still, value, day.get(signal, value))
                for signal, value in steady.items()
            }
        )
    return operations, BasisCode.STANDSTILL_MAY_END(count=len(after_earlier))


def _standstills(history: Record, now_s: float) -> tuple[float, list[float]]:
    """Return the duration [s] of the present standstill, and the times [s] at which earlier standstills had
    lasted as long."""
    time = now_s - SCENARIO_STEP_S * np.arange(PAST_DAYS * DAY_S / SCENARIO_STEP_S)[::-1]
    power = values_held(history["active_power"], time)
    is_still = power <= 0.0
    begins = np.flatnonzero(is_still[1:] & (power[:-1] > 0.0)) + 1
    present_begin = int(np.flatnonzero(~is_still).max(initial=-1)) + 1
    age_steps = max(len(is_still) - 1 - present_begin, 0)
    ends = begins[begins + age_steps < len(is_still)] + age_steps
    reached = [end for end in ends if is_still[end - age_steps : end + 1].all()]
    return SCENARIO_STEP_S * max(age_steps, 1), [
        float(time[i]) for i in reached if time[i] + HORIZON_S <= now_s
    ]


def _present_power(power: np.ndarray, time: np.ndarray, now_s: float) -> float:
    """Return the mean power [W] of the last hour; 0 at standstill now, NaN if unknown."""
    last_hour = power[(time > now_s - 3601.0) & (time <= now_s)]
    return 0.0 if last_hour[-1] <= 0.0 else float(np.mean(np.maximum(last_hour, 0.0)))


def _shift_power(power: np.ndarray, level: float, time: np.ndarray, now_s: float) -> np.ndarray:
    """Shift the power (H,) [W] of another day to begin at today's `level` [W], without its standstills."""
    day_level = _present_power(power, time, now_s)
    decay = np.exp(-np.maximum(time - now_s, 0.0) / (HOUR_S * LEVEL_H))
    # a running turbine keeps running, with at least a hundredth of its power on that day
    shifted = np.clip(power + decay * (level - day_level), 0.01 * power, max(level, float(power.max())))
    return np.where((time > now_s) & (power > 0.0), shifted, power)
