"""Bounds of root mean squared errors of correlated errors: their coverage by simulation, and simple cases."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from hygrokf.evaluation.bootstrap import block_h, integral_time_h, resampled

STEP_S = 900.0


def remembering(random: np.random.Generator, size: int, time_h: float) -> np.ndarray:
    """Ornstein–Uhlenbeck series of variance 1 at steps of 15 minutes."""
    gain = math.exp(-STEP_S / 3600.0 / time_h)
    kicks = math.sqrt(1.0 - gain**2) * random.standard_normal(size + 1000)
    return lfilter([1.0], [1.0, -gain], kicks)[1000:]


@pytest.mark.parametrize("time_h", [4.0, 10.0])
def test_the_integral_time_of_an_exponential_memory_is_its_time_constant(time_h: float) -> None:
    found = [
        integral_time_h(remembering(np.random.default_rng(seed), 20_000, time_h), 0.25) for seed in range(6)
    ]
    assert np.mean(found) == pytest.approx(time_h, rel=0.15)


def pair(seed: int, days: int, time_h: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and two columns of errors with a share in common; true errors √1.25 and √0.89."""
    random = np.random.default_rng([53, seed, days])
    size = days * 96
    common, first, second = (remembering(random, size, time_h) for _ in range(3))
    return STEP_S * np.arange(size), np.column_stack([common + 0.5 * first, 0.8 * common + 0.5 * second])


@pytest.mark.parametrize(("days", "time_h"), [(30, 12.0), (60, 4.0)])
def test_bounds_hold_the_truth_as_often_as_they_say(days: int, time_h: float) -> None:
    runs, hits = 160, np.zeros(4)
    first, second = math.sqrt(1.25), math.sqrt(0.89)
    for seed in range(runs):
        time, errors = pair(seed, days, time_h)
        found = resampled(time, errors, count=250)
        low, high = found.bounds(0)
        hits[0] += low <= first <= high
        _, low, high = found.difference(0, 1)
        hits[1] += low <= first - second <= high
        _, low, high = found.skill(1, 0)
        hits[2] += low <= 1.0 - (second / first) ** 2 <= high
        # standstills of days, a quarter of the time
        stopped = np.sin(time / 86400.0 / 5.0 * 2.0 * math.pi) > 0.7
        low, high = resampled(time, np.where(stopped[:, None], errors, np.nan), count=250).bounds(0)
        hits[3] += low <= first <= high
    share = hits / runs
    assert np.all(share > 0.91) and np.all(share < 0.995), share


def test_values_are_plain_root_mean_squares_on_common_instants() -> None:
    time, errors = pair(1, 20, 6.0)
    errors[::7, 0] = np.nan
    errors[3::11, 1] = np.nan
    there = np.isfinite(errors).all(axis=1)
    found = resampled(time, errors)
    assert found.n == there.sum()
    np.testing.assert_allclose(found.value, np.sqrt(np.mean(errors[there] ** 2, axis=0)), rtol=1e-12)
    assert found.draws.shape[1] == 2
    value, low, high = found.difference(0, 1)
    assert low < value < high and value == pytest.approx(found.value[0] - found.value[1])
    skill, low, high = found.skill(1, 0)
    assert low < skill < high and skill == pytest.approx(1.0 - (found.value[1] / found.value[0]) ** 2)


def test_a_mean_square_of_white_noise_varies_as_its_formula_says() -> None:
    """sd of ln RMSE of n independent normal errors is 1/√(2n); blocks of one hour of hourly errors are no
    blocks."""
    errors = np.random.default_rng(8).standard_normal((4000, 1))
    drawn = resampled(3600.0 * np.arange(4000.0), errors, length_h=1.0, count=2000).draws
    assert np.std(np.log(drawn)) == pytest.approx(1.0 / math.sqrt(8000.0), rel=0.08)


def test_too_few_blocks_give_no_bounds_and_nothing_gives_nothing() -> None:
    time, errors = pair(2, 3, 12.0)
    found = resampled(time, errors)
    assert found.bounds(0) is None and found.difference(0, 1) is None and found.skill(0, 1) is None
    assert resampled(time, np.full_like(errors, np.nan)) is None


def test_blocks_grow_with_memory_and_stay_a_tenth_of_the_record() -> None:
    random = np.random.default_rng(4)
    fast, slow = (remembering(random, 96 * 200, time_h)[::4] for time_h in (2.0, 20.0))
    assert block_h(fast) == 24.0
    assert 50.0 < block_h(slow) < 120.0
    assert block_h(slow[:360]) <= 36.0
