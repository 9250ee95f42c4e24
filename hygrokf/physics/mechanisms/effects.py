"""Patterns that mechanisms share: an amplitude that scales an input, a lagged share, noise of a state, and a
general linear network, dx = (A x + B u) dt + L dW,  y = C x + D u + v."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

from hygrokf.physics.expression import Value
from hygrokf.physics.model import Factory, Initial, Mechanism, Pair, Space, Spread, Values
from hygrokf.physics.parameters import Parameter

PAPER = "Field-measurement based hygrothermal modelling of the converter-cabinet climate in wind turbines"
NONNEGATIVE = (0.0, math.inf)
"""Physical range of an amplitude that cannot be negative."""
ABOVE_MINUS_ONE = (-1.0, math.inf)
"""Physical range of a relative change."""
Factor = str | Callable[[Space, Space, Space], Value]
"""An input's name, or a function (x, u, q) -> value."""
Result = TypeVar("Result")


def named(name: str, docstring: str, factory: Factory, module: str = "") -> Factory:
    """Give a factory the name, the module and the docstring of a library function."""
    factory.__name__ = factory.__qualname__ = name
    factory.__doc__, factory.__module__ = docstring, module or factory.__module__
    return factory


def effect(
    name: str,
    target: str,
    amplitude: Parameter,
    *factors: Factor,
    negative: bool = False,
    inputs: tuple[str, ...] | None = None,
    **mechanism_fields: Any,
) -> Mechanism:
    """One amplitude a, with the null value 0, that scales inputs: target += ± a · factor · factor …

    `inputs` are read by the factors; by default the factors that are names.  `mechanism_fields` are further
    fields of the mechanism, such as its meaning and source.
    """

    def contributions(p: Space, x: Space, u: Space, q: Space) -> Values:
        values = [getattr(u, f) if isinstance(f, str) else f(x, u, q) for f in factors]
        term = -getattr(p, amplitude.name) if negative else getattr(p, amplitude.name)
        for value in values:
            term = term * value
        return {target: term}

    signals = tuple(factor for factor in factors if isinstance(factor, str))
    return Mechanism(
        name=name,
        parameters=(amplitude,),
        inputs=signals if inputs is None else inputs,
        contributions=contributions,
        **mechanism_fields,
    )


def lagged_share(
    name: str,
    target: str,
    signal: str,
    state: str,
    share: Parameter,
    time: Parameter,
    variance: float,
    amount: bool = False,
    **mechanism_fields: Any,
) -> Mechanism:
    """A share w of a signal follows it with a first-order lag θ: target += w (L − signal), dL/dt = (signal −
    L)/θ.

    `variance` is that of the state L at the first instant; `amount`: L cannot be negative;
    `mechanism_fields`: as in `effect`.
    """
    return Mechanism(
        name=name,
        parameters=(share, time),
        states=(state,),
        amounts=(state,) if amount else (),
        inputs=(signal,),
        contributions=lambda p, x, u, q: {
            target: getattr(p, share.name) * (getattr(x, state) - getattr(u, signal))
        },
        drift=lambda p, x, u, q, s: {state: (getattr(u, signal) - getattr(x, state)) / getattr(p, time.name)},
        initial=lambda p, u: {state: (getattr(u, signal), variance)},
        source="first-order mixing of the air in the tower",
        **mechanism_fields,
    )


def white_noise(name: str, module: str, state: str, intensity: Parameter, quantity: str) -> Factory:
    """White noise on a state of another mechanism; `intensity` [unit of the state/√h]."""

    def diffusion(p: Space) -> Values:
        root = getattr(p, intensity.name)
        return {state: root * root}

    def factory() -> Mechanism:
        return Mechanism(
            name=name,
            parameters=(intensity,),
            diffusion=diffusion,
            meaning=f"white disturbance of the {quantity}",
        )

    return named(
        name, f"White noise of the {quantity}, on the state `{state}` [{intensity.unit}].", factory, module
    )


