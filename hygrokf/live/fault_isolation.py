"""Fault isolation: attributes a parameter shift to the cabinet or to a sensor, whichever explains the
readings of the last weeks best.

Every property and every sensor error is a state of the tracked model that may drift.  Fault isolation lets
one of them drift at a time and holds the others constant.  This is the same filter with different rates, so
that likelihoods are comparable.  For example, a thermometer's error shifts the humidity reading as saturation
demands, while a heater that stays on does not.

An error of an ambient sensor looks like an error of the cabinet's sensor, because both act on the difference
between inside and outside.  The ambient readings of sister turbines distinguish the two, because the turbines
of a tracker share their weather.  The daily mean of the difference between a turbine's reading and the median
of its sisters' readings varies little from day to day; an error of the turbine's ambient sensor shows in this
difference, and an error of a sensor in the cabinet does not.  The readings of distant sisters vary more and
give less evidence.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import DAY_S
from hygrokf.estimation.likelihood import Gaussian
from hygrokf.live.plan import Plan
from hygrokf.live.properties import ParameterShift, TrackedState, lasting_s
from hygrokf.live.traces import censored_end, censored_trace
from hygrokf.live.tracker import SAME_S, Point
from hygrokf.modelling.design import extended
from hygrokf.modelling.inputs import model_inputs
from hygrokf.physics.signal_names import AMBIENT_HUMIDITIES

CHANGED_STATES = {
    "thermal_time_constant": (("log_thermal_change", (0.05, 0.2, 0.6)),),
    "hygric_k": (("log_hygric_change", (0.05, 0.2, 0.6)),),
    "heat_release_change": (("release_change", (0.2, 0.6, 2.0)),),
    "temperature_sensor": (("temperature_reading_change", (0.2, 0.6, 2.0)),),
    "humidity_sensor": (
        ("humidity_reading_change", (0.01, 0.03, 0.1)),
        ("humidity_scale_change", (0.03, 0.1, 0.3)),
    ),
    "ambient_temperature": (("ambient_temperature_change", (0.2, 0.6, 2.0)),),
    "ambient_humidity": (("ambient_humidity_change", (0.01, 0.03, 0.1)),),
}
"""Cause -> states that drift if it is the cause, each with the drift rates [per day^0.5] to try."""
PAIRS = {"ambient_temperature": "temperature_sensor", "ambient_humidity": "humidity_sensor"}
"""Error of an ambient sensor -> error of the cabinet's sensor that only sister turbines can distinguish from
it: in the likelihood, small misfits of the model weigh more than the difference between the two errors."""
PAIRED_SENSORS = (*PAIRS, *PAIRS.values())
EXPLAINING_GAIN = 8.0
"""Gain in ln L from which a cause counts as an explanation; fault isolation chooses among about twenty
combinations."""
CLOSE = 3.0
"""Difference in ln L below which two causes cannot be distinguished."""
SHIFT_BEFORE_S = 20.0 * DAY_S
"""[s] before a shift from which readings are used."""
LONGEST_ISOLATION_S = 45.0 * DAY_S
"""Longest period of readings [s]."""
ISOLATION_EVERY_S = DAY_S
"""[s] after which the cause of a lasting shift is isolated again."""


@dataclass(frozen=True)
class CauseFinding:
    """How well a `cause` explains the readings, or the most likely cause, "" if no cause explains them.

    `state`, `value`, `sd`: the drifting state, its present value and its standard deviation; `gain`: increase
    of ln L over an unchanged cabinet; `alike`: causes that cannot be distinguished from this one.
    """

    time_s: float
    cause: str
    state: str = ""
    value: float = 0.0
    gain: float = 0.0
    alike: tuple[str, ...] = ()
    sd: float = 0.0


@dataclass(frozen=True)
class ShiftStep:
    """The tracked properties by the final estimates at a `time` [s]: the `lasting` shifts, the `deviations`
    of the properties from their references, and whether fault isolation is `due` for the shifts.

    The alarms of the shifts are judged step by step, however fast the estimates came.
    """

    time: float
    lasting: tuple[ParameterShift, ...]
    due: bool
    deviations: Mapping[str, TrackedState] = field(default_factory=dict)


def shift_step(
    time: float, shifts: Mapping[str, ParameterShift], deviations: Mapping[str, TrackedState], last_s: float
) -> ShiftStep:
    """The step at a time [s].  Isolation is due when a shift becomes lasting and then once per
    `ISOLATION_EVERY_S`.

    last_s: time [s] of the last isolation."""
    lasting = tuple(shift for shift in shifts.values() if shift.lasting)
    newest_s = max((shift.since + lasting_s(shift) for shift in lasting), default=-np.inf)
    due = bool(lasting) and (last_s < newest_s or last_s <= time - ISOLATION_EVERY_S)
    return ShiftStep(time, lasting, due, dict(deviations))


def isolate(
    plan: Plan, record: Record, reference: Point | None = None, sisters: Sequence[Record] = ()
) -> Iterator[CauseFinding | None]:
    """Search for the cause in a record, step by step: yields None after each step and the finding at the end.

    `reference`: the state from which shifts count after a stated change, None for the fit's values; the
    record then begins before it.  `sisters`: the ambient's readings of other turbines over the same time.
    Raises ValueError if the record cannot be filtered.
    """
    # with errors of the ambient's readings among the states
    relative = "ambient_absolute_humidity" in plan.model.inputs and AMBIENT_HUMIDITIES[0] in record
    additions: list[tuple[str, dict[str, Any]]] = [("wandering_ambient_temperature", {"relative": relative})]
    if "ambient_absolute_humidity" in plan.model.inputs:
        additions.append(("wandering_ambient_humidity", {}))
    wide = replace(plan, design=extended(plan.design, additions))
    timeline = model_inputs(wide.design, record).timeline
    # the smallest drift rates that the model allows hold every state constant
    wandering = {f"{state}_rate" for options in CHANGED_STATES.values() for state, _ in options}
    constant = {**wide.values, **{p.name: p.lower for p in wide.model.parameters if p.name in wandering}}
    start = None
    if reference is not None:
        first = int(np.searchsorted(timeline.seconds, reference.time + SAME_S, side="right"))
        timeline = timeline.window(first, len(timeline))
        if not len(timeline):
            raise ValueError("no readings since the stated change")
        start = _widened_state(plan, wide, reference.state)
    likelihood = wide.likelihood(timeline)
    base_loglik, end_s = censored_end(likelihood, constant, start).loglik, float(timeline.seconds[-1])
    gains: dict[str, CauseFinding] = {}
    evidence: dict[str, float] = {}
    for cause, options in CHANGED_STATES.items():
        best: tuple[Mapping[str, float], Gaussian | None, int] | None = None
        for state, rates in options:
            if state not in wide.model.states:
                continue
            state_index = wide.model.states.index(state)
            for rate in rates:
                prior = None if start is None else _with_variance(start, state_index, rate**2)
                values = {**constant, f"{state}_rate": rate}
                end = censored_end(likelihood, values, prior)
                gain = end.loglik - base_loglik
                if cause not in gains or gain > gains[cause].gain:
                    sd = float(np.sqrt(max(end.last.covariance[state_index, state_index], 0.0)))
                    gains[cause] = CauseFinding(
                        end_s, cause, state, float(end.last.mean[state_index]), gain, sd=sd
                    )
                    best = values, prior, state_index
                yield None
        departures_ = departures(record, sisters, SISTERS_SIGNAL.get(cause, ""))
        if departures_ is not None and best is not None:
            error = censored_trace(likelihood, *best[:2]).mean[:, best[2]]
            evidence[cause] = departures_.support(timeline.seconds, error, gains[cause].sd)
    yield finding_from(gains, end_s, evidence)


def _widened_state(plan: Plan, wide: Plan, state: Gaussian) -> Gaussian:
    """A state of the plan as a state of the wider plan, whose wandering properties are known exactly."""
    places, size = [wide.model.states.index(name) for name in plan.model.states], len(wide.model.states)
    mean, covariance = np.zeros(size), np.zeros((size, size))
    mean[places], covariance[np.ix_(places, places)] = state.mean, state.covariance
    state = replace(state, mean=mean, covariance=covariance)
    for name in (name for options in CHANGED_STATES.values() for name, _ in options):
        if name in wide.model.states:
            state = _with_variance(state, wide.model.states.index(name), 0.0)
    return state


def _with_variance(state: Gaussian, place: int, variance: float) -> Gaussian:
    """A state with another variance at a place, uncorrelated with the others."""
    covariance = state.covariance.copy()
    covariance[place, :] = covariance[:, place] = 0.0
    covariance[place, place] = variance
    return replace(state, covariance=covariance)


def finding_from(
    gains: Mapping[str, CauseFinding], time_s: float, evidence: Mapping[str, float] | None = None
) -> CauseFinding:
    """The finding at `time_s` [s] from the best explanation by each cause.

    `evidence`: cause, an error of an ambient sensor -> gain in ln L by which the sister turbines support it.
    If the sisters decide, one error of each of the `PAIRS` remains.  Else both errors get the same gain: the
    larger one where the cause may be water, the smaller one where the larger would rule water out.
    """
    remaining = dict(gains)
    for ambient, sensor in PAIRS.items():
        support = (evidence or {}).get(ambient, 0.0)
        pair = [cause for cause in (sensor, ambient) if cause in remaining]
        if abs(support) >= CLOSE:
            remaining.pop(sensor if support > 0.0 else ambient, None)
        elif len(pair) > 1:
            gain = (max if sensor == "humidity_sensor" else min)(remaining[cause].gain for cause in pair)
            remaining.update({cause: replace(remaining[cause], gain=gain) for cause in pair})
    ordered = sorted(remaining, key=lambda cause: -remaining[cause].gain)
    if not ordered or remaining[ordered[0]].gain < EXPLAINING_GAIN:
        return CauseFinding(time_s, "")
    best = remaining[ordered[0]]
    alike = tuple(cause for cause in ordered[1:] if best.gain - remaining[cause].gain < CLOSE)
    return replace(best, alike=alike)


SISTERS_SIGNAL = {
    "ambient_temperature": "ambient_temperature",
    "ambient_humidity": "ambient_relative_humidity",
}
"""Cause in `CHANGED_STATES` -> signal that is compared with the signal of the sisters."""
USUAL = 10
"""Days at the beginning of a record, before a shift was noticed, that give the usual difference."""
FEWEST_COMMON_DAYS = 5
"""Smallest number of these days on which both turbines must have readings."""


@dataclass(frozen=True)
class Departures:
    """Deviation of a turbine's reading from its sisters' readings on each day before `end_s` [s], newest
    first.

    `size` (D,) [SI unit]: deviation minus its mean on the oldest `USUAL` days, NaN for an unknown day; `sd`:
    standard deviation of `size` on a usual day, from `count` days.
    """

    size: np.ndarray
    sd: float
    count: int
    end_s: float

    def support(self, seconds: np.ndarray, error: np.ndarray, sd: float) -> float:
        """Gain in ln L by an error (T,) [SI unit] of the turbine's reading at times (T,) [s] with the
        standard deviation `sd`, by Student's t, because few days determine the standard deviation of a
        day."""
        expected = _daily(seconds, error, self.end_s, len(self.size))
        expected = expected - np.nanmean(expected[-USUAL:])
        gain = self._log_density(self.size - expected, sd) - self._log_density(self.size, 0.0)
        return float(np.nansum(gain[:-USUAL]))

    def _log_density(self, deviation: np.ndarray, sd: float) -> np.ndarray:
        variance, freedom = self.sd**2 + sd**2, self.count - 1
        return -0.5 * np.log(variance) - 0.5 * self.count * np.log1p(deviation**2 / (freedom * variance))


def departures(record: Record, sisters: Sequence[Record], signal: str) -> Departures | None:
    """The deviations of a turbine's reading of a signal from its sisters' readings; None if too little is
    known.

    The usual difference is subtracted for each sister, so that a sister may miss days.  A sister with the
    same readings as the turbine, from a common mast, is left out.
    """
    if signal not in record:
        return None
    series, end_s = record[signal], record.end_s
    days = int((end_s - record.start_s) // DAY_S) + 1
    mean = _daily(*series.known, end_s, days)
    differences = []
    for other in (
        sister[signal]
        for sister in sisters
        if signal in sister and not _is_same_sensor(series, sister[signal])
    ):
        difference = mean - _daily(*other.known, end_s, days)
        if np.isfinite(difference[-USUAL:]).sum() >= FEWEST_COMMON_DAYS:
            differences.append(difference - np.nanmedian(difference[-USUAL:]))
    if not differences or days < 2 * USUAL:
        return None
    size = np.ma.median(np.ma.masked_invalid(differences), axis=0).filled(np.nan)
    usual = size[-USUAL:][np.isfinite(size[-USUAL:])]
    if not usual.std() > 0.0:
        return None
    sd = float(usual.std(ddof=1) * np.sqrt(1.0 + 1.0 / len(usual)))
    return Departures(size - usual.mean(), sd, len(usual), end_s)


def _daily(time: np.ndarray, value: np.ndarray, end_s: float, days: int) -> np.ndarray:
    """Means (days,) of the values of each day, counted back from the end; NaN without any."""
    day = ((end_s - time) // DAY_S).astype(int)
    within = (day >= 0) & (day < days)
    count = np.bincount(day[within], minlength=days)
    total = np.bincount(day[within], value[within], minlength=days)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _is_same_sensor(series: Series, other: Series) -> bool:
    """Whether two series are readings of one sensor: equal at all stamps that they share."""
    shared, first, second = np.intersect1d(series.time, other.time, return_indices=True)
    difference = np.abs(series.value[first] - other.value[second])
    return len(shared) > 0 and bool(np.all(difference <= max(series.resolution, other.resolution, 1e-9)))
