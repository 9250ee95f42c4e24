"""From a continuous model dx = f(x, u) dt + L dW to the moments after one sub-step of length h [h].

The extended Kalman filter's moment equations,

    dm/dt = f(m, u(t)),     dP/dt = A P + P A' + Q,     A = ∂f/∂x at m(t),

are integrated by one Magnus step with two Gauss nodes in time.  With the Jacobians `A₁, A₂` at the nodes, the
remainder b = f − A (x − x₀) interpolated through them as b(t) = β + s t, and D = A₂ − A₁,

    Ω  = h (A₁+A₂)/2 + (√3/12) h² [A₂, A₁],
    m⁺ = x₀ + e^Ω (m−x₀) + φ₁(Ω) (h β + (√3/12) h² D β) + φ₂(Ω) h (h s + (√3/12) h² D s),
    P⁺ = e^Ω P e^Ω' + ∫₀¹ e^{Ωσ} Q̄ e^{Ω'σ} dσ,    Q̄ = h Q + (√3/12) h² (D Q + Q D').

An intensity Q that follows a changing input is a parabola through its values at the start, the middle and the
end of a sub-step: under constant rates the accumulated noise is exact for the square of a linear input, and
of order h⁵ a sub-step for any other function.

Rows of a linear model have A₁ = A₂ and an exactly affine b.  For them every formula above is *exact* under
the stated hold (constant or linear) for any h, and with x₀ = 0 the matrix e^Ω and its relatives are
computed only once.  Where rates vary, x₀ = m: the remainder then changes with what happens within the step
and not with the distance of the state from zero (kelvins from absolute zero), which makes the error of a
sub-step about 250 times smaller.  This error is of order h⁵ for the mean and of order h⁴ for the covariance,
whose Jacobians are taken where a second-order rule places the nodes.  Sub-steps keep both below a stated size
(`VARYING_RATES`).

The exponential and its relatives φ₁, φ₂ are Taylor polynomials in the traced entries, centred in the range of
rates that sub-steps permit.  A sparse model costs as much as its non-zero entries, and entries that depend
only on h and the parameters are computed once for each distinct h.

Sources: Magnus step: Iserles & Nørsett 1999, doi:10.1098/rsta.1999.0362; Van Loan 1978,
doi:10.1109/TAC.1978.1101743.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from hygrokf.physics.expression import (
    Expression,
    Graph,
    Matrix,
    Value,
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
from hygrokf.physics.model import Values


@dataclass(frozen=True)
class Range:
    """Limit of the sub-steps h, and the degrees of the polynomials for this range.

    `rate_step` is the largest product of the model's fastest rate and h.  `order` is the degree of the
    polynomials for e^Ω, φ₁ and φ₂, with the remainder (rate_step/2)^(order+1) / (order+1)!; `noise_order`
    that of the accumulated noise, with the remainder rate_step^(noise_order+1) / (noise_order+1)!.
    """

    rate_step: float
    order: int
    noise_order: int


CONSTANT_RATES = Range(rate_step=0.85, order=13, noise_order=15)
"""Rates that are constant within a step: the step is exact, with remainders of 7e-17 and 2e-15."""
VARYING_RATES = Range(rate_step=0.35, order=8, noise_order=9)
"""Rates that depend on the state or on a changing input: splitting a step changes ln L by < 1e-6; remainders
4e-13, 8e-12."""
NODES = (0.5 - math.sqrt(3.0) / 6.0, 0.5 + math.sqrt(3.0) / 6.0)

Drift = Callable[[Sequence[Value], Values], list[Value]]
"""(x, u) -> rates (n,) [unit of the state per h]."""
Inputs = Mapping[str, Expression]


@dataclass(frozen=True)
class Step:
    """Traced moments after one sub-step, and the matrices that made them."""

    mean: list[Expression]
    covariance: Matrix
    transition: Matrix
    noise: Matrix


def step(
    graph: Graph,
    drift: Drift,
    noise: Callable[[Values], Matrix],
    state: Sequence[Expression],
    covariance: Matrix,
    start: Inputs,
    end: Inputs,
    h: Expression,
) -> Step:
    """Trace one sub-step.

    `drift(x, u)` -> list of n rates [unit of the state per h]; `noise(u)` -> Q (n, n) [unit² per h]; `state`
    and `covariance` before the step; `start` and `end` the inputs just after its start and just before its
    end (a constant input has the same node in both); `h` [h].
    """
    n = len(state)
    field = _Field(graph, drift, n, start)
    inputs = [_between(start, end, c) for c in NODES]
    points = [_predictor(field, state, start, end, c, h) for c in NODES] if field.nonlinear else [state] * 2
    a1, a2 = (field.jacobian_at(x, u) for x, u in zip(points, inputs, strict=True))
    difference = _difference(a2, a1)
    origin = state if _any(difference) else [0.0] * n
    b1, b2 = (field.rest_at(x, u, a, origin) for x, u, a in zip(points, inputs, (a1, a2), strict=True))
    correction = math.sqrt(3.0) / 12.0 * h * h
    mean_rate = [[_mean(x, y) for x, y in zip(r, s, strict=True)] for r, s in zip(a1, a2, strict=True)]
    omega = add(
        scale(h, mean_rate),
        scale(
            correction, _difference(product(a2, a1), product(a1, a2)) if _any(difference) else _zeros(n, n)
        ),
    )
    span = VARYING_RATES if _any(difference) else CONSTANT_RATES
    exponential, phi1, phi2 = _exponentials(omega, span)
    # b(t) is the straight line through b1 and b2 at the nodes; the weights of both do not depend on the
    # inputs
    gap = NODES[1] - NODES[0]
    early = _weights(phi1, NODES[1] / gap, phi2, -1.0 / gap)
    late = _weights(phi1, -NODES[0] / gap, phi2, 1.0 / gap)
    early, late = (_corrected(h, m, correction, difference) for m in (early, late))
    mean = [_driven(early[i], b1, late[i], b2) for i in range(n)]
    carried = state if _any(difference) else [dot(row, state) for row in exponential]
    mean = [x + v for x, v in zip(carried, mean, strict=True)]
    intensities = [noise(inputs[0])]
    if _any(_difference(noise(inputs[1]), intensities[0])):
        intensities = [noise(_between(start, end, c)) for c in (0.0, 0.5, 1.0)]
    spreads = [add(product(difference, q), transpose(product(difference, q))) for q in intensities]
    sums = [add(scale(h, q), scale(correction, v)) for q, v in zip(intensities, spreads, strict=True)]
    accumulated = _accumulated(omega, sums, span)
    return Step(
        mean=[graph.lift(v) for v in mean],
        covariance=[[graph.lift(v) for v in row] for row in congruence(exponential, covariance, accumulated)],
        transition=exponential,
        noise=accumulated,
    )


class _Field:
    """f, its Jacobian and its affine remainder as functions of the point at which they are taken."""

    def __init__(self, graph: Graph, drift: Drift, n: int, inputs: Inputs) -> None:
        self.graph = graph
        self.x = [graph.symbol(f"field:x{i}") for i in range(n)]
        self.u = {name: graph.symbol(f"field:u:{name}") for name in inputs}
        self.f = [graph.lift(v) for v in drift(self.x, self.u)]
        self.jacobian = jacobian(self.f, self.x)
        names = [f"field:x{i}" for i in range(n)]
        self.curved = [any(depends_on(graph, v, names) for v in row) for row in self.jacobian]
        self.nonlinear = any(self.curved)

    def _at(self, expressions: Sequence[Value], x: Sequence[Value], u: Inputs) -> list[Value]:
        values = {s.index: self.graph.lift(v) for s, v in zip(self.x, x, strict=True)}
        values |= {self.u[name].index: self.graph.lift(u[name]) for name in self.u}
        result = self.graph.substitute(expressions, values)
        return [0.0 if is_zero(v) else v for v in result]

    def value_at(self, x: Sequence[Value], u: Inputs) -> list[Value]:
        return self._at(self.f, x, u)

    def jacobian_at(self, x: Sequence[Value], u: Inputs) -> Matrix:
        return [self._at(row, x, u) for row in self.jacobian]

    def rest_at(self, x: Sequence[Value], u: Inputs, a: Matrix, origin: Sequence[Value]) -> list[Value]:
        """The remainder b of f(x) = A (x − x₀) + b; x₀ = `origin`.

        Rows that are affine in the state have b = f(x₀), without cancellation and without the error of x.
        """
        there = self.value_at(origin, u)
        if not self.nonlinear:
            return there
        moved = [_minus(v, o) for v, o in zip(x, origin, strict=True)]
        value = self.value_at(x, u)
        return [_minus(value[i], dot(a[i], moved)) if self.curved[i] else there[i] for i in range(len(value))]


def _weights(a: Matrix, factor_a: float, b: Matrix, factor_b: float) -> Matrix:
    return [
        [0.0 if is_zero(x) and is_zero(y) else factor_a * x + factor_b * y for x, y in zip(r, s, strict=True)]
        for r, s in zip(a, b, strict=True)
    ]


def _corrected(h: Expression, weights: Matrix, correction: Expression, difference: Matrix) -> Matrix:
    """W (h I + correction (A2 - A1))."""
    whole = scale(h, weights)
    return add(whole, scale(correction, product(weights, difference))) if _any(difference) else whole


def _driven(early: Sequence[Value], b1: Sequence[Value], late: Sequence[Value], b2: Sequence[Value]) -> Value:
    """A row of W1 b1 + W2 b2; a remainder that is equal at both nodes takes the sum of the weights."""
    total: Value = 0.0
    for w1, x1, w2, x2 in zip(early, b1, late, b2, strict=True):
        if isinstance(x1, Expression) and isinstance(x2, Expression) and x1.index == x2.index:
            total = total + dot([w1 + w2], [x1])
        else:
            total = total + dot([w1, w2], [x1, x2])
    return total


def _between(start: Inputs, end: Inputs, c: float) -> dict[str, Expression]:
    return {
        name: start[name]
        if start[name].index == end[name].index
        else start[name] + c * (end[name] - start[name])
        for name in start
    }


def _predictor(
    field: _Field, x: Sequence[Value], start: Inputs, end: Inputs, c: float, h: Expression
) -> list[Value]:
    """The state at the fraction c of the step by the midpoint rule, where the field is linearised."""
    half = [v + (0.5 * c) * h * k for v, k in zip(x, field.value_at(x, start), strict=True)]
    middle = field.value_at(half, _between(start, end, 0.5 * c))
    return [v + c * h * k for v, k in zip(x, middle, strict=True)]


def _exponentials(omega: Matrix, span: Range) -> tuple[Matrix, Matrix, Matrix]:
    """e^Ω, φ₁(Ω) = ∫₀¹ e^{Ωσ} dσ, φ₂(Ω) = ∫₀¹ (1−σ) e^{Ωσ} dσ, as polynomials in Ω + μ I."""
    n = len(omega)
    centre = 0.5 * span.rate_step
    coefficients = [_taylor(centre, weight, span.order) for weight in (None, 0, 1)]
    shifted = add(omega, scale(centre, identity(n)))
    power = identity(n)
    sums = [scale(c[0], power) for c in coefficients]
    for k in range(1, span.order + 1):
        power = product(power, shifted) if k > 1 else shifted
        sums = [add(total, scale(c[k], power)) for c, total in zip(coefficients, sums, strict=True)]
    return sums[0], sums[1], sums[2]


def _taylor(centre: float, weight: int | None, order: int) -> list[float]:
    """Taylor coefficients about z = −centre of e^z (weight None) or of ∫₀¹ (1−σ)^w e^{zσ} dσ for the weight
    w."""
    if weight is None:
        return [math.exp(-centre) / f for f in factorials(order + 1)]
    terms = 40  # terms of the series of e^{−centre σ}: beyond machine precision for centre < 1
    inverse = [1.0 / f for f in factorials(terms + order + 2)]
    result = []
    for k in range(order + 1):
        moments = (
            math.factorial(weight) / math.prod(range(k + j + 1, k + j + 2 + weight)) for j in range(terms)
        )
        result.append(inverse[k] * math.fsum((-centre) ** j * inverse[j] * m for j, m in enumerate(moments)))
    return result


def _accumulated(omega: Matrix, noises: Sequence[Matrix], span: Range) -> Matrix:
    """∫₀¹ e^{Ωσ} Q̄ e^{Ω'σ} dσ, a polynomial in L + 2μ with L(X) = Ω X + X Ω', for one Q̄ or the parabola
    through three of them at the start, the middle and the end of the step."""
    n = len(omega)
    centre = 0.5 * span.rate_step
    coefficients = [_taylor(2.0 * centre, weight, span.noise_order) for weight in range(len(noises))]
    shifted = add(omega, scale(centre, identity(n)))

    def acted(x: Matrix) -> Matrix:
        half = product(shifted, x)
        return _symmetric([[half[i][j] + half[j][i] for j in range(i + 1)] for i in range(n)])

    if len(noises) > 1:
        total = _zeros(n, n)
        for whole, slope, curve in zip(*map(reversed, coefficients), strict=True):
            total = acted(total)
            shares = (whole - 3.0 * slope + 2.0 * curve, 4.0 * (slope - curve), 2.0 * curve - slope)
            for share, q in zip(shares, noises, strict=True):
                total = add(total, scale(share, q))
        return total
    term = noises[0]
    total = scale(coefficients[0][0], term)
    for c in coefficients[0][1:]:
        term = acted(term)
        if not _any(term):
            break
        total = add(total, scale(c, term))
    return total


def congruence(f: Matrix, p: Matrix, q: Matrix | None = None) -> Matrix:
    """F P F' + Q; the lower triangle is computed and mirrored."""
    n = len(f)
    q = _zeros(n, n) if q is None else q
    fp = product(f, p)
    alone = [[k for k, v in enumerate(row) if not is_zero(v)] for row in f]

    def entry(i: int, j: int) -> Value:
        if len(alone[i]) == 1 and len(alone[j]) == 1:
            (k,), (m,) = alone[i], alone[j]
            return (f[i][k] * f[j][m]) * p[k][m]
        return dot(fp[i], f[j])

    return _symmetric([[entry(i, j) + q[i][j] for j in range(i + 1)] for i in range(n)])


def _symmetric(lower: Matrix) -> Matrix:
    n = len(lower)
    return [[lower[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]


def _difference(a: Matrix, b: Matrix) -> Matrix:
    return [[_minus(x, y) for x, y in zip(r, s, strict=True)] for r, s in zip(a, b, strict=True)]


def _minus(x: Value, y: Value) -> Value:
    result = x - y
    return 0.0 if is_zero(result) else result


def _mean(x: Value, y: Value) -> Value:
    if isinstance(x, Expression) and isinstance(y, Expression) and x.index == y.index:
        return x
    return 0.0 if is_zero(x) and is_zero(y) else 0.5 * (x + y)


def _any(a: Matrix) -> bool:
    return not all(is_zero(x) for row in a for x in row)


def _zeros(n: int, m: int) -> Matrix:
    return [[0.0] * m for _ in range(n)]
