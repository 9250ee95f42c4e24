"""The gate of readings: what departs and returns goes, what stays or belongs to the signal's course stays."""

from __future__ import annotations

import numpy as np
import pytest

from hygrokf.data.gate import ACCEPTED, DEPARTED, FROZEN, Scale, judge, scale_of

TEMPERATURE = "cabinet_temperature"


def course(count: int = 3000, step_s: float = 600.0, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and a temperature [K] with a day's swing, slow noise and a resolution of 0.1 K."""
    random = np.random.default_rng(seed)
    time = step_s * np.arange(count)
    slow = np.cumsum(random.normal(0.0, 0.1 * np.sqrt(step_s / 600.0), count))
    value = 290.0 + 4.0 * np.sin(2.0 * np.pi * time / 86400.0) + slow - slow.mean()
    return time, np.round(value, 1)


def verdicts(time: np.ndarray, value: np.ndarray, signal: str = TEMPERATURE) -> np.ndarray:
    scale = scale_of(signal, time, value, 0.1)
    assert scale is not None
    return judge(signal, time, value, scale).verdict


@pytest.mark.parametrize("step_s", [60.0, 600.0, 3600.0])
@pytest.mark.parametrize("wrong", [358.15, 250.0])
def test_one_bad_reading_goes_and_only_that_one(step_s, wrong):
    time, value = course(step_s=step_s)
    value[1500] = wrong
    found = verdicts(time, value)
    assert np.flatnonzero(found != ACCEPTED).tolist() == [1500]
    assert found[1500] == DEPARTED


@pytest.mark.parametrize("length", [2, 3])
def test_a_run_that_returns_within_half_an_hour_goes(length):
    time, value = course()
    value[1500 : 1500 + length] = 358.15
    assert np.flatnonzero(verdicts(time, value)).tolist() == list(range(1500, 1500 + length))


def test_a_step_stays_from_its_second_reading_on():
    time, value = course()
    value[1500:] += 20.0
    assert not verdicts(time, value).any()
    scale = scale_of(TEMPERATURE, time, value, 0.1)
    newest = judge(TEMPERATURE, time[:1501], value[:1501], scale).verdict
    confirmed = judge(TEMPERATURE, time[:1502], value[:1502], scale).verdict
    assert newest[1500] == DEPARTED  # one reading alone confirms nothing
    assert not confirmed.any()


def test_a_bad_reading_at_the_start_and_after_a_gap_goes():
    time, value = course()
    value[0] = value[1500] = 358.15
    time[1500:] += 86400.0
    assert np.flatnonzero(verdicts(time, value)).tolist() == [0, 1500]


def test_a_change_over_a_gap_is_no_departure():
    time, value = course()
    time[1500:] += 10.0 * 86400.0
    value[1500:] += 15.0
    assert not verdicts(time, value).any()


def test_bad_readings_do_not_widen_the_scale():
    time, value = course()
    clean = scale_of(TEMPERATURE, time, value, 0.1)
    value[np.random.default_rng(3).choice(3000, 10, replace=False)] = 358.15
    assert scale_of(TEMPERATURE, time, value, 0.1).departure == pytest.approx(clean.departure, rel=0.1)


def test_hardly_any_clean_reading_is_suspected():
    suspected = sum(np.count_nonzero(verdicts(*course(seed=seed))) for seed in range(20))
    assert suspected <= 6  # of 60,000


def test_flags_rain_and_directions_are_not_judged():
    time = 600.0 * np.arange(300)
    value = np.zeros(300)
    value[150] = 1.0
    for signal in ("door_open", "rain", "wind_direction"):
        assert scale_of(signal, time, value) is None


def test_a_frozen_sensor_is_known_when_it_is_still_for_too_long_and_in_hindsight_whole():
    time, value = course()
    value[1000:1300] = value[1000]
    scale = scale_of(TEMPERATURE, time, value, 0.1)
    live = judge(TEMPERATURE, time, value, scale).verdict
    whole = judge(TEMPERATURE, time, value, scale, in_hindsight=True).verdict
    assert scale.still_s < 86400.0
    late = (time - time[1000] + 600.0 > scale.still_s) & (np.arange(3000) < 1300)
    np.testing.assert_array_equal(live == FROZEN, late)
    assert (whole[1001:1300] == FROZEN).all() and not whole[:1001].any() and not whole[1303:].any()


def test_readings_at_rest_are_never_frozen():
    time = 600.0 * np.arange(1000)
    value = np.round(np.random.default_rng(2).uniform(0.4, 0.9, 1000), 2)
    value[300:600] = 1.0
    assert not verdicts(time, value, "ambient_relative_humidity").any()


@pytest.mark.parametrize("step_s", [60.0, 600.0, 3600.0])
def test_settled_verdicts_are_those_of_the_whole_record(step_s):
    """What a tracker sees of the record up to a time, and waits for, is what the record itself gives."""
    time, value = course(count=600, step_s=step_s)
    random = np.random.default_rng(5)
    for place in random.choice(590, 30, replace=False):
        value[place : place + random.integers(1, 4)] += random.choice([-30.0, 8.0, 60.0])
    scale = Scale(departure=3.0, still_s=6.0 * 3600.0, step_s=step_s, top=350.0)
    whole = judge(TEMPERATURE, time, value, scale).verdict
    for count in range(2, 600, 7):
        known_until_s = time[count - 1] - 1800.0
        part = judge(TEMPERATURE, time[:count], value[:count], scale, known_until_s)
        settled = time[:count] <= part.settled_s
        np.testing.assert_array_equal(part.verdict[settled], whole[:count][settled])
        # nothing waits for longer than three intervals, or half an hour, besides the lateness
        assert part.settled_s >= known_until_s - max(1800.0, 3.0 * step_s) - step_s
