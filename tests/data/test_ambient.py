"""Ambient courses at any time, the noise of their readings, and the course that the readings most likely
belong to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from hygrokf.data.ambient import FEWEST_FOR_NOISE, at_times, bridge_h, reading_noise, smoothed
from hygrokf.data.input_paths import centred
from hygrokf.data.prepared import prepare
from hygrokf.data.record import Record, Series
from hygrokf.physics.psychrometrics import absolute_humidity, absolute_humidity_from_dew_point

START_S = 1.6e9
STEP_S = 600.0
SEEDS = 200


def walk(seed: int, count: int, level_sd: float, noise_sd: float, step_s: float = STEP_S) -> Series:
    """A random walk with steps of `level_sd` [K], read with noise of `noise_sd` [K]."""
    random = np.random.default_rng([seed, 77])
    value = 283.0 + np.cumsum(level_sd * random.normal(size=count)) + noise_sd * random.normal(size=count)
    return Series("ambient_temperature", START_S + step_s * np.arange(count), value)


# --- noise of the readings ------------------------------------------------------------------


def test_variances_of_a_noisy_walk_are_recovered():
    """Means over 200 walks within four standard errors of the truth; single estimates within the spread of
    their own."""
    level_sd, noise_sd, count = 0.06, 0.05, 6000
    found = np.array(
        [reading_noise(walk(seed, count, level_sd, noise_sd)) or (np.nan, np.nan) for seed in range(SEEDS)]
    )
    assert np.isfinite(found).all()
    truth = np.array([level_sd**2 / STEP_S, noise_sd**2])
    spread = found.std(axis=0)
    assert np.all(np.abs(found.mean(axis=0) - truth) < 4.0 * spread / np.sqrt(SEEDS) + 0.01 * truth)
    assert np.all(spread < 0.15 * truth)


def test_noise_free_readings_rarely_raise_a_false_alarm():
    """Three standard errors of γ₂ − γ₁: 0.13 % by the normal law, so of 200 walks three alarms are one chance
    in 300."""
    alarms = sum(reading_noise(walk(seed, 4000, 0.06, 0.0)) is not None for seed in range(SEEDS))
    assert alarms <= 2


def test_noise_well_below_the_weathers_own_steps_is_no_finding():
    found = [reading_noise(walk(seed, 4000, 0.2, 0.01)) for seed in range(50)]
    assert sum(one is not None for one in found) <= 1


def test_smooth_weather_without_noise_is_left_alone():
    """Increments of smooth weather are correlated, the nearer the more: the opposite of noise."""
    hours = np.arange(6000) / 6.0
    value = 283.0 + 5 * np.sin(2 * np.pi * hours / 24) + np.sin(hours / 3.1) + 0.5 * np.sin(hours / 1.3)
    assert reading_noise(Series("ambient_temperature", START_S + STEP_S * np.arange(6000), value)) is None


def test_fronts_and_outages_do_not_pass_for_noise():
    """A few jumps of 10 K and gaps change the estimate by little."""
    plain = walk(3, 6000, 0.06, 0.05)
    value = plain.value.copy()
    for place in (500, 1700, 3100, 4400):
        value[place:] += 10.0
    value[2000:2100] = np.nan
    kept = np.delete(np.arange(6000), np.arange(3500, 3700))
    jumpy = replace(plain, time=plain.time[kept], value=value[kept])
    q, r = reading_noise(jumpy)
    expected_q, expected_r = reading_noise(plain)
    assert r == pytest.approx(expected_r, rel=0.1)
    assert q == pytest.approx(expected_q, rel=0.2)


@pytest.mark.parametrize(
    "series",
    [
        walk(1, FEWEST_FOR_NOISE - 1, 0.06, 0.05),
        replace(walk(1, 4000, 0.06, 0.05), value=np.full(4000, 283.0)),
        replace(walk(1, 4000, 0.06, 0.05), value=np.full(4000, np.nan)),
        replace(walk(1, 4000, 0.06, 0.05), time=START_S + np.cumsum(np.tile([300.0, 900.0], 2000))),
        replace(walk(1, 4001, 0.06, 0.05), time=START_S + np.cumsum(np.tile([300.0, 900.0], 2001)[:4001])),
    ],
    ids=["short", "constant", "empty", "two-steps", "odd-two-steps"],
)
def test_where_noise_cannot_be_told_none_is_said(series):
    assert reading_noise(series) is None


# --- smoothing ------------------------------------------------------------------------------


def dense_mean(time: np.ndarray, value: np.ndarray, q: float, r: float) -> np.ndarray:
    """E[x | readings] of a local level with a flat start, by the joint Gaussian of all of it."""
    vague = 1e7
    elapsed = time - time[0]
    prior = q * np.minimum(elapsed[:, None], elapsed[None, :]) + vague
    centre = value.mean()
    return centre + prior @ np.linalg.solve(prior + r * np.eye(len(time)), value - centre)


def test_smoothed_is_the_conditional_mean_on_any_clock():
    random = np.random.default_rng(9)
    time = START_S + np.cumsum(random.uniform(60.0, 3000.0, 120))
    value = 283.0 + np.cumsum(random.normal(size=120)) + 0.3 * random.normal(size=120)
    value[[5, 6, 40, 119]] = np.nan
    series = Series("ambient_temperature", time, value, resolution=0.1, source="a.csv")
    q, r = 4e-4, 0.09
    found = smoothed(series, (q, r))
    there = ~np.isnan(value)
    assert_allclose(found.value[there], dense_mean(time[there], value[there], q, r), atol=1e-5)
    assert_array_equal(np.isnan(found.value), ~there)  # NaN stay NaN
    assert replace(found, value=series.value) == series


def test_smoothing_has_both_limits():
    series = walk(4, 300, 0.06, 0.05)
    assert_allclose(smoothed(series, (1.0, 1e-12)).value, series.value, atol=1e-9)
    flat = smoothed(series, (1e-15, 1.0)).value
    assert_allclose(flat, series.value.mean(), atol=1e-3)


def test_smoothing_brings_noisy_readings_nearer_to_the_truth():
    random = np.random.default_rng(12)
    true = 283.0 + np.cumsum(0.03 * random.normal(size=5000))
    series = Series(
        "ambient_temperature", START_S + STEP_S * np.arange(5000), true + 0.1 * random.normal(size=5000)
    )
    found = smoothed(series, reading_noise(series))
    assert np.std(found.value - true) < 0.7 * np.std(series.value - true)


def test_nothing_to_smooth():
    series = walk(4, 300, 0.06, 0.05)
    assert smoothed(series, None) is series
    means = replace(series, hold="mean", interval_s=STEP_S)
    assert smoothed(means, (1e-5, 1e-3)) is means
    two = replace(series, time=series.time[:2], value=series.value[:2])
    assert smoothed(two, (1e-5, 1e-3)) is two


# --- humidity -------------------------------------------------------------------------------


def outside(moist: Series, warm: Series) -> Series | None:
    return prepare(Record("made", (warm, moist))).ambient_vapour


def test_absolute_humidity_comes_from_what_there_is():
    time = START_S + 3600.0 * np.arange(24)
    warm = Series("ambient_temperature", time, 280.0 + np.arange(24) / 4)
    late = time[:-1] + 1234.0
    kelvin = np.interp(late, time, warm.value)
    relative = Series("ambient_relative_humidity", late, np.linspace(0.4, 1.0, 23), clock_uncertainty_s=60.0)
    found = outside(relative, warm)
    assert_allclose(found.value, absolute_humidity(relative.value, kelvin))
    assert (found.signal, found.clock_uncertainty_s) == ("ambient_absolute_humidity", 60.0)
    assert_array_equal(found.time, late)
    dew = Series("ambient_dew_point_temperature", late, kelvin - 3.0)
    assert_allclose(outside(dew, warm).value, absolute_humidity_from_dew_point(kelvin - 3.0, kelvin))
    given_ = Series("ambient_absolute_humidity", late, np.full(23, 7e-3))
    assert outside(given_, warm) is given_
    both = Record("made", (warm, dew, relative))
    assert_allclose(prepare(both).ambient_vapour.value, found.value)  # the reading before what is derived
    assert prepare(Record("made", (warm,))).ambient_vapour is None


def test_a_mean_humidity_meets_the_temperature_of_the_middle_of_its_interval():
    """Hourly means of both at their ends: each humidity goes with the temperature of the same hour."""
    end = START_S + 3600.0 * np.arange(1, 49)
    kelvin = 283.0 + 6.0 * np.sin(np.arange(48) / 4.0)
    warm = Series("ambient_temperature", end, kelvin, "mean", 3600.0)
    moist = Series("ambient_relative_humidity", end, np.full(48, 0.7), "mean", 3600.0)
    found = outside(moist, warm)
    assert_allclose(found.value, absolute_humidity(0.7, kelvin), rtol=1e-12)
    assert (found.hold, found.interval_s) == ("mean", 3600.0)
    assert_allclose(centred(found).time, end - 1800.0)


def test_a_humidity_without_temperature_is_missing():
    time = START_S + 3600.0 * np.arange(48)
    value = np.full(48, 283.0)
    value[10:20] = np.nan
    found = outside(
        Series("ambient_relative_humidity", time, np.full(48, 0.6)),
        Series("ambient_temperature", time, value),
    )
    assert_array_equal(np.isnan(found.value), np.isnan(value))


# --- at other times -------------------------------------------------------------------------


def test_means_become_instants_in_the_middle_of_their_interval():
    means = replace(walk(1, 20, 0.1, 0.0), hold="mean", interval_s=STEP_S, resolution=0.1)
    found = centred(means)
    assert_array_equal(found.time, means.time - 300.0)
    assert (found.hold, found.interval_s, found.resolution) == ("linear", 0.0, 0.1)
    assert centred(found) is found


def test_the_limit_of_bridges_never_falls_below_the_own_step():
    def instants(step_s: float, **more) -> Series:
        return Series("ambient_temperature", START_S + step_s * np.arange(20), np.full(20, 283.0), **more)

    assert bridge_h(instants(600.0), 6.0) == 6.0
    assert bridge_h(instants(8 * 3600.0), 6.0) == 12.0
    assert bridge_h(instants(7200.0, hold="mean", interval_s=7200.0), 1.0) == 1.0
    assert bridge_h(Series("ambient_temperature", [0.0], [283.0]), 6.0) == 6.0


def by_definition(series: Series, when: float, bridge: float) -> float:
    """One value of a series at a time, by the words of the docstring."""
    known = [(t, v) for t, v in zip(series.time, series.value, strict=True) if not np.isnan(v)]
    length = series.interval_s
    if series.hold == "linear":
        before = [k for k in known if k[0] <= when]
        after = [k for k in known if k[0] >= when]
        if not before or not after or after[0][0] - before[-1][0] > bridge * 3600.0:
            return np.nan
        (a, low), (b, high) = before[-1], after[0]
        return low if a == b else low + (high - low) * (when - a) / (b - a)
    for end, value in known:
        if end - length < when <= end:
            return value
    before = [k for k in known if k[0] < when]
    after = [k for k in known if k[0] - length >= when]
    if not before:
        return np.nan
    hole = (after[0][0] - length if after else when) - before[-1][0]
    return np.nan if hole > bridge * 3600.0 else before[-1][1]


@settings(max_examples=60)
@given(
    st.integers(0, 10_000),
    st.sampled_from(["linear", "mean"]),
    st.sampled_from([0.0, 0.3, 0.7]),
    st.sampled_from([0.2, 1.0, 6.0]),
)
def test_every_value_is_the_one_by_definition(seed, hold, missing, bridge):
    random = np.random.default_rng(seed)
    time = START_S + np.cumsum(random.choice([600.0, 1200.0, 5400.0, 20_000.0], 40))
    value = 283.15 + random.normal(size=40)
    value[random.random(40) < missing] = np.nan
    series = Series("ambient_temperature", time, value, hold, 600.0 if hold == "mean" else 0.0)
    asked = np.sort(np.concatenate([time, time - 600.0, random.uniform(time[0] - 9e3, time[-1] + 9e3, 60)]))
    found = at_times(series, asked, bridge)
    assert_allclose(found, [by_definition(series, when, bridge) for when in asked], atol=1e-9)


def test_a_held_value_is_known_from_its_stamp_on_until_it_is_too_old():
    """Three times the median of the steps before it, whatever comes later; or the stated age; or for ever."""
    time = START_S + 60.0 * np.array([0, 1, 2, 3, 4, 5, 15, 16, 17, 18, 100])
    value = np.arange(11.0)
    door = Series("ambient_temperature", time, 280.0 + value, "previous")
    minutes = [-0.01, 0.0, 0.99, 1.0, 5.5, 8.0, 8.01, 14.99, 15.0, 21.0, 21.01, 103.0]
    asked = START_S + 60.0 * np.array(minutes)
    expected = [np.nan, 0, 0, 1, 5, 5, np.nan, np.nan, 6, 9, np.nan, 10]
    assert_array_equal(at_times(door, asked, 6.0) - 280.0, expected)
    stated, endless = (replace(door, longest_hold_s=age) for age in (120.0, np.inf))
    young = [np.nan, 0, 0, 1, 5, np.nan, np.nan, np.nan, 6, np.nan, np.nan, np.nan]
    assert_array_equal(at_times(stated, asked, 6.0) - 280.0, young)
    assert_array_equal(at_times(endless, asked, 6.0) - 280.0, [np.nan, 0, 0, 1, 5, 5, 5, 5, 6, 9, 9, 10])
    for count in range(2, 11):  # by earlier readings alone
        part = replace(door, time=time[:count], value=door.value[:count])
        assert_array_equal(part.held_s, door.held_s[:count])


def test_an_empty_series_is_unknown_everywhere():
    empty = Series("ambient_temperature", START_S + np.arange(5.0), np.full(5, np.nan))
    assert np.isnan(at_times(empty, START_S + np.arange(3.0), 6.0)).all()
