"""Noise that grows with its state: geometric Brownian motion and Cox–Ingersoll–Ross against their exact
transition densities, and coverage on exactly simulated courses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import lognorm, ncx2

from hygrokf.engine.timeline import timeline
from hygrokf.estimation.inference import confidence_intervals
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import fit_mle
from hygrokf.estimation.reference_filter import reference_filter
from hygrokf.estimation.smoother import smoothed_states
from hygrokf.physics.expression import log, sqrt
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import Model, compose
from hygrokf.physics.parameters import Parameter


def positive(name: str, start: float, noise: bool = False) -> Parameter:
    return Parameter(name, "1", start, start / 1e3, start * 1e3, positive=True, noise=noise)


def geometric(first: float, variance: float = 1e-12) -> Model:
    """dx = μ x dt + σ x dW, of which ln x is read."""
    network = linear_network(
        "geometric",
        [Parameter("drift", "1/h", 0.1, -5.0, 5.0), positive("size", 0.3)],
        ["x"],
        [],
        lambda p, x, u: {"x": p.drift * x.x},
        {"read": lambda p, x, u: (log(x.x), variance)},
        lambda p: {"x": p.size * p.size},
        lambda p, u: {"x": (first, 0.0)},
        noise_exponents={"x": 1.0},
    )
    return compose([network])


def square_root(first: float, variance: float = 1e-12) -> Model:
    """dx = κ (θ − x) dt + σ √x dW (Cox–Ingersoll–Ross), of which √x is read."""
    network = linear_network(
        "square root",
        [positive("pull", 1.0), positive("level", 2.0), positive("size", 0.3)],
        ["x"],
        [],
        lambda p, x, u: {"x": p.pull * (p.level - x.x)},
        {"read": lambda p, x, u: (sqrt(x.x), variance)},
        lambda p: {"x": p.size * p.size},
        lambda p, u: {"x": (first, 0.0)},
        noise_exponents={"x": 0.5},
    )
    return compose([network])


def geometric_course(
    random: np.random.Generator, step: float, count: int, drift: float, size: float
) -> np.ndarray:
    """x (count,) from 1, sampled from its exact law."""
    growth = (drift - 0.5 * size**2) * step + size * math.sqrt(step) * random.normal(size=count - 1)
    return np.exp(np.append(0.0, np.cumsum(growth)))


def square_root_law(x: float | np.ndarray, step: float, pull: float, level: float, size: float):
    """The law of x after a step: a scaled non-central χ² (Cox, Ingersoll & Ross 1985, equation 18)."""
    c = size**2 * -math.expm1(-pull * step) / (4.0 * pull)
    return ncx2(4.0 * pull * level / size**2, x * math.exp(-pull * step) / c, scale=c)


def square_root_course(random: np.random.Generator, step: float, count: int, *law: float) -> np.ndarray:
    x = [law[1]]
    for _ in range(count - 1):
        x.append(float(square_root_law(x[-1], step, *law).rvs(random_state=random)))
    return np.array(x)


def read(model: Model, time: np.ndarray, y: np.ndarray) -> Likelihood:
    return Likelihood(model, timeline(model, time, {}, {"read": y}))


def test_geometric_brownian_motion_has_its_exact_transition_density():
    """In ln x the filter is exact: ln L is the sum of lognormal densities, times x for the density of ln
    x."""
    values = {"drift": 0.2, "size": 0.4}
    x = geometric_course(np.random.default_rng(1), 0.5, 60, 0.2, 0.4)
    likelihood = read(geometric(1.0), 0.5 * np.arange(60), np.append(np.nan, np.log(x[1:])))
    scale = x[:-1] * math.exp((0.2 - 0.08) * 0.5)
    exact = np.sum(lognorm.logpdf(x[1:], 0.4 * math.sqrt(0.5), scale=scale) + np.log(x[1:]))
    # readings have the variance 1e-12, which adds 1e-12/0.08 to each of the 59
    assert likelihood.value(values) == pytest.approx(exact, rel=1e-8)
    total, states = reference_filter(likelihood, values)
    assert total == pytest.approx(exact, rel=1e-7)
    assert states[-1].mean[0] == pytest.approx(math.log(x[-1]))
    mean, spread = smoothed_states(likelihood, values)
    np.testing.assert_allclose(mean[1:, 0], x[1:], rtol=1e-6)  # in the state's unit
    assert spread[-1, 0, 0] == pytest.approx(1e-12 * x[-1] ** 2, rel=1e-3)


def test_the_square_root_process_tends_to_its_exact_transition_density():
    """The density of √x is 2 √x times that of x; the linearisation's error falls with the step."""
    law = (1.5, 2.0, 0.4)
    values = dict(zip(("pull", "level", "size"), law, strict=True))
    per_reading = []
    for step in (0.4, 0.1, 0.025):
        x = square_root_course(np.random.default_rng(2), step, 400, *law)
        likelihood = read(square_root(2.0), step * np.arange(400), np.append(np.nan, np.sqrt(x[1:])))
        exact = np.sum(square_root_law(x[:-1], step, *law).logpdf(x[1:]) + np.log(2.0 * np.sqrt(x[1:])))
        per_reading.append(abs(likelihood.value(values) - exact) / 399)
    assert per_reading[0] < 2e-3 and per_reading[2] < 0.1 * per_reading[0]


