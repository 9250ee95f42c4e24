"""From a record to instants: every hold, gap and clock against its definition, written here once more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from hygrokf.data.record import Record, Series
from hygrokf.modelling.design import Design, design, extended
from hygrokf.modelling.inputs import model_inputs
from hygrokf.modelling.library import LIBRARY
from hygrokf.physics.model import Mechanism
from hygrokf.physics.psychrometrics import absolute_humidity

START_S = 1.6e9
HOUR_S = 3600.0
RATED_W = 2.0e6


def weather(time: np.ndarray) -> np.ndarray:
    """Ambient temperature [K] at any time."""
    hours = (time - START_S) / HOUR_S
    return 283.0 + 5.0 * np.sin(2 * np.pi * hours / 24.0) + 1.5 * np.sin(hours / 1.7)


def instants(signal: str, value, *, step_s: float, hours: float, offset_s: float = 0.0, **more) -> Series:
    time = START_S + offset_s + np.arange(0.0, hours * HOUR_S + 1e-6, step_s)
    return Series(signal, time, value(time) if callable(value) else np.full(len(time), value), **more)


def means(signal: str, value, *, step_s: float, hours: float, offset_s: float = 0.0) -> Series:
    """Interval means with their stamps at the end, the first interval beginning at the offset."""
    series = instants(signal, value, step_s=step_s, hours=hours - step_s / HOUR_S, offset_s=offset_s + step_s)
    return replace(series, hold="mean", interval_s=step_s)


def power_course(time: np.ndarray) -> np.ndarray:
    """[W], below zero a quarter of the time."""
    return RATED_W * (0.45 * np.sin((time - START_S) / 7000.0) + 0.3)


def a_record(hours: float = 96.0, **series: Series | None) -> Record:
    """Three loggers with clocks of their own; `series` replaces or removes signals."""
    all_ = {
        "cabinet_temperature": instants(
            "cabinet_temperature", lambda t: weather(t) + 7.0, step_s=900, hours=hours - 1, offset_s=417.0
        ),
        "cabinet_relative_humidity": instants(
            "cabinet_relative_humidity",
            lambda t: 0.5 + 0.1 * np.sin(t / 9000),
            step_s=900,
            hours=hours - 1,
            offset_s=417.0,
        ),
        "ambient_temperature": instants(
            "ambient_temperature", weather, step_s=600, hours=hours, offset_s=-60.0
        ),
        "ambient_relative_humidity": instants(
            "ambient_relative_humidity",
            lambda t: 0.7 + 0.1 * np.cos(t / 8000),
            step_s=600,
            hours=hours,
            offset_s=-60.0,
        ),
        "active_power": means("active_power", power_course, step_s=600, hours=hours, offset_s=-180.0),
    }
    all_.update(series)
    return Record("made", tuple(s for s in all_.values() if s is not None), rated_power_W=RATED_W)


def seconds(made) -> np.ndarray:
    return made.timeline.origin_s + made.timeline.time * HOUR_S


def at(made, when: float) -> int:
    """Position of the instant at a time [s]."""
    found = int(np.argmin(np.abs(seconds(made) - when)))
    assert abs(seconds(made)[found] - when) < 1e-3
    return found


def blanked(series: Series, first_h: float, last_h: float) -> Series:
    """The series without values between two times [h] since the start, both excluded."""
    hours = (series.time - START_S) / HOUR_S
    return replace(series, value=np.where((hours > first_h) & (hours < last_h), np.nan, series.value))


def cut(series: Series, first_h: float, last_h: float) -> Series:
    """The series without rows between two times [h] since the start, both excluded."""
    hours = (series.time - START_S) / HOUR_S
    kept = ~((hours > first_h) & (hours < last_h))
    return replace(series, time=series.time[kept], value=series.value[kept])


@pytest.fixture(scope="module")
def record() -> Record:
    return a_record()


@pytest.fixture(scope="module")
def base(record) -> Design:
    return design(record)


@pytest.fixture(scope="module")
def made(base, record):
    return model_inputs(base, record)


# --- holds ----------------------------------------------------------------------------------


def test_the_run_spans_the_cabinets_readings(made, record):
    cabinet = record["cabinet_temperature"]
    assert seconds(made)[0] == pytest.approx(cabinet.time[0], abs=1e-5)
    assert seconds(made)[-1] == pytest.approx(cabinet.time[-1], abs=1e-5)
    assert np.all(np.diff(made.timeline.time) > 0)


def test_ambient_instants_run_straight_between_their_readings(made, record):
    ambient = record["ambient_temperature"]
    expected = np.interp(seconds(made), ambient.time, ambient.value)
    assert_allclose(made.timeline.input("ambient_temperature"), expected, atol=1e-6)
    assert_allclose(made.timeline.input("exchange_factor"), expected**0.8 / 273.0**1.8, rtol=1e-9)


def test_ambient_humidity_is_computed_where_it_was_read(made, record):
    """c_amb [g/m³] comes from each humidity reading and the temperature of that time, then runs straight."""
    moist, warm = record["ambient_relative_humidity"], record["ambient_temperature"]
    there = 1e3 * absolute_humidity(moist.value, np.interp(moist.time, warm.time, warm.value))
    found = made.timeline.input("ambient_absolute_humidity")
    assert_allclose(found, np.interp(seconds(made), moist.time, there), atol=1e-6)
    assert 5.0 < found.mean() < 9.0


def test_power_holds_over_its_interval(made, base, record):
    """Each step lies in one interval (end − 10 min, end] and takes that interval's mean."""
    power = record["active_power"]
    time = seconds(made)
    middle = 0.5 * (time[1:] + time[:-1])
    interval = np.array(
        [np.flatnonzero((power.time - 600.0 < m) & (m <= power.time))[0] for m in middle], dtype=int
    )
    # a power column that nothing else than zero-order would survive: neighbours differ
    assert np.mean(np.diff(power.value) != 0) > 0.9
    p = power.value[interval] / RATED_W
    running = p > 0
    assert 0.1 < running.mean() < 0.9
    assert_allclose(made.timeline.input("operating")[1:], running)
    assert_allclose(made.timeline.input("power_1")[1:], np.where(running, p, 0.0), atol=1e-12)
    assert_allclose(made.timeline.input("power_2")[1:], np.where(running, p, 0.0) ** 2, atol=1e-12)
    assert_array_equal(made.operating[1:], running)
    assert base.power_scale_W == RATED_W


