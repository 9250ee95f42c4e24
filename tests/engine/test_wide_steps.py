"""Matrices of whole steps against scipy's exponential (Van Loan's block matrices)."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm

from hygrokf.engine.wide_recursion import bound, powers, series

N, HOURS = 5, np.array([0.0, 0.01, 0.3, 1.0, 2.0, 50.0])
DRIVEN = np.eye(N)[:, [0, 3]]


def systems(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Stable Jacobians (K, n, n) whose states have units that differ by 10⁶, and noise intensities."""
    random = np.random.default_rng(seed)
    a = random.uniform(0.0, 1.0, (len(HOURS), N, N))
    a -= np.eye(N) * (a.sum(axis=2) + random.uniform(0.1, 9.0, (len(HOURS), N)))[:, :, None]
    units = np.array([1.0, 1e-3, 1.0, 1e3, 1.0])
    noise = np.eye(N) * random.uniform(1.0, 2.0, (len(HOURS), 1, N)) * units**2
    return a * units[:, None] / units, noise


def together(a: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T (K, n, w) and N (K, n, n) of all steps."""
    whole, noise = np.empty((len(a), N, N + 4)), np.empty_like(q)
    for places, found in powers(series(a, q, DRIVEN), np.arange(len(a)), HOURS):
        whole[places], noise[places] = found.whole, found.noise
    return whole, noise


def test_steps_are_those_of_block_matrices() -> None:
    a, q = systems()
    whole, noise = together(a, q)
    for k, h in enumerate(HOURS):
        field = np.zeros((N + 4, N + 4))
        field[:N, :N], field[:N, N : N + 2], field[N : N + 2, N + 2 :] = a[k], DRIVEN, np.eye(2)
        # scipy's own errors reach 1e-11 where the products of rate and step reach 500
        expected = expm(field * h)[:N]
        scale = np.abs(expected).max(axis=1, keepdims=True)
        assert_allclose(whole[k] + np.eye(N, N + 4), expected, rtol=1e-9, atol=1e-10 * scale.max())
        # N solves A N + N A' = e^{Ah} Q e^{A'h} − Q
        f = whole[k, :, :N] + np.eye(N)
        balance = a[k] @ noise[k] + noise[k] @ a[k].T - (f @ q[k] @ f.T - q[k])
        assert np.abs(balance).max() < 1e-12 * np.abs(a[k] @ noise[k]).max() + 1e-300


@pytest.mark.parametrize("seed", range(3))
def test_the_bound_holds_for_any_matrix_and_units(seed: int) -> None:
    random = np.random.default_rng(seed)
    matrix = random.normal(size=(200, N, N)) * random.choice([0.0, 1.0, 30.0], size=(200, N, N))
    units = 10.0 ** random.uniform(-2.0, 2.0, N)
    size = np.abs(np.linalg.eigvals(matrix)).max(axis=1)
    found = bound(matrix * units[:, None] / units)
    # eigenvalues of a matrix whose only cycles vanish are zero but for rounding
    assert (found >= size * (1.0 - 1e-9) - 1e-2).all()


def test_the_bound_is_that_of_a_ring() -> None:
    """Three states, each of which drives the next one at 30 a unit of time."""
    ring = 30.0 * np.roll(np.eye(3), 1, axis=1) - 0.1 * np.eye(3)
    assert 30.0 <= bound(ring[None])[0] <= 31.0
