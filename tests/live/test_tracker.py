"""The tracker against the offline filter: bit for bit, whatever the order in which readings come."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from builders.tracker_case import LATENESS_S, arriving, planned, readings_of

from hygrokf.cases.case_file import read_case
from hygrokf.cases.synthetic import synthetic_turbine, write_case
from hygrokf.data.gate import REACH_S
from hygrokf.data.readings import SATURATED
from hygrokf.data.record import Record, Series
from hygrokf.live import tracker as tracker_module
from hygrokf.live.frozen import Frozen, frozen_runs
from hygrokf.live.plan import BEFORE, Plan
from hygrokf.live.sources.local import line_form
from hygrokf.live.traces import censored_trace
from hygrokf.live.tracker import NEITHER, Reading, Tracker, offline_course, tracked_record
from hygrokf.live.turbine import SENSOR_SILENT_S, instants_kept

HOUR_S = 3600.0


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """Six days of the synthetic turbine, the first of them for identification."""
    return read_case(write_case(synthetic_turbine(seed=5, days=6.0), tmp_path_factory.mktemp("turbine")))


def followed(plan_: Plan, readings: list[Reading], batch: int) -> tuple[Tracker, object]:
    tracker, course = Tracker(plan_), None
    for first in range(0, len(readings), batch):
        tracker.take(readings[first : first + batch])
        course = tracker.advance() or course
    return tracker, course


def without_gaps(record: Record) -> Record:
    return record


def gapped(record: Record) -> Record:
    """Ten hours without the ambient, three without power, a day without humidity; then all loggers down for
    eight hours."""
    start = record.start_s

    def holed(series: Series) -> Series:
        hours = (series.time - start) / HOUR_S
        hole = (hours > 100) & (hours < 108)
        if series.signal.startswith("ambient"):
            hole |= (hours > 30) & (hours < 40)
        if series.signal == "active_power":
            hole |= (hours > 60) & (hours < 63)
        if series.signal == "cabinet_relative_humidity":
            hole |= (hours > 70) & (hours < 94)
        return replace(series, time=series.time[~hole], value=series.value[~hole])

    return record.replace_series(*(holed(s) for s in record.series))


def switches_unknown(record: Record) -> Record:
    """Two days without power and pre-heating, longer than readings are kept; then half a day with them, and a
    day without."""

    def holed(series: Series) -> Series:
        hours = (series.time - record.start_s) / HOUR_S
        hole = ((hours > 40) & (hours < 89)) | ((hours > 101) & (hours < 127))
        return replace(series, time=series.time[~hole], value=series.value[~hole])

    return record.replace_series(*(holed(record[name]) for name in ("active_power", "preheating")))


def rarely_told(record: Record) -> Record:
    """The pre-heating is told before and after each half of a day alone: hours in which it may have stayed
    on."""

    def thinned(series: Series) -> Series:
        kept = ((series.time - record.start_s) / HOUR_S) % 12.0 < 7.0
        return (
            series
            if series.signal != "preheating"
            else replace(series, time=series.time[kept], value=series.value[kept])
        )

    return record.replace_series(*(thinned(s) for s in record.series))


def of_means(record: Record) -> Record:
    """The cabinet's and the ambient's readings as means that end at their stamps."""

    def mean(series: Series) -> Series:
        if not series.signal.startswith(("cabinet", "ambient")):
            return series
        step = float(np.median(np.diff(series.time)))
        return replace(series, hold="mean", interval_s=step)

    return record.replace_series(*(mean(s) for s in record.series))


def lagging(record: Record) -> Record:
    """Ambient means read by sensors with a stated response."""
    return of_means(record).replace_series(
        *(
            replace(s, response_time_s=600.0)
            for s in of_means(record).series
            if s.signal.startswith("ambient")
        )
    )


def saturated(record: Record) -> Record:
    """A humidity sensor that is at its ceiling for a fifth of the time."""
    series = record["cabinet_relative_humidity"]
    more = 1.0 - np.nanquantile(series.value, 0.8)
    return record.replace_series(replace(series, value=np.minimum(series.value + more, 1.0)))


def saturated_means(record: Record) -> Record:
    return of_means(saturated(record))


def spoilt(record: Record) -> Record:
    """Bad readings alone and in runs, and a sensor that freezes for a day, in every signal that is judged."""
    random = np.random.default_rng(4)

    def spoil(series: Series) -> Series:
        value = series.value.copy()
        for place in random.choice(len(value) - 3, 12, replace=False):
            value[place : place + random.integers(1, 4)] = random.choice([np.nanmin(value), np.nanmax(value)])
        value[random.choice(len(value), 3, replace=False)] *= 1.2
        hours = (series.time - record.start_s) / HOUR_S
        frozen = (hours > 40.0) & (hours < 64.0)
        if series.signal.startswith(("ambient", "cabinet")):
            value[frozen] = value[np.argmax(frozen)]
        return replace(series, value=value)

    return record.replace_series(*(spoil(s) for s in record.series))


def dry(record: Record) -> Record:
    """No humidity sensor in the cabinet."""
    return replace(record, series=tuple(s for s in record.series if s.signal != "cabinet_relative_humidity"))


def blind(record: Record) -> Record:
    """No sensor in the cabinet at all."""
    return replace(record, series=tuple(s for s in record.series if not s.signal.startswith("cabinet")))


def powerless(record: Record) -> Record:
    return replace(
        record, series=tuple(s for s in record.series if s.signal not in ("active_power", "preheating"))
    )


def on_change(record: Record) -> Record:
    """Power, pre-heating and the ambient hold from their stamps on; the pre-heating comes only when it
    changes, and the power is silent for two hours."""

    def held(series: Series) -> Series:
        there, hours = ~series.missing, (series.time - record.start_s) / HOUR_S
        if series.signal == "preheating":
            there &= np.append(True, np.diff(series.value) != 0.0)
        if series.signal == "active_power":
            there &= (hours < 60.0) | (hours > 62.0)
        told = {"longest_hold_s": np.inf} if series.signal == "preheating" else {}
        course = {"time": series.time[there], "value": series.value[there]}
        return replace(series, hold="previous", interval_s=0.0, **course, **told)

    names = [s for s in record.series if not s.signal.startswith("cabinet")]
    return record.replace_series(*map(held, names))


SHAPES = (
    without_gaps, on_change, gapped, switches_unknown, rarely_told, of_means, lagging, saturated,
    saturated_means, spoilt, dry, blind, powerless,
)  # fmt: skip
LATE_S = 0.95 * LATENESS_S


@pytest.mark.parametrize(
    ("shape", "seed", "late_s", "batch"),
    [
        *((shape, 31, LATE_S, 31) for shape in SHAPES),
        # where a state spans rounds: small ones, and ones that hold more than a stretch of it
        *((shape, 1, LATE_S, 7) for shape in (rarely_told, of_means, saturated_means, spoilt)),
        *((shape, 2, LATE_S, 400) for shape in (gapped, switches_unknown, lagging)),
        *((shape, 0, 0.0, 31) for shape in (without_gaps, on_change)),
    ],
)
def test_what_is_final_is_the_offline_filter_bit_for_bit(
    record: Record, shape: Callable, seed: int, late_s: float, batch: int
) -> None:
    shaped = shape(record)
    model = planned(of_means(record) if shape in (of_means, lagging, saturated_means) else record)
    model = replace(model, forms={s.signal: line_form(s) for s in shaped.series})
    tracker, course = followed(model, arriving(readings_of(shaped), seed, late_s), batch)
    offline = offline_course(model, shaped)
    assert tracker.counts["late"] == tracker.counts["contradicting"] == 0
    # what follows the pre-heating is final when its gap is known
    waits_s = HOUR_S + (6.0 * HOUR_S if shape is rarely_told else 0.0)
    if shape is spoilt:  # departed readings are judged by those of the next half hour
        waits_s += REACH_S
        assert tracker.counts["departed"] > 20 and tracker.counts["frozen"] > 100
    assert tracker.point is not None and tracker.newest - tracker.point.time < LATENESS_S + waits_s
    last = int(np.searchsorted(offline.seconds, tracker.point.time + 1e-3, side="right"))
    t = offline.run.timeline
    there = censored_trace(model.likelihood(t.window(0, last)), model.values)
    if shape in (saturated, saturated_means):
        assert 50 < (t.reading("cabinet_relative_humidity") >= SATURATED).sum() < 0.3 * t.n_readings
    assert np.array_equal(tracker.point.state.mean, there.last.mean)
    assert np.array_equal(tracker.point.state.covariance, there.last.covariance)
    assert np.array_equal(course.trace.mean[-1], offline.trace.mean[-1])
    assert np.array_equal(course.trace.variance[-1], offline.trace.variance[-1])
    assert course.seconds[-1] == pytest.approx(offline.seconds[-1], abs=1e-3)


def test_a_value_that_holds_acts_from_its_stamp_on_and_never_before(record: Record) -> None:
    """What comes later changes no held input of an earlier instant, final or not; it ends with its age."""
    shaped = on_change(record)
    model = replace(planned(shaped), forms={s.signal: line_form(s) for s in shaped.series})
    whole = offline_course(model, shaped).run.timeline
    names = [n for n in ("operating", "power_1", "preheating", "power_unknown") if n in model.model.inputs]
    assert "operating" in names and "preheating" in names
    readings = readings_of(shaped)
    for count in (len(readings) // 3, len(readings) // 2, 2 * len(readings) // 3):
        _, course = followed(model, readings[:count], count)
        so_far = course.run.timeline
        at = np.searchsorted(whole.seconds, so_far.seconds - 1e-3)
        same = np.abs(whole.seconds[np.minimum(at, len(whole) - 1)] - so_far.seconds) < 1e-3
        assert same.mean() > 0.99 and readings[count - 1].time - so_far.seconds[-1] < 1800.0
        for name in names:
            assert np.array_equal(so_far.input(name)[same], whole.input(name)[at[same]]), name
    power = shaped["active_power"]
    known = np.searchsorted(power.time, whole.seconds - 1e-3, side="left") - 1  # at the step's beginning
    age = whole.seconds - power.time[known]
    silent = (age > 3.0 * 600.0 + 1.0) & (known > 0) & (age < 7200.0)
    assert silent.sum() > 5 and whole.input("power_unknown")[silent].all()
    some = np.flatnonzero(~silent & (known > 0) & (age <= 600.0))
    assert np.array_equal(whole.input("operating")[some] > 0.0, power.value[known[some]] > 0.0)


def test_a_restart_from_the_point_and_the_readings_that_are_kept_changes_nothing(record: Record) -> None:
    model, readings = planned(record), readings_of(record)
    _, through = followed(model, readings, 31)
    half = len(readings) // 2
    first, _ = followed(model, readings[:half], 31)
    again = Tracker(model, first.point, first.readings())
    for place in range(half, len(readings), 31):
        again.take(readings[place : place + 31])
        course = again.advance()
    assert np.array_equal(course.trace.mean[-1], through.trace.mean[-1])
    assert not again.counts


@pytest.mark.parametrize("quiet", [("cabinet_",), ("cabinet_relative_humidity",)])
def test_estimates_go_on_from_the_inputs_while_sensors_are_silent(record: Record, quiet: tuple) -> None:
    """Twenty hours without the cabinet's readings: estimates after half an hour, by the filter that never had
    them; no instant is filtered again and again."""
    model, begin = planned(record), record.start_s + 60.0 * HOUR_S
    heard = [one for one in readings_of(record) if one.time <= begin + 20.0 * HOUR_S]
    kept = [one for one in heard if one.time <= begin or not one.signal.startswith(quiet)]
    tracker, told, steps = Tracker(model), set(), 0
    for place in range(0, len(kept), 40):
        tracker.take(kept[place : place + 40])
        course = tracker.advance()
        if course is not None:
            told |= set(np.round(course.seconds[instants_kept(course)]).tolist())
            steps += len(course.seconds) * (course.seconds[0] > begin + 2.0 * HOUR_S)
    silent = np.array(sorted(at for at in told if begin <= at))
    assert np.diff(silent).max() < SENSOR_SILENT_S + 1200.0 and np.median(np.diff(silent)) <= 900.0
    assert silent[-1] >= begin + 19.5 * HOUR_S
    offline = offline_course(model, tracked_record(model, *_columns(kept)))
    assert np.array_equal(course.trace.mean[-1], offline.trace.mean[-1])
    if quiet == ("cabinet_",):
        assert tracker.silent_since() == max(one.time for one in kept if one.signal.startswith("cabinet_"))
        assert steps < 5 * len(silent)
    else:
        assert tracker.silent_since() is None


def _columns(readings: list[Reading]) -> tuple[dict, dict]:
    """Times and values by signal."""
    times: dict[str, list[float]] = {}
    values: dict[str, list[float]] = {}
    for one in readings:
        times.setdefault(one.signal, []).append(one.time)
        values.setdefault(one.signal, []).append(one.value)
    return times, values


def test_a_late_delivery_fills_in_what_the_inputs_alone_told(record: Record) -> None:
    """What a logger kept for twenty hours is used in full: the state is the offline filter's, bit for bit."""
    model, begin = planned(record), record.start_s + 60.0 * HOUR_S
    end = begin + 20.0 * HOUR_S
    readings = readings_of(record)
    held = [one for one in readings if begin < one.time <= end and one.signal.startswith("cabinet_")]
    prompt = [one for one in readings if one not in held]
    order = [one for one in prompt if one.time <= end] + held + [one for one in prompt if one.time > end]
    tracker, course = followed(model, order, 40)
    assert tracker.counts["late"] == 0
    offline = offline_course(model, record)
    last = int(np.searchsorted(offline.seconds, tracker.point.time + 1e-3, side="right")) - 1
    assert np.array_equal(tracker.point.state.mean, offline.trace.mean[last])
    assert np.array_equal(course.trace.mean[-1], offline.trace.mean[-1])


