"""A model as a linear system around one point, from the exact derivatives of its equations.

Shapes: n states, m inputs, k outputs, N sets of parameter values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.physics.expression import Expression, Graph, Value, jacobian
from hygrokf.physics.model import Equations, Model, Values


@dataclass(frozen=True)
class LinearSystem:
    """dx/dt = A x + B u, y = C x + D u for deviations from a point.

    `A` (n, n) [1/h], `B` (n, m), `C` (k, n), `D` (k, m), each with a leading N for N sets of parameters;
    `states`, `inputs`, `outputs`: the names of their rows and columns.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def state_derivatives(
    model: Model, name: str, values: Values, state: Sequence[Value] | np.ndarray, inputs: Values
) -> np.ndarray:
    """Exact derivatives (…, n) of an output, a shared quantity or a state's rate with respect to the
    states; states, inputs and parameter values are numbers or arrays (…)."""
    # cached on the model, as its filters are
    rows: dict[str, list[Value]] = vars(model).setdefault("_state_derivatives", {})
    if name not in rows:
        equations, x, _ = _trace_model(model)
        expressions = {**equations.quantities, **dict(zip(model.states, equations.rates, strict=True))}
        expressions |= {output: prediction for output, (prediction, _) in equations.outputs.items()}
        rows[name] = [x[0].graph.lift(derivative) for derivative in jacobian([expressions[name]], x)[0]]
    return _evaluate_entries(rows[name], model, values, state, inputs)


def _trace_model(model: Model) -> tuple[Equations, list[Expression], list[Expression]]:
    """The model's equations, its states and its inputs as expressions of one graph."""
    g = Graph()
    p = {parameter.name: g.symbol(f"p:{parameter.name}") for parameter in model.parameters}
    x = [g.symbol(f"x:{name}") for name in model.states]
    u = {name: g.symbol(f"u:{name}") for name in model.inputs}
    return model.traced(x, u, p), x, list(u.values())


def _evaluate_entries(
    entries: Sequence[Value],
    model: Model,
    values: Values,
    state: Sequence[Value] | np.ndarray,
    inputs: Values,
) -> np.ndarray:
    """The numbers (…, m) of m expressions of `_trace_model`."""
    graph = next((entry.graph for entry in entries if isinstance(entry, Expression)), Graph())
    symbol_values = {f"p:{parameter.name}": values[parameter.name] for parameter in model.parameters}
    symbol_values |= {f"x:{name}": value for name, value in zip(model.states, state, strict=True)}
    symbol_values |= {f"u:{name}": inputs[name] for name in model.inputs}
    shape = np.broadcast_shapes(*(np.shape(value) for value in symbol_values.values()))
    arrays = [np.broadcast_to(value, shape) for value in graph.evaluate(entries, symbol_values)]
    return np.stack(arrays, axis=-1).astype(float)


def linearise(
    model: Model, values: Values, state: Sequence[float] | np.ndarray, inputs: Mapping[str, float]
) -> LinearSystem:
    """A model around a point; outputs are readings of an instant, also those that are read as means.

    values: of all parameters in their units, numbers or arrays (N,).  state: (n,) of the model's own states.
    inputs: by name, in the model's units.
    """
    unaveraged = replace(model, averaged={})  # resets of running means are not linear
    equations, x, u = _trace_model(unaveraged)
    rows = jacobian(
        [*equations.rates, *(equations.outputs[name][0] for name in unaveraged.outputs)], [*x, *u]
    )
    entries = _evaluate_entries([entry for row in rows for entry in row], unaveraged, values, state, inputs)
    n, width = len(unaveraged.states), len(x) + len(u)
    matrix = entries.reshape(*entries.shape[:-1], len(rows), width)
    return LinearSystem(
        matrix[..., :n, :n], matrix[..., :n, n:], matrix[..., n:, :n], matrix[..., n:, n:],
        unaveraged.states, unaveraged.inputs, unaveraged.outputs,
    )  # fmt: skip
