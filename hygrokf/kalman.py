"""Smoothed states, and every model as a `filterpy` object.

Shapes: T instants, n states, k outputs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.likelihood import Gaussian, Likelihood

if TYPE_CHECKING:
    from filterpy.kalman import ExtendedKalmanFilter


def smooth(likelihood: Likelihood, values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed means (T, n) and covariances (T, n, n): every state given all readings.

    Rauch–Tung–Striebel on the filter's own moments and transitions (extended where the model is nonlinear):
        G_k = P_k Φ' (P⁻_{k+1})⁻¹,  m^s_k = m_k + G_k (m^s_{k+1} − m⁻_{k+1}),  P^s_k = P_k + G_k (P^s_{k+1} − P⁻_{k+1}) G_k'.
    A running mean that begins anew at an instant carries nothing over it and is left out of the backward step there.
    """
    found = likelihood.trace(values)
    mean, covariance = found.mean.copy(), found.covariance.copy()
    kept = _carried(likelihood)
    masked = found.covariance * kept[:, :, None] * kept[:, None, :]
    cross = np.einsum("tij,tkj->tik", masked[:-1], found.transition[1:])
    prior = found.prior_covariance[1:]
    # scaled to a correlation matrix; the ridge only matters for states without any variance (a mean just begun)
    scale = np.sqrt(np.maximum(np.einsum("tii->ti", prior), 1e-300))
    normal = prior / scale[:, :, None] / scale[:, None, :]
    inverse = np.linalg.inv(normal + 1e-13 * np.eye(mean.shape[1])) / scale[:, :, None] / scale[:, None, :]
    gain = cross @ inverse
    for k in range(len(mean) - 2, -1, -1):
        g = gain[k]
        mean[k] += g @ (mean[k + 1] - found.prior_mean[k + 1])
        step = covariance[k] + g @ (covariance[k + 1] - found.prior_covariance[k + 1]) @ g.T
        covariance[k] = 0.5 * (step + step.T)
    return mean, covariance


def _carried(likelihood: Likelihood) -> np.ndarray:
    """(T, n) 1 where a state is carried on from an instant, 0 where it begins anew."""
    states, resets = likelihood.model.states, likelihood.recursion.system.resets
    result = np.ones((len(likelihood.timeline), len(states)))
    for bit, state in enumerate(resets):
        result[(likelihood.timeline.reset & (1 << bit)) != 0, state] = 0.0
    return result


def filterpy_filter(likelihood: Likelihood, values: Mapping[str, float]) -> ExtendedKalmanFilter:
    """The model as a `filterpy.kalman.ExtendedKalmanFilter`, standing before the first instant of the timeline.

    It has two verbs beside filterpy's own: `advance(k)` predicts to instant k, `observe(k)` takes its readings one
    after the other (missing ones are left out) and returns the log-likelihood of them.  All matrix algebra is
    filterpy's; the nonlinear prediction, its Jacobian F and the noise Q come from the model.
    """
    from filterpy.kalman import ExtendedKalmanFilter

    class ModelFilter(ExtendedKalmanFilter):
        """filterpy's filter with this model's prediction."""

        def predict_x(self, u: object = None) -> None:
            self.x = self._next

        def advance(self, k: int) -> None:
            self._next, self.F, self.Q = transition(likelihood, values, k, self.x)
            self.predict()

        def observe(self, k: int) -> float:
            total = 0.0
            for j, z in enumerate(likelihood.timeline.y[k]):
                if np.isfinite(z):
                    prediction, row, variance = observation(likelihood, values, k, j, self.x)
                    self.update(
                        np.array([z]),
                        lambda x, row=row: row[None, :],
                        lambda x, prediction=prediction: np.array([prediction]),
                        R=np.array([[variance]]),
                    )
                    spread, error = float(self.S[0, 0]), float(self.y[0])
                    total -= 0.5 * (np.log(2.0 * np.pi * spread) + error * error / spread)
            for bit, state in enumerate(likelihood.recursion.system.resets):
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
    """Predicted mean (n,), its derivative F (n, n) and the accumulated noise Q (n, n) of the step to instant k."""
    part = likelihood.timeline.window(k, k + 1)
    part = part.with_readings(np.full_like(part.y, np.nan))
    n = len(mean)
    start = Gaussian(mean, np.zeros((n, n)))
    found = Likelihood(likelihood.model, part).trace(values, start=start)
    return found.prior_mean[0].copy(), found.transition[0].copy(), found.prior_covariance[0].copy()


def observation(
    likelihood: Likelihood, values: Mapping[str, float], k: int, j: int, mean: np.ndarray
) -> tuple[float, np.ndarray, float]:
    """Prediction of output j at instant k, its slopes (n,) by complex steps, and the variance of its noise."""
    model, t = likelihood.model, likelihood.timeline
    u = {name: float(t.input(name)[k]) for name in model.inputs}
    name = model.outputs[j]
    prediction, variance = model.evaluate(list(mean), u, values).outputs[name]
    row = np.empty(len(mean))
    for i in range(len(mean)):
        moved = [complex(v) for v in mean]
        moved[i] += 1e-30j
        row[i] = np.imag(model.evaluate(moved, u, values).outputs[name][0]) * 1e30
    return float(np.real(prediction)), row, float(variance)
