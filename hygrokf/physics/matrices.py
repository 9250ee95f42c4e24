"""Matrices of expressions, as lists of rows; structural zeros cost nothing."""

from __future__ import annotations

from collections.abc import Sequence

from hygrokf.physics.expression import Expression, Matrix, Value, is_zero


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
    """A + B."""
    return [[x + y for x, y in zip(r, s, strict=True)] for r, s in zip(a, b, strict=True)]


def scale(factor: Value, a: Matrix) -> Matrix:
    """A matrix times a factor."""
    return [[0.0 if is_zero(x) else factor * x for x in row] for row in a]


def identity(n: int) -> Matrix:
    """The identity (n, n)."""
    return [[1.0 if i == j else 0.0 for j in range(n)] for i in range(n)]


def transpose(a: Matrix) -> Matrix:
    """A'."""
    return [list(row) for row in zip(*a, strict=True)]


def zeros(n: int, m: int) -> Matrix:
    """A matrix (n, m) of structural zeros."""
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
    """The symmetric matrix with this lower triangle; rows of `lower` may end at the diagonal."""
    n = len(lower)
    return [[lower[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]


def closure(a: Matrix) -> list[list[bool]]:
    """(n, n) True where some power A, A², … of a matrix has an entry that is not structurally zero."""
    n = len(a)
    reaches = [[not is_zero(v) for v in row] for row in a]
    for k in range(n):
        for i in range(n):
            if reaches[i][k]:
                reaches[i] = [x or y for x, y in zip(reaches[i], reaches[k], strict=True)]
    return reaches


def difference(a: Matrix, b: Matrix) -> Matrix:
    """A − B."""
    return [[minus(x, y) for x, y in zip(r, s, strict=True)] for r, s in zip(a, b, strict=True)]


def minus(x: Value, y: Value) -> Value:
    """x − y, the float 0.0 where that is a structural zero."""
    result = x - y
    return 0.0 if is_zero(result) else result


def mean_of(x: Value, y: Value) -> Value:
    """(x + y)/2, without an operation where both are the same."""
    if isinstance(x, Expression) and isinstance(y, Expression) and x.index == y.index:
        return x
    return 0.0 if is_zero(x) and is_zero(y) else 0.5 * (x + y)


def has_entries(a: Matrix) -> bool:
    """Whether an entry is not a structural zero."""
    return not all(is_zero(x) for row in a for x in row)


def same(x: Value, y: Value) -> bool:
    """Whether two values are one node, or both structural zeros."""
    if isinstance(x, Expression) and isinstance(y, Expression):
        return x.index == y.index
    return is_zero(x) and is_zero(y)
