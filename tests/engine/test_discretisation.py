"""One step of the moments: exact for linear networks, of fourth order for the bilinear cabinet.

Oracles: python-control (zero-order hold), the augmented matrix exponential (linear hold), Van Loan's matrix
exponential (noise), scipy's integrator on separately written moment equations (bilinear model).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import control
import numpy as np
import pytest
from builders.linear_oracles import linear_hold, van_loan

from hygrokf.engine.discretisation import CONSTANT_SHARE, Step, step
from hygrokf.engine.timeline import timeline
from hygrokf.estimation.likelihood import Gaussian, Likelihood
from hygrokf.physics.expression import Graph
from hygrokf.physics.matrices import congruence
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import compose
from hygrokf.physics.parameters import Parameter

EXACT = 1e-12
SECOND, QUARTER, DAY, FORTNIGHT = 1.0 / 3600.0, 0.25, 24.0, 336.0


def network(seed: int, n: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B, Q of a random chain of heat stores: time constants from minutes to weeks [1/h]."""
    random = np.random.default_rng(seed)
    capacity = 10.0 ** random.uniform(-1.0, 2.0, n)
    conductance = np.zeros((n, n))
    for i in range(n):
        for j in range(i):
            conductance[i, j] = conductance[j, i] = 10.0 ** random.uniform(-1.0, 0.5)
    outside = 10.0 ** random.uniform(-1.0, 0.5, n)
    a = (conductance - np.diag(conductance.sum(axis=1) + outside)) / capacity[:, None]
    b = np.column_stack([outside, random.uniform(0.0, 1.0, n)]) / capacity[:, None]
    return a, b, np.diag(random.uniform(0.1, 2.0, n) ** 2)


def zero_order(a: np.ndarray, b: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """F and the gain by python-control."""
    made = control.sample_system(control.ss(a, b, np.eye(len(a)), np.zeros_like(b)), h, method="zoh")
    return made.A, made.B


def close(found: np.ndarray, expected: np.ndarray, tolerance: float = EXACT) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * max(1.0, np.abs(expected).max()))


def traced_step(a: np.ndarray, q: np.ndarray, b: np.ndarray, h: float, hold: str) -> dict[str, np.ndarray]:
    """One sub-step of the network, traced and computed by the interpreter; gains from its response to each
    input."""
    n, m = b.shape
    graph = Graph()
    x = [graph.symbol(f"x{i}") for i in range(n)]
    cov = [[graph.symbol(f"P{max(i, j)}{min(i, j)}") for j in range(n)] for i in range(n)]
    end = {f"u{j}": graph.symbol(f"end{j}") for j in range(m)}
    start = end if hold == "mean" else {f"u{j}": graph.symbol(f"start{j}") for j in range(m)}

    def drift(x: list, u: dict) -> list:
        return [
            sum(a[i, j] * x[j] for j in range(n)) + sum(b[i, j] * u[f"u{j}"] for j in range(m))
            for i in range(n)
        ]

    names = [f"x{i}" for i in range(n)] + [f"{s}{j}" for s in ("start", "end") for j in range(m)]
    noise = [[float(v) for v in row] for row in q]
    made = step(graph, drift, lambda u: noise, x, cov, start, end, graph.symbol("h"), names)
    reach = np.abs(np.linalg.eigvals(a)).max() * h
    whole = doubled(graph, made, {"h": h}, max(0, math.ceil(math.log2(reach / CONSTANT_SHARE))))

    def mean(**given: float) -> np.ndarray:
        return np.array(graph.evaluate(made.mean, dict.fromkeys(names, 0.0) | given | whole), dtype=float)

    prior = np.diag(np.arange(1.0, n + 1))
    values = whole | {f"P{i}{j}": prior[i, j] for i in range(n) for j in range(i + 1)}
    return {
        "F": np.array([graph.evaluate(row, whole) for row in made.transition], dtype=float),
        "response": np.column_stack([mean(**{f"x{j}": 1.0}) for j in range(n)]),
        "start": np.column_stack([mean(**{f"start{j}": 1.0}) for j in range(m)]),
        "end": np.column_stack([mean(**{f"end{j}": 1.0}) for j in range(m)]),
        "Q": np.array([graph.evaluate(row, whole) for row in made.noise], dtype=float),
        "P": np.array([graph.evaluate(row, values) for row in made.covariance], dtype=float) if m else prior,
        "prior": prior,
    }


def doubled(graph: Graph, made: Step, known: dict[str, float], times: int) -> dict[str, float]:
    """The known numbers, and those of a constant-rate step's matrices by the names of their symbols."""
    first, twice = made.early
    names = [graph.nodes[e.index][1] for e in first.into]
    now = graph.evaluate(first.block, known | {"share": 2.0**-times})
    for _ in range(times):
        now = graph.evaluate(twice.block, dict(zip(names, now, strict=True)))
    return known | dict(zip(names, now, strict=True))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("reach", [1e-6, 0.2, 1.0, 300.0])
