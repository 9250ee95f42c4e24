"""The path of an input between its readings, against dense Gaussian conditioning and known courses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hygrokf.data.ambient import reading_noise
from hygrokf.data.input_paths import edge_weights, input_path, mean_weights, without_response
from hygrokf.data.record import Series

START_S = 1.6e9
FINE = 40


def means(values, width=600.0, start=START_S):
    """Adjacent interval means as a series."""
    ends = start + width * np.arange(1, len(values) + 1)
    return Series("ambient_temperature", ends, values, hold="mean", interval_s=width)


def test_the_path_of_held_values_jumps_after_their_stamps_and_ends_with_their_age():
    time = START_S + np.array([0.0, 600.0, 1200.0, 1800.0, 9000.0, 9000.5])
    held = Series("ambient_temperature", time, 280.0 + np.array([1.0, 2.0, 2.0, 3.0, 4.0, 5.0]), "zoh")
    path = input_path(held)
    assert path.hold == "linear"
    nodes = [0, 600, 601, 1200, 1800, 1801, 3600, 9000, 9000.5, 9001.5, 10800.5]
    assert (path.time - START_S).tolist() == nodes
    assert (path.value - 280.0).tolist() == [1, 1, 2, 2, 2, 3, 3, 4, 4, 5, 5]


def dense(count: int, noise: float = 0.0):
    """Gain (fine, count) of a Brownian path at the edges of a fine grid, given adjacent means; by dense
    linear algebra.

    The path starts with a variance so large that its level is unknown; 1e4 keeps eight digits of the rest.
    """
    edges = np.arange(count * FINE + 1) / FINE
    path = np.minimum.outer(edges, edges) + 1e4
    trapezoid = np.zeros((count, len(edges)))
    for k in range(count):
        trapezoid[k, k * FINE : (k + 1) * FINE + 1] = 1.0 / FINE
        trapezoid[k, [k * FINE, (k + 1) * FINE]] *= 0.5
    seen = trapezoid @ path @ trapezoid.T + noise * np.eye(count)
    return edges, path @ trapezoid.T @ np.linalg.inv(seen), trapezoid


@pytest.mark.parametrize(("before", "after"), [(2, 2), (1, 2), (0, 2), (2, 0), (1, 1), (2, 1)])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_weights_of_an_edge_are_those_of_dense_conditioning(before, after, noise):
    _, gain, _ = dense(before + after, noise)
    # trapezoids of 1/40 of an interval are off by their own square
    assert_allclose(edge_weights(before, after, noise), gain[before * FINE], atol=2e-3)
    assert edge_weights(before, after, noise).sum() == pytest.approx(1.0, abs=1e-12)


def test_two_means_on_each_side_have_simple_weights():
    assert_allclose(edge_weights(2, 2), [-0.125, 0.625, 0.625, -0.125], atol=1e-12)


def test_a_noisy_mean_is_corrected_by_its_neighbours_as_dense_conditioning_does():
    _, gain, trapezoid = dense(5, 0.3)
    assert_allclose(mean_weights(2, 2, 0.3), (trapezoid @ gain)[2], atol=2e-3)
    assert_allclose(mean_weights(2, 2, 0.0), [0, 0, 1, 0, 0], atol=1e-12)


def test_the_path_is_near_the_one_that_all_means_give():
    """Four means know an edge almost as well as forty do: the difference is 1 % of what stays unknown, in
    variance."""
    random = np.random.default_rng(11)
    value = 283.0 + np.cumsum(random.normal(size=40))
    path = input_path(means(value))
    gain = dense(40)[1]
    wanted = 283.0 + gain @ (value - 283.0)
    at_edges = path.value[::2]
    assert np.std(at_edges[3:-3] - wanted[::FINE][3:-3]) < 0.1
    at_middles = path.value[1::2]
    # straight pieces that keep the mean stand beyond the quadratic in the middle of an interval
    assert np.std(at_middles[3:-3] - wanted[FINE // 2 :: FINE][3:-3]) < 0.25


@pytest.mark.parametrize("width", [300.0, 600.0, 1800.0, 3600.0, 10800.0])
def test_the_path_keeps_every_mean(width):
    value = np.random.default_rng(5).normal(283.0, 4.0, 60)
    path = input_path(means(value, width))
    cumulated = np.append(0.0, np.cumsum(0.5 * np.diff(path.time) * (path.value[1:] + path.value[:-1])))
    edges = np.searchsorted(path.time, START_S + width * np.arange(61))
    assert_allclose(np.diff(cumulated[edges]) / width, value, rtol=1e-12)
    assert np.diff(path.time).max() <= 900.0
    assert path.hold == "linear" and path.interval_s == 0.0
    assert path.time[0] == START_S and path.time[-1] == START_S + width * 60


def test_hourly_means_are_drawn_as_the_quadratic_that_they_give():
    """At the quarters of an hour the path is the conditional mean, but for the 1/16 that keeps the area."""
    value = 283.0 + np.cumsum(np.random.default_rng(12).normal(size=9))
    path = input_path(means(value, 3600.0))
    e, m = path.value[16:21:4], value[4]
    half = 0.5 * (e[0] + e[1])
    assert path.value[18] == pytest.approx(half + 1.5 * (m - half) * 16.0 / 15.0, abs=1e-9)


def test_a_quadratic_course_is_found_at_the_edges():
    edges = START_S + 600.0 * np.arange(31)
    hours = (edges - START_S) / 3600.0
    cumulated = 280.0 * hours + 0.5 * 2.0 * hours**2 + 0.3 * hours**3 / 3.0
    path = input_path(means(np.diff(cumulated) * 6.0))
    true = 280.0 + 2.0 * hours + 0.3 * hours**2
    # −1/8, 5/8 is exact for a straight course; of the curvature 2·0.3 K/h² it misses Δ²/24
    assert_allclose(path.value[::2][2:-2], true[2:-2], atol=0.3 / 36.0 / 4.0)


def test_missing_means_end_a_stretch_and_a_lone_mean_stands_in_its_middle():
    value = np.arange(12.0) + 270.0
    value[[4, 6]] = np.nan
    path = input_path(means(value))
    lone = START_S + 600.0 * 5.5
    assert path.value[np.searchsorted(path.time, lone)] == 275.0
    gap = (path.time > START_S + 2400.0) & (path.time < lone)
    assert not gap.any()


def test_overlapping_means_stand_in_the_middle_of_their_intervals():
    running = replace(means(np.arange(280.0, 300.0)), interval_s=1800.0)
    path = input_path(running)
    assert_allclose(path.time, running.time - 900.0)
    assert_allclose(path.value, running.value)


def test_a_path_depends_on_the_means_around_it_alone():
    """What the tracker counts on: two means further on nothing changes any more, to the last bit."""
    value = np.random.default_rng(8).normal(283.0, 2.0, 30)
    whole, part = input_path(means(value)), input_path(means(value[:20]))
    settled = part.time <= START_S + 600.0 * 18
    assert np.array_equal(part.value[settled], whole.value[: settled.sum()])
    late = input_path(replace(means(value[10:]), time=means(value).time[10:]))
    assert np.array_equal(late.value[-30:], whole.value[-30:])


def test_instants_are_left_as_they_are():
    series = Series("ambient_temperature", START_S + 600.0 * np.arange(9), np.arange(280.0, 289.0))
    assert input_path(series) is series


# --- response of a sensor -------------------------------------------------------------------


def test_the_response_of_a_sensor_is_taken_out():
    """A sensor that lags a slow sine by 10 min: what is left is of second order in step and response time."""
    time = START_S + 300.0 * np.arange(2000)
    omega, response = 2 * np.pi / 86400.0, 600.0
    true = 283.0 + 5.0 * np.sin(omega * (time - START_S))
    gain = 1.0 / np.hypot(1.0, omega * response)
    read = 283.0 + 5.0 * gain * np.sin(omega * (time - START_S) - np.arctan(omega * response))
    series = Series("ambient_temperature", time, read, response_time_s=response)
    freed = without_response(series)
    assert np.abs(read - true).max() > 0.2
    assert np.abs(freed.value - true)[1:-1].max() < 1e-3
    assert freed.response_time_s == 0.0


@pytest.mark.parametrize("response", [None, 0.0])
def test_a_sensor_without_stated_response_is_left_alone(response):
    series = Series(
        "ambient_temperature", START_S + np.arange(5.0), np.ones(5) * 280, response_time_s=response
    )
    assert without_response(series) is series


def test_no_slope_is_taken_across_a_long_gap():
    time = START_S + 600.0 * np.array([0, 1, 2, 200, 201, 202])
    series = Series(
        "ambient_temperature", time, [280.0, 280.0, 280.0, 290.0, 290.0, 290.0], response_time_s=600.0
    )
    assert_allclose(without_response(series).value, series.value)


def test_a_negative_response_time_is_refused():
    with pytest.raises(ValueError, match="response_time_s must be a finite number ≥ 0 or None, found -1"):
        Series("ambient_temperature", [0.0], [280.0], response_time_s=-1.0)


# --- noise of means ------------------------------------------------------------------------


def test_noise_of_means_is_told_from_the_weather():
    """q and r of a Brownian course read as ten-minute means with noise, within four standard errors over 100
    courses."""
    found = []
    for seed in range(100):
        random = np.random.default_rng([seed, 31])
        course = 283.0 + np.cumsum(random.normal(0.0, 0.06 / np.sqrt(10.0), 10 * 6000))
        read = course.reshape(-1, 10).mean(axis=1) + 0.05 * random.normal(size=6000)
        found.append(reading_noise(means(read)) or (np.nan, np.nan))
    found = np.array(found)
    assert np.isfinite(found).all()
    # ten steps an interval are no Brownian course yet: 1 % of q
    truth = np.array([0.06**2 / 600.0, 0.05**2])
    spread = found.std(axis=0)
    assert np.all(np.abs(found.mean(axis=0) - truth) < 4.0 * spread / 10.0 + 0.02 * truth)


def test_means_without_noise_rarely_raise_a_false_alarm():
    alarms = 0
    for seed in range(100):
        course = 283.0 + np.cumsum(np.random.default_rng([seed, 32]).normal(0.0, 0.02, 10 * 4000))
        alarms += reading_noise(means(course.reshape(-1, 10).mean(axis=1))) is not None
    assert alarms <= 2
