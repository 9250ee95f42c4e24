"""Scalar expression graphs: a model is traced once, differentiated exactly, and compiled.

A mechanism is an ordinary Python function of numbers.  Called with floats, arrays or complex numbers, it
computes.  Called with `Expression`s, it is *traced*: every operation becomes a node of a `Graph`.  The graph
yields exact derivatives (`jacobian`, `reverse`, `forward`), an interpreter (`evaluate`, the reference in the
tests) and the compiled filter (`hygrokf.engine.filter_loops`).

Equal nodes are created once (hash-consing), and zeros and ones are simplified away, so that a sparse model
costs as much as its non-zero entries.  A product that is added to something becomes one fused multiply-add
*in the graph*, so that every program made from the graph rounds in the same way wherever the compiler places
the operation.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any, NoReturn

import numpy as np

Value = Any
"""A number that a model computes with: a float, a complex number, an array of either, or an `Expression`."""
Node = tuple[Any, ...]
"""`("const", float)`, `("symbol", name)` or `(operation, index of argument, …)`.

Operations: neg, exp, log, sqrt; add, sub, mul, div, lt; fma(a, b, c) = a b + c, select(a, b, c) = b where a
else c.
"""
Coefficients = Sequence[float | None]
"""The values of an operation's constant arguments; None for any other argument."""
FUNCTION_NAMES = ("exp", "log", "sqrt", "where", "maximum", "minimum")
"""The functions that a model may use."""
LARGEST_POWER = 32
"""Largest size of an exponent that is written out as a product."""


class Given(float):
    """A number that belongs to one record or logger, such as a mean temperature or a resolution.

    Tracing makes it a leaf instead of a constant: models that differ only in such numbers share one compiled
    program. Elsewhere it behaves as the float it is, and results computed from it are plain floats.
    """

    __slots__ = ()


@dataclass(frozen=True)
class _Program:
    """The interpreter's steps for some outputs: constants and leaves by node, then operations in order."""

    constants: dict[int, float]
    symbols: list[tuple[int, str]]
    operations: list[tuple[int, Callable[..., Value], tuple[int, ...]]]


