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
"""[1] length of periods in thermal time constants, unless that yields too few periods."""
SHORTEST_PERIOD_H = 1.0
"""[h] shortest period; periods also last at least two steps of the slowest series."""
LONGEST_PERIOD_H = 12.0
"""[h] longest period: sun and weather change over a day."""
FEWEST_PERIODS = (8, 5)
"""Fewest periods and episodes for a regression."""
EPISODES_A_PARAMETER = 3
"""Number of episodes needed for each coefficient."""
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
    """Quasi-stationary periods (N,), one point each, in order of time.

    Means over the period: `power` P/P_rated [1], `difference_K` T_conv,a − T_amb, `ambient_K` T_amb.
    """

    power: np.ndarray = field(default_factory=lambda: np.empty(0))
    difference_K: np.ndarray = field(default_factory=lambda: np.empty(0))
    ambient_K: np.ndarray = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        """Check that all arrays have one length; raises ValueError."""
        lengths = {name: len(value) for name, value in vars(self).items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"expected one number for each of {len(self)} periods, found {lengths}")

    def __len__(self) -> int:
        return len(self.power)

    def thinned(self) -> StationaryPoints:
        """Return at most `MOST_REGIME_POINTS` of the points, evenly thinned."""
        every_nth = slice(None, None, max(1, math.ceil(len(self) / MOST_REGIME_POINTS)))
        return StationaryPoints(**{name: value[every_nth] for name, value in vars(self).items()})


@dataclass(frozen=True)
class Regression:
    """The heat release of one regime (operation or standstill) as a polynomial in the power.

    `order`: of the polynomial in P/P_rated.  `ambient`: whether there is a slope over T_amb.
    `coefficients`: by parameter name of `mechanisms.thermal.heat_release`.  `points`: the periods.
    """

    n_points: int = 0
    n_episodes: int = 0
    order: int = 0
    ambient: bool = False
    coefficients: Mapping[str, float] = field(default_factory=dict)
    points: StationaryPoints = field(default_factory=StationaryPoints)


@dataclass(frozen=True)
class HeatRelease:
    """Heat release of both regimes; None for a regime that cannot be fitted, with the reason in `statements`.

    `reference_K` [K]: ambient temperature at which the slopes are zero.
    """

    operation: Regression | None = None
    standstill: Regression | None = None
    reference_K: float | None = None
    statements: tuple[Statement, ...] = ()

    @property
    def regimes(self) -> dict[str, Regression]:
        """The regressions that could be fitted, by regime."""
        pairs = ((OPERATION, self.operation), (STANDSTILL, self.standstill))
        return {regime: regression for regime, regression in pairs if regression is not None}

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
        """Return start values of the heat release's parameters, within their bounds; empty without a
        regression."""
        values: dict[str, float] = {}
        for regime, regression in self.regimes.items():
            for parameter in _parameters(regime, regression.order, regression.ambient):
                value = regression.coefficients[parameter.name]
                values[parameter.name] = min(max(value, parameter.lower), parameter.upper)
        return values

    def thinned(self) -> HeatRelease:
        """Return the heat release with as few points as results store."""
        thinned = {
            regime: replace(regression, points=regression.points.thinned())
            for regime, regression in self.regimes.items()
        }
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
    identification_part = record.identification()
    missing = tuple(
        name
        for name in (CABINET_TEMPERATURE, AMBIENT_TEMPERATURE)
        if not has_readings(identification_part, name)
    )
    if missing:
        return HeatRelease(None, None, reference_K, (FitCode.NO_READINGS_FOR_PERIODS(signals=missing),))
    if reference_K is None:
        reference_K = float(np.nanmean(identification_part[AMBIENT_TEMPERATURE].value))
    statements: list[Statement] = []
    scale_W = power_scale(identification_part) if has_readings(identification_part, ACTIVE_POWER) else None
    if not has_readings(identification_part, ACTIVE_POWER):
        statements.append(FitCode.NO_POWER())
    elif scale_W is None:
        statements.append(FitCode.POWER_NEVER_POSITIVE())
    used_series = [
        identification_part[name]
        for name in (CABINET_TEMPERATURE, AMBIENT_TEMPERATURE, *((ACTIVE_POWER,) if scale_W else ()))
    ]
    slowest_h = max(max(reading_step_h(series), series.interval_s / 3600.0) for series in used_series)
    start_s, end_s = (
        max(series.time[0] - series.interval_s for series in used_series),
        min(series.time[-1] for series in used_series),
    )
    blocks = np.arange(start_s, end_s, 3600.0 * max(1.0, slowest_h))
    time_constant_h = rough_time_constant(cells_between(identification_part, scale_W, blocks))
    cells = cells_between(
        identification_part,
        scale_W,
        cell_edges(used_series[-1] if scale_W else used_series[0], start_s, end_s),
    )
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
    both_regimes = (regressions.get(OPERATION), regressions.get(STANDSTILL))
    return HeatRelease(*both_regimes, reference_K, tuple(statements))


def _too_few(cells: Cells, regime: str, choice: Choice) -> Statement:
    """Return the statement that a regime is absent or has too few periods."""
    hours = float((cells.end - cells.start)[cells.regime == (regime == OPERATION)].sum()) / 3600.0
    if hours <= 0.0:
        return FitCode.REGIME_ABSENT(regime=regime)
    return FitCode.TOO_FEW_PERIODS(
        regime=regime, periods=len(choice.periods), window_h=choice.window_h,
        episodes=choice.periods.n_episodes, hours=hours, fewest_periods=FEWEST_PERIODS[0],
        fewest_episodes=FEWEST_PERIODS[1],
    )  # fmt: skip


