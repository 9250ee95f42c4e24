"""The gate of readings: excludes outliers and frozen readings, judged by the readings around each.

*Departed* readings (outliers) deviate from the course of the signal and return to it within `REACH_S`, alone
or as a run: power-on values, dropped bits, values of another channel.  With x_a the last accepted reading,
the deviation of reading k is

    d_k = min(|x_k − x_a|, max_j ±(x_k − x_j)),    j the readings up to `REACH_S` after k, at least one,

the smaller of the jump away from x_a and the jump back.  For a reading after a gap the deviation is its
distance from the x_j minus the range of the x_j.  The bound on d follows from the ordinary deviations of the
signal (`Scale`).  A jump without return is a step and is accepted, once a second reading confirms it.
Signals that jump between states (flags, directions, rain) are not judged.

*Frozen* readings repeat one value for longer than the signal ordinarily does (`Scale.still_s`).  Values at
which the signal rests do not count: calm, night, saturated air, power at its rated value.

Both verdicts need only the earlier readings and those of the following `REACH_S`, so that a tracker that
waits for the latter gives the same verdicts as an analysis of the whole record.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hygrokf.data.signals import signal_named

REACH_S = 1800.0
"""[s] time within which an outlier returns to the course of the signal."""
REACH_STEPS = 3.0
"""Usual intervals within which the next reading is still used, if there is none within `REACH_S`."""
DEVIATION_LEVELS = ((0.90, 8.0), (0.95, 6.5))
"""Quantiles of the deviations d > 0 of a series, and multiples of them that no ordinary deviation reaches.

The largest of 10,000 deviations with an exponential tail is four times their 90 % quantile; the second level
is for heavier tails.  Of 1.9 million measured readings (temperature, humidity, wind, power; 1 min to 1 h)
one in 14,000 exceeds both.  Up to a twentieth of the deviations may be due to bad readings.
"""
INCREMENT_MULTIPLE = 2.0
"""Multiple of the 95 % quantile of the increments that the bound on deviations reaches at least."""
FEWEST_FOR_SCALE = 50
"""Fewest readings from which a scale is estimated."""
AT_TOP = 0.995
"""Share of its highest reading above which power counts as rated power, at which it rests."""
SHORTEST_RUN = 6
"""Fewest identical readings in a row for which a sensor may be called frozen."""
QUIET_STEPS = 2.0
"""Steps of the resolution within which readings count as still."""
QUIET_LEAST = {"temperature": 0.1, "fraction": 0.005}
"""[SI unit] smallest range of still readings by dimension, even for a finer resolution."""
QUIET_SHARE = 0.005
"""Smallest range of still readings of other dimensions, as a share of the range of the series' readings."""

ACCEPTED, DEPARTED, FROZEN = range(3)
"""Verdicts on a reading."""


@dataclass(frozen=True)
class Scale:
    """Limits of the ordinary behaviour of a signal, beyond which readings are bad.

    `departure` [SI unit]: largest ordinary deviation d_k.  `still_s` [s]: longest time for which one value
    repeats. `step_s` [s]: usual interval of the readings.  `top` [SI unit]: highest reading.
    """

    departure: float
    still_s: float
    step_s: float
    top: float


@dataclass(frozen=True)
class Judgement:
    """Verdicts (T,) on readings: accepted, departed or frozen.

    `settled_s`: [s] later readings cannot change verdicts up to this time.
    """

    verdict: np.ndarray
    settled_s: float


def scale_of(signal: str, time: np.ndarray, value: np.ndarray, resolution: float = 0.0) -> Scale | None:
    """Estimate the ordinary behaviour of a signal from its readings, some of which may be bad.

    time: [s] (T,) increasing.
    value: [SI unit] (T,), no NaN.
    resolution: [SI unit] of the readings, or 0.
    None for too few readings, and for signals that jump between states.
    """
    signal_row = signal_named(signal)
    if len(value) < FEWEST_FOR_SCALE or signal_row.idle == (-math.inf, math.inf):
        return None
    step = float(np.median(np.diff(time)))
    departures = _departures(time, value, _reach_s(step))
    departures = departures[departures > 0.0]
    if len(departures) >= FEWEST_FOR_SCALE // 5:
        departure = max(
            float(factor * np.quantile(departures, quantile)) for quantile, factor in DEVIATION_LEVELS
        )
    else:  # hardly any deviations: the range of all readings and the sensor's error are ordinary
        departure = max(float(np.ptp(value)), DEVIATION_LEVELS[0][1] * (signal_row.default_accuracy or 0.0))
    ordinary_step = INCREMENT_MULTIPLE * float(np.quantile(np.abs(np.diff(value)), 0.95))
    departure = max(departure, ordinary_step, DEVIATION_LEVELS[0][1] * resolution)
    top = float(value.max())
    longest_still_run = longest_still(
        value, quiet_range(signal, value, resolution), resting(signal, value, top)
    )
    return Scale(departure, longest_still_run * step, step, top) if departure > 0.0 else None


