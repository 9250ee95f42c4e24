"""Moments of the state before the first reading, and their exact derivatives by the parameters.

A start is the mechanisms' own law (`prior`) or the steady state at the first inputs (`stationary`):

    f(m) = 0,    A P + P A' + Q = 0,    A = ∂f/∂x at m.

Its derivatives along every parameter solve the same equations with other right-hand sides,

    A ∂m = −∂f,    A ∂P + ∂P A' = −(∂A P + P ∂A' + ∂Q),

with one factorisation for all.  The right-hand sides come from complex steps, exact to rounding, of all
parameters at once: numpy carries one column for each of them.

Shapes: n states, d parameters.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.engine.traced_filter import Recursion
from hygrokf.physics.expression import Value
from hygrokf.physics.model import Model, Values

STEP = 1e-30
"""Size of a complex step: far below rounding, so that its square vanishes."""
NEWTON = 50
"""Largest number of steps to a steady state; a linear model takes one."""


@dataclass(frozen=True)
class Moments:
    """Mean (n,) and covariance (n, n) of the state."""

    mean: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class Slopes:
    """Derivatives of the moments by the parameters: of the mean (d, n), of the covariance (d, n, n)."""

    mean: np.ndarray
    covariance: np.ndarray


def prior(model: Model, values: Mapping[str, float], inputs: Mapping[str, float]) -> Moments:
    """The mechanisms' own law at the first inputs."""
    mean, variance = model.initial(values, inputs)
    return Moments(np.array(mean, dtype=float), np.diag(np.array(variance, dtype=float)))


def prior_slopes(model: Model, values: Mapping[str, float], inputs: Mapping[str, float]) -> Slopes:
    """Derivatives of `prior`."""
    mean, variance = model.initial(_stepped(model, values), inputs)
    n, count = len(mean), len(model.parameters)
    covariance = np.zeros((count, n, n))
    covariance[:, np.arange(n), np.arange(n)] = _slopes(variance, count)
    return Slopes(_slopes(mean, count), covariance)


def stationary(
    model: Model, recursion: Recursion, values: Mapping[str, float], inputs: Mapping[str, float]
) -> tuple[Moments, np.ndarray]:
    """The steady state at the first inputs with its covariance, and the Jacobian A (n, n) there.

    Raises ValueError where the model has none: Newton's steps from the prior's mean do not end, or a state
    does not return.
    """
    mean = prior(model, values, inputs).mean
    for _ in range(NEWTON):
        rates, matrix, noise = _linearised(recursion, values, mean, inputs)
        try:
            change = np.linalg.solve(matrix, rates)
        except np.linalg.LinAlgError:
            break
        if recursion.exact or np.all(np.abs(change) <= 1e-14 * np.abs(mean)):
            if np.linalg.eigvals(matrix).real.max() >= 0.0:
                break
            return Moments(mean - change, lyapunov(matrix, noise[None])[0]), matrix
        mean = mean - change
    raise ValueError("initial: the model has no stationary state; use 'prior', 'diffuse' or a Gaussian")


def stationary_slopes(
    model: Model,
    recursion: Recursion,
    values: Mapping[str, float],
    inputs: Mapping[str, float],
    at: Moments,
    matrix: np.ndarray,
) -> Slopes:
    """Derivatives of `stationary`, which gave the moments `at` and the Jacobian `matrix`."""
    count, graph, moved = len(model.parameters), recursion.graph, _stepped(model, values)
    known = recursion.symbols(moved, at.mean, inputs)
    mean = -np.linalg.solve(matrix, _slopes(graph.evaluate(recursion.rates, known), count).T)
    known |= recursion.symbols({}, at.mean[:, None] + 1j * STEP * mean)
    places, noise_places = recursion.jacobian_entries, recursion.noise_entries
    found = _slopes(graph.evaluate([*places.values(), *noise_places.values()], known), count)
    n, half = recursion.n, len(places)
    right = _filled(n, places, found[:, :half]) @ at.covariance
    right = right + np.swapaxes(right, 1, 2) + _filled(n, noise_places, found[:, half:])
    return Slopes(mean.T, lyapunov(matrix, right))


def lyapunov(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The matrices X (r, n, n) of A X + X A' + B = 0 for A (n, n) and symmetric B (r, n, n)."""
    n, eye = len(matrix), np.eye(len(matrix))
    whole = matrix[:, None, :, None] * eye[None, :, None, :] + eye[:, None, :, None] * matrix[None, :, None]
    flat = np.linalg.solve(whole.reshape(n * n, n * n), -right.reshape(-1, n * n).T)
    found = flat.T.reshape(-1, n, n)
    return 0.5 * (found + np.swapaxes(found, 1, 2))


def _stepped(model: Model, values: Mapping[str, float]) -> dict[str, np.ndarray]:
    """The values as arrays (d,), of which entry i takes a complex step along parameter i."""
    names = [p.name for p in model.parameters]
    columns = np.array([[values[name]] for name in names]).reshape(-1, 1) + 1j * STEP * np.eye(len(names))
    return dict(zip(names, columns, strict=True))


def _slopes(moved: Sequence[Value], count: int) -> np.ndarray:
    """Derivatives (d, m) of m numbers from what complex steps made of them: (d,), or () where no parameter
    enters."""
    found = np.empty((len(moved), count))
    for row, value in zip(found, moved, strict=True):
        row[:] = np.imag(value) / STEP
    return found.T


def _linearised(
    recursion: Recursion, values: Values, mean: np.ndarray, inputs: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The rates (n,), A (n, n) and Q (n, n) at a state and inputs."""
    n, places, noise_places = recursion.n, recursion.jacobian_entries, recursion.noise_entries
    wanted = [*recursion.rates, *places.values(), *noise_places.values()]
    known = recursion.symbols(values, mean.tolist(), inputs)
    found = np.array(recursion.graph.evaluate(wanted, known), dtype=float)
    split = n + len(places)
    return found[:n], _filled(n, places, found[n:split]), _filled(n, noise_places, found[split:])


def _filled(n: int, places: Iterable[tuple[int, int]], entries: np.ndarray) -> np.ndarray:
    """Matrices (…, n, n) with `entries` (…, m) at `places`."""
    matrix = np.zeros((*entries.shape[:-1], n * n))
    matrix[..., [i * n + j for i, j in places]] = entries
    return matrix.reshape(*entries.shape[:-1], n, n)