def _parameters(regime: str, order: int, ambient: bool) -> tuple[Parameter, ...]:
    """Return the parameters of the heat release of a regime, in the order of the columns of `_regressors`."""
    running = regime == OPERATION
    return heat_release(
        order=order, ambient=ambient, standstill_ambient=ambient, operation=running, standstill=not running
    ).parameters


def _regressors(points: Periods, order: int, ambient: bool, reference_K: float) -> np.ndarray:
    """Return the regression's columns: powers of the relative power and, if wanted, the ambient
    temperature."""
    columns = [points.power**k for k in range(order + 1)]
    return np.column_stack([*columns, points.ambient_K - reference_K] if ambient else columns)


def _left_out(regressors: np.ndarray, response: np.ndarray, episode: np.ndarray) -> np.ndarray | None:
    """Return the sum of squared errors [K²] (G,) of each episode under the fit to all other episodes.

    None where the fit is not determined without one of the episodes.
    """
    if np.linalg.matrix_rank(regressors) < regressors.shape[1]:
        return None
    basis = np.linalg.qr(regressors)[0]
    residual = response - basis @ (basis.T @ response)
    squares_of_episodes = []
    for rows_of_episode in np.split(np.arange(len(response)), np.flatnonzero(np.diff(episode)) + 1):
        # (I − H_gg)⁻¹ e_g through the small matrix of the coefficients
        basis_of_episode = basis[rows_of_episode]
        small_matrix = np.eye(basis_of_episode.shape[1]) - basis_of_episode.T @ basis_of_episode
        if np.linalg.eigvalsh(small_matrix)[0] < 1e-6:
            return None
        error_without_episode = residual[rows_of_episode] + basis_of_episode @ np.linalg.solve(
            small_matrix, basis_of_episode.T @ residual[rows_of_episode]
        )
        squares_of_episodes.append(float(error_without_episode @ error_without_episode))
    return np.array(squares_of_episodes)


def _supported_order(points: Periods) -> int:
    """Return the largest polynomial order that the distribution of the power supports.

    For order K each of K+1 equal parts of the power's range must occur in enough episodes.  Periods cluster
    near standstill and at rated power, because the wind in between is rarely steady.  Without this rule a
    curve through both ends would be unconstrained in the middle, where cross-validation has no data either.
    """
    lowest, highest = points.power.min(), points.power.max()
    for order in range(LARGEST_ORDER, 0, -1):
        part_of_range = np.minimum(
            ((points.power - lowest) / (highest - lowest) * (order + 1)).astype(int), order
        )
        episode_counts = [
            len(np.unique(points.episode[part_of_range == part_number])) for part_number in range(order + 1)
        ]
        if min(episode_counts) >= EPISODES_A_PARAMETER:
            return order
    return 0


def _forms(regime: str, points: Periods) -> list[tuple[int, bool]]:
    """Return the forms (order, ambient slope) to try, as the spread of the periods permits; the constant is
    first."""
    largest_order = 0
    if regime == OPERATION and np.ptp(np.quantile(points.power, [0.02, 0.98])) >= 2.0 * POWER_TOLERANCE:
        largest_order = _supported_order(points)
    has_ambient_range = np.ptp(np.quantile(points.ambient_K, [0.05, 0.95])) >= LEAST_AMBIENT_K
    forms = [
        (order, ambient)
        for order in range(largest_order + 1)
        for ambient in ((False, True) if has_ambient_range else (False,))
    ]
    most_coefficients = points.n_episodes // EPISODES_A_PARAMETER
    return [form for form in forms if form == (0, False) or form[0] + 1 + form[1] <= most_coefficients]


def _cross_validate(
    points: Periods, response: np.ndarray, forms: list[tuple[int, bool]], reference_K: float
) -> tuple[tuple[int, bool], float]:
    """Choose a form by leave-one-episode-out cross-validation.

    forms: (order, ambient slope).  Returns the simplest form whose error is within a standard error of the
        best one's, and the best one's root mean square error [K].

    The standard error is that of the difference of both errors over episodes, so that errors common to all
    forms, such as a day's disturbance, do not hide a slope.
    """
    squares_by_form = {
        form: squares
        for form in forms
        if (squares := _left_out(_regressors(points, *form, reference_K), response, points.episode))
        is not None
    }
    best = min(squares_by_form.values(), key=lambda squares: float(squares.sum()))
    readings_by_episode = np.unique(points.episode, return_counts=True)[1]
    count, episode_count = len(points), points.n_episodes
    error_of_close_forms = {}
    for form, squares in squares_by_form.items():
        mean_excess = float((squares - best).sum()) / count
        centred_difference = squares - best - readings_by_episode * mean_excess
        standard_error = (
            math.sqrt(episode_count / (episode_count - 1.0) * float(centred_difference @ centred_difference))
            / count
        )
        if mean_excess <= standard_error + 1e-12:
            error_of_close_forms[form] = math.sqrt(float(squares.sum()) / count)
    chosen = min(error_of_close_forms, key=lambda form: (form[0] + form[1], error_of_close_forms[form]))
    return chosen, math.sqrt(float(best.sum()) / count)


def _regression(
    regime: str, points: Periods, reference_K: float, time_constant_h: float | None
) -> Regression:
    """Fit the heat release of a regime by least squares, in the form that cross-validation chooses.

    time_constant_h: for the contribution of a period's own temperature change, which is subtracted unless
        that increases the error by more than `WORSE`.
    """
    forms, response = _forms(regime, points), points.difference_K
    form, error_K = _cross_validate(points, response, forms, reference_K)
    if time_constant_h is not None:
        settled_response = response + time_constant_h * points.rate_K_h
        settled_form, settled_error_K = _cross_validate(points, settled_response, forms, reference_K)
        if settled_error_K <= WORSE * error_K:
            response, form = settled_response, settled_form
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
