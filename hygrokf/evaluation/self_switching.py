"""Simulations that drive their own switches: a heater or a fan follows the reading that a simulated logger
would show.

A filter derives a switch's state from the readings, because the controller saw them.  A simulation must not
use readings: they would reveal the quantity to be simulated.  The mean of the state is therefore stepped
through the run, the switch decides at every step, and the share of each step for which it was on replaces its
state by readings.

Shapes: T instants, N runs or members side by side, n states.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.engine.filter_loops import Control
from hygrokf.engine.timeline import Timeline
from hygrokf.estimation.likelihood import Gaussian, Likelihood
from hygrokf.modelling.design import Design
from hygrokf.modelling.inputs import Run
from hygrokf.physics.expression import Value
from hygrokf.physics.holds import between
from hygrokf.physics.model import Model
from hygrokf.physics.switches import CONTROLLED, Throttle

DECIDE_H = 1.0 / 12.0
"""[h] longest time between two decisions of a simulated switch."""
DECIDED_H = 720.0
"""[h] part at the end of a longer step in which a switch decides: a cabinet with time constants of hours does
not remember earlier switching."""


def switches_of(design: Design) -> dict[str, Throttle]:
    """Return the switches of a design, by input, whose controlling reading the model predicts."""
    return {
        name: switch
        for name, settings in design.features.items()
        if name in CONTROLLED and (switch := Throttle(**settings)).reads in design.model.outputs
    }


def cut(hours: float) -> tuple[np.ndarray, np.ndarray]:
    """Divide a step of `hours` into sub-steps at whose ends switches decide.

    Returns the lengths [h] of the sub-steps, and their ends as shares of the step.  In a step longer than
    `DECIDED_H` the first sub-step is everything before the last `DECIDED_H`.
    """
    sub_step_count = max(math.ceil(min(hours, DECIDED_H) / DECIDE_H - 1e-9), 1)
    if hours <= DECIDED_H:
        return np.full(sub_step_count, hours / sub_step_count), np.arange(
            1, sub_step_count + 1
        ) / sub_step_count
    shares = 1.0 - DECIDED_H / hours * (1.0 - np.arange(sub_step_count + 1) / sub_step_count)
    return np.append(hours - DECIDED_H, np.full(sub_step_count, DECIDED_H / sub_step_count)), shares


@dataclass
class Switchboard:
    """The switches of N simulations of one model, and whether they are on.

    `values`: of the parameters, numbers or (N,) each.  `flags`: input → 1 for on, else 0, a number or (N,).
    """

    model: Model
    values: Mapping[str, np.ndarray | float]
    switches: Mapping[str, Throttle]
    flags: dict[str, Value]

    def decide(
        self, mean: np.ndarray, inputs: Mapping[str, np.ndarray | float], idle: np.ndarray | bool
    ) -> None:
        """Switch on and off according to the logger readings at states (N, n) and inputs.

        idle: whether the turbine stands still.
        """
        # for a single simulation use plain numbers: arrays of one element take three times as long
        columns = mean[0].tolist() if len(mean) == 1 else list(mean.T)
        evaluated = self.model.evaluate(columns, {**inputs, **self.flags}, self.values)
        for name, switch in self.switches.items():
            if switch.reads in self.model.averaged:
                # the running mean grows by the reading divided by the interval
                row = self.model.states.index(f"mean_{switch.reads}")
                reading = evaluated.rates[row] * self.model.averaged[switch.reads]
            else:
                reading = evaluated.outputs[switch.reads][0]
            self.flags[name] = switch.at(reading, idle)


def self_switched(
    design: Design, values: Mapping[str, float], runs: Sequence[Run], starts: Sequence[Gaussian] | None = None
) -> list[Run]:
    """Return the runs with switches that follow the simulation instead of the readings.

    starts: initial states of the runs; None: those of the model.  Without switches the runs are unchanged.
    """
    switches = switches_of(design)
    if not switches:
        return list(runs)
    model = design.model
    controls = {
        Control(name, switch.reads, model.averaged.get(switch.reads, 0.0), switch.idle): switch.levels
        for name, switch in switches.items()
    }
    switched = []
    initial_states: Sequence[Gaussian | None] = starts or [None] * len(runs)
    for run, start in zip(runs, initial_states, strict=True):
        timeline, pieces = run.timeline, _pieces(model, run)
        first_state = start or Likelihood(model, timeline).first_gaussian(values)
        positions = Likelihood(model, pieces.timeline, initial=first_state).controlled(
            values, controls, pieces.idle
        )
        shares = {control.input: pieces.over(positions[:, i]) for i, control in enumerate(controls)}
        switched.append(replace(run, timeline=timeline.with_inputs(shares)))
    return switched


@dataclass(frozen=True)
class _Pieces:
    """A run divided into S sub-steps.

    `hours`: (S,) lengths.  `owner`: (S,) step to which each belongs, of `count` steps.  `idle`: (S,) whether
        the turbine stands still.
    """

    timeline: Timeline
    hours: np.ndarray
    owner: np.ndarray
    idle: np.ndarray
    count: int

    def over(self, is_on: np.ndarray) -> np.ndarray:
        """Return the share (T,) of each step during which a switch is on.

        is_on: (S,) whether it is on in each sub-step.
        """
        total = np.bincount(self.owner, self.hours, self.count)
        time_on = np.bincount(self.owner, self.hours * is_on, self.count)
        share = np.zeros(self.count)
        share[self.owner] = is_on  # for steps that take no time
        return np.divide(time_on, total, out=share, where=total > 0.0)


def _pieces(model: Model, run: Run) -> _Pieces:
    """Divide a run into sub-steps at whose ends switches decide, with interpolated inputs."""
    timeline = run.timeline
    cuts_of_steps = [cut(length) for length in timeline.steps[:, 0].tolist()]
    pieces_of_step = np.array([len(hours) for hours, _ in cuts_of_steps])
    owner = np.repeat(np.arange(len(timeline)), pieces_of_step[timeline.key])
    step_of_piece = timeline.key[owner]
    index_in_step = np.arange(len(owner)) - np.repeat(
        np.cumsum(pieces_of_step[timeline.key]) - pieces_of_step[timeline.key], pieces_of_step[timeline.key]
    )
    first_of_step = np.cumsum(pieces_of_step) - pieces_of_step
    hours, shares = (
        np.concatenate([cut_of_step[i] for cut_of_step in cuts_of_steps])[
            first_of_step[step_of_piece] + index_in_step
        ]
        for i in (0, 1)
    )
    inputs_before, inputs_after = timeline.u[:-1][owner], timeline.u[1:][owner]
    inputs = inputs_after.copy()
    for column, name in enumerate(timeline.varying):
        inputs[:, column] = between(
            model.holds[name], inputs_before[:, column], inputs_after[:, column], shares
        )
    steps, key = np.unique(
        np.column_stack([hours, timeline.steps[step_of_piece, 1:]]), axis=0, return_inverse=True
    )
    cut_timeline = replace(
        timeline,
        time=np.interp(np.arange(len(owner)) + 1.0, np.cumsum(pieces_of_step[timeline.key]), timeline.time),
        key=key.reshape(-1).astype(timeline.key.dtype),
        steps=np.ascontiguousarray(steps),
        u=np.ascontiguousarray(np.vstack([timeline.u[:1], inputs])),
        y=np.full((len(owner), timeline.y.shape[1]), np.nan),
        reset=np.zeros(len(owner), dtype=timeline.reset.dtype),
    )
    return _Pieces(cut_timeline, hours, owner, ~run.operating[owner], len(timeline))
