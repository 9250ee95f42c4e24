"""The compiled simulation of a cabinet over cells of equal length, eight runs side by side.

A run is a model of heat and a model of vapour, driven by inputs alone.  Within a cell every input has its
mean f̄ and rises in a straight line from its value at the beginning to that at the end; the readings at the
end of a cell are evaluated with the inputs' values at the end.  Each state follows its own linearised
equation,

    x ← x + h φ₁(z) f + h (φ₂(z) − φ₁(z)/2) (f_end − f_begin),    z = h ∂f/∂x,
    φ₁(z) = (e^z − 1)/z,    φ₂(z) = (φ₁(z) − 1)/z,

which is exact for a constant rate.  The equations of the other states use the state's values before and after
the cell, and the mean of both; states that come earlier in the order use a prediction from the first rate.
The vapour's model runs on the cabinet's temperature: the temperature of the heat model where
`SIMULATED_TEMPERATURE` is 1, the input `cabinet_temperature` where it is 0.  Controllers follow the readings
that the run itself gives at the start of each cell.

The loop is emitted from the traced expressions of the mechanisms; no equation is written here.

`TracedCell` makes expressions, nothing is computed there.  `cell_text`, `exponential` and `logarithm` emit
code: strings in them are registers and slots of the text (`llvm_writer`).  `run` computes.

Shapes: K cells, m inputs, w inputs of which every run has its own, P parameters, LANES runs, k outputs.

Exponential and logarithm of whole vectors stand in place of one library call for each lane.  Both are
polynomials after the usual reduction to [1/√2, √2] and ±ln 2/2; their errors stay below three units in the
last place.  They use the same operations on every processor with fused multiply-add.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hygrokf.engine.jit import CompiledCode
from hygrokf.engine.llvm_writer import LANES, SCALAR, Writer, declarations, literal, vector
from hygrokf.physics.expression import Expression, Graph, Value, exp, jacobian, where
from hygrokf.physics.model import Model
from hygrokf.physics.signal_names import CABINET_RELATIVE_HUMIDITY, CABINET_TEMPERATURE
from hygrokf.physics.switches import position

_MAGIC = 6755399441055744.0
"""1.5 · 2⁵²: adding it rounds to an integer, which the lowest bits then hold."""
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10
"""ln 2 as a sum: products of the first term with small integers are exact."""
_TERMS = 13
"""Degree of the exponential's Taylor polynomial in the remainder after the rounded multiple of ln 2."""
_LOG_TERMS = 10
"""Degree of the logarithm's polynomial in f², f = (m − 1)/(m + 1) for the mantissa m."""
_SMALLEST = -708.0
_LARGEST = 709.0
"""Limits of the exponential's argument: e^x is a normal number between them."""


# -- exponential and logarithm of whole vectors --------------------------------------------------------------
class _Function(Writer):
    """Text of a function of one vector, which the compiler copies into its callers.

    Methods emit one operation on vectors and return the register of its result; `all` and `whole` return
    literal vectors with the same number in all lanes.
    """

    def __init__(self, name: str, lanes: int) -> None:
        super().__init__(name, [], lanes)
        self.integers = vector(lanes, "i64")

    def all(self, number: float) -> str:
        return self.splat_of("double", literal(number))

    def whole(self, number: int) -> str:
        return self.splat_of("i64", str(number))

    def splat_of(self, kind: str, number: str) -> str:
        return "<" + ", ".join([f"{kind} {number}"] * self.lanes) + ">"

    def real(self, operation: str, a: str, b: str) -> str:
        return self.value(f"{operation} {self.vector} {a}, {b}")

    def integer(self, operation: str, a: str | int, b: str | int) -> str:
        return self.value(f"{operation} {self.integers} {a}, {b}")

    def fused(self, a: str, b: str, c: str) -> str:
        return self.fma(self.vector, (a, b, c))

    def select(self, test: str, yes: str, no: str) -> str:
        return self.value(f"select {self.truths} {test}, {self.vector} {yes}, {self.vector} {no}")

    def compare(self, word: str, a: str, b: str) -> str:
        return self.value(f"fcmp {word} {self.vector} {a}, {b}")

    def bits(self, a: str) -> str:
        """The bits of doubles as integers."""
        return self.value(f"bitcast {self.vector} {a} to {self.integers}")

    def number(self, a: str) -> str:
        """The doubles with these bits."""
        return self.value(f"bitcast {self.integers} {a} to {self.vector}")

    def done(self, result: str) -> str:
        """The text of the function, which returns the register `result`."""
        head = f"define internal {self.vector} @{self._name}({self.vector} %x) alwaysinline {{"
        return "\n".join([head, *self._lines, f"  ret {self.vector} {result}", "}"]) + "\n"


