"""Simulations that drive their own switches: a heater or a fan follows what the simulated logger would show.

A filter takes a switch's course from the readings, because they are what the controller saw.  A simulation must not: it
has no readings, and where a record has some it would be told by them what it is to foretell.  So the mean of the state
is stepped through the run, the switch decides at every step, and its course, as the share of each step that it was on,
takes the place of the one by readings.

Shapes: T instants, N runs or members side by side, n states.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.design import Design
from hygrokf.drivers import Run
from hygrokf.likelihood import Gaussian, Likelihood
from hygrokf.loops import LINEAR
from hygrokf.model import Model
from hygrokf.side_by_side import SideBySide
from hygrokf.switches import SWITCHES, Switch
from hygrokf.timeline import Timeline

DECIDE_H = 1.0 / 12.0
"""[h] after which a simulated switch looks at its reading again at the latest."""
DECIDED_H = 720.0
"""[h] at the end of a longer step in which it does: what it did months ago in a gap, a cabinet of hours has forgotten."""


def switches_of(design: Design) -> dict[str, Switch]:
    """A design's switches by their input, as far as its model predicts the reading that they follow."""
    return {
        name: switch
        for name, settings in design.features.items()
        if name in SWITCHES and (switch := SWITCHES[name](**settings)).reads in design.model.outputs
    }


def all_on(t: Timeline, switches: Mapping[str, Switch]) -> Timeline:
    """The run with its switches on throughout: its range, by which sub-steps are chosen, has them off and on."""
    return t.with_inputs({name: np.ones(len(t)) for name in switches})


def cut(hours: float) -> tuple[np.ndarray, np.ndarray]:
    """Lengths [h] of the pieces of a step in which switches decide, and the shares of it at which they end.

    Of a step longer than `DECIDED_H` the first piece is all but the last `DECIDED_H`.
    """
    parts = max(math.ceil(min(hours, DECIDED_H) / DECIDE_H - 1e-9), 1)
    if hours <= DECIDED_H:
        return np.full(parts, hours / parts), np.arange(1, parts + 1) / parts
    shares = 1.0 - DECIDED_H / hours * (1.0 - np.arange(parts + 1) / parts)
    return np.append(hours - DECIDED_H, np.full(parts, DECIDED_H / parts)), shares


@dataclass
class Switchboard:
    """Switches of N simulations of one model: `flags` input → (N,) 1 where it is on.

    `values` of the parameters, numbers or (N,) each.
    """

    model: Model
    values: Mapping[str, np.ndarray | float]
    switches: Mapping[str, Switch]
    flags: dict[str, np.ndarray]

    def decide(
        self, mean: np.ndarray, inputs: Mapping[str, np.ndarray | float], idle: np.ndarray | bool
    ) -> None:
        """Look at what the loggers would show at states (N, n) under inputs, and switch."""
        # of a single one in numbers: numpy takes three times as long for arrays of one
        columns = mean[0].tolist() if len(mean) == 1 else list(mean.T)
        made = self.model.evaluate(columns, inputs | self.flags, self.values)
        for name, switch in self.switches.items():
            if switch.reads in self.model.averaged:  # the running mean grows by the reading over its interval
                place = self.model.states.index(f"mean_{switch.reads}")
                reading = made.rates[place] * self.model.averaged[switch.reads]
            else:
                reading = made.outputs[switch.reads][0]
            self.flags[name] = switch.after(self.flags[name], reading, idle)


def self_switched(
    design: Design,
    values: Mapping[str, float],
    runs: Sequence[Run],
    starts: Sequence[Gaussian] | None = None,
) -> list[Run]:
    """Runs whose switches follow their own simulation instead of readings; as they are where the model has none.

    `starts` the state that each run begins from, else the model's own.  All runs step side by side.
    """
    switches = switches_of(design)
    if not switches or not runs:
        return list(runs)
    model = design.model
    lines = [one.timeline for one in runs]
    starts = starts or [Likelihood(model, t).first_gaussian(values) for t in lines]
    rates = [Likelihood(model, all_on(t, switches)).rate(values) for t in lines]
    begun = {name: [float(t.u[0, t.varying.index(name)] > 0.5) for t in lines] for name in switches}
    board = Switchboard(model, values, switches, dict(zip(begun, _rows(list(begun.values())), strict=True)))
    side = SideBySide(model, [values] * len(runs), starts, rates)
    pieces = [_pieces(model, one) for one in runs]
    longest = max(len(one.hours) for one in pieces)
    hours = _rows(_side_by_side([one.hours for one in pieces], longest, filled=False))
    idle = _rows(_side_by_side([one.idle for one in pieces], longest))
    inputs = {
        name: _rows(_side_by_side([one.inputs[name] for one in pieces], longest + 1)) for name in model.inputs
    }
    shares = {name: np.zeros((longest, len(runs))) for name in switches}
    now = {name: rows[0] for name, rows in inputs.items()}
    side.begin(now | board.flags)
    for row in range(longest):
        board.decide(side.mean, now, idle[row])
        now = {name: rows[row + 1] for name, rows in inputs.items()}
        side.step(hours[row], now | board.flags)
        for name, flag in board.flags.items():
            shares[name][row] = flag
    return [
        replace(one, timeline=one.timeline.with_inputs({n: piece.over(s[:, i]) for n, s in shares.items()}))
        for i, (one, piece) in enumerate(zip(runs, pieces, strict=True))
    ]


def _side_by_side(columns: Sequence[np.ndarray], count: int, filled: bool = True) -> np.ndarray:
    """Columns of different lengths as (count, N), `filled` up with their last value or with 0."""
    made = np.zeros((count, len(columns)), columns[0].dtype)
    for i, column in enumerate(columns):
        made[: len(column), i] = column
        if filled:
            made[len(column) :, i] = column[-1]
    return made


def _rows(values: np.ndarray | Sequence) -> list:
    """Rows of (T, N) for one step each; those of a single run as numbers."""
    values = np.asarray(values)
    return values[:, 0].tolist() if values.shape[1] == 1 else list(values)


@dataclass(frozen=True)
class _Pieces:
    """A run cut into sub-steps: `hours`, `owner` (the instant that each leads to) and `idle` (S,), `inputs` (S + 1,)."""

    hours: np.ndarray
    owner: np.ndarray
    idle: np.ndarray
    inputs: Mapping[str, np.ndarray]
    count: int

    def over(self, flag: np.ndarray) -> np.ndarray:
        """The share (T,) of each step in which a flag (S, or longer) was on."""
        flag = flag[: len(self.hours)]
        total = np.bincount(self.owner, self.hours, self.count)
        on = np.bincount(self.owner, self.hours * flag, self.count)
        at = np.zeros(self.count)
        at[self.owner] = flag  # of a step that takes no time
        return np.divide(on, total, out=at, where=total > 0.0)


def _pieces(model: Model, one: Run) -> _Pieces:
    t = one.timeline
    length = t.steps[t.key, 0]
    cuts = {h: cut(h) for h in np.unique(length).tolist()}
    owner = np.repeat(np.arange(len(t)), [len(cuts[h][0]) for h in length.tolist()])
    hours, share = (np.concatenate([cuts[h][i] for h in length.tolist()]) for i in (0, 1))
    inputs = {}
    for name in model.inputs:
        now = t.input(name)
        if model.holds[name] == LINEAR:
            before = t.u[:-1, t.varying.index(name)]
            within = before[owner] + share * (now - before)[owner]
            inputs[name] = np.append(before[:1], within)
        else:
            inputs[name] = np.append(now[:1], now[owner])
    return _Pieces(hours, owner, ~one.operating[owner], inputs, len(t))
