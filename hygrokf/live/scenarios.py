"""Possible weather and operation: members drawn from the turbine's own last weeks, or around a weather
forecast.

Without a weather forecast each member uses one of the last weeks' days: how temperature and vapour deviated
from their mean at each hour of the day, minus the part that could be predicted from the start of that day.
Added to the prediction from today's start, this gives persistence with a realistic spread.  Operation is as
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
BEFORE_S = 3 * HOUR_S
"""[s] before now that the scenarios include, for inputs that look back."""
MEMBERS = 24
"""Number of members drawn around a weather forecast."""
FORECAST_ERROR = {"temperature_K": 1.5, "vapour": 0.08}
"""Standard deviation of a weather forecast's error a day ahead: temperature [K], logarithm of vapour
concentration [1]."""
ERROR_H = 12.0
"""Correlation time of these errors [h], also the time constant with which the present error fades."""
WEATHER_DAYS = 3.0
"""Duration of a weather pattern [d]: as many of the members' days count as one independent day in their
spread."""
DRIEST, MOISTEST = 1e-5, 1.0
"""Lowest vapour concentration [kg/m³] and highest relative humidity [1] of the ambient."""
STEP_S = 1800.0
"""[s] between the instants of the scenarios."""
HORIZON_S = 48 * HOUR_S
DAYS = 30
"""Number of past days considered."""
LEAST = 5
"""Smallest number of days needed."""
LEVEL_H = 4.0
"""Time constant [h] with which the present power loses its influence."""
SWITCHED = ("active_power", "preheating")
OPERATION = (*SWITCHED, *ACTUATORS)
"""Signals whose course belongs to the operation: actuators act as on the day whose operation is taken."""
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
        """The scenarios for the next `hours` [h], with the turbine at standstill, and pre-heating and
        `heaters` (signal -> value [SI unit]) on from now on.

        Other actuators act as in the scenarios; a door is closed.
        """
        time = np.arange(self.time_s[0], self.now_s + HOUR_S * hours + 1.0, FINE_S)
        after = time > self.now_s + 1.0
        switched = {"active_power": 0.0, "preheating": 1.0, **(heaters or {})}
        members = []
        for member in self.members:
            chosen = {name: np.interp(time, self.time_s, values) for name, values in member.items()}
            closed = {name: 0.0 for name in ("door_open",) if name in chosen}
            for name, value in {**closed, **switched}.items():
                chosen[name] = np.where(after, value, chosen.get(name, 0.0))
            members.append(chosen)
        return replace(self, time_s=time, members=tuple(members))


def grid(now_s: float) -> np.ndarray:
    """Instants of the scenarios [s]."""
    return now_s + np.arange(-BEFORE_S, HORIZON_S + 1.0, STEP_S)


def persistence(history: Record, now_s: float, further: Sequence[str] = ()) -> Scenarios:
    """Scenarios from the ambient and the operation of the last weeks.

    `history`: readings of up to the last `DAYS` days, of which those after `now_s` [s] are ignored;
    `further`: other signals that the model uses.  Raises NoScenarios with fewer than `LEAST` complete days.
    """
    time, history = grid(now_s), prepare(history.window(-np.inf, now_s))
    paths = _days(history, time, further)
    if len(paths) < LEAST:
        raise NoScenarios(
            f"persistence needs {LEAST} complete days of ambient readings that began two days ago or "
            f"earlier; found {len(paths)}"
        )
    ambient = _ambients(history, now_s, time, [day for day, _ in paths])
    others, operation = possible_operation(history, now_s, time, [one for _, one in paths], len(paths))
    members = tuple({**weather, **other} for weather, other in zip(ambient, others, strict=True))
    return Scenarios(now_s, time, members, BasisCode.PERSISTENCE(days=len(members), operation=operation))


def weather_forecast(
    history: Record,
    now_s: float,
    coming: Mapping[str, Series],
    further: Sequence[str] = (),
    error: Mapping[str, float] = FORECAST_ERROR,
    seed: int = 0,
) -> Scenarios:
    """Scenarios around a weather forecast.

    `coming`: the forecast's series "temperature" [K] and "vapour" [kg/m³]; `error`: standard deviations a day
    ahead.  The forecast's error at the last reading is corrected, fading within hours.  Raises NoScenarios if
    the forecast does not cover a day.
    """
    time, history = grid(now_s), prepare(history.window(-np.inf, now_s))
    absent = sorted({"temperature", "vapour"} - set(coming))
    if absent:
        raise NoScenarios(f"the weather forecast has no {' and no '.join(absent)}")
    base, spread = {}, {}
    for name, series in _ambient(history).items():
        joined, newest = _continue_readings(series, input_path(coming[name]), now_s, log=name == "vapour")
        base[name] = at_times(joined, time, AMBIENT_BRIDGE_H)
        spread[name] = np.sqrt(1.0 - np.exp(-2.0 * np.maximum(time - newest, 0.0) / (HOUR_S * ERROR_H)))
    now = int(np.searchsorted(time, now_s))
    unknown = np.flatnonzero(np.isnan(base["temperature"]) | np.isnan(base["vapour"]))
    if now in unknown:
        raise NoScenarios("neither the weather forecast nor the ambient readings cover the present")
    first, last = unknown[unknown < now].max(initial=-1) + 1, unknown[unknown > now].min(initial=len(time))
    if time[last - 1] < now_s + DAY_S:
        raise NoScenarios("the weather forecast ends within a day; send a newer one")
    kept = slice(first, last)
    random = np.random.default_rng(seed)
    members = []
    for _ in range(MEMBERS):
        drawn = {
            name: base[name] + error[key] * spread[name] * _random_course(random, len(time))
            for name, key in (("temperature", "temperature_K"), ("vapour", "vapour"))
        }
        members.append(_physical(drawn["temperature"][kept], np.exp(drawn["vapour"][kept])))
    days = [one for _, one in _days(history, time, further)]
    others, operation = possible_operation(history, now_s, time, days, MEMBERS)
    both = tuple(
        {**weather, **{name: values[kept] for name, values in other.items()}}
        for weather, other in zip(members, others, strict=True)
    )
    return Scenarios(now_s, time[kept], both, BasisCode.WEATHER_FORECAST(operation=operation))


def _continue_readings(seen: Series, told: Series, now_s: float, log: bool) -> tuple[Series, float]:
    """Readings up to now, continued by the forecast, with `log` as logarithms; and the time of the newest
    reading [s].

    The forecast's difference from the newest reading is added, fading with `ERROR_H`.
    """

    def scaled(values: np.ndarray) -> np.ndarray:
        return np.log(np.maximum(values, DRIEST)) if log else values

    past = ~seen.missing & (seen.time <= now_s)
    newest = float(seen.time[past][-1]) if past.any() else -np.inf
    later = told.time > newest
    off = scaled(seen.value[past][-1:]) - scaled(at_times(told, np.array([newest]), AMBIENT_BRIDGE_H))
    fading = np.exp(-(told.time[later] - newest) / (HOUR_S * ERROR_H))
    value = scaled(told.value[later]) + np.nan_to_num(off).sum() * fading
    time = np.concatenate([seen.time[past], told.time[later]])
    return replace(seen, time=time, value=np.concatenate([scaled(seen.value[past]), value])), newest


def _random_course(random: np.random.Generator, count: int) -> np.ndarray:
    """An Ornstein-Uhlenbeck course (count,) of standard deviation 1."""
    keep = math.exp(-STEP_S / HOUR_S / ERROR_H)
    steps = random.standard_normal(count)
    course = np.empty(count)
    course[0] = steps[0]
    for i in range(1, count):
        course[i] = keep * course[i - 1] + math.sqrt(1.0 - keep**2) * steps[i]
    return course


def _ambient(history: PreparedRecord) -> dict[str, Series]:
    if "ambient_temperature" not in history or history.ambient_vapour is None:
        raise NoScenarios("no readings of the ambient's temperature and humidity")
    return {"temperature": history.path("ambient_temperature"), "vapour": history.path(VAPOUR)}


def _days(
    history: PreparedRecord, time: np.ndarray, further: Sequence[str]
) -> list[tuple[int, dict[str, np.ndarray]]]:
    """(days ago, courses of all non-ambient signals) of days on which ambient and `further` signals are
    complete."""
    absent = sorted(set(further) - set(history.signals))
    if absent:
        raise NoScenarios(f"the model needs {', '.join(absent)}, of which there are no readings")
    ambient = _ambient(history)
    own = [s for s in history.signals if s.startswith(("cabinet_", "ambient_")) and s != "ambient_pressure"]
    others = {s.signal: s for s in history.series if s.signal not in own and not s.missing.all()}
    found = []
    for day in range(2, DAYS + 3):
        then = time - day * DAY_S
        if not all(np.isfinite(values_at(series, then)).all() for series in ambient.values()):
            continue
        chosen = {name: values_at(series, then) for name, series in others.items()}
        if not all(np.isfinite(chosen[name]).all() for name in further):
            continue
        # as in the features, an unknown value takes the mean; a day with unknown power stays NaN and is not
        # chosen
        daily_mean = {n: np.nanmean(s.value) for n, s in others.items() if n != "active_power"}
        daily_mean |= {"active_power": np.nan, "preheating": 0.0}
        found.append((day, {n: np.where(np.isnan(v), daily_mean[n], v) for n, v in chosen.items()}))
    return found


def _ambients(
    history: PreparedRecord, now_s: float, time: np.ndarray, days: Sequence[int]
) -> list[dict[str, np.ndarray]]:
    """Possible courses of the ambient, one for each of the given days ago.

    Humidity is drawn as w with RH = exp(−w²), so that the air stays below saturation whatever is added to w,
    and a deviation in w has less effect on humidity near saturation, as in air that would condense.
    """
    ambient = _ambient(history)
    kelvin = _possible_courses(ambient["temperature"], now_s, time, days)
    dryness = _possible_courses(
        _humidity(ambient), now_s, time, days, scaled=lambda humidity: np.sqrt(-np.log(humidity))
    )
    return [
        _physical(warm, absolute_humidity(np.exp(-(dry**2)), warm))
        for warm, dry in zip(kelvin, dryness, strict=True)
    ]


def _humidity(ambient: Mapping[str, Series]) -> Series:
    """Relative humidity [1] of the ambient at the times of its vapour readings, limited to saturation."""
    vapour, warm = ambient["vapour"], ambient["temperature"]
    kelvin = at_times(warm, vapour.time, bridge_h(warm, AMBIENT_BRIDGE_H))
    value = np.minimum(relative_humidity(np.maximum(vapour.value, DRIEST), kelvin), MOISTEST)
    return replace(vapour, signal="ambient_relative_humidity", value=value)


def _possible_courses(
    series: Series,
    now_s: float,
    time: np.ndarray,
    days: Sequence[int],
    scaled: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> list[np.ndarray]:
    """Possible courses of one signal, transformed by `scaled`, one for each of the given days ago.

    Up to now they are the readings.  After now they are the sum of the mean at that hour, the
    persistence of today's deviation from it, and the part of the other day's deviation that its start did not
    predict.
    """
    hours = np.arange(0.0, DAY_S, STEP_S)
    past = scaled(values_at(series, now_s - DAY_S + hours[:, None] - DAY_S * np.arange(0, DAYS + 3)))
    there = np.isfinite(past)
    daily_mean = np.where(there, past, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
    phase = np.mod(time - now_s, DAY_S) / STEP_S
    expected = daily_mean[np.round(phase).astype(int) % len(hours)]
    deviation = (past - daily_mean[:, None]).T[::-1].reshape(-1)  # by time, oldest first
    first, later = deviation[: -len(hours)], deviation[len(hours) :]
    both = np.isfinite(first) & np.isfinite(later)
    kept = float(np.sum(first[both] * later[both]) / max(np.sum(first[both] ** 2), 1e-12))
    memory = np.clip(kept, 0.02, 0.98) ** (np.maximum(time - now_s, 0.0) / DAY_S)
    before = time <= now_s
    beginning = int(np.flatnonzero(before)[-1])
    observed = _held(scaled(values_held(series, time)), beginning)
    today = observed[beginning] - expected[beginning]
    independent = max(len(days) / WEATHER_DAYS, 2.0)
    wider = math.sqrt((independent + 1.0) / (independent - 1.0))
    found = []
    for day in days:
        own = scaled(values_at(series, time - day * DAY_S)) - expected
        coming = expected + memory * today + wider * (own - memory * own[beginning])
        found.append(np.where(before, observed, coming))
    return found


def _held(values: np.ndarray, now: int) -> np.ndarray:
    """Values (H,) with gaps filled by the previous value, at the start by the first one."""
    there = np.flatnonzero(np.isfinite(values))
    if not np.isfinite(values[now]):
        raise NoScenarios(f"no readings of the ambient within the last {AMBIENT_BRIDGE_H:.0f} h")
    place = np.maximum(np.searchsorted(there, np.arange(len(values)), side="right") - 1, 0)
    return values[there[place]]


def _physical(kelvin: np.ndarray, vapour: np.ndarray) -> dict[str, np.ndarray]:
    """The ambient of a member, limited to saturation."""
    return {
        "ambient_temperature": kelvin,
        "ambient_absolute_humidity": np.clip(vapour, DRIEST, absolute_humidity(MOISTEST, kelvin)),
    }


# -- operation -----------------------------------------------------------------------------------------------
def values_at(series: Series, time: np.ndarray) -> np.ndarray:
    """Values of a series at other times [s]; NaN outside the series and in gaps that the filter would not
    bridge."""
    return at_times(series, time, bridge_h(series, AMBIENT_BRIDGE_H))


def values_held(series: Series, time: np.ndarray) -> np.ndarray:
    """As `values_at`, with the last reading held for as long as a gap is bridged."""
    known = series.time[~series.missing]
    if not len(known):
        return np.full(len(time), np.nan)
    stale = time > known[-1] + HOUR_S * bridge_h(series, AMBIENT_BRIDGE_H)
    return np.where(stale, np.nan, values_at(series, np.minimum(time, known[-1])))


def possible_operation(
    history: Record, now_s: float, time: np.ndarray, days: Sequence[Courses], count: int
) -> tuple[list[Courses], Statement]:
    """`count` courses that cycle through the days, with an operation that may follow the present one; and
    what this is based on.

    `days`: non-ambient signals of earlier days at the scenarios' instants `time` (H,) [s].
    """
    given = [days[i % len(days)] if days else {} for i in range(count)]
    names = [name for name in OPERATION if name in history and not history[name].missing.all()]
    past = {name: values_held(history[name], time) for name in names}
    known = [one for one in days if np.isfinite(one.get("active_power", np.nan)).all()]
    level = _level(past["active_power"], time, now_s) if "active_power" in past else np.nan
    # as now: without pre-heating
    steady = {n: 0.0 if n in SWITCHED else _present(history[n], now_s) for n in names}
    if np.isnan(level) and len(known) < LEAST:
        names = [name for name in names if name != "active_power"]
        past = {n: past[n] if n != "preheating" else np.zeros(len(time)) for n in names}
        given = [{n: v for n, v in one.items() if n not in SWITCHED} for one in given]
        coming = [{n: one.get(n, np.full(len(time), steady[n])) for n in names} for one in given]
        basis = BasisCode.OPERATION_UNKNOWN()
    elif np.isnan(level):
        coming, basis = _as_on(known, given, names), BasisCode.PRESENT_POWER_UNKNOWN()
    elif level <= 0.0:
        coming, basis = _standing_still(history, now_s, time, given, steady)
    else:
        alike = [one for one in known if _level(one["active_power"], time, now_s) > 0.0]
        coming, basis = _running(alike, given, {**steady, "active_power": level}, time, now_s)
    before = time <= now_s
    found = []
    for one, ahead in zip(given, coming, strict=True):
        whole = {n: np.where(np.isnan(v), steady[n], v) for n, v in ahead.items()}
        joined = {n: np.where(before & np.isfinite(v), v, whole[n]) for n, v in past.items()}
        found.append({**one, **joined})
    return found, basis


def _present(series: Series, now_s: float) -> float:
    """Mean of an actuator over the last `PRESENT_S`; 0 if all of it is unknown."""
    values = values_held(series, now_s - np.arange(0.0, PRESENT_S, 60.0))
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else 0.0


def _as_on(chosen: Sequence[Courses], given: Sequence[Courses], names: Sequence[str]) -> list[Courses]:
    """The operation of each given day if that day is chosen, else that of the chosen days in turn."""
    own = {id(one) for one in chosen}
    sources = [one if id(one) in own else chosen[i % len(chosen)] for i, one in enumerate(given)]
    return [{name: one[name] for name in names} for one in sources]


def _running(
    alike: Sequence[Courses],
    given: Sequence[Courses],
    steady: Mapping[str, float],
    time: np.ndarray,
    now_s: float,
) -> tuple[list[Courses], Statement]:
    """Operation that may follow while the turbine runs: that of days that began alike, adjusted to the
    present power, or the operation as now (`steady`)."""
    if len(alike) < LEAST:
        same = {n: np.full(len(time), v) for n, v in steady.items()}
        return [same] * len(given), BasisCode.OPERATION_AS_NOW()
    found = _as_on(alike, given, tuple(steady))
    for one in found:
        one["active_power"] = _shift_power(one["active_power"], steady["active_power"], time, now_s)
    return found, BasisCode.OPERATION_OF_ALIKE_DAYS()


def _standing_still(
    history: Record, now_s: float, time: np.ndarray, given: Sequence[Courses], steady: Mapping[str, float]
) -> tuple[list[Courses], Statement]:
    """Operation that may follow a standstill: that after each earlier standstill of the same length, or an
    unprecedented one.

    Each of these is equally likely.  Of an unprecedented standstill only its age a is known: it lasts for
    another h with probability a/(a + h), with actuators as now (`steady`), and then the operation is that of
    the given day.
    """
    age_s, moments = _standstills(history, now_s)
    others = [{name: values_at(history[name], time - now_s + then) for name in steady} for then in moments]
    others = [one for one in others if np.isfinite(one["active_power"]).all()]
    turn = len(others) + 1
    unlike = math.ceil(len(given) / turn)
    found = []
    for i, one in enumerate(given):
        if i % turn:
            found.append(others[i % turn - 1])
            continue
        share = (i // turn + 0.5) / unlike
        still = time <= now_s + age_s * (1.0 / share - 1.0)
        found.append({n: np.where(still, value, one.get(n, value)) for n, value in steady.items()})
    return found, BasisCode.STANDSTILL_MAY_END(count=len(others))


def _standstills(history: Record, now_s: float) -> tuple[float, list[float]]:
    """How long [s] the turbine has stood still, and the times [s] at which earlier standstills had lasted as
    long."""
    time = now_s - STEP_S * np.arange(DAYS * DAY_S / STEP_S)[::-1]
    power = values_held(history["active_power"], time)
    still = power <= 0.0
    began = np.flatnonzero(still[1:] & (power[:-1] > 0.0)) + 1
    last = int(np.flatnonzero(~still).max(initial=-1)) + 1
    age = max(len(still) - 1 - last, 0)
    lasted = [b + age for b in began if b + age < len(still) and still[b : b + age + 1].all()]
    return STEP_S * max(age, 1), [float(time[m]) for m in lasted if time[m] + HORIZON_S <= now_s]


def _level(power: np.ndarray, time: np.ndarray, now_s: float) -> float:
    """Mean power [W] of the last hour; 0 at standstill now, NaN if the present power is unknown."""
    hour = power[(time > now_s - 3601.0) & (time <= now_s)]
    return 0.0 if hour[-1] <= 0.0 else float(np.mean(np.maximum(hour, 0.0)))


def _shift_power(power: np.ndarray, level: float, time: np.ndarray, now_s: float) -> np.ndarray:
    """Another day's power, shifted to begin at today's level; its standstills are kept."""
    began = _level(power, time, now_s)
    fading = np.exp(-np.maximum(time - now_s, 0.0) / (HOUR_S * LEVEL_H))
    # a running turbine keeps running, with at least a hundredth of its power on that day
    moved = np.clip(power + fading * (level - began), 0.01 * power, max(level, float(power.max())))
    return np.where((time > now_s) & (power > 0.0), moved, power)
