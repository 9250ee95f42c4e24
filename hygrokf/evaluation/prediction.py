"""Free run, forecast, smoothed states and innovations of a model on its data.

The functions take a fit of a cabinet or a user's own likelihood.  Shapes: T instants, n states.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.record import Record
from hygrokf.data.result_file import utc_index, with_units
from hygrokf.engine.timeline import Timeline
from hygrokf.estimation.confidence import normal_quantile
from hygrokf.estimation.likelihood import Gaussian, Likelihood, Trace
from hygrokf.estimation.smoother import smoothed_states
from hygrokf.estimation.subject import Given, Source, Spread, subject
from hygrokf.evaluation.innovation_tests import Diagnosis
from hygrokf.evaluation.simulation import (
    QUANTITIES,
    Prediction,
    ahead,
    expected_readings,
    free_run,
    measured,
    run_on,
)
from hygrokf.modelling.inputs import Run

if TYPE_CHECKING:
    from pandas import DataFrame, Index


@dataclass(frozen=True)
class Course:
    """Expected values and standard deviations of named quantities over time.

    `time_h`: (T,) [h] from `origin_s` [s since 1970, UTC; 0 where the data have no date].
    `value`, `sd`: (T,) by name, in the quantities' own units; `units`: these units, as far as they are known.
    `reading`: (T,) by name, NaN where there is none; without the quantities that are not read.
    `lead_h`: (T,) [h] since the last reading that a forecast used; empty unless this is a forecast.

    `course[name]` is the pair (value, standard deviation).
    """

    time_h: np.ndarray
    origin_s: float
    value: Mapping[str, np.ndarray]
    sd: Mapping[str, np.ndarray]
    reading: Mapping[str, np.ndarray] = field(default_factory=dict)
    lead_h: np.ndarray = field(default_factory=lambda: np.empty(0))
    units: Mapping[str, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return value and standard deviation (T,) of a quantity.  Raises KeyError with the names that
        exist."""
        if name not in self.value:
            raise KeyError(f"expected one of {', '.join(self.value)}, found {name}")
        return self.value[name], self.sd[name]

    def bounds(self, name: str, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper bound (T,) of the central interval with probability `level` [1]."""
        value, sd = self[name]
        half_width = normal_quantile(level) * sd
        return value - half_width, value + half_width

    def to_frame(self, level: float = 0.95) -> DataFrame:
        """Return a pandas frame over time: UTC, or hours where the data have no date.

        Every quantity has the columns `name`, `name_sd`, `name_lower`, `name_upper` and, where it is read,
        `name_reading`; a forecast has `lead_h` too.
        """
        from pandas import DataFrame

        columns: dict[str, np.ndarray] = {"lead_h": self.lead_h} if len(self.lead_h) else {}
        for name in self.value:
            lower, upper = self.bounds(name, level)
            columns |= {name: self.value[name], f"{name}_sd": self.sd[name]}
            columns |= {f"{name}_lower": lower, f"{name}_upper": upper}
            if name in self.reading:
                columns[f"{name}_reading"] = self.reading[name]
        frame = DataFrame(columns, index=time_index(self.time_h, self.origin_s))
        units = {f"{name}{suffix}": unit for name, unit in self.units.items() for suffix in COLUMN_SUFFIXES}
        return with_units(frame, units | {"lead_h": "h"})

    def __repr__(self) -> str:
        """Return the number of instants, the span, and the range of every quantity."""
        lines = [f"{type(self).__name__} of {len(self.time_h)} instants"]
        if len(self.time_h):
            index = time_index(self.time_h[[0, -1]], self.origin_s)
            lines[0] += f", {index[0]} … {index[1]}{'' if self.origin_s else ' h'}"
            for name, value in self.value.items():
                lines.append(f"  {name}: {np.nanmin(value):.5g} … {np.nanmax(value):.5g}")
        return "\n".join(lines[:12])


COLUMN_SUFFIXES = ("", "_sd", "_lower", "_upper", "_reading")
"""Suffixes of a quantity's name in the names of its columns."""


def time_index(time_h: np.ndarray, origin_s: float) -> Index:
    """Return times (T,) [h] as an index: in UTC where their origin is a date, else in hours."""
    from pandas import Index

    return utc_index(origin_s + 3600.0 * time_h) if origin_s else Index(time_h, name="time_h")


Pairs = Mapping[str, tuple[np.ndarray, np.ndarray]]
"""Values and standard deviations (T,) by output."""
QUANTITY_UNITS = dict(zip(QUANTITIES, ("K", "1", "g/m³"), strict=True))


def simulate(source: Source, given: Given | None = None) -> Course:
    """The free run: the model driven by its inputs alone, with the standard deviations of the readings.

    source, given: a `Fit` and a `Record`; or a `Likelihood` and its `Estimate` or values by name.

    Returns every output over all instants of the data, in its unit; of a cabinet the temperature [K], the
    relative humidity [1] and the absolute humidity [g/m³] that follows from both.  The standard deviations
    include the noise of a reading, the model's disturbances and, of a fit or an estimate, the uncertainty of
    the parameters to first order.  A cabinet's thermostats follow the simulated readings.
    Raises ValueError for other arguments, with the call that makes the right ones, and for a diffuse start.
    """
    resolved = subject("simulate", source, given)
    if isinstance(given, Record) and resolved.fit is not None:
        design, run = run_on(resolved.fit.design, resolved.values, given)
        free_prediction = free_run(design, resolved.values, run, resolved.fit.covariance)
        return _course(run.timeline, _by_output(free_prediction), _readings_of(run))
    likelihood, timeline = resolved.likelihood, resolved.likelihood.timeline
    if likelihood.initial == "diffuse":
        raise ValueError(
            "simulate: expected a known first state, found a diffuse one; give the likelihood `initial`, "
            "such as Gaussian(smoothed.mean[0], smoothed.covariance[0]) of `smooth`"
        )
    without_readings = replace(likelihood, timeline=timeline.with_readings(np.full_like(timeline.y, np.nan)))

    def predicted_with(values: Mapping[str, float]) -> Pairs:
        """Return the expected readings at some parameter values."""
        return expected_readings(without_readings.model, timeline, values, without_readings.trace(values))

    predicted = _with_parameters(predicted_with(resolved.values), resolved.spread, predicted_with)
    return _course(timeline, predicted, _readings_in(timeline))


def forecast(
    source: Source,
    given: Given | None = None,
    *,
    leads_h: Sequence[float] | None = None,
    start_h: float | None = None,
    count: int = 250,
) -> Course:
    """Forecasts from the filtered state at a reading, with the inputs that the data have after it.

    source, given: a `Fit` and a `Record`; or a `Likelihood` and its `Estimate` or values by name.
    leads_h: [h] how far ahead; None: one forecast, to every later instant of the data.  The instants beyond
        the last reading are those of a record's ambient series, or the instants of the `timeline` that have
        inputs and NaN as readings.
    start_h: [h] since the timeline's origin; later readings are not used.  Default: the last reading, or,
        with leads, the first one.
    count: with leads, number of forecasts, spread evenly over the readings from `start_h` on.

    Returns the expected readings and their standard deviations, with the observed readings and the lead [h];
    with leads one row per forecast and lead.  The standard deviations include the state's uncertainty, the
    disturbances and the noise of a reading.  Those of a single forecast also include the uncertainty of the
    parameters of a fit or an estimate, to first order; forecasts by lead treat parameters as known.
    Raises ValueError for other arguments, with the call that makes the right ones, and where no reading or no
    later instant is left.
    """
    if leads_h is not None and not (len(leads_h) and min(leads_h) > 0.0):
        raise ValueError(f"leads_h: expected leads above 0 h, found {[float(lead) for lead in leads_h]}")
    if count < 1:
        raise ValueError(f"count: expected at least 1 forecast, found {count}")
    resolved = subject("forecast", source, given)
    if isinstance(given, Record) and resolved.fit is not None:
        design, run = run_on(resolved.fit.design, resolved.values, given, beyond=True)
        likelihood = Likelihood(design.model, run.timeline)
        usable = run.scored
    else:
        likelihood, usable = resolved.likelihood, np.ones(len(resolved.likelihood.timeline), dtype=bool)
    timeline = likelihood.timeline
    has_reading = np.isfinite(timeline.y).any(axis=1) & usable
    starts, ends = _origins(timeline, np.flatnonzero(has_reading), leads_h, start_h, count)

    def pieces(values: Mapping[str, float]) -> Iterator[Pairs]:
        """Yield the expected readings after each start, at some parameter values."""
        trace = likelihood.trace(values)
        if likelihood is resolved.likelihood:
            return _windows(likelihood, values, trace, starts, ends)
        predictions = ahead(likelihood, values, run, design, trace, starts, ends)
        return (_by_output(prediction) for _, prediction in predictions)

    readings = _readings_in(timeline) if likelihood is resolved.likelihood else _readings_of(run)
    pairs_by_start = list(pieces(resolved.values))
    if leads_h is None:
        pairs_by_start = [
            _with_parameters(pairs_by_start[0], resolved.spread, lambda values: next(pieces(values)))
        ]
    time, last_reading = timeline.time, int(np.flatnonzero(has_reading)[-1])
    forecasts: list[tuple[int, np.ndarray, Pairs]] = []
    for start, end, pairs in zip(starts, ends, pairs_by_start, strict=True):
        instants = np.arange(start + 1, end)
        if leads_h is not None:
            observable = instants[has_reading[instants] | (instants > last_reading)]
            instants = _nearest(time, observable, time[start] + np.asarray(leads_h, dtype=float))
        forecasts.append((start, instants, pairs))
    return _joined(forecasts, timeline, readings)


def _joined(
    forecasts: Sequence[tuple[int, np.ndarray, Pairs]], timeline: Timeline, readings: Mapping[str, np.ndarray]
) -> Course:
    """Return forecasts as one course.

    forecasts: start, instants to keep, and expected readings at all instants after the start.
    """
    starts = np.concatenate([np.full(len(kept), start) for start, kept, _ in forecasts])
    instants = np.concatenate([kept for _, kept, _ in forecasts])
    names = list(forecasts[0][2])
    value, sd = (
        {
            name: np.concatenate([pairs[name][i][kept - start - 1] for start, kept, pairs in forecasts])
            for name in names
        }
        for i in (0, 1)
    )
    reading = {name: readings[name][instants] for name in names if name in readings}
    lead_h = timeline.time[instants] - timeline.time[starts]
    return Course(timeline.time[instants], timeline.origin_s, value, sd, reading, lead_h, _units(names))


@dataclass(frozen=True, repr=False)
class Smoothed(Course):
    """Smoothed states: `value`, `sd` by state, and the `covariance` (T, n, n) between all states."""

    covariance: np.ndarray = field(default_factory=lambda: np.empty((0, 0, 0)))

    @property
    def mean(self) -> np.ndarray:
        """All states (T, n), in the model's order."""
        return np.column_stack(list(self.value.values()))


def smooth(source: Source, given: Given | None = None) -> Smoothed:
    """The states given all readings, with their times, names and bands.

    source, given: a `Fit` and a `Record`; or a `Likelihood` and its `Estimate` or values by name.

    Returns the smoothed states by name in the model's units; `mean` (T, n) and `covariance` (T, n, n) hold
    all of them; `to_frame()` makes a pandas frame.  Parameters are treated as known.
    Raises ValueError for other arguments, with the call that makes the right ones.
    Source: Bierman 1973, doi:10.1016/0005-1098(73)90051-4.
    """
    resolved = subject("smooth", source, given)
    likelihood, timeline = resolved.likelihood, resolved.likelihood.timeline
    mean, covariance = smoothed_states(likelihood, resolved.values)
    sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    names = likelihood.model.states
    return Smoothed(
        timeline.time,
        timeline.origin_s,
        dict(zip(names, mean.T, strict=True)),
        dict(zip(names, sd.T, strict=True)),
        covariance=covariance,
    )


@dataclass(frozen=True)
class Innovations:
    """One-step prediction errors and their standard deviations, by output.

    `error`, `sd`: (T,) by output, NaN without a reading.  `sd` is infinite, and `standardised` NaN, at the
        readings that determine the state of a diffuse start.
    `inputs`: (T,) by name.  `time_h`: (T,) [h] from `origin_s` [s since 1970, UTC; 0 where the data have no
        date].
    """

    time_h: np.ndarray
    origin_s: float
    error: Mapping[str, np.ndarray]
    sd: Mapping[str, np.ndarray]
    inputs: Mapping[str, np.ndarray]

    @property
    def standardised(self) -> dict[str, np.ndarray]:
        """Innovations [1] divided by their standard deviations, (T,) by output."""
        return {
            name: np.where(np.isinf(self.sd[name]), np.nan, error / self.sd[name])
            for name, error in self.error.items()
        }

    def to_frame(self) -> DataFrame:
        """Return a pandas frame over time with `name`, `name_sd` and `name_standardised` of every output."""
        from pandas import DataFrame

        columns: dict[str, np.ndarray] = {}
        for name, standard in self.standardised.items():
            columns |= {name: self.error[name], f"{name}_sd": self.sd[name], f"{name}_standardised": standard}
        frame = DataFrame(columns, index=time_index(self.time_h, self.origin_s))
        return with_units(frame, {f"{name}_standardised": "1" for name in self.error})

    def tests(self, longest_h: float = 24.0) -> Diagnosis:
        """Test whiteness, distribution and correlation with every input
        (`evaluation.innovation_tests.diagnose`).

        longest_h: [h] longest lag.
        """
        from hygrokf.evaluation.innovation_tests import diagnose

        return diagnose(self.time_h, self.standardised, self.inputs, longest_h=longest_h)

    def __repr__(self) -> str:
        """Return the number of instants, and count and root mean square of the innovations of every
        output."""
        lines = [f"Innovations at {len(self.time_h)} instants"]
        for name, standard in self.standardised.items():
            count, spread = int(np.isfinite(standard).sum()), math.sqrt(float(np.nanmean(standard**2)))
            lines.append(f"  {name}: {count}, root mean square {spread:.3g} standard deviations")
        return "\n".join(lines)


def innovations(source: Source, given: Given | None = None) -> Innovations:
    """The innovations of the filter, the errors of its one-step predictions.

    source, given: a `Fit` and a `Record`; or a `Likelihood` and its `Estimate` or values by name.

    Returns the errors with their standard deviations in the outputs' units; `standardised` [1] is white with
    variance 1 where the model is right, which `tests()` judges; `to_frame()` makes a pandas frame.  Readings
    count in full, also in a model that bounds their influence.
    Raises ValueError for other arguments, with the call that makes the right ones.
    """
    resolved = subject("innovations", source, given)
    linear_likelihood = replace(resolved.likelihood, model=replace(resolved.likelihood.model, bound=math.inf))
    timeline, trace = linear_likelihood.timeline, linear_likelihood.trace(resolved.values)
    is_read = np.isfinite(timeline.y)
    error = np.where(is_read, timeline.y - trace.prediction, np.nan)
    sd = np.where(is_read, np.sqrt(trace.variance), np.nan)
    errors, deviations = (dict(zip(timeline.outputs, array.T, strict=True)) for array in (error, sd))
    inputs = {name: timeline.input(name) for name in linear_likelihood.model.inputs}
    return Innovations(timeline.time, timeline.origin_s, errors, deviations, inputs)


def _course(timeline: Timeline, pairs: Pairs, readings: Mapping[str, np.ndarray]) -> Course:
    """Return expected readings by output as a `Course`, with the observed readings."""
    value, sd = ({name: value_and_sd[i] for name, value_and_sd in pairs.items()} for i in (0, 1))
    reading = {name: readings[name] for name in pairs if name in readings}
    return Course(timeline.time, timeline.origin_s, value, sd, reading, units=_units(pairs))


CABINET_SIGNAL = {
    quantity: f"cabinet_{quantity.removesuffix('_K').removesuffix('_g_m3')}" for quantity in QUANTITIES
}
"""Quantities of a cabinet and the names of their readings."""


def _units(names: Iterable[str]) -> dict[str, str]:
    """Return the units of those names that are readings of a cabinet."""
    unit_of = {name: QUANTITY_UNITS[quantity] for quantity, name in CABINET_SIGNAL.items()}
    return {name: unit_of[name] for name in names if name in unit_of}


def _by_output(predicted: Prediction) -> Pairs:
    """Return a prediction as (value, standard deviation) by the name of the reading."""
    return {
        name: value_and_sd
        for quantity, name in CABINET_SIGNAL.items()
        if (value_and_sd := predicted.of(quantity)) is not None
    }


def _readings_of(run: Run) -> dict[str, np.ndarray]:
    """Return the observed readings (T,) of a cabinet's run by name."""
    return {CABINET_SIGNAL[quantity]: value for quantity, value in measured(run).items()}


def _readings_in(timeline: Timeline) -> dict[str, np.ndarray]:
    """Return the observed readings (T,) of a timeline by output."""
    return {name: timeline.reading(name) for name in timeline.outputs}


def _origins(
    timeline: Timeline,
    with_reading: np.ndarray,
    leads_h: Sequence[float] | None,
    start_h: float | None,
    count: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the instants at which forecasts start, and those before which their predictions end.

    with_reading: instants with a reading.  leads_h, start_h, count: as for `forecast`.  Raises ValueError if
        no reading has an instant after it.
    """
    if leads_h is None:
        starts = with_reading[timeline.time[with_reading] <= (math.inf if start_h is None else start_h)][-1:]
        ends = np.full(len(starts), len(timeline))
    else:
        later_readings = with_reading[
            timeline.time[with_reading] >= (-math.inf if start_h is None else start_h)
        ]
        positions = np.linspace(0, len(later_readings) - 1, min(count, len(later_readings)))
        starts = later_readings[np.unique(positions.astype(int))] if len(later_readings) else later_readings
        ends = np.searchsorted(timeline.time, timeline.time[starts] + 1.5 * max(leads_h), side="right")
    has_target = ends > starts + 1
    if not has_target.any():
        raise ValueError(
            f"forecast: expected a reading{'' if start_h is None else f' at {start_h:g} h'} with instants "
            "after it, found none; state an earlier start_h, or give inputs beyond the last reading"
        )
    return starts[has_target], ends[has_target]


def _windows(
    likelihood: Likelihood, values: Mapping[str, float], trace: Trace, starts: np.ndarray, ends: np.ndarray
) -> Iterator[Pairs]:
    """Yield the expected readings after each start, computed from the filtered state at the start."""
    timeline = likelihood.timeline
    for start, end in zip(starts, ends, strict=True):
        piece = timeline.window(start + 1, end)
        piece = piece.with_readings(np.full_like(piece.y, np.nan))
        state = Gaussian(trace.mean[start], trace.covariance[start], float(timeline.time[start]))
        from_state = replace(likelihood, timeline=piece, initial=state, diffuse_states=())
        yield expected_readings(from_state.model, piece, values, from_state.trace(values))


SHIFT = 0.1
"""[standard errors] step of the central differences.  The truncation error grows with the square of the step;
errors of the filter's sub-steps are divided by it."""


def _with_parameters(
    pairs: Pairs, spread: Spread, predict: Callable[[Mapping[str, float]], Pairs]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return a prediction whose variance includes that of the parameters.

    pairs: prediction at the estimated parameters.  predict: computes it at other ones.  The derivatives are
        central differences along the axes of the parameters' covariance.
    """
    variance: dict[str, np.ndarray | float] = dict.fromkeys(pairs, 0.0)
    for axis in SHIFT * np.eye(len(spread.names)):
        predicted_above, predicted_below = (
            predict({name: float(np.squeeze(value)) for name, value in spread.drawn(step[None, :]).items()})
            for step in (axis, -axis)
        )
        variance = {
            name: variance_before
            + ((predicted_above[name][0] - predicted_below[name][0]) / (2.0 * SHIFT)) ** 2
            for name, variance_before in variance.items()
        }
    return {name: (value, np.sqrt(sd**2 + variance[name])) for name, (value, sd) in pairs.items()}


def _nearest(time: np.ndarray, instants: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the instants nearest to the wanted times [h]; instants farther away than half a step are left
    out."""
    if not len(instants):
        return instants
    nearest = instants[np.abs(time[instants][:, None] - wanted).argmin(axis=0)]
    median_step_h = float(np.median(np.diff(time[instants]))) if len(instants) > 1 else math.inf
    return nearest[np.abs(time[nearest] - wanted) <= 0.5 * median_step_h]
