"""Heat release by operating point from quasi-stationary periods: equation (1) and Fig. 4 of the paper."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace

import numpy as np

from hygrokf.data.record import Record
from hygrokf.identification.periods import (
    AMBIENT,
    ENOUGH,
    OPERATION,
    POWER,
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
from hygrokf.modelling.design import TEMPERATURE, power_scale, reading_step_h
from hygrokf.physics.mechanisms.thermal import heat_release
from hygrokf.physics.parameters import Parameter

TIME_CONSTANTS = 3.0
"""[1] length of periods in thermal time constants, where enough periods are that long."""
SHORTEST_H = 1.0
"""[h] shortest period; periods also last at least two steps of the slowest series."""
LONGEST_H = 12.0
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
MOST_POINTS = 2000
"""Largest number of points of a regime in the results of a fit."""


@dataclass(frozen=True)
class Coefficient:
    """A coefficient of the heat release: `value` by least squares, `se` clustered by episode, `robust` by
    Huber."""

    value: float
    se: float
    robust: float


@dataclass(frozen=True)
class Candidate:
    """One form tried by leave-one-episode-out cross-validation.

    `error_K` [K] is the root mean square error over the episodes left out; `excess`, `excess_se` [K²] are the
    mean square error above the best form's and the standard error of this difference over episodes.
    """

    order: int
    ambient: bool
    error_K: float
    excess: float
    excess_se: float
    chosen: bool


@dataclass(frozen=True)
class StationaryPoints:
    """Quasi-stationary periods (N,), one point each, in order of time.

    `start_s`, `end_s` [s] since 1970-01-01T00:00Z; means over the period: `power` P/P_rated [1],
    `difference_K` T_conv,a − T_amb, `ambient_K` T_amb; `episode` numbers from 0; `settled_K` the fitted
    difference T_conv,a − T_amb, `fitted_K` the fit.
    """

    start_s: np.ndarray = field(default_factory=lambda: np.empty(0))
    end_s: np.ndarray = field(default_factory=lambda: np.empty(0))
    power: np.ndarray = field(default_factory=lambda: np.empty(0))
    difference_K: np.ndarray = field(default_factory=lambda: np.empty(0))
    ambient_K: np.ndarray = field(default_factory=lambda: np.empty(0))
    episode: np.ndarray = field(default_factory=lambda: np.empty(0))
    settled_K: np.ndarray = field(default_factory=lambda: np.empty(0))
    fitted_K: np.ndarray = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        found = {one.name: len(getattr(self, one.name)) for one in fields(self)}
        needed = {found[name] for name in ("power", "difference_K", "ambient_K")}
        if len(needed) > 1 or set(found.values()) - {0, len(self)}:
            raise ValueError(f"expected one number for each of {len(self)} periods, found {found}")

    def __len__(self) -> int:
        return len(self.power)

    def thinned(self) -> StationaryPoints:
        """At most `MOST_POINTS` of the points, evenly thinned."""
        kept = slice(None, None, max(1, math.ceil(len(self) / MOST_POINTS)))
        return StationaryPoints(**{name: value[kept] for name, value in vars(self).items()})


@dataclass(frozen=True)
class Regression:
    """The regression of one regime, operation or standstill.

    `window_h` [h] length of the periods; `order` of the polynomial in P/P_rated; `ambient` whether there is a
    slope over T_amb; `coefficients` by parameter name of `mechanisms.thermal.heat_release`;
    `cross_validation` the forms tried; `points` the periods; `transient_K` [K] root mean square contribution
    of the periods' own warming or cooling to the difference (None without a time constant), `settled` whether
    it is subtracted; `r2` [1]; `residual_sd_K` [K].
    """

    n_points: int = 0
    n_episodes: int = 0
    window_h: float = math.nan
    order: int = 0
    ambient: bool = False
    coefficients: Mapping[str, Coefficient] = field(default_factory=dict)
    cross_validation: tuple[Candidate, ...] = ()
    r2: float = math.nan
    residual_sd_K: float = math.nan
    transient_K: float | None = None
    settled: bool = False
    points: StationaryPoints = field(default_factory=StationaryPoints)
    statement: str = ""


@dataclass(frozen=True)
class HeatRelease:
    """Heat release of both regimes; a regime is None where it cannot be fitted, and `statement` gives the
    reason.

    `reference_K` [K] ambient temperature at which the slopes are zero; `scale_W` [W] power that counts as 1
    (None without power: the whole record is standstill); `time_constant_h` [h] thermal time constant that
    determined the length of the periods, given or roughly estimated, None where it could not be estimated.
    """

    operation: Regression | None = None
    standstill: Regression | None = None
    reference_K: float | None = None
    scale_W: float | None = None
    time_constant_h: float | None = None
    statement: str = ""

    @property
    def regimes(self) -> dict[str, Regression]:
        """The regressions that could be fitted, by regime."""
        pairs = ((OPERATION, self.operation), (STANDSTILL, self.standstill))
        return {regime: one for regime, one in pairs if one is not None}

    def start(self) -> dict[str, float]:
        """Start values of the heat release's parameters by name, within their bounds; empty without a
        regression."""
        values: dict[str, float] = {}
        for regime, regression in self.regimes.items():
            for parameter in _parameters(regime, regression.order, regression.ambient):
                value = regression.coefficients[parameter.name].value
                values[parameter.name] = min(max(value, parameter.lower), parameter.upper)
        return values

    def thinned(self) -> HeatRelease:
        """The heat release with as many points as results hold."""
        thinned = {regime: replace(one, points=one.points.thinned()) for regime, one in self.regimes.items()}
        return replace(self, operation=thinned.get(OPERATION), standstill=thinned.get(STANDSTILL))


def heat_release_regression(
    record: Record, *, reference_K: float | None = None, time_constant_h: float | None = None
) -> HeatRelease:
    """Heat release f_ΔT = Q R_AT [K] in operation and at standstill, by regression over quasi-stationary
    periods.

        T_conv,a − T_amb = a₀ + a₁ p + … + a_K p^K + a_T (T_amb − T_ref) in operation,  b₀ + b_T (T_amb −
        T_ref) else

    record: only its identification period is used; every series on its own clock; p = 1 at
        `design.power_scale`.
    reference_K: [K] T_ref; None: the mean of the ambient readings, as in `design.design`.
    time_constant_h: [h] thermal time constant, where known; None: a rough estimate is made.

    Periods (`periods.Periods`) are three time constants long, so that the contribution of a period's own
    change ΔT_conv,a to its mean difference, −τ ΔT_conv,a/window by equation (2), is at most a third of a
    kelvin. Where that yields fewer than 30 periods in 10 episodes, or loses a quarter of the range of power
    or ambient temperature, shorter periods are used, down to an hour or two steps of the slowest series. As
    short periods are not settled, this contribution is subtracted before the regression, unlike in the paper,
    where cross-validation does not contradict it. Standard errors are clustered by episode; they include
    neither the sensors' accuracy nor omitted forms. Times at which a logged heater is on are left out.
    Between the powers of the periods the form is an interpolation.

    A regime with too few periods is None, and the statement gives the reason. Source: equation (1), Fig. 3
    and Fig. 4 of the paper.
    """
    early = record.identification()
    missing = [name for name in (TEMPERATURE, AMBIENT) if not has_readings(early, name)]
    if missing:
        text = f"no readings of {' and '.join(missing)}: no heat release from stationary periods"
        return HeatRelease(None, None, reference_K, None, time_constant_h, text)
    if reference_K is None:
        reference_K = float(np.nanmean(early[AMBIENT].value))
    statements = []
    scale_W = power_scale(early) if has_readings(early, POWER) else None
    if not has_readings(early, POWER):
        statements.append("no power in the record: all of it counts as standstill")
    elif scale_W is None:
        statements.append("the power never rises above zero: all of the record counts as standstill")
    used = [early[name] for name in (TEMPERATURE, AMBIENT, *((POWER,) if scale_W else ()))]
    slowest_h = max(max(reading_step_h(one), one.interval_s / 3600.0) for one in used)
    first, last = max(one.time[0] - one.interval_s for one in used), min(one.time[-1] for one in used)
    rough = time_constant_h is None
    if rough:
        blocks = np.arange(first, last, 3600.0 * max(1.0, slowest_h))
        time_constant_h = rough_time_constant(cells_between(early, scale_W, blocks))
    cells = cells_between(early, scale_W, cell_edges(used[-1] if scale_W else used[0], first, last))
    shortest_h = max(SHORTEST_H, 2.0 * slowest_h)
    wanted_h = LONGEST_H if time_constant_h is None else min(TIME_CONSTANTS * time_constant_h, LONGEST_H)
    wanted_h = max(wanted_h, shortest_h)
    earliest = earliest_starts(cells, wanted_h)
    regressions: dict[str, Regression] = {}
    for regime in (OPERATION, STANDSTILL) if scale_W else (STANDSTILL,):
        choice = choose_length(cells, earliest, regime, shortest_h, wanted_h)
        if len(choice.periods) < FEWEST_PERIODS[0] or choice.periods.n_episodes < FEWEST_PERIODS[1]:
            statements.append(_too_few(cells, regime, choice))
            continue
        lead = _length_words(wanted_h, shortest_h, time_constant_h, rough, choice.reason)
        fit = _regression(regime, choice, reference_K, time_constant_h, lead)
        regressions[regime] = fit
        statements.append(fit.statement)
    pair = (regressions.get(OPERATION), regressions.get(STANDSTILL))
    return HeatRelease(*pair, reference_K, scale_W, time_constant_h, "; ".join(statements))


# --- regression -----------------------------------------------------------------------------


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
) -> tuple[Candidate, ...]:
    """All forms; the simplest one whose error is within a standard error of the best one's is marked as
    chosen.

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
    rows = {}
    for form, sums in tried.items():
        excess = float((sums - best).sum()) / n
        apart = sums - best - counts * excess
        se = math.sqrt(episodes / (episodes - 1.0) * float(apart @ apart)) / n
        rows[form] = (math.sqrt(float(sums.sum()) / n), excess, se)
    within = [form for form, (_, excess, se) in rows.items() if excess <= se + 1e-12]
    chosen = min(within, key=lambda form: (form[0] + form[1], rows[form][0]))
    return tuple(Candidate(*form, *row, form == chosen) for form, row in rows.items())


