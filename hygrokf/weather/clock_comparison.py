"""Compare two weather series of the same signal: lag, offset and daily wave, with bounds; and check the clock
of one source against another: right, off by a constant, or off in one season.

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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hygrokf.data.ambient import at_times, bridge_h
from hygrokf.data.input_paths import centred
from hygrokf.data.record import Record, Series
from hygrokf.data.shared_clocks import in_america
from hygrokf.data.timestamps import DAY_S, MINUTE_S, modal_step, summer_time
from hygrokf.texts.record_codes import DoubtCode, RecordCode
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import Name, Source
from hygrokf.texts.wording import signed_shift

GRID_S = 600.0
"""[s] grid on which both series are compared; a parabola gives lags between its points."""
REACH_H = 14.0
"""[h] largest lag searched: the widest difference between two time zones in use."""
COMPARISON_BRIDGE_H = 3.0
BLOCK_D = 5.0
FEWEST_COMPARED_D = 20.0
"""[d] fewest common days for a comparison."""
LAG_DRAWS = 400
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


UNKNOWN_BOUNDS = Bounded(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Lag:
    """How much later one series is than the other, over a part of the time.

    weather, mean_day: [s] the two estimates; positive where the first series is late.
    """

    weather: Bounded
    mean_day: Bounded


@dataclass(frozen=True)
class Alignment:
    """Comparison of one series with another of the same signal.

    signal: of both. one, other: their files.
    offset: [SI unit] mean of one minus other, at their stamps.
    amplitude, other_amplitude: [SI unit] of the daily wave.
    whole: lag over the common span; winter, summer: lag outside and inside summer time, None where too short.
    change, mean_day_change: [s] lag in summer minus lag in winter, from the weather and from the mean day.
    """

    signal: Name
    one: Source
    other: Source
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
    if not end - start >= FEWEST_COMPARED_D * DAY_S:
        return None
    time = np.arange(start, end, GRID_S)
    x, y = (at_times(each, time, bridge_h(each, COMPARISON_BRIDGE_H)) for each in (first, second))
    both = np.isfinite(x) & np.isfinite(y)
    if both.sum() * GRID_S < FEWEST_COMPARED_D * DAY_S:
        return None
    sums = _sums(time, x, y, america)
    random = np.random.default_rng(0)
    everything = np.ones(len(sums.days), dtype=bool)
    lags, draws = dict[str, Lag](), dict[str, tuple[np.ndarray, np.ndarray]]()
    for part, inside in (("whole", everything), ("winter", ~sums.summer), ("summer", sums.summer)):
        if part == "whole" or sums.days[inside].sum() >= FEWEST_COMPARED_D:
            lags[part], draws[part] = _lag(sums, inside, random)
    change = mean_day_change = UNKNOWN_BOUNDS
    if {"winter", "summer"} <= set(lags):
        winter, summer = lags["winter"], lags["summer"]
        # estimates from disjoint blocks
        leads = [after - before for before, after in zip(draws["winter"], draws["summer"], strict=True)]
        change = _change(winter.weather, summer.weather, leads[0])
        mean_day_change = _change(winter.mean_day, summer.mean_day, leads[1])
    weights = _weights(sums.days, everything, random)
    number = weights @ sums.count
    offset = _bounded(
        float(np.sum(sums.difference) / np.sum(sums.count)), (weights @ sums.difference) / number
    )
    size = 2.0 * GRID_S / (DAY_S * float(np.sum(sums.days)))
    return Alignment(
        one.signal, one.file, other.file, offset, size * abs(np.sum(sums.wave)),
        size * abs(np.sum(sums.other_wave)), lags["whole"], lags.get("winter"), lags.get("summer"),
        change, mean_day_change,
    )  # fmt: skip


@dataclass(frozen=True)
class _BlockSums:
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


def _sums(time: np.ndarray, x: np.ndarray, y: np.ndarray, america: bool) -> _BlockSums:
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
    return _BlockSums(
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
    weights = np.zeros((LAG_DRAWS, len(days)))
    if len(blocks):
        weights[:, blocks] = random.multinomial(
            len(blocks), np.full(len(blocks), 1.0 / len(blocks)), size=LAG_DRAWS
        )
    return weights


def _change(winter: Bounded, summer: Bounded, draws: np.ndarray) -> Bounded:
    return _bounded(summer.value - winter.value, draws) if winter.known and summer.known else UNKNOWN_BOUNDS


def _lag(
    sums: _BlockSums, inside: np.ndarray, random: np.random.Generator
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
        weather = UNKNOWN_BOUNDS
    mean_day = _bounded(float(phase[0]), phase[1:])
    if mean_day.high - mean_day.low > WIDEST_H * 3600.0:
        mean_day = UNKNOWN_BOUNDS
    return Lag(weather, mean_day), (peaks[1:], phase[1:])


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


TOLERANCE_S = 20.0 * MINUTE_S
"""[s] largest lag that is not a clock error: slow housings, and fronts that reach the middle of a grid cell
before the site."""
APART_S = 60.0 * MINUTE_S
"""[s] largest difference between the lags from weather and mean day if a clock causes both."""
NOT_COMPARED = ("wind_direction", "rain")
"""Signals that are not compared: a direction has no mean, and rain differs between places."""
JUDGES = ("ambient_temperature", "global_horizontal_irradiance")
"""Signals whose mean day follows the sun everywhere; that of wind differs between heights and places."""


@dataclass(frozen=True)
class ClockError:
    """Error of one source's clock against another's.

    one, other: the sources. kind: "right", "constant", "seasonal", or "unclear": the lag is unknown, or
        weather and mean day disagree, as between distant places.
    winter, summer: [s] how much later readings of `one` are stamped; equal unless seasonal.
    alignments: the comparisons behind it, which have the lags from the mean day too.
    """

    one: Source
    other: Source
    kind: Literal["right", "constant", "seasonal", "unclear"]
    winter: Bounded
    summer: Bounded
    alignments: tuple[Alignment, ...]

    @property
    def corrections_s(self) -> tuple[float, float]:
        """Corrections of the stamps of `one` in winter and in summer [s], rounded as by `rounded`."""
        if self.kind not in ("constant", "seasonal"):
            return 0.0, 0.0
        winter = rounded(-self.winter.value)
        return winter, winter if self.kind == "constant" else rounded(-self.summer.value)


def rounded(seconds: float) -> float:
    """A correction [s] rounded as clocks are set: 0 within 20 min, whole hours within 15 min, half hours
    within 10 min, otherwise to 5 min."""
    hour, half = 3600.0 * round(seconds / 3600.0), 1800.0 * round(seconds / 1800.0)
    if abs(seconds) <= TOLERANCE_S:
        return 0.0
    if abs(seconds - hour) <= 0.75 * TOLERANCE_S:
        return hour
    if abs(seconds - half) <= 0.5 * TOLERANCE_S:
        return half
    return 300.0 * round(seconds / 300.0)


def alignments(record: Record) -> tuple[Alignment, ...]:
    """Comparison of every `compared` series of a record with the series of the same signal that is used.

    The reference, `other` of an alignment, is the series with the longer step, such as a reanalysis; with
    equal steps it is the compared one.
    """
    found = []
    for other in record.compared:
        if other.signal not in record or other.signal in NOT_COMPARED:
            continue
        first, second = record[other.signal], other
        if modal_step(first.time)[0] > modal_step(second.time)[0]:
            first, second = second, first
        made = align(first, second, america=in_america(record))
        if made is not None:
            found.append(made)
    return tuple(found)


def clock_errors(found: Sequence[Alignment]) -> tuple[ClockError, ...]:
    """Errors of clocks, one for each pair of sources.

    found: of `alignments`. A clock has a constant error where the bounds of the weather's lag lie beyond
    20 min, and the mean day's lag has the same sign and differs by at most an hour.  The error is seasonal
    where both lags change by more than 20 min (mean day: 15 min) between winter and summer.  Where the mean
    day is unknown, for wind alone for instance, the weather's lag must exceed 30 min.
    """
    pairs: dict[tuple[str, str], list[Alignment]] = {}
    for one in found:
        pairs.setdefault((one.one, one.other), []).append(one)
    return tuple(_clock_error(one, other, tuple(ones)) for (one, other), ones in pairs.items())


def _clock_error(one: str, other: str, found: tuple[Alignment, ...]) -> ClockError:
    weather, day = dict[str, Bounded](), dict[str, Bounded]()
    judges = [each for each in found if each.signal in JUDGES]
    for name in ("whole", "winter", "summer"):
        lags: list[Lag | None] = [getattr(each, name) for each in found]
        weather[name] = _combined([lag.weather for lag in lags if lag is not None])
        lags = [getattr(each, name) for each in judges]
        day[name] = next(
            (lag.mean_day for lag in lags if lag is not None and lag.mean_day.known), UNKNOWN_BOUNDS
        )
    change = _combined([each.change for each in found])
    day_change = next((each.mean_day_change for each in judges if each.mean_day_change.known), UNKNOWN_BOUNDS)
    if not weather["whole"].known and not (weather["winter"].known and weather["summer"].known):
        return ClockError(one, other, "unclear", UNKNOWN_BOUNDS, UNKNOWN_BOUNDS, found)
    seasonal = _beyond(change) and (
        not day_change.known
        or (day_change.value * change.value > 0 and abs(day_change.value) > 0.75 * TOLERANCE_S)
    )
    if seasonal and any(_off(weather[name], day[name]) for name in ("winter", "summer")):
        return ClockError(one, other, "seasonal", weather["winter"], weather["summer"], found)
    constant = not seasonal and _off(weather["whole"], day["whole"])
    unclear = _beyond(weather["whole"]) or seasonal
    return ClockError(
        one, other, "constant" if constant else "unclear" if unclear else "right",
        weather["whole"], weather["whole"], found,
    )  # fmt: skip


def _combined(estimates: Sequence[Bounded]) -> Bounded:
    """Mean of estimates of the same lag, weighted by inverse variance; its bounds include their spread."""
    known = [one for one in estimates if one.known]
    if len(known) < 2:
        return known[0] if known else UNKNOWN_BOUNDS
    spread = [max((one.high - one.low) / 3.92, MINUTE_S) for one in known]
    weights = [1.0 / one**2 for one in spread]
    total = sum(weights)
    mean = sum(w * one.value for w, one in zip(weights, known, strict=True)) / total
    misfit = sum(w * (one.value - mean) ** 2 for w, one in zip(weights, known, strict=True)) / (
        len(known) - 1
    )
    half = 1.96 * math.sqrt(max(misfit, 1.0) / total)
    return Bounded(mean, mean - half, mean + half)


def _beyond(lag: Bounded, limit_s: float = TOLERANCE_S) -> bool:
    return lag.known and (lag.low > limit_s or lag.high < -limit_s)


def _off(weather: Bounded, day: Bounded) -> bool:
    """Whether the lags from weather and mean day both show a clock error."""
    if not day.known:
        return _beyond(weather, 1.5 * TOLERANCE_S)
    # a day later is the same phase: a clock that is off by half a day shows either sign
    turn = DAY_S * round((weather.value - day.value) / DAY_S)
    value, low, high = (one + turn for one in (day.value, day.low, day.high))
    same_side = weather.value * value > 0 and (low > 0.0 or high < 0.0)
    return _beyond(weather) and same_side and abs(weather.value - value) <= APART_S


def clock_doubts(errors: Sequence[ClockError], south: bool = False) -> list[Statement]:
    """Clock errors and their remedies, one doubt for each pair of sources; none for clocks that are right.

    south: whether the site lies in the southern hemisphere, where the seasons are exchanged.
    """
    early, late = seasons(south)
    doubts = []
    for error in errors:
        first, second = error.corrections_s
        if error.kind == "constant":
            doubts.append(
                DoubtCode.CLOCK_RUNS(
                    source=error.one, other=error.other, pace=pace(first), lag=_lag_of(error.winter),
                    needed=first, remedy=state_correction(first),
                )
            )  # fmt: skip
        elif error.kind == "seasonal":
            doubts.append(
                DoubtCode.CLOCK_RUNS_BY_SEASON(
                    source=error.one, other=error.other, early=early, late=late,
                    first_pace=pace(first), second_pace=pace(second),
                    first_lag=_lag_of(error.winter), second_lag=_lag_of(error.summer),
                    remedy=season_remedy(first, second, south),
                )
            )  # fmt: skip
    return doubts


def state_correction(correction_s: float) -> Statement:
    """The key of a case file that corrects a clock."""
    return RecordCode.STATE_CORRECTION(correction=signed_shift(correction_s).replace(" ", ""))


def seasons(south: bool) -> tuple[Statement, Statement]:
    """The months of winter time and of summer time in the north, as either hemisphere calls them."""
    if south:
        return RecordCode.NOVEMBER_TO_MARCH(), RecordCode.APRIL_TO_OCTOBER()
    return RecordCode.IN_WINTER(), RecordCode.IN_SUMMER()


def season_remedy(winter_s: float, summer_s: float, south: bool = False) -> Statement:
    """What corrects a clock that needs one correction [s] in winter and another one in summer."""
    early, late = seasons(south)
    needed = RecordCode.BY_SEASON(first=winter_s, early=early, second=summer_s, late=late)
    # the clock's summer time is the other season in the south
    change = winter_s - summer_s if south else summer_s - winter_s
    if abs(change - 3600.0) < 1.0:
        zone = () if south else (_zone(winter_s),)
        return RecordCode.CLOCK_WITHOUT_SUMMER_TIME(needed=needed, zone=zone)
    if abs(change + 3600.0) < 1.0:
        example = "Australia/Sydney" if south else "Europe/Berlin"
        return RecordCode.CLOCK_WITH_SUMMER_TIME(needed=needed, zone=example)
    return needed


def _zone(winter_s: float) -> Statement:
    """The fixed offset of the clock, from the offset at which its stamps are read in winter."""
    if winter_s == 0.0:
        return RecordCode.OFFSET_OF_WINTER()
    sign, minutes = "+" if winter_s > 0 else "-", round(abs(winter_s) / MINUTE_S)
    return RecordCode.OFFSET_OF_UTC(offset=f"{sign}{minutes // 60:02d}:{minutes % 60:02d}")


def pace(correction_s: float) -> Statement:
    """How a clock runs whose stamps need a correction [s]."""
    if correction_s == 0.0:
        return RecordCode.CLOCK_RIGHT()
    return (RecordCode.CLOCK_SLOW if correction_s > 0 else RecordCode.CLOCK_FAST)(by=abs(correction_s))


def _lag_of(lag: Bounded) -> Statement:
    """A lag with its bounds: "54 min early (48 … 60)"."""
    ends = sorted(
        abs(end) / MINUTE_S if lag.low * lag.high > 0 else end / MINUTE_S for end in (lag.low, lag.high)
    )
    code = RecordCode.COMES_LATE if lag.value > 0 else RecordCode.COMES_EARLY
    return code(minutes=abs(lag.value) / MINUTE_S, low=ends[0], high=ends[1])