def test_power_read_at_instants_gives_the_mean_of_its_course():
    """Instants are joined by straight lines; over any stretch the held steps have the line's integral."""
    read = instants("active_power", lambda t: 0.5 * RATED_W * (1.3 + np.sin(t / 5000)), step_s=720, hours=96)
    record = a_record(active_power=read)
    made = model_inputs(design(record), record)
    time = seconds(made)
    fine = np.linspace(time[0], time[-1], 400_001)
    exact = np.trapezoid(np.interp(fine, read.time, read.value) / RATED_W, fine)
    held = np.sum(made.timeline.input("power_1")[1:] * np.diff(time))
    assert held == pytest.approx(exact, rel=1e-6)
    # and not the value at the end of each step, which runs ahead by half a step
    late = np.sum(np.interp(time[1:], read.time, read.value) / RATED_W * np.diff(time))
    assert abs(late - exact) > 10 * abs(held - exact)


def test_ambient_means_give_the_path_that_keeps_them():
    """Held at its end an hourly mean would come half an hour late; joined at its middle it would be smoothed
    twice."""

    def hourly(time: np.ndarray) -> np.ndarray:
        inside = time[:, None] - np.linspace(0.0, HOUR_S, 241)[None, :]
        return np.trapezoid(weather(inside), dx=1 / 240, axis=1)

    read = means("ambient_temperature", hourly, step_s=3600, hours=97, offset_s=-1800.0)
    record = a_record(ambient_temperature=read)
    made = model_inputs(design(record), record)
    time = seconds(made)
    found = made.timeline.input("ambient_temperature")
    error = [np.std(found - weather(time - lag)) for lag in (0.0, -1800.0, 1800.0)]
    assert error[0] < 0.15 < min(error[1:])
    joined = np.interp(time, read.time - 1800.0, read.value)
    assert error[0] < 0.9 * np.std(joined - weather(time))