def exponential(lanes: int) -> str:
    """LLVM text of `@exponential`: e^x of a vector; arguments are limited to −708 … 709."""
    t = _Function("exponential", lanes)
    low = t.select(t.compare("olt", "%x", t.all(_SMALLEST)), t.all(_SMALLEST), "%x")
    x = t.select(t.compare("ogt", low, t.all(_LARGEST)), t.all(_LARGEST), low)
    shifted = t.fused(x, t.all(1.0 / math.log(2.0)), t.all(_MAGIC))
    n = t.real("fsub", shifted, t.all(_MAGIC))
    r = t.fused(n, t.all(-_LN2_LOW), t.fused(n, t.all(-_LN2_HIGH), x))
    total = t.all(1.0 / math.factorial(_TERMS))
    for k in range(_TERMS - 1, -1, -1):
        total = t.fused(total, r, t.all(1.0 / math.factorial(k)))
    raised = t.integer("add", t.bits(total), t.integer("shl", t.bits(shifted), t.whole(52)))
    return t.done(t.select(t.compare("ord", "%x", "%x"), t.number(raised), "%x"))


def logarithm(lanes: int) -> str:
    """LLVM text of `@logarithm`: ln x of a vector of normal numbers and ∞; NaN where x is not positive."""
    t = _Function("logarithm", lanes)
    bits = t.bits("%x")
    exponent = t.integer("sub", t.integer("lshr", bits, t.whole(52)), t.whole(1023))
    fraction = t.integer("and", bits, t.whole(0x000FFFFFFFFFFFFF))
    mantissa = t.number(t.integer("or", fraction, t.whole(0x3FF0000000000000)))
    large = t.compare("ogt", mantissa, t.all(math.sqrt(2.0)))
    m = t.select(large, t.real("fmul", mantissa, t.all(0.5)), mantissa)
    n = t.value(f"sitofp {t.integers} {exponent} to {t.vector}")
    n = t.select(large, t.real("fadd", n, t.all(1.0)), n)
    f = t.real("fdiv", t.real("fsub", m, t.all(1.0)), t.real("fadd", m, t.all(1.0)))
    s = t.real("fmul", f, f)
    total = t.all(2.0 / (2 * _LOG_TERMS + 1))
    for k in range(_LOG_TERMS - 1, -1, -1):
        total = t.fused(total, s, t.all(2.0 / (2 * k + 1)))
    result = t.fused(n, t.all(_LN2_HIGH), t.fused(n, t.all(_LN2_LOW), t.real("fmul", total, f)))
    result = t.select(t.compare("olt", "%x", t.all(math.inf)), result, "%x")
    return t.done(t.select(t.compare("ogt", "%x", t.all(0.0)), result, t.all(math.nan)))


SIMULATED_TEMPERATURE = "simulated_temperature"
"""Parameter of every run: 1 where the vapour model uses the simulated temperature, 0 the measured one."""
CONTROL = ("first", "second", "humidity", "idle")
"""Parameters of a controller: its two levels [K] or [1]; 1 where it follows the humidity; 1 where it acts at
standstill only."""
IDLE = "standstill"


