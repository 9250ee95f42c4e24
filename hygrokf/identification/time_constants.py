"""The two time constants as reported: value, bounds, conditions, and contradicting evidence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hygrokf.estimation.confidence import Bounds, normal_quantile, parts_scale
from hygrokf.estimation.output_error import OutputError
from hygrokf.evaluation.simulation import measured
from hygrokf.identification.composition import (
    ANY,
    AlternativeEstimate,
    Resolved,
    compose_interval,
    of_forms,
    of_free_run,
    of_parts,
)
from hygrokf.identification.estimation import LEVEL, Stage
from hygrokf.identification.fit_results import (
    FormEstimate,
    MeanTemperatures,
    Sampling,
    SensorResponse,
    TimeConstant,
)
from hygrokf.identification.forms import FittedForm
from hygrokf.identification.verdict_terms import Interval
from hygrokf.modelling.design import TEMPERATURE
from hygrokf.modelling.inputs import Run
from hygrokf.modelling.thermal_system import thermal_poles
from hygrokf.physics.mechanisms.hygric import exchange_factor, hygric_time_constant
from hygrokf.physics.mechanisms.thermal import STILL_K, small_signal

THERMAL, HYGRIC = "thermal_time_constant", "hygric_k"
OPEN = 1e3
"""Ratio of the free run's bounds above which they are uninformative."""


def reference_temperatures(run: Run) -> tuple[float, float]:
    """Mean cabinet and ambient temperature [K] over the instants with a temperature reading (else all)."""
    known = measured(run)["temperature_K"]
    ambient = run.timeline.input("ambient_temperature")
    there = np.isfinite(known)
    if not there.any():
        return float(ambient.mean()), float(ambient.mean())
    return float(known[there].mean()), float(ambient[there].mean())


def thermal_entry(stage: Stage, simulated: Mapping[str, OutputError]) -> TimeConstant | None:
    """The thermal time constant of small changes at the median difference to the ambient, with R·C."""
    if THERMAL not in stage.bounds:
        return None
    entry = _entry(stage, THERMAL, 1.0, simulated)
    exponent = stage.estimate.values.get("convection_exponent", 0.0)
    quantiles = _differences_K(stage.run)
    courses = None
    if exponent > 0:
        at = dict(stage.base.mechanisms)["natural_convection"]["difference_K"]
        courses = tuple(small_signal(entry.value_h, exponent, at, d) for d in quantiles)
    return replace(
        entry,
        range_h=None if _unbounded(entry) else courses,
        difference_K=quantiles,
        resistance_capacity=_resistance_capacity(stage, entry, exponent),
        modes=tuple(thermal_poles(stage.base, stage.estimate.values)),
    )


def hygric_entry(stage: Stage, simulated: Mapping[str, OutputError]) -> TimeConstant | None:
    """The hygric time constant R_D*·V* at the record's mean temperatures."""
    if HYGRIC not in stage.bounds:
        return None
    cabinet, ambient = reference_temperatures(stage.run)
    scale = float(hygric_time_constant(1.0, cabinet, ambient))
    entry = _entry(stage, HYGRIC, scale, simulated)
    known = measured(stage.run)["temperature_K"]
    there = np.isfinite(known)
    factor = known[there] * exchange_factor(stage.run.timeline.input("ambient_temperature")[there])
    k = stage.estimate.values[HYGRIC]
    return replace(
        entry,
        mean_temperatures=MeanTemperatures(cabinet, ambient),
        range_h=(float(k / factor.max()), float(k / factor.min()))
        if there.any() and not _unbounded(entry)
        else None,
        response=_response(stage),
        modes=(entry.value_h,),
    )


def _differences_K(run: Run) -> tuple[float, ...]:
    """10, 50 and 90 % quantiles of the difference [K] between cabinet and ambient over the readings, at least
    `STILL_K`."""
    apart = measured(run)["temperature_K"] - run.timeline.input("ambient_temperature")
    apart = np.abs(apart[np.isfinite(apart)])
    return tuple(np.maximum(np.quantile(apart, (0.1, 0.5, 0.9)), STILL_K).tolist()) if len(apart) else ()


