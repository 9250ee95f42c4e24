"""Free run, forecasts and derived quantities of an identified model, with their uncertainty.

Shapes: T instants, n states, k outputs, d parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.tabular import utc_index, with_units
from hygrokf.engine.schedule import TOLERANCE
from hygrokf.estimation.likelihood import Gaussian, Likelihood, Trace
from hygrokf.evaluation.self_switching import self_switched
from hygrokf.modelling.design import Design
from hygrokf.modelling.inputs import Run, gap_ends
from hygrokf.physics.model import Equations
from hygrokf.physics.psychrometrics import absolute_humidity, absolute_humidity_slope_temperature

if TYPE_CHECKING:
    from pandas import DataFrame

QUANTITIES = ("temperature_K", "relative_humidity", "absolute_humidity_g_m3")


@dataclass(frozen=True)
class Prediction:
    """Expected logger readings: value and standard deviation (T,) each.

    `temperature` [K], `relative_humidity` [1], `absolute_humidity` [g/m³] as computed from the other two
    readings; None where the model lacks the quantity.
    """

    temperature: tuple[np.ndarray, np.ndarray] | None
    relative_humidity: tuple[np.ndarray, np.ndarray] | None
    absolute_humidity: tuple[np.ndarray, np.ndarray] | None

    def of(self, quantity: str) -> tuple[np.ndarray, np.ndarray] | None:
        """The quantity with a name used in reports: temperature_K, relative_humidity,
        absolute_humidity_g_m3."""
        return getattr(self, quantity.removesuffix("_K").removesuffix("_g_m3"))

    def to_frame(self, time_s: np.ndarray) -> DataFrame:
        """The readings and their standard deviations as a pandas frame over time in UTC, with units in the
        names of its columns.

        time_s: [s] (T,) since 1970-01-01T00:00Z, `run.timeline.seconds`.
        """
        from pandas import DataFrame

        columns = {}
        for quantity, unit in zip(QUANTITIES, ("K", "1", "g/m³"), strict=True):
            pair = self.of(quantity)
            if pair is not None:
                name = quantity.removesuffix("_K").removesuffix("_g_m3").replace("_", " ")
                columns[f"{name} [{unit}]"], columns[f"{name}, standard deviation [{unit}]"] = pair
        frame = DataFrame(columns, index=utc_index(time_s))
        return with_units(frame, {one: one.partition(" [")[2].removesuffix("]") for one in columns})


def measured(run: Run) -> dict[str, np.ndarray]:
    """Readings (T,) by quantity; absolute humidity from relative humidity and temperature of the same
    instant."""
    t = run.timeline
    nothing = np.full(len(t), np.nan)
    temperature = t.reading("cabinet_temperature") if "cabinet_temperature" in t.outputs else None
    if temperature is None and "cabinet_temperature" in t.varying:
        temperature = t.input("cabinet_temperature")
    result = {"temperature_K": nothing if temperature is None else temperature}
    result["relative_humidity"] = nothing
    result["absolute_humidity_g_m3"] = nothing
    if "cabinet_relative_humidity" in t.outputs:
        humidity = t.reading("cabinet_relative_humidity")
        result["relative_humidity"] = humidity
        if temperature is not None:
            result["absolute_humidity_g_m3"] = 1e3 * absolute_humidity(humidity, _filled(t.time, temperature))
    elif "cabinet_absolute_humidity" in t.outputs:
        result["absolute_humidity_g_m3"] = t.reading("cabinet_absolute_humidity")
    return result


def _filled(time: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Readings interpolated over at most half an hour, NaN beyond."""
    there = np.isfinite(value)
    if there.sum() < 2:
        return value
    known = time[there]
    after = np.clip(np.searchsorted(known, time), 0, len(known) - 1)
    before = np.clip(np.searchsorted(known, time, side="right") - 1, 0, len(known) - 1)
    near = (known[after] - known[before] <= 0.55) & (time >= known[0]) & (time <= known[-1])
    return np.where(near, np.interp(time, known, value[there]), np.nan)


def settled(design: Design, values: Mapping[str, float], run: Run, tolerance: float = TOLERANCE) -> Run:
    """The run with `scored` False also until the free run has forgotten the gaps of its inputs.

    design, values: the model and its parameters, in their units.  tolerance: [1] as in `Likelihood`.

    A gap is forgotten where what its end adds to the variance of every predicted reading (see
    `engine.gaps`) is at most what the reading has without it.
    """
    ends = gap_ends(run.scored)
    if not ends.any():
        return run
    with_gaps, without = (
        Likelihood(design.model, replace(run.timeline, ends=one), tolerance=tolerance)
        .trace(values, gain=False)
        .variance
        for one in (ends, ends[:0])
    )
    return replace(run, scored=run.scored & (with_gaps <= 2.0 * without).all(axis=1))


