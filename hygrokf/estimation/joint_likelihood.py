"""Several records of one model in one likelihood.

Records are independent, so that their log-likelihoods, scores and informations add up:

    ln L(θ) = Σ_k ln L_k(θ),    θ shared, but for named parameters of which every record has its own.

Shapes: d parameters of the joint likelihood, m of the model, T instants of all records, k outputs.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NoReturn

import numpy as np

from hygrokf.errors import unknown_names
from hygrokf.estimation.likelihood import Likelihood, Sensitivities
from hygrokf.physics.model import Model
from hygrokf.physics.parameters import Parameter, unique


@dataclass(frozen=True)
class Records:
    """The instants of several records, one record after the other.

    `time` (T,) [h] continues from record to record after a pause of the longest step; `y` (T, k) readings,
    NaN where there is none.
    """

    time: np.ndarray
    y: np.ndarray

    def __len__(self) -> int:
        return len(self.time)

    @property
    def n_readings(self) -> int:
        return int(np.isfinite(self.y).sum())


@dataclass(frozen=True)
class JointLikelihood:
    """The likelihood of several independent records of one model.

    parts: the likelihood of each record; their models have the same parameters, states and outputs.
    own: parameters of which every record has its own value, such as a sensor's offset; the parameter of the
        k-th record (from 1) is named `name_k`.

    `fit_mle`, `confidence_intervals` and `modal_time_constants` (linearised with the first record's own
    parameters) take it as they take a `Likelihood`.  Functions of a single record take
    `parts[k]` with `values_of(values, k)`.  Raises ValueError for models that differ, and for unknown
    parameters in `own`.
    """

    parts: Sequence[Likelihood]
    own: Sequence[str] = ()

    def __post_init__(self) -> None:
        # a likelihood keeps working memory between calls: a copy for another thread needs its own parts
        object.__setattr__(self, "parts", tuple(replace(part) for part in self.parts))
        object.__setattr__(self, "own", tuple(self.own))
        if not self.parts:
            raise ValueError("parts: expected the likelihood of at least one record, found none")
        first = self.model
        faults = [
            f"part {k}: expected the {kind} of the first part's model, found others"
            for k, part in enumerate(self.parts)
            for kind in ("parameters", "states", "outputs")
            if getattr(part.model, kind) != getattr(first, kind)
        ]
        faults += unknown_names("own", self.own, [p.name for p in first.parameters])
        if faults:
            raise ValueError("; ".join(faults))

    def __getattr__(self, name: str) -> NoReturn:
        raise AttributeError(
            f"{name}: expected the likelihood of one record, found that of {len(self.parts)}; take parts[k] "
            "with values_of(values, k), k from 0"
            if hasattr(Likelihood, name)
            else f"a JointLikelihood has no {name}"
        )

    @property
    def model(self) -> Model:
        return self.parts[0].model

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters (d,); a parameter in `own` is replaced by one for each record."""
        return unique(
            replace(p, name=name)
            for p in self.model.parameters
            for name in dict.fromkeys(self._name(p.name, k) for k in range(len(self.parts)))
        )

    @cached_property
    def timeline(self) -> Records:
        """Instants and readings of all records."""
        times, end = [], 0.0
        pause = max(float(part.timeline.steps[:, 0].max()) for part in self.parts)
        for part in self.parts:
            times.append(end + part.timeline.time - part.timeline.time[0])
            end = times[-1][-1] + pause
        return Records(np.concatenate(times), np.concatenate([part.timeline.y for part in self.parts]))

    def values_of(self, values: Mapping[str, float], k: int) -> dict[str, float]:
        """Values of the model's parameters for record k, from 0."""
        return {p.name: values[self._name(p.name, k)] for p in self.model.parameters}

    def _name(self, name: str, k: int) -> str:
        return f"{name}_{k + 1}" if name in self.own else name

    def _places(self, k: int) -> list[int]:
        """Indices (m,) of the parameters of record k among those of the joint likelihood."""
        names = [p.name for p in self.parameters]
        return [names.index(self._name(p.name, k)) for p in self.model.parameters]

    def value(self, values: Mapping[str, float]) -> float:
        """ln L; −inf where the filter of a record breaks down."""
        return sum(part.value(part_values) for part, part_values in records_of(self, values))

    def score(self, values: Mapping[str, float]) -> tuple[float, np.ndarray]:
        """ln L and its exact derivatives (d,) with respect to all parameters."""
        total, gradient = 0.0, np.zeros(len(self.parameters))
        for k, (part, part_values) in enumerate(records_of(self, values)):
            value, part_gradient = part.score(part_values)
            total += value
            gradient[self._places(k)] += part_gradient
        return total, gradient

    def sensitivities(
        self, values: Mapping[str, float], directions: np.ndarray, each: bool = False
    ) -> Sensitivities:
        """Score and expected information along directions (d, r), as `Likelihood.sensitivities`; `scores`
        (T, r) record after record."""
        parts = [
            part.sensitivities(part_values, directions[self._places(k)], each)
            for k, (part, part_values) in enumerate(records_of(self, values))
        ]
        return Sensitivities(
            sum(part.loglik for part in parts),
            np.sum([part.score for part in parts], axis=0),
            np.sum([part.information for part in parts], axis=0),
            np.concatenate([part.scores for part in parts]),
        )

    @property
    def tolerance(self) -> float:
        """Largest error of a sub-step (`Likelihood.tolerance`)."""
        return max(one.tolerance for one in self.parts)

    def scheduled(self, values: Mapping[str, float]) -> JointLikelihood:
        """The likelihood that holds the sub-steps chosen for these values; itself where steps are exact."""
        return self._with_parts([part.scheduled(own) for part, own in records_of(self, values)])

    def halved(self, values: Mapping[str, float]) -> JointLikelihood:
        """The likelihood that holds these sub-steps, each divided in two; itself where steps are exact."""
        return self._with_parts([part.halved(own) for part, own in records_of(self, values)])

    def _with_parts(self, parts: Sequence[Likelihood]) -> JointLikelihood:
        return self if all(map(operator.is_, parts, self.parts)) else replace(self, parts=parts)

    def steps_per_instant(self, values: Mapping[str, float]) -> float:
        """Filter steps of one pass per instant of all records."""
        steps = [part.steps_per_instant(part_values) for part, part_values in records_of(self, values)]
        return float(np.average(steps, weights=[len(part.timeline) for part in self.parts]))

    def jacobian(self, values: Mapping[str, float], mean: np.ndarray, u: Mapping[str, float]) -> np.ndarray:
        """Derivatives (n, n) [1/h] of the states' rates by the states with the first record's parameters."""
        return self.parts[0].jacobian(self.values_of(values, 0), mean, u)


AnyLikelihood = Likelihood | JointLikelihood
"""The likelihood of one record or of several."""


def records_of(
    likelihood: AnyLikelihood, values: Mapping[str, float]
) -> list[tuple[Likelihood, Mapping[str, float]]]:
    """The likelihood of every record, with the values of its model's parameters."""
    if isinstance(likelihood, Likelihood):
        return [(likelihood, values)]
    return [(part, likelihood.values_of(values, k)) for k, part in enumerate(likelihood.parts)]