def test_preheating_holds_over_its_interval_and_unwritten_duty_is_none(record):
    duty = means(
        "preheating",
        lambda t: (np.abs(t - START_S - 30 * HOUR_S) < 2 * HOUR_S).astype(float),
        step_s=600,
        hours=96,
    )
    unwritten = replace(duty, value=np.where(duty.time > START_S + 60 * HOUR_S, np.nan, duty.value))
    heated = replace(record, series=(*record.series, unwritten))
    base = design(heated)
    made = model_inputs(base, heated)
    values, time = made.timeline.input("preheating"), seconds(made)
    on = time[values > 0]
    assert on.min() > START_S + 28 * HOUR_S
    assert on.max() <= START_S + 32 * HOUR_S + 1e-3
    assert np.all(values[time > START_S + 61 * HOUR_S] == 0.0)
    plain = model_inputs(base, record)  # a record that knows no pre-heating has none
    assert np.all(plain.timeline.input("preheating") == 0.0)


def test_further_signals_bring_their_own_instants(base, record):
    """A mechanism that reads another signal gets it by its hold, with every corner of its course in the
    run."""

    def windy() -> Mechanism:
        return Mechanism(
            name="windy",
            inputs=("wind_speed",),
            contributions=lambda p, x, u, q: {"heat_release": 0.0 * u.wind_speed},
        )

    base = replace(base, library=LIBRARY.with_mechanisms(windy))
    wind = instants("wind_speed", lambda t: 8 + 3 * np.sin(t / 3000), step_s=420, hours=96, offset_s=11.0)
    windy_record = replace(record, series=(*record.series, wind))
    made = model_inputs(extended(base, [("windy", {})], {"wind_speed": "linear"}), windy_record)
    time = seconds(made)
    inside = (wind.time >= time[0]) & (wind.time <= time[-1])
    near = time[np.clip(np.searchsorted(time, wind.time[inside]), 0, len(time) - 1)]
    assert_allclose(near, wind.time[inside], atol=1e-3)
    assert_allclose(made.timeline.input("wind_speed"), np.interp(time, wind.time, wind.value), atol=1e-6)
    with pytest.raises(
        ValueError, match=r"reads wind_speed, which the record does not have \(it has cabinet_"
    ):
        model_inputs(extended(base, [("windy", {})], {"wind_speed": "linear"}), record)


# --- interval means of the cabinet ----------------------------------------------------------


def averaged_record(time_end: np.ndarray, interval_s: float, value: np.ndarray | None = None) -> Record:
    value = weather(time_end) + 7.0 if value is None else value
    series = Series("cabinet_temperature", time_end, value, "mean", interval_s)
    return a_record(cabinet_temperature=series, cabinet_relative_humidity=None)


def reset_times(made, output: str = "cabinet_temperature") -> np.ndarray:
    bit = list(made.timeline.outputs).index(output)
    return seconds(made)[(made.timeline.reset >> bit) & 1 == 1]


def test_interval_means_stand_at_their_end_and_begin_anew_at_their_start():
    end = (
        START_S + 300.0 + 900.0 * np.arange(0, 200)
    )  # the first interval began ten minutes before the weather
    record = averaged_record(end, 900.0)
    base = design(record)
    assert base.averaged == {"cabinet_temperature": 0.25}
    made = model_inputs(base, record)
    reading, time = made.timeline.reading("cabinet_temperature"), seconds(made)
    assert np.isnan(reading[at(made, end[0])])
    for k in (1, 2, 77, 199):
        assert reading[at(made, end[k])] == record["cabinet_temperature"].value[k]
    assert np.isfinite(reading).sum() == 199
    assert_allclose(reset_times(made), end[1:] - 900.0, atol=1e-3)
    assert time[0] == pytest.approx(record["ambient_temperature"].time[0], abs=1e-5)


