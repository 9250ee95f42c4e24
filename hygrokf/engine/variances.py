"""Noise intensities and variances of readings: whether they can be, and whether they are, negative."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.physics.expression import Expression, Graph, depends_on
from hygrokf.physics.model import Model, Values, VarianceFault


@dataclass(frozen=True)
class Variances:
    """Checks before a run that no variance is negative.

    `parameters`: indices of the parameters with a lower limit of at least 0 that variances depend on;
    `doubtful`: (description, variance) of variances whose expression may be negative.
    """

    graph: Graph
    model: Model
    parameters: tuple[int, ...]
    doubtful: tuple[tuple[str, Expression], ...]

    def check(self, theta: Sequence[float] | np.ndarray, symbol_values: Values) -> None:
        """Raise VarianceFault where a variance is negative; `theta` (d, …): parameters in the model's
        order; `symbol_values`: values of all symbols, with the inputs of the whole run."""
        for i in self.parameters:
            if theta[i] < 0.0:
                p = self.model.parameters[i]
                raise VarianceFault(
                    f"{p.name}: expected at least 0 {p.unit}, as its limits say, found {theta[i]:g}"
                )
        variances = self.graph.evaluate([e for _, e in self.doubtful], symbol_values) if self.doubtful else []
        for (description, _), value in zip(self.doubtful, variances, strict=True):
            if np.any(np.asarray(value) < 0.0):
                raise VarianceFault(
                    f"expected variances and noise intensities of at least 0, found {np.min(value):g} for "
                    f"the {description}; square a standard deviation, or bound its parameters below by 0"
                )


def variances_of(
    graph: Graph, model: Model, p: Mapping[str, Expression], u: Values, x: Sequence[Expression]
) -> Variances:
    """The checks for a traced model; variances that depend on the state are left out."""
    variances = [
        (f"noise intensity of the state {state}", graph.lift(spread))
        for state, spread in model.noise_spreads(p, u)
        if not isinstance(spread, Mapping)
    ]
    outputs = model.traced(x, u, p).outputs
    variances += [(f"variance of the reading {name}", graph.lift(pair[1])) for name, pair in outputs.items()]
    states = [graph.nodes[e.index][1] for e in x]
    variances = [(description, e) for description, e in variances if not depends_on(graph, e, states)]
    needed = set(graph.needed([e for _, e in variances]))
    nonnegative = [q for q in model.parameters if q.lower >= 0.0 and p[q.name].index in needed]
    nonnegative_symbols = [f"c:{i}" for i, number in enumerate(graph.given) if number >= 0.0]
    nonnegative_symbols += [f"p:{q.name}" for q in nonnegative]
    return Variances(
        graph,
        model,
        tuple(model.parameters.index(q) for q in nonnegative),
        tuple(
            (description, e)
            for description, e in variances
            if not never_negative(graph, e, nonnegative_symbols)
        ),
    )


def never_negative(graph: Graph, expression: Expression, nonnegative: Iterable[str]) -> bool:
    """Whether the form of an expression proves that it is at least 0: a sum, product or quotient of squares,
    exponentials, roots, and numbers and symbols that are `nonnegative`."""
    nonnegative_symbols, proven = set(nonnegative), set[int]()
    for i in graph.needed([expression]):
        operation, *args = graph.nodes[i]
        match operation:
            case "const":
                is_proven = args[0] >= 0.0
            case "symbol":
                is_proven = args[0] in nonnegative_symbols
            case "mul" | "fma":
                is_proven = args[0] == args[1] or {args[0], args[1]} <= proven
                is_proven = is_proven and set(args[2:]) <= proven
            case "add" | "div":
                is_proven = set(args) <= proven
            case "select":
                is_proven = set(args[1:]) <= proven
            case _:
                is_proven = operation in ("exp", "sqrt")
        if is_proven:
            proven.add(i)
    return expression.index in proven
