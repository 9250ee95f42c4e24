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
CLOCKED_DRIVERS = (
    "ambient_temperature",
    "ambient_relative_humidity",
    "ambient_absolute_humidity",
    "ambient_dew_point_temperature",
    "active_power",
)
"""Signals whose clock affects a time constant."""


@dataclass(frozen=True)
class ClockOffset:
    """The offset of one source's clock from the cabinet's clock.

    `prior_s` [s] is its prior standard deviation; `offset_s` ± `sd_s` [s] is the estimated delay of the
    source's stamps.
    """

    source: Source
    prior_s: float
    offset_s: float
    sd_s: float


@dataclass(frozen=True)
class ClockOffsets:
    """The clock offsets of all sources and what they do to the parameters.

    `shift`: by parameter, change of its coordinate under the most likely offsets.
    `variance`: by parameter, variance of its coordinate that the offsets' uncertainty adds.
    """

    sources: tuple[ClockOffset, ...] = ()
    shift: Mapping[str, float] = field(default_factory=dict)
    variance: Mapping[str, float] = field(default_factory=dict)


NO_OFFSETS = ClockOffsets()


def prior_s(series: Series, reference: Series) -> float:
    """Return the prior standard deviation [s] of the clock offset between two series."""
    stated_uncertainties = [
        one_series.clock_uncertainty_s
        for one_series in (series, reference)
        if one_series.clock_uncertainty_s is not None
    ]
    if stated_uncertainties:
        return float(np.hypot.reduce(stated_uncertainties))
    return ONE_SYSTEM_S if _system(series) == _system(reference) else TWO_SYSTEMS_S


def _system(series: Series) -> str:
    """Return the name of a series' source, without its column."""
    return series.source.split(",")[0]


def clock_offsets(base: Design, run: Run, estimate: Estimate, uncertainty: Uncertainty) -> ClockOffsets:
    """Estimate the clock offsets of the sources that drive a run, by linearisation at the estimate.

    Sources without clock uncertainty are left out.
    """
    record = run.record
    reference = next(
        (record[name] for name in (CABINET_TEMPERATURE, *CABINET_HUMIDITIES) if name in record), None
    )
    if reference is None:
        return NO_OFFSETS
    series_by_source: dict[str, list[Series]] = {}
    for series in record.series:
        if series.signal in CLOCKED_DRIVERS and prior_s(series, reference) > 0:
            series_by_source.setdefault(_system(series), []).append(series)
    likelihood = Likelihood(base.model, run.timeline)
    weights, errors, slopes = _innovations(likelihood, estimate, uncertainty)
    information = Objective(likelihood, estimate.coordinates).information(estimate.z)
    indices = [estimate.coordinates.names.index(name) for name in uncertainty.names]
    covariance = positive_inverse(information.information[np.ix_(indices, indices)], uncertainty.open)
    derivatives, names = [], []
    for name, group in series_by_source.items():
        shifted = record.replace_series(
            *(replace(one_series, time=one_series.time - CLOCK_STEP_S) for one_series in group)
        )
        shifted_run = model_inputs(base, shifted)
        matching_rows = _matched(run, shifted_run)
        if matching_rows is None:
            continue
        shifted_trace = Likelihood(base.model, shifted_run.timeline).trace(estimate.values)
        change = (shifted_run.timeline.y - shifted_trace.prediction)[matching_rows[1]] - errors[
            matching_rows[0]
        ]
        derivative = np.zeros_like(errors)
        derivative[matching_rows[0]] = np.nan_to_num(change) / CLOCK_STEP_S
        derivatives.append(derivative)
        names.append(name)
    if not derivatives:
        return NO_OFFSETS
    prior = np.array(
        [max(prior_s(one_series, reference) for one_series in series_by_source[name]) for name in names]
    )
    return _solved(
        uncertainty.names, covariance, names, prior, weights, errors, slopes, np.stack(derivatives, axis=-1)
    )


def _innovations(
    likelihood: Likelihood, estimate: Estimate, uncertainty: Uncertainty
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the weights 1/S (T, k), the innovations (T, k) and their Jacobian (T, k, f) in the coordinates.

    All are 0 where there is no reading.
    """
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
    """Return the rows of common readings in two runs that differ only in the times of their inputs; None
    without any."""
    timeline, other_timeline = run.timeline, other.timeline
    reference_ms = np.round(timeline.seconds * 1e3)
    shifted_ms = np.round(other_timeline.seconds * 1e3)
    has_reading = np.isfinite(timeline.y).any(axis=1)
    _, common, common_in_other = np.intersect1d(
        reference_ms[has_reading], shifted_ms, assume_unique=True, return_indices=True
    )
    return (np.flatnonzero(has_reading)[common], common_in_other) if len(common) else None


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
    """Solve the equations of the module's docstring for the clock offsets.

    parameter_covariance: (f, f) I_θθ⁻¹.  prior: (m,) standard deviations [s].  weights, errors: (T, k).
    jacobian: (T, k, f) of the innovations by the parameters; derivatives: (T, k, m) by the offsets.
    """
    derivative_rows = derivatives.reshape(-1, len(names))
    weighted = derivative_rows * weights.reshape(-1, 1)
    # the Jacobian has no columns if all parameters are open
    cross = jacobian.reshape(len(derivative_rows), jacobian.shape[-1]).T @ weighted
    gain = parameter_covariance @ cross
    # in units of the prior's standard deviations
    values, vectors = np.linalg.eigh((derivative_rows.T @ weighted - cross.T @ gain) * np.outer(prior, prior))
    vectors = prior[:, None] * vectors
    covariance = (vectors / (1.0 + np.maximum(values, 0.0))) @ vectors.T
    offsets = -covariance @ (errors.reshape(-1) @ weighted)
    step = -gain @ offsets
    variance = np.einsum("ij,jk,ik->i", gain, covariance, gain)
    deviations = np.sqrt(np.diag(covariance))
    return ClockOffsets(
        tuple(
            ClockOffset(name, float(prior_sd), float(offset), float(sd))
            for name, prior_sd, offset, sd in zip(names, prior, offsets, deviations, strict=True)
        ),
        dict(zip(parameters, step.tolist(), strict=True)),
        dict(zip(parameters, variance.tolist(), strict=True)),
    )
