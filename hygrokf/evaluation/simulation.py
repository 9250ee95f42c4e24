"""Free run, forecasts and derived quantities of an identified model, with their uncertainty.

Shapes: T instants, n states, k outputs, d parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.record import Record
from hygrokf.engine.schedule import STEP_TOLERANCE
from hygrokf.engine.timeline import Timeline
from hygrokf.estimation.likelihood import Gaussian, Likelihood, Trace
from hygrokf.evaluation.self_switching import self_switched
from hygrokf.modelling.design import Design, read_as
from hygrokf.modelling.inputs import Run, gap_ends, model_inputs
from hygrokf.physics.linearisation import state_derivatives
from hygrokf.physics.model import Model
from hygrokf.physics.psychrometrics import absolute_humidity, absolute_humidity_slope_temperature

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


def measured(run: Run) -> dict[str, np.ndarray]:
    """Readings (T,) by quantity; absolute humidity from relative humidity and temperature of the same
    instant."""
    t = run.timeline
    missing = np.full(len(t), np.nan)
    temperature = t.reading("cabinet_temperature") if "cabinet_temperature" in t.outputs else None
    if temperature is None and "cabinet_temperature" in t.varying:
        temperature = t.input("cabinet_temperature")
    result = {"temperature_K": missing if temperature is None else temperature}
    result["relative_humidity"] = missing
    result["absolute_humidity_g_m3"] = missing
    if "cabinet_relative_humidity" in t.outputs:
        humidity = t.reading("cabinet_relative_humidity")
        result["relative_humidity"] = humidity
        if temperature is not None:
            result["absolute_humidity_g_m3"] = 1e3 * absolute_humidity(
                humidity, _interpolated(t.time, temperature)
            )
    elif "cabinet_absolute_humidity" in t.outputs:
        result["absolute_humidity_g_m3"] = t.reading("cabinet_absolute_humidity")
    return result


def _interpolated(time: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Readings interpolated over at most half an hour, NaN beyond."""
    is_present = np.isfinite(value)
    if is_present.sum() < 2:
        return value
    times = time[is_present]
    after = np.clip(np.searchsorted(times, time), 0, len(times) - 1)
    before = np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 1)
    # [h] gaps of half an hour, with a margin for rounding
    near = (times[after] - times[before] <= 0.55) & (time >= times[0]) & (time <= times[-1])
    return np.where(near, np.interp(time, times, value[is_present]), np.nan)


def run_on(
    design: Design, values: Mapping[str, float], record: Record, beyond: bool = False
) -> tuple[Design, Run]:
    """The design as the record's loggers read it, and the record's run, settled; `beyond`: as
    `model_inputs`."""
    base = read_as(design, record)
    return base, settled(base, values, model_inputs(base, record, beyond=beyond))


def settled(design: Design, values: Mapping[str, float], run: Run, tolerance: float = STEP_TOLERANCE) -> Run:
    """The run in which instants shortly after a gap of the inputs are not `scored` either.

    design, values: the model and its parameters, in their units.  tolerance: [1] as in `Likelihood`.

    After a gap (see `engine.gaps`) instants are excluded until the gap at most doubles the variance of every
    predicted reading.
    """
    ends = gap_ends(run.scored)
    if not ends.any():
        return run
    # without readings, gaps change only the covariance: both traces can share the schedule of sub-steps
    blind = replace(run.unread().timeline, ends=ends[:0])
    likelihood = Likelihood(design.model, blind, tolerance=tolerance).scheduled(values)
    variance_with_gaps, variance_without = (
        replace(likelihood, timeline=replace(blind, ends=gaps)).trace(values).variance
        for gaps in (ends, ends[:0])
    )
    return replace(run, scored=run.scored & (variance_with_gaps <= 2.0 * variance_without).all(axis=1))


def project(
    model: Model,
    t: Timeline,
    values: Mapping[str, float],
    mean: np.ndarray,
    covariance: np.ndarray | None,
    name: str,
) -> tuple[np.ndarray, np.ndarray]:
    """Value (T,) and variance (T,) of a shared quantity or of the rate of a state [1/h], to first order in
    the states' covariance.

    mean, covariance: (T, n), (T, n, n) of the states; without a covariance the variance is zero.
    """
    u, states = {input_name: t.input(input_name) for input_name in model.inputs}, list(mean.T)
    evaluated = model.evaluate(states, u, values)
    if name in evaluated.quantities:
        quantity = evaluated.quantities[name]
    else:
        quantity = evaluated.rates[model.states.index(name)]
    value = np.broadcast_to(np.asarray(quantity), len(t))  # a constant is a float
    if covariance is None:
        return value, np.zeros_like(value)
    derivatives = state_derivatives(model, name, values, states, u)
    return value, np.einsum("ti,tij,tj->t", derivatives, covariance, derivatives)


