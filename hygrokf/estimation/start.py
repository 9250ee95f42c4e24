"""Moments of the state before the first reading, and their exact derivatives by the parameters.

A start is the mechanisms' own law (`prior`) or the steady state at the first inputs (`stationary`):

    f(m) = 0,    A P + P A' + Q = 0,    A = ∂f/∂x at m.

Its derivatives along every parameter solve the same equations with other right-hand sides,

    A ∂m = −∂f,    A ∂P + ∂P A' = −(∂A P + P ∂A' + ∂Q),

with one factorisation for all.  The right-hand sides are the derivatives of the traced equations, which are
exact.

Shapes: n states, d parameters.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hygrokf.engine.traced_filter import Recursion
from hygrokf.physics.expression import Expression, Graph, Partials, Value, depends_on, jacobian, partials
from hygrokf.physics.model import Model, Values

MOST_NEWTON_STEPS = 50
"""Largest number of steps to a steady state; a linear model takes one."""


@dataclass(frozen=True)
class Moments:
    """Mean (n,) and covariance (n, n) of the state; derivatives by the parameters have a first axis (d,)."""

    mean: np.ndarray
    covariance: np.ndarray


def law(name: str, model: Model, values: Mapping[str, float], inputs: Mapping[str, float]) -> Moments:
    """The moments before the first reading: of the steady state where `name` is "stationary", else of the
    mechanisms' prior."""
    return stationary(model, values, inputs)[0] if name == "stationary" else prior(model, values, inputs)


def law_with_slopes(
    name: str, model: Model, values: Mapping[str, float], inputs: Mapping[str, float]
) -> tuple[Moments, Moments]:
    """The moments of `law` and their derivatives."""
    if name == "stationary":
        return stationary_with_slopes(model, values, inputs)
    return prior(model, values, inputs), prior_slopes(model, values, inputs)


class _StartEquations:
    """The equations that determine a model's moments before the first reading, and their derivatives, as
    expressions in a graph of their own."""

    def __init__(self, model: Model) -> None:
        self.model, self.graph = model, Graph()
        self.p = {p.name: self.graph.symbol(f"p:{p.name}") for p in model.parameters}
        self.u = {name: self.graph.symbol(f"u:{name}") for name in model.inputs}
        self.x = [self.graph.symbol(f"x:{name}") for name in model.states]

    def symbols(
        self, values: Values, inputs: Mapping[str, float], mean: Iterable[Value] = ()
    ) -> dict[str, Value]:
        """Parameters, inputs and states by the names of their symbols."""
        known = {f"p:{name}": value for name, value in values.items()}
        known |= {f"u:{name}": value for name, value in inputs.items()}
        return known | {f"x:{name}": value for name, value in zip(self.model.states, mean, strict=False)}

    @cached_property
    def prior_partials(self) -> Partials:
        """Derivatives (n + n², d) of the prior's mean and covariance by the parameters."""
        mean, covariance = self.model.initial_moments(self.p, self.u)
        return partials(self.graph, [*mean, *itertools.chain(*covariance)], list(self.p.values()))

    @cached_property
    def equations(self) -> list[Expression]:
        """The rates (n,), the entries (n²) of A and the entries (n²) of Q."""
        rates = [self.graph.lift(v) for v in self.model.traced(self.x, self.u, self.p).rates]
        matrices = jacobian(rates, self.x), self.model.noise(self.p, self.u)
        return [*rates, *(self.graph.lift(v) for matrix in matrices for row in matrix for v in row)]

    @cached_property
    def is_linear(self) -> bool:
        """Whether A depends on no state: a single step then leads to the steady state."""
        n, names = len(self.x), [f"x:{name}" for name in self.model.states]
        return not any(depends_on(self.graph, entry, names) for entry in self.equations[n : n + n * n])

    @cached_property
    def equation_partials(self) -> Partials:
        """Derivatives (n + 2 n², d + n) of the equations by the parameters and the states."""
        return partials(self.graph, self.equations, [*self.p.values(), *self.x])


def _equations(model: Model) -> _StartEquations:
    """The equations of a model, traced at first use and cached on the model."""
    if "_start" not in vars(model):
        vars(model)["_start"] = _StartEquations(model)
    traced: _StartEquations = vars(model)["_start"]
    return traced


def prior(model: Model, values: Mapping[str, float], inputs: Mapping[str, float]) -> Moments:
    """The moments that the mechanisms state at the first inputs."""
    mean, covariance = model.initial_moments(values, inputs)
    return Moments(np.array(mean, dtype=float), np.array(covariance, dtype=float))


