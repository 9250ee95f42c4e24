"""The bootstrap keeps its promises on series whose memory is known, where tests for white noise break
theirs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plants.chance import ornstein_uhlenbeck

from hygrokf.discovery.changes import change_p, drift_p, sharp_step
from hygrokf.discovery.significance import Null, Prewhitened, benjamini_hochberg, largest_p, linear_p, tail
from hygrokf.evaluation.bootstrap import autoregression, effective_size, integral_time_h, surrogates


def remembering(seed: int, size: int, time_h: float, step_h: float = 1.0) -> np.ndarray:
    """Ornstein–Uhlenbeck series of variance 1."""
    return ornstein_uhlenbeck(np.random.default_rng(seed), size, step_h, time_h)


def weekend(size: int) -> np.ndarray:
    """A condition of 30 h out of 100 h, as a column."""
    return ((np.arange(size) % 100) < 30).astype(float)[:, None]


@pytest.mark.parametrize("time_h", [4.0, 10.0])
def test_the_integral_time_of_an_exponential_memory_is_its_time_constant(time_h: float) -> None:
    found = [integral_time_h(remembering(seed, 5000, time_h)) for seed in range(6)]
    assert np.mean(found) == pytest.approx(time_h, rel=0.15)


def test_the_effective_size_tells_how_well_a_mean_is_known() -> None:
    means = [remembering(seed, 1500, 8.0).mean() for seed in range(300)]
    sizes = [effective_size(remembering(seed, 1500, 8.0)) for seed in range(20)]
    assert 1.0 / np.var(means) == pytest.approx(np.mean(sizes), rel=0.25)


def test_a_hole_does_not_change_what_is_found_around_it() -> None:
    values = remembering(3, 4000, 6.0)
    holed = values.copy()
    holed[1000:1300] = np.nan
    holed[2000:3000:9] = np.nan
    assert integral_time_h(holed) == pytest.approx(integral_time_h(values), rel=0.2)
    assert np.isnan(autoregression(holed)[1][1000:1300]).all()


def test_the_autoregression_finds_the_coefficients_of_its_kind() -> None:
    random = np.random.default_rng(5)
    values, kicks = np.zeros(20000), random.standard_normal(20000)
    for i in range(2, len(values)):
        values[i] = 1.4 * values[i - 1] - 0.5 * values[i - 2] + kicks[i]
    phi, errors = autoregression(values)
    assert phi[:2] == pytest.approx([1.4, -0.5], abs=0.04)
    assert np.nanstd(errors) == pytest.approx(1.0, abs=0.02)


def test_surrogates_have_the_series_variance_and_memory() -> None:
    values = remembering(1, 3000, 9.0)
    made = surrogates(values, count=200, seed=2)
    assert made.shape == (200, 3000)
    assert made.var() == pytest.approx(values.var(), rel=0.15)
    at_lag = np.mean(made[:, 9:] * made[:, :-9]) / made.var()
    assert at_lag == pytest.approx(math.exp(-1.0), abs=0.08)
    assert np.array_equal(made, surrogates(values, count=200, seed=2))


def test_conditions_that_mean_nothing_are_found_as_often_as_the_level_says() -> None:
    """And a test for independent readings finds most of them."""
    from scipy.stats import ttest_ind

    bootstrap, naive = [], []
    for seed in range(200):
        values = remembering(40000 + seed, 1200, 9.0)
        inside = np.roll(weekend(1200), 37 * seed, axis=0)
        bootstrap.append(linear_p(Null.of(values, count=200), [inside])[0])
        flag = inside[:, 0] > 0
        naive.append(ttest_ind(values[flag], values[~flag]).pvalue)
    assert np.mean(np.array(naive) < 0.05) > 0.35
    assert 0.005 <= np.mean(np.array(bootstrap) < 0.05) <= 0.085
    assert np.mean(np.array(bootstrap) < 0.5) > 0.35


def test_livelier_errors_under_a_condition_are_no_effect_of_it() -> None:
    p = []
    for seed in range(120):
        inside = weekend(1500)
        values = remembering(3000 + seed, 1500, 5.0) * (1.0 + 2.0 * inside[:, 0])
        p.append(linear_p(Null.of(values, count=150), [inside])[0])
    assert np.mean(np.array(p) < 0.05) <= 0.10


@given(scale=st.floats(1e-6, 1e6), shift=st.floats(-1e3, 1e3))
def test_units_of_a_basis_do_not_matter(scale: float, shift: float) -> None:
    values = remembering(7, 400, 4.0)
    null = Null.of(values, count=60)
    x = np.column_stack([np.sin(np.arange(400) / 20.0), np.arange(400) / 400.0])
    first, second = linear_p(null, [x, scale * x + shift * scale])
    assert second == pytest.approx(first, rel=1e-4)


def test_an_effect_is_found_and_one_column_too_many_does_no_harm() -> None:
    values = remembering(11, 2000, 6.0) + 1.0 * weekend(2000)[:, 0]
    null = Null.of(values)
    twice = np.column_stack([weekend(2000), 2.0 * weekend(2000), np.ones(2000)])
    single, doubled, nothing = linear_p(null, [weekend(2000), twice, np.ones((2000, 1))])
    assert single < 1e-6
    assert doubled == pytest.approx(single, rel=1e-3)
    assert nothing == 1.0


def test_the_largest_of_many_columns_is_paid_for() -> None:
    values = remembering(12, 2000, 6.0)
    driver = remembering(13, 2030, 20.0)
    table = np.column_stack([driver[30 - lag : 2030 - lag] for lag in range(0, 30, 3)])
    assert largest_p(Null.of(values), table) > 0.02
    assert largest_p(Null.of(values + 0.9 * table[:, 4]), table) < 1e-4


# --- what lasts ------------------------------------------------------------------------------

DATES = np.arange(144, 1860, 12)


def lasting(seed: int, step: float = 0.0, drift: float = 0.0) -> np.ndarray:
    values = remembering(seed, 2000, 8.0)
    return values + step * (np.arange(2000) >= 1200) + drift * np.linspace(-1.0, 1.0, 2000)


def test_a_change_is_dated_and_surer_the_larger_it_is() -> None:
    chances = []
    for size in (0.0, 1.0, 2.0, 4.0):
        p, place = change_p(Null.of(lasting(14, step=size)), DATES)
        chances.append(p)
        assert size < 1.0 or place == pytest.approx(1200, abs=72)
    assert chances[0] > 0.02
    assert chances[1] > chances[2] > chances[3]
    assert chances[2] < 1e-3


def test_a_drift_is_surer_the_steeper_it_is() -> None:
    trend = np.linspace(-1.0, 1.0, 2000)[:, None]
    chances = [drift_p(Null.of(lasting(15, drift=size)), trend) for size in (0.0, 1.0, 3.0)]
    assert chances[0] > 0.02
    assert chances[2] < chances[1] < 0.02


def test_slow_wandering_is_neither_a_change_nor_a_drift() -> None:
    """Memory of eight hours, and of four days beside it."""
    trend = np.linspace(-1.0, 1.0, 2000)[:, None]
    found = []
    for seed in range(100):
        null = Null.of(
            remembering(500 + seed, 2000, 8.0) + 0.5 * remembering(900 + seed, 2000, 96.0), count=100
        )
        found.append((change_p(null, DATES)[0], drift_p(null, trend)))
    assert np.all(np.mean(np.array(found) < 0.05, axis=0) <= 0.12)
    assert np.all(np.mean(np.array(found) < 0.005, axis=0) <= 0.03)


def test_prewhitening_brings_out_what_sets_in_sharply() -> None:
    inside = np.zeros((2000, 1))
    for start in (300, 900, 1500):
        inside[start : start + 6] = 1.0
    values = remembering(16, 2000, 10.0) + 1.5 * inside[:, 0]
    slow = linear_p(Null.of(values), [inside])[0]
    free = Prewhitened.of(values)
    sharp = linear_p(Null.of(free.errors), [free.basis(inside)])[0]
    assert sharp < 1e-3 * slow
    assert sharp < 1e-8


@pytest.mark.parametrize(("at", "low", "high"), [(1.0, 0.2, 0.45), (2.0, 0.03, 0.07), (4.0, 1e-6, 2e-3)])
def test_the_tail_of_a_normal_law(at: float, low: float, high: float) -> None:
    simulated = np.abs(np.random.default_rng(17).standard_normal(1000))
    assert low < tail(at, simulated) < high


# --- steps between two readings --------------------------------------------------------------


def smooth_errors(seed: int, size: int = 5000) -> np.ndarray:
    """A cabinet's errors at 15 min [K]: a slow disturbance through an inertia, 1.5 K, and 0.05 K of noise."""
    random = np.random.default_rng(seed)
    slow = remembering(seed, size, 8.0, 0.25)
    gain = math.exp(-0.25 / 1.5)
    heated = np.zeros(size)
    for i in range(1, size):
        heated[i] = gain * heated[i - 1] + (1.0 - gain) * slow[i]
    return 1.5 * heated / heated.std() + 0.05 * random.standard_normal(size)


