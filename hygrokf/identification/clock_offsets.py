"""Offsets between the clocks of a record's sources: their estimates, and their effect on the parameters.

The cabinet's clock is the reference; another source's stamps may be late by δ_j [s] with a prior N(0, σ_j²)
from the resolution of its stamps.  Shifting that source changes every innovation by δ_j ∂e/∂δ_j, which is
found by moving its series once.  With the slopes of the innovations with respect to the parameters, to first
order (Gauss–Newton),

    [ I_θθ  I_θδ        ] [Δθ]   [0  ]
    [ I_δθ  I_δδ + 1/σ² ] [Δδ] = [s_δ].

Δθ is the effect of the most likely offsets on the parameters.  Solved by elimination, with G = I_θθ⁻¹ I_θδ:

    V_δ = (M + 1/σ²)⁻¹,   M = I_δδ − I_δθ G ≥ 0,     Δδ = V_δ s_δ,   Δθ = −G Δδ,   V_θ = I_θθ⁻¹ + G V_δ G'.

All blocks are of the expected information, in which M cannot be negative: readings only add information, so
that no offset is less certain than its prior.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hygrokf.data.record import Series
from hygrokf.estimation.confidence import Uncertainty, positive_inverse
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Estimate, Objective
from hygrokf.modelling.design import HUMIDITIES, TEMPERATURE, Design
from hygrokf.modelling.inputs import Run, model_inputs
from hygrokf.texts.terms import Source

ONE_SYSTEM_S = 30.0
"""[s] prior standard deviation of an offset between signals of one source, whose stamps are often full
minutes."""
TWO_SYSTEMS_S = 60.0
"""[s] prior standard deviation of the offset between two sources without a stated clock uncertainty."""
STEP_S = 30.0
"""[s] shift of a source by which the effect of its offset is found."""
DRIVERS = (
    "ambient_temperature",
    "ambient_relative_humidity",
    "ambient_absolute_humidity",
    "ambient_dew_point_temperature",
    "active_power",
)
"""Signals whose clock affects a time constant."""


@dataclass(frozen=True)
class ClockOffset:
    """The offset of one source's clock from the cabinet's.

    `prior_s` [s] is the prior standard deviation; `offset_s` ± `sd_s` [s] is the delay of its stamps by
    readings and prior.
    """

    source: Source
    prior_s: float
    offset_s: float
    sd_s: float


@dataclass(frozen=True)
class ClockOffsets:
    """The offsets of all sources.

    `shift` is the change of the parameters' coordinates with the most likely offsets, `variance` the addition
    to the coordinates' variances from the offsets' uncertainty.
    """

    sources: tuple[ClockOffset, ...] = ()
    shift: Mapping[str, float] = field(default_factory=dict)
    variance: Mapping[str, float] = field(default_factory=dict)


NO_OFFSETS = ClockOffsets()


def prior_s(series: Series, reference: Series) -> float:
    """Prior standard uncertainty [s] of the offset between two series."""
    stated = [s.clock_uncertainty_s for s in (series, reference) if s.clock_uncertainty_s is not None]
    if stated:
        return float(np.hypot.reduce(stated))
    return ONE_SYSTEM_S if _system(series) == _system(reference) else TWO_SYSTEMS_S


def _system(series: Series) -> str:
    return series.source.split(",")[0]


def clock_offsets(base: Design, run: Run, estimate: Estimate, uncertainty: Uncertainty) -> ClockOffsets:
    """Offsets of the sources that drive a design's run, at its estimate; sources without clock uncertainty
    are left out."""
    record = run.record
    reference = next((record[name] for name in (TEMPERATURE, *HUMIDITIES) if name in record), None)
    if reference is None:
        return NO_OFFSETS
    groups: dict[str, list[Series]] = {}
    for series in record.series:
        if series.signal in DRIVERS and prior_s(series, reference) > 0:
            groups.setdefault(_system(series), []).append(series)
    likelihood = Likelihood(base.model, run.timeline)
    weights, errors, slopes = _innovations(likelihood, estimate, uncertainty)
    at = Objective(likelihood, estimate.coordinates).information(estimate.z)
    places = [estimate.coordinates.names.index(name) for name in uncertainty.names]
    known = positive_inverse(at.information[np.ix_(places, places)], uncertainty.open)
    moved, names = [], []
    for name, group in groups.items():
        shifted = record.replace_series(*(replace(s, time=s.time - STEP_S) for s in group))
        other = model_inputs(base, shifted)
        there = _matched(run, other)
        if there is None:
            continue
        trace = Likelihood(base.model, other.timeline).trace(estimate.values)
        change = (other.timeline.y - trace.prediction)[there[1]] - errors[there[0]]
        column = np.zeros_like(errors)
        column[there[0]] = np.nan_to_num(change) / STEP_S
        moved.append(column)
        names.append(name)
    if not moved:
        return NO_OFFSETS
    prior = np.array([max(prior_s(s, reference) for s in groups[name]) for name in names])
    return _solved(uncertainty.names, known, names, prior, weights, errors, slopes, np.stack(moved, axis=-1))


def _innovations(
    likelihood: Likelihood, estimate: Estimate, uncertainty: Uncertainty
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """1/S and innovations (T, k), 0 without reading, and slopes (T, k, f) of the innovations with respect to
    the coordinates."""
    coordinates = estimate.coordinates
    trace = likelihood.trace(estimate.values)
    there = np.isfinite(likelihood.timeline.y)
    chosen = [coordinates.names.index(name) for name in uncertainty.names]
    slopes = likelihood.slopes(estimate.values, coordinates.directions(estimate.z)[:, chosen])
    errors = np.where(there, likelihood.timeline.y - trace.prediction, 0.0)
    return np.where(there, 1.0 / trace.variance, 0.0), errors, np.where(there[..., None], slopes, 0.0)


def _matched(run: Run, other: Run) -> tuple[np.ndarray, np.ndarray] | None:
    """Rows of two runs with the same readings, where the runs differ only in the times of their inputs."""
    one, two = run.timeline, other.timeline
    first = np.round(one.seconds * 1e3)
    second = np.round(two.seconds * 1e3)
    read = np.isfinite(one.y).any(axis=1)
    _, left, right = np.intersect1d(first[read], second, assume_unique=True, return_indices=True)
    return (np.flatnonzero(read)[left], right) if len(left) else None


def _solved(
    parameters: tuple[str, ...],
    known: np.ndarray,
    names: list[str],
    prior: np.ndarray,
    weights: np.ndarray,
    errors: np.ndarray,
    slopes: np.ndarray,
    moved: np.ndarray,
) -> ClockOffsets:
    """Solve the equations of the module's text; `known` (f, f) is I_θθ⁻¹, `moved` (T, k, m) are slopes of the
    innovations with respect to the offsets."""
    flat = moved.reshape(-1, len(names))
    weighted = flat * weights.reshape(-1, 1)
    # a model whose parameters are all open has no slopes
    cross = slopes.reshape(len(flat), slopes.shape[-1]).T @ weighted
    carried = known @ cross
    # in units of the prior's standard deviations
    values, vectors = np.linalg.eigh((flat.T @ weighted - cross.T @ carried) * np.outer(prior, prior))
    vectors = prior[:, None] * vectors
    covariance = (vectors / (1.0 + np.maximum(values, 0.0))) @ vectors.T
    offsets = -covariance @ (errors.reshape(-1) @ weighted)
    step = -carried @ offsets
    added = np.einsum("ij,jk,ik->i", carried, covariance, carried)
    deviations = np.sqrt(np.diag(covariance))
    return ClockOffsets(
        tuple(
            ClockOffset(name, float(before), float(offset), float(sd))
            for name, before, offset, sd in zip(names, prior, offsets, deviations, strict=True)
        ),
        dict(zip(parameters, step.tolist(), strict=True)),
        dict(zip(parameters, added.tolist(), strict=True)),
    )
