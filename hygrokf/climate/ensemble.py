"""Free runs of an ensemble through years of weather: parameters drawn, disturbances simulated; these may be
rare and strong, as a fit's innovations show.

To the filter, heat and vapour that the model does not explain are Gaussian noise.  A door, a drain or a fan
is strong and rare instead, with the same variance, and changes everything that depends on single events:
rates of change, hours above a limit.  The excess kurtosis of the fit's innovations, 0 for Gaussian noise,
shows how rare.

Noise with shots is a compound Poisson process: normal shots at random times, every h hours on average.  Over
a step d the variance is the Gaussian one times G h/d, G ~ Poisson(d/h), with mean 1; the excess kurtosis of
an increment is 3 h/d. h = 0 is the Gaussian noise.

Source: Campbell's theorem (cumulants of shot noise; Rice 1944, doi:10.1002/j.1538-7305.1944.tb00874.x).

From a known state the model's moments over one step are the mean and covariance of the next state (exact
where the model is linear over a step).  Every member draws its next state from that distribution: Gaussian,
or with the rare shots that the fit's innovations show.  Compiled code steps all
members side by side.  In a model with switches every member operates its own.

Shapes: N members, T instants that are kept, n states, m outputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.data.record import Record
from hygrokf.estimation.batch_filter import SideBySide
from hygrokf.evaluation.self_switching import Switchboard, cut, switches_of
from hygrokf.identification.fit import Fit
from hygrokf.modelling.design import Design, read_as
from hygrokf.modelling.inputs import Run, model_inputs
from hygrokf.physics.expression import Value
from hygrokf.physics.holds import inputs_between
from hygrokf.physics.model import Model
from hygrokf.physics.parameters import Parameter
from hygrokf.physics.psychrometrics import (
    GAS_CONSTANT_VAPOUR,
    Surface,
    absolute_humidity_from_vapour_pressure,
    condenses,
    saturation_pressure_water,
)
from hygrokf.texts.climate_codes import ClimateCode
from hygrokf.texts.statement import Statement

FEWEST_JUMPS = 30
"""Number of shots that must fall into the fit's period, which limits their distance: fewer shots do not
determine a fourth moment."""
SETTLED = 2000
"""Number of readings after which the filter's covariance has converged and a shot has decayed."""
OUTPUTS = {
    "temperature": ("cabinet_temperature",),
    "humidity": ("cabinet_relative_humidity", "cabinet_absolute_humidity"),
}
"""Name of an output in the diagnosis of a fit's innovations → names of this output in models."""


@dataclass(frozen=True)
class Shots:
    """Noise of a balance ("heat", "vapour") that comes as shots: `states`: whether each state (n,) receives
    it; `every_h`: mean time between shots [h]; 0: Gaussian noise."""

    name: str
    states: np.ndarray
    every_h: float

    def factors(self, random: np.random.Generator, step_h: float, count: int) -> np.ndarray:
        """Draw factors (count,) for the standard deviation of the noise over one step [h]; their squares have
        mean 1."""
        if self.every_h <= 0.0:
            return np.ones(count)
        return np.sqrt(random.poisson(step_h / self.every_h, count) * (self.every_h / step_h))