class Graph:
    """A list of nodes whose arguments are indices of earlier nodes; `given` holds the numbers of the leaves
    `c:i`."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.given: list[Given] = []
        self._index: dict[Node, int] = {}
        self._append_lock = Lock()
        self._programs: dict[tuple[int, ...], _Program] = {}

    def _node(self, key: Node) -> Expression:
        """The node with this content, added if there is none yet."""
        index = self._index.get(key)
        if index is None:
            with self._append_lock:  # likelihoods of one model may run on several threads
                index = self._index.get(key)
                if index is None:
                    index = len(self.nodes)
                    self.nodes.append(key)
                    self._index[key] = index
        return Expression(self, index)

    def constant(self, value: float) -> Expression:
        return self._node(("const", float(value)))

    def symbol(self, name: str) -> Expression:
        """A named leaf; the same name gives the same leaf."""
        return self._node(("symbol", name))

    def lift(self, value: Expression | float) -> Expression:
        """A number as a node of this graph; an expression as it is.  Raises ValueError for an expression of
        another graph, TypeError for anything else."""
        if isinstance(value, Expression):
            if value.graph is not self:
                raise ValueError("an expression of another graph was mixed in: trace the model once, whole")
            return value
        # 0 and ±1 stay constants, because they simplify the operations they enter
        if isinstance(value, Given) and value not in (0.0, 1.0, -1.0):
            return self._given(value)
        try:
            return self.constant(value)
        except (TypeError, ValueError):
            description = f"an array of shape {np.shape(value)}" if np.ndim(value) else repr(value)
            raise TypeError(
                f"expected a number beside a traced value, found {description}: a model's functions are "
                "traced with one number of each name; write every component out"
            ) from None

    def _given(self, value: Given) -> Expression:
        """The leaf `c:i` of the given number i; the same object always yields the same leaf."""
        index = next((i for i, number in enumerate(self.given) if number is value), len(self.given))
        if index == len(self.given):
            self.given.append(value)
        return self.symbol(f"c:{index}")

    def number(self, index: int) -> float | None:
        """The value of a constant node; None for any other node."""
        node = self.nodes[index]
        return node[1] if node[0] == "const" else None

    # -- construction with the simplifications that keep sparse models sparse --------------------------------
    def make(self, operation: str, *arguments: Expression) -> Expression:
        """The node of an operation, or a simpler one of the same value.

        Each `_make_…` simplifies one operation, given its arguments `a` and the values `v` of those that are
        constants, and returns None where it cannot.
        """
        indices = [a.index for a in arguments]
        constants_or_none = [self.number(i) for i in indices]
        constants = [v for v in constants_or_none if v is not None]
        if len(constants) == len(constants_or_none):
            return self.constant(float(_COMPUTE[operation](*constants)))
        rule = getattr(self, "_make_" + operation, None)
        if rule is not None:
            simple = rule(arguments, constants_or_none)
            if simple is not None:
                return simple
        if operation in ("add", "mul") and indices[0] > indices[1]:
            indices.reverse()
        if operation == "fma" and indices[0] > indices[1]:
            indices[0], indices[1] = indices[1], indices[0]
        return self._node((operation, *indices))

    def _make_add(self, a: Sequence[Expression], v: Coefficients) -> Expression | None:
        if v[0] == 0.0:
            return a[1]
        if v[1] == 0.0:
            return a[0]
        for x, y in ((a[0], a[1]), (a[1], a[0])):
            node = self.nodes[x.index]
            if node[0] == "mul":
                return self.make("fma", Expression(self, node[1]), Expression(self, node[2]), y)
            if node[0] == "neg":
                return self.make("sub", y, Expression(self, node[1]))
        return None

    def _make_sub(self, a: Sequence[Expression], v: Coefficients) -> Expression | None:
        if v[1] == 0.0:
            return a[0]
        if v[0] == 0.0:
            return self.make("neg", a[1])
        if a[0].index == a[1].index:
            return self.constant(0.0)
        left, right = self.nodes[a[0].index], self.nodes[a[1].index]
        if right[0] == "neg":
            return self.make("add", a[0], Expression(self, right[1]))
        if right[0] == "mul":
            minus = self.make("neg", Expression(self, right[1]))
            return self.make("fma", minus, Expression(self, right[2]), a[0])
        if left[0] == "mul":
            minus = self.make("neg", a[1])
            return self.make("fma", Expression(self, left[1]), Expression(self, left[2]), minus)
        return None

    def _make_mul(self, a: Sequence[Expression], v: Coefficients) -> Expression | None:
        if v[0] == 0.0 or v[1] == 0.0:
            return self.constant(0.0)
        for k in (0, 1):
            if v[k] == 1.0:
                return a[1 - k]
            if v[k] == -1.0:
                return self.make("neg", a[1 - k])
            c = v[k]
            if c is not None and self.nodes[a[1 - k].index][0] == "mul":
                _, i, j = self.nodes[a[1 - k].index]
                for p, q in ((i, j), (j, i)):
                    d = self.number(p)
                    if d is not None:  # c (d x) = (c d) x
                        return self.make("mul", self.constant(c * d), Expression(self, q))
        left, right = self.nodes[a[0].index], self.nodes[a[1].index]
        if left[0] == "neg" and right[0] == "neg":
            return self.make("mul", Expression(self, left[1]), Expression(self, right[1]))
        if left[0] == "neg":
            return self.make("neg", self.make("mul", Expression(self, left[1]), a[1]))
        if right[0] == "neg":
            return self.make("neg", self.make("mul", a[0], Expression(self, right[1])))
        return None

    def _make_fma(self, a: Sequence[Expression], v: Coefficients) -> Expression | None:
        if v[0] == 0.0 or v[1] == 0.0:
            return a[2]
        if v[2] == 0.0:
            return self.make("mul", a[0], a[1])
        for k in (0, 1):
            if v[k] == 1.0:
                return self.make("add", a[1 - k], a[2])
            if v[k] == -1.0:
                return self.make("sub", a[2], a[1 - k])
        if v[0] is not None and v[1] is not None:
            return self.make("add", self.constant(v[0] * v[1]), a[2])
        return None

    def _make_div(self, a: Sequence[Expression], v: Coefficients) -> Expression | None:
        if v[0] == 0.0:
            return self.constant(0.0)
        if v[1] is not None:
            return self.make("mul", a[0], self.constant(1.0 / v[1]))
        if v[0] != 1.0:  # a reciprocal is a node of its own, so that those of parameters leave the time loop
            return self.make("mul", a[0], self.make("div", self.constant(1.0), a[1]))
        return None

    def _make_neg(self, a: Sequence[Expression], v: Coefficients) -> Expression | None:
        node = self.nodes[a[0].index]
        if node[0] == "neg":
            return Expression(self, node[1])
        if node[0] == "sub":
            return self.make("sub", Expression(self, node[2]), Expression(self, node[1]))
        return None

    def _make_select(self, a: Sequence[Expression], v: Coefficients) -> Expression | None:
        if v[0] is not None:
            return a[1] if v[0] else a[2]
        return a[1] if a[1].index == a[2].index else None

    # -- walking ---------------------------------------------------------------------------------------------
    def needed(self, outputs: Iterable[Expression], stop: Iterable[int] = ()) -> list[int]:
        """Indices of the nodes that `outputs` depend on, in an order in which they can be computed.

        Nodes in `stop` are included, their arguments are not.
        """
        halt = set(stop)
        seen: set[int] = set()
        stack = [e.index for e in outputs]
        while stack:
            i = stack.pop()
            if i in seen:
                continue
            seen.add(i)
            if i not in halt:
                stack.extend(arguments(self.nodes[i]))
        return sorted(seen)

    def evaluate(self, outputs: Sequence[Expression | float], values: Mapping[str, Value]) -> list[Value]:
        """Interpreter: compute `outputs` with numbers, arrays or complex numbers in place of the symbols."""
        output_indices = tuple(self.lift(e).index for e in outputs)
        program = self._programs.get(output_indices)
        if program is None:
            program = self._programs[output_indices] = self._program(output_indices)
        result: dict[int, Value] = dict(program.constants)
        for i, name in program.symbols:
            result[i] = self.given[int(name[2:])] if name.startswith("c:") else values[name]
        for i, compute, argument_indices in program.operations:
            result[i] = compute(*[result[j] for j in argument_indices])
        return [result[i] for i in output_indices]

    def _program(self, output_indices: Sequence[int]) -> _Program:
        """The interpreter's steps for some outputs."""
        nodes = [(i, self.nodes[i]) for i in self.needed([Expression(self, i) for i in output_indices])]
        return _Program(
            {i: node[1] for i, node in nodes if node[0] == "const"},
            [(i, node[1]) for i, node in nodes if node[0] == "symbol"],
            [(i, _COMPUTE[node[0]], node[1:]) for i, node in nodes if arguments(node)],
        )

    def substitute(
        self, outputs: Sequence[Expression | float], values: Mapping[int, Expression]
    ) -> list[Expression]:
        """Copies of `outputs` in which the nodes listed in `values` (index -> replacement) are replaced."""
        lifted = [self.lift(e) for e in outputs]
        result: dict[int, Expression] = dict(values)
        for i in self.needed(lifted, values):
            if i not in result:
                node = self.nodes[i]
                new_arguments = [result[j] for j in arguments(node)]
                result[i] = self.make(node[0], *new_arguments) if new_arguments else Expression(self, i)
        return [result[e.index] for e in lifted]


