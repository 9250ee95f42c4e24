"""The two time constants as they are reported: value, bounds, where they hold, and what speaks against them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from hygrokf.estimation.confidence import Bounds, normal_quantile, parts_scale
from hygrokf.estimation.output_error import OutputError
from hygrokf.evaluation.simulation import measured
from hygrokf.identification.composition import (
    Alternative,
    Source,
    composed,
    from_clocks,
    from_forms,
    from_free_run,
    from_parts,
    from_sampling,
)
from hygrokf.identification.estimation import LEVEL, Stage
from hygrokf.identification.forms import Form
from hygrokf.modelling.inputs import Run
from hygrokf.modelling.thermal_system import thermal_poles
from hygrokf.physics.mechanisms.hygric import exchange_factor, hygric_time_constant
from hygrokf.physics.mechanisms.thermal import STILL_K, small_signal

THERMAL, HYGRIC = "thermal_time_constant", "hygric_k"
OPEN = 1e3
"""Ratio of the free run's bounds above which they say nothing."""


def reference_temperatures(run_: Run) -> tuple[float, float]:
    """Mean cabinet and ambient temperature [K] over the instants with a temperature reading (else all)."""
    known = measured(run_)["temperature_K"]
    ambient = run_.timeline.input("ambient_temperature")
    there = np.isfinite(known)
    if not there.any():
        return float(ambient.mean()), float(ambient.mean())
    return float(known[there].mean()), float(ambient[there].mean())


def thermal_entry(stage: Stage, simulated: Mapping[str, OutputError]) -> dict | None:
    """The thermal time constant: that of small changes at the median difference to the ambient, and R·C beside it."""
    if THERMAL not in stage.bounds:
        return None
    entry = _entry(stage, THERMAL, 1.0, simulated)
    exponent = stage.estimate.values.get("convection_exponent", 0.0)
    quantiles = _differences_K(stage.run)
    entry["reference"] = "(R_AT+R_IC) C"
    if exponent > 0:
        at = dict(stage.base.mechanisms)["natural_convection"]["difference_K"]
        entry["reference"] = (
            f"small changes at {at:.1f} K above the ambient; (R_AT+R_IC) C is {1.0 + exponent:.2f} times as much there"
        )
        entry["range_h"] = [small_signal(entry["value_h"], exponent, at, d) for d in quantiles]
    entry["difference_K"] = quantiles
    entry["resistance_capacity"] = _resistance_capacity(stage, entry, exponent)
    entry["modes"] = thermal_poles(stage.base, stage.estimate.values)
    return entry


def hygric_entry(stage: Stage, simulated: Mapping[str, OutputError]) -> dict | None:
    """The hygric time constant R_D*·V* at the record's mean temperatures."""
    if HYGRIC not in stage.bounds:
        return None
    cabinet, ambient = reference_temperatures(stage.run)
    scale = float(hygric_time_constant(1.0, cabinet, ambient))
    entry = _entry(stage, HYGRIC, scale, simulated)
    entry["reference"] = {
        "definition": "R_D*·V* = k (273 K)^1.8 / (T_conv,a T_amb^0.8)",
        "cabinet_temperature_K": cabinet,
        "ambient_temperature_K": ambient,
    }
    known = measured(stage.run)["temperature_K"]
    there = np.isfinite(known)
    factor = known[there] * exchange_factor(stage.run.timeline.input("ambient_temperature")[there])
    k = stage.estimate.values[HYGRIC]
    entry["range_h"] = [float(k / factor.max()), float(k / factor.min())] if there.any() else None
    entry["response"] = _response(stage)
    entry["modes"] = [entry["value_h"]]
    return entry


def _differences_K(run_: Run) -> list[float]:
    """10, 50 and 90 % of the difference [K] between cabinet and ambient over the readings, `STILL_K` at least."""
    apart = measured(run_)["temperature_K"] - run_.timeline.input("ambient_temperature")
    apart = np.abs(apart[np.isfinite(apart)])
    return np.maximum(np.quantile(apart, (0.1, 0.5, 0.9)), STILL_K).tolist() if len(apart) else []


