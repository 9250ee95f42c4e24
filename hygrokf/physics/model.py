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

import inspect
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cached_property
from textwrap import fill, indent
from types import SimpleNamespace
from typing import Any

import numpy as np

from hygrokf.errors import suggestion, unknown_names
from hygrokf.physics.expression import Expression, Matrix, Value, exp, log
from hygrokf.physics.holds import holds_named
from hygrokf.physics.parameters import Parameter, unique


class VarianceFault(FloatingPointError, ValueError):
    """A variance or a noise intensity below 0; the message names the state or the output, and the remedy."""


class UnknownName(AttributeError, ValueError):
    """A mechanism's function reads a name that the model does not have."""


class Space(SimpleNamespace):
    """Named values that a mechanism's function reads as attributes: parameters, states, inputs, quantities or
    sums.  Reading an unknown name raises `UnknownName`, whose message lists the existing names."""

    _letter, _kind, _hint = "q", "quantities", ""

    def __getattr__(self, name: str) -> Value:
        names = list(vars(self))
        raise UnknownName(
            f"a mechanism reads {self._letter}.{name}, but the {self._kind} here are "
            f"{', '.join(names) or 'none'}{suggestion(name, names, 1)}{self._hint}"
        )


class _Parameters(Space):
    _letter, _kind = "p", "parameters"


class _States(Space):
    _letter, _kind = "x", "states"


class _Inputs(Space):
    _letter, _kind = "u", "inputs"


class _NoiseInputs(_Inputs):
    _hint = "; noise that grows with a state is given by noise_exponents"


Values = Mapping[str, Value]
"""Values by name."""
Feature = tuple[Callable[..., np.ndarray], str]
"""A function (record, time, **settings) -> values (T,) of an input at `time` (T,) [s]; and its hold."""
Pair = tuple[Value, Value]
"""A mean, or a prediction, and its variance."""
Spread = Value | Mapping[str, Value]
"""The variance of one state, or its loadings on independent sources of variance 1 by the sources' names.
States may share sources: states i and j have the covariance Σ_k l_ik l_jk, the matrix L L'."""
Initial = Callable[[Space, Space], Mapping[str, tuple[Value, Spread]]]
"""(p, u) -> mean and spread of each of the mechanism's states."""
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


def field_values(instance: Any) -> dict[str, Any]:
    """Values of a dataclass's fields by name: the state that a pickle keeps, without cached properties."""
    return {entry.name: getattr(instance, entry.name) for entry in fields(instance)}


def describe_fields(instance: Any) -> str:
    """Describe a dataclass instance: its required fields, and the others that differ from their default."""
    lines = [type(instance).__name__]
    for entry in fields(instance):
        value = getattr(instance, entry.name)
        if entry.default is MISSING:
            lines.append(indent(repr(value), "  "))
        elif value != entry.default:
            lines.append(f"  {entry.name}: {value!r}")
    return "\n".join(lines)


