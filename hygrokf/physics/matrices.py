"""Matrices of expressions, as lists of rows; structural zeros cost nothing."""

from __future__ import annotations

from collections.abc import Sequence

from hygrokf.physics.expression import Matrix, Value, is_zero


def product(a: Matrix, b: Matrix) -> Matrix:
    """Matrix product that skips structural zeros."""
    rows, inner, columns = len(a), len(b), len(b[0])
    return [
        [dot([a[i][k] for k in range(inner)], [b[k][j] for k in range(inner)]) for j in range(columns)]
        for i in range(rows)
    ]


def dot(a: Sequence[Value], b: Sequence[Value]) -> Value:
    """Scalar product that skips structural zeros."""
    total: Value = 0.0
    for x, y in zip(a, b, strict=True):
        if not is_zero(x) and not is_zero(y):
            total = x * y if is_zero(total) else total + x * y
    return total


def add(a: Matrix, b: Matrix) -> Matrix:
    return [[x + y for x, y in zip(r, s, strict=True)] for r, s in zip(a, b, strict=True)]


def scale(factor: Value, a: Matrix) -> Matrix:
    return [[0.0 if is_zero(x) else factor * x for x in row] for row in a]


def identity(n: int) -> Matrix:
    return [[1.0 if i == j else 0.0 for j in range(n)] for i in range(n)]


def transpose(a: Matrix) -> Matrix:
    return [list(row) for row in zip(*a, strict=True)]


def zeros(n: int, m: int) -> Matrix:
    return [[0.0] * m for _ in range(n)]


def congruence(f: Matrix, p: Matrix, q: Matrix | None = None) -> Matrix:
    """F P F' + Q; the lower triangle is computed and mirrored."""
    n = len(f)
    q = zeros(n, n) if q is None else q
    fp = product(f, p)
    nonzero = [[k for k, v in enumerate(row) if not is_zero(v)] for row in f]

    def entry(i: int, j: int) -> Value:
        if len(nonzero[i]) == 1 and len(nonzero[j]) == 1:
            (k,), (m,) = nonzero[i], nonzero[j]
            return (f[i][k] * f[j][m]) * p[k][m]
        return dot(fp[i], f[j])

    return symmetric([[entry(i, j) + q[i][j] for j in range(i + 1)] for i in range(n)])


def symmetric(lower: Matrix) -> Matrix:
    n = len(lower)
    return [[lower[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]
