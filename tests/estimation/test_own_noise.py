"""Abilities of own models against the joint normal distribution of all readings, assembled densely: shared
noises, correlated and estimated first states, diffusion that follows inputs, repeated instants, several
records."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from builders.dense_gaussian import Course, loglik, score, smoothed
from builders.linear_oracles import van_loan
from numpy.testing import assert_allclose
from scipy.integrate import quad_vec
from scipy.linalg import expm

from hygrokf.engine.timeline import timeline
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.reference_filter import reference_filter
from hygrokf.estimation.smoother import smoothed_states
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import Model, VarianceFault, compose
from hygrokf.physics.parameters import Parameter

RELATIVE = 1e-10
"""[1] both sides are exact but for rounding and the polynomials' remainder (2e-15); the dense covariance has
a condition number below 1e4."""
TIME = np.array([0.0, 0.3, 0.5, 0.5, 0.5, 1.4, 2.0, 2.0, 4.5, 5.0, 5.1, 7.0])
"""[h] irregular, with repeated instants."""
ROWS, NOISE = np.array([[1.0, 0.0], [0.5, -1.0]]), np.array([0.04, 0.09])


def readings(seed: int = 3, count: int = len(TIME)) -> np.ndarray:
    random = np.random.default_rng(seed)
    y = random.normal(size=(count, 2))
    y[random.random(y.shape) < 0.25] = np.nan
    return y


def parameter(name: str, start: float) -> Parameter:
    return Parameter(name, "1", start, -10.0, 10.0)


VALUES = {
    "rate": 0.7,
    "link": 0.4,
    "sun": 0.5,
    "wind": -0.3,
    "own": 0.2,
    "level": 0.6,
    "known": 1.1,
    "tie": -0.8,
}


def two_states() -> Model:
    """Two coupled states with two shared noises, one of their own, and a correlated first state: all
    estimated."""
    network = linear_network(
        "two",
        [parameter(name, start) for name, start in VALUES.items()],
        ["a", "b"],
        [],
        lambda p, x, u: {"a": p.rate * (x.b - x.a), "b": p.link * (x.a - 2.0 * x.b)},
        {
            "first": lambda p, x, u: (x.a, NOISE[0]),
            "second": lambda p, x, u: (0.5 * x.a - x.b, NOISE[1]),
        },
        lambda p: {"a": {"sun": p.sun, "wind": p.wind}, "b": {"sun": 2.0 * p.wind, "rest": p.own}},
        lambda p, u: {"a": (p.level, {"both": p.known}), "b": (2.0 * p.level, {"both": p.tie, "b": 0.5})},
    )
    return compose([network])


def course_of(theta: np.ndarray, time: np.ndarray = TIME) -> Course:
    """The same model in matrices; accepts complex parameters."""
    rate, link, sun, wind, own, level, known, tie = theta
    a = np.array([[-rate, rate], [link, -2.0 * link]])
    noise = np.array([[sun, wind, 0.0], [2.0 * wind, 0.0, own]])
    first = np.array([[known, 0.0], [tie, 0.5]])
    steps = []
    for h in np.diff(time):
        q = noise @ noise.T
        power = expm(np.block([[-a, q], [np.zeros((2, 2)), a.T]]) * h)
        f = power[2:, 2:].T
        steps.append((f, np.zeros(2), f @ power[:2, 2:]))
    return Course(steps, np.array([level, 2.0 * level]), first @ first.T, ROWS, NOISE)


def line(model: Model, time: np.ndarray, y: np.ndarray, inputs: dict | None = None):
    return timeline(model, time, inputs or {}, dict(zip(model.outputs, y.T, strict=True)))


def test_shared_noises_correlated_first_state_and_repeated_instants_are_exact():
    """Value, score, tangents and smoothed states; the parameters of the first state are estimated with the
    rest."""
    model, y, theta = two_states(), readings(), np.array(list(VALUES.values()))
    likelihood = Likelihood(model, line(model, TIME, y))
    course = course_of(theta)
    assert likelihood.value(VALUES) == pytest.approx(loglik(course, y), rel=RELATIVE)
    value, slopes = likelihood.score(VALUES)
    expected = score(course_of, theta, y)
    assert value == pytest.approx(loglik(course, y), rel=RELATIVE)
    assert_allclose(slopes, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    along = likelihood.sensitivities(VALUES, np.eye(len(theta)))
    assert_allclose(along.score, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    for found, wanted in zip(smoothed_states(likelihood, VALUES), smoothed(course, y), strict=True):
        assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)
    assert model.noise(VALUES)[0][1] == pytest.approx(2.0 * 0.5 * -0.3)
    mean, variance = model.initial(VALUES, {})
    assert mean == [0.6, 1.2] and variance == pytest.approx([1.1**2, 0.8**2 + 0.25])


def test_a_noise_is_shared_between_mechanisms():
    one = linear_network(
        "one", [parameter("s", 0.5)], ["a"], [],
        lambda p, x, u: {"a": -x.a}, {"y": lambda p, x, u: (x.a, 1.0)},
        lambda p: {"a": {"sun": p.s}}, lambda p, u: {"a": (0.0, 1.0)},
    )  # fmt: skip
    other = linear_network(
        "other", [parameter("t", 0.2)], ["b"], [], lambda p, x, u: {"b": -x.b}, {},
        lambda p: {"b": {"sun": p.t}}, lambda p, u: {"b": (0.0, 1.0)},
    )  # fmt: skip
    assert compose([one, other]).noise({"s": 3.0, "t": 2.0}) == [[9.0, 6.0], [6.0, 4.0]]


def gusty(hold: str, power: int = 1) -> Model:
    """A state whose noise follows a power of an input, which does not drive it, beside a slower one that it
    drives."""
    network = linear_network(
        "gusty",
        [parameter("size", 0.6)],
        ["a", "b"],
        ["gust"],
        lambda p, x, u: {"a": -1.3 * x.a, "b": 0.4 * (x.a - x.b)},
        {"first": lambda p, x, u: (x.a, NOISE[0]), "second": lambda p, x, u: (0.5 * x.a - x.b, NOISE[1])},
        lambda p, u: {"a": p.size * p.size * u.gust**power, "b": 0.05},
        lambda p, u: {"a": (0.0, 1.0), "b": (0.0, 0.5)},
    )
    return compose([network], {"gust": hold})


GUST = np.array([1.0, 0.2, 2.0, 3.0, 0.5, 0.1, 4.0, 1.0, 2.0, 0.3, 0.3, 5.0])


def gusty_course(hold: str, time: np.ndarray, gust: np.ndarray, power: int = 1) -> Course:
    a = np.array([[-1.3, 0.0], [0.4, -0.4]])

    def intensity(level: float) -> np.ndarray:
        return np.diag([0.36 * level**power, 0.05])

    steps = []
    for k, h in enumerate(np.diff(time)):
        begin, end = gust[k], gust[k + 1]
        if hold == "linear" and h:

            def grown(t, h=h, begin=begin, end=end):
                f = expm(a * (h - t))
                return f @ intensity(begin + (end - begin) * t / h) @ f.T

            f, q = expm(a * h), quad_vec(grown, 0.0, h, epsabs=1e-15, epsrel=1e-14)[0]
        elif h:
            f, q = van_loan(a, intensity({"previous": begin, "mean": end}.get(hold, end)), h)
        else:
            f, q = np.eye(2), np.zeros((2, 2))
        steps.append((f, np.zeros(2), q))
    return Course(steps, np.zeros(2), np.diag([1.0, 0.5]), ROWS, NOISE)


@pytest.mark.parametrize(
    ("hold", "power"),
    [("previous", 1), ("mean", 2), ("linear", 1), ("linear", 2), ("mean of few distinct values", 2)],
)
def test_diffusion_follows_an_input_under_every_hold(hold, power):
    """An intensity that is the square of a linear input is exact, as one that is constant within a step
    is."""
    y = readings(5)
    model = gusty(hold, power)
    likelihood = Likelihood(model, line(model, TIME, y, {"gust": GUST}))
    course = gusty_course(hold, TIME, GUST, power)
    assert likelihood.value({"size": 0.6}) == pytest.approx(loglik(course, y), rel=RELATIVE)
    total, _ = reference_filter(likelihood, {"size": 0.6})
    assert total == pytest.approx(loglik(course, y), rel=1e-8)  # its integrator's tolerance
    up, down = (likelihood.value({"size": 0.6 + d}) for d in (1e-5, -1e-5))
    assert likelihood.score({"size": 0.6})[1][0] == pytest.approx((up - down) / 2e-5, rel=1e-6)


def test_an_intensity_that_is_no_parabola_in_time_is_of_fourth_order():
    """Instants without readings halve the steps: the error of the fourth power of a linear input falls
    16-fold."""
    model, y = gusty("linear", power=4), readings(5)[[0, 1, 5]]
    time, gust = np.array([0.0, 0.25, 0.5]), np.array([1.0, 1.6, 0.8])  # one sub-step each
    exact = loglik(gusty_course("linear", time, gust, 4), y)
    errors = []
    for parts in (1, 2, 4):
        fine = np.interp(np.arange(2 * parts + 1) / parts, np.arange(3), time)
        blank = np.full((len(fine), 2), np.nan)
        blank[::parts] = y
        made = line(model, fine, blank, {"gust": np.interp(fine, time, gust)})
        errors.append(abs(Likelihood(model, made, tolerance=1.0).value({"size": 0.6}) - exact))
    for coarse, fine in pairwise(errors):
        assert 15.0 < coarse / fine < 19.0


def test_running_means_at_repeated_instants_are_exact():
    """A mean that is read twice where its interval ends, once by each of two rows, restarts after the
    second."""
    network = linear_network(
        "one", [parameter("rate", 0.7)], ["a"], [], lambda p, x, u: {"a": -p.rate * x.a},
        {"first": lambda p, x, u: (x.a, NOISE[0]), "second": lambda p, x, u: (x.a, NOISE[1])},
        lambda p: {"a": 0.3}, lambda p, u: {"a": (1.0, 2.0)},
    )  # fmt: skip
    model = compose([network], averaged={"second": 1.0})
    time = np.array([0.0, 0.4, 1.0, 1.0, 1.5, 2.0, 2.0, 3.0])
    y = np.random.default_rng(2).normal(size=(8, 2))
    y[[0, 1, 4], 1] = np.nan
    ended = np.isin(time, [1.0, 2.0, 3.0])
    for rows in (
        ended,
        ended & np.append(time[1:] != time[:-1], True),
        ended & np.append(True, np.diff(time) > 0),
    ):
        made = timeline(model, time, {}, dict(zip(model.outputs, y.T, strict=True)), {"second": rows})
        likelihood = Likelihood(model, made)
        a, steps = np.array([[-0.7, 0.0], [1.0, 0.0]]), []
        for k, h in enumerate(np.diff(time)):
            f, q = van_loan(a, np.diag([0.3, 0.0]), h) if h else (np.eye(2), np.zeros((2, 2)))
            restart = np.diag([1.0, 0.0 if ended[k] and h else 1.0])
            steps.append((f @ restart, np.zeros(2), q))
        course = Course(steps, np.array([1.0, 0.0]), np.diag([2.0, 0.0]), np.eye(2), NOISE)
        assert likelihood.value({"rate": 0.7}) == pytest.approx(loglik(course, y), rel=RELATIVE)
        up, down = (likelihood.value({"rate": 0.7 + d}) for d in (1e-5, -1e-5))
        assert likelihood.score({"rate": 0.7})[1][0] == pytest.approx((up - down) / 2e-5, rel=1e-6)


def network_with(intensity, variance=lambda p: 0.1, first=lambda p: 1.0) -> Likelihood:
    made = linear_network(
        "one",
        [Parameter("q", "1", 0.5, -5.0, 5.0), Parameter("r", "1", 0.5, 0.0, 5.0)],
        ["x"],
        ["push"],
        lambda p, x, u: {"x": u.push - x.x},
        {"y": lambda p, x, u: (x.x, variance(p))},
        intensity,
        lambda p, u: {"x": (0.0, first(p))},
    )
    model = compose([made], {"push": "linear"})
    inputs = {"push": np.array([1.0, 2.0, 5.0, 1.0])}
    return Likelihood(model, timeline(model, np.arange(4.0), inputs, {"y": np.ones(4)}))


@pytest.mark.parametrize(
    ("likelihood", "at", "words"),
    [
        (lambda: network_with(lambda p: {"x": -0.1}), 0.5, "found -0.1 for the state x"),
        (lambda: network_with(lambda p: {"x": p.q}), -0.5, "found -0.5 for the noise intensity of"),
        (lambda: network_with(lambda p: {"x": p.r * p.r / p.q}), -0.5, "found -0.5 for the noise"),
        (lambda: network_with(lambda p: {"x": 1.0 - p.q * p.q}), 2.0, "found -3 for the noise intensity"),
        (lambda: network_with(lambda p, u: {"x": 3.0 - u.push}), 0.5, "found -2 for the noise intensity"),
        (lambda: network_with(lambda p: {"x": 0.1}, lambda p: p.q), -0.5, "the variance of the reading y"),
        (lambda: network_with(lambda p: {"x": 0.1}, first=lambda p: p.q), -0.5, "found -0.5 for the state x"),
    ],
)  # fmt: skip
def test_negative_variances_and_intensities_are_refused(likelihood, at, words):
    with pytest.raises(VarianceFault, match=words):
        likelihood().value({"q": at, "r": 0.5})
    with pytest.raises(ValueError, match=words):
        likelihood().score({"q": at, "r": 0.5})


def test_a_parameter_below_the_limit_that_keeps_a_variance_positive_is_refused():
    likelihood = network_with(lambda p: {"x": p.r})
    assert np.isfinite(likelihood.value({"q": 0.5, "r": 0.0}))
    with pytest.raises(VarianceFault, match=r"r: expected at least 0 1, as its limits say, found -0\.2"):
        likelihood.value({"q": 0.5, "r": -0.2})