def _regression(
    regime: str, choice: Choice, reference_K: float, time_constant_h: float | None, lead: str
) -> Regression:
    """Least squares with errors clustered by episode, and Huber's M-estimate beside it."""
    from statsmodels.regression.linear_model import OLS
    from statsmodels.robust.robust_linear_model import RLM

    points, forms = choice.periods, _forms(regime, choice.periods)
    response, transient_K, settled = points.difference_K, None, False
    candidates = _cross_validate(points, response, forms, reference_K)
    if time_constant_h is not None:
        lag = time_constant_h * points.rate_K_h
        transient_K = float(np.sqrt(np.mean(lag**2)))
        others = _cross_validate(points, response + lag, forms, reference_K)
        settled = min(c.error_K for c in others) <= WORSE * min(c.error_K for c in candidates)
        if settled:
            response, candidates = response + lag, others
    chosen = next(c for c in candidates if c.chosen)
    regressors = _regressors(points, chosen.order, chosen.ambient, reference_K)
    fit = OLS(response, regressors).fit(cov_type="cluster", cov_kwds={"groups": points.episode})
    sd = math.sqrt(float(fit.scale))
    robust = fit.params
    if sd > 1e-6:  # without scatter there are no outliers, and the scale of Huber's estimate would be 0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            huber = RLM(response, regressors).fit().params
        if np.isfinite(huber).all():
            robust = huber
    names = [parameter.name for parameter in _parameters(regime, chosen.order, chosen.ambient)]
    coefficients = {
        name: Coefficient(float(value), float(se), float(other))
        for name, value, se, other in zip(names, fit.params, fit.bse, robust, strict=True)
    }
    words = [
        f"{regime}: {_periods_words(choice)} ({lead})",
        _form_words(regime, points, chosen, sd, max(c.order for c in candidates) < LARGEST_ORDER),
        *_transient_words(transient_K, settled),
        *_doubts(points, coefficients),
    ]
    return Regression(
        n_points=len(points),
        n_episodes=points.n_episodes,
        window_h=choice.window_h,
        order=chosen.order,
        ambient=chosen.ambient,
        coefficients=coefficients,
        cross_validation=candidates,
        r2=0.0 if regressors.shape[1] == 1 else float(fit.rsquared),
        residual_sd_K=sd,
        transient_K=transient_K,
        settled=settled,
        points=StationaryPoints(
            points.start_s, points.end_s, points.power, points.difference_K, points.ambient_K,
            points.episode, response, regressors @ fit.params,
        ),
        statement="; ".join(words),
    )  # fmt: skip


