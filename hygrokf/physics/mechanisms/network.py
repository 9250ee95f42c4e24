"""A general linear network as a mechanism: dx = (A x + B u) dt + L dW,  y = C x + D u + v."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from hygrokf.physics.model import Mechanism
from hygrokf.physics.parameters import Parameter


def linear_network(
    name: str,
    parameters: Sequence[Parameter],
    states: Sequence[str],
    inputs: Sequence[str],
    rates: Callable,
    outputs: Mapping[str, Callable],
    intensities: Callable,
    initial: Callable,
) -> Mechanism:
    """Any linear network of any size.

    `rates(p, x, u)` -> {state: rate [unit/h]}, `outputs[name](p, x, u)` -> (prediction, noise variance),
    `intensities(p)` -> {state: white noise intensity [unit²/h]}, `initial(p, u)` -> {state: (mean, variance)}.
    Nothing in the package asks that the functions be linear; for linear ones the filter is exact.
    """
    return Mechanism(
        name=name,
        parameters=tuple(parameters),
        states=tuple(states),
        inputs=tuple(inputs),
        drift=lambda p, x, u, q, s: rates(p, x, u),
        diffusion=intensities,
        initial=initial,
        outputs={
            key: (lambda p, x, u, q, s, function=function: function(p, x, u))
            for key, function in outputs.items()
        },
        meaning="a linear network given by the user",
    )
