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
    """Mean cabinet and ambient temperature [K] over the instants with a cabinet temperature reading; without
    any reading, twice the mean ambient temperature."""
    cabinet = measured(run)["temperature_K"]
    ambient = run.timeline.input("ambient_temperature")
    is_present = np.isfinite(cabinet)
    if not is_present.any():
        return float(ambient.mean()), float(ambient.mean())
    return float(cabinet[is_present].mean()), float(ambient[is_present].mean())


def thermal_entry(stage: Stage, simulated: Mapping[str, OutputError]) -> TimeConstant | None:
    """The thermal time constant of small changes at the median difference to the ambient, with R·C."""
    if THERMAL_TIME_CONSTANT not in stage.bounds:
        return None
    entry = _entry(stage, THERMAL_TIME_CONSTANT, 1.0, simulated)
    exponent = stage.estimate.values.get("convection_exponent", 0.0)
    quantiles = _differences_K(stage.run)
    range_h = None
    if exponent > 0:
        reference_K = dict(stage.base.mechanisms)["natural_convection"]["difference_K"]
        range_h = tuple(small_signal(entry.value_h, exponent, reference_K, d) for d in quantiles)
    return replace(
        entry,
        range_h=None if _unbounded(entry) else range_h,
        difference_K=quantiles,
        resistance_capacity=_resistance_capacity(stage, entry, exponent),
        modes=tuple(thermal_poles(stage.base, stage.estimate.values)),
    )


def hygric_entry(stage: Stage, simulated: Mapping[str, OutputError]) -> TimeConstant | None:
    """The hygric time constant R_D*·V* at the record's mean temperatures."""
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
    """10, 50 and 90 % quantiles of the difference [K] between cabinet and ambient over the readings, at least
    `STILL_K`."""
    differences = measured(run)["temperature_K"] - run.timeline.input("ambient_temperature")
    differences = np.abs(differences[np.isfinite(differences)])
    return (
        tuple(np.maximum(np.quantile(differences, (0.1, 0.5, 0.9)), STILL_K).tolist())
        if len(differences)
        else ()
    )


def _resistance_capacity(stage: Stage, entry: TimeConstant, exponent: float) -> Interval:
    """(R_AT+R_IC) C at the median temperature difference over all forms: (1+n) times the time constant of
    small changes, with the exponent n of natural convection."""
    value = entry.value_h * (1.0 + exponent)
    sources = {step.source: step.sd_ln**2 for step in entry.composition[1:] if step.source != "forms"}
    variance = _variance(stage, THERMAL_TIME_CONSTANT)
    if stage.forms:
        forms = []
        for form in stage.forms:
            n = form.estimate.values.get("convection_exponent", 0.0)
            spread = form.variance({THERMAL_TIME_CONSTANT: 1.0, "convection_exponent": 1.0 / (1.0 + n)})
            forms.append(
                AlternativeEstimate(
                    math.log(form.estimate.values[THERMAL_TIME_CONSTANT] * (1.0 + n)), spread, form.weight
                )
            )
        if exponent > 0:
            variance = max(variance, max(forms, key=lambda form: form.weight).variance)
        sources["forms"] = of_forms(math.log(value), variance, forms)
    if _unbounded(entry):
        return Interval(value, 0.0)
    ends = ANY_CONSTANT.around(value, normal_quantile(entry.level) * math.sqrt(variance))
    last = compose_interval(value, ends, entry.level, sources, _resolved(stage, THERMAL_TIME_CONSTANT))[-1]
    return Interval(value, last.lower_h, last.upper_h)


def _response(stage: Stage) -> SensorResponse:
    """The response time of the humidity sensor, which affects the hygric time constant: stated, included in
    that constant, or estimated."""
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
    return not (entry.lower_h > 0 or math.isfinite(entry.upper_h))


def _resolved(stage: Stage, name: str) -> Resolved:
    """The range of time constants [h] that a stage's readings resolve: from a tenth of their median step to
    ten times their length."""
    t = stage.run.timeline
    output = CABINET_TEMPERATURE if name == THERMAL_TIME_CONSTANT else stage.base.humidity
    steps = np.diff(t.time[np.isfinite(t.reading(output))]) if output in t.outputs else t.time[:0]
    shortest = 0.1 * float(np.median(steps)) if len(steps) else 0.0
    return Resolved(shortest, 10.0 * float(t.time[-1] - t.time[0]))


def _variance(stage: Stage, name: str) -> float:
    """Variance of a positive parameter's logarithm, by the wider of both covariances; 0 at a bound."""
    uncertainty = stage.uncertainty
    place = uncertainty.place(name)
    return 0.0 if place is None else float(uncertainty.wald[place, place] * uncertainty.factor[place])