def test_after_a_week_the_inputs_alone_are_final(record: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracker_module, "PROVISIONAL_S", 12.0 * HOUR_S)
    model, begin = planned(record), record.start_s + 60.0 * HOUR_S
    kept = [one for one in readings_of(record) if one.time <= begin or not one.signal.startswith("cabinet_")]
    tracker, _ = followed(model, [one for one in kept if one.time <= begin + 11.0 * HOUR_S], 40)
    assert tracker.point.time <= begin < tracker.provisional_point.time
    assert tracker.judged_s == tracker.provisional_point.time, "alarms do not wait"
    tracker.take([Reading("cabinet_temperature", begin + HOUR_S, 300.0)])
    assert tracker.provisional_point is None and tracker.advance().judged_s < begin, "and are judged again"
    tracker, _ = followed(model, kept, 40)
    offline = offline_course(model, tracked_record(model, *_columns(kept)))
    last = int(np.searchsorted(offline.seconds, tracker.point.time + 1e-3, side="right")) - 1
    assert tracker.provisional_point is None and tracker.newest - tracker.point.time < LATENESS_S + HOUR_S
    assert np.array_equal(tracker.point.state.mean, offline.trace.mean[last])


def test_a_signal_that_repeats_a_value_is_frozen_since_its_first_repetition() -> None:
    """In saturated air, where the gate lets all pass, only below what the sensor has read before."""
    time = 600.0 * np.arange(6)

    def found(*value: float, after_s: float = -math.inf, known: Frozen | None = None) -> list[Frozen]:
        readings = time[: len(value)], np.array(value)
        return list(frozen_runs("cabinet_relative_humidity", readings, 900.0, 8.0 * HOUR_S, after_s, known))

    stuck = Frozen("cabinet_relative_humidity", 600.0, 0.6, 1800.0)
    assert found(0.5, 0.6, 0.6, 0.6, 0.6, 0.6) == [stuck]
    assert found(0.5, 0.6, 0.6, 0.6, 0.6, 0.7) == [replace(stuck, end=3000.0)]
    assert found(0.5, 0.6, 0.6, 0.5) == found() == []
    assert [one.value for one in found(0.98, 0.97, 0.97, 0.97, 0.97, 0.97)] == [0.97]
    assert found(0.9, 0.97, 0.97, 0.97, 0.97, 0.97) == []
    # what was found before stands, because the readings from before may be gone
    known = Frozen("cabinet_relative_humidity", -9e5, 0.97, -8e5)
    assert found(0.97, 0.97, 0.97, 0.97, after_s=1800.0, known=known) == [known]
    assert found(0.6, 0.6, 0.6, 0.6, after_s=1800.0) == []