def test_other_exponents_correlated_noise_and_drift_agree_with_the_plain_filter():
    """Itô's correction takes the whole intensity of shared noises; score and tangents are those of ln L."""
    network = linear_network(
        "pair",
        [positive("pull", 1.0), positive("size", 0.3), Parameter("tie", "1", 0.2, -2.0, 2.0)],
        ["x", "z"],
        [],
        lambda p, x, u: {"x": p.pull * (2.0 - x.x), "z": x.x - x.z},
        {"read": lambda p, x, u: (x.x + 0.1 * x.z, 0.01)},
        lambda p: {"x": {"a": p.size, "b": p.tie}, "z": {"b": 0.5}},
        lambda p, u: {"x": (1.5, {"first": 0.2, "both": 0.1}), "z": (1.0, {"both": 0.3})},
        noise_exponents={"x": 0.75},
    )
    model = compose([network])
    values = {"pull": 1.2, "size": 0.25, "tie": 0.3}
    likelihood = read(model, 0.2 * np.arange(30), 2.0 + 0.3 * np.random.default_rng(4).normal(size=30))
    # z = 4 x^(1/4), with ∂z/∂x = x^(−3/4)
    first = likelihood.first_gaussian(values)
    assert first.mean.tolist() == pytest.approx([4.0 * 1.5**0.25, 1.0])
    assert first.covariance[0, 0] == pytest.approx(0.05 * 1.5**-1.5)
    assert first.covariance[0, 1] == pytest.approx(0.03 * 1.5**-0.75)
    rates = model.evaluate([4.0 * 1.5**0.25, 1.0], {}, values).rates
    q = 0.25**2 + 0.3**2
    assert rates[0] == pytest.approx(1.2 * 0.5 * 1.5**-0.75 - 0.5 * 0.75 * q * 1.5**-0.25)
    total, _ = reference_filter(likelihood, values)
    assert likelihood.value(values) == pytest.approx(total, rel=1e-4)  # of the sub-steps
    _, slopes = likelihood.score(values)
    np.testing.assert_allclose(likelihood.sensitivities(values, np.eye(3)).score, slopes, rtol=1e-8)
    for i, name in enumerate(values):
        up, down = (likelihood.value({**values, name: values[name] + d}) for d in (1e-5, -1e-5))
        assert slopes[i] == pytest.approx((up - down) / 2e-5, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize(
    ("exponents", "first", "words"),
    [
        ({"x": 1.5}, 1.0, "expected 0 to 1 for the state x, found 1.5"),
        (
            {"y": 0.5},
            1.0,
            'noise_exponents of the mechanism "one": expected names of x, found "y"',
        ),
        ({"x": 0.5}, -1.0, r"mean above 0 of a state whose noise grows with it, found -1\.0"),
    ],
)
def test_what_has_no_lamperti_coordinate_is_refused(exponents, first, words):
    network = linear_network(
        "one", [positive("s", 1.0)], ["x"], [],
        lambda p, x, u: {"x": -x.x}, {"y": lambda p, x, u: (x.x, 1.0)},
        lambda p: {"x": p.s}, lambda p, u: {"x": (first, 1.0)}, exponents,
    )  # fmt: skip
    model = compose([network])
    with pytest.raises(ValueError, match=words):
        Likelihood(model, timeline(model, np.arange(3.0), {}, {"y": np.ones(3)})).value({"s": 1.0})


def test_diffusion_that_reads_a_state_says_what_to_do():
    for diffusion, words in (
        (lambda p, u: {"x": u.x}, r"reads u\.x, but.*noise_exponents"),
        (lambda p, x, u: {"x": x.x}, r"of p or \(p, u\), found one of p, x, u; .*noise_exponents"),
    ):
        network = linear_network(
            "one", [], ["x"], [], lambda p, x, u: {"x": -x.x}, {"y": lambda p, x, u: (x.x, 1.0)},
            diffusion, lambda p, u: {"x": (1.0, 1.0)},
        )  # fmt: skip
        with pytest.raises(ValueError, match=words):
            compose([network]).noise({})


def covered(
    model: Model, y: np.ndarray, step: float, truth: dict[str, float], method: str
) -> dict[str, bool]:
    likelihood = read(model, step * np.arange(len(y)), y)
    found = fit_mle(likelihood, count=1)
    assert found.converged, found.message
    bounds = confidence_intervals(likelihood, found, method=method)
    return {name: bounds[name].lower <= value <= bounds[name].upper for name, value in truth.items()}


@pytest.mark.slow
@pytest.mark.parametrize("method", ["wald", "profile"])
@pytest.mark.parametrize("process", ["geometric", "square root"])
def test_bounds_hold_on_exactly_simulated_courses(process, method):
    """200 courses of 400 readings with noise, seeds 5,000 …: 95 % bounds hold for at least 92 % of every
    parameter (three standard errors of 0.95 in 200 are 0.046)."""
    held: dict[str, list[bool]] = {}
    for seed in range(200):
        random = np.random.default_rng(5000 + seed)
        if process == "geometric":
            x = geometric_course(random, 0.25, 400, 0.2, 0.4)
            truth = {"drift": 0.2, "size": 0.4}
            y, model = np.log(x) + 0.05 * random.normal(size=400), geometric(1.0, 0.05**2)
        else:
            x = square_root_course(random, 0.25, 400, 1.5, 2.0, 0.4)
            truth = {"pull": 1.5, "level": 2.0, "size": 0.4}
            y, model = np.sqrt(x) + 0.02 * random.normal(size=400), square_root(2.0, 0.02**2)
        for name, holds in covered(model, y, 0.25, truth, method).items():
            held.setdefault(name, []).append(holds)
    shares = {name: float(np.mean(holds)) for name, holds in held.items()}
    print(process, method, shares)
    assert min(shares.values()) >= 0.92, shares
