"""The two time constants as reported: value, bounds, conditions, and contradicting evidence.

The free run is the simulation without corrections by the readings, whose output error is minimised.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hygrokf.estimation.confidence import Bounds, normal_quantile, parts_scale
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.estimation.output_error import OutputError
from hygrokf.evaluation.simulation import measured
from hygrokf.identification.composition import (
    ANY_CONSTANT,
    AlternativeEstimate,
    Resolved,
    compose_interval,
    of_forms,
    of_free_run,
    of_parts,
)
from hygrokf.identification.estimation import Stage
from hygrokf.identification.fit_results import (
    FormEstimate,
    MeanTemperatures,
    Sampling,
    SensorResponse,
    TimeConstant,
)
from hygrokf.identification.model_forms import FittedForm
from hygrokf.identification.verdict_terms import Interval
from hygrokf.modelling.inputs import Run
from hygrokf.modelling.thermal_system import thermal_poles
from hygrokf.physics.mechanisms.hygric import exchange_factor, hygric_time_constant
from hygrokf.physics.mechanisms.thermal import STILL_K, small_signal
from hygrokf.physics.signal_names import CABINET_TEMPERATURE
from hygrokf.texts.parts import TIME_CONSTANTS

THERMAL_TIME_CONSTANT, HYGRIC_TIME_CONSTANT = TIME_CONSTANTS
OPEN_RATIO = 1e3
"""Ratio of the free run's bounds above which they are uninformative."""


def reference_temperatures(run: Run) -> tuple[float, float]:
    """Return the mean cabinet and ambient temperature [K] at the instants with a cabinet reading.

    Without any reading both are the mean ambient temperature.
    """
    cabinet = measured(run)["temperature_K"]
    ambient = run.timeline.input("ambient_temperature")
    is_present = np.isfinite(cabinet)
    if not is_present.any():
        return float(ambient.mean()), float(ambient.mean())
    return float(cabinet[is_present].mean()), float(ambient[is_present].mean())


def thermal_entry(stage: Stage, simulated: Mapping[str, OutputError]) -> TimeConstant | None:
    """Return the thermal time constant of a stage as reported; None if the stage has none.

    It holds for small changes at the median difference to the ambient; (R_AT+R_IC) C is stated beside it.
    """
    if THERMAL_TIME_CONSTANT not in stage.bounds:
        return None
    entry = _entry(stage, THERMAL_TIME_CONSTANT, 1.0, simulated)
    exponent = stage.estimate.values.get("convection_exponent", 0.0)
    quantiles = _differences_K(stage.run)
    range_h = None
    if exponent > 0:
        reference_K = dict(stage.base.mechanisms)["natural_convection"]["difference_K"]
        range_h = tuple(
            small_signal(entry.value_h, exponent, reference_K, difference_K) for difference_K in quantiles
        )
    return replace(
        entry,
        range_h=None if _unbounded(entry) else range_h,
        difference_K=quantiles,
        resistance_capacity=_resistance_capacity(stage, entry, exponent),
        modes=tuple(thermal_poles(stage.base, stage.estimate.values)),
    )


def hygric_entry(stage: Stage, simulated: Mapping[str, OutputError]) -> TimeConstant | None:
    """Return the hygric time constant R_D*·V* at the record's mean temperatures; None if the stage has
    none."""
    if HYGRIC_TIME_CONSTANT not in stage.bounds:
        return None
    cabinet, ambient = reference_temperatures(stage.run)
    scale = float(hygric_time_constant(1.0, cabinet, ambient))
    entry = _entry(stage, HYGRIC_TIME_CONSTANT, scale, simulated)
    readings = measured(stage.run)["temperature_K"]
    is_present = np.isfinite(readings)
    ambient_present = stage.run.timeline.input("ambient_temperature")[is_present]
    range_h = None
    if is_present.any() and not _unbounded(entry):
        # the hygric time constant at an instant is the parameter divided by this product
        product = readings[is_present] * exchange_factor(ambient_present)
        parameter = stage.estimate.values[HYGRIC_TIME_CONSTANT]
        range_h = float(parameter / product.max()), float(parameter / product.min())
    return replace(
        entry,
        mean_temperatures=MeanTemperatures(cabinet, ambient),
        range_h=range_h,
        response=_response(stage),
        modes=(entry.value_h,),
    )


def _differences_K(run: Run) -> tuple[float, ...]:
    """Return the 10, 50 and 90 % quantiles of the difference [K] between cabinet and ambient, at least
    `STILL_K`."""
    differences = measured(run)["temperature_K"] - run.timeline.input("ambient_temperature")
    differences = np.abs(differences[np.isfinite(differences)])
    return (
        tuple(np.maximum(np.quantile(differences, (0.1, 0.5, 0.9)), STILL_K).tolist())
        if len(differences)
        else ()
    )


