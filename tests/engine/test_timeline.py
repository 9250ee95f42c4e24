"""Instants of a run: distinct steps, holds, resets, windows, and all faults in one message."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hygrokf.engine.timeline import timeline
from hygrokf.physics.holds import REGIME
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import Model, compose
from hygrokf.physics.parameters import Parameter


def room(averaged: dict[str, float] | None = None) -> Model:
    """Inputs of all three holds, two outputs."""
    made = linear_network(
        "room", [Parameter("k", "1/h", 1.0, 0.1, 9.0)], ["x"], ["sun", "fan", "mode"],
        lambda p, x, u: {"x": -p.k * x.x + u.sun + u.fan + u.mode},
        {"y": lambda p, x, u: (x.x, 0.1), "z": lambda p, x, u: (2 * x.x, 0.2)},
        lambda p: {"x": 0.1}, lambda p, u: {"x": (0.0, 1.0)},
    )  # fmt: skip
    return compose([made], {"sun": "linear", "fan": "mean", "mode": REGIME}, averaged)


TIME = np.array([0.0, 0.25, 0.5, 1.0, 1.25, 1.2500002])
INPUTS = {"sun": np.arange(6.0), "fan": 10.0 + np.arange(6.0), "mode": np.array([0.0, 0, 1, 1, 1, 0])}


def test_arrays_hold_what_was_given() -> None:
    y = np.array([1.0, np.nan, 3.0, 4.0, np.nan, 6.0])
    made = timeline(room(), TIME, INPUTS, {"z": y}, origin_s=1e9)
    assert len(made) == 6 and made.n_readings == 4 and made.origin_s == 1e9
    assert (made.varying, made.regimes, made.outputs) == (("sun", "fan"), ("mode",), ("y", "z"))
    for name, values in INPUTS.items():
        np.testing.assert_array_equal(made.input(name), values)
    np.testing.assert_array_equal(made.reading("z"), y)
    assert np.isnan(made.reading("y")).all()
    np.testing.assert_array_equal(
        made.u[0], made.u[1]
    )  # before the first instant nothing is known to be otherwise


def test_equal_steps_in_equal_regimes_share_a_key() -> None:
    made = timeline(room(), TIME, INPUTS, {})
    # (0, off) once, (0.25, off), (0.25, on) twice, (0.5, on), (0.7 ms, off)
    assert len(made.steps) == 5
    lengths, modes = made.steps[made.key].T
    np.testing.assert_allclose(lengths, np.diff(TIME, prepend=0.0), rtol=0, atol=0.5 / 3.6e9)
    np.testing.assert_array_equal(modes, INPUTS["mode"])
    assert made.key[2] == made.key[4] != made.key[1]
    assert made.key.dtype == np.int32 and made.reset.dtype == np.int32


@given(st.floats(0.01, 3.0), st.floats(0, 1e5), st.integers(3, 200))
def test_rounding_of_time_stamps_does_not_make_new_steps(step: float, start: float, count: int) -> None:
    step = round(step * 3.6e6) / 3.6e6  # whole milliseconds
    time = start + step * np.arange(count)
    values = {name: np.ones(count) for name in INPUTS}
    made = timeline(room(), time, values, {})
    assert len(made.steps) == 2  # none to the first instant, one for all others
    assert made.steps[1, 0] == pytest.approx(step, abs=0.5 / 3.6e9)


@pytest.mark.parametrize("rate", [44_100.0, 4096.0, 30.0])
def test_steps_of_fast_sampling_keep_their_length(rate: float) -> None:
    """[1/s] 1/44,100 s is 22.7 µs; every step within a millionth of its length."""
    time = np.arange(500) / rate
    made = timeline(room(), time, {name: np.ones(500) for name in INPUTS}, {}, unit="s")
    assert len(made.steps) == 2
    assert made.steps[1, 0] * 3600.0 * rate == pytest.approx(1.0, abs=1e-6)


def test_resets_are_bits_in_the_order_of_the_averaged_outputs() -> None:
    model = room({"z": 0.5, "y": 0.25})
    first, second = np.array([1, 0, 1, 0, 0, 1], bool), np.array([0, 0, 1, 1, 0, 0], bool)
    made = timeline(model, TIME, INPUTS, {}, {"y": second, "z": first})
    np.testing.assert_array_equal(made.reset, first * 1 + second * 2)
    assert model.states == ("x", "mean_z", "mean_y")


def test_windows_and_other_readings_are_copies() -> None:
    made = timeline(room(), TIME, INPUTS, {"y": np.arange(6.0)})
    part = made.window(2, 5)
    np.testing.assert_array_equal(part.time, TIME[2:5])
    np.testing.assert_array_equal(part.u, made.u[2:6])
    np.testing.assert_array_equal(part.reading("y"), [2.0, 3.0, 4.0])
    # of the steps it keeps those that lead to its own instants
    np.testing.assert_array_equal(part.steps[part.key], made.steps[made.key[2:5]])
    assert len(part.steps) == len(np.unique(made.key[2:5]))
    forecast = made.with_readings(np.full((6, 2), np.nan))
    assert forecast.n_readings == 0 and made.n_readings == 6
    with pytest.raises(ValueError, match=r"\(6, 2\), found \(2, 2\)"):
        made.with_readings(np.zeros((2, 2)))


def test_other_inputs_leave_the_rest() -> None:
    made = timeline(room(), TIME, INPUTS, {"y": np.arange(6.0)})
    other = made.window(2, 5).with_inputs({"fan": np.array([40.0, 41.0, 42.0])})
    assert other.input("fan").tolist() == [40.0, 41.0, 42.0] and made.input("fan")[2] == 12.0
    np.testing.assert_array_equal(other.input("sun"), made.input("sun")[2:5])
    np.testing.assert_array_equal(other.u[0], made.u[2])


def test_all_faults_come_in_one_message() -> None:
    inputs = {"fan": np.ones(3), "mode": np.array([0, 0, np.nan, 0, 0, 0])}
    with pytest.raises(ValueError) as caught:
        timeline(room(), TIME, inputs, {"q": np.zeros(6), "y": np.zeros(4)})
    text = str(caught.value)
    for piece in (
        "'sun' of the model is missing", "fan: expected 6 values, found shape (3,)",
        "mode: not finite at instant 2",
        "readings: expected names of y, z, found \"q\"", "y: expected 6 values, found shape (4,)",
    ):  # fmt: skip
        assert piece in text


@pytest.mark.parametrize(
    ("time", "words"),
    [
        ([], "at least one instant"),
        ([1.0, 0.5], "found 0.5 h after 1 h at instant 1; sort"),
        ([0.0, np.nan], "found nan at instant 1"),
        ([["0"]], r"found shape \(1, 1\)"),
        (np.array([0.0, 1.0], np.float32), "double precision, found float32"),
        (np.ma.array([0.0, 1.0], mask=[False, True]), "masked"),
        (np.array(["2020-01-01", "NaT"], "datetime64[s]"), "found nan at instant 1"),
        (["first", "second"], "numbers or dates, found first at"),
    ],
)
def test_instants_that_are_none_are_refused(time: list[float], words: str) -> None:
    values = {name: np.ones(len(time)) for name in INPUTS}
    with pytest.raises(ValueError, match=words):
        timeline(room(), time, values, {})


def test_dates_become_hours_since_the_first() -> None:
    """Numpy's, Python's and pandas' dates of one instant are the same; a zone counts."""
    import pandas as pd

    values = {name: np.ones(3) for name in INPUTS}
    stamps = ["2026-03-01T12:00:00", "2026-03-01T12:30:00", "2026-03-02T12:00:00"]
    naive = [datetime.fromisoformat(one) for one in stamps]
    aware = pd.to_datetime(stamps).tz_localize("UTC").tz_convert("Europe/Berlin")
    for one in (np.array(stamps, "datetime64[ns]"), naive, pd.Series(aware), aware, pd.to_datetime(stamps)):
        made = timeline(room(), one, values, {})
        np.testing.assert_array_equal(made.time, [0.0, 0.5, 24.0])
        assert made.origin_s == datetime(2026, 3, 1, 12, tzinfo=UTC).timestamp()
    lags = np.array([0, 1800, 86400], "timedelta64[s]")
    np.testing.assert_array_equal(timeline(room(), lags, values, {}).time, [0.0, 0.5, 24.0])
    for word, options in (("beside a unit", {"unit": "s"}), ("origin_s", {"origin_s": 1e9})):
        with pytest.raises(ValueError, match=word):
            timeline(room(), naive, values, {}, **options)


