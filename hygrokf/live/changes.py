"""Changes at a cabinet that people state (settings changed, defect repaired, humidity sensor wrong), as the
filter takes them.

At a stated change every tracked property may jump by an unknown amount: its variance is increased by the
square of `Watched.blind`, so that the property counts as unknown until readings show it again.  The other
states go on.  What had shifted until then is expected: shifts are judged anew against the property as it is
`SETTLED_S` after the change.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.timestamps import DAY_S
from hygrokf.estimation.likelihood import Gaussian, Likelihood, Trace
from hygrokf.live.ceiling import censored_trace, joined
from hygrokf.live.properties import WATCHED, TrackedState, observable
from hygrokf.physics.model import Model

SENSOR_WRONG = "humidity sensor wrong"
"""From this event to the next one the humidity sensor's readings are no evidence of condensation."""
KINDS = ("settings changed", "defect repaired", SENSOR_WRONG)
"""Kinds of events."""
SETTLED_S = 7.0 * DAY_S
"""[s] after a change at which a property becomes the reference for later shifts."""
SAME_S = 1e-3
"""[s] times closer than this count as equal."""


@dataclass(frozen=True)
class Change:
    """The event with an id and a kind, as taken into account from a `time` [s] on.

    This is the event's time, or that of the newest final estimate if the event became known later: final
    estimates stay as they are.
    """

    event: str
    time: float
    kind: str = ""


def jump_variance(model: Model) -> np.ndarray:
    """Variance (n,) by which a stated change widens the states."""
    blind = {one.state: one.blind for one in WATCHED}
    return np.array([blind.get(state, 0.0) ** 2 for state in model.states])


def changed_trace(
    likelihood: Likelihood,
    values: Mapping[str, float],
    start: Gaussian | None,
    changes: Iterable[float],
) -> Trace:
    """The filter's trace with stated changes at times [s], from a state or from the prior.

    A change acts between the last instant up to its time and the next one; one before the first instant acts
    on `start`, and one after the last instant does not act yet.
    """
    t, variance = likelihood.timeline, jump_variance(likelihood.model)
    found: list[Trace] = []
    first = 0
    for time in sorted(changes):
        place = int(np.searchsorted(t.seconds, time + SAME_S, side="right"))
        if place == len(t):
            break
        if place > first:
            piece = replace(likelihood, timeline=t.window(first, place))
            found.append(censored_trace(piece, values, start))
            start, first = found[-1].last, place
        if start is not None:  # the prior knows nothing that a change could spoil
            start = replace(start, covariance=start.covariance + np.diag(variance))
    if not found:
        return censored_trace(likelihood, values, start)
    rest = replace(likelihood, timeline=t.window(first, len(t)))
    return joined([*found, censored_trace(rest, values, start)])


def settled(
    references: Mapping[str, TrackedState], changed_s: float, time: float, states: Mapping[str, TrackedState]
) -> dict[str, TrackedState]:
    """The references of properties at `time` [s] after a change at `changed_s` [s].

    A property gets one as soon as it has settled and is observable.
    """
    return {**(observable(states) if time >= changed_s + SETTLED_S else {}), **references}
