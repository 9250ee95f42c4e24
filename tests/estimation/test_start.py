"""Moments before the first reading and their derivatives, against closed forms and differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from hygrokf.engine.timeline import timeline
from hygrokf.engine.traced_filter import traced
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.start import stationary_with_slopes
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
    found, slopes = stationary_with_slopes(model, traced(model), VALUES, {"u": 3.0})
    np.testing.assert_allclose(packed(found.mean, found.covariance), steady(VALUES, 3.0), rtol=1e-12)
    for i, (name, value) in enumerate(VALUES.items()):
        h = 2e-3 * value
        ends = [steady({**VALUES, name: value + s * h}, 3.0) for s in (-2, -1, 1, 2)]
        expected = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
        own = packed(slopes.mean[i], slopes.covariance[i])
        np.testing.assert_allclose(own, expected, rtol=1e-9, atol=1e-11)


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
