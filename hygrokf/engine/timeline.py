"""The instants of a filter run: times of events, inputs and readings.

A `Timeline` holds arrays on one merged axis of instants.  The axis is not a regular grid: every reading and
every change of an input keeps its own time, and between two instants each input follows its own hold.

Shapes: T instants, m inputs that vary within steps, r regime inputs, k outputs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hygrokf.physics.holds import REGIME
from hygrokf.physics.model import Model


@dataclass(frozen=True)
class Timeline:
    """Instants of one run.

    `time` (T,) [h] from `origin_s` [s since 1970, UTC]; `key` (T,) the row of `steps` (distinct steps: length
    [h] and regime inputs) that leads to each instant; `u` (T+1, m) inputs, whose first row belongs to the
    instant before the first one: a linear input has its value at the instant, one that holds from its stamp
    on (previous) its value from there on, and a mean its value over the step that ends there; `y` (T, k)
    readings, NaN where there is none; `reset` (T,) bits of the running means that restart at the instant;
    `whole` inputs of the whole run, which a piece of the run keeps; `ends` (T,) True at the first step with
    known inputs after a gap of them (`engine.gaps`), empty without gaps.
    """

    time: np.ndarray
    key: np.ndarray
    steps: np.ndarray
    u: np.ndarray
    y: np.ndarray
    reset: np.ndarray
    varying: tuple[str, ...]
    regimes: tuple[str, ...]
    outputs: tuple[str, ...]
    origin_s: float = 0.0
    whole: Mapping[str, np.ndarray] = field(default_factory=dict)
    ends: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=bool))

    def __len__(self) -> int:
        return len(self.time)

    @cached_property
    def corners(self) -> dict[str, np.ndarray]:
        """All inputs at the instants of the whole run where one of them is largest or smallest, and at two
        dozen instants in between.

        The sub-steps follow from these, so that a piece of the run takes the same ones as the whole.
        """
        count = len(next(iter(self.whole.values()), ()))
        rows = set(np.linspace(0, count - 1, 24).astype(int).tolist())
        for values in self.whole.values():
            rows |= {int(np.argmin(values)), int(np.argmax(values))}
        chosen = np.array(sorted(rows))
        return {name: values[chosen] for name, values in self.whole.items()}

    @property
    def seconds(self) -> np.ndarray:
        """The instants (T,) [s since 1970, UTC]."""
        return self.origin_s + 3600.0 * self.time

    @property
    def n_readings(self) -> int:
        return int(np.isfinite(self.y).sum())

    def input(self, name: str) -> np.ndarray:
        """Values (T,) of one input as the filter sees them."""
        if name in self.regimes:
            return self.steps[self.key, 1 + self.regimes.index(name)]
        return self.u[1:, self.varying.index(name)]

    def reading(self, name: str) -> np.ndarray:
        """Readings (T,) of one output, NaN where there is none."""
        return self.y[:, self.outputs.index(name)]

    def with_readings(self, y: np.ndarray) -> Timeline:
        """The same run with other readings (T, k); with NaN everywhere it is a forecast."""
        if y.shape != self.y.shape:
            raise ValueError(f"expected readings of shape {self.y.shape}, found {y.shape}")
        return replace(self, y=np.ascontiguousarray(y, dtype=float))

    def with_inputs(self, inputs: Mapping[str, np.ndarray]) -> Timeline:
        """The same run with other values (T,) of inputs that vary within steps; `whole` covers the corners of
        the old values and the new ones."""
        u = self.u.copy()
        for name, value in inputs.items():
            u[1:, self.varying.index(name)] = value
        changed = replace(self, u=u)
        whole = {n: np.append(value, changed.input(n)) for n, value in self.corners.items()}
        return replace(changed, whole=whole)

    def window(self, first: int, last: int) -> Timeline:
        """Instants first … last−1, including the step to the first one, which starts from an earlier
        state."""
        part = slice(first, last)
        used, key = np.unique(self.key[part], return_inverse=True)
        return replace(
            self,
            time=self.time[part],
            steps=self.steps[used],
            key=key.astype(self.key.dtype),
            u=np.ascontiguousarray(self.u[first : last + 1]),
            y=np.ascontiguousarray(self.y[part]),
            reset=np.ascontiguousarray(self.reset[part]),
            ends=self.ends[part],
        )


def timeline(
    model: Model,
    time: np.ndarray,
    inputs: Mapping[str, np.ndarray],
    readings: Mapping[str, np.ndarray],
    resets: Mapping[str, np.ndarray] | None = None,
    origin_s: float = 0.0,
    ends: np.ndarray | None = None,
) -> Timeline:
    """Timeline of a model.

    `time` (T,) [h], strictly increasing; `inputs[name]` (T,) and `readings[name]` (T,) as in `Timeline` (an
    output without readings may be omitted); `resets[name]` (T,) bool for outputs that are read as interval
    means; `ends` (T,) as in `Timeline`.

    Raises ValueError that lists every input that is missing or not finite.
    """
    time = np.asarray(time, dtype=float)
    count = len(time)
    faults = []
    if count == 0 or not np.isfinite(time).all() or not (time[1:] > time[:-1]).all():
        faults.append("time must hold at least one instant and increase strictly")
    for name in model.inputs:
        if name not in inputs:
            faults.append(f"the input {name!r} of the model is missing; given are {sorted(inputs)}")
        elif np.shape(inputs[name]) != (count,):
            faults.append(f"{name}: expected {count} values, found shape {np.shape(inputs[name])}")
        elif not np.isfinite(inputs[name]).all():
            bad = int(np.flatnonzero(~np.isfinite(inputs[name]))[0])
            faults.append(f"{name}: not finite at instant {bad}; inputs must be known everywhere")
    for name in readings:
        if name not in model.outputs:
            faults.append(f"readings for {name!r}, but the model's outputs are {list(model.outputs)}")
        elif np.shape(readings[name]) != (count,):
            faults.append(f"{name}: expected {count} readings, found shape {np.shape(readings[name])}")
    if faults:
        raise ValueError("the run cannot be set up: " + "; ".join(faults))
    varying = tuple(n for n in model.inputs if model.holds[n] != REGIME)
    regimes = tuple(n for n in model.inputs if model.holds[n] == REGIME)
    # a microsecond is below the resolution of any clock: equal steps must not differ by rounding of their end
    # points
    lengths = np.zeros(count)
    lengths[1:] = np.round((time[1:] - time[:-1]) * 3.6e9) / 3.6e9
    steps, key = _distinct(_columns([lengths, *(inputs[n] for n in regimes)], count))
    flags = np.zeros(count, dtype=np.int32)
    for bit, name in enumerate(model.averaged):
        flags |= (np.asarray((resets or {}).get(name, np.zeros(count, bool)), bool) << bit).astype(np.int32)
    u = _columns([inputs[n] for n in varying], count)
    return Timeline(
        whole={n: np.asarray(inputs[n], float) for n in model.inputs},
        time=time,
        key=key,
        steps=steps,
        u=np.concatenate([u[:1], u]),
        y=_columns([readings.get(n, math.nan) for n in model.outputs], count),
        reset=flags,
        varying=varying,
        regimes=regimes,
        outputs=model.outputs,
        origin_s=origin_s,
        ends=np.empty(0, dtype=bool) if ends is None else ends,
    )


def _distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct rows in order, and the index of each row among them: numpy's `unique` in a third of its
    time."""
    order = np.lexsort(rows.T[::-1])
    placed = rows[order]
    begins = np.append(True, (placed[1:] != placed[:-1]).any(axis=1))
    key = np.empty(len(rows), dtype=np.int32)
    key[order] = np.cumsum(begins) - 1
    return np.ascontiguousarray(placed[begins]), key


def _columns(columns: Sequence[np.ndarray | float], count: int) -> np.ndarray:
    """Columns (T,), or single numbers, side by side (T, n)."""
    found = np.empty((count, len(columns)))
    for place, column in enumerate(columns):
        found[:, place] = column
    return found
