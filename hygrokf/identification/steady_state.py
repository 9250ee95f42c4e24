"""Heat release by operating point from quasi-stationary periods: equation (1) and Fig. 4 of the paper."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hygrokf.data.record import Record
from hygrokf.identification.periods import (
    OPERATION,
    POWER_TOLERANCE,
    STANDSTILL,
    Cells,
    Choice,
    Periods,
    cell_edges,
    cells_between,
    choose_length,
    earliest_starts,
    has_readings,
    rough_time_constant,
)
from hygrokf.modelling.design import power_scale, reading_step_h
from hygrokf.physics.mechanisms.thermal import heat_release
from hygrokf.physics.parameters import Parameter
from hygrokf.physics.signal_names import ACTIVE_POWER, AMBIENT_TEMPERATURE, CABINET_TEMPERATURE
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.statement import Statement

PERIOD_TIME_CONSTANTS = 3.0
"""[1] length of periods in thermal time constants, unless too few periods would be that long."""
SHORTEST_PERIOD_H = 1.0
"""[h] shortest period; periods also last at least two steps of the slowest series."""
LONGEST_PERIOD_H = 12.0
"""[h] longest period: sun and weather change over a day."""
FEWEST_PERIODS = (8, 5)
"""Fewest periods and episodes for a regression."""
EPISODES_A_PARAMETER = 3
"""Episodes needed for each coefficient."""
LEAST_AMBIENT_K = 2.0
"""[K] spread of the ambient temperature needed for a slope over it."""
WORSE = 2.0
"""[1] periods are not settled with a time constant that increases their error by more than this factor.

