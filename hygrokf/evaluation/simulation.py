"""Free run, forecasts and derived quantities of an identified model, with their uncertainty.

Shapes: T instants, n states, k outputs, d parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.record import Record
from hygrokf.engine.schedule import TOLERANCE
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


def run_on(
    design: Design, values: Mapping[str, float], record: Record, beyond: bool = False
) -> tuple[Design, Run]:
    """The design as the record's loggers read it, and the record's run, settled; `beyond`: as
    `model_inputs`."""
    base = read_as(design, record)
    return base, settled(base, values, model_inputs(base, record, beyond=beyond))


def settled(design: Design, values: Mapping[str, float], run: Run, tolerance: float = TOLERANCE) -> Run:
    """The run with `scored` False also until the free run has forgotten the gaps of its inputs.

    design, values: the model and its parameters, in their units.  tolerance: [1] as in `Likelihood`.

    A gap is forgotten where what its end adds to the variance of every predicted reading (see
    `engine.gaps`) is at most what the reading has without it.
    """
    ends = gap_ends(run.scored)
    if not ends.any():
        return run
    # readings do not count, and the end of a gap changes no course: the sub-steps serve both
    blind = replace(run.unread().timeline, ends=ends[:0])
    held = Likelihood(design.model, blind, tolerance=tolerance).scheduled(values)
    with_gaps, without = (
        replace(held, timeline=replace(blind, ends=one)).trace(values).variance for one in (ends, ends[:0])
    )
    return replace(run, scored=run.scored & (with_gaps <= 2.0 * without).all(axis=1))


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
    u, columns = {one: t.input(one) for one in model.inputs}, list(mean.T)
    made = model.evaluate(columns, u, values)
    found = made.quantities[name] if name in made.quantities else made.rates[model.states.index(name)]
    value = np.broadcast_to(np.asarray(found), len(t))  # a constant is a float
    if covariance is None:
        return value, np.zeros_like(value)
    slopes = state_derivatives(model, name, values, columns, u)
    return value, np.einsum("ti,tij,tj->t", slopes, covariance, slopes)


def expected_readings(
    model: Model, t: Timeline, values: Mapping[str, float], trace: Trace
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Value and standard deviation (T,) of every output, before the readings of each instant are used."""
    found = {
        name: (trace.prediction[:, i], np.sqrt(trace.variance[:, i])) for i, name in enumerate(model.outputs)
    }
    mean, covariance = trace.prior_mean, trace.prior_covariance
    noise = _noise(model, t, values) if model.averaged else {}
    for name, interval in model.averaged.items():  # at instants without a mean the reading of an instant
        rate, variance = project(model, t, values, mean, covariance, f"mean_{name}")
        sd = np.sqrt(np.maximum(variance, 0.0) * interval**2 + noise[name] ** 2)
        read = np.isfinite(t.reading(name))
        found[name] = np.where(read, found[name][0], rate * interval), np.where(read, found[name][1], sd)
    return found


def predicted_readings(design: Design, values: Mapping[str, float], run: Run, trace: Trace) -> Prediction:
    """Expected logger readings before the readings of each instant are used.

    The spread of the absolute humidity combines that of the vapour itself with both readings' white noise.
    Errors of the predicted temperature change both readings and leave the vapour unchanged.
    """
    model, t = design.model, run.timeline
    found = expected_readings(model, t, values, trace)
    temperature = found.get("cabinet_temperature")
    relative = found.get("cabinet_relative_humidity")
    absolute = found.get("cabinet_absolute_humidity")
    warm = temperature[0] if temperature is not None else None
    if warm is None and "cabinet_temperature" in model.inputs:
        warm = t.input("cabinet_temperature")
    if relative is not None and warm is not None:
        value = 1e3 * absolute_humidity(relative[0], warm)
        slope = 1e3 * absolute_humidity_slope_temperature(relative[0], warm)
        noise = _noise(model, t, values)
        by_temperature = slope * noise.get("cabinet_temperature", 0.0)
        saturated = 1e3 * absolute_humidity(1.0, warm)
        by_humidity = saturated * noise["cabinet_relative_humidity"]
        state = model.states.index("vapour")
        ratio = t.input("ambient_temperature") / warm  # equation (5)
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
    _, slopes = replace(likelihood, timeline=zeros).residuals(values, directions)
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


def forecasts(
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
    predictions = ahead(likelihood, values, run, design, trace, starts, ends)
    for start, last, (piece, prediction) in zip(starts, ends, predictions, strict=True):
        part = piece.timeline
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


def ahead(
    likelihood: Likelihood,
    values: Mapping[str, float],
    run: Run,
    design: Design,
    trace: Trace,
    starts: np.ndarray,
    ends: np.ndarray,
) -> Iterator[tuple[Run, Prediction]]:
    """The run after each start, up to before its end (instants), and its prediction from the filtered state
    at the start; the switches of a piece follow the prediction."""
    states = [Gaussian(trace.mean[start], trace.covariance[start]) for start in starts]
    pieces = [run.window(start + 1, last).unread() for start, last in zip(starts, ends, strict=True)]
    for piece, state in zip(self_switched(design, values, pieces, states), states, strict=True):
        own = replace(likelihood, timeline=piece.timeline, schedule=None)
        yield piece, predicted_readings(design, values, piece, own.trace(values, start=state))
