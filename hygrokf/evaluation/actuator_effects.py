"""Effects of logged actuators on a cabinet, in kelvin and percent: the free run with and without each
actuator."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.actuators import Actuator, actuators
from hygrokf.data.structured import optional
from hygrokf.estimation.confidence import normal_quantile
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.evaluation.simulation import QUANTITIES, free_run
from hygrokf.modelling.design import Design
from hygrokf.modelling.inputs import Run
from hygrokf.physics.parameters import Parameter
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import Name


@dataclass(frozen=True)
class EstimatedChange:
    """The change of a quantity [its unit] with 95 % bounds; they are NaN if a parameter has no standard
    error."""

    value: float = math.nan
    lower: float = math.nan
    upper: float = math.nan


@dataclass(frozen=True)
class ActuatorEffect:
    """What a logged actuator changes in the cabinet while it is on.

    `used`: whether the model has the actuator.  `statement`: how it acts, or why the model leaves it out.
    `on_share`: share of the time [1] during which it is on.  `changes`: by quantity; None if it is not used.
    """

    signal: Name
    used: bool = False
    statement: Statement | None = None
    on_share: float = optional(math.nan)
    changes: Mapping[str, EstimatedChange] | None = optional()


def actuator_effects(
    design: Design, values: Mapping[str, float], errors: Mapping[str, float], run: Run
) -> tuple[ActuatorEffect, ...]:
    """Return the effect of each logged actuator on temperature and humidity [K, 1, g/m³].

    values, errors: the model's parameters and their standard errors.  The effect is the difference between
        free runs with and without the actuator; its bounds come from free runs at the bounds of the
        actuator's parameters.
    """
    mechanisms = {mechanism.name: mechanism for mechanism in design.model.mechanisms}
    effects = []
    for actuator in actuators(run.record):
        names = [
            mechanism_and_settings[0]
            for mechanism_and_settings in (actuator.thermal, actuator.hygric)
            if mechanism_and_settings is not None
        ]
        used_mechanisms = [mechanisms[name] for name in names if name in mechanisms]
        parameters = [
            parameter
            for mechanism_used in used_mechanisms
            if actuator.signal in mechanism_used.inputs
            for parameter in mechanism_used.parameters
        ]
        effect = ActuatorEffect(actuator.signal, bool(parameters), actuator.statement)
        if parameters:
            on_share, changes = _effects(design, values, errors, run, actuator, parameters)
            effect = replace(effect, on_share=on_share, changes=changes)
        effects.append(effect)
    return tuple(effects)


def _effects(
    design: Design,
    values: Mapping[str, float],
    errors: Mapping[str, float],
    run: Run,
    actuator: Actuator,
    parameters: Sequence[Parameter],
) -> tuple[float, dict[str, EstimatedChange]]:
    """Return the share of time [1] during which an actuator is on, and the mean changes by quantity while it
    is on.

    parameters: those of the actuator's mechanisms; with all of them at 0 it has no effect.
    """
    step = np.diff(run.timeline.time, prepend=run.timeline.time[0])
    weight = np.where(run.timeline.input(actuator.signal) > actuator.half, step, 0.0)
    on_share = float(weight.sum() / max(step.sum(), 1e-9))
    if on_share == 0.0:
        return 0.0, {}

    def means(changed: Mapping[str, float]) -> dict[str, float]:
        """Simulate with some parameters changed; return the mean of each quantity while the actuator is
        on."""
        prediction = free_run(design, {**values, **changed}, run)
        predicted = {name: prediction.of(name) for name in QUANTITIES}
        return {
            name: float(np.average(value_and_sd[0], weights=weight))
            for name, value_and_sd in predicted.items()
            if value_and_sd is not None
        }

    def at_bound(sign: float) -> dict[str, float]:
        """Return the actuator's parameters at their lower (sign −1) or upper (sign 1) bound."""
        return {
            parameter.name: min(
                max(
                    values[parameter.name] + sign * normal_quantile(CONFIDENCE) * errors[parameter.name],
                    parameter.lower,
                ),
                parameter.upper,
            )
            for parameter in parameters
        }

    means_without, means_with = means(dict.fromkeys((p.name for p in parameters), 0.0)), means({})
    has_errors = all(math.isfinite(errors.get(p.name, math.nan)) for p in parameters)
    means_at_bounds = [means(at_bound(sign)) for sign in (-1.0, 1.0)] if has_errors else []
    changes = {}
    for name in means_with:
        # two parameters together need not act monotonically
        differences = [
            with_actuator[name] - means_without[name] for with_actuator in (means_with, *means_at_bounds)
        ]
        bounds = (min(differences), max(differences)) if means_at_bounds else (math.nan, math.nan)
        changes[name] = EstimatedChange(differences[0], *bounds)
    return on_share, changes