@dataclass(frozen=True)
class Mechanism:
    """One piece of physics: parameters, states and inputs, and functions of them.

    Each function is pure and reads parameters `p`, states `x`, inputs `u`, quantities `q` and sums `s` as
    attributes; units inside a model are h, K, g/m³ and 1.

        corrections(x, u)              true inputs, which replace the measured ones
        conductance(p, u)              air exchange in parallel to 1/R_AT, in units of it [1]
        quantities(p, x, u, g)         shared quantities, such as the temperature of the cabinet air
        contributions(p, x, u, q)      terms of named sums (`SUMS`), such as the heat release [K]
        drift(p, x, u, q, s)           rates of the mechanism's own states [unit/h]
        diffusion(p) or (p, u)         intensities of their white noise [unit²/h], as `Spread`
        initial(p, u)                  their (mean, variance) at the first instant, the variance as `Spread`
        outputs[name](p, x, u, q, s)   expected reading, and the variance of its noise

    name: identifier in the library.
    parameters, states, inputs: the values that its functions read; states and inputs by name.
    corrections, conductance, quantities, contributions, drift, diffusion, initial, outputs: the functions
        above.
    noise_exponents: [1] γ of each state whose white noise grows with the state, dx = f dt + x^γ L dW, where
        `diffusion` gives L L' and 0 ≤ γ ≤ 1 (`Model.natural`).
    amounts: states that cannot be negative; simulations enforce this, the filter does not.
    features: functions for the inputs that no signal gives, by input name.
    settings: the arguments of its factory; `library[name](**settings)` creates the mechanism again.
    meaning, leaves, source: what it is; what the residuals show without it; the origin of its equations.

    A model raises ValueError at first use where the mechanism does not fit it.
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
    diffusion: Callable[..., Mapping[str, Spread]] | None = None
    initial: Initial | None = None
    outputs: Mapping[str, Output] = field(default_factory=dict)
    noise_exponents: Mapping[str, float] = field(default_factory=dict)
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


Factory = Callable[..., Mechanism]
"""A function (**settings) -> mechanism."""


@dataclass(frozen=True)
class Model:
    """States, inputs, outputs and equations, put together from mechanisms (`compose` makes a model).

    mechanisms: in any order.
    holds: input → its hold, as `compose` takes it.
    averaged: outputs that are read as interval means → the interval [h].
    bound: [1] distance of a reading from its prediction in standard deviations beyond which it moves the
        state no further; its square is an integer, or it is infinite, as for the exact Gaussian likelihood.

    `parameters`, `states` (n), `inputs` and `outputs` list the names in the order of all arrays; `evaluate`
    gives rates [unit/h] and expected readings for given values.  A model can be pickled if the functions of
    its mechanisms outside the library are defined at module level.

    A state x whose white noise grows with the state, dx = f dt + x^γ dV, is carried in its Lamperti
    coordinate z, in which the noise is constant (Itô's formula, with the intensity Q of dV):
        z = x^(1−γ)/(1−γ), or ln x for γ = 1;    dz = (f x^−γ − ½ γ Q x^(γ−1)) dt + dV.
    Arrays of states and their covariances hold z; all functions of mechanisms read x.  `natural` returns
    to x.
    Raises ValueError for an unknown hold or bound, and at first use where mechanisms do not fit together.
    """

    mechanisms: tuple[Mechanism, ...]
    holds: Mapping[str, str] = field(default_factory=dict)
    averaged: Mapping[str, float] = field(default_factory=dict)
    bound: float = math.inf

    __getstate__ = field_values

    def __repr__(self) -> str:
        """Mechanisms, states, inputs and outputs by name."""
        rows = {"mechanisms": [m.name for m in self.mechanisms], "states": self.states}
        rows |= {"inputs": self.inputs, "outputs": self.outputs}
        lines = (f"  {kind}: {', '.join(names)}" for kind, names in rows.items())
        return "\n".join(["Model", *(fill(line, 100, subsequent_indent="    ") for line in lines)])

    def __post_init__(self) -> None:
        if wrong_types := [type(m).__name__ for m in self.mechanisms if not isinstance(m, Mechanism)]:
            raise ValueError(f"mechanisms: expected Mechanisms, found {', '.join(wrong_types)}")
        object.__setattr__(self, "holds", holds_named(self.holds))
        if not (self.bound > 0.0 and (math.isinf(self.bound) or (self.bound**2).is_integer())):
            raise ValueError(
                f"bound: expected a number above 0 whose square is an integer, or infinity, "
                f"found {self.bound}; take 3 or 4, or leave it out"
            )

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return unique(p for m in self.mechanisms for p in m.parameters)

    @cached_property
    def mechanism_states(self) -> tuple[str, ...]:
        return _unique_names("a state", (s for m in self.mechanisms for s in m.states))

    @cached_property
    def states(self) -> tuple[str, ...]:
        """The mechanisms' states, and one running mean for every output that is read as an interval mean."""
        return self.mechanism_states + tuple(f"mean_{name}" for name in self.averaged)

    @cached_property
    def amounts(self) -> tuple[bool, ...]:
        """For every state, whether it cannot be negative."""
        names = {name for m in self.mechanisms for name in m.amounts} - set(self.exponents)
        return tuple(name in names for name in self.states)

    @cached_property
    def _state_set(self) -> frozenset[str]:
        return frozenset(self.mechanism_states)

    @cached_property
    def exponents(self) -> dict[str, float]:
        """Exponents γ > 0 of the states whose noise grows as x^γ.  Raises ValueError for an unknown state and
        for γ outside 0 … 1."""
        exponents: dict[str, float] = {}
        for m in self.mechanisms:
            for name, exponent in self._check_states(m, "noise_exponents", m.noise_exponents).items():
                if not 0.0 <= exponent <= 1.0:
                    raise ValueError(
                        f"noise_exponents: expected 0 to 1 for the state {name}, found {exponent}; write the "
                        "model in a coordinate in which its noise is constant"
                    )
                exponents |= {name: float(exponent)} if exponent else {}
        return exponents

    def _check_states(
        self, m: Mechanism, kind: str, values: object, taken: Iterable[str] = ()
    ) -> Mapping[str, Any]:
        """Check that the values, returned by a mechanism's function, are of states of the model that no other
        mechanism has `taken`; return the values."""
        if isinstance(values, dict) and values.keys() <= self._state_set and values.keys().isdisjoint(taken):
            return values
        source = f'{kind} of the mechanism "{m.name}"'
        if not isinstance(values, Mapping):
            raise ValueError(f'{source}: expected a mapping {{"state": value, …}}, found {values!r}')
        if faults := unknown_names(source, values, self.mechanism_states):
            raise ValueError("; ".join(faults))
        if duplicates := sorted(set(values) & set(taken)):
            raise ValueError(f"{source}: another mechanism gives values of {duplicates} too")
        return values

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for m in self.mechanisms for name in m.inputs))

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        return _unique_names("an output", (name for m in self.mechanisms for name in m.outputs))

    @property
    def resets(self) -> tuple[int, ...]:
        """Indices of the running-mean states, which are set to zero where an averaging interval begins."""
        return tuple(self.states.index(f"mean_{name}") for name in self.averaged)

    @property
    def input_holds(self) -> dict[str, str]:
        """The hold of every input.  Raises ValueError for an input without a hold."""
        unknown = [name for name in self.inputs if name not in self.holds]
        if unknown:
            stated = f"; stated are those of {', '.join(self.holds) or 'none'}"
            raise ValueError(f"the holds of the inputs {unknown} are not stated{stated}")
        return {name: self.holds[name] for name in self.inputs}

    # -- the model as functions ------------------------------------------------------------------------------
    def evaluate(self, x: Sequence[Value] | np.ndarray, u: Values, p: Values) -> Equations:
        """All quantities, sums, rates and outputs at a state x (n,), inputs u and parameters p.

        Accepts numbers, arrays (broadcast), complex numbers and traced expressions.
        """
        return self._equations(x, u, p, lambda sums: Space(**sums))

    def traced(self, x: Sequence[Value], u: Values, p: Values) -> Equations:
        """Evaluate the equations; raises ValueError for a contribution to a sum that no mechanism reads."""
        read: set[str] = set()
        equations = self._equations(x, u, p, lambda sums: _ReadSums(sums, read))
        readable = (*SUMS, *sorted(read - set(SUMS)))
        unknown = [name for name in equations.sums if name not in readable]
        if unknown:
            terms = self._contributions(*self._spaces(x, u, p), Space(**equations.quantities))
            raise ValueError(
                "; ".join(
                    f'mechanism "{mechanism}" adds to the sum "{name}", which no mechanism '
                    f"reads{suggestion(name, readable, 1)}"
                    for mechanism, name, _ in terms
                    if name in unknown
                )
                + f" (the sums of this model: {', '.join(readable)})"
            )
        return equations

    def _equations(
        self, x: Sequence[Value] | np.ndarray, u: Values, p: Values, make_sums: Callable[[Values], Space]
    ) -> Equations:
        """The values of `evaluate`; `make_sums` makes the object from which mechanisms read the sums."""
        spaces = self._spaces(x, u, p)
        state = vars(spaces[1])
        quantities = self._quantities(spaces)
        q = Space(**quantities)
        sums: dict[str, Value] = defaultdict(float, dict.fromkeys(SUMS, 0.0))
        for _, name, value in self._contributions(*spaces, q):
            sums[name] = sums[name] + value
        s = make_sums(sums)
        outputs = {
            name: _pair(f'output "{name}"', function(*spaces, q, s))
            for m in self.mechanisms
            for name, function in m.outputs.items()
        }
        rates: dict[str, Value] = {}
        for m in self.mechanisms:
            if m.drift is not None:
                rates.update(self._check_states(m, "rates", m.drift(*spaces, q, s), rates))
        for name, interval in self.averaged.items():
            rates[f"mean_{name}"] = outputs[name][0] * (1.0 / interval)
            outputs[name] = (state[f"mean_{name}"], outputs[name][1])
        missing = [n for n in self.states if n not in rates]
        if missing:
            raise ValueError(
                f"no rate is given for the states {missing}: the drift of a mechanism must return the "
                "rates of all its states"
            )
        if self.exponents:
            noise = self.noise(p, u)
            for name, exponent in self.exponents.items():
                i = self.states.index(name)
                scale, derivative = _noise_scale(x[i], exponent)
                rates[name] = rates[name] / scale - 0.5 * noise[i][i] * derivative
        return Equations(quantities, dict(sums), [rates[n] for n in self.states], outputs)

    def quantities(self, x: Sequence[Value] | np.ndarray, u: Values, p: Values) -> dict[str, Value]:
        """Evaluate only the shared quantities."""
        return self._quantities(self._spaces(x, u, p))

    def _spaces(self, x: Sequence[Value] | np.ndarray, u: Values, p: Values) -> tuple[Space, Space, Space]:
        """Parameters, states and inputs in the form that mechanisms read."""
        states, inputs = dict(zip(self.states, x, strict=True)), dict(u)
        for name, exponent in self.exponents.items():
            states[name] = _natural(states[name], exponent)
        state_space = _States(**states)
        for m in self.mechanisms:
            if m.corrections is not None:
                inputs.update(m.corrections(state_space, _Inputs(**inputs)))
        return _Parameters(**p), state_space, _Inputs(**inputs)

    def _contributions(self, p: Space, x: Space, u: Space, q: Space) -> Iterator[tuple[str, str, Value]]:
        """Every term of every sum as (mechanism, sum, value)."""
        for m in self.mechanisms:
            if m.contributions is not None:
                for name, value in m.contributions(p, x, u, q).items():
                    yield m.name, name, value

    def _quantities(self, spaces: tuple[Space, Space, Space]) -> dict[str, Value]:
        p, x, u = spaces
        conductance: Value = 0.0
        for mechanism in self.mechanisms:
            if mechanism.conductance is not None:
                conductance = conductance + mechanism.conductance(p, u)
        quantities: dict[str, Value] = {"air_conductance": conductance}
        for mechanism in self.mechanisms:
            if mechanism.quantities is not None:
                quantities.update(mechanism.quantities(p, x, u, conductance))
        return quantities

    @cached_property
    def _noise_reads_inputs(self) -> tuple[bool, ...]:
        """For every mechanism, whether its diffusion takes the inputs as a second argument."""
        reads_inputs = []
        for m in self.mechanisms:
            arguments = {} if m.diffusion is None else inspect.signature(m.diffusion).parameters
            count = sum(argument.default is argument.empty for argument in arguments.values())
            if count > 2:
                raise ValueError(
                    f'diffusion of the mechanism "{m.name}": expected a function of p or (p, u), found one '
                    f"of {', '.join(arguments)}{_NoiseInputs._hint}"
                )
            reads_inputs.append(count == 2)
        return tuple(reads_inputs)

    def noise(self, p: Values, u: Values | None = None) -> Matrix:
        """White noise intensity Q (n, n) [unit²/h] of the states, at measured inputs u."""
        return self._covariance(self.noise_spreads(p, u))

    def noise_spreads(self, p: Values, u: Values | None = None) -> Iterator[tuple[str, Spread]]:
        """Yield pairs (state, spread): the terms that the mechanisms add to `noise`."""
        for m, reads_u in zip(self.mechanisms, self._noise_reads_inputs, strict=True):
            if m.diffusion is not None:
                spaces = (_Parameters(**p), _NoiseInputs(**(u or {})))
                yield from self._check_states(m, "diffusion", m.diffusion(*spaces[: 1 + reads_u])).items()

    def _covariance(self, spreads: Iterable[tuple[str, Spread]]) -> Matrix:
        """The covariance (n, n) of states with these spreads.  Raises VarianceFault below 0."""
        result: Matrix = [[0.0] * len(self.states) for _ in self.states]
        sources: dict[str, dict[int, Value]] = {}
        for state, spread in spreads:
            i = self.states.index(state)
            if isinstance(spread, Mapping):
                for name, loading in spread.items():
                    row = sources.setdefault(name, {})
                    row[i] = row.get(i, 0.0) + loading
            # a complex step of a root at 0 has a square below 0
            elif not (isinstance(spread, Expression) or np.iscomplexobj(spread)) and (
                spread < 0.0 if isinstance(spread, float) else np.any(np.asarray(spread) < 0.0)
            ):
                raise VarianceFault(
                    "expected variances and noise intensities of at least 0, found "
                    f"{np.min(np.real(spread)):g} for the state {state}; square a standard deviation, "
                    "or bound its parameters below by 0"
                )
            else:
                result[i][i] = result[i][i] + spread
        for row in sources.values():
            for i, a in row.items():
                for j, b in row.items():
                    result[i][j] = result[i][j] + a * b
        return result

    def initial(self, p: Values, u: Values) -> tuple[list[Value], list[Value]]:
        """Mean and variance (n,) of the states at an instant with inputs u, before any reading."""
        mean, covariance = self.initial_moments(p, u)
        return mean, [row[i] for i, row in enumerate(covariance)]

    def initial_moments(self, p: Values, u: Values) -> tuple[list[Value], Matrix]:
        """Mean (n,) and covariance (n, n) of the states at an instant with inputs u, before any reading.

        The moments of a state that is carried in its Lamperti coordinate are transformed to first order.
        """
        means: dict[str, Value] = {f"mean_{name}": 0.0 for name in self.averaged}
        spreads: list[tuple[str, Spread]] = []
        spaces = _Parameters(**p), _Inputs(**u)
        for m in self.mechanisms:
            if m.initial is None:
                continue
            initials = self._check_states(m, "initial", m.initial(*spaces), means)
            for name, pair in initials.items():
                mean, spread = _pair(f'initial of the state "{name}"', pair)
                if name in self.exponents:
                    exponent = self.exponents[name]
                    mean = _coordinate(mean, exponent)
                    scale, _ = _noise_scale(mean, exponent)
                    loaded = isinstance(spread, Mapping)
                    spread = {k: v / scale for k, v in spread.items()} if loaded else spread / (scale * scale)
                means[name] = mean
                spreads.append((name, spread))
        missing = [n for n in self.states if n not in means]
        if missing:
            raise ValueError(f"no initial mean and variance for the states {missing}")
        return [means[n] for n in self.states], self._covariance(spreads)

    def natural(self, mean: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Transform means (..., n) and covariances (..., n, n) from Lamperti coordinates to states' units;
        means become medians, covariances are transformed to first order."""
        if not self.exponents:
            return mean, covariance
        natural_mean, scale = mean.copy(), np.ones_like(mean)
        for name, exponent in self.exponents.items():
            i = self.states.index(name)
            natural_mean[..., i] = _natural(mean[..., i], exponent)
            scale[..., i] = _noise_scale(mean[..., i], exponent)[0]
        if covariance.size:
            covariance = covariance * scale[..., :, None] * scale[..., None, :]
        return natural_mean, covariance


def _unique_names(kind: str, names: Iterable[str]) -> tuple[str, ...]:
    """The names as a tuple; raises ValueError where two mechanisms use the same name."""
    names = tuple(names)
    if duplicates := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"two mechanisms have {kind} of the same name: {duplicates}")
    return names


def _pair(source: str, value: object) -> tuple[Any, Any]:
    if isinstance(value, Sequence) and len(value) == 2:
        return value[0], value[1]
    raise ValueError(f"{source}: expected a pair (mean, variance), found {value!r}")


def _coordinate(x: Value, exponent: float) -> Value:
    """The Lamperti coordinate z of a state."""
    if not isinstance(x, Expression) and not np.all(np.real(x) > 0.0):
        raise ValueError(
            "initial: expected a mean above 0 of a state whose noise grows with it, found "
            f"{np.min(np.real(x))}"
        )
    return log(x) if exponent == 1.0 else x ** (1.0 - exponent) * (1.0 / (1.0 - exponent))


def _natural(z: Value, exponent: float) -> Value:
    """The state at its Lamperti coordinate z."""
    return exp(z) if exponent == 1.0 else ((1.0 - exponent) * z) ** (1.0 / (1.0 - exponent))


def _noise_scale(z: Value, exponent: float) -> tuple[Value, Value]:
    """x^γ at the coordinate z, and its derivative γ x^(γ−1) with respect to the state."""
    if exponent == 1.0:
        return exp(z), 1.0
    inner = (1.0 - exponent) * z
    return inner ** (exponent / (1.0 - exponent)), exponent / inner


class _ReadSums(Space):
    """The sums of a model as a mechanism reads them; records the names that were read."""

    def __init__(self, sums: Values, read: set[str]) -> None:
        super().__init__()
        self._sums = sums
        self._read = read

    def __getattr__(self, name: str) -> Value:
        self._read.add(name)
        if name in self._sums:
            return self._sums[name]
        raise UnknownName(
            f'a mechanism reads the sum "{name}", to which no mechanism adds'
            f"{suggestion(name, self._sums, 1)} (the sums of this model: {', '.join(self._sums)})"
        )


@dataclass(frozen=True)
class Equations:
    """Values of a model's equations: shared quantities, sums, rates (n,) [unit/h], outputs (prediction,
    variance)."""

    quantities: dict[str, Value]
    sums: dict[str, Value]
    rates: list[Value]
    outputs: dict[str, Pair]


def compose(
    mechanisms: Mechanism | Iterable[Mechanism],
    holds: Mapping[str, str] | None = None,
    averaged: Mapping[str, float] | None = None,
) -> Model:
    """Compose a model from mechanisms.

    mechanisms: one or several, in any order; each brings its parameters, states, inputs and contributions.
    holds: input → how it continues between its values at two instants: "previous" ("zoh", held from an
        instant on), "mean" (constant over the step that ends at an instant) or "linear" ("foh").
    averaged: output → interval [h] over which its readings are means.

    Returns the model.  Raises ValueError for an argument that is not a mechanism, an unknown hold or output
    and, at first use, two states of one name, a sum that no mechanism reads, and an input without a hold.
    """
    given_mechanisms = mechanisms if isinstance(mechanisms, Iterable) else (mechanisms,)
    model = Model(tuple(given_mechanisms), dict(holds or {}), dict(averaged or {}))
    faults = unknown_names("averaged", model.averaged, model.outputs)
    faults += [
        f"averaged: expected an interval above 0 h for {name}, found {interval}"
        for name, interval in model.averaged.items()
        if not 0.0 < interval < math.inf
    ]
    if faults:
        raise ValueError("; ".join(faults))
    return model


def extend(model: Model, mechanism: Mechanism, holds: Mapping[str, str] | None = None) -> Model:
    """Add a mechanism to a model.

    model: from `compose`, or from a fit (`fit.design.model`).
    mechanism: its state names must be new to the model; model units are h, K, g/m³ and 1.
    holds: how the mechanism's own inputs continue between two instants, as in `compose`.

    Returns the larger model; at the mechanism's null values it equals the original one, so that a likelihood
    ratio compares them.  Raises ValueError at first use, as `compose` does.
    """
    return replace(model, mechanisms=(*model.mechanisms, mechanism), holds={**model.holds, **(holds or {})})
