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
"""Periods and episodes that a length of period must yield; otherwise a shorter one is tried."""
KEPT_CLASSES = 0.75
"""[1] share of the classes of power and of ambient temperature that a longer length must retain from the
shortest one."""
EPISODE_GAP_H = 12.0
"""[h] a pause of this length between periods begins a new episode."""
EPISODE_LONGEST_H = 72.0
"""[h] longest episode."""
LAGS = (1, 2, 3, 6)
"""Lags, in blocks, of the instruments of the rough time constant."""
FEWEST_ROUGH_BLOCKS = 100
"""Fewest blocks for the rough time constant."""

Range = tuple[np.ndarray, np.ndarray]
"""Lowest and highest values (N,)."""


@dataclass(frozen=True)
class Periods:
    """Quasi-stationary periods (N,), one point each, in order of time and without overlap.

    `start_s`, `end_s` [s] since 1970-01-01T00:00Z; means over the period: `power` P/P_rated [1],
    `difference_K` T_conv,a − T_amb, `ambient_K` T_amb; `change_K` of T_conv,a from start to end; `episode`
    numbers from 0.
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
        """Mean rate of change of T_conv,a over each period [K/h]."""
        return self.change_K * 3600.0 / (self.end_s - self.start_s)

    def classes(self, value: np.ndarray, width: float) -> int:
        """Classes of a value (N,), with this width, that occur in at least two episodes."""
        met = np.unique(np.column_stack([np.floor(value / width), self.episode]), axis=0)
        return int((np.unique(met[:, 0], return_counts=True)[1] > 1).sum())


@dataclass(frozen=True)
class Choice:
    """Periods of the chosen length `window_h` [h]."""

    window_h: float
    periods: Periods


@dataclass(frozen=True)
class Cells:
    """Consecutive cells (N,): bounds [s], means, and the properties that decide whether a cell can be part of
    a period.

    `ranges` lowest and highest value of (cabinet, ambient, power), in units of the tolerated range;
    `change_K` and `ambient_change_K` of the cabinet and ambient temperature from start to end; `running`
    share of the cell with P > 0; `regime` 1 in operation, 0 at standstill, -1 mixed; `usable` known
    throughout, with no logged heater on.
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
    """Longest hole that one missing reading leaves [h]; longer holes are gaps."""
    return max(2.5 * reading_step_h(series) - series.interval_s / 3600.0, 0.0)


def cell_edges(series: Series, first: float, last: float) -> np.ndarray:
    """Bounds of cells on a series' own clock [s], thinned to about `CELL_S`."""
    time = series.time[~series.missing]
    edges = np.unique(np.concatenate([time, time - series.interval_s]))
    edges = edges[(edges >= first) & (edges <= last)]
    if len(edges) == 0:
        return edges
    # rounding keeps a clock of about ten minutes intact where its stamps are a few seconds off
    return edges[np.unique(np.round((edges - edges[0]) / CELL_S), return_index=True)[1]]


def cells_between(record: Record, scale_W: float | None, edges: np.ndarray) -> Cells:
    """The cells between the edges, with exact means and ranges of each course under its own hold."""
    edges = edges if len(edges) > 1 else np.empty(0)
    first, last = (edges[0], edges[-1]) if len(edges) else (math.inf, -math.inf)
    heaters = [name for name in HEATERS if name in record]
    knots = [edges]
    for name in (CABINET_TEMPERATURE, AMBIENT_TEMPERATURE, *((ACTIVE_POWER,) if scale_W else ()), *heaters):
        for shift in {0.0, record[name].interval_s}:
            knot = record[name].time - shift
            knots.append(knot[(knot > first) & (knot < last)])
    fine = np.unique(np.concatenate(knots))
    middle, length = 0.5 * (fine[:-1] + fine[1:]), np.diff(fine)
    begin, span = np.searchsorted(fine, edges[:-1]), np.diff(edges)

    def mean(value: np.ndarray) -> np.ndarray:
        return np.add.reduceat(value * length, begin) / span if len(begin) else np.empty(0)

    def course(name: str) -> tuple[np.ndarray, Range, np.ndarray]:
        """Mean, range and change of a temperature in each cell [K]; NaN where it is unknown."""
        series, bridge_h = record[name], _bridge_h(record[name])
        value = at_times(series, middle, bridge_h)
        low = high = value
        if series.hold == LINEAR:
            ends = at_times(series, fine, bridge_h)
            low, high = np.minimum(ends[:-1], ends[1:]), np.maximum(ends[:-1], ends[1:])
        change = np.diff(at_times(series, edges, bridge_h))
        if not len(begin):
            return np.empty(0), (np.empty(0), np.empty(0)), np.empty(0)
        return mean(value), (np.minimum.reduceat(low, begin), np.maximum.reduceat(high, begin)), change

    cabinet, cabinet_range, change = course(CABINET_TEMPERATURE)
    ambient, ambient_range, ambient_change = course(AMBIENT_TEMPERATURE)
    usable = np.isfinite(sum((*cabinet_range, *ambient_range), cabinet + ambient))
    power, running = np.zeros(len(span)), np.zeros(len(span))
    if scale_W:
        relative = at_times(record[ACTIVE_POWER], middle, _bridge_h(record[ACTIVE_POWER])) / scale_W
        power, running = mean(relative), mean((relative > 0).astype(float))
        usable &= np.isfinite(power)
    for name in heaters:
        # as in `modelling.inputs.model_inputs`, a missing duty counts as 0
        usable &= ~(mean((np.nan_to_num(at_times(record[name], middle, 24.0)) > 0).astype(float)) > 0)
    width_K, width = 2.0 * TEMPERATURE_TOLERANCE_K, 2.0 * POWER_TOLERANCE
    spans = ((cabinet_range, width_K), (ambient_range, width_K), ((power, power), width))
    ranges = tuple((low / tolerated, high / tolerated) for (low, high), tolerated in spans)
    regime = np.where(running > 1.0 - 1e-9, 1, np.where(running < 1e-9, 0, -1))
    return Cells(
        edges[:-1],
        edges[1:],
        cabinet,
        ambient,
        power,
        running,
        ranges,
        change,
        ambient_change,
        regime,
        usable,
    )


