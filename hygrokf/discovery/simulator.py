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
    """Number of simulations so far, and traced models shared by all simulators of a search.

    Tracing a model takes as long as ten runs, so models are kept.
    """

    simulations: int = 0
    models: dict[tuple[object, ...], tuple[CellModel, tuple[Model, ...]]] = field(default_factory=dict)


@dataclass(frozen=True)
class Simulator:
    """Simulator of the heat and vapour models on a scene.

    own: inputs of which each run has its own values.  limits: further bounds of parameters, by name.
    """

    scene: Scene
    heat: Design
    vapour: Design | None
    own: tuple[str, ...] = ()
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    work: SimulationWork = field(default_factory=SimulationWork, compare=False)
    _cells: dict[tuple[str, ...], CellInputs] = field(default_factory=dict, compare=False, repr=False)

    @property
    def designs(self) -> tuple[Design, ...]:
        """Design of heat and, if there is one, of vapour."""
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

    def _limited(self, parameter: Parameter) -> Parameter:
        """Return a parameter with narrower bounds: those of `limits`, and `ACCURACY` standard deviations of
        its prior."""
        lowest, highest = self.limits.get(parameter.name, (parameter.lower, parameter.upper))
        if parameter.prior is not None and not parameter.prior.logarithmic:
            # a likelihood would stretch an offset beyond its accuracy to stand for something else
            largest_deviation = ACCURACY * parameter.prior.sd
            lowest, highest = (
                max(lowest, parameter.prior.mean - largest_deviation),
                min(highest, parameter.prior.mean + largest_deviation),
            )
        if (lowest, highest) == (parameter.lower, parameter.upper):
            return parameter
        return replace(
            parameter, lower=lowest, upper=highest, start=min(max(parameter.start, lowest), highest)
        )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters, in order."""
        return tuple(p.name for p in self.parameters)

    @cached_property
    def controls(self) -> tuple[str, ...]:
        """Inputs that are switched by a controller."""
        inputs = {name for design in self.designs for name in design.model.inputs}
        return tuple(name for name in CONTROLLED if name in inputs)

    def _switch(self, name: str) -> Throttle:
        """Return the controller of an input."""
        return Throttle(**next(design.features[name] for design in self.designs if name in design.features))

    def _levels(self, name: str) -> tuple[Parameter, Parameter]:
        """Return the two parameters of a controller: the reading at which it begins to act, and that at which
        it acts fully."""
        switch = self._switch(name)
        is_temperature = switch.reads == CABINET_TEMPERATURE
        lowest, highest, unit = (200.0, 400.0, "K") if is_temperature else (-0.5, 1.5, "1")
        first, second = (
            Parameter(
                f"{name}_{suffix}",
                unit,
                level,
                lowest,
                highest,
                meaning=f"reading at which the controller {action}",
            )
            for suffix, level, action in (
                ("first", switch.start, "begins to act"), ("second", switch.full, "acts fully"),
            )
        )  # fmt: skip
        return first, second

    def _steering(self, name: str) -> tuple[float, float]:
        """Return whether a controller reads the humidity, and whether it acts at standstill only, each as 1.0
        or 0.0."""
        switch = self._switch(name)
        return float(switch.reads == CABINET_RELATIVE_HUMIDITY), float(switch.idle)

    def affects(self, name: str) -> tuple[str, ...]:
        """Return the quantities that a parameter acts on."""
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
        """Return the sources of a quantity's inputs and readings; each source has its own clock."""
        inputs = self.cell_model(quantity).inputs
        return {self.scene.source(name) for name in (CABINET_TEMPERATURE, *inputs)}

    # -- runs ------------------------------------------------------------------------------------------------
    def cell_model(self, quantity: str) -> CellModel:
        """Return the compiled model that a quantity needs; models are traced once and kept."""
        reads_humidity = any(self._steering(c)[0] for c in self.controls)
        models = tuple(design.model for design in self.designs)
        key = (quantity, reads_humidity, self.own, *map(id, models))
        if key not in self.work.models:
            # the key holds identities of models; the entry keeps the models alive, so that none is reused
            self.work.models[key] = self._cell_model(quantity, reads_humidity), models
        return self.work.models[key][0]

    def _cell_model(self, quantity: str, damp: bool) -> CellModel:
        """Trace the model for a quantity; damp: whether a controller reads the humidity."""
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
        """Return the inputs of a model over the cells; they are computed once and kept."""
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
        """Simulate parameters theta (P, n) and return the output (K, n) of a quantity's sensor at the ends of
        the cells.

        columns: own input → its means (K,) over the cells for each run.
        driven: whether the scene's temperature drives the vapour; otherwise the simulated temperature does.
        """
        model = self.cell_model(quantity if driven else "both")
        cells, count = self.cells(model), theta.shape[1]
        row_of = {name: i for i, name in enumerate(self.names)}
        result = np.empty((len(cells), count))
        output = next(i for i, name in enumerate(model.outputs) if name in OUTPUT[quantity])
        self.work.simulations += count
        for first_run in range(0, count, LANES):
            block_of_runs = theta[:, first_run : first_run + LANES]
            width = block_of_runs.shape[1]
            lanes = np.zeros((len(model.parameters), LANES))
            for i, name in enumerate(model.parameters):
                if name in row_of:
                    lanes[i, :width], lanes[i, width:] = (
                        block_of_runs[row_of[name]],
                        block_of_runs[row_of[name], -1],
                    )
            for name in model.controls:
                for suffix, value in zip(CONTROL[2:], self._steering(name), strict=True):
                    lanes[model.parameters.index(f"{name}_{suffix}")] = value
            is_simulated = quantity == "temperature" or not driven
            lanes[model.parameters.index(SIMULATED_TEMPERATURE)] = float(is_simulated)
            own_columns = [_lanes(columns or {}, name, first_run) for name in model.own]
            outputs = run(model, cells, lanes, self._start(model, cells, lanes), own_columns)
            result[:, first_run : first_run + width] = outputs[:, output, :width]
        return result

    def simulated(
        self,
        theta: np.ndarray,
        quantity: str,
        columns: Mapping[str, Sequence[np.ndarray]] | None = None,
    ) -> np.ndarray:
        """Return the simulated readings (T, n) [K] or [g/m³] for parameters theta (P, n); `columns` as in
        `shown`."""
        return self.scene.readings[quantity].sampled(self.shown(theta, quantity, columns))

    def _start(self, model: CellModel, cells: CellInputs, theta: np.ndarray) -> np.ndarray:
        """Return the states (n, LANES) at the start of the simulation."""
        inputs: dict[str, Any] = {name: cells.edges[0, c] for c, name in enumerate(model.inputs)}
        inputs |= dict.fromkeys((*model.own, *model.controls), 0.0)
        values: dict[str, Any] = {name: theta[i] for i, name in enumerate(model.parameters)}
        values |= {p.name: 0.0 for part_model in model.models for p in part_model.parameters if p.noise}
        states = [state for part_model in model.models for state in part_model.initial(values, inputs)[0]]
        return np.stack([np.broadcast_to(np.asarray(state, float), LANES) for state in states])

    def vector(self, values: Mapping[str, float]) -> np.ndarray:
        """Return the parameter vector (P,) of values by name.

        A parameter without a value gets its null value, or else its start value.
        """
        return np.array([values.get(p.name, p.start if p.null is None else p.null) for p in self.parameters])

    def owner(self, name: str) -> Design:
        """Return the design that has an input; the design of heat if none has it."""
        return next((design for design in self.designs if name in design.model.inputs), self.heat)

    def column(self, name: str, settings: Mapping[str, Any]) -> np.ndarray:
        """Return the means (K,) over the cells of an own input, computed with the given feature settings."""
        owner = self.owner(name)
        design = replace(owner, features={**owner.features, name: settings})
        return self.scene.column(name, design)


def _lanes(columns: Mapping[str, Sequence[np.ndarray]], name: str, first_run: int) -> np.ndarray:
    """Return the columns (K, LANES) of an own input for one block of runs; zeros (1, LANES) if it has
    none."""
    columns_of_block = list(columns.get(name, ()))[first_run : first_run + LANES]
    if not columns_of_block:
        return np.zeros((1, LANES))
    return np.ascontiguousarray(
        np.stack([*columns_of_block, *[columns_of_block[-1]] * (LANES - len(columns_of_block))], axis=1)
    )


def _silent(design: Design) -> Model:
    """Return the design's model without mechanisms that only add noise."""
    with_effect = [
        mechanism
        for mechanism in design.model.mechanisms
        if not mechanism.parameters
        or mechanism.outputs
        or mechanism.corrections
        or not all(p.noise for p in mechanism.parameters)
    ]
    return compose(with_effect, design.model.holds)