def test_one_step_of_a_network_is_exact(seed: int, reach: float) -> None:
    a, b, q = network(seed)
    h = reach / np.abs(np.linalg.eigvals(a)).max()
    f, gain = zero_order(a, b, h)
    found = traced_step(a, q, b, h, "mean")
    close(found["F"], f)
    close(found["response"], f)
    close(found["end"], gain)
    close(found["Q"] / h, van_loan(a, q, h)[1] / h)
    close(found["P"], f @ found["prior"] @ f.T + van_loan(a, q, h)[1])
    found = traced_step(a, q, b, h, "linear")
    first, last = linear_hold(a, b, h)
    close(found["start"], first)
    close(found["end"], last)


def linear_likelihood(
    a: np.ndarray, b: np.ndarray, q: np.ndarray, h: float, u: np.ndarray, hold: str
) -> Likelihood:
    """The network on two instants h [h] apart, inputs (2, m)."""
    n, m = b.shape
    states = [f"x{i}" for i in range(n)]
    made = linear_network(
        "network",
        [Parameter("scale", "1", 1.0, 0.1, 10.0)],
        states,
        [f"u{j}" for j in range(m)],
        lambda p, x, u: {
            s: sum(float(a[i, j]) * p.scale * getattr(x, states[j]) for j in range(n))
            + sum(float(b[i, j]) * getattr(u, f"u{j}") for j in range(m))
            for i, s in enumerate(states)
        },
        {"y": lambda p, x, u: (x.x0, 1.0)},
        lambda p: {s: float(q[i, i]) for i, s in enumerate(states)},
        lambda p, u: {s: (0.0, 1.0) for s in states},
    )
    model = compose([made], {f"u{j}": hold for j in range(m)})
    inputs = {f"u{j}": u[:, j] for j in range(m)}
    return Likelihood(model, timeline(model, np.array([0.0, h]), inputs, {"y": np.full(2, np.nan)}))


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("h", [SECOND, QUARTER, DAY, FORTNIGHT])
def test_compiled_steps_from_a_second_to_a_fortnight_are_exact(seed: int, h: float) -> None:
    a, b, q = network(seed)
    n, m = b.shape
    start = Gaussian(np.zeros(n), np.zeros((n, n)))
    # a step of a second is known to 0.2 µs of the time stamp: the filter rounds step lengths to a microsecond
    length = round(h * 3.6e9) / 3.6e9

    def run(
        u: np.ndarray, hold: str, mean: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        likelihood = linear_likelihood(a, b, q, h, u, hold)
        found = likelihood.trace(
            {"scale": 1.0}, start=Gaussian(np.zeros(n) if mean is None else mean, start.covariance)
        )
        return found.transition[1], found.prior_mean[1], found.prior_covariance[1]

    f, gain = zero_order(a, b, length)
    transition, _, noise = run(np.zeros((2, m)), "mean")
    # rounding of the oracle's own squarings adds to the 1e-12
    rounding = EXACT + 2e-16 * 20 * np.abs(a).max() * length
    close(transition, f, rounding)
    close(noise, van_loan(a, q, length)[1], rounding)
    first, last = linear_hold(a, b, length)
    for j in range(m):
        unit = np.eye(m)[j]
        close(run(np.array([0 * unit, unit]), "mean")[1], gain[:, j], rounding)
        close(run(np.array([unit, 0 * unit]), "linear")[1], first[:, j], rounding)
        close(run(np.array([0 * unit, unit]), "linear")[1], last[:, j], rounding)
    mean = np.arange(1.0, n + 1)
    close(run(np.zeros((2, m)), "linear", mean)[1], f @ mean, rounding)


def test_congruence_is_symmetric_and_numpys() -> None:
    random = np.random.default_rng(1)
    f, p = random.normal(size=(3, 3)), np.cov(random.normal(size=(3, 9)))
    found = np.array(congruence(f.tolist(), p.tolist(), np.eye(3).tolist()))
    np.testing.assert_allclose(found, f @ p @ f.T + np.eye(3), rtol=1e-13)
    np.testing.assert_array_equal(found, found.T)


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
    "two clocks": np.union1d(np.arange(0, 2400, 15), np.arange(3, 2400, 10)) / 60.0,
}


@pytest.mark.parametrize("kind", ["joint", "cascade"])
@pytest.mark.parametrize("time", CLOCKS.values(), ids=CLOCKS)
def test_splitting_one_step_leaves_the_likelihood(make_case: Callable, kind: str, time: np.ndarray) -> None:
    case = make_case(kind, time, 3, missing=0.05)
    base = case.likelihood.value(case.values)
    inner = time[:-1] + 0.37 * np.diff(time)
    changes = [case.split(inner[k : k + 1]).likelihood.value(case.values) - base for k in range(len(inner))]
    assert np.max(np.abs(changes)) < SPLIT


@pytest.mark.parametrize("step_h", [0.25, 1.0])
@pytest.mark.parametrize("parts", [2, 3, 8])
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
