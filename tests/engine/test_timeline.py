"""Instants of a run: distinct steps, holds, resets, windows, and all faults in one message."""

from __future__ import annotations

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


def test_other_inputs_leave_the_rest_and_widen_the_range() -> None:
    """The range that sub-steps are chosen by is that of the old inputs and the new ones."""
    made = timeline(room(), TIME, INPUTS, {"y": np.arange(6.0)})
    other = made.window(2, 5).with_inputs({"fan": np.array([40.0, 41.0, 42.0])})
    assert other.input("fan").tolist() == [40.0, 41.0, 42.0] and made.input("fan")[2] == 12.0
    np.testing.assert_array_equal(other.input("sun"), made.input("sun")[2:5])
    np.testing.assert_array_equal(other.u[0], made.u[2])
    assert other.corners["fan"].max() == 42.0 and other.corners["fan"].min() == 10.0
    assert other.corners["mode"].max() == 1.0


def test_all_faults_come_in_one_message() -> None:
    inputs = {"fan": np.ones(3), "mode": np.array([0, 0, np.nan, 0, 0, 0])}
    with pytest.raises(ValueError) as caught:
        timeline(room(), TIME, inputs, {"q": np.zeros(6), "y": np.zeros(4)})
    text = str(caught.value)
    for piece in (
        "'sun' of the model is missing", "fan: expected 6 values, found shape (3,)",
        "mode: not finite at instant 2",
        "'q', but the model's outputs are ['y', 'z']", "y: expected 6 readings, found shape (4,)",
    ):  # fmt: skip
        assert piece in text


@pytest.mark.parametrize("time", [[], [0.0, 0.0], [1.0, 0.5], [0.0, np.nan]])
def test_instants_must_increase(time: list[float]) -> None:
    values = {name: np.ones(len(time)) for name in INPUTS}
    with pytest.raises(ValueError, match="increase strictly"):
        timeline(room(), np.array(time), values, {})
