"""Proportional controllers, by readings and in simulations that drive their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders.switch_case import HOUR, heated, weather
from plants.as_record import to_record
from plants.plant import plant

from hygrokf.data.record import Record
from hygrokf.estimation.likelihood import Gaussian, Likelihood
from hygrokf.evaluation.self_switching import self_switched, switches_of
from hygrokf.evaluation.simulation import forecasts, free_run
from hygrokf.modelling.design import Design, design, extended, merged
from hygrokf.modelling.inputs import model_inputs
from hygrokf.physics.switches import Throttle


def by_hand(
    record: Record, values: dict[str, float], base: Design, every_h: float = 1.0 / 60.0
) -> np.ndarray:
    """The heated cabinet by plain Euler steps of a minute, at the record's instants [K]."""
    series = record["ambient_temperature"]
    p, share = values, []
    converter = None
    for k in range(len(series.time)):
        stop = series.time[k]
        now = stop if k == 0 else series.time[k - 1]
        idle = (record["active_power"].value[k]) <= 0.0
        relative = record["active_power"].value[k] / 2e6
        while True:
            ambient = float(np.interp(now, series.time, series.value))
            if converter is None:
                mean, _ = base.model.initial(values, {"ambient_temperature": ambient})
                converter = mean[0]
            cabinet = p["resistance_ratio"] * converter + (1.0 - p["resistance_ratio"]) * ambient
            if now >= stop:
                break
            duty = idle * min(max((288.15 - cabinet) / 3.0, 0.0), 1.0)
            warm = ambient - 283.15
            heat = (
                p["heat_release_operation"] + p["heat_release_power_1"] * relative
                + p["heat_release_operation_ambient"] * warm
                if not idle else p["heat_release_standstill"] + p["heat_release_standstill_ambient"] * warm
            ) + p["heater_heat"] * duty  # fmt: skip
            rate = (ambient - converter + heat / p["resistance_ratio"]) / p["thermal_time_constant"]
            converter += rate * every_h
            now += every_h * HOUR
        share.append(cabinet)
    return np.array(share)


def test_a_simulation_drives_its_own_heater() -> None:
    """Against Euler steps of a minute by hand.

    The readings of the record stand at 295 K, where the heater would never act: they must not count.  In
    operation it is off.
    """
    record = weather()
    base, values = heated(record)
    made = model_inputs(base, record)
    assert made.timeline.input("throttled_heating").max() == 0.0
    found = free_run(base, values, made).temperature[0]
    own = self_switched(base, values, [made])[0]
    duty = own.timeline.input("throttled_heating")
    idle = ~made.operating
    assert 0.05 < duty[idle].mean() < 0.95 and duty[~idle].max() == 0.0
    assert ((duty >= 0.0) & (duty <= 1.0)).all()
    seconds = made.timeline.origin_s + HOUR * made.timeline.time
    expected = np.interp(seconds, record["ambient_temperature"].time, by_hand(record, values, base))
    late = idle & (made.timeline.time > 12.0)
    assert np.abs(found[late] - expected[late]).max() < 0.2
    assert 285.15 < found[late].min() < found[late].max() < 288.15
    # what is fed back is the course, and the simulation with it has the heater's temperatures at the steps
    again = self_switched(base, values, [own])[0]
    np.testing.assert_array_equal(again.timeline.input("throttled_heating"), duty)
    without = free_run(base, {**values, "heater_heat": 0.0}, made).temperature[0]
    assert without[late].min() < 281.0


def test_readings_of_the_cabinet_change_nothing_in_a_simulation() -> None:
    """A record without the cabinet gives the same course, and so do readings that would have switched
    otherwise."""
    record, blind = weather(), weather(cabinet=False)
    base, values = heated(record)
    with_readings = free_run(base, values, model_inputs(base, record)).temperature[0]
    without = free_run(base, values, model_inputs(base, blind)).temperature[0]
    np.testing.assert_allclose(with_readings, without, atol=1e-9)
    cold = record.replace_series(
        replace(record["cabinet_temperature"], value=np.full(len(record["cabinet_temperature"].time), 270.0))
    )
    np.testing.assert_allclose(
        free_run(base, values, model_inputs(base, cold)).temperature[0], without, atol=1e-9
    )


def test_a_record_that_lacks_the_reading_alone_is_told() -> None:
    record = weather()
    base, _ = heated(record)
    moist = replace(
        weather(cabinet=False),
        series=(*weather(cabinet=False).series,
            replace(record["cabinet_temperature"], signal="cabinet_relative_humidity",
                value=np.full(len(record["cabinet_temperature"].time), 0.5))),
    )  # fmt: skip
    with pytest.raises(ValueError, match="switches by cabinet_temperature, which the record does not have"):
        model_inputs(base, moist)


