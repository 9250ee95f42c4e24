"""A model as a linear system around one point, from the exact derivatives of its equations.

Shapes: n states, m inputs, k outputs, N sets of parameter values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.physics.expression import Graph, jacobian
from hygrokf.physics.model import Model, Values


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


def linearised(
    model: Model, values: Values, state: Sequence[float] | np.ndarray, inputs: Mapping[str, float]
) -> LinearSystem:
    """A model around a point; outputs are readings of an instant, also those that are read as means.

    values: of all parameters in their units, numbers or arrays (N,).  state: (n,) of the model's own states.
    inputs: by name, in the model's units.
    """
    own = replace(model, averaged={})  # a running mean is reset, which no linear system does
    g = Graph()
    p = {one.name: g.symbol(f"p:{one.name}") for one in own.parameters}
    x = [g.symbol(f"x:{name}") for name in own.states]
    u = {name: g.symbol(f"u:{name}") for name in own.inputs}
    made = own.traced(x, u, p)
    rows = jacobian([*made.rates, *(made.outputs[name][0] for name in own.outputs)], [*x, *u.values()])
    known = {f"p:{one.name}": values[one.name] for one in own.parameters}
    known |= {f"x:{name}": value for name, value in zip(own.states, state, strict=True)}
    known |= {f"u:{name}": inputs[name] for name in own.inputs}
    entries = np.broadcast_arrays(*g.evaluate([one for row in rows for one in row], known))
    n, width = len(own.states), len(x) + len(u)
    matrix = np.stack(entries, axis=-1).astype(float).reshape(*entries[0].shape, len(rows), width)
    return LinearSystem(
        matrix[..., :n, :n], matrix[..., :n, n:], matrix[..., n:, :n], matrix[..., n:, n:],
        own.states, own.inputs, own.outputs,
    )  # fmt: skip
