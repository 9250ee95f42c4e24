"""Moments before the first reading and their derivatives, against closed forms and differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from hygrokf.engine.timeline import timeline
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.start import prior, prior_slopes, stationary, stationary_with_slopes
from hygrokf.physics.expression import exp
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import Model, compose
from hygrokf.physics.parameters import Parameter

VALUES = {"k": 0.7, "c": 2.5, "q": 0.3, "r": 0.2}


def radiating() -> Model:
    """A mass that loses heat by k x² + exp(−x) and feeds a slower one; no steady state in closed form."""
    made = linear_network(
        "radiating",
        [Parameter(name, "1", 1.0, 0.01, 9.0, positive=True) for name in VALUES],
        ["x", "z"],
        ["u"],
        lambda p, x, u: {"x": u.u - p.k * x.x * x.x - exp(-x.x), "z": (x.x - x.z) / p.c},
        {"y": lambda p, x, u: (x.z, p.r**2)},
        lambda p: {"x": p.q**2, "z": 0.1 * p.q / p.c},
        lambda p, u: {"x": (u.u / p.k, p.q / p.c), "z": (1.0 + p.c, 0.5)},
    )
    return compose([made], {"u": "linear"})


def steady(values: dict[str, float], u: float) -> np.ndarray:
    """Mean and packed covariance of the steady state: a root, and a chain's covariance in closed form."""
    k, c, q = (values[name] for name in ("k", "c", "q"))
    x = brentq(lambda x: u - k * x * x - math.exp(-x), 1.0, 9.0, xtol=1e-15, rtol=1e-15)
    a, b = -2 * k * x + math.exp(-x), 1 / c
    first = q**2 / (-2 * a)
    cross = b * first / (b - a)
    return np.array([x, x, first, cross, (2 * b * cross + q / (10 * c)) / (2 * b)])


def packed(mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.concatenate([mean, covariance[..., [0, 1, 1], [0, 0, 1]]], axis=-1)


def test_a_nonlinear_steady_state_and_its_slopes() -> None:
    """Against a bracketed root, and Richardson's differences of it, which have ten digits; Newton's steps end
    where one moves the mean by less than 1e-13 of it."""
    model = radiating()
    found, slopes = stationary_with_slopes(model, VALUES, {"u": 3.0})
    np.testing.assert_allclose(packed(found.mean, found.covariance), steady(VALUES, 3.0), rtol=1e-12)
    for i, (name, value) in enumerate(VALUES.items()):
        h = 2e-3 * value
        ends = [steady({**VALUES, name: value + s * h}, 3.0) for s in (-2, -1, 1, 2)]
        expected = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
        own = packed(slopes.mean[i], slopes.covariance[i])
        np.testing.assert_allclose(own, expected, rtol=1e-9, atol=1e-11)


def test_slopes_of_the_mechanisms_own_law() -> None:
    slopes = prior_slopes(radiating(), VALUES, {"u": 3.0})
    k, c, q = (VALUES[name] for name in ("k", "c", "q"))
    np.testing.assert_allclose(slopes.mean, [[-3.0 / k**2, 0.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(slopes.covariance[:, 0, 0], [0.0, -q / c**2, 1.0 / c, 0.0])
    assert not slopes.covariance[:, 1].any()


def test_every_mechanism_of_the_cabinets_takes_steps_along_all_parameters(joint: object) -> None:
    """The slopes of the prior are its central differences."""
    inputs = Likelihood(joint.model, joint.timeline).first_inputs()
    slopes = prior_slopes(joint.model, joint.values, inputs)
    for i, (name, value) in enumerate(joint.values.items()):
        step = 1e-5 * max(abs(value), 1e-3)
        up, down = (prior(joint.model, {**joint.values, name: value + s}, inputs) for s in (step, -step))
        np.testing.assert_allclose(slopes.mean[i], (up.mean - down.mean) / (2 * step), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(
            slopes.covariance[i], (up.covariance - down.covariance) / (2 * step), rtol=1e-6, atol=1e-9
        )


@pytest.mark.parametrize("law", ["prior", "stationary"])
def test_the_score_takes_the_start_with_it(law: str) -> None:
    """Richardson's differences of ln L over 12 instants, where the start weighs most."""
    model = radiating()
    line = timeline(model, np.arange(12.0) / 4, {"u": np.full(12, 3.0)}, {"y": 2.0 + np.sin(np.arange(12.0))})
    likelihood = Likelihood(model, line, law)
    _, score = likelihood.score(VALUES)
    for name, slope in zip(VALUES, score, strict=True):
        h = 1e-3 * VALUES[name]
        ends = [likelihood.value({**VALUES, name: VALUES[name] + s * h}) for s in (-2, -1, 1, 2)]
        assert slope == pytest.approx((ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h), rel=1e-7)


def test_no_steady_state_is_said() -> None:
    grows = linear_network(
        "grows", [Parameter("q", "1", 1.0, 0.0, 9.0)], ["x"], [], lambda p, x, u: {"x": 1.0 + 0.0 * x.x},
        {"y": lambda p, x, u: (x.x, 1.0)}, lambda p: {"x": p.q}, lambda p, u: {"x": (0.0, 1.0)},
    )  # fmt: skip
    model = compose([grows])
    with pytest.raises(ValueError, match="no stationary state"):
        stationary(model, {"q": 1.0}, {})