def test_a_step_far_below_the_errors_is_found_to_the_reading() -> None:
    values = smooth_errors(20)
    values[2345:] += 0.6
    found = sharp_step(values)
    assert found is not None
    assert found.place == 2345
    assert found.size == pytest.approx(0.6, abs=0.2)
    assert found.p < 1e-4


def test_no_step_is_found_where_there_is_none_even_with_missing_readings() -> None:
    for seed in range(21, 41):
        values = smooth_errors(seed)
        values[np.random.default_rng(seed).random(len(values)) < 0.01] = np.nan
        found = sharp_step(values)
        assert found is None or found.p > 2e-3, seed


def test_a_stray_reading_is_no_step() -> None:
    values = smooth_errors(42)
    values[2345] += 2.0
    assert sharp_step(values) is None


def test_a_kick_is_not_clearly_a_step() -> None:
    random = np.random.default_rng(43)
    values, kicks = np.zeros(5000), 0.1 * random.standard_normal(5000)
    kicks[2345] += 1.0
    for i in range(1, len(values)):
        values[i] = 0.97 * values[i - 1] + kicks[i]
    found = sharp_step(values)
    assert found is None or not found.clear


def test_too_few_readings_have_no_step() -> None:
    assert sharp_step(smooth_errors(44, 150)) is None


