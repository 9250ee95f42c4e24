"""What weather and operation may come: members drawn from the turbine's own last weeks, or around a weather forecast.

Without a weather forecast the members are the last weeks' days: each gives how temperature and vapour departed from their
usual value at that hour, as far as that could not be told from its beginning.  Added to what today's beginning tells, that
is persistence with an honest spread.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.ambient import AMBIENT_BRIDGE_H, ambient_absolute_humidity, at_times, bridge_h
from hygrokf.data.input_paths import input_path
from hygrokf.data.record import Record, Series
from hygrokf.live.operation import (
    DAY_S,
    DAYS,
    HORIZON_S,
    LEAST,
    STEP_S,
    operation_ahead,
    values_at,
    values_held,
)
from hygrokf.physics.psychrometrics import absolute_humidity, relative_humidity

FINE_S = 600.0
"""[s] between the instants of an outlook that advises how long to pre-heat."""
BEFORE_S = 3 * 3600.0
"""[s] of what was before now, so that what looks back a little has something to look at."""
MEMBERS = 24
"""Courses that are drawn around a weather forecast."""
FORECAST_ERROR = {"temperature_K": 1.5, "vapour": 0.08}
"""Standard deviation of a weather forecast's errors a day ahead: [K], and of the logarithm of vapour concentration [1]."""
ERROR_H = 12.0
"""[h] time by which such errors lose their memory, and by which an error that is seen now fades."""
WEATHER_DAYS = 3.0
"""Days that a weather lasts: so many of the members' days count as one when their mean and spread are judged."""
DRIEST, MOISTEST = 1e-5, 1.0
"""[kg/m³] and [1]: least vapour concentration, and highest relative humidity of the ambient."""


class NoOutlook(Exception):
    """Why nothing is known of what may come, in words."""


@dataclass(frozen=True)
class Outlook:
    """Members: signal → values (H,) [SI units] at `time_s` (H,) [s]; the same signals in each.  `words` say what it is."""

    now_s: float
    time_s: np.ndarray
    members: tuple[Mapping[str, np.ndarray], ...]
    words: str

    def heated(self, hours: float) -> Outlook:
        """The first so many hours, at standstill with the pre-heating on from now on."""
        time = np.arange(self.time_s[0], self.now_s + 3600.0 * hours + 1.0, FINE_S)
        after = time > self.now_s + 1.0
        members = []
        for member in self.members:
            chosen = {name: np.interp(time, self.time_s, values) for name, values in member.items()}
            chosen["active_power"] = np.where(after, 0.0, chosen.get("active_power", 0.0))
            chosen["preheating"] = after.astype(float)
            members.append(chosen)
        return replace(self, time_s=time, members=tuple(members))


def grid(now_s: float) -> np.ndarray:
    """Instants [s] of an outlook."""
    return now_s + np.arange(-BEFORE_S, HORIZON_S + 1.0, STEP_S)


def persistence(history: Record, now_s: float, further: Sequence[str] = ()) -> Outlook:
    """An outlook from the ambient and the operation of the last weeks.

    `history`: readings of the last `DAYS` days if they are there, those after now are not looked at; `further` signals that the model reads besides.
    Raises NoOutlook with fewer than `LEAST` days.
    """
    time, history = grid(now_s), history.window(-np.inf, now_s)
    paths = _days(history, time, further)
    if len(paths) < LEAST:
        raise NoOutlook(
            f"persistence needs {LEAST} days of the ambient that are known in full, beginning two days ago or more; "
            f"there are {len(paths)}"
        )
    ambient = _ambients(history, now_s, time, [day for day, _ in paths])
    others, said = operation_ahead(history, now_s, time, [one for _, one in paths], len(paths))
    members = tuple({**weather, **other} for weather, other in zip(ambient, others, strict=True))
    return Outlook(
        now_s, time, members, f"persistence of the weather, drawn from {len(members)} days; {said}"
    )


