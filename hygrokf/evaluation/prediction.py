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
from hygrokf.estimation.conventions import CONFIDENCE
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
    """Expected values and standard deviations of named quantities.

    `time_h` (T,) [h] from `origin_s` [s since 1970, UTC; 0 where a timeline states none]; `value`, `sd` by
    name (T,) in the quantities' own units, which `units` has as far as they are known; `reading` by name
    (T,), NaN where there is none, empty for quantities that are not read; `lead_h` (T,) [h] since the last
    reading that a forecast used, empty for other courses.

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
        if name not in self.value:
            raise KeyError(f"expected one of {', '.join(self.value)}, found {name}")
        return self.value[name], self.sd[name]

    def bounds(self, name: str, level: float = CONFIDENCE) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bound (T,) of the central interval with probability `level` [1]."""
        value, sd = self[name]
        half_width = normal_quantile(level) * sd
        return value - half_width, value + half_width

    def to_frame(self, level: float = CONFIDENCE) -> DataFrame:
        """A pandas frame over time (UTC, or hours where there is no date) with the columns `name`, `name_sd`,
        `name_lower`, `name_upper` and, where it is read, `name_reading`, of every quantity; a forecast has
        `lead_h` too."""
        from pandas import DataFrame

        columns: dict[str, np.ndarray] = {"lead_h": self.lead_h} if len(self.lead_h) else {}
        for name in self.value:
            lower, upper = self.bounds(name, level)
            columns |= {name: self.value[name], f"{name}_sd": self.sd[name]}
            columns |= {f"{name}_lower": lower, f"{name}_upper": upper}
            if name in self.reading:
                columns[f"{name}_reading"] = self.reading[name]
        frame = DataFrame(columns, index=time_index(self.time_h, self.origin_s))
        units = {f"{name}{end}": unit for name, unit in self.units.items() for end in COLUMN_SUFFIXES}
        return with_units(frame, units | {"lead_h": "h"})

    def __repr__(self) -> str:
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
    """Times (T,) [h] as an index: in UTC where their origin is a date, else in hours."""
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
    Raises ValueError for anything else, with the call that makes what is missing, and for a diffuse start.
    """
    resolved = subject("simulate", source, given)
    if isinstance(given, Record) and resolved.fit is not None:
        design, run = run_on(resolved.fit.design, resolved.values, given)
        free_prediction = free_run(design, resolved.values, run, resolved.fit.covariance)
        return _course(run.timeline, _by_output(free_prediction), _readings_of(run))
    likelihood, t = resolved.likelihood, resolved.likelihood.timeline
    if likelihood.initial == "diffuse":
        raise ValueError(
            "simulate: expected a known first state, found a diffuse one; give the likelihood `initial`, "
            "such as Gaussian(smoothed.mean[0], smoothed.covariance[0]) of `smooth`"
        )
    blind = replace(likelihood, timeline=t.with_readings(np.full_like(t.y, np.nan)))

    def predicted_with(values: Mapping[str, float]) -> Pairs:
        return expected_readings(blind.model, t, values, blind.trace(values))

    pairs = _with_parameters(predicted_with(resolved.values), resolved.spread, predicted_with)
    return _course(t, pairs, _readings_in(t))


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
    Raises ValueError for anything else, with the call that makes what is missing, and where no reading or no
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
    t = likelihood.timeline
    is_read = np.isfinite(t.y).any(axis=1) & usable
    starts, ends = _origins(t, np.flatnonzero(is_read), leads_h, start_h, count)

    def pieces(values: Mapping[str, float]) -> Iterator[Pairs]:
        trace = likelihood.trace(values)
        if likelihood is resolved.likelihood:
            return _windows(likelihood, values, trace, starts, ends)
        predictions = ahead(likelihood, values, run, design, trace, starts, ends)
        return (_by_output(prediction) for _, prediction in predictions)

    readings = _readings_in(t) if likelihood is resolved.likelihood else _readings_of(run)
    pairs_by_start = list(pieces(resolved.values))
    if leads_h is None:
        pairs_by_start = [
            _with_parameters(pairs_by_start[0], resolved.spread, lambda values: next(pieces(values)))
        ]
    last = int(np.flatnonzero(is_read)[-1])
    rows, parts = [], []
    for start, end, pairs in zip(starts, ends, pairs_by_start, strict=True):
        instants = np.arange(start + 1, end)
        if leads_h is not None:
            observable = instants[is_read[instants] | (instants > last)]
            instants = _nearest(t.time, observable, t.time[start] + np.asarray(leads_h, dtype=float))
        rows.append((np.full(len(instants), start), instants))
        place = instants - start - 1
        parts.append({name: (value[place], sd[place]) for name, (value, sd) in pairs.items()})
    start_of, instant = (np.concatenate(column) for column in zip(*rows, strict=True))
    value, sd = (
        {name: np.concatenate([part[name][i] for part in parts]) for name in parts[0]} for i in (0, 1)
    )
    reading = {name: readings[name][instant] for name in value if name in readings}
    return Course(
        t.time[instant], t.origin_s, value, sd, reading, t.time[instant] - t.time[start_of], _units(value)
    )


@dataclass(frozen=True, repr=False)
class Smoothed(Course):
    """Smoothed states: `value`, `sd` by state, and the `covariance` (T, n, n) of all states."""

    covariance: np.ndarray = field(default_factory=lambda: np.empty((0, 0, 0)))

    @property
    def mean(self) -> np.ndarray:
        """The states (T, n) in the model's order."""
        return np.column_stack(list(self.value.values()))