def _resistance_capacity(stage: Stage, entry: TimeConstant, exponent: float) -> Interval:
    """Return (R_AT+R_IC) C at the median temperature difference, with bounds over all forms.

    It is (1+n) times the time constant of small changes, with the exponent n of natural convection.
    """
    value = entry.value_h * (1.0 + exponent)
    sources = {step.source: step.sd_ln**2 for step in entry.composition[1:] if step.source != "forms"}
    variance = _variance(stage, THERMAL_TIME_CONSTANT)
    if stage.forms:
        forms = []
        for form in stage.forms:
            form_exponent = form.estimate.values.get("convection_exponent", 0.0)
            form_variance = form.variance(
                {THERMAL_TIME_CONSTANT: 1.0, "convection_exponent": 1.0 / (1.0 + form_exponent)}
            )
            forms.append(
                AlternativeEstimate(
                    math.log(form.estimate.values[THERMAL_TIME_CONSTANT] * (1.0 + form_exponent)),
                    form_variance,
                    form.weight,
                )
            )
        if exponent > 0:
            variance = max(variance, max(forms, key=lambda form: form.weight).variance)
        sources["forms"] = of_forms(math.log(value), variance, forms)
    if _unbounded(entry):
        return Interval(value, 0.0)
    bounds = ANY_CONSTANT.around(value, normal_quantile(entry.level) * math.sqrt(variance))
    final_step = compose_interval(
        value, bounds, entry.level, sources, _resolved(stage, THERMAL_TIME_CONSTANT)
    )[-1]
    return Interval(value, final_step.lower_h, final_step.upper_h)


def _response(stage: Stage) -> SensorResponse:
    """Return the response time of the humidity sensor: stated, included in the hygric constant, or
    estimated."""
    sensors = {name: settings for name, settings in stage.base.mechanisms if name.endswith("humidity_sensor")}
    settings = next(iter(sensors.values()), {})
    stated = settings.get("response_h", 0.0)
    if stated > 0:
        return SensorResponse("stated", 60.0 * stated)
    if settings.get("longest_response_h") is None:
        return SensorResponse("stated" if stage.response_stated else "included", 0.0)
    name = next(p for p in stage.estimate.values if p.endswith("_response"))
    value, variance = stage.estimate.values[name], _variance(stage, name)
    half_width = normal_quantile(CONFIDENCE) * math.sqrt(variance)
    return SensorResponse("estimated", 60.0 * value, *ANY_CONSTANT.around(60.0 * value, half_width))


def _unbounded(entry: TimeConstant) -> bool:
    """Whether the interval of a time constant is open on both sides."""
    return not (entry.lower_h > 0 or math.isfinite(entry.upper_h))


def _resolved(stage: Stage, name: str) -> Resolved:
    """Return the range of time constants that a stage's readings resolve.

    It runs from a tenth of the median step between readings to ten times the record's length.
    """
    timeline = stage.run.timeline
    signal = CABINET_TEMPERATURE if name == THERMAL_TIME_CONSTANT else stage.base.humidity
    steps_h = (
        np.diff(timeline.time[np.isfinite(timeline.reading(signal))])
        if signal in timeline.outputs
        else timeline.time[:0]
    )
    shortest = 0.1 * float(np.median(steps_h)) if len(steps_h) else 0.0
    return Resolved(shortest, 10.0 * float(timeline.time[-1] - timeline.time[0]))


def _variance(stage: Stage, name: str) -> float:
    """Return the variance of a positive parameter's logarithm, by the wider covariance; 0 at a bound."""
    uncertainty = stage.uncertainty
    index = uncertainty.place(name)
    return 0.0 if index is None else float(uncertainty.wald[index, index] * uncertainty.factor[index])


def _entry(stage: Stage, name: str, scale: float, simulated: Mapping[str, OutputError]) -> TimeConstant:
    """Return the report of one time constant; scale: [h] per unit of its parameter `name`.

    simulated: output-error estimates by parameter.
    """
    bounds = stage.bounds[name]
    index = stage.uncertainty.place(name)
    factor = float(stage.uncertainty.factor[index]) if index is not None else 1.0
    free_run = simulated.get(name)
    alternative = _by_free_run(free_run, name)
    resolved, without = _resolved(stage, name), stage.without.get(name)
    sources = _sources(stage, name, alternative)
    value, lower, upper = (scale * end for end in (bounds.value, bounds.lower, bounds.upper))
    interval_steps = compose_interval(value, (lower, upper), bounds.level, sources, resolved)
    reported = (interval_steps[-1].lower_h, interval_steps[-1].upper_h)
    if without is not None and not without.enough:
        reported = (0.0, math.nan)
    sampling = stage.sampling
    return TimeConstant(
        value_h=value,
        lower_h=reported[0],
        upper_h=reported[1],
        level=bounds.level,
        method="composed" if bounds.method == "profile" else bounds.method,
        composition=interval_steps,
        forms=tuple(_form(form, name, scale, bounds.level, resolved) for form in stage.forms),
        parts_scatter=_parts_scatter(stage, name),
        limited_by=bounds.limited_by,
        factor=factor,
        threshold=factor * normal_quantile(bounds.level) ** 2,
        curve=np.array([[float(constant) * scale, float(drop)] for constant, drop in bounds.curve]).reshape(
            -1, 2
        ),
        clock=stage.clock.sources or None,
        sampling=None if sampling is None else Sampling(sampling["step_h"], sampling[name]),
        simulation=None if free_run is None else _simulation(free_run, alternative, name, scale, resolved),
        criteria_disagree=free_run is not None
        and alternative is not None
        and _disagree(bounds, free_run, name),
        without_input=without,
    )


