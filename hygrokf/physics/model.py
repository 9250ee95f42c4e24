"""Mechanisms, and models composed of them.

A `Mechanism` is one piece of physics; a `Model` is a tuple of them.  Composition runs in four rounds, so that
the order of the mechanisms does not matter: `conductance` (their sum is g, available as the quantity
`air_conductance`), `quantities`, `contributions` to named sums, and `drift` of the states.  A sum that is
neither in `SUMS` nor read by any mechanism is a misspelling: the first trace raises an error.  The functions
are called with expressions when a model is traced and with numbers everywhere else.

Units inside a model: time h, temperature K, vapour concentration g/m³, relative humidity 1, heat as the
temperature difference [K] that it sustains across R_AT.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cached_property
from textwrap import fill, indent
from types import SimpleNamespace
from typing import Any

import numpy as np

from hygrokf.errors import suggestion
from hygrokf.physics.expression import Matrix, Value
from hygrokf.physics.holds import holds_named
from hygrokf.physics.parameters import Parameter, unique

Space = SimpleNamespace
"""Named values that a mechanism's function reads as attributes: parameters, states, inputs, quantities or
sums."""
Values = Mapping[str, Value]
"""Values by name."""
Feature = tuple[Callable[..., np.ndarray], str]
"""A function (record, time, **settings) -> values (T,) at `time` (T,) [s], and the hold of the input that it
gives."""
Pair = tuple[Value, Value]
"""A mean, or a prediction, and its variance."""
Initial = Callable[[Space, Space], Mapping[str, Pair]]
"""(p, u) -> mean and variance of each of the mechanism's states."""
Output = Callable[[Space, Space, Space, Space, Space], Pair]
"""(p, x, u, q, s) -> expected reading and the variance of its noise."""

SUMS = {
    "heat_release": "heat released into the cabinet, as Q R_AT [K]",
    "thermal_pace": "relative change of the thermal rate 1/τ [1]",
    "exchange": "relative change of the air exchange with the ambient [1]",
    "ambient_vapour": "difference between the intake air of the cabinet and the ambient series [g/m³]",
    "vapour_release": "vapour released into the cabinet air, per volume [g/(m³ h)]",
    "cabinet_temperature_reading": "error of the temperature reading [K]",
    "cabinet_relative_humidity_reading": "error of the humidity reading [1]",
    "cabinet_absolute_humidity_reading": "error of the absolute humidity reading [g/m³]",
}
"""Sums that mechanisms may contribute to; a mechanism with a network of its own may read further sums."""


def fields_alone(instance: Any) -> dict[str, Any]:
    """What a pickle keeps of a dataclass: its fields. A copy derives again what is cached."""
    return {one.name: getattr(instance, one.name) for one in fields(instance)}


def fields_by_line(instance: Any) -> str:
    """A dataclass in words: what it consists of, and its settings that are not the usual ones."""
    lines = [type(instance).__name__]
    for one in fields(instance):
        value = getattr(instance, one.name)
        if one.default is MISSING:
            lines.append(indent(repr(value), "  "))
        elif value != one.default:
            lines.append(f"  {one.name}: {value!r}")
    return "\n".join(lines)


