"""Logged actuators live: the same inputs as offline, their course ahead, and advice by a heater's effect."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.actuated import HEATER_W as PLANT_HEATER_W
from builders.actuated import actuated
from builders.forecast_case import DAY_S, RATED_W, STANDING, START_S, cabinet_record, standstill
from builders.live_case import expect_offline, expect_state, live_plan
from builders.record_edits import changed, without
from builders.store_case import queried
from builders.tracker_case import LATENESS_S, arriving, planned, readings_of

from hygrokf import identify
from hygrokf.data.record import Record, Series
from hygrokf.identification.fit import Fit
from hygrokf.live.condition import Surface
from hygrokf.live.config import turbine_of
from hygrokf.live.forecast import LONGEST_HEATING_H, forecast, heaters, heating, restart
from hygrokf.live.plan import Plan, SignalReporting, plan
from hygrokf.live.scenarios import persistence
from hygrokf.live.service import Service
from hygrokf.live.sources.local import Playback, record_mapping, record_messages
from hygrokf.live.storage.store import open_store
from hygrokf.live.tracker import Tracker, offline_course
from hygrokf.live.turbines import Turbine
from hygrokf.modelling.design import Design, design

HOUR_S = 3600.0
DAYS = 14.0
NOW_S = START_S + DAYS * DAY_S
COLD = Surface(0.3)
HEATER_W = 400.0


def courses_of(time: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Courses (T,) of every actuator, each switching in its own way."""
    random = np.random.default_rng(seed)
    hours = (time - START_S) / HOUR_S
    noise = random.random(len(time))
    return {
        "heater_power": HEATER_W * (hours % 11.0 < 3.0),
        "fan_duty": np.clip(0.5 + 0.5 * np.sin(hours / 3.0), 0.0, 1.0),
        "pump_duty": np.where(hours % 7.0 < 4.0, 0.7, 0.2),
        "dehumidifier_duty": np.where(noise > 0.6, noise, 0.0),
        "door_open": (hours % 37.0 < 1.0).astype(float),
    }


def acting(record: Record, seed: int = 3, **given: np.ndarray) -> Record:
    """A record with logged actuators, as means over its ten minutes."""
    time = record["active_power"].time
    found = [
        Series(name, time, values, "mean", 600.0)
        for name, values in (given or courses_of(time, seed)).items()
    ]
    return replace(record, series=(*record.series, *found))


@pytest.fixture(scope="module")
def record() -> Record:
    return acting(cabinet_record(4.0))


def holed(record: Record) -> Record:
    """Eight hours without the heater, twenty without fan and door, and the dehumidifier's last hours lost."""

    def cut(series: Series) -> Series:
        hours = (series.time - START_S) / HOUR_S
        holes = {
            "heater_power": (40.0, 48.0),
            "fan_duty": (50.0, 70.0),
            "door_open": (50.0, 70.0),
            "dehumidifier_duty": (80.0, np.inf),
        }
        first, last = holes.get(series.signal, (np.inf, np.inf))
        kept = (hours <= first) | (hours > last)
        return replace(series, time=series.time[kept], value=series.value[kept])

    return record.replace_series(*(cut(s) for s in record.series))


# -- online and offline --------------------------------------------------------------------------------------
@pytest.mark.parametrize(("with_holes", "late_s", "batch"), [(True, 0.0, 97), (False, 1700.0, 300)])
def test_a_tracked_cabinet_with_actuators_is_the_offline_filter_bit_for_bit(
    record: Record, with_holes: bool, late_s: float, batch: int
) -> None:
    model, shaped = planned(record), holed(record) if with_holes else record
    assert set(model.model.inputs) >= set(courses_of(np.zeros(1), 0))
    readings = arriving(readings_of(shaped), 1, late_s)
    tracker, half = Tracker(model), len(readings) // 2
    for first in range(0, len(readings), batch):
        tracker.take(readings[first : first + batch])
        course = tracker.advance() or tracker
        if first < half <= first + batch:  # restarted halfway
            tracker = Tracker(model, tracker.point, tracker.readings())
    offline = offline_course(model, shaped)
    assert tracker.newest - tracker.point.time < LATENESS_S + HOUR_S
    expect_state(tracker.point, offline)
    assert np.array_equal(course.trace.mean[-1], offline.trace.mean[-1])


def test_an_unknown_actuator_takes_its_mean_of_the_identified_record(record: Record) -> None:
    model, shaped = planned(record), holed(record)
    run = offline_course(model, shaped).run.timeline
    hours = (run.seconds - START_S) / HOUR_S
    for name, (first, last) in {"heater_power": (40.2, 47.8), "fan_duty": (50.2, 69.8)}.items():
        inside = (hours > first) & (hours < last)
        assert run.input(name)[inside] == pytest.approx(record[name].value.mean(), rel=1e-12)
    # a short gap is bridged by the last value
    last_value = record["dehumidifier_duty"].value[hours_of(record) <= 80.0][-1]
    assert np.all(run.input("dehumidifier_duty")[(hours > 80.2) & (hours < 85.9)] == last_value)
    # a design without means: what is unknown is off
    old = replace(model.design, actuator_means={})
    before = plan(Fit("old", old, dict(model.values)), wandering={}, forms=model.forms)
    assert set(before.design.actuator_means.values()) == {0.0}
    stored = model.design.to_json()
    assert Design.from_json(stored).actuator_means == model.design.actuator_means