def _operator(operation: str) -> tuple[Callable[[Any, Any], Expression], Callable[[Any, Any], Expression]]:
    """The method of an operator on expressions, and its reflected method."""

    def direct(self: Expression, other: Expression | float) -> Expression:
        return self.graph.make(operation, self, self.graph.lift(other))

    def reflected(self: Expression, other: Expression | float) -> Expression:
        return self.graph.make(operation, self.graph.lift(other), self)

    return direct, reflected


class Expression:
    """One node of a graph; it supports the operators of a number, and numpy's `_FUNCTIONS`."""

    __slots__ = ("graph", "index")

    def __init__(self, graph: Graph, index: int) -> None:
        self.graph = graph
        self.index = index

    __add__, __radd__ = _operator("add")
    __sub__, __rsub__ = _operator("sub")
    __mul__, __rmul__ = _operator("mul")
    __truediv__, __rtruediv__ = _operator("div")
    __lt__, __gt__ = _operator("lt")

    def __neg__(self) -> Expression:
        return self.graph.make("neg", self)

    def __abs__(self) -> Expression:
        return where(self < 0.0, -self, self)

    def __pow__(self, exponent: Expression | float) -> Expression:
        """xⁿ: a product for an integer n, so that x may be negative; times √x for a half-integer n."""
        if isinstance(exponent, Expression | Given):
            number = self.graph.number(self.graph.lift(exponent).index)
        else:
            number = float(exponent)
        if number is None or not (2.0 * number).is_integer() or abs(number) > LARGEST_POWER:
            return exp(exponent * log(self))
        result = self.graph.constant(1.0)
        for _ in range(int(abs(number))):
            result = result * self
        if number % 1.0:
            result = result * sqrt(self)
        return 1.0 / result if number < 0.0 else result

    def __rpow__(self, base: Expression | float) -> Expression:
        return self.graph.lift(base) ** self

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *values: Value, **options: Any) -> Expression:
        return self._apply_numpy(ufunc.__name__ if method == "__call__" and not options else method, *values)

    def __array_function__(self, function: Any, types: Any, values: Any, options: Any) -> Expression:
        return self._apply_numpy(function.__name__, *values, *options.values())

    def _apply_numpy(self, name: str, *values: Value) -> Expression:
        """Apply the function with this numpy name; raises TypeError for one that models do not support."""
        if name not in _FUNCTIONS:
            raise TypeError(
                f"numpy.{name} of a traced value: a model computes with + - * / **, abs, "
                f"{', '.join(FUNCTION_NAMES)}; give what else it needs as an input"
            )
        return _FUNCTIONS[name](*map(self.graph.lift, values))

    def __bool__(self) -> NoReturn:
        raise TypeError("a model must not branch on a traced value with `if`: write where(condition, a, b)")

    def __eq__(self, other: object) -> NoReturn:
        raise TypeError(
            "a traced value cannot be compared with ==, <= or >=: write where(a < b, yes, no), which takes "
            "`no` where both are equal; codes such as 0, 1, 2 are compared with 0.5, 1.5"
        )

    __le__ = __ge__ = __ne__ = __eq__
    __hash__ = object.__hash__

    def __float__(self) -> NoReturn:
        raise TypeError(
            "a traced value is not a number yet: in place of the functions of `math`, float() and int() "
            f"write {', '.join(FUNCTION_NAMES)} (of hygrokf, or of numpy)"
        )

    def __repr__(self) -> str:
        return f"Expression({self.graph.nodes[self.index]})"


