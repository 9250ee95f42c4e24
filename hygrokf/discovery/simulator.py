"""Simulations of a model on a scene, many at a time: the readings for each set of parameters.

The temperature follows from the model of heat alone.  The vapour follows from the model of vapour, driven by
the temperature of the scene.  A controller connects both models.  `SimulationWork` counts runs.

Shapes: T readings of a quantity, P parameters, n runs, F edges of parts of cells.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from hygrokf.discovery.scene import Scene
from hygrokf.engine.cell_loop import CONTROL, SIMULATED_TEMPERATURE, CellInputs, CellModel, run
from hygrokf.engine.llvm_writer import LANES
from hygrokf.modelling.design import Design
from hygrokf.physics.model import Model, compose
from hygrokf.physics.parameters import Parameter
from hygrokf.physics.signal_names import CABINET_RELATIVE_HUMIDITY, CABINET_TEMPERATURE
from hygrokf.physics.switches import CONTROLLED, Throttle

OUTPUT = {
    "temperature": ("cabinet_temperature",),
    "vapour": ("cabinet_relative_humidity", "cabinet_absolute_humidity"),
}


ACCURACY = 2.0
"""Largest deviation of an offset from the mean of its prior, in standard deviations of the prior."""


@dataclass
class SimulationWork:
    """The number of simulations so far, and the cell models that all simulators of a search share, since
    tracing a model takes as long as ten runs."""

    simulations: int = 0
    models: dict[tuple[object, ...], tuple[CellModel, tuple[Model, ...]]] = field(default_factory=dict)


@dataclass(frozen=True)
class Simulator:
    """Models of heat and of vapour on a scene; own: inputs for which each run has a separate column."""

    scene: Scene
    heat: Design
    vapour: Design | None
    own: tuple[str, ...] = ()
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    work: SimulationWork = field(default_factory=SimulationWork, compare=False)
    _cells: dict[tuple[str, ...], CellInputs] = field(default_factory=dict, compare=False, repr=False)

    @property
    def designs(self) -> tuple[Design, ...]:
        return (self.heat,) if self.vapour is None else (self.heat, self.vapour)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters that a run depends on, the levels of controllers included."""
        parameter_of = {
            p.name: self._limited(p)
            for design in self.designs
            for p in design.model.parameters
            if not p.noise
        }
        return (*parameter_of.values(), *(p for name in self.controls for p in self._levels(name)))

    def _limited(self, p: Parameter) -> Parameter:
        low, high = self.limits.get(p.name, (p.lower, p.upper))
        if p.prior is not None and not p.prior.logarithmic:
            # a likelihood would stretch an offset beyond its accuracy to stand for something else
            reach = ACCURACY * p.prior.sd
            low, high = max(low, p.prior.mean - reach), min(high, p.prior.mean + reach)
        if (low, high) == (p.lower, p.upper):
            return p
        return replace(p, lower=low, upper=high, start=min(max(p.start, low), high))

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @cached_property
    def controls(self) -> tuple[str, ...]:
        inputs = {name for design in self.designs for name in design.model.inputs}
        return tuple(name for name in CONTROLLED if name in inputs)

    def _switch(self, name: str) -> Throttle:
        return Throttle(**next(design.features[name] for design in self.designs if name in design.features))

    def _levels(self, name: str) -> tuple[Parameter, Parameter]:
        switch = self._switch(name)
        is_temperature = switch.reads == CABINET_TEMPERATURE
        low, high, unit = (200.0, 400.0, "K") if is_temperature else (-0.5, 1.5, "1")
        first, second = (
            Parameter(
                f"{name}_{word}", unit, level, low, high, meaning=f"reading at which the controller {does}"
            )
            for word, level, does in (
                ("first", switch.start, "begins to act"), ("second", switch.full, "acts fully"),
            )
        )  # fmt: skip
        return first, second

    def _steering(self, name: str) -> tuple[float, float]:
        """Whether (1.0 or 0.0) a controller reads the humidity, and whether it acts at standstill only."""
        switch = self._switch(name)
        return float(switch.reads == CABINET_RELATIVE_HUMIDITY), float(switch.idle)

    def affects(self, name: str) -> tuple[str, ...]:
        """The quantities that a parameter acts on."""
        parameters_of = {
            "temperature": [p.name for p in self.heat.model.parameters],
            "vapour": [] if self.vapour is None else [p.name for p in self.vapour.model.parameters],
        }
        quantities = [quantity for quantity, names in parameters_of.items() if name in names]
        if not quantities:
            control = name.rpartition("_")[0]
            quantities = [
                q
                for q, design in zip(parameters_of, self.designs, strict=False)
                if control in design.model.inputs
            ]
        return tuple(quantities)

    def clocks(self, quantity: str) -> set[str]:
        """The sources of a quantity's inputs and readings; each source has its own clock."""
        inputs = self.cell_model(quantity).inputs
        return {self.scene.source(name) for name in (CABINET_TEMPERATURE, *inputs)}

    # -- runs ------------------------------------------------------------------------------------------------
    def cell_model(self, quantity: str) -> CellModel:
        """The traced cell models that a quantity needs."""
        reads_humidity = any(self._steering(c)[0] for c in self.controls)
        models = tuple(design.model for design in self.designs)
        key = (quantity, reads_humidity, self.own, *map(id, models))
        if key not in self.work.models:
            # the key holds identities of models; the entry keeps the models alive, so that none is reused
            self.work.models[key] = self._cell_model(quantity, reads_humidity), models
        return self.work.models[key][0]

    def _cell_model(self, quantity: str, damp: bool) -> CellModel:
        heat, vapour = _silent(self.heat), None if self.vapour is None else _silent(self.vapour)
        steered = {c for c in self.controls if c in (vapour.inputs if vapour else ())}
        if quantity == "temperature" and not damp:
            vapour = None
        model = CellModel(heat, vapour) if quantity != "vapour" or steered else CellModel(None, vapour)
        inputs = {name for part_model in model.models for name in part_model.inputs}
        return replace(
            model,
            controls=tuple(name for name in self.controls if name in inputs),
            own=tuple(name for name in self.own if name in inputs),
        )

    def cells(self, model: CellModel) -> CellInputs:
        if model.inputs not in self._cells:
            self._cells[model.inputs] = self.scene.cells(model.inputs, self.designs)
        return self._cells[model.inputs]

    def shown(
        self,
        theta: np.ndarray,
        quantity: str,
        columns: Mapping[str, Sequence[np.ndarray]] | None = None,
        driven: bool = True,
    ) -> np.ndarray:
        """(K, n) output of a quantity's sensor at the ends of cells, for parameters (P, n).

        columns: own input → its (K,) means over the cells for each run.  driven: whether the temperature of
        the scene drives the vapour; else the simulated temperature does.
        """
        model = self.cell_model(quantity if driven else "both")
        cells, count = self.cells(model), theta.shape[1]
        row_of = {name: i for i, name in enumerate(self.names)}
        result = np.empty((len(cells), count))
        output = next(i for i, name in enumerate(model.outputs) if name in OUTPUT[quantity])
        self.work.simulations += count
        for first in range(0, count, LANES):
            block = theta[:, first : first + LANES]
            width = block.shape[1]
            lanes = np.zeros((len(model.parameters), LANES))
            for i, name in enumerate(model.parameters):
                if name in row_of:
                    lanes[i, :width], lanes[i, width:] = block[row_of[name]], block[row_of[name], -1]
            for name in model.controls:
                for word, value in zip(CONTROL[2:], self._steering(name), strict=True):
                    lanes[model.parameters.index(f"{name}_{word}")] = value
            is_simulated = quantity == "temperature" or not driven
            lanes[model.parameters.index(SIMULATED_TEMPERATURE)] = float(is_simulated)
            own_columns = [_lanes(columns or {}, name, first) for name in model.own]
            out = run(model, cells, lanes, self._start(model, cells, lanes), own_columns)
            result[:, first : first + width] = out[:, output, :width]
        return result

    def simulated(
        self,
        theta: np.ndarray,
        quantity: str,
        columns: Mapping[str, Sequence[np.ndarray]] | None = None,
    ) -> np.ndarray:
        """(T, n) readings of a quantity [K] or [g/m³]."""
        return self.scene.readings[quantity].sampled(self.shown(theta, quantity, columns))

    def _start(self, model: CellModel, cells: CellInputs, theta: np.ndarray) -> np.ndarray:
        """States (n, LANES) at the beginning."""
        inputs: dict[str, Any] = {name: cells.edges[0, c] for c, name in enumerate(model.inputs)}
        inputs |= dict.fromkeys((*model.own, *model.controls), 0.0)
        values: dict[str, Any] = {name: theta[i] for i, name in enumerate(model.parameters)}
        values |= {p.name: 0.0 for part_model in model.models for p in part_model.parameters if p.noise}
        states = [x for part_model in model.models for x in part_model.initial(values, inputs)[0]]
        return np.stack([np.broadcast_to(np.asarray(x, float), LANES) for x in states])

    def vector(self, values: Mapping[str, float]) -> np.ndarray:
        """The parameter vector (P,) of values by name; a parameter without a value has its null, or else its
        start value."""
        return np.array([values.get(p.name, p.start if p.null is None else p.null) for p in self.parameters])

    def owner(self, name: str) -> Design:
        """The design that has this input; the design of heat if none has."""
        return next((design for design in self.designs if name in design.model.inputs), self.heat)

    def column(self, name: str, settings: Mapping[str, Any]) -> np.ndarray:
        """(K,) means over the cells of an own input, computed with these settings of its feature."""
        owner = self.owner(name)
        design = replace(owner, features={**owner.features, name: settings})
        return self.scene.column(name, design)


def _lanes(columns: Mapping[str, Sequence[np.ndarray]], name: str, first: int) -> np.ndarray:
    """Columns (K, LANES) of an own input for the runs from `first` on; zeros (1, LANES) without columns."""
    part = list(columns.get(name, ()))[first : first + LANES]
    if not part:
        return np.zeros((1, LANES))
    return np.ascontiguousarray(np.stack([*part, *[part[-1]] * (LANES - len(part))], axis=1))


def _silent(design: Design) -> Model:
    """The model without mechanisms that have nothing but noise parameters."""
    kept = [
        m for m in design.model.mechanisms
        if not m.parameters or m.outputs or m.corrections or not all(p.noise for p in m.parameters)
    ]  # fmt: skip
    return compose(kept, design.model.holds)
