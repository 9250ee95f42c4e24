"""What logged actuators do to a cabinet, in kelvin and percent: the model's free run with each of them and without."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from hygrokf.data.actuators import Actuator, actuators
from hygrokf.data.record import Record
from hygrokf.estimation.confidence import normal_quantile
from hygrokf.evaluation.simulation import QUANTITIES, simulate
from hygrokf.modelling.design import Design
from hygrokf.modelling.inputs import Run
from hygrokf.physics.parameters import Parameter

LEVEL = 0.95


def actuator_effects(
    design: Design, values: Mapping[str, float], errors: Mapping[str, float], made: Run, record: Record
) -> list[dict]:
    """One entry for each logged actuator of a record, as plain data.

    `errors` standard errors of the parameters, in their units; `made` the run of the design on the record.  The effect of
    an actuator is the mean, over the time that it is above half of its span, of the free run less the free run with its
    parameters at 0: `changes` quantity → value and 95 % bounds [K], [1], [g/m³], from free runs at the parameters' own
    bounds; None where a parameter has no standard error.
    """
    mechanisms = {one.name: one for one in design.model.mechanisms}
    found = []
    for one in actuators(record):
        names = [pair[0] for pair in (one.thermal, one.hygric) if pair is not None and pair[0] in mechanisms]
        known = [
            p for name in names if one.signal in mechanisms[name].inputs for p in mechanisms[name].parameters
        ]
        entry: dict = {
            "signal": one.signal,
            "used": bool(known),
            "statement": one.statement,
            "parameters": [p.name for p in known],
        }
        if known:
            entry |= _effects(design, values, errors, made, one, known)
        found.append(entry)
    return found


def _effects(
    design: Design,
    values: Mapping[str, float],
    errors: Mapping[str, float],
    made: Run,
    one: Actuator,
    known: Sequence[Parameter],
) -> dict:
    """Share of the time that an actuator is on, and what its parameters change then."""
    step = np.diff(made.timeline.time, prepend=made.timeline.time[0])
    weight = np.where(made.timeline.input(one.signal) > one.half, step, 0.0)
    share = float(weight.sum() / max(step.sum(), 1e-9))
    if share == 0.0:
        return {"on_share": 0.0, "changes": {}}

    def means(at: Mapping[str, float]) -> dict[str, float]:
        """Mean of each quantity while it is on."""
        run = simulate(design, {**values, **at}, made)
        pairs = {name: run.of(name) for name in QUANTITIES}
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
        reached = [
            at[name] - without[name] for at in (now, *ends)
        ]  # two parameters at once need not act monotonically
        changes[name] = {
            "value": reached[0],
            "lower": min(reached) if ends else None,
            "upper": max(reached) if ends else None,
        }
    return {"on_share": share, "changes": changes}
