"""Traced graphs against numpy on the same formulas: values, exact derivatives, simplifications.

Hypothesis makes random formulas.  `Number` is the independent computation: numpy on complex numbers (a
complex step gives derivatives to rounding), carrying along bounds of its value and derivative that rounding
errors scale with.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from hygrokf.physics.expression import (
    Expression,
    Graph,
    depends_on,
    exp,
    forward,
    is_zero,
    jacobian,
    log,
    maximum,
    minimum,
    reverse,
    sqrt,
    where,
)

SYMBOLS = ("x", "y", "z")
STEP = 1e-30
ROUNDING = 1e-12  # 5,000 units of double rounding: formulas have at most 25 leaves
TIE = 1e-6  # comparisons closer than this may go either way by rounding


class Number:
    """A complex number with bounds on the size of its value and derivative, all cancellation undone; `gap`
    to the nearest tie of a comparison."""

    def __init__(self, value: complex, size: float, slope: float, gap: float = math.inf) -> None:
        self.value, self.size, self.slope, self.gap = value, size, slope, gap


Bound = tuple[float, float]
FORMS: dict[str, tuple[Callable, Callable[..., Bound]]] = {
    "add": (lambda a, b: a + b, lambda a, b: (a.size + b.size, a.slope + b.slope)),
    "sub": (lambda a, b: a - b, lambda a, b: (a.size + b.size, a.slope + b.slope)),
    "mul": (lambda a, b: a * b, lambda a, b: (a.size * b.size, a.size * b.slope + a.slope * b.size)),
    "div": (
        lambda a, b: a / (1.5 + b * b),
        lambda a, b: (
            a.size * (1.5 + b.size**2),
            (a.slope * (1.5 + b.size**2) + 2.0 * a.size * b.size * b.slope) * (1.5 + b.size**2),
        ),
    ),
    "neg": (lambda a: -a, lambda a: (a.size, a.slope)),
    "exp": (
        lambda a: exp(a / (1.0 + a * a)),  # at most e^½
        lambda a: (2.0 + a.size, 6.0 * a.slope * (1.0 + a.size**2)),
    ),
    "log": (lambda a: log(2.0 + a * a), lambda a: (2.0 + a.size**2, a.size * a.slope)),
    "sqrt": (lambda a: sqrt(1.0 + a * a), lambda a: (1.0 + a.size**2, a.size * a.slope)),
    "where": (
        lambda a, b, c, d: where(_less(a, b), c, d),
        lambda a, b, c, d: (max(c.size, d.size), max(c.slope, d.slope)),
    ),
}
"""Formulas as a mechanism would write them, and how size and slope of the result are bounded."""


def _less(a: object, b: object) -> object:
    if isinstance(a, Expression) or isinstance(b, Expression):
        return a < b
    return float(np.real(a) < np.real(b))


def number(tree: tuple, at: dict[str, Number]) -> Number:
    """The formula by numpy: the functions of numbers are numpy's."""
    kind, *rest = tree
    if kind == "symbol":
        return at[rest[0]]
    if kind == "constant":
        return Number(complex(rest[0]), abs(rest[0]), 0.0)
    branches = [number(branch, at) for branch in rest]
    value = complex(FORMS[kind][0](*(one.value for one in branches)))
    gap = min(one.gap for one in branches)
    if kind == "where":
        a, b = branches[:2]
        gap = min(gap, abs((a.value - b.value).real) / (1.0 + a.size + b.size))
    return Number(value, *FORMS[kind][1](*branches), gap)


def traced(tree: tuple, at: dict[str, object]) -> object:
    kind, *rest = tree
    if kind == "symbol":
        return at[rest[0]]
    return rest[0] if kind == "constant" else FORMS[kind][0](*(traced(branch, at) for branch in rest))


