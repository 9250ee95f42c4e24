"""Simulations of a model on a scene, many at a time: the readings that each set of parameters gives.

The temperature follows from the model of heat alone, the vapour from the model of vapour on the temperature
that drives the scene; a controller connects both.  `SimulationWork` counts runs.

Shapes: T readings of a quantity, P parameters, n runs, F edges of parts of cells.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from hygrokf.discovery.scene import Scene
from hygrokf.engine.cell_loop import CONTROL, SIMULATED, CellInputs, CellModel, run
from hygrokf.engine.llvm_writer import LANES
from hygrokf.modelling.design import Design
from hygrokf.physics.model import Model, compose
from hygrokf.physics.parameters import Parameter
from hygrokf.physics.switches import CONTROLLED, HUMIDITY, TEMPERATURE, Throttle

OUTPUT = {
    "temperature": ("cabinet_temperature",),
    "vapour": ("cabinet_relative_humidity", "cabinet_absolute_humidity"),
}


ACCURACY = 2.0
"""Standard deviations of a prior within which an offset stays."""


@dataclass
class SimulationWork:
    """Simulations so far, and the cell models that all simulators of a search share: tracing one takes as
    long as ten runs."""

    simulations: int = 0
    models: dict[tuple[object, ...], tuple[CellModel, tuple[Model, ...]]] = field(default_factory=dict)


@dataclass(frozen=True)
class Simulator:
    """Models of heat and of vapour on a scene; own: inputs of which each run has a column of its own."""

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
        known = {
            p.name: self._limited(p) for one in self.designs for p in one.model.parameters if not p.noise
        }
        return (*known.values(), *(p for name in self.controls for p in self._levels(name)))

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
        inputs = {name for one in self.designs for name in one.model.inputs}
        return tuple(name for name in CONTROLLED if name in inputs)

    def _switch(self, name: str) -> Throttle:
        return Throttle(**next(one.features[name] for one in self.designs if name in one.features))

    def _levels(self, name: str) -> tuple[Parameter, Parameter]:
        switch = self._switch(name)
        warm = switch.reads == TEMPERATURE
        low, high, unit = (200.0, 400.0, "K") if warm else (-0.5, 1.5, "1")
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
        """Whether a controller follows the humidity, and acts at standstill only."""
        switch = self._switch(name)
        return float(switch.reads == HUMIDITY), float(switch.idle)

    def affects(self, name: str) -> tuple[str, ...]:
        """The quantities that a parameter acts on."""
        by = {
            "temperature": [p.name for p in self.heat.model.parameters],
            "vapour": [] if self.vapour is None else [p.name for p in self.vapour.model.parameters],
        }
        found = [quantity for quantity, names in by.items() if name in names]
        if not found:
            control = name.rpartition("_")[0]
            found = [q for q, one in zip(by, self.designs, strict=False) if control in one.model.inputs]
        return tuple(found)

    def clocks(self, quantity: str) -> set[str]:
        """The sources whose clocks a quantity's inputs and its readings have."""
        inputs = self.cell_model(quantity).inputs
        return {self.scene.source(name) for name in (TEMPERATURE, *inputs)}

    # -- runs ------------------------------------------------------------------------------------------------
    def cell_model(self, quantity: str) -> CellModel:
        """The models that a quantity needs."""
        damp = any(self._steering(c)[0] for c in self.controls)
        models = tuple(one.model for one in self.designs)
        key = (quantity, damp, self.own, *map(id, models))
        if key not in self.work.models:
            # the entry keeps the models, so that their identities stay their own
            self.work.models[key] = self._cell_model(quantity, damp), models
        return self.work.models[key][0]

    def _cell_model(self, quantity: str, damp: bool) -> CellModel:
        heat, vapour = _silent(self.heat), None if self.vapour is None else _silent(self.vapour)
        steered = {c for c in self.controls if c in (vapour.inputs if vapour else ())}
        if quantity == "temperature" and not damp:
            vapour = None
        made = CellModel(heat, vapour) if quantity != "vapour" or steered else CellModel(None, vapour)
        inputs = {name for one in made.models for name in one.inputs}
        return replace(
            made,
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
        """(K, n) of what the sensor of a quantity shows at the ends of cells, for parameters (P, n).

        columns: own input → its (K,) means over the cells for each run.  driven: whether vapour runs on the
        scene's temperature; else on the simulated one.
        """
        model = self.cell_model(quantity if driven else "both")
        cells, count = self.cells(model), theta.shape[1]
        place = {name: i for i, name in enumerate(self.names)}
        result = np.empty((len(cells), count))
        output = next(i for i, name in enumerate(model.outputs) if name in OUTPUT[quantity])
        self.work.simulations += count
        for first in range(0, count, LANES):
            part = theta[:, first : first + LANES]
            width = part.shape[1]
            full = np.zeros((len(model.parameters), LANES))
            for i, name in enumerate(model.parameters):
                if name in place:
                    full[i, :width], full[i, width:] = part[place[name]], part[place[name], -1]
            for name in model.controls:
                for word, value in zip(CONTROL[2:], self._steering(name), strict=True):
                    full[model.parameters.index(f"{name}_{word}")] = value
            free = quantity == "temperature" or not driven
            full[model.parameters.index(SIMULATED)] = float(free)
            own = [_lanes(columns or {}, name, first) for name in model.own]
            out = run(model, cells, full, self._start(model, cells, full), own)
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
        values |= {p.name: 0.0 for one in model.models for p in one.parameters if p.noise}
        begun = [x for one in model.models for x in one.initial(values, inputs)[0]]
        return np.stack([np.broadcast_to(np.asarray(x, float), LANES) for x in begun])

    def vector(self, values: Mapping[str, float]) -> np.ndarray:
        """(P,) of values by name; a parameter without one has no effect, or its start."""
        return np.array([values.get(p.name, p.start if p.null is None else p.null) for p in self.parameters])

    def owner(self, name: str) -> Design:
        """The design whose input this is."""
        return next((one for one in self.designs if name in one.model.inputs), self.heat)

    def column(self, name: str, settings: Mapping[str, Any]) -> np.ndarray:
        """(K,) means over the cells of an own input under some settings of its feature."""
        owner = self.owner(name)
        made = replace(owner, features={**owner.features, name: settings})
        return self.scene.column(name, made)


def _lanes(columns: Mapping[str, Sequence[np.ndarray]], name: str, first: int) -> np.ndarray:
    """Own columns of a block of runs (K, LANES); zeros (1, LANES) where none is given."""
    part = list(columns.get(name, ()))[first : first + LANES]
    if not part:
        return np.zeros((1, LANES))
    return np.ascontiguousarray(np.stack([*part, *[part[-1]] * (LANES - len(part))], axis=1))


def _silent(design: Design) -> Model:
    """The model without what only disturbs it, read at instants."""
    kept = [
        m for m in design.model.mechanisms
        if not m.parameters or m.outputs or m.corrections or not all(p.noise for p in m.parameters)
    ]  # fmt: skip
    return compose(kept, design.model.holds)