def hours_of(record: Record) -> np.ndarray:
    return (record["active_power"].time - START_S) / HOUR_S


def test_a_tracker_waits_for_every_actuator_of_its_model(record: Record) -> None:
    tracker = Tracker(planned(record))
    readings = readings_of(record)[:1500]
    tracker.take(one for one in readings if one.signal not in ("heater_power", "door_open"))
    assert tracker.awaited() == ("door_open", "heater_power") and tracker.advance() is None
    tracker.take(one for one in readings if one.signal in ("heater_power", "door_open"))
    assert tracker.awaited() == () and tracker.advance() is not None


def through_a_service(record: Record, turbine: Turbine, folder: Path) -> None:
    """Play a record into a store, and hold the store against the offline filter."""
    url = f"sqlite:{folder / 'live.db'}"
    stream = Playback("replay:", record_messages(record, "T1"), record_mapping(record, "T1"), 0.0)
    Service({"T1": turbine}, [stream], url).run(until_ended=True)
    expect_offline(url, record, turbine)
    store = open_store(url, read_only=True)
    stored = {name for (name,) in queried(store, "SELECT DISTINCT signal FROM observation")}
    store.close()
    assert stored == set(record.signals)


def test_actuators_from_a_source_into_the_store_are_the_offline_filter(
    record: Record, tmp_path: Path
) -> None:
    through_a_service(record, Turbine(planned(record)), tmp_path)


@pytest.mark.slow
def test_an_identified_cabinet_with_a_heater_and_a_drier_is_tracked_as_offline(tmp_path: Path) -> None:
    """A plant of another make, identified on 40 days; the heater's effect is known with its error."""
    whole, _, made = actuated(41003, "heater_duty", "dehumidifier_duty", days=45.0)
    until_s = whole.start_s + 40.0 * DAY_S
    fit = identify(replace(whole.window(whole.start_s, until_s), until_s=None), starts=1, profiles=False)
    forms = {s.signal: SignalReporting(s.hold, s.interval_s, s.resolution, s.accuracy) for s in whole.series}
    one = turbine_of(
        fit, plan(fit, forms=forms, site=whole.site, rated_power_W=whole.rated_power_W, lateness_s=LATENESS_S)
    )
    true_K = PLANT_HEATER_W * made.cabinet.outer_resistance
    found = {heater.signal: one.plan.values[heater.parameter] for heater in heaters(one.plan.model)}
    assert found["heater_duty"] == pytest.approx(true_K, abs=4.0 * one.heating_sd_K)
    assert 0.0 < one.heating_sd_K < 0.3 * true_K
    through_a_service(whole.window(until_s, whole.end_s), one, tmp_path)


# -- ahead ---------------------------------------------------------------------------------------------------
def later_record() -> Record:
    """Two weeks in which the heater runs at standstill alone, and the fan with the power."""
    plain = cabinet_record(DAYS)
    still = plain["active_power"].value <= 0.0
    return acting(
        plain,
        heater_power=np.where(still, HEATER_W, 0.0),
        fan_duty=np.where(still, 0.0, 0.5),
        door_open=np.zeros(len(still)),
    )


def test_actuators_act_as_on_the_day_whose_operation_is_taken() -> None:
    record = later_record()
    hour = np.mod(record["active_power"].time - 1.0, DAY_S) / HOUR_S
    runs = (hour > 6.0) & (hour <= 18.0)
    daily = changed(record, "active_power", np.where(runs, 0.5 * RATED_W, -5e3))
    daily = changed(daily, "heater_power", np.where(runs, 0.0, HEATER_W))
    daily = changed(daily, "fan_duty", np.where(runs, 0.5, 0.0))
    for now_s in (NOW_S, NOW_S - 0.5 * DAY_S):  # at standstill, and in operation
        found = persistence(daily, now_s, ("heater_power", "fan_duty", "door_open"))
        for member in found.members:
            still = member["active_power"] <= 0.0
            assert still.any() and not still.all()
            assert np.array_equal(member["heater_power"] > 0.0, still)
            assert np.array_equal(member["fan_duty"] > 0.0, ~still)


def test_actuators_go_on_as_now_through_an_unprecedented_standstill() -> None:
    record = changed(later_record(), "active_power", 0.5 * RATED_W)
    record = changed(record, "heater_power", 0.0)
    stands = changed(record, "active_power", -5e3, NOW_S - 5 * HOUR_S)
    # a thermostat: two thirds of the time
    switching = np.where(np.arange(len(record["heater_power"])) % 3 > 0, HEATER_W, 0.0)
    stands = changed(stands, "heater_power", switching, NOW_S - 5 * HOUR_S)
    found = persistence(stands, NOW_S, ("heater_power",))
    ahead = found.time_s > NOW_S
    assert (np.array([m["active_power"][ahead] for m in found.members]) <= 0.0).any()
    for member in found.members:
        still = ahead & (member["active_power"] <= 0.0)
        assert member["heater_power"][still] == pytest.approx(HEATER_W * 2 / 3, rel=0.02)
        assert not member["heater_power"][ahead & ~still].any()
    # before now they are the readings
    past = (found.time_s <= NOW_S - 600.0) & (found.time_s > NOW_S - 3 * HOUR_S)
    seen = found.members[0]["heater_power"][past]
    assert set(seen) <= {0.0, HEATER_W}


