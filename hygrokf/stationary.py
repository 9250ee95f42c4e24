"""Heat release by operating point from quasi-stationary periods: equation (1) and Fig. 4 of the paper.

Where nothing changes, T_conv,a − T_amb = Q R_AT is the heat release itself [K]. A *cell* is a stretch of the power's
clock of at least ten minutes; a *period* is a run of cells over which temperatures and power stay within their
tolerances; an *episode* is what belongs to one spell of weather, within which periods are no independent readings.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.design import TEMPERATURE, power_scale, reading_step_h
from hygrokf.drivers import at_times
from hygrokf.mechanisms.thermal import heat_release
from hygrokf.record import Record, Series

AMBIENT = "ambient_temperature"
POWER = "active_power"
TEMPERATURE_TOLERANCE_K = 0.5
"""[K] ambient and cabinet temperature stay within ± this over a period (paper, text before equation 1)."""
POWER_TOLERANCE = 0.025
"""[1] the power stays within ± this share of the rated power over a period."""
CELL_S = 600.0
"""[s] the power is judged by its means over at least this long, as the paper's SCADA data are."""
TIME_CONSTANTS = 3.0
"""[1] periods are this many thermal time constants long, where there are enough of them."""
SHORTEST_H = 1.0
"""[h] no period is shorter, nor shorter than two steps of the slowest series."""
LONGEST_H = 12.0
"""[h] no period is longer: over a day the sun and the weather turn."""
ENOUGH = (30, 10)
"""Periods and episodes that a window must yield before a shorter one is tried."""
FEWEST = (8, 5)
"""Periods and episodes below which there is no regression."""
KEPT = 0.75
"""[1] a longer window must keep this share of the classes of power and ambient temperature of the shortest."""
EPISODES_A_PARAMETER = 3
"""Episodes that each coefficient needs."""
EPISODE_GAP_H = 12.0
"""[h] a pause of this length between periods begins an episode."""
EPISODE_LONGEST_H = 72.0
"""[h] so does the end of a spell of this length."""
LAGS = (1, 2, 3, 6)
"""Blocks by which the instruments of the rough time constant lie in the past."""
JSON_POINTS = 2000

OPERATION = "operation"
STANDSTILL = "standstill"


@dataclass(frozen=True)
class Coefficient:
    """A coefficient of the heat release by its mechanism's parameter name.

    `value` least squares, `se` its standard error clustered by episode, `robust` Huber's M-estimate [as the value].
    """

    value: float
    se: float
    robust: float


@dataclass(frozen=True)
class Candidate:
    """One form tried by leave-one-episode-out cross-validation.

    `error_K` [K] root mean square error of the episodes left out; `excess`, `excess_se` [K²] mean square error above
    the best form's and the standard error of this difference over episodes.
    """

    order: int
    ambient: bool
    error_K: float
    excess: float
    excess_se: float
    chosen: bool = False


@dataclass(frozen=True)
class Points:
    """Quasi-stationary periods (N,), one point each, in order of time.

    `start_s`, `end_s` [s] since 1970-01-01T00:00Z; means over the period: `power` of P/P_rated [1], `difference_K`
    of T_conv,a − T_amb, `ambient_K`; `change_K` of T_conv,a from start to end; `episode` numbers from 0; `fitted_K`
    by the regression.
    """

    start_s: np.ndarray
    end_s: np.ndarray
    power: np.ndarray
    difference_K: np.ndarray
    ambient_K: np.ndarray
    change_K: np.ndarray
    episode: np.ndarray
    fitted_K: np.ndarray

    def to_json(self) -> dict[str, list]:
        """Plain lists of at most `JSON_POINTS` points, thinned evenly."""
        kept = np.arange(0, len(self.power), max(1, math.ceil(len(self.power) / JSON_POINTS)))
        return {
            name: np.asarray(getattr(self, name))[kept].tolist()
            for name in ("start_s", "power", "difference_K", "ambient_K", "fitted_K", "episode")
        }