def test_a_reading_that_was_missed_leaves_its_interval_to_nobody():
    end = START_S + 1500.0 + 900.0 * np.arange(0, 200)
    kept = np.delete(end, [50, 51, 120])
    record = averaged_record(kept, 900.0)
    made = model_inputs(design(record), record)
    assert_allclose(reset_times(made), kept - 900.0, atol=1e-3)
    assert made.timeline.n_readings == len(kept)


def test_of_overlapping_means_the_later_ones_are_left_out():
    """A moving average over an hour every ten minutes: one in six is an independent reading, and only it is
    taken."""
    end = START_S + 4200.0 + 600.0 * np.arange(0, 300)
    record = averaged_record(end, 3600.0)
    made = model_inputs(design(record), record)
    taken = seconds(made)[np.isfinite(made.timeline.reading("cabinet_temperature"))]
    assert_allclose(taken, end[::6], atol=1e-3)
    assert_allclose(reset_times(made), end[::6] - 3600.0, atol=1e-3)


def test_a_clock_that_jitters_never_cuts_an_interval_in_two():
    random = np.random.default_rng(5)
    end = START_S + 1500.0 + 600.0 * np.arange(0, 300) + np.round(random.uniform(-4, 4, 300))
    record = averaged_record(end, 600.0)
    made = model_inputs(design(record), record)
    taken = seconds(made)[np.isfinite(made.timeline.reading("cabinet_temperature"))]
    assert len(taken) > 140
    resets = reset_times(made)
    for stamp in taken:  # between a reading's start and its end no other interval begins
        inside = resets[(resets > stamp - 600.0 + 1e-3) & (resets < stamp - 1e-3)]
        assert len(inside) == 0
        assert np.min(np.abs(resets - (stamp - 600.0))) < 1e-3


def test_rounding_of_stamps_is_no_overlap():
    """Stamps with fractions of a second: end − interval differs from the end before by the last bit only."""
    end = START_S + 1500.0 + 700.0 * np.arange(0, 200)
    end[::2] += 5e-7
    assert 90 < np.sum(end[1:] - 700.0 < end[:-1]) < 110
    record = averaged_record(end, 700.0)
    made = model_inputs(design(record), record)
    assert made.timeline.n_readings == 200
    time, bit = seconds(made), (made.timeline.reset & 1) == 1
    for stamp in end[:-1]:
        here = np.flatnonzero(np.abs(time - stamp) < 1e-3)
        first_reset = here[bit[here]]
        read = here[np.isfinite(made.timeline.reading("cabinet_temperature")[here])]
        assert len(first_reset) == 1
        assert read[0] <= first_reset[0]  # the mean is read before the next one begins


def test_a_design_for_means_refuses_instants_and_the_other_way_round(base, record):
    end = START_S + 1500.0 + 900.0 * np.arange(0, 200)
    other = averaged_record(end, 900.0)
    with pytest.raises(ValueError, match="the design reads means over 0 s, the record has 900 s"):
        model_inputs(base, other)
    with pytest.raises(ValueError, match=r"means over 900 s, the record has 0 s.*read_as"):
        model_inputs(design(other), record)


# --- gaps -----------------------------------------------------------------------------------


@pytest.mark.parametrize("remove", [blanked, cut])
def test_short_gaps_of_the_power_are_bridged_by_the_value_before_them(base, record, remove):
    power = record["active_power"]
    end = power.time[300]
    gap = remove(power, (end - START_S) / HOUR_S + 1e-6, (end - START_S) / HOUR_S + 1.0 + 1e-6)
    holed = record.replace_series(gap)
    assert np.isfinite(gap.value).sum() == np.isfinite(power.value).sum() - 6  # six means: one hour
    made = model_inputs(base, holed)
    time = seconds(made)
    inside = (time > end + 1.0) & (time < end + HOUR_S + 1.0)
    assert inside.sum() > 5
    before = max(power.value[300] / RATED_W, 0.0)
    assert_allclose(made.timeline.input("power_1")[inside], before)
    assert made.scored.all()