LEAVES = st.one_of(
    st.sampled_from(SYMBOLS).map(lambda name: ("symbol", name)),
    # zeros and ones of either sign meet the simplifications, other constants are folded
    st.sampled_from([0.0, 1.0, -1.0, 2.0, -0.5, 3.25]).map(lambda value: ("constant", value)),
)


def _branches(inner: st.SearchStrategy) -> st.SearchStrategy:
    unary = st.tuples(st.sampled_from(["neg", "exp", "log", "sqrt"]), inner)
    binary = st.tuples(st.sampled_from(["add", "sub", "mul", "div"]), inner, inner)
    return st.one_of(unary, binary, binary, st.tuples(st.just("where"), inner, inner, inner, inner))


TREES = st.recursive(LEAVES, _branches, max_leaves=25)
POINTS = st.tuples(*[st.floats(-2.0, 2.0, allow_subnormal=False).map(lambda v: round(v, 6)) for _ in SYMBOLS])
formulas = settings(max_examples=100)


def along(tree: tuple, point: tuple, direction: tuple) -> Number:
    """Value, and derivative along a direction as the imaginary part, of the formula by numpy."""
    return number(
        tree,
        {
            name: Number(complex(v, d * STEP), abs(v), abs(d))
            for name, v, d in zip(SYMBOLS, point, direction, strict=True)
        },
    )


def tracing(tree: tuple) -> tuple[Graph, list[Expression], Expression]:
    graph = Graph()
    symbols = [graph.symbol(name) for name in SYMBOLS]
    return graph, symbols, graph.lift(traced(tree, dict(zip(SYMBOLS, symbols, strict=True))))


@formulas
@given(TREES, POINTS)
def test_a_traced_formula_has_the_value_that_numpy_gives_it(tree: tuple, point: tuple) -> None:
    graph, _, output = tracing(tree)
    expected = along(tree, point, (0.0, 0.0, 0.0))
    assume(expected.gap > TIE and expected.size < 1e6)
    found = graph.evaluate([output], dict(zip(SYMBOLS, point, strict=True)))[0]
    assert abs(found - expected.value.real) <= ROUNDING * (1.0 + expected.size)


@formulas
@given(TREES, POINTS)
def test_jacobian_forward_and_reverse_give_the_complex_step_derivative(tree: tuple, point: tuple) -> None:
    graph, symbols, output = tracing(tree)
    at = dict(zip(SYMBOLS, point, strict=True))
    expected = [along(tree, point, tuple(np.eye(3)[i])) for i in range(3)]
    assume(expected[0].gap > TIE and max(e.size + e.slope for e in expected) < 1e6)
    row = jacobian([output], symbols)[0]
    found = graph.evaluate(row, at)
    for i, e in enumerate(expected):
        assert abs(found[i] - e.value.imag / STEP) <= ROUNDING * (1.0 + e.size + e.slope) ** 2
    direction = (0.3, -1.7, 0.9)
    whole = along(tree, point, direction).value.imag / STEP
    tolerance = ROUNDING * (1.0 + sum(e.size + e.slope for e in expected)) ** 2
    tangents = {s.index: graph.constant(d) for s, d in zip(symbols, direction, strict=True)}
    assert abs(graph.evaluate(forward(graph, [output], tangents), at)[0] - whole) <= tolerance
    seed = 2.5
    bars = reverse(graph, {output.index: graph.constant(seed)}, [s.index for s in symbols])
    backwards = sum(
        d * graph.evaluate([bars[s.index]], at)[0]
        for s, d in zip(symbols, direction, strict=True)
        if s.index in bars
    )
    assert abs(backwards - seed * whole) <= seed * tolerance


