"""The law of a simulation's error against a dense Gaussian, a plain Kalman filter and differences."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm, solve_continuous_lyapunov

from hygrokf.discovery import error_model
from hygrokf.discovery.error_model import (
    HUBER,
    LEAST_VARIANCE,
    TIMES_H,
    VARIANCES,
    Filtered,
    Instants,
    coefficients,
    course,
    filtered,
    forecast_weights,
    loss,
    maximised,
    shares,
    start_variances,
)
from hygrokf.engine.timeline import timeline
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import compose
from hygrokf.physics.parameters import Parameter

PARTS = len(TIMES_H)
TIMES = np.array(TIMES_H)
EVERY = np.ones(PARTS, bool)
KNOWN = np.array([0.04, 0.3, 0.2, 0.5, 0.4, 0.3, 0.2])
"""R, s_w² and those of the parts [K²]."""


# -- the same law, written from its differential equations ---------------------------------------------------
def continuous(tau_h: float, variances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A [1/h] and Q [unit²/h] of (u_1 … u_m, n)."""
    a = np.diag(np.append(-1.0 / TIMES, -1.0 / tau_h))
    a[-1, :-1] = 1.0 / tau_h
    return a, np.diag(np.append(2.0 * variances[2:] / TIMES, 2.0 * variances[1] / tau_h))


def dense(time_h: np.ndarray, tau_h: float, variances: np.ndarray, added: np.ndarray) -> np.ndarray:
    """Covariance (T, T) of the error at instants, without the readings' noise."""
    a, q = continuous(tau_h, variances)
    resting = solve_continuous_lyapunov(a, -q)
    later: dict[float, float] = {}
    for gap in np.unique(np.abs(time_h[:, None] - time_h).round(9)):
        later[float(gap)] = float((expm(a * gap) @ resting)[-1, -1])
    found = np.vectorize(later.__getitem__)(np.abs(time_h[:, None] - time_h).round(9))
    for k in np.flatnonzero(added):
        since = np.maximum(time_h - time_h[k], 0.0)
        fading = np.where(time_h >= time_h[k], np.exp(-since / tau_h), 0.0)
        found += added[k] * np.outer(fading, fading)
    return found


@dataclass(frozen=True)
class Case:
    """An error with gaps, beginnings, readings of uneven quality and missing ones."""

    time_h: np.ndarray
    tau_h: float
    added: np.ndarray
    shape: np.ndarray
    error: np.ndarray

    @cached_property
    def course(self) -> Instants:
        return course(self.time_h, self.tau_h, self.added, self.shape, EVERY)

    @property
    def seen(self) -> np.ndarray:
        return np.isfinite(self.error)

    @cached_property
    def covariance(self) -> np.ndarray:
        return dense(self.time_h, self.tau_h, KNOWN, self.added)

    @cached_property
    def root(self) -> np.ndarray:
        """Cholesky factor of the readings' covariance."""
        full = self.covariance + np.diag(KNOWN[0] * self.shape)
        return np.linalg.cholesky(full[np.ix_(self.seen, self.seen)])

    @cached_property
    def filtered(self) -> Filtered:
        return filtered(self.course, KNOWN, self.error, math.inf)


@cache
def case(tau_h: float = 2.0, count: int = 130) -> Case:
    rng = np.random.default_rng(4)
    time = np.cumsum(rng.choice([0.25, 0.25, 0.25, 0.5, 1.0], count))
    time[90:] += 31.0
    added = np.zeros(count)
    added[[0, 60, 90]] = 25.0, 0.4, 9.0
    shape = rng.uniform(0.3, 3.0, count)
    error = 2.0 * rng.standard_normal(count) + np.sin(time)
    error[[*range(30, 40), 77, 0, count - 1]] = np.nan
    return Case(time, tau_h, added, shape, error)


TAUS = [0.02, 0.5, 2.0, 2.0 + 1e-13, 2.0 - 1e-13, 3.3, 32.0, 200.0]
"""[h] those that equal a part's correlation time are the limit of the others."""


@pytest.mark.parametrize("tau_h", TAUS)
def test_deviance_and_innovations_are_those_of_a_dense_gaussian(tau_h):
    one = case(tau_h)
    white = np.linalg.solve(one.root, one.error[one.seen])
    assert_allclose(one.filtered.standardised[one.seen], white, rtol=0, atol=1e-9)
    expected = 2.0 * np.log(np.diag(one.root)).sum() + white @ white
    assert one.filtered.deviance == pytest.approx(expected, rel=1e-9)
    assert one.filtered.terms.sum() == pytest.approx(expected, rel=1e-9)
    assert np.isnan(one.filtered.innovation[~one.seen]).all()
    assert not one.filtered.terms[~one.seen].any()


