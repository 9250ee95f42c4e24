"""A Kalman filter with 200 digits, written out: the oracle where doubles lose theirs.

An unknown start is a variance κ = 10^120; ln L + ½ ln κ for each of its states is the exact diffuse value but
for a share of 1/κ.
"""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal, localcontext

import numpy as np

Rows = list[list[Decimal]]
WIDE = Decimal(10) ** 120


def matrix(rows: Sequence[Sequence[object]]) -> Rows:
    return [[Decimal(v) for v in row] for row in rows]


def times(a: Rows, b: Rows) -> Rows:
    return [
        [sum((x * y for x, y in zip(row, c, strict=True)), Decimal(0)) for c in zip(*b, strict=True)]
        for row in a
    ]


def turned(a: Rows) -> Rows:
    return [list(row) for row in zip(*a, strict=True)]


def plus(a: Rows, b: Rows) -> Rows:
    return [[x + y for x, y in zip(r, s, strict=True)] for r, s in zip(a, b, strict=True)]


def filtered(
    steps: Sequence[tuple[Rows, Rows]],
    rows: Sequence[Sequence[float]],
    noise: Sequence[float],
    start: tuple[Sequence[float], Sequence[float]],
    y: np.ndarray,
    unknown: Sequence[int] = (),
) -> tuple[float, np.ndarray, np.ndarray]:
    """ln L, and the means (T, n) and covariances (T, n, n) after each instant.

    `steps` (F, Q) before each instant but the first; slopes `rows` (k, n) and variances `noise` (k,) of the
    readings y (T, k); `start` the mean (n,) and the variances (n,).
    """
    with localcontext() as context:
        context.prec = 200
        n, two_pi = (
            len(start[0]),
            2 * Decimal("3.14159265358979323846264338327950288419716939937510582097494"),
        )
        m = [[Decimal(0 if i in unknown else v)] for i, v in enumerate(start[0])]
        p = [
            [(WIDE if i in unknown else Decimal(start[1][i])) if i == j else Decimal(0) for j in range(n)]
            for i in range(n)
        ]
        total, means, covariances = Decimal(0), [], []
        for k, readings in enumerate(y):
            if k:
                f, q = steps[k - 1]
                m, p = times(f, m), plus(times(times(f, p), turned(f)), q)
            for row, r, reading in zip(rows, noise, readings, strict=True):
                if np.isnan(reading):
                    continue
                h = matrix([row])
                c = times(p, turned(h))
                s = times(h, c)[0][0] + Decimal(r)
                e = Decimal(float(reading)) - times(h, m)[0][0]
                m = [[v[0] + g[0] * e / s] for v, g in zip(m, c, strict=True)]
                p = [[p[i][j] - c[i][0] * c[j][0] / s for j in range(n)] for i in range(n)]
                total -= ((two_pi * s).ln() + e * e / s) / 2
            means.append([float(v[0]) for v in m])
            covariances.append([[float(v) for v in row] for row in p])
        total += len(unknown) * WIDE.ln() / 2
        return float(total), np.array(means), np.array(covariances)


def trend(hours: float, intensities: tuple[float, float]) -> tuple[Rows, Rows]:
    """F and Q of a position that a random velocity moves, both with white noise of these intensities."""
    with localcontext() as context:
        context.prec = 200
        h, a, b = Decimal(hours), *map(Decimal, intensities)
        f = [[Decimal(1), h], [Decimal(0), Decimal(1)]]
        return f, [[a * h + b * h**3 / 3, b * h * h / 2], [b * h * h / 2, b * h]]


def decay(hours: float, time_constant: float, intensity: float) -> tuple[Rows, Rows]:
    """F and Q of a state that returns to zero."""
    with localcontext() as context:
        context.prec = 200
        tau = Decimal(time_constant)
        f = (-Decimal(hours) / tau).exp()
        return [[f]], [[Decimal(intensity) * tau / 2 * (1 - f * f)]]