def smooth(source: Source, given: Given | None = None) -> Smoothed:
    """The states given all readings, with their times, names and bands.

    source, given: a `Fit` and a `Record`; or a `Likelihood` and its `Estimate` or values by name.

    Returns the smoothed states by name in the model's units; `mean` (T, n) and `covariance` (T, n, n) hold
    all of them; `to_frame()` makes a pandas frame.  Parameters are treated as known.
    Raises ValueError for anything else, with the call that makes what is missing.
    Source: Bierman 1973, doi:10.1016/0005-1098(73)90051-4.
    """
    resolved = subject("smooth", source, given)
    likelihood, t = resolved.likelihood, resolved.likelihood.timeline
    mean, covariance = smoothed_states(likelihood, resolved.values)
    sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    names = likelihood.model.states
    return Smoothed(
        t.time, t.origin_s, dict(zip(names, mean.T, strict=True)), dict(zip(names, sd.T, strict=True)),
        covariance=covariance,
    )  # fmt: skip


@dataclass(frozen=True)
class Innovations:
    """One-step prediction errors: `error`, `sd` (T,) by output, NaN without reading; `inputs` (T,) by name.

    `sd` is infinite, and `standardised` NaN, at the readings that determine the state of a diffuse start.
    `time_h` (T,) [h] from `origin_s` [s since 1970, UTC; 0 where a timeline states none].
    """

    time_h: np.ndarray
    origin_s: float
    error: Mapping[str, np.ndarray]
    sd: Mapping[str, np.ndarray]
    inputs: Mapping[str, np.ndarray]

    @property
    def standardised(self) -> dict[str, np.ndarray]:
        """Innovations [1] divided by their standard deviations, (T,) by output."""
        return {n: np.where(np.isinf(self.sd[n]), np.nan, e / self.sd[n]) for n, e in self.error.items()}

    def to_frame(self) -> DataFrame:
        """A pandas frame over time with `name`, `name_sd` and `name_standardised` of every output."""
        from pandas import DataFrame

        columns: dict[str, np.ndarray] = {}
        for name, standard in self.standardised.items():
            columns |= {name: self.error[name], f"{name}_sd": self.sd[name], f"{name}_standardised": standard}
        frame = DataFrame(columns, index=time_index(self.time_h, self.origin_s))
        return with_units(frame, {f"{name}_standardised": "1" for name in self.error})

    def tests(self, longest_h: float = 24.0) -> Diagnosis:
        """Whiteness, distribution and correlation with every input (`evaluation.innovation_tests.diagnose`).

        longest_h: [h] longest lag.
        """
        from hygrokf.evaluation.innovation_tests import diagnose

        return diagnose(self.time_h, self.standardised, self.inputs, longest_h=longest_h)

    def __repr__(self) -> str:
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
    Raises ValueError for anything else, with the call that makes what is missing.
    """
    resolved = subject("innovations", source, given)
    linear = replace(resolved.likelihood, model=replace(resolved.likelihood.model, bound=math.inf))
    t, trace = linear.timeline, linear.trace(resolved.values)
    is_read = np.isfinite(t.y)
    error = np.where(is_read, t.y - trace.prediction, np.nan)
    sd = np.where(is_read, np.sqrt(trace.variance), np.nan)
    errors, deviations = (dict(zip(t.outputs, array.T, strict=True)) for array in (error, sd))
    inputs = {name: t.input(name) for name in linear.model.inputs}
    return Innovations(t.time, t.origin_s, errors, deviations, inputs)


def _course(t: Timeline, pairs: Pairs, readings: Mapping[str, np.ndarray]) -> Course:
    value, sd = ({name: pair[i] for name, pair in pairs.items()} for i in (0, 1))
    reading = {name: readings[name] for name in pairs if name in readings}
    return Course(t.time, t.origin_s, value, sd, reading, units=_units(pairs))


CABINET_SIGNAL = {
    quantity: f"cabinet_{quantity.removesuffix('_K').removesuffix('_g_m3')}" for quantity in QUANTITIES
}
"""Quantities of a cabinet and the names of their readings."""


def _units(names: Iterable[str]) -> dict[str, str]:
    """The units of a cabinet's readings among some names."""
    unit_of = {name: QUANTITY_UNITS[quantity] for quantity, name in CABINET_SIGNAL.items()}
    return {name: unit_of[name] for name in names if name in unit_of}


