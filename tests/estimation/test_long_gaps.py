"""Gaps of months to ten years, against dense linear algebra, an integrator, and the filter that takes every
sub-step."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.climate_case import known_fit, made_up_weather
from builders.linear_oracles import van_loan
from builders.scores import check_score
from builders.switch_case import heated, weather
from builders.tracker_case import LATENESS_S, arriving, planned, readings_of
from scipy.linalg import expm

from hygrokf.cases.case_file import read_case
from hygrokf.cases.synthetic import synthetic_turbine, write_case
from hygrokf.climate.ensemble import course, simulate_years
from hygrokf.climate.region import driven
from hygrokf.data.record import Record
from hygrokf.engine.timeline import Timeline, timeline
from hygrokf.estimation.batch_filter import SideBySide
from hygrokf.estimation.likelihood import Likelihood, Trace
from hygrokf.estimation.rates_fault import RatesFault
from hygrokf.estimation.smoother import smoothed_states, transition
from hygrokf.evaluation.simulation import free_run
from hygrokf.live.plan import Plan
from hygrokf.live.tracker import Tracker, offline_course
from hygrokf.modelling.inputs import model_inputs
from hygrokf.physics.mechanisms.wandering import (
    wandering_exchange,
    wandering_release,
    wandering_time_constant,
)
from hygrokf.physics.model import extend
from hygrokf.physics.psychrometrics import Surface

YEAR_H = 8766.0
AT = 60
"""Instant that ends the gap."""


def gapped(case: object, hours: float, count: int = 120) -> object:
    """The case with `hours` more before one of its instants; what is read there and averaged begins after the
    gap."""
    case = case.first(count)
    moved = case.timeline.time.copy()
    moved[AT:] += hours
    readings = {name: np.where(np.arange(count) == AT, np.nan, v) for name, v in case.readings.items()}
    made = timeline(case.model, moved, case.inputs, readings, case.resets)
    return replace(case, timeline=made, readings=readings)


def before_and_after(case: object, values: Mapping[str, float]) -> tuple[Trace, np.ndarray, np.ndarray]:
    trace = case.likelihood.trace(values)
    return trace, trace.prior_mean[AT], trace.prior_covariance[AT]


# -- the moments after a gap ---------------------------------------------------------------------------------
def daily(
    a: np.ndarray, b: np.ndarray, slope: np.ndarray, noise: np.ndarray, days: int, hours: float
) -> Callable:
    """dx = (A x + b + t slope) dt + noise, by Van Loan's matrices over each of `days` equal parts, one after
    the other."""
    n, h = len(a), hours / days
    f, gained = van_loan(a, noise, h)
    wide = np.zeros((n + 2, n + 2))
    wide[:n, :n], wide[:n, n], wide[:n, n + 1], wide[n, n + 1] = a, slope, b, 1.0
    forced = expm(wide * h)

    def through(mean: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        for day in range(days):
            mean = (forced @ np.concatenate([mean, [day * h, 1.0]]))[:n]
            covariance = f @ covariance @ f.T + gained
        return mean, covariance

    return through


@pytest.mark.parametrize(("years", "correlation_h"), [(1.0, 3000.0), (10.0, 8.0)])
def test_a_linear_model_is_the_dense_one(thermal: object, years: float, correlation_h: float) -> None:
    """The thermal model with a heat release that wanders (a random walk) and a disturbance as slow as four
    months."""
    case = gapped(thermal, years * YEAR_H)
    model = extend(case.model, wandering_release(0.3))
    values = case.values | {"heat_disturbance_time": correlation_h, "release_change_rate": 0.3}
    case = replace(
        case,
        model=model,
        timeline=timeline(model, case.timeline.time, case.inputs, case.readings, case.resets),
    )
    trace, mean, covariance = before_and_after(case, values)
    assert list(model.states) == ["converter_temperature", "heat_disturbance", "release_change"]
    ratio, tau, u = values["resistance_ratio"], values["thermal_time_constant"], case.inputs
    a = np.array([[-1 / tau, 1 / ratio / tau, 1 / ratio / tau], [0, -1 / correlation_h, 0], [0, 0, 0]])
    noise = np.diag(
        [
            values["thermal_diffusion"] ** 2,
            2 * values["heat_disturbance_sd"] ** 2 / correlation_h,
            0.3**2 / 24.0,
        ]
    )
    assert u["operating"][AT] == 1.0
    release = (
        values["heat_release_operation"]
        + values["heat_release_power_1"] * u["power_1"][AT]
        + values["heat_release_power_2"] * u["power_2"][AT]
    )
    own = values["heat_release_operation_ambient"]
    hours = case.timeline.time[AT] - case.timeline.time[AT - 1]
    first, last = u["ambient_temperature"][[AT - 1, AT]]
    force = (first + (release + own * (first - 283.15)) / ratio) / tau
    rise = (1 + own / ratio) / tau * (last - first) / hours
    through = daily(a, np.array([force, 0, 0]), np.array([rise, 0, 0]), noise, 3650, hours)
    expected, spread = through(trace.mean[AT - 1], trace.covariance[AT - 1])
    np.testing.assert_allclose(mean, expected, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(covariance, spread, rtol=1e-8, atol=1e-9)
    # a random walk never forgets, and what it drives follows it
    assert covariance[2, 2] == pytest.approx(
        trace.covariance[AT - 1, 2, 2] + 0.3**2 * hours / 24.0, rel=1e-12
    )
    assert covariance[0, 2] == pytest.approx(covariance[2, 2] / ratio, rel=1e-3)


def test_the_joint_model_is_the_integrator_s(joint: object, joint_moments: Callable) -> None:
    """Four months, which scipy's integrator takes in its own steps of minutes."""
    case = gapped(joint, 3000.0)
    values = case.values | {"heat_disturbance_time": 100.0}
    trace, mean, covariance = before_and_after(case, values)
    advance = joint_moments(case, values)
    expected, spread = advance(AT, trace.mean[AT - 1], trace.covariance[AT - 1])
    np.testing.assert_allclose(mean, expected, rtol=1e-7, atol=1e-14)
    np.testing.assert_allclose(covariance, spread, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", ["thermal", "joint"])
def test_the_score_after_ten_years_is_the_central_difference(
    name: str, request: pytest.FixtureRequest
) -> None:
    case = gapped(request.getfixturevalue(name), 10.0 * YEAR_H)
    check_score(case.likelihood, case.values)


def test_ten_years_cost_hardly_more_than_a_week(joint: object) -> None:
    """Measured: 4 ms beside 1 ms; every sub-step of it would take a second."""

    def cost(hours: float) -> float:
        likelihood, times = gapped(joint, hours).likelihood, []
        for _ in range(5):
            begun = time.process_time()
            likelihood.value(joint.values)
            times.append(time.process_time() - begun)
        return min(times)

    assert cost(10.0 * YEAR_H) < cost(168.0) + 0.06


def test_a_gap_is_the_same_with_instants_in_it(joint: object) -> None:
    """Further instants where nothing is read, days before the end, change nothing: the end of a gap knows no
    beginning."""
    case = gapped(joint, YEAR_H)
    end = case.timeline.time[AT]
    split = case.split(np.array([end - 5000.0, end - 900.0, end - 50.0]))
    one, other = (c.likelihood.trace(case.values) for c in (case, split))
    # the sub-steps differ, and their errors of 1e-7 standard deviations
    np.testing.assert_allclose(one.prior_mean[AT], other.prior_mean[AT + 3], rtol=1e-7, atol=1e-12)
    spread = np.sqrt(np.diagonal(one.prior_covariance[AT]))
    apart = (one.prior_covariance[AT] - other.prior_covariance[AT + 3]) / np.outer(spread, spread)
    np.testing.assert_allclose(apart, 0.0, atol=1e-6)


def through_days(case: object) -> object:
    """The case with an instant on every day of its gap."""
    before, after = case.timeline.time[[AT - 1, AT]]
    return case.split(np.arange(before + 24.0, after, 24.0))


def test_the_smoother_and_the_transition_cross_a_gap(thermal: object) -> None:
    case = gapped(thermal, 2.0 * YEAR_H)
    values = case.values | {"heat_disturbance_time": 20000.0}
    mean, covariance = smoothed_states(case.likelihood, values)
    daily = through_days(case)
    kept = np.isin(daily.timeline.time, case.timeline.time)
    expected, spread = (part[kept] for part in smoothed_states(daily.likelihood, values))
    np.testing.assert_allclose(mean, expected, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(covariance, spread, rtol=1e-6, atol=1e-9)
    _, f, _ = transition(case.likelihood, values, AT, case.likelihood.trace(values).mean[AT - 1])
    hours = case.timeline.time[AT] - case.timeline.time[AT - 1]
    assert f[1, 1] == pytest.approx(math.exp(-hours / 20000.0), rel=1e-12)


def test_a_diffuse_start_before_a_gap(thermal: object) -> None:
    case = gapped(thermal, YEAR_H * 2)

    def likelihood(one: object) -> Likelihood:
        never = one.timeline.y.copy()
        never[:AT] = np.nan  # the infinite variance outlasts the gap where nothing is read before it
        line = one.timeline.with_readings(never)
        return Likelihood(one.model, line, initial="diffuse", diffuse_states=("heat_disturbance",))

    values = case.values | {"heat_disturbance_time": 9000.0}
    daily = likelihood(through_days(case)).value(values)
    assert likelihood(case).value(values) == pytest.approx(daily, rel=1e-9)
    check_score(likelihood(case), values)


# -- pieces of a run, many runs, the tracker -----------------------------------------------------------------
@pytest.mark.parametrize("cut", [AT, AT + 1])
def test_stop_and_resume_at_a_gap_is_one_run_bit_for_bit(joint: object, cut: int) -> None:
    case = gapped(joint, YEAR_H)
    through = case.likelihood.trace(case.values)
    first = Likelihood(case.model, case.timeline.window(0, cut)).trace(case.values)
    rest = Likelihood(case.model, case.timeline.window(cut, len(case.timeline)))
    second = rest.trace(case.values, start=first.last)
    np.testing.assert_array_equal(np.concatenate([first.mean, second.mean]), through.mean)
    np.testing.assert_array_equal(np.concatenate([first.covariance, second.covariance]), through.covariance)


def test_runs_side_by_side_cross_gaps_of_their_own(joint: object) -> None:
    """Five runs, more than a block of lanes: an hour, a year and ten, with parameters of their own."""
    hours = np.array([1.0, YEAR_H, 200.0, 10.0 * YEAR_H, YEAR_H])
    sets = [joint.values | {"hygric_k": k, "thermal_time_constant": 5 * k} for k in (0.2, 0.3, 0.4, 0.5, 0.6)]
    lines = [
        replace(
            joint.first(3).timeline, steps=np.array([[0.0], [h], [0.25]]), key=np.array([0, 1, 2], np.int32)
        )
        for h in hours
    ]
    assert not joint.timeline.regimes
    lines = [t.with_readings(np.full_like(t.y, np.nan)) for t in lines]
    runs_of = [Likelihood(joint.model, t) for t in lines]
    mean = np.array([one.first_gaussian(values).mean for one, values in zip(runs_of, sets, strict=True)])
    side = SideBySide(joint.model, sets)
    side.begin({name: np.full(5, lines[0].input(name)[0]) for name in joint.model.inputs})
    for k, step in ((1, hours), (2, np.full(5, 0.25))):
        before, inputs = mean, {name: np.full(5, lines[0].input(name)[k]) for name in joint.model.inputs}
        mean, gained = side.step(before, step, inputs)
        for i, (one, values) in enumerate(zip(runs_of, sets, strict=True)):
            expected, _, spread = transition(one, values, k, before[i])
            np.testing.assert_allclose(mean[i], expected, rtol=1e-7, atol=1e-7)
            np.testing.assert_allclose(gained[i], spread, rtol=1e-6, atol=1e-6)


def apart(record: Record, days: float) -> Record:
    """The record with its second half later: all sources are silent between."""
    middle = 0.5 * (record.start_s + record.end_s)

    def moved(series: object) -> object:
        later = series.time - series.interval_s > middle
        kept = later | (series.time <= middle)
        return replace(series, time=(series.time + 86400.0 * days * later)[kept], value=series.value[kept])

    return record.replace_series(*(moved(s) for s in record.series))


def test_the_tracker_is_the_offline_filter_across_a_gap_bit_for_bit(tmp_path: Path) -> None:
    """All properties wander: what was known of them before the gap is less sure after it, and not lost."""
    record = apart(read_case(write_case(synthetic_turbine(seed=6, days=3.0), tmp_path)), 3650.0)
    model: Plan = planned(record)
    tracker, course = Tracker(model), None
    readings = arriving(readings_of(record), 1, 0.95 * LATENESS_S)
    for first in range(0, len(readings), 40):
        tracker.take(readings[first : first + 40])
        course = tracker.advance() or course
    offline = offline_course(model, record)
    assert not tracker.counts["late"]
    last = int(np.searchsorted(offline.seconds, tracker.point.time + 1e-3, side="right"))
    there = Likelihood(model.model, offline.run.timeline.window(0, last))
    final = there.trace(model.values).last
    assert np.array_equal(tracker.point.state.mean, final.mean)
    assert np.array_equal(tracker.point.state.covariance, final.covariance)
    assert np.array_equal(course.trace.mean[-1], offline.trace.mean[-1])
    t = offline.run.timeline
    (gap,) = np.flatnonzero(t.steps[t.key, 0] > 24.0 * 300.0)
    for mechanism in (wandering_time_constant, wandering_exchange):
        (state,) = mechanism().states
        i = model.model.states.index(state)
        was, now = offline.trace.covariance[gap - 1, i, i], offline.trace.prior_covariance[gap, i, i]
        rate = model.values[f"{state}_rate"]
        assert now - was == pytest.approx(rate**2 * t.steps[t.key[gap], 0] / 24.0, rel=1e-6)
        assert offline.trace.prior_mean[gap, i] == pytest.approx(offline.trace.mean[gap - 1, i], rel=1e-9)


def test_a_climate_crosses_the_time_between_its_files() -> None:
    """Weather of three weeks, half a year of nothing, three weeks: every member goes on as it would."""
    fit = known_fit()
    record, _ = driven(fit, apart(made_up_weather(42), 182.0), None)
    begun = time.process_time()
    years = list(simulate_years(fit, *course(fit, record), [dict(fit.values)] * 2, 3, Surface()))
    assert time.process_time() - begun < 10.0
    for year in years:
        assert np.isfinite(year.temperature_K).all() and np.isfinite(year.relative_humidity).all()
    together = np.concatenate([y.temperature_K for y in years], axis=1)
    outside = np.concatenate([y.ambient["temperature_K"] for y in years])
    assert abs(np.mean(together - outside)) < 15.0


def test_a_switch_decides_after_a_gap_as_without_one() -> None:
    """A heater at standstill: the days after a gap of two years are those after any other week, to the
    thermostat's 3 K."""
    record = weather(8.0)
    base, values = heated(record)
    long = apart(record, 730.0)
    begun = time.process_time()
    found = free_run(base, values, model_inputs(base, long))
    assert time.process_time() - begun < 10.0
    plain = free_run(base, values, model_inputs(base, record))
    days_after = slice(-144 * 2, None)
    assert np.mean(found.temperature[0][days_after]) == pytest.approx(
        np.mean(plain.temperature[0][days_after]), abs=0.5
    )


# -- what no step resolves -----------------------------------------------------------------------------------
def many_gaps(case: object, count: int) -> Timeline:
    hours = YEAR_H * np.arange(count)
    inputs = {name: np.full(count, v[0]) for name, v in case.inputs.items()}
    return timeline(case.model, hours, inputs, {}, origin_s=1.6e9)


def test_rates_that_no_reading_resolves_cost_no_more(joint: object) -> None:
    t = many_gaps(joint, 1200)
    fast = joint.values | {"thermal_time_constant": 1e-3}
    assert math.isfinite(Likelihood(joint.model, t).value(fast))


def test_a_time_constant_of_zero_is_a_rate_that_is_not_finite(thermal: object) -> None:
    """As where a profile takes another parameter to its physical limit."""
    with pytest.raises(RatesFault, match=r"expected finite rates, found none for .*time_constant = 0"):
        Likelihood(thermal.model, many_gaps(thermal, 40)).value(
            thermal.values | {"thermal_time_constant": 0.0}
        )


def test_a_model_that_grows_without_limit_is_minus_infinity(thermal: object) -> None:
    case = gapped(thermal, 10.0 * YEAR_H)
    assert case.likelihood.value(case.values | {"thermal_time_constant": -2.0}) == -math.inf
