"""Models with many states: loops over matrices against straight-line code, dense algebra and statsmodels."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from statsmodels.tsa.statespace.kalman_filter import KalmanFilter

from hygrokf.engine import wide_recursion
from hygrokf.engine.timeline import Timeline, timeline
from hygrokf.engine.traced_filter import traced
from hygrokf.engine.wide_recursion import WideRecursion, recursion_of
from hygrokf.estimation.likelihood import Gaussian, Likelihood, Trace
from hygrokf.estimation.smoother import smoothed_states, to_filterpy
from hygrokf.physics.expression import exp
from hygrokf.physics.holds import REGIME
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import Mechanism, Model, compose
from hygrokf.physics.parameters import Parameter

AGREE = 1e-10
"""Both ways round to 1e-15 at every instant; what they sum differs by a few hundred of these."""


def positive(name: str, value: float, noise: bool = False) -> Parameter:
    return Parameter(name, "1", value, value * 1e-3, value * 1e3, positive=True, noise=noise)


# -- all features of a model at once, with few states --------------------------------------------------------
HOLDS = {"u": "previous", "v": "linear", "w": "mean", "wind": REGIME}


def small(curved: bool = False) -> Mechanism:
    """Two states with inputs of every hold, a loss and a noise that depend on a regime; readings of a sum and
    of a state beyond the inputs, or of an exponential."""
    names = [("a", 0.7), ("b", 0.4), ("s", 0.3), ("r", 0.2)]

    def rates(p, x, u):
        return {
            "x1": p.a * (x.x2 - x.x1) + p.b * u.u + u.w * u.v,
            "x2": 0.3 * x.x1 - (p.b + u.wind) * (x.x2 - u.v),
        }

    outputs = {
        "sum": lambda p, x, u: (x.x1 + p.b * x.x2, p.r**2),
        "beyond": lambda p, x, u: (x.x2 + 0.3 * u.u + u.v, p.r**2 * (1.0 + u.wind)),
    }
    if curved:
        outputs = {"curved": lambda p, x, u: (x.x1 + exp(0.2 * x.x2), p.r**2)}
    return linear_network(
        "small",
        [positive(name, value, noise=name in "sr") for name, value in names],
        ["x1", "x2"],
        list(HOLDS),
        rates,
        outputs,
        lambda p, u: {"x1": p.s**2, "x2": 0.1 * p.s * p.a * (1.0 + u.wind)},
        lambda p, u: {"x1": (p.b, p.r), "x2": (u.u, 2.0 + p.s)},
    )


def a_run(model: Model, count: int = 60, seed: int = 1, far_h: float = 0.0) -> Timeline:
    """Irregular instants, readings at two thirds, restarts of the running means, one gap of the inputs."""
    random = np.random.default_rng(seed)
    time_h = np.cumsum(random.uniform(0.01, 1.5, count))
    time_h[count // 2 :] += far_h
    inputs = {name: random.normal(size=count).round(1) for name in ("u", "v", "w")}
    inputs["wind"] = random.choice([0.0, 0.5, 2.0], count)
    readings = {
        name: np.where(random.random(count) < 1 / 3, np.nan, random.normal(size=count))
        for name in model.outputs
    }
    resets = {name: random.random(count) < 0.3 for name in model.averaged}
    ends = np.arange(count) == count // 3
    return timeline(model, time_h, inputs, readings, resets, ends=ends)


def both_ways(
    model: Model, line: Timeline, initial: str | Gaussian = "prior"
) -> tuple[Likelihood, Likelihood]:
    """The likelihood by loops over matrices and by straight-line code."""
    one, other = Likelihood(model, line, initial), Likelihood(model, line, initial)
    vars(one)["recursion"], vars(other)["recursion"] = WideRecursion(model), traced(model)
    return one, other


def check_same(one: Likelihood, other: Likelihood, values: dict[str, float]) -> None:
    assert one.value(values) == pytest.approx(other.value(values), rel=AGREE)
    (a, score), (b, expected) = one.score(values), other.score(values)
    assert a == pytest.approx(b, rel=AGREE)
    assert_allclose(score, expected, rtol=AGREE, atol=AGREE * np.abs(expected).max())
    directions = np.random.default_rng(0).normal(size=(len(values), 9))  # more than one block of lanes
    for name in ("loglik", "score", "information", "scores"):
        found, expected = (
            getattr(way.sensitivities(values, directions, each=True), name) for way in (one, other)
        )
        assert_allclose(found, expected, rtol=AGREE, atol=AGREE * np.abs(expected).max(), err_msg=name)
    for found, expected in zip(
        one.residuals(values, directions), other.residuals(values, directions), strict=True
    ):
        assert_allclose(found, expected, rtol=AGREE, atol=AGREE)
    check_same_trace(one.trace(values), other.trace(values))


def check_same_trace(found: Trace, expected: Trace) -> None:
    for field in fields(Trace):
        if field.name != "last":
            a, b = getattr(found, field.name), getattr(expected, field.name)
            assert_allclose(a, b, rtol=AGREE, atol=AGREE, err_msg=field.name)
    assert_allclose(found.last.mean, expected.last.mean, rtol=AGREE, atol=AGREE)
    assert_allclose(found.last.covariance, expected.last.covariance, rtol=AGREE, atol=AGREE)


def averaging() -> tuple[Model, dict[str, float]]:
    model = compose([small()], HOLDS, averaged={"sum": 0.5})
    return model, {p.name: p.start for p in model.parameters}


@pytest.mark.parametrize("far_h", [0.0, 170.0])
def test_loops_over_matrices_give_what_straight_line_code_gives(
    far_h: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Holds and a regime, missing readings, running means and their restarts, the end of a gap, a step of a
    week; whether the matrices of all steps are in memory or of few."""
    model, values = averaging()
    one, other = both_ways(model, a_run(model, far_h=far_h))
    check_same(one, other, values)
    whole = one.value(values)
    monkeypatch.setattr(wide_recursion, "KEYS", 16)
    check_same(one, other, values)
    assert one.value(values) == pytest.approx(whole, rel=1e-13)


