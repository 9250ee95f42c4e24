"""Offsets between the clocks of a record's sources: their estimates, and their effect on the parameters.

The cabinet's clock is the reference; the stamps of another source j may be late by δ_j [s], with a prior N(0,
σ_j²) from their resolution.  An offset changes every innovation by δ_j ∂e/∂δ_j; one shift of the source's
series gives this derivative numerically.  With the Jacobian of the innovations with respect to the
parameters, to first order (Gauss–Newton),

    [ I_θθ  I_θδ        ] [Δθ]   [0  ]
    [ I_δθ  I_δδ + 1/σ² ] [Δδ] = [s_δ].

Δθ is the effect of the most likely offsets on the parameters.  By elimination, with G = I_θθ⁻¹ I_θδ:

    V_δ = (M + 1/σ²)⁻¹,   M = I_δδ − I_δθ G ≥ 0,     Δδ = V_δ s_δ,   Δθ = −G Δδ,   V_θ = I_θθ⁻¹ + G V_δ G'.

All blocks belong to the expected information, for which M ≥ 0: readings only add information, so that no
offset is less certain than under its prior.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hygrokf.data.record import Series
from hygrokf.estimation.confidence import Uncertainty, positive_inverse
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Estimate, Objective
from hygrokf.modelling.design import Design
from hygrokf.modelling.inputs import Run, model_inputs
from hygrokf.physics.signal_names import (
    ACTIVE_POWER,
    AMBIENT_HUMIDITIES,
    AMBIENT_TEMPERATURE,
    CABINET_HUMIDITIES,
    CABINET_TEMPERATURE,
)
from hygrokf.texts.terms import Source

ONE_SYSTEM_S = 30.0
"""[s] prior standard deviation of an offset between signals of one source: stamps are often rounded to full
minutes."""
TWO_SYSTEMS_S = 60.0
"""[s] prior standard deviation of the offset between two sources without a stated clock uncertainty."""
CLOCK_STEP_S = 30.0
"""[s] shift of a source for the numerical derivative by its offset."""
CLOCKED_DRIVERS = (AMBIENT_TEMPERATURE, *AMBIENT_HUMIDITIES, ACTIVE_POWER)
"""Signals whose clock affects a time constant."""


@dataclass(frozen=True)
class ClockOffset:
    """The offset of one source's clock from the cabinet's.

    `prior_s` [s] is the prior standard deviation; `offset_s` ± `sd_s` [s] is the delay of the source's stamps
    given the readings and the prior.
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
    """Offsets of the sources that drive a run, linearised at the estimate; sources without clock uncertainty
    are left out."""
    record = run.record
    reference = next(
        (record[name] for name in (CABINET_TEMPERATURE, *CABINET_HUMIDITIES) if name in record), None
    )
    if reference is None:
        return NO_OFFSETS
    groups: dict[str, list[Series]] = {}
    for series in record.series:
        if series.signal in CLOCKED_DRIVERS and prior_s(series, reference) > 0:
            groups.setdefault(_system(series), []).append(series)
    likelihood = Likelihood(base.model, run.timeline)
    weights, errors, slopes = _innovations(likelihood, estimate, uncertainty)
    information = Objective(likelihood, estimate.coordinates).information(estimate.z)
    places = [estimate.coordinates.names.index(name) for name in uncertainty.names]
    covariance = positive_inverse(information.information[np.ix_(places, places)], uncertainty.open)
    derivatives, names = [], []
    for name, group in groups.items():
        shifted = record.replace_series(*(replace(s, time=s.time - CLOCK_STEP_S) for s in group))
        shifted_run = model_inputs(base, shifted)
        rows = _matched(run, shifted_run)
        if rows is None:
            continue
        trace = Likelihood(base.model, shifted_run.timeline).trace(estimate.values)
        change = (shifted_run.timeline.y - trace.prediction)[rows[1]] - errors[rows[0]]
        column = np.zeros_like(errors)
        column[rows[0]] = np.nan_to_num(change) / CLOCK_STEP_S
        derivatives.append(column)
        names.append(name)
    if not derivatives:
        return NO_OFFSETS
    prior = np.array([max(prior_s(s, reference) for s in groups[name]) for name in names])
    return _solved(
        uncertainty.names, covariance, names, prior, weights, errors, slopes, np.stack(derivatives, axis=-1)
    )


def _innovations(
    likelihood: Likelihood, estimate: Estimate, uncertainty: Uncertainty
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """1/S and innovations (T, k), 0 without a reading, and the Jacobian (T, k, f) of the innovations with
    respect to the coordinates."""
    coordinates = estimate.coordinates
    trace = likelihood.trace(estimate.values)
    is_present = np.isfinite(likelihood.timeline.y)
    chosen = [coordinates.names.index(name) for name in uncertainty.names]
    jacobian = likelihood.slopes(estimate.values, coordinates.directions(estimate.z)[:, chosen])
    errors = np.where(is_present, likelihood.timeline.y - trace.prediction, 0.0)
    return (
        np.where(is_present, 1.0 / trace.variance, 0.0),
        errors,
        np.where(is_present[..., None], jacobian, 0.0),
    )


def _matched(run: Run, other: Run) -> tuple[np.ndarray, np.ndarray] | None:
    """Rows of the same readings in two runs that differ only in the times of their inputs; None without
    common readings."""
    reference, shifted = run.timeline, other.timeline
    reference_ms = np.round(reference.seconds * 1e3)
    shifted_ms = np.round(shifted.seconds * 1e3)
    has_reading = np.isfinite(reference.y).any(axis=1)
    _, left, right = np.intersect1d(
        reference_ms[has_reading], shifted_ms, assume_unique=True, return_indices=True
    )
    return (np.flatnonzero(has_reading)[left], right) if len(left) else None


def _solved(
    parameters: tuple[str, ...],
    parameter_covariance: np.ndarray,
    names: list[str],
    prior: np.ndarray,
    weights: np.ndarray,
    errors: np.ndarray,
    jacobian: np.ndarray,
    derivatives: np.ndarray,
) -> ClockOffsets:
    """Solve the equations of the module's docstring; `parameter_covariance` (f, f) is I_θθ⁻¹, `derivatives`
    (T, k, m) are those of the innovations by the offsets."""
    flat = derivatives.reshape(-1, len(names))
    weighted = flat * weights.reshape(-1, 1)
    # the Jacobian has no columns if all parameters are open
    cross = jacobian.reshape(len(flat), jacobian.shape[-1]).T @ weighted
    gain = parameter_covariance @ cross
    # in units of the prior's standard deviations
    values, vectors = np.linalg.eigh((flat.T @ weighted - cross.T @ gain) * np.outer(prior, prior))
    vectors = prior[:, None] * vectors
    covariance = (vectors / (1.0 + np.maximum(values, 0.0))) @ vectors.T
    offsets = -covariance @ (errors.reshape(-1) @ weighted)
    step = -gain @ offsets
    variance = np.einsum("ij,jk,ik->i", gain, covariance, gain)
    deviations = np.sqrt(np.diag(covariance))
    return ClockOffsets(
        tuple(
            ClockOffset(name, float(before), float(offset), float(sd))
            for name, before, offset, sd in zip(names, prior, offsets, deviations, strict=True)
        ),
        dict(zip(parameters, step.tolist(), strict=True)),
        dict(zip(parameters, variance.tolist(), strict=True)),
    )
