"""The climate that comes: the model itself without readings, mixed over members; and how long to pre-heat."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from builders.forecast_case import DAY_S, STANDING, START_S, STEP_S, cabinet_record, standstill
from builders.live_case import live_fit, live_plan
from builders.record_edits import changed, without

from hygrokf.data.ambient import at_times
from hygrokf.data.prepared import prepare
from hygrokf.data.record import Record, Series
from hygrokf.estimation.likelihood import Gaussian
from hygrokf.identification.fit import Fit
from hygrokf.live.condition import Surface, air_condition, inputs_of
from hygrokf.live.forecast import (
    DRY_ENOUGH,
    LONGEST_HEATING_H,
    STAYS_H,
    NoForecast,
    advice_from,
    conditions_by_member,
    forecast,
    restart,
)
from hygrokf.live.plan import Plan
from hygrokf.live.scenarios import HORIZON_S, Scenarios, persistence
from hygrokf.live.traces import censored_trace
from hygrokf.live.tracker import Point, offline_course
from hygrokf.modelling.design import design, extended
from hygrokf.texts.live_codes import AdviceCode, BasisCode, StateCode

DAYS = 16.0
NOW_S = START_S + 14.0 * DAY_S
HOUR_S = 3600.0
SURFACE = Surface(0.5)
QUANTITIES = (
    "temperature_K",
    "relative_humidity",
    "absolute_humidity_g_m3",
    "dew_point_K",
    "margin_K",
    "surface_humidity",
)


@pytest.fixture(scope="module")
def record() -> Record:
    return cabinet_record(DAYS)


@pytest.fixture(scope="module")
def planned_for(record: Record) -> Plan:
    return live_plan(live_fit(record), record)


def point_at(plan_: Plan, record: Record, now_s: float = NOW_S) -> Point:
    """The offline filter's estimate after the readings up to now."""
    course = offline_course(plan_, record.window(START_S, now_s))
    assert course.seconds[-1] == pytest.approx(now_s, abs=1e-3)
    return Point(now_s, course.trace.last)


@pytest.fixture(scope="module")
def point(planned_for: Plan, record: Record) -> Point:
    return point_at(planned_for, record)


def future(record: Record, time_s: np.ndarray) -> dict[str, np.ndarray]:
    """What truly came, as a member: of power and pre-heating the means over the steps."""
    member = {
        "ambient_temperature": at_times(record["ambient_temperature"], time_s, 6.0),
        "ambient_absolute_humidity": at_times(prepare(record).ambient_vapour, time_s, 6.0),
    }
    step = time_s[1] - time_s[0]
    parts = np.arange(0.0, step - 1.0, STEP_S)
    for name in ("active_power", "preheating"):
        member[name] = at_times(record[name], time_s[:, None] - parts, 6.0).mean(axis=1)
    return member


def unread(plan_: Plan, record: Record) -> tuple:
    """The offline filter over the whole record, with no reading of the cabinet after now: its run, and its
    condition."""
    made = offline_course(plan_, record).run
    t = made.timeline
    y = np.where((t.origin_s + HOUR_S * t.time > NOW_S + 1.0)[:, None], np.nan, t.y)
    trace = censored_trace(plan_.likelihood(t.with_readings(y)), plan_.values)
    u = inputs_of(plan_.model, t)
    moments = trace.mean, trace.covariance
    return t, air_condition(plan_.model, plan_.values, t.seconds, u, *moments, SURFACE)


# -- the model ahead -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("step_s", [600.0, 1800.0])
def test_with_the_true_future_it_is_the_filter_without_readings(
    record: Record, planned_for: Plan, point: Point, step_s: float
) -> None:
    time = NOW_S + np.arange(-18 * 600.0, 40 * HOUR_S + 1.0, step_s)
    known = Scenarios(NOW_S, time, (future(record, time),), BasisCode.OPERATION_AS_NOW())
    found = forecast(planned_for, point, known, SURFACE)
    t, offline = unread(planned_for, record)
    place = np.searchsorted(t.origin_s + HOUR_S * t.time, found.condition.time_s - 1.0)
    assert len(found.condition.time_s) == 1 + int(40 * HOUR_S / step_s)
    for name in QUANTITIES:
        mine, theirs = getattr(found.condition, name), getattr(offline, name)
        if step_s == 600.0:  # the record's own clock
            assert mine.value == pytest.approx(theirs.value[place], rel=1e-9, abs=1e-9), name
            assert mine.sd == pytest.approx(theirs.sd[place], rel=1e-9, abs=1e-9), name
        else:  # power as means and weather as lines over half an hour
            off = np.abs(mine.value - theirs.value[place])
            most = 1.0 if name.endswith("_K") else 0.15 if name.endswith("g_m3") else 0.03
            assert 0.0 < off.max() < most and off.mean() < 0.2 * most, name