_COMPUTE: dict[str, Callable[..., Value]] = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv,
    "fma": lambda a, b, c: a * b + c, "neg": operator.neg,
    "lt": lambda a, b: np.less(np.real(a), np.real(b)), "select": np.where,
    "exp": np.exp, "log": np.log, "sqrt": np.sqrt,
}  # fmt: skip
"""The operations of the nodes as functions of numbers, arrays and complex numbers."""


def arguments(node: Node) -> tuple[int, ...]:
    """The indices of a node's arguments."""
    return () if node[0] in ("const", "symbol") else node[1:]


# -- functions for those who write mechanisms ----------------------------------------------------------------
def _unary(name: str, number: Callable[[Value], Value]) -> Callable[[Value], Value]:
    """The function `name` of values, which computes numbers and arrays by `number`."""

    def function(value: Value) -> Value:
        return value.graph.make(name, value) if isinstance(value, Expression) else number(value)

    function.__name__ = name
    function.__doc__ = (
        f"{name} for the equations of a model: of a number, an array or a traced expression.\n\n"
        "value: in any unit, as the equation has it.\n\n"
        "Returns a value of the same kind.  Raises TypeError for an argument that is not a number."
    )
    return function


exp = _unary("exp", np.exp)
log = _unary("log", np.log)
sqrt = _unary("sqrt", np.sqrt)


