"""The compiled sums of score and information against the same sums by numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hygrokf.engine.information import summed
from hygrokf.engine.llvm_writer import LANES


@pytest.mark.parametrize("blocks", [1, 3])
@pytest.mark.parametrize("bound", [math.inf, 2.0])
def test_sums_are_those_of_the_formulas(blocks: int, bound: float) -> None:
    random = np.random.default_rng(7)
    count, outputs = 50, 2
    e, s = 3.0 * random.normal(size=(count, outputs)), random.uniform(0.5, 2.0, (count, outputs))
    de, ds = random.normal(size=(2, blocks, count, outputs, LANES))
    missing = random.random((count, outputs)) < 0.3
    e[missing], s[missing] = 0.0, 1.0
    de[:, missing] = ds[:, missing] = 0.0
    a, b = (np.concatenate(list(one), axis=-1) for one in (de, ds))
    weight = np.minimum(1.0, bound**2 * s / np.maximum(e**2, 1e-300))[..., None]
    e_, s_ = e[..., None], s[..., None]
    share = -weight * e_ / s_ * a - 0.5 * (1.0 / s_ - weight * (e_ / s_) ** 2) * b
    expected = np.einsum("tki,tkj->ij", weight * a / s_, a) + 0.5 * np.einsum("tki,tkj->ij", b / s_**2, b)
    scores, information = summed(e, s, de, ds, bound**2)
    # sums of a hundred products, in another order
    assert_allclose(scores, share.sum(axis=1), rtol=1e-12, atol=1e-12)
    assert_allclose(information, expected, rtol=1e-12, atol=1e-12)
    assert (information == information.T).all()


def test_a_broken_filter_gives_sums_that_are_not_finite() -> None:
    e, s = np.array([[1.0], [2.0]]), np.array([[-1.0], [np.nan]])
    scores, information = summed(e, s, *np.ones((2, 1, 2, 1, LANES)), math.inf)
    assert not np.isfinite(scores).any() and not np.isfinite(information).any()