@dataclass(frozen=True)
class Regression:
    """The regression of one regime, "operation" or "standstill".

    `window_h` [h] length of the periods; `order` of the polynomial in P/P_rated; `ambient` whether there is a slope
    over T_amb; `transient_K` [K] root mean square of what the periods' own warming or cooling leaves in the
    difference by the rough time constant (None without one); `r2` [1]; `residual_sd_K` [K].
    """

    regime: str
    n_points: int
    n_episodes: int
    window_h: float
    order: int
    ambient: bool
    coefficients: Mapping[str, Coefficient]
    candidates: tuple[Candidate, ...]
    r2: float
    residual_sd_K: float
    transient_K: float | None
    points: Points
    statement: str

    def to_json(self) -> dict:
        """Everything as plain data."""
        return {
            "n_points": self.n_points,
            "n_episodes": self.n_episodes,
            "window_h": self.window_h,
            "order": self.order,
            "ambient": self.ambient,
            "coefficients": {name: vars(one).copy() for name, one in self.coefficients.items()},
            "cross_validation": [vars(one).copy() for one in self.candidates],
            "r2": self.r2,
            "residual_sd_K": self.residual_sd_K,
            "transient_K": self.transient_K,
            "points": self.points.to_json(),
            "statement": self.statement,
        }


@dataclass(frozen=True)
class HeatRelease:
    """Heat release of both regimes; a regime is None where there is nothing to fit, and `statement` says why.

    `reference_K` [K] ambient temperature that the slopes count from; `scale_W` [W] power that counts as 1 (None
    without power: the whole record is standstill); `time_constant_h` [h] thermal time constant by which the length
    of the periods was chosen, given or roughly estimated, None where it could not be.
    """

    operation: Regression | None
    standstill: Regression | None
    reference_K: float | None
    scale_W: float | None
    time_constant_h: float | None
    statement: str

    def start(self) -> dict[str, float]:
        """Start values of the heat release's parameters by name, within their bounds; empty without a regression."""
        values: dict[str, float] = {}
        for regression in (self.operation, self.standstill):
            if regression is not None:
                for parameter in _parameters(regression.regime, regression.order, regression.ambient):
                    value = regression.coefficients[parameter.name].value
                    values[parameter.name] = min(max(value, parameter.lower), parameter.upper)
        return values

    def to_json(self) -> dict:
        """Everything as plain data."""
        return {
            OPERATION: None if self.operation is None else self.operation.to_json(),
            STANDSTILL: None if self.standstill is None else self.standstill.to_json(),
            "reference_K": self.reference_K,
            "scale_W": self.scale_W,
            "time_constant_h": self.time_constant_h,
            "statement": self.statement,
        }