def test_times_in_other_units_are_converted_and_misspelt_units_named() -> None:
    values = {name: np.ones(2) for name in INPUTS}
    for unit, hours in (("s", 1 / 3600), ("min", 1 / 60), ("h", 1.0), ("d", 24.0), ("a", 8766.0)):
        np.testing.assert_array_equal(timeline(room(), [0, 3], values, {}, unit=unit).time, [0.0, 3 * hours])
    with pytest.raises(ValueError, match='s, min, h, d, a, found "hours"'):
        timeline(room(), [0, 3], values, {}, unit="hours")


def test_missing_readings_of_all_kinds_are_nan() -> None:
    import pandas as pd

    values = {name: np.ones(3) for name in INPUTS}
    wanted = timeline(room(), [0, 1, 2], values, {"y": [1.0, np.nan, 3.0]}).y
    for one in (
        np.ma.array([1.0, 99.0, 3.0], mask=[0, 1, 0]), np.ma.array([1, 99, 3], mask=[0, 1, 0]),
        [1.0, None, 3.0], pd.Series([1.0, None, 3.0], dtype="Float64"), pd.Series([1, None, 3],
        dtype="Int64"),
    ):  # fmt: skip
        np.testing.assert_array_equal(timeline(room(), [0, 1, 2], values, {"y": one}).y, wanted)


