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
(`RATE_STEP`).

Where rates are constant, the matrices are Taylor polynomials for a share c = 2^−s of the step, doubled s
times: with D = e^{cΩ} − I, Γ = c φ₁(cΩ), W = c φ₂(cΩ) and N = c ∫₀¹ e^{cΩσ} Q̄ e^{cΩ'σ} dσ,

    D ← 2 D + D²,    Γ ← 2 Γ + D Γ,    W ← W + (D W + Γ)/2,
    N ← 2 N + D N + N D' + D N D'.

I + D is never formed while D is small, so that slow states keep all digits beside fast ones; a step of any
length is one step, whose cost grows with the logarithm of its stiffness.  Elsewhere the polynomials are
centred in the range of rates that sub-steps permit.  A sparse model costs as much as its non-zero entries,
and entries that depend only on h and the parameters are computed once for each distinct h.

Sources: Magnus step: Iserles & Nørsett 1999, doi:10.1098/rsta.1999.0362; Van Loan 1978,
doi:10.1109/TAC.1978.1101743; scaling and squaring: Moler & Van Loan 2003, doi:10.1137/S00361445024180.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.physics.expression import Expression, Graph, Matrix, Value, depends_on, is_zero, jacobian, where
from hygrokf.physics.matrices import add, dot, identity, product, scale, transpose
from hygrokf.physics.model import Values

SHARE = 0.25
"""[1] largest product of the rates and the share of a constant-rate step, as its polynomials take it."""
ORDER = 11
"""Degree of these polynomials: the remainder of D is below SHARE^11 / 12! = 5e-16 of D."""
FAINT = 2.0**-40
"""[1] square of an entry of e^Ω from which on I + D has fewer of its digits than repeated squares."""
RATE_STEP, DEGREE, NOISE_DEGREE = 0.35, 8, 9
"""Largest product of rates that vary within a step and a sub-step, for which splitting a step changes ln L by
< 1e-6, and the degrees of its polynomials: remainders (0.35/2)^9 / 9! = 4e-13 and 0.35^10 / 10! = 8e-12."""
NODES = (0.5 - math.sqrt(3.0) / 6.0, 0.5 + math.sqrt(3.0) / 6.0)

Drift = Callable[[Sequence[Value], Values], list[Value]]
"""(x, u) -> rates (n,) [unit of the state per h]."""
Inputs = Mapping[str, Expression]


@dataclass(frozen=True)
class Doubling:
    """The matrices of a constant-rate step: `first` their entries for the `share` c of the step, `twice`
    those for twice the length of the entries `now` (w,), which the step is made from."""

    share: Expression
    first: list[Expression]
    now: list[Expression]
    twice: list[Expression]


@dataclass(frozen=True)
class Step:
    """Traced moments after one sub-step, the matrices that made them, and how these are doubled."""

    mean: list[Expression]
    covariance: Matrix
    transition: Matrix
    noise: Matrix
    doubling: Doubling | None
    decay: Matrix
    """The transition, with the relative digits also of entries that have decayed far below 1."""


def doublings(reach: np.ndarray) -> np.ndarray:
    """Doublings of a constant-rate step whose rates times length are `reach` [1]; any shape."""
    return np.ceil(np.log2(np.maximum(reach, SHARE) / SHARE))


def step(
    graph: Graph,
    drift: Drift,
    noise: Callable[[Values], Matrix],
    state: Sequence[Expression],
    covariance: Matrix,
    start: Inputs,
    end: Inputs,
    h: Expression,
    changing: Sequence[str],
    decays: bool = False,
) -> Step:
    """Trace one sub-step.

    `drift(x, u)` -> list of n rates [unit of the state per h]; `noise(u)` -> Q (n, n) [unit² per h]; `state`
    and `covariance` before the step; `start` and `end` the inputs just after its start and just before its
    end (a constant input has the same node in both); `h` [h]; `changing` the names of the symbols that change
    from step to step (`constant_rates`); `decays` asks for the relative digits of `Step.decay`.
    """
    n = len(state)
    field = _Field(graph, drift, n, start)
    inputs = [_between(start, end, c) for c in NODES]
    points = [_predictor(field, state, start, end, c, h) for c in NODES] if field.nonlinear else [state] * 2
    a1, a2 = (field.jacobian_at(x, u) for x, u in zip(points, inputs, strict=True))
    difference = _difference(a2, a1)
    intensity = noise(inputs[0])
    rising = [field.u[name] for name in start if start[name].index != end[name].index]
    constant = constant_rates(graph, [*a1, *intensity], changing, field.f, rising)
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
    carried: Sequence[Value] = state
    if constant:
        doubling, (exponential, weights, slopes, accumulated, decay) = _doubled(
            graph, h, omega, intensity, b1, b2, decays
        )
        carried = [dot(row, state) for row in exponential]
        weights, slopes = scale(h, weights), scale(h, slopes)
    else:
        doubling = None
        exponential, *phi = _exponentials(omega)
        decay = exponential
        weights, slopes = (_corrected(h, m, correction, difference) for m in phi)
        if not _any(difference):
            carried = [dot(row, state) for row in exponential]
        intensities = [intensity]
        if _any(_difference(noise(inputs[1]), intensity)):
            intensities = [noise(_between(start, end, c)) for c in (0.0, 0.5, 1.0)]
        spreads = [add(product(difference, q), transpose(product(difference, q))) for q in intensities]
        sums = [add(scale(h, q), scale(correction, v)) for q, v in zip(intensities, spreads, strict=True)]
        accumulated = _accumulated(omega, sums)
    # b(t) is the straight line through b1 and b2 at the nodes; the weights do not depend on the inputs
    mean = [x + _driven(i, weights, slopes, b1, b2) for i, x in enumerate(carried)]
    return Step(
        mean=[graph.lift(v) for v in mean],
        covariance=[[graph.lift(v) for v in row] for row in congruence(exponential, covariance, accumulated)],
        transition=exponential,
        noise=accumulated,
        doubling=doubling,
        decay=decay,
    )


def constant_rates(
    graph: Graph, rows: Matrix, changing: Sequence[str], rates: Sequence[Expression], rising: list[Expression]
) -> bool:
    """Whether a step of any length is one exact step.

    The `rows` of the Jacobian and the noise must have none of the symbols `changing`, and `rates` must be
    straight lines in the inputs `rising` within a step: the product of two such inputs is not, in time.
    """
    if any(depends_on(graph, v, changing) for row in rows for v in row):
        return False
    names = [graph.nodes[e.index][1] for e in rising]
    return not any(depends_on(graph, v, names) for u in rising for (v,) in jacobian(rates, [u]))


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


def _doubled(
    graph: Graph,
    h: Expression,
    omega: Matrix,
    noise: Matrix,
    b1: Sequence[Value],
    b2: Sequence[Value],
    decays: bool,
) -> tuple[Doubling, tuple[Matrix, Matrix, Matrix, Matrix, Matrix]]:
    """How the matrices of a constant-rate step are doubled, and e^Ω, φ₁, φ₂, the noise and the decay.

    I + D has lost the relative digits of entries far below 1; where it `decays`, E = e^Ω is squared beside it
    for them, and elsewhere I + D is better, as squaring doubles a relative error.
    """
    n, share = len(omega), graph.symbol("share")
    reach = closure(omega)
    driven = [j for j in range(n) if not (is_zero(b1[j]) and is_zero(b2[j]))]
    rising = [j for j in driven if not _same(b1[j], b2[j])]
    lower = [(i, j) for i in range(n) for j in range(i + 1)]
    spread = {(i, j) for i, j in lower if any(
        not is_zero(noise[a][b]) and (a == i or reach[i][a]) and (b == j or reach[j][b])
        for a in range(n) for b in range(n)
    )}  # fmt: skip
    parts = {
        "D": [(i, j) for i in range(n) for j in range(n) if reach[i][j]],
        "G": [(i, j) for j in driven for i in range(n) if i == j or reach[i][j]],
        "W": [(i, j) for j in rising for i in range(n) if i == j or reach[i][j]],
        "N": sorted(spread),
        "E": [(i, j) for i in range(n) for j in range(n) if decays and (i == j or reach[i][j])],
    }
    matrices = {name: _zeros(n, n) for name in parts}
    for name, places in parts.items():
        for i, j in places:
            matrices[name][i][j] = graph.symbol(f"{name}{i}.{j}")
    d, g, w, e = (matrices[name] for name in "DGWE")
    q = matrices["N"] = _symmetric(matrices["N"])

    x, inverse = scale(share, omega), [1.0 / f for f in _factorials(ORDER + 3)]
    first = {"D": _zeros(n, n), "G": scale(share, identity(n)), "W": scale(0.5 * share, identity(n))}
    power = identity(n)
    for k in range(1, ORDER + 1):
        power = product(power, x) if k > 1 else x
        for name, c in (("D", inverse[k]), ("G", share * inverse[k + 1]), ("W", share * inverse[k + 2])):
            first[name] = add(first[name], scale(c, power))
    term = first["N"] = scale(share, scale(h, noise))
    for k in range(1, ORDER + 1):
        half = product(x, term)
        term = _symmetric([[half[i][j] + half[j][i] for j in range(i + 1)] for i in range(n)])
        first["N"] = add(first["N"], scale(inverse[k + 1], term))
    first["E"] = add(first["D"], identity(n))
    gained = product(d, q)
    twice = {
        "D": add(scale(2.0, d), product(d, d)),
        "G": add(scale(2.0, g), product(d, g)),
        "W": add(w, scale(0.5, add(product(d, w), g))),
        "N": add(add(scale(2.0, q), add(gained, transpose(gained))), product(gained, transpose(d))),
        "E": product(e, e),
    }

    def listed(rows: Mapping[str, Matrix]) -> list[Expression]:
        return [graph.lift(rows[name][i][j]) for name, places in parts.items() for i, j in places]

    whole = add(d, identity(n))
    decay = whole
    if decays:
        decay = [
            [v if is_zero(v) else where(v * v < FAINT, x, v) for v, x in zip(r, t, strict=True)]
            for r, t in zip(whole, e, strict=True)
        ]
    return Doubling(share, listed(first), listed(matrices), listed(twice)), (whole, g, w, q, decay)


def closure(a: Matrix) -> list[list[bool]]:
    """Where the powers of a matrix, from the first on, have entries."""
    n = len(a)
    reach = [[not is_zero(v) for v in row] for row in a]
    for k in range(n):
        for i in range(n):
            if reach[i][k]:
                reach[i] = [x or y for x, y in zip(reach[i], reach[k], strict=True)]
    return reach


def _corrected(h: Expression, weights: Matrix, correction: Expression, difference: Matrix) -> Matrix:
    """W (h I + correction (A2 - A1))."""
    return add(scale(h, weights), scale(correction, product(weights, difference)))


def _driven(i: int, whole: Matrix, slope: Matrix, b1: Sequence[Value], b2: Sequence[Value]) -> Value:
    """Row i of φ₁ β + φ₂ s for the line β + s t through b1 and b2 at the nodes; β alone where both agree."""
    total: Value = 0.0
    gap = NODES[1] - NODES[0]
    for one, rise, x1, x2 in zip(whole[i], slope[i], b1, b2, strict=True):
        if _same(x1, x2):
            total = total + dot([one], [x1])
        else:
            early = _combined(one, NODES[1] / gap, rise, -1.0 / gap)
            late = _combined(one, -NODES[0] / gap, rise, 1.0 / gap)
            total = total + dot([early, late], [x1, x2])
    return total


def _combined(x: Value, a: float, y: Value, b: float) -> Value:
    return 0.0 if is_zero(x) and is_zero(y) else a * x + b * y


def _same(x: Value, y: Value) -> bool:
    if isinstance(x, Expression) and isinstance(y, Expression):
        return x.index == y.index
    return is_zero(x) and is_zero(y)


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


def _exponentials(omega: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """e^Ω, φ₁(Ω) = ∫₀¹ e^{Ωσ} dσ, φ₂(Ω) = ∫₀¹ (1−σ) e^{Ωσ} dσ, as polynomials in Ω + μ I."""
    n = len(omega)
    centre = 0.5 * RATE_STEP
    coefficients = [_taylor(centre, weight, DEGREE) for weight in (None, 0, 1)]
    shifted = add(omega, scale(centre, identity(n)))
    power = identity(n)
    sums = [scale(c[0], power) for c in coefficients]
    for k in range(1, DEGREE + 1):
        power = product(power, shifted) if k > 1 else shifted
        sums = [add(total, scale(c[k], power)) for c, total in zip(coefficients, sums, strict=True)]
    return sums[0], sums[1], sums[2]


def _taylor(centre: float, weight: int | None, order: int) -> list[float]:
    """Taylor coefficients about z = −centre of e^z (weight None) or of ∫₀¹ (1−σ)^w e^{zσ} dσ for the weight
    w."""
    if weight is None:
        return [math.exp(-centre) / f for f in _factorials(order + 1)]
    terms = 40  # terms of the series of e^{−centre σ}: beyond machine precision for centre < 1
    inverse = [1.0 / f for f in _factorials(terms + order + 2)]
    result = []
    for k in range(order + 1):
        moments = (
            math.factorial(weight) / math.prod(range(k + j + 1, k + j + 2 + weight)) for j in range(terms)
        )
        result.append(inverse[k] * math.fsum((-centre) ** j * inverse[j] * m for j, m in enumerate(moments)))
    return result


def _accumulated(omega: Matrix, noises: Sequence[Matrix]) -> Matrix:
    """∫₀¹ e^{Ωσ} Q̄ e^{Ω'σ} dσ, a polynomial in L + 2μ with L(X) = Ω X + X Ω', for one Q̄ or the parabola
    through three of them at the start, the middle and the end of the step."""
    n = len(omega)
    centre = 0.5 * RATE_STEP
    coefficients = [_taylor(2.0 * centre, weight, NOISE_DEGREE) for weight in range(len(noises))]
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


def _factorials(count: int) -> list[float]:
    """0!, 1!, … as floats."""
    return [float(math.factorial(k)) for k in range(count)]