def _resistance_capacity(stage: Stage, entry: Mapping, exponent: float) -> dict:
    """(R_AT+R_IC) C at the median difference: (1+n) times the constant of small changes, over all forms."""
    value = entry["value_h"] * (1.0 + exponent)
    forms = [
        Alternative(
            form.name,
            math.log(form.estimate.values[THERMAL] * (1.0 + n)),
            form.variance({THERMAL: 1.0, "convection_exponent": 1.0 / (1.0 + n)}),
            form.weight,
        )
        for form in stage.forms
        for n in [form.estimate.values.get("convection_exponent", 0.0)]
    ]
    others = [Source(one["source"], one["sd_ln"] ** 2, "") for one in entry["composition"][1:]]
    chosen = max(forms, key=lambda form: form.weight) if forms else None
    own = _variance(stage, THERMAL)
    if chosen is not None and exponent > 0:
        own = max(own, chosen.variance)
    kept = [source for source in others if source.name != "forms"]
    whole = composed(
        value,
        value * math.exp(-normal_quantile(entry["level"]) * math.sqrt(own)),
        value * math.exp(normal_quantile(entry["level"]) * math.sqrt(own)),
        entry["level"],
        [*kept, from_forms(math.log(value), own, forms)] if forms else kept,
    )
    return {"value_h": value, "lower_h": whole.lower, "upper_h": _closed(whole.upper), "exponent": exponent}


def _response(stage: Stage) -> dict:
    """What the humidity sensor's response has to do with the constant."""
    sensors = {name: settings for name, settings in stage.base.mechanisms if name.endswith("humidity_sensor")}
    settings = next(iter(sensors.values()), {})
    stated = settings.get("response_h", 0.0)
    if stated > 0:
        return {"kind": "stated", "minutes": 60.0 * stated}
    if settings.get("longest_response_h") is None:
        return {"kind": "stated" if stage.response_stated else "included", "minutes": 0.0}
    name = next(p for p in stage.estimate.values if p.endswith("_response"))
    value, variance = stage.estimate.values[name], _variance(stage, name)
    reach = normal_quantile(LEVEL) * math.sqrt(variance)
    return {
        "kind": "estimated",
        "minutes": 60.0 * value,
        "lower_minutes": 60.0 * value * math.exp(-reach),
        "upper_minutes": 60.0 * value * math.exp(reach),
    }


def _variance(stage: Stage, name: str) -> float:
    """Variance of a positive parameter's logarithm, by the wider of both covariances; 0 at a bound."""
    found = stage.uncertainty
    place = found.place(name)
    return 0.0 if place is None else float(found.wald[place, place] * found.factor[place])


def _closed(upper: float) -> float | None:
    return None if math.isinf(upper) else upper


def _entry(stage: Stage, name: str, scale: float, simulated: Mapping[str, OutputError]) -> dict:
    b = stage.bounds[name]
    place = stage.uncertainty.place(name)
    factor = float(stage.uncertainty.factor[place]) if place is not None else 1.0
    statement = b.statement
    if name == HYGRIC:
        statement = re.sub(r"^([≤≥] \S+ h)\b", r"\1 at 273 K", statement)
    free = _by_free_run(simulated.get(name), name)
    whole = composed(b.value, b.lower, b.upper, b.level, _sources(stage, name, free))
    entry = {
        "value_h": b.value * scale,
        "lower_h": whole.lower * scale,
        "upper_h": _closed(whole.upper * scale),
        "level": b.level,
        "method": "composed" if b.method == "profile" else b.method,
        "statement": statement,
        "profile": {
            "value_h": b.value * scale,
            "lower_h": b.lower * scale,
            "upper_h": _closed(b.upper * scale),
            "method": b.method,
            "statement": statement,
        },
        "composition": [
            {**row, "lower_h": row["lower_h"] * scale, "upper_h": row["upper_h"] and row["upper_h"] * scale}
            for row in whole.to_json()
        ],
        "forms": [_form(form, name, scale, b.level) for form in stage.forms],
        "parts": _parts(stage, name, scale),
        "limited_by": [asdict(limit) for limit in b.limited_by],
        "factor": factor,
        "threshold": factor * normal_quantile(b.level) ** 2,
        "curve": [[float(x) * scale, float(y)] for x, y in b.curve],
        "clock": [asdict(one) for one in stage.clock.sources] or None,
        "sampling": None,
        "simulation": None,
        "disagreement": None,
    }
    if stage.sampling is not None:
        entry["sampling"] = {
            "ambient_step_h": stage.sampling["step_h"],
            "shift_ln_when_halved": stage.sampling[name],
        }
    other = simulated.get(name)
    if other is not None:
        entry |= _beside(b, other, free, name, scale)
    return entry


