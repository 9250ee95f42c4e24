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
"""[1] largest relative difference between a lag and the nearest multiple of the bins' length."""
RATE_H = 3.0
"""[h] interval over which a rate of change is computed; over shorter ones it is noise of the readings."""
STANDSTILL_H = 6.0
LONG_STANDSTILL_H = 24.0
LONG_STOPS = ConditionCode.STOPS_LONGER_THAN_A_DAY()
AFTERWARDS_H = 6.0
"""[h] time after an episode that counts as "after the episode"."""
SATURATED_AIR = 0.97
"""[1] relative humidity from which air counts as saturated; within its accuracy, a sensor shows no more."""
SINCE_H = (3.0, 6.0, 12.0, 24.0)
LEVEL_QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)
RATE_QUANTILES = (0.1, 0.3, 0.7, 0.9)
RESTING = 0.15
"""[1] share of the time at its lowest value from which a driver has a bin of its own for it (night, calm,
dry)."""
MONTH_H = 240.0
"""[h] shortest part of a month within the record for which the month counts."""
SECTORS = 12
SHORTEST_CONDITION_H = 6.0
"""[h] shortest time for which a condition must hold to be tested."""
LARGEST_PART = 0.5
"""[1] largest share of the hours that a finding may cover; beyond it, the rest would be the exception."""
GROUPS = {
    "regime": "episodes", "episode": "episodes", "since": "episodes", "saturation": "episodes",
    "hour": "hour",
    "season": "calendar", "drift": "calendar", "step": "calendar",
    "level": "drivers", "rate": "drivers", "lag": "drivers",
}  # fmt: skip
"""Kind of a condition -> its group; every group gets an equal share of the allowed false discoveries."""

Phrase = Callable[[int, int], Statement]


