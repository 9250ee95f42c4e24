"""Matrices, Bode diagram and step response of a network of one's own, against python-control, closed forms
and plain random draws."""

from __future__ import annotations

import math

import control
import numpy as np
import pytest
from builders import masses
from numpy.testing import assert_allclose

import hygrokf
from hygrokf.estimation.optimiser import Estimate
from hygrokf.estimation.subject import covariances
from hygrokf.identification.fit import Fit
from hygrokf.modelling.design import Design

DRAWS = 100_000
"""A percentile at 2.5 % of N normal draws scatters by 0.68/√N of the band's width, so by 0.21 %: the 2 % that
the bands must keep are nine times that, and what is left of them is the error of the band itself."""
KEPT = 0.02


@pytest.fixture(scope="module")
def few() -> tuple[hygrokf.Likelihood, Estimate]:
    """Readings of two days: the parameters are known to some 5 to 30 %, and the bands are not symmetric."""
    random = np.random.default_rng(7)
    time = 0.25 * np.arange(190.0)
    likelihood = masses.likelihood(time, *masses.simulated(time, random))
    return likelihood, hygrokf.fit_mle(likelihood, masses.VALUES, count=1)


@pytest.fixture(scope="module")
def drawn(few: tuple) -> dict[str, np.ndarray]:
    """Parameters drawn from the covariance of the estimate's coordinates, by numpy alone."""
    _, estimate = few
    known = covariances(*few)
    moves = np.random.default_rng(5).multivariate_normal(np.zeros(len(known.names)), known.wider, DRAWS)
    found = {}
    for name, move in zip(known.names, moves.T, strict=True):
        p = estimate.coordinates.parameter(name)
        value = estimate.values[name]
        found[name] = np.clip(value * np.exp(move) if p.positive else value + move, p.lower, p.upper)
    return found


def closer(found: tuple, draws: np.ndarray) -> None:
    """The bounds (T,) are within KEPT of the band's width of the draws' (N, T) percentiles."""
    low, high = np.quantile(draws, [0.025, 0.975], axis=0)
    width = high - low
    assert np.all(np.abs(found[1] - low) <= KEPT * width)
    assert np.all(np.abs(found[2] - high) <= KEPT * width)


def test_the_exported_system_is_the_network(few: tuple) -> None:
    likelihood, estimate = few
    system = hygrokf.to_statespace(likelihood, estimate)
    a, b = masses.matrices(estimate.values)
    assert_allclose(system.A, a, rtol=1e-13)
    assert_allclose(system.B, b, rtol=1e-13)
    assert_allclose(system.C, [[1.0, 0.0]])
    assert_allclose(system.D, [[0.0, 0.0]])
    assert system.state_labels == list(masses.STATES) and system.input_labels == ["ambient", "heater"]
    assert system.output_labels == ["read"]
    sampled = control.sample_system(system, 0.25, "zoh")
    assert_allclose(sampled.A, likelihood.trace(estimate.values).transition[5], rtol=1e-11)


def test_a_nonlinear_network_is_linearised_where_it_is_asked_to() -> None:
    """x' = −k x³ + u x, y = x² + 3 u: the derivatives by hand."""
    made = hygrokf.linear_network(
        "cubic",
        [hygrokf.Parameter("k", "1/h", 0.5, 0.01, 10.0, positive=True)],
        states=["x"],
        inputs=["u"],
        rates=lambda p, x, u: {"x": u.u * x.x - p.k * x.x**3},
        outputs={"y": lambda p, x, u: (x.x**2 + 3.0 * u.u, 0.01)},
        intensities=lambda p: {"x": 0.01},
        initial=lambda p, u: {"x": (1.0, 0.1)},
    )
    model = hygrokf.compose([made], {"u": "mean"})
    time = np.arange(5.0)
    likelihood = hygrokf.Likelihood(model, hygrokf.timeline(model, time, {"u": 0.2 + 0.0 * time}, {}))
    found = hygrokf.to_statespace(likelihood, {"k": 0.7}, state={"x": 1.3}, inputs={"u": 0.4})
    assert found.A[0, 0] == pytest.approx(0.4 - 3.0 * 0.7 * 1.3**2, rel=1e-14)
    assert found.B[0, 0] == pytest.approx(1.3, rel=1e-14)
    assert (found.C[0, 0], found.D[0, 0]) == (pytest.approx(2.6, rel=1e-14), pytest.approx(3.0))
    usual = hygrokf.to_statespace(likelihood, {"k": 0.7})
    at = likelihood.trace({"k": 0.7}).mean.mean()
    assert usual.A[0, 0] == pytest.approx(0.2 - 2.1 * at**2, rel=1e-12)
    with pytest.raises(ValueError, match="state: expected names of x, found z"):
        hygrokf.to_statespace(likelihood, {"k": 0.7}, state={"z": 1.0})


def test_the_frequency_response_is_that_of_python_control(few: tuple) -> None:
    found = hygrokf.bode(*few)
    system = hygrokf.to_statespace(*few)
    expected = control.frequency_response(system, found.omega)
    for j, name in enumerate(("ambient", "heater")):
        assert_allclose(found.magnitude["read", name][0], expected.magnitude[0, j], rtol=1e-10)
        phase = np.degrees(np.unwrap(expected.phase[0, j]))
        assert_allclose(found.phase_deg["read", name][0], phase, atol=1e-8)
    poles = np.abs(control.poles(system))
    assert found.omega[0] <= poles.min() / 9.9 and found.omega[-1] >= 9.9 * poles.max()


