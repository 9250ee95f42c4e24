"""Compare two weather series of the same signal: lag, offset and daily wave, with bounds.

Clocks that differ shift the weather and the mean day alike, so the lag is estimated from each:

- weather: both series less the running mean of a day and the mean day of each month; the lag at which the
  rest correlates best.  Fronts, clouds and showers determine it; a sensor in the sun does not change it.
- mean day: the phase between the daily waves of the two series.  A sensor in the sun or in a slow housing
  shifts it by half an hour; a front that reaches one place before the other does not.

Bounds are quantiles of a bootstrap over blocks of five days, which keeps the correlation within a weather
situation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hygrokf.data.ambient import at_times, bridge_h
from hygrokf.data.input_paths import centred
from hygrokf.data.record import Series
from hygrokf.data.timestamps import DAY_S, summer_time

GRID_S = 600.0
"""[s] grid on which both series are compared; a parabola gives lags between its points."""
REACH_H = 14.0
"""[h] largest lag searched: the widest difference between two time zones in use."""
BRIDGE_H = 3.0
BLOCK_D = 5.0
FEWEST_D = 20.0
"""[d] fewest common days for a comparison."""
DRAWS = 400
LEAST_CORRELATION = 0.25
"""Highest correlation below which the two series are not of the same weather and have no lag."""
WIDEST_H = 3.0
"""[h] width of a lag's bounds above which the lag counts as unknown."""


@dataclass(frozen=True)
class Bounded:
    """An estimate with 95 % bounds; NaN where it is unknown."""

    value: float
    low: float
    high: float

    @property
    def known(self) -> bool:
        return math.isfinite(self.value)


