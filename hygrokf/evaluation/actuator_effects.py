"""Effects of logged actuators on a cabinet, in kelvin and percent: the free run with and without each
actuator."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.data.actuators import Actuator, actuators
from hygrokf.data.structured import optional
from hygrokf.estimation.confidence import normal_quantile
from hygrokf.evaluation.simulation import QUANTITIES, free_run
from hygrokf.modelling.design import Design
from hygrokf.modelling.inputs import Run
from hygrokf.physics.parameters import Parameter
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import Name

LEVEL = 0.95


@dataclass(frozen=True)
class EstimatedChange:
    """The change of a quantity [its unit] with 95 % bounds, NaN where a parameter has no standard error."""

    value: float = math.nan
    lower: float = math.nan
    upper: float = math.nan


@dataclass(frozen=True)
class ActuatorEffect:
    """What a logged actuator changes in the cabinet while it is on.

    `used`: whether the model has it; `statement`: how it acts, or why it is left out; `on_share`: share of
    the time that it is on [1]; `changes`: by quantity, None where the model does not have it.
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
    mechanisms = {one.name: one for one in design.model.mechanisms}
    found = []
    for one in actuators(run.record):
        names = [pair[0] for pair in (one.thermal, one.hygric) if pair is not None and pair[0] in mechanisms]
        known = [
            p for name in names if one.signal in mechanisms[name].inputs for p in mechanisms[name].parameters
        ]
        share, changes = _effects(design, values, errors, run, one, known) if known else (math.nan, None)
        found.append(ActuatorEffect(one.signal, bool(known), one.statement, share, changes))
    return tuple(found)


def _effects(
    design: Design,
    values: Mapping[str, float],
    errors: Mapping[str, float],
    run: Run,
    one: Actuator,
    known: Sequence[Parameter],
) -> tuple[float, dict[str, EstimatedChange]]:
    """Share of the time that an actuator is on, and the changes that its parameters cause during that
    time."""
    step = np.diff(run.timeline.time, prepend=run.timeline.time[0])
    weight = np.where(run.timeline.input(one.signal) > one.half, step, 0.0)
    share = float(weight.sum() / max(step.sum(), 1e-9))
    if share == 0.0:
        return 0.0, {}

    def means(at: Mapping[str, float]) -> dict[str, float]:
        """Mean of each quantity while the actuator is on."""
        prediction = free_run(design, {**values, **at}, run)
        pairs = {name: prediction.of(name) for name in QUANTITIES}
        return {
            name: float(np.average(pair[0], weights=weight))
            for name, pair in pairs.items()
            if pair is not None
        }

    def moved(sign: float) -> dict[str, float]:
        return {
            p.name: min(
                max(values[p.name] + sign * normal_quantile(LEVEL) * errors[p.name], p.lower), p.upper
            )
            for p in known
        }

    without, now = means(dict.fromkeys((p.name for p in known), 0.0)), means({})
    bounded = all(math.isfinite(errors.get(p.name, math.nan)) for p in known)
    ends = [means(moved(sign)) for sign in (-1.0, 1.0)] if bounded else []
    changes = {}
    for name in now:
        # two parameters together need not act monotonically
        reached = [at[name] - without[name] for at in (now, *ends)]
        bounds = (min(reached), max(reached)) if ends else (math.nan, math.nan)
        changes[name] = EstimatedChange(reached[0], *bounds)
    return share, changes