def shots_from_innovations(
    fit: Fit, model: Model, inputs: Mapping[str, float], state: np.ndarray
) -> tuple[Shots, ...]:
    """Estimate the mean time between shots of heat and of vapour from the excess kurtosis of a fit's
    innovations.

    `model` is the fit's; it is linearised at typical `inputs` and a typical `state` (n,). The filter of the
    readings remembers a shot: an innovation is the sum of h'M^s exp(A v) w over all shots w that came s
    readings and v hours before a reading, with M = F (I − K H). The fourth cumulants add up to κ S² = 3 h Σ_s
    Σ_i ∫ (h'M^s exp(A v) e_i)⁴ q_i² dv over the readings' step, with S the innovation's variance and q_i the
    noise intensity of state i. The temperature's innovations give the shots of heat; their share in the
    humidity's innovations is subtracted before the shots of vapour are estimated.
    """
    diagnoses = _seen(fit, model)
    if not diagnoses:
        return ()
    rates, output_slopes, air_slopes, sensor_variances = _linear(model, fit.values, inputs, state)
    intensities = np.diag(np.array(model.noise(fit.values), dtype=float))
    is_thermal = air_slopes != 0.0
    for _ in range(len(air_slopes)):  # also through other states
        is_thermal = is_thermal | (rates[is_thermal] != 0.0).any(axis=0)
    mean_states = [i for i, name in enumerate(model.states) if name not in model.mechanism_states]
    shots: list[Shots] = []
    for output, chosen in (("temperature", is_thermal), ("humidity", ~is_thermal)):
        if output not in diagnoses:
            continue
        output_number, kurtosis, step_h, period_h = diagnoses[output]
        linear = (rates, output_slopes, sensor_variances, intensities)
        for earlier in shots:
            share = _share(*linear, earlier.states, mean_states, output_number, step_h)
            kurtosis -= earlier.every_h * share
        per_hour = _share(*linear, chosen, mean_states, output_number, step_h)
        every_h = min(max(kurtosis, 0.0) / per_hour, period_h / FEWEST_JUMPS) if per_hour > 0.0 else 0.0
        shots.append(Shots({"temperature": "heat", "humidity": "vapour"}[output], chosen, every_h))
    return tuple(shots)


def shot_statements(shots: tuple[Shots, ...]) -> list[Statement]:
    """Return a statement on shots that are on average more than an hour apart."""
    statements = [
        ClimateCode.SHOTS_OF_BALANCE(balance=shots_of_balance.name, hours=shots_of_balance.every_h)
        for shots_of_balance in shots
        if shots_of_balance.every_h >= 1.0
    ]
    return [ClimateCode.SHOTS(shots=tuple(statements))] if statements else []


def _seen(fit: Fit, model: Model) -> dict[str, tuple[int, float, float, float]]:
    """Return of every output with a diagnosis: its number in the model, the excess kurtosis of its
    innovations, and the step [h] and the length [h] of its readings."""
    diagnoses = {}
    for name, outputs in OUTPUTS.items():
        number = next((model.outputs.index(output) for output in outputs if output in model.outputs), None)
        diagnosis = fit.results.innovations.outputs.get(name)
        if number is not None and diagnosis is not None and math.isfinite(diagnosis.excess_kurtosis):
            diagnoses[name] = (
                number,
                diagnosis.excess_kurtosis,
                diagnosis.step_h,
                diagnosis.step_h * diagnosis.n,
            )
    return diagnoses