def where(condition: Value, yes: Value, no: Value) -> Value:
    """Choose `yes` where `condition` holds, else `no`, in the equations of a model.

    condition, yes, no: numbers, arrays or traced expressions in any unit; both branches are always computed.

    Returns a value of the same kind.  Raises ValueError for arrays whose shapes do not fit together.
    """
    for value in (condition, yes, no):
        if isinstance(value, Expression):
            g = value.graph
            return g.make("select", g.lift(condition), g.lift(yes), g.lift(no))
    return np.where(condition, yes, no)


def maximum(a: Value, b: Value) -> Value:
    """The larger of two values; the derivative is that of the larger one."""
    return where(_less_than(a, b), b, a)


def minimum(a: Value, b: Value) -> Value:
    """The smaller of two values; the derivative is that of the smaller one."""
    return where(_less_than(b, a), b, a)


def _less_than(a: Value, b: Value) -> Value:
    return a < b if isinstance(a, Expression) or isinstance(b, Expression) else np.real(a) < np.real(b)


_FUNCTIONS: dict[str, Callable[..., Expression]] = {
    "add": operator.add, "subtract": operator.sub, "multiply": operator.mul, "divide": operator.truediv,
    "negative": operator.neg, "positive": lambda a: a, "absolute": abs, "power": operator.pow,
    "square": lambda a: a * a, "reciprocal": lambda a: 1.0 / a,
    "less": operator.lt, "greater": operator.gt, "less_equal": operator.le, "greater_equal": operator.ge,
    "equal": operator.eq, "not_equal": operator.ne, "exp": exp, "log": log, "sqrt": sqrt, "where": where,
    "maximum": maximum, "minimum": minimum, "clip": lambda a, low, high: minimum(maximum(a, low), high),
}  # fmt: skip
"""Functions of traced values, by the name of the numpy function that each stands for."""


# -- derivatives ---------------------------------------------------------------------------------------------
def _partials(graph: Graph, i: int) -> list[tuple[int, Expression]]:
    """Pairs (argument, derivative of node i with respect to that argument)."""
    node = graph.nodes[i]
    e = [Expression(graph, j) for j in arguments(node)]
    one = graph.constant(1.0)
    match node[0]:
        case "add":
            return [(node[1], one), (node[2], one)]
        case "sub":
            return [(node[1], one), (node[2], -one)]
        case "mul":
            return [(node[1], e[1]), (node[2], e[0])]
        case "fma":
            return [(node[1], e[1]), (node[2], e[0]), (node[3], one)]
        case "div":
            inverse = 1.0 / e[1]
            return [(node[1], inverse), (node[2], -(Expression(graph, i) * inverse))]
        case "neg":
            return [(node[1], -one)]
        case "exp":
            return [(node[1], Expression(graph, i))]
        case "log":
            return [(node[1], 1.0 / e[0])]
        case "sqrt":
            return [(node[1], 0.5 / Expression(graph, i))]
        case "select":
            zero = graph.constant(0.0)
            return [(node[2], where(e[0], one, zero)), (node[3], where(e[0], zero, one))]
        case _:  # const, symbol, lt
            return []


def reverse(graph: Graph, seeds: Mapping[int, Expression], leaves: Iterable[int]) -> dict[int, Expression]:
    """Differentiate in reverse mode: adjoints of `leaves` (node indices) from the adjoints `seeds` of
    outputs.

    The walk stops at the leaves and skips nodes that do not depend on any leaf.
    """
    stop = set(leaves)
    order = graph.needed([Expression(graph, i) for i in seeds], stop)
    active = _dependent_nodes(graph, order, stop)
    adjoint: dict[int, Expression] = dict(seeds)
    for i in reversed(order):
        if i in stop or i not in active or i not in adjoint:
            continue
        bar = adjoint[i]
        for j, partial in _partials(graph, i):
            if j in active:
                adjoint[j] = adjoint[j] + partial * bar if j in adjoint else partial * bar
    return {i: adjoint[i] for i in stop if i in adjoint}