Some increase is expected: a slow cabinet smooths the disturbances of its heat release, and settling undoes
the smoothing.
"""
LARGEST_ORDER = 3
"""Largest order of the polynomial in the power that is tried."""
MOST_REGIME_POINTS = 2000
"""Largest number of points of a regime in the results of a fit."""


@dataclass(frozen=True)
class StationaryPoints:
    """Quasi-stationary periods (N,), one point each, in order of time: means over the period of `power`
    P/P_rated [1], `difference_K` T_conv,a − T_amb and `ambient_K` T_amb."""

    power: np.ndarray = field(default_factory=lambda: np.empty(0))
    difference_K: np.ndarray = field(default_factory=lambda: np.empty(0))
    ambient_K: np.ndarray = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        found = {name: len(value) for name, value in vars(self).items()}
        if len(set(found.values())) > 1:
            raise ValueError(f"expected one number for each of {len(self)} periods, found {found}")

    def __len__(self) -> int:
        return len(self.power)

    def thinned(self) -> StationaryPoints:
        """At most `MOST_REGIME_POINTS` of the points, evenly thinned."""
        kept = slice(None, None, max(1, math.ceil(len(self) / MOST_REGIME_POINTS)))
        return StationaryPoints(**{name: value[kept] for name, value in vars(self).items()})


@dataclass(frozen=True)
class Regression:
    """The regression of one regime, operation or standstill.

    `order` of the polynomial in P/P_rated; `ambient` whether there is a slope over T_amb; `coefficients` by
    parameter name of `mechanisms.thermal.heat_release`; `points` the periods.
    """

    n_points: int = 0
    n_episodes: int = 0
    order: int = 0
    ambient: bool = False
    coefficients: Mapping[str, float] = field(default_factory=dict)
    points: StationaryPoints = field(default_factory=StationaryPoints)


@dataclass(frozen=True)
class HeatRelease:
    """Heat release of both regimes; a regime is None where it cannot be fitted, and `statements` give the
    reasons.  `reference_K` [K] ambient temperature at which the slopes are zero."""

    operation: Regression | None = None
    standstill: Regression | None = None
    reference_K: float | None = None
    statements: tuple[Statement, ...] = ()

    @property
    def regimes(self) -> dict[str, Regression]:
        """The regressions that could be fitted, by regime."""
        pairs = ((OPERATION, self.operation), (STANDSTILL, self.standstill))
        return {regime: one for regime, one in pairs if one is not None}

    @property
    def power_order(self) -> int:
        """Order of the power in a design: that of the regression, at least two.

        Cross-validation drops terms that do not help to predict a few dozen stationary periods.  If the
        likelihood omitted these terms, they would act as a disturbance that follows the power and bias the
        time constant (by 6 % on simulated plants).  The likelihood therefore keeps the quadratic term and
        both ambient slopes; where they are not needed their estimates are near 0.
        """
        return 2 if self.operation is None else max(2, self.operation.order)

    def start(self) -> dict[str, float]:
        """Start values of the heat release's parameters by name, within their bounds; empty without a
        regression."""
        values: dict[str, float] = {}
        for regime, regression in self.regimes.items():
            for parameter in _parameters(regime, regression.order, regression.ambient):
                value = regression.coefficients[parameter.name]
                values[parameter.name] = min(max(value, parameter.lower), parameter.upper)
        return values

    def thinned(self) -> HeatRelease:
        """The heat release with as many points as results hold."""
        thinned = {regime: replace(one, points=one.points.thinned()) for regime, one in self.regimes.items()}
        return replace(self, operation=thinned.get(OPERATION), standstill=thinned.get(STANDSTILL))


def heat_release_regression(record: Record, *, reference_K: float | None = None) -> HeatRelease:
    """Heat release f_ΔT = Q R_AT [K] in operation and at standstill, by regression over quasi-stationary
    periods.

        T_conv,a − T_amb = a₀ + a₁ p + … + a_K p^K + a_T (T_amb − T_ref) in operation,  b₀ + b_T (T_amb −
        T_ref) else

    record: only its identification period is used; every series on its own clock; p = 1 at
        `design.power_scale`.
    reference_K: [K] T_ref; None: the mean of the ambient readings, as in `design.design`.

    Periods (`periods.Periods`) are three time constants long, by a rough estimate, so that the contribution
    of a period's own change ΔT_conv,a to its mean difference, −τ ΔT_conv,a/window by equation (2), is at most
    a third of a kelvin. Where that yields fewer than 30 periods in 10 episodes, or loses a quarter of the
    range of power or ambient temperature, shorter periods are used, down to an hour or two steps of the
    slowest series. As short periods are not settled, this contribution is subtracted before the regression,
    unlike in the paper, where cross-validation does not contradict it. Times at which a logged heater is on
    are left out. Between the powers of the periods the form is an interpolation.

    A regime with too few periods is None, and a statement gives the reason. Source: equation (1), Fig. 3
    and Fig. 4 of the paper.
    """
    early = record.identification()
    missing = tuple(
        name for name in (CABINET_TEMPERATURE, AMBIENT_TEMPERATURE) if not has_readings(early, name)
    )
    if missing:
        return HeatRelease(None, None, reference_K, (FitCode.NO_READINGS_FOR_PERIODS(signals=missing),))
    if reference_K is None:
        reference_K = float(np.nanmean(early[AMBIENT_TEMPERATURE].value))
    statements: list[Statement] = []
    scale_W = power_scale(early) if has_readings(early, ACTIVE_POWER) else None
    if not has_readings(early, ACTIVE_POWER):
        statements.append(FitCode.NO_POWER())
    elif scale_W is None:
        statements.append(FitCode.POWER_NEVER_POSITIVE())
    used = [
        early[name]
        for name in (CABINET_TEMPERATURE, AMBIENT_TEMPERATURE, *((ACTIVE_POWER,) if scale_W else ()))
    ]
    slowest_h = max(max(reading_step_h(one), one.interval_s / 3600.0) for one in used)
    first, last = max(one.time[0] - one.interval_s for one in used), min(one.time[-1] for one in used)
    blocks = np.arange(first, last, 3600.0 * max(1.0, slowest_h))
    time_constant_h = rough_time_constant(cells_between(early, scale_W, blocks))
    cells = cells_between(early, scale_W, cell_edges(used[-1] if scale_W else used[0], first, last))
    shortest_h = max(SHORTEST_PERIOD_H, 2.0 * slowest_h)
    wanted_h = (
        LONGEST_PERIOD_H
        if time_constant_h is None
        else min(PERIOD_TIME_CONSTANTS * time_constant_h, LONGEST_PERIOD_H)
    )
    wanted_h = max(wanted_h, shortest_h)
    earliest = earliest_starts(cells, wanted_h)
    regressions: dict[str, Regression] = {}
    for regime in (OPERATION, STANDSTILL) if scale_W else (STANDSTILL,):
        choice = choose_length(cells, earliest, regime, shortest_h, wanted_h)
        if len(choice.periods) < FEWEST_PERIODS[0] or choice.periods.n_episodes < FEWEST_PERIODS[1]:
            statements.append(_too_few(cells, regime, choice))
        else:
            regressions[regime] = _regression(regime, choice.periods, reference_K, time_constant_h)
    pair = (regressions.get(OPERATION), regressions.get(STANDSTILL))
    return HeatRelease(*pair, reference_K, tuple(statements))


def _too_few(cells: Cells, regime: str, choice: Choice) -> Statement:
    hours = float((cells.end - cells.start)[cells.regime == (regime == OPERATION)].sum()) / 3600.0
    if hours <= 0.0:
        return FitCode.REGIME_ABSENT(regime=regime)
    return FitCode.TOO_FEW_PERIODS(
        regime=regime, periods=len(choice.periods), window_h=choice.window_h,
        episodes=choice.periods.n_episodes, hours=hours, fewest_periods=FEWEST_PERIODS[0],
        fewest_episodes=FEWEST_PERIODS[1],
    )  # fmt: skip


def _parameters(regime: str, order: int, ambient: bool) -> tuple[Parameter, ...]:
    """Parameters of the mechanism, in the order of `_regressors`."""
    running = regime == OPERATION
    return heat_release(
        order=order, ambient=ambient, standstill_ambient=ambient, operation=running, standstill=not running
    ).parameters


def _regressors(points: Periods, order: int, ambient: bool, reference_K: float) -> np.ndarray:
    columns = [points.power**k for k in range(order + 1)]
    return np.column_stack([*columns, points.ambient_K - reference_K] if ambient else columns)


def _left_out(regressors: np.ndarray, response: np.ndarray, episode: np.ndarray) -> np.ndarray | None:
    """Sums of squares [K²] (G,) of each episode by the fit to all others; None where an episode is
    indispensable."""
    if np.linalg.matrix_rank(regressors) < regressors.shape[1]:
        return None
    basis = np.linalg.qr(regressors)[0]
    residual = response - basis @ (basis.T @ response)
    sums = []
    for rows in np.split(np.arange(len(response)), np.flatnonzero(np.diff(episode)) + 1):
        # (I − H_gg)⁻¹ e_g through the small matrix of the coefficients
        part = basis[rows]
        inner = np.eye(part.shape[1]) - part.T @ part
        if np.linalg.eigvalsh(inner)[0] < 1e-6:
            return None
        outside = residual[rows] + part @ np.linalg.solve(inner, part.T @ residual[rows])
        sums.append(float(outside @ outside))
    return np.array(sums)


def _supported_order(points: Periods) -> int:
    """Largest order K, up to `LARGEST_ORDER`, for which each of K+1 equal parts of the power's range occurs
    in enough episodes.

    Periods cluster near standstill and at rated power, because the wind in between is rarely steady.  Without
    this rule a curve through both ends would be unconstrained in the middle, where cross-validation has no
    data either.
    """
    low, high = points.power.min(), points.power.max()
    for order in range(LARGEST_ORDER, 0, -1):
        part = np.minimum(((points.power - low) / (high - low) * (order + 1)).astype(int), order)
        met = [len(np.unique(points.episode[part == k])) for k in range(order + 1)]
        if min(met) >= EPISODES_A_PARAMETER:
            return order
    return 0


def _forms(regime: str, points: Periods) -> list[tuple[int, bool]]:
    """Forms (order, ambient slope) that the spread of the periods permits, the constant first."""
    orders = 0
    if regime == OPERATION and np.ptp(np.quantile(points.power, [0.02, 0.98])) >= 2.0 * POWER_TOLERANCE:
        orders = _supported_order(points)
    warm = np.ptp(np.quantile(points.ambient_K, [0.05, 0.95])) >= LEAST_AMBIENT_K
    forms = [
        (order, ambient) for order in range(orders + 1) for ambient in ((False, True) if warm else (False,))
    ]
    most = points.n_episodes // EPISODES_A_PARAMETER
    return [form for form in forms if form == (0, False) or form[0] + 1 + form[1] <= most]


def _cross_validate(
    points: Periods, response: np.ndarray, forms: list[tuple[int, bool]], reference_K: float
) -> tuple[tuple[int, bool], float]:
    """The simplest form whose error is within a standard error of the best one's, by leave-one-episode-out
    cross-validation, and the best one's root mean square error [K].

    The standard error is that of the difference of both errors over episodes, so that errors common to all
    forms, such as a day's disturbance, do not hide a slope.
    """
    tried = {
        form: sums
        for form in forms
        if (sums := _left_out(_regressors(points, *form, reference_K), response, points.episode)) is not None
    }
    best = min(tried.values(), key=lambda sums: float(sums.sum()))
    counts = np.unique(points.episode, return_counts=True)[1]
    n, episodes = len(points), points.n_episodes
    within = {}
    for form, sums in tried.items():
        excess = float((sums - best).sum()) / n
        apart = sums - best - counts * excess
        se = math.sqrt(episodes / (episodes - 1.0) * float(apart @ apart)) / n
        if excess <= se + 1e-12:
            within[form] = math.sqrt(float(sums.sum()) / n)
    chosen = min(within, key=lambda form: (form[0] + form[1], within[form]))
    return chosen, math.sqrt(float(best.sum()) / n)


def _regression(
    regime: str, points: Periods, reference_K: float, time_constant_h: float | None
) -> Regression:
    """Least squares in the form that cross-validation chooses."""
    forms, response = _forms(regime, points), points.difference_K
    form, error_K = _cross_validate(points, response, forms, reference_K)
    if time_constant_h is not None:
        settled = response + time_constant_h * points.rate_K_h
        other, other_error_K = _cross_validate(points, settled, forms, reference_K)
        if other_error_K <= WORSE * error_K:
            response, form = settled, other
    solution = np.linalg.pinv(_regressors(points, *form, reference_K), rcond=1e-15) @ response
    names = [parameter.name for parameter in _parameters(regime, *form)]
    return Regression(
        n_points=len(points),
        n_episodes=points.n_episodes,
        order=form[0],
        ambient=form[1],
        coefficients=dict(zip(names, solution.tolist(), strict=True)),
        points=StationaryPoints(points.power, points.difference_K, points.ambient_K),
    )