def test_the_step_response_is_that_of_python_control(few: tuple) -> None:
    found = hygrokf.step_response(*few)
    expected = control.step_response(hygrokf.to_statespace(*few), found.time_h)
    for j, name in enumerate(("ambient", "heater")):
        assert_allclose(found.value["read", name][0], expected.outputs[0, j], rtol=1e-8, atol=1e-10)
    assert found.value["read", "ambient"][0][-1] == pytest.approx(1.0, abs=0.01)


def test_bode_bands_are_the_percentiles_of_draws(few: tuple, drawn: dict) -> None:
    likelihood, estimate = few
    found = hygrokf.bode(likelihood, estimate, np.array([0.02, 0.2, 2.0, 20.0]))
    a, b = masses.matrices(drawn)
    exact = masses.matrices(estimate.values)
    for j, name in enumerate(("ambient", "heater")):
        gains, own = [], []
        for omega in found.omega:
            for (one, two), into in (((a, b), gains), (exact, own)):
                det = (1j * omega - one[..., 0, 0]) * (1j * omega - one[..., 1, 1])
                det = det - one[..., 0, 1] * one[..., 1, 0]  # Cramer's rule for the first state
                into.append((1j * omega - one[..., 1, 1]) * two[..., 0, j] / det)
        gain = np.array(gains).T
        closer(found.magnitude["read", name], np.abs(gain))
        phase = np.degrees(np.unwrap(np.angle(own)) + np.angle(gain / np.array(own)))
        closer(found.phase_deg["read", name], phase)


def test_step_bands_are_the_percentiles_of_draws(few: tuple, drawn: dict) -> None:
    found = hygrokf.step_response(*few, np.linspace(0.0, 20.0, 41))
    places = [1, 3, 10, 40]
    a, b = masses.matrices(drawn)
    values, vectors = np.linalg.eig(a)
    for j, name in enumerate(("ambient", "heater")):
        weight = np.linalg.solve(vectors, b[..., :, j, None])[..., 0]
        rows = [
            ((vectors[:, 0, :] * weight) * np.expm1(values * found.time_h[k]) / values).sum(axis=1)
            for k in places
        ]
        closer(tuple(one[places] for one in found.value["read", name]), np.array(rows).T)


def test_values_without_uncertainty_have_no_bands(few: tuple) -> None:
    likelihood, estimate = few
    found = hygrokf.step_response(likelihood, estimate.values)
    assert (
        np.isnan(found.value["read", "heater"][1]).all()
        and np.isfinite(found.value["read", "heater"][0]).all()
    )
    with pytest.raises(ValueError, match="evenly spaced times"):
        hygrokf.step_response(likelihood, estimate, np.array([0.0, 1.0, 5.0]))
    with pytest.raises(ValueError, match="omega: expected frequencies above 0 rad/h, found -1"):
        hygrokf.bode(likelihood, estimate, np.array([-1.0, 1.0]))


def test_an_integral_and_an_oscillation_have_responses() -> None:
    """A double integral has equal eigenvalues without a full set of eigenvectors: t²/2 after a step."""
    made = hygrokf.linear_network(
        "carriage",
        [hygrokf.Parameter("gain", "1", 2.0, 0.1, 10.0, positive=True)],
        states=["speed", "place"],
        inputs=["push"],
        rates=lambda p, x, u: {"speed": p.gain * u.push, "place": x.speed},
        outputs={"read": lambda p, x, u: (x.place, 0.01)},
        intensities=lambda p: {"speed": 0.01, "place": 0.0},
        initial=lambda p, u: {"speed": (0.0, 1.0), "place": (0.0, 1.0)},
    )
    model = hygrokf.compose([made], {"push": "mean"})
    time = np.arange(9.0)
    likelihood = hygrokf.Likelihood(
        model, hygrokf.timeline(model, time, {"push": 0.0 * time}, {"read": time})
    )
    step = hygrokf.step_response(likelihood, {"gain": 3.0})
    assert_allclose(step.value["read", "push"][0], 1.5 * step.time_h**2, rtol=1e-12, atol=1e-12)
    swing = hygrokf.bode(likelihood, {"gain": 3.0})
    assert_allclose(swing.magnitude["read", "push"][0], 3.0 / swing.omega**2, rtol=1e-12)


def test_a_fit_answers_with_its_thermal_network() -> None:
    """At rest a kelvin of ambient and of heat release warm the air by one; the poles are −1/τ."""
    mechanisms = (("thermal_network", {}), ("thermal_diffusion", {}))
    design = Design(mechanisms=(*mechanisms, ("temperature_sensor", {"accuracy": 0.0})))
    values = {p.name: p.start for p in design.model.parameters}
    values |= {"thermal_time_constant": 1.7, "resistance_ratio": 0.83}
    fit = Fit("made", design, values)
    step = hygrokf.step_response(fit)
    value = step.value["cabinet_air_temperature", "heat_release"][0]
    assert_allclose(value, -np.expm1(-step.time_h / 1.7), rtol=1e-10, atol=1e-12)
    gain = hygrokf.bode(fit, omega=np.array([1.0 / 1.7])).magnitude["cabinet_air_temperature", "heat_release"]
    assert gain[0][0] == pytest.approx(1.0 / math.sqrt(2.0), rel=1e-12)
    with pytest.raises(ValueError, match=r"bode\(fit.likelihood\(record\), fit.values"):
        hygrokf.bode(fit, state={"converter_temperature": 300.0})
