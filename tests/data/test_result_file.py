"""Arrays of series.npz, of which anything may be missing."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hygrokf.data.result_file import array, instants, scalar


def test_series() -> None:
    series = {
        "time_s": np.arange(3.0),
        "x": np.array([1.0, np.inf, 3.0]),
        "short": np.ones(2),
        "until_s": np.array(7.0),
    }
    np.testing.assert_array_equal(array(series, "x"), [1.0, np.nan, 3.0])
    assert np.isnan(array(series, "short")).all() and len(array(series, "none")) == 3
    assert scalar(series, "until_s") == 7.0
    assert math.isnan(scalar(series, "x")) and math.isnan(scalar(series, "none"))


@pytest.mark.parametrize("time", [[], [0.0, np.nan], [1.0, 1.0], [2.0, 1.0], [0.0, 1e300], [[0.0], [1.0]]])
def test_instants_that_no_calendar_can_show(time: list) -> None:
    assert len(instants({"time_s": np.array(time)})) == 0
    assert len(array({"time_s": np.array(time), "x": np.zeros(2)}, "x")) == 0


def test_one_instant() -> None:
    assert len(instants({"time_s": np.array(5.0)})) == 1
    np.testing.assert_array_equal(array({"time_s": np.array(5.0), "x": np.array(2.0)}, "x"), [2.0])