def _sources(stage: Stage, name: str, by_free_run: AlternativeEstimate | None) -> dict[str, float]:
    """Return by how much each source of uncertainty increases the variance of ln(time constant).

    by_free_run: the free run's own estimate, or None.
    """
    index = stage.uncertainty.place(name)
    if index is None:
        return {}
    value, variance = math.log(stage.estimate.values[name]), _variance(stage, name)
    variances = {"parts": of_parts(parts_scale(stage.uncertainty, name), variance)}
    if stage.forms:
        alternatives = [
            AlternativeEstimate(math.log(form.estimate.values[name]), form.variance({name: 1.0}), form.weight)
            for form in stage.forms
        ]
        variances["forms"] = of_forms(value, variance, alternatives)
    if by_free_run is not None:
        variances["free run"] = of_free_run(value, variance, by_free_run)
    if stage.clock.sources:
        factor = float(stage.uncertainty.factor[index])
        variances["clocks"] = factor * stage.clock.variance[name] + stage.clock.shift[name] ** 2
    if stage.sampling is not None:
        variances["sampling"] = stage.sampling[name] ** 2 / 3.0
    return variances


def _by_free_run(free_run: OutputError | None, name: str) -> AlternativeEstimate | None:
    """Return the free run's own estimate of a time constant; None where its bounds say nothing."""
    if free_run is None or name not in free_run.names or name in free_run.at_bounds:
        return None
    index = free_run.names.index(name)
    variance = float(free_run.covariance[index, index])
    # with a singular information matrix the variance may be negative
    is_informative = 0.0 < variance and 2.0 * normal_quantile(CONFIDENCE) * math.sqrt(variance) <= math.log(
        OPEN_RATIO
    )
    return AlternativeEstimate(math.log(free_run.values[name]), variance) if is_informative else None


def _simulation(
    free_run: OutputError,
    by_free_run: AlternativeEstimate | None,
    name: str,
    scale: float,
    resolved: Resolved,
) -> Interval:
    """Return the interval of a time constant by the free run; scale: [h] per unit of its parameter."""
    value = free_run.values[name] * scale
    if by_free_run is None:
        return Interval(value, 0.0)
    lower, upper = free_run.bounds(name, positive=True)
    return Interval(value, *resolved.bounds(lower * scale, upper * scale))


def _disagree(bounds: Bounds, free_run: OutputError, name: str) -> bool:
    """Whether the estimates from the free run and from one-step predictions differ by more than their
    uncertainty."""
    lower, upper = free_run.bounds(name, positive=True)
    distance = abs(math.log(free_run.values[name] / bounds.value))
    half_width = (
        0.5 * math.log(max(bounds.upper / max(bounds.lower, 1e-9), 1.0 + 1e-9))
        if math.isfinite(bounds.upper)
        else 50.0
    )
    return distance > math.hypot(0.5 * math.log(max(upper / lower, 1.0 + 1e-9)), half_width)


def _form(form: FittedForm, name: str, scale: float, level: float, resolved: Resolved) -> FormEstimate:
    """Return the time constant by one form of the model, for the results."""
    value = form.estimate.values[name] * scale
    half_width = normal_quantile(level) * math.sqrt(form.variance({name: 1.0}))
    return FormEstimate(value, *resolved.around(value, half_width), form.name, form.weight, form.gain)


def _parts_scatter(stage: Stage, name: str) -> float:
    """Return the ratio [1] of the scatter between quarters of the record to the scatter that their bounds
    predict."""
    if stage.uncertainty.place(name) is None or not len(stage.uncertainty.parts):
        return math.nan
    return math.sqrt(parts_scale(stage.uncertainty, name))


def by_simulation(entry: TimeConstant | None) -> TimeConstant | None:
    """Return the entry with the output-error estimate as its reported value.

    The maximum-likelihood estimate moves to the field `likelihood`.
    """
    if entry is None or entry.simulation is None:
        return entry
    free_run, without = entry.simulation, entry.without_input
    needed = without is None or without.enough
    return replace(
        entry,
        value_h=free_run.value_h,
        lower_h=free_run.lower_h if needed else 0.0,
        upper_h=free_run.upper_h if needed else math.nan,
        method="output error, sandwich",
        likelihood=Interval(entry.value_h, entry.lower_h, entry.upper_h),
    )
