"""One step of the moments: exact for linear networks, of fourth order for the bilinear cabinet.

Oracles: python-control (zero-order hold), the augmented matrix exponential (linear hold), Van Loan's matrix
exponential (noise), scipy's integrator on separately written moment equations (bilinear model).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import control
import numpy as np
import pytest
from builders.linear_oracles import linear_hold, van_loan

from hygrokf.engine.timeline import timeline
from hygrokf.estimation.likelihood import Gaussian, Likelihood, Trace
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import Model, compose
from hygrokf.physics.parameters import Parameter

EXACT = 1e-12
SECOND, QUARTER, DAY, FORTNIGHT = 1.0 / 3600.0, 0.25, 24.0, 336.0


def network(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B [1/h] and roots of the noise of random heat stores: time constants from minutes to weeks."""
    random, n = np.random.default_rng(seed), 3
    capacity = 10.0 ** random.uniform(-1.0, 2.0, n)
    conductance = np.zeros((n, n))
    for i in range(n):
        for j in range(i):
            conductance[i, j] = conductance[j, i] = 10.0 ** random.uniform(-1.0, 0.5)
    outside = 10.0 ** random.uniform(-1.0, 0.5, n)
    a = (conductance - np.diag(conductance.sum(axis=1) + outside)) / capacity[:, None]
    b = np.column_stack([outside, random.uniform(0.0, 1.0, n)]) / capacity[:, None]
    return a, b, random.uniform(0.1, 2.0, n)


def exact(found: np.ndarray, expected: np.ndarray, rounding: float) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=rounding * max(1.0, np.abs(expected).max()))


@pytest.fixture(scope="module")
def stores() -> Model:
    """Three heat stores whose matrices are parameters; the first input is held, the second runs straight."""
    states, inputs = ("x0", "x1", "x2"), ("u0", "u1")
    into = {s: [f"{s}_{one}" for one in (*states, *inputs, "noise")] for s in states}
    made = linear_network(
        "stores",
        [Parameter(name, "1", 0.0, -1e3, 1e3) for names in into.values() for name in names],
        states,
        inputs,
        lambda p, x, u: {
            s: sum(getattr(p, f"{s}_{one}") * getattr(x, one) for one in states)
            + sum(getattr(p, f"{s}_{one}") * getattr(u, one) for one in inputs)
            for s in states
        },
        {"y": lambda p, x, u: (x.x0, 1.0)},
        lambda p: {s: getattr(p, f"{s}_noise") ** 2 for s in states},
        lambda p, u: {s: (0.0, 1.0) for s in states},
    )
    return compose([made], {"u0": "mean", "u1": "linear"})


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("h", [SECOND, QUARTER, DAY, FORTNIGHT])
def test_compiled_steps_from_a_second_to_a_fortnight_are_exact(stores: Model, seed: int, h: float) -> None:
    a, b, q = network(seed)
    values = dict(zip([p.name for p in stores.parameters], np.column_stack([a, b, q]).ravel(), strict=True))
    # a step of a second is known to 0.2 µs of the time stamp: the filter rounds step lengths to a microsecond
    length = round(h * 3.6e9) / 3.6e9
    prior = np.diag([1.0, 2.0, 3.0])

    def run(mean: Sequence[float], begin: Sequence[float], end: Sequence[float]) -> Trace:
        inputs = {name: np.array([begin[i], end[i]]) for i, name in enumerate(stores.inputs)}
        line = timeline(stores, np.array([0.0, h]), inputs, {"y": np.full(2, np.nan)})
        return Likelihood(stores, line).trace(values, start=Gaussian(np.array(mean), prior))

    sampled = control.sample_system(control.ss(a, b, np.eye(3), np.zeros((3, 2))), length, method="zoh")
    first, last = linear_hold(a, b, length)
    noise = van_loan(a, np.diag(q**2), length)[1]
    # rounding of the oracle's own squarings adds to the 1e-12
    rounding = EXACT + 2e-16 * 20 * np.abs(a).max() * length
    at_rest = run((1.0, 2.0, 3.0), (0.0, 0.0), (0.0, 0.0))
    exact(at_rest.transition[1], sampled.A, rounding)
    exact(at_rest.prior_mean[1], sampled.A @ [1.0, 2.0, 3.0], rounding)
    gained = at_rest.prior_covariance[1] - sampled.A @ prior @ sampled.A.T
    exact(gained / length, noise / length, rounding / length)
    still = (0.0, 0.0, 0.0)
    exact(run(still, (0.0, 0.0), (1.0, 0.0)).prior_mean[1], sampled.B[:, 0], rounding)
    exact(run(still, (0.0, 1.0), (0.0, 0.0)).prior_mean[1], first[:, 1], rounding)
    exact(run(still, (0.0, 0.0), (0.0, 1.0)).prior_mean[1], last[:, 1], rounding)