# --- false discoveries -----------------------------------------------------------------------


def test_adjusted_values_are_those_of_statsmodels() -> None:
    from statsmodels.stats.multitest import multipletests

    p = np.random.default_rng(50).random(40) ** 2
    assert benjamini_hochberg(p) == pytest.approx(multipletests(p, method="fdr_bh")[1])


@given(st.lists(st.floats(1e-9, 1.0), min_size=1, max_size=30), st.floats(0.1, 10.0))
def test_equal_weights_are_none_and_order_is_kept(p: list[float], weight: float) -> None:
    q = benjamini_hochberg(np.array(p))
    assert benjamini_hochberg(np.array(p), np.full(len(p), weight)) == pytest.approx(q)
    assert np.all(q >= np.array(p) * (1 - 1e-12))
    assert np.all(np.diff(q[np.argsort(p)]) >= -1e-12)


def test_a_heavier_weight_makes_one_test_easier_and_the_others_harder() -> None:
    p = np.array([0.01, 0.2, 0.3, 0.4])
    plain, favoured = benjamini_hochberg(p), benjamini_hochberg(p, np.array([3.0, 1.0, 1.0, 1.0]))
    assert favoured[0] < plain[0]
    assert favoured[0] == pytest.approx(0.01 * 4 / 2)
