"""What the tests of the innovations found, as it stands in `fit.json`.

Shapes: L lags, m frequencies.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from hygrokf.data.structured import optional


@dataclass(frozen=True)
class Statistic:
    """A test statistic with its probability `p` [1] under white innovations."""

    statistic: float = math.nan
    p: float = math.nan


@dataclass(frozen=True)
class LjungBox:
    """The Ljung–Box test of all lags up to `lag` readings, `lag_h` [h]."""

    lag: int
    lag_h: float
    statistic: float = math.nan
    p: float = math.nan


@dataclass(frozen=True)
class Autocorrelation:
    """Autocorrelation `value` (L,) [1] at lags `lag_h` (L,) [h].

    `limit`: of each lag by itself; `limit_all`: of all lags together.
    """

    lag_h: tuple[float, ...] = ()
    value: tuple[float, ...] = ()
    limit: float = math.nan
    limit_all: float = math.nan


@dataclass(frozen=True)
class LargestCorrelation:
    """The cross-correlation [1] farthest beyond its limit, its lag [h], and a sentence about it."""

    lag_h: float
    value: float
    words: str = ""


@dataclass(frozen=True)
class CrossCorrelation:
    """Correlation of innovations with one whitened input, in the form of `Autocorrelation`.

    A positive lag: the innovation comes after the input.  `order`: of the autoregression that whitens the
    input; `p` and `p_adjusted` [1]: probability under independence, alone and among all tests.  `statement`:
    why there is no correlation to show; everything else is empty then.
    """

    lag_h: tuple[float, ...] = optional(())
    value: tuple[float, ...] = optional(())
    limit: float = optional(math.nan)
    limit_all: float = optional(math.nan)
    order: int | None = optional()
    largest: LargestCorrelation | None = optional()
    p: float = optional(math.nan)
    p_adjusted: float = optional(math.nan)
    statement: str = optional("")


@dataclass(frozen=True)
class CumulativePeriodogram:
    """Cumulative share `value` (m,) [1] of the power up to `frequency_per_h` (m,) [1/h], with the
    Kolmogorov–Smirnov test against a straight line."""

    frequency_per_h: tuple[float, ...] = ()
    value: tuple[float, ...] = ()
    statistic: float = math.nan
    limit: float = math.nan
    p: float = math.nan


@dataclass(frozen=True)
class Periodogram:
    """Power (m,) [1] in bands about `frequency_per_h` (m,) [1/h]; white innovations stay between `lower` and
    `upper`."""

    frequency_per_h: tuple[float, ...] = ()
    power: tuple[float, ...] = ()
    lower: tuple[float, ...] = ()
    upper: tuple[float, ...] = ()


@dataclass(frozen=True)
class DailyCycle:
    """A sine of 24 h in the innovations: amplitude [standard deviations], explained variance [1], p [1]."""

    amplitude: float
    explained: float
    p: float


@dataclass(frozen=True)
class OutputDiagnosis:
    """Moments and whiteness of one output's standardised innovations.

    `n` readings, `step_h` [h] median step, `lags` longest lag in readings; `beyond_3`: share [1] beyond ±3,
    and the share of a normal distribution.  `daily_cycle`: None where the record is too short to tell it from
    the mean.  `cross_correlation`: by input.  With too few readings there are only `n` and `statements`.
    """

    n: int = 0
    step_h: float = optional(math.nan)
    lags: int | None = optional()
    mean: float = optional(math.nan)
    variance: float = optional(math.nan)
    skewness: float = optional(math.nan)
    excess_kurtosis: float = optional(math.nan)
    beyond_3: float = optional(math.nan)
    beyond_3_expected: float = optional(math.nan)
    jarque_bera: Statistic | None = optional()
    ljung_box: tuple[LjungBox, ...] = optional(())
    autocorrelation: Autocorrelation | None = optional()
    cumulative_periodogram: CumulativePeriodogram | None = optional()
    periodogram: Periodogram | None = optional()
    daily_cycle: DailyCycle | None = None
    cross_correlation: Mapping[str, CrossCorrelation] = field(default_factory=dict)
    statements: tuple[str, ...] = ()


@dataclass(frozen=True)
class InnovationTest:
    """One test of an output's innovations: p [1], p adjusted by Holm's method, and whether it rejects."""

    output: str
    test: str
    p: float = math.nan
    p_adjusted: float = math.nan
    rejected: bool = False


@dataclass(frozen=True)
class Diagnosis:
    """All tests of the innovations, at the probability `level` [1] of any false alarm among them."""

    level: float = math.nan
    note: str = ""
    outputs: Mapping[str, OutputDiagnosis] = field(default_factory=dict)
    tests: tuple[InnovationTest, ...] = ()
    statements: tuple[str, ...] = ()