@dataclass(frozen=True)
class Mechanism:
    """One piece of physics: parameters, states and inputs, and functions of them.

    Each function is pure and reads parameters `p`, states `x`, inputs `u`, quantities `q` and sums `s` as
    attributes; units inside a model are h, K, g/m³ and 1.

        corrections(x, u)              inputs as they truly are, in place of those that were read
        conductance(p, u)              air exchange in parallel to 1/R_AT, in units of it [1]
        quantities(p, x, u, g)         shared quantities, such as the temperature of the cabinet air
        contributions(p, x, u, q)      terms of named sums (`SUMS`), such as the heat release [K]
        drift(p, x, u, q, s)           rates of the mechanism's own states [unit/h]
        diffusion(p)                   intensities of their white noise [unit²/h]
        initial(p, u)                  their (mean, variance) at the first instant
        outputs[name](p, x, u, q, s)   expected reading, and the variance of its noise

    name: identifier in the library.
    parameters, states, inputs: what its functions read; states and inputs by name.
    corrections, conductance, quantities, contributions, drift, diffusion, initial, outputs: the functions
        above.
    amounts: states that cannot be negative; simulations enforce this, the filter does not.
    features: those inputs that no signal gives and that this mechanism brings with it, by name.
    settings: the arguments that the mechanism was made with; `library[name](**settings)` makes it again.
    meaning, leaves, source: what it is, what its absence leaves in the residuals, the equations' origin.

    Raises ValueError, from the model at first use, where the mechanism does not fit it.
    """

    name: str
    parameters: tuple[Parameter, ...] = ()
    states: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    corrections: Callable[[Space, Space], Values] | None = None
    conductance: Callable[[Space, Space], Value] | None = None
    quantities: Callable[[Space, Space, Space, Value], Values] | None = None
    contributions: Callable[[Space, Space, Space, Space], Values] | None = None
    drift: Callable[[Space, Space, Space, Space, Space], Values] | None = None
    diffusion: Callable[[Space], Values] | None = None
    initial: Initial | None = None
    outputs: Mapping[str, Output] = field(default_factory=dict)
    amounts: tuple[str, ...] = ()
    features: Mapping[str, Feature] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    meaning: str = ""
    leaves: str = ""
    source: str = ""

    @property
    def null(self) -> dict[str, float]:
        """Parameter values at which the mechanism has no effect on a model."""
        return {p.name: p.null for p in self.parameters if p.null is not None}