def forward(
    graph: Graph, outputs: Sequence[Expression], tangents: Mapping[int, Expression]
) -> list[Expression]:
    """Differentiate in forward mode: derivatives of `outputs` along the `tangents` of leaf nodes."""
    order = graph.needed(outputs, tangents)
    active = _dependent_nodes(graph, order, set(tangents))
    zero = graph.constant(0.0)
    dot: dict[int, Expression] = dict(tangents)
    for i in order:
        if i in dot or i not in active:
            continue
        total = zero
        for j, partial in _partials(graph, i):
            if j in dot:
                total = total + partial * dot[j]
        dot[i] = total
    return [dot.get(e.index, zero) for e in outputs]


def jacobian(outputs: Sequence[Expression | float], variables: Sequence[Expression]) -> Matrix:
    """Exact partial derivatives: rows are outputs, columns are variables, structural zeros are the float
    0.0."""
    graph = variables[0].graph
    lifted = [graph.lift(e) for e in outputs]
    rows = []
    for e in lifted:
        bar = reverse(graph, {e.index: graph.constant(1.0)}, [v.index for v in variables])
        rows.append([_without_constant_node(bar.get(v.index, 0.0)) for v in variables])
    return rows


@dataclass(frozen=True)
class Partials:
    """Derivatives (m, v) of m expressions by v symbols: `entries` that are not 0, at `rows` and `columns`."""

    graph: Graph
    shape: tuple[int, int]
    rows: list[int]
    columns: list[int]
    entries: list[Value]

    def evaluate(self, values: Mapping[str, Value]) -> np.ndarray:
        """The derivatives (m, v) at these values of the symbols."""
        matrix = np.zeros(self.shape)
        matrix[self.rows, self.columns] = self.graph.evaluate(self.entries, values)
        return matrix


def partials(
    graph: Graph, outputs: Sequence[Expression | float], variables: Sequence[Expression]
) -> Partials:
    """The derivatives of `outputs` by `variables`, as expressions."""
    matrix = jacobian(outputs, variables) if variables else []
    places = [(i, j) for i, row in enumerate(matrix) for j, entry in enumerate(row) if not is_zero(entry)]
    rows, columns = [i for i, _ in places], [j for _, j in places]
    return Partials(graph, (len(outputs), len(variables)), rows, columns, [matrix[i][j] for i, j in places])


def _without_constant_node(value: Expression | float) -> Expression | float:
    """The number of a constant node; any other value as it is."""
    if isinstance(value, Expression):
        number = value.graph.number(value.index)
        return value if number is None else number
    return value


def _dependent_nodes(graph: Graph, order: Sequence[int], leaves: set[int]) -> set[int]:
    """The nodes of `order` that are leaves or depend on one."""
    active: set[int] = set()
    for i in order:
        if i in leaves or not active.isdisjoint(arguments(graph.nodes[i])):
            active.add(i)
    return active


def depends_on(graph: Graph, expression: Expression | float, names: Iterable[str]) -> bool:
    """Whether an expression contains one of the named symbols."""
    if not isinstance(expression, Expression):
        return False
    symbol_names = set(names)
    nodes = graph.nodes
    return any(nodes[i][0] == "symbol" and nodes[i][1] in symbol_names for i in graph.needed([expression]))


# -- small matrices of expressions ---------------------------------------------------------------------------
Matrix = list[list[Value]]
"""Rows of expressions and numbers; a structural zero is the float 0.0."""


def is_zero(value: Expression | float) -> bool:
    """Whether a value is a structural zero."""
    number = value.graph.number(value.index) if isinstance(value, Expression) else value
    return number == 0.0
