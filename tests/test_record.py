"""Series and records."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hygrokf.record import Record, Series, Site


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
        one.hold = "zero-order"


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


def test_equality_looks_at_the_readings():
    one = series(value=[281.0, np.nan, 283.0])
    assert one == series(value=[281.0, np.nan, 283.0])
    assert one != series(value=[281.0, np.nan, 284.0])
    assert one != series(value=[281.0, np.nan, 283.0], hold="zero-order")


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
    ("site", "word"),
    [((91.0, 0.0), "latitude"), ((0.0, 400.0), "longitude"), ((0.0, 0.0, 1e5), "altitude")],
)
def test_a_site_is_on_earth(site, word):
    with pytest.raises(ValueError, match=word):
        Site(*site)


def test_span_includes_the_interval_of_the_first_mean():
    mean = series("active_power", (600.0, 1200.0), hold="zero-order", interval_s=600.0)
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
