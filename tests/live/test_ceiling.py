"""The filter where a humidity sensor is at its ceiling: against a truncated normal distribution and drawn
readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders.forecast_case import cabinet_record
from builders.live_case import live_fit, live_plan
from scipy.stats import truncnorm

from hygrokf.data.readings import SATURATED
from hygrokf.data.record import Record
from hygrokf.engine.timeline import Timeline
from hygrokf.estimation.likelihood import Gaussian
from hygrokf.estimation.smoother import observation
from hygrokf.live.plan import Plan
from hygrokf.live.traces import censored_trace, truncated_moments
from hygrokf.live.tracker import offline_course
from hygrokf.physics.signal_names import CABINET_RELATIVE_HUMIDITY


@pytest.fixture(scope="module")
def moist() -> Record:
    """Six days of moist air: the sensor is at its ceiling for hours."""
    return cabinet_record(6.0, moisture=0.55)


@pytest.fixture(scope="module")
def planned(moist: Record) -> Plan:
    return live_plan(live_fit(cabinet_record(16.0)), moist)


@pytest.mark.parametrize("z", [-6.0, -1.3, 0.0, 0.7, 3.0, 9.0, 25.0])
def test_moments_are_those_of_a_truncated_normal_distribution(z: float) -> None:
    mean, share, chance = truncated_moments(z)
    oracle = truncnorm(z, np.inf)
    assert mean == pytest.approx(oracle.mean(), rel=1e-6, abs=1e-12)
    assert 1.0 - share == pytest.approx(oracle.var(), rel=2e-3)
    assert chance == pytest.approx(_log_above(z), rel=1e-9)


def _log_above(z: float) -> float:
    from scipy.stats import norm

    return float(norm.logsf(z))


def censored_instant(moist: Record, planned: Plan) -> tuple[Timeline, Gaussian]:
    """The one instant with a reading at the ceiling of which just that was expected, and the state before
    it."""
    course = offline_course(planned, moist)
    t = course.run.timeline
    high = t.reading(CABINET_RELATIVE_HUMIDITY) >= SATURATED
    off = np.where(
        high,
        np.abs(course.trace.prediction[:, t.outputs.index(CABINET_RELATIVE_HUMIDITY)] - SATURATED),
        np.inf,
    )
    place = int(np.argmin(off))
    before = censored_trace(planned.likelihood(t.window(0, place)), planned.values).last
    return t.window(place, place + 1), before


def unread(t: Timeline) -> Timeline:
    """The same without the readings of humidity."""
    return t.with_readings(np.where(np.array(t.outputs) == CABINET_RELATIVE_HUMIDITY, np.nan, t.y))


def test_a_reading_at_the_ceiling_leaves_what_drawn_readings_leave(moist: Record, planned: Plan) -> None:
    """States and readings drawn from the filter's own Gaussian: of those whose reading is at the ceiling,
    mean and spread."""
    t, before = censored_instant(moist, planned)
    likelihood = planned.likelihood(unread(t))
    prior = likelihood.trace(planned.values, start=before).last
    predicted, row, variance = observation(
        likelihood, planned.values, 0, CABINET_RELATIVE_HUMIDITY, prior.mean
    )
    found = censored_trace(planned.likelihood(t), planned.values, before).last
    random = np.random.default_rng(8)
    drawn = random.multivariate_normal(prior.mean, prior.covariance, 400_000, method="eigh")
    shown = predicted + (drawn - prior.mean) @ row + np.sqrt(variance) * random.standard_normal(len(drawn))
    kept = drawn[shown >= SATURATED]
    assert 0.1 < len(kept) / len(drawn) < 0.9
    spread = np.sqrt(np.diag(prior.covariance))
    moved = (found.mean - prior.mean) / spread
    assert np.abs(moved - (kept.mean(axis=0) - prior.mean) / spread).max() < 0.01
    assert np.abs(moved).max() > 0.1
    expected = np.cov(kept.T) / np.outer(spread, spread)
    assert np.abs(found.covariance / np.outer(spread, spread) - expected).max() < 0.01
    assert np.abs(prior.covariance / np.outer(spread, spread) - expected).max() > 0.1


def test_its_likelihood_is_the_chance_of_such_a_reading(moist: Record, planned: Plan) -> None:
    t, before = censored_instant(moist, planned)
    found = censored_trace(planned.likelihood(t), planned.values, before)
    without = planned.likelihood(unread(t)).trace(planned.values, start=before)
    column = t.outputs.index(CABINET_RELATIVE_HUMIDITY)
    z = (SATURATED - without.prediction[0, column]) / np.sqrt(without.variance[0, column])
    assert found.loglik - without.loglik == pytest.approx(_log_above(z), rel=1e-9)


def test_readings_below_the_ceiling_are_the_filter_s_own(moist: Record, planned: Plan) -> None:
    series = moist[CABINET_RELATIVE_HUMIDITY]
    dry = moist.replace_series(replace(series, value=np.minimum(series.value, SATURATED - 1e-6)))
    course = offline_course(planned, dry)
    plain = planned.likelihood(course.run.timeline).trace(planned.values)
    assert np.array_equal(course.trace.mean, plain.mean) and course.trace.loglik == plain.loglik


def test_pieces_end_in_the_whole_bit_for_bit(moist: Record, planned: Plan) -> None:
    course = offline_course(planned, moist)
    t = course.run.timeline
    assert (t.reading(CABINET_RELATIVE_HUMIDITY) >= SATURATED).sum() > 100
    state = None
    for first in range(0, len(t), 37):
        part = censored_trace(
            planned.likelihood(t.window(first, min(first + 37, len(t)))), planned.values, state
        )
        assert np.array_equal(part.mean, course.trace.mean[first : first + 37])
        assert np.array_equal(part.covariance, course.trace.covariance[first : first + 37])
        state = part.last
    assert np.array_equal(state.mean, course.trace.last.mean)
    assert np.array_equal(course.trace.covariance, np.swapaxes(course.trace.covariance, 1, 2))


def test_how_far_above_the_ceiling_a_sensor_reads_says_nothing(moist: Record, planned: Plan) -> None:
    """A sensor that shows 100 % and one that shows up to 104 % in saturated air leave the same state."""
    series = moist[CABINET_RELATIVE_HUMIDITY]
    random = np.random.default_rng(3)
    more = np.where(series.value >= SATURATED, 1.0 + 0.04 * random.random(len(series)), series.value)
    one, other = (
        offline_course(planned, moist),
        offline_course(planned, moist.replace_series(replace(series, value=more))),
    )
    assert np.array_equal(one.trace.mean, other.trace.mean)