def test_at_the_beginning_it_is_the_state_itself(record: Record, planned_for: Plan, point: Point) -> None:
    found = forecast(planned_for, point, persistence(record, NOW_S), SURFACE)
    t, offline = unread(planned_for, record)
    now = int(np.searchsorted(t.origin_s + HOUR_S * t.time, NOW_S - 1.0))
    assert found.made_s == found.condition.time_s[0] == NOW_S
    assert found.condition.time_s[-1] == NOW_S + HORIZON_S
    for name in QUANTITIES:
        mine, theirs = getattr(found.condition, name), getattr(offline, name)
        assert mine.value[0] == pytest.approx(theirs.value[now], rel=1e-9), name
        assert mine.sd[0] == pytest.approx(theirs.sd[now], rel=1e-6), name
    # what comes is less sure than what is, and its temperature follows the weather and operation that may
    # come
    assert found.condition.temperature_K.sd[-1] > 5.0 * found.condition.temperature_K.sd[0]


def test_the_mixture_is_that_of_drawn_courses(record: Record, planned_for: Plan, point: Point) -> None:
    scenarios = persistence(record, NOW_S)
    limit = 0.5
    each = conditions_by_member(planned_for, point, scenarios, SURFACE)
    found = forecast(planned_for, point, scenarios, SURFACE, limit)
    assert found.limit == limit and found.basis == scenarios.basis
    random = np.random.default_rng(5)
    count = 4000  # of each member, each instant
    for name in ("relative_humidity", "margin_K"):
        drawn = np.concatenate(
            [
                getattr(one, name).value
                + getattr(one, name).sd * random.standard_normal((count, len(one.time_s)))
                for one in each
            ]
        )
        mixed = getattr(found.condition, name)
        spread = drawn.std(axis=0)
        assert np.abs(mixed.value - drawn.mean(axis=0)).max() < 0.03 * spread.max()
        assert mixed.sd == pytest.approx(spread, rel=0.03)
        seen, said = {
            "relative_humidity": ((drawn > limit).mean(axis=0), found.above),
            "margin_K": ((drawn < 0.0).mean(axis=0), found.condition.condensation),
        }[name]
        assert np.abs(seen - said).max() < 0.01
        assert name == "margin_K" or said.max() - said.min() > 0.2


# -- the advice ----------------------------------------------------------------------------------------------
HOURS = np.arange(0.0, LONGEST_HEATING_H + STAYS_H + 0.01, 1.0 / 6.0)


def test_dry_at_once_needs_no_heating() -> None:
    advice = advice_from(HOURS, np.full(len(HOURS), 0.97), 0.6)
    assert (advice.hours, advice.probability) == (0.0, 0.97)
    assert advice.statement.code is AdviceCode.NO_PREHEATING
    assert advice.statement.text == (
        "no pre-heating is needed: relative humidity is below 60 % at the coldest surface with a probability "
        "of 97 %, and of at least 97 % until a start within 1 h"
    )
    assert "over 99 %" in advice_from(HOURS, np.ones(len(HOURS)), 0.6).statement.text


def test_never_dry_says_how_close_it_comes() -> None:
    chance = np.where(HOURS < 20.0, 0.2 + 0.02 * HOURS, 0.1)
    advice = advice_from(HOURS, chance, 0.6)
    best = HOURS[HOURS < 20.0][-1]
    assert advice.hours is None and advice.probability == pytest.approx(0.2 + 0.02 * best)
    for number in ("24 h", "below 60 %", "95 %", "at best it is 60 %", f"after {best:.1f} h"):
        assert number in advice.statement.text
    assert "under 1 %" in advice_from(HOURS, np.zeros(len(HOURS)), 0.6).statement.text


def test_a_peak_of_vapour_must_have_passed() -> None:
    """Dry for half an hour, then the heat drives vapour out, then dry for good: the first moment is none."""
    chance = np.where(HOURS < 0.4, 0.99, np.where(HOURS < 4.9, 0.3, 0.96))
    advice = advice_from(HOURS, chance, 0.6)
    assert advice.hours == pytest.approx(5.0) and advice.probability == pytest.approx(0.96)
    assert advice.statement.code is AdviceCode.PREHEAT and advice.statement.values["limit"] == 0.6
    # dry for a moment alone is never dry, though the probability was reached
    moment = advice_from(HOURS, np.where(np.abs(HOURS - 3.0) < 0.4, 0.99, 0.5), 0.6)
    assert moment.hours is None and moment.probability == 0.99


