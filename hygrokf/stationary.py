"""Heat release by operating point from quasi-stationary periods: equation (1) and Fig. 4 of the paper.

Where nothing changes, T_conv,a − T_amb = Q R_AT is the heat release itself [K]. A *cell* is a stretch of the power's
clock of at least ten minutes; a *period* is a run of cells over which temperatures and power stay within their
tolerances; an *episode* is what belongs to one spell of weather, within which periods are no independent readings.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
    if time_constant_h is None:
        block_s = 3600.0 * max(1.0, slowest_h)
        time_constant_h = _rough_time_constant(_cells(known, scale_W, np.arange(first, last, block_s)))
        rough = True
    else:
        rough = False
    cells = _cells(known, scale_W, _edges(used[-1] if scale_W else used[0], first, last))
    shortest_h = max(SHORTEST_H, 2.0 * slowest_h)
    longest_h = max(LONGEST_H if time_constant_h is None else min(TIME_CONSTANTS * time_constant_h, LONGEST_H), shortest_h)
    earliest = _earliest_starts(cells, longest_h)
    made: dict[str, Regression | None] = {OPERATION: None, STANDSTILL: None}
    for regime in (OPERATION, STANDSTILL) if scale_W else (STANDSTILL,):
        window_h, points, why = _choose_window(cells, earliest, regime, shortest_h, longest_h)
        n, episodes = len(points.power), _count(points.episode)
        if n < FEWEST[0] or episodes < FEWEST[1]:
            statements.append(_too_few(cells, regime, n, episodes, window_h))
            continue
        lead = _window_reason(window_h, time_constant_h, rough, why)
        made[regime] = _regression(regime, points, window_h, reference_K, time_constant_h, largest_order, lead)
        statements.append(made[regime].statement)
    return HeatRelease(
        made[OPERATION], made[STANDSTILL], reference_K, scale_W, time_constant_h, "; ".join(statements)
    )
