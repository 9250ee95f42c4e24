"""Score tests under the error model keep their level where tests for white noise break theirs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plants.chance import ornstein_uhlenbeck

from hygrokf.discovery.findings import Whitened, benjamini_hochberg

SIZE = 2000


def remembering(seed: int, time_h: float = 8.0, size: int = SIZE, step_h: float = 1.0) -> np.ndarray:
    """Ornstein–Uhlenbeck series of variance 1."""
    return ornstein_uhlenbeck(np.random.default_rng(seed), size, step_h, time_h)


def weekend(size: int = SIZE) -> np.ndarray:
    """A condition of 30 h out of 100 h, as a column."""
    return ((np.arange(size) % 100) < 30).astype(float)[:, None]


def chance(values: np.ndarray, condition: np.ndarray, flow: bool = True) -> float:
    """p that a series at steps of an hour, behind a low pass of 2 h, is free of a condition."""
    white = Whitened.of(values, 1.0, 2.0)
    return math.exp(white.log_p(white.whitened(white.columns(condition, flow))))


def test_conditions_that_mean_nothing_are_found_as_often_as_the_level_says() -> None:
    """And a test for independent readings finds most of them."""
    from scipy.stats import ttest_ind

    found, naive = [], []
    for seed in range(200):
        values = remembering(40000 + seed, 9.0, 1200)
        inside = np.roll(weekend(1200), 37 * seed, axis=0)
        found.append(chance(values, inside))
        flag = inside[:, 0] > 0
        naive.append(ttest_ind(values[flag], values[~flag]).pvalue)
    assert np.mean(np.array(naive) < 0.05) > 0.35
    assert 0.005 <= np.mean(np.array(found) < 0.05) <= 0.085
    assert np.mean(np.array(found) < 0.5) > 0.35


def test_livelier_errors_under_a_condition_are_no_effect_of_it() -> None:
    p = []
    for seed in range(120):
        inside = weekend()
        p.append(chance(remembering(3000 + seed, 5.0) * (1.0 + 2.0 * inside[:, 0]), inside))
    assert np.mean(np.array(p) < 0.05) <= 0.10


def test_outliers_do_not_decide() -> None:
    """A stray reading of 20 standard deviations under the condition, and shocks of 8 at random."""
    p = []
    for seed in range(60):
        random = np.random.default_rng(seed)
        values = remembering(seed)
        values[random.integers(0, SIZE, 10)] += 8.0 * random.choice((-1.0, 1.0), 10)
        values[105] += 20.0
        p.append(chance(values, weekend()))
    assert np.mean(np.array(p) < 0.05) <= 0.10


@given(scale=st.floats(1e-6, 1e6), shift=st.floats(-1e3, 1e3))
def test_units_of_a_condition_do_not_matter(scale: float, shift: float) -> None:
    white = Whitened.of(remembering(7, 4.0, 400), 1.0, 2.0)
    x = np.column_stack([np.sin(np.arange(400) / 20.0), np.arange(400) / 400.0])
    first, second = (
        white.log_p(white.whitened(white.columns(one, True))) for one in (x, scale * x + shift * scale)
    )
    assert second == pytest.approx(first, rel=1e-4)


def test_an_effect_is_found_and_one_column_too_many_does_no_harm() -> None:
    values = remembering(11, 6.0) + 1.0 * weekend()[:, 0]
    twice = np.column_stack([weekend(), 2.0 * weekend(), np.ones(SIZE)])
    single, doubled, nothing = (chance(values, one) for one in (weekend(), twice, np.ones((SIZE, 1))))
    assert single < 1e-6
    assert doubled == pytest.approx(single, rel=1e-3)
    assert nothing == 1.0


@pytest.mark.parametrize("lag_h", [0.0, 2.0, 8.0])
def test_an_effect_is_measured_whether_it_acts_at_once_or_as_a_flow(lag_h: float) -> None:
    clean = Whitened.of(remembering(12, 6.0), 1.0, 2.0)
    course = weekend() if lag_h == 0 else clean.low_passed(weekend(), lag_h / 2.0)
    white = Whitened.of(clean.error + 2.0 * course[:, 0], 1.0, 2.0)
    effect = white.effect(white.columns(weekend(), True))
    assert np.std(effect - 2.0 * course[:, 0]) < 0.5 * np.std(2.0 * course)
    assert np.polyfit(course[:, 0], effect, 1)[0] == pytest.approx(2.0, abs=0.5)


def test_what_was_taken_out_is_tested_no_more() -> None:
    white = Whitened.of(remembering(13) + 2.0 * weekend()[:, 0], 1.0, 2.0)
    columns = white.columns(weekend(), True)
    assert white.log_p(white.whitened(columns)) < -20.0
    rest = white.without(columns, np.empty((SIZE, 0)))
    assert rest.log_p(rest.whitened(columns)) == 0.0
    assert np.nanvar(rest.error) < np.nanvar(white.error)


def test_a_drift_is_not_hidden_by_the_memory_that_it_feigns() -> None:
    trend = np.linspace(-1.0, 1.0, SIZE)[:, None]
    white = Whitened.of(remembering(15) + 2.0 * trend[:, 0], 1.0, 2.0)
    columns = white.columns(trend, False)
    again = white.rejudged(columns)
    assert again.log_p(again.whitened(columns)) < white.log_p(white.whitened(columns)) - 3.0
    assert again.log_p(again.whitened(columns)) < math.log(1e-3)


# --- changes ---------------------------------------------------------------------------------


def smooth_errors(seed: int, size: int = 5000) -> np.ndarray:
    """A cabinet's errors at 15 min [K]: a slow disturbance through an inertia, 1.5 K, and 0.05 K of noise."""
    from scipy.signal import lfilter

    gain = math.exp(-0.25 / 1.5)
    heated = lfilter([1.0 - gain], [1.0, -gain], remembering(seed, 8.0, size, 0.25))
    noise = 0.05 * np.random.default_rng(seed).standard_normal(size)
    return 1.5 * heated / heated.std() + noise


