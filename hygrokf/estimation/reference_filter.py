"""The extended Kalman filter in plain numpy: the place to read the filter, to check it against and to port it
from.

Between two instants the moments of the state follow

    dm/dt = f(m, u(t)),    dP/dt = A P + P A' + Q,    A = ∂f/∂x at m,

and each reading y = h(x) + e, e ~ N(0, R), corrects them by K = P H'/S, S = H P H' + R, H = ∂h/∂x at m.  The
compiled filter (`engine.filter_loops`) does the same with closed-form steps and is some ten thousand times as
fast.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from hygrokf.engine.gaps import gap_variances
from hygrokf.estimation.likelihood import Gaussian, Likelihood
from hygrokf.estimation.smoother import observation
from hygrokf.physics.holds import between

INTEGRATION_TOLERANCE = 1e-12
"""Relative error of the integration over one step."""
INSIDE = math.nextafter(1.0, 0.0)
"""[1] largest share of a step: just before its end, where an input held from its stamp on changes."""


def reference_filter(likelihood: Likelihood, values: Mapping[str, float]) -> tuple[float, list[Gaussian]]:
    """The log-likelihood of all readings, and the state (n,) with its covariance (n, n) after each instant.

    `values` maps every parameter of the model to a number in its unit; the first state is the likelihood's
    own, which must be proper (`initial` other than "diffuse"; ValueError).  Source: Jazwinski 1970, theorem
    8.1.
    """
    model, line = likelihood.model, likelihood.timeline
    if likelihood.initial == "diffuse":
        raise ValueError("expected a proper initial state, found a diffuse state; state `initial`")
    first = likelihood.first_gaussian(values)
    gaps = gap_variances(model, likelihood.recursion, line)
    m, P, total, states = first.mean.copy(), first.covariance.copy(), 0.0, []
    for k, readings in enumerate(line.y):
        P = P + np.diag(gaps.get(k, np.zeros(len(m))))
        m, P = predict(likelihood, values, k, m, P)
        for name, y in zip(model.outputs, readings, strict=True):
            if np.isfinite(y):  # a reading that is missing corrects nothing
                h, H, R = observation(likelihood, values, k, name, m)
                e, S = y - h, H @ P @ H + R
                z = abs(e) / math.sqrt(S)
                if z > model.bound:  # the reading counts as at its bound: its noise is that much larger
                    tail = model.bound**2 * (1.0 + 2.0 * math.log(z / model.bound))
                    total -= 0.5 * (math.log(2.0 * math.pi * S) + tail)
                    K = P @ H / (S * z / model.bound)
                else:
                    total -= 0.5 * (math.log(2.0 * math.pi * S) + z * z)
                    K = P @ H / S
                m, P = m + K * e, P - np.outer(K, P @ H)
        for bit, state in enumerate(model.resets):  # running means that begin anew
            if line.reset[k] & (1 << bit):
                m[state], P[state, :], P[:, state] = 0.0, 0.0, 0.0
        states.append(Gaussian(m.copy(), P.copy(), float(line.time[k])))
    return total, states


def predict(
    likelihood: Likelihood, values: Mapping[str, float], k: int, m: np.ndarray, P: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (n,) and covariance (n, n) at instant k, integrated numerically from the moments `m` and `P` at
    the instant before."""
    from scipy.integrate import solve_ivp

    model, line, n = likelihood.model, likelihood.timeline, len(m)
    length = float(line.steps[line.key[k], 0])
    regimes = dict(zip(line.regimes, line.steps[line.key[k], 1:], strict=True))

    def inputs(share: float) -> dict[str, float]:
        ends = zip(line.varying, line.u[k], line.u[k + 1], strict=True)
        within = min(share, INSIDE)
        return regimes | {name: between(model.holds[name], a, b, within) for name, a, b in ends}

    def derivatives(t: float, moments: np.ndarray) -> np.ndarray:
        u, x, C = inputs(t / length), moments[:n], moments[n:].reshape(n, n)
        A = likelihood.jacobian(values, x, u)
        f = np.array(model.evaluate(list(x), u, values).rates, dtype=float)
        Q = np.array(model.noise(values, u), dtype=float)
        return np.concatenate([f, (A @ C + C @ A.T + Q).ravel()])

    if length == 0.0:
        return m, P
    start = np.concatenate([m, P.ravel()])
    end = solve_ivp(
        derivatives, (0.0, length), start, "DOP853", [length],
        rtol=INTEGRATION_TOLERANCE, atol=INTEGRATION_TOLERANCE * (1e-3 + abs(start)),
    ).y[:, -1]  # fmt: skip
    return end[:n], end[n:].reshape(n, n)