def test_the_longest_time_is_the_last_one_that_is_advised() -> None:
    at_last = advice_from(HOURS, np.where(HOURS > LONGEST_HEATING_H - 0.01, 0.99, 0.5), 0.6)
    assert at_last.hours == pytest.approx(LONGEST_HEATING_H)
    too_late = advice_from(HOURS, np.where(HOURS > LONGEST_HEATING_H + 0.1, 0.99, 0.5), 0.6)
    assert too_late.hours is None and too_late.probability == 0.5
    edge = advice_from(HOURS, np.full(len(HOURS), DRY_ENOUGH), 0.6)
    assert edge.hours == 0.0
    below = advice_from(HOURS, np.full(len(HOURS), np.nextafter(DRY_ENOUGH, 0.0)), 0.6)
    assert below.hours is None


# -- heating -------------------------------------------------------------------------------------------------
COLD = Surface(0.3)


def cabinet(record: Record, *additions: tuple[str, dict], **given: float) -> Plan:
    """A plan of a cabinet 9 K warmer with its heating on, with mechanisms added and parameters given."""
    base = extended(live_fit(record).design, additions)
    values = {p.name: p.start for p in base.model.parameters} | STANDING | {"preheating_heat": 9.0} | given
    return live_plan(Fit("cabinet", base, values), record, wandering={})


def test_material_that_gives_off_vapour_takes_longer_to_dry(record: Record) -> None:
    """40 g/m³ of water for each unit of humidity, given off within hours when heated: a peak, and a longer
    advice."""
    humidity = 0.74
    sorption = {"sorption_capacity": 40.0, "sorption_time": 3.0}
    bare, sorbing = cabinet(record), cabinet(record, ("moisture_sorption", {}), **sorption)
    advice, vapour = [], []
    for one in (bare, sorbing):
        state, scenarios = standstill(one, humidity, NOW_S, "preheating")
        (course,) = conditions_by_member(
            one, state, scenarios.with_preheating(LONGEST_HEATING_H + STAYS_H), COLD
        )
        advice.append(restart(one, state, scenarios, COLD, 0.6))
        vapour.append(course.absolute_humidity_g_m3.value)
    without_, with_ = vapour
    assert without_.argmax() == 0 and 0 < with_.argmax() < len(with_) - 1
    assert with_.max() > 1.03 * with_[0] and with_[-1] < 0.99 * with_.max()
    assert 0.0 < advice[0].hours < advice[1].hours - 1.0
    assert all(DRY_ENOUGH <= one.probability < 1.0 for one in advice)
    # what is advised is what the air at the surface does
    dry = course.surface_humidity.upper[(course.time_s - NOW_S) >= 3600.0 * advice[1].hours]
    assert np.all(dry < 0.605)


def test_who_never_saw_a_pre_heating_gives_no_advice(record: Record) -> None:
    cold = without(record, "preheating")
    one = live_plan(live_fit(cold), cold)
    scenarios = persistence(cold, NOW_S)
    state = point_at(one, cold)
    advice = restart(one, state, scenarios, SURFACE)
    assert (advice.hours, advice.probability) == (None, None)
    assert advice.statement == AdviceCode.HEATING_UNKNOWN()
    assert np.isfinite(forecast(one, state, scenarios, SURFACE).condition.temperature_K.value).all()


def test_a_model_without_humidity_forecasts_the_temperature(record: Record) -> None:
    warm = without(record, "cabinet_relative_humidity")
    base = design(warm, kind="thermal")
    one = live_plan(Fit("warm", base, {p.name: p.start for p in base.model.parameters}), warm)
    state, scenarios = point_at(one, warm), persistence(record, NOW_S)
    found = forecast(one, state, scenarios, SURFACE)
    assert np.isfinite(found.condition.temperature_K.sd).all() and np.isnan(found.above).all()
    assert found.condition.relative_humidity is None and found.condition.condensation is None
    advice = restart(one, state, scenarios, SURFACE)
    assert (advice.hours, advice.statement) == (None, StateCode.MODEL_WITHOUT_HUMIDITY())