def test_readings_whose_source_states_that_neither_counts_are_both_left_out(record: Record) -> None:
    model, readings = planned(record), readings_of(record)
    place = next(
        i for i, one in enumerate(readings) if one.signal == "cabinet_temperature" and i > len(readings) // 2
    )
    wrong = replace(readings[place], value=readings[place].value + 3.0, mark=NEITHER)
    tracker, course = followed(model, [*readings[: place + 1], wrong, *readings[place + 1 :]], 50)
    assert tracker.counts["contradicting"] == 2
    series = record["cabinet_temperature"]
    masked = np.where(series.time == wrong.time, np.nan, series.value)
    offline = offline_course(model, record.replace_series(replace(series, value=masked)))
    assert np.array_equal(course.trace.mean[-1], offline.trace.mean[-1])


def test_what_comes_after_its_time_was_final_is_counted_and_changes_nothing(record: Record) -> None:
    model, readings = planned(record), readings_of(record)
    place = len(readings) // 2
    held = [one for one in readings[place : place + 60] if one.signal == "cabinet_relative_humidity"]
    rest = [one for one in readings if one not in held]
    _, expected = followed(model, rest, 40)
    tracker, course = followed(model, [*rest, *held], 40)
    assert tracker.counts["late"] == len(held) > 0
    assert np.array_equal(course.trace.mean[-1], expected.trace.mean[-1])


