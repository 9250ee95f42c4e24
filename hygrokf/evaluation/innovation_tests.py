"""Tests of the innovations: whiteness, distribution, and remaining correlation with the inputs; and their
results, as `fit.json` stores them.

Innovations divided by their standard deviations, e/√S, are white with unit variance if the model is correct,
whatever the time steps between the readings.  Autocorrelation and spectrum are therefore computed over the
*sequence of readings*: a lag is a number of readings, and a gap counts as one step.  Hours are lags times the
median step.

Shapes: T instants, n readings of one output, L lags, m frequencies.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from hygrokf.data.structured import optional
from hygrokf.estimation.confidence import normal_quantile
from hygrokf.estimation.conventions import SIGNIFICANCE
from hygrokf.evaluation.bootstrap import prediction_error
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import Name

SMALL_CORRELATION = 0.1
"""[1] correlations below this explain less than 1 % of the variance and are called small."""
FEWEST_DIAGNOSED = 30
"""Fewest readings for a diagnosis."""
MOST_POINTS = 400
"""Largest number of values in a list of the result: a longer list keeps of each stretch of equal length the
value farthest from zero."""
SPECTRUM_POINTS = 120
"""Bands of the periodogram, evenly spaced in the logarithm of the frequency."""
WHITENING_ORDER = 48
"""Largest order of the autoregression that whitens an input."""
OUTLIER_SD = 3.0
"""[1] absolute value of a standardised innovation above which it counts as an outlier."""
NOTE = (
    "standardised innovations e/√S of the identification period; lags count readings, a gap counts as one "
    "step, hours are lags times the median step; inputs are whitened by an autoregression before they are "
    "correlated (Haugh 1976); a correlation counts only where it exceeds its limit under equal and under "
    "unequal variance; all tests share one error rate (Holm 1979)"
)


# --- results ---------------------------------------------------------------------------------


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


# --- all outputs -----------------------------------------------------------------------------


def diagnose(
    time_h: np.ndarray,
    standardised: Mapping[str, np.ndarray],
    inputs: Mapping[str, np.ndarray],
    *,
    longest_h: float = 24.0,
) -> Diagnosis:
    """Test standardised innovations for whiteness, for their distribution, and for correlation with every
    input.

    time_h: [h] (T,) instants, increasing.
    standardised: output -> (T,) e/√S [1]; NaN where there is no reading.
    inputs: input -> (T,) values at the same instants [any unit]; NaN where unknown.
    longest_h: [h] longest lag; none is longer than a tenth of the readings.

    An output with fewer than 30 readings, or one that does not vary, has a statement only.
    Raises ValueError for another longest lag.

    Source: Ljung & Box 1978, doi:10.1093/biomet/65.2.297; Bartlett 1955 (cumulative periodogram,
        Kolmogorov–Smirnov); Haugh 1976, doi:10.1080/01621459.1976.10480354; Holm 1979.
    """
    time = np.asarray(time_h, dtype=float)
    if not 0.0 < longest_h < math.inf:
        raise ValueError(f"longest_h: expected a number of hours above 0, found {longest_h}")
    tests: list[InnovationTest] = []
    outputs: dict[str, OutputDiagnosis] = {}
    for name, values in standardised.items():
        e = np.where(np.isfinite(values), np.asarray(values, dtype=float), np.nan)
        is_read = np.isfinite(e)
        inputs_at_readings = {source: np.asarray(u, dtype=float)[is_read] for source, u in inputs.items()}
        outputs[name], output_tests = _output(name, time[is_read], e[is_read], inputs_at_readings, longest_h)
        tests += output_tests
    adjusted = _holm([test.p for test in tests])
    rows = tuple(
        replace(
            test,
            p_adjusted=p,
            rejected=p < SIGNIFICANCE,
            statement=test.statement if p < SIGNIFICANCE else None,
        )
        for test, p in zip(tests, adjusted, strict=True)
    )
    return Diagnosis(outputs, rows)


def _output(
    name: str, time: np.ndarray, e: np.ndarray, inputs: Mapping[str, np.ndarray], longest_h: float
) -> tuple[OutputDiagnosis, list[InnovationTest]]:
    """Run all tests on one output's innovations e (n,) at times (n,) [h]; returns the diagnosis and its
    tests."""
    count = len(e)
    if count < FEWEST_DIAGNOSED:
        remark = FitCode.TOO_FEW_INNOVATIONS(output=name, n=count, fewest=FEWEST_DIAGNOSED)
        return OutputDiagnosis(count, remark=remark), []
    if float(np.ptp(e)) <= 1e-12 * max(1.0, float(np.max(np.abs(e)))):
        return OutputDiagnosis(count, remark=FitCode.CONSTANT_INNOVATIONS(output=name)), []
    step_h = float(np.median(np.diff(time)))
    lags = int(min(max(round(longest_h / step_h), 1), count // 10))
    moments, tests = _moments(name, e)
    autocorrelation, whiteness_tests = _autocorrelation(name, e, step_h, lags)
    cumulative, periodogram, spectral = _spectrum(name, e, step_h)
    tests += [*whiteness_tests, spectral, *_daily_cycle(name, time, e)]
    cross_correlations = {}
    for source, values in inputs.items():
        if (correlation_and_test := _cross_correlation(name, source, e, values, step_h, lags)) is not None:
            cross_correlations[source], test = correlation_and_test
            tests.append(test)
    results_by_lag = (autocorrelation, cumulative, periodogram, cross_correlations)
    return OutputDiagnosis(count, step_h, lags, *moments, *results_by_lag), tests


# --- one series ------------------------------------------------------------------------------


def _moments(name: str, e: np.ndarray) -> tuple[tuple[float, float, float, float], list[InnovationTest]]:
    """Return mean, variance, excess kurtosis (0 for a normal distribution) and share beyond ±3, with their
    tests."""
    from scipy.stats import jarque_bera

    count = len(e)
    mean, variance = float(e.mean()), float(e.var())
    normalised = (e - mean) / math.sqrt(variance)
    skewness, kurtosis = float(np.mean(normalised**3)), float(np.mean(normalised**4) - 3.0)
    outlier_share = float(np.mean(np.abs(e) > OUTLIER_SD))
    # the sample kurtosis enters the variance of the sample variance: heavy tails alone cause no rejection
    standard_error = math.sqrt(max(kurtosis + 2.0, 1e-12) / count) * variance
    mean_code = FitCode.MEAN_SMALL if abs(mean) < SMALL_CORRELATION else FitCode.MEAN_BIASED
    variance_code = FitCode.WIDER_THAN_PREDICTED if variance > 1 else FitCode.NARROWER_THAN_PREDICTED
    tails_code = FitCode.TAILS_HEAVY if kurtosis > 0 else FitCode.TAILS_LIGHT
    shape_statement = tails_code() if abs(kurtosis) >= abs(skewness) else FitCode.SKEWED()
    tests: tuple[tuple[TestName, float, Statement], ...] = (
        ("mean", _two_sided(mean * math.sqrt(count / variance)), mean_code(output=name, mean=mean)),
        (
            "variance",
            _two_sided((variance - 1.0) / standard_error),
            variance_code(output=name, excess=abs(math.sqrt(variance) - 1.0), variance=variance),
        ),
        (
            "normality",
            float(jarque_bera(e).pvalue),
            FitCode.NOT_NORMAL(
                output=name,
                shape=shape_statement,
                kurtosis=kurtosis,
                skewness=skewness,
                beyond=outlier_share,
                expected=_two_sided(OUTLIER_SD),
            ),
        ),
    )
    return (mean, variance, kurtosis, outlier_share), [
        InnovationTest(name, test, p=p, statement=statement) for test, p, statement in tests
    ]


def _autocorrelation(
    name: str, e: np.ndarray, step_h: float, lags: int
) -> tuple[Autocorrelation, list[InnovationTest]]:
    """Return the autocorrelation up to `lags` readings, with Ljung–Box tests over all lags and over one hour.

    step_h: [h] between readings.
    """
    from statsmodels.tsa.stattools import acf, q_stat

    count = len(e)
    values = np.asarray(acf(e, nlags=lags, fft=True))[1:]
    _, p = q_stat(values, count)
    lags_per_hour = int(min(max(round(1.0 / step_h), 1), lags))
    limit_all = _simultaneous(lags) / math.sqrt(count)
    shown_indices = _extremes(values)
    limit = normal_quantile(1.0 - SIGNIFICANCE) / math.sqrt(count)
    autocorrelation = Autocorrelation(
        _rounded((shown_indices + 1) * step_h), _rounded(values[shown_indices]), limit, limit_all
    )
    tests = []
    for lag_count in dict.fromkeys((lags, lags_per_hour)):
        worst = int(np.argmax(np.abs(values[:lag_count])))
        p_value, value = float(p[lag_count - 1]), float(values[worst])
        statement = FitCode.AUTOCORRELATED(
            output=name, longest_h=lag_count * step_h, p=p_value, lag_h=(worst + 1) * step_h,
            size=_correlation_and_limit(value, limit_all), remarks=_remark_on_size(value),
        )  # fmt: skip
        tests.append(
            InnovationTest(name, "autocorrelation", lag_h=lag_count * step_h, p=p_value, statement=statement)
        )
    return autocorrelation, tests


def _spectrum(
    name: str, e: np.ndarray, step_h: float
) -> tuple[CumulativePeriodogram, Periodogram, InnovationTest]:
    """Return the cumulative periodogram with its Kolmogorov–Smirnov test, and the periodogram in bands.

    The spectrum is that of the sequence of readings; step_h: [h] between them.
    """
    from scipy.stats import chi2, kstest, kstwo

    count = len(e)
    power = np.abs(np.fft.rfft(e - e.mean())[1 : (count + 1) // 2]) ** 2
    power = power / power.mean()
    frequency_count = len(power)
    frequency = np.arange(1, frequency_count + 1) / (count * step_h)
    cumulative = np.cumsum(power) / frequency_count
    # for white noise the first m−1 values are distributed as the order statistics of m−1 uniform numbers
    kolmogorov = kstest(cumulative[:-1], "uniform")
    distance, p = float(kolmogorov.statistic), float(kolmogorov.pvalue)
    limit = float(kstwo.isf(SIGNIFICANCE, frequency_count - 1))
    offset = cumulative - np.arange(1, frequency_count + 1) / frequency_count
    worst = int(np.argmax(np.abs(offset)))
    shown_indices = np.unique(
        np.linspace(0, frequency_count - 1, min(frequency_count, MOST_POINTS)).astype(int)
    )
    cumulative_periodogram = CumulativePeriodogram(
        _rounded(frequency[shown_indices]), _rounded(cumulative[shown_indices]), distance, limit, p
    )
    edges = (
        np.unique(
            np.round(np.geomspace(1, frequency_count + 1, min(SPECTRUM_POINTS, frequency_count) + 1)).astype(
                int
            )
        )
        - 1
    )
    frequencies_in_band = np.diff(edges)
    periodogram = Periodogram(
        _rounded(np.add.reduceat(frequency, edges[:-1]) / frequencies_in_band),
        _rounded(np.add.reduceat(power, edges[:-1]) / frequencies_in_band),
        _rounded(chi2.ppf(SIGNIFICANCE / 2.0, 2 * frequencies_in_band) / (2 * frequencies_in_band)),
        _rounded(chi2.isf(SIGNIFICANCE / 2.0, 2 * frequencies_in_band) / (2 * frequencies_in_band)),
    )
    code = FitCode.SPECTRUM_TOO_HIGH if offset[worst] > 0 else FitCode.SPECTRUM_TOO_LOW
    statement = code(output=name, distance=distance, limit=limit, period_h=float(1.0 / frequency[worst]))
    test = InnovationTest(name, "cumulative periodogram", p=p, statement=statement)
    return cumulative_periodogram, periodogram, test


def _daily_cycle(name: str, time: np.ndarray, e: np.ndarray) -> list[InnovationTest]:
    """Test a 24 h sine fitted by least squares; no test if the record is too short to separate it from the
    mean."""
    count = len(e)
    angle = 2.0 * math.pi * time / 24.0
    regressors = np.column_stack([np.ones(count), np.cos(angle), np.sin(angle)])
    if time[-1] - time[0] < 48.0 or np.linalg.matrix_rank(regressors) < 3:
        return []
    coefficients, *_ = np.linalg.lstsq(regressors, e, rcond=None)
    residual_square = float(np.sum((e - regressors @ coefficients) ** 2))
    explained = 1.0 - residual_square / float(np.sum((e - e.mean()) ** 2))
    amplitude = float(math.hypot(coefficients[1], coefficients[2]))
    # the survival function of F with (2, n−3) degrees of freedom is a power of the unexplained share
    p = float((1.0 - min(max(explained, 0.0), 1.0)) ** ((count - 3) / 2.0))
    statement = FitCode.DAILY_CYCLE(output=name, amplitude=amplitude, p=p, explained=explained)
    return [InnovationTest(name, "daily cycle", p=p, statement=statement)]


# --- against the inputs ----------------------------------------------------------------------


def whitened(values: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the errors (n,) with which an autoregression predicts an input (n,), and its order.

    AIC selects the order, at most `WHITENING_ORDER`.  The errors are NaN at missing values, at values
    predicted from missing ones, and at the first values, as many as the order.
    """
    from statsmodels.tsa.stattools import acovf, levinson_durbin

    is_known = np.isfinite(values)
    centred = np.where(is_known, values - float(np.mean(values[is_known])), 0.0)
    count = len(values)
    largest_order = int(min(WHITENING_ORDER, max(count // 10, 1)))
    covariance = np.asarray(acovf(centred, fft=True, nlag=largest_order))
    _, _, _, error_variance, phi = levinson_durbin(covariance, nlags=largest_order, isacov=True)
    error_variance = np.concatenate([[covariance[0]], error_variance[1:]])
    criterion = count * np.log(np.maximum(error_variance, 1e-12 * covariance[0])) + 2.0 * np.arange(
        largest_order + 1
    )
    order = int(np.argmin(criterion))
    return prediction_error(centred, is_known, phi[1 : order + 1, order]), order


def _cross_correlation(
    name: str, source: str, e: np.ndarray, values: np.ndarray, step: float, lags: int
) -> tuple[CrossCorrelation, InnovationTest] | None:
    """Return the correlation of innovations with one input by lag, and its test.

    None where the input hardly varies, or where its own past predicts it without error.
    """
    known_values = values[np.isfinite(values)]
    if len(known_values) < FEWEST_DIAGNOSED:
        return None
    if float(np.ptp(known_values)) <= 1e-9 * max(1.0, float(np.max(np.abs(known_values)))):
        return None
    whitened_input, _ = whitened(values)
    is_known = np.isfinite(whitened_input)
    known_count = int(is_known.sum())
    input_square = float(np.sum(whitened_input[is_known] ** 2))
    if known_count < FEWEST_DIAGNOSED or input_square <= 0.0:
        return None
    whitened_input = np.where(is_known, whitened_input - float(whitened_input[is_known].mean()), 0.0)
    centred = e - e.mean()
    products = _lagged_products(centred, whitened_input, lags)
    correlations = products / math.sqrt(float(centred @ centred) * float(whitened_input @ whitened_input))
    # under unequal variance (a few large jumps of an input) the scatter of the products scales the test
    product_scatter = np.sqrt(np.maximum(_lagged_products(centred**2, whitened_input**2, lags), 1e-300))
    standardised_sizes = np.minimum(
        np.abs(correlations) * math.sqrt(known_count), np.abs(products) / product_scatter
    )
    lag_numbers = np.arange(-lags, lags + 1)
    worst_index = int(np.argmax(standardised_sizes))
    p_of_one_lag = _two_sided(float(standardised_sizes[worst_index]))
    p = float(-math.expm1(len(lag_numbers) * math.log1p(-p_of_one_lag))) if p_of_one_lag < 1.0 else 1.0
    limit_all = _simultaneous(len(lag_numbers)) / math.sqrt(known_count)
    shown_indices = _extremes(correlations)
    worst_lag_h = float(lag_numbers[worst_index] * step)
    value = float(correlations[worst_index])
    readings_lead_remark = (FitCode.READINGS_LEAD(input=source),) if worst_lag_h < 0 else ()
    statement = FitCode.CORRELATED_WITH_INPUT(
        output=name, input=source, lag_h=worst_lag_h,
        size=_correlation_and_limit(value, limit_all), remarks=_remark_on_size(value) or readings_lead_remark,
    )  # fmt: skip
    correlation = CrossCorrelation(
        _rounded(lag_numbers[shown_indices] * step),
        _rounded(correlations[shown_indices]),
        normal_quantile(1.0 - SIGNIFICANCE) / math.sqrt(known_count),
        limit_all,
        p,
    )
    return correlation, InnovationTest(name, "correlation", source, p=p, statement=statement)


def _lagged_products(a: np.ndarray, b: np.ndarray, lags: int) -> np.ndarray:
    """Return Σ_t a[t] b[t−k] for the lags k = −lags … lags."""
    from scipy.signal import correlate

    n = len(a)
    return np.asarray(correlate(a, b, method="fft")[n - 1 - lags : n + lags])


# --- numbers ---------------------------------------------------------------------------------


def _holm(p: list[float]) -> list[float]:
    """Return p values adjusted by Holm's method, so that the chance of any false rejection is the level."""
    # statsmodels' multipletests collects all garbage at each call, which takes longer than all the tests
    adjusted, largest_so_far = [0.0] * len(p), 0.0
    for rank, i in enumerate(np.argsort(p)):
        largest_so_far = max(largest_so_far, (len(p) - rank) * p[i])
        adjusted[i] = min(largest_so_far, 1.0)
    return adjusted


def _two_sided(z: float) -> float:
    """Return the probability that a standard normal number is farther from 0 than z."""
    return math.erfc(abs(z) / math.sqrt(2.0))


def _simultaneous(count: int) -> float:
    """Return the bound within which `count` independent normal numbers all lie with probability 1 −
    SIGNIFICANCE (Šidák)."""
    return normal_quantile((1.0 - SIGNIFICANCE) ** (1.0 / count))


def _extremes(values: np.ndarray) -> np.ndarray:
    """Return the indices of at most `MOST_POINTS` values to plot: the value farthest from zero in each
    stretch."""
    width = math.ceil(len(values) / MOST_POINTS)
    if width == 1:
        return np.arange(len(values))
    sizes = np.full(math.ceil(len(values) / width) * width, -1.0)
    sizes[: len(values)] = np.abs(values)
    return sizes.reshape(-1, width).argmax(axis=1) + width * np.arange(len(sizes) // width)


def _rounded(values: np.ndarray) -> tuple[float, ...]:
    """Return the values with six significant digits, enough for a figure."""
    return tuple(float(f"{value:.6g}") for value in np.asarray(values, dtype=float))


def _correlation_and_limit(r: float, limit: float) -> Statement:
    """Return the statement of a correlation and its limit, with enough digits to tell them apart."""
    near = round(abs(r), 2) == round(limit, 2)
    return (FitCode.CORRELATION_NEAR_LIMIT if near else FitCode.CORRELATION)(r=r, limit=limit)


def _remark_on_size(r: float) -> tuple[Statement, ...]:
    """Return the remark that a correlation explains little; empty for a larger one."""
    return (FitCode.SMALL_SHARE(share=r * r),) if abs(r) < SMALL_CORRELATION else ()
