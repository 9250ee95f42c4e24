"""The path of an input between its readings: instants, interval means, and sensors with a response time.

An input is read as instants or as means over intervals, but the filter needs it at every time.  Its path is
modelled as Brownian with noisy readings,

    u(t+Δ) = u(t) + N(0, q Δ),    reading = u, or the mean of u over its interval, + N(0, r),

and the filter is given the mean of that path conditional on the surrounding readings.  Between instants this
path is straight.  Through interval means it is a quadratic in every interval that keeps the interval's mean
(the derivative of the cubic spline through the cumulative means).  Two means on either side of an edge
determine its value to within 1 % of the variance that all means would give (`edge_weights`), so a path
depends only on the readings around it.  The quadratic is approximated by straight pieces of at most a quarter
of an hour, which keep the interval's mean too.

Joining the middles of intervals by straight lines, as is often done, smooths the input once more and makes
the cabinet appear faster: by 8 % (ten-minute means) and 22 % (hourly means) for a hygric time constant of
half an hour.

A sensor with the response time θ reads dy/dt = (u − y)/θ, so its input is u = y + θ dy/dt.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from hygrokf.data.record import Series
from hygrokf.data.timestamps import DAY_S, modal_step
from hygrokf.physics.holds import LINEAR, MEAN

AROUND = 2
"""Number of means on each side of an edge that determine its value."""
JOINED_S = 1.0
"""[s] intervals are adjacent if their edges are closer than this; a held value takes this long to change."""
PIECE_S = 900.0
"""[s] longest straight piece of a path within an interval; there are at least two pieces."""
SLOPE_REACH_S = 6 * 3600.0
"""[s] no derivative is computed between readings farther apart than this."""


def on_change(time: np.ndarray, value: np.ndarray, resolution: float = 0.0) -> bool:
    """Whether readings (N,) are logged only when the value changes: at irregular times [s], no two in a row
    equal.

    resolution: grid of the values; 0 for a switched signal, whose regular readings nearly always repeat.  A
        measured value repeats at least as often as it moves one step up, or one step down.  The probability
        that m such readings never repeat is at most (2/3)^m, and must be below 0.001.
    """
    is_present = np.isfinite(value)
    steps = np.abs(np.diff(value[is_present]))
    if len(steps) < 2 or not steps.all() or modal_step(time[is_present])[1] > 0.5:
        return False
    return resolution == 0.0 or bool((2.0 / 3.0) ** np.count_nonzero(steps < 1.5 * resolution) < 1e-3)


def input_path(series: Series, noise: tuple[float, float] | None = None) -> Series:
    """Return the most likely path given the readings, as a series of straight pieces.

    noise: (q [unit²/s], r [unit²]) of means to be smoothed; noisy instants are smoothed beforehand
        (`ambient.smoothed`).

    Missing readings end a stretch of adjacent means.  A mean without neighbours is placed in the middle of
    its interval, and so are means whose intervals overlap.  A held value replaces the previous one within
    `JOINED_S` after its stamp.
    """
    if series.hold == LINEAR:
        return series
    return _path_through_means(series, noise) if series.hold == MEAN else _path_of_held_values(series)


def without_response(series: Series) -> Series:
    """Return the readings y corrected for the sensor's stated response time θ: y + θ dy/dt.

    The derivative is the difference quotient of the two neighbours.  A series without a stated response time,
    or with one of 0, is returned unchanged.
    """
    response_s = series.response_time_s or 0.0
    time, value = series.known
    if response_s <= 0 or len(time) < 2:
        return series
    index = np.arange(len(time))
    previous_index, next_index = np.maximum(index - 1, 0), np.minimum(index + 1, len(time) - 1)
    previous_index = np.where(time - time[previous_index] > SLOPE_REACH_S, index, previous_index)
    next_index = np.where(time[next_index] - time > SLOPE_REACH_S, index, next_index)
    time_difference = time[next_index] - time[previous_index]
    slope = (value[next_index] - value[previous_index]) / np.where(
        time_difference > 0, time_difference, np.inf
    )
    result = series.value.copy()
    result[~series.missing] = value + response_s * slope
    return replace(series, value=result, response_time_s=0.0)


def centred(series: Series) -> Series:
    """Return the series with interval means moved to the middle of their interval; others are unchanged."""
    if series.hold != MEAN:
        return series
    return replace(series, time=series.time - 0.5 * series.interval_s, hold=LINEAR, interval_s=0.0)


def thinned(series: Series) -> Series:
    """Return the series with half as many readings: every second instant, or means over pairs of adjacent
    intervals."""
    if series.interval_s <= 0:
        return replace(series, time=series.time[::2], value=series.value[::2])
    count = len(series) // 2
    first_time, second_time = series.time[: 2 * count : 2], series.time[1 : 2 * count : 2]
    adjacent = np.abs(second_time - first_time - series.interval_s) <= JOINED_S
    mean = 0.5 * (series.value[: 2 * count : 2] + series.value[1 : 2 * count : 2])
    return replace(
        series, time=second_time[adjacent], value=mean[adjacent], interval_s=2.0 * series.interval_s
    )


def readings_ahead(interval_s: float, response_time_s: float) -> int:
    """Return how many readings, after the next one, the path at a time depends on."""
    return (AROUND if interval_s > 0 else 0) + (1 if response_time_s > 0 else 0)


@cache
def edge_weights(before: int, after: int, noise_share: float = 0.0) -> np.ndarray:
    """Return the weights (before+after,) of adjacent interval means in the path's value at the edge between
    them.

    noise_share: r/(q Δ).  With two means on each side and no noise −1/8, 5/8, 5/8, −1/8.
    """
    return _weights(before + after, float(before), None, noise_share)


@cache
def mean_weights(before: int, after: int, noise_share: float) -> np.ndarray:
    """Return the weights (before+1+after,) of adjacent means in the noise-free mean of one interval."""
    return _weights(before + 1 + after, 0.0, before, noise_share)


def _weights(count: int, edge: float, block: int | None, noise_share: float) -> np.ndarray:
    """Return the weights of means over adjacent unit intervals in one value of the path.

    edge: position of the value.  block: number of the interval whose mean is wanted instead, or None.

    The start of the path is unknown, so the weights sum to 1 (ordinary kriging).
    """
    index = np.arange(count)
    # covariance (n, n) of the means of a Brownian path that starts at 0 with q = 1
    covariance = np.minimum.outer(index, index) + 0.5
    np.fill_diagonal(covariance, index + 1.0 / 3.0)
    target_covariance = covariance[block] if block is not None else np.minimum(index + 0.5, edge)
    system = np.ones((count + 1, count + 1))
    system[:count, :count] = covariance + noise_share * np.eye(count)
    system[count, count] = 0.0
    return np.linalg.solve(system, np.append(target_covariance, 1.0))[:count]


def _path_of_held_values(series: Series) -> Series:
    """Return the path of values that hold from their stamps on: constant, with steep pieces after the
    changes."""
    time, value, longest_s = series.held
    if not len(time):
        return series
    time_to_next = np.append(np.diff(time), np.inf)
    longest_s = np.minimum(longest_s, 30 * DAY_S)  # a path has an end
    ends_hold = time_to_next > longest_s
    is_change = np.append(False, (value[1:] != value[:-1]) & ~ends_hold[:-1])
    change_time_s = np.minimum(JOINED_S, 0.5 * np.minimum(time_to_next, longest_s))
    times = np.concatenate(
        [time[is_change], time + np.where(is_change, change_time_s, 0.0), (time + longest_s)[ends_hold]]
    )
    time_order = np.argsort(times, kind="stable")
    values = np.concatenate([value[np.flatnonzero(is_change) - 1], value, value[ends_hold]])
    return replace(
        series, time=times[time_order], value=values[time_order], hold=LINEAR, longest_hold_s=None, lost=()
    )


def _path_through_means(series: Series, noise: tuple[float, float] | None) -> Series:
    """Return the path through interval means, with the noise (q, r) of the means removed."""
    time, value = series.known
    interval_s = series.interval_s
    if len(time) < 2:
        return centred(series)
    gap_s = np.diff(time) - interval_s
    noise_share = 0.0 if noise is None else noise[1] / (noise[0] * interval_s)
    if np.any(gap_s < -JOINED_S):  # running means overlap and have no edges
        return replace(centred(series), time=time - 0.5 * interval_s, value=value)
    times_of_stretches, values_of_stretches = [], []
    for adjacent in np.split(np.arange(len(time)), np.flatnonzero(gap_s > JOINED_S) + 1):
        stretch_times, stretch_values = _nodes_of_stretch(
            time[adjacent], value[adjacent], interval_s, noise_share
        )
        times_of_stretches.append(stretch_times)
        values_of_stretches.append(stretch_values)
    path_time, path_value = np.concatenate(times_of_stretches), np.concatenate(values_of_stretches)
    is_new = np.append(True, np.diff(path_time) > JOINED_S)
    return replace(series, time=path_time[is_new], value=path_value[is_new], hold=LINEAR, interval_s=0.0)


def _nodes_of_stretch(
    time: np.ndarray, mean: np.ndarray, interval_s: float, noise_share: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and values of the path's nodes through adjacent interval means (n,).

    time: [s] (n,) ends of the intervals.  noise_share: r/(q Δ).
    """
    count = len(mean)
    if count == 1:
        return time - 0.5 * interval_s, mean
    edges = np.empty(count + 1)
    for k in {*range(min(AROUND, count + 1)), *range(max(count + 1 - AROUND, 0), count + 1)}:
        before, after = min(k, AROUND), min(count - k, AROUND)
        edges[k] = edge_weights(before, after, noise_share) @ mean[k - before : k + after]
    inner_edges = np.arange(AROUND, count + 1 - AROUND)
    edges[inner_edges] = sum(
        w * mean[inner_edges - AROUND + i] for i, w in enumerate(edge_weights(AROUND, AROUND, noise_share))
    )
    interval_mean = mean if noise_share == 0.0 else _denoise_means(mean, noise_share)
    # n straight pieces between points of the quadratic would lose 1/n² of the area above its chord
    piece_count = max(2, math.ceil(interval_s / PIECE_S))
    fractions = np.arange(piece_count) / piece_count
    peak = 1.5 * (interval_mean - 0.5 * (edges[1:] + edges[:-1])) / (1.0 - piece_count**-2.0)
    nodes = edges[:-1, None] * (1.0 - fractions) + edges[1:, None] * fractions
    nodes += peak[:, None] * (4.0 * fractions * (1.0 - fractions))
    times = (time - interval_s)[:, None] + interval_s * fractions
    return np.append(times.ravel(), time[-1]), np.append(nodes.ravel(), edges[-1])


def _denoise_means(mean: np.ndarray, noise_share: float) -> np.ndarray:
    """Return the interval means (n,) without their noise."""
    count = len(mean)
    result = np.empty(count)
    for k in range(count):
        before, after = min(k, AROUND), min(count - 1 - k, AROUND)
        result[k] = mean_weights(before, after, noise_share) @ mean[k - before : k + after + 1]
    return result
