"""Whether a record needs the input through which a time constant acts.

A time constant is the memory between an input and a reading.  A record in which that input does not act
shows no such memory, and the estimate is then that of something else, such as of the disturbance, or of the
cabinet's temperature in a humidity that is regulated.  The fit is therefore compared with the models in which
the input does not act, the disturbances refitted in each:

- hygric: the vapour outside is its mean; or the humidity is held, so that the content follows
  φ v_sat(T_cab) at once, with its mean level φ;
- thermal: every input is its mean.

Twice its gain in ln L must exceed what chance gives to as many parameters as the fit has (χ², `CHANCE`).
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
from hygrokf.texts.fit import FitCode
from hygrokf.texts.statement import Statement

CHANCE = 1e-3
"""[1] probability with which chance alone gives the gain that is required."""
PASSES = 15
"""Scoring passes of a model without the input: from the fit's values most end after six."""
TOLERANCE = 0.5
"""Gain in ln L of a further step below which they end; what is required is some ten times as much."""
TRIED_DAYS = 10.0
"""[d] stretch of the record that is tried first: an input that is needed there is needed."""
STEP_TOLERANCE = 1e-4
"""[1] `tolerance` of these models' sub-steps: ln L is right to a few hundredths."""


@dataclass(frozen=True)
class WithoutInput:
    """The best `model` in which an input does not act: twice the `gain` in ln L by which the fit exceeds it,
    and the gain `required`."""

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
    whole, known = run.timeline, measured(run)
    inputs = {one: whole.input(one) for one in whole.varying}
    courses = whole.time, known["temperature_K"], known["absolute_humidity_g_m3"]
    others = list(alternatives(name, inputs, *courses))

    def best(count: int) -> WithoutInput:
        part = whole.window(0, count)
        own = Objective(Likelihood(model, part, tolerance=STEP_TOLERANCE), estimate.coordinates).value(
            estimate.z
        )
        found = []
        for code, inputs, fixed in others:
            timeline = part.with_inputs({name: value[:count] for name, value in inputs.items()})
            coordinates = Coordinates(model.parameters, fixed)
            objective = Objective(Likelihood(model, timeline, tolerance=STEP_TOLERANCE), coordinates)
            end = climb(objective, coordinates.start(estimate.values), PASSES, TOLERANCE)
            found.append(WithoutInput(code(), 2.0 * (own - end.objective), required))
        return min(found, key=lambda one: one.gain)

    tried = best(int(np.searchsorted(whole.time, whole.time[0] + 24.0 * TRIED_DAYS)))
    return tried if tried.enough else best(len(whole))


def alternatives(
    name: str, inputs: Mapping[str, np.ndarray], time_h: np.ndarray, warm: np.ndarray, vapour: np.ndarray
) -> Iterator[tuple[FitCode, dict[str, np.ndarray], dict[str, float]]]:
    """The models in which the input of a time constant does not act: code, inputs (T,), fixed parameters.

    inputs (T,) by name at times (T,) [h]; warm, vapour: (T,) the cabinet's readings [K], [g/m³], or NaN.
    """
    if name == "hygric_k":
        outside = inputs["ambient_absolute_humidity"]
        yield FitCode.CONSTANT_VAPOUR, {"ambient_absolute_humidity": _mean(outside)}, {}
        there, read = np.isfinite(warm), np.isfinite(vapour)
        if read.any():
            warm = np.interp(time_h, time_h[there], warm[there])
            saturated = 1e3 * absolute_humidity(1.0, warm)
            held = saturated * np.nanmean(vapour / saturated) * warm / inputs["ambient_temperature"]
            step = float(np.median(np.diff(time_h[read])))
            yield FitCode.HELD_HUMIDITY, {"ambient_absolute_humidity": held}, {name: 0.5 * step}
        return
    still = {one: _mean(value) for one, value in inputs.items()}
    if "exchange_factor" in inputs:  # a joint model: the vapour outside stays what it is
        vapour = inputs["ambient_absolute_humidity"] * inputs["ambient_temperature"]
        still["ambient_absolute_humidity"] = vapour / still["ambient_temperature"]
        still["exchange_factor"] = inputs["exchange_factor"]
    yield FitCode.CONSTANT_INPUTS, still, {}


def _mean(value: np.ndarray) -> np.ndarray:
    return np.full_like(value, value.mean())
