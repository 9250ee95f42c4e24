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
    """Limits of the ordinary behaviour of a signal.

    `departure` [SI unit]: largest deviation d_k; `still_s` [s]: longest time for which one value repeats;
    `step_s` [s]: usual interval of the readings; `top` [SI unit]: highest reading.
    """

    departure: float
    still_s: float
    step_s: float
    top: float


@dataclass(frozen=True)
class Judgement:
    """Verdicts (T,) on readings, and the time [s] up to which later readings cannot change them."""

    verdict: np.ndarray
    settled_s: float


def scale_of(signal: str, time: np.ndarray, value: np.ndarray, resolution: float = 0.0) -> Scale | None:
    """The scale of a signal from its readings, which may include bad ones; None for too few readings, and for
    signals that jump between states.

    time: [s] (T,) increasing; value: [SI unit] (T,), no NaN; resolution: [SI unit] of the readings, or 0.
    """
    row = signal_named(signal)
    if len(value) < FEWEST_FOR_SCALE or row.idle == (-math.inf, math.inf):
        return None
    step = float(np.median(np.diff(time)))
    departures = _departures(time, value, _reach_s(step))
    departures = departures[departures > 0.0]
    if len(departures) >= FEWEST_FOR_SCALE // 5:
        departure = max(float(factor * np.quantile(departures, share)) for share, factor in DEVIATION_LEVELS)
    else:  # hardly any deviations: the range of all readings and the sensor's error are ordinary
        departure = max(float(np.ptp(value)), DEVIATION_LEVELS[0][1] * (row.default_accuracy or 0.0))
    ordinary = INCREMENT_MULTIPLE * float(np.quantile(np.abs(np.diff(value)), 0.95))
    departure = max(departure, ordinary, DEVIATION_LEVELS[0][1] * resolution)
    top = float(value.max())
    still = longest_still(value, quiet_range(signal, value, resolution), resting(signal, value, top))
    return Scale(departure, still * step, step, top) if departure > 0.0 else None


def judge(
    signal: str,
    time: np.ndarray,
    value: np.ndarray,
    scale: Scale,
    known_until_s: float = math.inf,
    in_hindsight: bool = False,
) -> Judgement:
    """The verdicts on readings.

    time: [s] (T,) increasing; value: [SI unit] (T,), no NaN; scale: of the signal.
    known_until_s: [s] no further reading with a stamp up to this time will come.
    in_hindsight: whether a frozen run counts from its second reading on, or only from when it is too long.
    """
    verdict = np.zeros(len(value), dtype=np.int8)
    settled_s = known_until_s
    if len(value):
        settled_s = _judge_departures(time, value, scale, known_until_s, verdict)
    still = scale.still_s / scale.step_s + 1e-6
    if len(value) > still:
        # a tracker forgets the readings before a gap
        starts, lengths = runs_of(value, False if in_hindsight else gaps(time, scale.step_s))
        position = np.arange(len(value)) - np.repeat(starts, lengths)
        run_length = np.repeat(lengths, lengths) if in_hindsight else position + 1
        late = (run_length > still) & (position > 0) & ~resting(signal, value, scale.top)
        verdict[late & (verdict == ACCEPTED)] = FROZEN
    return Judgement(verdict, settled_s)


def _judge_departures(
    time: np.ndarray, value: np.ndarray, scale: Scale, known_until_s: float, verdict: np.ndarray
) -> float:
    """Mark outliers in `verdict`; returns the time up to which later readings cannot change it [s]."""
    settled_s = known_until_s
    bound = scale.departure
    # a reading after a gap has no recent predecessor: it is compared with all readings that follow
    after_gap = gaps(time, scale.step_s)
    judged_until = 0
    for jump in (np.flatnonzero(np.abs(np.diff(value)) > bound) + 1).tolist():
        if jump < judged_until or after_gap[jump]:
            continue
        if after_gap[jump - 1]:
            end, needed_s = _after(time, jump - 1, scale.step_s)
            if needed_s > known_until_s:
                settled_s = min(settled_s, _before(time[jump - 1]))
            following = value[jump:end]
            if np.abs(following - value[jump - 1]).min() > bound + np.ptp(following):
                verdict[jump - 1] = DEPARTED
                continue
        k, last_accepted = jump, value[jump - 1]
        while k < len(value) and abs(value[k] - last_accepted) > bound:
            end, needed_s = _after(time, k, scale.step_s)
            if needed_s > known_until_s:
                settled_s = min(settled_s, _before(time[k]))
            returns = math.copysign(1.0, value[k] - last_accepted) * (value[k] - value[k + 1 : end])
            if len(returns) and returns.max() <= bound:
                break  # a jump without return is a step
            verdict[k] = DEPARTED
            k += 1
        judged_until = k + 1
    return settled_s