def _entry(stage: Stage, name: str, scale: float, simulated: Mapping[str, OutputError]) -> TimeConstant:
    """The report of one time constant; `scale` [h] per unit of its parameter."""
    bounds = stage.bounds[name]
    place = stage.uncertainty.place(name)
    factor = float(stage.uncertainty.factor[place]) if place is not None else 1.0
    free_run = simulated.get(name)
    alternative = _by_free_run(free_run, name)
    resolved, without = _resolved(stage, name), stage.without.get(name)
    sources = _sources(stage, name, alternative)
    value, low, high = (scale * end for end in (bounds.value, bounds.lower, bounds.upper))
    steps = compose_interval(value, (low, high), bounds.level, sources, resolved)
    reported = (steps[-1].lower_h, steps[-1].upper_h)
    if without is not None and not without.enough:
        reported = (0.0, math.nan)
    sampling = stage.sampling
    return TimeConstant(
        value_h=value,
        lower_h=reported[0],
        upper_h=reported[1],
        level=bounds.level,
        method="composed" if bounds.method == "profile" else bounds.method,
        composition=steps,
        forms=tuple(_form(form, name, scale, bounds.level, resolved) for form in stage.forms),
        parts_scatter=_parts_scatter(stage, name),
        limited_by=bounds.limited_by,
        factor=factor,
        threshold=factor * normal_quantile(bounds.level) ** 2,
        curve=np.array([[float(x) * scale, float(y)] for x, y in bounds.curve]).reshape(-1, 2),
        clock=stage.clock.sources or None,
        sampling=None if sampling is None else Sampling(sampling["step_h"], sampling[name]),
        simulation=None if free_run is None else _simulation(free_run, alternative, name, scale, resolved),
        criteria_disagree=free_run is not None
        and alternative is not None
        and _disagree(bounds, free_run, name),
        without_input=without,
    )


def _sources(stage: Stage, name: str, free: AlternativeEstimate | None) -> dict[str, float]:
    """Source of uncertainty → variance of the logarithm that the source adds to the bounds of a profile."""
    place = stage.uncertainty.place(name)
    if place is None:
        return {}
    value, variance = math.log(stage.estimate.values[name]), _variance(stage, name)
    variances = {"parts": of_parts(parts_scale(stage.uncertainty, name), variance)}
    if stage.forms:
        alternatives = [
            AlternativeEstimate(math.log(form.estimate.values[name]), form.variance({name: 1.0}), form.weight)
            for form in stage.forms
        ]
        variances["forms"] = of_forms(value, variance, alternatives)
    if free is not None:
        variances["free run"] = of_free_run(value, variance, free)
    if stage.clock.sources:
        factor = float(stage.uncertainty.factor[place])
        variances["clocks"] = factor * stage.clock.variance[name] + stage.clock.shift[name] ** 2
    if stage.sampling is not None:
        variances["sampling"] = stage.sampling[name] ** 2 / 3.0
    return variances


def _by_free_run(free_run: OutputError | None, name: str) -> AlternativeEstimate | None:
    """The free run's own estimate; None where its bounds are uninformative."""
    if free_run is None or name not in free_run.names or name in free_run.at_bounds:
        return None
    place = free_run.names.index(name)
    variance = float(free_run.covariance[place, place])
    # with a singular information matrix the variance may be negative
    log_width = 2.0 * normal_quantile(CONFIDENCE) * math.sqrt(max(variance, 0.0))
    is_informative = 0.0 < variance and log_width <= math.log(OPEN_RATIO)
    return AlternativeEstimate(math.log(free_run.values[name]), variance) if is_informative else None


def _simulation(
    free_run: OutputError, free: AlternativeEstimate | None, name: str, scale: float, resolved: Resolved
) -> Interval:
    """The free run's estimate of a time constant."""
    value = free_run.values[name] * scale
    if free is None:
        return Interval(value, 0.0)
    low, high = free_run.bounds(name, positive=True)
    return Interval(value, *resolved.bounds(low * scale, high * scale))


def _disagree(bounds: Bounds, free_run: OutputError, name: str) -> bool:
    """Whether the estimates from the free run and from one-step predictions differ by more than their
    combined uncertainty."""
    low, high = free_run.bounds(name, positive=True)
    distance = abs(math.log(free_run.values[name] / bounds.value))
    half_width = (
        0.5 * math.log(max(bounds.upper / max(bounds.lower, 1e-9), 1.0 + 1e-9))
        if math.isfinite(bounds.upper)
        else 50.0
    )
    return distance > math.hypot(0.5 * math.log(max(high / low, 1.0 + 1e-9)), half_width)


def _form(form: FittedForm, name: str, scale: float, level: float, resolved: Resolved) -> FormEstimate:
    value = form.estimate.values[name] * scale
    half_width = normal_quantile(level) * math.sqrt(form.variance({name: 1.0}))
    return FormEstimate(value, *resolved.around(value, half_width), form.name, form.weight, form.gain)


def _parts_scatter(stage: Stage, name: str) -> float:
    """Ratio [1] of the scatter of the estimates from quarters of the readings to the scatter that their
    bounds predict."""
    if stage.uncertainty.place(name) is None or not len(stage.uncertainty.parts):
        return math.nan
    return math.sqrt(parts_scale(stage.uncertainty, name))


def by_simulation(entry: TimeConstant | None) -> TimeConstant | None:
    """The entry with the output-error estimate as its value; the maximum-likelihood estimate moves to the
    field `likelihood`."""
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