# -- the simulation ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class CellModel:
    """A model of heat and one of vapour; `controls`: inputs that controllers set; `own`: inputs with separate
    values for every run."""

    heat: Model | None
    vapour: Model | None
    controls: tuple[str, ...] = ()
    own: tuple[str, ...] = ()

    @property
    def models(self) -> tuple[Model, ...]:
        return tuple(model for model in (self.heat, self.vapour) if model is not None)

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        names = [p.name for model in self.models for p in model.parameters if not p.noise]
        steered = [f"{control}_{word}" for control in self.controls for word in CONTROL]
        return tuple(dict.fromkeys([*names, *steered, SIMULATED_TEMPERATURE]))

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Inputs that all runs share."""
        names = dict.fromkeys(
            [*(name for model in self.models for name in model.inputs), CABINET_TEMPERATURE, IDLE]
        )
        return tuple(name for name in names if name not in (*self.controls, *self.own))

    @cached_property
    def states(self) -> tuple[str, ...]:
        return tuple(name for model in self.models for name in model.states)

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(name for model in self.models for name in model.outputs)

    @cached_property
    def traced(self) -> TracedCell:
        return TracedCell(self)

    @cached_property
    def code(self) -> CompiledCode:
        return CompiledCode(cell_text(self.traced), ["cells"])


class TracedCell:
    """One cell as expressions of its symbols, by name.

    `mean`, `begin`, `end`: of the shared inputs over the cell and at its ends; `own`: of the inputs that
    every run has for itself; `before`: positions of the controllers in the cell before; `states`: at the
    beginning. `positions`: of the controllers in the cell; `after`: states at its end; `readings`: there.
    """

    def __init__(self, model: CellModel) -> None:
        self.model = model
        g = self.graph = Graph()
        self.hours = g.symbol("hours")
        self.parameters = {name: g.symbol(f"p:{name}") for name in model.parameters}
        self.mean = {name: g.symbol(f"m:{name}") for name in model.inputs}
        self.begin = {name: g.symbol(f"b:{name}") for name in model.inputs}
        self.end = {name: g.symbol(f"e:{name}") for name in model.inputs}
        self.own = {name: g.symbol(f"o:{name}") for name in model.own}
        self.before = {name: g.symbol(f"before:{name}") for name in model.controls}
        self.states = {name: g.symbol(f"x:{name}") for name in model.states}
        noise = {p.name: 0.0 for one in model.models for p in one.parameters if p.noise}
        self.values: dict[str, Value] = {**noise, **self.parameters}
        self.positions = self._positions()
        steered = {**self.own, **self.positions}
        state = dict(self.states)
        mean, begin, end = ({**one, **steered} for one in (self.mean, self.begin, self.end))
        middle = {} if model.heat is None else self._stage(model.heat, state, mean, begin, end)
        if model.vapour is not None:
            warm = [
                {**inputs, CABINET_TEMPERATURE: self._air(at, inputs)}
                for at, inputs in ((middle, mean), (self.states, begin), (state, end))
            ]
            self._stage(model.vapour, state, *warm)
        self.after = [state[name] for name in model.states]
        shown = self._shown(state, end)
        self.readings = [g.lift(shown[name]) for name in model.outputs]

    def _positions(self) -> dict[str, Expression]:
        """Expressions of the controllers' positions in the cell."""
        # an open vent cools the air that the controller reads
        readings = self._shown(self.states, {**self.begin, **self.own, **self.before}) if self.before else {}
        positions = {}
        for name in self.model.controls:
            first, second, humid, idle = (self.parameters[f"{name}_{word}"] for word in CONTROL)
            temperature = readings[CABINET_TEMPERATURE]
            value = temperature + humid * (readings.get(CABINET_RELATIVE_HUMIDITY, temperature) - temperature)
            allowed = 1.0 - idle * (1.0 - self.mean[IDLE])
            positions[name] = allowed * position(value, first, second)
        return positions

    def _stage(
        self,
        model: Model,
        state: dict[str, Expression],
        mean: Mapping[str, Value],
        begin: Mapping[str, Value],
        end: Mapping[str, Value],
    ) -> dict[str, Value]:
        """Trace the states of a model at the end of the cell, one after the other, into `state`; returns the
        expressions of their means over the cell.

        mean, begin, end: inputs of the model over the cell and at its ends.
        """

        def rates(at: Mapping[str, Value], inputs: Mapping[str, Value]) -> list[Expression]:
            equations = model.traced([at[name] for name in model.states], inputs, self.values)
            return [self.graph.lift(rate) for rate in equations.rates]

        is_amount = dict(zip(model.states, model.amounts, strict=True))
        means: dict[str, Value] = {}

        def move(name: str, step: Expression) -> None:
            after = self.states[name] + step
            state[name] = where(after < 0.0, 0.0, after) if is_amount[name] else after
            means[name] = 0.5 * (self.states[name] + state[name])

        # predict every state from its rate at the beginning, with a rational approximation of φ₁
        first = rates(self.states, begin)
        for name, rate in zip(model.states, first, strict=True):
            z = self._stretch(rate, name)
            move(name, self.hours * rate / (1.0 - z * (0.5 - z * (1.0 / 12.0))))
        for index, name in enumerate(model.states):
            state[name] = means[name] = self.states[name]
            rate, last = rates(means, mean)[index], rates(state, end)[index]
            phi_1, phi_2_term = _phi(self._stretch(rate, name))
            move(name, self.hours * (rate * phi_1 + (last - first[index]) * phi_2_term))
        return means

    def _stretch(self, rate: Expression, name: str) -> Value:
        """Expression of z of a state: the cell's length times the derivative of the rate by the state."""
        ((slope,),) = jacobian([rate], [self.states[name]])
        return self.hours * slope

    def _air(self, heat: Mapping[str, Value], inputs: Mapping[str, Value]) -> Value:
        """Expression of the cabinet temperature that the vapour model uses."""
        model = self.model.heat
        if model is None:
            return inputs[CABINET_TEMPERATURE]
        air = model.quantities([heat[name] for name in model.states], inputs, self.values)
        given = inputs[CABINET_TEMPERATURE]
        return given + self.values[SIMULATED_TEMPERATURE] * (air["cabinet_air_temperature"] - given)

    def _shown(self, state: Mapping[str, Value], inputs: Mapping[str, Value]) -> dict[str, Value]:
        """Expressions of the readings at a state under inputs."""
        temperature_input = {CABINET_TEMPERATURE: self._air(state, inputs)}
        readings: dict[str, Value] = {}
        for model in self.model.models:
            given = inputs if model is self.model.heat else {**inputs, **temperature_input}
            outputs = model.evaluate([state[name] for name in model.states], given, self.values).outputs
            readings |= {name: value for name, (value, _) in outputs.items()}
        return readings


