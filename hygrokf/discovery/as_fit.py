"""A set of parameters by simulation in the form of a `Fit`: for reports, climate, measures and the tracker.

Parameters and covariance are those of the set.  The filter that the file's other users run needs the sizes of
its own disturbances beside; these maximise its likelihood with everything else held.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from hygrokf.data.clocks import shifted
from hygrokf.data.progress import Progress
from hygrokf.data.record import Record
from hygrokf.discovery.final_set import FinalSet
from hygrokf.estimation.confidence import Uncertainty, wald_bounds
from hygrokf.estimation.likelihood import Likelihood, RatesFault
from hygrokf.estimation.optimiser import Estimate, Objective, climb
from hygrokf.identification.clock_offsets import clock_offsets
from hygrokf.identification.estimation import LEVEL, TIME_CONSTANTS, Stage
from hygrokf.identification.fit import Fit
from hygrokf.identification.needed_inputs import without_input
from hygrokf.identification.procedure import Basis, assemble_fit
from hygrokf.identification.steady_state import heat_release_regression
from hygrokf.identification.verdict import with_reasons, with_verdicts
from hygrokf.identification.verdict_terms import Reason
from hygrokf.modelling.design import CASCADE, Design
from hygrokf.modelling.inputs import prepare_run
from hygrokf.physics.parameters import Coordinates

RATE_STEP = 1.0
"""Largest product of a rate and a sub-step: coarser ones change the disturbances' sizes alone."""


def fit_of(
    record: Record, final: FinalSet, say: Progress = lambda text: None, against: Sequence[Reason] = ()
) -> Fit:
    """A final set as a fit of the record, whose clocks are corrected as the set says.

    against: reasons against the hygric constant, beside the fit's own.
    Raises ValueError where the set is faster than a filter of the readings can follow.
    """
    try:
        return _fit_of(record, final, say, against)
    except RatesFault as fault:
        raise ValueError(f"the model that the search ends with cannot be filtered: {fault}") from fault


def _fit_of(record: Record, final: FinalSet, say: Progress, against: Sequence[Reason]) -> Fit:
    record = shifted(record, *final.estimate.simulator.scene.shifts)
    early = record.identification()
    stages = tuple(_stage(early, one, final, say) for one in final_designs(final))
    basis = Basis(CASCADE, stages, (early,) * len(stages), heat_release_regression(early))
    fit = assemble_fit(record, basis, {}, say=say, rate_step=RATE_STEP)
    results = with_verdicts(replace(fit.results, criterion=final.estimator))
    return replace(fit, results=with_reasons(results, "hygric", against))


def final_designs(final: FinalSet) -> tuple[Design, ...]:
    """The designs of a set, whose controllers have the levels that were estimated."""
    values, simulator = final.estimate.values, final.estimate.simulator
    found = []
    for one in simulator.designs:
        features = dict(one.features)
        for name in set(features) & set(simulator.controls):
            levels = {"start": values[f"{name}_first"], "full": values[f"{name}_second"]}
            features[name] = {**features[name], **levels}
        found.append(replace(one, features=features))
    return tuple(found)


def _stage(early: Record, base: Design, final: FinalSet, say: Progress) -> Stage:
    """One likelihood at the set's values, with the set's covariance."""
    say("sizes of the disturbances")
    run = prepare_run(base, early)
    likelihood = Likelihood(base.model, run.timeline, rate_step=RATE_STEP)
    known = final.estimate.values
    held = {
        p.name: _inside(p.lower, p.upper, known[p.name]) for p in base.model.parameters if p.name in known
    }
    noise = Coordinates(base.model.parameters, held)
    found = climb(Objective(likelihood, noise), noise.start())
    values = {**noise.values(found.z)}
    coordinates = Coordinates(base.model.parameters, {n: values[n] for n in noise.names})
    estimate = Estimate(
        coordinates, coordinates.start(values), values, likelihood.value(values), found.objective,
        found.converged, found.message, tuple(n for n in final.at_bounds if n in held),
    )  # fmt: skip
    spread = _uncertainty(final, coordinates)
    bounds = {
        name: wald_bounds(estimate, spread, name, LEVEL)
        for name in TIME_CONSTANTS
        if name in coordinates.names
    }
    say("clocks, and models without the input")
    clock = clock_offsets(early, base, run, estimate, spread)
    stated = base.humidity is not None and early[base.humidity].response_time_s is not None
    without = {name: without_input(name, base.model, run, estimate) for name in bounds}
    return Stage(base, run, estimate, spread, bounds, clock, response_stated=stated, without=without)


def _inside(low: float, high: float, value: float) -> float:
    return min(max(value, low), high)


def _uncertainty(final: FinalSet, coordinates: Coordinates) -> Uncertainty:
    """The covariance of a stage's parameters; logarithms where the coordinate is one."""
    open_ = (*final.at_bounds, *final.flat)
    names = tuple(n for n in coordinates.names if n in final.names and n not in open_)
    place = [final.names.index(n) for n in names]
    values: Mapping[str, float] = final.estimate.values
    linear = final.estimate.linear
    as_logarithm = [coordinates.parameter(n).positive and n in linear for n in names]
    scale = np.array(
        [1.0 / max(values[n], 1e-300) if log else 1.0 for n, log in zip(names, as_logarithm, strict=True)]
    )
    covariance = final.covariance[np.ix_(place, place)] * np.outer(scale, scale)
    information = np.linalg.pinv(covariance)
    factor = np.ones(len(names))
    return Uncertainty(names, covariance, covariance, factor, final.flat, (), information)