@dataclass(frozen=True)
class Stratum:
    """A condition on which errors may depend, such as "in stops" or "wind speed above 8 m/s".

    kind: one of `GROUPS`.  driver: the signal that the condition is about, or "".
    basis: (n, k) columns that are tested against the errors; NaN = unknown.
    bins: (n,) bin number 0 … m − 1 of each instant; −1 = none.
    phrase: makes the statement of the condition from its first and last bin.
    flag: whether the condition is yes or no; bin 0 is then yes and bin 1 no.
    circular: whether the last bin is followed by the first, as for hours of the day.
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
        """Group of conditions that share one part of the allowed false discoveries."""
        return GROUPS[self.kind]

    @property
    def flow(self) -> bool:
        """Whether a heat or vapour flow under this condition would have a distinct effect on the air, unlike
        a time lag or a wave."""
        return self.group in ("episodes", "drivers") and self.kind != "lag"

    def worst(self, effect: np.ndarray) -> tuple[int, int]:
        """Return the first and last bin of the contiguous bins whose mean effect differs most from the rest.

        effect: (n,) explained error; NaN = unknown.  The bins hold at most `LARGEST_PART` of the readings.
        """
        if self.flag:
            return 0, 0
        usable = np.isfinite(effect) & (self.bins >= 0)
        count = int(self.bins.max()) + 1
        bins_count = np.bincount(self.bins[usable], minlength=count).astype(float)
        effect_sum = np.bincount(self.bins[usable], weights=effect[usable], minlength=count)
        overall_count, overall_effect = bins_count.sum(), effect_sum.sum()
        best, worst_stretch = 0.0, (0, 0)
        for first in range(count):
            for length in range(1, count if self.circular else count - first + 1):
                stretch = np.arange(first, first + length) % count
                inside_count, inside_effect = bins_count[stretch].sum(), effect_sum[stretch].sum()
                if not 0 < inside_count <= LARGEST_PART * overall_count:
                    continue
                rest_count, rest_effect = overall_count - inside_count, overall_effect - inside_effect
                difference = inside_effect / inside_count - rest_effect / rest_count
                gain = difference**2 * inside_count * rest_count
                if gain > best * (1.0 + 1e-9):
                    best, worst_stretch = gain, (first, first + length - 1)
        return worst_stretch

    def inside(self, first: int, last: int) -> np.ndarray:
        """Return (n,) whether each instant lies in the bins from `first` to `last`."""
        count = int(self.bins.max()) + 1
        return np.isin(self.bins, np.arange(first, last + 1) % count)


def conditions(hours: Residuals) -> list[Stratum]:
    """Return all conditions to test on a record; yes-or-no conditions must hold, and fail, for at least six
    hours."""
    strata = [*_regimes(hours), *_preheating(hours), _hour(hours), *_calendar(hours)]
    humidity = hours.drivers.get("cabinet_relative_humidity")
    if humidity is not None:
        saturated = np.nan_to_num(humidity) >= SATURATED_AIR
        strata.append(_flag("saturation", saturated, ConditionCode.SATURATED_AIR(share=SATURATED_AIR)))
    for name, value in hours.drivers.items():
        if name != "preheating":
            strata += _driver(hours, name, value)
    return [stratum for stratum in strata if not stratum.flag or _held(stratum, hours.step_h)]


def _held(stratum: Stratum, step_h: float) -> bool:
    """Whether a yes-or-no condition holds, and fails, for at least `SHORTEST_CONDITION_H`."""
    hours_inside = float((stratum.bins == 0).sum()) * step_h
    return SHORTEST_CONDITION_H <= hours_inside <= len(stratum.bins) * step_h - SHORTEST_CONDITION_H


def _flag(kind: str, flag: np.ndarray, condition: Statement, share: np.ndarray | None = None) -> Stratum:
    """Return a yes-or-no condition.

    flag: (n,) where it holds.  share: (n,) share of each bin for which it holds, where that is known.
    """
    column = flag.astype(float) if share is None else share
    return Stratum(kind, "", column[:, None], np.where(flag, 0, 1), lambda a, b: condition, flag=True)


def dummies(bins: np.ndarray) -> np.ndarray:
    """Return indicator columns (n, m − 1), one for each bin except the first; NaN where an instant has no
    bin."""
    labels = np.unique(bins[bins >= 0])
    table = (bins[:, None] == labels[None, 1:]).astype(float)
    table[bins < 0] = np.nan
    return table


# --- episodes --------------------------------------------------------------------------------


def _filled(spans: Iterable[tuple[int, int]], count: int) -> np.ndarray:
    """Return flags (count,) that are True inside the spans [first, last)."""
    flag = np.zeros(count, dtype=bool)
    for first, last in spans:
        flag[max(first, 0) : last] = True
    return flag


def _regimes(hours: Residuals) -> list[Stratum]:
    """Return the conditions about operation and standstill.

    They are: standstill, long stops, the hours after long stops, and the hours since the last start or stop.
    """
    count, step, running = len(hours.time_h), hours.step_h, hours.operating
    if running.all() or not running.any():
        return []
    strata = [_flag("regime", ~running, ConditionCode.STANDING())]
    stops = run_lengths(~running)
    bins_after = round(AFTERWARDS_H / step)
    longer = ConditionCode.STOPS_LONGER_THAN(hours=STANDSTILL_H)
    for least, long in ((STANDSTILL_H, longer), (LONG_STANDSTILL_H, LONG_STOPS)):
        long_stops = [(a, b) for a, b in stops if step * (b - a) >= least]
        if not long_stops:
            continue
        strata.append(_flag("episode", _filled(long_stops, count), ConditionCode.IN_STOPS(stops=long)))
        after_start = _filled([(b, b + bins_after) for _, b in long_stops], count) & running
        after_stops = ConditionCode.STARTED_AFTER_STOPS(stops=long, hours=AFTERWARDS_H)
        strata.append(_flag("episode", after_start, after_stops))
    edges = (0.0, *SINCE_H, math.inf)
    for flag, within, beyond in (
        (~running, ConditionCode.SINCE_STOP, ConditionCode.LONG_SINCE_STOP),
        (running, ConditionCode.SINCE_START, ConditionCode.LONG_SINCE_START),
    ):
        hours_since = np.full(count, np.nan)
        for first, last in run_lengths(flag):
            hours_since[first:last] = step * np.arange(last - first)
        bins = np.where(flag, np.digitize(hours_since, SINCE_H), -1)

        def phrase(
            a: int, b: int, within: ConditionCode = within, beyond: ConditionCode = beyond
        ) -> Statement:
            if b == len(SINCE_H):
                return beyond(first=edges[a])
            return within(first=edges[a], last=edges[b + 1])

        basis = (bins[:, None] == np.arange(len(SINCE_H) + 1)).astype(float)
        strata.append(Stratum("since", "", basis, bins, phrase))
    return strata


def _preheating(hours: Residuals) -> list[Stratum]:
    """Return the conditions about pre-heating: during it, during it after long stops, and in the hours after
    it."""
    count, step = len(hours.time_h), hours.step_h
    heating = hours.preheating > 0.5
    heating_spans = run_lengths(heating)
    if not heating_spans:
        return []
    stops = run_lengths(~hours.operating)
    bins_after = round(AFTERWARDS_H / step)
    hours_stood_before = [
        max((step * (b - a) for a, b in stops if a <= first < b + bins_after), default=0.0)
        for first, _ in heating_spans
    ]
    after_long_stop = [
        span
        for span, length in zip(heating_spans, hours_stood_before, strict=True)
        if length >= LONG_STANDSTILL_H
    ]
    stood_long = ConditionCode.PREHEATED_AFTER_STOPS(stops=LONG_STOPS)
    condition = stood_long if len(after_long_stop) == len(heating_spans) else ConditionCode.PREHEATING()
    strata = [_flag("episode", heating, condition, hours.preheating)]
    if 0 < len(after_long_stop) < len(heating_spans):
        around = _filled([(a - 1, b + 1) for a, b in after_long_stop], count)
        share = np.where(around, hours.preheating, 0.0)
        strata.append(_flag("episode", _filled(after_long_stop, count), stood_long, share))
    after_heating = _filled([(last, last + bins_after) for _, last in heating_spans], count) & ~heating
    strata.append(_flag("episode", after_heating, ConditionCode.PREHEATED(hours=AFTERWARDS_H)))
    return strata


# --- clock and calendar ----------------------------------------------------------------------


def _hour(hours: Residuals) -> Stratum:
    """Return the condition "hour of the day": three harmonics, described in 24 bins."""
    hour = hours.time_s / 3600.0 % 24.0
    angle = 2.0 * math.pi * hour / 24.0
    basis = np.column_stack([wave(k * angle) for k in (1, 2, 3) for wave in (np.cos, np.sin)])
    bins = np.floor(hour).astype(int)

    def hours_of(a: int, b: int) -> Statement:
        return ConditionCode.HOURS_OF_THE_DAY(first=a % 24, last=(b + 1) % 24)

    return Stratum("hour", "", basis, bins, hours_of, circular=True)


def _calendar(hours: Residuals) -> list[Stratum]:
    """Return the conditions about the date: the month (given three full months) and a linear drift."""
    count, step = len(hours.time_h), hours.step_h
    month = hours.time_s.astype("datetime64[s]").astype("datetime64[M]").astype(int)
    bins = month - month[0]
    month_names = [
        f"{np.datetime64(int(number), 'M').item():%B %Y}" for number in range(month[0], month[-1] + 1)
    ]

    def months(a: int, b: int) -> Statement:
        if a == b:
            return ConditionCode.MONTH(month=month_names[a])
        return ConditionCode.MONTHS(first=month_names[a], last=month_names[b])

    strata = []
    if (np.bincount(bins) * step >= MONTH_H).sum() >= 3:
        strata.append(Stratum("season", "", dummies(bins), bins, months))
    third_of_record = np.minimum(3 * np.arange(count) // count, 2)
    trend = np.linspace(-1.0, 1.0, count)[:, None]
    strata.append(Stratum("drift", "", trend, third_of_record, lambda a, b: THIRDS[a, b]()))
    return strata


THIRDS = {
    (0, 0): ConditionCode.FIRST_THIRD, (1, 1): ConditionCode.MIDDLE_THIRD, (2, 2): ConditionCode.LAST_THIRD,
    (0, 1): ConditionCode.FIRST_TWO_THIRDS, (1, 2): ConditionCode.LAST_TWO_THIRDS,
}  # fmt: skip
"""First and last third of the record -> code of that period."""


def step_at(hours: Residuals, first: int, sharp: bool) -> Stratum:
    """Return the condition "from this bin on".

    first: bin at which it begins.  sharp: whether the date is certain to the hour.
    """
    date = hours.time_s[first] - 1800.0 * hours.step_h
    code = ConditionCode.SINCE_DATE if sharp else ConditionCode.SINCE_ABOUT_DATE
    return _flag("step", np.arange(len(hours.time_h)) >= first, code(date=float(date)))


# --- drivers ---------------------------------------------------------------------------------


def _driver(hours: Residuals, name: str, value: np.ndarray) -> list[Stratum]:
    """Return the conditions about one driver (n,): its level, its rate of change, and its earlier values.

    The level is tested as a straight line and as a free curve; rising and falling rates are tested
    separately.
    """
    if name.endswith("_direction"):
        return [_direction(name, value)]
    level_stratum = _binned("level", name, value, LEVEL_QUANTILES, ConditionCode.LEVEL_OF_DRIVER)
    if level_stratum is None:
        return []
    strata = [level_stratum]
    if level_stratum.bins.max() > 1:
        strata.append(
            replace(
                level_stratum,
                basis=np.column_stack([level_stratum.basis, dummies(level_stratum.bins)[:, 1:]]),
            )
        )
    count, rate_steps = len(value), max(1, round(RATE_H / hours.step_h))
    rate = np.full(count, np.nan)
    rate[rate_steps:] = (value[rate_steps:] - value[:-rate_steps]) / (rate_steps * hours.step_h)
    rate_stratum = _binned("rate", name, rate, RATE_QUANTILES, ConditionCode.RATE_OF_DRIVER)
    if rate_stratum is not None:
        strata.append(
            replace(rate_stratum, basis=np.column_stack([np.maximum(rate, 0.0), np.minimum(rate, 0.0)]))
        )
    for lag in CONDITION_LAGS_H:
        lag_steps = round(lag / hours.step_h)
        if not 1 <= lag_steps < count or abs(lag_steps * hours.step_h - lag) > LAG_TOLERANCE * lag:
            continue
        earlier_value = np.full(count, np.nan)
        earlier_value[lag_steps:] = value[:-lag_steps]
        lag_stratum = _binned(
            "lag", name, earlier_value, LEVEL_QUANTILES, ConditionCode.EARLIER_DRIVER, hours=lag
        )
        if lag_stratum is not None:
            strata.append(lag_stratum)
    return strata


def _direction(name: str, value: np.ndarray) -> Stratum:
    """Return the condition "direction of the wind": two harmonics of the angle [rad], described in 12
    sectors."""
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
    """Return a condition about the level of a value (n,), in bins between its quantiles; None if it hardly
    varies.

    quantiles: of the bin edges.  code: makes the statement, with the further `values`.  The tested basis is
        the standardised value itself.
    """
    finite = value[np.isfinite(value)]
    if len(finite) < 48 or not finite.std() > 1e-9 * max(1.0, float(np.abs(finite).max())):
        return None
    rate = kind == "rate"
    edges = _edges(finite, quantiles, rate)
    if len(edges) == 0:
        return None
    bins = np.where(np.isfinite(value), np.digitize(value, edges), -1)
    displayed_edges, unit = displayed(name, edges, rate)
    unit = f"{unit}/h" if rate else unit

    def phrase(a: int, b: int) -> Statement:
        lower = {} if a == 0 else {"lower": float(displayed_edges[a - 1])}
        upper = {} if b == len(edges) else {"upper": float(displayed_edges[b])}
        between = ConditionCode.DRIVER_BETWEEN if lower and upper else ConditionCode.DRIVER_ABOVE
        within = between if lower else ConditionCode.DRIVER_BELOW
        return code(driver=words(name), range=within(**lower, **upper, unit=unit), **values)

    scaled = (value - finite.mean()) / finite.std()
    return Stratum(kind, name, scaled[:, None], bins, phrase)


def _edges(finite: np.ndarray, quantiles: tuple[float, ...], rate: bool) -> np.ndarray:
    """Return the edges between the bins of a driver.

    finite: its known values.  A driver that often rests at its lowest value (night, calm) gets a bin of its
        own for it.
    """
    lowest = float(finite.min())
    tolerance = 1e-6 * float(finite.std())
    resting = not rate and float(np.mean(finite <= lowest + tolerance)) > RESTING
    if not resting:
        edges = np.unique(np.quantile(finite, quantiles))
        return edges[(edges > lowest) & (edges < finite.max())]
    above_rest = finite[finite > lowest + tolerance]
    return np.unique(
        np.concatenate([[0.5 * (lowest + float(above_rest.min()))], np.quantile(above_rest, quantiles[1:])])
    )
