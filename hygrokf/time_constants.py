"""The two time constants as they are reported: value, bounds, where they hold, and what speaks against them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from hygrokf.confidence import Bounds, normal_quantile
from hygrokf.drivers import Run
from hygrokf.mechanisms.hygric import exchange_factor, hygric_time_constant
from hygrokf.output_error import OutputError
from hygrokf.simulation import measured
from hygrokf.stage import Stage
from hygrokf.thermal import thermal_poles


def reference_temperatures(run_: Run) -> tuple[float, float]:
    """Mean cabinet and ambient temperature [K] over the instants with a temperature reading (else all)."""
    known = measured(run_)["temperature_K"]
    ambient = run_.timeline.input("ambient_temperature")
    there = np.isfinite(known)
    if not there.any():
        return float(ambient.mean()), float(ambient.mean())
    return float(known[there].mean()), float(ambient[there].mean())


def thermal_entry(stage: Stage, simulated: Mapping[str, OutputError]) -> dict | None:
    if "thermal_time_constant" not in stage.bounds:
        return None
    entry = _entry(stage, "thermal_time_constant", 1.0, simulated)
    entry["reference"] = "(R_AT+R_IC) C"
    entry["modes"] = thermal_poles(stage.base, stage.estimate.values)
    return entry


def hygric_entry(stage: Stage, simulated: Mapping[str, OutputError]) -> dict | None:
    if "hygric_k" not in stage.bounds:
        return None
    cabinet, ambient = reference_temperatures(stage.run)
    scale = float(hygric_time_constant(1.0, cabinet, ambient))
    entry = _entry(stage, "hygric_k", scale, simulated)
    entry["reference"] = {
        "definition": "R_D*·V* = k (273 K)^1.8 / (T_conv,a T_amb^0.8)",
        "cabinet_temperature_K": cabinet,
        "ambient_temperature_K": ambient,
    }
    known = measured(stage.run)["temperature_K"]
    there = np.isfinite(known)
    factor = known[there] * exchange_factor(stage.run.timeline.input("ambient_temperature")[there])
    k = stage.estimate.values["hygric_k"]
    entry["range_h"] = [float(k / factor.max()), float(k / factor.min())] if there.any() else None
    entry["modes"] = [entry["value_h"]]
    return entry


def _entry(stage: Stage, name: str, scale: float, simulated: Mapping[str, OutputError]) -> dict:
    b = stage.bounds[name]
    lower, upper, clock = _with_clock(stage, name, b)
    place = stage.uncertainty.place(name)
    factor = float(stage.uncertainty.factor[place]) if place is not None else 1.0
    entry = {
        "value_h": b.value * scale,
        "lower_h": lower * scale,
        "upper_h": None if math.isinf(upper) else upper * scale,
        "level": b.level,
        "method": b.method + (" with clock uncertainty" if clock else ""),
        "statement": re.sub(r"^([≤≥] \S+ h)\b", r"\1 at 273 K", b.statement)
        if name == "hygric_k"
        else b.statement,
        "limited_by": [asdict(limit) for limit in b.limited_by],
        "factor": factor,
        "threshold": factor * normal_quantile(b.level) ** 2,
        "curve": [[float(x) * scale, float(y)] for x, y in b.curve],
        "clock": clock or None,
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
        low, high = other.bounds(name, positive=True)
        value = other.values[name]
        if not high <= 1e3 * low:
            entry["simulation"] = {"value_h": value * scale, "lower_h": 0.0, "upper_h": None}
            entry["simulation"]["statement"] = "not identifiable from the free run"
            return entry
        entry["simulation"] = {"value_h": value * scale, "lower_h": low * scale, "upper_h": high * scale}
        apart = abs(math.log(value / b.value))
        reach = math.hypot(
            0.5 * math.log(max(high / low, 1.0 + 1e-9)),
            0.5 * math.log(max(upper / max(lower, 1e-9), 1.0 + 1e-9)) if math.isfinite(upper) else 50.0,
        )
        if apart > reach:
            entry["disagreement"] = (
                f"innovations say {b.value * scale:.3g} h, the free run says {value * scale:.3g} h "
                f"({low * scale:.3g} … {high * scale:.3g}): more than both uncertainties explain; "
                "the model lacks something"
            )
    return entry


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


def _with_clock(stage: Stage, name: str, b: Bounds) -> tuple[float, float, dict]:
    """Bounds widened by the stated uncertainty of the clocks, in quadrature on the logarithm."""
    variance, clock = 0.0, {}
    for key, shift in stage.clock.items():
        low, high = shift[name]
        variance += (0.5 * math.log(high / low)) ** 2
        clock[key] = {"uncertainty_s": shift["clock_uncertainty_s"], "shift_ln": 0.5 * math.log(high / low)}
    if not clock or b.lower <= 0 or math.isinf(b.upper):
        return b.lower, b.upper, clock
    extra = normal_quantile(b.level) * math.sqrt(variance)
    down, up = (
        math.hypot(math.log(b.value / b.lower), extra),
        math.hypot(math.log(b.upper / b.value), extra),
    )
    return b.value * math.exp(-down), b.value * math.exp(up), clock
