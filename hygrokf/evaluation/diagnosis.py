"""Results of the tests of the innovations, as `fit.json` stores them.

Shapes: L lags, m frequencies.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from hygrokf.data.structured import optional
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import Name


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
class CrossCorrelation(Autocorrelation):
    """Correlation of innovations with one whitened input; at a positive lag the innovation is later than the
    input.  `p` [1]: probability under independence."""

    p: float = math.nan


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
class OutputDiagnosis:
    """Moments and whiteness of one output's standardised innovations.

    `n` readings, `step_h` [h] median step, `lags` longest lag in readings; `beyond_3`: share [1] beyond ±3;
    `cross_correlation`: by input, without inputs that hardly vary.  `remark`: why only `n` is known.
    """

    n: int = 0
    step_h: float = optional(math.nan)
    lags: int | None = optional()
    mean: float = optional(math.nan)
    variance: float = optional(math.nan)
    excess_kurtosis: float = optional(math.nan)
    beyond_3: float = optional(math.nan)
    autocorrelation: Autocorrelation | None = optional()
    cumulative_periodogram: CumulativePeriodogram | None = optional()
    periodogram: Periodogram | None = optional()
    cross_correlation: Mapping[str, CrossCorrelation] = field(default_factory=dict)
    remark: Statement | None = optional()


TestName: TypeAlias = Literal[
    "mean", "variance", "normality", "autocorrelation", "cumulative periodogram", "daily cycle", "correlation"
]
WHITENESS: tuple[TestName, ...] = ("autocorrelation", "cumulative periodogram")
"""Tests of the same property: whiteness."""


@dataclass(frozen=True)
class InnovationTest:
    """One test of an output's innovations: p [1], p adjusted by Holm's method, and whether it rejects.

    `input`: input of a tested correlation; `lag_h` [h]: longest lag of a tested autocorrelation; `statement`:
    the finding, if the test rejects.
    """

    output: Name
    test: TestName
    input: Name = optional("")
    lag_h: float = optional(math.nan)
    p: float = math.nan
    p_adjusted: float = math.nan
    rejected: bool = False
    statement: Statement | None = optional()


@dataclass(frozen=True)
class Diagnosis:
    """All tests of the innovations; the probability of any false alarm among them is `SIGNIFICANCE`."""

    outputs: Mapping[str, OutputDiagnosis] = field(default_factory=dict)
    tests: tuple[InnovationTest, ...] = ()

    @property
    def statements(self) -> tuple[Statement, ...]:
        """The findings for each output; of several rejections of whiteness only the first is included."""
        statements: list[Statement] = []
        for name, output in self.outputs.items():
            tests = [test for test in self.tests if test.output == name]
            rejections: dict[tuple[str, str], Statement] = {}
            for test in tests:
                if test.rejected and test.statement is not None:
                    kind = "whiteness" if test.test in WHITENESS else test.test
                    rejections.setdefault((kind, test.input), test.statement)
            white = [FitCode.WHITE(output=name, tests=len(tests))] if tests else []
            statements += [output.remark] if output.remark else rejections.values() or white
        return tuple(statements)