@pytest.mark.parametrize("remove", [blanked, cut])
def test_long_gaps_of_the_power_are_unknown_and_not_zero(record, remove):
    power = record["active_power"]
    begin, end = power.time[200], power.time[200] + 10 * HOUR_S
    holed = record.replace_series(
        remove(power, (begin - START_S) / HOUR_S + 1e-6, (end - START_S) / HOUR_S + 1e-6)
    )
    base = design(holed)
    made = model_inputs(base, holed)
    time = seconds(made)
    unknown = (time > begin + 1.0) & (time < end + 1.0)
    assert unknown.sum() > 30
    known = holed["active_power"].value
    p = known[np.isfinite(known)] / RATED_W
    running = (p > 0).astype(float)
    assert_allclose(made.timeline.input("operating")[unknown], running.mean())
    assert_allclose(made.timeline.input("power_1")[unknown], (running * p).mean())
    assert_allclose(made.timeline.input("power_2")[unknown], (running * p**2).mean())
    assert_array_equal(made.timeline.input("power_unknown") == 1.0, unknown)
    assert not made.operating[unknown].any()
    # readings are kept: the filter goes on with an honest spread
    read = np.isfinite(made.timeline.reading("cabinet_temperature"))
    assert read[unknown].sum() == pytest.approx(40, abs=1)
    # but scores leave the stretch out
    assert_array_equal(made.scored, ~unknown)


def test_a_gap_unforeseen_by_the_design_takes_the_mean_all_the_same(base, record):
    """A design from a record without gaps has no regime for them: the mean stands in, and nothing is
    scored."""
    assert "power_unknown" not in base.model.inputs
    made = model_inputs(base, record.replace_series(blanked(record["active_power"], 40.0, 60.0)))
    time = seconds(made) - START_S
    inside = (time > 41 * HOUR_S) & (time < 59 * HOUR_S)
    assert_allclose(made.timeline.input("operating")[inside], base.power_mean[0])
    assert not made.scored[inside].any()


def test_gaps_of_the_ambient_up_to_six_hours_are_straight(base, record):
    warm = record["ambient_temperature"]
    hole = cut(warm, 30.0, 35.7)
    holed = record.replace_series(hole, cut(record["ambient_relative_humidity"], 30.0, 35.7))
    made = model_inputs(base, holed)
    assert made.scored.all()
    assert_allclose(
        made.timeline.input("ambient_temperature"),
        np.interp(seconds(made), hole.time, hole.value),
        atol=1e-6,
    )
    assert made.timeline.n_readings == model_inputs(base, record).timeline.n_readings


@pytest.mark.parametrize("remove", [blanked, cut])
@pytest.mark.parametrize("signal", ["ambient_temperature", "ambient_relative_humidity"])
def test_in_long_gaps_of_the_ambient_readings_are_left_out(base, record, remove, signal):
    hole = remove(record[signal], 30.0, 40.0)
    known = hole.time[~hole.missing]
    first, last = known[known <= START_S + 30 * HOUR_S][-1], known[known >= START_S + 40 * HOUR_S][0]
    made = model_inputs(base, record.replace_series(hole))
    time = seconds(made)
    # the step that ends at the first reading after the gap is unknown, too
    lost = (time > first + 1.0) & (time <= last + 1e-3)
    assert_array_equal(made.scored, ~lost)
    assert_array_equal(made.timeline.ends, np.arange(len(time)) == np.flatnonzero(lost)[-1] + 1)
    for name in ("cabinet_temperature", "cabinet_relative_humidity"):
        series = record[name]
        inside = (series.time > first) & (series.time <= last)
        read = np.isfinite(made.timeline.reading(name))
        assert read.sum() == len(series) - inside.sum()
        assert not read[lost].any()
    for name in ("ambient_temperature", "ambient_absolute_humidity"):
        assert np.isfinite(made.timeline.input(name)).all()


