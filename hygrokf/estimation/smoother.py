"""Smoothed states, and any model as a `filterpy` object.

Shapes: T instants, n states, k outputs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.estimation.likelihood import Gaussian, Likelihood, Trace
from hygrokf.physics.parameters import expect_values

if TYPE_CHECKING:
    from filterpy.kalman import ExtendedKalmanFilter


def smooth(
    likelihood: Likelihood, values: Mapping[str, float], covariance: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """States given all readings of the timeline.

    likelihood: of the model on its timeline, with T instants and n states.
    values: of all parameters, in the parameters' units.
    covariance: False leaves the second array empty.

    Returns smoothed means (T, n) and covariances (T, n, n), in the states' units.  Raises ValueError for
    values that the model does not have.

    Modified Bryson–Frazier recursion, which needs no inverse of a covariance: with C_j = I − K_j H_j of the
    readings j of an instant and Φ the transition to it, backwards
        λ⁻ = C' λ − H' e/S,   Λ⁻ = C' Λ C + H' H/S  (reading by reading),   λ = Φ' λ⁻,   Λ = Φ' Λ⁻ Φ,
        m^s = m⁻ − P⁻ λ⁻,     P^s = P⁻ − P⁻ Λ⁻ P⁻.
    A running mean passes nothing across its reset.
    Source: Bierman 1973, doi:10.1016/0005-1098(73)90051-4.
    """
    found = likelihood.trace(values)
    through, push, weight = _readings(likelihood, values, found)
    n = found.mean.shape[1]
    back = np.swapaxes(found.transition, 1, 2).copy()
    back[1:] *= _carried(likelihood)[:-1, :, None]
    vectors = np.empty_like(found.mean)
    matrices = np.empty_like(found.covariance) if covariance else np.empty((0, n, n))
    vector, matrix = np.zeros(n), np.zeros((n, n))
    for k in range(len(vectors) - 1, -1, -1):
        b = through[k]
        vector = b @ vector + push[k]
        vectors[k] = vector
        vector = back[k] @ vector
        if covariance:
            matrix = b @ matrix @ b.T + weight[k]
            matrices[k] = matrix
            matrix = back[k] @ matrix @ back[k].T
    mean = found.prior_mean - np.einsum("tij,tj->ti", found.prior_covariance, vectors)
    if not covariance:
        return mean, matrices
    prior = found.prior_covariance
    return mean, prior - prior @ matrices @ prior


def _readings(
    likelihood: Likelihood, values: Mapping[str, float], found: Trace
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Terms of the readings of each instant in the backward recursion: C' (T, n, n), −H' e/S (T, n), H' H/S
    (T, n, n)."""
    model, t = likelihood.model, likelihood.timeline
    count, n = found.prior_mean.shape
    u = {name: t.input(name) for name in model.inputs}
    mean, covariance = found.prior_mean, found.prior_covariance
    through = np.broadcast_to(np.eye(n), (count, n, n)).copy()
    push, weight = np.zeros((count, n)), np.zeros((count, n, n))
    for j, name in enumerate(model.outputs):
        there = np.isfinite(t.y[:, j])

        def shown(state: list[np.ndarray], name: str = name) -> np.ndarray:
            return np.broadcast_to(np.asarray(model.evaluate(state, u, values).outputs[name][0]), count)

        columns = [mean[:, i] for i in range(n)]
        row = np.empty((count, n))
        for i in range(n):
            moved = list(columns)
            moved[i] = columns[i] + 1e-30j
            row[:, i] = np.imag(shown(moved)) * 1e30
        spread = found.variance[:, j]
        error = np.where(there, t.y[:, j] - found.prediction[:, j], 0.0)
        row = np.where(there[:, None], row, 0.0)
        gain = np.einsum("tij,tj->ti", covariance, row) / spread[:, None]
        # λ⁻ = C₁'(C₂'(…λ…) − H₂' e₂/S₂) − H₁' e₁/S₁: later readings act through the earlier ones
        pulled = np.einsum("tij,tj->ti", through, row)
        push -= pulled * (error / spread)[:, None]
        weight += pulled[:, :, None] * pulled[:, None, :] / spread[:, None, None]
        through = through - pulled[:, :, None] * gain[:, None, :]
        mean = mean + gain * error[:, None]
        covariance = covariance - gain[:, :, None] * gain[:, None, :] * spread[:, None, None]
    return through, push, weight