@dataclass(frozen=True)
class Model:
    """States, inputs, outputs and equations, put together from mechanisms (`compose` makes a model).

    mechanisms: in any order.
    holds: input → its hold, as `compose` takes it.
    averaged: outputs that are read as interval means → the interval [h].
    bound: [1] distance of a reading from its prediction in standard deviations beyond which it moves the
        state no further; its square is whole, or it is infinite, as for the exact Gaussian likelihood.

    `parameters`, `states` (n), `inputs` and `outputs` list the names in the order of all arrays; `evaluate`
    gives rates [unit/h] and expected readings at one point.  A model can be pickled; functions of mechanisms
    outside the library must then be those of a module.
    Raises ValueError for an unknown hold or bound, and at first use where mechanisms do not fit together.
    """

    mechanisms: tuple[Mechanism, ...]
    holds: Mapping[str, str] = field(default_factory=dict)
    averaged: Mapping[str, float] = field(default_factory=dict)
    bound: float = math.inf

    __getstate__ = fields_alone

    def __repr__(self) -> str:
        """Mechanisms, states, inputs and outputs by name."""
        rows = {"mechanisms": [m.name for m in self.mechanisms], "states": self.states}
        rows |= {"inputs": self.inputs, "outputs": self.outputs}
        lines = (f"  {kind}: {', '.join(names)}" for kind, names in rows.items())
        return "\n".join(["Model", *(fill(line, 100, subsequent_indent="    ") for line in lines)])

    def __post_init__(self) -> None:
        object.__setattr__(self, "holds", holds_named(self.holds))
        if not (self.bound > 0.0 and (math.isinf(self.bound) or (self.bound**2).is_integer())):
            raise ValueError(
                f"bound: expected a number above 0 whose square is whole, or infinity, found {self.bound}; "
                "take 3 or 4, or leave it out"
            )

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return unique(p for m in self.mechanisms for p in m.parameters)

    @cached_property
    def own_states(self) -> tuple[str, ...]:
        names = [s for m in self.mechanisms for s in m.states]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"two mechanisms have a state of the same name: {twice}")
        return tuple(names)

    @cached_property
    def states(self) -> tuple[str, ...]:
        """The mechanisms' states, and one running mean for every output that is read as an interval mean."""
        return self.own_states + tuple(f"mean_{name}" for name in self.averaged)

    @cached_property
    def amounts(self) -> tuple[bool, ...]:
        """For every state, whether it cannot be negative."""
        names = {name for m in self.mechanisms for name in m.amounts}
        return tuple(name in names for name in self.states)

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for m in self.mechanisms for name in m.inputs))

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        return tuple(name for m in self.mechanisms for name in m.outputs)

    @property
    def resets(self) -> tuple[int, ...]:
        """Places of the states that are running means, set to zero where an averaging interval begins."""
        return tuple(self.states.index(f"mean_{name}") for name in self.averaged)

    @property
    def input_holds(self) -> dict[str, str]:
        """The hold of every input.  Raises ValueError where one is not stated."""
        unknown = [name for name in self.inputs if name not in self.holds]
        if unknown:
            raise ValueError(f"the holds of the inputs {unknown} are not stated")
        return {name: self.holds[name] for name in self.inputs}

    # -- the model as functions ------------------------------------------------------------------------------
    def evaluate(self, x: Sequence[Value] | np.ndarray, u: Values, p: Values) -> Equations:
        """All quantities, sums, rates and outputs at a state x (n,), inputs u and parameters p.

        Accepts numbers, arrays (broadcast), complex numbers and traced expressions.
        """
        return self._equations(x, u, p, lambda sums: SimpleNamespace(**sums))

    def traced(self, x: Sequence[Value], u: Values, p: Values) -> Equations:
        """`evaluate`, with a check that some mechanism reads every sum that is contributed to; raises
        ValueError otherwise."""
        read: set[str] = set()
        found = self._equations(x, u, p, lambda sums: _Sums(sums, read))
        known = (*SUMS, *sorted(read - set(SUMS)))
        unknown = [name for name in found.sums if name not in known]
        if unknown:
            added = self._contributions(*self._spaces(x, u, p), SimpleNamespace(**found.quantities))
            raise ValueError(
                "; ".join(
                    f'mechanism "{mechanism}" adds to the sum "{name}", which no mechanism '
                    f"reads{suggestion(name, known, 1)}"
                    for mechanism, name, _ in added
                    if name in unknown
                )
                + f" (the sums of this model: {', '.join(known)})"
            )
        return found

    def _equations(
        self, x: Sequence[Value] | np.ndarray, u: Values, p: Values, as_read: Callable[[Values], Space]
    ) -> Equations:
        """The values of `evaluate`; `as_read` makes the object from which mechanisms read the sums."""
        spaces = self._spaces(x, u, p)
        state = vars(spaces[1])
        quantities = self._quantities(spaces)
        q = SimpleNamespace(**quantities)
        sums: dict[str, Value] = defaultdict(float, dict.fromkeys(SUMS, 0.0))
        for _, name, value in self._contributions(*spaces, q):
            sums[name] = sums[name] + value
        s = as_read(sums)
        outputs = {
            name: function(*spaces, q, s) for m in self.mechanisms for name, function in m.outputs.items()
        }
        rates: dict[str, Value] = {}
        for m in self.mechanisms:
            if m.drift is not None:
                rates.update(m.drift(*spaces, q, s))
        for name, interval in self.averaged.items():
            rates[f"mean_{name}"] = outputs[name][0] * (1.0 / interval)
            outputs[name] = (state[f"mean_{name}"], outputs[name][1])
        missing = [n for n in self.states if n not in rates]
        if missing:
            raise ValueError(
                f"no rate is given for the states {missing}: the drift of a mechanism must return the "
                "rates of all its states"
            )
        return Equations(quantities, dict(sums), [rates[n] for n in self.states], outputs)

    def quantities(self, x: Sequence[Value] | np.ndarray, u: Values, p: Values) -> dict[str, Value]:
        """The shared quantities of `evaluate` alone."""
        return self._quantities(self._spaces(x, u, p))

    def _spaces(self, x: Sequence[Value] | np.ndarray, u: Values, p: Values) -> tuple[Space, Space, Space]:
        """Parameters, states and inputs in the form that mechanisms read."""
        state, inputs = SimpleNamespace(**dict(zip(self.states, x, strict=True))), dict(u)
        for m in self.mechanisms:
            if m.corrections is not None:
                inputs.update(m.corrections(state, SimpleNamespace(**inputs)))
        return SimpleNamespace(**p), state, SimpleNamespace(**inputs)

    def _contributions(self, p: Space, x: Space, u: Space, q: Space) -> Iterator[tuple[str, str, Value]]:
        """Every term of every sum as (mechanism, sum, value)."""
        for m in self.mechanisms:
            if m.contributions is not None:
                for name, value in m.contributions(p, x, u, q).items():
                    yield m.name, name, value

    def _quantities(self, spaces: tuple[Space, Space, Space]) -> dict[str, Value]:
        p, x, u = spaces
        g: Value = 0.0
        for m in self.mechanisms:
            if m.conductance is not None:
                g = g + m.conductance(p, u)
        found: dict[str, Value] = {"air_conductance": g}
        for m in self.mechanisms:
            if m.quantities is not None:
                found.update(m.quantities(p, x, u, g))
        return found

    def noise(self, p: Values) -> Matrix:
        """White noise intensity Q (n, n) [unit²/h] of the states."""
        n = len(self.states)
        result: Matrix = [[0.0] * n for _ in range(n)]
        for m in self.mechanisms:
            if m.diffusion is not None:
                for name, value in m.diffusion(SimpleNamespace(**p)).items():
                    i = self.states.index(name)
                    result[i][i] = result[i][i] + value
        return result

    def initial(self, p: Values, u: Values) -> tuple[list[Value], list[Value]]:
        """Mean and variance (n,) of the states at an instant with inputs u, before any reading."""
        given: dict[str, Pair] = {f"mean_{name}": (0.0, 0.0) for name in self.averaged}
        for m in self.mechanisms:
            if m.initial is not None:
                given.update(m.initial(SimpleNamespace(**p), SimpleNamespace(**u)))
        missing = [n for n in self.states if n not in given]
        if missing:
            raise ValueError(f"no initial mean and variance for the states {missing}")
        return [given[n][0] for n in self.states], [given[n][1] for n in self.states]