def test_a_gap_of_all_loggers_at_once_is_a_gap_too(base, record):
    """No instant lies inside; the step over the gap is what is unknown."""
    down = replace(record, series=tuple(cut(s, 30.0, 45.0) for s in record.series))
    made = model_inputs(base, down)
    time = seconds(made)
    assert not np.any((time > START_S + 30.3 * HOUR_S) & (time < START_S + 44.8 * HOUR_S))
    end = np.flatnonzero(made.timeline.ends)
    assert len(end) == 1 and time[end[0]] < START_S + 45.6 * HOUR_S
    assert not np.isfinite(made.timeline.y[end[0] - 1]).any()
    assert made.scored[end[0] :].all() and not made.scored[end[0] - 1]
    assert made.scored[
        time <= down["active_power"].time[down["active_power"].time < START_S + 31 * HOUR_S][-1]
    ].all()


def test_coarse_series_are_no_chain_of_gaps(record):
    """Power every two hours and weather every eight are poor, but known; one missing reading is a gap."""
    coarse = record.replace_series(
        instants("ambient_temperature", weather, step_s=8 * HOUR_S, hours=96),
        instants("ambient_relative_humidity", 0.7, step_s=8 * HOUR_S, hours=96),
        instants("active_power", power_course, step_s=2 * HOUR_S, hours=96),
    )
    base = design(coarse)
    assert "power_unknown" not in base.model.inputs
    assert model_inputs(base, coarse).scored.all()
    holed = coarse.replace_series(blanked(coarse["active_power"], 39.0, 41.0))
    assert "power_unknown" in design(holed).model.inputs
    assert not model_inputs(base, holed).scored.all()


# --- what is not there ----------------------------------------------------------------------


def test_without_power_all_of_it_counts_as_standstill(record):
    idle = replace(record, series=tuple(s for s in record.series if s.signal != "active_power"))
    base = design(idle)
    made = model_inputs(base, idle)
    assert not made.operating.any()
    assert made.scored.all()
    assert "operating" not in base.model.inputs


def test_a_design_that_knows_the_power_scores_nothing_without_it(base, record):
    idle = replace(record, series=tuple(s for s in record.series if s.signal != "active_power"))
    made = model_inputs(base, idle)
    assert not made.scored.any()
    assert_allclose(made.timeline.input("power_1"), base.power_mean[1])


def test_drivers_alone_run_over_the_span_of_the_ambient(base, record):
    alone = replace(record, series=tuple(s for s in record.series if not s.signal.startswith("cabinet")))
    made = model_inputs(base, alone)
    ambient = record["ambient_temperature"]
    assert seconds(made)[[0, -1]] == pytest.approx(ambient.time[[0, -1]], abs=1e-5)
    assert made.timeline.n_readings == 0


def test_series_with_other_spans(base, record):
    """The cabinet before and after the ambient: only what both cover is run; power may end early and is
    unknown."""
    late = {
        name: replace(record[name], time=record[name].time + 20 * HOUR_S)
        for name in ("ambient_temperature", "ambient_relative_humidity")
    }
    power = record["active_power"]
    short = replace(power, time=power.time[:300], value=power.value[:300])
    made = model_inputs(base, record.replace_series(*late.values(), short))
    time = seconds(made)
    cabinet = record["cabinet_temperature"]
    assert time[0] == pytest.approx(late["ambient_temperature"].time[0], abs=1e-5)
    assert time[-1] == pytest.approx(cabinet.time[-1], abs=1e-5)
    known = time <= short.time[-1] + HOUR_S + 1e-3
    assert_array_equal(made.scored, known)
    expected = (cabinet.time >= time[0] - 1e-3) & (cabinet.time <= time[-1] + 1e-3)
    assert np.isfinite(made.timeline.reading("cabinet_temperature")).sum() == expected.sum()


