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


def state_slopes(
    model: Model, name: str, values: Values, state: Sequence[Value] | np.ndarray, inputs: Values
) -> np.ndarray:
    """Exact derivatives (…, n) of an output, a shared quantity or the rate of a state by the states, at
    states, inputs and values of parameters that are numbers or arrays (…)."""
    # the model keeps its rows, as it keeps its filters
    rows: dict[str, list[Value]] = vars(model).setdefault("_state_slopes", {})
    if name not in rows:
        made, x, _ = _traced(model)
        found = {**made.quantities, **dict(zip(model.states, made.rates, strict=True))}
        found |= {output: prediction for output, (prediction, _) in made.outputs.items()}
        rows[name] = [x[0].graph.lift(one) for one in jacobian([found[name]], x)[0]]
    return _evaluated(rows[name], model, values, state, inputs)


def _traced(model: Model) -> tuple[Equations, list[Expression], list[Expression]]:
    """The model's equations, its states and its inputs as expressions of one graph."""
    g = Graph()
    p = {one.name: g.symbol(f"p:{one.name}") for one in model.parameters}
    x = [g.symbol(f"x:{name}") for name in model.states]
    u = {name: g.symbol(f"u:{name}") for name in model.inputs}
    return model.traced(x, u, p), x, list(u.values())


def _evaluated(
    entries: Sequence[Value],
    model: Model,
    values: Values,
    state: Sequence[Value] | np.ndarray,
    inputs: Values,
) -> np.ndarray:
    """The numbers (…, m) of m expressions of `_traced`."""
    graph = next((one.graph for one in entries if isinstance(one, Expression)), Graph())
    known = {f"p:{one.name}": values[one.name] for one in model.parameters}
    known |= {f"x:{name}": value for name, value in zip(model.states, state, strict=True)}
    known |= {f"u:{name}": inputs[name] for name in model.inputs}
    shape = np.broadcast_shapes(*(np.shape(value) for value in known.values()))
    found = [np.broadcast_to(value, shape) for value in graph.evaluate(entries, known)]
    return np.stack(found, axis=-1).astype(float)


def linearised(
    model: Model, values: Values, state: Sequence[float] | np.ndarray, inputs: Mapping[str, float]
) -> LinearSystem:
    """A model around a point; outputs are readings of an instant, also those that are read as means.

    values: of all parameters in their units, numbers or arrays (N,).  state: (n,) of the model's own states.
    inputs: by name, in the model's units.
    """
    own = replace(model, averaged={})  # a running mean is reset, which no linear system does
    made, x, u = _traced(own)
    rows = jacobian([*made.rates, *(made.outputs[name][0] for name in own.outputs)], [*x, *u])
    entries = _evaluated([one for row in rows for one in row], own, values, state, inputs)
    n, width = len(own.states), len(x) + len(u)
    matrix = entries.reshape(*entries.shape[:-1], len(rows), width)
    return LinearSystem(
        matrix[..., :n, :n], matrix[..., :n, n:], matrix[..., n:, :n], matrix[..., n:, n:],
        own.states, own.inputs, own.outputs,
    )  # fmt: skip