def changed(values: np.ndarray) -> tuple[float, int, float]:
    """p over all dates, the date, and the size of the likeliest change."""
    white = Whitened.of(values, 0.25, 1.5)
    first, flow, tried, _ = white.change()
    step = white.columns((np.arange(len(values)) >= first)[:, None].astype(float), False)
    columns = white.low_passed(step) if flow else step
    p = min(1.0, tried * math.exp(white.log_p(white.whitened(columns), unbounded=True)))
    effect = white.effect(columns)
    return p, first, float(effect[-1] - effect[0])


def test_a_step_far_below_the_errors_is_found_to_the_reading() -> None:
    found = []
    for seed in range(20, 26):
        values = smooth_errors(seed)
        values[2345:] += 0.9
        p, place, size = changed(values)
        found.append(p < 1e-3 and place == 2345 and abs(size - 0.9) < 0.25)
    assert sum(found) >= 5


def test_a_step_is_found_where_most_of_the_record_is_a_gap() -> None:
    """Each part is shorter than a twentieth of the record: the margins are shares of the readings."""
    values = np.full(20000, np.nan)
    values[:800], values[-800:] = smooth_errors(20, 800), smooth_errors(21, 800)
    values[19500:] += 6.0
    p, place, size = changed(values)
    assert p < 1e-3 and abs(place - 19500) <= 2 and abs(size - 6.0) < 1.5


def test_no_step_is_found_where_there_is_none_even_with_missing_readings() -> None:
    p = []
    for seed in range(30, 60):
        values = smooth_errors(seed)
        values[np.random.default_rng(seed).random(len(values)) < 0.01] = np.nan
        p.append(changed(values)[0])
    assert sum(one < 0.05 for one in p) <= 3


def test_stray_readings_and_shocks_are_no_step() -> None:
    """Three of each in a record: strays of forty times the noise, shocks of the disturbance of five times its
    own size."""
    from scipy.signal import lfilter

    alarms = 0
    for seed in range(60, 90):
        random = np.random.default_rng(seed)
        values, kicks = smooth_errors(seed), np.zeros(5000)
        values[random.integers(300, 4700, 3)] += random.choice((-2.0, 2.0), 3)
        kicks[random.integers(300, 4700, 3)] = random.choice((-7.5, 7.5), 3)
        slow = lfilter([1.0], [1.0, -math.exp(-0.25 / 8.0)], kicks)
        fading = lfilter([1.0 - math.exp(-0.25 / 1.5)], [1.0, -math.exp(-0.25 / 1.5)], slow)
        alarms += changed(values + fading)[0] < 0.01
    assert alarms <= 2


def test_the_score_of_a_date_is_that_of_its_own_column() -> None:
    values = smooth_errors(44, 1500)
    values[np.random.default_rng(44).random(1500) < 0.05] = np.nan
    white = Whitened.of(values, 0.25, 1.5)
    told = np.cumsum(white._adjoint(white.innovations)[::-1])[::-1]
    for date in (200, 777, 1300):
        step = (np.arange(1500) >= date)[:, None].astype(float)
        assert told[date] == pytest.approx(
            float(white.filter_result.whitened(step)[:, 0] @ white.innovations), rel=1e-6
        )


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
