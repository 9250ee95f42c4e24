"""Sub-steps of models whose rates vary, chosen along the filter's course: against scipy's stiff integrator,
the truth that made the data, and what halving them changes."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
from builders.scores import check_score
from scipy.integrate import solve_ivp

from hygrokf.engine.timeline import timeline
from hygrokf.estimation.inference import confidence_intervals
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Objective, changes_by_halving, climb, fit_mle
from hygrokf.estimation.rates_fault import RatesFault
from hygrokf.estimation.reference_filter import reference_filter
from hygrokf.physics.expression import where
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import Model, compose
from hygrokf.physics.parameters import Coordinates, Parameter
from hygrokf.texts.fit_codes import FitCode


def positive(name: str, start: float, noise: bool = False) -> Parameter:
    return Parameter(name, "1", start, start * 1e-3, start * 1e3, positive=True, noise=noise)


def one_state(
    rate: Callable, parameters: list[Parameter], mean: float, variance: float, inputs: bool
) -> Model:
    """dx = rate(p, x, u) dt + s dw, y = x + e, e ~ N(0, r²)."""
    network = linear_network(
        "state", [*parameters, positive("s", 1.0, True), positive("r", 0.5, True)], ["x"], ["u"] * inputs,
        lambda p, x, u: {"x": rate(p, x.x, u)}, {"y": lambda p, x, u: (x.x, p.r**2)}, lambda p: {"x": p.s**2},
        lambda p, u: {"x": (mean, variance)},
    )  # fmt: skip
    return compose([network], {"u": "mean"} if inputs else {})


FURNACE = one_state(
    lambda p, x, u: u.u - (x**4 - 300.0**4) / (4 * 300.0**3 * p.tau), [positive("tau", 8.0)], 300.0, 1.0, True
)
CUBIC = one_state(lambda p, x, u: u.u - p.k * x**3, [positive("k", 0.7)], 0.1, 1e-4, True)


def furnace(seed: int) -> Likelihood:
    """A radiating furnace: τ = 10 h at 300 K and 0.2 h at 1,100 K, read every half hour."""
    random = np.random.default_rng(seed)
    u, h = np.repeat(random.choice([0.0, 1500.0], 24), 10), 0.5 / 1000
    x, y = 300.0, np.empty(240)
    for k in range(240):
        for z in random.normal(size=1000 if k else 0).tolist():
            x += h * (u[k] - (x**4 - 300.0**4) / (40.0 * 300.0**3)) + 2.0 * math.sqrt(h) * z
        y[k] = x + random.normal()
    return Likelihood(FURNACE, timeline(FURNACE, 0.5 * np.arange(240), {"u": u}, {"y": y}))


def cubic(seed: int) -> Likelihood:
    """x rises from 0.1, where the rate 3 k x² is 0.03, to 1.6, where it is 7.6, within 30 h."""
    random = np.random.default_rng(seed)
    x, y = 0.1, np.empty(60)
    for k in range(60):
        for z in random.normal(size=500 if k else 0).tolist():
            x += 0.001 * (4.0 - x**3) + 0.05 * math.sqrt(0.001) * z
        y[k] = x + 0.02 * random.normal()
    return Likelihood(CUBIC, timeline(CUBIC, 0.5 * np.arange(60), {"u": np.full(60, 4.0)}, {"y": y}))


def test_bounds_hold_the_truth_where_rates_grow_along_the_course() -> None:
    """The rates at the first state are 250 times as slow as those that follow.  One seed; the coverage over
    many, and of a furnace, is the slow test below."""
    likelihood = cubic(42)
    found = fit_mle(likelihood, count=1)
    assert found.converged and found.discretisation_error < 1e-5, found.message
    bound = confidence_intervals(likelihood, found, ["k"], "wald")["k"]
    assert bound.lower < 1.0 < bound.upper and bound.upper / bound.lower < 1.05
    assert found.loglik == likelihood.value(found.values)
    expected, _ = reference_filter(likelihood, found.values)
    assert found.loglik == pytest.approx(expected, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("made", "name", "truth"), [(furnace, "tau", 10.0), (cubic, "k", 1.0)])
def test_the_bounds_cover(made: Callable, name: str, truth: float) -> None:
    """Of 200, at least 184 (the chance of fewer with a coverage of 0.95 is 0.03) by Wald and by profile."""
    held, estimates, halves = {"wald": 0, "profile": 0}, [], []
    for seed in range(5000, 5200):
        likelihood = made(seed)
        found = fit_mle(likelihood)
        estimates.append(found.values[name])
        for method in held:
            bound = confidence_intervals(likelihood, found, [name], method)[name]
            held[method] += bound.lower <= truth <= bound.upper
            halves.append(0.5 * (bound.upper - bound.lower))
    assert min(held.values()) >= 184, held
    assert np.median(halves) == pytest.approx(1.96 * np.std(estimates), rel=0.2)


def test_the_score_under_held_sub_steps_is_the_central_difference() -> None:
    likelihood = furnace(3)
    likelihood = replace(likelihood, timeline=likelihood.timeline.window(0, 120))
    values = {"tau": 9.0, "s": 2.0, "r": 1.0}
    held = likelihood.scheduled(values)
    assert held.steps_per_instant(values) > 1.5
    check_score(held, values)
    assert held.value(values) == likelihood.value(values)


def test_states_that_act_on_each_other_at_constant_rates_have_a_score() -> None:
    """A noise that follows an input divides their steps; at the first instant no time passes."""
    network = linear_network(
        "pair", [positive("k", 0.7), positive("s", 1.0, True)], ["x", "z"], ["u"],
        lambda p, x, u: {"x": p.k * (x.z - x.x), "z": 0.3 * p.k * (x.x - x.z) - 0.1 * x.z},
        {"y": lambda p, x, u: (x.x, 0.01)}, lambda p, u: {"x": (p.s * u.u) ** 2, "z": 0.0},
        lambda p, u: {"x": (0.0, 1.0), "z": (0.0, 1.0)},
    )  # fmt: skip
    model, random = compose([network], {"u": "linear"}), np.random.default_rng(6)
    line = timeline(
        model, np.arange(20.0), {"u": random.uniform(0.5, 1.0, 20)}, {"y": random.normal(size=20)}
    )
    values = {"k": 0.7, "s": 1.0}
    check_score(Likelihood(model, line).scheduled(values), values)


# -- stiff states --------------------------------------------------------------------------------------------
def relaxation() -> Model:
    """Van der Pol's oscillator with μ = 1000: x' = v, v' = μ (1 − x²) v − x."""
    network = linear_network(
        "oscillator", [Parameter("mu", "1", 1000.0, 1.0, 1e6, positive=True)], ["x", "v"], [],
        lambda p, x, u: {"x": x.v, "v": p.mu * (1.0 - x.x**2) * x.v - x.x},
        {"y": lambda p, x, u: (x.x, 0.01)}, lambda p: {"x": 0.0, "v": 0.0},
        lambda p, u: {"x": (2.0, 0.0), "v": (0.0, 0.0)},
    )  # fmt: skip
    return compose([network])


