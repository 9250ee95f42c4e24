"""Conditions on which errors may depend: episodes, regimes, hours, season, level, rate and lag of drivers,
dates.

A condition is a basis that is tested, and bins in which its worst part is described.  All are made from
inputs and from the simulation, never from the readings that are judged.  Shapes: n bins of an hour, k
columns, m bins of a condition.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.discovery.residuals import Residuals, displayed, run_lengths, words
from hygrokf.texts.discovery_codes import ConditionCode
from hygrokf.texts.statement import Statement

CONDITION_LAGS_H = (1.0, 2.0, 3.0, 4.0, 6.0, 9.0, 12.0, 18.0, 24.0)
LAG_TOLERANCE = 0.1
"""[1] share of a lag by which the bins may miss it."""
RATE_H = 3.0
"""[h] over which a rate is taken: shorter ones are noise of the readings."""
STANDSTILL_H = 6.0
LONG_STANDSTILL_H = 24.0
LONG_STOPS = ConditionCode.STOPS_LONGER_THAN_A_DAY()
AFTERWARDS_H = 6.0
"""[h] after an episode that count as its end."""
SATURATED_AIR = 0.97
"""[1] relative humidity from which air counts as saturated: a sensor reads no more, within its accuracy."""
SINCE_H = (3.0, 6.0, 12.0, 24.0)
LEVEL_QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)
RATE_QUANTILES = (0.1, 0.3, 0.7, 0.9)
RESTING = 0.15
"""[1] share of the time at its least value from which a driver counts as resting there (night, calm, dry)."""
MONTH_H = 240.0
"""[h] of a month within the record from which it counts."""
SECTORS = 12
SHORTEST_CONDITION_H = 6.0
"""[h] shortest time for which a condition must hold to be tested."""
LARGEST_PART = 0.5
"""[1] largest share of the hours that a finding may hold for: beyond it, the rest is the exception."""
GROUPS = {
    "regime": "episodes", "episode": "episodes", "since": "episodes", "saturation": "episodes",
    "hour": "hour",
    "season": "calendar", "drift": "calendar", "step": "calendar",
    "level": "drivers", "rate": "drivers", "lag": "drivers",
}  # fmt: skip
"""Kind -> group; each group may make an equal share of the false discoveries."""

Phrase = Callable[[int, int], Statement]


@dataclass(frozen=True)
class Stratum:
    """A condition on which errors may depend.

    kind: one of `GROUPS`.  driver: the signal, or "".  basis: (n, k), NaN = unknown.
    bins: (n,) number of the bin 0 … m − 1, −1 = none.
    phrase: first and last bin -> the condition.  flag: bin 0 is the condition, bin 1 the rest.
    circular: the bins close a circle.
    """

    kind: str
    driver: str
    basis: np.ndarray
    bins: np.ndarray
    phrase: Phrase
    flag: bool = False
    circular: bool = False

    @property
    def group(self) -> str:
        """Group with which it shares the false discoveries."""
        return GROUPS[self.kind]

    @property
    def flow(self) -> bool:
        """Whether a flow under the condition leaves a course of its own, unlike that of a lag or a wave."""
        return self.group in ("episodes", "drivers") and self.kind != "lag"

    def worst(self, effect: np.ndarray) -> tuple[int, int]:
        """First and last bin of the stretch of bins whose effect (n,), NaN = unknown, differs most from the
        rest."""
        if self.flag:
            return 0, 0
        there = np.isfinite(effect) & (self.bins >= 0)
        count = int(self.bins.max()) + 1
        number = np.bincount(self.bins[there], minlength=count).astype(float)
        total = np.bincount(self.bins[there], weights=effect[there], minlength=count)
        all_n, all_e = number.sum(), total.sum()
        best, chosen = 0.0, (0, 0)
        for first in range(count):
            for length in range(1, count if self.circular else count - first + 1):
                place = np.arange(first, first + length) % count
                n, e = number[place].sum(), total[place].sum()
                if not 0 < n <= LARGEST_PART * all_n:
                    continue
                gain = (e / n - (all_e - e) / (all_n - n)) ** 2 * n * (all_n - n)
                if gain > best * (1.0 + 1e-9):
                    best, chosen = gain, (first, first + length - 1)
        return chosen

    def inside(self, first: int, last: int) -> np.ndarray:
        """(n,) whether a bin of the stretch holds."""
        count = int(self.bins.max()) + 1
        return np.isin(self.bins, np.arange(first, last + 1) % count)


def conditions(hours: Residuals) -> list[Stratum]:
    """All conditions that a record can show: those that hold for at least six hours."""
    made = [*_regimes(hours), *_preheating(hours), _hour(hours), *_calendar(hours)]
    humidity = hours.drivers.get("cabinet_relative_humidity")
    if humidity is not None:
        saturated = np.nan_to_num(humidity) >= SATURATED_AIR
        made.append(_flag("saturation", saturated, ConditionCode.SATURATED_AIR(share=SATURATED_AIR)))
    for name, value in hours.drivers.items():
        if name != "preheating":
            made += _driver(hours, name, value)
    return [one for one in made if not one.flag or _held(one, hours.step_h)]


def _held(one: Stratum, step_h: float) -> bool:
    inside = float((one.bins == 0).sum()) * step_h
    return SHORTEST_CONDITION_H <= inside <= len(one.bins) * step_h - SHORTEST_CONDITION_H


def _flag(kind: str, flag: np.ndarray, condition: Statement, share: np.ndarray | None = None) -> Stratum:
    """A condition that holds or not; share: (n,) of each bin for which it holds, where that is known."""
    column = flag.astype(float) if share is None else share
    return Stratum(kind, "", column[:, None], np.where(flag, 0, 1), lambda a, b: condition, flag=True)


def dummies(bins: np.ndarray) -> np.ndarray:
    """Columns (n, m − 1) that are 1 in one bin each; NaN where there is no bin."""
    labels = np.unique(bins[bins >= 0])
    table = (bins[:, None] == labels[None, 1:]).astype(float)
    table[bins < 0] = np.nan
    return table


# --- episodes --------------------------------------------------------------------------------


def _filled(spans: Iterable[tuple[int, int]], count: int) -> np.ndarray:
    flag = np.zeros(count, dtype=bool)
    for first, last in spans:
        flag[max(first, 0) : last] = True
    return flag


def _regimes(hours: Residuals) -> list[Stratum]:
    """Standstill, its longer episodes, the hours after starts, hours since the last change."""
    count, step, running = len(hours.time_h), hours.step_h, hours.operating
    if running.all() or not running.any():
        return []
    made = [_flag("regime", ~running, ConditionCode.STANDING())]
    stops = run_lengths(~running)
    after = round(AFTERWARDS_H / step)
    longer = ConditionCode.STOPS_LONGER_THAN(hours=STANDSTILL_H)
    for least, long in ((STANDSTILL_H, longer), (LONG_STANDSTILL_H, LONG_STOPS)):
        chosen = [(a, b) for a, b in stops if step * (b - a) >= least]
        if not chosen:
            continue
        made.append(_flag("episode", _filled(chosen, count), ConditionCode.IN_STOPS(stops=long)))
        started = _filled([(b, b + after) for _, b in chosen], count) & running
        after_stops = ConditionCode.STARTED_AFTER_STOPS(stops=long, hours=AFTERWARDS_H)
        made.append(_flag("episode", started, after_stops))
    edges = (0.0, *SINCE_H, math.inf)
    for flag, within, beyond in (
        (~running, ConditionCode.SINCE_STOP, ConditionCode.LONG_SINCE_STOP),
        (running, ConditionCode.SINCE_START, ConditionCode.LONG_SINCE_START),
    ):
        since = np.full(count, np.nan)
        for first, last in run_lengths(flag):
            since[first:last] = step * np.arange(last - first)
        bins = np.where(flag, np.digitize(since, SINCE_H), -1)

        def phrase(
            a: int, b: int, within: ConditionCode = within, beyond: ConditionCode = beyond
        ) -> Statement:
            if b == len(SINCE_H):
                return beyond(first=edges[a])
            return within(first=edges[a], last=edges[b + 1])

        basis = (bins[:, None] == np.arange(len(SINCE_H) + 1)).astype(float)
        made.append(Stratum("since", "", basis, bins, phrase))
    return made


def _preheating(hours: Residuals) -> list[Stratum]:
    """Pre-heating, after long standstills and after any, and the hours after it."""
    count, step = len(hours.time_h), hours.step_h
    heating = hours.preheating > 0.5
    heated = run_lengths(heating)
    if not heated:
        return []
    stops = run_lengths(~hours.operating)
    near = round(AFTERWARDS_H / step)
    stood = [
        max((step * (b - a) for a, b in stops if a <= first < b + near), default=0.0) for first, _ in heated
    ]
    long = [span for span, length in zip(heated, stood, strict=True) if length >= LONG_STANDSTILL_H]
    stood_long = ConditionCode.PREHEATED_AFTER_STOPS(stops=LONG_STOPS)
    every = stood_long if len(long) == len(heated) else ConditionCode.PREHEATING()
    made = [_flag("episode", heating, every, hours.preheating)]
    if 0 < len(long) < len(heated):
        around = _filled([(a - 1, b + 1) for a, b in long], count)
        share = np.where(around, hours.preheating, 0.0)
        made.append(_flag("episode", _filled(long, count), stood_long, share))
    after = _filled([(last, last + near) for _, last in heated], count) & ~heating
    made.append(_flag("episode", after, ConditionCode.PREHEATED(hours=AFTERWARDS_H)))
    return made


# --- clock and calendar ----------------------------------------------------------------------


def _hour(hours: Residuals) -> Stratum:
    hour = hours.time_s / 3600.0 % 24.0
    angle = 2.0 * math.pi * hour / 24.0
    basis = np.column_stack([wave(k * angle) for k in (1, 2, 3) for wave in (np.cos, np.sin)])
    bins = np.floor(hour).astype(int)

    def hours_of(a: int, b: int) -> Statement:
        return ConditionCode.HOURS_OF_THE_DAY(first=a % 24, last=(b + 1) % 24)

    return Stratum("hour", "", basis, bins, hours_of, circular=True)


def _calendar(hours: Residuals) -> list[Stratum]:
    """Months and a straight drift."""
    count, step = len(hours.time_h), hours.step_h
    month = hours.time_s.astype("datetime64[s]").astype("datetime64[M]").astype(int)
    bins = month - month[0]
    names = [f"{np.datetime64(int(one), 'M').item():%B %Y}" for one in range(month[0], month[-1] + 1)]

    def months(a: int, b: int) -> Statement:
        if a == b:
            return ConditionCode.MONTH(month=names[a])
        return ConditionCode.MONTHS(first=names[a], last=names[b])

    made = []
    if (np.bincount(bins) * step >= MONTH_H).sum() >= 3:
        made.append(Stratum("season", "", dummies(bins), bins, months))
    third = np.minimum(3 * np.arange(count) // count, 2)
    trend = np.linspace(-1.0, 1.0, count)[:, None]
    made.append(Stratum("drift", "", trend, third, lambda a, b: THIRDS[a, b]()))
    return made


THIRDS = {
    (0, 0): ConditionCode.FIRST_THIRD, (1, 1): ConditionCode.MIDDLE_THIRD, (2, 2): ConditionCode.LAST_THIRD,
    (0, 1): ConditionCode.FIRST_TWO_THIRDS, (1, 2): ConditionCode.LAST_TWO_THIRDS,
}  # fmt: skip
"""First and last third of a stretch -> its code."""


def step_at(hours: Residuals, first: int, sharp: bool) -> Stratum:
    """What lasts from a bin on, against before; sharp: its date is sure to the hour."""
    date = hours.time_s[first] - 1800.0 * hours.step_h
    code = ConditionCode.SINCE_DATE if sharp else ConditionCode.SINCE_ABOUT_DATE
    return _flag("step", np.arange(len(hours.time_h)) >= first, code(date=float(date)))


# --- drivers ---------------------------------------------------------------------------------


def _driver(hours: Residuals, name: str, value: np.ndarray) -> list[Stratum]:
    """Level (straight, and any curve), rate (rising and falling apart) and lag of one driver."""
    if name.endswith("_direction"):
        return [_direction(name, value)]
    level = _binned("level", name, value, LEVEL_QUANTILES, ConditionCode.LEVEL_OF_DRIVER)
    if level is None:
        return []
    made = [level]
    if level.bins.max() > 1:
        made.append(replace(level, basis=np.column_stack([level.basis, dummies(level.bins)[:, 1:]])))
    count, reach = len(value), max(1, round(RATE_H / hours.step_h))
    rate = np.full(count, np.nan)
    rate[reach:] = (value[reach:] - value[:-reach]) / (reach * hours.step_h)
    changing = _binned("rate", name, rate, RATE_QUANTILES, ConditionCode.RATE_OF_DRIVER)
    if changing is not None:
        made.append(replace(changing, basis=np.column_stack([np.maximum(rate, 0.0), np.minimum(rate, 0.0)])))
    for lag in CONDITION_LAGS_H:
        shift = round(lag / hours.step_h)
        if not 1 <= shift < count or abs(shift * hours.step_h - lag) > LAG_TOLERANCE * lag:
            continue
        before = np.full(count, np.nan)
        before[shift:] = value[:-shift]
        one = _binned("lag", name, before, LEVEL_QUANTILES, ConditionCode.EARLIER_DRIVER, hours=lag)
        if one is not None:
            made.append(one)
    return made


def _direction(name: str, value: np.ndarray) -> Stratum:
    basis = np.column_stack([wave(k * value) for k in (1, 2) for wave in (np.cos, np.sin)])
    degrees = np.degrees(value)
    width = 360.0 / SECTORS
    bins = np.where(np.isfinite(value), np.nan_to_num(degrees // width).astype(int) % SECTORS, -1)

    def phrase(a: int, b: int) -> Statement:
        lower, upper = width * (a % SECTORS), width * (b % SECTORS + 1)
        return ConditionCode.DIRECTION_OF_DRIVER(driver=words(name), lower=lower, upper=upper)

    return Stratum("level", name, basis, bins, phrase, circular=True)


def _binned(
    kind: str,
    name: str,
    value: np.ndarray,
    quantiles: tuple[float, ...],
    code: ConditionCode,
    **values: float,
) -> Stratum | None:
    """A condition by bins between quantiles of a value; its basis is the standardised value itself."""
    known = value[np.isfinite(value)]
    if len(known) < 48 or not known.std() > 1e-9 * max(1.0, float(np.abs(known).max())):
        return None
    rate = kind == "rate"
    edges = _edges(known, quantiles, rate)
    if len(edges) == 0:
        return None
    bins = np.where(np.isfinite(value), np.digitize(value, edges), -1)
    marks, unit = displayed(name, edges, rate)
    unit = f"{unit}/h" if rate else unit

    def phrase(a: int, b: int) -> Statement:
        lower = {} if a == 0 else {"lower": float(marks[a - 1])}
        upper = {} if b == len(edges) else {"upper": float(marks[b])}
        between = ConditionCode.DRIVER_BETWEEN if lower and upper else ConditionCode.DRIVER_ABOVE
        within = between if lower else ConditionCode.DRIVER_BELOW
        return code(driver=words(name), range=within(**lower, **upper, unit=unit), **values)

    scaled = (value - known.mean()) / known.std()
    return Stratum(kind, name, scaled[:, None], bins, phrase)


def _edges(known: np.ndarray, quantiles: tuple[float, ...], rate: bool) -> np.ndarray:
    least = float(known.min())
    small = 1e-6 * float(known.std())
    resting = not rate and float(np.mean(known <= least + small)) > RESTING
    if not resting:
        edges = np.unique(np.quantile(known, quantiles))
        return edges[(edges > least) & (edges < known.max())]
    above = known[known > least + small]
    return np.unique(
        np.concatenate([[0.5 * (least + float(above.min()))], np.quantile(above, quantiles[1:])])
    )