def project(
    design: Design,
    values: Mapping[str, float],
    run: Run,
    mean: np.ndarray,
    covariance: np.ndarray | None,
    function: Callable[[Equations], np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Value (T,) and variance (T,) of a function of the model's equations, to first order in the state's
    covariance.

    mean, covariance: (T, n), (T, n, n) of the states; without a covariance the variance is zero.
    function: equations -> (T,); the slopes come from complex steps.
    """
    t = run.timeline
    model = design.model
    u = {name: t.input(name) for name in model.inputs}
    n = len(model.states)

    # constants of the interpreter are floats, so results must be broadcast to (T,)
    def at(state: list[np.ndarray]) -> np.ndarray:
        return np.broadcast_to(np.asarray(function(model.evaluate(state, u, values))), len(t))

    columns = [mean[:, i] for i in range(n)]
    value = np.real(at(columns))
    if covariance is None:
        return value, np.zeros_like(value)
    slopes = np.empty((len(t), n))
    for i in range(n):
        moved = list(columns)
        moved[i] = columns[i] + 1e-30j
        slopes[:, i] = np.imag(at(moved)) * 1e30
    return value, np.einsum("ti,tij,tj->t", slopes, covariance, slopes)


def air_temperature(equations: Equations) -> np.ndarray:
    """T_conv,a [K] of the model."""
    return equations.quantities["cabinet_air_temperature"]


def predicted_readings(design: Design, values: Mapping[str, float], run: Run, trace: Trace) -> Prediction:
    """Expected logger readings before the readings of each instant are used.

    The spread of the absolute humidity combines that of the vapour itself with both readings' white noise.
    Errors of the predicted temperature change both readings and leave the vapour unchanged.
    """
    model = design.model
    found = {
        name: (trace.prediction[:, i], np.sqrt(trace.variance[:, i])) for i, name in enumerate(model.outputs)
    }
    for name in model.averaged:
        found[name] = _between_means(design, values, run, trace, name, found[name])
    temperature = found.get("cabinet_temperature")
    relative = found.get("cabinet_relative_humidity")
    absolute = found.get("cabinet_absolute_humidity")
    warm = temperature[0] if temperature is not None else None
    if warm is None and "cabinet_temperature" in model.inputs:
        warm = run.timeline.input("cabinet_temperature")
    if relative is not None and warm is not None:
        value = 1e3 * absolute_humidity(relative[0], warm)
        slope = 1e3 * absolute_humidity_slope_temperature(relative[0], warm)
        by_temperature = slope * _noise(design, values, run, "cabinet_temperature")
        saturated = 1e3 * absolute_humidity(1.0, warm)
        by_humidity = saturated * _noise(design, values, run, "cabinet_relative_humidity")
        state = model.states.index("vapour")
        ratio = run.timeline.input("ambient_temperature") / warm  # equation (5)
        vapour = ratio * np.sqrt(np.maximum(trace.prior_covariance[:, state, state], 0.0))
        absolute = (value, np.sqrt(vapour**2 + by_humidity**2 + by_temperature**2))
    return Prediction(temperature, relative, absolute)


def _between_means(
    design: Design,
    values: Mapping[str, float],
    run: Run,
    trace: Trace,
    name: str,
    pair: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """The reading of an interval mean at the instants that have one; at other instants the reading of an
    instant."""
    state, interval = design.model.states.index(f"mean_{name}"), design.model.averaged[name]

    value, variance = project(
        design, values, run, trace.prior_mean, trace.prior_covariance, lambda e: e.rates[state] * interval
    )
    sd = np.sqrt(np.maximum(variance, 0.0) + _noise(design, values, run, name) ** 2)
    read = np.isfinite(run.timeline.reading(name))
    return np.where(read, pair[0], value), np.where(read, pair[1], sd)


def _noise(design: Design, values: Mapping[str, float], run: Run, output: str) -> float:
    """Standard deviation of a single reading's white noise, including resolution; 0 for a signal that is not
    an output."""
    model = design.model
    if output not in model.outputs:
        return 0.0
    u = {name: float(run.timeline.input(name)[0]) for name in model.inputs}
    mean, _ = model.initial(values, u)
    return float(np.sqrt(model.evaluate(mean, u, values).outputs[output][1]))


def simulate(
    design: Design,
    values: Mapping[str, float],
    run: Run,
    covariance: tuple[Sequence[str], np.ndarray] | None = None,
    tolerance: float = TOLERANCE,
) -> Prediction:
    """The free run: the model driven by its inputs alone, from the start of the run to its end.

    design, values: model and parameter values, in the parameters' units (`fit.design`, `fit.values`).
    run: of `model_inputs`, with T instants.
    covariance: (names, (r, r) in the parameters' units) adds the parameters' uncertainty to first order.
    tolerance: [1] as in `Likelihood`.

    Returns `temperature` [K], `relative_humidity` [1], `absolute_humidity` [g/m³], each as (mean, standard
    deviation), both (T,), or None where the model has no such output.  Switches follow the simulated readings
    (`self_switching`); the spread takes their course as given.  Raises ValueError for parameters that the
    model does not have.
    """
    run = self_switched(design, values, [run])[0]
    blind = run.timeline.with_readings(np.full_like(run.timeline.y, np.nan))
    likelihood = Likelihood(design.model, blind, tolerance=tolerance)
    prediction = predicted_readings(design, values, run, likelihood.trace(values))
    if covariance is None:
        return prediction
    names, matrix = covariance
    place = {p.name: i for i, p in enumerate(design.model.parameters)}
    directions = np.zeros((len(place), len(names)))
    directions[[place[name] for name in names], np.arange(len(names))] = 1.0
    # with readings of zero, the residuals of the free run are minus the predictions at every instant
    zeros = run.timeline.with_readings(np.zeros_like(run.timeline.y))
    zero = Likelihood(design.model, zeros, tolerance=tolerance)
    _, slopes = zero.residuals(values, directions)
    rows = {name: -slopes[:, j] for j, name in enumerate(design.model.outputs)}
    warm = rows.get("cabinet_temperature")
    moist = rows.get("cabinet_relative_humidity")
    vapour = rows.get("cabinet_absolute_humidity")
    relative, absolute = prediction.relative_humidity, prediction.absolute_humidity
    if absolute is not None and relative is not None and moist is not None:
        vapour = (absolute[0] / relative[0])[:, None] * moist
        if prediction.temperature is not None and warm is not None:
            slope = 1e3 * absolute_humidity_slope_temperature(relative[0], prediction.temperature[0])
            vapour = vapour + slope[:, None] * warm
    return Prediction(
        _wider(prediction.temperature, warm, matrix),
        _wider(relative, moist, matrix),
        _wider(absolute, vapour, matrix),
    )


def _wider(
    pair: tuple[np.ndarray, np.ndarray] | None, jacobian: np.ndarray | None, matrix: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """A prediction with the variance J V J' of its parameters added."""
    if pair is None or jacobian is None:
        return pair
    extra = np.einsum("ti,ti->t", jacobian @ matrix, jacobian)
    return pair[0], np.sqrt(pair[1] ** 2 + np.maximum(extra, 0.0))


def forecast(
    design: Design,
    values: Mapping[str, float],
    run: Run,
    first: int,
    leads_h: tuple[float, ...] = (1.0, 6.0, 24.0),
    count: int = 250,
    tolerance: float = TOLERANCE,
) -> dict[float, dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """Forecasts from filtered states at instants of a run, compared with the readings that came.

    design, values: model and parameter values, in the parameters' units (`fit.design`, `fit.values`).
    run: of `model_inputs`.
    first, count: instant after which forecasts start, and how many of them, spread evenly.
    leads_h: [h] how far ahead.
    tolerance: [1] as in `Likelihood`.

    Inputs are those of the record (a perfect weather forecast); readings after a start are not used.

    Returns by lead and quantity ("temperature_K", …) the arrays (reading, prediction, standard deviation),
    one element per forecast; empty where fewer than ten instants have readings.  Raises ValueError for
    parameters that the model does not have.
    """
    t = run.timeline
    likelihood = Likelihood(design.model, t, tolerance=tolerance)
    trace = likelihood.trace(values)
    known = measured(run)
    there = np.flatnonzero(np.isfinite(t.y).any(axis=1) & run.scored)
    there = there[there >= first]
    result: dict[float, dict[str, list[tuple[float, float, float]]]] = {
        lead: {q: [] for q in QUANTITIES} for lead in leads_h
    }
    if len(there) < 10:
        return {}
    starts = there[np.unique(np.linspace(0, len(there) - 1, min(count, len(there))).astype(int))]
    step = float(np.median(np.diff(t.time[there])))
    ends = np.searchsorted(t.time, t.time[starts] + max(leads_h) + step, side="right")
    starts, ends = starts[ends - starts >= 3], ends[ends - starts >= 3]
    states = [Gaussian(trace.mean[start], trace.covariance[start]) for start in starts]
    pieces = []
    for start, last in zip(starts, ends, strict=True):
        part = t.window(start + 1, last)
        part = part.with_readings(np.full_like(part.y, np.nan))
        pieces.append(Run(part, run.operating[start + 1 : last], run.scored[start + 1 : last]))
    pieces = self_switched(design, values, pieces, states)
    for start, last, piece, state in zip(starts, ends, pieces, states, strict=True):
        part = piece.timeline
        ahead = Likelihood(design.model, part, tolerance=tolerance).trace(values, start=state)
        prediction = predicted_readings(design, values, piece, ahead)
        for lead in leads_h:
            for quantity in QUANTITIES:
                pair = prediction.of(quantity)
                if pair is None:
                    continue
                seen = known[quantity][start + 1 : last]
                usable = np.flatnonzero(np.isfinite(seen) & piece.scored)
                if len(usable) == 0:
                    continue
                at = usable[np.argmin(np.abs(part.time[usable] - t.time[start] - lead))]
                if abs(part.time[at] - t.time[start] - lead) <= 0.6 * step:
                    result[lead][quantity].append((seen[at], pair[0][at], pair[1][at]))
    return {
        lead: {q: tuple(np.array(rows).T) for q, rows in found.items() if rows}
        for lead, found in result.items()
    }
