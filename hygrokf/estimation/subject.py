"""The subject of a verb such as `simulate`: a model on its data with the values of its parameters, from a fit
or a likelihood.

Shapes: d parameters, r uncertain ones, N draws.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, TypeGuard

import numpy as np

from hygrokf.data.record import Record, kind_of, maker_of
from hygrokf.estimation.confidence import Uncertainty, uncertainty
from hygrokf.estimation.joint_likelihood import AnyLikelihood, JointLikelihood
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Estimate, Objective, fit_mle
from hygrokf.physics.parameters import Parameter, expect_values, within_limits

IDENTIFICATION, WHOLE_RECORD = "identification", "whole"
"""Parts of a record: its identification period, and all of it."""


class Fitted(Protocol):
    """What a fit offers to the verbs; `design` is what higher floors need beside the likelihood."""

    design: Any
    values: Mapping[str, float]

    @property
    def fixed(self) -> Mapping[str, float]:
        """Parameters that were not estimated, with their values."""

    @property
    def covariance(self) -> tuple[tuple[str, ...], np.ndarray]:
        """Names and covariance (r, r) of the uncertain parameters, in their units."""

    def likelihood(self, record: Record, part: str = IDENTIFICATION) -> Likelihood:
        """The likelihood of a record, or of its identification period."""


Source = Fitted | AnyLikelihood
"""The first argument of a verb."""
Given = Record | Estimate | Mapping[str, float]
"""The second: the record of a fit, or the estimate or the values of a likelihood."""
MAKERS = (
    "identify(record) makes a Fit, read_case or read_frames makes a Record, "
    "Likelihood(model, timeline(model, …)) and fit.likelihood(record) make a Likelihood, which has its own "
    "readings, and fit_mle(likelihood) makes its Estimate"
)


@dataclass(frozen=True)
class Spread:
    """Uncertain parameters: `names` and `covariance` (r, r) of their coordinates around `values`."""

    parameters: tuple[Parameter, ...]
    values: Mapping[str, float]
    names: tuple[str, ...]
    covariance: np.ndarray

    @classmethod
    def in_units(
        cls,
        parameters: Sequence[Parameter],
        values: Mapping[str, float],
        covariance: tuple[Sequence[str], np.ndarray],
    ) -> Spread:
        """From names and their covariance (r, r) in the parameters' units; other parameters count as
        exact."""
        by_name = {p.name: p for p in parameters}
        places = [i for i, name in enumerate(covariance[0]) if name in by_name]
        names = tuple(covariance[0][i] for i in places)
        scale = np.array([1.0 / by_name[name].slope(values[name]) for name in names])
        matrix = covariance[1][np.ix_(places, places)] * np.outer(scale, scale)
        return cls(tuple(parameters), values, names, matrix)

    def drawn(self, draws: np.ndarray) -> dict[str, Any]:
        """Values of all parameters for standard normal draws (N, r): arrays (N,) of the uncertain ones, which
        stay within their search limits."""
        drawn: dict[str, Any] = dict(self.values)
        values, vectors = np.linalg.eigh(self.covariance)
        moves = draws @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
        by_name = {p.name: p for p in self.parameters}
        for name, move in zip(self.names, moves.T, strict=True):
            p = by_name[name]
            ends = p.to_coordinate(p.lower), p.to_coordinate(p.upper)
            z = np.clip(p.to_coordinate(self.values[name]) + move, *ends)
            drawn[name] = np.exp(z) if p.positive else z
        return drawn


@dataclass(frozen=True)
class Subject:
    """A model on its data: `likelihood`, `values` of its parameters, and where they come from: an `estimate`
    of this likelihood, or a `fit`; neither for plain values."""

    likelihood: Likelihood
    values: Mapping[str, float]
    estimate: Estimate | None = None
    fit: Fitted | None = None

    @cached_property
    def spread(self) -> Spread:
        """The uncertainty of the values: the fit's, or the wider of Wald and sandwich of the estimate."""
        parameters = self.likelihood.model.parameters
        if self.fit is not None:
            return Spread.in_units(parameters, self.values, self.fit.covariance)
        if self.estimate is None:
            return Spread(parameters, self.values, (), np.empty((0, 0)))
        uncertain = uncertainty(Objective(self.likelihood, self.estimate.coordinates), self.estimate)
        return Spread(parameters, self.values, uncertain.names, uncertain.wider)