def heat_release_regression(
    record: Record,
    *,
    scale_W: float | None = None,
    reference_K: float | None = None,
    time_constant_h: float | None = None,
    largest_order: int = 3,
) -> HeatRelease:
    """Heat release f_ΔT = Q R_AT [K] in operation and at standstill, by regression over quasi-stationary periods.

        T_conv,a − T_amb = a₀ + a₁ p + … + a_K p^K + a_T (T_amb − T_ref) in operation,  b₀ + b_T (T_amb − T_ref) else

    record: its identification period is used, never what follows; every series on its own clock.
    scale_W: [W] power that counts as p = 1; None: `design.power_scale`.
    reference_K: [K] T_ref; None: the mean of the ambient readings, as in `design.design`.
    time_constant_h: [h] thermal time constant, where one is known; None: a rough one is estimated.
    largest_order: [1] 0 … 3, largest K tried.

    Periods are three time constants long: what a period's own change ΔT_conv,a leaves in its mean difference is
    τ ΔT_conv,a/window, at most a third of a kelvin at the stated tolerance. Where that yields fewer than 30 periods
    in 10 episodes, or loses a quarter of the range of power or ambient temperature, shorter ones are taken, down
    to an hour or two steps of the slowest series. Periods are laid from the end of a stationary stretch backwards,
    so that the rest of a transient at its start is left out. Standard errors are clustered by episode; they do not
    know the sensors' accuracy. Periods with known pre-heating are left out.

    A regime with too few periods is None, and the statement says so. Raises ValueError for arguments out of range.
    Source: equation (1), Fig. 3 and Fig. 4 of the paper.
    """
    faults = [
        f"{name} must be a number above 0, found {value}"
        for name, value in (
            ("scale_W", scale_W), ("reference_K", reference_K), ("time_constant_h", time_constant_h),
        )
        if value is not None and not 0.0 < value < math.inf
    ]  # fmt: skip
    if largest_order not in (0, 1, 2, 3):
        faults.append(f"largest_order must be 0, 1, 2 or 3, found {largest_order}")
    if faults:
        raise ValueError("heat_release_regression: " + "; ".join(faults))
    known = record.identification()
    missing = [name for name in (TEMPERATURE, AMBIENT) if not _known(known, name)]
    if missing:
        said = f"no reading of {' and '.join(missing)}: no heat release from stationary periods"
        return HeatRelease(None, None, reference_K, scale_W, time_constant_h, said)
    if reference_K is None:
        reference_K = float(np.nanmean(known[AMBIENT].value))
    if scale_W is None:
        scale_W = power_scale(known)
    if scale_W is not None and not _known(known, POWER):
        scale_W = None
    statements = []
    if scale_W is None:
        statements.append("no power in the record: all of it counts as standstill")
    used = [known[name] for name in (TEMPERATURE, AMBIENT, *((POWER,) if scale_W else ()))]
    slowest_h = max(max(reading_step_h(one), one.interval_s / 3600.0) for one in used)
    first, last = max(one.time[0] - one.interval_s for one in used), min(one.time[-1] for one in used)
    rough = time_constant_h is None
    if rough:
        blocks = np.arange(first, last, 3600.0 * max(1.0, slowest_h))
        time_constant_h = _rough_time_constant(_cells(known, scale_W, blocks))
    cells = _cells(known, scale_W, _edges(used[-1] if scale_W else used[0], first, last))
    shortest_h = max(SHORTEST_H, 2.0 * slowest_h)
    wanted_h = LONGEST_H if time_constant_h is None else min(TIME_CONSTANTS * time_constant_h, LONGEST_H)
    wanted_h = max(wanted_h, shortest_h)
    earliest = _earliest_starts(cells, wanted_h)
    made: dict[str, Regression | None] = {OPERATION: None, STANDSTILL: None}
    for regime in (OPERATION, STANDSTILL) if scale_W else (STANDSTILL,):
        window_h, points, why = _choose_window(cells, earliest, regime, shortest_h, wanted_h)
        n, episodes = len(points.power), _count(points.episode)
        if n < FEWEST[0] or episodes < FEWEST[1]:
            statements.append(_too_few(cells, regime, n, episodes, window_h))
            continue
        lead = _lead(window_h, wanted_h, time_constant_h, rough, why)
        fit = _regression(regime, points, window_h, reference_K, time_constant_h, largest_order, lead)
        made[regime] = fit
        statements.append(fit.statement)
    return HeatRelease(
        made[OPERATION], made[STANDSTILL], reference_K, scale_W, time_constant_h, "; ".join(statements)
    )


# --- periods --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Cells:
    """Consecutive cells (N,): bounds [s], means, and what decides whether a cell can be part of a period.

    `ranges` lowest and highest value of (cabinet, ambient, power), in units of what a period may span; `change_K` and
    `ambient_change_K` of the cabinet and ambient temperature from start to end; `running` share of the cell with
    P > 0; `regime` 1 in operation, 0 at standstill, -1 mixed; `usable` known throughout and without pre-heating.
    """

    start: np.ndarray
    end: np.ndarray
    cabinet: np.ndarray
    ambient: np.ndarray
    power: np.ndarray
    running: np.ndarray
    ranges: tuple[tuple[np.ndarray, np.ndarray], ...]
    change_K: np.ndarray
    ambient_change_K: np.ndarray
    regime: np.ndarray
    usable: np.ndarray


def _known(record: Record, name: str) -> bool:
    return name in record and int(np.isfinite(record[name].value).sum()) > 1


def _bridge_h(series: Series) -> float:
    """Longest hole that one missing reading leaves [h]; a longer one is a gap."""
    return max(2.5 * reading_step_h(series) - series.interval_s / 3600.0, 0.0)


def _edges(series: Series, first: float, last: float) -> np.ndarray:
    """Bounds of cells on a series' own clock [s], thinned to about `CELL_S`."""
    time = series.time[~series.missing]
    edges = np.unique(np.concatenate([time, time - series.interval_s]))
    edges = edges[(edges >= first) & (edges <= last)]
    if len(edges) == 0:
        return edges
    # Rounding keeps a clock of about ten minutes whole where its stamps are a few seconds off.
    return edges[np.unique(np.round((edges - edges[0]) / CELL_S), return_index=True)[1]]


