"""Signals that repeat one value for longer than they ever stay still.

A humidity that is frozen in the range of saturated air is named, and its readings are used all the same: it
can err only towards wet, and to leave out a sensor that is rightly flat would hide water.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.gate import resting, runs_of


@dataclass(frozen=True)
class Frozen:
    """A signal that has repeated a `value` [SI unit] `since` a time [s]: for longer than it stays still from
    `known_s` [s] on, and until it reads another one at `end` [s]."""

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
    known: Frozen | None,
) -> Iterator[Frozen]:
    """The runs of identical readings that are longer than the signal stays still (`still_s` [s]) and that
    last at or beyond a time `after_s` [s].

    readings: times [s] (T,) and values [SI unit] (T,).  In the range of saturated air, where the gate lets
    readings pass, the value must be below one that was read within `context_s` [s] before the run became too
    long: a sensor at its ceiling is not frozen.  Of a run that became so up to `after_s` it is `known`,
    because older readings may be gone.
    """
    time, value = readings
    if not len(time):
        return
    starts, lengths = runs_of(value)
    lasts = starts + lengths - 1
    for place in np.flatnonzero(time[lasts] - time[starts] > still_s):
        start, last = int(starts[place]), int(lasts[place])
        end = float(time[last + 1]) if last + 1 < len(time) else math.inf
        at = float(time[start:][time[start:] - time[start] > still_s][0])
        if at <= after_s:
            if known is not None and known.value == value[start] and end > after_s:
                yield replace(known, end=end)
            continue
        earlier = value[np.searchsorted(time, at - context_s) : start]
        rests = resting(signal, value[start : start + 1], math.inf)[0]
        if not rests or value[start] < earlier.max(initial=-math.inf):
            yield Frozen(signal, float(time[start]), float(value[start]), at, end)
