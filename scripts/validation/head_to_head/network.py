"""A small neural residual: what a network of one hidden layer foretells of the free run's error from drivers
and lags."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import minimize
from scipy.signal import lfilter

from validation.head_to_head.ground import Ground, drivers

HIDDEN = 12
HOUR_S = 3600.0
LAGS_H = (3.0, 24.0)
"""[h] memories of the lagged copies of each driver."""
DECAYS = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Weight decays, of which the one with the least error on the last fifth of the identification period is
taken."""
PASSES = 200
SEED = 0


def corrected(ground: Ground) -> dict[str, float | None]:
    """Held-out errors [K], [g/m³] of the base model's free run and the network together."""
    times = [time for time, _ in ground.readings.values() if len(time)]
    first, last = min(time[0] for time in times), max(time[-1] for time in times)
    grid = np.arange(HOUR_S * math.floor(first / HOUR_S), last + HOUR_S, HOUR_S)
    x = inputs(ground, grid)
    early = grid <= ground.until_s
    x = (x - x[early].mean(axis=0)) / (x[early].std(axis=0) + 1e-9)
    return {quantity: _held_out(ground, quantity, grid, x) for quantity in ground.quantities}


def inputs(ground: Ground, grid: np.ndarray) -> np.ndarray:
    """(T, m) drivers, exponential means of them, the hour of day."""
    columns = []
    for name, course in drivers(ground.record, grid).items():
        columns.append(course)
        if name not in ("sin", "cos"):
            for lag in LAGS_H:
                keep = math.exp(-1.0 / lag)
                columns.append(course[0] + lfilter([1.0 - keep], [1.0, -keep], course - course[0]))
    return np.stack(columns, axis=1)


def _held_out(ground: Ground, quantity: str, grid: np.ndarray, x: np.ndarray) -> float | None:
    time, error = ground.errors(quantity, held_out=True)
    if not len(time):
        return None
    known, target = ground.errors(quantity, held_out=False)
    place = np.clip(np.round((known - grid[0]) / HOUR_S).astype(int), 0, len(grid) - 1)
    count = np.bincount(place, minlength=len(grid))
    there = np.flatnonzero(count)
    y = np.bincount(place, target, minlength=len(grid))[there] / count[there]
    scale = float(np.std(y)) or 1.0
    split = int(0.8 * len(there))
    a, b = there[:split], there[split:]

    def missed(decay: float) -> float:
        foretold = foretell(train(x[a], y[:split] / scale, decay), x[b])
        return float(np.mean((y[split:] / scale - foretold) ** 2))

    best = min(DECAYS, key=missed)
    course = scale * foretell(train(x[there], y / scale, best), x)
    return float(np.sqrt(np.mean((error - np.interp(time, grid, course)) ** 2)))


def _split(weights: np.ndarray, m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Weights (m, h), offsets (h,), output weights (h,) and output offset."""
    inner = m * HIDDEN
    return (
        weights[:inner].reshape(m, HIDDEN),
        weights[inner : inner + HIDDEN],
        weights[inner + HIDDEN : -1],
        weights[-1],
    )


def foretell(trained: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Output (T,) of the network at inputs (T, m)."""
    inner, offset, outer, last = _split(trained, x.shape[1])
    return np.tanh(x @ inner + offset) @ outer + last


def train(x: np.ndarray, y: np.ndarray, decay: float) -> np.ndarray:
    """Weights of the least mean squared error plus `decay` times the mean of the squared weights over the
    inputs."""
    n, m = x.shape
    start = np.random.default_rng(SEED).standard_normal(m * HIDDEN + 2 * HIDDEN + 1) / math.sqrt(m)

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        inner, offset, outer, last = _split(weights, m)
        lit = np.tanh(x @ inner + offset)
        off = lit @ outer + last - y
        back = np.outer(off, outer) * (1.0 - lit**2)
        slope = np.concatenate([(x.T @ back).ravel(), back.sum(axis=0), lit.T @ off, [off.sum()]]) * (2.0 / n)
        return float(np.mean(off**2) + decay / m * weights @ weights), slope + 2.0 * decay / m * weights

    return minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": PASSES}).x