class _Sums(SimpleNamespace):
    """The sums of a model as a mechanism reads them; records the names that were read."""

    def __init__(self, sums: Values, read: set[str]) -> None:
        super().__init__()
        self._sums = sums
        self._read = read

    def __getattr__(self, name: str) -> Value:
        self._read.add(name)
        if name in self._sums:
            return self._sums[name]
        raise AttributeError(
            f'a mechanism reads the sum "{name}", to which no mechanism adds'
            f"{suggestion(name, self._sums, 1)} (the sums of this model: {', '.join(self._sums)})"
        )


@dataclass(frozen=True)
class Equations:
    """A model's values at one point: shared quantities, sums, rates (n,) [unit/h], outputs (prediction,
    variance)."""

    quantities: dict[str, Value]
    sums: dict[str, Value]
    rates: list[Value]
    outputs: dict[str, Pair]


def compose(
    mechanisms: Iterable[Mechanism],
    holds: Mapping[str, str] | None = None,
    averaged: Mapping[str, float] | None = None,
) -> Model:
    """Compose a model from mechanisms.

    mechanisms: in any order; each brings its parameters, states, inputs and contributions.
    holds: input → how it continues between its values at two instants: "previous" ("zoh", held from an
        instant on), "mean" (constant over the step that ends at an instant) or "linear" ("foh").
    averaged: output → interval [h] over which its readings are means.

    Returns the model.  Its equations are put together at first use.  Raises ValueError for an unknown hold
    and, then, for two states of one name, for a sum that nobody reads, and for an input without a hold.
    """
    return Model(tuple(mechanisms), dict(holds or {}), dict(averaged or {}))


def extend(model: Model, mechanism: Mechanism, holds: Mapping[str, str] | None = None) -> Model:
    """Add a mechanism to a model.

    model: that of `compose`, or of a fit (`fit.design.model`).
    mechanism: with state names of its own; model units are h, K, g/m³ and 1.
    holds: how the mechanism's own inputs continue between two instants, as in `compose`.

    Returns the larger model; at the mechanism's null values it equals the original one, so that a likelihood
    ratio compares them.  Raises ValueError at first use, as `compose` does.
    """
    return replace(model, mechanisms=(*model.mechanisms, mechanism), holds={**model.holds, **(holds or {})})
