"""Parameters, their coordinates and priors."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from hygrokf.physics.parameters import (
    Coordinates,
    Parameter,
    Prior,
    expect_starts,
    expect_values,
    unique,
    within_limits,
)

TIME = Parameter("time", "h", 2.0, 0.02, 200.0, positive=True)
SLOPE = Parameter("slope", "K/K", 0.0, -2.0, 2.0, null=0.0)
NOISE = Parameter("noise", "K", 0.1, 1e-3, 10.0, positive=True, noise=True)
BIAS = Parameter("bias", "K", 0.0, -1.2, 1.2, prior=Prior(0.05, 0.15))
ALL = (TIME, SLOPE, NOISE, BIAS)


@given(st.floats(0.02, 200.0), st.floats(-2.0, 2.0))
def test_coordinates_and_values_are_each_others_inverse(time: float, slope: float) -> None:
    coordinates = Coordinates(ALL)
    z = coordinates.start({"time": time, "slope": slope})
    values = coordinates.values(z)
    assert values["time"] == pytest.approx(time, rel=1e-14)
    assert values["slope"] == slope
    assert z[0] == pytest.approx(math.log(time), abs=1e-14) and z[1] == slope
    step = 1e-6
    for i, name in enumerate(coordinates.names):
        up, down = z.copy(), z.copy()
        up[i] += step
        down[i] -= step
        rise = coordinates.values(up)[name] - coordinates.values(down)[name]
        # the central difference errs by step²/6 of the third derivative
        assert coordinates.slopes(z)[i] == pytest.approx(rise / (2 * step), rel=1e-8)


def test_a_start_is_moved_into_the_bounds() -> None:
    z = Coordinates(ALL).start({"time": 0.0, "slope": 7.0, "noise": 1e9})
    values = Coordinates(ALL).values(z)
    assert values["time"] == pytest.approx(0.02) and values["slope"] == 2.0
    assert values["noise"] == pytest.approx(10.0) and values["bias"] == 0.0
    assert np.all(z >= Coordinates(ALL).lower) and np.all(z <= Coordinates(ALL).upper)


def test_fixed_parameters_leave_the_coordinates_but_not_the_values() -> None:
    coordinates = Coordinates(ALL, {"slope": 0.7})
    assert coordinates.names == ("time", "noise", "bias")
    np.testing.assert_array_equal(coordinates.positions(), [0, 2, 3])
    values = coordinates.values(coordinates.start())
    assert list(values) == ["time", "slope", "noise", "bias"] and values["slope"] == 0.7
    slopes = coordinates.slopes(coordinates.start())
    expected = np.zeros((4, 3))
    expected[[0, 2, 3], [0, 1, 2]] = slopes
    np.testing.assert_array_equal(coordinates.directions(coordinates.start()), expected)
    assert coordinates.parameter("slope") is SLOPE and coordinates.fixed == {"slope": 0.7}


def test_starts_are_checked_by_name_and_limits_but_for_rounding() -> None:
    expect_starts(ALL, {"noise": 5.0}, {"values": {"time": 200.0 * (1.0 + 1e-14), "noise": 1e9}})
    with pytest.raises(ValueError) as caught:
        expect_starts(ALL, {}, {"values": {"tme": 2.0, "slope": 7.0}, "more_starts[0]": {"noise": math.nan}})
    text = str(caught.value)
    for piece in (
        'values: expected names of time, slope, noise, bias, found "tme"; did you mean',
        "values: expected slope within -2 … 2 K/K, found 7.0; start within its limits",
        "more_starts[0]: expected noise within 0.001 … 10 K, found nan",
    ):
        assert piece in text
    assert within_limits(ALL, {"time": 1e9, "slope": 0.5, "other": 1.0}) == {"time": 200.0, "slope": 0.5}


def test_values_that_are_missing_are_named_beside_what_may_be_meant() -> None:
    with pytest.raises(ValueError, match=r'found none of time; .*"tme"; did you mean "time"'):
        expect_values(ALL, {"tme": 1.0, "slope": 0.0, "noise": 1.0, "bias": 0.0})


def test_impossible_priors_and_fixed_values_are_refused() -> None:
    for sd in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="a standard deviation above 0"):
            Prior(0.0, sd)
    with pytest.raises(ValueError, match="fixed: expected a finite slope, found nan"):
        Coordinates(ALL, {"slope": math.nan})
    with pytest.raises(ValueError, match=r'time, slope, noise, bias, found "slop"; did you mean "slope"'):
        Coordinates(ALL, {"slop": 1.0})


@given(st.floats(-1.0, 1.0))
def test_the_log_prior_is_the_normal_density_of_the_value(bias: float) -> None:
    coordinates = Coordinates(ALL)
    total, gradient, curvature = coordinates.log_prior(coordinates.start({"bias": bias}))
    assert total == pytest.approx(stats.norm(0.05, 0.15).logpdf(bias), rel=1e-12, abs=1e-12)
    np.testing.assert_allclose(gradient, [0, 0, 0, -(bias - 0.05) / 0.15**2], rtol=1e-12)
    np.testing.assert_allclose(curvature, [0, 0, 0, 1 / 0.15**2], rtol=1e-12)


def test_the_prior_of_a_positive_parameter_is_differentiated_in_its_coordinate() -> None:
    coordinates = Coordinates([Parameter("time", "h", 2.0, 0.1, 50.0, positive=True, prior=Prior(1.5, 0.4))])
    z = coordinates.start()
    step = 1e-5
    up, down = (coordinates.log_prior(z + s)[0] for s in (step, -step))
    assert coordinates.log_prior(z)[1][0] == pytest.approx((up - down) / (2 * step), rel=1e-8)
    # the curvature is the expected one, (dθ/dz)²/sd²: positive wherever the value lies
    assert coordinates.log_prior(z)[2][0] == pytest.approx((2.0 / 0.4) ** 2, rel=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lower": 5.0, "upper": 1.0}, "lower < upper"),
        ({"start": 11.0}, "start within"),
        ({"lower": 0.0, "positive": True}, "above 0"),
        ({"physical": (0.6, 12.0)}, "within the physical range, 0.6 … 12.0, found 0.5"),
        ({"physical": (0.0, 9.0)}, "within the physical range"),
    ],
)
def test_impossible_parameters_are_refused(change: dict, message: str) -> None:
    given_ = {"name": "p", "unit": "1", "start": 1.0, "lower": 0.5, "upper": 10.0} | change
    with pytest.raises(ValueError, match=rf"^p: .*{message}"):
        Parameter(**given_)


def test_guards_are_lifted_and_physics_is_not() -> None:
    """Positive ones by a factor of 20; others to 20 half widths from the middle; never past what is
    physical."""
    assert TIME.lifted_limits() == pytest.approx((math.log(1e-3), math.log(4000.0)))
    assert SLOPE.lifted_limits() == pytest.approx((-40.0, 40.0))
    ratio = Parameter("ratio", "1", 0.9, 0.2, 1.0, physical=(0.0, 1.0))
    assert ratio.lifted_limits() == (0.0, 1.0)
    share = Parameter("share", "1", 0.5, 0.01, 1.0, positive=True, physical=(0.0, 1.0))
    assert share.lifted_limits() == pytest.approx((math.log(5e-4), 0.0))


def test_a_value_at_a_guard_is_told_from_one_at_a_limit_that_means_something() -> None:
    """No less of a noise, no effect at all, and what is physical: none of these was stopped by a guard."""
    ratio = Parameter("ratio", "1", 0.9, 0.2, 1.0, physical=(0.0, 1.0))
    assert not ratio.is_stopped_by_guard(1.0) and ratio.is_stopped_by_guard(0.2)
    noise = Parameter("noise", "K", 0.1, 0.002, 5.0, positive=True, noise=True)
    assert not noise.is_stopped_by_guard(0.002) and noise.is_stopped_by_guard(5.0)
    step = Parameter("step", "K", 0.0, 0.0, 30.0, null=0.0)
    assert not step.is_stopped_by_guard(0.0) and step.is_stopped_by_guard(30.0)


def test_one_name_stands_for_one_thing() -> None:
    assert unique(ALL) == ALL
    with pytest.raises(ValueError, match="'slope'"):
        unique([TIME, SLOPE, SLOPE])
