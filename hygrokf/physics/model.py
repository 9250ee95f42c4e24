"""Mechanisms, and models composed of them.

A `Mechanism` is one piece of physics: its parameters, its states, the inputs it reads, and up to six functions of
numbers.  A `Model` is a tuple of mechanisms.  Composition runs in four rounds, so that the order of the
mechanisms does not matter:

1. `conductance(p, u)`        -> a conductance between cabinet air and ambient beside 1/R_AT, in its units; their sum is g;
2. `quantities(p, x, u, g)`   -> shared quantities, such as the temperature of the cabinet air;
3. `contributions(p, x, u, q)` -> terms added to named sums, such as the heat release;
4. `drift(p, x, u, q, s)`     -> the rates of the mechanism's own states [unit/h], with the sums in `s`.

The sum g is the quantity `air_conductance`.  `p` parameters, `x` states, `u` inputs, `q` quantities and `s` sums are read as attributes.  A sum that is
neither in `SUMS` nor read by any mechanism is misspelt: the first trace raises an error.  `diffusion(p)` gives white noise
intensities [unit²/h] of the mechanism's own states, `initial(p, u)` their (mean, variance) at the first instant,
`outputs(p, x, u, q, s)` what a sensor is expected to show and the variance of its noise.
All functions are pure; they are called with expressions when a model is traced and with numbers everywhere else.

Units inside a model: time h, temperature K, vapour concentration g/m³, relative humidity 1, heat as the temperature
difference in K that it would hold up across R_AT.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import SimpleNamespace

from hygrokf.errors import suggestion
from hygrokf.physics.expression import Value
from hygrokf.physics.parameters import Parameter, unique

SUMS = {
    "heat_release": "heat released into the cabinet, as Q R_AT [K]",
    "thermal_pace": "relative change of the thermal rate 1/τ [1]",
    "exchange": "relative change of the air exchange with the ambient [1]",
    "ambient_vapour": "departure of the air that the cabinet breathes from the ambient series [g/m³]",
    "vapour_release": "vapour released into the cabinet air, per volume [g/(m³ h)]",
    "cabinet_temperature_reading": "error of the temperature reading [K]",
    "cabinet_relative_humidity_reading": "error of the humidity reading [1]",
    "cabinet_absolute_humidity_reading": "error of the absolute humidity reading [g/m³]",
}
"""Sums that mechanisms may contribute to; a mechanism that owns a further network may read sums of its own."""


@dataclass(frozen=True)
class Mechanism:
    """One piece of physics; see the module's text for the functions.

    `amounts` are states of which there cannot be less than nothing; the filter does not know that, simulations keep to it.
    `settings` are the numbers that the mechanism was made with (they make it again: `library[name](**settings)`);
    `leaves` says what its absence leaves in the residuals, `source` where the equations come from.
    """

    name: str
    parameters: tuple[Parameter, ...] = ()
    states: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    conductance: Callable | None = None
    quantities: Callable | None = None
    contributions: Callable | None = None
    drift: Callable | None = None
    diffusion: Callable | None = None
    initial: Callable | None = None
    outputs: Mapping[str, Callable] = field(default_factory=dict)
    amounts: tuple[str, ...] = ()
    settings: Mapping[str, object] = field(default_factory=dict)
    meaning: str = ""
    leaves: str = ""
    source: str = ""

    @property
    def null(self) -> dict[str, float]:
        """Values at which a model with this mechanism is the model without it."""
        return {p.name: p.null for p in self.parameters if p.null is not None}


@dataclass(frozen=True)
class System:
    """A continuous-time model as functions of expressions, ready to be traced.

    `inputs` maps names to holds (`linear`, `zero-order`, or `regime`: piecewise constant with few distinct values);
    `drift(x, u, p)` -> n rates [1/h]; `noise(p)` -> (n, n) intensity [1/h]; `outputs` are pairs (name,
    function (x, u, p) -> (prediction, noise variance)); `averages` maps a state index to the output whose running
    mean it is: it is set to zero where an averaging interval begins.
    """

    parameters: tuple[str, ...]
    states: tuple[str, ...]
    inputs: Mapping[str, str]
    drift: Callable
    noise: Callable
    outputs: tuple[tuple[str, Callable], ...]
    resets: tuple[int, ...] = ()


@dataclass(frozen=True)
class Model:
    """A tuple of mechanisms; `averaged` maps outputs that are read as interval means to the interval [h].

    `holds` maps every input to its hold: linear, zero-order, or regime (piecewise constant with few values).
    """

    mechanisms: tuple[Mechanism, ...]
    holds: Mapping[str, str] = field(default_factory=dict)
    averaged: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return unique(p for m in self.mechanisms for p in m.parameters)

    @cached_property
    def own_states(self) -> tuple[str, ...]:
        names = [s for m in self.mechanisms for s in m.states]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"two mechanisms bring a state of the same name: {twice}")
        return tuple(names)

    @cached_property
    def states(self) -> tuple[str, ...]:
        """The mechanisms' states and one running mean for every output that is read as an interval mean."""
        return self.own_states + tuple(f"mean_{name}" for name in self.averaged)

    @cached_property
    def amounts(self) -> tuple[bool, ...]:
        """Which of the states cannot be below 0."""
        names = {name for m in self.mechanisms for name in m.amounts}
        return tuple(name in names for name in self.states)

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for m in self.mechanisms for name in m.inputs))

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        return tuple(name for m in self.mechanisms for name in m.outputs)

    def mechanism(self, name: str) -> Mechanism:
        """The mechanism of that name."""
        for m in self.mechanisms:
            if m.name == name:
                return m
        raise KeyError(f"no mechanism {name!r}; the model has {[m.name for m in self.mechanisms]}")

    # -- the model as functions ------------------------------------------------------------------------------
    def evaluate(self, x: Sequence, u: Mapping[str, object], p: Mapping[str, object]) -> Equations:
        """All quantities, sums, rates and outputs at a state x (n,), inputs u and parameters p.

        Works with numbers, arrays (broadcast), complex numbers and traced expressions.
        """
        return self._equations(x, u, p, lambda sums: SimpleNamespace(**sums))

    def _traced(self, x: Sequence, u: Mapping[str, object], p: Mapping[str, object]) -> Equations:
        """`evaluate`, which also makes sure that every sum that is added to exists; raises ValueError where one does not."""
        read: set[str] = set()
        found = self._equations(x, u, p, lambda sums: _Sums(sums, read))
        known = (*SUMS, *sorted(read - set(SUMS)))
        unknown = [name for name in found.sums if name not in known]
        if unknown:
            added = self._contributions(*self._spaces(x, u, p), SimpleNamespace(**found.quantities))
            raise ValueError(
                "; ".join(
                    f'mechanism "{mechanism}" adds to the sum "{name}", which no mechanism reads{suggestion(name, known, 1)}'
                    for mechanism, name, _ in added
                    if name in unknown
                )
                + f" (the sums of this model: {', '.join(known)})"
            )
        return found

    def _equations(
        self,
        x: Sequence,
        u: Mapping[str, object],
        p: Mapping[str, object],
        as_read: Callable[[Mapping[str, object]], object],
    ) -> Equations:
        """The values of `evaluate`; `as_read` makes of all sums the object that mechanisms read them from."""
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
        rates: dict[str, object] = {}
        for m in self.mechanisms:
            if m.drift is not None:
                rates.update(m.drift(*spaces, q, s))
        for name, interval in self.averaged.items():
            rates[f"mean_{name}"] = outputs[name][0] * (1.0 / interval)
            outputs[name] = (state[f"mean_{name}"], outputs[name][1])
        missing = [n for n in self.states if n not in rates]
        if missing:
            raise ValueError(
                f"no rate is given for the states {missing}: a mechanism's drift must return all of its own"
            )
        return Equations(quantities, dict(sums), [rates[n] for n in self.states], outputs)

    def quantities(self, x: Sequence, u: Mapping[str, object], p: Mapping[str, object]) -> dict[str, object]:
        """Shared quantities alone, as `evaluate` has them."""
        return self._quantities(self._spaces(x, u, p))

    def _spaces(
        self, x: Sequence, u: Mapping[str, object], p: Mapping[str, object]
    ) -> tuple[SimpleNamespace, SimpleNamespace, SimpleNamespace]:
        """Parameters, states and inputs as mechanisms read them."""
        state = dict(zip(self.states, x, strict=True))
        return SimpleNamespace(**p), SimpleNamespace(**state), SimpleNamespace(**u)

    def _contributions(
        self, p: SimpleNamespace, x: SimpleNamespace, u: SimpleNamespace, q: SimpleNamespace
    ) -> Iterator[tuple[str, str, object]]:
        """Every term of every sum: the mechanism that adds it, the sum, the value."""
        for m in self.mechanisms:
            if m.contributions is not None:
                for name, value in m.contributions(p, x, u, q).items():
                    yield m.name, name, value

    def _quantities(self, spaces: Sequence[SimpleNamespace]) -> dict[str, object]:
        p, x, u = spaces
        g: object = 0.0
        for m in self.mechanisms:
            if m.conductance is not None:
                g = g + m.conductance(p, u)
        found: dict[str, object] = {"air_conductance": g}
        for m in self.mechanisms:
            if m.quantities is not None:
                found.update(m.quantities(p, x, u, g))
        return found

    def noise(self, p: Mapping[str, object]) -> list[list]:
        """White noise intensity Q (n, n) [unit²/h] of the states."""
        n = len(self.states)
        result: list[list] = [[0.0] * n for _ in range(n)]
        for m in self.mechanisms:
            if m.diffusion is not None:
                for name, value in m.diffusion(SimpleNamespace(**p)).items():
                    i = self.states.index(name)
                    result[i][i] = result[i][i] + value
        return result

    def initial(self, p: Mapping[str, object], u: Mapping[str, object]) -> tuple[list, list]:
        """Mean and variance (n,) of the states at an instant with inputs u, before any reading."""
        given: dict[str, tuple] = {f"mean_{name}": (0.0, 0.0) for name in self.averaged}
        for m in self.mechanisms:
            if m.initial is not None:
                given.update(m.initial(SimpleNamespace(**p), SimpleNamespace(**u)))
        missing = [n for n in self.states if n not in given]
        if missing:
            raise ValueError(f"no initial mean and variance for the states {missing}")
        return [given[n][0] for n in self.states], [given[n][1] for n in self.states]

    @cached_property
    def system(self) -> System:
        unknown = [name for name in self.inputs if name not in self.holds]
        if unknown:
            raise ValueError(f"the holds of the inputs {unknown} are not stated")
        return System(
            parameters=tuple(p.name for p in self.parameters),
            states=self.states,
            inputs={name: self.holds[name] for name in self.inputs},
            drift=lambda x, u, p: self._traced(x, u, p).rates,
            noise=self.noise,
            outputs=tuple(
                (name, lambda x, u, p, name=name: self._traced(x, u, p).outputs[name])
                for name in self.outputs
            ),
            resets=tuple(self.states.index(f"mean_{name}") for name in self.averaged),
        )


