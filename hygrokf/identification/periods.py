"""Quasi-stationary periods of a record: stretches over which temperatures and power hardly change.

A *cell* is a stretch of at least ten minutes on the power's clock.  A *period* is a run of cells over which
cabinet and ambient temperature and power stay within their tolerances.  An *episode* groups the periods of
one spell of weather, which are not independent of each other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hygrokf.data.actuators import HEATERS
from hygrokf.data.ambient import at_times
from hygrokf.data.record import Record, Series
from hygrokf.modelling.design import reading_step_h
from hygrokf.physics.holds import LINEAR
from hygrokf.physics.signal_names import ACTIVE_POWER, AMBIENT_TEMPERATURE, CABINET_TEMPERATURE

OPERATION = "operation"
STANDSTILL = "standstill"
TEMPERATURE_TOLERANCE_K = 0.5
"""[K] tolerance ± of ambient and cabinet temperature within a period (paper, text before equation 1)."""
POWER_TOLERANCE = 0.025
"""[1] tolerance ± of the power within a period, as a share of the rated power."""
CELL_S = 600.0
"""[s] shortest averaging time of the power, as in the paper's SCADA data."""
ENOUGH_PERIODS = (30, 10)
"""Numbers of periods and of episodes that a length must yield; otherwise a shorter one is tried."""
KEPT_CLASSES = 0.75
"""[1] share of the classes of power and of ambient temperature that a longer length must retain from the
shortest one."""
EPISODE_GAP_H = 12.0
"""[h] a pause of this length between periods begins a new episode."""
EPISODE_LONGEST_H = 72.0
"""[h] longest episode."""
LAGS = (1, 2, 3, 6)
"""Lags, in blocks, at which earlier inputs serve as instruments for the rough time constant."""
FEWEST_ROUGH_BLOCKS = 100
"""Fewest blocks for the rough time constant."""

Range = tuple[np.ndarray, np.ndarray]
"""Lowest and highest values (N,)."""


@dataclass(frozen=True)
class Periods:
    """Quasi-stationary periods (N,) in order of time, without overlap.

    `start_s`, `end_s` [s since 1970-01-01T00:00Z].  Means over the period: `power` P/P_rated [1],
    `difference_K` T_conv,a − T_amb, `ambient_K` T_amb.
    `change_K`: of T_conv,a from start to end.  `episode`: number of the spell of weather, from 0.
    """

    start_s: np.ndarray
    end_s: np.ndarray
    power: np.ndarray
    difference_K: np.ndarray
    ambient_K: np.ndarray
    change_K: np.ndarray
    episode: np.ndarray

    def __len__(self) -> int:
        return len(self.power)

    @property
    def n_episodes(self) -> int:
        """Number of episodes."""
        return len(np.unique(self.episode))

    @property
    def rate_K_h(self) -> np.ndarray:
        """Mean rate of change [K/h] of T_conv,a over each period."""
        return self.change_K * 3600.0 / (self.end_s - self.start_s)

    def classes(self, value: np.ndarray, width: float) -> int:
        """Return how many classes of a value (N,), of this width, occur in at least two episodes."""
        class_and_episode = np.unique(np.column_stack([np.floor(value / width), self.episode]), axis=0)
        return int((np.unique(class_and_episode[:, 0], return_counts=True)[1] > 1).sum())


@dataclass(frozen=True)
class Choice:
    """The chosen length `window_h` [h] of periods, and the periods of that length."""

    window_h: float
    periods: Periods


@dataclass(frozen=True)
class Cells:
    """Consecutive cells (N,) of a record: bounds [s], means, and whether a cell can be part of a period.

    `ranges`: lowest and highest value of cabinet, ambient and power, in units of the tolerated range.
    `change_K`, `ambient_change_K`: change of cabinet and ambient temperature from start to end.
    `running`: share of the cell with P > 0.  `regime`: 1 operation, 0 standstill, −1 mixed.
    `usable`: known throughout, and no logged heater on.
    """

    start: np.ndarray
    end: np.ndarray
    cabinet: np.ndarray
    ambient: np.ndarray
    power: np.ndarray
    running: np.ndarray
    ranges: tuple[Range, ...]
    change_K: np.ndarray
    ambient_change_K: np.ndarray
    regime: np.ndarray
    usable: np.ndarray


def has_readings(record: Record, name: str) -> bool:
    """Whether a record has at least two readings of a signal."""
    return name in record and int(np.isfinite(record[name].value).sum()) > 1


def _bridge_h(series: Series) -> float:
    """Return the longest hole [h] that a single missing reading leaves; longer holes are gaps."""
    return max(2.5 * reading_step_h(series) - series.interval_s / 3600.0, 0.0)


