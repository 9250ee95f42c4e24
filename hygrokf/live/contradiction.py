"""Readings that contradict the estimate: the filter's innovations against their own bounds.

Before the filter uses a reading y it predicts ŷ with the variance S, which contains the uncertainty of the
state, the model and the sensor.  The reading contradicts the estimate if |y − ŷ| > `BEYOND` √S.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hygrokf.data.readings import SATURATED
from hygrokf.data.signals import SIGNALS, from_si
from hygrokf.identification.wording import fixed
from hygrokf.live.alarms import CONTRADICTS, Level
from hygrokf.live.ceiling import HUMIDITY
from hygrokf.live.tracker import SAME_S, Course

BEYOND = 8.0
"""Standard deviations of the prediction beyond which a reading contradicts it.

On ordinary data of simulated cabinets the innovations have heavier tails than a normal distribution, so that
the bound is wider than a normal distribution would need: docs/validation/live_trials.md has the shares
of false and of right flags.
"""


@dataclass(frozen=True)
class Innovation:
    """A `reading` of a signal at a time [s] beside its prediction: `expected` value and `sd` [SI unit]."""

    signal: str
    time_s: float
    reading: float
    expected: float
    sd: float

    @property
    def deviations(self) -> float:
        """The innovation in standard deviations of its prediction; at its ceiling a humidity sensor reads at
        least its reading."""
        reading = self.reading
        if self.signal == HUMIDITY and reading >= SATURATED:
            reading = max(SATURATED, self.expected)
        return (reading - self.expected) / self.sd


def innovations(course: Course, final_s: float = math.inf) -> list[Innovation]:
    """The innovations of a course by time, as far as its estimates are final (up to `final_s` [s])."""
    timeline, trace = course.run.timeline, course.trace
    known = course.seconds <= final_s + SAME_S
    found = []
    for column, signal in enumerate(timeline.outputs):
        new = known & np.isfinite(timeline.y[:, column])
        found += [
            Innovation(
                signal,
                float(course.seconds[i]),
                float(timeline.y[i, column]),
                float(trace.prediction[i, column]),
                float(np.sqrt(trace.variance[i, column])),
            )
            for i in np.flatnonzero(new)
        ]
    return sorted(found, key=lambda one: (one.time_s, one.signal))


def contradiction_level(one: Innovation) -> Level:
    """The level of a contradiction: 1 at `BEYOND` standard deviations of the prediction."""
    level = abs(one.deviations) / BEYOND
    if level < CONTRADICTS.off:
        return Level(CONTRADICTS.kind, level, "", subject=one.signal)
    row = SIGNALS[one.signal]
    reading, expected, lower, upper = (
        float(from_si(value, row.display, row))
        for value in (one.reading, one.expected, one.expected - 2.0 * one.sd, one.expected + 2.0 * one.sd)
    )
    unit = {"degC": "°C"}.get(row.display, row.display)
    statement = (
        f"{one.signal.replace('_', ' ')} reads {fixed(reading, 1)} {unit}, where the estimate expects "
        f"{fixed(expected, 1)} ({fixed(lower, 1)} … {fixed(upper, 1)})"
    )
    return Level(CONTRADICTS.kind, level, statement, subject=one.signal)
