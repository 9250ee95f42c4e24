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
"""Size of a complex step: far below rounding, so that the square of the step vanishes."""
MOST_NEWTON_STEPS = 50
"""Largest number of steps to a steady state; a linear model takes one."""


@dataclass(frozen=True)
class Moments:
    """Mean (n,) and covariance (n, n) of the state; derivatives by the parameters have a first axis (d,)."""

    mean: np.ndarray
    covariance: np.ndarray


def law(
    name: str, model: Model, recursion: Recursion, values: Mapping[str, float], inputs: Mapping[str, float]
) -> Moments:
    """Moments of the steady state for "stationary", of the mechanisms' prior for any other name."""
    if name == "stationary":
        return stationary(model, recursion, values, inputs)[0]
    return prior(model, values, inputs)


def law_with_slopes(
    name: str, model: Model, recursion: Recursion, values: Mapping[str, float], inputs: Mapping[str, float]
) -> tuple[Moments, Moments]:
    """The moments of `law` and their derivatives."""
    if name == "stationary":
        return stationary_with_slopes(model, recursion, values, inputs)
    return prior(model, values, inputs), prior_slopes(model, values, inputs)


def prior(model: Model, values: Mapping[str, float], inputs: Mapping[str, float]) -> Moments:
    """The moments that the mechanisms state at the first inputs."""
    mean, covariance = model.initial_moments(values, inputs)
    return Moments(np.array(mean, dtype=float), np.array(covariance, dtype=float))


def prior_slopes(model: Model, values: Mapping[str, float], inputs: Mapping[str, float]) -> Moments:
    """Derivatives of `prior`."""
    mean, covariance = model.initial_moments(_complex_steps(model, values), inputs)
    n, count = len(mean), len(model.parameters)
    slopes = _imaginary_parts([value for row in covariance for value in row], count)
    return Moments(_imaginary_parts(mean, count), slopes.reshape(count, n, n))


def stationary(
    model: Model, recursion: Recursion, values: Mapping[str, float], inputs: Mapping[str, float]
) -> tuple[Moments, np.ndarray]:
    """The steady state at the first inputs with its covariance, and the Jacobian A (n, n) there.

    Raises ValueError where the model has no steady state: Newton's iteration from the prior's mean does not
    converge, or an eigenvalue of A has no negative real part.
    """
    start = prior(model, values, inputs)
    mean, width = start.mean, np.sqrt(np.diag(start.covariance))
    for _ in range(MOST_NEWTON_STEPS):
        rates, jacobian, noise = _linearise(recursion, values, mean, inputs)
        try:
            change = np.linalg.solve(jacobian, rates)
        except np.linalg.LinAlgError:
            break
        if recursion.exact or np.all(np.abs(change) <= 1e-13 * (np.abs(mean) + width)):
            if np.linalg.eigvals(jacobian).real.max() >= 0.0:
                break
            return Moments(mean - change, lyapunov(jacobian, noise[None])[0]), jacobian
        mean = mean - change
    raise ValueError("initial: the model has no stationary state; use 'prior', 'diffuse' or a Gaussian")


def stationary_with_slopes(
    model: Model, recursion: Recursion, values: Mapping[str, float], inputs: Mapping[str, float]
) -> tuple[Moments, Moments]:
    """The moments of `stationary` and their derivatives."""
    steady, matrix = stationary(model, recursion, values, inputs)
    count, graph, stepped = len(model.parameters), recursion.graph, _complex_steps(model, values)
    symbols = recursion.symbols(stepped, steady.mean, inputs)
    mean = -np.linalg.solve(matrix, _imaginary_parts(graph.evaluate(recursion.rates, symbols), count).T)
    symbols |= recursion.symbols({}, steady.mean[:, None] + 1j * STEP * mean)
    places, noise_places = recursion.jacobian_entries, recursion.noise_entries
    derivatives = _imaginary_parts(graph.evaluate([*places.values(), *noise_places.values()], symbols), count)
    n, split = recursion.n, len(places)
    right = _matrices_of_entries(n, places, derivatives[:, :split]) @ steady.covariance
    right = right + np.swapaxes(right, 1, 2) + _matrices_of_entries(n, noise_places, derivatives[:, split:])
    return steady, Moments(mean.T, lyapunov(matrix, right))


