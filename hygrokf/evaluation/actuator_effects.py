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
    """The change of a quantity [its unit] with 95 % bounds, NaN where a parameter has no standard error."""

    value: float = math.nan
    lower: float = math.nan
    upper: float = math.nan


@dataclass(frozen=True)
class ActuatorEffect:
    """The change that a logged actuator causes in the cabinet while it is on.

    `used`: whether the model has the actuator; `statement`: how it acts, or why the model leaves it out;
    `on_share`: share of the time during which it is on [1]; `changes`: by quantity, None if it is not used.
    """

    signal: Name
    used: bool = False
    statement: Statement | None = None
    on_share: float = optional(math.nan)
    changes: Mapping[str, EstimatedChange] | None = optional()


def actuator_effects(
    design: Design, values: Mapping[str, float], errors: Mapping[str, float], run: Run
) -> tuple[ActuatorEffect, ...]:
    """The effect of each logged actuator [K, 1, g/m³], from free runs with and without it.

    The bounds come from free runs at the bounds of its parameters.
    """
    mechanisms = {mechanism.name: mechanism for mechanism in design.model.mechanisms}
    effects = []
    for actuator in actuators(run.record):
        names = [chosen[0] for chosen in (actuator.thermal, actuator.hygric) if chosen is not None]
        acting = [mechanisms[name] for name in names if name in mechanisms]
        parameters = [p for part in acting if actuator.signal in part.inputs for p in part.parameters]
        effect = ActuatorEffect(actuator.signal, bool(parameters), actuator.statement)
        if parameters:
            share, changes = _effects(design, values, errors, run, actuator, parameters)
            effect = replace(effect, on_share=share, changes=changes)
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
    """Share of time [1] during which an actuator is on, and the changes that its parameters cause then."""
    step = np.diff(run.timeline.time, prepend=run.timeline.time[0])
    weight = np.where(run.timeline.input(actuator.signal) > actuator.half, step, 0.0)
    share = float(weight.sum() / max(step.sum(), 1e-9))
    if share == 0.0:
        return 0.0, {}

    def means(changed: Mapping[str, float]) -> dict[str, float]:
        """Mean of each quantity while the actuator is on."""
        prediction = free_run(design, {**values, **changed}, run)
        pairs = {name: prediction.of(name) for name in QUANTITIES}
        return {
            name: float(np.average(pair[0], weights=weight))
            for name, pair in pairs.items()
            if pair is not None
        }

    def at_bound(sign: float) -> dict[str, float]:
        return {
            p.name: min(
                max(values[p.name] + sign * normal_quantile(CONFIDENCE) * errors[p.name], p.lower), p.upper
            )
            for p in parameters
        }

    without, actual = means(dict.fromkeys((p.name for p in parameters), 0.0)), means({})
    has_errors = all(math.isfinite(errors.get(p.name, math.nan)) for p in parameters)
    means_at_bounds = [means(at_bound(sign)) for sign in (-1.0, 1.0)] if has_errors else []
    changes = {}
    for name in actual:
        # two parameters together need not act monotonically
        differences = [with_actuator[name] - without[name] for with_actuator in (actual, *means_at_bounds)]
        bounds = (min(differences), max(differences)) if means_at_bounds else (math.nan, math.nan)
        changes[name] = EstimatedChange(differences[0], *bounds)
    return share, changes
