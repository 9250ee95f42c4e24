"""The tracker's variant of the filter's trace: with humidity readings at their ceiling, which give only a
lower bound, and with changes at the cabinet that people state (settings, a repair, a sensor that is wrong).

A reading at the ceiling c is censored: only y ≥ c is known.  With the prediction ŷ of the reading, its
variance S, z = (c − ŷ)/√S and λ = φ(z)/Φ(−z), the conditional moments of y are
    E y = ŷ + λ √S,    var y = S (1 − δ),    δ = λ (λ − z),  between 0 and 1,
and the moments of the state follow from them with the gain K of an ordinary reading:
    m + K (E y − ŷ),   P − δ K S K'.
So a censored reading changes the mean like a reading of E y, and reduces the covariance by the share δ of an
ordinary reading's reduction.  The filter continues with the Gaussian of these moments (the Tobit Kalman
filter; Allik et al. 2016, doi:10.1109/TCST.2015.2432155; moments of a truncated normal distribution: Tobin
1958).

At a stated change every tracked property may jump by an unknown amount: its variance is increased by the
square of `Watched.blind`, so that the property counts as unknown until readings show it again.  The other
states are not changed.  Shifts before the change count as expected: later shifts are judged against the
property `SETTLED_S` after the change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from hygrokf.data.readings import SATURATED
from hygrokf.data.timestamps import DAY_S
from hygrokf.estimation.likelihood import End, Gaussian, Likelihood, Trace
from hygrokf.live.properties import WATCHED, TrackedState, observable
from hygrokf.physics.model import Model
from hygrokf.physics.signal_names import CABINET_RELATIVE_HUMIDITY


def censored_trace(
    likelihood: Likelihood, values: Mapping[str, float], start: Gaussian | None = None
) -> Trace:
    """Run the filter with relative humidity censored from `SATURATED` on; returns its trace.

    start: state before the first instant, None for the prior.

    A timeline may be filtered in pieces: starting each piece from the last state of the previous piece gives
    the same bits.
    """
    pieces = list(
        _filter_pieces(likelihood, start, lambda piece, begin: piece.trace(values, start=begin), values)
    )
    return pieces[0] if len(pieces) == 1 else joined(pieces)


def censored_end(likelihood: Likelihood, values: Mapping[str, float], start: Gaussian | None = None) -> End:
    """Return ln L and the last state of the `censored_trace`, without the moments at the other instants."""

    def run(piece: Likelihood, begin: Gaussian | None) -> End:
        """Run the filter over a piece without keeping its moments."""
        started = piece if begin is None else replace(piece, initial=begin)
        return started.end(values)

    ends = list(_filter_pieces(likelihood, start, run, values))
    return End(sum(end.loglik for end in ends), ends[-1].last)


Ended = TypeVar("Ended", End, Trace)


def _filter_pieces(
    likelihood: Likelihood, start: Gaussian | None, run: Callable[[Likelihood, Gaussian | None], Ended],
    values: Mapping[str, float],
) -> Iterator[Ended | Trace]:  # fmt: skip
    """Yield the results of `run(piece, start)` for the pieces between censored readings, and the traces of
    the censored readings, in the order of time."""
    t = likelihood.timeline
    humidity = t.reading(CABINET_RELATIVE_HUMIDITY) if CABINET_RELATIVE_HUMIDITY in t.outputs else np.zeros(0)
    censored_indices: list[int] = np.flatnonzero(humidity >= SATURATED).tolist()
    first = 0
    for index in (*censored_indices, len(t)):
        if index > first:
            is_complete = index - first == len(t)
            piece = run(
                likelihood if is_complete else replace(likelihood, timeline=t.window(first, index)), start
            )
            yield piece
            start = piece.last
        if index < len(t):
            censored = _censored(replace(likelihood, timeline=t.window(index, index + 1)), values, start)
            yield censored
            start, first = censored.last, index + 1


def _censored(likelihood: Likelihood, values: Mapping[str, float], start: Gaussian | None) -> Trace:
    """Run the filter over one instant with a censored humidity reading (see the module)."""
    t = likelihood.timeline
    column = t.outputs.index(CABINET_RELATIVE_HUMIDITY)

    def read(humidity: float) -> Trace:
        """Run the filter with this value as an ordinary humidity reading; NaN for no reading."""
        y = t.y.copy()
        y[:, column] = humidity
        return replace(likelihood, timeline=t.with_readings(y)).trace(values, start=start)

    unread_trace = read(np.nan)
    prediction, spread = (
        float(unread_trace.prediction[0, column]),
        float(np.sqrt(unread_trace.variance[0, column])),
    )
    expected_z, share, log_probability = truncated_moments((SATURATED - prediction) / spread)
    mean_trace = read(prediction + expected_z * spread)

    def reduced(before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Reduce a covariance by the share of the reduction that an ordinary reading gives."""
        return before + share * (after - before)

    return replace(
        unread_trace,
        mean=mean_trace.mean,
        covariance=reduced(unread_trace.covariance, mean_trace.covariance),
        loglik=unread_trace.loglik + log_probability,
        last=replace(
            mean_trace.last, covariance=reduced(unread_trace.last.covariance, mean_trace.last.covariance)
        ),
    )


