"""Compare two weather series of the same signal (lag, offset and daily wave, with bounds), and judge the
clock of one source against another: right, off by a constant, or off in one season.

Different clocks shift the weather and the mean day alike, so the lag is estimated from each of them:

- weather: both series minus their running mean of a day and minus the mean day of each month; the lag at
which the remainders correlate best. Fronts, clouds and showers determine it; a sensor in the sun does not
change it.
- mean day: the phase between the daily waves of the two series. A sensor in the sun or in a slow housing
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
"""[s] step of the grid on which both series are compared; a parabola gives lags between its points."""
REACH_H = 14.0
"""[h] largest lag searched: the widest difference between two time zones in use."""
COMPARISON_BRIDGE_H = 3.0
"""[h] longest gap that is interpolated."""
BLOCK_D = 5.0
"""[d] length of the blocks of the bootstrap."""
FEWEST_COMPARED_D = 20.0
"""[d] smallest number of common days for a comparison."""
LAG_DRAWS = 400
LEAST_CORRELATION = 0.25
"""[1] for a smaller highest correlation the series are not of the same weather, and the lag is unknown."""
WIDEST_H = 3.0
"""[h] if the bounds of a lag are further apart, the lag counts as unknown."""


@dataclass(frozen=True)
class Bounded:
    """An estimate with its 95 % bounds; NaN if it is unknown."""

    value: float
    low: float
    high: float

    @property
    def known(self) -> bool:
        """Whether the estimate is known."""
        return math.isfinite(self.value)


UNKNOWN_BOUNDS = Bounded(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Lag:
    """How much later one series is than the other [s], estimated from the weather and from the mean day;
    positive if the first series is late."""

    weather: Bounded
    mean_day: Bounded


@dataclass(frozen=True)
class Alignment:
    """The comparison of one series with another one of the same signal.

    signal: of both. one, other: their files.
    offset: [SI unit] mean of one minus other, at their stamps.
    amplitude, other_amplitude: [SI unit] of the daily wave.
    whole: lag over the common time; winter, summer: lag outside and inside summer time, None for too short a
        time.
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


def align(first: Series, second: Series, *, america: bool = False) -> Alignment | None:
    """Compare one series with another one of the same signal; None for less than 20 common days.

    first, second: of any hold, with steps of up to two hours; means are placed in the middle of their
        interval.
    america: whether summer time follows North American dates.

    Raises ValueError for different signals.
    """
    if first.signal != second.signal:
        raise ValueError(f"expected two series of one signal, found {first.signal} and {second.signal}")
    x, y = centred(first), centred(second)
    if len(x.known[0]) < 2 or len(y.known[0]) < 2:
        return None
    start_s = math.ceil(max(x.known[0][0], y.known[0][0]) / GRID_S) * GRID_S
    end_s = min(x.known[0][-1], y.known[0][-1])
    if not end_s - start_s >= FEWEST_COMPARED_D * DAY_S:
        return None
    time = np.arange(start_s, end_s, GRID_S)
    x_values, y_values = (at_times(series, time, bridge_h(series, COMPARISON_BRIDGE_H)) for series in (x, y))
    both_known = np.isfinite(x_values) & np.isfinite(y_values)
    if both_known.sum() * GRID_S < FEWEST_COMPARED_D * DAY_S:
        return None
    sums = _sums(time, x_values, y_values, america)
    random = np.random.default_rng(0)
    all_blocks = np.ones(len(sums.days), dtype=bool)
    lags, draws = dict[str, Lag](), dict[str, tuple[np.ndarray, np.ndarray]]()
    for season, inside in (("whole", all_blocks), ("winter", ~sums.summer), ("summer", sums.summer)):
        if season == "whole" or sums.days[inside].sum() >= FEWEST_COMPARED_D:
            lags[season], draws[season] = _lag(sums, inside, random)
    change = mean_day_change = UNKNOWN_BOUNDS
    if {"winter", "summer"} <= set(lags):
        winter, summer = lags["winter"], lags["summer"]
        # estimates from disjoint blocks
        by_season = zip(draws["winter"], draws["summer"], strict=True)
        draws_of_change = [in_summer - in_winter for in_winter, in_summer in by_season]
        change = _change(winter.weather, summer.weather, draws_of_change[0])
        mean_day_change = _change(winter.mean_day, summer.mean_day, draws_of_change[1])
    weights = _weights(sums.days, all_blocks, random)
    counts = weights @ sums.count
    offset = _bounded(
        float(np.sum(sums.difference) / np.sum(sums.count)), (weights @ sums.difference) / counts
    )
    per_sum = 2.0 * GRID_S / (DAY_S * float(np.sum(sums.days)))
    return Alignment(
        first.signal, first.file, second.file, offset, per_sum * abs(np.sum(sums.wave)),
        per_sum * abs(np.sum(sums.other_wave)), lags["whole"], lags.get("winter"),
        lags.get("summer"),
        change, mean_day_change,
    )  # fmt: skip