def cell_edges(series: Series, first: float, last: float) -> np.ndarray:
    """Return the bounds [s] of cells of about `CELL_S`, taken from the stamps of a series."""
    time = series.time[~series.missing]
    edges = np.unique(np.concatenate([time, time - series.interval_s]))
    edges = edges[(edges >= first) & (edges <= last)]
    if len(edges) == 0:
        return edges
    # rounding keeps a clock of about ten minutes intact where its stamps are a few seconds off
    return edges[np.unique(np.round((edges - edges[0]) / CELL_S), return_index=True)[1]]


def cells_between(record: Record, scale_W: float | None, edges: np.ndarray) -> Cells:
    """Return the cells between the edges [s], with exact means and ranges of each series under its own hold.

    scale_W: power that counts as 1; None: without power.
    """
    edges = edges if len(edges) > 1 else np.empty(0)
    start, end = (edges[0], edges[-1]) if len(edges) else (math.inf, -math.inf)
    heaters = [name for name in HEATERS if name in record]
    all_edges = [edges]
    for name in (CABINET_TEMPERATURE, AMBIENT_TEMPERATURE, *((ACTIVE_POWER,) if scale_W else ()), *heaters):
        for shift in {0.0, record[name].interval_s}:
            edges_of_series = record[name].time - shift
            all_edges.append(edges_of_series[(edges_of_series > start) & (edges_of_series < end)])
    fine_edges = np.unique(np.concatenate(all_edges))
    middles, lengths = 0.5 * (fine_edges[:-1] + fine_edges[1:]), np.diff(fine_edges)
    first_part, cell_length = np.searchsorted(fine_edges, edges[:-1]), np.diff(edges)

    def mean(value: np.ndarray) -> np.ndarray:
        """Return the mean in each cell of values given between the fine edges."""
        return np.add.reduceat(value * lengths, first_part) / cell_length if len(first_part) else np.empty(0)

    def course(name: str) -> tuple[np.ndarray, Range, np.ndarray]:
        """Return mean, range and change of a temperature [K] in each cell; NaN where it is unknown."""
        series, bridge_h = record[name], _bridge_h(record[name])
        value = at_times(series, middles, bridge_h)
        low = high = value
        if series.hold == LINEAR:
            ends = at_times(series, fine_edges, bridge_h)
            low, high = np.minimum(ends[:-1], ends[1:]), np.maximum(ends[:-1], ends[1:])
        cabinet_change = np.diff(at_times(series, edges, bridge_h))
        if not len(first_part):
            return np.empty(0), (np.empty(0), np.empty(0)), np.empty(0)
        return (
            mean(value),
            (np.minimum.reduceat(low, first_part), np.maximum.reduceat(high, first_part)),
            cabinet_change,
        )

    cabinet, cabinet_range, cabinet_change = course(CABINET_TEMPERATURE)
    ambient, ambient_range, ambient_change = course(AMBIENT_TEMPERATURE)
    usable = np.isfinite(sum((*cabinet_range, *ambient_range), cabinet + ambient))
    power, running = np.zeros(len(cell_length)), np.zeros(len(cell_length))
    if scale_W:
        relative_power = at_times(record[ACTIVE_POWER], middles, _bridge_h(record[ACTIVE_POWER])) / scale_W
        power, running = mean(relative_power), mean((relative_power > 0).astype(float))
        usable &= np.isfinite(power)
    for name in heaters:
        # as in `modelling.inputs.model_inputs`, a missing duty counts as 0
        usable &= ~(mean((np.nan_to_num(at_times(record[name], middles, 24.0)) > 0).astype(float)) > 0)
    width_K, power_width = 2.0 * TEMPERATURE_TOLERANCE_K, 2.0 * POWER_TOLERANCE
    ranges_and_widths = ((cabinet_range, width_K), (ambient_range, width_K), ((power, power), power_width))
    ranges = tuple((low / tolerated, high / tolerated) for (low, high), tolerated in ranges_and_widths)
    regime = np.where(running > 1.0 - 1e-9, 1, np.where(running < 1e-9, 0, -1))
    return Cells(
        edges[:-1],
        edges[1:],
        cabinet,
        ambient,
        power,
        running,
        ranges,
        cabinet_change,
        ambient_change,
        regime,
        usable,
    )


