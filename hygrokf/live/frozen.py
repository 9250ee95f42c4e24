"""Signals that repeat a value for longer than they ever stay still.

A humidity that is frozen in the range of saturated air raises an alarm, but its readings are used: they can
err only towards wet, and without a sensor that is rightly constant water would remain hidden.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.gate import resting, runs_of


@dataclass(frozen=True)
class Frozen:
    """A signal that has repeated a `value` [SI unit] `since` a time [s]; at `known_s` [s] the repetition
    became too long, and at `end` [s] the first other value was read."""

    signal: str
    since: float
    value: float
    known_s: float
    end: float = math.inf


def frozen_runs(
    signal: str,
    readings: tuple[np.ndarray, np.ndarray],
    still_s: float,
    context_s: float,
    after_s: float,
    known_run: Frozen | None,
) -> Iterator[Frozen]:
    """Yield the runs of identical readings of a signal that are too long and last beyond `after_s` [s].

    readings: times [s] (T,) and values [SI unit] (T,).  still_s: time [s] for which the signal may keep a
    value. In the range of saturated air, where the gate accepts readings, the value must be below a value
    that was read within `context_s` [s] before the run became too long, because a sensor at its ceiling is
    not frozen.  A run that became too long up to `after_s` must be `known_run`, because older readings may
    have been dropped.
    """
    time, value = readings
    if not len(time):
        return
    starts, lengths = runs_of(value)
    lasts = starts + lengths - 1
    for run_index in np.flatnonzero(time[lasts] - time[starts] > still_s):
        start, last = int(starts[run_index]), int(lasts[run_index])
        end = float(time[last + 1]) if last + 1 < len(time) else math.inf
        too_long_s = float(time[start:][time[start:] - time[start] > still_s][0])
        if too_long_s <= after_s:
            if known_run is not None and known_run.value == value[start] and end > after_s:
                yield replace(known_run, end=end)
            continue
        earlier = value[np.searchsorted(time, too_long_s - context_s) : start]
        may_rest = resting(signal, value[start : start + 1], math.inf)[0]
        if not may_rest or value[start] < earlier.max(initial=-math.inf):
            yield Frozen(signal, float(time[start]), float(value[start]), too_long_s, end)
