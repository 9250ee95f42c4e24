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
    """The switches of a design, by input, that follow a reading which the model predicts."""
    return {
        name: switch
        for name, settings in design.features.items()
        if name in CONTROLLED and (switch := Throttle(**settings)).reads in design.model.outputs
    }


def cut(hours: float) -> tuple[np.ndarray, np.ndarray]:
    """Lengths [h] of the sub-steps at whose ends switches decide, and their ends as shares of the step.

    In a step longer than `DECIDED_H` the first sub-step is everything before the last `DECIDED_H`.
    """
    parts = max(math.ceil(min(hours, DECIDED_H) / DECIDE_H - 1e-9), 1)
    if hours <= DECIDED_H:
        return np.full(parts, hours / parts), np.arange(1, parts + 1) / parts
    shares = 1.0 - DECIDED_H / hours * (1.0 - np.arange(parts + 1) / parts)
    return np.append(hours - DECIDED_H, np.full(parts, DECIDED_H / parts)), shares


@dataclass
class Switchboard:
    """Switches of N simulations of one model.

    `values` of the parameters, numbers or (N,) each.  `flags`: input → (N,) or a number, 1 for switched on.
    """

    model: Model
    values: Mapping[str, np.ndarray | float]
    switches: Mapping[str, Throttle]
    flags: dict[str, Value]

    def decide(
        self, mean: np.ndarray, inputs: Mapping[str, np.ndarray | float], idle: np.ndarray | bool
    ) -> None:
        """Evaluate the logger readings at states (N, n) under inputs, and switch accordingly."""
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
    """Runs whose switches follow a simulation instead of the readings; unchanged if the model has no switch.

    `starts`: initial states of the runs; by default that of the model.
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
        t, pieces = run.timeline, _pieces(model, run)
        first = start or Likelihood(model, t).first_gaussian(values)
        positions = Likelihood(model, pieces.timeline, initial=first).controlled(
            values, controls, pieces.idle
        )
        shares = {control.input: pieces.over(positions[:, i]) for i, control in enumerate(controls)}
        switched.append(replace(run, timeline=t.with_inputs(shares)))
    return switched


@dataclass(frozen=True)
class _Pieces:
    """A run cut into S sub-steps: their `timeline` and lengths `hours` (S,), the step to which each belongs
    (`owner`, of `count` steps), and whether the turbine is `idle` (S,)."""

    timeline: Timeline
    hours: np.ndarray
    owner: np.ndarray
    idle: np.ndarray
    count: int

    def over(self, is_on: np.ndarray) -> np.ndarray:
        """The share (T,) of each step during which a switch that is on in sub-steps (S,) is on."""
        total = np.bincount(self.owner, self.hours, self.count)
        time_on = np.bincount(self.owner, self.hours * is_on, self.count)
        share = np.zeros(self.count)
        share[self.owner] = is_on  # for steps that take no time
        return np.divide(time_on, total, out=share, where=total > 0.0)


def _pieces(model: Model, run: Run) -> _Pieces:
    t = run.timeline
    cuts = [cut(length) for length in t.steps[:, 0].tolist()]
    count = np.array([len(hours) for hours, _ in cuts])
    owner = np.repeat(np.arange(len(t)), count[t.key])
    kind = t.key[owner]
    inner = np.arange(len(owner)) - np.repeat(np.cumsum(count[t.key]) - count[t.key], count[t.key])
    begin = np.cumsum(count) - count
    hours, share = (np.concatenate([pair[i] for pair in cuts])[begin[kind] + inner] for i in (0, 1))
    before, after = t.u[:-1][owner], t.u[1:][owner]
    u = after.copy()
    for c, name in enumerate(t.varying):
        u[:, c] = between(model.holds[name], before[:, c], after[:, c], share)
    steps, key = np.unique(np.column_stack([hours, t.steps[kind, 1:]]), axis=0, return_inverse=True)
    timeline = replace(
        t,
        time=np.interp(np.arange(len(owner)) + 1.0, np.cumsum(count[t.key]), t.time),
        key=key.reshape(-1).astype(t.key.dtype),
        steps=np.ascontiguousarray(steps),
        u=np.ascontiguousarray(np.vstack([t.u[:1], u])),
        y=np.full((len(owner), t.y.shape[1]), np.nan),
        reset=np.zeros(len(owner), dtype=t.reset.dtype),
    )
    return _Pieces(timeline, hours, owner, ~run.operating[owner], len(t))