@dataclass(frozen=True)
class _BlockSums:
    """Sums over each of B blocks, which the bootstrap weighs; L lags.

    lags: (L,) [s]. xy, xx, yy: (B, L) products of the two series without mean day. wave, other_wave: (B,)
        complex sums of the daily wave. difference, count: (B,) sum of one minus other, and number of common
        values. days: (B,) length. summer: (B,) whether the block is in summer time.
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
    """Return the sums over all blocks; a block ends after five days, with a month, or with summer time.

    time: [s] (T,) grid. x, y: (T,) values of both series, NaN where missing.
    """
    month = time.astype("datetime64[s]").astype("datetime64[M]")
    is_summer = summer_time(time, america)
    block = np.floor((time - time[0]) / (BLOCK_D * DAY_S)).astype(int)
    ends_block = (
        (np.diff(block) != 0) | (np.diff(month.astype(int)) != 0) | (np.diff(is_summer.astype(int)) != 0)
    )
    starts = np.append(0, np.flatnonzero(ends_block) + 1)
    season = np.unique(np.stack([month.astype(int), is_summer.astype(int)]), axis=1, return_inverse=True)[
        1
    ].ravel()
    fast_x, fast_y = _without_slow(x), _without_slow(y)
    phase = np.exp(-2j * math.pi * np.mod(time, DAY_S) / DAY_S)
    known = np.isfinite(fast_x) & np.isfinite(fast_y)
    waves = [np.add.reduceat(np.where(known, fast, 0.0) * phase, starts) for fast in (fast_x, fast_y)]
    weather_x, weather_y = (_without_mean_day(fast_x, time, season), _without_mean_day(fast_y, time, season))
    known_x, known_y = np.isfinite(weather_x), np.isfinite(weather_y)
    weather_x, weather_y = np.where(known_x, weather_x, 0.0), np.where(known_y, weather_y, 0.0)
    square_x, square_y = weather_x**2, weather_y**2
    most_steps = round(REACH_H * 3600.0 / GRID_S)
    lags = np.arange(-most_steps, most_steps + 1)
    xy, xx, yy = (np.empty((len(starts), len(lags))) for _ in range(3))
    padded = [np.pad(values, most_steps) for values in (weather_y, square_y, known_y)]
    for column, steps in enumerate(lags):
        # one is late by the lag: it shows now what the other showed earlier
        shifted_y, shifted_square_y, shifted_known_y = (
            values[most_steps - steps : most_steps - steps + len(time)] for values in padded
        )
        xy[:, column] = np.add.reduceat(weather_x * shifted_y, starts)
        xx[:, column] = np.add.reduceat(square_x * shifted_known_y, starts)
        yy[:, column] = np.add.reduceat(shifted_square_y * known_x, starts)
    both_known = np.isfinite(x) & np.isfinite(y)
    count = np.add.reduceat(both_known.astype(float), starts)
    difference = np.add.reduceat(np.where(both_known, x - y, 0.0), starts)
    days = np.add.reduceat(known.astype(float), starts) * GRID_S / DAY_S
    return _BlockSums(
        GRID_S * lags, xy, xx, yy, waves[0], waves[1], difference, count, days, is_summer[starts]
    )  # fmt: skip


def _without_slow(value: np.ndarray) -> np.ndarray:
    """Return values (T,) minus their running mean over a day; NaN at the ends, and where less than 60 % of a
    day is known."""
    half_day = round(0.5 * DAY_S / GRID_S)
    is_known = np.isfinite(value)
    running_sum = np.concatenate([[0.0], np.cumsum(np.where(is_known, value, 0.0))])
    running_count = np.concatenate([[0.0], np.cumsum(is_known)])
    start = np.clip(np.arange(len(value)) - half_day, 0, None)
    end = np.clip(np.arange(len(value)) + half_day, None, len(value))
    count_in_day = running_count[end] - running_count[start]
    has_enough = (count_in_day >= 0.6 * 2 * half_day) & (end - start == 2 * half_day)
    return np.where(
        has_enough & is_known,
        value - (running_sum[end] - running_sum[start]) / np.maximum(count_in_day, 1.0),
        np.nan,
    )


def _without_mean_day(value: np.ndarray, time: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return values (T,) minus the mean day of their month, separately for winter and summer time.

    group: (T,) number of month and season.
    """
    per_day = round(DAY_S / GRID_S)
    bin_number = group * per_day + np.round(np.mod(time, DAY_S) / GRID_S).astype(int) % per_day
    is_known = np.isfinite(value)
    counts = np.bincount(bin_number[is_known], minlength=bin_number.max() + 1)
    sums = np.bincount(bin_number[is_known], weights=value[is_known], minlength=bin_number.max() + 1)
    weather = value - (sums / np.maximum(counts, 1))[bin_number]
    # a series that repeats every day leaves only rounding errors, which are no weather
    return weather if np.nanstd(weather) > 1e-6 * np.nanstd(value) else np.where(is_known, 0.0, np.nan)