def subject(verb: str, source: Source, given: object, part: str = WHOLE_RECORD) -> Subject:
    """The subject of a verb, from a fit and a record, or from a likelihood and its estimate or values.

    part: `IDENTIFICATION` or `WHOLE_RECORD`, of the record.  Raises ValueError for other arguments, with the
    call that makes the expected ones, and for values that do not belong to the model.
    """
    if isinstance(source, JointLikelihood):
        raise ValueError(
            f"{verb}: expected the likelihood of one record, found a JointLikelihood of {len(source.parts)}; "
            "give one of its `parts`, with `values_of(values, k)` for part k"
        )
    if _is_likelihood(source):
        if isinstance(given, Estimate):
            _expect_own(verb, source, given)
            return Subject(source, given.values, given)
        if isinstance(given, Mapping) and not maker_of(given):
            expect_values(source.model.parameters, given)
            return Subject(source, given)
    elif is_fit(source) and isinstance(given, Record):
        return Subject(source.likelihood(given, part), source.values, fit=source)
    raise ValueError(_refusal(verb, source, given))


def estimated(verb: str, source: Source, given: object) -> tuple[AnyLikelihood, Estimate]:
    """The likelihood and its maximum; for a fit, the likelihood of the full model on the identification
    period of the record is climbed from the fit's values."""
    if isinstance(source, JointLikelihood) and isinstance(given, Estimate):
        _expect_own(verb, source, given)
        return source, given
    checked = subject(verb, source, given, IDENTIFICATION)
    if checked.estimate is not None:
        return checked.likelihood, checked.estimate
    if checked.fit is None:
        raise ValueError(
            f"{verb}: expected the Estimate of this likelihood, found values, which need not be its maximum: "
            "fit_mle(likelihood, values, count=1) makes one"
        )
    start = within_limits(checked.likelihood.parameters, checked.values)
    return checked.likelihood, fit_mle(checked.likelihood, start, checked.fit.fixed, count=1)


def covariances(source: Source, given: Given | None = None) -> Uncertainty:
    """Covariances of all estimated parameters, and what the data do not determine.

    source, given: a `Fit` and its `Record`, or a `Likelihood` and the `Estimate` that `fit_mle` made of it.

    Returns `names` (f,) with the covariances `wald` and `sandwich` (f, f) of their coordinates (the
    parameter in its unit, or the logarithm of a positive one), `wider` of both, `flat` directions and
    strongly correlated `trade_offs`.
    Raises ValueError for other arguments, with the call that makes the expected ones.
    """
    likelihood, estimate = estimated("covariances", source, given)
    return uncertainty(Objective(likelihood, estimate.coordinates), estimate)


def _expect_own(verb: str, likelihood: AnyLikelihood, estimate: Estimate) -> None:
    """Check that an estimate has the parameters of a likelihood, no more and no fewer."""
    names = [p.name for p in likelihood.parameters]
    if {*names} != {*estimate.values}:
        raise ValueError(
            f"{verb}: expected an Estimate of the parameters {', '.join(names)}, found one of "
            f"{', '.join(estimate.values)}; fit_mle(likelihood) makes one of this likelihood"
        )


def _is_likelihood(source: object) -> TypeGuard[Likelihood]:
    return callable(getattr(source, "sensitivities", None))


def is_fit(source: object) -> TypeGuard[Fitted]:
    """Whether `source` has the values and the likelihood that the verbs need of a fit."""
    return hasattr(source, "values") and callable(getattr(source, "likelihood", None))


def _refusal(verb: str, source: object, given: object) -> str:
    """The message for unsuitable arguments: expected kinds, kinds found, and the calls that make the
    expected."""
    makers = filter(None, (maker_of(source, fit=True), maker_of(given), MAKERS))
    return (
        f"{verb}: expected a Fit and a Record, or a Likelihood and its Estimate or values, in this order, "
        f"found {kind_of(source)} and {kind_of(given)}; {'; '.join(makers)}"
    )