@formulas
@given(TREES, POINTS)
def test_second_derivatives_are_symmetric_and_those_of_the_traced_gradient(tree: tuple, point: tuple) -> None:
    graph, symbols, output = tracing(tree)
    expected = along(tree, point, (1.0, 1.0, 1.0))
    assume(expected.gap > TIE and expected.size + expected.slope < 1e3)
    gradient = jacobian([output], symbols)[0]
    hessian = jacobian(gradient, symbols)
    at = dict(zip(SYMBOLS, point, strict=True))
    found = np.array([graph.evaluate(row, at) for row in hessian], dtype=float)
    size = (2.0 + expected.size + expected.slope) ** 3
    np.testing.assert_allclose(found, found.T, rtol=0, atol=ROUNDING * size)
    for i, name in enumerate(SYMBOLS):
        moved = {**at, name: complex(at[name], STEP)}
        column = [np.imag(v) / STEP for v in graph.evaluate(gradient, moved)]
        np.testing.assert_allclose(found[:, i], column, rtol=0, atol=ROUNDING * size)


@formulas
@given(TREES, POINTS, TREES)
def test_substitution_equals_evaluation_at_the_substituted_value(
    tree: tuple, point: tuple, inner: tuple
) -> None:
    graph, symbols, output = tracing(tree)
    at = dict(zip(SYMBOLS, point, strict=True))
    replacement = graph.lift(traced(inner, dict(zip(SYMBOLS, symbols, strict=True))))
    value = graph.evaluate([replacement], at)[0]
    moved = (float(value), *point[1:])
    expected = along(tree, moved, (0.0, 0.0, 0.0))
    assume(expected.gap > TIE and expected.size < 1e6)
    found = graph.evaluate(graph.substitute([output], {symbols[0].index: replacement}), at)[0]
    assert abs(found - expected.value.real) <= ROUNDING * (1.0 + expected.size)


def test_arrays_and_complex_numbers_go_through_the_interpreter() -> None:
    graph, _, output = tracing(("mul", ("exp", ("symbol", "x")), ("sub", ("symbol", "y"), ("symbol", "z"))))
    x, y, z = np.linspace(-1, 1, 5), 2.0, np.full(5, 0.5)
    expected = np.exp(x / (1 + x * x)) * (y - z)
    np.testing.assert_allclose(graph.evaluate([output], {"x": x, "y": y, "z": z})[0], expected, rtol=1e-15)
    assert graph.evaluate([output], {"x": 0.0, "y": 1j, "z": 0.0})[0] == 1j


SIMPLE = {
    "x + 0": lambda x, y: x + 0.0,
    "0 + x": lambda x, y: 0.0 + x,
    "x - 0": lambda x, y: x - 0.0,
    "1 x": lambda x, y: 1.0 * x,
    "x 1": lambda x, y: x * 1.0,
    "x / 1": lambda x, y: x / 1.0,
    "-(0 - x)": lambda x, y: -(0.0 - x),
    "(-1)(-x)": lambda x, y: -1.0 * -x,
    "x + 0 y": lambda x, y: x + 0.0 * y,
    "x - 0 / y": lambda x, y: x - 0.0 / y,
    "where(1 < 2, x, y)": lambda x, y: where(1.0 < 2.0, x, y),
    "where(x < y, x, x)": lambda x, y: where(x < y, x, x),
    "x^1": lambda x, y: x**1,
    "0.5 (2 x)": lambda x, y: 0.5 * (2.0 * x),
}


@pytest.mark.parametrize("formula", SIMPLE.values(), ids=SIMPLE)
def test_what_is_the_symbol_itself_is_simplified_to_the_symbol(formula: object) -> None:
    graph = Graph()
    x, y = graph.symbol("x"), graph.symbol("y")
    assert formula(x, y).index == x.index


VANISHING = {
    "x - x": lambda x, y: x - x,
    "0 x": lambda x, y: 0.0 * x,
    "x 0": lambda x, y: x * 0.0,
    "0 / x": lambda x, y: 0.0 / x,
    "x y - y x": lambda x, y: x * y - y * x,
    "1 + -1": lambda x, y: (x - x + 1.0) + -1.0,
}


@pytest.mark.parametrize("formula", VANISHING.values(), ids=VANISHING)
def test_structural_zeros_vanish(formula: object) -> None:
    graph = Graph()
    assert is_zero(formula(graph.symbol("x"), graph.symbol("y")))