def test_a_stiff_oscillator_is_scipys() -> None:
    """Between the jumps, a thousandth of a unit long, x creeps for 800: rates of 3,000 and of 0.001."""
    model, times = relaxation(), np.array([0.0, 10.0, 400.0, 800.0, 1000.0])
    likelihood = Likelihood(model, timeline(model, times, {}, {"y": np.full(5, np.nan)}))
    found = likelihood.trace({"mu": 1000.0}).mean
    expected = solve_ivp(
        lambda t, z: [z[1], 1000.0 * (1.0 - z[0] ** 2) * z[1] - z[0]], (0.0, 1000.0), [2.0, 0.0], "Radau",
        times, rtol=1e-10, atol=1e-12,
    ).y.T  # fmt: skip
    # at 800 the jump is near, and the speed tells the time of it five times as sharply as the position
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    np.testing.assert_allclose(found[:, 0], expected[:, 0], rtol=1e-6)
    assert likelihood.steps_per_instant({"mu": 1000.0}) < 5000.0  # a stable explicit rule takes 300,000


def test_a_state_that_leaves_every_bound_is_refused_with_its_step() -> None:
    """dx = x² reaches infinity at t = 1."""
    model = one_state(lambda p, x, u: p.k * x * x, [positive("k", 1.0)], 1.0, 0.01, False)
    line = timeline(model, np.array([0.0, 0.5, 2.0]), {}, {"y": np.full(3, np.nan)}, origin_s=1.6e9)
    with pytest.raises(
        RatesFault, match=r"found faster ones of x in the step of 90 min until 2020-09.* k = 1"
    ):
        Likelihood(model, line).value({"k": 1.0, "s": 0.1, "r": 0.1})


