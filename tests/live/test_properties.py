"""Properties of the cabinet as they are now, and when one has departed from the fit's."""

from __future__ import annotations

import math

import pytest
from builders.fit_case import typed

from hygrokf.identification.fit import Fit
from hygrokf.live.properties import (
    DAY_S,
    MOIST,
    ParameterShift,
    TrackedState,
    deviations,
    parameter_shifts,
    properties,
    standard_errors,
)
from hygrokf.modelling.design import Design

TAU = "thermal_time_constant"
ERRORS = {TAU: 0.03}


def followed(course: list[tuple[float, float, float]], name: str = TAU) -> dict[str, ParameterShift]:
    """Parameter shifts after a course of (day, x, standard deviation)."""
    known: dict[str, ParameterShift] = {}
    for day, x, sd in course:
        found = deviations({name: TrackedState(x, sd)}, ERRORS)
        known = parameter_shifts(known, DAY_S * day, found)
    return known


def test_bounds_hold_what_filter_and_fit_do_not_know() -> None:
    (one,) = properties({TAU: (math.log(2.0), 0.04)}, {TAU: 1.5}, ERRORS)
    assert one.value == pytest.approx(3.0) and one.reference == 1.5 and one.observable
    assert math.log(one.upper / one.value) == pytest.approx(1.959964 * 0.05)
    assert one.value / one.lower == pytest.approx(one.upper / one.value)
    (offset,) = properties({"heat_release_change": (-1.0, 0.5)}, {}, {})
    assert (offset.value, offset.reference, offset.unit) == (-1.0, 0.0, "K")
    assert offset.upper == pytest.approx(-1.0 + 1.959964 * 0.5)


def test_what_cannot_be_seen_has_no_value() -> None:
    (one,) = properties({TAU: (0.5, 0.25)}, {TAU: 1.5}, ERRORS)
    assert not one.observable and one.value is one.lower is one.upper is None
    assert followed([(0.0, 2.0, 0.3), (5.0, 2.0, 0.3)]) == {}


def test_a_shift_must_be_sure_matter_and_last() -> None:
    assert followed([(0.0, 0.10, 0.005), (9.0, 0.10, 0.005)]) == {}  # sure, but too small
    assert followed([(0.0, 0.20, 0.05), (9.0, 0.20, 0.05)]) == {}  # of a size that matters, but not sure
    assert not followed([(0.0, 0.4, 0.05), (1.9, 0.4, 0.05)])[TAU].lasting
    for sign, lasts in ((1.0, [False, True]), (-1.0, [False, False])):  # moister air may be water
        course = [(0.0, 0.1 * sign, 0.01), (0.24, 0.1 * sign, 0.01), (0.26, 0.1 * sign, 0.01)]
        assert [followed(course[:n], MOIST)[MOIST].lasting for n in (2, 3)] == lasts
    lasting = followed([(0.0, 0.4, 0.05), (1.0, 0.5, 0.05), (2.0, 0.45, 0.05)])[TAU]
    assert lasting == ParameterShift(TAU, 0.0, True, 0.5)


def test_a_shift_that_is_interrupted_begins_anew() -> None:
    assert followed([(0.0, 0.4, 0.05), (1.0, 0.2, 0.05), (2.5, 0.4, 0.05)])[TAU].since == 2.5 * DAY_S
    assert followed([(0.0, 0.4, 0.05), (1.0, -0.4, 0.05)])[TAU] == ParameterShift(TAU, DAY_S, False, -0.4)


def test_a_shift_ends_where_the_property_is_back() -> None:
    course = [(0.0, 0.4, 0.05), (3.0, 0.5, 0.05)]
    # less sure for a while is no end, half of it is
    assert followed([*course, (4.0, 0.3, 0.09)])[TAU].lasting
    assert followed([*course, (4.0, 0.24, 0.05)]) == {}
    assert followed([*course, (4.0, 0.5, 0.3)]) == {}


def test_a_fit_says_what_it_does_not_know() -> None:
    results = {"covariance": {"names": [TAU], "matrix": [[0.0225]]}}
    fit = Fit("one", Design(()), {TAU: 1.5}, typed(results))
    assert standard_errors(fit) == pytest.approx({TAU: 0.1})
    assert standard_errors(Fit("one", Design(()), {TAU: 1.5})) == {}