def _linear(
    model: Model, values: Mapping[str, float], inputs: Mapping[str, float], state: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Linearise a model at a state: slopes of the rates (n, n), of the outputs (m, n) and of the cabinet's
    temperature (n,), and the variances of the sensors (m,)."""

    def evaluate(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return rates (n,), outputs (m,) and the cabinet's temperature at the state x (n,)."""
        evaluation = model.evaluate(list(x), inputs, values)
        outputs = [float(evaluation.outputs[name][0]) for name in model.outputs]
        air = float(evaluation.quantities["cabinet_air_temperature"])
        return np.array([float(rate) for rate in evaluation.rates]), np.array(outputs), air

    columns = []
    for i, value in enumerate(state):
        shift = np.zeros(len(state))
        shift[i] = 1e-4 * max(1.0, abs(value))
        above: tuple[Value, ...] = evaluate(state + shift)
        below: tuple[Value, ...] = evaluate(state - shift)
        columns.append([(a - b) / (2.0 * shift[i]) for a, b in zip(above, below, strict=True)])
    rates, reads, air = (np.array([column[kind] for column in columns]).T for kind in range(3))
    outputs = model.evaluate(list(state), inputs, values).outputs
    return rates, reads, air, np.array([float(outputs[name][1]) for name in model.outputs])


def _share(
    rates: np.ndarray,
    output_slopes: np.ndarray,
    sensor_variances: np.ndarray,
    intensities: np.ndarray,
    chosen: np.ndarray,
    mean_states: list[int],
    output_number: int,
    step_h: float,
) -> float:
    """Return the excess kurtosis of an output's innovations for each hour between shots [1/h].

    rates: (n, n), output_slopes: (m, n), sensor_variances: (m,), intensities: (n,) of the noise. chosen:
        whether each state (n,) receives the shots. mean_states: indices of states that are running means over
        a reading's interval. step_h: [h] between readings.
    """
    from scipy.linalg import expm

    n = len(rates)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -rates, np.diag(intensities), rates.T
    block = expm(block * step_h)  # Van Loan 1978
    transition = block[n:, n:].T
    process_noise = transition @ block[:n, n:]
    transition[:, mean_states] = 0.0  # a running mean begins anew after every reading
    covariance = process_noise + 1e-9 * np.eye(n)
    for _ in range(SETTLED):
        innovation_covariance = output_slopes @ covariance @ output_slopes.T + np.diag(sensor_variances)
        gain = covariance @ output_slopes.T @ np.linalg.pinv(innovation_covariance)
        updated = covariance - gain @ innovation_covariance @ gain.T
        covariance = transition @ updated @ transition.T + process_noise
        covariance = 0.5 * (covariance + covariance.T)
    memory = transition @ (np.eye(n) - gain @ output_slopes)
    responses = np.empty((SETTLED, n))
    response = output_slopes[output_number]
    for lag in range(SETTLED):
        responses[lag], response = response, response @ memory
    # a shot at any time between two readings, by Gauss-Legendre
    nodes, weights = np.polynomial.legendre.leggauss(8)
    fourth_moment = 0.0
    for node, weight in zip(nodes, weights, strict=True):
        shot_effects = expm(rates * (0.5 * step_h * (1.0 + node))) * np.sqrt(intensities * chosen)
        fourth_moment += 0.5 * step_h * weight * float(((responses @ shot_effects) ** 4).sum())
    return 3.0 * fourth_moment / float(innovation_covariance[output_number, output_number]) ** 2


MEMBER_STEP_TOLERANCE = 1e-4
"""[1] tolerance of the members' sub-steps, relative to the spread of a member's state."""
STEP_H = 1.0
"""[h] time between the instants that are kept; shorter steps are simulated but not kept."""
YEAR_H = 8766.0
"""[h] length of a year, 365.25 days."""
WHOLE_SHARE = 0.9
"""[1] share of a year from which on a period counts as a year."""
SPIN_UP_H = 720.0
"""[h] length of a first run after which the start no longer matters; then the run starts again."""
OWN_NOISE = 1e-9
"""[1] share of a state's variance that is added as independent noise, so that singular covariances have a
factor."""
DRAWN = 256
"""Number of steps whose random numbers are drawn at once."""
LOG_MOST = 0.5
"""[1] largest standard error of a logarithm for which the logarithm is drawn from a normal distribution."""


@dataclass(frozen=True)
class Year:
    """One simulated year of all members; the last or only one may be shorter.

    `time_s` (T,) [s since 1970, UTC]. Of the cabinet air, by member and instant (N, T): `temperature_K`,
    `relative_humidity` [1] over water, `absolute_humidity_g_m3`; `condensing`: whether the cold surface is
    wet; None without humidity. `operating`, `known` (T,): whether the turbine operates; whether weather and
    power are known. `ambient`: the weather (T,) by the same names and units. `step_h`: [h] between instants.
    """

    time_s: np.ndarray
    temperature_K: np.ndarray
    relative_humidity: np.ndarray | None
    absolute_humidity_g_m3: np.ndarray | None
    condensing: np.ndarray | None
    operating: np.ndarray
    known: np.ndarray
    ambient: Mapping[str, np.ndarray]
    step_h: float

    @property
    def hours(self) -> float:
        """Hours [h] for which weather and power are known."""
        return float(self.known.sum()) * self.step_h


# --- members ---------------------------------------------------------------------------------


def draw_members(fit: Fit, count: int, seed: int) -> list[dict[str, float]]:
    """Draw `count` sets of parameter values, each as plausible as the fit given its data.

    The values are drawn from the normal distribution of the estimates in the coordinates of the estimation
    (logarithms of positive parameters), and limited to the parameters' bounds. A positive parameter whose
    logarithm is uncertain by more than `LOG_MOST`, usually a noise, cannot be distinguished from zero: a
    normal distribution of its logarithm would reach values a hundred times as large, which the data exclude.
    It is drawn in its own unit instead. Parameters without covariance (fixed, or at a bound) keep the fit's
    value. The biases of the loggers are drawn too, because their uncertainty also makes the heat release
    uncertain. A seed gives the same first sets for every count.
    """
    names, matrix = fit.covariance
    by_name = {parameter.name: parameter for parameter in fit.design.model.parameters}
    free = [by_name[name] for name in names]
    values = np.array([fit.values[parameter.name] for parameter in free])
    slopes = np.array([parameter.slope(value) for parameter, value in zip(free, values, strict=True)])
    coordinates = np.array(
        [parameter.to_coordinate(value) for parameter, value in zip(free, values, strict=True)]
    )
    spread_factor = _factor(matrix / np.outer(slopes, slopes)) if len(free) else np.zeros((0, 0))
    sds = np.sqrt((spread_factor**2).sum(axis=1))
    normal_numbers = np.random.default_rng([seed, 1]).standard_normal((count, len(free)))
    members = []
    for numbers in normal_numbers:
        shifts = spread_factor @ numbers
        drawn = {
            parameter.name: _perturbed(parameter, float(coordinate), float(shift), float(sd))
            for parameter, coordinate, shift, sd in zip(free, coordinates, shifts, sds, strict=True)
        }
        members.append({**fit.values, **drawn})
    return members


def _perturbed(parameter: Parameter, coordinate: float, shift: float, sd: float) -> float:
    """Return the value of a parameter whose coordinate changes by `shift`, limited to its bounds.

    A positive parameter whose logarithm has a standard deviation `sd` above `LOG_MOST` changes linearly
    instead.
    """
    if parameter.positive and sd > LOG_MOST:
        value = parameter.from_coordinate(coordinate) * (1.0 + shift)
    else:
        # cut before the exponential, which could overflow
        lowest, highest = parameter.to_coordinate(parameter.lower), parameter.to_coordinate(parameter.upper)
        value = parameter.from_coordinate(min(max(coordinate + shift, lowest), highest))
    return min(max(value, parameter.lower), parameter.upper)


def _factor(covariance: np.ndarray) -> np.ndarray:
    """Return a matrix B with B B' equal to the covariance, which may be singular."""
    symmetric = 0.5 * (covariance + covariance.T)
    scale = np.sqrt(np.maximum(np.diag(symmetric), 0.0))
    scale[scale == 0.0] = 1.0
    eigenvalues, eigenvectors = np.linalg.eigh(symmetric / np.outer(scale, scale))
    return scale[:, None] * eigenvectors * np.sqrt(np.maximum(eigenvalues, 0.0))


# --- instants and years ----------------------------------------------------------------------


def course(fit: Fit, record: Record) -> tuple[Design, Run]:
    """Return a fit's design, and its run on weather and power. Raises ValueError if they lack an input of the
    model."""
    design = read_as(fit.design, record)
    return design, model_inputs(design, record)


def shots_of(fit: Fit, design: Design, run: Run) -> tuple[Shots, ...]:
    """Return the shots of a fit's disturbances, at typical inputs of a run made by `course`."""
    timeline, model = run.timeline, design.model
    inputs = {name: _typical(timeline.input(name), name in timeline.regimes) for name in model.inputs}
    initial_state = np.array([model.initial(fit.values, inputs)[0]], dtype=float)
    constant_inputs = {name: np.full(2, value) for name, value in inputs.items()}
    runs = SideBySide(model, [fit.values], MEMBER_STEP_TOLERANCE)
    walk = _EnsembleWalk(runs, initial_state, constant_inputs, np.array([0.0, STEP_H]), None)
    walk.through(range(1))
    for _ in range(int(SPIN_UP_H / STEP_H)):
        walk.through(range(1, 2), is_jump=False)
    return shots_from_innovations(fit, model, inputs, walk.state[0])


def _typical(values: np.ndarray, is_regime: bool) -> float:
    """Return the median of an input (T,); for a regime, its most frequent value."""
    if not is_regime:
        return float(np.median(values))
    different, count = np.unique(values, return_counts=True)
    return float(different[count.argmax()])


def simulate_years(
    fit: Fit,
    design: Design,
    run: Run,
    members: Sequence[Mapping[str, float]],
    seed: int,
    surface: Surface,
    process: bool = True,
    rare: Sequence[Shots] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Iterator[Year]:
    """Simulate all members through the weather and power of a run; yields one year after the other.

    design, run: made by `course`.
    members: parameter values of each member, drawn by `draw_members`.
    process: False: the disturbances stay at their means, and only the parameters differ.
    rare: noise that comes as shots (`shots_of`); all other noise is Gaussian.
    say: called with the number of each year.

    Raises ValueError if the state of a member diverges.
    """
    model, timeline = design.model, run.timeline
    kept = kept_instants(timeline.time)
    groups = years_of(timeline.time[kept])
    switches = switches_of(design)
    starts = []
    random = np.random.default_rng([seed, 2])
    inputs = {name: timeline.input(name) for name in model.inputs}
    initial_inputs = {name: float(value[0]) for name, value in inputs.items()}
    state_count = len(model.states)
    for values in members:
        mean, variance = (np.array(moment, dtype=float) for moment in model.initial(values, initial_inputs))
        numbers = random.standard_normal(state_count) if process else np.zeros(state_count)
        start = mean + np.sqrt(variance) * numbers
        starts.append(np.where(model.amounts, np.maximum(start, 0.0), start))
    runs = SideBySide(model, members, MEMBER_STEP_TOLERANCE)
    initial_flags = {name: np.zeros(len(members)) for name in switches}
    values_of_members = _by_parameter(model, members)
    board = Switchboard(model, values_of_members, switches, initial_flags) if switches else None
    chance = random if process else None
    walk = _EnsembleWalk(runs, np.array(starts), inputs, timeline.time, chance, rare, board, ~run.operating)
    first_after_spin_up = int(np.searchsorted(timeline.time, timeline.time[0] + SPIN_UP_H, side="right"))
    walk.through(range(min(first_after_spin_up, len(timeline.time))))
    next_instant = 0
    for number, group in enumerate(groups):
        say(f"year {number + 1} of {len(groups)}")
        instants = kept[group]
        states = np.empty((len(instants), len(members), state_count))
        for row, instant in enumerate(instants):
            walk.through(range(next_instant, instant + 1), is_jump=next_instant == 0)
            next_instant = instant + 1
            states[row] = walk.state
        yield _year(model, members, run, instants, states, surface)


def _by_parameter(model: Model, members: Sequence[Mapping[str, float]]) -> dict[str, np.ndarray]:
    """Return the values of each parameter by name, for all members (N,)."""
    return {p.name: np.array([member[p.name] for member in members]) for p in model.parameters}


def kept_instants(time_h: np.ndarray) -> np.ndarray:
    """Return the indices of the instants to keep: the whole hours, or else the first instants that are at
    least an hour apart."""
    whole_hours = np.flatnonzero(np.abs(time_h / STEP_H - np.round(time_h / STEP_H)) < 1e-6)
    # where every hour has an instant of its own these are the hours; else whatever stands an hour on
    if len(whole_hours) >= WHOLE_SHARE * (time_h[-1] - time_h[0]) / STEP_H:
        return whole_hours
    chosen, last_time = [], -np.inf
    for index, time in enumerate(time_h.tolist()):
        if time - last_time >= STEP_H - 1e-6:
            chosen.append(index)
            last_time = time
    return np.array(chosen)


def years_of(time_h: np.ndarray) -> list[np.ndarray]:
    """Return the indices of the instants [h] of each year; a last period that is much shorter than a year is
    left out.

    Years without any instant, between weather files that are years apart, are left out too.
    """
    year_number = ((time_h - time_h[0]) // YEAR_H).astype(int)
    groups = [np.flatnonzero(year_number == year) for year in np.unique(year_number)]
    long_groups = [group for group in groups if time_h[group[-1]] - time_h[group[0]] >= WHOLE_SHARE * YEAR_H]
    return long_groups or groups[:1]


class _EnsembleWalk:
    """Steps the states (N, n) of all members through the instants `time_h`.

    random: None: no disturbances. board: decides the switches of each member; None for a model without
        switches. idle: (T,) whether the turbine stands still.
    """

    def __init__(
        self,
        runs: SideBySide,
        state: np.ndarray,
        inputs: Mapping[str, np.ndarray],
        time_h: np.ndarray,
        random: np.random.Generator | None,
        rare: Sequence[Shots] = (),
        board: Switchboard | None = None,
        idle: np.ndarray | None = None,
    ) -> None:
        self.runs, self.inputs, self.time_h, self.random = runs, inputs, time_h, random
        self.board, self.idle = board, np.zeros(len(time_h), bool) if idle is None else idle
        self.rare = [shots for shots in rare if shots.every_h > 0.0 and shots.states.any()]
        self.state = state
        self._amounts = np.array(runs.model.amounts)
        self._kicks = np.empty((0, *self.state.shape))
        self._at = 0

    def through(self, places: range, is_jump: bool = True) -> None:
        """Step to each of the instants in turn; is_jump: the first of them takes no time."""
        for instant in places:
            inputs_now = self._inputs_at(instant)
            if is_jump:
                self.runs.begin(inputs_now | self._flags)
                is_jump = False
                continue
            step_h = self.time_h[instant] - self.time_h[instant - 1]
            if self.board is None:
                self._step(step_h, inputs_now)
                continue
            inputs_before = self._inputs_at(instant - 1)
            holds, start_share = self.runs.model.holds, 0.0
            lengths_h, end_shares = cut(step_h)
            for length_h, end_share in zip(lengths_h.tolist(), end_shares.tolist(), strict=True):
                inputs = inputs_between(holds, inputs_before, inputs_now, start_share)
                self.board.decide(self.state, inputs, self.idle[instant])
                inputs = inputs_between(holds, inputs_before, inputs_now, end_share)
                self._step(length_h, inputs | self._flags)
                start_share = end_share

    def _inputs_at(self, instant: int) -> dict[str, Value]:
        """Return the inputs at an instant by name."""
        return {name: float(value[instant]) for name, value in self.inputs.items()}

    @property
    def _flags(self) -> dict[str, Value]:
        """The position of each switch by name; empty without switches."""
        return {} if self.board is None else self.board.flags

    def _step(self, step_h: float, inputs: Mapping[str, Value]) -> None:
        """Step all members over `step_h`, and draw their disturbances."""
        self.state, covariance = self.runs.step(self.state, step_h, inputs)
        if self.random is not None:
            self.state = self.state + _drawn(covariance, self._kick(step_h))
            self.state[:, self._amounts] = np.maximum(self.state[:, self._amounts], 0.0)

    def _kick(self, step_h: float) -> np.ndarray:
        """Draw random numbers (N, n) with mean 0 and variance 1 for one step: normal ones, or shots."""
        assert self.random is not None, "a walk without chance has no kicks"
        if self._at == len(self._kicks):
            self._kicks, self._at = self.random.standard_normal((DRAWN, *self.state.shape)), 0
        numbers = self._kicks[self._at]
        for shots in self.rare:
            numbers[:, shots.states] *= shots.factors(self.random, step_h, len(numbers))[:, None]
        self._at += 1
        return numbers


def _drawn(covariance: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return errors (N, n) with covariances (N, n, n), which may be singular, from independent random numbers
    (N, n).

    Raises ValueError if a covariance is not finite.
    """
    diverged = int((~np.isfinite(covariance).all(axis=(1, 2))).sum())
    if diverged:
        raise ValueError(
            f"expected finite states, found others in {diverged} of {len(covariance)} members: with the "
            "parameters that the fit leaves open its model runs away under this weather; identify it on more "
            "data, or with fewer causes"
        )
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 0.0))
    safe_scale = np.where(scale > 0.0, scale, 1.0)
    correlation = covariance / (safe_scale[:, :, None] * safe_scale[:, None, :])
    state_count = numbers.shape[1]
    correlation[:, np.arange(state_count), np.arange(state_count)] = 1.0 + OWN_NOISE
    try:
        factor = np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        # the moments of a nonlinear model may have an eigenvalue a little below 0
        least = np.linalg.eigvalsh(correlation)[:, 0]
        correlation[:, np.arange(state_count), np.arange(state_count)] += np.maximum(
            2.0 * OWN_NOISE - least, 0.0
        )[:, None]
        factor = np.linalg.cholesky(correlation)
    return scale * np.einsum("nij,nj->ni", factor, numbers)


def _year(
    model: Model,
    members: Sequence[Mapping[str, float]],
    run: Run,
    instants: np.ndarray,
    states: np.ndarray,
    surface: Surface,
) -> Year:
    """Return the year whose kept instants have the states (T, N, n)."""
    timeline = run.timeline
    inputs = {name: timeline.input(name)[instants][:, None] for name in model.inputs}
    values = {name: value[None, :] for name, value in _by_parameter(model, members).items()}
    columns = [states[:, :, i] for i in range(states.shape[2])]
    air_temperature: Value = model.quantities(columns, inputs, values)["cabinet_air_temperature"]
    temperature = np.ascontiguousarray(np.broadcast_to(air_temperature, states.shape[:2]).T)
    ambient_temperature = timeline.input("ambient_temperature")[instants]
    ambient = {"temperature_K": ambient_temperature}
    relative_humidity = absolute_humidity = is_wet = None
    if "vapour" in model.states:
        # the vapour is a linear state and may be negative where the air is all but dry
        vapour_kg = np.maximum(states[:, :, model.states.index("vapour")].T, 1e-3)
        pressure = 1e-3 * GAS_CONSTANT_VAPOUR * ambient_temperature * vapour_kg
        relative_humidity = pressure / saturation_pressure_water(temperature)
        absolute_humidity = 1e3 * absolute_humidity_from_vapour_pressure(pressure, temperature)
        is_wet = condenses(pressure, surface.temperature(ambient_temperature, temperature))
        ambient_humidity = timeline.input("ambient_absolute_humidity")[instants]
        ambient["absolute_humidity_g_m3"] = ambient_humidity
        ambient_pressure = 1e-3 * GAS_CONSTANT_VAPOUR * ambient_temperature * ambient_humidity
        ambient["relative_humidity"] = ambient_pressure / saturation_pressure_water(ambient_temperature)
    time_s = timeline.origin_s + 3600.0 * timeline.time[instants]
    step_h = float(np.median(np.diff(timeline.time[instants]))) if len(instants) > 1 else STEP_H
    operating, known = run.operating[instants], run.scored[instants]
    return Year(
        time_s, temperature, relative_humidity, absolute_humidity, is_wet, operating, known, ambient, step_h
    )