def test_a_kink_is_not_passed_over() -> None:
    """The rate has a kink at x = 1, behind the last node of a whole step; there the covariance shrinks."""
    model = one_state(
        lambda p, x, u: 1.0 + where(x > 1.0, -5.0 * p.k * (x - 1.0), 0.0),
        [positive("k", 1.0)],
        0.05,
        0.01,
        False,
    )
    line = timeline(model, np.array([0.0, 1.0]), {}, {"y": np.full(2, np.nan)})
    values = {"k": 1.0, "s": 0.1, "r": 0.1}
    likelihood = Likelihood(model, line)
    # the covariance P = 0.0195 at x = 1, and then dP/dt = −10 P + s²
    rest = 0.05
    expected = 0.001 + (0.01 + 0.95 * 0.01 - 0.001) * math.exp(-10.0 * rest)
    assert likelihood.trace(values).prior_covariance[1, 0, 0] == pytest.approx(expected, rel=2e-3)
    assert likelihood.steps_per_instant(values) > 3.0


# -- the schedule as a value ---------------------------------------------------------------------------------
def test_a_schedule_is_a_value(joint: object) -> None:
    held = joint.likelihood.scheduled(joint.values)
    again = pickle.loads(pickle.dumps(held.schedule))
    for name, array in vars(held.schedule).items():
        np.testing.assert_array_equal(getattr(again, name), array)
    assert replace(joint.likelihood, schedule=again).value(joint.values) == held.value(joint.values)
    moved: Mapping[str, float] = joint.values | {"hygric_k": 0.33}
    assert held.value(moved) == pytest.approx(joint.likelihood.value(moved), abs=1e-4)
    finer = replace(joint.likelihood, tolerance=1e-10)
    assert held.value(joint.values) == pytest.approx(finer.value(joint.values), abs=1e-5)
    assert held.halved(joint.values).value(joint.values) == pytest.approx(held.value(joint.values), abs=1e-5)
    with pytest.raises(ValueError, match="expected the sub-steps of 10 instants, found those of"):
        replace(held, timeline=joint.timeline.window(0, 10))


def test_the_shift_by_halved_sub_steps_is_that_of_a_refit() -> None:
    """Far shorter sub-steps move the estimate by as much as its score and curvature promise."""
    likelihood = replace(cubic(44), tolerance=0.1)
    objective = Objective(likelihood, Coordinates(likelihood.parameters))
    optimum = climb(objective, objective.coordinates.start({"s": 0.05, "r": 0.02}))
    change, shift = changes_by_halving(objective, optimum)
    exact = Objective(replace(likelihood, tolerance=1e-9), objective.coordinates)
    refitted = climb(exact, optimum.z, tolerance=1e-13)
    moved, curvature = refitted.z - optimum.z, exact.information(refitted.z).information
    # half the length removes 15/16 of a fourth-order error
    assert shift == pytest.approx(math.sqrt(moved @ curvature @ moved), rel=0.2)
    assert change == pytest.approx(abs(exact.value(optimum.z) - optimum.objective), rel=0.2)
    assert 1e-4 < shift < change


def test_a_coarse_tolerance_is_told() -> None:
    found = fit_mle(replace(cubic(44), tolerance=0.1), count=1)
    assert found.discretisation_error > 1e-3
    assert found.message.code is FitCode.STEPS_TOO_LONG


def test_an_exact_model_has_no_schedule(thermal: object) -> None:
    likelihood = thermal.likelihood
    assert likelihood.scheduled(thermal.values) is likelihood
    assert likelihood.halved(thermal.values) is likelihood
