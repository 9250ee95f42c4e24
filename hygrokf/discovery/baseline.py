"""What all candidates of causes share: a record, its two submodels at their maxima, and the time that
candidates may take."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hygrokf.data.progress import Progress
from hygrokf.data.record import Record
from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.submodel import HYGRIC, THERMAL, Submodel, search_likelihood, submodel_of, temper
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Objective, climb
from hygrokf.identification.estimation import estimate_design, select_form, smoothed_temperature
from hygrokf.identification.steady_state import heat_release_regression
from hygrokf.modelling.design import CASCADE, Design, design, extended
from hygrokf.modelling.inputs import prepare_run
from hygrokf.physics.model import Model
from hygrokf.physics.parameters import Coordinates

SECONDS = 120.0
"""[s] time of a discovery where none is stated."""
FOR_CANDIDATES = 0.6
"""[1] share of it for candidates; the rest is for the final estimates and the held-out period."""
SCOUTED = 4
"""Starts that are followed for a few passes; of more starts, those with the largest likelihood."""
WANDERS_H = 24.0
"""[h] memory from which a disturbance may stand for a lasting effect."""
HOPE = 0.3
"""ln L that a mechanism's own parameters must gain by themselves for all parameters to be estimated with
it."""


class BudgetSpent(Exception):
    """The time for candidates is over."""


class Budget:
    """Wall-clock time from now on, `seconds` in all; infinite for results that do not depend on the
    machine."""

    def __init__(self, seconds: float = math.inf) -> None:
        if not seconds > 0.0:
            raise ValueError(f"budget: expected seconds above 0, found {seconds}")
        self._until = time.monotonic() + FOR_CANDIDATES * seconds

    @property
    def spent(self) -> bool:
        """Whether the time for candidates is over."""
        return time.monotonic() > self._until

    def check(self) -> None:
        """Raise BudgetSpent where the time for candidates is over."""
        if self.spent:
            raise BudgetSpent


@dataclass(frozen=True)
class Baseline:
    """The identification period of a record, its submodels by name, and the time for candidates.

    The thermal submodel is always there, the hygric one where the record has a humidity.  Where the time is
    over, whatever estimates a candidate raises BudgetSpent.
    """

    record: Record
    submodels: Mapping[str, Submodel]
    budget: Budget = field(default_factory=Budget)

    @cached_property
    def tempers(self) -> dict[str, float]:
        """`temper` of each submodel."""
        return {name: temper(submodel) for name, submodel in self.submodels.items()}


def baseline(record: Record, starts: int = 2, say: Progress = lambda text: None) -> Baseline:
    """Identify the base model on the identification period of a record."""
    early = record.identification()
    regression = heat_release_regression(early)
    order = 2
    if regression.operation is not None and regression.operation.coefficients:
        order = max(2, regression.operation.order)
    submodels: dict[str, Submodel] = {}

    def identify(name: str, record: Record, base: Design) -> None:
        """Estimate a submodel in the form that the record calls for."""
        found, _ = select_form(record, estimate_design(record, base, starts, say), say)
        submodels[name] = submodel_of(name, record, found)

    identify(THERMAL, early, design(early, kind=THERMAL, power_order=order, heat_start=regression.start()))
    base = design(early, kind=CASCADE)
    if base.humidity is not None:
        say("smoothed cabinet temperature")
        identify(HYGRIC, _driven(submodels[THERMAL], early, base.humidity), base)
    return Baseline(early, submodels)


def redriven(baseline: Baseline) -> Baseline:
    """The baseline with its hygric submodel estimated again on the temperature that its thermal submodel
    smooths now; unchanged where that does not gain.

    A better simulation of the temperature also knows it better between the readings: a heater's cycles that
    the base smoothed away are errors of the humidity's saturation.
    """
    before = baseline.submodels.get(HYGRIC)
    if before is None or before.base.humidity is None:
        return baseline
    record = _driven(baseline.submodels[THERMAL], before.record, before.base.humidity)
    after = climbed(replace(before, record=record, run=prepare_run(before.base, record)))
    if after.objective <= before.objective:
        return baseline
    return replace(baseline, submodels={**baseline.submodels, HYGRIC: after})


def _driven(thermal: Submodel, record: Record, humidity: str) -> Record:
    """A record with the cabinet temperature that a thermal submodel smooths from its own readings."""
    smoothed = smoothed_temperature(thermal.base, thermal.run, thermal.values, thermal.record, humidity)
    return record.replace_series(smoothed)


# -- estimates of candidates ---------------------------------------------------------------------------------
class _Timed(Objective):
    """An objective that raises BudgetSpent once the time for candidates is over."""

    def __init__(self, likelihood: Likelihood, coordinates: Coordinates, budget: Budget | None) -> None:
        super().__init__(likelihood, coordinates)
        self._budget = budget or Budget()

    def value(self, z: np.ndarray) -> float:
        self._budget.check()
        return super().value(z)

    def information(self, z: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        self._budget.check()
        return super().information(z)


def refitted(
    submodel: Submodel,
    additions: Sequence[tuple[str, Settings]],
    features: Mapping[str, Settings],
    starts: Sequence[Mapping[str, float]],
    record: Record | None = None,
    budget: Budget | None = None,
) -> Submodel:
    """The submodel with further mechanisms, all its parameters estimated again, also those of the noise; the
    best of several starts."""
    wider = extended(submodel.base, additions, features=features)
    record = submodel.record if record is None else record
    run = prepare_run(wider, record)
    likelihood = search_likelihood(wider.model, run.timeline)
    coordinates = Coordinates(wider.model.parameters)
    objective = _Timed(likelihood, coordinates, budget)
    given = {p.name: p.start for p in wider.model.parameters} | dict(submodel.values)
    first, hopeful = [{**given, **start} for start in starts or ({},)], True
    if len(first) > SCOUTED:
        offsets = _offsets(wider.model)
        first.sort(key=lambda at: -objective.value(coordinates.start({**at, **offsets})))
        first = first[:SCOUTED]
    ordinary = disturbances(wider.model)
    if any(submodel.values.get(name, 0.0) > WANDERS_H for name in ordinary if name.endswith("_time")):
        # a disturbance that wanders for days may have taken the candidate's place: one start has ordinary
        # ones
        first.append({**first[0], **ordinary})
    if len(first) > 1:
        # a few passes over the mechanisms' own parameters: a start that is far behind then is not followed
        reached, best_start = max(
            (_scouted(likelihood, submodel, at, budget) for at in first), key=lambda pair: pair[0]
        )
        first = [best_start]
        hopeful = reached > submodel.objective + HOPE
    best = climb(objective, coordinates.start(first[0]), passes=10 if hopeful else 2, tolerance=0.5)
    values = coordinates.values(best.z)
    return Submodel(submodel.name, record, wider, run, values, best.objective, best.converged)


def climbed(submodel: Submodel, budget: Budget | None = None) -> Submodel:
    """The submodel with its parameters climbed to the maximum."""
    coordinates = Coordinates(submodel.base.model.parameters)
    objective = _Timed(submodel.likelihood, coordinates, budget)
    best = climb(objective, coordinates.start(submodel.values), passes=40, tolerance=0.02)
    values = coordinates.values(best.z)
    return replace(submodel, values=values, objective=best.objective, converged=best.converged)


def disturbances(model: Model) -> dict[str, float]:
    """Start values of the sizes and memories of a model's disturbances."""
    return {p.name: p.start for p in model.parameters if p.noise and "_disturbance_" in p.name}


def _offsets(model: Model) -> dict[str, float]:
    """The sensors' offsets where their accuracy has them: the base may have stretched them to stand for an
    effect that it lacks."""
    return {p.name: p.prior.mean for p in model.parameters if p.prior is not None}


def _scouted(
    likelihood: Likelihood, submodel: Submodel, at: Mapping[str, float], budget: Budget | None
) -> tuple[float, dict[str, float]]:
    """(objective, values) after a few passes over the parameters that the submodel does not have, those of
    the disturbances, and the sensors' offsets."""
    parameters, offsets = likelihood.model.parameters, _offsets(likelihood.model)
    free = {*offsets, *disturbances(likelihood.model)}
    held = {name: value for name, value in at.items() if name in submodel.values and name not in free}
    coordinates = Coordinates(parameters, held if len(held) < len(parameters) else {})
    objective = _Timed(likelihood, coordinates, budget)
    found = climb(objective, coordinates.start({**at, **offsets}), passes=5, tolerance=1.0)
    return found.objective, coordinates.values(found.z)