def packed(recursion: Recursion, first: Moments, unknown: Sequence[int], begun: bool) -> np.ndarray:
    """Moments (…, w) packed for the loops of a recursion; nothing is known of the states `unknown`.

    Without `begun`, the loadings start at the first reading: nothing is known of these states until then.
    """
    if not unknown:
        return recursion.packed_moments(first.mean, first.covariance)
    is_known = np.ones(recursion.n)
    is_known[unknown] = 0.0
    state = recursion.packed_moments(first.mean * is_known, first.covariance * np.outer(is_known, is_known))
    loadings, directions = np.eye(recursion.n)[:, unknown].ravel(), np.eye(len(unknown)).ravel()
    state[..., recursion.loaded :] = np.concatenate([loadings, directions, [float(begun)]])
    return state


def packed_slopes(
    recursion: Recursion, first: Moments, slopes: Moments, unknown: Sequence[int]
) -> np.ndarray:
    """Derivatives (d, w) of `packed`."""
    if recursion.factored:
        parts = (first.mean, slopes.mean), (first.covariance, slopes.covariance)
        stepped = Moments(*(part + 1j * STEP * slope for part, slope in parts))
        return np.imag(packed(recursion, stepped, unknown, False)) / STEP
    derivatives = packed(recursion, slopes, unknown, False)
    derivatives[:, recursion.loaded :] = 0.0
    return derivatives


def lyapunov(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The matrices X (r, n, n) of A X + X A' + B = 0 for A (n, n) and symmetric B (r, n, n)."""
    n, eye = len(matrix), np.eye(len(matrix))
    operator = (
        matrix[:, None, :, None] * eye[None, :, None, :] + eye[:, None, :, None] * matrix[None, :, None]
    )
    columns = np.linalg.solve(operator.reshape(n * n, n * n), -right.reshape(-1, n * n).T)
    solution = columns.T.reshape(-1, n, n)
    return 0.5 * (solution + np.swapaxes(solution, 1, 2))


def _complex_steps(model: Model, values: Mapping[str, float]) -> dict[str, np.ndarray]:
    """The parameter values as arrays (d,); entry i has a complex step along parameter i."""
    names = [p.name for p in model.parameters]
    columns = np.array([[values[name]] for name in names]).reshape(-1, 1) + 1j * STEP * np.eye(len(names))
    return dict(zip(names, columns, strict=True))


def _imaginary_parts(stepped: Sequence[Value], count: int) -> np.ndarray:
    """Derivatives (d, m) of m numbers from their values after complex steps, (d,), or () without a
    parameter."""
    derivatives = np.empty((len(stepped), count))
    for row, value in zip(derivatives, stepped, strict=True):
        row[:] = np.imag(value) / STEP
    return derivatives.T


def _linearise(
    recursion: Recursion, values: Values, mean: np.ndarray, inputs: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The rates (n,), A (n, n) and Q (n, n) at a state and inputs."""
    n, places, noise_places = recursion.n, recursion.jacobian_entries, recursion.noise_entries
    expressions = [*recursion.rates, *places.values(), *noise_places.values()]
    symbols = recursion.symbols(values, mean.tolist(), inputs)
    evaluated = np.array(recursion.graph.evaluate(expressions, symbols), dtype=float)
    split = n + len(places)
    return (
        evaluated[:n],
        _matrices_of_entries(n, places, evaluated[n:split]),
        _matrices_of_entries(n, noise_places, evaluated[split:]),
    )


def _matrices_of_entries(n: int, places: Iterable[tuple[int, int]], entries: np.ndarray) -> np.ndarray:
    """Matrices (…, n, n) with `entries` (…, m) at `places`."""
    matrix = np.zeros((*entries.shape[:-1], n * n))
    matrix[..., [i * n + j for i, j in places]] = entries
    return matrix.reshape(*entries.shape[:-1], n, n)