def _weights(days: np.ndarray, is_inside: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Draw how often each block occurs in each resample (draws, B); blocks outside never occur."""
    blocks = np.flatnonzero(is_inside & (days > 0.0))
    weights = np.zeros((LAG_DRAWS, len(days)))
    if len(blocks):
        weights[:, blocks] = random.multinomial(
            len(blocks), np.full(len(blocks), 1.0 / len(blocks)), size=LAG_DRAWS
        )
    return weights


def _change(winter: Bounded, summer: Bounded, draws: np.ndarray) -> Bounded:
    """Return the change of a lag from winter to summer; unknown if one of both is."""
    return _bounded(summer.value - winter.value, draws) if winter.known and summer.known else UNKNOWN_BOUNDS


def _lag(
    sums: _BlockSums, is_inside: np.ndarray, random: np.random.Generator
) -> tuple[Lag, tuple[np.ndarray, np.ndarray]]:
    """Return the lag over some blocks, and the draws of both of its estimates [s]."""
    weights = np.concatenate([is_inside[None, :].astype(float), _weights(sums.days, is_inside, random)])
    with np.errstate(invalid="ignore", divide="ignore"):
        curves = (weights @ sums.xy) / np.sqrt((weights @ sums.xx) * (weights @ sums.yy))
    peaks, highest = _peaks(sums.lags, np.nan_to_num(curves, nan=-1.0))
    wave_ratio = (weights @ sums.wave) / (weights @ sums.other_wave)
    phase_s = -np.angle(wave_ratio) * DAY_S / (2.0 * math.pi)
    # a phase is known up to whole days: bring all draws to the side of the estimate
    phase_s = phase_s[0] + np.mod(phase_s - phase_s[0] + 0.5 * DAY_S, DAY_S) - 0.5 * DAY_S
    weather = _bounded(float(peaks[0]), peaks[1:])
    is_at_edge = abs(peaks[0]) >= sums.lags[-1] - GRID_S
    if highest[0] < LEAST_CORRELATION or weather.high - weather.low > WIDEST_H * 3600.0 or is_at_edge:
        weather = UNKNOWN_BOUNDS
    mean_day = _bounded(float(phase_s[0]), phase_s[1:])
    if mean_day.high - mean_day.low > WIDEST_H * 3600.0:
        mean_day = UNKNOWN_BOUNDS
    return Lag(weather, mean_day), (peaks[1:], phase_s[1:])


def _peaks(lags: np.ndarray, curves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lags [s] (N,) at which curves (N, L) peak, by a parabola through seven points, and the
    heights of the peaks."""
    highest_index = np.argmax(curves, axis=1)
    half_width = 3
    middle = np.clip(highest_index, half_width, curves.shape[1] - 1 - half_width)
    offsets = np.arange(-half_width, half_width + 1)
    values_near = np.take_along_axis(curves, middle[:, None] + offsets, axis=1)
    # least squares of a + b k + c k² on k = −3 … 3
    slope = values_near @ offsets / np.sum(offsets**2)
    squares = offsets**2 - np.mean(offsets**2)
    curvature = values_near @ squares / np.sum(squares**2)
    with np.errstate(invalid="ignore", divide="ignore"):
        steps_to_peak = np.where(curvature < 0.0, -0.5 * slope / curvature, 0.0)
    steps_to_peak = np.clip(steps_to_peak, -half_width, half_width)
    return lags[middle] + steps_to_peak * GRID_S, np.take_along_axis(curves, highest_index[:, None], axis=1)[
        :, 0
    ]


def _bounded(value: float, draws: np.ndarray) -> Bounded:
    """Return an estimate with the 95 % quantiles of its draws."""
    low, high = np.quantile(draws, [0.025, 0.975])
    return Bounded(value, float(low), float(high))


TOLERANCE_S = 20.0 * MINUTE_S
"""[s] smaller lags are no clock errors: slow housings, and fronts that reach a grid cell before the site,
cause them too."""
APART_S = 60.0 * MINUTE_S
"""[s] if the lags from weather and mean day differ by more, they do not come from a clock."""
NOT_COMPARED = ("wind_direction", "rain")
"""Signals that are not compared: a direction has no mean, and rain differs between places."""
SIGNALS_WITH_SUN = ("ambient_temperature", "global_horizontal_irradiance")
"""Signals whose mean day follows the sun everywhere; that of the wind differs between heights and places."""


@dataclass(frozen=True)
class ClockError:
    """The error of one source's clock against another's.

    one, other: the sources. kind: "right", "constant", "seasonal", or "unclear": the lag is unknown, or
        weather and mean day disagree, as between distant places.
    winter, summer: [s] how much later the readings of `one` are stamped; equal unless the error is seasonal.
    alignments: the comparisons of the two sources.
    """

    one: Source
    other: Source
    kind: Literal["right", "constant", "seasonal", "unclear"]
    winter: Bounded
    summer: Bounded
    alignments: tuple[Alignment, ...]

    @property
    def corrections_s(self) -> tuple[float, float]:
        """Corrections [s] of the stamps of `one` in winter and in summer, rounded by `rounded`."""
        if self.kind not in ("constant", "seasonal"):
            return 0.0, 0.0
        winter = rounded(-self.winter.value)
        return winter, winter if self.kind == "constant" else rounded(-self.summer.value)


def rounded(seconds: float) -> float:
    """Round the correction of a clock [s]: to 0 within 20 min, to a whole hour within 15 min, to half an hour
    within 10 min, else to 5 min."""
    hour, half = 3600.0 * round(seconds / 3600.0), 1800.0 * round(seconds / 1800.0)
    if abs(seconds) <= TOLERANCE_S:
        return 0.0
    if abs(seconds - hour) <= 0.75 * TOLERANCE_S:
        return hour
    if abs(seconds - half) <= 0.5 * TOLERANCE_S:
        return half
    return 300.0 * round(seconds / 300.0)


def alignments(record: Record) -> tuple[Alignment, ...]:
    """Compare every `compared` series of a record with the series of the same signal that is used.

    The reference (`other` of an alignment) is the series with the longer step, such as a reanalysis; for
    equal steps, the compared one.
    """
    results = []
    for compared in record.compared:
        if compared.signal not in record or compared.signal in NOT_COMPARED:
            continue
        used_series, reference = record[compared.signal], compared
        if modal_step(used_series.time)[0] > modal_step(reference.time)[0]:
            used_series, reference = reference, used_series
        alignment = align(used_series, reference, america=in_america(record))
        if alignment is not None:
            results.append(alignment)
    return tuple(results)


def clock_errors(all_alignments: Sequence[Alignment]) -> tuple[ClockError, ...]:
    """Return the clock errors, one for each pair of sources.

    all_alignments: of `alignments`. A clock has a constant error if the bounds of the weather's lag lie
        beyond 20 min, and the mean day's lag has the same sign and differs by an hour at most. The error is
        seasonal if both lags change by more than 20 min (mean day: 15 min) between winter and summer. If the
        mean day is unknown, for instance for wind alone, the weather's lag must exceed 30 min.
    """
    by_sources: dict[tuple[str, str], list[Alignment]] = {}
    for alignment in all_alignments:
        by_sources.setdefault((alignment.one, alignment.other), []).append(alignment)
    return tuple(
        _clock_error(first, second, tuple(alignments_of_pair))
        for (first, second), alignments_of_pair in by_sources.items()
    )


def _clock_error(one: str, other: str, alignments_of_pair: tuple[Alignment, ...]) -> ClockError:
    """Return the clock error of one source against another, from the comparisons of their signals."""
    weather, mean_day = dict[str, Bounded](), dict[str, Bounded]()
    with_sun = [alignment for alignment in alignments_of_pair if alignment.signal in SIGNALS_WITH_SUN]
    for season in ("whole", "winter", "summer"):
        lags: list[Lag | None] = [getattr(alignment, season) for alignment in alignments_of_pair]
        weather[season] = _combined([lag.weather for lag in lags if lag is not None])
        lags = [getattr(alignment, season) for alignment in with_sun]
        mean_day[season] = next(
            (lag.mean_day for lag in lags if lag is not None and lag.mean_day.known), UNKNOWN_BOUNDS
        )
    change = _combined([alignment.change for alignment in alignments_of_pair])
    day_change = next(
        (alignment.mean_day_change for alignment in with_sun if alignment.mean_day_change.known),
        UNKNOWN_BOUNDS,
    )
    if not weather["whole"].known and not (weather["winter"].known and weather["summer"].known):
        return ClockError(one, other, "unclear", UNKNOWN_BOUNDS, UNKNOWN_BOUNDS, alignments_of_pair)
    is_seasonal = _beyond(change) and (
        not day_change.known
        or (day_change.value * change.value > 0 and abs(day_change.value) > 0.75 * TOLERANCE_S)
    )
    if is_seasonal and any(_off(weather[season], mean_day[season]) for season in ("winter", "summer")):
        return ClockError(one, other, "seasonal", weather["winter"], weather["summer"], alignments_of_pair)
    is_constant = not is_seasonal and _off(weather["whole"], mean_day["whole"])
    is_unclear = _beyond(weather["whole"]) or is_seasonal
    return ClockError(
        one, other, "constant" if is_constant else "unclear" if is_unclear else "right",
        weather["whole"], weather["whole"], alignments_of_pair,
    )  # fmt: skip


def _combined(estimates: Sequence[Bounded]) -> Bounded:
    """Return the mean of estimates of the same lag, weighted by inverse variance; its bounds include their
    spread."""
    known_estimates = [estimate for estimate in estimates if estimate.known]
    if len(known_estimates) < 2:
        return known_estimates[0] if known_estimates else UNKNOWN_BOUNDS
    standard_errors = [max((estimate.high - estimate.low) / 3.92, MINUTE_S) for estimate in known_estimates]
    weights = [1.0 / estimate**2 for estimate in standard_errors]
    total_weight = sum(weights)
    mean = (
        sum(weight * estimate.value for weight, estimate in zip(weights, known_estimates, strict=True))
        / total_weight
    )
    misfit = sum(
        weight * (estimate.value - mean) ** 2
        for weight, estimate in zip(weights, known_estimates, strict=True)
    ) / (len(known_estimates) - 1)
    half_width = 1.96 * math.sqrt(max(misfit, 1.0) / total_weight)
    return Bounded(mean, mean - half_width, mean + half_width)


def _beyond(lag: Bounded, limit_s: float = TOLERANCE_S) -> bool:
    """Return whether the bounds of a lag lie beyond a limit on one side."""
    return lag.known and (lag.low > limit_s or lag.high < -limit_s)


def _off(weather: Bounded, mean_day: Bounded) -> bool:
    """Return whether the lags from weather and mean day both show a clock error."""
    if not mean_day.known:
        return _beyond(weather, 1.5 * TOLERANCE_S)
    # a day later is the same phase: a clock that is off by half a day shows either sign
    whole_days_s = DAY_S * round((weather.value - mean_day.value) / DAY_S)
    value, low, high = (lag_s + whole_days_s for lag_s in (mean_day.value, mean_day.low, mean_day.high))
    same_side = weather.value * value > 0 and (low > 0.0 or high < 0.0)
    return _beyond(weather) and same_side and abs(weather.value - value) <= APART_S


def clock_doubts(errors: Sequence[ClockError], south: bool = False) -> list[Statement]:
    """Return the clock errors and their remedies as doubts, one for each pair of sources; none for a clock
    that is right.

    south: whether the site is in the southern hemisphere, where the seasons are exchanged.
    """
    early, late = seasons(south)
    doubts = []
    for error in errors:
        winter_s, summer_s = error.corrections_s
        if error.kind == "constant":
            doubts.append(
                DoubtCode.CLOCK_RUNS(
                    source=error.one, other=error.other, pace=pace(winter_s), lag=_lag_of(error.winter),
                    needed=winter_s, remedy=state_correction(winter_s)
                )
            )  # fmt: skip
        elif error.kind == "seasonal":
            doubts.append(
                DoubtCode.CLOCK_RUNS_BY_SEASON(
                    source=error.one, other=error.other, early=early, late=late,
                    first_pace=pace(winter_s), second_pace=pace(summer_s),
                    first_lag=_lag_of(error.winter), second_lag=_lag_of(error.summer),
                    remedy=season_remedy(winter_s, summer_s, south)
                )
            )  # fmt: skip
    return doubts


def state_correction(correction_s: float) -> Statement:
    """Return the statement of the key in a case file that corrects a clock."""
    return RecordCode.STATE_CORRECTION(correction=signed_shift(correction_s).replace(" ", ""))


def seasons(south: bool) -> tuple[Statement, Statement]:
    """Return the names of the seasons outside and inside the summer time of the north, as the hemisphere
    calls them."""
    if south:
        return RecordCode.NOVEMBER_TO_MARCH(), RecordCode.APRIL_TO_OCTOBER()
    return RecordCode.IN_WINTER(), RecordCode.IN_SUMMER()


def season_remedy(winter_s: float, summer_s: float, south: bool = False) -> Statement:
    """Return the remedy for a clock that needs one correction [s] in winter and another one in summer."""
    early, late = seasons(south)
    needed = RecordCode.BY_SEASON(first=winter_s, early=early, second=summer_s, late=late)
    # the clock's summer time is the other season in the south
    change_s = winter_s - summer_s if south else summer_s - winter_s
    if abs(change_s - 3600.0) < 1.0:
        zone = () if south else (_zone(winter_s),)
        return RecordCode.CLOCK_WITHOUT_SUMMER_TIME(needed=needed, zone=zone)
    if abs(change_s + 3600.0) < 1.0:
        example = "Australia/Sydney" if south else "Europe/Berlin"
        return RecordCode.CLOCK_WITH_SUMMER_TIME(needed=needed, zone=example)
    return needed


def _zone(winter_s: float) -> Statement:
    """Return the fixed offset of the clock, from the correction [s] of its stamps in winter."""
    if winter_s == 0.0:
        return RecordCode.OFFSET_OF_WINTER()
    sign, minutes = "+" if winter_s > 0 else "-", round(abs(winter_s) / MINUTE_S)
    return RecordCode.OFFSET_OF_UTC(offset=f"{sign}{minutes // 60:02d}:{minutes % 60:02d}")


def pace(correction_s: float) -> Statement:
    """Return how a clock runs whose stamps need a correction [s]."""
    if correction_s == 0.0:
        return RecordCode.CLOCK_RIGHT()
    return (RecordCode.CLOCK_SLOW if correction_s > 0 else RecordCode.CLOCK_FAST)(by=abs(correction_s))


def _lag_of(lag: Bounded) -> Statement:
    """Return the statement of a lag with its bounds: "54 min early (48 … 60)"."""
    bounds_min = sorted(
        abs(end) / MINUTE_S if lag.low * lag.high > 0 else end / MINUTE_S for end in (lag.low, lag.high)
    )
    code = RecordCode.COMES_LATE if lag.value > 0 else RecordCode.COMES_EARLY
    return code(minutes=abs(lag.value) / MINUTE_S, low=bounds_min[0], high=bounds_min[1])
