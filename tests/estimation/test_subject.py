"""Every verb takes a fit with a record or a likelihood with its estimate, and names the call that makes what
is missing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from builders import masses

import hygrokf
from hygrokf.data.record import Series
from hygrokf.estimation.confidence import uncertainty
from hygrokf.estimation.optimiser import Objective
from hygrokf.estimation.subject import Spread
from hygrokf.identification.fit import Fit
from hygrokf.modelling.design import Design

VERBS = (
    "simulate", "forecast", "smooth", "innovations", "to_filterpy", "to_statespace", "bode", "step_response",
    "confidence_intervals", "modal_time_constants", "covariances",
)  # fmt: skip


@pytest.fixture(scope="module")
def things() -> dict[str, Any]:
    random = np.random.default_rng(3)
    time = 0.25 * np.arange(120.0)
    likelihood = masses.likelihood(time, *masses.simulated(time, random))
    design = Design(mechanisms=(("thermal_network", {}), ("thermal_diffusion", {})))
    series = Series("ambient_temperature", 1.6e9 + 600.0 * np.arange(9), np.full(9, 283.0), hold="linear")
    return {
        "likelihood": likelihood,
        "estimate": hygrokf.fit_mle(likelihood, masses.VALUES, count=1),
        "fit": Fit("made", design, {p.name: p.start for p in design.model.parameters}),
        "record": hygrokf.Record("made", (series,)),
        "design": design,
        "model": likelihood.model,
        "frame": pd.DataFrame({"ambient_temperature": [9.8]}),
        "path": "case.toml",
        "nothing": None,
    }


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize(
    ("first", "second", "said"),
    [
        ("path", "record", r"the path 'case.toml' and a Record; read_fit\('case.toml'\) reads a Fit"),
        ("fit", "path", r"a Fit and the path 'case.toml'; read_case\('case.toml'\) makes a Record"),
        ("fit", "frame", r"a Fit and a pandas frame; read_frames\(frames, units=…\) makes a Record"),
        ("frame", "nothing", r"a pandas frame and nothing; read_frames\(.*identify a Fit of it"),
        ("record", "fit", "in this order, found a Record and a Fit; "),
        ("estimate", "likelihood", "in this order, found an Estimate and a Likelihood; "),
        ("design", "record", r"a Design and a Record; identify\(record\) makes a Fit"),
        ("model", "estimate", r"a Model and an Estimate; .*Likelihood\(model, timeline\(model, …\)\)"),
        ("likelihood", "nothing", r"a Likelihood and nothing; .*fit_mle\(likelihood\) makes its Estimate"),
        ("likelihood", "record", r"a Likelihood and a Record; .* which has its own readings, and fit_mle"),
        ("likelihood", "fit", r"a Likelihood and a Fit; .*fit.likelihood\(record\) make a Likelihood"),
        ("fit", "estimate", r"a Fit and an Estimate; .*fit.likelihood\(record\) make a Likelihood"),
    ],
)
def test_anything_else_is_answered_by_the_call_that_makes_it(
    things: dict, verb: str, first: str, second: str, said: str
) -> None:
    with pytest.raises(ValueError, match=said) as found:
        getattr(hygrokf, verb)(things[first], things[second])
    assert str(found.value).startswith(f"{verb}: expected a Fit and a Record, or a Likelihood")


@pytest.mark.parametrize("verb", ["confidence_intervals", "modal_time_constants", "covariances"])
def test_bounds_need_an_estimate_where_values_are_not_enough(things: dict, verb: str) -> None:
    with pytest.raises(ValueError, match=r"found values, which .*fit_mle\(likelihood, values, count=1\)"):
        getattr(hygrokf, verb)(things["likelihood"], things["estimate"].values)


@pytest.mark.parametrize("verb", VERBS)
def test_an_estimate_of_another_model_is_refused(things: dict, verb: str) -> None:
    estimate = things["estimate"]
    other = replace(estimate, values={**estimate.values, "third": 1.0})
    with pytest.raises(
        ValueError, match=f"{verb}: expected an Estimate of the parameters .*found .*, third; fit_"
    ):
        getattr(hygrokf, verb)(things["likelihood"], other)


@pytest.mark.parametrize(
    "verb", ["bode", "step_response", "confidence_intervals", "modal_time_constants", "parameter_table"]
)
def test_a_level_is_a_probability(things: dict, verb: str) -> None:
    with pytest.raises(ValueError, match="level: expected a probability between 0 and 1, found 95"):
        getattr(hygrokf, verb)(things["likelihood"], things["estimate"], level=95)


def test_leads_lie_ahead(things: dict) -> None:
    with pytest.raises(ValueError, match=r"leads_h: expected leads above 0 h, found \[-1.0\]"):
        hygrokf.forecast(things["likelihood"], things["estimate"], leads_h=[-1.0])


@pytest.mark.parametrize("verb", VERBS)
def test_a_parameter_without_a_value_is_named(things: dict, verb: str) -> None:
    values = {name: value for name, value in masses.VALUES.items() if name != "warmth"}
    with pytest.raises(ValueError, match="found none of warmth"):
        getattr(hygrokf, verb)(things["likelihood"], values)


def test_covariances_are_those_of_the_estimate(things: dict) -> None:
    likelihood, estimate = things["likelihood"], things["estimate"]
    found = hygrokf.covariances(likelihood, estimate)
    expected = uncertainty(Objective(likelihood, estimate.coordinates), estimate)
    np.testing.assert_array_equal(found.wald, expected.wald)
    assert found.names == expected.names


def test_a_covariance_in_units_is_one_of_the_coordinates() -> None:
    """Draws from it have the standard deviations that it states, to first order."""
    model = masses.network()
    matrix = np.array([[1e-4, -2e-5], [-2e-5, 4e-6]])
    spread = Spread.in_units(model.parameters, masses.VALUES, (("outer", "share"), matrix))
    draws = np.random.default_rng(1).normal(size=(100_000, 2))
    found = spread.drawn(draws)
    assert set(found) == set(masses.VALUES) and found["warmth"] == masses.VALUES["warmth"]
    # 100,000 draws know a variance to 0.45 %
    np.testing.assert_allclose(np.cov(found["outer"], found["share"]), matrix, rtol=0.03)


@pytest.mark.parametrize("given", ["case.toml", None, {"a": pd.DataFrame({"x": [1.0]})}, 3.0])
def test_what_needs_a_record_names_what_makes_one(given: object) -> None:
    maker = {str: r"read_case\('case.toml'\)", dict: r"read_frames\(frames, units=…\)"}
    said = maker.get(type(given), "read_case makes one of a case file, read_frames one of pandas frames")
    with pytest.raises(ValueError, match=f"identify: expected a Record, found .*; {said}"):
        hygrokf.identify(given)
    with pytest.raises(ValueError, match="model_inputs: expected a Record"):
        hygrokf.model_inputs(Design(mechanisms=(("thermal_network", {}),)), given)


def test_words_of_an_object_fit_a_screen(things: dict) -> None:
    likelihood = things["likelihood"]
    for one, words in (
        (things["record"], ("made", "ambient_temperature [K]: 9 readings, every 10 min", "2020-09-13T12:26")),
        (likelihood, ("masses", "air, wall", "ambient, heater", "0 … 29.75 h, 120 instants", "120 of read")),
        (things["design"], ("thermal_network, thermal_diffusion", "ambient_temperature")),
        (hygrokf.smooth(likelihood, masses.VALUES), ("120 instants", "wall")),
        (hygrokf.innovations(likelihood, masses.VALUES), ("120", "read")),
        (hygrokf.bode(likelihood, masses.VALUES), ("read", "ambient, heater")),
    ):
        lines = repr(one).splitlines()
        assert len(lines) <= 12 and max(map(len, lines)) <= 110
        assert all(word in repr(one) for word in words), repr(one)