def weather_forecast(
    history: Record,
    now_s: float,
    coming: Mapping[str, Series],
    further: Sequence[str] = (),
    error: Mapping[str, float] = FORECAST_ERROR,
    seed: int = 0,
) -> Outlook:
    """An outlook around a weather forecast.

    `coming`: series "temperature" [K] and "vapour" [kg/m³] of it; `error` their standard deviations a day ahead.  What it
    was off at the last reading fades within hours.  Raises NoOutlook where the forecast does not cover a day.
    """
    time, history = grid(now_s), history.window(-np.inf, now_s)
    absent = sorted({"temperature", "vapour"} - set(coming))
    if absent:
        raise NoOutlook(f"the weather forecast has no {' and no '.join(absent)}")
    base, spread = {}, {}
    for name, series in _ambient(history).items():
        joined, newest = _continued(series, input_path(coming[name]), now_s, log=name == "vapour")
        base[name] = at_times(joined, time, AMBIENT_BRIDGE_H)
        spread[name] = np.sqrt(1.0 - np.exp(-2.0 * np.maximum(time - newest, 0.0) / (3600.0 * ERROR_H)))
    now = int(np.searchsorted(time, now_s))
    unknown = np.flatnonzero(np.isnan(base["temperature"]) | np.isnan(base["vapour"]))
    if now in unknown:
        raise NoOutlook("neither the weather forecast nor readings of the ambient say what it is now")
    first, last = unknown[unknown < now].max(initial=-1) + 1, unknown[unknown > now].min(initial=len(time))
    if time[last - 1] < now_s + DAY_S:
        raise NoOutlook("the weather forecast ends within a day; send a newer one")
    kept = slice(first, last)
    random = np.random.default_rng(seed)
    members = []
    for _ in range(MEMBERS):
        drawn = {
            name: base[name] + error[key] * spread[name] * _wandering(random, len(time))
            for name, key in (("temperature", "temperature_K"), ("vapour", "vapour"))
        }
        members.append(_physical(drawn["temperature"][kept], np.exp(drawn["vapour"][kept])))
    days = [one for _, one in _days(history, time, further)]
    others, said = operation_ahead(history, now_s, time, days, MEMBERS)
    both = tuple(
        {**weather, **{name: values[kept] for name, values in other.items()}}
        for weather, other in zip(members, others, strict=True)
    )
    return Outlook(now_s, time[kept], both, f"a weather forecast; {said}")


def _continued(seen: Series, told: Series, now_s: float, log: bool) -> tuple[Series, float]:
    """Readings up to now and what is told from the newest of them on, of which logarithms; the time of the newest."""

    def scaled(values: np.ndarray) -> np.ndarray:
        return np.log(np.maximum(values, DRIEST)) if log else values

    past = ~seen.missing & (seen.time <= now_s)
    newest = float(seen.time[past][-1]) if past.any() else -np.inf
    later = told.time > newest
    off = scaled(seen.value[past][-1:]) - scaled(at_times(told, np.array([newest]), AMBIENT_BRIDGE_H))
    fading = np.exp(-(told.time[later] - newest) / (3600.0 * ERROR_H))
    value = scaled(told.value[later]) + np.nan_to_num(off).sum() * fading
    time = np.concatenate([seen.time[past], told.time[later]])
    return replace(seen, time=time, value=np.concatenate([scaled(seen.value[past]), value])), newest


def _wandering(random: np.random.Generator, count: int) -> np.ndarray:
    """An Ornstein-Uhlenbeck course (count,) of standard deviation 1."""
    keep = math.exp(-STEP_S / 3600.0 / ERROR_H)
    steps = random.standard_normal(count)
    course = np.empty(count)
    course[0] = steps[0]
    for i in range(1, count):
        course[i] = keep * course[i - 1] + math.sqrt(1.0 - keep**2) * steps[i]
    return course


def _ambient(history: Record) -> dict[str, Series]:
    vapour = ambient_absolute_humidity(history) if "ambient_temperature" in history else None
    if vapour is None:
        raise NoOutlook("no readings of the ambient's temperature and humidity")
    return {"temperature": input_path(history["ambient_temperature"]), "vapour": input_path(vapour)}


