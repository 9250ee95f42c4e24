"""Variances of sums of dependent terms: closed forms of autoregressions, and coverage of what they bound."""

from __future__ import annotations

import math

import numpy as np
import pytest
from builders.constant_level import constant_level
from scipy.signal import lfilter
from scipy.stats import norm, t

from hygrokf.estimation.confidence import uncertainty, wald_bounds
from hygrokf.estimation.optimiser import Objective, fit_mle
from hygrokf.estimation.serial_dependence import FEWEST_TERMS, long_run_covariance, optimal_block
from hygrokf.physics.parameters import Parameter
from hygrokf.texts.fit_codes import FitCode


def autoregression(random: np.random.Generator, memory: float, count: int) -> np.ndarray:
    """An Ornstein–Uhlenbeck process of unit variance at `count` instants, `memory` of them long."""
    phi = math.exp(-1.0 / memory)
    kicks = random.normal(size=count + 300) * math.sqrt(1.0 - phi * phi)
    return lfilter([1.0], [1.0, -phi], kicks)[300:]


def test_the_optimal_block_is_politis_and_whites_for_an_autoregression() -> None:
    """Σ |k| φ^|k| / Σ φ^|k| = 2φ/(1 − φ²), and b³ = 3/2 of its square times n; the estimates of 20 long
    series scatter by a few per cent."""
    phi, n = math.exp(-0.25), 20_000
    ratio = 2.0 * phi / (1.0 - phi * phi)
    random = np.random.default_rng(21)
    found = np.array([optimal_block(autoregression(random, 4.0, n)) for _ in range(20)])
    assert np.median(found) == pytest.approx((1.5 * ratio**2 * n) ** (1 / 3), rel=0.07)


def test_the_variance_of_a_sum_is_that_of_an_autoregression() -> None:
    """(1 + φ)/(1 − φ) times that of independent terms; the mean over 40 series is known to 4 %."""
    phi, n = math.exp(-0.25), 5_000
    random = np.random.default_rng(22)
    each = [long_run_covariance(autoregression(random, 4.0, n)[:, None]).covariance[0, 0] for _ in range(40)]
    assert np.mean(each) / n == pytest.approx((1.0 + phi) / (1.0 - phi), rel=0.1)


def test_independent_terms_have_the_plain_variance() -> None:
    """400 n times the variance; the mean over 200 draws of 21 cosines is known to 2.2 %."""
    random = np.random.default_rng(23)
    draws = [long_run_covariance(random.normal(size=(400, 3))).covariance for _ in range(200)]
    found = np.mean(draws, axis=0)
    enlarged = (t.ppf(0.975, 21) / norm.ppf(0.975)) ** 2
    np.testing.assert_allclose(found / (400 * enlarged), np.eye(3), atol=0.07)


def test_a_covariance_of_columns_with_different_memories_is_positive() -> None:
    random = np.random.default_rng(24)
    slow, fast = autoregression(random, 20.0, 500), random.normal(size=500)
    terms = np.column_stack([slow, fast, slow - fast])
    found = long_run_covariance(terms).covariance
    assert np.linalg.eigvalsh(found / np.sqrt(np.outer(np.diag(found), np.diag(found)))).min() > -1e-12
    alone = long_run_covariance(fast[:, None]).covariance[0, 0]
    assert found[1, 1] == pytest.approx(alone, rel=1e-12)


def test_too_short_a_series_says_how_long_it_must_be() -> None:
    trend = np.linspace(-1.0, 1.0, 60)[:, None]
    needed = long_run_covariance(trend).needed[0]
    assert needed > 1.0
    assert long_run_covariance(trend[: FEWEST_TERMS // 2]).needed[0] == 2.0


@pytest.mark.parametrize(("memory", "noise"), [(0.2, 0.0), (4.0, 0.0), (4.0, 1.0)])
@pytest.mark.parametrize("count", [48, 120, 240, 960])
def test_bounds_of_a_mean_hold(memory: float, noise: float, count: int) -> None:
    """95 % bounds of the mean of 400 series: 0.90 less three standard errors of a share, 0.045."""
    random = np.random.default_rng(round(1000 * memory + 10 * noise + count))
    given = held = 0
    for _ in range(400):
        terms = autoregression(random, memory, count) + noise * random.normal(size=count)
        found = long_run_covariance(terms[:, None])
        if found.needed[0] <= 1.0:
            given += 1
            held += abs(terms.sum()) <= 1.959964 * math.sqrt(found.covariance[0, 0])
    assert given >= (400 if count > 900 else 360)
    assert held >= (0.90 - 0.045) * given


@pytest.mark.slow
@pytest.mark.parametrize("hours", [48, 120, 240, 960])
def test_the_sandwich_holds_under_a_disturbance_that_the_model_lacks(hours: int) -> None:
    """200 records of hourly readings about a mean with a disturbance of 3 h: given and right in 0.90 of them
    (less two standard errors of a share, 0.04), or refused; never refused at 960 h."""
    random = np.random.default_rng(hours)
    parameters = [
        Parameter("mean", "K", 3.0, -50.0, 50.0),
        Parameter("spread", "K", 1.0, 1e-3, 1e3, positive=True, noise=True),
    ]
    given = held = 0
    for _ in range(200):
        read = 3.0 + autoregression(random, 3.0, hours) + 0.2 * random.normal(size=hours)
        likelihood = constant_level(parameters, read, lambda p: p.mean, lambda p: p.spread * p.spread)
        estimate = fit_mle(likelihood, count=1)
        known = uncertainty(Objective(likelihood, estimate.coordinates), estimate)
        bounds = wald_bounds(estimate, known, "mean", 0.95, "sandwich")
        if bounds.method == "none":
            assert [one.code for one in bounds.statements] == [FitCode.NO_SANDWICH]
            continue
        given += 1
        held += bounds.lower <= 3.0 <= bounds.upper
    assert given == 200 or (hours < 960 and given >= 150)
    assert held >= (0.90 - 0.04) * given