def judge(
    signal: str,
    time: np.ndarray,
    value: np.ndarray,
    scale: Scale,
    known_until_s: float = math.inf,
    in_hindsight: bool = False,
) -> Judgement:
    """Return the verdicts on readings: accepted, departed (outliers) or frozen.

    time: [s] (T,) increasing.
    value: [SI unit] (T,), no NaN.
    scale: of the signal.
    known_until_s: [s] no further reading with a stamp up to this time will come.
    in_hindsight: whether a frozen run counts from its second reading on, or only from when it is too long.
    """
    verdict = np.zeros(len(value), dtype=np.int8)
    settled_s = known_until_s
    if len(value):
        settled_s = _judge_departures(time, value, scale, known_until_s, verdict)
    longest_run = scale.still_s / scale.step_s + 1e-6
    if len(value) > longest_run:
        # a tracker forgets the readings before a gap
        starts, lengths = runs_of(value, False if in_hindsight else gaps(time, scale.step_s))
        position = np.arange(len(value)) - np.repeat(starts, lengths)
        run_length = np.repeat(lengths, lengths) if in_hindsight else position + 1
        is_too_late = (run_length > longest_run) & (position > 0) & ~resting(signal, value, scale.top)
        verdict[is_too_late & (verdict == ACCEPTED)] = FROZEN
    return Judgement(verdict, settled_s)


def _judge_departures(
    time: np.ndarray, value: np.ndarray, scale: Scale, known_until_s: float, verdict: np.ndarray
) -> float:
    """Mark outliers in `verdict` (T,); returns the time [s] up to which later readings cannot change it."""
    settled_s = known_until_s
    bound = scale.departure
    # a reading after a gap has no recent predecessor: it is compared with all readings that follow
    after_gap = gaps(time, scale.step_s)
    judged_until = 0
    for jump_index in (np.flatnonzero(np.abs(np.diff(value)) > bound) + 1).tolist():
        if jump_index < judged_until or after_gap[jump_index]:
            continue
        if after_gap[jump_index - 1]:
            end_of_window, known_needed_s = _after(time, jump_index - 1, scale.step_s)
            if known_needed_s > known_until_s:
                settled_s = min(settled_s, _before(time[jump_index - 1]))
            following_values = value[jump_index:end_of_window]
            if np.abs(following_values - value[jump_index - 1]).min() > bound + np.ptp(following_values):
                verdict[jump_index - 1] = DEPARTED
                continue
        index, last_accepted = jump_index, value[jump_index - 1]
        while index < len(value) and abs(value[index] - last_accepted) > bound:
            end_of_window, known_needed_s = _after(time, index, scale.step_s)
            if known_needed_s > known_until_s:
                settled_s = min(settled_s, _before(time[index]))
            jumps_back = math.copysign(1.0, value[index] - last_accepted) * (
                value[index] - value[index + 1 : end_of_window]
            )
            if len(jumps_back) and jumps_back.max() <= bound:
                break  # a jump without return is a step
            verdict[index] = DEPARTED
            index += 1
        judged_until = index + 1
    return settled_s


def _before(time_s: float) -> float:
    """Return the largest number below a time."""
    return float(np.nextafter(time_s, -math.inf))


def _after(time: np.ndarray, index: int, step_s: float) -> tuple[int, float]:
    """Return which readings after `index` are used to judge it.

    Returns the end of these readings, and the time [s] up to which all readings must be known.
    """
    until_s = time[index] + _reach_s(step_s)
    end = int(np.searchsorted(time, until_s, side="right"))
    if end > index + 1:
        return end, until_s
    latest_s = max(until_s, time[index] + REACH_STEPS * step_s)
    if index + 1 < len(time) and time[index + 1] <= latest_s:
        return index + 2, time[index + 1]
    return index + 1, latest_s


def _reach_s(step_s: float) -> float:
    """Time [s] within which an outlier returns, with half an interval added for jitter of the stamps."""
    return REACH_S + 0.5 * step_s


def _departures(time: np.ndarray, value: np.ndarray, reach_s: float) -> np.ndarray:
    """Return the deviation d_k (T,) of every reading, taking the previous reading as accepted; 0 at both
    ends."""
    count = len(value)
    start = np.arange(count) + 1
    end = np.searchsorted(time, time + reach_s, side="right")
    lowest, highest = _extremes(value, start, np.minimum(np.maximum(end, start + 1), count))
    rise = np.diff(value, prepend=value[:1])
    fall_back = np.where(rise > 0.0, value - lowest, highest - value)
    return np.nan_to_num(np.maximum(np.minimum(np.abs(rise), fall_back), 0.0))


