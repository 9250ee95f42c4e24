"""A general linear network as a mechanism: dx = (A x + B u) dt + L dW,  y = C x + D u + v."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TypeVar

from hygrokf.physics.model import Initial, Mechanism, Pair, Space, Values
from hygrokf.physics.parameters import Parameter

Result = TypeVar("Result")


def linear_network(
    name: str,
    parameters: Sequence[Parameter],
    states: Sequence[str],
    inputs: Sequence[str],
    rates: Callable[[Space, Space, Space], Values],
    outputs: Mapping[str, Callable[[Space, Space, Space], Pair]],
    intensities: Callable[[Space], Values],
    initial: Initial,
) -> Mechanism:
    """A linear network of any size, as one mechanism.

    name: identifier of the mechanism.
    parameters, states, inputs: by name, in units of the user's choice; time is in hours.
    rates: (p, x, u) → {state: rate [unit/h]}.
    outputs: name → (p, x, u) → (prediction, variance of the reading's noise).
    intensities: p → {state: intensity of its white noise [unit²/h]}.
    initial: (p, u) → {state: (mean, variance)} at the first instant.

    Returns the mechanism for `compose`.  Nonlinear functions work too; for linear ones the filter is exact.
    Raises ValueError at first use of the model where a function names an unknown state.
    """

    return Mechanism(
        name=name,
        parameters=tuple(parameters),
        states=tuple(states),
        inputs=tuple(inputs),
        drift=partial(_of_states_and_inputs, rates),
        diffusion=intensities,
        initial=initial,
        outputs={key: partial(_of_states_and_inputs, function) for key, function in outputs.items()},
        meaning="a linear network given by the user",
    )


def _of_states_and_inputs(
    function: Callable[[Space, Space, Space], Result], p: Space, x: Space, u: Space, q: Space, s: Space
) -> Result:
    return function(p, x, u)