def _carried(likelihood: Likelihood) -> np.ndarray:
    """(T, n) 1 where a state continues from an instant, 0 where it restarts."""
    states, resets = likelihood.model.states, likelihood.model.resets
    result = np.ones((len(likelihood.timeline), len(states)))
    for bit, state in enumerate(resets):
        result[(likelihood.timeline.reset & (1 << bit)) != 0, state] = 0.0
    return result


def to_filterpy(likelihood: Likelihood, values: Mapping[str, float]) -> ExtendedKalmanFilter:
    """The model as a `filterpy.kalman.ExtendedKalmanFilter`, positioned before the first instant.

    likelihood: of the model on its timeline, with n states.
    values: of all parameters, in the parameters' units.

    Returns filterpy's filter with x (n,) and P (n, n) in the states' units, and two more methods:
    `advance(k)` predicts to instant k; `observe(k)` applies the readings of instant k one after the other
    (missing ones are left out) and returns their log-likelihood.  All matrix algebra is filterpy's; the
    nonlinear prediction, its Jacobian F and the noise Q come from the model.  Raises ValueError for
    parameters without a value.
    """
    from filterpy.kalman import ExtendedKalmanFilter

    expect_values(likelihood.model.parameters, values)
    likelihood = likelihood.scheduled(values)

    class ModelFilter(ExtendedKalmanFilter):
        """filterpy's filter with this model's prediction."""

        _next: np.ndarray

        def predict_x(self, u: np.ndarray | None = None) -> None:
            self.x = self._next

        def advance(self, k: int) -> None:
            self._next, self.F, self.Q = transition(likelihood, values, k, self.x)
            self.predict()

        def observe(self, k: int) -> float:
            total = 0.0
            for name, z in zip(likelihood.model.outputs, likelihood.timeline.y[k], strict=True):
                if np.isfinite(z):
                    prediction, row, variance = observation(likelihood, values, k, name, self.x)
                    spread, error = float(row @ self.P @ row) + variance, z - prediction
                    bound, distance = likelihood.model.bound, abs(error) / np.sqrt(spread)
                    term = distance**2
                    if distance > bound:  # its noise is larger by as much as puts the reading at the bound
                        variance += spread * (distance / bound - 1.0)
                        term = bound**2 * (1.0 + 2.0 * np.log(distance / bound))
                    total -= 0.5 * (np.log(2.0 * np.pi * spread) + term)
                    self.update(
                        np.array([z]),
                        lambda x, row=row: row[None, :],
                        lambda x, prediction=prediction: np.array([prediction]),
                        R=np.array([[variance]]),
                    )
            for bit, state in enumerate(likelihood.model.resets):
                if likelihood.timeline.reset[k] & (1 << bit):
                    self.x[state] = 0.0
                    self.P[state, :] = 0.0
                    self.P[:, state] = 0.0
            return total

    made = ModelFilter(dim_x=len(likelihood.model.states), dim_z=1)
    first = likelihood.first_gaussian(values)
    made.x, made.P = first.mean.copy(), first.covariance.copy()
    return made


def transition(
    likelihood: Likelihood, values: Mapping[str, float], k: int, mean: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Predicted mean (n,), its derivative F (n, n) and the accumulated noise Q (n, n) of the step to instant
    k."""
    part = likelihood.timeline.window(k, k + 1)
    part = part.with_readings(np.full_like(part.y, np.nan))
    n = len(mean)
    start = Gaussian(mean, np.zeros((n, n)))
    held = likelihood.schedule and likelihood.schedule.window(k, k + 1)
    found = replace(likelihood, timeline=part, schedule=held).trace(values, start=start)
    return found.prior_mean[0].copy(), found.transition[0].copy(), found.prior_covariance[0].copy()


def observation(
    likelihood: Likelihood, values: Mapping[str, float], k: int, name: str, mean: np.ndarray
) -> tuple[float, np.ndarray, float]:
    """Prediction of an output at instant k, its slopes (n,) by complex steps, and the variance of its
    noise."""
    model, t = likelihood.model, likelihood.timeline
    u = {one: float(t.input(one)[k]) for one in model.inputs}
    prediction, variance = model.evaluate(list(mean), u, values).outputs[name]
    row = np.empty(len(mean))
    for i in range(len(mean)):
        moved = [complex(v) for v in mean]
        moved[i] += 1e-30j
        row[i] = np.imag(model.evaluate(moved, u, values).outputs[name][0]) * 1e30
    return float(np.real(prediction)), row, float(variance)