def earliest_starts(cells: Cells, longest_h: float) -> np.ndarray:
    """First cell (N,) of the longest stationary run that ends with each cell; N where the cell is in no run.

    The reach doubles: level k holds the ranges over 2^k cells, and a run takes every level that fits, from
    the highest down.
    """
    count = len(cells.start)
    if count == 0:
        return np.empty(0, int)
    place = np.arange(count)
    slack = 1.0 + 1e-6  # readings in steps of 0.1 K that differ by 1 K do so only up to rounding
    fine = cells.usable & (cells.regime >= 0)
    for low, high in cells.ranges:
        fine &= np.nan_to_num(high - low, nan=np.inf) <= slack
    broken = ~fine
    broken[1:] |= (cells.regime[1:] != cells.regime[:-1]) | (cells.start[1:] > cells.end[:-1])
    # a run may not begin before the cell after the last unusable one or the last change of regime
    barrier = np.maximum.accumulate(np.where(broken, place + (~fine).astype(int), 0))
    typical_h = float(np.quantile(cells.end - cells.start, 0.1)) / 3600.0
    levels = max(1, math.ceil(math.log2(longest_h / typical_h + 2.0)))
    table = [[(np.nan_to_num(low), np.nan_to_num(high)) for low, high in cells.ranges]]
    for k in range(levels - 1):
        half = 2**k
        above = []
        for low, high in table[-1]:
            above.append(
                (np.minimum(low[:-half], low[half:]), np.maximum(high[:-half], high[half:]))
                if len(low) > half
                else (low, high)
            )
        table.append(above)
    start = place.copy()
    reached = [(low.copy(), high.copy()) for low, high in table[0]]
    for k in reversed(range(levels)):
        back = start - 2**k
        possible = np.flatnonzero(back >= barrier)
        if len(possible) == 0:
            continue
        grown, fits = [], np.ones(len(possible), bool)
        for (low, high), (more_low, more_high) in zip(reached, table[k], strict=True):
            new_low = np.minimum(low[possible], more_low[back[possible]])
            new_high = np.maximum(high[possible], more_high[back[possible]])
            grown.append((new_low, new_high))
            fits &= new_high - new_low <= slack
        chosen = possible[fits]
        start[chosen] = back[chosen]
        for (low, high), (new_low, new_high) in zip(reached, grown, strict=True):
            low[chosen], high[chosen] = new_low[fits], new_high[fits]
    return np.where(fine, start, count)


def periods_of_length(cells: Cells, earliest: np.ndarray, regime: str, window_h: float) -> Periods:
    """Non-overlapping periods of at least this length [h], placed from the end backwards."""
    wanted = cells.regime == (1 if regime == OPERATION else 0)
    begin = np.searchsorted(cells.start, cells.end - window_h * 3600.0 + 1e-3, side="right") - 1
    possible = wanted & (begin >= earliest)
    before = np.maximum.accumulate(np.where(possible, np.arange(len(possible)), -1))
    pairs, last = [], len(possible) - 1
    while last >= 0 and before[last] >= 0:
        end = int(before[last])
        pairs.append((int(begin[end]), end))
        last = int(begin[end]) - 1
    first, final = np.array(pairs[::-1], int).reshape(-1, 2).T
    length = cells.end - cells.start

    def total(value: np.ndarray) -> np.ndarray:
        running = np.concatenate([[0.0], np.cumsum(np.nan_to_num(value))])
        return running[final + 1] - running[first]

    span = total(length)

    def mean(value: np.ndarray) -> np.ndarray:
        return total(value * length) / span if len(span) else span

    return Periods(
        start_s=cells.start[first],
        end_s=cells.end[final],
        power=mean(cells.power),
        difference_K=mean(cells.cabinet - cells.ambient),
        ambient_K=mean(cells.ambient),
        change_K=total(cells.change_K),
        episode=_episodes(cells.start[first], cells.end[final]),
    )


