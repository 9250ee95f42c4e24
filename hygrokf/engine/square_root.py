"""Covariances as factors P = L D L', L unit lower triangular, D diagonal, which keep the sign and the digits.

The difference P − c c'/S loses all digits where a reading is far more exact than the prediction.
Factors are corrected by sums of positive terms only, and predicted by a weighted orthogonalisation,

    L D L' = [F L  L_Q] diag(D, D_Q) [F L  L_Q]',

so that they stay accurate for ratios P/R up to 1e24, the plain form only up to 1e9.

Packed (lower triangle by rows), the diagonal holds D.  Where a running mean restarts, its row of L is zero,
including the diagonal, until the next prediction.

Sources: Bierman 1977, Factorization methods for discrete sequential estimation, chapters V (correction) and
VI; Thornton 1976, NASA CR-149218 (prediction).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hygrokf.physics.expression import Expression, Matrix, Value, is_zero, where
from hygrokf.physics.matrices import dot, identity


def factors(matrix: Matrix) -> tuple[Matrix, list[Value]]:
    """L (n, n) and D (n,) of a traced matrix that has no negative eigenvalue."""
    n, rest = len(matrix), [list(row) for row in matrix]
    lower, diagonal = identity(n), []
    for j in range(n):
        inverse = 1.0 / _or_one(rest[j][j])
        diagonal.append(_positive(rest[j][j]))
        for i in range(j + 1, n):
            lower[i][j] = dot([rest[i][j]], [inverse])
        for i in range(j + 1, n):
            for k in range(j + 1, i + 1):
                rest[i][k] = _minus_product(rest[i][k], lower[i][j], rest[k][j])
    return lower, diagonal


def orthogonalised(rows: Matrix, weights: Sequence[Value]) -> tuple[Matrix, list[Value]]:
    """L (n, n) and D (n,) with L D L' = W diag(weights) W', W the rows (n, m), by modified Gram–Schmidt."""
    n, rest = len(rows), [list(row) for row in rows]
    lower, diagonal = identity(n), []
    for k in range(n):
        weighted = [dot([w], [x]) for w, x in zip(weights, rest[k], strict=True)]
        diagonal.append(dot(weighted, rest[k]))
        inverse = 1.0 / _or_one(diagonal[k])
        for i in range(k + 1, n):
            lower[i][k] = dot([dot(weighted, rest[i])], [inverse])
            rest[i] = [_minus_product(x, lower[i][k], y) for x, y in zip(rest[i], rest[k], strict=True)]
    return lower, diagonal


def corrected(
    lower: Matrix, diagonal: Sequence[Value], row: Sequence[Value], noise: Value
) -> tuple[Matrix, list[Value]]:
    """Trace the factors L and D after a reading with the derivatives `row` (n,) and the noise variance
    `noise`, by Bierman's correction: one state after the other, from the last one."""
    n = len(lower)
    projected = [dot([lower[i][j] for i in range(j, n)], row[j:]) for j in range(n)]
    new_lower, new_diagonal = [list(r) for r in lower], list(diagonal)
    gain: list[Value] = [0.0] * n
    total = noise
    for j in reversed(range(n)):
        if is_zero(projected[j]):
            continue
        gain_term = diagonal[j] * projected[j]
        new_total = total + gain_term * projected[j]
        new_diagonal[j] = diagonal[j] * (total * (1.0 / _or_one(new_total)))
        factor = projected[j] * (1.0 / _or_one(total))
        for i in range(j + 1, n):
            new_lower[i][j] = _minus_product(lower[i][j], factor, gain[i])
        for i in range(j, n):
            gain[i] = gain[i] + dot([lower[i][j]], [gain_term])
        total = new_total
    return new_lower, new_diagonal


def _or_one(value: Value) -> Value:
    """The value, or 1 where it is not above 0: the numerator is 0 in that case."""
    if isinstance(value, Expression):
        return where(value > 0.0, value, 1.0)
    return value if value > 0.0 else 1.0


def _positive(value: Value) -> Value:
    """The value, or 0 where it is not above 0."""
    return where(value > 0.0, value, 0.0) if isinstance(value, Expression) else max(value, 0.0)


def _minus_product(value: Value, a: Value, b: Value) -> Value:
    """value − a b, without an operation where a or b is a structural zero."""
    return value if is_zero(a) or is_zero(b) else value - a * b


# -- numbers -------------------------------------------------------------------------------------------------
def factored(covariance: np.ndarray) -> np.ndarray:
    """Factors of covariances (…, n, n) in one matrix, L below the diagonal, D on it."""
    rest, n = np.array(covariance, dtype=float), covariance.shape[-1]
    result = np.zeros_like(rest)
    for j in range(n):
        pivot = rest[..., j, j]
        result[..., j, j] = np.where(pivot > 0.0, pivot, 0.0)
        column = rest[..., j + 1 :, j] / np.where(pivot > 0.0, pivot, 1.0)[..., None]
        column = np.where(pivot[..., None] > 0.0, column, 0.0)
        rest[..., j + 1 :, j + 1 :] -= column[..., :, None] * rest[..., None, j + 1 :, j]
        result[..., j + 1 :, j] = column
    return result


def factored_slopes(covariance: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Derivatives (r, n, n) of `factored` from those of a covariance (n, n); 0 where D is 0.

    dD = diag M,    dL = L tril(M D⁻¹, −1),    M = L⁻¹ dP L'⁻¹.
    """
    factors_ = factored(covariance)
    lower, diagonal = np.tril(factors_, -1) + np.eye(len(factors_)), np.diag(factors_)
    inverse = np.linalg.inv(lower)
    inner = np.where(diagonal > 0.0, inverse @ slopes @ inverse.T, 0.0)
    result = lower @ np.tril(inner / np.where(diagonal > 0.0, diagonal, 1.0), -1)
    index = np.arange(len(factors_))
    result[:, index, index] = inner[:, index, index]
    return result


def square_root(covariance: np.ndarray) -> np.ndarray:
    """L √D (…, n, n) of covariances (…, n, n)."""
    factors_, index = factored(covariance), np.arange(covariance.shape[-1])
    root = np.sqrt(factors_[..., index, index])
    factors_[..., index, index] = 1.0
    return factors_ * root[..., None, :]
