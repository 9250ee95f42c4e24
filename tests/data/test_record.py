"""Series and records."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from hygrokf.data.input_paths import input_path
from hygrokf.data.record import Record, Series, Site


def series(signal="cabinet_temperature", time=(0.0, 60.0, 120.0), value=None, **more) -> Series:
    time = np.array(time, dtype=float)
    value = 293.15 + np.arange(len(time)) if value is None else value
    return Series(signal, time, np.array(value, dtype=float), **more)


def test_arrays_are_copied_and_read_only():
    time = np.arange(3.0)
    one = Series("wind_speed", time, time)
    time[0] = -1.0
    assert one.time[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        one.value[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        one.hold = "mean"


def test_everything_wrong_with_a_series_is_said_at_once():
    with pytest.raises(ValueError, match="increase strictly") as caught:
        Series(
            "cabinet_temprature",
            np.array([0.0, 0.0]),
            np.array([1.0, np.inf]),
            hold="cubic",
            interval_s=-1.0,
            resolution=np.nan,
            accuracy=-0.1,
        )
    for word in ("unknown signal", "finite", "hold", "interval_s", "resolution", "accuracy"):
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("time", "value"),
    [([0.0, 1.0], [1.0]), ([[0.0]], [[1.0]]), ([0.0, np.nan], [1.0, 2.0]), ([1.0, 0.0], [1.0, 2])],
)
def test_bad_times_are_refused(time, value):
    with pytest.raises(ValueError, match="time"):
        Series("wind_speed", np.array(time), np.array(value))


CELSIUS = 20.0 + np.arange(50.0) / 10.0
SECONDS = 1.6e9 + 600.0 * np.arange(50)
INDEX = pd.date_range("2020-09-13", periods=50, freq="10min")


@pytest.mark.parametrize(
    ("signal", "time", "value", "words"),
    [
        ("cabinet_temperature", INDEX, CELSIUS + 273.15,
            ["expected seconds since 1970", "found datetime64", "read_frames"]),
        ("cabinet_temperature", INDEX.tz_localize("UTC"), CELSIUS + 273.15,
            ["expected seconds", "found Timestamp"]),
        ("cabinet_temperature", INDEX.to_period("10min"), CELSIUS + 273.15,
            ["expected seconds", "found Period"]),
        ("cabinet_temperature", INDEX - INDEX[0], CELSIUS + 273.15,
            ["expected seconds", "found timedelta64"]),
        ("cabinet_temperature", list(INDEX.strftime("%Y-%m-%d %H:%M")), CELSIUS + 273.15,
            ["expected seconds", "found str"]),
        ("cabinet_temperature", 1e3 * SECONDS, CELSIUS + 273.15,
            ["found 1.6e+12", "milliseconds: divide them by 1000"]),
        ("cabinet_temperature", INDEX.as_unit("us").asi8, CELSIUS + 273.15,
            ["microseconds: divide them by 1e+06"]),
        ("cabinet_temperature", INDEX.as_unit("ns").asi8, CELSIUS + 273.15,
            ["nanoseconds: divide them by 1e+09"]),
        ("cabinet_temperature", -1e10 + SECONDS, CELSIUS + 273.15,
            ["expected seconds since 1970", "correct them"]),
        ("cabinet_temperature", SECONDS, CELSIUS,
            ["expected K, found readings of about 22.45", 'to_si(value, "degC", "cabinet_temp']),
        ("cabinet_temperature", SECONDS, [f"{one:.1f} C" for one in CELSIUS],
            ["value: expected numbers in K, found str"]),
        ("cabinet_temperature", SECONDS, [pd.NA, *range(273, 322)], ["found NAType", "na_value=numpy.nan"]),
        ("cabinet_temperature", SECONDS, [*CELSIUS[1:], [1.0, 2.0]],
            ["value: expected numbers in K, found list"]),
        ("ambient_temperature", SECONDS, CELSIUS - 40.0, ["expected K", "degC"]),
        ("cabinet_relative_humidity", SECONDS, 2.0 * CELSIUS,
            ["expected fractions (unit 1), found", 'to_si(value, "%"']),
        ("ambient_pressure", SECONDS, 990.0 + CELSIUS, ["expected Pa", "hPa"]),
        ("cabinet_absolute_humidity", SECONDS, 0.4 * CELSIUS, ["expected kg/m3", "g/m3"]),
        ("wind_direction", SECONDS, 7.0 * CELSIUS, ["expected rad", "deg"]),
        ("cabinet_temprature", INDEX, CELSIUS,
            ['unknown signal "cabinet_temprature"; did you mean', "expected seconds"]),
    ],
)  # fmt: skip
def test_readings_that_cannot_be_in_si_are_refused(signal, time, value, words):
    with pytest.raises(ValueError, match=f"series {signal}: ") as caught:
        Series(signal, time, value)
    assert all(word in str(caught.value) for word in words), caught.value


@pytest.mark.parametrize(
    ("signal", "value"),
    [
        ("cabinet_temperature", np.full(50, -99.0 + 273.15)),  # a dead sensor, to be masked
        ("cabinet_relative_humidity", np.full(50, 99.99)),  # a sentinel, 9999 %
        ("cabinet_relative_humidity", np.where(np.arange(50) % 3, 0.7, 1.5)),  # a third out of range
        ("cabinet_relative_humidity", np.where(np.arange(50) % 3, 1.4, 0.7)),  # a sensor that is far off
        ("cabinet_temperature", np.where(np.arange(50) % 2, 20.0, 293.0)),  # half of them, nobody knows
        ("rotor_speed", CELSIUS / 10.0),
        ("cabinet_temperature", np.full(50, np.nan)),
    ],
)
def test_readings_that_may_be_wrong_are_kept_to_be_masked_or_doubted(signal, value):
    assert Series(signal, SECONDS, value).missing.sum() == np.isnan(value).sum()


def test_masked_arrays_are_missing_where_they_are_masked():
    value = np.ma.masked_array(CELSIUS + 273.15, mask=np.arange(50) < 3)
    assert Series("cabinet_temperature", SECONDS, value).missing.sum() == 3


def test_until_is_a_number_of_seconds():
    for until in (INDEX[9], "2020-09-13T00:00Z", 1.6e12, math.nan):
        with pytest.raises(ValueError, match="until_s must be a number of seconds since 1970"):
            Record("x", (), until_s=until)


def test_equality_looks_at_the_readings():
    one = series(value=[281.0, np.nan, 283.0])
    assert one == series(value=[281.0, np.nan, 283.0])
    assert one != series(value=[281.0, np.nan, 284.0])
    assert one != series(value=[281.0, np.nan, 283.0], hold="zoh")


def test_a_hold_is_one_word_and_a_mean_has_its_interval():
    assert (series().hold, series("door_open").hold) == ("linear", "previous")
    assert series(interval_s=60.0).hold == series(interval_s=60.0, hold="mean").hold == "mean"
    assert (series(hold="zoh").hold, series("door_open", hold="foh").hold) == ("previous", "linear")
    for more in ({"hold": "mean"}, *({"hold": word, "interval_s": 60.0} for word in ("linear", "zoh"))):
        with pytest.raises(ValueError, match="expected hold mean together with interval_s > 0 only"):
            series(**more)
    for word in ("zero-order", "zero_order_hold", "Linear", "", "regime", None):
        with pytest.raises(ValueError, match="hold"):
            series(hold=word)
    with pytest.raises(ValueError, match="longest_hold_s must be a number > 0"):
        series(hold="zoh", longest_hold_s=0.0)


def test_a_window_begins_with_the_value_that_is_held_until_then():
    door = series("door_open", 3600.0 * np.array([0.0, 6.0, 7.0]), [0.0, 1.0, 0.0], longest_hold_s=math.inf)
    for start, end, hours, values in ((3, 8, [3, 6, 7], [0, 1, 0]), (6, 6.5, [6], [1]), (8, 9, [8], [0])):
        part = door.window(3600.0 * start, 3600.0 * end)
        assert (part.time / 3600.0).tolist() == hours and part.value.tolist() == values
    assert door.window(-7200.0, -3600.0) is None
    aged = dataclasses.replace(door, longest_hold_s=3600.0)
    assert aged.window(3 * 3600.0, 8 * 3600.0).value.tolist() == [1.0, 0.0]
    assert aged.window(9 * 3600.0, 10 * 3600.0) is None


def test_a_held_value_is_unknown_while_its_connection_is_lost():
    """Known again once it is regained, and from a reading on that comes from within the loss."""
    hours = 3600.0 * np.array([0.0, 6.0, 7.0])
    door = series("door_open", hours, [0.0, 1.0, 0.0], longest_hold_s=math.inf)
    asked = 3600.0 * np.array([0.5, 1.0, 1.5, 2.0, 4.5, 5.5, 6.5, 7.5, 8.5, 9.5])
    nan = math.nan
    for spans, expected in (
        ([(1.0, 2.0)], [0, 0, nan, 0, 0, 0, 1, 0, 0, 0]),
        ([(1.0, 2.0), (4.0, 5.0)], [0, 0, nan, 0, nan, 0, 1, 0, 0, 0]),
        ([(5.0, 8.0)], [0, 0, 0, 0, 0, nan, 1, 0, 0, 0]),
        ([(-2.0, -1.0), (8.0, math.inf)], [0, 0, 0, 0, 0, 0, 1, 0, nan, nan]),
    ):
        lost = tuple((3600.0 * start, 3600.0 * end) for start, end in spans)
        assert_array_equal(dataclasses.replace(door, lost=lost).held_at(asked), expected)
    aged = dataclasses.replace(door, longest_hold_s=3 * 3600.0, lost=((3600.0, 7200.0),))
    assert_array_equal(aged.held_at(asked), [0, 0, nan, 0, nan, nan, 1, 0, 0, 0])
    path = input_path(dataclasses.replace(door, lost=((3600.0, 7200.0),)))
    assert (path.time[:4] / 3600.0).tolist() == [0.0, 1.0, 2.0, 6.0] and path.lost == ()
    for wrong in (((2.0, 1.0),), ((0.0, 2.0), (1.0, 3.0))):
        with pytest.raises(ValueError, match="lost must be spans"):
            dataclasses.replace(door, lost=wrong)


def test_a_record_finds_its_signals():
    record = Record("x", (series(), series("active_power")))
    assert "active_power" in record
    assert "rain" not in record
    assert record["active_power"].signal == "active_power"
    with pytest.raises(KeyError, match=r"has no rain; it has cabinet_temperature, active_power"):
        record["rain"]


def test_a_signal_occurs_once():
    with pytest.raises(ValueError, match="more than one series of cabinet_temperature"):
        Record("x", (series(), series()))


@pytest.mark.parametrize("rated", [0.0, -1.0, math.nan, math.inf])
def test_rated_power_is_above_zero(rated):
    with pytest.raises(ValueError, match="rated_power_W"):
        Record("x", (series(),), rated_power_W=rated)


@pytest.mark.parametrize(
    ("site", "word"), [((91.0, 0.0), "latitude"), ((0.0, 400.0), "longitude"), ((0.0, 0.0, 1e5), "altitude")]
)
def test_a_site_is_on_earth(site, word):
    with pytest.raises(ValueError, match=word):
        Site(*site)


def test_span_includes_the_interval_of_the_first_mean():
    mean = series("active_power", (600.0, 1200.0), hold="mean", interval_s=600.0)
    record = Record("x", (series(time=(30.0, 90.0)), mean))
    assert record.start_s == 0.0
    assert record.end_s == 1200.0
    assert math.isnan(Record("x", ()).start_s)


@given(
    times=st.lists(st.integers(0, 1000), min_size=1, max_size=40, unique=True).map(sorted),
    until=st.integers(-10, 1010),
)
def test_identification_and_validation_part_the_readings(times, until):
    one = series(time=times)
    record = Record("x", (one,), until_s=float(until))
    parts = [
        part[one.signal].time for part in (record.identification(), record.validation()) if one.signal in part
    ]
    np.testing.assert_array_equal(np.concatenate(parts), one.time)
    for reading in record.identification().series:
        assert reading.time[-1] <= until
    for reading in record.validation().series:
        assert reading.time[0] > until


def test_without_until_everything_identifies_and_nothing_validates():
    record = Record("x", (series(),))
    assert record.identification() == record
    assert record.validation().series == ()


@given(limits=st.tuples(st.floats(-50, 200), st.floats(-50, 200)).map(sorted))
def test_window_keeps_what_lies_inside(limits):
    time = np.arange(0.0, 150.0, 10.0)
    record = Record("x", (series(time=time),)).window(*limits)
    expected = [one for one in time if limits[0] <= one <= limits[1]]
    kept = record.series[0].time if record.series else []
    np.testing.assert_array_equal(kept, expected)


def test_window_over_the_whole_span_changes_nothing():
    record = Record("x", (series(),), until_s=60.0)
    assert record.window(record.start_s, record.end_s) == record


def test_window_keeps_until_only_inside():
    record = Record("x", (series(),), until_s=60.0)
    assert record.window(0.0, 30.0).until_s is None
    assert record.window(30.0, 120.0).until_s == 60.0
    with pytest.raises(ValueError, match="must not be after"):
        record.window(2.0, 1.0)


def test_replace_series_exchanges_one_and_adds_warnings():
    record = Record("x", (series(), series("rain")), warnings=("a",))
    other = series(value=[281.0, 282.0, 283.0])
    changed = record.replace_series(other, warnings=("b",))
    assert changed.signals == record.signals
    assert changed["cabinet_temperature"] == other
    assert changed["rain"] == record["rain"]
    assert changed.warnings == ("a", "b")
    with pytest.raises(KeyError, match="wind_speed"):
        record.replace_series(series("wind_speed"))
