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
    """Mean (n,) and covariance (n, n) of the state; derivatives by the parameters have a first axis (d,)."""

    mean: np.ndarray
    covariance: np.ndarray


def law(
    name: str, model: Model, recursion: Recursion, values: Mapping[str, float], inputs: Mapping[str, float]
) -> Moments:
    """The start called "stationary", or the mechanisms' own under any other name."""
    if name == "stationary":
        return stationary(model, recursion, values, inputs)[0]
    return prior(model, values, inputs)


def law_with_slopes(
    name: str, model: Model, recursion: Recursion, values: Mapping[str, float], inputs: Mapping[str, float]
) -> tuple[Moments, Moments]:
    """`law` and its derivatives."""
    if name == "stationary":
        return stationary_with_slopes(model, recursion, values, inputs)
    return prior(model, values, inputs), prior_slopes(model, values, inputs)


def prior(model: Model, values: Mapping[str, float], inputs: Mapping[str, float]) -> Moments:
    """The mechanisms' own law at the first inputs."""
    mean, covariance = model.initial_moments(values, inputs)
    return Moments(np.array(mean, dtype=float), np.array(covariance, dtype=float))


def prior_slopes(model: Model, values: Mapping[str, float], inputs: Mapping[str, float]) -> Moments:
    """Derivatives of `prior`."""
    mean, covariance = model.initial_moments(_stepped(model, values), inputs)
    n, count = len(mean), len(model.parameters)
    slopes = _slopes([value for row in covariance for value in row], count)
    return Moments(_slopes(mean, count), slopes.reshape(count, n, n))


def stationary(
    model: Model, recursion: Recursion, values: Mapping[str, float], inputs: Mapping[str, float]
) -> tuple[Moments, np.ndarray]:
    """The steady state at the first inputs with its covariance, and the Jacobian A (n, n) there.

    Raises ValueError where the model has none: Newton's steps from the prior's mean do not end, or a state
    does not return.
    """
    begun = prior(model, values, inputs)
    mean, width = begun.mean, np.sqrt(np.diag(begun.covariance))
    for _ in range(NEWTON):
        rates, matrix, noise = _linearised(recursion, values, mean, inputs)
        try:
            change = np.linalg.solve(matrix, rates)
        except np.linalg.LinAlgError:
            break
        if recursion.exact or np.all(np.abs(change) <= 1e-13 * (np.abs(mean) + width)):
            if np.linalg.eigvals(matrix).real.max() >= 0.0:
                break
            return Moments(mean - change, lyapunov(matrix, noise[None])[0]), matrix
        mean = mean - change
    raise ValueError("initial: the model has no stationary state; use 'prior', 'diffuse' or a Gaussian")


def stationary_with_slopes(
    model: Model, recursion: Recursion, values: Mapping[str, float], inputs: Mapping[str, float]
) -> tuple[Moments, Moments]:
    """`stationary` and its derivatives."""
    at, matrix = stationary(model, recursion, values, inputs)
    count, graph, moved = len(model.parameters), recursion.graph, _stepped(model, values)
    known = recursion.symbols(moved, at.mean, inputs)
    mean = -np.linalg.solve(matrix, _slopes(graph.evaluate(recursion.rates, known), count).T)
    known |= recursion.symbols({}, at.mean[:, None] + 1j * STEP * mean)
    places, noise_places = recursion.jacobian_entries, recursion.noise_entries
    found = _slopes(graph.evaluate([*places.values(), *noise_places.values()], known), count)
    n, half = recursion.n, len(places)
    right = _filled(n, places, found[:, :half]) @ at.covariance
    right = right + np.swapaxes(right, 1, 2) + _filled(n, noise_places, found[:, half:])
    return at, Moments(mean.T, lyapunov(matrix, right))


def packed(recursion: Recursion, first: Moments, unknown: Sequence[int], begun: bool) -> np.ndarray:
    """Moments (…, w) as the loops of a recursion take them; of the states `unknown` nothing is known.

    Not `begun`, the loadings wait for the first reading: there nothing is known, whatever came before.
    """
    if not unknown:
        return recursion.packed_moments(first.mean, first.covariance)
    known = np.ones(recursion.n)
    known[unknown] = 0.0
    state = recursion.packed_moments(first.mean * known, first.covariance * np.outer(known, known))
    loadings, directions = np.eye(recursion.n)[:, unknown].ravel(), np.eye(len(unknown)).ravel()
    state[..., recursion.loaded :] = np.concatenate([loadings, directions, [float(begun)]])
    return state


def packed_slopes(
    recursion: Recursion, first: Moments, slopes: Moments, unknown: Sequence[int]
) -> np.ndarray:
    """Derivatives (d, w) of `packed`."""
    if recursion.factored:
        parts = (first.mean, slopes.mean), (first.covariance, slopes.covariance)
        moved = Moments(*(at + 1j * STEP * slope for at, slope in parts))
        return np.imag(packed(recursion, moved, unknown, False)) / STEP
    found = packed(recursion, slopes, unknown, False)
    found[:, recursion.loaded :] = 0.0
    return found


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