def _phi(z: Value) -> tuple[Value, Value]:
    """Expressions of φ₁ and φ₂ − φ₁/2; near z = 0 by their Taylor series."""
    if not isinstance(z, Expression):
        return 1.0, 0.0
    small = z * z < 1e-4
    safe = where(small, 1.0, z)
    series = 1.0 + z * (1.0 / 2.0 + z * (1.0 / 6.0 + z * (1.0 / 24.0 + z * (1.0 / 120.0))))
    phi_1 = where(small, series, (exp(z) - 1.0) / safe)
    series = z * (-1.0 / 12.0 - z * (1.0 / 24.0 + z * (1.0 / 80.0 + z * (1.0 / 360.0))))
    return phi_1, where(small, series, (phi_1 - 1.0) / safe - 0.5 * phi_1)


CELL_ARGUMENTS = ("hours", "means", "edges", "strides", "theta", "given", "start", "out")


def cell_text(t: TracedCell) -> str:
    """LLVM text of `cells(count, hours, means, edges, strides, theta, given, start, out, own…)`.

    hours: (1,); means (K, m) and edges (K+1, m) of the inputs, in their order; strides: (w,) LANES for an
    input of which every cell has values, 0 for a constant one; theta: (P, LANES); given: constants of the
    models; start: (n, LANES); out: (K, k, LANES); own: (K, LANES) or (1, LANES) each.
    """
    model, g = t.model, t.graph
    own_names = [f"own{i}" for i in range(len(model.own))]
    functions = {"exp": "exponential", "log": "logarithm"}
    arguments = [("i64", "count"), *(("ptr", name) for name in (*CELL_ARGUMENTS, *own_names))]
    w = Writer("cells", arguments, LANES, functions)
    fixed = {t.hours.index: w.load(SCALAR, "%hours")}
    fixed |= {
        symbol.index: w.load(w.vector, w.at(w.vector, "%theta", i))
        for i, symbol in enumerate(t.parameters.values())
    }
    fixed |= {
        g.symbol(f"c:{i}").index: w.load(SCALAR, w.at(SCALAR, "%given", i)) for i in range(len(g.given))
    }
    strides = [w.load("i64", w.at("i64", "%strides", i)) for i in range(len(model.own))]
    slots = {
        symbol.index: w.slot(w.vector, w.load(w.vector, w.at(w.vector, "%start", i)))
        for i, symbol in enumerate(t.states.values())
    }
    slots |= {symbol.index: w.slot(w.vector, "zeroinitializer") for symbol in t.before.values()}
    vectors = [symbol.index for symbol in (*t.parameters.values(), *t.own.values())] + list(slots)
    width, shown = len(model.inputs), len(model.outputs)
    with w.loop("%count") as k:
        row = w.integer("mul", k, width)
        after = w.integer("add", row, width)
        leaves = fixed | {i: w.load(w.vector, slot) for i, slot in slots.items()}
        for array, first, symbols in (
            ("means", row, t.mean), ("edges", row, t.begin), ("edges", after, t.end),
        ):  # fmt: skip
            leaves |= {
                symbol.index: w.load(SCALAR, w.at(SCALAR, f"%{array}", w.integer("add", first, c)))
                for c, symbol in enumerate(symbols.values())
            }
        for name, stride, symbol in zip(own_names, strides, t.own.values(), strict=True):
            leaves[symbol.index] = w.load(w.vector, w.at(SCALAR, f"%{name}", w.integer("mul", k, stride)))
        outputs = [*t.readings, *t.after, *(g.lift(symbol) for symbol in t.positions.values())]
        values = [w.as_vector(kind, name) for kind, name in w.block(g, outputs, leaves, vectors)]
        start = w.integer("mul", k, shown)
        for c, value in enumerate(values[:shown]):
            w.store(w.vector, value, w.at(w.vector, "%out", w.integer("add", start, c)))
        for slot, value in zip(slots.values(), values[shown:], strict=True):
            w.store(w.vector, value, slot)
    return declarations() + exponential(LANES) + logarithm(LANES) + w.text()


@dataclass(frozen=True)
class CellInputs:
    """Inputs over cells of `hours` [h]: means (K, m), values at the edges (K+1, m), and own inputs, (K,
    LANES) or (1, LANES) each."""

    hours: float
    means: np.ndarray
    edges: np.ndarray

    def __len__(self) -> int:
        return len(self.means)


def run(
    model: CellModel, cells: CellInputs, theta: np.ndarray, start: np.ndarray, own: Sequence[np.ndarray]
) -> np.ndarray:
    """Readings (K, k, LANES) at the end of each cell, of runs with parameters (P, LANES) from states (n,
    LANES)."""
    out = np.empty((len(cells), len(model.outputs), LANES))
    code = model.code
    strides = np.array([LANES if len(values) > 1 else 0 for values in own] or [0], dtype=np.int64)
    given = np.array([float(number) for number in model.traced.graph.given] or [0.0])
    code(
        "cells", len(cells), np.array([cells.hours]), cells.means, cells.edges, strides,
        np.ascontiguousarray(theta), given, np.ascontiguousarray(start), out, *own,
    )  # fmt: skip
    return out