def expected_readings(
    model: Model, t: Timeline, values: Mapping[str, float], trace: Trace
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Value and standard deviation (T,) of every output, before the readings of each instant are used."""
    readings = {
        name: (trace.prediction[:, i], np.sqrt(trace.variance[:, i])) for i, name in enumerate(model.outputs)
    }
    mean, covariance = trace.prior_mean, trace.prior_covariance
    noise = _noise(model, t, values) if model.averaged else {}
    for name, interval in model.averaged.items():  # at instants without a mean the reading of an instant
        rate, variance = project(model, t, values, mean, covariance, f"mean_{name}")
        sd = np.sqrt(np.maximum(variance, 0.0) * interval**2 + noise[name] ** 2)
        is_read = np.isfinite(t.reading(name))
        expected, expected_sd = readings[name]
        readings[name] = np.where(is_read, expected, rate * interval), np.where(is_read, expected_sd, sd)
    return readings


def predicted_readings(design: Design, values: Mapping[str, float], run: Run, trace: Trace) -> Prediction:
    """Expected logger readings before the readings of each instant are used.

    The variance of the absolute humidity is that of the vapour plus that of both readings' white noise.  An
    error of the predicted temperature changes both readings but not the vapour.
    """
    model, t = design.model, run.timeline
    readings = expected_readings(model, t, values, trace)
    temperature = readings.get("cabinet_temperature")
    relative = readings.get("cabinet_relative_humidity")
    absolute = readings.get("cabinet_absolute_humidity")
    air_K = temperature[0] if temperature is not None else None
    if air_K is None and "cabinet_temperature" in model.inputs:
        air_K = t.input("cabinet_temperature")
    if relative is not None and air_K is not None:
        value = 1e3 * absolute_humidity(relative[0], air_K)
        slope = 1e3 * absolute_humidity_slope_temperature(relative[0], air_K)
        noise = _noise(model, t, values)
        by_temperature = slope * noise.get("cabinet_temperature", 0.0)
        saturated = 1e3 * absolute_humidity(1.0, air_K)
        by_humidity = saturated * noise["cabinet_relative_humidity"]
        state = model.states.index("vapour")
        ratio = t.input("ambient_temperature") / air_K  # equation (5)
        vapour = ratio * np.sqrt(np.maximum(trace.prior_covariance[:, state, state], 0.0))
        absolute = (value, np.sqrt(vapour**2 + by_humidity**2 + by_temperature**2))
    return Prediction(temperature, relative, absolute)


def _noise(model: Model, t: Timeline, values: Mapping[str, float]) -> dict[str, float]:
    """Standard deviation of a single reading's white noise, including resolution, of every output."""
    u = {name: float(t.input(name)[0]) for name in model.inputs}
    mean, _ = model.initial(values, u)
    outputs = model.evaluate(mean, u, values).outputs
    return {name: float(np.sqrt(outputs[name][1])) for name in model.outputs}


def free_run(
    design: Design,
    values: Mapping[str, float],
    run: Run,
    covariance: tuple[Sequence[str], np.ndarray] | None = None,
    tolerance: float = STEP_TOLERANCE,
) -> Prediction:
    """The free run: the model driven by its inputs alone, from the start of the run to its end.

    design, values: model and parameter values, in the parameters' units (`fit.design`, `fit.values`).
    run: of `model_inputs`, with T instants.
    covariance: (names, (r, r) in the parameters' units) adds the parameters' uncertainty to first order.
    tolerance: [1] as in `Likelihood`.

    Returns `temperature` [K], `relative_humidity` [1], `absolute_humidity` [g/m³], each as (mean, standard
    deviation), both (T,), or None where the model has no such output.  Switches follow the simulated readings
    (`self_switching`); the standard deviations treat the switches as known.  Raises ValueError for parameters
    that the model does not have.
    """
    run = self_switched(design, values, [run])[0]
    likelihood = Likelihood(design.model, run.unread().timeline, tolerance=tolerance).scheduled(values)
    prediction = predicted_readings(design, values, run, likelihood.trace(values))
    if covariance is None:
        return prediction
    names, matrix = covariance
    place = {p.name: i for i, p in enumerate(design.model.parameters)}
    directions = np.zeros((len(place), len(names)))
    directions[[place[name] for name in names], np.arange(len(names))] = 1.0
    # with readings of zero, the residuals of the free run are minus the predictions at every instant
    zeros = run.timeline.with_readings(np.zeros_like(run.timeline.y))
    _, derivatives = replace(likelihood, timeline=zeros).residuals(values, directions)
    jacobian_of = {name: -derivatives[:, j] for j, name in enumerate(design.model.outputs)}
    of_temperature = jacobian_of.get("cabinet_temperature")
    of_relative = jacobian_of.get("cabinet_relative_humidity")
    of_absolute = jacobian_of.get("cabinet_absolute_humidity")
    relative, absolute = prediction.relative_humidity, prediction.absolute_humidity
    if absolute is not None and relative is not None and of_relative is not None:
        of_absolute = (absolute[0] / relative[0])[:, None] * of_relative
        if prediction.temperature is not None and of_temperature is not None:
            slope = 1e3 * absolute_humidity_slope_temperature(relative[0], prediction.temperature[0])
            of_absolute = of_absolute + slope[:, None] * of_temperature
    return Prediction(
        _with_parameter_variance(prediction.temperature, of_temperature, matrix),
        _with_parameter_variance(relative, of_relative, matrix),
        _with_parameter_variance(absolute, of_absolute, matrix),
    )


def _with_parameter_variance(
    pair: tuple[np.ndarray, np.ndarray] | None, jacobian: np.ndarray | None, matrix: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """The prediction with its variance increased by that of the parameters, J V J'."""
    if pair is None or jacobian is None:
        return pair
    extra = np.einsum("ti,ti->t", jacobian @ matrix, jacobian)
    return pair[0], np.sqrt(pair[1] ** 2 + np.maximum(extra, 0.0))


def forecasts(
    design: Design,
    values: Mapping[str, float],
    run: Run,
    first: int,
    leads_h: tuple[float, ...] = (1.0, 6.0, 24.0),
    count: int = 250,
    tolerance: float = STEP_TOLERANCE,
) -> dict[float, dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """Forecasts from filtered states at instants of a run, paired with the observed readings.

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
    observed = measured(run)
    scored_instants = np.flatnonzero(np.isfinite(t.y).any(axis=1) & run.scored)
    scored_instants = scored_instants[scored_instants >= first]
    result: dict[float, dict[str, list[tuple[float, float, float]]]] = {
        lead: {q: [] for q in QUANTITIES} for lead in leads_h
    }
    if len(scored_instants) < 10:
        return {}
    positions = np.linspace(0, len(scored_instants) - 1, min(count, len(scored_instants)))
    starts = scored_instants[np.unique(positions.astype(int))]
    step = float(np.median(np.diff(t.time[scored_instants])))
    ends = np.searchsorted(t.time, t.time[starts] + max(leads_h) + step, side="right")
    starts, ends = starts[ends - starts >= 3], ends[ends - starts >= 3]
    predictions = ahead(likelihood, values, run, design, trace, starts, ends)
    for start, last, (piece, prediction) in zip(starts, ends, predictions, strict=True):
        part = piece.timeline
        for lead in leads_h:
            for quantity in QUANTITIES:
                pair = prediction.of(quantity)
                if pair is None:
                    continue
                readings = observed[quantity][start + 1 : last]
                usable = np.flatnonzero(np.isfinite(readings) & piece.scored)
                if len(usable) == 0:
                    continue
                instant = usable[np.argmin(np.abs(part.time[usable] - t.time[start] - lead))]
                if abs(part.time[instant] - t.time[start] - lead) <= 0.6 * step:
                    result[lead][quantity].append((readings[instant], pair[0][instant], pair[1][instant]))
    return {
        lead: {q: tuple(np.array(rows).T) for q, rows in by_quantity.items() if rows}
        for lead, by_quantity in result.items()
    }


def ahead(
    likelihood: Likelihood,
    values: Mapping[str, float],
    run: Run,
    design: Design,
    trace: Trace,
    starts: np.ndarray,
    ends: np.ndarray,
) -> Iterator[tuple[Run, Prediction]]:
    """For each pair of instants (start, end): the part of the run after the start and before the end, and its
    prediction from the filtered state at the start; its switches follow the prediction."""
    states = [Gaussian(trace.mean[start], trace.covariance[start]) for start in starts]
    pieces = [run.window(start + 1, last).unread() for start, last in zip(starts, ends, strict=True)]
    for piece, state in zip(self_switched(design, values, pieces, states), states, strict=True):
        from_state = replace(likelihood, timeline=piece.timeline, schedule=None)
        yield piece, predicted_readings(design, values, piece, from_state.trace(values, start=state))
