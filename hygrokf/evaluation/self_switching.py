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
"""[h] part at the end of a longer step in which it decides; a cabinet with a memory of hours has forgotten
earlier switching."""


def switches_of(design: Design) -> dict[str, Throttle]:
    """The switches of a design by input, as far as the model predicts the reading that they follow."""
    return {
        name: switch
        for name, settings in design.features.items()
        if name in CONTROLLED and (switch := Throttle(**settings)).reads in design.model.outputs
    }


def cut(hours: float) -> tuple[np.ndarray, np.ndarray]:
    """Lengths [h] of the pieces of a step in which switches decide, and the shares of the step at which they
    end.

    In a step longer than `DECIDED_H` the first piece is everything before the last `DECIDED_H`.
    """
    parts = max(math.ceil(min(hours, DECIDED_H) / DECIDE_H - 1e-9), 1)
    if hours <= DECIDED_H:
        return np.full(parts, hours / parts), np.arange(1, parts + 1) / parts
    shares = 1.0 - DECIDED_H / hours * (1.0 - np.arange(parts + 1) / parts)
    return np.append(hours - DECIDED_H, np.full(parts, DECIDED_H / parts)), shares


@dataclass
class Switchboard:
    """Switches of N simulations of one model: `flags` input → (N,), or one number, 1 where it is on.

    `values` of the parameters, numbers or (N,) each.
    """

    model: Model
    values: Mapping[str, np.ndarray | float]
    switches: Mapping[str, Throttle]
    flags: dict[str, Value]

    def decide(
        self, mean: np.ndarray, inputs: Mapping[str, np.ndarray | float], idle: np.ndarray | bool
    ) -> None:
        """Evaluate the logger readings at states (N, n) under inputs, and switch accordingly."""
        # for a single simulation use plain numbers: numpy takes three times as long for arrays of one
        columns = mean[0].tolist() if len(mean) == 1 else list(mean.T)
        made = self.model.evaluate(columns, {**inputs, **self.flags}, self.values)
        for name, switch in self.switches.items():
            if (
                switch.reads in self.model.averaged
            ):  # the running mean grows by the reading divided by the interval
                place = self.model.states.index(f"mean_{switch.reads}")
                reading = made.rates[place] * self.model.averaged[switch.reads]
            else:
                reading = made.outputs[switch.reads][0]
            self.flags[name] = switch.at(reading, idle)


def self_switched(
    design: Design, values: Mapping[str, float], runs: Sequence[Run], starts: Sequence[Gaussian] | None = None
) -> list[Run]:
    """Runs whose switches follow their own simulation instead of readings; unchanged where the model has no
    switch.

    `starts` are the states that the runs begin from, by default the model's own.
    """
    switches = switches_of(design)
    if not switches:
        return list(runs)
    model = design.model
    controls = {
        Control(name, one.reads, model.averaged.get(one.reads, 0.0), one.idle): one.levels
        for name, one in switches.items()
    }
    made = []
    begun: Sequence[Gaussian | None] = starts or [None] * len(runs)
    for run, start in zip(runs, begun, strict=True):
        t, pieces = run.timeline, _pieces(model, run)
        first = start or Likelihood(model, t).first_gaussian(values)
        found = Likelihood(model, pieces.timeline, initial=first).controlled(values, controls, pieces.idle)
        shares = {control.input: pieces.over(found[:, i]) for i, control in enumerate(controls)}
        made.append(replace(run, timeline=t.with_inputs(shares)))
    return made


@dataclass(frozen=True)
class _Pieces:
    """A run cut into S sub-steps: `timeline`, `owner` (the instant that each leads to, of `count`) and `idle`
    (S,)."""

    timeline: Timeline
    hours: np.ndarray
    owner: np.ndarray
    idle: np.ndarray
    count: int

    def over(self, position: np.ndarray) -> np.ndarray:
        """The mean (T,) of a position (S,) over each step."""
        total = np.bincount(self.owner, self.hours, self.count)
        on = np.bincount(self.owner, self.hours * position, self.count)
        at = np.zeros(self.count)
        at[self.owner] = position  # for steps that take no time
        return np.divide(on, total, out=at, where=total > 0.0)


def _pieces(model: Model, one: Run) -> _Pieces:
    t = one.timeline
    kinds = [cut(length) for length in t.steps[:, 0].tolist()]
    count = np.array([len(hours) for hours, _ in kinds])
    owner = np.repeat(np.arange(len(t)), count[t.key])
    kind = t.key[owner]
    inner = np.arange(len(owner)) - np.repeat(np.cumsum(count[t.key]) - count[t.key], count[t.key])
    begin = np.cumsum(count) - count
    hours, share = (np.concatenate([one[i] for one in kinds])[begin[kind] + inner] for i in (0, 1))
    before, now = t.u[:-1][owner], t.u[1:][owner]
    u = now.copy()
    for c, name in enumerate(t.varying):
        u[:, c] = between(model.holds[name], before[:, c], now[:, c], share)
    steps, key = np.unique(np.column_stack([hours, t.steps[kind, 1:]]), axis=0, return_inverse=True)
    made = replace(
        t,
        time=np.interp(np.arange(len(owner)) + 1.0, np.cumsum(count[t.key]), t.time),
        key=key.reshape(-1).astype(t.key.dtype),
        steps=np.ascontiguousarray(steps),
        u=np.ascontiguousarray(np.vstack([t.u[:1], u])),
        y=np.full((len(owner), t.y.shape[1]), np.nan),
        reset=np.zeros(len(owner), dtype=t.reset.dtype),
    )
    return _Pieces(made, hours, owner, ~one.operating[owner], len(t))