class _Sums:
    """The sums of a model as a mechanism reads them, which remembers the names that were read."""

    def __init__(self, sums: Mapping[str, object], read: set[str]) -> None:
        self._sums = sums
        self._read = read

    def __getattr__(self, name: str) -> object:
        self._read.add(name)
        if name in self._sums:
            return self._sums[name]
        raise AttributeError(
            f'a mechanism reads the sum "{name}", to which none adds{suggestion(name, self._sums, 1)} '
            f"(the sums of this model: {', '.join(self._sums)})"
        )


@dataclass(frozen=True)
class Equations:
    """A model's values at one point: shared quantities, sums, rates (n,) [unit/h], outputs (prediction, variance)."""

    quantities: dict
    sums: dict
    rates: list
    outputs: dict


def compose(
    mechanisms: Iterable[Mechanism],
    holds: Mapping[str, str] | None = None,
    averaged: Mapping[str, float] | None = None,
) -> Model:
    """A model from mechanisms; see `Model`."""
    return Model(tuple(mechanisms), dict(holds or {}), dict(averaged or {}))


def extend(model: Model, mechanism: Mechanism, holds: Mapping[str, str] | None = None) -> Model:
    """The model with one mechanism more; at the mechanism's null values it is the old model exactly."""
    return replace(model, mechanisms=(*model.mechanisms, mechanism), holds={**model.holds, **(holds or {})})


def without(model: Model, name: str) -> Model:
    """The model with one mechanism less."""
    model.mechanism(name)
    return replace(model, mechanisms=tuple(m for m in model.mechanisms if m.name != name))
