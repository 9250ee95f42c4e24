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
    """Expected logger readings: value and standard deviation (T,) each; None for a quantity that the model
    lacks.

    `temperature` [K], `relative_humidity` [1], `absolute_humidity` [g/m³] as computed from the other two.
    """

    temperature: tuple[np.ndarray, np.ndarray] | None
    relative_humidity: tuple[np.ndarray, np.ndarray] | None
    absolute_humidity: tuple[np.ndarray, np.ndarray] | None

    def of(self, quantity: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Return value and standard deviation of a quantity named as in reports: "temperature_K", …."""
        return getattr(self, quantity.removesuffix("_K").removesuffix("_g_m3"))


def measured(run: Run) -> dict[str, np.ndarray]:
    """Return the readings (T,) of a run by quantity, NaN where there is none.

    The absolute humidity is computed from relative humidity and temperature of the same instant.
    """
    timeline = run.timeline
    missing = np.full(len(timeline), np.nan)
    temperature = (
        timeline.reading("cabinet_temperature") if "cabinet_temperature" in timeline.outputs else None
    )
    if temperature is None and "cabinet_temperature" in timeline.varying:
        temperature = timeline.input("cabinet_temperature")
    result = {"temperature_K": missing if temperature is None else temperature}
    result["relative_humidity"] = missing
    result["absolute_humidity_g_m3"] = missing
    if "cabinet_relative_humidity" in timeline.outputs:
        humidity = timeline.reading("cabinet_relative_humidity")
        result["relative_humidity"] = humidity
        if temperature is not None:
            result["absolute_humidity_g_m3"] = 1e3 * absolute_humidity(
                humidity, _interpolated(timeline.time, temperature)
            )
    elif "cabinet_absolute_humidity" in timeline.outputs:
        result["absolute_humidity_g_m3"] = timeline.reading("cabinet_absolute_humidity")
    return result


def _interpolated(time: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return readings (T,) interpolated over gaps of at most half an hour; NaN in longer gaps."""
    is_present = np.isfinite(value)
    if is_present.sum() < 2:
        return value
    read_times = time[is_present]
    next_index = np.clip(np.searchsorted(read_times, time), 0, len(read_times) - 1)
    previous_index = np.clip(np.searchsorted(read_times, time, side="right") - 1, 0, len(read_times) - 1)
    # [h] gaps of half an hour, with a margin for rounding
    in_short_gap = (
        (read_times[next_index] - read_times[previous_index] <= 0.55)
        & (time >= read_times[0])
        & (time <= read_times[-1])
    )
    return np.where(in_short_gap, np.interp(time, read_times, value[is_present]), np.nan)


def run_on(
    design: Design, values: Mapping[str, float], record: Record, beyond: bool = False
) -> tuple[Design, Run]:
    """Return the design as a record's loggers read it, and the record's run without instants shortly after
    gaps.

    beyond: as in `model_inputs`.
    """
    base = read_as(design, record)
    return base, settled(base, values, model_inputs(base, record, beyond=beyond))


def settled(design: Design, values: Mapping[str, float], run: Run, tolerance: float = STEP_TOLERANCE) -> Run:
    """Return the run, in which instants shortly after a gap of the inputs are not `scored`.

    design, values: the model and its parameters, in their units.  tolerance: [1] as in `Likelihood`.

    After a gap (see `engine.gaps`) instants are excluded until the gap at most doubles the variance of every
    predicted reading.
    """
    gap_end = gap_ends(run.scored)
    if not gap_end.any():
        return run
    # without readings, gaps change only the covariance: both traces can share the schedule of sub-steps
    without_readings = replace(run.unread().timeline, ends=gap_end[:0])
    likelihood = Likelihood(design.model, without_readings, tolerance=tolerance).scheduled(values)
    variance_with_gaps, variance_without = (
        replace(likelihood, timeline=replace(without_readings, ends=gap_ends_used)).trace(values).variance
        for gap_ends_used in (gap_end, gap_end[:0])
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
    """Return value (T,) and variance (T,) of a quantity of the model, or of the rate of a state [1/h].

    mean, covariance: (T, n), (T, n, n) of the states; the variance is to first order in the covariance, and 0
        without it.
    name: of the quantity or of the state.
    """
    inputs, states = {input_name: t.input(input_name) for input_name in model.inputs}, list(mean.T)
    evaluated = model.evaluate(states, inputs, values)
    if name in evaluated.quantities:
        quantity = evaluated.quantities[name]
    else:
        quantity = evaluated.rates[model.states.index(name)]
    value = np.broadcast_to(np.asarray(quantity), len(t))  # a constant is a float
    if covariance is None:
        return value, np.zeros_like(value)
    derivatives = state_derivatives(model, name, values, states, inputs)
    return value, np.einsum("ti,tij,tj->t", derivatives, covariance, derivatives)


def expected_readings(
    model: Model, t: Timeline, values: Mapping[str, float], trace: Trace
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the expected value and standard deviation (T,) of every output, before each instant's reading is
    used."""
    readings = {
        name: (trace.prediction[:, i], np.sqrt(trace.variance[:, i])) for i, name in enumerate(model.outputs)
    }
    mean, covariance = trace.prior_mean, trace.prior_covariance
    noise = _noise(model, t, values) if model.averaged else {}
    for name, interval in model.averaged.items():  # at instants without a mean the reading of an instant
        reading_rate, variance = project(model, t, values, mean, covariance, f"mean_{name}")
        sd = np.sqrt(np.maximum(variance, 0.0) * interval**2 + noise[name] ** 2)
        is_read = np.isfinite(t.reading(name))
        expected, expected_sd = readings[name]
        readings[name] = (
            np.where(is_read, expected, reading_rate * interval),
            np.where(is_read, expected_sd, sd),
        )
    return readings


def predicted_readings(design: Design, values: Mapping[str, float], run: Run, trace: Trace) -> Prediction:
    """Return the expected logger readings, before the readings of each instant are used.

    The variance of the absolute humidity is that of the vapour plus that of both readings' white noise.  An
    error of the predicted temperature changes both readings but not the vapour.
    """
    model, t = design.model, run.timeline
    readings = expected_readings(model, t, values, trace)
    temperature = readings.get("cabinet_temperature")
    relative_humidity = readings.get("cabinet_relative_humidity")
    absolute_humidity_pair = readings.get("cabinet_absolute_humidity")
    air_K = temperature[0] if temperature is not None else None
    if air_K is None and "cabinet_temperature" in model.inputs:
        air_K = t.input("cabinet_temperature")
    if relative_humidity is not None and air_K is not None:
        vapour_value = 1e3 * absolute_humidity(relative_humidity[0], air_K)
        vapour_by_temperature = 1e3 * absolute_humidity_slope_temperature(relative_humidity[0], air_K)
        noise = _noise(model, t, values)
        by_temperature = vapour_by_temperature * noise.get("cabinet_temperature", 0.0)
        saturated = 1e3 * absolute_humidity(1.0, air_K)
        by_humidity = saturated * noise["cabinet_relative_humidity"]
        vapour_index = model.states.index("vapour")
        temperature_ratio = t.input("ambient_temperature") / air_K  # equation (5)
        vapour_sd = temperature_ratio * np.sqrt(
            np.maximum(trace.prior_covariance[:, vapour_index, vapour_index], 0.0)
        )
        absolute_humidity_pair = (vapour_value, np.sqrt(vapour_sd**2 + by_humidity**2 + by_temperature**2))
    return Prediction(temperature, relative_humidity, absolute_humidity_pair)


def _noise(model: Model, t: Timeline, values: Mapping[str, float]) -> dict[str, float]:
    """Return the standard deviation of a single reading's white noise, including resolution, by output."""
    first_inputs = {name: float(t.input(name)[0]) for name in model.inputs}
    mean, _ = model.initial(values, first_inputs)
    outputs = model.evaluate(mean, first_inputs, values).outputs
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
    names, covariance_matrix = covariance
    parameter_index = {p.name: i for i, p in enumerate(design.model.parameters)}
    directions = np.zeros((len(parameter_index), len(names)))
    directions[[parameter_index[name] for name in names], np.arange(len(names))] = 1.0
    # with readings of zero, the residuals of the free run are minus the predictions at every instant
    zeros = run.timeline.with_readings(np.zeros_like(run.timeline.y))
    _, derivatives = replace(likelihood, timeline=zeros).residuals(values, directions)
    jacobian_of = {name: -derivatives[:, j] for j, name in enumerate(design.model.outputs)}
    temperature_jacobian = jacobian_of.get("cabinet_temperature")
    relative_jacobian = jacobian_of.get("cabinet_relative_humidity")
    absolute_jacobian = jacobian_of.get("cabinet_absolute_humidity")
    relative, absolute = prediction.relative_humidity, prediction.absolute_humidity
    if absolute is not None and relative is not None and relative_jacobian is not None:
        absolute_jacobian = (absolute[0] / relative[0])[:, None] * relative_jacobian
        if prediction.temperature is not None and temperature_jacobian is not None:
            slope = 1e3 * absolute_humidity_slope_temperature(relative[0], prediction.temperature[0])
            absolute_jacobian = absolute_jacobian + slope[:, None] * temperature_jacobian
    return Prediction(
        _with_parameter_variance(prediction.temperature, temperature_jacobian, covariance_matrix),
        _with_parameter_variance(relative, relative_jacobian, covariance_matrix),
        _with_parameter_variance(absolute, absolute_jacobian, covariance_matrix),
    )


def _with_parameter_variance(
    value_and_sd: tuple[np.ndarray, np.ndarray] | None, jacobian: np.ndarray | None, matrix: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return a prediction with its variance increased by that of the parameters, J V J'.

    jacobian: (T, r) J.  matrix: (r, r) V.
    """
    if value_and_sd is None or jacobian is None:
        return value_and_sd
    added_variance = np.einsum("ti,ti->t", jacobian @ matrix, jacobian)
    return value_and_sd[0], np.sqrt(value_and_sd[1] ** 2 + np.maximum(added_variance, 0.0))


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
    timeline = run.timeline
    likelihood = Likelihood(design.model, timeline, tolerance=tolerance)
    trace = likelihood.trace(values)
    observed = measured(run)
    scored_instants = np.flatnonzero(np.isfinite(timeline.y).any(axis=1) & run.scored)
    scored_instants = scored_instants[scored_instants >= first]
    rows_by_lead: dict[float, dict[str, list[tuple[float, float, float]]]] = {
        lead: {q: [] for q in QUANTITIES} for lead in leads_h
    }
    if len(scored_instants) < 10:
        return {}
    positions = np.linspace(0, len(scored_instants) - 1, min(count, len(scored_instants)))
    starts = scored_instants[np.unique(positions.astype(int))]
    step_h = float(np.median(np.diff(timeline.time[scored_instants])))
    ends = np.searchsorted(timeline.time, timeline.time[starts] + max(leads_h) + step_h, side="right")
    starts, ends = starts[ends - starts >= 3], ends[ends - starts >= 3]
    predictions = ahead(likelihood, values, run, design, trace, starts, ends)
    for start, end, (piece, prediction) in zip(starts, ends, predictions, strict=True):
        piece_timeline = piece.timeline
        for lead in leads_h:
            for quantity in QUANTITIES:
                value_and_sd = prediction.of(quantity)
                if value_and_sd is None:
                    continue
                readings = observed[quantity][start + 1 : end]
                usable_instants = np.flatnonzero(np.isfinite(readings) & piece.scored)
                if len(usable_instants) == 0:
                    continue
                nearest = usable_instants[
                    np.argmin(np.abs(piece_timeline.time[usable_instants] - timeline.time[start] - lead))
                ]
                if abs(piece_timeline.time[nearest] - timeline.time[start] - lead) <= 0.6 * step_h:
                    rows_by_lead[lead][quantity].append(
                        (readings[nearest], value_and_sd[0][nearest], value_and_sd[1][nearest])
                    )
    return {
        lead: {
            q: tuple(np.array(rows_of_quantity).T)
            for q, rows_of_quantity in by_quantity.items()
            if rows_of_quantity
        }
        for lead, by_quantity in rows_by_lead.items()
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
    """Yield the prediction from the filtered state at each start.

    starts, ends: instants; a prediction covers those after the start and before the end.  Yields that part of
        the run and its prediction; its switches follow the prediction.
    """
    states = [Gaussian(trace.mean[start], trace.covariance[start]) for start in starts]
    pieces = [run.window(start + 1, end).unread() for start, end in zip(starts, ends, strict=True)]
    for piece, state in zip(self_switched(design, values, pieces, states), states, strict=True):
        from_state = replace(likelihood, timeline=piece.timeline, schedule=None)
        yield piece, predicted_readings(design, values, piece, from_state.trace(values, start=state))