def _cells(record: Record, scale_W: float | None, edges: np.ndarray) -> _Cells:
    """The cells between the edges: exact means and ranges of each course, which runs by its own hold."""
    edges = edges if len(edges) > 1 else np.empty(0)
    first, last = (edges[0], edges[-1]) if len(edges) else (math.inf, -math.inf)
    heated = "preheating" in record
    knots = [edges]
    for name in (TEMPERATURE, AMBIENT, *((POWER,) if scale_W else ()), *(("preheating",) if heated else ())):
        for shift in {0.0, record[name].interval_s}:
            knot = record[name].time - shift
            knots.append(knot[(knot > first) & (knot < last)])
    fine = np.unique(np.concatenate(knots))
    middle, length = 0.5 * (fine[:-1] + fine[1:]), np.diff(fine)
    begin, span = np.searchsorted(fine, edges[:-1]), np.diff(edges)

    def mean(value: np.ndarray) -> np.ndarray:
        return np.add.reduceat(value * length, begin) / span if len(begin) else np.empty(0)

    def course(name: str) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray]:
        """Mean, range and change of a temperature in each cell [K]; NaN where it is unknown."""
        series, bridge_h = record[name], _bridge_h(record[name])
        value = at_times(series, middle, bridge_h)
        low = high = value
        if series.hold == "linear":
            ends = at_times(series, fine, bridge_h)
            low, high = np.minimum(ends[:-1], ends[1:]), np.maximum(ends[:-1], ends[1:])
        change = np.diff(at_times(series, edges, bridge_h))
        if not len(begin):
            return np.empty(0), (np.empty(0), np.empty(0)), np.empty(0)
        return mean(value), (np.minimum.reduceat(low, begin), np.maximum.reduceat(high, begin)), change

    cabinet, cabinet_range, change = course(TEMPERATURE)
    ambient, ambient_range, ambient_change = course(AMBIENT)
    known = np.isfinite(cabinet + ambient + np.diff(np.array(ambient_range), axis=0)[0])
    known &= np.isfinite(np.diff(np.array(cabinet_range), axis=0)[0])
    power, running = np.zeros(len(span)), np.zeros(len(span))
    if scale_W:
        relative = at_times(record[POWER], middle, _bridge_h(record[POWER])) / scale_W
        power, running = mean(relative), mean((relative > 0).astype(float))
        known &= np.isfinite(power)
    if heated:
        # As in `drivers.run`, a duty that nobody wrote down is none.
        known &= ~(mean((np.nan_to_num(at_times(record["preheating"], middle, 24.0)) > 0).astype(float)) > 0)
    width_K, width = 2.0 * TEMPERATURE_TOLERANCE_K, 2.0 * POWER_TOLERANCE
    ranges = (
        (cabinet_range[0] / width_K, cabinet_range[1] / width_K),
        (ambient_range[0] / width_K, ambient_range[1] / width_K),
        (power / width, power / width),
    )
    regime = np.where(running > 1.0 - 1e-9, 1, np.where(running < 1e-9, 0, -1))
    return _Cells(
        edges[:-1], edges[1:], cabinet, ambient, power, running, ranges, change, ambient_change, regime, known
    )


def _earliest_starts(cells: _Cells, longest_h: float) -> np.ndarray:
    """First cell (N,) of the longest stationary run that ends with each cell; N where the cell is in no run.

    The reach doubles: level k knows the ranges over 2^k cells, and a run takes every level that it can, from the
    highest down.
    """
    count = len(cells.start)
    if count == 0:
        return np.empty(0, int)
    place = np.arange(count)
    slack = 1.0 + 1e-6  # 0.1 K readings that differ by 1 K do so to rounding only
    fine = cells.usable & (cells.regime >= 0)
    for low, high in cells.ranges:
        fine &= np.nan_to_num(high - low, nan=np.inf) <= slack
    broken = ~fine
    broken[1:] |= (cells.regime[1:] != cells.regime[:-1]) | (cells.start[1:] > cells.end[:-1])
    # A run may not reach back beyond the cell after the last unusable one, or the last change of regime.
    barrier = np.maximum.accumulate(np.where(broken, place + (~fine).astype(int), 0))
    typical_h = float(np.median(cells.end - cells.start)) / 3600.0
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