def _resistance_capacity(stage: Stage, entry: TimeConstant, exponent: float) -> Interval:
    """(R_AT+R_IC) C at the median difference, over all forms: (1+n) times the constant of small changes."""
    value = entry.value_h * (1.0 + exponent)
    sources = {one.source: one.sd_ln**2 for one in entry.composition[1:] if one.source != "forms"}
    variance = _variance(stage, THERMAL)
    if stage.forms:
        forms = []
        for form in stage.forms:
            n = form.estimate.values.get("convection_exponent", 0.0)
            spread = form.variance({THERMAL: 1.0, "convection_exponent": 1.0 / (1.0 + n)})
            forms.append(
                AlternativeEstimate(math.log(form.estimate.values[THERMAL] * (1.0 + n)), spread, form.weight)
            )
        if exponent > 0:
            variance = max(variance, max(forms, key=lambda form: form.weight).variance)
        sources["forms"] = of_forms(math.log(value), variance, forms)
    if _unbounded(entry):
        return Interval(value, 0.0)
    ends = ANY.around(value, normal_quantile(entry.level) * math.sqrt(variance))
    last = compose_interval(value, ends, entry.level, sources, _resolved(stage, THERMAL))[-1]
    return Interval(value, last.lower_h, last.upper_h)


def _response(stage: Stage) -> SensorResponse:
    """The humidity sensor's response time, which affects the constant: stated, included or estimated."""
    sensors = {name: settings for name, settings in stage.base.mechanisms if name.endswith("humidity_sensor")}
    settings = next(iter(sensors.values()), {})
    stated = settings.get("response_h", 0.0)
    if stated > 0:
        return SensorResponse("stated", 60.0 * stated)
    if settings.get("longest_response_h") is None:
        return SensorResponse("stated" if stage.response_stated else "included", 0.0)
    name = next(p for p in stage.estimate.values if p.endswith("_response"))
    value, variance = stage.estimate.values[name], _variance(stage, name)
    reach = normal_quantile(LEVEL) * math.sqrt(variance)
    return SensorResponse("estimated", 60.0 * value, *ANY.around(60.0 * value, reach))


def _unbounded(entry: TimeConstant) -> bool:
    return not (entry.lower_h > 0 or math.isfinite(entry.upper_h))


def _resolved(stage: Stage, name: str) -> Resolved:
    """The time constants [h] that a stage's readings and length can tell apart."""
    t = stage.run.timeline
    output = TEMPERATURE if name == THERMAL else stage.base.humidity
    steps = np.diff(t.time[np.isfinite(t.reading(output))]) if output in t.outputs else t.time[:0]
    shortest = 0.1 * float(np.median(steps)) if len(steps) else 0.0
    return Resolved(shortest, 10.0 * float(t.time[-1] - t.time[0]))


def _variance(stage: Stage, name: str) -> float:
    """Variance of a positive parameter's logarithm, by the wider of both covariances; 0 at a bound."""
    found = stage.uncertainty
    place = found.place(name)
    return 0.0 if place is None else float(found.wald[place, place] * found.factor[place])


def _entry(stage: Stage, name: str, scale: float, simulated: Mapping[str, OutputError]) -> TimeConstant:
    """What was found about one time constant; `scale` [h] per unit of its parameter."""
    b = stage.bounds[name]
    place = stage.uncertainty.place(name)
    factor = float(stage.uncertainty.factor[place]) if place is not None else 1.0
    other = simulated.get(name)
    free = _by_free_run(other, name)
    resolved, without = _resolved(stage, name), stage.without.get(name)
    sources = _sources(stage, name, free)
    value, low, high = (scale * one for one in (b.value, b.lower, b.upper))
    steps = compose_interval(value, (low, high), b.level, sources, resolved)
    shown = (steps[-1].lower_h, steps[-1].upper_h)
    if without is not None and not without.enough:
        shown = (0.0, math.nan)
    sampling = stage.sampling
    return TimeConstant(
        value_h=value,
        lower_h=shown[0],
        upper_h=shown[1],
        level=b.level,
        method="composed" if b.method == "profile" else b.method,
        composition=steps,
        forms=tuple(_form(form, name, scale, b.level, resolved) for form in stage.forms),
        parts_scatter=_parts_scatter(stage, name),
        limited_by=b.limited_by,
        factor=factor,
        threshold=factor * normal_quantile(b.level) ** 2,
        curve=np.array([[float(x) * scale, float(y)] for x, y in b.curve]).reshape(-1, 2),
        clock=stage.clock.sources or None,
        sampling=None if sampling is None else Sampling(sampling["step_h"], sampling[name]),
        simulation=None if other is None else _simulation(other, free, name, scale, resolved),
        criteria_disagree=other is not None and free is not None and _disagree(b, other, name),
        without_input=without,
    )


