"""From a continuous model dx = f(x, u) dt + L dW to the moments after one sub-step of length h [h].

The extended Kalman filter's moment equations,

    dm/dt = f(m, u(t)),     dP/dt = A P + P A' + Q,     A = ∂f/∂x at m(t),

are integrated by one fourth-order Magnus step with two Gauss nodes in time.  With `A₁, A₂` the Jacobians at the
nodes and the affine rest b(t) = β + s t through them,

    Ω  = h (A₁+A₂)/2 + (√3/12) h² [A₂, A₁],
    m⁺ = e^Ω m + φ₁(Ω) (h β + (√3/12) h² (A₂−A₁) β) + φ₂(Ω) h (h s + (√3/12) h² (A₂−A₁) s),
    P⁺ = e^Ω P e^Ω' + ∫₀¹ e^{Ωσ} Q̄ e^{Ω'σ} dσ,    Q̄ = h Q + (√3/12) h² ((A₂−A₁) Q + Q (A₂−A₁)').

Rows of a linear model have A₁ = A₂ and an exactly affine b: for them every formula above is *exact* under the
stated hold (zero-order or linear), for any h.  What remains of order h⁵ belongs to the rows that depend on the
state or on a changing input, and is made small by sub-steps (`MAXIMUM_RATE_STEP`).

The exponential and its relatives φ₁, φ₂ are Taylor polynomials in the traced entries, centred at the middle of the
range that sub-steps keep the rates in: a sparse model pays for its non-zeros only, and entries that depend on h and
the parameters alone are computed once for each distinct h.

Sources: Magnus step: Iserles & Nørsett 1999, doi:10.1098/rsta.1999.0362; Van Loan 1978, doi:10.1109/TAC.1978.1101743.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from hygrokf.expression import (
    Expression,
    Graph,
    Matrix,
    add,
    depends_on,
    dot,
    factorials,
    identity,
    is_zero,
    jacobian,
    product,
    scale,
    transpose,
)

MAXIMUM_RATE_STEP = 0.85
"""Largest product of a model's fastest rate and the sub-step."""
VARYING_RATE_STEP = 0.35
"""The same where rates depend on the state or on a changing input: splitting a step then moves ln L by < 1e-6."""
ORDER = 13
"""Degree of the polynomials for e^Ω, φ₁, φ₂: their rest is below 0.425¹⁴/14! = 7e-17 in the range."""
NOISE_ORDER = 15
"""Degree of the polynomial for the accumulated noise: its rest is below e^-0.85 0.85¹⁶/16! = 2e-15."""
NODES = (0.5 - math.sqrt(3.0) / 6.0, 0.5 + math.sqrt(3.0) / 6.0)

Drift = Callable[[Sequence, Mapping[str, object]], list]


@dataclass(frozen=True)
class Step:
    """Traced moments after one sub-step, and the matrices that made them."""

    mean: list
    covariance: Matrix
    transition: Matrix
    noise: Matrix


def step(
    graph: Graph,
    drift: Drift,
    noise: Matrix,
    state: Sequence[Expression],
    covariance: Matrix,
    start: Mapping[str, Expression],
    end: Mapping[str, Expression],
    h: Expression,
) -> Step:
    """Trace one sub-step.

    Arguments: `drift(x, u)` -> list of n [unit of the state per h]; `noise` Q (n, n) [unit² per h]; `state` and
    `covariance` before the step; `start`, `end` the inputs just after its start and just before its end (a
    zero-order input has the same node in both); `h` [h].
    """
    n = len(state)
    field = _Field(graph, drift, n, start)
    inputs = [_between(start, end, c) for c in NODES]
    points = [_predictor(field, state, start, end, c, h) for c in NODES] if field.nonlinear else [state] * 2
    a1, a2 = (field.jacobian_at(x, u) for x, u in zip(points, inputs, strict=True))
    b1, b2 = (field.rest_at(x, u, a) for x, u, a in zip(points, inputs, (a1, a2), strict=True))
    difference = _difference(a2, a1)
    correction = math.sqrt(3.0) / 12.0 * h * h
    mean_rate = [[_mean(x, y) for x, y in zip(r, s, strict=True)] for r, s in zip(a1, a2, strict=True)]
    omega = add(
        scale(h, mean_rate),
        scale(
            correction, _difference(product(a2, a1), product(a1, a2)) if _any(difference) else _zeros(n, n)
        ),
    )
    slope = [_minus(y, x) / ((NODES[1] - NODES[0]) * h) for x, y in zip(b1, b2, strict=True)]
    level = [_minus(x, s * (NODES[0] * h)) for x, s in zip(b1, slope, strict=True)]
    constant = [h * b + correction * dot(row, level) for b, row in zip(level, difference, strict=True)]
    linear = [h * (h * s + correction * dot(row, slope)) for s, row in zip(slope, difference, strict=True)]
    exponential, phi1, phi2 = _exponentials(omega)
    mean = [dot(exponential[i], state) + dot(phi1[i], constant) + dot(phi2[i], linear) for i in range(n)]
    spread = add(product(difference, noise), transpose(product(difference, noise)))
    accumulated = _accumulated(omega, add(scale(h, noise), scale(correction, spread)))
    return Step(
        mean=[graph.lift(v) for v in mean],
        covariance=[[graph.lift(v) for v in row] for row in congruence(exponential, covariance, accumulated)],
        transition=exponential,
        noise=accumulated,
    )


