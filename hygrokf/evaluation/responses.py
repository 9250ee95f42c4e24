"""A model as a linear system: its matrices for python-control, frequency and step responses with their
uncertainty.

Bands are percentiles over draws of the parameters from the covariance of their coordinates.  The draws are
points of a scrambled Sobol' sequence (Owen 1998, doi:10.1006/jcom.1998.0487): a few thousand are as accurate
as some hundred thousand random points.  Shapes: F frequencies, T times, N draws; k outputs, m inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from hygrokf.data.record import Record
from hygrokf.data.result_file import drawn
from hygrokf.estimation.confidence import expect_level
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.estimation.inference import operating_point
from hygrokf.estimation.subject import Given, Source, Spread, is_fit, subject
from hygrokf.modelling.thermal_system import thermal_system
from hygrokf.physics.linearisation import LinearSystem, linearise

if TYPE_CHECKING:
    import control
    from matplotlib.axes import Axes

RESPONSE_DRAWS = 4096
RESPONSE_POINTS = 121
"""Frequencies or times of a response whose grid is not stated."""
LEAST_RESIDUE = 1e-9
"""[1] share of the largest residue at or below which a mode transmits no input to an output."""
Answer = tuple[np.ndarray, np.ndarray, np.ndarray]
"""A value with its lower and upper bound, (F,) or (T,) each; NaN where no uncertainty is known."""


@dataclass(frozen=True)
class Response:
    """Responses of the outputs to the inputs, by pair (output, input).

    `level` [1] of the bands; `system`: the linear system at the parameters' values.
    """

    level: float
    system: LinearSystem

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """All pairs (output, input)."""
        return [(output, name) for output in self.system.outputs for name in self.system.inputs]

    def __repr__(self) -> str:
        outputs, inputs = ", ".join(self.system.outputs), ", ".join(self.system.inputs)
        return f"{type(self).__name__}\n  of {outputs}\n  to {inputs}\n  {100 * self.level:g} % bands"


@dataclass(frozen=True, repr=False)
class FrequencyResponse(Response):
    """G(iω) = C (iω − A)⁻¹ B + D: `omega` (F,) [rad/h]; `magnitude` [output's unit by input's unit] and
    `phase_deg` [°] by (output, input)."""

    omega: np.ndarray
    magnitude: Mapping[tuple[str, str], Answer]
    phase_deg: Mapping[tuple[str, str], Answer]

    def plot(self, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
        """The Bode diagram with its bands, magnitude over phase; one column for each input.

        axes: matplotlib's, row by row; None: a new figure of pyplot.  Returns the axes drawn on.
        """
        return drawn(self, axes)


@dataclass(frozen=True, repr=False)
class StepResponse(Response):
    """Response to a unit step of an input at time 0: `time_h` (T,) [h]; `value` [output's unit by input's
    unit] by (output, input)."""

    time_h: np.ndarray
    value: Mapping[tuple[str, str], Answer]

    def plot(self, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
        """The step responses with their bands, one panel for each output and input.

        axes: matplotlib's, row by row; None: a new figure of pyplot.  Returns the axes drawn on.
        """
        return drawn(self, axes)


def to_statespace(
    source: Source,
    given: Given | None = None,
    *,
    state: Mapping[str, float] | None = None,
    inputs: Mapping[str, float] | None = None,
) -> control.StateSpace:
    """A model as a `control.StateSpace`, time in hours.

    source, given: a `Fit`, whose thermal network, equations (2) and (3), becomes the system, with or without
        a `Record`; or a `Likelihood` and its `Estimate` or values by name.
    state, inputs: the point at which a nonlinear model of a likelihood is linearised, in its units; values
        that are not given are means of the filtered states and medians of the inputs over the data.

    Returns the system with the names of its states, inputs and outputs.  Of a fit: inputs
    `ambient_temperature` and `heat_release` [K] (f_ΔT), output `cabinet_air_temperature` [K], state
    `converter_temperature` [K].  `control.sample_system(system, step_h, "zoh")` gives F and G of the filter.
    Raises ValueError for anything else, with the call that makes what is missing, for names that the model
    does not have, and for a fit without a thermal network.
    """
    import control

    system_of, spread = _linear("to_statespace", source, given, state, inputs)
    system = system_of(spread.values)
    return control.ss(
        system.A, system.B, system.C, system.D,
        states=list(system.states), inputs=list(system.inputs), outputs=list(system.outputs), name="model",
    )  # fmt: skip


def bode(
    source: Source,
    given: Given | None = None,
    omega: np.ndarray | None = None,
    *,
    level: float = CONFIDENCE,
    state: Mapping[str, float] | None = None,
    inputs: Mapping[str, float] | None = None,
) -> FrequencyResponse:
    """Magnitude and phase of the outputs over frequency, with the uncertainty of the parameters.

    source, given, state, inputs: as `to_statespace` takes them, in the model's units.
    omega: (F,) [rad/h] above 0; default: a decade beyond the slowest and the fastest mode.
    level: [1] of the bands.

    Returns `magnitude` and `phase_deg` by (output, input), each as (value, lower, upper); the bounds are NaN
    for plain values, whose uncertainty is not known.  `plot()` draws the diagram.
    Raises ValueError as `to_statespace` does.
    """
    expect_level(level)
    if omega is not None and not np.min(omega, initial=np.inf) > 0.0:
        raise ValueError(f"omega: expected frequencies above 0 rad/h, found {np.min(omega)}")
    system_of, spread = _linear("bode", source, given, state, inputs)
    system = system_of(spread.values)
    rates = np.abs(_modes(system))
    if omega is None:
        low, high = (rates.min() / 10.0, rates.max() * 10.0) if len(rates) else (0.01, 100.0)
        omega = np.geomspace(low, high, RESPONSE_POINTS)
    grid = np.asarray(omega, dtype=float)
    exact, of_draws = _frequency(system, grid), None
    if len(spread.names):
        of_draws = _frequency(system_of(spread.drawn(_normal(len(spread.names)))), grid)
    magnitude, phase = {}, {}
    unwrapped = np.degrees(np.unwrap(np.angle(exact), axis=0))
    for pair, index in _places(system).items():
        gain, phase_value = np.abs(exact[index]), unwrapped[index]
        drawn_gains = drawn_phases = None
        if of_draws is not None:
            drawn_gains = np.abs(of_draws[(slice(None), *index)])
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = of_draws[(slice(None), *index)] / exact[index]
                drawn_phases = phase_value + np.degrees(np.angle(ratio))
        magnitude[pair] = _with_bounds(gain, drawn_gains, level)
        phase[pair] = _with_bounds(phase_value, drawn_phases, level)
    return FrequencyResponse(level, system, grid, magnitude, phase)


def step_response(
    source: Source,
    given: Given | None = None,
    time_h: np.ndarray | None = None,
    *,
    level: float = CONFIDENCE,
    state: Mapping[str, float] | None = None,
    inputs: Mapping[str, float] | None = None,
) -> StepResponse:
    """Response of the outputs to a unit step of every input, with the uncertainty of the parameters.

    source, given, state, inputs: as `to_statespace` takes them, in the model's units.
    time_h: (T,) [h] from 0 on, evenly spaced; default: five times the slowest time constant of the responses.
    level: [1] of the bands.

    Returns `value` by (output, input) as (value, lower, upper); the bounds are NaN for plain values, whose
    uncertainty is not known.  `plot()` draws the responses.
    Raises ValueError as `to_statespace` does, and for times that are not evenly spaced from 0 on.
    """
    expect_level(level)
    system_of, spread = _linear("step_response", source, given, state, inputs)
    system = system_of(spread.values)
    if time_h is None:
        decays = -1.0 / _modes(system).real
        decays = decays[decays > 0.0]
        time_h = np.linspace(
            0.0, 5.0 * float(decays.max(initial=1e-12)) if len(decays) else 10.0, RESPONSE_POINTS
        )
    grid = np.asarray(time_h, dtype=float)
    steps = np.diff(grid)
    if grid[0] != 0.0 or len(grid) < 2 or not np.allclose(steps, steps[0], rtol=1e-6) or steps[0] <= 0.0:
        raise ValueError("time_h: expected evenly spaced times [h] from 0 on, found others; use np.linspace")
    exact, of_draws = _steps(system, grid), None
    if len(spread.names):
        of_draws = _steps(system_of(spread.drawn(_normal(len(spread.names)))), grid)
    value = {
        pair: _with_bounds(exact[index], None if of_draws is None else of_draws[(slice(None), *index)], level)
        for pair, index in _places(system).items()
    }
    return StepResponse(level, system, grid, value)


# --- the system ------------------------------------------------------------------------------


def _linear(
    verb: str,
    source: Source,
    given: Given | None,
    state: Mapping[str, float] | None,
    inputs: Mapping[str, float] | None,
) -> tuple[Callable[[Mapping[str, Any]], LinearSystem], Spread]:
    """The linear system as a function of the parameters, and their values with their uncertainty."""
    if is_fit(source) and (given is None or isinstance(given, Record)):
        if state or inputs:
            raise ValueError(
                f"{verb}: expected no state and inputs beside a Fit, whose thermal network has a point of "
                f"its own; linearise the whole model by {verb}(fit.likelihood(record), fit.values, …)"
            )
        parameters = source.design.model.parameters
        spread = Spread.in_units(parameters, source.values, source.covariance)
        return (lambda values: thermal_system(source.design, values)), spread
    resolved = subject(verb, source, given)
    states, input_values = operating_point(resolved.likelihood, resolved.values, state or {}, inputs or {})
    model = resolved.likelihood.model
    states = states[: len(model.mechanism_states)]
    return (lambda values: linearise(model, values, states, input_values)), resolved.spread


def _modes(system: LinearSystem) -> np.ndarray:
    """Eigenvalues [1/h] of the modes that transmit an input to an output."""
    values, vectors = np.linalg.eig(system.A)
    driven = np.abs(np.linalg.pinv(vectors) @ system.B).max(axis=1, initial=0.0)
    residues = np.abs(system.C @ vectors).max(axis=0) * driven
    return values[(residues > LEAST_RESIDUE * residues.max(initial=0.0)) & (np.abs(values) > 0.0)]


def _places(system: LinearSystem) -> dict[tuple[str, str], tuple[Any, int, int]]:
    return {
        (output, name): (slice(None), i, j)
        for i, output in enumerate(system.outputs)
        for j, name in enumerate(system.inputs)
    }


def _frequency(system: LinearSystem, omega: np.ndarray) -> np.ndarray:
    """G(iω) (…, F, k, m)."""
    n = len(system.states)
    gain = np.empty((*system.A.shape[:-2], len(omega), *system.D.shape[-2:]), dtype=complex)
    for row, frequency in enumerate(omega):  # a frequency at a time: all together would fill the memory
        gain[..., row, :, :] = system.C @ np.linalg.solve(1j * frequency * np.eye(n) - system.A, system.B)
    return gain + system.D[..., None, :, :]


def _steps(system: LinearSystem, time_h: np.ndarray) -> np.ndarray:
    """Step responses (…, T, k, m), from the matrix exponential of [[A, B], [0, 0]]."""
    from scipy.linalg import expm

    n, m = system.B.shape[-2:]
    block_matrix = np.zeros((*system.A.shape[:-2], n + m, n + m))
    block_matrix[..., :n, :n], block_matrix[..., :n, n:] = system.A, system.B
    transition = expm(block_matrix * (time_h[1] - time_h[0]))
    state_matrix, input_matrix = transition[..., :n, :n], transition[..., :n, n:]
    state = np.zeros_like(system.B)
    responses = np.empty((*system.A.shape[:-2], len(time_h), *system.D.shape[-2:]))
    for row in range(len(time_h)):
        responses[..., row, :, :] = system.C @ state + system.D
        state = state_matrix @ state + input_matrix
    return responses


@cache
def _normal(count: int) -> np.ndarray:
    """Standard normal quasi-random points (DRAWS, count) with a fixed seed."""
    from scipy.stats import qmc

    return np.asarray(qmc.MultivariateNormalQMC(np.zeros(count), seed=1).random(RESPONSE_DRAWS))


def _with_bounds(value: np.ndarray, draws: np.ndarray | None, level: float) -> Answer:
    """A value (T,) with the percentiles of its draws (N, T)."""
    if draws is None:
        unknown = np.full(len(value), np.nan)
        return value, unknown, unknown
    lower, upper = np.quantile(draws, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)
    return value, lower, upper
