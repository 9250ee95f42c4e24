"""What the form of an expression says about its sign."""

from __future__ import annotations

from collections.abc import Iterable

from hygrokf.physics.expression import Expression, Graph


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