def truncated_moments(z: float) -> tuple[float, float, float]:
    """Return λ = E(x | x > z), δ = 1 − var(x | x > z) and ln P(x > z) for a standard normal x."""
    from scipy.special import erfcx, log_ndtr

    mean = float(np.sqrt(2.0 / np.pi) / erfcx(z / np.sqrt(2.0)))
    # for large z the difference of two large numbers loses all digits
    return mean, float(np.clip(mean * (mean - z), 0.0, 1.0)), float(log_ndtr(-z))


def joined(traces: list[Trace]) -> Trace:
    """Join the traces of consecutive pieces of a timeline."""
    arrays = {
        name: np.concatenate([getattr(trace, name) for trace in traces])
        for name, value in vars(traces[0]).items()
        if isinstance(value, np.ndarray)
    }
    return Trace(**arrays, loglik=sum(trace.loglik for trace in traces), last=traces[-1].last)


# -- changes that people state -------------------------------------------------------------------------------
SENSOR_WRONG = "humidity sensor wrong"
"""Kind of event from which on, until the next event, humidity readings are no evidence of condensation."""
EVENT_KINDS = ("settings changed", "defect repaired", SENSOR_WRONG)
"""Kinds of events."""
SETTLED_S = 7.0 * DAY_S
"""[s] after a change at which a property becomes the reference for later shifts."""
SAME_S = 1e-3
"""[s] below which a difference of times counts as zero."""


@dataclass(frozen=True)
class StatedChange:
    """A change at a cabinet that a person stated: id of the `event`, its kind, and the `time` [s] from which
    the filter takes it into account.

    This is the event's time or, if the event became known later, the time of the newest final estimate,
    because final estimates are not changed.
    """

    event: str
    time: float
    kind: str = ""


def jump_variance(model: Model) -> np.ndarray:
    """Return the variance (n,) of the jump that each state may make at a stated change, in its unit squared.

    It is the square of `WATCHED`'s `blind` of the states that are watched, 0 for all others.
    """
    blind = {watched.state: watched.blind for watched in WATCHED}
    return np.array([blind.get(state, 0.0) ** 2 for state in model.states])


def changed_trace(
    likelihood: Likelihood,
    values: Mapping[str, float],
    start: Gaussian | None,
    changes: Iterable[float],
) -> Trace:
    """Run the filter with stated changes at the times `changes` [s]; returns its trace.

    start: state before the first instant, None for the prior.

    A change acts between the last instant up to its time and the next instant; a change before the first
    instant acts on `start`, and a change after the last instant does not act yet.
    """
    t, variance = likelihood.timeline, jump_variance(likelihood.model)
    traces: list[Trace] = []
    first = 0
    for time in sorted(changes):
        index = int(np.searchsorted(t.seconds, time + SAME_S, side="right"))
        if index == len(t):
            break
        if index > first:
            piece = replace(likelihood, timeline=t.window(first, index))
            traces.append(censored_trace(piece, values, start))
            start, first = traces[-1].last, index
        if start is not None:  # without `start` the prior applies, which a change does not affect
            start = replace(start, covariance=start.covariance + np.diag(variance))
    if not traces:
        return censored_trace(likelihood, values, start)
    rest = replace(likelihood, timeline=t.window(first, len(t)))
    return joined([*traces, censored_trace(rest, values, start)])


def references_after(
    references: Mapping[str, TrackedState], changed_s: float, time: float, states: Mapping[str, TrackedState]
) -> dict[str, TrackedState]:
    """Return property → reference at `time` [s], against which shifts after a change at `changed_s` [s] are
    judged.

    A property keeps its earlier reference (`references`).  Otherwise its present state (`states`) becomes the
    reference once `SETTLED_S` have passed and the property is observable.
    """
    return {**(observable(states) if time >= changed_s + SETTLED_S else {}), **references}


def humidity_sensor_trusted(changes: Sequence[StatedChange], seconds: np.ndarray) -> np.ndarray:
    """Return whether the humidity sensor is trusted (T,) at times [s]: not from a statement that it is wrong
    to the next stated change."""
    change_count = np.searchsorted([change.time for change in changes], seconds + SAME_S, side="right")
    is_wrong = np.array([False, *(change.kind == SENSOR_WRONG for change in changes)])
    return ~is_wrong[change_count]