def _days(
    history: Record, time: np.ndarray, further: Sequence[str]
) -> list[tuple[int, dict[str, np.ndarray]]]:
    """(days ago, courses of all that is not the ambient) of days on which ambient and `further` signals are known in full."""
    absent = sorted(set(further) - set(history.signals))
    if absent:
        raise NoOutlook(f"the model reads {', '.join(absent)}, of which there are no readings")
    ambient = _ambient(history)
    others = {s.signal: s for s in history.series if _acts(s)}
    found = []
    for day in range(2, DAYS + 3):
        then = time - day * DAY_S
        if not all(np.isfinite(values_at(series, then)).all() for series in ambient.values()):
            continue
        chosen = {name: values_at(series, then) for name, series in others.items()}
        if not all(np.isfinite(chosen[name]).all() for name in further):
            continue
        # as the features have it: what is not known takes the mean; an unknown power is none to choose
        usual = {n: np.nanmean(s.value) for n, s in others.items() if n != "active_power"}
        usual |= {"active_power": np.nan, "preheating": 0.0}
        found.append((day, {n: np.where(np.isnan(v), usual[n], v) for n, v in chosen.items()}))
    return found


def _acts(series: Series) -> bool:
    """Whether a signal is a driver other than the ambient's temperature and humidity."""
    own = series.signal.startswith(("cabinet_", "ambient_")) and series.signal != "ambient_pressure"
    return not own and not series.missing.all()


def _ambients(
    history: Record, now_s: float, time: np.ndarray, days: Sequence[int]
) -> list[dict[str, np.ndarray]]:
    """The ambient as it may go on, a course for each of so many days ago.

    Of its humidity not the vapour is drawn but w with RH = exp(−w²): whatever is added to w, the air stays below saturation,
    and the nearer it is to it the less of a departure in w is left of it in the humidity, as in air that would condense.
    """
    ambient = _ambient(history)
    kelvin = _departures(ambient["temperature"], now_s, time, days)
    dryness = _departures(_humidity(ambient), now_s, time, days, scaled=_dryness)
    return [
        _physical(warm, absolute_humidity(np.exp(-(dry**2)), warm))
        for warm, dry in zip(kelvin, dryness, strict=True)
    ]


def _humidity(ambient: Mapping[str, Series]) -> Series:
    """Relative humidity [1] of the ambient at the times of its vapour's readings; what is above saturation is saturated."""
    vapour, warm = ambient["vapour"], ambient["temperature"]
    kelvin = at_times(warm, vapour.time, bridge_h(warm, AMBIENT_BRIDGE_H))
    value = np.minimum(relative_humidity(np.maximum(vapour.value, DRIEST), kelvin), MOISTEST)
    return replace(vapour, signal="ambient_relative_humidity", value=value)


def _dryness(humidity: np.ndarray) -> np.ndarray:
    """w ≥ 0 with RH = exp(−w²), of any shape."""
    return np.sqrt(-np.log(humidity))


def _departures(
    series: Series,
    now_s: float,
    time: np.ndarray,
    days: Sequence[int],
    scaled: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> list[np.ndarray]:
    """Courses of one signal, `scaled`: the readings up to now; then what is usual at the hour, what today's departure from
    it tells, and what each day's beginning did not tell of its own."""
    hours = np.arange(0.0, DAY_S, STEP_S)
    past = scaled(values_at(series, now_s - DAY_S + hours[:, None] - DAY_S * np.arange(0, DAYS + 3)))
    there = np.isfinite(past)
    usual = np.where(there, past, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
    phase = np.mod(time - now_s, DAY_S) / STEP_S
    expected = usual[np.round(phase).astype(int) % len(hours)]
    departed = (past - usual[:, None]).T[::-1].reshape(-1)  # by time, oldest first
    first, later = departed[: -len(hours)], departed[len(hours) :]
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
    """Values (H,) with those before held where there are none; at the beginning the first one."""
    there = np.flatnonzero(np.isfinite(values))
    if not np.isfinite(values[now]):
        raise NoOutlook(f"no readings of the ambient within the last {AMBIENT_BRIDGE_H:.0f} h")
    place = np.maximum(np.searchsorted(there, np.arange(len(values)), side="right") - 1, 0)
    return values[there[place]]


def _physical(kelvin: np.ndarray, vapour: np.ndarray) -> dict[str, np.ndarray]:
    """The ambient of a member, no moister than saturated."""
    return {
        "ambient_temperature": kelvin,
        "ambient_absolute_humidity": np.clip(vapour, DRIEST, absolute_humidity(MOISTEST, kelvin)),
    }
