"""Noise intensities and variances of readings: whether a model can make one of them negative, and whether it
does."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.physics.expression import Expression, Graph, depends_on
from hygrokf.physics.model import Model, Values, VarianceFault


@dataclass(frozen=True)
class Variances:
    """What has to be checked before a run so that no variance is negative.

    `parameters`: places of those that are at least 0 by their limits, which variances rely on; `doubtful`:
    variances, by what they are of, whose form leaves open whether they are negative.
    """

    graph: Graph
    model: Model
    parameters: tuple[int, ...]
    doubtful: tuple[tuple[str, Expression], ...]

    def check(self, theta: Sequence[float] | np.ndarray, known: Values) -> None:
        """Raise VarianceFault where a variance is negative; `theta` (d, …) values in the model's order,
        `known` those of all symbols, with the inputs of the whole run."""
        for i in self.parameters:
            if theta[i] < 0.0:
                p = self.model.parameters[i]
                raise VarianceFault(
                    f"{p.name}: expected at least 0 {p.unit}, as its limits say, found {theta[i]:g}"
                )
        found = self.graph.evaluate([e for _, e in self.doubtful], known) if self.doubtful else []
        for (what, _), value in zip(self.doubtful, found, strict=True):
            if np.any(np.asarray(value) < 0.0):
                raise VarianceFault(
                    f"expected variances and noise intensities of at least 0, found {np.min(value):g} for "
                    f"the {what}; square a standard deviation, or bound its parameters below by 0"
                )


def variances_of(
    graph: Graph, model: Model, p: Mapping[str, Expression], u: Values, x: Sequence[Expression]
) -> Variances:
    """The variances of a traced model, without those of readings that depend on the state."""
    found = [
        (f"noise intensity of the state {state}", graph.lift(spread))
        for state, spread in model.noise_spreads(p, u)
        if not isinstance(spread, Mapping)
    ]
    outputs = model.traced(x, u, p).outputs
    found += [(f"variance of the reading {name}", graph.lift(pair[1])) for name, pair in outputs.items()]
    states = [graph.nodes[e.index][1] for e in x]
    found = [(what, e) for what, e in found if not depends_on(graph, e, states)]
    read = set(graph.needed([e for _, e in found]))
    known = [q for q in model.parameters if q.lower >= 0.0 and p[q.name].index in read]
    positive = [f"c:{i}" for i, number in enumerate(graph.given) if number >= 0.0]
    positive += [f"p:{q.name}" for q in known]
    return Variances(
        graph,
        model,
        tuple(model.parameters.index(q) for q in known),
        tuple((what, e) for what, e in found if not never_negative(graph, e, positive)),
    )


def never_negative(graph: Graph, expression: Expression, positive: Iterable[str]) -> bool:
    """Whether an expression is at least 0 by its form, as a sum, product or quotient of squares,
    exponentials, roots, numbers and symbols that are `positive`; False where this does not show."""
    known, sure = set(positive), set[int]()
    for i in graph.needed([expression]):
        operation, *args = graph.nodes[i]
        match operation:
            case "const":
                holds = args[0] >= 0.0
            case "symbol":
                holds = args[0] in known
            case "mul" | "fma":
                holds = args[0] == args[1] or {args[0], args[1]} <= sure
                holds = holds and set(args[2:]) <= sure
            case "add" | "div":
                holds = set(args) <= sure
            case "select":
                holds = set(args[1:]) <= sure
            case _:
                holds = operation in ("exp", "sqrt")
        if holds:
            sure.add(i)
    return expression.index in sure