def test_runs_side_by_side_are_each_their_own() -> None:
    """Windows of different lengths, begun from states of their own, as one by one."""
    record = weather()
    base, values = heated(record)
    made = model_inputs(base, record)
    t = made.timeline
    trace = Likelihood(base.model, t).trace(values)
    pieces, states = [], []
    for first, last in ((50, 90), (200, 260), (580, 700)):
        pieces.append(made.window(first + 1, last))
        states.append(Gaussian(trace.mean[first], trace.covariance[first]))
    together = self_switched(base, values, pieces, states)
    for one, state, found in zip(pieces, states, together, strict=True):
        alone = self_switched(base, values, [one], [state])[0]
        np.testing.assert_allclose(
            found.timeline.input("throttled_heating"), alone.timeline.input("throttled_heating"), atol=1e-12
        )
        assert len(found.timeline) == len(one.timeline)


def test_forecasts_do_not_know_the_readings_that_come() -> None:
    """Readings after the start of a forecast change what it is compared with, and not the forecast."""
    record = weather()
    base, values = heated(record)
    made = model_inputs(base, record)
    middle = len(made.timeline) // 3
    late = made.timeline.time > made.timeline.time[middle] + 1e-6
    hot = made.timeline.u.copy()
    hot[1:, made.timeline.varying.index("throttled_heating")][late] = 1.0
    other = replace(made, timeline=replace(made.timeline, u=hot))
    plain, told = (forecasts(base, values, one, middle, (1.0,), count=1) for one in (made, other))
    assert plain[1.0]["temperature_K"][1] == pytest.approx(told[1.0]["temperature_K"][1], abs=1e-12)


def test_a_model_without_switches_is_left_alone() -> None:
    record = to_record(plant(77, days=8.0))
    base = design(record, kind="thermal")
    made = model_inputs(base, record)
    assert self_switched(base, {}, [made]) == [made] and not switches_of(base)


def test_a_switch_whose_reading_the_model_does_not_foretell_stays_with_the_readings() -> None:
    """The thermal part of a cascade knows no humidity: a humidistat follows the readings there, the joint
    model's its own."""
    record = to_record(plant(77, days=8.0))
    features = {"throttled_heating": {"reads": "cabinet_relative_humidity", "start": 0.6, "full": 0.7}}
    thermal = extended(design(record, kind="thermal"), (("unreported_heater", {}),), features=features)
    assert not switches_of(thermal)
    joint = merged((thermal, design(record, kind="cascade")))
    assert list(switches_of(joint)) == ["throttled_heating"]


def test_a_throttle_follows_its_reading_within_its_band() -> None:
    opening = Throttle("cabinet_temperature", 290.0, 294.0)
    value = np.array([np.nan, 288.0, 291.0, np.nan, 293.0, 299.0])
    np.testing.assert_allclose(opening.course(value, np.zeros(6, bool)), [0.0, 0.0, 0.25, 0.25, 0.75, 1.0])
    heating = Throttle("cabinet_temperature", 290.0, 286.0)
    np.testing.assert_allclose(heating.at(np.array([292.0, 289.0, 280.0]), False), [0.0, 0.25, 1.0])


def test_a_throttle_of_the_standstill_is_closed_in_operation() -> None:
    one = Throttle("cabinet_temperature", 290.0, 286.0, idle=True)
    idle = np.array([True, False])
    assert one.at(np.array([287.0, 287.0]), idle).tolist() == [0.75, 0.0]
    assert one.course(np.array([287.0, 287.0]), idle).tolist() == [0.75, 0.0]


def test_a_heater_in_any_state_holds_its_cabinet() -> None:
    """In operation too, where the one of the standstill is off: within its band."""
    record = weather()
    _, values = heated(record)
    features = {"throttled_heating": {"reads": "cabinet_temperature", "start": 296.0, "full": 292.0}}
    wider = extended(
        design(weather(), kind="thermal", power_order=1), (("unreported_heater", {}),), features=features
    )
    made = model_inputs(wider, record)
    own = self_switched(wider, values, [made])[0]
    duty = own.timeline.input("throttled_heating")
    late = made.timeline.time > 24.0
    assert duty[late & made.operating].mean() > 0.02 and 0.0 <= duty.min() <= duty.max() <= 1.0
    found = free_run(wider, values, made).temperature[0]
    cold = free_run(wider, {**values, "heater_heat": 0.0}, made).temperature[0]
    assert found[late].min() > cold[late].min() + 2.0
    inside = late & (duty > 0.05) & (duty < 0.95)
    expected = (296.0 - found[inside]) / 4.0
    # the mean of a step's duty belongs to temperatures within the step
    assert inside.sum() > 20 and np.abs(duty[inside] - expected).mean() < 0.1