def ornstein_uhlenbeck(
    name: str,
    module: str,
    target: str,
    unit: str,
    sd: tuple[float, float, float],
    start_h: float,
    meaning: str,
    leaves: str,
    reason: str,
) -> Factory:
    """A coloured disturbance w of a named sum: dw = −w/θ dt + sd √(2/θ) dW.

    `sd`: start, lower and upper limit of the standard deviation [unit]; `start_h`: start of the correlation
    time θ [h], clipped to its limits; `leaves`: what the residuals show without the disturbance; `reason`:
    why a model has it.
    """

    def variance(p: Space) -> Value:
        sd_value = getattr(p, f"{name}_sd")
        return sd_value * sd_value

    def factory(longest_h: float = 100.0, shortest_h: float = 0.25, start_h: float = start_h) -> Mechanism:
        return Mechanism(
            name=name,
            parameters=(
                Parameter(
                    f"{name}_sd", unit, *sd, positive=True, null=0.0, noise=True,
                    meaning=f"standard deviation of the {meaning}",
                ),
                Parameter(
                    f"{name}_time", "h", min(max(start_h, shortest_h), longest_h), shortest_h, longest_h,
                    positive=True, noise=True, meaning="its correlation time",
                ),
            ),
            states=(name,),
            contributions=lambda p, x, u, q: {target: getattr(x, name)},
            drift=lambda p, x, u, q, s: {name: -getattr(x, name) / getattr(p, f"{name}_time")},
            diffusion=lambda p: {name: 2.0 * variance(p) / getattr(p, f"{name}_time")},
            initial=lambda p, u: {name: (0.0, variance(p))},
            settings={"longest_h": longest_h, "shortest_h": shortest_h, "start_h": start_h},
            meaning=meaning,
            leaves=leaves,
        )  # fmt: skip

    docstring = f"""A {meaning}: an Ornstein–Uhlenbeck process w [{unit}].

    {reason}  `shortest_h` and `longest_h` limit its correlation time [h] to the range that the readings can
    resolve.
    """
    return named(name, docstring, factory, module)


def linear_network(
    name: str,
    parameters: Sequence[Parameter],
    states: Sequence[str],
    inputs: Sequence[str],
    rates: Callable[[Space, Space, Space], Values],
    outputs: Mapping[str, Callable[[Space, Space, Space], Pair]],
    intensities: Callable[..., Mapping[str, Spread]],
    initial: Initial,
    noise_exponents: Mapping[str, float] | None = None,
) -> Mechanism:
    """A network of any size, as one mechanism: dx = f(x, u) dt + x^γ L dW, y = h(x, u) + v.

    name: identifier of the mechanism.
    parameters, states, inputs: by name, in units of the user's choice; time is in hours.
    rates: (p, x, u) → {state: rate [unit/h]}.
    outputs: name → (p, x, u) → (prediction, variance of the reading's noise).
    intensities: p, or (p, u), → {state: intensity of its white noise [unit²/h]}.  In place of an intensity,
        {noise: loading [unit/√h]} gives a row of L: independent white noises by name, which states share.
    initial: (p, u) → {state: (mean, variance)} at the first instant; in place of a variance, {source:
        loading} as for `intensities`.
    noise_exponents: [1] state → γ from 0 to 1 where the noise of `intensities` is multiplied by x^γ: 1 in a
        geometric Brownian motion, ½ in a Cox–Ingersoll–Ross process (`Model` says how the filter carries it).

    Returns the mechanism for `compose`.  For functions that are linear in x and u the filter is exact.
    Raises ValueError at first use of the model where a function reads a name that the model does not have.
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
        noise_exponents=dict(noise_exponents or {}),
        meaning="a linear network given by the user",
    )


def _of_states_and_inputs(
    function: Callable[[Space, Space, Space], Result], p: Space, x: Space, u: Space, q: Space, s: Space
) -> Result:
    """Call a function of (p, x, u) with the arguments of a mechanism's function."""
    return function(p, x, u)
