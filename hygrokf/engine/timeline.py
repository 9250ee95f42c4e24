"""The instants of a filter run: times of events, inputs and readings.

A `Timeline` holds arrays on one merged axis of instants.  The axis is not a regular grid: every reading and
every change of an input keeps its own time, and between two instants each input follows its own hold.

Shapes: T instants, m inputs that vary within steps, r regime inputs, k outputs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.errors import suggestion, unknown_names
from hygrokf.physics.holds import REGIME
from hygrokf.physics.model import Model

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

UNITS_H = {"s": 1.0 / 3600.0, "min": 1.0 / 60.0, "h": 1.0, "d": 24.0, "a": 24.0 * 365.25}
"""[h] units in which times may be given."""


@dataclass(frozen=True)
class Timeline:
    """Instants of one run.

    `time` (T,) [h] from `origin_s` [s since 1970, UTC]; `key` (T,) the row of `steps` (distinct steps: length
    [h] and regime inputs) that leads to each instant; `u` (T+1, m) inputs, whose first row belongs to the
    instant before the first one: a linear input has its value at the instant, one that holds from its stamp
    on (previous) its value from there on, and a mean its value over the step that ends there; `y` (T, k)
    readings, NaN where there is none; `reset` (T,) bits of the running means that restart at the instant;
    `ends` (T,) True at the first step with known inputs after a gap in them (`engine.gaps`), empty without
    gaps; `part`: description of the part of a record, empty without one.
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
    ends: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=bool))
    part: str = ""

    def __repr__(self) -> str:
        """Span, instants and readings."""
        if self.origin_s:
            ends = np.round(self.seconds[[0, -1]]).astype("datetime64[s]")
            span = "Z … ".join(np.datetime_as_string(ends)) + "Z"
        else:
            span = f"{self.time[0]:.6g} … {self.time[-1]:.6g} h"
        read = np.isfinite(self.y).sum(axis=0)
        counts = ", ".join(f"{count} of {name}" for name, count in zip(self.outputs, read, strict=True))
        part = f", {self.part}" if self.part else ""
        return f"Timeline {span}, {len(self)} instants{part}\n  readings: {counts or 'none'}"

    def __len__(self) -> int:
        return len(self.time)

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
        return self.u[1:, _place("input", name, self.varying, self.regimes)]

    def reading(self, name: str) -> np.ndarray:
        """Readings (T,) of one output, NaN where there is none."""
        return self.y[:, _place("output", name, self.outputs)]

    def with_readings(self, y: np.ndarray) -> Timeline:
        """The same run with other readings (T, k); with NaN everywhere it is a forecast."""
        if y.shape != self.y.shape:
            raise ValueError(f"expected readings of shape {self.y.shape}, found {y.shape}")
        return replace(self, y=np.ascontiguousarray(y, dtype=float))

    def with_inputs(self, inputs: Mapping[str, np.ndarray]) -> Timeline:
        """The same run with other values (T,) of inputs that vary within steps."""
        u = self.u.copy()
        for name, value in inputs.items():
            u[1:, _place("inputs that vary within steps", name, self.varying)] = value
        return replace(self, u=u)

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
    time: ArrayLike,
    inputs: Mapping[str, ArrayLike],
    readings: Mapping[str, ArrayLike],
    resets: Mapping[str, ArrayLike] | None = None,
    origin_s: float = 0.0,
    ends: np.ndarray | None = None,
    unit: str = "h",
) -> Timeline:
    """Instants with the inputs and readings of a model.

    model: from `compose`, with m inputs and k outputs.
    time: (T,) numbers in `unit`, or dates (numpy's, pandas' or Python's; without a zone they count as UTC),
        which become hours since the first one.  They must not decrease: readings in several rows of one
        instant are processed in order, and a running mean restarts after the last of these rows.
    inputs: name → (T,), finite everywhere; they continue between instants as their hold says.
    readings: output → (T,), NaN or masked where there is none; an output without readings may be omitted.
    resets: output that is read as an interval mean → (T,) True where an interval ends.
    origin_s: [s since 1970, UTC] of time 0; not allowed with dates, which determine it.
    ends: [1] (T,) as in `Timeline`.
    unit: of `time`: "s", "min", "h", "d" or "a" (365.25 d).  The model's own unit of time stays the hour.

    Returns the timeline.  Raises ValueError that lists what is missing, misspelt, of another shape,
    infinite, or not in order.
    """
    faults: list[str] = []
    time, origin_s = _hours(time, unit, origin_s, faults)
    count, resets = len(time), resets or {}
    given = {name: _numbers(name, inputs[name], count, faults) for name in model.inputs if name in inputs}
    read = {name: _numbers(name, values, count, faults) for name, values in readings.items()}
    ended = {
        name: _numbers(f"resets of {name}", flags, count, faults) > 0.0 for name, flags in resets.items()
    }
    faults += _faults(model, given, read, [*inputs], [*ended])
    if ends is not None and np.shape(ends) not in ((count,), (0,)):
        faults.append(f"ends: expected {count} values, found shape {np.shape(ends)}")
    if faults:
        raise ValueError("the run cannot be set up: " + "; ".join(faults))
    varying = tuple(n for n in model.inputs if model.holds[n] != REGIME)
    regimes = tuple(n for n in model.inputs if model.holds[n] == REGIME)
    lengths = np.concatenate([[0.0], _lengths(time)])
    steps, key = _distinct(_columns([lengths, *(given[n] for n in regimes)], count))
    flags = np.zeros(count, dtype=np.int32)
    for bit, name in enumerate(model.averaged):
        if name in ended:
            flags |= (_at_last_rows(ended[name], lengths) << bit).astype(np.int32)
    u = _columns([given[n] for n in varying], count)
    return Timeline(
        time=time,
        key=key,
        steps=steps,
        u=np.concatenate([u[:1], u]),
        y=_columns([read.get(n, math.nan) for n in model.outputs], count),
        reset=flags,
        varying=varying,
        regimes=regimes,
        outputs=model.outputs,
        origin_s=origin_s,
        ends=np.empty(0, dtype=bool) if ends is None else ends,
    )