def _sources(stage: Stage, name: str, free: Alternative | None) -> list[Source]:
    """What adds to a profile's bounds."""
    value = math.log(stage.estimate.values[name])
    variance = _variance(stage, name)
    if stage.uncertainty.place(name) is None:
        return []
    found = [from_parts(parts_scale(stage.uncertainty, name), variance)]
    if stage.forms:
        alternatives = [
            Alternative(
                form.name,
                math.log(form.estimate.values[name]),
                form.variance({name: 1.0}),
                form.weight,
            )
            for form in stage.forms
        ]
        found.append(from_forms(value, variance, alternatives))
    if free is not None:
        found.append(from_free_run(value, variance, free))
    if stage.clock.sources:
        factor = float(stage.uncertainty.factor[stage.uncertainty.place(name)])
        said = ", ".join(
            f"{one.source or 'its source'} {one.offset_s:+.0f} ± {one.sd_s:.0f} s late"
            for one in stage.clock.sources
        )
        found.append(from_clocks(factor * stage.clock.variance[name], stage.clock.shift[name], said))
    if stage.sampling is not None:
        found.append(from_sampling(stage.sampling[name], stage.sampling["step_h"]))
    return found


def _by_free_run(found: OutputError | None, name: str) -> Alternative | None:
    """The free run's own estimate; None where it bounds nothing."""
    if found is None or name not in found.names or name in found.at_bounds:
        return None
    place = found.names.index(name)
    variance = float(found.covariance[place, place])
    wide = 2.0 * normal_quantile(LEVEL) * math.sqrt(variance) > math.log(OPEN)
    return None if wide else Alternative("free run", math.log(found.values[name]), variance)


def _beside(b: Bounds, other: OutputError, free: Alternative | None, name: str, scale: float) -> dict:
    """The free run's estimate beside the likelihood's, and whether they contradict each other."""
    value = other.values[name]
    if free is None:
        said = {"value_h": value * scale, "lower_h": 0.0, "upper_h": None}
        return {"simulation": {**said, "statement": "not identifiable from the free run"}}
    low, high = other.bounds(name, positive=True)
    found: dict = {"simulation": {"value_h": value * scale, "lower_h": low * scale, "upper_h": high * scale}}
    apart = abs(math.log(value / b.value))
    own = 0.5 * math.log(max(b.upper / max(b.lower, 1e-9), 1.0 + 1e-9)) if math.isfinite(b.upper) else 50.0
    if apart > math.hypot(0.5 * math.log(max(high / low, 1.0 + 1e-9)), own):
        found["disagreement"] = (
            f"innovations say {b.value * scale:.3g} h, the free run says {value * scale:.3g} h "
            f"({low * scale:.3g} … {high * scale:.3g}): more than both uncertainties explain; "
            "the model lacks something"
        )
    return found


def _form(form: Form, name: str, scale: float, level: float) -> dict:
    value = form.estimate.values[name] * scale
    reach = normal_quantile(level) * math.sqrt(form.variance({name: 1.0}))
    return {
        "form": form.name,
        "weight": form.weight,
        "gain": form.gain,
        "value_h": value,
        "lower_h": value * math.exp(-reach),
        "upper_h": value * math.exp(reach),
    }


def _parts(stage: Stage, name: str, scale: float) -> dict | None:
    """The constant that each quarter of the readings alone would give [h], to first order, and how much they scatter."""
    place = stage.uncertainty.place(name)
    if place is None or not len(stage.uncertainty.parts):
        return None
    value = stage.estimate.values[name] * scale
    return {
        "value_h": (value * np.exp(np.clip(stage.uncertainty.parts[:, place], -5.0, 5.0))).tolist(),
        "scale": math.sqrt(parts_scale(stage.uncertainty, name)),
    }


def by_simulation(entry: dict | None) -> dict | None:
    """The entry with the output-error estimate in front and the innovations' beside it."""
    if entry is None or entry["simulation"] is None:
        return entry
    keys = ("value_h", "lower_h", "upper_h")
    return {
        **entry,
        "statement": "",
        **entry["simulation"],
        "method": "output error, sandwich",
        "likelihood": {key: entry[key] for key in (*keys, "method")},
    }