@pytest.mark.parametrize("tau_h", [0.5, 2.0, 200.0])
@pytest.mark.parametrize("width", [1, 8, 11])
def test_whitened_columns_are_those_of_a_dense_gaussian(tau_h, width):
    one = case(tau_h)
    columns = np.random.default_rng(5).standard_normal((len(one.error), width))
    found = one.filtered.whitened(columns)
    assert_allclose(found[one.seen], np.linalg.solve(one.root, columns[one.seen]), rtol=0, atol=1e-9)
    assert not found[~one.seen].any()
    own = one.filtered.whitened(one.error[:, None])[:, 0]
    assert_allclose(own[one.seen], one.filtered.standardised[one.seen], rtol=0, atol=1e-12)


@pytest.mark.parametrize("tau_h", [0.5, 2.0, 200.0])
def test_the_smoother_is_the_conditional_mean_of_a_dense_gaussian(tau_h):
    one = case(tau_h)
    weights = np.linalg.solve(one.root.T, np.linalg.solve(one.root, one.error[one.seen]))
    expected = one.covariance[:, one.seen] @ weights
    assert_allclose(one.filtered.smoothed(), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("tau_h", [0.5, 2.0, 200.0])
def test_forecasts_are_the_conditional_mean_given_the_readings_so_far(tau_h):
    one, last = case(tau_h), 110
    horizons = np.array([0.0, 0.1, 3.0, 12.0, 48.0])
    time = np.append(one.time_h[: last + 1], one.time_h[last] + horizons)
    full = dense(time, tau_h, KNOWN, np.append(one.added[: last + 1], np.zeros(len(horizons))))
    there = np.flatnonzero(one.seen[: last + 1])
    root = one.root[: len(there), : len(there)]
    weights = np.linalg.solve(root.T, np.linalg.solve(root, one.error[there]))
    found = forecast_weights(one.course, horizons) @ one.filtered.state[last]
    assert_allclose(found, full[last + 1 :, there] @ weights, rtol=0, atol=1e-9)


# -- against the package's own filter ------------------------------------------------------------------------
def ladder(tau_h: float) -> Callable:
    """Rates of the parts and of what they drive through a low pass."""

    def rates(p, x, u):
        parts = [getattr(x, f"u{j}") for j in range(PARTS)]
        found = {f"u{j}": (-1.0 / t) * part for j, (t, part) in enumerate(zip(TIMES_H, parts, strict=True))}
        return {**found, "n": (sum(parts[1:], parts[0]) - x.n) * (1.0 / tau_h)}

    return rates


@pytest.mark.parametrize("tau_h", [0.3, 2.0, 40.0])
def test_it_is_the_packages_filter_of_the_linear_model(tau_h):
    """Cabinet and ladder as a linear network, which starts at rest, since it knows no correlation at the
    start: a long time before the first reading."""
    one = case(tau_h)
    _, q = continuous(tau_h, KNOWN)
    states = [*(f"u{j}" for j in range(PARTS)), "n"]
    noise = Parameter("noise", "K", math.sqrt(KNOWN[0]), 1e-6, 10.0)
    mechanism = linear_network(
        "ladder", [noise], states, ["nothing"], ladder(tau_h),
        {"error": lambda p, x, u: (x.n + 0.0 * u.nothing, p.noise * p.noise)},
        lambda p: dict(zip(states, np.diag(q).tolist(), strict=True)),
        lambda p, u: dict.fromkeys(states, (0.0, 0.0)),
    )  # fmt: skip
    time = np.append(0.0, one.time_h + 60.0 * max(*TIMES_H, tau_h))
    error = np.append(np.nan, one.error)
    model = compose([mechanism], {"nothing": "linear"})
    likelihood = Likelihood(model, timeline(model, time, {"nothing": np.zeros(len(time))}, {"error": error}))
    trace = likelihood.trace({"noise": math.sqrt(KNOWN[0])})
    plain = course(one.time_h, tau_h, np.zeros(len(one.error)), None, EVERY)
    found = filtered(plain, KNOWN, one.error, math.inf)
    assert_allclose(found.predicted, trace.prediction[1:, 0], rtol=0, atol=1e-9)
    assert_allclose(found.variance, trace.variance[1:, 0], rtol=1e-9)
    assert_allclose(found.state, trace.mean[1:], rtol=0, atol=1e-9)


# -- coefficients --------------------------------------------------------------------------------------------
@pytest.mark.parametrize("tau_h", [1e-3, 0.02, *TAUS, 1e4])
@pytest.mark.parametrize("step_h", [0.0, 1e-4, 0.25, 12.0, 1e3])
def test_coefficients_are_those_of_the_matrix_exponential(tau_h, step_h):
    found = coefficients(step_h, tau_h)
    assert np.isfinite(found).all()
    a, _ = continuous(tau_h, KNOWN)
    expected = expm(a * step_h)
    assert_allclose(found[:PARTS], np.diag(expected)[:-1], rtol=1e-12, atol=1e-300)
    # the matrix exponential of a stiff matrix has a digit or two less
    assert_allclose(found[PARTS:], expected[-1], rtol=1e-9, atol=1e-13)


def test_coefficients_pass_smoothly_through_an_equal_time_constant():
    equal = coefficients(0.25, 2.0)
    for off in (1e-15, -1e-15, 1e-13, -1e-13, 1e-11, -1e-11):
        assert_allclose(coefficients(0.25, 2.0 * (1.0 + off)), equal, rtol=1e-10)


@pytest.mark.parametrize("tau_h", [0.02, 2.0, 200.0])
def test_shares_are_those_of_the_stationary_law(tau_h):
    for j in range(PARTS):
        alone = np.zeros(VARIANCES)
        alone[2 + j] = 1.0
        a, q = continuous(tau_h, alone)
        assert solve_continuous_lyapunov(a, -q)[-1, -1] == pytest.approx(shares(tau_h)[j], rel=1e-9)


def test_parts_that_the_readings_do_not_resolve_are_left_out():
    hourly = course(np.arange(24.0 * 20.0), 2.0, np.zeros(480))
    assert hourly.is_resolved.tolist() == [False, True, True, True, True]
    short = course(0.25 * np.arange(4.0 * 30.0), 2.0, np.zeros(120))
    assert short.is_resolved.tolist() == [True, True, True, False, False]


# -- scoring -------------------------------------------------------------------------------------------------
def with_outliers() -> tuple[Instants, np.ndarray]:
    one = case()
    error = one.error.copy()
    error[[50, 51, 100, 120]] += 9.0, -20.0, 30.0, -6.0
    return one.course, error


@pytest.mark.parametrize("bound", [HUBER, 1.5, math.inf])
def test_the_gradient_is_that_of_the_same_loss(bound):
    """By central differences of the bounded loss.  The lanes' own differences, forward by a thousandth,
    carry their second order: half of that times the curvature."""
    where, error = with_outliers()
    z = np.log(KNOWN)
    value, gradient, information = error_model._scores(where, error, z, np.ones(VARIANCES, bool), bound)
    standardised = filtered(where, KNOWN, error, bound).standardised
    assert np.nanmax(np.abs(standardised)) > 4.5
    assert value == pytest.approx(filtered(where, KNOWN, error, bound).deviance, rel=1e-12)
    move = 1e-4
    for i in range(VARIANCES):
        up, down = (filtered(where, np.exp(z + s * move * (np.arange(VARIANCES) == i)), error, bound).deviance
                    for s in (1.0, -1.0))  # fmt: skip
        slope = (up - down) / (2.0 * move)
        assert gradient[i] == pytest.approx(slope, rel=3e-3, abs=1e-3 * math.sqrt(information[i, i]))


@pytest.mark.parametrize("bound", [HUBER, math.inf])
def test_the_information_is_that_of_simulated_errors(bound):
    """Symmetric and positive; and, since it is the expected one, the covariance of the gradients of errors
    that follow the law, halved, as −2 ln L has twice the score: to the spread of 300 errors."""
    one, rng = case(), np.random.default_rng(8)
    full = np.linalg.cholesky(one.covariance + np.diag(KNOWN[0] * one.shape))
    z, every = np.log(KNOWN), np.ones(VARIANCES, bool)
    gradients, total = [], np.zeros((VARIANCES, VARIANCES))
    for _ in range(300):
        error = full @ rng.standard_normal(len(full))
        _, gradient, information = error_model._scores(one.course, error, z, every, bound)
        assert_allclose(information, information.T, rtol=0, atol=1e-9)
        assert np.linalg.eigvalsh(information).min() > 0.0
        gradients.append(gradient)
        total += information / 300.0
    found = 0.5 * np.cov(np.array(gradients).T)
    size = np.sqrt(np.diag(total))
    assert_allclose(found / np.outer(size, size), total / np.outer(size, size), rtol=0, atol=0.25)


def drawn(time: np.ndarray, tau_h: float, variances: np.ndarray, seed: int) -> np.ndarray:
    """An error on equal steps that follows the law, stepped by its own matrices."""
    rng = np.random.default_rng(seed)
    a, q = continuous(tau_h, variances)
    resting = solve_continuous_lyapunov(a, -q)
    move = expm(a * float(time[1] - time[0]))
    values, vectors = np.linalg.eigh(resting - move @ resting @ move.T)
    kick = vectors * np.sqrt(np.maximum(values, 0.0))
    state = np.linalg.cholesky(resting + 1e-12 * np.eye(len(resting))) @ rng.standard_normal(len(a))
    found = np.empty(len(time))
    for k in range(len(time)):
        found[k] = state[-1] + math.sqrt(variances[0]) * rng.standard_normal()
        state = move @ state + kick @ rng.standard_normal(len(a))
    return found


@pytest.mark.parametrize(("seed", "part"), [(1, 0), (2, 2), (3, 3)])
def test_maximised_variances_are_those_of_the_law(seed, part):
    """Noise, and the variance that each range of times brings to the output.  Within a factor of two: 170
    days hold some dozens of courses of the slow parts, and neighbours in the ladder share theirs."""
    time, tau = 0.25 * np.arange(96.0 * 170.0), 2.0
    known = np.zeros(VARIANCES)
    known[0], known[2 + part] = 0.02, 1.0
    error = drawn(time, tau, known, seed)
    where = course(time, tau, np.zeros(len(time)), largest=9.0)
    found = maximised(where, error)
    assert found[0] == pytest.approx(known[0], rel=0.1)
    reach = found[2:] * shares(tau)
    near = [j for j in range(PARTS) if abs(j - part) <= 1]
    assert sum(reach[j] for j in near) == pytest.approx(shares(tau)[part], rel=0.5)
    assert reach.sum() - sum(reach[j] for j in near) < 0.1 * reach.sum()
    assert filtered(where, found, error).deviance < filtered(where, known, error).deviance + 1.0


@pytest.mark.parametrize("seed", range(4))
def test_maximised_variances_stay_within_their_bounds_and_gain(seed):
    """Errors of any kind: white, a line, a jump, larger than the readings vary."""
    rng = np.random.default_rng(seed)
    time = 0.25 * np.arange(2000.0)
    error = [
        rng.standard_normal(2000), 5.0 * np.sin(time / 3.0), np.where(time > 200.0, 30.0, 0.0),
        1e3 * rng.standard_normal(2000),
    ][seed]  # fmt: skip
    largest = 1.0
    where = course(time, 2.0, np.append(25.0, np.zeros(1999)), largest=largest)
    upper = np.append([largest, largest], largest / shares(2.0))
    for start in (None, KNOWN, np.zeros(VARIANCES), np.full(VARIANCES, 1e6)):
        found = maximised(where, error, start)
        there = np.append([True, True], where.is_resolved)
        assert (found[there] >= LEAST_VARIANCE * upper[there] * (1.0 - 1e-9)).all()
        assert (found <= upper * (1.0 + 1e-9)).all()
        assert not found[~there].any()
        begun = np.clip(
            start_variances(where, error) if start is None else start, LEAST_VARIANCE * upper, upper
        )
        begun = np.where(there, begun, 0.0)
        assert filtered(where, found, error).deviance <= filtered(where, begun, error).deviance


def test_scoring_ends_at_a_maximum():
    """From anywhere, also near zero, it reaches the same likelihood, to what last steps gain."""
    time = 0.25 * np.arange(96.0 * 60.0)
    known = np.array([0.02, 0.1, 0.0, 0.8, 0.0, 0.3, 0.0])
    error = drawn(time, 2.0, known, 5)
    where = course(time, 2.0, np.zeros(len(time)), largest=4.0)
    rng = np.random.default_rng(6)
    starts = [None, np.zeros(VARIANCES), *np.exp(rng.uniform(-9.0, 1.0, (5, VARIANCES)))]
    reached = [filtered(where, maximised(where, error, one), error).deviance for one in starts]
    assert max(reached) - min(reached) < 0.5


def test_the_loss_counts_linearly_beyond_its_bound():
    e = np.array([-9.0, -4.0, -1.0, 0.0, 2.0, 4.0, 6.0])
    assert_allclose(loss(e), [56.0, 16.0, 1.0, 0.0, 4.0, 16.0, 32.0])
    assert_allclose(loss(e, math.inf), e**2)


def test_weights_are_those_of_the_loss():
    where, error = with_outliers()
    found = filtered(where, KNOWN, error)
    e = np.nan_to_num(found.standardised)
    slope = (loss(e + 1e-6) - loss(e - 1e-6)) / 2e-6
    assert_allclose(2.0 * found.weight * e, slope, rtol=0, atol=1e-5)