def test_equal_nodes_are_made_once_whatever_the_order() -> None:
    graph = Graph()
    x, y = graph.symbol("x"), graph.symbol("y")
    assert (x + y).index == (y + x).index
    assert (x * y).index == (y * x).index
    assert (x * y + 3.0).index == (3.0 + y * x).index
    assert graph.symbol("x").index == x.index
    before = len(graph.nodes)
    _ = exp(x * y) + exp(y * x)
    assert len(graph.nodes) <= before + 3  # the product, its exponential, their sum


def test_a_product_in_a_sum_is_one_fused_node() -> None:
    graph = Graph()
    x, y, z = (graph.symbol(name) for name in SYMBOLS)
    for made in (x * y + z, z + x * y, z - x * y, x * y - z):
        assert graph.nodes[made.index][0] == "fma"
    values = {"x": 3.0, "y": 5.0, "z": 7.0}
    assert graph.evaluate([x * y + z, z - x * y, x * y - z], values) == [22.0, -8.0, 8.0]


@pytest.mark.parametrize(("a", "b"), [(1.0, 2.0), (2.0, 1.0), (-1.5, 0.25)])
def test_maximum_and_minimum_pick_value_and_derivative(a: float, b: float) -> None:
    graph = Graph()
    x, y = graph.symbol("x"), graph.symbol("y")
    outputs = [maximum(x, y), minimum(x, y)]
    at = {"x": a, "y": b}
    assert graph.evaluate(outputs, at) == [max(a, b), min(a, b)]
    assert [maximum(a, b), minimum(a, b)] == [max(a, b), min(a, b)]
    rows = [graph.evaluate(row, at) for row in jacobian(outputs, [x, y])]
    larger = [float(a > b), float(b > a)]
    np.testing.assert_array_equal(rows, [larger, larger[::-1]])
    # a constant on either side
    assert graph.evaluate([maximum(x, 0.0), minimum(0.5, y)], at) == [max(a, 0.0), min(0.5, b)]
    np.testing.assert_array_equal(maximum(np.array([a, b]), 0.0), np.maximum([a, b], 0.0))


@pytest.mark.parametrize("function", [exp, log, sqrt])
def test_functions_of_numbers_are_numpys(function: object) -> None:
    reference = getattr(np, function.__name__)
    assert function(2.25) == reference(2.25)
    np.testing.assert_array_equal(function(np.array([1.0, 4.0])), reference([1.0, 4.0]))
    graph = Graph()
    assert graph.number(function(graph.constant(2.25)).index) == reference(2.25)  # folded


@pytest.mark.parametrize("exponent", [0, 1, 2, 5, 8, 0.8, 1.8, -2.0])
def test_powers(exponent: float) -> None:
    graph = Graph()
    x = graph.symbol("x")
    value, slope = graph.evaluate([x**exponent, jacobian([x**exponent], [x])[0][0]], {"x": 1.7})
    assert value == pytest.approx(1.7**exponent, rel=1e-14)
    assert slope == pytest.approx(exponent * 1.7 ** (exponent - 1), rel=1e-14)


def test_a_branch_on_a_traced_value_is_refused_with_the_remedy() -> None:
    graph = Graph()
    with pytest.raises(TypeError, match="where"):
        if graph.symbol("x") < 1.0:
            pass


def test_expressions_of_two_graphs_do_not_mix() -> None:
    with pytest.raises(ValueError, match="another graph"):
        _ = Graph().symbol("x") + Graph().symbol("x")