def test_nothing_in_common_is_said(base, record):
    cabinet = [replace(s, time=s.time + 1e6) for s in record.series if s.signal.startswith("cabinet")]
    with pytest.raises(
        ValueError, match="the cabinet's readings and the ambient series have no stretch of time"
    ):
        model_inputs(base, record.replace_series(*cabinet))
    blind = replace(record["ambient_temperature"], value=np.full(len(record["ambient_temperature"]), np.nan))
    with pytest.raises(ValueError, match="no reading of ambient_temperature, the ambient humidity can"):
        model_inputs(base, record.replace_series(blind))


def test_absolute_humidity_of_the_cabinet_is_read_in_grams(record):
    moist = instants("cabinet_absolute_humidity", 7.1e-3, step_s=900, hours=90, offset_s=417.0)
    series = [s for s in record.series if s.signal != "cabinet_relative_humidity"]
    other = replace(record, series=(*series, moist))
    made = model_inputs(design(other), other)
    read = made.timeline.reading("cabinet_absolute_humidity")
    assert_allclose(read[np.isfinite(read)], 7.1)


# --- every reading once, at its own time ----------------------------------------------------


@st.composite
def clocks(draw):
    """A cabinet logger with any step, offset, jitter and losses; weather and power with theirs."""
    step = draw(st.sampled_from([60.0, 300.0, 599.0, 600.0, 900.0, 1234.5, 3600.0]))
    offset = draw(st.floats(-3000.0, 3000.0).map(lambda v: round(v, 3)))
    seed = draw(st.integers(0, 10_000))
    jitter = draw(st.sampled_from([0.0, 1.0, 0.2 * step]))
    missing = draw(st.sampled_from([0.0, 0.1, 0.6]))
    interval = draw(st.booleans())
    return (
        step,
        offset,
        seed,
        jitter,
        missing,
        interval,
        draw(st.floats(-300.0, 300.0)),
        draw(st.floats(-500.0, 0.0)),
    )


@settings(max_examples=60)
@given(clocks())
def test_every_reading_appears_once_at_its_own_time(clock):
    step, offset, seed, jitter, missing, interval, ambient_offset, power_offset = clock
    random = np.random.default_rng(seed)
    count = int(60 * HOUR_S / step)
    time = START_S + offset + step * np.arange(1, count + 1) + random.uniform(0.0, jitter, count)
    value = 290.0 + random.normal(size=count)
    value[random.random(count) < missing] = np.nan
    humidity = np.where(random.random(count) < missing, np.nan, 0.5)
    length = 0.7 * step if interval and jitter <= 0.2 * step else 0.0
    hold = "mean" if length else "linear"
    record = a_record(
        hours=60,
        cabinet_temperature=Series("cabinet_temperature", time, value, hold, length),
        cabinet_relative_humidity=Series("cabinet_relative_humidity", time, humidity, hold, length),
        ambient_temperature=instants(
            "ambient_temperature", weather, step_s=600, hours=60, offset_s=ambient_offset
        ),
        active_power=means("active_power", power_course, step_s=600, hours=60, offset_s=power_offset),
    )
    made = model_inputs(design(record), record)
    warm, moist = (record[n].time for n in ("ambient_temperature", "ambient_relative_humidity"))
    moist = moist[(moist >= warm[0]) & (moist <= warm[-1])]  # a humidity counts where there is a temperature
    first, last = max(time[0] - length, moist[0], warm[0]), min(time[-1], moist[-1], warm[-1])
    inside = (time - length >= first) & (time <= last)
    for name, read in (("cabinet_temperature", value), ("cabinet_relative_humidity", humidity)):
        if np.isfinite(read).sum() < 50:
            continue  # too few for a model of the humidity
        expected = inside & np.isfinite(read)
        found = made.timeline.reading(name)
        there = np.isfinite(found)
        assert there.sum() == expected.sum()
        assert_allclose(seconds(made)[there], time[expected], atol=2e-5, rtol=0)
        assert_array_equal(found[there], read[expected])