def _by_output(predicted: Prediction) -> Pairs:
    return {
        name: pair
        for quantity, name in CABINET_SIGNAL.items()
        if (pair := predicted.of(quantity)) is not None
    }


def _readings_of(run: Run) -> dict[str, np.ndarray]:
    return {CABINET_SIGNAL[quantity]: value for quantity, value in measured(run).items()}


def _readings_in(t: Timeline) -> dict[str, np.ndarray]:
    return {name: t.reading(name) for name in t.outputs}


def _origins(
    t: Timeline, with_reading: np.ndarray, leads_h: Sequence[float] | None, start_h: float | None, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Instants from which forecasts start, and the instants before which their predictions end."""
    if leads_h is None:
        starts = with_reading[t.time[with_reading] <= (math.inf if start_h is None else start_h)][-1:]
        ends = np.full(len(starts), len(t))
    else:
        later = with_reading[t.time[with_reading] >= (-math.inf if start_h is None else start_h)]
        positions = np.linspace(0, len(later) - 1, min(count, len(later)))
        starts = later[np.unique(positions.astype(int))] if len(later) else later
        ends = np.searchsorted(t.time, t.time[starts] + 1.5 * max(leads_h), side="right")
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
    """The expected readings after each start, from its filtered state."""
    t = likelihood.timeline
    for start, end in zip(starts, ends, strict=True):
        part = t.window(start + 1, end)
        part = part.with_readings(np.full_like(part.y, np.nan))
        state = Gaussian(trace.mean[start], trace.covariance[start], float(t.time[start]))
        from_state = replace(likelihood, timeline=part, initial=state, diffuse_states=())
        yield expected_readings(from_state.model, part, values, from_state.trace(values))


SHIFT = 0.1
"""[standard errors] step of the central differences.  The truncation error grows with the square of the step;
errors of the filter's sub-steps are divided by it."""


def _with_parameters(
    pairs: Pairs, spread: Spread, predict: Callable[[Mapping[str, float]], Pairs]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """A prediction whose variance includes that of the parameters, by central differences along the axes of
    the parameters' covariance."""
    variance: dict[str, np.ndarray | float] = dict.fromkeys(pairs, 0.0)
    for axis in SHIFT * np.eye(len(spread.names)):
        up, down = (
            predict({name: float(np.squeeze(value)) for name, value in spread.drawn(move[None, :]).items()})
            for move in (axis, -axis)
        )
        variance = {n: v + ((up[n][0] - down[n][0]) / (2.0 * SHIFT)) ** 2 for n, v in variance.items()}
    return {name: (value, np.sqrt(sd**2 + variance[name])) for name, (value, sd) in pairs.items()}


def _nearest(time: np.ndarray, instants: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The instants nearest to the wanted times [h], without those farther away than half a step."""
    if not len(instants):
        return instants
    nearest = instants[np.abs(time[instants][:, None] - wanted).argmin(axis=0)]
    step = float(np.median(np.diff(time[instants]))) if len(instants) > 1 else math.inf
    return nearest[np.abs(time[nearest] - wanted) <= 0.5 * step]
