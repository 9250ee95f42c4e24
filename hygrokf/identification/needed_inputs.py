"""Whether a record needs the input through which a time constant acts.

A time constant describes how a reading follows an input.  If the input does not act in a record, the estimate
describes something else: the disturbance, or the cabinet's temperature where the humidity is regulated.  The
fit is therefore compared with models in which the input does not act, with their disturbances refitted:

- hygric: the ambient vapour is constant at its mean; or the relative humidity is regulated to its mean φ, so
  that the vapour content follows φ v_sat(T_cab) without delay;
- thermal: every input is constant at its mean.

Twice the gain of the fit in ln L must exceed the χ² quantile of the fit's number of parameters (`CHANCE`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Estimate, Objective, climb
from hygrokf.evaluation.simulation import measured
from hygrokf.modelling.inputs import Run
from hygrokf.physics.model import Model
from hygrokf.physics.parameters import Coordinates
from hygrokf.physics.psychrometrics import absolute_humidity
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.statement import Statement

CHANCE = 1e-3
"""[1] probability that chance alone gives the required gain."""
WITHOUT_INPUT_PASSES = 15
"""Scoring passes of a model without the input: from the fit's values most end after six."""
WITHOUT_INPUT_TOLERANCE = 0.5
"""Expected gain in ln L below which scoring ends: about a tenth of the required gain."""
TRIED_DAYS = 10.0
"""[d] first stretch of the record, tried alone at first: an input that is needed there is needed in all."""
WITHOUT_INPUT_STEP_TOLERANCE = 1e-4
"""[1] `tolerance` of these models' sub-steps: the error of ln L is a few hundredths."""


@dataclass(frozen=True)
class WithoutInput:
    """The best `model` in which an input does not act; `gain`: twice the ln L of the fit minus that of the
    model; `required`: the least gain with which the fit needs the input."""

    model: Statement
    gain: float = math.nan
    required: float = math.nan

    @property
    def enough(self) -> bool:
        """Whether the fit needs the input."""
        return self.gain > self.required


def without_input(name: str, model: Model, run: Run, estimate: Estimate) -> WithoutInput:
    """The best model in which the input of a time constant does not act.

    name: "thermal_time_constant" or "hygric_k".  model, run, estimate: of the fit.
    """
    from scipy.special import chdtri

    required = float(chdtri(len(estimate.z), CHANCE))
    timeline, readings = run.timeline, measured(run)
    inputs = {signal: timeline.input(signal) for signal in timeline.varying}
    time_and_readings = timeline.time, readings["temperature_K"], readings["absolute_humidity_g_m3"]
    models = list(alternatives(name, inputs, *time_and_readings))

    def best(count: int) -> WithoutInput:
        window = timeline.window(0, count)
        fit_objective = Objective(
            Likelihood(model, window, tolerance=WITHOUT_INPUT_STEP_TOLERANCE), estimate.coordinates
        ).value(estimate.z)
        without = []
        for code, inputs, fixed in models:
            without_it = window.with_inputs({name: value[:count] for name, value in inputs.items()})
            coordinates = Coordinates(model.parameters, fixed)
            objective = Objective(
                Likelihood(model, without_it, tolerance=WITHOUT_INPUT_STEP_TOLERANCE), coordinates
            )
            end = climb(
                objective, coordinates.start(estimate.values), WITHOUT_INPUT_PASSES, WITHOUT_INPUT_TOLERANCE
            )
            without.append(WithoutInput(code(), 2.0 * (fit_objective - end.objective), required))
        return min(without, key=lambda result: result.gain)

    on_short = best(int(np.searchsorted(timeline.time, timeline.time[0] + 24.0 * TRIED_DAYS)))
    return on_short if on_short.enough else best(len(timeline))


def alternatives(
    name: str, inputs: Mapping[str, np.ndarray], time_h: np.ndarray, cabinet_K: np.ndarray, vapour: np.ndarray
) -> Iterator[tuple[FitCode, dict[str, np.ndarray], dict[str, float]]]:
    """The models in which the input of a time constant does not act: code, inputs (T,), fixed parameters.

    inputs (T,) by name at times (T,) [h]; cabinet_K, vapour: (T,) the cabinet's readings [K], [g/m³], or NaN.
    """
    if name == "hygric_k":
        outside = inputs["ambient_absolute_humidity"]
        yield FitCode.CONSTANT_VAPOUR, {"ambient_absolute_humidity": _mean(outside)}, {}
        is_warm_known, is_vapour_known = np.isfinite(cabinet_K), np.isfinite(vapour)
        if is_vapour_known.any():
            cabinet_K = np.interp(time_h, time_h[is_warm_known], cabinet_K[is_warm_known])
            saturated = 1e3 * absolute_humidity(1.0, cabinet_K)
            regulated = saturated * np.nanmean(vapour / saturated) * cabinet_K / inputs["ambient_temperature"]
            step = float(np.median(np.diff(time_h[is_vapour_known])))
            yield FitCode.HELD_HUMIDITY, {"ambient_absolute_humidity": regulated}, {name: 0.5 * step}
        return
    means = {signal: _mean(value) for signal, value in inputs.items()}
    if "exchange_factor" in inputs:  # a joint model: the ambient vapour stays as it is
        vapour = inputs["ambient_absolute_humidity"] * inputs["ambient_temperature"]
        means["ambient_absolute_humidity"] = vapour / means["ambient_temperature"]
        means["exchange_factor"] = inputs["exchange_factor"]
    yield FitCode.CONSTANT_INPUTS, means, {}


def _mean(value: np.ndarray) -> np.ndarray:
    return np.full_like(value, value.mean())