UNKNOWN = Bounded(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Lag:
    """How much later one series is than the other, over a part of the time.

    weather, mean_day: [s] the two estimates; positive where the first series is late. days: [d] in common.
    correlation: highest correlation of the series without their mean day.
    """

    weather: Bounded
    mean_day: Bounded
    days: float
    correlation: float


@dataclass(frozen=True)
class Alignment:
    """Comparison of one series with another of the same signal.

    signal: of both. one, other: their files. start_s, end_s: [s] common span. days: [d] in common.
    offset: [SI unit] mean of one minus other, at their stamps.
    amplitude, other_amplitude: [SI unit] of the daily wave.
    whole: lag over the common span; winter, summer: lag outside and inside summer time, None where too short.
    change, mean_day_change: [s] lag in summer minus lag in winter, from the weather and from the mean day.
    """

    signal: str
    one: str
    other: str
    days: float
    offset: Bounded
    amplitude: float
    other_amplitude: float
    whole: Lag
    winter: Lag | None
    summer: Lag | None
    change: Bounded
    mean_day_change: Bounded


def align(one: Series, other: Series, *, america: bool = False) -> Alignment | None:
    """Lag, offset and daily wave of one series against another of the same signal; None below 20 common days.

    one, other: of any hold, with steps of up to two hours; means are placed in the middle of their interval.
    america: whether summer time follows North American dates.

    Raises ValueError for different signals.
    """
    if one.signal != other.signal:
        raise ValueError(f"expected two series of one signal, found {one.signal} and {other.signal}")
    first, second = centred(one), centred(other)
    if len(first.known[0]) < 2 or len(second.known[0]) < 2:
        return None
    start = math.ceil(max(first.known[0][0], second.known[0][0]) / GRID_S) * GRID_S
    end = min(first.known[0][-1], second.known[0][-1])
    if not end - start >= FEWEST_D * DAY_S:
        return None
    time = np.arange(start, end, GRID_S)
    x, y = (at_times(each, time, bridge_h(each, BRIDGE_H)) for each in (first, second))
    both = np.isfinite(x) & np.isfinite(y)
    days = float(both.sum()) * GRID_S / DAY_S
    if days < FEWEST_D:
        return None
    sums = _sums(time, x, y, america)
    random = np.random.default_rng(0)
    everything = np.ones(len(sums.days), dtype=bool)
    whole, _ = _lag(sums, everything, random)
    winter, winter_draws = _part(sums, ~sums.summer, random)
    summer, summer_draws = _part(sums, sums.summer, random)
    change = mean_day_change = UNKNOWN
    if winter is not None and summer is not None:
        # estimates from disjoint blocks
        if summer.weather.known and winter.weather.known:
            lead = summer.weather.value - winter.weather.value
            change = _bounded(lead, summer_draws[0] - winter_draws[0])
        if summer.mean_day.known and winter.mean_day.known:
            lead = summer.mean_day.value - winter.mean_day.value
            mean_day_change = _bounded(lead, summer_draws[1] - winter_draws[1])
    weights = _weights(sums.days, everything, random)
    number = weights @ sums.count
    offset = _bounded(
        float(np.sum(sums.difference) / np.sum(sums.count)), (weights @ sums.difference) / number
    )
    size = 2.0 * GRID_S / (DAY_S * float(np.sum(sums.days)))
    return Alignment(
        one.signal, one.file, other.file, days, offset, size * abs(np.sum(sums.wave)),
        size * abs(np.sum(sums.other_wave)), whole, winter, summer, change, mean_day_change,
    )  # fmt: skip


@dataclass(frozen=True)
class _Sums:
    """Sums over each block, which the bootstrap weighs (B blocks, L lags).

    lags: [s] (L,). xy, xx, yy: (B, L) of the series without mean day. wave, other_wave: (B,) complex.
    difference, count: (B,) of one minus other. days: (B,). summer: (B,).
    """

    lags: np.ndarray
    xy: np.ndarray
    xx: np.ndarray
    yy: np.ndarray
    wave: np.ndarray
    other_wave: np.ndarray
    difference: np.ndarray
    count: np.ndarray
    days: np.ndarray
    summer: np.ndarray


def _sums(time: np.ndarray, x: np.ndarray, y: np.ndarray, america: bool) -> _Sums:
    """Sums of every block; a block ends with five days, a month, or summer time."""
    month = time.astype("datetime64[s]").astype("datetime64[M]")
    warm = summer_time(time, america)
    part = np.floor((time - time[0]) / (BLOCK_D * DAY_S)).astype(int)
    turns = (np.diff(part) != 0) | (np.diff(month.astype(int)) != 0) | (np.diff(warm.astype(int)) != 0)
    starts = np.append(0, np.flatnonzero(turns) + 1)
    group = np.unique(np.stack([month.astype(int), warm.astype(int)]), axis=1, return_inverse=True)[1].ravel()
    swift_x, swift_y = _without_slow(x), _without_slow(y)
    phase = np.exp(-2j * math.pi * np.mod(time, DAY_S) / DAY_S)
    known = np.isfinite(swift_x) & np.isfinite(swift_y)
    waves = [np.add.reduceat(np.where(known, swift, 0.0) * phase, starts) for swift in (swift_x, swift_y)]
    weather_x, weather_y = _without_mean_day(swift_x, time, group), _without_mean_day(swift_y, time, group)
    there_x, there_y = np.isfinite(weather_x), np.isfinite(weather_y)
    weather_x, weather_y = np.where(there_x, weather_x, 0.0), np.where(there_y, weather_y, 0.0)
    square_x, square_y = weather_x**2, weather_y**2
    reach = round(REACH_H * 3600.0 / GRID_S)
    lags = np.arange(-reach, reach + 1)
    xy, xx, yy = (np.empty((len(starts), len(lags))) for _ in range(3))
    padded = [np.pad(each, reach) for each in (weather_y, square_y, there_y)]
    for place, lag in enumerate(lags):
        # one is late by the lag: it shows now what the other showed earlier
        moved, square, there = (each[reach - lag : reach - lag + len(time)] for each in padded)
        xy[:, place] = np.add.reduceat(weather_x * moved, starts)
        xx[:, place] = np.add.reduceat(square_x * there, starts)
        yy[:, place] = np.add.reduceat(square * there_x, starts)
    both = np.isfinite(x) & np.isfinite(y)
    count = np.add.reduceat(both.astype(float), starts)
    difference = np.add.reduceat(np.where(both, x - y, 0.0), starts)
    days = np.add.reduceat(known.astype(float), starts) * GRID_S / DAY_S
    return _Sums(
        GRID_S * lags, xy, xx, yy, waves[0], waves[1], difference, count, days, warm[starts]
    )  # fmt: skip


def _without_slow(value: np.ndarray) -> np.ndarray:
    """Values minus their running mean over a day; NaN at the ends and where under 60 % of a day is known."""
    half = round(0.5 * DAY_S / GRID_S)
    known = np.isfinite(value)
    total = np.concatenate([[0.0], np.cumsum(np.where(known, value, 0.0))])
    number = np.concatenate([[0.0], np.cumsum(known)])
    low = np.clip(np.arange(len(value)) - half, 0, None)
    high = np.clip(np.arange(len(value)) + half, None, len(value))
    many = number[high] - number[low]
    enough = (many >= 0.6 * 2 * half) & (high - low == 2 * half)
    return np.where(enough & known, value - (total[high] - total[low]) / np.maximum(many, 1.0), np.nan)


def _without_mean_day(value: np.ndarray, time: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Values minus the mean day of their month, separately for winter and summer time."""
    per_day = round(DAY_S / GRID_S)
    key = group * per_day + np.round(np.mod(time, DAY_S) / GRID_S).astype(int) % per_day
    known = np.isfinite(value)
    number = np.bincount(key[known], minlength=key.max() + 1)
    total = np.bincount(key[known], weights=value[known], minlength=key.max() + 1)
    weather = value - (total / np.maximum(number, 1))[key]
    # a series that repeats every day leaves only rounding errors, which are no weather
    return weather if np.nanstd(weather) > 1e-6 * np.nanstd(value) else np.where(known, 0.0, np.nan)


def _weights(days: np.ndarray, inside: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """How often each block occurs in each draw (draws, B); never, if it lies outside."""
    blocks = np.flatnonzero(inside & (days > 0.0))
    weights = np.zeros((DRAWS, len(days)))
    if len(blocks):
        weights[:, blocks] = random.multinomial(
            len(blocks), np.full(len(blocks), 1.0 / len(blocks)), size=DRAWS
        )
    return weights


def _part(
    sums: _Sums, inside: np.ndarray, random: np.random.Generator
) -> tuple[Lag | None, tuple[np.ndarray, np.ndarray]]:
    if sums.days[inside].sum() < FEWEST_D:
        return None, (np.zeros(0), np.zeros(0))
    return _lag(sums, inside, random)


def _lag(
    sums: _Sums, inside: np.ndarray, random: np.random.Generator
) -> tuple[Lag, tuple[np.ndarray, np.ndarray]]:
    """Lag over some blocks, and the draws of both of its estimates."""
    weights = np.concatenate([inside[None, :].astype(float), _weights(sums.days, inside, random)])
    with np.errstate(invalid="ignore", divide="ignore"):
        curves = (weights @ sums.xy) / np.sqrt((weights @ sums.xx) * (weights @ sums.yy))
    peaks, highest = _peaks(sums.lags, np.nan_to_num(curves, nan=-1.0))
    turn = (weights @ sums.wave) / (weights @ sums.other_wave)
    phase = -np.angle(turn) * DAY_S / (2.0 * math.pi)
    # a phase is known up to whole days: bring all draws to the side of the estimate
    phase = phase[0] + np.mod(phase - phase[0] + 0.5 * DAY_S, DAY_S) - 0.5 * DAY_S
    weather = _bounded(float(peaks[0]), peaks[1:])
    at_edge = abs(peaks[0]) >= sums.lags[-1] - GRID_S
    if highest[0] < LEAST_CORRELATION or weather.high - weather.low > WIDEST_H * 3600.0 or at_edge:
        weather = UNKNOWN
    mean_day = _bounded(float(phase[0]), phase[1:])
    if mean_day.high - mean_day.low > WIDEST_H * 3600.0:
        mean_day = UNKNOWN
    lag = Lag(weather, mean_day, float(sums.days[inside].sum()), float(highest[0]))
    return lag, (peaks[1:], phase[1:])


def _peaks(lags: np.ndarray, curves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lags [s] (N,) at which curves (N, L) peak, by a parabola through seven points, and their heights."""
    top = np.argmax(curves, axis=1)
    reach = 3
    middle = np.clip(top, reach, curves.shape[1] - 1 - reach)
    offsets = np.arange(-reach, reach + 1)
    near = np.take_along_axis(curves, middle[:, None] + offsets, axis=1)
    # least squares of a + b k + c k² on k = −3 … 3
    slope = near @ offsets / np.sum(offsets**2)
    squares = offsets**2 - np.mean(offsets**2)
    bend = near @ squares / np.sum(squares**2)
    with np.errstate(invalid="ignore", divide="ignore"):
        step = np.where(bend < 0.0, -0.5 * slope / bend, 0.0)
    step = np.clip(step, -reach, reach)
    return lags[middle] + step * GRID_S, np.take_along_axis(curves, top[:, None], axis=1)[:, 0]


def _bounded(value: float, draws: np.ndarray) -> Bounded:
    low, high = np.quantile(draws, [0.025, 0.975])
    return Bounded(value, float(low), float(high))