def _extremes(value: np.ndarray, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and largest values (N,) in windows from `start` to before `end` (N,); NaN for empty
    ones."""
    length = end - start
    lowest, highest = np.full(len(start), np.nan), np.full(len(start), np.nan)
    window_minima = window_maxima = value
    width = 1
    while width <= length.max(initial=0):  # extremes of windows from those of two halves that may overlap
        has_width = (length >= width) & (length < 2 * width)
        first_half, second_half = start[has_width], end[has_width] - width
        lowest[has_width] = np.minimum(window_minima[first_half], window_minima[second_half])
        highest[has_width] = np.maximum(window_maxima[first_half], window_maxima[second_half])
        if 2 * width > len(value):
            break
        window_minima = np.minimum(window_minima[:-width], window_minima[width:])
        window_maxima = np.maximum(window_maxima[:-width], window_maxima[width:])
        width *= 2
    return lowest, highest


# -- frozen readings -----------------------------------------------------------------------------------------
def gaps(time: np.ndarray, step_s: float) -> np.ndarray:
    """Return (T,) True for readings after a gap and for the first reading."""
    return np.append(True, np.diff(time) > max(REACH_S, REACH_STEPS * step_s))


def runs_of(value: np.ndarray, begins: np.ndarray | bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return the starts and lengths of the runs of identical readings.

    begins: (T,) True where a new run must begin.
    """
    starts = np.flatnonzero(begins | np.append(True, np.diff(value) != 0.0))
    return starts, np.diff(np.append(starts, len(value)))


def resting(signal: str, value: np.ndarray, top: float) -> np.ndarray:
    """Return (T,) True for readings in the range in which unchanged values are ordinary; for power also near
    `top`."""
    idle = signal_named(signal).idle
    is_resting = np.zeros(len(value), bool) if idle is None else (value >= idle[0]) & (value <= idle[1])
    return is_resting | (value >= AT_TOP * top) if signal_named(signal).dimension == "power" else is_resting


def quiet_range(signal: str, value: np.ndarray, resolution: float) -> float:
    """Return the range [SI unit] within which readings count as still.

    It has a minimum, because means of readings on a coarse grid lie on a finer grid.
    """
    low, high = np.quantile(value, (0.005, 0.995))
    least = QUIET_LEAST.get(signal_named(signal).dimension, QUIET_SHARE * float(high - low))
    return max(QUIET_STEPS * resolution, least) * (1.0 + 1e-6)


def longest_still(value: np.ndarray, quiet: float, resting: np.ndarray) -> int:
    """Return the length, in readings, of the longest run of identical readings that is ordinary for the
    signal.

    quiet: range of still readings.  resting: (T,) whether unchanged values are ordinary.

    A run is not ordinary if it is more than twice as long as the 99th percentile of the runs, and longer than
    every other stretch whose readings stay within `quiet` without being all equal.  Runs of a coarse sensor
    in still weather are thus ordinary.
    """
    starts, lengths = runs_of(value)
    idle = resting[starts]
    long_run = np.quantile(lengths[~idle], 0.99) if (~idle).any() else 0.0
    ordinary = max(SHORTEST_RUN - 1, int(2.0 * long_run))
    discarded = np.zeros(len(value), dtype=bool)
    while True:
        candidates = ~idle & (lengths > ordinary) & ~discarded[starts]
        if not candidates.any():
            return ordinary
        length = int(lengths[candidates].max())
        # neither the run itself nor a run of similar length may count as the quiet stretch: all of them are
        # cut in the middle
        cut = discarded.copy()
        similar_runs = ~idle & (lengths >= 0.8 * length)
        cut[starts[similar_runs] + lengths[similar_runs] // 2] = True
        if _quiet_stretch(value, length, quiet, cut):
            return length
        for run in np.flatnonzero(candidates & (lengths == length)):
            discarded[starts[run] : starts[run] + lengths[run]] = True


def _quiet_stretch(value: np.ndarray, length: int, quiet: float, cut: np.ndarray) -> bool:
    """Whether some window of `length` readings stays within `quiet`, without being constant or containing a
    cut (T,)."""
    count = len(value) - length + 1
    if count <= 0:
        return False
    low, high = _extremes(value, np.arange(count), np.arange(count) + length)
    total = np.append(0, np.cumsum(cut))
    uncut = total[length : length + count] == total[:count]
    spread = high - low
    return bool(np.any((spread <= quiet) & (spread > 0.0) & uncut))