# -- what is not known ahead ---------------------------------------------------------------------------------
def test_a_switch_is_foretold_by_what_the_forecast_itself_shows(record: Record) -> None:
    """A cooling stage out of reach changes nothing, and one that is always on cools.

    All begin from the state that the plain model filtered: a filter that believes in a cooling that is not
    there takes the readings for a further heat release, and goes on with that.
    """
    plain = live_fit(record).design
    one = live_plan(Fit("plain", plain, {p.name: p.start for p in plain.model.parameters}), record)
    state, scenarios = point_at(one, record), persistence(record, NOW_S)
    without = forecast(one, state, scenarios, SURFACE).condition.temperature_K.value
    found = {}
    for full_K in (350.0, 200.0):
        switch = {"venting": {"reads": "cabinet_temperature", "start": full_K - 3.0, "full": full_K}}
        base = extended(plain, [("throttled_cooling_loss", {})], features=switch)
        values = {p.name: p.start for p in base.model.parameters} | {"throttled_conductance": 3.0}
        one = live_plan(Fit("cooled", base, values), record)
        found[full_K] = forecast(one, state, scenarios, SURFACE).condition.temperature_K.value
        assert restart(one, state, scenarios, SURFACE).statement.text
    assert found[350.0][1:] == pytest.approx(without[1:], abs=0.05)
    assert found[200.0][-1] < without[-1] - 0.1


def test_a_model_that_reads_the_weather_has_one(record: Record) -> None:
    wind = Series("wind_speed", record["active_power"].time, np.full(len(record["active_power"]), 8.0))
    windy = replace(record, series=(*record.series, wind))
    base = extended(live_fit(record).design, [("wind_loss", {})], features={"wind_tenth": {}})
    values = {p.name: p.start for p in base.model.parameters}
    one = live_plan(Fit("windy", base, values), windy)
    state = point_at(one, windy)
    assert np.isfinite(forecast(one, state, persistence(windy, NOW_S), SURFACE).condition.margin_K.sd).all()
    with pytest.raises(NoForecast, match="the model reads wind_speed"):
        forecast(one, state, persistence(record, NOW_S), SURFACE)


def test_scenarios_of_another_time_is_refused(record: Record, planned_for: Plan, point: Point) -> None:
    for late_s in (-7200.0, 600.0, 3 * DAY_S):
        with pytest.raises(NoForecast, match=re.escape(f"begin {late_s:+.0f} s from it")):
            forecast(planned_for, replace(point, time=NOW_S - late_s), persistence(record, NOW_S), SURFACE)


def test_an_unknown_power_makes_it_less_sure_not_impossible(record: Record) -> None:
    gap = changed(record, "active_power", np.nan, START_S + 5 * DAY_S, START_S + 5.4 * DAY_S)
    one = live_plan(live_fit(gap), gap)
    state = point_at(one, gap)
    known = forecast(one, state, persistence(gap, NOW_S), SURFACE).condition
    lost = persistence(without(gap, "active_power"), NOW_S)
    found = forecast(one, state, lost, SURFACE).condition
    assert lost.basis.values["operation"] == BasisCode.OPERATION_UNKNOWN()
    assert np.all(found.temperature_K.sd[6:] > 0.3) and np.isfinite(found.margin_K.value).all()
    # half an hour ahead the power of now is worth something
    assert found.temperature_K.sd[1] > known.temperature_K.sd[1]
    # but a pre-heating is at standstill, whatever was known
    hours = [restart(one, state, o, SURFACE, 0.95).probability for o in (lost, persistence(gap, NOW_S))]
    assert hours[0] == pytest.approx(hours[1], abs=0.05)


@pytest.mark.parametrize(
    ("move_K", "sd", "vapour"),
    [(-45.0, 1e-3, 0.05), (-25.0, 1.0, -3.0), (25.0, 1.0, 60.0), (0.0, 200.0, 6.0)],
)
def test_odd_states_and_weathers_stay_finite(
    record: Record, planned_for: Plan, move_K: float, sd: float, vapour: float
) -> None:
    """Arctic frost, vapour below zero, tropical saturation, a state that nobody knows."""
    odd = changed(record, "ambient_temperature", record["ambient_temperature"].value + move_K)
    states = planned_for.model.states
    mean = np.zeros(len(states))
    mean[states.index("converter_temperature")] = 290.0 + move_K
    mean[states.index("vapour")] = vapour
    state = Point(NOW_S, Gaussian(mean, np.diag(np.where(np.char.find(states, "change") >= 0, 1e-2, sd**2))))
    scenarios = persistence(odd, NOW_S)
    found = forecast(planned_for, state, scenarios, SURFACE)
    for name in QUANTITIES:
        quantity = getattr(found.condition, name)
        assert np.isfinite(quantity.value).all() and np.isfinite(quantity.sd).all(), name
        assert np.all(quantity.sd > 0.0)
    for chance in (found.above, found.condition.condensation):
        assert np.all((chance >= 0.0) & (chance <= 1.0))
    assert found.condition.relative_humidity.value.min() > 0.0
    advice = restart(planned_for, state, scenarios, SURFACE)
    assert advice.hours is None or 0.0 <= advice.hours <= LONGEST_HEATING_H
    assert 0.0 <= advice.probability <= 1.0