class _Field:
    """f, its Jacobian and its affine rest as functions of where they are taken."""

    def __init__(self, graph: Graph, drift: Drift, n: int, inputs: Mapping[str, Expression]) -> None:
        self.graph = graph
        self.x = [graph.symbol(f"field:x{i}") for i in range(n)]
        self.u = {name: graph.symbol(f"field:u:{name}") for name in inputs}
        self.f = [graph.lift(v) for v in drift(self.x, self.u)]
        self.jacobian = jacobian(self.f, self.x)
        names = [f"field:x{i}" for i in range(n)]
        self.curved = [any(depends_on(graph, v, names) for v in row) for row in self.jacobian]
        self.nonlinear = any(self.curved)

    def _at(self, expressions: Sequence, x: Sequence, u: Mapping[str, Expression]) -> list:
        values = {s.index: self.graph.lift(v) for s, v in zip(self.x, x, strict=True)}
        values |= {self.u[name].index: self.graph.lift(u[name]) for name in self.u}
        result = self.graph.substitute(expressions, values)
        return [0.0 if is_zero(v) else v for v in result]

    def value_at(self, x: Sequence, u: Mapping[str, Expression]) -> list:
        return self._at(self.f, x, u)

    def jacobian_at(self, x: Sequence, u: Mapping[str, Expression]) -> Matrix:
        return [self._at(row, x, u) for row in self.jacobian]

    def rest_at(self, x: Sequence, u: Mapping[str, Expression], a: Matrix) -> list:
        """b = f(x) − A x; for rows that are affine in the state simply f(0), free of cancellation."""
        zero = self._at(self.f, [0.0] * len(self.x), u)
        if not self.nonlinear:
            return zero
        value = self.value_at(x, u)
        return [_minus(value[i], dot(a[i], x)) if self.curved[i] else zero[i] for i in range(len(value))]


def _between(start: Mapping, end: Mapping, c: float) -> dict[str, Expression]:
    return {
        name: start[name]
        if start[name].index == end[name].index
        else start[name] + c * (end[name] - start[name])
        for name in start
    }


def _predictor(field: _Field, x: Sequence, start: Mapping, end: Mapping, c: float, h: Expression) -> list:
    """The state at the fraction c of the step, by the midpoint rule: where the field is linearised."""
    half = [v + (0.5 * c) * h * k for v, k in zip(x, field.value_at(x, start), strict=True)]
    middle = field.value_at(half, _between(start, end, 0.5 * c))
    return [v + c * h * k for v, k in zip(x, middle, strict=True)]


def _exponentials(omega: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """e^Ω, φ₁(Ω) = ∫₀¹ e^{Ωσ} dσ, φ₂(Ω) = ∫₀¹ (1−σ) e^{Ωσ} dσ, as polynomials in Ω + μ I."""
    n = len(omega)
    centre = 0.5 * MAXIMUM_RATE_STEP
    coefficients = [_taylor(centre, weight, ORDER) for weight in (None, 0, 1)]
    shifted = add(omega, scale(centre, identity(n)))
    power = identity(n)
    sums = [scale(c[0], power) for c in coefficients]
    for k in range(1, ORDER + 1):
        power = product(power, shifted) if k > 1 else shifted
        sums = [add(total, scale(c[k], power)) for c, total in zip(coefficients, sums, strict=True)]
    return sums[0], sums[1], sums[2]


def _taylor(centre: float, weight: int | None, order: int) -> list[float]:
    """Taylor coefficients about z = −centre of e^z (weight None) or of ∫₀¹ (1−σ)^weight e^{zσ} dσ."""
    if weight is None:
        return [math.exp(-centre) / f for f in factorials(order + 1)]
    terms = 40  # of the series of e^{−centre σ}: beyond machine precision for centre < 1
    inverse = [1.0 / f for f in factorials(terms + order + 2)]
    result = []
    for k in range(order + 1):
        moments = (
            (1.0 / (k + j + 1) if weight == 0 else 1.0 / ((k + j + 1) * (k + j + 2))) for j in range(terms)
        )
        result.append(inverse[k] * math.fsum((-centre) ** j * inverse[j] * m for j, m in enumerate(moments)))
    return result


def _accumulated(omega: Matrix, noise: Matrix) -> Matrix:
    """∫₀¹ e^{Ωσ} Q̄ e^{Ω'σ} dσ, a polynomial in L + 2μ with L(X) = Ω X + X Ω'."""
    n = len(omega)
    centre = 0.5 * MAXIMUM_RATE_STEP
    coefficients = _taylor(2.0 * centre, 0, NOISE_ORDER)
    shifted = add(omega, scale(centre, identity(n)))
    term = noise
    total = scale(coefficients[0], noise)
    for c in coefficients[1:]:
        half = product(shifted, term)
        term = _symmetric([[half[i][j] + half[j][i] for j in range(i + 1)] for i in range(n)])
        if not _any(term):
            break
        total = add(total, scale(c, term))
    return total


def congruence(f: Matrix, p: Matrix, q: Matrix | None = None) -> Matrix:
    """F P F' + Q, its lower triangle computed and mirrored."""
    n = len(f)
    q = _zeros(n, n) if q is None else q
    fp = product(f, p)
    return _symmetric([[dot(fp[i], f[j]) + q[i][j] for j in range(i + 1)] for i in range(n)])


def _symmetric(lower: Matrix) -> Matrix:
    n = len(lower)
    return [[lower[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]


def _difference(a: Matrix, b: Matrix) -> Matrix:
    return [[_minus(x, y) for x, y in zip(r, s, strict=True)] for r, s in zip(a, b, strict=True)]


def _minus(x, y):
    result = x - y
    return 0.0 if is_zero(result) else result


def _mean(x, y):
    if isinstance(x, Expression) and isinstance(y, Expression) and x.index == y.index:
        return x
    return 0.0 if is_zero(x) and is_zero(y) else 0.5 * (x + y)


def _any(a: Matrix) -> bool:
    return not all(is_zero(x) for row in a for x in row)


def _zeros(n: int, m: int) -> Matrix:
    return [[0.0] * m for _ in range(n)]