def prior_slopes(model: Model, values: Mapping[str, float], inputs: Mapping[str, float]) -> Moments:
    """Derivatives of `prior`."""
    traced, n = _equations(model), len(model.states)
    slopes = traced.prior_partials.evaluate(traced.symbols(values, inputs)).T
    return Moments(slopes[:, :n], slopes[:, n:].reshape(-1, n, n))


def stationary(
    model: Model, values: Mapping[str, float], inputs: Mapping[str, float]
) -> tuple[Moments, np.ndarray]:
    """The steady state at the first inputs with its covariance, and the Jacobian A (n, n) there.

    Raises ValueError where the model has no steady state: Newton's iteration from the prior's mean does not
    converge, or an eigenvalue of A has no negative real part.
    """
    traced, n, start = _equations(model), len(model.states), prior(model, values, inputs)
    mean, width = start.mean, np.sqrt(np.diag(start.covariance))
    for _ in range(MOST_NEWTON_STEPS):
        symbols = traced.symbols(values, inputs, mean.tolist())
        numbers = np.array(traced.graph.evaluate(traced.equations, symbols), dtype=float)
        rates, (matrix, noise) = numbers[:n], numbers[n:].reshape(2, n, n)
        try:
            change = np.linalg.solve(matrix, rates)
        except np.linalg.LinAlgError:
            break
        if traced.is_linear or np.all(np.abs(change) <= 1e-13 * (np.abs(mean) + width)):
            if np.linalg.eigvals(matrix).real.max() >= 0.0:
                break
            return Moments(mean - change, lyapunov(matrix, noise[None])[0]), matrix
        mean = mean - change
    raise ValueError("initial: the model has no stationary state; use 'prior', 'diffuse' or a Gaussian")


def stationary_with_slopes(
    model: Model, values: Mapping[str, float], inputs: Mapping[str, float]
) -> tuple[Moments, Moments]:
    """The moments of `stationary` and their derivatives."""
    steady, matrix = stationary(model, values, inputs)
    traced, n, d = _equations(model), len(model.states), len(model.parameters)
    derivatives = traced.equation_partials.evaluate(traced.symbols(values, inputs, steady.mean.tolist()))
    mean = -np.linalg.solve(matrix, derivatives[:n, :d])
    along = derivatives[n:, :d] + derivatives[n:, d:] @ mean
    matrix_slopes, noise_slopes = along.T.reshape(d, 2, n, n).swapaxes(0, 1)
    right = matrix_slopes @ steady.covariance
    right = right + np.swapaxes(right, 1, 2) + noise_slopes
    return steady, Moments(mean.T, lyapunov(matrix, right))


def packed(recursion: Recursion, first: Moments, unknown: Sequence[int], begun: bool) -> np.ndarray:
    """Pack moments (w,) for the loops of a recursion.

    unknown: indices of states of which nothing is known; their moments do not count.  begun: whether their
    loadings move with the state from the first instant on; else from the first reading on, so that nothing
    is known of these states until then.
    """
    first = _of_known(first, unknown)
    state = recursion.packed_moments(first.mean, first.covariance)
    if unknown:
        loadings, directions = np.eye(recursion.n)[:, unknown].ravel(), np.eye(len(unknown)).ravel()
        state[recursion.loaded :] = np.concatenate([loadings, directions, [float(begun)]])
    return state


def packed_slopes(
    recursion: Recursion, first: Moments, slopes: Moments, unknown: Sequence[int]
) -> np.ndarray:
    """Derivatives (d, w) of `packed`."""
    first, slopes = _of_known(first, unknown), _of_known(slopes, unknown)
    return recursion.packed_slopes(slopes.mean, first.covariance, slopes.covariance)


def _of_known(moments: Moments, unknown: Sequence[int]) -> Moments:
    """Set the moments (…), or their derivatives, of the states `unknown` to zero."""
    is_known = np.ones(moments.mean.shape[-1])
    is_known[list(unknown)] = 0.0
    return Moments(moments.mean * is_known, moments.covariance * np.outer(is_known, is_known))


def lyapunov(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve A X + X A' + B = 0 for X (r, n, n), with A (n, n) and symmetric B (r, n, n)."""
    n, eye = len(matrix), np.eye(len(matrix))
    operator = (
        matrix[:, None, :, None] * eye[None, :, None, :] + eye[:, None, :, None] * matrix[None, :, None]
    )
    columns = np.linalg.solve(operator.reshape(n * n, n * n), -right.reshape(-1, n * n).T)
    solution = columns.T.reshape(-1, n, n)
    return 0.5 * (solution + np.swapaxes(solution, 1, 2))