def test_leaves_stop_the_walks() -> None:
    graph = Graph()
    x = graph.symbol("x")
    inner = exp(x)
    output = inner * inner
    assert set(reverse(graph, {output.index: graph.constant(1.0)}, [inner.index])) == {inner.index}
    slope = reverse(graph, {output.index: graph.constant(1.0)}, [inner.index])[inner.index]
    assert graph.evaluate([slope], {"x": 0.3})[0] == pytest.approx(2 * math.exp(0.3), rel=1e-15)
    dotted = forward(graph, [output], {inner.index: graph.constant(1.0)})[0]
    assert graph.evaluate([dotted], {"x": 0.3})[0] == pytest.approx(2 * math.exp(0.3), rel=1e-15)
    assert depends_on(graph, output, ["x"]) and not depends_on(graph, output, ["y"])
    assert not depends_on(graph, 1.0, ["x"])


def test_numpys_functions_of_a_traced_value_are_the_models_own() -> None:
    """Each gives the node that the package's own function gives, or computes what numpy computes."""
    g = Graph()
    x, y = g.symbol("x"), g.symbol("y")
    for made, same in (
        (np.exp(x), exp(x)), (np.log(x), log(x)), (np.sqrt(x), sqrt(x)),
        (np.where(x < y, x, 2.0), where(x < y, x, 2.0)), (np.maximum(x, 0.5), maximum(x, 0.5)),
        (np.minimum(0.5, x), minimum(0.5, x)), (np.float64(2.0) * x, 2.0 * x), (np.float64(2.0) - x, 2.0 - x),
        (np.clip(x, 0.0, 1.0), minimum(maximum(x, 0.0), 1.0)), (np.square(x), x * x), (np.power(x, 3), x**3),
        (np.array(2.0) * x, 2.0 * x), (x / np.float64(4.0), x / 4.0), (np.float64(1.0) < x, x > 1.0),
    ):  # fmt: skip
        assert made.index == same.index
    for at in (-1.7, 0.3):
        found = g.evaluate([abs(x), np.abs(x), 2.0**x, np.negative(x)], {"x": at})
        np.testing.assert_allclose(found, [abs(at), abs(at), 2.0**at, -at], rtol=1e-15)


@pytest.mark.parametrize("exponent", [2, 2.0, 3, 5.0, np.int64(2), np.float64(4.0), -1, -2.0, 12, 0, 0.0])
def test_a_whole_power_takes_negative_numbers(exponent: float) -> None:
    g = Graph()
    x = g.symbol("x")
    (slope,) = jacobian([x**exponent], [x])[0]
    for at in (-1.7, 2.3):
        value, derivative = g.evaluate([x**exponent, slope], {"x": at})
        assert value == pytest.approx(at ** float(exponent), rel=1e-14)
        assert derivative == pytest.approx(float(exponent) * at ** (float(exponent) - 1.0), rel=1e-13)


@pytest.mark.parametrize("exponent", [0.5, 1.5, -0.5, 2.5])
def test_a_half_power_is_a_root(exponent: float) -> None:
    g = Graph()
    x = g.symbol("x")
    assert g.evaluate([x**exponent], {"x": 2.3})[0] == pytest.approx(2.3**exponent, rel=1e-15)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda x: np.sin(x), r"numpy\.sin of a traced value: .* exp, log, sqrt, where, maximum"),
        (lambda x: np.add.reduce(x), r"numpy\.reduce"),
        (lambda x: math.exp(x), "in place of the functions of `math`.* exp, log"),
        (lambda x: float(x), "not a number yet"),
        (lambda x: x == 1.0, "compared with ==.*where"),
        (lambda x: x != 1.0, "compared with =="),
        (lambda x: x <= 1.0, "compared with =="),
        (lambda x: np.float64(1.0) >= x, "compared with =="),
        (lambda x: 1.0 if x < 0.0 else 2.0, "must not branch"),
        (lambda x: np.ones(2) * x, r"expected a number .* found an array of shape \(2,\)"),
        (lambda x: x + "1a", "expected a number .* found '1a'"),
        (lambda x: x + None, "expected a number .* found None"),
    ],
)
def test_what_a_traced_value_cannot_do_is_said(call: Callable, words: str) -> None:
    with pytest.raises(TypeError, match=words):
        call(Graph().symbol("x"))