def earliest_starts(cells: Cells, longest_h: float) -> np.ndarray:
    """Return (N,) the first cell of the longest stationary run that ends with each cell; N where there is no
    run.

    longest_h: [h] longest run needed.  A run is extended backwards by 2^k cells at a time, the largest k
        first; level k of the table holds the ranges over 2^k cells.
    """
    count = len(cells.start)
    if count == 0:
        return np.empty(0, int)
    index = np.arange(count)
    slack = 1.0 + 1e-6  # readings in steps of 0.1 K that differ by 1 K do so only up to rounding
    is_steady = cells.usable & (cells.regime >= 0)
    for low, high in cells.ranges:
        is_steady &= np.nan_to_num(high - low, nan=np.inf) <= slack
    starts_anew = ~is_steady
    starts_anew[1:] |= (cells.regime[1:] != cells.regime[:-1]) | (cells.start[1:] > cells.end[:-1])
    # a run may not begin before the cell after the last unusable one or the last change of regime
    barrier = np.maximum.accumulate(np.where(starts_anew, index + (~is_steady).astype(int), 0))
    typical_h = float(np.quantile(cells.end - cells.start, 0.1)) / 3600.0
    levels = max(1, math.ceil(math.log2(longest_h / typical_h + 2.0)))
    table = [[(np.nan_to_num(low), np.nan_to_num(high)) for low, high in cells.ranges]]
    for k in range(levels - 1):
        half_width = 2**k
        next_level = []
        for low, high in table[-1]:
            next_level.append(
                (
                    np.minimum(low[:-half_width], low[half_width:]),
                    np.maximum(high[:-half_width], high[half_width:]),
                )
                if len(low) > half_width
                else (low, high)
            )
        table.append(next_level)
    start = index.copy()
    reached = [(low.copy(), high.copy()) for low, high in table[0]]
    for k in reversed(range(levels)):
        earlier_start = start - 2**k
        possible = np.flatnonzero(earlier_start >= barrier)
        if len(possible) == 0:
            continue
        grown_ranges, fits = [], np.ones(len(possible), bool)
        for (low, high), (more_low, more_high) in zip(reached, table[k], strict=True):
            new_low = np.minimum(low[possible], more_low[earlier_start[possible]])
            new_high = np.maximum(high[possible], more_high[earlier_start[possible]])
            grown_ranges.append((new_low, new_high))
            fits &= new_high - new_low <= slack
        chosen = possible[fits]
        start[chosen] = earlier_start[chosen]
        for (low, high), (new_low, new_high) in zip(reached, grown_ranges, strict=True):
            low[chosen], high[chosen] = new_low[fits], new_high[fits]
    return np.where(is_steady, start, count)


def periods_of_length(cells: Cells, earliest: np.ndarray, regime: str, window_h: float) -> Periods:
    """Return periods of at least `window_h` [h] in one regime, without overlap, placed from the end
    backwards.

    earliest: (N,) of `earliest_starts`.
    """
    in_regime = cells.regime == (1 if regime == OPERATION else 0)
    begin = np.searchsorted(cells.start, cells.end - window_h * 3600.0 + 1e-3, side="right") - 1
    possible = in_regime & (begin >= earliest)
    last_possible = np.maximum.accumulate(np.where(possible, np.arange(len(possible)), -1))
    first_and_last, last = [], len(possible) - 1
    while last >= 0 and last_possible[last] >= 0:
        end = int(last_possible[last])
        first_and_last.append((int(begin[end]), end))
        last = int(begin[end]) - 1
    first_cell, last_cell = np.array(first_and_last[::-1], int).reshape(-1, 2).T
    cell_length = cells.end - cells.start

    def total(value: np.ndarray) -> np.ndarray:
        """Return the sum over the cells of each period."""
        running = np.concatenate([[0.0], np.cumsum(np.nan_to_num(value))])
        return running[last_cell + 1] - running[first_cell]

    period_length = total(cell_length)

    def mean(value: np.ndarray) -> np.ndarray:
        """Return the mean over each period."""
        return total(value * cell_length) / period_length if len(period_length) else period_length

    return Periods(
        start_s=cells.start[first_cell],
        end_s=cells.end[last_cell],
        power=mean(cells.power),
        difference_K=mean(cells.cabinet - cells.ambient),
        ambient_K=mean(cells.ambient),
        change_K=total(cells.change_K),
        episode=_episodes(cells.start[first_cell], cells.end[last_cell]),
    )