def test_numbers_that_are_none_and_misspelt_names_are_refused() -> None:
    values = {name: np.ones(3) for name in INPUTS}
    masked = {**values, "sun": np.ma.array(np.ones(3), mask=[0, 1, 0])}
    misspelt = {"suun": np.ones(3), "fan": np.ones(3), "mode": np.ones(3)}
    dates = np.array(["2020-01-01"] * 3, "datetime64[s]")
    for inputs, read, resets, words in (
        (masked, {}, {}, "sun: not finite at instant 1"),
        (misspelt, {}, {}, "'sun' of the model is missing; given are .*did you mean \"suun\""),
        (values, {"y": [1.0, np.inf, 2.0]}, {}, "y: infinite at instant 1"),
        (values, {"y": ["a", "b", "c"]}, {}, "y: expected numbers, found list"),
        (values, {"y": dates}, {}, r"y: expected numbers, found datetime64\[s\]"),
        (values, {}, {"x": np.ones(3, bool)}, "resets: expected names of y, z, found"),
        (values, {}, {"z": np.ones(2, bool)}, r"resets of z: expected 3 values, found shape \(2,\)"),
    ):
        with pytest.raises(ValueError, match=words):
            timeline(room({"z": 1.0}), [0, 1, 2], inputs, read, resets)
    made = timeline(room(), [0, 1, 2], values, {})
    for call, words in (
        (lambda: made.input("sum"), 'found "sum"; did you mean "sun"'),
        (lambda: made.reading("yy"), 'found "yy"; did you mean "y"'),
        (
            lambda: made.with_inputs({"mode": np.ones(3)}),
            'vary within steps: expected names of sun, fan, found "mode"',
        ),
    ):
        with pytest.raises(ValueError, match=words):
            call()


def test_a_running_mean_restarts_after_the_last_row_of_an_instant() -> None:
    values = {name: np.ones(5) for name in INPUTS}
    model = room({"z": 1.0})
    made = timeline(model, [0, 1, 1, 1, 2], values, {}, {"z": np.array([1, 0, 1, 0, 0], bool)})
    assert made.reset.tolist() == [1, 0, 0, 1, 0]
    assert made.steps[made.key, 0].tolist() == [0.0, 1.0, 0.0, 0.0, 1.0]