def _episodes(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Episode number (N,) of each period: a new one begins after a long pause and where the longest duration
    is reached."""
    numbers, number = [], -1
    begun = ended = -math.inf
    for a, b in zip(start.tolist(), end.tolist(), strict=True):
        if a - ended >= EPISODE_GAP_H * 3600.0 or b - begun > EPISODE_LONGEST_H * 3600.0:
            number, begun = number + 1, a
        ended = b
        numbers.append(number)
    return np.array(numbers, int)


def choose_length(
    cells: Cells, earliest: np.ndarray, regime: str, shortest_h: float, longest_h: float
) -> Choice:
    """Periods of the longest length up to `longest_h` [h] that still yields enough of them.

    Enough means `ENOUGH_PERIODS` periods and episodes that retain the share `KEPT_CLASSES` of the classes of
    power (tenths of the rated) and of ambient temperature (5 K) found with the shortest length. Lengths are
    multiples of the cells' length, increasing by a quarter; where none yields enough, the shortest is taken.
    """
    cell_h = float(np.median(cells.end - cells.start)) / 3600.0 if len(cells.start) else shortest_h
    steps = max(1, math.ceil(math.log(longest_h / shortest_h) / math.log(1.25)))
    lengths = np.geomspace(shortest_h, longest_h, steps + 1)
    lengths = np.round(np.unique(np.ceil(lengths / cell_h - 1e-3)) * cell_h, 6)
    shortest = periods_of_length(cells, earliest, regime, float(lengths[0]))
    if len(shortest) < ENOUGH_PERIODS[0] or shortest.n_episodes < ENOUGH_PERIODS[1]:
        return Choice(float(lengths[0]), shortest)
    spread = (shortest.classes(shortest.power, 0.1), shortest.classes(shortest.ambient_K, 5.0))
    for length in lengths[:0:-1]:
        found = periods_of_length(cells, earliest, regime, float(length))
        kept = (found.classes(found.power, 0.1), found.classes(found.ambient_K, 5.0))
        enough = len(found) >= ENOUGH_PERIODS[0] and found.n_episodes >= ENOUGH_PERIODS[1]
        if enough and all(a >= KEPT_CLASSES * b for a, b in zip(kept, spread, strict=True)):
            return Choice(float(length), found)
    return Choice(float(lengths[0]), shortest)


def rough_time_constant(cells: Cells) -> float | None:
    """(R_AT+R_IC) C [h] from all blocks of the record by two-stage least squares; None where they do not
    determine it.

    The mean of equations (2) and (3) over a block of length h is exact, with Δ the change over it:
        T_conv,a − T_amb = f_ΔT − τ ΔT_conv,a/h + (1−ρ) τ ΔT_amb/h.
    Coloured disturbances of f_ΔT also change T_conv,a. Power and ambient temperature of earlier blocks are
    independent of them and serve as instruments for ΔT_conv,a. The result is used to choose a length and to
    settle periods; the likelihood gives the accurate value.
    """
    if len(cells.start) < FEWEST_ROUGH_BLOCKS:
        return None
    known = cells.usable & np.isfinite(cells.change_K + cells.ambient_change_K)
    hours = (cells.end - cells.start) / 3600.0
    drivers = [cells.running, cells.running * cells.power, cells.running * cells.power**2, cells.ambient]
    past = []
    for driver in (drivers[0], drivers[1], drivers[3]):
        for lag in LAGS:
            earlier = np.full(len(driver), np.nan)
            earlier[lag:] = np.where(known, driver, np.nan)[:-lag]
            past.append(earlier)
    table = np.column_stack([*drivers, cells.ambient_change_K / hours, -cells.change_K / hours, *past])
    there = known & np.isfinite(table).all(axis=1)
    if there.sum() < FEWEST_ROUGH_BLOCKS:
        return None
    table = table[there] - table[there].mean(axis=0)
    spread = table.std(axis=0)
    if spread[5] <= 0.0:
        return None
    varies = spread > 1e-9
    table[:, varies] /= spread[varies]
    exogenous, change = table[:, :5][:, varies[:5]], table[:, 5]
    instruments = np.column_stack([exogenous, table[:, 6:][:, varies[6:]]])
    stand_in = instruments @ np.linalg.lstsq(instruments, change, rcond=1e-8)[0]
    design = np.column_stack([exogenous, change])
    staged = np.column_stack([exogenous, stand_in])
    response = (cells.cabinet - cells.ambient)[there]
    response = response - response.mean()
    inverse = np.linalg.pinv(staged, rcond=1e-8)
    solution = inverse @ response
    scores = inverse * (response - design @ solution)
    days = np.floor((cells.start[there] - cells.start[0]) / (48 * 3600.0))
    sums = np.add.reduceat(scores[-1], np.unique(days, return_index=True)[1])
    value, se = solution[-1] / spread[5], math.sqrt(float(sums @ sums)) / spread[5]
    return float(value) if value > 3.0 * se > 0.0 else None