def test_curved_readings_a_bound_and_a_given_start() -> None:
    model = replace(compose([small(curved=True)], HOLDS), bound=2.0)
    values = {p.name: p.start for p in model.parameters}
    start = Gaussian(np.array([0.3, -0.2]), np.array([[1.0, 0.2], [0.2, 2.0]]))
    check_same(*both_ways(model, a_run(model), start), values)


def test_a_piece_of_a_run_gives_the_numbers_of_the_whole() -> None:
    """Bit for bit, as matrices do not depend on the steps beside them."""
    model, values = averaging()
    run = a_run(model)
    whole = both_ways(model, run)[0].trace(values)
    after = run.window(31, len(run))
    begun = np.where(run.reset[30], np.array([1.0, 1.0, 0.0]), 1.0)  # a trace shows means before they restart
    start = Gaussian(
        whole.mean[30] * begun, whole.covariance[30] * np.outer(begun, begun), float(run.time[30])
    )
    found = both_ways(model, after)[0].trace(values, start=start)
    assert found.mean.tolist() == whole.mean[31:].tolist()
    assert found.covariance.tolist() == whole.covariance[31:].tolist()


@pytest.mark.parametrize(
    ("mechanism", "hold", "wide"),
    [
        (small(), "mean", True),
        (small(), "linear", False),
        (small(curved=True), "mean", True),
        (replace(small(), diffusion=lambda p, u: {"x1": p.s**2 * u.u**2}), "mean", False),
    ],
)
def test_matrices_are_taken_where_they_are_exact(
    mechanism: Mechanism, hold: str, wide: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not where two straight lines are multiplied or the noise follows an input, nor for a diffuse start or
    factors, nor for few states."""
    monkeypatch.setattr(wide_recursion, "FEW", 1)
    model = compose([mechanism], HOLDS | {"w": hold})
    assert recursion_of(model).wide == wide
    assert not recursion_of(model, unknown=2).wide
    assert not recursion_of(model, factored=True).wide
    monkeypatch.setattr(wide_recursion, "FEW", 8)
    assert not recursion_of(model).wide


def test_a_product_of_two_rising_inputs_is_divided_into_sub_steps() -> None:
    """A parabola in time drives the states: free runs against an ODE solver, at steps of up to 15 h."""
    model, values = compose([small()], HOLDS | {"w": "linear"}), dict(a=0.7, b=0.4, s=0.3, r=0.2)
    random, time_h = np.random.default_rng(4), np.array([0.0, 1.0, 16.0, 18.0])
    inputs = {name: random.normal(size=4) for name in ("u", "v", "w")} | {"wind": np.full(4, 0.5)}
    run = timeline(model, time_h, inputs, {name: np.full(4, np.nan) for name in model.outputs})
    start = Gaussian(np.array([0.3, -0.2]), np.eye(2), 0.0)

    def rates(t: float, x: np.ndarray, k: int) -> list[float]:
        v, w = (np.interp(t, time_h, inputs[name]) for name in "vw")
        u = inputs["u"][k - 1]
        return [0.7 * (x[1] - x[0]) + 0.4 * u + w * v, 0.3 * x[0] - (0.4 + 0.5) * (x[1] - v)]

    expected = [start.mean]
    for k in range(1, 4):
        span = (time_h[k - 1], time_h[k])
        expected.append(solve_ivp(rates, span, expected[-1], args=(k,), rtol=1e-11, atol=1e-12).y[:, -1])
    held = Likelihood(model, run, start, tolerance=1e-4).scheduled(values)
    errors = [
        np.abs(one.trace(values, gain=False).mean - expected).max()
        for one in (held, replace(held, schedule=held.schedule.halved()))
    ]
    # a straight line through both nodes leaves h⁵ |A² b''| / 720 a sub-step
    assert errors[0] < 1e-4
    assert 12.0 < errors[0] / errors[1] < 20.0


def test_lost_digits_are_seen_and_the_run_is_repeated_in_factors() -> None:
    """Two precise readings of one state with a wide start: their variances say what is lost."""
    model, values = averaging()
    line = a_run(model)
    start = Gaussian(np.zeros(3), np.diag([1e14, 1e14, 1.0]), float(line.time[0]))
    one, other = both_ways(model, line, start)
    sums = []
    for way in (one, other):
        state, steps = way.first_state(values), way._steps(values)
        sums.append(way._run(values, steps, slice(0, len(line)), state))
    # digits are lost in both, at different rounding: those that are left agree
    assert_allclose(sums[0][3:], sums[1][3:], rtol=1e-3)
    assert one.value(values) == other.value(values) == replace(other, square_root=True).value(values)


# -- chains and full networks --------------------------------------------------------------------------------
def network(n: int, full: bool, fast: float = 1.0) -> Model:
    """n heat stores, coupled as a chain or each with each, the first heated, the last read.

    `fast` multiplies the conductances around the first store.
    """
    states = [f"x{i}" for i in range(n)]
    share = np.random.default_rng(0).uniform(0.2, 1.0, (n, n)) / n

    def conductance(k: list, i: int, j: int) -> object:
        return (k[min(i, j)] + k[max(i, j)]) * (float(share[min(i, j), max(i, j)]) if full else 1.0)

    def rates(p, x, u):
        k = [getattr(p, f"k{i}") * (fast if i == 0 else 1.0) for i in range(n)]
        v = [getattr(x, name) for name in states]
        found = {name: 0.0 for name in states}
        found["x0"] = k[0] * (u.u - v[0])
        for i in range(n):
            for j in range(i + 1, n if full else min(i + 2, n)):
                flow = conductance(k, i, j) * (v[j] - v[i])
                found[f"x{i}"] = found[f"x{i}"] + flow
                found[f"x{j}"] = found[f"x{j}"] - flow
        return found

    made = linear_network(
        "network",
        [
            *(positive(f"k{i}", 1.0 + 0.1 * i) for i in range(n)),
            positive("s", 0.3, True),
            positive("r", 0.1, True),
        ],
        states,
        ["u"],
        rates,
        {"y": lambda p, x, u: (getattr(x, states[-1]), p.r**2)},
        lambda p: {name: p.s**2 for name in states},
        lambda p, u: {name: (0.0, 1.0) for name in states},
    )
    return compose([made], {"u": "mean"})


def network_run(model: Model, count: int, missing: float = 0.0) -> Timeline:
    random = np.random.default_rng(3)
    y = np.where(random.random(count) < missing, np.nan, random.normal(size=count))
    return timeline(model, 0.25 * np.arange(count), {"u": random.normal(size=count)}, {"y": y})


def in_statsmodels(likelihood: Likelihood, values: dict[str, float]) -> KalmanFilter:
    """The same model, with matrices of the exponential of an augmented one (Van Loan)."""
    r, t, h = likelihood.recursion, likelihood.timeline, 0.25
    n = r.n
    known = r.symbols(values, np.zeros(n), {"u": 0.0})
    a = np.array([r.graph.evaluate(row, known) for row in r.jacobian], dtype=float)
    b = np.array(r.graph.evaluate(r.rates, r.symbols(values, np.zeros(n), {"u": 1.0})), dtype=float)
    driven = expm(h * np.block([[a, b[:, None]], [np.zeros((1, n + 1))]]))
    noise = expm(h * np.block([[-a, values["s"] ** 2 * np.eye(n)], [np.zeros((n, n)), a.T]]))
    f = driven[:n, :n]
    made = KalmanFilter(k_endog=1, k_states=n, k_posdef=n)
    made.bind(np.ascontiguousarray(t.y))
    made["design"], made["transition"], made["selection"] = np.eye(n)[-1:], f, np.eye(n)
    made["state_cov"], made["obs_cov"] = f @ noise[:n, n:], np.array([[values["r"] ** 2]])
    # statsmodels' intercept of an instant enters the state of the next one
    made["state_intercept"] = driven[:n, n:] * np.append(t.u[2:, 0], 0.0)
    first = likelihood.first_gaussian(values)
    made.initialize_known(first.mean, first.covariance)
    return made


@pytest.mark.parametrize("full", [False, True])
def test_sixteen_states_agree_with_statsmodels_and_differences(full: bool) -> None:
    model = network(16, full)
    values = {p.name: p.start for p in model.parameters}
    likelihood = Likelihood(model, network_run(model, 300, missing=0.2))
    assert likelihood.recursion.wide
    assert likelihood.value(values) == pytest.approx(in_statsmodels(likelihood, values).loglike(), rel=AGREE)
    _, score = likelihood.score(values)
    found = likelihood.sensitivities(values, np.eye(len(values)))
    assert_allclose(found.score, score, rtol=1e-9, atol=1e-9 * np.abs(score).max())
    for i, name in enumerate(values):
        up, down = (likelihood.value({**values, name: values[name] * (1 + step)}) for step in (1e-5, -1e-5))
        # differences lose half of the digits
        assert score[i] == pytest.approx((up - down) / (2e-5 * values[name]), rel=1e-5, abs=1e-4)


def test_a_stiff_network_takes_one_step_an_instant() -> None:
    """A store that follows its input 10⁹ times as fast as the others is its input."""
    model = network(9, False, fast=1e9)
    values = {p.name: p.start for p in model.parameters}
    likelihood = Likelihood(model, network_run(model, 100))
    assert likelihood.steps_per_instant(values) <= 1.0
    nearer = Likelihood(network(9, False, fast=1e8), likelihood.timeline)
    # the difference to the limit falls with the rate
    change = abs(likelihood.value(values) - nearer.value(values))
    farther = Likelihood(network(9, False, fast=1e7), likelihood.timeline)
    assert change < 0.2 * abs(farther.value(values) - nearer.value(values)) < 1e-3
    _, score = likelihood.score(values)
    assert np.isfinite(score).all()


def test_smoothing_and_filterpy() -> None:
    model = network(9, True)
    values = {p.name: p.start for p in model.parameters}
    run = network_run(model, 40, missing=0.3)
    likelihood = Likelihood(model, run)
    mean, covariance = smoothed_states(likelihood, values)
    made = in_statsmodels(likelihood, values)
    from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother

    other = KalmanSmoother(k_endog=1, k_states=9, k_posdef=9)
    other.bind(np.ascontiguousarray(run.y))
    for name in ("design", "transition", "selection", "state_cov", "obs_cov", "state_intercept"):
        other[name] = made[name]
    first = likelihood.first_gaussian(values)
    other.initialize_known(first.mean, first.covariance)
    expected = other.smooth()
    assert_allclose(mean, expected.smoothed_state.T, rtol=1e-8, atol=1e-8)
    assert_allclose(covariance, np.moveaxis(expected.smoothed_state_cov, -1, 0), rtol=1e-8, atol=1e-8)
    exported, total = to_filterpy(likelihood, values), 0.0
    for k in range(len(run)):
        exported.advance(k)
        total += exported.observe(k)
    assert total == pytest.approx(likelihood.value(values), rel=1e-8)


FIRST = """
import sys, time
import numpy as np
sys.path.insert(0, {folder!r})
from test_wide import Likelihood, network, network_run
model = network(16, {full})
values = {{p.name: p.start for p in model.parameters}}
likelihood = Likelihood(model, network_run(model, 1000))
begin = time.process_time()
likelihood.value(values), likelihood.score(values), likelihood.sensitivities(values, np.eye(len(values)))
print(time.process_time() - begin)
"""


@pytest.mark.slow
@pytest.mark.parametrize("full", [False, True])
def test_the_first_value_score_and_information_take_seconds(full: bool, tmp_path: object) -> None:
    """With nothing compiled before; straight-line code of the chain takes 76 s of CPU."""
    code = FIRST.format(folder=os.path.dirname(__file__), full=full)
    environment = {**os.environ, "HYGROKF_CACHE": str(tmp_path), "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert float(done.stdout) < 10.0


@pytest.mark.slow
@pytest.mark.parametrize("full", [False, True])
def test_sixteen_states_are_faster_than_statsmodels(full: bool) -> None:
    """Medians of pairs that are run one after the other."""
    model = network(16, full)
    values = {p.name: p.start for p in model.parameters}
    likelihood = Likelihood(model, network_run(model, 10_000))
    made = in_statsmodels(likelihood, values)
    calls: tuple[Callable[[], object], ...] = (lambda: likelihood.value(values), made.loglike)
    ratios = []
    for _ in range(12):
        spent = []
        for call in calls:
            begin = time.process_time()
            call()
            spent.append(time.process_time() - begin)
        ratios.append(spent[0] / spent[1])
    assert np.median(ratios[1:]) < 1.0
