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
computed only once.  Where rates vary, x₀ = m: the remainder then changes with the change within the step
instead of the distance of the state from zero (kelvins from absolute zero), so that the error of a sub-step
is about 250 times smaller.  This error is of order h⁵ for the mean and of order h⁴ for the covariance,
whose Jacobians are taken at nodes from a second-order rule; sub-steps keep both below a tolerance
(`engine.schedule_codegen`).

The matrices are Taylor polynomials for a share c = 2^−s of the step, doubled s
times: with D = e^{cΩ} − I, Γ = c φ₁(cΩ), W = c φ₂(cΩ) and N = c ∫₀¹ e^{cΩσ} Q̄ e^{cΩ'σ} dσ,

    D ← 2 D + D²,    Γ ← 2 Γ + D Γ,    W ← W + (D W + Γ)/2,
    N ← 2 N + D N + N D' + D N D'.

Where a parabola q(σ) replaces Q̄, q' and q'' have separate integrals N: q(t+σ) = q + t q' + t² q''/2.  I + D
is never formed while D is small, so that slow states keep all digits beside fast ones; a step of any length
is one step, whose cost grows with the logarithm of its stiffness.  A sparse model costs as much as its
non-zero entries, and entries that depend only on h and the parameters are computed once for each distinct h.

Everything here is traced: functions take and return expressions, and nothing is computed.

- node: one of the two instants of a sub-step, at the fractions `NODES`, at which f is linearised.
- operations: assignments to symbols, before the step's formulas; `early` ones depend on h, the parameters and
  regimes alone, `late` ones also on states or inputs.
- steady, quiet: a state whose rate has constant derivatives; constant noise.
- driven, rising: a state whose remainder b is not 0; one whose b changes within the sub-step.
- D, G, W, E, N: in names of symbols, the matrices D, Γ, W, e^Ω and N above; N' and N'' of a parabola.

Sources: Magnus step: Iserles & Nørsett 1999, doi:10.1098/rsta.1999.0362; Van Loan 1978,
doi:10.1109/TAC.1978.1101743; scaling and squaring: Moler & Van Loan 2003, doi:10.1137/S00361445024180.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from hygrokf.physics.expression import (
    Expression,
    Graph,
    Matrix,
    Value,
    depends_on,
    is_zero,
    jacobian,
    maximum,
    sqrt,
    where,
)
from hygrokf.physics.matrices import (
    add,
    closure,
    congruence,
    difference,
    dot,
    has_entries,
    identity,
    mean_of,
    minus,
    product,
    same,
    scale,
    symmetric,
    transpose,
    zeros,
)
from hygrokf.physics.model import Values

CONSTANT_SHARE, SHARE = 0.25, 0.5
"""[1] largest product of the rates and the share of a step: with constant rates, and with varying ones."""
CONSTANT_ORDER, ORDER, NODE_ORDER = 11, 9, 5
"""Degrees of the Taylor polynomials: for constant rates, with the remainder 0.25^11/12! = 5e-16 of D; for
varying rates, with 0.5^9/10! = 5e-10; and for the states at the nodes.
"""
FAINT = 2.0**-40
"""[1] square of an entry of e^Ω below which repeated squaring keeps more of its digits than I + D does."""
MILD = 1
"""Largest number of doublings at which the midpoint rule is stable: rates times length below 1."""
NODES = (0.5 - math.sqrt(3.0) / 6.0, 0.5 + math.sqrt(3.0) / 6.0)

Drift = Callable[[Sequence[Value], Values], list[Value]]
"""(x, u) -> rates (n,) [unit of the state per h]."""
Inputs = Mapping[str, Expression]


@dataclass(frozen=True)
class Assign:
    """The symbols `into` get the values of the expressions `block`."""

    into: tuple[Expression, ...]
    block: tuple[Expression, ...]


@dataclass(frozen=True)
class Repeat:
    """The symbols `into` get the values of `block`, expressions of them, once for every doubling."""

    into: tuple[Expression, ...]
    block: tuple[Expression, ...]


@dataclass(frozen=True)
class Choose:
    """`stiff` where the step is doubled more than `MILD` times, else `plain`."""

    stiff: tuple[Operation, ...]
    plain: tuple[Operation, ...]


Operation = Assign | Repeat | Choose


@dataclass(frozen=True)
class Step:
    """Traced moments after one sub-step, the matrices behind them, and the operations that compute the
    matrices: `early` for constant rates, which depend only on h, the parameters and regimes, and `late` for
    all others.

    `decay` is the transition whose entries keep their relative accuracy also far below 1; `share` is the
    symbol of c; the largest of `reach` (n,) bounds the rates times h at the beginning of the sub-step;
    `exact` tells whether a step of any length is exact (`constant_rates`).
    """

    mean: list[Expression]
    covariance: Matrix
    transition: Matrix
    noise: Matrix
    decay: Matrix
    share: Expression
    early: tuple[Operation, ...]
    late: tuple[Operation, ...]
    exact: bool
    reach: list[Expression]


def operations(program: Sequence[Operation]) -> Iterator[Assign | Repeat]:
    """Yield all assignments of a program, including those of both alternatives of a `Choose`."""
    for operation in program:
        if isinstance(operation, Choose):
            yield from operations((*operation.stiff, *operation.plain))
        else:
            yield operation


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
    from step to step; `decays` whether `Step.decay` is needed.
    """
    n, share = len(state), graph.symbol("share")
    field = _Field(graph, drift, n, start)
    inputs = [_between(start, end, c) for c in NODES]
    a0 = field.jacobian_at(state, start)
    points, late = _nodes(field, state, start, inputs, a0, h, share) if field.nonlinear else ([state] * 2, [])
    a1, a2 = (field.jacobian_at(x, u) for x, u in zip(points, inputs, strict=True))
    jacobian_change = difference(a2, a1)
    varies = has_entries(jacobian_change)
    origin = state if varies else [0.0] * n
    b1, b2 = (field.remainder_at(x, u, a, origin) for x, u, a in zip(points, inputs, (a1, a2), strict=True))
    correction = math.sqrt(3.0) / 12.0 * h * h
    mean_rate = [[mean_of(x, y) for x, y in zip(r, s, strict=True)] for r, s in zip(a1, a2, strict=True)]
    omega = scale(h, mean_rate)
    intensities = [noise(inputs[0])]
    if has_entries(difference(noise(inputs[1]), intensities[0])):
        intensities = [noise(_between(start, end, c)) for c in (0.0, 0.5, 1.0)]
    spreads = [scale(h, q) for q in intensities]
    if varies:
        omega = add(omega, scale(correction, difference(product(a2, a1), product(a1, a2))))
        changes = [product(jacobian_change, q) for q in intensities]
        spreads = [
            add(q, scale(correction, add(change, transpose(change))))
            for q, change in zip(spreads, changes, strict=True)
        ]

    changing = [*changing, *(graph.nodes[e.index][1] for op in operations(late) for e in op.into)]
    driven = [j for j in range(n) if not (is_zero(b1[j]) and is_zero(b2[j]))]
    rising = [j for j in driven if not same(b1[j], b2[j])]
    columns = [  # of Γ and W; the corrections add columns
        {*indices, *(k for k in range(n) if any(not is_zero(jacobian_change[k][j]) for j in indices))}
        for indices in (driven, rising)
    ]
    steady = [not any(depends_on(graph, v, changing) for a in (a1, a2) for v in a[i]) for i in range(n)]
    quiet = not any(depends_on(graph, v, changing) for row in intensities[0] for v in row)
    early, doubling, matrices = _matrices(graph, share, omega, spreads, columns, steady, quiet, decays)
    d, g, w, squared, accumulated = matrices
    decay = exponential = add(d, identity(n))
    if decays:
        decay = [
            [v if is_zero(v) else where(v * v < FAINT, x, v) for v, x in zip(r, t, strict=True)]
            for r, t in zip(exponential, squared, strict=True)
        ]
    drives = [field.u[name] for name in start if start[name].index != end[name].index]
    weights, slopes = (
        _corrected(h, m, correction, jacobian_change) if varies else scale(h, m) for m in (g, w)
    )
    carried = state if varies else [dot(row, state) for row in exponential]
    # b(t) is the straight line through b1 and b2 at the nodes; the weights do not depend on the inputs
    mean = [x + _driven(i, weights, slopes, b1, b2) for i, x in enumerate(carried)]
    return Step(
        mean=[graph.lift(v) for v in mean],
        covariance=[[graph.lift(v) for v in row] for row in congruence(exponential, covariance, accumulated)],
        transition=exponential,
        noise=accumulated,
        decay=decay,
        share=share,
        early=tuple(early),
        late=(*late, *doubling),
        exact=constant_rates(graph, [*a1, *intensities[0]], changing, field.f, drives),
        reach=_reach(graph, a0, h),
    )


def _matrices(
    graph: Graph,
    share: Expression,
    omega: Matrix,
    spreads: Sequence[Matrix],
    columns: Sequence[set[int]],
    steady: Sequence[bool],
    quiet: bool,
    decays: bool,
) -> tuple[list[Operation], list[Operation], list[Matrix]]:
    """Trace the matrices of a sub-step: returns the early and the late operations, and D, Γ, W, E and N.

    share, omega, columns, decays: as in `_doublings`.  spreads: its `noises`.  steady: of every state,
    whether the derivatives of its rate are constant.  quiet: whether the noise is.

    Rows of a state are early (`fixed`) where its rate and the rates of all states that act on it are constant
    (`steady`); entries of N are early (`still`) only where the noise is constant too (`quiet`)."""
    n, reaches = len(omega), closure(omega)
    fixed = [steady[i] and all(steady[j] for j in range(n) if reaches[i][j]) for i in range(n)]
    still = [one and quiet for one in fixed]
    early_omega = [[v if fixed[i] else 0.0 for v in row] for i, row in enumerate(omega)]
    early_noise = [
        [v if still[i] and still[j] else 0.0 for j, v in enumerate(row)] for i, row in enumerate(spreads[0])
    ]
    early_columns = [{j for j in indices if fixed[j]} for indices in columns]
    early, early_matrices = _doublings(
        graph, "", share, early_omega, [early_noise], early_columns, CONSTANT_ORDER, decays
    )
    if all(still):
        return early, [], early_matrices
    order = CONSTANT_ORDER if all(fixed) else ORDER
    late, late_matrices = _doublings(graph, "late:", share, omega, spreads, columns, order, decays)
    merged = [
        [[p[i][j] if fixed[i] and (name != "N" or still[j]) else q[i][j] for j in range(n)] for i in range(n)]
        for name, p, q in zip("DGWEN", early_matrices, late_matrices, strict=True)
    ]
    return early, late, merged


def constant_rates(
    graph: Graph, rows: Matrix, changing: Sequence[str], rates: Sequence[Expression], rising: list[Expression]
) -> bool:
    """Whether a step of any length is one exact step.

    The `rows` of the Jacobian and the noise must contain none of the symbols `changing`.  The `rates` must be
    linear in the inputs `rising`, which are linear within a step: a product of two of them is quadratic.
    """
    if any(depends_on(graph, v, changing) for row in rows for v in row):
        return False
    names = [graph.nodes[e.index][1] for e in rising]
    return not any(depends_on(graph, v, names) for u in rising for (v,) in jacobian(rates, [u]))


class _Field:
    """f, its Jacobian and its affine remainder as functions of the state and the inputs.

    `curved`: for every state, whether its rate is not affine in the states; `nonlinear`: whether any is.
    """

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
        """Expressions with the states x and the inputs u put in."""
        values = {s.index: self.graph.lift(v) for s, v in zip(self.x, x, strict=True)}
        values |= {self.u[name].index: self.graph.lift(u[name]) for name in self.u}
        result = self.graph.substitute(expressions, values)
        return [0.0 if is_zero(v) else v for v in result]

    def value_at(self, x: Sequence[Value], u: Inputs) -> list[Value]:
        return self._at(self.f, x, u)

    def jacobian_at(self, x: Sequence[Value], u: Inputs) -> Matrix:
        return [self._at(row, x, u) for row in self.jacobian]

    def remainder_at(self, x: Sequence[Value], u: Inputs, a: Matrix, origin: Sequence[Value]) -> list[Value]:
        """The remainder b of f(x) = A (x − x₀) + b; x₀ = `origin`.

        Rows that are affine in the state have b = f(x₀), without cancellation and without the error of x.
        """
        base = self.value_at(origin, u)
        if not self.nonlinear:
            return base
        offset = [minus(v, o) for v, o in zip(x, origin, strict=True)]
        value = self.value_at(x, u)
        return [minus(value[i], dot(a[i], offset)) if self.curved[i] else base[i] for i in range(len(value))]


def _doublings(
    graph: Graph,
    prefix: str,
    share: Expression,
    omega: Matrix,
    noises: Sequence[Matrix],
    columns: Sequence[Iterable[int]],
    order: int,
    decays: bool,
) -> tuple[list[Operation], list[Matrix]]:
    """Trace the doublings: returns their operations, and D, Γ, W, E and N after them, as symbols.

    prefix: of the symbols' names.  share: c.  omega: Ω.  noises: one Q̄, or three of them at the start, the
    middle and the end of the step.  columns: those of Γ and of W that are needed.  order: degree of the
    polynomials.

    Entries of I + D far below 1 have lost their relative accuracy.  With `decays`, E = e^Ω is squared for
    them; elsewhere I + D is better, as squaring doubles a relative error.
    """
    n = len(omega)
    linked = closure(omega)
    pairs = [(i, j) for i in range(n) for j in range(n)]
    near = [[i == j or linked[i][j] for j in range(n)] for i in range(n)]
    noisy = [(a, b) for a, b in pairs if not all(is_zero(q[a][b]) for q in noises)]
    spread = [(i, j) for i, j in pairs if j <= i and any(near[i][a] and near[j][b] for a, b in noisy)]
    slopes = ["N", "N'", "N''"][: len(noises)]
    entries = {
        "D": [(i, j) for i, j in pairs if linked[i][j]],
        "G": [(i, j) for j in sorted(columns[0]) for i in range(n) if near[i][j]],
        "W": [(i, j) for j in sorted(columns[1]) for i in range(n) if near[i][j]],
        "E": [(i, j) for i, j in pairs if decays and near[i][j]],
        **dict.fromkeys(slopes, spread),
    }
    matrices = {name: zeros(n, n) for name in entries}
    for name, places in entries.items():
        for i, j in places:
            matrices[name][i][j] = graph.symbol(f"{prefix}{name}{i}.{j}")
    d, g, w, e = (matrices[name] for name in "DGWE")
    moments = [symmetric(matrices[name]) for name in slopes]

    x, inverse = scale(share, omega), [1.0 / f for f in _factorials(order + 3)]
    initial = {"D": zeros(n, n), "G": scale(share, identity(n)), "W": scale(0.5 * share, identity(n))}
    power = identity(n)
    for k in range(1, order + 1):
        power = product(power, x) if k > 1 else x
        for name, c in (("D", inverse[k]), ("G", share * inverse[k + 1]), ("W", share * inverse[k + 2])):
            initial[name] = add(initial[name], scale(c, power))
    initial["E"] = add(initial["D"], identity(n))
    curves = [noises] if len(noises) == 1 else _derivatives(*noises)
    for name, curve in zip(slopes, curves, strict=True):
        initial[name] = _integral(x, share, curve, order)
    doubled = {
        "D": add(scale(2.0, d), product(d, d)),
        "G": add(scale(2.0, g), product(d, g)),
        "W": add(w, scale(0.5, add(product(d, w), g))),
        "E": product(e, e),
    }
    length = graph.symbol(f"{prefix}t")
    for name, moment, shifted in zip(slopes, moments, _shifted(moments, length), strict=True):
        carried = product(d, shifted)
        cross = add(carried, transpose(carried))
        doubled[name] = add(add(moment, shifted), add(cross, product(carried, transpose(d))))

    def listed(rows: Mapping[str, Matrix]) -> tuple[Expression, ...]:
        return tuple(graph.lift(rows[name][i][j]) for name, places in entries.items() for i, j in places)

    symbols, initials, doubles = listed(matrices), listed(initial), listed(doubled)
    if len(noises) > 1:
        symbols, initials, doubles = (*symbols, length), (*initials, share), (*doubles, 2.0 * length)
    program: list[Operation] = [Assign(symbols, initials), Repeat(symbols, doubles)] if symbols else []
    return program, [d, g, w, e, moments[0]]


def _derivatives(start: Matrix, middle: Matrix, end: Matrix) -> list[list[Matrix]]:
    """Coefficients of q, q' and q'' for the parabola q(σ) that is `end` at 0 and `start` at 1."""
    slope = add(add(scale(-3.0, end), scale(4.0, middle)), scale(-1.0, start))
    curve = add(add(scale(2.0, end), scale(-4.0, middle)), scale(2.0, start))
    return [[end, slope, curve], [slope, scale(2.0, curve)], [scale(2.0, curve)]]


def _integral(x: Matrix, share: Expression, curve: Sequence[Matrix], order: int) -> Matrix:
    """∫₀ᶜ e^{Ωσ} q(σ) e^{Ω'σ} dσ of a polynomial q with coefficients `curve`, c the `share`, x = c Ω."""
    n, total = len(x), zeros(len(x), len(x))
    inverse = [1.0 / f for f in _factorials(order + 1)]
    for m, coefficient in enumerate(curve, 1):
        term = coefficient
        for _ in range(m):
            term = scale(share, term)
        for k in range(order + 1):
            if k > 0:
                half = product(x, term)
                term = symmetric([[half[i][j] + half[j][i] for j in range(i + 1)] for i in range(n)])
            total = add(total, scale(inverse[k] / (k + m), term))
    return total


def _shifted(moments: Sequence[Matrix], t: Expression) -> list[Matrix]:
    """N of q(t+σ) and of its derivatives, from N of q, q' and q''."""
    if len(moments) == 1:
        return list(moments)
    q, slope, curve = moments
    return [add(add(q, scale(t, slope)), scale(0.5 * t * t, curve)), add(slope, scale(t, curve)), curve]


def _nodes(
    field: _Field,
    state: Sequence[Expression],
    start: Inputs,
    inputs: Sequence[Inputs],
    at_start: Matrix,
    h: Expression,
    share: Expression,
) -> tuple[list[Sequence[Value]], list[Operation]]:
    """Trace the states at the nodes, where f is linearised; returns them, and the operations that predict
    them: by the midpoint rule or, where the rule could be unstable, by the exponential of the Jacobian at the
    beginning,

        x(c h) = x + c h (Γ f + W (f(x, u(c h)) − f)),    with Γ and W of c h A.
    """
    graph, n = field.graph, len(state)
    rate = field.value_at(state, start)
    needed = [
        i for i in range(n) if any(not is_zero(field.jacobian[r][i]) for r in range(n) if field.curved[r])
    ]
    states: list[Sequence[Value]] = []
    midpoint: list[Expression] = []
    stiff: list[Operation] = []
    targets: list[Expression] = []
    exponential: list[Expression] = []
    for node, (c, node_inputs) in enumerate(zip(NODES, inputs, strict=True)):
        slope: Sequence[Value] = rate
        for fraction in (1.0 / 3.0, 2.0 / 3.0):
            inner = [v + (fraction * c) * h * k for v, k in zip(state, slope, strict=True)]
            slope = field.value_at(inner, _between(start, node_inputs, fraction))
        symbols = {i: graph.symbol(f"node{node}.{i}") for i in needed}
        states.append([symbols.get(i, state[i]) for i in range(n)])
        targets += symbols.values()
        midpoint += [graph.lift(state[i] + (0.25 * c) * h * (rate[i] + 3.0 * slope[i])) for i in needed]
        change = [minus(v, r) for v, r in zip(field.value_at(state, node_inputs), rate, strict=True)]
        doublings, pushed = _push(graph, f"node{node}:", share, scale(c * h, at_start), rate, change)
        stiff += doublings
        exponential += [graph.lift(state[i] + c * h * pushed[i]) for i in needed]
    stiff.append(Assign(tuple(targets), tuple(exponential)))
    return states, [Choose(tuple(stiff), (Assign(tuple(targets), tuple(midpoint)),))]


def _push(
    graph: Graph, prefix: str, share: Expression, omega: Matrix, rate: Sequence[Value], rise: Sequence[Value]
) -> tuple[list[Operation], list[Value]]:
    """Trace the products Γ `rate` and W `rise` without the matrices Γ and W: returns the operations that
    double these vectors, and their sum (n,)."""
    n, powers = len(omega), closure(omega)

    def symbols(name: str, factor: Sequence[Value]) -> list[Value]:
        present = [not is_zero(v) for v in factor]
        reached = [present[i] or any(powers[i][j] and present[j] for j in range(n)) for i in range(n)]
        return [graph.symbol(f"{prefix}{name}{i}") if reached[i] else 0.0 for i in range(n)]

    d = [[graph.symbol(f"{prefix}D{i}.{j}") if powers[i][j] else 0.0 for j in range(n)] for i in range(n)]
    v, y, w = symbols("v", rate), symbols("y", rise), symbols("w", rise)
    x, inverse = scale(share, omega), [1.0 / f for f in _factorials(NODE_ORDER + 3)]
    power, taylor = identity(n), zeros(n, n)
    for k in range(1, NODE_ORDER + 1):
        power = product(power, x) if k > 1 else x
        taylor = add(taylor, scale(inverse[k], power))

    def series(factor: Sequence[Value], offset: int) -> list[Value]:
        term = total = [[v] for v in factor]
        total = scale(share * inverse[offset], total)
        for k in range(1, NODE_ORDER + 1):
            term = product(x, term)
            total = add(total, scale(share * inverse[k + offset], term))
        return [row[0] for row in total]

    def times(vector: Sequence[Value]) -> list[Value]:
        return [dot(row, vector) for row in d]

    square = add(scale(2.0, d), product(d, d))
    unknowns = [*(e for row in d for e in row), *v, *y, *w]
    initial = [*(e for row in taylor for e in row), *series(rate, 1), *series(rise, 1), *series(rise, 2)]
    doubled = [
        *(e for row in square for e in row),
        *(2.0 * a + b for a, b in zip(v, times(v), strict=True)),
        *(2.0 * a + b for a, b in zip(y, times(y), strict=True)),
        *(a + 0.5 * (b + c) for a, b, c in zip(w, times(w), y, strict=True)),
    ]
    nonzero = [k for k, e in enumerate(unknowns) if not is_zero(e)]
    targets, initials, doubles = (
        tuple(graph.lift(rows[k]) for k in nonzero) for rows in (unknowns, initial, doubled)
    )
    return [Assign(targets, initials), Repeat(targets, doubles)], [a + b for a, b in zip(v, w, strict=True)]


def _reach(graph: Graph, matrix: Matrix, h: Expression) -> list[Expression]:
    """Bounds (n,) whose largest is at least |eigenvalues of A| h: the rows of |A h|⁸, to the power 1/8.

    Only entries on a cycle of states count; one-way couplings do not change the eigenvalues.
    """
    n, powers = len(matrix), closure(matrix)
    magnitudes: Matrix = zeros(n, n)
    for i in range(n):
        for j in range(n):
            if not is_zero(matrix[i][j]) and (i == j or powers[j][i]):
                entry = graph.lift(matrix[i][j]) * h
                magnitudes[i][j] = maximum(entry, -entry)
    if all(is_zero(magnitudes[i][j]) for i in range(n) for j in range(n) if i != j):
        return [graph.lift(magnitudes[i][i]) for i in range(n)]
    squarings = 3 if n <= 8 else 0  # for many states only the norm: more doublings, but less code
    for _ in range(squarings):
        magnitudes = product(magnitudes, magnitudes)
    rows = [graph.lift(dot(row, [1.0] * n)) for row in magnitudes]
    for _ in range(squarings):
        rows = [sqrt(row) for row in rows]
    return rows


def _corrected(h: Expression, weights: Matrix, correction: Expression, jacobian_change: Matrix) -> Matrix:
    """W (h I + correction D) for the matrix W of the `weights`, with the change D = A₂ − A₁."""
    return add(scale(h, weights), scale(correction, product(weights, jacobian_change)))


def _driven(i: int, weights: Matrix, ramps: Matrix, b1: Sequence[Value], b2: Sequence[Value]) -> Value:
    """Row i of φ₁ β + φ₂ s for the line β + s t through b1 and b2 at the nodes; s = 0 where b1 and b2
    agree."""
    total: Value = 0.0
    gap = NODES[1] - NODES[0]
    for weight, ramp, x1, x2 in zip(weights[i], ramps[i], b1, b2, strict=True):
        if same(x1, x2):
            total = total + dot([weight], [x1])
        else:
            early = _combined(weight, NODES[1] / gap, ramp, -1.0 / gap)
            late = _combined(weight, -NODES[0] / gap, ramp, 1.0 / gap)
            total = total + dot([early, late], [x1, x2])
    return total


def _combined(x: Value, a: float, y: Value, b: float) -> Value:
    """a x + b y."""
    return 0.0 if is_zero(x) and is_zero(y) else a * x + b * y


def _between(start: Inputs, end: Inputs, c: float) -> dict[str, Expression]:
    """The inputs at the fraction c of a sub-step."""
    return {
        name: start[name]
        if start[name].index == end[name].index
        else start[name] + c * (end[name] - start[name])
        for name in start
    }


def _factorials(count: int) -> list[float]:
    """0!, 1!, … as floats."""
    return [float(math.factorial(k)) for k in range(count)]
