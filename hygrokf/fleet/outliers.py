"""Outliers of a fleet: a robust rule that allows for the number of turbines and of quantities.

On the logarithm x of a positive quantity, with standard errors e from its bounds,

    z_i = (x_i − med x) / √(S² − ē² + e_i²),   S = 1.4826 med |x − med x|,   ē² = med e²  (S² − ē² at least
    0),

so a turbine with wide bounds must depart further.  z is compared with the largest |z| of as many normal
numbers, found by simulation (`SEED`): the chance of any outlier in a fleet of turbines that are alike is
`LEVEL`, shared by the quantities that are compared (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from hygrokf.fleet.job import Row, number
from hygrokf.fleet.tasks import Compared

LEVEL = 0.05
"""Chance of any outlier, in all quantities together, in a fleet of turbines that are alike."""
FEWEST_JUDGED = 6
"""Fewest turbines among which outliers are sought."""
DRAWS, SEED = 4000, 20
TO_SD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
REACH = 1.959963984540054
"""Half-width of a 95 % interval, in standard deviations."""
NUMBERS_AT_ONCE = 2_000_000


@dataclass(frozen=True)
class Scatter:
    """A quantity over the N turbines of a fleet that have a value.

    x: logarithms of the values (N,). error: their standard errors (N,), NaN without bounds. open: turbines
    without a value and bounds above zero. center: median of x. between: standard deviation of x between the
    turbines beyond their bounds. z: robust distances (N,); p: their chances (N,) corrected for the number of
    turbines and quantities; both NaN below `FEWEST_JUDGED` turbines. rejected: turbines whose value is not to
    be believed.
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
        return [int(i) for i in np.argsort(-np.abs(self.z)) if self.p[i] < LEVEL]

    @property
    def explained(self) -> bool:
        """Whether the bounds explain the scatter of the turbines without outliers (Cochran's Q).

        `between` does not suffice: the median deviation misses a few turbines that depart, and below
        `FEWEST_JUDGED` turbines there are no outliers.
        """
        from scipy.special import chdtrc

        kept = np.delete(np.arange(len(self.x)), self.outliers)
        x, weight = self.x[kept], self.error[kept] ** -2.0
        if len(kept) < 2:
            return True
        q = float(weight @ (x - weight @ x / weight.sum()) ** 2)
        return bool(chdtrc(len(kept) - 1, q) > LEVEL)


def spreads(rows: Sequence[Row], compared: Sequence[Compared]) -> list[Scatter]:
    """The spread of every quantity that any turbine has."""
    there = [one for one in compared if any(number(row, one.column) > 0 for row in rows)]
    return [spread(rows, one, len(there)) for one in there]


def spread(rows: Sequence[Row], compared: Compared, quantities: int = 1) -> Scatter:
    """The spread of one quantity, of `quantities` that share the chance of an outlier."""
    named, x, error, open_, rejected = [], [], [], [], []
    for row in rows:
        value = number(row, compared.column)
        if not value >= 0:
            continue
        if compared.rejected(row):
            rejected.append(str(row["turbine"]))
            continue
        if value == 0:  # no logarithm
            open_.append(str(row["turbine"]))
            continue
        low, high = (number(row, name) if name else np.nan for name in (compared.lower, compared.upper))
        if compared.lower and not 0 < low < high:
            open_.append(str(row["turbine"]))
            continue
        named.append(str(row["turbine"]))
        x.append(np.log(value))
        error.append(np.log(high / low) / (2.0 * REACH) if compared.lower else np.nan)
    logs, sds = np.array(x), np.array(error)
    nothing = np.full(len(logs), np.nan)
    if not len(logs):
        return Scatter(
            compared, (), logs, sds, tuple(open_), np.nan, np.nan, nothing, nothing, tuple(rejected)
        )
    center = float(np.median(logs))
    scale = TO_SD * float(np.median(np.abs(logs - center)))
    own = sds**2 if compared.lower else np.zeros(len(logs))
    between = float(np.sqrt(max(scale**2 - float(np.median(own)), 0.0)))
    z = p = nothing
    if len(logs) >= FEWEST_JUDGED and scale > 0:
        z = (logs - center) / np.sqrt(
            scale**2 - min(float(np.median(own)), scale**2) + own if own.any() else scale**2
        )
        largest = _largest(len(logs))
        beyond = len(largest) - np.searchsorted(largest, np.abs(z), side="left")
        p = np.minimum(1.0, quantities * ((beyond + 1.0) / (len(largest) + 1.0)))
    return Scatter(compared, tuple(named), logs, sds, tuple(open_), center, between, z, p, tuple(rejected))


@cache
def _largest(count: int) -> np.ndarray:
    """Largest |z| of so many normal numbers, scaled by their own median deviation, in each of many draws, in
    order."""
    random = np.random.default_rng(SEED)
    draws = max(DRAWS // 8, min(DRAWS, 8_000_000 // count))
    largest = np.empty(draws)
    part = max(1, NUMBERS_AT_ONCE // count)
    for start in range(0, draws, part):
        x = random.normal(size=(min(part, draws - start), count))
        away = np.abs(x - np.median(x, axis=1, keepdims=True))
        largest[start : start + part] = away.max(axis=1) / (TO_SD * np.median(away, axis=1))
    return np.sort(largest)