def _episodes(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the episode number (N,) of each period.

    A new episode begins after a long pause, and where the longest duration is reached.
    """
    numbers, episode = [], -1
    episode_start = previous_end = -math.inf
    for start_s, end_s in zip(start.tolist(), end.tolist(), strict=True):
        if (
            start_s - previous_end >= EPISODE_GAP_H * 3600.0
            or end_s - episode_start > EPISODE_LONGEST_H * 3600.0
        ):
            episode, episode_start = episode + 1, start_s
        previous_end = end_s
        numbers.append(episode)
    return np.array(numbers, int)


def choose_length(
    cells: Cells, earliest: np.ndarray, regime: str, shortest_h: float, longest_h: float
) -> Choice:
    """Return the periods of the longest length up to `longest_h` [h] that still yields enough of them.

    Enough means `ENOUGH_PERIODS` periods and episodes that retain the share `KEPT_CLASSES` of the classes of
    power (tenths of the rated) and of ambient temperature (5 K) found with the shortest length.  Lengths are
    multiples of the cells' length, increasing by a quarter; where none yields enough, the shortest is taken.
    """
    cell_h = float(np.median(cells.end - cells.start)) / 3600.0 if len(cells.start) else shortest_h
    step_count = max(1, math.ceil(math.log(longest_h / shortest_h) / math.log(1.25)))
    lengths = np.geomspace(shortest_h, longest_h, step_count + 1)
    lengths = np.round(np.unique(np.ceil(lengths / cell_h - 1e-3)) * cell_h, 6)
    shortest = periods_of_length(cells, earliest, regime, float(lengths[0]))
    if len(shortest) < ENOUGH_PERIODS[0] or shortest.n_episodes < ENOUGH_PERIODS[1]:
        return Choice(float(lengths[0]), shortest)
    classes_shortest = (shortest.classes(shortest.power, 0.1), shortest.classes(shortest.ambient_K, 5.0))
    for length in lengths[:0:-1]:
        longer = periods_of_length(cells, earliest, regime, float(length))
        classes_longer = (longer.classes(longer.power, 0.1), longer.classes(longer.ambient_K, 5.0))
        has_enough = len(longer) >= ENOUGH_PERIODS[0] and longer.n_episodes >= ENOUGH_PERIODS[1]
        if has_enough and all(
            count >= KEPT_CLASSES * count_shortest
            for count, count_shortest in zip(classes_longer, classes_shortest, strict=True)
        ):
            return Choice(float(length), longer)
    return Choice(float(lengths[0]), shortest)


def rough_time_constant(cells: Cells) -> float | None:
    """Estimate (R_AT+R_IC) C [h] from all blocks of the record by two-stage least squares; None if it is not
    determined.

    The mean of equations (2) and (3) over a block of length h is exact, with Δ the change over it:

        T_conv,a − T_amb = f_ΔT − τ ΔT_conv,a/h + (1−ρ) τ ΔT_amb/h.

    Coloured disturbances of f_ΔT also change T_conv,a.  Power and ambient temperature of earlier blocks are
    independent of them and serve as instruments for ΔT_conv,a.  The result is used to choose a length and to
    settle periods; the likelihood gives the accurate value.
    """
    if len(cells.start) < FEWEST_ROUGH_BLOCKS:
        return None
    is_known = cells.usable & np.isfinite(cells.change_K + cells.ambient_change_K)
    hours = (cells.end - cells.start) / 3600.0
    drivers = [cells.running, cells.running * cells.power, cells.running * cells.power**2, cells.ambient]
    instruments_of_past = []
    for driver in (drivers[0], drivers[1], drivers[3]):
        for lag in LAGS:
            earlier = np.full(len(driver), np.nan)
            earlier[lag:] = np.where(is_known, driver, np.nan)[:-lag]
            instruments_of_past.append(earlier)
    table = np.column_stack(
        [*drivers, cells.ambient_change_K / hours, -cells.change_K / hours, *instruments_of_past]
    )
    is_complete = is_known & np.isfinite(table).all(axis=1)
    if is_complete.sum() < FEWEST_ROUGH_BLOCKS:
        return None
    table = table[is_complete] - table[is_complete].mean(axis=0)
    deviations = table.std(axis=0)
    if deviations[5] <= 0.0:
        return None
    varies = deviations > 1e-9
    table[:, varies] /= deviations[varies]
    exogenous, change = table[:, :5][:, varies[:5]], table[:, 5]
    instruments = np.column_stack([exogenous, table[:, 6:][:, varies[6:]]])
    predicted_change = instruments @ np.linalg.lstsq(instruments, change, rcond=1e-8)[0]
    design = np.column_stack([exogenous, change])
    second_stage = np.column_stack([exogenous, predicted_change])
    response = (cells.cabinet - cells.ambient)[is_complete]
    response = response - response.mean()
    inverse = np.linalg.pinv(second_stage, rcond=1e-8)
    solution = inverse @ response
    scores = inverse * (response - design @ solution)
    days = np.floor((cells.start[is_complete] - cells.start[0]) / (48 * 3600.0))
    sums_by_block = np.add.reduceat(scores[-1], np.unique(days, return_index=True)[1])
    time_constant, standard_error = (
        solution[-1] / deviations[5],
        math.sqrt(float(sums_by_block @ sums_by_block)) / deviations[5],
    )
    return float(time_constant) if time_constant > 3.0 * standard_error > 0.0 else None
