"""Memory layout of the moments: a mean, then the lower triangle of a covariance by rows."""

from __future__ import annotations

from functools import cache

import numpy as np


def place(i: int, j: int) -> int:
    """Place of entry (i, j) in a packed lower triangle."""
    i, j = max(i, j), min(i, j)
    return i * (i + 1) // 2 + j


def trace_width(width: int, n: int, outputs: int) -> int:
    """Count of numbers in a row of a trace: moments (`width`) before and after the readings, prediction and
    variance of every output, transition matrix (n, n), and packed noise of the step."""
    return 2 * width + 2 * outputs + n * n + n * (n + 1) // 2


@cache
def _places(n: int) -> np.ndarray:
    return np.array([[place(i, j) for j in range(n)] for i in range(n)])


@cache
def _triangle(n: int) -> tuple[np.ndarray, np.ndarray]:
    return np.tril_indices(n)


def unpack(packed: np.ndarray, n: int) -> np.ndarray:
    """Packed lower triangles (..., q) as symmetric matrices (..., n, n)."""
    return packed[..., _places(n)]


def pack(matrix: np.ndarray) -> np.ndarray:
    """Symmetric matrices (..., n, n) as packed lower triangles (..., q)."""
    rows, columns = _triangle(matrix.shape[-1])
    return np.ascontiguousarray(matrix[..., rows, columns])
