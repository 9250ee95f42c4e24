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

UNSEEN_SHARE = 1e-14
"""[1] share of the largest singular value below which a direction counts as not seen."""


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
    Both terms of P^s are squares, so that P^s stays positive semi-definite.  A running mean carries no
    information across its reset.
    Source: Rauch, Tung & Striebel 1965, doi:10.2514/3.3166; in square roots Park & Kailath 1995,
    doi:10.1080/00207179508921953.
    """
    trace, roots, directions = likelihood.with_roots(values)
    count, n = trace.mean.shape
    mean = trace.mean.copy()
    matrices = np.empty((count if covariance else 0, n, n))
    carried = _is_continued(likelihood)[..., None, :] * np.roll(trace.transition, -1, axis=0)
    noise = square_root(trace.noise[1:])
    matrix, unknown = roots[-1] @ roots[-1].T, directions[-1]
    for begin in range((count - 1) // CHUNK * CHUNK, -1, -CHUNK):
        part = slice(begin, min(begin + CHUNK, count - 1))
        gains, spreads, unresolved = _given_next(roots[part], directions[part], carried[part], noise[part])
        if covariance and part.stop == count - 1:
            matrices[-1] = _with_infinite(matrix, unknown)
        for k in range(part.stop - 1, begin - 1, -1):
            gain = gains[k - begin]
            mean[k] += gain @ (mean[k + 1] - trace.prior_mean[k + 1])
            if covariance:
                matrix = gain @ matrix @ gain.T + spreads[k - begin]
                if unknown.size:
                    unknown = _without_rounding(gain @ unknown, np.abs(gain) @ np.abs(unknown))
                    unknown = np.linalg.qr(np.hstack([unknown, unresolved[k - begin]]).T)[1].T
                matrices[k] = _with_infinite(matrix, unknown)
    return likelihood.model.natural(mean, matrices)


def _given_next(
    root: np.ndarray, start: np.ndarray, carried: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the law of the states at some instants k given those at k + 1 and the readings until k: returns
    C (t, n, n), D D' (t, n, n), and the directions (t, n, d) that stay unknown.

    root, start: W and B at the instants k.  carried: F, with zeros for running means that restart.  noise:
    the factor V of the step's noise.

    With η the unknown start, x_k = m_k + B η + W ε and x_{k+1} = m⁻ + F (B η + W ε) + V ω.  Along F B the
    next state determines η; across F B it determines ε and ω by regression.
    """
    n, d = start.shape[1:]
    error = np.concatenate([root, np.zeros_like(root)], axis=2)
    later = np.concatenate([carried @ root, noise], axis=2)
    along = carried @ start
    scale = np.sqrt((later**2).sum(axis=2) + (along**2).sum(axis=2))[..., None]
    scale = np.where(scale > 0.0, scale, 1.0)
    later, back = later / scale, np.eye(n) / np.swapaxes(scale, 1, 2)
    gain, unresolved = np.zeros_like(root), np.zeros_like(start)
    if d:
        along = along / scale
        size = np.sqrt((along**2).sum(axis=1, keepdims=True))
        size = np.where(size > 0.0, size, 1.0)
        left_vectors, length, columns = np.linalg.svd(along / size)
        is_seen = length > UNSEEN_SHARE
        reached = (start / size) @ np.swapaxes(columns, 1, 2)
        unresolved = np.where(is_seen[:, None, :], 0.0, reached)
        reached = np.where(is_seen[:, None, :], reached / np.where(is_seen, length, 1.0)[:, None, :], 0.0)
        rotation = np.swapaxes(left_vectors, 1, 2)
        rotated = rotation @ later
        gain = reached @ (rotation @ back)[:, :d]
        error = error - reached @ rotated[:, :d]
        later = np.concatenate([np.where(is_seen[..., None], 0.0, rotated[:, :d]), rotated[:, d:]], axis=1)
        back = rotation @ back
    left_directions, size, right = np.linalg.svd(later)
    is_seen = size > UNSEEN_SHARE * size[:, :1]
    weight = np.where(is_seen, 1.0 / np.where(is_seen, size, 1.0), 0.0)
    rotation = error @ np.swapaxes(right, 1, 2)
    gain = gain + (rotation[:, :, :n] * weight[:, None, :]) @ np.swapaxes(left_directions, 1, 2) @ back
    rotation[:, :, :n] *= ~is_seen[:, None, :]
    return gain, rotation @ np.swapaxes(rotation, 1, 2), unresolved


def _with_infinite(matrix: np.ndarray, unknown: np.ndarray) -> np.ndarray:
    """A covariance (n, n), infinite along the directions `unknown` (n, d)."""
    infinite = _without_rounding(unknown @ unknown.T, np.abs(unknown) @ np.abs(unknown.T))
    return np.where(infinite != 0.0, np.copysign(np.inf, infinite), matrix)


def _without_rounding(sums: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Sums of products, set to 0 where they are rounding of their `terms`, the sums of absolute products."""
    return np.where(np.abs(sums) > UNSEEN * terms, sums, 0.0)


def _is_continued(likelihood: Likelihood) -> np.ndarray:
    """(T, n) 1 where a state continues after an instant, 0 where the state is reset there."""
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
    a diffuse start, which filterpy cannot represent, and for other kinds of `source` or `given`, with the
    call that makes the expected kind.
    """
    checked = subject("to_filterpy", source, given)
    likelihood, values = checked.likelihood, checked.values
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
                    if distance > bound:  # a larger noise variance puts the reading at the bound
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

    filter_ = ModelFilter(dim_x=len(likelihood.model.states), dim_z=1)
    first = likelihood.first_gaussian(values)
    filter_.x, filter_.P = first.mean.copy(), first.covariance.copy()
    return filter_


def transition(
    likelihood: Likelihood, values: Mapping[str, float], k: int, mean: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Predicted mean (n,), its derivative F (n, n) and the accumulated noise Q (n, n) of the step to instant
    k."""
    part = likelihood.timeline.window(k, k + 1)
    part = part.with_readings(np.full_like(part.y, np.nan))
    n = len(mean)
    start = Gaussian(mean, np.zeros((n, n)))
    schedule = likelihood.schedule and likelihood.schedule.window(k, k + 1)
    trace = replace(likelihood, timeline=part, schedule=schedule).trace(values, start=start)
    return trace.prior_mean[0].copy(), trace.transition[0].copy(), trace.prior_covariance[0].copy()


def observation(
    likelihood: Likelihood, values: Mapping[str, float], k: int, name: str, mean: np.ndarray
) -> tuple[float, np.ndarray, float]:
    """Prediction of an output at instant k, its derivatives (n,) by the states, and its noise variance."""
    model, t = likelihood.model, likelihood.timeline
    u = {signal: float(t.input(signal)[k]) for signal in model.inputs}
    prediction, variance = model.evaluate(list(mean), u, values).outputs[name]
    return float(prediction), state_derivatives(model, name, values, mean, u), float(variance)