def _sources(stage: Stage, name: str, free: AlternativeEstimate | None) -> dict[str, float]:
    """The variances by which sources of uncertainty widen a profile's bounds."""
    place = stage.uncertainty.place(name)
    if place is None:
        return {}
    value, variance = math.log(stage.estimate.values[name]), _variance(stage, name)
    found = {"parts": of_parts(parts_scale(stage.uncertainty, name), variance)}
    if stage.forms:
        alternatives = [
            AlternativeEstimate(math.log(form.estimate.values[name]), form.variance({name: 1.0}), form.weight)
            for form in stage.forms
        ]
        found["forms"] = of_forms(value, variance, alternatives)
    if free is not None:
        found["free run"] = of_free_run(value, variance, free)
    if stage.clock.sources:
        factor = float(stage.uncertainty.factor[place])
        found["clocks"] = factor * stage.clock.variance[name] + stage.clock.shift[name] ** 2
    if stage.sampling is not None:
        found["sampling"] = stage.sampling[name] ** 2 / 3.0
    return found


def _by_free_run(found: OutputError | None, name: str) -> AlternativeEstimate | None:
    """The free run's own estimate; None where its bounds are uninformative."""
    if found is None or name not in found.names or name in found.at_bounds:
        return None
    place = found.names.index(name)
    variance = float(found.covariance[place, place])
    # a singular information matrix leaves a variance of any sign
    told = 0.0 < variance and 2.0 * normal_quantile(LEVEL) * math.sqrt(variance) <= math.log(OPEN)
    return AlternativeEstimate(math.log(found.values[name]), variance) if told else None


def _simulation(
    found: OutputError, free: AlternativeEstimate | None, name: str, scale: float, resolved: Resolved
) -> Interval:
    """The free run's estimate of a time constant."""
    value = found.values[name] * scale
    if free is None:
        return Interval(value, 0.0)
    low, high = found.bounds(name, positive=True)
    return Interval(value, *resolved.bounds(low * scale, high * scale))


def _disagree(b: Bounds, other: OutputError, name: str) -> bool:
    """Whether the free run and the one-step predictions are further apart than both uncertainties explain."""
    low, high = other.bounds(name, positive=True)
    apart = abs(math.log(other.values[name] / b.value))
    own = 0.5 * math.log(max(b.upper / max(b.lower, 1e-9), 1.0 + 1e-9)) if math.isfinite(b.upper) else 50.0
    return apart > math.hypot(0.5 * math.log(max(high / low, 1.0 + 1e-9)), own)


def _form(form: FittedForm, name: str, scale: float, level: float, resolved: Resolved) -> FormEstimate:
    value = form.estimate.values[name] * scale
    reach = normal_quantile(level) * math.sqrt(form.variance({name: 1.0}))
    return FormEstimate(value, *resolved.around(value, reach), form.name, form.weight, form.gain)


def _parts_scatter(stage: Stage, name: str) -> float:
    """Scatter [1] of the estimates from quarters of the readings against their bounds."""
    if stage.uncertainty.place(name) is None or not len(stage.uncertainty.parts):
        return math.nan
    return math.sqrt(parts_scale(stage.uncertainty, name))


def by_simulation(entry: TimeConstant | None) -> TimeConstant | None:
    """The entry with the output-error estimate as its value and the likelihood's as an addition."""
    if entry is None or entry.simulation is None:
        return entry
    free, without = entry.simulation, entry.without_input
    needed = without is None or without.enough
    return replace(
        entry,
        value_h=free.value_h,
        lower_h=free.lower_h if needed else 0.0,
        upper_h=free.upper_h if needed else math.nan,
        method="output error, sandwich",
        likelihood=Interval(entry.value_h, entry.lower_h, entry.upper_h),
    )
