"""Smoothed states, and any model as a `filterpy` object.

Shapes: T instants, n states, k outputs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.engine.square_root import square_root
from hygrokf.engine.traced_filter import UNSEEN
from hygrokf.estimation.likelihood import CHUNK, Gaussian, Likelihood
from hygrokf.estimation.subject import Given, Source, subject
from hygrokf.physics.linearisation import state_derivatives

if TYPE_CHECKING:
    from filterpy.kalman import ExtendedKalmanFilter

SINGULAR = 1e-14
"""[1] share of the largest singular value below which a direction counts as known."""


def smoothed_states(
    likelihood: Likelihood, values: Mapping[str, float], covariance: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """States given all readings of the timeline.

    likelihood: of the model on its timeline, with T instants and n states.
    values: of all parameters, in the parameters' units.
    covariance: False leaves the second array empty.

    Returns smoothed means (T, n) and covariances (T, n, n), in the states' units (`Model.natural`); infinite
    variances where the start is diffuse and no reading tells.  Raises ValueError for values that the model
    does not have.

    Backwards from the last instant, with the law of x_k given x_{k+1} and the readings until k,
        x_k = m_k + C (x_{k+1} − m⁻_{k+1}) + D ν,    ν ~ N(0, I),
        m^s_k = m_k + C (m^s_{k+1} − m⁻_{k+1}),    P^s_k = C P^s_{k+1} C' + D D'.
    Both terms of P^s are squares, so that it keeps its sign.  A running mean passes nothing across its reset.
    Source: Rauch, Tung & Striebel 1965, doi:10.2514/3.3166; in square roots Park & Kailath 1995,
    doi:10.1080/00207179508921953.
    """
    found, roots, directions = likelihood.with_roots(values)
    count, n = found.mean.shape
    mean = found.mean.copy()
    matrices = np.empty((count if covariance else 0, n, n))
    carried = _carried(likelihood)[..., None, :] * np.roll(found.transition, -1, axis=0)
    noise = square_root(found.noise[1:])
    matrix, unknown = roots[-1] @ roots[-1].T, directions[-1]
    for first in range((count - 1) // CHUNK * CHUNK, -1, -CHUNK):
        part = slice(first, min(first + CHUNK, count - 1))
        gains, spreads, still = _given_next(roots[part], directions[part], carried[part], noise[part])
        if covariance and part.stop == count - 1:
            matrices[-1] = _with_infinite(matrix, unknown)
        for k in range(part.stop - 1, first - 1, -1):
            gain = gains[k - first]
            mean[k] += gain @ (mean[k + 1] - found.prior_mean[k + 1])
            if covariance:
                matrix = gain @ matrix @ gain.T + spreads[k - first]
                if unknown.size:
                    unknown = _sure(gain @ unknown, np.abs(gain) @ np.abs(unknown))
                    unknown = np.linalg.qr(np.hstack([unknown, still[k - first]]).T)[1].T
                matrices[k] = _with_infinite(matrix, unknown)
    return likelihood.model.natural(mean, matrices)


def _given_next(
    own: np.ndarray, start: np.ndarray, carried: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The law of the states at some instants k given those at k + 1 and the readings until k: C (t, n, n),
    D D' (t, n, n), and the directions (t, n, d) that stay unknown.

    With η the unknown start, x_k = m_k + B η + W ε and x_{k+1} = m⁻ + F (B η + W ε) + V ω.  Across F B the
    next state tells ε and ω by their regression, along it η.
    """
    n, d = start.shape[1:]
    wide = np.concatenate([own, np.zeros_like(own)], axis=2)
    later = np.concatenate([carried @ own, noise], axis=2)
    along = carried @ start
    scale = np.sqrt((later**2).sum(axis=2) + (along**2).sum(axis=2))[..., None]
    scale = np.where(scale > 0.0, scale, 1.0)
    later, back = later / scale, np.eye(n) / np.swapaxes(scale, 1, 2)
    gain, still = np.zeros_like(own), np.zeros_like(start)
    if d:
        along = along / scale
        size = np.sqrt((along**2).sum(axis=1, keepdims=True))
        size = np.where(size > 0.0, size, 1.0)
        turn, length, columns = np.linalg.svd(along / size)
        told = length > SINGULAR
        reached = (start / size) @ np.swapaxes(columns, 1, 2)
        still = np.where(told[:, None, :], 0.0, reached)
        reached = np.where(told[:, None, :], reached / np.where(told, length, 1.0)[:, None, :], 0.0)
        turned = np.swapaxes(turn, 1, 2)
        shown = turned @ later
        gain = reached @ (turned @ back)[:, :d]
        wide = wide - reached @ shown[:, :d]
        later = np.concatenate([np.where(told[..., None], 0.0, shown[:, :d]), shown[:, d:]], axis=1)
        back = turned @ back
    left, size, right = np.linalg.svd(later)
    told = size > SINGULAR * size[:, :1]
    weight = np.where(told, 1.0 / np.where(told, size, 1.0), 0.0)
    turned = wide @ np.swapaxes(right, 1, 2)
    gain = gain + (turned[:, :, :n] * weight[:, None, :]) @ np.swapaxes(left, 1, 2) @ back
    turned[:, :, :n] *= ~told[:, None, :]
    return gain, turned @ np.swapaxes(turned, 1, 2), still