def _faults(
    model: Model,
    given: Mapping[str, np.ndarray],
    read: Mapping[str, np.ndarray],
    inputs: Sequence[str],
    resets: Sequence[str],
) -> list[str]:
    """Messages about wrong names and numbers of a run."""
    faults = [
        f"the input {name!r} of the model is missing; given are {sorted(inputs)}{suggestion(name, inputs, 1)}"
        for name in model.inputs
        if name not in inputs
    ]
    faults += unknown_names("readings", read, model.outputs) + unknown_names("resets", resets, model.outputs)
    for values, is_wrong, message in (
        (given, lambda x: ~np.isfinite(x), "not finite at instant {}; inputs must be known everywhere"),
        (read, np.isinf, "infinite at instant {}; a reading that is missing is NaN"),
    ):
        wrong_instants = {name: np.flatnonzero(is_wrong(value)) for name, value in values.items()}
        faults += [
            f"{name}: {message.format(instants[0])}"
            for name, instants in wrong_instants.items()
            if len(instants)
        ]
    return faults


def _at_last_rows(ended: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Ends of averaging intervals (T,), each moved to the last row of its instant: all readings of an instant
    are of the interval that ends there."""
    instant = np.cumsum(lengths > 0.0)
    last = np.append(instant[1:] != instant[:-1], True)
    return last & (np.bincount(instant, ended)[instant] > 0)


def _numbers(name: str, values: object, count: int, faults: list[str]) -> np.ndarray:
    """Values as floats (T,), NaN where masked or missing; adds a fault for non-numbers or another length."""
    try:
        if isinstance(values, np.ma.MaskedArray):
            values = np.ma.filled(values.astype(float), np.nan)
        elif hasattr(values, "to_numpy") and getattr(values, "hasnans", False):
            values = values.to_numpy(dtype=float, na_value=np.nan)
        numbers = np.asarray(values)
        if numbers.dtype.kind in "mM":
            raise TypeError
        numbers = np.asarray(numbers, dtype=float)
    except (TypeError, ValueError):
        faults.append(f"{name}: expected numbers, found {getattr(values, 'dtype', type(values).__name__)}")
        return np.zeros(count)
    if numbers.shape != (count,):
        faults.append(f"{name}: expected {count} values, found shape {numbers.shape}")
        return np.zeros(count)
    return numbers


def _hours(time: object, unit: str, origin_s: float, faults: list[str]) -> tuple[np.ndarray, float]:
    """The instants (T,) [h] and time 0 [s since 1970, UTC]; adds a message to `faults` for each error."""
    if np.ma.is_masked(time):
        faults.append("time: expected instants, found masked ones; leave their rows out")
    times = np.asarray(time)
    if times.dtype == object and times.size and isinstance(times.flat[0], datetime):
        dates = (date if date.tzinfo else date.replace(tzinfo=UTC) for date in times)
        times = np.array([date.astimezone(UTC).replace(tzinfo=None) for date in dates], "datetime64[us]")
    if times.dtype.kind in "mM":
        if unit != "h" or origin_s:
            faults.append("time: expected numbers beside a unit or origin_s, found dates; leave both out")
        if times.dtype.kind == "M":
            origin_s = float((times[0] - np.datetime64(0, "s")) / np.timedelta64(1, "s"))
            times = times - times[0]
        times = times / np.timedelta64(1, "h")
    elif times.dtype.kind == "f" and times.dtype.itemsize < 8:
        faults.append(f"time: expected double precision, found {times.dtype}, which rounds; read as float64")
    faults += unknown_names("unit", [unit], UNITS_H)
    try:
        hours = times.astype(float) * UNITS_H.get(unit, 1.0)
    except (TypeError, ValueError):
        hours = np.full(np.shape(times), np.nan)
    if hours.ndim != 1 or not len(hours):
        faults.append(f"time: expected at least one instant (T,), found shape {hours.shape}")
        return np.zeros(0), origin_s
    not_finite = np.flatnonzero(~np.isfinite(hours))
    decreasing = 1 + np.flatnonzero(hours[1:] < hours[:-1])
    if len(not_finite):
        faults.append(
            f"time: expected finite numbers or dates, found {times[not_finite[0]]} at instant {not_finite[0]}"
        )
    elif len(decreasing):
        faults.append(
            f"time: expected instants in order, found {hours[decreasing[0]]:.9g} h after "
            f"{hours[decreasing[0] - 1]:.9g} h at instant {decreasing[0]}; sort the rows by time"
        )
    return hours, origin_s


def _lengths(time: np.ndarray) -> np.ndarray:
    """Steps (T-1,) [h] between instants (T,) [h], rounded to a microsecond or, below a second, to a
    millionth of the step, so that rounded end points do not make equal steps differ."""
    steps = time[1:] - time[:-1]
    per_hour = np.full(len(steps), 3.6e9)
    short = (steps > 0.0) & (steps < UNITS_H["s"])
    per_hour[short] *= 10.0 ** np.ceil(-np.log10(3600.0 * steps[short]))
    return np.round(steps * per_hour) / per_hour


def _place(kind: str, name: str, names: Sequence[str], others: Sequence[str] = ()) -> int:
    """Index of a name in a tuple; raises ValueError for an unknown name."""
    if name not in names:
        raise ValueError("; ".join(unknown_names(kind, [name], (*names, *others))))
    return tuple(names).index(name)


def _distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct rows in order, and the index of each row among them; three times as fast as numpy's
    `unique`."""
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    is_first = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1))
    key = np.empty(len(rows), dtype=np.int32)
    key[order] = np.cumsum(is_first) - 1
    return np.ascontiguousarray(ordered[is_first]), key


def _columns(columns: Sequence[np.ndarray | float], count: int) -> np.ndarray:
    """Columns (T,), or single numbers, side by side (T, n)."""
    table = np.empty((count, len(columns)))
    for index, column in enumerate(columns):
        table[:, index] = column
    return table