def test_a_tracker_says_what_it_waits_for(record: Record) -> None:
    tracker = Tracker(planned(record))
    assert tracker.awaited() == ("ambient_relative_humidity", "ambient_temperature")
    assert tracker.advance() is None and tracker.point is None
    readings = readings_of(record)
    tracker.take(one for one in readings[:300] if one.signal != "ambient_relative_humidity")
    assert tracker.awaited() == ("ambient_relative_humidity",)
    assert tracker.advance() is None
    tracker.take(one for one in readings[:300] if one.signal == "ambient_relative_humidity")
    assert tracker.awaited() == () and tracker.advance() is not None


def test_readings_are_kept_as_long_as_an_instant_may_look_at_them(record: Record) -> None:
    tracker, _ = followed(planned(record), readings_of(record), 50)
    kept = [one.time for one in tracker.readings()]
    before_s = (BEFORE + 1) * 900.0
    assert 7 * HOUR_S < tracker.point.time - min(kept) <= tracker.plan.context_s + before_s
    assert max(kept) == tracker.newest
    stillest_s = max(scale[1] for scale in tracker.plan.design.scales.values())
    without = replace(tracker.plan, design=replace(tracker.plan.design, scales={}))
    assert without.context_s == 8.0 * HOUR_S + 2.0 * 1800.0
    assert tracker.plan.context_s - without.context_s == 3.0 * stillest_s > 0.0


def test_no_number_is_no_reading(record: Record) -> None:
    with pytest.raises(ValueError, match="expected a finite number, found nan; omit missing ones"):
        Tracker(planned(record)).take([Reading("cabinet_temperature", 0.0, np.nan)])


def test_unknown_properties_are_refused(record: Record) -> None:
    with pytest.raises(ValueError, match="wandering_exchange"):
        planned(record, wandering={"seal": 0.1})