def _with_infinite(matrix: np.ndarray, unknown: np.ndarray) -> np.ndarray:
    """A covariance (n, n), infinite along the directions `unknown` (n, d)."""
    infinite = _sure(unknown @ unknown.T, np.abs(unknown) @ np.abs(unknown.T))
    return np.where(infinite != 0.0, np.copysign(np.inf, infinite), matrix)


def _sure(found: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Sums of products, 0 where rounding alone is left of their `terms`."""
    return np.where(np.abs(found) > UNSEEN * terms, found, 0.0)


def _carried(likelihood: Likelihood) -> np.ndarray:
    """(T, n) 1 where a state continues from an instant, 0 where it restarts."""
    states, resets = likelihood.model.states, likelihood.model.resets
    result = np.ones((len(likelihood.timeline), len(states)))
    for bit, state in enumerate(resets):
        result[(likelihood.timeline.reset & (1 << bit)) != 0, state] = 0.0
    return result


def to_filterpy(source: Source, given: Given | None = None) -> ExtendedKalmanFilter:
    """The model as a `filterpy.kalman.ExtendedKalmanFilter`, positioned before the first instant.

    source, given: a `Fit` and its `Record`, or a `Likelihood` and its `Estimate` or values; n states.

    Returns filterpy's filter with x (n,) and P (n, n) in the states' units, and two more methods:
    `advance(k)` predicts to instant k; `observe(k)` applies the readings of instant k one after the other
    (missing ones are left out) and returns their log-likelihood.  All matrix algebra is filterpy's; the
    nonlinear prediction, its Jacobian F and the noise Q come from the model.  Raises ValueError for
    a diffuse start, which filterpy cannot hold, and for anything else, with the call that makes what is
    missing.
    """
    found = subject("to_filterpy", source, given)
    likelihood, values = found.likelihood, found.values
    if likelihood.initial == "diffuse":
        raise ValueError(
            "initial: filterpy's filter starts from finite variances, found a diffuse start; state another "
            "`initial`, such as the Gaussian `trace(values).last` of the readings that resolve it"
        )
    from filterpy.kalman import ExtendedKalmanFilter

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
    """Prediction of an output at instant k, its slopes (n,), and the variance of its noise."""
    model, t = likelihood.model, likelihood.timeline
    u = {one: float(t.input(one)[k]) for one in model.inputs}
    prediction, variance = model.evaluate(list(mean), u, values).outputs[name]
    return float(prediction), state_derivatives(model, name, values, mean, u), float(variance)
