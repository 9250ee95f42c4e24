"""A general linear network as a mechanism: dx = (A x + B u) dt + L dW,  y = C x + D u + v."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from hygrokf.physics.model import Initial, Mechanism, Output, Pair, Space, Values
from hygrokf.physics.parameters import Parameter


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
    """A linear network of any size.

    `rates(p, x, u)` -> {state: rate [unit/h]}, `outputs[name](p, x, u)` -> (prediction, noise variance),
    `intensities(p)` -> {state: white noise intensity [unit²/h]}, `initial(p, u)` -> {state: (mean,
    variance)}. Nonlinear functions work too; for linear ones the filter is exact.
    """

    def output(function: Callable[[Space, Space, Space], Pair]) -> Output:
        return lambda p, x, u, q, s: function(p, x, u)

    return Mechanism(
        name=name,
        parameters=tuple(parameters),
        states=tuple(states),
        inputs=tuple(inputs),
        drift=lambda p, x, u, q, s: rates(p, x, u),
        diffusion=intensities,
        initial=initial,
        outputs={key: output(function) for key, function in outputs.items()},
        meaning="a linear network given by the user",
    )
