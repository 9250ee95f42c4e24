"""Outliers of a fleet by a robust rule that allows for the number of turbines and of quantities.

On the logarithm x of a positive quantity, with standard errors e from its bounds,

    z_i = (x_i − med x) / √(S² − ē² + e_i²),   S = 1.4826 med |x − med x|,   ē² = med e²  (S² − ē² at least
    0),

so a turbine with wide bounds must deviate further.  |z| is compared with the largest |z| of as many normal
numbers, which is simulated (`FLEET_SEED`): the probability of any outlier in a fleet of identical turbines is
`SIGNIFICANCE`, divided among the compared quantities (Bonferroni).
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
"""Fewest turbines among which outliers are sought."""
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
    """A quantity over the N turbines of a fleet that have a value.

    x: logarithms of the values (N,).  error: their standard errors (N,), NaN without bounds.  open: turbines
    whose value or bounds are not positive and finite.  center: median of x.  between: standard deviation of x
    between the turbines, without the part that their bounds explain.  z: robust distances (N,); p: their
    p-values (N,) corrected for the number of turbines and quantities; both NaN below `FEWEST_JUDGED`
    turbines.  rejected: turbines whose value the verdict rejects.
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
        """Indices of the outliers, sorted by distance, farthest first."""
        return [int(i) for i in np.argsort(-np.abs(self.z)) if self.p[i] < SIGNIFICANCE]

    @property
    def explained(self) -> bool:
        """Whether the bounds explain the scatter of the turbines that are not outliers (Cochran's Q).

        `between` does not suffice, because the median deviation misses a few deviating turbines, and because
        fewer than `FEWEST_JUDGED` turbines have no outliers.
        """
        from scipy.special import chdtrc

        kept = np.delete(np.arange(len(self.x)), self.outliers)
        x, weight = self.x[kept], self.error[kept] ** -2.0
        if len(kept) < 2:
            return True
        q = float(weight @ (x - weight @ x / weight.sum()) ** 2)
        return bool(chdtrc(len(kept) - 1, q) > SIGNIFICANCE)


def spreads(rows: Sequence[Row], compared: Sequence[Compared]) -> list[Scatter]:
    """The scatter of every quantity of which at least one turbine has a positive value."""
    present = [
        quantity for quantity in compared if any(cell_number(row, quantity.column) > 0 for row in rows)
    ]
    return [spread(rows, quantity, len(present)) for quantity in present]


def spread(rows: Sequence[Row], compared: Compared, quantities: int = 1) -> Scatter:
    """The scatter of one quantity; `quantities` is the number of quantities among which `SIGNIFICANCE` is
    divided."""
    names, x, error, open_, rejected = [], [], [], [], []
    for row in rows:
        value = cell_number(row, compared.column)
        if not value >= 0:
            continue
        if compared.rejected(row):
            rejected.append(str(row["turbine"]))
            continue
        if value == 0:  # no logarithm
            open_.append(str(row["turbine"]))
            continue
        low, high = (cell_number(row, name) if name else np.nan for name in (compared.lower, compared.upper))
        if compared.lower and not 0 < low < high:
            open_.append(str(row["turbine"]))
            continue
        names.append(str(row["turbine"]))
        x.append(np.log(value))
        error.append(np.log(high / low) / (2.0 * INTERVAL_SD) if compared.lower else np.nan)
    logs, sds = np.array(x), np.array(error)
    undefined = np.full(len(logs), np.nan)
    if not len(logs):
        return Scatter(
            compared, (), logs, sds, tuple(open_), np.nan, np.nan, undefined, undefined, tuple(rejected)
        )
    center = float(np.median(logs))
    scale = TO_SD * float(np.median(np.abs(logs - center)))
    variances = sds**2 if compared.lower else np.zeros(len(logs))
    median_variance = float(np.median(variances))
    between = float(np.sqrt(max(scale**2 - median_variance, 0.0)))
    z = p = undefined
    if len(logs) >= FEWEST_JUDGED and scale > 0:
        total = scale**2 - min(median_variance, scale**2) + variances if variances.any() else scale**2
        z = (logs - center) / np.sqrt(total)
        largest = _largest_distances(len(logs))
        exceeding = len(largest) - np.searchsorted(largest, np.abs(z), side="left")
        p = np.minimum(1.0, quantities * ((exceeding + 1.0) / (len(largest) + 1.0)))
    return Scatter(compared, tuple(names), logs, sds, tuple(open_), center, between, z, p, tuple(rejected))


@cache
def _largest_distances(count: int) -> np.ndarray:
    """Largest |z| of `count` normal numbers, scaled by their median deviation, in each of many draws;
    sorted."""
    random = np.random.default_rng(FLEET_SEED)
    draws = max(SIMULATED_FLEETS // 8, min(SIMULATED_FLEETS, 8_000_000 // count))
    largest = np.empty(draws)
    part = max(1, NUMBERS_AT_ONCE // count)
    for start in range(0, draws, part):
        x = random.normal(size=(min(part, draws - start), count))
        deviation = np.abs(x - np.median(x, axis=1, keepdims=True))
        largest[start : start + part] = deviation.max(axis=1) / (TO_SD * np.median(deviation, axis=1))
    return np.sort(largest)