# --- words ----------------------------------------------------------------------------------


def _many(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _periods_words(choice: Choice) -> str:
    periods = _many(len(choice.periods), "quasi-stationary period")
    return f"{periods} of {choice.window_h:.3g} h in {_many(choice.periods.n_episodes, 'episode')}"


def _length_words(
    wanted_h: float, shortest_h: float, time_constant_h: float | None, rough: bool, reason: str
) -> str:
    """The reason for the length of the periods, in words."""
    if time_constant_h is None:
        wanted = (
            f"the time constant is not known: the longest of which there are enough, up to {wanted_h:.3g} h"
        )
    else:
        source = "a rough" if rough else "the given"
        wanted = f"{wanted_h:.3g} h wanted by {source} time constant of {time_constant_h:.2g} h"
        if wanted_h == shortest_h:
            wanted = f"the shortest allowed; {source} time constant is {time_constant_h:.2g} h"
    return f"{wanted}; {reason}" if reason else wanted


def _too_few(cells: Cells, regime: str, choice: Choice) -> str:
    hours = float((cells.end - cells.start)[cells.regime == (regime == OPERATION)].sum()) / 3600.0
    if hours <= 0.0:
        return f"{regime}: none in the record"
    return (
        f"{regime}: {_periods_words(choice)} within {hours:.0f} h are too few for a regression, which "
        f"needs {FEWEST_PERIODS[0]} in {FEWEST_PERIODS[1]}: the likelihood alone determines the heat release"
    )


def _form_words(regime: str, points: Periods, chosen: Candidate, sd: float, limited: bool) -> str:
    shape = ("constant", "linear in the power", "quadratic in the power", "cubic in the power")[chosen.order]
    slope = "with a slope" if chosen.ambient else "without a slope"
    text = (
        f"the difference is {shape}, {slope} over the ambient temperature (by cross-validation); residual "
        f"{sd:.2g} K"
    )
    if regime == OPERATION and chosen.order == 0:
        low, high = np.quantile(points.power, [0.02, 0.98])
        if high - low < 2.0 * POWER_TOLERANCE:
            text += f"; the power hardly varies ({low:.2f} … {high:.2f} of rated), so its slope is unknown"
            return text
    if regime == OPERATION and limited:
        text += "; higher orders were not tried, because too few episodes cover every part of the power range"
    return text


def _transient_words(transient_K: float | None, settled: bool) -> list[str]:
    if transient_K is None:
        return []
    if settled:
        return [f"{transient_K:.2g} K is subtracted for warming and cooling within the periods"]
    return [
        "by the time constant, warming and cooling within the periods would be far larger than "
        "observed: nothing is subtracted"
    ]


def _doubts(points: Periods, coefficients: Mapping[str, Coefficient]) -> list[str]:
    doubts = []
    apart = [
        f"{name} {c.value:.3g} ± {c.se:.2g} against {c.robust:.3g}"
        for name, c in coefficients.items()
        if abs(c.value - c.robust) > 2.0 * c.se + 1e-9
    ]
    if apart:
        doubts.append(
            f"least squares and the robust fit differ by more than two standard errors: {', '.join(apart)}"
        )
    if points.n_episodes < 2 * ENOUGH[1]:
        doubts.append(f"with {points.n_episodes} episodes the standard errors are optimistic")
    return doubts