# -- the bilinear cabinet ------------------------------------------------------------------------------------
def test_the_bilinear_step_converges_with_fourth_order(make_case: Callable, joint_moments: Callable) -> None:
    """Halving the sub-steps divides the errors of the mean and of the covariance by 16."""
    case = make_case("joint", np.array([0.0, 0.25]), 5, missing=1.0)
    values = case.values | {"hygric_k": 0.4}
    names = case.model.states
    mean = np.array(
        [{"converter_temperature": 296.0, "heat_disturbance": 1.0, "vapour": 9.0}.get(n, 0.4) for n in names]
    )
    root = np.array([[0.5, 0, 0, 0], [0.2, 0.6, 0, 0], [0.1, 0.1, 0.5, 0], [0.05, -0.1, 0.2, 0.3]])
    start = Gaussian(mean, root @ root.T)
    expected = joint_moments(case, values)(1, start.mean, start.covariance)
    errors = []
    for parts in (2, 4, 8, 16):  # each of them one sub-step
        fine = case.split(0.25 * np.arange(1, parts) / parts)
        found = Likelihood(fine.model, fine.timeline, tolerance=math.inf).trace(values, start=start)
        pair = (found.prior_mean[-1], found.prior_covariance[-1])
        errors.append([np.max(np.abs(f - e)) for f, e in zip(pair, expected, strict=True)])
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all((orders > 3.7) & (orders < 4.6)), (errors, orders)
    assert np.max(errors[0]) < 1e-5


SPLIT = 1e-6  # the stated error of the sub-steps


CLOCKS = {
    "quarters": 0.25 * np.arange(200),
    "hours": 1.0 * np.arange(200),
    # a logger's quarters and ten-minute power three minutes late: steps of two to ten minutes
    "two clocks": np.union1d(np.arange(0, 1800, 15), np.arange(3, 1800, 10)) / 60.0,
}


@pytest.mark.parametrize(
    ("kind", "clock"), [("joint", "hours"), ("joint", "two clocks"), ("cascade", "quarters")]
)
def test_splitting_one_step_leaves_the_likelihood(make_case: Callable, kind: str, clock: str) -> None:
    time = CLOCKS[clock]
    case = make_case(kind, time, 3, missing=0.05)
    base = case.likelihood.value(case.values)
    inner = (time[:-1] + 0.37 * np.diff(time))[::5]
    changes = [case.split(inner[k : k + 1]).likelihood.value(case.values) - base for k in range(len(inner))]
    assert np.max(np.abs(changes)) < SPLIT


@pytest.mark.parametrize(("step_h", "parts"), [(0.25, 3), (1.0, 2), (1.0, 8)])
def test_splitting_every_step_leaves_the_likelihood(make_case: Callable, step_h: float, parts: int) -> None:
    """Changes of the steps add up: the mean change of a step stays below the stated error."""
    case = make_case("joint", step_h * np.arange(200), 3, missing=0.05)
    time = case.timeline.time
    inner = np.concatenate([time[:-1] + step_h * i / parts for i in range(1, parts)])
    change = case.split(inner).likelihood.value(case.values) - case.likelihood.value(case.values)
    assert abs(change) / len(time) < SPLIT


def test_splitting_steps_of_a_linear_model_changes_rounding_only(make_case: Callable) -> None:
    case = make_case("thermal", 0.25 * np.arange(200), 3, missing=0.05)
    inner = case.timeline.time[:-1] + 0.1
    change = case.split(inner).likelihood.value(case.values) - case.likelihood.value(case.values)
    assert abs(change) < 1e-8