def _periods(cells: _Cells, earliest: np.ndarray, regime: str, window_h: float) -> Points:
    """Periods of at least this length [h] that do not overlap, laid from the end backwards."""
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

    return Points(
        start_s=cells.start[first],
        end_s=cells.end[final],
        power=mean(cells.power),
        difference_K=mean(cells.cabinet - cells.ambient),
        ambient_K=mean(cells.ambient),
        change_K=total(cells.change_K),
        episode=_episodes(cells.start[first], cells.end[final]),
        fitted_K=np.full(len(first), np.nan),
    )


def _episodes(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Number of the episode (N,) of each period: a spell without a long pause, cut where it lasts too long."""
    numbers, number = [], -1
    begun = ended = -math.inf
    for a, b in zip(start.tolist(), end.tolist(), strict=True):
        if a - ended >= EPISODE_GAP_H * 3600.0 or b - begun > EPISODE_LONGEST_H * 3600.0:
            number, begun = number + 1, a
        ended = b
        numbers.append(number)
    return np.array(numbers, int)


def _count(labels: np.ndarray) -> int:
    return len(np.unique(labels))


def _classes(points: Points, value: np.ndarray, width: float) -> int:
    """Classes of a value that are met in at least two episodes."""
    met = np.unique(np.column_stack([np.floor(value / width), points.episode]), axis=0)
    return int((np.unique(met[:, 0], return_counts=True)[1] > 1).sum())


def _choose_window(
    cells: _Cells, earliest: np.ndarray, regime: str, shortest_h: float, longest_h: float
) -> tuple[float, Points, str]:
    """The longest window [h] with enough periods, its periods, and why it is no longer ("" where it is the longest)."""
    steps = max(1, math.ceil(math.log(longest_h / shortest_h) / math.log(1.25)))
    ladder = np.unique(np.round(np.geomspace(shortest_h, longest_h, steps + 1), 3))
    points = shortest = _periods(cells, earliest, regime, float(ladder[0]))
    if len(shortest.power) < ENOUGH[0] or _count(shortest.episode) < ENOUGH[1]:
        return float(ladder[0]), points, "even the shortest yields few periods"
    spread = (_classes(shortest, shortest.power, 0.1), _classes(shortest, shortest.ambient_K, 5.0))
    why = ""
    for window_h in ladder[:0:-1]:
        points = _periods(cells, earliest, regime, float(window_h))
        n, episodes = len(points.power), _count(points.episode)
        kept = (_classes(points, points.power, 0.1), _classes(points, points.ambient_K, 5.0))
        if n < ENOUGH[0] or episodes < ENOUGH[1]:
            why = f"{window_h:.3g} h would leave {n} periods in {_many(episodes, 'episode')}"
        elif any(a < KEPT * b for a, b in zip(kept, spread, strict=True)):
            lost = "power" if kept[0] < KEPT * spread[0] else "ambient temperature"
            why = f"{window_h:.3g} h would lose more than a quarter of the classes of {lost}"
        else:
            return float(window_h), points, why
    return float(ladder[0]), shortest, why


# --- time constant --------------------------------------------------------------------------


def _rough_time_constant(cells: _Cells) -> float | None:
    """(R_AT+R_IC) C [h] from all blocks of the record by two-stage least squares; None where they do not tell.

    The mean of equations (2) and (3) over a block of length h is exact, with Δ the change over it:
        T_conv,a − T_amb = f_ΔT − τ ΔT_conv,a/h + (1−ρ) τ ΔT_amb/h.
    Coloured disturbances of f_ΔT move T_conv,a too; power and ambient temperature of earlier blocks do not know them
    and stand in for ΔT_conv,a. It serves the choice of a window only.
    """
    if len(cells.start) < 100:
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
    if there.sum() < 100:
        return None
    table = table[there] - table[there].mean(axis=0)
    spread = table.std(axis=0)
    if spread[5] <= 0.0:
        return None
    varies = spread > 1e-9
    table[:, varies] /= spread[varies]
    known_sides, change = table[:, :5][:, varies[:5]], table[:, 5]
    instruments = np.column_stack([known_sides, table[:, 6:][:, varies[6:]]])
    stand_in = instruments @ np.linalg.lstsq(instruments, change, rcond=1e-8)[0]
    design = np.column_stack([known_sides, change])
    staged = np.column_stack([known_sides, stand_in])
    response = (cells.cabinet - cells.ambient)[there]
    response = response - response.mean()
    inverse = np.linalg.pinv(staged, rcond=1e-8)
    solution = inverse @ response
    scores = inverse * (response - design @ solution)
    days = np.floor((cells.start[there] - cells.start[0]) / (48 * 3600.0))
    sums = np.add.reduceat(scores[-1], np.unique(days, return_index=True)[1])
    value, se = solution[-1] / spread[5], math.sqrt(float(sums @ sums)) / spread[5]
    return float(value) if value > 3.0 * se > 0.0 else None


# --- regression -----------------------------------------------------------------------------


def _parameters(regime: str, order: int, ambient: bool) -> tuple:
    """Parameters of the mechanism, in the order of `_regressors`."""
    running = regime == OPERATION
    made = heat_release(
        order=order, ambient=ambient, standstill_ambient=ambient, operation=running, standstill=not running
    )
    return made.parameters


def _regressors(points: Points, order: int, ambient: bool, reference_K: float) -> np.ndarray:
    columns = [points.power**k for k in range(order + 1)]
    return np.column_stack([*columns, points.ambient_K - reference_K] if ambient else columns)


def _left_out(regressors: np.ndarray, response: np.ndarray, episode: np.ndarray) -> np.ndarray | None:
    """Sums of squares [K²] (G,) of each episode by the fit to all others; None where an episode is indispensable."""
    if np.linalg.matrix_rank(regressors) < regressors.shape[1]:
        return None
    basis = np.linalg.qr(regressors)[0]
    residual = response - basis @ (basis.T @ response)
    sums = []
    for rows in np.split(np.arange(len(response)), np.flatnonzero(np.diff(episode)) + 1):
        # (I − H_gg)⁻¹ e_g through the small matrix of the coefficients.
        part = basis[rows]
        inner = np.eye(part.shape[1]) - part.T @ part
        if np.linalg.eigvalsh(inner)[0] < 1e-6:
            return None
        outside = residual[rows] + part @ np.linalg.solve(inner, part.T @ residual[rows])
        sums.append(float(outside @ outside))
    return np.array(sums)


def _choose_form(
    regime: str, points: Points, reference_K: float, largest_order: int
) -> tuple[tuple[Candidate, ...], int, bool]:
    """Every form tried, and the simplest whose error is within a standard error of the best one's."""
    orders = 0
    if regime == OPERATION and np.ptp(np.quantile(points.power, [0.02, 0.98])) >= 2.0 * POWER_TOLERANCE:
        orders = min(largest_order, _classes(points, points.power, 0.1) - 1)
    slopes = (False, True) if np.ptp(np.quantile(points.ambient_K, [0.05, 0.95])) >= 2.0 else (False,)
    episodes, n = _count(points.episode), len(points.power)
    tried: dict[tuple[int, bool], np.ndarray] = {}
    for order in range(max(orders, 0) + 1):
        for ambient in slopes:
            size = order + 1 + ambient
            if size > 1 and episodes < EPISODES_A_PARAMETER * size:
                continue
            sums = _left_out(
                _regressors(points, order, ambient, reference_K), points.difference_K, points.episode
            )
            if sums is not None:
                tried[order, ambient] = sums
    best = min(tried, key=lambda form: tried[form].sum())
    counts = np.unique(points.episode, return_counts=True)[1]
    rows, within = [], []
    for form, sums in tried.items():
        above = sums - tried[best]
        excess = float(above.sum()) / n
        spread = above - counts * excess
        se = math.sqrt(episodes / (episodes - 1.0) * float(spread @ spread)) / n
        rows.append(Candidate(*form, math.sqrt(float(sums.sum()) / n), excess, se))
        if excess <= se + 1e-12:
            within.append((form[0] + form[1], float(sums.sum()), form))
    chosen = min(within)[2]
    marked = tuple(
        Candidate(c.order, c.ambient, c.error_K, c.excess, c.excess_se, (c.order, c.ambient) == chosen)
        for c in rows
    )
    return marked, *chosen


def _regression(
    regime: str,
    points: Points,
    window_h: float,
    reference_K: float,
    time_constant_h: float | None,
    largest_order: int,
    lead: str,
) -> Regression:
    """Least squares with errors clustered by episode, and Huber's M-estimate beside it."""
    from statsmodels.regression.linear_model import OLS
    from statsmodels.robust.robust_linear_model import RLM

    candidates, order, ambient = _choose_form(regime, points, reference_K, largest_order)
    regressors = _regressors(points, order, ambient, reference_K)
    fit = OLS(points.difference_K, regressors).fit(cov_type="cluster", cov_kwds={"groups": points.episode})
    sd = math.sqrt(float(fit.scale))
    robust = fit.params
    if sd > 1e-6:  # without scatter there is nothing to be robust against, and its scale is 0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            robust = RLM(points.difference_K, regressors).fit().params
    names = [parameter.name for parameter in _parameters(regime, order, ambient)]
    coefficients = {
        name: Coefficient(float(a), float(b), float(c))
        for name, a, b, c in zip(names, fit.params, np.sqrt(np.diag(fit.cov_params())), robust, strict=True)
    }
    transient_K = None
    if time_constant_h is not None:
        lag = time_constant_h * points.change_K * 3600.0 / (points.end_s - points.start_s)
        transient_K = float(np.sqrt(np.mean(lag**2)))
    said = _said(regime, points, window_h, lead, order, ambient, coefficients, sd, transient_K)
    return Regression(
        regime=regime,
        n_points=len(points.power),
        n_episodes=_count(points.episode),
        window_h=window_h,
        order=order,
        ambient=ambient,
        coefficients=coefficients,
        candidates=candidates,
        r2=0.0 if regressors.shape[1] == 1 else float(fit.rsquared),
        residual_sd_K=sd,
        transient_K=transient_K,
        points=replace(points, fitted_K=regressors @ fit.params),
        statement=said,
    )


# --- words ----------------------------------------------------------------------------------


def _many(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _too_few(cells: _Cells, regime: str, n: int, episodes: int, window_h: float) -> str:
    hours = float((cells.end - cells.start)[cells.regime == (regime == OPERATION)].sum()) / 3600.0
    if hours <= 0.0:
        return f"{regime}: none in the record"
    return (
        f"{regime}: {_many(n, 'quasi-stationary period')} of {window_h:.3g} h in {_many(episodes, 'episode')} "
        f"of {hours:.0f} h are too few for a regression, which takes {FEWEST[0]} in {FEWEST[1]}: the heat release "
        "is left to the likelihood"
    )


def _lead(window_h: float, wanted_h: float, time_constant_h: float | None, rough: bool, why: str) -> str:
    """Why the periods are as long as they are."""
    if time_constant_h is None:
        wanted = "the time constant is not known, so the longest window that serves"
    else:
        source = "a rough" if rough else "the given"
        wanted = f"wanted {wanted_h:.3g} h by {source} time constant of {time_constant_h:.2g} h"
    return f"{wanted}; {why}" if why else wanted


def _said(
    regime: str,
    points: Points,
    window_h: float,
    lead: str,
    order: int,
    ambient: bool,
    coefficients: Mapping[str, Coefficient],
    sd: float,
    transient_K: float | None,
) -> str:
    episodes = _count(points.episode)
    shape = ("constant", "linear in the power", "quadratic in the power", "cubic in the power")[order]
    text = (
        f"{regime}: {_many(len(points.power), 'quasi-stationary period')} of {window_h:.3g} h in "
        f"{_many(episodes, 'episode')} ({lead}); the difference is {shape}"
        f"{' with a slope' if ambient else ' without a slope'} over the ambient temperature, by cross-validation; "
        f"residual {sd:.2g} K"
    )
    if transient_K is not None:
        text += f"; changes within the periods leave {transient_K:.2g} K of it"
    if regime == OPERATION and order == 0:
        low, high = np.quantile(points.power, [0.02, 0.98])
        if high - low < 2.0 * POWER_TOLERANCE:
            text += (
                f"; the power hardly varies ({low:.2f} … {high:.2f} of rated), which leaves no slope over it"
            )
    apart = [name for name, c in coefficients.items() if abs(c.value - c.robust) > 2.0 * c.se + 1e-9]
    if apart:
        listed = ", ".join(
            f"{name} {coefficients[name].value:.3g} ± {coefficients[name].se:.2g} against {coefficients[name].robust:.3g}"
            for name in apart
        )
        text += f"; least squares and the robust fit differ by more than two standard errors: {listed}"
    if episodes < 2 * ENOUGH[1]:
        text += f"; with {episodes} episodes the standard errors are optimistic"
    return text