def _before(time_s: float) -> float:
    return float(np.nextafter(time_s, -math.inf))


def _after(time: np.ndarray, k: int, step_s: float) -> tuple[int, float]:
    """The end of the readings after k by which reading k is judged, and the time [s] up to which all readings
    must be known."""
    until_s = time[k] + _reach_s(step_s)
    end = int(np.searchsorted(time, until_s, side="right"))
    if end > k + 1:
        return end, until_s
    latest_s = max(until_s, time[k] + REACH_STEPS * step_s)
    if k + 1 < len(time) and time[k + 1] <= latest_s:
        return k + 2, time[k + 1]
    return k + 1, latest_s


def _reach_s(step_s: float) -> float:
    """Time [s] within which an outlier returns, with half an interval added for jitter of the stamps."""
    return REACH_S + 0.5 * step_s


def _departures(time: np.ndarray, value: np.ndarray, reach_s: float) -> np.ndarray:
    """d_k (T,) of every reading, with the previous reading as the last accepted one; 0 at both ends."""
    count = len(value)
    start = np.arange(count) + 1
    end = np.searchsorted(time, time + reach_s, side="right")
    low, high = _extremes(value, start, np.minimum(np.maximum(end, start + 1), count))
    rise = np.diff(value, prepend=value[:1])
    fall_back = np.where(rise > 0.0, value - low, high - value)
    return np.nan_to_num(np.maximum(np.minimum(np.abs(rise), fall_back), 0.0))


def _extremes(value: np.ndarray, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest values (N,) of windows from `start` to before `end` (N,); NaN for empty ones."""
    length = end - start
    low, high = np.full(len(start), np.nan), np.full(len(start), np.nan)
    window_minima = window_maxima = value
    width = 1
    while width <= length.max(initial=0):  # extremes of windows from those of two halves that may overlap
        fits = (length >= width) & (length < 2 * width)
        first, second = start[fits], end[fits] - width
        low[fits] = np.minimum(window_minima[first], window_minima[second])
        high[fits] = np.maximum(window_maxima[first], window_maxima[second])
        if 2 * width > len(value):
            break
        window_minima = np.minimum(window_minima[:-width], window_minima[width:])
        window_maxima = np.maximum(window_maxima[:-width], window_maxima[width:])
        width *= 2
    return low, high


# -- frozen readings -----------------------------------------------------------------------------------------
def gaps(time: np.ndarray, step_s: float) -> np.ndarray:
    """True (T,) for readings after a gap and for the first reading."""
    return np.append(True, np.diff(time) > max(REACH_S, REACH_STEPS * step_s))


def runs_of(value: np.ndarray, begins: np.ndarray | bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Starts and lengths of the runs of identical readings; `begins` (T,) True where a run must begin."""
    starts = np.flatnonzero(begins | np.append(True, np.diff(value) != 0.0))
    return starts, np.diff(np.append(starts, len(value)))


def resting(signal: str, value: np.ndarray, top: float) -> np.ndarray:
    """True (T,) for readings in the range in which the signal rests; power also rests at `top`."""
    idle = signal_named(signal).idle
    is_resting = np.zeros(len(value), bool) if idle is None else (value >= idle[0]) & (value <= idle[1])
    return is_resting | (value >= AT_TOP * top) if signal_named(signal).dimension == "power" else is_resting


def quiet_range(signal: str, value: np.ndarray, resolution: float) -> float:
    """Range within which readings count as still [SI unit].

    The range has a minimum, because means of readings on a coarse grid lie on a finer grid.
    """
    low, high = np.quantile(value, (0.005, 0.995))
    least = QUIET_LEAST.get(signal_named(signal).dimension, QUIET_SHARE * float(high - low))
    return max(QUIET_STEPS * resolution, least) * (1.0 + 1e-6)


def longest_still(value: np.ndarray, quiet: float, resting: np.ndarray) -> int:
    """Longest ordinary run of identical readings of the signal, in readings.

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
    """Whether some window of `length` readings stays within `quiet` without being constant or cut."""
    count = len(value) - length + 1
    if count <= 0:
        return False
    low, high = _extremes(value, np.arange(count), np.arange(count) + length)
    total = np.append(0, np.cumsum(cut))
    uncut = total[length : length + count] == total[:count]
    spread = high - low
    return bool(np.any((spread <= quiet) & (spread > 0.0) & uncut))