def test_pre_heating_switches_the_heater_on_and_closes_the_door() -> None:
    record = changed(later_record(), "door_open", 1.0, NOW_S - HOUR_S)
    found = persistence(record, NOW_S, ("heater_power", "door_open")).with_preheating(
        25.0, {"heater_power": HEATER_W}
    )
    after = found.time_s > NOW_S + 1.0
    for member in found.members:
        assert np.all(member["heater_power"][after] == HEATER_W) and not member["door_open"][after].any()
        assert member["door_open"][~after][-1] == 1.0


# -- the advice ----------------------------------------------------------------------------------------------
STEADY_HUMIDITY = 0.74


def cabinet(signal: str, preheating: bool = False, **given: float) -> Plan:
    """The plan of a cabinet with a logged heater that gives 9 K at full power."""
    plain = cabinet_record(DAYS)
    plain = plain if preheating else without(plain, "preheating")
    full = HEATER_W if signal == "heater_power" else 1.0
    on = np.where(hours_of(plain) % 11.0 < 3.0, full, 0.0)
    record = acting(plain, **{signal: on})
    base = design(record)
    values = {p.name: p.start for p in base.model.parameters} | STANDING | {"logged_heater_heat": 9.0} | given
    return live_plan(Fit("cabinet", base, values), record, wandering={})


def advised(one: Plan, sd_K: float = 0.0):
    """The advice of a cabinet that has stood still for twenty days in steady weather."""
    state, ahead = standstill(one, STEADY_HUMIDITY, NOW_S, *heating(one).signals)
    return restart(one, state, ahead, COLD, 0.6, sd_K), forecast(one, state, ahead, COLD)


@pytest.mark.parametrize("signal", ["heater_power", "heater_duty"])
def test_the_advice_uses_the_heater_and_its_identified_effect(signal: str) -> None:
    one = cabinet(signal)
    (heater,) = heaters(one.model)
    assert (heater.signal, heater.full) == (signal, HEATER_W if signal == "heater_power" else 1.0)
    advice, idle = advised(one)
    assert heating(one).effect_K == 9.0 and heating(one).bounds_K == (9.0, 9.0)
    assert 0.5 < advice.hours < LONGEST_HEATING_H and advice.probability >= 0.95
    # the air settles 9 K warmer than without; a heater of 12 K needs less time, one of 3 K never gets there
    assert idle.condition.surface_humidity.value[-1] > 0.6
    stronger, _ = advised(cabinet(signal, logged_heater_heat=12.0))
    weaker, _ = advised(cabinet(signal, logged_heater_heat=3.0))
    assert 0.0 < stronger.hours < advice.hours and weaker.hours is None


def test_a_heater_is_worth_as_much_as_a_pre_heating_of_the_same_effect() -> None:
    both = cabinet("heater_duty", preheating=True, logged_heater_heat=4.0, preheating_heat=5.0)
    assert heating(both).signals == {"preheating": 1.0, "heater_duty": 1.0}
    advice, single = advised(both)[0], advised(cabinet("heater_duty"))[0]
    assert heating(both).effect_K == 9.0
    assert advice.hours == pytest.approx(single.hours, abs=1e-9)
    assert advice.probability == pytest.approx(single.probability, abs=0.01)


def test_an_uncertain_effect_makes_the_advice_longer_and_states_its_bounds() -> None:
    one = cabinet("heater_duty")
    sure, unsure = advised(one)[0], advised(one, sd_K=0.8)[0]
    lower, upper = heating(one, 0.8).bounds_K
    assert (lower, upper) == pytest.approx((9.0 - 1.96 * 0.8, 9.0 + 1.96 * 0.8), abs=1e-3)
    strong, weak = (advised(cabinet("heater_duty", logged_heater_heat=k))[0].hours for k in (upper, lower))
    assert strong < sure.hours < unsure.hours <= weak
    for number in ("9.0 K", f"{lower:.1f} to {upper:.1f} K", f"{strong:.1f} to {weak:.1f} h"):
        assert number in unsure.statement.text
    # an effect that may be none at all: the bound of the heater is zero, and no time is long enough
    doubtful = advised(one, sd_K=9.0)[0]
    assert doubtful.hours is None and "within 0.0 to " in doubtful.statement.text
    assert "to more than 24 h are needed" in doubtful.statement.text


def test_what_does_not_heat_is_no_advice() -> None:
    cooling = cabinet("heater_duty", preheating=True, logged_heater_heat=0.0, preheating_heat=-3.0)
    advice, _ = advised(cooling)
    assert advice.hours is None and advice.statement.values["effect_K"] == -3.0
