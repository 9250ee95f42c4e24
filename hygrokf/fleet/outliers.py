"""Outliers of a fleet, by a robust rule that allows for the number of turbines and of quantities.

For the logarithm x of a positive quantity, with standard errors e from its bounds,

    z_i = (x_i − med x) / √(S² − ē² + e_i²),   S = 1.4826 med |x − med x|,   ē² = med e²  (S² − ē² at least
    0),

so that a turbine with wide bounds must deviate further. |z| is compared with the largest |z| among as many
normal numbers, which is simulated (`FLEET_SEED`): the probability of any outlier in a fleet of identical
turbines is `SIGNIFICANCE`, divided among the compared quantities (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from hygrokf.estimation.conventions import SIGNIFICANCE
from hygrokf.fleet.job import Row, cell_number
from hygrokf.fleet.tasks import Compared

FEWEST_JUDGED = 6
"""Smallest number of turbines among which outliers are looked for."""
SIMULATED_FLEETS, FLEET_SEED = 4000, 20
"""Number of simulated fleets, and the seed of the simulation."""
TO_SD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
INTERVAL_SD = 1.959963984540054
"""Half-width of a 95 % interval, in standard deviations."""
NUMBERS_AT_ONCE = 2_000_000
"""Largest number of normal numbers in memory at once."""


@dataclass(frozen=True)
class Scatter:
    """The values of a quantity in a fleet, of the N turbines that have one.

    x: (N,) logarithms of the values. error: (N,) their standard errors, NaN without bounds. open: turbines
        whose value or bounds are not positive and finite. center: median of x. between: standard deviation of
        x between turbines, without the part that their bounds explain. z: (N,) robust distances; p: (N,)
        their p-values, corrected for the numbers of turbines and quantities; both NaN for fewer than
        `FEWEST_JUDGED` turbines. rejected: turbines whose value is not reliable.
    """

    compared: Compared
    turbines: tuple[str, ...]
    x: np.ndarray
    error: np.ndarray
    open: tuple[str, ...]
    center: float
    between: float
    z: np.ndarray
    p: np.ndarray
    rejected: tuple[str, ...] = ()

    @property
    def outliers(self) -> list[int]:
        """Indices of the outliers, the farthest first."""
        return [int(index) for index in np.argsort(-np.abs(self.z)) if self.p[index] < SIGNIFICANCE]

    @property
    def explained(self) -> bool:
        """Whether the bounds explain the scatter of the turbines that are not outliers (Cochran's Q).

        `between` alone does not tell, because the median deviation misses a few deviating turbines, and
        because fewer than `FEWEST_JUDGED` turbines have no outliers.
        """
        from scipy.special import chdtrc

        inner = np.delete(np.arange(len(self.x)), self.outliers)
        x, weight = self.x[inner], self.error[inner] ** -2.0
        if len(inner) < 2:
            return True
        cochran_q = float(weight @ (x - weight @ x / weight.sum()) ** 2)
        return bool(chdtrc(len(inner) - 1, cochran_q) > SIGNIFICANCE)


def spreads(rows: Sequence[Row], compared: Sequence[Compared]) -> list[Scatter]:
    """Return the scatter of every quantity of which at least one turbine has a positive value."""
    present = [
        quantity for quantity in compared if any(cell_number(row, quantity.column) > 0 for row in rows)
    ]
    return [spread(rows, quantity, len(present)) for quantity in present]


def spread(rows: Sequence[Row], compared: Compared, quantities: int = 1) -> Scatter:
    """Return the scatter of one quantity; quantities: number of quantities among which `SIGNIFICANCE` is
    divided."""
    names, logarithms, errors, without_bounds, rejected = [], [], [], [], []
    for row in rows:
        value = cell_number(row, compared.column)
        if not value >= 0:
            continue
        if compared.rejected(row):
            rejected.append(str(row["turbine"]))
            continue
        if value == 0:  # no logarithm
            without_bounds.append(str(row["turbine"]))
            continue
        lower, upper = (
            cell_number(row, name) if name else np.nan for name in (compared.lower, compared.upper)
        )
        if compared.lower and not 0 < lower < upper:
            without_bounds.append(str(row["turbine"]))
            continue
        names.append(str(row["turbine"]))
        logarithms.append(np.log(value))
        errors.append(np.log(upper / lower) / (2.0 * INTERVAL_SD) if compared.lower else np.nan)
    x, error = np.array(logarithms), np.array(errors)
    all_nan = np.full(len(x), np.nan)
    if not len(x):
        return Scatter(
            compared, (), x, error, tuple(without_bounds), np.nan, np.nan, all_nan, all_nan, tuple(rejected)
        )
    center = float(np.median(x))
    scale = TO_SD * float(np.median(np.abs(x - center)))
    variances = error**2 if compared.lower else np.zeros(len(x))
    median_variance = float(np.median(variances))
    between = float(np.sqrt(max(scale**2 - median_variance, 0.0)))
    z = p = all_nan
    if len(x) >= FEWEST_JUDGED and scale > 0:
        variance_of_distance = (
            scale**2 - min(median_variance, scale**2) + variances if variances.any() else scale**2
        )
        z = (x - center) / np.sqrt(variance_of_distance)
        largest = _largest_distances(len(x))
        count_exceeding = len(largest) - np.searchsorted(largest, np.abs(z), side="left")
        p = np.minimum(1.0, quantities * ((count_exceeding + 1.0) / (len(largest) + 1.0)))
    return Scatter(
        compared, tuple(names), x, error, tuple(without_bounds), center, between, z, p, tuple(rejected)
    )


@cache
def _largest_distances(count: int) -> np.ndarray:
    """Return the largest |z| of `count` normal numbers, scaled by their median deviation, in each of many
    draws; sorted."""
    random = np.random.default_rng(FLEET_SEED)
    draws = max(SIMULATED_FLEETS // 8, min(SIMULATED_FLEETS, 8_000_000 // count))
    largest = np.empty(draws)
    draws_at_once = max(1, NUMBERS_AT_ONCE // count)
    for start in range(0, draws, draws_at_once):
        numbers = random.normal(size=(min(draws_at_once, draws - start), count))
        deviations = np.abs(numbers - np.median(numbers, axis=1, keepdims=True))
        largest[start : start + draws_at_once] = deviations.max(axis=1) / (
            TO_SD * np.median(deviations, axis=1)
        )
    return np.sort(largest)
